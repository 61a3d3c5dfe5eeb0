"""Outliers: rows with an isolated wrong reading."""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import threading
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import ndtr, ndtri

from calibration.data import Columns
from calibration.data.runs import Runs
from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.candidates import BaseFit, Candidate, fill_slots, fit_base
from calibration.discovery.experiments import predict_menu
from calibration.discovery.score_tests import (
    Diagnosed,
    ScoreTable,
    bootstrap_statistics,
    diagnose_fit,
)
from calibration.discovery.settings import Settings
from calibration.inference import bases as bases_room
from calibration.inference.bases import Bases
from calibration.inference.blocks import fit_from_each_start
from mmrjax.compile.compiling import Threads

# --- clusters of outliers in time, angle, order or condition --------------------------------------


#: Fewest outliers in a cluster.
FEWEST = 3
#: Gauss-Newton steps between changes of the weights of a robust fit.
FEW = 6
#: Widths of the windows in which they are counted, as shares of the range.
WINDOWS = (1 / 16, 1 / 8, 1 / 4)
#: Permutations that give the p-value of a count.
PERMUTATIONS = 1000
#: Columns whose levels are tested.
LEVELS = ("configuration", "supply_voltage_V", "slope_deg", "payload_kg", "run_id", "surface", "duty", "mode")


@dataclasses.dataclass(frozen=True)
class OutlierCluster:
    """Outliers that share a condition, or that are close together along an axis.

    Attributes:
        axis: column, or angle, along which they are close together.
        low, high: ends of the cluster on the axis.
        level: the shared level, for a column of words or levels.
        inside, of: number of outliers in the cluster, and number of all outliers.
        p: p-value of the cluster.
    """

    axis: str
    low: float
    high: float
    level: str
    inside: int
    of: int
    p: float


def find_cluster(
    outliers: np.ndarray,
    included: np.ndarray,
    axes: Columns,
    levels: Columns,
    error: float,
    seed: int,
) -> OutlierCluster | None:
    """Most significant cluster of outliers. None if their positions are consistent with chance.

    Args:
        outliers, included: True for outliers, and for the other included rows, shape (rows,).
        axes: positions of the rows along continuous variables.
        levels: columns of conditions with few levels.
        error: family-wise error.
        seed: random seed of the permutations.
    """
    pool = np.flatnonzero(outliers | included)
    outlier_rows = np.flatnonzero(outliers)
    if len(outlier_rows) < FEWEST:
        return None
    clusters = [_cluster_along_axis(name, np.asarray(x, float), outlier_rows, pool, seed) for name, x in axes.items()]
    clusters += [c for name, x in levels.items() for c in _clusters_by_level(name, np.asarray(x), outlier_rows, pool)]
    if not clusters:
        return None
    best = min(clusters, key=lambda c: c.p)
    p = min(1.0, best.p * (len(axes) + len(levels)))
    return dataclasses.replace(best, p=p) if p < error else None


def _cluster_along_axis(
    name: str, x: np.ndarray, outliers: np.ndarray, pool: np.ndarray, seed: int
) -> OutlierCluster:
    """Window of an axis with most outliers, compared with random draws of as many rows."""
    low, high = x[pool].min(), x[pool].max()
    random = np.random.default_rng(seed)
    permutations = np.stack([random.choice(pool, len(outliers), replace=False) for _ in range(PERMUTATIONS)])
    clusters: list[OutlierCluster] = []
    for share in WINDOWS:
        width = share * (high - low)
        (count,), (first,) = _fullest_window(x[outliers][None], width)
        null, _ = _fullest_window(x[permutations], width)
        p = (1 + int(np.sum(null >= count))) / (1 + PERMUTATIONS)
        if p == 1 / (1 + PERMUTATIONS):  # beyond the resolution of permutations: a normal approximation
            p = min(p, float(ndtr((null.mean() - count) / max(null.std(), 0.3))))
        inside = x[outliers][(x[outliers] >= first) & (x[outliers] <= first + width)]
        p = min(1.0, p * len(WINDOWS))
        clusters.append(
            OutlierCluster(name, float(inside.min()), float(inside.max()), "", int(count), len(outliers), p)
        )
    return min(clusters, key=lambda c: c.p)


def _fullest_window(x: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Largest number of points in a window of given width, for each set of points, and the start of that window."""
    x = np.sort(x, 1)
    inside = np.stack([np.searchsorted(row, row + width, side="right") - np.arange(len(row)) for row in x])
    return inside.max(1), x[np.arange(len(x)), inside.argmax(1)]


def _clusters_by_level(name: str, x: np.ndarray, outliers: np.ndarray, pool: np.ndarray) -> list[OutlierCluster]:
    """A cluster for each level of a column, with the hypergeometric p-value of its number of outliers."""
    values = np.unique(x[pool])
    if not 1 < len(values) <= 0.5 * len(pool):
        return []
    from scipy.stats import hypergeom  # takes a second to import, and is rarely needed

    clusters = []
    for value in values:
        inside, size = int(np.sum(x[outliers] == value)), int(np.sum(x[pool] == value))
        p = float(hypergeom.sf(inside - 1, len(pool), size, len(outliers)))
        clusters.append(
            OutlierCluster(name, np.nan, np.nan, str(value), inside, len(outliers), min(1.0, p * len(values)))
        )
    return clusters


# --- outliers -------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Screening:
    """Base fit without isolated outliers.

    Attributes:
        base: the base fit.
        outliers: indices of the excluded rows, in order of exclusion.
        bases: bases of the smooth curves at that fit.
        diagnosed: linearization of the fit, and scores of effects and curves on its residuals.
        cluster: property that the outliers share. They were then not excluded. None if there is none.
    """

    base: BaseFit
    outliers: tuple[int, ...]
    bases: Bases
    diagnosed: Diagnosed
    cluster: OutlierCluster | None = None


@contextlib.contextmanager
def compile_ahead(space: CandidateSpace, runs: Runs) -> Iterator[Callable[[BaseFit], None]]:
    """Context manager that compiles programs for later steps, on other cores, during the base fit.

    To compile them, it runs a diagnosis and, except for long runs, one bootstrap replicate and a fit with slots, all
    at the prior mean. It yields a function of the base fit that does the same for the predictions of experiments. All
    results are discarded.
    """
    zeros, empty_slots = np.zeros(len(space.coordinates)), fill_slots((), space.settings)
    mean = Candidate(empty_slots, zeros, zeros, np.inf, zeros, zeros, False, False, False)
    start = BaseFit(mean, np.full(np.shape(space.bare.data.measured), np.nan), space, ())

    diagnosed = threading.Event()

    def compile_diagnosis() -> None:
        try:
            bases, (linear, _, _) = _diagnose_base(start, runs, space.settings)
        finally:
            diagnosed.set()
        if not space.bare.observe.long:
            bootstrap_statistics(
                space.bare, zeros[: space.free], linear, space.library.scored, bases, 1, space.settings.seed
            )

    def compile_fit() -> None:
        if space.bare.observe.long:  # its readings are linear from here
            return
        diagnosed.wait()  # needed last: compilation shares two cores with the base fit
        fit_from_each_start(space.equipped, [zeros], [space.weight], [space.coordinates.indices(empty_slots)])

    def compile_predictions(base: BaseFit) -> None:
        if space.bare.observe.menu:
            jobs.append(threads.submit(predict_menu, base.space, {"": base.candidate}))

    with Threads(2) as threads:
        jobs: list[concurrent.futures.Future[Any]] = [threads.submit(compile_diagnosis), threads.submit(compile_fit)]
        yield compile_predictions
    for job in jobs:
        job.result()


def screen_outliers(base: BaseFit, runs: Runs, settings: Settings) -> Screening:
    """Excludes rows with a single wrong reading: its shift is more significant than any effect or curve.

    Outliers that form a cluster are not excluded. `cluster` of the result describes it.

    Args:
        runs: the runs.
    """
    allowed = settings.outliers(int(base.space.included.sum()))
    clean, excluded = _exclude_gross_errors(base, settings, runs.source)
    bases, diagnosis = _diagnose_base(clean, runs, settings)
    while len(excluded) < allowed:
        isolated = _isolated_rows(clean, diagnosis[1], bases, allowed - len(excluded), settings)
        if not isolated.size:
            break
        excluded = (*excluded, *map(int, isolated))
        clean = _refit_without(clean, isolated, settings, runs.source)
        bases, diagnosis = _diagnose_base(clean, runs, settings)
    screened = Screening(clean, excluded, bases, diagnosis)
    cluster = _common_property(screened, runs, settings)
    return screened if cluster is None else Screening(base, (), *_diagnose_base(base, runs, settings), cluster)


def _common_property(screening: Screening, runs: Runs, settings: Settings) -> OutlierCluster | None:
    """Property that the outliers share."""
    rows, included = np.arange(len(runs)), screening.base.space.included
    axes = {a: runs[c] for a, c in (("time", "time_s"), ("order", "order")) if runs.has(c)}
    angle = screening.diagnosed[0].shaft_angle()
    if angle is not None:
        axes["angle of the driving shaft"] = angle[rows] % (2 * np.pi)
    levels = {c: runs[c] for c in LEVELS if runs.has(c)}
    outliers = np.isin(rows, screening.outliers)
    return find_cluster(outliers, included[rows], axes, levels, settings.outlier_error, settings.seed)


def screen_with_effects(screening: Screening, scores: ScoreTable, runs: Runs, settings: Settings) -> Screening | None:
    """Excludes rows that are outliers only after effects are added.

    None if there are no such rows, or if they form a cluster.

    Args:
        scores: scores of the residuals of the fit with effects.
    """
    row_count = screening.base.space.included.sum() + len(screening.outliers)
    allowed = settings.outliers(int(row_count)) - len(screening.outliers)
    isolated = _isolated_rows(screening.base, scores, screening.bases, allowed, settings)
    if not isolated.size or screening.cluster is not None:
        return None
    base = _refit_without(screening.base, isolated, settings, runs.source)
    extended = Screening(base, (*screening.outliers, *map(int, isolated)), *_diagnose_base(base, runs, settings))
    return extended if _common_property(extended, runs, settings) is None else None


def _isolated_rows(base: BaseFit, scores: ScoreTable, bases: Bases, allowed: int, settings: Settings) -> np.ndarray:
    """Indices of at most `allowed` rows with one reading whose shift is more significant than any effect or curve."""
    included = base.space.included
    level = -ndtri(settings.outlier_error / 2 / (base.space.weight.shape[1] * included.sum()))
    row_scores = (np.abs(scores.row) * included[:, None]).max(1)
    smooth = [variable not in bases_room.ORDERS for _, variable in bases_room.family_names(bases)]
    strongest = max(np.max(np.abs(scores.single)), np.max(np.asarray(scores.curve)[smooth]))
    count = 1 if base.space.bare.observe.policy.one_by_one else allowed
    candidates = np.argsort(-row_scores)[: min(count, max(allowed, 0))]
    return candidates[(row_scores[candidates] >= level) & (row_scores[candidates] >= strongest)]


def _diagnose_base(base: BaseFit, runs: Runs, settings: Settings) -> tuple[Bases, Diagnosed]:
    space, bases = base.space, bases_at_fit(runs, base)
    problem, z = space.problem(fill_slots((), settings)), base.candidate.z
    if problem.observe.long:  # by the program of its fit
        problem, z = space.bare, z[: space.free]
    return bases, jax.device_get(diagnose_fit(problem, jnp.asarray(z), space.library.scored, bases))


def _refit_without(base: BaseFit, rows: np.ndarray, settings: Settings, source: str) -> BaseFit:
    refit = fit_base(base.space.without(rows), source, base.candidate)
    return dataclasses.replace(refit, unusable=tuple(sorted({*base.unusable, *refit.unusable})))


def _exclude_gross_errors(base: BaseFit, settings: Settings, source: str) -> tuple[BaseFit, tuple[int, ...]]:
    """Excludes rows so far from the fit that they distort it and every score.

    They are detected at a robust fit with Cauchy's weights, reweighted every few steps (Holland and Welsch 1977).
    """
    space = base.space
    data, included = space.bare.data, space.included
    sd, measured, weight = (np.asarray(x) for x in (data.sd, data.measured, data.weight))

    def largest_residual(reading: np.ndarray) -> np.ndarray:
        return np.max(np.abs((reading - measured) / sd) * (weight > 0), 1)

    problem, start, active = space.fit_of(base.candidate.active, base.candidate.z)
    distance = largest_residual(base.reading)
    if distance[included].max() < settings.gross:
        return base, ()
    for _ in range(settings.reweightings):
        robust = space.weight / np.sqrt(1 + (distance / settings.cauchy) ** 2)[:, None]
        optima, observations = fit_from_each_start(
            problem, [start], [robust], None if active is None else [active], FEW
        )
        distance, start = largest_residual(np.asarray(observations.reading[0])), np.asarray(optima.z[0])
    gross = included & (distance > settings.gross * max(1.0, float(np.median(distance[included]))))
    if not gross.any() or gross.sum() > settings.outliers(int(included.sum())):
        return base, ()
    return _refit_without(base, np.flatnonzero(gross), settings, source), tuple(map(int, np.flatnonzero(gross)))


def bases_at_fit(runs: Runs, base: BaseFit) -> Bases:
    """Bases of smooth curves over the fitted readings. Curves over measured readings would share their noise."""
    problem, z, active = base.space.fit_of(base.candidate.active, base.candidate.z)
    problem = problem if active is None else base.space.problem(base.candidate.active)
    index, _ = problem.observe.padded_rows(len(runs))
    columns = dict(runs.where(index).columns)
    reading = np.where(np.isfinite(base.reading), base.reading, problem.data.measured)
    columns |= {c.column: reading[:, k] for k, c in enumerate(problem.channels)}
    observe = problem.observe.at_fit(problem, z)
    return observe.bases(columns, base.space.included, problem.robot(jnp.asarray(z)))
