"""Sentences about feedforward constants and what stands in their way."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from calibration.inference.feedforward import WRONG_UNITS, Feedforward, constant_units


def feedforward_statement(found: Feedforward) -> str:
    """Each constant with ± (95 %) and unit."""
    units = constant_units(found.unit)
    constants_words = (f"{n} = {x:.4g} ± {1.96 * found.sds[n]:.2g} {units[n]}" for n, x in found.constants.items())
    return ", ".join(constants_words) + "."


def _limit(level: float, current: float | None) -> str:
    peak = "" if current is None else f" The current reaches {current:.3g} A."
    return (
        f"A current limit acts: above {level:.2g} V of accelerating voltage the acceleration no longer "
        f"increases.{peak} Those windows are left out. Lower the dynamic test's voltage, or raise the limit."
    )


#: Ratio of a velocity in a wrong unit to the rate of the position → its unit.
MEANT = dict(
    zip(
        WRONG_UNITS,
        ("per minute", "per second, while the position counts minutes", "in radians", "in rotations", "in degrees",
         "in rotations", "in rotations per minute, while the position is in radians", "in millimetres",
         "in centimetres"),
        strict=True,
    )
)  # fmt: skip


def _unit(ratio: float, near: float) -> str:
    told = f"it is probably {MEANT[near]}" if near else "check gear ratio and wheel size in the conversion"
    return (
        f"The velocity is {ratio:.4g} times the rate of the position: {told}. The constants use the position's unit."
    )


def _undetermined(share: float, missing: Sequence[str]) -> str:
    lack = f" ({', '.join(missing)} missing)" if missing else ""
    return (
        f"kA is not determined: its 95 % interval is ± {100 * share:.0f} %{lack}. No feedback gains are given. "
        "Run dynamic tests with more acceleration and a faster log."
    )


SAID: dict[str, str | Callable[..., str]] = {
    "feedforward_sign": (
        "A positive voltage gives a negative velocity, so its sign is changed here. Set the inversion in the "
        "robot's code."
    ),
    "feedforward_speed_sign": (
        "Velocity and position have opposite signs, so that of the velocity is changed here. Invert one in the "
        "robot's code."
    ),
    "feedforward_unit": _unit,
    "feedforward_delay": lambda delay: (
        f"The motion follows the voltage {1000 * delay:.0f} ms late, which the fit includes."
    ),
    "feedforward_filter": lambda lag: (
        f"The velocity lags the position by {1000 * lag:.0f} ms because it is filtered, so the position is "
        "fitted. Shorten the velocity filter before you use kP."
    ),
    "feedforward_limit": _limit,
    "feedforward_skid": lambda level: (
        f"The wheels slip: above {level:.2g} V of accelerating voltage the velocity rises faster. Those windows "
        "are left out. Lower the dynamic test's voltage."
    ),
    "feedforward_direction": lambda forward, backward: (
        f"kS differs by direction: {forward:.3g} V forward, {backward:.3g} V backward. A slope, a weight or a "
        "binding gear can cause this. WPILib's kS is their mean."
    ),
    "feedforward_sag": lambda rest, low: (
        f"The battery sagged from {rest:.3g} to {low:.3g} V. Without the voltage at the motor, kA and kV are too "
        "large. Use setVoltage, or a fresh battery."
    ),
    "feedforward_missing": "Tests are missing: {tests}.",
    "feedforward_no_kA": _undetermined,
    "feedforward_gains_delayed": lambda delay, slow, prompt: (
        f"A delay of {1000 * delay:.0f} ms reduces the velocity kP from {prompt:.3g} to {slow:.3g}."
    ),
}
