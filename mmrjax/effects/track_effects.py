"""Effects on the loss of tracks and bearings [N·m] at the driving pulley, eqs. (24), (26)."""

from __future__ import annotations

import jax.numpy as jnp

from mmrjax.effects.base import Bristle, Effect, Periodic, amplitude, breakaway_parameter, phase_parameter
from mmrjax.model.params import Index, Scalar, parameter
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals
from mmrjax.numerics.elementary import magnitude


class TrackEffect(Effect):
    """Torque lost between the driving shaft and the ground, on one side [N·m]."""

    balance = "track"


class Churning(TrackEffect):
    """ΔM_t = a ω_k |ω_k| at the pulley, for the track of one side.

    The loss of the track grows with the square of speed.

    Source: the next term after eq. (24). Impact of teeth and grousers transfers a momentum proportional to the
    speed, at a rate proportional to the speed (Merritt, The Evolution of a Tank Transmission, 1946).
    """

    driver = "speed"
    dissipative = True

    amplitude: Scalar = amplitude(
        "N·m·s^2", "torque over squared pulley speed", (-1e-3, 1e-2), "at 25 rad/s a tenth to the whole of eq. (24)",
        sd=5e-4,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        # ω² with the shaft's smooth sign: |ω| alone has no derivative at rest.
        return self.amplitude * signals.speed_wheel**2 * signals.direction


def _fade_parameter(low: float = 0.5) -> Scalar:
    """The speed over which friction falls, a field of effects that decay with speed."""
    return parameter(
        8.0, "rad/s", "shaft speed ω_s that scales the decay of the excess", (low, 80.0),
        "belt speeds of 0.1 to 0.5 m/s", relative_sd=0.5,
    )  # fmt: skip


class StribeckTrack(TrackEffect):
    """ΔM_t = a exp(-|ω_k| / ω_s) sign ω_k at the pulley, for a side's tracks.

    The friction of belt and pulley bearings decreases with belt speed.

    Source: Tustin (1947), the exponential law. Armstrong-Hélouvry, Dupont and Canudas de Wit (1994).
    """

    driver = "speed"
    dissipative = True

    amplitude: Scalar = amplitude(
        "N·m", "loss torque at rest beyond M_t0", (-0.1, 1.0), "a third of M_t0 of Table 3", sd=0.1
    )
    speed_fade: Scalar = _fade_parameter()

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * jnp.exp(-jnp.abs(signals.speed_wheel) / self.speed_fade) * signals.direction


class TensionFriction(TrackEffect):
    """ΔM_t = a r_k |P_t|: the tension presses the tight side of the belt on pulleys and guides.

    Belt friction grows with the traction that the belt carries.

    Source: Euler (1769) and Eytelwein (1808): normal force of a belt round a pulley in proportion to its
    tension. Merritt, The Evolution of a Tank Transmission (1946), track efficiency as a share of the
    tractive effort.
    """

    driver = "load"
    dissipative = True

    amplitude: Scalar = amplitude(
        "-", "loss torque over torque of the traction", (-0.2, 1.0),
        "1 - efficiency of a rubber track's final drive: 5 to 15 %", sd=0.1,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        radius = robot.chassis(signals.configuration).radius
        return self.amplitude * radius * magnitude(signals.traction, signals.direction) * signals.direction


class CentrifugalTension(TrackEffect):
    """ΔM_t = a M_t0 v², v = ω_k r_p the belt's speed: dry loss M_t0 in proportion to the tension T_0 + ρ v².

    The belt's own centrifugal tension adds to its loss.

    Source: centrifugal tension ρ v² of a running belt (Eytelwein 1808; Budynas and Nisbett, Shigley's
    Mechanical Engineering Design, 2011, ch. 17), so a = ρ / T_0. With the belts of Table 7, ρ = 0.05 kg/m,
    and T_0 of 1 to 10 N. Unlike `churning` it scales with the configuration's own M_t0. r_p is the radius of
    the pulley, which drives the belt in both configurations.
    """

    needs_belt = True
    driver = "speed"
    dissipative = True

    amplitude: Scalar = amplitude(
        "s^2/m^2", "mass of the belt per length over its rest tension", (-0.1, 0.5),
        "0.005 for a taut belt, 0.05 for a slack one", sd=0.05,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        loss = robot.chassis(signals.configuration).track.loss_coulomb
        belt_speed = signals.speed_wheel * robot.radius_pulley
        return self.amplitude * loss * belt_speed**2 * signals.direction


class BendingLoss(TrackEffect):
    """ΔM_t = a 2x / (1 + x²), x = ω_k / ω_r: loss modulus of a standard linear solid.

    Rubber bent round the pulleys (or, for a load on a shaft, in a belt drive or coupling) relaxes while it passes.

    Source: Ferry, Viscoelastic Properties of Polymers (1980), ch. 3, the loss modulus G'' of a Maxwell
    element. Gerbert, Traction Belt Mechanics (1999), bending loss of a belt at each run on and off a pulley.
    Far from ω_r it is similar to eq. (24)'s terms.
    """

    driver = "speed"
    dissipative = True

    amplitude: Scalar = amplitude(
        "N·m", "largest loss torque, reached at ω_r", (-0.1, 1.0), "a seventh of M_t0 of Table 3", sd=0.05
    )
    speed_relaxation: Scalar = parameter(
        8.0, "rad/s", "pulley speed ω_r of the largest loss", (0.5, 200.0),
        "relaxation over a tenth of a second, about the bend's duration", relative_sd=0.5,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        ratio = signals.speed_wheel / self.speed_relaxation
        return self.amplitude * 2 * ratio / (1 + ratio**2)


class StickSlip(TrackEffect):
    """ΔM_t = a z, θ_s z' = ω_k exp(-(ω_k/ω_s)²) - |ω_k| z, z(0) = 0: bristles bend over θ_s, then release.

    Break-away: dry contacts of the track hold a larger torque before they slip.

    Source: Dahl (1968) with the Stribeck curve of Canudas de Wit, Olsson, Åström and Lischinsky, A new model
    for control of systems with friction, IEEE Trans. Automatic Control 40 (1995). The curve multiplies the drive of
    z, so that its rate stays finite. Settled: z = exp(-(ω_k/ω_s)²) sign ω_k, zero at travelling speed. Torque that
    decreases with speed lets a crawling drive stick and slip. The memory is z [-]. Bent bristles return energy, so
    it is not a pure loss.
    """

    driver = "speed"
    transient = True
    memory_size = 1.0
    memory_unit = "-"

    amplitude: Scalar = amplitude(
        "N·m", "break-away torque of a side beyond M_t0", (-0.2, 2.0), "a third of M_t0 of Table 3", sd=0.1
    )
    angle_breakaway: Scalar = parameter(
        0.01, "rad", "angle θ_s of the pulley until the contacts release", (1e-4, 1.0),
        "0.4 mm of belt: shear of teeth and seals", relative_sd=0.5,
    )  # fmt: skip
    speed_fade: Scalar = parameter(
        3.0, "rad/s", "pulley speed ω_s above which the excess vanishes", (0.05, 8.0), "belt speed of 0.1 m/s",
        relative_sd=0.5,
    )  # fmt: skip

    def _excess(self, signals: Signals) -> Scalar:
        return jnp.exp(-((signals.speed_wheel / self.speed_fade) ** 2))

    def settled(self, robot: Robot, signals: Signals) -> Scalar:
        return self._excess(signals) * signals.direction

    def rate(self, robot: Robot, signals: Signals) -> Scalar:
        speed = signals.speed_wheel
        bend_speed = speed * self._excess(signals) - speed * signals.direction * signals.memory[self.name]
        return bend_speed / self.angle_breakaway

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * self.recall(robot, signals)


class DirectionalFriction(TrackEffect):
    """ΔM_t = a (sign ω_k)²: a dry loss of M_t0 + a forward and of M_t0 - a backward.

    Dry friction is larger in one direction of rotation than in the other.

    Source: Armstrong-Hélouvry, Control of Machines with Friction (1991), who states the Coulomb friction of a joint
    separately for each direction. Causes are lip seals, and teeth and belts that bear on another flank. The mean of
    both directions is eq. (24)'s M_t0, half their difference is a. Runs in one direction show only the sum, so that
    the effect cannot be distinguished from M_t0. A constant torque (`torque_offset`) does not depend on the
    direction. The effect is dissipative only together with a larger M_t0. Alone it adds power in one direction, so it
    is not dissipative.
    """

    driver = "direction"
    odd_in_travel = True
    needs_reverse = True

    amplitude: Scalar = amplitude(
        "N·m", "loss torque in forward rotation minus the mean of both directions", (-0.5, 0.5), "a seventh of M_t0 "
        "of Table 3",
        sd=0.05,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.direction**2


class StribeckExponent(TrackEffect):
    """ΔM_t = a exp(-(|ω_k| / ω_s)^δ) sign ω_k at the driven shaft. δ = 2 unless stated.

    The friction of bearings and seals decreases with speed faster or more slowly than exponentially.

    Source: Armstrong-Hélouvry, Dupont and Canudas de Wit, A survey of models, analysis tools and compensation
    methods for the control of machines with friction, Automatica 30 (1994) 1083. δ is 1/2 to 1 in the exponential of
    Bo and Pavelescu, 1 in that of Tustin (`stribeck_track`) and 2 in Armstrong's Gaussian. |ω_k| / ω_s is smoothed
    within a thousandth, as the sign is: for δ below 1 the power has no derivative at rest.
    """

    driver = "speed"
    dissipative = True

    amplitude: Scalar = amplitude(
        "N·m", "loss torque at rest beyond M_t0", (-0.1, 1.0), "a third of M_t0 of Table 3", sd=0.1
    )
    # The loop frees the first of two shapes, ω_s. Test: curves with any δ from 1/2 to 2, after a fit of dry and
    # viscous friction. With ω_s free, δ = 1 and δ = 2 leave half the residual of a free δ at one ω_s and δ = 1.
    speed_fade: Scalar = _fade_parameter(0.05)
    exponent: Scalar = parameter(
        2.0, "-", "exponent δ of the speed", (0.5, 4.0),
        "1/2 to 2 in the survey, and much larger for boundary lubricants", relative_sd=0.5,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        squared_ratio = (signals.speed_wheel / self.speed_fade) ** 2 + 1e-3**2
        return self.amplitude * jnp.exp(-(squared_ratio ** (0.5 * self.exponent))) * signals.direction


class DirectionalViscous(TrackEffect):
    """ΔM_t = a |ω_k|: a viscous loss of K + a forward and of K - a backward.

    Viscous friction is larger in one direction of rotation than in the other.

    Source: Armstrong-Hélouvry, Control of Machines with Friction (1991), who fits viscous friction of a joint
    separately for each direction. Causes are lip seals, and guides that draw in their lubricant in one direction. It
    is the part that grows with speed, in addition to `directional_friction`, which is even in the speed too. The mean
    of both directions is eq. (24)'s viscous loss: runs in one direction show their sum.
    """

    driver = "direction"
    odd_in_travel = True
    needs_reverse = True

    amplitude: Scalar = amplitude(
        "N·m·s", "viscous loss in forward rotation minus the mean of both directions", (-0.05, 0.05),
        "a third of the viscous loss of Table 3", sd=5e-3,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        # The shaft's smooth sign: |ω| has no derivative at rest.
        return self.amplitude * signals.speed_wheel * signals.direction


class TorqueOffset(TrackEffect):
    """ΔM_t = a in both directions of rotation and at rest, or a force a / r_k at the radius r_k.

    A cable, a spring or a counterweight pulls in one direction, or a torque command or meter has an offset.

    Source: Swevers, Verdonck and De Schutter, Dynamic model identification for industrial robots, IEEE Control
    Systems 27 (2007) 58: an offset in addition to dry and viscous friction of each joint. While a shaft turns it
    equals `directional_friction`, which fades at rest: only histories through rest distinguish the two. An offset of
    the motor is a i η_rm at the output. A stated torque of a load on a shaft (`torque_constant`) is the same.
    """

    needs_reverse = True
    odd_in_travel = True
    settles_to = "directional_friction"

    amplitude: Scalar = amplitude(
        "N·m", "torque that acts against forward rotation", (-0.5, 0.5), "a seventh of M_t0 of Table 3", sd=0.05
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * jnp.ones_like(signals.speed_motor)


class Presliding(Bristle, TrackEffect):
    """ΔM_t = a (z - sign ω_k), θ_s z' = ω_k - |ω_k| z, z(0) = 0: a share a of the dry loss acts through bristles.

    Dry friction builds up over a small angle instead of at once, because contacts yield before they slide.

    Source: Dahl, A solid friction model (1968), with exponent 1. It is the first order of Canudas de Wit, Olsson,
    Åström and Lischinsky (1995) without their damping of the bristles. Settled z = sign ω_k: steady travel does not
    show it, reversals do. The memory is z [-]. At a = M_t0 all of the dry friction is Dahl's. `stick_slip` is the
    additional torque beyond M_t0 before the contacts release. `bristle_load_loss` grows with the load.
    """

    driver = "direction"
    transient = True

    amplitude: Scalar = amplitude(
        "N·m", "dry loss that acts through bristles", (-0.5, 2.0), "a third of M_t0 of Table 3", sd=0.1
    )
    angle_breakaway: Scalar = breakaway_parameter()

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * (self.recall(robot, signals) - signals.direction)


class AngleFriction(Periodic, TrackEffect):
    """ΔM_t = a sin(θ_k + φ) sign ω_k: dry friction that changes over a turn of the driven shaft.

    A bent shaft, a bearing or a guide is tight at one place in each turn.

    Source: Popović and Goldenberg, Modeling of friction using spectral analysis, IEEE Trans. Robotics and Automation
    14 (1998) 114: friction of a joint over its angle, here its first order. If the log measures the angle, φ
    refers to the zero of that angle, otherwise to the start of each run. As friction, it changes sign with the
    speed. An amplitude as large as M_t0 would not be a loss at every angle.
    """

    driver = "angle"

    amplitude: Scalar = amplitude(
        "N·m", "amplitude of the dry loss over a turn", (-0.5, 0.5), "a seventh of M_t0 of Table 3", sd=0.05
    )
    phase: Scalar = phase_parameter()

    def order(self, robot: Robot, configuration: Index) -> Scalar:
        return 1 / robot.gearbox.ratio

    def initial(self, robot: Robot, angle: Scalar) -> Scalar:
        return angle

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * self.wave(signals) * signals.direction


class PositionFriction(TrackEffect):
    """ΔM_t = a θ sign ω_k, θ' = ω_k: dry friction that grows along the travel.

    The guides or the screw are tighter towards one end.

    Source: Armstrong-Hélouvry, Control of Machines with Friction (1991), ch. 4: friction of a joint over its
    position, to first order. The memory is θ [rad], counted as in the channel of the angle or position, which
    the rig must show. Without one the phase is 0 at the start of each run. Its mean over the travel is M_t0.
    """

    driver = "position"
    transient = True
    memory_size = 10.0
    memory_unit = "rad"

    amplitude: Scalar = amplitude(
        "N·m/rad", "dry loss over the angle of the driven shaft", (-0.1, 0.1),
        "over ten radians a third of M_t0 of Table 3", sd=0.01,
    )  # fmt: skip

    def initial(self, robot: Robot, angle: Scalar) -> Scalar:
        return angle

    def settled(self, robot: Robot, signals: Signals) -> Scalar:
        return jnp.zeros_like(signals.speed_motor)

    def rate(self, robot: Robot, signals: Signals) -> Scalar:
        return signals.speed_wheel

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * self.recall(robot, signals) * signals.direction


class DirectionalStribeck(TrackEffect):
    """ΔM_t = a exp(-|ω_k| / ω_s) (sign ω_k)²: an excess at low speed of E + a forward and of E - a backward.

    The friction decreases more with speed in one direction of rotation than in the other.

    Source: Canudas de Wit, Olsson, Åström and Lischinsky, A new model for control of systems with friction, IEEE
    Trans. Automatic Control 40 (1995): the curve g of the steady friction may differ between the directions. Here the
    exponential of Tustin (1947). The mean E of both directions is `stribeck_track`: runs in one direction show their
    sum. Far above ω_s it is absent, far below it is `directional_friction`. The part that grows with the speed is
    `directional_viscous`. Runs in both directions at low speed distinguish the three.
    """

    driver = "direction"
    odd_in_travel = True
    needs_reverse = True

    amplitude: Scalar = amplitude(
        "N·m", "excess at low speed in forward rotation minus the mean of both directions", (-0.5, 0.5),
        "half of a common `stribeck_track`", sd=0.05,
    )  # fmt: skip
    speed_fade: Scalar = _fade_parameter()

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        excess = jnp.exp(-jnp.abs(signals.speed_wheel) / self.speed_fade)
        return self.amplitude * excess * signals.direction**2
