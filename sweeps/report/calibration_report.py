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
    result: CalibrationResult, robot_name: str, voltage_fit: Feedforward | None = None
) -> Document:
    """Report of a calibration. `robot_name` is the name or the file of the robot."""
    in_units = Layout.of(result.robot).crosses_zero
    search = Note(
        as_paragraph([result.starts.statement()]), "" if result.converged else "warn", "search", terminal=True
    )
    rms = [fit_tables.rms_table(result.rms, result.channels)] if in_units else []
    answer = fit_words.calibration_answer(result)
    rows = result.rows()
    kinds = {"": "measured", "after_": "fitted"}
    return Document(
        f"Calibration of {words.displayed_robot_name(Path(robot_name).name)} to {Path(result.source).name}",
        answer,
        (
            Note(f"{result.adequacy.statement}.", "lead", "adequate", terminal=True),
            *([catalogue.figure("fit.overlay", rows, result.channels, LINES, finding=answer)] if result.axis else []),
            _parameters(result),
            _errors(result),
            *rms,
            search,
            *run_tables.curve_warning(result.robot),
            *remarks(result.notes),
            catalogue.note("calibration.free"),
        ),
        (
            *_over_rows(result),
            *([voltage_section(voltage_fit)] if voltage_fit is not None else []),
            *fit_tables.clusters_section(result.residual_clusters),
            Section("Noise", tuple(_noise(result))),
            fit_tables.rows_section(rows, result.channels, kinds, in_units),
        ),
        brief=fit_words.brief_calibration(result),
    )


def _parameters(result: CalibrationResult) -> Table:
    rows = []
    for name, parameter in result.parameters.items():
        limits = zip(("≤ ", "≥ "), parameter.interval_open, parameter.interval, strict=True)
        interval = " to ".join(f"{prefix * is_open}{value:.3g}" for prefix, is_open, value in limits)
        bound = f", {parameter.at_bound} bound" if parameter.at_bound else ""
        shift = fit_tables.shift_cell(parameter.shift)
        median = parameter.prior.median
        numbers = (parameter.value, parameter.sd, interval, parameter.unit, median, shift, parameter.variance_ratio)
        rows.append((f"`{name}`", *numbers, result.determined(name) + bound, parameter.meaning))
    title = f"{count_noun(len(result), 'row')}, {result.model}"
    return catalogue.table("calibration.parametertable", rows, title=title)


def _errors(result: CalibrationResult) -> Table:
    """rms errors before and after, and of held-out rows, each with its number of rows."""
    errors_by_fit = {"before": result.errors_before, "after": result.errors_after}
    errors_by_fit |= {
        f"after, held out by {blocks.kind_in_words(k)}": result.held_out[k].errors for k in result.held_out_alike
    }
    rows = [
        (
            fit, f"{max(e.rows for e in errors_by_channel.values())}/{len(result)}",
            *(e.rms_percent if e.rows else None for e in errors_by_channel.values()),
        )
        for fit, errors_by_channel in errors_by_fit.items()
    ]  # fmt: skip
    title = f"rms of simulated - measured [% of {OF_SIZE}]"
    return catalogue.table("calibration.errors", rows, *(f"{c.label} | .1f" for c in result.channels), title=title)


def _noise(result: CalibrationResult) -> Iterable[Block]:
    if result.tied:
        ties = (f"`{name}` = {ratio:.4g} x `{leader}`" for name, (leader, ratio) in result.tied.items())
        yield Note(f"Tied: {'; '.join(ties)}.")
    noises = {name: (noise.median_percent, noise.source) for name, noise in result.noise.items()}
    yield Note(fit_tables.noise_sentence(noises, result.channels))


def _over_rows(result: CalibrationResult) -> Iterable[Section]:
    """Sections: frequency response of a log, residuals over each condition."""
    table = result.rows()
    channels = result.channels
    table |= {f"simulated_{c.column}": table[f"after_{c.column}"] for c in channels}
    if result.axis:
        runs = Runs(result.source, table, layout=Layout.of(result.robot))
        for figure in fit_tables.frequency_response(runs, channels, LINES):
            yield Section("Frequency response", (figure,))
    residuals = catalogue.figure("calibration.residuals", table, channels)
    yield Section("Residuals against every condition", (residuals,))


def feedforward_document(fit: Feedforward) -> Document:
    """Constants, gains, remarks and the two figures."""
    units = constant_units(fit.unit)
    tolerances = fit.tolerances
    gains = [(*name.split("_"), x, units[name.split("_")[1]]) for name, x in fit.gains.items()]
    settings_sentence = (
        f"Gains for tolerances of {tolerances.position:g} {fit.unit}, {tolerances.velocity:g} {fit.unit}/s and "
        f"{tolerances.effort:g} V, a period of {1000 * tolerances.period:g} ms and a measurement delay of "
        f"{1000 * (tolerances.delay or 0):.3g} ms."
    )
    blocks: list[Block] = [_constants(fit), *remarks(sentences(fit.remarks))]
    if gains:
        blocks += [catalogue.table("feedforward.gains", gains), *remarks((settings_sentence,), "asked")]
    return Document(
        f"Feedforward of {'an' if fit.mechanism[0] in 'ae' else 'a'} {fit.mechanism} mechanism",
        fit_words.feedforward_statement(fit),
        tuple(blocks),
        (Section("Windows", _figures(fit)),),
    )


def voltage_section(fit: Feedforward) -> Section:
    """The two voltage plots of a log and the constants of their lines, for other reports."""
    return Section("Voltage against speed and acceleration", (*_figures(fit), _constants(fit)))


def _figures(fit: Feedforward) -> tuple[Figure, ...]:
    return tuple(catalogue.figure(f"feedforward.{name}", fit) for name in ("quasistatic", "dynamic"))


def _constants(fit: Feedforward) -> Table:
    units = constant_units(fit.unit)
    rows = [
        (name, value, interval_95(value, fit.sds[name])[1] - value, units[name])
        for name, value in fit.constants.items()
    ]
    return catalogue.table("feedforward.constants", rows)
