"""Effects on the gearbox [N·m] at its output shaft, eqs. (19)-(23).

M_load is the torque that the gearbox transmits to its output (`signals.torque_carried`): the load, and what
accelerates the parts behind the gearbox, but not the rotor.
"""

from __future__ import annotations

import jax.numpy as jnp

from mmrjax.effects.base import Effect, amplitude
from mmrjax.effects.bristle import Bristle, breakaway_parameter
from mmrjax.model.params import Scalar, parameter
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals
from mmrjax.numerics.one_sided import at_least, magnitude


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
        driving = at_least(0.0, -signals.torque_carried * signals.direction)
        return self.amplitude * driving * signals.direction


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
        load, bend = signals.torque_carried, self.recall(robot, signals)
        driving = magnitude(load, signals.direction) * bend - load * bend**2
        return 0.5 * self.amplitude * driving
