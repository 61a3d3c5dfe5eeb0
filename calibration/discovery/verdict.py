"""Results of the loop up to the verdict, and what this verdict claims."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from calibration.data import Names
from calibration.data.runs import Runs
from calibration.discovery import loop_notes, search
from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.adequacy import Diagnosis
from calibration.discovery.candidates import Candidate
from calibration.discovery.classes import Classes
from calibration.discovery.discrepancy import BaseCurve
from calibration.discovery.location import DiscrepancyLocation
from calibration.discovery.log_simulation import LogSimulation
from calibration.discovery.loop_notes import VerdictSummary
from calibration.discovery.outliers import Screening
from calibration.discovery.prediction import HeldOutScore, Predicted
from calibration.discovery.settings import WITHOUT_NAME
from calibration.inference import checks
from calibration.inference.fit_notes import Remark
from calibration.inference.lack_of_fit import EXPLAINED, UNDESCRIBED
from calibration.inference.linearization import Linearization
from calibration.inference.noise import UNSTATED, Noise

#: Share of excluded rows above which the summary begins with it.
MANY = 0.03
#: Distance from the prior above which a note reports a base parameter [prior sd].
FAR = 3.0


@dataclasses.dataclass(frozen=True)
class VerdictNoise:
    """Noise behind a verdict.

    Attributes:
        noise: noise of the readings.
        factors: factors on the given sds by channel, empty if they are unchanged.
        remarks: notes on the noise.
    """

    noise: Noise
    factors: dict[str, float] = dataclasses.field(default_factory=dict)
    remarks: tuple[Remark, ...] = ()


#: Result of a stage that has not run yet.
PENDING: Any = None


@dataclasses.dataclass(frozen=True)
class LoopStages:
    """Results of the stages of the loop, in the order of `discover.STAGES`.

    Attributes:
        verdict: `none`, `named`, `class`, `mechanism`, `place` or `undescribed`.
        screened: base fit without outliers.
        left: diagnosis of the base fit.
        sds: noise behind the verdict.
        searched: result of the search for effects.
        alike: alternatives to the effects found, if effects are named.
        where: location of the discrepancy, or of the rest that the effects leave.
        standing: tests of the effects' names.
        beside: smooth curve of the discrepancy of the base, if there is one.
        predicted: hold-out predictions of fits, as from `prediction.smallest_predictive_set`.
        mechanism: equation and driving variable, if no effect is established. They need not be established either.
        missed: channels that the refit does not describe. For other verdicts than `undescribed`, with the error that
            remains after adding effects.
        unused: numeric columns that vary and have no role.
        run: simulation of a log, whose verdict comes from its equations.
        settled: True if settled runs replace a log.
    """

    verdict: str = ""
    screened: Screening = PENDING
    left: Diagnosis = PENDING
    sds: VerdictNoise = PENDING
    searched: search.SearchResult | None = None
    alike: Classes | None = None
    where: DiscrepancyLocation | None = None
    standing: loop_notes.NameSupport | None = None
    beside: BaseCurve | None = None
    predicted: Predicted = dataclasses.field(default_factory=dict)
    mechanism: loop_notes.Mechanism | None = None
    missed: tuple[loop_notes.MissedChannel, ...] = ()
    unused: Names = ()
    run: LogSimulation | None = None
    settled: bool = False

    @property
    def members(self) -> tuple[Names, ...]:
        """For each established effect, the effect and those that the data cannot separate from it."""
        classes = () if self.alike is None else self.alike.members
        return tuple(itertools.compress(classes, self._named))

    @property
    def _named(self) -> list[bool]:
        """For each class of effects, True if its leading effect is established."""
        classes = () if self.alike is None else self.alike.members
        return [self.standing is None or self.standing.established(m[0]) for m in classes]

    @property
    def families(self) -> Names:
        """Families of the members of each established class, or of the location of a discrepancy without a name."""
        if self.alike is not None and self.verdict not in WITHOUT_NAME:
            return tuple(itertools.chain(*itertools.compress(self.alike.families, self._named)))
        if self.verdict == "mechanism" and self.mechanism is not None:
            return self.mechanism.families
        return () if self.where is None else (self.where.family,)

    @property
    def best(self) -> Candidate:
        """Proposed candidate: the base fit if no effect is named."""
        if self.alike is None or self.searched is None or self.searched.best is None:
            return self.screened.base.candidate
        return self.searched.best

    @property
    def ends(self) -> Diagnosis:
        """Diagnosis of the proposed candidate."""
        if self.alike is None or self.searched is None or self.searched.diagnosis is None:
            return self.left
        return self.searched.diagnosis


def verdict_summary(traced: LoopStages, numbers: np.ndarray) -> VerdictSummary:
    """Data of the statement of a verdict. `numbers`: row numbers as used in messages."""
    space, alike = traced.screened.base.space, traced.alike
    support = None if traced.standing is None else traced.standing.with_row_numbers(numbers)
    best = None if traced.searched is None else traced.searched.best
    base = traced.screened.base.candidate
    outlier_count, included_count = len(traced.screened.outliers), int(space.included.sum())
    is_many = outlier_count > MANY * (outlier_count + included_count)
    classes = () if alike is None else zip(alike.members, alike.stated, alike.families, strict=True)
    missing = (
        loop_notes.MissingEffect(
            names,
            tuple(loop_notes.AlternativeValue(s.name, s.value, s.unit) for s in shifts),
            families,
            support is None or support.established(names[0]),
            None if support is None else support.test_of(names[0]),
        )
        for names, shifts, families in classes
    )
    return VerdictSummary(
        traced.verdict,
        traced.left.test.p_value,
        traced.where,
        missing=tuple(missing),
        nearest=best.effects if traced.verdict in WITHOUT_NAME and best is not None else (),
        support=support,
        aside=outlier_count if is_many else 0,
        of=outlier_count + included_count,
        noise=traced.sds.remarks if traced.sds.factors and traced.verdict == "none" else (),
        cluster=traced.screened.cluster,
        mechanism=traced.mechanism,
        missed=traced.missed,
        unused=traced.unused,
        far=tuple(n for n, z in zip(space.coordinates.base.names, base.z[: space.free], strict=True) if abs(z) > FAR),
    )


#: Least share of the refit's error on unseen runs that effects have to remove where the refit misses a channel.
REMOVED = 0.5


def missed_channels(
    space: CandidateSpace, runs: Runs, noise: Noise, refit: Linearization
) -> tuple[loop_notes.MissedChannel, ...]:
    """Channels with a refit error above `UNDESCRIBED` of their measured rms, or with an estimated noise above it.

    If the stated noise of a channel is that large, residuals up to `EXPLAINED` times the noise are accepted.

    Args:
        refit: linearization of the fit without effects.
    """
    if not space.bare.observe.reads:
        return ()
    rows = len(runs)
    counts = space.weight[:rows] > 0
    whitened = np.where(counts, np.asarray(refit.by_row())[:rows], 0.0)
    sd, squares = np.where(counts, noise.sd, 0.0), np.sum(np.where(counts, runs.measured(), 0.0) ** 2, 0)
    error_share = np.sqrt(np.sum((whitened * sd) ** 2, 0)) / np.maximum(np.sqrt(squares), 1e-300)
    sigma = np.sqrt(np.sum(whitened**2, 0) / np.maximum(counts.sum(0), 1))
    has_stated_sd = np.array([source not in UNSTATED for source in noise.source])
    large = (error_share > UNDESCRIBED) & ~(has_stated_sd & (sigma <= EXPLAINED))
    with np.errstate(invalid="ignore"):
        noise_share = np.sqrt(np.sum(sd**2, 0) / squares)
    noise_share = np.where(has_stated_sd, 0.0, noise_share)
    return tuple(
        loop_notes.MissedChannel(c.name, float(error_share[k]), float(noise_share[k]))
        for k, c in enumerate(runs.channels)
        if large[k] or noise_share[k] > UNDESCRIBED
    )


def remaining_errors(
    space: CandidateSpace,
    runs: Runs,
    missed: Sequence[loop_notes.MissedChannel],
    refit: HeldOutScore,
    with_effects: HeldOutScore,
) -> tuple[loop_notes.MissedChannel, ...]:
    """Hold-out errors of the missed channels after effects were added.

    Empty if the effects do not describe the runs either. Then more than `UNDESCRIBED` of a channel's rms remains,
    less than `REMOVED` of the refit's error is gone, or the estimated noise alone exceeds `UNDESCRIBED`.

    Args:
        missed: channels from `missed_channels`.
        refit, with_effects: hold-out predictions without and with the effects.
    """
    measured, counts = runs.measured(), space.weight[: len(runs)] > 0
    deviations = [
        [np.where(counts, x - measured, np.nan) for x in score.reading.values()] for score in (refit, with_effects)
    ]
    errors: np.ndarray = np.array(deviations).reshape(2, -1, measured.shape[1])
    errors = np.where(np.isfinite(errors).all(0), errors, np.nan)  # of readings that both predict
    with np.errstate(invalid="ignore"):
        size = np.nansum(np.where(counts, measured, np.nan) ** 2, 0) / counts.sum(0)
        before, after = np.sqrt(np.nansum(errors**2, 1) / np.isfinite(errors).sum(1) / size)
    index = {c.name: k for k, c in enumerate(runs.channels)}
    remaining = [m._replace(error=float(after[index[m.channel]])) for m in missed]
    described = all(
        m.noise <= UNDESCRIBED and m.error <= min(UNDESCRIBED, (1 - REMOVED) * before[index[m.channel]])
        for m in remaining
    )
    return tuple(remaining) if described else ()


def unused_inputs(runs: Runs) -> Names:
    """Numeric columns that vary but have no role, and an output torque that may be imposed by a brake."""
    torques = (f"{note.theirs} as a condition" for note in checks.unexplained_torque_notes(runs))
    return (*checks.unused_columns(runs), *torques)
