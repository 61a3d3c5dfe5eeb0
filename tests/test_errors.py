"""Equation (35) and (A1) against numbers of the paper and cases known by hand."""

import numpy as np
import pytest

from calibration.inference.simulation_errors import channel_errors, error_summary, r_squared, relative_error
from mmrjax.model.channels import usual_channels


def test_relative_error_is_equation_35_with_simulated_below():
    assert relative_error(np.array([2.22]), np.array([2.30])) == pytest.approx([-3.6], abs=0.05)  # Table A1


def test_summary_leaves_out_rows_without_a_simulation():
    assert error_summary(np.array([3.0, -4.0, np.nan])) == {
        "rows": 2,
        "rms_percent": pytest.approx(np.sqrt(12.5)),
        "max_percent": 4.0,
    }
    assert error_summary(np.array([np.nan]))["rows"] == 0


def test_certainty_is_equation_a1():
    y = np.array([1.0, 2.0, 4.0])
    assert r_squared(y, y) == 1.0
    assert r_squared(y, np.full(3, y.mean())) == pytest.approx(0.0)
    assert r_squared(y, y + 1) == pytest.approx(1 - 3 / (21 - 49 / 3))
    assert np.isnan(r_squared(np.ones(3), y)) and np.isnan(r_squared(y[:1], y[:1]))


def test_channel_errors_leave_out_what_is_missing():
    measured = np.array([[2.0, np.nan, 1.0], [4.0, np.nan, np.nan]])
    simulated = np.array([[2.0, 5.0, 1.1], [5.0, 5.0, 1.1]])
    found = channel_errors(usual_channels(), simulated, measured, np.ones((2, 3)))
    assert [found[c]["rows"] for c in ("total_current", "motor_speed", "speed")] == [2, 0, 1]
    assert found["total_current"]["rms_sigma"] == pytest.approx(np.sqrt(0.5))
    assert found["total_current"]["max_percent"] == pytest.approx(100 / np.sqrt(10))
    assert np.isnan(found["motor_speed"]["rms_percent"])
    assert found["total_current"]["rms"] == pytest.approx(np.sqrt(0.5))
    assert found["speed"]["rms"] == pytest.approx(0.1 / 1e-3)  # in mm/s, as the column
