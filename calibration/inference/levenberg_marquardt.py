"""Least-squares solver for optimistix in which some residuals are one-sided: they count only while they are positive.

The objective is ½ Σ r² over the two-sided residuals and the positive one-sided ones. The solver is
Levenberg-Marquardt, built from optimistix's parts. Its descent determines which one-sided residuals are positive at
the end of its step. A trust region predicts with them, and Anderson's mixing acts between the two. The
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
def with_derivative(y: Array, value: Array, slope: Array) -> Array:
    """Returns `value` with `slope` as its derivative with respect to y.

    Args:
        y: shape (n,).
        value: shape (m,).
        slope: shape (m, n).
    """
    return value


@with_derivative.defjvp
def _slope(primals: tuple[Array, Array, Array], tangents: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    return primals[1], primals[2] @ tangents[0]


def linear_residual_function(value: Array, slope: Array, aux: Any = None) -> Function:
    """Residual function with a known value and derivative at the single point where it will be called."""
    return lambda y, args: (with_derivative(y, value, slope), aux)


def zero_inactive_residuals(r: Array, jacobian: Array, one_sided: slice) -> tuple[Array, Array]:
    """Residuals and Jacobian with zeros for one-sided residuals that are not positive."""
    counts = jnp.ones(r.shape, bool).at[one_sided].set(r[one_sided] > 0)
    return jnp.where(counts, r, 0.0), jnp.where(counts[:, None], jacobian, 0.0)


def half_squares(r: Array, one_sided: slice) -> Float[Array, ""]:
    """Objective: half the sum of squares of the residuals that count."""
    return 0.5 * jnp.sum(r.at[one_sided].set(jnp.maximum(r[one_sided], 0.0)) ** 2)


def one_sided_step(r: Array, jacobian: Array, one_sided: slice, damping: Array | float) -> Z:
    """Step to the optimum of a linearised problem in which one-sided residuals count only while they are positive.

    min_d ½ Σ (r + J d)² + ½ damping |d|², over the two-sided residuals and those one-sided ones that are positive
    after the step. These are found iteratively (semismooth Newton method). A step that kept the set of positive
    residuals from its start would cross a nearby edge and predict a gain that does not exist.

    Args:
        r, jacobian: residuals and derivatives, including those of negative one-sided residuals.
    """
    free = jacobian.at[one_sided].set(0.0)
    normal = free.T @ free + damping * jnp.eye(jacobian.shape[1])
    gradient, edge, height = free.T @ r, jacobian[one_sided], r[one_sided]

    def value(d: Array) -> Array:
        return half_squares(r + jacobian @ d, one_sided) + 0.5 * damping * jnp.sum(d**2)

    def iterate(carry: tuple) -> tuple:
        turns, active, _, best, lowest = carry
        counts = edge * active[:, None]
        d = -solve(normal + counts.T @ counts, gradient + counts.T @ height)
        beyond, values = height + edge @ d > 0, value(d)
        better = values < lowest
        return turns + 1, beyond, active, jnp.where(better, d, best), jnp.where(better, values, lowest)

    zero_step = jnp.zeros(jacobian.shape[1])

    def has_changed(carry: tuple) -> Array:
        turns, active, before, _, _ = carry
        return (turns == 0) | (turns < TURNS) & jnp.any(active != before)

    start = jnp.asarray(0), height > 0, height > 0, zero_step, jnp.asarray(jnp.inf)
    return jax.lax.while_loop(has_changed, iterate, start)[3]


class SolverLinearisation(optx.FunctionInfo):
    """Residuals (one-sided ones with their signs) and their Jacobian at a point of the search.

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
        """True for one-sided residuals that count, because they are positive."""
        return self.residual[self.one_sided] > 0

    @property
    def active_residuals(self) -> Float[Array, " residuals"]:
        """Residuals, with zeros for inactive one-sided ones."""
        return self.residual.at[self.one_sided].set(jnp.where(self.positive, self.residual[self.one_sided], 0.0))

    def as_min(self) -> Float[Array, ""]:
        return half_squares(self.residual, self.one_sided)


class OneSidedDescent(optx.AbstractDescent[Z, SolverLinearisation, SolverLinearisation]):
    """Damped Newton steps of the linearised problem, with the one-sided residuals that are positive after the
    step.
    """

    def init(self, y: Z, f_info_struct: SolverLinearisation) -> SolverLinearisation:
        return f_info_struct

    def query(self, y: Z, f_info: SolverLinearisation, state: SolverLinearisation) -> SolverLinearisation:
        return f_info

    def step(self, step_size: Array, state: SolverLinearisation) -> tuple[Z, optx.RESULTS]:
        tiny = jnp.finfo(step_size.dtype)
        damping = jnp.where(step_size > tiny.eps, 1 / jnp.maximum(step_size, tiny.eps), tiny.max)
        return one_sided_step(state.residual, state.jacobian, state.one_sided, damping), optx.RESULTS.successful  # type: ignore[return-value]  # an enumeration of equinox's


class OneSidedTrustRegion(optx.ClassicalTrustRegion):
    """Classical trust region (Conn, Gould, Toint 2000, alg. 6.1.1) for residuals that are partly one-sided."""

    high_cutoff: float = NEARLY_ALL
    low_cutoff: float = LITTLE
    high_constant: float = LONGER
    low_constant: float = SHORTER

    def predict_reduction(self, y_diff: Z, f_info: SolverLinearisation) -> Array:
        """Predicted change of the objective by a step, negative or 0. A mixed step whose prediction is a rise counts
        as 0.
        """
        predicted_objective = half_squares(f_info.residual + f_info.jacobian @ y_diff, f_info.one_sided)
        return jnp.minimum(predicted_objective - f_info.as_min(), 0.0)


def mixed_step(stride: Z, moved: Z, changed: Z) -> Z:
    """A step, corrected by the change of the linearised step since the previous point.

    Gauss-Newton converges only linearly if residuals are large compared with their curvature. Anderson mixing of
    depth one (D. G. Anderson, J. ACM 12 (1965)) acts as a secant in that direction: d - θ (Δy + Δd), θ = d·Δd /
    |Δd|².

    Args:
        stride: d, linearised step at y.
        moved: Δy, last change of y.
        changed: Δd, change of the linearised step.
    """
    share = stride @ changed / jnp.maximum(changed @ changed, jnp.finfo(stride.dtype).tiny)
    return stride - jnp.clip(share, -MIXED_MOST, MIXED_MOST) * (moved + changed)


class SearchState(eqx.Module):
    """State of a search between two steps. The caller of the solver keeps y, the best point so far.

    Attributes:
        found: linearisation at y.
        slope: Jacobian for the next step, corrected by rejected steps.
        aux: auxiliary output of its evaluation.
        stride: linearised step at y.
        ahead: point of the next evaluation.
        mixed: True if `mixed_step` leads to that point.
        region: state of the trust region.
        steps: number of evaluations so far.
        rejected: number of evaluations since y was found.
        over: True if the search has ended.
    """

    found: SolverLinearisation
    slope: Float[Array, "residuals parameters"]
    aux: Any
    stride: Z
    ahead: Z
    mixed: Bool[Array, ""]
    region: Any
    steps: Int[Array, ""]
    rejected: Int[Array, ""]
    over: Bool[Array, ""]


class OneSidedLevenbergMarquardt(optx.AbstractLeastSquaresSolver[Z, Array, Any, SearchState]):
    """Levenberg-Marquardt for residuals that are partly one-sided. It evaluates the function once per step.

    A step is rejected, and the next one shortened, if the objective falls by less than `LITTLE` of the prediction. If
    it falls by at least `NEARLY_ALL` of it, the next step may be longer. A `mixed_step` must keep the same one-sided
    residuals positive. If it is rejected, the linearised step is tried alone. A search ends if an accepted step
    changes neither y nor any residual by more than the tolerances, or after `PATIENCE` rejected steps in a row. Each
    of these is a quarter of the previous one, so only rounding errors (or the tolerance of a rollout) are left.

    Attributes:
        rtol, atol, norm: tolerances and norm of the last step, as in optimistix.
        first, last: the residuals from `first` up to `last` are one-sided. The function returns them with their
            signs.
        near: largest step that is mixed with the previous one, `NEAR`. 0: no mixing.
        rough: True for residuals with kinks, such as those of rollouts in which a load stops. A rejected step then
            corrects the Jacobian in its direction (Broyden, Math. Comp. 19 (1965)), and the next step is at most half
            as long in that direction.
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

    def _linearised(self, fn: Function, y: Z, args: Any) -> tuple[SolverLinearisation, Any]:
        residual, slope, aux = jax.linearize(lambda y: fn(y, args), y, has_aux=True)
        jacobian = jax.vmap(slope, out_axes=-1)(jnp.eye(y.size, dtype=y.dtype))
        return SolverLinearisation(residual, jacobian, self.first, self.last), aux

    def init(
        self, fn: Function, y: Z, args: Any, options: Json, f_struct: Any, aux_struct: Any, tags: frozenset
    ) -> SearchState:
        """State of a search before its first evaluation."""
        none, no, still = jnp.asarray(0), jnp.asarray(False), jnp.zeros_like(y)
        jacobian = jnp.zeros((f_struct.size, y.size), f_struct.dtype)
        unevaluated = SolverLinearisation(jnp.zeros(f_struct.shape, f_struct.dtype), jacobian, self.first, self.last)
        aux = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), aux_struct)
        return SearchState(unevaluated, jacobian, aux, still, y, no, self.search.init(y, unevaluated), none, none, no)

    def step(
        self, fn: Function, y: Z, args: Any, options: Json, state: SearchState, tags: frozenset
    ) -> tuple[Z, SearchState, Any]:
        """Evaluates the function at the end of the last step, accepts or rejects that step, and finds the next
        one.
        """
        linearised, aux = self._linearised(fn, state.ahead, args)
        state_after_step, first, before = (
            state.ahead - y,
            state.steps == 0,
            dataclasses.replace(state.found, jacobian=state.slope),
        )
        _, accepted, _, region = self.search.step(first, y, state.ahead, before, linearised, state.region)
        alike = jnp.all(linearised.positive == before.positive)
        accepted &= first | alike | ~state.mixed
        region = _select(state.mixed & ~accepted, state.region, region)
        has_converged = self._is_small(state.ahead, state_after_step, linearised, before) & accepted

        corrected = state.slope
        if self.rough:
            least = jnp.finfo(y.dtype).tiny
            projection, length = corrected @ state_after_step, jnp.maximum(state_after_step @ state_after_step, least)
            missed = linearised.residual - before.residual - projection
            near = (state.steps > 0) & (linearised.as_min() < TELLING * before.as_min())
            corrected = jnp.where(near, corrected + jnp.outer(missed, state_after_step) / length, corrected)
            half = jnp.minimum(region.step_size, length / jnp.maximum(projection @ projection, least))
            region = _select(accepted | state.mixed, region, dataclasses.replace(region, step_size=half))
        slope = jnp.where(accepted, linearised.jacobian, corrected)
        y, best, aux = _select(accepted, (state.ahead, linearised, aux), (y, state.found, state.aux))
        ahead_of = dataclasses.replace(best, jacobian=slope)
        stride, _ = self.descent.step(region.step_size, self.descent.query(y, ahead_of, ahead_of))
        mixed = accepted & alike & (state.steps > 1) & (jnp.max(jnp.abs(stride)) < self.near)
        next_y = y + jnp.where(mixed, mixed_step(stride, state_after_step, stride - state.stride), stride)
        rejected = jnp.where(accepted, 0, state.rejected + 1)
        is_over = has_converged | (rejected >= PATIENCE)
        new = SearchState(best, slope, aux, stride, next_y, mixed, region, state.steps + 1, rejected, is_over)
        return y, new, aux

    def _is_small(self, y: Z, moved: Z, found: SolverLinearisation, before: SolverLinearisation) -> Array:
        """True if a step changed neither y nor any residual that counts by more than the tolerances."""
        changed = found.active_residuals - before.active_residuals
        return (self.norm(moved / (self.atol + self.rtol * jnp.abs(y))) < 1) & (
            self.norm(changed / (self.atol + self.rtol * jnp.abs(found.residual))) < 1
        )

    def terminate(
        self, fn: Function, y: Z, args: Any, options: Json, state: SearchState, tags: frozenset
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
        state: SearchState,
        tags: frozenset,
        result: optx.RESULTS,
    ) -> tuple[Z, Any, Json]:
        """Returns the best point, the auxiliary output of its evaluation, and no statistics."""
        return y, aux, {}


def _select(chosen: Array, a: Any, b: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(chosen, a, b), a, b)
