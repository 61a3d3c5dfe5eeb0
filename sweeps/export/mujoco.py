"""A drive as a `<dcmotor>` of MuJoCo: an MJCF fragment to include, a runnable scene, and its law in steady travel."""

from __future__ import annotations

import dataclasses
import math
import re
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from calibration.data import Names
from calibration.data.input_errors import BadConfiguration
from mmrjax import __version__
from mmrjax.errors import printable
from mmrjax.model import params
from mmrjax.model.chassis import inertia_reduced
from mmrjax.model.driver import Controller
from mmrjax.model.shaft import FLANK_DAMPING, FLANK_STIFFNESS
from sweeps.export.comparison import APPROXIMATED, DROPPED, HELD, ComparisonRuns, EffectFate, JointResult
from sweeps.export.joint import DriveJoint
from sweeps.export.law_source import LawConstant, filled_template

#: First version with `<dcmotor>`.
FIRST, FIRST_TEXT = (3, 7, 0), "3.7"
#: Effects for which the format has a term, and the term.
TERMS = {
    "series_resistance": "resistance",
    "supply_sag": "resistance of all motors together",
    "armature_inductance": "inductance",
    "rotating_inertia": "armature of the joint",
    "thermal_drift": "thermal",
    "cogging": "cogging, which does not fade at speed",
    "presliding": "lugre",
}
#: Friction that falls with speed: amplitude at the motor shaft, and True if its speed is that of the motor.
STRIBECK = {
    "stribeck_motor": (True, True),
    "stribeck_gear": (False, True),
    "stribeck_track": (False, False),
    "stribeck_exponent": (False, False),
}
#: Default angle of the joint over which a bristle yields [rad].
YIELD = 0.02
#: Smallest friction of a bristle at speed, as a share of the friction that falls with speed.
LEAST_SHARE = 0.05
#: Fixed-point steps of heat and falling friction.
STEPS = 12
#: Names of base terms.
PLAY, CONTROLLER, ROTOR, LIMIT = (
    "backlash and elasticity", "controller", "rotor inertia", "current limit of the driver",
)  # fmt: skip
#: Fate of the ground in simulators.
GROUND = EffectFate("ground: slip and rolling resistance", DROPPED, "the simulator's own contact with the ground")
#: Impedance of a tendon's limit, so low that the limit acts as a spring and a damper in addition to other torques.
IMPEDANCE = 1e-3
#: Names of the format's parameters.
RESISTANCE, CONSTANT, FRICTION, DAMPING, SHARE = (
    "resistance", "motorconst", "frictionloss", "damping", "current over act",
)  # fmt: skip
EXCESS, FADE, HEAT = "lugre F_S - F_C", "lugre v_S", "thermal R"


class MujocoLaw(eqx.Module):
    """Steady law of `<dcmotor>` on a joint with friction loss and damping.

    U = R' I' + g K ω, g K I' = M + f sign ω + d ω, and I = c I'. `ratio` is g, and `coefficient` the temperature
    coefficient of the resistance [1/K]. Further attributes are as in `comparison.FormatLaw`.
    """

    names: Names = eqx.field(static=True)
    start: jax.Array
    ratio: jax.Array
    coefficient: jax.Array

    def __call__(self, theta: Any, command: Any, load: Any, way: Any) -> tuple[Any, Any]:
        values_by_name = dict(zip(self.names, theta, strict=True))
        resistance, turns = values_by_name[RESISTANCE], self.ratio * values_by_name[CONSTANT]
        hot, excess = jnp.ones_like(command), jnp.zeros_like(command)
        current, speed = jnp.zeros_like(command), jnp.zeros_like(command)
        for _ in range(STEPS if EXCESS in values_by_name or HEAT in values_by_name else 1):
            carried = load + way * (values_by_name[FRICTION] + excess)
            drop = hot * resistance / turns
            speed = (command - drop * carried) / (turns + drop * values_by_name[DAMPING])
            current = (carried + values_by_name[DAMPING] * speed) / turns
            if HEAT in values_by_name:
                hot = 1 + self.coefficient * values_by_name[HEAT] * hot * resistance * current**2
            if EXCESS in values_by_name:
                excess = values_by_name[EXCESS] * jnp.exp(-((speed / values_by_name[FADE]) ** 2))
        return values_by_name[SHARE] * current, speed


class _LawNumbers(dict[str, float]):
    """Parameters by dotted name [SI]. Those of effects that a joint lacks are 0."""

    def __missing__(self, name: str) -> float:
        if name.startswith("effects."):
            return 0.0
        raise KeyError(name)


def _law_numbers(joint: DriveJoint, amplitudes: Mapping[str, float]) -> _LawNumbers:
    """Parameters of a joint, with some amplitudes replaced."""
    changed = {f"effects.{name}.amplitude": amplitude for name, amplitude in amplitudes.items()}
    return _LawNumbers(params.values_by_name(joint.robot) | changed)


def mujoco_law_function(normal: float) -> Any:
    """Function of a joint and amplitudes that returns its law, at a normal load of one side [N]."""
    return lambda joint, amplitudes: translate_law(joint, normal, amplitudes)


def translate_law(joint: DriveJoint, normal: float, amplitudes: Mapping[str, float] | None = None) -> MujocoLaw:
    """Law of the format with the native law's parameters, for a motor that drives.

    Losses in proportion to the load take a share 1 - η of the torque. `<dcmotor>` has one motor constant for torque
    and voltage, so the current that it shows is I' = η I, and its resistance is R / η.
    """
    robot, load, v = joint.robot, joint.load, _law_numbers(joint, amplitudes or {})
    ratio, share = v["gearbox.ratio"], v["gearbox.efficiency_load"]
    leads = v["effects.series_resistance.amplitude"] + float(robot.sides) * v["effects.supply_sag.amplitude"]
    dry = ratio * share * (v["motor.friction_coulomb"] + v["gearbox.friction_coulomb"])
    damping = ratio**2 * share * (v["motor.friction_viscous"] + v["gearbox.friction_viscous"])
    losses = load.track if robot.has_ground else load
    dry += float(losses.loss_coulomb)
    damping += float(losses.loss_viscous)
    if robot.has_ground:
        dry += float(losses.force_guide(normal, 1.0)) * float(load.radius)
    values = {
        RESISTANCE: (v["motor.resistance"] + leads) / share,
        CONSTANT: v["motor.torque_constant"],
        FRICTION: dry,
        DAMPING: damping,
        SHARE: 1 / share,
    }
    # friction at low speed, at the joint
    falling = [e.name for e in joint.inside if e.name in STRIBECK]
    if falling:
        excess = [v[f"effects.{n}.amplitude"] * (ratio * share if STRIBECK[n][0] else 1.0) for n in falling]
        fades = [v[f"effects.{n}.speed_fade"] / (ratio if STRIBECK[n][1] else 1.0) for n in falling]
        values |= {EXCESS: max(sum(excess), 0.0), FADE: max(fades)}
    if any(e.name == "thermal_drift" for e in joint.inside):
        heat = v["effects.thermal_drift.amplitude"] * v["effects.thermal_drift.resistance_thermal"]
        values[HEAT] = max(heat, 0.0) / share
    numbers = (list(values.values()), ratio, float(robot.motor.temperature_coefficient))
    return MujocoLaw(tuple(values), *(jnp.asarray(x, float) for x in numbers))


def fates_in_mujoco(joint: DriveJoint, normal: float) -> list[EffectFate]:
    """Fates of the base's terms, and of effects outside the joint."""
    robot, load = joint.robot, joint.load
    gear = robot.gearbox
    fates = [
        EffectFate("winding and back-EMF", HELD, "resistance, motorconst, inductance"),
        EffectFate("friction of motor and gearbox", HELD, "frictionloss and damping of the joint"),
        EffectFate(ROTOR, HELD, "armature of the joint, for a motor that drives"),
    ]
    if float(gear.efficiency_load) != 1:
        fates.append(
            EffectFate(
                "gearbox losses proportional to the load", APPROXIMATED,
                "resistance / η and current = act / η: exact while power flows to the load. While it flows "
                "back, the joint is braked too little",
            )
        )  # fmt: skip
    if robot.has_ground:
        fates.append(EffectFate("internal losses of tracks", HELD, "frictionloss and damping of the joint"))
        if float(load.track.guide_friction * load.track.guide_share) > 0:
            how = f"frictionloss at the mean normal load of these runs, {normal:.4g} N a side"
            fates.append(EffectFate("friction of track guides", APPROXIMATED, how))
        fates.append(GROUND)
    if joint.loose:
        how = "a joint for the motor's side, and a tendon"
        fates.append(EffectFate(PLAY, HELD, how))
    if joint.controller is not None:
        fates.append(_controller_fate(joint, joint.controller))
    if joint.limit is not None:
        fates.append(EffectFate(LIMIT, HELD, "saturation"))
    return [*fates, *fates_outside_joint(joint)]


def _controller_fate(joint: DriveJoint, controller: Controller) -> EffectFate:
    """Fate of a controller in `<dcmotor>`, which follows the motor's angle without lag, with a limited integral."""
    imposed, lag = joint.robot.rig.imposed, float(controller.lag)
    if imposed != "goal_angle":
        how = f"<dcmotor> has no {imposed.replace('_', ' ')} control with these gains: take them from LAW.md and "
        return EffectFate(CONTROLLER, DROPPED, f"{how}command voltages")
    limitations = [f"its lag of {lag:g} s is dropped"] * (lag > 0)
    limitations += [f"it acts at each step, not at {controller.rate:g} Hz"] * (controller.rate > 0)
    limitations += ["its integral stops at a value, not at the duty's limit"] * (float(controller.ki) > 0)
    limitations += ["it measures the angle on the motor's side of the backlash"] * joint.loose
    how = "; ".join(["gains and limit of voltage", *limitations])
    return EffectFate(CONTROLLER, APPROXIMATED if limitations else HELD, how)


def fates_outside_joint(joint: DriveJoint) -> list[EffectFate]:
    """Fates of effects that are not part of a joint."""
    place_by_effect = {
        "sensor": "an instrument error, not part of the drive",
        "supply": "the battery; reduce the command's voltage accordingly",
        "mass": "set the mass in the model",
    }
    other = "set the ground in the model"
    return [EffectFate(e.name, DROPPED, place_by_effect.get(e.balance, other)) for e in joint.outside]


def approximated_terms(balance: str) -> str:
    """Terms that replace an effect of a balance."""
    return "resistance" if balance in ("supply", "electrical") else "resistance, frictionloss and damping"


@dataclasses.dataclass(frozen=True)
class MjcfMotor:
    """Numbers of the MJCF.

    Attributes:
        values: refitted parameters by name [SI].
        ratio, inductance, armature: values of these attributes [-], [H], [kg·m²].
        added: inertia that effects add to the joint, part of the armature [kg·m²].
        thermal, lugre, cogging: attributes of `<dcmotor>` at the motor shaft, empty if it has none.
        limit: largest torque of the motor by its driver limit [N·m]. None: no limit.
    """

    values: Mapping[str, float]
    ratio: float
    inductance: float
    armature: float
    added: float = 0.0
    thermal: tuple[float, ...] = ()
    lugre: tuple[float, ...] = ()
    cogging: tuple[float, ...] = ()
    limit: float | None = None

    @property
    def friction(self) -> float:
        """Friction loss of the joint [N·m], without the part in `lugre`."""
        return self.values[FRICTION] - (self.lugre[2] * self.ratio if self.lugre else 0.0)


def mjcf_motor(joint: DriveJoint, values: Mapping[str, float]) -> MjcfMotor:
    """Numbers of the MJCF for refitted parameters."""
    robot, v = joint.robot, _law_numbers(joint, {})
    ratio, share = v["gearbox.ratio"], v["gearbox.efficiency_load"]
    inductance = (v["motor.inductance"] + v["effects.armature_inductance.amplitude"]) * values[SHARE]
    inertia = float(inertia_reduced(robot.motor.inertia, ratio, share, 0.0))
    thermal: tuple[float, ...] = ()
    if values.get(HEAT):
        capacity = v["effects.thermal_drift.time_constant"] / values[HEAT]
        thermal = (values[HEAT], capacity, 0.0, float(robot.motor.temperature_coefficient), 25.0, 25.0)
    lugre: tuple[float, ...] = ()
    bristle = max(v["effects.presliding.amplitude"], 0.0)
    excess = values.get(EXCESS, 0.0)
    if bristle or excess:
        # All dry friction goes through the bristle if it falls with speed, because its steady curve must end above 0.
        coulomb = max(values[FRICTION], LEAST_SHARE * excess) if excess else min(bristle, values[FRICTION])
        turn = v["effects.presliding.angle_breakaway"] or YIELD
        stiffness = (coulomb + excess) / turn
        fade = values.get(FADE, 1.0)
        lugre = (stiffness / ratio**2, 0.0, coulomb / ratio, (coulomb + excess) / ratio, fade * ratio)
    cogging: tuple[float, ...] = ()
    if amplitude := v["effects.cogging.amplitude"]:
        cogging = (-amplitude * share, v["effects.cogging.ripples"], v["effects.cogging.phase"])
    limit = None if joint.limit is None else values[CONSTANT] * joint.limit / values[SHARE]
    added = v["effects.rotating_inertia.amplitude"]
    return MjcfMotor(values, ratio, inductance, inertia + added, added, thermal, lugre, cogging, limit)


def _controller_gains(joint: DriveJoint, found: MjcfMotor) -> tuple[float, ...]:
    """Gains of the controller of `<dcmotor>`: kp, ki, kd of a torque, -, limits of integral and voltage.

    U = (R/K) (kp e + ki ∫ e dt - kd ω_m) + K ω_m, for the motor's angle. Empty if the command is a voltage.
    """
    controller = joint.controller
    if controller is None or joint.robot.rig.imposed != "goal_angle":
        return ()
    constant = found.values[CONSTANT]
    torque, volts = constant / found.values[RESISTANCE], controller.supply_voltage / found.ratio
    kp, ki, kd, limit = (float(x) for x in (controller.kp, controller.ki, controller.kd, controller.limit))
    return (
        volts * kp * torque, volts * ki * torque, (volts * kd + constant) * torque,
        0.0, limit * found.ratio / ki if ki else 0.0, controller.supply_voltage * limit,
    )  # fmt: skip


def _numbers_text(*numbers: float) -> str:
    return " ".join(f"{x:.9g}" for x in numbers)


#: Command that shows the scene. It has no double hyphen, which XML comments must not contain.
VIEWER = "python -c \"import mujoco.viewer as v; v.launch_from_path('scene.xml')\""


def _comment_lines(lines: Sequence[str], indent: str) -> str:
    """Lines as XML comments, escaped because names come from users and could end the comment."""
    text = [re.sub("-(?=-)", "- ", t) for line in lines for t in textwrap.wrap(printable(line), 104 - len(indent))]
    return "".join(f"{indent}<!-- {t} -->\n" for t in text)


def mjcf_fragment(
    joint: DriveJoint,
    found: MjcfMotor,
    about: Mapping[str, str],
    notes: Sequence[str],
    name: str,
    at: str,
    volts: float,
) -> str:
    """Text of the fragment that a model includes.

    Args:
        volts: highest voltage seen or allowed [V], which the control's range states but does not enforce.
        about: source and interval of each attribute, in words.
        notes: notes of the header.
        name: name of the actuator and the default class.
        at: name of the joint.
    """
    v, load = found.values, joint.load
    attributes = {
        "motorconst": (v[CONSTANT],), "resistance": (v[RESISTANCE],), "inductance": (found.inductance,),
        "thermal": found.thermal, "lugre": found.lugre, "cogging": found.cogging,
    }  # fmt: skip
    gains = _controller_gains(joint, found)
    head = [
        f"Drive of {joint.file.name}, {joint.configuration}. Written by mmrjax {__version__}; "
        f"MuJoCo {FIRST_TEXT} "
        f"or later.",
        f'In the model: <include file="drive.xml"/> before <worldbody>, and class="{name}" on the joint "{at}".',
        f"Command: goal angle of the motor [rad], {found.ratio:.6g} times that of the joint; MuJoCo 3.17 or later."
        if gains
        else "Command: voltage at the driver's output [V], its duty times the supply's voltage.",
        f"Current of the motor [A]: {v[SHARE]:.6g} times the actuator's last activation, or "
        f"{v[SHARE] / v[CONSTANT]:.6g} times its force.",
        *notes,
    ]
    about_motor = [
        f"{key}: {about[key]}" for key in ("gear", *(k for k, x in attributes.items() if x)) if key in about
    ]
    # A load that turns separately has its own friction, and the motor's side has the rest.
    numbers = [max(found.friction, 0.0), v[DAMPING], found.armature]
    sides, play = [("", *numbers)], dict[str, float]()
    if joint.loose:
        of_load = (load.loss_coulomb, load.loss_viscous, found.added)
        own = [min(x, float(y)) for x, y in zip(numbers, of_load, strict=True)]
        sides = [("", *own), ("_rotor", *(a - b for a, b in zip(numbers, own, strict=True)))]
        stiffness, damping = float(load.stiffness), float(load.damping)
        rate = 1 / (found.armature - found.added) + 1 / (float(load.inertia) + found.added)
        square, damper = (stiffness * rate, damping * rate) if stiffness > 0 else (FLANK_STIFFNESS, FLANK_DAMPING)
        play = {
            "half": 0.5 * float(load.backlash), "square": square, "damper": damper, "stiffness": stiffness,
            "damping": damping,
        }  # fmt: skip
    return filled_template(
        "drive.xml", joint=joint, at=at, name=name, text=_numbers_text, ratio=found.ratio, volts=volts,
        head=_comment_lines(head, "  "), about_motor=_comment_lines(about_motor, "    "),
        about_joint=_comment_lines([f"{k}: {about[k]}" for k in ("frictionloss", "damping", "armature")], "    "),
        sides=sides, attributes=attributes, gains=gains, limit=found.limit, impedance=IMPEDANCE, **play,
    )  # fmt: skip


def mjcf_scene(joint: DriveJoint, mass: float, name: str, at: str, command: float, load: float) -> str:
    """Text of a runnable model of one joint: the load of the drive is a body that turns with it.

    A vehicle rolls without sliding, so one side's share of its mass acts at the wheel as m r². The actuator
    `load` gives the torque of slope and ground.

    Args:
        mass: mass of the vehicle [kg].
        command, load: command and load of the key frame `run` [V or rad], [N·m].
    """
    body, head, arm = joint.load, "The rig's shaft", 0.05
    inertia, centre, own_mass = float(body.inertia), (0.0, 0.0, 0.0), 1.0
    own_inertia = inertia
    if joint.robot.has_ground:
        arm, sides = float(body.radius), float(joint.robot.sides)
        own_inertia += mass / sides * arm**2
        head = f"One side of the robot: its wheel, carrying 1/{sides:g} of {mass:.4g} kg"
    elif (weight := float(body.torque_gravity)) > 0:
        # the mass on its lever has half of the inertia
        gravity, angle = 9.81, float(body.angle_zero)  # MuJoCo's default
        lever = inertia * gravity / (2 * weight)
        own_mass = weight / (gravity * lever)
        own_inertia = inertia - own_mass * lever**2
        centre = lever * math.sin(angle), 0.0, -lever * math.cos(angle)
    return filled_template(
        "scene.xml", at=at, name=name, timestep="0.0005" if joint.loose else "0.001", text=_numbers_text,
        head=_comment_lines([f"{head}. Key frame run turns it. Viewer:", VIEWER], "  "), centre=centre,
        mass=own_mass, inertia=own_inertia, arm=arm, run=_numbers_text(command, load),
    )  # fmt: skip


def attribute_notes(
    constants: Sequence[LawConstant], translated: Mapping[str, float], values: Mapping[str, float]
) -> dict[str, str]:
    """Origin of each attribute in words, with intervals of the parameters from which it is computed."""
    by_name = {c.name: c for c in constants}

    def made_of(*names: str) -> str:
        parts = [by_name[n] for n in names if n in by_name]
        return "; ".join(
            f"{c.name} {c.value:.5g} {c.unit}".rstrip(" -") + (f", {c.interval}" if c.interval else "") for c in parts
        )

    def fitted(key: str) -> str:
        return f" (translated {translated[key]:.5g}, refitted to the native model {values[key]:.5g})"

    friction = [n for n in by_name if n.rpartition(".")[2] in ("friction_coulomb", "loss_coulomb", "guide_friction")]
    viscous = [n for n in by_name if n.rpartition(".")[2] in ("friction_viscous", "loss_viscous")]
    effects = lambda *names: [n for n in by_name if n.split(".")[1:2] and n.split(".")[1] in names]  # noqa: E731
    return {
        "gear": f"ratio motor to joint [-]; {made_of('gearbox.ratio')}",
        "motorconst": f"[N·m/A] = [V·s/rad]; {made_of('motor.torque_constant')}{fitted(CONSTANT)}",
        "resistance": "[ohm], resistance of winding and leads, divided by the gearbox's efficiency; "
        + made_of("motor.resistance", "gearbox.efficiency_load", *effects("series_resistance", "supply_sag"))
        + fitted(RESISTANCE),
        "inductance": f"[H], likewise; {made_of('motor.inductance', *effects('armature_inductance'))}",
        "frictionloss": f"[N·m] at the joint; {made_of(*friction)}{fitted(FRICTION)}",
        "damping": f"[N·m·s/rad] at the joint; {made_of(*viscous)}{fitted(DAMPING)}",
        "armature": f"[kg·m^2] at the joint; {made_of('motor.inertia', *effects('rotating_inertia'))}",
        "thermal": "thermal resistance [K/W], capacity [J/K], -, [1/K], two temperatures [C]; "
        + made_of(*effects("thermal_drift")),
        "lugre": "stiffness, damping, Coulomb and static friction, Stribeck speed, at the motor's shaft; "
        + made_of(*effects("presliding", *STRIBECK)),
        "cogging": f"amplitude [N·m], periods a turn, phase; {made_of(*effects('cogging'))}",
    }


def mujoco_module() -> Any:
    """Module of MuJoCo.

    Raises:
        BadConfiguration: MuJoCo is missing, or too old for `<dcmotor>`.
    """
    try:
        import mujoco as found
    except ImportError as error:
        raise BadConfiguration("--to mujoco: mujoco is not installed; pip install mujoco") from error
    if tuple(int(x) for x in found.__version__.split(".")[:3]) < FIRST:
        raise BadConfiguration(
            f"--to mujoco: got MuJoCo {found.__version__}, which has no <dcmotor>; "
            f"expected {FIRST_TEXT} or later: "
            "pip install -U mujoco"
        )
    found.set_mju_user_warning(lambda text: None)  # otherwise MuJoCo writes a file in the working folder
    return found


def _scene(files: Mapping[str, str]) -> tuple[Any, Any, Any]:
    """MuJoCo's module, the model of a scene with its fragment, and its data."""
    library = mujoco_module()
    model = library.MjModel.from_xml_string(files["scene.xml"], {name: text.encode() for name, text in files.items()})
    return library, model, library.MjData(model)


def angles_in_mujoco(
    files: Mapping[str, str], command: float, times: np.ndarray, timestep: float | None = None
) -> np.ndarray:
    """Angles of the joint [rad] at instants after a start from rest in MuJoCo C under a constant control.

    Args:
        timestep: time step [s]. None: that of the scene.
    """
    mujoco, model, data = _scene(files)
    model.opt.timestep = timestep or model.opt.timestep
    data.ctrl[0] = command
    angles = np.zeros(len(times))
    for k, time in enumerate(times):
        while data.time < time - 0.5 * model.opt.timestep:
            mujoco.mj_step(model, data)
        angles[k] = data.qpos[-1]
    return angles


def settle_in_mujoco(
    files: Mapping[str, str], found: MjcfMotor, at: ComparisonRuns, expected: JointResult, rows: Sequence[int]
) -> JointResult:
    """Current and speed of some runs, settled in MuJoCo C by the scene.

    Args:
        expected: values from the steady law, near which each run begins.
        rows: indices of the runs.
    """
    mujoco, model, data = _scene(files)
    model.opt.gravity[:] = 0  # an arm's weight is part of the stated load
    current, speed = np.empty(len(rows)), np.empty(len(rows))
    period = model.opt.timestep
    total = float(np.sum(model.dof_armature) + np.sum(model.body_inertia[:, 1]))
    turns = found.ratio * found.values[CONSTANT]
    settle = 12 * total * found.values[RESISTANCE] / turns**2
    steps = int(np.clip(settle / period, 500, 20_000))
    for k, row in enumerate(rows):
        mujoco.mj_resetData(model, data)
        data.ctrl[:] = at.command[row], at.load[row]
        data.qvel[:] = 0.9 * expected.speed[row]
        if found.thermal:  # in its settled state, as in the steady law
            heat = found.values[RESISTANCE] * (expected.current[row] / found.values[SHARE]) ** 2 * found.thermal[0]
            data.act[0] = heat / (1 - found.thermal[3] * heat)
        if model.na:
            data.act[-1] = expected.current[row] / found.values[SHARE]
        for _ in range(steps):
            mujoco.mj_step(model, data)
        current[k] = found.values[SHARE] * data.act[-1]
        speed[k] = data.qvel[-1]
    return JointResult(current, speed)
