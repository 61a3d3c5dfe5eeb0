"""A whole robot free to turn, in motion: its state, all its forces at an instant, one time step, and its start.

Coordinates q begin with place x uphill and y to the left [m], and height z of the middle of the wheelbase over the
ground [m]. Then come yaw, pitch (nose down) and roll (left side up) [rad]. The last are the angles of driving and
driven pulley of the left and of the right side [rad], relative to the chassis. Velocities v are their rates. MJX
computes chassis and pulleys (`mjcf`). Each side is the half robot's belt, contacts and drive (`undercarriage`,
`balances.resolved_sides`) at its own height z + y_s roll and speed v_x - ω y_s. `turning.ContactLaw` at each contact
replaces the straight-travel law of Fig. 7. Roll is small.
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
    at: ContactState
    aside: Float[Array, "2 contacts"]  # velocity of each contact to the left [m/s]
    height: Pair

    @property
    def normal(self) -> Pair:
        return jnp.sum(self.at.force, axis=-1)

    def pull(self, chassis: Chassis, signals: Signals) -> ContactPull:
        def side(signals: Signals, at: ContactState, aside: Array, height: Scalar) -> ContactPull:
            along = side_contacts.sliding_speeds(signals, at)
            friction_force = signals.adhesion * at.force * self.law.per_speed(along**2, aside**2)
            pulled = side_contacts.contact_forces(self.path, chassis, signals, at, height, friction_force * along)
            return replace(pulled, aside=-self.lateral * friction_force * aside)

        return jax.vmap(side)(signals, self.at, self.aside, self.height)


def _places_of_sides(run: HalfRobotSystem) -> Pair:
    """Distances of the sides to the left of the middle of the robot [m]."""
    return jnp.asarray(SIDES * run.chassis.turning.width)


def _heading(motion: HalfRobotState) -> tuple[Array, Array]:
    """Cosine and sine of the yaw angle."""
    return cosine(motion.q[YAW]), sine(motion.q[YAW])


def _mid_wheelbase_speeds(motion: HalfRobotState, v: Coordinates) -> tuple[Array, Array]:
    """Speeds of the middle of the wheelbase, ahead and to the left, in the frame of the robot [m/s]."""
    cos, sin = _heading(motion)
    return cos * v[X] + sin * v[Y], cos * v[Y] - sin * v[X]


def plane_motion(run: HalfRobotSystem, motion: HalfRobotState) -> PlaneMotion:
    """Motion in the form of the other fidelities: speeds of the centre of mass of a level robot."""
    q, v = motion.q, motion.v
    speed, lateral = _mid_wheelbase_speeds(motion, v)
    forward, up = run.half.centre
    return PlaneMotion(
        current=motion.current,
        speed_motor=run.robot.gearbox.ratio * v[SHAFTS],
        speed=speed,
        speed_lateral=lateral + forward * v[YAW] - up * v[ROLL],
        yaw_rate=v[YAW],
        heading=q[YAW],
        place_x=q[X],
        place_y=q[Y],
        discharge=motion.discharge,
        memory=motion.memory,
    )


def _contacts_of_sides(run: HalfRobotSystem, motion: HalfRobotState) -> _ContactsOfSides:
    q, v = motion.q, motion.v
    speed, lateral = _mid_wheelbase_speeds(motion, v)
    y = _places_of_sides(run)
    heights, rises = q[HEIGHT] + y * q[ROLL], v[HEIGHT] + y * v[ROLL]
    nothing = jnp.zeros_like(y)
    of_q = jnp.stack([nothing, heights, q[PITCH] + nothing, *q[PULLEYS].T], axis=1)
    of_v = jnp.stack([speed - v[YAW] * y, rises, v[PITCH] + nothing, *v[PULLEYS].T], axis=1)
    touching = jax.vmap(lambda q, v: side_contacts.compute_contacts(run.path, run.chassis, q, v))(of_q, of_v)
    turning, ratio = run.chassis.turning, balances.lateral_friction(run.conditions, run.chassis)
    rule = turning.rule
    law = ContactLaw(run.chassis.ground.friction, ratio ** (2 * rule - 2), run.chassis.on_tracks, turning.nodes)
    aside = lateral + v[YAW] * touching.lever_x - v[ROLL] * touching.lever_z
    return _ContactsOfSides(run.path, law, ratio**rule, touching, aside, heights)


def _resolve_signals(
    run: HalfRobotSystem, motion: PlaneMotion, sides: _ContactsOfSides
) -> tuple[Signals, ContactPull]:
    return balances.resolved_sides(run.robot, run.conditions, motion, sides, run.half.inertia_pulley)


def instant(run: HalfRobotSystem, motion: HalfRobotState) -> tuple[Signals, ContactState, ContactPull]:
    """All signals, contacts and forces of an instant. The first axis is the side: left, right."""
    sides = _contacts_of_sides(run, motion)
    signals, pulled = _resolve_signals(run, plane_motion(run, motion), sides)
    return signals, sides.at, pulled


def _loss_derivatives(run: HalfRobotSystem, motion: PlaneMotion, sides: _ContactsOfSides) -> Float[Array, "2 2"]:
    """Derivatives of resistance and losses as in `half_robot`, with respect to the speed of each side and of its
    driving shaft.
    """

    def along(change: Scalar) -> Array:
        signals, pulled = _resolve_signals(run, replace(motion, speed=motion.speed + change), sides)
        return jnp.sum(pulled.force, axis=-1) - signals.resistance

    def shaft(change: Scalar) -> Array:
        faster = motion.speed_motor + run.robot.gearbox.ratio * change
        return _resolve_signals(run, replace(motion, speed_motor=faster), sides)[0].torque_net

    zero, one = jnp.zeros_like(motion.speed), jnp.ones_like(motion.speed)
    return jnp.stack([jnp.maximum(-jax.jvp(f, (zero,), (one,))[1], 0.0) for f in (along, shaft)])


#: Motion of each contact along the robot, to its left and off the ground, per velocity of `OF_SIDE`, each of shape
#: (2, contacts, 8).
_ContactLevers = tuple[Array, Array, Array]


def _contact_levers(run: HalfRobotSystem, motion: HalfRobotState, at: ContactState) -> _ContactLevers:
    cos, sin = _heading(motion)
    one, y = jnp.ones_like(at.gap), _places_of_sides(run)[:, None]
    none = jnp.zeros_like(one)
    front, rear = run.path.radius * (1 - at.weight), run.path.radius * at.weight
    x, z = at.lever_x, at.lever_z
    along: list[Any] = [cos * one, sin * one, none, -y * one, z, none, at.rate_x * front, at.rate_x * rear]
    across: list[Any] = [-sin * one, cos * one, none, x, none, -z, none, none]
    off: list[Any] = [none, none, one, none, -x, y * one, at.rate_z * front, at.rate_z * rear]
    return jnp.stack(along, axis=-1), jnp.stack(across, axis=-1), jnp.stack(off, axis=-1)


def generalized_forces(
    run: HalfRobotSystem, motion: HalfRobotState, signals: Signals, at: ContactState, pulled: ContactPull
) -> Coordinates:
    """Generalized forces on q [N, N·m]."""
    cos, sin = _heading(motion)
    y, several = _places_of_sides(run), run.robot.sides / 2
    assert pulled.aside is not None
    moment_lateral = jnp.sum(pulled.aside * (at.lever_x - run.half.centre[0]), axis=-1)
    lateral, yaw = balances.lateral_and_yaw_effects(run.robot, replace(signals, moment_lateral=moment_lateral))
    forward, normal, moment, rear = pulled.generalized.T
    ahead, aside = several * jnp.sum(forward), several * jnp.sum(pulled.aside) - lateral
    turn = several * (jnp.sum(pulled.aside * at.lever_x) - y @ forward) - yaw
    roll_moment = several * (y @ normal - jnp.sum(pulled.aside * at.lever_z))
    body = [cos * ahead - sin * aside, sin * ahead + cos * aside, several * jnp.sum(normal), turn]
    shafts = several * signals.torque_net, several * rear
    pulleys = [x[k] for k in range(2) for x in shafts]
    return jnp.stack([*body, several * jnp.sum(moment), roll_moment, *pulleys])


def damping_matrix(
    run: HalfRobotSystem, motion: HalfRobotState, signals: Signals, sides: _ContactsOfSides, pulled: ContactPull
) -> tuple[Float[Array, "10 10"], _ContactLevers, Array]:
    """Damping matrix K of the forces on v, see `half_robot.damping_matrix`, with friction in both directions.

    Also returns the levers, and the rise of each contact's forces with its sliding [N·s/m], shape (2, 2, 2,
    contacts).
    """
    levers, touching = _contact_levers(run, motion, sides.at), sides.at
    along, across, off = levers
    assert pulled.aside is not None
    sliding = jax.vmap(side_contacts.sliding_speeds)(signals, touching)
    weight = signals.adhesion[:, None] * touching.force
    rises = jnp.stack([jnp.stack(row) for row in sides.law.rises(sliding, -sides.aside)])
    rises = rises * jnp.stack([weight, sides.lateral * weight])[:, None]
    least = jnp.maximum(touching.force, 1e-9)
    moves = jnp.concatenate(levers, axis=1)
    falls = touching.damped[..., None] * off
    pushes = [
        rises[k, 0][..., None] * along + rises[k, 1][..., None] * across + (f / least)[..., None] * falls
        for k, f in enumerate((pulled.force, pulled.aside))
    ]
    side_matrices = jnp.einsum("sci,scj->sij", moves, jnp.concatenate([*pushes, falls], axis=1))
    losses = _loss_derivatives(run, plane_motion(run, motion), sides)
    # Rolling resistance acts at each side, along the robot.
    cos, sin = _heading(motion)
    total = jnp.zeros((COORDINATES, COORDINATES), motion.v.dtype)
    for k, y in enumerate(_places_of_sides(run)):
        way = jnp.zeros(8).at[PLANE].set(jnp.stack([cos, sin, -y]))
        of_side = side_matrices[k] + losses[0, k] * jnp.outer(way, way)
        of_side = of_side.at[6, 6].add(losses[1, k])
        total = total.at[np.ix_(OF_SIDE[k], OF_SIDE[k])].add(of_side)
    return run.robot.sides / 2 * total, levers, rises


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

    sides: _ContactsOfSides
    signals: Signals
    pulled: ContactPull
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
    sides = store(_contacts_of_sides(run, motion))
    signals, pulled = store(_resolve_signals(run, plane_motion(run, motion), sides))
    damping, levers, rises = damping_matrix(run, motion, signals, sides, pulled)
    mass, bias = mass_matrix_and_bias(run, motion, run.robot.sides / 2 * half_robot.armature_inertia(run, signals))
    push = run.step * (generalized_forces(run, motion, signals, sides.at, pulled) - bias)
    return _StepForces(sides, signals, pulled, levers, rises, mass, damping, push)


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
    gained = solve(forces.push)

    def imbalance(run: HalfRobotSystem, motion: HalfRobotState) -> tuple[Array, _StepForces]:
        forces = _step_forces(run, motion, stored=True)
        damped = _damping_product(run, motion, forces, gained)
        return forces.push - forces.mass @ gained - run.step * damped, forces

    _, (change, changed_forces) = eqx.filter_jvp(imbalance, primals, tangents)
    return eqx.filter_jvp(_state_after_step, (*primals, forces, gained), (*tangents, changed_forces, solve(change)))


def _damping_product(
    run: HalfRobotSystem, motion: HalfRobotState, forces: _StepForces, gained: Coordinates
) -> Coordinates:
    """Product K Δv without forming K, see `damping_matrix`."""
    touching, pulled, levers = forces.sides.at, forces.pulled, forces.levers
    assert pulled.aside is not None
    after = contact_forces_after_step(touching, pulled, levers, forces.rises, gained)
    losses, shafts = _loss_derivatives(run, plane_motion(run, motion), forces.sides)
    (cos, sin), y = _heading(motion), _places_of_sides(run)
    ahead, turn = cos * gained[X] + sin * gained[Y], gained[YAW]
    rolling_damping = losses * (ahead - y * turn)
    gained_forces = jnp.zeros(COORDINATES, motion.v.dtype).at[SHAFTS].set(shafts * gained[SHAFTS])
    gained_forces = gained_forces.at[PLANE].add(
        jnp.stack([cos * jnp.sum(rolling_damping), sin * jnp.sum(rolling_damping), -y @ rolling_damping])
    )
    for lever, now, then in zip(levers, (pulled.force, pulled.aside, touching.force), after, strict=True):
        side_products = jnp.einsum("sci,sc->si", lever, now - then)
        gained_forces = gained_forces.at[OF_SIDE[0]].add(side_products[0]).at[OF_SIDE[1]].add(side_products[1])
    return run.robot.sides / 2 * gained_forces


def _state_after_step(
    run: HalfRobotSystem, motion: HalfRobotState, forces: _StepForces, gained: Coordinates
) -> tuple[HalfRobotState, balances.Travel, Pair]:
    v = motion.v + gained

    def later(conditions: Conditions, signals: Signals, memory: Mapping[str, Scalar]) -> Any:
        of_side = replace(run, conditions=conditions), replace(motion, memory=memory)
        return half_robot.other_states_after_step(*of_side, signals)

    current, discharge, memory = jax.vmap(later)(run.conditions.of_sides(), forces.signals, motion.memory)
    after = HalfRobotState(motion.q + run.step * v, v, current, discharge[0], memory)
    return after, _signals_after_step(run, motion, forces, gained), forces.pulled.guided


def contact_forces_after_step(
    at: ContactState, pulled: ContactPull, levers: _ContactLevers, rises: Array, gained: Coordinates
) -> tuple[Array, Array, Array]:
    """Forces of the contacts ahead, to the left and off the ground [N] in a step that changes the velocities by Δv.

    Each has the shape (2, contacts).
    """
    of_side = gained[OF_SIDE]
    along, across, off = (jnp.einsum("sci,si->sc", x, of_side) for x in levers)
    down, least = at.damped * off, jnp.maximum(at.force, 1e-9)
    assert pulled.aside is not None
    ahead, aside = (
        force - (rises[k, 0] * along + rises[k, 1] * across + force / least * down)
        for k, force in enumerate((pulled.force, pulled.aside))
    )
    return ahead, aside, at.force - down


def _signals_after_step(
    run: HalfRobotSystem, motion: HalfRobotState, forces: _StepForces, gained: Coordinates
) -> balances.Travel:
    """All signals of a step, with its forces at the end of the step to first order."""
    sides, signals, touching, several = forces.sides, forces.signals, forces.sides.at, run.robot.sides / 2
    ahead, aside, normal = contact_forces_after_step(touching, forces.pulled, forces.levers, forces.rises, gained)
    forward = run.half.centre[0]
    arm = touching.lever_x - forward
    load, moment = jnp.sum(normal, axis=-1), jnp.sum(aside * arm, axis=-1)
    signals = replace(signals, traction=jnp.sum(ahead, axis=-1), normal=load, moment_lateral=moment)
    # Of the centre of mass, in the rotating frame of the robot.
    speed, lateral = _mid_wheelbase_speeds(motion, motion.v)
    ahead_gained, aside_gained = _mid_wheelbase_speeds(motion, gained / run.step)
    turn = gained[YAW] / run.step
    y = _places_of_sides(run)
    acceleration = ahead_gained + motion.v[YAW] * lateral
    signals = replace(signals, acceleration=acceleration - turn * y)
    grip = GroundForces(
        normal=several * load,
        ahead=several * jnp.sum(ahead, axis=-1),
        aside=several * jnp.sum(aside, axis=-1),
        moment=several * moment,
        across=-several * jnp.sum(aside * sides.aside, axis=-1),
        moved=several * (load[1] - load[0]) / 2,
        centre=jnp.sum(normal * touching.lever_x) / jnp.maximum(jnp.sum(load), 1e-9),
        lacking=jnp.zeros_like(y),
    )
    return balances.Travel(signals, grip, acceleration, aside_gained - motion.v[YAW] * speed + forward * turn, turn)


def stand(run: HalfRobotSystem) -> HalfRobotState:
    """At rest on the ground, with the heading of the conditions. See `half_robot.stand`, on the slope along it.

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
    rolls = circling.motion_of_unknowns(run.robot, circling.turning_start(run.robot, run.conditions, rolling=True))
    cos, sin = cosine(rolls.heading), sine(rolls.heading)
    lateral = rolls.speed_lateral - run.half.centre[0] * rolls.yaw_rate
    shafts = rolls.speed_motor / run.robot.gearbox.ratio
    plane = [cos * rolls.speed - sin * lateral, sin * rolls.speed + cos * lateral, rolls.yaw_rate]
    v = at_rest.v.at[PLANE].set(jnp.stack(plane)).at[PULLEYS].set(shafts[:, None])
    return replace(at_rest, v=v, current=rolls.current, memory=rolls.memory)


def loads(run: HalfRobotSystem, at: ContactState, pulled: ContactPull) -> GearReactions:
    """See `half_robot.loads`, for each side."""
    return jax.vmap(lambda at, pulled: half_robot.loads(run, at, pulled))(at, pulled)


def distance_and_reactions(q: Array, reactions: GearReactions) -> tuple[Array, GearReactions | None]:
    """See `half_robot.distance_and_reactions`: distance from the start. A history has no loads of both sides."""
    return jnp.hypot(q[..., X], q[..., Y]), None


def steady_averages(average: Average, travelled: Array, passed: balances.Travel, guided: Array) -> SteadyAverages:
    """See `half_robot.steady_averages`. Quantities of the whole robot are averaged over the periods of both sides."""
    side_averages = jax.tree.map(lambda x: jnp.broadcast_to(x.reshape(*x.shape[:1], -1), (*x.shape[:1], 2)), passed)
    means, load, periods, changes = jax.vmap(average, in_axes=1)(jnp.abs(travelled), (side_averages, guided))
    travel = jax.tree.map(lambda x, like: x if like.ndim > 1 else jnp.mean(x), means, passed)
    share = jnp.sum(load) / jnp.maximum(jnp.sum(travel.signals.normal), 1e-9)
    # A side that hardly moves counts as settled if its changes are small compared with the other side's.
    larger = [(change, jnp.max(size)) for change, size in changes]
    return SteadyAverages(travel.signals, share, periods, jnp.max(half_robot.relative_changes(larger)), travel)


def status(run: HalfRobotSystem, averages: SteadyAverages, end: HalfRobotState) -> Array:
    """See `half_robot.status`."""
    travel, signals = averages.travel, jax.tree.map(jnp.mean, averages.signals)
    assert travel is not None
    limits = {name: getattr(signals, name) for name in ("speed", "speed_lateral", "yaw_rate")}
    keeps = replace(plane_motion(run, end), **limits)
    status = circling.status_of_steady_motion(run.robot, run.conditions, travel, keeps)
    status = jnp.where((averages.change > half_robot.SETTLED) & (status == CONVERGED), NOT_SETTLED, status)
    tilt = jnp.maximum(jnp.abs(end.q[PITCH]), jnp.abs(end.q[ROLL]))
    return half_robot.status_unless_lost(run, status, end, end.q[HEIGHT], tilt, signals.total_current)


def result_of(run: HalfRobotSystem, averages: SteadyAverages, status: Array) -> Result:
    assert averages.travel is not None
    return circling.result_of_turn(run.robot, averages.travel, status)
