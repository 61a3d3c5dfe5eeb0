"""Dissipation is judged on the balance: a negative term corrects a law that takes too much, and may not do more."""

import numpy as np
import pytest

from calibration.data import robot_file
from calibration.data.runs import Runs
from calibration.discovery import loop_input
from calibration.discovery.candidates import candidate_of_fit, supplying_effects
from calibration.discovery.settings import settings_for
from calibration.inference import observers
from calibration.inference.optimizers import Optimum
from mmrjax.effects import BY_NAME

RIG = """
base = "none"
imposed = "motor_speed"
channels = ["motor_current"]
[motor]
torque_constant = "0.05 ± 0"
friction_coulomb = "0.001 ± 50 %"
[gearbox]
ratio = 50
efficiency_load = "0.8 ± 20 %"
[down]
load = "shaft"
inertia = 0.01
loss_coulomb = "0 ± 0"
torque_constant = "-10 ± 0"
[up]
like = "down"
torque_constant = "10 ± 0"
"""


@pytest.fixture(scope="module")
def space(tmp_path_factory):
    file = tmp_path_factory.mktemp("rig") / "rig.toml"
    file.write_text(RIG, encoding="utf-8")
    robot = robot_file.read_robot(file)
    speeds = np.tile([-3000.0, -1000.0, -500.0, 500.0, 1000.0, 3000.0], 2)
    columns = {
        "configuration": np.repeat(["down", "up"], 6), "motor_speed_rpm": speeds, "motor_current_A": np.ones(12),
        "order": np.arange(1.0, 13.0),
    }  # fmt: skip
    runs = Runs("runs.csv", columns).of(robot)
    library = {n: BY_NAME[n] for n in ("backdriving_loss", "brush_drop", "stribeck_motor")}
    settings = settings_for(observers.observer_kind(runs))
    return loop_input.build_candidate_space(runs, robot, np.full((12, 1), 0.01), settings, {}, library), settings


@pytest.mark.parametrize(
    "name, amplitude, supplies",
    [
        ("backdriving_loss", -0.2, False),  # 0.8 · 1.2 of the load's torque gets to the motor
        ("backdriving_loss", -0.3, True),  # 0.8 · 1.3
        ("backdriving_loss", 0.3, False),
        ("stribeck_motor", -0.0005, False),  # of a dry friction of 1 mN·m
        ("stribeck_motor", -0.01, True),
    ],
)
def test_a_negative_effect_is_excluded_where_its_balance_supplies_power(space, name, amplitude, supplies):
    space, settings = space
    active = (name, *("",) * (settings.slots - 1))
    z = np.zeros(space.free + 2 * settings.slots)
    z[space.free] = amplitude / float(space.coordinates.sd[space.library.names.index(name)])
    sizes = np.where([bool(n) for n in active], amplitude, 0.0)
    assert supplying_effects(space, active, sizes, z) == ((name,) if supplies else ())
    found = candidate_of_fit(space, active, Optimum(z, 0.1 + 0 * z, np.eye(len(z)), 1.0, 0.0, True, 1))
    assert found.supplying == ((name,) if supplies else ()) and not (supplies and found.plausible)
