"""Sealed data: tables of runs with undeclared effects, from plain NumPy physics that shares nothing with mmrjax.

The base model is that of `reference`, written again for whole tables: Newton's method in NumPy over all
rows at once. Equation numbers are the paper's, symbols too. A case is made in four steps: draw constants
within their tolerances, draw effects, size their amplitudes so that the signature which is left after
refitting the constants has the wanted number of sigmas, read the instruments. `Case.table` is what an
analyst gets; `Case.label` is for the scorer alone and is written to another file.
"""

from __future__ import annotations

import csv
import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from reference import NOMINAL, SIDES, G

# --- what is known of the robot ---------------------------------------------------------------------

#: Constants of a robot that climbs 20 degrees: `reference.NOMINAL` on a surface that holds.
CLIMBING: dict[str, float] = dict(NOMINAL)
for _c in ("6T2A", "4W2T"):
    CLIMBING |= {f"{_c}.ground.friction.static": 0.60, f"{_c}.ground.friction.dynamic": 0.48}

#: Relative standard deviation within which a constant is known (guide share: of its nominal 0.3).
TOLERANCES: dict[str, float] = {
    "motor.resistance": 0.05,
    "motor.torque_constant": 0.02,
    "motor.friction_coulomb": 0.15,
    "motor.friction_viscous": 0.15,
    "gearbox.efficiency_load": 0.03,
    "gearbox.friction_coulomb": 0.15,
    "gearbox.friction_viscous": 0.15,
    "6T2A.track.guide_share": 0.3,
    **{
        f"{c}.{name}": sd
        for c in ("6T2A", "4W2T")
        for name, sd in {
            "track.loss_coulomb": 0.15,
            "track.loss_viscous": 0.15,
            "ground.rolling_resistance": 0.15,
            "ground.friction.static": 0.15,
            "ground.friction.speed_static": 0.3,
            "radius": 0.005,
        }.items()
    },
}
#: The subset that bears on friction and slip; the makers' constants stay at their sheets.
FRICTION = tuple(n for n in TOLERANCES if ".track." in n or ".ground." in n)


def perturbed(rng: np.random.Generator, names: Sequence[str] = tuple(TOLERANCES), scale: float = 1.0) -> dict:
    """Constants drawn from normals of `scale` tolerances, cut at two of them."""
    p = dict(CLIMBING)
    for name in names:
        p[name] *= 1 + scale * TOLERANCES[name] * float(np.clip(rng.standard_normal(), -2, 2))
    for c in ("6T2A", "4W2T"):
        p[f"{c}.ground.friction.dynamic"] = 0.8 * p[f"{c}.ground.friction.static"]
    return p


# --- conditions -------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Conditions:
    """One array a column, shape (rows,): wheeled 0/1, U [V], slope [rad], payload [kg], stated mass [kg], and the
    position in which the row was measured, from 0 on."""

    wheeled: np.ndarray
    U: np.ndarray
    slope: np.ndarray
    payload: np.ndarray
    mass: np.ndarray
    row: np.ndarray

    def at(self, rows: np.ndarray) -> Conditions:
        """These rows, measured in this order."""
        kept = [getattr(self, f.name)[rows] for f in dataclasses.fields(self)[:-1]]
        return Conditions(*kept, np.arange(len(rows), dtype=float))


def conditions(wheeled, U, slope_deg, payload, p: Mapping[str, float] = CLIMBING) -> Conditions:
    """Conditions with the mass as weighed, to 10 g."""
    w, u, s, m = (np.asarray(x, float) for x in np.broadcast_arrays(wheeled, U, slope_deg, payload))
    own = np.where(w > 0.5, p["4W2T.mass"], p["6T2A.mass"])
    return Conditions(w, u, np.radians(s), m, np.round(own + m, 2), np.arange(w.size, dtype=float).reshape(w.shape))


def table8(
    p: Mapping[str, float] = CLIMBING,
    payloads: Sequence[float] = (0.0, 3.0, 8.0),
    slopes: Sequence[float] = (0.0, 5.0, 10.0, 15.0, 20.0),
    voltages: Sequence[float] = (15.0, 24.0, 33.0),
    configurations: Sequence[int] = (0, 1),
) -> Conditions:
    """A grid like Table 8; by default 90 rows, with six payloads 180."""
    axes = np.meshgrid(configurations, slopes, payloads, voltages, indexing="ij")
    w, s, m, u = (a.ravel() for a in axes)
    return conditions(w, u, s, m, p)


# --- effects ----------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Form:
    """One undeclared effect: what it adds to its balance per unit of amplitude.

    Attributes:
        cls: name of the library's effect whose place it takes; "" outside the library.
        balance: where it enters.
        of: (signals, shapes) → term per unit amplitude, shape (rows,).
        size: amplitude of ordinary size, which sets its sign and the step of differences.
        shapes: bounds from which each shape parameter is drawn, uniformly.
        either: whether amplitudes of both signs occur.
    """

    cls: str
    balance: str
    of: Callable[[SimpleNamespace, Mapping[str, float]], np.ndarray]
    size: float
    shapes: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    either: bool = False


def _lag(x, x_c):
    """2x/(1+x²): loss modulus of a Maxwell element, torque of an eddy-current brake."""
    return 2 * (x / x_c) / (1 + (x / x_c) ** 2)


COPPER = 0.00393  # [1/K]
_W_S, _WK_S = {"fade": (150.0, 600.0)}, {"fade": (5.0, 16.0)}

#: Every effect of the library that steady runs forward, up slopes, can show, by its equation.
LIBRARY: dict[str, Form] = {
    "mass_error": Form("mass_error", "mass", lambda s, q: s.M, 0.03, either=True),
    "mass_offset": Form("mass_offset", "mass", lambda s, q: s.wheeled, 1.0, either=True),
    "supply_sag": Form("supply_sag", "supply", lambda s, q: SIDES * s.I, 0.2),
    "series_resistance": Form("series_resistance", "electrical", lambda s, q: s.I, 0.4),
    "brush_drop": Form("brush_drop", "electrical", lambda s, q: s.I / np.hypot(s.I, q["knee"]), 0.5, {"knee": (0.05, 0.2)}),
    "winding_heating": Form("winding_heating", "electrical", lambda s, q: COPPER * 7.7 * s.R**2 * s.I**3, 1.0),
    "torque_constant_saturation": Form("torque_constant_saturation", "motor", lambda s, q: s.C * s.I**3, 3e-3),
    "windage": Form("windage", "motor", lambda s, q: s.w * abs(s.w), 5e-10),
    "stribeck_motor": Form("stribeck_motor", "motor", lambda s, q: np.exp(-s.w / q["fade"]), 1.5e-3, _W_S),
    "iron_loss": Form("iron_loss", "motor", lambda s, q: _lag(s.w, q["critical"]), 1e-3, {"critical": (400.0, 1600.0)}),
    "gear_load_loss": Form("gear_load_loss", "gearbox", lambda s, q: abs(s.B), 0.05),
    "gear_quadratic_loss": Form("gear_quadratic_loss", "gearbox", lambda s, q: s.B**2, 0.03),
    "stribeck_gear": Form("stribeck_gear", "gearbox", lambda s, q: np.exp(-s.w / q["fade"]), 0.05, _W_S),
    "churning": Form("churning", "track", lambda s, q: s.w_k**2, 5e-4),
    "stribeck_track": Form("stribeck_track", "track", lambda s, q: np.exp(-s.w_k / q["fade"]), 0.1, _WK_S),
    "tension_friction": Form("tension_friction", "track", lambda s, q: s.r * abs(s.P), 0.1),
    "centrifugal_tension": Form("centrifugal_tension", "track", lambda s, q: s.M_t0 * (s.r_pulley * s.w_k) ** 2, 0.05),
    "bending_loss": Form("bending_loss", "track", lambda s, q: _lag(s.w_k, q["relaxation"]), 0.05, {"relaxation": (4.0, 16.0)}),
    "stribeck_exponent": Form("stribeck_exponent", "track", lambda s, q: np.exp(-(np.hypot(s.w_k / q["fade"], 1e-3) ** q["exponent"])), 0.1, _WK_S | {"exponent": (1.5, 2.5)}),
    "speed_rolling": Form("speed_rolling", "ground", lambda s, q: s.N * s.V**2, 0.01),
    "adhesive_drag": Form("adhesive_drag", "ground", lambda s, q: (1 + (s.V / q["peel"]) ** 2) ** 0.3, 0.02, {"peel": (5e-4, 5e-3)}),
    "weight_transfer": Form("weight_transfer", "ground", lambda s, q: s.N * np.tan(s.slope) ** 2, 0.2),
    "sinkage": Form("sinkage", "ground", lambda s, q: s.N * (s.M / s.M_own) ** (1 / q["exponent"]), 0.02, {"exponent": (0.6, 1.4)}),
    "slope_bias": Form("slope_bias", "ground", lambda s, q: s.N, 9e-3, either=True),
    "rolling_radius": Form("rolling_radius", "slip", lambda s, q: -s.V_teor, 0.03, either=True),
    "belt_creep": Form("belt_creep", "slip", lambda s, q: s.D * s.V_teor, 5e-4),
    "nonlinear_slip": Form("nonlinear_slip", "slip", lambda s, q: np.clip(s.D / s.D_max, -2, 2) ** 3 * s.V_teor, 0.05),
    "speed_slip": Form("speed_slip", "slip", lambda s, q: s.V_teor**2, 0.02),
    "load_slip": Form("load_slip", "slip", lambda s, q: s.N * s.V_teor, 1e-4),
    "vibration_slip": Form("vibration_slip", "slip", lambda s, q: (1 - s.wheeled) * np.hypot(s.V_teor, 1e-3) ** q["exponent"] * s.D / s.D_max / np.hypot(1 - abs(s.D / s.D_max), 0.05), 0.02, {"exponent": (1.3, 2.7)}),
    "ammeter_gain": Form("ammeter_gain", "total_current", lambda s, q: SIDES * s.I, 0.02, either=True),
    "ammeter_offset": Form("ammeter_offset", "total_current", lambda s, q: np.ones_like(s.I), 0.1, either=True),
    "encoder_scale": Form("encoder_scale", "motor_speed", lambda s, q: s.w, 0.01, either=True),
    "speed_gain": Form("speed_gain", "speed", lambda s, q: s.V, 0.02, either=True),
}  # fmt: skip

#: The same causes in another functional form than the library's.
VARIANTS: dict[str, Form] = {
    "supply_sag.diode": Form("supply_sag", "supply", lambda s, q: np.log1p(SIDES * s.I / 0.2), 0.2),
    "brush_drop.tanh": Form("brush_drop", "electrical", lambda s, q: np.tanh(s.I / 0.4), 0.5),
    "winding_heating.hot": Form("winding_heating", "electrical", lambda s, q: s.R * s.I * (lambda t: t / (1 - np.minimum(t, 0.8)))(COPPER * 7.7 * s.R * s.I**2), 1.0),
    "torque_constant_saturation.linear": Form("torque_constant_saturation", "motor", lambda s, q: s.C * s.I * abs(s.I), 0.01),
    "windage.power": Form("windage", "motor", lambda s, q: (s.w / 1000) ** 2.6, 5e-4),
    "stribeck_motor.gauss": Form("stribeck_motor", "motor", lambda s, q: np.exp(-((s.w / 600) ** 2)), 1.5e-3),
    "iron_loss.excess": Form("iron_loss", "motor", lambda s, q: np.sqrt(abs(s.w) / 1000), 1e-3),
    "gear_quadratic_loss.power": Form("gear_quadratic_loss", "gearbox", lambda s, q: abs(s.B) ** 1.5, 0.04),
    "stribeck_gear.gauss": Form("stribeck_gear", "gearbox", lambda s, q: np.exp(-((s.w / 600) ** 2)), 0.05),
    "churning.power": Form("churning", "track", lambda s, q: s.w_k**2.5, 1e-4),
    "stribeck_track.lorentz": Form("stribeck_track", "track", lambda s, q: 1 / (1 + (s.w_k / 14) ** 2), 0.1),
    "tension_friction.power": Form("tension_friction", "track", lambda s, q: s.r * abs(s.P) ** 1.3, 0.04),
    "bending_loss.power": Form("bending_loss", "track", lambda s, q: (abs(s.w_k) / 10) ** 0.3, 0.05),
    "speed_rolling.linear": Form("speed_rolling", "ground", lambda s, q: s.N * abs(s.V), 0.01),
    "adhesive_drag.power": Form("adhesive_drag", "ground", lambda s, q: abs(s.V) ** 0.35, 1.0),
    "weight_transfer.versine": Form("weight_transfer", "ground", lambda s, q: s.N * abs(np.sin(s.slope)) ** 1.5, 0.2),
    "sinkage.linear": Form("sinkage", "ground", lambda s, q: s.N * (s.M - s.M_own) / s.M_own, 0.02),
    "belt_creep.stiffening": Form("belt_creep", "slip", lambda s, q: s.V_teor * s.D / (1 + abs(s.D) / 60), 5e-4),
    "nonlinear_slip.janosi": Form("nonlinear_slip", "slip", lambda s, q: -s.V_teor * np.log1p(-np.clip(s.D / s.D_max, -0.97, 0.97)), 0.02),
    "speed_slip.cubic": Form("speed_slip", "slip", lambda s, q: s.V_teor**3, 0.02),
    "load_slip.hertz": Form("load_slip", "slip", lambda s, q: s.V_teor * s.N ** (2 / 3), 5e-4),
}  # fmt: skip

#: Forms that the library does not hold.
OUTSIDE: dict[str, Form] = {
    # brushes arc above a voltage: a step of the drop
    "commutation_step": Form("", "electrical", lambda s, q: 0.5 * (1 + np.tanh((s.U - q["at"]) / 2)), 0.6, {"at": (18.0, 21.0)}),
    # half-wave of a supply whose regulator hunts with the load
    "supply_hunting": Form("", "supply", lambda s, q: np.sin(2 * np.pi * SIDES * s.I / q["period"]), 0.3, {"period": (2.0, 4.0)}),
    # grease thins as the gear's own loss warms it: viscous torque that falls with power
    "gear_viscosity": Form("", "gearbox", lambda s, q: s.w_k * np.exp(-abs(s.B * s.w_k) / q["power"]), 0.01, {"power": (8.0, 20.0)}),
    # teeth rattle in their backlash while little load keeps them together
    "backlash_dither": Form("", "gearbox", lambda s, q: np.exp(-abs(s.B) / q["load"]), 0.2, {"load": (0.3, 0.8)}),
    # a span of the belt resonates at one speed
    "resonance_bump": Form("", "track", lambda s, q: np.exp(-(((s.w_k - q["at"]) / 2) ** 2)), 0.1, {"at": (13.0, 19.0)}),
    # the payload bends the chassis until the guides bind
    "guide_binding": Form("", "track", lambda s, q: np.maximum(s.payload - q["from"], 0) ** 2 / 25, 0.2, {"from": (1.0, 3.0)}),
    # the nose digs in on the slope, up to a limit
    "slope_rolling": Form("", "ground", lambda s, q: s.N * np.tanh(s.slope / q["slope"]), 0.02, {"slope": (0.04, 0.12)}),
    # lugs that catch at one speed only when loaded
    "loaded_chatter": Form("", "ground", lambda s, q: s.payload * np.exp(-(((s.V - q["at"]) / 0.12) ** 2)), 0.3, {"at": (0.6, 0.9)}),
    # teeth climb and jump back when voltage and slope are high together
    "tooth_climb": Form("", "slip", lambda s, q: s.V_teor * s.slope * np.maximum(s.U - q["from"], 0) / 10, 0.05, {"from": (15.0, 20.0)}),
}  # fmt: skip

FORMS: dict[str, Form] = LIBRARY | VARIANTS | OUTSIDE
CHANNELS = ("total_current", "motor_speed", "speed")


@dataclasses.dataclass(frozen=True)
class Term:
    """One form with its amplitude and shape parameters; `law` is a form that FORMS does not hold under that name."""

    name: str
    amplitude: float
    shapes: Mapping[str, float] = dataclasses.field(default_factory=dict)
    law: Form | None = None

    @property
    def form(self) -> Form:
        return FORMS[self.name] if self.law is None else self.law

    def of(self, s: SimpleNamespace) -> np.ndarray:
        return self.amplitude * self.form.of(s, self.shapes)


def draw(name: str, rng: np.random.Generator, law: Form | None = None) -> Term:
    """A term of unit amplitude (of its ordinary sign) with its shape parameters drawn."""
    form = FORMS[name] if law is None else law
    sign = rng.choice((-1.0, 1.0)) if form.either else 1.0
    return Term(name, sign, {k: float(rng.uniform(*b)) for k, b in form.shapes.items()}, law)


# --- the balances -----------------------------------------------------------------------------------

_SCALE = np.array([1.0, 100.0, 0.1])[:, None]  # of I, w, V


def _instant(x: np.ndarray, c: Conditions, p: Mapping[str, float], terms: Sequence[Term]) -> SimpleNamespace:
    """Every quantity of settled forward travel at x = (I [A], w [rad/s], V [m/s]), shape (3, rows)."""

    def both(name: str) -> np.ndarray:
        return np.where(c.wheeled > 0.5, p["4W2T." + name], p["6T2A." + name])

    def extra(balance: str) -> Any:
        return sum((t.of(s) for t in terms if t.form.balance == balance), 0.0)

    s = SimpleNamespace(I=x[0], w=x[1], V=x[2], wheeled=c.wheeled, slope=c.slope, payload=c.payload, U=c.U)
    s.row, s.order = c.row, c.row / max(float(np.max(c.row, initial=0.0)), 1.0)  # order: 0 to 1
    s.R, s.C = p["motor.resistance"], p["motor.torque_constant"]
    s.r, s.M_t0, s.M_own, s.r_pulley = both("radius"), both("track.loss_coulomb"), both("mass"), p["6T2A.radius"]
    s.w_k = s.w / p["gearbox.ratio"]
    s.V_teor = s.r * s.w_k
    s.M = c.mass
    s.M = s.M + extra("mass")
    m = s.M / SIDES
    s.N = m * G * np.cos(c.slope)
    s.volts_left = s.U - extra("supply") - s.C * s.w - s.R * s.I - extra("electrical")  # (15)
    M_d = (
        s.C * s.I - p["motor.friction_coulomb"] - p["motor.friction_viscous"] * s.w - extra("motor")
    )  # (14), (17), (18)
    s.D = both("ground.rolling_resistance") * s.N + extra("ground") + m * G * np.sin(c.slope)  # (1), (5)
    s.P = s.D
    s.D_max = both("ground.friction.static") * s.N  # (6)
    share = s.D / s.D_max
    s.slides = np.abs(share) >= 1
    creep = 2 * both("ground.friction.speed_static") * np.sin(np.arcsin(np.clip(share, -1, 1)) / 3)  # Fig. 7
    s.speed_left = s.V_teor - s.V - creep - extra("slip")
    M_t = s.M_t0 + both("track.loss_viscous") * s.w_k + extra("track")  # (24)
    M_t = M_t + s.r * both("track.guide_friction") * both("track.guide_share") * s.N  # (26)
    s.B = M_t + s.r * s.P
    A = M_d - p["gearbox.friction_coulomb"] - p["gearbox.friction_viscous"] * s.w  # (20)
    load = s.B + extra("gearbox")
    eta = p["gearbox.efficiency_load"]
    s.torque_left = p["gearbox.ratio"] * np.where(load >= 0, eta, 1 / eta) * A - load  # (19), (22), (23)
    s.readings = np.stack([SIDES * s.I + extra("total_current"), s.w + extra("motor_speed"), s.V + extra("speed")])
    return s


def _left(x, c, p, terms) -> np.ndarray:
    s = _instant(x, c, p, terms)
    return np.stack([s.volts_left, 10 * s.torque_left, 10 * s.speed_left])


def _slope(x, c, p, terms, f0) -> np.ndarray:
    """d(left)/dx by differences, shape (rows, 3, 3)."""
    columns = []
    for k in range(3):
        h = 1e-6 * _SCALE[k]
        there = x.copy()
        there[k] += h
        columns.append((_left(there, c, p, terms) - f0) / h)
    return np.stack(columns, 1).transpose(2, 0, 1)


def solve(c: Conditions, p: Mapping[str, float], terms: Sequence[Term] = ()) -> tuple[np.ndarray, np.ndarray]:
    """Operating points by Newton's method over all rows: x of shape (3, rows), and whether each is sound."""
    no_load = 0.9 * c.U / p["motor.torque_constant"]
    radius = np.where(c.wheeled > 0.5, p["4W2T.radius"], p["6T2A.radius"])
    x = np.stack([0.1 * c.U / p["motor.resistance"], no_load, radius * no_load / p["gearbox.ratio"]])
    with np.errstate(all="ignore"):
        for _ in range(25):
            f = _left(x, c, p, terms)
            step = np.linalg.solve(_slope(x, c, p, terms, f), f.T[..., None])[..., 0].T
            step = np.clip(np.nan_to_num(step), -50 * _SCALE, 50 * _SCALE)
            x = x - step
            if np.abs(step / _SCALE).max() < 1e-12:
                break
        s = _instant(x, c, p, terms)
        f = _left(x, c, p, terms)
    sound = np.isfinite(f).all(0) & (np.abs(f).max(0) < 1e-7) & ~s.slides & (s.w > 0)
    return x, sound


def readings(c: Conditions, p: Mapping[str, float], terms: Sequence[Term] = ()) -> tuple[np.ndarray, np.ndarray]:
    """Total current [A], motor speed [rad/s], speed [m/s], shape (3, rows), without noise; and sound rows."""
    x, sound = solve(c, p, terms)
    with np.errstate(all="ignore"):
        return _instant(x, c, p, terms).readings, sound


# --- signatures -------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Instruments:
    """Standard deviation and step of the display of each channel: A, rpm, mm/s."""

    sd: tuple[float, float, float] = (0.02, 5.0, 3.0)
    step: tuple[float, float, float] = (0.01, 1.0, 1.0)

    @property
    def stated(self) -> np.ndarray:
        """Standard deviation of a reading, rounding included [A, rpm, mm/s]."""
        return np.sqrt(np.square(self.sd) + np.square(self.step) / 12)


_SHOWN = np.array([1.0, 30 / np.pi, 1000.0])[:, None]  # A, rad/s, m/s → A, rpm, mm/s


def base_slopes(
    c, p, instruments: Instruments, names: Sequence[str] = tuple(TOLERANCES), sds: Mapping[str, float] | None = None
) -> np.ndarray:
    """Whitened change of the readings for one sd of each constant, shape (3 rows, names); `sds`: else tolerances."""
    x, _ = solve(c, p)
    f0 = _left(x, c, p, ())
    inverse = np.linalg.inv(_slope(x, c, p, (), f0))
    columns = []
    for name in names:
        sd = TOLERANCES[name] * CLIMBING[name] if sds is None else sds[name]
        h = 1e-6 * max(p[name], sd)
        df = (_left(x, c, dict(p) | {name: p[name] + h}, ()) - f0) / h
        dx = -np.einsum("nij,jn->in", inverse, df)
        dy = dx * np.array([SIDES, 1.0, 1.0])[:, None] * sd
        columns.append((dy * _SHOWN / instruments.stated[:, None]).ravel())
    return np.stack(columns, 1)


def remainder(signature: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """What of a whitened signature is left after a refit of the constants with their tolerances as priors."""
    n = slopes.shape[1]
    wide = np.concatenate([slopes, np.eye(n)])
    long = np.concatenate([signature, np.zeros(n)])
    fit = np.linalg.lstsq(wide, long, rcond=None)[0]
    return long - wide @ fit


def signature(c, p, terms: Sequence[Term], instruments: Instruments) -> np.ndarray:
    """Whitened change of all readings by the terms, shape (3 rows,); NaN where a row is lost."""
    with_them, a = readings(c, p, terms)
    without, b = readings(c, p)
    change = np.where(a & b, (with_them - without) * _SHOWN / instruments.stated[:, None], np.nan)
    return change.ravel()


def sized(term: Term, sigmas: float, c, p, instruments: Instruments, slopes: np.ndarray) -> tuple[Term, float]:
    """The term with the amplitude at which `sigmas` are left after refitting, and how many really are.

    Secant steps from a tenth of its ordinary size; fewer sigmas come back where the robot would no longer run.
    """
    amplitude = 0.1 * term.form.size * np.sign(term.amplitude)
    best = (dataclasses.replace(term, amplitude=amplitude), 0.0)
    for _ in range(8):
        now = dataclasses.replace(term, amplitude=float(amplitude))
        sign = signature(c, p, [now], instruments)
        if not np.isfinite(sign).all():
            amplitude = 0.5 * (amplitude + best[0].amplitude)
            continue
        left = float(np.linalg.norm(remainder(sign, slopes)))
        best = (now, left) if left > 0 else best
        if abs(left - sigmas) < 0.02 * sigmas or left == 0:
            break
        amplitude *= np.clip(sigmas / left, 0.2, 20.0)
    return best


# --- further experiments ----------------------------------------------------------------------------

#: How a run of the menu is carried out (see `_free`), by the name of its setup.
HOW = {
    "on_ground": "travel", "reversed_": "reverse", "lifted": "lifted", "bare": "motor", "braked": "brake",
    "blocked": "stall",
}  # fmt: skip
#: Channel whose instrument a calibration act reads; `weigh` reads the scales.
SHOWN = {"shunt": 0, "zero current": 0, "strobe": 1, "timing": 2}


def _act(name: str, at: np.ndarray, p: Mapping[str, float], terms: Sequence[Term]) -> np.ndarray:
    """What an instrument shows of true values `at`; of the scales' mass the stated one is taken away."""
    if name == "weigh":  # configuration and payload
        c = conditions(at[:, 0], 0.0, 0.0, at[:, 1], p)
        s = SimpleNamespace(M=c.mass, wheeled=c.wheeled)
        return 0 * c.mass + sum((t.of(s) for t in terms if t.form.balance == "mass"), 0.0)
    true = at[:, 0]
    s = SimpleNamespace(I=true / SIDES, w=true, V=true)
    return true + sum((t.of(s) for t in terms if t.form.balance == CHANNELS[SHOWN[name]]), 0.0)


def _free(
    how: str, U: np.ndarray, wheeled: int, motors: int, p: Mapping[str, float], terms: Sequence[Term], brake: float
) -> tuple[np.ndarray, np.ndarray]:
    """Current [A] and speed [rad/s] shown where nothing touches the ground, shape (2, rows).

    `how` is `lifted`, `motor` (nothing on its shaft), `brake` (one of a torque [N·m] on it) or `stall` (shaft held).
    """
    chassis = ("6T2A.", "4W2T.")[wheeled]
    R, C, zero = p["motor.resistance"], p["motor.torque_constant"], np.zeros_like(U)

    def left(x: np.ndarray, shown: bool = False) -> np.ndarray:
        i, w = x
        s = SimpleNamespace(
            I=i, w=w, w_k=w / p["gearbox.ratio"], U=U, R=R, C=C, r=p[chassis + "radius"], r_pulley=p["6T2A.radius"],
            M_t0=p[chassis + "track.loss_coulomb"], M=zero, N=zero, D=zero, P=zero, payload=zero, slope=zero,
            wheeled=zero + wheeled, V=zero, row=zero, order=zero,
        )  # fmt: skip
        # terms of the common line are written for the current of all motors, SIDES I
        line = SimpleNamespace(**vars(s) | {"I": i * motors / SIDES})

        def extra(balance: str, at: SimpleNamespace = s) -> Any:
            return sum((t.of(at) for t in terms if t.form.balance == balance), 0.0)

        if shown:
            return np.stack([motors * i + extra("total_current", line), w + extra("motor_speed")])
        volts = U - extra("supply", line) - C * w - R * i - extra("electrical")
        if how == "stall":
            return np.stack([volts, w])
        torque = C * i - p["motor.friction_coulomb"] - p["motor.friction_viscous"] * w - extra("motor")
        if how in ("motor", "brake"):
            return np.stack([volts, 1000 * (torque - brake * (how == "brake"))])
        torque = torque - p["gearbox.friction_coulomb"] - p["gearbox.friction_viscous"] * w
        s.B = s.M_t0 + p[chassis + "track.loss_viscous"] * s.w_k + extra("track")
        return np.stack([volts, p["gearbox.ratio"] * p["gearbox.efficiency_load"] * torque - s.B - extra("gearbox")])

    x = np.stack([U if how == "stall" else 0.1 * U, 0.0 * U if how == "stall" else 0.9 * U / C])
    for _ in range(40):
        f = left(x)
        columns = [(left(x + h) - f) / h.max() for h in (np.array([[1e-6], [0.0]]), np.array([[0.0], [1e-4]]))]
        x = x - np.linalg.solve(np.stack(columns, 1).transpose(2, 1, 0).swapaxes(1, 2), f.T[..., None])[..., 0].T
    return left(x, shown=True), np.abs(left(x)).max(0) < 1e-7


def carried_out(experiment: Any, p: Mapping[str, float], terms: Sequence[Term] = ()) -> tuple[np.ndarray, np.ndarray]:
    """What an experiment shows without noise [SI], row by row and in each row channel by channel; and what is sound.

    Args:
        experiment: of the menu, an act or a run with its conditions; nothing but these is read of it.
    """
    if hasattr(experiment, "at"):
        y = _act(experiment.name, np.array(experiment.at, float), p, terms)
        return y, np.ones(y.shape, bool)
    how, wheeled = HOW[experiment.setup.__name__], experiment.configuration
    U, slope, payload = (np.array(x, float) for x in (experiment.voltage, experiment.slope, experiment.payload))
    if how in ("lifted", "motor", "brake", "stall"):
        y, sound = _free(how, U, wheeled, experiment.sides or SIDES, p, terms, experiment.brake)
        y = y[:1] if how == "stall" else y
    else:
        if how == "reverse":  # an angle that is too small now drives
            terms = [
                dataclasses.replace(t, amplitude=-t.amplitude) if t.form.cls == "slope_bias" else t for t in terms
            ]
        y, sound = readings(conditions(wheeled, U, slope, payload, p), p, terms)
    return y.T.ravel(), np.repeat(sound, len(y))


# --- cases ------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Case:
    """One sealed table with its label.

    Attributes:
        table: columns of a CSV of runs.
        label: kind, seed, constants; effects with class, balance, amplitude (`sizes`: in multiples of its
            ordinary size, for whoever leaves implausible ones out), shapes and sigmas.
        conditions, constants, terms: what it was made from; `more` carries out further runs.
    """

    table: dict[str, np.ndarray]
    label: dict[str, Any]
    conditions: Conditions
    constants: dict[str, float]
    terms: tuple[Term, ...]
    instruments: Instruments

    def more(self, c: Conditions, seed: int) -> dict[str, np.ndarray]:
        """The table of another experiment with the same robot."""
        return _table(c, *readings(c, self.constants, self.terms), self.instruments, np.random.default_rng(seed))

    def carry_out(self, experiment: Any, seed: int) -> dict[str, np.ndarray]:
        """An experiment of the menu with the same robot: `value` and `sd` of its readings [SI], repeats averaged.

        What a robot that slides or stands still does not show is NaN.
        """
        y, sound = carried_out(experiment, self.constants, self.terms)
        if hasattr(experiment, "at"):
            one = np.full(y.shape, experiment.sd)
        else:
            shown = (self.instruments.stated / _SHOWN[:, 0])[: len(experiment.channels)]
            one = np.tile(shown, len(experiment.voltage))
        sd = one / np.sqrt(experiment.repeats)
        noise = np.random.default_rng(seed).standard_normal(y.shape)
        return {"value": np.where(sound, y + sd * noise, np.nan), "sd": sd}

    def write(self, table: Path, label: Path) -> None:
        """Table as CSV and label as JSON; two paths, so that they can be kept apart."""
        with table.open("w", newline="", encoding="utf-8") as file:
            out = csv.writer(file)
            out.writerow(self.table)
            out.writerows(zip(*self.table.values(), strict=True))
        label.write_text(json.dumps(self.label, indent=1), encoding="utf-8")


def _table(c: Conditions, y, sound, instruments: Instruments, rng: np.random.Generator) -> dict[str, np.ndarray]:
    noise = rng.standard_normal(y.shape) * np.array(instruments.sd)[:, None]
    step = np.array(instruments.step)[:, None]
    shown = np.round((y * _SHOWN + noise) / step) * step
    kept = {
        "configuration": np.where(c.wheeled > 0.5, "4W2T", "6T2A"),
        "supply_voltage_V": c.U,
        "total_mass_kg": c.mass,
        "payload_kg": c.payload,
        "slope_deg": np.round(np.degrees(c.slope), 6),
        "total_current_A": np.round(shown[0], 6),
        "motor_speed_rpm": np.round(shown[1], 6),
        "speed_mm_s": np.round(shown[2], 6),
    }
    for name, sd in zip(
        ("total_current_sd_A", "motor_speed_sd_rpm", "speed_sd_mm_s"), instruments.stated, strict=True
    ):
        kept[name] = np.full(c.U.shape, round(float(sd), 6))
    return {name: column[sound] for name, column in kept.items()}


def case(
    names: Sequence[str] = (),
    sigmas: float = 8.0,
    seed: int = 0,
    *,
    compensating: bool = False,
    free: Sequence[str] = tuple(TOLERANCES),
    scale: float = 1.0,
    instruments: Instruments | None = None,
    grid: Callable[[Mapping[str, float]], Conditions] = table8,
) -> Case:
    """One sealed case.

    Args:
        names: effects of `FORMS`; none makes a clean table.
        sigmas: that each effect alone leaves after a refit of the `free` constants.
        seed: of constants, shape parameters, signs and noise.
        compensating: of two effects, size the second to hide as much of the first as it can.
        free: constants that are off their nominal values, and refitted when amplitudes are sized.
        scale: how far off, in tolerances.
    """
    instruments = instruments or Instruments()
    rng = np.random.default_rng(seed)
    p = perturbed(rng, free, scale)
    c = grid(p)
    slopes = base_slopes(c, p, instruments, free)
    terms, reached = [], []
    for name in names:
        term, left = sized(draw(name, rng), sigmas, c, p, instruments, slopes)
        terms.append(term)
        reached.append(left)
    if compensating:
        first, second = (remainder(signature(c, p, [t], instruments), slopes) for t in terms)
        hide = -float(first @ second) / float(second @ second)
        terms[1] = dataclasses.replace(terms[1], amplitude=terms[1].amplitude * hide)
        reached[1] *= abs(hide)
    together = float(np.linalg.norm(remainder(np.nan_to_num(signature(c, p, terms, instruments)), slopes)))
    kinds = {"library": LIBRARY, "variant": VARIANTS, "outside": OUTSIDE}
    label = {
        "schema": "mmrjax.sealed/1",
        "seed": seed,
        "kind": "+".join(next(k for k, v in kinds.items() if n in v) for n in names) or "clean",
        "compensating": compensating,
        "effects": [
            {"name": t.name, "class": t.form.cls, "balance": "sensor" if t.form.balance in CHANNELS else t.form.balance,
             "amplitude": t.amplitude, "sizes": abs(t.amplitude) / t.form.size, "shapes": dict(t.shapes), "sigmas": left}
            for t, left in zip(terms, reached, strict=True)
        ],
        "sigmas_together": together,
        "constants": {n: p[n] for n in free},
    }  # fmt: skip
    y, sound = readings(c, p, terms)
    label["rows_lost"] = int((~sound).sum())
    return Case(_table(c, y, sound, instruments, rng), label, c, p, tuple(terms), instruments)
