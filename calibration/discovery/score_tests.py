"""Score tests of a fit's residuals: for every effect, every smooth curve in a balance, and every single reading.

Everything is linear algebra at one fit. It has whitened residuals e (readings, the limit on adhesion, priors) and
their Jacobian J by the free parameters. An effect has the signature g = ∂e/∂a. After the free parameters have been
fitted again, r = (I - P) g remains of g, with P = J (JᵀJ)⁻¹ Jᵀ. The score of the effect is (r·e)² / ‖r‖², χ² with one
degree of freedom under the null hypothesis (Rao 1948).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from calibration.discovery.projection import ABSORBED
from calibration.inference.bases import Bases, place_signature
from calibration.inference.linearization import Linearization, ScoredEffect
from calibration.inference.optimizers import CORES, with_solved_rows
from calibration.inference.problem import Problem
from mmrjax.compile.compiling import SELDOM, SMALL, Threads, compiled
from mmrjax.numerics.linear_equations import solve_lower

#: Largest predicted decrease of the objective [½σ²] for a refit's statistics to count.
UNSETTLED = 0.05
#: Prior sd of a curve's columns in a fit with the free parameters [σ]: wide, but it keeps their rank.
WIDE = 30.0
#: Coordinates are padded to a multiple of this.
COORDINATE_MULTIPLE = 72
#: Range of the ratio of the true to an estimated sd.
UNSURE = 0.3, 4.0
#: Replicates in one batch of the bootstrap.
CHUNK = 64


class ScoreTable(eqx.Module):
    """Scores of effects, pairs, curves and readings on the residuals e of a fit. r is a projected signature.

    Attributes:
        single: signed square root of the score of each instance, -(r·e)/‖r‖, shape (instances,).
        amplitude: estimated amplitude of each instance, -(r·e)/‖r‖² [prior sds].
        left: ‖r‖, change of the readings per prior sd of the amplitude [σ].
        pair: score of each pair of instances (χ² with two degrees of freedom), shape (instances, instances). Zero if
            the two cannot be separated.
        cosine: cosine of the angle between every two projected signatures.
        curve: score of each family of curves as a normal deviate, shape (families,).
        explained: ridge score of each family [σ²].
        row: signed square root of the score of a shift of each single reading, shape (rows, channels).
        fall: decrease of the objective that a further step of the fit would give [½σ²].
    """

    single: Float[Array, " instances"]
    amplitude: Float[Array, " instances"]
    left: Float[Array, " instances"]
    pair: Float[Array, "instances instances"]
    cosine: Float[Array, "instances instances"]
    curve: Float[Array, " families"]
    explained: Float[Array, " families"]
    row: Float[Array, "rows channels"]
    fall: Float[Array, ""]


class ProjectionFactors(eqx.Module):
    """Factors for projections at a fit with Jacobian J and residuals e, where L Lᵀ = JᵀJ.

    Attributes:
        half: L⁻¹ Jᵀ of the readings, shape (coordinates, readings).
        step: L⁻¹ Jᵀ e, shape (coordinates,).
        left: e of the readings after that step.
    """

    half: Float[Array, "coordinates readings"]
    step: Float[Array, " coordinates"]
    left: Float[Array, " readings"]

    @staticmethod
    def of(linear: Linearization) -> ProjectionFactors:
        """Factors of a linearisation."""
        jacobian, e, readings = linear.jacobian, linear.residual, linear.readings
        normal = jacobian.T @ jacobian
        # Apart, because only the second depends on the table of a bootstrap.
        half, step = solve_lower(normal, jacobian[:readings].T), solve_lower(normal, (jacobian.T @ e)[:, None])[:, 0]
        return ProjectionFactors(half, step, e[:readings] - half.T @ step)

    def projected(self, columns: Array) -> tuple[Array, Array]:
        """Products of projected columns with e, and with each other."""
        inside = self.half @ columns
        return columns.T @ self.left, columns.T @ columns - inside.T @ inside


def score_tests(linear: Linearization, bases: Bases) -> ScoreTable:
    """Scores of each instance, pair of instances, curve and reading."""
    signatures, fit = linear.signatures, ProjectionFactors.of(linear)
    dots, products = fit.projected(signatures)
    total_norm = jnp.sum(signatures**2, 0)
    norm2 = jnp.maximum(jnp.diag(products), 0.0)
    is_visible = norm2 > ABSORBED**2 * jnp.maximum(total_norm, 1e-300)
    norm = jnp.sqrt(jnp.where(is_visible, norm2, 1.0))
    single = jnp.where(is_visible, -dots / norm, 0.0)
    both_visible = is_visible[:, None] & is_visible
    cosine = jnp.where(both_visible, products / (norm[:, None] * norm), 0.0)
    separation = jnp.where(both_visible, 1 - cosine**2, 0.0)
    pair_scores = (single[:, None] ** 2 + single**2 - 2 * cosine * single[:, None] * single) / jnp.maximum(
        separation, 1e-9
    )
    pair = jnp.where(separation > 1e-2, pair_scores, 0.0)

    leverage = jnp.sum(fit.half**2, 0)
    row = jnp.where(leverage < 1 - 1e-6, fit.left / jnp.sqrt(jnp.maximum(1 - leverage, 1e-12)), 0.0)

    scores = [basis.of_signatures(linear, functools.partial(_curve_score, fit)) for basis in bases]
    deviate, explained = (jnp.concatenate([f[k] for f in scores] or [jnp.zeros(0)]) for k in (0, 1))
    amplitude = jnp.where(is_visible, -dots / norm**2, 0.0)
    row = row.reshape(linear.rows, -1)
    fall = 0.5 * jnp.sum(fit.step**2)
    return ScoreTable(single, amplitude, jnp.sqrt(norm2), pair, cosine, deviate, explained, row, fall)


def _curve_score(fit: ProjectionFactors, columns: Array) -> tuple[Array, Array]:
    """Score (rᵀe)ᵀ (rᵀr + I)⁻¹ (rᵀe) of several columns, as a normal deviate and in σ².

    The columns are scaled so that each changes the readings by ten sigmas, which acts as a prior on their size.
    """
    dots, products = fit.projected(columns)
    norm2 = jnp.diag(products)
    is_visible = norm2 > ABSORBED**2 * jnp.maximum(jnp.sum(columns**2, 0), 1e-300)
    scale = jnp.where(is_visible, 10.0 / jnp.sqrt(jnp.where(is_visible, norm2, 1.0)), 0.0)
    products = products * scale[:, None] * scale
    dots = dots * scale
    right_sides = jnp.concatenate([dots[:, None], jnp.eye(dots.size)], 1)
    half = solve_lower(products + jnp.eye(dots.size), right_sides)
    explained = jnp.sum(half[:, 0] ** 2)
    # E = tr(A (A + I)⁻¹) under the null: degrees of freedom.
    freedom = dots.size - jnp.sum(half[:, 1:] ** 2)
    deviate = normal_deviate(explained, jnp.maximum(freedom, 1e-3))
    return jnp.where(jnp.any(is_visible), deviate, -1.0 / ABSORBED), explained


def normal_deviate(chi2: Array, freedom: Array) -> Array:
    """Standard normal deviate that has the same p-value as a χ² with this many degrees of freedom [-].

    Modified signed root of a gamma distribution (Barndorff-Nielsen 1986). It is accurate to 0.03 from 1 to 20 degrees
    of freedom, for any p-value. The cube root of Wilson and Hilferty is much too small for a large χ² with few
    degrees of freedom. It is used only near the mean, where the signed root is 0/0.
    """
    x, k = jnp.maximum(chi2, 1e-12) / 2, freedom / 2
    spread = 1 / (9 * k)
    cube = ((x / k) ** (1 / 3) - (1 - spread)) / jnp.sqrt(spread)
    near = jnp.abs(x / k - 1) < 0.05
    x = jnp.where(near, 2 * k, x)
    root = jnp.sign(x - k) * jnp.sqrt(2 * jnp.maximum(x - k - k * jnp.log(x / k), 1e-12))
    return jnp.where(near, cube, root + jnp.log((x - k) / jnp.sqrt(k) / root) / root)


class StrongestStatistics(eqx.Module):
    """Strongest statistics of a fit: |single|, pair [σ²], curve [normal deviate], and χ² and memory of the residuals.

    `settled` is True if the fit is an optimum. `white` is `Linearization.autocorrelation`.
    """

    single: Array
    pair: Array
    curve: Array
    chi2: Array
    white: Array
    settled: Array


def strongest_statistics(scores: ScoreTable, linear: Linearization) -> StrongestStatistics:
    """Largest statistic of each kind."""
    return StrongestStatistics(
        jnp.max(jnp.abs(scores.single)),
        jnp.max(scores.pair),
        jnp.max(scores.curve),
        jnp.sum(linear.residual**2),
        linear.autocorrelation(),
        scores.fall < UNSETTLED,
    )


Diagnosed = tuple[Linearization, ScoreTable, StrongestStatistics]


def diagnose_fit(
    problem: Problem, z: Array, effects: tuple[ScoredEffect, ...], bases: Bases, near: Linearization | None = None
) -> Diagnosed:
    """Linearization of a fit, scores of effects and curves on its residuals, and the strongest statistics.

    Args:
        near: linearization of another fit. Its changes of the readings by effects and curves are used. None: they are
            computed at this fit, which for a log takes a program.
    """
    if near is not None:
        residual, jacobian, _ = problem.observe.at(problem, z)
        linear = dataclasses.replace(near, residual=residual, jacobian=jacobian)
    elif problem.observe.over_time:  # by separate programs
        linear = problem.observe.linearise(problem, z, effects)
    else:
        linear = _linearised(with_solved_rows(problem, z), z, effects)
    return linear, *_padded_scores(linear, bases)


@functools.partial(compiled, options=SELDOM)
def _linearised(problem: Problem, z: Array, effects: tuple[ScoredEffect, ...]) -> Linearization:
    return problem.observe.linearise(problem, z, effects)


def _padded_scores(linear: Linearization, bases: Bases) -> tuple[ScoreTable, StrongestStatistics]:
    """Scores of a fit and the strongest of them, by a program that serves any number of coordinates and any signals.

    The coordinates are padded with ones that do not influence the readings, so that only a few sizes are compiled.
    """
    padding = np.zeros((linear.readings, -linear.jacobian.shape[1] % COORDINATE_MULTIPLE))
    jacobian, residual = augment_with_columns(linear, padding)
    padded: Any = {"jacobian": jacobian, "residual": residual, "signals": None}
    return _scores_and_strongest(dataclasses.replace(jax.tree.map(np.asarray, linear), **padded), bases)


@functools.partial(compiled, options=SELDOM)
def _scores_and_strongest(linear: Linearization, bases: Bases) -> tuple[ScoreTable, StrongestStatistics]:
    scores = score_tests(linear, bases)
    return scores, strongest_statistics(scores, linear)


def family_columns(linear: Linearization, bases: Bases, chosen: int) -> np.ndarray:
    """Sensitivity of the readings to each term of one family of curves, scaled by a wide prior sd, shape (readings,
    terms).

    Args:
        chosen: index of the family, in the order of `ScoreTable.curve`.
    """
    linear = jax.tree.map(np.asarray, linear)
    for basis in bases:
        if chosen < len(basis.places):
            columns = place_signature(linear, basis.places[chosen], np.asarray(basis.columns)[chosen])
            norm = np.linalg.norm(columns, axis=0)
            return columns[:, norm > 0] / norm[norm > 0] * WIDE
        chosen -= len(basis.places)
    raise IndexError(chosen)


def augment_with_columns(linear: Linearization, extra: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Jacobian and residuals of a fit with additional columns, each with prior mean 0 and sd 1.

    Args:
        extra: columns over the readings, shape (readings, columns).
    """
    jacobian, (readings, added) = np.asarray(linear.jacobian), extra.shape
    total, free = jacobian.shape
    augmented = np.zeros((total + added, free + added))
    augmented[:total, :free] = jacobian
    augmented[:readings, free:] = extra
    augmented[total:, free:] = np.eye(added)
    return augmented, np.concatenate([np.asarray(linear.residual), np.zeros(added)])


def statistics_with_columns(
    linear: Linearization, bases: Bases, extra: np.ndarray, names: Sequence[str]
) -> tuple[StrongestStatistics, np.ndarray]:
    """Strongest statistics after additional columns are fitted together with the free parameters.

    Also returns the normal deviate of each family of curves, -inf for families in the places of the columns.

    Args:
        extra: columns over the readings, shape (readings, columns).
        names: place of each column.
    """
    augmented: tuple[Any, Any] = augment_with_columns(linear, extra)
    scores, _ = _padded_scores(dataclasses.replace(linear, jacobian=augmented[0], residual=augmented[1]), bases)
    places = np.array([n[0] for b in bases for n in b.names])
    deviate = np.where(np.isin(places, list(names)), -np.inf, scores.curve)
    untested = jnp.asarray(-jnp.inf)
    statistics = StrongestStatistics(
        single=np.max(np.abs(scores.single)),
        pair=np.max(np.asarray(scores.pair)),
        curve=np.max(deviate, initial=-np.inf),
        chi2=untested,
        white=untested,
        settled=jnp.asarray(True),
    )
    return statistics, deviate


@functools.partial(compiled, options=SELDOM)
def _replicate_keys(seed: Array, batches: int, replicates: int) -> Array:
    """Random key of each bootstrap replicate, shape (replicates, 2)."""
    keys = jax.random.key_data(jax.random.split(jax.random.key(seed), (batches, CHUNK)))
    return keys.reshape(batches * CHUNK, -1)[:replicates]


def bootstrap_statistics(
    problem: Problem,
    z: np.ndarray,
    linear: Linearization,
    effects: tuple[ScoredEffect, ...],
    bases: Bases,
    replicates: int,
    seed: int,
    freedom: np.ndarray | None = None,
) -> StrongestStatistics:
    """Statistics of tables that are drawn from the fitted base and refitted, shape (replicates,).

    Replicates whose refit does not converge are omitted, so there may be fewer.

    Args:
        problem: problem of the base.
        z: coordinates of its fit.
        linear: linearization of that fit.
        seed: random seed.
        freedom: degrees of freedom of the estimated sd of each channel, infinite if the sd is known. None: all are
            known. The true sds of each table are drawn given these estimates.
    """
    count = -(-replicates // CHUNK)
    draws = problem.observe.draws(
        problem, jnp.asarray(z), linear, _replicate_keys(jnp.asarray(seed), count, replicates),
        _noise_factors(freedom, len(problem.channels), replicates, seed),
    )  # fmt: skip
    # Padded to whole batches by repeats, which are cut off later.
    draws = jax.tree.map(lambda x: np.resize(np.asarray(x), (count, CHUNK, *x.shape[1:])), draws)

    def statistics_of_batch(k: int) -> StrongestStatistics:
        draws_of_part = jax.tree.map(lambda x: x[k], draws)
        return jax.device_get(_replicate_batch(problem, linear, effects, bases, draws_of_part))

    linear = jax.tree.map(jnp.asarray, linear)  # else each batch has a copy
    # The first batch compiles the program of the others; a batch keeps one core busy.
    with Threads(CORES) as cores:
        parts = [statistics_of_batch(0), *cores.map(statistics_of_batch, range(1, count))]
    statistics = jax.tree.map(lambda *x: np.concatenate(x)[:replicates], *parts)
    return jax.tree.map(lambda x: x[statistics.settled], statistics)


def _noise_factors(freedom: np.ndarray | None, channels: int, replicates: int, seed: int) -> np.ndarray:
    """Random ratios of true to estimated sds, √(ν / χ²_ν), shape (replicates, channels)."""
    factors = np.ones((replicates, channels))
    if freedom is not None:
        random = np.random.default_rng(seed)
        for k in np.flatnonzero(np.isfinite(freedom)):
            factors[:, k] = np.sqrt(freedom[k] / random.chisquare(freedom[k], replicates))
    return np.clip(factors, *UNSURE)


@functools.partial(compiled, options=SMALL)
def _replicate_batch(
    problem: Problem, linear: Linearization, effects: tuple[ScoredEffect, ...], bases: Bases, drawn: Any
) -> StrongestStatistics:
    """Statistics of one batch of bootstrap replicates."""

    def statistics_of_replicate(drawn: Any) -> StrongestStatistics:
        replicate = problem.observe.fit_replicate(problem, effects, linear, drawn)
        return strongest_statistics(score_tests(replicate, bases), replicate)

    return jax.vmap(statistics_of_replicate)(drawn)
