"""Two sides: how a robot whose sides are driven apart stands on the ground and slides over it.

Frame of the robot, its origin the centre of mass: x ahead, y to the left, yaw positive to the left. Sides are in the
order left, right (leading axis 2), their contact lines at y = ±B/2. A contact at (x, y_s) slides over the ground by

    u_x = r ω_k,s - V_s - slip, V_s = v_x - ω y_s,    u_y = -v_y - ω x,

and is held by N μ(|u|) (u_x, λ^a u_y) / |(u_x, λ^(a-1) u_y)|, with μ the law of Fig. 7 and λ = φ_y / φ_x: at u_y = 0
the law of straight travel, and on the friction ellipse whatever a, the rule of direction. At a = 1 the force is along
(φ_x u_x, φ_y u_y), at a = 2 it takes the most power that the ellipse allows. Which holds is an assumption; so is that
loads are those of a rigid robot in balance at every instant.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mmrjax.contact import Friction
from mmrjax.params import Scalar, parameter

#: Of a side's contact line from the middle of the robot, in shares of B [-]: left, right.
SIDES = np.array([0.5, -0.5])
#: Square of a sliding speed too small to have a direction [m²/s²].
STILL = 1e-16
#: Newton steps of the transfer of load; the contact's forces are nearly bilinear in it.
LOAD_STEPS = 3


def _nodes(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places of nodes on -1..1 and their weights, Gauss and Legendre's; and the weights of two wheels at the ends,
    which have the first and the last of them."""
    place, weight = np.polynomial.legendre.leggauss(count)
    ends = np.zeros(count)
    ends[[0, -1]] = 0.5
    return place, weight / 2, ends


class Turning(eqx.Module):
    """What straight travel does not show of a robot with two sides.

    Attributes:
        nodes: of a track's contact, see `Stance`.
    """

    width: Scalar = parameter(
        0.243,
        unit="m",
        meaning="distance B of the contact lines of left and right side",
        bounds=(0.0, 5.0),
        sd=0.012,
        source="middle of 208-278 mm, the widths between and over the tracks (Table 6: B_b, B_T)",
    )
    lateral: Scalar = parameter(
        1.0,
        unit="-",
        meaning="lateral friction over longitudinal φ_y/φ_x",
        bounds=(0.02, 10.0),
        relative_sd=0.2,
        source="Table 5, lacquered wood (surface of the bench)",
    )
    rule: Scalar = parameter(
        1.0,
        unit="-",
        meaning="rule of the direction of friction, a: 1 along (φ_x u_x, φ_y u_y), 2 maximum dissipation",
        bounds=(0.0, 3.0),
        sd=0.5,
        source="assumed; the paper has no lateral sliding",
    )
    inertia: Scalar = parameter(
        0.2,
        unit="kg·m^2",
        meaning="moment of inertia in yaw J_ψ of the robot without payload",
        bounds=(0.0, 1e4),
        relative_sd=0.2,
        source="sum of Table 7's parts in their places of Table 6",
    )
    nodes: int = eqx.field(default=16, static=True)


class Stance(eqx.Module):
    """How a robot stands on its contacts.

    Attributes:
        length: of the contact, or the wheelbase [m]; width: B [m].
        height: of the centre of mass above the ground [m]; ahead: of it from the middle of the contact [m].
        on_tracks: 1 on tracks, whose contact is a line, 0 on wheels, which bear at its ends [-].
        lateral: λ on this ground [-]; rule: a [-].
        nodes: of a track's contact, even. With 16 the width of a turn on the spot under dry friction is 3e-5 off,
            with 32 1e-8.
    """

    length: Scalar
    width: Scalar
    height: Scalar
    ahead: Scalar
    on_tracks: Scalar
    lateral: Scalar
    rule: Scalar
    nodes: int = eqx.field(default=16, static=True)


class Grip(eqx.Module):
    """What the ground does to each side, shape (2,): left, right.

    Attributes:
        normal: load of a side [N]; ahead, aside: forces along x and y [N]; moment: of the lateral forces about the
            centre of mass, positive to the left [N·m].
        across: power that lateral sliding turns into heat [W].
        moved: load that has moved from the left side to the right one [N]; centre: of pressure, ahead of the middle
            of the contact [m].
    """

    normal: Float[Array, " 2"]
    ahead: Float[Array, " 2"]
    aside: Float[Array, " 2"]
    moment: Float[Array, " 2"]
    across: Float[Array, " 2"]
    moved: Scalar
    centre: Scalar


def pressure(stance: Stance, centre: Scalar) -> tuple[Array, Array]:
    """Nodes of a contact [m], from its middle, and the share of the load that each bears [-].

    Tracks: p = (N/L)(1 + 12 x_p x / L²), and from |x_p| = L/6 on a triangle of length 3 (L/2 - |x_p|), its foot where
    the contact lifts off (middle third rule). Wheels: by the lever.
    """
    tracks, length = stance.on_tracks > 0.5, stance.length
    out = jnp.abs(centre)
    tilt = jnp.clip(jnp.where(tracks, 6.0, 2.0) * centre / length, -1.0, 1.0)
    borne = jnp.where(tracks, jnp.clip(3 * (length / 2 - out), 1e-6 * length, length), length)
    middle = jnp.sign(centre) * (length - borne) / 2
    line, share, ends = _nodes(stance.nodes)
    place = jnp.where(tracks, line, np.sign(line))
    weight = jnp.where(tracks, share, ends)
    return middle + place * borne / 2, weight * (1 + tilt * place)


def grip(
    stance: Stance,
    friction: Friction,
    adhesion: Scalar,
    load: Scalar,
    sliding: Float[Array, " 2"],
    lateral_speed: Scalar,
    yaw_rate: Scalar,
    resistance: Float[Array, " 2"],
) -> Grip:
    """Forces and loads of both sides, which hang together.

    The load moves to the outer side, T = h ΣF_y / B, and to the rear, N x_p = N x_c - h ΣF_x; no side bears less than
    nothing.

    Args:
        stance: how it stands; friction: of the ground; adhesion: the surface's ratio [-].
        load: normal to the ground, of both sides [N].
        sliding: u_x of each side [m/s]; lateral_speed: v_y [m/s]; yaw_rate: ω [rad/s].
        resistance: rolling resistance over the normal load, with its sign, of each side [-].
    """

    given = stance, friction, adhesion, load, sliding, lateral_speed, yaw_rate, resistance

    def lacking(loads: Array, given: Any) -> Array:
        stance, load, resistance = given[0], given[3], given[7]
        found = _at_loads(loads, *given[:7])
        along = jnp.sum(found.ahead - resistance * found.normal)
        moved = stance.height * jnp.sum(found.aside) / stance.width
        # Nothing presses on a vertical ground.
        centre = stance.ahead - stance.height * along / jnp.maximum(load, 1e-9)
        return loads - jnp.stack([moved, centre])

    def corrected(loads: Array, left: Array, slope: Array) -> Array:
        (a, b), (c, d) = slope
        return loads - jnp.stack([d * left[0] - b * left[1], a * left[1] - c * left[0]]) / (a * d - b * c)

    held = jax.lax.stop_gradient(given)

    def linearised(loads: Array) -> tuple[Array, Array]:
        return jax.jacfwd(lambda x: (lacking(x, held),) * 2, has_aux=True)(loads)

    def step(_: int, loads: Array) -> Array:
        slope, left = linearised(loads)
        return corrected(loads, left, slope)

    nothing = held[3] * held[4][0]
    begun = jnp.stack([jnp.zeros_like(nothing), held[0].ahead * jnp.ones_like(nothing)])
    at = jax.lax.fori_loop(0, LOAD_STEPS - 1, step, begun)
    # The last step alone carries the derivatives, which are the implicit ones.
    slope, _ = linearised(at)
    return _at_loads(corrected(at, lacking(at, given), slope), *given[:7])


def _at_loads(
    loads: Array,
    stance: Stance,
    friction: Friction,
    adhesion: Scalar,
    load: Scalar,
    sliding: Array,
    lateral_speed: Scalar,
    yaw_rate: Scalar,
) -> Grip:
    """What the ground does where so much load has moved, and the centre of pressure is there."""
    moved, centre = loads
    normal = jnp.maximum(load / 2 - 2 * SIDES * moved, 0.0)
    place, share = pressure(stance, centre)
    arm = place - stance.ahead
    across = -lateral_speed - yaw_rate * arm
    along, squared = sliding[:, None] ** 2, across**2
    weighed = along + stance.lateral ** (2 * stance.rule - 2) * squared
    turned = jnp.sqrt((along + squared + STILL) / (weighed + STILL))
    holds = adhesion * share * turned * friction.per_speed(along + squared)
    aside = stance.lateral**stance.rule * holds * across
    return Grip(
        normal=normal,
        ahead=normal * jnp.sum(holds, -1) * sliding,
        aside=normal * jnp.sum(aside, -1),
        moment=normal * jnp.sum(aside * arm, -1),
        across=normal * jnp.sum(aside * across, -1),
        moved=moved,
        centre=centre,
    )
