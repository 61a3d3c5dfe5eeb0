"""Checks for contradictions within a table of runs, or between table and robot, and for exchanged sides."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from calibration.data.columns import DUTY, HEADING, LEVERS, SIDES, SPEED, SUPPLY, VOLTS
from calibration.data.input_errors import BadData
from calibration.data.table import Runs
from mmrjax.model import channels, params
from mmrjax.model.quantities import CURRENT, RPM, TURN, VOLTAGE
from mmrjax.model.rig import Instrument
from mmrjax.model.robot import Robot, turn_error

#: A row counts if the drives of its sides differ by at least this share of the largest drive [-]. It also counts if a
#: side is driven backward by as much.
CLEAR = 0.25
#: Fewest rows that count, and the share of them that must contradict the drive [-].
FEWEST, MOSTLY = 3, 0.75
#: Largest relative excess of a side's voltage over the supply voltage, because both are rounded [-].
ROUNDED = 0.01


def supply_and_shares(volts: np.ndarray, supply: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Supply voltage [V], by default the larger of the sides' voltages, and the duty of each side.

    Args:
        volts: voltages of left and right side [V], shape (2, rows).
        supply: shape (rows,).
    """
    supply_voltage = np.max(np.abs(volts), 0) if supply is None else supply
    return supply_voltage, np.divide(volts, supply_voltage, out=np.zeros_like(volts), where=supply_voltage != 0)


def with_duties_of_sides(runs: Runs, battery: bool) -> Runs:
    """Table with duties in place of the sides' voltages, as shares of the supply voltage, and a note on that.

    Raises:
        BadData: a battery feeds the motors, one side's voltage is missing, the table also states shares, or a voltage
            is higher than the supply's.
    """
    voltage_columns = [c for c in VOLTS if runs.has(c)]
    if not voltage_columns:
        return runs
    if battery:
        raise BadData(
            f"{runs.source}: column {voltage_columns[0]} together with --battery, whose voltage falls; give "
            f"{' and '.join(SIDES)} instead"
        )
    check_commands_of_sides(runs, VOLTS, (*SIDES, *DUTY))
    volts = np.stack([runs[c] for c in VOLTS])
    supply, shares = supply_and_shares(volts, runs.columns.get(SUPPLY))
    for side, row in np.argwhere(np.abs(volts) > np.abs(supply) * (1 + ROUNDED))[:1].tolist():
        raise BadData(
            f"{runs.place(row)}, {[*VOLTS][side]}: got {volts[side, row]:g} V at a supply of {supply[row]:g} V; "
            f"expected no more than {SUPPLY}, or remove that column"
        )
    supply_text = SUPPLY if runs.has(SUPPLY) else f"{SUPPLY}, the larger of both"
    note = f"{runs.source}: {' and '.join(VOLTS)} are read as {' and '.join(SIDES)}, shares of {supply_text}"
    duties = dict(zip(SIDES, np.clip(shares, -1.0, 1.0), strict=True))
    return runs.without_columns(VOLTS).with_columns({SUPPLY: supply, **duties}, note)


def check_commands_of_sides(runs: Runs, pair: Iterable[str], whole: Iterable[str]) -> None:
    """Rejects the command of one side alone, or of both sides twice.

    Args:
        pair: columns with the command of each side.
        whole: other columns that give the command of both.

    Raises:
        BadData: one column of the pair is missing, or another gives the command too.
    """
    commanded = [c for c in pair if runs.has(c)]
    if extra := next((c for c in whole if commanded and runs.has(c)), None):
        raise BadData(
            f"{runs.source}: column {extra} in addition to {commanded[0]}, which already gives the command of both "
            "sides; keep one"
        )
    if len(commanded) == 1:
        (other,) = {*pair} - {*commanded}
        raise BadData(
            f"{runs.source}: column {other} is missing although {commanded[0]} is present; give the command of both "
            "sides"
        )


def check_turns(runs: Runs) -> None:
    """Rejects a table of turns with exchanged sides or a yaw rate with the wrong sign.

    Raises:
        BadData: readings of a side follow the drive of the other side, or the yaw rate contradicts both.
    """
    left, right = runs.of_sides
    for quantity in ("motor_speed", "motor_current"):
        pair = [channels.find_channel(f"{quantity}_{side}") for side in channels.SIDES]
        if all(c in runs.channels and runs.has(c.column) for c in pair):
            values, drive = np.stack([runs[c.column] for c in pair]), right - left
            if any(runs.layout.magnitude(c.name) for c in pair):
                values, drive = np.abs(values), np.abs(right) - np.abs(left)
            _reject_opposite_signs(
                runs, " and ".join(c.column for c in pair), values, values[1] - values[0], drive,
                "the larger value on the faster side; left and right columns of one quantity are exchanged",
            )  # fmt: skip
    for yaw in (c.column for c in channels.EVERY if c.sign == TURN and runs.has(c.column)):
        _reject_opposite_signs(
            runs, yaw, runs[yaw][None], runs[yaw], right - left,
            f"a positive value if the right side is faster: reverse its sign with [columns] {yaw} = {{column, "
            "factor = -1}, or exchange the columns of the sides",
        )  # fmt: skip


def _reject_opposite_signs(
    runs: Runs, column: str, shown: np.ndarray, readings: np.ndarray, drive: np.ndarray, expected: str
) -> None:
    """Rejects readings whose sign is mostly opposite to that of their drive. The message names the clearest row.

    Args:
        shown: values of the columns, shape (columns, rows).
    """
    counts = np.isfinite(readings) & (np.abs(drive) > CLEAR * np.max(np.abs(drive), initial=0.0))
    against = counts & (readings * drive < 0)
    if counts.sum() < FEWEST or against.sum() <= MOSTLY * counts.sum():
        return
    row = int(np.argmax(np.where(against, np.abs(drive), -1.0)))
    got, driven = (" and ".join(f"{float(f'{x:.4g}'):g}" for x in both[:, row]) for both in (shown, runs.of_sides))
    unit = runs.layout.imposed_column.rpartition("_")[2]
    raise BadData(
        f"{runs.place(row)}, {column}: got {got} although the left and right sides are driven at {driven} "
        f"{unit} (as in {against.sum()} of {counts.sum()} rows); expected {expected}"
    )


def with_unsigned_currents(runs: Runs) -> Runs:
    """Table with an instrument without sign for each side's current that is positive whenever its side is driven
    backward, and a note on each.
    """
    layout = runs.layout
    if not layout.sides or not all(map(runs.has, layout.sides)):
        return runs
    stated = {instrument.channel for instrument in layout.instruments}
    for side, drive in zip(channels.SIDES, runs.of_sides, strict=True):
        channel = channels.find_channel(f"motor_current_{side}")
        if runs.has(channel.column) and channel.name not in stated:
            readings = runs[channel.column]
            is_backward = np.isfinite(readings) & (drive < -CLEAR * np.max(np.abs(drive)))
            if is_backward.sum() >= FEWEST - 1 and (readings[is_backward] > 0).all() and not (readings < 0).any():
                note = f"{runs.source}: {channel.column} is positive although its side is driven backward"
                instruments = (*runs.layout.instruments, Instrument(channel.name, signed=False))
                runs = replace(runs, layout=replace(layout, instruments=instruments))
                runs = runs.with_columns({}, f"{note}, so magnitudes are compared")
    return runs


#: A voltage below this share of the back-EMF cannot turn the motors at an imposed speed [-]. Least back-EMF that is
#: checked [V].
TOO_SMALL, LEAST = 0.5, 0.2
#: Largest share of rows that may brake, in tables without currents.
MOST_BRAKING = 0.5
#: Channels whose instruments may show only the magnitude, by column. Currents: that of the motors first.
MAGNITUDES = {"motor_voltage_V": "motor_voltage"}
CURRENTS = {"motor_current_A": "motor_current", "total_current_A": "total_current"}
#: Jump of an angle that indicates a lost turn [deg], and its least multiple of the usual step.
HALF_TURN, UNUSUAL = 180.0, 4.0
#: Time step beyond which samples are missing, in usual steps.
GAP = 5.0
#: If time goes back in at most this share of rows, the rows are not just in another order.
SELDOM = 0.02


def check_contradictions(runs: Runs, robot: Robot) -> Runs:
    """Rejects a table that contradicts itself or its robot. Returns it with angles that keep counting.

    Raises:
        BadData: a vehicle has no mass, the table has turns of a robot that cannot turn, or the sides are exchanged.
            Also if the stated voltage cannot turn the motors at the imposed speed, a position wraps, an angle or a
            position changes its unit, or time goes back.
    """
    for name in np.unique(runs.configurations_named(robot)) if robot.has_ground else ():
        is_known = name in robot.configurations and not runs.has("total_mass_kg")
        if is_known and float(robot.configurations[str(name)].mass) <= 0:
            raise BadData(
                f"{runs.source}: no column total_mass_kg, and the robot's file has no mass for {name}; a vehicle "
                "needs one of the two"
            )
    if runs.turns:
        if why := turn_error(robot, sorted({str(n) for n in runs.configurations_named(robot)})):
            raise BadData(f"{runs.source}, {', '.join((*runs.layout.sides, *HEADING))}: {why}")
        check_turns(runs)
    if misplaced := misplaced_levers(runs, robot):
        row, column, why = misplaced
        raise BadData(f"{runs.place(row)}, {column}: {why}")
    if robot.rig.imposed == "motor_speed" and not runs.sampled and not runs.turns:
        for column in (SUPPLY, "motor_voltage_V"):
            _check_voltage(runs, robot, column)
    if runs.sampled:
        _check_time_order(runs)
        for column in ("output_angle_deg", "position_mm"):
            if runs.has(column):
                runs = unwrap_angle(runs, column)
    return runs


def reason_without_stance(robot: Robot) -> str | None:
    """Reason why the stance of a robot is unknown. None if it is known."""
    if not robot.has_ground:
        return "the robot's load is a shaft, which has no contact with the ground"
    if not any(robot.knows([f"running_gear.{p.name}"]) for p in params.walk_parameters(robot.running_gear)):
        return "the robot's file has no running_gear; add its wheelbase, levers and masses"
    return None


def reason_without_levers(robot: Robot, configuration: str) -> str:
    """Reason why a configuration has no levers, empty if it has levers."""
    have = [name for name, c in robot.configurations.items() if float(c.on_tracks) > 0.5]
    advice = f"configurations with levers: {', '.join(have)}" if have else "no configuration of the robot has"
    return "" if configuration in have else f"{configuration} has no levers; {advice}"


def misplaced_levers(runs: Runs, robot: Robot) -> tuple[int, str, str] | None:
    """Row and column of the first impossible lever angle, and the reason. None if all angles are possible.

    The reason is a configuration without levers, or an angle beyond their range.
    """
    lever_columns = [name for name in LEVERS if runs.has(name)]
    if not lever_columns:
        return None
    if why := reason_without_stance(robot):
        return 0, lever_columns[0], why
    on_tracks = robot.configurations.tracked[runs.configurations(robot)]
    if not on_tracks.all():
        row = int(np.argmin(on_tracks))
        return row, lever_columns[0], reason_without_levers(robot, runs["configuration"][row])
    levers = robot.running_gear.levers
    low, high = (float(np.degrees(x)) for x in (levers.angle_least, levers.angle_most))
    limits = f"{low:g} to {high:g}, the range of the robot's levers (running_gear.levers.angle_least, angle_most)"
    for name in lever_columns:
        for row in np.flatnonzero((runs[name] < low - 1e-9) | (runs[name] > high + 1e-9))[:1].tolist():
            return row, name, f"got {runs[name][row]:g}; expected {limits}"
    return None


def _check_voltage(runs: Runs, robot: Robot, column: str) -> None:
    """Rejects a voltage that contradicts the back-EMF of the motors at the imposed speed.

    A bridge may reverse the supply. Motors that a load drives act as brakes: their voltage is lower by the voltage
    drop of their current. Without current readings, a share of the rows may be such rows.
    """
    if not runs.has(column) or not np.nan_to_num(runs[column]).any() or not robot.knows(CURRENT):
        return
    voltage = runs[column]
    back_emf = np.asarray(robot.motor.voltage_back(jnp.asarray(runs[SPEED] * RPM)))
    is_magnitude = runs.layout.magnitude(MAGNITUDES.get(column, "")) or (column == SUPPLY and (voltage > 0).all())
    voltage_forward = np.abs(voltage) if is_magnitude else voltage * np.sign(back_emf)
    current_columns = CURRENTS if robot.knows(VOLTAGE) else ()
    current = next((c for c in current_columns if runs.has(c) and not runs.layout.magnitude(CURRENTS[c])), None)
    if current is not None:
        motors = float(robot.sides) if current == "total_current_A" else 1.0
        drop = np.nan_to_num(runs[current]) / motors * float(robot.motor.resistance)
        voltage_forward = voltage_forward - drop * np.sign(back_emf)
    compared = np.abs(back_emf) > LEAST
    wrong = compared & (voltage_forward < TOO_SMALL * np.abs(back_emf))
    if wrong.sum() > (0 if current else MOST_BRAKING * np.sum(compared)):
        row = int(np.argmax(wrong))
        fault = "with the wrong sign" if voltage_forward[row] < 0 else "too small"
        why = (
            f" at an imposed {SPEED} of {runs[SPEED][row]:g}, {fault} for the motors' back-EMF of "
            f"{float(f'{back_emf[row]:.3g}'):g} V; check both columns and motor.torque_constant in the robot's file"
        )
        runs.check_rows([(column, wrong, why)])


def _check_time_order(runs: Runs) -> None:
    """Rejects a time that sometimes goes back, because of several recordings or a reset clock. A consistent order,
    rising or falling, is accepted.
    """
    time, run = runs["time_s"], runs.run_names
    for name in np.unique(run):
        run_rows = np.flatnonzero(run == name)
        rows_of_falls = np.flatnonzero(np.diff(time[run_rows]) < 0)
        if 0 < rows_of_falls.size <= max(SELDOM * len(run_rows), 1):
            before, row = run_rows[rows_of_falls[0] :][:2]
            raise BadData(
                f"{runs.place(row)}, time_s: goes back from {time[before]:g} to {time[row]:g} s; give each recording "
                "its own run_id, or sort the rows"
            )


def _median_of_neighbours(step: np.ndarray) -> np.ndarray:
    """Median of the four steps around each step."""
    padded = np.pad(step, 2, constant_values=np.nan)
    return np.nanmedian([padded[k : k + len(step)] for k in (0, 1, 3, 4)], axis=0)


def unwrap_angle(runs: Runs, column: str) -> Runs:
    """Removes the wraps of an angle at a turn. Rejects an angle or a position that jumps otherwise.

    A position wraps at any length, so it also has to jump against its motion.
    """
    readings, is_angle, unit = runs[column].copy(), column == "output_angle_deg", column.rpartition("_")[2]
    noun = "an angle" if is_angle else "a position"
    note = ""
    for name in np.unique(runs.run_names):
        rows = runs.in_order(name)
        rows = rows[np.isfinite(readings[rows])]
        step = np.diff(readings[rows])
        if step.size < 2:
            continue
        size = np.abs(step)
        usual = np.maximum(np.median(size), _median_of_neighbours(size))
        is_turn = np.abs(size - 2 * HALF_TURN) <= UNUSUAL * usual
        is_jump = size > UNUSUAL * usual
        if is_angle:
            is_undone = np.minimum(*(np.abs(step + np.roll(step, k)) for k in (1, -1))) < HALF_TURN  # a wrong reading
            is_jump &= (size > HALF_TURN) & ((size < 2 * HALF_TURN + UNUSUAL * usual) | ~is_undone)
        else:
            is_jump &= (size > np.ptp(readings[rows]) / 2) & (step * _median_of_neighbours(step) < 0)
        if not is_jump.any():
            continue
        jump, time_steps = int(np.argmax(is_jump)), np.diff(runs["time_s"][rows])
        place = f"{runs.place(rows[jump + 1])}, {column}"
        why = f"like {noun} that wraps or changes its unit; expected {noun} that keeps counting"
        if time_steps[jump] > GAP * np.median(time_steps):
            why = f"{float(f'{time_steps[jump]:.3g}'):g} s earlier; give each recording its own run_id"
        elif is_angle and is_turn[is_jump].all():
            readings[rows] = np.unwrap(readings[rows], period=2 * HALF_TURN)
            note = f"{place}: wraps at {2 * HALF_TURN:g} {unit}. The wraps are removed"
            continue
        raise BadData(f"{place}: jumps by {float(f'{step[jump]:.4g}'):g} {unit} from the sample before, {why}")
    if not note:
        return runs
    return runs.with_columns({column: readings}, note)
