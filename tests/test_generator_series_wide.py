"""The wide generator of histories: surfaces, settings and samplings, gaps, events, sizes, and its physics at the end."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from worlds import histories, laws, machines, settled

from calibration.data import robot_file
from calibration.data import runs as records
from calibration.inference import noise, observers
from mmrjax import params
from mmrjax import robots as mm_robots
from mmrjax.conditions import Conditions
from mmrjax.fidelities.drive import drive_batch

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
    shown = histories.samples(w)
    for k, (duration, every) in enumerate(w.design):
        times = np.flatnonzero(shown[k]) * histories.BASE
        assert times[0] == 0 and times[-1] == pytest.approx(duration)
        gaps = np.diff(times) / (every * histories.BASE)
        np.testing.assert_allclose(gaps, np.round(gaps), atol=1e-9)
        assert (gaps.max() > 1.5) == (w.dropped > 0) and every in (1, 2, 4) and 0.6 <= duration <= 3.0
    assert w.variety == histories.STRATA[stratum][variety]
    again = histories.samples(world(stratum, variety, seed=5))
    assert (shown == again).all()  # so that programs serve all


def at_rest(w):
    """States of settled travel, shape (states, runs), and the fastest that each changes [per second]."""
    s, sound = settled.solve(w.conditions, w.constants)
    y = np.zeros((len(histories.STATES), len(s.I)))
    y[:3] = s.x
    p = settled.of_rows(w.conditions, w.constants)
    rates = histories.rates(10.0, y, w.conditions, 0.0, p, ())
    assert sound.all()
    return y, np.abs(rates[:3] / y[:3]).max()


def test_settled_travel_of_another_robot_does_not_change():
    for variety in range(3):
        w = world("robots", variety, seed=2)
        assert at_rest(w)[1] < 1e-5
        other = dict(w.constants) | {"gearbox.efficiency_load": 1.01 * w.constants["gearbox.efficiency_load"]}
        moved = histories.rates(10.0, at_rest(w)[0], w.conditions, 0.0, settled.of_rows(w.conditions, other), ())
        assert np.abs(moved[1]).max() > 1.0  # rad/s²


@pytest.mark.slow
def test_steps_are_fine_enough_for_the_stickiest_contact():
    w = brief(world("plain"), 0.06)
    p = dict(w.constants)
    for role in machines.ROLES:
        p |= {f"{role}.ground.friction.static": 1.0, f"{role}.ground.friction.speed_static": 0.002,
              f"{role}.ground.friction.speed_dynamic": 0.02}  # fmt: skip
    assert histories.fastest(w.conditions, p) > 2.0 / histories.STEP
    _, y = histories.simulated(w, p, w.conditions)
    _, finer = histories.histories(w.conditions, 0.06, histories.BASE, p, step=4e-5)
    assert (np.abs(y - finer).max(-1) / np.abs(finer).max(-1)).max() < 2e-4


@pytest.mark.slow
def test_long_runs_of_another_robot_end_where_settled_travel_is():
    for variety in range(3):
        w = brief(world("robots", variety, seed=2), 3.0)
        _, y = histories.simulated(w, w.constants, w.conditions)
        np.testing.assert_allclose(y[:, :, -1], settled.readings(w.conditions, w.constants)[0], rtol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("variety", range(3))
def test_histories_of_another_robot_agree_with_drive(tmp_path, variety):
    w = brief(world("robots", variety, seed=3), 0.6)
    (tmp_path / "robot.toml").write_text(w.machine.toml)
    robot = robot_file.read(tmp_path / "robot.toml")
    kept = {
        w.machine.public(n): v for n, v in w.constants.items() if n.split(".")[0] not in (*machines.ROLES, "battery")
    }
    for role in w.machine.names:
        kept |= {w.machine.public(n): v for n, v in w.constants.items() if n.startswith(f"{role}.")}
    robot = params.replace(robot, {n: jnp.asarray(v, float) for n, v in kept.items()})
    c = w.conditions
    index = [robot.configurations.index(w.machine.names[machines.ROLES[int(k)]]) for k in c.wheeled]
    run = Conditions(index, c.U, np.degrees(c.slope), c.payload, total_mass=c.mass)
    times, y = histories.simulated(w, w.constants, c)
    s = drive_batch(robot, run, jnp.asarray(times), 1e-9, 20000).signals
    ours = np.stack([s.total_current, s.speed_motor, s.speed])
    assert (np.abs(ours - y).max(-1) / np.abs(y).max(-1)).max() < 1e-4


def test_table_of_histories_passes_the_input_checks(quick, tmp_path):
    for variety, stratum in ((1, "faults"), (2, "faults"), (2, "robots")):
        w = world(stratum, variety, seed=4)
        w = brief(w)
        made = histories.case(w, seed=1)
        rows = zip(*made.table.values(), strict=True)
        lines = [",".join("" if x != x else str(x) for x in r) for r in rows]
        (tmp_path / "runs.csv").write_text("\n".join([",".join(made.table), *lines]) + "\n")
        runs = records.read(tmp_path / "runs.csv")
        kind = observers.kind(runs)
        known = noise.of(runs, kind.sizes(runs))
        assert (
            runs.has("time_s")
            and kind.check(runs, known) == []
            and kind.check_start(runs, known, mm_robots.nominal()) == []
        )
        assert len(runs) == made.label["rows"]
        assert np.isnan(runs.measured()).sum() == made.label["missing"]
        assert set(runs["configuration"]) <= set(w.machine.names.values())
        assert (made.label["missing"] > 0) == (w.missing > 0) and (made.label["outliers"] > 0) == (w.outliers > 0)


@pytest.mark.slow
@pytest.mark.parametrize("name", histories.EVENTS)
def test_event_happens_at_the_same_instant_of_every_run(quick, name):
    w = brief(world("plain"), 0.25, 1)
    made = histories.case(w, [name], 10.0, seed=3)
    (effect,) = made.label["effects"]
    a, b = effect["where"]["window"]
    assert (
        0.05 <= b - a <= 0.2
        and b < 0.25
        and effect["where"]["variable"] == "time"
        and effect["sigmas"] == pytest.approx(10, rel=0.05)
    )
    times, y = histories.shown_by(w, w.constants, w.conditions, made.terms)
    change = np.abs(y - histories.shown_by(w, w.constants, w.conditions, ())[1])
    scale = w.instruments.stated[:, None, None] / settled.SHOWN[:, :, None]
    moved = (change / scale).max(0)
    during = (times >= a) & (times < b)
    assert (moved[:, during].max(1) > 0.1).all() and moved[:, times < a].max() < 1e-9
    if histories.EVENTS[name][0] in laws.CHANNELS:
        assert moved[:, ~during].max() < 1e-9
        assert effect["balance"] == "sensor" and effect["channel"] == histories.EVENTS[name][0]
    else:
        assert effect["balance"] == histories.EVENTS[name][0]


@pytest.mark.slow
def test_each_of_two_leaves_its_sigmas_beside_the_other(quick):
    w = brief(world("plain"), 0.25, 1)
    made = histories.case(w, ["rolling_radius", "supply_sag"], [9.0, 10.0], seed=2)
    effects = made.label["effects"]
    assert [e["sigmas"] for e in effects] == pytest.approx([9, 10])
    small = [dataclasses.replace(t, amplitude=0.1 * t.law.size) for t in made.terms]
    good = np.broadcast_to(histories.samples(w), (3, *histories.samples(w).shape))
    changes, slopes = histories.signatures(w, small, good)
    first = settled.remainder(changes[0], np.concatenate([slopes, 1e4 * changes[1][:, None]], 1))
    assert np.linalg.norm(first) * effects[0]["sizes"] / 0.1 == pytest.approx(9, rel=0.02)
    assert np.linalg.norm(settled.remainder(changes[0], slopes)) > np.linalg.norm(first)


@pytest.mark.slow
def test_oracle_finds_a_mimic_and_none_for_a_law_of_its_own(quick):
    w = brief(world("plain"), 0.25, 1)
    near = dataclasses.replace(laws.SERIES["churning"], cls="", of=lambda s, q: s.w_k**2 * s.d * 1.0001)
    odd = laws.SERIES["supply_recovery"]
    made = histories.case(w, ["supply_recovery"], 30.0, seed=1)
    both = dataclasses.replace(
        made, terms=(laws.Term("", 5e-4, {}, near), laws.Term("", made.terms[0].amplitude, {}, odd))
    )
    mimic, own = histories.oracle(both)
    assert mimic["mimic"] == "churning" and mimic["best_other"] < 0.5
    assert own["best_other"] > 3.0


@pytest.mark.slow
def test_noise_of_histories_is_a_factor_of_what_is_stated(quick):
    for factor in (2.0,):
        w = brief(world("plain", noise=factor), 0.4, 1)
        made = histories.case(w, seed=6)
        _, y = histories.shown_by(w, w.constants, w.conditions, ())
        run, instant = np.nonzero(histories.samples(w))
        columns = np.stack([made.table[n] for n in ("total_current_A", "motor_speed_rpm", "speed_mm_s")])
        left = (columns - (y * settled.SHOWN[:, :, None])[:, run, instant]) / w.instruments.stated[:, None]
        assert left.std() == pytest.approx(factor, rel=0.1)
