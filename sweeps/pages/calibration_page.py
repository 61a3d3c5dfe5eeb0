"""The report of a calibration: one offline page with its parameters, errors and figures."""

from __future__ import annotations

from pathlib import Path

from calibration.data.columns import Layout
from calibration.inference.identifiability import HELD
from calibration.inference.result import CalibrationResult
from calibration.words import fit_words
from sweeps.pages import calibration_figures, cluster_figures, comparison_figures
from sweeps.pages.page import Album, channel_columns, first_rows, render_page, unnamed_curves
from sweeps.pages.time_overlay import time_overlay
from sweeps.pages.words import words_shown
from sweeps.report.condition_columns import condition_formats


def write_calibration_page(folder: Path, found: CalibrationResult, *, robot_name: str) -> Path:
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
    album.add("parameters", lambda: calibration_figures.draw_parameter_intervals(found))
    album.add("before_after", lambda: calibration_figures.before_after(found))
    if found.axis:
        simulated = {"after_": "calibrated", "before_": "before"}
        album.add_overlay("histories", time_overlay(table, found.channels, simulated))
    along = {found.axis: "time [s]"} if found.axis else {}
    sized = Layout.of(found.robot).crosses_zero
    album.add("parity", lambda: comparison_figures.draw_parity(table, found.channels, band=not sized))
    album.add("residuals", lambda: comparison_figures.errors_over(table, found.channels, sized, along))
    if found.residual_clusters:
        album.add("clusters", lambda: cluster_figures.draw_clusters(found.residual_clusters))
    if found.profiled:
        album.add("profiles", lambda: calibration_figures.draw_profile_likelihoods(found))
    album.add("correlations", lambda: calibration_figures.draw_correlations(found))
    if len(found.posterior) > 1:
        album.add("pairs", lambda: calibration_figures.draw_correlated_pairs(found))
    return render_page(
        folder,
        "calibration.html.j2",
        album,
        of_channels=found.channels,
        title=f"Calibration of {words_shown(Path(robot_name).name)} to {Path(found.source).name}",
        answer=fit_words.calibration_answer(found),
        curves=unnamed_curves(found.robot),
        document=found.to_json(),
        rows=first_rows(table),
        conditions=condition_formats(table),
        columns=channel_columns(found.channels),
        sized=sized,
        has_ground=found.robot.has_ground,
        rms=found.rms,
        determined={name: found.determined(name) for name in found.parameters},
        held=HELD,
        shift=lambda z: "bad" if abs(z) > 3 else "fair" if abs(z) > 2 else "",
    )
