"""The report of a calibration: adequate or not, its parameters, errors before and after, and their certainty."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from calibration.data.columns import Layout
from calibration.inference import blocks
from calibration.inference.identifiability import HELD
from calibration.inference.result import METHOD, CalibrationResult
from calibration.inference.simulation_errors import OF_SIZE
from calibration.words import fit_words
from mmrjax.errors import count_noun
from sweeps.pages import words
from sweeps.report import fit_tables, run_tables
from sweeps.report.document import Block, Document, Note, Section, Table, columns, deferred_figure, remarks

_PRIORS = (
    "**Shift from the prior.** Dot: the optimum; bar: 95 % interval; band: the prior's. Grey: not determined by "
    "these runs, the posterior sd is above {:g} of the prior's; a bar as wide as the band is a parameter of which "
    "these data say nothing."
)
_ERRORS = (
    "**rms errors, in percent of the {}.** Held out: each block's rows are predicted by a fit that has not seen the "
    "block. Rows that a robot does not reach have no error and are not counted; their number stands beside the bar."
)
_RESIDUALS = (
    "**Errors of the fit, in {}.** A trend along a condition is what the model lacks; no free parameter hides it."
)
_PROFILES = (
    "**Profile likelihood.** The objective refitted at each value of one parameter; below the line lies its 95 % "
    "interval (shaded)."
)
_CORRELATIONS = "**Posterior correlations, and singular values of the data's Jacobian in prior sds.**"
_PAIRS = (
    "**Posterior of the most correlated pairs of parameters.** The contours hold 68 % and 95 %; a narrow oblique one "
    "means that the data determine a combination better than either parameter."
)
_ESTIMATED = "; the noise was estimated from the misfit, so this tests nothing"


def calibration_document(found: CalibrationResult, robot_name: str) -> Document:
    """The report of a calibration of a robot of that name or file."""
    sized = Layout.of(found.robot).crosses_zero
    chi, about = found.chi_square, found.identifiability
    facts = (
        f"{count_noun(len(found), 'row')}, fidelity **{found.model}**, {len(found.parameters)} free parameters; "
        f"maximum a posteriori by {METHOD} with exact Jacobians. χ² {chi.value:.1f} on "
        f"{chi.degrees_of_freedom:.1f} degrees of freedom{'' if chi.tests_adequacy else _ESTIMATED}. The data say "
        f"more than the priors in {int(np.sum(about.singular_values > 1))} of {len(found.parameters)} directions "
        f"(numerical rank {about.rank})."
    )
    search = Note(f"{found.starts.statement()}.", "" if found.converged else "warn", "search", terminal=True)
    rms = [fit_tables.rms_table(found.rms, found.channels)] if sized else []
    before_after = deferred_figure(
        "before_after", fit_words.calibration_answer(found), _ERRORS.format(OF_SIZE),
        "calibration_figures.before_after", found,
    )  # fmt: skip
    table = found.rows()
    kinds = {"": "measured", "after_": "fitted"}
    return Document(
        f"Calibration of {words.words_shown(Path(robot_name).name)} to {Path(found.source).name}",
        fit_words.calibration_answer(found),
        (
            Note(f"{found.adequacy.statement}.", "lead", "adequate", terminal=True),
            _parameters(found),
            _errors(found),
            *rms,
            search,
            *run_tables.curve_warning(found.robot),
            *remarks(found.notes),
            Note(facts, "lead"),
        ),
        (
            Section("Parameters before and after", tuple(_shifts(found)), "parameters-section"),
            Section("Errors before and after, seen and unseen", (before_after,)),
            *_over_rows(found, sized),
            *fit_tables.clusters_section(found.residual_clusters),
            Section("How sure", tuple(_certainty(found))),
            fit_tables.rows_section(table, found.channels, kinds, sized),
        ),
    )


def _parameters(found: CalibrationResult) -> Table:
    heads = columns(
        "parameter", "value | .4g", "~sd | .2g", "95 % interval |", "~unit", "~prior median | .4g",
        "shift [σ] | +.1f", "~variance ratio | .2f", "determined", "~meaning",
    )  # fmt: skip
    rows = []
    for name, p in found.parameters.items():
        ends = zip(("≤ ", "≥ "), p.interval_open, p.interval, strict=True)
        interval = " to ".join(f"{sign * beyond}{value:.3g}" for sign, beyond, value in ends)
        bound = f", {p.at_bound} bound" if p.at_bound else ""
        shift, median = fit_tables.shift_cell(p.shift), p.prior.median
        numbers = (p.value, p.sd, interval, p.unit, median, shift, p.variance_ratio)
        rows.append((f"`{name}`", *numbers, found.determined(name) + bound, p.meaning))
    title = f"{count_noun(len(found), 'row')}, {found.model}"
    return Table("parametertable", heads, rows, title, wide=True)


def _errors(found: CalibrationResult) -> Table:
    """rms errors before, after, and of rows held out, with the number of rows that each reaches."""
    lines = {"before": found.errors_before, "after": found.errors_after}
    lines |= {f"after, held out by {blocks.kind_in_words(k)}": found.held_out[k].errors for k in found.held_out_alike}
    rows = [
        (
            which, f"{max(e.rows for e in by.values())}/{len(found)}",
            *(e.rms_percent if e.rows else None for e in by.values()),
        )
        for which, by in lines.items()
    ]  # fmt: skip
    heads = columns("", "rows |", *(f"{c.label} | .1f" for c in found.channels))
    return Table("errors", heads, rows, f"rms of simulated - measured [% of {OF_SIZE}]")


def _shifts(found: CalibrationResult) -> Iterable[Block]:
    caption, drawing = _PRIORS.format(HELD), "calibration_figures.draw_parameter_intervals"
    yield deferred_figure("parameters", "parameters against their priors", caption, drawing, found)
    if found.tied:
        yield Note(f"Tied: {'; '.join(f'`{n}` = {t.ratio:.4g} x `{t.leader}`' for n, t in found.tied.items())}.")
    yield Note(fit_tables.noise_sentence(found.noise, found.channels))


def _over_rows(found: CalibrationResult, sized: bool) -> Iterable[Section]:
    """Simulated readings over time, over the measured ones, and their errors over each condition."""
    table = found.rows()
    table |= {f"simulated_{c.column}": table[f"after_{c.column}"] for c in found.channels}
    answer, shown = fit_words.calibration_answer(found), found.channels
    if found.axis:
        lines = {"after_": "calibrated", "before_": "before"}
        yield Section("Histories", (fit_tables.overlay_figure("histories", answer, table, shown, lines),))
    parity = "**Fitted over measured.**" + ("" if sized else " Band: ±5 %.")
    unit = "the channel's unit; band: ±2 sd of the readings" if sized else f"percent of the {OF_SIZE}"
    along = {found.axis: "time [s]"} if found.axis else {}
    figures = (
        deferred_figure(
            "parity", "fitted over measured", parity, "comparison_figures.draw_parity", table, shown, band=not sized
        ),
        deferred_figure(
            "residuals", "residuals over every condition", _RESIDUALS.format(unit), "comparison_figures.errors_over",
            table, shown, sized, along,
        ),
    )  # fmt: skip
    yield from (Section(h, (f,)) for h, f in zip(("Parity", "Residuals over every condition"), figures, strict=True))


def _certainty(found: CalibrationResult) -> Iterable[Block]:
    drawn = {
        "profiles": (found.profiled, "profile likelihoods", _PROFILES, "draw_profile_likelihoods"),
        "correlations": (True, "correlation map and singular values", _CORRELATIONS, "draw_correlations"),
        "pairs": (len(found.posterior) > 1, "posterior of each two parameters", _PAIRS, "draw_correlated_pairs"),
    }
    for name, (wanted, alternative, caption, function) in drawn.items():
        if wanted:
            yield deferred_figure(name, alternative, caption, f"calibration_figures.{function}", found)
    weak = [
        (value, " ".join(f"{x:+.2f} `{n}`" for n, x in parts.items()))
        for value, parts in found.identifiability.weak_directions()
    ]
    if weak:
        yield Note("Directions of which the priors say more than the data (in prior sds):")
        yield Table("weak", columns("singular value | .2g", "combination"), weak, terminal=False)
