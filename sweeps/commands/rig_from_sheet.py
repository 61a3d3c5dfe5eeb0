"""Motor constants from the six usual numbers of a data sheet."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

from calibration.data.input_errors import BadConfiguration, parse_number, three_digits
from sweeps.commands.rig_template import StatedNumber

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
LARGEST = 0.1
#: Smallest sds of resistance and torque constant [%]. Makers print three digits and allow 5 to 10 % between motors.
WIDTH_RESISTANCE, WIDTH_CONSTANT = 5.0, 3.0


def _unit_list(text: str) -> str:
    return re.sub(r"[\s·.*-]", "", text).casefold()


def _parse_quantity(name: str, text: str) -> float:
    units = NUMBERS[name]
    expected = f"expected a positive number with a unit: {', '.join(units)}"
    split = re.fullmatch(r"\s*([-+\d.][\d.]*(?:[eE][-+]?\d+)?)\s*(.*?)\s*", text)
    factor = None if split is None else {_unit_list(u): f for u, f in units.items()}.get(_unit_list(split[2]))
    try:
        value = parse_number(split[1]) if split is not None and factor is not None else math.nan
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
            `LARGEST` although these equations make them equal.
    """
    if not stated:
        other_options = ", ".join(f"--{name}" for name in NUMBERS if name != "no-load-current")
        raise BadConfiguration(
            f"--from-sheet: no motor data; expected --no-load-current and at least three of {other_options}"
        )
    sheet = {name: _parse_quantity(name, text) for name, text in stated.items()}
    drop = _stall_minus_no_load_current(sheet)
    voltage, speed, idle, torque, stall, stated_resistance = map(sheet.get, NUMBERS)
    assert idle is not None
    resistances = [(stated_resistance, "resistance"), (_ratio_or_none(voltage, stall), "voltage / stall current")]
    if stated_resistance is None and stall is None:
        resistances.append((_ratio_or_none(voltage, idle + drop), "voltage and power at no load"))
    if voltage is None and stated_resistance is None and speed is not None and torque is not None:
        resistances.append((torque * speed / drop**2, "stall torque, no-load speed and stall current"))
    known_resistances = [(value, source) for value, source in resistances if value is not None]
    resistance = known_resistances[0][0]
    back_emf = resistance * drop if voltage is None else voltage - resistance * idle
    constants = [
        (_ratio_or_none(back_emf, speed), "voltage / no-load speed"),
        (_ratio_or_none(torque, drop), "stall torque / stall current"),
    ]
    stated_constants = [(value, source) for value, source in constants if value is not None]
    _reject_contradictions((known_resistances, "resistance", "ohm"), (stated_constants, "torque constant", "N·m/A"))
    constant = stated_constants[0][0]

    def line(value: float, unit: str, source: str, width: float) -> StatedNumber:
        return StatedNumber(float(f"{value:.4g}"), unit, f"data sheet, {source}", f"{width:.2g} %")

    spread = [100 * _largest_difference(pairs) for pairs in (known_resistances, stated_constants)]
    return {
        "motor.resistance": line(resistance, "ohm", known_resistances[0][1], max(WIDTH_RESISTANCE, spread[0])),
        "motor.torque_constant": line(constant, "N·m/A", stated_constants[0][1], max(WIDTH_CONSTANT, spread[1])),
        "motor.friction_coulomb": line(constant * idle, "N·m", "torque constant × no-load current", 30.0),
        "motor.friction_viscous": StatedNumber(
            0.0,
            "N·m·s",
            "Coulomb and viscous friction are not separated, ± as if half were viscous",
            f"{0.5 * constant**2 * idle / back_emf:.2g}",
        ),
    }


def _ratio_or_none(one: float | None, other: float | None) -> float | None:
    return None if one is None or other is None else one / other


def _stall_minus_no_load_current(sheet: Mapping[str, float]) -> float:
    """Stall current minus no-load current [A].

    Raises:
        BadConfiguration: the numbers do not determine it, or the no-load current is not the smaller one.
    """
    voltage, speed, idle, torque, stall, resistance = map(sheet.get, NUMBERS)
    if idle is None:
        raise BadConfiguration("--no-load-current: missing; the motor friction needs it")
    missing = [name for name in NUMBERS if name not in sheet]
    if speed is None and torque is None:
        raise BadConfiguration("--no-load-speed and --stall-torque: both missing; the torque constant needs one")
    totals = [x for x in (stall, _ratio_or_none(voltage, resistance)) if x is not None]
    if totals and min(totals) <= idle:
        raise BadConfiguration(f"--no-load-current: got {three_digits(idle)} A, but the stall current is "
                               f"{three_digits(min(totals))} A; expected less")  # fmt: skip
    total = totals[0] if totals else None
    if total is not None and (resistance is not None or voltage is not None):
        return total - idle
    if speed is not None and torque is not None:
        power = torque * speed
        if total is not None:
            return total - idle
        if resistance is not None:
            return math.sqrt(power / resistance)
        if voltage is not None:  # U D² = M_s ω_0 (D + I_0)
            return (power + math.sqrt(power**2 + 4 * voltage * power * idle)) / (2 * voltage)
    lacking = ", ".join(f"--{name}" for name in missing)
    raise BadConfiguration(f"--from-sheet: missing {lacking}; resistance and torque constant need one more")


def _largest_difference(pairs: list[tuple[float, str]]) -> float:
    values = [value for value, _ in pairs]
    return max(values) / min(values) - 1


def _reject_contradictions(*groups: tuple[list[tuple[float, str]], str, str]) -> None:
    faults = [
        f"{name} is {' and '.join(f'{three_digits(value)} {unit} ({source})' for value, source in pairs)}, "
        f"{100 * _largest_difference(pairs):.0f} % apart"
        for pairs, name, unit in groups
        if _largest_difference(pairs) > LARGEST
    ]
    if faults:
        raise BadConfiguration(
            f"--from-sheet: contradiction: {'; '.join(faults)}; expected at most {100 * LARGEST:.0f} %; give "
            "data of the motor shaft at one voltage"
        )
