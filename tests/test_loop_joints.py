"""Joints of a MuJoCo model, one loop after another: torques against MuJoCo, what is refused, and what is kept."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose

from calibration.data.delimited import read_csv_columns
from calibration.data.input_errors import BadData
from sweeps.commands.loop_joints import Chain, runs_of_joints
from sweeps.store import finish_run_folder, open_folder
from tests.commands import ends, read_json, read_rig

JOINTS = ("shoulder", "elbow")

LINK = '<geom type="capsule" fromto="0 0 0 0 0 -{length}" size="0.02" mass="{mass}"/>'
#: The loop of an arm in a folder.
COMMAND = "loop {0}/log.csv --model {0}/arm.xml --robot {0}/{{joint}}.toml"
MODEL = f"""
<mujoco><option timestep="0.001"/><worldbody><body>
  <joint name="shoulder" axis="0 1 0" frictionloss="0.3" damping="0.1" armature="0.01"/>
  {LINK.format(length=0.3, mass=0.8)}
  <body pos="0 0 -0.3"><joint name="elbow" axis="0 1 0" armature="0.02" damping="0.2"/>
    {LINK.format(length=0.25, mass=0.4)}</body>
</body></worldbody>
<actuator><motor joint="shoulder"/><motor joint="elbow"/></actuator></mujoco>
"""
RIG = """
base = "none"
sides = 1
imposed = "motor_speed"
channels = ["motor_current"]
[motor]
resistance = 4.0
inductance = 1e-3
torque_constant = "0.02 ± 10 %"
inertia = 2e-6
[gearbox]
ratio = 50
efficiency_load = 1.0
[joint]
load = "shaft"
inertia = 0.05
loss_coulomb = "0.1 ± 100 %"
loss_viscous = "0.05 ± 100 %"
"""
#: Dry friction of each joint forward and backward [N·m], viscous friction [N·m·s], speed of smoothed rest [rad/s].
DRY, VISCOUS, REST = np.array([[0.1, 0.1], [0.25, 0.1]]), 0.05, 2e-3


def arm(seconds=4.0, every=0.005, seed=0):
    """A log of the arm under steps of voltage, by own steps of motors and friction around MuJoCo's `mj_forward`."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    model.dof_damping[:], model.dof_frictionloss[:], model.dof_armature[:] = 0, 0, 2e-6 * 50**2
    data, rng, step = mujoco.MjData(model), default_rng(seed), 5e-5
    volts = np.repeat(rng.choice([-1.0, 1.0], (40, 2)) * rng.uniform(2, 7, (40, 2)), 50, 0)
    angle, speed, current, rows = np.zeros(2), np.zeros(2), np.zeros(2), []
    for k in range(round(seconds / step)):
        now = volts[int(k * step / every)] if k * step > 0.1 else np.zeros(2)
        data.qpos[:], data.qvel[:], data.qfrc_applied[:] = angle, speed, 50 * 0.02 * current - friction_of(speed)
        mujoco.mj_forward(model, data)
        if k % round(every / step) == 0:
            rows.append([k * step, *now, *current, *angle, *speed, *data.qacc])
        current = current + step * (now - 4.0 * current - 0.02 * 50 * speed) / 1e-3
        speed = speed + step * data.qacc
        angle = angle + step * speed
    return np.array(rows)


def write(folder, rows, noise=0.0, model=MODEL):
    """Model, a rig for each joint, and the log of `rows`."""
    (folder / "arm.xml").write_text(model)
    for name in JOINTS:
        (folder / f"{name}.toml").write_text(RIG)
    rng = default_rng(1)
    angle, current = (
        rows[:, k : k + 2] + sd * rng.standard_normal((len(rows), 2)) for k, sd in ((5, noise), (3, 30 * noise))
    )
    cells = np.column_stack([rows[:, :3], current, np.degrees(angle)])
    columns = [f"{j}.{c}" for c in ("supply_voltage_V", "motor_current_A", "output_angle_deg") for j in JOINTS]
    np.savetxt(folder / "log.csv", cells, "%.13g", ",", header=",".join(["time_s", *columns]), comments="")


def runs_of(folder, joint="elbow", rig=RIG):
    """The runs of one joint of the arm and the log in a folder."""
    log = read_csv_columns(folder / "log.csv", "log.csv")
    return runs_of_joints(log, Chain(folder / "arm.xml"), {joint: read_rig(folder, rig)})[joint]


def friction_of(speed, way=None):
    """Friction torque of each joint, smoothed at rest."""
    way = np.tanh(speed / REST) if way is None else way
    return np.where(speed > 0, DRY[:, 0], DRY[:, 1]) * way + VISCOUS * speed


def test_torque_of_the_model_is_what_mujoco_was_given_without_friction_and_rotors(tmp_path):
    """At states of the arm, MuJoCo's own forward dynamics with the torque gives the acceleration."""
    rows = arm(0.5)[::10]
    write(tmp_path, rows)
    given = 50 * 0.02 * rows[:, 3:5] - friction_of(rows[:, 7:9]) - 2e-6 * 50**2 * rows[:, 9:]
    motion = rows[:, 5:].reshape(-1, 3, 2).swapaxes(0, 1)
    assert_allclose(Chain(tmp_path / "arm.xml").torques(motion), given, atol=1e-9)


def test_load_of_a_joint_is_that_torque_less_what_its_file_states(tmp_path):
    """A smooth motion without noise, and the share of the noise of readings that ends in the torque."""
    time, amplitude, rate = np.arange(0, 2, 0.002), np.array([0.6, 0.9]), np.array([3.0, 2.0])
    angle = amplitude * np.sin(time[:, None] * rate)
    motion = np.stack([angle, amplitude * rate * np.cos(time[:, None] * rate), -(rate**2) * angle])
    angle, speed, acceleration = motion[:, :, 1]
    rows = np.column_stack([time, np.ones((len(time), 4)), motion[0]])
    inner, errors = slice(100, -100), []
    for noise in (0.0, 1e-3):
        write(tmp_path, rows, noise)
        runs = runs_of(tmp_path, rig=RIG + "torque_gravity = 0.3\nangle_zero = 0.2\n").whole
        needed = Chain(tmp_path / "arm.xml").torques(motion)[:, 1]
        given = runs["load_torque_Nm"] + 0.05 * acceleration + 0.3 * np.sin(angle - 0.2)
        errors.append(np.abs(given - needed)[inner].max() / np.abs(needed).max())
        assert_allclose(runs["motor_speed_rpm"][inner], 50 * 30 / np.pi * speed[inner], atol=3)
    assert errors[0] < 1e-6 and 1e-4 < errors[1] < 0.02


def test_units_of_a_log_reach_each_joint(tmp_path):
    """In names of columns and in a row below them. The sd of a current is that of its noise, in any unit."""
    rng, time = default_rng(2), np.arange(0, 2, 0.005)
    rows = np.column_stack(
        [time, np.full((len(time), 2), 5.0), np.tile([np.sin(2 * time), np.cos(3 * time)], (2, 1)).T]
    )
    rows[:, 3:5] += 0.01 * rng.standard_normal((len(time), 2))

    def runs(units, rows=rows, unit="A"):
        write(tmp_path, rows)
        header, *lines = (tmp_path / "log.csv").read_text().splitlines()
        header = header.replace("elbow.motor_current_A", f"elbow.motor_current_{unit}")
        (tmp_path / "log.csv").write_text("\n".join([header, units, *lines]))
        return runs_of(tmp_path)

    table = runs("s,V,V,A,A,deg,deg")
    assert any("contains units" in note for note in table.notes)
    assert_allclose(np.median(table["motor_current_sd_A"]), 0.01, rtol=0.1)
    milli = rows * np.where(np.arange(7) == 4, 1e3, 1.0)
    other = runs("s,V,V,A,mA,deg,deg", milli, "mA")
    assert_allclose(other["motor_current_sd_A"], table["motor_current_sd_A"], rtol=1e-6)
    for wrong, name in (("A,mA,deg", "motor_current_A states mA"), ("A,A,rad", "output_angle_deg states rad")):
        with pytest.raises(BadData, match=f"{name} in the row of units"):
            runs(f"s,V,V,{wrong},deg")


def test_current_is_left_out_where_the_direction_of_the_smoothed_speed_is_uncertain(tmp_path):
    """A reading of friction with the wrong sign looks like a missing effect."""
    rows = arm(2.0)
    write(tmp_path, rows, 3e-4)
    table = runs_of(tmp_path)
    wrong = np.sign(table["motor_speed_rpm"]) != np.sign(np.interp(table["time_s"], rows[:, 0], rows[:, 8]))
    kept = np.isfinite(table["motor_current_A"])
    assert np.sum(wrong) > 5 and np.sum(wrong & kept) <= 0.2 * np.sum(wrong) and np.mean(kept) > 0.5
    assert any("direction of the speed is uncertain" in note for note in table.notes)


@pytest.mark.parametrize("joint", JOINTS)
def test_currents_of_a_joint_are_not_late(tmp_path, joint):
    """Against the true friction. Readings before a jump of the torque, which the smoothed motion anticipates, looked
    late by 4 ms. Inertias that move half a row early made that 10 ms."""
    rows, k = arm(2.0, seed=12), JOINTS.index(joint)
    write(tmp_path, rows, 3e-4)
    table = runs_of(tmp_path, joint)
    time, speed = table.whole["time_s"], table.whole["motor_speed_rpm"] * np.pi / 30 / 50
    at = np.searchsorted(time, table["time_s"])
    speed, gradient = speed[at], np.gradient(speed, time)[at]
    friction = friction_of(speed[:, None], np.sign(speed[:, None]))[:, k]
    needed = table["load_torque_Nm"] + (0.05 + 2e-6 * 50**2) * gradient + friction
    slope = np.interp(table["time_s"], rows[:, 0], np.gradient(rows[:, 3 + k], rows[:, 0]))
    error, slope = (x / table["motor_current_sd_A"] for x in (table["motor_current_A"] - needed / (50 * 0.02), slope))
    kept = np.isfinite(error)
    assert abs(error[kept] @ slope[kept]) < 2 * np.linalg.norm(slope[kept])
    assert 0.3 < np.sqrt(np.mean(error[kept] ** 2)) < 1


@pytest.mark.parametrize(
    "old, new, joints, message",
    [
        ("", "", "wrist", r"--joints: got wrist; arm.xml has no such driven joint"),
        ('name="elbow" axis="0 1 0"', 'name="elbow" type="slide"', "all", "joint elbow is no named hinge"),
        ('<body>\n  <joint name="shoulder"', '<body><freejoint name="base"/><geom size="1"/><body>\n  <joint name="shoulder"', "all", "joint base is no named hinge"),
        ('<motor joint="elbow"/>', '<motor joint="elbow"/><motor joint="elbow"/>', "all", "elbow has several actuators"),
        ("</actuator>", '</actuator><equality><joint joint1="elbow" joint2="shoulder"/></equality>', "all", "closed loops"),
    ],
)  # fmt: skip
def test_models_that_are_no_chain_of_driven_hinges_are_refused(old, new, joints, message, mmrjax, tmp_path):
    model = MODEL.replace(old, new)
    model = model.replace("</worldbody>", "</body></worldbody>") if "freejoint" in new else model
    write(tmp_path, np.zeros((20, 7)), model=model)
    ends(mmrjax("loop", tmp_path / "log.csv", "--model", tmp_path / "arm.xml", "--joints", joints), message)


@pytest.mark.parametrize("old, new, options, says, code", [
    ("", "", [], "--model and --joints must be given together", 2),
    ("elbow.output", "wrist.output", ["--joints", "shoulder"], "has no column elbow.output_angle_deg or elbow.output_angle_rad", 4),
    ("time_s", "moment", ["--joints", "elbow"], "has no column time_s", 4),
    ("0.05,", "#", ["--joints", "elbow"], "shoulder.output_angle_deg: has 5 readings in run 1", 4),
    ("", "", ["--joints", "elbow", "--robot", "sm1"], "expected the rig of one joint", 2),
])  # fmt: skip
def test_what_a_joint_lacks_is_named(old, new, options, says, code, mmrjax, tmp_path):
    rows = np.zeros((20, 7))
    rows[:, 0] = np.arange(20) * 0.01
    write(tmp_path, rows)
    log = (tmp_path / "log.csv").read_text()
    (tmp_path / "log.csv").write_text(log.partition("0.05,")[0] if new == "#" else log.replace(old, new))
    ends(mmrjax(COMMAND.format(tmp_path), *options), says, code=code)


@pytest.mark.slow
def test_each_joint_of_an_arm_has_its_loop_and_keeps_it(mmrjax, tmp_path):
    write(tmp_path, arm(2.0), 3e-4)
    arguments = [*COMMAND.format(tmp_path).split(), "--out", tmp_path / "found", "--within", "1h", "--joints"]
    _, out, _ = ends(mmrjax(*arguments, "elbow"), code=0)
    assert out.strip().endswith("found") and "elbow/report.html" in (tmp_path / "found/report.html").read_text()
    began = read_json(tmp_path / "found/elbow/manifest.json")["started"]
    ends(mmrjax(*arguments, "elbow"), "elbow: finished in", code=0)
    assert read_json(tmp_path / "found/elbow/manifest.json")["started"] == began
    (tmp_path / "elbow.toml").write_text(RIG.replace("ratio = 50", "ratio = 51"))
    ends(mmrjax(*arguments, "elbow"), "exists already; choose another path")


def test_finished_joints_are_kept_and_all_are_on_one_page(mmrjax, tmp_path, monkeypatch):
    """With a loop that only leaves a result."""
    ran = []

    def loop(one, beside, robot, runs):
        ran.append(one.joints)
        with open_folder("loop", one, robot, beside, runs) as folder:
            errors = {
                which: {"held_out": {"motor_current": {"rms_percent": x}}}
                for which, x in (("before", 4.0), ("after", 2.0))
            }
            folder.write_json("result.json", {"statement": f"Friction of {runs.source}.", "errors": errors})
            return finish_run_folder(folder, {}, lambda results: None)

    monkeypatch.setattr("sweeps.commands.loop._run_with_time_limit", loop)
    write(tmp_path, np.column_stack([np.arange(40) * 0.01, np.zeros((40, 4)), default_rng(0).random((40, 2))]))
    arguments = [*COMMAND.format(tmp_path).split(), "--joints", "all", "--out", tmp_path / "found"]
    ends(mmrjax(*arguments), "4 → 2", code=0)
    ends(mmrjax(*arguments), "joint shoulder: finished in", code=0)
    page = (tmp_path / "found/report.html").read_text("utf-8")
    assert ran == [("shoulder",), ("elbow",)] and all(f"{name}/report.html" in page for name in JOINTS)
    (tmp_path / "elbow.toml").write_text(RIG.replace("ratio = 50", "ratio = 51"))
    ends(mmrjax(*arguments), "found/elbow exists already")
