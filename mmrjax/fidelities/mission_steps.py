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
from mmrjax.fidelities.rest import current_at_rest, firmness
from mmrjax.fidelities.result import exceeded, mask
from mmrjax.fidelities.rosenbrock import stages
from mmrjax.params import Scalar
from mmrjax.profile import MOTOR_SPEED, SPEED, Instant, Profile
from mmrjax.rarely import rarely
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
#: What steps land on: standing and breaking away, an empty battery, cells falling below their cut-off and recovering.
EVENTS = ("stands", "breaks_away", "battery_empty", "below_cut_off", "above_cut_off")
STANDS, BREAKS_AWAY, EMPTY, FALLS, RECOVERS = range(len(EVENTS))
#: What a row over time may mark: an event, or that the cells have been below their cut-off for as long as they may,
#: which is timed from its event.
MARKS = (*EVENTS, "cut_off")
#: How near an event a step has to end, of what its function is scaled to; or how short a step is near enough [s].
EVENT, NEAR = 1e-2, 1e-7
#: Scales of events: charge, of the capacity [-]; voltage of a cell [V]. From an event at most `EVENT` of its scale
#: away a Newton step leads to it, along which rates are constant.
OF_CHARGE, OF_CELL = 1e-3, 1e-3
#: How far above its cut-off a cell has recovered [V]: beyond the rounding of the crossing.
RECOVERED = 1e-6
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
    below: Array  # whether the cells are below their cut-off
    low: Array  # for how long they have been [s]
    cut_off: Array  # whether they have been for as long as they may
    peaks: Array
    flags: Array
    events: Array
    accepted: Array
    rejected: Array
    failed: Array
    slope: Array  # of the unknowns, in their units [1/s]
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


def _cell_above(asked: Asked, state: State) -> Scalar:
    """By how much a cell is above its cut-off [V]; on an external supply far."""
    motors = asked.robot.sides * state.current * asked.robot.driver.duty_limited(asked.conditions.duty, state.current)
    battery = asked.robot.battery
    cell = battery.voltage_cell(motors, state.discharge)
    return jnp.where(asked.conditions.battery > 0.5, cell - battery.voltage_cutoff, 10.0)


def events_of(
    robot: Robot, otherwise: Conditions, segment: Profile, y: Array, stands: Array, below: Array
) -> Float[Array, " events"]:
    """Functions that are positive once their event of `EVENTS` has happened [-]."""
    asked = asked_at(robot, otherwise, segment, y, stands)
    state = state_of(robot, y, stands)
    load = robot.chassis(asked.conditions.configuration)
    rolling = load.radius * state.speed_motor / robot.gearbox.ratio
    slow = 1 - jnp.abs(rolling) / load.speed_still
    grips = 1 - jnp.abs(rolling - state.speed) / load.speed_grip
    near = stands | ((slow > -1) & (grips > -1))

    none = -jnp.ones_like(slow)
    firm, stays = rarely(near, _firmly, (robot, otherwise, segment, y, stands), (none, none))
    standing = jnp.minimum(jnp.minimum(slow, grips), stays - FIRMLY)
    battery = asked.robot.battery
    empty = jnp.where(asked.conditions.battery > 0.5, (state.discharge / battery.capacity - 1) / OF_CHARGE, -1.0)
    above = _cell_above(asked, state)
    falls, recovers = jnp.where(below, -1.0, -above / OF_CELL), jnp.where(below, (above - RECOVERED) / OF_CELL, -1.0)
    return jnp.stack([jnp.where(stands, -1.0, standing), jnp.where(stands, -firm, -1.0), empty, falls, recovers])


def _onto(
    robot: Robot,
    otherwise: Conditions,
    segment: Profile,
    y: Array,
    q: Array,
    stands: Array,
    below: Array,
    after: Array,
    h: Array,
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Onto the earliest event by a Newton step in time, which carries the derivative of its moment (the implicit
    function theorem: dt = -dg / (∂g/∂y y')); and what it changes.

    Returns:
        Unknowns, integrals, whether the robot stands, whether the cells are below their cut-off; the event, and the
        step in time [s].
    """
    _, dy, dq, _ = instant(robot, otherwise, segment, y, stands)
    steep = jax.jvp(lambda y: events_of(robot, otherwise, segment, y, stands, below), (y,), (dy,))[1]
    back = jnp.where(steep > 1e-9, -after / jnp.where(steep > 1e-9, steep, 1.0), 0.0)
    back = jnp.where(jnp.abs(back) < h, back, 0.0)
    which = jnp.argmin(jnp.where(after > 0, back, jnp.inf))
    back = back[which]
    y, q = y + back * dy, q + back * dq
    # To rest: what is left of the motion is lost where it slid.
    rest = y.at[MOTOR].set(0.0).at[GROUND].set(0.0)
    moved, parked = (instant(robot, otherwise, segment, x, stands)[0] for x in (y, rest))
    halts = which == STANDS
    lost = jnp.where(halts, energy.stored(robot, moved) - energy.stored(robot, parked), 0.0)
    q = q.at[list(TOTALS).index("sliding")].add(lost)
    stands = (stands | halts) & (which != BREAKS_AWAY)
    below = (below | (which == FALLS)) & (which != RECOVERS)
    return jnp.where(halts, rest, y), q, stands, below, which, back


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

    def left_below(c: Carry) -> Array:
        """How much longer the cells may stay below their cut-off [s]."""
        return jnp.where(c.below, robot.battery.delay_cutoff - c.low, jnp.inf)

    def going(c: Carry) -> Array:
        return (c.y[CLOCK] < nearly) & ~c.ended & (c.accepted + c.rejected - first < most)

    def turn(c: Carry) -> Carry:
        to_end, to_trip = length - c.y[CLOCK], left_below(c)
        left, trips = jnp.minimum(to_end, to_trip), to_trip < to_end
        last = c.step >= left * (1 - 1e-9)
        h = jnp.where(last, left, jax.lax.stop_gradient(c.step))
        y, q, u, _ = stages(functools.partial(rates, stands=c.stands), c.y, c.q, h, inverted=True)
        y = y.at[CLOCK].set(jnp.where(last & ~trips, length, y[CLOCK]))
        scale = tolerance * (1 + jnp.maximum(jnp.abs(c.y), jnp.abs(y)))
        size = optx.rms_norm(u[-1] / scale) * (y.shape[0] / len(UNITS)) ** 0.5
        size = jax.lax.stop_gradient(jnp.where(jnp.isfinite(size), size, 1e6))
        good = size <= 1
        grown = h * jnp.clip(0.9 * jnp.maximum(size, 1e-12) ** -0.25, 0.1, 6.0)
        # Events: steps land on the first of them.
        after = events_of(robot, otherwise, segment, y, c.stands, c.below)
        happened = after > 0
        between = happened & (c.events < 0)
        # The next one is to end a little beyond it.
        share = jnp.where(between, (c.events - EVENT / 2) / jnp.where(between, c.events - after, 1.0), 1.0)
        far = jnp.any(between & (after > EVENT)) & (h > NEAR)
        taken = good & ~far
        event = taken & jnp.any(happened)
        here = (robot, otherwise, segment, y, q, c.stands, c.below, after, h)
        none = (y, q, c.stands, c.below, jnp.asarray(-1, jnp.argmin(after).dtype), jnp.zeros_like(h))
        y, q, stands, below, which, back = rarely(event, _onto, here, none)
        y, q = jnp.where(taken, y, c.y), jnp.where(taken, q, c.q)
        stands = jnp.where(taken, stands, c.stands)
        low = jnp.where(below & c.below, c.low + jnp.where(taken, h + back, 0.0), 0.0)
        cut_off = taken & _stayed_below(robot, below, low)
        # After a step cut short by the segment's end or an event, the length from before it.
        step = jnp.where(taken, jnp.where(last, jnp.maximum(grown, c.step), grown), grown)
        step = jnp.where(good & far, h * jnp.clip(jnp.min(share), 0.02, 0.99), step)
        step = jnp.where(event, FIRST, step)
        step = jnp.clip(jax.lax.stop_gradient(step), SHORTEST, longest)
        signals, dy, _, _ = instant(robot, otherwise, segment, y, stands)
        # Current and heat may be largest within the step. Not so speeds: at the end of a long step their slopes are
        # those of what is stiff in them, and a cubic would swing.
        tops = _top(c.y, y, h * c.slope, h * dy)
        within = {
            "current": robot.sides * UNITS[CURRENT] * tops[CURRENT],
            "temperature": jnp.where(y[WINDING] > 0, UNITS[WINDING] * tops[WINDING], -jnp.inf),
        }
        highest = jnp.stack([jnp.where(taken, within.get(name, -jnp.inf), -jnp.inf) for name in PEAKS])
        peaks = jnp.maximum(jnp.maximum(c.peaks, _peaks_of(robot, signals)), highest)
        hot = taken & (within["temperature"] > robot.motor.temperature_limit)
        flags = _flags(robot, signals, cut_off) | mask({"too_hot": hot})
        failed = c.failed | (~good & (h <= SHORTEST))
        ended = c.ended | cut_off | (which == EMPTY) | failed
        now = (robot, otherwise, segment, y, stands, below)
        events_now = rarely(event, events_of, now, jnp.where(taken, after, c.events))
        kept, buffer = c.kept, c.buffer
        if buffer is not None:
            at = jnp.where(taken, kept, buffer[0].shape[0])  # beyond the end: dropped
            row = (y, q, stands, jnp.where(cut_off, MARKS.index("cut_off"), which))
            buffer = tuple(b.at[at].set(r, mode="drop") for b, r in zip(buffer, row, strict=True))
        return Carry(
            y=y, q=q, step=step, stands=stands, ended=ended, below=below, low=low, cut_off=cut_off, peaks=peaks,
            flags=c.flags | flags,
            events=events_now, accepted=c.accepted + taken, rejected=c.rejected + ~taken, failed=failed,
            kept=kept + taken, buffer=buffer, slope=dy,
        )  # fmt: skip

    # The segment's beginning may have taken away what held the robot.
    y = carry.y.at[CLOCK].set(0.0)
    asked = asked_at(robot, otherwise, segment, y, carry.stands)
    stands = carry.stands & (firmness(asked.robot, asked.conditions, state_of(robot, y, carry.stands)) >= 0)
    # And it may have lifted the cells above their cut-off, or pressed them below.
    below = jnp.asarray(_cell_above(asked, state_of(robot, y, stands)) < 0)
    low = jnp.where(below & carry.below, carry.low, 0.0)
    step = jnp.minimum(jnp.asarray(FIRST, y.dtype), longest)
    events = events_of(robot, otherwise, segment, y, stands, below)
    cut_off = carry.cut_off | _stayed_below(robot, below, low)
    begin = carry._replace(
        y=y, q=jnp.zeros_like(carry.q), step=step, stands=stands, below=below, low=low, cut_off=cut_off,
        ended=carry.ended | cut_off, events=events,
    )  # fmt: skip
    begin = begin._replace(slope=instant(robot, otherwise, segment, y, stands)[1])
    c = jax.lax.while_loop(going, turn, begin)
    failed = c.failed | ((c.y[CLOCK] < nearly) & ~c.ended)
    return c._replace(failed=failed, ended=c.ended | failed)


def _stayed_below(robot: Robot, below: Array, low: Array) -> Array:
    """Whether the cells have been below their cut-off for as long as they may."""
    rounding = 8 * jnp.finfo(low.dtype).eps
    return below & (low >= robot.battery.delay_cutoff * (1 - rounding))


def _step_longest(robot: Robot, conditions: Conditions) -> Scalar:
    """The longest step that still resolves every effect with a memory [s]."""
    limits = [jnp.asarray(effect.step_longest(robot, conditions)) for effect in robot.remembering]
    return jax.lax.stop_gradient(jnp.min(jnp.stack([*limits, jnp.asarray(jnp.inf)])))


def _flags(robot: Robot, signals: Signals, cut_off: Array) -> Array:
    """What an instant exceeds.

    A start draws more than the cells bear for an instant; only what lasts counts.
    """
    over = exceeded(robot, signals)
    over.pop("slips")  # every start slips for an instant; of a segment it counts at its end
    hot = jnp.asarray(signals.temperature) > robot.motor.temperature_limit
    return mask({**over, "cut_off": cut_off, "too_hot": hot})
