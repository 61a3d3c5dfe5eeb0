"""Parameters whose misfit is a staircase are scanned: a delay of coarse samples is found, and its interval is honest."""

import dataclasses
import functools
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from test_rig_histories import drive, history

from calibration.inference import noise, observers, priors, scans
from calibration.inference.calibration import calibrate
from calibration.inference.identifiability import Z95
from calibration.inference.observers import time_histories
from calibration.inference.optimizers import evaluate_residuals
from calibration.inference.scans import Scan
from mmrjax.model import params

OPTIONS = {"model": "drive", "starts": 1, "blocks": False, "profiles": False}
TRUTH = 0.0312


@pytest.fixture(scope="module")
def coarse(tmp_path_factory):
    """A bench whose current rises within a millisecond and is read every 20 ms, 31 ms late."""
    folder = tmp_path_factory.mktemp("coarse")
    robot = drive(folder, "total_current", motor="inductance = 1e-3", rig='delay = "0 ± 0.02"')
    truth = params.replace(robot, {"rig.delay": TRUTH, "bench.loss_coulomb": 0.24})
    t = np.arange(0, 0.32, 0.02)
    columns = {"time_s": t, "supply_voltage_V": np.where(t < 0.16, 12.0, 6.0)}
    runs = history(folder, robot, truth, columns, [0.02], 1)
    return robot, runs


def posed(robot, runs):
    kind = observers.observer_kind(runs)
    names = ("bench.loss_coulomb", "rig.delay")
    return observers.pose_problem(
        runs, robot, priors.parameter_coordinates(robot, names), noise.noise_from_table(runs, kind.sizes(runs)).sd
    )


@pytest.mark.slow
def test_a_calibration_states_the_delay_that_its_profile_shows(coarse):
    robot, runs = coarse
    found = calibrate(runs, robot, free=("bench.loss_coulomb", "rig.delay"), **OPTIONS)
    delay = found.parameters["rig.delay"]
    low, high = delay.interval
    assert found.converged
    assert low <= TRUTH <= high and 0.02 < low < high < 0.04
    assert abs(delay.value - TRUTH) < 4 * delay.sd < 0.01
    assert high - low == pytest.approx(4 * delay.sd, rel=0.35)


@pytest.mark.slow
def test_a_scan_sees_the_misfit_of_runs_at_each_delay(coarse):
    """A delay shifts one run: where the others are held, the scan's objective is that of a run of its own."""
    robot, runs = coarse
    problem = posed(robot, runs)
    only = dataclasses.replace(problem, coordinates=priors.parameter_coordinates(robot, ("rig.delay",)))
    only = only.with_data(centre=only.data.centre[:1])
    at = np.array([-0.5, 0.3, 1.1, 1.6])
    cost, others = only.observe.scan(only, np.zeros(1), 0, at)
    alone = [0.5 * np.sum(np.asarray(evaluate_residuals(only, z)) ** 2) for z in at[:, None]]
    assert_allclose(cost, alone, rtol=1e-9)
    assert_array_equal(np.asarray(others)[:, 0], at)


@pytest.mark.slow
def test_a_scan_is_as_fine_as_the_rise_of_a_current(coarse):
    robot, runs = coarse
    problem = posed(robot, runs)
    assert problem.observe.scanned(problem) == (1,)
    count = problem.observe.number_of_scan_points(problem, 1)
    assert 2 * scans.RANGE * 0.02 / count <= 0.5 * 1e-3 / 3.0


def test_the_interval_of_a_scan_holds_every_basin_that_may_be():
    """Two basins that differ by 1 σ² and a wall between them. A third one, 6 σ² higher, is out."""
    at = np.linspace(-4, 4, 801)
    rise = np.minimum(np.minimum(((at - 1) / 0.1) ** 2, ((at + 1) / 0.1) ** 2 + 1), ((at - 3) / 0.1) ** 2 + 6)
    seen = Scan(at, 0.5 * rise, at[:, None])
    low, high = seen.interval()
    assert low == pytest.approx(-1 - 0.1 * (1.96**2 - 1) ** 0.5, abs=0.01)
    assert high == pytest.approx(1 + 0.1 * 1.96, abs=0.01)
    assert seen.parts() == 2 and seen.open() == (False, False)
    assert [round(at[k], 2) for k in seen.local_minima()] == [1.0, -1.0, 3.0]
    weights = np.array([1.0, np.exp(-0.5), np.exp(-3.0)])
    places = np.array([1.0, -1.0, 3.0])
    middle = weights @ places / weights.sum()
    spread = (weights @ (places - middle) ** 2 / weights.sum() + 0.01) ** 0.5
    assert seen.sd() == pytest.approx(spread, rel=0.01)


def test_a_scan_of_one_smooth_basin_is_the_curvature():
    at = np.linspace(-4, 4, 801)
    seen = Scan(at, 0.5 * ((at - 0.5) / 0.2) ** 2, at[:, None])
    assert seen.sd() == pytest.approx(0.2, rel=1e-3)
    assert seen.interval() == pytest.approx((0.5 - 0.392, 0.5 + 0.392), abs=1e-3)
    assert seen.parts() == 1


def test_searches_that_converged_elsewhere_are_counted():
    at = np.linspace(-4, 4, 801)
    seen = {1: Scan(at, 0.5 * ((at - 0.5) / 0.1) ** 2, at[:, None])}
    ends = np.array([[0.0, 0.5], [9.0, 0.55], [0.0, -1.0], [0.0, -1.0]])
    converged = np.array([True, True, True, False])
    assert scans.count_outside(seen, ends, converged) == 1
    assert scans.count_outside({}, ends, converged) == scans.count_outside(seen, None, converged) == 0


def test_a_fit_that_may_be_proposed_goes_on_until_it_is_an_optimum(monkeypatch):
    """A fit that has used up its steps and lies within a class's margin of the lowest one goes on from its end."""
    calls, distances = [], []

    def ended(evaluate, starts, *_, within):
        calls.append(np.asarray(starts))
        distances.append(within)
        cost = np.array([100.0, 102.0, 110.0]) - len(calls)
        return SimpleNamespace(
            z=np.asarray(starts) + 1,
            cost=cost,
            converged=np.array([True, len(calls) > 1, False]),
            steps=np.full(3, 30),
        ), None

    monkeypatch.setattr(time_histories.optimizers, "search_rollouts", ended)
    monkeypatch.setattr(time_histories, "parallel_evaluator", lambda *_: None)
    observer = SimpleNamespace(policy=SimpleNamespace(steps=30, batch=8))
    search = functools.partial(time_histories.Histories.search, observer, SimpleNamespace(data=None))
    found, _ = search(np.zeros((3, 2)), np.ones(3))
    assert len(calls) == 2 and calls[1].tolist() == [[1.0, 1.0]] * 3 and found.converged[1]
    calls.clear()
    search(np.zeros((3, 2)), np.ones(3), most=6)  # as many steps as are stated
    assert len(calls) == 1
    search(np.zeros((3, 2)), np.arange(3), most=6)  # fits of different readings have no lowest one
    assert distances == [time_histories.NEAR] * 3 + [np.inf]


def test_a_scan_sees_a_minimum_that_no_point_of_its_grid_is_in():
    """A stiff joint's: 0.01 prior sds wide where points are 0.27 apart, and a slope beyond it. z is the minimum."""
    at, width = -0.764, 0.01

    def scan(problem, z, k, values):
        x = np.asarray(values)
        cost = np.minimum(0.5 * ((x - at) / width) ** 2, 800.0 + 100.0 * x)
        return cost, np.stack([x, np.zeros_like(x)], 1)

    problem = SimpleNamespace(observe=SimpleNamespace(number_of_scan_points=lambda problem, k: 32, scan=scan))
    low, high = scans.scan_coordinate(problem, np.array([at, 0.0]), 0).interval()
    assert_allclose([low, high], [at - Z95 * width, at + Z95 * width], atol=0.2 * width)
