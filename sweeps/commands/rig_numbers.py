"""Numbers of a driven joint or a data sheet, and templates of rig files that they fill in."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from importlib import resources

import numpy as np

from calibration.data.input_errors import BadConfiguration, allowed_words, parse_number, three_digits
from calibration.data.stated import HEADER
from mmrjax.errors import list_some

#: Number, and the element of the model that states it.
NumberWithSource = tuple[float, str]

#: Kinds of rig on the ground, and kinds for a joint that turns.
VEHICLES = ("wheeled", "tracked")
TURNING = (*VEHICLES, "bench", "dyno", "pendulum", "servo")
#: Largest vertical component of a wheel axis, and largest relative difference between radii of equal wheels.
LEVEL, EQUAL = 0.1, 0.01
#: Smallest gravity torque that counts as an arm [N·m].
LEAST_WEIGHT = 1e-9
#: Largest distance between wheel centre and joint axis, as a share of the radius, and largest sine between the axes.
OFF_AXIS = 0.02
#: Upper limit of a loss that the model does not state, as a share of the stall torque.
UNSTATED = 0.05
#: Line of a rig's file for each number of a joint: name, unit and ±. Models round masses and guess losses.
LINES = {
    "mass": ("load.mass", "kg", "20 %"), "radius": ("load.radius", "m", "5 %"),
    "weight": ("load.torque_gravity", "N·m", "20 %"), "angle": ("load.angle_zero", "rad", "0.1"),
    "sides": ("sides", "-", ""), "friction": ("load.loss_coulomb", "N·m", "100 %"),
    "damping": ("load.loss_viscous", "N·m·s", "100 %"), "ratio": ("gearbox.ratio", "-", "5 %"),
    "armature": ("motor.inertia", "kg·m^2", "50 %"), "inertia": ("load.inertia", "kg·m^2", "50 %"),
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class JointNumbers:
    """Numbers of a joint and its load.

    Attributes:
        file, joint: names of the file and the joint.
        rolls: True if the joint turns a wheel of a body that is free to move.
        stated: number [SI] for each key of `LINES`, None if the model has none. `mass` is that of the whole model,
            `sides` the number of equal joints, and `weight` the largest gravity torque. `inertia` is that of
            everything that turns with the joint, without `armature`. `angle` is that of the load at rest under
            gravity.
        drive: numbers of the motor by dotted name. They take precedence over values that follow from the others.
    """

    file: str
    joint: str
    rolls: bool
    stated: Mapping[str, NumberWithSource | None]
    drive: Mapping[str, StatedNumber] = dataclasses.field(default_factory=dict)

    def kind(self, stated: str | None) -> str:
        """Kind of rig: `stated`, or else the kind that fits the joint's load.

        Raises:
            BadConfiguration: the load of this kind slides.
        """
        if stated is None:
            return "wheeled" if self.rolls else "bench" if self.stated["weight"] is None else "pendulum"
        if stated not in TURNING:
            raise BadConfiguration(f"--kind: got {stated} with --from, which reads a revolute joint; "
                                   f"{allowed_words(stated, TURNING)}")  # fmt: skip
        return stated

    def numbers(self, kind: str) -> dict[str, StatedNumber]:
        """Numbers for the rig file of this kind, by dotted name."""
        moving = kind in VEHICLES
        losses = "load.track.loss" if moving else "load.loss"
        omitted = ("weight", "angle") if moving else ("mass", "radius")
        pairs = {key: pair for key, pair in self.stated.items() if pair is not None and key not in omitted}
        by_name: dict[str, StatedNumber] = {}
        if "armature" in pairs:
            armature, source = pairs.pop("armature")
            inertia, source_inertia = pairs["inertia"]
            if "ratio" in pairs:
                pairs["armature"] = armature / pairs["ratio"][0] ** 2, f"{source} / ratio²"
            else:
                pairs["inertia"] = inertia + armature, f"{source_inertia}, and armature"
                source = "no ratio found: the load inertia includes it"
                by_name["motor.inertia"] = StatedNumber(0.0, "kg·m^2", source)
        for key, (name, unit, width) in LINES.items():
            if key in pairs:
                value, source = pairs[key]
                by_name[name] = StatedNumber(value, unit, f"{self.file}, {source}", width)
        return {name.replace("load.loss", losses): number for name, number in {**by_name, **self.drive}.items()}


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


def choose_joint(
    joint: str | None, names: Collection[str], turning: Sequence[str], driven: Collection[str], file: str, kind: str
) -> str:
    """Name of a joint of a model: the stated one, or the only driven one.

    Args:
        names, turning, driven: names of all joints, of those that turn, and of driven ones.
        kind: joints that turn, in words.

    Raises:
        BadConfiguration: the joint does not exist, or none is stated and there is not exactly one.
    """
    candidates = [name for name in turning if name in driven] or turning
    if joint is None:
        if len(candidates) != 1:
            finding = f"has {list_some(candidates)}" if candidates else f"has no {kind}"
            raise BadConfiguration(f"--joint: missing, and {file} {finding}; expected the name of one joint")
        return candidates[0]
    if joint not in names:
        hint = allowed_words(joint, turning) if turning else f"the file has no {kind}"
        raise BadConfiguration(f"--joint: got {joint}; {file} has no such joint; {hint}")
    return joint


def equal_wheels(
    radius: float, axis: np.ndarray, joints: Iterable[tuple[str, NumberWithSource | None, np.ndarray]]
) -> NumberWithSource:
    """Number of joints with a wheel of the same radius and a parallel axis, and their names.

    Args:
        joints: name, radius of the wheel, if any, and axis of each, shape (3,).
    """
    equal = [
        name or "one without a name"
        for name, other, along in joints
        if other is not None and abs(other[0] / radius - 1) <= EQUAL and abs(axis @ along) > 1 - EQUAL
    ]
    return len(equal), f"equal wheels: {', '.join(equal)}"


def hanging_torque_and_angle(torque: float, torque_quarter: float) -> tuple[float, float] | None:
    """Amplitude M [N·m] and rest angle θ_0 [rad] of the gravity torque -M sin(θ - θ_0). None: M is negligible.

    Args:
        torque, torque_quarter: gravity torques about the axis at θ = 0 and at a quarter turn [N·m].
    """
    weight = math.hypot(torque, torque_quarter)
    angle = math.atan2(torque, -torque_quarter) + 0.0  # avoids -0.0 in the file
    return (weight, angle) if weight > LEAST_WEIGHT else None


def is_round(centre: np.ndarray, axis: np.ndarray, radius: float, own_axis: np.ndarray | None) -> bool:
    """True if a cylinder or sphere turns about its own axis.

    Args:
        centre: centre relative to a point on the joint's axis.
        axis: axis of the joint.
        own_axis: axis of the cylinder. None: a sphere. Axes are unit vectors, shape (3,).
    """
    distance = np.linalg.norm(np.cross(axis, centre))
    tilted = 0.0 if own_axis is None else np.linalg.norm(np.cross(axis, own_axis))
    return bool(distance <= OFF_AXIS * radius and tilted <= OFF_AXIS)


#: Kinds of rig, in words.
KINDS = {
    "bench": "a motor with gearbox that drives a shaft: brake, disk, worm, winch",
    "dyno": "a motor on a dynamometer: a brake whose torque is set and measured",
    "pendulum": "a servo with an arm under gravity",
    "servo": "a servo driven by PWM, with its angle logged",
    "linear": "a carriage on a screw, a belt or a rope",
    "carriage": "a carriage on an amplifier that controls the current, with its position logged",
    "wheeled": "a robot on wheels",
    "tracked": "a robot on tracks",
}
#: Name of the load's table in dotted names, which the template's own name replaces.
LOAD = "load"


@dataclasses.dataclass(frozen=True)
class StatedNumber:
    """A number for a line of a rig file.

    Attributes:
        value: value in `unit`.
        source: file and element that state it.
        width: text after ±, empty if there is none.
    """

    value: float
    unit: str
    source: str
    width: str = ""

    @property
    def text(self) -> str:
        """Number as text for the file. A relative sd of 0 is omitted."""
        number = repr(self.value if isinstance(self.value, int) else float(f"{self.value:.12g}"))
        exact = not self.width or (self.value == 0 and self.width.endswith("%"))
        return number if exact else f'"{number} ± {self.width}"'


def rig_template(kind: str) -> str:
    """Template for a kind of rig."""
    return resources.files("calibration.data").joinpath("rigs", f"{kind}.toml").read_text(encoding="utf-8")


def fill_rig_template(kind: str, numbers: Mapping[str, StatedNumber], heading: str) -> str:
    """Template of a kind of rig, filled in with numbers.

    Numbers without a line in the template are added at the end of their table.

    Args:
        numbers: numbers by dotted name, with `load.` for the table of the load.
        heading: sentence for the first line.
    """
    lines = rig_template(kind).splitlines()
    load_line = next(k for k, line in enumerate(lines) if line.startswith("load = "))
    load = lines[load_line - 1].strip("[]")
    for name, number in numbers.items():
        table, _, key = re.sub(rf"^{LOAD}\.", f"{load}.", name).rpartition(".")
        line = f"{key} = {number.text}  # [{number.unit}] {_one_line(number.source)}"
        if table and f"[{table}]" not in lines:
            lines += ["", f"[{table}]"]
        start = lines.index(f"[{table}]") + 1 if table else 0
        end = next((k for k in range(start, len(lines)) if HEADER.match(lines[k])), len(lines))
        key_lines = [k for k in range(start, end) if re.match(rf"(# )?{key} = ", lines[k])]
        if key_lines:
            lines[key_lines[0]] = line
            continue
        while end > start and (not lines[end - 1] or lines[end - 1].startswith("#")):
            end -= 1  # comments below belong to the next table
        lines.insert(end, line)
    return "\n".join([f"# {_one_line(heading)}", *lines]) + "\n"


def _one_line(text: str) -> str:
    """Text on one line, because line breaks in names of a model would end a comment."""
    return "".join(letter if letter.isprintable() else " " for letter in text)


_GRAVITY, _POUND_FORCE, _INCH = 9.80665, 4.4482216, 0.0254
#: Units of torque: normalised spelling, and value in N·m.
TORQUES = {
    "Nm": 1.0, "mNm": 1e-3, "Ncm": 1e-2, "kg·cm": 1e-2 * _GRAVITY, "kgf·cm": 1e-2 * _GRAVITY,
    "g·cm": 1e-5 * _GRAVITY, "gf·cm": 1e-5 * _GRAVITY, "oz·in": _POUND_FORCE / 16 * _INCH,
    "ozf·in": _POUND_FORCE / 16 * _INCH, "lb·in": _POUND_FORCE * _INCH, "lbf·in": _POUND_FORCE * _INCH,
}  # fmt: skip
_CURRENTS = {"A": 1.0, "mA": 1e-3}
#: Numbers of a data sheet, by the name of their option: units in SI.
NUMBERS: dict[str, dict[str, float]] = {
    "voltage": {"V": 1.0, "mV": 1e-3},
    "no-load-speed": {"rpm": math.pi / 30, "1/min": math.pi / 30, "rad/s": 1.0},
    "no-load-current": _CURRENTS,
    "stall-torque": TORQUES,
    "stall-current": _CURRENTS,
    "resistance": {"ohm": 1.0, "Ω": 1.0, "mohm": 1e-3, "mΩ": 1e-3},
}
#: Largest relative difference between two values of a number.
APART = 0.1
#: Smallest sds of resistance and torque constant [%]. Makers print three digits and allow 5 to 10 % between motors.
WIDTH_RESISTANCE, WIDTH_CONSTANT = 5.0, 3.0


def _normalised_unit(text: str) -> str:
    return re.sub(r"[\s·.*-]", "", text).casefold()


def _parse_quantity(name: str, text: str) -> float:
    units = NUMBERS[name]
    expected = f"expected a positive number with a unit: {', '.join(units)}"
    match = re.fullmatch(r"\s*([-+\d.][\d.]*(?:[eE][-+]?\d+)?)\s*(.*?)\s*", text)
    factor = (
        None if match is None else {_normalised_unit(u): f for u, f in units.items()}.get(_normalised_unit(match[2]))
    )
    try:
        value = parse_number(match[1]) if match is not None and factor is not None else math.nan
    except ValueError:
        value = math.nan
    if not (0 < value < math.inf) or factor is None:
        raise BadConfiguration(f"--{name}: got {text}; {expected}")
    return value * factor


def read_data_sheet(stated: Mapping[str, str]) -> dict[str, StatedNumber]:
    """Resistance, torque constant and friction of a motor as lines of a rig file.

    At stall U = R I_s and M_s = k (I_s - I_0). At no load U = R I_0 + k ω_0, with friction torque k I_0.

    Args:
        stated: text with unit for each of `NUMBERS`.

    Raises:
        BadConfiguration: a text has no number or unit, there are too few numbers, or numbers differ by more than
            `APART` although these equations make them equal.
    """
    if not stated:
        other_options = ", ".join(f"--{name}" for name in NUMBERS if name != "no-load-current")
        raise BadConfiguration(
            f"--from-sheet: no motor data; expected --no-load-current and at least three of {other_options}"
        )
    sheet = {name: _parse_quantity(name, text) for name, text in stated.items()}
    difference = _stall_minus_no_load_current(sheet)
    voltage, speed, no_load, torque, stall, stated_resistance = map(sheet.get, NUMBERS)
    assert no_load is not None
    resistances = [(stated_resistance, "resistance"), (_ratio_or_none(voltage, stall), "voltage / stall current")]
    if stated_resistance is None and stall is None:
        resistances.append((_ratio_or_none(voltage, no_load + difference), "voltage and power at no load"))
    if voltage is None and stated_resistance is None and speed is not None and torque is not None:
        resistances.append((torque * speed / difference**2, "stall torque, no-load speed and stall current"))
    known_resistances = [(value, source) for value, source in resistances if value is not None]
    resistance = known_resistances[0][0]
    back_emf = resistance * difference if voltage is None else voltage - resistance * no_load
    constants = [
        (_ratio_or_none(back_emf, speed), "voltage / no-load speed"),
        (_ratio_or_none(torque, difference), "stall torque / stall current"),
    ]
    stated_constants = [(value, source) for value, source in constants if value is not None]
    constant = stated_constants[0][0]
    differences = [_largest_difference(pairs) for pairs in (known_resistances, stated_constants)]
    groups = (known_resistances, "resistance", "ohm"), (stated_constants, "torque constant", "N·m/A")
    faults = [
        f"{name} is {' and '.join(f'{three_digits(value)} {unit} ({source})' for value, source in pairs)}, "
        f"{100 * apart:.0f} % apart"
        for (pairs, name, unit), apart in zip(groups, differences, strict=True)
        if apart > APART
    ]
    if faults:
        raise BadConfiguration(
            f"--from-sheet: contradiction: {'; '.join(faults)}; expected at most {100 * APART:.0f} %, at the motor's "
            "shaft and one voltage"
        )

    def sheet_number(value: float, unit: str, source: str, width: float) -> StatedNumber:
        return StatedNumber(float(f"{value:.4g}"), unit, f"data sheet, {source}", f"{width:.2g} %")

    widths = max(WIDTH_RESISTANCE, 100 * differences[0]), max(WIDTH_CONSTANT, 100 * differences[1])
    return {
        "motor.resistance": sheet_number(resistance, "ohm", known_resistances[0][1], widths[0]),
        "motor.torque_constant": sheet_number(constant, "N·m/A", stated_constants[0][1], widths[1]),
        "motor.friction_coulomb": sheet_number(constant * no_load, "N·m", "torque constant × no-load current", 30.0),
        "motor.friction_viscous": StatedNumber(
            0.0,
            "N·m·s",
            "not separated from Coulomb friction, ± as if half were viscous",
            f"{0.5 * constant**2 * no_load / back_emf:.2g}",
        ),
    }


def _ratio_or_none(numerator: float | None, denominator: float | None) -> float | None:
    return None if numerator is None or denominator is None else numerator / denominator


def _stall_minus_no_load_current(sheet: Mapping[str, float]) -> float:
    """Stall current minus no-load current [A].

    Raises:
        BadConfiguration: the numbers do not determine it, or the no-load current is not the smaller one.
    """
    voltage, speed, no_load, torque, stall, resistance = map(sheet.get, NUMBERS)
    if no_load is None:
        raise BadConfiguration("--no-load-current: missing; the motor friction needs it")
    missing = [name for name in NUMBERS if name not in sheet]
    if speed is None and torque is None:
        raise BadConfiguration("--no-load-speed and --stall-torque: both missing; the torque constant needs one")
    stall_currents = [x for x in (stall, _ratio_or_none(voltage, resistance)) if x is not None]
    if stall_currents and min(stall_currents) <= no_load:
        raise BadConfiguration(f"--no-load-current: got {three_digits(no_load)} A, but the stall current is "
                               f"{three_digits(min(stall_currents))} A; expected less")  # fmt: skip
    stall_current = stall_currents[0] if stall_currents else None
    if stall_current is not None and (resistance is not None or voltage is not None):
        return stall_current - no_load
    if speed is not None and torque is not None:
        power = torque * speed
        if stall_current is not None:
            return stall_current - no_load
        if resistance is not None:
            return math.sqrt(power / resistance)
        if voltage is not None:  # U D² = M_s ω_0 (D + I_0)
            return (power + math.sqrt(power**2 + 4 * voltage * power * no_load)) / (2 * voltage)
    lacking = ", ".join(f"--{name}" for name in missing)
    raise BadConfiguration(f"--from-sheet: missing {lacking}; resistance and torque constant need one more")


def _largest_difference(pairs: list[tuple[float, str]]) -> float:
    values = [value for value, _ in pairs]
    return max(values) / min(values) - 1
