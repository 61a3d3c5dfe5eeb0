"""Fidelity `track`: half a robot, or a whole one free to turn, as multibody dynamics in MJX with all contacts."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import replace
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mmrjax import fidelities
from mmrjax.compile.compiling import compiled
from mmrjax.compile.programs import has_tracer
from mmrjax.fidelities.base import Fidelity, History, Progress, RunBatch, flag_mask, withhold_numbers
from mmrjax.model import balances, contact, masses
from mmrjax.model.balances import signals_of
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import (
    FAILED,
    TIPS,
    Result,
    Signals,
)
from mmrjax.undercarriage import both_sides, half_robot
from mmrjax.undercarriage.half_robot import Changes, HalfRobotState, HalfRobotSystem, SteadyAverages, build_system
from mmrjax.undercarriage.modes import check_track_step, largest_step
from mmrjax.undercarriage.side_contacts import GearReactions

STEP = fidelities.fidelity_facts("track").resolved()["step"]  # [s]
SAMPLE = 1e-3  # [s]
WINDOW = 0.4  # share of a run, at its end, that is averaged
PARTS = 20  # of a run, with progress reported in between
#: Length of a run from a rolling start after which it counts as settled [s]. Its last 40 % hold two grouser periods
#: (34) or more down to 0.29 m/s; averages over them are within 1e-4 of those of a run of 1.5 s.
TIME_ROLLED = 0.6
#: A robot jumps if for this share of the window its reaction is below this share of its mean [-].
JUMPS, ALOFT = 0.01, 0.01


#: Sample intervals of a run: motion at their end, means over them, mean load of the guides, and loads at their end.
SampleRecord = tuple[HalfRobotState, Signals | balances.Travel, Float[Array, "samples ..."], GearReactions]


class TrackTrajectory(eqx.Module):
    """One run over time.

    Attributes:
        time: end of each sample interval [s], shape (samples,).
        q, v: coordinates and velocities at those times (see `side_contacts`), shape (samples, 5). For a robot free to
            turn those of `both_sides`, shape (samples, 10).
        signals: means over each interval. Each field has shape (samples,). For a robot free to turn they and the
            following have a last axis of left and right side: (samples, 2).
        reactions: loads at those times, for one side.
        steady: averages at the end of the run.
        result: the observation from those averages, with the run's status.
    """

    time: Float[Array, " samples"]
    q: Float[Array, "samples coordinates"]
    v: Float[Array, "samples coordinates"]
    signals: Signals
    reactions: GearReactions
    steady: SteadyAverages
    result: Result


def _window_begin(time: Array) -> Array:
    """Time at which the window of the averages begins [s]."""
    return time[-1] - WINDOW * (time[-1] - time[0])


def _period_averages(
    run: HalfRobotSystem, time: Array, travelled: Array, sums: tuple[Any, Array]
) -> tuple[Any, Scalar, Array, Changes]:
    """Means of signals (or `Travel`) and guides' load, number of periods, and change and size of three signals."""
    # Weights over the belt's travel that rise over one pitch and fall over another by the cubic step. Each adds up to
    # one with the weight one pitch further. The mean of an orbit that repeats with the pitch is therefore exact, and
    # it varies smoothly with the position at which the run ends.
    pitch = run.path.pitch
    end = travelled[-1]
    middle = (travelled[1:] + travelled[:-1]) / 2
    window_begin = _window_begin(time)
    window_weights = (time[1:] > window_begin).astype(time.dtype)
    window_start = travelled[jnp.searchsorted(time, window_begin)]
    periods = jnp.floor(jax.lax.stop_gradient((end - window_start) / pitch))
    periods = jnp.where(jnp.isfinite(periods) & (periods >= 2), periods, 0)

    def means_over(begin: Array, until: Scalar, otherwise: Array) -> tuple[Any, Array]:
        rise = contact.cubic_step(middle, end - begin * pitch, 0.0, end - (begin - 1) * pitch, 1.0)
        fall = contact.cubic_step(middle, end - (until + 1) * pitch, 1.0, end - until * pitch, 0.0)
        weight = jnp.where(periods > 0, rise * fall, otherwise)
        return jax.tree.map(lambda x: jnp.sum(weight * x) / jnp.sum(weight), sums)

    half_periods = jnp.floor(periods / 2) + 1
    first_half = window_weights * (jnp.cumsum(window_weights) <= jnp.sum(window_weights) / 2)
    means, guide_load = means_over(periods, 0.0, window_weights)
    halves = (
        means_over(periods, periods - half_periods, first_half)[0],
        means_over(half_periods, 0.0, window_weights - first_half)[0],
    )
    earlier, later, period_signals = (signals_of(x) for x in (*halves, means))
    changes = [
        (jnp.abs(getattr(later, field) - getattr(earlier, field)), jnp.abs(getattr(period_signals, field)))
        for field in ("total_current", "speed_motor", "speed")
    ]
    return means, guide_load, periods.astype(int), changes


def track(
    robot: Robot,
    conditions: Conditions,
    *,
    duration: float = 1.5,
    step: float = STEP,
    sample: float = SAMPLE,
    rolling: bool = False,
) -> TrackTrajectory:
    """Simulates one robot under constant conditions, from standstill or rolling.

    Pure and traceable: differentiable forward and backward, vmappable over every argument's leaves.

    Args:
        robot: any robot. Its parameters may be tracers. Its `guide_share` is not used: it is an output.
        conditions: conditions of one run, scalar fields.
        duration: duration of the run [s].
        step, sample: intervals of integration and of the record [s].
        rolling: True to start at the steady fidelity's speed, which settles sooner. False: from standstill.

    Returns:
        The trajectory, with one of these statuses. `converged`: current and speeds change by less than 0.1 % from one
        half of the averaging window to the other, else `not_settled`. `stalled`: the shafts do not turn forward.
        `slides`: the movers slide beyond V_s and the robot loses speed or stands. In steady travel it has
        `converged`, flagged `slips`. `tips`: the line of gravity passes outside the contacts, or the robot has turned
        over although gravity alone would not turn it (a resonance, a wild start). `battery_empty`. `failed`: the
        numbers are no longer finite, or the robot has left the ground. `failed` and `tips` withhold the result's
        numbers. Flag `jumps`: the robot has no contact for more than a hundredth of the averaging window.
    """
    run = build_system(robot, conditions, step)
    start = _initial_motion(run, rolling)
    end, record = _advance_and_record(run, start, round(sample / step), round(duration / sample))
    return _assemble_trajectory(run, start, end, record, sample)


def _moving_system_module(conditions: Conditions) -> ModuleType:
    """The module of the moving system: half a robot, or a whole robot free to turn."""
    return both_sides if conditions.turns else half_robot


def _initial_motion(run: HalfRobotSystem, rolling: bool) -> HalfRobotState:
    module = _moving_system_module(run.conditions)
    start: HalfRobotState = module.roll(run) if rolling else module.stand(run)
    return start


def _advance_and_record(
    run: HalfRobotSystem, start: HalfRobotState, steps: int, samples: int
) -> tuple[HalfRobotState, SampleRecord]:
    module = _moving_system_module(run.conditions)

    def advance_step(motion: HalfRobotState, _: None) -> tuple[HalfRobotState, tuple[Any, Array]]:
        after, record, guide_load = module.advance(run, motion)
        return after, (record, guide_load)

    @jax.checkpoint  # reverse mode keeps one motion per sample and recomputes the steps in between
    def advance_sample(motion: HalfRobotState, _: None) -> tuple[HalfRobotState, SampleRecord]:
        after, records = jax.lax.scan(advance_step, motion, None, length=steps)
        record, guide_load = jax.tree.map(lambda x: jnp.mean(x, axis=0), records)
        return after, (after, record, guide_load, module.loads(run, *module.instant(run, after)[1:]))

    return jax.lax.scan(advance_sample, start, None, length=samples)


def _assemble_trajectory(
    run: HalfRobotSystem, start: HalfRobotState, end: HalfRobotState, record: SampleRecord, sample: float
) -> TrackTrajectory:
    module = _moving_system_module(run.conditions)
    motions, sample_means, guide_loads, reactions = record
    time = sample * jnp.arange(len(motions.q) + 1)
    travelled = run.path.radius * jnp.concatenate([start.q[None, module.SHAFTS], motions.q[:, module.SHAFTS]])
    averages = module.steady_averages(
        functools.partial(_period_averages, run, time), travelled, sample_means, guide_loads
    )
    status = module.status(run, averages, end)
    valid = (status != FAILED) & (status != TIPS)
    window = time[1:] > _window_begin(time)
    signals = signals_of(sample_means)
    result = module.result_of(run, averages, status)
    normal_load = jnp.sum(jnp.reshape(signals.normal, (len(motions.q), -1)), axis=-1)
    is_aloft = window & (normal_load < ALOFT * jnp.sum(averages.signals.normal))
    jumps = jnp.sum(is_aloft) > JUMPS * jnp.sum(window)
    flags = result.flags | flag_mask({"jumps": jumps})
    result = withhold_numbers(replace(result, flags=flags), valid, status != FAILED)
    return TrackTrajectory(time[1:], motions.q, motions.v, signals, reactions, averages, result)


def check_track_runs(
    robot: Robot, conditions: Conditions, *, duration: float, step: float, sample: float = SAMPLE
) -> None:
    """Raises if the track model cannot compute some run of a batch.

    Raises:
        ValueError: `sample` is not a whole number of steps or `duration` of samples, or a lever reaches below the
            ground. The step is above the largest stable one, which the message states. Also a load without ground, an
            imposed motor speed, movers without inertia, parts with more mass or inertia than the robot.
    """
    if not robot.has_ground:
        raise ValueError("a shaft has no running gear; use steady or drive")
    if robot.rig.imposed != "voltage":
        quantity = robot.rig.imposed.removeprefix("motor_")
        raise ValueError(
            f"the motors' {quantity} is imposed, but this model imposes the voltage; use steady or drive"
        )
    if conditions.motor_speed is not None or (conditions.turns and conditions.of_sides().motor_speed is not None):
        raise ValueError("motor_speed: got an imposed speed; this model imposes the voltage")
    if sample < step or abs(sample / step - round(sample / step)) > 1e-6:
        raise ValueError(f"step: got {step:g} s; expected the sample time, {sample:g} s, divided by a whole number")
    if duration < sample or abs(duration / sample - round(duration / sample)) > 1e-6:
        raise ValueError(f"duration: got {duration:g} s; expected a whole number of samples of {sample:g} s")
    if has_tracer((robot, conditions)):
        return  # within a transformation the numbers are not known
    for name, chassis in robot.configurations.items():
        if not np.all(np.asarray(chassis.inertia) > 0):
            raise ValueError(
                f"{name}.inertia: got 0; expected the inertia of all parts that turn with the movers of one side "
                "[kg·m^2]"
            )
    masses.check_parts(robot)
    check_track_step(robot, conditions, step, sample)


def track_batch(
    robot: Robot,
    conditions: Conditions,
    *,
    duration: float = 1.5,
    step: float = STEP,
    sample: float = SAMPLE,
    rolling: bool = False,
    progress: Progress | None = None,
) -> TrackTrajectory:
    """`track` for one robot over a batch of conditions (first axis of every field), compiled once.

    Args:
        progress: called with the finished share of the runs' time. Between its calls the runs can be interrupted.
            None: one call of XLA, which cannot be interrupted.

    Raises:
        ValueError: a run that `check_track_runs` refuses.
    """
    check_track_runs(robot, conditions, duration=duration, step=step, sample=sample)
    if progress is not None:
        # All parts have one length, to share a compilation; the excess of the last one is cut off.
        samples = round(duration / sample)
        length = math.ceil(samples / PARTS)
        start = motion = _begin_runs(robot, conditions, step, rolling)
        records = []
        for done in range(0, samples, length):
            motion, record = jax.block_until_ready(_advance_runs(robot, conditions, motion, step, sample, length))
            records.append(record)
            progress(min((done + length) / samples, 1.0))
        return _end_runs(robot, conditions, start, records, step, sample, samples)
    return _simulate_batch(robot, conditions, duration, step, sample, rolling)


@compiled
def _simulate_batch(
    robot: Robot,
    conditions: Conditions,
    duration: float,
    step: float,
    sample: float,
    rolling: bool,
) -> TrackTrajectory:
    options: Any = {"duration": duration, "step": step, "sample": sample, "rolling": rolling}
    return jax.vmap(lambda one: track(robot, one, **options))(conditions)


@compiled
def _begin_runs(robot: Robot, conditions: Conditions, step: float, rolling: bool) -> HalfRobotState:
    return jax.vmap(lambda one: _initial_motion(build_system(robot, one, step), rolling))(conditions)


@compiled
def _advance_runs(
    robot: Robot, conditions: Conditions, motions: HalfRobotState, step: float, sample: float, samples: int
) -> tuple[HalfRobotState, SampleRecord]:
    steps = round(sample / step)
    return jax.vmap(lambda one, motion: _advance_and_record(build_system(robot, one, step), motion, steps, samples))(
        conditions, motions
    )


@compiled
def _end_runs(
    robot: Robot,
    conditions: Conditions,
    starts: HalfRobotState,
    records: list[SampleRecord],
    step: float,
    sample: float,
    samples: int,
) -> TrackTrajectory:
    def one(conditions: Conditions, start: HalfRobotState, parts: list[SampleRecord]) -> TrackTrajectory:
        record = jax.tree.map(lambda *x: jnp.concatenate(x)[:samples], *parts)
        end = jax.tree.map(lambda x: x[-1], record[0])
        return _assemble_trajectory(build_system(robot, conditions, step), start, end, record, sample)

    return jax.vmap(one)(conditions, starts, records)


def _settled_results(robot: Robot, conditions: Conditions) -> Result:
    return jax.vmap(lambda c: track(robot, c, duration=TIME_ROLLED, rolling=True).result)(conditions)


def _run_batch(
    robot: Robot, conditions: Conditions, options: Mapping[str, float], progress: Progress | None = None
) -> RunBatch:
    runs = track_batch(
        robot, conditions, duration=options["duration"], step=options["step"], rolling=True, progress=progress
    )
    return RunBatch(runs.result, {"guide_share": runs.steady.guide_share})


def _run_histories(
    robot: Robot, conditions: Conditions, options: Mapping[str, float], progress: Progress | None = None
) -> RunBatch:
    runs = track_batch(robot, conditions, duration=options["duration"], step=options["step"], progress=progress)
    distance, reactions = _moving_system_module(conditions).distance_and_reactions(runs.q, runs.reactions)
    history = History.of(robot, runs.time, distance, runs.signals, reactions)
    return RunBatch(runs.result, {"guide_share": runs.steady.guide_share}, history)


def _check_time_step_and_conditions(robot: Robot, conditions: Conditions, options: Mapping[str, float]) -> None:
    check_track_runs(robot, conditions, duration=options["duration"], step=options["step"])


def _stiffness_cautions(robot: Robot, conditions: Conditions) -> list[str]:
    limits = largest_step(robot, conditions)
    rows = ", ".join(str(k + 1) for k in np.flatnonzero(limits < STEP))
    if not rows:
        return []
    return [
        f"rows {rows}: the step of {STEP:g} s is above the largest stable one, {limits.min():.2g} s. Do not "
        "trust these readings: contacts or belt are too stiff"
    ]


FIDELITY = Fidelity(
    "track",
    settled=_settled_results,
    run=_run_batch,
    histories=_run_histories,
    check=_check_time_step_and_conditions,
    cautions=_stiffness_cautions,
    columns=("guide_share",),
)
