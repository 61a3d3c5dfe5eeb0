"""Static limits from geometry alone: the highest step and the widest gap for given lever angles.

They ignore the friction and torque needed to get there. A static limit is therefore an upper bound for a robot that
climbs slowly with its levers held.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mmrjax.climbing import resting_posture
from mmrjax.climbing.resting_posture import BELTS, FRONT_ROLLER, REAR_ROLLER, Posture, SideOutline
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.numerics.elementary import value_and_slope

#: Number of pitches searched first, then near the best one, and rounds; for one posture, and for any.
_PITCHES, _POSTURES = (181, 33, 4), (13, 9, 1)
#: Distance of the two evaluations on both sides of the highest step [rad].
_BESIDE = 1e-5


class StepLimit(eqx.Module):
    """The highest step on which the robot can rest with its centre of mass above the edge.

    Attributes:
        height: height of the step [m].
        pitch: pitch of the robot, nose up [rad].
        side: outline of the robot there, in a frame along the ground whose origin is the middle of the wheelbase.
        base: height of that origin above the lower ground [m].
    """

    height: Scalar
    pitch: Scalar
    side: SideOutline
    base: Scalar


class StaticLimits(eqx.Module):
    """Static limits of a robot at its lever angles.

    Attributes:
        step: highest step, driven onto nose first [m].
        gap: widest gap that the contact bridges on both sides of the centre of mass [m]. 0 if no belt touches the
            ground.
        contact: length of the contact on level ground [m].
        tip_front, tip_rear: height of the tops of the lever rollers above level ground [m]. On wheels, of the wheels.
        tips_back, tips_forward, tips_aside: slopes that tip the robot: uphill, downhill, sideways [rad].
        length, height: overall, on level ground [m].
    """

    step: Scalar
    gap: Scalar
    contact: Scalar
    tip_front: Scalar
    tip_rear: Scalar
    tips_back: Scalar
    tips_forward: Scalar
    tips_aside: Scalar
    length: Scalar
    height: Scalar


def lowest_points(side: SideOutline) -> tuple[Scalar, Scalar]:
    """Heights of the lowest points of an outline behind its centre of mass and ahead of it [m]."""
    line = side.centre_forward
    # circles: the bottom if it is on that side, else the intersection of the line with the arc
    offset = side.forward - line
    radius = side.radius
    arc_height = jnp.where(jnp.abs(offset) < radius, jnp.sqrt(jnp.maximum(radius**2 - offset**2, 1e-18)), -jnp.inf)
    ahead = side.up - jnp.where(offset >= 0, radius, arc_height)
    behind = side.up - jnp.where(offset <= 0, radius, arc_height)

    # belts: intersection of the line with a straight run, both of each, as either may be the lower one
    first, second = np.array([*BELTS, *(pair[::-1] for pair in BELTS)]).T
    belt_radius = jnp.where(np.array([True, False, False, True]), radius, side.belt)
    distance_forward, rise = side.forward[second] - side.forward[first], side.up[second] - side.up[first]
    distance = jnp.sqrt(jnp.maximum(distance_forward**2 + rise**2, 1e-12))
    ratio = (belt_radius[second] - belt_radius[first]) / distance
    has_run = (jnp.abs(ratio) < 1) & (distance > 1e-6)
    direction = jnp.arctan2(rise, jnp.where(has_run, distance_forward, 1.0)) - jnp.arcsin(
        jnp.where(has_run, ratio, 0.0)
    )
    sine, cosine = jnp.sin(direction), jnp.cos(direction)
    (x0, x1) = (side.forward[k] + belt_radius[k] * sine for k in (first, second))
    (z0, z1) = (side.up[k] - belt_radius[k] * cosine for k in (first, second))
    crosses = has_run & ((x0 - line) * (x1 - line) <= 0) & (jnp.abs(x1 - x0) > 1e-9)
    share = (line - x0) / jnp.where(crosses, x1 - x0, 1.0)
    belt = jnp.min(jnp.where(crosses, z0 + share * (z1 - z0), jnp.inf))
    return jnp.minimum(jnp.min(behind), belt), jnp.minimum(jnp.min(ahead), belt)


def step_height_at(side: SideOutline, pitch: Scalar) -> Scalar:
    """Height of the step on which an outline rests at a pitch with its centre of mass above the edge [m].

    The lowest point behind the centre of mass stands on the lower ground, the lowest point ahead of it on the step.
    So H = min over x ≥ x_c of z less min over x ≤ x_c of z. If only belt and pulley touch, the tail turns on a circle
    of radius R. With the centre of mass ℓ ahead of its centre and h above the axles,

        H = R (1 - cos θ) + (ℓ - (h + R) tan θ) sin θ.
    """
    behind, ahead = lowest_points(side.with_pitch(pitch))
    return ahead - behind


def _pitch_of_highest_step(
    height: Callable[[Scalar], Scalar], count: int, refined_count: int, rounds: int
) -> tuple[Scalar, Scalar]:
    """Pitch of the highest step and its resolution [rad], from `count` pitches, refined `rounds` times around
    `refined_count`.
    """
    resolution = jnp.pi / 2 / (count - 1)
    grid = jnp.linspace(0.0, jnp.pi / 2, count)
    best = grid[jnp.argmax(jax.vmap(height)(grid))]
    for _ in range(rounds):
        grid = jnp.clip(best + resolution * jnp.linspace(-1.0, 1.0, refined_count), 0.0, jnp.pi / 2)
        best = grid[jnp.argmax(jax.vmap(height)(grid))]
        resolution = resolution * 2 / (refined_count - 1)
    return best, resolution


def find_highest_step(side: SideOutline, pitch: Scalar | None = None) -> StepLimit:
    """Highest step for one outline: the maximum of `step_height_at` over all pitches with the nose up.

    If two parts of the outline meet at the highest step, its derivatives are those of both. The weight of each is the
    slope s over pitch of the other: dH = (s_1 dH_2 - s_2 dH_1) / (s_1 - s_2).

    Args:
        pitch: pitch of the highest step [rad]. None: it is searched.
    """
    constant_side = jax.lax.stop_gradient(side)
    best = (
        _pitch_of_highest_step(lambda pitch: step_height_at(constant_side, pitch), *_PITCHES)[0]
        if pitch is None
        else pitch
    )
    neighbours = best + jnp.array([-_BESIDE, _BESIDE])
    slopes = jax.vmap(lambda pitch: value_and_slope(lambda x: step_height_at(constant_side, x), pitch)[1])(neighbours)
    share = jnp.clip(-slopes[1] / jnp.maximum(slopes[0] - slopes[1], 1e-12), 0.0, 1.0)
    height_change = jnp.asarray(
        jax.vmap(lambda pitch: step_height_at(side, pitch) - step_height_at(constant_side, pitch))(neighbours)
    )
    pitched = side.with_pitch(best)
    height = step_height_at(constant_side, best) + share * height_change[0] + (1 - share) * height_change[1]
    return StepLimit(height, best, pitched, -lowest_points(pitched)[0])


def with_lever_angles(conditions: Conditions, front: Scalar, rear: Scalar) -> Conditions:
    """Conditions with the levers at these angles [rad]."""
    front, rear = (jnp.broadcast_to(jnp.degrees(x), conditions.shape) for x in (front, rear))
    return dataclasses.replace(conditions, levers_front_deg=front, levers_rear_deg=rear)


def flush_lever_angle(robot: Robot) -> Scalar:
    """Lever angle at which the lower run of a lever is in line with the main belt [rad], positive downward."""
    gear = robot.running_gear
    return -jnp.arcsin((robot.radius_pulley + gear.grouser_height - gear.levers.roller) / gear.lever_length)


def best_levers(robot: Robot, conditions: Conditions, pitch: Scalar) -> tuple[Scalar, Scalar]:
    """Angles of front and rear levers [rad] with which the robot of one run climbs its highest step at a pitch θ.

    The belt is over the edge, and the tail stands on the rollers of the rear levers. Front levers extend level, which
    brings their mass furthest over the step: φ_1 = -θ. Rear levers of length L stand at

        θ - φ_2 = π/2 + atan2(μ c sin θ, L cos θ).

    They would be upright without their mass, a share μ of the total with its centre c from their axle, which favours
    a position further ahead. Both angles are limited to the levers' range.
    """
    gear = robot.running_gear
    half_masses = resting_posture.posture_masses(robot, conditions)
    lever_moment_share = gear.lever_mass * gear.lever_centre / (half_masses.chassis + 2 * half_masses.pulley)
    rear = pitch - jnp.pi / 2 - jnp.arctan2(lever_moment_share * jnp.sin(pitch), gear.lever_length * jnp.cos(pitch))
    least, most = gear.levers.angle_least, gear.levers.angle_most
    return jnp.clip(-pitch, least, most), jnp.clip(rear, least, most)


def best_step(robot: Robot, conditions: Conditions) -> tuple[StepLimit, Scalar, Scalar]:
    """Highest step of one run in any posture within the lever range, with the angles of front and rear levers [rad].

    In derivatives, the angles are treated as constants. The step is a limit for any slow sequence of postures if the
    riser carries no load. When the tail leaves the lower ground, the centre of mass must be over the step, and no
    posture allows a higher step then. Only the pitch is searched. The levers' angles follow from it (`best_levers`).
    """
    constant_robot, constant_conditions = jax.lax.stop_gradient((robot, conditions))

    def height(pitch: Scalar) -> Scalar:
        return step_height_at(
            resting_posture.side_outline(
                constant_robot,
                with_lever_angles(constant_conditions, *best_levers(constant_robot, constant_conditions, pitch)),
            ),
            pitch,
        )

    best, resolution = _pitch_of_highest_step(height, *_POSTURES)
    for _ in range(2):  # smooth here: vertices of parabolas
        low, middle, high = jnp.asarray(jax.vmap(height)(best + resolution * jnp.array([-1.0, 0.0, 1.0])))
        curvature = 2 * middle - low - high
        best = (
            best
            + jnp.where(
                curvature > 0, jnp.clip((high - low) / (2 * jnp.where(curvature > 0, curvature, 1.0)), -1, 1), 0.0
            )
            * resolution
        )
        resolution = resolution / 16
    front, rear = best_levers(constant_robot, constant_conditions, best)
    return (
        find_highest_step(resting_posture.side_outline(robot, with_lever_angles(conditions, front, rear)), best),
        front,
        rear,
    )


def stairs_rise(robot: Robot, conditions: Conditions, tread: Scalar, friction: Scalar) -> Scalar:
    """Largest rise of stairs with this tread [m] on which the robot of one run rests without rocking or sliding.

    Its levers are flush with the belt. With friction alone, a belt of friction μ slides at tan α = μ, with tan α =
    rise / tread. Noses are t / cos α apart. The belt always has one nose behind gravity's line through its centre of
    mass and one ahead of it if it extends far enough both ways. At the tail this is ℓ - h tan α ≥ t / cos α, with the
    centre of mass ℓ ahead of the tail and h above the belt. The result is 0 if even noses without rise are too far
    apart. Grousers that catch a nose hold more, and a robot that rocks may still climb.
    """
    angle = flush_lever_angle(robot)
    posture = resting_posture.level_posture(robot, with_lever_angles(conditions, angle, angle))
    tail, nose = posture.centre_ahead - posture.rear, posture.front - posture.centre_ahead
    # ℓ cos α - h sin α = t
    reach = jnp.sqrt(tail**2 + posture.centre_height**2)
    rocking_angle = jnp.arccos(jnp.clip(tread / reach, 0.0, 1.0 - 1e-12)) - jnp.arctan2(posture.centre_height, tail)
    is_bridged = jnp.minimum(tail, nose) >= tread
    steepest = jnp.minimum(jnp.arctan(friction), jnp.maximum(rocking_angle, 0.0))
    return jnp.where(is_bridged, tread * jnp.tan(steepest), 0.0) * posture.line


def posture_limits(robot: Robot, conditions: Conditions) -> StaticLimits:
    """Static limits of a robot on level ground, for one run, including the slopes at which it tips."""
    side, posture = resting_posture.side_outline(robot, conditions), resting_posture.level_posture(robot, conditions)
    highest = find_highest_step(side)
    level_side = side.with_pitch(posture.pitch)
    tops = level_side.up + level_side.radius + posture.height
    on_tracks = jnp.asarray(side.tracked) > 0.5
    half_gap: Scalar = jnp.minimum(posture.front - posture.centre_ahead, posture.centre_ahead - posture.rear)
    width = robot.chassis(conditions.configuration).turning.width
    return StaticLimits(
        step=highest.height,
        gap=jnp.maximum(half_gap, 0.0) * posture.line,
        contact=posture.length,
        tip_front=jnp.where(on_tracks, tops[FRONT_ROLLER], jnp.max(tops)),
        tip_rear=jnp.where(on_tracks, tops[REAR_ROLLER], jnp.max(tops)),
        tips_back=posture.tips_back,
        tips_forward=posture.tips_forward,
        tips_aside=jnp.arctan2(width / 2, posture.centre_height),
        length=level_side.length,
        height=level_side.height,
    )


@jax.jit
def postures_of_runs(robot: Robot, conditions: Conditions) -> tuple[Posture, StaticLimits, SideOutline, StepLimit]:
    """Posture, limits, outline at rest and highest step of the robot, for each run of a batch.

    Leaves have the shape (runs, ...).
    """

    def results_of_run(one: Conditions) -> tuple[Posture, StaticLimits, SideOutline, StepLimit]:
        side, posture = resting_posture.side_outline(robot, one), resting_posture.posture(robot, one)
        return posture, posture_limits(robot, one), side.with_pitch(posture.pitch), find_highest_step(side)

    return jax.vmap(results_of_run)(conditions)
