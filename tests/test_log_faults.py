"""Logs with faults that no reader sees: one sentence each. Sound logs have none."""

from __future__ import annotations

import numpy as np
import pytest
from test_weak_form import RIG, motor

from calibration.data import rig_facts, robot_file
from calibration.data.runs import Runs
from calibration.described import describe
from calibration.inference.conduct import error_after_steps


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    file = tmp_path_factory.mktemp("motor") / "rig.toml"
    file.write_text(RIG, encoding="utf-8")
    return robot_file.read_robot(file)


def still(speed):
    return np.zeros_like(speed)


def held(speed):
    of_runs = speed.reshape(4, 150).copy()
    of_runs[:, 80:] = of_runs[:, 80:81]
    return of_runs.ravel()


def swapped(speed):
    return np.where(np.arange(len(speed)) % 150 > 75, -speed, speed)


@pytest.mark.parametrize("fault, sentence", [
    (still, rig_facts.still_sentence), (held, rig_facts.held_sentence), (swapped, rig_facts.swapped_sentence),
])  # fmt: skip
def test_a_fault_of_a_log_is_reported_and_only_that(robot, fault, sentence):
    columns = motor()
    sound = Runs("log.csv", columns).of(robot)
    every = rig_facts.still_sentence, rig_facts.held_sentence, rig_facts.swapped_sentence
    assert not any(of_fault(sound) for of_fault in every)
    faulty = Runs("log.csv", {**columns, "motor_speed_rpm": fault(columns["motor_speed_rpm"])}).of(robot)
    assert [of_fault for of_fault in every if of_fault(faulty)] == [sentence]
    text = sentence(faulty)
    assert "motor_speed_rpm" in text and len(text) <= 400
    if fault is swapped:
        assert "row 377," in text  # of the first run with so much of both signs


@pytest.mark.parametrize("late", [0, 1])
def test_an_error_in_the_first_sample_after_each_step_is_named_with_its_share(robot, late):
    """Current was missed by 48.6 %, of which 24 of 6 000 readings, each the first after a step, made 93 %."""
    runs = Runs("log.csv", motor()).of(robot)
    volts = runs["supply_voltage_V"]
    steps = np.flatnonzero(np.abs(np.diff(volts)) > 0.1 * np.abs(volts).max()) + 1
    steps = steps[steps % 150 != 0]  # within a run
    off = 0.02 * np.random.default_rng(0).standard_normal((len(runs), 2))
    assert error_after_steps(runs, off) == []
    off[steps + late, 1] = 5.0
    (note,) = error_after_steps(runs, off)
    share = np.sum(off[steps + late, 1] ** 2) / np.sum(off[:, 1] ** 2)
    assert (note.channel, note.rows, note.share) == (runs.channels[1].name, len(steps), pytest.approx(share))
    text = describe(note)
    assert f"{share:.0%} of the squared error" in text and "may be negative" in text and len(text) <= 400
    off[:, 1] = 5.0
    assert error_after_steps(runs, off) == []  # an error everywhere
