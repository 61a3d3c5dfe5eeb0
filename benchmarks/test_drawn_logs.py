"""Logs that campaigns draw: stated noise of coarse displays, and sizes of effects of a servo."""

import numpy as np
import pytest
from worlds import logs
from worlds.settled import remainder

from calibration.data import robot_file
from calibration.data import runs as records
from calibration.inference import noise, observers


def test_the_file_of_a_coarse_log_states_the_noise_without_its_steps(tmp_path):
    """The loop adds them. With sds that contain them a right fit left 594 of 800."""
    rig = logs.rig(np.random.default_rng(5), "motor_current", 0.005, coarse=True)
    assert rig.steps["motor_speed"] > 2 * rig.noise("motor_speed")
    case = logs.case(rig, "", 0.0, 5)
    case.write(tmp_path)
    runs = records.read_runs(tmp_path / "table.csv", robot=robot_file.read_robot(tmp_path / "rig.toml"))
    known = noise.noise_from_table(runs, observers.observer_kind(runs).sizes(runs))
    np.testing.assert_allclose(known.sd[0] / [c.factor for c in runs.channels], [*rig.sd.values()], rtol=2e-3)


def test_an_effect_of_a_servo_is_sized_by_two_simulations(monkeypatch):
    """A search for the amplitude took a simulation for each of its steps."""
    monkeypatch.setattr(logs, "ROWS", 60)
    monkeypatch.setattr(logs, "left_over", lambda rig, shown: 9.0)
    rig, simulations = logs.rig(np.random.default_rng(7), logs.GOAL, 0.01, coarse=True), []
    simulated = logs.histories
    monkeypatch.setattr(logs, "histories", lambda *given: simulations.append(1) or simulated(*given))
    one = logs.case(rig, "angle_friction", 9.0, 4)
    assert len(simulations) == 2 and "angle_friction" in one.label["effects"][0]["class_oracle"]
    _, base, (change,) = logs.slopes(rig, rig.p, (), [one.terms])
    left = remainder(change.ravel(), np.stack([b.ravel() for b in base], 1))
    assert np.linalg.norm(left) == pytest.approx(9.0, rel=0.03)
