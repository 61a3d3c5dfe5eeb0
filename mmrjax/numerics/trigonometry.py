"""Sine, cosine and a third of an arc sine in plain arithmetic, which XLA vectorises and fuses with other operations.

On a CPU XLA's own `sin`, `cos` and `asin` call the C library for each member of a batch. They took nine tenths of the
time of a closed form with four of them. Each function here ends with a quotient, even if only by ±1, because XLA
stores quotients once for the whole batch but computes products and sums again for each use.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

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
    turns = jnp.round(angle * (1 / math.pi))
    return 1 - 2 * jnp.abs(turns - 2 * jnp.round(turns / 2)), (angle - turns * _PI[0]) - turns * _PI[1]


@jax.custom_jvp
@jax.jit
def sine(angle: Float[Array, "..."]) -> Float[Array, "..."]:
    """sin of an angle within ±1e5 [rad], accurate to 3e-16."""
    sign, angle_left = _half_turns(jnp.asarray(angle))
    return angle_left * _polynomial(angle_left * angle_left, _SINE) / sign


@jax.custom_jvp
@jax.jit
def cosine(angle: Float[Array, "..."]) -> Float[Array, "..."]:
    """cos of an angle within ±1e5 [rad], accurate to 3e-16."""
    sign, angle_left = _half_turns(jnp.asarray(angle))
    return _polynomial(angle_left * angle_left, _COSINE) / sign


@jax.custom_jvp
@jax.jit
def sine_third(share: Float[Array, "..."]) -> Float[Array, "..."]:
    """sin(asin(x) / 3), a root of 3 y - 4 y³ = x, for x within ±1, accurate to 2e-16, NaN beyond."""
    share = jnp.asarray(share)
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
