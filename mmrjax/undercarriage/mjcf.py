"""Half a robot, or a whole one free to turn, as MJCF for MuJoCo and as an MJX model with masses for each member.

MJX computes only the multibody dynamics: contacts and constraints are switched off, and every force of the running
gear enters as a generalized force. The same text loads in C MuJoCo and its viewer.
"""

from __future__ import annotations

import contextlib
import functools
import io
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mmrjax.model import channels
from mmrjax.model.conditions import Conditions
from mmrjax.model.masses import HalfRobotMasses, masses_of_parts
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import GRAVITY
from mmrjax.numerics.elementary import cosine, sine
from mmrjax.turning.two_sides import SIDES
from mmrjax.undercarriage.side_contacts import lever_tips

with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
    import mujoco
    from mujoco import mjx  # prints a list of missing optional back ends to stdout


#: Joints of the chassis: of half a robot in its plane of travel, and of a robot free to turn. Name, type, axis.
_JOINTS = {
    False: (("travel", "slide", "1 0 0"), ("height", "slide", "0 0 1"), ("pitch", "hinge", "0 1 0")),
    True: (
        ("travel", "slide", "1 0 0"), ("aside", "slide", "0 1 0"), ("height", "slide", "0 0 1"),
        ("yaw", "hinge", "0 0 1"), ("pitch", "hinge", "0 1 0"), ("roll", "hinge", "1 0 0"),
    ),
}  # fmt: skip


class ModelBodies(NamedTuple):
    """Bodies in the order of the model: chassis, then driving and driven pulley of each side.

    Attributes:
        names: names of the bodies.
        mass: masses [kg].
        inertia: moments of inertia about the own centre, for x, y, z [kg·m²].
        centre: centres of mass, each in the frame of its body [m].
        place: origins of the frames in the frame of the chassis, whose origin is the middle of the wheelbase [m].
    """

    names: tuple[str, ...]
    mass: Float[Array, " bodies"]
    inertia: Float[Array, "bodies 3"]
    centre: Float[Array, "bodies 3"]
    place: Float[Array, "bodies 3"]


def robot_bodies(robot: Robot, half: HalfRobotMasses, conditions: Conditions) -> ModelBodies:
    """Bodies of half a robot, or of a whole robot that is free to turn (`Conditions.turns`).

    In the plane of travel only the moments about y count, and the others are set equal. The moment of yaw is
    `turning.inertia` of all parts about their centre, without payload as in the other fidelities. The moment of roll
    decides the speed of load transfer between the sides, not its size. It is summed over the parts: a uniform body as
    wide as the distance of the tracks, and the parts of the sides at their positions. At least that of a flat robot
    with this yaw and pitch.
    """
    zero = jnp.zeros_like(half.chassis)
    wheelbase = robot.running_gear.wheelbase
    ends = (("driving", wheelbase / 2), ("driven", -wheelbase / 2))
    if not conditions.turns:
        names = tuple(name for name, _ in ends)
        mass = [half.chassis, half.pulley, half.pulley]
        pitch_inertias = [half.inertia] + [half.inertia_pulley] * 2
        inertia = jnp.stack([jnp.stack([x] * 3) for x in pitch_inertias])
        places = [jnp.stack([x + zero, zero, zero]) for _, x in ends]
    else:
        turning = robot.chassis(conditions.configuration).turning
        motors_per_side, half_width = robot.sides / 2, turning.width / 2
        pulley, pulley_inertia = motors_per_side * half.pulley, motors_per_side * half.inertia_pulley
        mass = [2 * motors_per_side * half.chassis] + [pulley] * 4
        names = tuple(f"{name}_{side}" for side in channels.SIDES for name, _ in ends)
        places = [jnp.stack([x + zero, y * turning.width + zero, zero]) for y in SIDES for _, x in ends]
        centre = half.centre[0]
        offset_inertia = mass[0] * (half.forward - centre) ** 2 + 4 * (
            pulley_inertia + pulley * (wheelbase**2 / 4 + half_width**2 + centre**2)
        )
        pitch, yaw = 2 * motors_per_side * half.inertia, turning.inertia - offset_inertia
        payload = conditions.payload / robot.sides
        roll = 2 * motors_per_side * (half.body / 3 + half.chassis - half.body - payload) * half_width**2
        rows = [jnp.stack([jnp.maximum(roll, yaw - pitch), pitch, yaw])] + [jnp.stack([pulley_inertia] * 3)] * 4
        inertia = jnp.stack(rows)
    chassis_centre = jnp.stack([half.forward, zero, half.up])
    return ModelBodies(
        ("chassis", *names),
        jnp.stack(mass),
        inertia,
        jnp.zeros_like(inertia).at[0].set(chassis_centre),
        jnp.stack([jnp.zeros_like(chassis_centre), *places]),
    )


def mjcf_text(robot: Robot, conditions: Conditions, mass: float, step: float = 1e-4) -> str:
    """MJCF of half a robot under some conditions (scalar fields), or of a whole one if they free it to turn.

    The shapes are for display and show both sides. Masses and inertias are stated, for half a robot those of one
    side.

    Args:
        mass: total mass [kg].
        step: time step [s].
    """
    gear = robot.running_gear
    bodies = robot_bodies(robot, masses_of_parts(robot, conditions, jnp.asarray(mass)), conditions)
    chassis = robot.chassis(conditions.configuration)
    wheeled = bool(chassis.on_tracks < 0.5)
    further = " 0 0 0 0" if conditions.turns else ""
    radius, base = float(robot.radius_pulley), float(gear.wheelbase)
    axle = float(chassis.radius) if wheeled else radius + float(gear.grouser_height)
    outer = float(chassis.radius) if wheeled else radius
    sin, cos = float(jnp.sin(conditions.slope)), float(jnp.cos(conditions.slope))
    levers = ""
    if not wheeled:
        for side, (x, z) in zip((1.0, -1.0), lever_tips(gear, conditions), strict=True):
            for y in (-0.15, 0.15):
                ends = f"{side * base / 2:.9g} {y} 0 {float(x):.9g} {y} {float(z):.9g}"
                levers += f'<geom type="capsule" size="0.012" fromto="{ends}" rgba=".35 .4 .45 1"/>\n      '
    pulleys = ""
    for k, name in enumerate(bodies.names[1:], 1):
        disc = f'<geom type="cylinder" size="{outer:.9g} 0.018" euler="90 0 0" rgba=".2 .2 .2 1"'
        middles = (0.0,) if conditions.turns else (0.122, -0.122)
        discs = "".join(f'{disc} pos="0 {y} 0"/>\n        ' for y in middles)
        across = 0.019 if conditions.turns else 0.141
        pulleys += f"""
      <body name="{name}" pos="{_numbers_text(bodies.place[k])}">
        <inertial pos="0 0 0" mass="{float(bodies.mass[k]):.17g}" diaginertia="{_numbers_text(bodies.inertia[k])}"/>
        <joint name="{name}" type="hinge" axis="0 1 0"/>
        {discs}<geom type="box" size="{outer:.9g} {across} 0.003" rgba=".8 .8 .2 1"/>
      </body>"""
    joints = "".join(f'<joint name="{n}" type="{t}" axis="{a}"/>\n      ' for n, t, a in _JOINTS[conditions.turns])
    belts = "".join(
        f'<geom type="box" size="{base / 2:.9g} 0.014 0.0015" pos="0 {y} {z:.9g}" rgba=".2 .2 .2 1"/>\n      '
        for y in (-0.122, 0.122)
        for z in (-radius, radius)
    )
    title = f"{'' if conditions.turns else 'half '}robot {robot.configurations.names[int(conditions.configuration)]}"
    return f"""<mujoco model="{title}">
  <compiler inertiafromgeom="false"/>
  <option timestep="{step:.9g}" integrator="Euler" gravity="{-GRAVITY * sin:.17g} 0 {-GRAVITY * cos:.17g}">
    <flag contact="disable" constraint="disable" eulerdamp="disable"/>
  </option>
  <default><geom contype="0" conaffinity="0"/></default>
  <visual><global offwidth="1280" offheight="720"/></visual>
  <asset><texture type="skybox" builtin="gradient" rgb1=".9 .95 1" rgb2=".6 .7 .8" width="64" height="64"/></asset>
  <worldbody>
    <light pos="0 -2 3" dir="0 .5 -1" directional="true"/>
    <geom name="ground" type="plane" size="20 2 .1" rgba=".8 .78 .72 1"/>
    <body name="chassis" pos="0 0 0">
      <inertial pos="{_numbers_text(bodies.centre[0])}" mass="{float(bodies.mass[0]):.17g}"
        diaginertia="{_numbers_text(bodies.inertia[0])}"/>
      {joints}<geom type="box" size="{base / 2:.9g} 0.104 0.038" pos="0 0 {0.043 - 0.038:.9g}" rgba=".3 .5 .7 1"/>
      {belts}{levers}{pulleys}
    </body>
  </worldbody>
  <keyframe><key name="stand" qpos="{"0 0" if conditions.turns else "0"} {axle:.9g} 0 0 0{further}"/></keyframe>
</mujoco>
"""


def _numbers_text(numbers: Array) -> str:
    return " ".join(f"{float(x):.17g}" for x in numbers)


def step_impulse(
    half: HalfRobotMasses,
    wheelbase: Scalar,
    conditions: Conditions,
    pitch: Scalar,
    pitch_rate: Scalar,
    armature: Scalar,
    velocity_change: Float[Array, " 5"],
    step: Scalar,
) -> Float[Array, " 5"]:
    """Generalized impulse that changes velocities by `velocity_change` in a `step`, M Δv + Δt c, in closed form.

    M is the mass matrix and c the bias (gravity and centrifugal forces) of the model from `mjcf_text`. MJX computes
    them too, but the derivatives of its general tree cost many times as much. No other force depends on v here.

    Args:
        half, wheelbase: masses of half a robot, and distance between its pulleys.
        conditions: conditions, for their slope.
        pitch: pitch of the chassis [rad].
        pitch_rate: pitch rate [rad/s].
        armature: inertia of the armature at its joint [kg·m²].
        velocity_change: change of the velocities Δv.
        step: Δt [s].
    """
    cos, sin = cosine(pitch), sine(pitch)
    moment_ahead = half.chassis * (half.forward * cos + half.up * sin)  # times the mass: the pulleys' parts cancel
    moment_above = half.chassis * (half.up * cos - half.forward * sin)
    mass = half.chassis + 2 * half.pulley
    pulley_inertia = half.inertia_pulley
    pitch_inertia = half.inertia_about_middle(wheelbase)
    gravity_x, gravity_z = GRAVITY * jnp.sin(conditions.slope), GRAVITY * jnp.cos(conditions.slope)
    x, z, turn, front, rear = (velocity_change[k] for k in range(5))
    return jnp.stack(
        [
            mass * x + moment_above * turn + step * (mass * gravity_x - moment_ahead * pitch_rate**2),
            mass * z - moment_ahead * turn + step * (mass * gravity_z - moment_above * pitch_rate**2),
            moment_above * x - moment_ahead * z + pitch_inertia * turn + pulley_inertia * (2 * turn + front + rear)
            + step * (gravity_x * moment_above - gravity_z * moment_ahead),
            pulley_inertia * (turn + front) + armature * front,
            pulley_inertia * (turn + rear),
        ]
    )  # fmt: skip


@functools.cache
def _template(double: bool, turns: bool) -> tuple[Any, Any]:
    from mmrjax.model.paper_robots import nominal  # for the topology only: every number is replaced per member

    with jax.ensure_compile_time_eval():
        conditions = Conditions(heading_deg=0.0 if turns else None)
        model = mujoco.MjModel.from_xml_string(mjcf_text(nominal(), conditions, 13.1))
        return mjx.put_model(model), mjx.make_data(model)


def model_template(turns: bool) -> tuple[Any, Any]:
    """The MJX model and data whose structure all members share, of half a robot or one free to turn."""
    return _template(jnp.result_type(float) == jnp.float64, turns)


def member_model(model: Any, bodies: ModelBodies, slope: Scalar, step: Scalar) -> Any:
    """The MJX `model` with this member's bodies, gravity and time step.

    Every constant that the smooth dynamics read and that depends on mass is set here (mujoco issue 1607).
    Derived constants for the constraint solver and the sensors are set only if they are sums.
    """
    zero = jnp.zeros_like(bodies.mass[0])
    total = jnp.sum(bodies.mass)
    gravity = -GRAVITY * jnp.stack([jnp.sin(slope), zero, jnp.cos(slope)])
    return model.replace(
        body_mass=jnp.concatenate([zero[None], bodies.mass]),
        body_subtreemass=jnp.concatenate([jnp.stack([total, total]), bodies.mass[1:]]),
        body_inertia=jnp.concatenate([jnp.zeros((1, 3)), bodies.inertia]),
        body_ipos=jnp.concatenate([jnp.zeros((1, 3)), bodies.centre]),
        body_pos=jnp.concatenate([jnp.zeros((1, 3)), bodies.place]),
        opt=model.opt.replace(gravity=gravity, timestep=jnp.asarray(step)),
    )
