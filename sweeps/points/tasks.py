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
        usual: names of the default outputs.
        slow: True if a call takes long and reports progress.
        at_once: points per call, on processors and accelerators.
        axes: names that may vary and are neither a condition nor a parameter of the robot.
        further: function that returns conditions in addition to the varied and stated ones, and rejects impossible
            points.
        run: function that computes points, see `climbs.compute_climbs`. None: the program of the fidelity.
    """

    model: str
    options: Mapping[str, float]
    attributes: Attributes
    usual: Names
    slow: bool
    at_once: tuple[int, int]
    axes: Mapping[str, Axis] = dataclasses.field(default_factory=dict)
    further: Callable[[Columns, Robot, str], dict[str, float]] = lambda stated, robot, where: {}
    run: Callable[..., Json] | None = None


def task_of_configuration(config: Campaign, robot: Robot, turns: bool = False) -> Task:
    """Task of a configuration. `turns`: True if its profile drives the sides independently."""
    if config.obstacle is None:
        return run_task(config.model, config.options, robot, config.profile is not None, turns)
    obstacle, attributes = config.obstacle, climb_attributes(config.obstacle)
    further, run = functools.partial(further_variation, obstacle), functools.partial(compute_climbs, obstacle)
    return Task("climb", {}, attributes, tuple(attributes), True, AT_ONCE, {SIZE: SIZES[obstacle.kind]}, further, run)


def run_task(
    model: str, options: Mapping[str, float], robot: Robot, profiled: bool = False, turns: bool = False
) -> Task:
    """Task of a run. `profiled`: over a profile, with its totals as outputs. `turns`: with both sides."""
    facts, own_columns = fidelities.fidelity_facts(model), fidelities.get_fidelity(model).columns
    usual = channels.channel_names(robot.channels)
    rows: dict[str, tuple[str, str]] = {r.name: (r.unit_shown, r.label) for r in outputs.output_table(robot.channels)}
    rows |= {name: ("", name.replace("_", " ")) for name in own_columns}
    if profiled:
        from mmrjax.missions import mission_batch  # imports an integrator

        output_names = (*mission_batch.OUTPUTS, *(mission_batch.OF_TURNS if turns else ()))
        rows, usual = {r.column: (r.unit, r.label) for r in output_names}, mission_batch.USUAL
    attributes: Attributes = {n: {"units": unit, "long_name": label} for n, (unit, label) in rows.items()}
    masks = [1 << k for k in range(len(LIMITS))]
    attributes[FLAGS] = {"long_name": "limits exceeded", "flag_masks": masks, "flag_meanings": " ".join(LIMITS)}
    at_once = facts.at_once(False), facts.at_once(True)
    return Task(model, options, attributes, usual, facts.slow and not profiled, at_once)


#: Initial interval of a search, and its final width [mm].
SOUGHT = {"step": (10.0, 450.0), "stairs": (20.0, 400.0), "gap": (20.0, 800.0)}
NEAR = 1.0
#: Default voltage [V]: so low that a robot climbs instead of leaping.
SLOW = 12.0
#: Points per call on a processor and on an accelerator. Interval of their record [s].
AT_ONCE, SAMPLE = (64, 2048), 0.05
#: Outputs with units and descriptions. A search has only the first two, with size 0 if no obstacle is climbed.
#: Currents are maxima. Positions are of the middle of the robot, from the start of the obstacle.
VERDICT, LARGEST = "verdict", "largest_mm"
OUTPUTS: dict[str, tuple[str, str]] = {
    VERDICT: (
        "",
        "result. For a search, of the smallest obstacle not climbed",
    ),
    LARGEST: ("mm", "largest got over"),
    "time_s": ("s", "time to the verdict"),
    "furthest_mm": ("mm", "furthest place"),
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


def further_variation(obstacle: Obstacle, varied: Columns, robot: Robot, where: str) -> dict[str, float]:
    """Further conditions: a low voltage, if a sweep of climbs states none.

    Args:
        varied: varied and stated quantities, with their values.

    Raises:
        BadConfiguration: the robot cannot climb. There is no size, or a size and a search. Angles are stated in
            addition to a sequence, are beyond the levers' range, or begin below the ground.
    """
    if (why := climb_refusal(robot)) is not None:
        raise BadConfiguration(f"{where}, obstacle: {why}")
    if obstacle.find == (SIZE in varied):
        wants = "find searches for it" if obstacle.find else f"expected an axis {SIZE}, or find = true"
        raise BadConfiguration(f"{where}, {SIZE}: got {'it' if obstacle.find else 'none'}; {wants}")
    sizes = varied.get(SIZE, ())
    if obstacle.kind == "stairs" and 2 * obstacle.nose_mm >= (shortest := min([obstacle.tread_mm, *sizes])):
        raise BadConfiguration(
            f"{where}, obstacle.nose_mm: got {obstacle.nose_mm:g}; expected less than half of rise and tread, "
            f"{shortest / 2:g} mm"
        )
    one = None if obstacle.sequence is None else terrains.read_sequence(obstacle.sequence, robot, (0.0, 0.0))
    for name in ("levers_front_deg", "levers_rear_deg"):
        if name in varied and one is not None and one.begins is None:
            raise BadConfiguration(
                f"{where}, {name}: {obstacle.sequence} already gives all angles; keep one of the two"
            )
        for angle in varied.get(name, ()):
            if why := terrains.lever_angle_refusal(robot, angle) or terrains.lever_start_refusal(robot, angle):
                raise BadConfiguration(f"{where}, {name}: {why}")
    return {} if "voltage" in varied or np.all(varied.get("battery", 0.0) > 0.5) else {"voltage": SLOW}


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
    told: Callable[[float], None],
) -> Columns:
    """Outputs and status of points, by name.

    Args:
        conditions: conditions that do not vary, of shape (points,).
        values: varied values, one row for each point.
        sizes: sizes of the obstacles [mm]. None: searches for all points run in parallel.
        told: callback for the share of the work that is done.
    """
    robot, conditions_there = variation.at(jnp.asarray(values), conditions)
    points = len(values)
    if variation.varies_robot:
        base = variation.robot
        robot = jax.tree.map(
            lambda new, old: (
                new if jnp.ndim(new) > jnp.ndim(old) else jnp.broadcast_to(new, (points, *jnp.shape(new)))
            ),
            robot,
            base,
        )
    sequence = _lever_sequences(obstacle, robot, conditions_there, points)

    def run(sizes: np.ndarray, told: Callable[[float], None]) -> ClimbRuns:
        # Terrains of sizes [mm]
        nose, tread = obstacle.nose_mm / 1000, obstacle.tread_mm / 1000
        make = {
            "step": lambda s: terrain.single_step(s, nose),
            "stairs": lambda s: terrain.stairs(s, tread, obstacle.count, nose),
            "gap": terrain.gap,
        }
        return climb_batch(
            robot, conditions_there, jax.vmap(make[obstacle.kind])(jnp.asarray(sizes) / 1000), sequence,
            duration=obstacle.duration_s, step=obstacle.time_step_s, sample=SAMPLE, record=not obstacle.find,
            progress=told,
        )  # fmt: skip

    results = _until_verdict(run(sizes, told)) if sizes is not None else _search_all(obstacle, points, run, told)
    verdict = results[VERDICT]
    status = np.where(verdict == FAILED, FAILED_POINT, np.where(verdict == UNFINISHED, NOT_SETTLED, CONVERGED))
    told(1.0)
    return {**results, VERDICT: verdict.astype(np.uint8), STATUS: status.astype(np.uint8)}


def _lever_sequences(obstacle: Obstacle, robot: Robot, conditions: Conditions, points: int) -> LeverSequence:
    batch_axis = 0 if jnp.ndim(robot.sides) else None
    angles = jax.vmap(lambda r, c: masses.lever_angles(r.running_gear, c), in_axes=(batch_axis, 0))(robot, conditions)
    front, rear = (jnp.broadcast_to(x, (points,)) for x in angles)
    sequences = jax.vmap(constant_angles)(front, rear)
    if obstacle.sequence is not None:
        one = terrains.read_sequence(obstacle.sequence, robot, (0.0, 0.0))
        sequences = jax.tree.map(lambda x: jnp.broadcast_to(x, (points, *jnp.shape(x))), one)
        if sequences.begins is not None:
            sequences = dataclasses.replace(sequences, begins=jnp.stack([front, rear], axis=1))
    if obstacle.levers_voltage_V is None:
        return sequences
    return dataclasses.replace(sequences, supply=jnp.full(points, obstacle.levers_voltage_V))


def _until_verdict(found: ClimbRuns) -> Columns:
    """Outputs of runs, evaluated until their verdicts."""
    r, during = found.record, found.before_verdict

    def most(values: Any) -> np.ndarray:
        return np.max(np.where(during, np.nan_to_num(np.asarray(values)), -np.inf), axis=1)

    last_sample = np.maximum(during.sum(axis=1) - 1, 0)[:, None]
    energy = np.asarray(r.energy["supply"] + r.energy["levers"])
    return {
        VERDICT: found.verdict,
        "time_s": np.take_along_axis(np.asarray(r.time), last_sample, 1)[:, 0],
        "furthest_mm": 1000 * np.asarray(found.furthest),
        "pitch_most_deg": np.degrees(most(-np.asarray(r.motion.q)[..., PITCH])),
        "energy_J": np.take_along_axis(energy, last_sample, 1)[:, 0],
        "traction_current_most_A": most(np.abs(r.current)),
        "front_current_most_A": most(np.abs(r.lever_current[..., 0])),
        "rear_current_most_A": most(np.abs(r.lever_current[..., 1])),
    }


def _search_all(
    obstacle: Obstacle, points: int, run: Callable[..., ClimbRuns], told: Callable[[float], None]
) -> Columns:
    """Largest sizes that are climbed, by bisection of all points in parallel, and the result for the next larger
    size.
    """
    low, high = SOUGHT[obstacle.kind]
    rounds = 1 + int(np.ceil(np.log2((high - low) / NEAR)))
    climbed, beyond, sizes = np.zeros(points), np.full(points, high), np.full(points, low)
    verdict = np.full(points, OVER)
    for k in range(rounds):
        verdicts = run(sizes, lambda share, k=k: told((k + share) / rounds)).verdict
        is_over = verdicts == OVER
        climbed, beyond = np.where(is_over, sizes, climbed), np.where(is_over, beyond, sizes)
        verdict = np.where(is_over, verdict, verdicts)
        sizes = (np.maximum(climbed, low) + beyond) / 2
    return {VERDICT: verdict, LARGEST: climbed}
