"""The adequacy test against its definition: shares of a family-wise error, ranks among bootstrap tables, margins."""

from types import SimpleNamespace

import numpy as np
import pytest

from calibration.discovery.adequacy import AdequacyTest
from calibration.discovery.score_tests import StrongestStatistics

SETTINGS = SimpleNamespace(
    shares={"single": 0.05, "curve": 0.1}, margins={"single": 1.0, "curve": 2.0}, family_wise_error=0.15
)
NULL = SimpleNamespace(single=np.arange(1.0, 100.0), curve=np.arange(1.0, 100.0))


def judged(single, curve):
    return AdequacyTest(SimpleNamespace(single=single, curve=curve), NULL, SETTINGS)


def test_p_is_the_rank_among_the_bootstrap_tables():
    test = judged(95.5, 50.0)
    assert test.p("single") == pytest.approx(5 / 100) and test.p("curve") == pytest.approx(51 / 100)
    assert judged(1e9, 0.0).p("single") == pytest.approx(1 / 100)  # never 0
    assert test.p_value == pytest.approx(0.05 * 0.15 / 0.05)


def test_rejected_at_the_share_of_each_kind():
    assert judged(95.5, 0.0).rejected and not judged(94.5, 0.0).rejected
    assert judged(0.0, 90.5).rejected and not judged(0.0, 89.5).rejected


def test_rejected_with_margin_is_above_the_threshold_by_the_margin():
    threshold = judged(0.0, 0.0).threshold("single")
    assert threshold == 95.0  # 94 of 99 are below
    assert not judged(threshold + 0.9, 0.0).rejected_with_margin
    assert judged(threshold + 1.1, 0.0).rejected_with_margin


@pytest.mark.parametrize(
    "gain, chi2, stands", [(5.4, 1, False), (19.0, 1, True), (5.4, 99, True)],
    ids=["refuted", "confirmed", "other statistic"],
)  # fmt: skip
def test_score_of_a_log_that_its_simulation_refutes_is_no_finding(gain, chi2, stands):
    """A start of a vehicle that slips is not linear: 4.4 sigma of a score were 2.3 in the simulation."""
    zeros = np.zeros(99)
    null = StrongestStatistics(
        np.linspace(1, 4, 99), np.linspace(1, 20, 99), zeros, np.linspace(1, 9, 99), zeros, zeros
    )
    settings = SimpleNamespace(shares={"single": 0.03, "pair": 0.03, "chi2": 0.03}, family_wise_error=0.05)
    found = StrongestStatistics(np.asarray(4.4), np.asarray(30.0), *(np.asarray(float(x)) for x in (0, chi2, 0, 1)))
    test = AdequacyTest(found, null, settings)
    confirmed = test.confirmed(gain)
    assert test.rejected and confirmed.rejected == stands
    assert confirmed.found.single == pytest.approx(gain**0.5)
    assert confirmed.found.pair == pytest.approx(30 - 4.4**2 + gain)
