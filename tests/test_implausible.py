"""What would explain the data but for its size is said beside `unnamed`, with how large it is and what to check."""

import functools
from dataclasses import replace

import numpy as np
import pytest
from numpy.random import default_rng
from synthetic import FEW, SETTLED, table
from test_stated_values import LOOKS
from worlds import laws, settled, tables

from calibration.discovery.candidates import Candidate
from calibration.discovery.findings import listed_alternatives
from calibration.discovery.search import search_effects, single_p_value
from calibration.discovery.settings import WITHOUT_NAME
from calibration.inference.linearization import amplitude_of
from mmrjax.effects import BY_NAME

LARGEST = amplitude_of(BY_NAME["winding_heating"]()).spec.bounds[1]


def heated(times, grid=settled.table8):
    """A table of the nominal robot whose windings heat so many times as much as is plausible."""
    p = dict(settled.CLIMBING)
    c = grid(p)
    readings = settled.readings(c, p, (laws.Term("winding_heating", times * LARGEST),))
    return table(tables.table_of(c, *readings, settled.Instruments(), default_rng(1)))


def steep(p):
    """24 runs, half of them up a slope that loads the motors."""
    return settled.table8(p, payloads=(0.0, 8.0), slopes=(0.0, 20.0))


pytestmark = pytest.mark.slow


#: Who looks at a robot that heats three times as much as is plausible, and at which runs.
HOT = {"few": (FEW, steep), "many": (SETTLED, settled.table8)}


@functools.cache
def traced(looks="few"):
    """The stages of the loop on them, and those runs."""
    analyst, grid = HOT[looks]
    runs = heated(3.0, grid)
    return analyst.trace(runs), runs


@functools.cache
def unnamed(looks="few"):
    """Their result. Made once for all files."""
    return HOT[looks][0].result(*traced(looks))


@pytest.fixture(scope="module", params=["few", "many"])
def looks(request):
    return LOOKS[request.param]


@pytest.fixture(scope="module")
def hot(looks):
    return traced("few" if looks is LOOKS["few"] else "many")[0]


def listed(traced, cost):
    space, base = traced.screened.base.space, traced.screened.base.candidate
    return listed_alternatives(space, base, cost, traced.searched.ladder)


def test_heating_of_a_plausible_size_is_named():
    found = SETTLED.trace(heated(0.6))
    assert found.verdict == "named" and found.members == (("winding_heating",),)


def test_heating_three_times_too_large_is_ruled_out_by_its_size(hot):
    support = hot.standing
    assert hot.verdict in WITHOUT_NAME and hot.members == ()
    assert "winding_heating" in support.effects or all(t.larger == ("winding_heating",) for t in support.tests)
    least = min(c.cost for c in hot.searched.ladder)
    plausible, ruled_out = listed(hot, least)
    assert plausible == ()
    first = next(a for a in ruled_out if list(a.effects) == ["winding_heating"])
    assert 2.7 < first.sizes["winding_heating"] < 3.3 and abs(first.rise_chi2) < 9
    assert first.why == (
        f"winding_heating would have {first.sizes['winding_heating']:.2g} times its largest plausible size, so "
        "check motor.resistance_thermal_housing and motor.resistance_thermal_winding"
    )
    assert first.effects["winding_heating"] == pytest.approx(3.0 * LARGEST, rel=0.1)


def made(*effects, slots, cost, plausible=True):
    active = (*effects, *("",) * (slots - len(effects)))
    size = np.where([bool(n) for n in active], 0.1 if plausible else 2.0, 0.0)
    return Candidate(active, np.zeros(40), np.ones(40), cost, size, size, plausible, plausible, True)


def test_a_pair_is_listed_where_it_explains_more_than_noise(hot):
    """Costs are half of χ²."""
    space = hot.screened.base.space
    of = functools.partial(made, slots=(len(hot.screened.base.candidate.z) - space.free) // 2)
    best = of("churning", cost=100.0)
    ladder = (
        of("supply_sag", cost=101.0), of("churning", "load_slip", cost=99.0), of("churning", "mass_offset", cost=90.0),
        of("supply_sag", "load_slip", cost=100.5), of("series_resistance", cost=98.0, plausible=False), best,
    )  # fmt: skip
    plausible, ruled_out = listed_alternatives(space, best, best.cost, ladder)
    assert [(tuple(a.effects), a.rise_chi2) for a in plausible] == [
        (("churning", "mass_offset"), -20.0),
        (("supply_sag",), 2.0),
    ]
    assert [(tuple(a.effects), a.rise_chi2) for a in ruled_out] == [(("series_resistance",), -4.0)]
    (reason,) = ruled_out[0].reasons
    assert (reason.name, reason.why, reason.size) == ("series_resistance", "size", 2.0)


# --- weak companions ------------------------------------------------------------------------------------


def test_own_p_is_the_share_of_tables_whose_strongest_effect_explains_as_much():
    null = np.array([1.0, 2.0, 3.0, 4.0])
    assert single_p_value(9.0, null) == pytest.approx(3 / 5) and single_p_value(100.0, null) == pytest.approx(1 / 5)
    assert single_p_value(0.0, null) == 1.0


def test_an_effect_without_a_p_of_its_own_is_not_proposed(looks):
    """The same search, once as it is and once where noise explains as much in every table of the bootstrap."""
    analyst, grid = looks
    found = analyst.trace(table(tables.narrow(["churning"], 10.0, seed=4, grid=grid)))
    assert "churning" in found.members[0]
    base, test = found.screened.base, found.left.test
    loud = replace(test, null=replace(test.null, single=np.full_like(test.null.single, 1e3)))
    best = [
        search_effects(
            base.space,
            base.candidate,
            replace(found.left, test=of),
            found.screened.bases,
            lambda text: None,
        ).best
        for of in (test, loud)
    ]
    assert best[0] is not None and best[1] is None
