"""Coordinates with slots for any effects of a library, so that one compiled fit serves every candidate."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Collection, Iterable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from calibration.data import Names
from calibration.data.effect_file import Library
from calibration.data.posterior_file import ANGLE, LOG, NORMAL, Posterior, join_posteriors
from calibration.discovery.settings import Settings
from calibration.inference.identifiability import posterior_of_coordinates
from calibration.inference.linearization import (
    Linearization,
    ScoredEffect,
    amplitude_of,
    free_shape_parameter,
    shape_parameter_at,
    shape_scales,
    with_shape_grid,
)
from calibration.inference.optimizers import informative_residuals
from calibration.inference.priors import Coordinates
from calibration.inference.problem import Problem
from mmrjax.compile.compiling import SELDOM, compiled
from mmrjax.effects import Effect
from mmrjax.model import params
from mmrjax.model.params import Spec
from mmrjax.model.robot import Robot


class ActiveSet(eqx.Module):
    """Base coordinates, then the amplitudes and the shapes of the active effects.

    z = [base, amplitudes, shapes], all with standard normal priors: an amplitude is width · sd · z, a shape
    its nominal value times exp(spread · z). The effect in a slot is data, not structure, so that fits
    of many candidates are one vmapped batch. An empty slot keeps its coordinates at 0.

    Attributes:
        base: coordinates of the base parameters.
        active: index into `names` of the effect in each slot, -1 if it is empty, shape (slots,).
        sd: standard deviation of each effect's amplitude, including the width.
        scales: scales of each effect's shape, see `shape_scales`.
        names, shapes: names of the robot's effects, and of their shape parameters ("" for none).
    """

    base: Coordinates
    active: Int[Array, " slots"]
    sd: Float[Array, " effects"]
    scales: tuple[Array, Array, Array, Array, Array]
    names: Names = eqx.field(static=True)
    shapes: Names = eqx.field(static=True)

    @property
    def slots(self) -> int:
        """Number of slots."""
        return self.active.shape[-1]

    def __len__(self) -> int:
        return len(self.base) + 2 * self.slots

    def parts(self, z: Array) -> tuple[Array, Array, Array]:
        """Coordinates z, split into those of the base, of the amplitudes and of the shapes."""
        p, s = len(self.base), self.slots
        return z[..., :p], z[..., p : p + s], z[..., p + s :]

    def slot_matrix(self) -> Float[Array, "slots effects"]:
        """Matrix with a 1 in each slot's row, in the column of its effect, and zeros elsewhere."""
        return jnp.asarray(self.active[:, None] == jnp.arange(len(self.names)), float)

    def robot(self, robot: Robot, z: Float[Array, " coordinates"]) -> Robot:
        """Returns the robot at coordinates z. `robot` must have all effects of `names`."""
        base, amplitudes, shapes = _scaled_parts(self, z)
        values = {f"effects.{name}.amplitude": amplitudes[k] for k, name in enumerate(self.names)}
        pairs = enumerate(zip(self.names, self.shapes, strict=True))
        values |= {f"effects.{n}.{s}": shapes[k] for k, (n, s) in pairs if s}
        return params.replace(self.base.robot(robot, base), values)

    def indices(self, names: Sequence[str]) -> tuple[int, ...]:
        """Index of each effect, -1 for an empty slot ("")."""
        return tuple(self.names.index(name) if name else -1 for name in names)

    def with_effects(self, active: Sequence[int] | Array) -> ActiveSet:
        """Copy with these effects in the slots."""
        indices = (
            active if isinstance(active, jax.Array) else np.asarray(active, int)
        )  # avoids compiling a conversion
        return dataclasses.replace(self, active=jnp.asarray(indices, int))


@functools.partial(compiled, options=SELDOM)
def _scaled_parts(space: ActiveSet, z: Array) -> tuple[Array, tuple[Array, ...], tuple[Array, ...]]:
    """Base coordinates, and the amplitude and shape value of each effect."""
    base, amplitude, shape = space.parts(z)
    slot_matrix = space.slot_matrix()
    amplitudes = space.sd * (amplitude @ slot_matrix)
    shapes = shape_parameter_at(space.scales, shape @ slot_matrix)
    return base, params.split_numbers(amplitudes), params.split_numbers(shapes)


@dataclasses.dataclass(frozen=True)
class ScoredLibrary:
    """Effects that a search may add, each at every point of the grid of its shape parameter.

    Attributes:
        effects: effects that the data can reveal and that the robot does not have yet.
        scored: the same effects with the grids of their shapes. An effect at one grid point is an instance.
        of: index of the effect of each instance.
        at: shape coordinate of each instance, shape (instances,).
    """

    effects: tuple[Effect, ...]
    scored: tuple[ScoredEffect, ...]
    of: np.ndarray
    at: np.ndarray

    @property
    def names(self) -> Names:
        """Names of the effects."""
        return tuple(e.name for e in self.effects)

    def __len__(self) -> int:
        return len(self.effects)

    def __getitem__(self, name: str) -> Effect:
        return self.effects[self.names.index(name)]

    def largest(self, instances: np.ndarray) -> np.ndarray:
        """Largest value among the instances of each effect, shape (effects,). Values must not be negative."""
        largest = np.zeros(len(self))
        np.maximum.at(largest, self.of, instances)
        return largest

    def instances(self, name: str) -> np.ndarray:
        """Indices of the instances of an effect."""
        return np.flatnonzero(self.of == self.names.index(name))

    def columns(self, name: str, linear: Linearization) -> np.ndarray:
        """Sensitivity of the readings to each instance of an effect at a fit, shape (readings, instances)."""
        return np.asarray(linear.signatures)[:, self.instances(name)]

    def best_instance(self, name: str, single: np.ndarray) -> int:
        """Index of the instance of an effect that has the largest |score|."""
        instances = self.instances(name)
        return int(instances[np.argmax(np.abs(np.asarray(single)[instances]))])


@dataclasses.dataclass(frozen=True)
class CandidateSpace:
    """The fitting problems of a search: the base alone, and the base with effects of the library in a few slots.

    Attributes:
        bare: problem of the base alone.
        equipped: problem of the base and the effects in the slots.
        library: effects that the slots can hold.
        settings: statistical constants of the search.
        room: names of the effects that the compiled fits of time histories include, see `problem_for_sets`.
    """

    bare: Problem
    equipped: Problem
    library: ScoredLibrary
    settings: Settings
    room: Names = ()

    @property
    def coordinates(self) -> ActiveSet:
        """Coordinates of `equipped`."""
        return self.equipped.coordinates

    @property
    def free(self) -> int:
        """Number of free base parameters."""
        return len(self.coordinates.base)

    @property
    def included(self) -> np.ndarray:
        """True for each row with at least one reading of positive weight, shape (rows,)."""
        return np.asarray(self.bare.data.weight).max(1) > 0

    @property
    def weight(self) -> np.ndarray:
        """Weight of each reading, shape (rows, channels)."""
        return np.asarray(self.bare.data.weight)

    def without(self, rows: np.ndarray) -> CandidateSpace:
        """Copy in which some rows (a mask or indices) are ignored."""
        weight = self.weight.copy()
        weight[rows] = 0.0
        return self.with_noise(None, weight)

    def with_noise(self, sd: np.ndarray | None, weight: np.ndarray) -> CandidateSpace:
        """Copy with these standard deviations [SI] and weights of the readings, shape (rows, channels).

        Args:
            sd: None to keep those of the problem. Values of missing readings have no meaning.
        """

        def with_data(problem: Problem) -> Problem:
            problem_sd = np.asarray(problem.data.sd)
            new = problem_sd if sd is None else np.where(np.isfinite(sd) & (sd > 0), sd, problem_sd)
            return problem.with_data(sd=jnp.asarray(new), weight=jnp.asarray(weight))

        return dataclasses.replace(self, bare=with_data(self.bare), equipped=with_data(self.equipped))

    def with_room(self, names: Sequence[str]) -> CandidateSpace:
        """Copy whose compiled fits of time histories include these effects."""
        return dataclasses.replace(self, room=tuple(n for n in self.library.names if n in names))

    def problem_for_sets(self, sets: Iterable[Sequence[str]]) -> tuple[Problem, list[tuple[int, ...]]]:
        """One problem that can fit all these sets of effects, and the indices of each set in it.

        For settled runs, the problem has the whole library, so one compiled program serves every set. For time
        histories, each further effect makes steps and compilation slower. Their problem has only the effects of
        `room` and of the sets.
        """
        sets = [tuple(names) for names in sets]
        problem, coordinates = self.equipped, self.coordinates
        if self.bare.observe.long:
            included = {*self.room, *(n for names in sets for n in names if n)} or {*self.library.names[:1]}
            effect_indices = np.flatnonzero(np.isin(self.library.names, list(included)))
            scales: Any = tuple(x[effect_indices] for x in coordinates.scales)
            coordinates = dataclasses.replace(
                coordinates,
                sd=coordinates.sd[effect_indices],
                scales=scales,
                names=tuple(coordinates.names[k] for k in effect_indices),
                shapes=tuple(coordinates.shapes[k] for k in effect_indices),
            )
            included |= {e.name for e in self.bare.base.effects}
            robot = with_only(problem.base, included)
            problem = dataclasses.replace(problem, base=robot, coordinates=coordinates)
        return problem, [coordinates.indices(names) for names in sets]

    def fit_of(self, active: Sequence[str], z: np.ndarray) -> tuple[Problem, np.ndarray, tuple[int, ...] | None]:
        """Problem, coordinates and indices of the effects for one fit.

        A fit without effects uses the problem of the base, because its steps take at most a third of the time. If
        `room` has effects, their program serves this fit too.
        """
        if not any(active) and not self.room:
            return self.bare, np.asarray(z)[: self.free], None
        problem, (indices,) = self.problem_for_sets([active])
        return problem, np.asarray(z), indices

    def problem(self, active: Sequence[str]) -> Problem:
        """Problem with these effects in its slots."""
        problem, (indices,) = self.problem_for_sets([active])
        return dataclasses.replace(problem, coordinates=problem.coordinates.with_effects(indices))


def with_only(robot: Robot, names: Collection[str]) -> Robot:
    """The robot with those of its effects that have these names."""
    return dataclasses.replace(robot, effects=tuple(e for e in robot.effects if e.name in names))


def candidate_space(bare: Problem, effects: Sequence[Effect], library: Library, settings: Settings) -> CandidateSpace:
    """Candidate space of a base problem, with slots for effects of a library."""
    slots = settings.slots
    shapes = [free_shape_parameter(e) for e in effects]
    scales = [shape_scales(s) for s in shapes]
    value, spread, sd, low, high = (jnp.asarray([s[k] for s in scales]) for k in range(5))
    coordinates = ActiveSet(
        bare.coordinates,
        jnp.full(slots, -1, int),
        settings.width * jnp.asarray([amplitude_of(e).spec.prior_sd(0.0) for e in effects]),
        (value, spread, sd, low, high),
        tuple(e.name for e in effects),
        tuple("" if s is None else s.name for s in shapes),
    )
    existing = {e.name for e in bare.base.effects}
    added = tuple(library[e.name]() for e in effects if e.name not in existing)
    robot = params.without_weak_types(dataclasses.replace(bare.base, effects=(*bare.base.effects, *added)))
    data = dataclasses.replace(bare.data, centre=jnp.pad(bare.data.centre, (0, 2 * slots)))
    grids = tuple(with_shape_grid(e) for e in effects)
    effect_index = np.repeat(np.arange(len(grids)), [len(s.at) for s in grids])
    return CandidateSpace(
        bare,
        Problem(robot, coordinates, bare.observe, data),
        ScoredLibrary(tuple(effects), grids, effect_index, np.concatenate([s.at for s in grids])),
        settings,
    )


def posterior_of_fit(space: CandidateSpace, active: Names, z: np.ndarray, linear: Linearization) -> Posterior:
    """Posterior distribution of a fit of the base with effects, from its linearization.

    Args:
        active: effect in each slot, "" if empty.
        z: coordinates of the fit, of the base only or of all.
        linear: linearization of the fit.
    """
    jacobian = np.asarray(linear.jacobian)
    size = jacobian.shape[1]
    problem = space.bare if size == space.free else space.equipped
    informed = jacobian[informative_residuals(problem.data)]
    covariance = np.linalg.inv(informed.T @ informed)
    parts, used = coordinate_groups(problem.coordinates, space, active, np.asarray(z)[:size])
    return join_posteriors(parts, covariance[np.ix_(used, used)])


def coordinate_groups(
    coordinates: Coordinates | ActiveSet, space: CandidateSpace, active: Names, z: np.ndarray
) -> tuple[list[Posterior], list[int]]:
    """Posterior of each group of coordinates, and the indices of these coordinates in z. Empty slots and missing
    shapes are left out.
    """
    if not isinstance(coordinates, ActiveSet):
        return [posterior_of_coordinates(coordinates, z, np.eye(len(z)))], list(range(len(z)))
    p, slots = len(coordinates.base), coordinates.slots
    base = posterior_of_coordinates(coordinates.base, z[:p], np.eye(p))
    rows: list[tuple[Any, ...]] = []
    for slot, name in enumerate(active):
        if not name:
            continue
        amplitude, shape = amplitude_of(space.library[name]).spec, free_shape_parameter(space.library[name])
        sd = float(coordinates.sd[coordinates.names.index(name)])
        rows.append((p + slot, f"effects.{name}.amplitude", amplitude, 0.0, sd, *amplitude.bounds, NORMAL))
        if shape is not None:
            index, full_name = p + slots + slot, f"effects.{name}.{shape.name}"
            value, spread, angle_sd, low, high = shape_scales(shape)
            if spread > 0:
                ends = math.log(low) if low > 0 else -math.inf, math.log(high)
                rows.append((index, full_name, shape.spec, math.log(value), spread, *ends, LOG))
            else:
                rows.append((index, full_name, shape.spec, value, angle_sd, -math.inf, math.inf, ANGLE))
    if not rows:
        return [base], list(range(p))
    places, names, specs, *numbers, kinds = zip(*rows, strict=True)
    location, spreads, lows, highs = np.array(numbers, float)
    effects = dataclasses.replace(
        clipped_parameters(names, specs, z[list(places)]),
        location=location, spread=spreads, low=lows, high=highs, kinds=kinds,
    )  # fmt: skip
    return [base, effects], [*range(p), *places]


def clipped_parameters(names: Names, specs: Sequence[Spec], mean: np.ndarray) -> Posterior:
    """Posterior of parameters that are their own coordinates, clipped at their bounds."""
    size = len(names)
    return Posterior(
        coordinates=names, units=tuple(s.unit for s in specs), mean=mean, covariance=np.eye(size),
        location=np.zeros(size), spread=np.ones(size), low=np.array([s.bounds[0] for s in specs], float),
        high=np.array([s.bounds[1] for s in specs], float), softness=np.zeros(size), kinds=(NORMAL,) * size,
    )  # fmt: skip
