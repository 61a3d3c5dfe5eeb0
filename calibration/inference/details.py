"""Further findings of one kind of data: defects of each run's equations, or memory, orders and drift over time."""

from __future__ import annotations

import abc
import dataclasses

from calibration.data import Columns, Json, Names


@dataclasses.dataclass(frozen=True)
class Detail(abc.ABC):
    """Further findings of one kind of data. Reports select their section by its type."""

    @abc.abstractmethod
    def to_json(self) -> Json:
        """Entries of `result.json`."""

    def columns(self) -> Columns:
        """Columns of `rows.csv`, shape (rows,)."""
        return {}


@dataclasses.dataclass(frozen=True)
class EquationDefects(Detail):
    """Defect of each equation in each run [its balance's unit], NaN for excluded rows.

    Attributes:
        before, after: balance, with its side if sides are driven independently (`track_left`) → values, shape
            (rows,), that would cancel the readings' residuals.
    """

    before: Columns
    after: Columns

    def to_json(self) -> Json:
        return {"series": None}

    def columns(self) -> Columns:
        both = (("before", self.before), ("after", self.after))
        return {f"defect_{when}_{balance}": values for when, by in both for balance, values in by.items()}


@dataclasses.dataclass(frozen=True)
class Memory:
    """Autocorrelation of the residuals: the Ljung-Box statistic as a normal deviate, with threshold and p.

    Threshold and p are from bootstrap tables. `autocorrelation` is each channel's, at lags 1 to `lags`.
    """

    deviate: float
    threshold: float
    p: float
    lags: int
    autocorrelation: dict[str, list[float]]


@dataclasses.dataclass(frozen=True)
class Strongest:
    """Balance in which a wave or a drift explains most of the misfit: score as a normal deviate, and decrease of
    χ² [σ²]."""

    balance: str
    deviate: float
    explained: float


@dataclasses.dataclass(frozen=True)
class TimeSide:
    """Statistics of one fit over time: memory. Order (word, waves a turn of the driving shaft) → score, drift.

    Without drift if the other conditions determine the time (see `bases.COLLINEAR`).
    """

    memory: Memory
    orders: dict[tuple[str, float], Strongest]
    drift: Strongest | None

    def to_json(self) -> Json:
        """Entries of `result.json`."""
        orders = [{"order": w, "a_turn": n, **vars(s)} for (w, n), s in self.orders.items()]
        return {"memory": self.memory, "orders": orders, "drift": self.drift}


@dataclasses.dataclass(frozen=True)
class TimeStatistics(Detail):
    """Statistics that only histories have.

    Attributes:
        runs, samples: counts.
        orders_unresolved: waves that the samples do not resolve.
        before, after: statistics of the base and of the proposed robot.
    """

    runs: int
    samples: int
    orders_unresolved: Names
    before: TimeSide
    after: TimeSide

    def to_json(self) -> Json:
        return {"series": vars(self)}
