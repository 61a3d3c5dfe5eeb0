"""The report of a resonance map: which speeds to avoid, the figure, natural frequencies, every confirmed peak."""

from __future__ import annotations

import numpy as np

from calibration.data.robot_file import RobotFile
from mmrjax.errors import count_noun
from mmrjax.model.quantities import MM
from mmrjax.undercarriage.ripple_peaks import MATTERS, PERIODS, SIGNALS, TAIL, strongest_resonances
from sweeps.pages import words
from sweeps.report import catalogue, run_tables
from sweeps.report.document import Cell, Document, Section, Table, remarks
from sweeps.results.resonance_results import SLOW, ResonanceResult

_FEW = "travels, but fewer than {} {} passed while ripple was read; take a longer --duration"
#: Most peaks that are shown unfolded.
UNFOLDED = 30


def resonance_document(found: ResonanceResult, file: RobotFile) -> Document:
    """The report of a map."""
    first, *others = found.sentences
    passing = found.passing
    lead = f"**{found.configuration}**, slope {found.slope_deg:g}°, {found.surface}; {found.read.size} runs."
    values = passing.name, 1000 * passing.travel
    figure = catalogue.figure("resonance.map", found, finding=found.statement(), words=values)
    endings = run_tables.endings_table(found.statuses, meanings={SLOW: _FEW.format(PERIODS, passing.name)})
    peaks, ended = _peaks(found), catalogue.note("resonance.ended", 100 * TAIL)
    folded = count_noun(len(peaks.rows), "peak") if len(peaks.rows) > UNFOLDED else ""
    return Document(
        "Which speeds to avoid",
        first,
        (
            run_tables.lead_note(file, "track", lead),
            *remarks(others),
            figure if found.read.any() else catalogue.note("resonance.still"),
        ),
        (
            Section("Natural frequencies", (catalogue.note("resonance.modes"), _modes(found)), "modes"),
            Section(
                "Peaks of ripple over speed",
                (catalogue.note("resonance.peaks", passing.name, 100 * MATTERS),),
                "peaks",
            ),
            Section("", (peaks,), folded=folded),
            Section("Operating points of Table 8", (_points(found),), "table8"),
            Section("How the runs ended", (ended, endings), "ended"),
        ),
    )


def _modes(found: ResonanceResult) -> Table:
    rows = []
    for payload, modes in found.modes.items():
        for m in modes:
            low_high = f"{m.low:.1f} to {m.high:.1f}"
            numbers = (m.frequency, low_high, m.natural, m.damping, 100 * m.share, 100 * m.positions)
            rows.append((payload, m.name, *(Cell(x, "" if m.resonant else "none") for x in numbers)))
    return catalogue.table("resonance.frequencies", rows)


def _peaks(found: ResonanceResult) -> Table:
    strong = {(r.mode, r.order, r.signal) for r in strongest_resonances(found.resonances)}
    rows = [
        (
            Cell(SIGNALS[p.signal].label, "bad" if (p.mode, p.order, p.signal) in strong else ""), p.payload,
            p.speed / MM, f"{p.low / MM:.0f} to {p.high / MM:.0f}", 100 * p.ripple, 100 * p.rise, p.order or "none",
            p.frequency, p.mode or "none",
        )
        for p in found.peaks
    ]  # fmt: skip
    return catalogue.table("resonance.peaks_found", rows)


def _points(found: ResonanceResult) -> Table:
    """Operating points of Table 8."""
    table = found.table
    rows = [
        (
            table["supply_voltage_V"][k], table["payload_kg"][k], table["speed_mean_mm_s"][k],
            *(table[f"{name}_ripple_percent"][k] for name in SIGNALS), words.short_status(str(table["status"][k])),
            found.to_avoid(k),
        )
        for k in np.flatnonzero(table["table8"])
    ]  # fmt: skip
    ripples = (f"ripple > {signal.label} [%] | .3g" for signal in SIGNALS.values())
    return catalogue.table("resonance.points", rows, *ripples)
