"""Grids of operating points as tables of runs."""

from __future__ import annotations

import itertools

import numpy as np

from calibration.data.runs import Runs
from sweeps.config import Sweep


def grid(config: Sweep) -> Runs:
    """Every combination of the axes as a table of conditions, slope varying fastest."""
    points = list(itertools.product(config.configurations, config.voltages_V, config.payloads_kg, config.slopes_deg))
    configuration, voltage, payload, slope = (np.array(column) for column in zip(*points, strict=True))
    return Runs(
        source="the grid",
        columns={
            "configuration": configuration,
            "supply_voltage_V": voltage,
            "payload_kg": payload,
            "slope_deg": slope,
            "surface": np.full(len(points), config.surface),
        },
    )
