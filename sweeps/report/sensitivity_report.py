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
_OF = {"local": " to first order", "morris": ", by squared effects"}


def sensitivity_document(found: SensitivityResult, file: RobotFile) -> Document:
    """Report of a finished study."""
    method = f"Method: {sensitivity_words.METHODS[found.method]} (`{found.method}`)"
    ran = f", {found.evaluations:,} model evaluations in {found.seconds:.1f} s." if found.evaluations else "."
    p = found.points.at(np.any([o.studied for o in found.outputs.values()], axis=0))
    parts = [", ".join(dict.fromkeys(map(str, p.configuration)))]
    _, own_values, symbol = p.imposed
    for _, x, unit in (("", own_values, f" {symbol}"), *p.ground):
        on_battery = unit == " V" and np.isnan(x).all()
        parts.append("battery" if on_battery else ", ".join(f"{v:g}" for v in np.unique(x)) + unit)
    overview = catalogue.figure(
        "sensitivity.overview", found, words=(_OF.get(found.method, ""), "; ".join(parts), 100 * NEGLIGIBLE),
        more=catalogue.text("sensitivity.sobol") if found.method == "sobol" else "",
    )  # fmt: skip
    idle = [f"less than {100 * NEGLIGIBLE:g} % everywhere: {', '.join(found.negligible)}"] * bool(found.negligible)
    rows = [_row(study, found) for study in found.outputs.values()]
    return Document(
        "Which parameters matter",
        found.statement(),
        (
            run_tables.note_on_robot(file, found.model, method + ran),
            catalogue.table("sensitivity.leading", rows),
            overview,
            *remarks([*idle, *found.notes]),
        ),
        page_sections=lambda: _sections(found),
    )


def _row(study: OutputStudy, found: SensitivityResult) -> tuple[str | None, ...]:
    """The most important inputs for an output, and its range and spread over the operating points."""
    share, row = study.overall_share, study.row
    order = [k for k in np.argsort(-share, kind="stable")[:3] if share[k] >= NEGLIGIBLE]
    leading = [f"{short_name(found.names[k])} {100 * share[k]:.0f} %" for k in order]
    value, sd = study.value / row.factor, study.sd / row.factor
    finite = np.isfinite(value) & np.isfinite(sd)
    numbers: list[str | None] = [None] * 3
    if finite.any():
        low, high, spread = value[finite].min(), value[finite].max(), np.median(sd[finite])
        numbers = [f"{x:.{row.resolution}f}" for x in (low, high, spread)]
    return row.label, *leading, *[""] * (3 - len(leading)), *numbers, row.unit_shown.replace("-", "")


def _sections(found: SensitivityResult) -> Iterable[Section]:
    yield Section("Output by output", (catalogue.note("sensitivity.legend"),), "outputs")
    for k, (name, study) in enumerate(found.outputs.items()):
        label, acts = study.row.label.capitalize(), bool(study.overall_share.max(initial=0.0) > 0)
        acts = acts and bool(study.studied.any()) and bool(np.isfinite(study.value).any())
        yield Section(label, () if acts else (catalogue.note("sensitivity.nothing"),), name, level=3)
        if acts:
            finding = f"{study.row.label} with one input at the ends of its interval"
            tornado = catalogue.figure(
                "sensitivity.tornado", study, found, finding=finding, words=(label,), suffix=name
            )
            yield Section("", (tornado,), folded="tornado" if k >= UNFOLDED else "")
    yield Section("Inputs", (_inputs(found), catalogue.note("sensitivity.largest")), "inputs")


def _inputs(found: SensitivityResult) -> Table:
    """Table of all inputs with their distributions, the most important first."""
    importance, rows = found.importance(), []
    for k in np.argsort(-importance, kind="stable"):
        name = found.names[k]
        x, share = found.inputs[name], importance[k]
        largest = f"{100 * share:.0f} %" if share >= NEGLIGIBLE else f"< {100 * NEGLIGIBLE:g} %"
        interval = "{:.3g} to {:.3g}".format(*x.interval)
        rows.append((f"`{name}`", x.meaning, x.unit, x.distribution, x.median, interval, largest))
    return catalogue.table("sensitivity.inputs", rows)
