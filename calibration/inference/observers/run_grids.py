"""Time grids of the runs of a log, the conditions at their instants, and their initial states."""

from __future__ import annotations

import dataclasses
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from calibration.data import Names
from calibration.data.clock import applied_drive, changing_columns, differs_from_row_before
from calibration.data.columns import SUPPLY
from calibration.data.runs import Runs
from calibration.inference.noise import Noise
from calibration.inference.shown_states import with_condition
from mmrjax.fidelities import histories
from mmrjax.fidelities.histories import LONGEST
from mmrjax.model import balances
from mmrjax.model.conditions import Conditions
from mmrjax.model.quantities import GOALS
from mmrjax.model.rig import RunStart, RunStarts
from mmrjax.model.robot import Robot
from mmrjax.model.signals import State

#: Fields of `Conditions` that may change within a run.
CHANGING = (
    "voltage", "motor_current", "slope_deg", "payload", "adhesion", "total_mass", "duty", "open", "load_torque",
    "goal", "held",
)  # fmt: skip
#: Imposed quantities among these, and the torque of a brake, which is measured.
ON_LINES = ("voltage", "motor_current", "duty", "load_torque", "goal")
#: Fewest steps between samples near rest, for a run that is driven both ways, if shafts and load do not move as one.
#: Near rest: a speed is below a share of its largest, or will be within some time [s] plus this many times the delay.
#: Both depend on the imposed quantity: with an imposed current, the instant of rest depends more on the parameters.
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
#: Largest number of first samples that determine a run's initial state.
FIRST_SAMPLES = 5


def grids_of_log(
    runs: Runs, robot: Robot, rows_by_run: list[np.ndarray], log_rows_by_run: list[np.ndarray], parts: int
) -> tuple[list[np.ndarray], Conditions, np.ndarray]:
    """Instants of each run, the conditions there, and the instants of all runs as one array [s].

    In the array, shape (runs, instants), the last instant of a run is repeated up to a common length.

    Args:
        rows_by_run, log_rows_by_run: rows of each run in order of time, of the table and of the whole log.
        parts: number of equal steps into which each step is divided.
    """
    log = runs.whole
    rig = robot.rig
    time = runs.whole["time_s"]
    linear = rig.between_rows == "linear"
    every_row = linear or rig.imposed == "motor_speed"
    averaged = runs.log is not None and rig.imposed == "motor_current" and not linear
    is_kept_by_run = []
    for run_rows, rows in zip(rows_by_run, log_rows_by_run, strict=True):
        # Rows of the log without a reading here are kept if the imposed quantity changes there.
        is_kept = np.isin(time[rows], runs["time_s"][run_rows]) | every_row
        is_kept = is_kept | _drive_changes(log, rows, SMALL if averaged else 0.0)
        if averaged:
            is_kept = _begins_new_step(time[rows], is_kept | np.append(_near_rest(log, robot, rows, RESTS), True))
        is_kept_by_run.append(is_kept)
    log = _average_imposed_current(log, log_rows_by_run, is_kept_by_run) if averaged else log
    # An imposed speed determines the current; a linear drive does not jump; an unknown drive is refused later.
    drive = applied_drive(log)
    drive = np.zeros(len(log)) if every_row or not np.isfinite(drive).all() else drive
    switches = [log[column] == word for column, word in (("mode", "coast"), ("held", 1.0)) if log.has(column)]
    period = 0.0 if robot.controller is None or not robot.controller.rate else 1 / robot.controller.rate
    change = histories.LOOSE if robot.loose else histories.CHANGE
    grids = []
    for rows, is_kept, longest_steps_of_run in zip(
        log_rows_by_run, is_kept_by_run, longest_steps(runs, robot), strict=True
    ):
        sizes = np.maximum.reduce([_relative_jumps(drive[rows]), *(np.diff(x[rows]) for x in switches)])
        jumps, sizes = time[rows[1:]][sizes > 0], sizes[sizes > 0]
        if period:
            jumps = np.union1d(jumps, np.arange(0.0, time[rows[-1]], period))
            sizes = np.ones(len(jumps))
        steps = np.minimum.reduceat(longest_steps_of_run, np.flatnonzero(is_kept)[:-1])
        start = histories.START if robot.has_ground else change
        grids.append(histories.time_grid(time[rows[is_kept]], jumps, sizes, steps, start, change, parts))
    # The last instant begins a step too, of length zero.
    count = _common_length(max(map(len, grids)) + 1)
    times = np.stack([np.pad(grid, (0, count - len(grid)), "edge") for grid in grids])
    read_at = times + EARLIEST * period
    on_lines = ON_LINES if linear else ()
    return grids, _conditions_over_time(log.conditions(robot), log_rows_by_run, time, read_at, on_lines), times


def longest_steps(runs: Runs, robot: Robot) -> list[np.ndarray]:
    """Longest allowed step after each row of a log except the last, for each run in order of their names [s].

    With an imposed speed, only the memory of effects is simulated. If the command of a run changes its sign, and
    shafts and load do not move as one, friction jumps when a speed passes through zero. Steps must then be short
    compared with the time between readings near each such passage.
    """
    log = runs.whole
    imposed = robot.rig.imposed
    drive = None if imposed == "motor_speed" else applied_drive(log)
    output_inertia = robot.motor.inertia * robot.gearbox.ratio**2
    loads = robot.configurations.members if robot.loose else ()
    elastic = max((float(load.frequency(output_inertia)) for load in loads), default=0.0)
    steps_of_runs = []
    for name in np.unique(runs.run_names):
        rows = log.in_order(name)
        times = log["time_s"][rows]
        usual_interval = _usual_interval(runs["time_s"][runs.in_order(name)])
        changes_direction = drive is not None and drive[rows].min() < 0 < drive[rows].max()
        longest = np.full(len(rows) - 1, (FAST if changes_direction else 1) * LONGEST)
        if drive is None:
            longest[:] = min(SLOWLY * LONGEST, usual_interval / COARSELY)
        elif runs.log is not None:
            change_rows = np.where(_drive_changes(log, rows, SMALL), np.arange(len(rows)), 0)
            since = times - times[np.maximum.accumulate(change_rows)]
            longest = np.maximum(longest, np.minimum(LATER * since[:-1], usual_interval / BETWEEN))
        if changes_direction and not robot.moves_as_one:
            longest[_near_rest(log, robot, rows, SLOW[imposed])] = min(LONGEST, usual_interval / FINE)
        if elastic > 0:
            longest = np.minimum(longest, ELASTIC / elastic)
        steps_of_runs.append(longest)
    return steps_of_runs


def _drive_changes(runs: Runs, rows: np.ndarray, share: float) -> np.ndarray:
    """True for rows of a run where its command changes. For the supply of motors, only changes above a share of
    the largest value count.
    """
    supply_columns = (runs.layout.imposed_column, SUPPLY, "duty")
    is_change = differs_from_row_before(
        rows, (runs[column] for column in changing_columns(runs) if column not in supply_columns)
    )
    is_change[1:] |= _relative_jumps(applied_drive(runs)[rows]) > share
    return is_change


def _begins_new_step(time: np.ndarray, is_kept: np.ndarray) -> np.ndarray:
    """True for noted rows and rows that divide the time between them into parts of at most the usual longest step."""
    begin_times = time[np.maximum.accumulate(np.where(is_kept, np.arange(len(time)), 0))]
    part_index = np.floor((time - begin_times) / (FAST * LONGEST) + 1e-9)
    return is_kept | (np.diff(part_index, prepend=0.0) > 0)


def _average_imposed_current(runs: Runs, rows_by_run: list[np.ndarray], is_kept_by_run: list[np.ndarray]) -> Runs:
    """Runs whose imposed current is averaged between noted rows.

    The means change the load's speed by the same amount. A small charge moves from each mean to the next one, so that
    the load also travels as far.
    """
    column = runs.layout.imposed_column
    time = runs["time_s"]
    drive = runs[column].copy()
    for rows, is_kept in zip(rows_by_run, is_kept_by_run, strict=True):
        durations = np.diff(time[rows], append=time[rows[-1]])
        first = np.flatnonzero(is_kept)
        middle, charge = time[rows] + durations / 2, drive[rows] * durations
        charges, spans, charge_moments, time_moments = (
            np.add.reduceat(x, first) for x in (charge, durations, charge * middle, durations * middle)
        )
        centre = time_moments / np.where(spans > 0, spans, 1.0)
        transfer = (charges * centre - charge_moments)[:-1] / np.where(spans[1:] > 0, np.diff(centre), np.inf)
        charges += np.append(transfer, 0.0) - np.append(0.0, transfer)
        mean = np.where(spans > 0, charges / np.where(spans > 0, spans, 1.0), drive[rows[first]])
        drive[rows] = mean[np.cumsum(is_kept) - 1]
    return dataclasses.replace(runs, columns={**runs.columns, column: drive})


def _relative_jumps(drive: np.ndarray) -> np.ndarray:
    """Change of a run's command from row to row, relative to its largest value."""
    return np.abs(np.diff(drive)) / max(float(np.abs(drive).max(initial=0.0)), 1e-300)


def _usual_interval(time: np.ndarray) -> float:
    """Median time between a run's rows [s]. Infinite for a single row."""
    return float(np.median(np.diff(time))) if len(time) > 1 else np.inf


def _near_rest(runs: Runs, robot: Robot, rows: np.ndarray, share: float) -> np.ndarray:
    """True between rows of a run where it may pass through rest, and earlier by the largest delay of the rig.

    There the measured speeds, or the rates of measured angles and positions, are below a share of their largest or
    change their sign. All True if no reading can tell.
    """
    motion_channels = [k for k, c in enumerate(runs.channels) if c.zero_at_rest and (c.directed or not c.settled)]
    angle_columns = [k for k, channel in enumerate(motion_channels) if not runs.channels[channel].settled]
    speeds, time = runs.where(rows).measured()[:, motion_channels], runs["time_s"][rows]
    speeds[:, angle_columns] = np.gradient(speeds[:, angle_columns], time, axis=0)
    is_moving = np.abs(speeds) > share * np.nanmax(np.abs(speeds), 0, initial=0.0)
    directions = np.where(is_moving, np.sign(speeds), 0.0)
    is_slow = ~np.any((directions[1:] == directions[:-1]) & (directions[1:] != 0), 1)
    lead_time = DELAYED * np.max(np.asarray(robot.rig.delay)) + EARLIER.get(robot.rig.imposed, 0.0)
    early_steps = int(np.ceil(lead_time / _usual_interval(time)))
    return np.convolve(is_slow, np.ones(early_steps + 1))[early_steps:] > 0


def _common_length(instants: int) -> int:
    """Next common length of a time grid, in eighths of powers of two.

    Logs of similar length then share compiled programs, at the cost of at most an eighth more steps, of length zero.
    """
    part = max(2 ** (instants.bit_length() - 1) // 8, 1)
    return -(-instants // part) * part


# --- conditions and initial states ----------------------------------------------------------------------


def _conditions_over_time(
    row_conditions: Conditions, rows_by_run: list[np.ndarray], time: np.ndarray, times: np.ndarray, on_lines: Names
) -> Conditions:
    """Conditions of runs from those of rows, shape (runs,), or (runs, instants) if they change within a run.

    Args:
        row_conditions: conditions of each row, shape (rows,).
        rows_by_run: rows of each run in order of time.
        time: time of each row [s].
        times: instants of each run [s].
        on_lines: fields that are linear between rows. They are averaged over the step that begins at each instant.
    """

    def interpolated(x: np.ndarray, instants: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(t, time[rows], x[rows]) for rows, t in zip(rows_by_run, instants, strict=True)])

    middle = np.concatenate([0.5 * (times[:, 1:] + times[:, :-1]), times[:, -1:]], 1)
    row_before = np.stack([
        rows[np.maximum(np.searchsorted(time[rows], t, side="right") - 1, 0)]
        for rows, t in zip(rows_by_run, times, strict=True)
    ])  # fmt: skip
    conditions = conditions_of_rows(row_conditions, np.array([rows[0] for rows in rows_by_run]))
    for name in CHANGING:
        x = None if getattr(row_conditions, name) is None else np.asarray(getattr(row_conditions, name))
        if x is not None and any(np.ptp(x[rows]) > 0 for rows in rows_by_run):
            values = interpolated(x, middle) if name in on_lines else x[row_before]
            conditions = with_condition(conditions, name, jnp.asarray(values))
    if row_conditions.motor_speed is None:
        return conditions
    speed = np.asarray(row_conditions.motor_speed)
    # Rows are samples of a smooth motion. Slopes of the lines from row to row were those of half a row later.
    slope = np.zeros(len(speed))
    for rows in (rows for rows in rows_by_run if len(rows) > 1):
        slope[rows] = np.gradient(speed[rows], time[rows], edge_order=2 if len(rows) > 2 else 1)
    # Not by `dataclasses.replace`, because its constructor would broadcast constant conditions over the instants.
    return eqx.tree_at(
        lambda c: (c.motor_speed, c.motor_acceleration),
        conditions,
        (jnp.asarray(interpolated(speed, times)), jnp.asarray(interpolated(slope, times))),
        is_leaf=lambda x: x is None,
    )


def conditions_of_rows(conditions: Conditions, rows: np.ndarray) -> Conditions:
    """Conditions of some rows, selected with NumPy so that nothing is compiled."""
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[rows]), conditions)


def initial_state_name(run: str) -> str:
    """Name of a run's initial state among the parameters of the rig."""
    return f"begin_{re.sub(r'[^A-Za-z0-9_-]', '_', run)}"


def measure_initial_states(robot: Robot, runs: Runs, noise: Noise) -> Robot:
    """Robot with the initial states of a table's runs, if its rig states that they do not begin at rest.

    Speed and angle are extrapolated from the first samples to the first one. The error of this is the prior sd of an
    initial state that is fitted.
    """
    if robot.rig.start == "rest" or not runs.sampled:
        return robot
    measured = runs.measured()
    configuration_of_rows = runs.configurations(robot)
    time = runs["time_s"]
    begins = dict[str, RunStart]()
    state_priors = list(robot.rig.priors)
    for name in np.unique(runs.run_names):
        run_rows = runs.in_order(name)
        key = initial_state_name(str(name))
        state: dict[str, float] = {}
        for k, channel in enumerate(runs.channels):
            field = "motor_speed" if channel.settled else "angle"
            first_samples = run_rows[np.isfinite(measured[run_rows, k])][:FIRST_SAMPLES]
            if channel.zero_at_rest and field not in state and len(first_samples):
                configuration = int(configuration_of_rows[run_rows[0]])
                radius = float(robot.configurations.members[configuration].radius)
                zero = jnp.zeros(())
                one = jnp.ones(())
                rolling = State(zero, one, radius / robot.gearbox.ratio, zero, distance=radius)
                signals = balances.begin_signals(robot, Conditions(configuration), rolling)
                factor = 1 / float(channel.read(robot, signals))
                value, sd = _value_at_zero(time[first_samples] - time[run_rows[0]], measured[first_samples, k])
                state[field] = factor * value
                sd = abs(factor) * max(sd, float(np.median(noise.sd[first_samples, k])))
                state_priors.append((f"rig.{key}.{field}", state[field], sd))
        begins[key] = RunStart(**state)
    priors = tuple(state_priors) if robot.rig.start == "free" else robot.rig.priors
    return dataclasses.replace(robot, rig=dataclasses.replace(robot.rig, begins=RunStarts(begins), priors=priors))


def _value_at_zero(time: np.ndarray, readings: np.ndarray) -> tuple[float, float]:
    """Value at time 0 of a line through samples, and its standard error. With fewer than three samples, their
    mean.
    """
    if len(time) < 3:
        return float(np.mean(readings)), 0.0
    matrix = np.stack([np.ones_like(time), time], 1)
    line, *_ = np.linalg.lstsq(matrix, readings, rcond=None)
    scatter = float(np.sum((readings - matrix @ line) ** 2) / (len(time) - 2))
    return float(line[0]), float(np.sqrt(scatter * np.linalg.inv(matrix.T @ matrix)[0, 0]))
