"""The generator of synthetic data: its clean tables and its effects against mmrjax, its sizes, labels and noise."""

import ast
import dataclasses
import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from worlds import laws, paper, settled, tables

from calibration.data import runs as records
from mmrjax import params, robots
from mmrjax.conditions import Conditions
from mmrjax.effects import ALL, BY_NAME
from mmrjax.fidelities.steady import steady_batch

GRID = settled.table8(payloads=robots.PAYLOADS_KG)
#: What the generator calls a shape parameter, and what the library does.
SHAPES = {
    "knee": "current_ohmic",
    "fade": "speed_fade",
    "critical": "speed_critical",
    "relaxation": "speed_relaxation",
    "peel": "speed_peel",
    "exponent": "exponent",
}


@pytest.fixture(scope="module")
def package():
    """Readings of `steady` on GRID, shape (3, rows), for constants and a term of the library."""
    base = params.replace(robots.nominal(), settled.CLIMBING)
    full = dataclasses.replace(base, effects=tuple(BY_NAME[name]() for name in laws.LIBRARY))
    run = Conditions(GRID.wheeled, GRID.U, np.degrees(GRID.slope), GRID.payload, total_mass=GRID.mass)

    every = {p.name: p.value for p in params.walk(full)}

    def read(constants=None, term=None):
        values = every | (constants or {})
        if term is not None:
            values[f"effects.{term.name}.amplitude"] = term.amplitude
            values |= {f"effects.{term.name}.{SHAPES[k]}": v for k, v in term.shapes.items()}
        # all of one type, so that one compiled program serves every call
        r = steady_batch(params.replace(full, {k: jnp.asarray(v, float) for k, v in values.items()}), run).reading
        return np.stack([r["total_current"], r["motor_speed"], r["speed"]])

    return read


def test_generator_imports_nothing_of_the_package():
    for path in (Path(__file__).parent / "worlds").glob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        modules = {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
        modules |= {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
        # of turns, names and units of columns are the package's
        foreign = {m for m in modules if m.split(".")[0] in ("mmrjax", "calibration", "sweeps", "jax")}
        assert foreign == ({"mmrjax"} if path.name == "turns.py" else set())


def test_generator_holds_every_effect_that_steady_runs_show():
    # battery_sag acts on the battery alone, thermal_drift settles to winding_heating; forward directional_friction is
    # loss_coulomb, and up a slope no load drives a motor; forward a torque_offset is loss_coulomb too, and
    # directional_viscous loss_viscous
    forward = {"directional_friction", "torque_offset", "directional_viscous"}
    other = {"battery_sag", "thermal_drift", "backdriving_loss", *forward}
    shown = {e.name for e in ALL if not e.transient} - other
    assert set(laws.LIBRARY) == shown
    assert all(f.cls == name for name, f in laws.LIBRARY.items())
    assert {f.cls for f in laws.VARIANTS.values()} <= shown
    assert {f.cls for f in laws.OUTSIDE.values()} == {""} and len(laws.OUTSIDE) >= 6


def test_clean_tables_agree_with_steady(package):
    y, sound = settled.readings(GRID, settled.CLIMBING)
    assert sound.all() and len(GRID.U) == 180
    np.testing.assert_allclose(package(), y, rtol=1e-9)


def test_clean_tables_with_other_constants_agree_with_steady(package):
    p = settled.perturbed(np.random.default_rng(5))
    y, sound = settled.readings(GRID, p)
    assert sound.all()
    np.testing.assert_allclose(package({n: p[n] for n in p if p[n] != paper.NOMINAL[n]}), y, rtol=1e-9)


def test_comparison_with_steady_can_fail(package):
    y, _ = settled.readings(GRID, settled.CLIMBING | {"motor.resistance": 0.6111})
    with pytest.raises(AssertionError):
        np.testing.assert_allclose(package(), y, rtol=1e-6)


@pytest.mark.parametrize("name", laws.LIBRARY)
def test_library_effect_agrees_with_steady(package, name):
    drawn = laws.draw(name, np.random.default_rng(3))
    term = dataclasses.replace(drawn, amplitude=drawn.amplitude * laws.FORMS[name].size)
    y, sound = settled.readings(GRID, settled.CLIMBING, [term])
    assert sound.all()
    np.testing.assert_allclose(package(term=term), y, rtol=1e-8)
    assert np.abs(y / settled.readings(GRID, settled.CLIMBING)[0] - 1).max() > 1e-4


#: Channels that an effect of a balance may move, and the sign of the largest change at positive amplitude.
MOVES = {
    "supply": {"motor_speed": -1, "speed": -1},
    "electrical": {"motor_speed": -1, "speed": -1},
    "motor": {"total_current": 1, "motor_speed": -1},
    "gearbox": {"total_current": 1, "motor_speed": -1},
    "track": {"total_current": 1, "motor_speed": -1},
    "ground": {"total_current": 1, "motor_speed": -1, "speed": -1},
    "mass": {"total_current": 1, "speed": -1},
    "slip": {"speed": -1},
    **{channel: {channel: 1} for channel in laws.CHANNELS},
}
ONLY = {"slip", *laws.CHANNELS}  # no other channel moves at all


@pytest.mark.parametrize("name", laws.FORMS)
def test_every_effect_moves_its_channel(name):
    form = laws.FORMS[name]
    term = dataclasses.replace(laws.draw(name, np.random.default_rng(8)), amplitude=form.size)
    y, sound = settled.readings(GRID, settled.CLIMBING, [term])
    change = (y / settled.readings(GRID, settled.CLIMBING)[0] - 1)[:, sound]
    for k, channel in enumerate(laws.CHANNELS):
        sign = MOVES[form.balance].get(channel)
        if sign is not None:
            largest = change[k][np.abs(change[k]).argmax()]
            if name == "rolling_radius":
                sign = -sign
            assert abs(largest) > 1e-5 and (name == "supply_hunting" or np.sign(largest) == sign), channel
        elif form.balance in ONLY:
            assert np.abs(change[k]).max() < 1e-12, channel


@pytest.mark.parametrize("name", laws.FORMS)
def test_size_is_the_wanted_number_of_sigmas(name):
    made = tables.narrow([name], sigmas=8.0, seed=21)
    (effect,) = made.label["effects"]
    assert effect["sigmas"] == pytest.approx(8.0, rel=0.05)
    assert made.label["sigmas_together"] == pytest.approx(effect["sigmas"], rel=1e-6)
    assert len(made.table["slope_deg"]) == 90 - made.label["rows_lost"]


def test_remainder_of_what_the_constants_can_do_is_small():
    p, show = dict(settled.CLIMBING), settled.Instruments()
    slopes = settled.base_slopes(GRID, p, show)
    name = "motor.resistance"
    other = p | {name: p[name] * (1 + 0.5 * settled.TOLERANCES[name])}
    change = (
        (settled.readings(GRID, other)[0] - settled.readings(GRID, p)[0]) * settled.SHOWN / show.stated[:, None]
    ).ravel()
    k = list(settled.TOLERANCES).index(name)
    np.testing.assert_allclose(change, 0.5 * slopes[:, k], rtol=0.02, atol=0.02 * np.abs(change).max())
    # a half sigma of the prior at most
    assert np.linalg.norm(settled.remainder(change, slopes)) <= 0.51


def test_clean_table_differs_from_its_physics_by_the_stated_noise():
    show = settled.Instruments()
    left = []
    for seed in range(20):
        made = tables.narrow(seed=seed)
        y, _ = settled.readings(made.conditions, made.constants)
        columns = [made.table[n] for n in ("total_current_A", "motor_speed_rpm", "speed_mm_s")]
        left.append((np.stack(columns) - y * settled.SHOWN) / show.stated[:, None])
    left = np.concatenate(left, 1)
    assert np.abs(left.std(1) - 1).max() < 0.08 and np.abs(left.mean(1)).max() < 0.1
    steps = np.stack([made.table[n] for n in ("total_current_A", "motor_speed_rpm", "speed_mm_s")])
    shown = steps / np.array(show.step)[:, None]
    np.testing.assert_allclose(shown, np.round(shown), atol=1e-6)


def test_cases_are_reproducible_and_seeds_differ():
    a, b, c = (tables.narrow(["churning"], seed=s) for s in (4, 4, 5))
    assert a.label == b.label and a.label != c.label
    for name in a.table:
        np.testing.assert_array_equal(a.table[name], b.table[name])


def test_two_effects_and_their_label():
    made = tables.narrow(["brush_drop", "resonance_bump"], sigmas=10.0, seed=2)
    assert made.label["kind"] == "library+outside"
    assert [e["class"] for e in made.label["effects"]] == ["brush_drop", ""]
    assert all(e["sigmas"] == pytest.approx(10, rel=0.05) for e in made.label["effects"])
    assert made.label["sigmas_together"] > 10


def test_compensating_pair_hides_part_of_itself():
    made = tables.narrow(["churning", "windage"], sigmas=10.0, seed=2, compensating=True)
    first, second = made.label["effects"]
    assert first["amplitude"] * second["amplitude"] < 0
    assert made.label["sigmas_together"] < 0.8 * first["sigmas"]


def test_table_and_label_are_separate_files_and_the_table_passes_the_input_checks(tmp_path):
    made = tables.narrow(["windage"], seed=9)
    made.write(tmp_path / "runs.csv", tmp_path / "label.json")
    assert "windage" not in (tmp_path / "runs.csv").read_text()
    assert json.loads((tmp_path / "label.json").read_text())["effects"][0]["name"] == "windage"
    runs = records.read(tmp_path / "runs.csv")
    assert len(runs) == 90 and runs.has("total_current_sd_A")


def test_more_runs_come_from_the_same_robot():
    made = tables.narrow(["series_resistance"], seed=9)
    again = made.more(made.conditions, seed=1)
    difference = again["total_current_A"] - made.table["total_current_A"]
    assert 0 < np.abs(difference).max() < 0.2
    assert len(made.more(settled.conditions([0, 1], 24.0, -5.0, 0.0), seed=1)["slope_deg"]) == 2


def test_without_effects_sigmas_are_none():
    assert tables.narrow(seed=1).label["sigmas_together"] == 0.0
    assert tables.narrow(seed=1).label["kind"] == "clean" and tables.narrow(seed=1).label["effects"] == []


def test_a_term_may_bring_its_own_law_and_see_when_a_row_was_measured():
    law = laws.Law("", "track", lambda s, q: s.order, 0.1)
    rows = settled.table8().at(np.arange(89, -1, -1))
    term = laws.Term("drift", 0.1, law=law)
    y, sound = settled.readings(rows, settled.CLIMBING, [term])
    change = (y / settled.readings(rows, settled.CLIMBING)[0] - 1)[0]
    assert sound.all() and change[0] == pytest.approx(0, abs=1e-9) and change[-1] > 5 * change[9] > 0
    assert (rows.slope == settled.table8().slope[::-1]).all()


def test_slopes_take_the_sds_that_they_are_given():
    p, show = dict(settled.CLIMBING), settled.Instruments()
    name = "4W2T.ground.friction.speed_static"
    usual = settled.base_slopes(GRID, p, show, (name,))
    wide = settled.base_slopes(GRID, p, show, (name,), {name: p[name]})
    np.testing.assert_allclose(wide, usual / 0.3, rtol=1e-6)
