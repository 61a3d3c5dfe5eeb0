"""Task of every point of a sweep: a run of a fidelity, a run over a profile, or a climb."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from calibration.data import Columns, Json, Names, terrains
from calibration.data.input_errors import BadConfiguration
from mmrjax import fidelities
from mmrjax.climbing import terrain
from mmrjax.climbing.climb_simulation import (
    FAILED,
    NAMES,
    OVER,
    UNFINISHED,
    ClimbRuns,
    LeverSequence,
    climb_batch,
    constant_angles,
)
from mmrjax.climbing.footing import PITCH
from mmrjax.fidelities import outputs
from mmrjax.fidelities.variation import FLAGS, STATUS, Axis, Variation
from mmrjax.model import channels, masses
from mmrjax.model.conditions import Conditions
from mmrjax.model.robot import Robot
from mmrjax.model.signals import CONVERGED, NOT_SETTLED
from mmrjax.model.signals import FAILED as FAILED_POINT
from mmrjax.model.signals import FLAGS as LIMITS
from sweeps.config_campaign import SIZE, Campaign, Obstacle

Attributes = dict[str, Json]


@dataclasses.dataclass(frozen=True)
class Task:
    """Task of every point of a sweep.

    Attributes:
        model: name of the task.
        options: options of a fidelity.
        attributes: attributes of its outputs in a store, by name.
        default_outputs: names of the default outputs.
        slow: True if a call takes long and reports progress.
        points_per_call: points per call, on processors and accelerators.
        axes: names that may vary and are neither a condition nor a parameter of the robot.
        added_conditions: function that returns conditions in addition to the varied and stated ones, and rejects
            impossible points.
        run: function that computes points, such as `compute_climbs`. None: the program of the fidelity.
    """

    model: str
    options: Mapping[str, float]
    attributes: Attributes
    default_outputs: Names
    slow: bool
    points_per_call: tuple[int, int]
    axes: Mapping[str, Axis] = dataclasses.field(default_factory=dict)
    added_conditions: Callable[[Columns, Robot, str], dict[str, float]] = lambda stated, robot, where: {}
    run: Callable[..., Json] | None = None


def task_of_configuration(config: Campaign, robot: Robot, turns: bool = False) -> Task:
    """Task of a configuration. `turns`: True if its profile drives the sides independently."""
    if config.obstacle is None:
        return run_task(config.model, config.options, robot, config.profile is not None, turns)
    obstacle = config.obstacle
    attributes = climb_attributes(config.obstacle)
    added_conditions, run = functools.partial(climb_conditions, obstacle), functools.partial(compute_climbs, obstacle)
    return Task(
        "climb",
        {},
        attributes,
        tuple(attributes),
        True,
        POINTS_PER_CALL,
        {SIZE: SIZES[obstacle.kind]},
        added_conditions,
        run,
    )


def run_task(
    model: str, options: Mapping[str, float], robot: Robot, profiled: bool = False, turns: bool = False
) -> Task:
    """Task of a run. `profiled`: over a profile, with its totals as outputs. `turns`: with both sides."""
    facts = fidelities.fidelity_facts(model)
    fidelity_columns = fidelities.get_fidelity(model).columns
    default_outputs = channels.channel_names(robot.channels)
    unit_and_label: dict[str, tuple[str, str]] = {
        row.name: (row.unit_shown, row.label) for row in outputs.output_table(robot.channels)
    }
    unit_and_label |= {name: ("", name.replace("_", " ")) for name in fidelity_columns}
    if profiled:
        from mmrjax.missions import mission_batch  # imports an integrator

        output_names = (*mission_batch.OUTPUTS, *(mission_batch.OF_TURNS if turns else ()))
        unit_and_label = {row.column: (row.unit, row.label) for row in output_names}
        default_outputs = mission_batch.USUAL
    attributes: Attributes = {
        name: {"units": unit, "long_name": label} for name, (unit, label) in unit_and_label.items()
    }
    masks = [1 << k for k in range(len(LIMITS))]
    attributes[FLAGS] = {"long_name": "limits exceeded", "flag_masks": masks, "flag_meanings": " ".join(LIMITS)}
    points_per_call = facts.at_once(False), facts.at_once(True)
    return Task(model, options, attributes, default_outputs, facts.slow and not profiled, points_per_call)


#: Initial interval of a search, and its final width [mm].
SEARCH_INTERVALS = {"step": (10.0, 450.0), "stairs": (20.0, 400.0), "gap": (20.0, 800.0)}
SEARCH_TOLERANCE = 1.0
#: Default voltage [V]: so low that a robot climbs instead of leaping.
DEFAULT_VOLTAGE = 12.0
#: Points per call on a processor and on an accelerator. Interval of their record [s].
POINTS_PER_CALL, SAMPLE_INTERVAL = (64, 2048), 0.05
#: Outputs with units and descriptions. A search has only the first two, with size 0 if no obstacle is climbed.
#: Currents are maxima. Positions are of the middle of the robot, from the start of the obstacle.
VERDICT, LARGEST = "verdict", "largest_mm"
OUTPUTS: dict[str, tuple[str, str]] = {
    VERDICT: (
        "",
        "verdict. For a search, of the smallest obstacle not climbed",
    ),
    LARGEST: ("mm", "largest climbed size"),
    "time_s": ("s", "time to the verdict"),
    "furthest_mm": ("mm", "furthest position"),
    "pitch_most_deg": ("deg", "largest pitch"),
    "energy_J": ("J", "energy, all motors"),
    "traction_current_most_A": ("A", "traction motor"),
    "front_current_most_A": ("A", "front levers' motor"),
    "rear_current_most_A": ("A", "rear levers' motor"),
}


#: Size of each kind of obstacle, which may vary between points.
SIZES = {
    kind: Axis(SIZE, "mm", meaning, (1.0, 5000.0), None)
    for kind, meaning in (
        ("step", "height of the step"),
        ("stairs", "rise of each stair"),
        ("gap", "width of the trench"),
    )
}


def climb_attributes(obstacle: Obstacle) -> Attributes:
    """Outputs of a point, by name, with their attributes in a store."""
    names = (VERDICT, LARGEST) if obstacle.find else tuple(name for name in OUTPUTS if name != LARGEST)
    attributes: Attributes = {name: {"units": OUTPUTS[name][0], "long_name": OUTPUTS[name][1]} for name in names}
    verdicts = {"flag_values": [*range(len(NAMES))], "flag_meanings": " ".join(NAMES)}
    return attributes | {VERDICT: {"long_name": OUTPUTS[VERDICT][1], **verdicts}}


def climb_conditions(obstacle: Obstacle, varied: Columns, robot: Robot, where: str) -> dict[str, float]:
    """Checks a sweep of climbs. Returns conditions to add: a low voltage, if none is stated.

    Args:
        varied: varied and stated quantities, with their values.

    Raises:
        BadConfiguration: the robot cannot climb. Or there is no size, or a size is combined with a search. Or angles
            are combined with a sequence, are beyond the levers' range, or begin below the ground.
    """
    if (reason := climb_refusal(robot)) is not None:
        raise BadConfiguration(f"{where}, obstacle: {reason}")
    if obstacle.find == (SIZE in varied):
        expectation = "find searches for it" if obstacle.find else f"expected an axis {SIZE}, or find = true"
        raise BadConfiguration(f"{where}, {SIZE}: got {'it' if obstacle.find else 'none'}; {expectation}")
    sizes = varied.get(SIZE, ())
    if obstacle.kind == "stairs" and 2 * obstacle.nose_mm >= (shortest := min([obstacle.tread_mm, *sizes])):
        raise BadConfiguration(
            f"{where}, obstacle.nose_mm: got {obstacle.nose_mm:g}; expected less than half of rise and tread, "
            f"{shortest / 2:g} mm"
        )
    sequence = None if obstacle.sequence is None else terrains.read_sequence(obstacle.sequence, robot, (0.0, 0.0))
    for name in ("levers_front_deg", "levers_rear_deg"):
        if name in varied and sequence is not None and sequence.begins is None:
            raise BadConfiguration(
                f"{where}, {name}: {obstacle.sequence} already gives all angles; keep one of the two"
            )
        for angle in varied.get(name, ()):
            if reason := terrains.lever_angle_refusal(robot, angle) or terrains.lever_start_refusal(robot, angle):
                raise BadConfiguration(f"{where}, {name}: {reason}")
    return {} if "voltage" in varied or np.all(varied.get("battery", 0.0) > 0.5) else {"voltage": DEFAULT_VOLTAGE}


def climb_refusal(robot: Robot) -> str | None:
    """Reason why a robot cannot climb. None if it can."""
    if not robot.has_ground:
        return "the robot's load is a shaft; a climb needs a vehicle"
    if robot.rig.imposed != "voltage":
        return "the robot's file imposes no voltage"
    try:
        masses.check_parts(robot)
    except ValueError as error:
        return str(error)
    return None


def compute_climbs(
    obstacle: Obstacle,
    variation: Variation,
    conditions: Conditions,
    values: np.ndarray | jax.Array,
    sizes: np.ndarray | None,
    report_share: Callable[[float], None],
) -> Columns:
    """Outputs and status of points, by name.

    Args:
        conditions: conditions that do not vary, of shape (points,).
        values: varied values, one row for each point.
        sizes: sizes of the obstacles [mm]. None: searches for all points run in parallel.
        report_share: callback for the share of the work that is done.
    """
    robot, point_conditions = variation.at(jnp.asarray(values), conditions)
    points = len(values)
    if variation.varies_robot:
        base = variation.robot
        robot = jax.tree.map(
            lambda varied, original: (
                varied
                if jnp.ndim(varied) > jnp.ndim(original)
                else jnp.broadcast_to(varied, (points, *jnp.shape(varied)))
            ),
            robot,
            base,
        )
    sequence = _lever_sequences(obstacle, robot, point_conditions, points)

    def run(sizes: np.ndarray, report_share: Callable[[float], None]) -> ClimbRuns:
        # Terrains of sizes [mm]
        nose, tread = obstacle.nose_mm / 1000, obstacle.tread_mm / 1000
        terrain_of_size = {
            "step": lambda s: terrain.single_step(s, nose),
            "stairs": lambda s: terrain.stairs(s, tread, obstacle.count, nose),
            "gap": terrain.gap,
        }
        return climb_batch(
            robot, point_conditions, jax.vmap(terrain_of_size[obstacle.kind])(jnp.asarray(sizes) / 1000), sequence,
            duration=obstacle.duration_s, step=obstacle.time_step_s, sample=SAMPLE_INTERVAL, record=not obstacle.find,
            progress=report_share,
        )  # fmt: skip

    results = (
        _until_verdict(run(sizes, report_share))
        if sizes is not None
        else _search_all(obstacle, points, run, report_share)
    )
    verdict = results[VERDICT]
    status = np.where(verdict == FAILED, FAILED_POINT, np.where(verdict == UNFINISHED, NOT_SETTLED, CONVERGED))
    report_share(1.0)
    return {**results, VERDICT: verdict.astype(np.uint8), STATUS: status.astype(np.uint8)}


def _lever_sequences(obstacle: Obstacle, robot: Robot, conditions: Conditions, points: int) -> LeverSequence:
    batch_axis = 0 if jnp.ndim(robot.sides) else None
    angles = jax.vmap(lambda r, c: masses.lever_angles(r.running_gear, c), in_axes=(batch_axis, 0))(robot, conditions)
    front, rear = (jnp.broadcast_to(x, (points,)) for x in angles)
    sequences = jax.vmap(constant_angles)(front, rear)
    if obstacle.sequence is not None:
        sequence = terrains.read_sequence(obstacle.sequence, robot, (0.0, 0.0))
        sequences = jax.tree.map(lambda x: jnp.broadcast_to(x, (points, *jnp.shape(x))), sequence)
        if sequences.begins is not None:
            sequences = dataclasses.replace(sequences, begins=jnp.stack([front, rear], axis=1))
    if obstacle.levers_voltage_V is None:
        return sequences
    return dataclasses.replace(sequences, supply=jnp.full(points, obstacle.levers_voltage_V))


def _until_verdict(runs: ClimbRuns) -> Columns:
    """Outputs of runs, evaluated until their verdicts."""
    record, before_verdict = runs.record, runs.before_verdict

    def maximum(values: Any) -> np.ndarray:
        return np.max(np.where(before_verdict, np.nan_to_num(np.asarray(values)), -np.inf), axis=1)

    last_sample = np.maximum(before_verdict.sum(axis=1) - 1, 0)[:, None]
    energy = np.asarray(record.energy["supply"] + record.energy["levers"])
    return {
        VERDICT: runs.verdict,
        "time_s": np.take_along_axis(np.asarray(record.time), last_sample, 1)[:, 0],
        "furthest_mm": 1000 * np.asarray(runs.furthest),
        "pitch_most_deg": np.degrees(maximum(-np.asarray(record.motion.q)[..., PITCH])),
        "energy_J": np.take_along_axis(energy, last_sample, 1)[:, 0],
        "traction_current_most_A": maximum(np.abs(record.current)),
        "front_current_most_A": maximum(np.abs(record.lever_current[..., 0])),
        "rear_current_most_A": maximum(np.abs(record.lever_current[..., 1])),
    }


def _search_all(
    obstacle: Obstacle, points: int, run: Callable[..., ClimbRuns], report_share: Callable[[float], None]
) -> Columns:
    """Largest sizes that are climbed, by bisection of all points in parallel, and the result for the next larger
    size.
    """
    low, high = SEARCH_INTERVALS[obstacle.kind]
    rounds = 1 + int(np.ceil(np.log2((high - low) / SEARCH_TOLERANCE)))
    largest_climbed = np.zeros(points)
    smallest_missed = np.full(points, high)
    sizes = np.full(points, low)
    verdict = np.full(points, OVER)
    for k in range(rounds):
        verdicts = run(sizes, lambda share, k=k: report_share((k + share) / rounds)).verdict
        is_climbed = verdicts == OVER
        largest_climbed = np.where(is_climbed, sizes, largest_climbed)
        smallest_missed = np.where(is_climbed, smallest_missed, sizes)
        verdict = np.where(is_climbed, verdict, verdicts)
        sizes = (np.maximum(largest_climbed, low) + smallest_missed) / 2
    return {VERDICT: verdict, LARGEST: largest_climbed}
