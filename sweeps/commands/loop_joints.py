"""One loop for each joint of a MuJoCo model. Its load is the torque that the model needs for the joint's motion."""

from __future__ import annotations

import dataclasses
import json
import math
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from scipy.interpolate import UnivariateSpline
from scipy.ndimage import maximum_filter1d

from calibration.data import Names
from calibration.data import runs as records
from calibration.data.column_names import check_units
from calibration.data.columns import CURRENT, LOAD, SPEED, Column
from calibration.data.input_errors import BadConfiguration, BadData, allowed_words
from calibration.data.named_arrays import NamedArrays, column_numbers, column_texts
from calibration.data.runs import Runs
from calibration.data.sources import reading
from calibration.data.unused_readings import thin_rows
from calibration.inference.observers import observer_kind
from calibration.inference.series_noise import estimate_noise
from mmrjax.model import channels
from mmrjax.model.quantities import RPM
from mmrjax.model.robot import Robot
from sweeps import config as configuration
from sweeps import store
from sweeps.commands.rig_from_mujoco import read_mujoco_model
from sweeps.console import print_message, print_output
from sweeps.export import mujoco
from sweeps.inputs import load_robot
from sweeps.report import catalogue
from sweeps.report.document import Document

ANGLE = channels.find_channel("output_angle")
#: Placeholder for a joint's name in the name of its robot file.
JOINT = "{joint}"
#: Column of the current's sd.
SD = "motor_current_sd_A"
#: Smallest speed whose direction is certain, in sds of the speed. Smallest change that counts as a jump, in sds.
CERTAIN, JUMP = 2.0, 6.0
#: Temporary columns of a joint's table: error of the torque [A] and smallest certain speed [rpm].
ERROR_COLUMNS = ("error of torque", "least speed")
#: Fewest readings in a run for smoothing its motion.
FEWEST = 12
#: Median of the magnitude of sixth differences of white noise [sd].
QUANTILE = 0.6745 * math.sqrt(math.comb(12, 6))


class Chain:
    """Model whose joints are all hinges, with friction, damping, rotors and contacts removed."""

    def __init__(self, source: Path) -> None:
        """Reads the model from a file.

        Raises:
            BadConfiguration: MuJoCo rejects the model, a joint is no hinge or has several actuators, or equality
                constraints close a loop.
        """
        self.library, self.model = library, model = mujoco.mujoco_module(), read_mujoco_model(source)
        names = [model.joint(k).name for k in range(model.njnt)]
        on_joint = (library.mjtTrn.mjTRN_JOINT, library.mjtTrn.mjTRN_JOINTINPARENT)
        driven = list(model.actuator_trnid[np.isin(model.actuator_trntype, on_joint), 0])
        for k, name in enumerate(names):
            if model.jnt_type[k] != library.mjtJoint.mjJNT_HINGE or not name:
                raise BadConfiguration(f"--model: {source.name}, joint {name or k + 1} is no named hinge")
            if driven.count(k) > 1:
                raise BadConfiguration(
                    f"--model: {source.name}, joint {name} has several actuators; expected one drive per joint"
                )
        if model.neq or not names:
            obstacle = "closed loops (<equality>)" if names else "no joint"
            raise BadConfiguration(f"--model: {source.name} has {obstacle}; expected a chain or tree of hinges")
        self.names: Names = tuple(names)
        self.driven: Names = tuple(names[k] for k in sorted(driven))
        for values in (model.dof_damping, model.dof_frictionloss, model.dof_armature):
            values[:] = 0.0
        model.opt.disableflags |= int(library.mjtDisableBit.mjDSBL_CONSTRAINT)

    def torques(self, motion: np.ndarray) -> np.ndarray:
        """Torque for the motion of each joint [N·m], shape (rows, joints).

        Args:
            motion: angles [rad], speeds and accelerations, shape (3, rows, joints).
        """
        data, torques = self.library.MjData(self.model), np.empty_like(motion[0])
        for row in range(len(torques)):
            data.qpos[:], data.qvel[:], data.qacc[:] = motion[:, row]
            self.library.mj_inverse(self.model, data)
            torques[row] = data.qfrc_inverse
        return torques


def smoothed_motion(time: np.ndarray, angle: np.ndarray, times: np.ndarray, degree: int) -> tuple[np.ndarray, int]:
    """Motion at `times` on a smoothing spline, shape (3, times), and the number of the spline's knots.

    The motion is the angle [rad], the speed and the acceleration. The spline has the fewest knots with which its
    residuals equal the noise. If most readings repeat others, this noise is at least that of the display's step.
    Knots are dense at jumps of the torque, so that the acceleration jumps within a few samples.
    """
    # Second differences, as in `estimate_noise`, would contain 0.1 mrad from the curvature of a 200 Hz log.
    noise = float(np.nanmedian(np.abs(np.diff(angle, 6)))) / QUANTILE
    steps = np.diff(np.unique(np.round(angle, 9)))
    if 0 < len(steps) < len(angle) / 2:
        noise = max(noise, steps.min() / math.sqrt(12))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # more knots would be needed, for readings without noise
        curve = UnivariateSpline(time, angle, k=degree, s=len(time) * noise**2)
    return np.stack([curve(times), *(curve.derivative(n)(times) for n in (1, 2))]), len(curve.get_knots())


def columns_of_joint(log: NamedArrays, joint: str, joints: Names) -> NamedArrays:
    """Columns of a log for one joint, with the joint's name removed, and columns of no joint."""
    other_prefixes = tuple(f"{name}." for name in joints if name != joint)
    joint_columns = [k for k, column in enumerate(log.header) if not column.startswith(other_prefixes)]
    return dataclasses.replace(
        log,
        name=f"{log.name}, joint {joint}",
        header=tuple(log.header[k].removeprefix(f"{joint}.") for k in joint_columns),
        values=tuple(log.values[k] for k in joint_columns),
        units=tuple(log.units[k] for k in joint_columns if log.units),
    )


def smoothed_log(log: NamedArrays, chain: Chain) -> tuple[np.ndarray, np.ndarray, int]:
    """`smoothed_motion` of all joints at each row of a log, by splines of degree 5 and of degree 3.

    Both have the shape (3, rows, joints). The largest number of knots of a joint at degree 5 follows.

    Raises:
        BadData: the log has no `time_s`, lacks the angle of a joint, or has too few readings of it in a run. Also as
            in `check_units`.
    """
    motion, cubic = np.empty((2, 3, len(log), len(chain.names)))
    knots = np.zeros(len(chain.names), int)
    for k, name in enumerate(chain.names):
        joint = columns_of_joint(log, name, chain.names)
        columns, units = dict(zip(joint.header, joint.values, strict=True)), ANGLE.columns()
        column = next((c for c in units if c in columns), None)
        clock = columns.get("time_s")
        if column is None or clock is None:
            lacking = "time_s" if column else " or ".join(f"{name}.{c}" for c in units)
            raise BadData(f"{log.name}: has no column {lacking}; expected time_s and the angle of each joint")
        check_units(joint, [Column(ANGLE, c, units[c]) if c in units else None for c in joint.header])
        time = column_numbers(clock)
        angle = math.radians(ANGLE.units[units[column]]) * column_numbers(columns[column])
        runs = np.array(column_texts(columns["run_id"]) if "run_id" in columns else [""] * len(log))
        for run in np.unique(runs):
            rows = np.flatnonzero(runs == run)
            finite_rows = rows[np.isfinite(angle[rows])]
            if len(finite_rows) < FEWEST or not (np.diff(time[finite_rows]) > 0).all():
                raise BadData(
                    f"{log.name}, {name}.{column}: has {len(finite_rows)} readings in run {run or 1}; expected at "
                    f"least {FEWEST} with increasing time_s"
                )
            readings = time[finite_rows], angle[finite_rows], time[rows]
            motion[:, rows, k], knot_count = smoothed_motion(*readings, degree=5)
            cubic[:, rows, k], _ = smoothed_motion(*readings, degree=3)
            knots[k] += knot_count
    return motion, cubic, int(knots.max())


def runs_of_joints(log: NamedArrays, chain: Chain, robots: Mapping[str, Robot]) -> dict[str, Runs]:
    """Runs of each joint, with the torque of the rest of the model as the torque of its load.

    It is the torque of the model minus the torque of inertia and weight in the joint's file. The motor speed is that
    of the smoothed motion. Errors of both are largest where the torque jumps: within two knots of a jump they are
    about the difference from a cubic spline. Within one knot of a jump of the current, the error of the torque is up
    to that jump. This error is included in the current's sd, unless the log states the sd. If it exceeds the
    current's noise, one row per knot is used. Readings are omitted if the direction of the speed is uncertain,
    because friction in the wrong direction would count as an error.

    Args:
        robots: robot of each joint, by the joint's name.

    Raises:
        BadData: as in `smoothed_log` and `runs.runs_of_arrays`.
    """
    motion, cubic, knots = smoothed_log(log, chain)
    torques, cubic_torques = chain.torques(motion), chain.torques(cubic)
    rows_per_knot = round(len(log) / knots)  # rows from knot to knot
    errors = [
        maximum_filter1d(np.abs(x), 4 * rows_per_knot + 1, axis=0)
        for x in (torques - cubic_torques, motion[1] - cubic[1])
    ]
    runs = {}
    for name, robot in robots.items():
        k, (load,) = chain.names.index(name), robot.configurations.members
        joint = columns_of_joint(log, name, chain.names)
        angle, speed, acceleration = motion[:, :, k]
        ratio = float(robot.gearbox.ratio)
        per_ampere = ratio * float(robot.gearbox.efficiency_load * robot.motor.torque_constant)
        columns = {
            LOAD: torques[:, k] - float(load.inertia) * acceleration - np.asarray(load.torque_load(angle)),
            SPEED: speed * ratio / RPM,
            **{
                ERROR_COLUMNS[0]: errors[0][:, k] / per_ampere,
                ERROR_COLUMNS[1]: CERTAIN * errors[1][:, k] * ratio / RPM,
            },
        }
        table = records.runs_of_arrays(joint.with_columns(columns), robot=robot)
        torque_error, least_speed = (table.extras[c] for c in ERROR_COLUMNS)
        (noise,) = estimate_noise(table, sizes := observer_kind(table).sizes(table))
        noise_sd = np.zeros(len(table)) if noise is None else noise.sd(sizes[:, 0])
        change = np.abs(np.diff(table[CURRENT], prepend=np.nan))
        jump = np.where(change > JUMP * noise_sd, change, 0.0)
        current_sd = np.sqrt(maximum_filter1d(jump, 2 * rows_per_knot + 1) ** 2 + torque_error**2 + noise_sd**2)
        is_certain = np.abs(table[SPEED]) > least_speed
        columns = {SD: current_sd, **table.columns, CURRENT: np.where(is_certain, table[CURRENT], np.nan)}
        note = (
            f"{joint.name}: {np.sum(~is_certain)} of {len(table)} readings of the current are left out, because the "
        )
        table = dataclasses.replace(
            table,
            columns=columns,
            unknown=tuple(c for c in table.unknown if c not in ERROR_COLUMNS),
            extras={c: x for c, x in table.extras.items() if c not in ERROR_COLUMNS},
            notes=(*table.notes, f"{note}direction of the speed is uncertain"),
        )
        runs[name] = thin_rows(table, knots) if np.median(torque_error) > np.median(noise_sd) else table
    return runs


def robot_of_joint(config: configuration.Loop, joint: str) -> tuple[configuration.Loop, Robot]:
    """Configuration of a joint's loop, and the robot.

    Raises:
        BadConfiguration: the file does not exist, or it is no rig of one shaft with imposed motor speed and measured
            current.
    """
    robot_name = f"{JOINT}.toml" if config.robot == "nominal" else config.robot
    joint_config = config.model_copy(update={"robot": robot_name.replace(JOINT, joint), "joints": (joint,)})
    robot = load_robot(joint_config).robot
    rig, is_shaft = robot.rig, not robot.has_ground and len(robot.configurations.members) == 1
    if not is_shaft or (rig.imposed, rig.channels) != ("motor_speed", ("motor_current",)):
        raise BadConfiguration(
            f'--robot {joint_config.robot}: expected the rig of one joint with load = "shaft", imposed = '
            f'"motor_speed" and channels = ["motor_current"]; mmrjax rig new {joint}.toml --from {config.model} '
            f"--joint {joint} --kind bench writes a template"
        )
    return joint_config, robot


def run_joints(
    config: configuration.Loop,
    options: configuration.LoopBeside,
    loop: Callable[[configuration.Loop, configuration.LoopBeside, Robot, Runs], int],
) -> int:
    """Runs the loop of each joint in its own folder, and writes one page. Finished joints are kept.

    Args:
        loop: function that runs the loop of one joint.

    Returns:
        Largest exit code of the joints.

    Raises:
        BadConfiguration: the model lacks a joint, or nothing drives it. Also as in `Chain` and `robot_of_joint`.
        BadData: the file does not exist, or as in `runs_of_joints`.
    """
    assert config.model is not None
    chain, data = Chain(config.model), Path(options.data)
    joint_names = chain.driven if config.joints == ("all",) else config.joints
    unknown = next((name for name in joint_names if name not in chain.names), "" if joint_names else "all")
    if unknown:
        raise BadConfiguration(
            f"--joints: got {unknown}; {config.model.name} has no such driven joint; "
            f"{allowed_words(unknown, chain.names)}"
        )
    robots = {name: robot_of_joint(config, name) for name in joint_names}
    if not data.is_file():
        raise BadData(f"{data}: no such file; expected a log of the joints of {config.model.name}")
    log = reading.read_whole_table(data)
    runs = runs_of_joints(log, chain, {name: robot for name, (_, robot) in robots.items()})
    folder = options.out or store.default_path("loop")
    code, rows = 0, []
    for name, (joint_config, robot) in robots.items():
        run_folder, table = folder / name, runs[name]
        is_finished = not options.force and store.is_finished(
            run_folder, store.run_identity("loop", joint_config, robot, table)
        )
        print_message(f"joint {name}{f': finished in {run_folder}, kept' if is_finished else ''}")
        for note in table.notes:
            print_message(note)
        if not is_finished:
            code = max(code, loop(joint_config, options.model_copy(update={"out": run_folder}), robot, table))
        rows.append(_row(name, run_folder))
    answer = " ".join(f"{name}: {answer}" for name, answer, *_ in rows)
    document = Document(f"Joints of {config.model.name}", answer, (catalogue.table("loop.joints", rows),))
    store.print_report(document)(folder)
    print_output(str(folder))
    return code


def _row(joint: str, folder: Path) -> tuple[str, str, str, str]:
    """Row of a joint: its name, answer, held-out errors and page."""
    if not (folder / "result.json").is_file():
        screening = folder.with_name(f"{joint}.partial") / store.SCREENING_FILE
        answer = json.loads(screening.read_text(encoding="utf-8"))["answer"] if screening.is_file() else ""
        return joint, f"no verdict in time. The same command continues. So far: {answer}.", "", ""
    result: Mapping = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    held_out = (result["errors"][fit]["held_out"] for fit in ("before", "after"))
    percent = [next(iter(x.values()))["rms_percent"] if x else None for x in held_out]  # of the current
    errors = "" if None in percent else " → ".join(f"{x:.3g}" for x in percent)
    return joint, result["statement"], errors, f"{joint}/report.html"
