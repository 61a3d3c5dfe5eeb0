"""Steps of a mission: integration over one segment of the profile, with steps that end exactly at events.

The law of motion gives the equations of an instant: `mission_straight` or `mission_turning`. For a start and a stop
the loop of diffrax with its `Event` takes 1.8 to 2.5 times as long. It takes as many steps of the same method, and
finds neither peaks nor flags (docs/lab/figures.md).
"""

from __future__ import annotations

import functools
from types import ModuleType
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mmrjax.fidelities.base import flag_mask
from mmrjax.fidelities.rest import smallest_of
from mmrjax.missions.profile import Profile
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.numerics.batch_flow import compute_if_needed
from mmrjax.numerics.rosenbrock import error_across_kink, rosenbrock_stages, step_longest

#: Most steps of one segment. A mission that needs more ends as `failed`.
MOST_STEPS = 4096
#: The first step of a segment [s], and the shortest.
FIRST, SHORTEST = 1e-4, 1e-9
#: Events that steps land on: stopping, breaking away, an empty battery, cells falling below their cut-off,
#: recovering.
EVENTS = ("stands", "breaks_away", "battery_empty", "below_cut_off", "above_cut_off")
STANDS, BREAKS_AWAY, EMPTY, FALLS, RECOVERS = range(len(EVENTS))
#: Marks of a row over time: an event, or the end of the permitted time below the cut-off, which is measured from its
#: event.
MARKS = (*EVENTS, "cut_off")
#: Largest distance of a step's end from an event, relative to the event's scale; or the step length that suffices
#: [s].
EVENT, NEAR = 1e-2, 1e-7
#: Scales of events: charge, of the capacity [-]; voltage of a cell [V]. Within `EVENT` of its scale a Newton step
#: leads to the event, with constant rates.
OF_CHARGE, OF_CELL = 1e-3, 1e-3
#: Margin above the cut-off of a recovered cell [V]: beyond the rounding of the crossing.
RECOVERED = 1e-6
#: Margin of the friction that holds a robot before it counts as standing [-].
FIRMLY = 1e-3


class SegmentInputs(NamedTuple):
    """Inputs of the robot at an instant.

    The robot with its other consumers, the conditions with the duty of the controller, the rate of the controller's
    integral [rad/s], and the error of the demand [rad/s]. For a robot that turns, duty, rate and error of each side.
    """

    robot: Robot
    conditions: Conditions
    integral_rate: Scalar
    error: Scalar


#: Equations of motion of a robot in a mission: the module `mission_straight`, or `mission_turning` with the same
#: names. Docstrings are in `mission_straight`. `signals` or `travel` is the first result of `instant`: the signals
#: and, for a robot that turns, its motion.
#: TOTALS, PEAKS: units of the integrated quantities, and of those whose largest values are recorded.
#: CLOCK, DISCHARGE, WINDING, HOUSING, CURRENT, MOTOR, GROUND, HEADING: positions among the unknowns. They are the
#: time in the segment [s], charge taken [C], temperatures [°C], currents, motor speeds, speed and heading.
#: STOPS: positions of the unknowns that are 0 at rest. AT_REST: module for standing robots of this kind.
#: RESULT: function (robot, instant, status) that returns the result at the end of a run.
#: UNITS: units of the unknowns, except memories of effects. LONG: True if an instant takes long to compile.
MotionLaw = ModuleType


def _holding_margins(
    law: MotionLaw, robot: Robot, otherwise: Conditions, segment: Profile, y: Array, stands: Array
) -> tuple[Array, Array]:
    """Margin of the friction that would hold the robot at rest: now, and with the settled current.

    A controller lowers its demand once the error has vanished.
    """
    inputs = law.inputs_at(robot, otherwise, segment, y, stands)
    inputs_at_rest = law.inputs_at(robot, otherwise, segment, y, jnp.asarray(True))
    current = law.AT_REST.current_at_rest(
        inputs_at_rest.robot, inputs_at_rest.conditions, law.state_of(inputs_at_rest.robot, y, stands)
    )
    settled_unknowns = y.at[law.CURRENT].set(current / law.UNITS[0])
    margin_now = _holding_margin(law, inputs, y, stands)
    return margin_now, smallest_of(margin_now, _holding_margin(law, inputs_at_rest, settled_unknowns, stands))


def _holding_margin(law: MotionLaw, inputs: SegmentInputs, y: Array, stands: Array) -> Array:
    """Margin of the friction that would hold the robot at rest [-], see `rest.holding_margin`."""
    return law.AT_REST.holding_margin(inputs.robot, inputs.conditions, law.state_of(inputs.robot, y, stands))


class IntegrationState(NamedTuple):
    y: Array
    q: Array
    step: Array
    stands: Array
    ended: Array  # True after the end: empty, cut off or failed
    below: Array  # True while the cells are below their cut-off
    time_below: Array  # time since they fell below [s]
    cut_off: Array  # True once that time exceeds the permitted one
    peaks: Array
    flags: Array
    events: Array
    accepted: Array
    rejected: Array
    failed: Array
    slope: Array  # of the unknowns, in their units [1/s]
    kept: Array
    buffer: tuple[Array, ...] | None


def _peak_between(before: Array, after: Array, rise: Array, fall: Array) -> Array:
    """Largest magnitude of a curve between two values, by a cubic with the slopes `rise` and `fall` at its ends."""
    sign = jnp.sign(after)
    x0, x1, d0, d1 = sign * before, sign * after, sign * rise, sign * fall
    has_peak = (d0 > 0) & (d1 < 0)
    a, b = 3 * (d0 + d1 - 2 * (x1 - x0)), 2 * (3 * (x1 - x0) - 2 * d0 - d1)
    root = b * b - 4 * a * d0
    has_peak &= root > 0
    # The root in 0..1, in the form that stays finite if the cubic is a parabola.
    denominator = b - jnp.sqrt(jnp.where(has_peak, root, 1.0))
    t = jnp.clip(-2 * d0 / jnp.where(jnp.abs(denominator) > 1e-12, denominator, -1e-12), 0.0, 1.0)
    peak = x0 + t * (d0 + t * (b / 2 + t * a / 3))
    return jnp.where(has_peak, jnp.maximum(peak, jnp.maximum(x0, x1)), jnp.maximum(x0, x1))


def _cell_voltage_margin(law: MotionLaw, inputs: SegmentInputs, y: Array, stands: Array) -> Array:
    """Margin of a cell above its cut-off voltage [V]. Large on an external supply."""
    battery = inputs.robot.battery
    cell_voltage = battery.voltage_cell(*law.supply_current_and_charge(inputs, y, stands))
    return jnp.where(inputs.conditions.battery > 0.5, cell_voltage - battery.voltage_cutoff, 10.0)


def event_functions(
    law: MotionLaw, robot: Robot, otherwise: Conditions, segment: Profile, y: Array, stands: Array, below: Array
) -> Float[Array, " events"]:
    """Functions that become positive when their event (see `EVENTS`) has happened [-]."""
    inputs = law.inputs_at(robot, otherwise, segment, y, stands)
    shaft_slowness, grip_slowness = law.slowness(inputs, y, stands)
    is_near = stands | ((shaft_slowness > -1) & (grip_slowness > -1))

    far = -jnp.ones_like(shaft_slowness)
    law_inputs = (robot, otherwise, segment, y, stands)
    margin_now, margin_settled = compute_if_needed(
        is_near, functools.partial(_holding_margins, law), law_inputs, (far, far)
    )
    standing = smallest_of(shaft_slowness, grip_slowness, margin_settled - FIRMLY)
    battery = inputs.robot.battery
    discharge = law.supply_current_and_charge(inputs, y, stands)[1]
    empty = jnp.where(inputs.conditions.battery > 0.5, (discharge / battery.capacity - 1) / OF_CHARGE, -1.0)
    cell_margin = _cell_voltage_margin(law, inputs, y, stands)
    falls, recovers = (
        jnp.where(below, -1.0, -cell_margin / OF_CELL),
        jnp.where(below, (cell_margin - RECOVERED) / OF_CELL, -1.0),
    )
    return jnp.stack(
        [jnp.where(stands, -1.0, standing), jnp.where(stands, -margin_now, -1.0), empty, falls, recovers]
    )


def _move_to_event(
    law: MotionLaw,
    robot: Robot,
    otherwise: Conditions,
    segment: Profile,
    y: Array,
    q: Array,
    stands: Array,
    below: Array,
    events: Array,
    h: Array,
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Moves to the earliest event by a Newton step in time, and applies its change of state.

    The step includes the derivative of the event's time (implicit function theorem: dt = -dg / (∂g/∂y y')).

    Returns:
        Unknowns, integrals, True if the robot stands, True if the cells are below their cut-off, the event, and the
        step in time [s].
    """
    _, dy, dq, _ = law.instant(robot, otherwise, segment, y, stands)
    event_rates = jax.jvp(lambda y: event_functions(law, robot, otherwise, segment, y, stands, below), (y,), (dy,))[1]
    time_shift = jnp.where(event_rates > 1e-9, -events / jnp.where(event_rates > 1e-9, event_rates, 1.0), 0.0)
    time_shift = jnp.where(jnp.abs(time_shift) < h, time_shift, 0.0)
    event_index = jnp.argmin(jnp.where(events > 0, time_shift, jnp.inf))
    time_shift = time_shift[event_index]
    y, q = y + time_shift * dy, q + time_shift * dq
    # At a stop, the remaining kinetic energy is dissipated by the sliding contacts.
    y_at_rest = y
    for k in law.STOPS:
        y_at_rest = y_at_rest.at[k].set(0.0)
    instant_at_event, instant_at_rest = (law.instant(robot, otherwise, segment, x, stands)[0] for x in (y, y_at_rest))
    halts = event_index == STANDS
    stored_energy_lost = jnp.where(
        halts, law.stored(robot, instant_at_event) - law.stored(robot, instant_at_rest), 0.0
    )
    q = q.at[list(law.TOTALS).index("sliding")].add(stored_energy_lost)
    stands = (stands | halts) & (event_index != BREAKS_AWAY)
    below = (below | (event_index == FALLS)) & (event_index != RECOVERS)
    return jnp.where(halts, y_at_rest, y), q, stands, below, event_index, time_shift


def integrate_segment(
    law: MotionLaw,
    robot: Robot,
    otherwise: Conditions,
    segment: Profile,
    carry: IntegrationState,
    tolerance: Scalar,
) -> IntegrationState:
    """Integrates one segment until its end, or until the mission ends."""
    length = (segment.time[1] - segment.time[0]).astype(carry.y.dtype)
    limit = step_longest(robot, otherwise)
    integrator = _SegmentIntegrator(
        law, robot, otherwise, segment, tolerance, length, jnp.inf if limit is None else limit
    )
    steps_before = carry.accepted + carry.rejected
    nearly_length = length * (1 - 1e-12 if carry.y.dtype == float else 1 - 1e-6)

    def is_running(c: IntegrationState) -> Array:
        return (c.y[law.CLOCK] < nearly_length) & ~c.ended & (c.accepted + c.rejected - steps_before < MOST_STEPS)

    def take_step(c: IntegrationState) -> IntegrationState:
        return integrator.after(c, *integrator.step_to_event(c))

    c = jax.lax.while_loop(is_running, take_step, integrator.begin(carry))
    failed = c.failed | ((c.y[law.CLOCK] < nearly_length) & ~c.ended)
    return c._replace(failed=failed, ended=c.ended | failed)


class _SegmentIntegrator(NamedTuple):
    """Integrator of one segment, with its length and the longest step [s]."""

    law: MotionLaw
    robot: Robot
    otherwise: Conditions
    segment: Profile
    tolerance: Scalar
    length: Array
    longest: Array | float

    def begin(self, carry: IntegrationState) -> IntegrationState:
        """State at the start of the segment."""
        law, robot, otherwise, segment, *_ = self
        # The inputs of the segment may exceed the friction that held the robot.
        y = carry.y.at[law.CLOCK].set(0.0)
        inputs = law.inputs_at(robot, otherwise, segment, y, carry.stands)
        stands = carry.stands & (_holding_margin(law, inputs, y, carry.stands) >= 0)
        # They may also change the cell voltage across its cut-off.
        below = _cell_voltage_margin(law, inputs, y, stands) < 0
        time_below = jnp.where(below & carry.below, carry.time_below, 0.0)
        step = jnp.minimum(jnp.asarray(FIRST, y.dtype), self.longest)
        events = event_functions(law, robot, otherwise, segment, y, stands, below)
        cut_off = carry.cut_off | _stayed_below(robot, below, time_below)
        begin = carry._replace(
            y=y, q=jnp.zeros_like(carry.q), step=step, stands=stands, below=below, time_below=time_below,
            cut_off=cut_off, ended=carry.ended | cut_off, events=events,
        )  # fmt: skip
        return begin._replace(slope=law.instant(robot, otherwise, segment, y, stands)[1])

    def try_step(self, c: IntegrationState) -> tuple[Array, Array, Array, Array, Array, Array]:
        """A step of the planned length, limited by the end of the segment and the cut-off time of the cells.

        Returns:
            Unknowns and integrals at its end, its length [s], two flags, and the length of the next step that its
            error permits [s]. The first flag is True if the segment or the cut-off time of the cells ends with it.
            The second flag is True if its error is within the tolerance.
        """
        law, robot, otherwise, segment, *_ = self

        def rates(y: Array) -> tuple[Array, Array]:
            _, dy, dq, _ = law.instant(robot, otherwise, segment, y, c.stands)
            return dy, dq

        to_end = self.length - c.y[law.CLOCK]
        to_cut_off = jnp.where(c.below, robot.battery.delay_cutoff - c.time_below, jnp.inf)
        step_left = jnp.minimum(to_end, to_cut_off)
        ends_at_cut_off = to_cut_off < to_end
        is_last = c.step >= step_left * (1 - 1e-9)
        h = jnp.where(is_last, step_left, jax.lax.stop_gradient(c.step))
        y, q, u, _ = rosenbrock_stages(rates, c.y, c.q, h, looped=law.LONG)
        y = y.at[law.CLOCK].set(jnp.where(is_last & ~ends_at_cut_off, self.length, y[law.CLOCK]))
        scale = self.tolerance * (1 + jnp.maximum(jnp.abs(c.y), jnp.abs(y)))
        kink = jnp.any(law.limited(robot, c.y) != law.limited(robot, y))
        error = law.norm(error_across_kink(u[-1], c.y, y, kink) / scale)
        error = jax.lax.stop_gradient(jnp.where(jnp.isfinite(error), error, 1e6))
        next_length = h * jnp.clip(0.9 * jnp.maximum(error, 1e-12) ** -0.25, 0.1, 6.0)
        return y, q, h, is_last, error <= 1, next_length

    def step_to_event(self, c: IntegrationState) -> tuple[IntegrationState, Array, Array, Array]:
        """The next step, shortened to its first event if it contains one.

        Returns:
            The state at its end, without its peaks, flags and recorded steps. The length of the tried step [s], the
            index of the event, -1 for none, and True if it ends at an event.
        """
        law, robot, otherwise, segment, *_ = self
        y, q, h, is_last, is_accurate, next_length = self.try_step(c)
        events = event_functions(law, robot, otherwise, segment, y, c.stands, c.below)
        has_happened = events > 0
        is_new = has_happened & (c.events < 0)
        # The next step is to end slightly beyond it.
        share = jnp.where(is_new, (c.events - EVENT / 2) / jnp.where(is_new, c.events - events, 1.0), 1.0)
        overshoots = jnp.any(is_new & (events > EVENT)) & (h > NEAR)
        is_accepted = is_accurate & ~overshoots
        at_event = is_accepted & jnp.any(has_happened)
        event_inputs = (robot, otherwise, segment, y, q, c.stands, c.below, events, h)
        without_event = (y, q, c.stands, c.below, jnp.asarray(-1, jnp.argmin(events).dtype), jnp.zeros_like(h))
        y, q, stands, below, event_index, time_shift = compute_if_needed(
            at_event, functools.partial(_move_to_event, law), event_inputs, without_event
        )
        y, q = jnp.where(is_accepted, y, c.y), jnp.where(is_accepted, q, c.q)
        stands = jnp.where(is_accepted, stands, c.stands)
        time_below = jnp.where(below & c.below, c.time_below + jnp.where(is_accepted, h + time_shift, 0.0), 0.0)
        cut_off = is_accepted & _stayed_below(robot, below, time_below)
        # After a step shortened by the segment's end or an event, the length before it.
        step = jnp.where(is_accepted, jnp.where(is_last, jnp.maximum(next_length, c.step), next_length), next_length)
        step = jnp.where(is_accurate & overshoots, h * jnp.clip(jnp.min(share), 0.02, 0.99), step)
        step = jnp.where(at_event, FIRST, step)
        step = jnp.clip(jax.lax.stop_gradient(step), SHORTEST, self.longest)
        state = c._replace(
            y=y, q=q, step=step, stands=stands, below=below, time_below=time_below, cut_off=cut_off,
            events=jnp.where(is_accepted, events, c.events), accepted=c.accepted + is_accepted,
            rejected=c.rejected + ~is_accepted, failed=c.failed | (~is_accurate & (h <= SHORTEST)),
        )  # fmt: skip
        return state, h, event_index, at_event

    def after(
        self, c: IntegrationState, state: IntegrationState, h: Array, event_index: Array, at_event: Array
    ) -> IntegrationState:
        """State after a step as from `step_to_event`, with its peaks, flags and recorded steps."""
        law, robot, otherwise, segment, *_ = self
        y, stands, below, cut_off = state.y, state.stands, state.below, state.cut_off
        is_accepted = state.accepted > c.accepted
        signals, dy, _, _ = law.instant(robot, otherwise, segment, y, stands)
        # Current and heat may peak within the step. Speeds are different: at the end of a long step their slopes
        # belong to the stiff part of the solution, and a cubic would oscillate.
        largest = _peak_between(c.y, y, h * c.slope, h * dy)
        peaks_within_step = law.peaks_within(robot, y, largest)
        highest = jnp.stack(
            [jnp.where(is_accepted, peaks_within_step.get(name, -jnp.inf), -jnp.inf) for name in law.PEAKS]
        )
        signal_peaks = law.peaks(robot, signals)
        peaks = jnp.maximum(
            jnp.maximum(c.peaks, jnp.stack([jnp.asarray(signal_peaks[name]) * jnp.ones(()) for name in law.PEAKS])),
            highest,
        )
        is_too_hot = is_accepted & (peaks_within_step["temperature"] > robot.motor.temperature_limit)
        exceedance = law.exceeded(robot, signals)
        exceedance.pop("slips")  # every start slips for an instant; for a segment, slip counts at its end
        flags = flag_mask({**exceedance, "cut_off": cut_off}) | flag_mask({"too_hot": is_too_hot})
        has_ended = c.ended | cut_off | (event_index == EMPTY) | state.failed
        event_inputs = (robot, otherwise, segment, y, stands, below)
        events_now = compute_if_needed(at_event, functools.partial(event_functions, law), event_inputs, state.events)
        buffer_count, buffer = c.kept, c.buffer
        if buffer is not None:
            slot = jnp.where(is_accepted, buffer_count, buffer[0].shape[0])  # beyond the end: dropped
            row = (y, state.q, stands, jnp.where(cut_off, MARKS.index("cut_off"), event_index))
            buffer = tuple(b.at[slot].set(r, mode="drop") for b, r in zip(buffer, row, strict=True))
        return state._replace(
            ended=has_ended, peaks=peaks, flags=c.flags | flags, events=events_now, kept=buffer_count + is_accepted,
            buffer=buffer, slope=dy,
        )  # fmt: skip


def _stayed_below(robot: Robot, below: Array, time_below: Array) -> Array:
    """True if the cells have been below their cut-off for longer than permitted."""
    rounding = 8 * jnp.finfo(time_below.dtype).eps
    return below & (time_below >= robot.battery.delay_cutoff * (1 - rounding))
