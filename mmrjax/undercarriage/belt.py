"""Main track of one side: its path around two pulleys, its elastic runs and its tooth mesh.

The belt is not a chain of bodies: it runs on its path. The coordinate of a point is its distance along the path,
counted from the end of the front pulley, in the direction of forward running. The order is lower run (backwards),
rear pulley (up), upper run (forwards), front pulley (down).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mmrjax.model.contact import cubic_step
from mmrjax.model.params import Scalar
from mmrjax.numerics.elementary import cosine, sine
from mmrjax.undercarriage.running_gear import GROUSERS, TEETH_PULLEY, RunningGear

#: Numbers along the belt.
Numbers = Float[Array, " n"]

#: Relative variation of the pulley's radius: links of a chain form a polygon with as many sides as teeth.
POLYGON = (1 - math.cos(math.pi / TEETH_PULLEY)) / 2


class BeltPath(eqx.Module):
    """Closed path of the belt in the frame of the chassis, whose origin is midway between the axles.

    Attributes:
        radius: pitch radius of the pulleys [m].
        gear: the running gear.
    """

    radius: Scalar
    gear: RunningGear

    @property
    def length(self) -> Scalar:
        """Length of the path, 2 L_b + 2 π r [m]. 840 mm for the paper's robot."""
        return 2 * self.gear.wheelbase + 2 * jnp.pi * self.radius

    @property
    def pitch(self) -> Scalar:
        """Pitch of the grousers S_g [m]. 35 mm for the paper's robot."""
        return self.length / GROUSERS

    def weight(self, place: Numbers) -> Numbers:
        """Share of the rear pulley in the motion of a belt point: 0 at the front pulley, 1 at the rear one.

        A straight run stretches uniformly, so the share is linear along it. By virtual work, a force on the point
        loads the pulleys in the same shares. This is exact for a uniform elastic run.
        """
        run, arc = self.gear.wheelbase, jnp.pi * self.radius
        return jnp.clip(place / run, 0.0, 1.0) - jnp.clip((place - run - arc) / run, 0.0, 1.0)

    def place(self, front: Scalar, rear: Scalar) -> tuple[Float[Array, " 24"], Float[Array, " 24"]]:
        """Positions of the grousers [m along the path] for pulley angles [rad], and the share of the rear pulley in
        their motion.
        """
        at_front = jnp.mod(jnp.arange(GROUSERS) * self.pitch + self.radius * front, self.length)
        weight = self.weight(at_front)
        return jnp.mod(at_front + self.radius * weight * (rear - front), self.length), weight


class PathTips(eqx.Module):
    """Tips of the grousers in the frame of the chassis, each field of shape (grousers,).

    Attributes:
        forward, up: coordinates [m].
        rate_forward, rate_up: displacement per displacement of the belt [-].
        guided: share of a load on the grouser that passes to the lower guide [-]. The rest passes to a pulley.
        compliance: compliance of the free belt between pulley and guide at unit tension [m], see `tips_on_path`.
    """

    forward: Numbers
    up: Numbers
    rate_forward: Numbers
    rate_up: Numbers
    guided: Numbers
    compliance: Numbers


def tips_on_path(path: BeltPath, place: Numbers) -> PathTips:
    """Tips of the grousers at `place` [m along the path].

    A grouser sits on a rigid base and turns with the mean direction of the path under that base. Its
    tip therefore accelerates from r to r + height over one base length instead of at once. From the end of an arc the
    belt rises to the guide over the free gap. In the gap a load is shared between pulley and guide, by a cubic
    step in place of the lever's straight line, for a continuous slope. The belt deflects as a string,
    x (gap - x) / gap per unit of tension. Both ends of the lower run are equal: x counts from the nearer.
    """
    gear, radius = path.gear, path.radius
    run, arc, base = gear.wheelbase, jnp.pi * radius, gear.grouser_length
    ahead = (place < run / 2) | (place > run + arc + run / 2)
    side = jnp.where(ahead, 1.0, -1.0)
    x = jnp.where(ahead, jnp.where(place < run / 2, place, place - path.length), run - place)
    arc_angle = jnp.clip(-x / radius, 0.0, jnp.pi)  # on the arc, from its bottom
    share = jnp.clip((base / 2 - x) / base, 0.0, 1.0)  # of the base on the arc
    tilt = jnp.minimum(jnp.where(x < -base / 2, -x / radius, share**2 * base / (2 * radius)), jnp.pi)
    tilt_rate = -jnp.where(tilt < jnp.pi, share, 0.0) / radius
    rise = gear.guide_recess * cubic_step(x, 0.0, 0.0, gear.guide_gap, 1.0)
    u = jnp.clip(x / gear.guide_gap, 0.0, 1.0)
    rise_rate = gear.guide_recess * 6 * u * (1 - u) / gear.guide_gap
    straight = jnp.where(x > 0, -x, jnp.where(arc_angle < jnp.pi, 0.0, x + arc))
    height = gear.grouser_height
    return PathTips(
        forward=side * (run / 2 + straight + radius * sine(arc_angle) + height * sine(tilt)),
        up=-radius * cosine(arc_angle) - height * cosine(tilt) + rise,
        rate_forward=-cosine(arc_angle) + height * cosine(tilt) * tilt_rate,
        rate_up=side * (-sine(arc_angle) + height * sine(tilt) * tilt_rate + rise_rate),
        guided=jnp.where(x > 0, cubic_step(x, 0.0, 0.0, gear.guide_gap, 1.0), 0.0),
        compliance=u * (1 - u) * gear.guide_gap,
    )


class BeltRuns(eqx.Module):
    """Tensions of the two straight runs, and their torques on the pulleys.

    Attributes:
        upper, lower: total tension, averaged over the run [N].
        centrifugal: part that accelerates the belt's own mass round the pulleys, P_ct = m v² / length [N].
        torque_front, torque_rear: torques on front and rear pulley, in the direction of running [N·m].
    """

    upper: Scalar
    lower: Scalar
    centrifugal: Scalar
    torque_front: Scalar
    torque_rear: Scalar


def belt_travel(radius: Scalar, angle: Scalar) -> tuple[Scalar, Scalar]:
    """Belt drawn by a pulley turned by `angle` [m], and per radian [m]: s = r (φ + ε sin(nφ) / n).

    The links form a polygon of n = 48 sides, so the lever arm varies by ±ε with each tooth (chordal action;
    ε from the geometry). This is the tooth mesh, with period S_t.
    """
    phase = TEETH_PULLEY * angle
    return radius * (angle + POLYGON * sine(phase) / TEETH_PULLEY), radius * (1 + POLYGON * cosine(phase))


def belt_runs(path: BeltPath, angles: Sequence[Scalar], rates: Sequence[Scalar]) -> BeltRuns:
    """Tensions from the angles [rad] and rates [rad/s] of front and rear pulley, relative to the chassis.

    P = max(0, P_0 ± k Δs ± b Δṡ), with Δs the belt drawn by the front pulley less that of the rear one. The upper run
    pulls, the lower one slackens. The teeth transmit, so P_0 only keeps the runs from going slack.
    """
    gear = path.gear
    drawn_front, lever_front = belt_travel(path.radius, angles[0])
    drawn_rear, lever_rear = belt_travel(path.radius, angles[1])
    stretch = drawn_front - drawn_rear
    rate = lever_front * rates[0] - lever_rear * rates[1]
    pull = gear.span_stiffness * stretch + gear.span_damping * rate
    upper = jnp.maximum(gear.pretension + pull, 0.0)
    lower = jnp.maximum(gear.pretension - pull, 0.0)
    speed = path.radius * (rates[0] + rates[1]) / 2
    return BeltRuns(
        upper=upper,
        lower=lower,
        centrifugal=gear.belt_mass / path.length * speed**2,
        torque_front=-lever_front * (upper - lower),
        torque_rear=lever_rear * (upper - lower),
    )


def tension_along(
    path: BeltPath, tension: BeltRuns, place: Numbers, force: Numbers, stations: Float[Array, " s"]
) -> Float[Array, " s"]:
    """Tension [N] at `stations` [m along the path], with forces [N] on the belt against its running direction.

    A force F at x of the lower run leaves P - F (1 - x/L) ahead of it and P + F x/L behind. On the arcs the tension
    changes uniformly along the engaged teeth, from that of one run to that of the other.
    """
    run, arc = path.gear.wheelbase, jnp.pi * path.radius
    on_run = place < run
    x = jnp.where(on_run, place / run, 0.0)
    load = jnp.where(on_run, force, 0.0)

    def lower(at: Scalar) -> Scalar:
        return tension.lower + jnp.sum(load * (x - (at < place)))

    def one(at: Float[Array, ""]) -> Float[Array, ""]:
        rear = jnp.clip((at - run) / arc, 0.0, 1.0)
        front = jnp.clip((at - 2 * run - arc) / arc, 0.0, 1.0)
        # from the end of the lower run over the rear arc to the upper run, and over the front arc back down
        up = lower(run) * (1 - rear) + tension.upper * rear
        down = tension.upper * (1 - front) + lower(-1.0) * front
        return jnp.where(at < run, lower(at), jnp.where(at < run + arc + run, up, down))

    return jax.vmap(one)(stations)
