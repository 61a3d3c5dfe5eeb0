"""Regression of a log's equations in weak form, on logs from plain NumPy laws. No window holds a jump."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest
from test_log_kinds import carriage, servo, written
from test_regression_verdicts import EVERY, SD, motor_log
from worlds import logs

from calibration.data import robot_file
from calibration.data import runs as records
from calibration.data.runs import Runs
from calibration.discovery import discover, findings, loop_input, search, stages
from calibration.discovery.settings import settings_for
from calibration.inference import shown_states, weak_form
from calibration.inference.observers import Histories
from mmrjax.effects import BY_NAME, signal_effects
from tests.commands import csv_text, motor_on_bench, read_rig, read_table

TRUE = {"resistance": 0.9, "torque_constant": 0.042, "inertia": 2.4e-4}
RIG = motor_on_bench("0.043 ± 10 %", "0.8 ± 20 %")
NAMES = ("churning", "stribeck_track", "torque_constant_saturation", "series_resistance", "directional_friction")
SETTINGS = settings_for(Histories, 250)


def motor(seed=0, noise=(1.0, 1.0), quadratic=4e-8):
    """Four runs under a staircase of voltage, of a motor that churns."""
    rng = np.random.default_rng(seed)
    volts = np.repeat(rng.uniform(6.0, 24.0, (4, 3)) * np.array([[1.0], [1.0], [-1.0], [-1.0]]), 50, 1)
    return motor_log(
        volts, lambda n, w: 0.02 * np.tanh(w / 0.05) + (3e-5 + quadratic * abs(w)) * w, rng, np.multiply(noise, SD)
    )


@pytest.fixture(scope="module")
def space(tmp_path_factory):
    """What can be fitted to the log of a motor that churns."""
    file = tmp_path_factory.mktemp("motor") / "rig.toml"
    file.write_text(RIG, encoding="utf-8")
    return posed(Runs("synthetic", motor()).of(robot_file.read_robot(file)), robot_file.read_robot(file))


def posed(runs, robot, sd=SD, library=None):
    library = library or {n: BY_NAME[n] for n in NAMES}
    return loop_input.build_candidate_space(
        runs, robot, np.broadcast_to(sd, runs.measured().shape), SETTINGS, {}, library
    )


@pytest.fixture(scope="module")
def before(space):
    return search.screen_by_weak_form(space)


def test_a_window_integrates_by_parts():
    time = np.linspace(0.0, 0.3, 31)
    w, slope, bend = shown_states.window_function(time / 0.3, 0.3)
    x, rate, second = np.sin(9 * time), 9 * np.cos(9 * time), -81 * np.sin(9 * time)
    assert w @ rate == pytest.approx(-slope @ x, rel=1e-5)
    assert w @ second == pytest.approx(bend @ x, rel=1e-4)


def test_windows_end_before_what_they_may_not_hold():
    time = np.arange(40) * 0.01
    piece = np.where(np.arange(40) < 25, 0, 1)
    piece[12] = -1
    found = [set(rows) for rows, _ in shown_states.windows_of_run(time, piece, 0.1)]
    assert any(max(rows) < 12 for rows in found) and any(min(rows) >= 25 for rows in found)
    assert not any(12 in rows or {24, 25} <= rows for rows in found)


def test_base_parameters_are_those_of_the_log(space, before):
    value = space.coordinates.base.value(before.base.z[: space.free])
    names = space.coordinates.base.names
    for name, true in TRUE.items():
        assert value[names.index(f"motor.{name}")] == pytest.approx(true, rel=0.01)
    assert not before.base.simulated


def test_the_effect_of_the_log_is_ranked_first_and_not_by_chance(space, before):
    found = findings.rank_effects_by_weak_form(space, before)
    assert found.missing and found.windows == before.windows > 0
    assert "churning" in [e.name for e in found.effects[:2]]
    assert found.effects[0].score > found.chance


def test_the_ranking_comes_before_the_base_fit_which_begins_there(space, before, monkeypatch):
    begun, kept = [], []

    def fit_base(space, where, near=None):
        begun.append(near)
        raise InterruptedError

    def keep(name, make):
        found = make()
        kept.append(name)
        return found

    monkeypatch.setattr(stages.candidates, "fit_base", fit_base)
    runs, library = Runs("synthetic", motor()).of(space.bare.base), {n: BY_NAME[n] for n in NAMES}
    noise = SimpleNamespace(sd=np.broadcast_to(SD, runs.measured().shape))
    with pytest.raises(InterruptedError):
        discover.trace_verdict(
            loop_input.LoopInput(runs, None, space.bare.base, noise, {}, SETTINGS, library, keep=keep)
        )
    assert kept == ["ranking"]
    assert not begun[0].simulated and begun[0].z == pytest.approx(before.base.z)


def test_noise_of_windows_is_that_of_their_readings(space, before):
    """Without an effect that the base lacks what is left is a χ² of the windows."""
    quiet = Runs("synthetic", motor(seed=5, quadratic=0.0)).of(space.bare.base)
    found = weak_form.fit_weak_form(posed(quiet, space.bare.base).bare)
    chi2 = np.sum(found.residual**2)
    assert abs(chi2 - len(found.signatures)) < 4 * np.sqrt(2 * len(found.signatures))


def test_noise_that_windows_and_equations_share_is_correlated(space, before):
    """As in a Monte Carlo of the motor's two equations, in NumPy, with noise in both readings."""
    problem, plan = space.bare, shown_states.state_plan(space.bare)
    rows, _, (w, *_) = shown_states.points_and_windows(problem, plan)
    w, z, sd = w.part(np.arange(12)), before.base.z[: space.free], np.asarray(rows.sd)
    terms = weak_form._terms_with_derivatives(problem, plan, rows, z, ())
    factor = weak_form.covariance_factor(plan, w, sd, jax.device_get(terms), np.zeros(2))
    value = dict(zip(problem.coordinates.names, np.asarray(problem.coordinates.value(z)), strict=True))
    r, k, inertia = (float(value[f"motor.{name}"]) for name in TRUE)
    noise = sd * np.random.default_rng(0).standard_normal((20_000, *sd.shape))
    names = [channel.name for channel in problem.channels]
    current, speed = (noise[:, w.rows, names.index(f"motor_{name}")] for name in ("current", "speed"))
    electrical = np.sum(w.weight * (-k * speed - r * current) + w.slope * 4e-4 * current, -1)
    mechanical = np.sum(w.weight * (k * current - 3e-5 * speed) + w.slope * inertia * speed, -1)
    drawn = np.corrcoef(np.concatenate([electrical, mechanical], 1).T)
    covariance = factor @ factor.T
    size = np.sqrt(np.diag(covariance) / (1 + weak_form.FLOOR))
    off = ~np.eye(24, dtype=bool)
    assert np.max(np.abs(covariance / np.outer(size, size) - drawn)[off]) < 0.04
    assert np.max(np.abs(drawn[:12, 12:])) > 0.3 and np.max(np.abs(drawn[12:, 12:][off[12:, 12:]])) > 0.3


@pytest.mark.parametrize("rows", [12, -7])
def test_a_delay_of_many_rows_is_found(space, rows):
    """Also one of readings that a log holds earlier than the voltage that drives them."""
    columns = motor(seed=2, quadratic=0.0)
    late = {"motor_speed_rpm", "motor_current_A"}
    shape, first = (4, 150), slice(max(rows, 0), 150 + min(rows, 0))
    shifted = {
        name: (np.roll(x.reshape(shape), rows, 1) if name in late else x.reshape(shape))[:, first].ravel()
        for name, x in columns.items()
    }
    delayed = posed(Runs("synthetic", shifted).of(space.bare.base), space.bare.base).bare
    plan = shown_states.state_plan(delayed)
    assert weak_form.fit_delay(delayed, plan) == pytest.approx(rows * EVERY, abs=EVERY)
    found = weak_form.fit_weak_form(delayed)
    value = delayed.coordinates.value(found.z)
    for name, true in TRUE.items():
        assert value[delayed.coordinates.names.index(f"motor.{name}")] == pytest.approx(true, rel=0.02)


def test_noise_of_simulated_states_is_not_that_of_readings(space):
    """So it does not bias parameters."""
    noisy, quiet = (posed(Runs("synthetic", motor(seed=4, noise=n, quadratic=0.0)).of(space.bare.base),
                          space.bare.base).bare for n in ((1.0, 1.0), (1e-6, 1e-6)))  # fmt: skip
    plan = shown_states.state_plan(noisy)
    z = weak_form.fit_weak_form(noisy).z
    rows, exact = (shown_states.points_and_windows(p, plan)[0] for p in (noisy, quiet))
    smooth = weak_form.with_smooth_states(noisy, plan, rows, z)
    moving = np.asarray(rows.way) != 0
    off, read = ((np.asarray(x.readings) - np.asarray(exact.readings))[moving] for x in (smooth, rows))
    for k in range(off.shape[1]):
        assert abs(np.corrcoef(off[:, k], read[:, k])[0, 1]) < 0.1
    assert np.all(np.std(off, axis=0) < 0.05 * np.std(exact.readings, axis=0))


def test_windows_hold_no_jump_and_readings_show_the_current_before_one(space, before, monkeypatch):
    names, plan = space.bare.coordinates.names, shown_states.state_plan(space.bare)
    rows, _, cut = shown_states.points_and_windows(space.bare, plan)
    volts = np.asarray(rows.conditions.voltage)
    for w in cut:
        assert np.max(np.ptp(np.where(w.weight > 0, volts[w.rows], volts[w.rows[:, 4:5]]), axis=1)) < 1e-9
    monkeypatch.setattr(shown_states, "JUMP", 9.0)
    monkeypatch.setattr(weak_form, "CHANCE", np.inf)  # else they count less, as noise that no reading has
    across, k = weak_form.fit_weak_form(space.bare).z, names.index("motor.inductance")
    for z in (before.base.z, across):  # across jumps it was more than three times as large without `_current_lead`
        assert space.coordinates.base.value(z[: space.free])[k] == pytest.approx(4e-4, rel=0.3)


@pytest.mark.parametrize("imposed, channel", [("motor_current", "motor_speed"), ("motor_speed", "motor_current")])
def test_a_current_or_a_speed_may_be_imposed(tmp_path, imposed, channel):
    """Torques alone are shown then: inertia over the torque constant, and the effect where rows follow a speed that
    turns between them. Lines between rows of an imposed one differ from it by more than the effect."""
    text = RIG.replace('imposed = "voltage"', f'imposed = "{imposed}"')
    # Samples of a current that changes between them, half a row earlier than if held.
    text += f'[rig]\ndelay = "{-EVERY / 2 if imposed == "motor_current" else 0.0} ± 0"\n'
    robot = read_rig(tmp_path, text.replace('"motor_current", "motor_speed"', f'"{channel}"'))
    columns = motor(noise=(0.0, 1.0) if imposed == "motor_speed" else (1.0, 0.0))
    del columns["supply_voltage_V"]
    mine = posed(read_table(tmp_path, csv_text(columns), robot).of(robot), robot, SD[int(channel == "motor_current")])
    found = search.screen_by_weak_form(mine)
    names, value = mine.coordinates.base.names, mine.coordinates.base.value(found.base.z[: mine.free])
    ratio = value[names.index("motor.inertia")] / value[names.index("motor.torque_constant")]
    assert ratio == pytest.approx(TRUE["inertia"] / TRUE["torque_constant"], rel=0.03)
    ranked = findings.rank_effects_by_weak_form(mine, found)
    assert imposed == "motor_speed" or "churning" in [e.name for e in ranked.effects[:2]]


@pytest.mark.parametrize("kind, made", [("servo", servo), pytest.param("carriage", carriage, marks=pytest.mark.slow)])
def test_logs_of_an_angle_alone_are_twice_integrated(tmp_path, kind, made):
    made = made(np.random.default_rng(1), levels=(0.8, 1.0, -0.9) if kind == "servo" else (1.2, 2.0, -1.6))
    robot = written(tmp_path, kind, made)
    runs = records.read_runs(str(tmp_path / "log.csv"), robot=robot).of(robot)
    found = weak_form.fit_weak_form(posed(runs, robot, np.maximum(0.003 * Histories.sizes(runs), 1e-9)).bare)
    if kind == "servo":  # whose log has no noise
        assert np.all(np.abs(found.z) < 0.1)
    assert found is not None and np.all(np.abs(found.z) < 4)


@pytest.mark.quick(1)
@pytest.mark.parametrize("imposed, every, seed", [("voltage", 0.005, 714), ("motor_current", 0.005, 739)])
def test_noise_of_an_angle_alone_is_neither_an_inertia_nor_a_gain(tmp_path, imposed, every, seed):
    """Its derivatives contained that noise. Inertias were too small by 3 to 18 posterior sds, and a gain had 2.4 sds, on 25 000 rows 11."""
    case = logs.case(logs.rig(np.random.default_rng([41, 0, seed]), imposed, every, alone=True), "", 0.0, seed)
    case.write(tmp_path)
    robot = robot_file.read_robot(tmp_path / "rig.toml")
    runs, sd = (
        records.read_runs(tmp_path / "table.csv", robot=robot).of(robot),
        case.rig.noise("output_angle") * np.pi / 180,
    )
    space = posed(runs, robot, sd, {"output_angle_gain": signal_effects.OF_CHANNELS["output_angle_gain"]})
    problem = space.bare
    fit, k = weak_form.fit_weak_form(problem, space.library.scored), problem.coordinates.names.index("bench.inertia")
    sds = np.sqrt(np.diag(np.linalg.inv(fit.jacobian.T @ fit.jacobian)))
    low, value, high = (float(problem.coordinates.value(fit.z + x * sds)[k]) for x in (-1, 0, 1))
    assert abs(value - case.label["constants"]["inertia"]) < 2.5 * (high - low) / 2
    base = np.linalg.qr(fit.jacobian)[0]
    signature = np.concatenate([fit.signatures[:, 0], np.zeros(len(fit.z))])
    rest = signature - base @ (base.T @ signature)
    assert abs(rest @ fit.residual) < 1.3 * np.linalg.norm(rest) > 0


def test_a_log_that_does_not_show_its_states_is_none(space):
    assert weak_form.fit_weak_form(without(space.bare, "motor_speed")) is None
    assert shown_states.state_plan(without(space.bare, "motor_current")).electrical is False


def without(problem, channel):
    """The problem without the readings of a channel."""
    weight = np.array(problem.data.weight)
    weight[:, [c.name for c in problem.channels].index(channel)] = 0.0
    return problem.with_data(weight=weight)
