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
from scipy.special import chdtrc, fdtrc, ndtr

from calibration.data.courses import courses
from calibration.data.runs import DUTY, Runs
from calibration.described import described
from calibration.inference.fit_notes import Shown
from calibration.inference.observers import Observer
from calibration.inference.simulation_errors import share_of_measured

#: Family-wise error of «not adequate».
LEVEL = 0.05
#: Terms of a curve of one variable, of one over time; fewest degrees of freedom that an F test has to leave.
TERMS, OVER_TIME, LEAST = 3, 6, 10
#: Share of a column that free parameters have to leave for it to be a direction of its own.
CLEAR = 1e-3
#: Fewest degrees of freedom of replicates.
REPLICATES = 4
#: Share of a channel's measured rms that a model which describes the runs misses at most; residuals up to so many
#: stated sds are noise, whatever their size.
UNDESCRIBED, EXPLAINED = 0.25, 1.5
#: Rise of χ² over that of the file as stated which rounding and the search for the noise leave [σ²].
WORSE = 1.0


@dataclasses.dataclass(frozen=True)
class Miss:
    """Error of a channel over its measured rms [-]: of the fit, and of the robot's file as stated.

    Attributes:
        large: whether it is larger than noise that is stated, and than `UNDESCRIBED`.
    """

    channel: str
    fitted: float
    as_stated: float
    large: bool


@dataclasses.dataclass(frozen=True)
class Adequacy:
    """Whether a fit's residuals are what noise leaves.

    Attributes:
        adequate: None where it cannot be tested, or the search did not converge.
        chi2: misfit of the readings [σ²]; degrees_of_freedom: that the fit leaves them.
        p_value: family-wise, of all tests made; None where none could be.
        shown_by: the most telling test.
        noise_known: whether χ² was among the tests.
        obstacle: why no test of residuals decides: the model is `undescribed`, the search `not converged`, or the fit
            `worse` than the file as stated by the same sds; "" where a test does.
        misses: of each channel.
    """

    adequate: bool | None
    chi2: float
    degrees_of_freedom: float
    p_value: float | None
    shown_by: Shown
    noise_known: bool
    obstacle: str = ""
    misses: tuple[Miss, ...] = ()

    @property
    def statement(self) -> str:
        """In one sentence; opens a calibration's output."""
        return described(self)

    def to_json(self) -> dict[str, object]:
        """As in `adequate` of result.json."""
        return {
            **dataclasses.asdict(self),
            "shown_by": described(self.shown_by),
            "statement": self.statement,
        }


@dataclasses.dataclass(frozen=True)
class Residuals:
    """What a fit leaves.

    Attributes:
        observe: kind of the runs.
        simulated: fitted readings [SI]; whitened: simulated less measured, in sds, 0 where a reading does not count;
            counts: whether it does; shape (rows, channels).
        jacobian: of the whitened readings, row by row, shape (rows · channels, parameters).
        z: coordinates of the fit, shape (parameters,).
    """

    observe: type[Observer]
    runs: Runs
    simulated: np.ndarray
    whitened: np.ndarray
    counts: np.ndarray
    jacobian: np.ndarray
    z: np.ndarray

    @functools.cached_property
    def taken(self) -> np.ndarray:
        """Orthonormal directions that the free parameters take up, shape (readings + parameters, parameters)."""
        return np.asarray(np.linalg.qr(np.concatenate([self.jacobian, np.eye(self.jacobian.shape[1])]))[0])

    @property
    def freedom(self) -> np.ndarray:
        """Degrees of freedom that the fit leaves each channel, shape (channels,)."""
        leverage = np.sum(self.taken[: self.counts.size] ** 2, 1).reshape(self.counts.shape)
        return np.sum(np.where(self.counts, 1.0 - leverage, 0.0), 0)

    @property
    def chi2(self) -> np.ndarray:
        """Misfit of each channel [σ²], shape (channels,)."""
        return np.sum(self.whitened**2, 0)

    def misses(self, as_stated: np.ndarray, stated: np.ndarray) -> tuple[Miss, ...]:
        """Errors over the measured rms of each channel with readings.

        Args:
            as_stated: readings of the robot's file before any fit [SI], shape (rows, channels).
            stated: whether the noise of a channel is, shape (channels,).
        """
        counts = self.counts & np.isfinite(as_stated)
        measured = np.where(counts, self.runs.measured(), np.nan)
        fitted, before = (share_of_measured(x, measured) for x in (self.simulated, as_stated))
        sigma = np.sqrt(self.chi2 / np.maximum(self.counts.sum(0), 1))
        large = (fitted > UNDESCRIBED) & ~(stated & (sigma <= EXPLAINED))
        return tuple(
            Miss(c.name, float(fitted[k]), float(before[k]), bool(large[k]))
            for k, c in enumerate(self.runs.channels)
            if np.isfinite(fitted[k])
        )

    def rescaled(self) -> Residuals:
        """The same with each channel's sds as its own misfit says."""
        factor = np.sqrt(np.maximum(self.chi2, 1e-300) / np.maximum(self.freedom, 1e-9))
        factor = np.where(self.counts.any(0) & (self.freedom > 0), factor, 1.0)
        whitened = self.whitened / factor
        jacobian = (self.jacobian.reshape(*self.counts.shape, -1) / factor[:, None]).reshape(self.jacobian.shape)
        return dataclasses.replace(self, whitened=whitened, jacobian=jacobian)


def judged(
    fit: Residuals, as_stated: np.ndarray, sd: np.ndarray, *, estimated: np.ndarray, converged: bool
) -> Adequacy:
    """Tests of a fit: meaningful where the model describes the runs, the search converged, and the fit is
    no worse than the file of the robot.

    A fit minimises χ² and the distance to the priors, so with the same sds its χ² cannot be above that at the prior
    means.

    Args:
        as_stated: readings of the file as stated [SI]; sd: of the readings [SI]; shape (rows, channels).
        estimated: whether a channel's noise was, from the misfit, shape (channels,).
        converged: whether the search was.
    """
    misses = fit.misses(as_stated, ~estimated)
    found = adequacy(fit, known=not estimated.any())
    both = fit.counts & np.isfinite(as_stated)
    before = np.sum(((as_stated - fit.runs.measured()) / sd) ** 2, where=both)
    obstacle = (
        "undescribed" if any(m.large for m in misses)
        else "not converged" if not converged
        else "worse" if np.sum(fit.whitened**2, where=both) > before + WORSE
        else ""
    )  # fmt: skip
    adequate = found.adequate if not obstacle else None if obstacle == "not converged" else False
    return dataclasses.replace(found, adequate=adequate, obstacle=obstacle, misses=misses)


def adequacy(fit: Residuals, *, known: bool) -> Adequacy:
    """Tests of a fit's residuals.

    Args:
        known: whether the noise of every channel is, and was not estimated from the misfit.
    """
    chi2, freedom = float(fit.chi2.sum()), float(fit.freedom.sum())
    found = structure(fit, known=known)
    if known and freedom > 0:
        found.append((float(chdtrc(freedom, chi2)), Shown(what="stated")))
    if not found:
        return Adequacy(None, chi2, freedom, None, Shown(), known)
    p, shown = min(found)
    p = min(1.0, p * len(found))
    return Adequacy(p > LEVEL, chi2, freedom, p, shown, known)


def structure(fit: Residuals, *, known: bool) -> list[tuple[float, Shown]]:
    """Tests of structure, each p-value with what it shows: curves over the conditions, memory, replicates."""
    families = {shown: _p_value(fit, columns, known) for shown, columns in _families(fit).items()}
    tested = [(p, shown) for shown, p in families.items() if p is not None]
    found = []
    if tested:
        p, shown = min(tested)
        found.append((min(1.0, p * len(tested)), shown))
    return [*found, *(made for made in (_memory(fit), _replicates(fit)) if made is not None)]


def _p_value(fit: Residuals, columns: np.ndarray, known: bool) -> float | None:
    """Of what columns over the readings explain, shape (readings, terms); None where too little is left."""
    parameters = fit.jacobian.shape[1]
    wide = np.concatenate([columns, np.zeros((parameters, columns.shape[1]))])
    size = np.linalg.norm(wide, axis=0)
    wide = wide[:, size > 0] / size[size > 0]
    left = wide - fit.taken @ (fit.taken.T @ wide)
    directions, scale, _ = np.linalg.svd(left, full_matrices=False)
    directions = directions[:, scale > CLEAR]
    terms, freedom = directions.shape[1], float(fit.freedom.sum())
    if terms == 0 or freedom - terms < LEAST:
        return None
    explained = float(np.sum((directions.T @ np.concatenate([fit.whitened.ravel(), fit.z])) ** 2))
    if known:
        return float(chdtrc(terms, explained))
    rest = max(float(fit.chi2.sum()) - explained, 1e-12) / (freedom - terms)
    return float(fdtrc(terms, freedom - terms, explained / terms / rest))


def _families(fit: Residuals) -> dict[Shown, np.ndarray]:
    """Columns over the readings by what they show: for each channel, curves over each variable, by configuration."""
    observe, runs, simulated, counts = fit.observe, fit.runs, fit.simulated, fit.counts
    variables = {c: (runs[c], TERMS) for c in (*runs.axes, *DUTY) if runs.has(c)}
    if observe.axis:
        variables[observe.axis] = runs[observe.axis], OVER_TIME
    if runs.has("order"):
        variables["the order of the runs"] = runs["order"], OVER_TIME
    variables |= {
        f"the fitted {c.label}": (simulated[:, k], TERMS)
        for k, c in enumerate(fit.runs.channels)
        if counts[:, k].any()
    }
    which = runs["configuration"]
    families = {}
    for k, channel in enumerate(fit.runs.channels):
        rows = counts[:, k]
        for name, (x, terms) in variables.items():
            if rows.sum() < 2 or not np.isfinite(x[rows]).all() or np.ptp(x[rows]) == 0:
                continue
            scaled = 2 * (x - x[rows].min()) / np.ptp(x[rows]) - 1
            curve = legendre.legvander(np.nan_to_num(scaled), min(terms, len(np.unique(x[rows])) - 1))
            own = [curve * ((which == c) & rows)[:, None] for c in np.unique(which)]
            columns = np.zeros((*counts.shape, sum(o.shape[1] for o in own)))
            columns[:, k] = np.concatenate(own, 1)
            families[Shown(channel.name, "follow", name)] = columns.reshape(counts.size, -1)
    return families


def _memory(fit: Residuals) -> tuple[float, Shown] | None:
    """Whether residuals of a run resemble those of the sample before, where rows of a run follow one another."""
    observe, runs, residual, counts = fit.observe, fit.runs, fit.whitened, fit.counts
    if not observe.axis:
        return None
    run = runs.run_names
    order = np.lexsort((runs[observe.axis], run))
    follows = run[order][1:] == run[order][:-1]
    found = []
    for k, channel in enumerate(fit.runs.channels):
        e, ok = residual[order, k], counts[order, k]
        both = follows & ok[1:] & ok[:-1]
        power = float(np.sum(e[ok] ** 2))
        if both.sum() >= 20 and power > 0:
            r = float(np.sum(e[1:][both] * e[:-1][both])) / power
            found.append((float(ndtr(-r * np.sqrt(both.sum()))), Shown(channel.name, "remember")))
    if not found:
        return None
    p, shown = min(found)
    return min(1.0, p * len(found)), shown


def _replicates(fit: Residuals) -> tuple[float, Shown] | None:
    """Whether the residuals exceed the scatter of rows under the same conditions."""
    observe, runs, residual, counts = fit.observe, fit.runs, fit.whitened, fit.counts
    freedom, chi2 = float(fit.freedom.sum()), float(fit.chi2.sum())
    columns = [c for c in ("configuration", *observe.axes_of(runs), "surface") if runs.has(c)]
    groups: dict[tuple[str, ...], list[int]] = {}
    past = courses(runs).tolist()  # what a run met before counts too
    for row, key in enumerate(zip(past, *(runs[c].astype(str).tolist() for c in columns), strict=True)):
        groups.setdefault(key, []).append(row)
    pure, own = 0.0, 0
    for rows in (g for g in groups.values() if len(g) > 1):
        for k in range(counts.shape[1]):
            e = residual[rows, k][counts[rows, k]]
            pure += float(np.sum((e - e.mean()) ** 2)) if len(e) > 1 else 0.0
            own += max(len(e) - 1, 0)
    if own < REPLICATES or freedom - own < 1 or pure <= 0:
        return None
    quotient = max(chi2 - pure, 0.0) / (freedom - own) / (pure / own)
    return float(fdtrc(freedom - own, own, quotient)), Shown(what="repeats")
