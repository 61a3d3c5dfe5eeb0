"""The report of `settle`: the settled runs of a log, and why other samples are left out."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from calibration.data.settling import Settled, Stretch
from calibration.words import settle_words as words
from sweeps.report.document import Column, Document, Figure, Note, Section, Table, deferred_drawing

#: Imposed quantity of a log and its unit.
IMPOSED = {
    "voltage": ("voltage", "V"),
    "motor_speed": ("motor speed", "rpm"),
    "motor_current": ("motor current", "A"),
}
_LOG = "**The log.** Shaded: settled stretches; thick: their means, the rows of `settled.csv`."
_SDS = (
    "±: standard deviation of the mean. It includes scatter and autocorrelation within the stretch, the step of the "
    "instrument, the remaining change, and differences between repeated levels."
)


def settle_document(found: Settled, few: str = "", notes: tuple[str, ...] = ()) -> Document:
    """The report; `few`: sentence of `words.too_few`; notes: further sentences on the settled runs."""
    next_step = Note("Next: `mmrjax loop settled.csv` with the same `--robot`.", "lead", terminal=False)
    next_step = Note(few, "lead", "few") if few else next_step
    remarks = (*words.settle_remarks(found), *notes)
    left = words.left_out(found.stretches, bool(few))
    columns = (
        Column("reason"), Column("stretches", form="{}"), Column("samples", form="{}"),
        Column("rows, for example", form="{}"), Column("what to do"),
    )  # fmt: skip
    log = Figure("log", words.settle_statement(found), _LOG, deferred_drawing("settle_figures.over_log", found))
    sections = [Section("Over the log", (log,))]
    if left:
        sections.append(Section("Left out", (Table("left", columns, left, "left out"),)))
    levels = Note(words.levels_and_samples(found), "key", terminal=False)
    settled = Section("Settled runs", (_settled(found), levels, Note(_SDS, "key", terminal=False)))
    return Document(
        f"Settled runs of {Path(found.runs.source).name}",
        words.settle_statement(found),
        (next_step, *([Note(remarks, name="notes")] if remarks else [])),
        (*sections, settled),
    )


def _settled(found: Settled) -> Table:
    imposed, unit = IMPOSED[found.runs.layout.imposed]
    columns = [
        Column("where"), Column("samples used", form="{}"), Column("of the level", form="{}"),
        Column(imposed, unit, "{:.4g}"),
    ]  # fmt: skip
    for signal in found.signals:
        c = signal.channel
        columns += [Column("mean", c.unit, "{:.5g}", c.label), Column("±", c.unit, "{:.2g}", c.label)]
    rows = [
        (
            f"{s.run or 'log'}, {s.begin:.4g} to {s.end:.4g} s", len(s.rows), available, s.imposed,
            *(x for k in found.signals for x in (s.mean[k.channel.name], s.sd[k.channel.name])),
        )
        for s, available in _levels(found)
    ]  # fmt: skip
    return Table("settled", tuple(columns), rows, file="settled.csv", wide=True, terminal=False)


def _levels(found: Settled) -> Iterator[tuple[Stretch, int]]:
    """Each settled run with the number of samples since the stretch before it in the same recording."""
    names, before = found.runs.run_names, -1
    for s in found.stretches:
        first, last = int(s.rows[0]), int(s.rows[-1])
        if before < 0 or names[before] != names[first]:
            before = int((names == names[first]).argmax()) - 1
        if not s.why:
            yield s, last - before
        before = last
