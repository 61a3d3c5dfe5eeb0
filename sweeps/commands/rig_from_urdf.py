"""Numbers of a driven joint of a robot in URDF."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.data.input_errors import BadConfiguration, stated_word
from mmrjax.errors import list_some
from mmrjax.model.signals import GRAVITY
from sweeps.commands.rig_numbers import (
    LEVEL,
    JointNumbers,
    NumberWithSource,
    choose_joint,
    equal_wheels,
    hanging_torque_and_angle,
    is_round,
)

#: Joint types that turn.
TURNS = ("revolute", "continuous")
#: Name of a fixed root link.
FIXED_ROOT = "world"
#: Names of a transmission's reduction in ROS 1 and ROS 2.
REDUCTIONS = ("mechanicalReduction", "mechanical_reduction")
#: Smallest inertia of rotating parts [kg·m²]. Smaller values are rounding errors of rotations.
LEAST_INERTIA = 1e-12

#: Rotation, shape (3, 3), and position [m], shape (3,).
Pose = tuple[np.ndarray, np.ndarray]


class UrdfRobot:
    """Robot of an element `<robot>`, from a file of this name."""

    def __init__(self, root: Element, file: str) -> None:
        """Reads links and joints.

        Raises:
            BadConfiguration: xacro elements, a name is missing or occurs twice, or a joint has no known link.
        """
        self.root, self.file = root, file
        if any("xacro}" in element.tag for element in root.iter()):
            raise BadConfiguration(
                f"{file}: contains xacro elements; run xacro {file} > robot.urdf, and use that file"
            )
        self.links, self.joints = self._named("link"), self._named("joint")
        #: Link at each end of a joint.
        self.parent, self.child = (
            {name: self._link(j, end, name) for name, j in self.joints.items()} for end in ("parent", "child")
        )

    def _named(self, tag: str) -> dict[str, Element]:
        elements: dict[str, Element] = {}
        for element in self.root.findall(tag):
            name = element.get("name", "")
            if not name or name in elements:
                problem_words = f"two are called {name}" if name else "one has no name"
                raise BadConfiguration(f"{self.file}, <{tag}>: {problem_words}; expected different names")
            elements[name] = element
        if not elements:
            raise BadConfiguration(f"{self.file}: has no <{tag}>; expected a robot with links and joints")
        return elements

    def _link(self, joint: Element, end: str, name: str) -> str:
        element = joint.find(end)
        link = "" if element is None else element.get("link", "")
        return stated_word(link, self.links, f"{self.file}, joint {name}, <{end}>", f"got {link or 'no link'}")

    def turning_joint(self, joint: str | None) -> str:
        """Name of a joint that turns, None for the only driven one.

        Raises:
            BadConfiguration: the joint is unknown, fixed, or slides.
        """
        turning = [name for name, element in self.joints.items() if element.get("type") in TURNS]
        driven = [name for name in turning if self._driven(name)]
        joint = choose_joint(joint, self.joints, turning, driven, self.file, "joint that turns")
        if joint not in turning:
            kind = self.joints[joint].get("type") or "without a type"
            advice = "; for a carriage: mmrjax rig new --kind linear" if kind == "prismatic" else ""
            raise BadConfiguration(f"--joint: got {joint}, which is {kind}; expected one that turns: "
                                   f"{list_some(driven or turning) or 'the file has none'}{advice}")  # fmt: skip
        return joint

    def numbers(self, joint: str) -> JointNumbers:
        """Numbers of a joint.

        Raises:
            BadConfiguration: links form a loop, a number is wrong or negative, or there is no inertia.
        """
        element, link = self.joints[joint], self.child[joint]
        axis = self._axis(joint)
        to_root, root_link = self._to_root(joint)
        moved_links = list(self._moved_links(link))
        inertia, moment, count = 0.0, np.zeros(3), 0
        for name, pose in moved_links:
            mass, inertia_about_axis, first_moment = self._inertial(name, pose, axis)
            inertia, moment, count = inertia + inertia_about_axis, moment + first_moment, count + (mass > 0)
        links_text = (
            f"link {link}"
            if len(moved_links) == 1
            else (f"link {link} and the {len(moved_links) - 1} links that it carries")
        )
        if count == 0:
            raise BadConfiguration(f"{self.file}, {links_text}: no <inertial>; expected its <mass> and <inertia>")
        if inertia < LEAST_INERTIA:
            inertia_text = f"{round(inertia, 12):g} kg·m² about the axis of {joint}"
            raise BadConfiguration(f"{self.file}, {links_text}, <inertia>: got {inertia_text}; expected more than 0")
        radius = self._radius(joint)
        is_level = abs(float((to_root[0] @ axis)[2])) <= LEVEL
        rolls = radius is not None and is_level and root_link != FIXED_ROOT and element.get("type") == "continuous"
        weight = None
        if not rolls:
            gravity, moment_across = to_root[0].T @ [0.0, 0.0, -GRAVITY], np.cross(axis, moment)
            # without the component of the first moment along the axis
            torque = axis @ np.cross(np.cross(moment_across, axis), gravity)
            weight = hanging_torque_and_angle(float(torque), float(axis @ np.cross(moment_across, gravity)))
        numbers = {
            "mass": self._mass(),
            "sides": self._sides(joint, radius[0]) if rolls and radius is not None else None,
            "radius": radius,
            "inertia": (inertia, f"{links_text}, <inertia> about the axis"),
            "ratio": self._ratio(joint),
            "weight": None if weight is None else (weight[0], f"{links_text}, <mass> and its lever"),
            "angle": None if weight is None else (weight[1], f"{links_text}, hanging position"),
        }
        for key, unit in {"friction": "N·m", "damping": "N·m·s", "armature": "kg·m²"}.items():
            place = f"joint {joint}, <dynamics {key}>"
            value = self._number(element.find("dynamics"), key, place, unit, 0.0)
            numbers[key] = (value, place) if value else None
        return JointNumbers(self.file, joint, rolls, numbers)

    # --- frames

    def _axis(self, joint: str) -> np.ndarray:
        element = self.joints[joint].find("axis")
        axis = self._vector(element, "xyz", f"joint {joint}, <axis>", (1.0, 0.0, 0.0))
        length = float(np.linalg.norm(axis))
        if length == 0:
            raise BadConfiguration(f"{self.file}, joint {joint}, <axis>: got 0 0 0; expected a direction")
        return axis / length

    def _origin(self, owner: Element, where: str) -> Pose:
        element = owner.find("origin")
        angles = self._vector(element, "rpy", f"{where}, <origin>", (0.0, 0.0, 0.0))
        rotation = Rotation.from_euler("xyz", angles).as_matrix()
        return rotation, self._vector(element, "xyz", f"{where}, <origin>", (0.0, 0.0, 0.0))

    def _moved_links(self, link: str, rigid: bool = False) -> Iterator[tuple[str, Pose]]:
        """Links that turn with a link or are fixed to it, and their poses in its frame with other joints at zero."""
        pending: list[tuple[str, Pose]] = [(link, (np.eye(3), np.zeros(3)))]
        met: set[str] = set()
        while pending:
            name, pose = pending.pop()
            self._reject_loop(name, met)
            yield name, pose
            pending += [
                (self.child[j], _compose(pose, self._origin(element, f"joint {j}")))
                for j, element in self.joints.items()
                if self.parent[j] == name and (not rigid or element.get("type") == "fixed")
            ]

    def _reject_loop(self, link: str, met: set[str]) -> None:
        if link in met:
            raise BadConfiguration(f"{self.file}: link {link} is part of a loop; expected a tree")
        met.add(link)

    def _to_root(self, joint: str) -> tuple[Pose, str]:
        """Pose of a joint in the frame of the root link, and the name of the root link."""
        pose: Pose = (np.eye(3), np.zeros(3))
        link, met, above = "", set[str](), {link: j for j, link in self.child.items()}
        joint_name: str | None = joint
        while joint_name is not None:
            pose = _compose(self._origin(self.joints[joint_name], f"joint {joint_name}"), pose)
            link = self.parent[joint_name]
            self._reject_loop(link, met)
            joint_name = above.get(link)
        return pose, link

    # --- numbers

    def _mass(self) -> NumberWithSource | None:
        masses = [self._link_mass(name) for name in self.links]
        link_masses = [m for m in masses if m]
        lacking = f", {len(masses) - len(link_masses)} more links have none" if len(link_masses) < len(masses) else ""
        return (
            (math.fsum(link_masses), f"sum of <mass> of {len(link_masses)} links{lacking}") if link_masses else None
        )

    def _link_mass(self, link: str) -> float:
        element = self.links[link].find("inertial/mass")
        return self._number(element, "value", f"link {link}, <mass>", "kg", 0.0)

    def _inertial(self, link: str, pose: Pose, axis: np.ndarray) -> tuple[float, float, np.ndarray]:
        """Mass, inertia about the axis, and first moment of a link. All are 0 without `<inertial>`."""
        inertial = self.links[link].find("inertial")
        if inertial is None:
            return 0.0, 0.0, np.zeros(3)
        mass = self._link_mass(link)
        rotation, centre = _compose(pose, self._origin(inertial, f"link {link}"))
        entries = inertial.find("inertia")
        place_words = f"link {link}, <inertia>"
        xx, yy, zz = (self._number(entries, f"i{a}{a}", place_words, "kg·m²", 0.0) for a in "xyz")
        xy, xz, yz = (self._number(entries, f"i{a}", place_words, "kg·m²", None) for a in ("xy", "xz", "yz"))
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        axis_in_link = rotation.T @ axis
        lever = np.cross(axis, centre)
        return mass, float(axis_in_link @ tensor @ axis_in_link + mass * lever @ lever), mass * centre

    def _radius(self, joint: str) -> NumberWithSource | None:
        """Radius of the largest cylinder or sphere about the axis, from collision or else visual geometry."""
        axis = self._axis(joint)
        for tag in ("collision", "visual"):
            radii: list[NumberWithSource] = []
            for name, pose in self._moved_links(self.child[joint], rigid=True):
                for shape in self.links[name].findall(tag):
                    rotation, centre = _compose(pose, self._origin(shape, f"link {name}, <{tag}>"))
                    for kind, cylinder_axis in (("cylinder", rotation[:, 2]), ("sphere", None)):
                        place_words = f"link {name}, <{tag}> <{kind}>"
                        element = shape.find(f"geometry/{kind}")
                        radius = self._number(element, "radius", place_words, "m", 0.0)
                        if radius > 0 and is_round(centre, axis, radius, cylinder_axis):
                            radii.append((radius, place_words))
            if radii:
                return max(radii)
        return None

    def _sides(self, joint: str, radius: float) -> NumberWithSource:
        """Number of driven wheels like that of a joint, including its own."""
        axes = {
            name: self._to_root(name)[0][0] @ self._axis(name)
            for name, element in self.joints.items()
            if element.get("type") in TURNS and self._driven(name) == self._driven(joint)
        }
        return equal_wheels(radius, axes[joint], ((name, self._radius(name), axis) for name, axis in axes.items()))

    def _transmissions(self, joint: str) -> Iterator[Element]:
        for element in self.root.iter("transmission"):
            if joint in [j.get("name") for j in element.findall("joint")]:
                yield element

    def _driven(self, joint: str) -> bool:
        is_commanded = any(
            ros_joint.get("name") == joint and ros_joint.find("command_interface") is not None
            for ros_joint in self.root.iterfind("ros2_control/joint")
        )
        return is_commanded or any(True for _ in self._transmissions(joint))

    def _ratio(self, joint: str) -> NumberWithSource | None:
        """Product of the reductions between motor and joint."""
        for element in self._transmissions(joint):
            is_shared = len(element.findall("joint")) > 1  # actuators then belong to no single joint
            of_joint = [j for j in element.findall("joint") if j.get("name") == joint]
            owners = of_joint if is_shared else [element, *of_joint, *element.findall("actuator")]
            reduction_texts = [(owner.findtext(tag), tag) for owner in owners for tag in REDUCTIONS]
            ratio_texts = [(text, tag) for text, tag in reduction_texts if text is not None]
            if not ratio_texts:
                continue
            name = f"transmission {element.get('name', '')}, <{ratio_texts[0][1]}>".replace(" ,", ",")
            ratio = math.prod(abs(self._parse_number(text, name, "")) for text, _ in ratio_texts)
            if not ratio >= 1:
                raise BadConfiguration(f"{self.file}, {name}: got {ratio:g}; expected motor turns per joint turn, "
                                       "1 or more")  # fmt: skip
            return ratio, name + (": 1 is often a placeholder" if ratio == 1 else "")
        return None

    # --- cells

    def _number(self, element: Element | None, key: str, where: str, unit: str, least: float | None) -> float:
        text = None if element is None else element.get(key)
        if text is None:
            return 0.0
        value = self._parse_number(text, f"{where} {key}" if key not in where else where, unit)
        if least is not None and value < least:
            raise BadConfiguration(f"{self.file}, {where}: got {key} {value:g}; expected {least:g} {unit} or more")
        return value

    def _vector(self, element: Element | None, key: str, where: str, usual: Sequence[float]) -> np.ndarray:
        text = None if element is None else element.get(key)
        if text is None:
            return np.array(usual)
        values = [self._parse_number(word, f"{where} {key}", "") for word in text.split()]
        if len(values) != len(usual):
            raise BadConfiguration(f"{self.file}, {where} {key}: got {text!r}; expected {len(usual)} numbers")
        return np.array(values)

    def _parse_number(self, text: str | None, where: str, unit: str) -> float:
        try:
            value = float(text or "")
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            xacro = "; run xacro on it first" if text and "${" in text else ""
            expected = f"a number [{unit}]" if unit else "a number"
            raise BadConfiguration(f"{self.file}, {where}: got {text!r}; expected {expected}{xacro}")
        return value


def _compose(outer: Pose, inner: Pose) -> Pose:
    """Pose composed with another one."""
    return outer[0] @ inner[0], outer[1] + outer[0] @ inner[1]
