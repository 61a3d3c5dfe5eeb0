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
from mmrjax.model.quantities import MM, RPM, VOLTAGE
from mmrjax.model.robot import Robot
from sweeps import capabilities
from sweeps.pages import words
from sweeps.report import catalogue, run_tables, turn_words
from sweeps.report.document import SIDE_BY_SIDE, Block, Column, Document, Note, Section, Table, remarks
from sweeps.report.run_tables import imposed_column
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
    stands: Postures | None = None,
    notes: Sequence[str] = (),
) -> Document:
    """Report of a few finished runs.

    Args:
        runs: table of the finished runs.
        histories: the runs as a batch with histories, if these are kept.
        stands: postures, if the runs state lever angles.
        notes: remarks on the runs.
    """
    robot, names = file.robot, run_headings(runs)
    single, first_run = len(names) == 1, {key: value[0] for key, value in runs.items()}
    limit_use = limits_used(robot, first_run) if single else []
    endings = run_tables.endings_table(Counter(map(str, runs["status"])))
    table = capabilities.drop_inapplicable_columns(robot, runs)
    shown_columns = (imposed_column(table), *_CONDITIONS, *(c.column for c in robot.channels), *_FURTHER)
    if not np.nan_to_num(table.get("voltage_cell_V", 0.0)).any():
        table.pop("voltage_cell_V", None)
    blocks: list[Block] = [run_tables.note_on_robot(file, model, "From standstill." if histories is not None else "")]
    blocks += [run_tables.limits_table(limit_use, "this run"), catalogue.note("run.warming")] if limit_use else []
    shown_table = run_tables.quantity_table(
        "runs", table, shown_columns, first=[(Column("run"), names)], file="runs.csv", wide=len(names) > SIDE_BY_SIDE,
        sideways=True,
    )  # fmt: skip
    of_runs = Section("The run" if single else "The runs", (shown_table,), "runs-section")
    blocks += [] if single and first_run["status"] in words.SETTLED else [endings]
    blocks += remarks([*notes, *([] if stands is None else [turn_words.posture_sentences(stands)])])

    def sections() -> Iterable[Section]:
        if histories is not None:
            yield from _histories(robot, runs, names, histories)
        if stands is not None:
            yield _posture(stands, names)
        chart = tuple(_drive_chart(robot, runs))
        yield Section("Where the power goes", (*_power_chain(robot, runs, names), *chart), "chain")

    title = f"Run of {names[0]}" if single else f"{len(names)} runs"
    return Document(title, runs_answer(runs, robot.channels, limit_use), tuple(blocks), (of_runs,), sections)


def runs_answer(runs: Columns, channels: Sequence[Channel], used: Sequence[Json]) -> str:
    """One sentence: readings of a single run and its most used limit, or the number of runs that settle.

    Args:
        used: limits of a single run, from `limits_used`.
    """
    settled = np.isin(runs["status"], words.SETTLED)
    if len(settled) > 1:
        flagged_count = int((settled & (runs["flags"] != "")).sum())
        exceeding_words = f". {flagged_count} of them {'exceeds' if flagged_count == 1 else 'exceed'} a limit"
        limits_words = (exceeding_words if flagged_count else ", all within every limit") if settled.any() else ""
        return f"{settled.sum()} of {len(settled)} runs have an operating point{limits_words}."
    if not settled[0]:
        return f"No operating point: {words.status_meaning(str(runs['status'][0]))}."
    readings = ", ".join(f"{c.label} {run_tables.reading_text(runs[c.column][0], c)} {c.unit}" for c in channels)
    judged = [limit for limit in used if limit["percent"] is not None]
    readings = readings[0].upper() + readings[1:]
    if not judged:
        return f"{readings}."
    nearest = max(judged, key=lambda limit: limit["percent"])
    verb = "exceeds its limit" if nearest["percent"] > 100 else "is the nearest limit"
    return f"{readings}. The {nearest['words']} {verb} ({nearest['percent']:.0f} % of {nearest['limit']})."


def run_headings(runs: Columns) -> list[str]:
    """Heading for each run: its name if it has one, and its conditions."""
    headings = [conditions_in_words(runs, k) for k in range(len(runs["status"]))]
    return [f"{runs['run_id'][k]}: {heading}" for k, heading in enumerate(headings)] if "run_id" in runs else headings


def conditions_in_words(table: Columns, row: int) -> str:
    """Conditions of a row in words: the imposed quantity, and for vehicles payload, slope and a rig's surface."""
    parts = [str(table["configuration"][row])]
    if "supply_voltage_V" in table:
        parts.append("battery" if math.isnan(volts := float(table["supply_voltage_V"][row])) else f"{volts:g} V")
    elif "motor_speed_rpm" in table:
        parts.append(f"{table['motor_speed_rpm'][row]:g} rpm")
    elif "motor_current_A" in table and "simulated_motor_current_A" not in table:
        parts.append(f"{table['motor_current_A'][row]:g} A")
    if "payload_kg" in table:
        parts += [f"{table['payload_kg'][row]:g} kg", f"{table['slope_deg'][row]:g}°"]
    if "load_torque_Nm" in table:
        parts.append(f"{table['load_torque_Nm'][row]:.4g} N·m")
    if "duty_left" in table:
        parts.append(f"duties {table['duty_left'][row]:.3g} and {table['duty_right'][row]:.3g}")
    return ", ".join(parts)


def _histories(robot: Robot, runs: Columns, names: list[str], histories: RunBatch) -> Iterable[Section]:
    """Section on runs over time: readings of instruments, or starts on a ground, with effects of the running gear."""
    from sweeps.pages import history_figures, resonance_figures

    configuration_indices = [robot.configurations.index(str(c)) for c in runs["configuration"]]
    history, status = histories.history, np.asarray(histories.result.status)
    assert history is not None  # the fidelity was asked for it
    cut = (catalogue.note("runs.cut", HISTORIES, len(names)),) * (len(names) > HISTORIES)
    if not robot.has_ground:
        if any(c.over_time for c in robot.channels):
            members = history_figures.shaft_runs(robot.channels, history, status, names[:HISTORIES])
            names_of = [c.name for c in robot.channels]
            ends = [
                (s.name, words.short_status(s.status), *(read(n) for n in names_of for read in (s.largest, s.last)))
                for s in members
            ]
            read_heads = run_tables.reading_columns(robot.channels, {"": "largest", "last_": "at the end"})
            table = catalogue.table("runs.courses-table", ends, *(column for _, column in read_heads))
            yield Section("Over time", (*cut, catalogue.figure("runs.courses", members), table), "history-section")
        return
    starts = history_figures.start_runs(robot, history, status, configuration_indices, names[:HISTORIES])
    averaged = ""
    if history.reactions is not None:
        averaged = catalogue.text("runs.averaged", 1e3 * float(history.time[0, 1] - history.time[0, 0]))
    figure = catalogue.figure("runs.history", starts, more=averaged)
    yield Section("From standstill", (*cut, figure, starts_table(starts)), "history-section")
    if history.reactions is None:
        return
    share = np.asarray(histories.columns["guide_share"])
    gears = resonance_figures.gear_runs(robot, history, status, share, configuration_indices, names[:GEARS])
    # Ripple is evaluated in steady travel: contacts stop sliding before the evaluated part.
    ripples = [g for g, s in zip(gears, starts, strict=False) if s.gets_under_way and g.settled_since(s.slipping)]
    if ripples:
        touchdowns = [
            catalogue.figure("runs.touchdown", g, f"{g.name}: touchdowns dotted") for g in ripples if g.on_tracks
        ]
        blocks: tuple[Block, ...] = (catalogue.figure("runs.ripple", ripples), ripple_table(ripples))
        blocks += (*touchdowns[:1], catalogue.figure("runs.reactions", ripples))
        yield Section("Inside the running gear", blocks, "gear")


def starts_table(starts: Sequence[Any]) -> Table:
    """Table of stages, currents and slip of each start. Runs that do not get under way have no stages."""
    rows = []
    for s in starts:
        numbers: list[float | None] = [None] * 10
        if s.time.size:
            under_way = (s.starting, s.slipping, s.settled), (*s.stages.slip, s.stages.over_settling)
            times, slips = under_way if s.gets_under_way else ([None] * 3, [math.nan] * 4)
            ends = (s.sense * x for x in (s.peak, *s.ended))
            numbers = [*times, *ends, *(100 * x for x in slips)]
        rows.append((s.name, words.short_status(s.status), *numbers))
    return catalogue.table("runs.starts", rows)


def ripple_table(ripples: Sequence[Any]) -> Table:
    """Table of the ripple at the end of each run."""
    from sweeps.pages import resonance_figures

    return catalogue.table("runs.ripple-table", [resonance_figures.ripple_row(g) for g in ripples])


def _posture(stands: Postures, names: Sequence[str]) -> Section:
    table = turn_words.posture_table(stands, names)
    return Section("Posture", (catalogue.figure("runs.posture", stands), table), "posture-section")


def _power_chain(robot: Robot, runs: Columns, names: Sequence[str]) -> Iterable[Block]:
    from sweeps.pages import power_figures

    chain = np.flatnonzero(power_figures.drawable_runs(runs) & np.isin(runs["status"], words.SETTLED))[:CHAINS]
    if not chain.size:
        no_run_sentence = "No run ends in steady travel." if robot.has_ground else "No run ends turning steadily."
        unknown = [] if robot.knows(VOLTAGE) else capabilities.unknown_numbers_sentence(robot)
        yield Note(f"{'. '.join(unknown).capitalize()}." if unknown else no_run_sentence)
        return
    if len(chain) < len(names):
        yield catalogue.note("runs.chains", len(chain), len(names), CHAINS)
    picked = {key: value[chain] for key, value in runs.items()}
    chain_end_text = catalogue.text("runs.on_ground" if robot.has_ground else "runs.on_shaft")
    yield catalogue.figure("runs.power", picked, [names[k] for k in chain], robot.has_ground, more=chain_end_text)


def _drive_chart(robot: Robot, runs: Columns) -> Iterable[Block]:
    """Chart of motor and gear with the settled forward runs on a supply."""
    from sweeps.pages import power_figures

    supply = runs.get("supply_voltage_V", np.full(len(runs["status"]), np.nan))
    is_drawn = np.isin(runs["status"], words.SETTLED) & (supply > 0) & (runs["theoretical_speed_mm_s"] > 0)
    if is_drawn.any() and robot.knows(VOLTAGE) and np.isfinite(runs["total_current_A"][is_drawn]).all():
        points = power_figures.operating_points(robot, {key: value[is_drawn] for key, value in runs.items()})
        voltages = np.unique(supply[is_drawn])[-3:].tolist()
        yield catalogue.figure("run.drive_chart", robot, voltages, points)


def limits_used(robot: Robot, run: Json) -> list[Json]:
    """Use of each limit by a run. The inrush current has no share if its limit is not stated."""
    idle = capabilities.inapplicable_columns(robot)
    radius = float(robot.configurations[str(run["configuration"])].radius)
    shaft = float(run["theoretical_speed_mm_s"]) * MM / radius * float(robot.gearbox.ratio) / RPM
    turning = abs(shaft) > 1e-9
    torque = (
        float(run["power_gear_W"]) / (float(robot.sides) * shaft * RPM) * float(robot.gearbox.ratio)
        if turning
        else math.nan
    )
    cell = math.nan if "voltage_cell_V" in idle else float(run["voltage_cell_V"]) or math.nan  # 0: no supply
    gear = f"gearbox torque at {'the driving wheel' if robot.has_ground else 'its output'}"
    limits = [
        ("adhesion", math.nan if "adhesion_used" in idle else float(run["adhesion_used"]), 1.0, "{:.2f}"),
        ("motor speed", shaft, float(robot.motor.speed_limit) / RPM, "{:.0f} rpm"),
        ("gearbox input speed", shaft, float(robot.gearbox.speed_limit) / RPM, "{:.0f} rpm"),
        ("winding, long running", run["winding_settled_C"], robot.motor.temperature_limit, "{:.0f} °C"),
        (gear, torque, robot.gearbox.torque_limit or math.nan, "{:.2f} N·m"),
        ("voltage of a cell, charged", cell, robot.battery.voltage_charge, "{:.2f} V"),
    ]
    used_limits = run_tables.use_of_limits(limits, float(robot.motor.temperature_ambient))
    if PEAK in run and not math.isnan(peak := float(run[PEAK])):
        # Largest current for all motors [A]: that of the driver, or of the battery minus other consumers.
        driver_limit, battery = float(robot.driver.current_limit), robot.battery
        current_limits = (
            [float(robot.sides) * driver_limit] if driver_limit < float(type(robot.driver)().current_limit) else []
        )
        if math.isnan(float(run.get("supply_voltage_V", math.nan))) and battery.current_limit is not None:
            current_limits.append(battery.current_limit - float(battery.current_other))
        inrush = min(current_limits, default=None)
        used_limits.append({
            "words": "largest current of the start, all motors", "value": f"{peak:.1f} A",
            "limit": "not stated" if inrush is None else f"{inrush:.1f} A",
            "percent": None if inrush is None else 100 * peak / inrush,
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
    ended: Mapping[str, float] | None,
    history: History | None,
    turns: Columns | None,
    notes: Sequence[str],
) -> Document:
    """Report of a turn.

    Args:
        run: row of the turn in `runs.csv`.
        ended: time, distance and angle at the end of a run over time.
        history: history over time, if the fidelity keeps it.
        turns: settled turns at other duties of the slower side.
        notes: further remarks.
    """
    robot, row = file.robot, {name: values[0] for name, values in run.items()}
    sides, going = sides_table(robot, row), turn_words.has_motion(row)
    sections = []
    if sides.rows and history is not None:
        path = (np.asarray(history.reading[name])[0] for name in ("place_x", "place_y", "yaw"))
        sections.append(Section("From above", (catalogue.figure("turn.path", robot, row, *path),)))
    if history is not None:
        names = [f"motor_{what}_{side}" for what in ("current", "speed") for side in SIDES]
        shown = channels_named((*names, "yaw_rate"))
        rows = {c.column: np.asarray(history.reading[c.name])[0] / c.factor for c in shown}
        rows["time_s"] = np.asarray(history.time)[0]
        sections.append(Section("Over time", (catalogue.figure("turn.course", rows),)))
    elif turns is not None:
        sections.append(Section("Other turns", (catalogue.figure("turn.turns", turns, row),)))
    return Document(
        f"Turn of {run_headings(run)[0]}",
        turn_words.turn_answer(row, ended),
        (
            run_tables.note_on_robot(file, model),
            sides,
            *remarks([*(turn_words.turn_notes(robot, row) if going else []), *notes]),
        ),
        tuple(sections),
    )


def sides_table(robot: Robot, row: Columns) -> Table:
    """Table of both sides, without rows if no motion is known."""
    idle, yaw_known = capabilities.inapplicable_columns(robot), math.isfinite(float(row["yaw_rate_rad_s"]))
    rows = []
    for label, column, form in _ROWS if yaw_known else ():
        values = [float(row[column.format(side)]) for side in SIDES]
        if column.format(SIDES[0]) not in idle:
            rows.append((label, *(words.NONE_SETTLES if math.isinf(v) else format(v, form) for v in values)))
    return catalogue.table("turn.sides", rows)
