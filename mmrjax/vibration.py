"""Friction of contacts that shake: the law of Fig. 7 averaged over their oscillation.

A track that runs over its grousers shakes: reaction and sliding speed of each contact swing about their means.
Friction does not average, so a robot may slip far more than Fig. 7 says of its mean demand (Section 3.2.4, ref. [46];
Blekhman, Vibrational Mechanics, 2000: dry friction turns into an apparent viscous one). docs/vibration.md derives it.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mmrjax import undercarriage
from mmrjax.conditions import Conditions
from mmrjax.contact import Friction
from mmrjax.fidelities.half_robot import system
from mmrjax.fidelities.track import STEP, Trajectory
from mmrjax.params import Scalar
from mmrjax.robot import Robot
from mmrjax.undercarriage import GROUSERS

#: Second harmonic of the sliding speed over the first: two events a pitch, a grouser landing in front and one lifting
#: at the rear. Bursts of sliding are short and steep with it, as in the track model (docs/vibration.md).
SECOND = 0.5
#: Phases over which is averaged.
PHASES = 128
_BISECTIONS = 40


def _wave() -> Float[np.ndarray, " phases"]:
    phase = 2 * np.pi * (np.arange(PHASES) + 0.5) / PHASES
    wave = np.cos(phase) + SECOND * np.cos(2 * phase)
    return np.asarray(wave / np.mean(np.abs(wave)))


#: Sliding speed less its mean, over its mean size: mean 0, mean size 1.
WAVE = _wave()


def coefficient(friction: Friction, speed: Scalar, swing: Scalar) -> Scalar:
    """Mean friction coefficient [-] of contacts that slide at `speed` on average and swing about it by `swing`, the
    mean size of the difference [m/s]: (1/2π) ∫ μ(v + s ξ(φ)) dφ. Without swing that of Fig. 7."""
    return jnp.mean(friction.coefficient(speed + swing * jnp.asarray(WAVE)))


def speed_sliding(friction: Friction, demanded: Scalar, swing: Scalar) -> Scalar:
    """Mean sliding speed [m/s] at which shaking contacts carry the coefficient `demanded` [-], scalars.

    The inverse of `coefficient`; without swing `Friction.speed_creep`. NaN where they carry it at no speed.
    """
    furthest = friction.speed_static + swing * float(np.abs(WAVE).max())

    def narrower(between: tuple[Scalar, Scalar], _: None) -> tuple[tuple[Scalar, Scalar], None]:
        low, high = between
        middle = (low + high) / 2
        less = coefficient(friction, middle, swing) < demanded
        return (jnp.where(less, middle, low), jnp.where(less, high, middle)), None

    (low, high), _ = jax.lax.scan(narrower, (-furthest, furthest), None, length=_BISECTIONS)
    root = jax.lax.stop_gradient((low + high) / 2)
    value, slope = jax.jvp(lambda v: coefficient(friction, v, swing), (root,), (jnp.ones_like(root),))
    carried = coefficient(friction, furthest, swing) >= demanded
    # One step of Newton leaves the root where it is and gives it its derivatives.
    return jnp.where(carried, root - (value - demanded) / jnp.where(slope > 0, slope, 1.0), jnp.nan)


class Ripple(eqx.Module):
    """How the contacts of one run shake, over its averaging window. The speed lost that follows is the mean sliding
    that carries the demand (`speed_sliding`), less the lead.

    Attributes:
        swing: mean size of the sliding speed less its mean [m/s]; lead: mean less plain mean of the sliding speed
            [m/s], positive where contacts slide faster while they bear more. Means are weighted by load.
        normal: sd over mean of the ground's reaction [-].
        demanded: mean traction over mean reaction and adhesion [-].
    """

    swing: Scalar
    lead: Scalar
    normal: Scalar
    demanded: Scalar


def ripple(robot: Robot, conditions: Conditions, run: Trajectory, window: float = 0.8) -> Ripple:
    """Ripple of one run on tracks (scalar fields) over its last `window` [s]; samples of 0.2 ms or less tell it."""
    half = system(robot, conditions, STEP)

    def contacts(q: Float[Array, " 5"], v: Float[Array, " 5"]) -> tuple[Array, Array]:
        at = undercarriage.touch(half.path, half.chassis, q, v)
        return at.force[:GROUSERS], -at.speed_x[:GROUSERS]

    late = run.time > run.time[-1] - window
    force, sliding = jax.vmap(contacts)(run.q, run.v)
    load = jnp.where(late[:, None], force, 0.0)
    signals = run.steady.signals

    def mean(values: Array) -> Scalar:
        return jnp.sum(load * values) / jnp.sum(load)

    centre, reaction = mean(sliding), jnp.sum(force, axis=1)
    return Ripple(
        swing=mean(jnp.abs(sliding - centre)),
        lead=centre - (signals.speed_theoretical - signals.speed),
        normal=jnp.std(reaction, where=late) / jnp.mean(reaction, where=late),
        demanded=signals.traction / (signals.normal * signals.adhesion),
    )
