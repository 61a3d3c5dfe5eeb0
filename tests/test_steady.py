"""Fidelity `steady` against the reference root, in its limits, over a batch, and its statuses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from worlds import paper

from mmrjax.fidelities.drive import drive_batch
from mmrjax.fidelities.steady import steady, steady_batch
from mmrjax.model import params
from mmrjax.model.conditions import Conditions
from mmrjax.model.signals import FLAGS, STATUSES

CHANNELS = ("total_current", "motor_speed", "speed")


def readings(answer):
    return np.stack([np.asarray(answer.reading[c]) for c in CHANNELS], -1)


def expected_readings(side):
    current, w, speed = side.steady()
    return np.array([paper.SIDES * current, w, speed])


def names(answer):
    return [STATUSES[k] for k in np.ravel(answer.status)]


def test_steady_matches_reference_root_over_table8(grid, steady_table8):
    got = readings(steady_table8)
    compared = 0
    for k, (wheeled, slope, payload, voltage) in enumerate(grid):
        side = paper.Side(voltage, np.radians(slope), payload, bool(wheeled))
        if side.steady() is None:
            assert names(steady_table8)[k] == "slides" and np.isnan(got[k]).all()
            continue
        assert names(steady_table8)[k] == "converged"
        assert_allclose(got[k], expected_readings(side), rtol=1e-9)
        compared += 1
    assert compared == 126


@pytest.mark.slow
def test_steady_matches_reference_root_on_battery(robot, grid):
    rows = grid[::3]  # voltage plays no part
    for charge in (0.0, 3000.0, 7000.0):
        wheeled, slope, payload, _ = rows.T
        runs = Conditions(
            slope_deg=slope, payload=payload, configuration=wheeled.astype(int), battery=1.0, discharge=charge
        )
        answer = steady_batch(robot, runs)
        got = readings(answer)
        for k, (w, s, p, _) in enumerate(rows):
            side = paper.Side(0.0, np.radians(s), p, bool(w), battery=True, discharge=charge)
            if side.steady() is not None:
                assert_allclose(got[k], expected_readings(side), rtol=1e-9)
            else:
                assert names(answer)[k] == "slides"


def test_steady_matches_reference_root_for_random_robots(robot):
    """Every parameter off its nominal value by up to 20 %, uphill, level and downhill."""
    rng = np.random.default_rng(3)
    for _ in range(40):
        values = {n: v * rng.uniform(0.8, 1.2) for n, v in paper.NOMINAL.items()}
        slope, payload, wheeled = rng.uniform(-0.25, 0.12), rng.uniform(0, 8), rng.integers(2)
        side = paper.Side(24.0, slope, payload, bool(wheeled), p=values)
        other = params.replace(robot, values)
        runs = Conditions(voltage=[24.0], slope_deg=np.degrees(slope), payload=payload, configuration=int(wheeled))
        answer = steady_batch(other, runs)
        if side.steady() is not None:
            assert_allclose(readings(answer)[0], expected_readings(side), rtol=1e-9)


# --- analytic cases ---------------------------------------------------------------------------------


# --- statuses and flags -----------------------------------------------------------------------------


def one(robot, **conditions):
    return jax.tree.map(lambda x: x[0], steady_batch(robot, Conditions(**{"voltage": [24.0], **conditions})))


@pytest.mark.parametrize(
    "conditions, status",
    [
        (dict(), "converged"),
        (dict(voltage=[0.5], slope_deg=np.degrees(0.1)), "stalled"),
        (dict(voltage=[0.0]), "stalled"),
        (dict(slope_deg=20.0), "slides"),
        (dict(slope_deg=-25.0), "slides"),
        (dict(battery=1.0, discharge=7920.0), "battery_empty"),
        (dict(voltage=[np.nan]), "failed"),
        (dict(payload=np.nan), "failed"),
        (dict(voltage=[np.inf]), "failed"),
    ],
)
def test_steady_status(robot, conditions, status):
    answer = one(robot, **conditions)
    assert STATUSES[int(answer.status)] == status
    floats = [x for x in jax.tree.leaves((answer.reading, answer.slip, answer.power_supply))]
    if status in ("converged", "stalled"):
        assert np.isfinite(floats).all()
    else:
        assert np.isnan(floats).all() and int(answer.flags) == 0


def test_steady_nominal_adhesion_does_not_hold_20_degrees(robot):
    answer = one(robot, slope_deg=20.0)
    assert_allclose(answer.adhesion_used, (np.tan(np.radians(20)) + 0.06) / 0.32, rtol=1e-12)


def test_steady_stalls_exactly_below_the_voltage_that_breaks_away(robot):
    """Break-away torque from the tables by hand, 6T2A on 5 degrees."""
    m, alpha, r = 13.1 / 2, np.radians(5.0), paper.PULLEY
    load = 0.350 + r * m * paper.G * (0.2 * 0.3 * np.cos(alpha) + 0.06 * np.cos(alpha) + np.sin(alpha))
    voltage = 0.611 * (load / (48 * 0.74) + 0.0027 + 0.0003) / 0.0259
    below, above = (one(robot, voltage=[voltage * k], slope_deg=5.0) for k in (0.9999, 1.0001))
    assert below.motor_speed == 0.0 < above.motor_speed
    assert STATUSES[int(below.status)] == "stalled"


@pytest.mark.slow
def test_steady_stands_until_shafts_and_robot_are_faster_than_rest(robot):
    """A tenth of V_s = 2 mm/s: below, the fidelities resolve friction at rest differently, so both say `stalled`."""
    voltages = np.linspace(0.64, 1.2, 113)
    runs = Conditions(voltage=voltages, slope_deg=5.0)
    answer = steady_batch(robot, runs)
    slow = np.minimum(np.asarray(answer.speed), np.asarray(answer.theoretical_speed)) < 2e-3
    assert slow.any() and not slow.all()
    assert (answer.status == np.where(slow, STATUSES.index("stalled"), 0)).all()
    ends = drive_batch(robot, runs, jnp.asarray([0.0, 30.0])).result
    agree = answer.status == ends.status
    assert agree.sum() >= len(voltages) - 2  # but for the edge itself
    moving = ~slow & agree
    assert_allclose(ends.speed[moving], answer.speed[moving], rtol=1e-3)
    assert_allclose(ends.total_current[moving], answer.total_current[moving], rtol=1e-3)


@pytest.mark.parametrize(
    "conditions, flags",
    [
        (dict(voltage=[15.0], configuration=1), set()),
        (dict(voltage=[24.0], configuration=1), {"gearbox_overspeed"}),
        (dict(voltage=[36.0], configuration=1), {"motor_overspeed", "gearbox_overspeed"}),
        (dict(voltage=[15.0], slope_deg=np.degrees(0.17), payload=70.0), {"winding_hot"}),
    ],
)
def test_steady_flags(robot, conditions, flags):
    mask = int(one(robot, **conditions).flags)
    assert {name for k, name in enumerate(FLAGS) if mask >> k & 1} == flags


# --- batches ----------------------------------------------------------------------------------------


def test_steady_compiles_once_for_other_numbers(robot, table8, compilations):
    jax.block_until_ready(steady_batch(robot, table8))
    other = params.replace(robot, {"motor.resistance": 0.9, "6T2A.mass": 14})
    runs = Conditions(
        voltage=table8.voltage * 0.9,
        slope_deg=table8.slope_deg,
        payload=table8.payload,
        configuration=table8.configuration,
    )
    compilations.clear()
    jax.block_until_ready(steady_batch(other, runs))
    assert not compilations


BAD = dict(
    slides=dict(slope_deg=np.degrees(0.5)),
    stalled=dict(voltage=0.3),
    nan_voltage=dict(voltage=np.nan),
    zero_voltage=dict(voltage=0.0),
    nan_payload=dict(payload=np.nan),
    negative_mass=dict(payload=-20.0),
    weightless=dict(payload=-13.1),
    empty=dict(battery=1.0, discharge=1e5),
    huge=dict(voltage=1e30),
    vertical=dict(slope_deg=90.0),
    no_adhesion=dict(adhesion=0.0),
)


@pytest.fixture(scope="module")
def speed_and_gradients(robot, rebuild):
    """Sum of the readings of the members that `keep` marks, its gradient, and its derivative along `way`."""

    @jax.jit
    def evaluate(vector, runs, keep, way):
        def total(v):
            answer = jax.vmap(steady, in_axes=(None, 0))(rebuild(v), runs)
            parts = sum(jnp.where(keep, r, 0.0).sum() for r in jax.tree.leaves(answer.reading))
            return parts, answer

        reverse, answer = jax.grad(total, has_aux=True)(vector)
        return answer, reverse, jax.jvp(lambda v: total(v)[0], (vector,), (way,))[1]

    return evaluate


def test_steady_bad_members_leave_neighbours_values_and_gradients(theta, speed_and_gradients):
    fields = ("voltage", "slope_deg", "payload", "configuration", "battery", "discharge", "adhesion")
    plain = dict(voltage=24.0, slope_deg=np.degrees(0.05), payload=2.0, configuration=0, battery=0.0, discharge=0.0)
    plain["adhesion"] = 1.0
    bad = [{**plain, **b} for b in BAD.values()]
    steep = np.degrees(np.linspace(0, 0.15, len(bad)))
    good = [{**plain, "slope_deg": s, "configuration": w} for s, w in zip(steep, [0, 1] * 6)]  # noqa: B905
    mixed = Conditions(**{f: [row[f] for pair in zip(good, bad, strict=True) for row in pair] for f in fields})
    clean = Conditions(**{f: [row[f] for row in good for _ in range(2)] for f in fields})
    keep = jnp.asarray([True, False] * len(bad))
    way = jnp.asarray(np.random.default_rng(6).normal(size=theta.size)) * theta
    answer, reverse, forward = speed_and_gradients(theta, mixed, keep, way)
    wanted, reverse_wanted, forward_wanted = speed_and_gradients(theta, clean, keep, way)
    assert_array_equal(readings(answer)[::2], readings(wanted)[::2])
    assert_allclose(reverse, reverse_wanted, rtol=1e-12)
    assert_allclose(forward, forward_wanted, rtol=1e-12)
    assert_allclose(reverse @ way, forward, rtol=1e-8)
    status = names(answer)[1::2]
    for (name, _), got in zip(BAD.items(), status, strict=True):
        assert got != "converged" or name == "huge", name


@pytest.mark.slow
def test_steady_downhill_gearbox_never_gives_power(robot):
    slopes = np.linspace(-0.25, 0.0, 26)
    answer = steady_batch(robot, Conditions(voltage=24.0, slope_deg=np.degrees(slopes), configuration=1))
    assert set(names(answer)) == {"converged"}
    assert (answer.power_motor >= answer.power_gear).all()
    assert (answer.power_gear < 0).any()  # the robot does overhaul its drive
    assert (np.diff(answer.total_current) > 0).all()
