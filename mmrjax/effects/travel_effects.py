"""Effects on the resistance of the ground [N], eqs. (1), (5), and on the slip [m/s], eqs. (32), (33)."""

from __future__ import annotations

import jax.numpy as jnp

from mmrjax.effects.base import Effect, Periodic, amplitude, phase_parameter
from mmrjax.model.params import Index, Scalar, parameter
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals


class GroundEffect(Effect):
    """Force against the travel, on one side [N]."""

    balance = "ground"


class SpeedRolling(GroundEffect):
    """ΔF_f = a N V² against the travel: f(V) = f + a V².

    The rolling resistance grows with the square of speed.

    Source: Wong, Theory of Ground Vehicles (2008), ch. 1: f = f_0 + f_s V² of rolling tyres. Bekker (1969)
    for light tracks.
    """

    driver = "speed"
    dissipative = True

    amplitude: Scalar = amplitude(
        "s^2/m^2", "rise of the coefficient f over squared speed", (-0.01, 0.1),
        "at 1 m/s a sixth to a third of f of Table 4", sd=0.01,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.normal * signals.speed**2 * signals.direction_travel


class AdhesiveDrag(GroundEffect):
    """ΔF_f = a (1 + (V / V_p)²)^0.3 against the travel: a rest value that grows as V^0.6, independent of the load.

    Rubber is peeled off the ground behind the contact.

    Source: Roberts and Thomas, The adhesion and friction of smooth rubber surfaces, Wear 33 (1975) 45.
    Maugis and Barquins, J. Phys. D 11 (1978) 1989: energy of peeling w (1 + (V/V_p)^0.6) times the width.
    Smoothed at rest, so that its derivative is finite.
    """

    driver = "speed"
    dissipative = True

    amplitude: Scalar = amplitude(
        "N", "peeling force of one side at a crawl", (-0.02, 0.3), "0.1 J/m^2 over 0.1 m of width, and more if soft",
        sd=0.02,
    )  # fmt: skip
    speed_peel: Scalar = parameter(
        1e-3, "m/s", "speed V_p above which peeling is rate-dependent", (1e-6, 1.0),
        "rubber on glass at room temperature: micrometres to millimetres per second", relative_sd=1.0,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        growth = (1 + (signals.speed / self.speed_peel) ** 2) ** 0.3
        return self.amplitude * growth * signals.direction_travel


class WeightTransfer(GroundEffect):
    """ΔF_f = a N tan² α against the travel.

    The slope loads the rear of the tracks, and uneven pressure increases the resistance.

    Source: load transfer (h/L) tan α of the weight (Wong 2008, ch. 1). Resistance that is convex in the
    local pressure gains the square of an antisymmetric transfer (Bekker 1956: compaction as a power of the pressure
    above 1). So the first-order part cancels and a ~ f (h/L)².
    """

    driver = "slope"
    dissipative = True

    amplitude: Scalar = amplitude(
        "-", "rise of the coefficient f over squared slope", (-0.2, 2.0), "at 20 deg 0.03, half of f of Table 4",
        sd=0.2,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.normal * jnp.tan(signals.slope) ** 2 * signals.direction_travel


class Sinkage(GroundEffect):
    """ΔF_f = a N (M / M_0)^(1/n) against the travel, M_0 the robot without payload.

    Tracks or wheels that sink deeper under load meet more resistance.

    Source: Bekker, Theory of Land Locomotion (1956): compaction resistance as the power (n + 1)/n of the
    load with sinkage exponent n. Written as a change of the coefficient of the unladen robot, so that a is a
    coefficient.
    """

    driver = "load"
    dissipative = True

    amplitude: Scalar = amplitude(
        "-", "rise of the coefficient f at the robot's own mass", (-0.03, 0.3), "a third of f of Table 4", sd=0.02
    )
    exponent: Scalar = parameter(
        1.0, "-", "sinkage exponent n", (0.3, 2.0),
        "0.5 for clay, 1 for sand; felt and lacquer are like springs (Wong 2008, ch. 2)", relative_sd=0.3,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        unladen = robot.chassis(signals.configuration).mass
        growth = (signals.mass / unladen) ** (1 / self.exponent)
        return self.amplitude * signals.normal * growth * signals.direction_travel


class SlopeBias(GroundEffect):
    """ΔF = a N: m_i g (sin(α + a) - sin α) to first order, independent of the direction of travel.

    The slope differs from the reading of the inclinometer.

    Source: expansion of eq. (1). The change of the normal load, second order in a on the level, is left out.
    On the level in forward travel it looks like rolling resistance. Reverse travel distinguishes the two.
    """

    driver = "weight"
    odd_in_travel = True

    amplitude: Scalar = amplitude(
        "rad", "excess of the true slope angle over the stated one", (-0.1, 0.1),
        "half a degree for an inclinometer on a bench", sd=9e-3,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.normal


class GrouserPolygon(Periodic, GroundEffect):
    """ΔF = a sin(2π r_k θ_k / p + φ) in the tracked configuration, p the pitch of the grousers.

    The belt runs over its grousers as over the corners of a polygon.

    Source: chordal action of chain drives (Budynas and Nisbett, Shigley's Mechanical Engineering Design,
    2011, ch. 17), grousers every 35 mm (Section 3.2.4): 6.9 passages per turn of the pulley. The robot rises and
    falls again, so a full passage takes no power out.
    """

    driver = "angle"
    movers = "tracks"

    amplitude: Scalar = amplitude(
        "N", "amplitude of the force of one side", (-20.0, 20.0), "a few percent of the weight of a side", sd=1.0
    )
    phase: Scalar = phase_parameter()
    pitch: Scalar = parameter(35e-3, "m", "pitch p of the grousers", (5e-3, 0.2), "Section 3.2.4", relative_sd=0.01)

    def order(self, robot: Robot, configuration: Index) -> Scalar:
        passages = robot.radius_pulley / (self.pitch * robot.gearbox.ratio)
        return 2 * jnp.pi * passages * robot.chassis(configuration).on_tracks

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * self.wave(signals)


#: Share of V_1, and distance of the demand from its limit, within which the slip of shaking contacts is smoothed [-].
SLOWEST, ROUNDED = 1e-3, 0.05


class SlipEffect(Effect):
    """Speed lost between belt or tyre and the ground [m/s]."""

    balance = "slip"


class RollingRadius(SlipEffect):
    """ΔV = -a r_k ω_k: per radian the robot travels (1 + a) r_k, while the lever arm of the traction stays r_k.

    The distance travelled per turn of the wheel differs from that of the nominal radius.

    Source: kinematic rolling radius against loaded radius (Wong, Theory of Ground Vehicles, 2008, ch. 1).
    The difference is kinematic and not dissipative: a > 0 reduces the loss in slip.
    """

    amplitude: Scalar = amplitude(
        "-", "relative error of the rolling radius", (-0.2, 0.2),
        "belt and tyre thickness against radius: a few percent", sd=0.03,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return -self.amplitude * signals.speed_theoretical


class BeltCreep(SlipEffect):
    """ΔV = a P V_teor: elastic creep, proportional to the traction P of a side and to the speed V_teor without slip.

    The belt stretches under traction and creeps on its pulley.

    Source: Firbank, Mechanics of the belt drive, Int. J. Mech. Sci. 12 (1970) 1053: creep = change of
    tension over the belt's stiffness E A, so a = 1/(E A). The demand is used as traction, which it equals in
    steady travel.
    """

    driver = "demand"
    dissipative = True

    amplitude: Scalar = amplitude(
        "1/N", "creep over traction of a side, 1/(E A)", (-1e-3, 1e-2),
        "E A of 1 to 20 kN for narrow rubber with cord, 1 % of creep at 22 N", sd=5e-4,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.demand * signals.speed_theoretical * signals.direction


class NonlinearSlip(SlipEffect):
    """ΔV = a V_teor u³, with the speed V_teor without slip and u = demand over the adhesion limit of eq. (6).

    The slip grows steeply as the demand approaches the adhesion limit.

    Source: Janosi and Hanamoto (1961): traction saturates over slip. The cube is the steep part of its
    inverse. u is limited to 2. From u = 1 on, the robot slides.
    """

    driver = "demand"
    dissipative = True

    amplitude: Scalar = amplitude(
        "-", "slip at the adhesion limit", (-0.05, 0.5), "slip of tracks at full adhesion: 5 to 20 %", sd=0.05
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        adhesion_used = jnp.clip(signals.demand / signals.adhesion_limit, -2.0, 2.0)
        return self.amplitude * adhesion_used**3 * signals.speed_theoretical * signals.direction


class SpeedSlip(SlipEffect):
    """ΔV = a V_teor |V_teor|: the share of speed lost is proportional to the speed V_teor without slip.

    Treads lift off the ground between impacts.

    Source: first term of an expansion of the slip in speed. The loss is kinematic, so on a descent it removes no
        power.
    """

    driver = "speed"

    amplitude: Scalar = amplitude("s/m", "slip over speed", (-0.1, 0.2), "2 % at 1 m/s", sd=0.02)

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.speed_theoretical**2 * signals.direction


class LoadSlip(SlipEffect):
    """ΔV = a V_teor N, with the speed V_teor without slip and the load N of a side: the radius becomes r_k (1 - a N).

    Belt and tyre yield under load, which reduces their rolling radius.

    Source: effective rolling radius of a loaded tyre (Wong 2008, ch. 1. Pacejka, Tire and Vehicle Dynamics,
    2012, ch. 1). Kinematic, so not dissipative.
    """

    driver = "load"

    amplitude: Scalar = amplitude(
        "1/N", "relative loss of rolling radius over load of a side", (-1e-3, 2e-3),
        "1 % at 100 N: a tread 5 mm thick yields by 0.5 mm", sd=1e-4,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.normal * signals.speed_theoretical


class PulleyEccentricity(Periodic, SlipEffect):
    """ΔV = -a r_k ω_k sin(θ_k + φ): the radius that rolls off is r_k (1 + a sin) with a = e / r_k.

    The driving pulley or wheel is eccentric.

    Source: order 1 of the driving wheel's angle. Total run-out as in ISO 1101. The lever arm of the traction
    changes by the same share. This is left out, because an effect enters only one balance.
    """

    driver = "angle"

    amplitude: Scalar = amplitude(
        "-", "eccentricity over rolling radius e / r_k", (-0.1, 0.1),
        "0.2 to 0.5 mm of run-out on a printed or pressed pulley of 38 mm", sd=0.01,
    )  # fmt: skip
    phase: Scalar = phase_parameter()

    def order(self, robot: Robot, configuration: Index) -> Scalar:
        return 1.0 / robot.gearbox.ratio

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return -self.amplitude * signals.speed_theoretical * self.wave(signals)


class VibrationSlip(SlipEffect):
    """ΔV = a √((V_teor / V_1)² + 0.001²)^p u / √((1 - |u|)² + 0.05²), on tracks only.

    V_teor is the speed without slip, V_1 = 1 m/s, and u is the demand over the adhesion limit of eq. (6). Vibrating
    contacts slide while their load is small, so dry friction acts like viscous friction.

    Source: Section 3.2.4 and its ref. [46]. Blekhman, Vibrational Mechanics (2000). The law of Fig. 7 is averaged
    over contacts that oscillate by s (`mmrjax.vibration`), for V_s small compared with s. The slip is proportional to
    s and, because the load leads, to u. s grows as 1 / (1 - u), as the track model shows
    (docs/explanation/vibration.md). It is smoothed at rest and within 0.05 of the limit. Beyond, the robot slides. If
    the demand pulls forward, the robot moves faster than its tracks.
    """

    driver = "demand"
    dissipative = True
    movers = "tracks"
    resolved = True

    amplitude: Scalar = amplitude(
        "m/s", "speed lost at V_1 and half of the adhesion", (-0.05, 0.5),
        "contacts of the track model oscillate by 1 to 4 % of the speed (docs/explanation/vibration.md)", sd=0.02,
    )  # fmt: skip
    exponent: Scalar = parameter(
        2.0, "-", "exponent p of the growth of the oscillation with speed", (0.0, 5.0),
        "inertia forces grow as the square of the frequency; running gears: 2.1 to 3.4", sd=0.7,
    )  # fmt: skip
    speed_reference: Scalar = parameter(
        1.0, "m/s", "speed V_1 for which the amplitude is stated", (1e-3, 100.0),
        "a choice: only the amplitude is fitted", relative_sd=0.01,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        adhesion_used = signals.demand / signals.adhesion_limit
        speed_factor = jnp.hypot(signals.speed_theoretical / self.speed_reference, SLOWEST) ** self.exponent
        return self.amplitude * speed_factor * adhesion_used / jnp.hypot(1 - jnp.abs(adhesion_used), ROUNDED)
