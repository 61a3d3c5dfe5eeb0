"""What the loop and `calibrate` write, simulated under the conditions of their table, is what they fitted."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from synthetic import SETTLED, STATED

from calibration.data import inferred_facts, robot_file
from calibration.data import runs as records
from calibration.discovery import findings, loop_input
from calibration.discovery.candidates import Candidate, fill_slots
from calibration.inference.calibration import calibrate
from calibration.inference.linearization import free_shape_parameter, shape_parameter_at, shape_scales
from calibration.inference.observers import SettledRuns
from calibration.inference.optimizers import observe_robot
from mmrjax.effects import ALL, BY_NAME
from mmrjax.fidelities.steady import steady_batch
from mmrjax.model import channels, paper_robots, params
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


@eqx.filter_jit
def _swept(robot, conditions):
    result = steady_batch(robot, conditions)
    return jnp.stack([result.reading[c] for c in channels.USUAL], -1), result.status


class Written:
    """Robots through robot.toml, then simulated with their own mass: one program for all effects of a set."""

    def __init__(self, runs, path, effects):
        self.path, self.effects = path / "robot.toml", tuple(e() for e in effects)
        self.runs = unweighed(runs)

    def __call__(self, robot):
        robot_file.write_robot(robot, self.path)
        back = robot_file.read_robot(self.path)
        have = {e.name: e for e in back.effects}
        assert set(have) == {e.name for e in robot.effects}
        whole = dataclasses.replace(back, effects=tuple(have.get(e.name, e) for e in self.effects))
        return jax.device_get(_swept(params.without_weak_types(whole), self.runs.conditions(back)))


# --- every effect ---------------------------------------------------------------------------------------

#: Effects that settled runs forward on an external supply show; a robot may have the others all the same.
SEEN = tuple(e.name for e in ALL if SettledRuns.shows(e) and not e.needs_reverse and not e.needs_duty)
UNSEEN = tuple(e.name for e in ALL if e.name not in SEEN)


@pytest.fixture(scope="module")
def fits(tmp_path_factory):
    """The loop's fits to a table, by effect, and the robot of each through its file."""
    runs = table()
    stated = {n: (m, 0.2) for n, (m, _) in STATED.items()}
    robot = robot_file.add_effects(paper_robots.nominal(), UNSEEN)
    robot = params.replace(robot, {f"effects.{n}.amplitude": 0.3 * _sd(BY_NAME[n]) for n in UNSEEN})
    sd = 0.02 * np.abs(runs.measured())
    space = loop_input.build_candidate_space(runs, robot, sd, SETTLED.settings, stated, BY_NAME)
    z = np.zeros(len(space.coordinates))
    z[: space.free] = np.random.default_rng(3).normal(0.0, 0.5, space.free)
    # The exponent of sinkage is then beyond its bounds, which a file could not state.
    z[space.free], z[space.free + SETTLED.settings.slots] = 0.3 / SETTLED.settings.width, 3.0
    written = Written(runs, tmp_path_factory.mktemp("written"), ALL)

    def of(name):
        active = fill_slots([name] if name else [], SETTLED.settings)
        problem = space.problem(active)
        seen = jax.device_get(observe_robot(problem, problem.robot(jnp.asarray(z))))
        candidate = Candidate(active, z, z, 0.0, z, z, True, True, True)
        again, status = written(findings.proposed_robot(space, candidate))
        return seen.reading[: len(runs)], seen.status[: len(runs)], again, status

    return of


def _sd(effect):
    return next(p for p in params.walk_parameters(effect()) if p.spec.amplitude).spec.prior_sd(0.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ("", *SEEN))
def test_robot_that_the_loop_writes_is_the_one_that_it_fitted(name, fits):
    reading, status, again, status_again = fits(name)
    assert_array_equal(status_again, status)
    assert np.isfinite(reading).all()
    assert_allclose(again, reading, rtol=1e-9)


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


@pytest.mark.slow
def test_comparison_can_fail(tmp_path):
    """What was wrong: the mass of the table was fitted with, the robot's own was written."""
    runs, robot = table(), paper_robots.nominal()
    written = Written(runs, tmp_path, ())
    conditions = runs.conditions(robot)
    before, _ = jax.device_get(_swept(params.without_weak_types(robot), conditions))
    assert np.abs(written(robot)[0] / before - 1).max() > 0.02
    assert_allclose(written(inferred_facts.with_table_mass(robot, runs))[0], before, rtol=1e-9)


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


def test_a_total_without_its_payload_is_suspected(robot):
    runs = table()
    runs.columns["total_mass_kg"][:] = 13.1
    said = inferred_facts.mass_notes(robot, runs)
    assert len(said) == 2 and all(s.endswith("; does total_mass_kg exclude the payload?") for s in said)


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
