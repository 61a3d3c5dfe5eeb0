"""Half a robot as MJCF for MuJoCo, and as an MJX model whose mass constants follow each batch member.

MJX owns the multibody dynamics alone: contacts and constraints are switched off and every force of the
running gear enters as a generalized force. The same text loads in C MuJoCo and its viewer.
"""

from __future__ import annotations

import contextlib
import functools
import io
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mmrjax.conditions import Conditions
from mmrjax.masses import Masses, masses
from mmrjax.params import Scalar
from mmrjax.robot import Robot
from mmrjax.signals import GRAVITY
from mmrjax.trigonometry import cosine, sine
from mmrjax.undercarriage import lever_tips

with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
    import mujoco
    from mujoco import mjx  # says on stdout which optional back ends are missing


def text(robot: Robot, conditions: Conditions, mass: float, step: float = 1e-4) -> str:
    """MJCF of half a robot under some conditions (scalar fields); `mass` total [kg], `step` [s].

    The shapes are for the eye and show both sides; masses and inertias are stated and are of one side.
    """
    gear = robot.running_gear
    half = masses(robot, conditions, jnp.asarray(mass))
    m = {name: float(getattr(half, name)) for name in vars(half)}
    chassis = robot.chassis(conditions.configuration)
    wheeled = bool(chassis.on_tracks < 0.5)
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
    for name, x in (("driving", base / 2), ("driven", -base / 2)):
        pulleys += f"""
      <body name="{name}" pos="{x:.17g} 0 0">
        <inertial pos="0 0 0" mass="{m["pulley"]:.17g}" diaginertia="{_planar(m["inertia_pulley"])}"/>
        <joint name="{name}" type="hinge" axis="0 1 0"/>
        <geom type="cylinder" size="{outer:.9g} 0.018" euler="90 0 0" pos="0 0.122 0" rgba=".2 .2 .2 1"/>
        <geom type="cylinder" size="{outer:.9g} 0.018" euler="90 0 0" pos="0 -0.122 0" rgba=".2 .2 .2 1"/>
        <geom type="box" size="{outer:.9g} 0.141 0.003" rgba=".8 .8 .2 1"/>
      </body>"""
    belts = "".join(
        f'<geom type="box" size="{base / 2:.9g} 0.014 0.0015" pos="0 {y} {z:.9g}" rgba=".2 .2 .2 1"/>\n      '
        for y in (-0.122, 0.122)
        for z in (-radius, radius)
    )
    return f"""<mujoco model="half robot {robot.configurations.names[int(conditions.configuration)]}">
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
      <inertial pos="{m["forward"]:.17g} 0 {m["up"]:.17g}" mass="{m["chassis"]:.17g}"
        diaginertia="{_planar(m["inertia"])}"/>
      <joint name="travel" type="slide" axis="1 0 0"/>
      <joint name="height" type="slide" axis="0 0 1" ref="0"/>
      <joint name="pitch" type="hinge" axis="0 1 0"/>
      <geom type="box" size="{base / 2:.9g} 0.104 0.038" pos="0 0 {0.043 - 0.038:.9g}" rgba=".3 .5 .7 1"/>
      {belts}{levers}{pulleys}
    </body>
  </worldbody>
  <keyframe><key name="stand" qpos="0 {axle:.9g} 0 0 0"/></keyframe>
</mujoco>
"""


def _planar(inertia: float) -> str:
    # In the plane only the moment about y counts; the other two only have to satisfy the triangle inequality.
    return " ".join([f"{inertia:.17g}"] * 3)


def impulse(
    half: Masses,
    wheelbase: Scalar,
    conditions: Conditions,
    pitch: Scalar,
    rate: Scalar,
    rotating: Scalar,
    gained: Float[Array, " 5"],
    step: Scalar,
) -> Float[Array, " 5"]:
    """Generalized impulse that changes velocities by `gained` in a `step`, M Δv + Δt c, in closed form.

    M is the mass matrix and c the bias (gravity and centrifugal forces) of the model that `text` writes: MJX has them
    too, but the derivatives of its general tree cost many times those of this one. No other force depends on v here.

    Args:
        half, wheelbase: masses and distance of the pulleys.
        conditions: for the slope.
        pitch: of the chassis [rad]; rate: its rate [rad/s]; rotating: the armature's inertia at its joint [kg·m²].
        gained: Δv; step: Δt [s].
    """
    cos, sin = cosine(pitch), sine(pitch)
    ahead = half.chassis * (half.forward * cos + half.up * sin)  # times the mass: the pulleys' cancel
    above = half.chassis * (half.up * cos - half.forward * sin)
    mass, turning = half.chassis + 2 * half.pulley, half.inertia_pulley
    pitching = half.pitching(wheelbase)
    gravity_x, gravity_z = GRAVITY * jnp.sin(conditions.slope), GRAVITY * jnp.cos(conditions.slope)
    x, z, turn, front, rear = (gained[k] for k in range(5))
    return jnp.stack(
        [
            mass * x + above * turn + step * (mass * gravity_x - ahead * rate**2),
            mass * z - ahead * turn + step * (mass * gravity_z - above * rate**2),
            above * x - ahead * z + pitching * turn + turning * (2 * turn + front + rear)
            + step * (gravity_x * above - gravity_z * ahead),
            turning * (turn + front) + rotating * front,
            turning * (turn + rear),
        ]
    )  # fmt: skip


@functools.cache
def _template(double: bool) -> tuple[Any, Any]:
    from mmrjax.robots import nominal  # topology only: every number is replaced per member

    with jax.ensure_compile_time_eval():
        model = mujoco.MjModel.from_xml_string(text(nominal(), Conditions(), 13.1))
        return mjx.put_model(model), mjx.make_data(model)


def template() -> tuple[Any, Any]:
    """The MJX model and data that all members share in structure."""
    return _template(jnp.result_type(float) == jnp.float64)


def member(model: Any, half: Masses, slope: Scalar, wheelbase: Scalar, step: Scalar) -> Any:
    """The MJX `model` with this member's masses, inertias, places, gravity and time step.

    Every constant that the smooth dynamics read and that mass decides is set here (mujoco issue 1607); the
    derived ones that only the constraint solver and the sensors read are set where they are sums.
    """
    zero = jnp.zeros_like(half.chassis)
    mass = jnp.stack([zero, half.chassis, half.pulley, half.pulley])
    inertia = jnp.stack([zero, half.inertia, half.inertia_pulley, half.inertia_pulley])
    total = half.chassis + 2 * half.pulley
    centre = model.body_ipos.at[1].set(jnp.stack([half.forward, zero, half.up]))
    place = model.body_pos.at[2, 0].set(wheelbase / 2).at[3, 0].set(-wheelbase / 2)
    gravity = -GRAVITY * jnp.stack([jnp.sin(slope), zero, jnp.cos(slope)])
    return model.replace(
        body_mass=mass,
        body_subtreemass=jnp.stack([total, total, half.pulley, half.pulley]),
        body_inertia=jnp.broadcast_to(inertia[:, None], (4, 3)),
        body_ipos=centre,
        body_pos=place,
        opt=model.opt.replace(gravity=gravity, timestep=jnp.asarray(step)),
    )
