"""Report of `export`: comparison of the exported drive with the native model, and what the format omits."""

from __future__ import annotations

from mmrjax.model import channels
from sweeps.export.comparison import APPROXIMATED, DROPPED, HELD
from sweeps.export.formats import Export
from sweeps.report import catalogue
from sweeps.report.document import Cell, Document, Note, Section, Table, remarks
from sweeps.report.words import export_words as words

#: Tone of a verdict's cell.
TONES = {HELD: "good", APPROXIMATED: "fair", DROPPED: "bad"}


def export_document(found: Export) -> Document:
    """Report of an exported drive."""
    compared = found.comparison
    usage = words.USE[found.format].format(name=found.joint.name, at="drive", armature=words.rotor_inertia(found))
    fate_rows = [(f.name, Cell(f.verdict, TONES[f.verdict]), 100 * f.kept, f.how) for f in compared.fates]
    fates = catalogue.table("export.fates", fate_rows)
    sections = [
        Section("What the format represents", (fates, catalogue.note("export.kept")), "holds"),
        Section(
            "Errors",
            (_errors(found), catalogue.note("export.rim", words.errors_title(found).capitalize())),
            "errors",
        ),
    ]
    if compared.refitted:
        fitted = [(n, compared.translated[n], v) for n, v in compared.refitted.items()]
        table = catalogue.table("export.fitted", fitted)
        sections.append(Section("Parameters of the format", (table, catalogue.note("export.fitted"))))
    if found.checks:
        checks = catalogue.table("export.checks", list(found.checks.items()))
        sections.append(Section("Checks of the files", (checks,)))
    conditions = (
        Note(tuple(words.conditions_seen(found)), name="seen"),
        Note(tuple(words.not_tested(found)), name="untested"),
    )
    return Document(
        f"{found.joint.file.name} for {found.format}",
        words.export_statement(found),
        (Note(usage, "lead"), *remarks(words.export_remarks(found))),
        (*sections, _constants(found), Section("Conditions in the data, and what was not tested", conditions)),
    )


def _errors(found: Export) -> Table:
    errors = found.comparison.errors
    names = list(next(iter(errors.values())))
    heads = (f"{channels.find_channel(n).label} [%] | .3g" for n in names)
    rows = [(label, *map(percent.get, names)) for label, percent in errors.items()]
    return catalogue.table("export.error-table", rows, *heads, title=words.errors_title(found))


def _constants(found: Export) -> Section:
    rows = [(f"`{c.name}`", c.value, c.unit, c.interval or None, c.meaning, c.source) for c in found.constants]
    return Section("Constants", (catalogue.table("export.constants", rows),))
