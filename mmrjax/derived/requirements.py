"""Requirements: what can be asked of a robot, as functions of the robot and a point of an envelope of use."""

from __future__ import annotations

import dataclasses
import functools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mmrjax.climbing import static_limits
from mmrjax.derived import steepest_slope
from mmrjax.fidelities.steady import operating
from mmrjax.model import balances, energy
from mmrjax.model.conditions import Conditions
from mmrjax.model.motor import TEMPERATURE_REFERENCE
from mmrjax.model.params import Index, Scalar
from mmrjax.model.quantities import CONDITIONS, MM, RPM
from mmrjax.model.robot import Robot
from mmrjax.model.signals import CONVERGED, CUT_OFF, Signals
from mmrjax.turning.circling import circling

#: Of an envelope: what a point of it states.
AXES = ("payload_kg", "slope_deg", "charge", "ambient_C")
PAYLOAD, SLOPE, CHARGE, AMBIENT = AXES
#: What turning on level ground depends on.
LEVEL = (PAYLOAD, CHARGE, AMBIENT)

WATT_HOUR, MINUTE = 3600.0, 60.0


@dataclasses.dataclass(frozen=True)
class Quantity:
    """What a requirement is about.

    Attributes:
        name: with its unit, as files have it; unit: as people read it; factor: the SI value of one.
        least: whether a number alone is the least that it has to be; else the most that it may be.
        label: words.
        group: which computation it is read from, of `GROUPS`.
        axes: of the envelope, on which it depends.
    """

    name: str
    unit: str
    factor: float
    least: bool
    label: str
    group: str
    axes: tuple[str, ...] = AXES


#: Those that rest on how warm the windings become.
OF_HEAT = ("winding_C", "payload_kg")
#: Everything that can be asked for, by name.
QUANTITIES: dict[str, Quantity] = {
    q.name: q
    for q in (
        Quantity("speed_m_s", "m/s", 1.0, True, "speed", "travel"),
        Quantity("speed_end_of_charge_m_s", "m/s", 1.0, True, "speed at the end of charge", "travel"),
        Quantity("slope_deg", "deg", 1.0, True, "steepest slope held", "slope", (PAYLOAD, CHARGE, AMBIENT)),
        Quantity("payload_kg", "kg", 1.0, True, "largest payload", "payload", (SLOPE, CHARGE, AMBIENT)),
        Quantity("mass_kg", "kg", 1.0, False, "mass without payload", "mass", ()),
        Quantity("endurance_min", "min", MINUTE, True, "endurance", "endurance", (PAYLOAD, SLOPE, AMBIENT)),
        Quantity("winding_C", "°C", 1.0, False, "winding after long running", "travel"),
        Quantity("gearbox_Nm", "N·m", 1.0, False, "torque of a gearbox", "travel"),
        Quantity("gearbox_speed_rpm", "rpm", RPM, False, "speed at the gearbox input", "travel"),
        Quantity("motor_speed_rpm", "rpm", RPM, False, "speed of the motors", "travel"),
        Quantity("current_A", "A", 1.0, False, "current of all motors", "travel"),
        Quantity("energy_per_metre_Wh", "Wh/m", WATT_HOUR, False, "energy per metre", "travel"),
        Quantity("turn_in_place_rad_s", "rad/s", 1.0, True, "yaw rate on the spot", "turn", LEVEL),
        Quantity("turning_radius_mm", "mm", MM, False, "turning radius beside a braked side", "turn", LEVEL),
        Quantity("side_slope_deg", "deg", 1.0, True, "steepest slope travelled across", "across", (PAYLOAD,)),
        Quantity("step_mm", "mm", MM, True, "highest step", "posture", (PAYLOAD,)),
        Quantity("stairs_rise_mm", "mm", MM, True, "highest rise of stairs", "posture", (PAYLOAD,)),
        Quantity("gap_mm", "mm", MM, True, "widest gap", "posture", (PAYLOAD,)),
        Quantity("length_mm", "mm", MM, False, "length with levers folded", "posture", ()),
        Quantity("height_mm", "mm", MM, False, "height with levers folded", "posture", ()),
    )
}


class Ratings(eqx.Module):
    """Numbers that a robot holds as constants, as numbers that can be batched.

    Attributes:
        cells: in series [-]; voltage_cutoff: of a cell [V]; temperature: permissible of the winding [°C];
        torque: permissible of a gearbox for long [N·m], inf where not stated.
    """

    cells: Scalar
    voltage_cutoff: Scalar
    temperature: Scalar
    torque: Scalar


def ratings(robot: Robot) -> Ratings:
    """Those of a robot."""
    return Ratings(
        jnp.asarray(robot.battery.cells, float),
        jnp.asarray(robot.battery.voltage_cutoff, float),
        jnp.asarray(robot.motor.temperature_limit, float),
        jnp.asarray(robot.gearbox.torque_limit or math.inf, float),
    )


class Point(eqx.Module):
    """A point of the envelope; every field differentiable and batchable.

    Attributes:
        configuration: index; battery: 1 on the battery.
        adhesion, adhesion_lateral: of the surface as a ratio to the robot's own [-].
        charge: state of charge [-], of an external supply its voltage [V]; charge_end: to which the battery is used.
        share: of the time that the robot drives, for its endurance; 0 standing still [-].
        slope_deg: [deg]; payload: [kg]; ambient: [°C].
        tread: of stairs [m].
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


class Found(eqx.Module):
    """What a point comes to.

    Attributes:
        value: [SI], with some number whatever the outcome; outcome: code into `STATUSES`, `converged` where the
            value counts.
    """

    value: Float[Array, "..."]
    outcome: Int[Array, "..."]


def packed(robot: Robot, cells: Scalar) -> Robot:
    """The robot with so many cells in series, also where that is traced: as many volts of those that it has."""
    battery = robot.battery
    more = cells / battery.cells
    battery = dataclasses.replace(
        battery, curvature=battery.curvature * more, slope=battery.slope * more,
        voltage_full=battery.voltage_full * more, resistance=battery.resistance * more,
    )  # fmt: skip
    return dataclasses.replace(robot, battery=battery)


def _at(robot: Robot, point: Point, rated: Ratings) -> tuple[Robot, Conditions]:
    """The robot with its winding at ambient temperature, as a run begins, and the conditions of a point."""
    copper = 1 + robot.motor.temperature_coefficient * (point.ambient - TEMPERATURE_REFERENCE)
    motor = dataclasses.replace(robot.motor, resistance=robot.motor.resistance * copper)
    robot = packed(dataclasses.replace(robot, motor=motor), rated.cells)
    return robot, Conditions(
        configuration=jnp.asarray(point.configuration),
        voltage=jnp.where(point.battery > 0.5, 1.0, point.charge),
        slope_deg=point.slope_deg, payload=point.payload, battery=point.battery,
        discharge=jnp.where(point.battery > 0.5, _discharge(robot, point.charge), 0.0), adhesion=point.adhesion,
    )  # fmt: skip


def _discharge(robot: Robot, charge: Scalar) -> Scalar:
    """Charge taken at a state of charge [C]; a hair before the end at 0, where a battery counts as empty."""
    return robot.battery.capacity * (1 - jnp.maximum(charge, 1e-9))


def _temperature(robot: Robot, point: Point, current: Scalar) -> Scalar:
    """Of the winding after long running [°C]; `robot` as stated, not as `_at` gives it."""
    return dataclasses.replace(robot.motor, temperature_ambient=point.ambient).temperature_settled(current)


def heat_left(robot: Robot, point: Point, current: Scalar, limit: Scalar) -> Scalar:
    """What is left of the loss that a winding may have for long at `current` [-]: 0 where it settles at `limit` [°C].

    1 - I² R_th R (1 + α (T - 25 °C)) / (T - T_a); `robot` as stated, not as `_at` gives it.
    """
    motor = robot.motor
    hot = motor.resistance * (1 + motor.temperature_coefficient * (limit - TEMPERATURE_REFERENCE))
    return 1 - current**2 * motor.resistance_thermal * hot / jnp.maximum(limit - point.ambient, 1.0)


def _cell(rated: Ratings, signals: Signals, point: Point) -> Scalar:
    """By how much a cell is above its cut-off voltage [V]; inf on an external supply."""
    return jnp.where(point.battery > 0.5, signals.voltage_source / rated.cells - rated.voltage_cutoff, jnp.inf)


def travel(robot: Robot, point: Point, rated: Ratings) -> tuple[dict[str, Array], Array]:
    """Steady travel: every quantity of group `travel` by name [SI], and the outcome; beside them the
    `current` of one motor and of the `battery` [A], what is `left` of traction and speed, of `adhesion` alone [-],
    and by how much a `cell` is above its cut-off [V]."""
    here, conditions = _at(robot, point, rated)
    signals, status, _ = operating(here, conditions)
    outcome = jnp.where((status == CONVERGED) & (_cell(rated, signals, point) < 0), CUT_OFF, status)
    moving = jnp.where(jnp.abs(signals.speed) > 1e-6, signals.speed, 1e-6)
    turns = jnp.abs(signals.speed_motor)
    found = {
        "speed_m_s": signals.speed,
        "speed_end_of_charge_m_s": signals.speed,
        "winding_C": _temperature(robot, point, signals.current),
        "gearbox_Nm": jnp.abs(signals.torque_gear),
        "gearbox_speed_rpm": turns,
        "motor_speed_rpm": turns,
        "current_A": signals.total_current,
        "energy_per_metre_Wh": energy.source(here, conditions, signals) / moving,
        "current": signals.current,
        "battery": here.battery.current(signals.total_current),
        "adhesion": 1 - signals.demand / signals.adhesion_limit,
        "left": steepest_slope.travel_margin(here, signals),
        "cell": _cell(rated, signals, point),
    }
    return {name: jnp.asarray(x) for name, x in found.items()}, outcome


def _travel(robot: Robot, point: Point, rated: Ratings, name: str) -> Found:
    values, outcome = travel(robot, point, rated)
    return Found(values[name], outcome)


def _slope(robot: Robot, point: Point, rated: Ratings, name: str) -> Found:
    here, conditions = _at(robot, point, rated)
    answer = steepest_slope.compute(here, conditions)
    held = jnp.isfinite(answer["steepest_slope"])
    return Found(jnp.where(held, answer["steepest_slope"], 0.0), answer["status"])


#: Halvings of a bracket, whose rest a step of Newton's method takes off.
HALVINGS = 26


def _payload(robot: Robot, point: Point, rated: Ratings, name: str) -> Found:
    """The largest payload that is carried for long: the robot travels, its winding settles within what is permitted,
    its gearboxes carry the torque (where their limit is stated) and its cells stay above their cut-off."""
    most = CONDITIONS["payload"].range[1]

    def left(robot: Robot, payload: Scalar) -> Scalar:
        at = dataclasses.replace(point, payload=payload)
        here, conditions = _at(robot, at, rated)
        signals, _, _ = operating(here, conditions)
        hot = heat_left(robot, at, signals.current, rated.temperature)
        torque = 1 - jnp.abs(signals.torque_gear) / rated.torque
        each = [steepest_slope.travel_margin(here, signals), hot, torque, _cell(rated, signals, point)]
        return functools.reduce(jnp.minimum, each)

    found, holds = _edge(left, robot, jnp.zeros(()), jnp.asarray(most))
    here, conditions = _at(robot, dataclasses.replace(point, payload=jnp.zeros(())), rated)
    signals, status, _ = operating(here, conditions)
    outcome = jnp.where((status == CONVERGED) & (_cell(rated, signals, point) < 0), CUT_OFF, status)
    return Found(jnp.where(holds, found, 0.0), outcome)


def _edge(left, robot: Robot, low: Array, high: Array) -> tuple[Array, Array]:  # type: ignore[no-untyped-def]
    """Where what is `left` becomes negative between low and high, `high` where it does not; and whether it is
    positive at low. Derivatives are implicit, forward and reverse."""
    still = jax.lax.stop_gradient(robot)

    def halve(bracket: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        a, b = bracket
        middle = (a + b) / 2
        holds = left(still, middle) > 0
        return (jnp.where(holds, middle, a), jnp.where(holds, b, middle)), None

    begin, end = jax.lax.stop_gradient((low, high))
    (a, b), _ = jax.lax.scan(halve, (begin, end), None, length=HALVINGS)
    at = (a + b) / 2
    steep = jax.jvp(lambda x: left(still, x), (at,), (jnp.ones_like(at),))[1]
    usable = jnp.isfinite(steep) & (jnp.abs(steep) > 1e-12)
    step = left(robot, at) / jnp.where(usable, jax.lax.stop_gradient(steep), 1.0)
    found = at - jnp.where(usable & jnp.isfinite(step), step, 0.0)
    # A margin that jumps has no root to step onto.
    found = jnp.where(jnp.abs(found - at) < 1e-3 * (end - begin) + 1e-9, found, at)
    return jnp.where(left(still, end) > 0, high, found), left(still, begin) > 0


#: Nodes of the integral over the charge.
NODES = 8


def _endurance(robot: Robot, point: Point, rated: Ratings, name: str) -> Found:
    """How long the battery lasts [s]: t = ∫ dC / (s I_Σ(C) + I_p) over the charge that is used, Gauss-Legendre.

    It drives at full voltage for a share s of the time, else it stands; it ends where a cell meets its cut-off.
    """
    first, last = (jnp.asarray(robot.battery.capacity * (1 - x)) for x in (point.charge, point.charge_end))

    def drawn(robot: Robot, discharge: Scalar) -> tuple[Scalar, Scalar, Array]:
        """Mean current of the battery [A], what is left of the cut-off [V], status."""
        here, conditions = _at(robot, point, rated)
        conditions = dataclasses.replace(conditions, discharge=jnp.asarray(discharge))
        signals, status, _ = operating(here, conditions)
        stands = point.share <= 0
        motors = jnp.where(stands, 0.0, signals.total_current)
        cell = here.battery.voltage(motors, discharge) / rated.cells - rated.voltage_cutoff
        current = here.battery.current(point.share * motors)
        return current, cell, jnp.where(stands, CONVERGED, status)

    end, begins = _edge(lambda robot, c: drawn(robot, c)[1], robot, first, last)
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    at = first + (end - first) * jnp.asarray((nodes + 1) / 2)
    current, _, status = jax.vmap(lambda c: drawn(robot, c))(at)
    flowing = jnp.maximum(current, 1e-9)
    time = (end - first) * jnp.sum(jnp.asarray(weights / 2) / flowing)
    worst = status[jnp.argmax(status != CONVERGED)]
    outcome = jnp.where(begins, worst, CUT_OFF)
    return Found(time, outcome)


def _mass(robot: Robot, point: Point, rated: Ratings, name: str) -> Found:
    mass = jnp.asarray(robot.chassis(point.configuration).mass)
    return Found(mass, jnp.full(mass.shape, CONVERGED))


#: Duty of the left side, the right one's being full.
DUTY_LEFT = {"turn_in_place_rad_s": -1.0, "turning_radius_mm": 0.0}


def _turn(robot: Robot, point: Point, rated: Ratings, name: str) -> Found:
    """A settled turn on level ground, at full voltage: both sides apart on the spot, or beside a side that brakes."""
    here, conditions = _at(robot, point, rated)
    conditions = dataclasses.replace(
        conditions, slope_deg=jnp.zeros(()), adhesion_lateral=jnp.asarray(point.adhesion_lateral),
        duty_left=jnp.asarray(DUTY_LEFT[name]), duty_right=jnp.asarray(1.0),
    )  # fmt: skip
    found, motion, status = circling(here, conditions)
    low = jnp.any(jnp.asarray(_cell(rated, found.signals, point)) < 0)
    turns = jnp.where(jnp.abs(motion.yaw_rate) > 1e-6, motion.yaw_rate, 1e-6)
    rolls = motion.speed**2 + motion.speed_lateral**2
    # A root of nothing has no derivative.
    value = motion.yaw_rate if name == "turn_in_place_rad_s" else jnp.sqrt(jnp.maximum(rolls, 1e-24)) / jnp.abs(turns)
    return Found(jnp.asarray(value), jnp.where((status == CONVERGED) & low, CUT_OFF, status))


def _across(robot: Robot, point: Point, rated: Ratings, name: str) -> Found:
    """The side slope [deg] from which a robot that travels across slides, or tips.

    Rolling resistance takes a share f/φ_x of the friction ellipse: tan α = φ_y √(1 - (f/φ_x)²). It tips at
    tan α = B / (2 h). Of a rigid robot whose load has not moved.
    """
    here, conditions = _at(robot, point, rated)
    conditions = dataclasses.replace(conditions, adhesion_lateral=jnp.asarray(point.adhesion_lateral))
    chassis = here.chassis(conditions.configuration)
    stands = balances.stance(here, conditions, chassis, chassis.mass + point.payload)
    friction = chassis.ground.friction.static * point.adhesion
    taken = jnp.minimum(chassis.ground.rolling_resistance / friction, 1.0)
    # A root of nothing left has no derivative.
    slides = friction * stands.lateral * jnp.sqrt(jnp.maximum(1 - taken**2, 1e-12))
    tips = stands.width / (2 * stands.height)
    return Found(jnp.degrees(jnp.arctan(jnp.minimum(slides, tips))), jnp.asarray(CONVERGED))


def _posture(robot: Robot, point: Point, rated: Ratings, name: str) -> Found:
    """What geometry allows a robot on level ground, see `static_limits`: the highest step in any posture of its
    levers, stairs and gaps with its levers flush, its size with them folded."""
    conditions = Conditions(configuration=jnp.asarray(point.configuration), payload=point.payload)
    if name == "step_mm":
        value = static_limits.best_step(robot, conditions)[0].height
    elif name == "stairs_rise_mm":
        friction = robot.chassis(point.configuration).ground.friction.static * point.adhesion
        value = static_limits.stairs_rise(robot, conditions, point.tread, friction)
    else:
        angle = static_limits.flush(robot) if name == "gap_mm" else jnp.pi
        found = static_limits.limits(robot, static_limits.with_levers(conditions, angle, angle))
        value = {"gap_mm": found.gap, "length_mm": found.length, "height_mm": found.height}[name]
    return Found(jnp.asarray(value), jnp.asarray(CONVERGED))


#: How a group of quantities is computed: (robot, point, ratings, name) -> Found.
GROUPS = {"travel": _travel, "slope": _slope, "payload": _payload, "endurance": _endurance, "mass": _mass,
          "turn": _turn, "across": _across, "posture": _posture}  # fmt: skip


def evaluate(robot: Robot, point: Point, rated: Ratings, name: str) -> Found:
    """One quantity at one point.

    Args:
        robot: any; its parameters may be tracers; point: scalars; rated: the robot's `ratings`, or others.
        name: of `QUANTITIES`.
    """
    return GROUPS[QUANTITIES[name].group](robot, point, rated, name)
