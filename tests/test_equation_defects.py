"""What each equation lacks, row by row: nothing is a residual over a vanishing slope, each side has its own, and what
was found is drawn over what it depends on."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose

from calibration.inference.observers.settled import EQUATIONS, SettledLinearization, _row_defects
from calibration.inference.observers.turns import TurnLinearization
from mmrjax.model.signals import Signals
from sweeps.pages.loop_figures import driving_variable

ROWS, COUNT, RANDOM = 12, 3, default_rng(0)
#: Sizes of voltage, torque and speed; and how many sds of a reading a defect of that size is.
SIZES, SEEN = {"voltage": 20.0, "torque_output": 2.0, "speed_theoretical": 0.5}, 200.0
#: What turns the output, of a gearbox 16 : 1.
SHAFT = {"torque_electromagnetic": 0.15, "speed_motor": 320.0, "speed_output": 20.0}
#: Which way each row goes.
WAY = np.where(np.arange(ROWS) % 3, 1.0, -1.0)


def linearised(kind, slopes, defects, **others):
    """A fit whose rows have defects along their way (equations, sides, rows), by slopes (equations, sides, rows,
    channels). `others`: sizes of signals."""
    sides = slopes.shape[1]
    whole = np.zeros((len(kind.probed), *slopes.shape[1:]))
    for slope, name in zip(slopes, EQUATIONS, strict=True):
        whole[kind.probed.index(name)] = slope
    residual = -np.einsum("esrc,esr->rc", slopes, WAY * defects)
    shape = (ROWS, sides) if sides > 1 else (ROWS,)
    signals = Signals(**{name: np.full(shape, size) for name, size in (SIZES | SHAFT | others).items()})
    way = np.broadcast_to(WAY[:, None], shape) if sides > 1 else WAY
    signals = replace(signals, direction=way)
    scale = np.ones(residual.shape)
    whole = whole if sides > 1 else whole[:, 0]
    return kind(residual.ravel(), np.zeros((residual.size, 1)), np.zeros((residual.size, 0)), whole, scale, signals,
                channels=tuple(map(str, range(residual.shape[1]))))  # fmt: skip


def slopes_of(sides, count=COUNT):
    size = np.array(list(SIZES.values()))[:, None, None, None]
    return SEEN * RANDOM.normal(size=(len(EQUATIONS), sides, ROWS, count)) / size


def test_defects_that_readings_show_are_found():
    true = RANDOM.normal(size=(3, 1, ROWS)) * np.array([0.1, 0.01, 0.005])[:, None, None]
    included = np.arange(ROWS) != 4
    found = _row_defects(linearised(SettledLinearization, slopes_of(1), true), included)
    assert list(found) == list(EQUATIONS)
    for x, wanted, size in zip(found.values(), true[:, 0], SIZES.values(), strict=True):
        assert np.isnan(x[4]) and np.isfinite(x[included]).all()
        assert_allclose(x[included], wanted[included], atol=2e-3 * size)


@pytest.mark.parametrize("slope", [1e-3, 1e-6, 0.0])
def test_no_defect_is_a_residual_over_a_vanishing_slope(slope):
    slopes = slopes_of(1)
    slopes[2, 0, 3] *= slope  # the slip of one row
    linear = linearised(SettledLinearization, slopes, np.zeros((3, 1, ROWS)))
    noisy = replace(linear, residual=RANDOM.normal(size=ROWS * COUNT))
    found = _row_defects(noisy, np.ones(ROWS, bool))["slip"]
    assert abs(found[3]) < SIZES["speed_theoretical"]


def test_a_motor_that_turns_nothing_but_itself_may_lack_torque():
    """At the output there is none, of which a share would be nothing too."""
    true = np.zeros((3, 1, ROWS))
    true[1] = 0.1
    found = _row_defects(linearised(SettledLinearization, slopes_of(1), true, torque_output=0.0), np.ones(ROWS, bool))
    # Of most rows: where random slopes are nearly alike, a row's residual is shared out.
    assert np.median(found["track"]) == pytest.approx(0.1, rel=0.02)
    assert np.median(np.abs(found["electrical"])) < 0.005 * SIZES["voltage"]


def test_each_side_has_its_own_defects():
    true = np.zeros((3, 2, ROWS))
    true[0, 1] = 0.3  # the right one's voltage
    found = _row_defects(linearised(TurnLinearization, slopes_of(2, 7), true), np.ones(ROWS, bool))
    assert list(found) == [f"{b}_{side}" for b in EQUATIONS for side in ("left", "right")]
    for name, x in found.items():
        wanted, size = (0.3, 20.0) if name == "electrical_right" else (0.0, SIZES[EQUATIONS[name.rpartition("_")[0]]])
        assert_allclose(x, wanted, atol=2e-3 * size)


def turns():
    """Columns of a table of turns."""
    n = 40
    duty, voltage = dict(zip(SIDES, RANDOM.uniform(-1, 1, (2, n)), strict=True)), np.repeat([15.0, 33.0], n // 2)
    table = {"configuration": np.full(n, "6T2A"), "supply_voltage_V": voltage, "payload_kg": np.zeros(n)}
    table |= {"slope_deg": np.zeros(n)} | {f"duty_{side}": d for side, d in duty.items()}
    for side, d in duty.items():
        table |= {f"motor_speed_{side}_rpm": 360 * d * voltage, f"motor_current_{side}_A": RANDOM.uniform(-2, 2, n)}
        table |= {f"defect_before_{b}_{side}": RANDOM.normal(size=n) for b in EQUATIONS}
    return table


SIDES = ("left", "right")


@pytest.mark.parametrize(
    "change, label",
    [
        (lambda t: t["supply_voltage_V"] ** 2, "supply voltage [V]"),
        (lambda t: np.abs(t["motor_current_right_A"]), "motor current, right [A]"),
        (lambda t: t["motor_current_left_A"] - t["motor_current_right_A"], "left minus right: motor current [A]"),
        (lambda t: np.sin(t["motor_current_left_A"] + t["motor_current_right_A"]), "mean of both sides: motor current [A]"),
        (lambda t: np.cos(t["slope_deg"]) + t["motor_current_left_A"], "motor current, left [A]"),
    ],
)  # fmt: skip
def test_what_was_found_is_drawn_over_what_it_depends_on(change, label):
    table = turns()
    y = change(table)
    y[3] = np.nan  # a row that does not count
    x, said = driving_variable(table, y)
    assert said == label and x.shape == y.shape
