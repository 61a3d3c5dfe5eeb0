"""Contacts of one side with the ground and the guides, and their generalized forces on the chassis.

Coordinates q of half a robot in its plane of travel: travel x [m] uphill, height z [m] of the middle of the wheelbase
(axle line) over the ground, and three angles. Pitch θ [rad] is nose down. φ_1, φ_2 [rad] are the angles of driving
(front) and driven pulley, relative to the chassis. Velocities v are their rates. A wheel of 4W2T sits on its pulley's
shaft.

Contact pairs of one side: 24 grousers with the ground, 168 teeth with each of two guides (720 in all for 6T2A), 2
wheels with the ground for 4W2T.
"""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mmrjax.model.chassis import Chassis
from mmrjax.model.conditions import Conditions
from mmrjax.model.contact import damping_contact, force_contact
from mmrjax.model.masses import lever_angles
from mmrjax.model.params import Scalar
from mmrjax.model.signals import Signals
from mmrjax.numerics.elementary import cosine, sine
from mmrjax.undercarriage.running_gear import (
    GROUSERS,
    WHEELS,
    BeltPath,
    BeltRuns,
    RunningGear,
    belt_runs,
    tension_along,
    tips_on_path,
)

#: A number of each contact.
PerContact = Float[Array, " contacts"]

CONTACTS = GROUSERS + WHEELS  # with the ground, of one side; those of the other configuration carry no load

WHEEL = np.arange(CONTACTS) >= GROUSERS
_END = np.where(WHEEL, np.where(np.arange(CONTACTS) == GROUSERS, 1.0, -1.0), 0.0)  # of the wheelbase: front, rear


class ContactState(eqx.Module):
    """Position, motion and load of the contacts of one side at an instant. Grousers come first.

    Attributes:
        lever_x, lever_z: contact point from the middle of the wheelbase [m].
        rate_x, rate_z: velocity of the contact per belt speed [-].
        weight: share of the driven pulley in that belt speed [-].
        speed_x: velocity of the contact over the ground, uphill [m/s].
        gap, gap_rate: height over the ground [m] and its rate [m/s].
        compliance: compliance of the belt under it at its tension [m/N].
        force: normal force R_z [N].
        damped: decrease of the force with the gap's rate [N·s/m].
        guided: share of the force that passes to the lower guide [-].
        belt: tensions of the runs.
    """

    lever_x: PerContact
    lever_z: PerContact
    rate_x: PerContact
    rate_z: PerContact
    weight: PerContact
    speed_x: PerContact
    gap: PerContact
    gap_rate: PerContact
    compliance: PerContact
    force: PerContact
    damped: PerContact
    guided: PerContact
    place: Float[Array, " 24"]
    belt: BeltRuns

    @property
    def normal(self) -> Scalar:
        """Normal reaction of the ground on one side [N]."""
        return jnp.sum(self.force)


def join_contacts(grousers: Float[Array, " 24"], wheels: Array | np.ndarray | float = 0.0) -> PerContact:
    """Contacts of grousers and wheels in one array, padded and masked. XLA vectorises this better than a
    concatenation.
    """
    return jnp.where(WHEEL, wheels, jnp.pad(grousers, (0, WHEELS)))


def compute_contacts(
    path: BeltPath, chassis: Chassis, q: Sequence[Scalar] | Array, v: Sequence[Scalar] | Array
) -> ContactState:
    """Contact points and normal forces (27)-(29) at coordinates `q`, velocities `v`.

    The free belt between pulley and guide deflects under the grouser as a string of tension P - P_ct. The force falls
    by h / (h + its deflection under the force of the rigid contact), exact at e = 1.

    Args:
        path: the belt's path.
        chassis: chassis. On tracks the grousers carry load, on wheels the wheels of its radius.
        q, v: coordinates and velocities, see the module.
    """
    gear = path.gear
    belt = belt_runs(path, (q[3], q[4]), (v[3], v[4]))
    place, weight = path.place(q[3], q[4])
    tips = tips_on_path(path, place)
    pitch = q[2]
    cos, sin = cosine(pitch), sine(pitch)
    tip_forward, tip_up = join_contacts(tips.forward, path.gear.wheelbase / 2 * _END), join_contacts(tips.up)
    tip_rate_forward, tip_rate_up = join_contacts(tips.rate_forward), join_contacts(tips.rate_up)
    # The lowest point of a wheel is below its axle at any pitch of the robot.
    wheel_radius = jnp.where(WHEEL, chassis.radius, 0.0)
    x, z, rate_x, rate_z, weight = (
        tip_forward * cos + tip_up * sin,
        tip_up * cos - tip_forward * sin - wheel_radius,
        tip_rate_forward * cos + tip_rate_up * sin - wheel_radius / path.radius,
        tip_rate_up * cos - tip_rate_forward * sin,
        join_contacts(weight, jnp.where(_END < 0, 1.0, 0.0)),
    )
    speed = path.radius * ((1 - weight) * v[3] + weight * v[4])
    gap = q[1] + z
    gap_rate = v[1] - v[2] * x + rate_z * speed
    # Tension of the lower run without its centrifugal part: a slack belt keeps 1 % of its pre-tension.
    tension = jnp.maximum(belt.lower - belt.centrifugal, 0.01 * gear.pretension)
    compliance = join_contacts(tips.compliance / tension)
    depth = jnp.maximum(-gap, 1e-9)
    softening = 1 / (1 + compliance * gear.contact_stiffness * depth ** (gear.contact_exponent - 1))
    carries_load = jnp.where(WHEEL, 1 - chassis.on_tracks, chassis.on_tracks)
    stiffness, damping = gear.contact_stiffness * softening, gear.contact_damping * softening
    force = force_contact(gap, gap_rate, 0.0, stiffness, gear.contact_exponent, damping, gear.contact_depth)
    return ContactState(
        lever_x=x,
        lever_z=z,
        rate_x=rate_x,
        rate_z=rate_z,
        weight=weight,
        speed_x=v[0] + v[2] * z + rate_x * speed,
        gap=gap,
        gap_rate=gap_rate,
        compliance=compliance,
        force=(force * carries_load),
        damped=damping_contact(force, gap, 0.0, damping, gear.contact_depth) * carries_load,
        guided=join_contacts(tips.guided),
        place=place,
        belt=belt,
    )


class ContactPull(eqx.Module):
    """Forces of the contacts at an instant.

    Attributes:
        force: traction of each contact, uphill on the robot [N].
        guide: friction of the teeth on the lower guide F'_t, against forward running [N], eq. (26).
        guided: load on the lower guide [N].
        load: torque of belt, ground and guides on the driving shaft [N·m].
        generalized: generalized forces on (x, z, θ, φ_2) [N, N, N·m, N·m], without the torque of the gearbox.
        aside: lateral force of each contact, to the left, for a robot free to turn [N]. None: straight travel.
    """

    force: PerContact
    guide: PerContact
    guided: Float[Array, ""]
    load: Scalar
    generalized: Float[Array, " 4"]
    aside: PerContact | None = None

    @property
    def traction(self) -> Scalar:
        """Traction P_t of one side [N]."""
        return jnp.sum(self.force)


def sliding_speeds(signals: Signals, contacts: ContactState) -> PerContact:
    """Backward sliding speed of each contact over the ground [m/s]. `speed_slip_terms` is added to it."""
    return -contacts.speed_x - signals.speed_slip_terms


def contact_forces(
    path: BeltPath,
    chassis: Chassis,
    signals: Signals,
    contacts: ContactState,
    height: Scalar,
    force: Array | None = None,
) -> ContactPull:
    """Friction of the contacts (25) by Fig. 7, of the guide (26), and all generalized forces.

    The motion resistance (5) acts on the chassis at the ground. Friction of the upper guide is part of the loss (24),
    which was measured with the tracks lifted.

    Args:
        path: the belt's path.
        chassis: friction and guide coefficients.
        signals: signals up to `balances.slip`. `speed_slip_terms` is added to the sliding of every contact.
        contacts: state of the contacts.
        height: height of the axles above the ground [m].
        force: traction of each contact, if contacts slide laterally too [N]. None: by Fig. 7.
    """
    if force is None:
        force = chassis.ground.traction(sliding_speeds(signals, contacts), contacts.force, signals.adhesion)
    guide = chassis.track.guide_friction * contacts.guided * contacts.force * signals.direction
    # Power of the contact forces per belt speed, then on the pulleys in their shares of that speed.
    belt_force = force * contacts.rate_x + contacts.force * contacts.rate_z - guide
    torque_front = path.radius * jnp.sum(belt_force * (1 - contacts.weight)) + contacts.belt.torque_front
    torque_rear = path.radius * jnp.sum(belt_force * contacts.weight) + contacts.belt.torque_rear
    force_forward = jnp.sum(force) - signals.resistance
    moment = jnp.sum(force * contacts.lever_z - contacts.force * contacts.lever_x) + signals.resistance * height
    return ContactPull(
        force,
        guide,
        jnp.sum(contacts.guided * contacts.force),
        -torque_front,
        jnp.stack([force_forward, contacts.normal, moment, torque_rear]),
    )


class GearReactions(eqx.Module):
    """Loads inside the running gear of one side at an instant.

    Attributes:
        grouser: normal reaction of the ground on each grouser R_z [N].
        guided: part of it that passes to the lower guide [N].
        support: load on front and rear pulley (6T2A) or wheel (4W2T) [N].
        place: positions of the grousers on the path of the belt [m].
        tension: tension of the belt at as many positions as grousers, from half a pitch after the path's start on
            [N].
        centrifugal: centrifugal part P_ct of the tension [N].
    """

    grouser: Float[Array, "... 24"]
    guided: Float[Array, "... 24"]
    support: Float[Array, "... 2"]
    place: Float[Array, "... 24"]
    tension: Float[Array, "... 24"]
    centrifugal: Scalar

    @property
    def guide(self) -> Float[Array, "..."]:
        """Load on the lower guide [N]."""
        return jnp.sum(self.guided, axis=-1)


def inner_loads(path: BeltPath, contacts: ContactState, contact_forces: ContactPull) -> GearReactions:
    """Loads on guides, pulleys and belt at an instant."""
    guide_loads = contacts.guided * contacts.force
    support_loads = contacts.force - guide_loads
    is_ahead = contacts.lever_x > 0
    force_on_belt = (-contact_forces.force * contacts.rate_x + contact_forces.guide)[:GROUSERS]
    return GearReactions(
        grouser=contacts.force[:GROUSERS],
        guided=guide_loads[:GROUSERS],
        support=jnp.stack(
            [jnp.sum(jnp.where(is_ahead, support_loads, 0.0)), jnp.sum(jnp.where(is_ahead, 0.0, support_loads))]
        ),
        place=contacts.place,
        tension=tension_along(
            path, contacts.belt, contacts.place, force_on_belt, (jnp.arange(GROUSERS) + 0.5) * path.pitch
        ),
        centrifugal=contacts.belt.centrifugal,
    )


def lever_tips(gear: RunningGear, conditions: Conditions) -> list[tuple[Scalar, Scalar]]:
    """Tips of the front and the rear lever, in the chassis frame [m]."""
    return [
        (side * (gear.wheelbase / 2 + gear.lever_length * jnp.cos(angle)), gear.lever_length * jnp.sin(angle))
        for side, angle in zip((1.0, -1.0), lever_angles(gear, conditions), strict=True)
    ]


def contact_damping(
    along: Float[Array, "contacts n"], off: Float[Array, "contacts n"], friction: Array, force: Array,
    friction_slopes: Array, normal_damping: Array,
) -> Float[Array, "n n"]:  # fmt: skip
    """Damping matrix of the contacts, see `damping_matrix`.

    Args:
        along, off: speeds of the contacts along the ground and off it, per v.
        friction: friction forces [N].
        force: normal forces [N].
        friction_slopes: derivatives of friction with sliding speed [N·s/m].
        normal_damping: decrease of the normal forces per rate of the gap [N·s/m].
    """
    pushes = (friction / jnp.maximum(force, 1e-9))[:, None] * along + off
    return (along.T * friction_slopes) @ along + (pushes.T * normal_damping) @ off
