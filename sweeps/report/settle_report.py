"""Report of `settle`: the settled runs of a log, and the reasons for omitting other samples."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from calibration.data import Names
from calibration.data.settling import Settled, Stretch
from calibration.words import table_words as words
from sweeps.report import catalogue
from sweeps.report.document import Document, Note, Section, Table, columns, remarks
from sweeps.report.run_tables import axis_title


def settle_document(found: Settled, few: str, notes: Names) -> Document:
    """The report. `few`: sentence on too few settled runs. `notes`: further sentences on the settled runs."""
    next_step = Note("Next: `mmrjax loop settled.csv` with the same `--robot`.", "lead")
    statement, levels = words.settle_statement(found), Note(words.levels_and_samples(found), "key")
    omitted = words.omitted_stretches(found.stretches, bool(few) and not found.runs.turns)
    left_out = Section("Left out", (catalogue.table("settle.left", omitted),))
    return Document(
        f"Settled runs of {Path(found.runs.source).name}",
        statement,
        (
            Note(few, "lead", "few", terminal=True) if few else next_step,
            *remarks((*words.settle_remarks(found), *notes)),
        ),
        (
            Section("Over the log", (catalogue.figure("settle.log", found, finding=statement),)),
            *[left_out] * bool(omitted),
            Section("Settled runs", (_settled(found), levels, catalogue.note("settle.sds"))),
        ),
    )


def _settled(found: Settled) -> Table:
    titles = ["where", "samples used |", "of the level |", f"{axis_title(found.runs.layout.imposed_column)} | .4g"]
    for signal in found.signals:
        c = signal.channel
        titles += [f"{c.label} > mean [{c.unit}] | .5g", f"{c.label} > ± [{c.unit}] | .2g"]
    rows = [
        (
            f"{s.run or 'log'}, {s.begin:.4g} to {s.end:.4g} s", len(s.rows), available, s.imposed,
            *(x for k in found.signals for x in (s.mean[k.channel.name], s.sd[k.channel.name])),
        )
        for s, available in _levels(found)
    ]  # fmt: skip
    return Table("settled", columns(*titles), rows, file="settled.csv", wide=True, terminal=False)


def _levels(found: Settled) -> Iterator[tuple[Stretch, int]]:
    """Settled runs, each with the number of samples since the previous stretch of the same recording."""
    names, before = found.runs.run_names, -1
    for s in found.stretches:
        first, last = int(s.rows[0]), int(s.rows[-1])
        if before < 0 or names[before] != names[first]:
            before = int((names == names[first]).argmax()) - 1
        if not s.why:
            yield s, last - before
        before = last
