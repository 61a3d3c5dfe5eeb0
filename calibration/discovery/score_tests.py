"""Tracing a residual: what every effect, and every smooth curve in a balance, could explain of it.

Everything is linear algebra at one fit. With whitened residuals e (readings, the limit on adhesion, priors),
their Jacobian J by the free parameters, and the signature g = ∂e/∂a of a candidate, what is left of g after
the free parameters have been fitted again is r = (I - P) g, P = J (JᵀJ)⁻¹ Jᵀ; its score is (r·e)² / ‖r‖², χ²
with one degree of freedom where nothing is missing (Rao 1948).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from calibration.data.runs import CHANNELS
from calibration.discovery.active_set import Scored
from calibration.inference import optimizers as fit
from calibration.inference.normal_equations import backward, cholesky, forward
from calibration.inference.problem import Data, Problem, Series
from mmrjax import balances, params
from mmrjax.effects import Effect
from mmrjax.fidelities.steady import operating_signals
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
        defects: by a defect of each balance of PROBED [its unit]: of settled rows each of its own, shape
            (balances, rows, 3); of histories at each knot of a run, shape (balances, runs, knots, samples, 3).
        signals: of every row, at the fit.
        series: how the rows of histories lie in time; None for settled rows.
        angle: of the driving shaft at every row of histories [rad]; None for settled rows.
    """

    residual: Float[Array, " residuals"]
    jacobian: Float[Array, "residuals coordinates"]
    signatures: Float[Array, "readings instances"]
    defects: Float[Array, "balances ..."]
    signals: Signals
    series: Series | None = None
    angle: Float[Array, " rows"] | None = None

    @property
    def rows(self) -> int:
        """How many rows there are."""
        return self.signatures.shape[0] // 3

    def columns(self, balance: Any, shapes: Float[Array, "rows terms"]) -> Float[Array, "readings terms"]:
        """Change of the whitened readings by defects of a balance, each a column over the rows (linear between
        knots in histories); `balance` an index into PROBED."""
        if self.series is None:
            return (self.defects[balance][:, :, None] * shapes[:, None, :]).reshape(-1, shapes.shape[1])
        rows = self.series.rows
        moved = jnp.einsum("rksc,rkt->rsct", self.defects[balance], shapes[self.series.knots])
        there = jnp.where(rows < 0, self.rows, rows)  # beyond the last row: dropped
        out = jnp.zeros((self.rows, 3, shapes.shape[1])).at[there].set(moved, mode="drop")
        return out.reshape(-1, shapes.shape[1])


def linearise(problem: Problem, z: Array, data: Data, candidates: tuple[Scored, ...]) -> Linear:
    """Residuals, Jacobian and signatures at z.

    In settled travel a signature is the sensitivity of the readings to a defect of the effect's balance,
    times its term: exact, as an effect enters one balance and is linear in its amplitude.
    """
    if isinstance(problem.observe, Series):
        return _linearise_series(problem, z, data, candidates)
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


def _linearise_series(problem: Problem, z: Array, data: Data, candidates: tuple[Scored, ...]) -> Linear:
    """As `linearise` for histories: effects that keep a memory act by the whole past of a run, so a signature is
    the derivative of the run by the amplitude. All effects are in one run, once for each point of the shapes'
    grids; those that are there already keep their shape."""
    observe = problem.observe
    residual, jacobian, _ = fit.linearised(problem, z, data)
    robot = problem.robot(z)
    have = {e.name for e in robot.effects}
    whole = dataclasses.replace(
        robot, effects=(*robot.effects, *(c.absent for c in candidates if c.effect.name not in have))
    )
    value = {p.name: p.value for p in params.walk(whole)}
    sds = jnp.stack([jnp.asarray(c.effect.amplitude) for c in candidates])

    def moved(point: Array) -> Array:
        def readings(a: Array) -> Array:
            put = {}
            for k, c in enumerate(candidates):
                amplitude = f"effects.{c.effect.name}.amplitude"
                put[amplitude] = value[amplitude] + a[k] * sds[k]
                if c.name:
                    shape = f"effects.{c.effect.name}.{c.name}"
                    wanted = jnp.asarray(c.values)[jnp.minimum(point, len(c.values) - 1)]
                    put[shape] = jnp.where(value[amplitude] == 0, wanted, value[shape])
            there = params.replace(whole, put)
            return problem.whitened(observe(there), data)[: data.measured.size]

        return jax.jacfwd(readings)(jnp.zeros(len(candidates)))

    by_point = jax.lax.map(moved, jnp.arange(max(len(c.at) for c in candidates)))
    parts = [by_point[j, :, k] for k, c in enumerate(candidates) for j in range(len(c.at))]
    defects = observe.defective(robot, tuple(_probe(b) for b in PROBED))
    scale = (data.weight / data.sd)[observe.rows]
    defects = jnp.where(observe.rows[:, None, :, None] < 0, 0.0, defects * scale[:, None])
    signatures = _finite(jnp.stack(parts, 1))
    runs = observe.whole(robot)
    signals, angle = observe.at_rows(runs), observe.angle(runs)
    return Linear(residual, jacobian, signatures, _finite(defects), signals, observe, angle)


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
    return jax.vmap(linear.columns)(jnp.asarray(curves.balance), curves.basis)


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
    """The strongest of each kind: |single|, pair [σ²], curve [normal deviate]; χ² of the residuals; memory of
    the residuals of histories, see `memory`; and whether the fit that left them is an optimum."""

    single: Array
    pair: Array
    curve: Array
    chi2: Array
    white: Array
    settled: Array


#: Lags of a run's residual that are looked at, at most a quarter of its samples.
LAGS = 12


def memory(linear: Linear) -> Array:
    """Whether residuals of histories remember: Ljung and Box's (1978) statistic over all runs, as a normal
    deviate, the largest of the channels; -inf for settled rows, whose order means nothing."""
    if linear.series is None:
        return jnp.asarray(-jnp.inf)
    rows = linear.series.rows
    x = jnp.where(rows[:, :, None] < 0, 0.0, linear.residual[: 3 * linear.rows].reshape(-1, 3)[rows])
    count = jnp.sum(rows >= 0, 1)[:, None]
    power = jnp.sum(x**2, 1)
    lags = min(LAGS, rows.shape[1] // 4)
    statistic = jnp.zeros(3)
    for k in range(1, lags + 1):
        r = jnp.sum(x[:, k:] * x[:, :-k], 1) / jnp.maximum(power, 1e-9)
        weight = jnp.where(count > k, count * (count + 2) / jnp.maximum(count - k, 1), 0.0)
        statistic = statistic + jnp.sum(weight * r**2, 0)
    freedom = jnp.maximum(jnp.sum(jnp.minimum(lags, count - 1)), 1)
    return jnp.max((statistic - freedom) / (2 * freedom) ** 0.5)


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
        memory(linear),
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
        object.__setattr__(self, "null_linear", eqx.filter_jit(self._null_linear))

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

    def _null_linear(self, linear: Linear, data: Data, curves: tuple[Curves, ...], keys: Array) -> Summary:
        jacobian = linear.jacobian
        lower = cholesky(jacobian.T @ jacobian)
        rows = linear.rows
        counts = jnp.concatenate([data.weight.ravel(), jnp.zeros(rows), jnp.ones(jacobian.shape[1])])

        def replicate(key: Array) -> Summary:
            noise = counts * jax.random.normal(key, counts.shape)
            left = noise - jacobian @ backward(lower, forward(lower, jacobian.T @ noise))
            there = dataclasses.replace(linear, residual=left)
            return strongest(score(there, curves), there)

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
    return Summary(single, float(np.max(np.asarray(scores.pair))), curve, -np.inf, -np.inf, True)  # type: ignore[arg-type]


_score_jit = eqx.filter_jit(score)


def bootstrap(null: Callable[[Array], Summary], replicates: int, seed: int, chunk: int = 64) -> Summary:
    """Statistics of `replicates` tables drawn from the fitted model and fitted again; shape (replicates,).

    A replicate draws readings with their sds, and the bench values too: a prior is a measurement made
    beforehand. Replicates whose refit did not settle are left out; there may be fewer than asked for.
    Histories have hundreds of readings a parameter and their refits stay where the model is linear: there the
    refit is the linear one.

    Args:
        null: of random keys, the statistics of as many replicates: `Tracer.null` or `Tracer.null_linear`.
    """
    count = -(-replicates // chunk)
    keys = jax.random.split(jax.random.key(seed), (count, chunk))
    parts = [jax.device_get(null(k)) for k in keys]
    whole = jax.tree.map(lambda *x: np.concatenate(x)[:replicates], *parts)
    return jax.tree.map(lambda x: x[whole.settled], whole)
