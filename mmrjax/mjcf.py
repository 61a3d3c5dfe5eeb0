"""Half a robot as MJCF for MuJoCo, and as an MJX model whose mass constants follow each batch member.

MJX owns the multibody dynamics alone: contacts and constraints are switched off and every force of the
running gear enters as a generalized force. The same text loads in C MuJoCo and its viewer.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import io
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mmrjax import params
from mmrjax.conditions import Conditions
from mmrjax.params import Scalar
from mmrjax.robot import Robot
from mmrjax.running_gear import RunningGear
from mmrjax.signals import GRAVITY
from mmrjax.trigonometry import cosine, sine
from mmrjax.undercarriage import lever_tip

with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
    import mujoco
    from mujoco import mjx  # says on stdout which optional back ends are missing


class Masses(eqx.Module):
    """Masses of half a robot [kg, m, kg·m²].

    Attributes:
        chassis: mass of all that does not turn with the pulleys.
        forward, up: its centre from the middle of the wheelbase.
        inertia: its moment of inertia in pitch about that centre.
        body: mass of what neither turns nor is lever, track or payload.
        pulley: mass of what turns on one axle: main and additional pulley, in 4W2T the wheel.
        inertia_pulley: about its axle, front and rear alike: half of J_w of eq. (31) each.
    """

    chassis: Scalar
    forward: Scalar
    up: Scalar
    inertia: Scalar
    body: Scalar
    pulley: Scalar
    inertia_pulley: Scalar

    def pitching(self, wheelbase: Scalar) -> Scalar:
        """Moment of inertia in pitch of all about the middle of the wheelbase, where pulleys do not turn on their
        axles [kg·m²]; J of the pulleys about their axles apart."""
        return self.inertia + self.chassis * (self.forward**2 + self.up**2) + self.pulley * wheelbase**2 / 2

    def inertia_pitch(self, wheelbase: Scalar) -> Scalar:
        """Moment of inertia in pitch of half a robot about its centre [kg·m²]."""
        total, moved = self.chassis + 2 * self.pulley, self.chassis**2 * (self.forward**2 + self.up**2)
        return self.pitching(wheelbase) + 2 * self.inertia_pulley - moved / total


class _Part(NamedTuple):
    """A rigid part: its mass [kg], its centre from the middle of the wheelbase [m], its moment of inertia in pitch
    about that centre [kg·m²]."""

    mass: Scalar
    forward: Scalar
    up: Scalar
    inertia: Scalar


def _together(parts: list[_Part]) -> _Part:
    """Parts joined rigidly: Σ J + Σ m d² about their common centre (Huygens and Steiner)."""
    mass = sum(p.mass for p in parts)
    forward = sum(p.mass * p.forward for p in parts) / mass
    up = sum(p.mass * p.up for p in parts) / mass
    inertia = sum(p.inertia + p.mass * ((p.forward - forward) ** 2 + (p.up - up) ** 2) for p in parts)
    return _Part(mass, forward, up, inertia)


def _belt(gear: RunningGear, radius: Scalar) -> _Part:
    """A main track round its pulleys, its inertia less what turns with them, m r², which is in J_w."""
    base, mass = gear.wheelbase, gear.belt_mass
    straights = 2 * base * (base**2 / 12 + radius**2)
    arcs = 2 * radius * (jnp.pi * base**2 / 4 + 2 * base * radius + jnp.pi * radius**2)
    loop = mass * (straights + arcs) / (2 * base + 2 * jnp.pi * radius)
    nothing = jnp.zeros_like(mass)
    return _Part(mass, nothing, nothing, loop - mass * radius**2)


def _levers(gear: RunningGear, tracked: Scalar, front: Scalar, rear: Scalar) -> list[_Part]:
    """The levers of one side at their angles [rad]."""
    mass, inertia, half = gear.lever_mass * tracked, gear.lever_inertia * tracked, gear.wheelbase / 2
    along = gear.lever_centre
    return [
        _Part(mass, side * half + along * jnp.cos(angle), along * jnp.sin(angle), inertia)
        for side, angle in ((1.0, front), (-1.0, rear))
    ]


def masses(robot: Robot, conditions: Conditions, mass: Scalar) -> Masses:
    """Masses of half a robot whose total with payload is `mass` [kg], as `balances.begin` gives it.

    The body has what pulleys, wheels, tracks, levers and payload leave of the mass, and its radius of gyration; the
    moment of inertia follows from the parts, wherever the levers stand. Where the robot states that of the whole with
    its levers folded and without payload (`inertia_tracked`, `inertia_wheeled`), the body's is what the other parts
    leave of that.
    """
    kind, gear = robot.chassis(conditions.configuration), robot.running_gear
    tracked = kind.on_tracks
    wheeled = 1 - tracked
    pulley = gear.pulley_mass + gear.additional_pulley_mass + gear.wheel_mass * wheeled
    inertia_pulley = kind.inertia / 2
    belt = _belt(gear, robot.radius_pulley)
    levers = _levers(gear, tracked, gear.lever_front, gear.lever_rear)
    nothing = jnp.zeros_like(belt.mass)
    payload = _Part(conditions.payload / robot.sides, gear.payload_offset, gear.payload_height, nothing)
    weighs = mass / robot.sides - 2 * pulley - belt.mass - sum(p.mass for p in levers) - payload.mass
    body = _Part(weighs, gear.centre_offset, gear.centre_height, weighs * gear.body_gyration**2)

    pulleys = [_Part(pulley, side * gear.wheelbase / 2, nothing, inertia_pulley) for side in (1.0, -1.0)]
    folded = [
        body._replace(inertia=nothing),
        belt,
        *_levers(gear, tracked, jnp.pi, jnp.zeros_like(tracked)),
        *pulleys,
    ]
    stated = jnp.where(wheeled > 0.5, gear.inertia_wheeled, gear.inertia_tracked) / robot.sides
    left = stated - _together(folded).inertia
    body = body._replace(inertia=jnp.where(left > 0, left, body.inertia))

    chassis = _together([body, belt, *levers, payload])
    return Masses(*chassis, body.mass, pulley, inertia_pulley)


def check_parts(robot: Robot) -> None:
    """Refuse a robot of which nothing is left for the body.

    Raises:
        ValueError: its parts weigh as much as a configuration, or have more inertia than is stated of the whole.
    """
    without = {"body_gyration": 0.0, "inertia_tracked": 0.0, "inertia_wheeled": 0.0}
    folded = {"lever_front": np.pi, "lever_rear": 0.0}
    gear = params.replace(robot.running_gear, {name: jnp.asarray(x) for name, x in (without | folded).items()})
    bodiless = dataclasses.replace(robot, running_gear=gear)
    for k, (name, chassis) in enumerate(robot.configurations.items()):
        half = masses(bodiless, Conditions(k).resolved(robot), chassis.mass)
        if np.any(np.asarray(half.body) <= 0):
            parts = np.max(np.asarray(chassis.mass - robot.sides * half.body))
            raise ValueError(
                f"{name}.mass: got {np.min(np.asarray(chassis.mass)):.3g} kg; expected more than {parts:.3g} kg, "
                "what its pulleys, wheels, tracks and levers weigh (running_gear.pulley_mass and the like)"
            )
        whole = "inertia_tracked" if chassis.on_tracks > 0.5 else "inertia_wheeled"
        stated = np.asarray(getattr(robot.running_gear, whole))
        least = np.asarray(robot.sides * half.inertia_pitch(gear.wheelbase))
        if np.any((stated > 0) & (stated <= least)):
            raise ValueError(
                f"running_gear.{whole}: got {np.min(stated):.3g} kg·m^2; expected 0, or more than "
                f"{np.max(least):.3g} kg·m^2, what the parts of {name} have without the body's own"
            )


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
        for side, angle in ((1.0, gear.lever_front), (-1.0, gear.lever_rear)):
            x, z = (float(c) for c in lever_tip(gear, angle, side))
            for y in (-0.15, 0.15):
                ends = f"{side * base / 2:.9g} {y} 0 {x:.9g} {y} {z:.9g}"
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
