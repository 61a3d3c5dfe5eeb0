"""Designs of sweeps: each point is known from its number, whatever the chunk. Distributions are what they state."""

import itertools

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from calibration.inference import priors
from mmrjax.model import paper_robots, params
from sweeps.config_campaign import Campaign
from sweeps.points import axes
from sweeps.points import sampled_design as design
from sweeps.points.sampled_design import Blocks, Design

SCIPY = {
    "uniform": ({"low": 2.0, "high": 6.0}, stats.uniform(2, 4)),
    "loguniform": ({"low": 2.0, "high": 6.0}, stats.loguniform(2, 6)),
    "normal": ({"mean": 4.0, "sd": 0.5}, stats.norm(4, 0.5)),
    "lognormal": ({"median": 4.0, "sd_log": 0.2}, stats.lognorm(0.2, scale=4)),
    "triangular": ({"low": 2.0, "mode": 3.0, "high": 6.0}, stats.triang(0.25, 2, 4)),
}


@pytest.fixture(scope="module")
def nominal():
    return paper_robots.nominal()


def planned(robot, **tables):
    return axes.plan_design(Campaign(**tables), robot, "plan.toml")


def sampled(robot, kind="latin_hypercube", number=1000, seed=5, **over):
    over = over or {"payload": {"distribution": "uniform", "low": 0, "high": 8}, "motor.resistance": "prior"}
    return planned(robot, samples={"design": kind, "number": number, "seed": seed, "over": over}).design


# --- single points --------------------------------------------------------------------------------------


@pytest.mark.parametrize("most", [30, pytest.param(300, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", design.DESIGNS)
def test_points_do_not_depend_on_how_they_are_cut(kind, most, nominal):
    samples = sampled(nominal, kind, number=10_000).samples
    whole = samples.values(0, 10_000)
    for size in (1, 7, 4096, 9999):
        parts = [samples.values(k, min(size, 10_000 - k)) for k in range(0, 10_000, size)[:most]]
        cut = np.concatenate(parts, axis=1)
        assert np.array_equal(cut, whole[:, : cut.shape[1]])
    assert np.array_equal(samples.values(7777, 1)[:, 0], whole[:, 7777])


@pytest.mark.parametrize("kind", design.DESIGNS)
def test_seed_is_another_design_and_the_same_again(kind, nominal):
    one, again, other = (sampled(nominal, kind, seed=s).samples.values(0, 1000) for s in (5, 5, 6))
    assert np.array_equal(one, again) and not np.any(one == other)


def test_permutation_of_many_points_is_spread_and_not_the_identity():
    number = 10**12
    points = np.arange(0, 10_000, dtype=np.uint64)
    found = design.keyed_permutation(17, number, points).astype(float) / number
    assert stats.kstest(found, "uniform").pvalue > 1e-4
    assert abs(np.corrcoef(found[:-1], found[1:])[0, 1]) < 0.05
    assert not np.array_equal(found, design.keyed_permutation(18, number, points) / number)


def test_latin_hypercube_has_one_point_in_each_slice():
    unit = design.latin_hypercube(3, 500, 4, 0, 500)
    for row in unit:
        assert sorted((row * 500).astype(int)) == list(range(500))
    assert np.abs(np.corrcoef(unit) - np.eye(4)).max() < 0.2


@pytest.mark.parametrize("dimensions", [1, 5, 40])
def test_sobol_is_the_sequence_of_scipy(dimensions):
    engine = stats.qmc.Sobol(dimensions, scramble=True, bits=design.BITS, rng=np.random.default_rng(9))
    expected = engine.random(2**14)
    found = design.sobol(9, 2**14, dimensions, 0, 2**14).T
    assert np.abs(found - expected).max() <= 2.0**-design.BITS  # half a cell off 0
    engine.random(100_000 - 2**14)  # its fast_forward takes no more than 32 bits
    assert np.abs(design.sobol(9, 0, dimensions, 100_000, 64).T - engine.random(64)).max() <= 2.0**-design.BITS


# --- distributions ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", SCIPY)
def test_distribution_is_that_of_scipy(kind, nominal):
    numbers, expected = SCIPY[kind]
    samples = sampled(nominal, "sobol", 4096, payload={"distribution": kind, **numbers}).samples
    quantile = samples.marginals["payload"]
    u = np.linspace(0.01, 0.99, 99)
    assert_allclose(quantile(u), expected.ppf(u), rtol=1e-9)
    assert stats.kstest(samples.values(0, 4096)[0], expected.cdf).pvalue > 0.01


def test_prior_is_the_one_of_calibrate_and_sensitivity(nominal):
    found = {p.name: p for p in params.walk_parameters(nominal)}
    name = "6T2A.ground.friction.speed_static"
    assert found[name].spec.relative_sd is not None  # a scale
    u = np.linspace(0.01, 0.99, 99)
    for each in (name, "motor.resistance"):
        values = sampled(nominal, **{each: "prior"}).samples.marginals[each](u)
        expected = priors.parameter_coordinates(nominal, [each]).value(stats.norm.ppf(u)[:, None])[:, 0]
        assert_allclose(values, expected, rtol=1e-14)
    median, sd = float(found[name].value), found[name].spec.prior_sd(float(found[name].value))
    quantile = sampled(nominal, **{name: "prior"}).samples.marginals[name]
    lognormal = stats.lognorm(np.sqrt(np.log1p((sd / median) ** 2)), scale=median)
    assert_allclose(quantile(u), lognormal.ppf(u), rtol=1e-6)


def test_normal_is_cut_off_at_the_bounds(nominal):
    wide = sampled(nominal, "sobol", 4096, slope_deg={"distribution": "normal", "mean": 40, "sd": 30}).samples
    values = wide.values(0, 4096)[0]
    assert -45 <= values.min() < -40 and 44.9 < values.max() <= 45
    cut = stats.truncnorm((-45 - 40) / 30, (45 - 40) / 30, 40, 30)
    assert stats.kstest(values, cut.cdf).pvalue > 0.01


class Pair:
    """Two correlated parameters and one that follows the first."""

    names = ("motor.resistance", "payload", "motor.inductance")

    def __len__(self):
        return 2

    def values(self, scores):
        first, second = 0.8 + 0.05 * scores[:, 0], 4 + 0.5 * scores[:, 0] + 0.1 * scores[:, 1]
        return np.stack([first, second, 1e-3 * first], -1)


def test_joint_names_are_sampled_together_whatever_the_chunk():
    samples = design.Samples("sobol", 10_000, 1, {}, Pair())
    whole = samples.values(0, 10_000)
    assert whole.shape == (3, 10_000)
    assert np.corrcoef(whole)[0, 1] > 0.95 and np.array_equal(whole[2], 1e-3 * whole[0])
    assert np.array_equal(samples.values(4090, 20), whole[:, 4090:4110])


# --- grids and blocks -----------------------------------------------------------------------------------------


def test_points_of_a_grid_are_every_combination_the_last_axis_fastest(nominal):
    plan = planned(
        nominal,
        axes={
            "configuration": "all",
            "slope_deg": "0:20:10",
            "motor.resistance": {"start": 0.5, "stop": 2, "number": 3, "scale": "log"},
        },
    )
    found = plan.design.values_in_slices(tuple(slice(0, n) for n in plan.design.shape))
    assert_allclose(found, list(itertools.product([0, 1], [0, 10, 20], [0.5, 1, 2])))
    assert np.array_equal(plan.design.at(np.array([17, 4])), found[[17, 4]])


def test_grid_is_crossed_with_every_sample(nominal):
    plan = planned(
        nominal, axes={"voltage": [15, 24]},
        samples={"design": "random", "number": 5, "over": {"payload": {"distribution": "uniform", "low": 0, "high": 8}}},
    )  # fmt: skip
    found = plan.design.values_in_slices((slice(0, 2), slice(0, 5)))
    assert found[:, 0].tolist() == [15] * 5 + [24] * 5
    assert np.array_equal(found[:5, 1], found[5:, 1]) and len(set(found[:5, 1])) == 5
    assert plan.design.dimensions == ("voltage", "sample")


@pytest.mark.parametrize("shape", [(10,), (3, 7), (2, 20, 30), (4, 1, 9), (1000, 3), (5, 2, 3, 7)])
@pytest.mark.parametrize("most", [1, 4, 100, 10**6])
def test_blocks_hold_each_point_once_and_no_more_than_stated(shape, most):
    blocks = Blocks.of(shape, most)
    seen = np.zeros(shape, int)
    for k in range(len(blocks)):
        box = blocks.box(k)
        seen[box] += 1
        assert seen[box].size == blocks.count(k) <= blocks.points <= most
        assert tuple(b.start // s for b, s in zip(box, blocks.size, strict=True)) == blocks.place(k)
    assert (seen == 1).all()
    numbers = np.arange(seen.size).reshape(shape)
    order = np.concatenate([numbers[blocks.box(k)].ravel() for k in range(len(blocks))])
    assert np.array_equal(order, np.arange(seen.size))  # a chunk is a run of consecutive points


def test_points_of_blocks_are_those_of_the_whole(nominal):
    whole = sampled(nominal, number=97)
    both = Design({"voltage": np.array([15.0, 24.0])}, whole.samples)
    every = both.values_in_slices((slice(0, 2), slice(0, 97)))
    blocks = Blocks.of(both.shape, 30)
    assert np.array_equal(np.concatenate([both.values_in_slices(blocks.box(k)) for k in range(len(blocks))]), every)


# --- what is refused ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stated, values", [([False, True], [0, 1]), (True, [1]), ([0, 1], [0, 1])])
def test_battery_is_an_axis_of_truth_values_too(nominal, stated, values):
    assert planned(nominal, axes={"battery": stated}).design.axes["battery"].tolist() == values


@pytest.mark.parametrize("number", [1, 2, 3, 10, 97, 1024, 5041])
def test_permutation_has_each_number_once(number):
    found = design.keyed_permutation(17, number, np.arange(number, dtype=np.uint64))
    assert sorted(found.tolist()) == list(range(number))


@pytest.mark.parametrize("kind", design.DESIGNS)
def test_unit_numbers_are_uniform_and_inside(kind):
    unit = design.DESIGNS[kind](1, 4096, 3, 0, 4096)
    assert unit.min() > 0 and unit.max() < 1
    assert all(stats.kstest(row, "uniform").pvalue > 1e-4 for row in unit)
