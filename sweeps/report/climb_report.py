"""The report of a climb: the answer, silhouettes, what it took on the way, and how sizes that were tried ended."""

from __future__ import annotations

from collections.abc import Iterable

from calibration.data.robot_file import RobotFile
from mmrjax.climbing.climb_derivatives import OUTPUTS
from sweeps.report import run_tables
from sweeps.report.document import Block, Document, Note, Section, Table, columns, deferred_figure
from sweeps.results.climb_results import VERDICTS, Along, ClimbResult

#: Outputs whose derivatives the terminal shows.
SHOWN = ("margin_success", "crest_time_s", "crest_energy_J", "crest_current_rms_A")
_SILHOUETTES = (
    "The robot from the side at the instants that decide the run; of a search that of the largest size it got over, "
    "or of the smallest that was tried. Dots are tips of grousers."
)
_COURSE = (
    "Over time, with the numbers of the silhouettes: pitch and lever angles; place of the middle of the robot from "
    "where the obstacle begins, and how far gravity’s line through the centre of mass is within the outermost "
    "contacts (negative: it tips, or has momentum, or leans on a wall); current of each traction motor and of the "
    "motors of both pairs of levers; energy since the start."
)
_LEAST = (
    "Least values are smoothed: what is within some 5 % of the least counts beside it. Of a robot that gets over "
    "they are taken up to the crest, where its centre of mass is past the obstacle."
)
_SLOPES = (
    "The first number is the derivative of this very run, with the instants at which contacts open and close. In "
    "brackets is the slope over the stated stretch, of runs side by side, with its standard deviation. Where the two "
    "agree the climb is smooth there; where they do not, other grousers meet the edge with other values, and the "
    "slope counts."
)
_BELTS = (
    "The belts run rigidly with their pulleys; the levers’ motors have what the supply gives, behind a planetary "
    "gear and a worm."
)


def climb_document(found: ClimbResult, file: RobotFile) -> Document:
    """The report of a climb."""
    lead = f"**{found.configuration}**; {found.obstacle}, met squarely."
    instants = "The robot at the decisive instants of the run"
    over_time = "Angles, place, margin, currents and energy over time"
    tried = ", ".join(f"{size:g} mm {VERDICTS[verdict][0]}" for size, verdict in found.tried)
    blocks: tuple[Block, ...] = (
        run_tables.lead_note(file, more=lead),
        deferred_figure("silhouettes", instants, _SILHOUETTES, "climb_figures.draw_silhouettes", found),
        deferred_figure("course", over_time, _COURSE, "climb_figures.draw_climb_course", found),
    )
    if tried:
        caption = "How each size that was tried ended."
        blocks = (*blocks, deferred_figure("search", tried, caption, "climb_figures.draw_size_search", found))
    return Document("Over an obstacle", found.statement(), blocks, tuple(_sections(found, tried)))


def _sections(found: ClimbResult, tried: str) -> Iterable[Section]:
    numbers = [
        (name.rpartition("_")[0].replace("_most", ", largest").replace("_least", ", least").replace("_", " "), value,
         name.rpartition("_")[2])
        for name, value in found.numbers().items()
    ]  # fmt: skip
    of_run = Table("run", columns("", "value | .4g", "unit"), numbers)
    yield Section("The run in numbers", (of_run, *[Note(f"{tried}.", terminal=True)] * bool(tried)), "numbers")
    if found.margins:
        rows = [(n.removeprefix("margin_"), 100 * value, OUTPUTS[n][1]) for n, value in found.margins.items()]
        shares = Table("shares", columns("margin", "[%] | .3g", "meaning"), rows, terminal=False)
        yield Section("Margins", (shares, Note(_LEAST)), "margins")
    if found.along is not None:
        yield Section("Derivatives", (_derivatives(found, found.along), Note(_SLOPES)), "derivatives")
    meanings = [(f"`{name}`", *about) for name, about in VERDICTS.items()]
    verdicts = Table("meanings", columns("verdict", "the robot", "meaning"), meanings, terminal=False)
    yield Section("Verdicts", (verdicts, Note(_BELTS)), "verdicts")


def _derivatives(found: ClimbResult, along: Along) -> Table:
    derivatives, names = found.derivatives, list(OUTPUTS)
    assert derivatives is not None  # it was asked for
    heads = columns(
        "of",
        "value | .4g",
        *(f"by {n} = {v:.4g} {u}, over ±{w:.2g} |".replace(" ,", ",") for n, u, v, w in along.rows),
    )
    parts = derivatives.by, derivatives.slope, derivatives.slope_sd
    rows = [
        (
            n if OUTPUTS[n][0] == "-" else f"{n} [{OUTPUTS[n][0]}]", derivatives.found[n],
            *(f"{d:.3g} ({s:.3g} ± {sd:.1g})" for d, s, sd in zip(*(x[n] for x in parts), strict=True))
        )
        for n in names
    ]  # fmt: skip
    title = "derivative (slope over the width, ± sd)"
    return Table("slopes", heads, rows, title, "derivatives.csv", brief=[names.index(n) for n in SHOWN])
