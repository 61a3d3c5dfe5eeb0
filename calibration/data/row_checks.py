"""Checks of rows: contradictions between columns, missing columns with a default, and repeated readings."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from calibration.data import Columns, Names, configuration_tables, contradictions
from calibration.data.columns import (
    DEFAULTS,
    DRIVEN,
    HEADING,
    LOAD,
    SPEED,
    SPEEDS,
    SUPPLY,
    TIME,
    WHEN,
    Layout,
)
from calibration.data.input_errors import BadData, three_digits
from calibration.data.named_arrays import Check, check_rows
from calibration.data.table import driven_on
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
    values = values[np.isfinite(values)]
    changed = np.flatnonzero(np.diff(values) != 0)
    gaps = np.diff(changed)
    if len(gaps) < FEWEST:
        return 0.0
    size = np.abs(np.diff(values)[changed])
    smallest = size.min()
    if (size <= 1.5 * smallest).mean() > STEPS:
        return 0.0
    usual = float(np.median(gaps))
    near = gaps[gaps <= 1.5 * usual]
    rows = usual if abs(near.mean() - usual) < 0.25 and (near == usual).mean() > 0.5 else float(near.mean())
    if usual < APART or (gaps < usual - 1.5).mean() > SOONER or (usual < 3 and (gaps < APART).mean() > SOONER):
        return 0.0
    distance_to_multiple = np.abs(gaps - rows * np.maximum(np.round(gaps / rows), 1))
    return (
        rows
        if (distance_to_multiple <= np.maximum(1.0, 0.1 * gaps)).mean() >= REGULAR and len(near) >= 0.5 * len(gaps)
        else 0.0
    )


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
    names = np.zeros(len(values), int) if run is None else np.unique(run, return_inverse=True)[1]
    order = np.lexsort((time, names))
    recordings = np.split(order, np.flatnonzero(np.diff(names[order])) + 1)
    periods = [reading_period(values[rows]) for rows in recordings]
    of_period = sum(len(rows) for rows, p in zip(recordings, periods, strict=True) if p)
    true_periods = [p for p in periods if p]
    if not true_periods or min(true_periods) < ALIKE * max(true_periods) or of_period < 0.5 * len(values):
        return values, 0.0
    rows_apart = float(np.median(true_periods))
    first_readings = np.full(len(values), np.nan)
    for rows in recordings:
        finite_rows = rows[np.isfinite(values[rows])]
        begins = np.flatnonzero(np.concatenate([[True], np.diff(values[finite_rows]) != 0]))[: len(finite_rows)]
        lengths = np.diff(np.append(begins, len(finite_rows)))
        times = np.maximum(np.floor(lengths / rows_apart + 0.5), 1).astype(int)  # two readings may be equal
        first = np.repeat(begins, times)
        again = np.arange(len(first)) - np.repeat(np.cumsum(times) - times, times)
        nearest = finite_rows[np.minimum(first + np.round(again * rows_apart).astype(int), len(finite_rows) - 1)]
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


def complete_columns(name: str, columns: Columns, rows: int, layout: Layout) -> None:
    """Adds columns that a table may omit, and rejects values that contradict each other."""
    _add_default_columns(name, columns, rows, layout)
    check_rows(name, columns, _contradictions_in_rows(name, columns, layout))
    if "duty" in columns:
        columns["duty"] = np.nan_to_num(columns["duty"])


def _contradictions_in_rows(name: str, columns: Columns, layout: Layout) -> Iterator[Check]:
    """Checks of values that contradict each other within a row.

    Raises:
        BadData: columns contradict each other.
    """
    if "mode" in columns and not set(TIME) <= set(columns):  # motors of settled runs are driven
        raise BadData(f"{name}: column mode is for time histories; add {', '.join(TIME)}, or remove it")
    if "duty" in columns:
        duty, modes = columns["duty"], columns.get("mode", np.full(len(columns["duty"]), DRIVEN[0]))
        driven = modes == DRIVEN[0]
        yield "duty", driven & np.isnan(duty), "; expected a number from -1 to 1"
        undriven = ~driven & (np.nan_to_num(duty) != 0)
        yield "duty", undriven, lambda row: f" in mode {modes[row]}; expected 0 or an empty cell"
    held = columns.get("held", np.zeros(1))
    yield "held", (held != 0) & (held != 1), "; expected 1 if a clamp holds the output, otherwise 0"
    yield (
        LOAD,
        (held == 1) & (columns.get(LOAD, 0.0) != 0),
        (
            " although held is 1; expected 0, since the torque at a clamp is a reading: rename its column to "
            "output_torque"
        ),
    )
    contradictions.check_commands_of_sides(name, columns, layout.sides, ("duty", "mode"))
    if "total_mass_kg" in columns:
        payload = columns["payload_kg"]
        yield "total_mass_kg", columns["total_mass_kg"] <= payload, lambda row: too_light(payload[row])
    for channel in (c for c in layout.channels if c.column in columns and c.sd_column in columns):
        lacks_sd = np.isfinite(columns[channel.column]) & ~np.isfinite(columns[channel.sd_column])
        yield channel.sd_column, lacks_sd, f" next to a reading; expected its sd, more than 0 {channel.unit}"


def distinct_rows(name: str, columns: Columns) -> tuple[np.ndarray, Names]:
    """False for each row of a log that repeats the row before it, shape (rows,), and a sentence on such rows."""
    rows = len(next(iter(columns.values()), []))
    is_distinct = np.full(rows, True)
    if not set(TIME) <= set(columns):
        return is_distinct, ()
    again = np.flatnonzero(np.diff(columns["time_s"]) == 0) + 1
    for values in columns.values():
        if not again.size:
            return is_distinct, ()
        values_after, values_before = values[again], values[again - 1]
        is_equal = values_after == values_before
        if values.dtype.kind == "f":
            is_equal |= np.isnan(values_after) & np.isnan(values_before)
        again = again[is_equal]
    is_distinct[again] = False
    if not again.size:
        return is_distinct, ()
    return is_distinct, (
        f"{name}: {_rows_are(again)} a repetition of the row before, with the same time. Repetitions are left out "
        "and not counted in row numbers",
    )


def _rows_are(rows: np.ndarray) -> str:
    return f"row {rows[0] + 1} is" if rows.size == 1 else f"{rows.size} rows, the first row {rows[0] + 1}, are"


def split_at_jumps(name: str, columns: Columns, at_rest: bool) -> Names:
    """Gives the rows after a jump of a log's clock a run of their own. Returns a sentence if it jumps.

    Args:
        at_rest: True if runs begin at rest. Rows after a jump then stay in their run.
    """
    if not set(TIME) <= set(columns):
        return ()
    time = columns["time_s"]
    run = columns.get("run_id", np.full(len(time), ""))
    steps = np.where(run[1:] == run[:-1], np.diff(time), 0.0)
    usual = float(np.median(np.abs(steps))) if len(steps) else 0.0
    jumps = np.flatnonzero((steps if at_rest else np.abs(steps)) > JUMP * usual) + 1
    if usual == 0 or not 0 < len(jumps) <= MOST_JUMPS:
        return ()
    first, rows = steps[jumps[0] - 1], ", ".join(str(k + 1) for k in jumps)
    sentence = (
        f"{name} row {rows}, time_s: {three_digits(abs(first))} s {'after' if first > 0 else 'earlier than'} the row "
        f"before it, where {three_digits(usual)} s is usual. "
    )
    if at_rest:
        return (
            sentence
            + (
                'A fit keeps the imposed quantity constant there. If rows are missing, set start = "measured" '
                "in the rig's file to begin a new run"
            ),
        )
    for part, row in enumerate(jumps):
        after = (np.arange(len(time)) >= row) & (run == run[row])
        time = np.where(after, time - time[row], time)
        run = np.where(after, f"{columns['run_id'][row] if 'run_id' in columns else ''} part {part + 2}".strip(), run)
    columns |= {"time_s": time, "run_id": run}
    return (sentence + "A new run begins there",)


def _add_default_columns(name: str, columns: Columns, rows: int, layout: Layout) -> None:
    """Adds columns that a table of a rig may omit: its only configuration, and conditions with their usual value."""
    if layout.complete:
        return
    if "configuration" not in columns and layout.configurations:
        labels = np.unique(columns.get("surface", np.zeros(0, str)))
        configuration = configuration_tables.common_configuration(layout.configurations, labels)
        if configuration is None:
            raise BadData(
                f"{name}: column configuration is missing, and the robot has {', '.join(layout.configurations)}"
            )
        columns["configuration"] = np.full(rows, configuration)
    if layout.imposed_column == SPEED and set(SPEEDS) <= set(columns):
        columns[SPEED] = np.mean([columns[c] for c in SPEEDS], 0)
    for column, value in {**DEFAULTS, SUPPLY: layout.supply}.items():
        columns.setdefault(column, np.full(rows, value))


def too_light(payload: float) -> str:
    """End of the message on a total mass that is not more than the payload [kg]."""
    return f"; expected more than the payload of {payload:g} kg, which it includes"


def drop_time_of_settled_rows(name: str, columns: Columns, layout: Layout, robot: Robot) -> tuple[Columns, Names]:
    """Columns without the time if each row is a settled run, and a note on that.

    Rows are then at least `CONSTANTS_APART` time constants apart. These are of the windings if a clamp holds the
    output in every row. Otherwise they are of the motors, and `_are_separate_settings` must be true.
    """
    columns_left, time = dict(columns), columns.get("time_s")
    if time is None or len(time) < 3 or {"mode", *layout.sides} & set(columns):
        return columns_left, ()
    step = np.diff(time)
    shortest_step, clamped = float(step[step > 0].min(initial=math.inf)), _is_clamped(columns, layout)
    windings = float(robot.motor.inductance / robot.motor.resistance) if robot.knows(VOLTAGE) else 0.0
    constant = windings if clamped else time_constant(robot)
    if not math.inf > shortest_step >= CONSTANTS_APART * constant or not (
        clamped or _are_separate_settings(columns, layout, shortest_step)
    ):
        return columns_left, ()
    for column in (*TIME, "run_id"):
        columns_left.pop(column, None)
    note = f"rows are {three_digits(shortest_step)} s or more apart, mostly at different settings"
    settle = f", and the motors settle in about {three_digits(CONSTANTS_APART * constant)} s" if constant > 0 else ""
    why = "the output is held in every row" if clamped else f"{note}{settle}"
    return columns_left, (f"{name}: {why}, so each row is read as a settled run and its time is ignored",)


def _is_clamped(columns: Columns, layout: Layout) -> bool:
    """True if a clamp holds the output in every row, or if an imposed speed of 0 holds it against a torque."""
    if "held" in columns:
        return bool((columns["held"] > 0.5).all())
    speed = columns.get(layout.imposed_column, np.ones(1))
    return layout.imposed == "motor_speed" and LOAD in columns and not speed.any()


def _are_separate_settings(columns: Columns, layout: Layout, apart: float) -> bool:
    """True if rows are at least `SECONDS_APART` apart, and half of them have another setting than the row before.

    Readings must follow the setting of their own row at least as well as that of the row before.
    """
    present = [c for c in layout.channels if c.column in columns]
    if layout.imposed != "voltage" or SUPPLY not in columns or "held" in columns or apart < SECONDS_APART:
        return False
    settings = [c for c in (SUPPLY, "duty", LOAD, "slope_deg", "payload_kg") if c in columns]
    if not all(c.settled for c in present) or np.any([np.diff(columns[c]) != 0 for c in settings], 0).mean() < 0.5:
        return False
    drive = columns[SUPPLY] * columns.get("duty", 1.0)
    other_settings = [columns[c] for c in settings if c not in (SUPPLY, "duty")]

    def left(readings: np.ndarray, k: int) -> float:
        return _unexplained_squares(readings[1:], [x[k : len(x) - 1 + k] for x in (drive, *other_settings)])

    return all(left(columns[c.column], 1) <= 2 * left(columns[c.column], 0) for c in present)


def _unexplained_squares(readings: np.ndarray, settings: Sequence[np.ndarray]) -> float:
    """Sum of squared residuals of the readings after a linear fit over the settings."""
    a = np.stack([np.ones(len(readings)), *settings], 1)
    is_finite = np.isfinite(readings)
    if is_finite.sum() < 3:
        return 0.0
    a, readings = a[is_finite], readings[is_finite]
    return float(np.sum((readings - a @ np.linalg.lstsq(a, readings, rcond=None)[0]) ** 2))


def inertia_at_motor(robot: Robot, load: Load) -> float:
    """Inertia of a motor and of its share of a load that rolls without slip, at the motor shaft [kg·m²]."""
    load_inertia = float(load.mass) * float(load.radius) ** 2 / float(robot.sides)
    return float(robot.motor.inertia) + (float(load.inertia) + load_inertia) / float(robot.gearbox.ratio) ** 2


def time_constant(robot: Robot) -> float:
    """Time constant J R/k² of the motor speed with the slowest load [s]. Infinite if unknown."""
    motor, slowest = robot.motor, 0.0
    if not robot.knows(VOLTAGE):
        return math.inf
    for load in robot.configurations.members:
        if not robot.has_ground and float(load.torque_gravity) > 0:
            return math.inf
        slowest = max(slowest, inertia_at_motor(robot, load))
    return slowest * float(motor.resistance) / float(motor.torque_constant) ** 2


def driven_rows(name: str, columns: Columns, layout: Layout) -> tuple[Columns, np.ndarray, Names]:
    """Columns of settled runs whose motors are driven, True for these rows, and a note on the other rows.

    Raises:
        BadData: for the same reasons as `_driven_mask`, a turn on a slope, or a reading without its sign.
    """
    driven, note = _driven_mask(name, columns, layout)
    if note:
        columns = {column: values[driven] for column, values in columns.items()}
    if {*layout.sides, *HEADING} & set(columns):
        slope = columns["slope_deg"]
        sloped = int(np.count_nonzero(slope))
        rows_text = f", as in {sloped} of {len(slope)} rows" if sloped > 1 else ""
        why = (
            f" in a table of settled turns{rows_text}; expected 0, since a turn never settles on a slope. Remove "
            "these rows. To simulate one: simulate --model drive --left --right --slope"
        )
        check_rows(name, columns, [("slope_deg", slope, why)])
    if not set(layout.sides) & set(columns):
        check_rows(name, columns, _missing_signs(columns, layout))
    return columns, driven, (note,) if note else ()


def _driven_mask(name: str, columns: Columns, layout: Layout) -> tuple[np.ndarray, str]:
    """True for rows of settled runs whose motors are driven, and a sentence on the other rows.

    Raises:
        BadData: no row is driven, or a row has a speed although nothing drives its motors.
    """
    sides = [c for c in layout.sides if c in columns]
    column = layout.imposed_column
    size = np.max(np.abs([columns[c] for c in sides]), 0) if sides else np.abs(columns[column])
    if layout.imposed == "motor_speed" and LOAD in columns:  # a shaft at rest may push against its load
        size = size + np.abs(columns[LOAD])
    if layout.imposed == "voltage":
        size = size * np.abs(columns[SUPPLY] if sides else columns.get("duty", 1.0))
    idle = np.flatnonzero(size == 0)
    if not idle.size:
        return size != 0, ""
    drive_columns = (column, *sides, *(["duty"] if "duty" in columns else []))
    zero = " and ".join(c for c in drive_columns if not columns[c][idle].any())
    for channel in (c for c in layout.channels if c.zero_at_rest and c.column in columns):
        readings = np.abs(np.nan_to_num(columns[channel.column]))
        moving = (size == 0) & (readings > STILL * np.max(readings))
        why = f" although {zero} is 0; give the command that drives it, or remove the row"
        check_rows(name, columns, [(channel.column, moving & ~moving.all(), why)])
    if idle.size == len(size):
        clamp = (
            '; if the shaft is locked, set imposed = "motor_current" or "voltage", and give the columns held '
            "(1) and output_torque"
        )
        raise BadData(
            f"{name}: {zero} is 0 in every row, so nothing drives the motors; expected rows with a "
            f"command{clamp * (layout.imposed == 'motor_speed' and not layout.has_ground)}"
        )
    return size != 0, (
        f"{name}: {_rows_are(idle)} left out, since nothing drives the motors ({zero or column} is 0). Row numbers "
        "do not count them"
    )


def _missing_signs(columns: Columns, layout: Layout) -> Iterator[Check]:
    """Checks for unsigned readings in rows that drive the robot backward."""
    column = layout.imposed_column
    imposed, unit = columns[column], column.split("_")[-1]
    if layout.imposed == "voltage":
        imposed = imposed * columns.get("duty", 1.0)

    def place(end: str) -> Callable[[int], str]:
        return lambda row: f" at {imposed[row]:g} {unit}; {end}"

    for channel in layout.channels:
        if channel.column not in columns or not channel.directed:
            continue
        readings = columns[channel.column]
        if layout.magnitude(channel.name):
            yield (
                channel.column,
                readings < 0,
                ("; expected no negative reading, since by the robot's file the instrument shows only the magnitude"),
            )
            continue
        # Downhill, gravity may drive a motor. Only uphill or on the flat do current and voltage have the same sign.
        backward = (imposed < 0) & ((columns["slope_deg"] <= 0) | channel.zero_at_rest)
        if not channel.zero_at_rest and (layout.weight or "duty" in columns or driven_on(columns, layout).any()):
            continue  # the load may drive a motor; a reversing bridge also reverses the supply current
        doubt = _sign_tolerance(columns, channel)
        forward = (imposed > 0) & (columns["slope_deg"] >= 0) & (not channel.zero_at_rest)
        forward &= channel.name != "motor_voltage"  # compared with the back-EMF instead
        alike = "" if channel not in channels.OF_TURNS else f"; for a turn, give {' and '.join(layout.sides)}"
        yield (
            channel.column,
            forward & (readings < -doubt),
            place(
                "nothing else drives the motors, so the reading should have its sign; use one sign convention in all "
                f"rows{alike}"
            ),
        )
        if not _rises_through_zero(imposed, readings, backward):
            advice = f"; or signed = false for {channel.name} in the robot's file, if it shows only the magnitude"
            yield (
                channel.column,
                backward & (readings > (doubt if layout.crosses_zero else 0.0)),
                place(
                    f"expected readings with their signs, negative in reverse{advice if layout.crosses_zero else ''}"
                ),
            )


def _rises_through_zero(imposed: np.ndarray, readings: np.ndarray, backward: np.ndarray) -> bool:
    """True if the readings of backward rows rise as the imposed value rises towards zero, so they
    are signed and have an offset.

    Unsigned readings would mirror the forward readings and fall towards zero.
    """
    read = backward & np.isfinite(readings)
    if len(np.unique(imposed[read])) < LEVELS_OF_SIGN:
        return False
    levels = imposed[read] - imposed[read].mean()
    slope = levels @ readings[read] / (levels @ levels)
    scatter = np.std(readings[read] - readings[read].mean() - slope * levels)
    return bool(slope * np.ptp(levels) > 2 * scatter)


def _sign_tolerance(columns: Columns, channel: Channel) -> np.ndarray | float:
    """Largest reading of the wrong sign that noise explains: SIGN_SDS of its sd, or a share of the channel's rms."""
    readings = columns[channel.column]
    share = SIGN_SHARE * float(np.sqrt(np.nanmean(readings**2))) if np.isfinite(readings).any() else 0.0
    return np.fmax(share, SIGN_SDS * np.nan_to_num(columns.get(channel.sd_column, np.zeros(len(readings)))))


def missing_data_notes(name: str, columns: Columns, layout: Layout) -> Iterator[str]:
    """Notes on missing channels and readings, on copies of rows, and on runs with several rows."""
    for channel in layout.channels:
        if channel.column not in columns:
            if layout.complete:
                yield f"{name}: no column {channel.column}, so this channel has no readings"
            continue
        empty = np.flatnonzero(np.isnan(columns[channel.column]))
        if empty.size:
            count = f"{empty.size} of {len(columns[channel.column])}"
            yield (
                f"{name}: {count} cells of {channel.column} are empty, the first in row {empty[0] + 1}. They are "
                "ignored"
            )
    alike: dict[tuple[Any, ...], list[int]] = {}
    settled = [] if set(TIME) & set(columns) else [c for c in columns if c not in ("run_id", *WHEN)]
    values_of_columns = [columns[column].tolist() for column in settled]
    for row, cells in enumerate(zip(*values_of_columns, strict=True), 1):
        alike.setdefault(cells, []).append(row)
    if copied := [rows for rows in alike.values() if len(rows) > 1]:
        others = f", as do {len(copied) - 1} more" if len(copied) > 1 else ""
        yield (
            f"{name}: rows {' and '.join(map(str, copied[0][:2]))} have the same conditions and "
            f"readings{others}. They count as repeats. Remove copies"
        )
    if "run_id" in columns and not set(TIME) & set(columns):
        runs, times = np.unique(columns["run_id"], return_counts=True)
        several = times > 1
        if several.any():
            run = runs[np.argmax(several)]
            rows = (np.flatnonzero(columns["run_id"] == run) + 1).tolist()
            row_words = f"{', '.join(map(str, rows[:5]))}{' and more' if len(rows) > 5 else ''}"
            others = f", and {several.sum() - 1} more run_ids are repeated" if several.sum() > 1 else ""
            yield (
                f"{name}: run_id {run} is in rows {row_words}{others}. Without {', '.join(TIME)} every row is a "
                "separate run"
            )


def driven_backward_notes(name: str, columns: Columns, layout: Layout) -> Iterator[str]:
    """Note on settled rows in which an unsigned load torque drives a shaft backward."""
    on = np.flatnonzero(driven_on(columns, layout))
    if on.size and not set(TIME) & set(columns) and columns[LOAD].min() >= 0:
        rows_text = f", as in {on.size} rows" if on.size > 1 else ""
        yield (
            f"{name} row {on[0] + 1}, {LOAD}: got {columns[LOAD][on[0]]:g} where the shaft is driven "
            f"backward{rows_text}: here it drives the shaft. The torque of a brake is negative for backward motion"
        )
