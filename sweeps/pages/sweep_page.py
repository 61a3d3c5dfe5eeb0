"""The report of a sweep: how its runs ended, which limits they exceed, and every channel over the grid."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data.robot_file import RobotFile
from mmrjax.errors import count_noun
from mmrjax.model.channels import Channel
from sweeps import capabilities
from sweeps.pages import sweep_figures, words
from sweeps.pages.page import Album, render_page, robot_section, status_rows

Table = dict[str, np.ndarray]
_AXES = {
    "configuration": ("configuration", ""),
    "supply_voltage_V": ("supply voltage", " V"),
    "motor_speed_rpm": ("motor speed", " rpm"),
    "payload_kg": ("payload", " kg"),
    "slope_deg": ("slope", "°"),
    "load_torque_Nm": ("load torque", " N·m"),
}


def write_sweep_page(folder: Path, file: RobotFile, *, model: str, runs: Table) -> Path:
    """Write `report.html` and `figures/` for a finished sweep.

    Args:
        folder: an existing run folder.
        file: of the robot that was simulated.
        model: fidelity.
        runs: the finished table of runs, any grid.

    Returns:
        The path of the page.
    """
    album, robot = Album(folder), file.robot
    for channel in robot.channels:
        album.add(f"sweep_{channel.name}", partial(sweep_figures.draw_sweep, runs, channel))
    return render_page(
        folder,
        "sweep.html.j2",
        album,
        of_channels=robot.channels,
        title=f"Sweep of {count_noun(len(runs['status']), 'run')}",
        model=model,
        answer=sweep_answer(runs),
        counts=sweep_counts(capabilities.without_idle(robot, runs), robot.channels),
        volts_drawn=_drawn(runs),
        **robot_section(file),
    )


def sweep_answer(runs: Table) -> str:
    """One sentence: runs that have an operating point, and how many of them stay within every limit."""
    total = len(runs["status"])
    settled = np.isin(runs["status"], words.SETTLED)
    over = settled & (runs["flags"] != "")
    verb = "has" if 1 in (total, settled.sum()) else "have"
    first = f"{settled.sum()} of {count_noun(total, 'run')} {verb} an operating point"
    if not over.any():
        return f"{first}; all within every limit." if settled.any() else f"{first}."
    raised = Counter(flag for flags in runs["flags"][over] for flag in str(flags).split(";"))
    most, times = raised.most_common(1)[0]
    return (
        f"{first}; {over.sum()} of them {'exceeds' if over.sum() == 1 else 'exceed'} a limit, most often: "
        f"{words.FLAGS.get(most, most)} ({count_noun(times, 'run')})."
    )


def sweep_counts(runs: Table, channels: Sequence[Channel]) -> dict[str, Any]:
    """Counts of a finished sweep per status and limit, its axes in words, and the extremes of the settled runs."""
    status = status_rows(runs)
    for s in status:
        s["over"] = int(((runs["status"] == s["name"]) & (runs["flags"] != "")).sum())
        s["where"] = "" if s["name"] in words.SETTLED else _where(runs, runs["status"] == s["name"])
    flags = []
    known, which = np.unique(runs["flags"], return_inverse=True)
    for flag, meaning in words.FLAGS.items():
        over = np.array([flag in str(f).split(";") for f in known])[which]
        if over.any():
            flags.append({"name": flag, "count": int(over.sum()), "meaning": meaning, "where": _where(runs, over)})
    return {
        "total": len(runs["status"]),
        "status": status,
        "flags": flags,
        "axes": [{"name": name, "values": _levels(runs[c], unit)} for c, (name, unit) in _axes(runs).items()],
        "extremes": _extremes(runs, channels),
    }


def _axes(runs: Table) -> dict[str, tuple[str, str]]:
    """The axes that runs have: on the battery no voltage."""
    return {
        c: known
        for c, known in _AXES.items()
        if c in runs
        and not (c == "motor_speed_rpm" and "supply_voltage_V" in runs)  # a reading then
        and (runs[c].dtype.kind not in "fiu" or not np.isnan(runs[c]).all())
    }


def _levels(values: np.ndarray, unit: str) -> str:
    levels = np.unique(values)
    if levels.dtype.kind not in "fiu":
        return ", ".join(dict.fromkeys(map(str, values)))
    if levels.size > 8:
        return f"{levels[0]:.3g} to {levels[-1]:.3g}{unit}, {levels.size} values"
    return ", ".join(f"{v:.4g}" for v in levels) + unit


def _where(runs: Table, pick: np.ndarray) -> str:
    """Ranges of slope and voltage of the picked runs, by configuration, in words."""
    parts = []
    for kind in dict.fromkeys(map(str, runs["configuration"])):
        mine = pick & (runs["configuration"] == kind)
        if mine.any():
            ranges = []
            axes = [c for c in ("slope_deg", sweep_figures.imposed_column(runs)) if c in runs]
            for column, unit in ((c, _AXES[c][1]) for c in axes):
                levels = np.unique(runs[column][mine])
                if np.isnan(levels).all():
                    continue
                if levels.size <= 4:
                    ranges.append(", ".join(f"{v:.4g}" for v in levels) + unit)
                else:
                    ranges.append(f"{levels[0]:.3g} to {levels[-1]:.3g}{unit}")
            parts.append(f"{kind}: {int(mine.sum())} at {' and '.join(ranges)}")
    return "; ".join(parts)


def _extremes(runs: Table, channels: Sequence[Channel]) -> list[dict[str, str]]:
    settled = np.nonzero(np.isin(runs["status"], words.SETTLED))[0]
    asked = [(f"largest {c.label}", c.column, f"{{:.{max(c.resolution - 1, 0)}f}} {c.unit}", 1.0)
             for c in channels]  # fmt: skip
    asked += [
        ("largest slip", "slip", "{:.1f} %", 100.0),
        ("hottest winding", "winding_settled_C", "{:.0f} °C", 1.0),
    ]
    answer = []
    for name, column, form, scale in asked:
        if column not in runs or np.isnan(runs[column][settled]).all():
            continue
        k = int(settled[np.nanargmax(np.abs(runs[column][settled]))])
        point = ", ".join(
            str(runs[c][k]) if not unit and runs[c].dtype.kind not in "fiu" else f"{runs[c][k]:.4g}{unit}"
            for c, (_, unit) in _axes(runs).items()
        )
        value = words.NONE_SETTLES if np.isinf(runs[column][k]) else form.format(scale * runs[column][k])
        answer.append({"words": name, "value": value, "at": point})
    return answer


def _drawn(runs: Table) -> str:
    if not sweep_figures.on_ground(runs):
        return ""
    imposed = sweep_figures.imposed_column(runs)
    shown = sweep_figures.panels_by_imposed(runs[imposed], imposed)
    if sum(int(mask.sum()) for _, mask in shown) == len(runs["status"]):
        return ""
    return (
        f"{', '.join(name for name, _ in shown)} of {np.unique(runs[imposed]).size} {sweep_figures.PLURAL[imposed]}"
    )
