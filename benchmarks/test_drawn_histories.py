"""Histories that campaigns draw: surfaces and samplings, gaps, noise, events, sizes and labels."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose
from worlds import histories, laws, settled
from worlds.histories import EVENTS, SERIES, samples, shown_by
from worlds.settled import remainder
from worlds.tables import READINGS

from calibration.data import runs as records
from calibration.inference import noise, observers

VARIETIES = [(stratum, k) for stratum, names in histories.STRATA.items() for k in range(len(names))]


def world(stratum, variety=0, seed=0, **options):
    return histories.world(np.random.default_rng([11, seed]), stratum, variety, **options)


@pytest.fixture
def quick(monkeypatch):
    """Fewer steps in the first instants: what they show is the same to some 1e-4."""
    monkeypatch.setattr(histories, "FINER", 2)


def brief(w, duration=0.2, every=4):
    """The first and the last run of a world, cut short."""
    rows = np.array([0, len(w.conditions.U) - 1])
    return dataclasses.replace(w, conditions=w.conditions.at(rows), design=((duration, every),) * 2)


def test_histories_span_surfaces_and_settings():
    made = [world("plain", seed=k) for k in range(80)]
    hold = np.array([w.constants["6T2A.ground.friction.static"] for w in made])
    creep = np.array([w.constants["4W2T.ground.friction.speed_static"] for w in made])
    assert hold.min() < 0.25 and hold.max() > 0.95 and creep.min() < 0.003 and creep.max() > 0.045
    for w in made:
        c = w.conditions
        assert len(set(c.wheeled)) == 2 and len(set(c.U)) == 3 and len(set(np.round(c.slope, 4))) >= 2
        s, _ = settled.solve(c, w.constants)
        assert (s.D / s.D_max < 0.65).all()  # below μ_d / μ_s: a start that slides grips in the end
        ratio = w.constants["6T2A.ground.friction.speed_dynamic"] / w.constants["6T2A.ground.friction.speed_static"]
        assert ratio == pytest.approx(10)  # as the model ties it


@pytest.mark.parametrize(("stratum", "variety"), VARIETIES)
def test_samples_are_those_of_the_design(stratum, variety):
    w = world(stratum, variety)
    shown = samples(w)
    for k, (duration, every) in enumerate(w.design):
        times = np.flatnonzero(shown[k]) * histories.BASE
        assert times[0] == 0 and times[-1] == pytest.approx(duration)
        gaps = np.diff(times) / (every * histories.BASE)
        assert_allclose(gaps, np.round(gaps), atol=1e-9)
        assert (gaps.max() > 1.5) == (w.dropped > 0) and every in (1, 2, 4) and 0.6 <= duration <= 3.0
    assert w.variety == histories.STRATA[stratum][variety]
    assert (shown == samples(world(stratum, variety, seed=5))).all()  # so that programs serve all


@pytest.mark.slow
def test_starts_of_the_papers_robot_pass_the_input_checks_and_are_reproducible(tmp_path):
    one, two = (
        histories.narrow(["rotating_inertia"], 6.0, seed=3, duration=0.2, free=settled.FRICTION[:2]) for _ in range(2)
    )
    assert all((one.table[n] == two.table[n]).all() for n in one.table)
    (effect,) = one.label["effects"]
    assert effect["class"] == "rotating_inertia" and effect["sigmas"] == pytest.approx(6.0)
    one.write(tmp_path)
    runs = records.read_runs(tmp_path / "table.csv")
    assert len(runs) == 6 * 11 and runs.has("time_s") and "rotating" not in (tmp_path / "table.csv").read_text()


@pytest.mark.slow
def test_table_of_histories_passes_the_input_checks(quick, tmp_path, robot):
    for variety, stratum in ((1, "faults"), (2, "faults"), (2, "robots")):
        w = brief(world(stratum, variety, seed=4))
        made = histories.case(w, seed=1)
        made.write(tmp_path)
        runs = records.read_runs(tmp_path / "table.csv")
        kind = observers.observer_kind(runs)
        known = noise.noise_from_table(runs, kind.sizes(runs))
        assert runs.has("time_s") and len(runs) == made.label["rows"]
        assert kind.check(runs, known) == kind.check_start(runs, known, robot) == []
        assert np.isnan(runs.measured()).sum() == made.label["missing"]
        assert set(runs["configuration"]) <= set(w.machine.names.values())
        assert (made.label["missing"] > 0) == (w.missing > 0) and (made.label["outliers"] > 0) == (w.outliers > 0)


@pytest.mark.slow
def test_noise_of_histories_is_a_factor_of_what_is_stated(quick):
    w = brief(world("plain", noise=2.0), 0.4, 1)
    made = histories.case(w, seed=6)
    _, y = shown_by(w, w.constants, w.conditions, ())
    run, instant = np.nonzero(samples(w))
    columns = np.stack([made.table[n] for n in READINGS])
    left = (columns - (y * settled.SHOWN[:, :, None])[:, run, instant]) / w.instruments.stated[:, None]
    assert left.std() == pytest.approx(2.0, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("name", EVENTS)
def test_event_happens_at_the_same_instant_of_every_run(quick, name):
    w = brief(world("plain"), 0.25, 1)
    made = histories.case(w, [name], 10.0, seed=3)
    (effect,) = made.label["effects"]
    (a, b), balance = effect["where"]["window"], EVENTS[name][0]
    assert 0.05 <= b - a <= 0.2 and b < 0.25 and effect["where"]["variable"] == "time"
    assert effect["sigmas"] == pytest.approx(10, rel=0.05)
    times, y = shown_by(w, w.constants, w.conditions, made.terms)
    change = np.abs(y - shown_by(w, w.constants, w.conditions, ())[1])
    moved = (change / (w.instruments.stated[:, None, None] / settled.SHOWN[:, :, None])).max(0)
    during = (times >= a) & (times < b)
    assert (moved[:, during].max(1) > 0.1).all() and moved[:, times < a].max() < 1e-9
    sensor = balance in laws.CHANNELS
    assert not sensor or moved[:, ~during].max() < 1e-9
    assert (effect["balance"], effect["channel"]) == (("sensor", balance) if sensor else (balance, ""))


@pytest.mark.slow
def test_each_of_two_leaves_its_sigmas_beside_the_other(quick):
    w = brief(world("plain"), 0.25, 1)
    made = histories.case(w, ["rolling_radius", "supply_sag"], [9.0, 10.0], seed=2)
    effects = made.label["effects"]
    assert [e["sigmas"] for e in effects] == pytest.approx([9, 10])
    small = [dataclasses.replace(t, amplitude=0.1 * t.law.size) for t in made.terms]
    changes, slopes = histories.signatures(w, small, np.broadcast_to(samples(w), (3, *samples(w).shape)))
    first = remainder(changes[0], np.concatenate([slopes, 1e4 * changes[1][:, None]], 1))
    assert np.linalg.norm(first) * effects[0]["sizes"] / 0.1 == pytest.approx(9, rel=0.02)
    assert np.linalg.norm(remainder(changes[0], slopes)) > np.linalg.norm(first)


@pytest.mark.nightly
def test_oracle_finds_a_mimic_and_none_for_a_law_of_its_own(quick):
    made = histories.case(brief(world("plain"), 0.25, 1), ["supply_recovery"], 30.0, seed=1)
    near = dataclasses.replace(SERIES["churning"], cls="", of=lambda s, q: s.w_k**2 * s.d * 1.0001)
    both = dataclasses.replace(made, terms=(laws.Term("near", 5e-4, law=near), *made.terms))
    mimic, own = histories.oracle(both)
    assert mimic["mimic"] == "churning" and mimic["best_other"] < 0.5
    assert own["best_other"] > 3.0
