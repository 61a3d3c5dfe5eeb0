"""DC motor: back-EMF, winding, torque and its speed-dependent friction, eqs. (14)-(18)."""

from __future__ import annotations

import equinox as eqx

from mmrjax.params import Scalar, parameter

_SHEET = "maker's sheet of RE30 310007 (24 V, 60 W)"


class Motor(eqx.Module):
    """U_e = C_E ω + I R + L dI/dt; M_d = C_m I - (M_df0 sign ω + K_fd ω)."""

    resistance: Scalar = parameter(
        0.611,
        unit="ohm",
        meaning="terminal resistance R_rot, eq. (15)",
        bounds=(0.01, 20.0),
        relative_sd=0.05,
        source=_SHEET,
    )
    inductance: Scalar = parameter(
        0.119e-3,
        unit="H",
        meaning="terminal inductance L_d, eq. (15)",
        bounds=(1e-6, 0.1),
        relative_sd=0.1,
        source=_SHEET,
    )
    torque_constant: Scalar = parameter(
        25.9e-3,
        unit="N·m/A",
        meaning="torque constant C_m, eq. (17), and speed constant C_E in V·s/rad, eq. (16)",
        bounds=(1e-3, 1.0),
        relative_sd=0.02,
        source=f"{_SHEET}; 369 rpm/V is the same number",
    )
    friction_coulomb: Scalar = parameter(
        2.7e-3,
        unit="N·m",
        meaning="dry friction torque M_df0, eq. (14)",
        bounds=(0.0, 0.1),
        relative_sd=0.15,
        source="Table 2",
    )
    friction_viscous: Scalar = parameter(
        5.5e-7,
        unit="N·m·s",
        meaning="viscous friction K_fd, eq. (14)",
        bounds=(0.0, 1e-3),
        relative_sd=0.15,
        source="Table 2: 5.5e-4 mN·m·s",
    )
    inertia: Scalar = parameter(
        33.5e-7,
        unit="kg·m^2",
        meaning="rotor inertia J_d, eqs. (3), (31)",
        bounds=(0.0, 1e-3),
        relative_sd=0.05,
        source=f"{_SHEET}: 33.5 g·cm^2",
    )
    resistance_thermal: Scalar = parameter(
        6.0 + 1.7,
        unit="K/W",
        meaning="thermal resistance winding to ambient",
        bounds=(0.0, 100.0),
        relative_sd=0.2,
        source=f"{_SHEET}: 1.7 to the housing, 6.0 to ambient",
    )
    temperature_ambient: Scalar = parameter(
        25.0,
        unit="°C",
        meaning="ambient temperature",
        bounds=(-50.0, 80.0),
        sd=5.0,
        source="reference temperature of the maker's sheet",
    )
    temperature_limit: float = eqx.field(default=125.0, static=True)  # winding [°C], maker's sheet
    voltage_limit: float | None = eqx.field(default=None, static=True)  # [V], highest for short; not on this sheet
    speed_limit: float = eqx.field(default=12_000 * 0.10471975511965977, static=True)  # 12 000 rpm, sheet

    def voltage_back(self, speed: Scalar) -> Scalar:
        """Back-EMF E = C_E ω [V], eq. (16)."""
        return self.torque_constant * speed

    def voltage_winding(self, current: Scalar) -> Scalar:
        """Voltage across the winding's resistance I R [V], eq. (15)."""
        return current * self.resistance

    def torque_electromagnetic(self, current: Scalar) -> Scalar:
        """M_de = C_m I [N·m], eq. (17)."""
        return self.torque_constant * current

    def torque_loss(self, speed: Scalar, direction: Scalar) -> Scalar:
        """Friction torque M_df [N·m], eq. (14), at shaft `speed` [rad/s] and its `direction` (-1..1)."""
        return self.friction_coulomb * direction + self.friction_viscous * speed

    def temperature_winding(self, current: Scalar) -> Scalar:
        """Winding temperature after long running at `current` [°C], resistance taken cold."""
        return self.temperature_ambient + self.resistance_thermal * self.resistance * current**2
