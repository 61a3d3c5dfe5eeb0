"""Formats by name, and the export of a drive to one of them."""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from calibration.data import Columns
from calibration.data.input_errors import BadConfiguration, stated_word
from calibration.data.posterior_file import FILE, Posterior
from calibration.data.robot_file import RobotFile
from calibration.data.runs import Runs
from mmrjax.compile.compiling import in_double
from mmrjax.errors import count_noun
from mmrjax.fidelities.drive import drive_batch
from mmrjax.model import params
from mmrjax.model.conditions import Conditions
from sweeps.export import comparison, feed_forward, jax_actuator, law_source, mujoco
from sweeps.export.comparison import ComparisonRuns, ExportComparison, situation_of_joint
from sweeps.export.joint import DriveJoint, joint_of_robot
from sweeps.export.law_source import LawConstant, law_constants
from sweeps.inputs import posterior_beside_robot

#: Names of formats and their uses.
FORMATS = {
    "mujoco": "MJCF with <dcmotor>, and a runnable scene",
    "jax": "an actuator function in JAX, as source and as a serialised program",
    "onnx": "an ONNX model of one time step, for Isaac Lab, Unity or C++",
    "mjlab": "an actuator configuration of mjlab, in PyTorch",
    "table": "feed-forward and efficiency maps, as CSV and as a C header",
    "randomization": "samples from the posterior, for MuJoCo and the actuator",
}
#: Goal of a start in MuJoCo [rad], and its length [s].
GOAL, START = 0.5, 0.5
#: Most runs that are checked in MuJoCo C.
CHECKED = 12


@dataclasses.dataclass(frozen=True)
class Export:
    """An exported drive.

    Attributes:
        format: one of `FORMATS`.
        joint: the exported drive.
        constants: constants of its law.
        posterior: posterior of the robot, if any.
        files: contents of the files by name.
        comparison: comparison with the native model.
        checks: results of checks with the files, by name.
    """

    format: str
    joint: DriveJoint
    constants: tuple[LawConstant, ...]
    posterior: Posterior | None
    files: Mapping[str, str | bytes]
    comparison: ExportComparison
    checks: Mapping[str, float]


@in_double
def export_format(
    file: RobotFile,
    to: str,
    *,
    configuration: str | None = None,
    data: Runs | str | None = None,
    at: str = "drive",
    draws: int = 1000,
    seed: int = 0,
    posterior: Posterior | None = None,
) -> Export:
    """Drive of a robot in a format, compared with the native model over runs.

    Args:
        to: one of `FORMATS`.
        configuration: name of the configuration. None: the robot's first.
        data: runs, or the file of a table or log. None: a grid of operating points.
        at: name of the joint in the simulator's model.
        draws, seed: draws and seed of `randomization`.
        posterior: posterior of the robot. None: read from the folder of its file.

    Raises:
        BadConfiguration, BadData: the format, drive or table is rejected.
    """
    stated_word(to, FORMATS, "--to")
    if not at.isprintable() or not at or any(c in at for c in "\"'<>&"):
        raise BadConfiguration(f"--joint: got {at!r}; expected the name of a joint, without quotes and brackets")
    if to in ("mujoco", "randomization"):
        mujoco.mujoco_module()
    drive = joint_of_robot(file, configuration)
    source = Path(file.source)
    if posterior is None and source.suffix == ".toml" and source.with_name(FILE).is_file():
        posterior = posterior_beside_robot(file)
    runs = situation_of_joint(drive.steady, data)
    constants = law_constants(drive, runs.signals, posterior)
    checks: Mapping[str, float] = {}
    if to in ("mujoco", "randomization"):
        files, compared, checks = _export_mujoco(drive, constants, runs, at)
        if to == "randomization":
            normal = float(np.mean(np.asarray(runs.signals.normal)))
            values = draw_parameters(drive, posterior, constants, compared.refitted, normal, draws, seed)
            files = randomization_files(values)
    elif to == "table":
        files, compared = _export_tables(drive, constants, runs)
    else:
        files, compared, checks = _export_actuator(to, drive, constants, runs)
    return Export(to, drive, constants, posterior, files, compared, checks)


def notes_for_file_head(runs: ComparisonRuns) -> list[str]:
    """Sentences for the head of every file."""
    command = runs.command
    return [
        f"Seen: {count_noun(len(command), 'run')} of {runs.source}, {np.min(command):.4g} to "
        f"{np.max(command):.4g} V, {np.min(runs.load):.4g} to {np.max(runs.load):.4g} N·m at the joint. Nothing "
        "else was tested. LAW.md lists equations, intervals and approximations."
    ]


def middle_run(command: np.ndarray, load: np.ndarray) -> tuple[float, float]:
    """Command and load of the run with the median magnitude of the command. The mean of a symmetric grid is rest."""
    row = int(np.argsort(np.abs(command))[len(command) // 2])
    return float(command[row]), float(load[row])


#: Files of an export, its comparison with the native model, and results of checks.
Written = tuple[Mapping[str, str | bytes], ExportComparison, Mapping[str, float]]


def _export_mujoco(drive: DriveJoint, constants: Sequence[LawConstant], runs: ComparisonRuns, at: str) -> Written:
    normal = float(np.mean(np.asarray(runs.signals.normal)))
    compared = comparison.compare_format(
        runs,
        mujoco.mujoco_law_function(normal),
        mujoco.fates_in_mujoco(drive, normal),
        mujoco.TERMS,
        mujoco.approximated_terms,
    )
    motor, name = mujoco.mjcf_motor(drive, compared.refitted), f"{drive.name}_drive"
    notes = mujoco.attribute_notes(constants, compared.translated, compared.refitted)
    mass = float(np.mean(np.asarray(runs.signals.mass)))
    volts = float(drive.robot.motor.voltage_limit or np.max(np.abs(runs.command)))
    follows_angle = drive.robot.rig.imposed == "goal_angle"
    command, load = (GOAL * motor.ratio, 0.0) if follows_angle else middle_run(runs.command, runs.load)

    def texts_of(drive: DriveJoint) -> dict[str, str]:
        return {
            "drive.xml": mujoco.mjcf_fragment(drive, motor, notes, notes_for_file_head(runs), name, at, volts),
            "scene.xml": mujoco.mjcf_scene(drive, mass, name, at, command, load),
        }

    texts = texts_of(drive)
    checks = _check_in_mujoco(texts_of(drive.steady), motor, runs, compared)
    if follows_angle or (drive.loose and drive.controller is None):
        times = np.linspace(0.0, START, 26)
        conditions = Conditions(voltage=volts)
        if drive.controller is not None:
            conditions = Conditions(voltage=drive.controller.supply_voltage, goal=GOAL)
        conditions = jax.tree.map(lambda x: jnp.asarray(x, float)[None], conditions)
        native = np.asarray(drive_batch(drive.robot, conditions, jnp.asarray(times)).signals.angle)[0]
        angles = mujoco.angles_in_mujoco(texts, command if follows_angle else volts, times)
        checks[f"angle over {START:g} s from rest, MuJoCo C against native [%]"] = _rms_percent(angles, native)
    return texts, compared, checks


def _rms_percent(values: np.ndarray, reference: np.ndarray) -> float:
    """Rms of a difference over the rms of the reference [%]."""
    return 100 * float(np.sqrt(np.mean((values - reference) ** 2)) / np.sqrt(np.mean(reference**2)))


def _check_in_mujoco(
    texts: Mapping[str, str], motor: mujoco.MjcfMotor, runs: ComparisonRuns, found: ExportComparison
) -> dict[str, float]:
    """Largest differences of MuJoCo C from the format's law, and errors of both on the same runs [%]."""
    rows = np.unique(np.linspace(0, len(runs.command) - 1, min(CHECKED, len(runs.command))).astype(int))
    mujoco_results = mujoco.settle_in_mujoco(texts, motor, runs, found.exported, rows.tolist())
    checks = {"runs settled in MuJoCo C": float(len(rows))}
    for name in ("current", "speed"):
        native, law, settled = (vars(x)[name] for x in (runs.inside, found.exported, mujoco_results))
        checks[f"{name}, law against native [%]"] = _rms_percent(law[rows], native[rows])
        checks[f"{name}, MuJoCo C against native [%]"] = _rms_percent(settled, native[rows])
    return checks


def _export_actuator(to: str, drive: DriveJoint, constants: Sequence[LawConstant], runs: ComparisonRuns) -> Written:
    notes, checks = notes_for_file_head(runs), dict[str, float]()
    if to == "jax":
        files = jax_actuator.jax_files(drive, constants, notes)
    elif to == "mjlab":
        files = law_source.mjlab_files(drive, constants, notes)
    else:
        files = jax_actuator.onnx_files(drive, constants)
        difference = jax_actuator.difference_from_jax(drive, constants, files["actuator.onnx"])
        checks["ONNX against JAX, largest of 10,000 states [relative]"] = difference
    law, fates = jax_actuator.actuator_law_function(runs, constants), jax_actuator.fates_in_actuator(drive)
    effect_names = {e.name: "a function of the law" for e in drive.inside}
    return files, comparison.compare_format(runs, law, fates, effect_names, mujoco.approximated_terms), checks


def _export_tables(
    drive: DriveJoint, constants: Sequence[LawConstant], runs: ComparisonRuns
) -> tuple[Mapping[str, str | bytes], ExportComparison]:
    settled = "its settled value, since a table has no state"
    effect_names = {e.name: "the tables" if e.memory_size is None else settled for e in drive.inside}
    law, fates = feed_forward.table_law_function(runs, constants), feed_forward.fates_in_tables(drive, constants)
    compared = comparison.compare_format(runs, law, fates, effect_names, mujoco.approximated_terms)
    table = feed_forward.map_of_drive(runs, constants)
    return feed_forward.table_files(drive, table, notes_for_file_head(runs)), compared


def draw_parameters(
    joint: DriveJoint,
    posterior: Posterior | None,
    constants: Sequence[LawConstant],
    refitted: Mapping[str, float],
    normal: float,
    draws: int,
    seed: int,
) -> Columns:
    """Draws by format and name, `mujoco/resistance` and `actuator/motor.resistance`, each of shape (draws,).

    All numbers of a draw belong together, with the correlation of the posterior. A parameter of MuJoCo is translated
    from the draw, and multiplied by the ratio of its refitted to its translated value at the posterior's centre.

    Raises:
        BadConfiguration: there is no posterior.
    """
    if posterior is None:
        raise BadConfiguration(
            f"--to randomization: no {FILE} next to {joint.file.source}; expected FOLDER/robot.toml of calibrate "
            "or loop"
        )
    values = posterior.draw(draws, seed)
    own_names = {p.name for p in params.walk_parameters(joint.robot)}
    columns = {name: values[:, k] for k, name in enumerate(posterior.names) if name in own_names}
    centre = mujoco.translate_law(joint, normal)
    factors = {
        n: refitted[n] / x if (x := float(v)) > 0 else 1.0 for n, v in zip(centre.names, centre.start, strict=True)
    }
    drawn_values: dict[str, list[float]] = {}
    for k in range(draws):
        robot = params.replace(joint.robot, {name: np.asarray(x[k]) for name, x in columns.items()})
        other = joint.with_robot(robot)
        law = mujoco.translate_law(other, normal)
        theta = {n: factors[n] * float(v) for n, v in zip(law.names, law.start, strict=True)}
        motor = mujoco.mjcf_motor(other, theta)
        numbers = {
            "gear": motor.ratio, "motorconst": theta[mujoco.CONSTANT], "resistance": theta[mujoco.RESISTANCE],
            "inductance": motor.inductance, "armature": motor.armature, "frictionloss": motor.friction,
            "damping": theta[mujoco.DAMPING], "current_over_act": theta[mujoco.SHARE],
        }  # fmt: skip
        for name, value in numbers.items():
            drawn_values.setdefault(f"mujoco/{name}", []).append(value)
    law_names = {c.name for c in constants}
    actuator = {f"actuator/{n}": x for n, x in columns.items() if n in law_names}
    return {name: np.asarray(x) for name, x in drawn_values.items()} | actuator


def randomization_files(found: Columns) -> dict[str, str | bytes]:
    """The draws as NumPy's archive."""
    stream = io.BytesIO()
    arrays: Any = dict(found)
    np.savez(stream, **arrays)
    return {"draws.npz": stream.getvalue()}
