"""What the loop and `calibrate` write, simulated under the conditions of their table, is what they fitted."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration.data import inferred_facts, robot_file
from calibration.data import runs as records
from calibration.inference.calibration import calibrate
from calibration.inference.linearization import free_shape_parameter, shape_parameter_at, shape_scales
from mmrjax.effects import ALL
from mmrjax.fidelities.steady import steady_batch
from mmrjax.model import channels
from tests.commands import refused

#: Mass without payload that the tables here state [kg]; the nominal robot has 13.1 and 11.5 kg.
MASSES = {"6T2A": 14.2, "4W2T": 13.1}


def table(masses=MASSES, surface=None):
    """Twelve runs, six of each configuration, with stated masses."""
    names = np.repeat(list(masses), 6)
    payload = np.tile([0.0, 3.0, 8.0], 4)
    columns = {
        "configuration": names,
        "supply_voltage_V": np.tile([15.0, 24.0, 33.0, 15.0], 3),
        "total_mass_kg": np.array([masses[n] for n in names]) + payload,
        "payload_kg": payload,
        "slope_deg": np.tile([0.0, 5.0, 12.0], 4)[::-1],
    } | {c.column: np.linspace(1.0, 2.0, 12) for c in channels.usual_channels()}
    return records.Runs("runs.csv", columns | ({} if surface is None else {"surface": np.full(12, surface)}))


def unweighed(runs):
    """The same conditions with the robot's own mass and the payload."""
    return dataclasses.replace(runs, columns={k: v for k, v in runs.columns.items() if k != "total_mass_kg"})


# --- every effect ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("effect", [e for e in ALL if free_shape_parameter(e()) is not None], ids=lambda e: e.name)
def test_shape_that_a_fit_reaches_is_one_that_a_file_may_state(effect):
    shape = free_shape_parameter(effect())
    z = np.linspace(-6.0, 6.0, 61)
    value = np.asarray(shape_parameter_at(shape_scales(shape), jnp.asarray(z)))
    low, high = shape.spec.bounds
    assert low <= value.min() and value.max() <= high
    if shape.name == "phase":
        assert_allclose(np.exp(1j * value), np.exp(1j * shape.spec.prior_sd(0.0) * z), atol=1e-12)
    else:
        assert np.all(np.diff(value) >= 0) and value[30] == pytest.approx(float(shape.value))


# --- what is said ---------------------------------------------------------------------------------------


NOMINAL = {"6T2A": 13.1, "4W2T": 11.5}
#: Masses and surface of a table, what is added to its total masses, what is said, and the masses that are written.
SAID = {
    "as the robot": (NOMINAL, "lacquered_wood", 0.0, (), NOMINAL),
    "another mass": (
        {"6T2A": 13.1, "4W2T": 13.1}, None, 0.0,
        ("4W2T: the table states 13.1 kg without payload, the robot's file 11.5 kg. 13.1 kg is used, and written to robot.toml",),
        {"6T2A": 13.1, "4W2T": 13.1},
    ),
    "a mass that varies": (
        {"6T2A": 14.2, "4W2T": 11.5}, None, np.append([0.0, 0.0, 0.1, 0.2, 0.3, 0.4], np.zeros(6)),
        ("6T2A: total_mass_kg minus payload_kg varies from 14.2 to 14.6 kg. robot.toml contains "
         "the median, 14.35 kg, so it does not reproduce the fit in other rows",),
        {"6T2A": 14.35, "4W2T": 11.5},
    ),
    "another surface": (
        NOMINAL, "asphalt", 0.0,
        ("the table has runs on asphalt: the written friction is for lacquered_wood. Simulate with "
         "--surface asphalt to use the fitted values",),
        NOMINAL,
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", SAID)
def test_mass_of_the_table_is_taken_and_said(robot, case):
    masses, surface, added, said, written = SAID[case]
    runs = table(masses, surface)
    runs.columns["total_mass_kg"][:] += added
    assert tuple(inferred_facts.mass_notes(robot, runs)) == said
    taken = inferred_facts.with_table_mass(robot, runs)
    assert {name: float(taken.configurations[name].mass) for name in written} == written
    # Of a sum of floats the rounding is neither written nor said, and what is taken is not taken again.
    assert "without payload" not in "".join(inferred_facts.mass_notes(taken, runs))
    bare = unweighed(runs)
    assert inferred_facts.with_table_mass(robot, bare) is robot or inferred_facts.stated_masses(robot, bare) == {}


def test_a_mass_that_no_robot_has_is_refused(robot):
    runs = table({"6T2A": 0.003, "4W2T": 13.1})
    says = r"runs\.csv row 1, total_mass_kg: got 0\.003 with a payload of 0 kg; expected 0\.01 to 10000 kg without"
    with refused(says):
        inferred_facts.with_table_mass(robot, runs)


# --- what calibration writes (what the loop writes: tests/test_prediction.py) ---------------------------


@pytest.mark.slow
def test_calibrated_robot_is_its_fit(tmp_path, robot):
    runs = records.read_runs("measured")
    found = calibrate(runs, robot, noise="current=2%,motor_speed=1%,speed=1%", starts=4, profiles=False,
                      blocks=())  # fmt: skip
    assert any(n.startswith("4W2T: the table states 13.1 kg without payload") for n in found.notes)
    found.save(tmp_path)
    again = robot_file.read_robot(tmp_path / "robot.toml")
    shown = steady_batch(again, unweighed(runs).conditions(again))
    for name, reading in found.readings.items():
        assert_allclose(shown.reading[name], reading.after, rtol=1e-8)
