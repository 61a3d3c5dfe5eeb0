"""Time histories: each `run_id` is a run from standstill, each row is a sample.

The conditions of a run may change from sample to sample. Each value holds from its sample until the next. An imposed
quantity is instead linear between samples if the rig's file says so (`Rig.between_rows`).
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import warnings
from collections.abc import Callable
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from calibration.data import Columns, Names
from calibration.data.clock import ConstantInterval, applied_drive, divide_run, intervals_by_run
from calibration.data.input_errors import BadConfiguration, BadData
from calibration.data.runs import Runs
from calibration.inference import bases as bases_room
from calibration.inference import details, linearization, optimizers, scans
from calibration.inference.bases import Bases
from calibration.inference.fit_notes import Remark
from calibration.inference.linearization import PROBED, Linearization, ScoredEffect
from calibration.inference.noise import Noise
from calibration.inference.observers import run_changes, run_grids, settled_ends
from calibration.inference.observers.base import Observer, SearchPolicy, parallel_evaluator, with_effects
from calibration.inference.optimizers import Numbers, Optimum
from calibration.inference.priors import DELAY
from calibration.inference.problem import MISSING, Observation, Problem
from calibration.inference.weak_form import fit_weak_form
from mmrjax import fidelities
from mmrjax.compile.compiling import OVER_TIME, SELDOM, compiled
from mmrjax.effects import Effect
from mmrjax.effects.curve import WAYS
from mmrjax.fidelities import histories
from mmrjax.fidelities.histories import LinearisedRun, StepCourse
from mmrjax.model import channels
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.quantities import GOALS
from mmrjax.model.rig import Rig
from mmrjax.model.robot import Robot
from mmrjax.model.signals import CONVERGED, FAILED, Signals
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
#: Shortest interval of unchanged conditions that may show steady travel [s].
LASTING = 0.25
#: Change of a speed from the third to the last quarter of an interval, as a share, above which it has not settled.
#: From rest a speed that nears steady travel exponentially and has reached half of it still changes by 0.23.
STILL = 0.2
#: Largest number of levels of a condition that changes within runs.
LEVELS = 6
#: Largest change of a stated mass within a run, apart from the payload [kg].
ROUNDING = 1e-3


def _to_rows(
    values_of_runs: Float[Array, "runs samples ..."], rows_of: Int[Array, "runs samples"], rows: int
) -> Float[Array, "rows ..."]:
    """Values of the samples of runs, rearranged into the rows of the table. Padding after the end of a run is
    dropped.
    """
    rows_or_end = jnp.where(rows_of < 0, rows, rows_of)
    return (
        jnp.zeros((rows, *values_of_runs.shape[2:]), values_of_runs.dtype)
        .at[rows_or_end]
        .set(values_of_runs, mode="drop")
    )


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

    def revealing_rows(self) -> np.ndarray:
        return np.unique(np.asarray(self.knots))

    def runs(self) -> list[np.ndarray]:
        return [rows[rows >= 0] for rows in np.asarray(self.rows_of)]

    def variable(self, name: str) -> np.ndarray:
        if name in bases_room.ORDERS:
            return bases_room.ORDERS[name][0] * np.asarray(self.angle)
        return np.asarray(self.time) if name == "time" else super().variable(name)

    def shaft_angle(self) -> np.ndarray | None:
        return np.asarray(self.angle)

    def series(self) -> Float[Array, "runs samples channels"]:
        """Whitened residuals of the readings of each run in the order of time, 0 beyond its last."""
        return jnp.where(self.rows_of[:, :, None] < 0, 0.0, self.by_row()[self.rows_of])

    def autocorrelation(self) -> Array:
        """Statistic of Ljung and Box (1978) over all runs, as a normal deviate. The largest of the channels."""
        residuals = self.series()
        rows = self.rows_of
        count = jnp.sum(rows >= 0, 1)[:, None]
        squares = jnp.sum(residuals**2, 1)
        lags = min(LAGS, rows.shape[1] // 4)
        statistic = jnp.zeros(residuals.shape[-1])
        for k in range(1, lags + 1):
            r = jnp.sum(residuals[:, k:] * residuals[:, :-k], 1) / jnp.maximum(squares, 1e-9)
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
        simulated_runs: simulated runs of the observed robot. None: not yet simulated.
    """

    word: ClassVar[str] = "sample"
    fewest: ClassVar[int] = 24
    axis: ClassVar[str] = "time_s"
    blocks: ClassVar[Names] = ("slope", "voltage", "run", "part")
    policy: ClassVar[SearchPolicy] = SearchPolicy(batch=8, steps=30, searches=8, one_by_one=False)
    one_row_reveals: ClassVar[bool] = False
    evidence: ClassVar[Names] = ("single", "curve", "pair", "chi2", "white")
    searches: ClassVar[int | None] = 8

    conditions: Conditions
    times: Float[Array, "runs instants"]
    run: Int[Array, " rows"]
    instant: Int[Array, " rows"]
    rows_of: Int[Array, "runs samples"]
    knots: Int[Array, "runs knots"]
    delayed: bool = eqx.field(default=False, static=True)
    simulated_runs: LinearisedRun | None = None

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
        names, run = np.unique(runs.run_names, return_inverse=True)
        rows_by_run, log_rows_by_run = ([table.in_order(name) for name in names] for table in (runs, runs.whole))
        grids, conditions, times = run_grids.grids_of_log(runs, robot, rows_by_run, log_rows_by_run, parts)
        instant = np.array([np.searchsorted(grids[r], t) for r, t in zip(run, runs["time_s"], strict=True)])
        sample_count = max(map(len, rows_by_run))
        rig = robot.rig
        rows_of = np.stack(
            [
                np.pad(rows_of_run, (0, sample_count - len(rows_of_run)), constant_values=-1)
                for rows_of_run in rows_by_run
            ]
        )
        knot_count = min(sample_count, KNOTS, max(8, int(KNOT_STEPS / times.size)))
        # Evenly spaced rows of each run, including its first and last.
        knots_by_run = [
            rows_of_run[np.unique(np.round(np.linspace(0, len(rows_of_run) - 1, knot_count)).astype(int))]
            for rows_of_run in rows_by_run
        ]
        knots = np.stack(
            [np.pad(knots_of_run, (0, knot_count - len(knots_of_run)), "edge") for knots_of_run in knots_by_run]
        )
        if rig.begins is not None:
            order = [rig.begins.names.index(run_grids.initial_state_name(str(n))) for n in names]
            conditions = eqx.tree_at(lambda c: c.begin, conditions, jnp.asarray(order), is_leaf=lambda x: x is None)
        indices = [jnp.asarray(x) for x in (run, instant, rows_of, knots)]
        delayed = not rig.inherits or DELAY in rig.stated or not rig.prompt
        return cls(conditions, jnp.asarray(times), indices[0], indices[1], indices[2], indices[3], delayed=delayed)

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
    def check_start(cls, runs: Runs, noise: Noise, robot: Robot) -> list[Remark | str]:
        """Checks that histories begin at their first row, usually at rest, with one sample at a time."""
        names = runs.run_names
        measured = runs.measured()
        # Current rises within a millisecond; speeds and angles do not.
        begins_at_rest = robot.rig.start == "rest" and robot.rig.imposed != "motor_speed"
        channels_at_rest = [k for k, c in enumerate(runs.channels) if c.zero_at_rest and begins_at_rest]
        for channel in (c for c in runs.present_channels if not c.over_time):
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
            for k in channels_at_rest:
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
        step = runs["time_s"].max() / histories.STEPS
        if robot.rig.imposed != "motor_speed":
            step = max(step, *(h.max(initial=0.0) for h in run_grids.longest_steps(runs, robot)))
        if step > run_grids.FAST * histories.LONGEST:
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
        time = runs["time_s"]
        measured = runs.measured()
        intervals = [
            max((s for s in run if s.driven or s.whole), key=lambda s: s.lasts, default=run[0])
            for run in intervals_by_run(runs)
        ]
        intervals = [s for s in intervals if s.driven and (s.whole or s.lasts >= LASTING)]
        if steady:
            speeds = measured[:, [c.zero_at_rest and c.directed for c in runs.channels]]
            intervals = [s for s in intervals if not _changes_still(speeds, s.after(time, 0.5), s.after(time, 0.75))]
        settled_readings = [_medians(measured[s.after(time, 0.5)]) for s in intervals]
        first, lasts = np.array([s.rows[0] for s in intervals], int), np.array([s.lasts for s in intervals])
        return runs.where(first), np.reshape(settled_readings, (-1, measured.shape[1])), lasts

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
        self, robot: Robot, probes: tuple[Effect, ...], effects: tuple[ScoredEffect, ...], number_type: Any = float
    ) -> tuple[Float[Array, "probes runs knots samples channels"], Float[Array, "runs samples channels instances"]]:
        """Changes of the readings by an error of the balance of each probe [unit of the balance], and by each effect
        at each point of its grid. A probe has amplitude 1. The error is 1 at a knot of a run and falls linearly to 0
        at the neighbouring knots.

        An effect with one amplitude enters one balance. So it changes a run as an error of that balance would, with
        the values of its term. Its memory follows from the run too. Between two instants, its change of a reading is
        linear. `number_type`: type of the numbers.
        """
        knot_times = self.times[jnp.arange(len(self.times))[:, None], self.instant[self.knots]]
        rows = jnp.where(self.rows_of < 0, 0, self.rows_of)
        simulated_runs = self.with_simulated_runs(robot).simulated_runs
        changes_of_run = run_changes.changes_of_run(
            robot, probes, effects, number_type=number_type, delayed=self.delayed
        )
        # One run at a time: each has a wide array, by its knots.
        inputs = self.conditions, knot_times, self.instant[rows], simulated_runs, self.times, self.time[rows]
        knots, by_effects = jax.lax.map(lambda run: changes_of_run(*run), inputs)
        return jnp.moveaxis(knots, 0, 1), by_effects

    def with_simulated_runs(self, robot: Robot) -> Histories:
        """Observer with the simulated runs of a robot."""
        if self.simulated_runs is not None:
            return self
        simulated = jax.vmap(lambda c, t: histories.linearise_run(robot, c, t))(self.conditions, self.times)
        return dataclasses.replace(self, simulated_runs=simulated)

    def signals_and_angle(self, robot: Robot) -> tuple[Signals, Array]:
        """Signals of a robot in each row, and the angle of its driving shaft since the start of the run [rad]."""
        run_signals = jax.vmap(lambda c, t, k: histories.history_signals(robot, c, t, k))
        signals = run_signals(self.conditions, self.times, self.simulated_runs)
        signals = jax.tree.map(lambda x: jnp.broadcast_to(x, self.times.shape), signals)
        speed = jnp.asarray(signals.speed_wheel)
        angle_steps = 0.5 * (speed[:, 1:] + speed[:, :-1]) * jnp.diff(self.times)
        angle = jnp.concatenate([jnp.zeros((len(angle_steps), 1)), jnp.cumsum(angle_steps, 1)], 1)
        return jax.tree.map(lambda x: x[self.run, self.instant], (signals, angle))

    @property
    def time(self) -> Float[Array, " rows"]:
        """Time of each row since the start of its run [s]."""
        return self.times[self.run, self.instant]

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

    def constant_intervals(self) -> list[list[ConstantInterval]]:
        """Intervals of constant conditions in each run."""
        rows_of = np.asarray(self.rows_of)
        time = np.asarray(self.time)
        of_rows = self.of_rows
        drive = np.where(of_rows.open > 0.5, 0.0, of_rows.voltage * of_rows.duty)
        drive = drive if of_rows.motor_current is None else of_rows.motor_current
        values = [x for name in run_grids.CHANGING if (x := getattr(of_rows, name)) is not None]
        return [divide_run(rows[rows >= 0], time, values, drive) for rows in rows_of]

    @property
    def driven(self) -> Conditions:
        """Conditions under which the robot was driven, see `Observer.driven`.

        Backward travel on a slope is the same as forward travel on the opposite slope. Similar levels are merged.
        """
        if not self.varying:
            return self.conditions
        rows = self.of_rows
        if rows.held is not None:  # a clamp, not the drive, determines the motion
            free = rows.held < 0.5
            drives = ("voltage", "motor_current")
            drive_without_clamp = {n: np.where(free, x, 0.0) for n in drives if (x := getattr(rows, n)) is not None}
            rows = dataclasses.replace(rows, held=None, **drive_without_clamp)
        brake_torque = np.zeros(len(rows.voltage)) if rows.load_torque is None else _merge_levels(rows.load_torque)
        if rows.voltage_follows:
            channel = "motor_current" if rows.motor_speed is None else "motor_speed"
            drive = _merge_levels(getattr(rows, channel))
            levels = {channel: drive}
            levels |= {} if rows.motor_speed is None else {"motor_acceleration": np.zeros_like(drive)}
            key = [drive, rows.slope_deg, rows.payload]
        else:
            drive = np.where(rows.open > 0.5, 0.0, rows.voltage * rows.duty)
            direction = np.where(drive < 0, -1.0, 1.0)
            brake_torque = direction * brake_torque
            levels = {"voltage": np.abs(drive), "slope_deg": direction * rows.slope_deg, "payload": rows.payload}
            levels = {name: _merge_levels(x) for name, x in levels.items()}
            key = [*levels.values()]
            levels |= {"duty": np.ones_like(rows.duty), "open": np.zeros_like(rows.open)}
        levels |= {} if rows.load_torque is None else {"load_torque": brake_torque}
        driven_rows = np.flatnonzero(drive != 0) if (drive != 0).any() else np.arange(1)
        distinct_cases = np.unique(
            np.stack([rows.configuration, *key, brake_torque], 1)[driven_rows], axis=0, return_index=True
        )[1]
        return run_grids.conditions_of_rows(dataclasses.replace(rows, **levels), driven_rows[distinct_cases])

    def delayed_values(self, steps: tuple[Array, ...], rig: Rig) -> Float[Array, "rows ..."]:
        """Values within steps at the time of each row minus the delay of the rig.

        Args:
            steps: arguments of `StepCourse.read` for every step, shape (runs, steps, ...) each.
            rig: rig with the delay.
        """

        def of_run(times: Array, steps: tuple[Array, ...], time: Array) -> Array:
            step, share = rig.before(times, time)
            return StepCourse.read(tuple(x[step] for x in steps), share)

        of_runs = jax.vmap(of_run)(self.times, steps, self.time[self.rows_of])
        return _to_rows(of_runs, self.rows_of, len(self.run))

    def __call__(self, robot: Robot) -> Observation:
        def of_run(
            conditions: Conditions, times: Array, simulated_run: LinearisedRun | None, instants: Array, time: Array
        ) -> Array:
            """Readings in the rows of a run."""
            if not self.delayed:
                return _readings(robot, histories.history_signals(robot, conditions, times, simulated_run, instants))
            step, share = robot.rig.before(times, time)
            course = histories.course_between_instants(robot, conditions, times, simulated_run, step)
            return StepCourse.read(_readings_within_steps(robot, course), share)

        places = self.instant[self.rows_of], self.time[self.rows_of]
        of_runs = jax.vmap(of_run)(self.conditions, self.times, self.simulated_runs, *places)
        reading = _to_rows(of_runs, self.rows_of, len(self.run))
        is_simulated = jnp.all(jnp.isfinite(reading), 1)
        status = jnp.where(is_simulated, CONVERGED, FAILED)
        return Observation(reading, jnp.zeros(self.run.shape), status, jnp.zeros_like(status))

    @property
    def long(self) -> bool:
        return True

    def unreachable(self, status: np.ndarray) -> np.ndarray:
        return status == FAILED

    def number_of_included_runs(self, included: np.ndarray) -> int:
        return len(np.unique(np.asarray(self.run)[included]))

    def noise_misfit(self, residuals: Callable[[], np.ndarray], counts: np.ndarray) -> float:
        """Expected χ² of noise. It is larger than the number of readings if neighbouring samples show that the sds
        are too small.

        Model errors nearly cancel in the differences of neighbouring samples (von Neumann, Ann. Math. Stat. 12
        (1941)).
        """
        whitened = residuals()
        rows = np.asarray(self.rows_of)
        total = 0.0
        first = rows[:, :-1].ravel()
        second = rows[:, 1:].ravel()
        has_both = (first >= 0) & (second >= 0)
        for k in range(whitened.shape[1]):
            is_compared = has_both & counts[first, k] & counts[second, k]
            change = np.abs(whitened[second[is_compared], k] - whitened[first[is_compared], k])
            noise_changes = change[change <= JUMP * np.median(change)] if len(change) else np.zeros(1)
            total += counts[:, k].sum() * max(1.0, float(np.mean(noise_changes**2)) / 2)
        return float(total)

    def linearise(self, problem: Problem, z: Array, effects: tuple[ScoredEffect, ...]) -> HistoriesLinearization:
        """Linearization at z, see `Observer.linearise`.

        Residuals and Jacobian come from the program of the searches. The changes by errors and effects (`responses`)
        are computed along its runs.
        """
        residual, jacobian, _, simulated = _evaluate_at(problem, z)
        robot = problem.robot(jnp.asarray(z))
        observe = dataclasses.replace(self, simulated_runs=simulated)
        scale = problem.data.weight / problem.data.sd
        places = {*bases_room.balances_of(problem.base), *itertools.chain(*bases_room.STANDS_FOR.values())}
        probed = tuple(k for k, b in enumerate(PROBED) if b in places)
        signatures, defects, signals, angle = _responses(observe, robot, effects, scale, probed)
        return HistoriesLinearization(
            residual, jacobian, signatures, defects, scale, signals, self.rows_of, self.knots, self.time, angle,
            balances=probed,
            channels=channels.channel_names(problem.channels),
            magnitudes=robot.rig.magnitudes,
        )  # fmt: skip

    def at_fit(self, problem: Problem, z: Numbers) -> Self:
        """Observer with its runs as simulated at coordinates z, by the program of the searches."""
        return dataclasses.replace(self, simulated_runs=_evaluate_at(problem, z)[3])

    def starts(
        self, problem: Problem, random: np.random.Generator, count: int, problem_of_log: Problem | None = None
    ) -> Float[np.ndarray, "starts z"]:
        """Starts of searches, see `Observer.starts`: the fit of the log's equations in weak form, if the log shows
        its states.

        The equations do not show sliding. On ground where the robot may slide, a start from `settled_ends` is added.
        """

        def search_batch(blunt: Problem, starts: np.ndarray, steps: int) -> Optimum:
            weights = np.repeat(np.asarray(blunt.data.weight)[None], len(starts), 0)
            evaluate = parallel_evaluator(blunt, weights, None)
            # The best parameters of each configuration are combined, so a search may be the best of one only.
            within = NEAR if len(blunt.base.configurations) == 1 else np.inf
            return optimizers.search_rollouts(
                evaluate, starts, blunt.data, weights, steps, self.policy.batch, within=within
            )[0]

        regression = fit_weak_form(problem if problem_of_log is None else problem_of_log)
        starts = np.zeros((0, len(problem.coordinates))) if regression is None else regression.z[None]
        if problem.base.has_ground and problem.base.rig.imposed == "voltage":
            # Configurations are combined from many points. A regression already determines the drive of a single one.
            is_drive_determined = regression is not None and len(problem.base.configurations) == 1
            count_of_draws, searches = settled_ends.FEW if is_drive_determined else settled_ends.MANY
            draws = random.standard_normal((count_of_draws, len(problem.coordinates)))
            ends = settled_ends.starts_from_settled_ends(problem, draws, search_batch, searches)
            starts = np.concatenate([starts, ends[: max(1, count - len(starts)) if regression is None else 1]])
        elif regression is None:
            starts = super().starts(problem, random, count)
        return scans.place_at_minimum(problem, starts[:count])

    def scanned(self, problem: Problem) -> tuple[int, ...]:
        return scans.wide_coordinates(problem)

    def number_of_scan_points(self, problem: Problem, k: int) -> int:
        """Number of values of a scan.

        A delay has a spacing of at most an eighth of a sample, within `DELAYS`. If the log shows the voltage, the
        spacing is also at most half a current's rise time L/R.
        """
        if problem.coordinates.names[k] != DELAY:
            return SCANNED
        motor = problem.base.motor
        time = np.unique(np.round(np.asarray(self.time), 9))
        rise = float(motor.inductance / motor.resistance) if problem.base.rig.shows_voltage else np.inf
        spacing = min(0.125 * float(np.median(np.diff(time))), max(0.5 * rise, 1e-6)) if len(time) > 1 else 1.0
        steps_needed = 2 * scans.RANGE * float(problem.coordinates.spread[k]) / spacing
        return int(2 ** np.clip(np.ceil(np.log2(steps_needed)), *np.log2(DELAYS)))

    def scan(self, problem: Problem, z: Array, k: int, values: Array) -> tuple[Array, Array]:
        """Scan of a coordinate, see `Observer.scan`. A delay only shifts the readings of a run, so one run serves all
        its values.
        """
        if problem.coordinates.names[k] == DELAY:
            return _scan_delays(problem, z, jnp.arange(len(z)) == k, values)
        costs, ends = [], []
        for point in (z.at[k].set(v) for v in values):
            linearised = optimizers.linearise(problem, point)[:2]
            cost, end = _minimum_with_one_held(*linearised, point, jnp.arange(len(z)) == k)
            costs.append(cost)
            ends.append(end)
        return jnp.stack(costs), jnp.stack(ends)

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
        steps = self.policy.steps if most is None else most
        have_same_readings = bool(np.all(weights == np.asarray(weights)[:1]))
        within = optimizers.SAME if rivals else NEAR if have_same_readings else np.inf

        def search_from(starts: Numbers, members: slice = slice(None)) -> tuple[Optimum, Observation]:
            weight = np.asarray(weights)[members]
            evaluate = parallel_evaluator(problem, weight, None if active is None else np.asarray(active)[members])
            return optimizers.search_rollouts(
                evaluate, starts, problem.data, weight, steps, self.policy.batch, within=within
            )

        optima = search_from(starts)
        is_near = np.asarray(optima[0].cost) < np.nanmin(optima[0].cost) + NEAR
        has_run_out = ~np.asarray(optima[0].converged) & (np.asarray(optima[0].steps) >= steps)
        if most is None and np.any(is_near & has_run_out):  # a proposal has to be an optimum
            optima = search_from(np.asarray(optima[0].z))
        if not rivals or not self.scanned(problem):
            return optima
        k = int(np.nanargmin(optima[0].cost))
        if most is not None and not optima[0].converged[k] and np.abs(optima[0].z[k]).max() > LOST:
            return optima

        def result_of_member(all_results: tuple[Optimum, Observation], k: int) -> tuple[Optimum, Observation]:
            return jax.tree.map(lambda leaf: leaf[k], all_results)

        def search_again(z: np.ndarray) -> tuple[Optimum, Observation]:
            return result_of_member(search_from(z[None], slice(k, k + 1)), 0)

        best = scans.search_lower_minima(
            problem.with_data(weight=weights[k]), result_of_member(optima, k), search_again, lambda _: None
        )
        return jax.tree.map(
            lambda old, new: np.concatenate([old[:k], np.asarray(new)[None], old[k + 1 :]]), optima, best
        )

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
        angle, electromotive, ways = jax.tree.map(np.nan_to_num, _shaft_motion(self, robot))
        if (rows.duty != 1).any():
            motor_voltage = np.where(rows.open > 0.5, electromotive, rows.voltage * rows.duty)
            columns = {**columns, "supply_voltage_V": motor_voltage}
        configuration = self.conditions.configuration
        on_tracks = np.broadcast_to(jax.vmap(robot.chassis)(configuration).on_tracks > 0.5, np.shape(configuration))
        scope = bases_room.CurveScope.of(robot, columns)
        waves = bases_room.wave_families(
            on_tracks[self.run], angle, np.asarray(self.rows_of), np.asarray(self.knots), scope.balances
        )
        return *bases_room.families_of_table(columns, included.astype(float), ways, scope), *waves

    def detail(self, bases: Bases, included: np.ndarray, before: Any, after: Any) -> details.TimeStatistics:
        names = bases_room.family_names(bases)
        orders = [w for w in bases_room.ORDERS if any(n[1] == w for n in names)]

        def strongest(diagnosis: Any, variable: str) -> details.StrongestWave | None:
            same_variable = [k for k, n in enumerate(names) if n[1] == variable]
            if not same_variable:
                return None
            k = max(same_variable, key=lambda j: np.asarray(diagnosis.scores.curve)[j])
            return details.StrongestWave(
                names[k][0], float(diagnosis.scores.curve[k]), float(diagnosis.scores.explained[k])
            )

        def statistics_of_fit(diagnosis: Any) -> details.FitOverTime:
            lags = min(LAGS, self.rows_of.shape[1] // 4)
            test = diagnosis.test
            x = np.asarray(diagnosis.linear.series())
            power = np.maximum(np.sum(x**2, (0, 1)), 1e-12)
            by_lag = np.array([np.sum(x[:, k:] * x[:, :-k], (0, 1)) / power for k in range(1, lags + 1)])
            autocorrelation = dict(zip(diagnosis.linear.channels, by_lag.T.tolist(), strict=True))
            waves = {(w, bases_room.ORDERS[w][0]): wave for w in orders if (wave := strongest(diagnosis, w))}
            return details.FitOverTime(
                float(test.found.white), test.threshold("white"), test.p("white"), autocorrelation, waves,
                strongest(diagnosis, "time"),
            )  # fmt: skip

        samples = int((np.asarray(self.rows_of) >= 0).sum())
        unresolved = tuple(w for w in bases_room.ORDERS if w not in orders)
        return details.TimeStatistics(
            self.rows_of.shape[0], samples, unresolved, statistics_of_fit(before), statistics_of_fit(after)
        )


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
    drive = applied_drive(runs)
    measured = runs.measured()
    time = runs["time_s"]
    size = np.nanmax(np.abs(measured), 0, initial=0.0)
    is_unsigned = np.nanmin(measured, 0, initial=0.0) >= -RESTING * size
    is_unsigned &= [runs.turns_round(c) for c in runs.channels]
    unit = runs.layout.imposed_column.rpartition("_")[2]
    for run in intervals_by_run(runs):
        for s in (s for s in run if drive[s.rows[0]] < 0 and s.lasts >= LASTING):
            rows = s.after(time, 0.5)
            for k in np.flatnonzero(is_unsigned):
                channel, readings = runs.channels[k], measured[rows, k][np.isfinite(measured[rows, k])]
                if readings.size and np.median(readings) > RESTING * size[k]:
                    raise BadData(
                        f"{runs.source} row {rows[0] + 1}, {channel.column}: got "
                        f"{runs[channel.column][rows[0]]:g} {channel.unit} at {drive[rows[0]]:g} {unit}; "
                        f"expected negative readings in reverse; or set [instruments.{channel.name}] signed = "
                        "false in the robot's file, if it shows a magnitude"
                    )


def _changes_still(speeds: np.ndarray, half: np.ndarray, quarter: np.ndarray) -> bool:
    """True if a speed changes by more than `STILL` in the later half of an interval.

    Args:
        speeds: speed readings, shape (rows, channels).
        half, quarter: rows of the later half, and of the last quarter.
    """
    before, after = _medians(speeds[np.setdiff1d(half, quarter)]), _medians(speeds[quarter])
    return bool(np.any(np.abs(after - before) > STILL * np.abs(before + after) / 2))


def _medians(readings: np.ndarray) -> np.ndarray:
    """Median of each channel, NaN without readings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.nanmedian(readings, 0)


def _readings(robot: Robot, signals: Signals) -> Float[Array, "instants channels"]:
    return jax.vmap(lambda s: run_changes.sensor_readings(robot, s))(signals)


def _readings_within_steps(robot: Robot, steps: StepCourse) -> tuple[Array, ...]:
    """Readings, as arguments of `StepCourse.read`."""
    return *(_readings(robot, s) for s in (steps.first, steps.begin, steps.end)), steps.decays


@functools.partial(compiled, options=OVER_TIME)
def _shaft_motion(observe: Histories, robot: Robot) -> tuple[Array, Array, dict[str, Array]]:
    """Angle of the driving shaft, back-EMF and directions of travel in each row."""
    rows, angle = observe.signals_and_angle(robot)
    ways = {name: jnp.broadcast_to(getattr(rows, name), jnp.shape(rows.speed_motor)) for name in WAYS}
    return angle, jnp.asarray(rows.voltage_back), ways


@functools.partial(compiled, options=OVER_TIME)
def _scan_delays(problem: Problem, z: Array, scanned: Array, values: Array) -> tuple[Array, Array]:
    observe: Histories = problem.observe  # type: ignore[assignment]
    data = problem.data

    def within_steps(z: Array) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        robot = problem.robot(z)

        def of_run(c: Conditions, t: Array, k: LinearisedRun | None) -> tuple[Array, ...]:
            return _readings_within_steps(robot, histories.course_between_instants(robot, c, t, k))

        *readings, decays = jax.vmap(of_run)(observe.conditions, observe.times, observe.simulated_runs)
        return tuple(readings), (*readings, decays)

    slopes, (*readings, decays) = jax.jacfwd(within_steps, has_aux=True)(z)
    pairs = zip(readings, slopes, strict=True)
    steps = *(jnp.concatenate([x[..., None], slope], -1) for x, slope in pairs), decays

    def minimum_at(value: Array) -> tuple[Array, Array]:
        coordinates = jnp.where(scanned, value, z)
        delayed = observe.delayed_values(steps, problem.robot(coordinates).rig)
        error = data.weight * (delayed[..., 0] - data.measured) / data.sd
        finite = jnp.all(jnp.isfinite(delayed), -1)
        error = jnp.where(finite, error, MISSING * data.weight)
        jacobian = jnp.where(finite[..., None], (data.weight / data.sd)[..., None] * delayed[..., 1:], 0.0)
        residual = jnp.concatenate([error.ravel(), coordinates - data.centre])
        full_jacobian = jnp.concatenate([jacobian.reshape(-1, z.size), jnp.eye(z.size)])
        return _minimum_with_one_held(residual, full_jacobian, coordinates, scanned)

    return jax.lax.map(minimum_at, values, batch_size=16)


@compiled
def _minimum_with_one_held(residual: Array, jacobian: Array, z: Array, held: Array) -> tuple[Array, Array]:
    """Minimum of a linearised objective with one coordinate held, and the coordinates there."""
    free = jnp.where(held, 0.0, jacobian)
    step = -solve(free.T @ free + jnp.diag(held.astype(float)), free.T @ residual)
    return 0.5 * jnp.sum((residual + free @ step) ** 2), z + step


@functools.partial(compiled, options=OVER_TIME)
def _evaluate(problem: Problem, z: Array) -> tuple[Array, Array, Observation, LinearisedRun]:
    """Result of `linearise_rollout` at z, and the simulated runs."""
    observe: Histories = problem.observe.with_simulated_runs(problem.robot(z))  # type: ignore[attr-defined]
    assert observe.simulated_runs is not None
    r, jacobian, observation = optimizers.linearise_rollout(dataclasses.replace(problem, observe=observe), z)
    penalties = optimizers.adhesion_penalty_slice(problem.data)  # negative, because adhesion is not penalised
    return *optimizers.zero_inactive_residuals(r, jacobian, penalties), observation, observe.simulated_runs


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
    probes = tuple(linearization.balance_probe(PROBED[k]) for k in probed)
    defects, by_effects = observe.changes(robot, probes, effects, jnp.float32)  # hundreds of megabytes for a long log
    signatures = _to_rows(by_effects, observe.rows_of, len(scale)) * scale[..., None]
    signatures, defects = (linearization.finite_or_zero(x) for x in (signatures.reshape(scale.size, -1), defects))
    return signatures, defects, *observe.signals_and_angle(robot)
