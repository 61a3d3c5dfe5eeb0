"""Backlash, play and soft couplings are noticed in a log by the angle that each reversal loses."""

from types import SimpleNamespace

import numpy as np
import pytest
from worlds.events import Bench

from calibration.described import describe
from calibration.discovery import discover, verdict
from calibration.discovery.loop_input import LoopInput, prepare_loop
from calibration.discovery.stages import findings, outliers, search_until_clean
from calibration.inference.lost_motion import lost_motion_notes
from mmrjax.model import params
from mmrjax.model.quantities import RPM
from sweeps.commands import loop as command
from sweeps.commands.rig_check import check_rig_file
from tests.commands import csv_text, read_rig, read_table

RIG = """base = "none"
channels = [{channels}]
start = "rest"
[motor]
resistance = "3.1 ± 10 %"
torque_constant = "0.0072 ± 10 %"
friction_coulomb = "4e-4 ± 50 %"
inertia = "3e-7 ± 30 %"
[gearbox]
ratio = 210.0
efficiency_load = "0.75 ± 10 %"
[wheel]
load = "shaft"
inertia = "6e-4 ± 20 %"
loss_coulomb = "0.02 ± 50 %"
{backlash}
"""
STEP, RATIO = 2e-3, 210.0


def wanted(time):
    """Goal of the output [deg]."""
    return 25 * np.sin(2 * np.pi * 0.23 * time) + 14 * np.sin(2 * np.pi * 0.71 * time)


def encoded(angle):
    """Reading of an encoder in steps of 0.088 deg [deg]."""
    return 0.088 * round(np.degrees(angle) / 0.088)


def servo(play=0.0, friction=0.17, delay=0, seconds=16.0):
    """Log of a servo: a motor with a lag of 20 ms and dry friction, worth so many volts, a play [deg] behind it.

    Returns:
        Time [s], duty, motor speed [rad/s] and angle of the output [deg] in steps of 0.088, at 100 Hz.
    """
    count, every = round(seconds / STEP), round(0.01 / STEP)
    speed = turned = output = 0.0
    rows, duties = [], [0.0] * (delay + 1)
    for k in range(count):
        if k % every == 0:
            shown = encoded(output)
            duties.append(round(float(np.clip(6 * np.radians(wanted(k * STEP) - shown), -1, 1)), 3))
            rows.append((k * STEP, duties[-1], speed, shown))
        volts = 12 * duties[-1 - delay]
        push = volts - 0.0072 * speed
        free = push - friction * np.sign(speed) if speed else np.sign(push) * max(abs(push) - friction, 0.0)
        after = speed + STEP * free / 0.0072 / 0.02
        speed = 0.0 if speed * after < 0 else after
        turned += STEP * speed / RATIO
        half = np.radians(play) / 2
        output = float(np.clip(output, turned - half, turned + half))
    return np.array(rows).T


def read(tmp_path, log, channels='"output_angle"', backlash=""):
    columns = dict(zip(("time_s", "duty", "motor_speed_rpm", "output_angle_deg"), log, strict=True))
    columns = {name: np.round(x, 3) for name, x in columns.items()} | {"supply_voltage_V": np.full(len(log[0]), 12)}
    columns["motor_speed_rpm"] = np.round(log[2] / RPM, 1)
    if "motor_speed" not in channels:
        del columns["motor_speed_rpm"]
    robot = read_rig(tmp_path, RIG.format(channels=channels, backlash=backlash))
    return read_table(tmp_path, csv_text(columns), robot), robot


@pytest.mark.parametrize(
    "channels, off", [('"output_angle"', 0.3), ('"output_angle", "motor_speed"', 0.05)], ids=["output", "both"]
)
def test_play_is_found_and_measured(tmp_path, channels, off):
    runs, robot = read(tmp_path, servo(play=1.0), channels)
    (note,) = lost_motion_notes(runs, robot)
    assert note.width == pytest.approx(1.0, rel=off) and note.angle == pytest.approx(np.radians(note.width))
    assert note.reversals >= 10 and note.column == "output_angle_deg"


@pytest.mark.parametrize("stiffness", [5.0, 8.0])
def test_an_elastic_joint_is_found_with_its_stiffness(tmp_path, stiffness):
    """The joint of tests/worlds by explicit steps, its load of 6e-3 kg·m², under a controller of the angle."""
    bench = Bench(
        resistance=3.1, inductance=2e-3, torque_constant=0.0072, inertia_motor=3e-7, friction_motor=1e-4, ratio=RATIO,
        efficiency=1.0, inertia=6e-3, loss_coulomb=0.05, loss_viscous=0.0, stiffness=stiffness, damper=0.02,
    )  # fmt: skip
    step, state, output, log = 2.5e-4, np.zeros(4), 0.0, []
    for k in range(round(12 / step)):
        if k % round(0.01 / step) == 0:
            shown = encoded(output)
            duty = np.clip(4 * np.radians(wanted(k * step) - shown) - 0.05 * state[1] / RATIO, -1, 1)
            log.append((k * step, round(duty, 3), state[1], shown))
        state = state + step * np.array(bench.rates_loose(state, 12 * duty))
        output += step * state[2]
    runs, robot = read(tmp_path, np.array(log).T, '"output_angle", "motor_speed"')
    robot = params.replace(robot, {"wheel.inertia": bench.inertia})
    (note,) = lost_motion_notes(runs, robot)
    assert note.values["stiffness"] == pytest.approx(stiffness, rel=0.3)
    assert "compliant coupling" in describe(note) and 'stiffness = "' in describe(note)


@pytest.mark.parametrize("log", [{}, {"friction": 0.5}, {"delay": 1}], ids=["plain", "friction", "delay"])
def test_friction_and_delay_are_no_play(tmp_path, log):
    for channels in ('"output_angle"', '"output_angle", "motor_speed"'):
        assert lost_motion_notes(*read(tmp_path, servo(**log), channels)) == []


def test_stated_backlash_needs_no_note(tmp_path):
    assert lost_motion_notes(*read(tmp_path, servo(play=1.0, seconds=8.0), backlash='backlash = "0.01 ± 30 %"')) == []


def test_check_of_a_log_reports_lost_motion(tmp_path, capsys):
    read(tmp_path, servo(play=1.0))
    assert check_rig_file(tmp_path / "rig.toml", str(tmp_path / "log.csv"), (), False) == 0
    assert "reversals about" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("lost", [True, False])
def test_no_effect_stands_in_for_a_missing_backlash(lost, monkeypatch):
    """The search took minutes, and its answer was a driver's characteristic."""
    rejected = SimpleNamespace(test=SimpleNamespace(rejected=True))
    steps, base = [], SimpleNamespace(cluster=None, base=SimpleNamespace(space=None))

    def keep(name, make):
        steps.append(name)
        return (base, rejected) if name == "bootstrap 0" else (base, rejected, SimpleNamespace(diagnosis=None))

    task = SimpleNamespace(
        settings=SimpleNamespace(replicates=1), keep=keep, ranked=[], progress=lambda step: None,
        shows_unmodelled_backlash=lost,
    )  # fmt: skip
    monkeypatch.setattr(findings, "rank_library", lambda *_: None)
    searched = search_until_clean(task, base, None)[2]
    assert (searched is None) == lost
    assert steps == ["bootstrap 0"] + ["ranking", "search 0"] * (not lost)


def test_the_last_search_belongs_to_the_rows_that_are_returned(monkeypatch):
    """A row excluded after the last search was missing from the fit, but not from its search."""
    unexplained = SimpleNamespace(scores=None, test=SimpleNamespace(rejected=True, rejected_with_margin=True))

    def keep(name, make):
        (screened,) = make.args[:1]
        results = SimpleNamespace(diagnosis=unexplained, screened=screened)
        return (screened, unexplained) if name.startswith("bootstrap") else (screened, unexplained, results)

    monkeypatch.setattr(outliers, "screen_with_effects", lambda *_: SimpleNamespace(cluster=None))
    task = SimpleNamespace(
        settings=SimpleNamespace(replicates=1), keep=keep, ranked=[1], progress=lambda step: None,
        shows_unmodelled_backlash=False, runs=None,
    )  # fmt: skip
    screened, _, searched = search_until_clean(task, SimpleNamespace(cluster=None), None)
    assert searched.screened is screened


@pytest.mark.parametrize("rejected", [True, False])
def test_a_rigid_base_that_leaves_only_noise_refutes_the_lost_motion(rejected, monkeypatch, tmp_path):
    """A clean servo, with its angle alone, had lost 62 deg at each reversal. Its base fit left 0.3 %, the noise."""
    runs, robot = read(tmp_path, servo(play=1.0))
    diagnosis, base = (
        SimpleNamespace(test=SimpleNamespace(rejected=rejected), linear=None),
        SimpleNamespace(space=None),
    )
    monkeypatch.setattr(verdict, "missed_channels", lambda *_: ())
    steps = {stage.name: stage for stage in discover.STAGES}
    search = steps["search"]._replace(function=lambda given, screened, sds: (screened, diagnosis, None))
    steps |= {"search": search, "windows": steps["windows"]._replace(function=lambda given: None)}
    monkeypatch.setattr(discover, "STAGES", tuple(steps.values())[1:])
    notes = tuple(lost_motion_notes(runs, robot))
    given = LoopInput(runs, None, robot, *[None] * 4, at_first=notes, keep=lambda name, make: (
        SimpleNamespace(base=base), SimpleNamespace(noise=None)))  # fmt: skip
    assert discover.trace_verdict(given).verdict == ("undescribed" if rejected else "none")


def test_a_loop_that_runs_out_of_time_answers_with_the_lost_motion(tmp_path, mmrjax, monkeypatch):
    read(tmp_path, servo(play=1.0))

    def out_of_time(*_, keep, **__):
        keep("base", lambda: SimpleNamespace())
        raise command.OutOfTime

    monkeypatch.setattr(command, "discover", out_of_time)
    monkeypatch.setattr(command, "_report_stored_stages", lambda *_: None)
    code, _, err = mmrjax("loop log.csv", "--robot", "rig.toml", "--no-report", "--out", "found", "--within", "20s")
    assert code == 3 and "reversals about" in " ".join(err.partition("no verdict within 20 s")[2].split())


def test_task_of_the_loop_knows_of_lost_motion(tmp_path):
    for play in (1.0, 0.0):
        runs, robot = read(tmp_path, servo(play=play))
        given = prepare_loop(runs, robot, noise="output_angle=0.1deg")
        assert given.shows_unmodelled_backlash == (play > 0)
