"""Running gear of one side: its parameters, those of levers (Fig. 5b), and path, elastic runs and mesh of its belt.

The belt is not a chain of bodies: it runs on its path. The coordinate of a point is its distance along the path,
counted from the end of the front pulley, in the direction of forward running. The order is lower run (backwards),
rear pulley (up), upper run (forwards), front pulley (down).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mmrjax.model.contact import Track, cubic_step
from mmrjax.model.paper_tables import GROUSERS, TEETH_BELT, TEETH_PULLEY
from mmrjax.model.params import Scalar, parameter
from mmrjax.numerics.elementary import cosine, sine


class Levers(eqx.Module):
    """Roller at the tip of a lever, and drive of a pair of levers: motor, planetary gear, worm (Fig. A1: 11-14).

    Length, mass, centre and inertia of a lever belong to the running gear, as does its angle if a run states none.
    Angles here: 0 along the wheelbase outward, positive up, π folded.
    """

    roller: Scalar = parameter(
        13.5e-3, "m", "radius of the roller at a lever's tip over the grousers of its track", (1e-3, 0.5),
        "Table 6, d/2. The track of 112 teeth then closes to 0.4 mm",
        relative_sd=0.05,
    )  # fmt: skip
    worm_ratio: Scalar = parameter(
        30.0, "-", "ratio of the worm gear of a pair of levers", (1.0, 1e3), "Fig. 5b", relative_sd=0.01
    )
    worm_efficiency: Scalar = parameter(
        0.5, "-", "efficiency of the worm gear, self-locking up to 0.5", (0.05, 0.99),
        "Fig. 5b. Single-start worm: 0.4-0.6", sd=0.15,
    )  # fmt: skip
    planetary_ratio: Scalar = parameter(
        23.04, "-", "ratio of the planetary gear between motor and worm", (1.0, 1e4),
        "as the traction drive, Fig. A1: 12 next to 2", relative_sd=0.8,
    )  # fmt: skip
    planetary_efficiency: Scalar = parameter(
        0.75, "-", "efficiency of the planetary gear between motor and worm", (0.1, 1.0),
        "assumed: catalogue of the traction drive's gear", sd=0.1,
    )  # fmt: skip
    rate: Scalar = parameter(
        1.0, "rad/s", "rate of a pair of levers with an imposed angle", (1e-3, 100.0),
        "assumed: 8810 rpm over both ratios are 1.3 rad/s without load", relative_sd=0.5,
    )  # fmt: skip
    angle_least: Scalar = parameter(
        -math.pi, "rad", "least angle of a lever, straight back under the belt", (-2 * math.pi, 0.0),
        "assumed: no stop in Fig. A2", sd=0.5,
    )  # fmt: skip
    angle_most: Scalar = parameter(
        math.pi, "rad", "greatest angle of a lever, folded along the body", (0.0, 2 * math.pi),
        "assumed: transport posture, Table 6", sd=0.5,
    )  # fmt: skip
    current_limit: Scalar = parameter(
        1000.0, "A", "current limit of a motor of the levers", (0.01, 1e4),
        "no limit on the bench", relative_sd=0.1,
    )  # fmt: skip
    share_coulomb: Scalar = parameter(
        0.4, "-", "share of a side's static loss torque in the track of each lever",
        (0.0, 0.5), "Table 3: (350 - 70) / 2 of 350 mN·m", sd=0.05,
    )  # fmt: skip
    share_viscous: Scalar = parameter(
        13 / 32, "-", "share of a side's pseudo-viscous loss in the track of each lever",
        (0.0, 0.5), "Table 3: (16 - 3) / 2 of 16 mN·m·s", sd=0.05,
    )  # fmt: skip

    def tracks(self, side: Track) -> tuple[Track, Track]:
        """Main track of a side, and track of one lever, with their parts of the losses."""

        def share(coulomb: Scalar, viscous: Scalar) -> Track:
            return replace(side, loss_coulomb=coulomb * side.loss_coulomb, loss_viscous=viscous * side.loss_viscous)

        lever_track = share(self.share_coulomb, self.share_viscous)
        return share(1 - 2 * self.share_coulomb, 1 - 2 * self.share_viscous), lever_track


__all__ = ["GROUSERS", "TEETH_BELT", "TEETH_PULLEY", "WHEELS", "RunningGear"]

WHEELS = 2  # of one side, 4W2T


class RunningGear(eqx.Module):
    """Geometry (Table 6), masses (Table 7), belt and contacts (27)-(29) of one side of the chassis.

    The robot holds the rolling radius, the moments of inertia of the rotating parts, friction, losses and its mass.
    The body's mass is the robot's less that of the parts below.
    """

    wheelbase: Scalar = parameter(
        0.300, "m", "distance of the axles L_b, length of a straight run of the belt", (0.05, 3.0),
        "Table 6", relative_sd=0.005,
    )  # fmt: skip
    grouser_height: Scalar = parameter(
        5.5e-3, "m", "height of a grouser over the belt's pitch line", (0.0, 0.05),
        "Table 6: 87.4/2 less the pitch radius of 38.2 mm",
        relative_sd=0.1,
    )  # fmt: skip
    grouser_length: Scalar = parameter(
        5e-3, "m", "length of a grouser's rigid base along the belt",
        (5e-4, 0.03), "one tooth pitch, Section 3.2.4", relative_sd=0.3,
    )  # fmt: skip
    guide_recess: Scalar = parameter(
        0.0, "m", "height of the lower guide above the line that touches both pulleys", (-2e-3, 5e-3),
        "assumed: flush. Decides the guides' share of the weight (docs/explanation/track-model.md)", sd=2e-4,
    )  # fmt: skip
    guide_gap: Scalar = parameter(
        20e-3, "m", "free length of the belt between the end of an arc and the lower guide", (1e-3, 0.14),
        "clearance of a guide 5 mm thick from a pulley: sqrt(38.2² - 33.2²) = 19 mm", relative_sd=0.3,
    )  # fmt: skip
    pretension: Scalar = parameter(
        100.0, "N", "pre-tension of the belt at rest P_0", (1.0, 2000.0),
        "assumed: twice the largest traction of a side (21.1 kg, 20 deg)",
        relative_sd=0.3,
    )  # fmt: skip
    span_stiffness: Scalar = parameter(
        1e5, "N/m", "tensile stiffness of one straight run of the belt", (1e3, 1e8),
        "assumed: EA/L of 3e4 N, a reinforced polyurethane belt 10 mm wide",
        relative_sd=0.5,
    )  # fmt: skip
    span_damping: Scalar = parameter(
        10.0, "N·s/m", "tensile damping of one straight run of the belt", (0.0, 1e4),
        "assumed: a tenth of critical for a pulley on two runs", relative_sd=0.5,
    )  # fmt: skip
    belt_mass: Scalar = parameter(40e-3, "kg", "mass of one main track", (0.0, 2.0), "Table 7", relative_sd=0.05)
    contact_stiffness: Scalar = parameter(
        3e7, "N/m^1.5", "stiffness c of a grouser or wheel on the ground, eq. (27) (unit at e = 1.5)", (1e4, 1e11),
        "assumed: 0.04 mm under 8 N, polyurethane on wood", relative_sd=0.5,
    )  # fmt: skip
    contact_exponent: Scalar = parameter(
        1.5, "-", "exponent e of the contact force, eq. (27)", (1.0, 3.0),
        "elastic bodies (Hertz 1881). Paper: e > 1 is hard contact", relative_sd=0.1,
    )  # fmt: skip
    contact_damping: Scalar = parameter(
        300.0, "N·s/m", "damping b_max of a grouser or wheel on the ground, eq. (27)", (0.0, 1e5),
        "assumed: a tenth to a half of critical for half a robot", relative_sd=0.5,
    )  # fmt: skip
    contact_depth: Scalar = parameter(
        1e-4, "m", "penetration depth d for full damping, Fig. 9a", (1e-6, 1e-2),
        "default of the multibody package of ref. [48]", relative_sd=0.5,
    )  # fmt: skip
    centre_height: Scalar = parameter(
        5e-3, "m", "centre of mass above the axles, without payload and levers", (-0.1, 0.3),
        "middle of the body, 76 mm high (Table 6), over `clearance`", sd=0.01,
    )  # fmt: skip
    clearance: Scalar = parameter(
        10.7e-3, "m", "ground clearance under the body on tracks", (0.0, 0.3), "Table 6", sd=1e-3
    )
    centre_offset: Scalar = parameter(
        0.0, "m", "centre of mass ahead of the middle of the wheelbase, without levers", (-0.3, 0.3),
        "assumed: symmetric layout, Fig. A2", sd=0.01,
    )  # fmt: skip
    payload_height: Scalar = parameter(
        73e-3, "m", "centre of the payload above the axles", (0.0, 0.5),
        "platform 43 mm above the axles (Table 6), half of a weight of 60 mm (Fig. 19)", sd=0.02,
    )  # fmt: skip
    payload_offset: Scalar = parameter(
        0.0, "m", "centre of the payload ahead of the middle of the wheelbase", (-0.5, 0.5), "Fig. 19", sd=0.02
    )
    body_gyration: Scalar = parameter(
        0.1075, "m", "radius of gyration in pitch of the body alone",
        (1e-3, 3.0), "Table 7: sqrt(1.19e5 kg·mm² / 10.3 kg)", relative_sd=0.05,
    )  # fmt: skip
    inertia_tracked: Scalar = parameter(
        0.0, "kg·m^2",
        "moment of inertia in pitch on tracks, levers folded, no payload; 0: body_gyration and parts",
        (0.0, 20.0),
        "sum of the parts (Table 7: 0.251 with outstretched levers)",
        sd=5e-3,
    )  # fmt: skip
    inertia_wheeled: Scalar = parameter(
        0.0, "kg·m^2", "moment of inertia in pitch on wheels, as a whole", (0.0, 20.0),
        "sum of the parts, 0.146 (Table 7: 0.145)", sd=5e-3,
    )  # fmt: skip
    lever_mass: Scalar = parameter(
        0.495, "kg", "mass of one lever with its track, 6T2A", (0.0, 10.0), "Table 7: 470 + 25 g", relative_sd=0.05
    )
    lever_centre: Scalar = parameter(
        0.083, "m", "centre of a lever with its track from its axle", (0.0, 1.0),
        "gives Table 7's 0.251 kg·m² outstretched; middle of its track: 80 mm", sd=5e-3,
    )  # fmt: skip
    lever_inertia: Scalar = parameter(
        1.6e-3, "kg·m^2", "moment of inertia of one lever with its track about its own centre", (0.0, 10.0),
        "Table 7: 1470 kg·mm², and 170 of its track, less 40 that turn with the pulley", relative_sd=0.1,
    )  # fmt: skip
    lever_length: Scalar = parameter(
        0.205, "m", "length of a lever from axle to tip l_p", (0.0, 2.0), "Table 6", relative_sd=0.01
    )
    lever_front: Scalar = parameter(
        math.pi, "rad", "fixed angle of the front lever, 0 pointing forward, positive upward",
        (-math.pi, 2 * math.pi), "transport posture, folded along the body (length 390 mm, Table 6)", sd=0.05,
    )  # fmt: skip
    lever_rear: Scalar = parameter(
        0.0, "rad", "fixed angle of the rear lever, 0 pointing forward, positive upward", (-math.pi, 2 * math.pi),
        "transport posture, folded along the body", sd=0.05,
    )  # fmt: skip
    pulley_mass: Scalar = parameter(
        82e-3, "kg", "mass of one main pulley", (1e-3, 10.0), "Table 7: two a side, as 13.1 and 11.5 kg need",
        relative_sd=0.05,
    )  # fmt: skip
    additional_pulley_mass: Scalar = parameter(
        104e-3, "kg",
        "mass of the axle's pulley for lever track or wheel", (0.0, 10.0),
        "Table 7: two a side, as 13.1 and 11.5 kg need", relative_sd=0.05,
    )  # fmt: skip
    wheel_mass: Scalar = parameter(86e-3, "kg", "mass of one wheel, 4W2T", (0.0, 10.0), "Table 7", relative_sd=0.05)
    levers: Levers = eqx.field(default_factory=Levers, kw_only=True)


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
    run = gear.wheelbase
    arc = jnp.pi * radius
    base_length = gear.grouser_length
    is_ahead = (place < run / 2) | (place > run + arc + run / 2)
    side = jnp.where(is_ahead, 1.0, -1.0)
    x = jnp.where(is_ahead, jnp.where(place < run / 2, place, place - path.length), run - place)
    arc_angle = jnp.clip(-x / radius, 0.0, jnp.pi)  # on the arc, from its bottom
    base_share = jnp.clip((base_length / 2 - x) / base_length, 0.0, 1.0)  # of the base on the arc
    tilt = jnp.minimum(
        jnp.where(x < -base_length / 2, -x / radius, base_share**2 * base_length / (2 * radius)), jnp.pi
    )
    tilt_rate = -jnp.where(tilt < jnp.pi, base_share, 0.0) / radius
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
    force_on_run = jnp.where(on_run, force, 0.0)

    def lower_tension(station: Scalar) -> Scalar:
        return tension.lower + jnp.sum(force_on_run * (x - (station < place)))

    def tension_at(station: Float[Array, ""]) -> Float[Array, ""]:
        rear = jnp.clip((station - run) / arc, 0.0, 1.0)
        front = jnp.clip((station - 2 * run - arc) / arc, 0.0, 1.0)
        # from the end of the lower run over the rear arc to the upper run, and over the front arc back down
        up = lower_tension(run) * (1 - rear) + tension.upper * rear
        down = tension.upper * (1 - front) + lower_tension(-1.0) * front
        return jnp.where(station < run, lower_tension(station), jnp.where(station < run + arc + run, up, down))

    return jax.vmap(tension_at)(stations)
