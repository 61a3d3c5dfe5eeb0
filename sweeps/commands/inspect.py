"""The command `inspect`: contents of a data file, and columns that its signals may be."""

from __future__ import annotations

from calibration.data import contents, presets_file
from mmrjax.errors import count_noun
from sweeps.console import print_json
from sweeps.report.document import Document, Note, Table, columns, remarks
from sweeps.report.terminal_renderer import print_document


def inspect_file(file: str, as_json: bool) -> int:
    """Prints the signals of a file and lines of `[columns]` for them. Returns 0.

    Raises:
        BadData: the file cannot be read.
    """
    source = contents.inspect_source(file)
    if as_json:
        print_json(source.to_json())
        return 0
    rows = [
        (s.path, s.unit, s.samples, *([""] * 6 if s.refused else
         (s.rate, s.gaps, *(("", "") if s.words else (s.least, s.greatest)), s.missing or "", ", ".join(s.words))))
        for s in source.signals
    ]  # fmt: skip
    heads = columns(
        "signal", "unit", "samples |", "Hz | .6g", "gaps | .0f", "from | .6g", "to | .6g", "missing |", "words"
    )
    remark_texts = [
        *(f"{signal.path} {signal.refused}" for signal in source.signals if signal.refused),
        *source.notes,
    ]
    proposals = []
    if source.preset:
        numbers = "".join(f",{key}=..." for key in presets_file.numbers_to_state(source.preset))
        proposals.append(f"Its columns match the preset {source.preset}: add --columns {source.preset}{numbers}")
    if source.proposed:
        proposals.append("\n".join(["Proposal for the robot's file, to be checked:", "[columns]", *source.proposed]))
    answer = f"{source.name}: {source.kind}, {count_noun(len(source.signals), 'signal')}"
    notes = (Note(text, terminal=True) for text in proposals)
    print_document(Document(source.name, answer, (Table("signals", heads, rows), *remarks(remark_texts), *notes)))
    return 0
