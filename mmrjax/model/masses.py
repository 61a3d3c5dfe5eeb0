"""Masses of half a robot, summed from its parts in their posture."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mmrjax.model import params
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.undercarriage.running_gear import RunningGear


class HalfRobotMasses(eqx.Module):
    """Masses and inertias of half a robot [kg, m, kg·m²].

    Attributes:
        chassis: mass of all parts that do not turn with the pulleys.
        forward, up: centre of mass relative to the middle of the wheelbase.
        inertia: moment of inertia in pitch about the centre of mass.
        body: mass without pulleys, wheels, tracks, levers and payload.
        pulley: mass on one axle that turns with it: main and additional pulley, in 4W2T the wheel.
        inertia_pulley: about its axle, front and rear equal: half of J_w of eq. (31) each.
    """

    chassis: Scalar
    forward: Scalar
    up: Scalar
    inertia: Scalar
    body: Scalar
    pulley: Scalar
    inertia_pulley: Scalar

    @property
    def centre(self) -> tuple[Scalar, Scalar]:
        """Centre of mass of all parts, ahead of the middle of the wheelbase and above it [m].

        Pulleys sit on the axles.
        """
        share = self.chassis / (self.chassis + 2 * self.pulley)
        return share * self.forward, share * self.up

    def inertia_about_middle(self, wheelbase: Scalar) -> Scalar:
        """Moment of inertia in pitch of all parts about the middle of the wheelbase [kg·m²].

        Pulleys do not turn on their axles. Their own inertia J about the axles is not included.
        """
        return self.inertia + self.chassis * (self.forward**2 + self.up**2) + self.pulley * wheelbase**2 / 2

    def inertia_pitch(self, wheelbase: Scalar) -> Scalar:
        """Moment of inertia in pitch of half a robot about its centre [kg·m²]."""
        total = self.chassis + 2 * self.pulley
        moment_squared = self.chassis**2 * (self.forward**2 + self.up**2)
        return self.inertia_about_middle(wheelbase) + 2 * self.inertia_pulley - moment_squared / total


class _RigidPart(NamedTuple):
    """A rigid part: mass [kg], centre from the middle of the wheelbase [m], inertia in pitch about it [kg·m²]."""

    mass: Scalar
    forward: Scalar
    up: Scalar
    inertia: Scalar


def _joined_parts(parts: list[_RigidPart]) -> _RigidPart:
    """Parts joined rigidly: Σ J + Σ m d² about their common centre (Huygens and Steiner)."""
    mass = sum(p.mass for p in parts)
    forward = sum(p.mass * p.forward for p in parts) / mass
    up = sum(p.mass * p.up for p in parts) / mass
    inertia = sum(p.inertia + p.mass * ((p.forward - forward) ** 2 + (p.up - up) ** 2) for p in parts)
    return _RigidPart(mass, forward, up, inertia)


def _belt_part(gear: RunningGear, radius: Scalar) -> _RigidPart:
    """A main track round its pulleys. Its inertia is reduced by m r², which is in J_w and turns with the pulleys."""
    wheelbase, mass = gear.wheelbase, gear.belt_mass
    straights = 2 * wheelbase * (wheelbase**2 / 12 + radius**2)
    arcs = 2 * radius * (jnp.pi * wheelbase**2 / 4 + 2 * wheelbase * radius + jnp.pi * radius**2)
    inertia = mass * (straights + arcs) / (2 * wheelbase + 2 * jnp.pi * radius)
    zero_mass = jnp.zeros_like(mass)
    return _RigidPart(mass, zero_mass, zero_mass, inertia - mass * radius**2)


def lever_angles(gear: RunningGear, conditions: Conditions) -> tuple[Scalar, Scalar]:
    """Angles of front and rear levers, 0 along the wheelbase outward, positive up [rad].

    They come from the conditions, else from the running gear, which measures the rear one from forward.
    """
    front, rear = conditions.levers_front_deg, conditions.levers_rear_deg
    return (
        gear.lever_front if front is None else jnp.radians(front),
        jnp.pi - gear.lever_rear if rear is None else jnp.radians(rear),
    )


def _lever_parts(gear: RunningGear, tracked: Scalar, front: Scalar, rear: Scalar) -> list[_RigidPart]:
    """The levers of one side at their angles [rad], see `lever_angles`."""
    mass = gear.lever_mass * tracked
    inertia = gear.lever_inertia * tracked
    half_wheelbase = gear.wheelbase / 2
    centre_distance = gear.lever_centre
    return [
        _RigidPart(
            mass,
            side * (half_wheelbase + centre_distance * jnp.cos(angle)),
            centre_distance * jnp.sin(angle),
            inertia,
        )
        for side, angle in ((1.0, front), (-1.0, rear))
    ]


def masses_of_parts(robot: Robot, conditions: Conditions, mass: Scalar) -> HalfRobotMasses:
    """Masses of half a robot whose total with payload is `mass` [kg], as `balances.begin_signals` gives it.

    The body's mass is the rest after pulleys, wheels, tracks, levers and payload. It has its own radius of gyration.
    The moment of inertia is summed over the parts at the lever angles. A robot may state the inertia of the whole
    with folded levers and without payload (`inertia_tracked`, `inertia_wheeled`). The body's is then the difference.
    """
    fixed, levers, body, pulley, inertia_pulley = _parts_of_robot(robot, conditions, mass)
    return HalfRobotMasses(*_joined_parts([*fixed, *levers]), body, pulley, inertia_pulley)


def without_levers(robot: Robot, conditions: Conditions, mass: Scalar) -> HalfRobotMasses:
    """Same as `masses_of_parts` without the levers, which rest on their axles."""
    fixed, _, body, pulley, inertia_pulley = _parts_of_robot(robot, conditions, mass)
    return HalfRobotMasses(*_joined_parts(fixed), body, pulley, inertia_pulley)


def _parts_of_robot(
    robot: Robot, conditions: Conditions, mass: Scalar
) -> tuple[list[_RigidPart], list[_RigidPart], Scalar, Scalar, Scalar]:
    """Parts fixed in the chassis, levers, mass of the body, mass and inertia of the parts that turn on an axle."""
    chassis = robot.chassis(conditions.configuration)
    gear = robot.running_gear
    tracked = chassis.on_tracks
    wheeled = 1 - tracked
    pulley = gear.pulley_mass + gear.additional_pulley_mass + gear.wheel_mass * wheeled
    inertia_pulley = chassis.inertia / 2
    belt = _belt_part(gear, robot.radius_pulley)
    levers = _lever_parts(gear, tracked, *lever_angles(gear, conditions))
    zero_mass = jnp.zeros_like(belt.mass)
    payload = _RigidPart(conditions.payload / robot.sides, gear.payload_offset, gear.payload_height, zero_mass)
    body_mass = mass / robot.sides - 2 * pulley - belt.mass - sum(p.mass for p in levers) - payload.mass
    body = _RigidPart(body_mass, gear.centre_offset, gear.centre_height, body_mass * gear.body_gyration**2)

    pulleys = [_RigidPart(pulley, side * gear.wheelbase / 2, zero_mass, inertia_pulley) for side in (1.0, -1.0)]
    folded = [
        body._replace(inertia=zero_mass),
        belt,
        *_lever_parts(gear, tracked, jnp.pi, jnp.pi),
        *pulleys,
    ]
    stated_inertia = jnp.where(wheeled > 0.5, gear.inertia_wheeled, gear.inertia_tracked) / robot.sides
    body_inertia = stated_inertia - _joined_parts(folded).inertia
    body = body._replace(inertia=jnp.where(body_inertia > 0, body_inertia, body.inertia))

    return [body, belt, payload], levers, body.mass, pulley, inertia_pulley


def check_parts(robot: Robot) -> None:
    """Raises if the parts of a robot leave no mass or inertia for its body.

    Raises:
        ValueError: the parts weigh as much as a configuration, or have more inertia than stated for the whole.
    """
    no_inertia = {"body_gyration": 0.0, "inertia_tracked": 0.0, "inertia_wheeled": 0.0}
    folded_levers = {"lever_front": np.pi, "lever_rear": 0.0}
    gear = params.replace(
        robot.running_gear, {name: jnp.asarray(x) for name, x in (no_inertia | folded_levers).items()}
    )
    bodiless = replace(robot, running_gear=gear)
    for k, (name, chassis) in enumerate(robot.configurations.items()):
        masses = masses_of_parts(bodiless, Conditions(k).resolved(robot), chassis.mass)
        if np.any(np.asarray(masses.body) <= 0):
            parts_mass = np.max(np.asarray(chassis.mass - robot.sides * masses.body))
            raise ValueError(
                f"{name}.mass: got {np.min(np.asarray(chassis.mass)):.3g} kg; expected more than "
                f"{parts_mass:.3g} kg, the mass of its pulleys, wheels, tracks and levers (running_gear)"
            )
        total_field = "inertia_tracked" if chassis.on_tracks > 0.5 else "inertia_wheeled"
        declared_total = np.asarray(getattr(robot.running_gear, total_field))
        parts_inertia = np.asarray(robot.sides * masses.inertia_pitch(gear.wheelbase))
        if np.any((declared_total > 0) & (declared_total <= parts_inertia)):
            raise ValueError(
                f"running_gear.{total_field}: got {np.min(declared_total):.3g} kg·m^2; expected 0, or more than "
                f"{np.max(parts_inertia):.3g} kg·m^2, that of the parts of {name} without the body's own"
            )
