"""An elastic joint between motor and load: its frequency, its motion beside SciPy's, and a log that has one."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose
from scipy import signal
from scipy.integrate import solve_ivp
from test_events import NAMES, SAMPLES
from worlds.events import Bench, through

from calibration.data.runs import read_runs
from calibration.discovery import discover, loop_input
from calibration.inference.calibration import calibrate
from mmrjax.effects import BY_NAME
from mmrjax.fidelities.drive import drive_batch, drive_rates, drive_start, drive_units
from mmrjax.fidelities.steady import steady_batch
from mmrjax.model import paper_robots, params
from mmrjax.model.conditions import Conditions
from mmrjax.model.quantities import RPM
from mmrjax.model.rig import Rig
from mmrjax.model.robot import Configurations
from mmrjax.model.shaft import Shaft
from sweeps.pages.history_figures import frequency_response
from tests.commands import read_rig

#: A motor that turns against the joint, with little back-EMF.
MOTOR = Bench(inertia_motor=2e-5, torque_constant=0.02, loss_coulomb=0.02, friction_motor=2e-4)
#: Joints of 15 and 40 Hz, one of them with play.
JOINTS = {
    "soft": replace(MOTOR, stiffness=36.0, damper=0.02),
    "hard": replace(MOTOR, stiffness=260.0, damper=0.05),
    "with play": replace(MOTOR, stiffness=260.0, damper=0.05, backlash=0.03),
}


def robot_of(bench, **more):
    shaft = Shaft(inertia=1.0, loss_coulomb=1.0)
    robot = paper_robots.blank_robot(Configurations({"bench": shaft}), rig=Rig(loose=True))
    joint = {"bench.stiffness": bench.stiffness, "bench.damping": bench.damper}
    return params.replace(robot, {p: getattr(bench, f) for f, p in NAMES.items()} | joint | more)


@pytest.mark.parametrize("name", ["soft", "hard"])
def test_frequency_and_damping_are_those_of_two_inertias(name):
    """Eigenvalues of the rates about forward travel, without friction, beside those of the linear equations."""
    bench = replace(JOINTS[name], friction_motor=0.0, loss_coulomb=0.0, efficiency=1.0)
    robot, at = robot_of(bench), Conditions(voltage=6.0)
    size = np.asarray(drive_units(robot))
    y = jnp.asarray(np.array([0.5, 100.0, 100.0 / bench.ratio, 0.0, 0.0, 0.02]) / size)
    matrix = np.asarray(jax.jacfwd(lambda y: drive_rates(robot, at, y))(y)) * size[:, None] / size
    own = np.stack([bench.rates_loose(state, 0.0) for state in np.eye(4)], -1)
    of = [0, 1, 2, 5]  # current, speeds of motor and load, angle between them
    found, expected = (np.sort_complex(np.linalg.eigvals(m)) for m in (matrix[np.ix_(of, of)], own))
    assert_allclose(found, expected, rtol=1e-9)
    assert abs(expected.imag).max() > 2 * np.pi * 10


@pytest.mark.parametrize("name", list(JOINTS))
def test_a_start_against_the_joint_is_that_of_scipy(name):
    bench = JOINTS[name]
    exact, _ = through(bench, np.array([6.0]), np.array([0.0]), SAMPLES)
    run = drive_batch(
        robot_of(bench), Conditions(voltage=[6.0]), jnp.asarray(SAMPLES), tolerance=1e-9, max_steps=40000
    )
    shown = np.stack([run.signals.current[0], run.signals.speed_motor[0]], -1)
    assert_allclose(shown / np.abs(exact).max(0), exact / np.abs(exact).max(0), atol=1e-6)


def test_settled_travel_knows_no_joint_and_a_hanging_load_begins_twisted():
    bench = replace(JOINTS["soft"], backlash=0.0)
    runs = Conditions(voltage=np.array([6.0, -6.0]))
    turned, rigid = (
        steady_batch(robot_of(bench), runs),
        steady_batch(robot_of(replace(bench, stiffness=0.0)), runs),
    )
    assert_allclose(turned.reading["motor_speed"], rigid.reading["motor_speed"], rtol=1e-12)
    start = drive_start(robot_of(bench, **{"bench.torque_constant": 0.6}), Conditions(voltage=0.0))
    assert float(start[-1]) * drive_units(robot_of(bench))[-1] == pytest.approx(0.6 / 36.0)


@pytest.fixture(scope="module")
def log():
    """A log of SciPy's joint of 8.6 Hz, with current and speed of the load at 100 Hz, and what made it."""
    bench = replace(MOTOR, friction_motor=1e-3, loss_coulomb=0.05, stiffness=12.0, damper=0.02)
    random, held, y, rows = default_rng(5), 0.15, np.zeros(4), []
    for k, volts in enumerate(random.choice([-6.0, -4.0, -2.0, 2.0, 4.0, 6.0], size=40)):
        times = np.arange(16) * held / 15
        run = solve_ivp(
            lambda _, y, volts=volts: bench.rates_loose(y, volts),
            (0.0, held),
            y,
            "LSODA",
            times,
            rtol=1e-9,
            atol=1e-10,
        )
        y = run.y[:, -1]
        rows.append([times[:-1] + k * held, np.full(15, volts), run.y[0, :-1], run.y[2, :-1]])
    time, volts, current, speed = np.concatenate(rows, 1)
    noise = random.standard_normal((len(time), 2)).T * [[0.01], [0.02]]
    return bench, {
        "time_s": time, "supply_voltage_V": volts, "total_current_A": current + noise[0],
        "total_current_sd_A": np.full(len(time), 0.01), "output_speed_rpm": (speed + noise[1]) / RPM,
        "output_speed_sd_rpm": np.full(len(time), 0.02 / RPM),
    }  # fmt: skip


RIG = """
schema = "mmrjax.robot/2"
base = "none"
imposed = "voltage"
channels = ["total_current", "output_speed"]
[motor]
resistance = "3.0 ± 0.3"
torque_constant = "0.02 ± 0.002"
inertia = "1.5e-5 ± 1e-5"
inductance = 1e-3
friction_coulomb = "2e-3 ± 2e-3"
[gearbox]
ratio = 16
efficiency_load = 0.8
[bench]
load = "shaft"
inertia = "0.03 ± 0.02"
loss_coulomb = "0.1 ± 0.1"
loss_viscous = "0.02 ± 0.02"
"""


@pytest.mark.slow
@pytest.mark.parametrize("joint", ["", 'stiffness = "20 ± 15"\ndamping = "0.03 ± 0.03"\n'], ids=["rigid", "elastic"])
def test_a_rigid_model_takes_friction_away_and_an_elastic_one_finds_the_joint(log, tmp_path, joint):
    bench, columns = log
    robot = read_rig(tmp_path, RIG + joint)
    fit = calibrate(read_runs(columns, robot=robot), robot, model="drive", starts=1, blocks=False, profiles=False)
    friction = fit.parameters["bench.loss_coulomb"]
    if not joint:
        assert fit.adequacy.adequate is False and friction.value < 0.1 * bench.loss_coulomb
        return
    assert fit.adequacy.adequate
    for name, truth in {"bench.stiffness": bench.stiffness, "bench.damping": bench.damper}.items():
        entry = fit.parameters[name]
        assert entry.interval[0] < truth < entry.interval[1] and not entry.held_by_prior, name
    assert abs(fit.parameters["bench.stiffness"].value - bench.stiffness) < 0.02 * bench.stiffness


@pytest.mark.nightly
def test_the_loop_names_no_effect_for_a_joint_that_twists(log, tmp_path):
    """The strongest effect of the library passes every threshold (117 of 3 σ) and explains a tenth of the misfit."""
    robot = read_rig(tmp_path, RIG)
    runs = read_runs(log[1], robot=robot)
    names = ("bristle_load_loss", "stick_slip", "directional_friction", "series_resistance")
    given = loop_input.prepare_loop(runs, robot, library={n: BY_NAME[n] for n in names})
    traced = discover.trace_verdict(replace(given, settings=replace(given.settings, slots=1)))
    (test,) = traced.standing.tests
    assert test.root > 10 * test.needed and not test.established
    assert traced.verdict in ("place", "undescribed") and traced.members == ()


def test_a_frequency_response_is_that_of_the_filter_that_made_it():
    """Two runs of steps through a resonance, read at uneven times, beside the filter's own response."""
    random, runs = default_rng(2), []
    numerator, denominator = signal.zpk2tf(*signal.bilinear_zpk([], np.array([-8 + 40j, -8 - 40j]), 1600.0, 200.0))
    for rows in (4000, 2600):
        drive = np.repeat(random.choice([-1.0, 1.0, 2.0], size=rows // 20), 20)
        reading = signal.lfilter(numerator, denominator, drive)
        kept = np.sort(np.concatenate([[0], random.choice(np.arange(1, rows), size=rows - 40, replace=False)]))
        runs.append((kept / 200.0, drive[kept], reading[kept][None]))
    frequency, response, coherence = frequency_response(runs)
    exact = np.abs(signal.freqz(numerator, denominator, frequency, fs=200.0)[1])
    low = frequency < 12
    assert_allclose(np.abs(response[0])[low], exact[low], rtol=0.25)
    assert frequency[np.argmax(np.abs(response[0]))] == pytest.approx(40 / (2 * np.pi), abs=0.8)
    assert coherence[0][low].min() > 0.7
