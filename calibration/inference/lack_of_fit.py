"""Whether a fit is adequate: χ² where the noise is known, and structure of the residuals over the conditions.

Columns of a smooth curve are cleared of what the free parameters and their priors could take up (projected on the
complement of the whitened Jacobian J, priors included), so that what they explain of the residuals has a χ²
distribution where nothing is missing; where the noise was estimated from the same residuals, their quotient has an F
distribution (Seber and Lee, Linear Regression Analysis (2003), 4.3). Replicates, rows under the same conditions, give
a noise that holds no model error (4.4: lack of fit).
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from numpy.polynomial import legendre
from scipy import stats

from calibration.data.runs import CONDITIONS, Runs
from calibration.inference.identifiability import Identifiability
from calibration.inference.observers import Observer
from mmrjax import channels

#: Family-wise error of «not adequate».
LEVEL = 0.05
#: Terms of a curve of one variable, of one over time; fewest degrees of freedom that an F test has to leave.
TERMS, OVER_TIME, LEAST = 3, 6, 10
#: Fewest degrees of freedom of replicates.
REPLICATES = 4


@dataclasses.dataclass(frozen=True)
class Adequacy:
    """Whether a fit's residuals are what noise leaves.

    Attributes:
        adequate: None where it cannot be tested.
        chi2: misfit of the readings [σ²]; degrees_of_freedom: that the fit leaves them.
        p_value: family-wise, of all tests made; None where none could be.
        shown_by: the most telling test, in words.
        noise_known: whether χ² was among the tests.
    """

    adequate: bool | None
    chi2: float
    degrees_of_freedom: float
    p_value: float | None
    shown_by: str
    noise_known: bool

    @property
    def statement(self) -> str:
        """In one sentence; opens a calibration's output."""
        chi2 = f"χ² {self.chi2:.4g} on {self.degrees_of_freedom:.4g} degrees of freedom"
        if self.adequate is None or self.p_value is None:
            return (
                "Adequacy cannot be tested: the noise was estimated from the misfit, and "
                f"{self.degrees_of_freedom:.4g} degrees of freedom cannot show structure; state it with --noise"
            )
        p = f"p = {self.p_value:.2g}" if self.p_value > 1e-6 else "p < 1e-6"
        if not self.adequate:
            why = f"{chi2}, {p}" if self.noise_known else f"{p}, the noise estimated from them"
            return (
                f"Not adequate: {self.shown_by} ({why}), so something is missing and the parameters may stand "
                "in for it; mmrjax loop finds what"
            )
        if self.noise_known:
            return f"Adequate: the residuals are what the stated noise leaves ({chi2}, {p})"
        return (
            f"Adequate as far as can be tested: the residuals show no structure ({p}); the noise was estimated from "
            "them, so χ² tests nothing"
        )

    def to_json(self) -> dict[str, object]:
        """As in `adequate` of result.json."""
        return {**dataclasses.asdict(self), "statement": self.statement}


def adequacy(
    observe: type[Observer],
    runs: Runs,
    simulated: np.ndarray,
    sd: np.ndarray,
    z: np.ndarray,
    about: Identifiability,
    estimated: np.ndarray,
) -> Adequacy:
    """Test a fit.

    Args:
        simulated: fitted readings; sd: of the measured ones [SI], shape (rows, channels).
        z: coordinates of the fit; about: the linear analysis there.
        estimated: whether a channel's noise was estimated from the misfit, shape (channels,).
    """
    measured = runs.measured()
    there = np.isfinite(measured) & np.isfinite(simulated)
    residual = np.where(there, (simulated - measured) / sd, 0.0)
    chi2, freedom = float(np.sum(residual**2)), float(there.sum() - about.leverage[there].sum())
    known = not estimated.any()
    found: list[tuple[float, str]] = []
    clear = _Clear(about.jacobian, np.concatenate([residual.ravel(), np.asarray(z)]), freedom, chi2, known)
    families = _families(observe, runs, simulated, there)
    tested = [(clear.p_value(columns), words) for words, columns in families.items()]
    structure = [(p, w) for p, w in tested if p is not None]
    if structure:
        p, words = min(structure)
        found.append((min(1.0, p * len(structure)), words))
    for made in (_memory(observe, runs, residual, there), _replicates(observe, runs, residual, there, freedom, chi2)):
        found += [made] if made is not None else []
    if known and freedom > 0:
        found.append((float(stats.chi2.sf(chi2, freedom)), "the residuals exceed the stated noise"))
    if not found:
        return Adequacy(None, chi2, freedom, None, "", known)
    p, words = min(found)
    p = min(1.0, p * len(found))
    return Adequacy(p > LEVEL, chi2, freedom, p, words, known)


@dataclasses.dataclass(frozen=True)
class _Clear:
    """Residuals cleared of what free parameters take up.

    Attributes:
        jacobian: of the readings; residual: of the readings and then of the priors.
        freedom: that the fit leaves the readings; chi2: their misfit; known: whether their noise is.
    """

    jacobian: np.ndarray
    residual: np.ndarray
    freedom: float
    chi2: float
    known: bool

    @functools.cached_property
    def taken(self) -> np.ndarray:
        """Orthonormal directions that the free parameters take up, shape (readings + parameters, parameters)."""
        return np.asarray(np.linalg.qr(np.concatenate([self.jacobian, np.eye(self.jacobian.shape[1])]))[0])

    def p_value(self, columns: np.ndarray) -> float | None:
        """Of what columns over the readings explain, shape (readings, terms); None where too little is left."""
        wide = np.concatenate([columns, np.zeros((self.jacobian.shape[1], columns.shape[1]))])
        size = np.linalg.norm(wide, axis=0)
        wide = wide[:, size > 0] / size[size > 0]
        left = wide - self.taken @ (self.taken.T @ wide)
        directions, scale, _ = np.linalg.svd(left, full_matrices=False)
        directions = directions[:, scale > 1e-3]
        terms = directions.shape[1]
        if terms == 0 or self.freedom - terms < LEAST:
            return None
        explained = float(np.sum((directions.T @ self.residual) ** 2))
        if self.known:
            return float(stats.chi2.sf(explained, terms))
        rest = max(self.chi2 - explained, 1e-12) / (self.freedom - terms)
        return float(stats.f.sf(explained / terms / rest, terms, self.freedom - terms))


def _families(observe: type[Observer], runs: Runs, simulated: np.ndarray, there: np.ndarray) -> dict[str, np.ndarray]:
    """Columns over the readings by what they mean: for each channel, curves over each variable, by configuration."""
    variables = {c: (runs[c], TERMS) for c in CONDITIONS if runs.has(c)}
    if observe.axis:
        variables[observe.axis] = runs[observe.axis], OVER_TIME
    variables |= {
        f"the fitted {c.label}": (simulated[:, k], TERMS)
        for k, c in enumerate(channels.CHANNELS)
        if there[:, k].any()
    }
    which = runs["configuration"]
    families = {}
    for k, channel in enumerate(channels.CHANNELS):
        rows = there[:, k]
        for name, (x, terms) in variables.items():
            if rows.sum() < 2 or not np.isfinite(x[rows]).all() or np.ptp(x[rows]) == 0:
                continue
            scaled = 2 * (x - x[rows].min()) / np.ptp(x[rows]) - 1
            curve = legendre.legvander(np.nan_to_num(scaled), min(terms, len(np.unique(x[rows])) - 1))
            own = [curve * ((which == c) & rows)[:, None] for c in np.unique(which)]
            columns = np.zeros((*there.shape, sum(o.shape[1] for o in own)))
            columns[:, k] = np.concatenate(own, 1)
            families[f"the residuals of {channel.label} follow {name}"] = columns.reshape(there.size, -1)
    return families


def _memory(observe: type[Observer], runs: Runs, residual: np.ndarray, there: np.ndarray) -> tuple[float, str] | None:
    """Whether residuals of a run resemble those of the sample before, where rows of a run follow one another."""
    if not observe.axis:
        return None
    run = runs["run_id"] if runs.has("run_id") else np.zeros(len(runs), str)
    order = np.lexsort((runs[observe.axis], run))
    follows = run[order][1:] == run[order][:-1]
    found = []
    for k, channel in enumerate(channels.CHANNELS):
        e, ok = residual[order, k], there[order, k]
        both = follows & ok[1:] & ok[:-1]
        power = float(np.sum(e[ok] ** 2))
        if both.sum() >= 20 and power > 0:
            r = float(np.sum(e[1:][both] * e[:-1][both])) / power
            found.append(
                (float(stats.norm.sf(r * np.sqrt(both.sum()))), f"the residuals of {channel.label} remember")
            )
    if not found:
        return None
    p, words = min(found)
    return min(1.0, p * len(found)), f"{words} the sample before"


def _replicates(
    observe: type[Observer], runs: Runs, residual: np.ndarray, there: np.ndarray, freedom: float, chi2: float
) -> tuple[float, str] | None:
    """Whether the residuals exceed the scatter of rows under the same conditions."""
    columns = [c for c in ("configuration", *observe.axes, "surface") if runs.has(c)]
    groups: dict[tuple[str, ...], list[int]] = {}
    for row, key in enumerate(zip(*(runs[c].astype(str).tolist() for c in columns), strict=True)):
        groups.setdefault(key, []).append(row)
    pure, own = 0.0, 0
    for rows in (g for g in groups.values() if len(g) > 1):
        for k in range(there.shape[1]):
            e = residual[rows, k][there[rows, k]]
            pure += float(np.sum((e - e.mean()) ** 2)) if len(e) > 1 else 0.0
            own += max(len(e) - 1, 0)
    if own < REPLICATES or freedom - own < 1 or pure <= 0:
        return None
    quotient = max(chi2 - pure, 0.0) / (freedom - own) / (pure / own)
    return float(stats.f.sf(quotient, freedom - own, own)), "the residuals exceed the scatter of repeated runs"
