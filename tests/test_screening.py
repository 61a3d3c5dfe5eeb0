"""Sets of effects are ranked by regression where runs take long, and simulation confirms the first of them."""

import dataclasses
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from synthetic import Analyst, table
from worlds import histories, rigs

from calibration.discovery import candidates, log_simulation, log_stages, search, verdict
from calibration.discovery.active_set import candidate_space
from calibration.discovery.candidates import Candidate
from calibration.discovery.findings import EffectRanking, EffectScore
from calibration.discovery.loop_notes import MissedChannel
from calibration.discovery.settings import settings_for
from calibration.inference.blocks import predict_unseen
from calibration.inference.observers import Histories
from calibration.inference.observers.linear_rows import problem_of_readings
from calibration.inference.optimizers import Optimum
from calibration.words import loop_words as words
from mmrjax.effects import BY_NAME
from sweeps.commands import loop as command
from tests.commands import read_json

NAMES = ("churning", "stribeck_track", "series_resistance", "brush_drop")
ANALYST = Analyst(dataclasses.replace(settings_for(Histories, 300), slots=2), {n: BY_NAME[n] for n in NAMES})


@pytest.fixture(scope="module")
def space():
    """What can be fitted to two starts. Nothing is."""
    runs = table(histories.narrow((), 0.0, 1, duration=0.4, every=0.02))
    return ANALYST.space(runs.where(np.isin(runs["run_id"], ["start0", "start3"])))


def test_the_program_of_a_log_has_the_effects_that_are_asked_for_and_those_of_its_room(space):
    problem, indices = space.with_room(["churning"]).problem_for_sets([("brush_drop", ""), ("", "churning")])
    names = problem.coordinates.names
    assert set(names) == {"churning", "brush_drop"} == {e.name for e in problem.base.effects}
    assert [tuple(names[k] if k >= 0 else "" for k in each) for each in indices] == [
        ("brush_drop", ""), ("", "churning"),
    ]  # fmt: skip
    z = np.linspace(-0.4, 0.5, len(space.coordinates))
    mine = problem.coordinates.with_effects(indices[0]).robot(problem.base, jnp.asarray(z))
    every = space.coordinates.with_effects(space.coordinates.indices(("brush_drop", "")))
    whole = every.robot(space.equipped.base, jnp.asarray(z))
    (one,) = (e for e in mine.effects if e.name == "brush_drop")
    (other,) = (e for e in whole.effects if e.name == "brush_drop")
    assert float(one.amplitude) == float(other.amplitude) != 0
    assert mine.motor.resistance == whole.motor.resistance


def test_a_refit_without_a_block_is_a_step_of_gauss_and_newton():
    rng, rows = np.random.default_rng(5), 12
    slopes, truth = rng.standard_normal((rows, 2, 3)), np.array([0.3, -0.2, 0.5])
    sd, measured = np.full((rows, 2), 0.1), slopes @ truth + 0.1 * rng.standard_normal((rows, 2))

    def at(problem, z, active):
        residual = np.concatenate([((slopes @ z - measured) / sd).ravel(), np.zeros(rows), z])
        jacobian = np.concatenate([(slopes / sd[..., None]).reshape(-1, 3), np.zeros((rows, 3)), np.eye(3)])
        return residual, jacobian, SimpleNamespace(reading=slopes @ z, status=np.zeros(rows, int))

    observe = SimpleNamespace(long=True, at=at, unreachable=lambda status: status > 0)
    data = SimpleNamespace(weight=np.ones((rows, 2)), sd=sd)
    block = np.arange(rows) < 4

    def optimum(kept):
        rows_of_fit = np.concatenate([(slopes[kept] / sd[kept][..., None]).reshape(-1, 3), np.eye(3)])
        wanted = np.concatenate([(measured[kept] / sd[kept]).ravel(), np.zeros(3)])
        return np.linalg.lstsq(rows_of_fit, wanted, rcond=None)[0]

    every, z = optimum(np.ones(rows, bool)), optimum(~block)
    found = predict_unseen(SimpleNamespace(observe=observe, data=data), every, [block])
    assert_allclose(found.z[0], z, rtol=1e-9)
    assert_allclose(found.reading[block], slopes[block] @ z, rtol=1e-9)
    # Where the search ended short of the optimum, the step that remains is no effect of the block.
    short = predict_unseen(SimpleNamespace(observe=observe, data=data), every + 0.1, [block])
    assert_allclose(short.z[0], z + 0.1, rtol=1e-9)
    assert np.isnan(found.reading[~block]).all() and list(found.block) == [0] * 4 + [-1] * 8


# --- the first answer -------------------------------------------------------------------------------------

TWO_SLOTS = dataclasses.replace(ANALYST.settings, slots=2)
RANKING = EffectRanking(
    True, 0.002, 9.0,
    (EffectScore("churning", "track", 412.0, 0.0123, 1.0, 0.0004, "loss torque that changes with speed", "N·m"),
     EffectScore("brush_drop", "electrical", 4.0, 0.1, 1.0, 0.05, "voltage drop that changes with current", "V"),
     EffectScore("bending_loss", "track", 430.0, -0.01, 1.0, 0.001, "loss torque that changes with speed", "N·m", True)),
)  # fmt: skip


@pytest.mark.parametrize("missing", [True, False])
def test_a_simulation_that_contradicts_the_regression_is_said_to(missing, capsys):
    folder = SimpleNamespace(keeps=lambda name: True, path="found")
    left = SimpleNamespace(test=SimpleNamespace(rejected=True))
    ranking = dataclasses.replace(RANKING, missing=missing)
    command._report_stored_stages({"ranking": ranking, "bootstrap 0": (None, left)}, folder, "rig.toml")
    assert (words.DISAGREES in capsys.readouterr().err) is not missing


def test_a_budget_that_ends_after_the_screening_leaves_its_ranking(tmp_path, mmrjax, monkeypatch):
    rigs.case(rigs.world(np.random.default_rng(3), "bench", "voltage", rows=(16, 20))).write(tmp_path)

    def screened(*_, keep, **__):
        keep("ranking", lambda: RANKING)
        raise command.OutOfTime

    monkeypatch.setattr(command, "discover", screened)
    options = ("--robot", "rig.toml", "--no-report", "--out", "found", "--within", "20s")
    code, _, err = mmrjax("loop table.csv", *options)
    assert code == 3 and "Strongest alone: churning\n" in err  # at once
    assert err.count("  1. churning, a loss torque that changes with speed") == 1  # at the end
    assert "no verdict within 20 s\n" in err and "kept: ranking" in err
    assert "regression only, not confirmed: perhaps a loss torque that changes" in err
    left = read_json(tmp_path / "found.partial/screening.json")
    assert left["schema"] == "mmrjax.screening/1" and left["confirmed"] is False
    assert [e["name"] for e in left["effects"]] == ["churning", "brush_drop", "bending_loss"]


def test_noise_stated_too_small_is_no_excess_of_a_log():
    """Half of the true sds: three quarters of χ² are noise, whatever slow misfit there is beside."""
    rng, count = np.random.default_rng(0), 400
    rows_of = np.concatenate([np.arange(count), np.full(100, -1)]).reshape(1, -1)
    slow = 6 * np.sin(np.linspace(0, 9, count))[:, None]
    counts = np.ones((count, 1), bool)

    def misfit(sd):
        observe = SimpleNamespace(rows_of=rows_of)
        return Histories.noise_misfit(observe, lambda: slow + sd * rng.standard_normal((count, 1)), counts)

    assert misfit(2.0) == pytest.approx(4 * count, rel=0.15)
    assert misfit(0.5) == count


def test_effects_that_remain_without_another_take_the_first_slots(monkeypatch):
    """A gap in the slots shifted the columns of a class, or ended a loop on 509 rows with an internal error."""
    asked = []

    def fit_candidates(space, proposals):
        asked.extend(proposals)
        return [SimpleNamespace(active=active) for active, _ in proposals]

    monkeypatch.setattr(search, "fit_candidates", fit_candidates)
    space = SimpleNamespace(free=2, settings=dataclasses.replace(ANALYST.settings, slots=3))
    z, zeros = np.arange(2 + 6.0), np.zeros(3)  # two base parameters, then amplitudes and shapes
    best = Candidate(("churning", "brush_drop", ""), z, z, 0.0, zeros, zeros, True, True, True)
    fewer = search.refit_without_each(space, best)
    assert [c.active for c in fewer] == [("brush_drop", "", ""), ("churning", "", "")]
    assert_allclose(asked[0][1], [0, 1, 3, 0, 0, 6, 0, 0])


@pytest.mark.parametrize("converged", [False, True])
def test_a_search_from_a_regression_that_does_not_converge_is_repeated_from_the_mean(monkeypatch, converged):
    """From a regression 2.9 prior sds away, a log with the angle alone ended at an efficiency of 0.26 for 0.74."""
    begun = []

    def optima(problem, starts, *_, **__):
        begun.append(np.asarray(starts))
        there = np.asarray(starts)[:, 0] != 0
        each = np.ones(len(starts))
        cost = jnp.asarray(np.where(there, 931.0, 408.0))
        return Optimum(starts, starts, starts, cost, each, jnp.asarray(converged | ~there), each), each

    monkeypatch.setattr(candidates.scans, "place_at_minimum", lambda bare, starts: starts)
    observe = SimpleNamespace(long=True, policy=SimpleNamespace(steps=60), search=optima)
    space = SimpleNamespace(
        bare=SimpleNamespace(observe=observe),
        free=2,
        weight=np.ones(3),
    )
    regression = SimpleNamespace(z=np.array([-2.9, 1.0, 0.0]), simulated=False)
    optima_found, _ = candidates._best_starts(space, regression)
    assert [b.tolist() for b in begun] == [[[-2.9, 1.0]]] + [[[0.0, 0.0]]] * (not converged)
    assert np.min(optima_found.cost) == (931.0 if converged else 408.0)


@pytest.mark.parametrize("missed", [(), (MissedChannel("position", 0.57, 0.0),)])
def test_no_effect_is_named_if_the_simulation_behind_the_windows_misses_a_channel(monkeypatch, missed):
    """An encoder that wrapped left 57 % of its rms, and an inertia was said to be missing."""
    base, best = SimpleNamespace(cost=100.0), SimpleNamespace(cost=10.0)
    run = SimpleNamespace(
        space=SimpleNamespace(weight=np.ones(9)), base=base, best=best, disturbed=False, contradicts=False,
        diagnosis=lambda fit, left: SimpleNamespace(linear=fit),
    )  # fmt: skip
    monkeypatch.setattr(log_stages, "simulate_models", lambda *_, **__: run)
    monkeypatch.setattr(log_stages, "delayed_by_rows", lambda given, fit: fit)
    monkeypatch.setattr(log_stages, "excess_misfit", lambda *_: 1e3)
    monkeypatch.setattr(verdict, "unused_inputs", lambda _: ("angle",))
    missed_by = {id(base): (MissedChannel("position", 0.8, 0.0),), id(best): missed}
    monkeypatch.setattr(verdict, "missed_channels", lambda space, runs, noise, fit: missed_by[id(fit)])
    given = SimpleNamespace(
        known=None, shows_unmodelled_backlash=False, progress=lambda _: None, runs=None, noise=None, settings=None,
        space=SimpleNamespace(with_room=lambda _: None),
    )  # fmt: skip
    screened = SimpleNamespace(base=SimpleNamespace(candidate=base))
    left = SimpleNamespace(test=SimpleNamespace(confirmed=lambda _: SimpleNamespace(rejected=True)))
    traced = verdict.LoopStages(
        "class", screened, left, None, SimpleNamespace(best=best, room=()), alike="classes", beside="curve"
    )
    found = log_stages.confirm_windows(given, given, traced)
    other = log_stages.confirm_windows(SimpleNamespace(**{**vars(given), "known": found}), given, traced)
    assert {found.verdict, other.verdict} == {"undescribed" if missed else "class"}
    assert found.missed == other.missed == (missed_by[id(base)] if missed else ()) and found.run is run
    assert (found.alike is None) == bool(missed) and found.unused == ("angle",) * bool(missed)


def test_a_slow_misfit_counts_as_noise_of_a_simulation(space):
    """With the readings' noise, parameters of EMPS followed a disturbance until they were 15 prior sds off."""
    random, data = np.random.default_rng(3), space.bare.data
    residual = random.standard_normal(data.sd.shape)
    fit = SimpleNamespace(active=None, z=None)

    def of(residual):
        at = SimpleNamespace(at=lambda *_: (np.append(residual, 9.0),), rows_of=space.bare.observe.rows_of)
        problem = SimpleNamespace(observe=at, data=data)
        noisy = SimpleNamespace(
            weight=space.weight, fit_of=lambda *_: (problem, None, None), with_noise=space.with_noise
        )
        return noisy, log_simulation.with_misfit(noisy, fit)

    as_read, noisy = of(residual)
    assert noisy is as_read
    for rows in np.asarray(space.bare.observe.rows_of):
        residual[rows[rows >= 0], 0] += np.repeat(random.standard_normal(9), 99)[: np.sum(rows >= 0)] * 5
    noisy = of(residual)[1].bare.data.sd / data.sd
    assert np.all(noisy[:, 1] == 1) and np.all(noisy[:, 0] > 6)


@pytest.fixture(scope="module")
def linear(space):
    """Coordinates near the prior mean, and the readings that are linear about them."""
    z = np.full(space.free, 0.1)
    return z, problem_of_readings(space.bare, z, space.library.scored, ANALYST.settings.width)


def test_linear_readings_are_those_of_the_simulation_at_and_near_the_fit(space, linear):
    z, problem = linear
    near = z + 1e-4 * np.linspace(-1, 1, space.free)
    counts = space.weight > 0
    for at, atol in ((z, 1e-10), (near, 1e-6)):
        simulated = np.asarray(space.bare.observe.at(space.bare, at)[2].reading)
        changed = np.max(np.abs(simulated), 0)
        assert_allclose((np.asarray(problem.observe.at(problem, at)[2].reading) / changed)[counts],
                        (simulated / changed)[counts], atol=atol)  # fmt: skip


def test_linear_readings_change_with_a_small_amplitude_as_the_simulation_does(space, linear):
    z, problem = linear
    table = candidate_space(problem, space.library.effects, ANALYST.library, TWO_SLOTS)
    active = ("brush_drop", "")
    some = np.concatenate([z, [0.01, 0.0, 0.0, 0.0]])

    def change(space):
        fits = [space.fit_of(active, np.where(np.arange(len(some)) < len(z), some, x)) for x in (some, 0.0)]
        with_effect, without = (problem.observe.at(problem, z, sets)[2].reading for problem, z, sets in fits)
        return np.asarray(with_effect - without)[space.weight > 0]

    linear_change, simulated = change(table), change(space)
    assert np.abs(simulated).max() > 0
    assert_allclose(linear_change, simulated, atol=0.01 * np.abs(simulated).max())


def test_a_row_without_weight_does_not_change_a_linear_fit(space, linear):
    z, problem = linear
    table = candidate_space(problem, space.library.effects, ANALYST.library, TWO_SLOTS)
    (without,) = candidates.fit_candidates(table.without([3]), [(("", ""), np.pad(z, (0, 4)))])
    wrong = dataclasses.replace(table.without([3]))
    data = wrong.equipped.data
    data = dataclasses.replace(data, measured=data.measured.at[3].add(1e3))
    wrong = dataclasses.replace(wrong, equipped=dataclasses.replace(wrong.equipped, data=data))
    (other,) = candidates.fit_candidates(wrong, [(("", ""), np.pad(z, (0, 4)))])
    assert_allclose(other.z, without.z, atol=1e-9)


@pytest.mark.parametrize(
    "remain, room, chosen",
    [((False, False), "", "b"), ((True, False), "", "a c"), ((True, True), "", "a c"), ((False,), "ac", "a")],
)
def test_the_smallest_set_that_a_simulation_confirms_is_proposed(remain, room, chosen, monkeypatch):
    """The linear readings prefer `a`, the simulation `b`, unless it has room for `a` and `c` alone."""

    def one(*effects, cost):
        return SimpleNamespace(effects=effects, z=0, cost=cost, plausible=True)

    def diagnosis(rejected):
        return SimpleNamespace(test=SimpleNamespace(rejected_with_margin=rejected, null=None), linear=None)

    ladder = [one("a", cost=10.0), one("b", cost=11.0), one("a", "c", cost=5.0)]
    simulated = {("a",): 9.0, ("b",): 6.0, ("a", "c"): 5.0}
    monkeypatch.setattr(
        log_stages, "refine_by_simulation", lambda space, c, *_: one(*c.effects, cost=simulated[c.effects])
    )
    rest = iter(remain)
    monkeypatch.setattr(log_stages, "diagnose_candidate", lambda *_: diagnosis(next(rest)))
    space = SimpleNamespace(room=tuple(room))
    space.with_noise = space.with_room = lambda *_: space
    screened = SimpleNamespace(base=SimpleNamespace(space=SimpleNamespace(weight=None)), bases=())
    searched = search.SearchResult(tuple(ladder), ladder[2], diagnosis(False))
    noise = SimpleNamespace(sd=None)
    best = log_stages.smallest_confirmed(space, screened, diagnosis(True), searched, noise).best
    assert " ".join(best.effects) == chosen


@pytest.mark.parametrize("cost, chosen", [(4.0, "a c"), (1e6, "a")])
def test_windows_propose_no_larger_set_whose_simulation_leaves_more(cost, chosen, monkeypatch):
    """Windows of EMPS found a second effect, whose simulation left 2000 times as much as the first alone."""
    small, large = (
        SimpleNamespace(effects=e, z=0, cost=x, plausible=True) for e, x in ((("a",), 9.0), (("a", "c"), 5.0))
    )
    monkeypatch.setattr(
        log_stages, "refine_by_simulation",
        lambda space, c, *_: SimpleNamespace(cost=cost if c is large else 100.0),
    )  # fmt: skip
    monkeypatch.setattr(log_stages, "diagnose_candidate", lambda *_: "diagnosis")
    space = SimpleNamespace(room=(), with_room=lambda _: space)
    screened = SimpleNamespace(base=SimpleNamespace(space=None), bases=())
    left = SimpleNamespace(test=SimpleNamespace(null=None))
    searched = search.SearchResult((small, large), large, "of both")
    found = log_stages.best_simulated_size(space, screened, left, searched, None)
    assert " ".join(found.best.effects) == chosen
    assert found.diagnosis == ("of both" if found.best is large else "diagnosis")
