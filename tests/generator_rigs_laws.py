"""Laws of effects that a rig's file may leave unstated: those of the library by their equations, and others.

Each is written in the signals of `generator_rigs` and sized by the rig at hand: `scale` holds the largest size of each
signal over its rows, `torque` [N·m] at the output, `current` [A] of one motor, and `rated` [A], 0.3 of that at stall.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Mapping
from types import SimpleNamespace

import numpy as np


@dataclasses.dataclass(frozen=True)
class About:
    """What of a rig decides which effects it can have and show: whether it is a vehicle, on tracks; what is imposed,
    its channels; whether it has rows backward, and at least three rows whose load drives the motor; how many slopes
    and payloads."""

    vehicle: bool
    tracks: bool
    imposed: str
    channels: tuple[str, ...]
    reverse: bool
    driven: bool
    slopes: int
    payloads: int

    def has(self, *names: str) -> bool:
        """Whether it has any of these channels."""
        return bool(set(names) & set(self.channels))

    @property
    def electric(self) -> bool:
        """Whether anything shows the electrical balance: a voltage imposed or read, and beside it two more readings of
        three unknowns would leave its equation closed only by its constants."""
        return self.imposed != "motor_speed" or self.has("motor_voltage")

    @property
    def slips(self) -> bool:
        """Whether ground speed stands beside the speed of the shafts."""
        return self.vehicle and self.has("speed") and (self.imposed == "motor_speed" or self.has("motor_speed"))


def always(about: About) -> bool:
    """Of effects that every rig can have."""
    return True


@dataclasses.dataclass(frozen=True)
class Form:
    """One effect: what it adds to its balance per unit of amplitude.

    Attributes:
        cls: name of the library's effect; "" outside the library.
        balance: where it enters, or the channel whose reading it changes.
        of: (signals, shapes) → term per unit amplitude, shape (rows,); shapes hold those of `shapes`, and `scale`.
        size: scale → amplitude of ordinary size.
        needs: which rigs can have it and show something of it.
        shapes: scale → bounds from which each shape parameter is drawn, uniformly.
        either: whether amplitudes of both signs occur.
    """

    cls: str
    balance: str
    of: Callable[[SimpleNamespace, Mapping[str, float]], np.ndarray]
    size: Callable[[SimpleNamespace], float]
    needs: Callable[[About], bool] = always
    shapes: Callable[[SimpleNamespace], Mapping[str, tuple[float, float]]] = lambda r: {}
    either: bool = False

    def grid(self, scale: SimpleNamespace) -> list[dict[str, float]]:
        """Shapes between their bounds, five of each."""
        bounds = self.shapes(scale)
        values = [np.geomspace(*b, 5).tolist() for b in bounds.values()]
        return [dict(zip(bounds, v, strict=True)) for v in itertools.product(*values)]


@dataclasses.dataclass(frozen=True)
class Term:
    """One form with its amplitude and shape parameters, at the scale of a rig."""

    name: str
    amplitude: float
    shapes: Mapping[str, float]
    form: Form
    scale: SimpleNamespace

    @property
    def size(self) -> float:
        """Its ordinary amplitude at this rig."""
        return self.form.size(self.scale)

    def of(self, s: SimpleNamespace) -> np.ndarray:
        """What it adds at these signals."""
        return self.amplitude * self.form.of(s, self.shapes)


def draw(name: str, rng: np.random.Generator, scale: SimpleNamespace) -> Term:
    """A term of unit amplitude (of its ordinary sign) with its shape parameters drawn."""
    form = FORMS[name]
    sign = float(rng.choice((-1.0, 1.0))) if form.either else 1.0
    return Term(name, sign, {k: float(rng.uniform(*b)) for k, b in form.shapes(scale).items()}, form, scale)


def _lag(x: np.ndarray, x_c: float) -> np.ndarray:
    """2x/(1+x²): loss modulus of a Maxwell element, torque of an eddy-current brake."""
    return 2 * (x / x_c) / (1 + (x / x_c) ** 2)


def _motor(share: float) -> Callable[[SimpleNamespace], float]:
    """A share of the motor's torque at its largest current."""
    return lambda r: share * r.C * r.current


def _output(share: float) -> Callable[[SimpleNamespace], float]:
    return lambda r: share * r.torque


def _fade_motor(r: SimpleNamespace) -> dict[str, tuple[float, float]]:
    return {"fade": (0.12 * r.w, 0.45 * r.w)}


def _fade_output(r: SimpleNamespace) -> dict[str, tuple[float, float]]:
    return {"fade": (0.12 * r.w_k, 0.45 * r.w_k)}


def _vehicle(a: About) -> bool:
    return a.vehicle


def _sloped(a: About) -> bool:
    return a.vehicle and a.slopes >= 3


def _electric(a: About) -> bool:
    return a.electric


def _slips(a: About) -> bool:
    return a.slips


def _varied(a: About) -> bool:
    return a.slips and a.slopes * a.payloads >= 3


def _ammeter(a: About) -> bool:
    return a.has("total_current")


#: Effects of the library that settled runs of some rig show, by their equations.
LIBRARY: dict[str, Form] = {
    "mass_error": Form("mass_error", "mass", lambda s, q: s.M, lambda r: 0.05, _sloped, either=True),
    "supply_sag": Form("supply_sag", "supply", lambda s, q: s.line, lambda r: 0.02 * r.supply / (r.sides * r.current), lambda a: a.imposed != "motor_speed"),
    "series_resistance": Form("series_resistance", "electrical", lambda s, q: s.I, lambda r: 0.05 * r.supply / r.current, _electric),
    "brush_drop": Form("brush_drop", "electrical", lambda s, q: s.I / np.hypot(s.I, q["knee"]), lambda r: 0.03 * r.supply, _electric, lambda r: {"knee": (min(0.05 * r.current, 0.3), min(0.3 * r.current, 0.9))}),
    "windage": Form("windage", "motor", lambda s, q: s.w * abs(s.w), lambda r: _motor(0.06)(r) / r.w**2),
    "stribeck_motor": Form("stribeck_motor", "motor", lambda s, q: np.exp(-abs(s.w) / q["fade"]) * s.d, _motor(0.06), shapes=_fade_motor),
    "iron_loss": Form("iron_loss", "motor", lambda s, q: _lag(s.w, q["critical"]), _motor(0.06), shapes=lambda r: {"critical": (0.3 * r.w, 1.2 * r.w)}),
    "torque_constant_saturation": Form("torque_constant_saturation", "motor", lambda s, q: s.C * s.I**3, lambda r: 0.15 / max(r.current, r.rated) ** 2),
    "gear_load_loss": Form("gear_load_loss", "gearbox", lambda s, q: abs(s.B) * s.d, lambda r: 0.05),
    "gear_quadratic_loss": Form("gear_quadratic_loss", "gearbox", lambda s, q: s.B**2 * s.d, lambda r: 0.06 / r.torque),
    "stribeck_gear": Form("stribeck_gear", "gearbox", lambda s, q: np.exp(-abs(s.w) / q["fade"]) * s.d, _output(0.06), shapes=_fade_motor),
    "backdriving_loss": Form("backdriving_loss", "gearbox", lambda s, q: np.maximum(-s.B * s.d, 0.0) * s.d, lambda r: 0.1, lambda a: a.driven),
    "churning": Form("churning", "track", lambda s, q: s.w_k**2 * s.d, lambda r: _output(0.06)(r) / r.w_k**2),
    "stribeck_track": Form("stribeck_track", "track", lambda s, q: np.exp(-abs(s.w_k) / q["fade"]) * s.d, _output(0.06), shapes=_fade_output),
    "stribeck_exponent": Form("stribeck_exponent", "track", lambda s, q: np.exp(-((s.w_k / q["fade"]) ** 2)) * s.d, _output(0.06), shapes=_fade_output),
    "bending_loss": Form("bending_loss", "track", lambda s, q: _lag(s.w_k, q["relaxation"]), _output(0.06), shapes=lambda r: {"relaxation": (0.25 * r.w_k, 0.8 * r.w_k)}),
    "directional_friction": Form("directional_friction", "track", lambda s, q: np.ones_like(s.I), _output(0.05), lambda a: a.reverse, either=True),
    "tension_friction": Form("tension_friction", "track", lambda s, q: abs(s.pull) * s.d, lambda r: 0.1, _sloped),
    "speed_rolling": Form("speed_rolling", "ground", lambda s, q: s.N * s.V**2 * s.d, lambda r: 0.02 / r.V_teor**2, _vehicle),
    "adhesive_drag": Form("adhesive_drag", "ground", lambda s, q: (1 + (s.V / q["peel"]) ** 2) ** 0.3 * s.d, lambda r: 0.02 * r.N / (r.V_teor / 1e-3) ** 0.6, _vehicle, lambda r: {"peel": (5e-4, 5e-3)}),
    "weight_transfer": Form("weight_transfer", "ground", lambda s, q: s.N * np.tan(s.slope) ** 2 * s.d, lambda r: 0.2, _sloped),
    "sinkage": Form("sinkage", "ground", lambda s, q: s.N * (s.M / s.M_own) ** (1 / q["exponent"]) * s.d, lambda r: 0.02, lambda a: a.vehicle and a.payloads >= 2, lambda r: {"exponent": (0.6, 1.4)}),
    "slope_bias": Form("slope_bias", "ground", lambda s, q: s.N, lambda r: 9e-3, _vehicle, either=True),
    "rolling_radius": Form("rolling_radius", "slip", lambda s, q: -s.V_teor, lambda r: 0.03, _slips, either=True),
    "belt_creep": Form("belt_creep", "slip", lambda s, q: s.D * s.V_teor * s.d, lambda r: 0.02 / r.D, _varied),
    "nonlinear_slip": Form("nonlinear_slip", "slip", lambda s, q: np.clip(s.D / s.D_max, -2, 2) ** 3 * s.V_teor * s.d, lambda r: 0.05, _varied),
    "speed_slip": Form("speed_slip", "slip", lambda s, q: s.V_teor**2 * s.d, lambda r: 0.02 / r.V_teor, _slips),
    "load_slip": Form("load_slip", "slip", lambda s, q: s.N * s.V_teor, lambda r: 0.01 / r.N, _slips),
    "ammeter_gain": Form("ammeter_gain", "total_current", lambda s, q: s.line, lambda r: 0.03, _ammeter, either=True),
    "ammeter_offset": Form("ammeter_offset", "total_current", lambda s, q: np.ones_like(s.I), lambda r: 0.04 * r.line, _ammeter, either=True),
    "encoder_scale": Form("encoder_scale", "motor_speed", lambda s, q: s.w, lambda r: 0.01, lambda a: a.has("motor_speed"), either=True),
    "speed_gain": Form("speed_gain", "speed", lambda s, q: s.V, lambda r: 0.02, lambda a: a.has("speed"), either=True),
}  # fmt: skip

#: Forms that the library does not hold.
OUTSIDE: dict[str, Form] = {
    # rolling bearings between mixed and full lubrication: friction as the root of speed, beyond a speed where it sets in
    "root_friction": Form("", "motor", lambda s, q: np.sqrt(np.maximum(abs(s.w) - q["from"], 0.0)) * s.d, lambda r: _motor(0.08)(r) / np.sqrt(r.w), shapes=lambda r: {"from": (0.3 * r.w, 0.6 * r.w)}),
    # a seal that lets go at a speed: a step of the load's friction
    "friction_step": Form("", "track", lambda s, q: 0.5 * (1 + np.tanh((abs(s.w_k) - q["at"]) / (0.06 * q["at"]))) * s.d, _output(0.06), shapes=lambda r: {"at": (0.45 * r.w_k, 0.75 * r.w_k)}),
    # a resonance of the gear at one speed
    "resonance_bump": Form("", "gearbox", lambda s, q: np.exp(-(((abs(s.w) - q["at"]) / (0.12 * q["at"])) ** 2)) * s.d, _output(0.08), shapes=lambda r: {"at": (0.45 * r.w, 0.8 * r.w)}),
    # an ammeter whose gain depends on its own current and on the speed at which brushes commutate
    "ammeter_two_things": Form("", "total_current", lambda s, q: s.line * np.tanh(3 * (abs(s.w) / q["w"] - 0.6)) * abs(s.I) / q["I"], lambda r: 0.04, _ammeter, lambda r: {"w": (0.999 * r.w, r.w), "I": (0.999 * r.current, r.current)}, True),
    # speed read over a wheel that is pressed flat by load and grows with speed together
    "speed_two_things": Form("", "speed", lambda s, q: s.V * (s.D / q["D"]) * np.tanh(3 * (abs(s.V_teor) / q["V"] - 0.6)), lambda r: 0.03, _varied, lambda r: {"D": (0.999 * r.D, r.D), "V": (0.999 * r.V_teor, r.V_teor)}, True),
    # brushes arc above a voltage of the winding's own: a step of the drop
    "commutation_step": Form("", "electrical", lambda s, q: 0.5 * (1 + np.tanh((abs(s.w) - q["at"]) / (0.06 * q["at"]))) * s.d, lambda r: 0.04 * r.supply, _electric, lambda r: {"at": (0.45 * r.w, 0.75 * r.w)}),
    # a regulator that hunts with the load
    "supply_hunting": Form("", "supply", lambda s, q: np.sin(2 * np.pi * s.line / q["period"]) * s.d, lambda r: 0.02 * r.supply, lambda a: a.imposed == "voltage" and a.slopes * a.payloads >= 3, lambda r: {"period": (0.35 * r.line, 0.6 * r.line)}),
    # the nose digs in on the slope, up to a limit
    "slope_rolling": Form("", "ground", lambda s, q: s.N * np.tanh(s.slope / q["slope"]) * s.d, lambda r: 0.03, _sloped, lambda r: {"slope": (0.04, 0.1)}),
    # lugs that catch at one speed only when loaded
    "loaded_chatter": Form("", "ground", lambda s, q: s.payload * np.exp(-(((abs(s.w_k) - q["at"]) / (0.15 * q["at"])) ** 2)) * s.d, lambda r: 0.2, lambda a: a.vehicle and a.payloads >= 2, lambda r: {"at": (0.5 * r.w_k, 0.8 * r.w_k)}),
    # teeth climb and jump back when speed and slope are high together
    "tooth_climb": Form("", "slip", lambda s, q: s.V_teor * s.slope * np.maximum(abs(s.w) / q["w"] - 0.5, 0.0), lambda r: 0.3, lambda a: a.slips and a.slopes >= 3, lambda r: {"w": (0.999 * r.w, r.w)}),
}  # fmt: skip

FORMS: dict[str, Form] = LIBRARY | OUTSIDE
