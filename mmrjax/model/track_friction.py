"""Tracks of one side: internal loss (24), friction on the body's guides (26)."""

from __future__ import annotations

import equinox as eqx

from mmrjax.model.params import Scalar, parameter


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
        "Table A1 simulated lies between 0 and 1 of the weight; wheels carry all of it in 4W2T", sd=0.2,
    )  # fmt: skip

    def torque_loss(self, speed_wheel: Scalar, direction: Scalar) -> Scalar:
        """Internal loss torque M_t [N·m], eq. (24), at pulley speed [rad/s]."""
        return self.loss_coulomb * direction + self.loss_viscous * speed_wheel

    def force_guide(self, normal: Scalar, direction: Scalar) -> Scalar:
        """Friction of the teeth on the lower guide F'_t = μ_t R_g [N], eq. (26)."""
        return self.guide_friction * self.guide_share * normal * direction
