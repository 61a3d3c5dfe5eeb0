"""Reports of calibrations: adequacy, parameters, errors and their certainty, and feedforward constants."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from calibration.data.columns import Layout
from calibration.data.table import Runs
from calibration.described import as_paragraph, sentences
from calibration.inference import blocks
from calibration.inference.feedforward import Feedforward, constant_units, interval_95
from calibration.inference.result import CalibrationResult
from calibration.inference.simulation_errors import OF_SIZE
from calibration.words import fit_words
from mmrjax.errors import count_noun
from sweeps.pages import words
from sweeps.report import catalogue, fit_tables, run_tables
from sweeps.report.document import Block, Document, Figure, Note, Section, Table, remarks

#: Prefixes of simulated readings of a log, and their names.
LINES = {"after_": "calibrated", "before_": "before"}


def calibration_document(
    found: CalibrationResult, robot_name: str, voltage_fit: Feedforward | None = None
) -> Document:
    """Report of a calibration. `robot_name` is the name or the file of the robot."""
    sized = Layout.of(found.robot).crosses_zero
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
            catalogue.note("calibration.free"),
        ),
        (
            *_over_rows(found),
            *([voltage_section(voltage_fit)] if voltage_fit is not None else []),
            *fit_tables.clusters_section(found.residual_clusters),
            Section("Noise", tuple(_noise(found))),
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


def _noise(found: CalibrationResult) -> Iterable[Block]:
    if found.tied:
        ties = (f"`{name}` = {ratio:.4g} x `{leader}`" for name, (leader, ratio) in found.tied.items())
        yield Note(f"Tied: {'; '.join(ties)}.")
    noises = {name: (n.median_percent, n.source) for name, n in found.noise.items()}
    yield Note(fit_tables.noise_sentence(noises, found.channels))


def _over_rows(found: CalibrationResult) -> Iterable[Section]:
    """Sections: frequency response of a log, residuals over each condition."""
    table, panels = found.rows(), found.channels
    table |= {f"simulated_{c.column}": table[f"after_{c.column}"] for c in panels}
    if found.axis:
        runs = Runs(found.source, table, layout=Layout.of(found.robot))
        for figure in fit_tables.frequency_response(runs, panels, LINES):
            yield Section("Frequency response", (figure,))
    residuals = catalogue.figure("calibration.residuals", table, panels)
    yield Section("Residuals against every condition", (residuals,))


def feedforward_document(found: Feedforward) -> Document:
    """Constants, gains, remarks and the two figures."""
    units, t = constant_units(found.unit), found.tolerances
    gains = [(*name.split("_"), x, units[name.split("_")[1]]) for name, x in found.gains.items()]
    option_rows = (
        f"Gains for tolerances of {t.position:g} {found.unit}, {t.velocity:g} {found.unit}/s and {t.effort:g} V, a "
        f"period of {1000 * t.period:g} ms and a measurement delay of {1000 * (t.delay or 0):.3g} ms."
    )
    blocks: list[Block] = [_constants(found), *remarks(sentences(found.remarks))]
    if gains:
        blocks += [catalogue.table("feedforward.gains", gains), *remarks((option_rows,), "asked")]
    return Document(
        f"Feedforward of {'an' if found.mechanism[0] in 'ae' else 'a'} {found.mechanism} mechanism",
        fit_words.feedforward_statement(found),
        tuple(blocks),
        (Section("Windows", _figures(found)),),
    )


def voltage_section(found: Feedforward) -> Section:
    """The two voltage plots of a log and the constants of their lines, for other reports."""
    return Section("Voltage against speed and acceleration", (*_figures(found), _constants(found)))


def _figures(found: Feedforward) -> tuple[Figure, ...]:
    return tuple(catalogue.figure(f"feedforward.{name}", found) for name in ("quasistatic", "dynamic"))


def _constants(found: Feedforward) -> Table:
    units = constant_units(found.unit)
    rows = [(n, x, interval_95(x, found.sds[n])[1] - x, units[n]) for n, x in found.constants.items()]
    return catalogue.table("feedforward.constants", rows)
