"""Checks of rows: contradictions between columns, missing columns with a default, and repeated readings."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from calibration.data import configuration_tables, contradictions
from calibration.data.columns import (
    DEFAULTS,
    DRIVEN,
    LOAD,
    SPEED,
    SPEEDS,
    SUPPLY,
    TIME,
    WHEN,
)
from calibration.data.input_errors import BadData, rows_text, three_digits
from calibration.data.named_arrays import Check
from calibration.data.table import Runs
from mmrjax.model import channels
from mmrjax.model.channels import Channel
from mmrjax.model.quantities import VOLTAGE
from mmrjax.model.robot import Load, Robot

#: Fewest rows between two readings of a slow sensor, and fewest readings.
APART, FEWEST = 2, 12
#: Largest share of changes before a full period, and smallest share after a whole number of periods.
SOONER, REGULAR = 0.02, 0.8
#: Smallest share of rows that repeat the row before, and smallest ratio of the periods of recordings.
LEAST, ALIKE = 0.3, 0.8
#: Step of a clock that begins a run, in usual steps, and most of such steps.
JUMP, MOST_JUMPS = 100.0, 20
#: If at least this share of changes are by one smallest step, repeats are attributed to the display.
STEPS = 0.5


def reading_period(values: np.ndarray) -> float:
    """Number of rows between two readings of a slow sensor in a log. 0 for a channel with a new reading in every row.

    A slow sensor changes at even intervals of two rows or more, and rarely sooner. An instrument with coarse
    resolution also repeats numbers, but changes by its smallest step or at irregular intervals.

    Args:
        values: readings of a channel in one recording, in order of time, NaN if missing.
    """
    changes = np.diff(values[np.isfinite(values)])
    gaps, size = np.diff(np.flatnonzero(changes)), np.abs(changes[changes != 0])
    if len(gaps) < FEWEST or (size <= 1.5 * size.min()).mean() > STEPS:
        return 0.0
    usual = float(np.median(gaps))
    near = gaps[gaps <= 1.5 * usual]
    rows = usual if abs(near.mean() - usual) < 0.25 and (near == usual).mean() > 0.5 else float(near.mean())
    if usual < APART or (gaps < usual - 1.5).mean() > SOONER or (usual < 3 and (gaps < APART).mean() > SOONER):
        return 0.0
    distance_to_multiple = np.abs(gaps - rows * np.maximum(np.round(gaps / rows), 1))
    is_regular = (distance_to_multiple <= np.maximum(1.0, 0.1 * gaps)).mean() >= REGULAR
    return rows if is_regular and len(near) >= 0.5 * len(gaps) else 0.0


def drop_repeated_readings(
    values: np.ndarray, time: np.ndarray, run: np.ndarray | None = None
) -> tuple[np.ndarray, float]:
    """Values of a channel with each reading of a slow sensor kept only once, and the number of rows between readings.

    Rows that repeat a reading are NaN. Without repeated readings, the values are unchanged and the number is 0.

    Args:
        values: readings, NaN if missing, shape (rows,).
        time: time of the rows.
        run: name of the recording of each row. None: all rows belong to one recording.
    """
    if (np.diff(values) == 0).sum() < LEAST * len(values):
        return values, 0.0
    run_index = np.zeros(len(values), int) if run is None else np.unique(run, return_inverse=True)[1]
    order = np.lexsort((time, run_index))
    recordings = np.split(order, np.flatnonzero(np.diff(run_index[order])) + 1)
    periods = np.array([reading_period(values[rows]) for rows in recordings])
    is_slow = periods > 0
    slow_rows = sum(len(rows) for rows, slow in zip(recordings, is_slow, strict=True) if slow)
    if not is_slow.any() or slow_rows < 0.5 * len(values) or periods[is_slow].min() < ALIKE * periods.max():
        return values, 0.0
    rows_apart = float(np.median(periods[is_slow]))
    first_readings = np.full(len(values), np.nan)
    for rows in recordings:
        finite_rows = rows[np.isfinite(values[rows])]
        begins = np.flatnonzero(np.concatenate([[True], np.diff(values[finite_rows]) != 0]))[: len(finite_rows)]
        lengths = np.diff(np.append(begins, len(finite_rows)))
        counts = np.maximum(np.floor(lengths / rows_apart + 0.5), 1).astype(int)  # two readings may be equal
        repetition = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        offsets = np.repeat(begins, counts) + np.round(repetition * rows_apart).astype(int)
        nearest = finite_rows[np.minimum(offsets, len(finite_rows) - 1)]
        first_readings[nearest] = values[nearest]
    return first_readings, rows_apart


#: Distance by which noise may carry a reading across zero, in stated sds, and as a share of the channel's rms.
SIGN_SDS, SIGN_SHARE = 4.0, 0.05
#: Fewest levels of the drive for deciding if readings have signs.
LEVELS_OF_SIGN = 3
#: Shortest time between settled points [s], and in time constants of motors and load.
SECONDS_APART, CONSTANTS_APART = 0.5, 5.0
#: An undriven motor is at rest below this share of the largest speed.
STILL = 0.02


def with_default_columns(runs: Runs) -> Runs:
    """Table with the columns that a table of a rig may omit: its only configuration, and conditions with their usual
    value.
    """
    layout, columns = runs.layout, dict[str, np.ndarray]()
    if not runs.has("configuration") and layout.configurations:
        labels = np.unique(runs.columns.get("surface", np.zeros(0, str)))
        configuration = configuration_tables.common_configuration(layout.configurations, labels)
        if configuration is None:
            raise BadData(
                f"{runs.source}: column configuration is missing, and the robot has "
                f"{', '.join(layout.configurations)}"
            )
        columns["configuration"] = np.full(len(runs), configuration)
    if layout.imposed_column == SPEED and all(map(runs.has, SPEEDS)):
        columns[SPEED] = np.mean([runs[c] for c in SPEEDS], 0)
    default_columns = {
        column: np.full(len(runs), value) for column, value in {**DEFAULTS, SUPPLY: layout.supply}.items()
    }
    return runs.with_columns(columns | {c: values for c, values in default_columns.items() if not runs.has(c)})


def contradictions_in_rows(runs: Runs) -> Iterator[Check]:
    """Checks of values that contradict each other within a row.

    Raises:
        BadData: columns contradict each other.
    """
    columns = runs.columns
    if runs.has("mode") and not runs.sampled:  # motors of settled runs are driven
        raise BadData(f"{runs.source}: column mode is for time histories; add {', '.join(TIME)}, or remove it")
    if "duty" in columns:
        duty, modes = columns["duty"], columns.get("mode", np.full(len(columns["duty"]), DRIVEN[0]))
        driven = modes == DRIVEN[0]
        yield "duty", driven & np.isnan(duty), "; expected a number from -1 to 1"
        undriven = ~driven & (np.nan_to_num(duty) != 0)
        yield "duty", undriven, lambda row: f" in mode {modes[row]}; expected 0 or an empty cell"
    clamp = columns.get("held", np.zeros(1))
    yield "held", (clamp != 0) & (clamp != 1), "; expected 1 if a clamp holds the output, otherwise 0"
    why = "; expected 0, since the torque at a clamp is a reading: rename its column to output_torque"
    yield LOAD, (clamp == 1) & (columns.get(LOAD, 0.0) != 0), f" although held is 1{why}"
    contradictions.check_commands_of_sides(runs, runs.layout.sides, ("duty", "mode"))
    if "total_mass_kg" in columns:
        payload = columns["payload_kg"]
        yield "total_mass_kg", columns["total_mass_kg"] <= payload, lambda row: too_light(payload[row])
    for channel in (c for c in runs.present_channels if runs.has(c.sd_column)):
        lacks_sd = np.isfinite(columns[channel.column]) & ~np.isfinite(columns[channel.sd_column])
        yield channel.sd_column, lacks_sd, f" next to a reading; expected its sd, more than 0 {channel.unit}"


def without_repeated_rows(runs: Runs) -> Runs:
    """Log without rows that repeat the row before, and a note on them."""
    if not runs.sampled:
        return runs
    repeated = np.flatnonzero(np.diff(runs["time_s"]) == 0) + 1
    for values in runs.columns.values():
        values_there, before = values[repeated], values[repeated - 1]
        is_equal = values_there == before
        if values.dtype.kind == "f":
            is_equal |= np.isnan(values_there) & np.isnan(before)
        repeated = repeated[is_equal]
    if not repeated.size:
        return runs
    is_distinct = np.full(len(runs), True)
    is_distinct[repeated] = False
    note = f"{_rows_are(repeated)} a repetition of the row before, with the same time. Repetitions are left out"
    return runs.where(is_distinct).with_columns({}, f"{runs.source}: {note} and not counted")


def without_repeated_readings(runs: Runs) -> Runs:
    """Log with NaN in place of repeated readings of slower sensors, and a note on each of their channels."""
    columns, notes = dict[str, np.ndarray](), list[str]()
    for channel in runs.present_channels if runs.sampled else ():
        if channel.column != runs.layout.imposed_column:
            readings = runs[channel.column]
            values, rows = drop_repeated_readings(readings, runs["time_s"], runs.columns.get("run_id"))
            if rows:
                columns[channel.column] = values
                notes.append(
                    f"{runs.source}: {channel.column} repeats each reading in {rows:.3g} rows, like a slower sensor, "
                    "and counts once"
                )
    return runs.with_columns(columns, *notes)


def _rows_are(rows: np.ndarray) -> str:
    return f"row {rows[0] + 1} is" if rows.size == 1 else f"{rows.size} rows, the first row {rows[0] + 1}, are"


def split_at_jumps(runs: Runs, at_rest: bool) -> Runs:
    """Log whose rows after a jump of its clock are a separate run, and a note if it jumps.

    Args:
        at_rest: True if runs begin at rest. Rows after a jump then stay in their run.
    """
    if not runs.sampled:
        return runs
    time = runs["time_s"]
    run = names = runs.columns.get("run_id", np.full(len(time), ""))
    steps = np.where(run[1:] == run[:-1], np.diff(time), 0.0)
    usual = float(np.median(np.abs(steps))) if len(steps) else 0.0
    jumps = np.flatnonzero((steps if at_rest else np.abs(steps)) > JUMP * usual) + 1
    if usual == 0 or not 0 < len(jumps) <= MOST_JUMPS:
        return runs
    first_step, row_numbers = steps[jumps[0] - 1], ", ".join(str(k + 1) for k in jumps)
    columns, consequence = dict[str, np.ndarray](), "A new run begins there"
    if at_rest:
        consequence = (
            'A fit keeps the imposed quantity constant there. If rows are missing, set start = "measured" in the '
            "rig's file to begin a new run"
        )
    else:
        for row in jumps:
            part = 1 + len({*run[names == names[row]]})
            after = (np.arange(len(time)) >= row) & (run == run[row])
            time = np.where(after, time - time[row], time)
            run = np.where(after, f"{names[row]} part {part}".strip(), run)
        columns = {"time_s": time, "run_id": run}
    return runs.with_columns(
        columns,
        f"{runs.source} row {row_numbers}, time_s: {three_digits(abs(first_step))} s "
        f"{'after' if first_step > 0 else 'earlier than'} the row before it, where {three_digits(usual)} s is "
        f"usual. {consequence}",
    )


def too_light(payload: float) -> str:
    """End of the message on a total mass that is not more than the payload [kg]."""
    return f"; expected more than the payload of {payload:g} kg, which it includes"


def without_time_of_settled_rows(runs: Runs, robot: Robot) -> Runs:
    """Table without the time if each row is a settled run, and a note on that.

    Rows are then at least `CONSTANTS_APART` time constants apart. These are of the windings if a clamp holds the
    output in every row. Otherwise they are of the motors, and `_are_separate_settings` must be true.
    """
    time = runs.columns.get("time_s", np.zeros(0))
    step = np.diff(time)
    apart = float(step[step > 0].min(initial=math.inf))
    clamped = _is_clamped(runs)
    windings = float(robot.motor.inductance / robot.motor.resistance) if robot.knows(VOLTAGE) else 0.0
    constant = windings if clamped else time_constant(robot)
    if (
        len(time) < 3
        or any(map(runs.has, ("mode", *runs.layout.sides)))
        or not math.inf > apart >= CONSTANTS_APART * constant
        or not (clamped or _are_separate_settings(runs, apart))
    ):
        return runs
    why = "the output is held in every row"
    if not clamped:
        settling_words = f", and the motors settle in about {three_digits(CONSTANTS_APART * constant)} s" * (
            constant > 0
        )
        why = f"rows are {three_digits(apart)} s or more apart, mostly at different settings{settling_words}"
    note = f"{runs.source}: {why}, so each row is read as a settled run and its time is ignored"
    return runs.without_columns((*TIME, "run_id")).with_columns({}, note)


def _is_clamped(runs: Runs) -> bool:
    """True if a clamp holds the output in every row, or if an imposed speed of 0 holds it against a torque."""
    if runs.has("held"):
        return bool((runs["held"] > 0.5).all())
    is_braked = runs.layout.imposed == "motor_speed" and runs.has(LOAD)
    return is_braked and not runs.columns.get(runs.layout.imposed_column, np.ones(1)).any()


def _are_separate_settings(runs: Runs, apart: float) -> bool:
    """True if rows are at least `SECONDS_APART` apart, and half of them have another setting than the row before.

    Readings must follow the setting of their own row at least as well as that of the row before.
    """
    if runs.layout.imposed != "voltage" or not runs.has(SUPPLY) or runs.has("held") or apart < SECONDS_APART:
        return False
    settings = [runs[c] for c in (SUPPLY, "duty", LOAD, "slope_deg", "payload_kg") if runs.has(c)]
    changed = np.any([np.diff(x) != 0 for x in settings], 0)
    if not all(c.settled for c in runs.present_channels) or changed.mean() < 0.5:
        return False
    loads = settings[1 + runs.has("duty") :]
    regressors = np.stack([np.ones(len(runs)), runs.commanded, *loads], 1)
    return all(
        _unexplained_squares(runs[c.column][1:], regressors[1:])
        <= 2 * _unexplained_squares(runs[c.column][1:], regressors[:-1])
        for c in runs.present_channels
    )


def _unexplained_squares(readings: np.ndarray, settings: np.ndarray) -> float:
    """Sum of squared residuals of the readings after a linear fit over the settings, shape (rows, settings)."""
    is_finite = np.isfinite(readings)
    if is_finite.sum() < 3:
        return 0.0
    a, readings = settings[is_finite], readings[is_finite]
    return float(np.sum((readings - a @ np.linalg.lstsq(a, readings, rcond=None)[0]) ** 2))


def inertia_at_motor(robot: Robot, load: Load) -> float:
    """Inertia of a motor and of its share of a load that rolls without slip, at the motor shaft [kg·m²]."""
    load_inertia = float(load.mass) * float(load.radius) ** 2 / float(robot.sides)
    return float(robot.motor.inertia) + (float(load.inertia) + load_inertia) / float(robot.gearbox.ratio) ** 2


def time_constant(robot: Robot) -> float:
    """Time constant J R/k² of the motor speed with the slowest load [s]. Infinite if unknown."""
    motor = robot.motor
    slowest = 0.0
    if not robot.knows(VOLTAGE):
        return math.inf
    for load in robot.configurations.members:
        if not robot.has_ground and float(load.torque_gravity) > 0:
            return math.inf
        slowest = max(slowest, inertia_at_motor(robot, load))
    return slowest * float(motor.resistance) / float(motor.torque_constant) ** 2


def without_idle_rows(runs: Runs) -> Runs:
    """Settled runs whose motors are driven, and a note on the other rows.

    Raises:
        BadData: no row is driven, a row has a speed although nothing drives its motors, a turn is on a slope, or a
            reading lacks its sign.
    """
    runs = _without_idle_rows(runs)
    if runs.turns:
        slope = runs["slope_deg"]
        sloped = int(np.count_nonzero(slope))
        count_words = f", as in {sloped} of {len(slope)} rows" if sloped > 1 else ""
        why = (
            f" in a table of settled turns{count_words}; expected 0, since a turn never settles on a slope. To "
            "simulate one: simulate --model drive --left --right --slope"
        )
        runs.check_rows([("slope_deg", slope, why)])
    if not any(map(runs.has, runs.layout.sides)):
        runs.check_rows(_missing_signs(runs))
    return runs


def _without_idle_rows(runs: Runs) -> Runs:
    layout = runs.layout
    sides = [c for c in layout.sides if runs.has(c)]
    drive = np.max(np.abs([runs[c] for c in sides]), 0) if sides else np.abs(runs.commanded)
    if layout.imposed == "motor_speed" and runs.has(LOAD):  # a shaft at rest may push against its load
        drive = drive + np.abs(runs[LOAD])
    if layout.imposed == "voltage" and sides:
        drive = drive * np.abs(runs[SUPPLY])
    idle = np.flatnonzero(drive == 0)
    if not idle.size:
        return runs
    drive_columns = (layout.imposed_column, *sides, *["duty"] * runs.has("duty"))
    zero_columns = " and ".join(c for c in drive_columns if not runs[c][idle].any()) or layout.imposed_column
    why = f" although {zero_columns} is 0; give the command that drives it, or remove the row"
    for channel in (c for c in runs.present_channels if c.zero_at_rest):
        readings = np.abs(np.nan_to_num(runs[channel.column]))
        moving = (drive == 0) & (readings > STILL * np.max(readings))
        runs.check_rows([(channel.column, moving & ~moving.all(), why)])
    if idle.size == len(drive):
        clamp_advice = (
            '; if the shaft is locked, set imposed = "motor_current" or "voltage", and give the columns held '
            "(1) and output_torque"
        )
        raise BadData(
            f"{runs.source}: {zero_columns} is 0 in every row, so nothing drives the motors; expected rows with a "
            f"command{clamp_advice * (layout.imposed == 'motor_speed' and not layout.has_ground)}"
        )
    why = f"nothing drives the motors ({zero_columns} is 0)"
    note = f"{runs.source}: {_rows_are(idle)} left out, since {why}. Row numbers do not count them"
    return runs.where(drive != 0).with_columns({}, note)


def _missing_signs(runs: Runs) -> Iterator[Check]:
    """Checks for unsigned readings in rows that drive the robot backward."""
    imposed, layout, unit = runs.commanded, runs.layout, runs.layout.imposed_column.split("_")[-1]

    def message_end(end: str) -> Callable[[int], str]:
        return lambda row: f" at {imposed[row]:g} {unit}; {end}"

    load_may_drive = layout.weight or runs.has("duty") or runs.driven_on.any()
    for channel in (c for c in runs.present_channels if c.directed):
        column, readings = channel.column, runs[channel.column]
        if layout.magnitude(channel.name):
            why = "; expected no negative reading of an instrument that shows only the magnitude"
            yield column, readings < 0, why
            continue
        if load_may_drive and not channel.zero_at_rest:
            continue  # the load may drive a motor; a reversing bridge also reverses the supply current
        # Downhill, gravity may drive a motor. Only uphill or on the flat do current and voltage have the same sign.
        backward = (imposed < 0) & ((runs["slope_deg"] <= 0) | channel.zero_at_rest)
        tolerance = _sign_tolerance(runs, channel)
        if not channel.zero_at_rest and channel.name != "motor_voltage":  # that is compared with the back-EMF instead
            turn_advice = (
                "" if channel not in channels.OF_TURNS else f"; for a turn, give {' and '.join(layout.sides)}"
            )
            why = (
                "nothing else drives the motors, so the reading should have its sign; use one sign convention in all "
                f"rows{turn_advice}"
            )
            yield column, (imposed > 0) & (runs["slope_deg"] >= 0) & (readings < -tolerance), message_end(why)
        if not _rises_through_zero(imposed, readings, backward):
            why = "expected readings with their signs, negative in reverse"
            if layout.crosses_zero:
                why += f"; or signed = false for {channel.name} in the robot's file, if it shows only the magnitude"
            yield column, backward & (readings > (tolerance if layout.crosses_zero else 0.0)), message_end(why)


def _rises_through_zero(imposed: np.ndarray, readings: np.ndarray, backward: np.ndarray) -> bool:
    """True if the readings of backward rows rise as the imposed value rises towards zero, so they
    are signed and have an offset.

    Unsigned readings would mirror the forward readings and fall towards zero.
    """
    is_read = backward & np.isfinite(readings)
    if len(np.unique(imposed[is_read])) < LEVELS_OF_SIGN:
        return False
    levels = imposed[is_read] - imposed[is_read].mean()
    slope = levels @ readings[is_read] / (levels @ levels)
    scatter = np.std(readings[is_read] - readings[is_read].mean() - slope * levels)
    return bool(slope * np.ptp(levels) > 2 * scatter)


def _sign_tolerance(runs: Runs, channel: Channel) -> np.ndarray | float:
    """Largest reading of the wrong sign that noise explains: SIGN_SDS of its sd, or a share of the channel's rms."""
    readings = runs[channel.column]
    share = SIGN_SHARE * float(np.sqrt(np.nanmean(readings**2))) if np.isfinite(readings).any() else 0.0
    return np.fmax(share, SIGN_SDS * np.nan_to_num(runs.columns.get(channel.sd_column, np.zeros(len(readings)))))


def missing_data_notes(runs: Runs) -> Iterator[str]:
    """Notes on missing channels and readings, on copies of rows, and on runs with several rows."""
    columns, name = runs.columns, runs.source
    for column in runs.layout.measured_columns:
        empty = np.flatnonzero(np.isnan(columns.get(column, np.zeros(0))))
        if not runs.has(column):
            yield f"{name}: no column {column}, so this channel has no readings"
        if empty.size:
            yield (
                f"{name}: {empty.size} of {len(runs)} cells of {column} are empty, the first in row "
                f"{empty[0] + 1}. They are ignored"
            )
    if runs.sampled:
        return
    rows_by_cells: dict[tuple[Any, ...], list[int]] = {}
    cells_by_column = [columns[c].tolist() for c in columns if c not in ("run_id", *WHEN)]
    for row, cells in enumerate(zip(*cells_by_column, strict=True), 1):
        rows_by_cells.setdefault(cells, []).append(row)
    copied = [rows for rows in rows_by_cells.values() if len(rows) > 1]
    if copied:
        others = f", as do {len(copied) - 1} more" if len(copied) > 1 else ""
        yield (
            f"{name}: rows {copied[0][0]} and {copied[0][1]} have the same conditions and readings{others}. They "
            "count as repeats. Remove copies"
        )
    run_ids, counts = np.unique(columns.get("run_id", np.zeros(0, str)), return_counts=True)
    is_repeated = counts > 1
    if is_repeated.any():
        run = run_ids[np.argmax(is_repeated)]
        rows = rows_text(np.flatnonzero(columns["run_id"] == run).tolist(), 5, " and more").removeprefix("rows ")
        others = f", and {is_repeated.sum() - 1} more run_ids are repeated" if is_repeated.sum() > 1 else ""
        yield (
            f"{name}: run_id {run} is in rows {rows}{others}. Without {', '.join(TIME)} every row is a separate run"
        )


def driven_backward_notes(runs: Runs) -> Iterator[str]:
    """Note on settled rows in which an unsigned load torque drives a shaft backward."""
    pushed_rows = np.flatnonzero(runs.driven_on)
    if pushed_rows.size and not runs.sampled and runs[LOAD].min() >= 0:
        count_words = f", as in {pushed_rows.size} rows" if pushed_rows.size > 1 else ""
        yield (
            f"{runs.place(pushed_rows[0])}, {LOAD}: got {runs[LOAD][pushed_rows[0]]:g} where the shaft is driven "
            f"backward{count_words}: here it drives the shaft. The torque of a brake is negative for backward motion"
        )
