"""Armature reaction weakens the torque constant at high current."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class TorqueConstantSaturation(Effect):
    """ΔM_d = a C_m I³: C_m(I) = C_m (1 - a I²) in the torque of eq. (17).

    Source: demagnetising part of the armature reaction, even in the current (Fitzgerald, Kingsley and Umans,
    Electric Machinery, 2003, ch. 7). It weakens torque and back-EMF alike; it stands in the motor balance
    alone, where its share is the larger: with I R a tenth of U, the back-EMF's part is a second-order one.
    So it is not a loss of power by itself.
    """

    name: ClassVar[str] = "torque_constant_saturation"
    balance: ClassVar[str] = "motor"
    dissipative: ClassVar[bool] = False

    amplitude: Scalar = parameter(
        0.0,
        unit="1/A^2",
        meaning="relative loss of torque constant over squared current",
        bounds=(-0.01, 0.05),
        sd=3e-3,
        source="3 % at 3 A; an ironless rotor saturates little",
        amplitude=True,
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * robot.motor.torque_electromagnetic(signals.current) * signals.current**2
