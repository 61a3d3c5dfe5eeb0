"""Setups of a robot for experiments: lifted, motors alone, held, braked, turned about."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import jax.numpy as jnp

from mmrjax.model import params
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot

#: Friction of a shaft that is held in a vice [N·m].
BLOCKED = 1e3
#: Function of the robot and the brake's torque on each motor shaft [N·m] that returns the robot as set up.
Setup = Callable[[Robot, Scalar], Robot]


def _with(robot: Robot, values: Mapping[str, Scalar]) -> Robot:
    return params.replace(robot, {k: jnp.asarray(v, float) for k, v in values.items()})


def without(robot: Robot, *closed: str) -> Robot:
    """The robot without the effects that enter the balances `closed`."""
    return _with(robot, {f"effects.{e.name}.amplitude": 0.0 for e in robot.effects if e.balance in closed})


def on_ground(robot: Robot, brake: Scalar = 0.0) -> Robot:
    """The unchanged robot. All setups except `braked` ignore the brake."""
    return robot


def reversed_(robot: Robot, brake: Scalar = 0.0) -> Robot:
    """The robot turned about, so that its travel is forward again.

    With the negative of the slope as condition, friction, slip and meters are unchanged, because they follow the
    travel. Effects that are odd in travel change sign: an error of the slope remains but now drives, and so does
    the zero error of an instrument with signed readings.
    """
    odd = (e for e in robot.effects if e.odd_in_travel and e.channel not in robot.rig.magnitudes)
    biased = {f"effects.{e.name}.amplitude": -e.amplitude for e in odd}
    return _with(robot, biased)


def lifted(robot: Robot, brake: Scalar = 0.0) -> Robot:
    """The robot on stands, with its movers in the air: no normal load, no ground."""
    rolling = {f"{c}.ground.rolling_resistance": 0.0 for c in robot.configurations}
    return _with(without(robot, "mass", "ground", "slip"), rolling)


def bare(robot: Robot, brake: Scalar = 0.0) -> Robot:
    """The motors with their gearboxes uncoupled. Only supply, electrical and motor balances remain."""
    losses = {f"{c}.track.loss_{kind}": 0.0 for c in robot.configurations for kind in ("coulomb", "viscous")}
    gear = {"gearbox.friction_coulomb": 0.0, "gearbox.friction_viscous": 0.0, "gearbox.efficiency_load": 1.0}
    return _with(without(lifted(robot), "gearbox", "track"), losses | gear)


def blocked(robot: Robot, brake: Scalar = 0.0) -> Robot:
    """The motors with their shafts held: U_e = E + I R at speed 0."""
    return _with(lifted(robot), {"gearbox.friction_coulomb": BLOCKED})


def braked(robot: Robot, brake: Scalar = 0.0) -> Robot:
    """The bare motors, each against a brake of constant torque [N·m]."""
    return _with(bare(robot), {"gearbox.friction_coulomb": brake})


#: Setups that carry no weight.
WEIGHTLESS = (lifted, bare, blocked, braked)
