"""Tables that campaigns draw: strata, noise and faults, drifts and clusters, robots, priors, labels."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from worlds import laws, machines, settled, tables
from worlds.machines import PAPER, ROLES, TRACKS, WHEELS
from worlds.settled import CLIMBING, Instruments, readings, remainder
from worlds.tables import READINGS, narrow

from calibration.data import robot_file
from calibration.data import runs as records
from calibration.inference import priors
from mmrjax.model import paper_robots, params
from tests.commands import read_json

BUILDS = ((TRACKS,), (WHEELS,), ROLES)


def worlds(stratum, count, **options):
    return [tables.world(np.random.default_rng([5, seed]), stratum, **options) for seed in range(count)]


@pytest.fixture(scope="module")
def plain():
    return worlds("plain", 200)


@pytest.fixture(scope="module")
def made():
    """Robots of each build."""
    return [machines.machine(np.random.default_rng([6, seed]), BUILDS[seed % 3]) for seed in range(240)]


def residuals(case):
    """Whitened difference of a table from its physics, shape (3, rows)."""
    y, _ = readings(case.conditions, case.constants, case.terms)
    columns = np.stack([case.table[n] for n in READINGS])
    return (columns - y * settled.SHOWN) / case.instruments.stated[:, None]


def test_size_counts_only_readings_that_are_there():
    (w,) = worlds("missing", 1)
    whole = dataclasses.replace(w, missing=0.0)
    a, b = (tables.case(x, ["churning"], 8.0, seed=2).label["effects"][0]["amplitude"] for x in (w, whole))
    assert abs(a) > 1.01 * abs(b)


def test_compensating_pair_hides_part_of_itself():
    made = narrow(["churning", "windage"], sigmas=10.0, seed=2, compensating=True)
    first, second = made.label["effects"]
    assert first["amplitude"] * second["amplitude"] < 0
    assert made.label["sigmas_together"] < 0.8 * first["sigmas"]


@pytest.mark.quick(1)
@pytest.mark.parametrize(("factor", "expected"), [(1.0, 1.0), (0.5, 0.5), (2.0, 2.0)])
def test_noise_is_a_factor_of_what_is_stated(factor, expected):
    cases = [tables.case(w, seed=k) for k, w in enumerate(worlds("plain", 15, noise=factor))]
    assert np.concatenate([residuals(c).ravel() for c in cases]).std() == pytest.approx(expected, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("law", tables.NOISES)
def test_noise_is_as_large_as_stated_by_any_law(law):
    w = tables.world(np.random.default_rng(3), "plain", law=law)
    truth = readings(w.conditions, w.constants)[0] * settled.SHOWN
    off = np.array([residuals(tables.case(w, seed=seed)) for seed in range(200)])
    assert_allclose(off.std((0, 2)), 1.0, rtol=0.12 if law == "heavy" else 0.03)
    large = np.abs(truth) > np.median(np.abs(truth), 1, keepdims=True)
    ratio = [off[:, k, large[k]].std() / off[:, k, ~large[k]].std() for k in range(3)]
    assert min(ratio) > 1.2 if law == "uneven" else law == "heavy" or np.allclose(ratio, 1.0, atol=0.06)
    assert (np.mean(np.abs(off) > 4) > 0.002) == (law == "heavy")


def test_coarse_displays_state_their_steps():
    for k, w in enumerate(worlds("quantised", 10)):
        made, show = tables.case(w, seed=k), w.instruments
        assert (np.array(show.step) > 2.5 * np.array(show.sd)).all()
        shown = np.stack([made.table[n] for n in READINGS]) / np.array(show.step)[:, None]
        assert_allclose(shown, np.round(shown), atol=1e-4)
        stated = np.stack([made.table[n] for n in tables.DEVIATIONS])
        assert_allclose(stated[:, 0], np.hypot(show.sd, np.array(show.step) / np.sqrt(12)), atol=1e-6)
        assert 0.8 < residuals(made).std() < 1.2


def test_outliers_are_few_and_gross_and_their_cells_are_on_the_label():
    count = 0
    for k, w in enumerate(worlds("outliers", 20)):
        made = tables.case(w, seed=k)
        left = np.abs(residuals(made))
        cells = {(laws.CHANNELS.index(channel), row - 1) for row, channel in made.label["outliers"]}
        assert {tuple(x) for x in np.argwhere(left > 5)} <= cells and all(left[x] > 2.5 for x in cells)
        count += len(cells)
    assert 0.01 < count / (20 * 270) < 0.03


def test_missing_cells_are_empty_in_the_file(tmp_path):
    (w,) = worlds("missing", 1)
    made = tables.case(w, seed=1)
    made.write(tmp_path)
    runs = records.read_runs(tmp_path / "table.csv")
    lost = np.isnan(runs.measured())
    assert lost.sum() == made.label["missing"] and 0.05 < lost.mean() < 0.16
    assert (np.isnan(runs.deviations()) == lost).all()


def test_tables_are_few_short_and_long():
    short, long = ([len(w.conditions.U) for w in worlds(s, 60)] for s in ("short", "long"))
    assert min(short) == 15 and max(short) > 40 and min(long) < 130 and max(long) == 200
    assert all(w.shuffled for w in worlds("short", 5))
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


@pytest.mark.parametrize("name", tables.DRIFTS)
def test_drift_goes_with_the_order_of_a_shuffled_table(name):
    (w,) = worlds("plain", 1, shuffled=True)
    made = tables.case(w, [name], 10.0, seed=3)
    (effect,) = made.label["effects"]
    assert effect["sigmas"] == pytest.approx(10, rel=0.05) and effect["where"] == {"variable": "order"}
    balance = tables.DRIFTS[name].balance
    assert effect["balance"] == ("sensor" if balance in laws.CHANNELS else balance) and effect["class"] == ""
    y, _ = readings(w.conditions, w.constants, made.terms)
    change = np.abs(y / readings(w.conditions, w.constants)[0] - 1).max(0)
    rank, order = np.argsort(np.argsort(change)), np.arange(len(change))
    falling = name.startswith("warming") and not name.endswith("electrical")
    assert abs(np.corrcoef(rank, order)[0, 1]) > 0.4 and (np.corrcoef(rank, order)[0, 1] < 0) == falling
    for column in (w.conditions.U, w.conditions.slope, w.conditions.payload):  # the order is nothing else
        assert abs(np.corrcoef(order, column)[0, 1]) < 0.3


@pytest.mark.parametrize("name", tables.CLUSTERS)
def test_cluster_shifts_the_rows_of_its_label_alone(name):
    (w,) = worlds("plain", 1, shuffled=True)
    made = tables.case(w, [name], 10.0, seed=4)
    rows = np.array(made.label["effects"][0]["where"]["rows"]) - 1
    y, _ = readings(w.conditions, w.constants, made.terms)
    change = np.abs(y / readings(w.conditions, w.constants)[0] - 1).max(0)
    assert (change[rows] > 1e-5).all() and (np.delete(change, rows) < 1e-9).all()
    which = name.split(".")[0]
    if which == "rows":
        assert len(rows) >= 4 and (np.diff(rows) == 1).all()
    else:
        values = {"voltage": w.conditions.U, "slope": w.conditions.slope, "payload": w.conditions.payload}[which]
        assert len(set(values[rows])) == 1 and set(values[rows]).isdisjoint(np.delete(values, rows))


def test_surfaces_span_adhesion_and_creep(plain):
    for role in ROLES:
        hold = np.array([w.constants[f"{role}.ground.friction.static"] for w in plain])
        creep = np.array([w.constants[f"{role}.ground.friction.speed_static"] for w in plain])
        assert hold.min() < 0.23 and hold.max() > 0.97 and abs(np.median(hold) - 0.6) < 0.08
        assert creep.min() < 0.0025 and creep.max() > 0.05 and 0.007 < np.median(creep) < 0.017
        share = [w.constants[f"{role}.ground.friction.dynamic"] for w in plain] / hold
        assert_allclose(share, 0.8)


@pytest.mark.quick(1)
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
        tracked = w.conditions.wheeled < 0.5
        assert 0.03 < w.conditions.slope[tracked].max() < np.radians(14)
        steep = np.full(len(tracked), np.radians(20.0))
        assert not readings(dataclasses.replace(w.conditions, slope=steep), w.constants)[1][tracked].any()


def test_robots_span_their_ranges_and_their_constants_fit_together(made):
    for name, (low, high) in {"mass": (2, 60), "ratio": (10, 120), "radius": (0.02, 0.15), "supply": (6, 48)}.items():
        seen = np.array([m.size[name] for m in made])
        assert low <= seen.min() < 1.3 * low and high >= seen.max() > high / 1.3
    for m in made:
        p = m.constants
        y, sound = readings(machines.grid(m, p), p)
        assert sound.all() and y[0].min() > 0.05 and y[0].max() < 120
        no_load = m.supply / p["motor.torque_constant"]
        assert 250 < no_load < 1300 and (y[1] < no_load).all() and y[2].min() > 0.02 and y[2].max() < 4.5
        dry = p["motor.friction_coulomb"] + p["gearbox.friction_coulomb"]
        assert dry / p["motor.torque_constant"] < 0.12 * np.median(y[0])  # current at no load


def test_truth_of_a_robot_is_near_what_its_file_states():
    for w in worlds("both", 30):
        for name in w.machine.free:
            if "friction.s" not in name:  # of the surface nothing is known
                off = abs(w.constants[name] / w.machine.constants[name] - 1)
                assert off <= 2 * settled.TOLERANCES[name] + 1e-9
    assert "mass_offset" in worlds("plain", 1)[0].pool and "mass_offset" not in w.pool


def test_laws_follow_the_size_of_the_robot():
    for seed, (name, own) in enumerate(laws.OUTSIDE.items()):
        m = machines.machine(np.random.default_rng([9, seed]), BUILDS[seed % 3])
        law = machines.fitted_to(own, m)
        shapes = {k: float(np.mean(b)) for k, b in law.shapes.items()}
        here, there = (machines.reference_run(x) for x in (m, PAPER))
        unit = getattr(there, machines.UNITS[law.balance]) / getattr(here, machines.UNITS[law.balance])
        if name in ("slope_rolling", "guide_binding", "commutation_step"):  # of conditions or forces alone
            assert_allclose(law.of(here, shapes) * unit, own.of(there, shapes), rtol=1e-6)
        assert machines.fitted_to(own, PAPER) is own


def test_priors_are_those_of_the_fields_and_truths_are_where_the_package_has_them():
    robot = robot_file.load_robot("nominal")
    c = priors.parameter_coordinates(robot, priors.loop_parameter_names(robot, ("6T2A", "4W2T")))
    assert set(c.names) == set(PAPER.free)
    known = {p.name: p for p in params.walk_parameters(robot)}
    for name in c.names:
        spec, short = known[name].spec, tables._last(name)
        if short in tables.ABSOLUTE:
            assert (spec.sd, *spec.bounds) == tables.ABSOLUTE[short]
        else:
            assert spec.relative_sd == tables.RELATIVE[short]
        assert float(known[name].value) == pytest.approx(PAPER.constants[name], rel=1e-9)
    for seed in range(50):
        p, z = tables.drawn_from_priors(np.random.default_rng(seed), PAPER)
        value = np.asarray(c.value(np.array([z[n] for n in c.names])))
        assert_allclose(value, [p[n] for n in c.names], rtol=1e-6, atol=1e-9)


def test_truths_from_the_priors_have_their_medians_and_spreads():
    drawn = [tables.drawn_from_priors(np.random.default_rng(seed), PAPER)[0] for seed in range(1500)]
    for name in PAPER.free:
        seen, nominal = np.array([p[name] for p in drawn]), PAPER.constants[name]
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


GRID = settled.table8(payloads=paper_robots.PAYLOADS_KG)


CLEAN = readings(GRID, CLIMBING)[0]


#: Channels that an effect of a balance may move, and the sign of the largest change at positive amplitude.
MOVES = {
    **{b: {"motor_speed": -1, "speed": -1} for b in ("supply", "electrical")},
    **{b: {"total_current": 1, "motor_speed": -1} for b in ("motor", "gearbox", "track")},
    "ground": {"total_current": 1, "motor_speed": -1, "speed": -1},
    "mass": {"total_current": 1, "speed": -1},
    "slip": {"speed": -1},
    **{channel: {channel: 1} for channel in laws.CHANNELS},
}


@pytest.mark.parametrize("name", laws.FORMS)
def test_every_effect_moves_its_channel_and_leaves_the_wanted_sigmas(name):
    law = laws.FORMS[name]
    term = dataclasses.replace(laws.draw(name, np.random.default_rng(8)), amplitude=law.size)
    y, sound = readings(GRID, CLIMBING, [term])
    change = (y / CLEAN - 1)[:, sound]
    for k, channel in enumerate(laws.CHANNELS):
        sign = MOVES[law.balance].get(channel)
        if sign is not None:
            largest = change[k][np.abs(change[k]).argmax()]
            sign = -sign if name == "rolling_radius" else sign
            assert abs(largest) > 1e-5 and (name == "supply_hunting" or np.sign(largest) == sign), channel
        elif law.balance in ("slip", *laws.CHANNELS):  # no other channel moves at all
            assert np.abs(change[k]).max() < 1e-12, channel
    made = narrow([name], sigmas=8.0, seed=21)
    (effect,) = made.label["effects"]
    assert effect["sigmas"] == pytest.approx(8.0, rel=0.05)
    assert made.label["sigmas_together"] == pytest.approx(effect["sigmas"], rel=1e-6)
    assert len(made.table["slope_deg"]) == 90 - made.label["rows_lost"]


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
    left = remainder(tables._signature(w, made.terms, 0), np.concatenate(columns, 1))
    assert np.linalg.norm(left) == pytest.approx(8, rel=0.05)


def test_clean_table_differs_from_its_physics_by_the_stated_noise():
    cases = [narrow(seed=seed) for seed in range(20)]
    left = np.concatenate([residuals(c) for c in cases], 1)
    assert np.abs(left.std(1) - 1).max() < 0.08 and np.abs(left.mean(1)).max() < 0.1
    shown = np.stack([cases[-1].table[n] for n in READINGS]) / np.array(Instruments().step)[:, None]
    assert_allclose(shown, np.round(shown), atol=1e-6)


def test_cases_are_reproducible_and_their_labels_tell_them_apart():
    a, b, c = (narrow(["churning"], seed=s) for s in (4, 4, 5))
    assert a.label == b.label and a.label != c.label
    for name in a.table:
        assert_array_equal(a.table[name], b.table[name])
    clean = narrow(seed=1).label
    assert clean["sigmas_together"] == 0.0 and clean["kind"] == "clean" and clean["effects"] == []
    both = narrow(["brush_drop", "resonance_bump"], sigmas=10.0, seed=2).label
    assert both["kind"] == "library+outside" and [e["class"] for e in both["effects"]] == ["brush_drop", ""]
    assert all(e["sigmas"] == pytest.approx(10, rel=0.05) for e in both["effects"]) and both["sigmas_together"] > 10


def test_table_and_label_are_separate_files_and_the_table_passes_the_input_checks(tmp_path):
    narrow(["windage"], seed=9).write(tmp_path)
    assert "windage" not in (tmp_path / "table.csv").read_text()
    assert read_json(tmp_path / "label.json")["effects"][0]["name"] == "windage"
    runs = records.read_runs(tmp_path / "table.csv")
    assert len(runs) == 90 and runs.has("total_current_sd_A")
