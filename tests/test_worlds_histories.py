"""Synthetic histories: physics and effects against `drive`, surfaces and samplings, gaps, events, sizes and labels."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from worlds import histories, laws, machines, settled
from worlds.histories import EVENTS, SERIES, samples, shown_by, simulated
from worlds.settled import CLIMBING, of_rows, remainder
from worlds.tables import READINGS

from calibration.data import runs as records
from calibration.inference import noise, observers
from mmrjax.effects import ALL, BY_NAME
from mmrjax.fidelities.drive import drive_batch
from mmrjax.model import paper_robots, params
from mmrjax.model.conditions import Conditions
from tests.commands import read_rig

RUNS = histories.starts(CLIMBING)
DURATION, EVERY = 0.6, 0.01
PASSING = tuple(n for n, law in SERIES.items() if law.cls)
#: What the library calls a shape parameter.
SHAPES = {"knee": "current_ohmic", "fade": "speed_fade"}
#: Of each channel's largest value in the run; 1.3e-5 at worst (brushes, 5 ohm more while the current rises), 4e-6 for a
#: battery run whose movers spin, else below 2e-6.
ERROR = 2e-5
#: The same of clean starts; 1.3e-6 measured, the error of the worlds' own step.
CLEAN = 4e-6
VARIETIES = [(stratum, k) for stratum, names in histories.STRATA.items() for k in range(len(names))]


def driven(robot, run, times):
    """Readings of `drive`, shape (3, runs, instants)."""
    s = drive_batch(robot, run, jnp.asarray(times), 1e-9, 20000).signals
    return np.stack([s.total_current, s.speed_motor, s.speed])


@pytest.fixture(scope="module")
def package():
    """Histories of `drive` for amplitudes of PASSING, shape (3, runs, instants)."""
    base = params.replace(paper_robots.nominal(), CLIMBING)
    full = dataclasses.replace(base, effects=tuple(BY_NAME[n]() for n in PASSING))
    times = np.arange(round(DURATION / EVERY) + 1) * EVERY
    every = {p.name: p.value for p in params.walk_parameters(full)}

    def read(battery, values=None):
        slope = np.degrees(RUNS.slope)
        run = Conditions(RUNS.wheeled, RUNS.U, slope, RUNS.payload, battery=battery, total_mass=RUNS.mass)
        # all of one type, so that one compiled program serves every call
        changed = {k: jnp.asarray(v, float) for k, v in (every | (values or {})).items()}
        return driven(params.replace(full, changed), run, times)

    return read


def apart(a, b):
    """Largest difference in each channel of each run over the run's largest value."""
    return (np.abs(a - b).max(-1) / np.abs(a).max(-1)).max()


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


# --- physics ------------------------------------------------------------------------------------------


def test_series_hold_every_effect_that_only_a_series_shows():
    assert {e.name for e in ALL if e.transient or e.memory_size is not None} <= set(PASSING)
    assert sum(not law.cls for law in SERIES.values()) >= 4


@pytest.mark.nightly
@pytest.mark.parametrize("battery", [0.0, 1.0])
def test_clean_histories_agree_with_drive(package, battery):
    _, y = histories.histories(RUNS, DURATION, EVERY, battery=battery)
    assert apart(package(battery), y) < CLEAN
    _, y = histories.histories(RUNS, DURATION, EVERY, CLIMBING | {"motor.inertia": 3.36e-6}, battery=battery)
    assert apart(package(battery), y) > 5 * ERROR


@pytest.mark.nightly
@pytest.mark.parametrize("name", PASSING)
def test_effect_of_a_series_agrees_with_drive(package, name):
    law, battery = SERIES[name], float(name == "battery_sag")
    size = {"cogging": 10.0, "stick_slip": 3.0, "thermal_drift": 5.0}.get(name, 1.0) * law.size
    shapes = {k: 0.5 if k == "phase" else float(np.mean(b)) for k, b in law.shapes.items()}
    term = laws.Term(name, size, shapes, law)
    _, y = histories.histories(RUNS, DURATION, EVERY, CLIMBING, [term], battery)
    values = {f"effects.{name}.{SHAPES.get(k, k)}": v for k, v in shapes.items()}
    there = package(battery, values | {f"effects.{name}.amplitude": size})
    assert apart(there, y) < ERROR
    assert apart(there, package(battery)) > 3e-5


def at_rest(w, **changes):
    """Of a world's settled travel, rates of its states, shape (states, runs), and these states."""
    s, sound = settled.solve(w.conditions, w.constants)
    assert sound.all()
    y = np.zeros((len(histories.STATES), len(s.I)))
    y[:3] = s.x
    return histories.rates(10.0, y, w.conditions, 0.0, of_rows(w.conditions, dict(w.constants) | changes), ()), y


def test_settled_travel_of_another_robot_does_not_change():
    for variety in range(3):
        w = world("robots", variety, seed=2)
        rates, y = at_rest(w)
        assert np.abs(rates[:3] / y[:3]).max() < 1e-5
        moved, _ = at_rest(w, **{"gearbox.efficiency_load": 1.01 * w.constants["gearbox.efficiency_load"]})
        assert np.abs(moved[1]).max() > 1.0  # rad/s²


@pytest.mark.slow
def test_steps_are_fine_enough_for_the_stickiest_contact():
    w = brief(world("plain"), 0.06)
    p = dict(w.constants)
    for role in machines.ROLES:
        p |= {f"{role}.ground.friction.static": 1.0, f"{role}.ground.friction.speed_static": 0.002,
              f"{role}.ground.friction.speed_dynamic": 0.02}  # fmt: skip
    assert histories.fastest(w.conditions, p) > 2.0 / histories.STEP
    _, y = simulated(w, p, w.conditions)
    _, finer = histories.histories(w.conditions, 0.06, histories.BASE, p, step=4e-5)
    assert apart(finer, y) < 2e-4


@pytest.mark.slow
@pytest.mark.parametrize("variety", range(3))
def test_histories_of_another_robot_agree_with_drive(tmp_path, variety):
    w = brief(world("robots", variety, seed=3), 0.6)
    robot = read_rig(tmp_path, w.machine.toml, "robot.toml")
    lost = {"battery", *machines.ROLES} - set(w.machine.names)
    kept = {w.machine.public(n): v for n, v in w.constants.items() if n.split(".")[0] not in lost}
    robot = params.replace(robot, {n: jnp.asarray(v, float) for n, v in kept.items()})
    c = w.conditions
    index = [robot.configurations.index(w.machine.names[machines.ROLES[int(k)]]) for k in c.wheeled]
    run = Conditions(index, c.U, np.degrees(c.slope), c.payload, total_mass=c.mass)
    times, y = simulated(w, w.constants, c)
    assert apart(y, driven(robot, run, times)) < 1e-4


# --- worlds and tables ----------------------------------------------------------------------------------


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


# --- effects --------------------------------------------------------------------------------------------


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
