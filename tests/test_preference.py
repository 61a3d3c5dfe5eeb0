"""What held-out data say: errors that rise are told first, and they may choose the leader of a class."""

import dataclasses

import numpy as np
import pytest
from synthetic import SETTLED, table
from worlds import tables

from calibration.data.input_errors import BadConfiguration
from calibration.discovery import preference
from calibration.discovery.prediction import HeldOutAlternative
from calibration.discovery.result import WorseChannel
from calibration.discovery.settings import HELD_OUT, settings_for
from calibration.inference.observers import SettledRuns
from mmrjax.model import channels
from tests.commands import refused

NAMES = channels.USUAL


def errors(sigma):
    """As by the loop: an rms of each channel over the rows that are there."""
    there = np.isfinite(sigma)
    return {
        n: {"rows": int(there[:, k].sum()), "rms_percent": float(np.sqrt(np.nanmean(sigma[:, k] ** 2)))}
        for k, n in enumerate(NAMES)
    }


def held_out(before, after, kind="voltage"):
    """Ten rows with these errors in every channel, by kind of block."""
    return {kind: tuple(np.full((10, len(NAMES)), x) for x in (before, after))}


def worse(readings):
    """Channels of readings whose errors rise."""
    pairs = {kind: preference.errors_on_common_rows(*x, errors) for kind, x in readings.items()}
    return preference.worse_predictions(pairs)


def test_an_error_that_rises_is_listed_and_said():
    readings = held_out(4.3, 4.3)
    readings["voltage"][1][:, 1] = 4.72
    found = worse(readings)
    assert found == (WorseChannel("voltage", "motor_speed", 10, pytest.approx(4.3), pytest.approx(4.72)),)


def test_an_error_that_falls_or_stays_is_not_said():
    readings = held_out(4.3, 4.3)
    readings["voltage"][1][:, 1], readings["voltage"][1][:, 2] = 4.0, 4.3 * 1.005
    assert worse(readings) == ()


def test_errors_are_of_the_rows_that_both_predict():
    """A fit that predicts two hard rows more is not worse for them. One that predicts fewer is said to."""
    readings = held_out(4.0, 4.0)
    before, after = readings["voltage"]
    before[:2], after[:2] = np.nan, 40.0
    assert worse(readings) == ()
    after[2:, 0] = 5.0
    assert [(w.rows, w.before, w.after) for w in worse(readings)] == [(8, 4.0, 5.0)]


# --- among alternatives ---------------------------------------------------------------------------------


def alternative(name, rms, *, leads=False, rise=0.0, lost=0):
    return HeldOutAlternative((name, "brush_drop"), leads, rise, rms, {"slope": rms}, lost)


@pytest.mark.parametrize(
    "rms, lost, first",
    [((3.0, 2.0, 2.5), (0, 0, 0), 1), ((2.01, 2.0, 2.5), (0, 0, 0), 0), ((3.0, 2.0, 2.5), (0, 3, 0), 2)],
    ids=["smallest", "a draw goes to the fit", "predicts fewer"],
)
def test_order_of_alternatives(rms, lost, first):
    rows = [alternative(n, r, lost=m) for n, r, m in zip("abc", rms, lost, strict=True)]
    assert preference._order_alternatives(rows)[0] == first


def test_another_preference_lists_the_choices():
    with refused(r"--prefer: got heldout; did you mean held-out\? allowed: fit, held-out", BadConfiguration):
        settings_for(SettledRuns, prefer="heldout")


RUNS = table(tables.narrow(["series_resistance", "tension_friction"], 12.0, seed=3))
#: The stages of a table whose effects have look-alikes, held-out data choosing.
HELD = dataclasses.replace(SETTLED, settings=dataclasses.replace(SETTLED.settings, prefer=HELD_OUT))


@pytest.fixture(scope="module")
def traced():
    return HELD.trace(RUNS)


@pytest.mark.nightly
def test_held_out_data_choose_the_leader(traced):
    by_fit = SETTLED.trace(RUNS)
    assert by_fit.verdict == "class" and by_fit.held_out == ()
    rows = traced.held_out
    assert len(rows) > 1 and rows[0].effects == by_fit.best.effects
    assert all(np.isfinite(a.rms_sigma) and a.by_kind for a in rows)
    (leader,) = (a for a in rows if a.leads)
    least = min(a.rms_sigma for a in rows)
    assert leader.rms_sigma <= (1 + preference.TOLD) * least and leader.effects == traced.best.effects


@pytest.mark.slow
def test_what_follows_is_of_the_leader_that_was_chosen(traced, monkeypatch):
    real = preference.compare_alternatives
    for k in range(1, len(traced.held_out)):

        def turned(*arguments, k=k):
            rows = enumerate(real(*arguments))
            return tuple(dataclasses.replace(a, rms_sigma=0.5 if j == k else 1.0) for j, a in rows)

        monkeypatch.setattr(preference, "compare_alternatives", turned)
        other = HELD.trace(RUNS)
        assert other.best.effects == traced.held_out[k].effects and other.held_out[k].leads
        assert other.members[0][0] == other.best.effects[0] and other.verdict == "class"
        assert {frozenset(m) for m in other.members} == {frozenset(m) for m in traced.members}
        found = HELD.result(other, RUNS)
        assert [next(iter(e.members)) for e in found.effects] == list(other.best.effects)
        assert {e.name for e in found.robot.effects} == set(other.best.effects)
