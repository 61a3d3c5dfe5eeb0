"""The command `inspect`: what a file of data contains, and which columns its signals may be."""

from __future__ import annotations

import math

from rich.table import Table

from calibration.data import Names, contents, presets_file
from calibration.data.contents import SignalFacts
from mmrjax.errors import count_noun
from sweeps.console import print_json, print_output


def inspect_file(file: str, as_json: bool) -> int:
    """Print the signals of a file and the lines of `[columns]` for them; returns 0.

    Raises:
        BadData: a file that cannot be read.
    """
    found = contents.inspect_source(file)
    if as_json:
        print_json(found.to_json())
        return 0
    print_output(f"{found.name}: {found.kind}, {count_noun(len(found.signals), 'signal')}")
    table = Table(box=None, pad_edge=False)
    for heading in ("signal", "unit"):
        table.add_column(heading, overflow="fold")
    for heading in ("samples", "Hz", "gaps", "from", "to", "missing"):
        table.add_column(heading, justify="right")
    for signal in found.signals:
        table.add_row(signal.path, signal.unit, str(signal.samples), *_numbers(signal))
    print_output(table)
    for signal in found.signals:
        if signal.refused:
            print_output(f"- {signal.path} {signal.refused}")
    for note in found.notes:
        print_output(f"- {note}")
    if found.preset:
        numbers = "".join(f",{key}=..." for key in presets_file.numbers_to_state(found.preset))
        print_output(f"\nIts columns are those of the preset {found.preset}: add --columns {found.preset}{numbers}")
    if found.proposed:
        print_output("\nFor the robot's file, to be checked:\n[columns]")
        for line in found.proposed:
            print_output(line)
    return 0


def _numbers(signal: SignalFacts) -> Names:
    if signal.refused:
        return ("",) * 5
    ends = (", ".join(signal.words), "") if signal.words else (_number(signal.least), _number(signal.greatest))
    gaps = "" if math.isnan(signal.gaps) else f"{signal.gaps:.0f}"
    return (_number(signal.rate), gaps, *ends, str(signal.missing) if signal.missing else "")


def _number(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.6g}"
