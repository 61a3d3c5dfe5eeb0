"""DC motor, eqs. (14)-(18), and reduction gear with losses at idle and with load, eqs. (19)-(23)."""

from __future__ import annotations

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array

from mmrjax.model.params import Scalar, parameter
from mmrjax.model.signals import safe_quotient

_SHEET = "maker's sheet of RE30 310007 (24 V, 60 W)"

#: Winding temperature at which makers state the resistance [°C].
TEMPERATURE_REFERENCE = 25.0
UNLIMITED = 1e9  # value of a limit that is not stated, in its unit
#: Times between which a motor reaches its limit [s]; the second is many of its time constants.
_SHORT, _LONG = 1e-6, 1e6


class Motor(eqx.Module):
    """U_e = C_E ω + I R + L dI/dt, M_d = C_m I - (M_df0 sign ω + K_fd ω)."""

    resistance: Scalar = parameter(
        0.611, "ohm", "terminal resistance R_rot, eq. (15)", (1e-3, 1e3), _SHEET, relative_sd=0.05
    )
    inductance: Scalar = parameter(
        0.119e-3, "H", "terminal inductance L_d, eq. (15)", (1e-7, 10.0), _SHEET, relative_sd=0.1
    )
    torque_constant: Scalar = parameter(
        25.9e-3, "N·m/A", "torque constant C_m, eq. (17), and speed constant C_E in V·s/rad, eq. (16)", (1e-4, 10.0),
        f"{_SHEET}; 369 rpm/V is the same number", relative_sd=0.02,
    )  # fmt: skip
    friction_coulomb: Scalar = parameter(
        2.7e-3, "N·m", "dry friction torque M_df0, eq. (14)", (0.0, 10.0), "Table 2", relative_sd=0.15
    )
    friction_viscous: Scalar = parameter(
        5.5e-7, "N·m·s", "viscous friction K_fd, eq. (14)", (0.0, 1.0), "Table 2: 5.5e-4 mN·m·s", relative_sd=0.15
    )
    inertia: Scalar = parameter(
        33.5e-7, "kg·m^2", "rotor inertia J_d, eqs. (3), (31)", (0.0, 1.0), f"{_SHEET}: 33.5 g·cm^2", relative_sd=0.05
    )
    resistance_thermal_winding: Scalar = parameter(
        1.7, "K/W", "thermal resistance winding to housing", (0.0, 100.0), _SHEET, relative_sd=0.2
    )
    resistance_thermal_housing: Scalar = parameter(
        6.0, "K/W", "thermal resistance housing to ambient", (0.0, 100.0), _SHEET, relative_sd=0.2
    )
    time_constant_winding: Scalar = parameter(
        16.3, "s", "thermal time constant of the winding at a constant housing temperature", (0.1, 1e4), _SHEET,
        relative_sd=0.2,
    )  # fmt: skip
    time_constant_housing: Scalar = parameter(
        593.0, "s", "thermal time constant of the housing to ambient",
        (1.0, 1e5), _SHEET, relative_sd=0.2,
    )  # fmt: skip
    temperature_ambient: Scalar = parameter(
        25.0, "°C", "ambient temperature", (-50.0, 80.0), "reference temperature of the maker's sheet", sd=5.0
    )
    temperature_limit: float = eqx.field(default=125.0, static=True)  # winding [°C], maker's sheet
    #: α of copper [1/K]: IEC 60028 (1925), at 20 °C; makers take it from 25 °C, where it is 2 % less
    temperature_coefficient: float = eqx.field(default=0.00393, static=True)
    voltage_limit: float | None = eqx.field(default=None, static=True)  # [V], highest for short; not on this sheet
    speed_limit: float = eqx.field(default=12_000 * 0.10471975511965977, static=True)  # 12 000 rpm, data sheet

    def voltage_back(self, speed: Scalar) -> Scalar:
        """Back-EMF E = C_E ω [V], eq. (16)."""
        return self.torque_constant * speed

    def voltage_winding(self, current: Scalar, temperature: Scalar | None = None) -> Scalar:
        """Voltage across the winding's resistance I R [V], eq. (15).

        If its `temperature` [°C] is given, R follows that of copper.
        """
        drop = current * self.resistance
        return drop if temperature is None else drop * self.resistance_ratio(temperature)

    def resistance_ratio(self, temperature: Scalar) -> Scalar:
        """Ratio of the winding's resistance at a `temperature` T [°C] to the stated one, 1 + α (T - 25 °C)."""
        return 1 + self.temperature_coefficient * (temperature - TEMPERATURE_REFERENCE)

    def current_stall(self, voltage: Scalar) -> Scalar:
        """Current of the motor at rest at a `voltage` [A]."""
        return voltage / self.resistance

    def torque_electromagnetic(self, current: Scalar) -> Scalar:
        """M_de = C_m I [N·m], eq. (17)."""
        return self.torque_constant * current

    def torque_loss(self, speed: Scalar, direction: Scalar) -> Scalar:
        """Friction torque M_df [N·m], eq. (14), at shaft `speed` [rad/s] and its `direction` (-1..1)."""
        return self.friction_coulomb * direction + self.friction_viscous * speed

    @property
    def resistance_thermal(self) -> Scalar:
        """Thermal resistance from the winding to ambient [K/W]."""
        return self.resistance_thermal_winding + self.resistance_thermal_housing

    def temperature_cold(self, current: Scalar) -> Scalar:
        """Winding temperature after long running at `current` with a constant resistance [°C]."""
        return self.temperature_ambient + self.resistance_thermal * self.resistance * current**2

    def temperature_settled(self, current: Scalar) -> Scalar:
        """Winding temperature after long running at `current` [°C], with the rise of its resistance.

        T = T_a + R_th R I² (1 + α (T - 25 °C)). It is inf if R_th R I² α >= 1.
        """
        rise = self.resistance_thermal * self.resistance * current**2
        denominator = 1 - self.temperature_coefficient * rise
        finite = denominator > 0
        ratio = self.resistance_ratio(self.temperature_ambient)
        settled = self.temperature_ambient + rise * ratio / jnp.where(finite, denominator, 1.0)
        return jnp.where(finite, settled, jnp.inf)

    @property
    def current_continuous(self) -> Scalar:
        """Current with a final winding temperature at the permissible limit [A], with the rise of its resistance."""
        rise_allowed = jnp.maximum(self.temperature_limit - self.temperature_ambient, 1.0)
        hot_resistance = self.resistance * self.resistance_ratio(self.temperature_limit)
        return jnp.sqrt(rise_allowed / jnp.maximum(self.resistance_thermal * hot_resistance, 1e-9))

    def heating(self, power: Scalar, winding: Scalar, housing: Scalar) -> tuple[Scalar, Scalar]:
        """Rates of the temperatures of winding and housing [K/s], two thermal masses in series.

        C_w T_w' = P - (T_w - T_h) / R_wh, C_h T_h' = (T_w - T_h) / R_wh - (T_h - T_a) / R_ha. Makers state the time
        constants τ_w and τ_h: C_w = τ_w / R_wh and C_h = τ_h / R_ha (maxon, Key information on motor data).

        Args:
            power: lost in the winding [W].
            winding, housing: temperatures [°C].
        """
        heat_to_housing = (winding - housing) / self.resistance_thermal_winding
        heat_to_ambient = (housing - self.temperature_ambient) / self.resistance_thermal_housing
        return (
            (power - heat_to_housing) * self.resistance_thermal_winding / self.time_constant_winding,
            (heat_to_housing - heat_to_ambient) * self.resistance_thermal_housing / self.time_constant_housing,
        )

    def temperatures_after(
        self, current: Scalar, time: Scalar, winding: Scalar, housing: Scalar
    ) -> tuple[Scalar, Scalar]:
        """Temperatures of winding and housing [°C] after `time` [s] at `current` [A], in closed form.

        `heating` with P = I² R (1 + α (T_w - 25 °C)) is linear in both temperatures: a matrix exponential solves it.
        """
        zero = jnp.zeros(())

        def rates(x: Array) -> Array:
            power = self.voltage_winding(current, x[0]) * current
            return jnp.stack([jnp.asarray(rate, float) for rate in self.heating(power, x[0], x[1])])

        rates_at_zero = rates(jnp.zeros(2))
        matrix = jax.jacfwd(rates)(jnp.zeros(2))
        augmented_matrix = jnp.block([[matrix, rates_at_zero[:, None]], [jnp.zeros((1, 3))]])
        begin = jnp.stack([jnp.asarray(x, float) + zero for x in (winding, housing, 1.0)])
        end = jax.scipy.linalg.expm(augmented_matrix * time) @ begin
        return end[0], end[1]

    def time_permissible(self, current: Scalar) -> Scalar:
        """Time for which a `current` [A] may flow from ambient temperature before the winding reaches its limit [s].

        inf: no end, 0: above it.
        """
        ambient, limit = self.temperature_ambient, self.temperature_limit

        def excess(time: Scalar, motor_and_current: tuple[Motor, Scalar]) -> Array:
            motor, current = motor_and_current
            begin = motor.temperature_ambient, motor.temperature_ambient
            temperature_excess = motor.temperatures_after(current, time, *begin)[0] - motor.temperature_limit
            return jnp.where(jnp.isfinite(temperature_excess), temperature_excess, jnp.inf)

        bounds = {"lower": math.log(_SHORT), "upper": math.log(_LONG)}
        inputs = jax.lax.stop_gradient((self, current))
        solution: optx.Solution = optx.root_find(
            lambda log_time, motor_and_current: excess(jnp.exp(log_time), motor_and_current),
            optx.Bisection(rtol=0.0, atol=0.0, flip=False),  # type: ignore[call-arg]  # its norm is no field
            jnp.asarray(sum(bounds.values()) / 2),
            inputs,
            options=bounds,
            max_steps=60,
            throw=False,
        )
        seconds = jax.lax.stop_gradient(jnp.exp(solution.value))
        # The Newton step from here changes no value; it carries the derivative.
        winding, housing = self.temperatures_after(current, seconds, ambient, ambient)
        heating_rate = self.heating(self.voltage_winding(current, winding) * current, winding, housing)[0]
        heats = jnp.isfinite(winding) & (heating_rate > 0)
        seconds = seconds - jnp.where(heats, (winding - limit) / jnp.where(heats, heating_rate, 1.0), 0.0)
        reaches_limit = (self.temperature_settled(current) > limit) & (excess(jnp.asarray(_LONG), inputs) > 0)
        return jnp.where(jnp.asarray(ambient) >= limit, 0.0, jnp.where(reaches_limit, seconds, jnp.inf))


#: Torque below which the gearbox counts as unloaded, so that rounding does not decide the direction of power [N·m].
NO_TORQUE = 1e-12


class Gearbox(eqx.Module):
    """M_r = i η_rm (M_d - M_rf_idle) with M_rf_idle = M_rf0 sign ω + K_fr ω.

    Driven from the output (overhauling), the load loss changes direction: M_r = (i / η_b) (M_d - M_rf_idle) with the
    efficiency η_b of `efficiency_backward`. The paper leaves it out because its robot never coasts. Without it, a
    robot would gain energy on a descent.

    Attributes:
        mesh_theory: True: η_b = 2 - 1/η_rm, the theory of the mesh. False: η_b = η_rm.
        speed_limit: speed limit at the input [rad/s].
        torque_limit: continuous, at the driving wheel, where the total ratio ends [N·m], None if not stated.
    """

    ratio: Scalar = parameter(
        48.0, "-", "total ratio motor to driving wheel i_r", (1.0, 1e4),
        "GP32C 576/25 and a belt stage 25/12; Tables A1, A2 simulated give 47.97-48.04", relative_sd=0.002,
    )  # fmt: skip
    efficiency_load: Scalar = parameter(
        0.74, "-", "efficiency for losses proportional to load η_rm, eq. (19)", (0.05, 1.0),
        "Table 2 (catalogue 0.75)", relative_sd=0.03,
    )  # fmt: skip
    friction_coulomb: Scalar = parameter(
        0.3e-3, "N·m", "idle Coulomb torque at the input M_rf0, eq. (20)", (0.0, 10.0), "Table 2", relative_sd=0.15
    )
    friction_viscous: Scalar = parameter(
        1.4e-6, "N·m·s", "idle viscous friction at the input K_fr, eq. (20)", (0.0, 1.0), "Table 2: 1.4e-3 mN·m·s",
        relative_sd=0.15,
    )  # fmt: skip
    speed_limit: float = eqx.field(default=8_000 * 0.10471975511965977, static=True)  # 8000 rpm input, catalogue
    # GP32C 166936, maker's sheet: at its output 3 N·m continuous, 3.75 short-term; times the belt stage 25/12 [N·m]
    torque_limit: float | None = eqx.field(default=3.0 * 25 / 12, static=True)
    mesh_theory: bool = eqx.field(default=False, static=True)

    @property
    def efficiency_backward(self) -> Scalar:
        """Efficiency η_b with the load driving the motor [-]: η_rm, or 2 - 1/η_rm by the theory of the mesh.

        Bounded below by 0.02. A loss in proportion to the mesh force is (1/η - 1) of the power that leaves the mesh,
        in both directions. A gear with η <= 1/2 is self-locking.
        """
        if not self.mesh_theory:
            return self.efficiency_load
        return jnp.maximum(2 - 1 / self.efficiency_load, 0.02)

    def torque_idle(self, speed: Scalar, direction: Scalar) -> Scalar:
        """Idle loss torque at the input M_rf_idle [N·m], eq. (20), at input `speed` [rad/s]."""
        return self.friction_coulomb * direction + self.friction_viscous * speed

    def efficiency_flow(self, transmitted: Scalar, direction: Scalar) -> Scalar:
        """η_rm if power flows to the wheels, 1/η_b if it flows back, fading to 1 at rest with `direction` [-].

        `transmitted` is the input torque less the idle torque [N·m]. If it is 0, the efficiency is that of a small
        load: power flows to the wheels.
        """
        torque_sign = jnp.where(jnp.abs(transmitted) > NO_TORQUE, jnp.sign(transmitted), jnp.sign(direction))
        flow = torque_sign * direction
        return 1 + flow * jnp.where(flow >= 0, self.efficiency_load - 1, 1 - 1 / self.efficiency_backward)

    def torque_output(self, transmitted: Scalar, direction: Scalar) -> Scalar:
        """Output torque M_r [N·m], eqs. (22), (23)."""
        return self.ratio * transmitted * self.efficiency_flow(transmitted, direction)

    def efficiency(self, torque_input: Scalar, speed: Scalar) -> Scalar:
        """Efficiency η_r [-], eq. (19), driving forward at input torque [N·m] and `speed` [rad/s]."""
        return (1 - safe_quotient(self.torque_idle(speed, 1.0), torque_input)) * self.efficiency_load

    def torque_loss(self, torque_input: Scalar, speed: Scalar) -> Scalar:
        """Total loss at the output M_rf [N·m], eq. (22), driving forward."""
        load_loss = torque_input * self.ratio * (1 - self.efficiency_load)
        return load_loss + self.torque_idle(speed, 1.0) * self.ratio * self.efficiency_load


def slow_output_torque(motor: Motor, gearbox: Gearbox, current: float) -> float:
    """Output torque of a drive that turns slowly at a motor current, after losses [N·m], eqs. (16), (22)."""
    friction = float(motor.friction_coulomb) + float(gearbox.friction_coulomb)
    return (float(motor.torque_constant) * current - friction) * float(gearbox.ratio) * float(gearbox.efficiency_load)


def slow_motor_current(motor: Motor, gearbox: Gearbox, torque: float) -> float:
    """Motor current for an output torque of a drive that turns slowly [A], the inverse of `slow_output_torque`."""
    friction = float(motor.friction_coulomb) + float(gearbox.friction_coulomb)
    transmitted = torque / (float(gearbox.ratio) * float(gearbox.efficiency_load))
    return (transmitted + friction) / float(motor.torque_constant)
