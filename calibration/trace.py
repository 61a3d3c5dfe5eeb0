"""Tracing a residual: what every effect, and every smooth curve in a balance, could explain of it.

Everything is linear algebra at one fit. With whitened residuals e (readings, the limit on adhesion, priors),
their Jacobian J by the free parameters, and the signature g = ∂e/∂a of a candidate, what is left of g after
the free parameters have been fitted again is r = (I - P) g, P = J (JᵀJ)⁻¹ Jᵀ; its score is (r·e)² / ‖r‖², χ²
with one degree of freedom where nothing is missing (Rao 1948).
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from calibration import fit
from calibration.normal import backward, cholesky, forward
from calibration.problem import Data, Problem, Settled
from calibration.records import CHANNELS
from calibration.slots import Scored
from mmrjax import balances
from mmrjax.effects import Effect
from mmrjax.models.steady import operating_signals
from mmrjax.params import Scalar, parameter
from mmrjax.robot import Robot
from mmrjax.signals import Signals

#: Balances whose defect moves the readings of settled travel. Those of a line act alike on the readings, but
#: for what they depend on: three channels close three equations.
PROBED = ("mass", "supply", "electrical", "motor", "gearbox", "track", "ground", "slip")
#: Share of a signature's norm below which the free parameters explain it all.
ABSORBED = 1e-3


def _probe(balance: str) -> Effect:
    """An effect that adds its amplitude to a balance."""

    class Probe(Effect):
        name: ClassVar[str] = f"probe_{balance}"
        dissipative: ClassVar[bool] = False
        amplitude: Scalar = parameter(
            0.0, unit="", meaning="defect", bounds=(-1e9, 1e9), sd=1.0, source="", amplitude=True
        )

        def term(self, robot: Robot, signals: Signals) -> Scalar:
            return self.amplitude

    Probe.balance = balance  # type: ignore[attr-defined]
    return Probe()


class Linear(eqx.Module):
    """A fit, linearised.

    Attributes:
        residual: whitened residuals, shape (residuals,): readings (3 a row), adhesion (1 a row), priors.
        jacobian: by the free coordinates, shape (residuals, coordinates).
        signatures: by each instance's amplitude in prior sds, shape (3 rows, instances).
        defects: by a defect of each balance of PROBED [its unit], shape (balances, rows, 3).
        signals: of every row, at the fit; None for histories.
    """

    residual: Float[Array, " residuals"]
    jacobian: Float[Array, "residuals coordinates"]
    signatures: Float[Array, "readings instances"]
    defects: Float[Array, "balances rows 3"]
    signals: Signals | None


def linearise(problem: Problem, z: Array, data: Data, candidates: tuple[Scored, ...]) -> Linear:
    """Residuals, Jacobian and signatures at z.

    In settled travel a signature is the sensitivity of the readings to a defect of the effect's balance,
    times its term: exact, as an effect enters one balance and is linear in its amplitude.
    """
    if not isinstance(problem.observe, Settled):
        return _linearise_rollout(problem, z, data, candidates)
    probes = tuple(_probe(b) for b in PROBED)
    robot = problem.robot(z)

    def whitened(x: Array) -> Array:
        z, delta = x[: z0.size], x[z0.size :]
        there = problem.robot(z)
        put = tuple(eqx.tree_at(lambda e: e.amplitude, p, d) for p, d in zip(probes, delta, strict=True))
        there = dataclasses.replace(there, effects=(*there.effects, *put))
        return jnp.concatenate([problem.whitened(problem.observe(there), data), z - data.centre])

    z0 = z
    jacobian, residual = jax.jacfwd(lambda x: (whitened(x),) * 2, has_aux=True)(
        jnp.concatenate([z, jnp.zeros(len(probes))])
    )
    rows = data.measured.shape[0]
    defects = jacobian[: 3 * rows, z.size :].reshape(rows, 3, len(probes)).transpose(2, 0, 1)
    signals = jax.vmap(lambda c: operating_signals(robot, c))(problem.observe.commands)
    scale = data.weight / data.sd

    def signature(effect: Effect) -> Array:
        alone = dataclasses.replace(robot, effects=(effect,))
        term = jax.vmap(lambda s: balances.added(alone, s, effect.balance, effect.channel))(signals)
        term = jnp.broadcast_to(term, (rows,))
        if effect.balance == "sensor":
            moved = term[:, None] * (jnp.arange(3) == CHANNELS.index(effect.channel)) * scale
        elif effect.balance in PROBED:
            moved = term[:, None] * defects[PROBED.index(effect.balance)]
        else:
            moved = jnp.zeros((rows, 3))
        return moved.ravel()

    signatures = jnp.concatenate([c.each(signature) for c in candidates]).T
    return Linear(residual, jacobian[:, : z.size], _finite(signatures), defects, signals)


def _linearise_rollout(problem: Problem, z: Array, data: Data, candidates: tuple[Scored, ...]) -> Linear:
    """As `linearise` for histories: signatures by differentiating the rollout in every amplitude."""

    def moved(effect: Effect) -> Array:
        robot = problem.robot(z)
        kept = tuple(e for e in robot.effects if e.name != effect.name)

        def readings(amplitude: Array) -> Array:
            put = eqx.tree_at(lambda e: e.amplitude, effect, amplitude * effect.amplitude)
            there = dataclasses.replace(robot, effects=(*kept, put))
            return problem.whitened(problem.observe(there), data)[: data.measured.size]

        return jax.jvp(readings, (jnp.zeros(()),), (jnp.ones(()),))[1]

    function = fit.residuals(problem, data, fit.no_pin(z.size))
    jacobian, residual = jax.jacfwd(lambda x: (function(x),) * 2, has_aux=True)(z)
    signatures = jnp.concatenate([c.each(moved) for c in candidates]).T
    rows = data.measured.shape[0]
    return Linear(residual, jacobian, _finite(signatures), jnp.zeros((len(PROBED), rows, 3)), None)


def _finite(x: Array) -> Array:
    return jnp.where(jnp.isfinite(x), x, 0.0)


class Curves(eqx.Module):
    """Families of smooth curves: a defect of one balance as a combination of columns over the rows.

    All families of one `Curves` have as many columns.

    Attributes:
        basis: columns of each family, shape (families, rows, terms).
        balance: index into PROBED of each family.
        names: (balance, variable) of each family.
    """

    basis: Float[Array, "families rows terms"]
    balance: tuple[int, ...] = eqx.field(static=True)
    names: tuple[tuple[str, str], ...] = eqx.field(static=True)


class Scores(eqx.Module):
    """What candidates could explain of a residual.

    Attributes:
        single: signed root of each instance's score, -(r·e)/‖r‖, shape (instances,); amplitude: -(r·e)/‖r‖²,
            in prior sds; left: ‖r‖, the sigmas that a prior sd leaves.
        pair: scores of pairs of instances (χ² with two degrees of freedom), shape (instances, instances);
            zero where the two can't be told apart; cosine: between what is left of two signatures.
        curve: of each family, as a normal deviate, shape (families,); explained: its ridge score [σ²].
        row: signed root of the score of a shift of each reading alone, shape (rows, 3).
    """

    single: Float[Array, " instances"]
    amplitude: Float[Array, " instances"]
    left: Float[Array, " instances"]
    pair: Float[Array, "instances instances"]
    cosine: Float[Array, "instances instances"]
    curve: Float[Array, " families"]
    explained: Float[Array, " families"]
    row: Float[Array, "rows 3"]


def _projected(linear: Linear, columns: Array) -> tuple[Array, Array, Array]:
    """What is left of columns over the readings: their products with e, the part Lᵀ in the fit, and L."""
    jacobian = linear.jacobian
    readings = columns.shape[0]
    lower = cholesky(jacobian.T @ jacobian)
    inside = forward(lower, jacobian[:readings].T @ columns)
    e = linear.residual
    dots = columns.T @ e[:readings] - inside.T @ forward(lower, jacobian.T @ e)
    return dots, inside, lower


def curve_columns(linear: Linear, curves: Curves) -> Float[Array, "families readings terms"]:
    """Signatures of every curve's columns."""
    defects = linear.defects[jnp.asarray(curves.balance)]  # families, rows, 3
    columns = defects[..., None] * curves.basis[:, :, None, :]
    return columns.reshape(columns.shape[0], -1, columns.shape[-1])


def score(linear: Linear, curves: tuple[Curves, ...]) -> Scores:
    """Scores of every instance, pair, curve and reading."""
    g = linear.signatures
    dots, inside, lower = _projected(linear, g)
    whole = jnp.sum(g**2, 0)
    products = g.T @ g - inside.T @ inside
    norm2 = jnp.maximum(jnp.diag(products), 0.0)
    seen = norm2 > ABSORBED**2 * jnp.maximum(whole, 1e-300)
    norm = jnp.sqrt(jnp.where(seen, norm2, 1.0))
    single = jnp.where(seen, -dots / norm, 0.0)
    both_seen = seen[:, None] & seen
    cosine = jnp.where(both_seen, products / (norm[:, None] * norm), 0.0)
    apart = jnp.where(both_seen, 1 - cosine**2, 0.0)
    both = (single[:, None] ** 2 + single**2 - 2 * cosine * single[:, None] * single) / jnp.maximum(apart, 1e-9)
    pair = jnp.where(apart > 1e-2, both, 0.0)

    readings = g.shape[0]
    jacobian, e = linear.jacobian[:readings], linear.residual
    half = forward(lower, jacobian.T)
    leverage = jnp.sum(half**2, 0)
    fitted = e[:readings] - half.T @ forward(lower, linear.jacobian.T @ e)
    row = jnp.where(leverage < 1 - 1e-6, fitted / jnp.sqrt(jnp.maximum(1 - leverage, 1e-12)), 0.0)

    found = [jax.vmap(lambda c: _curve_score(linear, c))(curve_columns(linear, family)) for family in curves]
    deviate, explained = (jnp.concatenate([f[k] for f in found] or [jnp.zeros(0)]) for k in (0, 1))
    amplitude = jnp.where(seen, -dots / norm**2, 0.0)
    return Scores(single, amplitude, jnp.sqrt(norm2), pair, cosine, deviate, explained, row.reshape(-1, 3))


def _curve_score(linear: Linear, columns: Array) -> tuple[Array, Array]:
    """(rᵀe)ᵀ (rᵀr + I)⁻¹ (rᵀe), and the same as a normal deviate.

    The columns are scaled so that each by itself leaves ten sigmas: a prior that the discrepancy is of such a size.
    """
    dots, inside, _ = _projected(linear, columns)
    products = columns.T @ columns - inside.T @ inside
    norm2 = jnp.diag(products)
    seen = norm2 > ABSORBED**2 * jnp.maximum(jnp.sum(columns**2, 0), 1e-300)
    scale = jnp.where(seen, 10.0 / jnp.sqrt(jnp.where(seen, norm2, 1.0)), 0.0)
    products = products * scale[:, None] * scale
    dots = dots * scale
    lower = cholesky(products + jnp.eye(dots.size))
    half = forward(lower, dots)
    explained = jnp.sum(half**2)
    # E = tr(A (A + I)⁻¹) under the null: degrees of freedom, then Wilson and Hilferty (1931).
    freedom = dots.size - jnp.sum(forward(lower, jnp.eye(dots.size)) ** 2)
    freedom = jnp.maximum(freedom, 1e-3)
    spread = 2 / (9 * freedom)
    deviate = ((explained / freedom) ** (1 / 3) - (1 - spread)) / jnp.sqrt(spread)
    return deviate, explained


class Summary(eqx.Module):
    """The strongest of each kind: |single|, pair [σ²], curve [normal deviate]; χ² of the residuals; and whether
    the fit that left them is an optimum."""

    single: Array
    pair: Array
    curve: Array
    chi2: Array
    settled: Array


#: Fall of the objective [½σ²] that a refit may still predict for its statistics to count.
UNSETTLED = 0.05


def strongest(scores: Scores, linear: Linear) -> Summary:
    """The largest statistics of a table; what a bootstrap draws the distribution of."""
    e, jacobian = linear.residual, linear.jacobian
    decrement = 0.5 * jnp.sum(forward(cholesky(jacobian.T @ jacobian), jacobian.T @ e) ** 2)
    return Summary(
        jnp.max(jnp.abs(scores.single)),
        jnp.max(scores.pair),
        jnp.max(scores.curve),
        jnp.sum(e**2),
        decrement < UNSETTLED,
    )


def gauss_newton(problem: Problem, z: Array, data: Data, steps: int) -> Array:
    """A few Gauss-Newton steps: the refit of a replicate whose truth is the start."""
    function = fit.residuals(problem, data, fit.no_pin(z.shape[0]))

    def step(_: Any, z: Array) -> Array:
        jacobian, r = jax.jacfwd(lambda x: (function(x),) * 2, has_aux=True)(z)
        lower = cholesky(jacobian.T @ jacobian)
        move = backward(lower, forward(lower, jacobian.T @ r))
        move = jnp.where(jnp.all(jnp.isfinite(move)), move, 0.0)
        return z - move * jnp.minimum(1.0, 3.0 / jnp.maximum(jnp.linalg.norm(move), 1e-9))

    return jax.lax.fori_loop(0, steps, step, z)


@dataclasses.dataclass(frozen=True)
class Tracer:
    """The compiled parts of a trace for one library.

    Attributes:
        candidates: instances of the library that are scored.
        steps: Gauss-Newton steps of a replicate's refit.
    """

    candidates: tuple[Scored, ...]
    steps: int = 4

    def __post_init__(self) -> None:
        object.__setattr__(self, "look", eqx.filter_jit(self._look))
        object.__setattr__(self, "null", eqx.filter_jit(self._null))

    def _look(
        self, problem: Problem, z: Array, data: Data, curves: tuple[Curves, ...]
    ) -> tuple[Linear, Scores, Summary]:
        linear = linearise(problem, z, data, self.candidates)
        scores = score(linear, curves)
        return linear, scores, strongest(scores, linear)

    def _null(self, problem: Problem, z: Array, data: Data, curves: tuple[Curves, ...], keys: Array) -> Summary:
        clean = problem.observation(z).reading

        def replicate(key: Array) -> Summary:
            one, two = jax.random.split(key)
            noisy = dataclasses.replace(
                data,
                measured=clean + data.sd * jax.random.normal(one, clean.shape),
                centre=z + jax.random.normal(two, z.shape),
            )
            there = gauss_newton(problem, z, noisy, self.steps)
            linear = linearise(problem, there, noisy, self.candidates)
            return strongest(score(linear, curves), linear)

        return jax.vmap(replicate)(keys)


def beside_curve(linear: Linear, curves: tuple[Curves, ...], chosen: int) -> Summary:
    """The strongest statistics that are left once the curves of one family are fitted with the free parameters.

    Args:
        chosen: index of the family, in the order of `Scores.curve`.
    """
    linear = jax.tree.map(jnp.asarray, linear)
    extra = [np.asarray(c) for family in curves for c in curve_columns(linear, family)][chosen]
    norm = np.linalg.norm(extra, axis=0)
    extra = extra[:, norm > 0] / norm[norm > 0] * 30.0  # a wide prior, which keeps its rank
    jacobian = np.asarray(linear.jacobian)
    readings, total, wide = extra.shape[0], jacobian.shape[0], extra.shape[1]
    whole = np.zeros((total + wide, jacobian.shape[1] + wide))
    whole[:total, : jacobian.shape[1]] = jacobian
    whole[:readings, jacobian.shape[1] :] = extra
    whole[total:, jacobian.shape[1] :] = np.eye(wide)
    padded = dataclasses.replace(
        linear, jacobian=jnp.asarray(whole), residual=jnp.concatenate([linear.residual, jnp.zeros(wide)])
    )
    scores = _score_jit(padded, curves)
    balances = np.array([n[0] for f in curves for n in f.names])
    others = balances != balances[chosen]
    curve = float(np.max(np.asarray(scores.curve)[others], initial=-np.inf))
    single = float(np.max(np.abs(np.asarray(scores.single))))
    return Summary(single, float(np.max(np.asarray(scores.pair))), curve, -np.inf, True)  # type: ignore[arg-type]


_score_jit = eqx.filter_jit(score)


def bootstrap(
    tracer: Tracer,
    problem: Problem,
    z: Array,
    data: Data,
    curves: tuple[Curves, ...],
    replicates: int,
    seed: int,
    chunk: int = 64,
) -> Summary:
    """Statistics of `replicates` tables drawn from the fitted model and fitted again; shape (replicates,).

    A replicate draws readings with their sds, and the bench values too: a prior is a measurement made
    beforehand. Replicates whose refit did not settle are left out; there may be fewer than asked for.
    """
    count = -(-replicates // chunk)
    keys = jax.random.split(jax.random.key(seed), (count, chunk))
    parts = [jax.device_get(tracer.null(problem, z, data, curves, k)) for k in keys]  # type: ignore[attr-defined]
    whole = jax.tree.map(lambda *x: np.concatenate(x)[:replicates], *parts)
    return jax.tree.map(lambda x: x[whole.settled], whole)
