"""The adequacy test against its definition: shares of a family-wise error, ranks among bootstrap tables, margins."""

from types import SimpleNamespace

import numpy as np
import pytest

from calibration.discovery.adequacy import AdequacyTest

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
