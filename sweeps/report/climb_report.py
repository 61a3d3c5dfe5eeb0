"""The report of a climb: the answer, silhouettes, what it took on the way, and how sizes that were tried ended."""

from __future__ import annotations

from collections.abc import Iterable

from calibration.data.robot_file import RobotFile
from mmrjax.climbing.climb_derivatives import OUTPUTS
from sweeps.report import catalogue, run_tables
from sweeps.report.document import Block, Document, Note, Section, Table
from sweeps.results.climb_results import VERDICTS, Along, ClimbResult

#: Outputs whose derivatives the terminal shows.
SHOWN = ("margin_success", "crest_time_s", "crest_energy_J", "crest_current_rms_A")


def climb_document(found: ClimbResult, file: RobotFile) -> Document:
    """The report of a climb."""
    lead = f"**{found.configuration}**; {found.obstacle}, met squarely."
    tried = ", ".join(f"{size:g} mm {VERDICTS[verdict][0]}" for size, verdict in found.tried)
    blocks: tuple[Block, ...] = (
        run_tables.lead_note(file, more=lead),
        catalogue.figure("climb.silhouettes", found),
        catalogue.figure("climb.course", found),
    )
    if tried:
        blocks = (*blocks, catalogue.figure("climb.search", found, finding=tried))
    return Document("Over an obstacle", found.statement(), blocks, tuple(_sections(found, tried)))


def _sections(found: ClimbResult, tried: str) -> Iterable[Section]:
    numbers = [
        (name.rpartition("_")[0].replace("_most", ", largest").replace("_least", ", least").replace("_", " "), value,
         name.rpartition("_")[2])
        for name, value in found.numbers().items()
    ]  # fmt: skip
    of_run = catalogue.table("climb.run", numbers)
    yield Section("The run in numbers", (of_run, *[Note(f"{tried}.", terminal=True)] * bool(tried)), "numbers")
    if found.margins:
        rows = [(n.removeprefix("margin_"), 100 * value, OUTPUTS[n][1]) for n, value in found.margins.items()]
        shares = catalogue.table("climb.shares", rows)
        yield Section("Margins", (shares, catalogue.note("climb.least")), "margins")
    if found.along is not None:
        yield Section(
            "Derivatives", (_derivatives(found, found.along), catalogue.note("climb.slopes")), "derivatives"
        )
    meanings = [(f"`{name}`", *about) for name, about in VERDICTS.items()]
    verdicts = catalogue.table("climb.meanings", meanings)
    yield Section("Verdicts", (verdicts, catalogue.note("climb.belts")), "verdicts")


def _derivatives(found: ClimbResult, along: Along) -> Table:
    derivatives, names = found.derivatives, list(OUTPUTS)
    assert derivatives is not None  # it was asked for
    parts = derivatives.by, derivatives.slope, derivatives.slope_sd
    rows = [
        (
            n if OUTPUTS[n][0] == "-" else f"{n} [{OUTPUTS[n][0]}]", derivatives.found[n],
            *(f"{d:.3g} ({s:.3g} ± {sd:.1g})" for d, s, sd in zip(*(x[n] for x in parts), strict=True))
        )
        for n in names
    ]  # fmt: skip
    by = (f"by {n} = {v:.4g} {u}, over ±{w:.2g} |".replace(" ,", ",") for n, u, v, w in along.rows)
    return catalogue.table("climb.slopes-table", rows, *by, brief=[names.index(n) for n in SHOWN])
