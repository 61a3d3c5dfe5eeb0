"""Motors from the six numbers of a data sheet: constants, contradictions, and what is refused."""

import itertools
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from calibration.data import robot_file
from sweeps.commands import rig_numbers
from sweeps.commands.rig_new import write_new_rig
from tests.commands import ends, read_json

#: maxon RE30 310007, as printed.
RE30 = {
    "voltage": "24 V", "no-load-speed": "8810 rpm", "no-load-current": "164 mA", "stall-torque": "1020 mNm",
    "stall-current": "39.3 A", "resistance": "0.611 Ω",
}  # fmt: skip
#: A motor of 2 Ω, 0.05 N·m/A and 0.6 A at no load, to the last digit.
EXACT = {
    "voltage": "12V", "no-load-speed": "216 rad/s", "no-load-current": "600mA", "stall-torque": "27 Ncm",
    "stall-current": "6A", "resistance": "2ohm",
}  # fmt: skip
SUBSETS = [n for size in (4, 5, 6) for n in itertools.combinations(EXACT, size) if "no-load-current" in n]
SILENT = ("voltage", "no-load-current", "stall-current", "resistance")


@pytest.mark.parametrize("names", [n for n in SUBSETS if n != SILENT], ids="+".join)
def test_each_sheet_that_determines_the_motor_gives_its_constants(names):
    found = rig_numbers.read_data_sheet({name: EXACT[name] for name in names})
    values = {name.removeprefix("motor."): number.value for name, number in found.items()}
    assert values == {
        "resistance": pytest.approx(2), "torque_constant": pytest.approx(0.05),
        "friction_coulomb": pytest.approx(0.03), "friction_viscous": 0,
    }  # fmt: skip


def test_viscous_friction_that_a_sheet_leaves_open_is_free(tmp_path):
    """Half of the no-load torque may be viscous: 0.5 k I0 / ω0."""
    sheet = rig_numbers.read_data_sheet(EXACT)["motor.friction_viscous"]
    assert float(sheet.width) == pytest.approx(0.5 * 0.03 / 216, rel=0.01)
    write_new_rig(tmp_path / "rig.toml", None, False, sheet=EXACT)
    robot = robot_file.read_robot(tmp_path / "rig.toml")
    priors = {name: sd for name, _, sd in robot.rig.priors}
    assert priors["motor.friction_viscous"] == pytest.approx(0.5 * 0.03 / 216, rel=0.01)
    assert "motor.friction_viscous" not in robot.rig.exact


def test_printed_sheet_gives_the_makers_torque_constant():
    found = rig_numbers.read_data_sheet(RE30)
    assert found["motor.torque_constant"].value == pytest.approx(25.9e-3, rel=1e-3)
    assert found["motor.torque_constant"].source == "data sheet, voltage / no-load speed"


@pytest.mark.parametrize(
    "text, torque", [("1 Nm", 1.0), ("10 kg.cm", 0.980665), ("100 oz-in", 0.70615518), ("100N·cm", 1.0)]
)
def test_torques_are_read_in_the_units_of_makers(text, torque):
    sheet = {"voltage": "12V", "no-load-current": "1A", "resistance": "1 ohm", "stall-torque": text}
    assert rig_numbers.read_data_sheet(sheet)["motor.torque_constant"].value == pytest.approx(torque / 11, rel=1e-3)


def test_numbers_that_differ_widen_the_constant():
    found = rig_numbers.read_data_sheet(RE30 | {"stall-torque": "1090 mNm"})
    assert float(found["motor.torque_constant"].width.split()[0]) == pytest.approx(7.5, abs=0.3)
    assert rig_numbers.read_data_sheet(RE30)["motor.torque_constant"].width == "3 %"


def test_rig_new_lists_what_robot_and_sheet_do_not_state(mmrjax, tmp_path):
    robot = str(Path(__file__).parent / "data/diffbot.urdf")
    sheet = [word for name, text in RE30.items() for word in (f"--{name}", text)]
    code, out, err = mmrjax("rig new r.toml --from", robot, "--joint", "left_wheel_joint", *sheet)
    said = " ".join(out.split())
    assert (code, err) == (0, "")
    assert "not found, so fill in: motor.inertia [kg·m^2], gearbox.efficiency_load [-], rover." in said
    text = (tmp_path / "r.toml").read_text()
    assert text.startswith("# kind wheeled, filled from joint left_wheel_joint of diffbot.urdf and a data sheet.")
    found = robot_file.read_robot(tmp_path / "r.toml")
    assert (float(found.motor.resistance), float(found.gearbox.ratio)) == (0.611, 34.0)


@pytest.mark.slow
def test_viscous_friction_of_a_motor_does_not_look_like_a_missing_effect(mmrjax, tmp_path):
    """A brake test of a motor, more than half of whose no-load torque is viscous, with a file from its sheet."""
    draw, resistance, constant, coulomb, viscous = np.random.default_rng(3), 0.62, 0.0262, 0.0035, 5e-6

    def balance(volts, torque):
        """Speed and current of U = R I + k ω, k I = M_0 + K ω + M."""
        speed = (constant * volts / resistance - coulomb - torque) / (constant**2 / resistance + viscous)
        return speed, (coulomb + viscous * speed + torque) / constant

    volts, torque = (x.ravel() for x in np.meshgrid(np.arange(6.0, 25.0, 3.0), [0.0, 0.02, 0.05, 0.08]))
    speed, current = balance(volts, torque)
    runs = {
        "supply_voltage_V": volts, "load_torque_Nm": torque,
        "motor_current_A": current + draw.normal(0, 0.01, volts.size), "motor_current_sd_A": np.full(volts.size, 0.01),
        "motor_speed_rpm": speed * 30 / np.pi + draw.normal(0, 10, volts.size),
        "motor_speed_sd_rpm": np.full(volts.size, 10.0),
    }  # fmt: skip
    pd.DataFrame(runs).to_csv(tmp_path / "runs.csv", index=False)
    fastest, idle = balance(24.0, 0.0)
    sheet = {
        "voltage": "24 V",
        "no-load-current": f"{idle} A",
        "no-load-speed": f"{fastest} rad/s",
        "resistance": "0.62 ohm",
    }
    write_new_rig(tmp_path / "rig.toml", "dyno", False, sheet=sheet)
    ends(mmrjax("loop runs.csv --robot rig.toml --out out --no-report"), code=0)
    assert read_json(tmp_path / "out/result.json")["verdict"] == "none"
    fitted = robot_file.read_robot(tmp_path / "out/fitted.toml").motor
    assert fitted.friction_viscous == pytest.approx(viscous, rel=0.1)
    assert fitted.friction_coulomb == pytest.approx(coulomb, rel=0.1)
