"""Loads, sliding and ground forces of a robot with independently driven sides.

Frame of the robot, its origin the centre of mass: x ahead, y to the left, yaw positive to the left. Sides are in the
order left, right (leading axis 2), their contact lines at y = ±B/2. A contact at (x, y_s) slides over the ground by

    u_x = r ω_k,s - V_s - slip, V_s = v_x - ω y_s,    u_y = -v_y - ω x,

and carries the force N μ(|u|) (u_x, λ^a u_y) / |(u_x, λ^(a-1) u_y)|, with μ the law of Fig. 7 and λ = φ_y / φ_x. At
u_y = 0 this is the law of straight travel, and for any a it is on the friction ellipse. The exponent a sets the
direction. At a = 1 the force is along (φ_x u_x, φ_y u_y). At a = 2 it dissipates the most power that the ellipse
allows. The rule is an assumption, as are the loads of a rigid robot in equilibrium at each instant.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mmrjax.model.contact import Friction
from mmrjax.model.params import Pair, Scalar, parameter
from mmrjax.numerics.batch_flow import compute_if_needed

#: Position of a side's contact line from the middle of the robot, in shares of B [-]: left, right.
SIDES = np.array([0.5, -0.5])
#: Widths of the packaged robot between and over its tracks, which enclose its contact lines [m] (Table 6).
BETWEEN, OVER = 0.208, 0.278
#: Square of a sliding speed that is too small to have a direction [m²/s²].
STILL = 1e-16
#: Newton steps of the load transfer; the contact's forces are nearly bilinear in it. The loop over three steps is
#: unrolled: for 1024 turns `newton.root` takes 1.28 times its time, and optimistix's `Newton` 4.8 times, for
#: the same loads (two cores, processor time in one run, 2026-11-28).
LOAD_STEPS = 3


def _quadrature_nodes(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes on -1 to 1 with their weights, and the weights of two wheels at the ends.

    The wheels use the first and last node.
    """
    place, weight = np.polynomial.legendre.leggauss(count)
    ends = np.zeros(count)
    ends[[0, -1]] = 0.5
    return place, weight / 2, ends


def sum_of_sides(sides: Float[Array, "2 ..."]) -> Array:
    """Sum over both sides, written as two numbers because XLA compiles every reduction to a call."""
    return sides[0] + sides[1]


class Turning(eqx.Module):
    """Parameters that matter only if the two sides are driven independently.

    Attributes:
        nodes: number of nodes along a track's contact, see `Stance`.
    """

    width: Scalar = parameter(
        0.243, "m", "distance B between the contact lines of the left and right sides", (0.0, 5.0),
        f"middle of {BETWEEN:g} and {OVER:g} m, the widths between and over the tracks (Table 6: B_b, B_T)", sd=0.012,
    )  # fmt: skip
    lateral: Scalar = parameter(
        1.0, "-", "lateral friction over longitudinal φ_y/φ_x", (0.02, 10.0),
        "Table 5, lacquered wood (surface of the bench)", relative_sd=0.2,
    )  # fmt: skip
    rule: Scalar = parameter(
        1.0, "-", "rule of the direction of friction, a: 1 along (φ_x u_x, φ_y u_y), 2 maximum dissipation",
        (0.0, 3.0), "assumed. The paper has no lateral sliding", sd=0.5,
    )  # fmt: skip
    inertia: Scalar = parameter(
        0.2, "kg·m^2", "moment of inertia in yaw J_ψ of the robot without payload", (0.0, 1e4),
        "sum of Table 7's parts in their places of Table 6", relative_sd=0.2,
    )  # fmt: skip
    nodes: int = eqx.field(default=16, static=True)


class Stance(eqx.Module):
    """Position of a robot on its contacts, and parameters of the contacts.

    Attributes:
        length: length of the contact, or wheelbase [m].
        width: distance between the tracks, B [m].
        height: height of the centre of mass above the ground [m].
        ahead: position of the centre of mass ahead of the middle of the contact [m].
        on_tracks: 1 on tracks, whose contact is a line, 0 on wheels, whose contacts are at its ends [-].
        lateral: ratio λ of lateral to longitudinal friction on this ground [-].
        rule: exponent a of the friction law [-].
        nodes: number of nodes along a track's contact, even. The width of a turn on the spot under dry friction has
            an error of 3e-5 with 16 nodes and 1e-8 with 32.
    """

    length: Scalar
    width: Scalar
    height: Scalar
    ahead: Scalar
    on_tracks: Scalar
    lateral: Scalar
    rule: Scalar
    nodes: int = eqx.field(default=16, static=True)


class GroundForces(eqx.Module):
    """Forces of the ground on each side, shape (2,): left, right.

    Attributes:
        normal: normal load of each side [N].
        ahead, aside: longitudinal and lateral force [N].
        moment: moment of the lateral forces about the centre of mass, positive to the left [N·m].
        lateral_power: power lost by lateral sliding [W].
        load_transfer: load transferred from the left to the right side [N].
        centre: centre of pressure ahead of the middle of the contact [m].
        residual: residual of these two: what the forces give minus the values used [N, m]. 0 except during a search.
    """

    normal: Pair
    ahead: Pair
    aside: Pair
    moment: Pair
    lateral_power: Pair
    load_transfer: Scalar
    centre: Scalar
    residual: Pair


def loaded_part(stance: Stance, centre: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """Centre and half length of the loaded part of a contact, measured from the middle of the contact [m], and its
    relative excess load.

    The excess is that of the pressure at its front end over the mean [-]. Tracks: p = (N/L)(1 + 12 x_p x / L²). From
    |x_p| = L/6 on it is a triangle of length 3 (L/2 - |x_p|), up to the lift-off of the contact (middle third rule).
    Wheels: by the lever.
    """
    tracks = stance.on_tracks > 0.5
    length = stance.length
    tilt = jnp.clip(jnp.where(tracks, 6.0, 2.0) * centre / length, -1.0, 1.0)
    loaded_length = jnp.where(tracks, jnp.clip(3 * (length / 2 - jnp.abs(centre)), 1e-6 * length, length), length)
    return jnp.sign(centre) * (length - loaded_length) / 2, loaded_length / 2, tilt


class ContactLaw(eqx.Module):
    """Parameters of the friction law that all nodes of a contact share.

    Attributes:
        friction: longitudinal friction.
        ratio: weight of lateral relative to longitudinal sliding in the direction of the force, λ^(2a-2) [-].
        on_tracks, nodes: see `Stance`.
    """

    friction: Friction
    ratio: Scalar
    on_tracks: Scalar
    nodes: int = eqx.field(static=True)

    def contact_nodes(self) -> Array:
        """Nodes on -1..1."""
        line = _quadrature_nodes(self.nodes)[0]
        return jnp.where(self.on_tracks > 0.5, line, np.sign(line))

    def power_sums(self, x: Scalar, order: int) -> Float[Array, "2 powers"]:
        """Sums Σ w zᵏ x over the nodes z with their weights w, for k from 0 to `order`."""
        line, share, ends = _quadrature_nodes(self.nodes)
        powers = np.arange(order + 1)
        line_weights = share[:, None] * line[:, None] ** powers
        end_weights = ends[:, None] * np.sign(line)[:, None] ** powers
        line_and_ends = x @ np.concatenate([line_weights, end_weights], axis=1)
        return jnp.where(self.on_tracks > 0.5, line_and_ends[..., : order + 1], line_and_ends[..., order + 1 :])

    def per_speed(self, along: Scalar, across: Scalar) -> Scalar:
        """Longitudinal force per load and sliding speed [s/m], given the squares of the sliding speeds [m²/s²]."""
        square, weighted_square = along + across, along + self.ratio * across
        return jnp.sqrt((square + STILL) / (weighted_square + STILL)) * self.friction.per_speed(square)

    def per_speed_rise(self, along: Scalar, across: Scalar) -> tuple[Scalar, Scalar]:
        """Derivatives of `per_speed` with respect to the squares of the sliding speeds [s³/m³]."""
        square, weighted_square = along + across, along + self.ratio * across
        friction_part = jnp.sqrt((square + STILL) / (weighted_square + STILL)) * self.friction.per_speed_rise(square)
        half_force = self.per_speed(along, across) / 2
        return (
            friction_part + half_force * (1 / (square + STILL) - 1 / (weighted_square + STILL)),
            friction_part + half_force * (1 / (square + STILL) - self.ratio / (weighted_square + STILL)),
        )

    def rises(self, along: Scalar, across: Scalar) -> tuple[tuple[Scalar, Scalar], tuple[Scalar, Scalar]]:
        """Derivatives of the forces per load with respect to the sliding speeds [s/m].

        If the total force falls with sliding, the derivative is set to 0.
        """
        along_square, across_square, speed_product = along**2, across**2, along * across
        friction_per_speed, (by_along, by_across) = (
            self.per_speed(along_square, across_square),
            self.per_speed_rise(along_square, across_square),
        )
        total_slope = friction_per_speed + 2 * (along_square * by_along + across_square * by_across)
        correction = jnp.maximum(-total_slope, 0.0) / (along_square + across_square + STILL)
        along_factor, across_factor = 2 * by_along + correction, 2 * by_across + correction
        return (friction_per_speed + along_square * along_factor, speed_product * across_factor), (
            speed_product * along_factor,
            friction_per_speed + across_square * across_factor,
        )


@eqx.filter_custom_jvp
def law_moments(law: ContactLaw, sliding: Pair, middle: Scalar, end: Scalar) -> Float[Array, "2 4"]:
    """Moments of order 0 to 3 of the force per sliding speed over a uniformly loaded contact, for each side [s/m].

    They are taken about its middle, in units of half its length.

    Args:
        law: friction law of the contact.
        sliding: longitudinal sliding speed of each side [m/s].
        middle: lateral sliding speed at the middle of the contact [m/s].
        end: increase of the lateral speed from the middle to the front end [m/s].
    """
    across = middle + end * law.contact_nodes()
    return law.power_sums(law.per_speed(sliding[:, None] ** 2, across**2), 3)


@law_moments.def_jvp
def _moments_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    """Derivatives in closed form with respect to the speeds, evaluated once for all tangent directions.

    Derivatives with respect to the law's parameters are left to JAX.
    """
    law, sliding, middle, end = primals
    across = middle + end * law.contact_nodes()
    along = sliding[:, None] ** 2
    moments = law.power_sums(law.per_speed(along, across**2), 3)
    by_along, by_across = law.per_speed_rise(along, across**2)
    change = jnp.zeros_like(moments)
    if tangents[1] is not None:
        change += 2 * (sliding * tangents[1])[:, None] * law.power_sums(by_along, 3)
    if tangents[2] is not None or tangents[3] is not None:
        first = law.power_sums(by_across * across, 4)
        for tangent, part in ((tangents[2], first[:, :4]), (tangents[3], first[:, 1:])):
            change += 0.0 if tangent is None else 2 * tangent * part
    if any(x is not None for x in jax.tree.leaves(tangents[0])):
        change += eqx.filter_jvp(
            lambda law: law.power_sums(law.per_speed(along, across**2), 3), (law,), (tangents[0],)
        )[1]
    return moments, change


class GroundForceInputs(NamedTuple):
    """Inputs of the ground forces of both sides.

    Attributes:
        stance: stance of the robot.
        friction: friction of the ground.
        adhesion: adhesion relative to the robot's surface [-].
        load: load of both sides, normal to the ground [N].
        sliding: longitudinal sliding speed u_x of each side [m/s].
        lateral_speed: lateral speed v_y [m/s].
        yaw_rate: yaw rate ω [rad/s].
        resistance: rolling resistance relative to the normal load, with sign, for each side [-].
    """

    stance: Stance
    friction: Friction
    adhesion: Scalar
    load: Scalar
    sliding: Array
    lateral_speed: Scalar
    yaw_rate: Scalar
    resistance: Array

    def forces(self, loads: Pair | None = None) -> GroundForces:
        """Ground forces and loads of both sides, which depend on each other.

        The load moves to the outer side, T = h ΣF_y / B, and to the rear, N x_p = N x_c - h (ΣF_x - ΣR). The load of
        a side is never negative.

        Args:
            loads: load transfer T [N] and centre of pressure x_p [m], if they are unknowns of a larger search. None:
                they are solved here.
        """
        if loads is not None:
            return _forces_at_loads(loads, None, self)
        constant_inputs = jax.lax.stop_gradient(self)
        solved_loads, slopes = _solve_loads(constant_inputs)
        forces = _forces_at_loads(solved_loads, None, self)
        # Only the last step carries derivatives, the implicit ones; it is so small that linear terms suffice.
        change = _load_step(forces.residual, slopes.residual)
        return jax.tree.map(lambda x, slope: x - slope @ change, forces, slopes)


def _load_step(residual: Pair, slope: Float[Array, "2 2"]) -> Pair:
    """Newton step of load transfer and centre of pressure, to be subtracted."""
    (a, b), (c, d) = slope
    first, second = residual
    return jnp.stack([d * first - b * second, a * second - c * first]) / (a * d - b * c)


def _solve_loads(inputs: GroundForceInputs) -> tuple[Pair, GroundForces]:
    """Load transfer [N] and centre of pressure [m], and the derivatives of `GroundForces` with respect to them.

    The results carry no derivatives. While the whole contact is loaded, the moments of its law do not depend on the
    loads.
    """
    stance, load = inputs.stance, inputs.load

    def solve(loads: Array, inputs: GroundForceInputs, uniform_moments: Array | None) -> tuple[Array, GroundForces]:
        def step(_: int, loads: Array) -> Array:
            def residual(x: Array) -> tuple[Array, Array]:
                return (_forces_at_loads(x, uniform_moments, inputs).residual,) * 2

            slope, load_residual = jax.jacfwd(residual, has_aux=True)(loads)
            return loads - _load_step(load_residual, slope)

        loads = jax.lax.fori_loop(0, LOAD_STEPS, step, loads, unroll=uniform_moments is not None)
        return loads, jax.jacfwd(lambda x: _forces_at_loads(x, uniform_moments, inputs))(loads)

    zero = load * inputs.sliding[0]
    first_loads = jnp.stack([jnp.zeros_like(zero), stance.ahead * jnp.ones_like(zero)])
    uniform_moments = law_moments(*_moment_arguments(first_loads[1], inputs))
    solution = solve(first_loads, inputs, uniform_moments)
    is_lifting = (stance.on_tracks > 0.5) & (
        jnp.maximum(jnp.abs(first_loads[1]), jnp.abs(solution[0][1])) > stance.length / 6
    )
    return compute_if_needed(
        is_lifting, lambda loads, inputs: solve(loads, inputs, None), (first_loads, inputs), solution
    )


def _moment_arguments(centre: Scalar, inputs: GroundForceInputs) -> tuple[ContactLaw, Array, Scalar, Scalar]:
    """Arguments of `law_moments` for a centre of pressure."""
    stance, yaw = inputs.stance, inputs.yaw_rate
    place, half, _ = loaded_part(stance, centre)
    law = ContactLaw(inputs.friction, stance.lateral ** (2 * stance.rule - 2), stance.on_tracks, stance.nodes)
    return law, inputs.sliding, -inputs.lateral_speed - yaw * (place - stance.ahead), -yaw * half


def _forces_at_loads(loads: Array, uniform_moments: Array | None, inputs: GroundForceInputs) -> GroundForces:
    """Ground forces for a given load transfer and centre of pressure.

    The lateral speed is linear along a contact, and so is its load. Forces and moments are therefore sums of four
    moments of the law over a uniform load. `uniform_moments`: these moments, if known.
    """
    (load_transfer, centre), stance, adhesion, load = loads, inputs.stance, inputs.adhesion, inputs.load
    normal = jnp.maximum(load / 2 - 2 * SIDES * load_transfer, 0.0)
    place, half, tilt = loaded_part(stance, centre)
    arm = place - stance.ahead
    law, sliding, middle, end = _moment_arguments(centre, inputs)
    uniform_moments = law_moments(law, sliding, middle, end) if uniform_moments is None else uniform_moments
    zeroth, first, second = (uniform_moments[:, k] + tilt * uniform_moments[:, k + 1] for k in range(3))
    friction_limit, lateral_limit = adhesion * normal, adhesion * normal * stance.lateral**stance.rule
    aside = lateral_limit * (middle * zeroth + end * first)
    lateral_moment = lateral_limit * (middle * first + end * second)
    ahead = friction_limit * zeroth * sliding
    outward_load = stance.height * sum_of_sides(aside) / stance.width
    # A vertical ground carries no normal load.
    rearward_shift = stance.height * sum_of_sides(ahead - inputs.resistance * normal) / jnp.maximum(load, 1e-9)
    return GroundForces(
        normal=normal,
        ahead=ahead,
        aside=aside,
        moment=arm * aside + half * lateral_moment,
        lateral_power=middle * aside + end * lateral_moment,
        load_transfer=load_transfer,
        centre=centre,
        residual=loads - jnp.stack([outward_load, stance.ahead - rearward_shift]),
    )
