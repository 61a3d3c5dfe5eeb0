"""Tables of the report: counts and limits of a sweep, errors against the bench, the paper row by row."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from calibration.data import runs as records
from calibration.inference import errors as residual
from mmrjax import params
from mmrjax.tables import CONFIGURATIONS
from sweeps import figures_data as data

if TYPE_CHECKING:
    from mmrjax.robot import Robot

#: What each status means to a person who reads the report.
STATUS_MEANING = {
    "converged": "found a steady operating point",
    "stalled": "the motors cannot turn against the load: shafts at rest at stall current",
    "slides": "slope and rolling resistance demand more traction than adhesion gives (demand above μ_s N), so the "
    "movers spin and the robot does not climb; an operating point does not exist",
    "not_settled": "still gaining speed when the simulated time ended",
    "tips": "the line of gravity passes outside the contacts: the robot turns over",
    "battery_empty": "the battery's capacity is used up",
    "failed": "the solver found no answer; please report the conditions",
}
FLAG_MEANING = {
    "motor_overspeed": "motor faster than its permissible 12 000 rpm",
    "gearbox_overspeed": "gearbox input faster than the catalogue's 8000 rpm",
    "winding_hot": "winding above 125 °C after long running at this current",
}
_FORMATS = ("{:.2f}", "{:.0f}", "{:.0f}")


def counts(runs: data.Columns) -> dict[str, Any]:
    """Counts of a finished sweep per status and limit, its axes in words, and the extremes of the settled runs."""
    total = len(runs["status"])
    status = [
        {"name": s, "count": n, "percent": 100 * n / total, "meaning": STATUS_MEANING.get(s, "")}
        | {"where": _where(runs, runs["status"] == s) if s != "converged" else ""}
        for s in (*STATUS_MEANING, *(set(runs["status"]) - set(STATUS_MEANING)))
        if (n := int((runs["status"] == s).sum()))
    ]
    flags = []
    for flag, meaning in FLAG_MEANING.items():
        over = np.array([flag in str(f).split(";") for f in runs["flags"]])
        if over.any():
            flags.append({"name": flag, "count": int(over.sum()), "meaning": meaning, "where": _where(runs, over)})
    settled = runs["status"] == "converged"
    return {
        "total": total,
        "status": status,
        "flags": flags,
        "axes": _axes(runs),
        "extremes": _extremes(runs, np.nonzero(settled)[0]),
    }


def _axes(runs: data.Columns) -> list[dict[str, str]]:
    names = (
        ("configuration", "configuration", ""),
        ("supply_voltage_V", "supply voltage", " V"),
        ("payload_kg", "payload", " kg"),
        ("slope_deg", "slope", "°"),
    )
    return [{"name": words, "values": _levels(runs[column], unit)} for column, words, unit in names]


def _levels(values: np.ndarray, unit: str) -> str:
    levels = np.unique(values)
    if levels.dtype.kind not in "fiu":
        return ", ".join(map(str, levels))
    if levels.size > 8:
        return f"{levels[0]:.3g} to {levels[-1]:.3g}{unit}, {levels.size} values"
    return ", ".join(f"{v:.4g}" for v in levels) + unit


def _where(runs: data.Columns, pick: np.ndarray) -> str:
    """Where in the sweep the picked runs lie, by configuration: the ranges of slope and voltage."""
    parts = []
    for kind in CONFIGURATIONS:
        mine = pick & (runs["configuration"] == kind)
        if mine.any():
            ranges = []
            for column, unit in (("slope_deg", "°"), ("supply_voltage_V", " V")):
                levels = np.unique(runs[column][mine])
                if levels.size <= 4:
                    ranges.append(", ".join(f"{v:.4g}" for v in levels) + unit)
                else:
                    ranges.append(f"{levels[0]:.3g} to {levels[-1]:.3g}{unit}")
            parts.append(f"{kind}: {int(mine.sum())} at {' and '.join(ranges)}")
    return "; ".join(parts)


def _extremes(runs: data.Columns, settled: np.ndarray) -> list[dict[str, str]]:
    if not settled.size:
        return []
    asked = (
        ("largest total current", "total_current_A", np.nanargmax, "{:.2f} A", 1),
        ("fastest", "speed_mm_s", np.nanargmax, "{:.0f} mm/s", 1),
        ("largest slip", "slip", np.nanargmax, "{:.1f} %", 100),
        ("hottest winding", "temperature_winding_C", np.nanargmax, "{:.0f} °C", 1),
    )
    answer = []
    for words, column, choose, form, scale in asked:
        if column not in runs or not np.isfinite(runs[column][settled]).any():
            continue
        k = int(settled[choose(runs[column][settled])])
        point = (
            f"{runs['configuration'][k]}, {runs['supply_voltage_V'][k]:.4g} V, {runs['payload_kg'][k]:.3g} kg, "
            f"{runs['slope_deg'][k]:.3g}°"
        )
        answer.append({"words": words, "value": form.format(scale * runs[column][k]), "at": point})
    return answer


def errors(variants: dict[str, np.ndarray], rows: data.Rows) -> list[dict[str, Any]]:
    """Rms and worst error (35) of each variant (name → errors of shape (20, 3)), all rows and by configuration."""
    kind = rows.conditions["configuration"]
    answer = []
    for name, values in variants.items():
        for group in ("all", *CONFIGURATIONS):
            pick = np.ones(len(kind), bool) if group == "all" else kind == group
            cells = [residual.summary(values[pick, k]) for k in range(3)]
            answer.append(
                {"variant": name, "group": group, "rows": cells[0]["rows"], "of": int(pick.sum()), "cells": cells}
            )
    return answer


def implied_resistance(robot: Robot, table: records.Runs) -> np.ndarray:
    """Resistance [Ω] in series with each motor that current and speed of each row imply by (15)."""
    current, speed, _ = table.measured().T
    back = np.asarray(robot.motor.voltage_back(speed))
    return robot.sides * (table["supply_voltage_V"] - back) / current


def row_by_row(nominal: Robot, rows: data.Rows) -> list[dict[str, Any]]:
    """The 20 rows: bench, the paper's simulation, the nominal robot three ways, and letters that say why."""
    table = rows.conditions
    own, raised, weighed = (data.stacked(t) for t in (rows.plain, rows.raised, rows.weighed))
    resistance = implied_resistance(nominal, records.read("simulated_by_paper"))
    limit = float(nominal.motor.resistance)
    answer = []
    for k in range(len(table)):
        wheeled = table["configuration"][k] == CONFIGURATIONS[1]
        reasons = []
        if rows.plain["status"][k] == "slides":
            reasons.append("A")
        if wheeled and abs(rows.weighed["total_mass_kg"][k] - table["total_mass_kg"][k]) > 0.05:
            reasons.append("M")
        if wheeled and abs(weighed[k, 0] - rows.paper[k, 0]) > 0.03 * rows.paper[k, 0]:
            reasons.append("W")
        if not wheeled and abs(raised[k, 0] - rows.paper[k, 0]) > 0.01 * rows.paper[k, 0]:
            reasons.append("G")
        if resistance[k] > 1.1 * limit:
            reasons.append("E")
        if raised[k, 1] > 1.03 * rows.measured[k, 1]:
            reasons.append("B")
        following = (table["slope_deg"] == table["slope_deg"][k] + 5) & _same_mode(table, k)
        if following.any() and rows.paper[following, 1][0] > rows.paper[k, 1]:
            reasons.append("N")
        creep = rows.raised["theoretical_speed_mm_s"][k] * rows.raised["slip"][k]
        radius = float(nominal.chassis(float(wheeled)).radius) / float(nominal.gearbox.ratio)
        creep_paper = rows.paper[k, 1] * records.RPM * radius / records.MM - rows.paper[k, 2]
        if creep_paper > 1.5 * creep + 2:
            reasons.append("S")
        answer.append(
            {
                "configuration": table["configuration"][k],
                "voltage": table["supply_voltage_V"][k],
                "mass": table["total_mass_kg"][k],
                "own_mass": float(rows.weighed["total_mass_kg"][k]),
                "slope": table["slope_deg"][k],
                "status": str(rows.plain["status"][k]),
                "reasons": reasons,
                "channels": [
                    _cells(form, rows.measured[k, c], rows.paper[k, c], own[k, c], raised[k, c], weighed[k, c])
                    for c, form in enumerate(_FORMATS)
                ],
            }
        )
    return answer


def _same_mode(table: records.Runs, k: int) -> np.ndarray:
    return (table["configuration"] == table["configuration"][k]) & (
        table["supply_voltage_V"] == table["supply_voltage_V"][k]
    )


def _cells(form: str, measured: float, paper: float, own: float, raised: float, weighed: float) -> dict[str, Any]:
    """Texts of one channel in a row; differences by (35) of the nominal (raised, own mass) from paper and bench."""
    return {
        "measured": form.format(measured),
        "paper": form.format(paper),
        "own": form.format(own) if np.isfinite(own) else "slides",
        "raised": form.format(raised) if np.isfinite(raised) else "no number",
        "weighed": form.format(weighed) if np.isfinite(weighed) else "no number",
        "to_paper": float(residual.relative_error(np.array(raised), np.array(paper))),
        "to_paper_weighed": float(residual.relative_error(np.array(weighed), np.array(paper))),
        "to_measured": float(residual.relative_error(np.array(raised), np.array(measured))),
        "to_measured_weighed": float(residual.relative_error(np.array(weighed), np.array(measured))),
    }


def facts(nominal: Robot, rows: data.Rows) -> dict[str, Any]:
    """The numbers behind the letters of `row_by_row`, for the page to put into words."""
    measured = rows.conditions
    of_paper = implied_resistance(nominal, records.read("simulated_by_paper"))
    tracked = measured["configuration"] == CONFIGURATIONS[0]
    slow, slope = measured["supply_voltage_V"] == 15.0, measured["slope_deg"]
    used = rows.plain["adhesion_used"]
    extra = rows.weighed["total_current_A"] - rows.paper[:, 0]
    gap = 100 * (rows.raised["total_current_A"] - rows.paper[:, 0])[tracked] / rows.paper[tracked, 0]

    def span(values: np.ndarray) -> tuple[float, float]:
        return float(values.min()), float(values.max())

    return {
        "adhesion": (
            float(nominal.configurations["6T2A"].ground.friction.static),
            float(nominal.configurations["4W2T"].ground.friction.static),
        ),
        "used_tracked_15": float(used[tracked & (slope == 15)][0]),
        "used_tracked_20": float(used[tracked & (slope == 20)][0]),
        "used_wheeled_20": float(used[~tracked & (slope == 20)][0]),
        "extra_slow": span(extra[~tracked & slow]),
        "extra_fast": span(extra[~tracked & ~slow]),
        "extra_flat": span(extra[~tracked & (slope == 0)]),
        "guide_share": float(nominal.configurations["6T2A"].track.guide_share),
        "gap": span(gap),
        "resistance": float(nominal.motor.resistance),
        "paper_slow": span(of_paper[tracked & slow]),
        "paper_fast": span(of_paper[tracked & ~slow]),
        "paper_wheeled": float(np.median(of_paper[~tracked])),
        "bench": float(np.median(implied_resistance(nominal, measured))),
    }


def changed_parameters(robot: Robot, nominal: Robot) -> list[dict[str, str]]:
    """Every parameter of `robot` that is not the nominal robot's, with both values."""
    base = {p.name: float(p.value) for p in params.walk(nominal)}
    answer = []
    for p in params.walk(robot):
        value = float(p.value)
        if p.name not in base or not np.isclose(value, base[p.name], rtol=1e-9, atol=0.0):
            before = f"{base[p.name]:.6g}" if p.name in base else "not in the paper's model"
            answer.append(
                {"name": p.name, "meaning": p.spec.meaning, "unit": p.spec.unit, "value": f"{value:.6g}"}
                | {"nominal": before}
            )
    return answer
