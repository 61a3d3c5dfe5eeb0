"""Synthetic histories from standstill: of the paper's robot on one surface, and under the wide conditions of the field:
any surface, other robots, settings and samplings, poor instruments, samples that are missing, an event at the same
instant of every run. From plain NumPy physics that shares nothing with mmrjax.

The ODE is that of `paper.Side.rates`, written for many runs at once and integrated by the classical Runge-Kutta method
with a fixed step, far below every time constant. Constants may be arrays, one value a run, so a whole batch of perturbed
robots is one call. No run is switched off on its way: a table of histories has one supply voltage a run, so it could not
say when.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
from worlds import foreign, laws, machines, settled, tables
from worlds.laws import CHANNELS, SERIES, Law, Term
from worlds.machines import PAPER, ROLES, TRACKS, WHEELS, Machine
from worlds.paper import CELLS, NOMINAL, SIDES, G
from worlds.settled import (
    CLIMBING,
    FRICTION,
    SHOWN,
    TOLERANCES,
    Conditions,
    Instruments,
    Sealed,
    conditions,
    of_rows,
    perturbed,
    remainder,
)  # fmt: skip

STEP = 2e-4  # [s]; the armature's time constant is 1.9e-4 s, the method is stable to 2.7 of them
FINER = 8  # times smaller steps through the first 20 ms
LARGEST = 20.0  # ordinary sizes; an effect that needs more comes with fewer sigmas
STATES = ("I", "w", "V", "theta", "C_b", "T", "q", "z", "b")  # T [K], q [A], z and b [-]: memories of single effects
BASE = 5e-3  # finest sampling [s]
#: Runs of a set: duration [s] and samples [in BASE] of each. Few sets, for each shape is a program to compile.
DESIGNS: dict[str, tuple[tuple[float, int], ...]] = {
    "plain": ((1.5, 4),) * 6,
    "short": ((0.6, 1),) * 6,
    "long": ((3.0, 4),) * 4,
    "mixed": ((0.6, 1), (1.0, 2), (1.5, 2), (2.0, 4), (3.0, 4)),
}
#: Kinds of worlds, and those of which each is made by turns.
STRATA: dict[str, tuple[str, ...]] = {
    "plain": ("plain",),
    "durations": ("short", "long", "mixed"),
    "faults": ("quantised", "outliers", "missing"),
    "robots": ("tracks", "wheels", "both"),
}
#: Noise of instruments that read while a robot starts, over that of settled readings.
FASTER = (2.5, 3.0, 1.7)
#: Share of the adhesion that travel demands: a start slides, and grips later even on the least adhesion.
DEMAND = 0.5
#: Largest step times the fastest rate: the method is stable to 2.7.
STABLE = 1.2
#: Smallest step after the first instants [s].
FINEST = 2e-5
#: What histories determine beside, and the analyst's relative sd.
FURTHER = {"motor.inductance": 0.1, "motor.inertia": 0.05, "inertia": 0.1, "ground.friction.dynamic": 0.3}
#: Duration of an event, and the share of the shortest run between which it begins.
EVENT, BEGINS = (0.05, 0.2), (0.25, 0.7)


# --- the physics ------------------------------------------------------------------------------------


def soft_sign(v: Any, rest: Any) -> Any:
    """Sign of v, an odd cubic within ±rest."""
    x = np.clip(v / rest, -1, 1)
    return 0.5 * x * (3 - x * x)


def _friction(v, mu_s, mu_d, V_s, V_d):
    """Fig. 7."""
    size = np.abs(v)
    rising = mu_s * soft_sign(size, V_s)
    u = np.clip((size - V_s) / (V_d - V_s), 0, 1)
    return np.sign(v) * np.where(size < V_s, rising, mu_s + (mu_d - mu_s) * u * u * (3 - 2 * u))


def teeth(flow: Any, d: Any, eta: Any) -> Any:
    """Efficiency of a gear by the direction of the torque that reaches its teeth, which lose power only where they turn:
    to 1 with the softened sign, as every friction about rest."""
    return 1 + abs(d) * (np.where(flow * d >= 0, eta, 1 / eta) - 1)


def runge_kutta(rates: Callable[[float, np.ndarray], np.ndarray], y: np.ndarray, h: float) -> np.ndarray:
    """A step of the classical method. Rates are of the share of the step, 0 to 1, and the state."""
    a = rates(0.0, y)
    b = rates(0.5, y + h / 2 * a)
    d = rates(0.5, y + h / 2 * b)
    e = rates(1.0, y + h * d)
    return y + h / 6 * (a + 2 * b + 2 * d + e)


#: Rounds of the torque at the output, of which a loss that depends on it is a small share.
ROUNDS = 12


def rates(
    time: float, y: np.ndarray, c: Conditions, battery: Any, p: Mapping[str, Any], terms: Sequence[Term]
) -> np.ndarray:
    """d/dt of STATES, shape (9, runs). `p` as from `settled.of_rows`."""

    def extra(balance: str) -> Any:
        return laws.total(terms, balance, s)

    s = SimpleNamespace(**dict(zip(STATES, y, strict=True)), wheeled=c.wheeled, battery=battery, time=time)
    s.R, s.i, s.r = p["motor.resistance"], p["gearbox.ratio"], p["radius"]
    C, J_d, eta_0 = p["motor.torque_constant"], p["motor.inertia"], p["gearbox.efficiency_load"]
    V_s = p["ground.friction.speed_static"]
    s.w_k, s.turn, s.line = s.w / s.i, s.theta / s.i, SIDES * s.I
    s.V_teor = s.r * s.w_k
    s.d, sign_V = soft_sign(s.V_teor, 0.1 * V_s), soft_sign(s.V, 0.1 * V_s)
    m = c.mass / SIDES
    N = s.N = m * G * np.cos(c.slope)
    q = s.C_b * NOMINAL["battery.capacity"] / p["battery.capacity"]
    cell = p["battery.curvature"] * q**2 + p["battery.slope"] * q + p["battery.voltage_full"]
    I_b = SIDES * s.I + p["battery.current_other"]  # (10)
    U = np.where(battery > 0.5, CELLS * (cell - I_b * p["battery.resistance"]), c.U) - extra("supply")
    L = p["motor.inductance"] + extra("inductance")
    dI = (U - C * s.w - s.R * s.I - extra("electrical")) / L  # (15)
    M_d = C * s.I - p["motor.friction_coulomb"] * s.d - p["motor.friction_viscous"] * s.w - extra("motor")
    slide = s.V_teor - s.V - extra("slip")
    fric = [p["ground.friction." + k] for k in ("static", "dynamic")]
    P = _friction(slide, *fric, V_s, p["ground.friction.speed_dynamic"]) * N
    D = p["ground.rolling_resistance"] * N * sign_V + extra("ground") + m * G * np.sin(c.slope)
    guide = p["track.guide_friction"] * p["track.guide_share"] * N * s.d
    B = p["track.loss_coulomb"] * s.d + p["track.loss_viscous"] * s.w_k + extra("track")
    load = B + s.r * (guide + P)
    A = M_d - p["gearbox.friction_coulomb"] * s.d - p["gearbox.friction_viscous"] * s.w
    J_w = p["inertia"] + extra("inertia")
    s.B = load
    for _ in range(1 + ROUNDS * any(t.law.balance == "gearbox" for t in terms)):
        B = load + extra("gearbox")
        eta = teeth(A * J_w + s.i * J_d * B, s.d, eta_0)
        wheel = (s.i * eta * A - B) / (J_w + J_d * s.i**2 * eta)
        s.B = load + J_w * wheel  # transmitted to the output, which effects of the gearbox see
    return np.stack([
        dI,
        s.i * wheel,
        (P - D) / m,
        s.w,
        np.where(battery > 0.5, I_b, 0.0),
        (1.7 * s.R * s.I**2 - s.T) / 16.3,
        (SIDES * s.I - s.q) / 20.0,
        (s.w_k * np.exp(-((s.w_k / 3.0) ** 2)) - s.w_k * s.d * s.z) / 0.01,
        (s.w_k - s.w_k * s.d * s.b) / 0.02,
    ])  # fmt: skip


def histories(
    c: Conditions, duration: float, every: float, p: Mapping[str, Any] = CLIMBING, terms: Sequence[Term] = (),
    battery: Any = 0.0, step: float = STEP,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Times (instants,) [s], and I_Σ [A], w [rad/s], V [m/s] of runs from standstill, shape (3, runs, instants).

    `every` is a multiple of `step`. Values of `p`, amplitudes and shapes may be arrays of shape (runs,).
    """
    battery = np.broadcast_to(battery, c.U.shape)
    y = np.zeros((len(STATES), len(c.U)))
    count, t, p = round(duration / every), 0.0, of_rows(c, p)
    kept = [y[:3]]
    for instant in range(count):
        # The first currents and the end of slipping are the fastest part of a start.
        h = step / (FINER if t < 0.02 else 1)
        for _ in range(round(every / h)):
            y = runge_kutta(lambda x, y: rates(t + x * h, y, c, battery, p, terms), y, h)  # noqa: B023
            t += h
        t = (instant + 1) * every
        kept.append(y[:3])
    kept = [k * np.array([SIDES, 1.0, 1.0])[:, None] for k in kept]
    return np.arange(len(kept)) * every, np.stack(kept, -1)


# --- worlds -----------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class SeriesWorld:
    """What a set of histories is measured in, as `tables.World`.

    Attributes:
        conditions: of each run.
        design: duration [s] and sampling [in base] of each.
        base: finest sampling [s].
        dropped: share of samples that no row tells of.
        stated: constants that the analyst fits with TOLERANCES as priors. None: those of the fields.
        step: of the integration [s]. None: as the fastest rate needs it. battery: whether one drives, 0 or 1.
    """

    stratum: str
    variety: str
    machine: Machine
    constants: Mapping[str, float]
    conditions: Conditions
    design: tuple[tuple[float, int], ...]
    instruments: Instruments
    outliers: float = 0.0
    missing: float = 0.0
    dropped: float = 0.0
    noise: float = 1.0
    base: float = BASE
    stated: tuple[str, ...] = ()
    step: float | None = None
    battery: float = 0.0

    @property
    def free(self) -> dict[str, tuple[float, float]]:
        """Constants that the analyst fits, the sds of their priors, and steps of differences."""
        p = self.constants
        if self.stated:
            return {n: (p[n] * TOLERANCES[n], 0.1 * TOLERANCES[n] * p[n]) for n in self.stated}
        chassis = [f"{r}.{n}" for r in self.machine.names for n in ("inertia", "ground.friction.dynamic")]
        further = ("motor.inductance", "motor.inertia", *chassis)
        sds = tables.analyst(p, self.machine.free) | {n: p[n] * FURTHER[_short(n)] for n in further}
        return {n: (sd, min(0.02 * p[n], 0.1 * sd) if p[n] > 0 else 0.1 * sd) for n, sd in sds.items()}

    @property
    def pool(self) -> tuple[str, ...]:
        """Effects of the library that these histories may have: two need longer ones or a battery, the inductance is
        a constant of the base, grousers have the paper's pitch, and at small currents brushes are stiff."""
        lost = ("thermal_drift", "battery_sag", "armature_inductance")
        lost += () if self.machine is PAPER else ("grouser_polygon", "brush_drop")
        return tuple(n for n, law in SERIES.items() if law.cls and n not in lost)


def world(rng: np.random.Generator, stratum: str = "plain", variety: int = 0, *, noise: float = 1.0) -> SeriesWorld:
    """A world of a stratum, of which `variety` takes one of its kinds."""
    kind = STRATA[stratum][variety % len(STRATA[stratum])]
    roles = {"tracks": (TRACKS,), "wheels": (WHEELS,), "both": ROLES}.get(kind)
    for _ in range(200):
        m = PAPER if roles is None else machines.machine(rng, roles)
        p = tables.surfaced(rng, m)
        for name in ("motor.inductance", "motor.inertia", *(f"{r}.inertia" for r in m.names)):
            p[name] *= 1 + 0.5 * FURTHER[_short(name)] * float(np.clip(rng.standard_normal(), -2, 2))
        design = DESIGNS.get(kind, DESIGNS["plain"])
        c = _settings(rng, m, p, len(design))
        y, sound = settled.readings(c, p)
        if sound.all() and tables.gripping(c, p, y):
            break
    else:
        raise ValueError("no such world without runs that never grip")
    show = m.instruments
    show = Instruments(tuple(float(f"{a * b:.2g}") for a, b in zip(show.sd, FASTER, strict=True)), show.step)
    if kind == "quantised":
        show = tables._coarse(rng, show)
    return SeriesWorld(
        stratum, kind, m, p, c, design, show, tables.OUTLIERS * (kind == "outliers"), tables.MISSING * (kind == "missing"),
        tables.MISSING * (kind == "missing"), noise,
    )  # fmt: skip


def _settings(rng: np.random.Generator, m: Machine, p: Mapping[str, float], runs: int) -> Conditions:
    """Settings of each run: configurations by turns, each voltage and payload in some of them, slopes as it comes."""
    wheeled = np.array([m.roles[k * len(m.roles) // runs] for k in range(runs)])
    voltages = np.round(np.array([0.45, 0.73, 1.0]) * m.supply, 1)
    payloads = np.round(np.linspace(0, 1, 3) * m.payload, 1)
    u = voltages[(np.arange(runs) + rng.integers(3)) % 3]
    load = payloads[rng.permutation(runs) % 3]
    slope = []
    for k, w in enumerate(wheeled):
        role = ROLES[int(w)]
        hold = DEMAND * p[f"{role}.ground.friction.static"] - p[f"{role}.ground.rolling_resistance"]
        most = min(machines.STEEPEST, float(np.degrees(np.arctan(max(hold, 0.0)))))
        slope.append(round(most * (k % 3) / 2 * float(rng.uniform(0.7, 1.0)), 1))
    return conditions(wheeled, u, slope, load, p)


def _short(name: str) -> str:
    """The key of FURTHER that a constant has."""
    return name if name in FURTHER else name.partition(".")[2]


def fastest(c: Conditions, p: Mapping[str, Any], ohms: float = 0.0) -> float:
    """The fastest rate of any run [1/s]: the armature's, with `ohms` more, or that at which a contact stops sliding."""
    rates = [float(np.max((np.asarray(p["motor.resistance"]) + ohms) / np.asarray(p["motor.inductance"])))]
    for wheeled, role in enumerate(ROLES):
        mine = c.wheeled == wheeled
        if not mine.any():
            continue
        m = c.mass[mine].max() / SIDES
        J = np.min(p[f"{role}.inertia"]) + np.min(p["motor.inertia"]) * np.min(p["gearbox.ratio"]) ** 2 * 0.5
        stiff = (
            1.5
            * np.max(p[f"{role}.ground.friction.static"])
            * m
            * G
            / np.min(p[f"{role}.ground.friction.speed_static"])
        )
        rates.append(float(stiff * (1 / m + np.max(p[f"{role}.radius"]) ** 2 / J)))
    return max(rates)


def simulated(
    w: SeriesWorld, p: Mapping[str, Any], c: Conditions, terms: Sequence[Term] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] from 0 on by the base, and I_Σ, w, V of every run as long as the longest, shape (3, runs, instants)."""
    ohms = sum(float(np.max(t.amplitude)) * SIDES for t in terms if t.law.balance in ("electrical", "supply"))
    step = w.step
    if step is None:
        step = float(w.base / np.ceil(w.base / np.clip(STABLE / fastest(c, p, min(ohms, 1.0)), FINEST, STEP)))
    return histories(c, max(d for d, _ in w.design), w.base, p, terms, w.battery, step)


def samples(w: SeriesWorld) -> np.ndarray:
    """Which instants of `simulated` each run shows, shape (runs, instants). Of those that are dropped the pattern is
    the same in every set, the first and the last stay."""
    count = round(max(d for d, _ in w.design) / w.base) + 1
    shown = np.zeros((len(w.design), count), bool)
    for k, (duration, every) in enumerate(w.design):
        at = np.arange(0, round(duration / w.base) + 1, every)
        lost = np.random.default_rng(k).permutation(np.arange(1, len(at) - 1))[: round(w.dropped * len(at))]
        shown[k, np.delete(at, lost)] = True
    return shown


# --- events -------------------------------------------------------------------------------------------

#: What happens at an event, and how strong it commonly is: in a balance, or in what an instrument shows.
EVENTS: dict[str, tuple[str, float]] = {
    "event.supply": ("supply", 2.0),
    "event.track": ("track", 0.3),
    "event.ground": ("ground", 5.0),
    "event.total_current": ("total_current", 0.3),
    "event.motor_speed": ("motor_speed", 5.0),
    "event.speed": ("speed", 0.02),
}


def event(name: str, rng: np.random.Generator, w: SeriesWorld) -> tuple[Law, list[float]]:
    """A shift while an event lasts, at the same instant of every run, and its window [s]."""
    balance, size = EVENTS[name]
    first = float(rng.uniform(*BEGINS) * min(d for d, _ in w.design))
    long = max(float(rng.uniform(*EVENT)), 2.5 * w.base * max(e for _, e in w.design))
    long = min(long, 0.95 * min(d for d, _ in w.design) - first)
    a, b = round(first, 3), round(first + long, 3)
    law = lambda s, q: np.where((s.time >= a) & (s.time < b), 1.0, 0.0) * np.ones_like(s.w)  # noqa: E731
    return Law("", balance, law, size), [a, b]


#: Laws of which a set may have one, but events.
EVERY: dict[str, Law] = {**SERIES, **foreign.FOREIGN_SERIES}


# --- cases ------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class SeriesCase(Sealed):
    """A sealed set of histories, one row a sample, with its world and its terms."""

    world: SeriesWorld
    terms: tuple[Term, ...] = ()


def starts(p: Mapping[str, float]) -> Conditions:
    """Six runs: both configurations at 15, 24 and 33 V, on the level, 5 and 10 degrees."""
    return conditions([0, 0, 0, 1, 1, 1], [15, 24, 33, 15, 24, 33], [0, 5, 10, 0, 5, 10], [0, 3, 8, 0, 3, 8], p)


def narrow(
    names: Sequence[str] = (),
    sigmas: float = 8.0,
    seed: int = 0,
    *,
    duration: float = 1.5,
    every: float = 0.02,
    free: Sequence[str] = FRICTION,
    instruments: Instruments | None = None,
    on_battery: bool = False,
    constants: dict[str, float] | None = None,
) -> SeriesCase:
    """One sealed set of starts of the paper's robot on a surface that is known.

    As `tables.narrow`: constants within tolerances, effects each sized to leave `sigmas` after a refit of the `free`
    constants alone. `constants`: true ones, in place of such.
    """
    rng = np.random.default_rng(seed)
    p = perturbed(rng, free) if constants is None else constants
    c = starts(p)
    w = SeriesWorld(
        "narrow", "", PAPER, p, c, ((duration, 1),) * len(c.U), instruments or Instruments(sd=(0.05, 15.0, 5.0)),
        base=every, stated=tuple(free), step=STEP, battery=float(on_battery),
    )  # fmt: skip
    return _made(w, names, [sigmas] * len(names), seed, rng, np.random.default_rng(0), beside=False)


def case(
    w: SeriesWorld, names: Sequence[str] = (), sigmas: float | Sequence[float] = 8.0, seed: int = 0
) -> SeriesCase:
    """One sealed set of histories.

    Args:
        names: of effects: EVERY or EVENTS.
        sigmas: that each leaves after a refit of the constants, with the analyst's priors, and of the others, estimated
            at a tenth of their ordinary size. None is larger than LARGEST.
    """
    rng = np.random.default_rng([78, seed])
    wanted = [float(sigmas)] * len(names) if np.ndim(sigmas) == 0 else [float(x) for x in sigmas]
    return _made(w, names, wanted, seed, rng, rng)


def _made(
    w: SeriesWorld, names: Sequence[str], wanted: Sequence[float], seed: int, rng: np.random.Generator,
    faults: np.random.Generator, beside: bool = True,
) -> SeriesCase:  # fmt: skip
    p, c, show = w.constants, w.conditions, w.instruments
    terms, where = [], []
    for name in names:
        law, window = event(name, rng, w) if name in EVENTS else (EVERY[name], None)
        terms.append(laws.shaped(name, rng, law))
        where.append({} if window is None else {"variable": "time", "window": window})
    shown = samples(w)
    seen, odd = _faults(w, shown, faults)
    reached: list[float] = []
    if names:
        terms, reached = _sized(w, terms, wanted, seen & ~odd, beside)
    y = shown_by(w, p, c, terms)[1]
    noise = w.noise * rng.standard_normal(y.shape) * np.array(show.sd)[:, None, None]
    gross = rng.choice((-1.0, 1.0), y.shape) * rng.uniform(*tables.GROSS, y.shape) * show.stated[:, None, None]
    step = np.array(show.step)[:, None, None]
    read = np.round((y * SHOWN[:, :, None] + noise + np.where(odd, gross, 0.0)) / step) * step
    rows = of_rows(c, p)
    grips = rows["radius"][:, None] * y[1] / p["gearbox.ratio"] - y[2] < rows["ground.friction.speed_static"][:, None]
    label = {
        "schema": "mmrjax.sealed/1",
        "seed": seed,
        "kind": "clean" if not names else "+".join("library" if t.law.cls else "outside" for t in terms),
        "stratum": w.stratum,
        "variety": w.variety,
        "on_battery": bool(w.battery),
        "effects": [
            t.label | {"sigmas": left, "where": place} for t, left, place in zip(terms, reached, where, strict=True)
        ],
        "constants": {w.machine.public(n): p[n] for n in w.free},
        **w.machine.label(p),
        "rows": int(shown.sum()),
        "grips": [bool(x[round(d / w.base)]) for x, (d, _) in zip(grips, w.design, strict=True)],
        "noise": w.noise,
        "outliers": int((odd & shown).sum()),
        "missing": int((~seen & shown).sum()),
        "sound": bool(np.isfinite(y).all()),
    }
    return SeriesCase(_columns(w, np.where(seen, read, np.nan), shown), label, w.machine.toml, w, tuple(terms))


def _faults(w: SeriesWorld, shown: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Which readings are in the table, and which of them are gross, shape (3, runs, instants). The first samples of a
    run are as they should be, for a history has to start at rest."""
    share = rng.random((2, 3, *shown.shape))
    later = shown.copy()
    later[:, :2] = False
    seen = shown & ~((share[0] < w.missing) & later)
    return seen, (share[1] < w.outliers) & seen & later


def shown_by(
    w: SeriesWorld, p: Mapping[str, Any], c: Conditions, terms: Sequence[Term]
) -> tuple[np.ndarray, np.ndarray]:
    """As `simulated`, with what is wrong with the instruments."""
    times, y = simulated(w, p, c, [t for t in terms if t.law.balance not in CHANNELS])
    for t in terms:
        if t.law.balance in CHANNELS:
            s = SimpleNamespace(time=times[None, :], w=y[1], V=y[2], I=y[0] / SIDES)
            a = np.asarray(t.amplitude)
            y[CHANNELS.index(t.law.balance)] += (a[:, None] if a.ndim else a) * t.law.of(s, t.shapes)
    return times, y


def signatures(w: SeriesWorld, terms: Sequence[Term], good: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whitened change of the good readings by each term alone, shape (terms, readings), and by one sd of the analyst's
    prior of each constant, shape (readings, constants). One batch of robots.

    Args:
        good: which readings count, shape (3, runs, instants).
    """
    p, c, free = w.constants, w.conditions, w.free
    runs, members = len(c.U), 1 + len(free) + len(terms)
    wide = c.at(np.tile(np.arange(runs), members))

    def only(k: int, value: float) -> np.ndarray:
        return np.where(np.arange(runs * members) // runs == k, value, 0.0)

    batch = {n: np.full(runs * members, v) for n, v in p.items()}
    for k, (name, (_, nudge)) in enumerate(free.items()):
        batch[name] = p[name] + only(1 + k, nudge)
    each = [dataclasses.replace(t, amplitude=only(1 + len(free) + k, t.amplitude)) for k, t in enumerate(terms)]
    _, y = shown_by(w, batch, wide, each)
    white = (y * SHOWN[:, :, None] / w.instruments.stated[:, None, None]).reshape(3, members, *good.shape[1:])
    change = np.moveaxis(white[:, 1:] - white[:, :1], 1, 0)[:, good]
    return change[len(free) :], change[: len(free)].T * np.array([sd / nudge for sd, nudge in free.values()])


def _sized(
    w: SeriesWorld, terms: Sequence[Term], wanted: Sequence[float], good: np.ndarray, beside: bool
) -> tuple[list[Term], list[float]]:
    """Terms with the amplitudes at which each leaves its sigmas, beside the others or alone, and how many it does.

    From a tenth of their ordinary size, in proportion: what is left of a large change after a linear refit is mostly
    curvature, which a refit would follow.
    """
    trial = [dataclasses.replace(t, amplitude=0.1 * t.law.size) for t in terms]
    changes, slopes = signatures(w, trial, good)
    found, reached = [], []
    for k, (t, d, want) in enumerate(zip(trial, changes, wanted, strict=True)):
        others = [1e4 * x / (np.linalg.norm(x) + 1e-300) for j, x in enumerate(changes) if beside and j != k]
        columns = np.concatenate([slopes, *(x[:, None] for x in others)], 1)
        left = float(np.linalg.norm(remainder(d, columns))) + 1e-300
        amplitude = min(want * t.amplitude / left, LARGEST * t.law.size)
        found.append(dataclasses.replace(t, amplitude=amplitude))
        reached.append(left * amplitude / t.amplitude)
    return found, reached


def oracle(k: SeriesCase) -> list[dict[str, Any]]:
    """For each effect of a case, the library effect that noise-free data tell from it least, of those that these
    histories may have, and the sigmas that it would leave: see `tables.oracle`."""
    w = k.world
    good = np.broadcast_to(samples(w), (3, *samples(w).shape))
    tried: list[Term] = []
    for name in w.pool:
        law = SERIES[name]
        grid: list[dict[str, float]] = [{}]
        for shape, (low, high) in law.shapes.items():
            grid = [{shape: v} for v in ((0.0, np.pi / 2) if shape == "phase" else np.geomspace(low, high, 3))]
        tried += [Term(name, 0.1 * law.size, shapes, law) for shapes in grid]
    changes, slopes = signatures(w, [*tried, *k.terms], good)
    left = [remainder(d, slopes) for d in changes]
    answers = []
    for term, mine in zip(k.terms, left[len(tried) :], strict=True):
        apart: dict[str, float] = {}
        for name in {t.name for t in tried if t.name != term.law.cls}:
            those = [x for t, x in zip(tried, left, strict=False) if t.name == name]
            waves = "phase" in SERIES[name].shapes  # two phases make any other
            spans = [np.stack(those, 1)] if waves else [x[:, None] for x in those]
            apart[name] = min(float(np.linalg.norm(mine - x @ np.linalg.lstsq(x, mine)[0])) for x in spans)
        mimic = min(apart, key=apart.__getitem__)
        answers.append({"best_other": apart[mimic], "mimic": mimic})
    return answers


def _columns(w: SeriesWorld, read: np.ndarray, shown: np.ndarray) -> dict[str, np.ndarray]:
    """The table of a set: run by run, in the order of time."""
    run, instant = np.nonzero(shown)
    table = {"run_id": np.array([f"start{k}" for k in run]), "time_s": np.round(instant * w.base, 6)}
    table |= {name: column[run] for name, column in tables.settings(w.conditions, w.machine.names).items()}
    for k, (column, sd) in enumerate(zip(tables.READINGS, tables.DEVIATIONS, strict=True)):
        table[column] = np.round(read[k][run, instant], 6)
        stated = round(float(w.instruments.stated[k]), 6)
        table[sd] = np.where(np.isfinite(table[column]), stated, np.nan)
    return table
