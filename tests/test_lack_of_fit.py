"""Whether a calibration says that its fit is adequate: right where it is, right where it is not, honest where nobody can
tell."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.random import default_rng
from scipy import stats
from scipy.signal import lfilter
from synthetic import table
from worlds import settled, tables

from calibration.data.runs import Runs
from calibration.inference.calibration import calibrate
from calibration.inference.fit_notes import AdequacyFinding
from calibration.inference.lack_of_fit import (
    LEVEL,
    Residuals,
    _replicate_test,
    adequacy_of_residuals,
    judge_adequacy,
    noise_factors,
    noise_remarks,
    variance_of_sums,
)
from calibration.inference.observers import SettledRuns
from calibration.inference.simulation_errors import root_mean_square
from mmrjax.model import params

SIGMA = np.array([0.02, 0.5, 3e-3])
GRID = settled.table8()


def toy(rng, noise=1.0, missing=0.0, parameters=8, repeats=1):
    """A linear fit with priors to readings of Table 8's rows, and what `adequacy_of_residuals` takes of it.

    Args:
        noise: true sd over the stated one.
        missing: of a trend of the first channel over the slope [σ].
    """
    rows = np.repeat(np.arange(90), repeats)
    slope, volts, payload = np.degrees(GRID.slope)[rows], GRID.U[rows], GRID.payload[rows]
    level = np.stack([2 + 0.1 * slope, 30 * volts, 0.03 * volts], 1)
    x = np.stack([np.ones(len(rows)), slope / 20, volts / 33, payload / 8], 1)
    jacobian = np.einsum("rx,xcp->rcp", x, 5 * rng.standard_normal((4, 3, parameters))).reshape(-1, parameters)
    truth = rng.standard_normal(parameters)
    e = noise * rng.standard_normal((len(rows), 3))
    e[:, 0] += missing * (1.5 * (slope / 10 - 1) ** 2 - 0.5)
    y = e.ravel() + jacobian @ truth
    whole = np.concatenate([jacobian, np.eye(parameters)])
    z = np.linalg.lstsq(whole, np.append(y, np.zeros(parameters)), rcond=None)[0]
    measured, simulated = (level + x.reshape(-1, 3) * SIGMA for x in (y, jacobian @ z))
    current, motor, speed = measured.T
    columns = {
        "configuration": np.where(GRID.wheeled[rows] > 0.5, "4W2T", "6T2A"), "supply_voltage_V": volts,
        "slope_deg": np.round(slope, 6), "payload_kg": payload, "total_mass_kg": GRID.mass[rows],
        "total_current_A": current, "motor_speed_rpm": motor * 30 / np.pi, "speed_mm_s": speed * 1e3,
    }  # fmt: skip
    runs = Runs("toy", columns)
    whitened = (simulated - runs.measured()) / SIGMA
    return Residuals(SettledRuns, runs, simulated, whitened, np.isfinite(whitened), jacobian, z)


def drifting(made, drift):
    """The same with runs made in random order, and all channels off by so many σ at its beginning, fading."""
    rows = len(made.runs)
    order = default_rng(5).permutation(rows) + 1.0
    whitened = made.whitened + drift * np.exp(-order / 20)[:, None]
    runs = replace(made.runs, columns=made.runs.columns | {"order": order})
    return replace(made, runs=runs, whitened=whitened)


def test_a_drift_from_run_to_run_is_structure_and_no_wrong_sd():
    made = toy(default_rng(6), parameters=3)
    assert noise_factors(drifting(made, 0.0)) == {} and noise_factors(drifting(made, 8.0)) == {}
    assert noise_factors(replace(made, whitened=drifting(made, 8.0).whitened)) != {}  # without the order
    found = judged(drifting(made, 8.0), estimated=True)
    assert found.adequate is False and found.shown_by[1:] == ("follow", "the order of the runs")


def judged(made, estimated=False):
    """Adequacy with the noise stated, or estimated from the misfit as `calibrate` does."""
    return adequacy_of_residuals(made.rescaled() if estimated else made, noise_known=not estimated)


@pytest.mark.slow
@pytest.mark.parametrize("estimated", [False, True])
def test_complete_models_are_called_inadequate_as_often_as_stated(estimated):
    rng = default_rng(1)
    wrong = sum(not judged(toy(rng), estimated).adequate for _ in range(200))
    assert wrong <= stats.binom.ppf(0.999, 200, LEVEL)


@pytest.mark.parametrize("estimated", [False, True])
def test_a_trend_is_found_with_and_without_stated_noise(estimated):
    found = judged(toy(default_rng(2), missing=1.5), estimated)
    assert found.adequate is False and found.p_value < 1e-4
    assert found.shown_by.channel == "total_current" or not estimated


def test_noise_that_is_larger_than_stated_is_not_adequate():
    found = judged(toy(default_rng(3), noise=1.5))
    assert not found.adequate and found.shown_by == AdequacyFinding(what="stated")


def test_replicates_tell_what_the_noise_is():
    made = toy(default_rng(4), missing=1.5, repeats=2)
    (found,) = _replicate_test(made)
    assert found[0] < 0.01 and found[1] == AdequacyFinding(what="repeats")
    clean = toy(default_rng(5), repeats=2)
    assert judged(clean, estimated=True).adequate


def test_adequacy_of_too_few_rows_is_unknown():
    whole, few = toy(default_rng(6), parameters=2), np.arange(0, 90, 30)
    rows = (few[:, None] * 3 + np.arange(3)).ravel()
    some = {name: getattr(whole, name)[few] for name in ("simulated", "whitened", "counts")}
    small = replace(whole, runs=whole.runs.where(few), jacobian=whole.jacobian[rows], **some)
    made = judged(small, estimated=True)
    assert made.adequate is None and made.p_value is None


@pytest.mark.parametrize("missed, noise, estimated, converged, stated_off, obstacle, adequate", [
    (0.0, 1.0, True, True, 9.0, "", True),
    (0.0, 1.0, True, False, 9.0, "not converged", None),
    (0.0, 1.0, True, True, 0.0, "worse", False),
    (0.6, 1.0, True, True, 9.0, "undescribed", False),
    (0.6, 1.0, True, False, 9.0, "undescribed", False),
    (0.6, 200.0, False, True, 900.0, "", True),  # an instrument that is stated to be so coarse
    (0.6, 1.0, False, True, 900.0, "undescribed", False),
])  # fmt: skip
def test_no_test_of_residuals_decides_before_the_fit_is_one(
    missed, noise, estimated, converged, stated_off, obstacle, adequate
):
    """Against the case whose misfit had become its noise: 74 % of the current, worse than as stated, p = 1."""
    made, sd = toy(default_rng(11)), np.tile(SIGMA * [noise, 1.0, 1.0], (90, 1))
    measured, simulated = made.runs.measured(), made.simulated.copy()
    simulated[:, 0] += missed * root_mean_square(measured[:, 0]) * default_rng(12).standard_normal(90)
    made = replace(made, simulated=simulated, whitened=(simulated - measured) / sd)
    as_stated, unknown = measured + stated_off * SIGMA, np.full(3, estimated)
    found = judge_adequacy(made, as_stated, sd, estimated=unknown, converged=converged)
    assert (found.obstacle, found.adequate) == (obstacle, adequate) and len(found.misses) == 3
    if obstacle:
        assert "before the fit" in found.statement and "Adequate" not in found.statement
        assert ("total current 56 %" in found.statement) == (missed > 0)


# --- sds that are not right ---------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [10.0, 0.5])
def test_wrong_sds_of_all_channels_are_reported_with_one_factor(noise):
    (off,) = noise_remarks(toy(default_rng(7), noise=noise))
    assert off.channel == "" and off.factor == pytest.approx(noise, rel=0.2) and off.source == "stated"


def test_wrong_sd_of_one_channel_is_reported_for_that_channel():
    made = toy(default_rng(8))
    whitened, jacobian = made.whitened.copy(), made.jacobian.reshape(90, 3, -1).copy()
    whitened[:, 2] *= 3
    jacobian[:, 2] *= 3
    (off,) = noise_remarks(replace(made, whitened=whitened, jacobian=jacobian.reshape(270, -1)))
    assert off.channel == "speed" and off.factor == pytest.approx(3.0, rel=0.1)


def test_right_sds_and_structured_residuals_have_no_remark_on_sds():
    assert noise_remarks(toy(default_rng(9))) == []
    assert noise_factors(toy(default_rng(10), missing=4.0)) == {}


def test_variance_of_sums_is_that_of_the_slowest_part():
    """An autoregression has (1 + r) / (1 - r) times its own variance at frequency 0."""
    white = default_rng(11).standard_normal((2, 20_000))
    slow = lfilter([0.6], [1, -0.8], white, axis=1)
    assert variance_of_sums(list(white)) == 1.0
    assert variance_of_sums(list(slow)) == pytest.approx(9.0, rel=0.15)
    assert variance_of_sums(list(3 * slow)) == pytest.approx(81.0, rel=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("missing", [[], ["churning"]])
@pytest.mark.parametrize("stated", [True, False])
def test_calibration_says_whether_it_is_adequate(robot, missing, stated):
    made = tables.narrow(missing, 12.0, seed=3, free=settled.FRICTION).table
    runs = table({k: v for k, v in made.items() if stated or "_sd_" not in k})
    climbing = params.replace(robot, settled.CLIMBING)
    found = calibrate(runs, climbing, starts=2, profiles=False, blocks=()).adequacy
    assert found.adequate is (not missing) and found.noise_known is stated
    assert not missing or "mmrjax loop" in found.statement
