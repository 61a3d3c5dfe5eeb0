"""Registry of derived outputs: results that need more than one operating point. Importable without jax.

A new output is a module with `compute(robot, conditions)` and a line of `TABLE`. `compute` is a pure function of one
run that returns its numbers [SI] by name and a `status`.
"""

from __future__ import annotations

import dataclasses
import importlib
import math
from collections.abc import Callable
from typing import Any

from mmrjax.model.channels import CURRENT, VOLTAGE


@dataclasses.dataclass(frozen=True)
class Derived:
    """One derived output.

    Attributes:
        name: noun; column: in tables, with the unit in the name.
        unit: of the column; factor: the SI value of one such unit.
        label: words in tables and reports.
        module: module that computes it, possibly together with others.
        resolution: digits after the point in reports [unit].
        ignores: conditions that it does not depend on, because it solves for them.
        rests_on: dotted names of the parameters that it depends on; it is unknown if one of them is.
    """

    name: str
    column: str
    unit: str
    factor: float
    label: str
    module: str
    resolution: int = 3
    ignores: tuple[str, ...] = ()
    rests_on: tuple[str, ...] = ()


_SLOPE, START = "mmrjax.derived.steepest_slope", "mmrjax.derived.start_figures"
_POSTURE, _TURN = "mmrjax.derived.pitch_and_step", "mmrjax.derived.turning_figures"

#: Read through the module, so that a new line adds an output everywhere.
TABLE: tuple[Derived, ...] = (
    Derived(
        "steepest_slope", "steepest_slope_deg", "deg", 1.0, "steepest slope held", _SLOPE, 2, ignores=("slope_deg",)
    ),
    Derived(
        "peak_current",
        "peak_current_A",
        "A",
        1.0,
        "peak current of the start, all motors",
        START,
        2,
        rests_on=CURRENT,
    ),
    Derived("time_to_speed", "time_to_speed_s", "s", 1.0, "time to 95 % of speed", START, 3),
    Derived("energy_start", "energy_start_J", "J", 1.0, "electrical energy of the start", START, 2, rests_on=VOLTAGE),
    Derived("pitch", "pitch_deg", "deg", math.pi / 180, "pitch at rest, nose up", _POSTURE, 2),
    Derived("highest_step", "highest_step_mm", "mm", 1e-3, "highest step of the posture", _POSTURE, 1),
    Derived("best_step", "best_step_mm", "mm", 1e-3, "highest step in any posture", _POSTURE, 1),
    Derived("turning_radius", "turning_radius_mm", "mm", 1e-3, "turning radius", _TURN, 1),
)
#: Outputs of a posture at rest, and of a robot on a ground.
OF_POSTURE = tuple(d for d in TABLE if d.module == _POSTURE)
OF_GROUND = (*OF_POSTURE, *(d for d in TABLE if d.module in (_SLOPE, _TURN)))
#: Outputs of a start from standstill.
OF_START = tuple(d for d in TABLE if d.module == START)
#: Outputs of robots that turn only, and of straight travel only.
OF_TURNS = tuple(d for d in TABLE if d.module == _TURN)
OF_STRAIGHT = tuple(d for d in TABLE if d.module in (_SLOPE, START))


def compute_function(module: str) -> Callable[..., dict[str, Any]]:
    """The function that computes the derived outputs of one run in a module."""
    return importlib.import_module(module).compute
