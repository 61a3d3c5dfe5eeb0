"""Noise that nobody states: estimates along series against the noise that tables were made with."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from calibration.data.inferred_facts import display_step
from calibration.data.runs import Runs
from calibration.data.table import Layout
from calibration.data.unused_readings import thin_rows
from calibration.discovery.score_tests import UNSURE, _noise_factors
from calibration.inference import noise, series_noise
from calibration.inference.observers import SettledRuns
from calibration.inference.observers.time_histories import Histories
from mmrjax.model import channels, quantities
from tests.commands import with_columns

SLOPES = np.arange(0.0, 21.0, 5.0)


def table(sd, share=False, slopes=SLOPES, seed=0, payloads=(0.0, 8.0), volts=(15.0, 33.0)):
    """A table whose readings bend gently over the slope, of 0.5 to 6 A, with noise of this sd."""
    volt, payload, slope = (x.ravel() for x in np.meshgrid(volts, payloads, slopes, indexing="ij"))
    random = np.random.default_rng(seed)
    clean = 0.5 + 0.1 * payload + 0.2 * slope + 2e-4 * slope**2
    current = clean + sd * (clean if share else 1.0) * random.standard_normal(len(slope))
    columns = {
        "configuration": np.array(["4W2T"] * len(slope)),
        "supply_voltage_V": volt,
        "payload_kg": payload,
        "slope_deg": slope,
        "total_current_A": current,
        "motor_speed_rpm": 350 * volt * (1 + 0.005 * random.standard_normal(len(slope))),
        "speed_mm_s": np.full(len(slope), np.nan),
    }
    return Runs("made", columns, layout=Layout())


def found(runs):
    return series_noise.estimate_noise(runs, np.nan_to_num(SettledRuns.sizes(runs), nan=1.0))


def test_degrees_of_freedom_are_those_of_second_differences():
    """Of a series of five, D Dᵀ has 6, -4, 1 along its diagonals: ν = (Σ 6)² / Σ of squares = 324 / 174."""
    current, _, _ = found(table(0.05))
    assert current.freedom == pytest.approx(4 * 324 / 174, rel=5e-3)  # of a share nearly as many
    assert current.axis == "slope_deg" and current.count == 4


@pytest.mark.parametrize("share", [False, True])
def test_estimates_are_right_on_average(share):
    """Of 20 rows the forms are not always told apart: the variance is right on average where readings are middling,
    and rarely far too small where they are smallest."""
    sd, middling, smallest = 0.03, np.array([3.0]), np.array([0.7])
    each = [found(table(sd, share, seed=k))[0] for k in range(200)]
    truth = sd * (middling if share else 1.0)
    squares = np.concatenate([(e.sd(middling) / truth) ** 2 for e in each])
    assert squares.mean() == pytest.approx(1.0, abs=0.15)
    low = np.concatenate([e.sd(smallest) / (sd * (smallest if share else 1.0)) for e in each])
    assert np.quantile(low, 0.05) > 0.4  # of the likelier form alone 0.27


def test_both_parts_of_the_noise_add_as_squares():
    mixed = series_noise.SeriesNoise(channels.find_channel("total_current"), 0.03, 0.04, 7.4, "slope_deg", 4)
    assert_allclose(mixed.sd(np.array([0.0, 1.0])), [0.03, 0.05])


def test_curvature_makes_it_larger_and_a_wrong_reading_does_not():
    at = np.array([2.0])
    clean = found(table(0.05))[0].sd(at)
    runs = table(0.05)
    bent = with_columns(runs, total_current_A=runs["total_current_A"] + 0.02 * runs["slope_deg"] ** 2)
    assert found(bent)[0].sd(at) > 3 * clean
    current = runs["total_current_A"].copy()
    current[7] += 5.0
    assert found(with_columns(runs, total_current_A=current))[0].sd(at) < 2 * clean


def test_uneven_steps_and_repeats_count_as_they_are():
    """A straight line leaves nothing whatever its steps. Of repeats, what they differ by."""
    uneven = table(0.0, slopes=np.array([0.0, 1.0, 7.0, 9.0, 20.0]), seed=1)
    straight = 1 + 0.1 * uneven["slope_deg"]
    weights, used = series_noise._differences_from_neighbours(
        straight, uneven["slope_deg"], series_noise.series_along(uneven, "slope_deg")
    )
    assert used == 4 and np.abs(weights @ straight).max() < 1e-12
    repeats = np.array([3.0, 3.0, 3.0])
    weights, _ = series_noise._differences_from_neighbours(np.array([1.0, 2.0, 4.0]), repeats, [np.arange(3)])
    assert_allclose(weights.toarray(), [[-0.5, 1.0, -0.5]])


def test_a_display_shows_nothing_finer_than_its_step():
    runs = table(1e-4)
    shown = found(with_columns(runs, total_current_A=np.round(runs["total_current_A"] / 0.05) * 0.05))[0]
    assert np.all(shown.sd(np.array([0.5, 6.0])) >= 0.05 / np.sqrt(12) * 0.999)
    smooth = found(table(0.0, slopes=np.arange(5.0)))[0]  # as simulated
    assert np.all(smooth.sd(np.array([0.5, 6.0])) >= series_noise.FLOOR * np.array([0.5, 6.0]))


def test_a_coarse_display_with_few_readings_has_a_floor():
    """With 0.1, 0.2 and 0.4 A the smallest reading would else have the largest weight by far."""
    current = channels.find_channel("total_current")
    assert display_step(np.array([0.1, 0.2, 0.4, 0.4, 0.1]), current) == pytest.approx(0.1)
    assert display_step(np.array([0.137, 0.2242, 0.41, 0.433]), current) < 1e-3
    levels = np.array([1000.0, 2000.0, 3000.0]) * quantities.RPM
    assert display_step(levels, channels.find_channel("motor_speed")) == pytest.approx(100 * quantities.RPM)


def test_rows_without_series_are_assumed_as_usual_and_stated_ones_stay():
    runs = table(0.05)
    random = np.random.default_rng(0)
    scattered = {k: v if v.dtype.kind == "U" else v + 0.01 * random.random(len(v)) for k, v in runs.columns.items()}
    alone = dataclasses.replace(runs, columns=scattered)
    assert found(alone) == (None, None, None)
    with np.errstate(invalid="ignore"):
        known = noise.infer_noise(alone, SettledRuns.sizes(alone))
        mine = noise.infer_noise(runs, SettledRuns.sizes(runs), "current=0.2A")
    assert known.source == ("assumed", "assumed", "no readings") and known.word == "assumed"
    assert np.all(np.isinf(known.freedom))
    assert mine.source == ("stated", "series", "no readings") and mine.word == "estimated"
    assert channels.channel_names(mine.silent) == ("motor_speed",)
    assert_allclose(mine.sd[:, 0], 0.2)
    assert mine.freedom[1] == mine.along_series[0].freedom


def test_series_that_go_backward_are_others():
    runs = table(0.05, volts=(-20.0, -10.0, 10.0, 20.0), slopes=np.zeros(1), payloads=(0.0,))
    assert series_noise.series_along(runs, "supply_voltage_V") == []  # two and two
    longer = table(0.05, volts=(-30.0, -20.0, -10.0, 10.0, 20.0, 30.0), slopes=np.zeros(1), payloads=(0.0,))
    assert [len(s) for s in series_noise.series_along(longer, "supply_voltage_V")] == [3, 3]


def test_voltages_that_differ_by_the_sag_of_the_supply_are_one_level():
    sagging = np.array([11.989, 11.408, 10.828, 17.988, 17.408, 16.827, 23.988, 23.407, 22.827])
    levels = np.repeat([11.989, 17.988, 23.988], 3)
    assert_array_equal(series_noise.voltage_levels(sagging), levels)
    for kept in (np.array([12.0, 12.0, 24.0, 24.0]), np.linspace(5, 24, 20)):
        assert_array_equal(series_noise.voltage_levels(kept), kept)
    assert_array_equal(series_noise.voltage_levels(np.array([36.5, 36.1, 35.6])), np.full(3, 36.5))


@pytest.mark.parametrize("stated", [None, "current=2%,motor_speed=0.5%"])
def test_an_sd_in_per_cent_has_a_part_that_does_not_depend_on_the_reading(stated):
    """An ammeter has a zero: with 2 % of 0.1 A a small reading would establish any offset."""
    runs = table(0.0)
    current, random = np.linspace(0.01, 10, len(runs)), np.random.default_rng(0)
    alone = {name: random.random(len(runs)) for name in ("slope_deg", "payload_kg")}
    runs = with_columns(runs, **alone, total_current_A=current)
    with np.errstate(invalid="ignore"):
        sd = noise.infer_noise(runs, SettledRuns.sizes(runs), stated).sd[:, 0]
    assert_allclose(sd, 0.02 * np.maximum(current, 0.2 * np.sqrt(np.mean(current**2))))


def test_replicates_are_drawn_with_sds_that_an_estimate_might_have_been_of():
    factors = _noise_factors(np.array([7.45, np.inf]), 2, 20_000, seed=3)
    assert np.all(factors[:, 1] == 1.0)
    # 1 / f² is χ² / ν: mean 1, variance 2 / ν, but for what is cut off
    assert np.mean(factors[:, 0] ** -2) == pytest.approx(1.0, abs=0.02)
    assert np.var(factors[:, 0] ** -2) == pytest.approx(2 / 7.45, rel=0.05)
    assert factors.min() >= UNSURE[0] and factors.max() <= UNSURE[1]
    assert np.all(_noise_factors(None, 3, 5, seed=0) == 1.0)


def test_readings_of_motors_at_rest_do_not_tell_the_noise_of_those_that_turn():
    """A driver's dead band: half of the speeds are exactly 0. A pure share gave the slowest rows a far too small sd."""
    runs = table(0.05, slopes=np.linspace(0, 20, 121), payloads=(0.0,), volts=(15.0,))
    turning = np.maximum(600 - 57 * runs["slope_deg"], 0.0)
    speed = turning + np.where(turning > 0, 3.0, 0.0) * np.random.default_rng(4).standard_normal(121)
    runs = with_columns(runs, motor_speed_rpm=speed)
    _, motor, _ = found(runs)
    assert_allclose(motor.sd(quantities.RPM * np.array([30.0, 600.0])) / quantities.RPM, 3.0, rtol=0.35)


@pytest.mark.parametrize("thinned", [False, True])
def test_noise_of_a_log_is_that_of_its_readings_over_time(thinned):
    """Speed after steps of a voltage, with a time constant of 60 ms, read at 100 Hz."""
    time, random = np.arange(0.0, 8.0, 0.01), np.random.default_rng(5)
    since = time % 1.0
    speed = 40.0 * (1 - np.exp(-since / 0.06)) + 0.3 * random.standard_normal(len(time))
    current = np.exp(-since / 0.06) + 0.01 * random.standard_normal(len(time))
    columns = {
        "configuration": np.full(len(time), "4W2T"),
        "run_id": np.repeat(["a", "b"], len(time) // 2),
        "time_s": time,
        "total_current_A": current,
        "motor_speed_rpm": speed / quantities.RPM,
        "speed_mm_s": np.full(len(time), np.nan),
    }
    runs = Runs("log", columns, layout=Layout())
    runs = thin_rows(runs, 80) if thinned else runs
    known = noise.infer_noise(runs, np.nan_to_num(Histories.sizes(runs), nan=1.0))
    assert known.source[:2] == ("series", "series") and known.along_series[0].axis == "time_s"
    assert known.along_series[0].share == 0.0
    assert_allclose(known.sd[0, :2], [0.01, 0.3], rtol=0.15)


def test_noise_of_a_position_or_an_angle_has_no_floor():
    """An error of its scale is no noise of each reading. On EMPS, 0.1 % of the position is 6000 times its noise."""
    sizes = np.array([0.25])
    for name, floor in (("position", 0.0), ("output_angle", 0.0), ("motor_speed", series_noise.FLOOR)):
        estimate = series_noise.SeriesNoise(channels.find_channel(name), 2.5e-8, 0.0, 100.0, "time_s", 1)
        assert_allclose(estimate.sd(sizes), np.maximum(2.5e-8, floor * sizes))


def test_noise_of_a_log_whose_dry_friction_reverses_is_not_that_of_its_jumps():
    """Each jump changes two differences by 4 of their sds. With differences up to five sds, a log at imposed speed had 1.22 of its noise."""
    time, random = np.arange(0.0, 4.0, 0.005), np.random.default_rng(6)
    current = np.sin(9 * time) + 0.1 * np.sign(np.sin(40 * time)) + 0.02 * random.standard_normal(len(time))
    columns = {
        "configuration": np.full(len(time), "4W2T"),
        "run_id": np.full(len(time), "a"),
        "time_s": time,
        "total_current_A": current,
        "motor_speed_rpm": np.full(len(time), np.nan),
        "speed_mm_s": np.full(len(time), np.nan),
    }
    runs = Runs("log", columns, layout=Layout())
    known = series_noise.estimate_noise(runs, np.nan_to_num(Histories.sizes(runs), nan=1.0))[0]
    assert known.floor == pytest.approx(0.02, rel=0.08)
