"""Discrepancies outside the library: their curve, the robot that has it, and the formula that is proposed."""

from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose
from synthetic import SETTLED, table
from test_implausible import unnamed
from worlds import settled, tables

from calibration.data.robot_file import load_robot, write_robot
from calibration.discovery import outliers
from calibration.discovery.discrepancy import (
    BaseCurve,
    location_columns,
    refine_window,
    similar_variables,
)
from calibration.discovery.formula import MOST, RATIOS, SYMBOL, Monomial, monomial_dictionary, propose_formula
from calibration.discovery.location import DiscrepancyLocation
from calibration.discovery.projection import balance_error_by_row
from calibration.discovery.score_tests import diagnose_fit
from calibration.discovery.smooth import fit_smooth_curve
from calibration.inference.bases import BALANCES, OF_TURNS
from calibration.inference.blocks import hold_out_blocks
from calibration.inference.linearization import PROBED
from calibration.inference.observers.settled import SettledLinearization
from calibration.words import loop_words
from mmrjax.effects.curve import PLACES
from mmrjax.fidelities.steady import steady_batch
from mmrjax.model import channels

#: An effect that no library holds → balance and variable that it acts through.
CASES = {"commutation_step": ("electrical", "voltage"), "guide_binding": ("track", "payload")}


@pytest.fixture(scope="module", params=[pytest.param(c, marks=pytest.mark.slow) for c in CASES])
def found(request):
    """A case of 12 sigmas, its base fit, and the discrepancy that is fitted to what that leaves."""
    case = tables.narrow([request.param], 12.0, seed=1)
    runs = table(case)
    fitted = SETTLED.base(runs)
    space, base = fitted.space, fitted.candidate
    bare = space.problem(base.active)
    seen = diagnose_fit(bare, jnp.asarray(base.z), space.library.scored, outliers.bases_at_fit(runs, fitted))
    linear = jax.device_get(seen[0])
    beside = BaseCurve(space, base, SimpleNamespace(linear=linear), ())
    vars(beside)["where"] = DiscrepancyLocation(*CASES[request.param], (), (), 0.0, 0.0)  # in place of a search
    truth, sound = settled.readings(case.conditions, case.constants, case.terms)
    s, _ = settled.solve(case.conditions, case.constants, case.terms)
    term = case.terms[0].of(s)
    return SimpleNamespace(
        case=case,
        runs=runs,
        space=space,
        base=base,
        linear=linear,
        beside=beside,
        what=beside.fitted,
        balance=beside.where.place,
        variable=beside.where.variable,
        truth=truth[:, sound].T,
        term=term[sound],
    )


def sigmas(found, reading):
    """Rms error against the noise-free truth, by channel [σ of a reading]."""
    sd = np.asarray(found.space.bare.data.sd)[: len(reading)]
    return np.sqrt(np.mean(((reading - found.truth) / sd) ** 2, 0))


def at_rows(found, values):
    """What is known on the grid, at the rows of the table."""
    x = np.asarray(getattr(found.linear.signals, found.variable))[: len(found.runs)]
    return np.interp(x, found.what.grid, values)


def test_curve_follows_the_truth_within_its_band(found):
    curve, sd = at_rows(found, found.what.curve), at_rows(found, found.what.sd)
    assert np.mean(np.abs(curve - found.term) < 1.96 * sd) > 0.9
    # beside a level and a trend, which base parameters can hide, it has the shape of the truth
    low, high = found.what.grid[[0, -1]]
    hidden = np.stack([np.ones_like(curve), (at_rows(found, found.what.grid) - low) / (high - low)], 1)
    wrong = curve - found.term
    left = [v - hidden @ np.linalg.lstsq(hidden, v, rcond=None)[0] for v in (wrong, found.term)]
    assert np.linalg.norm(left[0]) < 0.35 * np.linalg.norm(left[1])


def test_curve_takes_the_discrepancy_out_of_the_fit(found):
    before, after = found.what.chi2
    # 12 sigmas are 144 of χ²; six ordinates take no more than 6 of the noise
    assert found.what.converged and 100 < before - after < 200
    assert (sigmas(found, found.what.reading[: len(found.runs)]) < 0.4).all()


def test_curve_lowers_the_error_at_slopes_that_were_not_seen(found):
    slopes = found.runs["slope_deg"]
    blocks = [slopes == s for s in np.unique(slopes)]
    without = hold_out_blocks(found.space.equipped, found.base.z, blocks, (-1, -1))
    with_it = hold_out_blocks(found.what.problem, found.what.z, blocks)
    assert with_it.converged.all() and np.isfinite(with_it.reading).all()
    before, after = (sigmas(found, out.reading) for out in (without, with_it))
    assert after.max() < 0.5 < before.max() and np.sum(after**2) < 0.25 * np.sum(before**2)


def written_and_read(robot, folder):
    write_robot(robot, folder / "robot.toml", note="a discrepancy without a name")
    return load_robot(str(folder / "robot.toml"))


def readings_of(robot, runs):
    reading = steady_batch(robot, runs.conditions(robot)).reading
    return jnp.stack([reading[name] for name in channels.USUAL], -1)


def test_defect_of_each_row_shows_the_discrepancy(found):
    """Its rows scatter about the truth, less what the free parameters absorb of it, by their sds."""
    (value, sd), rows = balance_error_by_row(found.linear, found.balance), len(found.runs)
    change = np.array(found.linear.defects)[PROBED.index(found.balance)]
    change[:rows] *= found.term[:, None]
    change[rows:] = 0
    residual = np.zeros_like(found.linear.residual)
    residual[: change.size] = -change.ravel()
    clean = eqx.tree_at(lambda linear: linear.residual, found.linear, residual)
    expected = balance_error_by_row(clean, found.balance)[0][:rows]
    pull = (value[:rows] - expected) / sd[:rows]
    assert 0.7 < np.sqrt(np.mean(pull**2)) < 1.3
    assert np.corrcoef(expected, value[:rows])[0, 1] > 0.5


def test_formula_finds_the_variable(found):
    """One term where a term explains the curve. No term does for a step of the voltage, which words describe."""
    what, proposal = found.what, found.beside.proposal
    if found.balance == "electrical":
        seen = SimpleNamespace(
            window=None, variable=found.variable, at=what.grid, value=what.curve, unit="V", proposal=proposal
        )
        assert not proposal.terms and loop_words.proposed_formula(seen).startswith("The curve rises from ")
        return
    assert found.variable in proposal.variables
    assert len(proposal.terms) == 1 and proposal.mark == "a proposal, not a finding"
    curve = fit_smooth_curve(found.linear, found.balance, found.variable, found.space.included)
    assert proposal.explained >= MOST * curve.explained > 100
    assert all(abs(c) > 3 * s for c, s in zip(proposal.coefficients, proposal.sds, strict=True))
    assert proposal.expression.startswith(SYMBOL[found.balance] + " = ")
    assert proposal.expression.count(f" {found.beside.unit} (") == len(proposal.terms)


@pytest.mark.slow
def test_curve_of_a_result_is_in_its_robot_and_takes_the_discrepancy_out(tmp_path):
    found = unnamed()
    what = found.unnamed
    assert found.chi2[0] - found.chi2[1] == pytest.approx(what.score) and what.score > 50
    assert found.adequate_after and found.before.rejected
    assert what.at.shape == what.value.shape == what.sd.shape and (what.sd > 0).all()
    assert np.abs(what.value / what.sd).max() > 5
    robot = written_and_read(found.robot, tmp_path)
    assert [e.name for e in robot.effects] == [what.effect]
    assert_allclose(readings_of(robot, found.runs), found.readings_of_rows.after, rtol=1e-9)


# --- the dictionary -------------------------------------------------------------------------------------


def test_dictionary_holds_only_what_is_safe():
    rng = default_rng(3)
    ratios = np.stack([rng.uniform(*b, 40) for b in ((0.5, 1.5), (-1, 1), (0, 2), (1, 1), (0.5, 2))], 1)
    known = monomial_dictionary(ratios)
    powers = {k: {p for m in known for j, p in m.factors if j == k} for k in range(5)}
    assert -1.0 in powers[0] and 0.5 in powers[0]
    assert not {-1.0, 0.5} & powers[1]  # of either sign
    assert -1.0 not in powers[2] and 0.5 in powers[2]  # down to zero
    assert not powers[3]  # stands still
    assert all(np.isfinite(v).all() for v in known.values())
    assert all(len(m.factors) <= 2 for m in known)


def test_dictionary_holds_no_monomial_twice():
    rng = default_rng(3)
    one = rng.uniform(0.5, 1.5, 40)
    ratios = np.stack([one, 2 * one, *rng.uniform(0.5, 1.5, (3, 40))], 1)
    assert not any(m.variables == ("current",) for m in monomial_dictionary(ratios))  # as ω_m, which is first


def test_formula_reads_as_text():
    scaled = tuple(r.scaled(np.array([0.0, -x])) for r, x in zip(RATIOS, (731.0, 1.9, 24.0), strict=False))
    product = Monomial(((1, 2.0), (2, 1.0)), scaled)
    assert str(product) == "(I/2 A)^2 (U/20 V)" and product.variables == ("current", "voltage")


def test_every_place_of_a_curve_has_a_symbol():
    assert set(SYMBOL) == set(PLACES) >= {*BALANCES, *OF_TURNS, *(c.name for c in channels.EVERY)}


def test_no_formula_is_proposed_where_nothing_shows(found):
    blind = eqx.tree_at(lambda linear: linear.defects, found.linear, 0 * np.asarray(found.linear.defects))
    curve = fit_smooth_curve(found.linear, found.balance, found.variable, found.space.included)
    proposal = propose_formula(blind, found.balance, found.space.included, curve)
    assert proposal.expression == "" and proposal.terms == ()
    assert np.isnan(balance_error_by_row(blind, found.balance)[0]).all()


def test_variables_over_which_a_curve_is_as_improbable_are_told():
    """Beside the one that is said, in its own place alone, and along an axis only the best window."""
    names = [
        ("slip", v) for v in ("voltage", "speed_motor", "voltage 24 to 24", "voltage 33 to 33", "slope", "conditions")
    ]
    names.append(("track", "payload"))
    deviate = np.array([9.2, 9.0, 9.9, 9.5, 8.8, 9.8, 9.9])
    assert similar_variables(names, deviate, "slip", "speed_motor") == ("voltage 24 to 24", "voltage")
    assert similar_variables(names, deviate, "slip", "voltage 24 to 24") == ("voltage", "speed_motor")


def test_a_window_is_refined_to_its_rows():
    """Eighty settled rows, of which 13 to 24 lack something in one balance. Coarse windows begin every 2.5 rows."""
    rng = default_rng(5)
    rows, p = 80, 4
    defects = rng.standard_normal((len(PROBED), rows, 3))
    inside = (np.arange(rows) >= 13) & (np.arange(rows) <= 24)
    slopes = rng.standard_normal((3 * rows, p))
    missing = -6.0 * (defects[PROBED.index("track")] * inside[:, None]).ravel()
    residual = np.concatenate([missing + rng.standard_normal(3 * rows), np.zeros(p)])
    jacobian = np.concatenate([slopes, np.eye(p)])
    linear = SettledLinearization(
        *map(jnp.asarray, (residual, jacobian, np.zeros((3 * rows, 1)), defects, np.ones((rows, 3)))),
        SimpleNamespace(order=np.arange(1.0, rows + 1), direction=np.ones(rows)),
        channels=channels.USUAL,
    )
    found, explained = refine_window(linear, "track", "order", np.ones(rows, bool))
    assert (found.low, found.high) == (14, 25) and explained > 60
    half, _ = refine_window(linear, "track", "order", np.arange(rows) % 2 == 0)
    assert (half.low, half.high) == (15, 25)
    columns = location_columns(linear, (), DiscrepancyLocation("track", str(found), (), (), 0.0, 0.0))
    assert abs(np.corrcoef(columns[:, 0], missing)[0, 1]) == pytest.approx(1.0)
