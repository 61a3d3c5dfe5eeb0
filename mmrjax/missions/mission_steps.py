"""Steps of a mission: events that they land on, and one segment of the profile. What acts at an instant is the law's
of its motion: `mission_straight` or `mission_turning`.

For a start and a stop the loop of diffrax with its `Event` takes 1.8 to 2.5 times as long. It takes as many steps of
the same method, and finds neither peaks nor flags (docs/lab/figures.md).
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mmrjax.fidelities.rest import least
from mmrjax.fidelities.result import mask
from mmrjax.missions.profile import Profile
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals
from mmrjax.numerics.rarely import rarely
from mmrjax.numerics.rosenbrock import stages, step_longest

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


class Asked(NamedTuple):
    """What acts on the robot at an instant: the robot with its other consumers, conditions with the duty that the
    controller gives, rate of the controller's integral [rad/s], and the error of the demand [rad/s]; of a robot that
    turns the duties, integrals and errors of either side."""

    robot: Robot
    conditions: Conditions
    integral_rate: Scalar
    error: Scalar


class Law(Protocol):
    """How a robot moves through a mission: unknowns, what acts at an instant, and what is read of it.

    `found` is what `instant` gives of an instant: signals, and whatever else of a robot that turns.

    Attributes:
        TOTALS: what is integrated, and its unit; PEAKS: largest values of any instant, and their unit.
        CLOCK, DISCHARGE, WINDING, HOUSING: places among the unknowns of the time in the segment [s], the charge taken
            [C], and the temperatures [°C], of a robot that turns those of both sides.
        CURRENT, MOTOR, GROUND, HEADING: of currents, motor speeds, speed and heading.
        STOPS: of what is 0 at rest; AT_REST: the room of standing robots of its kind (`rest`, `turning`).
        RESULT: what there is of a run that ends so, of robot, instant and status.
        UNITS: of the unknowns before the memories of effects; LONG: whether an instant takes long to compile.
    """

    TOTALS: Mapping[str, str]
    PEAKS: Mapping[str, str]
    CLOCK: int
    DISCHARGE: int
    WINDING: Any
    HOUSING: Any
    CURRENT: Any
    MOTOR: Any
    GROUND: int
    HEADING: Any
    STOPS: tuple[Any, ...]
    AT_REST: Any
    RESULT: Any
    UNITS: tuple[float, ...]
    LONG: bool

    def units(self, robot: Robot) -> Float[Array, " unknowns"]:
        """What the unknowns are measured in."""
        ...

    def state_of(self, robot: Robot, y: Array, stands: Array) -> Any:
        """The state that the unknowns stand for."""
        ...

    def asked_at(self, robot: Robot, otherwise: Conditions, segment: Profile, y: Array, stands: Array) -> Asked:
        """What acts on the robot."""
        ...

    def instant(
        self, robot: Robot, otherwise: Conditions, segment: Profile, y: Array, stands: Array
    ) -> tuple[Any, Array, Array, Asked]:
        """What there is of an instant, rates of the unknowns in their units, and of the totals [1/s]."""
        ...

    def slowness(self, asked: Asked, y: Array, stands: Array) -> tuple[Scalar, Scalar]:
        """By how much shafts, and what slides, are slower than friction at rest is resolved [-]."""
        ...

    def drawn(self, asked: Asked, y: Array, stands: Array) -> tuple[Scalar, Scalar]:
        """What the motors take from the source [A], and the charge taken [C]."""
        ...

    def stored(self, robot: Robot, found: Any) -> Scalar:
        """Energy in the motion [J]."""
        ...

    def peaks(self, robot: Robot, found: Any) -> dict[str, Scalar]:
        """Values of which `PEAKS` are the largest, of the cells' voltage the negative."""
        ...

    def peaks_within(self, robot: Robot, y: Array, tops: Array) -> dict[str, Scalar]:
        """Those of currents and temperatures, of the sizes of the unknowns within a step."""
        ...

    def over(self, robot: Robot, found: Any) -> dict[str, Scalar]:
        """What an instant exceeds."""
        ...

    def norm(self, error: Array) -> Scalar:
        """Of an error of the unknowns over what is allowed [-]."""
        ...

    def demanded(self, robot: Robot, otherwise: Conditions, segment: Profile) -> Array:
        """What is demanded of each row [rad/s or m/s]."""
        ...

    def status(self, robot: Robot, conditions: Conditions, found: Any) -> Array:
        """Status of a robot that friction does not hold, by its last instant."""
        ...

    def at_places(self, signals: Signals, so_far: dict[str, Array]) -> Signals:
        """Signals over time, with what follows from the totals so far."""
        ...


def _firmly(
    law: Law, robot: Robot, otherwise: Conditions, segment: Profile, y: Array, stands: Array
) -> tuple[Array, Array]:
    """How firmly friction would hold the robot now, and with what current will flow then too: a controller asks for
    less once there is no error."""
    asked = law.asked_at(robot, otherwise, segment, y, stands)
    at_rest = law.asked_at(robot, otherwise, segment, y, jnp.asarray(True))
    current = law.AT_REST.current_at_rest(at_rest.robot, at_rest.conditions, law.state_of(at_rest.robot, y, stands))
    settled = y.at[law.CURRENT].set(current / law.UNITS[0])
    firm = _firm(law, asked, y, stands)
    return firm, least(firm, _firm(law, at_rest, settled, stands))


def _firm(law: Law, asked: Asked, y: Array, stands: Array) -> Array:
    """How firmly friction would hold the robot [-], see `rest.firmness`."""
    return jnp.asarray(law.AT_REST.firmness(asked.robot, asked.conditions, law.state_of(asked.robot, y, stands)))


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


def _cell_above(law: Law, asked: Asked, y: Array, stands: Array) -> Scalar:
    """By how much a cell is above its cut-off [V]; on an external supply far."""
    battery = asked.robot.battery
    cell = battery.voltage_cell(*law.drawn(asked, y, stands))
    return jnp.where(asked.conditions.battery > 0.5, cell - battery.voltage_cutoff, 10.0)


def events_of(
    law: Law, robot: Robot, otherwise: Conditions, segment: Profile, y: Array, stands: Array, below: Array
) -> Float[Array, " events"]:
    """Functions that are positive once their event of `EVENTS` has happened [-]."""
    asked = law.asked_at(robot, otherwise, segment, y, stands)
    slow, grips = law.slowness(asked, y, stands)
    near = stands | ((slow > -1) & (grips > -1))

    none = -jnp.ones_like(slow)
    here = (robot, otherwise, segment, y, stands)
    firm, stays = rarely(near, functools.partial(_firmly, law), here, (none, none))
    standing = least(slow, grips, stays - FIRMLY)
    battery, discharge = asked.robot.battery, law.drawn(asked, y, stands)[1]
    empty = jnp.where(asked.conditions.battery > 0.5, (discharge / battery.capacity - 1) / OF_CHARGE, -1.0)
    above = _cell_above(law, asked, y, stands)
    falls, recovers = jnp.where(below, -1.0, -above / OF_CELL), jnp.where(below, (above - RECOVERED) / OF_CELL, -1.0)
    return jnp.stack([jnp.where(stands, -1.0, standing), jnp.where(stands, -firm, -1.0), empty, falls, recovers])


def _onto(
    law: Law,
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
    _, dy, dq, _ = law.instant(robot, otherwise, segment, y, stands)
    steep = jax.jvp(lambda y: events_of(law, robot, otherwise, segment, y, stands, below), (y,), (dy,))[1]
    back = jnp.where(steep > 1e-9, -after / jnp.where(steep > 1e-9, steep, 1.0), 0.0)
    back = jnp.where(jnp.abs(back) < h, back, 0.0)
    which = jnp.argmin(jnp.where(after > 0, back, jnp.inf))
    back = back[which]
    y, q = y + back * dy, q + back * dq
    # To rest: what is left of the motion is lost where it slid.
    rest = y
    for k in law.STOPS:
        rest = rest.at[k].set(0.0)
    moved, parked = (law.instant(robot, otherwise, segment, x, stands)[0] for x in (y, rest))
    halts = which == STANDS
    lost = jnp.where(halts, law.stored(robot, moved) - law.stored(robot, parked), 0.0)
    q = q.at[list(law.TOTALS).index("sliding")].add(lost)
    stands = (stands | halts) & (which != BREAKS_AWAY)
    below = (below | (which == FALLS)) & (which != RECOVERS)
    return jnp.where(halts, rest, y), q, stands, below, which, back


def follow(
    law: Law,
    robot: Robot,
    otherwise: Conditions,
    segment: Profile,
    carry: Carry,
    tolerance: Scalar,
    most: int,
) -> Carry:
    """One segment: steps until its end, or until the mission has."""
    length = (segment.time[1] - segment.time[0]).astype(carry.y.dtype)
    limit = step_longest(robot, otherwise)
    leg = _Leg(law, robot, otherwise, segment, tolerance, length, jnp.inf if limit is None else limit)
    first, nearly = carry.accepted + carry.rejected, length * (1 - 1e-12 if carry.y.dtype == float else 1 - 1e-6)

    def going(c: Carry) -> Array:
        return (c.y[law.CLOCK] < nearly) & ~c.ended & (c.accepted + c.rejected - first < most)

    def turn(c: Carry) -> Carry:
        tried = leg.tried(c)
        return leg.after(c, tried.h, tried.good, leg.landed(c, tried))

    c = jax.lax.while_loop(going, turn, leg.begin(carry))
    failed = c.failed | ((c.y[law.CLOCK] < nearly) & ~c.ended)
    return c._replace(failed=failed, ended=c.ended | failed)


class _Tried(NamedTuple):
    """A step before it is known whether it counts.

    Attributes:
        y, q: unknowns and integrals at its end; h: its length [s]; last: True if it ends the segment or trips.
        good: its error is small enough; grown: the length that its error allows next [s].
    """

    y: Array
    q: Array
    h: Array
    last: Array
    good: Array
    grown: Array


class _Landed(NamedTuple):
    """A step with the event that it lands on.

    Attributes:
        y, q, stands, below, low: as of `Carry`, at its end; which: the event, -1 for none.
        cut_off: the cells stayed below their cut-off; after: functions of events at the end of the step tried.
        taken: the step counts; event: it lands on an event; step: length of the next one [s].
    """

    y: Array
    q: Array
    stands: Array
    below: Array
    low: Array
    which: Array
    cut_off: Array
    after: Array
    taken: Array
    event: Array
    step: Array


class _Leg(NamedTuple):
    """One segment of a mission, with its length and the longest step [s]."""

    law: Law
    robot: Robot
    otherwise: Conditions
    segment: Profile
    tolerance: Scalar
    length: Array
    longest: Array | float

    def begin(self, carry: Carry) -> Carry:
        """The state at the beginning of the segment."""
        law, robot, otherwise, segment, *_ = self
        # The segment's beginning may have taken away what held the robot.
        y = carry.y.at[law.CLOCK].set(0.0)
        asked = law.asked_at(robot, otherwise, segment, y, carry.stands)
        stands = carry.stands & (_firm(law, asked, y, carry.stands) >= 0)
        # And it may have lifted the cells above their cut-off, or pressed them below.
        below = jnp.asarray(_cell_above(law, asked, y, stands) < 0)
        low = jnp.where(below & carry.below, carry.low, 0.0)
        step = jnp.minimum(jnp.asarray(FIRST, y.dtype), self.longest)
        events = events_of(law, robot, otherwise, segment, y, stands, below)
        cut_off = carry.cut_off | _stayed_below(robot, below, low)
        begin = carry._replace(
            y=y, q=jnp.zeros_like(carry.q), step=step, stands=stands, below=below, low=low, cut_off=cut_off,
            ended=carry.ended | cut_off, events=events,
        )  # fmt: skip
        return begin._replace(slope=law.instant(robot, otherwise, segment, y, stands)[1])

    def tried(self, c: Carry) -> _Tried:
        """A step of the length that is planned, at most to the segment's end or to the cut-off of the cells."""
        law, robot, otherwise, segment, *_ = self

        def rates(y: Array) -> tuple[Array, Array]:
            _, dy, dq, _ = law.instant(robot, otherwise, segment, y, c.stands)
            return dy, dq

        to_end = self.length - c.y[law.CLOCK]
        to_trip = jnp.where(c.below, robot.battery.delay_cutoff - c.low, jnp.inf)
        left, trips = jnp.minimum(to_end, to_trip), to_trip < to_end
        last = c.step >= left * (1 - 1e-9)
        h = jnp.where(last, left, jax.lax.stop_gradient(c.step))
        y, q, u, _ = stages(rates, c.y, c.q, h, looped=law.LONG)
        y = y.at[law.CLOCK].set(jnp.where(last & ~trips, self.length, y[law.CLOCK]))
        scale = self.tolerance * (1 + jnp.maximum(jnp.abs(c.y), jnp.abs(y)))
        size = law.norm(u[-1] / scale)
        size = jax.lax.stop_gradient(jnp.where(jnp.isfinite(size), size, 1e6))
        grown = h * jnp.clip(0.9 * jnp.maximum(size, 1e-12) ** -0.25, 0.1, 6.0)
        return _Tried(y, q, h, last, size <= 1, grown)

    def landed(self, c: Carry, tried: _Tried) -> _Landed:
        """The step, on the first event in it if there is one."""
        law, robot, otherwise, segment, *_ = self
        y, q, h, last, good, grown = tried
        after = events_of(law, robot, otherwise, segment, y, c.stands, c.below)
        happened = after > 0
        between = happened & (c.events < 0)
        # The next one is to end a little beyond it.
        share = jnp.where(between, (c.events - EVENT / 2) / jnp.where(between, c.events - after, 1.0), 1.0)
        far = jnp.any(between & (after > EVENT)) & (h > NEAR)
        taken = good & ~far
        event = taken & jnp.any(happened)
        here = (robot, otherwise, segment, y, q, c.stands, c.below, after, h)
        none = (y, q, c.stands, c.below, jnp.asarray(-1, jnp.argmin(after).dtype), jnp.zeros_like(h))
        y, q, stands, below, which, back = rarely(event, functools.partial(_onto, law), here, none)
        y, q = jnp.where(taken, y, c.y), jnp.where(taken, q, c.q)
        stands = jnp.where(taken, stands, c.stands)
        low = jnp.where(below & c.below, c.low + jnp.where(taken, h + back, 0.0), 0.0)
        cut_off = taken & _stayed_below(robot, below, low)
        # After a step cut short by the segment's end or an event, the length from before it.
        step = jnp.where(taken, jnp.where(last, jnp.maximum(grown, c.step), grown), grown)
        step = jnp.where(good & far, h * jnp.clip(jnp.min(share), 0.02, 0.99), step)
        step = jnp.where(event, FIRST, step)
        step = jnp.clip(jax.lax.stop_gradient(step), SHORTEST, self.longest)
        return _Landed(y, q, stands, below, low, which, cut_off, after, taken, event, step)

    def after(self, c: Carry, h: Array, good: Array, landed: _Landed) -> Carry:
        """The state after a step of length h [s], with what it adds to peaks, flags and the course."""
        law, robot, otherwise, segment, *_ = self
        y, stands, below, taken, cut_off = landed.y, landed.stands, landed.below, landed.taken, landed.cut_off
        found, dy, _, _ = law.instant(robot, otherwise, segment, y, stands)
        # Current and heat may be largest within the step. Not so speeds: at the end of a long step their slopes are
        # those of what is stiff in them, and a cubic would swing.
        tops = _top(c.y, y, h * c.slope, h * dy)
        within = law.peaks_within(robot, y, tops)
        highest = jnp.stack([jnp.where(taken, within.get(name, -jnp.inf), -jnp.inf) for name in law.PEAKS])
        peaks = jnp.maximum(jnp.maximum(c.peaks, _peaks_of(law, robot, found)), highest)
        hot = taken & (within["temperature"] > robot.motor.temperature_limit)
        flags = _flags(law, robot, found, cut_off) | mask({"too_hot": hot})
        failed = c.failed | (~good & (h <= SHORTEST))
        ended = c.ended | cut_off | (landed.which == EMPTY) | failed
        now = (robot, otherwise, segment, y, stands, below)
        unchanged = jnp.where(taken, landed.after, c.events)
        events_now = rarely(landed.event, functools.partial(events_of, law), now, unchanged)
        kept, buffer = c.kept, c.buffer
        if buffer is not None:
            at = jnp.where(taken, kept, buffer[0].shape[0])  # beyond the end: dropped
            row = (y, landed.q, stands, jnp.where(cut_off, MARKS.index("cut_off"), landed.which))
            buffer = tuple(b.at[at].set(r, mode="drop") for b, r in zip(buffer, row, strict=True))
        return Carry(
            y=y, q=landed.q, step=landed.step, stands=stands, ended=ended, below=below, low=landed.low,
            cut_off=cut_off, peaks=peaks, flags=c.flags | flags,
            events=events_now, accepted=c.accepted + taken, rejected=c.rejected + ~taken, failed=failed,
            kept=kept + taken, buffer=buffer, slope=dy,
        )  # fmt: skip


def _stayed_below(robot: Robot, below: Array, low: Array) -> Array:
    """Whether the cells have been below their cut-off for as long as they may."""
    rounding = 8 * jnp.finfo(low.dtype).eps
    return below & (low >= robot.battery.delay_cutoff * (1 - rounding))


def _peaks_of(law: Law, robot: Robot, found: Any) -> Array:
    each = law.peaks(robot, found)
    return jnp.stack([jnp.asarray(each[name]) * jnp.ones(()) for name in law.PEAKS])


def _flags(law: Law, robot: Robot, found: Any, cut_off: Array) -> Array:
    """What an instant exceeds.

    A start draws more than the cells bear for an instant; only what lasts counts.
    """
    over = law.over(robot, found)
    over.pop("slips")  # every start slips for an instant; of a segment it counts at its end
    return mask({**over, "cut_off": cut_off})
