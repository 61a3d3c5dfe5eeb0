"""Adequacy tests of a fit: χ² if the noise is known, and structure of the residuals over the conditions.

Columns of a smooth curve are projected on the complement of the whitened Jacobian J, priors included, which removes
the part that free parameters could take up. Without a lack of fit, the decrease of χ² that they explain then has a χ²
distribution. If the noise was estimated from the same residuals, its quotient has an F distribution (Seber and Lee,
Linear Regression Analysis (2003), 4.3). Replicates, rows under the same conditions, give an estimate of the noise
without model error (4.4: lack of fit).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy.polynomial import legendre
from scipy.special import chdtr, chdtrc, fdtrc, ndtr

from calibration.data.clock import course_of_each_row
from calibration.data.runs import DUTY, Runs
from calibration.described import describe
from calibration.inference.fit_notes import AdequacyFinding, Remark
from calibration.inference.observers import Observer
from calibration.inference.series_noise import rows_by_key
from calibration.inference.simulation_errors import share_of_measured

#: Family-wise error of «not adequate».
LEVEL = 0.05
#: Terms of a curve of one variable, of one over time; fewest degrees of freedom that an F test has to leave.
TERMS, OVER_TIME, LEAST = 3, 6, 10
#: Share of a column that must remain after the free parameters for it to count as a direction of its own.
CLEAR = 1e-3
#: Fewest degrees of freedom of replicates.
REPLICATES = 4
#: Largest error, as a share of a channel's measured rms, of a model that describes the runs; residuals up to this
#: many stated sds are noise, whatever their size.
UNDESCRIBED, EXPLAINED = 0.25, 1.5
#: Rise of χ² over that of the file as stated that rounding and the search for the noise can cause [σ²].
WORSE = 1.0


@dataclasses.dataclass(frozen=True)
class RelativeError:
    """Error of a channel divided by its measured rms [-], for the fit and for the robot file as given.

    Attributes:
        large: True if the error of the fit exceeds the stated noise and `UNDESCRIBED`.
    """

    channel: str
    fitted: float
    as_stated: float
    large: bool


@dataclasses.dataclass(frozen=True)
class Adequacy:
    """Result of the tests of whether residuals are consistent with noise.

    Attributes:
        adequate: True or False. None if it cannot be tested, or if the search did not converge.
        chi2: misfit of the readings [σ²].
        degrees_of_freedom: degrees of freedom of the residuals.
        p_value: family-wise p-value of all tests, None without tests.
        shown_by: finding of the test with the smallest p-value.
        noise_known: True if χ² was among the tests.
        obstacle: reason why no test of residuals decides. `undescribed`: the model does not describe the runs. `not
            converged`: the search did not end. `worse`: the fit is worse than the robot file with the same sds. "" if
            a test decides.
        misses: relative error of each channel.
    """

    adequate: bool | None
    chi2: float
    degrees_of_freedom: float
    p_value: float | None
    shown_by: AdequacyFinding
    noise_known: bool
    obstacle: str = ""
    misses: tuple[RelativeError, ...] = ()

    @property
    def statement(self) -> str:
        """The verdict in one sentence, the first of a calibration's output."""
        return describe(self)

    def to_json(self) -> dict[str, object]:
        """Entries of `adequate` in result.json."""
        return {**vars(self), "shown_by": describe(self.shown_by), "statement": self.statement}


@dataclasses.dataclass(frozen=True)
class Residuals:
    """Residuals of a fit and what is needed to test them.

    Attributes:
        observe: observer of the runs.
        simulated: fitted readings [SI], shape (rows, channels).
        whitened: simulated minus measured readings, in sds, 0 if excluded, shape (rows, channels).
        counts: True for included readings, shape (rows, channels).
        jacobian: Jacobian of the whitened readings, row by row, shape (rows · channels, parameters).
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
    def absorbed(self) -> np.ndarray:
        """Orthonormal directions in which the free parameters absorb residuals, shape (readings + parameters,
        parameters).
        """
        return np.asarray(np.linalg.qr(np.concatenate([self.jacobian, np.eye(self.jacobian.shape[1])]))[0])

    @property
    def freedom(self) -> np.ndarray:
        """Degrees of freedom that the fit leaves in each channel, shape (channels,)."""
        leverage = np.sum(self.absorbed[: self.counts.size] ** 2, 1).reshape(self.counts.shape)
        return np.sum(np.where(self.counts, 1.0 - leverage, 0.0), 0)

    @property
    def chi2(self) -> np.ndarray:
        """Misfit of each channel [σ²], shape (channels,)."""
        return np.sum(self.whitened**2, 0)

    def misses(self, as_stated: np.ndarray, stated: np.ndarray) -> tuple[RelativeError, ...]:
        """Error of each channel with readings, relative to its measured rms.

        Args:
            as_stated: readings of the robot file before any fit [SI], shape (rows, channels).
            stated: True for channels with stated noise, shape (channels,).
        """
        counts = self.counts & np.isfinite(as_stated)
        measured = np.where(counts, self.runs.measured(), np.nan)
        relative_errors, relative_errors_as_stated = (
            share_of_measured(x, measured) for x in (self.simulated, as_stated)
        )
        sigma = np.sqrt(self.chi2 / np.maximum(self.counts.sum(0), 1))
        large = (relative_errors > UNDESCRIBED) & ~(stated & (sigma <= EXPLAINED))
        return tuple(
            RelativeError(c.name, float(relative_errors[k]), float(relative_errors_as_stated[k]), bool(large[k]))
            for k, c in enumerate(self.runs.channels)
            if np.isfinite(relative_errors[k])
        )

    def rescaled(self) -> Residuals:
        """Residuals in units of each channel's own scatter, instead of the stated sds."""
        factor = np.sqrt(np.maximum(self.chi2, 1e-300) / np.maximum(self.freedom, 1e-9))
        factor = np.where(self.counts.any(0) & (self.freedom > 0), factor, 1.0)
        whitened = self.whitened / factor
        jacobian = (self.jacobian.reshape(*self.counts.shape, -1) / factor[:, None]).reshape(self.jacobian.shape)
        return dataclasses.replace(self, whitened=whitened, jacobian=jacobian)


def judge_adequacy(
    fit: Residuals, as_stated: np.ndarray, sd: np.ndarray, *, estimated: np.ndarray, converged: bool
) -> Adequacy:
    """Adequacy of a fit. It first checks for obstacles that make tests of the residuals meaningless.

    A fit minimises χ² plus the distance from the priors. With the same sds, its χ² is therefore not above that of the
    robot at its prior means.

    Args:
        as_stated: readings of the robot file before any fit [SI].
        sd: standard deviation of the readings [SI], shape (rows, channels).
        estimated: True for channels whose noise is estimated from the misfit, shape (channels,).
        converged: True if the search converged.
    """
    misses = fit.misses(as_stated, ~estimated)
    adequacy = adequacy_of_residuals(fit, noise_known=not estimated.any())
    is_compared = fit.counts & np.isfinite(as_stated)
    chi2_as_stated = np.sum(((as_stated - fit.runs.measured()) / sd) ** 2, where=is_compared)
    obstacle = (
        "undescribed" if any(m.large for m in misses)
        else "not converged" if not converged
        else "worse" if np.sum(fit.whitened**2, where=is_compared) > chi2_as_stated + WORSE
        else ""
    )  # fmt: skip
    adequate = adequacy.adequate if not obstacle else None if obstacle == "not converged" else False
    return dataclasses.replace(adequacy, adequate=adequate, obstacle=obstacle, misses=misses)


def adequacy_of_residuals(fit: Residuals, *, noise_known: bool) -> Adequacy:
    """Tests if the residuals of a fit are consistent with noise.

    Args:
        known: True if the noise of every channel is known and not estimated from the misfit.
    """
    chi2, freedom = float(fit.chi2.sum()), float(fit.freedom.sum())
    tests = structure_tests(fit, noise_known=noise_known)
    if noise_known and freedom > 0:
        tests.append((float(chdtrc(freedom, chi2)), AdequacyFinding(what="stated")))
    if not (strongest := _strongest_test(tests)):
        return Adequacy(None, chi2, freedom, None, AdequacyFinding(), noise_known)
    (p, finding) = strongest[0]
    return Adequacy(p > LEVEL, chi2, freedom, p, finding, noise_known)


def _strongest_test(tests: list[tuple[float, AdequacyFinding]]) -> list[tuple[float, AdequacyFinding]]:
    """Test with the smallest p-value, multiplied by their number (Bonferroni). Empty without tests."""
    return [(min(1.0, p * len(tests)), finding) for p, finding in sorted(tests)[:1]]


def structure_tests(fit: Residuals, *, noise_known: bool) -> list[tuple[float, AdequacyFinding]]:
    """Tests for structure in the residuals: over the conditions, in time, and against replicates. Each has a p-value
    and a finding.
    """
    families = {
        finding: _p_value_of_columns(fit, columns, noise_known) for finding, columns in _curve_columns(fit).items()
    }
    curves = [(p, finding) for finding, p in families.items() if p is not None]
    return [*_strongest_test(curves), *_strongest_test(_autocorrelation_tests(fit)), *_replicate_test(fit)]


def _p_value_of_columns(fit: Residuals, columns: np.ndarray, noise_known: bool) -> float | None:
    """p-value of the misfit that the columns, shape (readings, terms), explain. None if too few degrees of freedom
    remain.
    """
    parameters = fit.jacobian.shape[1]
    padded_columns = np.concatenate([columns, np.zeros((parameters, columns.shape[1]))])
    size = np.linalg.norm(padded_columns, axis=0)
    padded_columns = padded_columns[:, size > 0] / size[size > 0]
    projected = padded_columns - fit.absorbed @ (fit.absorbed.T @ padded_columns)
    directions, singular_values, _ = np.linalg.svd(projected, full_matrices=False)
    directions = directions[:, singular_values > CLEAR]
    terms = directions.shape[1]
    freedom = float(fit.freedom.sum())
    if terms == 0 or freedom - terms < LEAST:
        return None
    explained = float(np.sum((directions.T @ np.concatenate([fit.whitened.ravel(), fit.z])) ** 2))
    if noise_known:
        return float(chdtrc(terms, explained))
    unexplained = max(float(fit.chi2.sum()) - explained, 1e-12) / (freedom - terms)
    return float(fdtrc(terms, freedom - terms, explained / terms / unexplained))


def _curve_columns(fit: Residuals) -> dict[AdequacyFinding, np.ndarray]:
    """Finding → columns over the readings: for each channel and variable, curves over the variable by
    configuration.
    """
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
    configuration = runs["configuration"]
    families = {}
    for k, channel in enumerate(fit.runs.channels):
        rows = counts[:, k]
        for name, (x, terms) in variables.items():
            if rows.sum() < 2 or not np.isfinite(x[rows]).all() or np.ptp(x[rows]) == 0:
                continue
            scaled = 2 * (x - x[rows].min()) / np.ptp(x[rows]) - 1
            curve = legendre.legvander(np.nan_to_num(scaled), min(terms, len(np.unique(x[rows])) - 1))
            configuration_curves = [curve * ((configuration == c) & rows)[:, None] for c in np.unique(configuration)]
            columns = np.zeros((*counts.shape, sum(curves.shape[1] for curves in configuration_curves)))
            columns[:, k] = np.concatenate(configuration_curves, 1)
            families[AdequacyFinding(channel.name, "follow", name)] = columns.reshape(counts.size, -1)
    return families


def _autocorrelation_tests(fit: Residuals) -> list[tuple[float, AdequacyFinding]]:
    """Tests for autocorrelation at lag 1 within runs. Empty if the rows of a run have no order."""
    observe, runs, residual, counts = fit.observe, fit.runs, fit.whitened, fit.counts
    if not observe.axis:
        return []
    run_names = runs.run_names
    order = np.lexsort((runs[observe.axis], run_names))
    is_same_run = run_names[order][1:] == run_names[order][:-1]
    tests = []
    for k, channel in enumerate(fit.runs.channels):
        residuals_of_channel, is_included = residual[order, k], counts[order, k]
        is_consecutive = is_same_run & is_included[1:] & is_included[:-1]
        power = float(np.sum(residuals_of_channel[is_included] ** 2))
        if is_consecutive.sum() >= 20 and power > 0:
            autocorrelation = (
                float(np.sum(residuals_of_channel[1:][is_consecutive] * residuals_of_channel[:-1][is_consecutive]))
                / power
            )
            tests.append(
                (
                    float(ndtr(-autocorrelation * np.sqrt(is_consecutive.sum()))),
                    AdequacyFinding(channel.name, "remember"),
                )
            )
    return tests


def _replicate_test(fit: Residuals) -> list[tuple[float, AdequacyFinding]]:
    """Tests the residuals against the scatter of rows under the same conditions. Empty if there are too few
    replicates.
    """
    observe, runs, residual, counts = fit.observe, fit.runs, fit.whitened, fit.counts
    freedom, chi2 = float(fit.freedom.sum()), float(fit.chi2.sum())
    columns = [c for c in ("configuration", *observe.axes_of(runs), "surface") if runs.has(c)]
    courses = course_of_each_row(runs).tolist()  # replicates share their past too
    groups = rows_by_key(zip(courses, *(runs[c].astype(str).tolist() for c in columns), strict=True))
    replicate_chi2, replicate_freedom = 0.0, 0
    for rows in (g for g in groups.values() if len(g) > 1):
        for k in range(counts.shape[1]):
            replicates = residual[rows, k][counts[rows, k]]
            replicate_chi2 += float(np.sum((replicates - replicates.mean()) ** 2)) if len(replicates) > 1 else 0.0
            replicate_freedom += max(len(replicates) - 1, 0)
    if replicate_freedom < REPLICATES or freedom - replicate_freedom < 1 or replicate_chi2 <= 0:
        return []
    variance_ratio = (
        max(chi2 - replicate_chi2, 0.0) / (freedom - replicate_freedom) / (replicate_chi2 / replicate_freedom)
    )
    return [
        (
            float(fdtrc(freedom - replicate_freedom, replicate_freedom, variance_ratio)),
            AdequacyFinding(what="repeats"),
        )
    ]


# --- stated sds -----------------------------------------------------------------------------------------


#: Factor on the sds, in either direction, above which a note reports it; p-value under correct sds below which it
#: does.
OFF, IMPROBABLE = 1.25, 0.001
#: Significance of structure that refutes a common factor of all channels.
BEYOND_DOUBT = 0.005
#: Fewest degrees of freedom of a channel for a test of structure.
FEWEST = 30
#: Sds of chance by which a variance exceeds 1.
CHANCE = 3.0
#: Largest ratio of the factors of channels, squared, for one common factor.
ALIKE = 1.3


def noise_factors(fit: Residuals, level: float = LEVEL) -> dict[str, float]:
    """Ratio of the residuals of each channel to its sds, if it differs significantly from 1. Empty if they have
    structure.

    Structure is tested with sds estimated from the misfit, so that the result does not depend on the stated sds.

    Args:
        level: family-wise significance level of that test.
    """
    tests = structure_tests(fit.rescaled(), noise_known=False)
    if tests and min(p for p, _ in tests) * len(tests) < level:
        return {}
    factors = {}
    for channel, chi2, freedom in zip(fit.runs.channels, fit.chi2.tolist(), fit.freedom.tolist(), strict=True):
        if freedom < 1 or chi2 <= 0:
            continue
        factor = float(np.sqrt(chi2 / freedom))
        p = chdtrc(freedom, chi2) if factor > 1 else chdtr(freedom, chi2)
        if max(factor, 1 / factor) > OFF and p < IMPROBABLE:
            factors[channel.name] = factor
    return factors


def common_factors(fit: Residuals) -> dict[str, float]:
    """The `noise_factors`, if every channel has the same factor. Otherwise, or with too few readings, empty.

    A model error affects some channels more than others. So a factor that is common to all channels is rejected only
    by highly significant structure.
    """
    factors = noise_factors(fit, BEYOND_DOUBT)
    enough = bool(np.all(fit.freedom[fit.counts.any(0)] >= FEWEST))
    return factors if enough and _is_common_factor(fit, factors) else {}


def _is_common_factor(fit: Residuals, factors: dict[str, float]) -> bool:
    """True if every measured channel has a factor and the factors agree."""
    count = int(fit.counts.any(0).sum())
    return len(factors) == count > 1 and max(factors.values()) < ALIKE**2 * min(factors.values())


def noise_remarks(fit: Residuals, source: str = "stated") -> list[Remark]:
    """Remarks on sds that are wrong by a factor. `source`: source of the sds."""
    factors = noise_factors(fit)
    if _is_common_factor(fit, factors):
        return [
            Remark(
                "noise_off", channel="", factor=float(np.exp(np.mean(np.log(list(factors.values()))))), source=source
            )
        ]
    return [Remark("noise_off", channel=name, factor=factor, source=source) for name, factor in factors.items()]


def variance_of_sums(residuals: Sequence[Float[np.ndarray, " rows"]]) -> float:
    """Variance of sums of consecutive residuals, divided by their number: 1 for white noise of unit variance.

    The sums are over blocks whose length is the root of the number of residuals (batch means, Flegal and Jones, Ann.
    Stat. 38 (2010) 1034). 1 if the excess is chance.

    Args:
        residuals: whitened residuals of each run, in order of time.
    """
    length = max(int(np.sqrt(sum(map(len, residuals)))), 1)
    blocks = [b for e in residuals for b in np.array_split(e, max(len(e) // length, 1)) if len(b)]
    variance = float(np.mean([np.sum(b) ** 2 / len(b) for b in blocks])) if blocks else 1.0
    return variance if variance > 1 + CHANCE * np.sqrt(2 / len(blocks)) else 1.0
