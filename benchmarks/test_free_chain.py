"""The free chain of 168 masses (benchmarks/free_chain.py) sees the belt as the track model does."""

import free_chain
import numpy as np
import pytest

from mmrjax.undercarriage.running_gear import RunningGear

pytestmark = pytest.mark.slow  # compiles for a minute

DURATION = 0.3  # [s], of which 5 grouser periods are averaged


@pytest.fixture(scope="module")
def found():
    return free_chain.measure(RunningGear(), duration=DURATION)


@pytest.mark.nightly
def test_belt_stays_on_its_path(found):
    assert found["finite"]
    assert found["off_path_mm"] < 0.3  # a tooth is 5 mm; tension and contacts give 0.1 mm


@pytest.mark.nightly
def test_weight_is_carried_and_divides_between_guide_and_pulleys(found):
    assert found["carried_over_weight"] == pytest.approx(1.0, abs=2e-3)
    # what is missing is the weight of the belt itself, 0.6 %
    assert found["guide_share"] + found["pulley_share"] == pytest.approx(1.0, abs=0.01)


@pytest.mark.nightly
def test_guides_carry_what_the_track_model_says(found):
    assert found["guide_share"] == pytest.approx(0.98, abs=0.02)


@pytest.mark.nightly
def test_reaction_repeats_with_the_grouser_pitch(found):
    assert found["ripple_period_s"] == pytest.approx(found["period_34_s"], rel=0.02)
    assert 0.05 < found["ripple_amplitude"] < 0.5


@pytest.mark.nightly
def test_robot_runs_at_the_belt_s_speed_less_the_creep(found):
    belt = 0.84 / 168 * 48 / (2 * np.pi) * free_chain.SPEED
    assert found["speed_m_s"] == pytest.approx(belt - 2.5e-3, abs=2e-3)


def test_too_short_a_run_says_so():
    with pytest.raises(ValueError, match="expected 2 or more"):
        free_chain.measure(RunningGear(), duration=0.05)
