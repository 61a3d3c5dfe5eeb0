"""Derivatives of the track model of both sides, forward, against central differences: averages and path of a turn.

Differences by a voltage need a small step: it moves the instants at which grousers begin to bear, and one that does
so within the step leaves an error in proportion to it (docs/explanation/track-model.md).
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_less

from mmrjax.fidelities.track import track
from mmrjax.model import params
from mmrjax.model.conditions import Conditions
from mmrjax.undercarriage import both_sides

PARAMETERS = ("6T2A.ground.friction.static", "6T2A.turning.lateral", "6T2A.turning.width", "6T2A.track.loss_coulomb")
VOLTAGES = ("duty_left", "duty_right")
READINGS = ("motor_current_left", "motor_current_right", "motor_speed_left", "motor_speed_right", "yaw_rate")
PATH = [both_sides.X, both_sides.Y, both_sides.YAW]
#: The change of each by which differences are taken, of itself.
STEP = 1e-7


@pytest.fixture(scope="module", params=[True, False], ids=["rolling", "standstill"])
def found(request, robot):
    """Derivatives of averages and of the path at four times, and differences of the same."""
    values = {p.name: p.value for p in params.walk_parameters(robot)}
    # At a duty of 1 the driver limits the side of the difference beyond it.
    turn = Conditions("6T2A", voltage=24.0, duty_left=0.95, duty_right=0.42).resolved(robot)

    def shown(theta):
        by, of_sides = theta[: len(PARAMETERS)], theta[len(PARAMETERS) :]
        changed = {name: values[name] * (1 + x) for name, x in zip(PARAMETERS, by, strict=True)}
        duties = {name: getattr(turn, name) * (1 + x) for name, x in zip(VOLTAGES, of_sides, strict=True)}
        run = track(
            params.replace(robot, changed), dataclasses.replace(turn, **duties), duration=0.2, rolling=request.param
        )
        return jnp.stack([run.result.reading[name] for name in READINGS]), run.q[49::50, PATH]

    count = len(PARAMETERS) + len(VOLTAGES)
    moved = STEP * jnp.concatenate([jnp.eye(count), -jnp.eye(count)])
    slopes = jax.jit(jax.jacfwd(shown))(jnp.zeros(count))
    values_at = jax.jit(jax.vmap(shown))(moved)
    differences = [np.moveaxis((x[:count] - x[count:]) / (2 * STEP), 0, -1) for x in values_at]
    return [np.asarray(x) for x in slopes], differences


@pytest.mark.slow
@pytest.mark.parametrize("which, least", [(0, 1e-3), (1, 1e-7)], ids=["averages", "path"])
def test_derivatives_are_differences(found, which, least):
    """To 1e-4 of the largest that the same input has. Of the path along the run, of place and yaw each."""
    slopes, differences = found[0][which], found[1][which]
    size = np.abs(differences).max(axis=0)
    assert (size > least).all()
    assert_array_less(np.abs(slopes - differences) / size, 1e-4)
