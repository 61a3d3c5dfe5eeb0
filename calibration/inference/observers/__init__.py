"""Observers: how inference treats each kind of data, settled runs or time histories. Each kind has its own file.

No other room tests which kind a table has (tests/test_structure.py checks the code for it).
"""

from __future__ import annotations

import numpy as np

from calibration.data.input_errors import stated_word
from calibration.data.runs import Runs
from calibration.inference.observers.base import Observer
from calibration.inference.observers.settled import SettledRuns
from calibration.inference.observers.time_histories import Histories
from calibration.inference.observers.turns import SettledTurns
from calibration.inference.priors import Coordinates
from calibration.inference.problem import Problem, data_from_readings
from mmrjax import fidelities
from mmrjax.fidelities import FidelityFacts
from mmrjax.model import params
from mmrjax.model.robot import Robot

__all__ = ["Histories", "Observer", "SettledRuns", "SettledTurns", "fidelity_facts", "observer_kind", "pose_problem"]

#: In the order in which a table is tested for them.
KINDS: tuple[type[Observer], ...] = (Histories, SettledTurns, SettledRuns)


def observer_kind(runs: Runs) -> type[Observer]:
    """Observer class of a table: time histories if it has `time_s`, otherwise settled turns or settled straight
    runs.
    """
    return next(k for k in KINDS if k.accepts_table(runs))


def facts_of_fidelity(model: str) -> FidelityFacts:
    """Properties of a fidelity, by its name.

    Raises:
        BadConfiguration: no such fidelity.
    """
    stated_word(model, fidelities.TABLE, f"--model {model}", "no such fidelity")
    return fidelities.fidelity_facts(model)


def pose_problem(
    runs: Runs, base: Robot, coordinates: Coordinates, sd: np.ndarray, model: str | None = None
) -> Problem:
    """Inverse problem of these runs.

    Args:
        sd: standard deviation of the readings [SI], shape (rows, channels).
        model: name of the fidelity that simulates them. None: the first one that the kind of data allows.

    Raises:
        BadConfiguration: no such fidelity, or one that cannot simulate this kind of data.
        BadData: a configuration that `base` does not have.
    """
    if model is not None:
        facts_of_fidelity(model)
    observe = observer_kind(runs).of(runs, base, model)
    return Problem(
        params.without_weak_types(base),
        coordinates,
        observe,
        data_from_readings(runs.measured(), sd, len(coordinates)),
    )
