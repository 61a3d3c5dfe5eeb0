"""A rig's file from a simulator's model: `rig new --from model.xml --joint J`, the way back from `export`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data.input_errors import BadConfiguration, allowed_words
from calibration.data.input_files import file_bytes
from sweeps.export import mujoco

#: Largest model that is read [bytes].
LARGEST = 2**26
#: Least torque of gravity that counts as an arm [N·m].
LEAST_WEIGHT = 1e-9


def rig_text_from_model(source: Path, joint: str | None) -> str:
    """Text of a rig's file for one driven joint of a model.

    Args:
        source: the model; joint: name of the joint, None: the only one that a motor drives.

    Raises:
        BadConfiguration: a file that is no model of a known format, or a joint that it does not have or drive.
    """
    reader = READERS.get(source.suffix.lower())
    if reader is None:
        raise BadConfiguration(f"--from: got {source}; expected a model that ends with {', '.join(READERS)}")
    file_bytes(source, source, BadConfiguration, LARGEST)
    return reader(source, joint)


def of_mujoco(source: Path, joint: str | None) -> str:
    """The rig of a joint that a `<dcmotor>` of MuJoCo drives."""
    library = mujoco.mujoco_module()
    try:
        model = library.MjModel.from_xml_path(str(source))
    except ValueError as error:
        raise BadConfiguration(f"{source}: MuJoCo does not read it ({' '.join(str(error).split())})") from error
    name_of = lambda kind, k: library.mj_id2name(model, kind, k) or ""  # noqa: E731
    joints = [name_of(library.mjtObj.mjOBJ_JOINT, k) for k in range(model.njnt)]
    dc = int(library.mjtGain.mjGAIN_DCMOTOR)
    on_joint = [int(library.mjtTrn.mjTRN_JOINT), int(library.mjtTrn.mjTRN_JOINTINPARENT)]
    drives = {
        joints[model.actuator_trnid[k, 0]]: k
        for k in range(model.nu)
        if model.actuator_gaintype[k] == dc and model.actuator_trntype[k] in on_joint
    }
    if joint is None:
        if len(drives) != 1:
            found = f"drives {', '.join(drives)}" if drives else "has no <dcmotor> on a joint"
            raise BadConfiguration(f"--joint: missing, and {source} {found}; expected the name of one driven joint")
        joint = next(iter(drives))
    if joint not in joints:
        raise BadConfiguration(
            f"--joint: got {joint}; {source} has no such joint; {allowed_words(joint, filter(None, joints))}"
        )
    if joint not in drives:
        raise BadConfiguration(
            f"--joint: got {joint}, which no <dcmotor> of {source} drives, so its winding is not known; "
            f"{allowed_words(joint, drives) if drives else 'expected a model with a <dcmotor>'}"
        )
    which = joints.index(joint)
    if model.jnt_type[which] != int(library.mjtJoint.mjJNT_HINGE):
        raise BadConfiguration(f"--joint: got {joint}, which slides or is free; expected a hinge")
    return _written(source, joint, _Drive(library, model, which, drives[joint]))


#: Reader of a model by how its file's name ends.
READERS: dict[str, Callable[[Path, str | None], str]] = {".xml": of_mujoco}


class _Drive:
    """Numbers of a driven joint [SI].

    Attributes: as of the rig's file; effects: name → fields of the effects given by the actuator's terms.
    """

    def __init__(self, library: Any, model: Any, joint: int, actuator: int) -> None:
        gain, dynamic, bias = (
            x[actuator] for x in (model.actuator_gainprm, model.actuator_dynprm, model.actuator_biasprm)
        )
        dof, self.ratio = model.jnt_dofadr[joint], float(model.actuator_gear[actuator, 0])
        self.resistance, self.constant = float(gain[0]), float(gain[1])
        self.inductance = float(dynamic[0]) * self.resistance
        armature = float(model.dof_armature[dof])
        self.rotor = armature / self.ratio**2
        self.friction, self.damping = float(model.dof_frictionloss[dof]), float(np.ravel(model.dof_damping[dof])[0])
        self.voltage = float(np.max(np.abs(model.actuator_ctrlrange[actuator])))
        self.limit: float | None = None
        if model.actuator_forcelimited[actuator]:
            self.limit = float(np.max(np.abs(model.actuator_forcerange[actuator]))) / self.constant
        self.effects: dict[str, dict[str, float]] = {}
        self._effects(dynamic, bias)
        self._load(library, model, joint, dof, armature)

    def _effects(self, dynamic: Sequence[float], bias: Sequence[float]) -> None:
        resistance_thermal, capacity, stiffness = (float(dynamic[k]) for k in (2, 3, 5))
        amplitude, ripples, phase, coulomb, static, fade = (float(x) for x in bias[:6])
        if resistance_thermal > 0:
            self.effects["thermal_drift"] = {
                "amplitude": 1.0, "resistance_thermal": resistance_thermal,
                "time_constant": resistance_thermal * capacity,
            }  # fmt: skip
        if amplitude:
            self.effects["cogging"] = {"amplitude": -amplitude, "ripples": ripples, "phase": phase}
        if stiffness > 0:  # of the motor's shaft, here at the joint
            self.friction += coulomb * self.ratio
            turn = static / stiffness / self.ratio
            self.effects["presliding"] = {"amplitude": coulomb * self.ratio, "angle_breakaway": turn}
            if static > coulomb:
                excess = (static - coulomb) * self.ratio
                speed = {"speed_fade": fade / self.ratio, "exponent": 2.0}
                self.effects["stribeck_exponent"] = {"amplitude": excess, **speed}

    def _load(self, library: Any, model: Any, joint: int, dof: int, armature: float) -> None:
        """Inertia of what turns and torque of its weight, other joints at rest in the reference pose."""
        data, place = library.MjData(model), model.jnt_qposadr[joint]
        weights = []
        for angle in (0.0, np.pi / 2):
            data.qpos[place] = model.qpos0[place] + angle
            library.mj_forward(model, data)
            weights.append(float(data.qfrc_bias[dof]))
        data.qpos[place] = model.qpos0[place]
        library.mj_forward(model, data)
        mass = np.zeros((model.nv, model.nv))
        library.mj_fullM(model, mass, data.qM) if hasattr(data, "qM") else library.mj_fullM(model, data, mass)
        self.inertia = float(mass[dof, dof]) - armature
        # The weight acts against forward rotation as M sin(θ - θ_0).
        self.weight = float(np.hypot(weights[0], weights[1]))
        self.angle = float(np.arctan2(-weights[0], weights[1])) if self.weight > LEAST_WEIGHT else 0.0


def _written(source: Path, joint: str, drive: _Drive) -> str:
    number = lambda x: repr(float(f"{x:.15g}"))  # noqa: E731
    lines = [
        f"# The joint {joint} of {source.name}, as MuJoCo computes it: the gearbox has no loss in proportion to the",
        "# load, and the current is that of the actuator. If you know them, state an efficiency and the resistance.",
        "# Next: mmrjax rig check THIS_FILE [DATA.csv], with what your instruments show in channels.",
        'schema = "mmrjax.robot/2"',
        'base = "none"',
        "sides = 1",
        'imposed = "voltage"',
        'channels = ["total_current", "motor_speed"]',
        'start = "rest"',
        "",
    ]
    if drive.limit is not None:
        lines += ["[driver]", f"current_limit = {number(drive.limit)}  # [A] forcerange over motorconst", ""]
    lines += [
        "[motor]",
        f"resistance = {number(drive.resistance)}  # [ohm] resistance",
        f"torque_constant = {number(drive.constant)}  # [N·m/A] motorconst",
        f"inductance = {number(drive.inductance)}  # [H] inductance" if drive.inductance > 0 else "# no inductance",
        f"inertia = {number(drive.rotor)}  # [kg·m^2] armature over gear squared",
    ]
    if drive.voltage > 0:
        lines.append(f"voltage_limit = {number(drive.voltage)}  # [V] ctrlrange")
    lines += [
        "",
        "[gearbox]",
        f"ratio = {number(drive.ratio)}  # [-] gear",
        "efficiency_load = 1.0  # [-] MuJoCo's joint has no such loss",
        "",
        "[joint]",
        'load = "shaft"',
        f"inertia = {number(drive.inertia)}  # [kg·m^2] of what turns with the joint, without its armature",
        f"loss_coulomb = {number(drive.friction)}  # [N·m] frictionloss and lugre",
        f"loss_viscous = {number(drive.damping)}  # [N·m·s] damping",
    ]
    if drive.weight > LEAST_WEIGHT:
        lines += [
            f"torque_gravity = {number(drive.weight)}  # [N·m] largest torque of its weight",
            f"angle_zero = {number(drive.angle)}  # [rad] where it hangs",
        ]
    for name, fields in drive.effects.items():
        lines += ["", f"[effects.{name}]", *(f"{key} = {number(value)}" for key, value in fields.items())]
    return "\n".join(lines) + "\n"
