"""Units of columns against a table written out by hand."""

import math

import pytest

from mmrjax.model import channels, quantities

#: One of each unit, in SI.
BY_HAND = {
    "A": 1.0, "mA": 0.001, "V": 1.0, "mV": 0.001, "Nm": 1.0, "mNm": 0.001, "kNm": 1000.0, "C": 1.0,
    "rpm": 2 * math.pi / 60, "rad/s": 1.0, "turns/s": 2 * math.pi, "deg/s": math.pi / 180,
    "mm/s": 0.001, "m/s": 1.0, "cm/s": 0.01, "km/h": 1000 / 3600, "m/min": 1 / 60,
    "kg": 1.0, "g": 0.001, "s": 1.0, "ms": 0.001, "min": 60.0, "h": 3600.0, "": 1.0, "percent": 0.01, "rad/s^2": 1.0,
    "mm": 0.001, "m": 1.0, "cm": 0.01, "um": 1e-6,
    "deg": math.pi / 180, "rad": 1.0, "turns": 2 * math.pi,
}  # fmt: skip


@pytest.mark.parametrize("channel", channels.EVERY, ids=lambda c: c.name)
def test_units_of_a_channel_are_those_of_the_table_by_hand(channel):
    for unit, factor in ((channel.unit, channel.factor), *channel.other_units):
        assert factor == pytest.approx(BY_HAND[unit], rel=1e-12), unit


@pytest.mark.parametrize("condition", quantities.SET, ids=lambda c: c.column)
def test_units_of_a_condition_are_those_of_the_table_by_hand(condition):
    for unit, factor in ((condition.unit, condition.factor), *condition.other_units):
        assert factor == pytest.approx(BY_HAND[unit], rel=1e-12), unit
        assert condition.value(2.0, quantities.spelled(unit)) == pytest.approx(2.0 * factor / condition.factor)


def test_per_cent_of_a_slope_are_those_of_its_tangent():
    slope = quantities.CONDITIONS["slope_deg"]
    assert slope.value(100.0, "percent") == pytest.approx(45.0)
    assert slope.limits("percent") == pytest.approx((-100.0, 100.0))


@pytest.mark.parametrize(
    ("written", "column"),
    [("U/min", "rpm"), ("1/min", "rpm"), ("min-1", "rpm"), ("°/s", "deg_s"), ("Nmm", "mNm"), ("N·m", "Nm"), ("%", "percent")],
)  # fmt: skip
def test_units_as_people_write_them_are_those_of_columns(written, column):
    assert quantities.spelled(written) == column
