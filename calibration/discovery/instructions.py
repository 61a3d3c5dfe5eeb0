"""Instructions for the next experiment, as data. `mmrjax.describe` makes their sentences."""

from __future__ import annotations

import dataclasses

from calibration.data import Names
from calibration.discovery.menu import Experiment
from calibration.discovery.reach import Reach


@dataclasses.dataclass(frozen=True)
class NothingPossible:
    """Every experiment of the menu is forbidden or beyond reach."""


@dataclasses.dataclass(frozen=True)
class NoMenu:
    """The menu has no runs of the table's kind. `word` is the name of its rows."""

    word: str


@dataclasses.dataclass(frozen=True)
class NothingTells:
    """No experiment of the menu separates the alternatives by at least `sigma` [σ]."""

    names: Names
    sigma: float


@dataclasses.dataclass(frozen=True)
class CarryOut:
    """Experiments of the menu, all to be carried out."""

    experiments: tuple[Experiment, ...]


@dataclasses.dataclass(frozen=True)
class MoreRuns:
    """More runs along the variable of a discrepancy in a place.

    Attributes:
        runs: number of runs in the series.
        low, high: range of its voltages, top: the highest voltage of the table [V].
        slope [deg], payload [kg]: largest values. `steps`: of voltage, slope and payload.
        within: reach of the table.
        by_duty: True if the table varied the duty at one supply voltage.
    """

    place: str
    variable: str
    runs: int
    low: float
    high: float
    top: float
    slope: float
    payload: float
    steps: tuple[float, float, float]
    within: Reach
    by_duty: bool = False


@dataclasses.dataclass(frozen=True)
class TooWeak:
    """A series in a variable with a separation that is too small [σ]."""

    variable: str
    sigma: float


KINDS = (NothingPossible, NoMenu, NothingTells, CarryOut, MoreRuns, TooWeak)
Instruction = NothingPossible | NoMenu | NothingTells | CarryOut | MoreRuns | TooWeak
