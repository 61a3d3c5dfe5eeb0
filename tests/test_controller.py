"""A controller in the loop: simulation, steps, derivatives, tables of goal and angle, and calibration from them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose
from worlds import servo

import mmrjax as mm
from calibration.data.input_errors import BadConfiguration, BadData
from calibration.data.robot_file import read_robot, write_robot
from calibration.data.runs import read_runs
from calibration.inference import foresight
from calibration.inference.calibration import calibrate
from calibration.inference.observers.time_histories import Histories
from mmrjax.fidelities.drive import drive_batch
from mmrjax.fidelities.histories import history_signals, time_grid
from mmrjax.model import params
from tests.commands import parameter_values, read_rig

SMOOTH = {**servo.TRUE, "coulomb": 0.0, "ki": 50.0}


@pytest.fixture
def actuator(tmp_path):
    """Robot of a file with these values. `lines`: a replacement in its text."""

    def made(values=servo.TRUE, old="", new=""):
        return read_rig(tmp_path, servo.RIG.format(**values).replace(old, new), "servo.toml")

    return made


#: Angle over time. One program serves all robots and goals of the same kinds and numbers of rows.
ANGLE = jax.jit(lambda robot, conditions, grid: history_signals(robot, conditions, grid).angle)


def angles(robot, goal, times, parts=1):
    """Simulated angles of the output [rad] for a goal held from each of its instants."""
    grid = time_grid(times, goal[0], parts=parts)
    held = goal[1][np.searchsorted(goal[0], grid + 1e-9, side="right") - 1]
    conditions = mm.Conditions(voltage=servo.TRUE["supply"], goal=0.0)
    conditions = eqx.tree_at(lambda c: c.goal, conditions, jnp.asarray(held))
    return ANGLE(robot, conditions, jnp.asarray(grid)), np.searchsorted(grid, times)


def held(goal):
    """A goal that is held from the beginning."""
    return np.zeros(1), np.full(1, goal)


def run_of_drive(robot, times, goal, voltage=7.4, **options):
    """Signals of `drive` under a goal that is held."""
    one = jax.tree.map(lambda x: jnp.asarray(x)[None], mm.Conditions(voltage=voltage, goal=goal))
    return drive_batch(robot, one, jnp.asarray(times), **options).signals


def stepped(robot, count, dt, begins=0.5):
    """Angle after so many steps of `step` to a goal of 0.5 rad."""
    conditions = mm.Conditions(voltage=7.4, goal=begins)
    state = mm.initial_state(robot, conditions)
    step = jax.jit(lambda s: mm.step(robot, s, {"goal": 0.5}, dt, conditions))
    for _ in range(count):
        state = step(state)
    return float(state.distance)


STEPS = np.array([0.0, 0.25]), np.array([0.8, -0.3])


@pytest.mark.parametrize("lag", [0.0, 0.005])
def test_a_servo_follows_as_an_own_simulation(actuator, lag):
    times, lagging = np.linspace(0.0, 0.4, 9), f"lag = {lag}\nkp = "
    values = {**servo.TRUE, "coulomb": 0.0} if lag else servo.TRUE
    own = servo.simulate(STEPS, times, {**values, "lag": lag})[0]
    shown, rows = angles(actuator(values, "kp = ", lagging), STEPS, times, parts=8)
    assert_allclose(np.asarray(shown)[rows], own, atol=1e-6)


SAMPLED = "rate = 50\nkp = ", "rate = 50\nsamples_late = 1\nkp = "
PERIOD = 0.02
#: Goals at the samples of a controller.
WAVES = np.arange(0, 0.4, PERIOD), 0.4 * np.sin(8 * np.pi * np.arange(0, 0.4, PERIOD)) ** 2
#: Gains with which a controller of 50 Hz is stable.
SLOWER = {**servo.TRUE, "kp": 2.0, "ki": 3.0}


def test_a_sampled_controller_follows_as_an_own_simulation(actuator):
    times = np.linspace(0.0, 0.4, 17)  # between samples too
    rows = np.searchsorted(time_grid(times, WAVES[0], parts=12), times)
    prompt, late = (
        np.asarray(angles(actuator(SLOWER, "kp = ", text), WAVES, times, parts=12)[0])[rows] for text in SAMPLED
    )
    continuous = servo.simulate(WAVES, times, SLOWER)[0]
    for shown, other, delayed in ((prompt, late, False), (late, prompt, True)):
        assert_allclose(shown, servo.simulate(WAVES, times, SLOWER, period=PERIOD, late=delayed)[0], atol=1e-6)
        assert min(np.abs(x - shown).max() for x in (continuous, other)) > 0.01


def test_runs_of_drive_and_steps_follow_a_sampled_controller(actuator):
    times = np.array([0.0, 0.015, 0.1, 0.13, 0.4])
    values = {**SLOWER, "coulomb": 0.0}
    robot = actuator(values, "kp = ", SAMPLED[True])
    own = servo.simulate(held(0.5), times, values, period=PERIOD, late=True)[0]
    assert_allclose(run_of_drive(robot, times, 0.5, tolerance=1e-9).angle[0], own, atol=1e-6)
    assert stepped(robot, 80, 0.005) == pytest.approx(own[-1], abs=1e-4)
    with pytest.raises(
        mm.UsageError, match=r"dt: got 0\.015; expected a whole part of the controller's period, 0\.02 s"
    ):
        stepped(robot, 1, 0.015)


def test_a_run_of_drive_follows_as_an_own_simulation(actuator):
    times = np.linspace(0.0, 0.5, 11)
    own, states = servo.simulate(held(1.0), times, SMOOTH)
    signals = run_of_drive(actuator(SMOOTH), times, 1.0, tolerance=1e-9, max_steps=20_000)
    assert_allclose(signals.angle[0], own, atol=1e-6)
    assert 50 * np.abs(states[:, 3]).max() > 0.1, "the integral acts"


@pytest.mark.parametrize("rate", [0, 50])
def test_derivatives_of_a_controlled_run_are_finite_differences(actuator, rate):
    names = ("controller.kp", "controller.kd", "controller.limit", "motor.torque_constant")
    robot, times = actuator(), np.linspace(0.0, 0.4, 9)
    onward = STEPS[0], np.array([0.8, 1.2])  # a reversal within a step has an error of its own
    if rate:
        values = {**SLOWER, "coulomb": 0.0}  # the moment at which friction yields is one of a step
        robot, onward = actuator(values, "kp = ", SAMPLED[True]), (WAVES[0], 0.8 + WAVES[0])
    value = parameter_values(robot)
    at = jnp.array([value[name] for name in names])

    @jax.jit
    def shown(x):
        angle, rows = angles(params.replace(robot, dict(zip(names, x, strict=True))), onward, times)
        return angle[rows]

    slopes = jax.jacfwd(shown)(at).T
    for step, slope, size in zip(1e-4 * jnp.diag(at), slopes, at, strict=True):
        differences = (shown(at + step) - shown(at - step)) / (2e-4 * size)
        assert np.abs(differences).max() > 1e-3 / size
        assert_allclose(slope, differences, atol=1e-6 * np.abs(differences).max())


@pytest.mark.parametrize("goal, value, gains, signal", [
    ("goal_speed", 3.0, {"kp": 0.5, "ki": 5.0, "kd": 0.0}, "speed_output"),
    ("goal_current", 0.4, {"kp": 1.0, "ki": 5e3, "kd": 0.0}, "current"),
])  # fmt: skip
def test_an_integral_brings_speed_and_current_to_their_goals(actuator, goal, value, gains, signal):
    robot = actuator({**servo.TRUE, **gains}, "goal_angle", goal)
    signals = run_of_drive(robot, [0.0, 0.1, 1.0], value, voltage=24.0)
    row = 1 if signal == "current" else 2  # a shaft without a load soon turns too fast for its current
    assert_allclose(getattr(signals, signal)[0, row], value, rtol=5e-3)


def test_a_motor_that_is_off_coasts(actuator):
    log = {"time_s": np.arange(4) * 0.1, "goal_angle_deg": [0.0, 30, 30, 30], "output_angle_deg": [0.0, 0, 5, 20],
           "mode": ["voltage", "voltage", "coast", "voltage"]}  # fmt: skip
    robot = actuator()
    held = read_runs(log, robot).conditions(robot)
    assert_allclose(held.goal, np.radians(log["goal_angle_deg"]))
    assert_allclose(held.open, [0, 0, 1, 0])
    assert_allclose(held.voltage, 7.4)


def test_a_current_limit_holds_the_motor_of_a_controller_and_coasting_releases_it(actuator):
    """A start at the limited torque, and one without any."""
    robot = actuator(old="[motor]", new="[driver]\ncurrent_limit = 0.3\n[motor]")
    each = mm.Conditions(voltage=7.4, goal=np.ones(2), open=np.array([0.0, 1.0]))
    run = drive_batch(robot, each, jnp.asarray([0.0, 0.01, 0.02]))
    v, currents = servo.TRUE, np.asarray(run.signals.current)
    assert_allclose(currents[0, 1:], 0.3, rtol=5e-3)  # the limit is a steep slope of the voltage
    rate = (v["ratio"] * v["constant"] * 0.3 - v["coulomb"]) / (v["load"] + v["ratio"] ** 2 * v["rotor"])
    assert_allclose(run.signals.angle[0, 2], rate * 0.02**2 / 2, rtol=0.05)
    assert_allclose([currents[1], run.signals.angle[1]], 0.0, atol=1e-12)


def test_a_table_states_the_supply_where_the_file_does_not(actuator):
    robot = actuator(old="supply_voltage = 7.4\n")
    log = {"time_s": [0.0, 0.1], "goal_angle_rad": [0.0, 1.0], "output_angle_deg": [0.0, 1.0]}
    with pytest.raises(BadData, match="supply_voltage_V is missing"):
        read_runs(log, robot)
    held = read_runs({**log, "supply_voltage_V": [7.0, 6.5]}, robot).conditions(robot)
    assert_allclose(held.voltage, [7.0, 6.5])
    assert_allclose(held.goal, [0.0, 1.0])


def test_a_robot_file_keeps_its_controller(actuator, tmp_path):
    robot = actuator(old="kp = 8.0", new='kp = "8.0 ± 10 %"')
    write_robot(robot, tmp_path / "again.toml")
    again = read_robot(tmp_path / "again.toml")
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(a == b), again.controller, robot.controller))
    assert again.rig.priors == robot.rig.priors == (("controller.kp", 8.0, pytest.approx(0.8)),)


REFUSED = {
    "no gain": ("kp = 8.0\n", "", r"controller\.kp"),
    "no goal": (
        'imposed = "goal_angle"\n',
        "",
        r"controller: cannot be combined with imposed = .voltage.*goal_angle",
    ),
    "no such gain": ("kd = 0.1", "kq = 0.1", r"controller\.kq: no such parameter.*controller\.k"),
    "a lag of a held duty": ("kp = ", "rate = 50\nlag = 0.01\nkp = ", r"controller\.lag: got 0\.01 s with rate = 50"),
    "half a sample": (
        "kp = ",
        "rate = 50\nsamples_late = 0.5\nkp = ",
        r"controller\.samples_late: got 0\.5 with rate = 50; expected 0, or with a rate 1",
    ),
    "a limit beyond the supply": ("limit = 0.9", "limit = 1.5", r"controller\.limit: got 1\.5; expected 0\.01 to 1"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_controller_that_cannot_be_is_refused(actuator, case):
    old, new, says = REFUSED[case]
    with pytest.raises(BadConfiguration, match=says):
        actuator(old=old, new=new)


def test_a_goal_and_a_controller_need_each_other(actuator, robot):
    with pytest.raises(mm.UsageError, match="goal: not stated"):
        mm.simulate(actuator(), mm.Conditions(voltage=7.4), model="drive")
    with pytest.raises(mm.UsageError, match="the robot has no controller"):
        mm.simulate(robot, mm.Conditions(goal=1.0))
    with pytest.raises(mm.UsageError, match="a controller needs model='drive'"):
        mm.simulate(actuator(), mm.Conditions(voltage=7.4, goal=1.0))


#: An encoder of 12 bits [rad].
BIT = 2 * np.pi / 4096


def servo_log(goal, seed=1, every=0.01, values=servo.TRUE, **sampled):
    """Goal and angle of 12 bits, and the states."""
    rng = default_rng(seed)
    times, goal = np.arange(len(goal)) * every, np.round(goal / BIT) * BIT
    angle, states = servo.simulate((times, goal), times, values, 1e-8, **sampled)
    shown = np.round((angle + rng.normal(0, 0.5 * BIT, len(times))) / BIT) * BIT
    return {"time_s": times, "goal_angle_deg": np.degrees(goal), "output_angle_deg": np.degrees(shown)}, states


def over_noise(robot, log):
    """Rms error of the angle over that of the noise and the bits."""
    runs = read_runs(log, robot)
    off = np.asarray(Histories.of(runs, robot)(robot).reading)[:, 0] - np.radians(log["output_angle_deg"])
    return np.sqrt(np.mean(off**2) / (0.5**2 + 1 / 12)) / BIT


def text_with(changes):
    """The servo's file with these replacements, and the quantum of its angle."""
    text = servo.RIG.format(**servo.TRUE)
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    return f"{text}[instruments.output_angle]\nquantum = {np.degrees(BIT)}\n"


def fitted(tmp_path, text, log):
    robot = read_rig(tmp_path, text)
    return calibrate(read_runs(log, robot), robot, starts=2, profiles=False, blocks=False)


@pytest.mark.slow
def test_the_missing_column_that_separates_a_gain_is_named_and_does(tmp_path):
    wide = {"kp = 8.0": 'kp = "7.0 ± 100 %"', "torque_constant = 0.006": 'torque_constant = "0.0065 ± 100 %"'}
    slow = np.arange(0, 2.5, 0.01)
    log, states = servo_log(0.3 * np.sin(np.pi * slow) * np.minimum(slow, 1))
    off = np.radians(log["goal_angle_deg"]) - states[:, 2]
    log["motor_voltage_V"] = 7.4 * np.clip(8.0 * off - 0.1 * states[:, 1], -0.9, 0.9)
    pair = {"controller.kp", "motor.torque_constant"}

    def foreseen(**channels):
        robot = read_rig(tmp_path, text_with(wide | channels).partition("[instruments")[0])
        return foresight.predict_identifiability(read_runs(log, robot), robot)

    alone = foreseen()
    by_pair = {frozenset(each[:2]): names for each, names in zip(alone.alike, alone.separating, strict=True)}
    assert "motor_voltage_V" in by_pair[frozenset(pair)]
    both = foreseen(**{'["output_angle"]': '["output_angle", "motor_voltage"]'})
    assert pair not in [{*each[:2]} for each in both.alike]


#: Prior of a hobby servo of which little is known; true values are in `servo.TRUE`.
PRIOR = {
    "kp = 8.0": 'kp = "7.0 ± 30 %"', "kd = 0.1": 'kd = "0.08 ± 50 %"', "inertia = 0.0005": 'inertia = "0.0006 ± 30 %"',
    "torque_constant = 0.006": 'torque_constant = "0.0065 ± 20 %"', "loss_coulomb = 0.02": 'loss_coulomb = "0.03 ± 50 %"',
    "loss_viscous = 0.005": 'loss_viscous = "0.004 ± 50 %"', "resistance = 4.0": 'resistance = "4.0 ± 0"',
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("late", [False, True])
def test_a_log_at_the_rate_of_its_controller_gives_the_gain(tmp_path, late):
    """A continuous controller with a lag left 5 times the noise and a gain off by 39 %."""
    slower = {**servo.TRUE, "kp": 2.5, "kd": 0.05}
    prior = PRIOR | {"kp = 8.0": 'kp = "3.0 ± 30 %"', "kd = 0.1": 'kd = "0.04 ± 50 %"'}
    t = np.arange(0, 6, PERIOD)
    goal = np.where(t < 3, 0.8 * (-1.0) ** (t // 0.75), np.sin(5 * t) * np.minimum(t - 3, 1))
    log = servo_log(goal, every=PERIOD, values=slower, period=PERIOD, late=late)[0]
    found = fitted(tmp_path, text_with(prior).replace("kp = ", SAMPLED[late]), log)
    kp = found.parameters["controller.kp"]
    assert abs(kp.value - slower["kp"]) < 2 * kp.sd < 0.2
    assert over_noise(found.robot, log) < 1.2
