"""Effects on the supply [V], eqs. (8)-(13), and the electrical circuit [V] and inductance [H] of motors, eq. (15)."""

from __future__ import annotations

import jax.numpy as jnp

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


class ElectricalEffect(Effect):
    """Voltage drop of one motor's circuit [V]."""

    balance = "electrical"


class SeriesResistance(ElectricalEffect):
    """ΔU = a I_d: Ohm's law for a resistance in series with one motor, not included in the motor's data sheet.

    Leads, an ammeter or brush contacts are in series with each motor.

    Source: Fig. 20 of the paper (leads and ammeter of the bench). Ohm (1827).
    """

    driver = "current"
    dissipative = True

    amplitude: Scalar = amplitude(
        "ohm",
        "resistance in series with each motor",
        (-0.5, 5.0),
        "leads and meters of a bench: tenths of an ohm",
        sd=0.5,
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.current


class BrushDrop(ElectricalEffect):
    """ΔU = a I / √(I² + I_b²): a constant drop against the current, smooth through zero.

    Contact voltage of the brushes, nearly equal at all currents.

    Source: IEEE Std 113-1985 takes a constant 2 V for carbon and graphite brushes of large machines. Small
    graphite brushes on copper drop tenths of a volt. Below the smoothing current I_b the contact is ohmic.
    """

    driver = "current"
    dissipative = True

    amplitude: Scalar = amplitude(
        "V", "voltage drop of a pair of brushes", (-0.5, 3.0), "0.2 V (copper-graphite) to 1 V (graphite) per pair",
        sd=0.5,
    )  # fmt: skip
    current_ohmic: Scalar = parameter(
        0.1, "A", "current I_b below which the contact is ohmic", (5e-3, 1.0), "below the no-load current of 165 mA",
        relative_sd=0.5,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.current / jnp.sqrt(signals.current**2 + self.current_ohmic**2)


class WindingHeating(ElectricalEffect):
    """ΔU = a α R I · R_th R I²: copper's resistance at a share `a` of the settled temperature rise.

    The winding's resistance rises as the current heats it.

    Source: IEC 60028 for α. The maker's sheet for R_th = 7.7 K/W. A run shorter than the thermal time
    constants (16 s winding, 593 s housing) reaches only a share of the settled rise: 1 is settled, 0 cold.
    The rise is computed at the cold resistance (first order in α) and limited to the winding's 125 °C. Otherwise the
    millisecond inrush of a start would count as a settled current of 50 A. If the winding's temperature is followed
    (missions), its resistance follows that, and the effect adds 0.
    """

    driver = "current"
    rests_on = ("motor.resistance_thermal_housing", "motor.resistance_thermal_winding")
    dissipative = True

    amplitude: Scalar = amplitude(
        "-", "share of the settled temperature rise that the run reaches", (-0.5, 3.0),
        "0 cold, 1 settled, above 1 for a closed housing", sd=1.0,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        motor = robot.motor
        if signals.temperature is not None:
            return jnp.zeros_like(signals.current)
        rise = jnp.minimum(motor.temperature_cold(signals.current), motor.temperature_limit)
        rise = rise - motor.temperature_ambient
        return self.amplitude * motor.temperature_coefficient * rise * motor.voltage_winding(signals.current)


class ThermalDrift(ElectricalEffect):
    """ΔU = a α R I T, with the rise T of the winding over its housing: τ T' = R_wh R I² - T, T(0) = 0.

    The winding warms up while the run lasts.

    Source: IEC 60028 for α. The maker's sheet of RE30 310007 for τ and R_wh. The housing's
    time constant is 593 s, so its temperature is taken as constant during a run.
    In steady travel this effect looks like `winding_heating`.
    The memory is T [K]. Without a memory the settled value is used. If the winding's temperature is followed
    (missions), its resistance follows that, and the effect adds 0.
    """

    driver = "current"
    dissipative = True
    settles_to = "winding_heating"
    memory_size = 10.0
    memory_unit = "K"

    amplitude: Scalar = amplitude(
        "-", "share of the data sheet's temperature rise", (-1.0, 10.0),
        "1 in the data sheet, more in still air between printed walls", sd=1.0,
    )  # fmt: skip
    time_constant: Scalar = parameter(
        16.3, "s", "thermal time constant of the winding τ", (1.0, 600.0), "maker's sheet of RE30 310007",
        relative_sd=0.3,
    )  # fmt: skip
    resistance_thermal: Scalar = parameter(
        1.7, "K/W", "thermal resistance winding to housing R_wh", (0.1, 20.0), "maker's sheet of RE30 310007",
        relative_sd=0.2,
    )  # fmt: skip

    def settled(self, robot: Robot, signals: Signals) -> Scalar:
        return self.resistance_thermal * robot.motor.voltage_winding(signals.current) * signals.current

    def rate(self, robot: Robot, signals: Signals) -> Scalar:
        return (self.settled(robot, signals) - signals.memory[self.name]) / self.time_constant

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        if signals.temperature is not None:
            return jnp.zeros_like(signals.current)
        drop = robot.motor.voltage_winding(signals.current)
        return self.amplitude * robot.motor.temperature_coefficient * self.recall(robot, signals) * drop


class CoastDecay(ElectricalEffect):
    """ΔU = -a (1 - |D|) E: during a share a of the pauses between the pulses of a duty D the motors coast.

    The driver uses fast decay, and its current ends within each period. The mean torque is proportional to the duty,
    and the no-load speed does not depend on it.

    Source: Mohan, Undeland and Robbins, Power Electronics (2003), chapter 7: discontinuous conduction, with pulses
    and pauses long compared with L/R. `driver.Driver` with `decay = "fast"` is a = 1, and also gives the supply
    current and the heat of the pulses. The effect is 0 at full duty and if the motors are open or shorted.
    """

    driver = "duty"
    needs_duty = True

    amplitude: Scalar = amplitude(
        "-", "share of the pauses between pulses in which the motors coast", (-0.5, 1.5),
        "0 slow decay, 1 fast decay with the current ending at once", sd=0.5,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return -self.amplitude * signals.pause * robot.motor.voltage_back(signals.speed_motor)


class ArmatureInductance(Effect):
    """ΔL = a in eq. (15), for one motor.

    The inductance of leads and supply is in series with the armature.

    Source: eq. (15). Leads have about 1 µH/m, a supply's output choke tens to hundreds of µH. Visible only
    while the current changes within a millisecond.
    """

    balance = "inductance"
    transient = True

    amplitude: Scalar = amplitude(
        "H", "inductance in series with each motor beyond L_d", (-1e-4, 5e-3), "output filter of a bench supply",
        sd=1e-4,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * jnp.ones_like(signals.speed_motor)
