"""Formats by name, and the export of a drive to one of them."""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Mapping, Sequence
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
from sweeps.export.comparison import ComparisonRuns, EffectFate, ExportComparison, JointResult, situation_of_joint
from sweeps.export.joint import DriveJoint, joint_of_robot
from sweeps.export.law_source import LawConstant, law_constants, posterior_next_to

#: Names of formats and their uses.
FORMATS = {
    "mujoco": "MJCF with <dcmotor>, and a runnable scene",
    "jax": "an actuator function in JAX, as source and as a serialised program",
    "onnx": "an ONNX model of one time step, for Isaac Lab, Unity or C++",
    "mjlab": "an actuator configuration for law_source, in PyTorch",
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
    posterior = posterior_next_to(drive) if posterior is None else posterior
    runs = situation_of_joint(drive.steady, data)
    constants = law_constants(drive, runs.signals, posterior)
    make = {
        "mujoco": _export_mujoco, "randomization": _export_mujoco, "table": _export_tables,
        "jax": _export_actuator, "onnx": _export_actuator,
        "mjlab": _export_actuator,
    }[to]  # fmt: skip
    empty_export = Export(to, drive, constants, posterior, {}, None, {})  # type: ignore[arg-type]  # filled in below
    return make(empty_export, runs, at, draws, seed)


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


def _export_mujoco(begun: Export, runs: ComparisonRuns, at: str, draws: int, seed: int) -> Export:
    drive = begun.joint
    normal = float(np.mean(np.asarray(runs.signals.normal)))
    compared = comparison.compare_format(
        runs,
        mujoco.mujoco_law_function(normal),
        mujoco.fates_in_mujoco(drive, normal),
        mujoco.TERMS,
        mujoco.approximated_terms,
    )
    motor, name = mujoco.mjcf_motor(drive, compared.refitted), f"{drive.name}_drive"
    notes = mujoco.attribute_notes(drive, begun.constants, compared.translated, compared.refitted)
    mass = float(np.mean(np.asarray(runs.signals.mass)))
    volts = float(drive.robot.motor.voltage_limit or np.max(np.abs(runs.command)))
    middle = middle_run(runs.command, runs.load)
    follows_angle = drive.robot.rig.imposed == "goal_angle"

    def texts_of(drive: DriveJoint) -> dict[str, str]:
        return {
            "drive.xml": mujoco.mjcf_fragment(drive, motor, notes, notes_for_file_head(runs), name, at, volts),
            "scene.xml": mujoco.mjcf_scene(
                drive, mass, name, at, *((GOAL * motor.ratio, 0.0) if follows_angle else middle)
            ),
        }

    texts = texts_of(drive)
    checks = _check_in_mujoco(texts_of(drive.steady), motor, runs, compared)
    if follows_angle or (drive.loose and drive.controller is None):
        command = GOAL if follows_angle else volts
        times = np.linspace(0.0, START, 26)
        controller = drive.controller
        conditions = (
            Conditions(voltage=command)
            if controller is None
            else Conditions(voltage=controller.supply_voltage, goal=command)
        )
        run = drive_batch(
            drive.robot, jax.tree.map(lambda x: jnp.asarray(x, float)[None], conditions), jnp.asarray(times)
        )
        native = np.asarray(run.signals.angle)[0]
        mujoco_angles = mujoco.angles_in_mujoco(texts, command * (motor.ratio if follows_angle else 1.0), times)
        share = 100 * float(np.sqrt(np.mean((mujoco_angles - native) ** 2)) / np.sqrt(np.mean(native**2)))
        checks |= {f"angle over {START:g} s from rest, MuJoCo C against native [%]": share}
    files: Mapping[str, str | bytes] = texts
    if begun.format == "randomization":
        values = draw_parameters(drive, begun.posterior, begun.constants, compared.refitted, normal, draws, seed)
        files = randomization_files(values)
    return dataclasses.replace(begun, files=files, comparison=compared, checks=checks)


def _check_in_mujoco(
    texts: Mapping[str, str], motor: mujoco.MjcfMotor, runs: ComparisonRuns, found: ExportComparison
) -> dict[str, float]:
    """Largest differences of MuJoCo C from the format's law, and errors of both on the same runs [%]."""
    rows = np.unique(np.linspace(0, len(runs.command) - 1, min(CHECKED, len(runs.command))).astype(int))
    mujoco_results = mujoco.settle_in_mujoco(texts, motor, runs, found.exported, rows.tolist())
    law = JointResult(found.exported.current[rows], found.exported.speed[rows])
    native = JointResult(runs.inside.current[rows], runs.inside.speed[rows])

    def apart(a: np.ndarray, b: np.ndarray) -> float:
        return 100 * float(np.sqrt(np.mean((a - b) ** 2)) / np.sqrt(np.mean(b**2)))

    return {
        "runs settled in MuJoCo C": float(len(rows)),
        "current, law against native [%]": apart(law.current, native.current),
        "current, MuJoCo C against native [%]": apart(mujoco_results.current, native.current),
        "speed, law against native [%]": apart(law.speed, native.speed),
        "speed, MuJoCo C against native [%]": apart(mujoco_results.speed, native.speed),
    }


def _export_actuator(begun: Export, runs: ComparisonRuns, at: str, draws: int, seed: int) -> Export:
    drive, constants, notes = begun.joint, begun.constants, notes_for_file_head(runs)
    law = jax_actuator.actuator_law_function(runs, constants)
    effect_names = {e.name: "a function of the law" for e in drive.inside}
    checks: dict[str, float] = {}
    if begun.format == "jax":
        files = jax_actuator.jax_files(drive, constants, notes)
    elif begun.format == "mjlab":
        files = law_source.mjlab_files(drive, constants, notes)
    else:
        files = jax_actuator.onnx_files(drive, constants)
        model: Any = files["actuator.onnx"]
        checks["ONNX against JAX, largest of 10,000 states [relative]"] = jax_actuator.difference_from_jax(
            drive, constants, model
        )
    compared = comparison.compare_format(
        runs, law, jax_actuator.fates_in_actuator(drive), effect_names, mujoco.approximated_terms
    )
    return dataclasses.replace(begun, files=files, comparison=compared, checks=checks)


def _export_tables(begun: Export, runs: ComparisonRuns, at: str, draws: int, seed: int) -> Export:
    drive, constants = begun.joint, begun.constants
    law = feed_forward.table_law_function(runs, constants)
    settled = "its settled value, since a table has no state"
    effect_names = {e.name: "the tables" if e.memory_size is None else settled for e in drive.inside}
    fates: list[EffectFate] = feed_forward.fates_in_tables(drive, constants)
    compared = comparison.compare_format(runs, law, fates, effect_names, mujoco.approximated_terms)
    files = feed_forward.table_files(drive, feed_forward.map_of_drive(runs, constants), notes_for_file_head(runs))
    return dataclasses.replace(begun, files=files, comparison=compared)


#: Smallest and largest number of draws, typical numbers of environments in training.
MOST = 1_000_000


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
