"""What a new user gets wrong of a rig: one sentence each, with where, what came, what is allowed."""

from calibration.data import runs as records
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


def test_rig_check_says_what_a_file_without_base_takes(tmp_path, capsys):
    assert (
        rig_check.check_rig_file(text_file(tmp_path / "rig.toml", "[motor]\nresistance = 0.6\n"), None, (), False)
        == 0
    )
    assert "come from the base, a packaged robot. base = " in " ".join(capsys.readouterr().out.split())
