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


def settle_document(settled_log: Settled, few_runs_sentence: str, notes: Names) -> Document:
    """Report of the settled runs of a log.

    Args:
        few_runs_sentence: sentence on too few settled runs, empty if there are enough.
        notes: further sentences on the settled runs.
    """
    next_step = Note("Next: `mmrjax loop settled.csv` with the same `--robot`.", "lead")
    statement = words.settle_statement(settled_log)
    levels_note = Note(words.levels_and_samples(settled_log), "key")
    omitted = words.omitted_stretches(settled_log.stretches, bool(few_runs_sentence) and not settled_log.runs.turns)
    omitted_section = Section("Left out", (catalogue.table("settle.left", omitted),))
    return Document(
        f"Settled runs of {Path(settled_log.runs.source).name}",
        statement,
        (
            Note(few_runs_sentence, "lead", "few", terminal=True) if few_runs_sentence else next_step,
            *remarks((*words.settle_remarks(settled_log), *notes)),
        ),
        (
            Section("Over the log", (catalogue.figure("settle.log", settled_log, finding=statement),)),
            *[omitted_section] * bool(omitted),
            Section("Settled runs", (_settled(settled_log), levels_note, catalogue.note("settle.sds"))),
        ),
    )


def _settled(settled_log: Settled) -> Table:
    titles = [
        "where",
        "samples used |",
        "of the level |",
        f"{axis_title(settled_log.runs.layout.imposed_column)} | .4g",
    ]
    for signal in settled_log.signals:
        channel = signal.channel
        titles += [f"{channel.label} > mean [{channel.unit}] | .5g", f"{channel.label} > ± [{channel.unit}] | .2g"]
    rows = [
        (
            f"{s.run or 'log'}, {s.begin:.4g} to {s.end:.4g} s", len(s.rows), available_samples, s.imposed,
            *(x for k in settled_log.signals for x in (s.mean[k.channel.name], s.sd[k.channel.name])),
        )
        for s, available_samples in _levels(settled_log)
    ]  # fmt: skip
    return Table("settled", columns(*titles), rows, file="settled.csv", wide=True, terminal=False)


def _levels(settled_log: Settled) -> Iterator[tuple[Stretch, int]]:
    """Settled runs, each with the number of samples since the previous stretch of the same recording."""
    names = settled_log.runs.run_names
    last_row_before = -1
    for stretch in settled_log.stretches:
        first, last = int(stretch.rows[0]), int(stretch.rows[-1])
        if last_row_before < 0 or names[last_row_before] != names[first]:
            last_row_before = int((names == names[first]).argmax()) - 1
        if not stretch.why:
            yield stretch, last - last_row_before
        last_row_before = last
