"""Settled runs behind a current limit or a diode, compared with a bisection in NumPy, and their derivatives."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
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


def drawn(kind, one_way, number, seed=0):
    """Random runs: a robot, its conditions, a limit for each, and their bisection by volts and limits."""
    rng = np.random.default_rng(seed)
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
    robot = dataclasses.replace(robot, driver=dataclasses.replace(robot.driver, returns_current=not one_way))

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
        moved = dataclasses.replace(conditions, voltage=volts * (1 + share))
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
def test_requirements_behind_a_limit_or_a_diode_are_those_of_a_bisection(one_way):
    """At points of an envelope as `check` and `size` evaluate them, limits from 1 to 3 A."""
    rng = np.random.default_rng(1)
    robot, number = nominal(), 100
    robot = dataclasses.replace(robot, driver=dataclasses.replace(robot.driver, returns_current=not one_way))
    volts, limits, payload, slope, which = (
        rng.uniform(10, 33, number), np.exp(rng.uniform(0, 1.1, number)), rng.uniform(0, 8, number), rng.uniform(-15, 15, number),
        rng.integers(0, 2, number),
    )  # fmt: skip
    names = [robot.configurations.names[k] for k in which]
    of = [bridges.vehicle(c, payload, np.radians(slope)) for c in ("6T2A", "4W2T")]
    load = {key: np.where(np.array(names) == "4W2T", of[1][key], of[0][key]) for key in of[0]}

    @jax.jit
    @jax.vmap
    def values(limit, which, volts, slope, payload):
        point = EnvelopePoint(which, 1.0, 1.0, 0.0, volts, 0.0, 1.0, slope, payload, 25.0, 0.0)
        mine = params.replace(robot, {"driver.current_limit": limit})
        found, outcome = travel_quantities(mine, point, ratings(robot))
        return found["current"], found["motor_speed_rpm"], outcome

    found = values(*map(jnp.asarray, (limits, which, volts, slope, payload)))
    way, none = np.full(number, one_way), np.zeros(number, bool)
    exact = bridges.settled(VEHICLE, load, volts, np.ones(number), limits, way, none)
    assert not (found[2] == STATUSES.index("failed")).any()
    for got, right in zip(found[:2], (exact[0], np.abs(exact[1])), strict=True):
        assert_allclose(got, right, rtol=1e-9, atol=1e-9)
    assert (np.abs(exact[0]) > limits).sum() > 10


def turned(one_way, number):
    """Random turns on a supply: robot with its limits, conditions, their settled motion and duties of the sides."""
    rng = np.random.default_rng(3)
    duties, volts = rng.uniform(-1, 1, (2, number)), rng.uniform(12, 33, number)
    limits, which = np.exp(rng.uniform(np.log(0.3), np.log(5), number)), rng.choice(["4W2T", "6T2A"], number).tolist()
    duties[:, 0], volts[0], limits[0], which[0] = (0.5, 0.8), 24.0, 1.0, "4W2T"
    robot = nominal()
    robot = dataclasses.replace(robot, driver=dataclasses.replace(robot.driver, returns_current=not one_way))
    robot = params.replace(robot, {"driver.current_limit": jnp.asarray(limits)})
    runs = mm.Conditions(which, voltage=volts, duty_left=duties[0], duty_right=duties[1]).resolved(robot)
    axes = jax.tree.map(lambda x: 0 if jnp.ndim(x) else None, robot)
    found = jax.jit(jax.vmap(circling.circling_signals, in_axes=(axes, 0)))(robot, runs)
    assert set(np.asarray(found[2]).tolist()) <= {STATUSES.index(s) for s in ("converged", "stalled")}
    assert (np.abs(found[1].current) > limits[:, None]).any(1).sum() > number / 4
    return robot, axes, runs, found, limits, duties


@pytest.mark.quick("True")
@pytest.mark.parametrize("one_way", [False, True])
def test_settled_turns_with_a_limit_or_a_diode_are_solved(one_way):
    _, _, runs, (travel, motion, _), limits, duties = turned(one_way, 20)
    volts, shape = np.asarray(runs.voltage)[:, None], (20, 2)
    current = bridges.current_at(
        VEHICLE, np.asarray(motion.speed_motor), lambda _: volts + np.zeros(shape), np.ones(shape), duties.T,
        limits[:, None] + np.zeros(shape), np.full(shape, one_way),
    )  # fmt: skip
    assert_allclose(motion.current, current, rtol=1e-9, atol=1e-9)
    blocked = (np.abs(current) < 1e-9) & (np.abs(motion.speed_motor) > 1)
    assert blocked.any() == one_way
    for rate in (travel.acceleration, travel.acceleration_yaw, travel.signals.acceleration_wheel):
        assert_allclose(rate, 0.0, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("one_way", [False, True])
def test_a_hundred_turns_with_a_limit_or_a_diode_settle_as_over_time(one_way):
    robot, axes, runs, (_, motion, status), *_ = turned(one_way, 100)
    times = jnp.asarray([0.0, 20.0])

    def over_time(rolling):
        return jax.jit(jax.vmap(lambda r, c: drive.drive(r, c, times, rolling=rolling), in_axes=(axes, 0)))(
            robot, runs
        )

    history, held = over_time(False), over_time(True)
    assert not (history.result.status == STATUSES.index("failed")).any()
    # Few still approach their speed slowly at the limit.
    rolls = (np.asarray(status) == STATUSES.index("converged")) & (history.result.status == status)
    assert rolls.sum() > 60
    stays, reached = np.ones(len(rolls), bool), np.ones(len(rolls), bool)
    for name in ("current", "speed_motor"):
        settled = np.asarray(getattr(motion, name))
        for by_row, signals in ((stays, held.signals), (reached, history.signals)):
            ended = np.asarray(getattr(signals, name))[:, -1]
            by_row &= np.isclose(ended, settled, rtol=1e-3, atol=1e-4).all(-1)
    # A turn at the limit may have two settled states. From standstill two of the hundred end in the other one.
    assert stays[rolls].all() and (~reached[rolls]).sum() <= 2


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
