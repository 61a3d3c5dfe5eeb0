"""The report of `simulate` over a profile: the mission over time, where its energy goes, its segments, its limits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from calibration.data.robot_file import RobotFile
from mmrjax.missions import mission_batch
from mmrjax.model.energy import SINKS
from mmrjax.model.quantities import WARMING
from mmrjax.model.robot import Robot
from mmrjax.model.signals import FLAGS
from sweeps import capabilities
from sweeps.pages import mission_figures, turn_page, words
from sweeps.pages.page import ROWS, Album, render_page, robot_section, status_rows
from sweeps.pages.runs_page import run_headings, warming_share
from sweeps.points.imposed import UNLIMITED
from sweeps.results.mission_results import Missions

#: Segments of a cycle that a page has room for.
SEGMENTS = 60


def write_mission_page(folder: Path, file: RobotFile, found: Missions) -> Path:
    """Write `report.html` and `figures/` for finished missions; in detail the first run.

    Args:
        folder: an existing run folder; file: of the robot that was simulated.

    Returns:
        The path of the page.
    """
    album = Album(folder)
    runs, source = found.table, found.source
    first, robot = {key: value[0] for key, value in runs.items()}, file.robot
    name = found.segments["run_id"][0]
    rows = {
        key: value[found.course["run_id"] == name]
        for key, value in capabilities.without_idle(robot, found.course).items()
    }
    idle = capabilities.idle_columns(robot)
    limit = float(robot.motor.temperature_limit)
    cycle = float(source.time[-1] - source.time[0]) if source.cycles > 1 else None
    on_battery = bool(np.isfinite(first["state_of_charge"]))
    album.add(
        "course", lambda: mission_figures.draw_mission_course(rows, cycle, limit, source.linear, float(robot.sides))
    )
    album.add("energy", lambda: mission_figures.draw_mission_energy(first, on_battery))
    if source.turns:
        x, y, yaw = rows["x_mm"] / 1e3, rows["y_mm"] / 1e3, np.radians(rows["yaw_deg"])
        album.add("path", lambda: turn_page.draw_path(robot, first, x, y, yaw))
        album.add("sides", lambda: mission_figures.of_sides(rows))
    names = _names(runs)
    return render_page(
        folder,
        "mission.html.j2",
        album,
        title=f"Mission {source.source}" + ("" if len(names) > 1 else f" of {names[0]}"),
        profile=source,
        total=len(names),
        first=names[0],
        run=first,
        on_battery=on_battery,
        answer=mission_answer(first),
        cards=_cards({key: value for key, value in first.items() if key not in idle}),
        limits=_limits(robot, first),
        flagged=_flags(first, found, name),
        rows=[
            {"label": label, **{k: v[i] for k, v in runs.items()}} for i, label in enumerate(names[:ROWS])
        ],
        statuses=status_rows(runs),
        segments=_segments(found, name),
        returned=max(float(first["energy_returned_Wh"]), 0.0),
        kept=len(rows["time_s"]),
        whole=found.whole,
        heat=robot.knows(WARMING),
        travels="distance_m" not in idle,
        turns=source.turns,
        **robot_section(file),
    )  # fmt: skip


def _names(runs: dict[str, np.ndarray]) -> list[str]:
    """Headings of runs; what the profile states in the place of a run's condition is left out."""
    answer = []
    for label in run_headings(runs):
        head, *parts = label.split(", ")
        answer.append(", ".join([head, *(p for p in parts if not p.startswith("nan"))]))
    return answer


def mission_answer(run: dict[str, Any]) -> str:
    """One sentence: energy of the mission, its largest shares, and how long the battery lasts."""
    drawn = float(run["energy_drawn_Wh"])
    text = f"The mission takes {float(run['energy_Wh']):.3g} Wh"
    if np.isfinite(run.get("distance_m", np.nan)) and run["distance_m"] > 0:
        text += f" over {run['distance_m']:.0f} m"
    if drawn > 0:
        shares = {mission_figures.label_of_sink(name): float(run[f"energy_to_{name}_Wh"]) / drawn for name in SINKS}
        largest = sorted(shares, key=lambda label: -shares[label])[:2]
        parts = [f"{label} {100 * shares[label]:.0f} %" for label in largest if shares[label] > 0]
        text += f" ({', '.join(parts)})"
    if np.isfinite(run["endurance_s"]):
        text += f"; a full battery lasts {run['endurance_s'] / 60:.0f} min"
    status = str(run["status"])
    return text + ("." if status == "converged" else f". It ends early: {words.status_meaning(status)}.")


def _cards(run: dict[str, Any]) -> list[dict[str, str]]:
    """Key figures of a mission, in large print."""
    about = {output.column: output for output in mission_batch.OUTPUTS}
    shown = ("energy_Wh", "energy_per_metre_Wh", "distance_m", "peak_current_A", "winding_peak_C", "state_of_charge")
    cards = []
    for column in shown:
        output, value = about[column], float(run.get(column, np.nan))
        if not np.isfinite(value):
            continue
        text = f"{100 * value:.1f} %" if output.unit == "-" else f"{value:.4g} {output.unit}"
        cards.append({"value": text, "label": output.label})
    if np.isfinite(run["endurance_s"]):
        label = "endurance at this duty" + (f", {run['range_m']:.0f} m" if "range_m" in run else "")
        cards.append({"value": f"{run['endurance_s'] / 60:.0f} min", "label": label})
    return cards


#: Limits that rest on how heat leaves the windings.
OF_HEAT = ("hottest winding", "rms current, one motor")


def _limits(robot: Robot, run: dict[str, Any]) -> list[dict[str, Any]]:
    """Use of each limit by the mission: words, its value, the limit, and the share of it [%]."""
    rpm, motor, gearbox, battery = np.pi / 30, robot.motor, robot.gearbox, robot.battery
    heat = robot.knows(WARMING)
    asked = [
        (OF_HEAT[0], run["winding_peak_C"], float(motor.temperature_limit), "°C", 0),
        ("motor speed", run["peak_motor_speed_rpm"], float(motor.speed_limit) / rpm, "rpm", 0),
        ("gearbox input speed", run["peak_motor_speed_rpm"], float(gearbox.speed_limit) / rpm, "rpm", 0),
        (OF_HEAT[1], run["rms_current_A"] / float(robot.sides), float(robot.current_continuous), "A",
         2),
    ]  # fmt: skip
    if gearbox.torque_limit is not None:
        asked.append(("rms torque, one gearbox", run["rms_torque_Nm"], float(gearbox.torque_limit), "N·m", 2))
    answer = [
        {"words": words, "value": f"{value:.{digits}f} {unit}", "limit": f"{limit:.{digits}f} {unit}",
         "percent": (warming_share(value, limit, float(motor.temperature_ambient)) if unit == "°C"
                     else 100 * value / limit)}
        for words, value, limit, unit, digits in asked
        if np.isfinite(value) and limit < UNLIMITED and (words not in OF_HEAT or heat)
    ]  # fmt: skip
    low, cutoff = float(run["cell_low_V"]), float(battery.voltage_cutoff)
    if np.isfinite(low):
        answer.append(
            {"words": "lowest cell (not below)", "value": f"{low:.2f} V", "limit": f"{cutoff:.2f} V",
             "percent": 100 * cutoff / low}
        )  # fmt: skip
    return answer


def _flags(run: dict[str, Any], found: Missions, name: str) -> list[dict[str, Any]]:
    """Limits that were exceeded, in words, and in how many segments."""
    raising = [str(f).split(";") for f in found.segments["flags"][found.segments["run_id"] == name]]
    raised = str(run["flags"]).split(";")
    return [
        {"name": flag, "words": words.FLAGS[flag], "segments": sum(flag in f for f in raising), "of": len(raising)}
        for flag in FLAGS
        if flag in raised
    ]


def _segments(found: Missions, name: str) -> list[dict[str, Any]]:
    """Segments of one run: the first cycle and totals over all cycles."""
    source = found.source
    rows = {key: value[found.segments["run_id"] == name] for key, value in found.segments.items()}
    whole = float(np.sum(rows["energy_Wh"]))
    answer = []
    for k in range(min(source.segments, SEGMENTS)):
        mine = {key: value[rows["segment"] == k + 1] for key, value in rows.items()}
        if not len(mine["status"]):
            continue
        energy = float(np.sum(mine["energy_Wh"]))
        ends = {s: int((mine["status"] == s).sum()) for s in dict.fromkeys(map(str, mine["status"]))}
        flags = dict.fromkeys(flag for f in mine["flags"] for flag in str(f).split(";") if flag)
        answer.append(
            {
                "number": k + 1,
                "begin": float(source.time[k] - source.time[0]),
                "end": float(source.time[k + 1] - source.time[0]),
                "mode": source.modes[k],
                "demand": _demand(found, k),
                "first": {key: value[0] for key, value in mine.items()},
                "count": len(mine["status"]),
                "energy": energy,
                "percent": 100 * energy / whole if whole > 0 else float("nan"),
                "distance": float(np.sum(mine["distance_m"])),
                "peak": float(np.max(mine["peak_current_A"])),
                "hottest": float(np.max(mine["winding_peak_C"])),
                "ends": ", ".join(
                    words.short_status(s) + (f" ({n})" if source.cycles > 1 else "") for s, n in ends.items()
                ),
                "flags": ", ".join(words.FLAGS[f] for f in flags),
            }
        )
    return answer


def _demand(found: Missions, k: int) -> str:
    """Demand of the profile in a segment, in words."""
    source = found.source
    last = k + 1 if source.linear else k

    def span(values: np.ndarray, factor: float, unit: str) -> str:
        begin, end = float(values[k]) / factor, float(values[last]) / factor
        unit = unit if unit == "°" else f"\u00a0{unit}"
        return f"{begin:g}{unit}" if abs(begin - end) < 1e-9 else f"{begin:g} to {end:g}{unit}"

    from calibration.data.profiles import CONTROLLED, YAW_RATE
    from mmrjax.missions.profile import PAIRS
    from mmrjax.model import channels

    mode = source.modes[k]
    said = []
    if mode in CONTROLLED:
        channel = channels.find_channel(mode)
        said.append(span(source.demand, channel.factor, channel.unit))
        if mode == "speed" and YAW_RATE in source.values:
            said.append(span(source.values[YAW_RATE], 1.0, channels.find_channel(YAW_RATE).unit))
    elif mode == "voltage":
        shares = [(name, 0.01, "% duty") for name in ("duty", *PAIRS[0])] + [(name, 1.0, "V") for name in PAIRS[1]]
        spans = [span(source.values[name], one, unit) for name, one, unit in shares if name in source.values]
        said.append(" and ".join(spans) or "100 % duty")
    units = {"voltage": "V", "slope_deg": "°", "payload": "kg", "load_torque": "N·m", "current_other": "A"}
    said += [span(source.values[name], 1.0, unit) for name, unit in units.items() if name in source.values]
    return ", ".join([*said, *([source.surface[k]] if source.surface else [])])
