"""Registry of derived outputs: results that need more than one operating point. Importable without jax.

A new output is a module with `compute(robot, conditions)` and a row of `quantities.TABLE`. `compute` is a pure
function of one run that returns its numbers [SI] by name and a `status`.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

from mmrjax.model.quantities import TABLE as QUANTITIES

_SLOPE, START = "mmrjax.derived.steepest_slope", "mmrjax.derived.start_figures"
_POSTURE, _TURN = "mmrjax.derived.pitch_and_step", "mmrjax.derived.turning_figures"

#: Read through the module, so that a new row adds an output everywhere.
TABLE = QUANTITIES["derived"]
#: Outputs of a posture at rest, and of a robot on a ground.
OF_POSTURE = tuple(d for d in TABLE if d.group == _POSTURE)
OF_GROUND = (*OF_POSTURE, *(d for d in TABLE if d.group in (_SLOPE, _TURN)))
#: Outputs of a start from standstill.
OF_START = tuple(d for d in TABLE if d.group == START)
#: Outputs of robots that turn only, and of straight travel only.
OF_TURNS = tuple(d for d in TABLE if d.group == _TURN)
OF_STRAIGHT = tuple(d for d in TABLE if d.group in (_SLOPE, START))


def compute_function(module: str) -> Callable[..., dict[str, Any]]:
    """The function that computes the derived outputs of one run in a module."""
    return importlib.import_module(module).compute
