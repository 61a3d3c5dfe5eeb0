"""The closed loop on synthetic histories: verdicts, and its linear algebra against differentiated runs."""

import itertools
from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose
from scipy import stats
from synthetic import STATED, Analyst, parts, table
from worlds import histories

from calibration.data.runs import Runs
from calibration.discovery.discrepancy import BaseCurve, locate_discrepancy
from calibration.discovery.settings import settings_for
from calibration.discovery.standing import judge_names
from calibration.inference import noise
from calibration.inference.bases import BALANCES
from calibration.inference.linearization import PROBED, free_shape_parameter, with_shape_grid
from calibration.inference.observers import Histories
from calibration.inference.optimizers import levenberg_marquardt
from mmrjax.effects import BY_NAME, UNNAMED
from mmrjax.effects.curve import ordinate_weights
from mmrjax.model import params

#: What these histories are searched for; the whole library is what the command and the campaign search.
SEARCHED = ("rotating_inertia", "series_resistance", "churning", "grouser_polygon", "pulley_eccentricity")
#: All histories have the same instants, and share what is compiled.
ANALYST = Analyst(
    replace(settings_for(Histories, 300), slots=1),
    {n: BY_NAME[n] for n in SEARCHED},
    STATED | {f"{c}.ground.friction.dynamic": (0.48, 0.08) for c in ("6T2A", "4W2T")},
)


def case(*names, sigmas=12.0, seed=1):
    """Four of six starts: both configurations at the least and at the highest voltage."""
    made = histories.narrow(names, sigmas, seed, duration=0.8, every=0.02)
    runs = table(made)
    return runs.where(np.isin(runs["run_id"], ["start0", "start2", "start3", "start5"])), made.label


@pytest.fixture(scope="module")
def runs():
    """Histories in which nothing is missing."""
    return case(seed=1)[0]


@pytest.fixture(scope="module")
def clean(runs):
    """The same through the stages of the loop."""
    return parts(runs, ANALYST.trace(runs))


@pytest.fixture(scope="module")
def seen(runs, clean):
    """Runs, space, coordinates and the linear model where the loop's fit ends."""
    space, z = clean.space, clean.base.z[: clean.space.free]
    # Without the run that is already known, because robots with other effects are simulated here.
    problem = replace(space.bare, observe=replace(space.bare.observe, simulated_runs=None))
    read = jax.jit(lambda r: problem.whitened(problem.observe(r))[: problem.data.measured.size])
    return SimpleNamespace(
        runs=runs, space=space, problem=problem, z=jnp.asarray(z), linear=clean.left.linear, read=read
    )


@pytest.fixture(scope="module")
def oval():
    """A bent pulley, twice a turn, which the library does not have: the stages of the loop."""
    runs, label = case("pulley_ovality", sigmas=15.0, seed=7)
    at = parts(runs, ANALYST.trace(runs))
    at.searched, at.label = at.traced.searched, label["effects"][0]
    return at


# --- verdicts ---------------------------------------------------------------------------------------


@pytest.mark.nightly
def test_eccentric_pulley_is_named_with_its_amplitude_and_phase():
    runs, label = case("pulley_eccentricity", seed=2)
    found = ANALYST.discover(runs)
    assert found.verdict == "named" and [list(e.members) for e in found.effects] == [["pulley_eccentricity"]]
    (effect,) = found.effects
    truth = label["effects"][0]
    a, phase = effect.parameters["amplitude"], effect.parameters["phase"]
    # of either sign: sin(ψ + φ) = -sin(ψ + φ + π)
    turned = abs(a.value) * np.exp(1j * (phase.value + (np.pi if a.value < 0 else 0.0)))
    assert abs(turned - truth["amplitude"] * np.exp(1j * truth["shapes"]["phase"])) < 4 * a.sd
    assert 0 < a.sd < 0.2 * truth["amplitude"]
    assert [e.name for e in found.robot.effects] == ["pulley_eccentricity"]


@pytest.mark.slow
def test_wave_outside_the_library_gets_its_balance_and_order_but_no_name(oval):
    space, left, searched = oval.space, oval.left, oval.searched
    assert left.test.rejected
    stood = judge_names(BaseCurve(space, oval.base, left, oval.bases), searched)
    assert not stood.stands and stood.why
    where = locate_discrepancy(left, oval.bases, space.included)
    assert {"track", "gearbox", "motor"} <= {where.balance, *where.alike}
    assert where.variable == "order 2 of the driving shaft"
    told = space.bare.observe.detail(oval.bases, space.included, left, left).before
    strength = {order: s.explained for (order, _), s in told.orders.items()}
    assert max(strength, key=strength.get) == where.variable
    assert strength[where.variable] > 2 * strength["order 3 of the driving shaft"]


# --- linear algebra ----------------------------------------------------------------------------------


def difference(seen, effect, size):
    """Whitened readings per amplitude of an effect, by runs with it and with its opposite."""
    ahead, behind = (
        seen.read(replace(seen.problem.robot(seen.z), effects=(replace(effect, amplitude=jnp.asarray(s)),)))
        for s in (size, -size)
    )
    return np.asarray(ahead - behind) / (2 * size)


@pytest.mark.slow
def test_signatures_are_differences_of_runs(seen):
    """At the first and the last point of each shape's grid, through everything that an effect remembers."""
    linear, library = seen.linear, seen.space.library
    for k, instances in enumerate(library.scored):
        mine = np.flatnonzero(library.of == k)
        for point in {0, len(instances.at) - 1}:
            effect = instances.effect
            if instances.shape:
                effect = params.replace(effect, {instances.shape: jnp.asarray(instances.values[point])})
            size = float(effect.amplitude)
            expected = size * difference(seen, effect, 1e-3 * size)
            off = np.asarray(linear.signatures)[:, mine[point]] - expected
            assert np.linalg.norm(off) < 5e-3 * np.linalg.norm(expected), (effect.name, point)


@pytest.mark.slow
@pytest.mark.parametrize("balance", BALANCES)
def test_columns_are_differences_of_runs_with_a_curve(seen, balance):
    """A defect over time, laid through the samples, against the curve effect that is the same over time."""
    linear, effect = seen.linear, UNNAMED[f"curve_{balance}_time"]
    y = np.array([0.5, 0.7, 0.9, 1.0, 1.2, 0.8])
    shape = {"low": 0.0, "high": 0.8} | {f"y{k}": x for k, x in enumerate(y)}
    size = 1e-3 * effect().amplitude + 1e-3 * {"electrical": 1.0, "track": 0.2, "ground": 4.0, "slip": 0.05}[balance]
    made = params.replace(effect(), {k: jnp.asarray(v) for k, v in shape.items()})
    expected = difference(seen, made, float(size))
    along = linear.signals.direction if balance != "ground" else linear.signals.direction_travel
    over_time = (ordinate_weights(linear.time, 0.0, 0.8) @ y) * along
    got = np.asarray(linear.columns(PROBED.index(balance), jnp.asarray(over_time[:, None])))[:, 0]
    # linear between samples 20 ms apart; at the start the direction rises within the first of them
    assert np.linalg.norm(got - expected) < 0.05 * np.linalg.norm(expected)
    assert np.linalg.norm(expected) > 0


def is_of_noise(null, readings):
    """χ² of tables drawn from a fit and fitted again is that of as many readings."""
    of_noise = stats.chi2(readings).cdf
    assert abs(np.mean(null.chi2) - readings) < 4 * np.sqrt(2 * readings / len(null.chi2))
    assert stats.kstest(null.chi2, of_noise).pvalue > 0.01
    assert stats.kstest(1.1 * null.chi2, of_noise).pvalue < 0.01  # the test can fail


@pytest.mark.slow
def test_linear_bootstrap_is_that_of_refits(clean, seen):
    """Statistics of replicates by the linear refit, against a few histories drawn and fitted again in full."""
    is_of_noise(clean.left.test.null, 3 * len(clean.runs))
    problem, z = seen.problem, seen.z
    draw = jax.random.normal(jax.random.key(3), (6, *problem.data.measured.shape))
    clean_reading = problem.observation(z).reading

    def taken(noise_):
        drawn = problem.with_data(measured=clean_reading + problem.data.sd * noise_, centre=z)
        back = levenberg_marquardt(drawn, z, max_steps=6)[0].z
        return jnp.sum(noise_**2) - jnp.sum(drawn.misfit(back) ** 2) - jnp.sum((back - z) ** 2)

    of_refit = np.asarray(jax.jit(lambda d: jax.lax.map(taken, d))(draw))
    assert (of_refit > 0).all() and of_refit.mean() < len(problem.coordinates)


@pytest.mark.slow
def test_memory_tells_noise_from_what_remembers(seen):
    linear, rng = seen.linear, default_rng(0)

    def of(x):
        residual = np.zeros(linear.residual.size)
        residual[: 3 * linear.rows] = x.ravel()
        return float(replace(linear, residual=jnp.asarray(residual)).autocorrelation())

    white = [of(rng.standard_normal((linear.rows, 3))) for _ in range(60)]
    assert -1.0 < np.mean(white) < 2.0 and np.quantile(white, 0.95) < 5.0
    slow = rng.standard_normal((linear.rows, 3))
    for run in np.asarray(linear.rows_of):
        for a, b in itertools.pairwise(run):
            slow[b, 1] = 0.85 * slow[a, 1] + 0.53 * slow[b, 1]
    assert of(slow) > 2 * np.max(white) > 0


@pytest.mark.slow
def test_knots_of_a_short_run_in_any_order_end_with_its_last_sample(runs, robot):
    short = runs.where((runs["run_id"] != "start2") | (runs["time_s"] < 0.5))
    mixed = short.where(default_rng(0).permutation(len(short)))
    observer, times, names = Histories.of(mixed, robot), mixed["time_s"], mixed["run_id"]
    for name, knots, row in zip(
        np.unique(names), np.asarray(observer.knots), np.asarray(observer.rows_of), strict=True
    ):
        there = times[knots]
        assert (np.diff(there) >= 0).all() and there[-1] == times[names == name].max()
        assert set(names[knots]) == {name}
        assert (np.diff(times[row[row >= 0]]) > 0).all() and (row >= 0).sum() == (names == name).sum()


def test_included_runs_of_a_log_are_counted_not_its_rows(runs, robot):
    names = runs["run_id"]
    included = Histories.of(runs, robot).number_of_included_runs(names != names[0])
    assert included == len(np.unique(names)) - 1


# --- input checks ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_assumed_noise_of_histories_does_not_vanish_at_the_start(runs):
    bare = {k: v for k, v in runs.columns.items() if "_sd_" not in k}
    made = Runs("bare", bare)
    sd = noise.infer_noise(made, Histories.sizes(made)).sd
    assert (np.ptp(sd, axis=0) == 0).all()
    assert_allclose(sd[0, 0], np.mean(runs["total_current_sd_A"]), rtol=0.1)  # as its series shows


def test_phase_is_a_shape_and_covers_half_a_turn():
    effect = BY_NAME["pulley_eccentricity"]()
    shape = free_shape_parameter(effect)
    assert shape.name == "phase"
    instances = with_shape_grid(effect)
    # sin(ψ + φ) of any φ lies within 18 degrees of the grid, with either sign
    wanted = np.linspace(-np.pi, np.pi, 400)
    best = np.max(np.abs(np.cos(wanted[:, None] - np.asarray(instances.values))), 1)
    assert best.min() > np.cos(np.radians(18.1))
    assert_allclose(instances.values, 2.0 * np.asarray(instances.at))
