"""Settled runs behind a current limit or a diode, compared with a bisection in NumPy, and their derivatives."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from worlds import bridges, paper

import mmrjax as mm
from mmrjax.derived.requirements import EnvelopePoint, ratings, travel_quantities
from mmrjax.fidelities import drive
from mmrjax.fidelities.steady import steady_outputs
from mmrjax.model import params
from mmrjax.model.paper_robots import blank_robot, nominal
from mmrjax.model.robot import Configurations
from mmrjax.model.shaft import Shaft
from mmrjax.model.signals import STATUSES
from mmrjax.turning import circling

P = paper.NOMINAL
VEHICLE = {
    "R": P["motor.resistance"],
    "C": P["motor.torque_constant"],
    "M_f": P["motor.friction_coulomb"] + P["gearbox.friction_coulomb"],
    "K_f": P["motor.friction_viscous"] + P["gearbox.friction_viscous"],
    "i": P["gearbox.ratio"],
    "eta": P["gearbox.efficiency_load"],
}
DYNO = {"R": 2.37, "C": 0.0302, "M_f": 2e-3, "K_f": 3e-6, "i": 14.0, "eta": 0.8}


def bench():
    """A dyno of one motor, on whose shaft a brake acts."""
    shaft = Shaft(inertia=1e-2, loss_coulomb=0.05, loss_viscous=0.002)
    names = {
        "motor.resistance": "R", "motor.torque_constant": "C", "motor.friction_coulomb": "M_f",
        "motor.friction_viscous": "K_f", "gearbox.ratio": "i", "gearbox.efficiency_load": "eta",
    }  # fmt: skip
    values = {name: DYNO[symbol] for name, symbol in names.items()}
    values |= {"motor.inertia": 1e-5, "motor.inductance": 1e-3}
    return params.replace(blank_robot(Configurations({"dyno": shaft}), sides=1.0), values)


def one_way_robot(robot, one_way):
    """The robot with a diode, which blocks what would flow back, or without."""
    return replace(robot, driver=replace(robot.driver, returns_current=not one_way))


def drawn(kind, one_way, number, seed=0):
    """Random runs: a robot, its conditions, a limit for each, and their bisection by volts and limits."""
    rng = default_rng(seed)
    volts = rng.uniform(5, 40, number) * rng.choice([-1, 1, 1, 1], number)
    duty = np.where(rng.random(number) < 0.5, 1.0, rng.uniform(-1, 1, number))
    for values in (volts, duty):
        values[rng.random(number) < 0.03] = 0.0
    limits, battery = np.exp(rng.uniform(np.log(0.3), np.log(5), number)), rng.random(number) < 0.3
    payload, slope, torque = (rng.uniform(a, b, number) for a, b in ((0, 8), (-20, 20), (-1.5, 1.5)))
    if kind == "dyno":
        robot, motor, battery = bench(), DYNO, np.zeros(number, bool)
        load = {"dry": 0.05, "viscous": 0.002, "constant": torque, "demand": 0.0 * torque}
        conditions = mm.Conditions(voltage=volts, duty=duty, load_torque=torque)
    else:
        robot, motor = nominal(), VEHICLE
        of = [bridges.vehicle(c, payload, np.radians(slope)) for c in ("6T2A", "4W2T")]
        wheeled = rng.random(number) < 0.5
        load = {key: np.where(wheeled, of[1][key], of[0][key]) for key in of[0]}
        conditions = mm.Conditions(
            np.where(wheeled, "4W2T", "6T2A").tolist(), voltage=volts, duty=duty, battery=battery, payload=payload,
            slope_deg=slope,
        )  # fmt: skip
    robot = one_way_robot(robot, one_way)

    def bisected(volts, limits):
        way = np.full(number, one_way)
        return bridges.settled(motor, load, volts, duty, limits, way, battery, float(robot.sides))

    return robot, conditions.resolved(robot), limits, bisected, load["demand"]


def solved(robot, conditions, limits):
    limited = params.replace(robot, {"driver.current_limit": limits})
    return steady_outputs(limited, conditions, ("motor_current", "motor_speed", "status"))


def checked(kind, one_way, number):
    robot, conditions, limits, bisected, demand = drawn(kind, one_way, number)
    current, speed = bisected(np.asarray(conditions.voltage), limits)
    found = solved(robot, conditions, jnp.asarray(limits))
    status = np.asarray(found["status"])
    assert not (status == STATUSES.index("failed")).any()
    numbers = np.isfinite(found["motor_speed"])
    assert (numbers | (demand > 1)).all() and numbers.mean() > 0.9
    for got, exact in ((found["motor_current"], current), (found["motor_speed"], speed)):
        assert_allclose(np.asarray(got)[numbers], exact[numbers], rtol=1e-9, atol=1e-9)
    # Runs of each kind are among them.
    assert {STATUSES.index(s) for s in ("converged", "stalled", "reverses", "rolls_back")} <= set(status.tolist())
    limited, blocked = np.abs(current) > limits, one_way & (np.abs(current) < 1e-9) & (speed != 0)
    assert limited.mean() > 0.1 and blocked.any() == one_way
    return numbers


@pytest.mark.quick("robot-False", "dyno-True")
@pytest.mark.parametrize("one_way", [False, True])
@pytest.mark.parametrize("kind", ["robot", "dyno"])
def test_every_run_with_a_limit_or_a_diode_is_solved(kind, one_way):
    checked(kind, one_way, 400)


@pytest.mark.quick("True")
@pytest.mark.parametrize("one_way", [False, True])
def test_derivatives_in_each_mode_are_differences_of_the_bisection(one_way):
    """Along a change of limit and voltage together."""
    robot, conditions, limits, bisected, _ = drawn("dyno", one_way, 400)
    volts = np.asarray(conditions.voltage)

    def answer(share):
        moved = replace(conditions, voltage=volts * (1 + share))
        return [solved(robot, moved, limits * (1 - share))[name] for name in ("motor_current", "motor_speed")]

    slope = [np.asarray(x) for x in jax.jvp(answer, (0.0,), (1.0,))[1]]
    far = 1e-5
    before, here, after = (bisected(volts * (1 + x), limits * (1 - x)) for x in (-far, 0.0, far))
    rises = [(b - a) / (2 * far) for a, b in zip(before, after, strict=True)]
    # The rest changes its mode within the difference.
    smooth = np.ones(len(limits), bool)
    for a, middle, b in zip(before, here, after, strict=True):
        smooth &= np.abs(a - 2 * middle + b) < 1e-3 * np.abs(b - a) + 1e-9
    assert smooth.mean() > 0.95
    for got, wanted in zip(slope, rises, strict=True):
        assert_allclose(got[smooth], wanted[smooth], rtol=1e-4, atol=1e-4)
        assert np.isfinite(got).all()
    limited = np.abs(here[0]) > limits
    assert (np.abs(slope[1][limited]) > 1).sum() > 20 and (slope[1][~limited] != 0).sum() > 20


@pytest.mark.quick("False")
@pytest.mark.parametrize("one_way", [False, True])
def test_requirements_behind_a_limit_or_a_diode_are_those_of_steady_travel(one_way):
    """At points of an envelope as `check` and `size` evaluate them, limits from 1 to 3 A: as is solved above."""
    rng, number, robot = default_rng(1), 100, one_way_robot(nominal(), one_way)
    volts, limits, payload = (
        rng.uniform(10, 33, number),
        np.exp(rng.uniform(0, 1.1, number)),
        rng.uniform(0, 8, number),
    )
    slope, which = rng.uniform(-15, 15, number), rng.integers(0, 2, number)

    @jax.jit
    @jax.vmap
    def values(limit, which, volts, slope, payload):
        point = EnvelopePoint(which, 1.0, 1.0, 0.0, volts, 0.0, 1.0, slope, payload, 25.0, 0.0)
        mine = params.replace(robot, {"driver.current_limit": limit})
        found, outcome = travel_quantities(mine, point, ratings(robot))
        return found["current"], found["motor_speed_rpm"], outcome

    current, speed, outcome = values(*map(jnp.asarray, (limits, which, volts, slope, payload)))
    runs = mm.Conditions(which, voltage=volts, slope_deg=slope, payload=payload).resolved(robot)
    exact = solved(robot, runs, jnp.asarray(limits))
    assert_array_equal(outcome, exact["status"])
    travels = np.isfinite(exact["motor_speed"])  # or slides
    assert travels.mean() > 0.9
    for got, right in ((current, exact["motor_current"]), (speed, np.abs(exact["motor_speed"]))):
        assert_allclose(got[travels], right[travels], rtol=1e-9, atol=1e-9)
    assert (np.abs(current) > limits).sum() > 10


@pytest.mark.quick("True")
@pytest.mark.parametrize("one_way", [False, True])
def test_settled_turns_with_a_limit_or_a_diode_are_solved(one_way):
    rng, shape = default_rng(3), (20, 2)
    duties, volts = rng.uniform(-1, 1, (2, 20)).T, rng.uniform(12, 33, 20)
    limits, which = np.exp(rng.uniform(np.log(0.3), np.log(5), 20)), rng.choice(["4W2T", "6T2A"], 20).tolist()
    duties[0], volts[0], limits[0], which[0] = (0.5, 0.8), 24.0, 1.0, "4W2T"
    robot = params.replace(one_way_robot(nominal(), one_way), {"driver.current_limit": jnp.asarray(limits)})
    left, right = duties.T
    runs = mm.Conditions(which, voltage=volts, duty_left=left, duty_right=right).resolved(robot)
    axes = jax.tree.map(lambda x: 0 if jnp.ndim(x) else None, robot)
    travel, motion, status = jax.jit(jax.vmap(circling.circling_signals, in_axes=(axes, 0)))(robot, runs)
    assert set(np.asarray(status).tolist()) <= {STATUSES.index(s) for s in ("converged", "stalled")}
    limits = np.repeat(limits[:, None], 2, 1)
    assert (np.abs(motion.current) > limits).any(1).sum() > 5
    current = bridges.current_at(
        VEHICLE, np.asarray(motion.speed_motor), lambda _: np.repeat(volts[:, None], 2, 1), np.ones(shape), duties,
        limits, np.full(shape, one_way),
    )  # fmt: skip
    assert_allclose(motion.current, current, rtol=1e-9, atol=1e-9)
    assert ((np.abs(current) < 1e-9) & (np.abs(motion.speed_motor) > 1)).any() == one_way
    for rate in (travel.acceleration, travel.acceleration_yaw, travel.signals.acceleration_wheel):
        assert_allclose(rate, 0.0, atol=1e-6)


def test_a_start_leaves_the_current_limit_as_by_radau():
    """Without short steps at the kink the current is off by 5 % of its largest value after it."""
    volts, limits = np.array([14.1, 14.3]), np.array([1.05, 1.42])
    motor = DYNO | {"L": 1e-3, "J": 1e-5, "J_l": 1e-2, "dry": 0.05, "viscous": 0.002}
    times = np.linspace(0, 1.5, 751)
    for volt, limit in zip(volts, limits, strict=True):
        robot = params.replace(bench(), {"driver.current_limit": limit})
        found = drive.drive_batch(robot, mm.Conditions(voltage=[volt]).resolved(robot), jnp.asarray(times))
        exact = bridges.started(motor, volt, limit, times)
        assert (np.abs(exact[0]) > limit).any() and abs(exact[0][-1]) < limit
        for got, wanted in zip((found.signals.current[0], found.signals.speed_motor[0]), exact, strict=True):
            assert np.abs(got - wanted).max() < 1e-4 * np.abs(wanted).max()
