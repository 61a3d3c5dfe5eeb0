"""What a simulated run adds to a table of runs: the columns of `runs.csv` out of a `Result`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from mmrjax import channels
from mmrjax.channels import MM
from mmrjax.signals import FLAGS, STATUSES, Result

#: Number columns beside the channels': name → (number out of a result, unit as a factor).
OUTPUTS: dict[str, tuple[Callable[[Result], Any], float]] = {
    "theoretical_speed_mm_s": (lambda r: r.theoretical_speed, MM),
    "slip": (lambda r: r.slip, 1.0),
    "voltage_V": (lambda r: r.voltage, 1.0),
    "adhesion_used": (lambda r: r.adhesion_used, 1.0),
    "traction_N": (lambda r: r.traction, 1.0),
    "power_supply_W": (lambda r: r.power_supply, 1.0),
    "power_motor_W": (lambda r: r.power_motor, 1.0),
    "power_gear_W": (lambda r: r.power_gear, 1.0),
    "power_ground_W": (lambda r: r.power_ground, 1.0),
    "power_lift_W": (lambda r: r.power_lift, 1.0),
    "efficiency_motor": (lambda r: r.efficiency_motor, 1.0),
    "efficiency_gear": (lambda r: r.efficiency_gear, 1.0),
    "efficiency_chassis": (lambda r: r.efficiency_chassis, 1.0),
    "temperature_winding_C": (lambda r: r.temperature_winding, 1.0),
}


def columns(result: Result) -> dict[str, np.ndarray]:
    """A batch of results, shape (rows,), in the units and words of `runs.csv`."""
    columns = readings(result.reading)
    columns |= {name: np.asarray(pick(result)) / unit for name, (pick, unit) in OUTPUTS.items()}
    columns["status"] = np.array(STATUSES)[np.asarray(result.status)]
    bits = np.asarray(result.flags)
    columns["flags"] = np.array([";".join(f for k, f in enumerate(FLAGS) if b >> k & 1) for b in bits], dtype=str)
    return columns


def readings(reading: dict[str, Any]) -> dict[str, np.ndarray]:
    """What the instruments show, by column, in the columns' units."""
    return {c.column: np.asarray(reading[c.name]) / c.factor for c in channels.CHANNELS}
