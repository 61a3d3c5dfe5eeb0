"""Steps of a mission: what acts at an instant, its rates and integrals, events, and one segment of the profile."""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from mmrjax import balances, energy
from mmrjax.compiling import compiled
from mmrjax.conditions import Conditions
from mmrjax.fidelities.rarely import rarely
from mmrjax.fidelities.rest import current_at_rest, firmness
from mmrjax.fidelities.result import exceeded, mask
from mmrjax.fidelities.rosenbrock import stages
from mmrjax.params import Scalar
from mmrjax.profile import MOTOR_SPEED, SPEED, Instant, Profile
from mmrjax.robot import Robot
from mmrjax.signals import Signals, State

#: Of the unknowns current, motor speed, speed, discharge, temperatures of winding and housing, integral of the
#: controller and time in the segment; all are then of the order of one. The memories of effects follow.
UNITS = (10.0, 1000.0, 1.0, 100.0, 50.0, 50.0, 10.0, 1.0)
CURRENT, MOTOR, GROUND, DISCHARGE, WINDING, HOUSING, INTEGRAL, CLOCK = range(len(UNITS))

#: What is integrated beside them: name, and unit of a total.
TOTALS: dict[str, str] = {
    "distance": "m", "path": "m", "drawn": "J", "returned": "J", "current_squared": "A²·s",
    "torque_squared": "N²·m²·s", **dict.fromkeys(energy.SINKS, "J"),
}  # fmt: skip

#: Largest values of a mission, of any instant: name, and unit.
PEAKS: dict[str, str] = {
    "current": "A", "torque": "N·m", "temperature": "°C", "motor_speed": "rad/s", "speed": "m/s", "cell_low": "V",
}  # fmt: skip

#: The first step of a segment [s], and the shortest.
FIRST, SHORTEST = 1e-4, 1e-9
#: How near an event a step has to end, of what its function is scaled to; or how short a step is near enough [s].
EVENT, NEAR = 1e-2, 1e-7
#: How firmly friction holds a robot before it stands [-].
FIRMLY = 1e-3


def units(robot: Robot) -> Float[Array, " unknowns"]:
    """What the unknowns are measured in."""
    return jnp.asarray(UNITS + tuple(effect.memory_size or 1.0 for effect in robot.remembering))


def state_of(robot: Robot, y: Float[Array, " unknowns"], stands: Array) -> State:
    x = y * units(robot).astype(y.dtype)
    memory = {effect.name: x[len(UNITS) + k] for k, effect in enumerate(robot.remembering)}
    motor, speed = (jnp.where(stands, 0.0, x[k]) for k in (MOTOR, GROUND))
    return State(x[CURRENT], motor, speed, x[DISCHARGE], memory, x[WINDING])


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


def asked_at(robot: Robot, otherwise: Conditions, segment: Profile, y: Array, stands: Array) -> Asked:
    asked = segment.at(y[CLOCK])
    if asked.current_other is not None:
        battery = dataclasses.replace(robot.battery, current_other=asked.current_other)
        robot = dataclasses.replace(robot, battery=battery)
    conditions = asked.conditions(otherwise)
    state = state_of(robot, y, stands)
    demanded, error = _error(robot, asked, conditions, state)
    controlled = (asked.mode == MOTOR_SPEED) | (asked.mode == SPEED)
    source = jnp.where(
        conditions.battery > 0.5, robot.battery.voltage(0.0, state.discharge), jnp.abs(conditions.voltage)
    )
    voltage = robot.driver.demand(error, y[INTEGRAL] * UNITS[INTEGRAL], demanded, robot.motor.torque_constant)
    wanted = voltage / jnp.maximum(source, 1e-3)
    limited = robot.driver.duty_limited(jnp.clip(wanted, -1.0, 1.0), state.current)
    # What the limits take away, the integral gives back: it does not wind up.
    excess = (wanted - limited) * source / (robot.driver.gain * robot.motor.torque_constant + 1e-12)
    duty = jnp.where(controlled, wanted, conditions.duty)
    sign = jnp.where(conditions.battery > 0.5, 1.0, jnp.sign(conditions.voltage))
    conditions = dataclasses.replace(conditions, duty=jnp.clip(jnp.where(controlled, sign * duty, duty), -1.0, 1.0))
    return Asked(robot, conditions, jnp.where(controlled, error - excess, 0.0), jnp.where(controlled, error, 0.0))


@compiled
def instant(
    robot: Robot, otherwise: Conditions, segment: Profile, y: Array, stands: Array
) -> tuple[Signals, Array, Array, Asked]:
    """Signals of an instant, rates of the unknowns in their units, and of the totals [1/s]."""
    asked = asked_at(robot, otherwise, segment, y, stands)
    state = state_of(robot, y, stands)
    signals = balances.moving(asked.robot, asked.conditions, state)
    winding, housing = (y[k] * UNITS[k] for k in (WINDING, HOUSING))
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
    asked = asked_at(robot, otherwise, segment, y, stands)
    at_rest = asked_at(robot, otherwise, segment, y, jnp.asarray(True))
    state = state_of(robot, y, stands)
    settled = dataclasses.replace(state, current=current_at_rest(at_rest.robot, at_rest.conditions, state))
    firm = firmness(asked.robot, asked.conditions, state)
    return jnp.asarray(firm), jnp.minimum(firm, firmness(at_rest.robot, at_rest.conditions, settled))


class Carry(NamedTuple):
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


def events_of(robot: Robot, otherwise: Conditions, segment: Profile, y: Array, stands: Array) -> Array:
    """Three functions that are positive once their event has happened: standing, breaking away, empty [-]."""
    asked = asked_at(robot, otherwise, segment, y, stands)
    state = state_of(robot, y, stands)
    load = robot.chassis(asked.conditions.configuration)
    rolling = load.radius * state.speed_motor / robot.gearbox.ratio
    slow = 1 - jnp.abs(rolling) / load.speed_still
    if robot.on_shaft:  # nothing slides
        grips = jnp.ones_like(slow)
    else:
        grips = 1 - jnp.abs(rolling - state.speed) / load.ground.friction.speed_static
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
    _, dy, dq, _ = instant(robot, otherwise, segment, y, stands)
    steep = jax.jvp(lambda y: events_of(robot, otherwise, segment, y, stands), (y,), (dy,))[1][which]
    back = jnp.where(steep > 1e-9, -after[which] / jnp.where(steep > 1e-9, steep, 1.0), 0.0)
    back = jnp.where(jnp.abs(back) < h, back, 0.0)
    y, q = y + back * dy, q + back * dq
    # To rest: what is left of the motion is lost where it slid.
    rest = y.at[MOTOR].set(0.0).at[GROUND].set(0.0)
    moved, parked = (instant(robot, otherwise, segment, x, stands)[0] for x in (y, rest))
    halts = after[0] > 0
    lost = jnp.where(halts, energy.stored(robot, moved) - energy.stored(robot, parked), 0.0)
    q = q.at[list(TOTALS).index("sliding")].add(lost)
    return jnp.where(halts, rest, y), q, (stands | halts) & ~(after[1] > 0)


def follow(
    robot: Robot,
    otherwise: Conditions,
    segment: Profile,
    carry: Carry,
    tolerance: float,
    most: int,
) -> Carry:
    """One segment: steps until its end, or until the mission has."""
    length = (segment.time[1] - segment.time[0]).astype(carry.y.dtype)
    first, nearly = carry.accepted + carry.rejected, length * (1 - 1e-12 if carry.y.dtype == float else 1 - 1e-6)
    longest = _step_longest(robot, otherwise)

    def rates(y: Array, stands: Array) -> tuple[Array, Array]:
        _, dy, dq, _ = instant(robot, otherwise, segment, y, stands)
        return dy, dq

    def events(y: Array, stands: Array) -> Array:
        return events_of(robot, otherwise, segment, y, stands)

    def going(c: Carry) -> Array:
        return (c.y[CLOCK] < nearly) & ~c.ended & (c.accepted + c.rejected - first < most)

    def turn(c: Carry) -> Carry:
        left = length - c.y[CLOCK]
        last = c.step >= left * (1 - 1e-9)
        h = jnp.where(last, left, jax.lax.stop_gradient(c.step))
        y, q, u, _ = stages(functools.partial(rates, stands=c.stands), c.y, c.q, h, inverted=True)
        y = y.at[CLOCK].set(jnp.where(last, length, y[CLOCK]))
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
        signals, dy, _, _ = instant(robot, otherwise, segment, y, stands)
        between_ends = _top(c.y[CURRENT], y[CURRENT], h * c.slope, h * dy[CURRENT])
        peaks = jnp.maximum(c.peaks, _peaks_of(robot, signals))
        within = jnp.where(taken, robot.sides * UNITS[CURRENT] * between_ends, -jnp.inf)
        peaks = peaks.at[list(PEAKS).index("current")].max(within)
        flags, low = _flags(robot, signals, c.low, jnp.where(taken, h, 0.0))
        tripped = low > robot.battery.delay_cutoff
        failed = c.failed | (~good & (h <= SHORTEST))
        ended = c.ended | tripped | (event & happened[2]) | failed
        now = (robot, otherwise, segment, y, stands)
        events_now = rarely(event, events_of, now, jnp.where(taken, after, c.events))
        kept, buffer = c.kept, c.buffer
        if buffer is not None:
            at = jnp.where(taken, kept, buffer[0].shape[0])  # beyond the end: dropped
            buffer = tuple(b.at[at].set(r, mode="drop") for b, r in zip(buffer, (y, q, stands), strict=True))
        return Carry(
            y=y, q=q, step=step, stands=stands, ended=ended, low=low, peaks=peaks, flags=c.flags | flags,
            events=events_now, accepted=c.accepted + taken, rejected=c.rejected + ~taken, failed=failed,
            kept=kept + taken, buffer=buffer, slope=dy[CURRENT],
        )  # fmt: skip

    # The segment's beginning may have taken away what held the robot.
    y = carry.y.at[CLOCK].set(0.0)
    asked = asked_at(robot, otherwise, segment, y, carry.stands)
    stands = carry.stands & (firmness(asked.robot, asked.conditions, state_of(robot, y, carry.stands)) >= 0)
    step = jnp.minimum(jnp.asarray(FIRST, y.dtype), longest)
    begin = carry._replace(y=y, q=jnp.zeros_like(carry.q), step=step, stands=stands, events=events(y, stands))
    begin = begin._replace(slope=instant(robot, otherwise, segment, y, stands)[1][CURRENT])
    c = jax.lax.while_loop(going, turn, begin)
    failed = c.failed | ((c.y[CLOCK] < nearly) & ~c.ended)
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
