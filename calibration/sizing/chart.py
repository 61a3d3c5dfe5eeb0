"""Chart of a robot's use: the nearest limit and its margin, over payload and slope."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from calibration.data.requirements_file import Requirement, Requirements
from calibration.sizing import sheet
from mmrjax.compile.compiling import compiled
from mmrjax.derived.requirements import EnvelopePoint, Ratings, ratings, thermal_margin, travel_quantities
from mmrjax.model import params
from mmrjax.model.robot import Robot

#: Limits of a use, in the order of the chart.
LIMITS = (
    "adhesion",
    "stall",
    "winding",
    "motor speed",
    "gearbox input speed",
    "gearbox torque",
    "cell cut-off",
    "speed",
)
#: Number of points along payload and slope, and ratio of the chart's extent to that of the envelope.
POINTS, BEYOND = 33, 1.6


@dataclasses.dataclass(frozen=True)
class MarginChart:
    """Nearest limit at each payload and slope, shape (slopes, payloads).

    Attributes:
        payload, slope: values of the axes [kg], [deg].
        nearest: index of the nearest limit in `LIMITS`.
        margin: margin to that limit, negative beyond it.
    """

    payload: np.ndarray
    slope: np.ndarray
    nearest: np.ndarray
    margin: np.ndarray


@compiled
def _margins(robot: Robot, rated: Ratings, points: EnvelopePoint, speeds: Array, wanted: Array) -> Array:
    """Margin to each limit, shape (points, limits)."""

    def margins_at_point(point: EnvelopePoint, wanted: Array) -> Array:
        state, _ = travel_quantities(robot, point, rated)
        turns = state["motor_speed_rpm"]
        margins = [
            state["adhesion"], jnp.clip(state["left"], -1.0, 1.0),
            thermal_margin(robot, point, state["current"], rated.temperature),
            1 - turns / speeds[0], 1 - turns / speeds[1], 1 - state["gearbox_Nm"] / rated.torque,
            jnp.minimum(state["cell"] / rated.voltage_cutoff, 1.0),
            jnp.where(wanted > 0, state["speed_m_s"] / jnp.where(wanted > 0, wanted, 1.0) - 1, 1.0),
        ]  # fmt: skip
        # At the limit of adhesion both margins are zero; it is assigned to adhesion.
        margins[1] = jnp.where(margins[0] <= margins[1], 1.0, margins[1])
        return jnp.stack([jnp.asarray(x, float) for x in margins])

    return jax.vmap(margins_at_point)(points, wanted)


def margin_chart(robot: Robot, asked: Requirements, most: tuple[float, float]) -> MarginChart:
    """Chart for a robot at the worse end of charge, in the warmest ambient temperature of the envelope.

    A required speed applies only within its own payloads and slopes.

    Args:
        most: largest payload [kg] and slope [deg] of the chart.
    """
    payload, slope = np.linspace(0, most[0], POINTS), np.linspace(0, most[1], POINTS)
    e = asked.envelope
    base = sheet.envelope_points(robot, Requirement("speed_m_s", 0.0, True, e))
    robot_and_point = jax.tree.map(lambda x: np.asarray(x)[-1], base)
    s, p = (x.ravel() for x in np.meshgrid(slope, payload, indexing="ij"))
    speeds = [r for r in asked.each if r.quantity.group == "travel" and r.name.startswith("speed") and r.least]
    power_needed = np.zeros(len(p))
    for r in speeds:
        v = r.envelope
        is_required = (p >= v.payload_kg[0]) & (p <= v.payload_kg[1]) & (s >= v.slope_deg[0]) & (s <= v.slope_deg[1])
        power_needed = np.where(is_required, np.maximum(power_needed, r.limit or 0.0), power_needed)
    robot = params.without_weak_types(robot)
    permitted = jnp.asarray([robot.motor.speed_limit, robot.gearbox.speed_limit])
    margins = None
    for charge in e.charge:
        points = jax.tree.map(lambda x: jnp.full(len(p), x), robot_and_point)
        points = dataclasses.replace(
            points, payload=jnp.asarray(p), slope_deg=jnp.asarray(s), charge=jnp.full(len(p), charge)
        )
        margin_grid = np.asarray(_margins(robot, ratings(robot), points, permitted, jnp.asarray(power_needed)))
        margins = margin_grid if margins is None else np.minimum(margins, margin_grid)
    assert margins is not None
    margins = np.where(np.isfinite(margins), margins, -1.0)
    shape = (POINTS, POINTS)
    return MarginChart(payload, slope, np.argmin(margins, 1).reshape(shape), margins.min(1).reshape(shape))


def chart_extent(asked: Requirements) -> tuple[float, float]:
    """Largest payload [kg] and slope [deg] of a chart of these requirements."""
    payloads = [asked.envelope.payload_kg[1], *(r.limit or 0.0 for r in asked.each if r.name == "payload_kg")]
    slopes = [asked.envelope.slope_deg[1], *(r.limit or 0.0 for r in asked.each if r.name == "slope_deg")]
    return BEYOND * max(*payloads, 2.0), min(BEYOND * max(*slopes, 10.0), 40.0)
