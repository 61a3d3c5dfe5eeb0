"""Every effect of the library acts in the track model unchanged, as much as in the steady one or in a start."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from mmrjax.effects import ALL
from mmrjax.fidelities.steady import steady
from mmrjax.fidelities.track import track
from mmrjax.model import paper_robots, params
from mmrjax.model.conditions import Conditions

pytestmark = pytest.mark.slow  # compiles for a minute

SETTLED = tuple(e for e in ALL if not e.transient)
TRANSIENT = tuple(e for e in ALL if e.transient)
OUTPUTS = ("total_current", "motor_speed", "speed")
RUNS = Conditions(
    voltage=[33.0, 24.0, 24.0],
    slope_deg=[3.0, 5.0, -12.0],  # down the last one the load drives the motors
    payload=[3.0, 0.0, 3.0],
    configuration=[0.0, 1.0, 1.0],
    battery=[0.0, 1.0, 0.0],  # 4W2T on its battery, whose effects act there alone
    duty=[1.0, 1.0, 0.9],  # effects of the driver act below 1
)


@pytest.fixture(scope="module")
def slopes():
    """Derivatives of the outputs by every amplitude at zero, in the track and in the steady model."""
    names = [f"effects.{effect.name}.amplitude" for effect in SETTLED]
    bare = dataclasses.replace(paper_robots.nominal(), effects=tuple(effect() for effect in SETTLED))
    sizes = [dict((p.name, p.spec) for p in params.walk_parameters(bare))[n].prior_sd(0.0) for n in names]

    def robot(theta, share):
        amplitudes = {name: theta[k] * sizes[k] for k, name in enumerate(names)}
        return params.replace(bare, amplitudes | {"6T2A.track.guide_share": share})

    def observed(reading):
        return jnp.stack([reading[name] for name in OUTPUTS])

    def resolved(theta, run):
        answer = track(robot(theta, jnp.asarray(0.98)), run, duration=0.4, rolling=True)
        return observed(answer.result.reading), answer.steady.guide_share

    def lumped(theta, run, share):
        return observed(steady(robot(theta, share), run).reading)

    at = jnp.zeros(len(SETTLED))
    ours, share = jax.jit(jax.vmap(jax.jacfwd(resolved, has_aux=True), in_axes=(None, 0)))(at, RUNS)
    theirs = jax.jit(jax.vmap(jax.jacfwd(lumped), in_axes=(None, 0, 0)))(at, RUNS, share)
    return np.asarray(ours), np.asarray(theirs)


@pytest.mark.parametrize("k", range(len(SETTLED)), ids=[effect.name for effect in SETTLED])
def test_effect_acts_as_in_the_steady_model(slopes, k):
    """To 5 % of its largest action on the same output (ripple, and the share that shifts with the load).

    A slip that follows the ripple of load or demand moves the current a little, where `steady` has none: the
    scale of an output is at least 0.5 % of the strongest effect's.
    """
    ours, theirs = slopes[0][..., k], slopes[1][..., k]
    assert np.isfinite(ours).all()
    assert np.abs(ours).max() > 0
    scale = np.maximum(np.abs(theirs).max(axis=0), 5e-3 * np.abs(slopes[1]).max(axis=(0, 2)))
    assert_allclose(ours / scale, theirs / scale, atol=0.05)


@pytest.fixture(scope="module")
def start_slopes():
    """Derivatives of a start's history by the amplitudes of the effects that only a series shows."""
    bare = dataclasses.replace(paper_robots.nominal(), effects=tuple(effect() for effect in TRANSIENT))
    sizes = [
        dict((p.name, p.spec) for p in params.walk_parameters(bare))[f"effects.{e.name}.amplitude"].prior_sd(0.0)
        for e in TRANSIENT
    ]

    def history(theta):
        amplitudes = {f"effects.{e.name}.amplitude": theta[k] * sizes[k] for k, e in enumerate(TRANSIENT)}
        run = track(params.replace(bare, amplitudes), jax.tree.map(lambda x: x[0], RUNS), duration=0.1)
        return jnp.stack([run.signals.total_current, run.signals.speed_motor, run.signals.speed])

    return np.asarray(jax.jit(jax.jacfwd(history))(jnp.zeros(len(TRANSIENT))))


@pytest.mark.slow
@pytest.mark.parametrize("k", range(len(TRANSIENT)), ids=[effect.name for effect in TRANSIENT])
def test_transient_effect_is_felt_in_a_start(start_slopes, k):
    assert np.isfinite(start_slopes[..., k]).all()
    assert np.abs(start_slopes[..., k]).max() > 1e-6
