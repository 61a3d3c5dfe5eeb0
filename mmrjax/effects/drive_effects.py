"""Effects on the motor [N·m] at its shaft, eqs. (14), (17), (18), and the gearbox [N·m] behind it, eqs. (19)-(23).

M_load is the torque that the gearbox transmits to its output (`signals.torque_carried`): the load, and what
accelerates the parts behind the gearbox, but not the rotor.
"""

from __future__ import annotations

import math

import jax.numpy as jnp

from mmrjax.effects.base import Bristle, Effect, Periodic, amplitude, breakaway_parameter, phase_parameter
from mmrjax.model import contact
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Index, Scalar, parameter
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals
from mmrjax.numerics.elementary import at_least, magnitude


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
        ratio = signals.speed_motor / self.speed_critical
        return self.amplitude * 2 * ratio / (1 + ratio**2)


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
        ratio = self.ripples * signals.speed_motor / self.rate_fade
        fade = contact.cubic_step(ratio**2, 1.0, 1.0, 4.0, 0.0)
        return self.amplitude * self.wave(signals) * fade

    def step_longest(self, robot: Robot, conditions: Conditions) -> float:
        """No limit: while the ripple acts, the steps of a start are shorter than its period."""
        return math.inf


class GearboxEffect(Effect):
    """Torque lost in the gearbox, at its output shaft [N·m]."""

    balance = "gearbox"


class GearLoadLoss(GearboxEffect):
    """ΔM_r = a |M_load|: a share of the torque at the output shaft.

    Teeth lose a larger or smaller share of the load than the catalogue states.

    Source: Niemann and Winter, Maschinenelemente II (2003): load-dependent mesh loss P_Z = P μ_z H_v. It is
    eq. (19)'s η_rm in another form: indistinguishable from a change of η_rm by -a η_rm.
    """

    driver = "load"
    dissipative = True

    amplitude: Scalar = amplitude(
        "-", "share of the output torque lost beyond eq. (19)", (-0.2, 0.5),
        "η_rm of two or three planetary stages: 0.70 to 0.80", sd=0.05,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        load = signals.torque_carried
        return self.amplitude * magnitude(load, signals.direction) * signals.direction


class GearQuadraticLoss(GearboxEffect):
    """ΔM_r = a M_load²: the square of the torque at the output shaft.

    The gear loss grows faster than the load.

    Source: second-order term of the load-dependent mesh loss. The coefficient of friction grows with the tooth load
    (Ohlendorf, Verlustleistung und Erwärmung von Stirnrädern, 1958: μ ∝ load^0.2), and the planets tilt under load.
    """

    driver = "load"
    dissipative = True

    amplitude: Scalar = amplitude(
        "1/N/m", "loss torque over squared output torque", (-0.05, 0.3), "6 % of the load at 2 N·m", sd=0.03
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.torque_carried**2 * signals.direction


class StribeckGear(GearboxEffect):
    """ΔM_r = a exp(-|ω_m| / ω_s) sign ω_m at the output shaft.

    The friction of the gear decreases with the speed of its input.

    Source: Tustin (1947), the exponential law. Mixed lubrication of grease-packed planets (Niemann and
    Winter, 2003). With the same ω_s it is `stribeck_motor` times i η_rm.
    """

    driver = "speed"
    dissipative = True

    amplitude: Scalar = amplitude(
        "N·m", "friction torque at rest, at the output", (-0.1, 1.0),
        "about 1.5 mN·m at the input, times 48 and η_rm", sd=0.05,
    )  # fmt: skip
    speed_fade: Scalar = parameter(
        300.0, "rad/s", "input speed ω_s that scales the decay of the excess", (20.0, 3000.0),
        "grease leaves mixed lubrication at 1000 to 5000 rpm of the input", relative_sd=0.5,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * jnp.exp(-jnp.abs(signals.speed_motor) / self.speed_fade) * signals.direction


class BackdrivingLoss(GearboxEffect):
    """ΔM_r = a |M_load| if the load drives the motor, 0 if the motor drives the load.

    Teeth lose a larger or smaller share of the load while power flows back through them, as on a descent.

    Source: Duclusaud, Passault, Padois and Ly, Extended friction models for the physics simulation of servo
    actuators (2024, arXiv:2410.08650): directional models in which motor and load each have a share of friction.
    Niemann and Winter, Maschinenelemente II (2003): the backward efficiency 2 - 1/η is below η. A share 1 - a of the
    load's torque reaches the gear, and a share η_b of that, eq. (19), the motor. At a = 1 the gear is self-locking.
    The load excludes the rotor's inertia. The effect fades at rest with the shaft's smooth sign.
    """

    driver = "load"
    dissipative = True

    amplitude: Scalar = amplitude(
        "-", "share of the load's torque lost beyond eq. (19) while the load drives", (-0.2, 1.0),
        "η - (2 - 1/η) = 0.09 for η_rm of Table 2", sd=0.1,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        backdriving = at_least(0.0, -signals.torque_carried * signals.direction)
        return self.amplitude * backdriving * signals.direction


class BristleLoadLoss(Bristle, GearboxEffect):
    """ΔM_r = a |M_load| z, θ_s z' = ω_k - |ω_k| z, z(0) = 0: a share of the load lost through a bristle.

    Loaded teeth yield over a small angle before they slide, so that their loss builds up after a reversal.

    Source: Duclusaud, Passault, Padois and Ly, Extended friction models for the physics simulation of servo actuators
    (2024, arXiv:2410.08650): friction in proportion to the load, here through Dahl's bristle (1968). Settled
    z = sign ω_k: it then equals `gear_load_loss`, and reversals distinguish the two. With `bristle_backdriving_loss`
    of amplitude b it is μ_avg |M_load| z + μ_dif M_load z² with μ_avg = a + b/2 and μ_dif = -b/2. Bent teeth return
    energy, so it is not a pure loss.
    """

    driver = "load"
    settles_to = "gear_load_loss"

    amplitude: Scalar = amplitude(
        "-", "share of the output torque lost through the bristle", (-0.2, 0.5), "as for `gear_load_loss`", sd=0.05
    )
    angle_breakaway: Scalar = breakaway_parameter()

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        load = magnitude(signals.torque_carried, signals.direction)
        return self.amplitude * load * self.recall(robot, signals)


class BristleBackdrivingLoss(Bristle, GearboxEffect):
    """ΔM_r = a (|M_load| z - M_load z²) / 2, θ_s z' = ω_k - |ω_k| z, z(0) = 0.

    While the load drives the motor, teeth lose a larger or smaller share of it than otherwise, through the bristle of
    `bristle_load_loss`.

    Source: Duclusaud, Passault, Padois and Ly (2024, arXiv:2410.08650): directional models in which motor and load
    each have a share of friction. Dahl (1968). Settled z = sign ω_k: it then equals `backdriving_loss`, 0 if the
    motor drives the load and a |M_load| if the load drives the motor. Reversals under load distinguish it from
    `backdriving_loss`. See `bristle_load_loss` for the sum of that effect and this one.
    """

    driver = "load"
    settles_to = "backdriving_loss"

    amplitude: Scalar = amplitude(
        "-", "share of the load's torque lost through the bristle while the load drives", (-0.2, 1.0),
        "as for `backdriving_loss`", sd=0.1,
    )  # fmt: skip
    angle_breakaway: Scalar = breakaway_parameter()

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        load = signals.torque_carried
        bend = self.recall(robot, signals)
        backdriving = magnitude(load, signals.direction) * bend - load * bend**2
        return 0.5 * self.amplitude * backdriving
