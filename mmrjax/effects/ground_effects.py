"""Effects on the resistance of the ground [N], eqs. (1), (5)."""

from __future__ import annotations

import jax.numpy as jnp

from mmrjax.effects.base import Effect, amplitude
from mmrjax.effects.periodic import Periodic, phase_parameter
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
