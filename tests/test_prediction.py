"""Scores of data held out: against SciPy's densities, and the set of effects that is chosen by them."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx
from scipy import stats

from calibration.data.runs import Runs
from calibration.discovery import prediction
from calibration.discovery.assembly import errors_on_common_rows, worse_predictions
from calibration.discovery.prediction import Gain, HeldOutScore, score_readings, smallest_predictive_set
from calibration.discovery.result import WorseChannel
from calibration.inference.blocks import distinct_held_out_blocks, predictable_blocks, unpredictable_kinds
from mmrjax.model import channels

RNG = np.random.default_rng(2)
NONE_FREE = SimpleNamespace(names=(), tied=())
SLOPES = np.repeat([0.0, 5.0, 10.0], 4)


@pytest.fixture(scope="module")
def runs():
    rows = len(SLOPES)
    columns = {
        "configuration": np.full(rows, "6T2A"), "supply_voltage_V": np.tile([20.0, 30.0], rows // 2), "slope_deg": SLOPES,
        "payload_kg": np.zeros(rows), "motor_speed_rpm": 900 + np.arange(rows, dtype=float),
        "speed_mm_s": 700 + np.arange(rows, dtype=float),
    }  # fmt: skip
    return Runs("a table", columns)


def test_predictions_that_were_scored_before_are_those_of_the_first_time(runs, monkeypatch):
    """They decide if a model describes the runs at all. Without them every model with effects was `undescribed`."""
    measured, calls = runs.measured(), []
    monkeypatch.setattr(
        prediction, "predict_unseen", lambda *a: calls.append(a) or SimpleNamespace(reading=measured + 1)
    )
    monkeypatch.setattr(prediction.blocks_room, "predictable_blocks", lambda *_: {"slope": {"0": np.ones(12, bool)}})
    space = SimpleNamespace(
        equipped=SimpleNamespace(data=SimpleNamespace(measured=measured, sd=np.ones_like(measured))),
        weight=np.ones_like(measured), bare=None, fit_of=lambda active, z: (None, z, active),
    )  # fmt: skip
    candidate, predicted = SimpleNamespace(active=("churning",), z=np.zeros(2)), {}
    first, again = (prediction.cached_hold_out_score(space, runs, candidate, predicted) for _ in range(2))
    assert (
        len(calls) == 1
        and prediction.candidate_key(SimpleNamespace(active=("churning",), z=np.ones(2))) not in predicted
    )
    assert_array_equal(first.reading["slope"], measured + 1)
    assert_array_equal(again.reading["slope"], measured + 1)


def test_score_is_the_log_density_and_what_is_not_reached_counts(runs):
    measured, sd = RNG.standard_normal((12, 2)), RNG.uniform(0.5, 2.0, (12, 2))
    reading = {kind: measured + sd * RNG.standard_normal((12, 2)) for kind in ("slope", "voltage")}
    reading["slope"][3, 1] = np.nan
    counts = np.ones((12, 2), bool)
    counts[5] = False
    found = score_readings(reading, measured, sd, counts, distinct_held_out_blocks(runs, ("slope", "voltage")))
    for kind in reading:
        off = np.where(np.isfinite(reading[kind]), reading[kind], measured + prediction.UNREACHED * sd)
        wanted = stats.t.logpdf((off - measured) / sd, prediction.FREEDOM) - np.log(sd)
        assert_allclose(found.by_kind[kind], np.where(counts, wanted, np.nan), rtol=1e-12)
    assert [len(set(found.blocks[kind])) for kind in ("slope", "voltage")] == [3, 2]


def score(values, blocks):
    return HeldOutScore({"slope": np.asarray(values, float)[:, None]}, {"slope": np.asarray(blocks)})


def test_gain_has_the_error_of_rows_or_blocks_whichever_is_larger():
    each = RNG.standard_normal(12)
    alone = score(each, np.arange(12)).gain(score(np.zeros(12), np.arange(12)))
    assert alone.mean == pytest.approx(each.mean()) and alone.se == pytest.approx(each.std(ddof=1) / np.sqrt(12))
    alike = np.repeat(RNG.standard_normal(3), 4)  # the rows of a block share what was not seen
    blocks = np.repeat(np.arange(3), 4)
    found = score(alike, blocks).gain(score(np.zeros(12), blocks))
    assert found.se == pytest.approx(alike[::4].std(ddof=1) / np.sqrt(3))


@pytest.mark.parametrize(
    "gains, chosen",
    [
        ([0.5, 0.9, 1.0], 2),  # the third gains less than its error over the second
        ([0.02, 0.03, 0.04], 0),  # none gains more than its error over nothing
        ([0.9, -0.5, -2.0], 1),
        ([0.1, 0.2, 3.0], 3),
    ],
)
def test_smallest_set_within_one_error_of_the_best_is_chosen(monkeypatch, runs, gains, chosen):
    noise = 0.6 * RNG.standard_normal((4, 12)) * np.array([[0.0], [1.0], [1.0], [1.0]])
    noise -= noise.mean(1, keepdims=True)
    candidates = [SimpleNamespace(effects=tuple("abc"[:k])) for k in range(4)]
    scores = {c.effects: score(noise[k] + ([0.0, *gains])[k], np.arange(12)) for k, c in enumerate(candidates)}
    monkeypatch.setattr(prediction, "cached_hold_out_score", lambda space, runs, c, predicted: scores[c.effects])
    space = SimpleNamespace(
        bare=SimpleNamespace(base=None, coordinates=NONE_FREE, observe=SimpleNamespace(blocks=("slope", "voltage")))
    )
    found = smallest_predictive_set(space, runs, candidates[0], candidates[1:], {})
    assert (found is None) if chosen == 0 else (found is candidates[chosen])


def test_nothing_is_chosen_where_nothing_can_be_held_out(runs):
    space = SimpleNamespace(
        bare=SimpleNamespace(base=None, coordinates=NONE_FREE, observe=SimpleNamespace(blocks=()))
    )
    assert smallest_predictive_set(space, runs, None, [None], {}) is None
    assert HeldOutScore({"slope": np.full((2, 1), np.nan)}, {"slope": np.arange(2)}).gain(
        HeldOutScore({"slope": np.zeros((2, 1))}, {"slope": np.arange(2)})
    ) == Gain(0.0, np.inf)


@pytest.mark.parametrize(
    "names, tied, dropped",
    [
        (("motor.resistance",), (), ()),
        (("motor.resistance", "a.loss_coulomb"), (), ("a",)),
        (("a.loss_coulomb", "b.loss_coulomb"), (), ("a", "b")),
        (("a.loss_coulomb",), (("b.loss_coulomb", 0, 1.0),), ()),  # the others determine it too
        (("c.loss_coulomb",), (), ()),  # of which the table has no run
    ],
)
def test_a_block_with_parameters_of_its_own_is_not_predicted(names, tied, dropped):
    """Of two configurations at two voltages each. Runs of one at another voltage determine what is its own."""
    columns = {
        "configuration": np.repeat(["a", "b"], 4), "supply_voltage_V": np.tile([10.0, 10.0, 20.0, 20.0], 2),
        "order": np.arange(8.0),
    }  # fmt: skip
    runs = Runs("a table", columns)
    coordinates = SimpleNamespace(names=names, tied=tied)
    observe = SimpleNamespace(blocks=("configuration", "voltage"))
    problem = SimpleNamespace(base=None, coordinates=coordinates, observe=observe)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Runs, "configurations_named", lambda self, robot: self["configuration"])
        kinds, lost = predictable_blocks(runs, problem), unpredictable_kinds(runs, problem)
    assert set(kinds.get("configuration", {})) == {"a", "b"} - set(dropped)
    assert len(kinds["voltage"]) == 2 and lost == (("configuration",) if dropped else ())


# --- errors that rise -----------------------------------------------------------------------------------


def held_out(before, after):
    """Simulated readings of ten rows with these errors [%] in every channel, without and with effects."""
    return tuple(np.full((10, len(channels.USUAL)), 100.0 + x) for x in (before, after))


def worse(before, after):
    """Channels of readings whose errors rise."""
    shown, hundred = channels.channels_named(channels.USUAL), np.full((10, len(channels.USUAL)), 100.0)
    readings = SimpleNamespace(measured=hundred, sd=hundred)
    pair = errors_on_common_rows(shown, readings, np.ones(10, bool), before, after)
    return worse_predictions({"voltage": pair})


def test_an_error_that_rises_is_listed_and_said():
    before, after = held_out(4.3, 4.3)
    after[:, 1] = 104.72
    assert worse(before, after) == (WorseChannel("voltage", "motor_speed", 10, approx(4.3), approx(4.72)),)


def test_an_error_that_falls_or_stays_is_not_said():
    before, after = held_out(4.3, 4.3)
    after[:, 1], after[:, 2] = 104.0, 100 + 4.3 * 1.005
    assert worse(before, after) == ()


def test_errors_are_of_the_rows_that_both_predict():
    """A fit that predicts two hard rows more is not worse for them. One that predicts fewer is said to."""
    before, after = held_out(4.0, 4.0)
    before[:2], after[:2] = np.nan, 140.0
    assert worse(before, after) == ()
    after[2:, 0] = 105.0
    assert [(w.rows, w.before, w.after) for w in worse(before, after)] == [(8, approx(4.0), approx(5.0))]
