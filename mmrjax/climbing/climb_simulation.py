"""Half a robot with levers on a terrain in its plane of travel: its state, one time step, and the verdict of a run.

The bodies are the chassis with payload, two pulleys and two levers. The belts run rigidly with the pulleys. The
levers' drives follow a sequence of angles, limited by the levers' rate, or have given voltages.
`contacts_with_terrain` computes the contacts, `balances` the drive of the tracks, `lever_drives` that of the levers.
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
        at: knots: position of the middle of the wheelbase from the start of the obstacle [m], or time [s].
        front, rear: values at the knots: angles, 0 along the wheelbase outward, positive up [rad], or voltages,
            positive up [V].
        begins: initial angles of front and rear levers that are driven by voltages [rad]. None: the sequence states
            angles.
        over_time: True if the knots are times.
        supply: highest voltage of the lever motors [V]. None: that of the supply.
    """

    at: Float[Array, " knots"]
    front: Float[Array, " knots"]
    rear: Float[Array, " knots"]
    begins: Pair | None = None
    over_time: bool = eqx.field(default=False, static=True)
    supply: Scalar | None = None

    @property
    def first(self) -> Pair:
        """Initial ψ of both levers [rad]."""
        return _convert_lever_angles(*(self.asked(-jnp.inf, 0.0) if self.begins is None else self.begins))

    def asked(self, place: Scalar, time: Scalar) -> tuple[Array, Array]:
        """Demanded angles of front and rear [rad], or voltages of their motors, positive up [V]."""
        abscissa = time if self.over_time else place
        return jnp.interp(abscissa, self.at, self.front), jnp.interp(abscissa, self.at, self.rear)


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
    drawn: Scalar


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
    none = jnp.zeros_like(chassis.on_tracks)
    lever = jnp.stack([gear.lever_mass, gear.lever_centre, gear.lever_inertia]) * jnp.stack(
        [chassis.on_tracks, jnp.ones(()), chassis.on_tracks]
    )
    main_track, lever_track = (
        jax.tree.map(lambda tracked, wheeled: jnp.where(chassis.on_tracks > 0.5, tracked, wheeled), *tracks)
        for tracks in zip(
            gear.levers.tracks(chassis.track),
            (chassis.track, dataclasses.replace(chassis.track, loss_coulomb=none, loss_viscous=none)),
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
    down = GRAVITY * jnp.stack([jnp.sin(run.conditions.slope), jnp.cos(run.conditions.slope)])
    zero, one = jnp.zeros(()), jnp.ones(())

    def across(arm: Array) -> Array:
        """Velocity of a point at `arm` that rotates nose down, per angular speed."""
        return jnp.stack([arm[1], -arm[0]])

    matrix, bias, height = jnp.zeros((COORDINATES, COORDINATES)), jnp.zeros(COORDINATES), zero
    mass_lever, centre_lever = run.lever[0], run.lever[1]
    masses: list[tuple[Scalar, Array, Array | None, int | None]] = []
    arm = body.along(jnp.stack([half.forward, half.up]))
    masses.append((half.chassis, arm, None, None))
    for lever in levers:
        axle = lever.origin - body.origin
        masses.append((half.pulley, axle, None, None))
        reach = lever.along(jnp.stack([centre_lever, zero]))
        masses.append((mass_lever, axle + reach, reach, lever.turns))
    for mass, place, out, turns in masses:
        columns = [jnp.stack([one, zero]), jnp.stack([zero, one]), across(place), *[jnp.zeros(2)] * 3]
        centrifugal = -place * v[PITCH] ** 2
        if out is not None and turns is not None:
            columns[turns] = -across(out)
            centrifugal = -(place - out) * v[PITCH] ** 2 - out * (v[PITCH] - v[turns]) ** 2
        moves = jnp.stack(columns, axis=1)
        matrix = matrix + mass * moves.T @ moves
        bias = bias + mass * moves.T @ (centrifugal + down)
        height = height + mass * down @ (body.origin + place)
    turning = [(half.inertia, {PITCH: 1.0}), (2 * half.inertia_pulley, {PITCH: 1.0, SHAFT: 1.0})]
    turning += [(run.lever[2], {PITCH: 1.0, k: -1.0}) for k in (FRONT, REAR)]
    for about, shares in turning:
        row = jnp.zeros(COORDINATES).at[np.array(list(shares))].set(jnp.array(list(shares.values())))
        matrix = matrix + about * jnp.outer(row, row)
    return matrix, bias, height


class _ContactForces(eqx.Module):
    """Forces of the contacts, in the form that `balances.resolved_signals` expects."""

    traction: Scalar
    guide: Scalar
    load: Scalar
    force: Float[Array, " pairs"]


class _LeveredContacts(eqx.Module):
    at: Footing
    v: Array
    radius: Scalar
    levers: Scalar  # losses of the levers' tracks, at the shaft [N·m]

    @property
    def normal(self) -> Scalar:
        """Total normal load on all rolling contacts of one side [N]."""
        return jnp.sum(self.at.force * self.at.rolls)

    def pull(self, chassis: Chassis, signals: Signals) -> _ContactForces:
        """Friction of the contacts (25) by Fig. 7, and of the guide (26)."""
        touching = self.at
        force = jnp.asarray(
            chassis.ground.traction(_sliding(touching, self.v, signals), touching.force, signals.adhesion)
        )
        guide = jnp.sum(chassis.track.guide_friction * touching.guided * touching.force * signals.direction)
        load = (
            guide * self.radius
            + self.levers
            - jnp.sum(force * touching.along[:, SHAFT] + touching.force * touching.off[:, SHAFT])
        )
        return _ContactForces(jnp.sum(force), guide, load, force)


def _sliding(at: Footing, v: Array, signals: Signals) -> Array:
    return -(at.along @ v) - signals.speed_slip_terms


def climb_instant(
    run: ClimbSystem, motion: ClimbMotion, on: Scalar
) -> tuple[Signals, Footing, _ContactForces, Array]:
    """All signals, contacts, forces and load shares of an instant. `on`: fraction of the voltage that is applied to
    each motor.
    """
    touching = footing.contacts_with_terrain(run.shape, run.terrain, motion.q, motion.v)
    # share of each rolling contact in the load, and the robot's speed along the ground, their load-weighted mean
    bearing_force = touching.force * touching.rolls
    share = bearing_force / jnp.maximum(jnp.sum(bearing_force), 1e-9)
    speed = share @ (touching.carried @ motion.v)
    conditions = _driven(run, on)

    ratio = run.robot.gearbox.ratio
    state = State(motion.current, ratio * motion.v[SHAFT], speed, motion.discharge)
    mover = _LeveredContacts(
        touching, motion.v, run.shape.main.first, jnp.sum(_lever_loss(run, motion.v[SHAFT] + motion.v[LED]))
    )
    signals, pulled = balances.resolved_signals(run.robot, conditions, state, mover, 2 * run.half.inertia_pulley)
    return signals, touching, pulled, share


def _driven(run: ClimbSystem, on: Scalar) -> Conditions:
    return dataclasses.replace(run.conditions, duty=run.conditions.duty * on)


def _lever_loss(run: ClimbSystem, speed: Array) -> Array:
    """Loss torques of the lever tracks (24) [N·m], at the speeds of their pulleys relative to the levers [rad/s]."""
    direction = contact.smooth_sign(run.shape.main.first * speed, run.chassis.speed_still)
    return jnp.asarray(run.lever_track.torque_loss(speed, direction))


def _with_lever_current(run: ClimbSystem, motion: ClimbMotion) -> ClimbSystem:
    """Run in which the current of the lever motors is added to the battery's other consumers, I_s of eq. (10)."""
    battery = run.robot.battery
    battery = dataclasses.replace(battery, current_other=battery.current_other + motion.drawn)
    return dataclasses.replace(run, robot=dataclasses.replace(run.robot, battery=battery))


def _drive_action(
    run: ClimbSystem, motion: ClimbMotion, time: Scalar, source: Scalar, free: Array, yields: Array
) -> LeverStep:
    """Action of the lever drives in a step. Without it, the rates after the step would be `free` [rad/s]."""
    levers, sequence = run.robot.running_gear.levers, run.sequence
    lever_voltage = jnp.abs(source) if sequence.supply is None else sequence.supply
    high = jnp.stack([lever_voltage, lever_voltage])
    low = -high
    # The levers move to the angles of the sequence, at most at their largest rate. One that has reached its angle
    # stands still.
    rate = run.robot.running_gear.levers.rate
    toward = (_convert_lever_angles(*run.sequence.asked(motion.q[0], time)) - motion.q[LED]) / (4 * _SWINGS)
    speed = motion.v[LED] + run.step / _SWINGS * (jnp.clip(toward, -rate, rate) - motion.v[LED])
    aims = jnp.where((jnp.abs(toward) < _STILL) & (jnp.abs(motion.v[LED]) < _STILL), 0.0, speed)
    if sequence.begins is not None:
        aims = jnp.zeros_like(aims)
        front, rear = sequence.asked(motion.q[0], time)
        low = high = jnp.clip(jnp.stack([front, -rear]), low, high)
    # beyond its range a lever is not driven further
    angles = _convert_lever_angles(*motion.q[LED])
    above_range, below_range = angles > levers.angle_most + 1e-3, angles < levers.angle_least - 1e-3
    up, down = jnp.stack([above_range[0], below_range[1]]), jnp.stack([below_range[0], above_range[1]])
    low, high = (jnp.where(up, jnp.minimum(x, 0.0), jnp.where(down, jnp.maximum(x, 0.0), x)) for x in (low, high))
    return step_levers(run.drive, run.step, motion.v[LED], free, yields, aims, low, high)


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
    run, on = _with_lever_current(run, motion), jnp.clip((time - SETTLES) / RISES, 0.0, 1.0)
    signals, touching, pulled, share = climb_instant(run, motion, on)
    robot, step, radius = run.robot, run.step, run.shape.main.first
    matrix, bias, height = mass_matrix_and_bias(run, motion.q, motion.v)
    ratio, rotor = robot.gearbox.ratio, robot.motor.inertia
    armature = rotor * ratio**2 * signals.efficiency_load + signals.inertia_added
    resisted = signals.resistance * (share @ touching.carried)
    force = pulled.force @ touching.along + touching.force @ touching.off - resisted
    force = force.at[SHAFT].set(signals.torque_net - resisted[SHAFT])
    belts = motion.v[SHAFT] + motion.v[LED]
    lever_loss, stiffens = value_and_slope(lambda speed: _lever_loss(run, speed), belts)
    stiffens = jnp.maximum(stiffens, 0.0)
    force = force.at[LED].add(-lever_loss)

    rises = jnp.maximum(
        run.chassis.ground.traction_rise(_sliding(touching, motion.v, signals), touching.force, signals.adhesion), 0
    )
    shaft = _shaft_loss(run, motion, signals, touching)
    damping = contact_damping(touching.along, touching.off, pulled.force, touching.force, rises, touching.damped)
    damping = damping.at[SHAFT, SHAFT].add(shaft) + (_ON_BELTS.T * stiffens) @ _ON_BELTS
    full_matrix = matrix.at[SHAFT, SHAFT].add(armature) + step * damping
    # of wheels, with massless levers
    full_matrix = full_matrix.at[LED, LED].add(1 - run.chassis.on_tracks)
    pushed = step * (force - bias)
    factors = factorise(full_matrix[:4, :4])
    # Change of the other velocities while the levers keep theirs, and its share per change of the levers' rates.
    change, *coupled = (solve_factorised(factors, x) for x in (pushed[:4], full_matrix[:4, 4], full_matrix[:4, 5]))
    coupling = jnp.stack(coupled, axis=1)
    coupled_matrix = full_matrix[4:, 4:] - full_matrix[4:, :4] @ coupling
    inverse = jnp.array(
        [[coupled_matrix[1, 1], -coupled_matrix[0, 1]], [-coupled_matrix[1, 0], coupled_matrix[0, 0]]]
    ) / (coupled_matrix[0, 0] * coupled_matrix[1, 1] - coupled_matrix[0, 1] * coupled_matrix[1, 0])
    lever_speeds = motion.v[LED] + inverse @ (pushed[4:] - full_matrix[4:, :4] @ change)
    swung = _drive_action(run, motion, time, signals.voltage_source, lever_speeds, step * inverse / robot.sides)
    led = swung.rate - motion.v[LED]
    gained = jnp.concatenate([change - coupling @ led, led])
    v = motion.v + gained
    middle = motion.v + gained / 2

    charge = balances.charge_drawn(robot, run.conditions, signals.total_current)
    current = current_after(robot, _driven(run, on), step, signals)
    lever_current = swung.voltage @ swung.current / jnp.maximum(jnp.abs(signals.voltage_source), 1e-9)
    after = ClimbMotion(motion.q + step * v, v, current, motion.discharge + step * charge, lever_current)

    pair = run.drive
    # (1 / step) is the compiler's form of a division by a constant: a step passed as an argument gives the same bits
    geared = (pair.constant * swung.current - pair.inertia * led * (1 / step) - swung.torque) @ middle[LED]
    off, along = touching.off @ gained, touching.along @ gained
    normal = touching.force - touching.damped * off
    friction = pulled.force - rises * along - pulled.force / jnp.maximum(touching.force, 1e-9) * touching.damped * off
    motor = ratio * middle[SHAFT]
    drive = signals.torque_motor - signals.torque_idle
    mesh = drive - rotor * ratio * gained[SHAFT] * (1 / step)
    imbalance = signals.torque_load - signals.torque_track_loss - (pulled.load - pulled.guide * radius)
    rise = current - signals.current
    mean, resistance = signals.current + rise / 2, robot.motor.resistance
    added = run.step * robot.sides * jnp.stack([
        signals.voltage * mean,
        swung.voltage @ swung.current / robot.sides,
        (signals.voltage_drop + resistance * rise / 2) * mean + resistance * rise**2 / 12,
        signals.torque_motor_loss * motor,
        (signals.torque_idle + (1 - signals.efficiency_load) * mesh) * motor + imbalance * middle[SHAFT],
        (signals.torque_track_loss + shaft * gained[SHAFT]) * middle[SHAFT]
        + (lever_loss + stiffens * (_ON_BELTS @ gained)) @ (_ON_BELTS @ middle),
        -friction @ (touching.along @ middle),
        -(normal - touching.elastic) @ (touching.off @ middle),
        resisted @ middle,
        pair.resistance * swung.current @ swung.current / robot.sides,
        geared / robot.sides,
    ])  # fmt: skip
    spent = {name: energy[name] + added[k] for k, name in enumerate((*SOURCES, *LOSSES))}
    kinetic = motion.v @ matrix @ motion.v + (signals.inertia_added + rotor * ratio**2) * motion.v[SHAFT] ** 2
    stored = kinetic / 2 + signals.inductance * motion.current**2 / 2 + height + jnp.sum(touching.energy)
    up = jnp.array([1.0, -1.0])  # for a rear lever, upward is decreasing ψ
    total = jnp.sum(touching.force)
    adhesion_force = run.chassis.ground.force_adhesion(jnp.sum(touching.force * touching.rolls), signals.adhesion)
    centre = motion.q[0] - matrix[1, PITCH] / matrix[0, 0]
    is_loaded, ahead = touching.force > 0, touching.place - centre
    record = ClimbRecord(
        time=time,
        motion=motion,
        current=signals.current,
        total_current=signals.total_current + lever_current,
        voltage=signals.voltage,
        torque=up * swung.torque,
        lever_current=up * swung.current,
        lever_voltage=up * swung.voltage,
        holds=1.0 * swung.holds,
        energy=energy,
        stored=robot.sides * stored + pair.inertia * motion.v[LED] @ motion.v[LED] / 2,
        normal=total,
        body=jnp.sum(touching.force * (1 - touching.rolls)) / jnp.maximum(total, 1e-9),
        grip=jnp.sum(jnp.abs(pulled.force) * touching.rolls) / jnp.maximum(adhesion_force, 1e-9),
        carried=total / (GRAVITY * matrix[0, 0]),
        centre=centre,
        base=jnp.stack([jnp.max(jnp.where(is_loaded, way, -jnp.inf)) for way in (-ahead, ahead)]),
    )
    return after, spent, record


def _shaft_loss(run: ClimbSystem, motion: ClimbMotion, signals: Signals, at: Footing) -> Scalar:
    """Derivative of the drive's losses with respect to the shaft speed, at least 0 [N·m·s]. It is large at rest.

    Contacts and winding are excluded because they are resolved in time.
    """
    one = jnp.ones_like(motion.v[SHAFT])
    force = jnp.sum(run.chassis.track.guide_friction * at.guided * at.force) * run.shape.main.first

    def loss(speed: Scalar) -> Scalar:
        direction = contact.smooth_sign(run.chassis.radius * speed, run.chassis.speed_still)
        motor = speed * run.robot.gearbox.ratio
        idle_torque = run.robot.motor.torque_loss(motor, direction) + run.robot.gearbox.torque_idle(motor, direction)
        track = run.chassis.track.torque_loss(speed, direction)
        return track + force * direction + idle_torque * run.robot.gearbox.ratio * signals.efficiency_load

    return jnp.maximum(jax.jvp(loss, (motion.v[SHAFT],), (one,))[1], 0.0)


class VerdictState(eqx.Module):
    """State of the verdict: the verdict and its time.

    It also has the furthest position, its time, and the shaft angle since then.
    """

    verdict: Array
    ended: Scalar
    furthest: Scalar
    since: Scalar
    belt: Scalar


def stand_before_obstacle(run: ClimbSystem, clear: float = 0.1) -> ClimbMotion:
    """Initial motion: at rest on the ground, with the foremost point `clear` [m] before the obstacle."""
    shape = run.shape
    angles = run.sequence.first
    outer = shape.main.first + shape.gear.grouser_height
    axle = jnp.where(shape.on_tracks > 0.5, outer, shape.wheel)
    tip = shape.gear.lever_length * jnp.cos(angles[0]) + shape.gear.levers.roller
    reach = shape.half + jnp.maximum(axle, jnp.where(shape.on_tracks > 0.5, tip, 0.0))
    x = -(reach + clear)
    below = jnp.stack([x, jnp.zeros_like(x)])
    gap, normal = (a[0] for a in run.terrain.distance(below[None]))
    place = below + (axle - gap - 2e-5) * normal
    zero = jnp.zeros_like(x)
    q = jnp.stack([place[0], place[1], jnp.arctan2(normal[0], normal[1]), zero, angles[0], angles[1]])
    return ClimbMotion(q, jnp.zeros(COORDINATES), zero, run.conditions.discharge + zero, zero)


def _update_verdict(
    run: ClimbSystem, before: ClimbMotion, passed: ClimbRecord, motion: ClimbMotion, progress: VerdictState
) -> tuple[ClimbMotion, VerdictState]:
    """Verdict of a run after one more sample. A run that has ended keeps its state."""
    q, v = motion.q, motion.v
    outer = run.shape.main.first + run.shape.gear.grouser_height
    finite = jnp.all(jnp.isfinite(q)) & jnp.all(jnp.isfinite(v)) & jnp.isfinite(motion.current)
    finite = finite & (jnp.max(jnp.abs(v)) < 1e4)
    rear = q[0] - run.shape.half * jnp.cos(q[PITCH])
    gained = q[0] > progress.furthest + GAIN
    swings = jnp.max(jnp.abs(v[LED])) > 0.05
    has_progressed = gained | swings | (passed.time < SETTLES)
    progress = VerdictState(
        progress.verdict,
        jnp.where(progress.verdict == _RUNNING, passed.time, progress.ended),
        jnp.where(gained, q[0], progress.furthest),
        jnp.where(has_progressed, passed.time, progress.since),
        jnp.where(has_progressed, q[SHAFT], progress.belt),
    )
    waits = passed.time - progress.since
    stuck = waits > PATIENCE
    stands = jnp.abs(q[SHAFT] - progress.belt) * run.shape.main.first < STANDS * PATIENCE
    fallen = q[1] < jnp.minimum(run.terrain.points[0, 1], run.terrain.points[-1, 1])
    why = jnp.where(stands, STALLS, jnp.where((passed.body > BEARS) | fallen, HANGS, SLIDES))
    verdict = jnp.where(stuck, why, _RUNNING)
    verdict = jnp.where(rear > run.terrain.finish + outer, OVER, verdict)
    verdict = jnp.where(jnp.abs(q[PITCH]) > TURNED_OVER, TIPS, verdict)
    verdict = jnp.where(finite, verdict, FAILED)
    has_ended = progress.verdict != _RUNNING
    verdict = jnp.where(has_ended, progress.verdict, verdict)
    motion = jax.tree.map(lambda new, old: jnp.where(finite & ~has_ended, new, old), motion, before)
    return motion, dataclasses.replace(progress, verdict=verdict)


def begin_climb(run: ClimbSystem, motion: ClimbMotion | None = None) -> tuple[ClimbMotion, Energy, VerdictState]:
    """Initial motion (None: at rest before the obstacle), zero energy, and the initial verdict.

    The verdict is `failed` if the levers would start below the ground. Otherwise the run continues.
    """
    angles, gear = _convert_lever_angles(*run.sequence.first), run.shape.gear
    under = roller_clearance(run.shape.main.first + gear.grouser_height, gear, angles) < -ON_GROUND
    buried = jnp.any(under & (run.shape.on_tracks > 0.5)) & (motion is None)
    motion = stand_before_obstacle(run) if motion is None else motion
    zero = jnp.zeros_like(motion.q[0])
    energy = dict.fromkeys((*SOURCES, *LOSSES), zero)
    return motion, energy, VerdictState(jnp.where(buried, FAILED, _RUNNING), zero, motion.q[0], zero, zero)


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

        def small(j: Array, carry: Any) -> Any:
            *after, record = advance_climb(run, carry[0], first + (k * steps + j) * run.step, carry[1])
            base = jnp.maximum(record.base, carry[2].base)
            return (*after, dataclasses.replace(record, base=base))

        nothing = jax.eval_shape(lambda: advance_climb(run, motion, first, energy)[2])
        nothing = jax.tree.map(lambda x: jnp.full(x.shape, -jnp.inf, x.dtype), nothing)
        after, spent, passed = jax.lax.fori_loop(0, steps, small, (motion, energy, nothing))
        has_ended = progress.verdict != _RUNNING
        after, progress = _update_verdict(run, motion, passed, after, progress)
        energy_recorded = jax.tree.map(lambda new, old: jnp.where(has_ended, old, new), spent, energy)
        return (after, energy_recorded, progress), passed

    return jax.lax.scan(sample, state, jnp.arange(samples))


def divide_run(duration: float, step: float, sample: float, part: float) -> tuple[int, int, int]:
    """Division of a run of length `duration`: number of parts (no longer than `part`), samples per part, steps per
    sample.

    A sample has a whole number of steps and all parts are equal, so the run may be a few samples longer.
    """
    steps, parts = max(round(sample / step), 1), math.ceil(duration / part - 1e-9)
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
def _begin(
    robot: Robot,
    conditions: Conditions,
    terrain: Terrain,
    sequence: LeverSequence,
    step: Scalar,
    motion: ClimbMotion | None,
) -> Any:
    def one(
        robot: Robot, conditions: Conditions, terrain: Terrain, sequence: LeverSequence, motion: ClimbMotion | None
    ) -> Any:
        return begin_climb(build_climb_system(robot, conditions, terrain, sequence, step), motion)

    return jax.vmap(one, in_axes=(_robot_axis(robot), 0, 0, 0, 0))(robot, conditions, terrain, sequence, motion)


def _part(
    robot: Robot, conditions: Conditions, terrain: Terrain, sequence: LeverSequence, state: Any, first: Scalar,
    step: Scalar, steps: Scalar, samples: int,
) -> tuple[Any, ClimbRecord]:  # fmt: skip
    def one(robot: Robot, conditions: Conditions, terrain: Terrain, sequence: LeverSequence, state: Any) -> Any:
        return advance_samples(
            build_climb_system(robot, conditions, terrain, sequence, step), state, first, steps, samples
        )

    in_axes = (_robot_axis(robot), 0, 0, 0, 0)
    parts: tuple[Any, ClimbRecord] = jax.vmap(one, in_axes=in_axes)(robot, conditions, terrain, sequence, state)
    return parts


_compiled = compiled(_part, options=SMALL)


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
    interval, steps_per_sample = jnp.asarray(step, float), jnp.asarray(steps)
    state = _begin(robot, conditions, terrain, sequence, interval, start)
    records: list[ClimbRecord] = []
    for k in range(parts):
        begins = jnp.asarray(k * samples * steps * step)
        state, passed = _compiled(
            robot, conditions, terrain, sequence, state, begins, interval, steps_per_sample, samples
        )
        verdict = np.asarray(state[2].verdict)
        last = passed if record else jax.tree.map(lambda x: x[:, -1:], passed)
        records = [*(records if record else []), jax.device_get(last)]
        if progress is not None:
            progress((k + 1) / parts)
        if np.all(verdict != _RUNNING):
            break
    verdict = np.where(verdict == _RUNNING, UNFINISHED, verdict)
    joined = jax.tree.map(lambda *x: np.concatenate(x, axis=1), *records)
    return ClimbRuns(verdict, np.asarray(state[2].ended), np.asarray(state[2].furthest), joined)
