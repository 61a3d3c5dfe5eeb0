"""The motor's torque ripples as its commutator turns."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, ClassVar

from jaxtyping import Array, Int

from mmrjax import contact
from mmrjax.conditions import Conditions
from mmrjax.effects.base import Effect
from mmrjax.effects.periodic import Periodic, phase_parameter
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class Cogging(Periodic, Effect):
    """ΔM = a sin(n θ_m + φ) fade(n ω_m), with n ripples a turn; fade falls from 1 at ω_f to 0 at 2 ω_f.

    Source: Kenjo and Nagamori, Permanent-Magnet and Brushless DC Motors (1985): ripple at twice the number
    of segments. The RE30 has an ironless rotor, hence no reluctance torque, and 13 segments. Above ω_f the
    rotor's inertia leaves no more than a / (J_d ω_f) of speed, 0.03 rad/s at the prior's size, so the ripple
    is faded out instead of being integrated at 5 kHz: it acts at a crawl and at the start.
    """

    name: ClassVar[str] = "cogging"
    balance: ClassVar[str] = "motor"

    amplitude: Scalar = parameter(
        0.0,
        unit="N·m",
        meaning="amplitude of the torque ripple",
        bounds=(-5e-3, 5e-3),
        sd=5e-4,
        source="a tenth of the no-load torque of 4.3 mN·m",
        amplitude=True,
    )
    phase: Scalar = phase_parameter()
    ripples: Scalar = parameter(
        26.0,
        unit="-",
        meaning="ripples a turn n",
        bounds=(1.0, 100.0),
        relative_sd=0.01,
        source="twice the 13 segments of the commutator",
    )
    rate_fade: Scalar = parameter(
        1000.0,
        unit="rad/s",
        meaning="ripple rate ω_f from which it is faded out",
        bounds=(10.0, 1e5),
        relative_sd=0.1,
        source="a choice of the model, see above",
    )

    def order(self, robot: Robot, configuration: Int[Array, ""]) -> Scalar:
        return self.ripples

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        share = self.ripples * signals.speed_motor / self.rate_fade
        fade = contact.step(share**2, 1.0, 1.0, 4.0, 0.0)
        return self.amplitude * self.wave(signals) * fade

    def step_longest(self, robot: Robot, conditions: Conditions) -> float:
        """No limit: where the ripple acts, the start's own steps are shorter than its period."""
        return math.inf
