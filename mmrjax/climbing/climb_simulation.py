"""Half a robot with levers on a terrain in its plane of travel: its state, one time step, and the verdict of a run.

The bodies are the chassis with payload, two pulleys and two levers. The belts run rigidly with the pulleys. The
levers' drives follow a sequence of angles, limited by the levers' rate, or have given voltages.
`contacts_with_terrain` computes the contacts, `balances` the drive of the tracks, `step_levers` that of the levers.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mmrjax.climbing import footing
from mmrjax.climbing.footing import COORDINATES, FRONT, PITCH, REAR, SHAFT, ContactShape, Footing
from mmrjax.climbing.levers import LeverDrive, LeverStep, lever_drive, step_levers
from mmrjax.climbing.terrain import Terrain
from mmrjax.compile.compiling import SMALL, compiled
from mmrjax.fidelities.drive import current_after
from mmrjax.model import balances, contact
from mmrjax.model.chassis import Chassis
from mmrjax.model.conditions import Conditions
from mmrjax.model.contact import Track
from mmrjax.model.masses import HalfRobotMasses, without_levers
from mmrjax.model.params import Pair, Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import GRAVITY, Signals, State
from mmrjax.numerics.elementary import value_and_slope
from mmrjax.numerics.linear_equations import factorise, solve_factorised
from mmrjax.undercarriage.running_gear import RunningGear
from mmrjax.undercarriage.side_contacts import contact_damping

#: Verdicts of a climb; the last two: its time ended while it was still moving, and numbers that are not finite.
VERDICTS = OVER, TIPS, STALLS, SLIDES, HANGS, UNFINISHED, FAILED = range(7)
NAMES = ("over", "tips", "stalls", "slides", "hangs", "unfinished", "failed")
_RUNNING = -1

STEP, SAMPLE, DURATION = 1e-4, 2e-2, 20.0  # [s]
SETTLES, RISES = 0.3, 0.1  # time before the motors are switched on, and until they have full voltage [s]
#: Pitch beyond which a robot has turned over [rad].
TURNED_OVER = np.radians(100.0)
#: A robot that advances less than this distance [m] in this time [s] is stuck.
GAIN, PATIENCE = 5e-3, 2.0
#: Largest depth of a lever below the ground at the start [m]; it then rests on the ground.
ON_GROUND = 4e-4
#: A belt slower than this [m/s] stands; a body that carries more than this share of the weight hangs.
STANDS, BEARS = 5e-3, 0.1
#: Contacts with less than this share of the weight do not carry the robot: it falls or bounces.
CARRIED = 0.5
#: Time for levers to reach their rate and come near their angle [s], and rate below which they may stand [rad/s].
_SWINGS, _STILL = 0.03, 5e-3
LED = np.array([FRONT, REAR])
#: Rotation of the pulleys of both levers' tracks relative to their levers, per velocity of `COORDINATES`.
_ON_BELTS = np.eye(COORDINATES)[LED] + np.eye(COORDINATES)[SHAFT]


class LeverSequence(eqx.Module):
    """Lever angles, or voltages of the lever motors, over distance or time. Linear between knots.

    Values beyond the first and last knot are constant.

    Attributes:
        knots: position of the middle of the wheelbase from the start of the obstacle [m], or time [s].
        front, rear: values at the knots: angles, 0 along the wheelbase outward, positive up [rad], or voltages,
            positive up [V].
        begins: initial angles of front and rear levers that are driven by voltages [rad]. None: the sequence states
            angles.
        over_time: True if the knots are times.
        supply: highest voltage of the lever motors [V]. None: that of the supply.
    """

    knots: Float[Array, " knots"]
    front: Float[Array, " knots"]
    rear: Float[Array, " knots"]
    begins: Pair | None = None
    over_time: bool = eqx.field(default=False, static=True)
    supply: Scalar | None = None

    @property
    def first(self) -> Pair:
        """Initial ψ of both levers [rad]."""
        return _convert_lever_angles(*(self.demand(-jnp.inf, 0.0) if self.begins is None else self.begins))

    def demand(self, place: Scalar, time: Scalar) -> tuple[Array, Array]:
        """Demanded angles of front and rear [rad], or voltages of their motors, positive up [V]."""
        abscissa = time if self.over_time else place
        return jnp.interp(abscissa, self.knots, self.front), jnp.interp(abscissa, self.knots, self.rear)


def _convert_lever_angles(front: Array, rear: Array) -> Pair:
    """Converts both lever angles between ψ (see `contacts_with_terrain`) and the angles of the sequence [rad]."""
    return jnp.stack([front, jnp.pi - rear])


def constant_angles(front: Scalar, rear: Scalar) -> LeverSequence:
    """Sequence in which the levers keep their angles [rad]."""
    one = jnp.zeros(1)
    return LeverSequence(one, one + front, one + rear)


class ClimbMotion(eqx.Module):
    """State of half a robot: coordinates, velocities (see `contacts_with_terrain`), current of one motor [A], charge
    taken from the battery [C], and supply current of the lever motors [A].
    """

    q: Float[Array, " 6"]
    v: Float[Array, " 6"]
    current: Scalar
    discharge: Scalar
    lever_supply_current: Scalar


#: Sources and sinks of energy: input of the motors of tracks and of levers, then losses.
SOURCES = ("supply", "levers")
LOSSES = ("winding", "motor", "gearbox", "track", "sliding", "contact", "rolling", "lever_winding", "lever_gears")


Energy = dict[str, Any]


class ClimbRecord(eqx.Module):
    """Recorded quantities of an instant, or their means over a sample. Energies count from the start of the run.

    Attributes:
        current: current of one motor [A].
        total_current: supply current of all motors, I_s of (10) [A].
        torque: torque of each lever drive on its pair of levers [N·m], with lever_current [A] and lever_voltage [V]
            of its motor, positive up.
        holds: 1 if a pair is held by its worm alone, without current [-].
        energy: energy taken and lost, by names in `SOURCES` and `LOSSES`, for the whole robot [J].
        stored: energy stored in motion, height, contacts and windings, for the whole robot [J].
        body: share of all normal force that acts on the body [-].
        grip: traction of all rolling contacts relative to the limit of their friction [-].
        carried: share of the weight that the contacts carry [-].
        centre: x of the centre of mass [m].
        base: distances from the centre of mass to the outermost contacts behind and ahead [m]. For a sample, the
            largest ones, because contacts that open for a few steps still support the robot.
    """

    time: Scalar
    motion: ClimbMotion
    current: Scalar
    total_current: Scalar
    voltage: Scalar
    torque: Pair
    lever_current: Pair
    lever_voltage: Pair
    holds: Pair
    energy: Energy
    stored: Scalar
    normal: Scalar
    body: Scalar
    grip: Scalar
    carried: Scalar
    centre: Scalar
    base: Pair

    @property
    def margin(self) -> Scalar:
        """Distance from the line of gravity through the centre of mass to the nearer of the outermost contacts [m].

        Negative if the line is outside them, NaN for a robot that falls or bounces.
        """
        lowest = jnp.min(self.base, axis=-1)
        return jnp.where(jnp.isfinite(lowest) & (self.carried >= CARRIED), lowest, jnp.nan)


class ClimbSystem(eqx.Module):
    """Constants of one run. Robot and chassis have the losses of the main tracks only, those of the lever tracks are
    separate.
    """

    robot: Robot
    conditions: Conditions
    terrain: Terrain
    sequence: LeverSequence
    shape: ContactShape
    half: HalfRobotMasses
    lever: Float[Array, " 3"]
    chassis: Chassis
    lever_track: Track
    drive: LeverDrive
    step: Scalar


def build_climb_system(
    robot: Robot, conditions: Conditions, terrain: Terrain, sequence: LeverSequence, step: Scalar = STEP
) -> ClimbSystem:
    """Constants of one run (scalar conditions). The robot may hold tracers."""
    zero = jnp.zeros_like(conditions.voltage)
    mass = balances.begin_signals(robot, conditions, State(zero, zero, zero, zero)).mass
    robot, gear = robot.within(conditions.configuration), robot.running_gear
    chassis = robot.chassis(conditions.configuration)
    half = without_levers(robot, conditions, mass)
    shape = footing.contact_shape_of_robot(chassis, gear, robot.radius_pulley)
    no_loss = jnp.zeros_like(chassis.on_tracks)
    lever = jnp.stack([gear.lever_mass, gear.lever_centre, gear.lever_inertia]) * jnp.stack(
        [chassis.on_tracks, jnp.ones(()), chassis.on_tracks]
    )
    main_track, lever_track = (
        jax.tree.map(lambda tracked, wheeled: jnp.where(chassis.on_tracks > 0.5, tracked, wheeled), *tracks)
        for tracks in zip(
            gear.levers.tracks(chassis.track),
            (chassis.track, dataclasses.replace(chassis.track, loss_coulomb=no_loss, loss_viscous=no_loss)),
            strict=True,
        )
    )
    chassis = dataclasses.replace(chassis, track=main_track)
    robot = eqx.tree_at(lambda r: r.configurations.chosen, robot, chassis)
    return ClimbSystem(
        robot,
        conditions,
        terrain,
        sequence,
        shape,
        half,
        lever,
        chassis,
        lever_track,
        drive=lever_drive(robot),
        step=jnp.asarray(step, float),
    )


def mass_matrix_and_bias(
    run: ClimbSystem, q: Array, v: Array
) -> tuple[Float[Array, "6 6"], Float[Array, " 6"], Scalar]:
    """Mass matrix M without rotors, bias c (centrifugal forces and gravity) and potential energy, per side.

    M v' + c = Q. Each body's centre of mass moves by its arm about the middle of the wheelbase and, of a lever, about
    its axle. Gravity is tilted by the slope of the conditions.
    """
    half, shape = run.half, run.shape
    body, *levers = footing.part_frames(shape, q)
    gravity = GRAVITY * jnp.stack([jnp.sin(run.conditions.slope), jnp.cos(run.conditions.slope)])
    zero, one = jnp.zeros(()), jnp.ones(())

    def turning_velocity(arm: Array) -> Array:
        """Velocity of a point at `arm` that rotates nose down, per angular speed."""
        return jnp.stack([arm[1], -arm[0]])

    matrix = jnp.zeros((COORDINATES, COORDINATES))
    bias = jnp.zeros(COORDINATES)
    height = zero
    mass_lever, centre_lever = run.lever[0], run.lever[1]
    masses: list[tuple[Scalar, Array, Array | None, int | None]] = []
    arm = body.along(jnp.stack([half.forward, half.up]))
    masses.append((half.chassis, arm, None, None))
    for lever in levers:
        axle = lever.origin - body.origin
        masses.append((half.pulley, axle, None, None))
        reach = lever.along(jnp.stack([centre_lever, zero]))
        masses.append((mass_lever, axle + reach, reach, lever.turns))
    for mass, place, lever_arm, turns in masses:
        columns = [jnp.stack([one, zero]), jnp.stack([zero, one]), turning_velocity(place), *[jnp.zeros(2)] * 3]
        centrifugal = -place * v[PITCH] ** 2
        if lever_arm is not None and turns is not None:
            columns[turns] = -turning_velocity(lever_arm)
            centrifugal = -(place - lever_arm) * v[PITCH] ** 2 - lever_arm * (v[PITCH] - v[turns]) ** 2
        jacobian = jnp.stack(columns, axis=1)
        matrix = matrix + mass * jacobian.T @ jacobian
        bias = bias + mass * jacobian.T @ (centrifugal + gravity)
        height = height + mass * gravity @ (body.origin + place)
    rotating = [(half.inertia, {PITCH: 1.0}), (2 * half.inertia_pulley, {PITCH: 1.0, SHAFT: 1.0})]
    rotating += [(run.lever[2], {PITCH: 1.0, k: -1.0}) for k in (FRONT, REAR)]
    for inertia, shares in rotating:
        row = jnp.zeros(COORDINATES).at[np.array(list(shares))].set(jnp.array(list(shares.values())))
        matrix = matrix + inertia * jnp.outer(row, row)
    return matrix, bias, height


class _ContactForces(eqx.Module):
    """Forces of the contacts, in the form that `balances.resolved_signals` expects."""

    traction: Scalar
    guide: Scalar
    load: Scalar
    force: Float[Array, " pairs"]


class _LeveredContacts(eqx.Module):
    contacts: Footing
    v: Array
    radius: Scalar
    lever_torque: Scalar  # losses of the levers' tracks, at the shaft [N·m]

    @property
    def normal(self) -> Scalar:
        """Total normal load on all rolling contacts of one side [N]."""
        return jnp.sum(self.contacts.force * self.contacts.rolls)

    def pull(self, chassis: Chassis, signals: Signals) -> _ContactForces:
        """Friction of the contacts (25) by Fig. 7, and of the guide (26)."""
        contacts = self.contacts
        force = jnp.asarray(
            chassis.ground.traction(_sliding(contacts, self.v, signals), contacts.force, signals.adhesion)
        )
        guide = jnp.sum(chassis.track.guide_friction * contacts.guided * contacts.force * signals.direction)
        load_torque = (
            guide * self.radius
            + self.lever_torque
            - jnp.sum(force * contacts.along[:, SHAFT] + contacts.force * contacts.off[:, SHAFT])
        )
        return _ContactForces(jnp.sum(force), guide, load_torque, force)


def _sliding(contacts: Footing, v: Array, signals: Signals) -> Array:
    return -(contacts.along @ v) - signals.speed_slip_terms


def climb_instant(
    run: ClimbSystem, motion: ClimbMotion, voltage_share: Scalar
) -> tuple[Signals, Footing, _ContactForces, Array]:
    """All signals, contacts, forces and load shares of an instant.

    `voltage_share` is the fraction of the voltage that is applied to each motor.
    """
    contacts = footing.contacts_with_terrain(run.shape, run.terrain, motion.q, motion.v)
    # share of each rolling contact in the load, and the robot's speed along the ground, their load-weighted mean
    bearing_force = contacts.force * contacts.rolls
    share = bearing_force / jnp.maximum(jnp.sum(bearing_force), 1e-9)
    speed = share @ (contacts.carried @ motion.v)
    conditions = _driven(run, voltage_share)

    ratio = run.robot.gearbox.ratio
    state = State(motion.current, ratio * motion.v[SHAFT], speed, motion.discharge)
    mover = _LeveredContacts(
        contacts, motion.v, run.shape.main.first, jnp.sum(_lever_loss(run, motion.v[SHAFT] + motion.v[LED]))
    )
    signals, contact_forces = balances.resolved_signals(
        run.robot, conditions, state, mover, 2 * run.half.inertia_pulley
    )
    return signals, contacts, contact_forces, share


def _driven(run: ClimbSystem, voltage_share: Scalar) -> Conditions:
    return dataclasses.replace(run.conditions, duty=run.conditions.duty * voltage_share)


def _lever_loss(run: ClimbSystem, speed: Array) -> Array:
    """Loss torques of the lever tracks (24) [N·m], at the speeds of their pulleys relative to the levers [rad/s]."""
    direction = contact.smooth_sign(run.shape.main.first * speed, run.chassis.speed_still)
    return jnp.asarray(run.lever_track.torque_loss(speed, direction))


def _with_lever_current(run: ClimbSystem, motion: ClimbMotion) -> ClimbSystem:
    """Run in which the current of the lever motors is added to the battery's other consumers, I_s of eq. (10)."""
    battery = run.robot.battery
    battery = dataclasses.replace(battery, current_other=battery.current_other + motion.lever_supply_current)
    return dataclasses.replace(run, robot=dataclasses.replace(run.robot, battery=battery))


def _drive_action(
    run: ClimbSystem, motion: ClimbMotion, time: Scalar, source: Scalar, free_rates: Array, rate_per_torque: Array
) -> LeverStep:
    """Action of the lever drives in a step. Without it, the rates after the step would be `free_rates` [rad/s]."""
    levers = run.robot.running_gear.levers
    sequence = run.sequence
    lever_voltage = jnp.abs(source) if sequence.supply is None else sequence.supply
    high = jnp.stack([lever_voltage, lever_voltage])
    low = -high
    # The levers move to the angles of the sequence, at most at their largest rate. One that has reached its angle
    # stands still.
    rate = run.robot.running_gear.levers.rate
    approach_rate = (_convert_lever_angles(*run.sequence.demand(motion.q[0], time)) - motion.q[LED]) / (4 * _SWINGS)
    led_rates = motion.v[LED] + run.step / _SWINGS * (jnp.clip(approach_rate, -rate, rate) - motion.v[LED])
    demanded_rates = jnp.where((jnp.abs(approach_rate) < _STILL) & (jnp.abs(motion.v[LED]) < _STILL), 0.0, led_rates)
    if sequence.begins is not None:
        demanded_rates = jnp.zeros_like(demanded_rates)
        front, rear = sequence.demand(motion.q[0], time)
        low = high = jnp.clip(jnp.stack([front, -rear]), low, high)
    # beyond its range a lever is not driven further
    angles = _convert_lever_angles(*motion.q[LED])
    above_range, below_range = angles > levers.angle_most + 1e-3, angles < levers.angle_least - 1e-3
    blocks_up, blocks_down = jnp.stack([above_range[0], below_range[1]]), jnp.stack([below_range[0], above_range[1]])
    low, high = (
        jnp.where(blocks_up, jnp.minimum(x, 0.0), jnp.where(blocks_down, jnp.maximum(x, 0.0), x)) for x in (low, high)
    )
    return step_levers(run.drive, run.step, motion.v[LED], free_rates, rate_per_torque, demanded_rates, low, high)


def advance_climb(
    run: ClimbSystem, motion: ClimbMotion, time: Scalar, energy: Energy
) -> tuple[ClimbMotion, Energy, ClimbRecord]:
    """One step, linearly implicit in the forces of contacts and drive, as `half_robot.advance`.

    (M + Δt K) Δv = Δt (Q - c). The drives' torques on the levers and the levers' rates are solved together within
    the step. Energy is that of the step's impulses at its mean velocities, with a motor current that changes
    linearly.

    Returns:
        Motion and energy after the step, and the record of the instant before it.
    """
    run = _with_lever_current(run, motion)
    voltage_share = jnp.clip((time - SETTLES) / RISES, 0.0, 1.0)
    signals, contacts, contact_forces, share = climb_instant(run, motion, voltage_share)
    robot = run.robot
    step = run.step
    radius = run.shape.main.first
    matrix, bias, height = mass_matrix_and_bias(run, motion.q, motion.v)
    ratio, rotor_inertia = robot.gearbox.ratio, robot.motor.inertia
    armature = rotor_inertia * ratio**2 * signals.efficiency_load + signals.inertia_added
    resistance_forces = signals.resistance * (share @ contacts.carried)
    force = contact_forces.force @ contacts.along + contacts.force @ contacts.off - resistance_forces
    force = force.at[SHAFT].set(signals.torque_net - resistance_forces[SHAFT])
    lever_belt_speeds = motion.v[SHAFT] + motion.v[LED]
    lever_loss, lever_loss_slope = value_and_slope(lambda speed: _lever_loss(run, speed), lever_belt_speeds)
    lever_loss_slope = jnp.maximum(lever_loss_slope, 0.0)
    force = force.at[LED].add(-lever_loss)

    traction_slope = jnp.maximum(
        run.chassis.ground.traction_rise(_sliding(contacts, motion.v, signals), contacts.force, signals.adhesion), 0
    )
    shaft_damping = _shaft_loss(run, motion, signals, contacts)
    damping = contact_damping(
        contacts.along, contacts.off, contact_forces.force, contacts.force, traction_slope, contacts.damped
    )
    damping = damping.at[SHAFT, SHAFT].add(shaft_damping) + (_ON_BELTS.T * lever_loss_slope) @ _ON_BELTS
    full_matrix = matrix.at[SHAFT, SHAFT].add(armature) + step * damping
    # of wheels, with massless levers
    full_matrix = full_matrix.at[LED, LED].add(1 - run.chassis.on_tracks)
    impulse = step * (force - bias)
    factors = factorise(full_matrix[:4, :4])
    # Change of the other velocities while the levers keep theirs, and its share per change of the levers' rates.
    other_change, *lever_columns = (
        solve_factorised(factors, x) for x in (impulse[:4], full_matrix[:4, 4], full_matrix[:4, 5])
    )
    coupling = jnp.stack(lever_columns, axis=1)
    coupled_matrix = full_matrix[4:, 4:] - full_matrix[4:, :4] @ coupling
    inverse = jnp.array(
        [[coupled_matrix[1, 1], -coupled_matrix[0, 1]], [-coupled_matrix[1, 0], coupled_matrix[0, 0]]]
    ) / (coupled_matrix[0, 0] * coupled_matrix[1, 1] - coupled_matrix[0, 1] * coupled_matrix[1, 0])
    lever_speeds = motion.v[LED] + inverse @ (impulse[4:] - full_matrix[4:, :4] @ other_change)
    lever_action = _drive_action(
        run, motion, time, signals.voltage_source, lever_speeds, step * inverse / robot.sides
    )
    lever_change = lever_action.rate - motion.v[LED]
    velocity_change = jnp.concatenate([other_change - coupling @ lever_change, lever_change])
    v = motion.v + velocity_change
    middle = motion.v + velocity_change / 2

    charge = balances.charge_drawn(robot, run.conditions, signals.total_current)
    current = current_after(robot, _driven(run, voltage_share), step, signals)
    lever_supply_current = (
        lever_action.voltage @ lever_action.current / jnp.maximum(jnp.abs(signals.voltage_source), 1e-9)
    )
    after = ClimbMotion(motion.q + step * v, v, current, motion.discharge + step * charge, lever_supply_current)

    drive = run.drive
    # (1 / step) is the compiler's form of a division by a constant: a step passed as an argument gives the same bits
    lever_gear_loss = (
        drive.constant * lever_action.current - drive.inertia * lever_change * (1 / step) - lever_action.torque
    ) @ middle[LED]
    off_change, along_change = contacts.off @ velocity_change, contacts.along @ velocity_change
    normal = contacts.force - contacts.damped * off_change
    friction = (
        contact_forces.force
        - traction_slope * along_change
        - contact_forces.force / jnp.maximum(contacts.force, 1e-9) * contacts.damped * off_change
    )
    motor_speed = ratio * middle[SHAFT]
    driving_torque = signals.torque_motor - signals.torque_idle
    mesh_torque = driving_torque - rotor_inertia * ratio * velocity_change[SHAFT] * (1 / step)
    imbalance = (
        signals.torque_load - signals.torque_track_loss - (contact_forces.load - contact_forces.guide * radius)
    )
    current_rise = current - signals.current
    mean_current = signals.current + current_rise / 2
    resistance = robot.motor.resistance
    step_energies = run.step * robot.sides * jnp.stack([
        signals.voltage * mean_current,
        lever_action.voltage @ lever_action.current / robot.sides,
        (signals.voltage_drop + resistance * current_rise / 2) * mean_current + resistance * current_rise**2 / 12,
        signals.torque_motor_loss * motor_speed,
        (signals.torque_idle + (1 - signals.efficiency_load) * mesh_torque) * motor_speed + imbalance * middle[SHAFT],
        (signals.torque_track_loss + shaft_damping * velocity_change[SHAFT]) * middle[SHAFT]
        + (lever_loss + lever_loss_slope * (_ON_BELTS @ velocity_change)) @ (_ON_BELTS @ middle),
        -friction @ (contacts.along @ middle),
        -(normal - contacts.elastic) @ (contacts.off @ middle),
        resistance_forces @ middle,
        drive.resistance * lever_action.current @ lever_action.current / robot.sides,
        lever_gear_loss / robot.sides,
    ])  # fmt: skip
    energy_after = {name: energy[name] + step_energies[k] for k, name in enumerate((*SOURCES, *LOSSES))}
    kinetic = motion.v @ matrix @ motion.v + (signals.inertia_added + rotor_inertia * ratio**2) * motion.v[SHAFT] ** 2
    stored = kinetic / 2 + signals.inductance * motion.current**2 / 2 + height + jnp.sum(contacts.energy)
    upward = jnp.array([1.0, -1.0])  # for a rear lever, upward is decreasing ψ
    total_force = jnp.sum(contacts.force)
    adhesion_force = run.chassis.ground.force_adhesion(jnp.sum(contacts.force * contacts.rolls), signals.adhesion)
    centre = motion.q[0] - matrix[1, PITCH] / matrix[0, 0]
    is_loaded = contacts.force > 0
    ahead_of_centre = contacts.place - centre
    record = ClimbRecord(
        time=time,
        motion=motion,
        current=signals.current,
        total_current=signals.total_current + lever_supply_current,
        voltage=signals.voltage,
        torque=upward * lever_action.torque,
        lever_current=upward * lever_action.current,
        lever_voltage=upward * lever_action.voltage,
        holds=1.0 * lever_action.holds,
        energy=energy,
        stored=robot.sides * stored + drive.inertia * motion.v[LED] @ motion.v[LED] / 2,
        normal=total_force,
        body=jnp.sum(contacts.force * (1 - contacts.rolls)) / jnp.maximum(total_force, 1e-9),
        grip=jnp.sum(jnp.abs(contact_forces.force) * contacts.rolls) / jnp.maximum(adhesion_force, 1e-9),
        carried=total_force / (GRAVITY * matrix[0, 0]),
        centre=centre,
        base=jnp.stack(
            [jnp.max(jnp.where(is_loaded, distance, -jnp.inf)) for distance in (-ahead_of_centre, ahead_of_centre)]
        ),
    )
    return after, energy_after, record


def _shaft_loss(run: ClimbSystem, motion: ClimbMotion, signals: Signals, contacts: Footing) -> Scalar:
    """Derivative of the drive's losses with respect to the shaft speed, at least 0 [N·m·s]. It is large at rest.

    Contacts and winding are excluded because they are resolved in time.
    """
    one = jnp.ones_like(motion.v[SHAFT])
    force = jnp.sum(run.chassis.track.guide_friction * contacts.guided * contacts.force) * run.shape.main.first

    def loss(speed: Scalar) -> Scalar:
        direction = contact.smooth_sign(run.chassis.radius * speed, run.chassis.speed_still)
        motor_speed = speed * run.robot.gearbox.ratio
        idle_torque = run.robot.motor.torque_loss(motor_speed, direction) + run.robot.gearbox.torque_idle(
            motor_speed, direction
        )
        track_loss = run.chassis.track.torque_loss(speed, direction)
        return track_loss + force * direction + idle_torque * run.robot.gearbox.ratio * signals.efficiency_load

    return jnp.maximum(jax.jvp(loss, (motion.v[SHAFT],), (one,))[1], 0.0)


class VerdictState(eqx.Module):
    """State of the verdict: the verdict and its time.

    It also has the furthest position, its time, and the shaft angle since then.
    """

    verdict: Array
    ended: Scalar
    furthest: Scalar
    since: Scalar
    shaft_angle: Scalar


def stand_before_obstacle(run: ClimbSystem, clear: float = 0.1) -> ClimbMotion:
    """Initial motion: at rest on the ground, with the foremost point `clear` [m] before the obstacle."""
    shape = run.shape
    angles = run.sequence.first
    belt_radius = shape.main.first + shape.gear.grouser_height
    axle = jnp.where(shape.on_tracks > 0.5, belt_radius, shape.wheel)
    roller_reach = shape.gear.lever_length * jnp.cos(angles[0]) + shape.gear.levers.roller
    reach = shape.half + jnp.maximum(axle, jnp.where(shape.on_tracks > 0.5, roller_reach, 0.0))
    x = -(reach + clear)
    ground_point = jnp.stack([x, jnp.zeros_like(x)])
    gap, normal = (array[0] for array in run.terrain.distance(ground_point[None]))
    place = ground_point + (axle - gap - 2e-5) * normal
    zero = jnp.zeros_like(x)
    q = jnp.stack([place[0], place[1], jnp.arctan2(normal[0], normal[1]), zero, angles[0], angles[1]])
    return ClimbMotion(q, jnp.zeros(COORDINATES), zero, run.conditions.discharge + zero, zero)


def _update_verdict(
    run: ClimbSystem, before: ClimbMotion, record: ClimbRecord, motion: ClimbMotion, progress: VerdictState
) -> tuple[ClimbMotion, VerdictState]:
    """Verdict of a run after one more sample. A run that has ended keeps its state."""
    q, v = motion.q, motion.v
    belt_radius = run.shape.main.first + run.shape.gear.grouser_height
    is_finite = jnp.all(jnp.isfinite(q)) & jnp.all(jnp.isfinite(v)) & jnp.isfinite(motion.current)
    is_finite = is_finite & (jnp.max(jnp.abs(v)) < 1e4)
    rear = q[0] - run.shape.half * jnp.cos(q[PITCH])
    has_advanced = q[0] > progress.furthest + GAIN
    is_swinging = jnp.max(jnp.abs(v[LED])) > 0.05
    has_progressed = has_advanced | is_swinging | (record.time < SETTLES)
    progress = VerdictState(
        progress.verdict,
        jnp.where(progress.verdict == _RUNNING, record.time, progress.ended),
        jnp.where(has_advanced, q[0], progress.furthest),
        jnp.where(has_progressed, record.time, progress.since),
        jnp.where(has_progressed, q[SHAFT], progress.shaft_angle),
    )
    waiting_time = record.time - progress.since
    stuck = waiting_time > PATIENCE
    is_standing = jnp.abs(q[SHAFT] - progress.shaft_angle) * run.shape.main.first < STANDS * PATIENCE
    fallen = q[1] < jnp.minimum(run.terrain.points[0, 1], run.terrain.points[-1, 1])
    stuck_verdict = jnp.where(is_standing, STALLS, jnp.where((record.body > BEARS) | fallen, HANGS, SLIDES))
    verdict = jnp.where(stuck, stuck_verdict, _RUNNING)
    verdict = jnp.where(rear > run.terrain.finish + belt_radius, OVER, verdict)
    verdict = jnp.where(jnp.abs(q[PITCH]) > TURNED_OVER, TIPS, verdict)
    verdict = jnp.where(is_finite, verdict, FAILED)
    has_ended = progress.verdict != _RUNNING
    verdict = jnp.where(has_ended, progress.verdict, verdict)
    motion = jax.tree.map(lambda new, old: jnp.where(is_finite & ~has_ended, new, old), motion, before)
    return motion, dataclasses.replace(progress, verdict=verdict)


def begin_climb(run: ClimbSystem, motion: ClimbMotion | None = None) -> tuple[ClimbMotion, Energy, VerdictState]:
    """Initial motion (None: at rest before the obstacle), zero energy, and the initial verdict.

    The verdict is `failed` if the levers would start below the ground. Otherwise the run continues.
    """
    angles = _convert_lever_angles(*run.sequence.first)
    gear = run.shape.gear
    is_below_ground = roller_clearance(run.shape.main.first + gear.grouser_height, gear, angles) < -ON_GROUND
    is_buried = jnp.any(is_below_ground & (run.shape.on_tracks > 0.5)) & (motion is None)
    motion = stand_before_obstacle(run) if motion is None else motion
    zero = jnp.zeros_like(motion.q[0])
    energy = dict.fromkeys((*SOURCES, *LOSSES), zero)
    return motion, energy, VerdictState(jnp.where(is_buried, FAILED, _RUNNING), zero, motion.q[0], zero, zero)


def roller_clearance(axle: Scalar, gear: RunningGear, angles: Float[Array, " levers"]) -> Float[Array, " levers"]:
    """Height of the rollers of levers at `angles` [rad] above level ground [m], for axles at height `axle` [m]."""
    return axle + gear.lever_length * jnp.sin(angles) - gear.levers.roller


def advance_samples(
    run: ClimbSystem, state: Any, first: Scalar, steps: Scalar, samples: int
) -> tuple[Any, ClimbRecord]:
    """State and record of a part of a run with `samples` samples of `steps` steps each, from time `first` [s].

    A record holds the last step of its sample, and the largest load on the base within it. Each sample updates the
    verdict. The energy of a run that has ended stays as it is.
    """

    def sample(state: Any, k: Array) -> tuple[Any, ClimbRecord]:
        motion, energy, progress = state

        def advance_step(j: Array, carry: Any) -> Any:
            *after, record = advance_climb(run, carry[0], first + (k * steps + j) * run.step, carry[1])
            base = jnp.maximum(record.base, carry[2].base)
            return (*after, dataclasses.replace(record, base=base))

        no_record = jax.eval_shape(lambda: advance_climb(run, motion, first, energy)[2])
        no_record = jax.tree.map(lambda x: jnp.full(x.shape, -jnp.inf, x.dtype), no_record)
        after, energy_after, sample_record = jax.lax.fori_loop(0, steps, advance_step, (motion, energy, no_record))
        has_ended = progress.verdict != _RUNNING
        after, progress = _update_verdict(run, motion, sample_record, after, progress)
        energy_kept = jax.tree.map(lambda new, old: jnp.where(has_ended, old, new), energy_after, energy)
        return (after, energy_kept, progress), sample_record

    return jax.lax.scan(sample, state, jnp.arange(samples))


def divide_run(duration: float, step: float, sample: float, part: float) -> tuple[int, int, int]:
    """Division of a run of length `duration`: number of parts (no longer than `part`), samples per part, steps per
    sample.

    A sample has a whole number of steps and all parts are equal, so the run may be a few samples longer.
    """
    steps = max(round(sample / step), 1)
    parts = math.ceil(duration / part - 1e-9)
    return parts, math.ceil(duration / (parts * steps * step) - 1e-9), steps


class ClimbRuns(eqx.Module):
    """Simulated climbs: verdicts as indices into `NAMES`, their times [s], and records of shape (runs, samples)."""

    verdict: np.ndarray
    ended: np.ndarray
    furthest: np.ndarray
    record: ClimbRecord

    @property
    def names(self) -> list[str]:
        """Verdicts in words."""
        return [NAMES[k] for k in self.verdict]

    @property
    def before_verdict(self) -> np.ndarray:
        """Mask of the samples before a run's verdict, after which its state is constant, shape (runs, samples)."""
        return np.asarray(self.record.time) <= np.asarray(self.ended)[:, None] + 1e-9

    def run(self, k: int) -> ClimbRecord:
        """The record of run `k` until its verdict, shape (samples,)."""
        count = int(np.sum(self.before_verdict[k]))
        return jax.tree.map(lambda x: x[k, :count], self.record)


def _robot_axis(robot: Robot) -> int | None:
    """Batch axis in the parameters of a robot, None if all runs have the same robot."""
    return 0 if jnp.ndim(robot.sides) else None


@compiled
def _begin_batch(
    robot: Robot,
    conditions: Conditions,
    terrain: Terrain,
    sequence: LeverSequence,
    step: Scalar,
    motion: ClimbMotion | None,
) -> Any:
    def begin_one(
        robot: Robot, conditions: Conditions, terrain: Terrain, sequence: LeverSequence, motion: ClimbMotion | None
    ) -> Any:
        return begin_climb(build_climb_system(robot, conditions, terrain, sequence, step), motion)

    return jax.vmap(begin_one, in_axes=(_robot_axis(robot), 0, 0, 0, 0))(robot, conditions, terrain, sequence, motion)


def _advance_batch(
    robot: Robot, conditions: Conditions, terrain: Terrain, sequence: LeverSequence, state: Any, first: Scalar,
    step: Scalar, steps: Scalar, samples: int,
) -> tuple[Any, ClimbRecord]:  # fmt: skip
    def advance_one(
        robot: Robot, conditions: Conditions, terrain: Terrain, sequence: LeverSequence, state: Any
    ) -> Any:
        return advance_samples(
            build_climb_system(robot, conditions, terrain, sequence, step), state, first, steps, samples
        )

    in_axes = (_robot_axis(robot), 0, 0, 0, 0)
    parts: tuple[Any, ClimbRecord] = jax.vmap(advance_one, in_axes=in_axes)(
        robot, conditions, terrain, sequence, state
    )
    return parts


_advance_compiled = compiled(_advance_batch, options=SMALL)


def climb_batch(
    robot: Robot,
    conditions: Conditions,
    terrain: Terrain,
    sequence: LeverSequence,
    *,
    duration: float = DURATION,
    step: float = STEP,
    sample: float = SAMPLE,
    part: float = 1.0,
    record: bool = True,
    start: ClimbMotion | None = None,
    progress: Callable[[float], None] | None = None,
) -> ClimbRuns:
    """Simulates climbs over a batch of conditions, terrains and sequences (first axis of every field) until all have
    ended.

    Args:
        robot: robot of all runs, or a batch with a first axis in every parameter.
        duration: duration of the longest run [s].
        step, sample: intervals of integration and of the record [s].
        part: simulated time between checks for the end of all runs [s].
        record: True to return all samples, False to return only the last one.
        start: initial motions. None: at rest before the obstacle.
        progress: callback with the finished share of the time.
    """
    parts, samples, steps = divide_run(duration, step, sample, part)
    # Arrays: one program for all lengths of a step.
    interval = jnp.asarray(step, float)
    steps_per_sample = jnp.asarray(steps)
    state = _begin_batch(robot, conditions, terrain, sequence, interval, start)
    records: list[ClimbRecord] = []
    for k in range(parts):
        first_time = jnp.asarray(k * samples * steps * step)
        state, part_record = _advance_compiled(
            robot, conditions, terrain, sequence, state, first_time, interval, steps_per_sample, samples
        )
        verdict = np.asarray(state[2].verdict)
        kept_record = part_record if record else jax.tree.map(lambda x: x[:, -1:], part_record)
        records = [*(records if record else []), jax.device_get(kept_record)]
        if progress is not None:
            progress((k + 1) / parts)
        if np.all(verdict != _RUNNING):
            break
    verdict = np.where(verdict == _RUNNING, UNFINISHED, verdict)
    joined_record = jax.tree.map(lambda *x: np.concatenate(x, axis=1), *records)
    return ClimbRuns(verdict, np.asarray(state[2].ended), np.asarray(state[2].furthest), joined_record)
