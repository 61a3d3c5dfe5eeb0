"""Statistical constants of the closed loop."""

from __future__ import annotations

import dataclasses
import math

from calibration.data import Names
from calibration.data.input_errors import SEEDS, stated_count
from calibration.inference.observers import Observer

#: Family-wise error of the test for a missing effect, divided among the kinds of evidence: single effects, curves,
#: pairs and χ². Residuals in order of time also have their memory (`white`).
SHARES = {
    ("single", "curve", "pair", "chi2"): (0.03, 0.01, 0.004, 0.006),
    ("single", "curve", "pair", "chi2", "white"): (0.03, 0.01, 0.004, 0.003, 0.003),
}
#: Verdicts that find a discrepancy but establish no effect.
WITHOUT_NAME = ("mechanism", "place")
#: Margin above its threshold at which a statistic rejects a fit with effects. A residual effect of two sigmas right
#: on the threshold would otherwise flip the verdict, at a family-wise error of about 1 %.
MARGINS = {"single": 0.5, "curve": 0.7, "pair": 6.0, "chi2": 10.0, "white": 1.0}


@dataclasses.dataclass(frozen=True)
class Settings:
    """Constants that decide a verdict, written to `result.json`.

    Attributes:
        shares: family-wise error by kind of evidence.
        margins: margins by kind of evidence, see `MARGINS`.
        replicates: number of bootstrap tables.
        seed: random seed.
        slots: largest number of effects in a fit.
        rows_per_effect: number of rows required for each effect.
        width: prior sd of an amplitude in a fit, relative to the sd of its field. It is wide enough not to shrink a
            visible effect.
        plausible: largest plausible amplitude, in sds of its field.
        stretched: factor on the largest plausible amplitude for alternatives of the same family, because their size
            is uncertain too.
        visible: an effect is visible if its largest plausible amplitude changes the readings by at least this [σ].
        same, same_parallel: largest rise of the objective for another effect that explains the data as well, and the
            same if |cos| of the signatures is above `parallel` [σ²].
        form, form_family: share of an effect's sigmas that another one may lack and still differ only in its form.
            The same within one family.
        alike: |cos| above which an effect is tried in place of another one.
        needed: smallest contribution of each of two effects, given the other, for both to be named [σ].
        preferred: a smooth curve with this much more evidence refutes names [σ²].
        alternative: largest rise of χ² at which a candidate is listed as an alternative [σ²].
        outlier_share: largest share of rows that may be excluded.
        outlier_few: in a short table, this many rows may be excluded, up to a fifth of it.
        outlier_error: family-wise error of an exclusion.
        gross: a row this far beyond the median row's distance cannot have been measured as stated [σ].
        cauchy: scale of the Cauchy weights [σ].
        reweightings: number of reweighting iterations.
        worth, apart: least separation of an experiment to be worthwhile, and to separate two alternatives [σ].
        enough, gain: probability above which a better separation is no gain, and least increase of the expected
            number of separated pairs by a second experiment.
        refuted: rise of χ² that refutes an alternative [σ²].
        forbidden: kinds of experiments (`menu.KINDS`) and configurations that must not be proposed.
        silent: channels without a stated noise.
    """

    shares: dict[str, float]
    margins: dict[str, float] = dataclasses.field(default_factory=lambda: dict(MARGINS))
    replicates: int = 500
    seed: int = 0
    slots: int = 4
    rows_per_effect: int = 5
    width: float = 3.0
    plausible: float = 4.0
    stretched: float = 2.0
    visible: float = 3.0
    same: float = 6.0
    same_parallel: float = 9.0
    parallel: float = 0.95
    form: float = 0.2
    form_family: float = 0.4
    alike: float = 0.5
    needed: float = 5.0
    preferred: float = 9.0
    alternative: float = 9.0
    outlier_share: float = 0.1
    outlier_few: int = 3
    outlier_error: float = 0.01
    gross: float = 12.0
    cauchy: float = 2.4
    reweightings: int = 8
    worth: float = 2.0
    apart: float = 3.0
    enough: float = 0.95
    gain: float = 0.2
    refuted: float = 4.0
    forbidden: Names = ()
    silent: Names = ()

    def outliers(self, rows: int) -> int:
        """Largest number of rows that may be excluded."""
        return max(int(self.outlier_share * rows), min(self.outlier_few, rows // 5))

    def tolerance(self, explained: float, akin: bool = False) -> float:
        """Decrease of χ² that an alternative may lack and still explain the data as well [σ²].

        Args:
            explained: decrease of χ² by the best explanation [σ²].
            akin: True if both are of one family.
        """
        return max(self.same, (self.form_family if akin else self.form) ** 2 * explained)

    @property
    def family_wise_error(self) -> float:
        """Error of the test for a missing effect."""
        return sum(self.shares.values())


def fewest_replicates(kind: type[Observer]) -> int:
    """Smallest number of bootstrap tables for which each kind of evidence can be significant.

    The p-value of a statistic is at least 1 / (1 + tables).
    """
    return math.ceil(1 / min(SHARES[kind.evidence])) - 1


def settings_for(kind: type[Observer], replicates: int = 500, seed: int = 0) -> Settings:
    """Settings of the loop for one kind of data.

    Raises:
        BadConfiguration: the number of replicates or the seed is out of range.
    """
    stated_count(replicates, "replicates", 1, 100_000)
    stated_count(seed, "seed", 0, SEEDS)
    shares = dict(zip(kind.evidence, SHARES[kind.evidence], strict=True))
    return Settings(shares, replicates=replicates, seed=seed)
