"""No effect is named where the model misses a channel by more than a quarter of its measured rms."""

from types import SimpleNamespace

import numpy as np
import pytest

from calibration.data.runs import Runs
from calibration.discovery.description import undescribed_channels, unused_inputs
from calibration.discovery.loop_notes import Missed, Summary
from calibration.words import loop_words
from mmrjax.model import channels

ROWS, SD = 40, 0.02
CURRENT, SPEED = channels.find_channel("total_current"), channels.find_channel("motor_speed")


class Sized(SimpleNamespace):
    def __len__(self):
        return ROWS


def judged(refit, found=None, sd=SD, source="columns", outlier=False):
    """Of a current of 2 A that fits miss by so many A, and a speed that they follow."""
    measured = np.stack([np.full(ROWS, 2.0), np.full(ROWS, 500.0)], 1)
    runs = Sized(channels=(CURRENT, SPEED), measured=lambda: measured)
    weight = np.ones((ROWS + 8, 2))  # padded
    weight[ROWS:] = 0.0
    weight[0] = 0.0 if outlier else 1.0
    sds = np.tile([sd, 5.0], (ROWS, 1))

    def fit(missed):
        off = np.tile([missed / sd, 0.5], (ROWS + 8, 1))
        off[0, 0] = 1e6 if outlier else off[0, 0]
        return SimpleNamespace(by_row=lambda: off)

    noise = SimpleNamespace(sd=sds, source=(source, "columns"))
    return undescribed_channels(
        SimpleNamespace(weight=weight), runs, noise, fit(refit), None if found is None else fit(found)
    )


@pytest.mark.parametrize(
    ("said", "options"),
    [
        ((), {"refit": 0.48}),
        (("total_current",), {"refit": 0.52}),
        ((), {"refit": 0.48, "outlier": True}),  # a row that is set aside does not count
        ((), {"refit": 0.52, "found": 0.09}),  # what was found is what the refit lacked
        (("total_current",), {"refit": 0.52, "found": 0.11}),
        ((), {"refit": 0.52, "sd": 0.5}),  # an instrument that is stated to be so coarse
        (("total_current",), {"refit": 0.52, "sd": 0.5, "source": "series"}),
        (("total_current",), {"refit": 0.1, "sd": 0.52, "source": "series"}),
    ],
)
def test_a_model_that_misses_a_quarter_of_a_channel_does_not_describe_the_runs(said, options):
    assert tuple(m.channel for m in judged(**options)) == said


def test_what_to_check_first_is_said_with_the_columns_that_are_not_used():
    extras = {"brake_Nm": np.linspace(0, 1, 4), "constant": np.ones(4), "who": np.array(list("abab"))}
    assert unused_inputs(Runs("runs.csv", {"order": np.arange(4.0)}, extras=extras)) == ("brake_Nm",)
    missed = (Missed("total_current", 0.484, 0.02),)
    said = loop_words.verdict_sentences(
        Summary("undescribed", 0.004, None, missed=missed, unused=("brake_Nm",), far=("motor.r",))
    )
    assert said == (
        "This model does not describe these runs: refitted, it misses total current by 48 % of its measured rms. No "
        "effect is named. Check first: columns that vary and are not used (brake_Nm); parameters far from their priors "
        "(motor.r); units, signs and sides of the columns."
    )
