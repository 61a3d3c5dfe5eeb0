"""Rodas4 as a solver of diffrax. Imported only for integrations, because diffrax takes long to import."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import jax.numpy as jnp
from diffrax import RESULTS

from mmrjax.numerics.rosenbrock import error_across_kink, rosenbrock_stages

# Weights of the stages in the two coefficients of the dense output.
_D = (
    (10.12623508344586, -7.487995877610167, -34.80091861555747, -7.992771707568823, 1.025137723295662),
    (-0.6762803392806898, 6.087714651680015, 16.43084320892478, 24.76722511418386, -6.594389125716872),
)


class RodasInterpolation(diffrax.LocalLinearInterpolation):
    """The method's own dense output, of order 3: y0 (1 - s) + s (y1 + (1 - s) (c2 + s c3)).

    A Hermite cubic would not work. Its slopes are right-hand sides, and there a stiff component multiplies the error
    of its value. So the cubic oscillates between the ends of a long step.
    """

    c2: Any
    c3: Any

    def evaluate(self, t0: Any, t1: Any = None, left: bool = True) -> Any:
        if t1 is not None:
            return self.evaluate(t1) - self.evaluate(t0)
        width = self.t1 - self.t0
        s = (t0 - self.t0) / jnp.where(width == 0, 1.0, width)
        return self.y0 * (1 - s) + s * (self.y1 + (1 - s) * (self.c2 + s * self.c3))


class Rodas4(diffrax.AbstractAdaptiveSolver):
    """Stiffly accurate, L-stable Rosenbrock method of order 4(3) with six stages.

    Source: Hairer and Wanner, Solving Ordinary Differential Equations II (1996), Section IV.7, RODAS. diffrax has no
    Rosenbrock method. Its implicit ones (Kvaerno's of order 3 to 5) take at least ten times as long over Table 8 at
    the same accuracy (docs/lab/figures.md). Only for autonomous right-hand sides of one flat vector: the derivative
    with respect to time is assumed to be zero.

    Attributes:
        branch: (unknowns, args) → booleans that change at a kink of the right-hand side, see `error_across_kink`.
    """

    branch: Callable[[Any, Any], Any] = lambda y, args: False
    term_structure: ClassVar[Any] = diffrax.ODETerm
    interpolation_cls: ClassVar[Callable[..., Any]] = RodasInterpolation

    def order(self, terms: Any) -> int:
        return 4

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> None:
        return None

    def func(self, terms: Any, t0: Any, y0: Any, args: Any) -> Any:
        return terms.vf(t0, y0, args)

    def step(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any) -> Any:
        def rate(y: Any) -> tuple[Any, Any]:
            return terms.vf(t0, y, args), y[:0]

        y1, _, u, _ = rosenbrock_stages(rate, y0, y0[:0], t1 - t0)
        c2, c3 = (sum(d * v for d, v in zip(row, u[:5], strict=True)) for row in _D)
        kink = jnp.any(self.branch(y0, args) != self.branch(y1, args))
        dense = {"y0": y0, "y1": y1, "c2": c2, "c3": c3}
        return y1, error_across_kink(u[-1], y0, y1, kink), dense, None, RESULTS.successful
