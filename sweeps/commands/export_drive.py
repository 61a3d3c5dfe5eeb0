"""The command `export`, and export from Python: a drive in the format of another simulator, with a report."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from calibration.data import Json, robot_file
from calibration.data.input_errors import BadConfiguration
from calibration.data.posterior_file import Posterior
from calibration.data.robot_file import RobotFile
from calibration.data.runs import Runs
from calibration.data.writing import naming_file
from mmrjax.model.robot import Robot
from sweeps import config as configuration
from sweeps.export.formats import Export, export_format
from sweeps.inputs import load_robot
from sweeps.report import export_report
from sweeps.store import finish_run_folder, open_folder, print_report


def execute(config: configuration.Export, invocation: configuration.FolderPart) -> int:
    """Exports a drive and writes a run folder with its files. Returns the exit code, 0."""
    file = load_robot(config)
    with open_folder("export", config, file.robot, invocation) as folder:
        exported = export_format(
            file, config.to, configuration=config.configuration, data=config.data, at=config.joint,
            draws=config.draws, seed=config.seed,
        )  # fmt: skip
        for name, content in exported.files.items():
            folder.write_bytes(name, content if isinstance(content, bytes) else content.encode())
        folder.write_text("LAW.md", export_report.law_text(exported))
        folder.write_json("result.json", to_json(exported))
        page = print_report(export_report.export_document(exported))
        folder.runs = exported.comparison.situation.runs
        return finish_run_folder(folder, {"seed": config.seed}, page)


def to_json(exported: Export) -> Json:
    """`result.json`."""
    comparison = exported.comparison
    return {
        "schema": "mmrjax.export/1",
        "format": exported.format,
        "robot": exported.joint.file.name,
        "configuration": exported.joint.configuration,
        "statement": export_report.export_statement(exported),
        "runs": len(comparison.situation.command),
        "source": comparison.situation.source,
        "reference": comparison.reference,
        "errors_percent": comparison.errors,
        "translated": dict(comparison.translated),
        "refitted": dict(comparison.refitted),
        "effects": [
            {"name": f.name, "verdict": f.verdict, "how": f.how, "share_kept": f.kept} for f in comparison.fates
        ],
        "idle": list(exported.joint.idle),
        "checks": dict(exported.checks),
        "constants": [
            {"name": c.name, "value": c.value, "unit": c.unit, "low": c.low, "high": c.high, "source": c.source}
            for c in exported.constants
        ],
        "files": sorted(exported.files),
    }


def export(
    robot: Robot | str | Path,
    to: str = "mujoco",
    *,
    out: str | Path | None = None,
    data: Runs | str | None = None,
    configuration: str | None = None,
    joint: str = "drive",
    posterior: Posterior | None = None,
    draws: int = 1000,
    seed: int = 0,
) -> Export:
    """Exports a robot's drive as the actuator of one joint in another simulator, and compares it with the native
    model.

    Args:
        robot: a robot, the name of a packaged one, or its TOML file. The posterior next to it is read.
        to: `mujoco`, `jax`, `onnx`, `mjlab`, `table` or `randomization` (docs/howto/export.md).
        out: folder for the files and `LAW.md`, made if it does not exist. None: no files are written.
        data: runs to compare with, or the file of a table or log. None: a grid of operating points.
        configuration: configuration of the robot. None: its first.
        joint: name of the joint in the simulator's model, for `mujoco`.
        posterior: posterior of a robot in memory, from a calibration or the loop.
        draws, seed: draws and seed of `randomization`.

    Returns:
        The export: `files` by name, `comparison` with refitted parameters, fates of effects and errors in percent.

    Raises:
        BadConfiguration: the format is unknown, the drive is not one joint, or the folder has one of these files.
        BadData: the table is rejected.
    """
    file = RobotFile(robot, "robot") if isinstance(robot, Robot) else robot_file.find_robot_file(str(robot))
    exported = export_format(
        file, to, configuration=configuration, data=data, at=joint, draws=draws, seed=seed, posterior=posterior
    )
    files = {**exported.files, "LAW.md": export_report.law_text(exported)}
    exported = dataclasses.replace(exported, files=files)
    if out is not None:
        folder = Path(out)
        if existing_file := next((folder / name for name in files if (folder / name).exists()), None):
            raise BadConfiguration(f"out: {existing_file} exists already; choose another folder")
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            with naming_file(folder / name):
                (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    return exported
