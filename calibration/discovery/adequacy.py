"""Adequacy test: do the residuals of a fit exceed the noise?"""

from __future__ import annotations

import dataclasses

import numpy as np

from calibration.discovery.score_tests import ScoreTable, Statistics
from calibration.discovery.settings import Settings
from calibration.inference.linearization import Linearization


@dataclasses.dataclass(frozen=True)
class AdequacyTest:
    """Test of a fit's residuals against its bootstrap.

    Attributes:
        found: the strongest statistics of the data.
        null: statistics of the bootstrap, shape (replicates,) each.
        settings: shares of the family-wise error, and margins.
    """

    found: Statistics
    null: Statistics
    settings: Settings

    def p(self, kind: str) -> float:
        """Fraction of bootstrap tables with a statistic at least as strong, never below 1 / (replicates + 1)."""
        null = getattr(self.null, kind)
        return (1 + int(np.sum(null >= float(getattr(self.found, kind))))) / (1 + len(null))

    def threshold(self, kind: str) -> float:
        """Critical value of the strongest statistic of a kind."""
        return float(np.quantile(getattr(self.null, kind), 1 - self.settings.shares[kind], method="higher"))

    @property
    def rejected(self) -> bool:
        """True if an effect is missing, at the family-wise error of the settings."""
        return any(self.p(kind) <= level for kind, level in self.settings.shares.items())

    @property
    def rejected_with_margin(self) -> bool:
        """True if the residuals are highly significant, so that the fit is incomplete."""
        return any(map(self.beyond_doubt, self.settings.shares))

    def beyond_doubt(self, kind: str, found: float | None = None) -> bool:
        """True if a statistic of a kind exceeds its threshold by the margin. None takes the strongest one."""
        if kind not in self.settings.shares:
            return False
        statistic = float(getattr(self.found, kind)) if found is None else found
        return statistic > self.threshold(kind) + self.settings.margins[kind]

    def confirmed(self, gain: float) -> AdequacyTest:
        """The test with the gain of the strongest effect, and of pairs with it, limited to the gain that its
        simulation confirms [σ²]."""
        promised = float(self.found.single) ** 2
        pair = self.found.pair - max(promised - gain, 0.0)
        found = dataclasses.replace(self.found, single=np.sqrt(min(promised, gain)), pair=pair)
        return dataclasses.replace(self, found=found)

    @property
    def p_value(self) -> float:
        """Family-wise p-value: the smallest of its kinds, each over its share of the error."""
        total = self.settings.family_wise_error
        return min(1.0, min(self.p(kind) * total / level for kind, level in self.settings.shares.items()))


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """Diagnosis of a fit's residuals.

    Attributes:
        linear: the fit, linearised.
        scores: scores of effects and curves.
        test: test of the residuals.
    """

    linear: Linearization
    scores: ScoreTable
    test: AdequacyTest
