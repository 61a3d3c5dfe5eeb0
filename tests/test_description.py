"""No effect is named where the model misses a channel by more than a quarter of its measured rms."""

from types import SimpleNamespace

import numpy as np
import pytest

from calibration.data.runs import Runs
from calibration.discovery.loop_notes import MissedChannel
from calibration.discovery.verdict import missed_channels, remaining_errors
from calibration.inference.blocks import predictable_blocks
from calibration.inference.observers import Histories
from mmrjax.model.channels import find_channel

ROWS, SD = 40, 0.02
CURRENT, SPEED = find_channel("total_current"), find_channel("motor_speed")


class Sized(SimpleNamespace):
    def __len__(self):
        return ROWS


def table():
    """Runs with a current of 2 A and a speed of 500, and a space with padding."""
    measured = np.stack([np.full(ROWS, 2.0), np.full(ROWS, 500.0)], 1)
    runs = Sized(channels=(CURRENT, SPEED), measured=lambda: measured)
    weight = np.ones((ROWS + 8, 2))
    weight[ROWS:] = 0.0
    return runs, SimpleNamespace(weight=weight, bare=SimpleNamespace(observe=SimpleNamespace(reads=True)))


def judged(refit, sd=SD, source="columns", outlier=False):
    """Of a current that a fit misses by so many A, and a speed that it follows."""
    runs, space = table()
    space.weight[0] = 0.0 if outlier else 1.0
    off = np.tile([refit / sd, 0.5], (ROWS + 8, 1))
    off[0, 0] = 1e6 if outlier else off[0, 0]
    noise = SimpleNamespace(sd=np.tile([sd, 5.0], (ROWS, 1)), source=(source, "columns"))
    return missed_channels(space, runs, noise, SimpleNamespace(by_row=lambda: off))


@pytest.mark.parametrize(
    "said, options",
    [
        ((), {"refit": 0.48}),
        (("total_current",), {"refit": 0.52}),
        ((), {"refit": 0.48, "outlier": True}),  # a row that is set aside does not count
        ((), {"refit": 0.52, "sd": 0.5}),  # an instrument that is stated to be so coarse
        (("total_current",), {"refit": 0.52, "sd": 0.5, "source": "series"}),
        (("total_current",), {"refit": 0.1, "sd": 0.52, "source": "series"}),
    ],
)
def test_a_model_that_misses_a_quarter_of_a_channel_does_not_describe_the_runs(said, options):
    assert tuple(m.channel for m in judged(**options)) == said


@pytest.mark.parametrize(
    "refit, found, noise, remains",
    [
        (0.54, 0.20, 0.0, 0.10),  # a lifted wheel: 27 %, where one effect leaves 10 %
        (0.54, 0.28, 0.0, None),  # less than half of the error is gone
        (1.40, 0.52, 0.0, None),  # more than a quarter of the rms remains
        (0.54, 0.20, 0.3, None),  # noise as large
    ],
)
def test_effects_describe_what_the_refit_misses_if_unseen_errors_are_halved(refit, found, noise, remains):
    runs, space = table()

    def unseen(missed):
        reading = runs.measured() + np.array([missed, 0.5])
        reading[3] = np.nan  # a row that the fit does not reach
        return SimpleNamespace(reading={"voltage": reading, "slope": reading})

    left = remaining_errors(space, runs, (MissedChannel("total_current", 0.27, noise),), unseen(refit), unseen(found))
    assert left == (() if remains is None else (MissedChannel("total_current", pytest.approx(remains), noise),))


@pytest.mark.parametrize("configurations", [("a",), ("a", "b"), ("a", "a")])
def test_a_run_without_others_is_held_out_in_parts_of_its_time(configurations, monkeypatch):
    samples = 12
    runs = Runs("log.csv", {
        "time_s": np.concatenate([start + np.arange(samples) * 0.1 for start, _ in enumerate(configurations)]),
        "run_id": np.repeat(np.arange(len(configurations)).astype(str), samples),
        "configuration": np.repeat(configurations, samples), "supply_voltage_V": np.full(samples * len(configurations), 9.0),
    })  # fmt: skip
    monkeypatch.setattr(Runs, "configurations_named", lambda self, robot: self["configuration"])
    coordinates = SimpleNamespace(names=tuple(f"{c}.friction" for c in set(configurations)), tied=())
    problem = SimpleNamespace(base=None, coordinates=coordinates, observe=Histories)
    kinds = predictable_blocks(runs, problem)
    if configurations == ("a", "a"):
        assert list(kinds) == ["run"]
        return
    quarters = np.tile(np.repeat(np.arange(4), samples // 4), len(configurations))
    assert list(kinds) == ["part"]
    np.testing.assert_array_equal(np.argmax(list(kinds["part"].values()), 0), quarters)
