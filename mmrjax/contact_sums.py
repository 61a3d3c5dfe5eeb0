"""What all contacts of one side add up to, and the exact derivatives of those sums, a column for each input.

A step of the track model needs a dozen sums over its contacts. Their derivatives are taken once for every input and
not once for every parameter that a run is differentiated by: along each tangent what is left is a small product.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mmrjax.belt import Path
from mmrjax.chassis import Chassis
from mmrjax.params import Scalar
from mmrjax.signals import Signals
from mmrjax.undercarriage import Touch, touch

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
        change = jnp.stack(moved) @ self.slopes
        return jax.tree.map(jnp.add, self.values, Sums(*(change[k] for k in range(len(ROWS)))))

    def slope(self, name: str) -> Sums:
        """Derivatives of the sums by one of `names`."""
        row = self.slopes[self.names.index(name)]
        return Sums(*(row[k] for k in range(len(ROWS))))


def linearize(
    path: Path,
    chassis: Chassis,
    given: Mapping[str, Any],
    gained: Float[Array, " 5"],
    differentiated: tuple[str, ...],
) -> Linearized:
    """Sums and their derivatives, each by forward differentiation of what a contact adds: nothing of it is by hand.

    Args:
        path, chassis: of the run.
        given: values of `MOTION`, of `inputs` and of `slip`.
        gained: Δv of the step, held.
        differentiated: which of `given` to have derivatives by.
    """

    def each(values: Mapping[str, Any]) -> Float[Array, "sums contacts"]:
        path_now, chassis_now = _with(path, chassis, values)
        z, pitch, front, rear, *v = (values[name] for name in MOTION)
        at = touch(path_now, chassis_now, (0.0, z, pitch, front, rear), v)
        return shares(path_now, chassis_now, at, values["slip"], values["adhesion"], gained)

    def along(name: str) -> Float[Array, "sums contacts"]:
        value = jnp.asarray(given[name])
        return jax.jvp(lambda x: each({**given, name: x}), (value,), (jnp.ones_like(value),))[1]

    slopes = jnp.stack([along(name) for name in differentiated])
    values = jnp.sum(each(given), axis=-1)
    return Linearized(
        Sums(*(values[k] for k in range(len(ROWS)))),
        slopes @ jnp.ones(slopes.shape[-1]),
        {name: given[name] for name in differentiated},
        differentiated,
    )


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
        if "slip" not in self.linearized.names:
            return self.sums
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
