"""A whole robot free to turn, in motion: its state, all its forces at an instant, one time step, and its start.

Coordinates q begin with place x uphill and y to the left [m], and height z of the middle of the wheelbase over the
ground [m]. Then come yaw, pitch (nose down) and roll (left side up) [rad]. The last are the angles of driving and
driven pulley of the left and of the right side [rad], relative to the chassis. Velocities v are their rates. MJX
computes chassis and pulleys (`mjcf`). Each side has the belt, contacts and drive of the half robot (`side_contacts`,
`balances.resolved_sides`), at its own height z + y_s roll and speed v_x - ω y_s. The law of each contact is
`two_sides.ContactLaw` instead of Fig. 7. Roll is small.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mmrjax.model import balances
from mmrjax.model.chassis import Chassis
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Pair, Scalar
from mmrjax.model.signals import CONVERGED, NOT_SETTLED, PlaneMotion, Result, Signals
from mmrjax.numerics.elementary import cosine, sine
from mmrjax.numerics.linear_equations import factorise, solve_factorised
from mmrjax.turning import circling
from mmrjax.turning.two_sides import SIDES, ContactLaw, GroundForces
from mmrjax.undercarriage import half_robot, side_contacts
from mmrjax.undercarriage.half_robot import Average, HalfRobotState, HalfRobotSystem, SteadyAverages
from mmrjax.undercarriage.mjcf import mjx
from mmrjax.undercarriage.running_gear import BeltPath
from mmrjax.undercarriage.side_contacts import ContactPull, ContactState, GearReactions

#: Coordinates of the robot, or their velocities or forces.
Coordinates = Float[Array, " 10"]

X, Y, HEIGHT, YAW, PITCH, ROLL = range(6)
#: Driving and driven pulley of left and right side.
PULLEYS = np.array([[6, 7], [8, 9]])
SHAFTS = PULLEYS[:, 0]
COORDINATES = 10
#: Coordinates of the motion in the plane of the ground.
PLANE = np.array([X, Y, YAW])
#: Coordinates that the contacts of left and right side act on.
OF_SIDE = np.array([[*range(6), *pulleys] for pulleys in PULLEYS])


class _ContactsOfSides(eqx.Module):
    """Contacts of both sides, first axis left and right, in the form that `balances.resolved_sides` expects."""

    path: BeltPath
    law: ContactLaw
    lateral: Scalar
    contacts: ContactState
    lateral_speed: Float[Array, "2 contacts"]  # velocity of each contact to the left [m/s]
    height: Pair

    @property
    def normal(self) -> Pair:
        return jnp.sum(self.contacts.force, axis=-1)

    def pull(self, chassis: Chassis, signals: Signals) -> ContactPull:
        def side(signals: Signals, contacts: ContactState, lateral_speed: Array, height: Scalar) -> ContactPull:
            sliding = side_contacts.sliding_speeds(signals, contacts)
            friction_force = signals.adhesion * contacts.force * self.law.per_speed(sliding**2, lateral_speed**2)
            forces = side_contacts.contact_forces(
                self.path, chassis, signals, contacts, height, friction_force * sliding
            )
            return replace(forces, aside=-self.lateral * friction_force * lateral_speed)

        return jax.vmap(side)(signals, self.contacts, self.lateral_speed, self.height)


def _side_offsets(run: HalfRobotSystem) -> Pair:
    """Distances of the sides to the left of the middle of the robot [m]."""
    return jnp.asarray(SIDES * run.chassis.turning.width)


def _yaw_cosine_and_sine(motion: HalfRobotState) -> tuple[Array, Array]:
    """Cosine and sine of the yaw angle."""
    return cosine(motion.q[YAW]), sine(motion.q[YAW])


def _mid_wheelbase_speeds(motion: HalfRobotState, v: Coordinates) -> tuple[Array, Array]:
    """Speeds of the middle of the wheelbase, ahead and to the left, in the frame of the robot [m/s]."""
    cos, sin = _yaw_cosine_and_sine(motion)
    return cos * v[X] + sin * v[Y], cos * v[Y] - sin * v[X]


def plane_motion(run: HalfRobotSystem, motion: HalfRobotState) -> PlaneMotion:
    """Motion in the form of the other fidelities: speeds of the centre of mass of a level robot."""
    q, v = motion.q, motion.v
    speed, lateral_speed = _mid_wheelbase_speeds(motion, v)
    forward, up = run.half.centre
    return PlaneMotion(
        current=motion.current,
        speed_motor=run.robot.gearbox.ratio * v[SHAFTS],
        speed=speed,
        speed_lateral=lateral_speed + forward * v[YAW] - up * v[ROLL],
        yaw_rate=v[YAW],
        heading=q[YAW],
        place_x=q[X],
        place_y=q[Y],
        discharge=motion.discharge,
        memory=motion.memory,
    )


def _contacts_of_sides(run: HalfRobotSystem, motion: HalfRobotState) -> _ContactsOfSides:
    q, v = motion.q, motion.v
    speed, lateral_speed = _mid_wheelbase_speeds(motion, v)
    y = _side_offsets(run)
    heights, height_rates = q[HEIGHT] + y * q[ROLL], v[HEIGHT] + y * v[ROLL]
    zeros = jnp.zeros_like(y)
    side_q = jnp.stack([zeros, heights, q[PITCH] + zeros, *q[PULLEYS].T], axis=1)
    side_v = jnp.stack([speed - v[YAW] * y, height_rates, v[PITCH] + zeros, *v[PULLEYS].T], axis=1)
    contacts = jax.vmap(lambda q, v: side_contacts.compute_contacts(run.path, run.chassis, q, v))(side_q, side_v)
    turning = run.chassis.turning
    ratio = balances.lateral_friction(run.conditions, run.chassis)
    rule = turning.rule
    law = ContactLaw(run.chassis.ground.friction, ratio ** (2 * rule - 2), run.chassis.on_tracks, turning.nodes)
    lateral_speeds = lateral_speed + v[YAW] * contacts.lever_x - v[ROLL] * contacts.lever_z
    return _ContactsOfSides(run.path, law, ratio**rule, contacts, lateral_speeds, heights)


def _resolve_signals(
    run: HalfRobotSystem, motion: PlaneMotion, contacts_of_sides: _ContactsOfSides
) -> tuple[Signals, ContactPull]:
    return balances.resolved_sides(run.robot, run.conditions, motion, contacts_of_sides, run.half.inertia_pulley)


def instant(run: HalfRobotSystem, motion: HalfRobotState) -> tuple[Signals, ContactState, ContactPull]:
    """All signals, contacts and forces of an instant. The first axis is the side: left, right."""
    contacts_of_sides = _contacts_of_sides(run, motion)
    signals, contact_forces = _resolve_signals(run, plane_motion(run, motion), contacts_of_sides)
    return signals, contacts_of_sides.contacts, contact_forces


def _loss_derivatives(
    run: HalfRobotSystem, motion: PlaneMotion, contacts_of_sides: _ContactsOfSides
) -> Float[Array, "2 2"]:
    """Derivatives of resistance and losses as in `half_robot`, with respect to the speed of each side and of its
    driving shaft.
    """

    def longitudinal_force(change: Scalar) -> Array:
        signals, contact_forces = _resolve_signals(
            run, replace(motion, speed=motion.speed + change), contacts_of_sides
        )
        return jnp.sum(contact_forces.force, axis=-1) - signals.resistance

    def shaft_torque(change: Scalar) -> Array:
        speed_motor = motion.speed_motor + run.robot.gearbox.ratio * change
        return _resolve_signals(run, replace(motion, speed_motor=speed_motor), contacts_of_sides)[0].torque_net

    zero, one = jnp.zeros_like(motion.speed), jnp.ones_like(motion.speed)
    return jnp.stack([jnp.maximum(-jax.jvp(f, (zero,), (one,))[1], 0.0) for f in (longitudinal_force, shaft_torque)])


#: Motion of each contact along the robot, to its left and off the ground, per velocity of `OF_SIDE`, each of shape
#: (2, contacts, 8).
_ContactLevers = tuple[Array, Array, Array]


def _contact_levers(run: HalfRobotSystem, motion: HalfRobotState, contacts: ContactState) -> _ContactLevers:
    cos, sin = _yaw_cosine_and_sine(motion)
    one = jnp.ones_like(contacts.gap)
    y = _side_offsets(run)[:, None]
    zero = jnp.zeros_like(one)
    front, rear = run.path.radius * (1 - contacts.weight), run.path.radius * contacts.weight
    x, z = contacts.lever_x, contacts.lever_z
    along: list[Any] = [
        cos * one,
        sin * one,
        zero,
        -y * one,
        z,
        zero,
        contacts.rate_x * front,
        contacts.rate_x * rear,
    ]
    across: list[Any] = [-sin * one, cos * one, zero, x, zero, -z, zero, zero]
    off: list[Any] = [zero, zero, one, zero, -x, y * one, contacts.rate_z * front, contacts.rate_z * rear]
    return jnp.stack(along, axis=-1), jnp.stack(across, axis=-1), jnp.stack(off, axis=-1)


def generalized_forces(
    run: HalfRobotSystem,
    motion: HalfRobotState,
    signals: Signals,
    contacts: ContactState,
    contact_forces: ContactPull,
) -> Coordinates:
    """Generalized forces on q [N, N·m]."""
    cos, sin = _yaw_cosine_and_sine(motion)
    y = _side_offsets(run)
    motors_per_side = run.robot.sides / 2
    assert contact_forces.aside is not None
    moment_lateral = jnp.sum(contact_forces.aside * (contacts.lever_x - run.half.centre[0]), axis=-1)
    lateral, yaw = balances.lateral_and_yaw_effects(run.robot, replace(signals, moment_lateral=moment_lateral))
    forward, normal, moment, rear = contact_forces.generalized.T
    force_ahead, force_aside = (
        motors_per_side * jnp.sum(forward),
        motors_per_side * jnp.sum(contact_forces.aside) - lateral,
    )
    yaw_moment = motors_per_side * (jnp.sum(contact_forces.aside * contacts.lever_x) - y @ forward) - yaw
    roll_moment = motors_per_side * (y @ normal - jnp.sum(contact_forces.aside * contacts.lever_z))
    body_forces = [
        cos * force_ahead - sin * force_aside,
        sin * force_ahead + cos * force_aside,
        motors_per_side * jnp.sum(normal),
        yaw_moment,
    ]
    shaft_torques = motors_per_side * signals.torque_net, motors_per_side * rear
    pulley_torques = [x[k] for k in range(2) for x in shaft_torques]
    return jnp.stack([*body_forces, motors_per_side * jnp.sum(moment), roll_moment, *pulley_torques])


def damping_matrix(
    run: HalfRobotSystem,
    motion: HalfRobotState,
    signals: Signals,
    contacts_of_sides: _ContactsOfSides,
    contact_forces: ContactPull,
) -> tuple[Float[Array, "10 10"], _ContactLevers, Array]:
    """Damping matrix K of the forces on v, see `half_robot.damping_matrix`, with friction in both directions.

    Also returns the levers, and the rise of each contact's forces with its sliding [N·s/m], shape (2, 2, 2,
    contacts).
    """
    levers = _contact_levers(run, motion, contacts_of_sides.contacts)
    contacts = contacts_of_sides.contacts
    along, across, off = levers
    assert contact_forces.aside is not None
    sliding = jax.vmap(side_contacts.sliding_speeds)(signals, contacts)
    weight = signals.adhesion[:, None] * contacts.force
    rises = jnp.stack(
        [jnp.stack(row) for row in contacts_of_sides.law.rises(sliding, -contacts_of_sides.lateral_speed)]
    )
    rises = rises * jnp.stack([weight, contacts_of_sides.lateral * weight])[:, None]
    force_least = jnp.maximum(contacts.force, 1e-9)
    all_levers = jnp.concatenate(levers, axis=1)
    falls = contacts.damped[..., None] * off
    pushes = [
        rises[k, 0][..., None] * along + rises[k, 1][..., None] * across + (f / force_least)[..., None] * falls
        for k, f in enumerate((contact_forces.force, contact_forces.aside))
    ]
    side_matrices = jnp.einsum("sci,scj->sij", all_levers, jnp.concatenate([*pushes, falls], axis=1))
    losses = _loss_derivatives(run, plane_motion(run, motion), contacts_of_sides)
    # Rolling resistance acts at each side, along the robot.
    cos, sin = _yaw_cosine_and_sine(motion)
    robot_damping = jnp.zeros((COORDINATES, COORDINATES), motion.v.dtype)
    for k, y in enumerate(_side_offsets(run)):
        direction = jnp.zeros(8).at[PLANE].set(jnp.stack([cos, sin, -y]))
        side_damping = side_matrices[k] + losses[0, k] * jnp.outer(direction, direction)
        side_damping = side_damping.at[6, 6].add(losses[1, k])
        robot_damping = robot_damping.at[np.ix_(OF_SIDE[k], OF_SIDE[k])].add(side_damping)
    return run.robot.sides / 2 * robot_damping, levers, rises


def mass_matrix_and_bias(
    run: HalfRobotSystem, motion: HalfRobotState, armature: Pair
) -> tuple[Float[Array, "10 10"], Coordinates]:
    """Mass matrix and bias force of MJX. The mass matrix includes the rotors' `armature` at the driving shafts
    [kg·m²].
    """
    model = run.model.replace(dof_armature=jnp.zeros(COORDINATES).at[SHAFTS].set(armature))
    data = run.data.replace(qpos=motion.q, qvel=motion.v)
    data = mjx.com_pos(model, mjx.kinematics(model, data))
    data = mjx.rne(model, mjx.com_vel(model, mjx.crb(model, data)))
    return mjx.full_m(model, data), data.qfrc_bias


class _StepForces(eqx.Module):
    """Quantities of a time step: mass matrix M, damping K, and impulse `push`, Δt (Q - c)."""

    contacts_of_sides: _ContactsOfSides
    signals: Signals
    contact_forces: ContactPull
    levers: _ContactLevers
    rises: Array
    mass: Float[Array, "10 10"]
    damping: Float[Array, "10 10"]
    push: Coordinates


def _step_forces(run: HalfRobotSystem, motion: HalfRobotState, stored: bool = False) -> _StepForces:
    """Forces of an instant. Without `stored`, XLA would compute derivatives of contacts and signals again at each
    use.
    """

    store = jax.lax.optimization_barrier if stored else lambda x: x
    contacts_of_sides = store(_contacts_of_sides(run, motion))
    signals, contact_forces = store(_resolve_signals(run, plane_motion(run, motion), contacts_of_sides))
    damping, levers, rises = damping_matrix(run, motion, signals, contacts_of_sides, contact_forces)
    mass, bias = mass_matrix_and_bias(run, motion, run.robot.sides / 2 * half_robot.armature_inertia(run, signals))
    push = run.step * (generalized_forces(run, motion, signals, contacts_of_sides.contacts, contact_forces) - bias)
    return _StepForces(contacts_of_sides, signals, contact_forces, levers, rises, mass, damping, push)


def _solver(run: HalfRobotSystem, forces: _StepForces) -> Callable[[Coordinates], Coordinates]:
    factors = factorise(forces.mass + run.step * forces.damping)
    return functools.partial(solve_factorised, factors)


@eqx.filter_custom_jvp
def advance(run: HalfRobotSystem, motion: HalfRobotState) -> tuple[HalfRobotState, balances.Travel, Pair]:
    """One step, see `half_robot.advance`: (M + Δt K) Δv = Δt (Q - c).

    Returns:
        The motion after it. All signals of the instant before it, with forces and accelerations of the step. The load
        on each lower guide before it [N].
    """
    forces = _step_forces(run, motion)
    return _state_after_step(run, motion, forces, _solver(run, forces)(forces.push))


@advance.def_jvp
def _differentiated(primals: tuple[HalfRobotSystem, HalfRobotState], tangents: tuple[Any, Any]) -> tuple[Any, Any]:
    """See `half_robot.advance`. K enters only by its product with Δv."""
    forces = _step_forces(*primals)
    solve = _solver(primals[0], forces)
    velocity_change = solve(forces.push)

    def imbalance(run: HalfRobotSystem, motion: HalfRobotState) -> tuple[Array, _StepForces]:
        forces = _step_forces(run, motion, stored=True)
        damping_force = _damping_product(run, motion, forces, velocity_change)
        return forces.push - forces.mass @ velocity_change - run.step * damping_force, forces

    _, (residual_change, changed_forces) = eqx.filter_jvp(imbalance, primals, tangents)
    return eqx.filter_jvp(
        _state_after_step, (*primals, forces, velocity_change), (*tangents, changed_forces, solve(residual_change))
    )


def _damping_product(
    run: HalfRobotSystem, motion: HalfRobotState, forces: _StepForces, velocity_change: Coordinates
) -> Coordinates:
    """Product K Δv without forming K, see `damping_matrix`."""
    contacts = forces.contacts_of_sides.contacts
    contact_forces = forces.contact_forces
    levers = forces.levers
    assert contact_forces.aside is not None
    after = contact_forces_after_step(contacts, contact_forces, levers, forces.rises, velocity_change)
    rolling_losses, shaft_damping = _loss_derivatives(run, plane_motion(run, motion), forces.contacts_of_sides)
    (cos, sin), y = _yaw_cosine_and_sine(motion), _side_offsets(run)
    ahead_change, yaw_change = cos * velocity_change[X] + sin * velocity_change[Y], velocity_change[YAW]
    rolling_damping = rolling_losses * (ahead_change - y * yaw_change)
    product = jnp.zeros(COORDINATES, motion.v.dtype).at[SHAFTS].set(shaft_damping * velocity_change[SHAFTS])
    product = product.at[PLANE].add(
        jnp.stack([cos * jnp.sum(rolling_damping), sin * jnp.sum(rolling_damping), -y @ rolling_damping])
    )
    for lever, force_before, force_after in zip(
        levers, (contact_forces.force, contact_forces.aside, contacts.force), after, strict=True
    ):
        side_products = jnp.einsum("sci,sc->si", lever, force_before - force_after)
        product = product.at[OF_SIDE[0]].add(side_products[0]).at[OF_SIDE[1]].add(side_products[1])
    return run.robot.sides / 2 * product


def _state_after_step(
    run: HalfRobotSystem, motion: HalfRobotState, forces: _StepForces, velocity_change: Coordinates
) -> tuple[HalfRobotState, balances.Travel, Pair]:
    v = motion.v + velocity_change

    def other_states(conditions: Conditions, signals: Signals, memory: Mapping[str, Scalar]) -> Any:
        side_system = replace(run, conditions=conditions), replace(motion, memory=memory)
        return half_robot.other_states_after_step(*side_system, signals)

    current, discharge, memory = jax.vmap(other_states)(run.conditions.of_sides(), forces.signals, motion.memory)
    after = HalfRobotState(motion.q + run.step * v, v, current, discharge[0], memory)
    return after, _signals_after_step(run, motion, forces, velocity_change), forces.contact_forces.guided


def contact_forces_after_step(
    contacts: ContactState,
    contact_forces: ContactPull,
    levers: _ContactLevers,
    rises: Array,
    velocity_change: Coordinates,
) -> tuple[Array, Array, Array]:
    """Forces of the contacts ahead, to the left and off the ground [N] in a step that changes the velocities by Δv.

    Each has the shape (2, contacts).
    """
    side_change = velocity_change[OF_SIDE]
    along, across, off = (jnp.einsum("sci,si->sc", x, side_change) for x in levers)
    normal_drop = contacts.damped * off
    force_least = jnp.maximum(contacts.force, 1e-9)
    assert contact_forces.aside is not None
    ahead, aside = (
        force - (rises[k, 0] * along + rises[k, 1] * across + force / force_least * normal_drop)
        for k, force in enumerate((contact_forces.force, contact_forces.aside))
    )
    return ahead, aside, contacts.force - normal_drop


def _signals_after_step(
    run: HalfRobotSystem, motion: HalfRobotState, forces: _StepForces, velocity_change: Coordinates
) -> balances.Travel:
    """All signals of a step, with its forces at the end of the step to first order."""
    contacts_of_sides = forces.contacts_of_sides
    signals = forces.signals
    contacts = forces.contacts_of_sides.contacts
    motors_per_side = run.robot.sides / 2
    ahead, aside, normal = contact_forces_after_step(
        contacts, forces.contact_forces, forces.levers, forces.rises, velocity_change
    )
    forward = run.half.centre[0]
    arm = contacts.lever_x - forward
    load, moment = jnp.sum(normal, axis=-1), jnp.sum(aside * arm, axis=-1)
    signals = replace(signals, traction=jnp.sum(ahead, axis=-1), normal=load, moment_lateral=moment)
    # Of the centre of mass, in the rotating frame of the robot.
    speed, lateral = _mid_wheelbase_speeds(motion, motion.v)
    speed_rate, lateral_rate = _mid_wheelbase_speeds(motion, velocity_change / run.step)
    yaw_acceleration = velocity_change[YAW] / run.step
    y = _side_offsets(run)
    acceleration = speed_rate + motion.v[YAW] * lateral
    signals = replace(signals, acceleration=acceleration - yaw_acceleration * y)
    grip = GroundForces(
        normal=motors_per_side * load,
        ahead=motors_per_side * jnp.sum(ahead, axis=-1),
        aside=motors_per_side * jnp.sum(aside, axis=-1),
        moment=motors_per_side * moment,
        lateral_power=-motors_per_side * jnp.sum(aside * contacts_of_sides.lateral_speed, axis=-1),
        load_transfer=motors_per_side * (load[1] - load[0]) / 2,
        centre=jnp.sum(normal * contacts.lever_x) / jnp.maximum(jnp.sum(load), 1e-9),
        residual=jnp.zeros_like(y),
    )
    return balances.Travel(
        signals,
        grip,
        acceleration,
        lateral_rate - motion.v[YAW] * speed + forward * yaw_acceleration,
        yaw_acceleration,
    )


def stand(run: HalfRobotSystem) -> HalfRobotState:
    """Initial motion: at rest on the ground, with the heading of the conditions. See `half_robot.stand`, on the slope
    along it.

    Load transfer to the lower side is not included yet.
    """
    heading_deg = run.conditions.heading_deg
    heading = jnp.zeros(()) if heading_deg is None else jnp.radians(heading_deg)
    slope_along = jnp.degrees(jnp.arcsin(sine(run.conditions.slope) * cosine(heading)))
    half = half_robot.stand(replace(run, conditions=replace(run.conditions, slope_deg=slope_along)))
    q = (
        jnp.zeros(COORDINATES, half.q.dtype)
        .at[np.array([HEIGHT, PITCH, YAW])]
        .set(jnp.stack([half.q[1], half.q[2], heading + jnp.zeros_like(half.q[1])]))
    )
    memory = {name: jnp.stack([x, x]) for name, x in half.memory.items()}
    return HalfRobotState(q, jnp.zeros_like(q), jnp.zeros(len(SIDES), q.dtype), half.discharge, memory)


def roll(run: HalfRobotSystem) -> HalfRobotState:
    """Initial motion: the settled turn of the steady fidelity, or rest if there is none."""
    at_rest = stand(run)
    settled = circling.motion_of_unknowns(run.robot, circling.turning_start(run.robot, run.conditions, rolling=True))
    cos, sin = cosine(settled.heading), sine(settled.heading)
    lateral_speed = settled.speed_lateral - run.half.centre[0] * settled.yaw_rate
    shaft_speeds = settled.speed_motor / run.robot.gearbox.ratio
    plane_speeds = [
        cos * settled.speed - sin * lateral_speed,
        sin * settled.speed + cos * lateral_speed,
        settled.yaw_rate,
    ]
    v = at_rest.v.at[PLANE].set(jnp.stack(plane_speeds)).at[PULLEYS].set(shaft_speeds[:, None])
    return replace(at_rest, v=v, current=settled.current, memory=settled.memory)


def loads(run: HalfRobotSystem, contacts: ContactState, contact_forces: ContactPull) -> GearReactions:
    """See `half_robot.loads`, for each side."""
    return jax.vmap(lambda contacts, contact_forces: half_robot.loads(run, contacts, contact_forces))(
        contacts, contact_forces
    )


def distance_and_reactions(q: Array, reactions: GearReactions) -> tuple[Array, GearReactions | None]:
    """See `half_robot.distance_and_reactions`: distance from the start. A history has no loads of both sides."""
    return jnp.hypot(q[..., X], q[..., Y]), None


def steady_averages(
    average: Average, travelled: Array, sample_travel: balances.Travel, guide_loads: Array
) -> SteadyAverages:
    """See `half_robot.steady_averages`. Quantities of the whole robot are averaged over the periods of both sides."""
    side_averages = jax.tree.map(
        lambda x: jnp.broadcast_to(x.reshape(*x.shape[:1], -1), (*x.shape[:1], 2)), sample_travel
    )
    means, guide_load, periods, changes = jax.vmap(average, in_axes=1)(
        jnp.abs(travelled), (side_averages, guide_loads)
    )
    travel = jax.tree.map(lambda x, sample_leaf: x if sample_leaf.ndim > 1 else jnp.mean(x), means, sample_travel)
    share = jnp.sum(guide_load) / jnp.maximum(jnp.sum(travel.signals.normal), 1e-9)
    # A side that hardly moves counts as settled if its changes are small compared with the other side's.
    scaled_changes = [(change, jnp.max(size)) for change, size in changes]
    return SteadyAverages(
        travel.signals, share, periods, jnp.max(half_robot.relative_changes(scaled_changes)), travel
    )


def status(run: HalfRobotSystem, averages: SteadyAverages, end: HalfRobotState) -> Array:
    """See `half_robot.status`."""
    travel = averages.travel
    signals = jax.tree.map(jnp.mean, averages.signals)
    assert travel is not None
    mean_speeds = {name: getattr(signals, name) for name in ("speed", "speed_lateral", "yaw_rate")}
    mean_motion = replace(plane_motion(run, end), **mean_speeds)
    status = circling.status_of_steady_motion(run.robot, run.conditions, travel, mean_motion)
    status = jnp.where((averages.change > half_robot.SETTLED) & (status == CONVERGED), NOT_SETTLED, status)
    tilt = jnp.maximum(jnp.abs(end.q[PITCH]), jnp.abs(end.q[ROLL]))
    return half_robot.status_unless_lost(run, status, end, end.q[HEIGHT], tilt, signals.total_current)


def result_of(run: HalfRobotSystem, averages: SteadyAverages, status: Array) -> Result:
    assert averages.travel is not None
    return circling.result_of_turn(run.robot, averages.travel, status)
