"""Searches by generations: what they find, what is kept, what the members say of derivatives, bad files."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from calibration.data import runs as records
from calibration.data.input_errors import BadConfiguration
from calibration.inference import identifiability, noise, observers, population, priors
from calibration.inference.calibration import calibrate
from calibration.inference.fit_notes import Remark
from calibration.inference.observers.settled import SettledRuns
from calibration.inference.problem import Observation
from mmrjax.model import channels, paper_robots
from mmrjax.model.signals import TIPS
from sweeps.store import RunFolder
from tests.commands import refused

NAMES = ("motor.resistance", "6T2A.track.loss_coulomb", "6T2A.track.loss_viscous", "6T2A.ground.rolling_resistance")
SIZE = 48


class Stepped(SettledRuns):
    """Settled rows whose current jumps where the armature's resistance passes its prior mean, as a contact would
    close."""

    def __call__(self, robot):
        seen = super().__call__(robot)
        jump = jnp.where(robot.motor.resistance > paper_robots.nominal().motor.resistance, 0.3, 0.0)
        return Observation(seen.reading.at[:, 0].add(jump), seen.adhesion_used, seen.status, seen.flags)


@pytest.fixture(scope="module")
def runs():
    table = records.read_runs("measured")
    return table.where((table["configuration"] == "6T2A") & (table["slope_deg"] < 10))


@pytest.fixture(scope="module")
def truth():
    return np.array([0.8, -0.6, 0.5, 0.9])


@pytest.fixture(scope="module")
def known(runs):
    return noise.noise_from_table(runs, SettledRuns.sizes(runs), "current=1%,motor_speed=0.2%,speed=0.2%")


@pytest.fixture(scope="module")
def posed(runs, truth, known):
    """Readings of a robot at `truth`, with priors that are right about it."""
    robot = paper_robots.nominal()
    problem = observers.pose_problem(runs, robot, priors.parameter_coordinates(robot, NAMES), known.sd)
    reading = problem.observation(jnp.asarray(truth)).reading
    return problem.with_data(measured=reading, centre=jnp.asarray(truth))


def evolve(posed, known, generations=30, seed=3, keep=lambda name, make: make()):
    size = len(NAMES)
    return population.run_evolution(
        posed, population.member_objective(posed, known), np.zeros(size), np.eye(size), size=SIZE, seed=seed,
        generations=generations, further_points=np.empty((0, size)), tell=lambda step: None, keep=keep,
    )  # fmt: skip


@pytest.fixture(scope="module")
def found(posed, known):
    return evolve(posed, known)


@pytest.mark.slow
def test_generations_come_down_to_the_truth(found, truth):
    best = found.z[found.order[0]]
    assert found.cost.min() < 0.5 and np.abs(best - truth).max() < 0.5
    lowest = [g.lowest for g in found.generations]
    assert lowest == sorted(lowest, reverse=True) and lowest[-1] < lowest[0] / 10
    assert len(found.z) == sum(g.members for g in found.generations)


@pytest.mark.slow
def test_same_seed_same_members_and_another_seed_others(posed, known, found):
    again = evolve(posed, known)
    assert_array_equal(again.z, found.z)
    assert_array_equal(again.cost, found.cost)
    assert not np.array_equal(evolve(posed, known, 1, seed=4).z, found.z[:SIZE])


@pytest.mark.slow
def test_objective_is_the_misfit_where_the_noise_is_known(posed, known, found):
    rows = jax.tree.map(lambda x: x[:3], found.observations)
    for z, cost in zip(found.z[:3], population.member_objective(posed, known)(found.z[:3], rows), strict=True):
        readings = np.asarray(posed.misfit(jnp.asarray(z)))[: posed.data.measured.size]
        lost = np.isin(np.asarray(posed.observation(jnp.asarray(z)).status), (2, 3, 4))
        if not lost.any():
            expected = 0.5 * (np.sum(readings**2) + np.sum((z - np.asarray(posed.data.centre)) ** 2))
            assert cost == pytest.approx(expected, rel=1e-9)


@pytest.mark.slow
def test_objective_with_noise_to_be_estimated_takes_the_most_probable(posed, runs, found):
    """n ln s is, but for a constant, ½ Σ (e/σ)² + n ln σ at the σ that makes it smallest."""
    unknown = noise.noise_from_table(runs, SettledRuns.sizes(runs))
    worst = found.order[-2:]  # far above the least share that is taken for noise
    rows = jax.tree.map(lambda x: x[worst], found.observations)
    costs = population.member_objective(posed, unknown)(found.z[worst], rows)
    size, measured = SettledRuns.sizes(runs), np.asarray(posed.data.measured)

    def at(k, share):
        """Of each channel, at a share for its noise."""
        error = (found.observations.reading[k] - measured) / size / share
        return 0.5 * np.sum(error**2, axis=0) + len(size) * np.log(share)

    best = [
        np.min([at(k, share) for share in GRID], axis=0).sum()
        + 0.5 * np.sum((found.z[k] - np.asarray(posed.data.centre)) ** 2)
        + population.LOST * np.isin(found.observations.status[k], (2, 3, 4)).sum()
        for k in worst
    ]
    assert costs[1] - costs[0] == pytest.approx(best[1] - best[0], abs=0.1)


GRID = np.geomspace(1.2e-3, 1.0, 80)


@pytest.mark.slow
def test_row_that_is_not_reached_costs_and_a_reading_that_is_missing_ends_it(posed, known, found):
    status = found.observations.status[:1].copy()
    status[0, 0] = 2
    reached = dataclasses.replace(jax.tree.map(lambda x: x[:1], found.observations), status=np.zeros_like(status))
    lost = dataclasses.replace(reached, status=status)
    cost = population.member_objective(posed, known)
    assert cost(found.z[:1], lost) - cost(found.z[:1], reached) == pytest.approx(population.LOST)
    broken = dataclasses.replace(reached, reading=np.full_like(reached.reading, np.nan))
    assert np.isinf(cost(found.z[:1], broken))


# --- kept ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_kept_generations_are_not_run_again_and_an_ended_search_goes_on(posed, known, found, tmp_path, monkeypatch):
    run = []
    true = population._observe_points
    monkeypatch.setattr(population, "_observe_points", lambda *a: run.append(1) or true(*a))
    with pytest.raises(KeyboardInterrupt), RunFolder(tmp_path / "x", {"command": "calibrate"}) as folder:
        evolve(posed, known, 2, keep=folder.stage)
        raise KeyboardInterrupt
    run.clear()
    with RunFolder(tmp_path / "x", {"command": "calibrate"}) as folder:
        whole = evolve(posed, known, len(found.generations), keep=folder.stage)
    assert_array_equal(whole.z, found.z)
    assert_array_equal(whole.cost, found.cost)
    together = population.TOGETHER[0]
    assert len(run) == (len(found.generations) - 2) * -(-SIZE // together)


# --- derivatives and differences -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_regression_over_members_is_the_derivative_of_a_smooth_model(posed, found):
    at = int(found.order[0])
    about = identifiability.analyse_identifiability(posed, jnp.asarray(found.z[at]))
    slope, left = population.local_regression(posed, found, at)
    assert np.linalg.norm(slope - about.jacobian) < 0.15 * np.linalg.norm(about.jacobian) and left < 1.0
    assert not population.unreliable_derivatives(posed, found.z[at], about.jacobian, about.sd).any()


@pytest.mark.slow
def test_parameter_across_whose_threshold_differences_lead_is_named(posed, found):
    """The derivative by the resistance says nothing of the jump. That by the other parameters is right."""
    stepped = eqx.tree_at(
        lambda p: p.observe, posed, Stepped(posed.observe.conditions, "steady"), is_leaf=lambda x: x is posed.observe
    )
    about = identifiability.analyse_identifiability(stepped, jnp.zeros(len(NAMES)))
    off = population.unreliable_derivatives(stepped, np.zeros(len(NAMES)), about.jacobian, about.sd)
    assert off.tolist() == [True, False, False, False]


def test_parameter_at_the_edge_of_its_prior_or_at_a_bound_is_named(posed):
    coordinates = dataclasses.replace(
        posed.coordinates, high=np.where(np.arange(4) == 3, np.log(0.07), posed.coordinates.high)
    )
    assert population.parameters_at_edge(coordinates, np.array([2.4, -2.4, 0.0, 0.0])) == {}
    said = population.parameters_at_edge(coordinates, np.array([2.6, -3.0, 0.0, 9.0]))
    assert list(said) == [NAMES[0], NAMES[1], NAMES[3]]
    assert [*said.values()] == [
        Remark("edge", bound="", sds=2.6),
        Remark("edge", bound="", sds=-3.0),
        Remark("edge", bound="upper", sds=9.0),
    ]


@pytest.mark.slow
def test_population_of_which_no_member_can_be_run_is_refused(runs, monkeypatch, robot):
    true = population._observe_points

    def broken(posed, points):
        seen = true(posed, points)
        return Observation(
            jnp.full_like(seen.reading, jnp.nan), seen.adhesion_used, jnp.full_like(seen.status, TIPS), seen.flags
        )

    monkeypatch.setattr(population, "_observe_points", broken)
    name = "6T2A.ground.rolling_resistance"
    with refused(r"none of \d+ members runs in every row .*: \d+ tips", BadConfiguration):
        calibrate(runs, robot, model="drive", free=(name,), population=4, generations=1)


@pytest.mark.nightly
def test_running_gear_is_found_through_the_track_model():
    """Readings of a shaking gear. The population comes near its slip, which the flush gear does not."""
    table = records.read_runs("measured")
    table = table.where(
        (table["configuration"] == "6T2A") & (table["supply_voltage_V"] == 15) & (table["slope_deg"] % 10 == 0)
    )
    from mmrjax.fidelities.track import track_batch
    from mmrjax.model import params

    changed = {
        "6T2A.ground.friction.static": 0.59, "6T2A.ground.friction.dynamic": 0.52,
        "6T2A.ground.friction.speed_static": 0.02, "6T2A.track.guide_friction": 0.06,
        "running_gear.guide_recess": 3.5e-4, "running_gear.contact_damping": 840.0,
    }  # fmt: skip
    robot = params.replace(paper_robots.nominal(), changed)
    shown = track_batch(robot, table.conditions(robot), duration=0.6, step=5e-5, rolling=True).result.reading
    columns = dict(table.columns)
    for channel in channels.usual_channels():
        columns[channel.column] = np.asarray(shown[channel.name]) / channel.factor
    data = dataclasses.replace(table, columns=columns)
    found = calibrate(
        data, paper_robots.nominal(), model="track", noise="current=2%,motor_speed=0.5%,speed=0.5%", population=48,
        free=("default", "running_gear.guide_recess", "running_gear.contact_damping"), generations=5,
    )  # fmt: skip
    assert found.errors_after["speed"].rms_percent < 0.6 * found.errors_before["speed"].rms_percent
    assert found.searched is not None and len(found.searched.population.z) > 48
