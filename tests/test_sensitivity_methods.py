"""Indices against what is known exactly: Ishigami, linear models, correlated normals, brute force."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from calibration.sensitivity import sampled_indices
from calibration.sensitivity.sampled_indices import REPLICATES, IntervalEstimate, ratio_estimate

A, B = 7.0, 0.1


def ishigami(u):
    x = np.pi * (2 * u - 1)
    return np.sin(x[:, 0]) + A * np.sin(x[:, 1]) ** 2 + B * x[:, 2] ** 4 * np.sin(x[:, 0])


ONE, TWO = (1 + B * np.pi**4 / 5) ** 2 / 2, A**2 / 8
BOTH = B**2 * np.pi**8 * (1 / 18 - 1 / 50)
WHOLE = ONE + TWO + BOTH
FIRST, TOTAL = np.array([ONE, TWO, 0.0]) / WHOLE, np.array([ONE + BOTH, TWO, BOTH]) / WHOLE


def within(estimate, truth, widths=1.5):
    """Whether every interval, widened so that a fixed seed is no gamble, holds the truth."""
    middle, half = estimate.value, widths * (estimate.high - estimate.low) / 2
    return bool(np.all(np.abs(middle - truth) <= half + 1e-12))


@pytest.fixture(scope="module")
def design():
    return sampled_indices.sobol_design(3, 64, 1)


@pytest.fixture(scope="module")
def found(design):
    return sampled_indices.sobol_indices(sampled_indices.sobol_terms(design, ishigami(design)))


def test_sobol_indices_are_those_of_ishigami(design, found):
    assert within(found["first"], FIRST) and within(found["total"], TOTAL)
    assert np.max(found["total"].high - found["total"].low) < 0.1
    second = np.zeros((3, 3))
    second[0, 2] = second[2, 0] = BOTH / WHOLE
    pairs = np.triu_indices(3, 1)
    assert within(IntervalEstimate(*(x[pairs] for x in found["second"])), second[pairs])
    assert sampled_indices.sobol_terms(design, ishigami(design)).variance.mean() == pytest.approx(WHOLE, rel=0.02)


def test_sobol_interval_of_another_function_does_not_hold(found):
    assert not within(found["first"], FIRST[[1, 0, 2]])


def test_sobol_replicates_are_unlike_one_another(design):
    first = design.reshape(REPLICATES, -1, 3)[:, 0]
    assert len(np.unique(first, axis=0)) == REPLICATES
    again = sampled_indices.sobol_design(3, 64, 1)
    assert_array_equal(again, design)
    assert not np.array_equal(sampled_indices.sobol_design(3, 64, 2), design)


def test_sobol_leaves_out_rows_without_numbers_exactly_where_one_input_decides_them(design):
    # y = x0 + x1 with no number below x0 = 0.25: x0 is then uniform above it.
    y = np.where(design[:, 0] < 0.25, np.nan, design[:, 0] + design[:, 1])
    terms = sampled_indices.sobol_terms(design, y)
    share = 0.75**2 / (0.75**2 + 1)
    found = sampled_indices.sobol_indices(terms)
    assert within(found["first"], [share, 1 - share, 0]) and within(found["total"], [share, 1 - share, 0])
    assert terms.lost / (REPLICATES * 64) == pytest.approx(1 - 0.75**2, abs=0.01)


def test_sobol_of_nothing_but_missing_numbers_is_none(design):
    assert sampled_indices.sobol_terms(design, np.full(len(design), np.nan)) is None


def test_sobol_of_several_outputs_together_weighs_them_by_their_variance(design):
    a, b = design[:, 0], 3 * design[:, 1]
    both = sampled_indices.sobol_terms(design, a) + sampled_indices.sobol_terms(design, b)
    assert within(sampled_indices.sobol_indices(both)["total"], [0.1, 0.9, 0.0])


def test_sobol_inputs_that_do_not_act_add_nothing_to_pairs():
    design = sampled_indices.sobol_design(2, 64, 3)
    narrow = sampled_indices.sobol_terms(design, design[:, 0] * design[:, 1])
    wide = sampled_indices.sobol_indices(narrow.widened((1, 3), 4))
    assert wide["second"].value[0, 1] == 0 and wide["second"].value[0, 2] == 0
    assert wide["second"].value[1, 3] == sampled_indices.sobol_indices(narrow)["second"].value[0, 1] != 0


def test_constant_output_has_no_indices(design):
    found = sampled_indices.sobol_indices(sampled_indices.sobol_terms(design, np.ones(len(design))))
    assert np.isnan(found["first"].value).all()


def test_size_covers_the_evaluations_that_are_asked_for():
    for evaluations in (1_000, 100_000, 123_456):
        size = sampled_indices.base_point_count(evaluations, 5)
        assert size * REPLICATES * 12 >= evaluations and size & (size - 1) == 0


@pytest.mark.nightly
@pytest.mark.parametrize("size", [8, 128])
def test_sobol_intervals_cover_in_ninety_to_ninety_eight_of_a_hundred(size):
    held = np.zeros((2, 3))
    for seed in range(200):
        design = sampled_indices.sobol_design(3, size, seed)
        found = sampled_indices.sobol_indices(sampled_indices.sobol_terms(design, ishigami(design)))
        for k, (e, truth) in enumerate(((found["first"], FIRST), (found["total"], TOTAL))):
            held[k] += (e.low <= truth) & (truth <= e.high)
    assert np.all((held / 200 >= 0.9) & (held / 200 <= 0.98)), held / 200


# --- Morris -------------------------------------------------------------------------------------------------------


def test_elementary_effects_of_a_linear_model_are_its_slopes():
    u = sampled_indices.morris_design(3, 40, 0)
    effects, lost = sampled_indices.elementary_effects(u, u @ np.array([1.0, -2.0, 0.0]))
    assert lost == 0
    assert_allclose(effects["mean_effect"].value, [1, -2, 0], atol=1e-12)
    assert_allclose(effects["mean_absolute_effect"].value, [1, 2, 0], atol=1e-12)
    assert_allclose(effects["sd_effect"].value, 0, atol=1e-12)
    assert_allclose(effects["mean_absolute_effect"].high, [1, 2, 0], atol=1e-12)


def test_elementary_effects_tell_what_is_not_linear_and_leave_out_whole_trajectories():
    u = sampled_indices.morris_design(2, 200, 0)
    y = np.where(u[:, 1] > 0.9, np.nan, u[:, 0] ** 2 + u[:, 1])
    effects, lost = sampled_indices.elementary_effects(u, y)
    assert lost == np.isnan(y.reshape(200, 3)).any(1).sum() > 0
    spread = effects["sd_effect"].value
    assert spread[0] > 0.05 and spread[1] == pytest.approx(0, abs=1e-12)


def test_morris_design_is_repeatable_and_leaves_the_global_generator_alone():
    np.random.seed(3)  # noqa: NPY002
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    first = sampled_indices.morris_design(3, 10, 5)
    assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002
    assert_array_equal(first, sampled_indices.morris_design(3, 10, 5))


def test_ratio_interval_is_that_of_students_t_for_a_constant_denominator():
    x = np.array([1.0, 2.0, 4.0, 3.0])
    e = ratio_estimate(x[:, None], np.full(4, 2.0))
    assert e.value[0] == 1.25
    assert e.high[0] - e.value[0] == pytest.approx(3.182446 * x.std(ddof=1) / 2 / 2, rel=1e-6)
