"""Posture of a robot at rest on a plane, on its main belts and the rollers of its levers.

Frame of the robot, its origin the middle of the wheelbase: forward along it, up across it. Seen from the side a robot
is two axles and two rollers, circles over the grousers, with a belt around each pair. The main belt is around the
axles, a lever's between its axle and its roller. It rests on the lower hull of the circles, on an edge between two of
them, which gives height, pitch and loads in closed form. All are smooth in angles, lengths and masses while the same
two circles carry the load. If another circle takes over, pitch and height are continuous, but their derivatives and
the contact jump.
"""

from __future__ import annotations

import dataclasses
import itertools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mmrjax.model import masses
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot

#: Circles of an outline, from tail to nose.
CIRCLES = REAR_ROLLER, REAR_AXLE, FRONT_AXLE, FRONT_ROLLER = range(4)
#: Pairs of circles with a belt around them.
BELTS = ((REAR_ROLLER, REAR_AXLE), (REAR_AXLE, FRONT_AXLE), (FRONT_AXLE, FRONT_ROLLER))
#: Possible contacts: tail and nose of an edge of the hull.
EDGES = np.array(list(itertools.permutations(CIRCLES, 2)))
#: Largest gap between belt and ground that still carries load [m]: about the compliance of grousers and ground.
TOUCH = 5e-4
#: Pitch beyond which a robot counts as tipped over, whatever it rests on [rad].
UPRIGHT = np.pi / 3
#: Rounding of heights [m].
_ROUNDING = 1e-9


class SideOutline(eqx.Module):
    """Side view of a robot, in its own frame.

    Attributes:
        forward, up: centres of the circles, in the order of `CIRCLES` [m].
        radius: rolling radius of each circle: wheels, or belts including grousers [m].
        belt: radius of the main belt including grousers [m].
        tracked: 1 on tracks, 0 on wheels [-]. On wheels there are no levers: their rollers are on the axles with
            radius 0.
        centre_forward, centre_up: centre of mass of all parts [m].
    """

    forward: Float[Array, "... 4"]
    up: Float[Array, "... 4"]
    radius: Float[Array, "... 4"]
    belt: Scalar
    tracked: Scalar
    centre_forward: Scalar
    centre_up: Scalar

    def with_pitch(self, pitch: Scalar) -> SideOutline:
        """Same outline with its nose raised by `pitch` [rad], about the middle of the wheelbase."""
        forward, up = rotate_to_ground(self.forward, self.up, jnp.asarray(pitch)[..., None])
        centre_forward, centre_up = rotate_to_ground(self.centre_forward, self.centre_up, pitch)
        return dataclasses.replace(self, forward=forward, up=up, centre_forward=centre_forward, centre_up=centre_up)

    @property
    def length(self) -> Scalar:
        """Overall length, over the grousers [m]."""
        return jnp.max(self.forward + self.radius, -1) - jnp.min(self.forward - self.radius, -1)

    @property
    def height(self) -> Scalar:
        """Overall height, over the grousers [m]."""
        return jnp.max(self.up + self.radius, -1) - jnp.min(self.up - self.radius, -1)


def rotate_to_ground(forward: Scalar, up: Scalar, pitch: Scalar) -> tuple[Array, Array]:
    """Coordinates along and above the ground of a point of the robot, relative to the middle of the wheelbase [m]."""
    sine, cosine = jnp.sin(pitch), jnp.cos(pitch)
    return jnp.asarray(forward * cosine - up * sine), jnp.asarray(forward * sine + up * cosine)


def posture_masses(robot: Robot, conditions: Conditions, mass: Scalar | None = None) -> masses.HalfRobotMasses:
    """Masses of half a robot with its levers at the angles of the conditions.

    Args:
        mass: total mass with payload [kg]. None: total mass of the conditions, or else robot mass plus payload.
    """
    if mass is None:
        total_mass = robot.chassis(conditions.configuration).mass + conditions.payload
        mass = total_mass if conditions.total_mass is None else conditions.total_mass
    return masses.masses_of_parts(robot, conditions, mass)


def side_outline(robot: Robot, conditions: Conditions, mass: Scalar | None = None) -> SideOutline:
    """Side view of a robot with its levers at the angles of the conditions.

    Args:
        mass: total mass with payload [kg]. None: as stated.
    """
    chassis = robot.chassis(conditions.configuration)
    gear = robot.running_gear
    tracked = jnp.asarray(chassis.on_tracks)
    centre_forward, centre_up = posture_masses(robot, conditions, mass).centre
    front, rear = masses.lever_angles(gear, conditions)
    half_wheelbase = gear.wheelbase / 2
    lever_length = gear.lever_length * tracked
    axle_radius, roller_radius = chassis.radius + tracked * gear.grouser_height, gear.levers.roller * tracked
    zeros = jnp.zeros_like(half_wheelbase)
    circles_forward = [
        -half_wheelbase - lever_length * jnp.cos(rear),
        -half_wheelbase,
        half_wheelbase,
        half_wheelbase + lever_length * jnp.cos(front),
    ]
    circles_up = [lever_length * jnp.sin(rear), zeros, zeros, lever_length * jnp.sin(front)]
    forward, up, radius = (
        jnp.stack(jnp.broadcast_arrays(*(jnp.asarray(x) for x in row)), -1)
        for row in (circles_forward, circles_up, [roller_radius, axle_radius, axle_radius, roller_radius])
    )
    return SideOutline(
        forward, up, radius, robot.radius_pulley + gear.grouser_height, tracked, centre_forward, centre_up
    )


class Posture(eqx.Module):
    """Posture of a robot at rest on a plane.

    Attributes:
        pitch: pitch, nose up [rad].
        height: height of the middle of the wheelbase above the plane [m].
        rear, front: ends of the contact, measured along the plane ahead of the middle of the wheelbase [m].
        line: 1 if a belt carries load over the whole length between them, 0 if only the ends carry load [-].
        centre_ahead: position of the centre of mass along the plane, ahead of the middle of the wheelbase [m].
        centre_height: height of the centre of mass above the plane [m].
        load_front: share of the normal load at the front end, if only the ends carried load. The robot tips outside 0
            to 1 [-].
        margin: distance along the plane from the line of gravity through the centre of mass to the nearer end of the
            contact [m]. Negative if the robot tips.
        tips_back, tips_forward: slopes that tip the robot, uphill and downhill [rad].
        inertia: moment of inertia in pitch about the centre of mass [kg·m²].
    """

    pitch: Scalar
    height: Scalar
    rear: Scalar
    front: Scalar
    line: Scalar
    centre_ahead: Scalar
    centre_height: Scalar
    load_front: Scalar
    margin: Scalar
    tips_back: Scalar
    tips_forward: Scalar
    inertia: Scalar

    @property
    def length(self) -> Scalar:
        """Distance between the ends of the contact [m]."""
        return self.front - self.rear


def posture(robot: Robot, conditions: Conditions, mass: Scalar | None = None) -> Posture:
    """The posture of a robot at rest on a slope, for one run. If several are possible, the one with least pitch.

    Two circles i (tail) and j (nose), d apart in the direction β of the frame, touch a plane at the pitch

        θ = asin((r_j - r_i) / d) - β,

    and carry the robot if no other circle is below and gravity's line through the centre of mass passes between them.
    The slope is that of the conditions, uphill ahead. If the robot would tip over every pair, the pair that comes
    nearest is returned, with a negative `margin`. Postures with a pitch beyond `UPRIGHT` are excluded.

    Args:
        mass: mass with payload [kg]. None: as stated.
    """
    inertia = robot.sides * posture_masses(robot, conditions, mass).inertia_pitch(robot.running_gear.wheelbase)
    return rest_on_slope(side_outline(robot, conditions, mass), conditions.slope, inertia)


def level_posture(robot: Robot, conditions: Conditions, mass: Scalar | None = None) -> Posture:
    """The posture of a robot at rest on level ground, see `posture`."""
    return posture(robot, dataclasses.replace(conditions, slope_deg=jnp.zeros_like(conditions.slope_deg)), mass)


def rest_on_slope(side: SideOutline, slope: Scalar, inertia: Scalar) -> Posture:
    """Posture of an outline at rest on a slope [rad], see `posture`."""
    tail, nose = EDGES.T
    ahead, rise = side.forward[nose] - side.forward[tail], side.up[nose] - side.up[tail]
    distance = jnp.sqrt(jnp.maximum(ahead**2 + rise**2, 1e-12))
    ratio = (side.radius[nose] - side.radius[tail]) / distance
    has_tangent = jnp.abs(ratio) < 1
    pitch = jnp.arcsin(jnp.where(has_tangent, ratio, 0.0)) - jnp.arctan2(rise, jnp.where(distance > 1e-6, ahead, 1.0))
    pitch = jnp.arctan2(jnp.sin(pitch), jnp.cos(pitch))
    rotated = side.with_pitch(pitch)
    bottoms = rotated.up - rotated.radius  # (edges, circles)
    edges = np.arange(len(EDGES))
    gaps = bottoms - bottoms[edges, tail][:, None]
    rear, front = rotated.forward[edges, tail], rotated.forward[edges, nose]
    centre_height = jnp.asarray(rotated.centre_up) - bottoms[edges, tail]
    centre = jnp.asarray(rotated.centre_forward)
    foot = centre - centre_height * jnp.tan(slope)
    margin = jnp.minimum(foot - rear, front - foot)

    is_upright = jnp.abs(pitch) < UPRIGHT
    is_possible = is_upright & has_tangent & (distance > 1e-6) & (jnp.min(gaps, -1) > -_ROUNDING)
    # Circles on one line give several edges of equal pitch: the longest is the contact.
    rank = jnp.where(margin >= 0, jnp.abs(pitch) - 1e-3 * (front - rear), 10 - margin)
    best = jnp.argmin(jnp.where(is_possible, rank, jnp.inf))

    is_touching = gaps[best] < TOUCH
    is_between = (np.arange(4) >= np.minimum(tail, nose)[:, None]) & (np.arange(4) <= np.maximum(tail, nose)[:, None])
    line = jnp.all(is_touching | ~jnp.asarray(is_between)[best]) * side.tracked
    return Posture(
        pitch=pitch[best],
        height=-bottoms[best, jnp.asarray(tail)[best]],
        rear=rear[best],
        front=front[best],
        line=line,
        centre_ahead=centre[best],
        centre_height=centre_height[best],
        load_front=((foot - rear) / (front - rear))[best],
        margin=margin[best],
        tips_back=jnp.arctan2(centre - rear, centre_height)[best],
        tips_forward=jnp.arctan2(front - centre, centre_height)[best],
        inertia=inertia,
    )
