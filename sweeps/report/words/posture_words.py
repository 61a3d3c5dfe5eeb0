"""Sentences on a posture, on the console and on the page."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sweeps.report.document import Column, Table
from sweeps.results.posture_results import Postures

#: Columns of the page's table: heading, format.
COLUMNS = {
    "levers_front_deg": ("front levers [°]", "{:g}"), "levers_rear_deg": ("rear levers [°]", "{:g}"),
    "pitch_deg": ("pitch [°]", "{:.1f}"), "contact_mm": ("contact [mm]", "{:.0f}"), "bears": ("bears", "{}"),
    "load_front_percent": ("load at the front [%]", "{:.0f}"),
    "centre_height_mm": ("centre of mass over the ground [mm]", "{:.1f}"), "margin_mm": ("margin [mm]", "{:.0f}"),
    "tips_back_deg": ("tips back on [°]", "{:.1f}"), "tips_forward_deg": ("tips forward on [°]", "{:.1f}"),
    "tips_aside_deg": ("tips aside on [°]", "{:.1f}"), "highest_step_mm": ("highest step [mm]", "{:.0f}"),
    "widest_gap_mm": ("widest gap [mm]", "{:.0f}"), "tip_front_mm": ("front tip up to [mm]", "{:.0f}"),
    "tip_rear_mm": ("rear tip up to [mm]", "{:.0f}"), "overall_length_mm": ("length [mm]", "{:.0f}"),
    "overall_height_mm": ("height [mm]", "{:.0f}"),
}  # fmt: skip
#: Rows of that table at most.
ROWS = 20


def posture_table(found: Postures, names: Sequence[str]) -> Table:
    """Postures of the first runs, a row each."""
    shown = {c: about for c, about in COLUMNS.items() if c in found.table}
    rows = zip(names[:ROWS], *(found.table[c][:ROWS] for c in shown), strict=True)
    columns = (Column("run"), *(Column(heading, form=form) for heading, form in shown.values()))
    return Table("posture", columns, list(rows), file="posture.csv", sideways=True)


def posture_sentences(found: Postures) -> str:
    """One or two sentences on the posture of the first run and its geometric limits."""
    one, most = {c: values[0] for c, values in found.table.items()}, found.over.step_mm.max()
    return (
        f"posture: pitch {one['pitch_deg']:z.1f}°, on {one['contact_mm']:.0f} mm, which bear {one['bears']}; tips on "
        f"slopes of {one['tips_back_deg']:.1f}° uphill, {one['tips_forward_deg']:.1f}° downhill, "
        f"{one['tips_aside_deg']:.1f}° across. Its geometry allows steps up to {one['highest_step_mm']:.0f} mm and "
        f"gaps up to {one['widest_gap_mm']:.0f} mm; the highest step in any posture is {most:.0f} mm "
        f"(front {found.over.front_deg:g}°, rear {found.over.rear_deg:g}°)"
    )


def tipping_remarks(found: Postures) -> list[str]:
    """Remarks on runs that would tip over, which the numbers of straight travel do not show."""
    over = np.flatnonzero(found.table["margin_mm"] < 0)
    if not over.size:
        return []
    which = "the run" if len(found.table["margin_mm"]) == 1 else "runs " + ", ".join(str(k + 1) for k in over[:ROWS])
    return [f"posture: {which} would tip over on that slope; currents and speeds are of a robot that is held on it"]
