"""The report of `simulate`: each run's readings, its limits, its history from standstill, where its power goes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data.robot_file import RobotFile
from mmrjax.fidelities.base import Run
from mmrjax.model.channels import Channel
from mmrjax.model.quantities import MM, RPM, VOLTAGE
from mmrjax.model.robot import Robot
from sweeps import capabilities
from sweeps.pages import posture_words, power_figures, words
from sweeps.pages.history_figures import Start
from sweeps.pages.page import (
    Album,
    channel_columns,
    conditions_in_words,
    first_rows,
    printed_reading,
    render_page,
    robot_section,
    status_rows,
)
from sweeps.points.imposed import UNLIMITED
from sweeps.report.condition_columns import condition_formats
from sweeps.results.posture_results import Postures

#: What the table of runs shows beside conditions and channels: heading, factor, format.
FURTHER = {
    "slip": ("slip [%]", 100.0, "{:.1f}"), "adhesion_used": ("adhesion used", 1.0, "{:.2f}"),
    "power_supply_W": ("supply P_e [W]", 1.0, "{:.1f}"), "power_motor_W": ("motors N_d [W]", 1.0, "{:.1f}"),
    "power_gear_W": ("gearboxes N_r [W]", 1.0, "{:.1f}"), "power_ground_W": ("ground N_t [W]", 1.0, "{:.1f}"),
    "power_lift_W": ("lift [W]", 1.0, "{:.1f}"),
}  # fmt: skip
HISTORIES, CHAINS, GEARS = 4, 12, 2  # runs that a figure has room for


def write_runs_page(
    folder: Path,
    file: RobotFile,
    *,
    model: str,
    runs: dict[str, np.ndarray],
    histories: Run | None = None,
    stands: Postures | None = None,
) -> Path:
    """Write `report.html` and `figures/` for a few finished runs.

    Args:
        folder: an existing run folder.
        file: of the robot that was simulated.
        model: fidelity.
        runs: the finished table of runs.
        histories: the same as a batch with its history, of a fidelity that keeps it.
        stands: in which posture, where the runs state levers.

    Returns:
        The path of the page.
    """
    album, robot = Album(folder), file.robot
    names = run_headings(runs)
    known: dict[str, Any] = {"shown": 0, "ripple": [], "averaged": 0.0, "courses": [], "starts": [], "posture": None}
    if histories is not None:
        known |= _histories(album, robot, runs, names, histories)
    if stands is not None:
        from sweeps.pages import posture_figures

        known["posture"] = posture_words.posture_table(stands)
        album.add("posture", lambda: posture_figures.rest_and_step(stands))
        if len(names) == 1:
            album.add("steps", lambda: posture_figures.draw_highest_steps(stands.over))
    chain = np.flatnonzero(power_figures.drawable_runs(runs) & np.isin(runs["status"], words.SETTLED))[:CHAINS]
    if chain.size:
        picked = {key: value[chain] for key, value in runs.items()}
        album.add(
            "power", lambda: power_figures.draw_power_chain(picked, [names[k] for k in chain], robot.has_ground)
        )
    single = len(names) == 1
    shown = capabilities.without_idle(robot, runs)
    used = limits_used(robot, {key: value[0] for key, value in runs.items()}, known["starts"]) if single else []
    return render_page(
        folder,
        "runs.html.j2",
        album,
        of_channels=robot.channels,
        title=f"Run of {names[0]}" if single else f"{len(names)} runs",
        model=model,
        total=len(names),
        rows=[{"label": name, **row} for name, row in zip(names, first_rows(runs), strict=False)],
        statuses=status_rows(runs),
        limits=used,
        answer=runs_answer(runs, robot.channels, used),
        within=not any(limit["percent"] is not None and limit["percent"] > 100 for limit in used),
        chained=len(chain),
        most=CHAINS,
        columns=channel_columns(robot.channels),
        about=condition_formats(runs, mass=True),
        further={c: about for c, about in FURTHER.items() if c in shown},
        heat="winding_settled_C" in shown,
        has_ground=robot.has_ground,
        unknown=[] if robot.knows(VOLTAGE) else capabilities.unknown_numbers_sentence(robot),
        **known,
        **robot_section(file),
    )


def runs_answer(runs: dict[str, np.ndarray], channels: Sequence[Channel], used: Sequence[Mapping[str, Any]]) -> str:
    """One sentence: readings of a single run and its most used limit, or how many of several runs settle.

    Args:
        used: limits of a single run, as `limits_used` returns them.
    """
    settled = np.isin(runs["status"], words.SETTLED)
    if len(settled) > 1:
        over = int((settled & (runs["flags"] != "")).sum())
        beyond = f"{over} of them {'exceeds' if over == 1 else 'exceed'} a limit"
        rest = f"; {beyond if over else 'all within every limit'}" if settled.any() else ""
        return f"{settled.sum()} of {len(settled)} runs have an operating point{rest}."
    if not settled[0]:
        return f"No operating point: {words.status_meaning(str(runs['status'][0]))}."
    readings = ", ".join(f"{c.label} {printed_reading(runs[c.column][0], c.name)} {c.unit}" for c in channels)
    judged = [limit for limit in used if limit["percent"] is not None]
    readings = readings[0].upper() + readings[1:]
    if not judged:
        return f"{readings}."
    nearest = max(judged, key=lambda limit: limit["percent"])
    verb = "exceeds its limit" if nearest["percent"] > 100 else "is the nearest limit"
    return f"{readings}; {nearest['words']} {verb} ({nearest['percent']:.0f} % of {nearest['limit']})."


def run_headings(runs: dict[str, np.ndarray]) -> list[str]:
    """A heading for each run: its name where it has one, and its conditions."""
    found = [conditions_in_words(runs, k) for k in range(len(runs["status"]))]
    return [f"{runs['run_id'][k]}: {at}" for k, at in enumerate(found)] if "run_id" in runs else found


def _histories(
    album: Album, robot: Robot, runs: dict[str, np.ndarray], names: list[str], histories: Run
) -> dict[str, Any]:
    from sweeps.pages import history_figures

    which = [robot.configurations.index(str(c)) for c in runs["configuration"]]
    history, status = histories.history, np.asarray(histories.result.status)
    assert history is not None  # the fidelity was asked for it
    if not robot.has_ground:
        if not any(c.over_time for c in robot.channels):
            return {}
        shown = history_figures.members_as_read(robot.channels, history, status, names[:HISTORIES])
        album.add("courses", lambda: history_figures.over_time(shown))
        return {"shown": len(shown), "courses": shown, "starts": []}
    starts = history_figures.members_from_standstill(robot, history, status, which, names[:HISTORIES])
    album.add("history", lambda: history_figures.from_standstill(starts))
    album.add("slip", lambda: history_figures.slip_over_start(starts))
    known: dict[str, Any] = {"shown": len(starts), "starts": starts}
    if history.reactions is not None:
        from sweeps.pages import gear_figures

        known["averaged"] = 1e3 * float(history.time[0, 1] - history.time[0, 0])
        share = np.asarray(histories.columns["guide_share"])
        gears = gear_figures.members_with_gear(robot, history, status, share, which, names[:GEARS])
        # A ripple is of steady travel: the contacts have stopped sliding before the part that is looked at.
        ripples = [g for g, s in zip(gears, starts, strict=False) if s.gets_under_way and g.settled_since(s.slipping)]
        if ripples:
            known["ripple"] = album.add("ripple", lambda: gear_figures.current_ripple(ripples))
            album.add("reactions", lambda: gear_figures.draw_reactions(ripples))
            tracked = [g for g in ripples if g.on_tracks]
            if tracked:
                album.add(
                    "touchdown",
                    lambda: gear_figures.draw_touchdowns(tracked[0], f"{tracked[0].name}: touchdowns dotted"),
                )
    return known


def limits_used(robot: Robot, run: dict[str, Any], starts: Sequence[Start] = ()) -> list[dict[str, Any]]:
    """Use of each limit by a run: words, its value, the limit, and the share of it [%].

    A winding has the share of its permissible temperature rise. An inrush without a stated limit has no share.

    Args:
        starts: the same run from standstill, of a fidelity that has histories.
    """
    idle = capabilities.idle_columns(robot)
    radius = float(robot.configurations[str(run["configuration"])].radius)
    rpm = RPM
    shaft = float(run["theoretical_speed_mm_s"]) * MM / radius * float(robot.gearbox.ratio) / rpm
    turning = abs(shaft) > 1e-9
    torque = (
        float(run["power_gear_W"]) / (float(robot.sides) * shaft * rpm) * float(robot.gearbox.ratio)
        if turning
        else math.nan
    )
    cell = math.nan if "voltage_cell_V" in idle else float(run["voltage_cell_V"]) or math.nan  # 0: none feeds it
    gear = f"gearbox torque at {'the driving wheel' if robot.has_ground else 'its output'}"
    asked = [
        ("adhesion", math.nan if "adhesion_used" in idle else float(run["adhesion_used"]), 1.0, "{:.2f}", ""),
        ("motor speed", shaft, float(robot.motor.speed_limit) / rpm, "{:.0f}", " rpm"),
        ("gearbox input speed", shaft, float(robot.gearbox.speed_limit) / rpm, "{:.0f}", " rpm"),
        ("winding, long running", float(run["winding_settled_C"]), float(robot.motor.temperature_limit), "{:.0f}",
         " °C"),
        (gear, torque, robot.gearbox.torque_limit or math.nan, "{:.2f}", " N·m"),
        ("voltage of a cell, charged", cell, robot.battery.voltage_charge, "{:.2f}", " V"),
    ]  # fmt: skip
    ambient = float(robot.motor.temperature_ambient)
    found = [
        {"words": name, "value": words.NONE_SETTLES if math.isinf(value) else form.format(value) + unit,
         "limit": form.format(limit) + unit,
         "percent": warming_share(value, limit, ambient) if unit == " °C" else 100 * abs(value) / limit}
        for name, value, limit, form, unit in asked
        if not (math.isnan(value) or math.isnan(limit) or limit >= UNLIMITED)
    ]  # fmt: skip
    for start in starts[:1]:
        if start.time.size:
            most = inrush_limit(robot, math.isnan(float(run.get("supply_voltage_V", math.nan))))
            found.append({
                "words": "largest current of the start, all motors", "value": f"{abs(start.peak):.1f} A",
                "limit": "not stated" if most is None else f"{most:.1f} A",
                "percent": None if most is None else 100 * abs(start.peak) / most,
                "unstated": "driver.current_limit" + ", battery.current_limit" * bool(run.get("voltage_cell_V")),
            })  # fmt: skip
    return found


def warming_share(value: float, limit: float, ambient: float) -> float:
    """Share of what a winding may warm up by above the surroundings [%]."""
    return 100 * (value - ambient) / max(limit - ambient, 1.0)


def inrush_limit(robot: Robot, on_battery: bool) -> float | None:
    """Largest current of the driver, or of the battery less other consumers, for all motors [A]; None: not stated."""
    most, battery = float(robot.driver.current_limit), robot.battery
    stated = [float(robot.sides) * most] if most < float(type(robot.driver)().current_limit) else []
    if on_battery and battery.current_limit is not None:
        stated.append(battery.current_limit - float(battery.current_other))
    return min(stated, default=None)
