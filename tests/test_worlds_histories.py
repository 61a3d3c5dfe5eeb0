"""Synthetic histories: physics and effects against `drive`, surfaces and samplings, gaps, events, sizes and labels."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from worlds import histories, laws, machines, settled
from worlds.histories import SERIES, simulated
from worlds.settled import CLIMBING, of_rows

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
