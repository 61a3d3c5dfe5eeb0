"""The common end of commands that write a run folder."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from calibration.data import Json
from calibration.data.robot_file import RobotFile
from calibration.data.runs import Runs
from sweeps import config as configuration
from sweeps.config import RobotPart
from sweeps.console import print_output
from sweeps.report import terminal_renderer
from sweeps.report.document import Document
from sweeps.store import DONE, SOLVER_FAILED, Folder

Page = Callable[[Path], Any]


def print_report(document: Document, file: RobotFile | None = None) -> Page:
    """Print a document and return its page, which ends with the robot's parameters if its file is given."""
    terminal_renderer.print_document(document)
    return lambda folder: importlib.import_module("sweeps.report.page_renderer").write_report_page(
        folder, document, file
    )


def finish_run_folder(
    folder: Folder,
    config: RobotPart,
    manifest: Json,
    *,
    solved: bool = True,
    page: Page | None = None,
    runs: Runs | None = None,
) -> int:
    """Write the configuration and the page (if wanted), move the folder into place and print its path.

    Args:
        folder: with the command's own files, `robot.toml` among them.
        manifest: entries besides program, versions and hashes; runs: the table whose hash is recorded, if any.
        solved: True if every solver gave an answer.

    Returns:
        The exit code: 0, or 3 where a solver failed.
    """
    folder.write_text("config.resolved.toml", configuration.as_toml(config))
    if page is not None and getattr(config, "report", True):
        page(folder.results())
    print_output(str(folder.finish(manifest, runs)))
    return DONE if solved else SOLVER_FAILED
