"""Synthetic histories under the wide conditions of the field: any surface, other robots, settings and samplings,
poor instruments, samples that are missing, an event at the same instant of every run.

No run is switched off on its way: a table of histories has one supply voltage a run, so it could not say when.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import generator as g
import generator_robots as robots
import generator_series as gs
import generator_wide as gw
import numpy as np
from generator_robots import PAPER, ROLES, TRACKS, WHEELS, Machine
from reference import SIDES, G

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


@dataclasses.dataclass(frozen=True)
class SeriesWorld:
    """What a set of histories is measured in; as `generator_wide.World`.

    Attributes:
        conditions: of each run; design: duration and sampling of each.
        dropped: share of samples that no row tells of.
    """

    stratum: str
    variety: str
    machine: Machine
    constants: Mapping[str, float]
    conditions: g.Conditions
    design: tuple[tuple[float, int], ...]
    instruments: g.Instruments
    outliers: float = 0.0
    missing: float = 0.0
    dropped: float = 0.0
    noise: float = 1.0

    @property
    def free(self) -> tuple[str, ...]:
        """Constants that the analyst fits."""
        chassis = [f"{r}.{n}" for r in self.machine.names for n in ("inertia", "ground.friction.dynamic")]
        return (*self.machine.free, "motor.inductance", "motor.inertia", *chassis)

    @property
    def pool(self) -> tuple[str, ...]:
        """Effects of the library that these histories may have: two need longer ones or a battery, the inductance is
        a constant of the base, grousers have the paper's pitch, and at small currents brushes are stiff."""
        lost = ("thermal_drift", "battery_sag", "armature_inductance")
        lost += () if self.machine is PAPER else ("grouser_polygon", "brush_drop")
        return tuple(n for n, f in gs.FORMS.items() if f.cls and n not in lost)


def world(rng: np.random.Generator, stratum: str = "plain", variety: int = 0, *, noise: float = 1.0) -> SeriesWorld:
    """A world of a stratum, of which `variety` takes one of its kinds."""
    kind = STRATA[stratum][variety % len(STRATA[stratum])]
    roles = {"tracks": (TRACKS,), "wheels": (WHEELS,), "both": ROLES}.get(kind)
    for _ in range(200):
        m = PAPER if roles is None else robots.machine(rng, roles)
        p = gw.surfaced(rng, m)
        for name in ("motor.inductance", "motor.inertia", *(f"{r}.inertia" for r in m.names)):
            short = name if name in FURTHER else "inertia"
            p[name] *= 1 + 0.5 * FURTHER[short] * float(np.clip(rng.standard_normal(), -2, 2))
        design = DESIGNS.get(kind, DESIGNS["plain"])
        c = _settings(rng, m, p, len(design))
        y, sound = g.readings(c, p)
        if sound.all() and gw.gripping(c, p, y):
            break
    else:
        raise ValueError("no such world without runs that never grip")
    show = m.instruments
    show = g.Instruments(tuple(float(f"{a * b:.2g}") for a, b in zip(show.sd, FASTER, strict=True)), show.step)
    if kind == "quantised":
        show = gw._coarse(rng, show)
    return SeriesWorld(
        stratum, kind, m, p, c, design, show, gw.OUTLIERS * (kind == "outliers"), gw.MISSING * (kind == "missing"),
        gw.MISSING * (kind == "missing"), noise,
    )  # fmt: skip


def _settings(rng: np.random.Generator, m: Machine, p: Mapping[str, float], runs: int) -> g.Conditions:
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
        most = min(robots.STEEPEST, float(np.degrees(np.arctan(max(hold, 0.0)))))
        slope.append(round(most * (k % 3) / 2 * float(rng.uniform(0.7, 1.0)), 1))
    return g.conditions(wheeled, u, slope, load, p)


# --- the physics ------------------------------------------------------------------------------------


def fastest(c: g.Conditions, p: Mapping[str, Any], ohms: float = 0.0) -> float:
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
    w: SeriesWorld, p: Mapping[str, Any], c: g.Conditions, terms: Sequence[tuple] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] from 0 on by BASE, and I_Σ, w, V of every run as long as the longest, shape (3, runs, instants)."""
    ohms = sum(float(np.max(a)) * SIDES for f, a, _ in terms if f.balance in ("electrical", "supply"))
    step = BASE / np.ceil(BASE / np.clip(STABLE / fastest(c, p, min(ohms, 1.0)), FINEST, gs.STEP))
    return gs.histories(c, max(d for d, _ in w.design), BASE, p, terms, step=float(step))


def _samples(w: SeriesWorld) -> np.ndarray:
    """Which instants of `simulated` each run shows, shape (runs, instants); of those that are dropped the pattern is
    the same in every set, the first and the last stay."""
    count = round(max(d for d, _ in w.design) / BASE) + 1
    shown = np.zeros((len(w.design), count), bool)
    for k, (duration, every) in enumerate(w.design):
        at = np.arange(0, round(duration / BASE) + 1, every)
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


def event(name: str, rng: np.random.Generator, w: SeriesWorld) -> tuple[gs.Moving, list[float]]:
    """A shift while an event lasts, at the same instant of every run, and its window [s]."""
    balance, size = EVENTS[name]
    first = float(rng.uniform(*BEGINS) * min(d for d, _ in w.design))
    long = max(float(rng.uniform(*EVENT)), 2.5 * BASE * max(e for _, e in w.design))
    long = min(long, 0.95 * min(d for d, _ in w.design) - first)
    a, b = round(first, 3), round(first + long, 3)
    law = lambda s, q: np.where((s.time >= a) & (s.time < b), 1.0, 0.0) * np.ones_like(s.w)  # noqa: E731
    return gs.Moving(balance, law, size), [a, b]


def law_of(name: str) -> gs.Moving:
    """A form by its name: of the generator, or a foreign law."""
    if name in gs.FORMS:
        return gs.FORMS[name]
    import foreign_laws

    return foreign_laws.FOREIGN_SERIES[name]


def foreign() -> tuple[str, ...]:
    """Names of the foreign laws of histories."""
    import foreign_laws

    return tuple(foreign_laws.FOREIGN_SERIES)


# --- cases ------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class SeriesCase:
    """A sealed set of histories: the columns of its table, one row a sample, NaN where a reading is missing; its label
    its world, and its terms (form, amplitude, shapes)."""

    table: dict[str, np.ndarray]
    label: dict[str, Any]
    world: SeriesWorld
    terms: tuple[tuple, ...] = ()

    @property
    def toml(self) -> str | None:
        """The robot's file; None for the paper's."""
        return self.world.machine.toml


def case(
    w: SeriesWorld, names: Sequence[str] = (), sigmas: float | Sequence[float] = 8.0, seed: int = 0
) -> SeriesCase:
    """One sealed set of histories.

    Args:
        names: of effects: `generator_series.FORMS`, EVENTS or foreign laws.
        sigmas: that each leaves after a refit of the constants, with the analyst's priors, and of the others, estimated
            at a tenth of their ordinary size; none is larger than `generator_series.LARGEST`.
    """
    rng = np.random.default_rng([78, seed])
    p, c, show = w.constants, w.conditions, w.instruments
    wanted = [float(sigmas)] * len(names) if np.ndim(sigmas) == 0 else [float(x) for x in sigmas]
    forms, drawn, where = [], [], []
    for name in names:
        form, window = event(name, rng, w) if name in EVENTS else (law_of(name), None)
        forms.append(form)
        drawn.append({k: float(rng.uniform(*b)) for k, b in form.shapes.items()})
        where.append({} if window is None else {"variable": "time", "window": window})
    shown = _samples(w)
    seen, odd = _faults(w, shown, rng)
    amplitudes, reached = _sized(w, forms, drawn, wanted, seen & ~odd) if names else ([], [])
    terms = tuple(zip(forms, amplitudes, drawn, strict=True))
    y = _readings(w, p, c, terms)[1]
    noise = w.noise * rng.standard_normal(y.shape) * np.array(show.sd)[:, None, None]
    gross = rng.choice((-1.0, 1.0), y.shape) * rng.uniform(*gw.GROSS, y.shape) * show.stated[:, None, None]
    step = np.array(show.step)[:, None, None]
    read = np.round((y * g._SHOWN[:, :, None] + noise + np.where(odd, gross, 0.0)) / step) * step
    read = np.where(seen, read, np.nan)
    label = _label(w, seed, names, forms, drawn, amplitudes, reached, where, y, odd & shown, (~seen & shown).sum())
    return SeriesCase(_columns(w, read, shown), label, w, terms)


def _faults(w: SeriesWorld, shown: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Which readings are in the table, and which of them are gross, shape (3, runs, instants); the first samples of a
    run are as they should be, for a history has to start at rest."""
    share = rng.random((2, 3, *shown.shape))
    later = shown.copy()
    later[:, :2] = False
    seen = shown & ~((share[0] < w.missing) & later)
    return seen, (share[1] < w.outliers) & seen & later


def _readings(
    w: SeriesWorld, p: Mapping[str, Any], c: g.Conditions, terms: Sequence[tuple]
) -> tuple[np.ndarray, np.ndarray]:
    """As `simulated`, with what is wrong with the instruments."""
    times, y = simulated(w, p, c, [t for t in terms if t[0].balance not in g.CHANNELS])
    for form, amplitude, q in terms:
        if form.balance in g.CHANNELS:
            s = SimpleNamespace(time=times[None, :], w=y[1], V=y[2], I=y[0] / SIDES)
            a = np.asarray(amplitude)
            y[g.CHANNELS.index(form.balance)] += (a[:, None] if a.ndim else a) * form.of(s, q)
    return times, y


def signatures(w: SeriesWorld, terms: Sequence[tuple], good: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whitened change of the good readings by each term alone, shape (terms, readings), and by one sd of the analyst's
    prior of each constant, shape (readings, constants); one batch of robots.

    Args:
        terms: (form, amplitude, shapes); good: which readings count, shape (3, runs, instants).
    """
    p, c, free = w.constants, w.conditions, w.free
    runs, members = len(c.U), 1 + len(free) + len(terms)
    wide = g.Conditions(*(np.tile(getattr(c, f.name), members) for f in dataclasses.fields(c)))

    def only(k: int, value: float) -> np.ndarray:
        return np.where(np.arange(runs * members) // runs == k, value, 0.0)

    sds = {n: p[n] * FURTHER[_further(n)] for n in w.free if _further(n)} | gw.analyst(p, w.machine.free)
    nudge = {n: min(0.02 * p[n], 0.1 * sds[n]) if p[n] > 0 else 0.1 * sds[n] for n in free}
    batch = {n: np.full(runs * members, v) for n, v in p.items()}
    for k, name in enumerate(free):
        batch[name] = p[name] + only(1 + k, nudge[name])
    each = [(f, only(1 + len(free) + k, a), q) for k, (f, a, q) in enumerate(terms)]
    _, y = _readings(w, batch, wide, each)
    white = (y * g._SHOWN[:, :, None] / w.instruments.stated[:, None, None]).reshape(3, members, *good.shape[1:])
    change = np.moveaxis(white[:, 1:] - white[:, :1], 1, 0)[:, good]
    return change[len(free) :], change[: len(free)].T * np.array([sds[n] / nudge[n] for n in free])


def _sized(
    w: SeriesWorld, forms: Sequence[gs.Moving], drawn: Sequence[Mapping], wanted: Sequence[float], good: np.ndarray
) -> tuple[list[float], list[float]]:
    """Amplitudes at which each form leaves its sigmas beside the others, and how many it does.

    From a tenth of their ordinary size, in proportion: what is left of a large change after a linear refit is mostly
    curvature, which a refit would follow.
    """
    trial = [0.1 * f.size for f in forms]
    changes, slopes = signatures(w, list(zip(forms, trial, drawn, strict=True)), good)
    amplitudes, reached = [], []
    for k, (d, want) in enumerate(zip(changes, wanted, strict=True)):
        others = [1e4 * x / (np.linalg.norm(x) + 1e-300) for j, x in enumerate(changes) if j != k]
        columns = np.concatenate([slopes, *(x[:, None] for x in others)], 1)
        left = float(np.linalg.norm(g.remainder(d, columns))) + 1e-300
        amplitudes.append(min(want * trial[k] / left, gs.LARGEST * forms[k].size))
        reached.append(left * amplitudes[k] / trial[k])
    return amplitudes, reached


def oracle(k: SeriesCase) -> list[dict[str, Any]]:
    """For each effect of a case, the library effect that noise-free data tell from it least, of those that this
    generator holds, and the sigmas that it would leave: see `benchmarks/loop.py`."""
    w = k.world
    good = np.broadcast_to(_samples(w), (3, len(w.design), _samples(w).shape[1]))
    tried: list[tuple[str, tuple]] = []
    for name in w.pool:
        form = gs.FORMS[name]
        grid: list[dict[str, float]] = [{}]
        for shape, (low, high) in form.shapes.items():
            grid = [{shape: v} for v in ((0.0, np.pi / 2) if shape == "phase" else np.geomspace(low, high, 3))]
        tried += [(name, (form, 0.1 * form.size, shapes)) for shapes in grid]
    changes, slopes = signatures(w, [*(t for _, t in tried), *k.terms], good)
    left = [g.remainder(d, slopes) for d in changes]
    answers = []
    for term, mine in zip(k.terms, left[len(tried) :], strict=True):
        apart: dict[str, float] = {}
        for name in {n for n, _ in tried if n != term[0].cls}:
            those = [x for (n, _), x in zip(tried, left, strict=False) if n == name]
            waves = "phase" in gs.FORMS[name].shapes  # two phases make any other
            spans = [np.stack(those, 1)] if waves else [x[:, None] for x in those]
            apart[name] = min(float(np.linalg.norm(mine - x @ np.linalg.lstsq(x, mine)[0])) for x in spans)
        mimic = min(apart, key=apart.__getitem__)
        answers.append({"best_other": apart[mimic], "mimic": mimic})
    return answers


def _further(name: str) -> str:
    """The key of FURTHER that a constant has; empty for none."""
    short = name.partition(".")[2] if name.split(".")[0] in ROLES else name
    return short if short in FURTHER else ""


def _label(w, seed, names, forms, drawn, amplitudes, reached, where, y, odd, missing) -> dict[str, Any]:
    p, m = w.constants, w.machine
    radius = np.where(w.conditions.wheeled > 0.5, p["4W2T.radius"], p["6T2A.radius"])
    V_s = np.where(
        w.conditions.wheeled > 0.5, p["4W2T.ground.friction.speed_static"], p["6T2A.ground.friction.speed_static"]
    )
    grips = radius[:, None] * y[1] / p["gearbox.ratio"] - y[2] < V_s[:, None]
    return {
        "schema": "mmrjax.sealed/1",
        "seed": seed,
        "kind": "clean" if not names else "+".join("library" if f.cls else "outside" for f in forms),
        "stratum": w.stratum,
        "variety": w.variety,
        "effects": [
            {"name": x, "class": f.cls, "balance": "sensor" if f.balance in g.CHANNELS else f.balance,
             "channel": f.balance if f.balance in g.CHANNELS else "", "amplitude": a, "sizes": abs(a) / f.size,
             "shapes": dict(q), "sigmas": s, "where": place}
            for x, f, q, a, s, place in zip(names, forms, drawn, amplitudes, reached, where, strict=True)
        ],
        "constants": {_public(m, n): p[n] for n in w.free},
        "surface": {m.names[r]: {"adhesion": p[f"{r}.ground.friction.static"], "V_s": p[f"{r}.ground.friction.speed_static"]}
                    for r in m.names},
        "robot": m.size,
        "rows": int(_samples(w).sum()),
        "grips": [bool(x[round(d / BASE)]) for x, (d, _) in zip(grips, w.design, strict=True)],
        "noise": w.noise,
        "outliers": int(odd.sum()),
        "missing": int(missing),
        "sound": bool(np.isfinite(y).all()),
    }  # fmt: skip


def _public(m: Machine, name: str) -> str:
    head, _, rest = name.partition(".")
    return f"{m.names[head]}.{rest}" if head in m.names else name


def _columns(w: SeriesWorld, read: np.ndarray, shown: np.ndarray) -> dict[str, np.ndarray]:
    """The table of a set: run by run, in the order of time."""
    c, m = w.conditions, w.machine
    run, instant = np.nonzero(shown)
    name = np.where(c.wheeled > 0.5, *(m.names.get(r, "") for r in (WHEELS, TRACKS)))
    table = {
        "run_id": np.array([f"start{k}" for k in run]),
        "time_s": np.round(instant * BASE, 6),
        "configuration": name[run],
        "supply_voltage_V": c.U[run],
        "total_mass_kg": c.mass[run],
        "payload_kg": c.payload[run],
        "slope_deg": np.round(np.degrees(c.slope), 6)[run],
    }
    for k, (column, sd) in enumerate(
        (("total_current_A", "total_current_sd_A"), ("motor_speed_rpm", "motor_speed_sd_rpm"), ("speed_mm_s", "speed_sd_mm_s"))
    ):  # fmt: skip
        table[column] = np.round(read[k][run, instant], 6)
        stated = round(float(w.instruments.stated[k]), 6)
        table[sd] = np.where(np.isfinite(table[column]), stated, np.nan)
    return table
