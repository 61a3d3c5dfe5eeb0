"""The wide generator: surfaces, robots and their files, instruments' faults, what goes with the order, sizes, priors."""

import dataclasses
import json

import numpy as np
import pytest
from worlds import laws, machines, settled, tables

from calibration.data import robot_file
from calibration.data import runs as records
from calibration.inference import priors
from mmrjax import params
from mmrjax.fidelities.steady import steady_batch

ROLES = ((machines.TRACKS,), (machines.WHEELS,), machines.ROLES)
READINGS = ("total_current_A", "motor_speed_rpm", "speed_mm_s")


def worlds(stratum, count, **options):
    return [tables.world(np.random.default_rng([5, seed]), stratum, **options) for seed in range(count)]


@pytest.fixture(scope="module")
def plain():
    return worlds("plain", 200)


@pytest.fixture(scope="module")
def made():
    return [machines.machine(np.random.default_rng([6, seed]), ROLES[seed % 3]) for seed in range(240)]


# --- surfaces ---------------------------------------------------------------------------------------


def test_surfaces_span_adhesion_and_creep(plain):
    for role in machines.ROLES:
        hold = np.array([w.constants[f"{role}.ground.friction.static"] for w in plain])
        creep = np.array([w.constants[f"{role}.ground.friction.speed_static"] for w in plain])
        assert hold.min() < 0.23 and hold.max() > 0.97 and abs(np.median(hold) - 0.6) < 0.08
        assert creep.min() < 0.0025 and creep.max() > 0.05 and 0.007 < np.median(creep) < 0.017
        share = [w.constants[f"{role}.ground.friction.dynamic"] for w in plain] / hold
        np.testing.assert_allclose(share, 0.8)


@pytest.mark.parametrize("stratum", tables.STRATA)
def test_no_row_of_a_world_slides(stratum):
    for w in worlds(stratum, 20):
        s, _ = settled.solve(w.conditions, w.constants)
        assert (np.abs(s.D / s.D_max) < 0.95).all() and (s.V / s.V_teor).min() > 0.2
        assert tables.case(w).label["rows_lost"] == 0


def test_slopes_go_as_far_as_the_surface_holds(plain):
    slick = [w for w in plain if w.constants["6T2A.ground.friction.static"] < 0.3]
    assert slick
    for w in slick:
        slope = w.conditions.slope[w.conditions.wheeled < 0.5]
        assert 0.03 < slope.max() < np.radians(14)
        _, sound = settled.readings(
            dataclasses.replace(w.conditions, slope=np.full(len(w.conditions.U), np.radians(20.0))), w.constants
        )
        assert not sound[w.conditions.wheeled < 0.5].any()


# --- robots -----------------------------------------------------------------------------------------


def test_robots_span_their_ranges(made):
    ranges = {"mass": (2, 60), "ratio": (10, 120), "radius": (0.02, 0.15), "supply": (6, 48)}
    for name, (low, high) in ranges.items():
        seen = np.array([m.size[name] for m in made])
        assert low <= seen.min() < 1.3 * low and high >= seen.max() > high / 1.3


def test_robots_constants_fit_together(made):
    for m in made:
        p, c = m.constants, machines.grid(m, m.constants)
        y, sound = settled.readings(c, p)
        assert sound.all() and y[0].min() > 0.05 and y[0].max() < 120
        no_load = m.supply / p["motor.torque_constant"]
        assert 250 < no_load < 1300 and (y[1] < no_load).all()
        assert y[2].min() > 0.02 and y[2].max() < 4.5
        dry = p["motor.friction_coulomb"] + p["gearbox.friction_coulomb"]
        assert dry / p["motor.torque_constant"] < 0.12 * np.median(y[0])  # current at no load


@pytest.mark.parametrize("roles", [ROLES[-1], *(pytest.param(r, marks=pytest.mark.slow) for r in ROLES[:-1])])
def test_robot_file_is_read_and_runs_agree_with_steady(tmp_path, roles):
    m = machines.machine(np.random.default_rng([7, len(roles)]), roles)
    (tmp_path / "robot.toml").write_text(m.toml)
    robot = robot_file.read(tmp_path / "robot.toml")
    assert robot.configurations.names == tuple(m.names.values())
    w = tables.world(
        np.random.default_rng(8), {1: "wheels", 2: "both"}[len(roles)] if roles != ROLES[0] else "tracks"
    )
    w = dataclasses.replace(w, machine=m, constants=dict(m.constants), conditions=machines.grid(m, m.constants))
    tables.case(w).write(tmp_path / "runs.csv", tmp_path / "label.json")
    runs = records.read(tmp_path / "runs.csv")
    r = steady_batch(robot, runs.conditions(robot)).reading
    ours = np.stack([r["total_current"], r["motor_speed"], r["speed"]])
    theirs, sound = settled.readings(w.conditions, w.constants)
    assert sound.all()
    np.testing.assert_allclose(ours, theirs, rtol=1e-6)
    other = dict(m.constants) | {"gearbox.efficiency_load": m.constants["gearbox.efficiency_load"] * 1.001}
    assert np.abs(ours / settled.readings(w.conditions, other)[0] - 1).max() > 1e-5


def test_truth_of_a_robot_is_near_what_its_file_states():
    for w in worlds("both", 30):
        for name in w.machine.free:
            if "friction.s" in name:  # the surface
                continue
            assert abs(w.constants[name] / w.machine.constants[name] - 1) <= 2 * settled.TOLERANCES[name] + 1e-9


def test_laws_follow_the_size_of_the_robot():
    for seed, name in enumerate(laws.OUTSIDE):
        m = machines.machine(np.random.default_rng([9, seed]), ROLES[seed % 3])
        law = machines.fitted_to(laws.FORMS[name], m)
        shapes = {k: float(np.mean(b)) for k, b in law.shapes.items()}
        here, there = (machines.reference_run(x) for x in (m, machines.PAPER))
        unit = getattr(there, machines.UNITS[law.balance]) / getattr(here, machines.UNITS[law.balance])
        if name in ("slope_rolling", "guide_binding", "commutation_step"):  # of conditions or forces alone
            np.testing.assert_allclose(law.of(here, shapes) * unit, laws.FORMS[name].of(there, shapes), rtol=1e-6)
    assert machines.fitted_to(laws.FORMS["backlash_dither"], machines.PAPER) is laws.FORMS["backlash_dither"]


# --- instruments and tables ---------------------------------------------------------------------------


def residuals(case):
    """Whitened difference of a table from its physics, shape (3, rows)."""
    y, _ = settled.readings(case.conditions, case.constants, case.terms)
    columns = np.stack([case.table[n] for n in READINGS])
    return (columns - y * settled.SHOWN) / case.instruments.stated[:, None]


@pytest.mark.parametrize(("factor", "expected"), [(1.0, 1.0), (0.5, 0.5), (2.0, 2.0)])
def test_noise_is_a_factor_of_what_is_stated(factor, expected):
    left = np.concatenate(
        [residuals(tables.case(w, seed=k)).ravel() for k, w in enumerate(worlds("plain", 15, noise=factor))]
    )
    assert left.std() == pytest.approx(expected, rel=0.05)


def test_coarse_displays_state_their_steps():
    for k, w in enumerate(worlds("quantised", 10)):
        made, show = tables.case(w, seed=k), w.instruments
        assert (np.array(show.step) > 2.5 * np.array(show.sd)).all()
        shown = np.stack([made.table[n] for n in READINGS]) / np.array(show.step)[:, None]
        np.testing.assert_allclose(shown, np.round(shown), atol=1e-4)
        stated = np.stack([made.table[n] for n in ("total_current_sd_A", "motor_speed_sd_rpm", "speed_sd_mm_s")])
        np.testing.assert_allclose(stated[:, 0], np.hypot(show.sd, np.array(show.step) / np.sqrt(12)), atol=1e-6)
        assert 0.8 < residuals(made).std() < 1.2


def test_outliers_are_few_and_gross_and_their_cells_are_on_the_label():
    count = 0
    for k, w in enumerate(worlds("outliers", 20)):
        made = tables.case(w, seed=k)
        left = np.abs(residuals(made))
        cells = {(laws.CHANNELS.index(channel), row - 1) for row, channel in made.label["outliers"]}
        assert {tuple(x) for x in np.argwhere(left > 5)} <= cells
        assert all(left[x] > 2.5 for x in cells)
        count += len(cells)
    assert 0.01 < count / (20 * 270) < 0.03


def test_missing_cells_are_empty_in_the_file(tmp_path):
    (w,) = worlds("missing", 1)
    made = tables.case(w, seed=1)
    made.write(tmp_path / "runs.csv", tmp_path / "label.json")
    runs = records.read(tmp_path / "runs.csv")
    lost = np.isnan(runs.measured())
    assert lost.sum() == made.label["missing"] and 0.05 < lost.mean() < 0.16
    assert (np.isnan(runs.deviations()) == lost).all()
    assert json.loads((tmp_path / "label.json").read_text())["missing"] == lost.sum()


def test_tables_are_short_and_long():
    short, long = ([len(w.conditions.U) for w in worlds(s, 60)] for s in ("short", "long"))
    assert min(short) == 15 and max(short) > 40 and min(long) < 130 and max(long) == 200
    assert all(w.shuffled for w in worlds("short", 5))


# --- order ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", tables.DRIFTS)
def test_drift_goes_with_the_order_of_a_shuffled_table(name):
    (w,) = worlds("plain", 1, shuffled=True)
    made = tables.case(w, [name], 10.0, seed=3)
    (effect,) = made.label["effects"]
    assert effect["sigmas"] == pytest.approx(10, rel=0.05) and effect["where"] == {"variable": "order"}
    balance = tables.DRIFTS[name].balance
    assert effect["balance"] == ("sensor" if balance in laws.CHANNELS else balance) and effect["class"] == ""
    y, _ = settled.readings(w.conditions, w.constants, made.terms)
    change = np.abs(y / settled.readings(w.conditions, w.constants)[0] - 1).max(0)
    rank = np.argsort(np.argsort(change))
    order = np.arange(len(change))
    falling = name.startswith("warming") and not name.endswith("electrical")
    assert abs(np.corrcoef(rank, order)[0, 1]) > 0.4 and (np.corrcoef(rank, order)[0, 1] < 0) == falling
    for column in (w.conditions.U, w.conditions.slope, w.conditions.payload):  # the order is nothing else
        assert abs(np.corrcoef(order, column)[0, 1]) < 0.3


@pytest.mark.parametrize("name", tables.CLUSTERS)
def test_cluster_shifts_the_rows_of_its_label_alone(name):
    (w,) = worlds("plain", 1, shuffled=True)
    made = tables.case(w, [name], 10.0, seed=4)
    (effect,) = made.label["effects"]
    rows = np.array(effect["where"]["rows"]) - 1
    y, _ = settled.readings(w.conditions, w.constants, made.terms)
    change = np.abs(y / settled.readings(w.conditions, w.constants)[0] - 1).max(0)
    assert (change[rows] > 1e-5).all() and (np.delete(change, rows) < 1e-9).all()
    which = name.split(".")[0]
    if which == "rows":
        assert len(rows) >= 4 and (np.diff(rows) == 1).all()
    else:
        values = {"voltage": w.conditions.U, "slope": w.conditions.slope, "payload": w.conditions.payload}[which]
        assert len(set(values[rows])) == 1 and set(values[rows]).isdisjoint(np.delete(values, rows))


# --- sizes ------------------------------------------------------------------------------------------


def test_each_of_three_leaves_its_sigmas_beside_the_others():
    (w,) = worlds("plain", 1)
    made = tables.case(w, ["churning", "series_resistance", "ammeter_gain"], [8.0, 9.0, 10.0], seed=2)
    assert [e["sigmas"] for e in made.label["effects"]] == pytest.approx([8, 9, 10], rel=0.05)
    alone = [tables.case(w, [t.name], seed=2, amplitudes={t.name: t.amplitude}).label for t in made.terms]
    assert all(a["effects"][0]["sigmas"] > e["sigmas"] for a, e in zip(alone, made.label["effects"], strict=True))
    # the same by an explicit refit of everything but the first
    columns = [w.slopes()]
    for k in (1, 2):
        column = tables._signature(w, made.terms, k)
        columns.append((1e4 * column / np.linalg.norm(column))[:, None])
    left = settled.remainder(tables._signature(w, made.terms, 0), np.concatenate(columns, 1))
    assert np.linalg.norm(left) == pytest.approx(8, rel=0.05)


def test_size_counts_only_readings_that_are_there():
    (w,) = worlds("missing", 1)
    whole = dataclasses.replace(w, missing=0.0)
    a, b = (tables.case(x, ["churning"], 8.0, seed=2).label["effects"][0]["amplitude"] for x in (w, whole))
    assert abs(a) > 1.01 * abs(b)


def test_effects_of_a_robot_that_has_no_4W2T_leave_mass_offset_out():
    assert "mass_offset" in worlds("plain", 1)[0].pool and "mass_offset" not in worlds("both", 1)[0].pool


# --- the analyst's priors -----------------------------------------------------------------------------


def coordinates():
    robot = robot_file.load("nominal")
    return priors.coordinates(robot, priors.free_names(robot, ("6T2A", "4W2T")))


def test_priors_of_the_generator_are_those_of_the_fields():
    c = coordinates()
    assert set(c.names) == set(machines.PAPER.free)
    known = {p.name: p for p in params.walk(robot_file.load("nominal"))}
    for name in c.names:
        spec = known[name].spec
        short = tables._last(name)
        if short in tables.ABSOLUTE:
            assert (spec.sd, *spec.bounds) == tables.ABSOLUTE[short]
        else:
            assert spec.relative_sd == tables.RELATIVE[short]
        assert float(known[name].value) == pytest.approx(machines.PAPER.constants[name], rel=1e-9)


def test_truths_from_the_priors_are_where_the_package_has_them():
    c = coordinates()
    for seed in range(50):
        p, z = tables.drawn_from_priors(np.random.default_rng(seed), machines.PAPER)
        value = np.asarray(c.value(np.array([z[n] for n in c.names])))
        np.testing.assert_allclose(value, [p[n] for n in c.names], rtol=1e-6, atol=1e-9)


def test_truths_from_the_priors_have_their_medians_and_spreads():
    drawn = [tables.drawn_from_priors(np.random.default_rng(seed), machines.PAPER)[0] for seed in range(1500)]
    for name in machines.PAPER.free:
        seen = np.array([p[name] for p in drawn])
        nominal = machines.PAPER.constants[name]
        if name.endswith("guide_share"):
            assert np.median(seen) == pytest.approx(nominal, abs=0.02) and seen.min() >= 0
            continue
        width = np.sqrt(np.log1p(tables.RELATIVE[tables._last(name)] ** 2))
        assert np.median(np.log(seen / nominal)) == pytest.approx(0, abs=0.1 * width)
        assert np.std(np.log(seen)) == pytest.approx(width, rel=0.08)


def test_label_of_a_coverage_table_holds_every_truth():
    (w,) = worlds("both", 1, from_priors=True)
    label = tables.case(w, ["churning"], 8.0, seed=1).label
    assert set(label["constants"]) == set(label["z"]) == {w.machine.public(n) for n in w.machine.free}
    assert any(n.startswith("crawler.") for n in label["z"]) and label["effects"][0]["amplitude"] != 0


# --- noise of its own -----------------------------------------------------------------------------------


def noise_of(law):
    """Noise of many tables [sd], shape (rows, channels, tables), and their readings without any [shown]."""
    w = tables.world(np.random.default_rng(3), "plain", law=law)
    truth = settled.readings(w.conditions, w.constants)[0] * settled.SHOWN
    off = []
    for seed in range(200):
        table = tables.case(w, seed=seed).table
        off.append((np.stack([table[c] for c in READINGS]) - truth) / w.instruments.stated[:, None])
    return np.array(off), truth


@pytest.mark.parametrize("law", tables.NOISES)
def test_noise_is_as_large_as_stated_by_any_law(law):
    off, truth = noise_of(law)
    np.testing.assert_allclose(off.std((0, 2)), 1.0, rtol=0.12 if law == "heavy" else 0.03)
    large = np.abs(truth) > np.median(np.abs(truth), 1, keepdims=True)
    ratio = [off[:, k, large[k]].std() / off[:, k, ~large[k]].std() for k in range(3)]
    assert min(ratio) > 1.2 if law == "uneven" else law == "heavy" or np.allclose(ratio, 1.0, atol=0.06)
    assert (np.mean(np.abs(off) > 4) > 0.002) == (law == "heavy")


def test_few_rows_are_a_grid_of_slopes_at_two_voltages():
    c = tables.world(np.random.default_rng(4), "few").conditions
    assert len(c.U) == 20 and not c.payload.any() and len(np.unique(c.U)) == 2


def test_runs_elsewhere_are_as_many_and_between_those_of_the_table():
    w = tables.world(np.random.default_rng(5), "plain", law="heavy", stated=False)
    case = tables.case(w, ("series_resistance",), 8.0, seed=1)
    table = case.elsewhere(1)
    assert len(table["speed_mm_s"]) == len(w.conditions.U) and "speed_sd_mm_s" in table
    assert "speed_sd_mm_s" not in case.table
    assert table["slope_deg"].min() >= 0 and table["slope_deg"].max() <= case.table["slope_deg"].max()
    assert not set(table["supply_voltage_V"]) & set(case.table["supply_voltage_V"])
