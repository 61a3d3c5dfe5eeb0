"""Outliers that lie together are a finding: where they do is said, and scattered ones are left alone."""

import numpy as np
import pytest
from numpy.random import default_rng

from calibration.discovery import outliers
from calibration.discovery.outliers import find_cluster
from calibration.words.loop_words import cluster_sentence

ERROR = 0.01
RNG = default_rng(0)
ROWS = 240
#: Eight runs of thirty samples, at four voltages, in random order of conditions.
TIME = np.tile(np.linspace(0.0, 1.45, 30), 8)
ANGLE = RNG.uniform(0.0, 2 * np.pi, ROWS)
ORDER = np.arange(ROWS, dtype=float)
VOLTAGE = RNG.permutation(np.repeat([12.0, 18.0, 24.0, 30.0], 60))
RUN = np.repeat([f"start{k}" for k in range(8)], 30)
AXES = {"time": TIME, "order": ORDER, "angle of the driving shaft": ANGLE}
LEVELS = {"supply_voltage_V": VOLTAGE, "run_id": RUN}


def found(rows, axes=AXES, levels=LEVELS, error=ERROR, included=None):
    """The cluster of outliers at these rows (indices or a mask)."""
    outliers = np.zeros(ROWS, bool)
    outliers[rows] = True
    included = ~outliers if included is None else included
    return find_cluster(outliers, included, axes, levels, error, seed=0)


def drawn(mask, count, seed=1):
    """So many rows of a mask, at random."""
    return default_rng(seed).choice(np.flatnonzero(mask), count, replace=False)


@pytest.mark.slow
def test_scattered_outliers_are_no_cluster(monkeypatch):
    """As seldom as stated, over 200 draws. A test of the test: of outliers that lie together, nearly always."""
    monkeypatch.setattr(outliers, "PERMUTATIONS", 400)
    axes, levels, error = {"time": TIME}, {"supply_voltage_V": VOLTAGE}, 0.05
    count = default_rng(2).integers(3, 16, 200)
    false = [found(drawn(np.ones(ROWS, bool), n, k), axes, levels, error) for k, n in enumerate(count)]
    assert sum(c is not None for c in false) <= error * len(false)
    true = [found(drawn((TIME > 0.7) & (TIME < 0.85), 8, k), axes, levels, error) for k in range(10)]
    assert all(c is not None for c in true)


#: Where outliers lie, how many of them, and the axis on which they have to be found.
TOGETHER = {
    "time": ((TIME >= 0.6) & (TIME <= 0.7), 14, "time"),
    "order": ((ORDER >= 100) & (ORDER <= 112), 9, "order"),
    "angle": ((ANGLE > 1.0) & (ANGLE < 1.3), 9, "angle of the driving shaft"),
}


@pytest.mark.parametrize("case", TOGETHER)
def test_outliers_on_a_stretch_are_found_there(case):
    inside, count, axis = TOGETHER[case]
    inside = drawn(inside, min(count, int(inside.sum())))
    alone = drawn(np.ones(ROWS, bool), 3, seed=5)
    got = found(np.union1d(inside, alone))
    assert got is not None and got.axis == axis and got.p < ERROR and got.level == ""
    x = AXES[axis][inside]
    # the place is told to the width of the widest window, and holds all of them
    assert got.low <= x.min() and got.high >= x.max() and got.inside >= len(inside)
    assert got.high - got.low <= max(outliers.WINDOWS) * np.ptp(AXES[axis])
    assert got.of == len(np.union1d(inside, alone))
    assert cluster_sentence(got).startswith(
        f"{got.inside} of {got.of} outlying rows cluster at {axis} {got.low:.3g} to"
    )


def test_outliers_of_one_level_are_found_there():
    got = found(drawn(VOLTAGE == 24.0, 10))
    assert got is not None and (got.axis, got.level, got.inside, got.of) == ("supply_voltage_V", "24.0", 10, 10)
    # 10 of 10 from a quarter of the rows, at one of four levels, in one of five columns
    expected = np.prod([(60 - k) / (ROWS - k) for k in range(10)]) * 4 * (len(AXES) + len(LEVELS))
    assert got.p == pytest.approx(expected, rel=1e-9)
    assert "cluster at supply_voltage_V 24.0" in cluster_sentence(got)


def test_two_outliers_are_no_cluster():
    assert outliers.FEWEST == 3 and found([100, 101]) is None and found([]) is None


def test_rows_that_never_counted_are_no_place_for_outliers():
    """A stretch in which all rows that count lie off by themselves is no wonder where no other rows count."""
    outliers = drawn((TIME > 0.6) & (TIME < 0.8), 12)
    assert found(outliers) is not None
    only = np.zeros(ROWS, bool)
    only[drawn((TIME > 0.6) & (TIME < 0.8), 24, seed=3)] = True
    only[outliers] = False
    assert found(outliers, axes={"time": TIME}, levels={}, included=only) is None


def test_a_column_of_many_values_has_no_levels():
    got = found(drawn(np.ones(ROWS, bool), 8), axes={}, levels={"every row its own": ORDER})
    assert got is None
