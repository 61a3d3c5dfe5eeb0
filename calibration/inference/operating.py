"""Operating points of a robot under the conditions of a table: approximate readings before any fit."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
from jaxtyping import Float

from calibration.data import Names
from mmrjax.fidelities.steady import results_of_rows
from mmrjax.model import channels
from mmrjax.model.conditions import Conditions
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Result, Signals, is_done

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
    if not conditions.turns:  # the load of a turn is friction
        gripping = jax.device_put(np.full(conditions.shape[0], GRIPPING))
        conditions = dataclasses.replace(conditions, adhesion=gripping)
    readings = travel_of_rows(robot, conditions, rests=conditions.held is not None)[0]
    reading = np.stack([np.asarray(readings.reading[c]) for c in names or channels.channel_names(robot.channels)], 1)
    return np.where(np.asarray(is_done(readings.status))[:, None], reading, np.nan)


def travel_of_rows(robot: Robot, conditions: Conditions, rests: bool = False) -> tuple[Result, Signals]:
    """Results and signals of steady travel, see `results_of_rows`.

    The robot's own mass is stated in the conditions, so that tables with and without a mass share a program.
    """
    if not conditions.turns and conditions.total_mass is None:
        masses = np.asarray([float(c.mass) for c in robot.configurations.members])
        mass = masses[np.asarray(conditions.configuration)] + np.asarray(conditions.payload)
        conditions = dataclasses.replace(conditions, total_mass=jax.device_put(mass))
    rig = dataclasses.replace(robot.rig, begins=None)  # of histories
    return results_of_rows(dataclasses.replace(robot, rig=rig), conditions, rests)
