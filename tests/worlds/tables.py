"""Synthetic tables under the wide conditions of the field: any surface, any robot, poor instruments, gaps, drifts.

A `World` is what a table is measured in: a robot, true constants, conditions in the order of measuring, instruments
and their faults. `case` puts effects into it, each as strong as wanted beside the others. `coverage` draws the truth
from the analyst's priors.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from worlds import foreign, machines
from worlds.laws import CHANNELS, FORMS, LIBRARY, OUTSIDE, VARIANTS, Law, Term, draw
from worlds.machines import PAPER, ROLES, TRACKS, WHEELS, Machine
from worlds.settled import (
    SHOWN,
    TOLERANCES,
    Conditions,
    Instruments,
    Sealed,
    base_slopes,
    carried_out,
    conditions,
    perturbed,
    readings,
    remainder,
    signature,
    table8,
)  # fmt: skip

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
    """Sd of the log of a constant that the analyst knows as a scale. Configurations by any name."""
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
        p[name] *= 1 + scale * TOLERANCES[name] * float(np.clip(rng.standard_normal(), -2, 2))
    for role in m.names:
        p[f"{role}.ground.friction.static"] = float(rng.uniform(*ADHESION))
        p[f"{role}.ground.friction.speed_static"] = float(np.exp(rng.uniform(*np.log(CREEP))))
    return _followed(p)


# --- worlds -----------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class World:
    """What a table is measured in.

    Attributes:
        stratum: of STRATA.
        constants: true ones.
        conditions: in the order of measuring.
        shuffled: that order.
        outliers, missing: shares of readings.
        noise: true sd over the stated one.
        law: of NOISES.
        stated: whether the table states sds.
        z: where the truth is in the analyst's priors, where it was drawn from them.
    """

    stratum: str
    machine: Machine
    constants: Mapping[str, float]
    conditions: Conditions
    instruments: Instruments
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
        return base_slopes(self.conditions, self.constants, self.instruments, free, sds)

    @property
    def pool(self) -> tuple[str, ...]:
        """Effects of the library that this robot can have."""
        return tuple(n for n in LIBRARY if n != "mass_offset" or self.machine is PAPER)


def gripping(c: Conditions, p: dict[str, float], y: np.ndarray) -> bool:
    """Whether no row's movers roll four times as far as it travels. y are its readings, shape (3, rows)."""
    rolled = y[1] * np.where(c.wheeled > 0.5, p["4W2T.radius"], p["6T2A.radius"]) / p["gearbox.ratio"]
    return bool((y[2] > 0.25 * rolled).all())


def world(
    rng: np.random.Generator, stratum: str = "plain", *, shuffled: bool | None = None, noise: float = 1.0,
    from_priors: bool = False, law: str = "normal", stated: bool = True,
) -> World:  # fmt: skip
    """A world of a stratum, or of `few` rows (see `World` for `law` and `stated`). `from_priors`: the truth is drawn
    from the analyst's priors.

    Rows are in the order of the grid, or shuffled, as it comes, where `shuffled` does not say.
    """
    everything = stratum == "all"
    roles = {"tracks": (TRACKS,), "wheels": (WHEELS,), "both": ROLES}.get(stratum)
    if everything:
        roles = ((TRACKS,), (WHEELS,), ROLES)[rng.integers(3)]
    fault = ("quantised", "outliers", "missing")
    for _ in range(200):
        m = PAPER if roles is None else machines.machine(rng, roles)
        p, z = drawn_from_priors(rng, m) if from_priors else (surfaced(rng, m), {})
        length = ("short", "long")[rng.integers(2)] if everything else stratum
        order = bool(rng.random() < 0.5) if shuffled is None else shuffled
        c, order = _conditions(rng, m, p, length, order)
        y, sound = readings(c, p)
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
) -> tuple[Conditions, bool]:
    if length == "short":
        c = machines.grid(m, p)
        rows = rng.permutation(len(c.U))[: rng.integers(*SHORT[rng.integers(len(SHORT))], endpoint=True)]
        return c.at(rows), True
    if length == "long":
        c = machines.grid(m, p, 6)
        count = rng.integers(*LONG[rng.integers(len(LONG))], endpoint=True)
        again = rng.integers(0, len(c.U), max(count - len(c.U), 0))  # repeats
        return c.at(rng.permutation(np.concatenate([rng.permutation(len(c.U))[:count], again]))), True
    c = machines.grid(m, p)
    if length == "few":  # as in Tables A1 and A2
        c = c.at(np.flatnonzero((c.payload == 0) & (np.isin(c.U, np.unique(c.U)[[0, -1]]))))
    return (c.at(rng.permutation(len(c.U))), True) if shuffled else (c, False)


def _coarse(rng: np.random.Generator, fine: Instruments) -> Instruments:
    """Displays that show steps of several sds."""
    return Instruments(fine.sd, tuple(float(f"{sd * rng.uniform(*COARSE):.1g}") for sd in fine.sd))


# --- what depends on when a row was measured ----------------------------------------------------------

_TAU = {"tau": (0.1, 0.4)}
#: Drifts over the order of measuring, `s.order` from 0 to 1.
DRIFTS: dict[str, Law] = {
    "drift.electrical": Law("", "electrical", lambda s, q: s.I * s.order, 0.2),
    "drift.supply": Law("", "supply", lambda s, q: s.order, 0.5),
    "drift.track": Law("", "track", lambda s, q: s.order, 0.05, either=True),
    "drift.ground": Law("", "ground", lambda s, q: s.N * s.order, 0.01, either=True),
    "drift.total_current": Law("", "total_current", lambda s, q: s.order, 0.05, either=True),
    "drift.speed": Law("", "speed", lambda s, q: s.V * s.order, 0.01, either=True),
    "warming.electrical": Law("", "electrical", lambda s, q: s.I * (1 - np.exp(-s.order / q["tau"])), 0.2, _TAU),
    "warming.motor": Law("", "motor", lambda s, q: np.exp(-s.order / q["tau"]), 5e-4, _TAU),
    "warming.gearbox": Law("", "gearbox", lambda s, q: s.w_k * np.exp(-s.order / q["tau"]), 5e-3, _TAU),
    "warming.track": Law("", "track", lambda s, q: np.exp(-s.order / q["tau"]), 0.1, _TAU),
}  # fmt: skip
#: What is shifted in some of the rows, and by how much it commonly is, in the instruments' or the paper's robot's size.
SHIFTED: dict[str, float] = {
    "total_current": 0.1, "motor_speed": 3.0, "speed": 0.015, "electrical": 0.3, "track": 0.05, "slip": 0.015,
}  # fmt: skip
#: Kinds of clusters: rows that follow one another, or all rows of one condition.
CLUSTERS = tuple(f"{which}.{where}" for which in ("rows", "voltage", "slope", "payload") for where in SHIFTED)


def cluster(name: str, rng: np.random.Generator, c: Conditions) -> tuple[Term, np.ndarray]:
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
    law = Law("", where, lambda s, q: np.isin(s.row, list(hit)).astype(float), SHIFTED[where], either=True)
    return draw(name, rng, law), rows


#: Laws of which a table may have one, but clusters.
EVERY: dict[str, Law] = {**FORMS, **DRIFTS, **foreign.FOREIGN}


# --- sizes ------------------------------------------------------------------------------------------


def _signature(w: World, terms: Sequence[Term], k: int) -> np.ndarray:
    """Whitened change of all readings by the k-th of the terms, beside the others, NaN where a row is lost."""
    others = [t for j, t in enumerate(terms) if j != k]
    return signature(w.conditions, w.constants, terms, w.instruments, others)


#: Of a column of no prior, in units of its whitened size.
_FREE = 1e4


def _beside(w: World, terms: Sequence[Term], k: int, slopes: np.ndarray) -> np.ndarray:
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


def left_of(
    w: World, terms: Sequence[Term], k: int, seen: np.ndarray, slopes: np.ndarray, lost: float = 0.0
) -> float:
    """Sigmas that the k-th of the terms leaves after a refit of the constants and of the others.

    Args:
        seen: whether a reading is in the table, shape (3 rows,).
        lost: the change of a row that no longer runs.
    """
    change = np.nan_to_num(_signature(w, terms, k), nan=lost)
    if not np.isfinite(change).all():
        return np.nan
    columns = _beside(w, terms, k, slopes * seen[:, None]) * seen[:, None]
    return float(np.linalg.norm(remainder(change * seen, columns)))


def sized(
    w: World, terms: Sequence[Term], sigmas: Sequence[float], seen: np.ndarray, slopes: np.ndarray
) -> tuple[list[Term], list[float]]:
    """Terms with amplitudes at which each leaves so many sigmas after a refit of the constants and of the others, and
    how many really are. Fewer where the robot would no longer run.

    Args:
        seen: whether a reading is in the table, shape (3 rows,).
    """
    terms = [dataclasses.replace(t, amplitude=0.1 * t.law.size * float(np.sign(t.amplitude))) for t in terms]

    def left(now: Sequence[Term], k: int) -> float:
        return left_of(w, now, k, seen, slopes, np.nan)

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


def sized_alone(
    term: Term, sigmas: float, c: Conditions, p: Mapping[str, float], instruments: Instruments, slopes: np.ndarray
) -> tuple[Term, float]:
    """The term with the amplitude at which `sigmas` are left after refitting, and how many really are.

    Secant steps from a tenth of its ordinary size. Fewer sigmas come back where the robot would no longer run.
    """
    amplitude = 0.1 * term.law.size * np.sign(term.amplitude)
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


# --- cases ------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Case(Sealed):
    """One sealed table. Of effects the label holds class, balance, amplitude (`sizes`: in multiples of its ordinary size,
    for whoever leaves implausible ones out), shapes and sigmas.

    Attributes:
        conditions, constants, terms: what it was made from.
        world: too, None of the paper's robot on a stated surface.
    """

    conditions: Conditions
    constants: dict[str, float]
    terms: tuple[Term, ...]
    instruments: Instruments
    world: World | None = None

    def slopes(self) -> np.ndarray:
        """Whitened change of the readings for one sd of what the analyst knows of each constant."""
        if self.world is not None:
            return self.world.slopes()
        return base_slopes(self.conditions, self.constants, self.instruments)

    def pool(self) -> dict[str, Law]:
        """Effects of the library that its robot can have."""
        return {n: LIBRARY[n] for n in (LIBRARY if self.world is None else self.world.pool)}

    def carry_out(self, experiment: Any, seed: int) -> dict[str, np.ndarray]:
        """An experiment of the menu with the same robot: `value` and `sd` of its readings [SI], repeats averaged.

        What a robot that slides or stands still does not show is NaN.
        """
        y, sound = carried_out(experiment, self.constants, self.terms)
        if hasattr(experiment, "at"):
            one = np.full(y.shape, experiment.sd)
        else:
            shown = (self.instruments.stated / SHOWN[:, 0])[: len(experiment.channels)]
            one = np.tile(shown, len(experiment.voltage))
        sd = one / np.sqrt(experiment.repeats)
        noise = np.random.default_rng(seed).standard_normal(y.shape)
        return {"value": np.where(sound, y + sd * noise, np.nan), "sd": sd}

    def elsewhere(self, seed: int) -> dict[str, np.ndarray]:
        """As many runs again of the same robot, without faults, at conditions within those of the table."""
        rng = np.random.default_rng([78, seed])
        c = self.conditions
        n = len(c.U)
        k = rng.integers(0, n, 3 * n)
        slope, payload, U = c.slope[k].copy(), c.payload[k].copy(), rng.uniform(c.U.min(), c.U.max(), 3 * n)
        for role in np.unique(c.wheeled):  # no steeper and no heavier than that configuration went
            mine = c.wheeled[k] == role
            slope[mine] *= rng.random(mine.sum())
            payload[mine] = rng.uniform(0, c.payload[c.wheeled == role].max(), mine.sum())
        new = conditions(c.wheeled[k], U, np.degrees(slope), payload, self.constants)
        _, sound = readings(new, self.constants, self.terms)
        new = new.at(np.flatnonzero(sound)[:n])
        plain = dataclasses.replace(self.world, noise=1.0, law="normal", stated=True)
        return table_of(new, *readings(new, self.constants, self.terms), self.instruments, rng, plain)


def table_of(
    c: Conditions, y: np.ndarray, sound: np.ndarray, show: Instruments, rng: np.random.Generator,
    w: World | None = None, missing: Any = False, odd: Any = False,
) -> dict[str, np.ndarray]:  # fmt: skip
    """Columns of what the instruments show of readings y [SI], of sound rows. A world's have its noise and names.

    Args:
        missing, odd: which readings are not there, and which are gross, shape (3, rows).
    """
    law, factor, names = ("normal", 1.0, PAPER.names) if w is None else (w.law, w.noise, w.machine.names)
    noise = factor * _deviates(law, y, rng) * np.array(show.sd)[:, None]
    gross = rng.choice((-1.0, 1.0), y.shape) * rng.uniform(*GROSS, y.shape) * show.stated[:, None]
    step = np.array(show.step)[:, None]
    shown = np.round((y * SHOWN + noise + np.where(odd, gross, 0.0)) / step) * step
    table = settings(c, names)
    lost = np.broadcast_to(missing, y.shape)
    table |= {name: np.where(lost[k], np.nan, np.round(shown[k], 6)) for k, name in enumerate(READINGS)}
    if w is None or w.stated:
        table |= {n: np.where(lost[k], np.nan, round(float(show.stated[k]), 6)) for k, n in enumerate(DEVIATIONS)}
    return {name: column[sound] for name, column in table.items()}


READINGS = ("total_current_A", "motor_speed_rpm", "speed_mm_s")
DEVIATIONS = ("total_current_sd_A", "motor_speed_sd_rpm", "speed_sd_mm_s")


def settings(c: Conditions, names: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Columns of conditions, with a robot's names of its configurations."""
    return {
        "configuration": np.where(c.wheeled > 0.5, *(names.get(r, "") for r in (WHEELS, TRACKS))),
        "supply_voltage_V": c.U,
        "total_mass_kg": c.mass,
        "payload_kg": c.payload,
        "slope_deg": np.round(np.degrees(c.slope), 6),
    }


def _deviates(law: str, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Noise of unit variance over all rows [sd]. y are the readings, shape (3, rows)."""
    if law == "heavy":
        return rng.standard_t(TAIL, y.shape) * np.sqrt(1 - 2 / TAIL)
    if law == "uneven":
        size = np.abs(y) / np.nanmax(np.abs(y), 1, keepdims=True)
        sd = UNEVEN[0] + (UNEVEN[1] - UNEVEN[0]) * size
        return rng.standard_normal(y.shape) * sd / np.sqrt(np.nanmean(sd**2, 1, keepdims=True))
    return rng.standard_normal(y.shape)


def kind_of(names: Sequence[str]) -> str:
    """Where the effects of a case come from."""
    kinds = {"library": LIBRARY, "variant": VARIANTS, "outside": OUTSIDE, "drift": DRIFTS, "cluster": CLUSTERS}
    return "+".join(next((k for k, v in kinds.items() if n in v), "foreign") for n in names) or "clean"


def narrow(
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
    """One sealed case of the paper's robot on a surface that is known.

    Args:
        names: effects of `FORMS`. None makes a clean table.
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
    found = [sized_alone(draw(name, rng), sigmas, c, p, instruments, slopes) for name in names]
    terms, reached = [t for t, _ in found], [left for _, left in found]
    if compensating:
        first, second = (remainder(signature(c, p, [t], instruments), slopes) for t in terms)
        hide = -float(first @ second) / float(second @ second)
        terms[1] = dataclasses.replace(terms[1], amplitude=terms[1].amplitude * hide)
        reached[1] *= abs(hide)
    together = float(np.linalg.norm(remainder(np.nan_to_num(signature(c, p, terms, instruments)), slopes)))
    y, sound = readings(c, p, terms)
    label = {
        "schema": "mmrjax.sealed/1",
        "seed": seed,
        "kind": kind_of(names),
        "stratum": "narrow",
        "compensating": compensating,
        "effects": [t.label | {"sigmas": left} for t, left in zip(terms, reached, strict=True)],
        "sigmas_together": together,
        "constants": {n: p[n] for n in free},
        "rows_lost": int((~sound).sum()),
    }
    return Case(table_of(c, y, sound, instruments, rng), label, None, c, p, tuple(terms), instruments)


def case(
    w: World, names: Sequence[str] = (), sigmas: float | Sequence[float] = 8.0, seed: int = 0,
    *, amplitudes: Mapping[str, float] | None = None,
) -> Case:  # fmt: skip
    """One sealed table of a world.

    Args:
        names: of effects: EVERY or CLUSTERS. None makes a clean table.
        sigmas: that each leaves after a refit of the constants, with the analyst's priors, and of the others.
        seed: of shapes, signs, noise and faults.
        amplitudes: by name, in place of sizes.
    """
    rng = np.random.default_rng([77, seed])
    c, p, m = w.conditions, w.constants, w.machine
    terms, where = [], []
    for name in names:
        if name in CLUSTERS:
            term, rows = cluster(name, rng, c)
            where.append({"rows": (rows + 1).tolist()})
        else:
            term = draw(name, rng, EVERY[name])
            where.append({"variable": "order"} if name in DRIFTS else {})
        if name not in LIBRARY and name not in VARIANTS and term.law.balance not in CHANNELS:
            term = dataclasses.replace(term, law=machines.fitted_to(term.law, m))
        terms.append(term)
    share = rng.random((2, 3, len(c.U)))
    missing = share[0] < w.missing
    odd = (share[1] < w.outliers) & ~missing
    seen = (~missing & ~odd).ravel().astype(float)
    wanted = [float(sigmas)] * len(terms) if np.ndim(sigmas) == 0 else list(sigmas)
    reached: list[float] = []
    with np.errstate(all="ignore"):
        slopes = w.slopes()
        if amplitudes is not None:
            terms = [dataclasses.replace(t, amplitude=amplitudes[t.name]) for t in terms]
            reached = [left_of(w, terms, k, seen, slopes) for k in range(len(terms))]
        elif terms:
            terms, reached = sized(w, terms, wanted, seen, slopes)
        y, sound = readings(c, p, terms)
    label = {
        "schema": "mmrjax.sealed/1",
        "seed": seed,
        "kind": kind_of(names),
        "stratum": w.stratum,
        "effects": [
            t.label | {"sigmas": left, "where": place} for t, left, place in zip(terms, reached, where, strict=True)
        ],
        "constants": {m.public(n): p[n] for n in m.free},
        "z": {m.public(n): z for n, z in w.z.items()},
        **m.label(p),
        "rows": len(c.U),
        "shuffled": w.shuffled,
        "noise": w.noise,
        "law": w.law,
        "stated": w.stated,
        "outliers": [[int(r) + 1, CHANNELS[k]] for k, r in zip(*np.nonzero(odd & sound), strict=True)],
        "missing": int((missing & sound).sum()),
        "rows_lost": int((~sound).sum()),
    }
    table = table_of(c, y, sound, w.instruments, rng, w, missing, odd)
    return Case(table, label, m.toml, c, dict(p), tuple(terms), w.instruments, w)


def oracle(case: Case) -> list[dict]:
    """For each effect of a case: library effects that noise-free data could not tell from it, and what the best
    one in its place would leave [σ]."""
    c, p, show = case.conditions, case.constants, case.instruments
    slopes, units = case.slopes(), {}
    for name, law in case.pool().items():
        for shapes in law.grid():
            sign = signature(c, p, [Term(name, 0.02 * law.size, shapes)], show)
            left = remainder(np.nan_to_num(sign), slopes)
            norm = np.linalg.norm(left)
            if norm > 1e-9:
                units.setdefault(name, []).append(left / norm)
    answers = []
    for term in case.terms:
        left = remainder(np.nan_to_num(signature(c, p, [term], show)), slopes)
        size, apart = float(np.linalg.norm(left)), {}
        for name, law in case.pool().items():
            along = [float(left @ u) for u in units.get(name, []) if law.either or left @ u >= 0]
            apart[name] = min((float(np.sqrt(max(size**2 - x**2, 0.0))) for x in along), default=size)
        answers.append(told_apart(apart, size, term.law.cls))
    return answers


def told_apart(apart: Mapping[str, float], size: float, cls: str) -> dict[str, Any]:
    """Of what each library effect would leave of a term [σ]: those as good as it, and the best that is not its own."""
    others = {n: d for n, d in apart.items() if n != cls}
    return {
        "class_oracle": [n for n, d in apart.items() if d < max(2.0, np.sqrt(1 - 0.95**2) * size)],
        "best_other": min(others.values(), default=size),
        "mimic": min(others, key=others.__getitem__, default=""),
    }
