"""Equation (35) and (A1) against numbers of the paper and cases known by hand."""

import numpy as np
import pytest

from calibration.inference import errors as residual


def test_relative_error_is_equation_35_with_simulated_below():
    assert residual.relative_error(np.array([2.22]), np.array([2.30])) == pytest.approx([-3.6], abs=0.05)  # Table A1


def test_summary_leaves_out_rows_without_a_simulation():
    assert residual.summary(np.array([3.0, -4.0, np.nan])) == {
        "rows": 2,
        "rms_percent": pytest.approx(np.sqrt(12.5)),
        "max_percent": 4.0,
    }
    assert residual.summary(np.array([np.nan]))["rows"] == 0


def test_certainty_is_equation_a1():
    y = np.array([1.0, 2.0, 4.0])
    assert residual.certainty(y, y) == 1.0
    assert residual.certainty(y, np.full(3, y.mean())) == pytest.approx(0.0)
    assert residual.certainty(y, y + 1) == pytest.approx(1 - 3 / (21 - 49 / 3))
    assert np.isnan(residual.certainty(np.ones(3), y)) and np.isnan(residual.certainty(y[:1], y[:1]))
