"""Backlash as a state of the load: a rigid gear in the limit, free play at reversals, and found in a history."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose
from test_shaft import DRIVE

from calibration.data.input_errors import BadConfiguration
from calibration.data.robot_file import load_robot
from calibration.inference.calibration import calibrate
from mmrjax.effects import ALL
from mmrjax.fidelities.drive import drive_batch
from mmrjax.fidelities.histories import history_signals, time_grid
from mmrjax.fidelities.steady import steady_batch
from mmrjax.model import balances, paper_robots, params, quantities
from mmrjax.model.conditions import Conditions
from mmrjax.model.rig import Rig
from mmrjax.model.robot import Configurations
from mmrjax.model.shaft import Shaft
from mmrjax.model.signals import Signals, State
from tests.commands import csv_text, read_rig, read_table, text_file

SAMPLES = np.linspace(0, 2, 201)
TIMES = time_grid(SAMPLES, np.arange(0, 2, 0.5), change=(1e-5, 0.04))
VOLTAGE = np.where(TIMES % 1.0 < 0.5, 6.0, -6.0)


def bench(backlash):
    shaft = Shaft(inertia=0.01, loss_coulomb=0.1, loss_viscous=0.01, backlash=backlash)
    rig = Rig(loose=backlash > 0)
    return params.replace(paper_robots.blank_robot(Configurations({"bench": shaft}), rig=rig), DRIVE)


@jax.jit
def driven(robot):
    conditions = replace(Conditions(voltage=0.0), voltage=jnp.asarray(VOLTAGE))
    return history_signals(robot, conditions, jnp.asarray(TIMES))


@pytest.mark.slow
def test_a_little_backlash_is_a_rigid_gear_once_things_have_settled():
    rigid, tight = driven(bench(0.0)), driven(bench(1e-4))
    ends = np.searchsorted(TIMES, [0.49, 0.99, 1.49, 1.99])
    assert_allclose(np.asarray(tight.speed_motor)[ends], np.asarray(rigid.speed_motor)[ends], rtol=2e-4)
    assert_allclose(np.asarray(tight.current)[ends], np.asarray(rigid.current)[ends], rtol=2e-3)


def test_effects_of_the_gearbox_go_by_the_load_within_the_backlash_too():
    """By the torque that the flanks carry: on the flank that drives, on the other one, and none between them."""
    those = [e for e in ALL if e.balance == "gearbox"]
    memory = {e.name: jnp.asarray(0.6) for e in those}

    @jax.jit
    def moving(amplitudes, gap):
        there = tuple(e(amplitude=a) for e, a in zip(those, amplitudes, strict=True))
        robot = replace(bench(0.02), effects=there)
        found = balances.moving_signals(
            robot, Conditions(0, voltage=6.0), State(0.5, 64.0, 4.0, 0.0, memory, gap=gap)
        )
        return found.torque_net, found.torque_output

    for gap in jnp.asarray([0.015, 0.0, -0.015]):
        without, carried = moving(jnp.zeros(len(those)), gap)
        assert np.sign(carried) == np.sign(gap)
        at = Signals(torque_carried=carried, direction=jnp.asarray(1.0), speed_motor=jnp.asarray(64.0), memory=memory)
        for k, effect in enumerate(those):
            lost = float(without - moving(jnp.zeros(len(those)).at[k].set(0.1), gap)[0])
            assert lost == pytest.approx(float(effect(amplitude=0.1).term(bench(0.02), at)), rel=1e-6), effect.name
            assert lost != 0 or gap == 0 or (effect.name == "backdriving_loss" and gap > 0)


@pytest.mark.slow
def test_steady_travel_knows_no_backlash():
    conditions = Conditions(voltage=np.array([6.0, -6.0]))
    run = drive_batch(bench(0.05), conditions, jnp.asarray([0.0, 3.0])).result
    steady = steady_batch(bench(0.05), conditions)
    for name in ("motor_speed", "output_speed", "total_current", "output_torque"):
        assert_allclose(run.reading[name], steady.reading[name], rtol=1e-4)


def test_at_a_reversal_the_motor_turns_through_the_backlash_before_the_load():
    """Motor side and load differ by the backlash from forward to backward, beside what the flanks give way."""
    apart = []
    for backlash in (0.05, 0.1):
        s = driven(bench(backlash))
        rate = np.asarray(s.speed_wheel - s.speed_output)
        gap = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(TIMES))])
        forward, backward = gap[np.searchsorted(TIMES, 0.49)], gap[np.searchsorted(TIMES, 0.99)]
        apart.append(forward - backward)
    assert_allclose(np.diff(apart), [0.05], rtol=1e-3)
    assert 0.05 < apart[0] < 0.052


@pytest.mark.slow
def test_the_derivative_by_the_backlash_is_the_difference():
    def speed(x):
        return driven(params.replace(bench(0.05), {"bench.backlash": x})).speed_motor

    slope = np.asarray(jax.jit(lambda x: jax.jvp(speed, (x,), (1.0,))[1])(0.05))
    difference = np.asarray(speed(0.05 + 1e-6) - speed(0.05 - 1e-6)) / 2e-6
    assert np.abs(slope).max() > 10
    assert np.abs(slope - difference).max() < 0.01 * np.abs(difference).max()


FILE = """
schema = "mmrjax.robot/2"
base = "none"
imposed = "voltage"
channels = ["motor_speed", "output_angle"]
[motor]
resistance = 3.0
torque_constant = 0.05
inertia = 2e-6
friction_coulomb = 2e-3
[gearbox]
ratio = 16
efficiency_load = 0.8
[bench]
load = "shaft"
inertia = 0.01
loss_coulomb = 0.1
backlash = "0.08 ± 30 %"
"""


@pytest.mark.parametrize(
    "stated, got",
    [
        ('backlash = "0.08 ± 30 %"', r"backlash: got 0\.08 rad"),
        ('stiffness = "20 ± 5"\ndamping = "0.01 ± 0.005"', "stiffness: got 20 N·m/rad"),
    ],
)
def test_a_file_with_backlash_is_followed_with_it_and_needs_inertia(tmp_path, stated, got):
    path, text = tmp_path / "rig.toml", FILE.replace('backlash = "0.08 ± 30 %"', stated)
    assert load_robot(text_file(path, text)).loose
    with pytest.raises(BadConfiguration, match=rf"bench\.{got}; .* motor\.inertia and bench\.inertia"):
        load_robot(text_file(path, text.replace("inertia = 2e-6\n", "")))


@pytest.mark.nightly
def test_backlash_is_found_in_a_history_of_reversals(tmp_path):
    robot = read_rig(tmp_path, FILE)
    seen = driven(params.replace(robot, {"bench.backlash": 0.06}))
    at, noise = np.searchsorted(TIMES, SAMPLES), default_rng(3).standard_normal((len(SAMPLES), 2)).T
    columns = {
        "time_s": SAMPLES, "supply_voltage_V": VOLTAGE[at],
        "motor_speed_rpm": np.asarray(seen.speed_motor)[at] / quantities.RPM + 5 * noise[0],
        "motor_speed_sd_rpm": np.full(len(at), 5.0), "output_angle_deg": np.degrees(seen.angle)[at] + 0.2 * noise[1],
        "output_angle_sd_deg": np.full(len(at), 0.2),
    }  # fmt: skip
    found = calibrate(
        read_table(tmp_path, csv_text(columns), robot, "table.csv"), robot, model="drive", starts=2, blocks=False,
        free=["bench.backlash", "bench.loss_coulomb"], profiles=False,
    )  # fmt: skip
    backlash = found.parameters["bench.backlash"]
    # Flanks that meet and part make kinks in the misfit: its curvature says less than what it finds is off by.
    assert abs(backlash.value - 0.06) < 0.003 and not backlash.held_by_prior
