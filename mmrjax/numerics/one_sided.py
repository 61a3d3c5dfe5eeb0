"""Slopes, and bounds whose derivative at the bound is the one from inside, because many defaults are at a bound.

JAX halves the derivative of `jnp.clip`, `jnp.minimum` and `jnp.maximum` if both arguments are equal, and the
derivative of `jnp.abs` is 0 at 0.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from mmrjax.model.params import Scalar


def value_and_slope(function: Callable[[Any], Any], x: Any) -> tuple[Any, Any]:
    """Value of a function and its derivative with respect to `x`, for an array element by element."""
    return jax.jvp(function, (x,), (jnp.ones_like(x),))


def clip(x: Scalar, low: Scalar, high: Scalar) -> Array:
    """`x` limited to `low` and `high`. At both bounds the derivative is that of `x`."""
    return jnp.where(x < low, low, at_most(x, high))


def at_least(x: Scalar, low: Scalar) -> Array:
    """The larger of `x` and `low`. If they are equal, the derivative is that of `x`."""
    return jnp.where(x < low, low, x)


def at_most(x: Scalar, high: Scalar) -> Array:
    """The smaller of `x` and `high`. If they are equal, the derivative is that of `x`."""
    return jnp.where(x > high, high, x)


def magnitude(x: Scalar, way: Scalar) -> Array:
    """|x|. At 0 the derivative is that for `x` growing in the direction of `way`, of either sign."""
    backward = (x < 0) | ((x == 0) & (way < 0))
    return jnp.where(backward, -x, x)
