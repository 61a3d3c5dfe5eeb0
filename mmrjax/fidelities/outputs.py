"""The table of outputs: the results of a simulated run, one row each. Importable without jax.

They are the columns of `runs.csv`, of `Results.to_dict` and of printed tables.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from mmrjax.model.channels import HEAT, VOLTAGE, Channel
from mmrjax.model.quantities import MM

if TYPE_CHECKING:
    from mmrjax.model.signals import Result


@dataclasses.dataclass(frozen=True)
class Output:
    """One number of a result.

    Attributes:
        name: noun; field of the result, or channel.
        column: in tables of runs, with the unit in the name.
        unit: of the column; factor: the SI value of one such unit.
        label: words in tables and reports.
        get: returns the number [SI] from a result.
        resolution: digits after the point in reports [unit].
        rests_on: dotted names of the parameters that it depends on; it is NaN if one of them is unknown.
    """

    name: str
    column: str
    unit: str
    factor: float
    label: str
    get: Callable[[Result], Any]
    resolution: int = 3
    rests_on: tuple[str, ...] = ()


#: Outputs in addition to the channels, which come first.
FURTHER: tuple[Output, ...] = (
    Output(
        "theoretical_speed", "theoretical_speed_mm_s", "mm/s", MM, "theoretical speed",
        lambda r: r.theoretical_speed, 1,
    ),
    Output("slip", "slip", "-", 1.0, "slip", lambda r: r.slip, 4),
    Output("voltage", "voltage_V", "V", 1.0, "voltage at the motors", lambda r: r.voltage, 2, VOLTAGE),
    Output("adhesion_used", "adhesion_used", "-", 1.0, "adhesion used", lambda r: r.adhesion_used),
    Output("traction", "traction_N", "N", 1.0, "traction", lambda r: r.traction, 1),
    Output("power_supply", "power_supply_W", "W", 1.0, "supply power", lambda r: r.power_supply, 1, VOLTAGE),
    Output("power_motor", "power_motor_W", "W", 1.0, "motor power", lambda r: r.power_motor, 1),
    Output("power_gear", "power_gear_W", "W", 1.0, "gearbox power", lambda r: r.power_gear, 1),
    Output("power_ground", "power_ground_W", "W", 1.0, "ground power", lambda r: r.power_ground, 1),
    Output("power_lift", "power_lift_W", "W", 1.0, "lifting power", lambda r: r.power_lift, 1),
    Output(
        "efficiency_motor", "efficiency_motor", "-", 1.0, "motor efficiency", lambda r: r.efficiency_motor, 3, VOLTAGE
    ),
    Output("efficiency_gear", "efficiency_gear", "-", 1.0, "gearbox efficiency", lambda r: r.efficiency_gear),
    Output(
        "efficiency_chassis", "efficiency_chassis", "-", 1.0, "chassis efficiency",
        lambda r: r.efficiency_chassis,
    ),
    Output(
        "winding_settled", "winding_settled_C", "°C", 1.0, "winding, long running",
        lambda r: r.winding_settled, 1, HEAT,
    ),
    Output("voltage_cell", "voltage_cell_V", "V", 1.0, "cell voltage", lambda r: r.voltage_cell, 3),
)  # fmt: skip


def _reading(channel: str) -> Callable[[Result], Any]:
    return lambda result: result.reading[channel]


def output_table(shown: Iterable[Channel]) -> tuple[Output, ...]:
    """Every output in the order of columns, the channels `shown` first."""
    read = tuple(
        Output(c.name, c.column, c.unit_shown, c.factor, c.label, _reading(c.name), c.resolution, c.rests_on)
        for c in shown
    )
    return read + FURTHER


def output_names(shown: Iterable[Channel]) -> tuple[str, ...]:
    """Names of all outputs, the channels `shown` first."""
    return tuple(output.name for output in output_table(shown))


def output_columns(
    result: Result, shown: Iterable[Channel], further: Mapping[str, Any] | None = None
) -> dict[str, np.ndarray]:
    """Results in the units and words of `runs.csv`.

    Args:
        shown: channels, of the robot.
        further: columns that a fidelity adds, in their units (`fidelities.base.Run.columns`).
    """
    found = {output.column: np.asarray(output.get(result)) / output.factor for output in output_table(shown)}
    return {
        **found,
        **status_words(result.status, result.flags),
        **{name: np.asarray(values) for name, values in (further or {}).items()},
    }


def status_words(status: Any, flags: Any) -> dict[str, np.ndarray]:
    """Statuses and flags as words of `runs.csv`, in the shape of the codes; flags separated by semicolons."""
    from mmrjax.model.signals import FLAGS, STATUSES

    bits = np.asarray(flags)
    names = [";".join(flag for k, flag in enumerate(FLAGS) if b >> k & 1) for b in bits.ravel()]
    return {
        "status": np.array(STATUSES)[np.asarray(status)],
        "flags": np.array(names, dtype=str).reshape(bits.shape),
    }
