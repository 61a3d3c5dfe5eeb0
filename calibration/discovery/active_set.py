"""Coordinates with room for any effects of a library, so that one compiled fit serves every hypothesis."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from calibration.data.effect_file import Library
from calibration.inference.priors import Coordinates
from mmrjax import params
from mmrjax.effects import Effect
from mmrjax.params import Parameter
from mmrjax.robot import Robot

#: Prior sd of an amplitude in a fit, in sds of its field: wide enough to leave a visible effect unshrunk.
WIDE = 3.0
#: An amplitude further out than so many sds of its field is not plausible.
PLAUSIBLE = 4.0


def shape_of(effect: Effect) -> Parameter | None:
    """The shape parameter that a fit frees: the first phase or scale beside the amplitude, if the effect has one."""
    for p in params.walk(effect):
        if not p.spec.amplitude and (_phase(p) or (p.spec.relative_sd and float(p.value) > 0)):
            return p
    return None


def _phase(p: Parameter) -> bool:
    return p.name == "phase"


def amplitude_of(effect: Effect) -> Parameter:
    """The amplitude of an effect."""
    return next(p for p in params.walk(effect) if p.spec.amplitude)


def shape_scales(shape: Parameter | None) -> tuple[float, float, float]:
    """(value, spread, sd) of a shape parameter, value · exp(spread · z) + sd · z at coordinate z: a phase is
    shifted, a scale multiplied."""
    if shape is None:
        return 1.0, 0.0, 0.0
    if _phase(shape):
        return float(shape.value), 0.0, float(shape.spec.sd)  # type: ignore[arg-type]
    return float(shape.value), math.sqrt(math.log1p(shape.spec.relative_sd**2)), 0.0  # type: ignore[operator]


def shaped(scales: tuple, z: Array) -> Array:
    """A shape parameter at coordinate z, `scales` as by `shape_scales`."""
    value, spread, sd = scales
    return value * jnp.exp(spread * z) + sd * z


class Slots(eqx.Module):
    """Base coordinates, then the amplitudes and the shapes of the effects in the slots.

    z = [base, amplitudes, shapes], all with standard normal priors: an amplitude is WIDE · sd · z, a shape
    its nominal value times exp(spread · z). Which effect is in a slot is data, not structure, so that fits
    of many hypotheses are one vmapped batch; an empty slot keeps its coordinates at 0.

    Attributes:
        base: coordinates of the base parameters.
        which: index into `names` of the effect in each slot, -1 if it is empty; shape (slots,).
        sd: of each effect's amplitude; scales: of each effect's shape, see `shape_scales`.
        names, shapes: of the effects of the robot, and of their shape parameter ("" for none).
    """

    base: Coordinates
    which: Int[Array, " slots"]
    sd: Float[Array, " effects"]
    scales: tuple[Array, Array, Array]
    names: tuple[str, ...] = eqx.field(static=True)
    shapes: tuple[str, ...] = eqx.field(static=True)

    @property
    def slots(self) -> int:
        """How many slots there are."""
        return self.which.shape[-1]

    def __len__(self) -> int:
        return len(self.base) + 2 * self.slots

    def parts(self, z: Array) -> tuple[Array, Array, Array]:
        """z of the base, of the amplitudes and of the shapes."""
        p, s = len(self.base), self.slots
        return z[..., :p], z[..., p : p + s], z[..., p + s :]

    def held(self) -> Float[Array, "slots effects"]:
        """1 where a slot holds an effect."""
        return jnp.asarray(self.which[:, None] == jnp.arange(len(self.names)), float)

    def robot(self, robot: Robot, z: Float[Array, " coordinates"]) -> Robot:
        """`robot`, which has every effect of `names`, at coordinates z."""
        base, amplitude, shape = self.parts(z)
        held = self.held()
        amplitudes = WIDE * self.sd * (amplitude @ held)
        shapes = shaped(self.scales, shape @ held)
        values = {f"effects.{name}.amplitude": amplitudes[k] for k, name in enumerate(self.names)}
        values |= {f"effects.{n}.{s}": shapes[k] for k, (n, s) in enumerate(zip(self.names, self.shapes)) if s}  # noqa: B905
        return params.replace(self.base.robot(robot, base), values)  # type: ignore[return-value]

    def with_effects(self, which: Sequence[int] | Array) -> Slots:
        """The same with these effects in the slots."""
        return dataclasses.replace(self, which=jnp.asarray(which, int))


def slots(base: Coordinates, effects: Sequence[Effect], size: int) -> Slots:
    """Empty slots for any of these effects."""
    shapes = [shape_of(e) for e in effects]
    return Slots(
        base,
        jnp.full(size, -1),
        jnp.asarray([amplitude_of(e).spec.prior_sd(0.0) for e in effects]),
        tuple(jnp.asarray(x) for x in zip(*map(shape_scales, shapes), strict=True)),  # type: ignore[arg-type]
        tuple(e.name for e in effects),
        tuple("" if s is None else s.name for s in shapes),
    )


def equipped(robot: Robot, library: Library, names: Sequence[str]) -> Robot:
    """The robot with the effects of `names`, each with amplitude 0, behind those that it has."""
    have = {e.name for e in robot.effects}
    more = tuple(library[n]() for n in names if n not in have)
    return dataclasses.replace(robot, effects=(*robot.effects, *more))


#: Where on the prior of a shape parameter the library is scored, in its sds.
GRID = (-1.5, -0.75, 0.0, 0.75, 1.5)
#: The same for a phase, whose sd is 2 rad: 36 degrees apart through half a turn; an amplitude has either sign.
TURN = tuple(float(x) for x in np.arange(-2, 3) * math.pi / 10)


@dataclasses.dataclass(frozen=True)
class Scored:
    """One effect at every point of its shape's grid, with an amplitude of one prior sd.

    Attributes:
        effect: of amplitude one sd.
        name: of its shape parameter, "" for none.
        at: coordinates of the shape on the grid, in its sds; values: of the shape there.
    """

    effect: Effect
    name: str
    at: tuple[float, ...]
    values: tuple[float, ...]

    @property
    def absent(self) -> Effect:
        """The effect with amplitude 0."""
        return eqx.tree_at(lambda e: e.amplitude, self.effect, jnp.zeros_like(jnp.asarray(self.effect.amplitude)))

    def each(self, function: Callable[[Effect], Array]) -> Array:
        """`function` of the effect at every point of the grid, along a new leading axis."""
        if not self.name:
            return function(self.effect)[None]
        put = lambda v: params.replace(self.effect, {self.name: v})  # noqa: E731
        return jax.vmap(lambda v: function(put(v)))(jnp.asarray(self.values))  # type: ignore[arg-type]


def scored(effect: Effect, grid: Sequence[float] = GRID) -> Scored:
    """An effect with the grid of its shape parameter, cut at the bounds."""
    shape, amplitude = shape_of(effect), amplitude_of(effect)
    unit = params.replace(effect, {amplitude.name: jnp.asarray(amplitude.spec.prior_sd(0.0))})
    if shape is None:
        return Scored(unit, "", (0.0,), ())  # type: ignore[arg-type]
    grid = TURN if _phase(shape) else grid
    values = np.clip(np.asarray(shaped(shape_scales(shape), np.asarray(grid))), *shape.spec.bounds)  # type: ignore[arg-type]
    return Scored(unit, shape.name, tuple(grid), tuple(map(float, values)))  # type: ignore[arg-type]
