"""Measured data and what is done with them: read a robot and runs, calibrate, discover what the model lacks."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from calibration.data.robot_file import load_robot as read_robot
    from calibration.data.runs import read_runs as read_runs
    from calibration.data.runs import read_runs as runs
    from calibration.data.writing import to_pandas, to_polars, to_xarray
    from calibration.discovery.discover import discover
    from calibration.inference.calibration import calibrate

__all__ = [
    "calibrate", "discover", "read_robot", "read_runs", "runs", "to_pandas", "to_polars", "to_xarray",
]  # fmt: skip

#: Module and attribute of each name, imported on first access because most of them load JAX.
_HOMES = {
    "calibrate": ("calibration.inference.calibration", "calibrate"),
    "discover": ("calibration.discovery.discover", "discover"),
    "read_robot": ("calibration.data.robot_file", "load_robot"),
    "read_runs": ("calibration.data.runs", "read_runs"),
    "runs": ("calibration.data.runs", "read_runs"),
    "to_pandas": ("calibration.data.writing", "to_pandas"),
    "to_polars": ("calibration.data.writing", "to_polars"),
    "to_xarray": ("calibration.data.writing", "to_xarray"),
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__} has no attribute {name}")
    module, attribute = _HOMES[name]
    return getattr(importlib.import_module(module), attribute)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
