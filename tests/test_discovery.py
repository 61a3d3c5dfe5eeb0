"""The closed loop on synthetic tables: verdicts, what it sets aside, its statistics against a second implementation."""

from dataclasses import replace
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose
from scipy import stats
from synthetic import FEW, SETTLED, known, parts, small, table
from worlds import settled, tables

from calibration.data.runs import read_runs as read_runs
from calibration.discovery import scales
from calibration.discovery.score_tests import bootstrap_statistics, diagnose_fit, normal_deviate, score_tests
from calibration.inference.bases import Basis
from calibration.inference.blocks import hold_out_blocks
from calibration.inference.linearization import PROBED, amplitude_of, free_shape_parameter, with_shape_grid
from calibration.inference.observers import SettledRuns
from calibration.inference.observers.settled import SettledLinearization
from calibration.inference.optimizers import observe_at
from mmrjax.effects import BY_NAME
from mmrjax.model import channels, params


@pytest.fixture(scope="module", params=["few", pytest.param("many", marks=pytest.mark.slow)])
def looks(request):
    """Who looks, at which runs, and for which effects signatures are compared."""
    if request.param == "few":
        return SimpleNamespace(analyst=FEW, grid=small, library=FEW.library)
    return SimpleNamespace(analyst=SETTLED, grid=settled.table8, library=BY_NAME)


@pytest.fixture(scope="module")
def clean(looks):
    """A table in which nothing is missing, through the stages of the loop."""
    runs = table(tables.narrow(seed=2, grid=looks.grid))
    return parts(runs, looks.analyst.trace(runs))


@pytest.fixture(scope="module")
def churning(looks):
    """Ten sigmas of churning, through the stages of the loop."""
    case = tables.narrow(["churning"], 10.0, seed=4, grid=looks.grid)
    runs = table(case)
    return SimpleNamespace(**vars(parts(runs, looks.analyst.trace(runs))), label=case.label)


def classes(traced):
    return [set(members) for members in traced.members]


def changed(runs, column, row, by):
    values = runs[column].copy()
    values[row] += by
    return replace(runs, columns=runs.columns | {column: values})


def joined(runs, more):
    return replace(runs, columns={k: np.concatenate([v, more[k]]) for k, v in runs.columns.items()})


def set_aside(traced):
    return traced.screened.outliers, traced.screened.base.unusable


# --- verdicts ---------------------------------------------------------------------------------------


def test_clean_table_lacks_nothing(clean):
    found = clean.traced
    assert found.verdict == "none" and found.members == found.families == ()
    assert found.searched is found.where is found.standing is None
    assert found.best is clean.base and found.ends is clean.left and set_aside(found) == ((), ())
    assert clean.left.test.p_value > 0.05
    # χ² of readings and priors is what noise leaves of as many readings
    readings, null = 3 * len(clean.runs), clean.left.test.null
    assert abs(2 * clean.base.cost - readings) < 4 * np.sqrt(2 * readings)
    assert abs(np.mean(null.chi2) - readings) < 4 * np.sqrt(2 * readings / len(null.chi2))


def test_two_effects_are_both_found(looks):
    case = tables.narrow(["series_resistance", "mass_offset"], 12.0, seed=3, grid=looks.grid)
    found = looks.analyst.trace(table(case))
    resistance, mass = sorted(classes(found), key=lambda c: "mass_offset" in c)
    # a common and a private resistance: one current flows in both
    assert {"series_resistance", "supply_sag"} <= resistance and "mass_offset" in mass
    assert found.verdict == "class"


# --- what is set aside -------------------------------------------------------------------------------


def test_reading_that_stands_alone_is_an_outlier(clean, looks):
    runs = changed(clean.runs, "speed_mm_s", 17, 15 * clean.runs["speed_sd_mm_s"][17])
    found = looks.analyst.discover(runs)
    assert found.outliers == (18,) and found.verdict == "none" and found.unusable == ()  # rows count from 1
    assert not found.included[17] and found.included.sum() == len(clean.runs) - 1
    assert found.rms["before"]["speed"] < 2 * np.max(clean.runs["speed_sd_mm_s"]), found.rms


def test_rows_beyond_the_model_are_kept_out(clean, looks):
    rows = len(clean.runs)
    kept = clean.runs.where(np.arange(rows - 2))
    steep = clean.runs.where(np.array([0, rows - 1]))
    steep.columns["slope_deg"][:] = -44.0  # downhill it slides, whatever adhesion is within reach
    fitted, without = (looks.analyst.base(runs) for runs in (joined(kept, steep), kept))
    assert fitted.unusable == (rows - 2, rows - 1) and fitted.space.included[:rows].sum() == rows - 2
    p = fitted.space.free
    assert_allclose(fitted.candidate.z[:p], without.candidate.z[:p], atol=0.1)


# --- invariances -------------------------------------------------------------------------------------


@pytest.mark.slow
def test_order_of_rows_does_not_matter(churning, looks):
    runs, before = churning.runs, churning.traced
    found = looks.analyst.trace(runs.where(default_rng(0).permutation(len(runs))))
    assert found.verdict == before.verdict and classes(found) == classes(before)
    assert_allclose(found.screened.base.candidate.cost, churning.base.cost, rtol=1e-5)
    assert_allclose(found.left.scores.single, before.left.scores.single, atol=0.02)
    assert np.abs(before.left.scores.single).max() > 5


# --- statistics --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_held_out_readings_are_those_of_a_refit_without_the_block(clean, looks):
    runs, sd = clean.runs, known(clean.runs).sd
    block = (runs["slope_deg"] == runs["slope_deg"].max()) & (runs["supply_voltage_V"] == 15)
    for row in np.flatnonzero(block):  # so far off that whoever has seen the block shows it
        runs = changed(runs, "speed_mm_s", row, 15 * runs["speed_sd_mm_s"][row])
    fitted, brute = looks.analyst.base(runs), looks.analyst.base(runs.where(~block))
    out = hold_out_blocks(fitted.space.equipped, fitted.candidate.z, [block], (-1,) * looks.analyst.settings.slots)
    seen = observe_at(fitted.space.bare, jnp.asarray(brute.candidate.z[: brute.space.free]))
    expected = np.asarray(seen.reading)[: len(runs)]
    assert out.converged.all() and block.sum() in (4, 6) and np.isnan(out.reading[~block]).all()
    off, off_if_seen = (np.abs(x[: len(runs)] - expected)[block] / sd[block] for x in (out.reading, fitted.reading))
    assert (off < 0.05).all() and (off_if_seen > 1).any()


@pytest.mark.slow
def test_signatures_are_derivatives_of_the_readings(clean, looks):
    """Of the whole library, against differentiation of the steady model in every amplitude, at two points a shape."""
    problem = clean.space.bare
    z = jnp.asarray(clean.base.z[: clean.space.free])
    library = scales.visible_effects(looks.library, problem.base, SettledRuns)
    names, shapes = [e.name for e in library], [free_shape_parameter(e) for e in library]
    unit = jnp.asarray([amplitude_of(e).spec.prior_sd(0.0) for e in library])
    instances = tuple(with_shape_grid(e, (-1.5, 0.75)) for e in library)
    robot = replace(problem.robot(z), effects=library)
    linear = jax.jit(lambda z: problem.observe.linearise(problem, z, instances))(z)

    @jax.jit
    @jax.jacfwd
    def direct(amplitude, values):
        there = {f"effects.{n}.amplitude": a for n, a in zip(names, amplitude * unit, strict=True)}
        there |= {f"effects.{n}.{s.name}": v for n, s, v in zip(names, shapes, values, strict=True) if s}
        seen = problem.observe(params.replace(robot, there))
        return problem.whitened(seen)[: problem.data.measured.size]

    first = np.cumsum([0, *(len(c.at) for c in instances)])[:-1]
    for point in (0, 1):
        values = jnp.asarray([c.values[point] if c.shape else 1.0 for c in instances])
        expected = np.asarray(direct(jnp.zeros(len(names)), values))
        got = np.asarray(linear.signatures)[:, first + [point if c.shape else 0 for c in instances]]
        scale = np.abs(expected).max(0)
        # These rows climb: no load drives a gear.
        hidden = {n for n, s in zip(names, scale, strict=True) if s == 0}
        assert len(names) > (30 if looks.library is BY_NAME else 4) and hidden == {"backdriving_loss"} & set(names)
        shown = scale > 0
        assert_allclose(got[:, shown] / scale[shown], expected[:, shown] / scale[shown], atol=1e-9)
        assert not got[:, ~shown].any()


@pytest.fixture(scope="module")
def toy():
    """A linear problem of 8 rows and 4 coordinates with 5 instances and two curves."""
    rng = default_rng(7)
    rows, p = 8, 4
    jacobian = np.concatenate([rng.standard_normal((3 * rows, p)), np.zeros((rows, p)), np.eye(p)])
    e = np.concatenate([rng.standard_normal(3 * rows), np.zeros(rows), rng.standard_normal(p)])
    signatures = 3 * rng.standard_normal((3 * rows, 5))
    signatures[:, 3] = 2 * signatures[:, 0] + 1e-3 * signatures[:, 3]  # look-alikes
    defects = rng.standard_normal((len(PROBED), rows, 3))
    columns = rng.standard_normal((2, rows, 3))
    basis = Basis.of(columns, (("electrical", "a"), ("track", "b")))
    shown = Basis.of(columns, (("speed", "a"), ("total_current", "b")))
    scale = rng.uniform(0.5, 2.0, (rows, 3))
    linear = SettledLinearization(
        *map(jnp.asarray, (e, jacobian, signatures, defects, scale)), None, channels=channels.USUAL
    )
    return SimpleNamespace(
        linear=linear, bases=(basis, shown), scores=eqx.filter_jit(score_tests)(linear, (basis, shown))
    )


def long(linear, columns):
    """Columns over the readings, and zeros over the priors."""
    return np.pad(columns, ((0, len(linear.residual) - len(columns)), (0, 0)))


def left(linear, columns):
    """What a least-squares fit of the free coordinates leaves of columns over the readings."""
    jacobian, columns = np.asarray(linear.jacobian), long(linear, columns)
    return columns - jacobian @ np.linalg.lstsq(jacobian, columns, rcond=None)[0]


def fall(linear, columns):
    """Fall of the sum of squares when columns over the readings are fitted beside the free coordinates."""
    e, jacobian = np.asarray(linear.residual), np.asarray(linear.jacobian)

    def squares(a):
        return float(np.sum((e - a @ np.linalg.lstsq(a, e, rcond=None)[0]) ** 2))

    return squares(jacobian) - squares(np.concatenate([jacobian, long(linear, columns)], 1))


def test_scores_are_falls_of_the_sum_of_squares(toy):
    scores, g_ = toy.scores, np.asarray(toy.linear.signatures)
    e, r = np.asarray(toy.linear.residual), left(toy.linear, np.asarray(toy.linear.signatures))
    norm = np.linalg.norm(r, axis=0)
    assert_allclose(scores.single, -(r.T @ e) / norm, rtol=1e-9)
    assert_allclose(scores.single**2, [fall(toy.linear, g_[:, [k]]) for k in range(5)], rtol=1e-9)
    assert_allclose(scores.amplitude, -(r.T @ e) / norm**2, rtol=1e-9)
    assert_allclose(scores.left, norm, rtol=1e-9)
    assert_allclose(scores.cosine, r.T @ r / np.outer(norm, norm), atol=1e-9)
    for i, j in ((0, 1), (1, 2), (2, 4)):
        assert_allclose(scores.pair[i, j], fall(toy.linear, g_[:, [i, j]]), rtol=1e-8)
    assert scores.pair[0, 3] == scores.pair[3, 0] == 0 < fall(toy.linear, g_[:, [0, 3]])  # not told apart
    reading = np.eye(len(g_))
    assert_allclose(np.ravel(scores.row) ** 2, [fall(toy.linear, reading[:, [k]]) for k in range(len(g_))], rtol=1e-8)


def test_normal_deviates_are_those_of_chi2():
    z = np.array([-2, -1, -0.1, 0, 0.3, 1, 2, 4, 8])
    for freedom in (1.0, 2.0, 5.0, 20.0):
        chi2 = stats.chi2.isf(stats.norm.sf(z), freedom)
        assert_allclose(normal_deviate(jnp.asarray(chi2), jnp.asarray(freedom)), z, atol=0.04)
    assert np.isfinite(normal_deviate(jnp.asarray([0.0, 1e-300, 3.0, 1e9]), jnp.asarray(3.0))).all()


def test_curve_scores_are_ridge_regressions(toy):
    e = np.asarray(toy.linear.residual)
    of_channel = [np.asarray(toy.linear.scale) * (np.arange(3) == k) for k in (2, 0)]  # speed, total current
    moves = [*np.asarray(toy.linear.defects)[[2, 5]], *of_channel]
    for k, move in enumerate(moves):
        columns = move[..., None] * np.asarray(toy.bases[k // 2].columns)[k % 2][:, None, :]
        r = left(toy.linear, columns.reshape(-1, 3))
        r *= 10 / np.linalg.norm(r, axis=0)
        inverse = np.linalg.inv(r.T @ r + np.eye(3))
        explained = (r.T @ e) @ inverse @ (r.T @ e)
        assert_allclose(toy.scores.explained[k], explained, rtol=1e-9)
        freedom = np.trace(r.T @ r @ inverse)
        deviate = stats.norm.isf(stats.chi2.sf(explained, freedom))
        assert_allclose(toy.scores.curve[k], deviate, atol=0.03)


def test_column_within_the_fit_scores_nothing(toy):
    """A signature that the free coordinates make by themselves, but for their priors' share, has no score."""
    linear = toy.linear
    inside = np.asarray(linear.jacobian)[:24] @ np.ones((4, 1))
    flat = replace(linear, jacobian=linear.jacobian.at[-4:].multiply(1e-6), signatures=jnp.asarray(inside))
    scores = score_tests(flat, ())
    assert scores.single[0] == scores.amplitude[0] == 0 < abs(toy.scores.single).min()


def test_diagnosis_is_that_of_the_fit_and_of_the_rows_that_count(clean):
    space, z = clean.space, jnp.asarray(clean.base.z)

    def residual(space, z):
        problem = space.problem(clean.base.active)
        return np.asarray(diagnose_fit(problem, z, space.library.scored, clean.bases)[0].residual)

    first = residual(space, z)
    np.testing.assert_array_equal(first, clean.left.linear.residual)
    assert not np.allclose(residual(space, z + 0.1), first)
    fewer = residual(space.without(np.array([0])), z)
    assert (fewer[:3] == 0).all() and (first[:3] != 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("looks", ["many"], indirect=True)
def test_null_of_one_column_is_normal(clean):
    """|score| of one effect in tables drawn from the fit and fitted again is that of a standard normal."""
    space = clean.space
    one = (with_shape_grid(space.library["ammeter_offset"]),)
    problem, z = space.bare, clean.base.z[: space.free]
    null = bootstrap_statistics(problem, z, clean.left.linear, one, clean.bases[:1], 384, 0)
    assert len(null.single) > 370
    assert stats.kstest(null.single, stats.halfnorm.cdf).pvalue > 0.02
    for factor in (0.8, 1.25):  # the test can fail
        assert stats.kstest(factor * null.single, stats.halfnorm.cdf).pvalue < 0.02
    # χ² of readings and priors less the coordinates that were fitted
    freedom = 3 * len(clean.runs)
    assert abs(np.mean(null.chi2) - freedom) < 4 * np.sqrt(2 * freedom / len(null.chi2))
