"""Search for a design: parts are enumerated, and continuous numbers are refined in shrinking boxes, in large batches.

A design has three continuous numbers, and every limit is a kink. On the packaged requirements, descents by gradients
from 256 starts found the same buildable designs, with twice the processor time for compilation and search.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from calibration.data import Names
from calibration.data.input_errors import stated_word
from calibration.data.requirements_file import Requirements
from calibration.inference.fit_notes import Remark, progress_remark
from calibration.sizing import sheet
from calibration.sizing.design import (
    CONTINUOUS,
    OBJECTIVES,
    Design,
    SizingTask,
    build_robot,
    build_sizing_task,
    evaluate_design,
)
from calibration.sizing.part_options import DriveOption, PartOptions, Sheet, options_for_robot
from mmrjax.compile.compiling import compiled
from mmrjax.model.robot import Robot

#: Ranges of cells in series, cells in parallel, and the radius as a multiple of the robot's. On tracks, the height of
#: 100 mm of Section 2.2 allows 1.3.
CELLS, PARALLEL, RADIUS = (3, 14), (1.0, 12.0), (0.6, 1.3)
#: Random designs for each choice of parts.
TRIES = 6
#: Rows of one call of `_evaluate_designs`.
ROWS = 8192
#: Number of choices whose best random design is refined with three points along each axis. Number of designs that are
#: refined after that, with any ratio and fractions of a cell. Points along each axis, rounds, and shrinkage of the
#: box per round.
COARSE, REFINED, POINTS_PER_AXIS, ROUNDS, SHRINK = 300, 24, 7, 7, 0.45
#: Half width of the first box [ratio of each number, logarithm].
WIDTH = 0.25
#: Number of choices whose data-sheet ratios are all tried with whole cells, most parallel cells, and number of
#: designs that are kept.
WHOLE, MOST_WHOLE, KEPT_WHOLE = 600, 8, 192
#: Weights of the second objective, for a Pareto front.
SHARES = np.linspace(0, 1, 9)
#: A limit is active up to this margin.
BINDS = 0.01


@dataclasses.dataclass(frozen=True)
class SizedDesign:
    """A design from the search, with its objectives, margins and robot.

    Attributes:
        drive, cell: data sheets of drive and cell.
        ratio, radius: total gear ratio [-] and rolling radius [m].
        in_series, parallel: number of cells in series and in parallel.
        objectives: objectives by name.
        margins: margins by label, relative to the required or permitted value [-].
        bounds: bounds of the search that limit the design.
        robot: robot of the design.
    """

    JSON = (
        "motor=drive.motor.name", "gearbox", "ratio", "radius_m=radius", "cell=cell.name", "cells=in_series",
        "parallel", "objectives", "feasible", "binds", "margins",
    )  # fmt: skip
    drive: DriveOption
    cell: Sheet
    ratio: float
    radius: float
    in_series: int
    parallel: float
    objectives: dict[str, float]
    margins: dict[str, float]
    bounds: Names
    robot: Robot

    @property
    def feasible(self) -> bool:
        """True if all margins are met."""
        return all(m >= 0 for m in self.margins.values())

    @property
    def binds(self) -> list[str]:
        """Limits that are reached or violated, the nearest first, then bounds of the search that limit the design."""
        order = sorted(self.margins.items(), key=lambda item: item[1])
        return [*(label for label, m in order if m < BINDS), *self.bounds]

    @property
    def gearbox(self) -> str:
        """Family of the gearbox and number of stages."""
        return f"{self.drive.family}, stages {self.drive.stages}"


@dataclasses.dataclass(frozen=True)
class SizingResult:
    """Result of a search for designs.

    Attributes:
        task, options: task and options of the search.
        objective: objective that is minimised. For a Pareto front, the first one.
        unmeetable: labels of requirements that no choice of parts meets. They were dropped.
        ideal: best design with any gear ratio and fraction of a cell. None if there is none.
        best: best design with a gear ratio from the data sheets and whole cells.
        alternatives: next best designs, with other motors or cells.
        motors: best design for each motor: the best feasible one, or the one nearest to feasible.
        front: designs on the Pareto front of two objectives. Empty unless requested.
        evaluated: number of evaluated designs.
    """

    task: SizingTask
    options: PartOptions
    objective: str
    unmeetable: Names
    ideal: SizedDesign | None
    best: SizedDesign | None
    alternatives: tuple[SizedDesign, ...]
    motors: dict[str, SizedDesign]
    front: tuple[SizedDesign, ...]
    evaluated: int


@compiled
def _evaluate_designs(task: SizingTask, designs: Design) -> tuple[Array, Array]:
    """Objectives, shape (designs, objectives), and margins, shape (designs, margins)."""
    return jax.vmap(lambda d: evaluate_design(task, d))(designs)


@dataclasses.dataclass(frozen=True)
class ChoiceSpace:
    """All enumerated choices of parts, one in each row, with the bounds of the continuous numbers.

    Attributes:
        drive, cell, in_series: index of drive and cell, and number of cells in series, of each choice.
        low, high: logarithms of the bounds, shape (choices, 3).
    """

    options: PartOptions
    drive: np.ndarray
    cell: np.ndarray
    in_series: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def designs(self, rows: np.ndarray, x: np.ndarray) -> Design:
        """Designs of choices `rows` with continuous numbers `x` (logarithms)."""
        o = self.options
        return Design(
            jnp.asarray(x),
            {k: jnp.asarray(v[self.drive[rows]]) for k, v in o.drive.items()},
            {k: jnp.asarray(v[self.cell[rows]]) for k, v in o.cell.items()},
            jnp.asarray(self.in_series[rows], float),
        )


def enumerate_choices(robot: Robot, task: SizingTask, options: PartOptions) -> ChoiceSpace:
    """All choices of parts for a robot."""
    n_drives, n_cells = len(options.drives), len(options.cells)
    combinations = list(itertools.product(range(n_drives), range(n_cells), range(CELLS[0], CELLS[1] + 1)))
    drive, cell, series = (np.array(x) for x in zip(*combinations, strict=True))
    radius = float(robot.configurations[task.configuration].radius)

    def bounds(k: int, ratio: str) -> np.ndarray:
        return np.log(
            np.stack(
                [
                    options.drive[ratio][drive],
                    np.full(len(drive), RADIUS[k] * radius),
                    np.full(len(drive), PARALLEL[k]),
                ],
                axis=1,
            )
        )

    return ChoiceSpace(options, drive, cell, series, bounds(0, "ratio_least"), bounds(1, "ratio_most"))


def evaluate_designs(
    task: SizingTask, choices: ChoiceSpace, rows: np.ndarray, x: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Objectives and margins of many designs, computed in calls of one size."""
    parts = []
    for first in range(0, len(rows), ROWS):
        batch = np.minimum(np.arange(first, first + ROWS), len(rows) - 1)
        f, g = jax.device_get(_evaluate_designs(task, choices.designs(rows[batch], x[batch])))
        parts.append((f[: len(rows) - first], g[: len(rows) - first]))
    f, g = (np.concatenate(p) for p in zip(*parts, strict=True))
    f = np.where(f > 0, f, np.inf)  # worse than any other: no motion, or no price
    return f, np.where(np.isfinite(g), g, -5.0)


def size_robot(
    robot: Robot,
    requirements: Requirements,
    objectives: Names,
    *,
    motors: Names = (),
    seed: int = 0,
    tell: Callable[[Remark], None] = lambda note: None,
) -> SizingResult:
    """Finds gear ratio, radius, cells and motor with which a robot meets its requirements.

    Args:
        objectives: objectives to minimise, from `OBJECTIVES`. Two give a Pareto front.
        motors: names of the motors to choose from, empty for all.
        seed: random seed of the first designs.
        tell: callback for progress.

    Raises:
        BadConfiguration: as in `sheet.reject_impossible`, or an objective or a motor is unknown.
    """
    for name in objectives:
        stated_word(name, OBJECTIVES, "objective")
    sheet.reject_impossible(robot, requirements)
    part_options = options_for_robot(robot, motors)
    task = build_sizing_task(robot, requirements, part_options)
    choices = enumerate_choices(robot, task, part_options)
    objective_columns = [list(OBJECTIVES).index(name) for name in objectives]
    tell(progress_remark("designs"))
    random_designs = _random_designs(task, choices, "cost" in objectives, np.random.default_rng(seed))
    meetable = random_designs.g.max(axis=0) >= 0
    unmeetable = tuple(label for label, k in zip(task.labels, meetable, strict=True) if not k)
    first_weights = np.eye(len(OBJECTIVES))[objective_columns[0]]

    def refined(
        designs: _EvaluatedDesigns, weights: np.ndarray, free: Names, points_per_axis: int
    ) -> _EvaluatedDesigns:
        return _refine_designs(task, choices, designs, meetable, weights, free, points_per_axis)

    def lowest_costs(designs: _EvaluatedDesigns, count: int, weights: np.ndarray) -> np.ndarray:
        return np.argsort(_cost(designs.f, designs.g, meetable, weights))[:count]

    tell(progress_remark("whole"))
    catalogue = _catalogue_designs(task, choices, _promising_choices(random_designs, meetable, objective_columns))
    shares = SHARES if len(objective_columns) == 2 else SHARES[:1]
    weights = np.outer(1 - shares, first_weights) + np.outer(shares, np.eye(len(OBJECTIVES))[objective_columns[-1]])
    best = np.concatenate([lowest_costs(catalogue, KEPT_WHOLE, w) for w in weights])
    best_weights = np.repeat(weights, len(best) // len(weights), axis=0)
    buildable = refined(catalogue.part(best), best_weights, ("radius",), POINTS_PER_AXIS)
    tell(progress_remark("refined", REFINED))
    cost_order = lowest_costs(random_designs, len(random_designs.rows), first_weights)
    motor_of_choice = np.array([part_options.drives[k].motor.name for k in choices.drive])
    best_choices = np.sort(np.unique(random_designs.rows[cost_order], return_index=True)[1])[:COARSE]
    best_of_motors = np.unique(motor_of_choice[random_designs.rows[cost_order]], return_index=True)[1]
    coarse_designs = refined(
        random_designs.part(cost_order[np.union1d(best_choices, best_of_motors)]), first_weights, CONTINUOUS, 3
    )
    start_designs = coarse_designs.part(lowest_costs(coarse_designs, REFINED // 2, first_weights)) + buildable.part(
        lowest_costs(buildable, REFINED // 2, first_weights)
    )
    ideal_designs = refined(start_designs, first_weights, CONTINUOUS, POINTS_PER_AXIS)
    evaluated = sum(d.evaluated for d in (random_designs, catalogue, buildable, coarse_designs, ideal_designs))

    def sized(designs: _EvaluatedDesigns, k: int) -> SizedDesign:
        margins = np.where(meetable, designs.g[k], np.nan)
        return _sized_design(robot, task, choices, designs.rows[k], designs.x[k], designs.f[k], margins)

    ranked = [
        (c, d, k)
        for d in (ideal_designs, buildable, coarse_designs)
        for k, c in enumerate(_cost(d.f, d.g, meetable, first_weights))
    ]
    best_by_motor = dict[str, SizedDesign]()
    for _, designs, k in sorted(ranked, key=lambda c: c[0]):
        name = str(motor_of_choice[designs.rows[k]])
        if name not in best_by_motor:  # building robots for all thousand designs takes time
            best_by_motor[name] = sized(designs, k)
    order = lowest_costs(buildable, len(buildable.rows), first_weights)
    feasible = [int(k) for k in order if np.all(buildable.g[k][meetable] >= 0)]
    best_of_parts: dict[tuple[int, int], int] = {}
    for k in feasible:
        row = buildable.rows[k]
        best_of_parts.setdefault((int(choices.drive[row]), int(choices.cell[row])), k)
    best_designs = [sized(buildable, k) for k in list(best_of_parts.values())[:8]]
    ideal_index = lowest_costs(ideal_designs, 1, first_weights)[0]
    front = _pareto_front(buildable.f[:, objective_columns], feasible) if len(objective_columns) == 2 else []
    return SizingResult(
        task, part_options, objectives[0], unmeetable,
        sized(ideal_designs, ideal_index) if np.all(ideal_designs.g[ideal_index][meetable] >= 0) else None,
        best_designs[0] if best_designs else None, tuple(best_designs[1:]), best_by_motor,
        tuple(sized(buildable, k) for k in front), evaluated,
    )  # fmt: skip


@dataclasses.dataclass(frozen=True)
class _EvaluatedDesigns:
    """Designs with their objectives and margins.

    Attributes:
        rows: index of the choice of parts, shape (designs,).
        x: logarithms of ratio, radius and cells in parallel, shape (designs, 3).
        f, g: objectives and margins, shapes (designs, objectives) and (designs, limits).
        evaluated: number of designs that were evaluated to find these.
    """

    rows: np.ndarray
    x: np.ndarray
    f: np.ndarray
    g: np.ndarray
    evaluated: int

    def __add__(self, other: _EvaluatedDesigns) -> _EvaluatedDesigns:
        rows, x, f, g = (
            np.concatenate(pair)
            for pair in ((self.rows, other.rows), (self.x, other.x), (self.f, other.f), (self.g, other.g))
        )
        return _EvaluatedDesigns(rows, x, f, g, self.evaluated + other.evaluated)

    def part(self, k: np.ndarray) -> _EvaluatedDesigns:
        """Some of the designs."""
        return _EvaluatedDesigns(self.rows[k], self.x[k], self.f[k], self.g[k], 0)


def _random_designs(
    task: SizingTask, choices: ChoiceSpace, priced: bool, rng: np.random.Generator
) -> _EvaluatedDesigns:
    """Random designs for every choice of parts. They reveal limits that can be met, and promising choices.

    Args:
        priced: True to include only drives with a known price.
    """
    rows = np.repeat(np.arange(len(choices.drive)), TRIES)
    if priced:
        rows = rows[np.isfinite(choices.options.drive["cost"][choices.drive[rows]])]
    low, high = choices.low[rows], choices.high[rows]
    x = low + (high - low) * rng.random((len(rows), 3)) ** np.array([1.0, 1.0, 2.0])
    return _EvaluatedDesigns(rows, x, *evaluate_designs(task, choices, rows, x), len(rows))


def _promising_choices(
    random_designs: _EvaluatedDesigns, meetable: np.ndarray, objective_columns: list[int]
) -> np.ndarray:
    """Choices of parts whose random designs come nearest to each objective and the limits that can be met."""
    shortfall = 5 * np.sum(np.maximum(-random_designs.g[:, meetable], 0.0), axis=1)
    ranked_rows = [
        random_designs.rows[np.argsort(np.log(random_designs.f[:, c]) + shortfall)] for c in objective_columns
    ]
    return np.unique(np.concatenate([list(dict.fromkeys(rows))[:WHOLE] for rows in ranked_rows]))


def _catalogue_designs(task: SizingTask, choices: ChoiceSpace, rows: np.ndarray) -> _EvaluatedDesigns:
    """Designs of each choice of parts: every gear ratio of its sheets, a few whole cells in parallel, three radii."""
    choice_rows, numbers = [], []
    for choice in rows:
        low, high = choices.low[choice, 1], choices.high[choice, 1]
        ratios = choices.options.drives[choices.drive[choice]].ratios
        for ratio, parallel, radius_share in itertools.product(ratios, range(1, MOST_WHOLE + 1), (0.4, 0.7, 1.0)):
            choice_rows.append(choice)
            numbers.append([math.log(ratio), low + radius_share * (high - low), math.log(parallel)])
    rows, points = np.array(choice_rows), np.array(numbers)
    return _EvaluatedDesigns(rows, points, *evaluate_designs(task, choices, rows, points), len(rows))


def _refine_designs(
    task: SizingTask, choices: ChoiceSpace, designs: _EvaluatedDesigns, meetable: np.ndarray, weights: np.ndarray,
    free: Names, points_per_axis: int,
) -> _EvaluatedDesigns:  # fmt: skip
    """Best designs in shrinking boxes around these designs.

    Args:
        meetable: True for limits that at least one design meets.
        weights: weights of the objectives, of all designs or of each.
        free: the numbers of `CONTINUOUS` that may move.
        points_per_axis: number of points along each axis of a box.
    """
    axes = [np.linspace(-WIDTH, WIDTH, points_per_axis) if name in free else np.zeros(1) for name in CONTINUOUS]
    box = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    count = len(designs.rows)
    n = len(box)
    x = designs.x
    rows = np.repeat(designs.rows, n)
    weights = np.repeat(np.broadcast_to(weights, (count, len(OBJECTIVES))), n, axis=0)
    for _ in range(ROUNDS):
        candidates = np.clip((x[:, None] + box).reshape(-1, 3), choices.low[rows], choices.high[rows])
        f, g = evaluate_designs(task, choices, rows, candidates)
        cost = _cost(f, g, meetable, weights).reshape(count, n)
        best = np.arange(count) * n + np.argmin(cost, axis=1)
        x = candidates[best]
        box = box * SHRINK
    return _EvaluatedDesigns(designs.rows, x, f[best], g[best], ROUNDS * len(rows))


def _cost(f: np.ndarray, g: np.ndarray, meetable: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Cost of designs: logarithm of the objective. Designs with a violated margin cost more than any feasible one."""
    value = np.sum(np.where(weights > 0, weights * np.log(np.where(weights > 0, f, 1.0)), 0.0), axis=1)
    shortfall = np.sum(np.maximum(-g[:, meetable], 0.0), axis=1)
    return np.where(np.isfinite(value), value + np.where(shortfall > 0, 100 + shortfall, 0.0), 1e6)


def _pareto_front(f: np.ndarray, among: list[int]) -> list[int]:
    """Indices of the designs on the Pareto front of two objectives, sorted by the first."""
    order = sorted(among, key=lambda k: (f[k, 0], f[k, 1]))
    front: list[int] = []
    for k in order:
        if not front or f[k, 1] < f[front[-1], 1] * (1 - 1e-9):
            front.append(k)
    return front


def _sized_design(
    robot: Robot, task: SizingTask, choices: ChoiceSpace, row: int, x: np.ndarray, f: np.ndarray, g: np.ndarray
) -> SizedDesign:
    drive, cell = choices.options.drives[choices.drive[row]], choices.options.cells[choices.cell[row]]
    in_series = int(choices.in_series[row])
    ratio, radius, parallel = (float(v) for v in np.exp(x))
    design = jax.tree.map(lambda v: v[0], choices.designs(np.array([row]), x[None]))
    sized_robot, _ = build_robot(task.robot, task.base_mass, task.configuration, design)
    sized_robot = jax.tree.map(lambda v: np.asarray(v) if eqx.is_array(v) else v, sized_robot)

    def rating(key: str) -> float:
        return float(choices.options.drive[key][choices.drive[row]])

    sized_robot = dataclasses.replace(
        sized_robot,
        battery=dataclasses.replace(
            sized_robot.battery, cells=in_series,
            voltage_cutoff=float(choices.options.cell["cutoff"][choices.cell[row]]),
            current_limit=parallel * limit if math.isfinite(limit := cell.max_continuous_current) else None,
        ),
        motor=dataclasses.replace(
            sized_robot.motor, speed_limit=rating("speed_motor"), temperature_limit=rating("temperature")
        ),
        gearbox=dataclasses.replace(
            sized_robot.gearbox, speed_limit=rating("speed_gearbox"), torque_limit=rating("torque")
        ),
    )  # fmt: skip
    margins = {label: float(v) for label, v in zip(task.labels, g, strict=True) if np.isfinite(v)}
    reached_bounds = tuple(
        f"{word} {name}"
        for word, bound in (("least", choices.low[row]), ("largest", choices.high[row]))
        for name, v, b in zip(CONTINUOUS, x, bound, strict=True)
        if abs(v - b) < 1e-6 and (word, name) != ("least", "parallel")
    )
    objectives = {name: float(v) for name, v in zip(OBJECTIVES, f, strict=True) if np.isfinite(v)}
    return SizedDesign(
        drive, cell, ratio, radius, in_series, parallel, objectives, margins, reached_bounds, sized_robot
    )
