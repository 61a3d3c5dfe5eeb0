"""How often the 95 % intervals of a fit hold a known truth, over draws of readings and bench values."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from calibration.inference import identifiability
from calibration.inference import optimizers as fit
from calibration.inference.optimizers import Pin
from mmrjax.compile.compiling import compiled


@compiled
def _redraw(problem, truth, data, keys, profiles):
    clean = problem.observation(truth).reading

    def draw(key):
        one, two = jax.random.split(key)
        noisy = dataclasses.replace(
            data,
            measured=clean + data.sd * jax.random.normal(one, clean.shape),
            centre=truth + jax.random.normal(two, truth.shape),
        )
        best, _ = fit.levenberg_marquardt(problem, truth, noisy)
        if not profiles:
            return best, jnp.zeros_like(truth)
        held = jnp.eye(truth.shape[0], dtype=bool)
        pinned = jax.vmap(lambda h: fit.levenberg_marquardt(problem, truth, noisy, Pin(h, truth))[0])(held)
        return best, 2 * (pinned.cost - best.cost)

    return jax.vmap(draw)(keys)


@dataclasses.dataclass(frozen=True)
class Coverage:
    """How often 95 % intervals hold a known truth.

    Attributes:
        linear: share of draws with the truth within z ± 1.96 sd, shape (parameters,).
        profile: share with the truth within the profile interval (NaN if not asked for).
        z: where each draw's fit ended, shape (draws, parameters).
        converged: whether it did, shape (draws,).
    """

    linear: np.ndarray
    profile: np.ndarray
    z: np.ndarray
    converged: np.ndarray


def coverage(problem, truth, draws, seed, profiles=False):
    """Coverage of the 95 % intervals over noise draws, all in one vmapped batch.

    Each draw takes new readings (with their sds) and new bench values (the prior means, with theirs): a
    prior is a measurement made beforehand, and intervals that use it cover only if it errs as it says.
    The truth lies within a profile interval where the objective, refitted with the parameter held at its
    truth, rises by less than the 95 % quantile of χ² with one degree of freedom. That is one refit more
    for each parameter and draw.
    """
    keys = jax.random.split(jax.random.key(seed), draws)
    found, rise = _redraw(problem, truth, problem.data, keys, profiles)
    inside = np.abs(np.asarray(found.z - truth)) <= identifiability.Z95 * np.asarray(found.sd)
    within = (np.asarray(rise) < identifiability.Z95**2).mean(0) if profiles else np.full(truth.shape[0], np.nan)
    return Coverage(inside.mean(0), within, np.asarray(found.z), np.asarray(found.converged))
