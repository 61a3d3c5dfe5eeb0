"""The inverse problem of a fit: data, simulated readings, and whitened residuals."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mmrjax.model.channels import Channel
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals
from mmrjax.numerics.newton import implicit_slopes

if TYPE_CHECKING:
    from calibration.inference.observers import Observer

#: Share of the adhesion limit that a measured steady row leaves unused [-].
MARGIN = 0.02
#: Demand above that limit that costs one sigma, as a share of the limit [-]; reduced if a row still slides.
STIFFNESS = 1e-3
#: Whitened residual of a reading that the model could not compute [σ].
MISSING = 1e3


class Observation(eqx.Module):
    """Simulated readings and status of each row.

    Attributes:
        reading: simulated reading of each channel [SI], shape (rows, channels).
        adhesion_used: used share of the adhesion [-], 0 if irrelevant, shape (rows,).
        status, flags: status and flags of each row's run, shape (rows,).
    """

    reading: Float[Array, "rows channels"]
    adhesion_used: Float[Array, " rows"]
    status: Int[Array, " rows"]
    flags: Int[Array, " rows"]


class Data(eqx.Module):
    """Readings and their weights. The part of a problem that varies between refits.

    Attributes:
        measured, sd: measured readings and their standard deviations [SI], shape (rows, channels). Arbitrary where a
            reading is missing.
        weight: 1 for a fitted reading, 0 for a held-out or missing one, shape (rows, channels).
        centre: prior mean of z, shape (parameters,). 0 except in a bootstrap, which draws the prior means too.
        stiffness: stiffness of the penalty on adhesion, see `Problem`, shape ().
    """

    measured: Float[Array, "rows channels"]
    sd: Float[Array, "rows channels"]
    weight: Float[Array, "rows channels"]
    centre: Float[Array, " parameters"]
    stiffness: Float[Array, ""]


def data_from_readings(measured: np.ndarray, sd: np.ndarray, parameters: int) -> Data:
    """Data in which every present reading has full weight.

    Args:
        measured: readings [SI], NaN if missing, shape (rows, channels).
        sd: standard deviation of each reading [SI], shape (rows, channels).
        parameters: number of free parameters.
    """
    finite = np.isfinite(measured)
    return Data(
        jnp.asarray(np.where(finite, measured, 0.0)),
        jnp.asarray(np.where(finite, sd, 1.0)),
        jnp.asarray(finite, float),
        jnp.zeros(parameters),
        jnp.asarray(STIFFNESS),
    )


class Problem(eqx.Module):
    """Maximum a posteriori over z: minimise half the sum of squared residuals.

    Residuals: (simulated - measured) / sd for each reading. z - centre for each free parameter, and, for a
    settled row with a demand on adhesion above 1 - MARGIN of its limit, the excess over `stiffness`.

    Steady travel does not exist beyond the limit (status `slides`), yet the robot was measured
    there, and at Table 5's adhesion six of the packaged rows slide. The balances are still defined
    with the contact held at V_s, so the objective is finite and continuous everywhere. The penalty
    turns the search back, because its gradient in μ_s remains where that of the speed vanishes. The margin keeps the
    search off the limit itself, where the inverse of Fig. 7 has an infinite slope. The penalty is zero, with zero
    gradient, if every row leaves the margin, so it does not move such an optimum. An optimum that it does
    hold is reported as held by the adhesion limit.
    """

    base: Robot
    coordinates: Any
    observe: Observer
    data: Data
    roots: tuple[Array, Array] | None = None  # of `Observer.solve` at z, if a separate program found them

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Channels of the readings, in the order of arrays."""
        return self.base.channels

    def observation(self, z: Float[Array, " parameters"]) -> Observation:
        """Observation at z."""
        return self.observe(self.coordinates.robot(self.base, z))

    def with_data(self, **changes: Any) -> Problem:
        """Copy with other fields of its `Data`."""
        return dataclasses.replace(self, data=dataclasses.replace(self.data, **changes))

    def misfit(self, z: Float[Array, " parameters"]) -> Float[Array, " residuals"]:
        """Whitened residuals of the readings, then adhesion penalties, at z. Shape (rows (channels + 1),)."""
        return self.whitened(self.observation(z))

    def whitened(self, observation: Observation) -> Float[Array, " residuals"]:
        """Whitened residuals of an observation: readings, then adhesion penalties. Shape (rows (channels + 1),)."""
        error = (observation.reading - self.data.measured) / self.data.sd
        error = self.data.weight * jnp.where(jnp.isfinite(error), error, MISSING)
        return jnp.concatenate([error.ravel(), jax.nn.relu(self.adhesion_excess(observation))])

    def signed(self, observation: Observation) -> Float[Array, " residuals"]:
        """Residuals as in `whitened`, but the adhesion penalty is negative for rows within their margin."""
        return jnp.concatenate(
            [self.whitened(observation)[: self.data.measured.size], self.adhesion_excess(observation)]
        )

    def linearised(
        self, robot: Callable[[Array], Robot], x: Float[Array, " x"]
    ) -> tuple[Array, Array, Observation, Signals | None]:
        """Residuals of a robot that depends on x, and their derivatives, by one evaluation.

        Returns:
            Residuals of readings, then adhesion penalties with their signs. Their Jacobian with respect to x. The
            observation.
            The signals of each row, if the observer solves its equations (`Observer.solve`), otherwise None.
        """
        solved = self.observe.solve(robot(x)) if self.roots is None else self.roots
        if solved is None:

            def explicit(x: Array) -> tuple[Array, tuple[Array, Observation]]:
                observation = self.observe(robot(x))
                r = self.signed(observation)
                return r, (r, observation)

            jacobian, (r, observed) = jax.jacfwd(explicit, has_aux=True)(x)
            return r, jacobian, observed, None

        unknowns, is_solved = solved
        size, (rows, count) = x.size, self.data.measured.shape

        def at_unknowns(x: Array) -> tuple[tuple[Array, Array], tuple[Array, Observation, Signals]]:
            observation, signals, residual = self.observe.observation_at_unknowns(
                robot(x[:size]), unknowns + x[size:], is_solved
            )
            r = self.signed(observation)
            return (r, residual), (r, observation, signals)

        x_and_unknowns = jnp.concatenate([x, jnp.zeros(unknowns.shape[1])])
        (slope, residual_slope), (r, observed, signals) = jax.jacfwd(at_unknowns, has_aux=True)(x_and_unknowns)
        by_row = slope[: rows * count].reshape(rows, count, -1)
        by_row = implicit_slopes(jnp.concatenate([by_row, slope[rows * count :, None]], 1), residual_slope)
        return r, jnp.concatenate([by_row[:, :count].reshape(-1, size), by_row[:, count]]), observed, signals

    def unreachable_rows(self, status: Any) -> np.ndarray:
        """True for rows with readings for which the model has no operating point, shape as `status`."""
        return self.observe.unreachable(np.asarray(status)) & (np.asarray(self.data.weight).max(1) > 0)

    def adhesion_excess(self, observation: Observation) -> Float[Array, " rows"]:
        """Used adhesion above the margin, in units of the penalty, shape (rows,). Negative within the margin."""
        excess = (observation.adhesion_used - (1 - MARGIN)) * jnp.max(self.data.weight, 1) / self.data.stiffness
        return jnp.where(jnp.isfinite(excess), excess, 0.0)

    def robot(self, z: Float[Array, " parameters"]) -> Robot:
        """Robot at coordinates z."""
        return self.coordinates.robot(self.base, z)
