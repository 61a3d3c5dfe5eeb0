"""Report of a calibration: adequacy, parameters, errors before and after, and their certainty."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from calibration.data.columns import Layout
from calibration.data.table import Runs
from calibration.described import as_paragraph
from calibration.inference import blocks
from calibration.inference.feedforward import Feedforward
from calibration.inference.result import METHOD, CalibrationResult
from calibration.inference.simulation_errors import OF_SIZE
from calibration.words import fit_words
from mmrjax.errors import count_noun
from sweeps.pages import words
from sweeps.report import catalogue, feedforward_report, fit_tables, run_tables
from sweeps.report.document import Block, Document, Note, Section, Table, remarks

#: Prefixes of simulated readings of a log, and their names.
LINES = {"after_": "calibrated", "before_": "before"}


def calibration_document(
    found: CalibrationResult, robot_name: str, voltage_fit: Feedforward | None = None
) -> Document:
    """Report of a calibration. `robot_name` is the name or the file of the robot."""
    sized = Layout.of(found.robot).crosses_zero
    chi, about = found.chi_square, found.identifiability
    estimated = "" if chi.tests_adequacy else catalogue.text("calibration.estimated")
    facts = catalogue.note(
        "calibration.facts", count_noun(len(found), "row"), found.model, len(found.parameters), METHOD, chi.value,
        chi.degrees_of_freedom, estimated, int(np.sum(about.singular_values > 1)), len(found.parameters), about.rank,
    )  # fmt: skip
    search = Note(
        as_paragraph([found.starts.statement()]), "" if found.converged else "warn", "search", terminal=True
    )
    rms = [fit_tables.rms_table(found.rms, found.channels)] if sized else []
    answer = fit_words.calibration_answer(found)
    table = found.rows()
    kinds = {"": "measured", "after_": "fitted"}
    return Document(
        f"Calibration of {words.displayed_robot_name(Path(robot_name).name)} to {Path(found.source).name}",
        answer,
        (
            Note(f"{found.adequacy.statement}.", "lead", "adequate", terminal=True),
            *([catalogue.figure("fit.overlay", table, found.channels, LINES, finding=answer)] if found.axis else []),
            _parameters(found),
            _errors(found),
            *rms,
            search,
            *run_tables.curve_warning(found.robot),
            *remarks(found.notes),
            facts,
            catalogue.note("calibration.free"),
        ),
        (
            *_over_rows(found, sized),
            *([feedforward_report.voltage_section(voltage_fit)] if voltage_fit is not None else []),
            *fit_tables.clusters_section(found.residual_clusters),
            Section("How sure", (*_shifts(found), *_certainty(found))),
            fit_tables.rows_section(table, found.channels, kinds, sized),
        ),
        brief=fit_words.brief_calibration(found),
    )


def _parameters(found: CalibrationResult) -> Table:
    rows = []
    for name, p in found.parameters.items():
        ends = zip(("≤ ", "≥ "), p.interval_open, p.interval, strict=True)
        interval = " to ".join(f"{sign * beyond}{value:.3g}" for sign, beyond, value in ends)
        bound = f", {p.at_bound} bound" if p.at_bound else ""
        shift, median = fit_tables.shift_cell(p.shift), p.prior.median
        numbers = (p.value, p.sd, interval, p.unit, median, shift, p.variance_ratio)
        rows.append((f"`{name}`", *numbers, found.determined(name) + bound, p.meaning))
    title = f"{count_noun(len(found), 'row')}, {found.model}"
    return catalogue.table("calibration.parametertable", rows, title=title)


def _errors(found: CalibrationResult) -> Table:
    """rms errors before and after, and of held-out rows, each with its number of rows."""
    lines = {"before": found.errors_before, "after": found.errors_after}
    lines |= {f"after, held out by {blocks.kind_in_words(k)}": found.held_out[k].errors for k in found.held_out_alike}
    rows = [
        (
            fit, f"{max(e.rows for e in by.values())}/{len(found)}",
            *(e.rms_percent if e.rows else None for e in by.values()),
        )
        for fit, by in lines.items()
    ]  # fmt: skip
    title = f"rms of simulated - measured [% of {OF_SIZE}]"
    return catalogue.table("calibration.errors", rows, *(f"{c.label} | .1f" for c in found.channels), title=title)


def _shifts(found: CalibrationResult) -> Iterable[Block]:
    if found.tied:
        ties = (f"`{name}` = {ratio:.4g} x `{leader}`" for name, (leader, ratio) in found.tied.items())
        yield Note(f"Tied: {'; '.join(ties)}.")
    noises = {name: (n.median_percent, n.source) for name, n in found.noise.items()}
    yield Note(fit_tables.noise_sentence(noises, found.channels))


def _over_rows(found: CalibrationResult, sized: bool) -> Iterable[Section]:
    """Sections: frequency response of a log, residuals over each condition."""
    table, panels = found.rows(), found.channels
    table |= {f"simulated_{c.column}": table[f"after_{c.column}"] for c in panels}
    if found.axis:
        runs = Runs(found.source, table, layout=Layout.of(found.robot))
        for figure in fit_tables.frequency_response(runs, panels, LINES):
            yield Section("Frequency response", (figure,))
    along = {found.axis: "time [s]"} if found.axis else {}
    figure = catalogue.figure("calibration.residuals", table, panels, along)
    yield Section("Residuals against every condition", (figure,))


def _certainty(found: CalibrationResult) -> Iterable[Block]:
    weak = [
        (value, " ".join(f"{x:+.2f} `{n}`" for n, x in parts.items()))
        for value, parts in found.identifiability.weak_directions()
    ]
    if weak:
        yield catalogue.note("calibration.weak-note")
        yield catalogue.table("calibration.weak", weak)
