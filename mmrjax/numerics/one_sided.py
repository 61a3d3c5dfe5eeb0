"""Bounds whose derivative at the bound itself is the one from inside: many defaults are bounds.

JAX halves the derivative of `jnp.clip`, `jnp.minimum` and `jnp.maximum` where both arguments are equal, and that of
`jnp.abs` is 0 at 0.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array

from mmrjax.model.params import Scalar


def clip(x: Scalar, low: Scalar, high: Scalar) -> Array:
    """`x` within `low` and `high`; at either bound the derivative is that of `x`."""
    return jnp.where(x < low, low, at_most(x, high))


def at_least(x: Scalar, low: Scalar) -> Array:
    """The larger of `x` and `low`; where they are equal the derivative is that of `x`."""
    return jnp.where(x < low, low, x)


def at_most(x: Scalar, high: Scalar) -> Array:
    """The smaller of `x` and `high`; where they are equal the derivative is that of `x`."""
    return jnp.where(x > high, high, x)


def magnitude(x: Scalar, way: Scalar) -> Array:
    """|x|; at 0 the derivative is that of `x` growing in the direction of `way`, of either sign."""
    backward = (x < 0) | ((x == 0) & (way < 0))
    return jnp.where(backward, -x, x)
