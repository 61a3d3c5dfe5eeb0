"""The report of a sensitivity study: the answer first, then every output, interactions, convergence, next runs."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data.robot_file import RobotFile
from calibration.sensitivity.result import NEGLIGIBLE, OutputStudy, SensitivityResult, interactions
from calibration.words import sensitivity_words
from sweeps.pages import sensitivity_figures
from sweeps.pages.page import Album, printed_number, render_page, robot_section

#: Pairs of a table of interactions.
PAIRS = 5


def write_sensitivity_page(folder: Path, found: SensitivityResult, file: RobotFile) -> Path:
    """Write `report.html` and `figures/` of a finished study; returns the path of the page.

    Args:
        folder: an existing run folder.
        file: of the robot that was studied.
    """
    album = Album(folder)
    album.add("overview", partial(sensitivity_figures.draw_input_shares, found))
    sections = []
    for name, study in found.outputs.items():
        has_numbers = bool(study.studied.any()) and bool(np.isfinite(study.value).any()) and _decided(study)
        pairs = _pairs(study, found)
        if has_numbers:
            album.add(f"tornado_{name}", partial(sensitivity_figures.draw_tornado, study, found))
            album.add(f"indices_{name}", partial(sensitivity_figures.draw_indices, study, found))
        sections.append(
            {
                "name": name,
                "label": study.row.label,
                "drawn": has_numbers,
                "sentence": _sentence(study, found),
                "pairs": pairs,
                "second": study.second is not None,
            }
        )
    if any(study.convergence for study in found.outputs.values()):
        album.add("convergence", partial(sensitivity_figures.draw_convergence, found))
    if found.next_runs is not None:
        album.add("next_runs", partial(sensitivity_figures.next_runs, found.next_runs, found))
    return render_page(
        folder,
        "sensitivity.html.j2",
        album,
        title="Which parameters matter",
        found=found,
        method=sensitivity_words.METHODS[found.method],
        sections=sections,
        inputs=_inputs(found),
        runs=_next_runs(found),
        negligible=100 * NEGLIGIBLE,
        ranges=_ranges(found),
        bounds=_bounds(found),
        **robot_section(file),
    )


def _decided(study: OutputStudy) -> bool:
    """True if any input changes an output."""
    return bool(study.overall_share.max(initial=0.0) > 0)


def _sentence(study: OutputStudy, found: SensitivityResult) -> str:
    """Sentence on the inputs that decide an output, with its spread."""
    share, row = study.overall_share, study.row
    if not _decided(study):
        return "No number at any of these operating points, or nothing changes it."
    top = sensitivity_figures.leading_inputs(share, 3)
    who = ", ".join(f"{sensitivity_words.input_in_words(found, found.names[k])} {100 * share[k]:.0f} %" for k in top)
    value, sd = study.value / row.factor, study.sd / row.factor
    finite = np.isfinite(value) & np.isfinite(sd)
    unit = "" if row.unit_shown == "-" else f" {row.unit_shown}"
    digits = row.resolution
    low, high = value[finite].min(), value[finite].max()
    spans = f"from {low:.{digits}f} to {high:.{digits}f}{unit} over the operating points"
    spread = f"uncertain by ±{np.median(sd[finite]):.{digits}f}{unit} (one sd, median of the points)"
    return f"{who[0].upper()}{who[1:]}. It goes {spans}, and is {spread}."


def _pairs(study: OutputStudy, found: SensitivityResult) -> list[dict[str, str]]:
    """Interactions that are sure, the strongest first."""
    sure = [pair for pair in interactions(study, found.names) if pair.sure and pair.second >= NEGLIGIBLE / 2]
    return [
        {
            "pair": " with ".join(pair.pair),
            "value": f"{100 * pair.second:.1f} %",
            "interval": f"{100 * pair.interval[0]:.1f} to {100 * pair.interval[1]:.1f} %",
        }
        for pair in sure[:PAIRS]
    ]


def _inputs(found: SensitivityResult) -> list[dict[str, Any]]:
    """Every input with its distribution, the most important first."""
    importance = found.importance()
    rows = []
    for k in np.argsort(-importance, kind="stable"):
        name = found.names[k]
        x = found.inputs[name]
        rows.append(
            {
                "name": name,
                "meaning": x.meaning,
                "unit": x.unit,
                "distribution": x.distribution,
                "median": f"{x.median:.4g}",
                "interval": f"{x.interval[0]:.3g} to {x.interval[1]:.3g}",
                "share": f"{100 * importance[k]:.0f} %"
                if importance[k] >= NEGLIGIBLE
                else f"< {100 * NEGLIGIBLE:g} %",
                "idle": name in found.negligible,
                "inert": x.inert,
            }
        )
    return rows


def _next_runs(found: SensitivityResult) -> dict[str, Any] | None:
    n = found.next_runs
    if n is None:
        return None
    outputs = []
    for name, sds in n.output_sd.items():
        row = found.outputs[name].row
        if np.isfinite(sds).all() and sds[0] > 0:
            unit = "" if row.unit_shown == "-" else f" {row.unit_shown}"
            before, after = sds[0] / row.factor, sds[-1] / row.factor
            outputs.append(
                {"label": row.label, "before": f"±{_two(before)}{unit}", "after": f"±{_two(after)}{unit}",
                 "left": f"{100 * after / before:.0f} %"}
            )  # fmt: skip
    points = n.points
    return {
        "rows": [
            {
                "configuration": str(points.configuration[k]),
                "imposed": printed_number(points.imposed[1][k], "{:g}"),
                "payload": f"{points.payload[k]:g}", "slope": f"{points.slope_deg[k]:g}", "gain": f"{n.gain[k]:.1f}",
            }
            for k in range(len(points))
        ],
        "heading": "supply [V]" if points.motor_speed is None else "motor speed [rpm]",
        "has_ground": points.has_ground, "candidates": n.candidates, "source": n.source, "noise": n.noise,
        "outputs": outputs,
    }  # fmt: skip


def _two(sd: float) -> str:
    """Two digits of an sd, without an exponent."""
    return f"{sd:.{int(np.clip(1 - np.floor(np.log10(sd)), 0, 6))}f}"


def _ranges(found: SensitivityResult) -> str:
    """Values of the operating points at which any output was studied."""
    p = found.points.at(np.any([o.studied for o in found.outputs.values()], axis=0))
    parts = [", ".join(dict.fromkeys(map(str, p.configuration)))]
    _, own, symbol = p.imposed
    for _, x, unit in (("", own, f" {symbol}"), *p.ground):
        on_battery = unit == " V" and np.isnan(x).all()
        parts.append("battery" if on_battery else ", ".join(f"{v:g}" for v in np.unique(x)) + unit)
    return "; ".join(parts)


def _bounds(found: SensitivityResult) -> list[dict[str, str]]:
    """Bounds from derivatives compared with sampled indices, by output."""
    return [
        {
            "label": found.outputs[name].row.label,
            "upper": "yes" if c["upper_holds"] else "no",
            "lower": "yes" if c["lower_holds"] else "no",
            "excess": f"{100 * c['largest_excess']:.1f} %",
        }
        for name, c in found.comparison.items()
    ]
