"""A loss and an error of the ammeter are one statement where only the current shows the torque."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.random import default_rng

from calibration.discovery.classes import ammeter_families
from calibration.discovery.projection import Projection
from calibration.discovery.settings import settings_for
from calibration.inference.observers import SettledRuns
from mmrjax.model import channels

LOSS = "loss torque that changes with load"
ROWS, AMOUNT = 40, 12.0


def families(imposed, *shown):
    """Families that imitate a loss which every channel shows, each by so many sigmas in a row."""
    rng = default_rng(0)
    ordered = channels.channels_named([name for name, _ in shown])
    of_row = np.array([dict(shown)[c.name] for c in ordered])
    shape = np.linspace(0.0, 1.0, ROWS) ** 2
    column = (shape[:, None] * of_row).ravel()
    residual = np.append(AMOUNT * column / np.linalg.norm(column) + 0.1 * rng.standard_normal(column.size), 0.0)
    jacobian = np.append(np.repeat(1 - shape, len(ordered)), 1.0)[:, None]
    rig = SimpleNamespace(imposed=imposed)
    space = SimpleNamespace(bare=SimpleNamespace(channels=ordered, base=SimpleNamespace(rig=rig)))
    return ammeter_families(space, Projection(jacobian, residual), column[:, None], LOSS, settings_for(SettledRuns))


@pytest.mark.parametrize(
    "shown, listed",
    [
        ([("total_current", 1.0)], True),
        ([("total_current", 1.0), ("speed", 0.1)], True),
        ([("total_current", 1.0), ("output_torque", 0.8)], False),
        ([("speed", 1.0)], False),
    ],
)
def test_only_a_second_reading_of_the_torque_separates_them(shown, listed):
    assert families("motor_speed", *shown) == ("reading of total current that changes with current",) * listed
    assert families("voltage", *shown) == ()  # the speed shows the torque as well
