"""Base fits of histories end in the lowest valley, whatever the ground: what settled ends tell, and what they do not."""

import dataclasses
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from synthetic import Analyst, table
from worlds import histories, settled

from calibration.discovery.candidates import fit_base
from calibration.discovery.settings import settings_for
from calibration.inference.observers import Histories, settled_ends, time_histories
from mmrjax.effects import BY_NAME
from tests.commands import with_columns

#: An analyst who knows nothing of the ground but what the nominal robot's file says (0.32 and 0.38, 20 mm/s).
ANALYST = Analyst(
    dataclasses.replace(settings_for(Histories, 300), slots=1), {"churning": BY_NAME["churning"]}, stated={}
)
INSTRUMENTS = settled.Instruments(sd=(0.02, 9.5, 2.0))


def on_ground(adhesion, creep, seed=3):
    """Six clean starts of the nominal robot on a ground of this adhesion (of tracks, of wheels) and V_s [m/s], and
    its constants."""
    p = dict(settled.CLIMBING)
    for c, mu in zip(("6T2A", "4W2T"), adhesion, strict=True):
        p |= {f"{c}.ground.friction.static": mu, f"{c}.ground.friction.dynamic": 0.8 * mu}
        p |= {f"{c}.ground.friction.speed_static": creep, f"{c}.ground.friction.speed_dynamic": 10 * creep}
    made = histories.narrow(seed=seed, duration=1.5, every=0.05, instruments=INSTRUMENTS, constants=p)
    return table(made), p


def at_truth(space, p):
    """Coordinates of the true robot."""
    c = space.bare.coordinates
    value = np.array([p[n] for n in c.names])
    inside = np.where(c.scale, np.log(value), value)
    return (inside - np.asarray(c.location)) / np.asarray(c.spread)


def is_global(adhesion, creep, seed=3):
    """Whether the base fit is at least as good as the truth, and leaves what noise leaves."""
    runs, p = on_ground(adhesion, creep, seed)
    space = ANALYST.space(runs)
    z = jnp.asarray(at_truth(space, p))
    truth = 0.5 * float(jnp.sum(space.bare.misfit(z) ** 2) + jnp.sum(z**2))
    fitted = fit_base(space, "starts")
    assert fitted.unusable == () and fitted.candidate.cost < truth, (adhesion, creep)
    readings = 3 * len(runs)
    assert abs(2 * fitted.candidate.cost - readings) < 5 * np.sqrt(2 * readings), (adhesion, creep)


@pytest.mark.nightly
@pytest.mark.parametrize(
    "adhesion, creep",
    [
        ((0.2, 0.25), 0.005),
        ((0.35, 0.9), 0.01),  # a friction of wheels that rises until it slides has a valley of its own, 8 above
        ((0.35, 0.9), 0.06),
        ((0.55, 0.54), 0.012),
        ((0.7, 0.6), 0.02),
        ((1.0, 1.0), 0.06),
    ],
)
def test_base_fit_of_clean_starts_is_global_on_any_ground(adhesion, creep):
    is_global(adhesion, creep)


# --- what the ends show ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def gripping():
    """Six starts on a ground that holds, and the constants of their robot."""
    return on_ground((0.6, 0.6), 0.02)


def ends_of(runs, p):
    """The ends of six starts on a ground, which of them slide, and what settled travel of the true robot shows."""
    problem = ANALYST.space(runs).bare
    ends = settled_ends.settled_ends_of_runs(problem)
    truth, sound = settled.readings(histories.starts(p), p)
    return ends, settled_ends._slides_at_end(problem, ends), truth.T, sound


@pytest.mark.slow
def test_ends_of_runs_that_grip_are_those_of_settled_travel(gripping):
    ends, slides, truth, sound = ends_of(*gripping)
    assert sound.all() and not slides.any()
    known = np.isfinite(ends.mean)
    assert known.sum() >= 15  # of six runs and three channels
    off = np.abs(ends.mean - truth)[known]
    # a reading that still changes by less than a fiftieth is taken for settled
    assert (off < 4 * ends.sd[known] + 0.02 * np.abs(truth[known])).all()
    assert (ends.sd[known] >= settled_ends.FLOOR * np.abs(ends.mean[known]) - 1e-12).all()


@pytest.mark.slow
def test_a_run_that_slides_is_not_taken_for_settled():
    """On a slope beyond its adhesion a robot spins its movers, and its steady state is none."""
    _, slides, _, sound = ends_of(*on_ground((0.12, 0.6), 0.02))
    assert not sound.all() and sound[3:].all()
    assert_array_equal(slides, ~sound)


@pytest.mark.slow
def test_a_reading_that_still_changes_has_no_settled_end(gripping):
    runs, _ = gripping
    mine = runs["run_id"] == "start4"
    current = runs["total_current_A"].copy()
    current[mine] += 2.0 * runs["time_s"][mine]  # 2 A/s
    changed = with_columns(runs, total_current_A=current)
    before, after = (settled_ends.settled_ends_of_runs(ANALYST.space(r).bare).mean for r in (runs, changed))
    assert np.isfinite(before[4, 0]) and np.isnan(after[4, 0])
    assert_array_equal(np.delete(before, 4, 0), np.delete(after, 4, 0))


@pytest.mark.parametrize(
    "configurations, regression, tries", [(1, True, (4, 2)), (2, True, (96, 8)), (1, False, (96, 8))]
)
def test_beside_the_regression_of_one_configuration_few_searches_are_tried(
    monkeypatch, configurations, regression, tries
):
    """On a public record of a drivetrain, 118 points and 8 searches took 72 s and gave the objective of 2 searches."""
    asked = []

    def settled(problem, draws, search, searches):
        asked.append((len(draws), searches))
        return np.ones((3, 2))

    weak = SimpleNamespace(z=np.zeros(2)) if regression else None
    monkeypatch.setattr(time_histories, "fit_weak_form", lambda problem: weak)
    monkeypatch.setattr(settled_ends, "starts_from_settled_ends", settled)
    monkeypatch.setattr(time_histories.scans, "place_at_minimum", lambda problem, starts: starts)
    rig = SimpleNamespace(imposed="voltage")
    base = SimpleNamespace(has_ground=True, rig=rig, configurations=("a", "b")[:configurations])
    problem = SimpleNamespace(base=base, coordinates=("x", "y"))
    starts = Histories.starts(SimpleNamespace(), problem, np.random.default_rng(0), 2)
    assert asked == [tries] and len(starts) == 2 and starts[0].any() == (not regression)
