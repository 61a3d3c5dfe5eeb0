"""Peaks of ripple over speed and what confirms them, on signals whose answer is known."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from mmrjax.model.signals import CONVERGED, FAILED, SLIDES
from mmrjax.undercarriage.modes import Mode
from mmrjax.undercarriage.ripple_peaks import (
    SIGNALS,
    RipplePeak,
    drop_unconfirmed_modes,
    find_crossings,
    group_resonances,
    measure_fluctuation,
    passing_parts,
    peaks_over_speed,
    strongest_resonances,
    vibrations_of_runs,
)

BOUNCE = Mode("bounce", 90.0, 85.0, 95.0, 91.0, 0.1, 0.9, 1.0)
TRAVEL = 0.035
SPEED = np.linspace(0.8, 1.3, 26)


def response(natural=90.0, order=3):
    """A base of 5 % and a resonance of the third harmonic."""
    line = order * SPEED / TRAVEL
    return 0.05 + 0.01 / np.hypot(1 - (line / natural) ** 2, 0.2 * line / natural), line


def test_fluctuation_reads_mean_deviation_and_strongest_line():
    time = np.arange(0.001, 0.75, 0.001)
    values = 10 + 0.3 * time + 0.5 * np.sin(2 * np.pi * 61.3 * time) + 0.2 * np.sin(2 * np.pi * 20 * time)
    mean, deviation, frequency = measure_fluctuation(time, values)
    assert frequency == pytest.approx(61.3, abs=0.1)
    assert deviation * mean == pytest.approx(np.hypot(0.5, 0.2) / np.sqrt(2), rel=0.01)
    assert np.isnan(measure_fluctuation(time, np.full_like(time, 3.0))[2])
    assert np.isnan(measure_fluctuation(time, np.full_like(time, np.nan))[1])


def test_peak_at_a_crossing_names_mode_and_order():
    ripple, line = response()
    (peak,) = peaks_over_speed("reaction", 3.0, SPEED, SPEED / TRAVEL, ripple, line, [BOUNCE])
    assert (peak.mode, peak.order, peak.payload) == ("bounce", 3, 3.0)
    assert peak.speed == pytest.approx(90 * TRAVEL / 3, rel=0.02)
    assert peak.low < peak.speed < peak.high
    met = find_crossings([BOUNCE], 3.0, TRAVEL, 0.8, 1.3, [peak])
    assert [(c.order, c.signals) for c in met] == [(3, ("reaction",))]


@pytest.mark.parametrize("natural, modes", [(104.0, [BOUNCE]), (90.0, []), (90.0, [BOUNCE._replace(damping=0.6)])])
def test_peak_away_from_a_mode_names_none(natural, modes):
    ripple, line = response(natural)
    (peak,) = peaks_over_speed("reaction", 3.0, SPEED, SPEED / TRAVEL, ripple, line, modes)
    assert peak.mode == ""


def test_crossing_without_a_peak_is_not_confirmed():
    flat = np.full_like(SPEED, 0.05)
    assert peaks_over_speed("reaction", 0.0, SPEED, SPEED / TRAVEL, flat, 3 * SPEED / TRAVEL, [BOUNCE]) == []
    (met,) = find_crossings([BOUNCE], 0.0, TRAVEL, 0.8, 1.3, [])
    assert met.signals == ()


def test_ripple_too_small_to_notice_has_no_peaks():
    ripple, line = response()
    assert peaks_over_speed("speed", 0.0, SPEED, SPEED / TRAVEL, 1e-3 * ripple, line, [BOUNCE]) == []
    assert peaks_over_speed("speed", 0.0, SPEED[:2], SPEED[:2], ripple[:2], line[:2], [BOUNCE]) == []


@pytest.mark.parametrize("lines, mode", [((95.0, 80.0), "bounce"), ((80.0, 95.0), "")])
def test_peaks_that_move_against_a_mode_are_not_confirmed_by_it(lines, mode):
    natural = {0.0: [BOUNCE._replace(frequency=94.0)], 8.0: [BOUNCE._replace(frequency=81.0)]}
    found = [
        RipplePeak("reaction", payload, 1.0, 0.9, 1.1, 0.1, 0.05, 3, line, "bounce")
        for payload, line in zip((0.0, 8.0), lines, strict=True)
    ]
    assert {p.mode for p in drop_unconfirmed_modes(found, natural)} == {mode}


def test_strongest_leaves_small_and_weak_ones_out():
    def peak(ripple, rise, order):
        return RipplePeak("current", 0.0, 1.0, 0.9, 1.1, ripple, rise, order, 50.0, "pitch")

    found = group_resonances([peak(0.05, 0.02, 2), peak(0.04, 0.005, 3), peak(0.005, 0.003, 5)])
    assert [r.order for r in found] == [2, 3, 5] and [r.order for r in strongest_resonances(found)] == [2]


def test_what_passes_is_grousers_or_teeth(robot):
    tracks, wheels = passing_parts(robot, 0), passing_parts(robot, 1)
    assert (tracks.name, wheels.name) == ("grousers", "teeth")
    assert tracks.travel == pytest.approx(0.035, rel=1e-3) and wheels.pitch == pytest.approx(5e-3, rel=1e-3)
    assert wheels.travel == pytest.approx(5e-3 * 49.96 / 38.2, rel=0.01)


def test_runs_that_fail_slide_or_creep_are_not_read(robot):
    time = np.broadcast_to(np.arange(1, 1001) * 1e-3, (4, 1000))
    wave = 10 + np.sin(2 * np.pi * 50 * time)
    wave[1] = np.nan
    fields = {s.field: wave for s in SIGNALS.values()}
    turns = np.full((4, 1000), 20.0)
    turns[3] = 0.5  # 0.3 pitches in the tail
    signals = SimpleNamespace(**fields, speed_wheel=turns)
    status = np.array([CONVERGED, FAILED, SLIDES, CONVERGED])
    runs = SimpleNamespace(time=time, signals=signals, result=SimpleNamespace(status=status))
    found = vibrations_of_runs(robot, runs, 0.035)
    assert found.read.tolist() == [True, False, False, False]
    assert found.frequency["reaction"][0] == pytest.approx(50, abs=0.1)
    for values in dataclasses.asdict(found)["deviation"].values():
        assert np.isnan(values[1:]).all()
