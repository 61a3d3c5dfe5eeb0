"""Shafts that a clamp holds: against formulas, beside free rows, and from tables to constant and resistance."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose
from test_shaft import DRIVE, bench

import mmrjax as mm
from calibration.data.input_errors import BadConfiguration, BadData
from calibration.data.rig_facts import doubtful_current
from calibration.data.runs import read_runs
from calibration.discovery import scales
from calibration.inference.calibration import calibrate
from calibration.inference.observers import Histories, SettledRuns
from mmrjax import effects
from mmrjax.errors import UsageError
from mmrjax.fidelities.steady import steady_batch
from mmrjax.model import params
from mmrjax.model.conditions import Conditions
from mmrjax.model.rig import Rig
from mmrjax.model.signals import STATUSES
from tests.commands import read_rig

AMPERES = np.array([-8.0, -2.0, 0.5, 5.0])
#: Friction of motor (N·m) and efficiency of `bench`; its load has none here.
FRICTION, EFFICIENCY, RATIO = DRIVE["motor.friction_coulomb"], 0.8, 16.0


def torque_of(current, constant=0.05):
    """Torque at the clamp [N·m]: friction acts against the current, and holds what it can."""
    left = np.maximum(constant * np.abs(current) - FRICTION, 0.0)
    return np.sign(current) * RATIO * EFFICIENCY * left


def clamped():
    return bench(Rig(imposed="motor_current"), loss_coulomb=0.0, loss_viscous=0.0)


def test_a_clamp_carries_what_current_and_friction_leave():
    """Beside a free row. Too little current for the friction leaves the clamp nothing."""
    current, held = np.array([*AMPERES, 0.03, 5.0]), np.array([1.0, 1, 1, 1, 1, 0])
    conditions = Conditions(motor_current=current, held=held, load_torque=np.array([0.0, 0, 0, 0, 0, 0.4]))
    found = steady_batch(clamped(), conditions)
    assert_allclose(found.output_torque[:5], torque_of(current[:5]), rtol=1e-9, atol=1e-9)
    assert_allclose(found.motor_voltage[:5], 3.0 * current[:5], rtol=1e-9)
    assert not np.any(found.motor_speed[:5]) and float(found.motor_speed[5]) > 100
    assert [STATUSES[s] for s in np.asarray(found.status)] == ["converged"] * 6


def test_a_locked_rotor_draws_voltage_over_resistance():
    """The current and its derivative by the resistance, and that of the torque by the constant, are the formulas'."""
    volts = np.array([-6.0, 3.0, 9.0])

    def read(x):
        robot = params.replace(bench(loss_coulomb=0.0), {"motor.resistance": x[0], "motor.torque_constant": x[1]})
        found = steady_batch(robot, Conditions(voltage=volts, held=1.0))
        return jnp.stack([found.motor_current, found.output_torque])

    at = jnp.array([3.0, 0.05])
    current, slopes = volts / 3.0, jax.jacfwd(read)(at)
    assert_allclose(read(at), [current, torque_of(current)], rtol=1e-9)
    assert_allclose(slopes[0, :, 0], -current / 3.0, rtol=1e-8)
    assert_allclose(slopes[1, :, 1], RATIO * EFFICIENCY * current, rtol=1e-8)
    assert_allclose(jax.jacrev(read)(at), slopes, rtol=1e-8, atol=1e-12)


def test_a_shaft_at_rest_pushes_against_its_load():
    """At an imposed speed of 0, current follows from the torque in either direction."""
    torque = torque_of(AMPERES)
    found = steady_batch(clamped(), Conditions(motor_speed=0.0, load_torque=torque))
    assert_allclose(found.motor_current, AMPERES, rtol=1e-9)
    assert [STATUSES[s] for s in np.asarray(found.status)] == ["converged"] * 4


@pytest.mark.parametrize("wrong", [{"motor_speed": 3.0, "held": 1}, {"held": True, "model": "drive"}])
def test_a_clamp_elsewhere_is_refused(wrong):
    model = wrong.pop("model", "steady")
    with pytest.raises(UsageError, match="held: a clamp needs a shaft"):
        mm.simulate(bench(), Conditions(**wrong), model)


RIG_HELD = """schema = "mmrjax.robot/2"
base = "none"
sides = 1
imposed = "{imposed}"
channels = [{channels}]
[motor]
resistance = "0.3 ± 30 %"
torque_constant = "0.1 ± 30 %"
friction_coulomb = "0.02 ± 50 %"
[gearbox]
ratio = "5 ± 0"
efficiency_load = "1 ± 0"
[brake]
load = "shaft"
inertia = 1e-4
loss_coulomb = 0.0
"""


FREED = ("motor.resistance", "motor.torque_constant", "motor.friction_coulomb")


def rig(tmp_path, imposed, channels):
    return read_rig(tmp_path, RIG_HELD.format(imposed=imposed, channels=channels))


#: Of a test of the motor, both ways [A].
CURRENT = np.r_[-16.0:0:2, 2.0:18:2]


def table(**more):
    """Columns of a test with the shaft held: constant 0.12, friction 0.03 N·m, resistance 0.25 ohm."""
    rng = default_rng(5)
    torque = 5 * (0.12 * CURRENT - 0.03 * np.sign(CURRENT)) + rng.normal(0, 0.01, 16)
    columns = {"motor_current_A": CURRENT, "motor_voltage_V": 0.25 * CURRENT + rng.normal(0, 0.01, 16)}
    return {**columns, "output_torque_Nm": torque, "held": np.ones(16), **more}


def test_a_test_with_the_shaft_held_gives_constant_friction_and_resistance(tmp_path):
    robot = rig(tmp_path, "motor_current", '"motor_voltage", "output_torque"')
    noise = "motor_voltage=0.01V,output_torque=0.01Nm"
    found = calibrate(read_runs(table(), robot=robot), robot, free=FREED, noise=noise, profiles=False)
    for name, right in (("resistance", 0.25), ("torque_constant", 0.12), ("friction_coulomb", 0.03)):
        p = found.parameters[f"motor.{name}"]
        assert abs(p.value - right) < 4 * p.sd and p.sd < 0.1 * right, (name, p.value, p.sd)


def test_a_gearbox_that_loses_nothing_by_its_file_has_no_effect(tmp_path):
    """A saturating motor was led by `gear_quadratic_loss`, though its file states an efficiency of exactly 1."""
    kind = effects.BY_NAME["gear_quadratic_loss"]
    exact = RIG_HELD.format(imposed="motor_speed", channels='"motor_current"')
    lossy = exact.replace('load = "1 ± 0"', 'load = "0.9 ± 5 %"')
    applies = [scales.effect_applies(kind, read_rig(tmp_path, text)) for text in (exact, lossy)]
    assert applies == [False, True]


def test_a_clamp_with_another_model_is_refused(tmp_path):
    robot = rig(tmp_path, "motor_current", '"motor_voltage", "output_torque"')
    with pytest.raises(BadConfiguration, match="held: got model drive; expected steady"):
        SettledRuns.of(read_runs(table(), robot=robot), robot, "drive")


def test_rows_of_a_clamp_in_tables(tmp_path):
    held = rig(tmp_path, "motor_current", '"motor_voltage", "output_torque"')
    speed = rig(tmp_path, "motor_speed", '"motor_current", "output_torque"')
    still = {"held": np.zeros(16), "motor_speed_rpm": np.zeros(16)}
    for robot, changes, says in (
        (held, {"load_torque_Nm": np.ones(16)},
         r"row 1, load_torque_Nm: got 1 although held is 1; expected 0, .* output_torque"),
        (held, {"held": np.r_[np.ones(15), 0.5]},
         r"row 16, held: got 0\.5; expected 1 if a clamp holds the output, otherwise 0"),
        (speed, still, r'nothing drives the motors; .* if the shaft is locked, set imposed = "motor_current"'),
    ):  # fmt: skip
        with pytest.raises(BadData, match=says):
            read_runs(table(**changes), robot=robot)
    assert len(read_runs(table(**still, load_torque_Nm=np.r_[np.ones(15), 0.0]), robot=speed)) == 15
    strong = table(motor_current_A=5 * CURRENT)
    assert doubtful_current(read_runs(strong, robot=held), held) == ""
    strong["held"] = np.r_[np.zeros(15), 1.0]
    doubt = doubtful_current(read_runs(strong, robot=held), held)
    assert "80 A, although by the file's numbers the load turns" in doubt


def test_a_log_of_a_clamp_is_read_as_settled_rows(tmp_path):
    """Windings settle within a millisecond."""
    held = rig(tmp_path, "motor_current", '"motor_voltage", "output_torque"')
    time, columns = 0.02 * np.arange(16.0), table()
    log, same = read_runs({**columns, "time_s": time}, robot=held), read_runs(columns, robot=held)
    assert not log.sampled and any("held in every row, so each row is read as a settled run" in n for n in log.notes)
    assert all((log[c] == same[c]).all() for c in columns)
    speed = rig(tmp_path, "motor_speed", '"motor_current", "motor_voltage"')
    torque = columns.pop("output_torque_Nm")
    columns |= {"motor_speed_rpm": np.zeros(16), "load_torque_Nm": torque, "time_s": time}
    del columns["held"]  # which the speed shows
    log = read_runs(columns, robot=speed)
    assert not log.sampled and len(log) == 16


def test_a_clamp_holds_a_part_of_a_log(tmp_path):
    """A clamp stops a turning shaft, holds it at two voltages and frees it. Such rows were left out.

    Held rows give R and k alone. The first row of the clamp is from before it, as after each change.
    """
    row = np.arange(20)
    held, volts = 1.0 * ((row >= 5) & (row < 15)), np.where(row < 10, 3.0, -6.0)
    robot = rig(tmp_path, "voltage", '"motor_current", "motor_speed", "output_torque"')
    robot = params.replace(robot, {"motor.inertia": 4e-4, "motor.inductance": 2e-4})
    log = {"time_s": 0.02 * row, "supply_voltage_V": volts, "held": held, "run_id": np.full(20, "one")}
    log |= dict.fromkeys(("motor_current_A", "motor_speed_rpm", "output_torque_Nm"), np.ones(20))
    runs = read_runs(log, robot=robot)
    assert runs.sampled and len(runs) == 20 and runs["held"].sum() == held.sum() == 10
    observe = Histories.of(runs, robot)

    def read(x):
        return observe(params.replace(robot, {"motor.resistance": x[0], "motor.torque_constant": x[1]})).reading

    at = jnp.array([0.3, 0.1])
    both = jax.jit(jax.jacfwd(lambda x: (read(x),) * 2, has_aux=True))
    slopes, readings = jax.device_get(both(at))
    speed, current, torque = readings.T
    rests, clamped = np.r_[6:16], np.r_[6:10, 11:15]  # the row of a change shows the state before it
    expected = np.where(row <= 10, 3.0, -6.0) / 0.3
    assert speed[5] > 25 and not speed[rests].any() and speed[19] < -25
    assert_allclose(current[rests], expected[rests], rtol=1e-6)
    load = 5 * np.sign(expected) * (0.1 * np.abs(expected) - 0.02)
    for found, right in (
        (torque, load), (slopes[:, 1, 0], -expected / 0.3), (slopes[:, 2, 1], 5 * expected),
    ):  # fmt: skip
        assert_allclose(found[clamped], right[clamped], rtol=1e-6)
    assert not slopes[rests, 0].any()
    ends = [np.asarray(both(at + np.array([d, 0.0]))[1]) for d in (1e-6, -1e-6)]
    assert_allclose(slopes[..., 0], (ends[0] - ends[1]) / 2e-6, rtol=1e-4, atol=1e-3)
    assert not read_runs({**log, "held": 0 * held}, robot=robot).has("held")


def test_a_log_of_a_locked_rotor_shows_its_inductance(tmp_path):
    """Rows closer than the rise of the current are a history: i = u / R (1 - exp(-t R / L))."""
    robot = params.replace(rig(tmp_path, "voltage", '"motor_current"'), {"motor.inductance": 3e-3})
    time = 1e-3 * np.arange(30)
    log = {"time_s": time, "supply_voltage_V": np.full(30, 3.0), "motor_current_A": np.ones(30), "held": np.ones(30)}
    runs = read_runs(log, robot=robot)
    assert runs.sampled
    observe = Histories.of(runs, robot)
    current = jax.jit(lambda robot: observe(robot).reading[:, 0])(robot)
    assert_allclose(current, 10 * -np.expm1(-time * 0.3 / 3e-3), atol=1e-3)


def test_a_clamp_in_a_log_of_an_elastic_joint_is_refused(tmp_path):
    text = RIG_HELD.format(imposed="voltage", channels='"motor_current"') + 'stiffness = "50 ± 5"\n'
    robot = read_rig(tmp_path, text.replace("[gearbox]", "inertia = 4e-4\n[gearbox]"))
    log = {"time_s": 1e-3 * np.arange(9), "supply_voltage_V": np.ones(9), "motor_current_A": np.ones(9)}
    runs = read_runs({**log, "held": np.r_[np.zeros(4), np.ones(5)]}, robot=robot)
    with pytest.raises(BadConfiguration, match="a clamp on a load with backlash or an elastic joint"):
        Histories.of(runs, robot)
