"""Sealed time series: start-up histories with undeclared effects, from plain NumPy physics of its own.

The ODE is that of `reference.Side.rates`, written for many runs at once and integrated by the classical
Runge-Kutta method with a fixed step, far below every time constant. Constants may be arrays, one value a
run, so a whole batch of perturbed robots is one call.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import generator as g
import numpy as np
from reference import CELLS, NOMINAL, SIDES, G

STEP = 2e-4  # [s]; the armature's time constant is 1.9e-4 s, the method is stable to 2.7 of them
FINER = 8  # times smaller steps through the first 20 ms
LARGEST = 20.0  # ordinary sizes; an effect that needs more comes with fewer sigmas
STATES = ("I", "w", "V", "theta", "C_b", "T", "q", "z", "b")  # T [K], q [A], z and b [-]: memories of single effects


@dataclasses.dataclass(frozen=True)
class Moving:
    """One effect of a history: balance, term per unit amplitude, ordinary size, shapes to draw from."""

    balance: str
    of: Callable[[SimpleNamespace, Mapping[str, float]], np.ndarray]
    size: float
    shapes: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    cls: str = ""


def _fade(x: np.ndarray) -> np.ndarray:
    """1 below 1, 0 above 2: a cubic in x² between."""
    u = np.clip((x**2 - 1) / 3, 0, 1)
    return 1 - u**2 * (3 - 2 * u)


_PHASE = {"phase": (-3.0, 3.0)}
#: Effects that need a series, by the library's equations (`cls` says which).
FORMS: dict[str, Moving] = {
    "pulley_eccentricity": Moving("slip", lambda s, q: -s.V_teor * np.sin(s.theta / s.i + q["phase"]), 0.01, _PHASE, "pulley_eccentricity"),
    "grouser_polygon": Moving("ground", lambda s, q: np.sin(2 * np.pi * s.r * s.theta / s.i / 35e-3 + q["phase"]) * (1 - s.wheeled), 1.0, _PHASE, "grouser_polygon"),
    "cogging": Moving("motor", lambda s, q: np.sin(26 * s.theta + q["phase"]) * _fade(26 * s.w / 1000), 5e-4, _PHASE, "cogging"),
    "rotating_inertia": Moving("inertia", lambda s, q: np.ones_like(s.w), 5e-4, {}, "rotating_inertia"),
    "armature_inductance": Moving("inductance", lambda s, q: np.ones_like(s.w), 1e-4, {}, "armature_inductance"),
    "thermal_drift": Moving("electrical", lambda s, q: g.COPPER * s.R * s.I * s.T, 1.0, {}, "thermal_drift"),
    "battery_sag": Moving("supply", lambda s, q: s.q * s.battery, 0.2, {}, "battery_sag"),
    "stick_slip": Moving("track", lambda s, q: s.z, 0.1, {}, "stick_slip"),
    "presliding": Moving("track", lambda s, q: s.b - s.sign, 0.1, {}, "presliding"),
    "angle_friction": Moving("track", lambda s, q: np.sin(s.theta / s.i + q["phase"]) * s.sign, 0.05, _PHASE, "angle_friction"),
    "position_friction": Moving("track", lambda s, q: s.theta / s.i * s.sign, 0.01, {}, "position_friction"),
    "series_resistance": Moving("electrical", lambda s, q: s.I, 0.4, {}, "series_resistance"),
    "churning": Moving("track", lambda s, q: s.w_k**2 * s.sign, 5e-4, {}, "churning"),
    "supply_sag": Moving("supply", lambda s, q: SIDES * s.I, 0.2, {}, "supply_sag"),
    "brush_drop": Moving("electrical", lambda s, q: s.I / np.hypot(s.I, q["knee"]), 0.5, {"knee": (0.05, 0.2)}, "brush_drop"),
    "windage": Moving("motor", lambda s, q: s.w**2 * s.sign, 5e-10, {}, "windage"),
    "stribeck_track": Moving("track", lambda s, q: np.exp(-abs(s.w_k) / q["fade"]) * s.sign, 0.1, {"fade": (5.0, 16.0)}, "stribeck_track"),
    "rolling_radius": Moving("slip", lambda s, q: -s.V_teor, 0.03, {}, "rolling_radius"),
    "speed_slip": Moving("slip", lambda s, q: s.V_teor**2 * s.sign, 0.02, {}, "speed_slip"),
    "load_slip": Moving("slip", lambda s, q: s.N * s.V_teor, 1e-4, {}, "load_slip"),
    # outside the library: a bent shaft (order 2 of the pulley), a belt splice (once a turn of the belt),
    # a supply that recovers after its inrush, oil that warms with the way travelled
    "pulley_ovality": Moving("track", lambda s, q: np.sin(2 * s.theta / s.i + q["phase"]), 0.05, _PHASE),
    "belt_splice": Moving("track", lambda s, q: np.exp(20 * (np.cos(s.r * s.theta / s.i * 2 * np.pi / 0.84 + q["phase"]) - 1)) * s.sign, 0.2, _PHASE),
    "supply_recovery": Moving("supply", lambda s, q: np.exp(-s.time / 0.4), 1.0),
    "oil_warming": Moving("gearbox", lambda s, q: np.exp(-abs(s.theta) / 1000) * s.sign, 0.2),
}  # fmt: skip


def _soft_sign(v, rest):
    x = np.clip(v / rest, -1, 1)
    return 0.5 * x * (3 - x * x)


def _friction(v, mu_s, mu_d, V_s, V_d):
    """Fig. 7."""
    size = np.abs(v)
    rising = mu_s * _soft_sign(size, V_s)
    u = np.clip((size - V_s) / (V_d - V_s), 0, 1)
    return np.sign(v) * np.where(size < V_s, rising, mu_s + (mu_d - mu_s) * u * u * (3 - 2 * u))


def _rates(time: float, y: np.ndarray, c: g.Conditions, battery, p: Mapping[str, Any], terms) -> np.ndarray:
    """d/dt of STATES, shape (9, runs); terms are (form, amplitude, shapes); `p` as from `_of_runs`."""

    def both(name: str) -> np.ndarray:
        return p[name]

    def extra(balance: str) -> Any:
        return sum((a * form.of(s, q) for form, a, q in terms if form.balance == balance), 0.0)

    s = SimpleNamespace(**dict(zip(STATES, y, strict=True)), wheeled=c.wheeled, battery=battery, time=time)
    s.R, s.i, s.r = p["motor.resistance"], p["gearbox.ratio"], both("radius")
    C, J_d, eta_0 = p["motor.torque_constant"], p["motor.inertia"], p["gearbox.efficiency_load"]
    V_s = both("ground.friction.speed_static")
    s.w_k = s.w / s.i
    s.V_teor = s.r * s.w_k
    s.sign, sign_V = _soft_sign(s.V_teor, 0.1 * V_s), _soft_sign(s.V, 0.1 * V_s)
    m = c.mass / SIDES
    N = s.N = m * G * np.cos(c.slope)
    q = s.C_b * NOMINAL["battery.capacity"] / p["battery.capacity"]
    cell = p["battery.curvature"] * q**2 + p["battery.slope"] * q + p["battery.voltage_full"]
    I_b = SIDES * s.I + p["battery.current_other"]  # (10)
    U = np.where(battery > 0.5, CELLS * (cell - I_b * p["battery.resistance"]), c.U) - extra("supply")
    L = p["motor.inductance"] + extra("inductance")
    dI = (U - C * s.w - s.R * s.I - extra("electrical")) / L  # (15)
    M_d = C * s.I - p["motor.friction_coulomb"] * s.sign - p["motor.friction_viscous"] * s.w - extra("motor")
    slide = s.V_teor - s.V - extra("slip")
    fric = [both("ground.friction." + k) for k in ("static", "dynamic")]
    P = _friction(slide, *fric, V_s, both("ground.friction.speed_dynamic")) * N
    D = both("ground.rolling_resistance") * N * sign_V + extra("ground") + m * G * np.sin(c.slope)
    guide = both("track.guide_friction") * both("track.guide_share") * N * s.sign
    B = both("track.loss_coulomb") * s.sign + both("track.loss_viscous") * s.w_k + extra("track")
    B = B + s.r * (guide + P) + extra("gearbox")
    A = M_d - p["gearbox.friction_coulomb"] * s.sign - p["gearbox.friction_viscous"] * s.w
    J_w = both("inertia") + extra("inertia")
    # Teeth lose power only where they turn: to 1 with the softened sign, as every friction about rest.
    eta = 1 + abs(s.sign) * (np.where((A * J_w + s.i * J_d * B) * s.sign >= 0, eta_0, 1 / eta_0) - 1)
    wheel = (s.i * eta * A - B) / (J_w + J_d * s.i**2 * eta)
    return np.stack([
        dI,
        s.i * wheel,
        (P - D) / m,
        s.w,
        np.where(battery > 0.5, I_b, 0.0),
        (1.7 * s.R * s.I**2 - s.T) / 16.3,
        (SIDES * s.I - s.q) / 20.0,
        (s.w_k * np.exp(-((s.w_k / 3.0) ** 2)) - s.w_k * s.sign * s.z) / 0.01,
        (s.w_k - s.w_k * s.sign * s.b) / 0.02,
    ])  # fmt: skip


def _of_runs(c: g.Conditions, p: Mapping[str, Any]) -> dict[str, Any]:
    """Constants, those of a configuration under their own name with a value for each run."""
    names = [n.removeprefix("6T2A.") for n in p if n.startswith("6T2A.")]
    return dict(p) | {n: np.where(c.wheeled > 0.5, p[f"4W2T.{n}"], p[f"6T2A.{n}"]) for n in names}


def histories(
    c: g.Conditions, duration: float, every: float, p: Mapping[str, Any] = g.CLIMBING, terms=(), battery=None,
    step: float = STEP,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Times (instants,) [s], and I_Σ [A], w [rad/s], V [m/s] of runs from standstill, shape (3, runs, instants).

    `every` is a multiple of `step`; values of `p`, amplitudes and shapes may be arrays of shape (runs,).
    """
    battery = np.zeros_like(c.U) if battery is None else np.asarray(battery, float)
    y = np.zeros((len(STATES), len(c.U)))
    count, t, p = round(duration / every), 0.0, _of_runs(c, p)
    kept = [y[:3]]
    for instant in range(count):
        # The first currents and the end of slipping are the fastest part of a start.
        h = step / (FINER if t < 0.02 else 1)
        for _ in range(round(every / h)):
            a = _rates(t, y, c, battery, p, terms)
            b = _rates(t + h / 2, y + h / 2 * a, c, battery, p, terms)
            d = _rates(t + h / 2, y + h / 2 * b, c, battery, p, terms)
            e = _rates(t + h, y + h * d, c, battery, p, terms)
            y = y + h / 6 * (a + 2 * b + 2 * d + e)
            t += h
        t = (instant + 1) * every
        kept.append(y[:3])
    kept = [k * np.array([SIDES, 1.0, 1.0])[:, None] for k in kept]
    return np.arange(len(kept)) * every, np.stack(kept, -1)


def starts(p: Mapping[str, float]) -> g.Conditions:
    """Six runs: both configurations at 15, 24 and 33 V, on the level, 5 and 10 degrees."""
    return g.conditions([0, 0, 0, 1, 1, 1], [15, 24, 33, 15, 24, 33], [0, 5, 10, 0, 5, 10], [0, 3, 8, 0, 3, 8], p)


def case(
    names: Sequence[str] = (),
    sigmas: float = 8.0,
    seed: int = 0,
    *,
    duration: float = 1.5,
    every: float = 0.02,
    free: Sequence[str] = g.FRICTION,
    instruments: g.Instruments | None = None,
    on_battery: bool = False,
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """One sealed series: the columns of its table (one row a sample) and its label.

    As `generator.case`: constants within tolerances, effects each sized to leave `sigmas` after a refit of
    the `free` constants, estimated at a tenth of their ordinary size, but none larger than `LARGEST`. All
    perturbed robots are one batch.
    """
    instruments = instruments or g.Instruments(sd=(0.05, 15.0, 5.0))
    rng = np.random.default_rng(seed)
    p = g.perturbed(rng, free)
    c = starts(p)
    runs, members = len(c.U), 1 + len(free) + len(names)
    drawn = [{k: float(rng.uniform(*b)) for k, b in FORMS[n].shapes.items()} for n in names]
    wide = g.Conditions(*(np.tile(getattr(c, f.name), members) for f in dataclasses.fields(c)))
    battery = np.full(runs * members, float(on_battery))

    def only(k: int, value: float) -> np.ndarray:
        return np.where(np.arange(runs * members) // runs == k, value, 0.0)

    batch = {n: np.full(runs * members, v) for n, v in p.items()}
    for k, name in enumerate(free):
        batch[name] = p[name] * (1 + only(1 + k, 0.1 * g.TOLERANCES[name]))
    trial = [0.1 * FORMS[n].size for n in names]
    terms = [(FORMS[n], only(1 + len(free) + k, trial[k]), drawn[k]) for k, n in enumerate(names)]
    _, y = histories(wide, duration, every, batch, terms, battery)
    white = (y * g._SHOWN[:, :, None] / instruments.stated[:, None, None]).reshape(3, members, -1)
    change = np.moveaxis(white[:, 1:] - white[:, :1], 1, 0).reshape(members - 1, -1)
    slopes = 10 * change[: len(free)].T
    wanted = [
        sigmas * a / (float(np.linalg.norm(g.remainder(d, slopes))) + 1e-300)
        for a, d in zip(trial, change[len(free) :], strict=True)
    ]
    amplitudes = [min(a, LARGEST * FORMS[n].size) for a, n in zip(wanted, names, strict=True)]
    terms = [(FORMS[n], a, q) for n, a, q in zip(names, amplitudes, drawn, strict=True)]
    times, y = histories(c, duration, every, p, terms, battery[:runs])
    noise = rng.standard_normal(y.shape) * np.array(instruments.sd)[:, None, None]
    step = np.array(instruments.step)[:, None, None]
    shown = np.round((y * g._SHOWN[:, :, None] + noise) / step) * step
    n = len(times)

    def column(values) -> np.ndarray:
        return np.repeat(values, n)

    table = {
        "run_id": column([f"start{k}" for k in range(runs)]),
        "time_s": np.tile(np.round(times, 6), runs),
        "configuration": column(np.where(c.wheeled > 0.5, "4W2T", "6T2A")),
        "supply_voltage_V": column(c.U),
        "total_mass_kg": column(c.mass),
        "payload_kg": column(c.payload),
        "slope_deg": column(np.round(np.degrees(c.slope), 6)),
    }
    for k, (name, sd) in enumerate(
        (("total_current_A", "total_current_sd_A"), ("motor_speed_rpm", "motor_speed_sd_rpm"), ("speed_mm_s", "speed_sd_mm_s"))
    ):  # fmt: skip
        table[name] = np.round(shown[k].ravel(), 6)
        table[sd] = np.full(n * runs, round(float(instruments.stated[k]), 6))
    label = {
        "schema": "mmrjax.sealed/1",
        "seed": seed,
        "kind": "clean" if not names else "+".join("library" if FORMS[x].cls else "outside" for x in names),
        "on_battery": on_battery,
        "effects": [
            {"name": x, "class": FORMS[x].cls, "balance": FORMS[x].balance, "amplitude": a,
             "sizes": abs(a) / FORMS[x].size, "shapes": q, "sigmas": sigmas * a / w}
            for x, a, q, w in zip(names, amplitudes, drawn, wanted, strict=True)
        ],
        "constants": {x: p[x] for x in free},
    }  # fmt: skip
    return table, label
