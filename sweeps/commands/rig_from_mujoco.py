"""Numbers of a driven joint of a MuJoCo model, the inverse of `export --to mujoco`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from calibration.data.input_errors import BadConfiguration
from calibration.data.input_files import VALUE, check_memory, file_bytes, first_bytes
from calibration.data.named_arrays import cell_number
from sweeps.commands.rig_numbers import (
    LEVEL,
    JointNumbers,
    NumberWithSource,
    StatedNumber,
    choose_joint,
    equal_wheels,
    hanging_torque_and_angle,
    is_round,
)
from sweeps.export import mujoco

#: Largest model file that is read [bytes].
LARGEST = 2**26
#: Elements that include files of the same format, and attributes that name folders.
NESTED, FOLDERS = ("include",), ("meshdir", "texturedir", "assetdir")
#: Attributes that are not numbers.
NAMES = ("name", "class", "childclass", "file")
#: Elements that replicate their content, and attributes with sizes of elements.
COPIES = ("replicate", "composite", "flexcomp")
SIZES = {
    **dict.fromkeys(COPIES, ("count",)), "numeric": ("size",), "hfield": ("nrow", "ncol"),
    "texture": ("width", "height"), "mesh": ("params",), "user": ("dim",), "general": ("actdim", "nsample"),
}  # fmt: skip
#: Most copies of an element, most elements including copies, and largest product of the sizes of an element.
MOST_COPIES, MOST_ELEMENTS, MOST_CELLS = 2_000, 50_000, 2**24


def read_mujoco_hinge(source: Path, joint: str | None) -> JointNumbers:
    """Numbers of a hinge. Defaults are resolved by MuJoCo's compiler.

    A `<dcmotor>` on the hinge supplies winding and effects.

    Args:
        source: the model.
        joint: name of the joint. None: the only driven one.

    Raises:
        BadConfiguration: MuJoCo rejects the model, or the joint is missing or no hinge.
    """
    return _MujocoModel(mujoco.mujoco_module(), read_mujoco_model(source), source.name).numbers(joint)


def read_mujoco_model(source: Path) -> Any:
    """Model of a file, compiled by MuJoCo.

    Raises:
        BadConfiguration: MuJoCo rejects the model.
    """
    check_mujoco_model(source)
    try:
        model = mujoco.mujoco_module().MjModel.from_xml_path(str(source))
    except (ValueError, RuntimeError) as error:
        raise BadConfiguration(f"{source}: MuJoCo cannot read it ({' '.join(str(error).split())})") from error
    check_memory(source, VALUE * model.nv**2)  # of its inertia matrix
    return model


def check_mujoco_model(source: Path) -> None:
    """Rejects a model for which MuJoCo's compiler would not terminate, before it starts.

    Raises:
        BadConfiguration: a number is not finite, there are too many copies, elements or cells, or a file is a pipe or
            a device.
    """
    pending, roots = [source], dict[Path, Element]()
    while pending:
        file = pending.pop().resolve()
        text = file_bytes(file, file, BadConfiguration, LARGEST)
        try:
            roots[file] = ElementTree.fromstring(text)
        except (ElementTree.ParseError, ValueError, LookupError) as error:
            raise BadConfiguration(f"{file}: not a readable XML file ({error}); expected MuJoCo's XML") from error
        file_names = [element.get("file", "") for tag in NESTED for element in roots[file].iter(tag)]
        model_files = {
            (base / name).resolve() for name in file_names if name for base in (source.parent, file.parent)
        }
        pending += [path for path in model_files if path.exists() and path not in roots]
    compilers = [element for root in roots.values() for element in root.iter("compiler")]
    folders = [element.get(key, "") for element in compilers for key in FOLDERS]
    count = 0
    for file, root in roots.items():
        stack = [(root, 1)]
        while stack:
            element, copies = stack.pop()
            copies *= _check_attributes(element, file, source.parent, ("", *folders))
            count += copies
            if count > MOST_ELEMENTS:
                raise BadConfiguration(f"{source}: has more than {MOST_ELEMENTS:,} elements; expected fewer")
            stack += [(child, copies) for child in element]


def _check_attributes(element: Element, file: Path, folder: Path, folders: Sequence[str]) -> int:
    """Number of copies that an element makes of its content, after its numbers and files are checked.

    Args:
        folder: folder of the model.
        folders: its subfolders that may contain files.
    """
    tag, place_words, sizes = element.tag, f"{file}, <{element.tag}>", [1.0]
    for key, text in element.attrib.items():
        words = [] if key in NAMES else text.casefold().split()
        numbers = [x for x in map(cell_number, words) if math.isfinite(x)]
        if "nan" in (word.lstrip("+-") for word in words):
            raise BadConfiguration(f"{place_words} {key}: got {text}; expected numbers")
        if tag == "size" and key.startswith(("nuser", "nkey")) and max(numbers, default=0) > MOST_COPIES:
            raise BadConfiguration(f"{place_words} {key}: got {text}; expected at most {MOST_COPIES:,}")
        if key in SIZES.get(tag, ()):
            sizes.append(math.prod(max(x, 1.0) for x in numbers))
        for base in folders if key.startswith("file") else ():
            if (path := folder / base / text).exists():
                first_bytes(path, path, BadConfiguration, 1)
    copies_or_cells = math.prod(sizes)
    if copies_or_cells > (most := MOST_COPIES if tag in COPIES else MOST_CELLS):
        raise BadConfiguration(f"{place_words}: got a size of {copies_or_cells:,.0f}; expected at most {most:,}")
    return int(copies_or_cells) if tag in COPIES else 1


class _MujocoModel:
    def __init__(self, library: Any, model: Any, file: str) -> None:
        self.library, self.model, self.file = library, model, file
        self.data = library.MjData(model)
        library.mj_forward(model, self.data)
        self.joints = [model.joint(k).name for k in range(model.njnt)]
        on_joint = (library.mjtTrn.mjTRN_JOINT, library.mjtTrn.mjTRN_JOINTINPARENT)
        self.is_motor = model.actuator_gaintype == library.mjtGain.mjGAIN_DCMOTOR
        of_joints = np.flatnonzero(np.isin(model.actuator_trntype, on_joint))
        #: Actuator of each driven joint, a `<dcmotor>` before others.
        self.actuators = {
            int(model.actuator_trnid[k, 0]): int(k) for k in sorted(of_joints, key=lambda k: (self.is_motor[k], -k))
        }

    def _chosen(self, joint: str | None) -> int:
        turns = self.model.jnt_type == self.library.mjtJoint.mjJNT_HINGE
        hinges = {name: k for k, name in enumerate(self.joints) if turns[k] and name}
        driven = [name for name, k in hinges.items() if k in self.actuators]
        joint = choose_joint(joint, self.joints, list(hinges), driven, self.file, "named hinge")
        if joint not in hinges:
            raise BadConfiguration(f"--joint: got {joint}, a slide or free joint; expected a hinge")
        return hinges[joint]

    def numbers(self, name: str | None) -> JointNumbers:
        joint = self._chosen(name)
        model, library, joint_words = self.model, self.library, f"joint {self.joints[joint]}"
        dof = model.jnt_dofadr[joint]
        armature = float(model.dof_armature[dof])
        inertia, weight = self._load(joint, dof, armature)
        if not 0 < inertia < math.inf:
            raise BadConfiguration(f"{self.file}, {joint_words}: no mass turns with it; expected an inertia")
        actuator = self.actuators.get(joint)
        gear = 1.0 if actuator is None else abs(float(model.actuator_gear[actuator, 0]))
        drive: dict[str, StatedNumber] = {}
        if actuator is not None and self.is_motor[actuator]:
            drive = _dc_motor(model, actuator, dof, gear, self.file)
        root = model.body_rootid[model.jnt_bodyid[joint]]
        is_free = model.jnt_type == library.mjtJoint.mjJNT_FREE
        radius = self._radius(joint)
        is_level = abs(float(self.data.xaxis[joint][2])) <= LEVEL
        rolls = bool((is_free & (model.jnt_bodyid == root)).any()) and radius is not None and is_level
        weight = None if rolls else weight
        losses = {
            "friction": (model.dof_frictionloss[dof], "frictionloss"),
            "damping": (np.ravel(model.dof_damping[dof])[0], "damping"),
            "armature": (armature, "armature"),
        }
        numbers = {
            "mass": (float(model.body_subtreemass[root]), "mass of its body tree"),
            "sides": self._sides(joint, radius[0]) if rolls and radius is not None else None,
            "radius": radius,
            "inertia": (inertia, f"{joint_words}, inertia that turns with it, without armature"),
            "ratio": (gear, f"{joint_words}, gear of its actuator") if gear > 1 or drive else None,
            "weight": None if weight is None else (weight[0], f"{joint_words}, largest torque from its weight"),
            "angle": None if weight is None else (weight[1], f"{joint_words}, hanging position"),
            **{key: (float(x), f"{joint_words}, {what}") if x else None for key, (x, what) in losses.items()},
        }
        return JointNumbers(self.file, self.joints[joint], rolls, numbers, drive)

    def _load(self, joint: int, dof: int, armature: float) -> tuple[float, tuple[float, float] | None]:
        """Inertia of the rotating parts, and their weight as `hanging`, with other joints in the reference pose."""
        model, data, position_index = self.model, self.data, self.model.jnt_qposadr[joint]
        weights = []
        for angle in (np.pi / 2, 0.0):
            data.qpos[position_index] = model.qpos0[position_index] + angle
            self.library.mj_forward(model, data)
            weights.append(-float(data.qfrc_bias[dof]))
        mass = np.zeros((model.nv, model.nv))
        full = self.library.mj_fullM
        full(model, mass, data.qM) if hasattr(data, "qM") else full(model, data, mass)
        return float(mass[dof, dof]) - armature, hanging_torque_and_angle(weights[1], weights[0])

    def _radius(self, joint: int) -> NumberWithSource | None:
        """Radius of the largest cylinder or sphere about the axis, from collision geometry if there is any."""
        model, data, geom_types = self.model, self.data, self.library.mjtGeom
        welded = model.body_weldid[model.jnt_bodyid[joint]]
        radii: list[tuple[bool, float, str]] = []
        for k in range(model.ngeom):
            kind = int(model.geom_type[k])
            is_rigid = model.body_weldid[model.geom_bodyid[k]] == welded
            if not is_rigid or kind not in (geom_types.mjGEOM_CYLINDER, geom_types.mjGEOM_SPHERE):
                continue
            cylinder_axis = data.geom_xmat[k].reshape(3, 3)[:, 2] if kind == geom_types.mjGEOM_CYLINDER else None
            radius, centre = float(model.geom_size[k, 0]), data.geom_xpos[k] - data.xanchor[joint]
            if is_round(centre, data.xaxis[joint], radius, cylinder_axis):
                shape = "sphere" if cylinder_axis is None else "cylinder"
                collides = bool(model.geom_contype[k] or model.geom_conaffinity[k])
                radii.append((collides, radius, " ".join(filter(None, ("geom", model.geom(k).name, f"({shape})")))))
        return max(radii)[1:] if radii else None

    def _sides(self, joint: int, radius: float) -> NumberWithSource:
        """Number of driven wheels like that of a joint, including its own."""
        kinds, driven = self.model.jnt_type, joint in self.actuators
        candidates = [k for k in range(len(kinds)) if kinds[k] == kinds[joint] and (k in self.actuators) == driven]
        axes = self.data.xaxis
        return equal_wheels(radius, axes[joint], ((self.joints[k], self._radius(k), axes[k]) for k in candidates))


def _dc_motor(model: Any, actuator: int, dof: int, ratio: float, file: str) -> dict[str, StatedNumber]:
    """Numbers of a `<dcmotor>` by dotted name. Losses of its bristles act at the joint."""
    parameter_rows = (model.actuator_gainprm, model.actuator_dynprm, model.actuator_biasprm)
    gain, dynamic, bias = (x[actuator] for x in parameter_rows)
    resistance, constant = float(gain[0]), float(gain[1])
    effects = _effects(dynamic, bias, ratio)
    friction = float(model.dof_frictionloss[dof]) + (float(bias[3]) * ratio if float(dynamic[5]) > 0 else 0.0)
    number = lambda value, unit, what, width="": StatedNumber(float(value), unit, f"{file}, {what}", width)  # noqa: E731
    numbers = {
        "motor.resistance": number(resistance, "ohm", "<dcmotor> resistance", "10 %"),
        "motor.torque_constant": number(constant, "N·m/A", "<dcmotor> motorconst", "10 %"),
        "motor.inertia": number(float(model.dof_armature[dof]) / ratio**2, "kg·m^2", "armature / gear²", "50 %"),
        "motor.friction_coulomb": number(0.0, "N·m", "all friction is at the joint"),
        "motor.friction_viscous": number(0.0, "N·m·s", "all damping is at the joint"),
        "gearbox.efficiency_load": number(1.0, "-", "no loss proportional to the torque"),
        "load.loss_coulomb": number(friction, "N·m", "frictionloss and lugre of the joint", "100 %"),
        "load.loss_viscous": number(np.ravel(model.dof_damping[dof])[0], "N·m·s", "damping of the joint", "100 %"),
    }
    inductance = float(dynamic[0]) * resistance
    voltage = float(np.max(np.abs(model.actuator_ctrlrange[actuator])))
    if inductance > 0:
        numbers["motor.inductance"] = number(inductance, "H", "<dcmotor> inductance", "50 %")
    if voltage > 0:
        numbers["motor.voltage_limit"] = number(voltage, "V", "<dcmotor> ctrlrange")
    if model.actuator_forcelimited[actuator]:
        limit = float(np.max(np.abs(model.actuator_forcerange[actuator]))) / constant
        numbers["driver.current_limit"] = number(limit, "A", "<dcmotor> saturation / motorconst")
    for name, fields in effects.items():
        numbers |= {f"effects.{name}.{key}": number(value, "SI", "<dcmotor>") for key, value in fields.items()}
    return numbers


def _effects(dynamic: Sequence[float], bias: Sequence[float], ratio: float) -> dict[str, dict[str, float]]:
    """Effects of a `<dcmotor>`: name → fields."""
    fields_by_effect: dict[str, dict[str, float]] = {}
    resistance_thermal, capacity, stiffness = (float(dynamic[k]) for k in (2, 3, 5))
    amplitude, ripples, phase, coulomb, static, fade = (float(x) for x in bias[:6])
    if resistance_thermal > 0:
        fields_by_effect["thermal_drift"] = {
            "amplitude": 1.0, "resistance_thermal": resistance_thermal,
            "time_constant": resistance_thermal * capacity,
        }  # fmt: skip
    if amplitude:
        fields_by_effect["cogging"] = {"amplitude": -amplitude, "ripples": ripples, "phase": phase}
    if stiffness > 0:  # from the motor shaft to the joint
        fields_by_effect["presliding"] = {"amplitude": coulomb * ratio, "angle_breakaway": static / stiffness / ratio}
        if static > coulomb:
            excess = (static - coulomb) * ratio
            fields_by_effect["stribeck_exponent"] = {"amplitude": excess, "speed_fade": fade / ratio, "exponent": 2.0}
    return fields_by_effect
