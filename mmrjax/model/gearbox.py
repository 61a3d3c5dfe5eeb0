"""Reduction gear: losses at idle and losses with load, eqs. (19)-(23)."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp

from mmrjax.model.params import Scalar, parameter
from mmrjax.model.signals import safe_quotient

#: Torque below which the gearbox counts as unloaded, so that rounding does not decide the direction of power [N·m].
NO_TORQUE = 1e-12


class Gearbox(eqx.Module):
    """M_r = i η_rm (M_d - M_rf_idle) with M_rf_idle = M_rf0 sign ω + K_fr ω.

    Driven from the output (overhauling), the load loss changes direction: M_r = (i / η_b) (M_d - M_rf_idle) with the
    efficiency η_b of `efficiency_backward`. The paper leaves it out because its robot never coasts. Without it, a
    robot would gain energy on a descent.

    Attributes:
        mesh_theory: True: η_b = 2 - 1/η_rm, the theory of the mesh. False: η_b = η_rm.
        speed_limit: speed limit at the input [rad/s].
        torque_limit: continuous, at the driving wheel, where the total ratio ends [N·m], None if not stated.
    """

    ratio: Scalar = parameter(
        48.0, "-", "total ratio motor to driving wheel i_r", (1.0, 1e4),
        "GP32C 576/25 and a belt stage 25/12; Tables A1, A2 simulated give 47.97-48.04", relative_sd=0.002,
    )  # fmt: skip
    efficiency_load: Scalar = parameter(
        0.74, "-", "efficiency for losses proportional to load η_rm, eq. (19)", (0.05, 1.0),
        "Table 2 (catalogue 0.75)", relative_sd=0.03,
    )  # fmt: skip
    friction_coulomb: Scalar = parameter(
        0.3e-3, "N·m", "idle Coulomb torque at the input M_rf0, eq. (20)", (0.0, 10.0), "Table 2", relative_sd=0.15
    )
    friction_viscous: Scalar = parameter(
        1.4e-6, "N·m·s", "idle viscous friction at the input K_fr, eq. (20)", (0.0, 1.0), "Table 2: 1.4e-3 mN·m·s",
        relative_sd=0.15,
    )  # fmt: skip
    speed_limit: float = eqx.field(default=8_000 * 0.10471975511965977, static=True)  # 8000 rpm input, catalogue
    # GP32C 166936, maker's sheet: at its output 3 N·m continuous, 3.75 short-term; times the belt stage 25/12 [N·m]
    torque_limit: float | None = eqx.field(default=3.0 * 25 / 12, static=True)
    mesh_theory: bool = eqx.field(default=False, static=True)

    @property
    def efficiency_backward(self) -> Scalar:
        """Efficiency η_b with the load driving the motor [-]: η_rm, or 2 - 1/η_rm by the theory of the mesh.

        Bounded below by 0.02. A loss in proportion to the mesh force is (1/η - 1) of the power that leaves the mesh,
        in both directions. A gear with η <= 1/2 is self-locking.
        """
        if not self.mesh_theory:
            return self.efficiency_load
        return jnp.maximum(2 - 1 / self.efficiency_load, 0.02)

    def torque_idle(self, speed: Scalar, direction: Scalar) -> Scalar:
        """Idle loss torque at the input M_rf_idle [N·m], eq. (20), at input `speed` [rad/s]."""
        return self.friction_coulomb * direction + self.friction_viscous * speed

    def efficiency_flow(self, transmitted: Scalar, direction: Scalar) -> Scalar:
        """η_rm if power flows to the wheels, 1/η_b if it flows back, fading to 1 at rest with `direction` [-].

        `transmitted` is the input torque less the idle torque [N·m]. If it is 0, the efficiency is that of a small
        load: power flows to the wheels.
        """
        way = jnp.where(jnp.abs(transmitted) > NO_TORQUE, jnp.sign(transmitted), jnp.sign(direction))
        flow = way * direction
        return 1 + flow * jnp.where(flow >= 0, self.efficiency_load - 1, 1 - 1 / self.efficiency_backward)

    def torque_output(self, transmitted: Scalar, direction: Scalar) -> Scalar:
        """Output torque M_r [N·m], eqs. (22), (23)."""
        return self.ratio * transmitted * self.efficiency_flow(transmitted, direction)

    def efficiency(self, torque_input: Scalar, speed: Scalar) -> Scalar:
        """Efficiency η_r [-], eq. (19), driving forward at input torque [N·m] and `speed` [rad/s]."""
        return (1 - safe_quotient(self.torque_idle(speed, 1.0), torque_input)) * self.efficiency_load

    def torque_loss(self, torque_input: Scalar, speed: Scalar) -> Scalar:
        """Total loss at the output M_rf [N·m], eq. (22), driving forward."""
        load = torque_input * self.ratio * (1 - self.efficiency_load)
        return load + self.torque_idle(speed, 1.0) * self.ratio * self.efficiency_load
