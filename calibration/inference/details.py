"""What one kind of data tells beside the fit: equations run by run, or memory, orders and drift over time."""

from __future__ import annotations

import abc
import dataclasses
from typing import Any

import numpy as np


@dataclasses.dataclass(frozen=True)
class Detail(abc.ABC):
    """Further findings of one kind of data; reports choose their section by its type."""

    @abc.abstractmethod
    def to_json(self) -> dict[str, Any]:
        """Entries of `result.json`."""

    def columns(self) -> dict[str, np.ndarray]:
        """Columns of `rows.csv`, shape (rows,)."""
        return {}


@dataclasses.dataclass(frozen=True)
class EquationDefects(Detail):
    """Defect of each equation in every run [its balance's unit], NaN for rows that do not count.

    Attributes:
        before, after: balance, with its side where sides are driven apart (`track_left`) → values, shape (rows,);
            what closes the readings' residual there.
    """

    before: dict[str, np.ndarray]
    after: dict[str, np.ndarray]

    def to_json(self) -> dict[str, Any]:
        return {"series": None}

    def columns(self) -> dict[str, np.ndarray]:
        both = (("before", self.before), ("after", self.after))
        return {f"defect_{when}_{balance}": values for when, by in both for balance, values in by.items()}


@dataclasses.dataclass(frozen=True)
class Memory:
    """Memory of the residual: Ljung and Box's statistic as a normal deviate, its threshold and p among bootstrap
    tables, the lags, and each channel's autocorrelation at lags 1 to that."""

    deviate: float
    threshold: float
    p: float
    lags: int
    autocorrelation: dict[str, list[float]]


@dataclasses.dataclass(frozen=True)
class Strongest:
    """The balance in which a wave or a drift explains most: its score as a normal deviate, the fall of χ² [σ²]."""

    balance: str
    deviate: float
    explained: float


@dataclasses.dataclass(frozen=True)
class TimeSide:
    """Of one fit: memory; order (its word, waves a turn of the driving shaft) → what a wave of it explains; drift."""

    memory: Memory
    orders: dict[tuple[str, float], Strongest]
    drift: Strongest

    def to_json(self) -> dict[str, Any]:
        """As `result.json` has it."""
        orders = [{"order": w, "a_turn": n, **dataclasses.asdict(s)} for (w, n), s in self.orders.items()]
        return {"memory": dataclasses.asdict(self.memory), "orders": orders, "drift": dataclasses.asdict(self.drift)}


@dataclasses.dataclass(frozen=True)
class TimeStatistics(Detail):
    """What only histories tell.

    Attributes:
        runs, samples: how many; orders_unresolved: waves that the samples do not resolve.
        before, after: of base and proposed robot.
    """

    runs: int
    samples: int
    orders_unresolved: tuple[str, ...]
    before: TimeSide
    after: TimeSide

    def to_json(self) -> dict[str, Any]:
        return {
            "series": {
                "runs": self.runs,
                "samples": self.samples,
                "orders_unresolved": list(self.orders_unresolved),
                "before": self.before.to_json(),
                "after": self.after.to_json(),
            }
        }
