"""Supply and on-board battery: the voltage that reaches the motors, eqs. (8)-(13)."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from mmrjax.model.paper_tables import COULOMB_PER_MAH
from mmrjax.model.params import Scalar, parameter

#: Capacity of the paper's cell [C]; Table 1 describes its discharge.
CAPACITY = 2200 * COULOMB_PER_MAH


class Battery(eqx.Module):
    """Cells in series, each with a parabola over the discharged share of its capacity. Tables 1 and A4.

    U_b = n (A q² + B q + U'_b0 - I_b R_b), eqs. (9), (12), (13), with I_b = I_s + I_p, eq. (10), and
    q = C_b C_n / C. A and B belong to a cell of capacity C_n. The paper's cell has C = C_n, so q = C_b. A cell of
    another capacity has the same voltage at the same share.
    """

    curvature: Scalar = parameter(
        7e-8 / COULOMB_PER_MAH**2, "V/C^2", "A of the cell's no-load voltage, eq. (13)", (0.0, 1e-6),
        "Table 1: 7e-8 V/mAh^2", relative_sd=0.1,
    )  # fmt: skip
    slope: Scalar = parameter(
        -5e-4 / COULOMB_PER_MAH, "V/C", "B of the cell's no-load voltage, eq. (13)", (-1e-2, 0.0),
        "Table 1: -5e-4 V/mAh", relative_sd=0.1,
    )  # fmt: skip
    voltage_full: Scalar = parameter(
        4.17, "V", "no-load voltage of a full cell, eq. (13)", (0.5, 10.0), "Table 1", relative_sd=0.01
    )
    resistance: Scalar = parameter(
        0.049, "ohm", "self-resistance of a cell, eq. (12)", (0.0, 5.0),
        "Table 1 (8 cells: 0.392, Table A4 rounds to 0.4)", relative_sd=0.2,
    )  # fmt: skip
    current_other: Scalar = parameter(
        1.5, "A", "current of all other consumers I_p, eq. (10)", (0.0, 50.0), "Table A4", relative_sd=0.2
    )
    capacity: Scalar = parameter(
        CAPACITY, "C", "charge taken from a full battery until it is empty", (1.0, 1e6),
        "type designation XP2200SL: 2200 mAh", relative_sd=0.05,
    )  # fmt: skip
    capacity_curve: float = eqx.field(default=CAPACITY, static=True)  # C_n, of the cell that A and B belong to [C]
    cells: int = eqx.field(default=8, static=True)
    voltage_charge: float = eqx.field(default=4.2, static=True)  # highest of a cell [V], Section 3.3: fully charged
    voltage_cutoff: float = eqx.field(
        default=3.0, static=True
    )  # lowest of a cell [V], usual for Li-Po; not in the paper
    delay_cutoff: float = eqx.field(default=1.0, static=True)  # permitted time below it [s]; a start draws more
    current_limit: float | None = eqx.field(default=None, static=True)  # of a cell, discharging [A]
    current_charge: float | None = eqx.field(default=None, static=True)  # of a cell, charging [A]

    def voltage_no_load(self, discharge: Scalar) -> Scalar:
        """No-load voltage of one cell [V] after `discharge` [C], eq. (13)."""
        curve_charge = self._charge_on_curve(discharge)
        return self.curvature * curve_charge**2 + self.slope * curve_charge + self.voltage_full

    def _charge_on_curve(self, discharge: Scalar) -> Scalar:
        """Charge q [C] that discharges a cell of capacity C_n by the same share."""
        return discharge * (self.capacity_curve / self.capacity)

    def rises(self, discharge: Scalar) -> Bool[Array, "..."]:
        """True if the no-load voltage rises with further discharge, beyond the minimum of eq. (13)."""
        return jnp.asarray(2 * self.curvature * self._charge_on_curve(discharge) + self.slope > 0)

    def energy(self, discharge: Scalar) -> Scalar:
        """Energy given by the whole battery at no-load voltage [J] after `discharge` [C]: integral of eq. (13)."""
        curve_charge = self._charge_on_curve(discharge)
        mean_voltage = (self.curvature / 3 * curve_charge + self.slope / 2) * curve_charge + self.voltage_full
        return self.cells * mean_voltage * discharge

    def current(self, total_current: Scalar) -> Scalar:
        """Load current of the battery I_b = I_s + I_p [A], eq. (10), also dC_b/dt, eq. (11)."""
        return total_current + self.current_other

    def voltage_cell(self, total_current: Scalar, discharge: Scalar) -> Scalar:
        """Voltage of one cell under load [V], eq. (12), for the motors' `total_current` [A]."""
        return self.voltage_no_load(discharge) - self.current(total_current) * self.resistance

    def voltage(self, total_current: Scalar, discharge: Scalar) -> Scalar:
        """Voltage of the whole battery U_b [V], eqs. (9), (12), for the motors' `total_current` [A]."""
        return self.cells * self.voltage_cell(total_current, discharge)

    @property
    def voltage_empty(self) -> Scalar:
        """No-load voltage of an empty cell [V]."""
        return self.voltage_no_load(self.capacity)

    def empty(self, discharge: Scalar) -> Bool[Array, "..."]:
        """True if the charge taken [C] has reached the capacity."""
        return jnp.asarray(discharge >= self.capacity)

    def emptied(self, on_board: Scalar, discharge: Scalar) -> Bool[Array, "..."]:
        """True if it feeds the motors and is empty."""
        return (on_board > 0.5) & self.empty(discharge)


def cutoff_error(battery: Battery) -> str | None:
    """Reason why no mission can start on a battery, without naming its place. None: one can. Not traceable."""
    full = float(battery.voltage_full)
    if battery.voltage_cutoff < full:
        return None
    return (
        f"got {battery.voltage_cutoff:g} V; expected less than voltage_full, {full:g} V: a full cell would be cut off"
    )


def cutoff_remark(battery: Battery) -> str | None:
    """Remark on a cut-off voltage below that of an empty cell, None for the assumed cut-off. Not traceable."""
    cutoff, empty, resistance = battery.voltage_cutoff, float(battery.voltage_empty), float(battery.resistance)
    if cutoff >= empty or cutoff == Battery.voltage_cutoff:
        return None
    consequence = f"it acts only beyond {(empty - cutoff) / resistance:.3g} A" if resistance > 0 else "it never acts"
    return f"{cutoff:g} V is below the {empty:.3g} V of an empty cell without load: {consequence}"


def curve_remark(battery: Battery) -> str | None:
    """Remark on a parabola (13) that rises before the battery is empty. None: it falls. Not traceable."""
    if not bool(battery.rises(battery.capacity)):
        return None
    share = -float(battery.slope) / (2 * float(battery.curvature)) / battery.capacity_curve
    return (
        f"with this curvature and slope a cell's voltage rises after {100 * share:.3g} % of its capacity is "
        f"taken (capacity_curve: {battery.capacity_curve:g} C)"
    )


def voltage_source(
    battery: Battery, external: Scalar, on_battery: Scalar, total_current: Scalar, discharge: Scalar
) -> Scalar:
    """Voltage of the selected source U_e [V], eq. (8): the battery where `on_battery`, else `external`."""
    return jnp.where(on_battery > 0.5, battery.voltage(total_current, discharge), external)
