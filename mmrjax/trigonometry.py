"""Sine, cosine and arc sine in plain arithmetic, which XLA vectorises and fuses with what stands around it.

Its own `sin`, `cos` and `asin` are calls of the C library on a CPU, one for each member of a batch: they took nine
tenths of the time of a closed form that holds four of them. Coefficients and intervals are those of fdlibm (Sun
Microsystems, 1993: k_sin.c, k_cos.c, e_asin.c), good to 1 unit in the last place of a double.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

#: Of odd and even powers beyond the first two, on ±π/4.
_SINE = (
    -1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04,
    2.75573137070700676789e-06, -2.50507602534068634195e-08, 1.58969099521155010221e-10,
)  # fmt: skip
_COSINE = (
    4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05,
    -2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11,
)  # fmt: skip
#: (asin x - x) / x as P / Q of x², on ±1/2.
_ARCSINE_P = (
    0.0, 1.66666666666666657415e-01, -3.25565818622400915405e-01, 2.01212532134862925881e-01,
    -4.00555345006794114027e-02, 7.91534994289814532176e-04, 3.47933107596021167570e-05,
)  # fmt: skip
_ARCSINE_Q = (
    1.0, -2.40339491173441421878e+00, 2.02094576023350569471e+00, -6.88283971605453293030e-01,
    7.70381505559019352791e-02,
)  # fmt: skip
#: π/2 in two parts, of which the first times a small integer is exact (Cody and Waite, 1980).
_HALF_PI = 1.57079632673412561417e00, 6.07710050650619224932e-11


def _polynomial(x: Array, coefficients: Sequence[float]) -> Array:
    value = jnp.full_like(x, coefficients[-1])
    for c in reversed(coefficients[:-1]):
        value = value * x + c
    return value


def _quarter_turns(angle: Array) -> tuple[Array, Array, Array]:
    """How many quarter turns `angle` holds, to the nearest, modulo 4; sine and cosine of what is left."""
    turns = jnp.round(angle * (2 / math.pi))
    left = (angle - turns * _HALF_PI[0]) - turns * _HALF_PI[1]
    square = left * left
    sine = left + left * square * _polynomial(square, _SINE)
    cosine = 1 - square / 2 + square * square * _polynomial(square, _COSINE)
    return turns - 4 * jnp.floor(turns / 4), sine, cosine


@jax.custom_jvp
@jax.jit
def sine(angle: Float[Array, "..."]) -> Float[Array, "..."]:
    """sin of an angle within ±1e5 [rad], to 1e-16."""
    quarter, sine, cosine = _quarter_turns(jnp.asarray(angle))
    value = jnp.where((quarter == 1) | (quarter == 3), cosine, sine)
    return jnp.where(quarter >= 2, -value, value)


@jax.custom_jvp
@jax.jit
def cosine(angle: Float[Array, "..."]) -> Float[Array, "..."]:
    """cos of an angle within ±1e5 [rad], to 1e-16."""
    quarter, sine, cosine = _quarter_turns(jnp.asarray(angle))
    value = jnp.where((quarter == 1) | (quarter == 3), sine, cosine)
    return jnp.where((quarter == 1) | (quarter == 2), -value, value)


@jax.custom_jvp
@jax.jit
def arcsine(share: Float[Array, "..."]) -> Float[Array, "..."]:
    """asin of a share within ±1 [rad], to 3e-16; NaN beyond."""
    share = jnp.asarray(share)
    size = jnp.abs(share)
    small = size < 0.5
    # asin x = π/2 - 2 asin √((1 - x) / 2) where the fraction would not do.
    square = jnp.where(small, size * size, (1 - size) / 2)
    root = jnp.where(small, size, jnp.sqrt(square))
    value = root + root * _polynomial(square, _ARCSINE_P) / _polynomial(square, _ARCSINE_Q)
    value = jnp.where(small, value, math.pi / 2 - 2 * value)
    return jnp.where(share < 0, -value, value)


sine.defjvp(lambda primals, tangents: (sine(*primals), cosine(*primals) * tangents[0]))
cosine.defjvp(lambda primals, tangents: (cosine(*primals), -sine(*primals) * tangents[0]))
arcsine.defjvp(
    lambda primals, tangents: (arcsine(*primals), tangents[0] / jnp.sqrt(1 - primals[0] ** 2)),
)
