"""Climbs as points of a sweep: each is a run over an obstacle, or a search for the largest one that is climbed."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from calibration.data import Columns, Json, terrains
from calibration.data.input_errors import BadConfiguration
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
from mmrjax.fidelities.variation import STATUS, Axis, Variation
from mmrjax.model import masses
from mmrjax.model.conditions import Conditions
from mmrjax.model.robot import Robot
from mmrjax.model.signals import CONVERGED, NOT_SETTLED
from mmrjax.model.signals import FAILED as FAILED_POINT
from sweeps.config_campaign import SIZE, Obstacle

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
        "result of the climb. For a search, that of the smallest obstacle not climbed",
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


def climb_attributes(obstacle: Obstacle) -> dict[str, Json]:
    """Outputs of a point, by name, with their attributes in a store."""
    names = (VERDICT, LARGEST) if obstacle.find else tuple(name for name in OUTPUTS if name != LARGEST)
    attributes: dict[str, Json] = {name: {"units": OUTPUTS[name][0], "long_name": OUTPUTS[name][1]} for name in names}
    del attributes[VERDICT]["units"]
    attributes[VERDICT] |= {"flag_values": [*range(len(NAMES))], "flag_meanings": " ".join(NAMES)}
    return attributes


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
    climbed, beyond, verdict, sizes = (
        np.zeros(points),
        np.full(points, high),
        np.full(points, OVER),
        np.full(points, low),
    )
    for k in range(rounds):
        verdicts = run(sizes, lambda share, k=k: told((k + share) / rounds)).verdict
        is_over = verdicts == OVER
        climbed, beyond = np.where(is_over, sizes, climbed), np.where(is_over, beyond, sizes)
        verdict = np.where(is_over, verdict, verdicts)
        sizes = (np.maximum(climbed, low) + beyond) / 2
    return {VERDICT: verdict, LARGEST: climbed}
