"""Rest: whether friction holds a robot that stands, and the current that flows in it then."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from mmrjax import balances
from mmrjax.conditions import Conditions
from mmrjax.params import Scalar
from mmrjax.robot import Robot
from mmrjax.signals import State

#: Torque at the driving wheel that counts as much as the whole weight of a side [N·m].
TORQUE = 1.0


def firmness(robot: Robot, conditions: Conditions, state: State) -> Scalar:
    """How firmly friction would hold the robot at rest, negative where it cannot [-].

    Its shafts stand where the motors and gravity together can turn them neither way against friction at rest, its
    movers where gravity along the slope is below the ground's adhesion.
    """
    at_rest = dataclasses.replace(state, speed_motor=jnp.zeros_like(state.speed), speed=jnp.zeros_like(state.speed))
    forward, _ = balances.settled(robot, conditions, at_rest, 1.0)
    backward, _ = balances.settled(robot, conditions, at_rest, -1.0)
    shafts = jnp.minimum(-forward.torque_net, backward.torque_net) / TORQUE
    along = jnp.maximum(backward.demand, -forward.demand)
    if robot.on_shaft:
        return shafts
    ground = (forward.adhesion_limit - along) / forward.normal
    return jnp.minimum(shafts, ground)


def current_at_rest(robot: Robot, conditions: Conditions, state: State) -> Scalar:
    """Current to which that of a standing robot settles [A], on the line through two of its voltage balance."""

    def left(current: Scalar) -> Scalar:
        still = jnp.zeros_like(state.speed)
        at_rest = dataclasses.replace(state, current=current, speed_motor=still, speed=still)
        return balances.settled(robot, conditions, at_rest, 0.0)[0].voltage_left

    guess = left(jnp.zeros_like(state.current)) / robot.motor.resistance
    first, second = left(0.5 * guess), left(guess)
    slope = (second - first) / jnp.where(guess == 0, 1.0, 0.5 * guess)
    return guess - jnp.where(guess == 0, 0.0, second / jnp.where(guess == 0, 1.0, slope))
