"""Export from Python in one call."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from calibration.data import robot_file
from calibration.data.input_errors import BadConfiguration
from calibration.data.posterior_file import Posterior
from calibration.data.robot_file import RobotFile
from calibration.data.runs import Runs
from calibration.data.writing import naming_file
from mmrjax.model.robot import Robot
from sweeps.export.formats import Export, export_format
from sweeps.report import export_report


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
    texts = {**exported.files, "LAW.md": export_report.law_text(exported)}
    exported = dataclasses.replace(exported, files=texts)
    if out is not None:
        folder = Path(out)
        if existing_file := next((folder / name for name in texts if (folder / name).exists()), None):
            raise BadConfiguration(f"out: {existing_file} exists already; choose another folder, or remove it")
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in texts.items():
            with naming_file(folder / name):
                (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    return exported
