"""The statistical constants of the closed loop, in one recorded place."""

from __future__ import annotations

import dataclasses
import math

from calibration.data.input_errors import BadConfiguration, choices
from calibration.inference.observers import Observer

#: Family-wise error of «something is missing», shared out among the kinds of evidence: single effects, curves, pairs,
#: χ², and where the order of the residuals means something also their memory (`white`).
SHARES = {
    ("single", "curve", "pair", "chi2"): (0.03, 0.01, 0.004, 0.006),
    ("single", "curve", "pair", "chi2", "white"): (0.03, 0.01, 0.004, 0.003, 0.003),
}
#: Verdicts by which something is missing and no effect of the library is established.
WITHOUT_NAME = ("mechanism", "place")
#: By what the leader of a class is chosen among its members.
PREFERENCES = FIT, HELD_OUT = ("fit", "held-out")
#: How far beyond its threshold a statistic has to be for a fit with effects to be rejected: two sigmas of a
#: leftover that lies right on it would flip the verdict, at a family-wise error of some 1 %.
MARGINS = {"single": 0.5, "curve": 0.7, "pair": 6.0, "chi2": 10.0, "white": 1.0}


@dataclasses.dataclass(frozen=True)
class Settings:
    """What decides a verdict; written to `result.json`.

    Attributes:
        shares: family-wise error by kind of evidence; margins: see `MARGINS`.
        replicates: of the bootstrap; seed: random.
        slots: most effects that are found at once; rows_per_effect: rows that each needs.
        width: prior sd of an amplitude in a fit, in sds of its field: wide enough to leave a visible effect
            unshrunk; plausible: sds of its field beyond which an amplitude is not plausible; stretched: times that
            up to which an effect is listed beside a plausible one of its family, whose size is known no better.
        visible: sigmas that the largest plausible amplitude has to leave for an effect to be visible [σ].
        same, same_parallel: rise of the objective up to which another effect explains the data as well, and up to
            which it does where |cos| of the signatures is above `parallel` [σ²].
        form, form_family: share of an effect's sigmas by which another one may explain less and still be the same but
            for its form; of one of its family.
        alike: |cos| above which an effect is tried in the place of another one.
        needed: what each of two effects has to explain, given the other, for both to be named [σ].
        preferred: evidence by which a smooth curve has to be the better explanation for names not to stand [σ²].
        alternative: rise of the objective up to which a candidate is listed [σ²].
        outlier_share: largest share of rows set aside; outlier_few: how many may be of a short table, up to a fifth
            of it; outlier_error: family-wise error of that.
        gross: how many times further off than the median row no row can be that was measured as it is stated [σ].
        cauchy: scale of Cauchy's weights [σ]; reweightings: their iterations.
        worth, apart: separation from which an experiment is worth while, and from which it tells two apart [σ].
        enough, gain: chance beyond which telling a pair apart better is no gain; what a second experiment has to
            add to the number of pairs that are expected to be told apart.
        refuted: rise of χ² by which an alternative is refuted [σ²].
        prefer: one of `PREFERENCES`.
        forbidden: kinds of experiments, and configurations, that are not proposed (see `menu.KINDS`).
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
    prefer: str = FIT
    forbidden: tuple[str, ...] = ()

    def outliers(self, rows: int) -> int:
        """How many of so many rows may be set aside."""
        return max(int(self.outlier_share * rows), min(self.outlier_few, rows // 5))

    @property
    def family_wise_error(self) -> float:
        """Of the test whether anything is missing."""
        return sum(self.shares.values())


def fewest_replicates(kind: type[Observer]) -> int:
    """Tables of the bootstrap from which on every kind of evidence that data of a kind give can count: below, a
    statistic beyond all of them is no more improbable than 1 / (1 + tables)."""
    return math.ceil(1 / min(SHARES[kind.evidence])) - 1


def settings_for(kind: type[Observer], replicates: int = 500, seed: int = 0, prefer: str = FIT) -> Settings:
    """The settings for data of a kind.

    Raises:
        BadConfiguration: `prefer` is none of `PREFERENCES`.
    """
    if prefer not in PREFERENCES:
        raise BadConfiguration(f"--prefer: got {prefer}; {choices(prefer, PREFERENCES)}")
    shares = dict(zip(kind.evidence, SHARES[kind.evidence], strict=True))
    return Settings(shares, replicates=replicates, seed=seed, prefer=prefer)
