"""Derivatives at defaults and bounds: one-sided differences into the admissible side, by all that is stated there."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mmrjax.effects import BY_NAME
from mmrjax.fidelities.steady import steady
from mmrjax.model import balances, paper_robots, params
from mmrjax.model.conditions import Conditions
from mmrjax.model.driver import Driver
from mmrjax.model.robot import Configurations
from mmrjax.model.shaft import Shaft
from mmrjax.model.signals import State
from mmrjax.numerics import elementary

#: Numbers compared [SI].
OUTPUTS = ("speed", "total_current", "output_torque", "adhesion_used", "efficiency_gear", "efficiency_chassis")
#: A shaft without friction transmits no power, and its efficiency is 0 over 0.
OUTPUTS_SHAFT = ("speed", "total_current", "output_torque")
FORWARD, REVERSE = {"voltage": 24.0, "duty": 1.0}, {"voltage": 24.0, "duty": -1.0}
STANDS = {"voltage": 24.0, "duty": 0.0}
#: Tracked robot on level ground: conditions, what is varied, the bound or default at which, into which sides.
GROUND = [
    (FORWARD, "duty", 1.0, (-1,)),
    (REVERSE, "duty", -1.0, (1,)),
    *((c, name, 0.0, (1,)) for c in (FORWARD, REVERSE, STANDS) for name in ("payload", "6T2A.inertia")),
    *((c, "6T2A.ground.rolling_resistance", 0.0, (1,)) for c in (FORWARD, REVERSE, STANDS)),
    *((FORWARD, f"effects.{name}.amplitude", 0.0, (-1, 1)) for name in ("gear_load_loss", "tension_friction")),
    *((FORWARD, name, 0.0, (-1, 1)) for name in ("slope_deg", "running_gear.guide_recess")),
    (REVERSE, "slope_deg", 0.0, (-1, 1)),
    *((STANDS, name, 0.0, (-1, 1)) for name in ("duty", "voltage")),
    (STANDS, "slope_deg", 0.0, (1,)),  # of the other side adhesion used falls
    *((FORWARD, name, 0.0, (1,)) for name in ("6T2A.track.loss_coulomb", "6T2A.track.loss_viscous", "motor.inertia")),
    *((FORWARD, "6T2A.track.guide_share", *at) for at in ((0.0, (1,)), (1.0, (-1,)))),
    (FORWARD, "gearbox.efficiency_load", 1.0, (-1,)),
    (FORWARD, "adhesion", 1.0, (-1, 1)),
]
#: Shaft without any friction, driven at 8 V.
SHAFT = [
    *(({"voltage": 8.0}, name, 0.0, (1,)) for name in ("bench.loss_coulomb", "bench.loss_viscous", "bench.inertia")),
    *(({"voltage": 8.0}, f"{part}.friction_coulomb", 0.0, (1,)) for part in ("motor", "gearbox")),
    ({"voltage": 8.0}, "bench.torque_constant", 0.0, (1,)),
    ({"voltage": 8.0}, "duty", 1.0, (-1,)),
]
VARIED = ("voltage", "duty", "payload", "slope_deg", "adhesion")


def tracked():
    effects = (BY_NAME[name](amplitude=0.05) for name in ("gear_load_loss", "tension_friction"))
    return dataclasses.replace(paper_robots.nominal(), effects=tuple(effects))


def bench():
    free = {f"{part}.friction_{kind}": 0.0 for part in ("motor", "gearbox") for kind in ("coulomb", "viscous")}
    shaft = Shaft(inertia=1e-3, loss_coulomb=0.0)
    blank = paper_robots.blank_robot(Configurations({"bench": shaft}), sides=1.0)
    return params.replace(
        blank, {**free, "gearbox.ratio": 1.0, "gearbox.efficiency_load": 0.7, "motor.inertia": 1e-6}
    )


def one_sided_differences(robot, rows, outputs):
    """Numbers, their derivatives, and differences to second order, each (rows, outputs)."""
    names = [p.name for p in params.walk_parameters(robot)]
    base = [float(p.value) for p in params.walk_parameters(robot)]

    def numbers(vector):
        own = params.replace(robot, {name: vector[k] for k, name in enumerate(names)})
        run = Conditions(**{name: vector[len(names) + k] for k, name in enumerate(VARIED)})
        found = steady(own, run)
        return jnp.stack([found.reading.get(n, getattr(found, n, None)) for n in outputs])

    def derivative(vector, along, steps):
        """At the place, and one and two steps from it: one program."""
        value, slope = jax.vmap(lambda step: jax.jvp(numbers, (vector + step * along,), (along,)))(steps)
        return value[0], slope[0], (4 * value[1] - value[2] - 3 * value[0]) / steps[2]

    places, vectors, steps = [*names, *VARIED], [], []
    for conditions, name, at, sides in rows:
        vector = np.array([*base, *({"adhesion": 1.0, "duty": 1.0, **conditions}.get(v, 0.0) for v in VARIED)])
        vector[places.index(name)] = at
        vectors += [vector] * len(sides)
        steps += [1e-5 * side * np.arange(3.0) for side in sides]
    along = np.eye(len(places))[[places.index(name) for _, name, _, sides in rows for _ in sides]]
    return jax.jit(jax.vmap(derivative))(np.array(vectors), along, np.array(steps))


@pytest.mark.quick("frictionless_shaft")
@pytest.mark.parametrize(
    "robot, rows, outputs",
    [(tracked, GROUND, OUTPUTS), (bench, SHAFT, OUTPUTS_SHAFT)],
    ids=["tracked", "frictionless_shaft"],
)
def test_derivatives_at_defaults_and_bounds_are_one_sided_differences(robot, rows, outputs):
    value, slope, difference = (np.asarray(x) for x in one_sided_differences(robot(), rows, outputs))
    names = [f"{name} at {at:g} of {c}" for c, name, at, sides in rows for _ in sides]
    off = ~(np.abs(slope - difference) <= 1e-3 * np.abs(difference) + 1e-4 * (1 + np.abs(value)))
    assert not off.any(), [(names[i], outputs[k], slope[i, k], difference[i, k]) for i, k in np.argwhere(off)]


def test_a_duty_of_all_the_voltage_has_the_derivative_from_inside():
    limited = Driver(current_limit=5.0).duty_limited
    for duty, current, slope in ((1.0, 2.0, 1.0), (-1.0, -2.0, 1.0), (0.5, 5.0, 1.0), (1.0, 6.0, 0.0)):
        assert jax.grad(limited)(duty, current) == slope


@pytest.mark.parametrize("name", ["bench.inertia", "effects.rotating_inertia.amplitude"])
def test_a_shaft_without_inertia_speeds_up_less_with_some(name):
    """Of 1e-6 kg·m² of the motor: dω'/dJ is -ω'/J, whatever the inertia is added by."""
    robot = dataclasses.replace(bench(), effects=(BY_NAME["rotating_inertia"](),))
    robot = params.replace(robot, {"bench.inertia": 0.0, "gearbox.efficiency_load": 1.0})

    def acceleration(added):
        own = params.replace(robot, {name: added})
        return balances.moving_signals(own, Conditions(voltage=8.0), State(0.5, 40.0, 40.0, 0.0)).acceleration_wheel

    value, slope = jax.value_and_grad(acceleration)(0.0)
    assert slope == pytest.approx(-float(value) / 1e-6, rel=1e-3)


@pytest.mark.parametrize(
    "function, at, slope",
    [
        (lambda x: elementary.clip(x, -1.0, 1.0), 1.0, 1.0),
        (lambda x: elementary.clip(x, -1.0, 1.0), -1.0, 1.0),
        (lambda x: elementary.clip(x, -1.0, 1.0), 1.1, 0.0),
        (lambda x: elementary.at_least(x, 0.0), 0.0, 1.0),
        (lambda x: elementary.at_least(0.0, x), 0.0, 0.0),
        (lambda x: elementary.at_most(x, 0.0), 0.0, 1.0),
        (lambda x: elementary.magnitude(x, 1.0), 0.0, 1.0),
        (lambda x: elementary.magnitude(x, -1.0), 0.0, -1.0),
        (lambda x: elementary.magnitude(x, -1.0), 2.0, 1.0),
    ],
)
def test_bounds_have_the_derivative_from_inside(function, at, slope):
    assert jax.grad(function)(at) == slope
