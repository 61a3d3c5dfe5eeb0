"""Sums over all contacts of one side, and their derivatives with respect to each input.

A step of the track model needs a dozen sums over its contacts. Their derivatives are computed once per input and not
once per parameter of a derivative. Each tangent then costs only a small product.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mmrjax.model.chassis import Chassis
from mmrjax.model.params import Scalar
from mmrjax.model.signals import Signals
from mmrjax.undercarriage.running_gear import BeltPath
from mmrjax.undercarriage.side_contacts import ContactState, compute_contacts

#: Parameters of the running gear, of the friction of the ground and of a chassis that contacts depend on.
GEAR = (
    "wheelbase",
    "grouser_height",
    "grouser_length",
    "guide_recess",
    "guide_gap",
    "pretension",
    "span_stiffness",
    "span_damping",
    "belt_mass",
    "contact_stiffness",
    "contact_exponent",
    "contact_damping",
    "contact_depth",
)
FRICTION = ("static", "dynamic", "speed_static", "speed_dynamic")
CHASSIS = ("radius", "on_tracks")
#: Coordinates and velocities (see `side_contacts`) except the travel, which has no influence.
MOTION = ("z", "pitch", "front", "rear", "v_x", "v_z", "v_pitch", "v_front", "v_rear")


class ContactSums(eqx.Module):
    """Sums over the contacts of one side, for a given change of velocity Δv in a time step.

    A contact's traction is F, its normal force R. The damping of the step (`half_robot.damping_matrix`, without the
    drive's part) reduces them by F~ and R~. They act on the pulleys with their levers, front and rear.

    Attributes:
        traction, normal: F and R [N].
        moment, rear: moments of F - F~ and R - R~ on pitch and driven pulley [N·m].
        front: moments of F and R on the driving pulley [N·m].
        guide_front, guide_rear: moments of R's share on the guide, on both pulleys, for a friction coefficient of 1
            [N·m].
        reduction_x, reduction_z: F~ along the ground and R~ off it [N].
        reduction_front: moments of F~ and R~ on the driving pulley [N·m].
        rise, rise_front: rise of F with all sliding speeds [N·s/m], and of its part of `front` [N·s].
    """

    traction: Scalar
    normal: Scalar
    moment: Scalar
    rear: Scalar
    front: Scalar
    guide_front: Scalar
    guide_rear: Scalar
    reduction_x: Scalar
    reduction_z: Scalar
    reduction_front: Scalar
    rise: Scalar
    rise_front: Scalar


def contact_inputs(path: BeltPath, chassis: Chassis, adhesion: Any) -> dict[str, Any]:
    """Inputs of the contacts other than the motion, by name. Tangents have the same form (None: constant)."""
    gear = path.gear
    friction = chassis.ground.friction
    return {
        "pulley": path.radius,
        "adhesion": adhesion,
        **{name: getattr(gear, name) for name in GEAR},
        **{f"friction_{name}": getattr(friction, name) for name in FRICTION},
        **{f"chassis_{name}": getattr(chassis, name) for name in CHASSIS},
    }


def sums_of_contacts(
    path: BeltPath,
    chassis: Chassis,
    contacts: ContactState,
    slip: Scalar,
    adhesion: Scalar,
    velocity_change: Float[Array, " 5"],
) -> ContactSums:
    """The `ContactSums`. `slip` is added to all sliding speeds [m/s]. `velocity_change` is Δv."""
    sliding = -contacts.speed_x - slip
    ground = chassis.ground
    coefficient = ground.traction(sliding, 1.0, adhesion)
    rise = ground.traction_rise(sliding, contacts.force, adhesion)
    traction = coefficient * contacts.force
    front, rear = path.radius * (1 - contacts.weight), path.radius * contacts.weight
    belt_change = front * velocity_change[3] + rear * velocity_change[4]
    speed_change = velocity_change[0] + velocity_change[2] * contacts.lever_z + contacts.rate_x * belt_change
    force_drop = contacts.damped * (
        velocity_change[1] - velocity_change[2] * contacts.lever_x + contacts.rate_z * belt_change
    )
    traction_drop = (
        jnp.maximum(rise, 0.0) * speed_change + jnp.where(contacts.force > 0, coefficient, 0.0) * force_drop
    )
    net_traction, net_normal = traction - traction_drop, contacts.force - force_drop
    guide_load = contacts.guided * contacts.force
    contributions = ContactSums(
        traction=traction,
        normal=contacts.force,
        moment=net_traction * contacts.lever_z - net_normal * contacts.lever_x,
        rear=(net_traction * contacts.rate_x + net_normal * contacts.rate_z) * rear,
        front=(traction * contacts.rate_x + contacts.force * contacts.rate_z) * front,
        guide_front=guide_load * front,
        guide_rear=guide_load * rear,
        reduction_x=traction_drop,
        reduction_z=force_drop,
        reduction_front=(traction_drop * contacts.rate_x + force_drop * contacts.rate_z) * front,
        rise=rise,
        rise_front=rise * contacts.rate_x * front,
    )
    return jax.tree.map(jnp.sum, contributions)


class LinearizedSums(eqx.Module):
    """Sums over contacts and their derivatives with respect to motion, slip and selected inputs.

    Attributes:
        values: the sums.
        slopes: derivatives of each sum with respect to `names`.
        point: values of these inputs for the linearization of the sums.
    """

    values: ContactSums
    slopes: ContactSums
    point: Mapping[str, Scalar]
    names: tuple[str, ...] = eqx.field(static=True)

    def near(self, inputs: Mapping[str, Any]) -> ContactSums:
        """Sums for inputs `inputs`, to first order. Missing inputs keep their values."""
        differences = jnp.stack([inputs[n] - self.point[n] if n in inputs else jnp.zeros(()) for n in self.names])
        return jax.tree.map(lambda value, slope: value + slope @ differences, self.values, self.slopes)

    def slope(self, name: str) -> ContactSums:
        """Derivatives of the sums with respect to one of `names`."""
        return jax.tree.map(lambda slope: slope[self.names.index(name)], self.slopes)


def linearize(
    path: BeltPath,
    chassis: Chassis,
    inputs: Mapping[str, Any],
    velocity_change: Float[Array, " 5"],
    constants: tuple[str, ...] = (),
) -> LinearizedSums:
    """Sums and their derivatives.

    Args:
        path, chassis: path and chassis of the run.
        inputs: values of `MOTION`, of `contact_inputs` and of `slip`.
        velocity_change: Δv of the step, constant.
        constants: `contact_inputs` to differentiate with respect to.
    """
    varied = (*MOTION, *constants)

    def sums(numbers: Float[Array, " varied"]) -> tuple[ContactSums, ContactSums]:
        values = {**inputs, **dict(zip(varied, numbers, strict=True))}
        gear = replace(path.gear, **{name: values[name] for name in GEAR})
        ground = chassis.ground
        friction = replace(ground.friction, **{name: values[f"friction_{name}"] for name in FRICTION})
        ground = replace(ground, friction=friction)
        chassis_values = {name: values[f"chassis_{name}"] for name in CHASSIS}
        varied_path = BeltPath(values["pulley"], gear)
        varied_chassis = replace(chassis, ground=ground, **chassis_values)
        z, pitch, front, rear, *v = (values[name] for name in MOTION)
        contacts = compute_contacts(varied_path, varied_chassis, (0.0, z, pitch, front, rear), v)
        return (
            sums_of_contacts(
                varied_path, varied_chassis, contacts, values["slip"], values["adhesion"], velocity_change
            ),
        ) * 2

    slopes, values = jax.jacfwd(sums, has_aux=True)(jnp.stack([jnp.asarray(inputs[name]) for name in varied]))
    # Slip shifts the sliding of every contact like the robot's own speed.
    slopes = jax.tree.map(lambda slope: jnp.append(slope, slope[MOTION.index("v_x")]), slopes)
    names = (*varied, "slip")
    return LinearizedSums(values, slopes, {name: inputs[name] for name in names}, names)


class ContactForces(eqx.Module):
    """Forces of the contacts at an instant, from their sums, see `side_contacts.ContactPull`."""

    traction: Scalar
    moment: Scalar
    rear: Scalar
    guide: Scalar
    guided: Scalar
    load: Scalar


class SummedContacts(eqx.Module):
    """Contacts in the form that `balances.resolved_signals` expects, from their sums near an instant.

    The forces also depend on `speed_slip_terms`: traction and load to second order, so that the first derivatives of
    their change with it are exact as well.
    """

    linearized: LinearizedSums
    sums: ContactSums
    radius: Scalar
    torque_front: Scalar

    @property
    def normal(self) -> Scalar:
        """Normal load of one side [N]."""
        return self.sums.normal

    def shifted(self, slip: Scalar) -> ContactSums:
        """Sums with `slip` added to the sliding speeds [m/s]."""
        slip_derivative = self.linearized.slope("slip")
        linear_sums = self.linearized.values
        slip_change = slip - self.linearized.point["slip"]
        sums = jax.tree.map(lambda a, b: a + b * slip_change, self.sums, slip_derivative)
        rise, rise_front = self.sums.rise - linear_sums.rise, self.sums.rise_front - linear_sums.rise_front
        return replace(
            sums,
            traction=sums.traction - (rise + slip_derivative.rise * slip_change / 2) * slip_change,
            front=sums.front - (rise_front + slip_derivative.rise_front * slip_change / 2) * slip_change,
        )

    def pull(self, chassis: Chassis, signals: Signals) -> ContactForces:
        """Forces of the contacts for these signals."""
        sums = self.shifted(signals.speed_slip_terms)
        friction = chassis.track.guide_friction * signals.direction
        guide_load = (sums.guide_front + sums.guide_rear) / self.radius
        load_torque = -(sums.front - friction * sums.guide_front + self.torque_front)
        return ContactForces(
            sums.traction,
            sums.moment,
            sums.rear - friction * sums.guide_rear,
            friction * guide_load,
            guide_load,
            load_torque,
        )
