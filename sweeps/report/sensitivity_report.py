"""Report of a sensitivity study: the answer, then each output and the inputs."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np

from calibration.data.robot_file import RobotFile
from calibration.sensitivity.result import NEGLIGIBLE, OutputStudy, SensitivityResult
from calibration.words import sensitivity_words
from sweeps.pages.words import short_name
from sweeps.report import catalogue, run_tables
from sweeps.report.document import Block, Document, Note, Section, Table, remarks

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
    idle = "less than {:g} % everywhere: {}".format(100 * NEGLIGIBLE, ", ".join(found.negligible))
    said = [idle] * bool(found.negligible)
    # the most important inputs for each output
    rows = []
    for study in found.outputs.values():
        share = study.overall_share
        top = [k for k in np.argsort(-share)[:3] if share[k] >= NEGLIGIBLE]
        cells = [f"{short_name(found.names[k])} {100 * share[k]:.0f} %" for k in top]
        rows.append((study.row.label, *cells, *[""] * (3 - len(cells))))
    return Document(
        "Which parameters matter",
        found.statement(),
        (
            run_tables.note_on_robot(file, found.model, method + ran),
            catalogue.table("sensitivity.leading", rows),
            overview,
            *remarks([*said, *found.notes]),
        ),
        page_sections=lambda: _sections(found),
    )


def _sections(found: SensitivityResult) -> Iterable[Section]:
    yield Section("Output by output", (catalogue.note("sensitivity.legend"),), "outputs")
    for k, (name, study) in enumerate(found.outputs.items()):
        yield Section(study.row.label.capitalize(), (Note(_sentence(study, found)),), name, level=3)
        if bool(study.studied.any()) and bool(np.isfinite(study.value).any()) and _any_influence(study):
            folded = "tornado" if k >= UNFOLDED else ""
            yield Section("", tuple(_output(name, study, found)), folded=folded)
    yield Section("Inputs", (_inputs(found), catalogue.note("sensitivity.largest")), "inputs")


def _any_influence(study: OutputStudy) -> bool:
    """True if any input changes an output."""
    return bool(study.overall_share.max(initial=0.0) > 0)


def _output(name: str, study: OutputStudy, found: SensitivityResult) -> Iterable[Block]:
    """Figure of an output."""
    label = study.row.label
    figure = catalogue.figure(
        "sensitivity.tornado", study, found, finding=_sentence(study, found), words=(label.capitalize(),)
    )
    yield dataclasses.replace(figure, name=f"tornado_{name}")


def _sentence(study: OutputStudy, found: SensitivityResult) -> str:
    """Sentence on the most important inputs for an output, with its spread."""
    share, row = study.overall_share, study.row
    if not _any_influence(study):
        return "No value at these operating points, or no input changes it."
    order = np.argsort(-share, kind="stable")[:3]
    top = [k for k in order if share[k] >= NEGLIGIBLE] or order[:1]
    who = ", ".join(f"{sensitivity_words.input_in_words(found, found.names[k])} {100 * share[k]:.0f} %" for k in top)
    value, sd = study.value / row.factor, study.sd / row.factor
    finite = np.isfinite(value) & np.isfinite(sd)
    unit = "" if row.unit_shown == "-" else f" {row.unit_shown}"
    digits = row.resolution
    low, high = value[finite].min(), value[finite].max()
    spans = f"from {low:.{digits}f} to {high:.{digits}f}{unit} over the operating points"
    spread = f"uncertain by ±{np.median(sd[finite]):.{digits}f}{unit} (one sd, median of the points)"
    return f"{who[0].upper()}{who[1:]}. It ranges {spans}, and is {spread}."


def _inputs(found: SensitivityResult) -> Table:
    """Table of all inputs with their distributions, the most important first."""
    importance, rows = found.importance(), []
    for k in np.argsort(-importance, kind="stable"):
        name, share = found.names[k], importance[k]
        x = found.inputs[name]
        largest = f"{100 * share:.0f} %" if share >= NEGLIGIBLE else f"< {100 * NEGLIGIBLE:g} %"
        interval = "{:.3g} to {:.3g}".format(*x.interval)
        rows.append((f"`{name}`", x.meaning, x.unit, x.distribution, x.median, interval, largest))
    return catalogue.table("sensitivity.inputs", rows)
