"""Laws of effects, each written once: those of the library by their equations, variants of them, and others.

A law is written in the signals of `settled` or `histories`. `d` is the direction in which parts turn, 1 or -1, softened
about rest in histories. Sizes and shapes are of the paper's robot. Those of a rig (`RIGS`) follow from its `scale`, which
holds the largest size of each signal over its rows, `torque` [N·m] at the output, `current` [A] of one motor, and `rated`
[A], 0.3 of that at stall.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np

CHANNELS = ("total_current", "motor_speed", "speed")


def _always(about: Any) -> bool:
    return True


@dataclasses.dataclass(frozen=True)
class Law:
    """One undeclared effect: what it adds to its balance per unit of amplitude.

    Attributes:
        cls: name of the library's effect whose place it takes, "" outside the library.
        balance: where it enters, or the channel whose reading it changes.
        of: (signals, shapes) → term per unit amplitude, shape (rows,).
        size: amplitude of ordinary size, which sets its sign and the step of differences. Of RIGS, scale → size.
        shapes: bounds from which each shape parameter is drawn, uniformly. Of RIGS, scale → bounds.
        either: whether amplitudes of both signs occur.
        needs: which rigs (`rigs.About`) can have it and show something of it.
    """

    cls: str
    balance: str
    of: Callable[[SimpleNamespace, Mapping[str, float]], Any]
    size: Any
    shapes: Any = dataclasses.field(default_factory=dict)
    either: bool = False
    needs: Callable[[Any], bool] = _always

    def at(self, scale: SimpleNamespace) -> Law:
        """The law of a rig with its size and shapes in numbers."""
        return dataclasses.replace(self, size=self.size(scale), shapes=self.shapes(scale))

    def grid(self, values: int = 5) -> list[dict[str, float]]:
        """Shapes between their bounds, so many of each."""
        spread = {True: np.geomspace, False: np.linspace}
        each = [spread[low > 0](low, high, values).tolist() for low, high in self.shapes.values()]
        return [dict(zip(self.shapes, point, strict=True)) for point in itertools.product(*each)]


@dataclasses.dataclass(frozen=True)
class Term:
    """An amplitude of a law with its shape parameters. `law` is the one of FORMS under its name where none is given."""

    name: str
    amplitude: Any
    shapes: Mapping[str, float] = dataclasses.field(default_factory=dict)
    law: Law = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        if self.law is None:
            object.__setattr__(self, "law", FORMS[self.name])

    def of(self, s: SimpleNamespace) -> np.ndarray:
        """What it adds at these signals."""
        return self.amplitude * self.law.of(s, self.shapes)

    @property
    def label(self) -> dict[str, Any]:
        """What the label of a case says of it, without what it leaves."""
        sensor = self.law.balance in READ
        return {
            "name": str(self.name), "class": self.law.cls, "balance": "sensor" if sensor else self.law.balance,
            "channel": self.law.balance if sensor else "", "amplitude": self.amplitude,
            "sizes": abs(self.amplitude) / self.law.size, "shapes": dict(self.shapes),
        }  # fmt: skip


def shaped(name: str, rng: np.random.Generator, law: Law) -> Term:
    """A term of unit amplitude with its shape parameters drawn."""
    return Term(name, 1.0, {k: float(rng.uniform(*b)) for k, b in law.shapes.items()}, law)


def draw(name: str, rng: np.random.Generator, law: Law | None = None) -> Term:
    """The same with the sign drawn where both occur. `law`: else the one of FORMS."""
    law = law or FORMS[name]
    sign = float(rng.choice((-1.0, 1.0))) if law.either else 1.0
    return dataclasses.replace(shaped(name, rng, law), amplitude=sign)


def total(terms: Any, balance: str, s: SimpleNamespace) -> Any:
    """What terms add to a balance, or to a channel."""
    return sum((t.of(s) for t in terms if t.law.balance == balance), 0.0)


#: Channels whose reading a law may change.
READ = (*CHANNELS, "motor_current", "output_speed", "motor_voltage", "output_torque")


def _lag(x: np.ndarray, x_c: float) -> np.ndarray:
    """2x/(1+x²): loss modulus of a Maxwell element, torque of an eddy-current brake."""
    return 2 * (x / x_c) / (1 + (x / x_c) ** 2)


def _fade(x: np.ndarray) -> np.ndarray:
    """1 below 1, 0 above 2: a cubic in x² between."""
    u = np.clip((x**2 - 1) / 3, 0, 1)
    return 1 - u**2 * (3 - 2 * u)


# --- of the paper's robot -----------------------------------------------------------------------------

COPPER = 0.00393  # [1/K]
_W_S, _WK_S, _PHASE = {"fade": (150.0, 600.0)}, {"fade": (5.0, 16.0)}, {"phase": (-3.0, 3.0)}

#: Every effect of the library that steady runs forward, up slopes, can show, by its equation.
LIBRARY: dict[str, Law] = {
    "mass_error": Law("mass_error", "mass", lambda s, q: s.M, 0.03, either=True),
    "mass_offset": Law("mass_offset", "mass", lambda s, q: s.wheeled, 1.0, either=True),
    "supply_sag": Law("supply_sag", "supply", lambda s, q: s.line, 0.2),
    "series_resistance": Law("series_resistance", "electrical", lambda s, q: s.I, 0.4),
    "brush_drop": Law("brush_drop", "electrical", lambda s, q: s.I / np.hypot(s.I, q["knee"]), 0.5, {"knee": (0.05, 0.2)}),
    "winding_heating": Law("winding_heating", "electrical", lambda s, q: COPPER * 7.7 * s.R**2 * s.I**3, 1.0),
    "torque_constant_saturation": Law("torque_constant_saturation", "motor", lambda s, q: s.C * s.I**3, 3e-3),
    "windage": Law("windage", "motor", lambda s, q: s.w**2 * s.d, 5e-10),
    "stribeck_motor": Law("stribeck_motor", "motor", lambda s, q: np.exp(-abs(s.w) / q["fade"]) * s.d, 1.5e-3, _W_S),
    "iron_loss": Law("iron_loss", "motor", lambda s, q: _lag(s.w, q["critical"]), 1e-3, {"critical": (400.0, 1600.0)}),
    "gear_load_loss": Law("gear_load_loss", "gearbox", lambda s, q: abs(s.B) * s.d, 0.05),
    "gear_quadratic_loss": Law("gear_quadratic_loss", "gearbox", lambda s, q: s.B**2 * s.d, 0.03),
    "stribeck_gear": Law("stribeck_gear", "gearbox", lambda s, q: np.exp(-abs(s.w) / q["fade"]) * s.d, 0.05, _W_S),
    "churning": Law("churning", "track", lambda s, q: s.w_k**2 * s.d, 5e-4),
    "stribeck_track": Law("stribeck_track", "track", lambda s, q: np.exp(-abs(s.w_k) / q["fade"]) * s.d, 0.1, _WK_S),
    "tension_friction": Law("tension_friction", "track", lambda s, q: abs(s.pull) * s.d, 0.1),
    "centrifugal_tension": Law("centrifugal_tension", "track", lambda s, q: s.M_t0 * (s.r_pulley * s.w_k) ** 2, 0.05),
    "bending_loss": Law("bending_loss", "track", lambda s, q: _lag(s.w_k, q["relaxation"]), 0.05, {"relaxation": (4.0, 16.0)}),
    "stribeck_exponent": Law("stribeck_exponent", "track", lambda s, q: np.exp(-(np.hypot(s.w_k / q["fade"], 1e-3) ** q["exponent"])), 0.1, _WK_S | {"exponent": (1.5, 2.5)}),
    "speed_rolling": Law("speed_rolling", "ground", lambda s, q: s.N * s.V**2 * s.d, 0.01),
    "adhesive_drag": Law("adhesive_drag", "ground", lambda s, q: (1 + (s.V / q["peel"]) ** 2) ** 0.3 * s.d, 0.02, {"peel": (5e-4, 5e-3)}),
    "weight_transfer": Law("weight_transfer", "ground", lambda s, q: s.N * np.tan(s.slope) ** 2 * s.d, 0.2),
    "sinkage": Law("sinkage", "ground", lambda s, q: s.N * (s.M / s.M_own) ** (1 / q["exponent"]) * s.d, 0.02, {"exponent": (0.6, 1.4)}),
    "slope_bias": Law("slope_bias", "ground", lambda s, q: s.N, 9e-3, either=True),
    "rolling_radius": Law("rolling_radius", "slip", lambda s, q: -s.V_teor, 0.03, either=True),
    "belt_creep": Law("belt_creep", "slip", lambda s, q: s.D * s.V_teor * s.d, 5e-4),
    "nonlinear_slip": Law("nonlinear_slip", "slip", lambda s, q: np.clip(s.D / s.D_max, -2, 2) ** 3 * s.V_teor * s.d, 0.05),
    "speed_slip": Law("speed_slip", "slip", lambda s, q: s.V_teor**2 * s.d, 0.02),
    "load_slip": Law("load_slip", "slip", lambda s, q: s.N * s.V_teor, 1e-4),
    "vibration_slip": Law("vibration_slip", "slip", lambda s, q: (1 - s.wheeled) * np.hypot(s.V_teor, 1e-3) ** q["exponent"] * s.D / s.D_max / np.hypot(1 - abs(s.D / s.D_max), 0.05), 0.02, {"exponent": (1.3, 2.7)}),
    "ammeter_gain": Law("ammeter_gain", "total_current", lambda s, q: s.line, 0.02, either=True),
    "ammeter_offset": Law("ammeter_offset", "total_current", lambda s, q: np.ones_like(s.I), 0.1, either=True),
    "encoder_scale": Law("encoder_scale", "motor_speed", lambda s, q: s.w, 0.01, either=True),
    "speed_gain": Law("speed_gain", "speed", lambda s, q: s.V, 0.02, either=True),
}  # fmt: skip

#: The same causes in another functional form than the library's.
VARIANTS: dict[str, Law] = {
    "supply_sag.diode": Law("supply_sag", "supply", lambda s, q: np.log1p(s.line / 0.2), 0.2),
    "brush_drop.tanh": Law("brush_drop", "electrical", lambda s, q: np.tanh(s.I / 0.4), 0.5),
    "winding_heating.hot": Law("winding_heating", "electrical", lambda s, q: s.R * s.I * (lambda t: t / (1 - np.minimum(t, 0.8)))(COPPER * 7.7 * s.R * s.I**2), 1.0),
    "torque_constant_saturation.linear": Law("torque_constant_saturation", "motor", lambda s, q: s.C * s.I * abs(s.I), 0.01),
    "windage.power": Law("windage", "motor", lambda s, q: (s.w / 1000) ** 2.6, 5e-4),
    "stribeck_motor.gauss": Law("stribeck_motor", "motor", lambda s, q: np.exp(-((s.w / 600) ** 2)), 1.5e-3),
    "iron_loss.excess": Law("iron_loss", "motor", lambda s, q: np.sqrt(abs(s.w) / 1000), 1e-3),
    "gear_quadratic_loss.power": Law("gear_quadratic_loss", "gearbox", lambda s, q: abs(s.B) ** 1.5, 0.04),
    "stribeck_gear.gauss": Law("stribeck_gear", "gearbox", lambda s, q: np.exp(-((s.w / 600) ** 2)), 0.05),
    "churning.power": Law("churning", "track", lambda s, q: s.w_k**2.5, 1e-4),
    "stribeck_track.lorentz": Law("stribeck_track", "track", lambda s, q: 1 / (1 + (s.w_k / 14) ** 2), 0.1),
    "tension_friction.power": Law("tension_friction", "track", lambda s, q: s.r * abs(s.P) ** 1.3, 0.04),
    "bending_loss.power": Law("bending_loss", "track", lambda s, q: (abs(s.w_k) / 10) ** 0.3, 0.05),
    "speed_rolling.linear": Law("speed_rolling", "ground", lambda s, q: s.N * abs(s.V), 0.01),
    "adhesive_drag.power": Law("adhesive_drag", "ground", lambda s, q: abs(s.V) ** 0.35, 1.0),
    "weight_transfer.versine": Law("weight_transfer", "ground", lambda s, q: s.N * abs(np.sin(s.slope)) ** 1.5, 0.2),
    "sinkage.linear": Law("sinkage", "ground", lambda s, q: s.N * (s.M - s.M_own) / s.M_own, 0.02),
    "belt_creep.stiffening": Law("belt_creep", "slip", lambda s, q: s.V_teor * s.D / (1 + abs(s.D) / 60), 5e-4),
    "nonlinear_slip.janosi": Law("nonlinear_slip", "slip", lambda s, q: -s.V_teor * np.log1p(-np.clip(s.D / s.D_max, -0.97, 0.97)), 0.02),
    "speed_slip.cubic": Law("speed_slip", "slip", lambda s, q: s.V_teor**3, 0.02),
    "load_slip.hertz": Law("load_slip", "slip", lambda s, q: s.V_teor * s.N ** (2 / 3), 5e-4),
}  # fmt: skip

#: Forms that the library does not hold.
OUTSIDE: dict[str, Law] = {
    # brushes arc above a voltage: a step of the drop
    "commutation_step": Law("", "electrical", lambda s, q: 0.5 * (1 + np.tanh((s.U - q["at"]) / 2)), 0.6, {"at": (18.0, 21.0)}),
    # half-wave of a supply whose regulator hunts with the load
    "supply_hunting": Law("", "supply", lambda s, q: np.sin(2 * np.pi * s.line / q["period"]), 0.3, {"period": (2.0, 4.0)}),
    # grease thins as the gear's own loss warms it: viscous torque that falls with power
    "gear_viscosity": Law("", "gearbox", lambda s, q: s.w_k * np.exp(-abs(s.B * s.w_k) / q["power"]), 0.01, {"power": (8.0, 20.0)}),
    # teeth rattle in their backlash while little load keeps them together
    "backlash_dither": Law("", "gearbox", lambda s, q: np.exp(-abs(s.B) / q["load"]), 0.2, {"load": (0.3, 0.8)}),
    # a span of the belt resonates at one speed
    "resonance_bump": Law("", "track", lambda s, q: np.exp(-(((s.w_k - q["at"]) / 2) ** 2)), 0.1, {"at": (13.0, 19.0)}),
    # the payload bends the chassis until the guides bind
    "guide_binding": Law("", "track", lambda s, q: np.maximum(s.payload - q["from"], 0) ** 2 / 25, 0.2, {"from": (1.0, 3.0)}),
    # the nose digs in on the slope, up to a limit
    "slope_rolling": Law("", "ground", lambda s, q: s.N * np.tanh(s.slope / q["slope"]), 0.02, {"slope": (0.04, 0.12)}),
    # lugs that catch at one speed only when loaded
    "loaded_chatter": Law("", "ground", lambda s, q: s.payload * np.exp(-(((s.V - q["at"]) / 0.12) ** 2)), 0.3, {"at": (0.6, 0.9)}),
    # teeth climb and jump back when voltage and slope are high together
    "tooth_climb": Law("", "slip", lambda s, q: s.V_teor * s.slope * np.maximum(s.U - q["from"], 0) / 10, 0.05, {"from": (15.0, 20.0)}),
}  # fmt: skip

FORMS: dict[str, Law] = LIBRARY | VARIANTS | OUTSIDE

#: Effects of the library that need a history, by its equations.
TRANSIENT: dict[str, Law] = {
    "pulley_eccentricity": Law("pulley_eccentricity", "slip", lambda s, q: -s.V_teor * np.sin(s.turn + q["phase"]), 0.01, _PHASE),
    "grouser_polygon": Law("grouser_polygon", "ground", lambda s, q: np.sin(2 * np.pi * s.r * s.turn / 35e-3 + q["phase"]) * (1 - s.wheeled), 1.0, _PHASE),
    "cogging": Law("cogging", "motor", lambda s, q: np.sin(26 * s.theta + q["phase"]) * _fade(26 * s.w / 1000), 5e-4, _PHASE),
    "rotating_inertia": Law("rotating_inertia", "inertia", lambda s, q: np.ones_like(s.w), 5e-4),
    "armature_inductance": Law("armature_inductance", "inductance", lambda s, q: np.ones_like(s.w), 1e-4),
    "thermal_drift": Law("thermal_drift", "electrical", lambda s, q: COPPER * s.R * s.I * s.T, 1.0),
    "battery_sag": Law("battery_sag", "supply", lambda s, q: s.q * s.battery, 0.2),
    "stick_slip": Law("stick_slip", "track", lambda s, q: s.z, 0.1),
    "presliding": Law("presliding", "track", lambda s, q: s.b - s.d, 0.1),
    "bristle_load_loss": Law("bristle_load_loss", "gearbox", lambda s, q: abs(s.B) * s.b, 0.05),
    "bristle_backdriving_loss": Law("bristle_backdriving_loss", "gearbox", lambda s, q: (abs(s.B) * s.b - s.B * s.b**2) / 2, 0.1),
    "angle_friction": Law("angle_friction", "track", lambda s, q: np.sin(s.turn + q["phase"]) * s.d, 0.05, _PHASE),
    "position_friction": Law("position_friction", "track", lambda s, q: s.turn * s.d, 0.01),
}  # fmt: skip
#: What only a history shows and the library does not hold.
OUTSIDE_SERIES: dict[str, Law] = {
    # a bent shaft (order 2 of the pulley), a belt splice (once a turn of the belt),
    # a supply that recovers after its inrush, oil that warms with the way travelled
    "pulley_ovality": Law("", "track", lambda s, q: np.sin(2 * s.turn + q["phase"]), 0.05, _PHASE),
    "belt_splice": Law("", "track", lambda s, q: np.exp(20 * (np.cos(s.r * s.turn * 2 * np.pi / 0.84 + q["phase"]) - 1)) * s.d, 0.2, _PHASE),
    "supply_recovery": Law("", "supply", lambda s, q: np.exp(-s.time / 0.4), 1.0),
    "oil_warming": Law("", "gearbox", lambda s, q: np.exp(-abs(s.theta) / 1000) * s.d, 0.2),
}  # fmt: skip
#: Of histories: effects of the library, and others.
SERIES: dict[str, Law] = {
    **TRANSIENT,
    **{n: LIBRARY[n] for n in ("series_resistance", "churning", "supply_sag", "brush_drop", "windage", "stribeck_track",
                               "rolling_radius", "speed_slip", "load_slip")},
    **OUTSIDE_SERIES,
}  # fmt: skip


# --- of rigs --------------------------------------------------------------------------------------------


def _motor(share: float) -> Callable[[SimpleNamespace], float]:
    """A share of the motor's torque at its largest current."""
    return lambda r: share * r.C * r.current


def _output(share: float) -> Callable[[SimpleNamespace], float]:
    return lambda r: share * r.torque


def _fade_motor(r: SimpleNamespace) -> dict[str, tuple[float, float]]:
    return {"fade": (0.12 * r.w, 0.45 * r.w)}


def _fade_output(r: SimpleNamespace) -> dict[str, tuple[float, float]]:
    return {"fade": (0.12 * r.w_k, 0.45 * r.w_k)}


def _vehicle(a: Any) -> bool:
    return a.vehicle


def _sloped(a: Any) -> bool:
    return a.vehicle and a.slopes >= 3


def _electric(a: Any) -> bool:
    return a.electric


def _slips(a: Any) -> bool:
    return a.slips


def _varied(a: Any) -> bool:
    return a.slips and a.slopes * a.payloads >= 3


def _ammeter(a: Any) -> bool:
    return a.has("total_current")


def _no_shapes(r: SimpleNamespace) -> dict[str, tuple[float, float]]:
    return {}


#: Of those that show in rigs alone.
_BOTH_WAYS: dict[str, Law] = {
    "backdriving_loss": Law("backdriving_loss", "gearbox", lambda s, q: np.maximum(-s.B * s.d, 0.0) * s.d, 0.1),
    "directional_friction": Law("directional_friction", "track", lambda s, q: s.d**2, 0.05, either=True),
    "directional_stribeck": Law("directional_stribeck", "track", lambda s, q: np.exp(-abs(s.w_k) / q["fade"]) * s.d**2, 0.05, _WK_S, either=True),
    "coast_decay": Law("coast_decay", "electrical", lambda s, q: -(1 - abs(s.duty)) * s.C * s.w, 0.5),
    "duty_exponent": Law("duty_exponent", "duty", lambda s, q: (s.duty - np.sign(s.duty) * abs(s.duty) ** q["exponent"]) / (q["exponent"] - 1), -0.2, {"exponent": (0.75, 0.85)}),
    "duty_dead_band": Law("duty_dead_band", "duty", lambda s, q: (1 - abs(s.duty)) * np.sign(s.duty), 0.05),
    "duty_saturation": Law("duty_saturation", "duty", lambda s, q: np.maximum(abs(s.duty) - q["full"], 0) * np.sign(s.duty), 0.5, {"full": (0.6, 0.8)}),
}  # fmt: skip


def _rig(name: str, size: Any, needs: Callable[[Any], bool] = _always, shapes: Any = _no_shapes, **own: Any) -> Law:
    """A law of the library at the size of a rig."""
    return dataclasses.replace((LIBRARY | TRANSIENT | _BOTH_WAYS)[name], size=size, needs=needs, shapes=shapes, **own)


#: Effects of the library that settled runs of some rig show.
RIGS: dict[str, Law] = {
    "mass_error": _rig("mass_error", lambda r: 0.05, _sloped),
    "supply_sag": _rig("supply_sag", lambda r: 0.02 * r.supply / (r.sides * r.current), lambda a: a.imposed != "motor_speed"),
    "series_resistance": _rig("series_resistance", lambda r: 0.05 * r.supply / r.current, _electric),
    "brush_drop": _rig("brush_drop", lambda r: 0.03 * r.supply, _electric, lambda r: {"knee": (min(0.05 * r.current, 0.3), min(0.3 * r.current, 0.9))}),
    "windage": _rig("windage", lambda r: _motor(0.06)(r) / r.w**2),
    "stribeck_motor": _rig("stribeck_motor", _motor(0.06), shapes=_fade_motor),
    "iron_loss": _rig("iron_loss", _motor(0.06), shapes=lambda r: {"critical": (0.3 * r.w, 1.2 * r.w)}),
    "torque_constant_saturation": _rig("torque_constant_saturation", lambda r: 0.15 / max(r.current, r.rated) ** 2),
    "gear_load_loss": _rig("gear_load_loss", lambda r: 0.05),
    "gear_quadratic_loss": _rig("gear_quadratic_loss", lambda r: 0.06 / r.torque),
    "stribeck_gear": _rig("stribeck_gear", _output(0.06), shapes=_fade_motor),
    "backdriving_loss": _rig("backdriving_loss", lambda r: 0.1, lambda a: a.driven),
    "churning": _rig("churning", lambda r: _output(0.06)(r) / r.w_k**2),
    "stribeck_track": _rig("stribeck_track", _output(0.06), shapes=_fade_output),
    "stribeck_exponent": _rig("stribeck_exponent", _output(0.06), shapes=_fade_output, of=lambda s, q: np.exp(-((s.w_k / q["fade"]) ** 2)) * s.d),
    "bending_loss": _rig("bending_loss", _output(0.06), shapes=lambda r: {"relaxation": (0.25 * r.w_k, 0.8 * r.w_k)}),
    "directional_friction": _rig("directional_friction", _output(0.05), lambda a: a.reverse),
    "directional_stribeck": _rig("directional_stribeck", _output(0.05), lambda a: a.reverse, _fade_output),
    "coast_decay": _rig("coast_decay", lambda r: 0.2, lambda a: a.imposed == "duty"),
    "duty_exponent": _rig("duty_exponent", lambda r: -0.2, lambda a: a.imposed == "duty", lambda r: {"exponent": (0.75, 0.85)}),
    "duty_dead_band": _rig("duty_dead_band", lambda r: 0.05, lambda a: a.imposed == "duty"),
    "duty_saturation": _rig("duty_saturation", lambda r: 0.5, lambda a: a.imposed == "duty", lambda r: {"full": (0.6, 0.8)}),
    "tension_friction": _rig("tension_friction", lambda r: 0.1, _sloped),
    "speed_rolling": _rig("speed_rolling", lambda r: 0.02 / r.V_teor**2, _vehicle),
    "adhesive_drag": _rig("adhesive_drag", lambda r: 0.02 * r.N / (r.V_teor / 1e-3) ** 0.6, _vehicle, lambda r: {"peel": (5e-4, 5e-3)}),
    "weight_transfer": _rig("weight_transfer", lambda r: 0.2, _sloped),
    "sinkage": _rig("sinkage", lambda r: 0.02, lambda a: a.vehicle and a.payloads >= 2, lambda r: {"exponent": (0.6, 1.4)}),
    "slope_bias": _rig("slope_bias", lambda r: 9e-3, _vehicle),
    "rolling_radius": _rig("rolling_radius", lambda r: 0.03, _slips),
    "belt_creep": _rig("belt_creep", lambda r: 0.02 / r.D, _varied),
    "nonlinear_slip": _rig("nonlinear_slip", lambda r: 0.05, _varied),
    "speed_slip": _rig("speed_slip", lambda r: 0.02 / r.V_teor, _slips),
    "load_slip": _rig("load_slip", lambda r: 0.01 / r.N, _slips),
    "ammeter_gain": _rig("ammeter_gain", lambda r: 0.03, _ammeter),
    "ammeter_offset": _rig("ammeter_offset", lambda r: 0.04 * r.line, _ammeter),
    "encoder_scale": _rig("encoder_scale", lambda r: 0.01, lambda a: a.has("motor_speed")),
    "speed_gain": _rig("speed_gain", lambda r: 0.02, lambda a: a.has("speed")),
}  # fmt: skip


def _new(
    balance: str, of: Any, size: Any, needs: Any = _always, shapes: Any = _no_shapes, either: bool = False
) -> Law:
    return Law("", balance, of, size, shapes, either, needs)


#: Forms that the library does not hold, of rigs.
OUTSIDE_RIGS: dict[str, Law] = {
    # rolling bearings between mixed and full lubrication: friction as the root of speed, beyond a speed where it sets in
    "root_friction": _new("motor", lambda s, q: np.sqrt(np.maximum(abs(s.w) - q["from"], 0.0)) * s.d, lambda r: _motor(0.08)(r) / np.sqrt(r.w), shapes=lambda r: {"from": (0.3 * r.w, 0.6 * r.w)}),
    # a seal that lets go at a speed: a step of the load's friction
    "friction_step": _new("track", lambda s, q: 0.5 * (1 + np.tanh((abs(s.w_k) - q["at"]) / (0.06 * q["at"]))) * s.d, _output(0.06), shapes=lambda r: {"at": (0.45 * r.w_k, 0.75 * r.w_k)}),
    # a resonance of the gear at one speed
    "resonance_bump": _new("gearbox", lambda s, q: np.exp(-(((abs(s.w) - q["at"]) / (0.12 * q["at"])) ** 2)) * s.d, _output(0.08), shapes=lambda r: {"at": (0.45 * r.w, 0.8 * r.w)}),
    # an ammeter whose gain depends on its own current and on the speed at which brushes commutate
    "ammeter_two_things": _new("total_current", lambda s, q: s.line * np.tanh(3 * (abs(s.w) / q["w"] - 0.6)) * abs(s.I) / q["I"], lambda r: 0.04, _ammeter, lambda r: {"w": (0.999 * r.w, r.w), "I": (0.999 * r.current, r.current)}, True),
    # speed read over a wheel that is pressed flat by load and grows with speed together
    "speed_two_things": _new("speed", lambda s, q: s.V * (s.D / q["D"]) * np.tanh(3 * (abs(s.V_teor) / q["V"] - 0.6)), lambda r: 0.03, _varied, lambda r: {"D": (0.999 * r.D, r.D), "V": (0.999 * r.V_teor, r.V_teor)}, True),
    # brushes arc above a voltage of the winding's own: a step of the drop
    "commutation_step": _new("electrical", lambda s, q: 0.5 * (1 + np.tanh((abs(s.w) - q["at"]) / (0.06 * q["at"]))) * s.d, lambda r: 0.04 * r.supply, _electric, lambda r: {"at": (0.45 * r.w, 0.75 * r.w)}),
    # a regulator that hunts with the load
    "supply_hunting": _new("supply", lambda s, q: np.sin(2 * np.pi * s.line / q["period"]) * s.d, lambda r: 0.02 * r.supply, lambda a: a.imposed == "voltage" and a.slopes * a.payloads >= 3, lambda r: {"period": (0.35 * r.line, 0.6 * r.line)}),
    # the nose digs in on the slope, up to a limit
    "slope_rolling": _new("ground", lambda s, q: s.N * np.tanh(s.slope / q["slope"]) * s.d, lambda r: 0.03, _sloped, lambda r: {"slope": (0.04, 0.1)}),
    # lugs that catch at one speed only when loaded
    "loaded_chatter": _new("ground", lambda s, q: s.payload * np.exp(-(((abs(s.w_k) - q["at"]) / (0.15 * q["at"])) ** 2)) * s.d, lambda r: 0.2, lambda a: a.vehicle and a.payloads >= 2, lambda r: {"at": (0.5 * r.w_k, 0.8 * r.w_k)}),
    # teeth climb and jump back when speed and slope are high together
    "tooth_climb": _new("slip", lambda s, q: s.V_teor * s.slope * np.maximum(abs(s.w) / q["w"] - 0.5, 0.0), lambda r: 0.3, lambda a: a.slips and a.slopes >= 3, lambda r: {"w": (0.999 * r.w, r.w)}),
}  # fmt: skip


# --- of logs of a drive and a load on a shaft -----------------------------------------------------------

#: Effects of the library that logs of a rig show, and others: a bent shaft, a seal that lets go at a speed, grease that
#: warms with time, a supply that recovers. Sizes are of the rig's `scale`; `needs` says what may be imposed.
LOGS: dict[str, Law] = {
    "series_resistance": _rig("series_resistance", lambda r: 0.15 * r.resistance, lambda imposed: imposed == "voltage"),
    "torque_constant_saturation": _rig("torque_constant_saturation", lambda r: 0.15 / r.rated**2),
    "gear_quadratic_loss": _rig("gear_quadratic_loss", lambda r: 0.1 / r.torque),
    "churning": _rig("churning", lambda r: 0.1 * r.torque / r.w_k**2),
    "stribeck_track": _rig("stribeck_track", _output(0.1), shapes=lambda r: {"fade": (0.1, 0.3)},
                           of=lambda s, q: np.exp(-abs(s.w_k) / (q["fade"] * s.fast)) * s.d),
    "directional_friction": _rig("directional_friction", _output(0.07), either=True),
    "directional_viscous": Law("directional_viscous", "track", lambda s, q: s.w_k * s.d, lambda r: 0.07 * r.torque / r.w_k, _no_shapes, either=True),
    "directional_stribeck": _rig("directional_stribeck", _output(0.07), shapes=lambda r: {"fade": (0.1, 0.3)},
                                 of=lambda s, q: np.exp(-abs(s.w_k) / (q["fade"] * s.fast)) * s.d**2),
    "presliding": _rig("presliding", _output(0.1)),
    "bristle_load_loss": _rig("bristle_load_loss", lambda r: 0.1),
    "angle_friction": _rig("angle_friction", _output(0.07), shapes=lambda r: _PHASE),
}  # fmt: skip
OUTSIDE_LOGS: dict[str, Law] = {
    "order_two": _new("track", lambda s, q: np.sin(2 * s.turn + q["phase"]), _output(0.07), shapes=lambda r: _PHASE),
    "friction_step": _new("track", lambda s, q: 0.5 * (1 + np.tanh((abs(s.w_k) / s.fast - q["at"]) / 0.03)) * s.d, _output(0.1), shapes=lambda r: {"at": (0.3, 0.6)}),
    "warming": _new("track", lambda s, q: np.exp(-s.time / 0.5) * s.d, _output(0.1)),
    "supply_recovery": _new("electrical", lambda s, q: np.exp(-s.time / 0.3) * np.sign(s.I), lambda r: 0.05 * r.supply, lambda imposed: imposed == "voltage"),
}  # fmt: skip
