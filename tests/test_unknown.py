"""What a rig's file leaves open and nothing stands for: no number rests on it, and that is said."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import mmrjax as mm
from calibration.data import rig_facts, robot_file
from mmrjax.fidelities.base import History
from mmrjax.missions.profile import profile
from mmrjax.model import params
from mmrjax.model.quantities import HEAT, WARMING
from mmrjax.model.signals import Signals
from sweeps.config import Simulate
from sweeps.inputs import load_robot
from tests.commands import ends, read_rig
from tests.pages import Tables

MOTOR = "[motor]\ntorque_constant = 0.03\n{more}[gearbox]\nratio = 20\nefficiency_load = 0.8\n"
BENCH = (
    'base = "none"\nimposed = "{imposed}"\nchannels = ["output_torque"]\n'
    + MOTOR
    + """
[bench]
load = "shaft"
inertia = 0.002
loss_coulomb = 0.05
loss_viscous = 0.01
"""
)
ROVER = (
    'base = "none"\nsides = 2\nimposed = "{imposed}"\n'
    + MOTOR
    + """
[rover]
load = "vehicle"
mass = 4.0
radius = 0.04
[rover.ground]
rolling_resistance = 0.05
[rover.ground.friction]
static = 0.5
[rover.turning]
width = 0.3
inertia = 0.2
[running_gear]
wheelbase = 0.4
"""
)


def read(tmp_path, text, imposed, more=""):
    return read_rig(tmp_path, text.format(imposed=imposed, more=more))


def elsewhere(robot):
    """The same rig beside another packaged robot: three times of what is unknown of its motor and battery.

    The inductance that nobody stated follows the resistance: robot files assume the time constant of the winding.
    """
    drive = [
        p
        for p in params.walk_parameters(robot)
        if p.name in robot.rig.unknown and not p.name.startswith("running_gear.")
    ]
    values = {p.name: jnp.clip(3.0 * jnp.asarray(p.value), *p.spec.bounds) for p in drive}
    if "motor.resistance" in values:
        values["motor.inductance"] = robot.motor.inductance / robot.motor.resistance * values["motor.resistance"]
    return dataclasses.replace(params.replace(robot, values), rig=robot.rig)


DRIVEN = "resistance = 1.0\ninertia = 1e-6\n"
CASES = {
    "speed": (BENCH, "motor_speed", "", {"motor_speed": [-100.0, 300.0]}, {}),
    "current": (BENCH, "motor_current", "", {"motor_current": [-0.5, 0.5]}, {}),
    "current over time": (BENCH, "motor_current", "", {"motor_current": [-0.2]}, {"model": "drive", "history": True}),
    "speeds of a turn": (ROVER, "motor_speed", "", {"motor_speed_left": [50.0], "motor_speed_right": [90.0]}, {}),
    "mission": (ROVER, "voltage", DRIVEN, {"voltage": [12.0]}, {"profile": ([0.0, 100.0], 12.0)}),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_no_number_rests_on_what_is_unknown(tmp_path, case):
    """Results, statuses, flags and histories, of every kind of run that a rig has."""
    text, imposed, more, conditions, options = CASES[case]
    robot = read(tmp_path, text, imposed, more)
    if "profile" in options:
        times, demand = options["profile"]
        options = {"model": "drive", "profile": profile(times, demand=demand)}
    runs = [mm.simulate(r, mm.Conditions(**conditions), **options) for r in (robot, elsewhere(robot))]
    for one, other in zip(*(jax.tree.leaves((r.result, r.history, r.mission)) for r in runs), strict=True):
        assert_allclose(one, other, rtol=1e-9, atol=1e-12)
    assert np.isfinite(runs[0].power_gear).all()
    if not more:
        assert np.isnan(runs[0].power_supply).all() and np.isnan(runs[0].voltage).all()
        assert np.isnan(runs[0].efficiency_motor).all() and np.isnan(runs[0].winding_settled).all()


def test_voltages_and_heat_over_time_rest_on_nothing_unknown(tmp_path):
    robot = read(tmp_path, BENCH, "motor_current")
    row = jnp.ones((1, 3))
    history = History.of(robot, row, row, Signals(**dict.fromkeys(("configuration", "current", "voltage"), row)))
    assert np.isnan(history.signals.voltage).all() and np.isnan(history.reading["motor_voltage"]).all()
    assert (history.reading["motor_current"] == 1.0).all()
    assert robot.heating(5.0, 30.0, 25.0) == (0.0, 0.0) and np.isinf(robot.current_continuous)
    heated = params.replace(robot, dict.fromkeys(WARMING, 1.0))
    assert heated.heating(5.0, 30.0, 25.0)[0] == heated.motor.heating(5.0, 30.0, 25.0)[0] == 0.0
    assert heated.heating(5.0, 30.0, 25.0)[1] == 5.0 and np.isfinite(heated.current_continuous)


def test_what_is_stated_is_known_with_the_packaged_robots_number_too(tmp_path):
    stated = "resistance = 0.611\nresistance_thermal_winding = 1.7\nresistance_thermal_housing = 6.0\n"
    robot = read(tmp_path, BENCH, "motor_speed", stated)
    assert robot.knows(HEAT) and not read(tmp_path, BENCH, "motor_speed").knows(HEAT)
    robot_file.write_robot(robot, tmp_path / "again.toml")
    assert robot_file.read_robot(tmp_path / "again.toml").rig.unknown == robot.rig.unknown
    seen = mm.simulate(robot, mm.Conditions(motor_speed=300.0))
    assert seen.power_supply > seen.power_motor and seen.winding_settled > 25.0


def test_rig_check_says_what_of_a_battery_is_an_examples(tmp_path):
    def left_open(more):
        read(tmp_path, ROVER + more, "voltage", DRIVEN)
        found = rig_facts.number_origins(robot_file.parse_robot_file(tmp_path / "rig.toml"))
        return {
            o.name.partition(".")[2] for o in found if o.name.startswith("battery.") and "an example value" in o.why
        }

    assert left_open("") == set()
    stated = "[battery]\ncells = 3\nvoltage_full = 4.1\nresistance = 0.02\n"
    assert left_open(stated) == {"curvature", "slope", "capacity"}


@pytest.mark.parametrize("kept, said", [(ROVER, False), (ROVER.partition("[running_gear]")[0], True)])
def test_a_fidelity_that_resolves_the_running_gear_says_where_it_is_an_examples(tmp_path, capsys, kept, said):
    read(tmp_path, kept.partition("[rover.turning]")[0] + kept.partition("inertia = 0.2\n")[2], "voltage", DRIVEN)
    for model in ("steady", "track"):
        load_robot(Simulate(robot=str(tmp_path / "rig.toml"), set={"rover.inertia": 0.001}, model=model))
        assert ("masses are examples" in capsys.readouterr().err) == (said and model == "track")


def test_a_parameter_that_is_set_is_known(tmp_path):
    robot = read(tmp_path, BENCH, "motor_speed")
    assert robot.unknown(HEAT) == (HEAT[0], *HEAT[2:])
    assert params.replace(robot, {"motor.resistance": 2.0}).unknown(HEAT) == HEAT[2:]


@pytest.mark.slow
def test_commands_leave_out_what_is_unknown_and_say_so(mmrjax, tmp_path):
    read(tmp_path, BENCH, "motor_speed")
    _, out, _ = ends(mmrjax("simulate --robot rig.toml --motor-speed 3000 --out run"), code=0)
    (head, _) = (tmp_path / "run/runs.csv").read_text(encoding="utf-8").splitlines()
    columns = {"voltage_V", "power_supply_W", "efficiency_motor", "winding_settled_C", "permissible_time_s"}
    assert columns.isdisjoint(head.split(",")) and "power_motor_W" in head
    note = "cannot be computed: the robot's file does not give motor.resistance, "
    assert note in " ".join(out.split()) and note in Tables((tmp_path / "run/report.html").read_text("utf-8")).text
