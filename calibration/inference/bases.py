"""Bases of smooth curves over the rows, with which a discrepancy that no effect explains is looked for."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.polynomial import legendre

from calibration.inference.linearization import PROBED

#: Balances that carry curves: one for each equation that the channels close, and the ground's, whose defect
#: also loads the contact; and those for which they stand, as what these lack has the same shape in them.
BALANCES = ("electrical", "track", "ground", "slip")
STANDS_FOR = {"electrical": ("supply",), "track": ("gearbox", "motor")}
#: Variables of a curve, fields of `Signals` (and the time of histories), with the column that measures each.
VARIABLES = {
    "voltage": "supply_voltage_V",
    "current": "total_current_A",
    "speed_motor": "motor_speed_rpm",
    "slope": "slope_deg",
    "payload": "payload_kg",
    "speed": "speed_mm_s",
    "time": "time_s",
}
#: Terms of a curve of one variable (Legendre polynomials), and degree of the polynomial in all conditions.
TERMS, DEGREE = 5, 2
CONDITIONS = "conditions"
#: Waves of histories: per turn of the driving pulley or wheel, and whether of the belt (168 teeth, 24 grousers
#: around a pulley of 48 teeth).
ORDERS: dict[str, tuple[float, bool]] = {
    "order 1 of the driving shaft": (1.0, False),
    "order 2 of the driving shaft": (2.0, False),
    "order 3 of the driving shaft": (3.0, False),
    "order 1 of the belt": (48 / 168, True),
    "order 2 of the belt": (96 / 168, True),
    "order of the grousers": (24 * 48 / 168, True),
    "order of the teeth": (48.0, True),
}
#: Largest angle of a wave between knots [rad]: two and a half a period.
RESOLVED = 2.5


class Basis(eqx.Module):
    """Families of smooth curves: a defect of one balance as a combination of columns over the rows.

    All families of one `Basis` have as many columns.

    Attributes:
        columns: of each family, shape (families, rows, terms).
        balance: index into PROBED of each family.
        names: (balance, variable) of each family.
    """

    columns: Float[Array, "families rows terms"]
    balance: tuple[int, ...] = eqx.field(static=True)
    names: tuple[tuple[str, str], ...] = eqx.field(static=True)


Bases = tuple[Basis, ...]


def scaled(x: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """x mapped linearly so that the rows that count span -1 to 1; zeros where it does not vary."""
    there = x[weight > 0]
    low, high = there.min(), there.max()
    return np.clip((2 * x - low - high) / (high - low), -1, 1) if high - low > 1e-9 * max(abs(high), 1e-9) else 0 * x


def families(columns: Mapping[str, np.ndarray], weight: np.ndarray) -> Bases:
    """Curves of one variable, and polynomials in all conditions for each configuration, in every balance.

    Args:
        columns: of the table, with fitted readings; weight: 0 for rows that do not count, shape (rows,).
    """
    names, bases = [], []
    for variable, column in VARIABLES.items():
        if column not in columns:
            continue
        basis = legendre.legvander(scaled(columns[column], weight), TERMS - 1) * np.exp(-0.35 * np.arange(TERMS))
        for balance in BALANCES:
            names.append((balance, variable))
            bases.append(basis)
    axes = [scaled(columns[c], weight) for c in ("supply_voltage_V", "slope_deg", "payload_kg")]
    powers = [p for p in itertools.product(range(DEGREE + 1), repeat=len(axes)) if sum(p) <= DEGREE]
    terms = [
        np.prod([a**k for a, k in zip(axes, p, strict=True)], 0) * (columns["configuration"] == name)
        for name in np.unique(columns["configuration"])
        for p in powers
    ]
    wide = np.stack(terms, 1)
    groups = [(names, bases), ([(b, CONDITIONS) for b in BALANCES], [wide] * len(BALANCES))]
    return tuple(
        Basis(jnp.asarray(np.stack(b)), tuple(PROBED.index(n[0]) for n in ns), tuple(ns)) for ns, b in groups if ns
    )


def waves(on_tracks: np.ndarray, angle: np.ndarray, rows: np.ndarray, knots: np.ndarray) -> Bases:
    """Waves of the orders that the samples of histories resolve, in every balance.

    A wave has its own amplitude and phase in each run: how the parts stood at its start is not known.

    Args:
        on_tracks: whether each row's run is on tracks; angle: of the driving shaft [rad]; shape (rows,).
        rows: indices of each run's rows in the order of time, -1 beyond its last, shape (runs, samples).
        knots: rows between which a defect is linear, shape (runs, knots).
    """
    bases, words = [], []
    for word, (order, belted) in ORDERS.items():
        wave = np.zeros((len(angle), 2 * len(rows)))
        for k, row in enumerate(rows):
            mine = row[row >= 0]
            if len(mine) < 8 or (belted and not on_tracks[mine[0]]):
                continue
            turned = order * angle[mine]
            step = np.diff(order * angle[knots[k]])
            if turned[-1] - turned[0] < 4 * np.pi or np.median(step[step > 0]) > RESOLVED:
                continue
            wave[mine, 2 * k], wave[mine, 2 * k + 1] = np.cos(turned), np.sin(turned)
        if wave.any():
            bases.append(wave)
            words.append(word)
    if not words:
        return ()
    every = [(b, w) for b in BALANCES for w in words]
    whole = jnp.asarray(np.stack(bases * len(BALANCES)))
    return (Basis(whole, tuple(PROBED.index(b) for b, _ in every), tuple(every)),)


def names(bases: Bases) -> tuple[tuple[str, str], ...]:
    """(balance, variable) of every family, in order."""
    return tuple(n for basis in bases for n in basis.names)
