"""The generator of synthetic histories against `drive`, and its labels."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from worlds import histories, laws, settled

from calibration.data import runs as records
from mmrjax import params, robots
from mmrjax.conditions import Conditions
from mmrjax.effects import ALL, BY_NAME
from mmrjax.fidelities.drive import drive_batch

RUNS = histories.starts(settled.CLIMBING)
DURATION, EVERY = 0.6, 0.01
PASSING = tuple(n for n, f in laws.SERIES.items() if f.cls)
#: What the library calls a shape parameter.
SHAPES = {"knee": "current_ohmic", "fade": "speed_fade"}
#: Of each channel's largest value in the run; 1.3e-5 at worst (brushes, 5 ohm more while the current rises), 4e-6 for a
#: battery run whose movers spin, else below 2e-6.
ERROR = 2e-5
#: The same of clean starts; 1.3e-6 measured, the error of the generator's own step.
CLEAN = 4e-6


@pytest.fixture(scope="module")
def package():
    """Histories of `drive` for amplitudes of PASSING, shape (3, runs, instants)."""
    base = params.replace(robots.nominal(), settled.CLIMBING)
    full = dataclasses.replace(base, effects=tuple(BY_NAME[n]() for n in PASSING))
    times = jnp.arange(round(DURATION / EVERY) + 1) * EVERY
    every = {p.name: p.value for p in params.walk(full)}

    def read(battery, values=None):
        run = Conditions(
            RUNS.wheeled, RUNS.U, np.degrees(RUNS.slope), RUNS.payload, battery=battery, total_mass=RUNS.mass
        )
        # all of one type, so that one compiled program serves every call
        changed = params.replace(full, {k: jnp.asarray(v, float) for k, v in (every | (values or {})).items()})
        s = drive_batch(changed, run, times, 1e-9, 20000).signals
        return np.stack([s.total_current, s.speed_motor, s.speed])

    return read


def apart(a, b):
    """Largest difference in each channel of each run over the run's largest value."""
    return (np.abs(a - b).max(-1) / np.abs(a).max(-1)).max()


def test_series_generator_holds_every_effect_that_only_a_series_shows():
    assert {e.name for e in ALL if e.transient or e.memory_size is not None} <= set(PASSING)
    assert sum(not f.cls for f in laws.SERIES.values()) >= 4


@pytest.mark.slow
@pytest.mark.parametrize("battery", [0.0, 1.0])
def test_clean_histories_agree_with_drive(package, battery):
    _, y = histories.histories(RUNS, DURATION, EVERY, battery=np.full(6, battery))
    assert apart(package(battery), y) < CLEAN


@pytest.mark.slow
def test_comparison_with_drive_can_fail(package):
    _, y = histories.histories(RUNS, DURATION, EVERY, settled.CLIMBING | {"motor.inertia": 3.36e-6})
    assert apart(package(0.0), y) > 5 * ERROR


@pytest.mark.slow
@pytest.mark.parametrize("name", PASSING)
def test_effect_of_a_series_agrees_with_drive(package, name):
    form, battery = laws.SERIES[name], float(name == "battery_sag")
    size = {"cogging": 10.0, "stick_slip": 3.0, "thermal_drift": 5.0}.get(name, 1.0) * form.size
    shapes = {k: 0.5 if k == "phase" else float(np.mean(b)) for k, b in form.shapes.items()}
    _, y = histories.histories(RUNS, DURATION, EVERY, settled.CLIMBING, [(form, size, shapes)], np.full(6, battery))
    values = {f"effects.{name}.amplitude": size} | {
        f"effects.{name}.{SHAPES.get(k, k)}": v for k, v in shapes.items()
    }
    there = package(battery, values)
    assert apart(there, y) < ERROR
    assert apart(there, package(battery)) > 3e-5


@pytest.mark.slow
def test_series_passes_the_input_checks_and_is_reproducible(tmp_path):
    options = dict(seed=3, duration=0.2, free=settled.FRICTION[:2])
    table, label = histories.narrow(["rotating_inertia"], 6.0, **options)
    again, _ = histories.narrow(["rotating_inertia"], 6.0, **options)
    assert all((table[n] == again[n]).all() for n in table)
    (effect,) = label["effects"]
    assert effect["class"] == "rotating_inertia" and effect["sigmas"] == pytest.approx(6.0)
    path = tmp_path / "runs.csv"
    rows = zip(*table.values(), strict=True)
    path.write_text("\n".join([",".join(table), *(",".join(map(str, r)) for r in rows)]) + "\n")
    runs = records.read(path)
    assert len(runs) == 6 * 11 and runs.has("time_s") and "rotating" not in path.read_text()
