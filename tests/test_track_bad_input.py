"""What the track model says to input that it cannot run, before and after the run."""

import contextlib

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration.data.input_errors import BadConfiguration
from mmrjax.fidelities.track import _simulate_batch, track_batch
from mmrjax.model import params
from mmrjax.model.conditions import Conditions
from mmrjax.model.signals import CONVERGED, FAILED, FLAGS, TIPS
from mmrjax.undercarriage import modes
from mmrjax.undercarriage.half_robot import build_system, instant, stand, tipping_margin
from mmrjax.undercarriage.modes import _step_that_divides, largest_step
from sweeps import config as configuration
from sweeps.points import run
from sweeps.points.grid import grid_conditions
from tests.commands import refused

TWO = Conditions(voltage=[33.0, 33.0], payload=[0.0, 8.0], configuration=[0.0, 1.0])


def test_refusal_names_the_first_run_that_a_step_is_too_large_for_and_one_to_take(robot, monkeypatch):
    """With limits as if they had been found: how they are is another test's."""
    monkeypatch.setattr(modes, "largest_step", lambda robot, conditions: np.array([9e-4, 6.5e-4]))
    with pytest.raises(
        ValueError, match=r"step: got 0.001 s; .*largest stable step is 0\.00065 s \(run 2 of 2\); take 0.0005 s,"
    ):
        modes.check_track_step(robot, TWO, 1e-3, 1e-3)
    modes.check_track_step(robot, TWO, 5e-4, 1e-3)


@pytest.mark.slow
def test_largest_step_falls_with_stiffness(robot):
    stiff = params.replace(robot, {"running_gear.contact_stiffness": 1e6 * robot.running_gear.contact_stiffness})
    soft = largest_step(robot, TWO)
    hard = largest_step(stiff, TWO)
    assert (hard < 0.95 * soft).all()


@pytest.mark.slow
def test_beyond_the_largest_step_a_run_goes_wrong_and_below_it_does_not(robot):
    """On tracks whose contacts are a thousand times as stiff: beyond twice the limit there are no numbers."""
    stiff = params.replace(robot, {"running_gear.contact_stiffness": 3e10})
    limit = float(largest_step(stiff, TWO)[0])
    assert 2e-4 < limit < 3e-4
    below, beyond = (_simulate_batch(stiff, TWO, 0.3, step, 1e-3, True).result for step in (1e-4, 5e-4))
    assert int(below.status[0]) != FAILED and int(beyond.status[0]) == FAILED


@pytest.mark.slow
@pytest.mark.parametrize("speed_static", [0.005, 0.001])
def test_small_v_s_is_neither_refused_nor_wrong(robot, speed_static):
    """At the standard step, against a tenth of it, to 0.05 points of slip."""
    small = params.replace(robot, {"6T2A.ground.friction.speed_static": jnp.asarray(speed_static)})
    runs = Conditions(voltage=[15.0, 33.0], slope_deg=[5.0, 10.0])
    assert largest_step(small, runs).min() > 1e-4
    slip = [np.asarray(_simulate_batch(small, runs, 0.5, step, 1e-3, True).result.slip) for step in (1e-4, 1e-5)]
    assert_allclose(slip[0], slip[1], atol=5e-4)


@pytest.mark.parametrize("limit", [2.6e-4, 1.0999e-4, 1e-4, 3.7e-6, 0.5])
def test_step_that_is_proposed_can_be_typed_in(limit):
    """It is not above the limit, divides the sample, and survives being printed, and it is not far below."""
    proposed = _step_that_divides(1e-3, limit)
    typed = float(f"{proposed:g}")
    assert 0.5 * min(limit, 1e-3) < typed <= limit * (1 + 1e-12)
    assert 1e-3 / typed == pytest.approx(round(1e-3 / typed), abs=1e-6)


def test_times_that_do_not_fit_are_refused(robot):
    with pytest.raises(ValueError, match=r"step: got 0.0001 s; expected the sample time, 0.00015 s, divided by"):
        track_batch(robot, TWO, sample=1.5e-4)
    with pytest.raises(ValueError, match=r"duration: got 0 s; expected a whole number of samples of 0.001 s"):
        track_batch(robot, TWO, duration=0.0)


def test_posture_that_cannot_stand_has_a_negative_margin(robot):
    place = {"running_gear.payload_offset": jnp.asarray(-0.45), "running_gear.payload_height": jnp.asarray(0.4)}
    loaded = params.replace(robot, place)
    for payload, stands in ((0.0, True), (8.0, False)):
        run = Conditions(slope_deg=20.0, payload=payload)
        assert (tipping_margin(build_system(loaded, run, 1e-4)) > 0) == stands


def test_standing_robot_is_in_balance(robot):
    """Weight and moment to 1e-9, on a slope with a payload off centre. Then no force is left over."""
    for wheeled, recess in ((0.0, 0.0), (0.0, 3e-3), (1.0, 0.0)):  # with a recess some grousers bear alone
        loaded = params.replace(robot, {"running_gear.payload_offset": 0.05, "running_gear.guide_recess": recess})
        run = build_system(loaded, Conditions(slope_deg=np.degrees(0.1), payload=5.0, configuration=wheeled), 1e-4)
        _, at, _ = instant(run, stand(run))
        weight = (run.half.chassis + 2 * run.half.pulley) * 9.80665 * np.cos(0.1)
        assert at.normal == pytest.approx(float(weight), rel=1e-9)


#: Set S of docs/explanation/vibration.md.
SHAKING = {
    "6T2A.ground.friction.static": 0.6093, "6T2A.ground.friction.dynamic": 0.5331,
    "6T2A.ground.friction.speed_static": 0.00961, "6T2A.ground.friction.speed_dynamic": 0.0961,
    "6T2A.track.guide_friction": 0.06, "running_gear.guide_recess": 3.648e-4, "running_gear.guide_gap": 0.01066,
    "running_gear.contact_stiffness": 3.816e7, "running_gear.contact_damping": 649.2,
    "running_gear.centre_offset": 0.00011, "running_gear.payload_height": 0.0595,
}  # fmt: skip


@pytest.mark.slow
def test_gear_that_throws_the_robot_off_the_ground_is_flagged(robot):
    """Set S at 33 V on 15 deg leaves the ground for a twentieth of the time. At 15 V it shakes and stays on it."""
    runs = Conditions(voltage=[15.0, 33.0], slope_deg=[10.0, 15.0], payload=[0.0, 8.0])
    answer = _simulate_batch(params.replace(robot, SHAKING), runs, 0.6, 1e-4, 1e-3, True)
    jumps = np.asarray(answer.result.flags) >> FLAGS.index("jumps") & 1
    assert jumps.tolist() == [0, 1]
    window = np.asarray(answer.signals.normal)[:, -240:]
    assert (window[0] > 0.01 * window[0].mean()).all()
    assert np.mean(window[1] < 0.01 * window[1].mean()) > 0.01


@pytest.mark.slow
def test_robot_thrown_over_by_its_own_motion_tips_and_harms_no_other(robot):
    """A payload 0.66 m up: gravity alone would not turn it over on 20 deg, its start does. At 15 V it climbs."""
    high = {
        "running_gear.payload_height": 0.66,
        "6T2A.ground.friction.static": 1.2,
        "6T2A.ground.friction.dynamic": 1.1,
    }
    tall = params.replace(robot, high)
    runs = Conditions(voltage=[33.0, 15.0], slope_deg=[20.0, 0.0], payload=[8.0, 0.0])
    assert tipping_margin(build_system(tall, Conditions(voltage=33.0, slope_deg=20.0, payload=8.0), 1e-4)) > 0
    answer = _simulate_batch(tall, runs, 1.0, 1e-4, 1e-3, False).result
    assert answer.status.tolist() == [TIPS, CONVERGED]
    assert np.isnan(float(answer.reading["speed"][0])) and np.isfinite(float(answer.reading["speed"][1]))


@pytest.mark.slow
def test_step_that_a_later_chunk_cannot_bear_is_refused_before_the_first(robot, monkeypatch):
    options = {"model": "track", "step_s": 5e-4, "chunk": 2, "slopes_deg": (0.0,), "configurations": ("4W2T", "6T2A")}
    config = configuration.resolve_configuration(configuration.Sweep, None, options)
    robot = params.replace(robot, {"running_gear.contact_stiffness": 5e9})
    runs, told = grid_conditions(config, robot), []
    limits = largest_step(robot, run.conditions_of_runs(robot, runs, config))
    worst = int(np.argmin(limits))
    assert limits[:2].min() > config.step_s > limits[worst]  # the first chunk could bear it
    monkeypatch.setattr(run, "progress_bar", lambda *_, **__: contextlib.nullcontext(told.append))
    with refused(rf"run {worst + 1} of {len(runs)}", BadConfiguration):
        run.evaluate_runs(robot, runs, config, None)
    assert told == []
