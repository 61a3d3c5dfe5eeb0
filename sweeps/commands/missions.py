"""The command `simulate` with a profile: all runs follow one mission. Results, segments and histories are tables."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np

from calibration.data import Columns, profiles
from calibration.data import runs as records
from calibration.data.columns import LOAD, ON_SHAFT, SUPPLY
from calibration.data.input_errors import BadConfiguration
from calibration.data.profiles import ProfileTable
from mmrjax.fidelities import outputs
from mmrjax.missions import mission_batch
from mmrjax.missions import profile as mission_profile
from mmrjax.missions.mission import Mission
from mmrjax.missions.mission_steps import MARKS
from mmrjax.model import balances, channels, contact, quantities
from mmrjax.model.conditions import Conditions
from mmrjax.model.paper_tables import COULOMB_PER_MAH, lateral_ratio
from mmrjax.model.robot import Robot
from sweeps import capabilities
from sweeps import config as configuration
from sweeps.console import print_message, progress_bar
from sweeps.inputs import OPTIONS, given_runs, load_robot
from sweeps.points import run
from sweeps.report import mission_report
from sweeps.report.mission_report import Missions
from sweeps.store import open_folder, print_report

#: Rows of history.csv: most and fewest of one run, and most of all runs together.
MAX_ROWS, MIN_ROWS, ALL_ROWS = 20_000, 200, 200_000
_FIRST_MARK_KEPT = MARKS.index("battery_empty")  # only later marks are kept: stops and starts are too many


def execute(config: configuration.Simulate, invocation: configuration.GivenRuns) -> int:
    """Simulates runs from a file, or one run from options, over a profile. Returns the exit code.

    Raises:
        BadConfiguration: options and profile state the same condition, or the battery is empty or below its cut-off
            at the start.
        BadData: the profile or the table of runs is wrong.
    """
    assert config.profile is not None
    file = load_robot(config)
    robot = file.robot
    if robot.rig.imposed != "voltage":
        imposed_words = capabilities.IMPOSED_WORDS[robot.rig.imposed].words
        raise BadConfiguration(
            f"--profile: the {imposed_words} is imposed on this robot, but a profile imposes the voltage; "
            'simulate a table, or set imposed = "voltage"'
        )
    if robot.loose:
        raise BadConfiguration(
            "--profile: profiles have no backlash or elastic joint; set them to 0, or use --model drive"
        )
    for name, load in robot.configurations.items():
        if float(load.torque_gravity) > 0:
            raise BadConfiguration(f"--profile: {name} is an arm; use --model drive")
    source = profiles.read_profile(config.profile)
    for note in source.notes:
        print_message(note)
    ground, shaft = (
        [f"{source.source}, {column}" for column in columns if column in source.stated]
        for columns in (("slope_deg", "payload_kg", "surface"), ON_SHAFT)
    )
    capabilities.check_acting(robot, ground, shaft)
    if "speed" in source.modes and not robot.shows_travel:
        raise BadConfiguration(
            f"{source.source}, speed_mm_s: a shaft has no travelling speed; give motor_speed_rpm or duty"
        )
    source.check_supply(config.battery)
    for column in source.stated:
        if column in invocation.stated:
            raise BadConfiguration(f"{OPTIONS[column]}: {source.source} contains {column} too; keep one of the two")
    capacity = float(robot.battery.capacity) / COULOMB_PER_MAH
    if config.battery and config.discharge_mAh >= capacity:
        raise BadConfiguration(
            f"--discharge: got {config.discharge_mAh:g} mAh; the battery is empty at {capacity:g} mAh"
        )
    runs = given_runs(robot, invocation, config, source.stated)
    for column in source.stated:
        if invocation.runs is not None and runs.has(column):
            print_message(f"{runs.source}, {column}: not used, because {source.source} gives it")
    if "current_other" in source.values and not config.battery:
        print_message(f"{source.source}, current_other_A: not used, because the battery supplies other consumers")
    _check_turning(robot, runs, source)
    conditions = _conditions_of_runs(robot, runs, source, config)
    profile = source.profile(robot, conditions)
    cell_voltages = mission_batch.cell_below_cutoff(robot, conditions, profile, source.start)
    for voltage in cell_voltages[np.isfinite(cell_voltages)][:1]:
        raise BadConfiguration(
            f"--discharge: got {config.discharge_mAh:g} mAh; a cell is then at {voltage:.4g} V, below its cut-off of "
            f"{robot.battery.voltage_cutoff:g} V, before the mission"
        )
    with open_folder("simulate", config, robot, invocation, runs) as folder:
        missions = run_missions(robot, runs, source, conditions, profile)
        columns = _condition_columns(robot, runs, source, config)
        missions = dataclasses.replace(missions, table=columns | missions.table)
        folder.write_table("segments.csv", capabilities.drop_inapplicable_columns(robot, missions.segments))
        folder.write_table("history.csv", capabilities.drop_inapplicable_columns(robot, missions.course))
        if not missions.whole:
            print_message("history.csv is cut short: the mission has too many steps")
        page = print_report(mission_report.missions_document(file, missions), file)
        return run.write_run_folder(folder, config.model, missions.table, page, missions.to_json())


def _check_turning(robot: Robot, runs: records.Runs, source: ProfileTable) -> None:
    """Rejects a robot that cannot turn if the profile drives its sides differently, and voltages above the supply
    voltage.
    """
    if not source.turns:
        return
    names = sorted({str(name) for name in runs.configurations_named(robot)})
    capabilities.check_can_turn(robot, names, f"{source.source} drives the two sides differently")
    highest = max(
        (float(np.abs(source.values[name]).max()) for name in mission_profile.PAIRS[1] if name in source.values),
        default=0.0,
    )
    supply = np.min(np.abs(source.values["voltage"] if "voltage" in source.values else runs[SUPPLY]))
    if highest > supply:
        raise BadConfiguration(
            f"{source.source}, voltage_left_V and voltage_right_V: got {highest:g} V; the supply has {supply:g} V "
            "(--voltage, or a column supply_voltage_V)"
        )


def _conditions_of_runs(
    robot: Robot, runs: records.Runs, source: ProfileTable, config: configuration.Simulate
) -> Conditions:
    """Conditions of the runs. For robots that turn, they include the lateral adhesion of a given surface."""
    conditions = run.conditions_of_runs(robot, runs, config)
    if not source.turns or not runs.has(profiles.SURFACE) or source.surface is not None:
        return conditions
    tracks = robot.configurations.tracked[np.asarray(conditions.configuration)]
    lateral = [lateral_ratio(str(s), t) for s, t in zip(runs[profiles.SURFACE], tracks, strict=True)]
    return dataclasses.replace(conditions, adhesion_lateral=jax.numpy.asarray(lateral))


def run_missions(
    robot: Robot, runs: records.Runs, source: ProfileTable, conditions: Conditions, profile: mission_profile.Profile
) -> Missions:
    """Simulates runs over a profile. The table has no conditions yet."""
    names = run.run_names(runs)
    max_rows = max(MIN_ROWS, min(MAX_ROWS, ALL_ROWS // len(runs)))
    run_tables: list[Columns] = []
    segment_tables: list[Columns] = []
    course_tables: list[Columns] = []
    is_complete = True
    with progress_bar(len(runs), quiet=False) as advance:
        for batch in mission_batch.simulate_in_parts(robot, conditions, profile, source.start):
            first = len(course_tables)
            count = len(batch.steps)
            batch_conditions = jax.tree.map(lambda x, a=first, b=first + count: np.asarray(x)[a:b], conditions)
            numbers = mission_batch.mission_numbers(robot, batch_conditions, batch)
            words = outputs.status_words(batch.result.status, batch.result.flags)
            run_tables.append({**mission_batch.numbers_by_column(jax.device_get(numbers)), **words})
            segment_totals = mission_batch.mission_totals(batch.segments, batch.segment_peaks)
            segment_numbers = mission_batch.numbers_by_column(jax.device_get(segment_totals))
            for k, name in enumerate(names[first : first + count]):
                mission, run_conditions, run_segments = jax.tree.map(
                    lambda x, k=k: x[k], (batch, batch_conditions, segment_numbers)
                )
                segment_tables.append(_segment_rows(robot, run_conditions, source, mission, run_segments, name))
                course_tables.append(_course_rows(robot, run_conditions, source, mission, name, max_rows))
            assert batch.course is not None  # it was asked for
            is_complete &= bool((batch.steps - batch.rejected <= batch.course.time.shape[-1]).all())
            advance(count)
    table, segment_rows, course = map(_concatenate_tables, (run_tables, segment_tables, course_tables))
    return Missions(table, segment_rows, course, source, is_complete)


def _concatenate_tables(tables: list[Columns]) -> Columns:
    """Concatenated tables with the same columns."""
    return {key: np.concatenate([table[key] for table in tables]) for key in tables[0]}


def _condition_columns(
    robot: Robot, runs: records.Runs, source: ProfileTable, config: configuration.Simulate
) -> Columns:
    """Conditions of the runs, empty if the profile states them or the battery determines them."""
    empty_column = np.full(len(runs), np.nan)
    emptied = {*source.stated, *(["supply_voltage_V"] if config.battery else [])}
    emptied |= {"total_mass_kg"} if "payload_kg" in emptied else set()
    columns = {
        key: empty_column if key in emptied else value for key, value in run.condition_table(robot, runs).items()
    }
    if source.surface is not None:
        columns.pop(profiles.SURFACE, None)
    return columns


def _segment_rows(
    robot: Robot, conditions: Conditions, source: ProfileTable, mission: Mission, numbers: Columns, name: str
) -> Columns:
    """Rows of segments.csv for one run: each segment of each cycle, up to the end of the run."""
    assert mission.course is not None  # it was asked for
    cycles, segments = mission.status.shape
    number = np.arange(cycles * segments)
    time = np.ravel(mission.segments.time)
    segment_of_step = np.where(
        mission.course.segment < 0, len(number), mission.course.segment
    )  # after the end, beyond the last
    last_steps = np.maximum(np.searchsorted(segment_of_step, number, side="right") - 1, 0)
    discharge = np.reshape(mission.course.signals.discharge, (len(segment_of_step), -1))[last_steps, 0]
    has_charge = (conditions.battery > 0.5) & (segment_of_step[last_steps] == number)
    numbers["state_of_charge"] = np.where(has_charge, 1 - discharge / float(robot.battery.capacity), np.nan)
    rows = {
        "run_id": np.full(len(number), name),
        "cycle": number // segments + 1,
        "segment": number % segments + 1,
        "time_s": np.cumsum(time) - time,
        "mode": np.array(source.modes)[number % segments],
        **{c: np.ravel(numbers[c]) for c in mission_batch.mission_columns(source.turns) if c in numbers},
        **outputs.status_words(mission.status.ravel(), mission.flags.ravel()),
    }
    return {column: values[time > 0] for column, values in rows.items()}


def select_course_rows(
    segment: np.ndarray, current: np.ndarray, max_rows: int, is_marked: np.ndarray | None = None
) -> np.ndarray:
    """Rows of a course to keep, in order: the current peak of each segment, marked rows, and evenly spaced ones.

    Args:
        segment: index of the segment of each row, not decreasing.
        current: current of each row.
        max_rows: largest number of rows to keep.
        is_marked: rows to keep. If there are too many, the last ones.
    """
    if len(segment) <= max_rows:
        return np.arange(len(segment))
    firsts = np.flatnonzero(np.diff(segment, prepend=segment[0] - 1))
    ends = np.append(firsts[1:], len(segment))
    peaks = np.array([a + np.argmax(np.abs(current[a:b])) for a, b in zip(firsts, ends, strict=True)])
    if len(peaks) > max_rows // 2:  # if there are too many segments, those with the highest peaks
        peaks = peaks[np.argsort(-np.abs(current[peaks]), kind="stable")[: max_rows // 2]]
    if is_marked is not None:
        peaks = np.union1d(peaks, np.flatnonzero(is_marked)[-(max_rows // 4) :])
    evenly_spaced = np.round(np.linspace(0, len(segment) - 1, max_rows - len(peaks))).astype(int)
    return np.unique(np.concatenate([peaks, evenly_spaced]))


def _course_rows(
    robot: Robot, conditions: Conditions, source: ProfileTable, mission: Mission, name: str, max_rows: int
) -> Columns:
    """Rows of history.csv for one run."""
    assert mission.course is not None  # it was asked for
    is_step = mission.course.segment >= 0
    course = jax.tree.map(lambda x: x[is_step], mission.course)
    largest_current = np.abs(course.signals.current).reshape(len(course.segment), -1).max(1)  # both sides
    kept_rows = select_course_rows(course.segment, largest_current, max_rows, course.event >= _FIRST_MARK_KEPT)
    course = jax.tree.map(lambda x: x[kept_rows], course)
    signals = course.signals
    side_columns = {}
    winding, housing = course.temperature_winding, course.temperature_housing
    if source.turns:
        reading = balances.readings_of_sides(robot, signals)
        signals = balances.mean_of_sides(signals)
        side_columns = {c.column: np.asarray(reading[c.name]) / c.factor for c in channels.OF_TURNS}
        for side, duty, temperature in zip(channels.SIDES, course.signals.duty.T, winding.T, strict=True):
            side_columns |= {f"duty_{side}": duty, f"winding_temperature_{side}_C": temperature}
        winding, housing = winding.max(1), housing.max(1)
    else:
        reading = balances.sensor(robot, signals)
    # Demands act this much later than in the profile, as do the values written next to them.
    delay = float(robot.rig.delay)
    segment = course.segment % source.segment_count
    length = np.ravel(mission.segments.time)
    elapsed = course.time - (np.cumsum(length) - length)[course.segment]
    motor_speed_per_speed = float(
        robot.gearbox.ratio / robot.configurations.members[int(conditions.configuration)].radius
    )
    state_of_charge = 1 - signals.discharge / float(robot.battery.capacity)
    demanded = source.demanded(segment, elapsed, motor_speed_per_speed)
    shaft_columns = {}
    if not robot.has_ground:
        shaft_columns = {
            "motor_speed_rpm": np.asarray(reading["motor_speed"]) / quantities.RPM,
            "demanded_motor_speed_rpm": demanded * motor_speed_per_speed / quantities.RPM,
        }
    return {
        "run_id": np.full(len(kept_rows), name),
        "time_s": course.time + delay,
        **{c.column: np.asarray(reading[c.name]) / c.factor for c in robot.channels},
        "theoretical_speed_mm_s": signals.speed_theoretical / quantities.MM,
        "slip": np.asarray(contact.slip_ratio(signals.speed, signals.speed_theoretical)),
        "distance_m": course.path,
        "displacement_m": course.distance,
        "voltage_V": signals.voltage,
        "traction_N": float(robot.sides) * signals.traction,
        "demanded_speed_mm_s": demanded / quantities.MM,
        **shaft_columns,
        "duty": signals.duty,
        "source_voltage_V": signals.voltage_source,
        "motor_current_A": np.asarray(reading["motor_current"]),
        "slope_deg": np.degrees(signals.slope),
        **({} if signals.load_torque is None else {LOAD: signals.load_torque}),
        "winding_temperature_C": winding if source.turns else np.asarray(reading["winding_temperature"]),
        "housing_temperature_C": housing,
        "energy_Wh": course.energy / quantities.SIZES["Wh"],
        "state_of_charge": np.where(conditions.battery > 0.5, state_of_charge, np.nan),
        "cycle": course.segment // source.segment_count + 1,
        "segment": segment + 1,
        **side_columns,
        "event": np.array([*MARKS, ""])[course.event],
    }
