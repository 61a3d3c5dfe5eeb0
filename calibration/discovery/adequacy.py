"""Adequacy test: do the residuals of a fit exceed the noise?"""

from __future__ import annotations

import dataclasses

import numpy as np

from calibration.data import Json
from calibration.discovery.score_tests import ScoreTable, StrongestStatistics
from calibration.discovery.settings import Settings
from calibration.inference.linearization import Linearization


@dataclasses.dataclass(frozen=True)
class AdequacyTest:
    """Compares the residuals of a fit with those of bootstrap tables without a missing effect.

    Attributes:
        found: the strongest statistics of the measured data.
        null: the same statistics of the bootstrap tables, shape (replicates,) each.
        settings: family-wise error of each kind of statistic, and margins.
    """

    found: StrongestStatistics
    null: StrongestStatistics
    settings: Settings

    def p(self, kind: str) -> float:
        """p-value of one kind of statistic: share of bootstrap tables with a statistic at least as large. At least 1
        / (replicates + 1).
        """
        null = getattr(self.null, kind)
        return (1 + int(np.sum(null >= float(getattr(self.found, kind))))) / (1 + len(null))

    def threshold(self, kind: str) -> float:
        """Critical value of one kind of statistic."""
        return float(np.quantile(getattr(self.null, kind), 1 - self.settings.shares[kind], method="higher"))

    @property
    def rejected(self) -> bool:
        """True if the test finds that an effect is missing, at the family-wise error of the settings."""
        return any(self.p(kind) <= level for kind, level in self.settings.shares.items())

    @property
    def rejected_with_margin(self) -> bool:
        """True if a statistic exceeds its critical value by its margin, so that the fit is certainly incomplete."""
        return any(map(self.exceeds_margin, self.settings.shares))

    def exceeds_margin(self, kind: str, value: float | None = None) -> bool:
        """True if a statistic exceeds its critical value by its margin. With `value` = None, the statistic of the
        data is tested.
        """
        if kind not in self.settings.shares:
            return False
        statistic = float(getattr(self.found, kind)) if value is None else value
        return statistic > self.threshold(kind) + self.settings.margins[kind]

    def of(self, statistics: StrongestStatistics) -> AdequacyTest:
        """The same test of other statistics."""
        return dataclasses.replace(self, found=statistics)

    def confirmed(self, gain: float) -> AdequacyTest:
        """The test after a simulation: the scores of the strongest effect and of its pairs are reduced to the gain
        that the simulation confirms [σ²].
        """
        promised = float(self.found.single) ** 2
        pair = self.found.pair - max(promised - gain, 0.0)
        return self.of(dataclasses.replace(self.found, single=np.sqrt(min(promised, gain)), pair=pair))

    def to_json(self) -> Json:
        """Entry of result.json: the strongest statistic of each kind, its critical value and its p-value."""
        kinds = {
            kind: {"found": float(getattr(self.found, kind)), "threshold": self.threshold(kind), "p": self.p(kind)}
            for kind in self.settings.shares
        }
        return {**kinds, "p_value": self.p_value}

    @property
    def p_value(self) -> float:
        """Family-wise p-value: the smallest p-value over the kinds, each divided by its share of the error."""
        total = self.settings.family_wise_error
        return min(1.0, min(self.p(kind) * total / level for kind, level in self.settings.shares.items()))


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """The residuals of a fit, tested for missing effects.

    Attributes:
        linear: linearization of the fit.
        scores: scores of effects and of smooth curves on the residuals.
        test: adequacy test of the residuals.
    """

    linear: Linearization
    scores: ScoreTable
    test: AdequacyTest
