"""Sums over all contacts of one side, and their exact derivatives, one column for each input.

A step of the track model needs a dozen sums over its contacts. Their derivatives are computed once per input and not
once per parameter of a derivative. Each tangent then costs only a small product.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mmrjax.model.chassis import Chassis
from mmrjax.model.params import Scalar
from mmrjax.model.signals import Signals
from mmrjax.numerics.elementary import cosine, sine, value_and_slope
from mmrjax.undercarriage.running_gear import BeltPath, belt_runs, tips_on_path
from mmrjax.undercarriage.side_contacts import (
    WHEEL,
    ContactState,
    bearing_contacts,
    compute_contacts,
    join_contacts,
    tension_free,
)

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
#: Coordinates and velocities (see `undercarriage`) except the travel, which has no influence.
MOTION = ("z", "pitch", "front", "rear", "v_x", "v_z", "v_pitch", "v_front", "v_rear")
#: Of each contact: F, R, F~ and R~ [N] (see `ContactSums`) and the rise of F with sliding [N·s/m].
Forces = tuple[Array, ...]


class ContactSums(eqx.Module):
    """Sums over the contacts of one side, for a given change of velocity Δv in a time step.

    A contact's traction is F, its normal force R. The damping of the step (`half_robot.resistance`, without the
    drive's part) reduces them by F~ and R~. They act on the pulleys with their levers, front and rear.

    Attributes:
        traction, normal: F and R [N].
        moment, rear: moments of F - F~ and R - R~ on pitch and driven pulley [N·m].
        front: moments of F and R on the driving pulley [N·m].
        guide_front, guide_rear: moments of R's share on the guide, on both pulleys, for a friction coefficient of 1
            [N·m].
        fallen_x, fallen_z, fallen_front: F~ and R~ along the ground and off it [N] and on the driving pulley [N·m].
        rise, rise_front: rise of F with all sliding speeds [N·s/m], and of its part of `front` [N·s].
    """

    traction: Scalar
    normal: Scalar
    moment: Scalar
    rear: Scalar
    front: Scalar
    guide_front: Scalar
    guide_rear: Scalar
    fallen_x: Scalar
    fallen_z: Scalar
    fallen_front: Scalar
    rise: Scalar
    rise_front: Scalar


ROWS = tuple(f.name for f in dataclasses.fields(ContactSums))


def contact_inputs(path: BeltPath, chassis: Chassis, adhesion: Any) -> dict[str, Any]:
    """Inputs of the contacts other than the motion, by name. Tangents have the same form (None: constant)."""
    gear, friction = path.gear, chassis.ground.friction
    return {
        "pulley": path.radius,
        "adhesion": adhesion,
        **{name: getattr(gear, name) for name in GEAR},
        **{f"friction_{name}": getattr(friction, name) for name in FRICTION},
        **{f"chassis_{name}": getattr(chassis, name) for name in CHASSIS},
    }


def contributions_of_contacts(
    path: BeltPath, chassis: Chassis, at: ContactState, slip: Scalar, adhesion: Scalar, gained: Float[Array, " 5"]
) -> Float[Array, "sums contacts"]:
    """Contribution of each contact to the `ContactSums`. `slip` is added to all sliding speeds [m/s]. `gained`
    is Δv.
    """
    sliding = -at.speed_x - slip
    ground = chassis.ground
    coefficient = ground.traction(sliding, 1.0, adhesion)
    rise = ground.traction_rise(sliding, at.force, adhesion)
    traction = coefficient * at.force
    front, rear = path.radius * (1 - at.weight), path.radius * at.weight
    drawn = front * gained[3] + rear * gained[4]
    along = gained[0] + gained[2] * at.lever_z + at.rate_x * drawn
    off = at.damped * (gained[1] - gained[2] * at.lever_x + at.rate_z * drawn)
    fallen = jnp.maximum(rise, 0.0) * along + jnp.where(at.force > 0, coefficient, 0.0) * off
    net_traction, bears = traction - fallen, at.force - off
    guided = at.guided * at.force
    return jnp.stack(
        [
            traction,
            at.force,
            net_traction * at.lever_z - bears * at.lever_x,
            (net_traction * at.rate_x + bears * at.rate_z) * rear,
            (traction * at.rate_x + at.force * at.rate_z) * front,
            guided * front,
            guided * rear,
            fallen,
            off,
            (fallen * at.rate_x + off * at.rate_z) * front,
            rise,
            rise * at.rate_x * front,
        ]
    )


class LinearizedSums(eqx.Module):
    """Sums over contacts and their derivatives with respect to motion, slip and selected inputs.

    Attributes:
        values: the sums.
        slopes: derivatives of the sums, one row for each of `names`.
        at: values of these inputs for the linearization of the sums.
    """

    values: ContactSums
    slopes: Float[Array, "names sums"]
    at: Mapping[str, Scalar]
    names: tuple[str, ...] = eqx.field(static=True)

    def near(self, now: Mapping[str, Any]) -> ContactSums:
        """Sums for inputs `now`, to first order. Missing inputs keep their values."""
        differences = [now[name] - self.at[name] if name in now else jnp.zeros(()) for name in self.names]
        return jax.tree.map(jnp.add, self.values, _sums(jnp.stack(differences) @ self.slopes))

    def slope(self, name: str) -> ContactSums:
        """Derivatives of the sums with respect to one of `names`."""
        return _sums(self.slopes[self.names.index(name)])


def _sums(row: Float[Array, " sums"]) -> ContactSums:
    return ContactSums(*(row[k] for k in range(len(ROWS))))


def linearize(
    path: BeltPath,
    chassis: Chassis,
    given: Mapping[str, Any],
    gained: Float[Array, " 5"],
    constants: tuple[str, ...] = (),
) -> LinearizedSums:
    """Sums and their derivatives.

    Derivatives with respect to motion and slip are written out. The others are by forward differentiation of
    `contributions_of_contacts`, one input at a time.

    Args:
        path, chassis: path and chassis of the run.
        given: values of `MOTION`, of `contact_inputs` and of `slip`.
        gained: Δv of the step, constant.
        constants: `contact_inputs` to differentiate with respect to.
    """

    def each(values: Mapping[str, Any]) -> Float[Array, "sums contacts"]:
        gear = dataclasses.replace(path.gear, **{name: values[name] for name in GEAR})
        ground = chassis.ground
        friction = dataclasses.replace(ground.friction, **{name: values[f"friction_{name}"] for name in FRICTION})
        ground = dataclasses.replace(ground, friction=friction)
        changed = {name: values[f"chassis_{name}"] for name in CHASSIS}
        path_now = BeltPath(values["pulley"], gear)
        chassis_now = dataclasses.replace(chassis, ground=ground, **changed)
        z, pitch, front, rear, *v = (values[name] for name in MOTION)
        touching = compute_contacts(path_now, chassis_now, (0.0, z, pitch, front, rear), v)
        return contributions_of_contacts(path_now, chassis_now, touching, values["slip"], values["adhesion"], gained)

    def along(name: str) -> Float[Array, "sums contacts"]:
        value = jnp.asarray(given[name])
        return value_and_slope(lambda x: each({**given, name: x}), value)[1]

    values, slopes = _sums_and_motion_derivatives(path, chassis, given, gained)
    if constants:
        others = jnp.stack([along(name) for name in constants])
        slopes = jnp.concatenate([slopes, others @ jnp.ones(others.shape[-1])])
    # Slip shifts the sliding of every contact like the robot's own speed.
    slopes = jnp.concatenate([slopes, slopes[None, MOTION.index("v_x")]])
    names = (*MOTION, *constants, "slip")
    return LinearizedSums(_sums(values), slopes, {name: given[name] for name in names}, names)


def _sum_of_products(*products: tuple[Any, ...]) -> Any:
    """Sum of products. Products with a factor None are left out. XLA would compute products with zeros."""
    terms = [math.prod(factors[1:], start=factors[0]) for factors in products if all(f is not None for f in factors)]
    return sum(terms[1:], start=terms[0]) if terms else None


class _ContactDerivatives(eqx.Module):
    """Derivatives of the forces of a contact with respect to its own motion, at constant Δv."""

    at: ContactState
    by_depth: Array  # of R [N/m]
    damped_by_depth: Array  # of D, the damping by the gap's rate [N·s/m²]
    share: Array  # relative decrease of both with the belt's compliance [N/m]
    coefficient: Array  # F = μ R
    rise: Array  # dμ/dv
    bend: Array  # d²μ/dv²
    along: Array  # change of the contact's velocity in the step [m/s]
    off: Array

    def forces(self) -> Forces:
        """F, R, F~, R~ [N] and the rise of F [N·s/m]."""
        force, down = self.at.force, self.at.damped * self.off
        fallen = jnp.maximum(self.rise, 0.0) * force * self.along + self.coefficient * down
        return self.coefficient * force, force, fallen, down, self.rise * force

    def moved(
        self,
        gap: Any = None,
        gap_rate: Any = None,
        slide: Any = None,
        along: Any = None,
        off: Any = None,
        compliance: Any = None,
    ) -> Forces:
        """Changes of `forces` due to gap, gap rate, sliding speed, velocity changes of the step, and belt compliance.

        None: no change.
        """
        touching, sinks = self.at, None if gap is None else -gap
        yields = None if compliance is None else -self.share * compliance
        force = _sum_of_products((self.by_depth, sinks), (-touching.damped, gap_rate), (touching.force, yields))
        damped = _sum_of_products((self.damped_by_depth, sinks), (touching.damped, yields))
        angle_derivative = _sum_of_products((self.bend * touching.force, slide), (self.rise, force))
        down = _sum_of_products((damped, self.off), (touching.damped, off))
        fallen = _sum_of_products(
            (jnp.where(self.rise > 0, self.along, 0.0), angle_derivative),
            (jnp.maximum(self.rise, 0.0) * touching.force, along),
            (self.rise * touching.damped * self.off, slide),
            (self.coefficient, down),
        )
        pulled = _sum_of_products((self.rise * touching.force, slide), (self.coefficient, force))
        moved_sums = (pulled, force, fallen, down, angle_derivative)
        return tuple(jnp.zeros_like(touching.force) if a is None else a for a in moved_sums)


def _contact_derivatives(
    path: BeltPath, chassis: Chassis, at: ContactState, given: Mapping[str, Any], gained: Array
) -> _ContactDerivatives:
    gear, friction = path.gear, chassis.ground.friction
    depth = jnp.maximum(-at.gap, 1e-9)
    stiff = gear.contact_stiffness * depth ** (gear.contact_exponent - 1)
    yields = 1 / (1 + at.compliance * stiff)
    u = jnp.clip(depth / gear.contact_depth, 0.0, 1.0)
    deepens = gear.contact_damping * 6 * u * (1 - u) / gear.contact_depth
    bears = jnp.where(at.force > 0, bearing_contacts(chassis), 0.0) * yields
    softens = at.compliance * stiff * yields * (gear.contact_exponent - 1) / depth
    sliding = -at.speed_x - given["slip"]
    rise, bend = value_and_slope(friction.rise, sliding)
    drawn = path.radius * ((1 - at.weight) * gained[3] + at.weight * gained[4])
    return _ContactDerivatives(
        at=at,
        by_depth=bears * (gear.contact_exponent * stiff - deepens * at.gap_rate) - softens * at.force,
        damped_by_depth=bears * deepens - softens * at.damped,
        share=stiff * yields,
        coefficient=given["adhesion"] * friction.coefficient(sliding),
        rise=given["adhesion"] * rise,
        bend=given["adhesion"] * bend,
        along=gained[0] + gained[2] * at.lever_z + at.rate_x * drawn,
        off=gained[1] - gained[2] * at.lever_x + at.rate_z * drawn,
    )


class _SumLevers(eqx.Module):
    """Levers of the forces along and normal to the ground in the sums, each of shape (levers, contacts)."""

    level: Array
    steep: Array

    @classmethod
    def of(cls, unit: Any, x: Array, z: Array, front: tuple[Array, ...], rear: tuple[Array, ...]) -> _SumLevers:
        """From the levers of the pitch [m], and on each pulley those of F, R [m] and of friction on the guide [m]."""
        return cls(jnp.stack([unit, z, front[0], rear[0]]), jnp.stack([unit, x, *front[1:], *rear[1:]]))


def _weighted_sums(forces: Sequence[Forces], levers: Sequence[_SumLevers]) -> Float[Array, "forces levers sums"]:
    """Sums over all contacts for every combination of forces and levers."""
    level, steep = jnp.stack([a.level for a in levers]), jnp.stack([a.steep for a in levers])
    pulls = jnp.stack([jnp.stack([row[0], row[2], row[4]]) for row in forces])
    bears = jnp.stack([jnp.stack([row[1], row[3]]) for row in forces])
    # (forces, kind, levers, lever)
    pulls, bears = jnp.tensordot(pulls, level, ((2,), (2,))), jnp.tensordot(bears, steep, ((2,), (2,)))
    pull, fallen, rise = (pulls[:, k] for k in range(3))
    force, down = (bears[:, k] for k in range(2))
    net_pull, net_force = pull - fallen, force - down
    sums = ContactSums(
        traction=pull[..., 0],
        normal=force[..., 0],
        moment=net_pull[..., 1] - net_force[..., 1],
        rear=net_pull[..., 3] + net_force[..., 4],
        front=pull[..., 2] + force[..., 2],
        guide_front=force[..., 3],
        guide_rear=force[..., 5],
        fallen_x=fallen[..., 0],
        fallen_z=down[..., 0],
        fallen_front=fallen[..., 2] + down[..., 2],
        rise=rise[..., 0],
        rise_front=rise[..., 2],
    )
    return jnp.stack([getattr(sums, name) for name in ROWS], axis=-1)


def _sums_and_motion_derivatives(
    path: BeltPath, chassis: Chassis, given: Mapping[str, Any], gained: Array
) -> tuple[Float[Array, " sums"], Float[Array, "motion sums"]]:
    """Sums over contacts, and their derivatives with respect to `MOTION`.

    Each contact is moved along ten directions: its height, the pitch, the position of the belt as each pulley turns,
    five velocities and the deflection of the belt. Changes of its forces are weighted with the levers of the sums,
    and changes of the levers with its forces.
    """
    height, pitch, front, rear, *v = (given[name] for name in MOTION)
    touching = compute_contacts(path, chassis, (0.0, height, pitch, front, rear), v)
    law = _contact_derivatives(path, chassis, touching, given, gained)
    x, z, rate_x, rate_z, guided, one = (
        touching.lever_x,
        touching.lever_z,
        touching.rate_x,
        touching.rate_z,
        touching.guided,
        jnp.ones_like(touching.gap),
    )
    on_front, on_rear = path.radius * (1 - touching.weight), path.radius * touching.weight
    speed, drawn = (on_front * a[3] + on_rear * a[4] for a in (v, gained))

    def turned(dx: Array, dz: Array, ahead: Array, rise: Array, compliance: Array | None = None) -> Forces:
        """Change of the forces with contact points and their rates."""
        return law.moved(
            gap=dz,
            gap_rate=rise * speed - v[2] * dx,
            slide=-v[2] * dz - ahead * speed,
            along=gained[2] * dz + ahead * drawn,
            off=rise * drawn - gained[2] * dx,
            compliance=compliance,
        )

    def levers(dx: Array, dz: Array, ahead: Array, rise: Array, share: Array) -> _SumLevers:
        """Change of the levers with contact points and their rates."""
        rates = (ahead, rise, share)
        return _SumLevers.of(
            jnp.zeros_like(x), dx, dz, tuple(a * on_front for a in rates), tuple(a * on_rear for a in rates)
        )

    # Along the belt the tips move in the frame of the pitched chassis, and their shares of the pulleys change.
    unit = jnp.ones_like(front)
    (place, _), (by_front, shared) = jax.jvp(lambda a: path.place(a, rear), (front,), (unit,))
    by_front, shared, by_rear = join_contacts(by_front), join_contacts(shared), touching.weight * path.radius
    tip = jax.tree.map(join_contacts, value_and_slope(lambda p: tips_on_path(path, p), place)[1])
    cos, sin = cosine(pitch), sine(pitch)
    belt = (
        tip.forward * cos + tip.up * sin,
        tip.up * cos - tip.forward * sin,
        tip.rate_forward * cos + tip.rate_up * sin,
        tip.rate_up * cos - tip.rate_forward * sin,
    )
    wheel_radius = jnp.where(WHEEL, chassis.radius, 0.0)
    pitched = (z + wheel_radius, -x, rate_z, -rate_x - wheel_radius / path.radius)

    def free(motion: Sequence[Scalar]) -> Scalar:
        return tension_free(path, belt_runs(path, motion[:2], motion[2:]))

    pulleys = (front, rear, v[3], v[4])
    taut = free(pulleys)
    drawn_belt = turned(*belt, tip.compliance / taut)
    belt_slip, gains = (path.radius * (a[4] - a[3]) for a in (v, gained))
    handed = law.moved(
        gap_rate=rate_z * belt_slip, slide=-rate_x * belt_slip, along=rate_x * gains, off=rate_z * gains
    )
    changes = [
        law.moved(gap=one),
        turned(*pitched),
        tuple(a * by_front + b * shared for a, b in zip(drawn_belt, handed, strict=True)),
        tuple(a * by_rear for a in drawn_belt),
        law.moved(slide=-one),
        law.moved(gap_rate=one),
        law.moved(gap_rate=-x, slide=-z),
        law.moved(gap_rate=rate_z * on_front, slide=-rate_x * on_front),
        law.moved(gap_rate=rate_z * on_rear, slide=-rate_x * on_rear),
        law.moved(compliance=-touching.compliance / taut),
    ]
    forces, rates = law.forces(), (rate_x, rate_z, guided)
    sum_levers = _SumLevers.of(one, x, z, tuple(a * on_front for a in rates), tuple(a * on_rear for a in rates))
    rows = _weighted_sums([*changes, forces], [sum_levers])[:, 0]
    over_belt = levers(*belt, tip.guided)
    shift = tuple(path.radius * a * shared for a in rates)
    by_share = _SumLevers.of(jnp.zeros_like(x), 0 * x, 0 * x, tuple(-a for a in shift), shift)
    derivatives = [
        levers(*pitched, jnp.zeros_like(x)),
        jax.tree.map(lambda a, b: a * by_front + b, over_belt, by_share),
        jax.tree.map(lambda a: a * by_rear, over_belt),
    ]
    slopes = rows[: len(MOTION)].at[1:4].add(_weighted_sums([forces], derivatives)[0])
    for k, name in enumerate(("front", "rear", "v_front", "v_rear")):
        pulley_derivative = jax.jvp(
            lambda a, k=k: free((*pulleys[:k], a, *pulleys[k + 1 :])), (pulleys[k],), (unit,)
        )[1]
        slopes = slopes.at[MOTION.index(name)].add(pulley_derivative * rows[-2])
    return rows[-1], slopes


class ContactForces(eqx.Module):
    """Forces of the contacts at an instant, from their sums, see `side_contacts.Pull`."""

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
        slip_derivative, was = self.linearized.slope("slip"), self.linearized.values
        slip_change = slip - self.linearized.at["slip"]
        sums = jax.tree.map(lambda a, b: a + b * slip_change, self.sums, slip_derivative)
        rise, rise_front = self.sums.rise - was.rise, self.sums.rise_front - was.rise_front
        return dataclasses.replace(
            sums,
            traction=sums.traction - (rise + slip_derivative.rise * slip_change / 2) * slip_change,
            front=sums.front - (rise_front + slip_derivative.rise_front * slip_change / 2) * slip_change,
        )

    def pull(self, chassis: Chassis, signals: Signals) -> ContactForces:
        """Forces of the contacts for these signals."""
        sums = self.shifted(signals.speed_slip_terms)
        friction = chassis.track.guide_friction * signals.direction
        guided = (sums.guide_front + sums.guide_rear) / self.radius
        load = -(sums.front - friction * sums.guide_front + self.torque_front)
        return ContactForces(
            sums.traction, sums.moment, sums.rear - friction * sums.guide_rear, friction * guided, guided, load
        )
