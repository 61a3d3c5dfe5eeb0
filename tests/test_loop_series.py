"""The closed loop on sealed histories: verdicts, and its linear algebra against differentiated runs."""

import dataclasses
import itertools
from types import SimpleNamespace

import generator_series as gs
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from calibration.inference import checks, noise
from calibration.data import runs as records
from calibration.data.errors import BadData
from calibration.discovery import active_set as slots
from calibration.discovery import bases as curves
from calibration.discovery import discrepancy as discover
from calibration.discovery import loop
from calibration.discovery import result as loop_outcome
from calibration.discovery import score_tests as trace
from calibration.inference import problem
from mmrjax import params, robots
from mmrjax.effects import BY_NAME, UNNAMED

STATED = {
    f"{c}.ground.friction.{k}": v
    for c in ("tracked", "wheeled")
    for k, v in (("static", (0.6, 0.09)), ("dynamic", (0.48, 0.08)))
}
#: What these histories are searched for; the whole library is what the command and the campaign search.
SEARCHED = ("rotating_inertia", "series_resistance", "churning", "grouser_polygon", "pulley_eccentricity")


@pytest.fixture(scope="module")
def engine():
    """Compiled once for every table of this file: all have the same instants."""
    return loop.Engine(robots.nominal(), {n: BY_NAME[n] for n in SEARCHED}, size=1, series=True)


@pytest.fixture(scope="module")
def looped(engine):
    def make(table) -> loop.Loop:
        runs = table if isinstance(table, records.Runs) else records.Runs("sealed", dict(table))
        return loop.Loop(engine, runs, noise.of(runs).sd, stated=STATED, replicates=300)

    return make


def case(*names, sigmas=10.0, seed=1):
    return gs.case(names, sigmas, seed, duration=0.8, every=0.02)


@pytest.fixture(scope="module")
def clean(looped):
    there = looped(case(seed=1)[0])
    return SimpleNamespace(loop=there, found=there.run())


@pytest.fixture(scope="module")
def oval(looped):
    """A bent pulley, twice a turn, which the library does not have."""
    table, label = case("pulley_ovality", sigmas=12.0, seed=7)
    there = looped(table)
    return SimpleNamespace(loop=there, found=there.run(), label=label["effects"][0])


# --- verdicts ---------------------------------------------------------------------------------------


def test_clean_histories_lack_nothing(clean):
    found = clean.found
    assert found.verdict == "none" and found.outliers == found.unusable == () and found.base.gate.p_value > 0.05
    readings = 3 * len(clean.loop.runs)
    assert abs(2 * found.base.hypothesis.cost - readings) < 4 * np.sqrt(2 * readings)


def test_eccentric_pulley_is_named_with_its_amplitude_and_phase(looped, engine):
    table, label = case("pulley_eccentricity", seed=2)
    there = looped(table)
    found = there.run()
    assert found.verdict == "named" and [[engine.names[k] for k in c] for c in found.classes] == [
        ["pulley_eccentricity"]
    ]
    (effect,) = loop_outcome.effects_found(there, found)
    truth = label["effects"][0]
    a, phase = effect["parameters"]["amplitude"], effect["parameters"]["phase"]
    # of either sign: sin(ψ + φ) = -sin(ψ + φ + π)
    turned = abs(a["value"]) * np.exp(1j * (phase["value"] + (np.pi if a["value"] < 0 else 0.0)))
    assert abs(turned - truth["amplitude"] * np.exp(1j * truth["shapes"]["phase"])) < 4 * a["sd"]
    assert 0 < a["sd"] < 0.2 * truth["amplitude"]
    robot = loop_outcome.robot(there, found)
    assert [e.name for e in robot.effects] == ["pulley_eccentricity"]


def test_wave_outside_the_library_gets_its_balance_and_order_but_no_name(oval):
    found = oval.found
    assert found.verdict == "unnamed" and found.classes == ()
    balance, variable, alike = found.unnamed
    assert {"track", "gearbox", "motor"} <= {balance, *alike} and variable == "order 2 of the driving shaft"
    told = loop_outcome.series(oval.loop, found.base, found.after)["before"]
    strength = {o["order"]: o["explained"] for o in told["orders"]}
    assert (
        max(strength, key=strength.get) == variable
        and strength[variable] > 2 * strength["order 3 of the driving shaft"]
    )


@pytest.mark.slow
def test_wave_without_a_name_can_be_added_to_the_robot(oval):
    found = oval.found
    curve = discover.discover(oval.loop, found.base.hypothesis, found.base.linear, "track", found.unnamed[1])
    assert (
        curve.converged and curve.effect == "wave_track" and isinstance(curve.robot.effects[0], UNNAMED["wave_track"])
    )
    assert curve.chi2[0] - curve.chi2[1] > 0.5 * oval.label["sigmas"] ** 2
    # a sin(2 θ + φ) of the generator
    wave = curve.robot.effects[0]
    got = complex(wave.y_sin, wave.y_cos) * float(wave.amplitude)
    expected = oval.label["amplitude"] * np.exp(1j * oval.label["shapes"]["phase"])
    assert abs(got - expected) < 0.3 * abs(expected) and float(wave.order_shaft) == 2.0
    assert "sin(2 θ_k" in curve.proposal.formula
    after = oval.loop.round_of(curve.problem, curve.z, found.base)
    assert not after.gate.clear and found.base.gate.clear


@pytest.mark.slow
def test_sample_that_stands_alone_is_an_outlier(looped, clean):
    runs = clean.loop.runs
    speed = runs["speed_mm_s"].copy()
    speed[[57, 130]] += 12 * runs["speed_sd_mm_s"][57]
    found = looped(dataclasses.replace(runs, columns=runs.columns | {"speed_mm_s": speed})).run()
    assert set(found.outliers) == {57, 130} and found.verdict == "none"


# --- linear algebra ----------------------------------------------------------------------------------


def at_base(clean):
    problem = clean.loop._weighted(clean.loop.problem)
    return problem, jnp.asarray(clean.found.base.hypothesis.z[: len(problem.coordinates)])


def test_signatures_are_differences_of_runs(clean, engine):
    """At the first and the last point of each shape's grid, through everything that an effect remembers."""
    problem, z = at_base(clean)
    robot, linear = problem.robot(z), clean.found.base.linear
    read = jax.jit(lambda r: problem.whitened(problem.observe(r), problem.data)[: problem.data.measured.size])
    for k, candidate in enumerate(engine.candidates):
        mine = np.flatnonzero(engine.of == k)
        for point in {0, len(candidate.at) - 1}:
            effect = candidate.effect
            if candidate.name:
                effect = params.replace(effect, {candidate.name: jnp.asarray(candidate.values[point])})
            sides = [
                dataclasses.replace(
                    robot, effects=(dataclasses.replace(effect, amplitude=jnp.asarray(s * effect.amplitude)),)
                )
                for s in (1e-3, -1e-3)
            ]
            expected = np.asarray(read(sides[0]) - read(sides[1])) / 2e-3
            got = np.asarray(linear.signatures)[:, mine[point]]
            assert np.linalg.norm(got - expected) < 5e-3 * np.linalg.norm(expected), (effect.name, point)


@pytest.mark.parametrize("balance", curves.BALANCES)
def test_columns_are_differences_of_runs_with_a_curve(clean, balance):
    """A defect over time, laid through the samples, against the curve effect that is the same over time."""
    problem, z = at_base(clean)
    linear = clean.found.base.linear
    effect = UNNAMED[f"curve_{balance}_time"]
    shape = {"low": 0.0, "high": 0.8, "y0": 0.5, "y1": 0.7, "y2": 0.9, "y3": 1.0, "y4": 1.2, "y5": 0.8}
    size = 1e-3 * effect().amplitude + 1e-3 * {"electrical": 1.0, "track": 0.2, "ground": 4.0, "slip": 0.05}[balance]
    read = jax.jit(lambda r: problem.whitened(problem.observe(r), problem.data)[: problem.data.measured.size])
    made = params.replace(effect(), {k: jnp.asarray(v) for k, v in shape.items()})
    sides = [
        dataclasses.replace(problem.robot(z), effects=(dataclasses.replace(made, amplitude=jnp.asarray(s * size)),))
        for s in (1, -1)
    ]
    expected = np.asarray(read(sides[0]) - read(sides[1])) / (2 * float(size))
    from mmrjax.effects.curve import weights

    y = jnp.asarray([shape[f"y{k}"] for k in range(6)])
    along = np.asarray(linear.signals.direction if balance != "ground" else linear.signals.direction_travel)
    over_time = np.asarray(weights(linear.series.time, 0.0, 0.8) @ y) * along
    got = np.asarray(linear.columns(trace.PROBED.index(balance), jnp.asarray(over_time[:, None])))[:, 0]
    # linear between samples 20 ms apart; at the start the direction rises within the first of them
    assert np.linalg.norm(got - expected) < 0.05 * np.linalg.norm(expected)
    assert np.linalg.norm(expected) > 0


def test_linear_bootstrap_is_that_of_refits(clean):
    """Statistics of replicates by the linear refit, against a few histories drawn and fitted again in full."""
    there, null = clean.loop, clean.found.base.gate.null
    problem, z = at_base(clean)
    key = jax.random.key(3)
    draw = jax.random.normal(key, (6, *problem.data.measured.shape))
    clean_reading = problem.observation(z).reading

    def chi2(noise_):
        data = dataclasses.replace(problem.data, measured=clean_reading + problem.data.sd * noise_, centre=z)
        back = trace.gauss_newton(problem, z, data, 3)
        return jnp.sum(problem.misfit(back, data) ** 2) + jnp.sum((back - z) ** 2), jnp.sum(noise_**2)

    after, before = jax.jit(lambda d: jax.lax.map(chi2, d))(draw)
    taken = np.asarray(before - after)  # what a refit of so many parameters takes
    p = len(problem.coordinates)
    assert (taken > 0).all() and taken.mean() < p
    readings = 3 * len(there.runs)
    assert abs(np.mean(null.chi2) - readings) < 4 * np.sqrt(2 * readings / len(null.chi2))
    assert stats.kstest(null.chi2, stats.chi2(readings).cdf).pvalue > 0.01


def test_memory_tells_noise_from_what_remembers(clean):
    linear = clean.found.base.linear
    rng = np.random.default_rng(0)
    rows = np.asarray(linear.series.rows)
    whole = np.asarray(linear.residual).size

    def of(x):
        residual = np.zeros(whole)
        residual[: 3 * linear.rows] = np.asarray(x).ravel()
        return float(trace.memory(dataclasses.replace(linear, residual=jnp.asarray(residual))))

    white = [of(rng.standard_normal((linear.rows, 3))) for _ in range(60)]
    assert -1.0 < np.mean(white) < 2.0 and np.quantile(white, 0.95) < 5.0
    slow = rng.standard_normal((linear.rows, 3))
    for run in rows:
        for a, b in itertools.pairwise(run):
            slow[b, 1] = 0.7 * slow[a, 1] + 0.71 * slow[b, 1]
    assert of(slow) > 2 * np.max(white) > 0


def test_knots_of_a_short_run_in_any_order_end_with_its_last_sample(clean):
    runs = clean.loop.runs
    short = runs.where((runs["run_id"] != "start1") | (runs["time_s"] < 0.5))
    mixed = short.where(np.random.default_rng(0).permutation(len(short)))
    observer = problem.series(mixed)
    times, names = mixed["time_s"], mixed["run_id"]
    for k, name in enumerate(np.unique(names)):
        there = times[np.asarray(observer.knots[k])]
        assert (np.diff(there) >= 0).all() and there[-1] == times[names == name].max()
        assert set(names[np.asarray(observer.knots[k])]) == {name}
        row = np.asarray(observer.rows[k])
        assert (np.diff(times[row[row >= 0]]) > 0).all() and (row >= 0).sum() == (names == name).sum()


# --- the door ----------------------------------------------------------------------------------------


def test_histories_that_do_not_start_from_rest_are_refused(clean):
    runs = clean.loop.runs
    late = runs.where(runs["time_s"] > 0.3)
    late.columns["time_s"] = late["time_s"] - 0.32
    with pytest.raises(BadData, match=r"run start0 is moving at 0 s .* starts from rest"):
        checks.from_rest(late, noise.of(late))
    checks.from_rest(runs, noise.of(runs))


def test_assumed_noise_of_histories_does_not_vanish_at_the_start(clean):
    bare = {k: v for k, v in clean.loop.runs.columns.items() if "_sd_" not in k}
    sd = noise.assumed(records.Runs("bare", bare)).sd
    assert (np.ptp(sd, axis=0) == 0).all()
    current = bare["total_current_A"]
    np.testing.assert_allclose(sd[0, 0], 0.02 * np.sqrt(np.mean(current**2)))


def test_phase_is_a_shape_and_covers_half_a_turn():
    effect = BY_NAME["pulley_eccentricity"]()
    shape = slots.shape_of(effect)
    assert shape.name == "phase"
    candidate = slots.scored(effect)
    # sin(ψ + φ) of any φ lies within 18 degrees of the grid, with either sign
    wanted = np.linspace(-np.pi, np.pi, 400)
    best = np.max(np.abs(np.cos(wanted[:, None] - np.asarray(candidate.values))), 1)
    assert best.min() > np.cos(np.radians(18.1))
    np.testing.assert_allclose(candidate.values, 2.0 * np.asarray(candidate.at))
