"""Operating points of a robot under the conditions of a table: approximate readings before any fit."""

from __future__ import annotations

import dataclasses
import functools

import jax
import numpy as np
from jaxtyping import Float

from calibration.data import Names
from mmrjax.compile.compiling import SELDOM, compiled
from mmrjax.fidelities.steady import results_of_rows, steady
from mmrjax.model import channels, params
from mmrjax.model.conditions import Conditions
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Result, is_done

#: Conditions are padded to a multiple of this, so that tables of similar size share compiled programs.
PAD = 16
#: Adhesion ratio at which no robot slides; the motors' load depends only weakly on the slip.
GRIPPING = 20.0


def operating_readings(
    robot: Robot, conditions: Conditions, names: Names | None = None
) -> Float[np.ndarray, "runs channels"]:
    """Predicted readings of steady travel without sliding, and of turns on their own surface [SI].

    NaN if the robot cannot move.

    Args:
        conditions: conditions of the runs, shape (runs,).
        names: names of the channels. None: those of the robot.
    """
    runs = conditions.shape[0]
    index = np.concatenate([np.arange(runs), np.zeros(-runs % PAD, int)])
    mass = conditions.total_mass
    if mass is None:
        masses = np.asarray([float(c.mass) for c in robot.configurations.members])
        mass = masses[np.asarray(conditions.configuration)] + np.asarray(conditions.payload)
    gripping, own_mass = jax.device_put((np.full(runs, GRIPPING), np.asarray(mass)))
    posed = dataclasses.replace(conditions, adhesion=gripping, total_mass=own_mass)
    if conditions.turns:  # the load of a turn is friction
        posed = conditions
    padded = jax.tree.map(lambda x: jax.device_put(np.asarray(x)[index]), posed)
    strong = params.without_weak_types(robot)
    readings = results_of_rows(strong, padded)[0] if conditions.turns else _steady_results(strong, padded)
    reading = np.stack([np.asarray(readings.reading[c]) for c in names or channels.channel_names(robot.channels)], 1)[
        :runs
    ]
    moving = is_done(np.asarray(readings.status))[:runs]
    return np.where(moving[:, None], reading, np.nan)


@functools.partial(compiled, options=SELDOM)
def _steady_results(robot: Robot, conditions: Conditions) -> Result:
    return jax.vmap(lambda c: steady(robot, c))(conditions)
