"""Synthetic tables: physics and effects against mmrjax, sizes, labels, noise and faults, robots and the analyst's priors."""

import ast
import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from worlds import laws, machines, settled, tables
from worlds.machines import ROLES, TRACKS, WHEELS
from worlds.settled import CLIMBING, Instruments, readings, remainder

from calibration.data import robot_file
from calibration.data import runs as records
from mmrjax.effects import ALL, BY_NAME
from mmrjax.fidelities.steady import steady_batch
from mmrjax.model import paper_robots, params
from mmrjax.model.conditions import Conditions

GRID = settled.table8(payloads=paper_robots.PAYLOADS_KG)
CLEAN = readings(GRID, CLIMBING)[0]
#: What the worlds call a shape parameter, and what the library does.
SHAPES = {
    "knee": "current_ohmic", "fade": "speed_fade", "critical": "speed_critical", "relaxation": "speed_relaxation",
    "peel": "speed_peel", "exponent": "exponent",
}  # fmt: skip
BUILDS = ((TRACKS,), (WHEELS,), ROLES)


@pytest.fixture(scope="module")
def package():
    """Readings of `steady` on GRID, shape (3, rows), for constants and a term of the library."""
    base = params.replace(paper_robots.nominal(), CLIMBING)
    full = dataclasses.replace(base, effects=tuple(BY_NAME[name]() for name in laws.LIBRARY))
    run = Conditions(GRID.wheeled, GRID.U, np.degrees(GRID.slope), GRID.payload, total_mass=GRID.mass)
    every = {p.name: p.value for p in params.walk_parameters(full)}

    def read(constants=None, term=None):
        values = every | (constants or {})
        if term is not None:
            values[f"effects.{term.name}.amplitude"] = term.amplitude
            values |= {f"effects.{term.name}.{SHAPES[k]}": v for k, v in term.shapes.items()}
        # all of one type, so that one compiled program serves every call
        r = steady_batch(params.replace(full, {k: jnp.asarray(v, float) for k, v in values.items()}), run).reading
        return np.stack([r["total_current"], r["motor_speed"], r["speed"]])

    return read


def test_worlds_import_nothing_of_the_package():
    for path in (Path(__file__).parent / "worlds").glob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        modules = {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
        modules |= {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
        # of turns, names and units of columns are the package's
        ours = {m for m in modules if m.split(".")[0] in ("mmrjax", "calibration", "sweeps", "jax")}
        assert ours == ({"mmrjax.model"} if path.name == "turns.py" else set())


# --- physics ------------------------------------------------------------------------------------------


def test_library_is_of_every_effect_that_steady_runs_show():
    # battery_sag acts on the battery alone, coast_decay at a duty below 1; thermal_drift settles to winding_heating; forward directional_friction is
    # loss_coulomb, and up a slope no load drives a motor; forward a torque_offset is loss_coulomb too, and
    # directional_viscous loss_viscous, directional_stribeck stribeck_track
    forward = {"directional_friction", "torque_offset", "directional_viscous", "directional_stribeck"}
    other = {e.name for e in ALL if e.memory_size is not None} | {
        "battery_sag",
        "coast_decay",
        "duty_exponent",
        "duty_dead_band",
        "duty_saturation",
        "backdriving_loss",
        *forward,
    }
    shown = {e.name for e in ALL if not e.transient} - other
    assert set(laws.LIBRARY) == shown
    assert all(law.cls == name for name, law in laws.LIBRARY.items())
    assert {law.cls for law in laws.VARIANTS.values()} <= shown
    assert {law.cls for law in laws.OUTSIDE.values()} == {""} and len(laws.OUTSIDE) >= 6


@pytest.mark.slow
def test_clean_tables_agree_with_steady(package):
    assert CLEAN.shape[1] == 180
    assert_allclose(package(), CLEAN, rtol=1e-9)
    p = settled.perturbed(np.random.default_rng(5))
    y, sound = readings(GRID, p)
    assert sound.all()
    assert_allclose(package({n: p[n] for n in p if p[n] != CLIMBING[n]}), y, rtol=1e-9)
    y, _ = readings(GRID, CLIMBING | {"motor.resistance": 0.6111})
    with pytest.raises(AssertionError):
        assert_allclose(package(), y, rtol=1e-6)


@pytest.mark.parametrize("name", laws.LIBRARY)
def test_library_effect_agrees_with_steady(package, name):
    drawn = laws.draw(name, np.random.default_rng(3))
    term = dataclasses.replace(drawn, amplitude=drawn.amplitude * drawn.law.size)
    y, sound = readings(GRID, CLIMBING, [term])
    assert sound.all()
    assert_allclose(package(term=term), y, rtol=1e-8)
    assert np.abs(y / CLEAN - 1).max() > 1e-4


# --- what a refit leaves --------------------------------------------------------------------------------


# --- tables and labels ----------------------------------------------------------------------------------


# --- what goes with the order or with some rows ---------------------------------------------------------


# --- surfaces and robots --------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("roles", [ROLES, *(pytest.param(r, marks=pytest.mark.slow) for r in BUILDS[:-1])])
def test_robot_file_is_read_and_runs_agree_with_steady(tmp_path, roles):
    m = machines.machine(np.random.default_rng([7, len(roles)]), roles)
    w = tables.world(
        np.random.default_rng(8), {1: "wheels", 2: "both"}[len(roles)] if roles != (TRACKS,) else "tracks"
    )
    w = dataclasses.replace(w, machine=m, constants=dict(m.constants), conditions=machines.grid(m, m.constants))
    tables.case(w).write(tmp_path)
    robot = robot_file.read_robot(tmp_path / "rig.toml")
    assert robot.configurations.names == tuple(m.names.values())
    r = steady_batch(robot, records.read_runs(tmp_path / "table.csv").conditions(robot)).reading
    ours = np.stack([r["total_current"], r["motor_speed"], r["speed"]])
    theirs, sound = readings(w.conditions, w.constants)
    assert sound.all()
    assert_allclose(ours, theirs, rtol=1e-6)
    other = dict(m.constants) | {"gearbox.efficiency_load": m.constants["gearbox.efficiency_load"] * 1.001}
    assert np.abs(ours / readings(w.conditions, other)[0] - 1).max() > 1e-5


# --- the analyst's priors -----------------------------------------------------------------------------


def test_a_term_may_bring_its_own_law_and_see_when_a_row_was_measured():
    rows = settled.table8().at(np.arange(89, -1, -1))
    term = laws.Term("drift", 0.1, law=laws.Law("", "track", lambda s, q: s.order, 0.1))
    y, sound = readings(rows, CLIMBING, [term])
    change = (y / readings(rows, CLIMBING)[0] - 1)[0]
    assert sound.all() and change[0] == pytest.approx(0, abs=1e-9) and change[-1] > 5 * change[9] > 0
    assert (rows.slope == settled.table8().slope[::-1]).all()


def test_remainder_of_what_the_constants_can_do_is_small():
    p, show, name = dict(CLIMBING), Instruments(), "motor.resistance"
    slopes = settled.base_slopes(GRID, p, show)
    other = p | {name: p[name] * (1 + 0.5 * settled.TOLERANCES[name])}
    change = ((readings(GRID, other)[0] - CLEAN) * settled.SHOWN / show.stated[:, None]).ravel()
    column = slopes[:, list(settled.TOLERANCES).index(name)]
    assert_allclose(change, 0.5 * column, rtol=0.02, atol=0.02 * np.abs(change).max())
    # a half sigma of the prior at most
    assert np.linalg.norm(remainder(change, slopes)) <= 0.51
    name = "4W2T.ground.friction.speed_static"  # slopes take the sds that they are given
    wide = settled.base_slopes(GRID, p, show, (name,), {name: p[name]})
    assert_allclose(wide, settled.base_slopes(GRID, p, show, (name,)) / 0.3, rtol=1e-6)
