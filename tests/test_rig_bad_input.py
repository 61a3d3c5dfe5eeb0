"""What a new user gets wrong of a rig: one sentence each, with where, what came, what is allowed."""

import numpy as np
import pytest

from calibration.data import runs as records
from calibration.inference import bases, observers
from sweeps.commands import rig_check
from tests.commands import read_rig, text_file

BRAKE = """
base = "none"
imposed = "motor_speed"
channels = ["total_current"]
[motor]
torque_constant = "0.041 ± 3 %"
friction_coulomb = 0.002
[gearbox]
ratio = 29
efficiency_load = "0.72 ± 6 %"
[brake]
load = "shaft"
inertia = 0.004
loss_coulomb = "0.3 ± 40 %"
"""
WINCH = BRAKE + "torque_constant = 0.2\n"


def rig_of(tmp_path, text):
    return read_rig(tmp_path, text)


def table(tmp_path, *rows, header="motor_speed_rpm,total_current_A"):
    path = tmp_path / "t.csv"
    path.write_text("\n".join((header, *rows)) + "\n", encoding="utf-8")
    return path


def test_noise_about_zero_and_a_weight_are_no_wrong_signs(tmp_path):
    robot = rig_of(tmp_path, BRAKE)
    rows = ("900,-0.01,0.004", "1800,0.6,0.004", "-900,0.01,0.004")
    header = "motor_speed_rpm,total_current_A,total_current_sd_A"
    assert len(records.read_runs(table(tmp_path, *rows, header=header), robot=robot)) == 3
    robot = rig_of(tmp_path, WINCH)
    assert len(records.read_runs(table(tmp_path, "900,-0.6", "1800,0.7"), robot=robot)) == 2


@pytest.mark.slow
def test_rig_check_does_not_call_runs_backward_unsettled(tmp_path, capsys):
    rig_of(tmp_path, BRAKE)
    data = table(tmp_path, "900,0.62", "-900,-0.61", "2000,0.64", "-2000,-0.65")
    assert rig_check.check_rig_file(tmp_path / "rig.toml", str(data), (), False) == 0
    out = capsys.readouterr().out
    assert "motor_speed_rpm" in out and "settles" not in out
    assert not any(word in out for word in ("slope_deg", "payload_kg", "supply_voltage_V"))


def test_rig_check_says_what_a_file_without_base_takes(tmp_path, capsys):
    assert (
        rig_check.check_rig_file(text_file(tmp_path / "rig.toml", "[motor]\nresistance = 0.6\n"), None, (), False)
        == 0
    )
    assert "come from the base, a packaged robot. base = " in " ".join(capsys.readouterr().out.split())


@pytest.mark.slow
def test_histories_of_a_shaft_have_bases_of_what_may_be_missing(tmp_path):
    """None of them a wave of a belt's: a shaft runs on no tracks."""
    text = BRAKE.replace('imposed = "motor_speed"', "").replace(
        "[motor]", "[motor]\nresistance = 3.0\ninertia = 1e-6"
    )
    robot = rig_of(tmp_path, text)
    times = np.linspace(0.0, 0.5, 12)
    rows = [f"a,{t:.3f},12,{0.9 - 0.5 * t:.3f}" for t in times]
    data = table(tmp_path, *rows, header="run_id,time_s,supply_voltage_V,total_current_A")
    runs = records.read_runs(data, robot=robot)
    observer = observers.Histories.of(runs, robot)
    seen = {
        "supply_voltage_V": np.full(12, 12.0),
        "motor_speed_rpm": np.linspace(0, 2000, 12),
        "total_current_A": np.linspace(0.9, 0.65, 12),
        "slope_deg": np.zeros(12),
        "total_mass_kg": np.zeros(12),
        "speed_mm_s": np.zeros(12),
        "time_s": times,
        "configuration": np.full(12, "brake"),
        "run_id": np.full(12, "a"),
        "payload_kg": np.zeros(12),
    }
    found = observer.bases(seen, np.ones(12, bool), robot)
    assert not any("belt" in str(name) for name in bases.family_names(found))
