"""The report of a resonance map: which speeds to avoid, the figure, natural frequencies, every confirmed peak."""

from __future__ import annotations

import numpy as np

from calibration.data.robot_file import RobotFile
from mmrjax.errors import count_noun
from mmrjax.model.quantities import MM
from mmrjax.undercarriage.ripple_peaks import MATTERS, PERIODS, SIGNALS, TAIL, strongest_resonances
from sweeps.pages import words
from sweeps.report import run_tables
from sweeps.report.document import Cell, Document, Note, Section, Table, columns, deferred_figure, remarks
from sweeps.results.resonance_results import SLOW, ResonanceResult

_MAP = (
    "**Above**: grey lines, frequency at which {} pass ({:.2f} mm of travel apart) and its harmonics; bands, natural "
    "frequencies of the robot on its contacts over payloads and positions of the belt (line: mean at the least "
    "payload; dashed: at the greatest). Every run is marked at its strongest frequency; a **star** is where ripple "
    "peaks over speed while its strongest line is in a band: a crossing that shows. **Below**: ripple of every run, "
    "standard deviation over mean; **boxes** are the speeds to avoid at that payload (dotted: a peak with no natural "
    "frequency to name), white circles the operating points of Table 8, dotted lines its voltages."
)
_MODES = (
    "Of half a robot rolling on its contacts, linearised about its balance at the middle voltage; over positions of "
    "the belt within a pitch. A mode has the name of the coordinate with most of its kinetic energy. Grey: too "
    "damped to amplify (ζ of 0.5 or more), there at few positions only, or different by an octave over positions, "
    "so that it has no one frequency."
)
_PEAKS = (
    "Every peak of settled runs. Order: which harmonic of the passing {} is strongest there. Marked: to be avoided "
    "(at least {:g} % of ripple, and at least half the rise of the signal's largest). A peak whose strongest line "
    "is in no mode's band names none: it may be the running gear's own, or a robot that rocks and jumps rather than "
    "swings. Crossings that no peak confirms are in `result.json`."
)
_ENDED = "Ripple is read in the last {:g} % of a run that begins rolling."
_FEW = "travels, but fewer than {} {} passed while ripple was read; take a longer --duration"
#: Most peaks that are shown unfolded.
UNFOLDED = 30


def resonance_document(found: ResonanceResult, file: RobotFile) -> Document:
    """The report of a map."""
    first, *others = found.sentences
    passing = found.passing
    lead = f"**{found.configuration}**, slope {found.slope_deg:g}°, {found.surface}; {found.read.size} runs."
    caption = _MAP.format(passing.name, 1000 * passing.travel)
    figure = deferred_figure("map", found.statement(), caption, "resonance_figures.resonance_map", found)
    endings = run_tables.endings_table(found.statuses, meanings={SLOW: _FEW.format(PERIODS, passing.name)})
    peaks, ended = _peaks(found), Note(_ENDED.format(100 * TAIL))
    folded = count_noun(len(peaks.rows), "peak") if len(peaks.rows) > UNFOLDED else ""
    return Document(
        "Which speeds to avoid",
        first,
        (
            run_tables.lead_note(file, "track", lead),
            *remarks(others),
            figure if found.read.any() else Note("No run travels, so there is nothing to draw."),
        ),
        (
            Section("Natural frequencies", (Note(_MODES), _modes(found)), "modes"),
            Section("Peaks of ripple over speed", (Note(_PEAKS.format(passing.name, 100 * MATTERS)),), "peaks"),
            Section("", (peaks,), folded=folded),
            Section("Operating points of Table 8", (_points(found),), "table8"),
            Section("How the runs ended", (ended, endings), "ended"),
        ),
    )


def _modes(found: ResonanceResult) -> Table:
    heads = columns(
        "payload [kg] | g", "mode", "damped [Hz] | .1f", "range [Hz] |", "~undamped [Hz] | .1f", "damping ζ | .2f",
        "~energy in its coordinate [%] | .0f", "~positions [%] | .0f",
    )  # fmt: skip
    rows = []
    for payload, modes in found.modes.items():
        for m in modes:
            low_high = f"{m.low:.1f} to {m.high:.1f}"
            numbers = (m.frequency, low_high, m.natural, m.damping, 100 * m.share, 100 * m.positions)
            rows.append((payload, m.name, *(Cell(x, "" if m.resonant else "none") for x in numbers)))
    return Table("frequencies", heads, rows, "natural frequencies")


def _peaks(found: ResonanceResult) -> Table:
    strong = {(r.mode, r.order, r.signal) for r in strongest_resonances(found.resonances)}
    heads = columns(
        "ripple of", "payload [kg] | g", "speed [mm/s] | .0f", "above 70 % of its rise |", "ripple [%] | .3g",
        "rise [%] | .2g", "order |", "strongest line [Hz] | .1f", "mode",
    )  # fmt: skip
    rows = [
        (
            Cell(SIGNALS[p.signal].label, "bad" if (p.mode, p.order, p.signal) in strong else ""), p.payload,
            p.speed / MM, f"{p.low / MM:.0f} to {p.high / MM:.0f}", 100 * p.ripple, 100 * p.rise, p.order or "none",
            p.frequency, p.mode or "none",
        )
        for p in found.peaks
    ]  # fmt: skip
    return Table("peaks_found", heads, rows, terminal=False)


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
    heads = columns("voltage [V] | g", "payload [kg] | g", "speed [mm/s] | .0f", *ripples, "status", "to avoid")
    return Table("points", heads, rows, terminal=False)
