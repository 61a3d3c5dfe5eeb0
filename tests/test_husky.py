"""The Husky's table of settled turns: read, checked and calibrated as any other rig's."""

from dataclasses import replace

import numpy as np
import pytest

import mmrjax as mm
from calibration.data import configuration_tables
from calibration.data import runs as records
from calibration.inference import blocks, observers
from calibration.inference.calibration import calibrate
from calibration.inference.observers import SettledTurns
from calibration.inference.priors import loop_parameter_names
from tests.commands import ROOT

HUSKY = ROOT / "docs/rigs/husky"


@pytest.fixture(scope="module")
def robot():
    return mm.read_robot(str(HUSKY / "husky.toml"))


@pytest.fixture(scope="module")
def runs(robot):
    return records.read_runs(HUSKY / "husky.csv", robot=robot)


def test_table_is_read_as_turns_of_imposed_speeds(robot, runs):
    assert observers.observer_kind(runs) is SettledTurns and len(runs) == 120
    assert set(runs["surface"]) == {"flooring", "asphalt", "ice"}
    wheels = np.asarray(runs.conditions(robot).motor_speed_left) / 78.71 * 0.165
    assert wheels[0] == pytest.approx(0.2362, rel=1e-4)  # m/s, as its column says
    assert [i.signed for i in robot.rig.instruments] == [False, False]


def test_runs_are_what_is_held_out_first(runs):
    held = blocks.distinct_held_out_blocks(runs, SettledTurns.blocks)
    assert next(iter(held)) == "run" and len(held["run"]) == len(set(runs["run_id"])) > 10


def test_loop_frees_the_friction_that_turns_show(robot, runs):
    """Of each surface. In straight travel nothing but a speed shows it."""
    ours = configuration_tables.with_surface_configurations(robot, runs)
    present = runs.configurations_named(ours)
    freed = loop_parameter_names(ours, present, *SettledTurns.free())
    of_ground = {f"{name}.ground.friction.{number}" for name in present for number in ("static", "speed_static")}
    assert len(of_ground) == 6 and of_ground < set(freed)
    straight = replace(ours, rig=replace(ours.rig, channels=("motor_current",)))
    assert not of_ground & set(loop_parameter_names(straight, present))


@pytest.mark.nightly
def test_third_of_the_table_has_the_effective_width_of_its_wheels(robot, runs):
    """The difference of the wheels' speeds over the yaw rate is 0.75 to 0.85 m."""
    found = calibrate(runs.where(np.arange(len(runs)) % 3 == 0), robot, starts=1, blocks=())
    ratio = next(p for name, p in found.parameters.items() if name.endswith("turning.lateral"))
    width, length = 0.555, 0.512
    assert found.converged and not ratio.held_by_prior
    assert 0.73 < width + ratio.value * length**2 / width < 0.87
    after, before = found.errors_after, found.errors_before
    for side in ("left", "right"):
        assert after[f"motor_current_{side}"].rms_percent < 22 < before[f"motor_current_{side}"].rms_percent
