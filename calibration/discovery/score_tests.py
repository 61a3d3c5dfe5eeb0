"""Score tests of residuals for every effect, and for every smooth curve in a balance.

Everything is linear algebra at one fit. It has whitened residuals e (readings, the limit on adhesion, priors) and
their Jacobian J by the free parameters. An effect has the signature g = ∂e/∂a. After the free parameters have been
fitted again, r = (I - P) g remains of g, with P = J (JᵀJ)⁻¹ Jᵀ. The score of the effect is (r·e)² / ‖r‖², χ²
with one degree of freedom under the null hypothesis (Rao 1948).
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

from calibration.inference.bases import Bases, place_signature
from calibration.inference.linearization import Linearization, ScoredEffect
from calibration.inference.optimizers import CORES, with_roots
from calibration.inference.problem import Problem
from mmrjax.compile.compiling import SELDOM, SMALL, compiled
from mmrjax.compile.precision import Threads
from mmrjax.numerics.linear_equations import solve_lower

#: Share of a signature's norm below which the free parameters absorb it completely.
ABSORBED = 1e-3
#: Largest predicted decrease of the objective [½σ²] for a refit's statistics to count.
UNSETTLED = 0.05
#: Prior sd of a curve's columns in a fit with the free parameters [σ]: wide, but it keeps their rank.
WIDE = 30.0
#: Coordinates are padded to a multiple of this.
FILLED = 72
#: Range of the ratio of the true to an estimated sd.
UNSURE = 0.3, 4.0
#: Replicates in one batch of the bootstrap.
CHUNK = 64


class ScoreTable(eqx.Module):
    """Scores of candidates on a fit's residuals.

    Attributes:
        single: signed root of each instance's score, -(r·e)/‖r‖, shape (instances,).
        amplitude: -(r·e)/‖r‖², in prior sds.
        left: ‖r‖, the change of the readings by a prior sd in sigmas.
        pair: scores of pairs of instances (χ² with two degrees of freedom), shape (instances, instances).
            Zero if they can't be separated.
        cosine: cosine between two projected signatures.
        curve: curve of each family, as a normal deviate, shape (families,).
        explained: ridge score of each family [σ²].
        row: signed root of the score of a shift of each single reading, shape (rows, channels).
        fall: further decrease of the objective predicted by a step of the fit [½σ²].
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


class Fit(eqx.Module):
    """Factors of a fit for projections, L Lᵀ = JᵀJ.

    Attributes:
        half: L⁻¹ Jᵀ of the readings, shape (coordinates, readings).
        step: L⁻¹ Jᵀ e, shape (coordinates,).
        left: e of the readings after that step.
    """

    half: Float[Array, "coordinates readings"]
    step: Float[Array, " coordinates"]
    left: Float[Array, " readings"]

    @staticmethod
    def of(linear: Linearization) -> Fit:
        """Factors of a linearisation."""
        jacobian, e, readings = linear.jacobian, linear.residual, linear.readings
        right_sides = jnp.concatenate([jacobian[:readings].T, (jacobian.T @ e)[:, None]], 1)
        solved = solve_lower(jacobian.T @ jacobian, right_sides)
        half, step = solved[:, :-1], solved[:, -1]
        return Fit(half, step, e[:readings] - half.T @ step)

    def projected(self, columns: Array) -> tuple[Array, Array]:
        """Projected columns over the readings: their products with e, and those with each other."""
        inside = self.half @ columns
        return columns.T @ self.left, columns.T @ columns - inside.T @ inside


def score_tests(linear: Linearization, bases: Bases) -> ScoreTable:
    """Scores of each instance, pair, curve and reading."""
    g, fit = linear.signatures, Fit.of(linear)
    dots, products = fit.projected(g)
    total_norm = jnp.sum(g**2, 0)
    norm2 = jnp.maximum(jnp.diag(products), 0.0)
    is_visible = norm2 > ABSORBED**2 * jnp.maximum(total_norm, 1e-300)
    norm = jnp.sqrt(jnp.where(is_visible, norm2, 1.0))
    single = jnp.where(is_visible, -dots / norm, 0.0)
    both_seen = is_visible[:, None] & is_visible
    cosine = jnp.where(both_seen, products / (norm[:, None] * norm), 0.0)
    apart = jnp.where(both_seen, 1 - cosine**2, 0.0)
    pair_scores = (single[:, None] ** 2 + single**2 - 2 * cosine * single[:, None] * single) / jnp.maximum(
        apart, 1e-9
    )
    pair = jnp.where(apart > 1e-2, pair_scores, 0.0)

    leverage = jnp.sum(fit.half**2, 0)
    row = jnp.where(leverage < 1 - 1e-6, fit.left / jnp.sqrt(jnp.maximum(1 - leverage, 1e-12)), 0.0)

    scores = [jax.vmap(lambda c: _curve_score(fit, c))(basis.signatures(linear)) for basis in bases]
    deviate, explained = (jnp.concatenate([f[k] for f in scores] or [jnp.zeros(0)]) for k in (0, 1))
    amplitude = jnp.where(is_visible, -dots / norm**2, 0.0)
    row = row.reshape(linear.rows, -1)
    fall = 0.5 * jnp.sum(fit.step**2)
    return ScoreTable(single, amplitude, jnp.sqrt(norm2), pair, cosine, deviate, explained, row, fall)


def _curve_score(fit: Fit, columns: Array) -> tuple[Array, Array]:
    """(rᵀe)ᵀ (rᵀr + I)⁻¹ (rᵀe), as a normal deviate and in σ².

    The columns are scaled so that each one changes the readings by ten sigmas, as a prior of the discrepancy's size.
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
    """Standard normal deviate with the same p-value as χ² with so many degrees of freedom, [-].

    Modified signed root, Barndorff-Nielsen (1986), of a gamma distribution: within 0.03 from 1 to 20 degrees of
    freedom and for any p-value. Wilson and Hilferty's cube root gives much too little for a large χ² with few degrees
    of freedom. The cube root is used near the mean, where the root is 0/0.
    """
    x, k = jnp.maximum(chi2, 1e-12) / 2, freedom / 2
    spread = 1 / (9 * k)
    cube = ((x / k) ** (1 / 3) - (1 - spread)) / jnp.sqrt(spread)
    near = jnp.abs(x / k - 1) < 0.05
    x = jnp.where(near, 2 * k, x)
    root = jnp.sign(x - k) * jnp.sqrt(2 * jnp.maximum(x - k - k * jnp.log(x / k), 1e-12))
    return jnp.where(near, cube, root + jnp.log((x - k) / jnp.sqrt(k) / root) / root)


class Statistics(eqx.Module):
    """Strongest statistics: |single|, pair [σ²], curve [normal deviate], χ² and memory of the residuals.

    `settled` is True if the fit is an optimum. `white` is `Linearization.memory`.
    """

    single: Array
    pair: Array
    curve: Array
    chi2: Array
    white: Array
    settled: Array


def strongest_statistics(scores: ScoreTable, linear: Linearization) -> Statistics:
    """Largest statistics of a table. A bootstrap draws their distribution."""
    return Statistics(
        jnp.max(jnp.abs(scores.single)),
        jnp.max(scores.pair),
        jnp.max(scores.curve),
        jnp.sum(linear.residual**2),
        linear.memory(),
        scores.fall < UNSETTLED,
    )


Diagnosed = tuple[Linearization, ScoreTable, Statistics]


def diagnose_fit(
    problem: Problem, z: Array, effects: tuple[ScoredEffect, ...], bases: Bases, near: Linearization | None = None
) -> Diagnosed:
    """A linearised fit, the scores of effects and curves on its residuals, and the strongest of these.

    Args:
        near: linearization of a fit nearby. Its signatures and defects are reused for long runs, because a curve
            changes the residuals, but barely the signatures.
    """
    if not problem.observe.long:
        linear = _linearised(with_roots(problem, z), z, effects)
    elif near is None:  # by separate programs
        linear = problem.observe.linearise(problem, z, problem.data, effects)
    else:
        residual, jacobian, _ = problem.observe.at(problem, z)
        linear = dataclasses.replace(near, residual=residual, jacobian=jacobian)
    return linear, *_padded_scores(linear, bases)


@functools.partial(compiled, options=SELDOM)
def _linearised(problem: Problem, z: Array, effects: tuple[ScoredEffect, ...]) -> Linearization:
    return problem.observe.linearise(problem, z, problem.data, effects)


def _padded_scores(linear: Linearization, bases: Bases) -> tuple[ScoreTable, Statistics]:
    """Scores and the strongest of them, by a program that serves fits of any number of coordinates.

    Coordinates are padded by ones without influence on the readings, so that there are few sizes.
    """
    filled = np.zeros((linear.readings, -linear.jacobian.shape[1] % FILLED))
    jacobian, residual = augment_with_columns(linear, filled)
    wide: Any = {"jacobian": jacobian, "residual": residual}
    return _scores_and_strongest(dataclasses.replace(jax.tree.map(np.asarray, linear), **wide), bases)


@functools.partial(compiled, options=SELDOM)
def _scores_and_strongest(linear: Linearization, bases: Bases) -> tuple[ScoreTable, Statistics]:
    scores = score_tests(linear, bases)
    return scores, strongest_statistics(scores, linear)


def family_columns(linear: Linearization, bases: Bases, chosen: int) -> np.ndarray:
    """Signatures of one family's columns, each of a wide prior sd, shape (readings, terms).

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
    """Jacobian and residuals of a fit with further columns, each with prior mean 0 and sd 1.

    Args:
        extra: columns over the readings, shape (readings, columns).
    """
    jacobian, (readings, wide) = np.asarray(linear.jacobian), extra.shape
    total, free = jacobian.shape
    augmented = np.zeros((total + wide, free + wide))
    augmented[:total, :free] = jacobian
    augmented[:readings, free:] = extra
    augmented[total:, free:] = np.eye(wide)
    return augmented, np.concatenate([np.asarray(linear.residual), np.zeros(wide)])


def statistics_with_columns(
    linear: Linearization, bases: Bases, extra: np.ndarray, names: Sequence[str]
) -> tuple[Statistics, np.ndarray]:
    """Strongest statistics after further columns are fitted with the free parameters, and the normal deviate of each
    family of curves, -inf for families in the columns' own places.

    Args:
        extra: columns over the readings, shape (readings, columns).
        names: places of the columns.
    """
    wide: tuple[Any, Any] = augment_with_columns(linear, extra)
    scores, _ = _padded_scores(dataclasses.replace(linear, jacobian=wide[0], residual=wide[1]), bases)
    balances = np.array([n[0] for b in bases for n in b.names])
    deviate = np.where(np.isin(balances, list(names)), -np.inf, np.asarray(scores.curve))
    nothing = jnp.asarray(-jnp.inf)
    statistics = Statistics(
        single=np.max(np.abs(np.asarray(scores.single))),
        pair=np.max(np.asarray(scores.pair)),
        curve=np.max(deviate, initial=-np.inf),
        chi2=nothing,
        white=nothing,
        settled=jnp.asarray(True),
    )
    return statistics, deviate


@functools.partial(compiled, options=SELDOM)
def _replicate_keys(seed: Array, batches: int, replicates: int) -> Array:
    """A key for each replicate, shape (replicates, 2)."""
    keys = jax.random.key_data(jax.random.split(jax.random.key(seed), (batches, CHUNK)))
    return keys.reshape(batches * CHUNK, -1)[:replicates]


def bootstrap(
    problem: Problem,
    z: np.ndarray,
    linear: Linearization,
    effects: tuple[ScoredEffect, ...],
    bases: Bases,
    replicates: int,
    seed: int,
    freedom: np.ndarray | None = None,
) -> Statistics:
    """Statistics of `replicates` tables drawn from the fitted base and fitted again, shape (replicates,).

    Replicates with a refit that did not settle are omitted, so there may be fewer.

    Args:
        problem: problem of the base only, z its fit.
        linear: the same fit, linearised.
        seed: random seed.
        freedom: degrees of freedom of each channel's estimated sd, infinite if it is known, None if all are known.
            Each table is drawn with random true sds, given such estimates.
    """
    count = -(-replicates // CHUNK)
    draws = problem.observe.draws(
        problem, jnp.asarray(z), linear, _replicate_keys(jnp.asarray(seed), count, replicates),
        _noise_factors(freedom, len(problem.channels), replicates, seed),
    )  # fmt: skip
    # Padded to whole batches by repeats, which are cut off later.
    draws = jax.tree.map(lambda x: np.resize(np.asarray(x), (count, CHUNK, *x.shape[1:])), draws)

    def part(k: int) -> Statistics:
        draws_of_part = jax.tree.map(lambda x: x[k], draws)
        return jax.device_get(_replicate_batch(problem, linear, effects, bases, draws_of_part))

    # The first batch compiles the program of the others; a batch keeps one core busy.
    with Threads(CORES) as cores:
        parts = [part(0), *cores.map(part, range(1, count))]
    statistics = jax.tree.map(lambda *x: np.concatenate(x)[:replicates], *parts)
    return jax.tree.map(lambda x: x[statistics.settled], statistics)


def _noise_factors(freedom: np.ndarray | None, channels: int, replicates: int, seed: int) -> np.ndarray:
    """True sds over estimated ones, √(ν / χ²_ν), shape (replicates, channels)."""
    factors = np.ones((replicates, channels))
    if freedom is not None:
        random = np.random.default_rng(seed)
        for k in np.flatnonzero(np.isfinite(freedom)):
            factors[:, k] = np.sqrt(freedom[k] / random.chisquare(freedom[k], replicates))
    return np.clip(factors, *UNSURE)


@functools.partial(compiled, options=SMALL)
def _replicate_batch(
    problem: Problem, linear: Linearization, effects: tuple[ScoredEffect, ...], bases: Bases, drawn: Any
) -> Statistics:
    """A batch of a bootstrap, from the observer's draws."""

    def one(drawn: Any) -> Statistics:
        replicate = problem.observe.replicate(problem, problem.data, effects, linear, drawn)
        return strongest_statistics(score_tests(replicate, bases), replicate)

    return jax.vmap(one)(drawn)
