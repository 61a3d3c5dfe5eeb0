"""Effects of a robot that turns: unequal sides, and resistance to the turn. Straight travel does not show them.

The library for straight travel does not contain them. On tables of turns the loop tries them in addition to it.
Robot files accept them, and `calibrate` frees their amplitudes.
"""

from __future__ import annotations

from mmrjax.effects.base import THE_SIDE, Effect, amplitude
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals


class SideFriction(Effect):
    """ΔM_df = a s sign ω_m, s = 1 on the left and -1 on the right: a dry loss of M + a left and of M - a right.

    Brushes, bearings and belts of one side have more friction than those of the other.

    Source: Coulomb's friction of each side. Currents of a robot's sides differ in straight travel, by 1.4 A of 4 A in
    LaRocque et al., arXiv 2403.16877 (docs/lab/turning-data.md).
    """

    balance = "motor"
    driver = THE_SIDE

    amplitude: Scalar = amplitude(
        "N·m", "half the difference of the sides' dry friction at the motor, positive if the left has more",
        (-1.0, 1.0), "half of the dry friction of Table 2", sd=1.5e-3,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.side * signals.direction


class SideTorque(Effect):
    """ΔM_d = a s C_m I, s = 1 on the left and -1 on the right: C_m (1 - a) on the left and C_m (1 + a) on the right.

    Motors and ammeters within makers' tolerances, or a motor whose magnets have lost strength.

    Source: eq. (17) with a separate constant for each side.
    """

    balance = "motor"
    driver = THE_SIDE
    rests_on = ("motor.torque_constant",)

    amplitude: Scalar = amplitude(
        "-", "half the relative difference of the sides' torque constants, positive if the left is weaker",
        (-0.5, 0.5), "makers' tolerances of 5 to 10 %", sd=0.05,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.side * robot.motor.torque_electromagnetic(signals.current)


class SideVoltage(Effect):
    """ΔU = a s (E + I R), s = 1 left and -1 right: settled motors get U / (1 + a) on the left, U / (1 - a) on
    the right.

    A driver or leads of one side give its motors less voltage: the robot turns at equal commands.

    Source: eq. (15) with a separate voltage for each side.
    """

    balance = "electrical"
    driver = THE_SIDE

    amplitude: Scalar = amplitude(
        "-", "half the relative difference of the sides' voltages, positive if the left gets less", (-0.5, 0.5),
        "drivers' gains and dead times: a few percent", sd=0.03,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        winding = robot.motor.voltage_winding(signals.current, signals.temperature)
        return self.amplitude * signals.side * (robot.motor.voltage_back(signals.speed_motor) + winding)


class TurningResistance(Effect):
    """ΔM_ψ = a N ω for the load N of each side, against the turn: a moment proportional to load and yaw rate.

    Soil, carpet or tyres that are dragged sideways resist more at higher yaw rates.

    Source: viscous drag in addition to Coulomb's friction. Wong and Chiang, A general theory for skid steering of
    tracked vehicles on firm ground, Proc. IMechE D 215 (2001), for a turning moment that is not constant.
    """

    balance = "yaw"
    driver = "speed"
    dissipative = True

    amplitude: Scalar = amplitude(
        "m·s", "moment against the turn per load and yaw rate", (-0.01, 0.5),
        "a tenth of the friction's moment φ_y L/4 at 4 rad/s (Table 5: 0.03 m)", sd=1e-3,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.normal * signals.yaw_rate


class SideRadius(Effect):
    """ΔV = a s r_k ω_k, s = 1 left and -1 right: the left side rolls on (1 - a) r_k, the right one on (1 + a) r_k.

    A worn belt, or a tyre of lower pressure or another size on one side: the robot turns at equal shaft speeds. The
    lever arm of the traction does not change, as for `rolling_radius`.

    Source: eq. (32) with a separate radius for each side. Unequal wheel diameters are the first of odometry's
    systematic errors in Borenstein and Feng, Measurement and correction of systematic odometry errors in mobile
    robots, IEEE Trans. Robotics and Automation 12 (1996) 869.
    """

    balance = "slip"
    driver = THE_SIDE

    amplitude: Scalar = amplitude(
        "-", "half the relative difference of the sides' rolling radii, positive if the left's is smaller",
        (-0.2, 0.2), "wear and pressure: a percent or two", sd=0.01,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.side * signals.speed_theoretical


class LateralGrip(Effect):
    """ΔM_ψ = a |ω| M_y against the turn, M_y the moment of each side's lateral forces: φ_y (1 + a |ω|) in the turn.

    Grousers dig in, or loose ground piles up at the tracks, more at higher lateral speed. The lateral force
    itself, which matters only for the path in a settled turn, does not change.

    Source: a friction ratio that is linear in the yaw rate. Wong, Theory of Ground Vehicles, chapter 6: the
    coefficient of lateral resistance is not constant. It differs from `turning_resistance` where contacts creep.
    """

    balance = "yaw"
    driver = "speed"
    dissipative = True

    amplitude: Scalar = amplitude(
        "s/rad", "relative rise of the lateral friction over the yaw rate", (-0.1, 2.0), "a fifth at 4 rad/s", sd=0.05
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return -self.amplitude * signals.yaw_rate * signals.direction_turn * signals.moment_lateral
