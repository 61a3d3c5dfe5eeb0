"""Ground: motion resistance (5), adhesion (6), (7), slip (32), (33)."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp

from mmrjax.model.contact import Friction
from mmrjax.model.params import Scalar, parameter
from mmrjax.model.signals import safe_quotient
from mmrjax.numerics.trigonometry import sine

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

    def traction(self, speed_sliding: Scalar, normal: Scalar, adhesion: Scalar) -> Scalar:
        """Traction [N] of a contact that slides at `speed_sliding` [m/s], eq. (25) with Fig. 7."""
        return self.friction.coefficient(speed_sliding) * adhesion * normal

    def traction_rise(self, speed_sliding: Scalar, normal: Scalar, adhesion: Scalar) -> Scalar:
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
