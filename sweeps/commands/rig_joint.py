"""Numbers of a driven joint of a model, and the lines of a rig file that follow from them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import numpy as np

from calibration.data.input_errors import BadConfiguration, allowed_words
from sweeps.commands.rig_template import StatedNumber

#: Number, and the element of the model that states it.
Found = tuple[float, str]

#: Kinds of rig on the ground, and kinds for a joint that turns.
VEHICLES = ("wheeled", "tracked")
TURNING = (*VEHICLES, "bench", "dyno", "pendulum", "servo")
#: Smallest gravity torque that counts as an arm [N·m].
LEAST_WEIGHT = 1e-9
#: Largest distance between wheel centre and joint axis, as a share of the radius, and largest sine between the axes.
OFF_AXIS = 0.02
#: Upper limit of a loss that the model does not state, as a share of the stall torque.
UNSTATED = 0.05
#: Sd of each number: models round masses and guess losses.
WIDTHS = {
    "mass": "20 %", "radius": "5 %", "inertia": "50 %", "ratio": "5 %", "armature": "50 %", "friction": "100 %",
    "damping": "100 %", "weight": "20 %", "angle": "0.1",
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class JointNumbers:
    """Numbers of a joint and its load [SI]. None if the model has no value.

    Attributes:
        file, joint: names of the file and the joint.
        rolls: True if the joint turns a wheel of a body that is free to move.
        mass: mass of the whole model.
        sides: number of equal joints, such as wheels on both sides.
        inertia: moment of inertia about the joint's axis of everything that turns with it, without `armature`.
        radius: radius of the wheel.
        ratio: motor turns per turn of the joint.
        friction, damping, armature: friction, damping and armature at the joint.
        weight: largest gravity torque [N·m].
        angle: angle of the load at rest under gravity.
        drive: numbers of the motor by dotted name. They take precedence over values that follow from the others.
    """

    file: str
    joint: str
    rolls: bool
    mass: Found | None
    inertia: Found
    sides: Found | None = None
    radius: Found | None = None
    ratio: Found | None = None
    friction: Found | None = None
    damping: Found | None = None
    armature: Found | None = None
    weight: Found | None = None
    angle: Found | None = None
    drive: Mapping[str, StatedNumber] = dataclasses.field(default_factory=dict)

    def kind(self, stated: str | None) -> str:
        """Kind of rig: `stated`, or else the kind that fits the joint's load.

        Raises:
            BadConfiguration: the load of this kind slides.
        """
        if stated is None:
            return "wheeled" if self.rolls else "bench" if self.weight is None else "pendulum"
        if stated not in TURNING:
            raise BadConfiguration(f"--kind: got {stated} with --from, which reads a revolute joint; "
                                   f"{allowed_words(stated, TURNING)}")  # fmt: skip
        return stated

    def numbers(self, kind: str) -> dict[str, StatedNumber]:
        """Numbers for the rig file of this kind, by dotted name."""
        by_name: dict[str, StatedNumber] = {}

        def put(name: str, unit: str, key: str, number: Found | None, source: str = "") -> None:
            if number is not None:
                by_name[name] = StatedNumber(
                    number[0], unit, f"{self.file}, {number[1]}{source}", WIDTHS.get(key, "")
                )

        moving = kind in VEHICLES
        losses = "load.track" if moving else "load"
        if moving:
            put("load.mass", "kg", "mass", self.mass)
            put("load.radius", "m", "radius", self.radius)
        else:
            put("load.torque_gravity", "N·m", "weight", self.weight)
            put("load.angle_zero", "rad", "angle", self.angle)
        if self.sides is not None:
            by_name["sides"] = StatedNumber(int(self.sides[0]), "-", f"{self.file}, {self.sides[1]}")
        put(f"{losses}.loss_coulomb", "N·m", "friction", self.friction)
        put(f"{losses}.loss_viscous", "N·m·s", "damping", self.damping)
        put("gearbox.ratio", "-", "ratio", self.ratio)
        inertia = self.inertia
        if self.armature is not None and self.ratio is not None:
            rotor = (self.armature[0] / self.ratio[0] ** 2, self.armature[1])
            put("motor.inertia", "kg·m^2", "armature", rotor, " / ratio²")
        elif self.armature is not None:
            inertia = (inertia[0] + self.armature[0], f"{inertia[1]}, and armature")
            by_name["motor.inertia"] = StatedNumber(0.0, "kg·m^2", "no ratio found: the load inertia includes it")
        put("load.inertia", "kg·m^2", "inertia", inertia)
        return by_name | {name.replace("load.loss", f"{losses}.loss"): number for name, number in self.drive.items()}


def free_unstated_losses(kind: str, numbers: Mapping[str, StatedNumber]) -> dict[str, StatedNumber]:
    """Numbers of a rig, with those losses of the joint free that its model lacks or leaves at the default 0.

    Each may be up to `UNSTATED` of the stall torque k n U / R, the speed-dependent loss at no-load speed U / (k n).
    Without motor constants and ratio, or without the voltage U for the constant loss, the template's line is kept,
    and a value of 0 is fixed.
    """
    freed = dict(numbers)
    constant, resistance, ratio, limit = (
        freed[name].value if name in freed else 0.0
        for name in ("motor.torque_constant", "motor.resistance", "gearbox.ratio", "motor.voltage_limit")
    )
    torque = UNSTATED * constant * ratio / resistance if resistance > 0 else 0.0  # [N·m/V]
    losses = "load.track" if kind in VEHICLES else "load"
    for key, unit, width in (
        ("loss_coulomb", "N·m", torque * limit),
        ("loss_viscous", "N·m·s", torque * constant * ratio),
    ):
        name, reason = f"{losses}.{key}", f"not in the model, ± is {100 * UNSTATED:g} % of the stall torque"
        if name in freed and freed[name].value != 0:
            continue
        if width > 0:
            freed[name] = StatedNumber(0.0, unit, reason, f"{width:.2g}")
        elif name in freed:
            source = f'{freed[name].source}; a value of 0 stays fixed, "0.0 ± 0.01" is fitted'
            freed[name] = dataclasses.replace(freed[name], source=source)
    return freed


def hanging_torque_and_angle(torque: float, torque_quarter: float) -> tuple[float, float] | None:
    """Amplitude M [N·m] and rest angle θ_0 [rad] of the gravity torque -M sin(θ - θ_0). None: M is negligible.

    Args:
        torque, torque_quarter: gravity torques about the axis at θ = 0 and at a quarter turn [N·m].
    """
    weight = math.hypot(torque, torque_quarter)
    angle = math.atan2(torque, -torque_quarter) + 0.0  # avoids -0.0 in the file
    return (weight, angle) if weight > LEAST_WEIGHT else None


def is_round(centre: np.ndarray, axis: np.ndarray, radius: float, along: np.ndarray | None) -> bool:
    """True if a cylinder or sphere turns about its own axis.

    Args:
        centre: centre relative to a point on the joint's axis.
        axis: axis of the joint.
        along: axis of the cylinder. None: a sphere. Axes are unit vectors, shape (3,).
    """
    distance = np.linalg.norm(np.cross(axis, centre))
    tilted = 0.0 if along is None else np.linalg.norm(np.cross(axis, along))
    return bool(distance <= OFF_AXIS * radius and tilted <= OFF_AXIS)
