"""Effects on the supply [V]: losses between the source and the motors, eqs. (8)-(13)."""

from __future__ import annotations

from mmrjax.effects.base import Effect, amplitude
from mmrjax.model.params import Scalar, parameter
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals


class SupplyEffect(Effect):
    """Voltage lost on the way to the motors [V]."""

    balance = "supply"


class SupplySag(SupplyEffect):
    """ΔU = a I_Σ: Ohm's law for conductors that carry the current of all motors.

    Both motors share leads and the internal resistance of the supply.

    Source: Fig. 20 of the paper (supply, leads and ammeter of the bench). Ohm (1827). With equal sides
    (assumption 3) it acts as a `series_resistance` of 2 a: only a run with one motor off
    distinguishes the two.
    """

    driver = "current"
    dissipative = True

    amplitude: Scalar = amplitude(
        "ohm", "resistance between the source and the motors' junction", (-0.2, 2.0),
        "bench leads of 1.5 mm^2, connectors and shunt: 0.05 to 0.3 ohm", sd=0.2,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.total_current


class BatterySag(SupplyEffect):
    """ΔU = a q on the battery, with the current's slow part q: τ q' = I_Σ - q, q(0) = 0.

    The battery's voltage falls over the first half minute of a load.

    Source: Chen and Rincón-Mora, Accurate electrical battery model capable of predicting runtime and I-V
    performance, IEEE Trans. Energy Conversion 21 (2006), the first RC pair. The
    amplitude a is its resistance for the whole battery. The memory is q [A]. Without a memory the settled value is
    used. The pair returns its stored energy, so it is not a pure loss. On an external supply it is absent.
    """

    driver = "current"
    needs_battery = True
    memory_size = 10.0
    memory_unit = "A"

    amplitude: Scalar = amplitude(
        "ohm", "polarisation resistance of the battery", (-0.1, 2.0), "half of the 8 x 0.049 ohm of Table 1", sd=0.2
    )
    time_constant: Scalar = parameter(
        20.0, "s", "time constant of the polarisation τ", (0.5, 1000.0), "lithium cells of a few Ah: 10 to 60 s",
        relative_sd=0.5,
    )  # fmt: skip

    def settled(self, robot: Robot, signals: Signals) -> Scalar:
        return signals.total_current

    def rate(self, robot: Robot, signals: Signals) -> Scalar:
        return (signals.total_current - signals.memory[self.name]) / self.time_constant

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * self.recall(robot, signals) * signals.battery
