"""Elementary functions: bounds and slopes with a derivative from inside, sines in plain arithmetic.

JAX halves the derivative of `jnp.clip`, `jnp.minimum` and `jnp.maximum` if both arguments are equal, and the
derivative of `jnp.abs` is 0 at 0. Many defaults are at a bound.

On a CPU XLA's own `sin`, `cos` and `asin` call the C library for each member of a batch. They took nine tenths of the
time of a closed form with four of them. Each function here ends with a quotient, even if only by ±1. XLA
stores quotients once for the whole batch, but computes products and sums again for each use.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

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


def magnitude(x: Scalar, direction: Scalar) -> Array:
    """|x|. At 0 the derivative is that for `x` growing in the direction of `direction`, of either sign."""
    backward = (x < 0) | ((x == 0) & (direction < 0))
    return jnp.where(backward, -x, x)


#: Taylor's series in x² of sin x / x and of cos x; their truncation errors on ±π/2 are 1e-18 and 2e-17.
_SINE = [(-1) ** k / math.factorial(2 * k + 1) for k in range(11)]
_COSINE = [(-1) ** k / math.factorial(2 * k) for k in range(11)]
#: π in two parts; the first times a small integer is exact (Cody and Waite, 1980).
_PI = 3.14159265346825122834e00, 1.21542010130123844986e-10
#: (asin x - x) / x as P / Q of x², on ±1/2: fdlibm (Sun Microsystems, 1993), e_asin.c.
_ARCSINE_P = (
    0.0, 1.66666666666666657415e-01, -3.25565818622400915405e-01, 2.01212532134862925881e-01,
    -4.00555345006794114027e-02, 7.91534994289814532176e-04, 3.47933107596021167570e-05,
)  # fmt: skip
_ARCSINE_Q = (
    1.0, -2.40339491173441421878e00, 2.02094576023350569471e00, -6.88283971605453293030e-01,
    7.70381505559019352791e-02,
)  # fmt: skip


def _polynomial(x: Array, coefficients: Sequence[float]) -> Array:
    value = jnp.full_like(x, coefficients[-1])
    for c in reversed(coefficients[:-1]):
        value = value * x + c
    return value


def _half_turns(angle: Array) -> tuple[Array, Array]:
    """1 or -1 for an even or odd nearest number of half turns in `angle`, and the remainder, within ±π/2."""
    half_turns = jnp.round(angle * (1 / math.pi))
    return 1 - 2 * jnp.abs(half_turns - 2 * jnp.round(half_turns / 2)), (
        angle - half_turns * _PI[0]
    ) - half_turns * _PI[1]


@jax.custom_jvp
@jax.jit
def sine(angle: Float[Array, "..."]) -> Float[Array, "..."]:
    """sin of an angle within ±1e5 [rad], accurate to 3e-16."""
    sign, remainder = _half_turns(angle)
    return remainder * _polynomial(remainder * remainder, _SINE) / sign


@jax.custom_jvp
@jax.jit
def cosine(angle: Float[Array, "..."]) -> Float[Array, "..."]:
    """cos of an angle within ±1e5 [rad], accurate to 3e-16."""
    sign, remainder = _half_turns(angle)
    return _polynomial(remainder * remainder, _COSINE) / sign


@jax.custom_jvp
@jax.jit
def sine_third(share: Float[Array, "..."]) -> Float[Array, "..."]:
    """sin(asin(x) / 3), a root of 3 y - 4 y³ = x, for x within ±1, accurate to 2e-16, NaN beyond."""
    size = jnp.abs(share)
    small = size < 0.5
    # asin x = π/2 - 2 asin √((1 - x) / 2) if the fraction is not accurate.
    square = jnp.where(small, size * size, (1 - size) / 2)
    root = jnp.where(small, share, jnp.sqrt(square))
    arc = root + root * (_polynomial(square, _ARCSINE_P) / _polynomial(square, _ARCSINE_Q))
    third = jnp.where(small, arc, jnp.sign(share) * (math.pi / 2 - 2 * arc)) / 3
    return third * _polynomial(third * third, _SINE[:8])  # on ±π/6


sine.defjvp(lambda primals, tangents: (sine(*primals), cosine(*primals) * tangents[0]))
cosine.defjvp(lambda primals, tangents: (cosine(*primals), -sine(*primals) * tangents[0]))


@sine_third.defjvp
def _sine_third_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (x,) = primals
    y = sine_third(x)
    return y, tangents[0] * jnp.sqrt((1 - y**2) / (1 - x**2)) / 3
