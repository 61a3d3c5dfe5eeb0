"""Outliers: rows with a reading that stands alone."""

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
from scipy.special import ndtri

from calibration.data.runs import Runs
from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.candidates import BaseFit, Candidate, empty, fit_base
from calibration.discovery.clusters import LEVELS, Cluster, cluster
from calibration.discovery.experiments import predict
from calibration.discovery.score_tests import Diagnosed, ScoreTable, bootstrap, diagnosed
from calibration.discovery.settings import Settings
from calibration.inference import bases as bases_room
from calibration.inference.bases import Bases
from calibration.inference.held_out import search_each
from mmrjax.compile.precision import Threads


@dataclasses.dataclass(frozen=True)
class Screening:
    """The base fit after rows that stand alone were set aside.

    Attributes:
        base: the fit; outliers: indices of the rows set aside, in the order in which they were.
        bases: of the curves that a discrepancy is looked for with, at that fit.
        diagnosed: the fit linearised, and what effects and curves could explain of its residual.
        cluster: what rows that lie off have in common, so that they were not set aside; None for nothing.
    """

    base: BaseFit
    outliers: tuple[int, ...]
    bases: Bases
    diagnosed: Diagnosed
    cluster: Cluster | None = None


@contextlib.contextmanager
def ahead(
    space: CandidateSpace, bases_at: Callable[[BaseFit], Bases], settings: Settings
) -> Iterator[Callable[[BaseFit], None]]:
    """Beside what is done meanwhile, a first look at the prior's mean, a replicate of a bootstrap there and a fit
    with room for effects, on other cores: what every later one needs is then compiled. A call of what this gives,
    with the base fit, has experiments foreseen too, or where runs are long what fits with room for effects take. What
    they find is not read."""
    nothing, none = np.zeros(len(space.coordinates)), empty(settings)
    mean = Candidate(none, nothing, nothing, np.inf, nothing, nothing, False, False, False)
    start = BaseFit(mean, np.full(np.shape(space.bare.data.measured), np.nan), space, ())

    looked = threading.Event()

    def look() -> None:
        try:
            bases, (linear, _, _) = _look(start, bases_at, settings)
        finally:
            looked.set()
        bootstrap(space.bare, nothing[: space.free], linear, space.library.scored, bases, 1, settings.seed)

    def fit() -> None:
        if space.bare.observe.long:  # whose programs have what is found to be missing, which is not known yet
            return
        looked.wait()  # needed last: what compiles beside the base fit shares two cores with it
        search_each(space.equipped, [nothing], [space.weight], [space.library.indices(none)])

    def make_room(base: BaseFit) -> None:
        problem, z = base.space.problem(none), jnp.asarray(nothing)
        problem.observe.linearise(problem, z, problem.data, base.space.library.scored)

    def foresee(base: BaseFit) -> None:
        if space.bare.observe.long:
            jobs.append(others.submit(make_room, base))
        elif space.bare.observe.menu:
            jobs.append(others.submit(predict, base.space, {"": base.candidate}, settings))

    with Threads(2) as others:
        jobs: list[concurrent.futures.Future[Any]] = [others.submit(look), others.submit(fit)]
        yield foresee
    for job in jobs:
        job.result()


def screen(base: BaseFit, bases_at: Callable[[BaseFit], Bases], runs: Runs, settings: Settings) -> Screening:
    """Set aside rows with a reading that stands alone: its own shift is less probable than any effect or curve.

    Rows that stand together are none: they stay, and `cluster` says where.

    Args:
        bases_at: bases of curves at a fit of the base; runs: the table.
    """
    where = runs.source
    found = _screened(base, bases_at, settings, where)
    mine = np.zeros(len(base.space.included), bool)
    mine[list(found.outliers)] = True
    together = _together(found, mine, runs, settings)
    if together is None:
        return found
    bases, seen = _look(base, bases_at, settings)
    return Screening(base, (), bases, seen, together)


def same_rows(base: BaseFit, bases_at: Callable[[BaseFit], Bases], known: Screening, settings: Settings) -> Screening:
    """A base fit to the rows that counted in another trace of the same table, looked at: no row is set aside anew.

    Args:
        base: fitted without the rows that `known` sets aside.
    """
    return Screening(base, known.outliers, *_look(base, bases_at, settings), known.cluster)


def _together(found: Screening, outliers: np.ndarray, runs: Runs, settings: Settings) -> Cluster | None:
    """What outliers have in common."""
    rows = len(runs)
    axes = {a: runs[c] for a, c in (("time", "time_s"), ("order", "order")) if runs.has(c)}
    turned = found.diagnosed[0].turned()
    if turned is not None:
        axes["angle of the driving shaft"] = turned[:rows] % (2 * np.pi)
    levels = {c: runs[c] for c in LEVELS if runs.has(c)}
    included = found.base.space.included
    return cluster(outliers[:rows], included[:rows], axes, levels, settings.outlier_error, settings.seed)


def screen_beside(
    found: Screening, left: ScoreTable, bases_at: Callable[[BaseFit], Bases], runs: Runs, settings: Settings
) -> Screening | None:
    """Rows that stand alone at a fit with effects, set aside too: what was missing hid them. None where there are no
    further ones, or they stand together.

    Args:
        left: what could explain what that fit leaves.
    """
    counting = found.base.space.included.sum() + len(found.outliers)
    allowed = settings.outliers(int(counting)) - len(found.outliers)
    far = _alone(found.base, left, found.bases, allowed, settings)
    if not far.size or found.cluster is not None:
        return None
    base = _again(found.base, far, settings, runs.source)
    more = Screening(base, (*found.outliers, *map(int, far)), *_look(base, bases_at, settings))
    outliers = np.zeros(len(base.space.included), bool)
    outliers[list(more.outliers)] = True
    return None if _together(more, outliers, runs, settings) is not None else more


def _alone(base: BaseFit, scores: ScoreTable, bases: Bases, allowed: int, settings: Settings) -> np.ndarray:
    """Indices of rows of which a reading's own shift is less probable than any effect or curve, at most so many."""
    included = base.space.included
    level = -ndtri(settings.outlier_error / 2 / (base.space.weight.shape[1] * included.sum()))
    alone = (np.abs(np.asarray(scores.row)) * included[:, None]).max(1)
    smooth = [variable not in bases_room.ORDERS for _, variable in bases_room.names(bases)]
    together = max(np.max(np.abs(np.asarray(scores.single))), np.max(np.asarray(scores.curve)[smooth]))
    count = 1 if base.space.bare.observe.policy.one_by_one else allowed
    far = np.argsort(-alone)[: min(count, max(allowed, 0))]
    return far[(alone[far] >= level) & (alone[far] >= together)]


def _screened(base: BaseFit, bases_at: Callable[[BaseFit], Bases], settings: Settings, where: str) -> Screening:
    """Rows whose own shift is less probable by chance than any effect or curve, set aside."""
    allowed = settings.outliers(int(base.space.included.sum()))
    base, outliers = _set_gross_aside(base, settings, where)
    bases, seen = _look(base, bases_at, settings)
    while len(outliers) < allowed:
        far = _alone(base, seen[1], bases, allowed - len(outliers), settings)
        if not far.size:
            break
        outliers = (*outliers, *map(int, far))
        base = _again(base, far, settings, where)
        bases, seen = _look(base, bases_at, settings)
    return Screening(base, outliers, bases, seen)


def _look(base: BaseFit, bases_at: Callable[[BaseFit], Bases], settings: Settings) -> tuple[Bases, Diagnosed]:
    space, bases = base.space, bases_at(base)
    problem, z = space.problem(empty(settings)), base.candidate.z
    if problem.observe.long:  # by the program that has fitted it
        problem, z = space.bare, z[: space.free]
    return bases, jax.device_get(diagnosed(problem, jnp.asarray(z), space.library.scored, bases))


def _again(base: BaseFit, rows: np.ndarray, settings: Settings, where: str) -> BaseFit:
    again = fit_base(base.space.without(rows), settings, where, base.candidate)
    return dataclasses.replace(again, unusable=tuple(sorted({*base.unusable, *again.unusable})))


def _set_gross_aside(base: BaseFit, settings: Settings, where: str) -> tuple[BaseFit, tuple[int, ...]]:
    """Set aside rows that lie so far off that they bend the fit, and with it every score.

    They are looked for at a robust fit: Cauchy's weights, iterated (Holland and Welsch 1977).
    """
    space = base.space
    data, included = space.bare.data, space.included
    sd, measured, weight = (np.asarray(x) for x in (data.sd, data.measured, data.weight))

    def off(reading: np.ndarray) -> np.ndarray:
        return np.max(np.abs((reading - measured) / sd) * (weight > 0), 1)

    far, start = off(base.reading), base.candidate.z[: space.free]
    if far[included].max() < settings.gross:
        return base, ()
    for _ in range(settings.reweightings):
        robust = space.weight / np.sqrt(1 + (far / settings.cauchy) ** 2)[:, None]
        found, seen = search_each(space.bare, [start], [robust])
        far, start = off(np.asarray(seen.reading[0])), np.asarray(found.z[0])
    gross = included & (far > settings.gross * max(1.0, float(np.median(far[included]))))
    if not gross.any() or gross.sum() > settings.outliers(int(included.sum())):
        return base, ()
    return _again(base, np.flatnonzero(gross), settings, where), tuple(map(int, np.flatnonzero(gross)))
