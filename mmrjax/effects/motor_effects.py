"""Effects on the motor's torque [N·m] at its shaft, eqs. (14), (17), (18)."""

from __future__ import annotations

import math

import jax.numpy as jnp

from mmrjax.effects.base import Effect, amplitude
from mmrjax.effects.periodic import Periodic, phase_parameter
from mmrjax.model import contact
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Index, Scalar, parameter
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals


class MotorEffect(Effect):
    """Torque lost at the motor's shaft [N·m]."""

    balance = "motor"


class Windage(MotorEffect):
    """ΔM_df = a ω_m |ω_m|: turbulent drag, torque proportional to the square of speed.

    Air drag of the rotor.

    Source: Vrancik, Prediction of windage power loss in alternators, NASA TN D-4849 (1968): power as the
    cube of speed at a constant skin friction coefficient.
    """

    driver = "speed"
    dissipative = True

    amplitude: Scalar = amplitude(
        "N·m·s^2", "torque over squared motor speed", (-1e-9, 1e-8), "0.7 mN·m at 1200 rad/s, a fifth of eq. (14)",
        sd=5e-10,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        # ω² with the shaft's smooth sign: |ω| alone has no derivative at rest.
        return self.amplitude * signals.speed_motor**2 * signals.direction


class StribeckMotor(MotorEffect):
    """ΔM_df = a exp(-|ω_m| / ω_s) sign ω_m.

    The friction of brushes and bearings decreases with shaft speed.

    Source: Tustin, The effects of backlash and of speed-dependent friction on the stability of closed-cycle
    control systems, J. IEE 94 (1947), the exponential law. Armstrong-Hélouvry, Dupont and Canudas de Wit
    (1994), with exponent 1.
    """

    driver = "speed"
    dissipative = True

    amplitude: Scalar = amplitude(
        "N·m", "friction torque at rest in excess of the dry friction", (-3e-3, 2e-2),
        "half of the dry friction of Table 2", sd=1.5e-3,
    )  # fmt: skip
    speed_fade: Scalar = parameter(
        300.0, "rad/s", "motor speed ω_s over which the excess falls to 1/e", (20.0, 3000.0),
        "sleeve bearings leave mixed lubrication at 1000 to 5000 rpm", relative_sd=0.5,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * jnp.exp(-jnp.abs(signals.speed_motor) / self.speed_fade) * signals.direction


class IronLoss(MotorEffect):
    """ΔM_df = a 2x / (1 + x²), x = ω_m / ω_c: the drag of an eddy-current brake.

    Eddy currents in the motor's solid parts brake it, and their own field weakens them at high speed.

    Source: Wouterse, Critical torque and speed of eddy current brake with widely separated soft iron poles,
    IEE Proc. B 138 (1991). Below ω_c the drag is proportional to speed, as eq. (14)'s viscous term. Hysteresis
    acts as its dry term. Only the bend towards ω_c distinguishes the effect from both.
    """

    driver = "speed"
    dissipative = True

    amplitude: Scalar = amplitude(
        "N·m", "largest drag torque, reached at ω_c", (-2e-3, 1e-2), "a quarter of the no-load torque of 4.3 mN·m",
        sd=1e-3,
    )  # fmt: skip
    speed_critical: Scalar = parameter(
        800.0, "rad/s", "motor speed ω_c of the largest drag", (50.0, 2e4),
        "millimetres of solid steel: 10^2 to 10^4 rad/s", relative_sd=0.5,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        share = signals.speed_motor / self.speed_critical
        return self.amplitude * 2 * share / (1 + share**2)


class TorqueConstantSaturation(MotorEffect):
    """ΔM_d = a C_m I³: C_m(I) = C_m (1 - a I²) in the torque of eq. (17).

    Armature reaction weakens the torque constant at high current.

    Source: demagnetising part of the armature reaction, even in the current (Fitzgerald, Kingsley and Umans,
    Electric Machinery, 2003, ch. 7). It weakens torque and back-EMF by the same share. Only the motor balance
    includes it, because its share is larger there: with I R a tenth of U, the back-EMF part is of second order.
    The term alone is therefore not a loss of power.
    """

    driver = "load"

    amplitude: Scalar = amplitude(
        "1/A^2", "relative loss of torque constant over squared current", (-0.01, 0.05),
        "3 % at 3 A, since an ironless rotor saturates little", sd=3e-3,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * robot.motor.torque_electromagnetic(signals.current) * signals.current**2


class Cogging(Periodic, MotorEffect):
    """ΔM = a sin(n θ_m + φ) fade(n ω_m), with n ripples per turn. Fade falls from 1 at ω_f to 0 at 2 ω_f.

    The motor's torque ripples as its commutator turns.

    Source: Kenjo and Nagamori, Permanent-Magnet and Brushless DC Motors (1985): ripple at twice the number
    of segments. The RE30 has an ironless rotor, hence no reluctance torque, and 13 segments. Above ω_f the
    rotor's inertia limits the speed ripple to a / (J_d ω_f), 0.03 rad/s at the prior's size. The torque ripple is
    therefore faded out instead of integrated at 5 kHz. It acts at low speed and during starts.
    """

    driver = "angle"

    amplitude: Scalar = amplitude(
        "N·m", "amplitude of the torque ripple", (-5e-3, 5e-3), "a tenth of the no-load torque of 4.3 mN·m", sd=5e-4
    )
    phase: Scalar = phase_parameter()
    ripples: Scalar = parameter(
        26.0, "-", "number of ripples n per turn", (1.0, 100.0), "twice the 13 segments of the commutator",
        relative_sd=0.01,
    )  # fmt: skip
    rate_fade: Scalar = parameter(
        1000.0, "rad/s", "ripple rate ω_f above which the ripple is faded out", (10.0, 1e5),
        "a choice of the model, see the source", relative_sd=0.1,
    )  # fmt: skip

    def order(self, robot: Robot, configuration: Index) -> Scalar:
        return self.ripples

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        share = self.ripples * signals.speed_motor / self.rate_fade
        fade = contact.cubic_step(share**2, 1.0, 1.0, 4.0, 0.0)
        return self.amplitude * self.wave(signals) * fade

    def step_longest(self, robot: Robot, conditions: Conditions) -> float:
        """No limit: while the ripple acts, the steps of a start are shorter than its period."""
        return math.inf
