"""Units of columns against a table written out by hand."""

import math

import pytest

from calibration.data import units
from mmrjax import channels

#: One of each unit, in SI.
BY_HAND = {
    "A": 1.0, "mA": 0.001, "V": 1.0, "mV": 0.001, "Nm": 1.0, "mNm": 0.001, "kNm": 1000.0, "C": 1.0,
    "rpm": 2 * math.pi / 60, "rad/s": 1.0, "turns/s": 2 * math.pi, "deg/s": math.pi / 180,
    "mm/s": 0.001, "m/s": 1.0, "cm/s": 0.01, "km/h": 1000 / 3600, "m/min": 1 / 60,
    "mm": 0.001, "m": 1.0, "cm": 0.01, "um": 1e-6,
    "deg": math.pi / 180, "rad": 1.0, "turns": 2 * math.pi,
}  # fmt: skip


@pytest.mark.parametrize("channel", channels.EVERY, ids=lambda c: c.name)
def test_units_of_a_channel_are_those_of_the_table_by_hand(channel):
    for unit, factor in ((channel.unit, channel.factor), *channel.other_units):
        assert factor == pytest.approx(BY_HAND[unit], rel=1e-12), unit


def test_units_of_conditions_are_those_by_hand():
    assert units.TIME == {"s": 1.0, "ms": 0.001, "min": 60.0, "h": 3600.0}
    assert units.VOLTAGE == {"V": 1.0, "mV": 0.001} and units.CURRENT == {"A": 1.0, "mA": 0.001}
    assert units.MASS == {"kg": 1.0, "g": 0.001} and units.SHARE == {"": 1.0, "percent": 0.01}
    assert set(units.ANGLE) == {"deg", "rad"} and units.ANGLE["deg"] == 1.0
    assert units.ANGLE["rad"] == pytest.approx(57.29577951308232)


@pytest.mark.parametrize(
    ("written", "column"),
    [("U/min", "rpm"), ("1/min", "rpm"), ("min-1", "rpm"), ("°/s", "deg_s"), ("Nmm", "mNm"), ("N·m", "Nm"), ("%", "percent")],
)  # fmt: skip
def test_units_as_people_write_them_are_those_of_columns(written, column):
    assert units.spelled(written) == column
