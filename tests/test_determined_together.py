"""Parameters that trade against each other are determined only together, and in which combination."""

import numpy as np
import pytest
from numpy.random import default_rng

from calibration.data.posterior_file import LOG, NORMAL, Posterior
from calibration.described import describe
from calibration.inference.fit_notes import determination
from calibration.inference.identifiability import determined_together, undetermined_names


def posterior(correlation, kinds, spread=(1.0, 1.0), value=(3.0, 5.0)):
    """Of two parameters and a third that is known by itself."""
    covariance = np.diag([0.25, 0.25, 0.01])
    covariance[0, 1] = covariance[1, 0] = 0.25 * correlation
    location = [np.log(v) if kind == LOG else v for v, kind in zip(value, kinds, strict=True)]
    wide = np.full(3, np.inf)
    return Posterior(
        ("a", "b", "c"), ("", "", ""), np.zeros(3), covariance, np.array([*location, 1.0]), np.array([*spread, 1.0]),
        -wide, wide, np.zeros(3), (*kinds, NORMAL),
    )  # fmt: skip


@pytest.mark.parametrize("correlation, kinds, spread, form, weight", [
    (0.99, (LOG, LOG), (0.1, 0.1), "ratio", -3 / 5),
    (-0.99, (LOG, LOG), (0.1, 0.11), "product", 3 / 5 / 1.1),
    (0.99, (LOG, LOG), (0.2, 0.1), "linear", -2 * 3 / 5),
    (-0.999, (NORMAL, NORMAL), (0.1, 0.4), "linear", 0.25),
])  # fmt: skip
def test_the_combination_is_the_one_that_varies_least(correlation, kinds, spread, form, weight):
    found = posterior(correlation, kinds, spread)
    (pair,) = determined_together(found)
    assert (pair.one, pair.other, pair.form) == ("a", "b", form) and pair.weight == pytest.approx(weight)
    a, b, _ = found.at(default_rng(1).standard_normal((4000, 3)) @ found.root.T * 0.1).T
    combined, alone = a + pair.weight * b, a
    if form != "linear":
        alone = np.log(a)
        combined = alone + np.log(b) * {"ratio": -1, "product": 1}[form]
    assert np.std(combined) < 0.2 * np.std(alone)
    determined = [describe(determination(n, False, (pair,))) for n in "abc"]
    assert determined == ["only with b", "only with a", "yes"]


def test_a_pair_that_priors_hold_or_that_hardly_trades_is_none():
    assert determined_together(posterior(0.94, (LOG, LOG))) == ()
    assert determined_together(posterior(0.99, (LOG, LOG)), held_names=("a", "b")) == ()
    pairs = determined_together(posterior(0.99, (LOG, LOG)), held_names=("a",))  # b is known by the prior of a
    assert describe(determination("a", True, pairs)) == "only with b"
    assert describe(determination("c", True, pairs)) == "no"
    assert undetermined_names(("a", "c"), pairs) == ("c",)
