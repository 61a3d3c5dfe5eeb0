"""Tables of runs and draws of a posterior as sweeps: their points, chunks that are taken up again, runs in parts."""

import contextlib
import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from calibration.data.runs import Runs
from mmrjax import fidelities
from mmrjax.fidelities.base import RunBatch
from mmrjax.fidelities.steady import steady_batch
from mmrjax.model import params
from sweeps import config
from sweeps.points import run, scale
from sweeps.points.sampled_design import DrawnSamples
from sweeps.store import RunFolder
from tests.test_sweep_posterior import NAMES, correlated_posterior

DRAWS = 12


@pytest.fixture(scope="module")
def runs(robot):
    """Of both configurations. The last one slides."""
    columns = {
        "configuration": np.array(["6T2A", "4W2T", "6T2A", "6T2A"]), "supply_voltage_V": np.array([24.0, 33.0, 15.0, 24.0]),
        "payload_kg": np.array([0.0, 3.0, 8.0, 0.0]), "slope_deg": np.array([0.0, 5.0, 5.0, 20.0]),
    }  # fmt: skip
    return Runs("a table", columns)


@pytest.fixture(scope="module")
def posterior():
    return correlated_posterior()


def chunked(chunk):
    return config.Sweep(chunk=chunk)


def same(one, other, rtol=0.0):
    assert list(one) == list(other)
    for name, values in other.items():
        if values.dtype.kind == "f":
            assert_allclose(one[name], values, rtol=rtol, err_msg=name)
        else:
            assert np.array_equal(one[name], values), name


def test_points_of_a_table_are_its_runs_each_with_every_draw(robot, runs, posterior):
    drawn = DrawnSamples(posterior.names, posterior.draw(DRAWS, 0).T)
    job = run.job_of_run_table(robot, runs, chunked(5), drawn)
    assert job.plan.design.shape == (4, DRAWS) and job.blocks.size == (1, 4)
    points = job.plan.design.values_in_slices((slice(1, 3), slice(2, 5)))
    assert_array_equal(points[:, 0], np.repeat([1.0, 2.0], 3))
    assert_array_equal(points[:, 1:], np.tile(posterior.draw(DRAWS, 0)[2:5], (2, 1)))


@pytest.mark.slow
@pytest.mark.parametrize("chunk", [None, 3])
def test_table_has_each_run_as_it_is_by_itself(robot, runs, chunk):
    found = run.evaluate_runs(robot, runs, chunked(chunk), None)
    alone = run.ending_columns(robot, RunBatch(steady_batch(robot, runs.conditions(robot))))
    same({name: found[name] for name in alone}, alone, rtol=1e-12)
    assert found["status"].tolist() == ["converged"] * 3 + ["slides"]
    assert found["total_mass_kg"][1] == float(robot.configurations.members[1].mass) + 3


@pytest.mark.slow
def test_draws_have_the_intervals_of_robots_simulated_one_by_one(robot, runs, posterior):
    found = run.simulate_draws(robot, posterior, runs, chunked(None), DRAWS)
    each = [
        run.evaluate_runs(params.replace(robot, dict(zip(NAMES, theta, strict=True))), runs, chunked(None), None)
        for theta in posterior.draw(DRAWS, run.SEED)
    ]
    speeds = np.array([table["speed_mm_s"] for table in each])
    assert_allclose(found["speed_mm_s_sd"][:3], speeds.std(0, ddof=1)[:3], rtol=1e-9)
    low = np.quantile(speeds[:, :3], run.QUANTILES[0], axis=0)
    assert_allclose(found["speed_mm_s_lower"][:3], low, rtol=1e-12)
    assert found[run.CONVERGED_SHARE].tolist() == [1, 1, 1, 0] and np.isnan(found["speed_mm_s_sd"][3])


@pytest.mark.slow
def test_chunks_of_draws_change_no_interval(robot, runs, posterior):
    """Of a run all draws in one chunk, some runs in each, and a run's draws in three."""
    whole = run.simulate_draws(robot, posterior, runs, chunked(2 * DRAWS), DRAWS)
    parted = run.simulate_draws(robot, posterior, runs, chunked(4), DRAWS)
    same(whole, parted, rtol=1e-9)


@pytest.mark.slow
def test_interrupted_draws_are_resumed(robot, runs, posterior, tmp_path, monkeypatch):
    whole = run.simulate_draws(robot, posterior, runs, chunked(DRAWS), DRAWS)
    folder, computed, honest = RunFolder(tmp_path / "r", {}), [], scale.CompiledJob.__call__

    def interrupted(compiled, values, *told):
        if len(computed) == 2:
            raise KeyboardInterrupt
        computed.append(compiled)
        return honest(compiled, values, *told)

    monkeypatch.setattr(scale.CompiledJob, "__call__", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run.simulate_draws(robot, posterior, runs, chunked(DRAWS), DRAWS, folder)
    kept = len(list((tmp_path / "r.partial/chunks").glob("draws-*.stage")))
    assert kept <= 2
    computed.clear()
    monkeypatch.setattr(scale.CompiledJob, "__call__", lambda *a: (computed.append(1), honest(*a))[1])
    same(run.simulate_draws(robot, posterior, runs, chunked(DRAWS), DRAWS, folder), whole)
    assert len(computed) == 4 - kept
    again = run.simulate_draws(robot, posterior, runs, chunked(DRAWS), DRAWS, folder)
    assert len(computed) == 4 - kept  # nothing is left to do
    same(again, whole)
    folder.close()


@pytest.mark.slow
def test_slow_computations_run_in_parts_and_report_their_share(robot, runs, monkeypatch):
    from mmrjax.fidelities import steady

    honest = steady.FIDELITY

    def in_two(robot, conditions, options, progress=None):
        progress(0.5)
        return honest.run(robot, conditions, options)

    plain, said = run.evaluate_runs(robot, runs, chunked(2), None), []
    monkeypatch.setitem(
        fidelities.TABLE, "steady", dataclasses.replace(fidelities.fidelity_facts("steady"), slow=True)
    )
    monkeypatch.setattr(steady, "FIDELITY", dataclasses.replace(honest, run=in_two))
    monkeypatch.setattr(run, "progress_bar", lambda *_, **__: contextlib.nullcontext(said.append))
    found = run.evaluate_runs(robot, runs, chunked(2), None)
    same(found, plain, rtol=1e-12)
    assert said.count(1.0) == 4 and sum(said) == 4  # two chunks, two parts each


def test_chunks_are_filled_up_to_share_programs(robot, runs):
    """Of settled points those of few too. What runs over time takes longer than its program does to compile."""
    many = dataclasses.replace(runs, columns={k: np.tile(v, 4200) for k, v in runs.columns.items()})
    sizes = [scale.CompiledJob(run.job_of_run_table(robot, r, chunked(None))).size for r in (runs, many)]
    assert sizes == [fidelities.FEW, 2 * scale.PADDING_MULTIPLE]
    assert scale.CompiledJob(run.job_of_run_table(robot, runs, config.Simulate(model="drive"))).size == 4
