"""Newton's method for a few unknowns over a large batch: it stops on the residual it has just computed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float

from mmrjax.fidelities.linear import factorise, substitute


class _Progress(eqx.Module):
    residual: Float[Array, " n"]


class SmallNewton(optx.AbstractRootFinder):
    """y ← y - J⁻¹ f(y), ended as soon as max |f(y)| < atol.

    `optimistix.Newton` ends when two iterates agree, so it linearises once more after it is there. The
    balances without effects are linear in the unknowns: one linearisation and one look at the residual is
    then all, which is what a sweep of millions of points spends its time on. Residuals have to be scaled to
    the order of one; a residual that is not finite ends as a failure when the steps run out.
    """

    atol: float
    rtol: float = 0.0
    norm: Callable[..., Any] = optx.max_norm

    def init(self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any) -> _Progress:
        return _Progress(jnp.full(f_struct.shape, jnp.inf, f_struct.dtype))

    def step(self, fn: Any, y: Any, args: Any, options: Any, state: _Progress, tags: Any) -> Any:
        def residual(unknowns: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
            value, _ = fn(unknowns, args)
            return value, value

        jacobian, value = jax.jacfwd(residual, has_aux=True)(y)
        factors = factorise(jacobian)
        step = substitute(factors, value)
        y = y - jnp.where(jnp.all(jnp.isfinite(step)), step, 0.0)
        value, aux = fn(y, args)
        # What rounding left over is taken off with the same factors: a shaft that stands still has speed 0.
        rest = substitute(factors, value)
        y = jnp.where(self._there(value), y - rest, y)
        return y, _Progress(value), aux

    def _there(self, residual: Float[Array, " n"]) -> Bool[Array, ""]:
        return jnp.max(jnp.abs(residual)) < self.atol

    def terminate(self, fn: Any, y: Any, args: Any, options: Any, state: _Progress, tags: Any) -> Any:
        return self._there(state.residual), optx.RESULTS.successful

    def postprocess(
        self, fn: Any, y: Any, aux: Any, args: Any, options: Any, state: _Progress, tags: Any, result: Any
    ) -> Any:
        return y, aux, {}
