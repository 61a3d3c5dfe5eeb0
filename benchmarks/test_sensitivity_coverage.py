"""The record of how often intervals of Sobol indices hold their truth."""

import numpy as np
import pytest
from sensitivity import coverage


@pytest.mark.nightly
def test_sobol_intervals_cover_those_of_the_steady_model_in_scipy():
    record = coverage(200, 32, 512)
    shares = np.array([x for by in record["steady"].values() for order in by.values() for x in order])
    # 36 indices of 200 seeds each: a share of 0.95 has an sd of 0.015, so that some lie outside by chance
    assert 0.93 <= shares.mean() <= 0.97 and shares.min() >= 0.88
    assert np.mean((shares >= 0.9) & (shares <= 0.98)) >= 0.85
