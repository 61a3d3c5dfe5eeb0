"""Half a robot in motion: its state, all its forces at an instant, one time step, and its start.

MJX computes chassis and pulleys (5 degrees of freedom, `mjcf`). Grousers or wheels and guides (`side_contacts`), belt
(`running_gear`) and drive (`balances`) enter as generalized forces.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mmrjax.fidelities.base import result_of_signals, travel_status
from mmrjax.fidelities.drive import current_after
from mmrjax.fidelities.rest import STARTS, is_at_rest, status_with_slip, travel_direction, voltage_at_rest
from mmrjax.fidelities.steady import steady
from mmrjax.model import balances
from mmrjax.model.chassis import Chassis, inertia_reduced
from mmrjax.model.conditions import Conditions
from mmrjax.model.masses import HalfRobotMasses, masses_of_parts
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import (
    BATTERY_EMPTY,
    FAILED,
    GRAVITY,
    NOT_SETTLED,
    ROLLS_BACK,
    STALLED,
    TIPS,
    Result,
    Signals,
    State,
    is_done,
)
from mmrjax.numerics.linear_equations import Factors, Vector, factorise, solve_factorised
from mmrjax.numerics.newton import root
from mmrjax.undercarriage import contact_sums, mjcf, side_contacts
from mmrjax.undercarriage.contact_sums import LinearizedSums
from mmrjax.undercarriage.mjcf import mjx
from mmrjax.undercarriage.running_gear import BeltPath, belt_runs
from mmrjax.undercarriage.side_contacts import ContactPull, ContactState, GearReactions, contact_damping

#: Coordinates of half a robot, or their velocities or forces.
Coordinates = Float[Array, " 5"]

#: Coordinate of the driving pulley.
SHAFTS = 3
#: Pitch beyond which a robot has turned over [rad], and limit of a valid height [axle heights].
OVER, HIGH = 0.5, 20.0
#: Tolerance of `root` for the posture at rest, whose last step is then at most 6e-12 m and rad.
SUNK = 1e-16
SETTLED = 1e-3  # largest relative change of the speeds from one half of the window to the other
#: Changes of some signals, and their sizes.
Changes = Sequence[tuple[Scalar, Scalar]]
#: Function of the positions of a belt over time and a tree of samples. It returns means of signals (or
#: `balances.Travel`) and of the guides' load, the number of periods averaged, and change and size of three signals.
Average = Callable[[Array, tuple[Any, Array]], tuple[Any, Array, Array, Changes]]


class HalfRobotState(eqx.Module):
    """State of half a robot, which a time step advances.

    Attributes:
        q, v: coordinates and velocities, see `side_contacts`.
        current: current of one motor [A].
        discharge: charge taken from the battery [C].
        memory: memory of each effect that has one, by name.
    """

    q: Coordinates
    v: Coordinates
    current: Array
    discharge: Array
    memory: Mapping[str, Scalar] = eqx.field(default_factory=dict)


class SteadyAverages(eqx.Module):
    """Averages over the last whole grouser periods of a run.

    For a robot that turns, their first axis is the side, with a separate period for each.

    Attributes:
        signals: mean signals.
        guide_share: share of the normal reaction of the ground on the lower guides [-]. It is an output here and a
            parameter in the other fidelities.
        periods: number of grouser periods that were averaged [-]. 0: a fixed window, because the belt moved too
            little.
        change: largest relative change of current, motor speed and speed between the two halves of the window [-].
        travel: for a robot that turns, means of `balances.Travel`.
    """

    signals: Signals
    guide_share: Scalar
    periods: Int[Array, "..."]
    change: Scalar
    travel: balances.Travel | None = None


class HalfRobotSystem(eqx.Module):
    """Constants of one run that `instant` and `advance` need.

    Attributes:
        chassis: chassis of the configuration of the run.
        model, data: MJX model with the constants of this member, and MJX data of the same structure.
        step: interval of integration [s].
    """

    robot: Robot
    conditions: Conditions
    path: BeltPath
    half: HalfRobotMasses
    chassis: Chassis
    model: Any
    data: Any
    step: Scalar


def build_system(robot: Robot, conditions: Conditions, step: Scalar) -> HalfRobotSystem:
    """Constants of one run (scalar fields), for half a robot or a whole one. The robot may hold tracers."""
    half = masses_of_parts(robot, conditions, balances.mass_with_effects(robot, conditions))
    model, data = mjcf.model_template(conditions.turns)
    model = mjcf.member_model(model, mjcf.robot_bodies(robot, half, conditions), conditions.slope, step)
    path = BeltPath(robot.radius_pulley, robot.running_gear)
    chassis = robot.chassis(conditions.configuration)
    return HalfRobotSystem(robot, conditions, path, half, chassis, model, data, jnp.asarray(step, float))


class _SideContacts(eqx.Module):
    path: BeltPath
    contacts: ContactState
    height: Scalar

    @property
    def normal(self) -> Scalar:
        return self.contacts.normal

    def pull(self, chassis: Chassis, signals: Signals) -> ContactPull:
        return side_contacts.contact_forces(self.path, chassis, signals, self.contacts, self.height)


def instant(run: HalfRobotSystem, motion: HalfRobotState) -> tuple[Signals, ContactState, ContactPull]:
    """All signals, contacts and forces of an instant."""
    contacts = side_contacts.compute_contacts(run.path, run.chassis, motion.q, motion.v)
    signals, contact_forces = _resolve_signals(
        run, motion, _SideContacts(run.path, contacts, motion.q[1]), motion.v[0], motion.v[3]
    )
    return signals, contacts, contact_forces


def _resolve_signals(
    run: HalfRobotSystem, motion: HalfRobotState, mover: balances.Mover, speed: Scalar, speed_shaft: Scalar
) -> tuple[Signals, Any]:
    """Signals and forces of these contacts at a speed of the robot [m/s] and of the driving shaft [rad/s]."""
    ratio = run.robot.gearbox.ratio
    state = State(motion.current, ratio * speed_shaft, speed, motion.discharge, motion.memory)
    return balances.resolved_signals(run.robot, run.conditions, state, mover, run.half.inertia_pulley)


def _loss_derivatives(run: HalfRobotSystem, motion: HalfRobotState, mover: balances.Mover) -> tuple[Scalar, Scalar]:
    """Derivative of the ground's resistance with respect to the robot's speed [N·s/m], and of the drive's losses with
    respect to the speed of the driving shaft [N·m·s]. Negative ones are set to 0.
    """

    def longitudinal_force(speed: Scalar) -> Scalar:
        signals, contact_forces = _resolve_signals(run, motion, mover, speed, motion.v[3])
        return contact_forces.traction - signals.resistance

    def shaft_torque(speed: Scalar) -> Scalar:
        return _resolve_signals(run, motion, mover, motion.v[0], speed)[0].torque_net

    one = jnp.ones_like(motion.v[0])
    force_slope, torque_slope = (
        jax.jvp(f, (motion.v[k],), (one,))[1] for f, k in ((longitudinal_force, 0), (shaft_torque, 3))
    )
    return jnp.maximum(-force_slope, 0.0), jnp.maximum(-torque_slope, 0.0)


def generalized_forces(
    run: HalfRobotSystem, signals: Signals, contact_forces: ContactPull
) -> tuple[Coordinates, Coordinates]:
    """Generalized forces on q [N, N·m], and inertia of the armature at each joint [kg·m²], eq. (31)."""
    force = jnp.insert(contact_forces.generalized, 3, signals.torque_net)
    return force, jnp.zeros_like(force).at[3].set(armature_inertia(run, signals))


def armature_inertia(run: HalfRobotSystem, signals: Signals) -> Any:
    """Inertia of the armature at the driving shaft [kg·m²], eq. (31)."""
    rotor_inertia, ratio = run.robot.motor.inertia, run.robot.gearbox.ratio
    return inertia_reduced(rotor_inertia, ratio, signals.efficiency_load, signals.inertia_added)


def damping_matrix(
    run: HalfRobotSystem,
    motion: HalfRobotState,
    signals: Signals,
    contacts: ContactState,
    contact_forces: ContactPull,
) -> Float[Array, "5 5"]:
    """Damping matrix K of a step: decrease of the forces on v with v.

    Friction rises with sliding and is proportional to the normal force, which falls with the rate of the gap:
    K = Σ k g gᵀ + d (μ g + h) hᵀ. Here g and h are the changes of a contact's speed along the ground and off it with
    v. Friction that falls with sliding, beyond V_s, is an instability of the robot and not of the step. It is left
    out. The drive's losses and the resistance of the ground rise steeply from rest and are on K's diagonal.
    """
    losses = _loss_derivatives(run, motion, _SideContacts(run.path, contacts, motion.q[1]))
    sliding = side_contacts.sliding_speeds(signals, contacts)
    rises = jnp.maximum(run.chassis.ground.traction_rise(sliding, contacts.force, signals.adhesion), 0.0)
    front, rear = run.path.radius * (1 - contacts.weight), run.path.radius * contacts.weight
    one, zero = jnp.ones_like(rises), jnp.zeros_like(rises)
    along = jnp.stack([one, zero, contacts.lever_z, contacts.rate_x * front, contacts.rate_x * rear], axis=1)
    off = jnp.stack([zero, one, -contacts.lever_x, contacts.rate_z * front, contacts.rate_z * rear], axis=1)
    zero = jnp.zeros_like(losses[0])
    diagonal = jnp.diag(jnp.stack([losses[0], zero, zero, losses[1], zero]))
    return contact_damping(along, off, contact_forces.force, contacts.force, rises, contacts.damped) + diagonal


def _explicit_step(
    run: HalfRobotSystem, motion: HalfRobotState, signals: Signals, contact_forces: ContactPull
) -> tuple[Coordinates, Float[Array, "5 5"]]:
    """Velocities after one explicit step, and the mass matrix."""
    force, armature = generalized_forces(run, signals, contact_forces)
    data = run.data.replace(qpos=motion.q, qvel=motion.v, qfrc_applied=force)
    model = run.model.replace(dof_armature=armature)
    data = mjx.step(model, data)
    return data.qvel, mjx.full_m(model, data)


def mass_matrix(run: HalfRobotSystem, motion: HalfRobotState) -> Float[Array, "5 5"]:
    """Mass matrix M on v, including the rotors' armature [kg, kg·m, kg·m²]."""
    signals, _, contact_forces = instant(run, motion)
    return _explicit_step(run, motion, signals, contact_forces)[1]


class _StepFactors(eqx.Module):
    """A computed time step, with the quantities of its derivatives: K, factors of M + Δt K, and Δv."""

    after: HalfRobotState
    signals: Signals
    guided: Scalar
    damping: Float[Array, "5 5"]
    factors: Factors
    velocity_change: Coordinates
    slip: Scalar


def _implicit_step(run: HalfRobotSystem, motion: HalfRobotState) -> _StepFactors:
    signals, contacts, contact_forces = instant(run, motion)
    explicit_velocity, mass = _explicit_step(run, motion, signals, contact_forces)
    damping = damping_matrix(run, motion, signals, contacts, contact_forces)
    factors = factorise(mass + run.step * damping)
    velocity_change = solve_factorised(factors, mass @ (explicit_velocity - motion.v))
    after, signals_of_step = _state_after_motion(
        motion,
        run.step,
        other_states_after_step(run, motion, signals),
        damping @ velocity_change,
        velocity_change,
        signals,
    )
    return _StepFactors(
        after, signals_of_step, contact_forces.guided, damping, factors, velocity_change, signals.speed_slip_terms
    )


def other_states_after_step(
    run: HalfRobotSystem, motion: HalfRobotState, signals: Signals
) -> tuple[Scalar, Scalar, dict[str, Scalar]]:
    """Currents, charge and memories after one time step."""
    charge = balances.charge_drawn(run.robot, run.conditions, signals.total_current)
    memory = {
        effect.name: motion.memory[effect.name] + run.step * effect.rate(run.robot, signals)
        for effect in run.robot.remembering
    }
    current = current_after(run.robot, run.conditions, run.step, signals)
    return current, motion.discharge + run.step * charge, memory


def _state_after_motion(
    motion: HalfRobotState,
    step: Scalar,
    other_states: tuple[Any, ...],
    damping_force: Array,
    velocity_change: Array,
    signals: Signals,
) -> tuple[HalfRobotState, Signals]:
    v = motion.v + velocity_change
    after = HalfRobotState(motion.q + step * v, v, *other_states)
    traction, normal = signals.traction - damping_force[0], signals.normal - damping_force[1]
    return after, replace(signals, traction=traction, normal=normal, acceleration=velocity_change[0] / step)


@eqx.filter_custom_jvp
def advance(run: HalfRobotSystem, motion: HalfRobotState) -> tuple[HalfRobotState, Signals, Scalar]:
    """One step of MJX (semi-implicit Euler) and of the winding.

    Forces of the contacts are those at the end of the step as far as they depend on v, to first order. So (M + Δt K)
    Δv = Δt M a with MJX's mass matrix M and acceleration a (linearly implicit Euler; Hairer and Wanner 1996, IV.7).
    Within V_s the time constant of a contact is m V_s / (μ_s R_z), microseconds for a small V_s.

    Derivatives are those of the step as computed, written once. With Δv constant, the residual of
    Δt τ - Δt c - (M + Δt K) Δv = 0 is differentiated (τ: forces of `generalized_forces`, c: MJX's bias). The same
    factors solve for the change of Δv.

    Returns:
        The motion after it. The signals before it, with traction, normal load and acceleration of the step. The
        load on the lower guide before it [N].
    """
    step = _implicit_step(run, motion)
    return step.after, step.signals, step.guided


@advance.def_jvp
def _differentiated(
    primals: tuple[HalfRobotSystem, HalfRobotState], tangents: tuple[Any, Any]
) -> tuple[tuple[HalfRobotState, Signals, Scalar], tuple[HalfRobotState, Signals, Scalar]]:
    run, motion = primals
    step = _implicit_step(run, motion)
    # The model's constants follow from the rest of the run.
    run, d_run = (replace(x, model=None, data=None) for x in (run, tangents[0]))
    d_motion = tangents[1]
    # the contacts' sums with derivatives with respect to the motion and to the `changed` inputs
    constants = contact_sums.contact_inputs(d_run.path, d_run.chassis, d_run.conditions.adhesion)
    differentiated = tuple(name for name, change in constants.items() if change is not None)
    contact_inputs = _contact_inputs(run, motion) | {"slip": step.slip}
    linearized = contact_sums.linearize(run.path, run.chassis, contact_inputs, step.velocity_change, differentiated)
    (residual, damping_force, other_states, signals, _), d_residual = eqx.filter_jvp(
        lambda run, motion: _step_residual(run, motion, step.velocity_change, linearized),
        (run, motion),
        (d_run, d_motion),
    )
    d_momentum, d_damping_force, d_other_states, d_signals, d_guided = d_residual
    # None: the differentiated quantity does not enter.
    d_velocity_change = jnp.zeros_like(residual) if d_momentum is None else solve_factorised(step.factors, d_momentum)
    damping_of_change = step.damping[:2] @ d_velocity_change
    d_damping_force = damping_of_change if d_damping_force is None else d_damping_force + damping_of_change
    _, (d_after, d_signals_of_step) = eqx.filter_jvp(
        _state_after_motion,
        (motion, run.step, other_states, damping_force, step.velocity_change, signals),
        (d_motion, d_run.step, d_other_states, d_damping_force, d_velocity_change, d_signals),
    )
    return (step.after, step.signals, step.guided), (d_after, d_signals_of_step, d_guided)


def _contact_inputs(run: HalfRobotSystem, motion: HalfRobotState) -> dict[str, Scalar]:
    """Inputs of the contacts, by name."""
    motion_inputs = dict(zip(contact_sums.MOTION, (*motion.q[1:], *motion.v), strict=True))
    return motion_inputs | contact_sums.contact_inputs(run.path, run.chassis, run.conditions.adhesion)


def _step_residual(
    run: HalfRobotSystem, motion: HalfRobotState, velocity_change: Coordinates, linearized: LinearizedSums
) -> tuple[Array, Array, tuple[Any, ...], Signals, Scalar]:
    """Residual of a time step at constant Δv, K Δv of x and z, and the other results of the step.

    The residual is Δt τ - Δt c - (M + Δt K) Δv, see `advance`.
    """
    q, v = motion.q, motion.v
    belt = belt_runs(run.path, (q[3], q[4]), (v[3], v[4]))
    sums = linearized.near(_contact_inputs(run, motion))
    mover = contact_sums.SummedContacts(linearized, sums, run.path.radius, belt.torque_front)
    signals, contact_forces = _resolve_signals(run, motion, mover, v[0], v[3])
    sums = mover.shifted(signals.speed_slip_terms)
    losses = [
        loss * velocity_change[k] for k, loss in zip((0, 3), _loss_derivatives(run, motion, mover), strict=True)
    ]
    force = jnp.stack(
        [
            contact_forces.traction - signals.resistance - sums.reduction_x - losses[0],
            sums.normal - sums.reduction_z,
            contact_forces.moment + signals.resistance * q[1],
            signals.torque_net - sums.reduction_front - losses[1],
            contact_forces.rear + belt.torque_rear,
        ]
    )
    gear = run.path.gear
    armature = armature_inertia(run, signals)
    impulse = mjcf.step_impulse(
        run.half, gear.wheelbase, run.conditions, q[2], v[2], armature, velocity_change, run.step
    )
    damping_force = jnp.stack([sums.reduction_x + losses[0], sums.reduction_z])
    return (
        run.step * force - impulse,
        damping_force,
        other_states_after_step(run, motion, signals),
        signals,
        contact_forces.guided,
    )


def tipping_margin(run: HalfRobotSystem) -> Scalar:
    """Distance of the line of gravity inside the outermost contacts [m]. Negative: the robot tips."""
    forward, up, _ = centre_of_mass(run)
    foot = forward - jnp.tan(run.conditions.slope) * (up + axle_height(run))
    return run.path.gear.wheelbase / 2 - jnp.abs(foot)


def centre_of_mass(run: HalfRobotSystem) -> tuple[Scalar, Scalar, Scalar]:
    """Centre of mass ahead of and above the middle of the wheelbase [m], and the mass of half a robot [kg]."""
    return *run.half.centre, run.half.chassis + 2 * run.half.pulley


def axle_height(run: HalfRobotSystem) -> Scalar:
    """Height of the axles over the ground with the contacts just touching [m]."""
    tracked = run.path.radius + run.path.gear.grouser_height
    return jnp.where(run.chassis.on_tracks > 0.5, tracked, run.chassis.radius)


def stand(run: HalfRobotSystem, pulley_angle: Scalar = 0.0) -> HalfRobotState:
    """Initial motion: at rest, with the weight on the contacts: a root in height and pitch.

    The search starts with every contact that could carry load touching, because from there it does not overshoot.
    `newton.root` takes 0.14 times the time of the 30 steps of a loop of our own (256 runs, 2026-11-28). Optimistix's
    `Newton` takes 0.22 times, and `LevenbergMarquardt` twice. A robot that tips starts level, its lowest contacts
    just touching.

    Args:
        pulley_angle: angle of both pulleys [rad], which gives the position of the belt.
    """
    forward, up, mass = centre_of_mass(run)
    weight = mass * GRAVITY
    cos, sin = jnp.cos(run.conditions.slope), jnp.sin(run.conditions.slope)
    axle = axle_height(run)
    at_rest = jnp.zeros(5, jnp.result_type(axle))

    def coordinates(pulley_angle: Scalar, height: Scalar, pitch: Scalar) -> Coordinates:
        return jnp.zeros_like(at_rest).at[3:5].set(pulley_angle).at[1].set(height).at[2].set(pitch)

    def imbalance(y: Vector, _: None, inputs: tuple[Any, ...]) -> Vector:
        path, chassis, pulley_angle, weight, forward, up, axle, cos, sin = inputs
        contacts = side_contacts.compute_contacts(
            path, chassis, coordinates(pulley_angle, axle - y[0], y[1]), jnp.zeros_like(at_rest)
        )
        moment = weight * (cos * (forward + y[1] * up) - sin * (up + axle)) - jnp.sum(
            contacts.force * contacts.lever_x
        )
        return (contacts.normal - weight * cos) / weight, moment / weight

    recess = jnp.maximum(run.path.gear.guide_recess, 0.0) * run.chassis.on_tracks
    contact_geometry = run.path, run.chassis, pulley_angle, weight, forward, up, axle, cos, sin
    (sinkage, pitch), _ = root(imbalance, (2e-4 + recess, jnp.zeros_like(recess)), None, contact_geometry, SUNK, None)
    is_stable = tipping_margin(run) > 0
    q = coordinates(pulley_angle, axle - jnp.where(is_stable, sinkage, 0.0), jnp.where(is_stable, pitch, 0.0))
    memory = {effect.name: jnp.zeros_like(axle) for effect in run.robot.remembering}
    return HalfRobotState(q, at_rest, jnp.zeros_like(axle), run.conditions.discharge * jnp.ones_like(axle), memory)


def roll(run: HalfRobotSystem) -> HalfRobotState:
    """Initial motion: rolling at the speed of the steady fidelity, or at the no-load speed if there is none.

    Derivatives pass through it, so that the derivatives of a short run include its start.
    """
    start = stand(run)
    steady_travel = steady(run.robot, run.conditions)
    is_travelling = is_done(steady_travel.status) | (steady_travel.status == ROLLS_BACK)
    ratio = run.robot.gearbox.ratio
    radius = run.chassis.radius
    no_load_speed = voltage_at_rest(run.robot, run.conditions) / run.robot.motor.torque_constant
    speed_wheel = steady_travel.theoretical_speed / radius  # the reading may include a sensor's error
    motor_speed = jnp.where(is_travelling, ratio * speed_wheel, no_load_speed)
    speed = jnp.where(
        is_travelling, steady_travel.theoretical_speed * (1 - steady_travel.slip), radius * no_load_speed / ratio
    )
    current = jnp.where(is_travelling, steady_travel.reading["total_current"] / run.robot.sides, 0.0)
    v = jnp.zeros(5, start.q.dtype).at[0].set(speed).at[3:5].set(motor_speed / ratio)
    start = replace(start, v=v, current=current)
    signals, _, _ = instant(run, start)  # memories of effects are settled too
    memory = {e.name: e.settled(run.robot, signals) * jnp.ones_like(current) for e in run.robot.remembering}
    return replace(start, memory=memory)


def loads(run: HalfRobotSystem, contacts: ContactState, contact_forces: ContactPull) -> GearReactions:
    """Loads inside the running gear at an instant."""
    return side_contacts.inner_loads(run.path, contacts, contact_forces)


def distance_and_reactions(q: Array, reactions: GearReactions) -> tuple[Array, GearReactions | None]:
    """Distance that a robot has travelled [m], and the loads inside its running gear."""
    return q[..., 0], reactions


def steady_averages(average: Average, travelled: Array, samples: Any, guide_loads: Array) -> SteadyAverages:
    """Averages at the end of a run, from its record."""
    signals, guide_load, periods, changes = average(travelled, (samples, guide_loads))
    return SteadyAverages(
        signals, guide_load / jnp.maximum(signals.normal, 1e-9), periods, jnp.max(relative_changes(changes))
    )


def relative_changes(changes: Changes) -> Array:
    """Changes relative to the sizes of the quantities [-]."""
    return jnp.stack([change / jnp.maximum(size, 1e-3) for change, size in changes])


def status(run: HalfRobotSystem, averages: SteadyAverages, end: HalfRobotState) -> Array:
    """Status of a run from its averages and its last motion."""
    robot, conditions, signals = run.robot, run.conditions, averages.signals
    status = jnp.where(averages.change > SETTLED, NOT_SETTLED, travel_status(signals.speed, signals.voltage))
    sense = travel_direction(robot, conditions)
    speed_still = robot.chassis(conditions.configuration).speed_still
    at_rest = is_at_rest(
        sense, voltage_at_rest(robot, conditions), signals.speed_theoretical, signals.speed, speed_still
    )
    parked = (jnp.abs(signals.direction) < 0.999) | (at_rest & (sense * signals.acceleration < STARTS))
    status = jnp.where(parked, STALLED, status)
    # On average over the window.
    status = status_with_slip(
        status, robot, signals, signals.acceleration * jnp.sign(signals.direction), 1e-2, at_rest
    )
    status = jnp.where(robot.battery.emptied(conditions.battery, end.discharge), BATTERY_EMPTY, status)
    status = jnp.where(tipping_margin(run) < 0, TIPS, status)
    return status_unless_lost(run, status, end, end.q[1], jnp.abs(end.q[2]), signals.total_current)


def status_unless_lost(
    run: HalfRobotSystem, status: Array, end: HalfRobotState, height: Array, tilt: Array, current: Scalar
) -> Array:
    """Status of a run, replaced by `tips` or `failed` if the robot has left the ground, sunk into it or turned over.

    The numbers of such a run are not valid.

    Args:
        run: the run.
        status: status otherwise.
        end: its last motion.
        height: height of the middle of the wheelbase [m].
        tilt: tilt of the robot, at least 0 [rad].
        current: current of the motors [A].
    """
    axle = axle_height(run)
    is_finite = jnp.all(jnp.isfinite(end.q)) & jnp.all(jnp.isfinite(end.v)) & jnp.isfinite(current)
    is_overturned = (tilt > OVER) & (tilt < 2 * jnp.pi)
    status = jnp.where(is_overturned & (jnp.abs(height) < HIGH * axle), TIPS, status)
    is_on_ground = (jnp.abs(height - axle) < 0.5 * axle) & (tilt < OVER)
    return jnp.where(is_finite & (is_on_ground | (status == TIPS)), status, FAILED)


def result_of(run: HalfRobotSystem, averages: SteadyAverages, status: Array) -> Result:
    return result_of_signals(run.robot, averages.signals, status)
