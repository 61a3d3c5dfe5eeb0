"""Quantities of requirements, as functions of the robot and of a point of the envelope of use."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from mmrjax.climbing import static_limits
from mmrjax.derived import steepest_slope
from mmrjax.fidelities.steady import operating_state
from mmrjax.model import balances, energy
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Index, Scalar
from mmrjax.model.quantities import CONDITIONS, TABLE, Quantity
from mmrjax.model.robot import Robot
from mmrjax.model.signals import CONVERGED, CUT_OFF, Signals
from mmrjax.numerics.elementary import value_and_slope
from mmrjax.turning.circling import circling_signals

#: Quantities that depend on the temperature of the windings.
OF_HEAT = ("winding_C", "payload_kg")
#: All quantities that a requirement can name, by column.
QUANTITIES: dict[str, Quantity] = {q.column: q for q in TABLE["requirement"]}


class Ratings(eqx.Module):
    """Limits and counts that are constants of a robot, in a form that can be batched.

    Attributes:
        cells: number of cells in series [-].
        voltage_cutoff: cut-off voltage of a cell [V].
        temperature: permissible winding temperature [°C].
        torque: permissible continuous torque of a gearbox [N·m], inf if not stated.
    """

    cells: Scalar
    voltage_cutoff: Scalar
    temperature: Scalar
    torque: Scalar


def ratings(robot: Robot) -> Ratings:
    """Ratings of a robot."""
    return Ratings(
        jnp.asarray(robot.battery.cells, float),
        jnp.asarray(robot.battery.voltage_cutoff, float),
        jnp.asarray(robot.motor.temperature_limit, float),
        jnp.asarray(robot.gearbox.torque_limit or math.inf, float),
    )


class EnvelopePoint(eqx.Module):
    """A point of the envelope of use. Every field can be differentiated and batched.

    Attributes:
        configuration: index of the configuration.
        battery: 1 on the battery, 0 on an external supply.
        adhesion, adhesion_lateral: adhesion along and across, relative to the robot's own [-].
        charge: state of charge [-], or voltage of an external supply [V].
        charge_end: state of charge at the end of use [-].
        share: for endurance, share of time in motion [-]. 0: standing still.
        slope_deg: slope [deg].
        payload: payload [kg].
        ambient: ambient temperature [°C].
        tread: tread of stairs [m].
    """

    configuration: Index
    adhesion: Scalar
    adhesion_lateral: Scalar
    battery: Scalar
    charge: Scalar
    charge_end: Scalar
    share: Scalar
    slope_deg: Scalar
    payload: Scalar
    ambient: Scalar
    tread: Scalar


#: Value of a quantity at one point [SI], finite for every outcome, and the outcome: an index into `STATUSES`. The
#: value is meaningful only for `converged`.
Valued = tuple[Array, Array]


def with_cells(robot: Robot, cells: Scalar) -> Robot:
    """Robot with this number of cells in series, which may be traced. Battery voltages scale with the number."""
    battery = robot.battery
    pack_ratio = cells / battery.cells
    battery = replace(
        battery, curvature=battery.curvature * pack_ratio, slope=battery.slope * pack_ratio,
        voltage_full=battery.voltage_full * pack_ratio, resistance=battery.resistance * pack_ratio,
    )  # fmt: skip
    return replace(robot, battery=battery)


def _robot_and_conditions_at(robot: Robot, point: EnvelopePoint, rated: Ratings) -> tuple[Robot, Conditions]:
    """The robot with its winding at ambient temperature, as at the start of a run, and the conditions of a point."""
    resistance = robot.motor.resistance * robot.motor.resistance_ratio(point.ambient)
    motor = replace(robot.motor, resistance=resistance)
    robot = with_cells(replace(robot, motor=motor), rated.cells)
    # slightly less charge is taken at a state of charge of 0, because a battery counts as empty there
    discharge = robot.battery.capacity * (1 - jnp.maximum(point.charge, 1e-9))
    return robot, Conditions(
        configuration=jnp.asarray(point.configuration),
        voltage=jnp.where(point.battery > 0.5, 1.0, point.charge),
        slope_deg=point.slope_deg, payload=point.payload, battery=point.battery,
        discharge=jnp.where(point.battery > 0.5, discharge, 0.0), adhesion=point.adhesion,
    )  # fmt: skip


def thermal_margin(robot: Robot, point: EnvelopePoint, current: Scalar, limit: Scalar) -> Scalar:
    """Relative thermal margin of a winding for continuous `current` [-]: 0 if it settles at `limit` [°C].

    1 - I² R_th R (1 + α (T - 25 °C)) / (T - T_a). `robot` as stated, not as returned by `_robot_and_conditions_at`.
    """
    motor = robot.motor
    hot_resistance = motor.resistance * motor.resistance_ratio(limit)
    return 1 - current**2 * motor.resistance_thermal * hot_resistance / jnp.maximum(limit - point.ambient, 1.0)


def _cell_voltage_margin(rated: Ratings, signals: Signals, point: EnvelopePoint) -> Scalar:
    """Margin of a cell above its cut-off voltage [V], inf with an external supply."""
    return jnp.where(point.battery > 0.5, signals.voltage_source / rated.cells - rated.voltage_cutoff, jnp.inf)


def travel_quantities(robot: Robot, point: EnvelopePoint, rated: Ratings) -> tuple[dict[str, Array], Array]:
    """Every quantity of group `travel_quantities` in steady travel by name [SI], and the outcome.

    Further entries are the `current` of one motor and of the `battery` [A] and three margins: `left` of traction and
    speed, `adhesion` alone [-], and `cell`, above the cut-off voltage [V].
    """
    robot_at_point, conditions = _robot_and_conditions_at(robot, point, rated)
    signals, status, _ = operating_state(robot_at_point, conditions)
    outcome = jnp.where((status == CONVERGED) & (_cell_voltage_margin(rated, signals, point) < 0), CUT_OFF, status)
    motor_at_ambient = replace(robot.motor, temperature_ambient=point.ambient)  # its resistance as stated
    speed_nonzero = jnp.where(jnp.abs(signals.speed) > 1e-6, signals.speed, 1e-6)
    motor_speed = jnp.abs(signals.speed_motor)
    quantities = {
        "speed_m_s": signals.speed,
        "speed_end_of_charge_m_s": signals.speed,
        "winding_C": motor_at_ambient.temperature_settled(signals.current),
        "gearbox_Nm": jnp.abs(signals.torque_gear),
        "gearbox_speed_rpm": motor_speed,
        "motor_speed_rpm": motor_speed,
        "current_A": signals.total_current,
        "energy_per_metre_Wh": energy.source_power(robot_at_point, conditions, signals) / speed_nonzero,
        "current": signals.current,
        "battery": robot_at_point.battery.current(signals.total_current),
        "adhesion": 1 - signals.demand / signals.adhesion_limit,
        "left": steepest_slope.travel_margin(robot_at_point, signals),
        "cell": _cell_voltage_margin(rated, signals, point),
    }
    return {name: jnp.asarray(x) for name, x in quantities.items()}, outcome


def _travel_quantity(robot: Robot, point: EnvelopePoint, rated: Ratings, name: str) -> Valued:
    values, outcome = travel_quantities(robot, point, rated)
    return values[name], outcome


def _steepest_slope(robot: Robot, point: EnvelopePoint, rated: Ratings, name: str) -> Valued:
    robot_at_point, conditions = _robot_and_conditions_at(robot, point, rated)
    limit = steepest_slope.compute(robot_at_point, conditions)
    is_finite = jnp.isfinite(limit["steepest_slope"])
    return jnp.where(is_finite, limit["steepest_slope"], 0.0), limit["status"]


#: Halvings of a bracket; a Newton step removes the remaining error.
HALVINGS = 26


def _largest_payload(robot: Robot, point: EnvelopePoint, rated: Ratings, name: str) -> Valued:
    """Largest payload for continuous travel.

    The robot travels, its winding settles below its largest temperature, the gearboxes stay within their torque limit
    (if stated), and the cells above their cut-off voltage.
    """
    heaviest = CONDITIONS["payload"].range[1]

    def smallest_margin(robot: Robot, payload: Scalar) -> Scalar:
        loaded_point = replace(point, payload=payload)
        robot_at_point, conditions = _robot_and_conditions_at(robot, loaded_point, rated)
        signals, _, _ = operating_state(robot_at_point, conditions)
        thermal = thermal_margin(robot, loaded_point, signals.current, rated.temperature)
        torque_margin = 1 - jnp.abs(signals.torque_gear) / rated.torque
        margins = [
            steepest_slope.travel_margin(robot_at_point, signals),
            thermal,
            torque_margin,
            _cell_voltage_margin(rated, signals, point),
        ]
        return functools.reduce(jnp.minimum, margins)

    payload, travels_empty = _find_sign_change(smallest_margin, robot, jnp.zeros(()), jnp.asarray(heaviest))
    unladen_robot, conditions = _robot_and_conditions_at(robot, replace(point, payload=jnp.zeros(())), rated)
    signals, status, _ = operating_state(unladen_robot, conditions)
    outcome = jnp.where((status == CONVERGED) & (_cell_voltage_margin(rated, signals, point) < 0), CUT_OFF, status)
    return jnp.where(travels_empty, payload, 0.0), outcome


def _find_sign_change(margin, robot: Robot, low: Array, high: Array) -> tuple[Array, Array]:  # type: ignore[no-untyped-def]
    """Point between low and high at which `margin` becomes negative, and True if `margin` is positive at low.

    `high` if it does not become negative. Derivatives are implicit, forward and reverse.
    """
    constant_robot = jax.lax.stop_gradient(robot)

    def halve(bracket: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        a, b = bracket
        middle = (a + b) / 2
        is_positive = margin(constant_robot, middle) > 0
        return (jnp.where(is_positive, middle, a), jnp.where(is_positive, b, middle)), None

    constant_low, constant_high = jax.lax.stop_gradient((low, high))
    (a, b), _ = jax.lax.scan(halve, (constant_low, constant_high), None, length=HALVINGS)
    middle_left = (a + b) / 2
    slope = value_and_slope(lambda x: margin(constant_robot, x), middle_left)[1]
    usable = jnp.isfinite(slope) & (jnp.abs(slope) > 1e-12)
    step = margin(robot, middle_left) / jnp.where(usable, jax.lax.stop_gradient(slope), 1.0)
    crossing = middle_left - jnp.where(usable & jnp.isfinite(step), step, 0.0)
    # A margin that jumps has no root for a Newton step.
    crossing = jnp.where(
        jnp.abs(crossing - middle_left) < 1e-3 * (constant_high - constant_low) + 1e-9, crossing, middle_left
    )
    return jnp.where(margin(constant_robot, constant_high) > 0, high, crossing), margin(
        constant_robot, constant_low
    ) > 0


#: Nodes of the integral over the charge.
NODES = 8


def _endurance(robot: Robot, point: EnvelopePoint, rated: Ratings, name: str) -> Valued:
    """Endurance on the battery [s]: t = ∫ dC / (s I_Σ(C) + I_p) over the usable charge, Gauss-Legendre.

    The robot drives at full voltage for a share s of the time and stands otherwise. It ends when a cell reaches its
    cut-off.
    """
    discharge_begin, discharge_end = (
        jnp.asarray(robot.battery.capacity * (1 - x)) for x in (point.charge, point.charge_end)
    )

    def load_at(robot: Robot, discharge: Scalar) -> tuple[Scalar, Scalar, Array]:
        """Mean battery current [A], margin above the cut-off [V], status."""
        robot_at_point, conditions = _robot_and_conditions_at(robot, point, rated)
        conditions = replace(conditions, discharge=jnp.asarray(discharge))
        signals, status, _ = operating_state(robot_at_point, conditions)
        is_standing = point.share <= 0
        motor_current = jnp.where(is_standing, 0.0, signals.total_current)
        cell_margin = robot_at_point.battery.voltage(motor_current, discharge) / rated.cells - rated.voltage_cutoff
        current = robot_at_point.battery.current(point.share * motor_current)
        return current, cell_margin, jnp.where(is_standing, CONVERGED, status)

    discharge_last, can_begin = _find_sign_change(
        lambda robot, c: load_at(robot, c)[1], robot, discharge_begin, discharge_end
    )
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    discharges = discharge_begin + (discharge_last - discharge_begin) * jnp.asarray((nodes + 1) / 2)
    current, _, status = jax.vmap(lambda c: load_at(robot, c))(discharges)
    current_nonzero = jnp.maximum(current, 1e-9)
    time = (discharge_last - discharge_begin) * jnp.sum(jnp.asarray(weights / 2) / current_nonzero)
    first_failure = status[jnp.argmax(status != CONVERGED)]
    outcome = jnp.where(can_begin, first_failure, CUT_OFF)
    return time, outcome


def _mass_quantity(robot: Robot, point: EnvelopePoint, rated: Ratings, name: str) -> Valued:
    mass = jnp.asarray(robot.chassis(point.configuration).mass)
    return mass, jnp.full(mass.shape, CONVERGED)


#: Duty of the left side, while the right side's is 1.
DUTY_LEFT = {"turn_in_place_rad_s": -1.0, "turning_radius_mm": 0.0}


def _settled_turn(robot: Robot, point: EnvelopePoint, rated: Ratings, name: str) -> Valued:
    """A settled turn on level ground at full voltage: on the spot with opposite sides, or around a braked side."""
    robot_at_point, conditions = _robot_and_conditions_at(robot, point, rated)
    conditions = replace(
        conditions, slope_deg=jnp.zeros(()), adhesion_lateral=jnp.asarray(point.adhesion_lateral),
        duty_left=jnp.asarray(DUTY_LEFT[name]), duty_right=jnp.asarray(1.0),
    )  # fmt: skip
    travel, motion, status = circling_signals(robot_at_point, conditions)
    cell_low = jnp.any(jnp.asarray(_cell_voltage_margin(rated, travel.signals, point)) < 0)
    yaw_rate_nonzero = jnp.where(jnp.abs(motion.yaw_rate) > 1e-6, motion.yaw_rate, 1e-6)
    speed_squared = motion.speed**2 + motion.speed_lateral**2
    # A root of 0 has no derivative.
    value = (
        motion.yaw_rate
        if name == "turn_in_place_rad_s"
        else jnp.sqrt(jnp.maximum(speed_squared, 1e-24)) / jnp.abs(yaw_rate_nonzero)
    )
    return jnp.asarray(value), jnp.where((status == CONVERGED) & cell_low, CUT_OFF, status)


def _side_slope(robot: Robot, point: EnvelopePoint, rated: Ratings, name: str) -> Valued:
    """Steepest side slope [deg] that a robot travels across without sliding or tipping.

    Rolling resistance takes a share f/φ_x of the friction ellipse: tan α = φ_y √(1 - (f/φ_x)²). It tips at
    tan α = B / (2 h). For a rigid robot whose load does not shift.
    """
    robot_at_point, conditions = _robot_and_conditions_at(robot, point, rated)
    conditions = replace(conditions, adhesion_lateral=jnp.asarray(point.adhesion_lateral))
    chassis = robot_at_point.chassis(conditions.configuration)
    stance = balances.stance(robot_at_point, conditions, chassis, chassis.mass + point.payload)
    friction = chassis.ground.friction.static * point.adhesion
    rolling_share = jnp.minimum(chassis.ground.rolling_resistance / friction, 1.0)
    # A root of 0 has no derivative.
    slope_of_sliding = friction * stance.lateral * jnp.sqrt(jnp.maximum(1 - rolling_share**2, 1e-12))
    slope_of_tipping = stance.width / (2 * stance.height)
    return jnp.degrees(jnp.arctan(jnp.minimum(slope_of_sliding, slope_of_tipping))), jnp.asarray(CONVERGED)


def _posture_quantity(robot: Robot, point: EnvelopePoint, rated: Ratings, name: str) -> Valued:
    """Geometric limits of a robot on level ground, see `static_limits`.

    The highest step in any posture of its levers, stairs and gaps with its levers flush, its size with them folded.
    """
    conditions = Conditions(configuration=jnp.asarray(point.configuration), payload=point.payload)
    if name == "step_mm":
        value = static_limits.best_step(robot, conditions)[0].height
    elif name == "stairs_rise_mm":
        friction = robot.chassis(point.configuration).ground.friction.static * point.adhesion
        value = static_limits.stairs_rise(robot, conditions, point.tread, friction)
    else:
        angle = static_limits.flush_lever_angle(robot) if name == "gap_mm" else jnp.pi
        limits = static_limits.posture_limits(robot, static_limits.with_lever_angles(conditions, angle, angle))
        value = {"gap_mm": limits.gap, "length_mm": limits.length, "height_mm": limits.height}[name]
    return jnp.asarray(value), jnp.asarray(CONVERGED)


#: Function of each group of quantities: (robot, point, ratings, name) -> Valued.
GROUPS = {"travel": _travel_quantity, "slope": _steepest_slope, "payload": _largest_payload, "endurance": _endurance,
"mass": _mass_quantity,
          "turn": _settled_turn, "across": _side_slope, "posture": _posture_quantity}  # fmt: skip


def evaluate_requirement(robot: Robot, point: EnvelopePoint, rated: Ratings, name: str) -> Valued:
    """Value of one quantity at one point.

    Args:
        robot: robot. Its parameters may be tracers.
        point: point of the envelope, scalar fields.
        rated: ratings of the robot, or others.
        name: name of the quantity, one of `QUANTITIES`.
    """
    return GROUPS[QUANTITIES[name].group](robot, point, rated, name)
