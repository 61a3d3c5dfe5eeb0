"""Instructions for the next experiment, as data; `mmrjax.describe` makes their sentences."""

from __future__ import annotations

import dataclasses

from calibration.discovery.menu import Experiment
from calibration.discovery.reach import Reach


@dataclasses.dataclass(frozen=True)
class NothingPossible:
    """Every experiment of the menu is forbidden or beyond reach."""


@dataclasses.dataclass(frozen=True)
class NoMenu:
    """The menu holds no runs of the kind of the table's; what its rows are."""

    word: str


@dataclasses.dataclass(frozen=True)
class NothingTells:
    """No experiment of the menu tells alternatives apart by so much [σ]."""

    names: tuple[str, ...]
    sigma: float


@dataclasses.dataclass(frozen=True)
class CarryOut:
    """Experiments of the menu, all of them."""

    experiments: tuple[Experiment, ...]


@dataclasses.dataclass(frozen=True)
class MoreRuns:
    """More runs along the variable of a discrepancy in a place.

    Attributes:
        runs: of the series.
        low, high: voltages that it goes between, top: the highest that the table used [V].
        slope [deg], payload [kg]: up to which it may go; steps: of voltage, slope and payload.
        within: reach of the table; by_duty: whether it varied the duty at one supply voltage.
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
    """A series in a variable that would show what is missing by too little [σ]."""

    variable: str
    sigma: float


KINDS = (NothingPossible, NoMenu, NothingTells, CarryOut, MoreRuns, TooWeak)
Instruction = NothingPossible | NoMenu | NothingTells | CarryOut | MoreRuns | TooWeak
