"""A differentiable, batched simulator of the drive and running gear of a small tracked or wheeled robot.

    import mmrjax as mm

    robot = mm.nominal()
    one = mm.simulate(robot, mm.Conditions(configuration="6T2A", voltage=24.0, slope_deg=10.0, payload=3.0))

Importing the package does not import jax. jax is imported when a name is first used. No setting of jax changes.
Called outside a trace, the functions compute in double precision. Within a trace, in JAX's own precision.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

#: Module of each public name; `__init__.pyi` has the same list for type checkers.
_HOME = {
    "Conditions": "model.conditions",
    "Effect": "effects",
    "Results": "fidelities.results",
    "Robot": "model.robot",
    "STATUSES": "model.signals",
    "State": "model.signals",
    "UsageError": "errors",
    "initial_state": "fidelities.stepping",
    "nominal": "model.paper_robots",
    "profile": "missions.profile",
    "rates": "fidelities.stepping",
    "replace": "model.params",
    "simulate": "fidelities.simulation",
    "step": "fidelities.stepping",
}

#: Names of the layers above `mmrjax`; each is imported when it is first used.
_ABOVE = {
    "calibrate": "calibration",
    "describe": "calibration.described",
    "discover": "calibration",
    "export": "sweeps.commands.export_drive",
    "keep_programs": "sweeps.compilation_cache",
    "read_robot": "calibration",
    "read_runs": "calibration",
    "runs": "calibration",
    "sweep": "sweeps",
    "to_pandas": "calibration",
    "to_polars": "calibration",
    "to_xarray": "calibration",
}

__all__ = sorted((*_HOME, *_ABOVE, "__version__"))

#: Value for XLA_FLAGS, to be set before JAX is imported. It turns off LLVM's fast instruction selection, which acts
#: at optimization level 0 and compiles some derivatives wrongly (NaN or zero; jaxlib 0.10.2).
SOUND_AT_LEVEL_0 = "--xla_backend_extra_options=-fast-isel=false"
#: Addition to it that halves the compilation of programs over time from jaxlib 0.11 on, which has no such option for
#: a single program (processor time for a log of 800 rows: 78 → 53 s).
OLDER_EMITTERS = "xla_cpu_disable_new_fusion_emitters=true"
#: Beginning of the names of threads that compute, which a process must not end around.
WORKER = "mmrjax-worker"


def __getattr__(name: str) -> Any:
    home = _ABOVE.get(name) or (f"{__name__}.{_HOME[name]}" if name in _HOME else None)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(home), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
