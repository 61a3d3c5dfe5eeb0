"""How averages of runs depend on step and contact stiffness. Energy of a run: tests/test_track_turning.py."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from mmrjax.fidelities.track import track
from mmrjax.model import params
from mmrjax.model.conditions import Conditions


@pytest.fixture(scope="module")
def averages():
    runs = Conditions(
        voltage=[33.0, 33.0, 15.0, 33.0],
        slope_deg=[0.0, 10.0, 5.0, 10.0],
        payload=[0.0, 8.0, 0.0, 8.0],
        configuration=[0.0, 0.0, 0.0, 1.0],
    )

    @eqx.filter_jit
    def settled(robot, step):
        reading = jax.vmap(lambda run: track(robot, run, duration=0.8, step=step, rolling=True).result.reading)(runs)
        return jnp.stack([reading["total_current"], reading["motor_speed"], reading["speed"]])

    return lambda robot, step: np.asarray(settled(robot, step))


@pytest.mark.slow
def test_averages_do_not_depend_on_the_step(averages, robot):
    """Halved: less than 0.3 %."""
    assert_allclose(averages(robot, 5e-5), averages(robot, 1e-4), rtol=3e-3)


@pytest.mark.slow
def test_averages_hardly_depend_on_the_contact_stiffness(averages, robot):
    """Doubled: less than 0.3 %."""
    stiffer = params.replace(robot, {"running_gear.contact_stiffness": 2 * robot.running_gear.contact_stiffness})
    assert_allclose(averages(stiffer, 1e-4), averages(robot, 1e-4), rtol=3e-3)
