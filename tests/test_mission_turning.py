"""Missions of robots whose sides are driven apart: straight travel where they are alike, mirrors, energy, demands."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import mmrjax as mm
from mmrjax.fidelities.drive import drive
from mmrjax.missions import mission_batch as missions
from mmrjax.missions import mission_straight
from mmrjax.missions.mission import TOLERANCE, Start, Totals, initial_unknowns, mission
from mmrjax.missions.mission_batch import simulate_batch
from mmrjax.missions.mission_steps import BREAKS_AWAY, event_functions
from mmrjax.missions.profile import profile
from mmrjax.model import params

ROWS = [0.0, 1.0, 4.0, 5.0, 6.0]
RAMP = dict(demand=[0, 0.3, 0.3, 0, 0], linear=True)
MODES = ["speed"] * 3 + ["brake"] * 2


def conditions(count, **given):
    return mm.Conditions(**{"configuration": np.full(count, 1), "voltage": 24.0} | given)


def several(*profiles):
    """Profiles of one structure as one of a batch."""
    return jax.tree.map(lambda *x: jnp.stack(x), *profiles)


@pytest.fixture(scope="module")
def demanded(robot):
    """Speed with a yaw rate of 0, of 0.5 and -0.5 rad/s."""
    rates = ([0.0] * 5, [0, 0.5, 0.5, 0, 0], [0, -0.5, -0.5, 0, 0])
    run = conditions(3, payload=np.zeros(3)).resolved(robot)
    asks = several(*(profile(ROWS, MODES, yaw_rate=rate, **RAMP) for rate in rates))
    return jax.device_get(simulate_batch(robot, run, asks, None, 512))


def with_duties(robot):
    """Duties held, left the slower side, the faster one, and one against the other, in steps fine enough for `drive`."""
    duties = ((0.4, 0.9), (0.9, 0.4), (-0.8, 0.8))
    one = several(*(profile([0.0, 0.5, 1.0], duty_left=left, duty_right=right) for left, right in duties))
    return jax.device_get(simulate_batch(params.without_weak_types(robot), conditions(3), one, None, 512, 1e-7))


@pytest.fixture(scope="module")
def driven(robot):
    return with_duties(robot)


def test_derivative_of_breaking_away_is_there_at_every_current(robot):
    """Of the torque that a motor's current has beyond friction: that of a minimum can vanish, see `rest.smallest`."""
    held = mm.Conditions(configuration=1, voltage=24.0)
    asks = profile([0.0, 1.0], "speed", demand=[0.0, 0.4], linear=True)

    def breaks(y):
        return event_functions(mission_straight, robot, held, asks, y, jnp.asarray(True), jnp.asarray(False))[
            BREAKS_AWAY
        ]

    def rise(current):
        y = initial_unknowns(mission_straight, robot, held, Start(current=current)) / mission_straight.units(robot)
        y = y.at[mission_straight.CLOCK].set(0.00748)
        along = jnp.zeros_like(y).at[mission_straight.CURRENT].set(1.0)
        return [float(x) for x in jax.jvp(breaks, (y,), (along,))]

    (low, first), (high, second) = rise(0.8217389663799393), rise(0.84)
    per_current = (high - low) / (0.84 - 0.8217389663799393) * mission_straight.UNITS[mission_straight.CURRENT]
    assert (first, second) == pytest.approx((per_current, per_current), rel=1e-9)


def test_numbers_of_either_side_follow_from_their_totals():
    of = {name: jnp.asarray(0.0) for name in missions.SINKS}
    of |= {"drawn": 3.0, "returned": 0.0, "distance": 1.0, "path": 1.0, "current_squared": 8.0, "torque_squared": 2.0}
    of |= {
        "turned": jnp.pi,
        "place_x": 1.0,
        "place_y": -2.0,
        "current_squared_left": 2.0,
        "current_squared_right": 18.0,
    }
    names = ("current", "torque", "temperature", "motor_speed", "speed", "cell_low", "yaw_rate")
    peaks = {name: jnp.asarray(1.0) for name in names}
    peaks |= {f"{name}_{side}": jnp.asarray(4.0) for name in ("current", "temperature") for side in ("left", "right")}
    total = Totals(jnp.asarray(2.0), {k: jnp.asarray(x) for k, x in of.items()}, jnp.asarray(0.0), jnp.asarray(3.0))
    found = missions.numbers_by_column(missions.mission_totals(total, peaks))
    assert {o.column for o in missions.OF_TURNS} < set(found)
    assert (float(found["rms_current_left_A"]), float(found["rms_current_right_A"])) == pytest.approx((1.0, 3.0))
    assert float(found["turned_deg"]) == pytest.approx(180.0)


@pytest.mark.nightly
def test_equal_sides_are_a_mission_of_straight_travel(robot, demanded):
    straight = jax.device_get(simulate_batch(robot, conditions(1), profile(ROWS, MODES, **RAMP), None, 512))
    for name, value in straight.total.of.items():
        assert_allclose(demanded.total.of[name][0], value[0], rtol=1e-9, atol=1e-9, err_msg=name)
    for name, value in straight.peaks.items():
        if name != "cell_low":
            assert_allclose(demanded.peaks[name][0], value[0], rtol=1e-9, err_msg=name)
    assert (demanded.status[0] == straight.status[0]).all() and (demanded.flags[0] == straight.flags[0]).all()
    assert int(demanded.steps[0]) == int(straight.steps[0])
    for name in ("place_y", "turned"):
        assert abs(demanded.total.of[name][0]) < 1e-12


@pytest.mark.slow
def test_demanded_speed_and_yaw_rate_are_met(demanded):
    course = demanded.course
    held = (course.time[1] > 2.0) & (course.time[1] < 4.0)
    signals = jax.tree.map(lambda x: x[1], course.signals)
    assert_allclose(np.asarray(signals.speed)[held].mean(1), 0.3, rtol=1e-4)
    assert_allclose(np.asarray(signals.yaw_rate)[held], 0.5, rtol=1e-3)
    turned = np.asarray(signals.heading)[np.isfinite(course.time[1])][-1, 0]
    assert turned == pytest.approx(float(demanded.total.of["turned"][1]), rel=1e-5)
    first, last = np.asarray(signals.heading)[held][[0, -1], 0]
    assert last - first == pytest.approx(0.5 * np.ptp(course.time[1][held]), rel=1e-4)


@pytest.mark.slow
def test_held_duties_are_a_run_of_drive(robot, driven):
    """Of windings that do not warm, whose resistance `drive` leaves as it is."""
    none = dict.fromkeys(("resistance_thermal_winding", "resistance_thermal_housing"), jnp.asarray(1e-9))
    cold = dataclasses.replace(robot, motor=dataclasses.replace(robot.motor, **none))
    found = with_duties(cold)
    at = mm.Conditions(configuration=1, voltage=24.0, duty_left=0.4, duty_right=0.9)
    run = jax.jit(lambda: drive(cold, at, jnp.asarray([0.0, 1.0]), 1e-8))()
    end = jax.tree.map(lambda x: x[-1], run.signals)
    for name in ("place_x", "place_y"):
        assert found.total.of[name][0] == pytest.approx(float(getattr(end, name)[0]), rel=1e-5)
    assert float(found.total.of["turned"][0]) == pytest.approx(float(end.heading[0]), rel=1e-5)


def demanding(robot, run, *asks, tolerance=TOLERANCE):
    """Three missions that demand a speed and a yaw rate in five rows: what is asked so has one program."""
    return jax.device_get(simulate_batch(robot, run, several(*asks), None, 512, jnp.asarray(tolerance)))


@pytest.mark.slow
def test_energy_adds_up_with_both_sides(driven, demanded):
    for found in (driven, demanded):
        numbers = missions.mission_totals(found.total, found.peaks)
        assert np.abs(numbers["unaccounted_share"]).max() < 1e-4  # the issue asks 1e-3
        assert (found.total.of["sliding"] > 0).all()
    assert driven.total.of["sliding"][2] > driven.total.of["sliding"][0]  # on the spot


@pytest.mark.nightly
def test_derivatives_of_a_turn_match_differences(robot):
    """Of energy and of what it turns by, by parameters of the robot and by speed and yaw rate that are demanded."""
    names = ("motor.resistance", "6T2A.turning.width", "6T2A.turning.lateral", "6T2A.ground.friction.static")
    base = {p.name: float(p.value) for p in params.walk_parameters(robot) if p.name in names}
    held = dict(demand=[0.0, 0.3, 0.3, 0.3, 0.3], yaw_rate=[0.0, 0.6, 0.6, 0.6, 0.6], linear=True)
    asks = profile([0.0, 0.4, 0.6, 0.8, 1.0], "speed", **held)
    own = conditions(3, configuration=np.zeros(3, int), payload=np.zeros(3)).resolved(robot)
    one = jax.tree.map(lambda x: x[0], own)

    def changed(x):
        of = params.replace(robot, {name: value * x[k] for k, (name, value) in enumerate(base.items())})
        return of, dataclasses.replace(asks, demand=asks.demand * x[-2], yaw_rate=asks.yaw_rate * x[-1])

    def of_total(total):
        return jnp.stack([total.energy, total.of["turned"]], axis=-1)

    def outputs(x):
        of, asked = changed(x)
        return of_total(mission(of, one, asked, tolerance=1e-8).total)

    def compiled(x):
        of, asked = changed(x)
        return of_total(demanding(of, own, *[asked] * 3, tolerance=1e-8).total)[0]

    x, step = jnp.ones(len(base) + 2), 1e-3
    exact, value = np.asarray(jax.jit(jax.jacfwd(outputs))(x)), np.asarray(compiled(x))
    assert len(base) == len(names) and np.abs(exact).min(axis=0).max() > 1e-3
    for k in range(len(x)):
        apart = (np.asarray(compiled(x.at[k].add(step))) - np.asarray(compiled(x.at[k].add(-step)))) / (2 * step)
        assert (np.abs(exact[:, k] - apart) < 1e-4 * np.abs(apart) + 1e-5 * np.abs(value)).all(), (
            k,
            exact[:, k],
            apart,
        )
