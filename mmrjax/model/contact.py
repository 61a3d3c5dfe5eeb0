"""Contact with ground and guides: friction law of Fig. 7 and its inverse, contact force (27)-(29), step of Fig. 9a,
loss (24) and guide friction (26) of tracks, motion resistance (5), adhesion (6), (7), slip (32), (33).
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from mmrjax.model.params import Scalar, parameter
from mmrjax.model.signals import safe_quotient
from mmrjax.numerics.elementary import sine, sine_third

_SLIPS = "Tables A1, A2 simulated: slip at 5 and 10 deg implies 9-39 mm/s"
_PACKAGE = "10 V_s, as in the multibody package of ref. [48]"


def cubic_step(x: Scalar, x0: Scalar, y0: Scalar, x1: Scalar, y1: Scalar) -> Scalar:
    """Cubic step from y0 at x0 to y1 at x1, flat outside, Fig. 9a (ref. [48]).

    y0 + (y1 - y0) u² (3 - 2u) with u = (x - x0) / (x1 - x0) held within 0..1.
    """
    u = jnp.clip((x - x0) / (x1 - x0), 0.0, 1.0)
    return y0 + (y1 - y0) * u**2 * (3 - 2 * u)


def smooth_sign(speed: Scalar, speed_rest: Scalar) -> Scalar:
    """Smooth sign of `speed`: the odd cubic x(3 - x²)/2 within ±speed_rest, exactly ±1 beyond [-]."""
    x = jnp.clip(speed / speed_rest, -1.0, 1.0)
    return x * (3 - x**2) / 2


class Friction(eqx.Module):
    """Friction coefficient over sliding speed, Fig. 7 (refs. [48, 49]).

    μ = μ_s x (3 - x²) / 2 with x = v / V_s inside V_s, the cubic step from μ_s to μ_d between V_s and
    V_d, and μ_d beyond. It is odd in v. Static friction thus creeps: the demand sets the sliding speed.
    """

    static: Scalar = parameter(
        None, "-", "static coefficient μ_s, the largest adhesion", (0.01, 3.0),
        "Table 5, φ_x on lacquered wood (surface of the bench)", relative_sd=0.3,
    )  # fmt: skip
    dynamic: Scalar = parameter(
        None, "-", "dynamic coefficient μ_d", (0.005, 3.0), "assumed: 0.8 of μ_s",
        relative_sd=0.3,
    )  # fmt: skip
    speed_static: Scalar = parameter(
        0.02, "m/s", "sliding speed V_s that reaches μ_s", (1e-4, 2.0), _SLIPS, relative_sd=1.0
    )
    speed_dynamic: Scalar = parameter(
        0.2, "m/s", "sliding speed V_d above which μ_d holds", (1e-3, 20.0), _PACKAGE, relative_sd=0.5
    )

    @property
    def speed_rest(self) -> Scalar:
        """Speed below which a robot counts as at rest, a tenth of V_s [m/s]. Directions are smoothed within it.

        Friction at rest is then resolved on the same scale as sliding.
        """
        return 0.1 * self.speed_static

    def coefficient(self, speed: Scalar) -> Array:
        """Friction coefficient [-] at sliding `speed` [m/s], with the sign of the speed."""
        size = jnp.abs(speed)
        falling = cubic_step(size, self.speed_static, self.static, self.speed_dynamic, self.dynamic)
        rising = self.static * smooth_sign(speed, self.speed_static)
        return jnp.where(size < self.speed_static, rising, jnp.sign(speed) * falling)

    def per_speed(self, square: Scalar) -> Scalar:
        """Coefficient over sliding speed [s/m] at the square of that speed [m²/s²].

        Finite at rest, with finite derivatives.
        """
        slow = square < self.speed_static**2
        creeping = self.static * (3 - square / self.speed_static**2) / (2 * self.speed_static)
        size = jnp.sqrt(jnp.where(slow, self.speed_static**2, square))
        falling = cubic_step(size, self.speed_static, self.static, self.speed_dynamic, self.dynamic)
        return jnp.where(slow, creeping, falling / size)

    def per_speed_rise(self, square: Scalar) -> Scalar:
        """Derivative of `per_speed` with respect to that square [s³/m³]."""
        slow = square < self.speed_static**2
        size = jnp.sqrt(jnp.where(slow, self.speed_static**2, square))
        falling = (self.rise(size) - self.per_speed(square)) / (2 * size**2)
        return jnp.where(slow, -self.static / (2 * self.speed_static**3), falling)

    def rise(self, speed: Scalar) -> Array:
        """Derivative of the coefficient with respect to sliding `speed` [s/m]. Negative between V_s and V_d."""
        size = jnp.abs(speed)
        width = self.speed_dynamic - self.speed_static
        u = jnp.clip((size - self.speed_static) / width, 0.0, 1.0)
        x = jnp.clip(speed / self.speed_static, -1.0, 1.0)
        rising = self.static * 1.5 * (1 - x**2) / self.speed_static
        return jnp.where(size < self.speed_static, rising, (self.dynamic - self.static) * 6 * u * (1 - u) / width)

    def speed_creep(self, coefficient: Scalar) -> Scalar:
        """Sliding speed [m/s] for a static friction coefficient: the inverse of the law below V_s.

        x (3 - x²) / 2 = sin 3θ for x = 2 sin θ, so v = 2 V_s sin(asin(μ/μ_s) / 3). A coefficient beyond ±μ_s has no
        such speed. ±V_s is returned, with a zero derivative.
        """
        share = coefficient / self.static
        grips = jnp.abs(share) < 1.0
        third = sine_third(jnp.where(grips, share, 0.0))
        return self.speed_static * jnp.where(grips, 2 * third, jnp.sign(share))


def force_contact(
    gap: Scalar,
    gap_rate: Scalar,
    gap_free: Scalar,
    stiffness: Scalar,
    exponent: Scalar,
    damping: Scalar,
    depth: Scalar,
) -> Scalar:
    """Contact force F_c [N], eqs. (27)-(29): max(0, c h^e - b_max q̇ step) for h = q_0 - q > 0, else 0.

    Args:
        gap: distance q [m].
        gap_rate: rate of the gap q̇ [m/s].
        gap_free: q_0 = r_1 + r_2 [m], eq. (29).
        stiffness: c [N/m^e].
        exponent: e [-].
        damping: b_max [N·s/m].
        depth: penetration d [m] for full damping (cubic step of Fig. 9a, from 0 at q_0).
    """
    h = gap_free - gap
    touching = h > 0
    deep = jnp.where(touching, h, depth)  # a value with a finite derivative when there is no contact
    force = stiffness * deep**exponent - damping * gap_rate * cubic_step(deep, 0.0, 0.0, depth, 1.0)
    return jnp.where(touching, jnp.maximum(force, 0.0), 0.0)


def damping_contact(force: Scalar, gap: Scalar, gap_free: Scalar, damping: Scalar, depth: Scalar) -> Scalar:
    """Damping of a `force` from `force_contact`: its decrease with the gap's rate [N·s/m], same arguments."""
    return jnp.where(force > 0, damping * cubic_step(gap_free - gap, 0.0, 0.0, depth, 1.0), 0.0)


class Track(eqx.Module):
    """M_t = M_t0 sign ω_k + K_ft ω_k at the pulley, and F' = μ_t R_g on the lower guide."""

    loss_coulomb: Scalar = parameter(
        None, "N·m", "static loss torque of a side's tracks M_t0, eq. (24)", (0.0, 1e3),
        "Table 3: 350 mN·m for three tracks, 70 for one", relative_sd=0.15,
    )  # fmt: skip
    loss_viscous: Scalar = parameter(
        None, "N·m·s", "pseudo-viscous loss of a side's tracks K_ft, eq. (24)", (0.0, 100.0),
        "Table 3: 16 mN·m·s for three tracks, 3 for one", relative_sd=0.15,
    )  # fmt: skip
    guide_friction: Scalar = parameter(
        0.20, "-", "track-guide friction coefficient μ_t, eq. (26)", (0.0, 2.0), "Table 4", relative_sd=0.2
    )
    guide_share: Scalar = parameter(
        None, "-", "share of the weight that the guides carry (the pulleys carry the rest)", (0.0, 1.0),
        "Table A1 simulated: between 0 and 1 of the weight; wheels carry all of it", sd=0.2,
    )  # fmt: skip

    def torque_loss(self, speed_wheel: Scalar, direction: Scalar) -> Scalar:
        """Internal loss torque M_t [N·m], eq. (24), at pulley speed [rad/s]."""
        return self.loss_coulomb * direction + self.loss_viscous * speed_wheel

    def force_guide(self, normal: Scalar, direction: Scalar) -> Scalar:
        """Friction of the teeth on the lower guide F'_t = μ_t R_g [N], eq. (26)."""
        return self.guide_friction * self.guide_share * normal * direction


#: Least normal load that divides a demand, beyond the traction it can hold [N].
NO_LOAD = 1e-9


class Ground(eqx.Module):
    """Resistance and adhesion of the surface for one mover."""

    friction: Friction
    rolling_resistance: Scalar = parameter(
        None, "-", "rolling resistance coefficient f, eq. (5)", (0.0, 1.0), "Table 4", relative_sd=0.15
    )

    def force_resistance(self, normal: Scalar, direction: Scalar) -> Scalar:
        """Motion resistance F_f = f N [N], eq. (5), against `direction` (-1..1)."""
        return self.rolling_resistance * normal * direction

    def force_adhesion(self, normal: Scalar, adhesion: Scalar) -> Scalar:
        """Largest traction φ R_z [N], eqs. (6), (7). `adhesion` is the surface's ratio [-]."""
        return self.friction.static * adhesion * normal

    def traction(self, speed_sliding: Scalar, normal: Scalar, adhesion: Scalar) -> Array:
        """Traction [N] of a contact that slides at `speed_sliding` [m/s], eq. (25) with Fig. 7."""
        return self.friction.coefficient(speed_sliding) * adhesion * normal

    def traction_rise(self, speed_sliding: Scalar, normal: Scalar, adhesion: Scalar) -> Array:
        """Derivative of `traction` with respect to `speed_sliding` [N·s/m]."""
        return self.friction.rise(speed_sliding) * adhesion * normal

    def speed_creep(self, demand: Scalar, normal: Scalar, adhesion: Scalar) -> Scalar:
        """Sliding speed [m/s] for a traction equal to `demand` [N]."""
        # A vertical ground carries no normal load: 0 / 0 would make the derivatives of the whole batch NaN.
        return self.friction.speed_creep(demand / jnp.maximum(adhesion * normal, NO_LOAD))


def force_gravity(mass: Scalar, slope: Scalar, gravity: float) -> Scalar:
    """Downhill force m g sin α [N], eq. (1)."""
    return mass * gravity * sine(slope)


def slip_ratio(speed: Scalar, speed_theoretical: Scalar) -> Scalar:
    """s = 1 - V / V_theoretical [-], eq. (33), 0 at rest."""
    return safe_quotient(speed_theoretical - speed, speed_theoretical)
