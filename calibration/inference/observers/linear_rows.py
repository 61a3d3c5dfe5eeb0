"""Rows linear about one fit: readings of a log near the simulated fit of its base, or windows of its equations.

All stages of the loop run on such rows without a simulation.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from calibration.inference.linearization import ScoredEffect
from calibration.inference.observers.base import Observer, SearchPolicy, with_effects
from calibration.inference.observers.time_histories import Histories
from calibration.inference.optimizers import Numbers
from calibration.inference.problem import Data, Observation, Problem
from mmrjax.compile.compiling import SELDOM, compiled
from mmrjax.model.signals import CONVERGED


class LinearRows(Observer):
    """Observer whose rows are linear in the base coordinates and the amplitudes, about one fit.

    Attributes:
        linear: linearization at `origin`, with one weight for all readings.
        origin: base coordinates of that fit.
        start: base coordinates at which searches begin.
        width: prior sd of an amplitude, relative to that of its field.
        effect, grid: effect of each instance, and its neighbours on the grid of its shape: before, at, after.
    """

    policy: ClassVar[SearchPolicy] = SearchPolicy(batch=16, steps=30, searches=1, one_by_one=False)
    rows_tell: ClassVar[bool] = False

    linear: Any = eqx.field(kw_only=True)
    origin: Float[Array, " parameters"] = eqx.field(kw_only=True)
    start: Float[Array, " parameters"] = eqx.field(kw_only=True)
    width: float = eqx.field(kw_only=True, static=True)
    effect: Int[Array, " instances"] = eqx.field(kw_only=True)
    grid: Float[Array, "three instances"] = eqx.field(kw_only=True)

    def errors(self, coordinates: Any, z: Array) -> Array:
        """Predictions minus readings at coordinates z, shape (readings,)."""
        linear, size = self.linear, self.origin.shape[0]
        readings = linear.readings
        errors = linear.residual[:readings] + linear.jacobian[:readings] @ (z[:size] - self.origin)
        if not hasattr(coordinates, "active"):
            return errors
        _, amplitude, shape = coordinates.parts(z)
        before, peak, after = self.grid
        rise = (shape[:, None] - before) / (peak - before)
        fall = (after - shape[:, None]) / (after - peak)
        share = jnp.clip(jnp.minimum(*(jnp.where(jnp.isfinite(x), x, 1.0) for x in (rise, fall))), 0.0, 1.0)
        membership = self.effect == jnp.asarray(coordinates.active)[:, None]
        return errors + self.width * linear.signatures @ jnp.sum(amplitude[:, None] * membership * share, 0)

    def linearise(self, problem: Problem, z: Array, effects: tuple[ScoredEffect, ...]) -> Any:
        data = problem.data
        evaluated, linear = jax.device_get((_evaluated(self, problem.coordinates, data, z), self.linear))
        linear = linear.rescaled(np.asarray(data.weight) / np.asarray(data.sd))
        return dataclasses.replace(linear, residual=evaluated[0], jacobian=evaluated[1])

    @property
    def long(self) -> bool:
        return False

    @property
    def over_time(self) -> bool:
        return True

    # Also for windows, which inherit from settled runs.
    operating_points, at_fit = Observer.operating_points, Observer.at_fit
    draws, fit_replicate, search = Observer.draws, Observer.fit_replicate, Observer.search

    def unreachable(self, status: np.ndarray) -> np.ndarray:
        return np.zeros(np.shape(status), bool)

    def starts(
        self, problem: Problem, random: np.random.Generator, count: int, every: Problem | None = None
    ) -> np.ndarray:
        return np.asarray(self.start)[None]

    def at(self, problem: Problem, z: Numbers, active: Numbers | None = None) -> tuple[Numbers, Numbers, Observation]:
        return _evaluated(self, with_effects(problem, active).coordinates, problem.data, jnp.asarray(z))


class LinearHistories(LinearRows, Histories):
    """Observer of time histories whose readings are linear about the fit of their base."""


def grid_of_effects(effects: tuple[ScoredEffect, ...]) -> tuple[Array, Array]:
    """Effect of each instance, and its neighbours on the grid of its shape, see `LinearRows`."""
    index = np.repeat(np.arange(len(effects)), [len(e.at) for e in effects])
    padded = [np.r_[-np.inf, e.at, np.inf] for e in effects]
    grid = [np.concatenate(x) for x in zip(*((x[:-2], x[1:-1], x[2:]) for x in padded), strict=True)]
    return jnp.asarray(index), jnp.asarray(np.stack(grid))


def problem_of_readings(problem: Problem, z: np.ndarray, effects: tuple[ScoredEffect, ...], width: float) -> Problem:
    """Problem of a log whose readings are linear about a fit of its base.

    Args:
        problem: problem of the log.
        z: coordinates of the fit.
        effects: effects whose signatures are computed.
        width: prior sd of amplitudes, relative to those of their fields.
    """
    data, observe, z = problem.data, problem.observe, np.asarray(z)
    linear: Any = jax.device_get(observe.linearise(problem, jnp.asarray(z), effects))
    scale = np.asarray(data.weight / data.sd)
    raw = jax.tree.map(jnp.asarray, linear.rescaled(np.where(scale > 0, 1 / np.where(scale > 0, scale, 1.0), 0.0)))
    index, grid = grid_of_effects(effects)
    simulated = observe.at_fit(problem, z)
    fields: Any = {f.name: getattr(simulated, f.name) for f in dataclasses.fields(simulated)}
    rows = LinearHistories(
        **fields, linear=raw, origin=jnp.asarray(z), start=jnp.asarray(z), width=width,
        effect=index, grid=grid,
    )  # fmt: skip
    return dataclasses.replace(problem, observe=rows)


@functools.partial(compiled, options=SELDOM)
def _evaluated(observe: LinearRows, coordinates: Any, data: Data, z: Array) -> tuple[Array, Array, Observation]:
    """Residuals of rows, penalties and priors, their Jacobian, and the observation."""

    def both(z: Array) -> tuple[Array, Array]:
        errors = observe.errors(coordinates, z)
        return errors, errors

    slopes, errors = jax.jacfwd(both, has_aux=True)(z)
    scale, penalties = (data.weight / data.sd).ravel(), jnp.zeros(len(data.weight))
    r = jnp.concatenate([scale * errors, penalties, z - data.centre])
    jacobian = [scale[:, None] * slopes, jnp.zeros((len(penalties), len(z))), jnp.eye(len(z))]
    status = jnp.full(len(penalties), CONVERGED)
    reading = errors.reshape(data.weight.shape) + data.measured
    observation = Observation(reading, penalties, status, jnp.zeros_like(status))
    return r, jnp.concatenate(jacobian), observation
