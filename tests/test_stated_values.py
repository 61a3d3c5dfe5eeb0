"""A stated value that may be wrong is listed in the place of an effect, with the value that the data have."""

import functools
from types import SimpleNamespace

import numpy as np
import pytest
from synthetic import FEW, SETTLED, small, table
from worlds import laws, settled, tables

from calibration.discovery import verdict
from calibration.discovery.classes import find_prior_shifts, prior_shift_scores
from calibration.discovery.loop_notes import AlternativeValue
from calibration.words import loop_words as words

NOMINAL = settled.CLIMBING["motor.resistance"]
#: χ² that a shift has to explain to be tried.
NEEDED = 25.0


# --- the score of a prior's shift, on a linear problem --------------------------------------------------


@pytest.fixture(scope="module")
def toy():
    """Thirty readings and five coordinates, the last of which no reading shows, at their optimum. The prior of the
    first is off by eight of its sds."""
    rng = np.random.default_rng(3)
    readings, p = 30, 5
    slopes = rng.standard_normal((readings, p)) * np.array([2.0, 1.0, 0.3, 1.0, 0.0])
    jacobian = np.concatenate([slopes, np.eye(p)])
    at_zero = np.concatenate(
        [-slopes @ np.array([8.0, 0.5, -1.0, 0.2, 0.0]) + rng.standard_normal(readings), 0 * slopes[0]]
    )
    z = -np.linalg.lstsq(jacobian, at_zero, rcond=None)[0]
    return SimpleNamespace(jacobian=jacobian, residual=at_zero + jacobian @ z, at_zero=at_zero, readings=readings)


def refitted(toy, without=()):
    """χ² and coordinates of a least-squares fit without some of the priors."""
    keep = np.setdiff1d(np.arange(len(toy.residual)), toy.readings + np.asarray(without, int))
    a, e = toy.jacobian[keep], toy.at_zero[keep]
    z = -np.linalg.lstsq(a, e, rcond=None)[0]
    return float(np.sum((e + a @ z) ** 2)), z


def test_scores_are_falls_of_chi2_without_a_prior(toy):
    explained, values = prior_shift_scores(toy.jacobian, toy.residual)
    whole, _ = refitted(toy)
    for k in range(4):
        without, z = refitted(toy, [k])
        assert explained[k] == pytest.approx(whole - without, rel=1e-8)
        assert values[k] == pytest.approx(z[k], rel=1e-8)
    assert explained[0] > 30 and explained[0] > 5 * explained[1:].max() and abs(values[0] - 8.0) < 1.0


def test_a_coordinate_that_nothing_shows_cannot_be_the_wrong_one(toy):
    explained, values = prior_shift_scores(toy.jacobian, toy.residual)
    assert explained[4] == values[4] == 0.0


# --- a robot whose sheet is wrong -----------------------------------------------------------------------


def made(resistance=NOMINAL, lead=0.0, grid=settled.table8):
    """A table of a robot with this winding, and leads beside it, all else at its sheets."""
    p = dict(settled.CLIMBING) | {"motor.resistance": resistance}
    terms = (laws.Term("series_resistance", lead),) * (lead > 0)
    c, instruments = grid(p), settled.Instruments()
    return table(tables.table_of(c, *settled.readings(c, p, terms), instruments, np.random.default_rng(1)))


#: Who looks, and at which runs.
LOOKS = {"few": (FEW, small), "many": (SETTLED, settled.table8)}


@functools.cache
def traced(looks):
    """The stages of the loop on runs of a robot with leads, and those runs. Made once for all files."""
    analyst, grid = LOOKS[looks]
    runs = made(lead=0.8, grid=grid)
    return analyst.trace(runs), runs


@pytest.fixture(scope="module", params=["few", pytest.param("many", marks=pytest.mark.slow)])
def looks(request):
    return LOOKS[request.param]


@pytest.mark.parametrize(
    "wrong, truth", [({"lead": 0.8}, NOMINAL + 0.8), ({"resistance": 1.3}, 1.3)], ids=["leads", "winding"]
)
def test_resistance_freed_of_its_prior_is_the_right_one(wrong, truth, looks):
    analyst, grid = looks
    runs = made(**wrong, grid=grid)
    fitted = analyst.base(runs)
    found = {s.name: s for s in find_prior_shifts(fitted.space, fitted.candidate, NEEDED)}
    assert "motor.resistance" in found
    shift = found["motor.resistance"]
    sd = shift.fit.sd[fitted.space.coordinates.base.names.index(shift.name)] * NOMINAL * 0.1
    assert abs(shift.value - truth) < 0.05 * truth and sd < 0.05 * truth
    assert shift.stated == pytest.approx(NOMINAL) and shift.unit == "ohm" and shift.prior_sds > 5
    # freed of its prior it explains more than held by it, and the fit is as good as noise allows
    assert 2 * (shift.fit.cost - fitted.candidate.cost) < -NEEDED
    readings = 3 * len(runs)
    assert 2 * shift.fit.cost < readings + 4 * np.sqrt(2 * readings)
    freed = AlternativeValue("motor.resistance", shift.value, shift.unit)
    assert words.freed_value(freed) == f"motor.resistance is {shift.value:.3g} ohm"
    assert words.freed_value(freed._replace(unit="-")) == f"motor.resistance is {shift.value:.3g}"


def test_nothing_is_shifted_where_the_sheet_is_right(looks):
    analyst, grid = looks
    fitted = analyst.base(made(grid=grid))
    assert find_prior_shifts(fitted.space, fitted.candidate, NEEDED) == []


def test_verdict_lists_the_resistance_that_may_be_wrong(looks):
    """Beside the leads, so that no single name is given. Its prior is one fifteenth of the shift."""
    found, _ = traced("few" if looks is LOOKS["few"] else "many")
    assert found.verdict == "class"
    (members,), (stated,) = found.alike.members, found.alike.stated
    assert "series_resistance" in members and [s.name for s in stated] == ["motor.resistance"]
    (missing,) = verdict.verdict_summary(found, np.arange(1, 100)).missing
    (value,) = missing.values
    assert missing.names == members and value.name == "motor.resistance" and f"{value.value:.1f}" == "1.4"
