"""Rig files from URDF and from MuJoCo's models: numbers, their sources, and one sentence for each mistake."""

import math
from pathlib import Path

import numpy as np
import pytest

from calibration.data.stated import example_numbers, has_template_number, is_example
from mmrjax.model import params
from mmrjax.model.signals import GRAVITY
from sweeps.commands import rig_from_mujoco, rig_new
from sweeps.commands.rig_numbers import rig_template
from tests.commands import read_rig, text_file

DIFFBOT = Path(__file__).parent / "data/diffbot.urdf"
FREE = """<mujoco>
  <default>
    <default class="wheel">
      <joint damping="0.02" frictionloss="0.05" armature="0.0016" axis="0 1 0"/>
      <geom type="cylinder" size="0.08 0.02" euler="90 0 0" mass="0.5"/>
    </default>
  </default>
  <worldbody>
    <body pos="0 0 0.1"><freejoint/><geom type="box" size="0.2 0.1 0.05" mass="5"/>
      <body pos="0 0.15 0"><joint name="left" class="wheel"/><geom name="tyre" class="wheel"/></body>
      <body pos="0 -0.15 0"><joint name="right" class="wheel"/><geom class="wheel"/></body>
    </body>
  </worldbody>
  <actuator><motor joint="left" gear="20"/><motor joint="right" gear="20"/></actuator>
</mujoco>"""


def values(text, tmp_path):
    """Parameters of a rig's text by name, after it was read."""
    robot = read_rig(tmp_path, text)
    numbers = {"sides": float(robot.sides), **{p.name: float(p.value) for p in params.walk_parameters(robot)}}
    return numbers, {name: sd for name, _, sd in robot.rig.priors}


def test_wheel_of_a_urdf_is_a_robot_on_wheels_with_sources(tmp_path):
    text = rig_new.new_rig_text(None, DIFFBOT, "left_wheel_joint", None)
    found, sds = values(text, tmp_path)
    expected = {
        "sides": 2, "rover.mass": 5.2, "rover.radius": 0.065, "rover.inertia": 6.8e-4, "gearbox.ratio": 34,
        "rover.track.loss_coulomb": 0.03, "rover.track.loss_viscous": 0.012,
    }  # fmt: skip
    assert {name: found[name] for name in expected} == pytest.approx(expected, rel=1e-9)
    assert sds["rover.inertia"] == pytest.approx(3.4e-4) and sds["rover.mass"] == pytest.approx(1.04)
    assert '"34.0 ± 5 %"  # [-] diffbot.urdf, transmission left_drive, <mechanicalReduction>' in text
    assert "equal wheels: left_wheel_joint, right_wheel_joint" in text
    assert set(example_numbers(text)) == {
        "motor.resistance", "motor.torque_constant", "motor.friction_coulomb", "motor.friction_viscous",
        "motor.inertia", "gearbox.efficiency_load", "rover.ground.rolling_resistance", "rover.ground.friction.static",
    }  # fmt: skip


def test_arm_of_a_urdf_carries_what_is_fixed_to_it(tmp_path):
    found, _ = values(rig_new.new_rig_text(None, DIFFBOT, "arm_joint", None), tmp_path)
    assert found["arm.inertia"] == pytest.approx(7e-4 + 0.2 * 0.1**2 + 2e-5 + 0.1 * 0.2**2)
    assert found["arm.torque_gravity"] == pytest.approx((0.2 * 0.1 + 0.1 * 0.2) * GRAVITY)
    assert found["arm.angle_zero"] == pytest.approx(math.pi / 2)  # it points forward, and turns down


@pytest.mark.parametrize("seed", range(3))
def test_urdf_agrees_with_mujoco_in_any_frames(seed, tmp_path):
    draw = np.random.default_rng(seed)
    some = lambda: " ".join(f"{x:.4f}" for x in draw.normal(0, 0.5, 3))  # noqa: E731
    text = f'<robot name="r"><mujoco><option gravity="0 0 {-GRAVITY}"/></mujoco><link name="l0"/>'
    for k, kind in enumerate(("fixed", "revolute", "fixed", "revolute"), 1):
        text += f"""<link name="l{k}"><inertial><origin xyz="{some()}" rpy="{some()}"/><mass value="{k}"/>
            <inertia ixx="0.2" iyy="0.3" izz="0.25" ixy="0.01" ixz="-0.02" iyz="0.03"/></inertial></link>
            <joint name="j{k}" type="{kind}"><parent link="l{k - 1}"/><child link="l{k}"/>
            <origin xyz="{some()}" rpy="{some()}"/><axis xyz="{some()}"/><limit lower="-1" upper="1" effort="1"
            velocity="1"/><dynamics damping="0.1" friction="0.2"/></joint>"""
    (tmp_path / "r.urdf").write_text(text + "</robot>")
    for joint in ("j2", "j4"):
        ours, theirs = (
            rig_new.joint_numbers(tmp_path / "r.urdf", joint),
            rig_from_mujoco.read_mujoco_hinge(tmp_path / "r.urdf", joint),
        )
        for key in ("inertia", "weight", "angle", "friction", "damping"):
            assert ours.stated[key][0] == pytest.approx(theirs.stated[key][0], rel=1e-6), (joint, key)


@pytest.mark.parametrize(
    "kind, text, joint, expected",
    [
        (None, FREE, "left", {
            "sides": 2, "rover.mass": 6.0, "rover.radius": 0.08, "rover.inertia": 0.5 * 0.5 * 0.08**2,
            "gearbox.ratio": 20, "motor.inertia": 4e-6, "rover.track.loss_coulomb": 0.05, "rover.track.loss_viscous": 0.02,
        }),
        # an armature without a ratio turns with the load
        ("bench", FREE.replace(' gear="20"', ""), "left", {"motor.inertia": 0, "bench.inertia": 0.0016 + 0.0016}),
        # a name with a line break stays in its comment
        (None, DIFFBOT.read_text().replace("left_wheel", "left&#10;mass = 1 #"), "left\nmass = 1 #_joint", {"rover.mass": 5.2}),
    ],
    ids=["wheel", "armature", "line break"],
)  # fmt: skip
def test_numbers_of_a_model_are_those_of_its_joint(tmp_path, kind, text, joint, expected):
    source = text_file(tmp_path / "free.xml", text)
    written = rig_new.new_rig_text(kind, source, joint, None)
    found, _ = values(written, tmp_path)
    assert {name: found[name] for name in expected} == pytest.approx(expected, rel=1e-6)
    assert text != FREE or (
        "free.xml, geom tyre (cylinder)" in written and example_numbers(written)["motor.resistance"] == "[ohm]"
    )


BARE = FREE.replace('damping="0.02" frictionloss="0.05" ', "")
SHEET = {"voltage": "24 V", "no-load-current": "0.3 A", "resistance": "0.6 ohm", "no-load-speed": "8810 rpm"}
DCMOTOR = '<dcmotor joint="left" gear="20" motorconst="0.03" resistance="1.2"%s/>'


@pytest.mark.parametrize("kind", ["wheeled", "bench"])
@pytest.mark.parametrize("motor", ["sheet", "dcmotor", "dcmotor without a voltage"])
def test_losses_that_a_model_leaves_at_0_are_free_up_to_a_share_of_the_stall_torque(kind, motor, tmp_path):
    """5 % of k n U / R, and of it over the no-load speed U / (k n)."""
    text = BARE
    if motor != "sheet":
        native = DCMOTOR % (' ctrlrange="-24 24"' if motor == "dcmotor" else "")
        text = BARE.replace('<motor joint="left" gear="20"/>', native)
    assert "damping" not in text
    (tmp_path / "model.xml").write_text(text)
    rig = rig_new.new_rig_text(kind, tmp_path / "model.xml", "left", SHEET if motor == "sheet" else None)
    found, sds = values(rig, tmp_path)
    losses = "rover.track" if kind == "wheeled" else "bench"
    constant, resistance = found["motor.torque_constant"], found["motor.resistance"]
    assert found[f"{losses}.loss_viscous"] == 0
    assert sds[f"{losses}.loss_viscous"] == pytest.approx(0.05 * (20 * constant) ** 2 / resistance, rel=0.03)
    if motor == "dcmotor":
        assert found[f"{losses}.loss_coulomb"] == 0
        assert sds[f"{losses}.loss_coulomb"] == pytest.approx(0.05 * 20 * constant * 24 / resistance, rel=0.03)
    elif motor != "sheet":
        assert 'a value of 0 stays fixed, "0.0 ± 0.01" is fitted' in rig and f"{losses}.loss_coulomb" not in sds


def test_losses_of_a_model_without_motor_constants_keep_the_lines_of_the_template(tmp_path):
    (tmp_path / "free.xml").write_text(BARE)
    text = rig_new.new_rig_text(None, tmp_path / "free.xml", "left", None)
    assert '# loss_viscous = "0.001 ± 100 %"' in text and "Not stated: 0. " in text
    assert "rover.track.loss_viscous" not in values(text, tmp_path)[1]


# --- bad robots -----------------------------------------------------------------------------------------


def test_a_replaced_number_is_no_example_even_with_its_comment():
    line = next(x for x in rig_template("dyno").splitlines() if x.startswith("torque_constant"))
    assert (
        is_example(line)
        and not is_example(line.replace("0.05", "0.031"))
        and not is_example("torque_constant = 0.05")
    )


def test_a_templates_number_is_recognised_without_its_comment():
    assert has_template_number('torque_constant = "0.05 ± 5 %"')
    others = "torque_constant = 0.031", "resistance = 0.05", "# torque_constant = 0.05", "ratio = 1", "[motor]"
    assert not any(map(has_template_number, others))  # a ratio of 1 may be anyone's
