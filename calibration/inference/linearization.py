"""Linearised fit: residuals, Jacobian, and changes of the readings by effects and by errors of balances."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from calibration.data import Names
from mmrjax.compile.compiling import compiled
from mmrjax.effects import Effect
from mmrjax.effects.base import amplitude_of as amplitude_of
from mmrjax.effects.base import free_shape_parameter as free_shape_parameter
from mmrjax.effects.curve import in_travel_frame
from mmrjax.model import balances, params
from mmrjax.model.params import Parameter, Scalar, parameter
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals
from mmrjax.numerics.elementary import clip

#: Balances with a defect that changes the readings of settled travel. Those on one line act on the readings in the
#: same way except for the variables that they depend on: three channels close three equations.
PROBED = ("mass", "supply", "electrical", "motor", "gearbox", "track", "ground", "slip", "duty")


def balance_probe(whose: str) -> Effect:
    """Effect that adds its amplitude to a balance: one number for all sides, or two, shape (2,), for left and
    right.
    """

    class Probe(Effect):
        name: ClassVar[str] = f"probe_{whose}"
        balance: ClassVar[str] = whose
        dissipative: ClassVar[bool] = False
        amplitude: Scalar = parameter(
            0.0, unit="", meaning="defect", bounds=(-1e9, 1e9), sd=1.0, source="", amplitude=True
        )

        def term(self, robot: Robot, signals: Signals) -> Scalar:
            amplitude = jnp.asarray(self.amplitude)
            return jnp.where(signals.side > 0, amplitude[0], amplitude[1]) if amplitude.ndim else amplitude

    return Probe()


def with_probes(robot: Robot, probes: Sequence[Effect], amplitudes: Sequence[Array] | Array) -> Robot:
    """Robot with further effects, such as probes, at these amplitudes."""
    probes_with_amplitudes = tuple(
        eqx.tree_at(lambda e: e.amplitude, p, a) for p, a in zip(probes, amplitudes, strict=True)
    )
    return dataclasses.replace(robot, effects=(*robot.effects, *probes_with_amplitudes))


# --- effects as they are scored -------------------------------------------------------------------------


def _is_phase(p: Parameter) -> bool:
    return p.name == "phase"


Scales = tuple[Scalar, Scalar, Scalar, Scalar, Scalar]


def shape_scales(shape: Parameter | None) -> tuple[float, float, float, float, float]:
    """Scales (value, spread, sd, low, high) of a shape parameter. At coordinate z it is value · exp(spread · z) + sd
    · z.

    A phase is shifted (sd), other parameters are multiplied (spread). `shape_parameter_at` applies the bounds.
    """
    if shape is None:
        return 1.0, 0.0, 0.0, -math.inf, math.inf
    low, high = shape.spec.bounds
    if _is_phase(shape):
        return float(shape.value), 0.0, shape.spec.prior_sd(0.0), low, high
    return float(shape.value), math.sqrt(math.log1p((shape.spec.relative_sd or 0.0) ** 2)), 0.0, low, high


def shape_parameter_at(scales: Scales, z: Array) -> Array:
    """Shape parameter at coordinate z, within the bounds of its field. `scales` is from `shape_scales`.

    A phase is wrapped by whole turns. Other parameters are clipped.
    """
    value, spread, sd, low, high = scales
    shape_value = value * jnp.exp(spread * z) + sd * z
    wrapped_angle = jnp.remainder(shape_value + jnp.pi, 2 * jnp.pi) - jnp.pi
    return jnp.where(jnp.asarray(sd) > 0, wrapped_angle, clip(shape_value, low, high))


#: Coordinates on the prior of a shape parameter at which the library is scored, in its sds.
GRID = (-1.5, -0.75, 0.0, 0.75, 1.5)
#: The same for a phase, whose sd is 2 rad: 36 degrees apart through half a turn; an amplitude has either sign.
TURN = tuple(float(x) for x in np.arange(-2, 3) * math.pi / 10)


class ScoredEffect(eqx.Module):
    """One effect at each point of the grid of its shape parameter, with an amplitude of one prior sd.

    Attributes:
        effect: the effect with an amplitude of one prior sd.
        shape: name of its shape parameter, "" for none.
        at: grid coordinates of the shape, in its sds.
        values: values of the shape on the grid.
    """

    effect: Effect
    shape: str = eqx.field(static=True)
    at: tuple[float, ...] = eqx.field(static=True)
    values: Float[Array, " grid"]

    @property
    def absent(self) -> Effect:
        """The effect with amplitude 0."""
        return eqx.tree_at(lambda e: e.amplitude, self.effect, jnp.zeros_like(jnp.asarray(self.effect.amplitude)))

    def each(self, function: Callable[[Effect], Array]) -> Array:
        """Applies `function` to the effect at each point of the grid, along a new first axis."""
        if not self.shape:
            return function(self.effect)[None]
        return jax.vmap(lambda v: function(params.replace(self.effect, {self.shape: v})))(self.values)


def with_shape_grid(effect: Effect, grid: Sequence[float] = GRID) -> ScoredEffect:
    """Effect with the grid of its shape parameter, clipped at the parameter's bounds."""
    shape = free_shape_parameter(effect)
    amplitude = amplitude_of(effect)
    unit = params.replace(effect, {amplitude.name: jnp.asarray(amplitude.spec.prior_sd(0.0))})
    if shape is None:
        return ScoredEffect(unit, "", (0.0,), jnp.zeros(0))
    grid = TURN if _is_phase(shape) else grid
    scales = [np.asarray(x) for x in shape_scales(shape)]
    return ScoredEffect(unit, shape.name, tuple(grid), _shape_parameter_at(tuple(scales), np.asarray(grid)))


_shape_parameter_at: Callable[..., Array] = compiled(shape_parameter_at)


def with_shape_of_robot(robot: Robot, scored: ScoredEffect) -> ScoredEffect:
    """Effect with its grid or, if the robot has the effect, with its shape in the robot."""
    effect_of_robot = next((e for e in robot.effects if e.name == scored.effect.name), None)
    if effect_of_robot is None or not scored.shape:
        return scored
    shape = getattr(effect_of_robot, scored.shape)
    return dataclasses.replace(
        scored, values=jnp.where(jnp.asarray(effect_of_robot.amplitude) == 0, scored.values, shape)
    )


def map_over_shapes(scored: ScoredEffect, function: Callable[[Effect, Array], Array], inputs: Array) -> Array:
    """Applies a function to the effect at each point of its grid and to the matching value in `inputs`, shape
    (grid,).
    """
    if not scored.shape:
        return function(scored.effect, inputs[0])[None]
    of_value = lambda v, x: function(params.replace(scored.effect, {scored.shape: v}), x)  # noqa: E731
    return jax.vmap(of_value)(scored.values, inputs)


def _with_memory(signals: Signals, effect: Effect, memory: Array) -> Signals:
    return dataclasses.replace(signals, memory={**signals.memory, effect.name: memory})


def initial_memory(robot: Robot, scored: ScoredEffect, angle: Array) -> Array:
    """Memory of an effect at the start of a run, at each point of its grid, shape (grid,)."""
    initial = lambda effect, _: jnp.asarray(effect.initial(robot, angle), float)  # noqa: E731
    return map_over_shapes(scored, initial, jnp.zeros(len(scored.at)))


def memory_rates(robot: Robot, scored: ScoredEffect, signals: Signals, memory: Array) -> Array:
    """Rate of change of an effect's memory at each point of its grid, shape (grid,)."""

    def rate(effect: Effect, memory: Array) -> Array:
        return jnp.asarray(effect.rate(robot, _with_memory(signals, effect, memory)), float)

    return map_over_shapes(scored, rate, memory)


def effect_terms(robot: Robot, signals: Signals, effects: tuple[ScoredEffect, ...], memory: list[Array]) -> Array:
    """Terms of effects in their balances at one instant, shape (instances,).

    Args:
        memory: memory of each effect at each point of its grid. Any number for an effect without memory.
    """

    def term(effect: Effect, effect_memory: Array) -> Array:
        robot_with_effect = dataclasses.replace(robot, effects=(effect,))
        signals_with_memory = _with_memory(signals, effect, effect_memory)
        return jnp.asarray(
            balances.effects_sum(robot_with_effect, signals_with_memory, effect.balance, effect.channel), float
        )

    terms = [map_over_shapes(e, term, m) for e, m in zip(effects, memory, strict=True)]
    return jnp.concatenate([jnp.zeros(0), *terms])


# --- the fit ------------------------------------------------------------------------------------------------


class Linearization(eqx.Module):
    """A linearised fit.

    Attributes:
        residual: whitened residuals, shape (residuals,): readings (row by row), adhesion (one per row), priors.
        jacobian: derivatives of the residuals with respect to the free coordinates, shape (residuals,
            coordinates).
        signatures: derivatives with respect to each instance's amplitude in prior sds, shape (readings,
            instances).
        defects: derivatives with respect to an error of each balance in `probed` [unit of the balance]. Further axes
            depend on the observer.
        scale: change of a whitened reading per unit of the reading [1/SI], 0 if excluded, shape (rows, channels).
        signals: signals of each row at the fit.
        channels: names of the readings' channels, in order.
        magnitudes: channels whose readings have no sign.
        probed: balances whose errors are known.

    A defect of a balance has a value at each point, which is a row. For a robot with independently driven sides it is
    a row and side, with the left side of all rows first.
    """

    probed: ClassVar[Names] = PROBED

    residual: Float[Array, " residuals"]
    jacobian: Float[Array, "residuals coordinates"]
    signatures: Float[Array, "readings instances"]
    defects: Float[Array, "balances ..."]
    scale: Float[Array, "rows channels"]
    signals: Signals
    channels: Names = eqx.field(static=True, kw_only=True)
    magnitudes: frozenset[str] = eqx.field(default=frozenset(), static=True, kw_only=True)

    @property
    def rows(self) -> int:
        """Number of rows."""
        return self.signatures.shape[0] // len(self.channels)

    @property
    def readings(self) -> int:
        """Number of readings, including missing ones."""
        return self.signatures.shape[0]

    def by_row(self) -> Float[Array, "rows channels"]:
        """Whitened residuals of the readings."""
        return self.residual[: self.readings].reshape(self.rows, -1)

    def rescaled(self, factor: Array) -> Self:
        """Copy with the scale of the readings times a factor, shape (rows, channels)."""
        by_reading = np.concatenate([np.ravel(factor), np.ones(self.residual.shape[0] - self.readings)])
        return dataclasses.replace(
            self, residual=self.residual * by_reading, jacobian=self.jacobian * by_reading[:, None],
            signatures=self.signatures * np.ravel(factor)[:, None], scale=self.scale * factor,
        )  # fmt: skip

    @property
    def points(self) -> int:
        """Number of points where a balance may have an error."""
        return self.rows

    def at_points(self, rows: np.ndarray) -> np.ndarray:
        """Values of rows, repeated for each point of the row, shape (points,)."""
        return rows

    def of_rows(self, points: np.ndarray) -> np.ndarray:
        """True for rows with at least one point in a mask, shape (rows,)."""
        return points

    def columns(self, balance: Scalar | int, shapes: Array | np.ndarray) -> Float[Array, "readings terms"]:
        """Change of the whitened readings by errors of a balance. Each column is an error over the points.

        Args:
            balance: index into `probed`.
            shapes: errors, shape (points, terms).
        """
        raise NotImplementedError

    def channel_columns(self, channel: Scalar | int, shapes: Array | np.ndarray) -> Float[Array, "readings terms"]:
        """Change of the whitened readings by errors of one channel [SI]. Each column is an error over the points.

        Args:
            channel: index of the channel.
            shapes: errors, shape (points, terms).
        """
        channel_scale = self.scale * (np.arange(self.scale.shape[1]) == channel)
        return (channel_scale[:, :, None] * shapes[:, None, :]).reshape(-1, shapes.shape[1])

    def revealing_rows(self) -> np.ndarray:
        """Indices of the rows in which a single row reveals an error."""
        raise NotImplementedError

    def variable(self, name: str) -> np.ndarray:
        """Variable of a curve at each point [SI]: a signal, or another quantity of the observer."""
        return np.broadcast_to(np.asarray(getattr(self.signals, name), float), (self.rows,))

    def curve_variable(self, place: str, variable: str) -> tuple[np.ndarray, np.ndarray]:
        """Variable of a curve in a place [SI] and its factor at each point, as `effects.curve` uses them."""
        x, factor = in_travel_frame(place, variable, self.variable(variable), self.variable, self.magnitudes)
        return np.asarray(x), np.broadcast_to(factor, (self.points,))

    def runs(self) -> list[np.ndarray]:
        """Indices of the rows of each run. A settled run has one row."""
        return list(np.arange(self.rows)[:, None])

    def shaft_angle(self) -> np.ndarray | None:
        """Angle of the driving shaft in each row since the start of its run [rad]. None for settled runs."""
        return None

    def series(self) -> Float[Array, "runs samples channels"]:
        """Whitened residuals of each run in order of time. A settled row is a run."""
        return self.by_row()[:, None]

    def autocorrelation(self) -> Array:
        """Test of autocorrelation of the residuals, as a normal deviate. -inf if the order of rows has no meaning."""
        return jnp.asarray(-jnp.inf)


def finite_or_zero(x: Array) -> Array:
    """x, with 0 in place of non-finite values."""
    return jnp.where(jnp.isfinite(x), x, 0.0)


def amplitude_unit(effect: Effect) -> float:
    """Prior sd of an effect's amplitude [unit of the amplitude]."""
    return amplitude_of(effect).spec.prior_sd(0.0)
