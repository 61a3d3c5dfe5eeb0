"""Motors whose current is imposed: steady travel, histories, tables and fits against plain physics, without a winding."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration.data import unused_readings
from calibration.data.input_errors import BadConfiguration
from calibration.data.rig_facts import doubtful_current
from calibration.data.robot_file import read_robot, write_robot
from calibration.inference import bases, observers
from calibration.inference import blocks as holdout
from calibration.inference.observers import time_histories
from mmrjax.fidelities.histories import history_signals
from mmrjax.fidelities.steady import steady
from mmrjax.model import params
from mmrjax.model.balances import absent_balances
from mmrjax.model.conditions import Conditions
from tests.commands import csv_text, read_rig, read_table

K, RATIO, ETA = 0.05, 10.0, 0.9
DRY, VISCOUS, INERTIA, ROTOR = 0.3, 0.02, 0.01, 2e-6
RIG = f"""
base = "none"
imposed = "current"
channels = ["motor_speed"]
[motor]
torque_constant = {K}
inertia = {ROTOR}
[gearbox]
ratio = {RATIO}
efficiency_load = {ETA}
[bench]
load = "shaft"
inertia = {INERTIA}
loss_coulomb = "{DRY} ± 30 %"
loss_viscous = "{VISCOUS} ± 50 %"
"""


@pytest.fixture
def robot(tmp_path):
    return read_rig(tmp_path, RIG)


def settles(current):
    """Speed of the motor [rad/s] at which i η k I is what the load takes."""
    torque = RATIO * ETA * K * np.abs(current) - DRY
    return np.sign(current) * RATIO * np.maximum(torque, 0.0) / VISCOUS


def turned(current, every):
    """Angle of the output [rad] at each row, by the exact solution from row to row, with stops and breakaways."""
    inertia, angle, speed, angles = INERTIA + ROTOR * RATIO**2, 0.0, 0.0, []
    rate = VISCOUS / inertia
    for torque in RATIO * K * current:
        angles.append(angle)
        left = every
        while left > 0 and (speed or abs(torque) > DRY):
            way = np.sign(speed or torque)
            end = (torque - DRY * way) / VISCOUS
            stops = np.log1p(-speed / end) / rate if speed and end * way < 0 else np.inf
            lasts = min(left, stops)
            fades = -np.expm1(-rate * lasts)
            angle += end * lasts + (speed - end) * fades / rate
            speed = 0.0 if stops <= left else end + (speed - end) * (1 - fades)
            left -= lasts
    return np.array(angles)


def test_a_thinned_log_of_a_varying_current_turns_the_load_as_its_rows_do(tmp_path):
    """A lag of 0.2 ms changed the angle by 4e-3 rad, and means across stops and breakaways by 1.5e-3 rad."""
    rig = RIG.replace('"motor_speed"', '"output_angle"').replace(f"load = {ETA}", 'load = "1.0 ± 0"')
    robot, every = read_rig(tmp_path, rig), 0.002
    time = every * np.arange(6000)
    current = np.round(2.0 * np.sin(2 * np.pi * (0.2 + 0.08 * time) * time), 3)
    angle = turned(current, every)
    rows = "".join(f"{t:.3f},{i},{np.degrees(x)}\n" for t, i, x in zip(time, current, angle, strict=True))
    runs = unused_readings.thin_rows(
        read_table(tmp_path, "time_s,motor_current_A,output_angle_deg\n" + rows, robot), 1000
    )
    observe = time_histories.Histories.of(runs, robot)
    assert len(runs) < 1100 and observe.times.size < len(time)
    simulated = np.asarray(jax.jit(lambda robot: observe(robot).reading)(robot))[:, 0]
    assert np.abs(simulated - runs.measured()[:, 0]).max() < 1e-4


@pytest.mark.parametrize("factor, doubted", [(1.0, False), (1e3, True), (1e-3, True)])
def test_a_current_in_another_unit_is_doubted_with_what_turns_the_load(tmp_path, robot, factor, doubted):
    """It is 0.67 A that turns the load slowly."""
    rows = "".join(f"{0.1 * k},{factor * current},0\n" for k, current in enumerate((1.5, 2.0, -1.5)))
    said = doubtful_current(
        read_table(tmp_path, f"time_s,motor_current_A,motor_speed_rpm\n{rows}", robot),
        robot,
    )
    assert bool(said) == doubted
    if doubted:
        assert (
            f"up to {2 * factor:g} A, although by the file's numbers the load turns slowly at 0.667 A. Is it in"
            in said
        )


def test_the_file_says_what_is_imposed_and_needs_no_winding(robot, tmp_path):
    assert robot.rig.imposed == "motor_current"
    assert {"electrical", "inductance", "supply"} <= absent_balances(robot)
    write_robot(robot, tmp_path / "again.toml")
    assert read_robot(tmp_path / "again.toml").rig == robot.rig
    for old, new, says in (
        ('["motor_speed"]', '["motor_current"]', "motor_current is imposed, so it cannot be a reading"),
        (f"torque_constant = {K}", "", r"motor\.torque_constant \[N·m/A\] is missing"),
    ):
        with pytest.raises(BadConfiguration, match=says):
            read_rig(tmp_path, RIG.replace(old, new), "bad.toml")


@pytest.mark.parametrize("resistance", [0.1, 5.0])
def test_steady_speeds_follow_from_torque_whatever_the_winding(robot, resistance):
    robot = params.replace(robot, {"motor.resistance": jnp.asarray(resistance)})
    for current in (-2.0, 1.0, 3.0):
        found = steady(robot, Conditions(motor_current=current))
        assert_allclose(found.reading["motor_speed"], settles(current), rtol=1e-6)
        assert_allclose(found.reading["motor_current"], current, rtol=1e-9)
    assert float(steady(robot, Conditions(motor_current=0.5)).reading["motor_speed"]) == 0.0  # friction holds it


def test_a_shaft_turns_through_rest_and_is_held_there_at_its_very_moment(tmp_path):
    """Friction jumps there. By steps of 5 ms from 3 A to -2 A to 0.1 A, against the law of either way. Its derivative by
    the dry friction too: it goes on from the first way to the second, and what friction holds forgets it."""
    robot = read_rig(tmp_path, RIG.replace(f"load = {ETA}", "load = 1.0"))
    times = np.arange(0.0, 0.9001, 0.005)
    levels = np.select([times < 0.3, times < 0.6], [3.0, -2.0], 0.1)
    rate = VISCOUS / (INERTIA + ROTOR * RATIO**2)

    def law(dry):
        shown, speed = [0.0], 0.0
        for level, h in zip(levels, np.diff(times), strict=False):
            for _ in range(2):  # to rest, and from it
                way = np.sign(speed) or np.sign(level) * (RATIO * K * abs(level) > dry)
                end = RATIO * (RATIO * K * level - way * dry) / VISCOUS if way else 0.0
                at_rest = np.log1p(-speed / end) / rate if speed * end < 0 else np.inf
                speed, h = (0.0, h - at_rest) if at_rest < h else (end + (speed - end) * np.exp(-rate * h), 0.0)
            shown.append(speed)
        return np.array(shown)

    def ours(dry):
        changed = params.replace(robot, {"bench.loss_coulomb": dry, "motor.inductance": 1e-9})
        found = history_signals(changed, Conditions(motor_current=jnp.asarray(levels)), jnp.asarray(times))
        return found.speed_motor, found.speed_motor

    slope, shown = map(np.asarray, jax.jit(jax.jacfwd(ours, has_aux=True))(DRY))
    exact, expected = law(DRY), (law(DRY + 1e-4) - law(DRY - 1e-4)) / 2e-4
    passed = exact.max() > 40 and exact.min() < -20 and exact[-1] == 0
    assert passed and np.abs(shown - exact).max() < 1e-4 * np.abs(exact).max()
    assert np.abs(slope - expected).max() < 0.02 * np.abs(expected).max()


def test_derivatives_are_those_of_the_steps_where_a_lagging_current_stops_a_shaft_and_starts_it(tmp_path):
    """A carriage under a position controller: the current passes the dry friction every tenth of a second, within
    steps of 1 ms, and lags by 0.3 ms. Where a level is just above the friction, the shaft creeps."""
    robot = params.replace(read_rig(tmp_path, RIG), {"motor.inductance": 3e-4, "motor.resistance": 1.0})
    times = np.arange(0.0, 1.2, 1e-3)
    current = np.round(1.2 * np.sin(2 * np.pi * 3.1 * times) + 0.25 * np.sin(2 * np.pi * 41 * times), 2)

    @jax.jit
    def ours(values):
        changed = params.replace(robot, {"bench.loss_coulomb": values[0], "bench.inertia": values[1]})
        found = history_signals(changed, Conditions(motor_current=jnp.asarray(current)), jnp.asarray(times))
        return found.speed_motor

    at = np.array([DRY, INERTIA])
    slope, shown = np.asarray(jax.jit(jax.jacfwd(ours))(at)), np.asarray(ours(at))
    moves = np.diff(np.sign(shown)) != 0
    assert moves.sum() > 12 and (shown == 0).sum() > 50
    for k, change in enumerate(np.diag(1e-7 * at)):
        steps = np.asarray(ours(at + change) - ours(at - change)) / (2 * change[k])
        assert np.abs(slope[:, k] - steps).max() < 2e-3 * np.abs(steps).max()


@pytest.mark.parametrize("excess", [1e-3, 1e-5])
def test_a_current_just_above_the_friction_hardly_turns_a_shaft(robot, excess):
    """It leaves rest when the lagging current exceeds the friction, and moves by the excess alone."""
    robot = params.replace(robot, {"motor.inductance": 1e-3, "motor.resistance": 1.0})
    level = DRY * (1 + excess) / (RATIO * ETA * K)
    times = jnp.arange(0.0, 0.05, 2.5e-3)
    found = history_signals(robot, Conditions(motor_current=jnp.full(times.shape, level)), times)
    speed, most = np.asarray(found.speed_motor), RATIO * DRY * excess / (INERTIA + ETA * ROTOR * RATIO**2) * 0.05
    assert 0.5 * most < speed[-1] < most


def test_levels_of_the_current_are_blocks_to_hold_out_and_curves_are_over_it(robot, tmp_path):
    current = np.repeat([-3.0, -2.0, -1.2, 1.2, 1.6, 2.0, 2.5, 3.0], 3)
    table = csv_text({"motor_current_A": current, "motor_speed_rpm": settles(current) * 30 / np.pi})
    runs = read_table(tmp_path, table, robot, "runs.csv")
    kind = observers.observer_kind(runs)
    blocks = holdout.distinct_held_out_blocks(runs, kind.blocks)
    assert list(blocks) == ["current"] and len(blocks["current"]) == 8
    found = kind.of(runs, robot).bases(runs.columns, np.ones(len(runs), bool), robot)
    assert ("track", "current") in bases.family_names(found)
