"""Missions: the ODE of `drive` over a profile, with heat, standing still, and energy integrated as states.

A robot that has come to rest stands: what friction can hold does not move, neither by the smooth friction of the
shafts nor by the creep of the ground's law, until motors or gravity overcome it. Standing and breaking away are
events that the steps land on, and derivatives pass through the moments at which they happen.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, Int

from mmrjax import balances, energy
from mmrjax.conditions import Conditions
from mmrjax.fidelities.rarely import rarely
from mmrjax.fidelities.rest import current_at_rest, firmness
from mmrjax.fidelities.result import exceeded, mask, result, slips, travels, withhold
from mmrjax.fidelities.rosenbrock import stages
from mmrjax.params import Scalar
from mmrjax.profile import BRAKE, COAST, MOTOR_SPEED, SPEED, Instant, Profile
from mmrjax.robot import Robot
from mmrjax.signals import (
    BATTERY_EMPTY,
    CONVERGED,
    FAILED,
    NOT_SETTLED,
    ROLLS_BACK,
    SLIDES,
    STALLED,
    Result,
    Signals,
    State,
)

#: Of the unknowns current, motor speed, speed, discharge, temperatures of winding and housing, integral of the
#: controller and time in the segment; all are then of the order of one. The memories of effects follow.
UNITS = (10.0, 1000.0, 1.0, 100.0, 50.0, 50.0, 10.0, 1.0)
_CURRENT, _MOTOR, _SPEED, _DISCHARGE, _WINDING, _HOUSING, _INTEGRAL, _CLOCK = range(len(UNITS))

#: What is integrated beside them: name, and unit of a total.
TOTALS: dict[str, str] = {
    "distance": "m", "path": "m", "drawn": "J", "returned": "J", "current_squared": "A²·s",
    "torque_squared": "N²·m²·s", **dict.fromkeys(energy.SINKS, "J"),
}  # fmt: skip

#: Largest values of a mission, of any instant: name, and unit.
PEAKS: dict[str, str] = {
    "current": "A", "torque": "N·m", "temperature": "°C", "motor_speed": "rad/s", "speed": "m/s", "cell_low": "V",
}  # fmt: skip

#: Relative tolerance of a step, and in the units of the unknowns.
TOLERANCE = 2e-5
#: Most steps of one segment.
MOST_STEPS = 4096
#: The first step of a segment [s], and the shortest.
FIRST, SHORTEST = 1e-4, 1e-9
#: How near an event a step has to end, of what its function is scaled to; or how short a step is near enough [s].
EVENT, NEAR = 1e-2, 1e-7
#: How firmly friction holds a robot before it stands [-].
FIRMLY = 1e-3
#: A demanded speed is missed where at the end of a segment it is off by more than this share of the segment's
#: largest [-].
MISSED = 0.02


class Totals(eqx.Module):
    """What a mission or a segment comes to.

    Attributes:
        time: that it took [s].
        of: integrals by the names of `TOTALS`; `drawn` and `returned` are the source's, the rest where it went.
        stored: rise of the energy in motion [J].
    """

    time: Array
    of: dict[str, Array]
    stored: Array

    @property
    def energy(self) -> Scalar:
        """Taken from the source on balance [J]."""
        return self.of["drawn"] - self.of["returned"]

    @property
    def unaccounted(self) -> Scalar:
        """Energy in, less where it went, less what is stored [J]: what the integration is off by."""
        return self.energy - sum(self.of[name] for name in energy.SINKS) - self.stored


class Start(eqx.Module):
    """The state that a mission begins in; at rest and at ambient temperature where nothing is stated.

    Attributes:
        speed: of the robot, its movers rolling [m/s]; current: of one motor [A].
        temperature_winding, temperature_housing: [°C], None: ambient.
    """

    speed: Scalar = 0.0
    current: Scalar = 0.0
    temperature_winding: Scalar | None = None
    temperature_housing: Scalar | None = None


class Course(eqx.Module):
    """A mission over time: its accepted steps, shape (kept,); those after the last are NaN.

    Attributes:
        time: since the mission began [s]; segment: index of the segment, -1 after the last.
        distance: along the ground [m]; temperature_winding, temperature_housing: [°C].
        energy: taken from the source on balance [J].
        signals: every signal.
    """

    time: Float[Array, " kept"]
    segment: Int[Array, " kept"]
    distance: Float[Array, " kept"]
    energy: Float[Array, " kept"]
    temperature_winding: Float[Array, " kept"]
    temperature_housing: Float[Array, " kept"]
    signals: Signals


class Mission(eqx.Module):
    """A robot's run over a profile.

    Attributes:
        total: of the mission; segments: of each segment of each cycle, fields of shape (cycles, segments).
        peaks: by the names of `PEAKS` (`cell_low` the lowest voltage of a cell); of the segments too.
        status: of each segment at its end, flags: of each segment; shape (cycles, segments).
        result: the end of the mission, with its status and the flags of all of it. Status is `converged` where the
            profile was followed to its end; `battery_empty` (also where the cells stay below their cut-off);
            `stalled`, `slides` or `rolls_back` where some segment that asks for motion ends so, the first one;
            `failed` the integrator gave up.
        end: unknowns at the end; temperature_winding, temperature_housing: [°C]; discharge: [C].
        steps: that were taken, and how many of them were rejected.
        course: over time, where it was asked for.
    """

    total: Totals
    segments: Totals
    peaks: dict[str, Array]
    segment_peaks: dict[str, Array]
    status: Int[Array, "cycles segments"]
    flags: Int[Array, "cycles segments"]
    result: Result
    temperature_winding: Scalar
    temperature_housing: Scalar
    discharge: Scalar
    steps: Int[Array, ""]
    rejected: Int[Array, ""]
    course: Course | None


def units(robot: Robot) -> Float[Array, " unknowns"]:
    """What the unknowns are measured in."""
    return jnp.asarray(UNITS + tuple(effect.memory_size or 1.0 for effect in robot.remembering))


def _state(robot: Robot, y: Float[Array, " unknowns"], stands: Array) -> State:
    x = y * units(robot).astype(y.dtype)
    memory = {effect.name: x[len(UNITS) + k] for k, effect in enumerate(robot.remembering)}
    motor, speed = (jnp.where(stands, 0.0, x[k]) for k in (_MOTOR, _SPEED))
    return State(x[_CURRENT], motor, speed, x[_DISCHARGE], memory, x[_WINDING])


def _error(robot: Robot, asked: Instant, conditions: Conditions, state: State) -> tuple[Scalar, Scalar]:
    """Demanded motor speed, and how much of it is lacking [rad/s]; a ground speed as the motor speed it takes."""
    per_speed = robot.gearbox.ratio / robot.chassis(conditions.configuration).radius
    on_ground = asked.mode == SPEED
    demanded = asked.demand * jnp.where(on_ground, per_speed, 1.0)
    return demanded, demanded - jnp.where(on_ground, state.speed * per_speed, state.speed_motor)


class Asked(NamedTuple):
    """What acts on the robot at an instant: the robot with its other consumers, conditions with the duty that the
    controller gives, rate of the controller's integral [rad/s], and the error of the demand [rad/s]."""

    robot: Robot
    conditions: Conditions
    integral_rate: Scalar
    error: Scalar


def _asked(robot: Robot, otherwise: Conditions, segment: Profile, y: Array, stands: Array) -> Asked:
    asked = segment.at(y[_CLOCK])
    if asked.current_other is not None:
        battery = dataclasses.replace(robot.battery, current_other=asked.current_other)
        robot = dataclasses.replace(robot, battery=battery)
    conditions = asked.conditions(otherwise)
    state = _state(robot, y, stands)
    demanded, error = _error(robot, asked, conditions, state)
    controlled = (asked.mode == MOTOR_SPEED) | (asked.mode == SPEED)
    source = jnp.where(
        conditions.battery > 0.5, robot.battery.voltage(0.0, state.discharge), jnp.abs(conditions.voltage)
    )
    voltage = robot.driver.demand(error, y[_INTEGRAL] * UNITS[_INTEGRAL], demanded, robot.motor.torque_constant)
    wanted = voltage / jnp.maximum(source, 1e-3)
    limited = robot.driver.duty_limited(jnp.clip(wanted, -1.0, 1.0), state.current)
    # What the limits take away, the integral gives back: it does not wind up.
    excess = (wanted - limited) * source / (robot.driver.gain * robot.motor.torque_constant + 1e-12)
    duty = jnp.where(controlled, wanted, conditions.duty)
    sign = jnp.where(conditions.battery > 0.5, 1.0, jnp.sign(conditions.voltage))
    conditions = dataclasses.replace(conditions, duty=jnp.clip(jnp.where(controlled, sign * duty, duty), -1.0, 1.0))
    return Asked(robot, conditions, jnp.where(controlled, error - excess, 0.0), jnp.where(controlled, error, 0.0))


@eqx.filter_jit
def _instant(
    robot: Robot, otherwise: Conditions, segment: Profile, y: Array, stands: Array
) -> tuple[Signals, Array, Array, Asked]:
    """Signals of an instant, rates of the unknowns in their units, and of the totals [1/s]."""
    asked = _asked(robot, otherwise, segment, y, stands)
    state = _state(robot, y, stands)
    signals = balances.moving(asked.robot, asked.conditions, state)
    winding, housing = (y[k] * UNITS[k] for k in (_WINDING, _HOUSING))
    copper = robot.motor.voltage_winding(signals.current, winding) * signals.current
    heating = robot.motor.heating(copper, winding, housing)
    drawn = asked.robot.battery.current(signals.total_current) * (asked.conditions.battery > 0.5)  # eq. (11)
    still = jnp.where(stands, 0.0, 1.0)
    rates = [
        signals.voltage_left / signals.inductance,
        still * signals.acceleration_wheel * robot.gearbox.ratio,
        still * signals.acceleration,
        drawn,
        *heating,
        asked.integral_rate,
        1.0,
        *(effect.rate(robot, signals) for effect in robot.remembering),
    ]
    power = energy.source(asked.robot, asked.conditions, signals)
    current, torque = robot.sides * signals.current, signals.torque_gear
    goes = energy.sinks(asked.robot, asked.conditions, signals)
    totals = [
        signals.speed, jnp.abs(signals.speed), jnp.maximum(power, 0.0), jnp.maximum(-power, 0.0), current**2,
        torque**2, *goes.values(),
    ]  # fmt: skip
    dtype = y.dtype
    return (
        signals,
        jnp.stack([jnp.asarray(r, dtype) for r in rates]) / units(robot).astype(dtype),
        jnp.stack([jnp.asarray(x, dtype) for x in totals]),
        asked,
    )


def _firmly(robot: Robot, otherwise: Conditions, segment: Profile, y: Array, stands: Array) -> tuple[Array, Array]:
    """How firmly friction would hold the robot now, and with what current will flow then too: a controller asks for
    less once there is no error."""
    asked = _asked(robot, otherwise, segment, y, stands)
    at_rest = _asked(robot, otherwise, segment, y, jnp.asarray(True))
    state = _state(robot, y, stands)
    settled = dataclasses.replace(state, current=current_at_rest(at_rest.robot, at_rest.conditions, state))
    firm = firmness(asked.robot, asked.conditions, state)
    return jnp.asarray(firm), jnp.minimum(firm, firmness(at_rest.robot, at_rest.conditions, settled))


class _Carry(NamedTuple):
    y: Array
    q: Array
    step: Array
    stands: Array
    ended: Array  # no more: empty, cut off or failed
    low: Array  # for how long the cells have been below their cut-off [s]
    peaks: Array
    flags: Array
    events: Array
    accepted: Array
    rejected: Array
    failed: Array
    slope: Array  # of the current, in its unit [1/s]
    kept: Array
    buffer: tuple[Array, ...] | None


def _peaks_of(robot: Robot, signals: Signals) -> Array:
    cell = jnp.where(signals.battery > 0.5, signals.voltage_source / robot.battery.cells, jnp.inf)
    of = [
        jnp.abs(robot.sides * signals.current), jnp.abs(signals.torque_gear), signals.temperature,
        jnp.abs(signals.speed_motor), jnp.abs(signals.speed), -cell,
    ]  # fmt: skip
    return jnp.stack([jnp.asarray(x, jnp.result_type(signals.current)) for x in of])


def _top(before: Array, after: Array, rise: Array, fall: Array) -> Array:
    """Largest size of a curve between two values, on the cubic with the slopes `rise` and `fall` at its ends."""
    sign = jnp.sign(after)
    x0, x1, d0, d1 = sign * before, sign * after, sign * rise, sign * fall
    bends = (d0 > 0) & (d1 < 0)
    a, b = 3 * (d0 + d1 - 2 * (x1 - x0)), 2 * (3 * (x1 - x0) - 2 * d0 - d1)
    root = b * b - 4 * a * d0
    bends &= root > 0
    # The root in 0..1, in the form that stays finite where the cubic is a parabola.
    low = b - jnp.sqrt(jnp.where(bends, root, 1.0))
    t = jnp.clip(-2 * d0 / jnp.where(jnp.abs(low) > 1e-12, low, -1e-12), 0.0, 1.0)
    top = x0 + t * (d0 + t * (b / 2 + t * a / 3))
    return jnp.where(bends, jnp.maximum(top, jnp.maximum(x0, x1)), jnp.maximum(x0, x1))


def _events(robot: Robot, otherwise: Conditions, segment: Profile, y: Array, stands: Array) -> Array:
    """Three functions that are positive once their event has happened: standing, breaking away, empty [-]."""
    asked = _asked(robot, otherwise, segment, y, stands)
    state = _state(robot, y, stands)
    friction = robot.chassis(asked.conditions.configuration).ground.friction
    rolling = robot.chassis(asked.conditions.configuration).radius * state.speed_motor / robot.gearbox.ratio
    slow = 1 - jnp.abs(rolling) / friction.speed_rest
    grips = 1 - jnp.abs(rolling - state.speed) / friction.speed_static
    near = stands | ((slow > -1) & (grips > -1))

    none = -jnp.ones_like(slow)
    firm, stays = rarely(near, _firmly, (robot, otherwise, segment, y, stands), (none, none))
    standing = jnp.minimum(jnp.minimum(slow, grips), stays - FIRMLY)
    battery = asked.robot.battery
    empty = jnp.where(asked.conditions.battery > 0.5, state.discharge / battery.capacity - 1, -1.0)
    return jnp.stack([jnp.where(stands, -1.0, standing), jnp.where(stands, -firm, -1.0), empty])


def _onto(
    robot: Robot, otherwise: Conditions, segment: Profile, y: Array, q: Array, stands: Array, after: Array, h: Array
) -> tuple[Array, Array, Array]:
    """Onto an event by a Newton step in time, which carries the derivative of its moment; and what it changes."""
    which = jnp.argmax(after)
    _, dy, dq, _ = _instant(robot, otherwise, segment, y, stands)
    steep = jax.jvp(lambda y: _events(robot, otherwise, segment, y, stands), (y,), (dy,))[1][which]
    back = jnp.where(steep > 1e-9, -after[which] / jnp.where(steep > 1e-9, steep, 1.0), 0.0)
    back = jnp.where(jnp.abs(back) < h, back, 0.0)
    y, q = y + back * dy, q + back * dq
    # To rest: what is left of the motion is lost where it slid.
    rest = y.at[_MOTOR].set(0.0).at[_SPEED].set(0.0)
    moved, parked = (_instant(robot, otherwise, segment, x, stands)[0] for x in (y, rest))
    halts = after[0] > 0
    lost = jnp.where(halts, energy.stored(robot, moved) - energy.stored(robot, parked), 0.0)
    q = q.at[list(TOTALS).index("sliding")].add(lost)
    return jnp.where(halts, rest, y), q, (stands | halts) & ~(after[1] > 0)


def _segment(
    robot: Robot,
    otherwise: Conditions,
    segment: Profile,
    carry: _Carry,
    tolerance: float,
    most: int,
) -> _Carry:
    """One segment: steps until its end, or until the mission has."""
    length = (segment.time[1] - segment.time[0]).astype(carry.y.dtype)
    first, nearly = carry.accepted + carry.rejected, length * (1 - 1e-12 if carry.y.dtype == float else 1 - 1e-6)
    longest = _step_longest(robot, otherwise)

    def rates(y: Array, stands: Array) -> tuple[Array, Array]:
        _, dy, dq, _ = _instant(robot, otherwise, segment, y, stands)
        return dy, dq

    def events(y: Array, stands: Array) -> Array:
        return _events(robot, otherwise, segment, y, stands)

    def going(c: _Carry) -> Array:
        return (c.y[_CLOCK] < nearly) & ~c.ended & (c.accepted + c.rejected - first < most)

    def turn(c: _Carry) -> _Carry:
        left = length - c.y[_CLOCK]
        last = c.step >= left * (1 - 1e-9)
        h = jnp.where(last, left, jax.lax.stop_gradient(c.step))
        y, q, u, _ = stages(functools.partial(rates, stands=c.stands), c.y, c.q, h, inverted=True)
        y = y.at[_CLOCK].set(jnp.where(last, length, y[_CLOCK]))
        scale = tolerance * (1 + jnp.maximum(jnp.abs(c.y), jnp.abs(y)))
        size = optx.rms_norm(u[-1] / scale) * (y.shape[0] / len(UNITS)) ** 0.5
        size = jax.lax.stop_gradient(jnp.where(jnp.isfinite(size), size, 1e6))
        good = size <= 1
        grown = h * jnp.clip(0.9 * jnp.maximum(size, 1e-12) ** -0.25, 0.1, 6.0)
        # Events: steps land on the first of them.
        after = events(y, c.stands)
        happened = after > 0
        between = happened & (c.events < 0)
        share = jnp.where(between, c.events / jnp.where(between, c.events - after, 1.0), 1.0)
        far = jnp.any(between & (after > EVENT)) & (h > NEAR)
        taken = good & ~far
        event = taken & jnp.any(happened)
        here = (robot, otherwise, segment, y, q, c.stands, after, h)
        y, q, stands = rarely(event, _onto, here, (y, q, c.stands))
        y, q = jnp.where(taken, y, c.y), jnp.where(taken, q, c.q)
        stands = jnp.where(taken, stands, c.stands)
        # After a step cut short by the segment's end or an event, the length from before it.
        step = jnp.where(taken, jnp.where(last, jnp.maximum(grown, c.step), grown), grown)
        step = jnp.where(good & far, h * jnp.clip(jnp.min(share) * 1.001, 0.02, 0.99), step)
        step = jnp.where(event, FIRST, step)
        step = jnp.clip(jax.lax.stop_gradient(step), SHORTEST, longest)
        signals, dy, _, _ = _instant(robot, otherwise, segment, y, stands)
        between_ends = _top(c.y[_CURRENT], y[_CURRENT], h * c.slope, h * dy[_CURRENT])
        peaks = jnp.maximum(c.peaks, _peaks_of(robot, signals))
        within = jnp.where(taken, robot.sides * UNITS[_CURRENT] * between_ends, -jnp.inf)
        peaks = peaks.at[list(PEAKS).index("current")].max(within)
        flags, low = _flags(robot, signals, c.low, jnp.where(taken, h, 0.0))
        tripped = low > robot.battery.delay_cutoff
        failed = c.failed | (~good & (h <= SHORTEST))
        ended = c.ended | tripped | (event & happened[2]) | failed
        now = (robot, otherwise, segment, y, stands)
        events_now = rarely(event, _events, now, jnp.where(taken, after, c.events))
        kept, buffer = c.kept, c.buffer
        if buffer is not None:
            at = jnp.where(taken, kept, buffer[0].shape[0])  # beyond the end: dropped
            buffer = tuple(b.at[at].set(r, mode="drop") for b, r in zip(buffer, (y, q, stands), strict=True))
        return _Carry(
            y=y, q=q, step=step, stands=stands, ended=ended, low=low, peaks=peaks, flags=c.flags | flags,
            events=events_now, accepted=c.accepted + taken, rejected=c.rejected + ~taken, failed=failed,
            kept=kept + taken, buffer=buffer, slope=dy[_CURRENT],
        )  # fmt: skip

    # The segment's beginning may have taken away what held the robot.
    y = carry.y.at[_CLOCK].set(0.0)
    asked = _asked(robot, otherwise, segment, y, carry.stands)
    stands = carry.stands & (firmness(asked.robot, asked.conditions, _state(robot, y, carry.stands)) >= 0)
    step = jnp.minimum(jnp.asarray(FIRST, y.dtype), longest)
    begin = carry._replace(y=y, q=jnp.zeros_like(carry.q), step=step, stands=stands, events=events(y, stands))
    begin = begin._replace(slope=_instant(robot, otherwise, segment, y, stands)[1][_CURRENT])
    c = jax.lax.while_loop(going, turn, begin)
    failed = c.failed | ((c.y[_CLOCK] < nearly) & ~c.ended)
    return c._replace(failed=failed, ended=c.ended | failed)


def _step_longest(robot: Robot, conditions: Conditions) -> Scalar:
    """The longest step that still resolves every effect with a memory [s]."""
    limits = [jnp.asarray(effect.step_longest(robot, conditions)) for effect in robot.remembering]
    return jax.lax.stop_gradient(jnp.min(jnp.stack([*limits, jnp.asarray(jnp.inf)])))


def _flags(robot: Robot, signals: Signals, low: Array, h: Array) -> tuple[Array, Array]:
    """What an instant exceeds, and for how long its cells have been below their cut-off [s].

    A start draws more than the cells bear for an instant; only what lasts counts.
    """
    over = exceeded(robot, signals)
    over.pop("slips")  # every start slips for an instant; of a segment it counts at its end
    low = jnp.where(over["cut_off"], low + h, 0.0)
    hot = jnp.asarray(signals.temperature) > robot.motor.temperature_limit
    return mask({**over, "cut_off": low > robot.battery.delay_cutoff, "too_hot": hot}), low


def _ends(
    robot: Robot, segment: Profile, signals: Signals, asked: Asked, stands: Array, mode: Array
) -> tuple[Array, Array]:
    """Status of a segment at its end, and whether the robot has missed what was demanded."""
    settling = jnp.abs(signals.acceleration) * 0.1 > 1e-3 * jnp.abs(signals.speed)
    driven = signals.duty * signals.voltage_source
    rests = stands | ((jnp.abs(signals.direction) < 1.0) & (jnp.abs(signals.direction_travel) < 1.0))
    wanted = (mode != BRAKE) & (mode != COAST) & (jnp.abs(driven) > 1e-6)
    status = jnp.where(settling & ~stands, NOT_SETTLED, travels(signals.speed, driven))
    slides = jnp.abs(signals.demand) > signals.adhesion_limit
    status = jnp.where(rests, STALLED, status)
    status = jnp.where(slides & ~stands, SLIDES, status)
    status = jnp.where(~wanted & rests & ~slides, CONVERGED, status)  # it stands, as it should
    controlled = (mode == MOTOR_SPEED) | (mode == SPEED)
    per_speed = robot.gearbox.ratio / robot.chassis(signals.configuration).radius
    # A ramp that ends in a stop is measured by where it began.
    demanded = segment.demand if segment.linear else segment.demand[:1]
    largest = jnp.max(jnp.abs(demanded)) * jnp.where(mode == SPEED, per_speed, 1.0)
    missed = controlled & (jnp.abs(asked.error) > MISSED * jnp.maximum(largest, 10.0))
    status = jnp.where(controlled & rests & ~missed, CONVERGED, status)
    return status, missed


def mission(
    robot: Robot,
    conditions: Conditions,
    profile: Profile,
    start: Start | None = None,
    *,
    tolerance: float = TOLERANCE,
    most_steps: int = MOST_STEPS,
    keep: int = 0,
) -> Mission:
    """Run one robot over a profile.

    Args:
        robot: any robot; its parameters may be tracers.
        conditions: one run, scalar fields: what the profile does not state.
        profile: one mission.
        start: state that it begins in; None: at rest, at ambient temperature.
        tolerance: relative, and in `UNITS` absolute, error of a step.
        most_steps: of one segment; a mission that needs more has `failed`.
        keep: accepted steps of which the mission over time is kept; 0 for none.

    Returns:
        The mission; derivatives are forward (`jax.jvp`, `jax.jacfwd`), by parameters, conditions and values and times
        of the profile, through stops and reversals; at a limit that begins to act they are those of one side.
    """
    begin = Start() if start is None else start
    ambient = robot.motor.temperature_ambient
    winding, housing = (ambient if t is None else t for t in (begin.temperature_winding, begin.temperature_housing))
    chassis = robot.chassis(conditions.configuration)
    dtype = jnp.result_type(conditions.voltage, profile.time)
    rest = [
        begin.current, begin.speed / chassis.radius * robot.gearbox.ratio, begin.speed, conditions.discharge, winding,
        housing, 0.0, 0.0, *(jnp.zeros(()) for _ in robot.remembering),
    ]  # fmt: skip
    y0 = jnp.stack([jnp.asarray(x, dtype) for x in rest]) / units(robot).astype(dtype)
    q0 = jnp.zeros(len(TOTALS), dtype)
    whole, false = jnp.asarray(0), jnp.asarray(False)
    buffer = None
    if keep:
        blank = jnp.full((keep, 1), jnp.nan, dtype)
        buffer = (blank * y0, blank * q0, jnp.zeros(keep, bool))
    carry = _Carry(
        y=y0, q=q0, step=jnp.asarray(FIRST, dtype), stands=jnp.asarray(begin.speed == 0.0), ended=false,
        low=jnp.zeros((), dtype), peaks=jnp.full(len(PEAKS), -jnp.inf, dtype), flags=whole,
        events=jnp.full(3, -1.0, dtype), accepted=whole, rejected=whole, failed=false, kept=whole, buffer=buffer,
        slope=jnp.zeros((), dtype),
    )  # fmt: skip

    def one(carry: _Carry, k: Array) -> tuple[_Carry, tuple]:
        segment = profile.row(k)
        fresh = carry._replace(peaks=jnp.full(len(PEAKS), -jnp.inf, dtype), flags=whole)
        beginning = _instant(robot, conditions, segment, carry.y.at[_CLOCK].set(0.0), carry.stands)[0]
        c = _segment(robot, conditions, segment, fresh, tolerance, most_steps)
        signals, _, _, asked = _instant(robot, conditions, segment, c.y, c.stands)
        status, missed = _ends(robot, segment, signals, asked, c.stands, segment.mode[0])
        empty = c.ended & ~c.failed
        status = jnp.where(c.failed, FAILED, jnp.where(empty, BATTERY_EMPTY, status))
        flags = c.flags | mask({"demand_missed": missed & ~c.ended, "slips": slips(robot, signals) & ~c.stands})
        rise = energy.stored(robot, signals) - energy.stored(robot, beginning)
        ran = ~carry.ended
        time = jnp.where(ran, c.y[_CLOCK], 0.0)
        out = (time, jnp.where(ran, c.q, 0.0), jnp.where(ran, rise, 0.0), c.peaks, status, flags, signals, c.kept)
        carry = c._replace(peaks=jnp.maximum(carry.peaks, c.peaks), flags=carry.flags | flags)
        return carry, out

    order = jnp.tile(jnp.arange(profile.segments), profile.cycles)
    c, (time, q, rise, peaks, status, flags, signals, kept) = jax.lax.scan(one, carry, order)
    shape = (profile.cycles, profile.segments)
    names = list(TOTALS)
    each = Totals(time.reshape(shape), {n: q[:, i].reshape(shape) for i, n in enumerate(names)}, rise.reshape(shape))
    total = jax.tree.map(jnp.sum, each)
    bad = (
        (status == STALLED)
        | (status == SLIDES)
        | (status == BATTERY_EMPTY)
        | (status == FAILED)
        | (status == ROLLS_BACK)
    )
    first = jnp.argmax(bad)
    outcome = jnp.where(jnp.any(bad), status[first], CONVERGED)
    outcome = jnp.where(c.failed, FAILED, jnp.where(c.ended, BATTERY_EMPTY, outcome))
    end = jax.tree.map(lambda x: x[-1], signals)
    answer = withhold(result(robot, end, outcome), outcome != FAILED, outcome != FAILED)
    answer = dataclasses.replace(answer, flags=c.flags)

    def named(x: Array) -> dict[str, Array]:
        signs = {"cell_low": -1.0}
        return {name: signs.get(name, 1.0) * x[..., i] for i, name in enumerate(PEAKS)}

    course = None
    if buffer is not None:
        course = _course(robot, conditions, profile, c, each, kept)
    return Mission(
        total=total, segments=each, peaks=named(c.peaks), segment_peaks=named(peaks.reshape(*shape, -1)),
        status=status.reshape(shape), flags=flags.reshape(shape), result=answer,
        temperature_winding=c.y[_WINDING] * UNITS[_WINDING], temperature_housing=c.y[_HOUSING] * UNITS[_HOUSING],
        discharge=c.y[_DISCHARGE] * UNITS[_DISCHARGE], steps=c.accepted + c.rejected, rejected=c.rejected,
        course=course,
    )  # fmt: skip


def _course(robot: Robot, conditions: Conditions, profile: Profile, c: _Carry, each: Totals, kept: Array) -> Course:
    assert c.buffer is not None
    ys, qs, stood = c.buffer
    at = jnp.arange(len(ys))
    # Of each kept step its segment: the first whose count reaches beyond it.
    of = jnp.minimum(jnp.searchsorted(kept, at, side="right"), len(kept) - 1)
    there = at < kept[-1]
    begun = jnp.concatenate([jnp.zeros(1), jnp.cumsum(each.time.ravel())])[of]
    so_far = {
        name: jnp.concatenate([jnp.zeros(1), jnp.cumsum(each.of[name].ravel())])[of] + qs[:, i]
        for i, name in enumerate(TOTALS)
    }

    def signals(y: Array, stands: Array, k: Array) -> Signals:
        return _instant(robot, conditions, profile.row(k % profile.segments), y, stands)[0]

    every = jax.vmap(signals)(ys, stood, of)

    def shown(x: Array) -> Array:
        return jnp.where(there, x, jnp.nan)

    return Course(
        time=shown(begun + ys[:, _CLOCK]),
        segment=jnp.where(there, of, -1),
        distance=shown(so_far["distance"]),
        energy=shown(so_far["drawn"] - so_far["returned"]),
        temperature_winding=shown(ys[:, _WINDING] * UNITS[_WINDING]),
        temperature_housing=shown(ys[:, _HOUSING] * UNITS[_HOUSING]),
        signals=jax.tree.map(shown, every),
    )


@eqx.filter_jit
def mission_batch(
    robot: Robot,
    conditions: Conditions,
    profile: Profile,
    start: Start | None = None,
    *,
    tolerance: float = TOLERANCE,
    most_steps: int = MOST_STEPS,
    keep: int = 0,
) -> Mission:
    """`mission` over a batch of conditions (leading axis of every field) for one robot and profile, compiled."""

    def one(c: Conditions) -> Mission:
        return mission(robot, c, profile, start, tolerance=tolerance, most_steps=most_steps, keep=keep)

    return jax.vmap(one)(conditions)
