"""Moment of inertia in pitch: from the parts of Table 7 and the posture, against what the paper prints."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from mmrjax.model import masses, params
from mmrjax.model.conditions import Conditions

OUTSTRETCHED = {"running_gear.lever_front": 0.0, "running_gear.lever_rear": np.pi}
#: Of one side: everything that has a mass or an inertia of its own, or places it.
PARTS = (
    "6T2A.mass",
    "6T2A.inertia",
    *(
        f"running_gear.{name}"
        for name in (
            "wheelbase", "body_gyration", "belt_mass", "lever_mass", "lever_centre", "lever_inertia", "pulley_mass",
            "additional_pulley_mass", "lever_front", "lever_rear", "payload_height", "payload_offset",
            "centre_height", "centre_offset",
        )
    ),
)  # fmt: skip
#: A posture and load in which each of them counts.
AT = {
    "running_gear.lever_front": 1.0, "running_gear.lever_rear": 2.0, "running_gear.payload_offset": 0.03,
    "running_gear.centre_offset": -0.01,
}  # fmt: skip


def half(robot, configuration="6T2A", payload=0.0):
    run = Conditions(configuration, payload=payload).resolved(robot)
    return masses.masses_of_parts(robot, run, robot.chassis(run.configuration).mass + payload)


def whole(robot, configuration="6T2A", payload=0.0):
    """Of the whole robot about its centre [kg·m²]."""
    of = half(robot, configuration, payload)
    return robot.sides * of.inertia_pitch(robot.running_gear.wheelbase)


def test_parts_weigh_what_the_paper_prints(robot):
    """Four pulleys of each kind leave 10.3 kg for the body in both configurations, two of each do not."""
    gear = robot.running_gear
    for name in ("6T2A", "4W2T"):
        body = 2 * float(half(robot, name).body)
        assert body == pytest.approx(10.3, abs=0.05)
        assert abs(body + 2 * (gear.pulley_mass + gear.additional_pulley_mass) - 10.3) > 0.3


def test_parts_add_up_to_the_printed_inertia(robot):
    """Table 7's 0.145 of 4W2T and 0.251 of 6T2A, which is that of the robot with its levers outstretched."""
    assert whole(robot, "4W2T") == pytest.approx(0.145, rel=0.015)
    assert whole(params.replace(robot, OUTSTRETCHED)) == pytest.approx(0.251, rel=0.01)
    assert whole(robot) == pytest.approx(0.153, rel=0.01)


@pytest.mark.parametrize("configuration", ["6T2A", "4W2T"])
def test_inertia_is_that_of_points(robot, configuration):
    """A second sum, of points: the belt in small pieces, all else at its place, in a posture and load of no symmetry."""
    robot = params.replace(robot, AT)
    tracked, payload = configuration == "6T2A", 5.0
    g = {name: float(getattr(robot.running_gear, name)) for name in vars(robot.running_gear) if name != "levers"}
    chassis, radius = robot.configurations[configuration], float(robot.radius_pulley)
    base, n = g["wheelbase"], 20_000
    s = (np.arange(n) + 0.5) / n * (2 * base + 2 * np.pi * radius)
    straight, arc = base, np.pi * radius
    turn = (np.clip(s - straight, 0, arc) + np.clip(s - 2 * straight - arc, 0, arc)) / radius
    run_x = np.minimum(s, straight) - np.clip(s - straight - arc, 0, straight) - base / 2
    x, z = run_x + radius * np.sin(turn), -radius * np.cos(turn)
    belt = np.full(n, 2 * g["belt_mass"] / n)
    levers = [(1, g["lever_front"]), (-1, g["lever_rear"])] if tracked else []
    pulley = g["pulley_mass"] + g["additional_pulley_mass"] + (0 if tracked else g["wheel_mass"])
    points = [(2 * pulley, base / 2, 0.0), (2 * pulley, -base / 2, 0.0)]
    points += [(payload, g["payload_offset"], g["payload_height"])]
    points += [
        (2 * g["lever_mass"], e * base / 2 + g["lever_centre"] * np.cos(a), g["lever_centre"] * np.sin(a))
        for e, a in levers
    ]
    points += list(zip(belt, x, z, strict=True))
    body = float(chassis.mass) + payload - sum(m for m, _, _ in points)
    points += [(body, g["centre_offset"], g["centre_height"])]
    m, x, z = np.array(points).T
    own = body * g["body_gyration"] ** 2 + 2 * len(levers) * g["lever_inertia"]
    turning = 2 * (float(chassis.inertia) - g["belt_mass"] * radius**2)  # of J_w the belt is among the points
    about = (m * ((x - np.average(x, weights=m)) ** 2 + (z - np.average(z, weights=m)) ** 2)).sum()
    assert whole(robot, configuration, payload) == pytest.approx(own + turning + about, rel=1e-6)


def test_each_part_payload_and_posture_count_in_every_member_with_derivatives(robot):
    """A batch in which each member has one number changed: none is as before, and as its derivative says."""
    robot = params.replace(robot, AT)
    start = {p.name: p.value for p in params.walk_parameters(robot)}
    at = jnp.stack([start[name] for name in PARTS] + [jnp.asarray(5.0)])

    def of(x):
        return whole(params.replace(robot, dict(zip(PARTS, x[:-1], strict=True))), payload=x[-1])

    step = 1e-5
    ends = jax.jit(jax.vmap(of))(jnp.concatenate([at + step * jnp.eye(len(at)), at - step * jnp.eye(len(at))]))
    differences = (ends[: len(at)] - ends[len(at) :]) / (2 * step)
    forward, reverse = jax.jit(jax.jacfwd(of))(at), jax.jit(jax.grad(of))(at)
    assert_allclose(forward, differences, rtol=1e-6, atol=1e-9)
    assert_allclose(reverse, forward, rtol=1e-12, atol=1e-14)
    assert (np.abs(forward) > 1e-6).all(), dict(zip((*PARTS, "payload"), forward, strict=True))


def test_inertia_stated_as_a_whole_is_that_of_the_folded_robot_without_payload(robot):
    for name, configuration in (("inertia_tracked", "6T2A"), ("inertia_wheeled", "4W2T")):
        stated = params.replace(robot, {f"running_gear.{name}": 0.2, "running_gear.centre_offset": 0.01})
        assert whole(stated, configuration) == pytest.approx(0.2, rel=1e-12)
        lighter = params.replace(stated, {"running_gear.pulley_mass": 0.02})
        assert whole(lighter, configuration) == pytest.approx(0.2, rel=1e-12)
        assert whole(stated, configuration, payload=8.0) > 0.22
    stretched = params.replace(robot, OUTSTRETCHED | {"running_gear.inertia_tracked": 0.2})
    lever = 4 * 0.495 * ((0.15 + 0.083) ** 2 - (0.15 - 0.083) ** 2)
    assert whole(stretched) == pytest.approx(0.2 + lever, rel=1e-9)
