"""Missions: the ODE of `drive` over a profile, with heat, standing still, and energy integrated as states.

Friction holds a robot at rest until motors or gravity exceed it. Neither smooth shaft friction nor the ground's law
lets it creep. Stopping and breaking away are events that the steps land on.
Derivatives pass through their moments.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mmrjax.fidelities.base import flag_mask, withhold_numbers
from mmrjax.missions import mission_straight, mission_turning
from mmrjax.missions.mission_steps import EVENTS, FIRST, IntegrationState, MotionLaw, SegmentInputs, integrate_segment
from mmrjax.missions.profile import BRAKE, COAST, MOTOR_SPEED, SPEED, Profile
from mmrjax.model import balances, energy
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import (
    BATTERY_EMPTY,
    CONVERGED,
    CUT_OFF,
    FAILED,
    ROLLS_BACK,
    SLIDES,
    STALLED,
    TIPS,
    Result,
    Signals,
)

#: Relative tolerance of a step; the absolute one is the same in the units of the unknowns.
TOLERANCE = 2e-5
#: A demanded speed counts as missed if its error at the end of a segment exceeds this share of the segment's largest
#: speed [-].
MISSED = 0.02


class Totals(eqx.Module):
    """Totals of a mission or a segment.

    Attributes:
        time: duration [s].
        of: integrals by name, as in the law's `TOTALS`. `drawn` and `returned` are energy of the source, the others
            are losses.
        stored: increase of the kinetic energy [J].
        supplied: net energy from the source [J]: for a battery from its charge at begin and end, for a supply by
            integration.
    """

    time: Array
    of: dict[str, Array]
    stored: Array
    supplied: Array

    @property
    def energy(self) -> Scalar:
        """Net energy taken from the source [J]."""
        return self.of["drawn"] - self.of["returned"]

    @property
    def unaccounted(self) -> Scalar:
        """Energy taken, minus losses and stored energy [J]: the error of the integration.

        The energy of a battery is computed from its charge, so this error also includes errors of the charge.
        """
        return self.supplied - sum(self.of[name] for name in energy.SINKS) - self.stored


class Start(eqx.Module):
    """State at the start of a mission. By default at rest and at ambient temperature.

    Attributes:
        speed: speed of the robot, with rolling tracks or wheels [m/s].
        current: current of one motor [A].
        temperature_winding, temperature_housing: temperatures [°C]. None: ambient.
    """

    speed: Scalar = 0.0
    current: Scalar = 0.0
    temperature_winding: Scalar | None = None
    temperature_housing: Scalar | None = None


class MissionCourse(eqx.Module):
    """A mission over time, at its accepted steps, shape (kept,). Entries after the last step are NaN.

    Attributes:
        time: time since the start of the mission [s].
        segment: index of the segment, -1 after the last.
        event: index into `MARKS` of the event at the end of the step, -1 for none.
        distance: distance along the ground, forward minus backward [m].
        path: distance in both directions [m].
        temperature_winding, temperature_housing: temperatures [°C]. For a robot that turns, of each side, shape
            (kept, 2).
        energy: net energy taken from the source [J].
        signals: all signals. For a robot that turns, of the left and right side, shape (kept, 2).
    """

    time: Float[Array, " kept"]
    segment: Int[Array, " kept"]
    event: Int[Array, " kept"]
    distance: Float[Array, " kept"]
    path: Float[Array, " kept"]
    energy: Float[Array, " kept"]
    temperature_winding: Float[Array, " kept"]
    temperature_housing: Float[Array, " kept"]
    signals: Signals


class Mission(eqx.Module):
    """Result of a mission: a robot's run over a profile.

    Attributes:
        total: totals of the whole mission.
        segments: totals of each segment of each cycle, fields of shape (cycles, segments).
        peaks: largest values by name, as in the law's `PEAKS` (`cell_low`: lowest voltage of a cell). `segments` has
            them too.
        status, flags: status and flags at the end of each segment, shape (cycles, segments).
        result: the end of the mission, with its status and all flags. `converged`: the profile was followed to its
            end. `battery_empty`. `cut_off`: the cells stayed below their cut-off. `stalled`, `slides`, `rolls_back`
            or `tips`: status of the first segment with demanded motion that ends so. `failed`: the integrator gave
            up.
        temperature_winding, temperature_housing: winding temperature and housing temperature of the hottest side at
            the end [°C].
        discharge: charge taken from the battery [C].
        steps: number of steps, and of rejected steps.
        course: course over time, if requested.
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
    course: MissionCourse | None


def initial_unknowns(law: MotionLaw, robot: Robot, conditions: Conditions, start: Start) -> Float[Array, " unknowns"]:
    """Unknowns at the start [SI], with the heading of the conditions, uphill by default."""
    ambient = robot.motor.temperature_ambient
    heading = conditions.heading_deg
    winding, housing = (ambient if t is None else t for t in (start.temperature_winding, start.temperature_housing))
    motor_speed = start.speed / robot.chassis(conditions.configuration).radius * robot.gearbox.ratio
    y = jnp.zeros_like(law.units(robot))
    for index, value in (
        (law.CURRENT, start.current), (law.MOTOR, motor_speed), (law.WINDING, winding), (law.HOUSING, housing),
        (law.GROUND, start.speed), (law.HEADING, 0.0 if heading is None else jnp.radians(heading)),
        (law.DISCHARGE, conditions.discharge),
    ):  # fmt: skip
        y = y.at[index].set(value)
    return y


def _segment_status(
    law: MotionLaw,
    robot: Robot,
    otherwise: Conditions,
    segment: Profile,
    instant: Any,
    inputs: SegmentInputs,
    stands: Array,
) -> tuple[Array, Array]:
    """Status at the end of a segment, and True if the robot has missed the demanded speed."""
    mode = segment.mode[0]
    signals = balances.signals_of(instant)
    driven = jnp.max(jnp.abs(signals.duty * signals.voltage_source))
    status = jnp.where(stands, STALLED, law.status(robot, inputs.conditions, instant))
    is_slow = [jnp.max(jnp.abs(x)) < 1.0 for x in (signals.direction, signals.direction_travel)]
    is_at_rest = stands | (is_slow[0] & is_slow[1])
    wants_motion = (mode != BRAKE) & (mode != COAST) & (driven > 1e-6)
    status = jnp.where(~wants_motion & (status == STALLED), CONVERGED, status)  # it stands as demanded
    controlled = (mode == MOTOR_SPEED) | (mode == SPEED)
    motor_angle_per_travel = robot.gearbox.ratio / robot.chassis(otherwise.configuration).radius
    demanded_speed = law.demanded(robot, otherwise, segment)
    # A ramp that ends in a stop is measured by its first value.
    largest_speed = jnp.max(jnp.abs(demanded_speed if segment.linear else demanded_speed[:1])) * jnp.where(
        mode == SPEED, motor_angle_per_travel, 1.0
    )
    largest_error = jnp.max(jnp.abs(inputs.error))
    missed = controlled & (largest_error > MISSED * jnp.maximum(largest_speed, 10.0))
    status = jnp.where(controlled & (is_at_rest | (status == STALLED)) & ~missed, CONVERGED, status)
    return status, missed


def _early_end_status(c: IntegrationState) -> Array:
    """Status of a mission that ended before its profile."""
    return jnp.where(c.failed, FAILED, jnp.where(c.cut_off, CUT_OFF, BATTERY_EMPTY))


def mission(
    robot: Robot,
    conditions: Conditions,
    profile: Profile,
    start: Start | None = None,
    *,
    tolerance: Scalar = TOLERANCE,
    keep: int = 0,
) -> Mission:
    """Simulates one robot over a profile.

    Args:
        robot: any robot. Its parameters may be tracers.
        conditions: conditions of one run, scalar fields, where the profile states none.
        profile: profile of one mission.
        start: state at the start. None: at rest, at ambient temperature.
        tolerance: relative error of a step, also absolute in `UNITS`.
        keep: largest number of accepted steps to record, 0 for none.

    Returns:
        The mission. Derivatives are forward (`jax.jvp`, `jax.jacfwd`), with respect to parameters, conditions, and
        values and times of the profile, through stops and reversals. At a limit that begins to act they are
        one-sided.
    """
    initial = Start() if start is None else start
    # free to turn if the profile or the conditions drive the sides differently or state a heading
    law = mission_turning if profile.turns or conditions.turns else mission_straight
    no_peaks = jnp.full(len(law.PEAKS), -jnp.inf, jnp.result_type(conditions.voltage, profile.time))

    def run_segment(carry: IntegrationState, k: Array) -> tuple[IntegrationState, _SegmentEnd]:
        segment = profile.row(k)
        carry_in = carry._replace(peaks=no_peaks, flags=jnp.asarray(0))
        signals_before = law.instant(robot, conditions, segment, carry.y.at[law.CLOCK].set(0.0), carry.stands)[0]
        c = integrate_segment(law, robot, conditions, segment, carry_in, tolerance)
        signals, _, _, inputs = law.instant(robot, conditions, segment, c.y, c.stands)
        status, missed = _segment_status(law, robot, conditions, segment, signals, inputs, c.stands)
        status = jnp.where(c.ended, _early_end_status(c), status)
        is_slipping = law.exceeded(robot, signals)["slips"] & ~c.stands
        flags = c.flags | flag_mask({"demand_missed": missed & ~c.ended, "slips": is_slipping})
        stored_rise = law.stored(robot, signals) - law.stored(robot, signals_before)
        drawn, returned = (c.q[list(law.TOTALS).index(name)] for name in ("drawn", "returned"))
        energy_before, energy_after = (robot.battery.energy(_charge_taken(law, x.y)) for x in (carry, c))
        energy_supplied = jnp.where(conditions.battery > 0.5, energy_after - energy_before, drawn - returned)
        is_run = ~carry.ended
        time, stored_rise, energy_supplied = (
            jnp.where(is_run, x, 0.0) for x in (c.y[law.CLOCK], stored_rise, energy_supplied)
        )
        segment_end = _SegmentEnd(
            time, jnp.where(is_run, c.q, 0.0), stored_rise, energy_supplied, c.peaks, status, flags, signals, c.kept
        )
        carry = c._replace(peaks=jnp.maximum(carry.peaks, c.peaks), flags=carry.flags | segment_end.flags)
        return carry, segment_end

    order = jnp.tile(jnp.arange(profile.segment_count), profile.cycles)
    c, segment_ends = jax.lax.scan(
        run_segment, _initial_carry(law, robot, conditions, initial, no_peaks, keep), order
    )
    return _assemble_mission(law, robot, conditions, profile, c, segment_ends)


class _SegmentEnd(NamedTuple):
    """State at the end of a segment: totals, peaks and status as in `Mission`, the last instant and the steps
    recorded so far.
    """

    time: Array
    q: Array
    rise: Array
    supplied: Array
    peaks: Array
    status: Array
    flags: Array
    instant: Any
    kept: Array


def _charge_taken(law: MotionLaw, y: Array) -> Array:
    """Charge taken from the battery [C]."""
    return y[law.DISCHARGE] * law.UNITS[law.DISCHARGE]


def _initial_carry(
    law: MotionLaw, robot: Robot, conditions: Conditions, start: Start, peaks: Array, keep: int
) -> IntegrationState:
    """State at the start of a mission, with space for `keep` recorded steps."""
    dtype = peaks.dtype
    zero = jnp.asarray(0)
    false = jnp.asarray(False)
    y0 = initial_unknowns(law, robot, conditions, start).astype(dtype) / law.units(robot).astype(dtype)
    q0 = jnp.zeros(len(law.TOTALS), dtype)
    buffer = None
    if keep:
        blank = jnp.full((keep, 1), jnp.nan, dtype)
        buffer = (blank * y0, blank * q0, jnp.zeros(keep, bool), jnp.full(keep, -1))
    return IntegrationState(
        y=y0, q=q0, step=jnp.asarray(FIRST, dtype), stands=jnp.asarray(start.speed == 0.0), ended=false,
        below=false, time_below=jnp.zeros((), dtype), cut_off=false, peaks=peaks,
        flags=zero, events=jnp.full(len(EVENTS), -1.0, dtype), accepted=zero, rejected=zero, failed=false,
        kept=zero, buffer=buffer, slope=jnp.zeros_like(y0),
    )  # fmt: skip


def _assemble_mission(
    law: MotionLaw, robot: Robot, conditions: Conditions, profile: Profile, c: IntegrationState, ends: _SegmentEnd
) -> Mission:
    """Mission from its last state `c` and the ends of its segments, shape (cycles · segments, ...)."""
    shape = (profile.cycles, profile.segment_count)
    totals = {n: ends.q[:, i].reshape(shape) for i, n in enumerate(law.TOTALS)}
    by_segment = Totals(ends.time.reshape(shape), totals, ends.rise.reshape(shape), ends.supplied.reshape(shape))
    total = jax.tree.map(jnp.sum, by_segment)
    status = ends.status
    is_failure = (status == STALLED) | (status == SLIDES) | (status == ROLLS_BACK) | (status == TIPS)
    first_failure = jnp.argmax(is_failure)
    outcome = jnp.where(jnp.any(is_failure), status[first_failure], CONVERGED)
    outcome = jnp.where(c.ended, _early_end_status(c), outcome)
    end = jax.tree.map(lambda x: x[-1], ends.instant)
    result = withhold_numbers(law.RESULT(robot, end, outcome), outcome != FAILED, outcome != FAILED)
    result = replace(result, flags=c.flags)

    def peaks_by_name(x: Array) -> dict[str, Array]:
        signs = {"cell_low": -1.0}
        return {name: signs.get(name, 1.0) * x[..., i] for i, name in enumerate(law.PEAKS)}

    course = None
    if c.buffer is not None:
        course = _recorded_course(law, robot, conditions, profile, c, by_segment, ends.kept)
    winding, housing = _winding_and_housing_temperatures(law, c.y)
    return Mission(
        total=total, segments=by_segment, peaks=peaks_by_name(c.peaks),
        segment_peaks=peaks_by_name(ends.peaks.reshape(*shape, -1)),
        status=status.reshape(shape), flags=ends.flags.reshape(shape), result=result,
        temperature_winding=jnp.max(winding), temperature_housing=jnp.max(housing), discharge=_charge_taken(law, c.y),
        steps=c.accepted + c.rejected, rejected=c.rejected,
        course=course,
    )  # fmt: skip


def _winding_and_housing_temperatures(law: MotionLaw, y: Array) -> tuple[Array, Array]:
    """Temperatures of windings and housings [°C]."""
    winding, housing = (np.asarray(law.UNITS)[k] * y[..., k] for k in (law.WINDING, law.HOUSING))
    return winding, housing


def _recorded_course(
    law: MotionLaw,
    robot: Robot,
    conditions: Conditions,
    profile: Profile,
    c: IntegrationState,
    segments: Totals,
    kept: Array,
) -> MissionCourse:
    assert c.buffer is not None
    ys, qs, stands_at, marks = c.buffer
    index = jnp.arange(len(ys))
    # Segment of each recorded step: the first one with a larger step count.
    segment = jnp.minimum(jnp.searchsorted(kept, index, side="right"), len(kept) - 1)
    is_recorded = index < kept[-1]
    begin_times = jnp.concatenate([jnp.zeros(1), jnp.cumsum(segments.time.ravel())])[segment]
    so_far = {
        name: jnp.concatenate([jnp.zeros(1), jnp.cumsum(segments.of[name].ravel())])[segment] + qs[:, i]
        for i, name in enumerate(law.TOTALS)
    }

    def signals(y: Array, is_standing: Array, k: Array) -> Signals:
        return balances.signals_of(
            law.instant(robot, conditions, profile.row(k % profile.segment_count), y, is_standing)[0]
        )

    course_signals = law.at_places(jax.vmap(signals)(ys, stands_at, segment), so_far)
    winding, housing = _winding_and_housing_temperatures(law, ys)

    def mask_unrecorded(x: Array) -> Array:
        return jnp.where(is_recorded.reshape(-1, *[1] * (x.ndim - 1)), x, jnp.nan)

    return MissionCourse(
        time=mask_unrecorded(begin_times + ys[:, law.CLOCK]),
        segment=jnp.where(is_recorded, segment, -1),
        event=jnp.where(is_recorded, marks, -1),
        distance=mask_unrecorded(so_far["distance"]),
        path=mask_unrecorded(so_far["path"]),
        energy=mask_unrecorded(so_far["drawn"] - so_far["returned"]),
        temperature_winding=mask_unrecorded(winding),
        temperature_housing=mask_unrecorded(housing),
        signals=jax.tree.map(mask_unrecorded, course_signals),
    )
