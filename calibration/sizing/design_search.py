"""Search for a design: parts are enumerated, and continuous numbers are found by gradients from many starts in a
batch.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

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
from calibration.sizing.part_options import CellSheet, DriveOption, PartOptions, options_for_robot
from mmrjax.compile.compiling import compiled
from mmrjax.model.robot import Robot

#: Ranges of cells in series, cells in parallel, and the radius as a multiple of the robot's (on tracks the height of
#: 100 mm of Section 2.2 allows 1.3).
CELLS, PARALLEL, RADIUS = (3, 14), (1.0, 12.0), (0.6, 1.3)
#: Random designs for each choice of parts, from which the starts are taken. Fewest starts per motor, and most starts
#: per choice.
TRIES, OF_MOTOR, OF_CHOICE = 6, 6, 3
#: Rows of one call of `_evaluate_designs`.
ROWS = 8192
#: Steps of each search. Steps between updates of the multipliers. First and last step length in the logarithms.
STEPS, EVERY, RATE = 120, 12, (0.06, 0.003)
#: Weight of a violated margin: initial value, factor per update, largest value.
WEIGHT, GROWTH, HEAVIEST = 5.0, 1.7, 500.0
#: Number of refined designs, points along each axis, rounds, and shrinkage of the box per round.
REFINED, ALONG, ROUNDS, SHRINK = 24, 7, 7, 0.45
#: Number of choices whose data-sheet ratios are all tried with whole cells, most parallel cells, and number of
#: designs that are kept.
WHOLE, MOST_WHOLE, KEPT_WHOLE = 600, 8, 192
#: A limit is active up to this margin.
BINDS = 0.01


@dataclasses.dataclass(frozen=True)
class SizedDesign:
    """One design that the search found.

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
    cell: CellSheet
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
        starts, evaluated: number of searches, and of evaluated designs.
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
    starts: int
    evaluated: int


@compiled
def _evaluate_designs(problem: SizingTask, designs: Design) -> tuple[Array, Array]:
    """Objectives, shape (designs, objectives), and margins, shape (designs, margins)."""
    return jax.vmap(lambda d: evaluate_design(problem, d))(designs)


@compiled
def _descend(
    problem: SizingTask,
    designs: Design,
    low: Float[Array, "designs 3"],
    high: Float[Array, "designs 3"],
    weights: Float[Array, "designs objectives"],
    kept: Float[Array, " margins"],
) -> Float[Array, "designs 3"]:
    """Improves designs by gradients. Returns the best feasible point of each search, or else its last point.

    The objective is an augmented Lagrangian, f + Σ (max(0, λ - w g)² - λ²) / 2w over the logarithms of the continuous
    numbers. Steps are Adam's, clipped to bounds.

    Args:
        weights: weights of the logarithms of the objectives in f.
        kept: 1 for included margins, 0 for others.
    """
    rate = optax.cosine_decay_schedule(RATE[0], STEPS, RATE[1] / RATE[0])
    adam = optax.adam(rate, b1=0.8, b2=0.95)

    def value(x: Array, d: Design, w: Array, multipliers: Array, weight: Array) -> tuple[Array, tuple[Array, Array]]:
        objectives, margins = evaluate_design(problem, dataclasses.replace(d, continuous=x))
        f = jnp.sum(jnp.where(w > 0, w * jnp.log(jnp.where(w > 0, objectives, 1.0)), 0.0))
        g = jnp.where(kept > 0, jnp.clip(margins, -5.0, 5.0), 1.0)
        short = jnp.maximum(multipliers - weight * (g - 1e-3), 0.0)
        return f + jnp.sum(short**2 - multipliers**2) / (2 * weight), (f, g)

    def one(d: Design, low: Array, high: Array, w: Array) -> Array:
        def step(carry: tuple, k: Array) -> tuple[tuple, None]:
            x, state, multipliers, weight, best, at_best = carry
            slope, (f, g) = jax.grad(value, has_aux=True)(x, d, w, multipliers, weight)
            better = jnp.all(g >= 0) & (f < best)
            best, at_best = jnp.where(better, f, best), jnp.where(better, x, at_best)
            slope = jnp.nan_to_num(slope, nan=0.0, posinf=0.0, neginf=0.0)
            change, state = adam.update(slope, state)
            updates_multipliers = (k + 1) % EVERY == 0
            multipliers = jnp.where(
                updates_multipliers, jnp.clip(multipliers - weight * (g - 1e-3), 0.0, 1e3), multipliers
            )
            weight = jnp.where(updates_multipliers, jnp.minimum(weight * GROWTH, HEAVIEST), weight)
            return (jnp.clip(x + change, low, high), state, multipliers, weight, best, at_best), None

        x = d.continuous
        begin = (x, adam.init(x), jnp.zeros_like(kept), jnp.asarray(WEIGHT), jnp.asarray(jnp.inf), x)
        (x, _, _, _, best, at_best), _ = jax.lax.scan(step, begin, jnp.arange(STEPS))
        return jnp.where(jnp.isfinite(best), at_best, x)

    return jax.vmap(one)(designs, low, high, weights)


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


def enumerate_choices(robot: Robot, problem: SizingTask, options: PartOptions) -> ChoiceSpace:
    """All choices of parts for a robot."""
    n_drives, n_cells = len(options.drives), len(options.cells)
    choices = list(itertools.product(range(n_drives), range(n_cells), range(CELLS[0], CELLS[1] + 1)))
    drive, cell, series = (np.array(x) for x in zip(*choices, strict=True))
    radius = float(robot.configurations[problem.configuration].radius)

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
    problem: SizingTask, choice: ChoiceSpace, rows: np.ndarray, x: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Objectives and margins of many designs, computed in calls of one size."""
    parts = []
    for first in range(0, len(rows), ROWS):
        some = np.minimum(np.arange(first, first + ROWS), len(rows) - 1)
        f, g = jax.device_get(_evaluate_designs(problem, choice.designs(rows[some], x[some])))
        parts.append((f[: len(rows) - first], g[: len(rows) - first]))
    f, g = (np.concatenate(p) for p in zip(*parts, strict=True))
    f = np.where(f > 0, f, np.inf)  # worse than any other: no motion, or no price
    return f, np.where(np.isfinite(g), g, -5.0)


def size_robot(
    robot: Robot,
    asked: Requirements,
    objectives: Names,
    *,
    starts: int,
    motors: Names = (),
    seed: int = 0,
    tell: Callable[[Remark], None] = lambda note: None,
) -> SizingResult:
    """Finds gear ratio, radius, cells and motor with which a robot meets its requirements.

    Args:
        objectives: objectives to minimise, from `OBJECTIVES`. Two give a Pareto front.
        starts: number of searches in the batch.
        motors: names of the motors to choose from, empty for all.
        seed: random seed of the starts.
        tell: callback for progress.

    Raises:
        BadConfiguration: as in `sheet.reject_impossible`, or an objective or a motor is unknown.
    """
    for name in objectives:
        stated_word(name, OBJECTIVES, "objective")
    sheet.reject_impossible(robot, asked)
    part_options = options_for_robot(robot, motors)
    problem = build_sizing_task(robot, asked, part_options)
    choice = enumerate_choices(robot, problem, part_options)
    columns = [list(OBJECTIVES).index(name) for name in objectives]
    tell(progress_remark("designs"))
    random_designs = _random_designs(problem, choice, "cost" in objectives, np.random.default_rng(seed))
    is_feasible = random_designs.g.max(axis=0) >= 0
    unmeetable = tuple(label for label, k in zip(problem.labels, is_feasible, strict=True) if not k)
    search = _DesignSearch(problem, choice, is_feasible, columns)
    weights = search.weights(starts)
    tell(progress_remark("descents", starts))
    free = search.descend(random_designs, weights)
    tell(progress_remark("whole"))
    real = search.buildable_designs(random_designs, free, weights)
    tell(progress_remark("refined", REFINED))
    # The best of these are refined with free ratio and fractions of a cell, because no search may have started from
    # their parts.
    top = np.argsort(search.cost(real))[:REFINED]
    free = free + search.refined(real.rows[top], real.x[top], search.first_objective_weights(len(top)), np.ones(3))
    evaluated = len(random_designs.rows) + starts * STEPS + search.evaluated

    def found(designs: _EvaluatedDesigns, k: int) -> SizedDesign:
        margins = np.where(is_feasible, designs.g[k], np.nan)
        return _sized_design(robot, problem, choice, designs.rows[k], designs.x[k], designs.f[k], margins)

    everything, by_motor = free + real, dict[str, SizedDesign]()
    for k in np.argsort(search.cost(everything)):
        name = part_options.drives[choice.drive[everything.rows[k]]].motor.name
        if name not in by_motor:  # building robots for all thousand designs takes time
            by_motor[name] = found(everything, int(k))
    good = [k for k in range(len(real.rows)) if np.all(real.g[k][is_feasible] >= 0)]
    different: dict[tuple[int, int], int] = {}
    for k in (int(k) for k in np.argsort(search.cost(real)) if k in set(good)):
        different.setdefault((int(choice.drive[real.rows[k]]), int(choice.cell[real.rows[k]])), k)
    best = [found(real, k) for k in list(different.values())[:8]]
    ideal = int(np.argmin(search.cost(free)))
    front = [found(real, k) for k in _pareto_front(real.f[:, columns], good)] if len(columns) == 2 else []
    return SizingResult(
        problem, part_options, objectives[0], unmeetable,
        found(free, ideal) if np.all(free.g[ideal][is_feasible] >= 0) else None,
        best[0] if best else None, tuple(best[1:]), by_motor, tuple(front), starts, evaluated,
    )  # fmt: skip


@dataclasses.dataclass(frozen=True)
class _EvaluatedDesigns:
    """Designs with their objectives and margins.

    Attributes:
        rows: index of the choice of parts, shape (designs,).
        x: logarithms of ratio, radius and cells in parallel, shape (designs, 3).
        f, g: objectives and margins, shapes (designs, objectives) and (designs, limits).
    """

    rows: np.ndarray
    x: np.ndarray
    f: np.ndarray
    g: np.ndarray

    def __add__(self, other: _EvaluatedDesigns) -> _EvaluatedDesigns:
        return _EvaluatedDesigns(*(np.concatenate([mine, theirs]) for mine, theirs in zip(self, other, strict=True)))

    def __iter__(self) -> Iterator[np.ndarray]:
        return iter((self.rows, self.x, self.f, self.g))


def _random_designs(
    problem: SizingTask, choice: ChoiceSpace, costed: bool, rng: np.random.Generator
) -> _EvaluatedDesigns:
    """Random designs for every choice of parts. They show which limits can be met, and some become starts.

    Args:
        costed: True to include only drives with a known price.
    """
    rows = np.repeat(np.arange(len(choice.drive)), TRIES)
    if costed:
        rows = rows[np.isfinite(choice.options.drive["cost"][choice.drive[rows]])]
    low, high = choice.low[rows], choice.high[rows]
    x = low + (high - low) * rng.random((len(rows), 3)) ** np.array([1.0, 1.0, 2.0])
    return _EvaluatedDesigns(rows, x, *evaluate_designs(problem, choice, rows, x))


@dataclasses.dataclass
class _DesignSearch:
    """The steps of a search for designs.

    Attributes:
        kept: True for limits that at least one design meets.
        columns: indices of the objectives.
        evaluated: number of designs evaluated so far.
    """

    problem: SizingTask
    choice: ChoiceSpace
    kept: np.ndarray
    columns: list[int]
    evaluated: int = 0

    def designs(self, rows: np.ndarray, x: np.ndarray) -> _EvaluatedDesigns:
        """Designs with their objectives and margins."""
        return _EvaluatedDesigns(rows, x, *evaluate_designs(self.problem, self.choice, rows, x))

    def first_objective_weights(self, count: int) -> np.ndarray:
        """Weights of only the first objective, shape (count, objectives)."""
        return np.tile(np.eye(len(OBJECTIVES))[self.columns[0]], (count, 1))

    def weights(self, starts: int) -> np.ndarray:
        """Weights of the objectives in each start, shape (starts, objectives). For two objectives they vary along the
        Pareto front.
        """
        weights = np.zeros((starts, len(OBJECTIVES)))
        share = np.ones(starts) if len(self.columns) == 1 else np.linspace(0.98, 0.02, starts)
        weights[:, self.columns[0]] += share
        if len(self.columns) == 2:
            weights[:, self.columns[1]] += 1 - share
        return weights

    def cost(self, designs: _EvaluatedDesigns) -> np.ndarray:
        """Cost by the first objective, shape (designs,)."""
        return _cost(designs.f, designs.g, self.kept, self.first_objective_weights(len(designs.rows)))

    def misses(self, drawn: _EvaluatedDesigns) -> np.ndarray:
        """Total violation of the limits that can be met, shape (designs,)."""
        return 5 * np.sum(np.maximum(-drawn.g[:, self.kept], 0.0), axis=1)

    def refined(self, rows: np.ndarray, x: np.ndarray, weights: np.ndarray, free: np.ndarray) -> _EvaluatedDesigns:
        """Refines designs in shrinking boxes around them. `free`: 1 for continuous numbers that may move."""
        choice = self.choice
        axes = [np.linspace(-1, 1, ALONG) if moves else np.zeros(1) for moves in free]
        box = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        x, width, count = x.copy(), 0.25 if free.sum() == 1 else 0.05, 0
        for _ in range(ROUNDS):
            candidates = np.clip(x[:, None] + width * box, choice.low[rows][:, None], choice.high[rows][:, None])
            n = candidates.shape[1]
            f, g = evaluate_designs(self.problem, choice, np.repeat(rows, n), candidates.reshape(-1, 3))
            cost = _cost(f, g, self.kept, np.repeat(weights, n, axis=0)).reshape(-1, n)
            x = candidates[np.arange(len(rows)), np.argmin(cost, axis=1)]
            width, count = width * SHRINK, count + len(f)
        self.evaluated += count
        return self.designs(rows, x)

    def descend(self, drawn: _EvaluatedDesigns, weights: np.ndarray) -> _EvaluatedDesigns:
        """Designs with any gear ratio and fraction of a cell, found by gradients from the best random designs."""
        choice, misses = self.choice, self.misses(drawn)
        shares = [len(s) for s in np.array_split(np.arange(len(weights)), len(self.columns))]
        picked = [
            _start_designs(choice, drawn.rows, np.log(drawn.f[:, c]) + misses, n)
            for c, n in zip(self.columns, shares, strict=True)
        ]
        rows, x = drawn.rows[np.concatenate(picked)], drawn.x[np.concatenate(picked)]
        x = np.array(_descend(
            self.problem, choice.designs(rows, x), jnp.asarray(choice.low[rows]), jnp.asarray(choice.high[rows]),
            jnp.asarray(weights), jnp.asarray(self.kept, float),
        ))  # fmt: skip
        designs = self.designs(rows, x)
        best = np.argsort(_cost(designs.f, designs.g, self.kept, weights))[: REFINED * len(self.columns)]
        x[best] = self.refined(rows[best], x[best], weights[best], np.ones(3)).x
        return self.designs(rows, x)

    def buildable_designs(
        self, drawn: _EvaluatedDesigns, free: _EvaluatedDesigns, weights: np.ndarray
    ) -> _EvaluatedDesigns:
        """Designs with gear ratios from data sheets and whole cells: those near `free`, and the best of every
        choice.
        """
        rows, x, w = _nearest_buildable(self.choice, free.rows, free.x, weights, np.argsort(self.cost(free)))
        misses = self.misses(drawn)
        for c in self.columns:
            merit = np.where(np.isfinite(drawn.f[:, c]), np.log(drawn.f[:, c]) + misses, np.inf)
            ranked = np.array(list(dict.fromkeys(drawn.rows[np.argsort(merit)]))[:WHOLE])
            one_objective = np.eye(len(OBJECTIVES))[c]
            more_rows, more_x, count = _best_buildable(self.problem, self.choice, ranked, self.kept, one_objective)
            self.evaluated += count
            rows, x = np.concatenate([rows, more_rows]), np.concatenate([x, more_x])
            w = np.concatenate([w, np.tile(one_objective, (len(more_rows), 1))])
        return self.refined(rows, x, w, np.array([0.0, 1.0, 0.0]))


def _start_designs(choice: ChoiceSpace, rows: np.ndarray, merit: np.ndarray, count: int) -> np.ndarray:
    """Designs to start from: the best for each motor, then the best of all, but few for each choice."""
    order = np.argsort(np.where(np.isfinite(merit), merit, 1e9))
    motor = [choice.options.drives[d].motor.name for d in choice.drive]
    start_indices: list[int] = []
    of_motor: dict[str, int] = {}
    of_choice: dict[int, int] = {}
    for for_each_motor in (True, False):
        for k in order:
            c = int(rows[k])
            name = motor[c]
            if len(start_indices) == count or (for_each_motor and of_motor.get(name, 0) >= OF_MOTOR):
                continue
            if (
                of_choice.get(c, 0) >= OF_CHOICE
                or k in start_indices[: len(start_indices) if not for_each_motor else 0]
            ):
                continue
            start_indices.append(int(k))
            of_motor[name], of_choice[c] = of_motor.get(name, 0) + 1, of_choice.get(c, 0) + 1
    return np.resize(np.array(start_indices), count)


def _cost(f: np.ndarray, g: np.ndarray, kept: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Cost of designs: logarithm of the objective. Designs with a violated margin cost more than any feasible one."""
    value = np.sum(np.where(weights > 0, weights * np.log(np.where(weights > 0, f, 1.0)), 0.0), axis=1)
    short = np.sum(np.maximum(-g[:, kept], 0.0), axis=1)
    return np.where(np.isfinite(value), value + np.where(short > 0, 100 + short, 0.0), 1e6)


def _nearest_buildable(
    choice: ChoiceSpace, rows: np.ndarray, x: np.ndarray, weights: np.ndarray, order: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Designs near the given ones with gear ratios from data sheets and whole cells: the two nearest of each."""
    buildable: dict[tuple, tuple] = {}
    for k in order:
        drive = choice.options.drives[choice.drive[rows[k]]]
        ratios = sorted(drive.ratios, key=lambda r: abs(math.log(r) - x[k, 0]))[:2]
        parallel = math.exp(x[k, 2])
        for ratio, p in itertools.product(
            ratios, {max(1, math.floor(parallel + 1e-6)), max(1, math.ceil(parallel - 1e-6))}
        ):
            key = (int(rows[k]), ratio, p)
            buildable.setdefault(key, (rows[k], [math.log(ratio), x[k, 1], math.log(p)], weights[k]))
    choices, points, w = zip(*buildable.values(), strict=True)
    return np.array(choices), np.array(points), np.array(w)


def _best_buildable(
    problem: SizingTask, choice: ChoiceSpace, rows: np.ndarray, kept: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, int]:
    """Best design of each choice of parts, over every gear ratio of its sheets, a few whole cells in parallel and
    three radii.

    Also returns the number of evaluations.
    """
    of_row, points = [], []
    for row in rows:
        low, high = choice.low[row, 1], choice.high[row, 1]
        ratios = choice.options.drives[choice.drive[row]].ratios
        for ratio, p, share in itertools.product(ratios, range(1, MOST_WHOLE + 1), (0.4, 0.7, 1.0)):
            of_row.append(row)
            points.append([math.log(ratio), low + share * (high - low), math.log(p)])
    choice_rows, x = np.array(of_row), np.array(points)
    f, g = evaluate_designs(problem, choice, choice_rows, x)
    best = np.argsort(_cost(f, g, kept, np.tile(weights, (len(choice_rows), 1))))[:KEPT_WHOLE]
    return choice_rows[best], x[best], len(choice_rows)


def _pareto_front(f: np.ndarray, among: list[int]) -> list[int]:
    """Indices of the designs on the Pareto front of two objectives, sorted by the first."""
    order = sorted(among, key=lambda k: (f[k, 0], f[k, 1]))
    front: list[int] = []
    for k in order:
        if not front or f[k, 1] < f[front[-1], 1] * (1 - 1e-9):
            front.append(k)
    return front


def _sized_design(
    robot: Robot, problem: SizingTask, choice: ChoiceSpace, row: int, x: np.ndarray, f: np.ndarray, g: np.ndarray
) -> SizedDesign:
    drive, cell = choice.options.drives[choice.drive[row]], choice.options.cells[choice.cell[row]]
    series = int(choice.in_series[row])
    ratio, radius, parallel = (float(v) for v in np.exp(x))
    design = jax.tree.map(lambda v: v[0], choice.designs(np.array([row]), x[None]))
    made, _ = build_robot(problem.robot, problem.base_mass, problem.configuration, design)
    made = jax.tree.map(lambda v: np.asarray(v) if eqx.is_array(v) else v, made)

    def rated(key: str) -> float:
        return float(choice.options.drive[key][choice.drive[row]])

    made = dataclasses.replace(
        made,
        battery=dataclasses.replace(
            made.battery, cells=series, voltage_cutoff=float(choice.options.cell["cutoff"][choice.cell[row]]),
            current_limit=parallel * cell.current_max if math.isfinite(cell.current_max) else None,
        ),
        motor=dataclasses.replace(
            made.motor, speed_limit=rated("speed_motor"), temperature_limit=rated("temperature")
        ),
        gearbox=dataclasses.replace(
            made.gearbox, speed_limit=rated("speed_gearbox"), torque_limit=rated("torque")
        ),
    )  # fmt: skip
    margins = {label: float(v) for label, v in zip(problem.labels, g, strict=True) if np.isfinite(v)}
    at_bound = tuple(
        f"{word} {name}"
        for word, bound in (("least", choice.low[row]), ("largest", choice.high[row]))
        for name, v, b in zip(CONTINUOUS, x, bound, strict=True)
        if abs(v - b) < 1e-6 and (word, name) != ("least", "parallel")
    )
    values = {name: float(v) for name, v in zip(OBJECTIVES, f, strict=True) if np.isfinite(v)}
    return SizedDesign(drive, cell, ratio, radius, series, parallel, values, margins, at_bound, made)
