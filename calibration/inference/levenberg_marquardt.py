"""Least-squares solver in which some residuals are one-sided: they count only while they are positive.

The objective is ½ Σ r² over the two-sided residuals and the positive one-sided ones. The method is
Levenberg-Marquardt with a trust region and Anderson's mixing. Each step determines which one-sided residuals are
positive at its end, and the trust region predicts with them. Methods of libraries need the same residuals clipped at
0. Near the edge of a clipped residual its linearisation predicts a gain that does not exist, and they then follow the
edge in steps of 1e-4.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

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
ITERATIONS = 8
#: Largest step that is mixed with the last one [prior sds], and the largest factor of that mixing.
NEAR, MIXED_MOST = 0.3, 10.0

Z = Float[Array, " parameters"]


def zero_inactive_residuals(r: Array, jacobian: Array, one_sided: slice) -> tuple[Array, Array]:
    """Residuals and Jacobian with zeros for one-sided residuals that are not positive."""
    counts = jnp.ones(r.shape, bool).at[one_sided].set(r[one_sided] > 0)
    return jnp.where(counts, r, 0.0), jnp.where(counts[:, None], jacobian, 0.0)


def active_residuals(r: Array, one_sided: slice) -> Float[Array, " residuals"]:
    """Residuals, with zeros for one-sided ones that are not positive."""
    return r.at[one_sided].set(jnp.maximum(r[one_sided], 0.0))


def half_squares(r: Array, one_sided: slice) -> Float[Array, ""]:
    """Objective: half the sum of squares of the residuals that count."""
    return 0.5 * jnp.sum(active_residuals(r, one_sided) ** 2)


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
    gradient = free.T @ r
    edge = jacobian[one_sided]
    height = r[one_sided]

    def value(d: Array) -> Array:
        return half_squares(r + jacobian @ d, one_sided) + 0.5 * damping * jnp.sum(d**2)

    def iterate(carry: tuple) -> tuple:
        iterations, active, _, best, lowest = carry
        active_edges = edge * active[:, None]
        d = -solve(normal + active_edges.T @ active_edges, gradient + active_edges.T @ height)
        positive = height + edge @ d > 0
        objective = value(d)
        better = objective < lowest
        return iterations + 1, positive, active, jnp.where(better, d, best), jnp.where(better, objective, lowest)

    zero_step = jnp.zeros(jacobian.shape[1])

    def has_changed(carry: tuple) -> Array:
        iterations, active, active_before, _, _ = carry
        return (iterations == 0) | (iterations < ITERATIONS) & jnp.any(active != active_before)

    start = jnp.asarray(0), height > 0, height > 0, zero_step, jnp.asarray(jnp.inf)
    return jax.lax.while_loop(has_changed, iterate, start)[3]


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
    """State of a search between two steps.

    Attributes:
        y: best point so far.
        residual, jacobian: residuals there (one-sided ones with their signs), and their Jacobian.
        aux: auxiliary output of its evaluation.
        slope: Jacobian for the next step, corrected by rejected steps.
        stride: linearised step at y.
        ahead: point of the next evaluation.
        mixed: True if `mixed_step` leads to that point.
        region: size of the trust region.
        steps: number of evaluations so far.
        rejected: number of evaluations since y was found.
        over: True if the search has ended.
    """

    y: Z
    residual: Float[Array, " residuals"]
    jacobian: Float[Array, "residuals parameters"]
    aux: Any
    slope: Float[Array, "residuals parameters"]
    stride: Z
    ahead: Z
    mixed: Bool[Array, ""]
    region: Float[Array, ""]
    steps: Int[Array, ""]
    rejected: Int[Array, ""]
    over: Bool[Array, ""]


class OneSidedLevenbergMarquardt(eqx.Module):
    """Levenberg-Marquardt for residuals that are partly one-sided. Each step takes one evaluation.

    A step is rejected, and the next one shortened, if the objective falls by less than `LITTLE` of the prediction. If
    it falls by at least `NEARLY_ALL` of it, the next step may be longer (classical trust region, Conn, Gould, Toint
    2000, alg. 6.1.1). A `mixed_step` must keep the same one-sided residuals positive. If it is rejected, the
    linearised step is tried alone. A search ends if an accepted step changes neither y nor any residual by more than
    the tolerance, or after `PATIENCE` rejected steps in a row. Each of these is a quarter of the previous one, so
    only rounding errors (or the tolerance of a rollout) are left.

    Attributes:
        tolerance: largest last step, absolute and relative.
        first, last: the residuals from `first` up to `last` are one-sided.
        near: largest step that is mixed with the previous one, `NEAR`. 0: no mixing.
        rough: True for residuals with kinks, such as those of rollouts in which a load stops. A rejected step then
            corrects the Jacobian in its direction (Broyden, Math. Comp. 19 (1965)), and the next step is at most half
            as long in that direction.
    """

    tolerance: float
    first: int = eqx.field(static=True, default=0)
    last: int = eqx.field(static=True, default=0)
    near: float = NEAR
    rough: bool = eqx.field(static=True, default=False)

    def begin(self, y: Z, residuals: int, aux: Any) -> SearchState:
        """State of a search before its first evaluation. `aux`: shapes and types of the auxiliary output."""
        zero = jnp.asarray(0)
        false = jnp.asarray(False)
        jacobian = jnp.zeros((residuals, y.size), y.dtype)
        aux = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), aux)
        evaluation = (jnp.zeros(residuals, y.dtype), jacobian, aux)
        zero_step = jnp.zeros_like(y)
        return SearchState(y, *evaluation, jacobian, zero_step, y, false, jnp.asarray(1.0), zero, zero, false)

    def step(self, state: SearchState, residual: Array, jacobian: Array, aux: Any) -> SearchState:
        """Accepts or rejects the last step, given the evaluation at its end, and finds the next one.

        Args:
            residual, jacobian, aux: residuals (one-sided ones with their signs) at `state.ahead`, their Jacobian and
                auxiliary output.
        """
        one_sided = slice(self.first, self.last)
        last_step = state.ahead - state.y
        first = state.steps == 0
        objective, objective_before = (half_squares(r, one_sided) for r in (residual, state.residual))
        # A mixed step whose prediction is a rise counts as one of no change.
        predicted = half_squares(state.residual + state.slope @ last_step, one_sided) - objective_before
        predicted = jnp.minimum(predicted, 0.0)
        change = objective - objective_before
        accepted = first | (change <= LITTLE * predicted)
        is_good = ~first & (change < NEARLY_ALL * predicted) & (predicted < 0)
        region = state.region * jnp.where(accepted, jnp.where(is_good, LONGER, 1), SHORTER)
        same_active = jnp.all((residual[one_sided] > 0) == (state.residual[one_sided] > 0))
        accepted &= first | same_active | ~state.mixed
        region = jnp.where(state.mixed & ~accepted, state.region, region)
        # Converged if an accepted step changed neither y nor any residual that counts by more than the tolerance.
        changed = active_residuals(residual, one_sided) - active_residuals(state.residual, one_sided)
        sizes = (last_step, state.ahead), (changed, residual)
        moved, change = (
            jnp.max(jnp.abs(x / (self.tolerance + self.tolerance * jnp.abs(reference)))) for x, reference in sizes
        )
        has_converged = (moved < 1) & (change < 1) & accepted

        corrected = state.slope
        if self.rough:
            tiny = jnp.finfo(residual.dtype).tiny
            projection = corrected @ last_step
            length = jnp.maximum(last_step @ last_step, tiny)
            missed = residual - state.residual - projection
            is_near = (state.steps > 0) & (objective < TELLING * objective_before)
            corrected = jnp.where(is_near, corrected + jnp.outer(missed, last_step) / length, corrected)
            half_region = jnp.minimum(region, length / jnp.maximum(projection @ projection, tiny))
            region = jnp.where(accepted | state.mixed, region, half_region)
        y, residual, jacobian, aux, slope = jax.tree.map(
            lambda new, old: jnp.where(accepted, new, old),
            (state.ahead, residual, jacobian, aux, jacobian),
            (state.y, state.residual, state.jacobian, state.aux, corrected),
        )
        number_limits = jnp.finfo(region.dtype)
        damping = jnp.where(region > number_limits.eps, 1 / jnp.maximum(region, number_limits.eps), number_limits.max)
        stride = one_sided_step(residual, slope, one_sided, damping)
        mixed = accepted & same_active & (state.steps > 1) & (jnp.max(jnp.abs(stride)) < self.near)
        ahead = y + jnp.where(mixed, mixed_step(stride, last_step, stride - state.stride), stride)
        rejected = jnp.where(accepted, 0, state.rejected + 1)
        evaluation = (residual, jacobian, aux)
        is_over = has_converged | (rejected >= PATIENCE)
        return SearchState(y, *evaluation, slope, stride, ahead, mixed, region, state.steps + 1, rejected, is_over)
