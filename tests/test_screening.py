"""Sets of effects are ranked by regression where runs take long, and simulation confirms the first of them."""

import dataclasses
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from synthetic import Analyst, table
from worlds import histories, rigs

from calibration.discovery import candidates, discover, screening, search
from calibration.discovery.candidates import Candidate, fill_slots
from calibration.discovery.loop_notes import MissedChannel
from calibration.discovery.result import EffectRanking, RankedEffect
from calibration.discovery.score_tests import ScoreTable
from calibration.discovery.settings import settings_for
from calibration.inference.held_out import predict_unseen
from calibration.inference.observers import Histories, time_histories
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
    every = space.coordinates.with_effects(space.library.indices(("brush_drop", "")))
    whole = every.robot(space.equipped.base, jnp.asarray(z))
    (one,) = (e for e in mine.effects if e.name == "brush_drop")
    (other,) = (e for e in whole.effects if e.name == "brush_drop")
    assert float(one.amplitude) == float(other.amplitude) != 0
    assert float(mine.motor.resistance) == float(whole.motor.resistance)


def test_the_base_of_a_log_is_fitted_in_the_program_of_its_room(space, monkeypatch):
    """One program serves fits with and without effects. Scans are those of the base's coordinates."""
    asked = []

    def search(self, problem, starts, weights, active=None, **options):
        asked.append((problem, np.asarray(starts), active, options["scanned"]))
        raise InterruptedError

    monkeypatch.setattr(Histories, "search", search)
    monkeypatch.setattr(Histories, "starts", lambda self, problem, *_: np.full((1, len(problem.coordinates)), 0.2))
    for room in ((), ("churning",)):
        with pytest.raises(InterruptedError):
            candidates.fit_base(space.with_room(room), ANALYST.settings, "")
    (bare, start, nothing, _), (problem, with_slots, active, scanned) = asked
    assert bare is scanned is space.bare and nothing is None and start.shape == (1, space.free)
    assert problem.coordinates.names == ("churning",) and active.tolist() == [[-1, -1]]
    assert with_slots[0].tolist() == [0.2] * space.free + [0.0] * 4


@pytest.mark.parametrize("lost", [False, True])
def test_other_basins_of_a_log_are_searched_in_the_program_of_its_room(space, monkeypatch, lost):
    """With the priors of its coordinates, which are more than the base's. Not of a fit that is lost."""
    problem, (empty,) = space.with_room(["churning"]).problem_for_sets([("", "")])
    size, priors = space.free + 4, []

    def rollouts(evaluate, starts, data, weights, *_, **options):
        priors.append(np.shape(data.centre))
        zero = np.zeros(len(starts))
        square = np.zeros((len(starts), size, size))
        return Optimum(np.asarray(starts), np.asarray(starts), square, zero, zero, zero == lost, zero), zero

    monkeypatch.setattr(time_histories, "search_rollouts", rollouts)
    monkeypatch.setattr(time_histories.scans, "scanned_coordinates", lambda problem: (0,))
    monkeypatch.setattr(
        time_histories.scans, "search_lower_minima", lambda problem, end, data, search, tell: search(end[0].z + 1)
    )
    weights, which = space.weight[None], np.asarray(empty)[None]
    best, _ = space.bare.observe.search(
        problem, np.full((1, size), 60.0 * lost), weights, which, rivals=True, most=1, scanned=space.bare
    )
    if lost:
        assert priors == [(size,)] and best.z[0].tolist() == [60.0] * size
        return
    assert priors == [(size,)] * 2 and best.z[0].tolist() == [1.0] * space.free + [0.0] * 4


def linear_world(space, seed=3):
    """A linearisation of the space's base in which every reading is linear, and what its effects explain there."""
    rng, p, rows = np.random.default_rng(seed), space.free, 40
    jacobian = np.concatenate([rng.standard_normal((rows, p)), np.zeros((rows, p)), np.eye(p)])
    signatures = rng.standard_normal((rows, len(space.library.of)))
    m = space.library.best_instance("churning", np.where(space.library.of == 0, 2.0, 1.0))
    residual = np.concatenate([0.1 * rng.standard_normal(rows), np.zeros(rows), np.zeros(p)])
    residual[:rows] -= 2.0 * signatures[:, m]  # an amplitude of 2 prior sds takes it away
    single = np.where(np.arange(len(space.library.of)) == m, 9.0, 1.0)
    none = jnp.zeros(0)
    scores = ScoreTable(single, none, none, none, none, none, none, none, none)
    at = Candidate(("", ""), np.zeros(p + 4), np.ones(p + 4), 0.5 * float(residual @ residual), np.zeros(2),
                   np.zeros(2), True, True, True)  # fmt: skip
    linear = SimpleNamespace(jacobian=jacobian, residual=residual, signatures=signatures)
    return screening.LinearisedFits(space, at, linear, scores, ANALYST.settings), at, linear, m


def test_a_regression_is_the_least_squares_fit_of_base_amplitudes_and_their_priors(space):
    beside, at, linear, m = linear_world(space)
    found, width, p = beside(("churning", "")), ANALYST.settings.width, space.free
    columns = np.concatenate([linear.jacobian[:40], width * linear.signatures[:, [m]]], 1)
    whole, left = np.concatenate([columns, np.eye(p + 1)]), np.concatenate([linear.residual[:40], np.zeros(p + 1)])
    step, *_ = np.linalg.lstsq(whole, -left, rcond=None)
    assert_allclose(found.z[:p], step[:p], atol=1e-9)
    assert found.z[p] == pytest.approx(step[p], rel=1e-9) and abs(found.amplitude[0] - 2.0) < 0.2
    shape = space.library.at[m]
    assert found.cost == pytest.approx(0.5 * np.sum((left + whole @ step) ** 2) + 0.5 * shape**2, rel=1e-9)
    assert not found.simulated and found.cost < 0.1 * at.cost


def test_a_regression_takes_an_effect_of_the_other_fit_away(space):
    """From a fit with an effect that is all there is back to nothing."""
    beside, at, linear, m = linear_world(space)
    p, width = space.free, ANALYST.settings.width
    wide = np.zeros((80 + p + 4, p + 4))
    wide[:80, :p] = linear.jacobian[:80]
    wide[:40, p] = width * linear.signatures[:, m]
    wide[80:] = np.eye(p + 4)
    there = np.zeros(p + 4)
    there[p] = 2.0 / width
    residual = np.concatenate([linear.residual[:80], np.zeros(p + 4)]) + wide @ there
    fitted = dataclasses.replace(at, active=("churning", ""), z=there, cost=0.5 * float(residual @ residual))
    after = SimpleNamespace(jacobian=wide, residual=residual, signatures=linear.signatures)
    back = screening.LinearisedFits(space, fitted, after, beside.scores, ANALYST.settings)(("", ""))
    assert back.cost == pytest.approx(beside(("", "")).cost, rel=1e-9)
    assert_allclose(back.z, beside(("", "")).z, atol=1e-9)


def ranked_sets(space, far=0.0, **explained):
    """Screened single effects that explain so much [σ²], of 1000, so far from the prior mean [prior sd]."""
    at = np.repeat([far, 0.0], [space.free, 4])
    return [
        Candidate(fill_slots([n], ANALYST.settings), at, at, 500 - x / 2, np.zeros(2), np.zeros(2), True, True, True,
                  simulated=False)
        for n, x in explained.items()
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("simulated", "asked", "otherwise", "far"),
    [
        ({"churning": 900, "series_resistance": 500, "stribeck_track": 895}, 3, 0, 2.0),
        ({"churning": 300, "series_resistance": 500, "stribeck_track": 400, "brush_drop": 700}, 4, 2, 2.0),
        ({"churning": 300, "series_resistance": 500, "stribeck_track": 400, "brush_drop": 700}, 4, 2, 0.5),
    ],
)
def test_simulation_confirms_the_first_and_its_rivals_or_another_is_tried(
    space, monkeypatch, simulated, asked, otherwise, far
):
    tried = []

    def fit(space, proposals, settings):
        tried.extend(names[0] for names, _ in proposals)
        return [
            dataclasses.replace(c, simulated=True)
            for names, _ in proposals
            for c in ranked_sets(space, **{names[0]: simulated[names[0]]})
        ]

    monkeypatch.setattr(screening, "fit_candidates", fit)
    screened = ranked_sets(space, far, churning=900, stribeck_track=890, series_resistance=500, brush_drop=480)
    found = screening.confirm_by_simulation(space.with_room(NAMES), screened, ANALYST.settings)
    assert (found.asked, found.otherwise) == (asked, otherwise)
    assert [c.simulated for c in found.candidates].count(True) == asked
    assert tried[:3] == ["churning", "series_resistance", "stribeck_track"]
    # From the prior mean too if simulation explains less than the regression, which is not near that mean.
    assert [tried.count(n) for n in tried[:3]] == ([1, 1, 1] if otherwise == 0 or far < 1 else [2, 1, 2])
    best = min((c for c in found.candidates if c.simulated), key=lambda c: c.cost)
    assert best.effects == (("churning",) if otherwise == 0 else ("brush_drop",))


@pytest.mark.parametrize("share, tried", [(0.97, 1), (0.9, 2)])
def test_a_small_share_of_a_large_gain_is_no_reason_for_another_set(space, monkeypatch, share, tried):
    """Of 100 000 σ² a simulation confirms a share. Each set is then tried once, or again from the prior mean."""
    asked = []

    def fit(space, proposals, settings):
        asked.extend(names[0] for names, _ in proposals)
        return [
            dataclasses.replace(c, simulated=True, cost=c.cost + (1 - share) * 5e4)
            for names, _ in proposals
            for c in screened
            if c.active == names
        ]

    monkeypatch.setattr(screening, "fit_candidates", fit)
    screened = ranked_sets(space, 2.0, churning=1e5, stribeck_track=9e4, series_resistance=5e4, brush_drop=2e3)
    found = screening.confirm_by_simulation(space.with_room(NAMES), screened, ANALYST.settings)
    assert [asked.count(n) for n in asked[:3]] == [tried] * 3 and ("brush_drop" in asked) is (tried == 2)
    assert found.otherwise == found.asked  # 3 % are 3000 σ²


@pytest.mark.parametrize(("first", "simulated"), [(905, ["stribeck_track", "brush_drop"]), (930, ["churning"])])
def test_a_set_that_needs_another_program_has_to_promise_more(space, monkeypatch, first, simulated):
    """The strongest effect is outside the program, which has two others: 30 or 5 σ² of 400 make the difference."""
    tried = []

    def fit(space, proposals, settings):
        tried.extend(names[0] for names, _ in proposals)
        return [
            dataclasses.replace(c, simulated=True) for names, _ in proposals for c in screened if c.active == names
        ]

    monkeypatch.setattr(screening, "fit_candidates", fit)
    screened = ranked_sets(space, churning=first, stribeck_track=900, brush_drop=500)
    screening.confirm_by_simulation(space.with_room(["stribeck_track", "brush_drop"]), screened, ANALYST.settings)
    assert tried[: len(simulated)] == simulated and ("churning" in tried) is (first == 930)


def test_fits_with_other_sds_are_few_steps_from_those_that_are_known(space, monkeypatch):
    """Such a fit begins where it ended with the other sds. One that is not known takes as many steps as it needs."""
    known, other, new = fill_slots(["churning"], ANALYST.settings), fill_slots(["brush_drop"], ANALYST.settings), []
    size, at = len(space.coordinates), np.full(len(space.coordinates), 0.3)

    def search(problem, starts, weights, active, most=None):
        new.append((starts[0][0], most))
        one = np.zeros((1, size))
        return Optimum(
            np.array(starts), one + 1, np.zeros((1, size, size)), one[:, 0], one[:, 0], one[:, 0], one[:, 0]
        ), None

    monkeypatch.setattr(candidates, "fit_from_each_start", search)
    near = dataclasses.replace(space, near={known: at})
    found = candidates.fit_candidates(near, [(known, 0 * at), (other, 0 * at)], ANALYST.settings)
    assert [c.active for c in found] == [known, other]
    assert new == [(0.0, None), (0.3, candidates.FEW)]


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

RANKING = EffectRanking(
    True, 0.002, 9.0,
    (RankedEffect("churning", "loss torque that changes with speed", "N·m", 412.0, 0.0123, 0.0004),
     RankedEffect("brush_drop", "voltage drop that changes with current", "V", 4.0, 0.1, 0.05),
     RankedEffect("bending_loss", "loss torque that changes with speed", "N·m", 430.0, -0.01, 0.001, True)),
)  # fmt: skip


def test_what_is_ranked_is_said_not_to_be_confirmed():
    first, *lines = words.ranking_lines(RANKING)
    assert "by regression, not yet confirmed: something is missing" in first
    assert lines == [
        "  1. churning, a loss torque that changes with speed: lowers the misfit by 412 σ², "
        "amplitude 0.0123 ± 0.0004 N·m"
    ]  # the others explain no more than chance, or would supply power
    nothing = dataclasses.replace(RANKING, missing=False, p_value=0.4)
    assert words.ranking_lines(nothing) == [
        "by regression, not yet confirmed: no effect of the library exceeds chance (family-wise p = 0.4)"
    ]


def test_a_ranking_answers_with_a_mechanism_at_most_and_with_parameters():
    found = dataclasses.replace(RANKING, parameters={"motor.inertia": (2.5e-4, 1e-6)})
    assert words.regression_verdict(found) == (
        "regression only, not confirmed by simulation: perhaps a loss torque that changes with speed is "
        "missing (churning). Parameters [SI]: motor.inertia 0.00025 ± 1e-06"
    )
    assert words.regression_verdict(dataclasses.replace(found, effects=(), parameters={})).endswith(
        "no effect explains it"
    )
    nothing = dataclasses.replace(RANKING, missing=False)
    assert words.regression_verdict(nothing).endswith("simulation: no effect of the library exceeds chance")


def test_what_is_found_before_the_verdict_is_said_to_be_untested(capsys):
    found = SimpleNamespace(best=SimpleNamespace(effects=("churning",)))
    library = {"churning": BY_NAME["churning"]()}
    base = SimpleNamespace(base=SimpleNamespace(space=SimpleNamespace(library=library)))
    folder = SimpleNamespace(keeps=lambda name: True, path="found")
    command._report_stored_stages({"ranking": RANKING, "search 0": (base, None, found)}, folder, "rig.toml")
    said = capsys.readouterr().err
    assert "so far, simulation confirms a loss torque that changes with speed (churning)." in said
    assert said.index("by regression") < said.index("so far")


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
    assert "regression only, not confirmed by simulation: perhaps a loss torque that changes" in err
    left = read_json(tmp_path / "found.partial" / "screening.json")
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


@pytest.mark.parametrize(("far", "gain", "begun"), [(0.5, 50.0, False), (60.0, 50.0, True), (60.0, 1.0, False)])
def test_effects_are_ranked_at_the_set_of_the_equations_where_the_base_is_far(monkeypatch, far, gain, begun):
    """The base of EMPS ends 60 prior sds away and 112 mm off: its signatures rank nothing."""
    fits, settings = [], settings_for(Histories)
    best = SimpleNamespace(cost=100.0 - gain)
    monkeypatch.setattr(search, "fit_candidates", lambda space, given, _: fits.append(given) or [best])
    monkeypatch.setattr(search, "diagnose_candidate", lambda *_: "its diagnosis")
    space = SimpleNamespace(begins={("torque_offset",): np.ones(3)}, free=1)
    base, left = (
        SimpleNamespace(z=np.array([far, 0.0, 0.0]), cost=100.0),
        SimpleNamespace(test=SimpleNamespace(null=0)),
    )
    wanted = (best, "its diagnosis") if begun else (base, left)
    assert search._fit_to_rank_at(space, base, left, (), settings) == wanted
    assert len(fits) == (far > 4) and search._fit_to_rank_at(
        SimpleNamespace(begins={}, free=1), base, left, (), settings
    ) == (base, left)


def test_effects_that_remain_without_another_take_the_first_slots(monkeypatch):
    """A gap in the slots shifted the columns of a class, or ended a loop on 509 rows with an internal error."""
    asked = []

    def fit_candidates(space, proposals, settings):
        asked.extend(proposals)
        return [SimpleNamespace(active=active) for active, _ in proposals]

    monkeypatch.setattr(search, "fit_candidates", fit_candidates)
    settings = dataclasses.replace(ANALYST.settings, slots=3)
    z, zeros = np.arange(2 + 6.0), np.zeros(3)  # two base parameters, then amplitudes and shapes
    best = Candidate(("churning", "brush_drop", ""), z, z, 0.0, zeros, zeros, True, True, True)
    fewer = search.refit_without_each(SimpleNamespace(free=2), best, settings)
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
        near={},
        free=2,
        begins={("churning", ""): 0},
        room=(),
        weight=np.ones(3),
    )
    regression = SimpleNamespace(z=np.array([-2.9, 1.0, 0.0]), simulated=False)
    optima_found, _ = candidates._best_starts(space, ANALYST.settings, regression)
    assert [b.tolist() for b in begun] == [[[-2.9, 1.0]]] + [[[0.0, 0.0]]] * (not converged)
    assert np.min(optima_found.cost) == (931.0 if converged else 408.0)


@pytest.mark.parametrize("missed", [(), (MissedChannel("position", 0.57, 0.0),)])
def test_no_effect_is_named_if_the_simulation_behind_the_windows_misses_a_channel(monkeypatch, missed):
    """An encoder that wrapped left 57 % of its rms, and an inertia was said to be missing."""
    base, best = SimpleNamespace(cost=100.0), SimpleNamespace(cost=10.0)
    run = SimpleNamespace(
        space=SimpleNamespace(weight=np.ones(9)), base=base, best=best, contradicts=False,
        diagnosis=lambda fit, left: SimpleNamespace(linear=fit),
    )  # fmt: skip
    monkeypatch.setattr(discover, "simulate_models", lambda *_: run)
    monkeypatch.setattr(discover, "_space_of", lambda *_: None)
    monkeypatch.setattr(discover, "excess_misfit", lambda *_: 1e3)
    monkeypatch.setattr(discover, "unused_inputs", lambda _: ("angle",))
    missed_by = {id(base): (MissedChannel("position", 0.8, 0.0),), id(best): missed}
    monkeypatch.setattr(discover, "missed_channels", lambda space, runs, noise, fit: missed_by[id(fit)])
    given = SimpleNamespace(
        known=None, shows_unmodelled_backlash=False, progress=lambda _: None, runs=None, noise=None, settings=None
    )
    screened = SimpleNamespace(base=SimpleNamespace(candidate=base))
    left = SimpleNamespace(test=SimpleNamespace(confirmed=lambda _: SimpleNamespace(rejected=True)))
    traced = discover.LoopStages(
        "class", screened, left, None, SimpleNamespace(best=best), alike="classes", beside="curve"
    )
    found = discover._confirm_by_simulation(given, given, traced)
    other = discover._confirm_by_simulation(SimpleNamespace(**{**vars(given), "known": found}), given, traced)
    assert {found.verdict, other.verdict} == {"undescribed" if missed else "class"}
    assert found.missed == other.missed == (missed_by[id(base)] if missed else ()) and found.run is run
    assert (found.alike is None) == bool(missed) and found.unused == ("angle",) * bool(missed)
