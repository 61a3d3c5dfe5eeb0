"""The report of `export`: an exported drive next to the native model, and the losses of the format."""

from __future__ import annotations

from mmrjax.model import channels
from sweeps.export.comparison import APPROXIMATED, DROPPED, HELD
from sweeps.export.formats import Export
from sweeps.report.document import Cell, Document, Note, Section, Table, columns, deferred_figure, remarks
from sweeps.report.words import export_words as words

#: Tone of a verdict's cell.
TONES = {HELD: "good", APPROXIMATED: "fair", DROPPED: "bad"}
_KEPT = "Kept: share of an effect's change of currents and speeds in settled runs that the exported drive shows."
_RIM = "{}. Speeds along the ground are read at the rim: slip is not part of a joint."
_FITTED = (
    "Translated: from the parameters of the native law. Refitted: by least squares to the native model over all "
    "runs; the files have these."
)
_RUNS = "**Each run.** On the line the exported drive shows the same as the reference."


def export_document(found: Export) -> Document:
    """The report of an exported drive."""
    compared = found.comparison
    used = words.USE[found.format].format(name=found.joint.name, at="drive", armature=words.rotor_inertia(found))
    fates = Table(
        "fates", columns("term or effect", "verdict", "kept [%] | .0f", "how"),
        [(f.name, Cell(f.verdict, TONES[f.verdict]), 100 * f.kept, f.how) for f in compared.fates],
        "what the format holds",
    )  # fmt: skip
    readings = deferred_figure(
        "readings", words.export_statement(found), _RUNS, "export_figures.draw_export_readings", compared
    )
    sections = [
        Section("What the format holds", (fates, Note(_KEPT, "key")), "holds"),
        Section(
            "Errors",
            (
                _errors(found),
                Note(_RIM.format(words.errors_title(found).capitalize()), "key"),
                readings,
            ),
            "errors",
        ),
    ]
    if compared.refitted:
        fitted = [(n, compared.translated[n], v) for n, v in compared.refitted.items()]
        heads = columns("name", "translated | .6g", "refitted | .6g")
        table = Table("fitted", heads, fitted, "parameters of the format", terminal=False)
        sections.append(Section("Parameters of the format", (table, Note(_FITTED, "key"))))
    if found.checks:
        heads = columns("check", "value | .3g")
        checks = Table("checks", heads, list(found.checks.items()), "checks of the files")
        sections.append(Section("Checks of the files", (checks,)))
    conditions = (
        Note(tuple(words.conditions_seen(found)), name="seen"),
        Note(tuple(words.not_tested(found)), name="untested"),
    )
    return Document(
        f"{found.joint.file.name} for {found.format}",
        words.export_statement(found),
        (Note(used, "lead"), *remarks(words.export_remarks(found))),
        (*sections, _constants(found), Section("Conditions seen, and what was not tested", conditions)),
    )


def _errors(found: Export) -> Table:
    names = list(found.comparison.errors[0].percent)
    heads = columns("model", *(f"{channels.find_channel(n).label} [%] | .3g" for n in names))
    rows = [(e.label, *(e.percent[n] for n in names)) for e in found.comparison.errors]
    return Table("error-table", heads, rows, words.errors_title(found))


def _constants(found: Export) -> Section:
    heads = columns("name", "value | .6g", "unit", "interval", "meaning", "source")
    rows = [(f"`{c.name}`", c.value, c.unit, c.interval or None, c.meaning, c.source) for c in found.constants]
    return Section("Constants", (Table("constants", heads, rows, wide=True, terminal=False),))
