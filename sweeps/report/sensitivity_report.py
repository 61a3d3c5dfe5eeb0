"""Report of a sensitivity study: the answer, then each output and the inputs."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from calibration.data.robot_file import RobotFile
from calibration.sensitivity.result import NEGLIGIBLE, OutputStudy, SensitivityResult
from calibration.words import sensitivity_words
from sweeps.pages.words import short_name
from sweeps.report import catalogue, run_tables
from sweeps.report.document import Document, Section, Table, remarks

#: Most pairs in a table of interactions, and most outputs that are not folded.
PAIRS, UNFOLDED = 5, 3
#: Measure of the shares of the overview, by method.
_SHARE_MEASURES = {"local": " to first order", "morris": ", by squared effects"}


def sensitivity_document(result: SensitivityResult, file: RobotFile) -> Document:
    """Report of a finished study."""
    method = f"Method: {sensitivity_words.METHODS[result.method]} (`{result.method}`)"
    effort = f", {result.evaluations:,} model evaluations in {result.seconds:.1f} s." if result.evaluations else "."
    points = result.points.at(np.any([o.studied for o in result.outputs.values()], axis=0))
    parts = [", ".join(dict.fromkeys(map(str, points.configuration)))]
    _, imposed_values, imposed_unit = points.imposed
    for _, x, unit in (("", imposed_values, f" {imposed_unit}"), *points.ground):
        on_battery = unit == " V" and np.isnan(x).all()
        parts.append("battery" if on_battery else ", ".join(f"{v:g}" for v in np.unique(x)) + unit)
    overview = catalogue.figure(
        "sensitivity.overview", result,
        words=(_SHARE_MEASURES.get(result.method, ""), "; ".join(parts), 100 * NEGLIGIBLE),
        more=catalogue.text("sensitivity.sobol") if result.method == "sobol" else "",
    )  # fmt: skip
    negligible_remark = [f"less than {100 * NEGLIGIBLE:g} % everywhere: {', '.join(result.negligible)}"] * bool(
        result.negligible
    )
    rows = [_row(study, result) for study in result.outputs.values()]
    return Document(
        "Which parameters matter",
        result.statement(),
        (
            run_tables.note_on_robot(file, result.model, method + effort),
            catalogue.table("sensitivity.leading", rows),
            overview,
            *remarks([*negligible_remark, *result.notes]),
        ),
        page_sections=lambda: _sections(result),
    )


def _row(study: OutputStudy, result: SensitivityResult) -> tuple[str | None, ...]:
    """The most important inputs for an output, and its range and spread over the operating points."""
    share, row = study.overall_share, study.row
    order = [k for k in np.argsort(-share, kind="stable")[:3] if share[k] >= NEGLIGIBLE]
    leading = [f"{short_name(result.names[k])} {100 * share[k]:.0f} %" for k in order]
    value, sd = study.value / row.factor, study.sd / row.factor
    finite = np.isfinite(value) & np.isfinite(sd)
    texts: list[str | None] = [None] * 3
    if finite.any():
        low, high, spread = value[finite].min(), value[finite].max(), np.median(sd[finite])
        texts = [f"{x:.{row.resolution}f}" for x in (low, high, spread)]
    return row.label, *leading, *[""] * (3 - len(leading)), *texts, row.unit_shown.replace("-", "")


def _sections(result: SensitivityResult) -> Iterable[Section]:
    yield Section("Output by output", (catalogue.note("sensitivity.legend"),), "outputs")
    for k, (name, study) in enumerate(result.outputs.items()):
        label = study.row.label.capitalize()
        has_influence = bool(study.overall_share.max(initial=0.0) > 0)
        has_influence = has_influence and bool(study.studied.any()) and bool(np.isfinite(study.value).any())
        yield Section(label, () if has_influence else (catalogue.note("sensitivity.nothing"),), name, level=3)
        if has_influence:
            finding = f"{study.row.label} with one input at the ends of its interval"
            tornado = catalogue.figure(
                "sensitivity.tornado", study, result, finding=finding, words=(label,), suffix=name
            )
            yield Section("", (tornado,), folded="tornado" if k >= UNFOLDED else "")
    yield Section("Inputs", (_inputs(result), catalogue.note("sensitivity.largest")), "inputs")


def _inputs(result: SensitivityResult) -> Table:
    """Table of all inputs with their distributions, the most important first."""
    importance = result.importance()
    rows = []
    for k in np.argsort(-importance, kind="stable"):
        name = result.names[k]
        quantity = result.inputs[name]
        share = importance[k]
        share_text = f"{100 * share:.0f} %" if share >= NEGLIGIBLE else f"< {100 * NEGLIGIBLE:g} %"
        interval = "{:.3g} to {:.3g}".format(*quantity.interval)
        rows.append(
            (
                f"`{name}`",
                quantity.meaning,
                quantity.unit,
                quantity.distribution,
                quantity.median,
                interval,
                share_text,
            )
        )
    return catalogue.table("sensitivity.inputs", rows)
