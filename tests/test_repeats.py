"""Noise as repeats in a table show it."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from calibration.data import robot_file
from calibration.data.runs import Runs
from calibration.data.table import Layout
from calibration.discovery import result_remarks
from calibration.inference import noise
from calibration.inference.fit_notes import remarks_with_codes
from calibration.inference.observers import SettledRuns
from calibration.inference.preparation import prepare_input
from tests.commands import with_columns


def table(sd, times=4, seed=0):
    """Runs at three voltages, each repeated, whose currents scatter with this sd [A]."""
    volt = np.repeat([12.0, 20.0, 30.0], times)
    random = np.random.default_rng(seed)
    columns = {
        "configuration": np.array(["4W2T"] * len(volt)),
        "supply_voltage_V": volt,
        "payload_kg": np.zeros(len(volt)),
        "slope_deg": np.zeros(len(volt)),
        "total_current_A": 1.0 + 0.02 * volt + sd * random.standard_normal(len(volt)),
        "motor_speed_rpm": 350 * volt * (1 + 0.004 * random.standard_normal(len(volt))),
    }
    return Runs("made", columns, layout=Layout())


def enlarged(runs, stated):
    known = noise.noise_from_table(runs, SettledRuns.sizes(runs), stated)
    return known, *noise.enlarge_noise(known, runs)


def test_noise_that_repeats_contradict_is_enlarged():
    known, larger, notes = enlarged(table(0.2), "current=0.02A,motor_speed=0.5%")
    (note,) = notes
    assert note.channel == "total_current" and 6 < note.factor < 16 and note.pairs == 9
    assert_allclose(larger.sd[:, 0], note.factor * known.sd[:, 0])
    assert_array_equal(larger.sd[:, 1], known.sd[:, 1])


def test_noise_as_stated_is_rarely_enlarged():
    found = [enlarged(table(0.02, seed=k), "current=0.02A,motor_speed=0.5%")[2] for k in range(300)]
    assert sum(map(bool, found)) <= 3


def test_one_wrong_reading_does_not_enlarge_the_noise():
    runs = table(0.02)
    current = runs["total_current_A"].copy()
    current[5] += 2.0
    wrong = with_columns(runs, total_current_A=current)
    assert enlarged(wrong, "current=0.02A,motor_speed=0.5%")[2] == []
    assert enlarged(table(0.2, times=1), "current=0.02A,motor_speed=0.5%")[2] == []


@pytest.mark.parametrize("count", [3, 4, 9])
def test_the_probability_of_a_median_is_right(count):
    magnitudes = np.abs(np.random.default_rng(0).standard_normal((40_000, count)))
    # Of an even number the larger of the two in the middle is below half of them.
    share = np.mean(np.sort(magnitudes, 1)[:, count // 2] > 1.2)
    least = noise._median_tail(1.2, count)
    assert least >= share - 0.01 and (count % 2 == 0 or least == pytest.approx(share, abs=0.01))


def test_every_command_takes_the_larger_noise():
    runs = table(0.2)
    ready = prepare_input(runs, robot_file.load_robot("nominal"), "current=0.02A,motor_speed=0.5%")
    assert remarks_with_codes(ready.table_remarks[:1], "larger_noise")
    assert ready.noise.sd[0, 0] > 0.1


@pytest.mark.parametrize(
    "levels, here, beside",
    [
        ([-0.40216, -0.40214, -0.2, 0.3], -0.40216, (-0.5, -0.3)),  # the same level as measured is no neighbour
        ([12.0, 18.0, 24.0], 18.0, (15.0, 21.0)),
        ([3.0, 3.0], 3.0, ()),
    ],
)
def test_runs_beside_a_row_are_at_levels_that_a_person_sets(levels, here, beside):
    assert result_remarks.neighbouring_levels(np.array(levels), here) == pytest.approx(beside)
