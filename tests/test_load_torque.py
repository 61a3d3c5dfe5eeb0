"""Torque of a brake as a condition: against formulas, the same torque of the load, another implementation, differences."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from test_shaft import SPEEDS, bench, current_of
from test_worlds_rigs import steady
from worlds import rigs

import mmrjax as mm
from calibration.data.input_errors import BadConfiguration, BadData
from calibration.data.profiles import read_profile
from calibration.data.rig_facts import doubtful_torque, log_doubts
from calibration.inference import bases
from calibration.inference.observers import Histories
from mmrjax.effects.curve import WAYS
from mmrjax.errors import UsageError
from mmrjax.fidelities import rest
from mmrjax.fidelities.drive import drive_batch
from mmrjax.fidelities.histories import history_signals, time_grid
from mmrjax.fidelities.steady import steady_batch, steady_outputs
from mmrjax.model import balances
from mmrjax.model.conditions import Conditions
from mmrjax.model.rig import Rig
from mmrjax.model.signals import STATUSES, State
from sweeps.config import Sweep
from sweeps.config_campaign import campaign_of_grid
from tests.commands import read_rig, read_table, text_file

VOLTS = np.array([24.0, 6.0, -12.0, 12.0])
TORQUE = np.array([0.5, 0.1, -0.3, 0.0])  # of a brake: against the way that each turns


def test_current_at_an_imposed_speed_follows_from_a_brake():
    """In both directions, a torque that drives the motor among them. Its derivative is that of the formula."""

    def shown(torque):
        conditions = Conditions(motor_speed=SPEEDS, load_torque=torque)
        return steady_outputs(bench(), conditions, ("motor_current", "output_torque"))

    torque = jnp.asarray([-0.1, 1.0, 0.3, 2.0])
    found, slope = jax.jit(lambda x: jax.jvp(shown, (x,), (jnp.ones(4),)))(torque)
    assert_allclose(found["motor_current"], current_of(SPEEDS, np.asarray(torque)), rtol=1e-9)
    assert_allclose(
        found["output_torque"], np.sign(SPEEDS) * 0.2 + 0.01 * SPEEDS / 16 + np.asarray(torque), rtol=1e-9
    )
    drives = np.array([False, True, False, False])
    assert_allclose(slope["motor_current"], np.where(drives, 0.8, 1 / 0.8) / 16 / 0.05, rtol=1e-9)


@pytest.mark.parametrize("loose", [False, True])
def test_a_brake_enters_as_a_constant_torque_of_the_load(loose):
    """Every signal of an instant, of a shaft with and without backlash, under an arm's weight."""
    state = State(1.0, 120.0, 7.0, 0.0, distance=0.3, gap=0.012 if loose else None)

    def moving(brake=None, **load):
        robot = bench(Rig(loose=loose), torque_gravity=0.4, backlash=0.02 * loose, **load)
        return jax.jit(balances.moving_signals)(robot, Conditions(load_torque=brake), state)

    braked, stated, free = moving(0.3), moving(torque_constant=0.3), moving()
    jax.tree.map(assert_allclose, replace(braked, load_torque=None), stated)
    assert float(braked.acceleration) < float(free.acceleration)


def test_a_torque_above_what_stalls_the_motors_turns_them_back():
    robot = bench()
    for voltage, torque, way in ((24.0, 3.0, 1.0), (24.0, 7.0, -1.0), (0.0, 0.5, -1.0), (0.0, -0.5, 1.0)):
        # 24 V / 3 ohm · 0.05 N·m/A · 16 = 6.4 N·m
        assert float(rest.travel_direction(robot, Conditions(voltage=voltage, load_torque=torque))) == way


@pytest.mark.parametrize("imposed", ["voltage", "motor_speed"])
def test_settled_rigs_with_a_brake_are_those_of_another_implementation(imposed):
    w = rigs.world(default_rng([3, 1]), "bench", imposed)
    size = 0.5 * rigs._nominal(w.constants, w.rig.supply)[0]
    torque = size * default_rng(0).uniform(0, 1, len(w.conditions)) * w.conditions.direction
    w, free = (replace(w, conditions=replace(w.conditions, load_torque=x)) for x in (torque, 0 * torque))
    found, _ = steady(w)
    (s, sound), (without, _) = (rigs.solve(x.rig, x.conditions, x.constants) for x in (w, free))
    assert sound.all()
    scale = np.abs(s.shown).max(1, keepdims=True)
    assert_allclose(found / scale, s.shown / scale, atol=1e-6)
    assert (np.abs(without.shown - s.shown) > 1e-2 * scale).any()  # a brake without effect would be seen


def test_a_torque_that_changes_from_step_to_step_is_followed():
    """A run from rest, which the torque begins to turn back before the current has risen."""
    times = time_grid(np.linspace(0, 0.6, 13))
    run = jax.jit(lambda x: history_signals(bench(), Conditions(voltage=24.0, load_torque=x), jnp.asarray(times)))
    changes = run(0.3 + 0.2 * np.sin(8 * times)).speed_motor
    end = float(run(np.full(len(times), 0.3)).speed_motor[-1])
    assert np.isfinite(changes).all() and abs(float(changes[-1]) - end) > 1.0
    assert 0.05 * end + 3.0 * current_of(end, 0.3) == pytest.approx(24.0, rel=1e-3)  # back-EMF and what torque takes


def _steady(torque):
    return steady_batch(bench(), Conditions(voltage=VOLTS, load_torque=torque))


def _driven(torque):
    return drive_batch(bench(), Conditions(voltage=VOLTS, load_torque=torque), jnp.asarray([0.0, 2.0, 4.0])).result


@pytest.mark.slow
def test_derivatives_by_a_brake_are_differences():
    """Of settled travel and of a run over time. Of a history by the load's own torque, which is the same."""
    for settles in (_steady, _driven):

        def speed(x, settles=settles):
            return settles(TORQUE + x).motor_speed

        assert_allclose(jax.jvp(speed, (0.0,), (1.0,))[1], (speed(1e-4) - speed(-1e-4)) / 2e-4, rtol=1e-4)
    times = jnp.asarray(time_grid(np.linspace(0, 0.6, 13)))
    torque = 0.3 + 0.2 * jnp.sin(8 * times)

    @jax.jit
    def both(x):
        def shown(own):
            conditions = Conditions(load_torque=torque + x)
            return history_signals(bench(torque_constant=own), conditions, times).speed_motor

        return jax.jvp(shown, (0.0,), (1.0,))

    less, (_, slope), more = map(both, (-1e-4, 0.0, 1e-4))
    assert_allclose(slope, (more[0] - less[0]) / 2e-4, rtol=1e-3, atol=1e-3)


def test_a_brake_on_a_vehicle_is_refused(robot):
    with pytest.raises(UsageError, match=r"load_torque: the robot is a vehicle.*slope_deg or payload"):
        mm.simulate(robot, mm.Conditions(load_torque=0.1))
    profile = mm.profile([0.0, 1.0], load_torque=0.1)
    with pytest.raises(UsageError, match="load_torque: the robot is a vehicle"):
        mm.simulate(robot, mm.Conditions(), profile=profile)


RIG = """
base = "none"
{head}
[motor]
resistance = 0.5
torque_constant = 0.05
friction_coulomb = 0.01
[gearbox]
ratio = 1
efficiency_load = 1.0
[brake]
load = "shaft"
inertia = 1e-4
loss_coulomb = 0.0
"""


def read(tmp_path, lines, head=""):
    robot = read_rig(tmp_path, RIG.format(head=head))
    return read_table(tmp_path, "\n".join(lines) + "\n", robot, "runs.csv"), robot


@pytest.mark.parametrize(
    "column, head, factor",
    [
        ("load_torque_Nm", "", 1.0),
        ("load_torque_mNm", "", 1e-3),
        ("load_torque_kNm", "", 1e3),
        ("M_b", '[columns]\nload_torque_mNm = "M_b"', 1e-3),
        ("M_b", '[columns]\nload_torque_Nm = {column = "M_b", factor = -0.1}', -0.1),
    ],
)
def test_the_torque_of_a_row_is_read_in_its_unit(tmp_path, column, head, factor):
    lines = [f"supply_voltage_V,motor_speed_rpm,{column}", "24,4000,0.2", "12,2000,0"]
    runs, rig = read(tmp_path, lines, head)
    assert_allclose(runs.conditions(rig).load_torque, [0.2 * factor, 0.0])
    assert "load_torque_Nm" in runs.axes


def test_a_torque_without_a_sign_is_reported_as_driving_a_shaft_that_runs_backward(tmp_path):
    head = "supply_voltage_V,motor_speed_rpm,motor_current_A,load_torque_Nm\n24,4000,4.2,0.2\n"
    for row, drives in (("-24,-4400,3.8,0.2", True), ("-24,-4000,-4.2,-0.2", False)):
        runs, _ = read(tmp_path, [head + row], 'channels = ["motor_speed", "motor_current"]')
        assert (
            bool(runs.pulled) == drives
            and any("got 0.2 where the shaft is driven backward" in n for n in runs.notes) == drives
        )


@pytest.mark.parametrize("between", ["held", "linear"])
def test_a_log_holds_the_torque_of_every_sample(tmp_path, between):
    time = np.arange(12) * 0.05
    torque = np.round(0.1 + 0.05 * np.sin(20 * time), 4)
    lines = ["time_s,supply_voltage_V,motor_speed_rpm,load_torque_Nm"]
    lines += [f"{t:.2f},24,{1e4 * t:.6g},{m}" for t, m in zip(time, torque, strict=True)]
    runs, rig = read(tmp_path, lines, f'between_rows = "{between}"')
    observe = Histories.of(runs, rig)
    held, times = np.asarray(observe.conditions.load_torque)[0], np.asarray(observe.times)[0]
    middle = 0.5 * (times[1:] + times[:-1])
    at = np.interp(middle, time, torque) if between == "linear" else torque[np.searchsorted(time, middle) - 1]
    moving = np.diff(times) > 0
    assert_allclose(held[:-1][moving], at[moving])
    assert observe.driven.load_torque.min() >= torque.min()


@pytest.mark.parametrize("torque", [{}, {"load_torque_Nm": np.linspace(0, 0.5, 18)}])
def test_a_drift_that_goes_with_the_torque_is_none(torque):
    """Tables of a brake are sorted by its torque. Their order then shows no drift of its own."""
    columns = {
        "configuration": np.full(18, "brake"), "order": np.arange(18.0), "supply_voltage_V": np.full(18, 24.0),
        "total_current_A": np.linspace(0, 9, 18), **torque,
    }  # fmt: skip
    ways, scope = dict.fromkeys(WAYS, np.ones(18)), bases.CurveScope.of(bench(), columns)
    over = {variable for _, variable in bases.family_names(bases.curve_families(columns, np.ones(18), ways, scope))}
    assert ("order" in over) != bool(torque)


def test_a_torque_in_another_unit_is_doubted(tmp_path):
    """24 V and 0.5 ohm stall at 2.4 N·m. The same torques in mN·m are in order."""
    rows = [f"24,{4565 - 1.91 * m},{m}" for m in (0, 100, 200, 300)]
    for column, doubted in (("load_torque_Nm", True), ("load_torque_mNm", False)):
        runs, rig = read(tmp_path, [f"supply_voltage_V,motor_speed_rpm,{column}", *rows])
        said = doubtful_torque(runs, rig)
        assert log_doubts(runs, rig) == (said,) * doubted
        assert (
            "row 2, load_torque_Nm: got 100 N·m, but the motors stall at 2.39 N·m; is it in mN·m" in said
        ) == doubted


def test_a_profile_and_a_sweep_state_the_torque(tmp_path, robot):
    table = read_profile(text_file(tmp_path / "p.csv", "time_s,duty,load_torque_mNm\n0,1,0\n1,1,300\n2,,\n"))
    assert_allclose(table.values["load_torque"], [0.0, 0.3, 0.3])
    assert table.stated == ("load_torque_Nm",)
    with pytest.raises(BadData, match=r"bad\.csv row 2, load_torque_Nm: got an empty cell; expected a number"):
        read_profile(text_file(tmp_path / "bad.csv", "time_s,duty,load_torque_Nm\n0,1,0\n1,1,\n2,1,0\n"))
    made = mm.sweep(bench(), voltages=[12.0, 24.0], load_torques=[0.0, 0.5])
    assert made.to_dict()["load_torque_Nm"].tolist() == [0.0, 0.5, 0.0, 0.5]
    free, braked = np.asarray(made.motor_speed).reshape(2, 2).T
    assert (braked < free).all() and "load torque" in str(made)
    with pytest.raises(BadConfiguration, match="--load-torques: the robot is a vehicle"):
        mm.sweep(robot, load_torques=[0.5])
    stated = campaign_of_grid(Sweep(load_torques_Nm=(0.0, 0.5), voltages_V=(12.0,), robot="rig.toml")).axes
    assert stated["load_torque"] == [0.0, 0.5]


@pytest.mark.slow
def test_every_fidelity_settles_alike_under_a_brake():
    at, run = _steady(TORQUE), _driven(TORQUE)
    for name in ("motor_speed", "total_current", "output_torque"):
        assert_allclose(run.reading[name], at.reading[name], rtol=1e-6)
    assert [STATUSES[s] for s in np.asarray(at.status)] == ["converged", "converged", "reverses", "converged"]
    without = steady_batch(bench(), Conditions(voltage=VOLTS))
    assert (np.abs(at.motor_speed)[:3] < np.abs(without.motor_speed)[:3]).all()  # it brakes either way
    assert_array_equal(at.motor_speed[3], without.motor_speed[3])
    times = time_grid(np.linspace(0, 4.0, 9))
    shown = jax.jit(history_signals)(bench(), Conditions(voltage=24.0, load_torque=0.5), jnp.asarray(times))
    assert_allclose(shown.speed_motor[-1], at.motor_speed[0], rtol=1e-6)


@pytest.mark.nightly
def test_a_dynos_table_gives_back_its_motor_and_nothing_is_missing(tmp_path):
    """Of one voltage, from a file that is off by a tenth: R 0.5, k 0.05, M0 0.01."""
    torque = np.round(np.arange(9) * 0.1, 1)
    current = (torque + 0.01) / 0.05
    speed = (24 - 0.5 * current) / 0.05 * 30 / np.pi
    current += 0.003 * default_rng(1).standard_normal(9)  # an exact line would be a computed current
    head = 'channels = ["motor_current", "motor_speed"]\n[columns]\nload_torque_Nm = "output_torque_Nm"'
    off = RIG.format(head=head)
    for true, stated in ((0.5, "0.54 ± 10 %"), (0.05, "0.047 ± 10 %"), (0.01, "0.02 ± 100 %"), ("1.0", "1 ± 0")):
        off = off.replace(f" = {true}\n", f' = "{stated}"\n')
    rig = read_rig(tmp_path, off)
    columns = {
        "supply_voltage_V": np.full(9, 24.0),
        "motor_speed_rpm": np.round(speed, 1),
        "output_torque_Nm": torque,
    }
    runs = mm.read_runs(columns | {"motor_current_A": np.round(current, 3)}, robot=rig)
    found = mm.discover(runs, rig, noise="motor_current=0.003 A,motor_speed=0.03 rpm")
    assert found.verdict == "none"
    for name, value in {"resistance": 0.5, "torque_constant": 0.05, "friction_coulomb": 0.01}.items():
        assert_allclose(getattr(found.robot.motor, name), value, rtol=0.01)
