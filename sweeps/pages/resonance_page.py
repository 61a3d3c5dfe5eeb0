"""The report of a resonance map: which speeds to avoid, the figure, natural frequencies, every confirmed peak."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data.robot_file import RobotFile
from mmrjax.model.quantities import MM
from mmrjax.undercarriage.ripple_peaks import MATTERS, PERIODS, SIGNALS, TAIL, strongest_resonances
from sweeps.pages import resonance_figures, words
from sweeps.pages.page import Album, render_page, robot_section
from sweeps.results.resonance_results import ResonanceResult


def write_resonance_page(folder: Path, found: ResonanceResult, file: RobotFile) -> Path:
    """Write `report.html` and `figures/` of a map; returns the path of the page."""
    album = Album(folder)
    if found.read.any():
        album.add("map", partial(resonance_figures.resonance_map, found))
    return render_page(
        folder,
        "resonance.html.j2",
        album,
        title="Which speeds to avoid",
        found=found,
        modes=_modes(found),
        peaks=_peaks(found),
        points=_points(found),
        statuses=_statuses(found),
        periods=PERIODS,
        tail=100 * TAIL,
        matters=100 * MATTERS,
        **robot_section(file),
    )


def _modes(found: ResonanceResult) -> list[dict[str, Any]]:
    return [
        {
            "payload": f"{payload:g}",
            "name": m.name,
            "frequency": f"{m.frequency:.1f}",
            "range": f"{m.low:.1f} to {m.high:.1f}",
            "natural": f"{m.natural:.1f}",
            "damping": f"{m.damping:.2f}",
            "share": f"{100 * m.share:.0f}",
            "positions": f"{100 * m.positions:.0f}",
            "resonant": m.resonant,
        }
        for payload, modes in found.modes.items()
        for m in modes
    ]


def _peaks(found: ResonanceResult) -> list[dict[str, Any]]:
    strong = {(r.mode, r.order, r.signal) for r in strongest_resonances(found.resonances)}
    return [
        {
            "signal": SIGNALS[p.signal].label,
            "payload": f"{p.payload:g}",
            "speed": f"{p.speed / MM:.0f}",
            "range": f"{p.low / MM:.0f} to {p.high / MM:.0f}",
            "ripple": f"{100 * p.ripple:.3g}",
            "rise": f"{100 * p.rise:.2g}",
            "order": f"{p.order}" if p.order else "none",
            "frequency": f"{p.frequency:.1f}",
            "mode": p.mode or "none",
            "strong": (p.mode, p.order, p.signal) in strong,
        }
        for p in found.peaks
    ]


def _points(found: ResonanceResult) -> list[dict[str, Any]]:
    """Rows of Table 8."""
    table = found.table
    return [
        {
            "voltage": f"{table['supply_voltage_V'][k]:g}",
            "payload": f"{table['payload_kg'][k]:g}",
            "speed": table["speed_mean_mm_s"][k],
            "ripple": [table[f"{name}_ripple_percent"][k] for name in SIGNALS],
            "status": words.short_status(str(table["status"][k])),
            "to_avoid": found.to_avoid(k),
        }
        for k in np.flatnonzero(table["table8"])
    ]


def _statuses(found: ResonanceResult) -> list[dict[str, Any]]:
    return [
        {"name": name, "count": count, "meaning": words.status_meaning(name)}
        for name, count in found.statuses.items()
        if count
    ]
