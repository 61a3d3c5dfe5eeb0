"""A fit, linearised: residuals, Jacobian, what effects and defects of balances would change of the readings."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mmrjax.compile.compiling import compiled
from mmrjax.effects import Effect
from mmrjax.effects.curve import in_travel
from mmrjax.effects.scaled import amplitude_of as amplitude_of
from mmrjax.effects.scaled import shape_of as shape_of
from mmrjax.model import balances, params
from mmrjax.model.params import Parameter, Scalar, parameter
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals
from mmrjax.numerics.one_sided import clip

#: Balances whose defect moves the readings of settled travel. Those of a line act alike on the readings, but
#: for what they depend on: three channels close three equations.
PROBED = ("mass", "supply", "electrical", "motor", "gearbox", "track", "ground", "slip")


def probe(whose: str) -> Effect:
    """An effect that adds its amplitude to a balance: of every side, or of each its own, shape (2,): left, right."""

    class Probe(Effect):
        name: ClassVar[str] = f"probe_{whose}"
        balance: ClassVar[str] = whose
        dissipative: ClassVar[bool] = False
        amplitude: Scalar = parameter(
            0.0, unit="", meaning="defect", bounds=(-1e9, 1e9), sd=1.0, source="", amplitude=True
        )

        def term(self, robot: Robot, signals: Signals) -> Scalar:
            own = jnp.asarray(self.amplitude)
            return jnp.where(signals.side > 0, own[0], own[1]) if own.ndim else own

    return Probe()


# --- effects as they are scored -------------------------------------------------------------------------


def _phase(p: Parameter) -> bool:
    return p.name == "phase"


Scales = tuple[Scalar, Scalar, Scalar, Scalar, Scalar]


def shape_scales(shape: Parameter | None) -> tuple[float, float, float, float, float]:
    """(value, spread, sd, low, high) of a shape parameter, value · exp(spread · z) + sd · z at coordinate z: a phase
    is shifted, a scale multiplied; see `shaped` for the bounds."""
    if shape is None:
        return 1.0, 0.0, 0.0, -math.inf, math.inf
    low, high = shape.spec.bounds
    if _phase(shape):
        return float(shape.value), 0.0, shape.spec.prior_sd(0.0), low, high
    return float(shape.value), math.sqrt(math.log1p((shape.spec.relative_sd or 0.0) ** 2)), 0.0, low, high


def shaped(scales: Scales, z: Array) -> Array:
    """A shape parameter at coordinate z, `scales` as by `shape_scales`, within the bounds that a robot file allows:
    a phase by whole turns, a scale by a cut."""
    value, spread, sd, low, high = scales
    moved = value * jnp.exp(spread * z) + sd * z
    turned = jnp.remainder(moved + jnp.pi, 2 * jnp.pi) - jnp.pi
    return jnp.where(jnp.asarray(sd) > 0, turned, clip(moved, low, high))


#: Where on the prior of a shape parameter the library is scored, in its sds.
GRID = (-1.5, -0.75, 0.0, 0.75, 1.5)
#: The same for a phase, whose sd is 2 rad: 36 degrees apart through half a turn; an amplitude has either sign.
TURN = tuple(float(x) for x in np.arange(-2, 3) * math.pi / 10)


class ScoredEffect(eqx.Module):
    """One effect at every point of its shape's grid, with an amplitude of one prior sd.

    Attributes:
        effect: of amplitude one sd.
        shape: name of its shape parameter, "" for none.
        at: coordinates of the shape on the grid, in its sds; values: of the shape there.
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
        """`function` of the effect at every point of the grid, along a new leading axis."""
        if not self.shape:
            return function(self.effect)[None]
        return jax.vmap(lambda v: function(params.replace(self.effect, {self.shape: v})))(self.values)


def scored(effect: Effect, grid: Sequence[float] = GRID) -> ScoredEffect:
    """An effect with the grid of its shape parameter, cut at the bounds."""
    shape, amplitude = shape_of(effect), amplitude_of(effect)
    unit = params.replace(effect, {amplitude.name: jnp.asarray(amplitude.spec.prior_sd(0.0))})
    if shape is None:
        return ScoredEffect(unit, "", (0.0,), jnp.zeros(0))
    grid = TURN if _phase(shape) else grid
    scales = [np.asarray(x) for x in shape_scales(shape)]
    return ScoredEffect(unit, shape.name, tuple(grid), _shaped(tuple(scales), np.asarray(grid)))


_shaped: Callable[..., Array] = compiled(shaped)


def shaped_as_in(robot: Robot, scored: ScoredEffect) -> ScoredEffect:
    """An effect with its grid; with the shape that it has in a robot in which it is present."""
    own = next((e for e in robot.effects if e.name == scored.effect.name), None)
    if own is None or not scored.shape:
        return scored
    shape = getattr(own, scored.shape)
    return dataclasses.replace(scored, values=jnp.where(jnp.asarray(own.amplitude) == 0, scored.values, shape))


def each_shape(scored: ScoredEffect, function: Callable[[Effect, Array], Array], given: Array) -> Array:
    """A function of an effect at every point of its shape's grid, and of what is given there, shape (grid,)."""
    if not scored.shape:
        return function(scored.effect, given[0])[None]
    at = lambda v, x: function(params.replace(scored.effect, {scored.shape: v}), x)  # noqa: E731
    return jax.vmap(at)(scored.values, given)


def terms_of(robot: Robot, signals: Signals, effects: tuple[ScoredEffect, ...], memory: list[Array]) -> Array:
    """Terms of effects in their balances at an instant, shape (instances,).

    Args:
        memory: of every effect at each point of its grid, any number where it has none.
    """

    def term(effect: Effect, remembered: Array) -> Array:
        alone = dataclasses.replace(robot, effects=(effect,))
        with_memory = dataclasses.replace(signals, memory={**signals.memory, effect.name: remembered})
        return jnp.asarray(balances.added(alone, with_memory, effect.balance, effect.channel), float)

    found = [each_shape(e, term, m) for e, m in zip(effects, memory, strict=True)]
    return jnp.concatenate(found) if found else jnp.zeros(0)


# --- the fit ------------------------------------------------------------------------------------------------


class Linearization(eqx.Module):
    """A fit, linearised.

    Attributes:
        residual: whitened residuals, shape (residuals,): readings (a channel after the other, row by row),
            adhesion (1 a row), priors.
        jacobian: by the free coordinates, shape (residuals, coordinates).
        signatures: by each instance's amplitude in prior sds, shape (readings, instances).
        defects: by a defect of each balance of `probed` [its unit]; what further axes are is the observer's.
        scale: of what is added to a reading [1/SI], 0 where it does not count, shape (rows, channels).
        signals: of every row, at the fit.
        channels: names of those that readings are of, in order; magnitudes: of those shown without a sign.
        probed: balances whose defects are known.

    A defect of a balance may be at every point: of each row, and of a robot whose sides are driven apart of each side
    of it, the left side of all rows first.
    """

    probed: ClassVar[tuple[str, ...]] = PROBED

    residual: Float[Array, " residuals"]
    jacobian: Float[Array, "residuals coordinates"]
    signatures: Float[Array, "readings instances"]
    defects: Float[Array, "balances ..."]
    scale: Float[Array, "rows channels"]
    signals: Signals
    channels: tuple[str, ...] = eqx.field(static=True, kw_only=True)
    magnitudes: frozenset[str] = eqx.field(default=frozenset(), static=True, kw_only=True)

    @property
    def rows(self) -> int:
        """How many rows there are."""
        return self.signatures.shape[0] // len(self.channels)

    @property
    def readings(self) -> int:
        """How many readings there are, missing ones among them."""
        return self.signatures.shape[0]

    def by_row(self) -> Float[Array, "rows channels"]:
        """Whitened residuals of the readings."""
        return self.residual[: self.readings].reshape(self.rows, -1)

    def with_residual(self, residual: Array) -> Linearization:
        """The same at other residuals."""
        return dataclasses.replace(self, residual=residual)

    @property
    def points(self) -> int:
        """How many points there are at which a balance may lack something."""
        return self.rows

    def at_points(self, rows: np.ndarray) -> np.ndarray:
        """What is known by row, at every point; shape (points,)."""
        return rows

    def of_rows(self, points: np.ndarray) -> np.ndarray:
        """Whether any of a row's points is among those of a mask; shape (rows,)."""
        return points

    def columns(self, balance: Scalar | int, shapes: Array | np.ndarray) -> Float[Array, "readings terms"]:
        """Change of the whitened readings by defects of a balance, each a column over the points.

        Args:
            balance: index into `probed`; shapes: shape (points, terms).
        """
        raise NotImplementedError

    def shown(self, channel: Scalar | int, shapes: Array | np.ndarray) -> Float[Array, "readings terms"]:
        """Change of the whitened readings by what is added to those of a channel [SI], each a column over the points.

        Args:
            channel: position in the table of channels; shapes: shape (points, terms).
        """
        mine = self.scale * (np.arange(self.scale.shape[1]) == channel)
        return (mine[:, :, None] * shapes[:, None, :]).reshape(-1, shapes.shape[1])

    def places(self) -> np.ndarray:
        """Rows at which a defect of a single row is told, indices."""
        raise NotImplementedError

    def variable(self, name: str) -> np.ndarray:
        """What a curve may be over, by point [SI]: a signal, or what else the observer knows."""
        return np.broadcast_to(np.asarray(getattr(self.signals, name), float), (self.rows,))

    def in_travel(self, place: str, variable: str) -> tuple[np.ndarray, np.ndarray]:
        """What a curve in a place is over [SI] and by what it counts, by point, as `effects.curve` takes both."""
        x, way = in_travel(place, variable, self.variable(variable), self.variable, self.magnitudes)
        return np.asarray(x), np.broadcast_to(way, (self.points,))

    def runs(self) -> list[np.ndarray]:
        """Indices of the rows of each run; of settled runs each row is one."""
        return list(np.arange(self.rows)[:, None])

    def turned(self) -> np.ndarray | None:
        """Angle of the driving shaft at every row since the start of its run [rad]; None where no run is followed."""
        return None

    def series(self) -> Float[Array, "runs samples channels"]:
        """Whitened residuals of the readings of each run in the order of time; of settled rows each its own."""
        return self.by_row()[:, None]

    def memory(self) -> Array:
        """Whether residuals remember, as a normal deviate; -inf where their order means nothing."""
        return jnp.asarray(-jnp.inf)


def finite(x: Array) -> Array:
    """x with 0 in the place of what is not finite."""
    return jnp.where(jnp.isfinite(x), x, 0.0)
