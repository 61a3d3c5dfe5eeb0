"""Synthetic tables under the wide conditions of the field: any surface, any robot, poor instruments, gaps, drifts.

A `World` is what a table is measured in: a robot, true constants, conditions in the order of measuring, instruments
and their faults. `case` puts effects into it, each as strong as wanted beside the others; `coverage` draws the truth
from the analyst's priors.
"""

from __future__ import annotations

import csv
import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import generator as g
import generator_robots as robots
import numpy as np
from generator_robots import PAPER, ROLES, TRACKS, WHEELS, Machine

#: Kinds of worlds. Surfaces are wide in all of them.
STRATA = ("plain", "quantised", "outliers", "missing", "short", "long", "tracks", "wheels", "both", "all")
ADHESION, CREEP = (0.2, 1.0), (0.002, 0.06)  # μ_s [-]; V_s [m/s]
OUTLIERS, GROSS, MISSING = 0.02, (6.0, 30.0), 0.1  # share of readings, their size [sd], share of cells
COARSE = (3.0, 6.0)  # steps of a coarse display [sd]
#: Degrees of freedom of heavy-tailed noise; what uneven noise is about zero, and at the largest reading [sd of all].
TAIL, UNEVEN = 3.0, (0.3, 1.7)
#: What noise may be like: as stated, heavy-tailed (Student's t of the same sd), uneven (of larger readings larger).
NOISES = ("normal", "heavy", "uneven")
#: Rows of short and of long tables. Few lengths once padded to 16: each is a program to compile for who reads them.
SHORT, LONG = ((15, 16), (17, 32), (33, 48)), ((113, 128), (193, 200))

#: The analyst's priors, as the fields of the package state them: relative sds of log-normals, sds of normals.
RELATIVE: dict[str, float] = {
    "motor.resistance": 0.05, "motor.torque_constant": 0.02, "motor.friction_coulomb": 0.15,
    "motor.friction_viscous": 0.15, "gearbox.efficiency_load": 0.03, "gearbox.friction_coulomb": 0.15,
    "gearbox.friction_viscous": 0.15, "track.loss_coulomb": 0.15, "track.loss_viscous": 0.15,
    "ground.rolling_resistance": 0.15, "ground.friction.static": 0.3, "ground.friction.speed_static": 1.0,
    "radius": 0.005,
}  # fmt: skip
ABSOLUTE: dict[str, tuple[float, float, float]] = {"track.guide_share": (0.2, 0.0, 1.0)}  # sd, bounds
SOFTNESS = 0.05  # sds over which a bound is rounded


def spread(name: str) -> float:
    """Sd of the log of a constant that the analyst knows as a scale; configurations by any name."""
    return float(np.sqrt(np.log1p((RELATIVE.get(name) or RELATIVE[name.split(".", 1)[1]]) ** 2)))


def _last(name: str) -> str:
    """A constant's name without its configuration."""
    head, _, rest = name.partition(".")
    return rest if head in ROLES else name


def analyst(p: Mapping[str, float], names: Sequence[str]) -> dict[str, float]:
    """One sd of each constant as the analyst's priors have it, at the values `p`."""
    return {n: ABSOLUTE[_last(n)][0] if _last(n) in ABSOLUTE else p[n] * spread(_last(n)) for n in names}


def drawn_from_priors(rng: np.random.Generator, m: Machine) -> tuple[dict[str, float], dict[str, float]]:
    """True constants of a robot from the analyst's priors, and where in them they are (standard normal)."""
    p, z = dict(m.constants), {}
    for name in m.free:
        z[name] = float(rng.standard_normal())
        if _last(name) in ABSOLUTE:
            sd, low, high = ABSOLUTE[_last(name)]
            u, w = p[name] + sd * z[name], SOFTNESS * sd
            u = u + w * np.logaddexp(0, (low - u) / w) - w * np.logaddexp(0, (u - high) / w)
            p[name] = float(np.clip(u, low, high))
        else:
            p[name] *= float(np.exp(spread(_last(name)) * z[name]))
    return _followed(p), z


def _followed(p: dict[str, float]) -> dict[str, float]:
    """Constants with μ_d and V_d in their ratio to μ_s and V_s, which the model keeps."""
    for role in ROLES:
        p[f"{role}.ground.friction.dynamic"] = 0.8 * p[f"{role}.ground.friction.static"]
        p[f"{role}.ground.friction.speed_dynamic"] = 10 * p[f"{role}.ground.friction.speed_static"]
    return p


def surfaced(rng: np.random.Generator, m: Machine, scale: float = 1.0) -> dict[str, float]:
    """True constants: off the maker's by their tolerances, on a surface of which nothing is known."""
    p = dict(m.constants)
    for name in m.free:
        p[name] *= 1 + scale * g.TOLERANCES[name] * float(np.clip(rng.standard_normal(), -2, 2))
    for role in m.names:
        p[f"{role}.ground.friction.static"] = float(rng.uniform(*ADHESION))
        p[f"{role}.ground.friction.speed_static"] = float(np.exp(rng.uniform(*np.log(CREEP))))
    return _followed(p)


# --- worlds -----------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class World:
    """What a table is measured in.

    Attributes:
        stratum: of STRATA; constants: true ones; conditions: in the order of measuring; shuffled: that order.
        outliers, missing: shares of readings; noise: true sd over the stated one.
        law: of NOISES; stated: whether the table states sds.
        z: where the truth is in the analyst's priors, where it was drawn from them.
    """

    stratum: str
    machine: Machine
    constants: Mapping[str, float]
    conditions: g.Conditions
    instruments: g.Instruments
    shuffled: bool
    outliers: float = 0.0
    missing: float = 0.0
    noise: float = 1.0
    z: Mapping[str, float] = dataclasses.field(default_factory=dict)
    law: str = "normal"
    stated: bool = True

    def slopes(self) -> np.ndarray:
        """Whitened change of the readings for one sd of the analyst's prior of each constant."""
        free = self.machine.free
        sds = analyst(self.constants, free)
        return g.base_slopes(self.conditions, self.constants, self.instruments, free, sds)

    @property
    def pool(self) -> tuple[str, ...]:
        """Effects of the library that this robot can have."""
        return tuple(n for n in g.LIBRARY if n != "mass_offset" or self.machine is PAPER)


def gripping(c: g.Conditions, p: dict[str, float], y: np.ndarray) -> bool:
    """Whether no row's movers roll four times as far as it travels; y are its readings, shape (3, rows)."""
    rolled = y[1] * np.where(c.wheeled > 0.5, p["4W2T.radius"], p["6T2A.radius"]) / p["gearbox.ratio"]
    return bool((y[2] > 0.25 * rolled).all())


def world(
    rng: np.random.Generator, stratum: str = "plain", *, shuffled: bool | None = None, noise: float = 1.0,
    from_priors: bool = False, law: str = "normal", stated: bool = True,
) -> World:  # fmt: skip
    """A world of a stratum, or of `few` rows (see `World` for `law` and `stated`); `from_priors`: the truth is drawn
    from the analyst's priors.

    Rows are in the order of the grid, or shuffled, as it comes, where `shuffled` does not say.
    """
    everything = stratum == "all"
    roles = {"tracks": (TRACKS,), "wheels": (WHEELS,), "both": ROLES}.get(stratum)
    if everything:
        roles = ((TRACKS,), (WHEELS,), ROLES)[rng.integers(3)]
    fault = ("quantised", "outliers", "missing")
    for _ in range(200):
        m = PAPER if roles is None else robots.machine(rng, roles)
        p, z = drawn_from_priors(rng, m) if from_priors else (surfaced(rng, m), {})
        length = ("short", "long")[rng.integers(2)] if everything else stratum
        order = bool(rng.random() < 0.5) if shuffled is None else shuffled
        c, order = _conditions(rng, m, p, length, order)
        y, sound = g.readings(c, p)
        if sound.all() and gripping(c, p, y):
            break
    else:
        raise ValueError("no such world without rows that slide")
    show = _coarse(rng, m.instruments) if everything or stratum == "quantised" else m.instruments
    has = {f: everything or stratum == f for f in fault}
    return World(
        stratum, m, p, c, show, order, OUTLIERS * has["outliers"], MISSING * has["missing"], noise, z, law, stated
    )  # fmt: skip


def _conditions(
    rng: np.random.Generator, m: Machine, p: Mapping[str, float], length: str, shuffled: bool
) -> tuple[g.Conditions, bool]:
    if length == "short":
        c = robots.grid(m, p)
        rows = rng.permutation(len(c.U))[: rng.integers(*SHORT[rng.integers(len(SHORT))], endpoint=True)]
        return c.at(rows), True
    if length == "long":
        c = robots.grid(m, p, 6)
        count = rng.integers(*LONG[rng.integers(len(LONG))], endpoint=True)
        again = rng.integers(0, len(c.U), max(count - len(c.U), 0))  # repeats
        return c.at(rng.permutation(np.concatenate([rng.permutation(len(c.U))[:count], again]))), True
    c = robots.grid(m, p)
    if length == "few":  # as in Tables A1 and A2
        c = c.at(np.flatnonzero((c.payload == 0) & (np.isin(c.U, np.unique(c.U)[[0, -1]]))))
    return (c.at(rng.permutation(len(c.U))), True) if shuffled else (c, False)


def _coarse(rng: np.random.Generator, fine: g.Instruments) -> g.Instruments:
    """Displays that show steps of several sds."""
    return g.Instruments(fine.sd, tuple(float(f"{sd * rng.uniform(*COARSE):.1g}") for sd in fine.sd))


# --- what depends on when a row was measured ----------------------------------------------------------

_TAU = {"tau": (0.1, 0.4)}
#: Drifts over the order of measuring, `s.order` from 0 to 1.
DRIFTS: dict[str, g.Form] = {
    "drift.electrical": g.Form("", "electrical", lambda s, q: s.I * s.order, 0.2),
    "drift.supply": g.Form("", "supply", lambda s, q: s.order, 0.5),
    "drift.track": g.Form("", "track", lambda s, q: s.order, 0.05, either=True),
    "drift.ground": g.Form("", "ground", lambda s, q: s.N * s.order, 0.01, either=True),
    "drift.total_current": g.Form("", "total_current", lambda s, q: s.order, 0.05, either=True),
    "drift.speed": g.Form("", "speed", lambda s, q: s.V * s.order, 0.01, either=True),
    "warming.electrical": g.Form("", "electrical", lambda s, q: s.I * (1 - np.exp(-s.order / q["tau"])), 0.2, _TAU),
    "warming.motor": g.Form("", "motor", lambda s, q: np.exp(-s.order / q["tau"]), 5e-4, _TAU),
    "warming.gearbox": g.Form("", "gearbox", lambda s, q: s.w_k * np.exp(-s.order / q["tau"]), 5e-3, _TAU),
    "warming.track": g.Form("", "track", lambda s, q: np.exp(-s.order / q["tau"]), 0.1, _TAU),
}  # fmt: skip
#: What is shifted in some of the rows, and by how much it commonly is, in the instruments' or the paper's robot's size.
SHIFTED: dict[str, float] = {
    "total_current": 0.1, "motor_speed": 3.0, "speed": 0.015, "electrical": 0.3, "track": 0.05, "slip": 0.015,
}  # fmt: skip
#: Kinds of clusters: rows that follow one another, or all rows of one condition.
CLUSTERS = tuple(f"{which}.{where}" for which in ("rows", "voltage", "slope", "payload") for where in SHIFTED)


def cluster(name: str, rng: np.random.Generator, c: g.Conditions) -> tuple[g.Term, np.ndarray]:
    """A shift of some rows (see CLUSTERS), and which rows: 6 to 12 % that follow one another, four at least, or all
    of one value of a condition."""
    which, _, where = name.partition(".")
    count = len(c.U)
    if which == "rows":
        long = max(4, round(count * rng.uniform(0.06, 0.12)))
        first = int(rng.integers(1, count - long))
        rows = np.arange(first, first + long)
    else:
        values = {"voltage": c.U, "slope": c.slope, "payload": c.payload}[which]
        rows = np.flatnonzero(values == rng.choice(np.unique(values)))
    hit = set(rows.tolist())
    law = g.Form("", where, lambda s, q: np.isin(s.row, list(hit)).astype(float), SHIFTED[where], either=True)
    return g.draw(name, rng, law), rows


def law_of(name: str) -> g.Form:
    """A form by its name: of the generator, a drift, or one of the foreign laws."""
    if name in g.FORMS or name in DRIFTS:
        return g.FORMS.get(name) or DRIFTS[name]
    import foreign_laws

    return foreign_laws.FOREIGN[name]


def foreign() -> tuple[str, ...]:
    """Names of the foreign laws."""
    import foreign_laws

    return tuple(foreign_laws.FOREIGN)


# --- sizes ------------------------------------------------------------------------------------------


def _signature(w: World, terms: Sequence[g.Term], k: int) -> np.ndarray:
    """Whitened change of all readings by the k-th of the terms, beside the others; NaN where a row is lost."""
    with_it, a = g.readings(w.conditions, w.constants, terms)
    without, b = g.readings(w.conditions, w.constants, [t for j, t in enumerate(terms) if j != k])
    change = np.where(a & b, (with_it - without) * g._SHOWN / w.instruments.stated[:, None], np.nan)
    return change.ravel()


#: Of a column of no prior, in units of its whitened size.
_FREE = 1e4


def _beside(w: World, terms: Sequence[g.Term], k: int, slopes: np.ndarray) -> np.ndarray:
    """What a refit moves while it looks at the k-th term: constants, amplitudes and shapes of the others."""
    columns = [slopes]
    for j, term in enumerate(terms):
        if j == k:
            continue
        whole = _signature(w, terms, j)
        changed = [whole]
        for shape, value in term.shapes.items():
            other = list(terms)
            other[j] = dataclasses.replace(term, shapes=dict(term.shapes) | {shape: 1.05 * value})
            changed.append(_signature(w, other, j) - whole)
        columns += [(_FREE * x / (np.linalg.norm(x) + 1e-300))[:, None] for x in map(np.nan_to_num, changed)]
    return np.concatenate(columns, 1)


def sized(
    w: World, terms: Sequence[g.Term], sigmas: Sequence[float], seen: np.ndarray, slopes: np.ndarray
) -> tuple[list[g.Term], list[float]]:
    """Terms with amplitudes at which each leaves so many sigmas after a refit of the constants and of the others, and
    how many really are; fewer where the robot would no longer run.

    Args:
        seen: whether a reading is in the table, shape (3 rows,).
    """
    weighted = slopes * seen[:, None]
    terms = [dataclasses.replace(t, amplitude=0.1 * t.form.size * float(np.sign(t.amplitude))) for t in terms]

    def left(now: Sequence[g.Term], k: int) -> float:
        sign = _signature(w, now, k)
        if not np.isfinite(sign).all():
            return np.nan
        return float(np.linalg.norm(g.remainder(sign * seen, _beside(w, now, k, weighted) * seen[:, None])))

    best, reached = list(terms), [0.0] * len(terms)
    for _ in range(8 if len(terms) == 1 else 12):
        settled = True
        for k, want in enumerate(sigmas):
            got = left(terms, k)
            if np.isnan(got):
                half = 0.5 * (terms[k].amplitude + best[k].amplitude)
                terms[k] = dataclasses.replace(terms[k], amplitude=half)
                settled = False
                continue
            best[k] = terms[k]
            if got > 0 and abs(got - want) > 0.02 * want:
                settled = False
                changed = terms[k].amplitude * float(np.clip(want / got, 0.2, 20.0))
                terms[k] = dataclasses.replace(terms[k], amplitude=changed)
        if settled:
            break
    for now in (terms, best):
        reached = [left(now, k) for k in range(len(now))]
        if np.isfinite(reached).all():
            return list(now), reached
    return list(best), [0.0 if np.isnan(x) else x for x in reached]


# --- cases ------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class WideCase(g.Case):
    """A sealed table of a world; readings that are missing are NaN, and empty cells of its file."""

    world: World

    @property
    def toml(self) -> str | None:
        """The robot's file; None for the paper's."""
        return self.world.machine.toml

    def elsewhere(self, seed: int) -> dict[str, np.ndarray]:
        """As many runs again of the same robot, without faults, at conditions within those of the table."""
        rng = np.random.default_rng([78, seed])
        w, c = self.world, self.conditions
        n = len(c.U)
        k = rng.integers(0, n, 3 * n)
        slope, payload, U = c.slope[k].copy(), c.payload[k].copy(), rng.uniform(c.U.min(), c.U.max(), 3 * n)
        for role in np.unique(c.wheeled):  # no steeper and no heavier than that configuration went
            mine = c.wheeled[k] == role
            slope[mine] *= rng.random(mine.sum())
            payload[mine] = rng.uniform(0, c.payload[c.wheeled == role].max(), mine.sum())
        new = g.conditions(c.wheeled[k], U, np.degrees(slope), payload, self.constants)
        _, sound = g.readings(new, self.constants, self.terms)
        new = new.at(np.flatnonzero(sound)[:n])
        y, sound = g.readings(new, self.constants, self.terms)
        plain = dataclasses.replace(w, conditions=new, noise=1.0, law="normal", stated=True)
        faultless = np.zeros(y.shape, bool)
        return _table(plain, y, sound, faultless, faultless, rng)

    def write(self, table: Path, label: Path) -> None:
        """As `Case.write`; the robot's file is beside the table, with the ending of its own."""
        with table.open("w", newline="", encoding="utf-8") as file:
            out = csv.writer(file)
            out.writerow(self.table)
            for row in zip(*self.table.values(), strict=True):
                out.writerow(["" if isinstance(x, float) and np.isnan(x) else x for x in row])
        label.write_text(json.dumps(self.label, indent=1), encoding="utf-8")
        if self.toml is not None:
            table.with_suffix(".toml").write_text(self.toml, encoding="utf-8")


def case(
    w: World, names: Sequence[str] = (), sigmas: float | Sequence[float] = 8.0, seed: int = 0,
    *, amplitudes: Mapping[str, float] | None = None,
) -> WideCase:  # fmt: skip
    """One sealed table of a world.

    Args:
        names: of effects: `g.FORMS`, DRIFTS, CLUSTERS or foreign laws; none makes a clean table.
        sigmas: that each leaves after a refit of the constants, with the analyst's priors, and of the others.
        seed: of shapes, signs, noise and faults.
        amplitudes: by name, in place of sizes.
    """
    rng = np.random.default_rng([77, seed])
    c, p, show = w.conditions, w.constants, w.instruments
    terms, where = [], []
    for name in names:
        if name in CLUSTERS:
            term, rows = cluster(name, rng, c)
            what = {"rows": (rows + 1).tolist()}
        else:
            law = law_of(name)
            term = g.draw(name, rng, law)
            what = {"variable": "order"} if name in DRIFTS else {}
        if name not in g.LIBRARY and name not in g.VARIANTS and term.form.balance not in g.CHANNELS:
            term = dataclasses.replace(term, law=robots.fitted_to(term.form, w.machine))
        terms.append(term)
        where.append(what)
    share = rng.random((2, *(3, len(c.U))))
    missing = share[0] < w.missing
    odd = (share[1] < w.outliers) & ~missing
    seen = (~missing & ~odd).ravel().astype(float)
    wanted = [float(sigmas)] * len(terms) if np.ndim(sigmas) == 0 else list(sigmas)
    reached: list[float] = []
    with np.errstate(all="ignore"):
        slopes = w.slopes()
        if amplitudes is not None:
            terms = [dataclasses.replace(t, amplitude=amplitudes[t.name]) for t in terms]
            reached = [
                float(
                    np.linalg.norm(
                        g.remainder(
                            np.nan_to_num(_signature(w, terms, k)) * seen,
                            _beside(w, terms, k, slopes) * seen[:, None],
                        )
                    )
                )
                for k in range(len(terms))
            ]
        elif terms:
            terms, reached = sized(w, terms, wanted, seen, slopes)
        y, sound = g.readings(c, p, terms)
    label = {
        "schema": "mmrjax.sealed/1",
        "seed": seed,
        "kind": "+".join(_origin(t.name) for t in terms) or "clean",
        "stratum": w.stratum,
        "effects": [
            {"name": str(t.name), "class": t.form.cls, "balance": "sensor" if t.form.balance in g.CHANNELS else t.form.balance,
             "channel": t.form.balance if t.form.balance in g.CHANNELS else "", "amplitude": t.amplitude,
             "sizes": abs(t.amplitude) / t.form.size, "shapes": dict(t.shapes), "sigmas": left, "where": place}
            for t, left, place in zip(terms, reached, where, strict=True)
        ],
        "constants": {w.machine.public(n): p[n] for n in w.machine.free},
        "z": {w.machine.public(n): z for n, z in w.z.items()},
        "surface": {
            w.machine.names[role]: {"adhesion": p[f"{role}.ground.friction.static"],
                                    "V_s": p[f"{role}.ground.friction.speed_static"]}
            for role in w.machine.names
        },
        "robot": w.machine.size,
        "rows": len(c.U),
        "shuffled": w.shuffled,
        "noise": w.noise,
        "law": w.law,
        "stated": w.stated,
        "outliers": [[int(r) + 1, g.CHANNELS[k]] for k, r in zip(*np.nonzero(odd & sound), strict=True)],
        "missing": int((missing & sound).sum()),
        "rows_lost": int((~sound).sum()),
    }  # fmt: skip
    table = _table(w, y, sound, missing, odd, rng)
    return WideCase(table, label, c, dict(p), tuple(terms), show, w)


def _origin(name: str) -> str:
    kinds = {"library": g.LIBRARY, "variant": g.VARIANTS, "outside": g.OUTSIDE, "drift": DRIFTS, "cluster": CLUSTERS}
    return next((k for k, v in kinds.items() if name in v), "foreign")


def _table(
    w: World, y: np.ndarray, sound: np.ndarray, missing: np.ndarray, odd: np.ndarray, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    show = w.instruments
    noise = w.noise * _deviates(w.law, y, rng) * np.array(show.sd)[:, None]
    gross = rng.choice((-1.0, 1.0), y.shape) * rng.uniform(*GROSS, y.shape) * show.stated[:, None]
    step = np.array(show.step)[:, None]
    shown = np.round((y * g._SHOWN + noise + np.where(odd, gross, 0.0)) / step) * step
    clean = g._table(w.conditions, y, np.ones(len(sound), bool), show, np.random.default_rng(0))
    clean["configuration"] = np.where(
        w.conditions.wheeled > 0.5, *(w.machine.names.get(r, "") for r in (WHEELS, TRACKS))
    )
    readings = ("total_current_A", "motor_speed_rpm", "speed_mm_s")
    deviations = ("total_current_sd_A", "motor_speed_sd_rpm", "speed_sd_mm_s")
    for k, (reading, sd) in enumerate(zip(readings, deviations, strict=True)):
        clean[reading] = np.where(missing[k], np.nan, np.round(shown[k], 6))
        clean[sd] = np.where(missing[k], np.nan, clean[sd])
        if not w.stated:
            del clean[sd]
    return {name: column[sound] for name, column in clean.items()}


def _deviates(law: str, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Noise of unit variance over all rows [sd]; y are the readings, shape (3, rows)."""
    if law == "heavy":
        return rng.standard_t(TAIL, y.shape) * np.sqrt(1 - 2 / TAIL)
    if law == "uneven":
        size = np.abs(y) / np.nanmax(np.abs(y), 1, keepdims=True)
        sd = UNEVEN[0] + (UNEVEN[1] - UNEVEN[0]) * size
        return rng.standard_normal(y.shape) * sd / np.sqrt(np.nanmean(sd**2, 1, keepdims=True))
    return rng.standard_normal(y.shape)
