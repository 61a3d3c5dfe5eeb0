"""The report of `export`: an exported drive next to the native model, and the losses of the format."""

from __future__ import annotations

from mmrjax.model import channels
from sweeps.export.comparison import APPROXIMATED, DROPPED, HELD
from sweeps.export.formats import Export
from sweeps.report.document import Cell, Column, Document, Note, Section, Table, deferred_figure
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
        "fates", (Column("term or effect"), Column("verdict"), Column("kept", "%", "{:.0f}"), Column("how")),
        [(f.name, Cell(f.verdict, TONES[f.verdict]), 100 * f.kept, f.how) for f in compared.fates],
        "what the format holds",
    )  # fmt: skip
    readings = deferred_figure(
        "readings", words.export_statement(found), _RUNS, "export_figures.draw_export_readings", compared
    )
    sections = [
        Section("What the format holds", (fates, Note(_KEPT, "key", terminal=False)), "holds"),
        Section(
            "Errors",
            (
                _errors(found),
                Note(_RIM.format(words.errors_title(found).capitalize()), "key", terminal=False),
                readings,
            ),
            "errors",
        ),
    ]
    if compared.refitted:
        fitted = [(n, compared.translated[n], v) for n, v in compared.refitted.items()]
        columns = (Column("name"), Column("translated", form="{:.6g}"), Column("refitted", form="{:.6g}"))
        table = Table("fitted", columns, fitted, "parameters of the format", terminal=False)
        sections.append(Section("Parameters of the format", (table, Note(_FITTED, "key", terminal=False))))
    if found.checks:
        shown = (Column("check"), Column("value", form="{:.3g}"))
        checks = Table("checks", shown, list(found.checks.items()), "checks of the files")
        sections.append(Section("Checks of the files", (checks,)))
    conditions = (
        Note(tuple(words.conditions_seen(found)), name="seen", terminal=False),
        Note(tuple(words.not_tested(found)), name="untested", terminal=False),
    )
    return Document(
        f"{found.joint.file.name} for {found.format}",
        words.export_statement(found),
        (Note(used, "lead", terminal=False), Note(tuple(words.export_remarks(found)), name="notes")),
        (*sections, _constants(found), Section("Conditions seen, and what was not tested", conditions)),
    )


def _errors(found: Export) -> Table:
    names = list(found.comparison.errors[0].percent)
    columns = (Column("model"), *(Column(channels.find_channel(n).label, "%", "{:.3g}") for n in names))
    rows = [(e.label, *(e.percent[n] for n in names)) for e in found.comparison.errors]
    return Table("error-table", columns, rows, words.errors_title(found))


def _constants(found: Export) -> Section:
    columns = (
        Column("name"), Column("value", form="{:.6g}"), Column("unit"), Column("interval"), Column("meaning"),
        Column("source"),
    )  # fmt: skip
    rows = [(f"`{c.name}`", c.value, c.unit, c.interval or None, c.meaning, c.source) for c in found.constants]
    return Section("Constants", (Table("constants", columns, rows, wide=True, terminal=False),))
