"""The report of a calibration: one offline page with its parameters, errors and figures."""

from __future__ import annotations

from pathlib import Path

from calibration.data.columns import Layout
from calibration.inference.identifiability import HELD
from calibration.inference.result import CalibrationResult
from sweeps import figures_calibration, figures_clusters, figures_comparison
from sweeps.report import Album, columns, conditions, first_rows, render, rms, words_shown


def write(folder: Path, found: CalibrationResult, *, robot_name: str) -> Path:
    """Write `report.html` and `figures/` for a calibration.

    Args:
        folder: an existing run folder.
        robot_name: name or file of the robot that was calibrated.

    Returns:
        The path of the page.
    """
    table = found.rows()
    table |= {f"simulated_{c.column}": table[f"after_{c.column}"] for c in found.channels}
    album = Album(folder)
    album.add("parameters", lambda: figures_calibration.parameters(found))
    album.add("before_after", lambda: figures_calibration.before_after(found))
    if found.axis:
        album.add("histories", lambda: figures_calibration.histories(table, found.channels))
    along = {found.axis: "time [s]"} if found.axis else {}
    sized = Layout.of(found.robot).crosses_zero
    album.add("parity", lambda: figures_comparison.parity(table, found.channels, band=not sized))
    album.add("residuals", lambda: figures_comparison.errors_over(table, found.channels, sized, along))
    if found.residual_clusters:
        album.add("clusters", lambda: figures_clusters.clusters(found.residual_clusters))
    if found.profiled:
        album.add("profiles", lambda: figures_calibration.profiles(found))
    album.add("correlations", lambda: figures_calibration.correlations(found))
    return render(
        folder,
        "calibration.html.j2",
        album,
        of_channels=found.channels,
        title=f"Calibration of {words_shown(Path(robot_name).name)} to {Path(found.source).name}",
        document=found.to_json(),
        rows=first_rows(table),
        conditions=conditions(table),
        columns=columns(found.channels),
        sized=sized,
        has_ground=found.robot.has_ground,
        rms=rms(table, found.channels, ("before", "after", "held_out")),
        held=HELD,
        shift=lambda z: "bad" if abs(z) > 3 else "fair" if abs(z) > 2 else "",
    )
