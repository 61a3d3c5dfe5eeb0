"""Time histories: each `run_id` is a run from standstill, each row is a sample.

The conditions of a run may change from sample to sample. Each value holds from its sample until the next. An imposed
quantity is instead linear between samples if the rig's file says so (`Rig.between_rows`).
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import operator
import re
import threading
import warnings
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from calibration.data import Columns, Names
from calibration.data.clock import (
    ConstantInterval,
    applied_drive,
    changing_columns,
    differs_from_row_before,
    divide_run,
    intervals_by_run,
)
from calibration.data.columns import SUPPLY
from calibration.data.input_errors import BadConfiguration, BadData
from calibration.data.runs import Runs
from calibration.inference import bases as bases_room
from calibration.inference import scans
from calibration.inference.bases import Bases
from calibration.inference.details import FitOverTime, ResidualMemory, StrongestWave, TimeStatistics
from calibration.inference.fit_notes import Remark
from calibration.inference.linearization import (
    PROBED,
    Linearization,
    ScoredEffect,
    balance_probe,
    effect_terms,
    finite_or_zero,
    map_over_shapes,
    with_shape_of_robot,
)
from calibration.inference.noise import Noise
from calibration.inference.observers import settled_ends
from calibration.inference.observers.base import Observer, SearchPolicy, linear_replicate, with_effects
from calibration.inference.optimizers import (
    CORES,
    SAME,
    Evaluate,
    Numbers,
    Optimum,
    adhesion_penalty_slice,
    linearise,
    linearise_rollout,
    search_rollouts,
    zero_inactive_residuals,
)
from calibration.inference.priors import DELAY
from calibration.inference.problem import MISSING, Observation, Problem
from calibration.inference.weak_form import fit_weak_form
from mmrjax import fidelities
from mmrjax.compile.compiling import OVER_TIME, SELDOM, Threads, compiled
from mmrjax.effects import Effect
from mmrjax.effects.curve import WAYS
from mmrjax.fidelities.drive import drive_rates, moving, state_of_unknowns
from mmrjax.fidelities.histories import (
    CHANGE,
    LONGEST,
    LOOSE,
    START,
    STEPS,
    LinearisedRun,
    RunStep,
    StepCourse,
    course_between_instants,
    first_conditions_and_state,
    history_signals,
    linearise_run,
    run_response,
    run_steps,
    signals_of_instant,
    time_grid,
)
from mmrjax.fidelities.rest import HELD
from mmrjax.model import balances, channels
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.quantities import GOALS
from mmrjax.model.rig import Rig, RunStart, RunStarts
from mmrjax.model.robot import Robot
from mmrjax.model.signals import CONVERGED, FAILED, Signals, State
from mmrjax.numerics.elementary import value_and_slope
from mmrjax.numerics.linear_equations import solve

#: Most knots of a run's defect in time, and largest product of knots and steps of all runs (2 GB of working memory).
KNOTS, KNOT_STEPS = 256, 1e7
#: Lags of a run's residual in tests of memory, at most a quarter of its samples.
LAGS = 12
#: Fewest and most values of a delay in a scan; number of values of other scanned coordinates, one run each.
DELAYS, SCANNED = (256, 2048), 32
#: Time up to which a first sample has to show a robot at rest [s]; largest allowed reading there, as a share of the
#: largest speed and in sds.
EARLY, RESTING, RESTING_SD = 0.005, 0.2, 5.0
#: Differences between neighbouring residuals, over their median, above which they are jumps rather than noise [-].
JUMP = 7.0
#: Fields of `Conditions` that may change within a run.
CHANGING = (
    "voltage", "motor_current", "slope_deg", "payload", "adhesion", "total_mass", "duty", "open", "load_torque",
    "goal", "held",
)  # fmt: skip
#: Imposed quantities among these, and the torque of a brake, which is measured.
ON_LINES = ("voltage", "motor_current", "duty", "load_torque", "goal")
#: Shortest interval of unchanged conditions that may show steady travel [s].
LASTING = 0.25
#: Fewest steps between samples for a run that is driven both ways, near rest, if shafts and load do not move as one:
#: while a speed is below a share of its largest, and for some time before [s], by imposed quantity (with an imposed
#: current the instant of rest depends more on calibrated parameters), plus this many times the delay.
FINE, DELAYED = 16, 2.0
SLOW, EARLIER = {"voltage": 0.1, "motor_current": 0.3}, {"voltage": 0.03, "motor_current": 0.06}
SLOW |= dict.fromkeys(GOALS, SLOW["motor_current"])
#: Time before a row from which a sample of a controller reads its goal, as a share of the controller's period.
EARLIEST = 1e-3
#: Longest step elsewhere, in usual longest steps.
FAST = 2
#: Longest step of a load on an elastic joint, as a share of its swing's time per radian: readings within 0.1 %.
ELASTIC = 0.2
#: For a thinned log: least number of steps between readings; largest growth of steps with the time since a condition
#: changed [1/s · s]; change of the supply that counts, as a share of its largest value.
BETWEEN, LATER, SMALL = 4, 0.05, 0.05
#: The same number for a log with imposed speed, and its longest step in usual longest steps.
COARSELY, SLOWLY = 2, 4
#: Share of a run's largest speed below which an imposed current is not averaged. A mean across a stop or a breakaway
#: leaves it with another speed.
RESTS = 0.1
#: Change of a speed from the third to the last quarter of an interval, as a share, above which it has not settled.
#: From rest a speed that nears steady travel exponentially and has reached half of it still changes by 0.23.
STILL = 0.2
#: Largest number of levels of a condition that changes within runs.
LEVELS = 6
#: Largest change of a stated mass within a run, apart from the payload [kg].
ROUNDING = 1e-3


def _to_rows(
    of_runs: Float[Array, "runs samples ..."], rows_of: Int[Array, "runs samples"], rows: int
) -> Float[Array, "rows ..."]:
    """Values of the samples of runs, rearranged into the rows of the table. Padding after the end of a run is
    dropped.
    """
    place = jnp.where(rows_of < 0, rows, rows_of)
    return jnp.zeros((rows, *of_runs.shape[2:]), of_runs.dtype).at[place].set(of_runs, mode="drop")


#: Distance from the prior from which a fit that did not converge, of a log with a missing effect, is not scanned for
#: other delays [prior sd].
LOST = 4.0
#: Distance from the lowest of several fits up to which one continues [half σ²], the margin of a class.
NEAR = 3.0


class HistoriesLinearization(Linearization):
    """Linearization of time histories.

    `defects` [SI] has shape (balances, runs, knots, samples, channels): the error of a balance has a value at each
    knot of a run. Copies with other scales share it, because it is large.

    Attributes:
        balances: indices of the balances of `defects`.
        rows_of: indices of each run's rows in order of time, padded with -1, shape (runs, samples).
        knots: rows between which an error is linear, shape (runs, knots).
        time: time of each row since the start of its run [s].
        angle: angle of the driving shaft since the start of the run [rad].
    """

    rows_of: Int[Array, "runs samples"]
    knots: Int[Array, "runs knots"]
    time: Float[Array, " rows"]
    angle: Float[Array, " rows"]
    balances: tuple[int, ...] = eqx.field(static=True, kw_only=True)

    def columns(self, balance: Scalar | int, shapes: Array | np.ndarray) -> Float[Array, "readings terms"]:
        place = jnp.argmax(jnp.asarray([*self.balances, balance]) == balance)
        defects = jnp.take(self.defects, place, 0, mode="fill")
        changes = jnp.einsum("rksc,rkt->rsct", defects, shapes[self.knots])
        return (_to_rows(changes, self.rows_of, self.rows) * self.scale[:, :, None]).reshape(-1, shapes.shape[1])

    def places(self) -> np.ndarray:
        return np.unique(np.asarray(self.knots))

    def runs(self) -> list[np.ndarray]:
        return [rows[rows >= 0] for rows in np.asarray(self.rows_of)]

    def variable(self, name: str) -> np.ndarray:
        if name in bases_room.ORDERS:
            return bases_room.ORDERS[name][0] * np.asarray(self.angle)
        return np.asarray(self.time) if name == "time" else super().variable(name)

    def turned(self) -> np.ndarray | None:
        return np.asarray(self.angle)

    def series(self) -> Float[Array, "runs samples channels"]:
        """Whitened residuals of the readings of each run in the order of time, 0 beyond its last."""
        return jnp.where(self.rows_of[:, :, None] < 0, 0.0, self.by_row()[self.rows_of])

    def memory(self) -> Array:
        """Statistic of Ljung and Box (1978) over all runs, as a normal deviate. The largest of the channels."""
        x, rows = self.series(), self.rows_of
        count = jnp.sum(rows >= 0, 1)[:, None]
        power = jnp.sum(x**2, 1)
        lags = min(LAGS, rows.shape[1] // 4)
        statistic = jnp.zeros(x.shape[-1])
        for k in range(1, lags + 1):
            r = jnp.sum(x[:, k:] * x[:, :-k], 1) / jnp.maximum(power, 1e-9)
            weight = jnp.where(count > k, count * (count + 2) / jnp.maximum(count - k, 1), 0.0)
            statistic = statistic + jnp.sum(weight * r**2, 0)
        freedom = jnp.maximum(jnp.sum(jnp.minimum(lags, count - 1)), 1)
        return jnp.max((statistic - freedom) / (2 * freedom) ** 0.5)


class Histories(Observer):
    """Observer of time histories: each `run_id` is a run of `drive` from standstill, each row is a sample.

    Sliding during a start is part of the run, so adhesion is not penalised. Histories have hundreds of readings per
    parameter, so the refits of a bootstrap stay within the linear range and are linear.

    Attributes:
        conditions: conditions of each run. A field that changes within a run has shape (runs, instants), others have
            (runs,).
        times: times of each run from 0 [s], shape (runs, instants). The last one is repeated up to a common length.
        run: index of each row's run.
        instant: index of its sample in `times`, shape (rows,).
        rows_of: indices of each run's rows in order of time, padded with -1, shape (runs, samples).
        knots: rows between which an error is linear, padded with the last one of the run, shape (runs, knots).
        delayed: True if imposed quantities may act later than their column states (`Rig.delay`). Readings are then
            taken earlier by the delay, between instants.
        known: simulated runs of the observed robot. None: not yet simulated.
    """

    word: ClassVar[str] = "sample"
    fewest: ClassVar[int] = 24
    axis: ClassVar[str] = "time_s"
    blocks: ClassVar[Names] = ("slope", "voltage", "run", "part")
    policy: ClassVar[SearchPolicy] = SearchPolicy(batch=8, steps=30, searches=8, one_by_one=False)
    rows_tell: ClassVar[bool] = False
    evidence: ClassVar[Names] = ("single", "curve", "pair", "chi2", "white")
    searches: ClassVar[int | None] = 8

    conditions: Conditions
    times: Float[Array, "runs instants"]
    run: Int[Array, " rows"]
    instant: Int[Array, " rows"]
    rows_of: Int[Array, "runs samples"]
    knots: Int[Array, "runs knots"]
    delayed: bool = eqx.field(default=False, static=True)
    known: LinearisedRun | None = None

    @classmethod
    def accepts_table(cls, runs: Runs) -> bool:
        return runs.has("time_s")

    @classmethod
    def of(cls, runs: Runs, robot: Robot, fidelity: str | None = None, parts: int = 1) -> Histories:
        """Observer of a table. Rows may be in any order. A condition that is constant in a run is taken from its
        first row.

        Args: as for `Observer`. `parts`: number of steps in place of each step of a fit.
        """
        if fidelity is not None and fidelities.get_fidelity(fidelity).name != "drive":
            raise BadConfiguration(f"--model {fidelity}: {runs.source} holds time histories; they need --model drive")
        if runs.turns:
            raise BadConfiguration(
                f"{runs.source}: logs of both sides cannot be fitted; fit their settled turns (mmrjax settle "
                f"{runs.source} --robot FILE), or straight runs with the columns of one side"
            )
        if runs.has("held") and robot.loose:
            raise BadConfiguration(
                f"{runs.source}, held: got a clamp on a load with backlash or an elastic joint; leave these rows "
                "out, or remove backlash and stiffness"
            )
        whole_log, exact = runs.whole, robot.rig.imposed == "motor_speed"
        linear = robot.rig.between_rows == "linear"
        names, run = np.unique(runs.run_names, return_inverse=True)
        own_rows, rows_of_whole = ([table.in_order(name) for name in names] for table in (runs, whole_log))
        run_times = [runs["time_s"][m] for m in own_rows]
        # Rows of the log without a reading here are kept if the imposed quantity changes there.
        smooth = runs.log is not None and robot.rig.imposed == "motor_current" and not linear
        noted = [
            np.isin(whole_log["time_s"][rows], t)
            | exact
            | linear
            | _drive_changes(whole_log, rows, SMALL if smooth else 0.0)
            for rows, t in zip(rows_of_whole, run_times, strict=True)
        ]
        longest_steps = _longest_steps(runs, robot)
        if smooth:
            noted = [
                _begins_new_step(
                    whole_log["time_s"][rows], n | np.append(_near_rest(whole_log, robot, rows, RESTS), True)
                )
                for n, rows in zip(noted, rows_of_whole, strict=True)
            ]
            whole_log = _average_imposed_current(whole_log, rows_of_whole, noted)
        steps = [np.minimum.reduceat(h, np.flatnonzero(n)[:-1]) for h, n in zip(longest_steps, noted, strict=True)]
        change = LOOSE if robot.loose else CHANGE
        jumps, early = _drive_jumps(whole_log, rows_of_whole, robot.rig), 0.0
        if robot.controller is not None and robot.controller.rate:
            period = 1 / robot.controller.rate
            instants = [np.arange(0.0, whole_log["time_s"][rows[-1]], period) for rows in rows_of_whole]
            all_jumps = [np.union1d(at, x) for (at, _), x in zip(jumps, instants, strict=True)]
            jumps, early = [(x, np.ones(len(x))) for x in all_jumps], EARLIEST * period
        grids = [
            time_grid(whole_log["time_s"][rows[n]], *c, h, START if robot.has_ground else change, change, parts)
            for rows, n, c, h in zip(rows_of_whole, noted, jumps, steps, strict=True)
        ]
        # The last instant begins a step too, of length zero.
        longest, samples = _common_length(max(map(len, grids)) + 1), max(map(len, own_rows))
        times = np.stack([np.concatenate([g, np.repeat(g[-1], longest - len(g))]) for g in grids])
        instant = np.array([np.searchsorted(grids[r], t) for r, t in zip(run, runs["time_s"], strict=True)])
        rows = np.stack([np.concatenate([m, np.full(samples - len(m), -1)]) for m in own_rows])
        most = min(samples, KNOTS, max(8, int(KNOT_STEPS / times.size)))
        knots = np.stack([_choose_knots(m, most) for m in own_rows])
        conditions = _conditions_over_time(
            whole_log.conditions(robot), rows_of_whole, whole_log["time_s"], times + early, ON_LINES if linear else ()
        )
        if robot.rig.begins is not None:
            order = [robot.rig.begins.names.index(initial_state_name(str(n))) for n in names]
            conditions = eqx.tree_at(lambda c: c.begin, conditions, jnp.asarray(order), is_leaf=lambda x: x is None)
        index = [jnp.asarray(x) for x in (run, instant, rows, knots)]
        rig = robot.rig
        delayed = not rig.inherits or DELAY in rig.stated or not rig.prompt
        return cls(conditions, jnp.asarray(times), index[0], index[1], index[2], index[3], delayed=delayed)

    @classmethod
    def sizes(cls, runs: Runs) -> np.ndarray:
        """Root mean square of each channel, because histories pass through zero but the error of an instrument does
        not.
        """
        measured = runs.measured()
        finite = np.isfinite(measured)
        power = np.sum(np.where(finite, measured, 0.0) ** 2, 0) / np.maximum(finite.sum(0), 1)
        return np.broadcast_to(np.sqrt(power), measured.shape)

    @classmethod
    def check(cls, runs: Runs, noise: Noise) -> list[Remark | str]:
        names = runs.run_names
        for name in np.unique(names):
            run_rows = names == name
            if len(np.unique(runs["configuration"][run_rows])) > 1:
                raise BadData(
                    f"{runs.source}, configuration: run {name or '(no run_id)'} has several values; give each "
                    "its own run_id"
                )
            if runs.has("total_mass_kg"):
                empty = runs["total_mass_kg"][run_rows] - runs["payload_kg"][run_rows]
                if np.ptp(empty) > ROUNDING:
                    raise BadData(
                        f"{runs.source}, total_mass_kg: run {name or '(no run_id)'} changes by {np.ptp(empty):g} "
                        "kg apart from its payload; within a run only payload_kg may change"
                    )
        _check_signs(runs)
        remarks: list[Remark | str] = []
        if runs.log is not None:
            remarks.append(Remark("thinned", source=runs.source, rows=len(runs.log), kept=len(runs)))
        undriven = runs.run_names[(applied_drive(runs) == 0) & (runs["slope_deg"] != 0)]
        if len(undriven):
            remarks.append(
                Remark("stops_on_slope", runs=tuple(dict.fromkeys(str(n) or "(no run_id)" for n in undriven)))
            )
        return remarks

    @classmethod
    def with_initial_states(cls, robot: Robot, runs: Runs, noise: Noise) -> Robot:
        return measure_initial_states(robot, runs, noise)

    @classmethod
    def check_start(cls, runs: Runs, noise: Noise, robot: Robot) -> list[Remark | str]:
        """Checks that histories begin at their first row, usually at rest, with one sample at a time."""
        names, measured = runs.run_names, runs.measured()
        # Current rises within a millisecond; speeds and angles do not.
        resting = robot.rig.start == "rest" and robot.rig.imposed != "motor_speed"
        moving = [k for k, c in enumerate(runs.channels) if c.zero_at_rest and resting]
        for channel in (c for c in runs.channels if not c.over_time and runs.has(c.column)):
            raise BadData(
                f"{runs.source}, {channel.column}: not modelled over time; remove the column, or give settled "
                "runs without time_s"
            )
        for name in np.unique(names):
            run_rows = np.flatnonzero(names == name)
            first = run_rows[np.argmin(runs["time_s"][run_rows])]
            times, count = np.unique(runs["time_s"][run_rows], return_counts=True)
            if (count > 1).any():
                raise BadData(
                    f"{runs.source}, time_s: run {name or '(no run_id)'} has {count.max()} samples at "
                    f"{times[count.argmax()]:g} s; give each run its own run_id"
                )
            for k in moving:
                size = np.max(np.nan_to_num(np.abs(measured[run_rows, k])))
                limit = max(RESTING * size, RESTING_SD * noise.sd[first, k])
                if runs["time_s"][first] < EARLY and abs(measured[first, k]) > limit:
                    column, unit = runs.channels[k].column, runs.channels[k].unit
                    raise BadData(
                        f"{runs.source} row {first + 1}, time_s: run {name or '(no run_id)'} is moving at "
                        f"{runs['time_s'][first]:g} s ({runs[column][first]:g} {unit}); a history begins at "
                        "rest. If it began earlier, add a row then without readings. If it began in motion, set "
                        'start = "measured" or "free" in the robot\'s file. If it is settled, give one row a '
                        "run, without time_s"
                    )
        remarks: list[Remark | str] = []
        step = runs["time_s"].max() / STEPS
        if robot.rig.imposed != "motor_speed":
            step = max(step, *(h.max(initial=0.0) for h in _longest_steps(runs, robot)))
        if step > FAST * LONGEST:
            remarks.append(Remark("coarse_steps", lasts=float(runs["time_s"].max()), step=float(step)))
        return remarks

    @classmethod
    def check_settled(cls, runs: Runs) -> None:
        raise BadData(
            f"{runs.source}, time_s: only calibrate, compare and loop take time histories; expected one row per run"
        )

    @classmethod
    def settled(cls, runs: Runs, steady: bool = False) -> tuple[Runs, np.ndarray, np.ndarray]:
        """Medians over the later half of each run. The run has settled if it is long enough.

        In a run with changing conditions, the longest interval of forward drive counts, if it is long enough.
        """
        time, measured = runs["time_s"], runs.measured()
        stretches = [
            max((s for s in run if s.driven or s.whole), key=lambda s: s.lasts, default=run[0])
            for run in intervals_by_run(runs)
        ]
        stretches = [s for s in stretches if s.driven and (s.whole or s.lasts >= LASTING)]
        if steady:
            speeds = measured[:, [c.zero_at_rest and c.directed for c in runs.channels]]
            stretches = [s for s in stretches if not _changes_still(speeds, s.after(time, 0.5), s.after(time, 0.75))]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # a channel without readings
            settled_readings = [np.nanmedian(measured[s.after(time, 0.5)], 0) for s in stretches]
        first = np.array([s.rows[0] for s in stretches], int)
        return (
            runs.where(first),
            np.reshape(settled_readings, (-1, measured.shape[1])),
            np.array([s.lasts for s in stretches]),
        )

    @classmethod
    def identity(cls, runs: Runs) -> Names:
        """All columns, including the run, because repeated runs begin equally, at rest."""
        return tuple(runs.columns)

    @classmethod
    def shows(cls, effect: type[Effect]) -> bool:
        return not effect.needs_battery

    @classmethod
    def free(cls) -> tuple[Names, Names]:
        return ("motor.inductance", "motor.inertia", DELAY), ("inertia", settled_ends.STATIC, *settled_ends.SLIDING)

    def changes(
        self, robot: Robot, probes: tuple[Effect, ...], effects: tuple[ScoredEffect, ...], kind: Any = float
    ) -> tuple[Float[Array, "probes runs knots samples channels"], Float[Array, "runs samples channels instances"]]:
        """Changes of the readings by an error of the balance of each probe [unit of the balance], and by each effect
        at each point of its grid. A probe has amplitude 1. The error is 1 at a knot of a run and falls linearly to 0
        at the neighbouring knots.

        An effect with one amplitude enters one balance. So it changes a run as an error of that balance would, with
        the values of its term. Its memory follows from the run too. Between two instants, its change of a reading is
        linear. `kind`: type of the numbers.
        """
        probed = _ProbedRobot.of(robot, probes, effects)
        clock = self.times[jnp.arange(len(self.times))[:, None], self.instant[self.knots]]
        rows = jnp.where(self.rows_of < 0, 0, self.rows_of)
        followed_signals = self.with_simulated_runs(robot).known
        assert followed_signals is not None
        # One run at a time: each has a wide array, by its knots.
        inputs = self.conditions, clock, self.instant[rows], followed_signals, self.times, self.time[rows]
        knots, by_effects = jax.lax.map(
            lambda of_run: probed.changes(*of_run, kind=kind, delayed=self.delayed), inputs
        )
        return jnp.moveaxis(knots, 0, 1), by_effects

    def with_simulated_runs(self, robot: Robot) -> Histories:
        """Observer with the simulated runs of a robot."""
        if self.known is not None:
            return self
        simulated = jax.vmap(lambda c, t: linearise_run(robot, c, t))(self.conditions, self.times)
        return dataclasses.replace(self, known=simulated)

    def whole(self, robot: Robot) -> Signals:
        """Signals of each run at each instant, shape (runs, instants)."""
        whole_runs = jax.vmap(lambda c, t, k: history_signals(robot, c, t, k))(
            self.conditions, self.times, self.known
        )
        return jax.tree.map(lambda x: jnp.broadcast_to(x, self.times.shape), whole_runs)

    def at_rows(self, whole: Signals) -> Signals:
        """Signals at each row."""
        return jax.tree.map(lambda x: x[self.run, self.instant], whole)

    @property
    def time(self) -> Float[Array, " rows"]:
        """Time of each row since the start of its run [s]."""
        return self.times[self.run, self.instant]

    def angle(self, whole: Signals) -> Float[Array, " rows"]:
        """Angle of the driving shaft in each row since the start of its run [rad]."""
        speed = jnp.asarray(whole.speed_wheel)
        angle_steps = 0.5 * (speed[:, 1:] + speed[:, :-1]) * jnp.diff(self.times)
        angle = jnp.concatenate([jnp.zeros((len(angle_steps), 1)), jnp.cumsum(angle_steps, 1)], 1)
        return angle[self.run, self.instant]

    @property
    def of_rows(self) -> Any:
        """Conditions of each row as NumPy arrays, shape (rows,)."""
        run, instant = np.asarray(self.run), np.asarray(self.instant)
        conditions = jax.tree.map(np.asarray, self.conditions)
        return jax.tree.map(lambda x: x[run] if x.ndim == 1 else x[run, instant], conditions)

    @property
    def varying(self) -> bool:
        """True if some conditions change within a run."""
        return any(x.ndim > 1 for x in jax.tree.leaves(self.conditions))

    def stretches(self) -> list[list[ConstantInterval]]:
        """Intervals of constant conditions in each run."""
        rows_of, time, of_rows = np.asarray(self.rows_of), np.asarray(self.time), self.of_rows
        volts = np.where(of_rows.open > 0.5, 0.0, of_rows.voltage * of_rows.duty)
        volts = volts if of_rows.motor_current is None else of_rows.motor_current
        values = [x for name in CHANGING if (x := getattr(of_rows, name)) is not None]
        return [divide_run(rows[rows >= 0], time, values, volts) for rows in rows_of]

    @property
    def driven(self) -> Conditions:
        """Conditions under which the robot was driven, see `Observer.driven`.

        Backward travel on a slope is the same as forward travel on the opposite slope. Similar levels are merged.
        """
        if not self.varying:
            return self.conditions
        rows = self.of_rows
        if rows.held is not None:  # a clamp, not the drive, determines the motion
            free, drives = rows.held < 0.5, ("voltage", "motor_current")
            turned_by = {n: np.where(free, x, 0.0) for n in drives if (x := getattr(rows, n)) is not None}
            rows = dataclasses.replace(rows, held=None, **turned_by)
        braked = np.zeros(len(rows.voltage)) if rows.load_torque is None else _merge_levels(rows.load_torque)
        if rows.voltage_follows:
            driven_channel = "motor_current" if rows.motor_speed is None else "motor_speed"
            levels = _merge_levels(getattr(rows, driven_channel))
            drive_key = np.stack([rows.configuration, levels, rows.slope_deg, rows.payload, braked], 1)
            cases = np.unique(drive_key[levels != 0], axis=0, return_index=True)[1]
            cases = np.flatnonzero(levels != 0)[cases] if len(cases) else np.arange(1)
            imposed_values = {} if rows.motor_speed is None else {"motor_acceleration": np.zeros_like(levels)}
            imposed_values |= {} if rows.load_torque is None else {"load_torque": braked}
            steady = dataclasses.replace(rows, **{driven_channel: levels}, **imposed_values)
            return _conditions_of_rows(steady, cases)
        applied = np.where(rows.open > 0.5, 0.0, rows.voltage * rows.duty)
        some = np.flatnonzero(applied != 0) if (applied != 0).any() else np.arange(1)
        way = np.where(applied < 0, -1.0, 1.0)
        braked = way * braked
        turned_rows = dataclasses.replace(
            rows,
            voltage=_merge_levels(np.abs(applied)),
            slope_deg=_merge_levels(way * rows.slope_deg),
            payload=_merge_levels(rows.payload),
            load_torque=None if rows.load_torque is None else braked,
            duty=np.ones_like(rows.duty),
            open=np.zeros_like(rows.open),
        )
        drive_key = np.stack(
            [turned_rows.configuration, turned_rows.voltage, turned_rows.slope_deg, turned_rows.payload, braked], 1
        )[some]
        cases = some[np.unique(drive_key, axis=0, return_index=True)[1]]
        return _conditions_of_rows(turned_rows, cases)

    def late(self, every: tuple[Array, ...], rig: Rig) -> Float[Array, "rows ..."]:
        """Values within steps at the time of each row minus the delay of the rig.

        Args:
            every: arguments of `StepCourse.read` for every step, shape (runs, steps, ...) each.
            rig: rig with the delay.
        """

        def of_run(times: Array, every: tuple[Array, ...], time: Array) -> Array:
            step, share = rig.before(times, time)
            return StepCourse.read(tuple(x[step] for x in every), share)

        of_runs = jax.vmap(of_run)(self.times, every, self.time[self.rows_of])
        return _to_rows(of_runs, self.rows_of, len(self.run))

    def __call__(self, robot: Robot) -> Observation:
        def of_run(
            conditions: Conditions, times: Array, known: LinearisedRun | None, instants: Array, time: Array
        ) -> Array:
            """Readings in the rows of a run."""

            if not self.delayed:
                return _readings(robot, history_signals(robot, conditions, times, known, instants))
            step, share = robot.rig.before(times, time)
            return StepCourse.read(
                _readings_within_steps(robot, course_between_instants(robot, conditions, times, known, step)), share
            )

        places = self.instant[self.rows_of], self.time[self.rows_of]
        of_runs = jax.vmap(of_run)(self.conditions, self.times, self.known, *places)
        reading = _to_rows(of_runs, self.rows_of, len(self.run))
        followed = jnp.all(jnp.isfinite(reading), 1)
        status = jnp.where(followed, CONVERGED, FAILED)
        return Observation(reading, jnp.zeros(self.run.shape), status, jnp.zeros_like(status))

    @property
    def long(self) -> bool:
        return True

    @property
    def starts_from_steady(self) -> bool:
        return False

    def unreachable(self, status: np.ndarray) -> np.ndarray:
        return status == FAILED

    def number_of_included_runs(self, included: np.ndarray) -> int:
        return self.rows_of.shape[0]

    def noise_misfit(self, off: Callable[[], np.ndarray], counts: np.ndarray) -> float:
        """Expected χ² of noise. It is larger than the number of readings if neighbouring samples show that the sds
        are too small.

        Model errors nearly cancel in the differences of neighbouring samples (von Neumann, Ann. Math. Stat. 12
        (1941)).
        """
        residual, rows, total = off(), np.asarray(self.rows_of), 0.0
        first, second = rows[:, :-1].ravel(), rows[:, 1:].ravel()
        has_both = (first >= 0) & (second >= 0)
        for k in range(residual.shape[1]):
            is_compared = has_both & counts[first, k] & counts[second, k]
            residual_difference = np.abs(residual[second[is_compared], k] - residual[first[is_compared], k])
            usual = (
                residual_difference[residual_difference <= JUMP * np.median(residual_difference)]
                if len(residual_difference)
                else np.zeros(1)
            )
            total += counts[:, k].sum() * max(1.0, float(np.mean(usual**2)) / 2)
        return float(total)

    def linearise(self, problem: Problem, z: Array, effects: tuple[ScoredEffect, ...]) -> HistoriesLinearization:
        """Linearization at z, see `Observer.linearise`.

        Residuals and Jacobian come from the program of the searches. The changes by errors and effects (`responses`)
        are computed along its runs.
        """
        residual, jacobian, _, simulated = _evaluate_at(problem, z)
        robot, observe = problem.robot(jnp.asarray(z)), dataclasses.replace(self, known=simulated)
        scale = problem.data.weight / problem.data.sd
        places = {*bases_room.balances_of(problem.base), *itertools.chain(*bases_room.STANDS_FOR.values())}
        probed = tuple(k for k, b in enumerate(PROBED) if b in places)
        signatures, defects, signals, angle = _responses(observe, robot, effects, scale, probed)
        return HistoriesLinearization(
            residual,
            jacobian,
            signatures,
            defects,
            scale,
            signals,
            self.rows_of,
            self.knots,
            self.time,
            angle,
            balances=probed,
            channels=channels.channel_names(problem.channels),
            magnitudes=robot.rig.magnitudes,
        )

    def at_fit(self, problem: Problem, z: Numbers) -> Histories:
        """Observer with its runs as simulated at coordinates z, by the program of the searches."""
        return dataclasses.replace(self, known=_evaluate_at(problem, z)[3])

    def fit_replicate(
        self, problem: Problem, effects: tuple[ScoredEffect, ...], linear: Linearization, drawn: Array
    ) -> Linearization:
        return linear_replicate(problem.data, linear, drawn)

    def starts(
        self, problem: Problem, random: np.random.Generator, count: int, every: Problem | None = None
    ) -> Float[np.ndarray, "starts z"]:
        """Starts of searches, see `Observer.starts`: the fit of the log's equations in weak form, if the log shows
        its states.

        The equations do not show sliding. On ground where the robot may slide, a start from `settled_ends` is added.
        """

        def search_batch(blunt: Problem, starts: np.ndarray, steps: int) -> Optimum:
            weights = np.repeat(np.asarray(blunt.data.weight)[None], len(starts), 0)
            evaluate = _parallel_evaluator(blunt, weights, None)
            # The best parameters of each configuration are combined, so a search may be the best of one only.
            within = NEAR if len(blunt.base.configurations) == 1 else np.inf
            return search_rollouts(evaluate, starts, blunt.data, weights, steps, self.policy.batch, within=within)[0]

        regression = fit_weak_form(problem if every is None else every)
        begins = np.zeros((0, len(problem.coordinates))) if regression is None else regression.z[None]
        if problem.base.has_ground and problem.base.rig.imposed == "voltage":
            # Configurations are combined from many points. A regression already determines the drive of a single one.
            alone = regression is not None and len(problem.base.configurations) == 1
            count_of_draws, searches = settled_ends.FEW if alone else settled_ends.MANY
            draws = random.standard_normal((count_of_draws, len(problem.coordinates)))
            ends = settled_ends.starts_from_settled_ends(problem, draws, search_batch, searches)
            begins = np.concatenate([begins, ends[: max(1, count - len(begins)) if regression is None else 1]])
        elif regression is None:
            begins = super().starts(problem, random, count)
        return scans.place_at_minimum(problem, begins[:count])

    def scanned(self, problem: Problem) -> tuple[int, ...]:
        return scans.wide_coordinates(problem)

    def number_of_scan_points(self, problem: Problem, k: int) -> int:
        """Number of values of a scan.

        A delay has a spacing of at most an eighth of a sample, within `DELAYS`. If the log shows the voltage, the
        spacing is also at most half a current's rise time L/R.
        """
        if problem.coordinates.names[k] != DELAY:
            return SCANNED
        motor, time = problem.base.motor, np.unique(np.round(np.asarray(self.time), 9))
        rise = float(motor.inductance / motor.resistance) if problem.base.rig.shows_voltage else np.inf
        fine = min(0.125 * float(np.median(np.diff(time))), max(0.5 * rise, 1e-6)) if len(time) > 1 else 1.0
        steps_needed = 2 * scans.RANGE * float(problem.coordinates.spread[k]) / fine
        return int(2 ** np.clip(np.ceil(np.log2(steps_needed)), *np.log2(DELAYS)))

    def scan(self, problem: Problem, z: Array, k: int, values: Array) -> tuple[Array, Array]:
        """Scan of a coordinate, see `Observer.scan`. A delay only shifts the readings of a run, so one run serves all
        its values.
        """
        if problem.coordinates.names[k] == DELAY:
            return _scan_delays(problem, z, jnp.arange(len(z)) == k, values)
        scans_found = [
            _minimum_with_one_held(*linearise(problem, z.at[k].set(v))[:2], z.at[k].set(v), jnp.arange(len(z)) == k)
            for v in values
        ]
        return jnp.stack([cost for cost, _ in scans_found]), jnp.stack([at for _, at in scans_found])

    def search(
        self,
        problem: Problem,
        starts: Numbers,
        weights: Numbers,
        active: Numbers | None = None,
        *,
        rivals: bool = False,
        most: int | None = None,
    ) -> tuple[Optimum, Observation]:
        """Fits from several starts, see `Observer.search`. The runs are compiled once for all steps."""
        data, steps = problem.data, self.policy.steps if most is None else most
        of_same_readings = bool(np.all(weights == np.asarray(weights)[:1]))
        within = SAME if rivals else NEAR if of_same_readings else np.inf

        def search_from(starts: Numbers, members: slice = slice(None)) -> tuple[Optimum, Observation]:
            weight = np.asarray(weights)[members]
            evaluate = _parallel_evaluator(problem, weight, None if active is None else np.asarray(active)[members])
            return search_rollouts(evaluate, starts, data, weight, steps, self.policy.batch, within=within)

        optima = search_from(starts)
        near = np.asarray(optima[0].cost) < np.nanmin(optima[0].cost) + NEAR
        unended = ~np.asarray(optima[0].converged) & (np.asarray(optima[0].steps) >= steps)
        if most is None and np.any(near & unended):  # a proposal has to be an optimum
            optima = search_from(np.asarray(optima[0].z))
        if not rivals or not scans.scanned_coordinates(problem):
            return optima
        k = int(np.nanargmin(optima[0].cost))
        if most is not None and not optima[0].converged[k] and np.abs(optima[0].z[k]).max() > LOST:
            return optima

        def result_of_member(every: tuple[Optimum, Observation], k: int) -> tuple[Optimum, Observation]:
            return jax.tree.map(lambda leaf: leaf[k], every)

        def search_again(z: np.ndarray) -> tuple[Optimum, Observation]:
            return result_of_member(search_from(z[None], slice(k, k + 1)), 0)

        best = scans.search_lower_minima(
            problem.with_data(weight=weights[k]), result_of_member(optima, k), search_again, lambda _: None
        )
        put = lambda every, mine: np.concatenate([every[:k], np.asarray(mine)[None], every[k + 1 :]])  # noqa: E731
        return jax.tree.map(put, optima, best)

    def observation_at(self, problem: Problem, z: Numbers, active: Numbers | None = None) -> Observation:
        return self.at(problem, z, active)[2]

    def at(self, problem: Problem, z: Numbers, active: Numbers | None = None) -> tuple[Numbers, Numbers, Observation]:
        """Residuals, Jacobian and observation, see `Observer.at`, by the program of the searches."""
        return _evaluate_at(with_effects(problem, active), z)[:3]

    def bases(self, columns: Columns, included: np.ndarray, robot: Robot) -> Bases:
        """Bases of curves and windows as for settled runs, also over time, and waves over the angle of a shaft.

        Curves over the voltage use the motor voltage if it differs from the supply voltage.
        """
        rows = self.of_rows
        angle, electromotive, ways = jax.tree.map(lambda x: np.nan_to_num(np.asarray(x)), _shaft_motion(self, robot))
        if (rows.duty != 1).any():
            at_motors = np.where(rows.open > 0.5, electromotive, rows.voltage * rows.duty)
            columns = {**columns, "supply_voltage_V": at_motors}
        configuration = self.conditions.configuration
        on_tracks = np.broadcast_to(jax.vmap(robot.chassis)(configuration).on_tracks > 0.5, np.shape(configuration))
        scope = bases_room.CurveScope.of(robot, columns)
        waves = bases_room.wave_families(
            on_tracks[self.run], angle, np.asarray(self.rows_of), np.asarray(self.knots), scope.balances
        )
        return *bases_room.families_of_table(columns, included.astype(float), ways, scope), *waves

    def detail(self, bases: Bases, included: np.ndarray, before: Any, after: Any) -> TimeStatistics:
        names = bases_room.family_names(bases)
        orders = [w for w in bases_room.ORDERS if any(n[1] == w for n in names)]

        def strongest(diagnosis: Any, variable: str) -> StrongestWave | None:
            same_variable = [k for k, n in enumerate(names) if n[1] == variable]
            if not same_variable:
                return None
            k = max(same_variable, key=lambda j: np.asarray(diagnosis.scores.curve)[j])
            return StrongestWave(names[k][0], float(diagnosis.scores.curve[k]), float(diagnosis.scores.explained[k]))

        def statistics_of_fit(diagnosis: Any) -> FitOverTime:
            lags = min(LAGS, self.rows_of.shape[1] // 4)
            test = diagnosis.test
            x = np.asarray(diagnosis.linear.series())
            power = np.maximum(np.sum(x**2, (0, 1)), 1e-12)
            by_lag = [np.sum(x[:, k:] * x[:, :-k], (0, 1)) / power for k in range(1, lags + 1)]
            memory = ResidualMemory(
                float(test.found.white),
                test.threshold("white"),
                test.p("white"),
                lags,
                {name: [float(lag[k]) for lag in by_lag] for k, name in enumerate(diagnosis.linear.channels)},
            )
            waves = {(w, bases_room.ORDERS[w][0]): wave for w in orders if (wave := strongest(diagnosis, w))}
            return FitOverTime(memory, waves, strongest(diagnosis, "time"))

        samples = int((np.asarray(self.rows_of) >= 0).sum())
        unresolved = tuple(w for w in bases_room.ORDERS if w not in orders)
        return TimeStatistics(
            self.rows_of.shape[0], samples, unresolved, statistics_of_fit(before), statistics_of_fit(after)
        )


def _drive_jumps(runs: Runs, each: list[np.ndarray], rig: Rig) -> list[tuple[np.ndarray, np.ndarray]]:
    """Times of jumps of the motors' command in each run [s], and each jump relative to the run's largest command."""
    driven, time = applied_drive(runs), runs["time_s"]
    # An imposed speed determines the current; a linear drive does not jump; an unknown drive is refused later.
    jumps_known = (
        rig.imposed != "motor_speed" and rig.between_rows == "held" and np.isfinite(driven).all() and driven.any()
    )
    switches = [runs[column] == word for column, word in (("mode", "coast"), ("held", 1.0)) if runs.has(column)]
    driven, jumps = driven if jumps_known else np.zeros(len(runs)), []
    for rows in each:
        switched = (x[rows][1:] != x[rows][:-1] for x in switches)
        sizes = functools.reduce(np.maximum, switched, _relative_jumps(driven[rows]))
        jumps.append((time[rows[1:]][sizes > 0], sizes[sizes > 0]))
    return jumps


def _conditions_over_time(
    of_rows: Conditions,
    each: list[np.ndarray],
    time: np.ndarray,
    times: np.ndarray,
    on_lines: Names,
) -> Conditions:
    """Conditions of runs from those of rows, shape (runs,), or (runs, instants) if they change within a run.

    Args:
        of_rows: conditions of each row, shape (rows,).
        each: rows of each run in order of time.
        time: time of each row [s].
        times: instants of each run [s].
        on_lines: fields that are linear between rows. They are averaged over the step that begins at each instant.
    """
    middle = np.concatenate([0.5 * (times[:, 1:] + times[:, :-1]), times[:, -1:]], 1)
    conditions_there = np.stack(
        [
            rows[np.maximum(np.searchsorted(time[rows], t, side="right") - 1, 0)]
            for rows, t in zip(each, times, strict=True)
        ]
    )
    conditions = _conditions_of_rows(of_rows, np.array([rows[0] for rows in each]))
    for name in CHANGING:
        x = None if getattr(of_rows, name) is None else np.asarray(getattr(of_rows, name))
        if x is not None and any(np.ptp(x[rows]) > 0 for rows in each):
            values = x[conditions_there] if name not in on_lines else _interpolate_at_instants(x, each, time, middle)
            conditions = eqx.tree_at(operator.attrgetter(name), conditions, jnp.asarray(values))
    if of_rows.motor_speed is None:
        return conditions
    every = np.asarray(of_rows.motor_speed)
    speed = _interpolate_at_instants(every, each, time, times)
    # Rows are samples of a smooth motion. Slopes of the lines from row to row were those of half a row later.
    gradient = [
        np.gradient(every[rows], time[rows], edge_order=2 if len(rows) > 2 else 1) if len(rows) > 1 else np.zeros(1)
        for rows in each
    ]
    slope = np.stack([np.interp(t, time[rows], x) for rows, x, t in zip(each, gradient, times, strict=True)])
    # Not by `dataclasses.replace`, because its constructor would broadcast constant conditions over the instants.
    return eqx.tree_at(
        lambda c: (c.motor_speed, c.motor_acceleration),
        conditions,
        (jnp.asarray(speed), jnp.asarray(slope)),
        is_leaf=lambda x: x is None,
    )


def _conditions_of_rows(conditions: Conditions, rows: np.ndarray) -> Conditions:
    """Conditions of some rows, selected with NumPy so that nothing is compiled."""
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[rows]), conditions)


def _interpolate_at_instants(x: np.ndarray, each: list[np.ndarray], time: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Values at instants of each run, interpolated linearly between its rows, shape (runs, instants)."""
    return np.stack([np.interp(t, time[rows], x[rows]) for rows, t in zip(each, at, strict=True)])


def initial_state_name(run: str) -> str:
    """Name of a run's initial state among the parameters of the rig."""
    return f"begin_{re.sub(r'[^A-Za-z0-9_-]', '_', run)}"


#: Largest number of first samples that determine a run's initial state.
FIRST_SAMPLES = 5


def measure_initial_states(robot: Robot, runs: Runs, noise: Noise) -> Robot:
    """Robot with the initial states of a table's runs, if its rig states that they do not begin at rest.

    Speed and angle are extrapolated from the first samples to the first one. The error of this is the prior sd of an
    initial state that is fitted.
    """
    if robot.rig.start == "rest" or not runs.sampled:
        return robot
    measured = runs.measured()
    begins, state_priors = dict[str, RunStart](), []
    rows = runs.configurations(robot)
    for name in np.unique(runs.run_names):
        run_rows = runs.in_order(name)
        key = initial_state_name(str(name))
        state: dict[str, tuple[float, float]] = {}
        for k, channel in enumerate(runs.channels):
            field = "motor_speed" if channel.settled else "angle"
            finite = run_rows[np.isfinite(measured[run_rows, k])][:FIRST_SAMPLES]
            if channel.zero_at_rest and field not in state and len(finite):
                configuration = int(rows[run_rows[0]])
                radius = float(robot.configurations.members[configuration].radius)
                zero, one = jnp.zeros(()), jnp.ones(())
                rolling = State(zero, one, radius / robot.gearbox.ratio, zero, distance=radius)
                factor = 1 / float(
                    channel.read(robot, balances.begin_signals(robot, Conditions(configuration), rolling))
                )
                value, sd = _value_at_zero(runs["time_s"][finite] - runs["time_s"][run_rows[0]], measured[finite, k])
                usual_sd = float(np.median(noise.sd[finite, k]))
                state[field] = factor * value, abs(factor) * max(sd, usual_sd)
        begins[key] = RunStart(**{field: value for field, (value, _) in state.items()})
        state_priors += [(f"rig.{key}.{field}", value, sd) for field, (value, sd) in state.items()]
    priors = (*robot.rig.priors, *state_priors) if robot.rig.start == "free" else robot.rig.priors
    return dataclasses.replace(robot, rig=dataclasses.replace(robot.rig, begins=RunStarts(begins), priors=priors))


def _value_at_zero(time: np.ndarray, shown: np.ndarray) -> tuple[float, float]:
    """Value at time 0 of a line through samples, and its standard error. With fewer than three samples, their
    mean.
    """
    if len(time) < 3:
        return float(np.mean(shown)), 0.0
    matrix = np.stack([np.ones_like(time), time], 1)
    line, *_ = np.linalg.lstsq(matrix, shown, rcond=None)
    scatter = float(np.sum((shown - matrix @ line) ** 2) / (len(time) - 2))
    return float(line[0]), float(np.sqrt(scatter * np.linalg.inv(matrix.T @ matrix)[0, 0]))


def _merge_levels(x: np.ndarray) -> np.ndarray:
    """The numbers, each replaced by the nearest of `LEVELS` levels if there are more distinct values than that."""
    if len(np.unique(x)) <= LEVELS:
        return x
    levels = np.linspace(x.min(), x.max(), LEVELS)
    return levels[np.argmin(np.abs(x[:, None] - levels), 1)]


def _check_signs(runs: Runs) -> None:
    """Rejects unsigned speeds and currents if runs are driven backward.

    Inertia may carry a rig forward during one interval of backward drive, but not during all of a table.
    """
    if runs.layout.imposed in GOALS:  # an output may turn away from its goal
        return
    volts, measured = applied_drive(runs), runs.measured()
    time, size = runs["time_s"], np.nanmax(np.abs(measured), 0, initial=0.0)
    unsigned = np.nanmin(measured, 0, initial=0.0) >= -RESTING * size
    unsigned &= [runs.turns_round(c) for c in runs.channels]
    unit = runs.layout.imposed_column.rpartition("_")[2]
    for run in intervals_by_run(runs):
        for s in (s for s in run if volts[s.rows[0]] < 0 and s.lasts >= LASTING):
            rows = s.after(time, 0.5)
            for k in np.flatnonzero(unsigned):
                channel, readings = runs.channels[k], measured[rows, k][np.isfinite(measured[rows, k])]
                if readings.size and np.median(readings) > RESTING * size[k]:
                    raise BadData(
                        f"{runs.source} row {rows[0] + 1}, {channel.column}: got "
                        f"{runs[channel.column][rows[0]]:g} {channel.unit} at {volts[rows[0]]:g} {unit}; "
                        f"expected negative readings in reverse; or set [instruments.{channel.name}] signed = "
                        "false in the robot's file, if it shows a magnitude"
                    )


def _choose_knots(rows: np.ndarray, most: int) -> np.ndarray:
    """At most `most` rows of a run, evenly spaced, including its first and last. The last one is repeated as
    padding.
    """
    knot_rows = rows[np.unique(np.round(np.linspace(0, len(rows) - 1, most)).astype(int))]
    return np.concatenate([knot_rows, np.repeat(knot_rows[-1], most - len(knot_rows))])


def _changes_still(speeds: np.ndarray, half: np.ndarray, quarter: np.ndarray) -> bool:
    """True if a speed changes by more than `STILL` in the later half of an interval.

    Args:
        speeds: speed readings, shape (rows, channels).
        half, quarter: rows of the later half, and of the last quarter.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a channel without readings
        before, after = np.nanmedian(speeds[np.setdiff1d(half, quarter)], 0), np.nanmedian(speeds[quarter], 0)
    return bool(np.any(np.abs(after - before) > STILL * np.abs(before + after) / 2))


def _drive_changes(runs: Runs, rows: np.ndarray, share: float) -> np.ndarray:
    """True for rows of a run where its command changes. For the supply of motors, only changes above a share of
    the largest value count.
    """
    supplied = (runs.layout.imposed_column, SUPPLY, "duty")
    changes = differs_from_row_before(
        rows, (runs[column] for column in changing_columns(runs) if column not in supplied)
    )
    changes[1:] |= _relative_jumps(applied_drive(runs)[rows]) > share
    return changes


def _begins_new_step(time: np.ndarray, noted: np.ndarray) -> np.ndarray:
    """True for noted rows and rows that divide the time between them into parts of at most the usual longest step."""
    begin = time[np.maximum.accumulate(np.where(noted, np.arange(len(time)), 0))]
    part = np.floor((time - begin) / (FAST * LONGEST) + 1e-9)
    return noted | (np.diff(part, prepend=0.0) > 0)


def _average_imposed_current(runs: Runs, each: list[np.ndarray], noted: list[np.ndarray]) -> Runs:
    """Runs whose imposed current is averaged between noted rows.

    The means change the load's speed by the same amount. A small charge moves from each mean to the next one, so that
    the load also travels as far.
    """
    column, time = runs.layout.imposed_column, runs["time_s"]
    drive = runs[column].copy()
    for rows, begins in zip(each, noted, strict=True):
        lasts, first = np.diff(time[rows], append=time[rows[-1]]), np.flatnonzero(begins)
        middle, charge = time[rows] + lasts / 2, drive[rows] * lasts
        total, span, moment, middles = (
            np.add.reduceat(x, first) for x in (charge, lasts, charge * middle, lasts * middle)
        )
        centre = middles / np.where(span > 0, span, 1.0)
        moved = (total * centre - moment)[:-1] / np.where(span[1:] > 0, np.diff(centre), np.inf)
        total += np.append(moved, 0.0) - np.append(0.0, moved)
        mean = np.where(span > 0, total / np.where(span > 0, span, 1.0), drive[rows[first]])
        drive[rows] = mean[np.cumsum(begins) - 1]
    return dataclasses.replace(runs, columns={**runs.columns, column: drive})


def _relative_jumps(driven: np.ndarray) -> np.ndarray:
    """Change of a run's command from row to row, relative to its largest value."""
    return np.abs(np.diff(driven)) / max(float(np.abs(driven).max(initial=0.0)), 1e-300)


def _usual_interval(apart: np.ndarray) -> float:
    """Median time between a run's rows [s]. Infinite for a single row."""
    return float(np.median(apart)) if len(apart) else np.inf


def _near_rest(runs: Runs, robot: Robot, rows: np.ndarray, share: float) -> np.ndarray:
    """True between rows of a run where it may pass through rest, and earlier by the largest delay of the rig.

    There the measured speeds, or the rates of measured angles and positions, are below a share of their largest or
    change their sign. All True if no reading can tell.
    """
    channels = [k for k, c in enumerate(runs.channels) if c.zero_at_rest and (c.directed or not c.settled)]
    rates = [k for k, channel in enumerate(channels) if not runs.channels[channel].settled]
    speeds, time = runs.where(rows).measured()[:, channels], runs["time_s"][rows]
    speeds[:, rates] = np.gradient(speeds[:, rates], time, axis=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a channel without readings
        is_moving = np.abs(speeds) > share * np.nanmax(np.abs(speeds), 0, initial=0.0)
    ways = np.where(is_moving, np.sign(speeds), 0.0)
    slow = ~np.any((ways[1:] == ways[:-1]) & (ways[1:] != 0), 1)
    early = DELAYED * np.max(np.asarray(robot.rig.delay)) + EARLIER.get(robot.rig.imposed, 0.0)
    early_steps = int(np.ceil(early / _usual_interval(np.diff(time))))
    return np.convolve(slow, np.ones(early_steps + 1))[early_steps:] > 0


def _longest_steps(runs: Runs, robot: Robot) -> list[np.ndarray]:
    """Longest allowed step after each row of a log except the last, for each run in order of their names [s].

    With an imposed speed, only the memory of effects is simulated. If the command of a run changes its sign, and
    shafts and load do not move as one, friction jumps when a speed passes through zero. Steps must then be short
    compared with the time between readings near each such passage.
    """
    whole_log, rig, exact = runs.whole, robot.rig, robot.rig.imposed == "motor_speed"
    driven, found = None if exact else applied_drive(whole_log), []
    output_inertia = robot.motor.inertia * robot.gearbox.ratio**2
    elastic = (
        max(float(load.frequency(output_inertia)) for _, load in robot.configurations.items()) if robot.loose else 0.0
    )
    for name in np.unique(runs.run_names):
        rows = whole_log.in_order(name)
        time = whole_log["time_s"][rows]
        row_steps, wait = np.diff(time), _usual_interval(np.diff(runs["time_s"][runs.in_order(name)]))
        both_ways = driven is not None and driven[rows].min() < 0 < driven[rows].max()
        longest = np.full(len(row_steps), (FAST if both_ways else 1) * LONGEST)
        if driven is None:
            longest[:] = min(SLOWLY * LONGEST, wait / COARSELY)
        elif runs.log is not None:
            begins = np.where(_drive_changes(whole_log, rows, SMALL), np.arange(len(rows)), 0)
            time_in_run = time - time[np.maximum.accumulate(begins)]
            longest = np.maximum(longest, np.minimum(LATER * time_in_run[:-1], wait / BETWEEN))
        if both_ways and not robot.moves_as_one:
            slow = _near_rest(whole_log, robot, rows, SLOW[rig.imposed])
            longest[slow] = min(LONGEST, wait / FINE)
        if elastic > 0:
            longest = np.minimum(longest, ELASTIC / elastic)
        found.append(longest)
    return found


def _common_length(instants: int) -> int:
    """Next common length of a time grid, in eighths of powers of two.

    Logs of similar length then share compiled programs, at the cost of at most an eighth more steps, of length zero.
    """
    part = max(2 ** (instants.bit_length() - 1) // 8, 1)
    return -(-instants // part) * part


def _reading(robot: Robot, signals: Signals) -> Float[Array, " channels"]:
    sensor_readings = balances.sensor(robot, signals)
    return jnp.stack([sensor_readings[name] for name in channels.channel_names(robot.channels)], -1)


def _readings(robot: Robot, signals: Signals) -> Float[Array, "instants channels"]:
    return jax.vmap(lambda s: _reading(robot, s))(signals)


def _readings_within_steps(robot: Robot, steps: StepCourse) -> tuple[Array, ...]:
    """Readings, as arguments of `StepCourse.read`."""
    return *(_readings(robot, s) for s in (steps.first, steps.begin, steps.end)), steps.decays


@functools.partial(compiled, options=OVER_TIME)
def _shaft_motion(observe: Histories, robot: Robot) -> tuple[Array, Array, dict[str, Array]]:
    """Angle of the driving shaft, back-EMF and directions of travel in each row."""
    whole_runs = observe.whole(robot)
    rows = observe.at_rows(whole_runs)
    ways = {name: jnp.broadcast_to(getattr(rows, name), jnp.shape(rows.speed_motor)) for name in WAYS}
    return observe.angle(whole_runs), jnp.asarray(rows.voltage_back), ways


@functools.partial(compiled, options=OVER_TIME)
def _scan_delays(problem: Problem, z: Array, scanned: Array, values: Array) -> tuple[Array, Array]:
    observe: Histories = problem.observe  # type: ignore[assignment]
    data = problem.data

    def shown(z: Array) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        robot = problem.robot(z)
        of_run = lambda c, t, k: _readings_within_steps(robot, course_between_instants(robot, c, t, k))  # noqa: E731
        *measured, decays = jax.vmap(of_run)(observe.conditions, observe.times, observe.known)
        return tuple(measured), (*measured, decays)

    slopes, (*all_measured, decays) = jax.jacfwd(shown, has_aux=True)(z)
    values_and_slopes = [
        jnp.concatenate([x[..., None], slope], -1) for x, slope in zip(all_measured, slopes, strict=True)
    ]

    def one(value: Array) -> tuple[Array, Array]:
        coordinates = jnp.where(scanned, value, z)
        late = observe.late((*values_and_slopes, decays), problem.robot(coordinates).rig)
        error = data.weight * (late[..., 0] - data.measured) / data.sd
        finite = jnp.all(jnp.isfinite(late), -1)
        error = jnp.where(finite, error, MISSING * data.weight)
        jacobian = jnp.where(finite[..., None], (data.weight / data.sd)[..., None] * late[..., 1:], 0.0)
        residual = jnp.concatenate([error.ravel(), coordinates - data.centre])
        full_jacobian = jnp.concatenate([jacobian.reshape(-1, z.size), jnp.eye(z.size)])
        return _minimum_with_one_held(residual, full_jacobian, coordinates, scanned)

    return jax.lax.map(one, values, batch_size=16)


@compiled
def _minimum_with_one_held(residual: Array, jacobian: Array, z: Array, held: Array) -> tuple[Array, Array]:
    """Minimum of a linearised objective with one coordinate held, and the coordinates there."""
    free = jnp.where(held, 0.0, jacobian)
    step = -solve(free.T @ free + jnp.diag(held.astype(float)), free.T @ residual)
    return 0.5 * jnp.sum((residual + free @ step) ** 2), z + step


def _parallel_evaluator(problem: Problem, weights: Numbers, active: Numbers | None) -> Evaluate:
    """Function that evaluates the model for members of a search, in parallel.

    Args:
        weights, active: values for each member, see `Histories.search`.
    """

    weights, made = np.asarray(weights), threading.Event()

    def evaluate_one(z: np.ndarray, member: int) -> tuple[np.ndarray, np.ndarray, Observation]:
        slots = None if active is None else np.asarray(active)[member]
        return _evaluate_at(with_effects(problem.with_data(weight=weights[member]), slots), z)[:3]

    def evaluate(z: np.ndarray, members: np.ndarray) -> tuple[np.ndarray, np.ndarray, Observation]:
        with Threads(CORES if made.is_set() else 1) as cores:
            results = list(cores.map(evaluate_one, z, members))
        made.set()  # the first call has compiled the program
        return jax.tree.map(lambda *x: np.stack(x), *results)

    return evaluate


@functools.partial(compiled, options=OVER_TIME)
def _evaluate(problem: Problem, z: Array) -> tuple[Array, Array, Observation, LinearisedRun]:
    """Result of `linearise_rollout` at z, and the simulated runs."""
    observe: Histories = problem.observe.with_simulated_runs(problem.robot(z))  # type: ignore[attr-defined]
    assert observe.known is not None
    r, jacobian, observation = linearise_rollout(dataclasses.replace(problem, observe=observe), z)
    penalties = adhesion_penalty_slice(problem.data)  # negative, because adhesion is not penalised
    return *zero_inactive_residuals(r, jacobian, penalties), observation, observe.known


def _evaluate_at(problem: Problem, z: Numbers) -> tuple[Numbers, Numbers, Observation, LinearisedRun]:
    """Result of `_evaluate`, as NumPy arrays."""
    return jax.device_get(_evaluate(problem, jnp.asarray(z)))


@functools.partial(compiled, options=SELDOM)
def _responses(
    observe: Histories, robot: Robot, effects: tuple[ScoredEffect, ...], scale: Array, probed: tuple[int, ...]
) -> tuple[Array, Array, Signals, Array]:
    """Signatures and balance errors for `HistoriesLinearization`, signals of each row, and the angle of the shaft
    there.

    Args:
        observe: observer with simulated runs.
        scale: scale of the readings [1/SI], shape (rows, channels).
        probed: indices of the balances with errors.
    """
    probes = tuple(balance_probe(PROBED[k]) for k in probed)
    defects, by_effects = observe.changes(robot, probes, effects, jnp.float32)  # hundreds of megabytes for a long log
    rows_of, rows = observe.rows_of, len(scale)
    signatures = _to_rows(by_effects, rows_of, rows) * scale[..., None]
    runs = observe.whole(robot)
    by_reading = signatures.reshape(scale.size, -1)
    return finite_or_zero(by_reading), finite_or_zero(defects), observe.at_rows(runs), observe.angle(runs)


class _ProbedRobot(NamedTuple):
    """A robot with probes in its balances, and the effects that change its readings through them.

    Attributes:
        every: all probes. Those whose errors are requested come first.
        size: number of the requested ones.
        effects: effects, with the shapes that the robot has.
        entering: index of the probe of each instance's balance, shape (instances,).
        enters: 1 if that balance has a probe, otherwise 0, shape (instances,).
        at_sensor: 1 if an instance is an error of the channel's instrument, otherwise 0, shape (channels, instances).
    """

    robot: Robot
    every: tuple[Effect, ...]
    size: int
    effects: tuple[ScoredEffect, ...]
    entering: np.ndarray
    enters: np.ndarray
    at_sensor: np.ndarray

    @classmethod
    def of(cls, robot: Robot, probes: tuple[Effect, ...], effects: tuple[ScoredEffect, ...]) -> _ProbedRobot:
        """Robot with these probes and further ones for the balances that the effects enter."""
        others = dict.fromkeys(e.effect.balance for e in effects if e.effect.balance != "sensor")
        entered = tuple(balance_probe(b) for b in others if b not in {p.balance for p in probes})
        rows_of_whole, size = (*probes, *entered), len(probes)
        effects = tuple(with_shape_of_robot(robot, e) for e in effects)
        counts, places = np.array([len(e.at) for e in effects], int), [p.balance for p in rows_of_whole]
        entering = np.array([places.index(b) if (b := e.effect.balance) in places else 0 for e in effects], int)
        entering = np.repeat(entering, counts)
        enters = np.repeat([1.0 * (e.effect.balance in places) for e in effects], counts)
        shown_channels = channels.channel_names(robot.channels)
        at_sensor = np.array([[e.effect.channel == c for e in effects] for c in shown_channels], float)
        at_sensor = np.repeat(at_sensor, counts, 1) if effects else np.zeros((len(shown_channels), 0))
        return cls(robot, rows_of_whole, size, effects, entering, enters, at_sensor)

    def at(self, amplitude: Array) -> Robot:
        """Robot with the probes at amplitudes [units of their balances], shape (probes,)."""
        put = tuple(eqx.tree_at(lambda e: e.amplitude, p, a) for p, a in zip(self.every, amplitude, strict=True))
        return dataclasses.replace(self.robot, effects=(*self.robot.effects, *put))

    def changes(
        self,
        conditions: Conditions,
        clock: Array,
        instants: Array,
        along: LinearisedRun,
        times: Array,
        time: Array,
        *,
        kind: Any,
        delayed: bool,
    ) -> tuple[Array, Array]:
        """Changes of a run's readings by an error at each knot, and by each effect.

        Args:
            conditions: conditions of the run.
            clock: times of the knots [s].
            instants: index of the instant of each sample.
            along: the simulated run.
            times: times of the instants [s].
            time: times of the samples [s].
            kind: type of the numbers.
            delayed: True if readings are delayed.
        """
        robot, size, none = self.robot, self.size, jnp.zeros(len(self.every))
        remembered, hat = _memory_along_run(robot, conditions, along, self.effects), _hat_functions(clock)

        def terms(t: Array, y: Array, held: Conditions, way: Array | None = None) -> Array:
            signals = moving(robot, held, state_of_unknowns(robot, y), way)
            return effect_terms(robot, signals, self.effects, remembered(t))

        def both(by_probes: Array, t: Array, term: Array) -> Array:
            """Changes by defects at all knots and by each instance, from the change by each probe."""
            knots = (by_probes[:, :size, None] * hat(t)).reshape(len(by_probes), -1)
            return jnp.concatenate([knots, by_probes[:, self.entering] * (self.enters * term)], 1)

        def source(t: Array, y: Array, held: Conditions, way: Array) -> Array:
            by_probes = jax.jacfwd(lambda a: drive_rates(self.at(a), held, y, way))(none)
            return both(by_probes, t, terms(t, y, held, way))

        def seen(t: Array, y: Array, dy: Array, held: Conditions) -> Array:
            """Changes through the state, and immediate ones: with an imposed speed, current follows from torque."""

            def reading(y: Array, amplitude: Array) -> Array:
                if held.held is not None:
                    return _reading(robot, signals_of_instant(self.at(amplitude), held, y, HELD * held.held))
                return _reading(robot, moving(self.at(amplitude), held, state_of_unknowns(robot, y)))

            by_state, at_once = jax.jacfwd(reading, (0, 1))(y, none)
            term = terms(t, y, held)
            shows = jnp.concatenate([jnp.zeros((len(by_state), size * len(clock))), self.at_sensor * term], 1)
            return (by_state @ dy + both(at_once, t, term) + shows).astype(kind)

        first, begins = first_conditions_and_state(robot, conditions)
        by_probes = jax.jacfwd(lambda a: first_conditions_and_state(self.at(a), conditions)[1])(none)
        begin_changes = by_probes[:, self.entering] * (self.enters * terms(clock[0], begins, first))
        unmoved = jnp.concatenate([jnp.zeros((len(begins), size * len(clock))), begin_changes], 1)
        changed = run_response(conditions, along, source, seen, unmoved)
        wide, at_begin = size * len(clock), seen(clock[0], begins, unmoved, first)
        knots = jnp.where(instants[:, None, None] > 0, changed[instants - 1, :, :wide], at_begin[:, :wide])
        knots = knots.reshape(len(instants), -1, size, len(clock))
        own_changes = jnp.concatenate([at_begin[None, :, wide:], changed[:, :, wide:]])
        if delayed:
            step, share = robot.rig.before(times, time)
            by_effects = own_changes[step] + share[:, None, None] * (own_changes[step + 1] - own_changes[step])
        else:
            by_effects = own_changes[instants]
        return knots.transpose(2, 3, 0, 1), by_effects


def _hat_functions(clock: Array) -> Callable[[Array], Array]:
    """Function of time that returns the hat function of each knot, shape (knots,).

    A hat is 1 at its knot and falls linearly to 0 at the neighbouring knots.
    """
    # A run that ended early repeats its last knot; only the first of these has a hat.
    real = jnp.concatenate([jnp.ones(1), (jnp.diff(clock) > 0).astype(clock.dtype)])
    before = jnp.concatenate([clock[:1], clock[:-1]])
    after = jnp.concatenate([clock[1:], clock[-1:] + 1.0])

    def hats(t: Array) -> Array:
        rising = ((t - before) / jnp.maximum(clock - before, 1e-12)).at[0].set(1.0)
        falling = jnp.where(after > clock, (after - t) / jnp.where(after > clock, after - clock, 1.0), 1.0)
        return real * jnp.clip(jnp.minimum(rising, falling), 0.0, 1.0)

    return hats


def _memory_along_run(
    robot: Robot, conditions: Conditions, along: LinearisedRun, effects: tuple[ScoredEffect, ...]
) -> Callable[[Array], list[Array]]:
    """Function of time that returns the memory of each effect along a simulated run, at each point of its grid.

    It follows the stages of the run (`histories.linearise_run`). The rate of a memory is linear, or nearly so, in the
    memory.
    """
    with_memory = [e for e in effects if e.effect.memory_size is not None]
    counts = np.cumsum([len(e.at) for e in with_memory])
    no_memory = [jnp.zeros(len(e.at)) for e in effects]
    if not with_memory:
        return lambda t: no_memory

    def split(memory: Array) -> list[Array]:
        return jnp.split(memory, counts[:-1])

    def memory_rates(y: Array, held: Conditions, way: Array, memory: Array) -> Array:
        signals = moving(robot, held, state_of_unknowns(robot, y), way)

        def rate(effect: Effect, remembered: Array) -> Array:
            with_memory = dataclasses.replace(signals, memory={**signals.memory, effect.name: remembered})
            return jnp.asarray(effect.rate(robot, with_memory), float)

        return jnp.concatenate([map_over_shapes(e, rate, m) for e, m in zip(with_memory, split(memory), strict=True)])

    times = jnp.append(along.clock[:, 0], along.clock[-1, 2])
    steps, constant = run_steps(conditions, times)

    def after(memory: Array, step: tuple[LinearisedRun, RunStep]) -> tuple[Array, Array]:
        state_there, run_step = step
        conditions, spans, passes = run_step.held(constant), jnp.diff(state_there.clock), state_there.passes

        def solve_next_stage(memory: Array, span: Array, y: Array, way: Array) -> Array:
            law = lambda m: memory_rates(y, conditions, way, m)  # noqa: E731
            speed, slope = value_and_slope(law, memory)
            return memory + span * speed / (1 - span * slope)

        first = solve_next_stage(memory, spans[0], state_there.places[0], state_there.sides[0])
        step_ratio = jnp.where(passes, 1.0, spans[1] / jnp.where(spans[0] > 0, spans[0], 1.0))
        span = jnp.where(passes, spans[1], spans[0])
        last = solve_next_stage(
            memory + step_ratio * (first - memory), span, state_there.places[1], state_there.sides[1]
        )
        return last, jnp.stack([first, last])

    begin = first_conditions_and_state(robot, conditions)[1]
    angle = state_of_unknowns(robot, begin).distance / robot.chassis(conditions.configuration).radius
    memory_at_begin = jnp.concatenate(
        [
            map_over_shapes(
                e, lambda effect, _: jnp.asarray(effect.initial(robot, angle), float), jnp.zeros(len(e.at))
            )
            for e in with_memory
        ]
    )
    stages = jax.lax.scan(after, memory_at_begin, (along, steps))[1]
    nodes = jnp.concatenate([memory_at_begin[None], stages.reshape(-1, len(memory_at_begin))])
    clock = jnp.append(along.clock[0, 0], along.clock[:, 1:].ravel())

    def at_time(t: Array) -> list[Array]:
        k = jnp.clip(jnp.searchsorted(clock, t, side="right") - 1, 0, len(clock) - 2)
        length = clock[k + 1] - clock[k]
        share = jnp.clip(jnp.where(length > 0, (t - clock[k]) / jnp.where(length > 0, length, 1.0), 0.0), 0.0, 1.0)
        parts = iter(split(nodes[k] + share * (nodes[k + 1] - nodes[k])))
        return [
            zero if e.effect.memory_size is None else next(parts) for e, zero in zip(effects, no_memory, strict=True)
        ]

    return at_time
