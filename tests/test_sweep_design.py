"""Designs of sweeps: each point is known from its number, whatever the chunk. Distributions are what they state."""

import itertools

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from calibration.data.input_errors import BadConfiguration
from calibration.inference import priors
from mmrjax.model import paper_robots, params
from sweeps.config_campaign import Campaign
from sweeps.points import axes
from sweeps.points import sampled_design as design
from sweeps.points.sampled_design import Blocks, Design
from tests.commands import refused

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


@pytest.mark.parametrize("number", [1, 2, 3, 10, 97, 1024, 5041])
def test_permutation_has_each_number_once(number):
    found = design.keyed_permutation(17, number, np.arange(number, dtype=np.uint64))
    assert sorted(found.tolist()) == list(range(number))


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


@pytest.mark.parametrize("kind", design.DESIGNS)
def test_unit_numbers_are_uniform_and_inside(kind):
    unit = design.DESIGNS[kind](1, 4096, 3, 0, 4096)
    assert unit.min() > 0 and unit.max() < 1
    assert all(stats.kstest(row, "uniform").pvalue > 1e-4 for row in unit)


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

RANGE = {"start": 0, "stop": 20, "number": 5}
UNIFORM = {"distribution": "uniform", "low": 0, "high": 8}
SAMPLES = {"design": "sobol", "number": 8, "over": {"payload": UNIFORM}}
BAD = {
    "unknown name": ({"axes": {"slope": [1]}}, r"plan\.toml, axes\.slope: neither a parameter of the robot nor a condition; did you mean slope_deg.*allowed: configuration, voltage"),
    "no values": ({"axes": {"voltage": []}}, r"axes\.voltage: got no values; expected at least one"),
    "range of none": ({"axes": {"voltage": RANGE | {"number": 0}}}, r"axes\.voltage\.number: got 0; expected a whole number from 1"),
    "range upside down": ({"axes": {"slope_deg": RANGE | {"start": 30}}}, r"axes\.slope_deg: got start 30, stop 20, number 5; expected start below stop"),
    "range with a wrong key": ({"axes": {"slope_deg": RANGE | {"steps": 3}}}, r"axes\.slope_deg\.steps: no such key; .*allowed: start, stop, number, scale"),
    "range without number": ({"axes": {"slope_deg": {"start": 0, "stop": 3}}}, r"axes\.slope_deg: number is missing; expected start, stop, number"),
    "range on no scale": ({"axes": {"slope_deg": RANGE | {"scale": "sqrt"}}}, r"scale: got 'sqrt'; allowed: linear, log"),
    "logarithm of zero": ({"axes": {"slope_deg": RANGE | {"scale": "log"}}}, r"start: got 0; expected a number above 0 with scale log"),
    "steps upside down": ({"axes": {"slope_deg": "20:0:5"}}, r"axes\.slope_deg: got 20:0:5, which ends before it begins; expected first:last:step"),
    "a word": ({"axes": {"voltage": [15, "high"]}}, r"axes\.voltage: got 'high'; expected a number"),
    "twice the same": ({"axes": {"voltage": [15, 15]}}, r"axes\.voltage: got a value twice"),
    "out of bounds": ({"axes": {"slope_deg": [0, 95]}}, r"axes\.slope_deg: got 95; expected -45 to 45 deg \(slope"),
    "parameter out of bounds": ({"axes": {"motor.resistance": [-1]}}, r"axes\.motor\.resistance: got -1; expected 0"),
    "unknown configuration": ({"axes": {"configuration": ["8T"]}}, r"axes\.configuration: got '8T'; the robot has no such configuration; allowed: 6T2A, 4W2T"),
    "nothing varies": ({}, r"plan\.toml: no \[axes\] or \[samples\]"),
    "stated twice": ({"axes": {"payload": [1]}, "samples": SAMPLES}, r"plan\.toml, payload: given twice"),
    "also fixed": ({"axes": {"payload": [1]}, "conditions": {"payload": 2}}, r"payload: given twice; give it once, under conditions"),
    "surface and adhesion": ({"axes": {"adhesion": [1]}, "conditions": {"surface": "asphalt"}}, r"conditions\.surface: got asphalt in addition to adhesion"),
    "unknown surface": ({"axes": {"payload": [1]}, "conditions": {"surface": "ice"}}, r"conditions\.surface: got 'ice'; allowed: linoleum"),
    "unknown condition": ({"axes": {"payload": [1]}, "conditions": {"volts": 3}}, r"conditions\.volts: no such condition; did you mean voltage"),
    "condition out of bounds": ({"axes": {"payload": [1]}, "conditions": {"voltage": 30000}}, r"conditions\.voltage: got 30000; expected -10000 to 10000 V"),
    "unknown design": ({"samples": SAMPLES | {"design": "halton"}}, r"samples\.design: got 'halton'; allowed: latin_hypercube, sobol, random"),
    "list of designs": ({"samples": SAMPLES | {"design": ["sobol"]}}, r"samples\.design: got \['sobol'\]; .*allowed: latin_hypercube"),
    "list of distributions": ({"samples": SAMPLES | {"over": {"payload": UNIFORM | {"distribution": ["uniform"]}}}}, r"payload\.distribution: got \['uniform'\]; .*"),
    "list of surfaces": ({"axes": {"payload": [1]}, "conditions": {"surface": ["asphalt"]}}, r"conditions\.surface: got \['asphalt'\]; .*"),
    "truth of a voltage": ({"axes": {"voltage": [True]}}, r"axes\.voltage: got True; expected a number"),
    "no samples": ({"samples": SAMPLES | {"number": 0}}, r"samples\.number: got 0; expected a whole number from 1"),
    "negative seed": ({"samples": SAMPLES | {"seed": -1}}, r"samples\.seed: got -1; expected a whole number from 0"),
    "nothing sampled": ({"samples": {"design": "sobol", "number": 8}}, r"samples: nothing to sample; give a table `over` of names and distributions, or `posterior`"),
    "unknown key of samples": ({"samples": SAMPLES | {"count": 3}}, r"samples\.count: no such key"),
    "over is a list": ({"samples": SAMPLES | {"over": ["payload"]}}, r"samples\.over: got \['payload'\]; expected a table"),
    "unknown distribution": ({"samples": SAMPLES | {"over": {"payload": "gauss"}}}, r"samples\.over\.payload\.distribution: got 'gauss'; allowed: uniform"),
    "distribution upside down": ({"samples": SAMPLES | {"over": {"payload": UNIFORM | {"low": 9}}}}, r"over\.payload: got low 9, high 8; expected low below high"),
    "sd of zero": ({"samples": SAMPLES | {"over": {"payload": {"distribution": "normal", "mean": 4, "sd": 0}}}}, r"over\.payload\.sd: got 0; expected more than 0"),
    "distribution out of bounds": ({"samples": SAMPLES | {"over": {"slope_deg": UNIFORM | {"high": 90}}}}, r"over\.slope_deg: got 90; expected -45 to 45"),
    "condition has no prior": ({"samples": SAMPLES | {"over": {"payload": "prior"}}}, r"over\.payload: payload has no prior; expected one of uniform"),
    "sampled configuration": ({"samples": SAMPLES | {"over": {"configuration": UNIFORM}}}, r"over\.configuration: cannot be sampled"),
    "logarithm from zero": ({"samples": SAMPLES | {"over": {"payload": {**UNIFORM, "distribution": "loguniform"}}}}, r"over\.payload\.low: got 0; expected a number above 0 with loguniform"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_designs_are_refused_with_place_value_and_choices(case, nominal):
    tables, message = BAD[case]
    with refused(message, BadConfiguration):
        planned(nominal, **tables)


@pytest.mark.parametrize("stated, values", [([False, True], [0, 1]), (True, [1]), ([0, 1], [0, 1])])
def test_battery_is_an_axis_of_truth_values_too(nominal, stated, values):
    assert planned(nominal, axes={"battery": stated}).design.axes["battery"].tolist() == values


def test_more_points_than_numbers_are_refused(nominal):
    many = {"start": 1.0, "stop": 2.0, "number": 4_000_000}
    with refused(r"points; expected at most", BadConfiguration):
        planned(nominal, axes={n: many for n in ("voltage", "payload", "slope_deg")})
    with refused(r"number: got 20000000; expected a whole number from 1 to 10000000", BadConfiguration):
        planned(nominal, axes={"voltage": many | {"number": 20_000_000}})
