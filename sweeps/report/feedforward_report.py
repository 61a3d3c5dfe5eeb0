"""Report of `calibrate --feedforward`."""

from __future__ import annotations

from calibration.described import sentences
from calibration.inference.feedforward import Feedforward, constant_units, interval_95
from calibration.words import feedforward_words
from sweeps.report import catalogue
from sweeps.report.document import Block, Document, Figure, Section, Table, remarks


def feedforward_document(found: Feedforward) -> Document:
    """Constants, gains, remarks and the two figures."""
    units, t = constant_units(found.unit), found.tolerances
    gains = [(*name.split("_"), x, units[name.split("_")[1]]) for name, x in found.gains.items()]
    option_rows = (
        f"Gains for tolerances of {t.position:g} {found.unit}, {t.velocity:g} {found.unit}/s and {t.effort:g} V, a "
        f"period of {1000 * t.period:g} ms and a measurement delay of {1000 * (t.delay or 0):.3g} ms."
    )
    blocks: list[Block] = [_constants(found), *remarks(sentences(found.remarks))]
    if gains:
        blocks += [catalogue.table("feedforward.gains", gains), *remarks((option_rows,), "asked")]
    return Document(
        f"Feedforward of {'an' if found.mechanism[0] in 'ae' else 'a'} {found.mechanism} mechanism",
        feedforward_words.feedforward_statement(found),
        tuple(blocks),
        (Section("Windows", _figures(found)),),
    )


def voltage_section(found: Feedforward) -> Section:
    """The two voltage plots of a log and the constants of their lines, for other reports."""
    return Section("Voltage against speed and acceleration", (*_figures(found), _constants(found)))


def _figures(found: Feedforward) -> tuple[Figure, ...]:
    return tuple(catalogue.figure(f"feedforward.{name}", found) for name in ("quasistatic", "dynamic"))


def _constants(found: Feedforward) -> Table:
    units = constant_units(found.unit)
    rows = [(n, x, interval_95(x, found.sds[n])[1] - x, units[n]) for n, x in found.constants.items()]
    return catalogue.table("feedforward.constants", rows)
