"""Posterior of the loop's result: base parameters, effects' amplitudes and shapes, curves' ordinates."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from calibration.data import Names
from calibration.data.posterior_file import ANGLE, LOG, NORMAL, Posterior, join_posteriors
from calibration.discovery.active_set import ActiveSet, CandidateSpace
from calibration.discovery.discrepancy import CurveCoordinates, Discrepancy
from calibration.inference.identifiability import posterior_of_coordinates
from calibration.inference.linearization import Linearization, amplitude_of, free_shape_parameter, shape_scales
from calibration.inference.optimizers import informative_residuals
from calibration.inference.priors import Coordinates
from mmrjax.model import params
from mmrjax.model.params import Spec


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
    parts, kept_places = _coordinate_groups(problem.coordinates, space, active, np.asarray(z)[:size])
    return join_posteriors(parts, covariance[np.ix_(kept_places, kept_places)])


def posterior_of_curve(space: CandidateSpace, active: Names, curve: Discrepancy) -> Posterior:
    """Posterior distribution of a fit with a smooth curve. The ordinates are linear in their coordinates and come
    last.
    """
    shaped: CurveCoordinates = curve.problem.coordinates
    inner = len(shaped.base)
    turn = np.eye(len(shaped))
    turn[inner:, inner:] = np.asarray(shaped.root)
    base, kept_places = _coordinate_groups(shaped.base, space, active, curve.z[:inner])
    spec = {p.name: p.spec for p in params.walk_parameters(curve.problem.base)}
    ordinates = _clipped_parameters(
        shaped.names, [spec[n] for n in shaped.names], np.asarray(shaped.root) @ curve.z[inner:]
    )
    places = [*kept_places, *range(inner, len(shaped))]
    covariance = (turn @ curve.covariance @ turn.T)[np.ix_(places, places)]
    return join_posteriors([*base, ordinates], covariance)


def _coordinate_groups(
    coordinates: Coordinates | ActiveSet, space: CandidateSpace, active: Names, z: np.ndarray
) -> tuple[list[Posterior], list[int]]:
    """Posterior of each group of coordinates, and the indices of these coordinates in z. Empty slots and missing
    shapes are left out.
    """
    if not isinstance(coordinates, ActiveSet):
        return [posterior_of_coordinates(coordinates, z, np.eye(len(z)))], list(range(len(z)))
    p, slots = len(coordinates.base), coordinates.slots
    parts, kept_places = [posterior_of_coordinates(coordinates.base, z[:p], np.eye(p))], list(range(p))
    for slot, name in enumerate(active):
        if not name:
            continue
        effect = space.library[name]
        amplitude = amplitude_of(effect)
        sd = float(coordinates.sd[coordinates.names.index(name)])
        of_amplitude = _clipped_parameters(
            (f"effects.{name}.amplitude",), [amplitude.spec], np.array([sd * z[p + slot]])
        )
        parts.append(dataclasses.replace(of_amplitude, mean=z[p + slot, None], spread=np.array([sd])))
        kept_places.append(p + slot)
        shape = free_shape_parameter(effect)
        if shape is None:
            continue
        value, spread, angle_sd, low, high = shape_scales(shape)
        log = spread > 0
        of_shape = _clipped_parameters((f"effects.{name}.{shape.name}",), [shape.spec], np.zeros(1))
        bounds = (math.log(low) if low > 0 else -math.inf, math.log(high)) if log else (-math.inf, math.inf)
        parts.append(
            dataclasses.replace(
                of_shape, mean=z[p + slots + slot, None], location=np.array([math.log(value) if log else value]),
                spread=np.array([spread if log else angle_sd]), low=np.array([bounds[0]]), high=np.array([bounds[1]]),
                kinds=(LOG if log else ANGLE,),
            )
        )  # fmt: skip
        kept_places.append(p + slots + slot)
    return parts, kept_places


def _clipped_parameters(names: Names, specs: list[Spec], mean: np.ndarray) -> Posterior:
    """Posterior of parameters that are their own coordinates, clipped at their bounds."""
    size = len(names)
    return Posterior(
        coordinates=names, units=tuple(s.unit for s in specs), mean=mean, covariance=np.eye(size),
        location=np.zeros(size), spread=np.ones(size), low=np.array([s.bounds[0] for s in specs], float),
        high=np.array([s.bounds[1] for s in specs], float), softness=np.zeros(size), kinds=(NORMAL,) * size,
    )  # fmt: skip
