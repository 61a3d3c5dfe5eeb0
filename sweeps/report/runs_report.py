"""Report of `simulate`: readings, limits, history from standstill and power balance of each run."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from calibration.data import Columns, Json
from calibration.data.robot_file import RobotFile
from mmrjax.fidelities.base import History, RunBatch
from mmrjax.model.channels import SIDES, Channel, channels_named
from mmrjax.model.quantities import RPM, VOLTAGE
from mmrjax.model.robot import Robot
from sweeps import capabilities
from sweeps.pages import words
from sweeps.report import catalogue, drive_curves, run_tables, turn_words
from sweeps.report.document import SIDE_BY_SIDE, Block, Column, Document, Note, Section, Table, remarks
from sweeps.report.turn_words import Postures

#: Column of the largest total motor current in a run over time.
PEAK = "peak_current_A"
#: Quantities before and after the readings of a run, in the order of the table.
_CONDITIONS = ("total_mass_kg", "slope_deg", "load_torque_Nm", "duty_left", "duty_right", "heading_deg")
_FURTHER = (
    PEAK, "displacement_m", "time_end_s", "voltage_cell_V", "slip", "power_supply_W", "power_motor_W", "power_gear_W",
    "power_ground_W", "power_lift_W", "winding_settled_C", "permissible_time_s", "adhesion_used", "status", "flags",
)  # fmt: skip
HISTORIES, CHAINS, GEARS = 4, 12, 2  # most runs in a figure


def runs_document(
    file: RobotFile,
    model: str,
    runs: Columns,
    histories: RunBatch | None = None,
    postures: Postures | None = None,
    notes: Sequence[str] = (),
) -> Document:
    """Report of a few finished runs.

    Args:
        runs: table of the finished runs.
        histories: the runs as a batch with histories, if these are kept.
        postures: postures, if the runs state lever angles.
        notes: remarks on the runs.
    """
    robot = file.robot
    names = run_headings(runs)
    single = len(names) == 1
    first_run = {key: value[0] for key, value in runs.items()}
    limit_use = limits_used(robot, first_run) if single else []
    table = capabilities.drop_inapplicable_columns(robot, runs)
    if not np.nan_to_num(table.get("voltage_cell_V", 0.0)).any():
        table.pop("voltage_cell_V", None)
    blocks: list[Block] = [run_tables.note_on_robot(file, model, "From standstill." if histories is not None else "")]
    if limit_use:
        blocks += [run_tables.limits_table(limit_use, "this run"), catalogue.note("run.warming")]
    if not (single and first_run["status"] in words.SETTLED):
        blocks.append(run_tables.endings_table(Counter(map(str, runs["status"]))))
    blocks += remarks([*notes, *([] if postures is None else [turn_words.posture_sentences(postures)])])
    imposed = run_tables.imposed_column(table)
    run_table = run_tables.quantity_table(
        "runs", table, (imposed, *_CONDITIONS, *(c.column for c in robot.channels), *_FURTHER),
        first=[(Column("run"), names)], file="runs.csv", wide=len(names) > SIDE_BY_SIDE, sideways=True,
    )  # fmt: skip

    def sections() -> Iterable[Section]:
        if histories is not None:
            yield from _histories(robot, runs, names, histories)
        if postures is not None:
            yield Section("Posture", (catalogue.figure("runs.posture", postures),), "posture-section")
        yield Section("Where the power goes", tuple(_power(robot, runs, names)), "chain")

    runs_section = Section("The run" if single else "The runs", (run_table,), "runs-section")
    title = f"Run of {names[0]}" if single else f"{len(names)} runs"
    return Document(title, runs_answer(runs, robot.channels, limit_use), tuple(blocks), (runs_section,), sections)


def runs_answer(runs: Columns, channels: Sequence[Channel], limit_use: Sequence[Json]) -> str:
    """One sentence: readings of a single run and its most used limit, or the number of runs that settle.

    Args:
        limit_use: limits of a single run, from `limits_used`.
    """
    settled = np.isin(runs["status"], words.SETTLED)
    if len(settled) > 1:
        flagged = int((settled & (runs["flags"] != "")).sum())
        limits_text = ", all within every limit" if settled.any() else ""
        if flagged:
            limits_text = f". {flagged} of them {'exceeds' if flagged == 1 else 'exceed'} a limit"
        return f"{settled.sum()} of {len(settled)} runs have an operating point{limits_text}."
    if not settled[0]:
        return f"No operating point: {words.status_meaning(str(runs['status'][0]))}."
    readings = ", ".join(f"{c.label} {run_tables.reading_text(runs[c.column][0], c)} {c.unit}" for c in channels)
    answer = f"{readings[0].upper()}{readings[1:]}."
    nearest = max((x for x in limit_use if x["percent"] is not None), key=lambda x: x["percent"], default=None)
    if nearest is None:
        return answer
    verb = "exceeds its limit" if nearest["percent"] > 100 else "is the nearest limit"
    return f"{answer} The {nearest['words']} {verb} ({nearest['percent']:.0f} % of {nearest['limit']})."


def run_headings(runs: Columns) -> list[str]:
    """Heading for each run: its name if it has one, and its conditions."""
    headings = [conditions_in_words(runs, k) for k in range(len(runs["status"]))]
    return [f"{runs['run_id'][k]}: {heading}" for k, heading in enumerate(headings)] if "run_id" in runs else headings


def conditions_in_words(table: Columns, row: int) -> str:
    """Conditions of a row in words: configuration, imposed quantity, payload, slope, load torque and duties."""
    run = {name: values[row] for name, values in table.items()}
    parts = [str(run["configuration"])]
    if "supply_voltage_V" in run:
        parts.append("battery" if math.isnan(volts := float(run["supply_voltage_V"])) else f"{volts:g} V")
    elif "motor_speed_rpm" in run:
        parts.append(f"{run['motor_speed_rpm']:g} rpm")
    elif "motor_current_A" in run and "simulated_motor_current_A" not in run:
        parts.append(f"{run['motor_current_A']:g} A")
    if "payload_kg" in run:
        parts += [f"{run['payload_kg']:g} kg", f"{run['slope_deg']:g}°"]
    if "load_torque_Nm" in run:
        parts.append(f"{run['load_torque_Nm']:.4g} N·m")
    if "duty_left" in run:
        parts.append(f"duties {run['duty_left']:.3g} and {run['duty_right']:.3g}")
    return ", ".join(parts)


def _histories(robot: Robot, runs: Columns, names: list[str], histories: RunBatch) -> Iterable[Section]:
    """Sections on runs over time: readings of a shaft, or starts of a vehicle and the ripple of its running gear."""
    history = histories.history
    status = np.asarray(histories.result.status)
    assert history is not None  # the fidelity was asked for it
    shown_names = names[:HISTORIES]
    cut_notes = (catalogue.note("runs.cut", HISTORIES, len(names)),) * (len(names) > HISTORIES)
    if not robot.has_ground:
        if any(c.over_time for c in robot.channels):
            figure = catalogue.figure("runs.courses", robot.channels, history, status, shown_names)
            yield Section("Over time", (*cut_notes, figure), "history-section")
        return
    from sweeps.pages import history_figures, resonance_figures

    configuration_indices = [robot.configurations.index(str(c)) for c in runs["configuration"]]
    starts = history_figures.start_runs(robot, history, status, configuration_indices, shown_names)
    averaged = ""
    if history.reactions is not None:
        averaged = catalogue.text("runs.averaged", 1e3 * float(history.time[0, 1] - history.time[0, 0]))
    figure = catalogue.figure("runs.history", starts, more=averaged)
    yield Section("From standstill", (*cut_notes, figure, starts_table(starts)), "history-section")
    if history.reactions is None:
        return
    share = np.asarray(histories.columns["guide_share"])
    gears = resonance_figures.gear_runs(robot, history, status, share, configuration_indices, names[:GEARS])
    # Ripple is evaluated in steady travel: contacts stop sliding before the evaluated part.
    ripples = [
        gear
        for gear, start in zip(gears, starts, strict=False)
        if start.gets_under_way and gear.settled_since(start.stages.slipping)
    ]
    if ripples:
        on_tracks = [gear for gear in ripples if gear.on_tracks][:1]
        touchdowns = (
            catalogue.figure("runs.touchdown", gear, f"{gear.name}: touchdowns dotted") for gear in on_tracks
        )
        figures = (*touchdowns, catalogue.figure("runs.reactions", ripples))
        ripple_blocks = catalogue.figure("runs.ripple", ripples), ripple_table(ripples)
        yield Section("Inside the running gear", (*ripple_blocks, *figures), "gear")


def starts_table(starts: Sequence[Any]) -> Table:
    """Table of stages, currents and slip of each start. Runs that do not get under way have no stages."""
    rows = []
    for start in starts:
        numbers: list[float | None] = [None] * 10
        if start.time.size:
            stages = start.stages
            times = [stages.starting, stages.slipping, stages.settled]
            slips = [*stages.slip, stages.slip_settling]
            if not start.gets_under_way:
                times = [None] * 3
                slips = [math.nan] * 4
            numbers = [
                *times,
                *(stages.sense * x for x in (start.peak, *start.end_values)),
                *(100 * x for x in slips),
            ]
        rows.append((start.name, words.short_status(start.status), *numbers))
    return catalogue.table("runs.starts", rows)


def ripple_table(ripples: Sequence[Any]) -> Table:
    """Table of the ripple at the end of each run."""
    from sweeps.pages import resonance_figures

    return catalogue.table("runs.ripple-table", [resonance_figures.ripple_row(g) for g in ripples])


def _power(robot: Robot, runs: Columns, names: Sequence[str]) -> Iterable[Block]:
    """Power chains of the settled runs, and the chart of motor and gearbox with the forward ones."""
    from sweeps.pages import power_figures

    settled = np.isin(runs["status"], words.SETTLED)
    chain_rows = np.flatnonzero(power_figures.drawable_runs(runs) & settled)[:CHAINS]
    if chain_rows.size:
        if len(chain_rows) < len(names):
            yield catalogue.note("runs.chains", len(chain_rows), len(names), CHAINS)
        chain_runs = {key: value[chain_rows] for key, value in runs.items()}
        explanation = catalogue.text("runs.on_ground" if robot.has_ground else "runs.on_shaft")
        yield catalogue.figure(
            "runs.power", chain_runs, [names[k] for k in chain_rows], robot.has_ground, more=explanation
        )
    else:
        sentence = "no run ends in steady travel" if robot.has_ground else "no run ends turning steadily"
        unknown = [] if robot.knows(VOLTAGE) else capabilities.unknown_numbers_sentence(robot)
        yield Note(f"{'. '.join(unknown or [sentence]).capitalize()}.")
    supply = runs.get("supply_voltage_V", np.full(len(names), np.nan))
    forward = settled & (supply > 0) & (runs["theoretical_speed_mm_s"] > 0)
    if forward.any() and robot.knows(VOLTAGE) and np.isfinite(runs["total_current_A"][forward]).all():
        points = drive_curves.operating_points(robot, {key: value[forward] for key, value in runs.items()})
        curves = drive_curves.drive_curves(robot, np.unique(supply[forward])[-3:].tolist())
        yield catalogue.figure("run.drive_chart", robot, curves, points)


def limits_used(robot: Robot, run: Json) -> list[Json]:
    """Use of each limit by a run. The inrush current has no share if its limit is not stated."""
    inapplicable = capabilities.inapplicable_columns(robot)
    points = drive_curves.operating_points(robot, {name: np.atleast_1d(x) for name, x in run.items()})
    motor_speed, torque = float(points["motor_rpm"][0]), float(points["torque_Nm"][0])
    cell = math.nan if "voltage_cell_V" in inapplicable else float(run["voltage_cell_V"]) or math.nan  # 0: no supply
    torque_label = f"gearbox torque at {'the driving wheel' if robot.has_ground else 'its output'}"
    limits = [
        ("adhesion", math.nan if "adhesion_used" in inapplicable else float(run["adhesion_used"]), 1.0, "{:.2f}"),
        ("motor speed", motor_speed, float(robot.motor.speed_limit) / RPM, "{:.0f} rpm"),
        ("gearbox input speed", motor_speed, float(robot.gearbox.speed_limit) / RPM, "{:.0f} rpm"),
        ("winding, long running", run["winding_settled_C"], robot.motor.temperature_limit, "{:.0f} °C"),
        (
            torque_label,
            torque if abs(motor_speed) > 1e-9 else math.nan,
            robot.gearbox.torque_limit or math.nan,
            "{:.2f} N·m",
        ),
        ("voltage of a cell, charged", cell, robot.battery.voltage_charge, "{:.2f} V"),
    ]
    used_limits = run_tables.use_of_limits(limits, float(robot.motor.temperature_ambient))
    if PEAK in run and not math.isnan(peak := float(run[PEAK])):
        # Largest current for all motors [A]: that of the driver, or of the battery minus other consumers.
        driver_limit = float(robot.driver.current_limit)
        battery = robot.battery
        current_limits = list[float]()
        if driver_limit < float(type(robot.driver)().current_limit):
            current_limits.append(float(robot.sides) * driver_limit)
        if math.isnan(float(run.get("supply_voltage_V", math.nan))) and battery.current_limit is not None:
            current_limits.append(battery.current_limit - float(battery.current_other))
        current_limit = min(current_limits, default=None)
        used_limits.append({
            "words": "largest current of the start, all motors", "value": f"{peak:.1f} A",
            "limit": "not stated" if current_limit is None else f"{current_limit:.1f} A",
            "percent": None if current_limit is None else 100 * peak / current_limit,
            "unstated": "driver.current_limit" + ", battery.current_limit" * bool(run.get("voltage_cell_V")),
        })  # fmt: skip
    return used_limits


#: Quantities of each side: name, column, format.
_ROWS = (
    ("voltage [V]", "motor_voltage_{}_V", "z.2f"),
    ("current [A]", "motor_current_{}_A", "z.3f"),
    ("motor speed [rpm]", "motor_speed_{}_rpm", "z.0f"),
    ("electrical power [W]", "power_{}_W", "z.1f"),
    ("winding, long running [°C]", "winding_{}_C", "z.0f"),
)


def turn_document(
    file: RobotFile,
    model: str,
    run: Columns,
    end: Mapping[str, float] | None,
    history: History | None,
    turns: Columns | None,
    notes: Sequence[str],
) -> Document:
    """Report of a turn.

    Args:
        run: row of the turn in `runs.csv`.
        end: time, distance and angle at the end of a run over time.
        history: history over time, if the fidelity keeps it.
        turns: settled turns at other duties of the slower side.
        notes: further remarks.
    """
    robot = file.robot
    row = {name: values[0] for name, values in run.items()}
    sides = sides_table(robot, row)
    sections = []
    if history is not None:
        reading = {name: np.asarray(values)[0] for name, values in history.reading.items()}
        if sides.rows:
            path = catalogue.figure(
                "turn.path", robot, row, *(reading[name] for name in ("place_x", "place_y", "yaw"))
            )
            sections.append(Section("From above", (path,)))
        names = [f"motor_{quantity}_{side}" for quantity in ("current", "speed") for side in SIDES]
        rows = {c.column: reading[c.name] / c.factor for c in channels_named((*names, "yaw_rate"))}
        rows["time_s"] = np.asarray(history.time)[0]
        sections.append(Section("Over time", (catalogue.figure("turn.course", rows),)))
    elif turns is not None:
        sections.append(Section("Other turns", (catalogue.figure("turn.turns", turns, row),)))
    turn_remarks = turn_words.turn_notes(robot, row) if turn_words.has_motion(row) else []
    return Document(
        f"Turn of {run_headings(run)[0]}",
        turn_words.turn_answer(row, end),
        (run_tables.note_on_robot(file, model), sides, *remarks([*turn_remarks, *notes])),
        tuple(sections),
    )


def sides_table(robot: Robot, row: Columns) -> Table:
    """Table of both sides, without rows if no motion is known."""
    inapplicable = capabilities.inapplicable_columns(robot)
    has_yaw_rate = math.isfinite(float(row["yaw_rate_rad_s"]))
    rows = []
    for label, column, form in _ROWS if has_yaw_rate else ():
        values = [float(row[column.format(side)]) for side in SIDES]
        if column.format(SIDES[0]) not in inapplicable:
            rows.append((label, *(words.NONE_SETTLES if math.isinf(v) else format(v, form) for v in values)))
    return catalogue.table("turn.sides", rows)
