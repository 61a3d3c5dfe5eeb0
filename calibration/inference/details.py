"""Further findings for one kind of data: errors of equations in each run, or memory, orders and drift over time."""

from __future__ import annotations

import abc
import dataclasses

from calibration.data import Columns, Json, Names
from calibration.data.writing import entries_of


@dataclasses.dataclass(frozen=True)
class Detail(abc.ABC):
    """Further findings for one kind of data. Reports choose the section by its type."""

    @abc.abstractmethod
    def to_json(self) -> Json:
        """Entries of `result.json`."""

    def columns(self) -> Columns:
        """Columns of `rows.csv`, shape (rows,)."""
        return {}


@dataclasses.dataclass(frozen=True)
class EquationErrors(Detail):
    """Error of each equation in each run [unit of its balance], NaN for excluded rows.

    Attributes:
        before, after: balance → error of each row that would cancel the residuals of the readings, shape (rows,).
            With the side in its name if sides are driven independently (`track_left`).
    """

    before: Columns
    after: Columns

    def to_json(self) -> Json:
        return {"series": None}

    def columns(self) -> Columns:
        defects_by_fit = (("before", self.before), ("after", self.after))
        return {
            f"defect_{when}_{balance}": values
            for when, defects_by_balance in defects_by_fit
            for balance, values in defects_by_balance.items()
        }


@dataclasses.dataclass(frozen=True)
class StrongestWave:
    """Balance in which a wave or a drift explains most of the misfit, with its score (normal deviate) and decrease of
    χ² [σ²].
    """

    balance: str
    deviate: float
    explained: float


@dataclasses.dataclass(frozen=True)
class FitOverTime:
    """Statistics of one fit over time: autocorrelation of the residuals, waves and drift.

    Attributes:
        deviate, threshold, p: Ljung-Box statistic as a normal deviate, with its critical value and p-value from
            bootstrap tables.
        autocorrelation: autocorrelation of each channel, at lags from 1.
        orders: (name, periods per turn of the driving shaft) → score.
        drift: None if the other conditions determine the time (see `bases.COLLINEAR`).
    """

    deviate: float
    threshold: float
    p: float
    autocorrelation: dict[str, list[float]]
    orders: dict[tuple[str, float], StrongestWave]
    drift: StrongestWave | None

    @property
    def lags(self) -> int:
        """Number of lags of the autocorrelation."""
        return len(next(iter(self.autocorrelation.values())))

    def to_json(self) -> Json:
        """Entries of `result.json`."""
        orders = [{"order": w, "a_turn": n, **vars(s)} for (w, n), s in self.orders.items()]
        memory = entries_of(self, "deviate", "threshold", "p", "lags", "autocorrelation")
        return {"memory": memory, "orders": orders, "drift": self.drift}


@dataclasses.dataclass(frozen=True)
class TimeStatistics(Detail):
    """Statistics that only time histories have.

    Attributes:
        runs, samples: number of runs and samples.
        orders_unresolved: waves that the sampling does not resolve.
        before, after: statistics without and with the proposal.
    """

    runs: int
    samples: int
    orders_unresolved: Names
    before: FitOverTime
    after: FitOverTime

    def to_json(self) -> Json:
        return {"series": vars(self)}
