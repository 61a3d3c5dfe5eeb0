"""Least-squares solver of optimistix for residuals of two kinds: some count only if they are positive.

The objective is ½ Σ r² over the two-sided residuals and the positive one-sided ones. The solver is
Levenberg-Marquardt, built from optimistix's parts: a descent that determines which one-sided residuals are positive
at the end of its step, a trust region that predicts with them, and Anderson's mixing between the two. The
Levenberg-Marquardt method of optimistix needs the same residuals clipped at 0. Near the edge of a clipped residual
its linearisation predicts a gain that does not exist, and it then follows the edge in steps of 1e-4.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from calibration.data import Json
from mmrjax.numerics.linear_equations import solve

#: Rejected steps in a row after which a search ends.
PATIENCE = 12
#: Shares of the predicted decrease of the objective: below the first a step is rejected, above the second the next
#: may be longer. Factors of the length of the next step in these cases.
LITTLE, NEARLY_ALL = 0.01, 0.75
SHORTER, LONGER = 0.25, 3.5
#: Multiple of the objective up to which a rejected point corrects the slope.
TELLING = 4.0
#: Most iterations in which the one-sided residuals that are positive at the end of a step are determined.
TURNS = 8
#: Largest step that is mixed with the last one [prior sds], and the largest factor of that mixing.
NEAR, MIXED_MOST = 0.3, 10.0

Z = Float[Array, " parameters"]
#: Residual function of optimistix: from y and its arguments to residuals and auxiliary output.
Function = Callable[[Z, Any], tuple[Float[Array, " residuals"], Any]]


@jax.custom_jvp
def with_slope(y: Array, value: Array, slope: Array) -> Array:
    """Returns `value` with `slope` as its derivative with respect to y.

    Args:
        y: shape (n,).
        value: shape (m,).
        slope: shape (m, n).
    """
    return value


@with_slope.defjvp
def _slope(primals: tuple[Array, Array, Array], tangents: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    return primals[1], primals[2] @ tangents[0]


def linear_residual_function(value: Array, slope: Array, aux: Any = None) -> Function:
    """Returns a residual function with a known value and slope at the single point where it will be called."""
    return lambda y, args: (with_slope(y, value, slope), aux)


def zero_inactive_residuals(r: Array, jacobian: Array, one_sided: slice) -> tuple[Array, Array]:
    """Returns residuals and Jacobian with zeros for the one-sided residuals that are not positive."""
    counts = jnp.ones(r.shape, bool).at[one_sided].set(r[one_sided] > 0)
    return jnp.where(counts, r, 0.0), jnp.where(counts[:, None], jacobian, 0.0)


def half_squares(r: Array, one_sided: slice) -> Float[Array, ""]:
    """Returns the objective, half the sum of the squared residuals that count."""
    return 0.5 * jnp.sum(r.at[one_sided].set(jnp.maximum(r[one_sided], 0.0)) ** 2)


def one_sided_step(r: Array, jacobian: Array, one_sided: slice, damping: Array | float) -> Z:
    """Step to the optimum of a linearisation whose one-sided residuals count where they are positive.

    min_d ½ Σ (r + J d)² + ½ damping |d|², over the two-sided residuals and the one-sided ones that are positive at
    its end. These are found iteratively (a semismooth Newton method). A step that assumed the residuals positive at
    its start would cross a nearby edge, and predict a gain that does not exist.

    Args:
        r, jacobian: residuals and slopes, including those of negative one-sided residuals.
    """
    free = jacobian.at[one_sided].set(0.0)
    normal = free.T @ free + damping * jnp.eye(jacobian.shape[1])
    gradient, edge, height = free.T @ r, jacobian[one_sided], r[one_sided]

    def value(d: Array) -> Array:
        return half_squares(r + jacobian @ d, one_sided) + 0.5 * damping * jnp.sum(d**2)

    def again(carry: tuple) -> tuple:
        turns, active, _, best, lowest = carry
        counts = edge * active[:, None]
        d = -solve(normal + counts.T @ counts, gradient + counts.T @ height)
        beyond, values = height + edge @ d > 0, value(d)
        better = values < lowest
        return turns + 1, beyond, active, jnp.where(better, d, best), jnp.where(better, values, lowest)

    still = jnp.zeros(jacobian.shape[1])

    def differs(carry: tuple) -> Array:
        turns, active, before, _, _ = carry
        return (turns == 0) | (turns < TURNS) & jnp.any(active != before)

    start = jnp.asarray(0), height > 0, height > 0, still, jnp.asarray(jnp.inf)
    return jax.lax.while_loop(differs, again, start)[3]


class Linearisation(optx.FunctionInfo):
    """Residuals, one-sided ones with their signs, and their Jacobian.

    Attributes:
        first, last: the one-sided residuals are those from `first` up to `last`.
    """

    residual: Float[Array, " residuals"]
    jacobian: Float[Array, "residuals parameters"]
    first: int = eqx.field(static=True)
    last: int = eqx.field(static=True)

    @property
    def one_sided(self) -> slice:
        """Slice of the one-sided residuals."""
        return slice(self.first, self.last)

    @property
    def positive(self) -> Bool[Array, " one_sided"]:
        """True for the one-sided residuals that count."""
        return self.residual[self.one_sided] > 0

    @property
    def counting(self) -> Float[Array, " residuals"]:
        """Residuals with zeros for the one-sided ones that do not count."""
        return self.residual.at[self.one_sided].set(jnp.where(self.positive, self.residual[self.one_sided], 0.0))

    def as_min(self) -> Float[Array, ""]:
        return half_squares(self.residual, self.one_sided)


class OneSidedDescent(optx.AbstractDescent[Z, Linearisation, Linearisation]):
    """Damped Newton steps of the linearisation, with those one-sided residuals that are positive after the step."""

    def init(self, y: Z, f_info_struct: Linearisation) -> Linearisation:
        return f_info_struct

    def query(self, y: Z, f_info: Linearisation, state: Linearisation) -> Linearisation:
        return f_info

    def step(self, step_size: Array, state: Linearisation) -> tuple[Z, optx.RESULTS]:
        tiny = jnp.finfo(step_size.dtype)
        damping = jnp.where(step_size > tiny.eps, 1 / jnp.maximum(step_size, tiny.eps), tiny.max)
        return one_sided_step(state.residual, state.jacobian, state.one_sided, damping), optx.RESULTS.successful  # type: ignore[return-value]  # an enumeration of equinox's


class OneSidedTrustRegion(optx.ClassicalTrustRegion):
    """Classical trust region (Conn, Gould, Toint 2000, alg. 6.1.1) for partly one-sided residuals."""

    high_cutoff: float = NEARLY_ALL
    low_cutoff: float = LITTLE
    high_constant: float = LONGER
    low_constant: float = SHORTER

    def predict_reduction(self, y_diff: Z, f_info: Linearisation) -> Array:
        """Returns the predicted change of the objective for a step, negative or 0. A mixed step may have a predicted
        rise, for which this is 0."""
        ahead = half_squares(f_info.residual + f_info.jacobian @ y_diff, f_info.one_sided)
        return jnp.minimum(ahead - f_info.as_min(), 0.0)


def mixed_step(stride: Z, moved: Z, changed: Z) -> Z:
    """Returns a step corrected by the change of the linearised step since the last point.

    Gauss-Newton steps converge only linearly if residuals are large compared with their curvature.
    Anderson's mixing (D. G. Anderson, J. ACM 12 (1965)) of depth one is a secant in that direction:
    d - θ (Δy + Δd), θ = d·Δd / |Δd|².

    Args:
        stride: d, the step of the linearisation at y.
        moved: Δy, from the point before.
        changed: Δd, from the stride there.
    """
    share = stride @ changed / jnp.maximum(changed @ changed, jnp.finfo(stride.dtype).tiny)
    return stride - jnp.clip(share, -MIXED_MOST, MIXED_MOST) * (moved + changed)


class Searching(eqx.Module):
    """State of a search between two steps. y, the best point so far, is kept by the caller of the solver.

    Attributes:
        found: linearisation at y.
        slope: Jacobian of the next step, which rejected steps have corrected.
        aux: auxiliary output of its evaluation.
        stride: step of the linearisation there.
        ahead: point of the next evaluation.
        mixed: True if `mixed_step` leads there.
        region: state of the trust region.
        steps: evaluations so far.
        rejected: evaluations since y was found.
        over: True if the search has ended.
    """

    found: Linearisation
    slope: Float[Array, "residuals parameters"]
    aux: Any
    stride: Z
    ahead: Z
    mixed: Bool[Array, ""]
    region: Any
    steps: Int[Array, ""]
    rejected: Int[Array, ""]
    over: Bool[Array, ""]


class OneSidedLevenbergMarquardt(optx.AbstractLeastSquaresSolver[Z, Array, Any, Searching]):
    """Levenberg-Marquardt for partly one-sided residuals. Evaluates the function once a step.

    A step is rejected, and the next one shortened, if the objective falls by less than `LITTLE` of the prediction.
    The next one may be longer if it falls by `NEARLY_ALL` of it. A `mixed_step` has to leave the same one-sided
    residuals positive. After a rejected one the step of the linearisation alone is tried. A search ends if an
    accepted step changes neither y nor any residual by more than the tolerances, or after `PATIENCE` rejected steps
    in a row. Each of those is a quarter of the one before, so that only rounding is left to gain (or a rollout's
    tolerance).

    Attributes:
        rtol, atol, norm: of the last step, as of optimistix's solvers.
        first, last: the one-sided residuals are those from `first` up to `last`. The function returns them with their
            signs.
        near: largest step that is mixed with the last one, `NEAR`, 0 for none.
        rough: True for residuals with kinks, such as those of rollouts in which a load stops. A rejected step then
            corrects the slope in its direction (Broyden, Math. Comp. 19 (1965)), and the next one is at most half as
            long in it.
    """

    rtol: float
    atol: float
    first: int = eqx.field(static=True, default=0)
    last: int = eqx.field(static=True, default=0)
    near: float = NEAR
    rough: bool = eqx.field(static=True, default=False)
    norm: Callable[[Any], Array] = eqx.field(static=True, default=optx.max_norm)
    descent: OneSidedDescent = OneSidedDescent()
    search: OneSidedTrustRegion = OneSidedTrustRegion()

    def _linearised(self, fn: Function, y: Z, args: Any) -> tuple[Linearisation, Any]:
        residual, slope, aux = jax.linearize(lambda y: fn(y, args), y, has_aux=True)
        jacobian = jax.vmap(slope, out_axes=-1)(jnp.eye(y.size, dtype=y.dtype))
        return Linearisation(residual, jacobian, self.first, self.last), aux

    def init(
        self, fn: Function, y: Z, args: Any, options: Json, f_struct: Any, aux_struct: Any, tags: frozenset
    ) -> Searching:
        """Returns the state of a search that has evaluated nothing yet."""
        none, no, still = jnp.asarray(0), jnp.asarray(False), jnp.zeros_like(y)
        jacobian = jnp.zeros((f_struct.size, y.size), f_struct.dtype)
        unevaluated = Linearisation(jnp.zeros(f_struct.shape, f_struct.dtype), jacobian, self.first, self.last)
        aux = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), aux_struct)
        return Searching(unevaluated, jacobian, aux, still, y, no, self.search.init(y, unevaluated), none, none, no)

    def step(
        self, fn: Function, y: Z, args: Any, options: Json, state: Searching, tags: frozenset
    ) -> tuple[Z, Searching, Any]:
        """Evaluates the function at the end of the last step, accepts or rejects that step, and finds the next."""
        linearised, aux = self._linearised(fn, state.ahead, args)
        moved, first, before = (
            state.ahead - y,
            state.steps == 0,
            dataclasses.replace(state.found, jacobian=state.slope),
        )
        _, accepted, _, region = self.search.step(first, y, state.ahead, before, linearised, state.region)
        alike = jnp.all(linearised.positive == before.positive)
        accepted &= first | alike | ~state.mixed
        region = _where(state.mixed & ~accepted, state.region, region)
        ended = self._is_small(state.ahead, moved, linearised, before) & accepted

        corrected = state.slope
        if self.rough:
            least = jnp.finfo(y.dtype).tiny
            along, length = corrected @ moved, jnp.maximum(moved @ moved, least)
            missed = linearised.residual - before.residual - along
            near = (state.steps > 0) & (linearised.as_min() < TELLING * before.as_min())
            corrected = jnp.where(near, corrected + jnp.outer(missed, moved) / length, corrected)
            half = jnp.minimum(region.step_size, length / jnp.maximum(along @ along, least))
            region = _where(accepted | state.mixed, region, dataclasses.replace(region, step_size=half))
        slope = jnp.where(accepted, linearised.jacobian, corrected)
        y, best, aux = _where(accepted, (state.ahead, linearised, aux), (y, state.found, state.aux))
        ahead_of = dataclasses.replace(best, jacobian=slope)
        stride, _ = self.descent.step(region.step_size, self.descent.query(y, ahead_of, ahead_of))
        mixed = accepted & alike & (state.steps > 1) & (jnp.max(jnp.abs(stride)) < self.near)
        ahead = y + jnp.where(mixed, mixed_step(stride, moved, stride - state.stride), stride)
        rejected = jnp.where(accepted, 0, state.rejected + 1)
        over = ended | (rejected >= PATIENCE)
        new = Searching(best, slope, aux, stride, ahead, mixed, region, state.steps + 1, rejected, over)
        return y, new, aux

    def _is_small(self, y: Z, moved: Z, found: Linearisation, before: Linearisation) -> Array:
        """True if a step changed neither y nor any residual that counts by more than the tolerances."""
        changed = found.counting - before.counting
        return (self.norm(moved / (self.atol + self.rtol * jnp.abs(y))) < 1) & (
            self.norm(changed / (self.atol + self.rtol * jnp.abs(found.residual))) < 1
        )

    def terminate(
        self, fn: Function, y: Z, args: Any, options: Json, state: Searching, tags: frozenset
    ) -> tuple[Array, optx.RESULTS]:
        """True if the search has ended."""
        return state.over, optx.RESULTS.successful  # type: ignore[return-value]  # an enumeration of equinox's

    def postprocess(
        self,
        fn: Function,
        y: Z,
        aux: Any,
        args: Any,
        options: Json,
        state: Searching,
        tags: frozenset,
        result: optx.RESULTS,
    ) -> tuple[Z, Any, Json]:
        """Returns the best point, the auxiliary output of its evaluation, and no statistics."""
        return y, aux, {}


def _where(chosen: Array, a: Any, b: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(chosen, a, b), a, b)
