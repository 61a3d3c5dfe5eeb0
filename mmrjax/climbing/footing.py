"""Contacts of half a robot with a terrain: grousers and wheels on the ground, and corners of the ground on belts.

Coordinates q of half a robot with levers: x, z [m] of the middle of the wheelbase, pitch θ [rad] nose down, and three
angles. φ [rad] is the angle of the pulleys relative to the chassis (belts are rigid here: all pulleys have one
angle). ψ_1, ψ_2 [rad] are those of front and rear lever from the chassis' forward axis, positive upward. Velocities v
are their rates. A lever's belt runs on its lever at r (φ̇ + ψ̇).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mmrjax.climbing.levers import BeltLoop, gaps_to_belt, gaps_to_grousers, grouser_tips, running_direction
from mmrjax.climbing.terrain import Terrain
from mmrjax.model import contact
from mmrjax.model.chassis import Chassis
from mmrjax.model.contact import damping_contact, force_contact
from mmrjax.model.paper_tables import GROUSERS_LEVER
from mmrjax.model.params import Scalar
from mmrjax.undercarriage.running_gear import GROUSERS, RunningGear

#: A number of each pair of a body and the ground.
PerPair = Float[Array, " pairs"]

COORDINATES = 6
PITCH, SHAFT, FRONT, REAR = 2, 3, 4, 5


class ContactShape(eqx.Module):
    """Parts of half a robot that can touch the ground.

    Attributes:
        main, lever: belts of one side. Both levers have equal belts.
        gear: the running gear.
        on_tracks: 1 if tracks carry load, 0 if wheels do [-].
        wheel: radius of the wheels [m].
        belly: height of the underside of the body above the axles [m].
    """

    main: BeltLoop
    lever: BeltLoop
    gear: RunningGear
    on_tracks: Scalar
    wheel: Scalar
    belly: Scalar

    @property
    def half(self) -> Scalar:
        """Half the wheelbase [m]."""
        return self.gear.wheelbase / 2


class PartFrame(NamedTuple):
    """Frame of a part: its origin in the world [m], the angle of its first axis [rad], and the coordinate that turns
    it.
    """

    origin: Array
    angle: Scalar
    turns: int | None = None

    def world(self, points: Array) -> Array:
        """Points of the part, in world coordinates."""
        return self.origin + self.along(points)

    def along(self, vector: Array) -> Array:
        """Directions of the part, in world coordinates."""
        cos, sin = jnp.cos(self.angle), jnp.sin(self.angle)
        a, b = vector[..., 0], vector[..., 1]
        return jnp.stack([a * cos - b * sin, a * sin + b * cos], axis=-1)

    def within(self, points: Array) -> Array:
        """World points, in coordinates of the part."""
        return self._replace(origin=jnp.zeros(2), angle=-self.angle).along(points - self.origin)


class Footing(eqx.Module):
    """All pairs of surfaces that may touch, and their forces at an instant.

    Attributes:
        gap: distance [m].
        gap_rate: rate of change of the gap [m/s].
        normal: normal of the contact on the robot, away from the ground.
        off, along: change of the contact's speed normal to the ground and along it (forward on level ground), per
            velocity of `COORDINATES`.
        carried: the change along the ground with the belts held still.
        force: normal force [N].
        damped: decrease of the force per rate of the gap [N·s/m].
        elastic: elastic part of the force [N].
        energy: energy stored in it [J].
        guided: share of the force that passes to the lower guide [-].
        rolls: 0 for contacts of the body, otherwise 1 [-].
        place: x of the contact [m].
    """

    gap: PerPair
    gap_rate: PerPair
    normal: Float[Array, "pairs 2"]
    off: Float[Array, "pairs 6"]
    along: Float[Array, "pairs 6"]
    carried: Float[Array, "pairs 6"]
    force: PerPair
    damped: PerPair
    elastic: PerPair
    energy: PerPair
    guided: PerPair
    rolls: PerPair
    place: PerPair


class _ContactGroup(NamedTuple):
    """Contacts of one part.

    Attributes:
        points, gap, normal: contact points in the world [m], gaps [m] and normals.
        rate: displacement of the belt per angle of the pulleys, 0 for the body [m].
        turns: coordinate of the lever that the part belongs to, None for body and main belt.
        guided: share of a load that passes to the lower guide [-].
        bears: 1 if the contacts carry load, else 0.
        rolls: 0 for contacts of the body, else 1.
    """

    points: Array
    gap: Array
    normal: Array
    rate: Array
    turns: int | None
    guided: Array
    bears: Array
    rolls: float = 1.0


def part_frames(shape: ContactShape, q: Sequence[Scalar] | Array) -> tuple[PartFrame, PartFrame, PartFrame]:
    """Frames of chassis, front lever and rear lever."""
    body = PartFrame(jnp.stack([q[0], q[1]]), -q[PITCH])
    levers = [
        PartFrame(body.world(jnp.stack([end * shape.half, jnp.zeros_like(shape.half)])), q[k] - q[PITCH], k)
        for end, k in ((1.0, FRONT), (-1.0, REAR))
    ]
    return body, levers[0], levers[1]


def _guided_share(shape: ContactShape, place: Array) -> Array:
    """Share of a load at `place` on the main belt that passes to the lower guide [-], see `tips_on_path`."""
    run, length = shape.main.run, shape.main.length
    distance = jnp.minimum(place, length - place)  # from the middle of the lower run
    return jnp.asarray(contact.cubic_step(run / 2 - distance, 0.0, 0.0, shape.gear.guide_gap, 1.0))


def _belt_contacts(
    shape: ContactShape, terrain: Terrain, belt: BeltLoop, frame: PartFrame, belt_travel: Scalar, bears: Scalar
) -> list[_ContactGroup]:
    """Contacts of a belt: its grousers on the ground, and corners of the ground on the belt and on flanks of
    grousers.
    """
    radius = shape.main.first
    is_main = frame.turns is None
    place = belt.places(belt_travel)
    tips, rate = grouser_tips(belt, place)
    points = frame.world(tips)
    gap, normal = terrain.distance(points)

    def contact_group(points: Array, gap: Array, normal: Array, rate: Array, place: Array) -> _ContactGroup:
        guided = _guided_share(shape, place) if is_main else jnp.zeros_like(gap)
        return _ContactGroup(points, gap, normal, radius * rate, frame.turns, guided, bears * jnp.ones_like(gap))

    groups = [contact_group(points, gap, normal, frame.along(rate), place)]
    corners = terrain.corners
    local = frame.within(corners)
    for gap, outward, rate, place in (
        gaps_to_belt(belt, local), gaps_to_grousers(belt, belt_travel, local),
    ):  # fmt: skip
        normal = -frame.along(outward)
        points = corners + terrain.nose * -normal
        groups.append(contact_group(points, gap - terrain.nose, normal, frame.along(rate), place))
    return groups


def _wheel_contacts(shape: ContactShape, terrain: Terrain, body: PartFrame) -> list[_ContactGroup]:
    """Contacts of the wheels with edges and corners of the ground."""
    a, b = terrain.points[:-1], terrain.points[1:]
    edges = b - a
    length = jnp.sqrt(jnp.maximum(jnp.sum(edges**2, axis=1), 1e-30))
    normals = jnp.stack([-edges[:, 1], edges[:, 0]], axis=1) / length[:, None]
    corners = terrain.corners
    groups = []
    for end in (1.0, -1.0):
        centre = body.world(jnp.stack([end * shape.half, jnp.zeros_like(shape.half)]))
        share = jnp.sum((centre - a) * edges, axis=1) / length**2
        to_edge = jnp.sum((centre - a) * normals, axis=1)
        is_beside = (share >= 0) & (share <= 1) & (length > 1e-9) & (to_edge > 0)
        arm = centre - corners
        to_corner = jnp.sqrt(jnp.sum(arm**2, axis=1))
        gap = jnp.concatenate([jnp.where(is_beside, to_edge, FAR_OFF), to_corner]) - shape.wheel - terrain.nose
        normal = jnp.concatenate([normals, arm / to_corner[:, None]])
        touch_points = centre - (shape.wheel + jnp.minimum(gap, 0.0))[:, None] * normal
        zeros = jnp.zeros_like(gap)
        rate = shape.wheel * running_direction(-normal)
        groups.append(_ContactGroup(touch_points, gap, normal, rate, None, zeros, zeros + 1 - shape.on_tracks))
    return groups


#: Gap of pairs that cannot touch [m].
FAR_OFF = 1e3


def _body_contacts(shape: ContactShape, terrain: Terrain, body: PartFrame) -> _ContactGroup:
    """Contacts of corners of the ground with the body."""
    local = body.within(terrain.corners)
    is_over = jnp.abs(local[:, 0]) < shape.half
    gap = jnp.where(is_over & (local[:, 1] < 0), shape.belly - local[:, 1], FAR_OFF) - terrain.nose
    up = body.along(jnp.broadcast_to(jnp.array([0.0, 1.0]), local.shape))
    zeros = jnp.zeros_like(gap)
    return _ContactGroup(terrain.corners + terrain.nose * up, gap, up, 0 * up, None, zeros, zeros + 1, 0.0)


def contacts_with_terrain(shape: ContactShape, terrain: Terrain, q: Array, v: Array) -> Footing:
    """Contacts that may touch and their normal forces (27), at coordinates `q` and velocities `v`."""
    body, front, rear = part_frames(shape, q)
    radius = shape.main.first
    rear_axle = body._replace(origin=rear.origin)  # origin of the main belt's loop
    groups = _belt_contacts(shape, terrain, shape.main, rear_axle, radius * q[SHAFT], jnp.ones(()))
    for lever in (front, rear):
        assert lever.turns is not None
        belt_travel = radius * (q[SHAFT] + q[lever.turns])
        groups += _belt_contacts(shape, terrain, shape.lever, lever, belt_travel, shape.on_tracks)
    groups += _wheel_contacts(shape, terrain, body)
    groups.append(_body_contacts(shape, terrain, body))

    points, normal, rate = (
        jnp.concatenate([getattr(g, name) for g in groups]) for name in ("points", "normal", "rate")
    )
    gap, guided, bears_load = (
        jnp.concatenate([getattr(g, name) for g in groups]) for name in ("gap", "guided", "bears")
    )
    rolls = np.concatenate([np.full(len(g.gap), g.rolls) for g in groups])
    along = running_direction(normal)
    still_belt, moving_belt = [], []
    for direction in (normal, along):
        columns = [direction[:, 0], direction[:, 1], _speed_about_axle(direction, points - body.origin)]
        belt = jnp.sum(direction * rate, axis=1)
        lever_columns, lever_belt_columns = [], []
        for lever in (front, rear):
            is_on_lever = np.concatenate([np.full(len(g.gap), g.turns == lever.turns) for g in groups])
            turning_speed = jnp.where(is_on_lever, -_speed_about_axle(direction, points - lever.origin), 0.0)
            lever_columns.append(turning_speed)
            lever_belt_columns.append(turning_speed + jnp.where(is_on_lever, belt, 0.0))
        still_belt.append(jnp.stack([*columns, 0 * belt, *lever_columns], axis=1))
        moving_belt.append(jnp.stack([*columns, belt, *lever_belt_columns], axis=1))
    off = moving_belt[0]
    gear = shape.gear
    gap_rate = off @ v
    stiffness, exponent = gear.contact_stiffness, gear.contact_exponent
    force = (
        force_contact(gap, gap_rate, 0.0, stiffness, exponent, gear.contact_damping, gear.contact_depth) * bears_load
    )
    depth = jnp.where((gap < 0) & (bears_load > 0), -gap, 0.0)
    elastic = stiffness * depth**exponent
    return Footing(
        gap=gap,
        gap_rate=gap_rate,
        normal=normal,
        off=off,
        along=moving_belt[1],
        carried=still_belt[1],
        force=force,
        damped=jnp.asarray(damping_contact(force, gap, 0.0, gear.contact_damping, gear.contact_depth)),
        elastic=elastic,
        energy=elastic * depth / (exponent + 1),
        guided=guided,
        rolls=jnp.asarray(rolls),
        place=points[:, 0],
    )


def _speed_about_axle(direction: Array, arm: Array) -> Array:
    """Speed along directions of points at `arm` that rotate nose down about an axle, per angular speed [m]."""
    return direction[:, 0] * arm[:, 1] - direction[:, 1] * arm[:, 0]


def contact_shape_of_robot(chassis: Chassis, gear: RunningGear, radius: Scalar) -> ContactShape:
    """Shapes of one side of a robot, from its parameters."""
    main = BeltLoop(radius, radius, gear.wheelbase, gear.grouser_height, gear.grouser_length, GROUSERS)
    lever = BeltLoop(
        radius,
        gear.levers.roller - gear.grouser_height,
        gear.lever_length,
        gear.grouser_height,
        gear.grouser_length,
        GROUSERS_LEVER,
    )
    belly = gear.clearance - (radius + gear.grouser_height)
    return ContactShape(main, lever, gear, chassis.on_tracks, chassis.radius, belly)
