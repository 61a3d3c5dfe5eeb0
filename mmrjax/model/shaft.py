"""Load on a bench: a shaft with inertia, friction, a constant torque, and a gravity torque over its angle."""

from __future__ import annotations

import math
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp

from mmrjax.model.params import Scalar, parameter

_STATED = "stated by the owner of the rig"
#: Flanks in contact: natural frequency of the two sides [Hz], and damping ratio [-].
MESH_FREQUENCY, MESH_DAMPING = 150.0, 0.4
_MESH = 2 * math.pi * MESH_FREQUENCY
#: Stiffness and damping of flanks in contact, per reduced inertia of the two sides [1/s²], [1/s].
FLANK_STIFFNESS, FLANK_DAMPING = _MESH**2, 2 * MESH_DAMPING * _MESH


class Shaft(eqx.Module):
    """J dω/dt = M_r - (M_0 sign ω + K ω) - M_c - m g l sin(θ - θ_0), at the output of one drive.

    One law for bench, winch, screw, pendulum and carriage. A winch has M_c = m g r. A screw of lead p with a carriage
    of mass m has J = m (p / 2π)² and travels p / 2π per radian. Newton's law for rotation. Friction as for the
    tracks, eq. (24).

    Attributes:
        speed_rest: output speed below which friction is smoothed through rest [rad/s].
        lacks: balances that it lacks, having no ground.
        on_tracks: 0, neither tracks nor wheels.
        mass: mass of a robot, 0.
        speed_grip: 0, nothing slides.
    """

    lacks: ClassVar[frozenset[str]] = frozenset({"ground", "slip", "mass"})
    on_tracks: ClassVar[float] = 0.0
    mass: ClassVar[float] = 0.0
    speed_grip: ClassVar[float] = math.inf
    inertia: Scalar = parameter(
        None, "kg·m^2", "inertia J of all parts that turn with the output of one drive", (0.0, 1e4), _STATED,
        relative_sd=0.2,
    )  # fmt: skip
    loss_coulomb: Scalar = parameter(
        None, "N·m", "dry friction torque M_0 at the output", (0.0, 1e4), _STATED, relative_sd=0.5
    )
    loss_viscous: Scalar = parameter(
        0.0, "N·m·s", "viscous friction K at the output", (0.0, 1e4), _STATED, relative_sd=0.5
    )
    torque_constant: Scalar = parameter(
        0.0, "N·m", "torque M_c that acts against forward rotation at any speed, such as a winch's weight",
        (-1e4, 1e4), _STATED, relative_sd=0.2,
    )  # fmt: skip
    torque_gravity: Scalar = parameter(
        0.0, "N·m", "largest gravity torque on an arm, m g l", (0.0, 1e4), _STATED, relative_sd=0.1
    )
    angle_zero: Scalar = parameter(
        0.0, "rad", "hanging angle θ_0 of the arm, from the start of a run", (-6.3, 6.3), _STATED, sd=0.05,
        scanned=1.0,
    )  # fmt: skip
    backlash: Scalar = parameter(
        0.0, "rad", "backlash of gearbox and couplings at the output, from flank to flank", (0.0, 1.0), _STATED,
        relative_sd=0.3, scanned=0.0,
    )  # fmt: skip
    stiffness: Scalar = parameter(
        0.0, "N·m/rad", "stiffness k of gearbox and coupling at the output (0: rigid)", (0.0, 1e8), _STATED,
        relative_sd=0.3,
    )  # fmt: skip
    damping: Scalar = parameter(
        0.0, "N·m·s", "damping d of an elastic gearbox and coupling at the output", (0.0, 1e4), _STATED,
        relative_sd=0.5,
    )  # fmt: skip
    radius: Scalar = parameter(
        1.0, "m", "travel per radian of the output: radius of a drum, lead of a screw / 2π", (1e-6, 10.0), _STATED,
        relative_sd=0.005,
    )  # fmt: skip
    speed_rest: float = eqx.field(default=0.01, static=True)

    @property
    def speed_still(self) -> Scalar:
        """Speed below which friction at rest is not resolved [m/s]."""
        return self.radius * self.speed_rest

    def torque_loss(self, speed: Scalar, direction: Scalar) -> Scalar:
        """Friction torque M_0 sign ω + K ω [N·m] at `speed` [rad/s] and its `direction` (-1..1)."""
        return self.loss_coulomb * direction + self.loss_viscous * speed

    @property
    def has_two_bodies(self) -> bool:
        """True if motor and load can turn relative to each other, because of backlash or an elastic joint."""
        return bool(self.backlash > 0) or bool(self.stiffness > 0)

    def frequency(self, inertia_motor: Scalar) -> Scalar:
        """Angular frequency of motor and load that swing against each other across an elastic joint [rad/s].

        √(k (1/J_m + 1/J)) with the inertia J_m of the motor side at the output [kg·m²]. 0 without a stiffness.
        """
        return jnp.sqrt(self.stiffness * (1 / inertia_motor + 1 / self.inertia))

    def twist(self, torque: Scalar) -> Scalar:
        """Twist of an elastic joint under a torque at the output [rad], 0 of a rigid one."""
        elastic = jnp.asarray(self.stiffness) > 0
        return jnp.where(elastic, torque / jnp.where(elastic, self.stiffness, 1.0), 0.0)

    def torque_joint(self, gap: Scalar, gap_rate: Scalar, inertia_motor: Scalar) -> Scalar:
        """Torque that the gear flanks or the elastic joint carry [N·m], 0 while flanks do not touch.

        k s + d ds/dt over the twist s. With backlash s is the compression beyond half of it, and flanks never pull (a
        dead zone with compliance: Nordin and Gutman, Controlling mechanical systems with backlash, Automatica 38
        (2002) 1633). A rig's sampling does not resolve the stiffness of flanks. If no stiffness is stated, they
        oscillate at `MESH_FREQUENCY`, damped by `MESH_DAMPING`.

        Args:
            gap: angle of the output's motor side ahead of the load, from the middle [rad].
            gap_rate: rate of the gap [rad/s].
            inertia_motor: inertia of the motor side at the output [kg·m²].
        """
        reduced_inertia = inertia_motor * self.inertia / (inertia_motor + self.inertia)
        elastic = jnp.asarray(self.stiffness) > 0
        stiffness = jnp.where(elastic, self.stiffness, FLANK_STIFFNESS * reduced_inertia)
        damping = jnp.where(elastic, self.damping, FLANK_DAMPING * reduced_inertia) * gap_rate
        compression_forward = jnp.maximum(gap - 0.5 * self.backlash, 0.0)
        compression_backward = jnp.minimum(gap + 0.5 * self.backlash, 0.0)
        # Damping sets in over a tenth of the backlash, so that the torque is continuous at contact.
        damping_onset = 0.1 * self.backlash + 1e-4
        push = jnp.maximum(
            stiffness * compression_forward + damping * jnp.minimum(compression_forward / damping_onset, 1.0), 0.0
        )
        pull = jnp.minimum(
            stiffness * compression_backward + damping * jnp.minimum(-compression_backward / damping_onset, 1.0), 0.0
        )
        return jnp.where(jnp.asarray(self.backlash) > 0, push + pull, stiffness * gap + damping)

    def torque_weight(self, mass: Scalar, slope: Scalar) -> Scalar:
        """Torque of gravity at rest against forward rotation [N·m], independent of a vehicle's mass and slope."""
        return self.torque_load(0.0)

    def torque_load(self, angle: Scalar) -> Scalar:
        """Torque that acts against forward rotation M_c + m g l sin(θ - θ_0) [N·m]."""
        return self.torque_constant + self.torque_gravity * jnp.sin(angle - self.angle_zero)
