"""What all contacts of one side add up to, and the exact derivatives of those sums, a column for each input.

A step of the track model needs a dozen sums over its contacts. Their derivatives are taken once for every input and
not once for every parameter that a run is differentiated by: along each tangent what is left is a small product.
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

from mmrjax.belt import Path, runs, tips
from mmrjax.chassis import Chassis
from mmrjax.params import Scalar
from mmrjax.signals import Signals
from mmrjax.running_gear import GROUSERS
from mmrjax.trigonometry import cosine, sine
from mmrjax.undercarriage import WHEEL, Touch, bearing, of_contacts, tension_free, touch

#: What contacts read of the running gear, of the friction of the ground and of a chassis.
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
#: Coordinates and velocities (see `undercarriage`) but for the travel, on which nothing depends.
MOTION = ("z", "pitch", "front", "rear", "v_x", "v_z", "v_pitch", "v_front", "v_rear")


class Sums(eqx.Module):
    """Sums over the contacts of one side, with a step's change of velocity Δv as given.

    A contact's traction is F, its normal force R; by the damping of the step (`half_robot.resistance`, but for the
    drive's part of it) they fall by F~ and R~. On the pulleys they act with their levers, front and rear.

    Attributes:
        traction, normal: F and R [N].
        moment, rear: of F - F~ and R - R~ on pitch and driven pulley [N·m].
        front: of F and R on the driving pulley [N·m].
        guide_front, guide_rear: of R's share on the guide, on both pulleys, at a coefficient of friction of 1 [N·m].
        fallen_x, fallen_z, fallen_front: F~ and R~ along the ground and off it [N] and on the driving pulley [N·m].
        rise, rise_front: how fast F rises with all sliding speeds [N·s/m], and its moment on the driving pulley [N·s].
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


ROWS = tuple(f.name for f in dataclasses.fields(Sums))


def inputs(path: Path, chassis: Chassis, adhesion: Any) -> dict[str, Any]:
    """What contacts depend on beside the motion, by name; of tangents alike (None: constant)."""
    gear, friction = path.gear, chassis.ground.friction
    return {
        "pulley": path.radius,
        "adhesion": adhesion,
        **{name: getattr(gear, name) for name in GEAR},
        **{f"friction_{name}": getattr(friction, name) for name in FRICTION},
        **{f"chassis_{name}": getattr(chassis, name) for name in CHASSIS},
    }


def _with(path: Path, chassis: Chassis, values: Mapping[str, Any]) -> tuple[Path, Chassis]:
    gear = dataclasses.replace(path.gear, **{name: values[name] for name in GEAR})
    ground = chassis.ground
    friction = dataclasses.replace(ground.friction, **{name: values[f"friction_{name}"] for name in FRICTION})
    ground = dataclasses.replace(ground, friction=friction)
    changed = {name: values[f"chassis_{name}"] for name in CHASSIS}
    return Path(values["pulley"], gear), dataclasses.replace(chassis, ground=ground, **changed)


def shares(
    path: Path, chassis: Chassis, at: Touch, slip: Scalar, adhesion: Scalar, gained: Float[Array, " 5"]
) -> Float[Array, "sums contacts"]:
    """Share of each contact in the `Sums`; `slip` shifts all sliding speeds [m/s], `gained` is Δv."""
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
    left, bears = traction - fallen, at.force - off
    guided = at.guided * at.force
    return jnp.stack(
        [
            traction,
            at.force,
            left * at.lever_z - bears * at.lever_x,
            (left * at.rate_x + bears * at.rate_z) * rear,
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


class Linearized(eqx.Module):
    """The sums and their derivatives by motion, slip and whichever inputs are differentiated.

    Attributes:
        values: the sums; slopes: their derivatives, a row for each of `names`.
        at: values of what the rows are by.
    """

    values: Sums
    slopes: Float[Array, "names sums"]
    at: Mapping[str, Scalar]
    names: tuple[str, ...] = eqx.field(static=True)

    def near(self, now: Mapping[str, Any]) -> Sums:
        """The sums where inputs are `now` (those not in it as they were), to first order."""
        moved = [now[name] - self.at[name] if name in now else jnp.zeros(()) for name in self.names]
        return jax.tree.map(jnp.add, self.values, _sums(jnp.stack(moved) @ self.slopes))

    def slope(self, name: str) -> Sums:
        """Derivatives of the sums by one of `names`."""
        return _sums(self.slopes[self.names.index(name)])


def _sums(row: Float[Array, " sums"]) -> Sums:
    return Sums(*(row[k] for k in range(len(ROWS))))


def linearize(
    path: Path,
    chassis: Chassis,
    given: Mapping[str, Any],
    gained: Float[Array, " 5"],
    constants: tuple[str, ...] = (),
) -> Linearized:
    """Sums and their derivatives: by the motion and the slip written out, by what contacts are made of by forward
    differentiation of `shares`, one at a time.

    Args:
        path, chassis: of the run.
        given: values of `MOTION`, of `inputs` and of `slip`.
        gained: Δv of the step, held.
        constants: which of `inputs` to have derivatives by.
    """

    def each(values: Mapping[str, Any]) -> Float[Array, "sums contacts"]:
        path_now, chassis_now = _with(path, chassis, values)
        z, pitch, front, rear, *v = (values[name] for name in MOTION)
        at = touch(path_now, chassis_now, (0.0, z, pitch, front, rear), v)
        return shares(path_now, chassis_now, at, values["slip"], values["adhesion"], gained)

    def along(name: str) -> Float[Array, "sums contacts"]:
        value = jnp.asarray(given[name])
        return jax.jvp(lambda x: each({**given, name: x}), (value,), (jnp.ones_like(value),))[1]

    values, slopes = _by_motion(path, chassis, given, gained)
    if constants:
        others = jnp.stack([along(name) for name in constants])
        slopes = jnp.concatenate([slopes, others @ jnp.ones(others.shape[-1])])
    # Slip shifts the sliding of every contact as the robot's own speed does.
    slopes = jnp.concatenate([slopes, slopes[None, MOTION.index("v_x")]])
    names = (*MOTION, *constants, "slip")
    return Linearized(_sums(values), slopes, {name: given[name] for name in names}, names)


def _total(*products: tuple[Any, ...]) -> Any:
    """Sum of products; those with a factor None are left out, which XLA would not do with zeros."""
    terms = [math.prod(factors[1:], start=factors[0]) for factors in products if all(f is not None for f in factors)]
    return sum(terms[1:], start=terms[0]) if terms else None


class _Law(eqx.Module):
    """How forces follow a contact's own motion, Δv of the step held."""

    at: Touch
    by_depth: Array  # of R [N/m]
    damped_by_depth: Array  # of D, how fast R falls with the gap's rate [N·s/m²]
    share: Array  # both fall by this much of themselves with the belt's compliance [N/m]
    coefficient: Array  # F = μ R
    rise: Array  # dμ/dv
    bend: Array  # d²μ/dv²
    along: Array  # what the step changes the contact's velocity by [m/s]
    off: Array

    def forces(self) -> tuple[Array, ...]:
        """F, R, F~, R~ [N] and the rise of F [N·s/m]."""
        force, down = self.at.force, self.at.damped * self.off
        fallen = jnp.maximum(self.rise, 0.0) * force * self.along + self.coefficient * down
        return self.coefficient * force, force, fallen, down, self.rise * force

    def moved(
        self, gap: Any = None, gap_rate: Any = None, slide: Any = None, along: Any = None, off: Any = None,
        compliance: Any = None,
    ) -> tuple[Array, ...]:  # fmt: skip
        """How `forces` change with the gap, its rate, the sliding speed, what a step changes velocities by and the
        compliance of the belt."""
        at, sinks = self.at, None if gap is None else -gap
        yields = None if compliance is None else -self.share * compliance
        force = _total((self.by_depth, sinks), (-at.damped, gap_rate), (at.force, yields))
        damped = _total((self.damped_by_depth, sinks), (at.damped, yields))
        turned = _total((self.bend * at.force, slide), (self.rise, force))
        down = _total((damped, self.off), (at.damped, off))
        implicit = jnp.maximum(self.rise, 0.0) * at.force
        fallen = _total(
            (jnp.where(self.rise > 0, self.along, 0.0), turned),
            (implicit, along),
            (self.rise * at.damped * self.off, slide),
            (self.coefficient, down),
        )
        pulled = _total((self.rise * at.force, slide), (self.coefficient, force))
        return tuple(jnp.zeros_like(at.force) if a is None else a * jnp.ones_like(at.force) for a in
                     (pulled, force, fallen, down, turned))  # fmt: skip


def _law(path: Path, chassis: Chassis, at: Touch, given: Mapping[str, Any], gained: Array) -> _Law:
    gear, friction = path.gear, chassis.ground.friction
    depth = jnp.maximum(-at.gap, 1e-9)
    stiff = gear.contact_stiffness * depth ** (gear.contact_exponent - 1)
    yields = 1 / (1 + at.compliance * stiff)
    u = jnp.clip(depth / gear.contact_depth, 0.0, 1.0)
    deepens = gear.contact_damping * 6 * u * (1 - u) / gear.contact_depth
    bears = jnp.where(at.force > 0, bearing(chassis), 0.0) * yields
    softens = at.compliance * stiff * yields * (gear.contact_exponent - 1) / depth
    sliding = -at.speed_x - given["slip"]
    rise, bend = jax.jvp(friction.rise, (sliding,), (jnp.ones_like(sliding),))
    drawn = path.radius * ((1 - at.weight) * gained[3] + at.weight * gained[4])
    return _Law(
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


def _by_motion(
    path: Path, chassis: Chassis, given: Mapping[str, Any], gained: Array
) -> tuple[Float[Array, " sums"], Float[Array, "motion sums"]]:
    """The sums, and their derivatives by `MOTION`.

    Each contact is moved along ten directions: its height, the pitch, the place of the belt as each pulley turns, five
    velocities and the yielding of the belt. What its forces change by is weighed with the levers of the sums; what
    the levers change by is weighed with its forces.
    """
    height, pitch, front, rear, *v = (given[name] for name in MOTION)
    at = touch(path, chassis, (0.0, height, pitch, front, rear), v)
    law = _law(path, chassis, at, given, gained)
    radius, x, z, rate_x, rate_z = path.radius, at.lever_x, at.lever_z, at.rate_x, at.rate_z
    on_front, on_rear = radius * (1 - at.weight), radius * at.weight

    def turned(x: Array, z: Array, rate_x: Array, rate_z: Array, compliance: Any = None) -> tuple[Array, ...]:
        """Change of the forces as contact points and their rates change."""
        speed, drawn = (on_front * a[3] + on_rear * a[4] for a in (v, gained))
        return law.moved(
            gap=z,
            gap_rate=rate_z * speed - v[2] * x,
            slide=-v[2] * z - rate_x * speed,
            along=gained[2] * z + rate_x * drawn,
            off=rate_z * drawn - gained[2] * x,
            compliance=compliance,
        )

    def levers(x: Any, z: Any, rate_x: Any, rate_z: Any, guided: Any, weight: Any) -> tuple[Array, ...]:
        """What the sums change by as the levers of the forces do."""
        pulls, bears, fallen, down, rises = forces
        left, held, along = pulls - fallen, bears - down, _total((pulls, rate_x), (bears, rate_z))
        shift = None if weight is None else radius * weight
        none = jnp.zeros_like(bears)
        back = None if weight is None else -shift

        def both(a: Any, b: Any, at_a: Array, at_b: Array, share: Array, shift: Any) -> Any:
            return _total((a, rate_x, share), (b, rate_z, share), (a, at_a, shift), (b, at_b, shift))

        del along
        rows = (
            None,
            None,
            _total((left, z), (-held, x)),
            both(left, held, at.rate_x, at.rate_z, on_rear, shift),
            both(pulls, bears, at.rate_x, at.rate_z, on_front, back),
            _total((guided, bears, on_front), (at.guided, bears, back)),
            _total((guided, bears, on_rear), (at.guided, bears, shift)),
            None,
            None,
            both(fallen, down, at.rate_x, at.rate_z, on_front, back),
            None,
            _total((rises, rate_x, on_front), (rises, at.rate_x, back)),
        )
        return tuple(none if row is None else row for row in rows)

    forces = law.forces()
    one = jnp.ones_like(x)
    # Along the belt the tips move in the frame of the chassis, which is pitched.
    (place, _), (by_front, weight) = jax.jvp(lambda a: path.place(a, rear), (front,), (jnp.ones_like(front),))
    tip = jax.jvp(lambda p: tips(path, p), (place,), (jnp.ones_like(place),))[1]
    cos, sin = cosine(pitch), sine(pitch)
    tip = jax.tree.map(of_contacts, tip)
    shift = (
        tip.forward * cos + tip.up * sin,
        tip.up * cos - tip.forward * sin,
        tip.rate_forward * cos + tip.rate_up * sin,
        tip.rate_up * cos - tip.rate_forward * sin,
    )
    below = jnp.where(WHEEL, chassis.radius, 0.0)
    tilt = (z + below, -x, rate_z, -rate_x - below / radius)
    by_front, by_rear, weight = of_contacts(by_front), of_contacts(radius * at.weight[:GROUSERS]), of_contacts(weight)

    def free(motion: Sequence[Scalar]) -> Scalar:
        return tension_free(path, runs(path, motion[:2], motion[2:]))

    pulleys = (front, rear, v[3], v[4])
    taut, taut_by = free(pulleys), []
    for k, name in enumerate(("front", "rear", "v_front", "v_rear")):
        slope = jax.jvp(lambda a, k=k: free((*pulleys[:k], a, *pulleys[k + 1 :])), (pulleys[k],), (jnp.ones_like(taut),))
        taut_by.append((MOTION.index(name), slope[1]))
    along_belt = turned(*shift, tip.compliance / taut)
    over, gains = radius * (v[4] - v[3]), radius * (gained[4] - gained[3])
    across = law.moved(
        gap_rate=rate_z * over, slide=-rate_x * over, along=rate_x * gains, off=rate_z * gains
    )
    directions = [
        law.moved(gap=one),
        turned(*tilt),
        tuple(a * by_front + b * weight for a, b in zip(along_belt, across, strict=True)),
        tuple(a * by_rear for a in along_belt),
        law.moved(slide=-one),
        law.moved(gap_rate=one),
        law.moved(gap_rate=-x, slide=-z),
        law.moved(gap_rate=rate_z * on_front, slide=-rate_x * on_front),
        law.moved(gap_rate=rate_z * on_rear, slide=-rate_x * on_rear),
        law.moved(compliance=-at.compliance / taut),
        forces,
    ]
    slopes = _weighed(directions, at, on_front, on_rear)
    belt = levers(*shift, tip.guided, None)
    weights = levers(None, None, None, None, None, one)
    geometry = jnp.stack(
        [
            jnp.stack(levers(*tilt, None, None)),
            jnp.stack([a * by_front + b * weight for a, b in zip(belt, weights, strict=True)]),
            jnp.stack([a * by_rear for a in belt]),
        ]
    )
    moved = slopes[: len(MOTION)].at[1:4].add(geometry @ one)
    for k, slope in taut_by:
        moved = moved.at[k].add(slope * slopes[-2])
    return slopes[-1], moved


def _weighed(
    forces: Sequence[tuple[Array, ...]], at: Touch, on_front: Array, on_rear: Array
) -> Float[Array, "rows sums"]:
    """The sums over the contacts for rows of (F, R, F~, R~, rise of F)."""
    one = jnp.ones_like(at.force)
    level = jnp.stack([one, at.lever_z, at.rate_x * on_rear, at.rate_x * on_front])
    steep = jnp.stack([one, at.lever_x, at.rate_z * on_rear, at.rate_z * on_front, at.guided * on_front, at.guided * on_rear])
    pulls = jnp.stack([jnp.stack([row[0], row[2], row[4]]) for row in forces]) @ level.T
    bears = jnp.stack([jnp.stack([row[1], row[3]]) for row in forces]) @ steep.T
    (pull, fallen, rise), (force, down) = (jnp.moveaxis(a, 1, 0) for a in (pulls, bears))
    left, held = pull - fallen, force - down
    rows = [
        pull[:, 0],
        force[:, 0],
        left[:, 1] - held[:, 1],
        left[:, 2] + held[:, 2],
        pull[:, 3] + force[:, 3],
        force[:, 4],
        force[:, 5],
        fallen[:, 0],
        down[:, 0],
        fallen[:, 3] + down[:, 3],
        rise[:, 0],
        rise[:, 3],
    ]
    return jnp.stack(rows, axis=-1)


class Drawn(eqx.Module):
    """What the contacts do at an instant, by their sums; see `undercarriage.Pull`."""

    traction: Scalar
    moment: Scalar
    rear: Scalar
    guide: Scalar
    guided: Scalar
    load: Scalar


class Mover(eqx.Module):
    """The contacts as `balances.resolved` asks for them, by their sums near an instant.

    What they do follows `speed_slip_terms` too: traction and load to second order, so that the first derivatives of
    how they change with it are exact as well.
    """

    linearized: Linearized
    sums: Sums
    radius: Scalar
    torque_front: Scalar

    @property
    def normal(self) -> Scalar:
        """Normal load of one side [N]."""
        return self.sums.normal

    def shifted(self, slip: Scalar) -> Sums:
        """The sums with the sliding speeds shifted by `slip` [m/s]."""
        by, was = self.linearized.slope("slip"), self.linearized.values
        moved = slip - self.linearized.at["slip"]
        sums = jax.tree.map(lambda a, b: a + b * moved, self.sums, by)
        rise, rise_front = self.sums.rise - was.rise, self.sums.rise_front - was.rise_front
        return dataclasses.replace(
            sums,
            traction=sums.traction - (rise + by.rise * moved / 2) * moved,
            front=sums.front - (rise_front + by.rise_front * moved / 2) * moved,
        )

    def pull(self, chassis: Chassis, signals: Signals) -> Drawn:
        """What they do at these signals."""
        sums = self.shifted(signals.speed_slip_terms)
        friction = chassis.track.guide_friction * signals.direction
        guided = (sums.guide_front + sums.guide_rear) / self.radius
        load = -(sums.front - friction * sums.guide_front + self.torque_front)
        return Drawn(sums.traction, sums.moment, sums.rear - friction * sums.guide_rear, friction * guided, guided, load)
