"""The closed loop: fit, outliers, score tests, adequacy, search, classes, discrepancy, next experiment, in turn.

Each stage is a function of what the stages before it found; none changes anything.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from calibration.data import own_mass
from calibration.data.columns import ROWS, SIDES, WHEN
from calibration.data.effect_file import Library
from calibration.data.input_errors import BadConfiguration, BadData
from calibration.data.posterior_file import Posterior
from calibration.data.runs import Runs
from calibration.data.thinning import thinned
from calibration.described import described, in_words
from calibration.discovery import findings, kept, menu, prediction, preference, scales
from calibration.discovery.active_set import CandidateSpace, candidate_space
from calibration.discovery.adequacy import AdequacyTest, Diagnosis
from calibration.discovery.candidates import BaseFit, Candidate, filled, fit_base, fit_candidates, start
from calibration.discovery.classes import Classes, classes, cosines
from calibration.discovery.description import undescribed, unused
from calibration.discovery.discrepancy import CurveBeside, Discrepancy, locate
from calibration.discovery.experiments import Proposal, denser, no_menu, separating
from calibration.discovery.hidden import hidden
from calibration.discovery.kept import Keep
from calibration.discovery.location import DiscrepancyLocation, varied_by_duty
from calibration.discovery.loop_notes import (
    AssumedNoise,
    Copies,
    FreedValue,
    KeptOut,
    Late,
    LostReplicates,
    Mechanism,
    Missed,
    Missing,
    NameSupport,
    NameTest,
    NoiseFromSeries,
    NotPredictable,
    Outstanding,
    PhasesDiffer,
    RefitWorse,
    RestsOn,
    StillLacks,
    Summary,
    TooFewReplicates,
    Unwritten,
)
from calibration.discovery.loop_posterior import of_curve, of_fit
from calibration.discovery.mechanism import mechanism
from calibration.discovery.outliers import Screening, ahead, same_rows, screen, screen_beside
from calibration.discovery.prediction import Predicted
from calibration.discovery.result import (
    Alternative,
    DiscoveryResult,
    Errors,
    FoundEffect,
    HeldOutAlternative,
    HiddenEffect,
    Ranking,
    ReadingsOfRows,
    Sensitivity,
    UnnamedDiscrepancy,
)
from calibration.discovery.score_tests import Statistics, bootstrap
from calibration.discovery.screening import beforehand, with_room
from calibration.discovery.search import Search, diagnose, path, search
from calibration.discovery.settings import FIT, HELD_OUT, WITHOUT_NAME, Settings, settings_for
from calibration.discovery.standing import standing
from calibration.inference import bases as bases_room
from calibration.inference import blocks as blocks_room
from calibration.inference import noise as noise_room
from calibration.inference import observers, preparation, priors, series_noise
from calibration.inference.bases import Bases
from calibration.inference.fit_notes import (
    Copied,
    FarFromPrior,
    HeldByPrior,
    NoiseOff,
    Note,
    Notes,
    NothingVaries,
    OnlyTogether,
    Step,
)
from calibration.inference.fit_posterior import undetermined
from calibration.inference.lack_of_fit import Residuals
from calibration.inference.linearization import Linearization
from calibration.inference.noise import Noise
from calibration.inference.noise_factor import common_factors, noise_remarks
from calibration.inference.residual_clusters import residual_clusters
from mmrjax import effects
from mmrjax.compile.precision import SINGLE, Threads, in_double, is_double
from mmrjax.effects import Effect
from mmrjax.errors import counted
from mmrjax.model import channels
from mmrjax.model.robot import Robot

#: Factors on a noise that nobody states at which the verdict is looked at too: on what is assumed, and on what the
#: table shows.
FACTORS = {"assumed": (0.5, 2.0), "estimated": (0.7, 1.4)}
#: Times that rows are looked through for such as stand alone, with what was found.
SCREENINGS = 4
#: Share of the largest speed or voltage that is no noise about rest [-].
EITHER_WAY = 0.05
#: Sds of a delay from zero from which on it is one.
LATE = 4.0
#: Share of rows set aside beyond which that is said first.
MANY = 0.03
#: Share of the range of a series by which levels differ that are not the same one as measured [-].
LEVEL = 0.02
#: Error of a refit over that of the robot as stated above which it is said [-].
WORSE = 1.1
#: Root of a score from which on it is likely that something is missing, before the bootstrap tells [σ].
LIKELY = 4.0
#: Prior sds beyond which a base parameter is worth a look.
FAR = 3.0
#: Is told what the loop does next.
Tell = Callable[[Note | str], None]


@in_double
def discover(
    runs: Runs,
    robot: Robot,
    *,
    noise: str | None = None,
    stated: Mapping[str, tuple[float, float]] | None = None,
    library: Library = effects.BY_NAME,
    replicates: int = 500,
    seed: int = 0,
    prefer: str = FIT,
    forbidden: Sequence[str] = (),
    rows: int = ROWS,
    progress: Callable[[str], None] = lambda text: None,
    keep: Keep = kept.nothing,
    left: Callable[[], float | None] = lambda: None,
) -> DiscoveryResult:
    """Find what a robot's model lacks against measured runs.

    Args:
        runs: settled runs, or time histories from rest.
        robot: its values are the prior means; a mass that the table states takes the place of its own.
        noise: sds as `noise.parse`; None takes the file's columns, else what series of conditions show,
            or where there are none a usual one, halved and doubled.
        stated: parameter → (mean, sd) [SI], priors in place of the fields'.
        library: effects to look for.
        replicates: of the bootstrap; seed: random seed.
        prefer: by what the leader of a class is chosen, `fit` or `held-out`.
        forbidden: kinds of experiments (`menu.KINDS`) and configurations that are not to be proposed.
        rows: of a log over time from which on readings are used of fewer, evenly in time, which its notes say.
        progress: called with a sentence as the work goes on; keep: by which stages are kept as they end.
        left: time that is left once there is a verdict [s], for which verdicts at other noises are waited; None: all.

    Raises:
        BadData, BadConfiguration: data that contradict themselves or are too few, priors that cannot be, experiments
            that are not known; or a call inside `jax.jit` where JAX is single.
    """
    if not is_double():
        raise BadConfiguration(f"discover: {SINGLE}")
    tell = in_words(progress)
    ready = prepared(
        runs, robot, noise=noise, stated=stated, library=library, replicates=replicates, seed=seed, prefer=prefer,
        forbidden=forbidden, rows=rows,
    )  # fmt: skip
    distinct, known = ready.runs, ready.noise
    for note in ready.at_first:
        tell(note)
    space = pose(distinct, ready.robot, known.sd, ready.settings, ready.stated, ready.library)
    with ahead(space, functools.partial(bases_at, distinct), ready.settings) as later:
        traced, notes = keep("verdict", lambda: ready.trace(progress=tell, later=later, keep=keep)), ready.notes
    silent = channels.names(known.silent)
    factors = FACTORS.get(known.word, ())
    # Verdicts at other noises run the programs of the first one: beside what follows it, on other cores.
    others = Threads(2, kept.BESIDE)
    sensitivity, outstanding = list[Sensitivity](), list[float]()
    try:
        if factors:
            tell(Step("factors", (tuple(f"{f:g}" for f in factors), known.word)))

        def other(factor: float) -> LoopStages:
            noise = known.scaled(dict.fromkeys(silent, factor))
            return keep(f"noise {factor:g}", lambda: ready.trace(noise, known=traced))

        verdicts = {f: others.submit(other, f) for f in factors}
        found = keep(
            "result",
            lambda: assemble_result(traced, distinct, ready.numbers, ready.settings, ready.library, tell),
        )
        if not all(verdict.done() for verdict in verdicts.values()):
            tell(Step("others"))
        for f, verdict in verdicts.items():
            try:
                sensitivity.append(in_short(f, verdict.result(left()), ready.numbers))
            except concurrent.futures.TimeoutError:
                outstanding.append(f)
    finally:  # one that is interrupted, or out of time, waits for none
        others.shutdown(wait=False, cancel_futures=True)
    if outstanding:
        notes = (Outstanding(tuple(outstanding), known.word), *notes)
    assumed = [c for c in known.silent if c not in {s.channel for s in known.along_series}]
    if assumed:
        notes = (*notes, AssumedNoise(channels.names(assumed), noise_room.default(assumed)))
    if known.along_series:
        notes = (*notes, NoiseFromSeries(known.along_series))
    return dataclasses.replace(found, remarks=(*notes, *found.remarks), sensitivity=tuple(sensitivity))


@dataclasses.dataclass(frozen=True)
class LoopInput:
    """What the stages of the loop are given: a table, its robot, and how to look.

    Attributes:
        runs: without copies; numbers: of the rows, as messages call them.
        robot: as `preparation.prepare` leaves it; noise: of the readings; stated: priors (mean, sd) [SI].
        settings: statistical; library: effects to look for.
        notes: what to say of all that; at_first: those that are said before the first fit.
    """

    runs: Runs
    numbers: np.ndarray
    robot: Robot
    noise: Noise
    stated: dict[str, tuple[float, float]]
    settings: Settings
    library: Library
    notes: Notes
    at_first: Notes

    def trace(
        self,
        noise: Noise | None = None,
        progress: Tell = lambda note: None,
        known: LoopStages | None = None,
        later: Callable[[BaseFit], None] = lambda base: None,
        keep: Keep = kept.nothing,
    ) -> LoopStages:
        """The stages up to a verdict, with this noise or another; the others as of the function `trace`."""
        sds = self.noise if noise is None else noise
        return trace(
            self.runs, self.robot, sds, self.settings, self.stated, self.library, progress, known, later, keep
        )


def prepared(
    runs: Runs,
    robot: Robot,
    *,
    noise: str | None = None,
    stated: Mapping[str, tuple[float, float]] | None = None,
    library: Library = effects.BY_NAME,
    replicates: int = 500,
    seed: int = 0,
    prefer: str = FIT,
    forbidden: Sequence[str] = (),
    rows: int = ROWS,
) -> LoopInput:
    """What `discover` does before its first fit; arguments and errors as of `discover`.

    A campaign that wants verdicts alone goes on with `LoopInput.trace`, so that it takes the way that users take.
    """
    menu.check_forbidden(forbidden, robot)
    if not robot.rig.inherits:
        scales.nominal_ahead()
    runs = thinned(runs.of(robot), rows)
    distinct, numbers, notes = without_copies(runs)
    kind = observers.kind(distinct)
    if len(distinct) < kind.fewest:
        raise BadData(
            f"{runs.source}: {counted(len(distinct), kind.word)} cannot show what a model lacks; at least "
            f"{kind.fewest} are needed"
        )
    ready = preparation.prepare(distinct, robot, noise, stated)
    for note in ready.checked:
        if isinstance(note, NothingVaries) or (isinstance(note, Copied) and not note.tied):
            raise BadData(described(note))
    at_first = (*ready.foreign, *ready.doubted)
    said: Notes = (*notes, *ready.checked, *ready.begins, *ready.weighed, *at_first)
    turned = scales.turned_in(distinct, ready.robot)
    own = {name: e for name, e in effects.OF_CHANNELS.items() if e.channel in ready.robot.rig.channels}
    library = {**library, **kind.library, **own}
    library = scales.library_for(ready.robot, distinct.conditions(ready.robot), library, turned)
    settings = dataclasses.replace(settings_for(kind, replicates, seed, prefer), forbidden=tuple(forbidden))
    return LoopInput(distinct, numbers, ready.robot, ready.noise, ready.stated, settings, library, said, at_first)


@dataclasses.dataclass(frozen=True)
class Sds:
    """The noise that a verdict is with.

    Attributes:
        noise: of the readings; factors: of the sds as given by which each channel's were changed, empty for none.
        remarks: what to say of that.
    """

    noise: Noise
    factors: dict[str, float] = dataclasses.field(default_factory=dict)
    remarks: tuple[NoiseOff, ...] = ()


@dataclasses.dataclass(frozen=True)
class LoopStages:
    """What the stages up to a verdict found.

    Attributes:
        verdict: `none`, `named`, `class`, `mechanism`, `place` or `undescribed`.
        screened: the base fit, rows that stand alone set aside; left: what it leaves.
        sds: the noise that the verdict is with.
        searched: what was tried; alike: what cannot be told apart, where a name is given.
        where: something is missing, or remains.
        standing: why names that were looked at do not stand, or what was put beside them.
        held_out: the alternatives compared by data held out, where these chose the leader.
        beside: the curve of what the base leaves, where something is missing.
        predicted: what fits predict of data held out, as of `prediction.smallest`.
        mechanism: where no name stands, established or not.
        missed: channels that the model does not describe; unused: columns that vary and have no role.
    """

    verdict: str
    screened: Screening
    left: Diagnosis
    sds: Sds
    searched: Search | None = None
    alike: Classes | None = None
    where: DiscrepancyLocation | None = None
    standing: NameSupport | None = None
    held_out: tuple[HeldOutAlternative, ...] = ()
    beside: CurveBeside | None = None
    predicted: Predicted = dataclasses.field(default_factory=dict)
    mechanism: Mechanism | None = None
    missed: tuple[Missed, ...] = ()
    unused: tuple[str, ...] = ()

    @property
    def members(self) -> tuple[tuple[str, ...], ...]:
        """Of each effect that is established, those that these data cannot tell from it, itself first."""
        return tuple(m for m, name in zip(self._classes, self._named, strict=True) if name)

    @property
    def _classes(self) -> tuple[tuple[str, ...], ...]:
        return () if self.alike is None else self.alike.members

    @property
    def _named(self) -> list[bool]:
        return [self.standing is None or self.standing.established(m[0]) for m in self._classes]

    @property
    def noise_factor(self) -> float | None:
        """By what factor sds are off, the mean of the channels; None where they are right."""
        return float(np.exp(np.mean(np.log(list(self.sds.factors.values()))))) if self.sds.factors else None

    @property
    def families(self) -> tuple[str, ...]:
        """Families of what is established: of the members of each class, or where something without a name is."""
        if self.alike is not None and self.verdict not in WITHOUT_NAME:
            return tuple(f for each, name in zip(self.alike.families, self._named, strict=True) if name for f in each)
        if self.verdict == "mechanism" and self.mechanism is not None:
            return self.mechanism.families
        return () if self.where is None else (self.where.family,)

    @property
    def events(self) -> tuple[dict[str, Any], ...]:
        """Where something happens for a while: axis and window, and numbers of the rows in it."""
        return () if self.where is None else self._happening(self.where.variable)

    @property
    def events_alike(self) -> tuple[dict[str, Any], ...]:
        """The same of what it cannot be told from."""
        alike = () if self.where is None else self.where.variables_alike
        return tuple(event for variable in alike for event in self._happening(variable))

    def _happening(self, variable: str) -> tuple[dict[str, Any], ...]:
        happens = bases_room.window(variable)
        if happens is None or self.where is None:
            return ()
        linear = self.left.linear
        x, _ = linear.in_travel(self.where.place, happens.axis)
        inside = self.screened.base.space.included & linear.of_rows(happens.holds(x))
        rows = [int(k) + 1 for k in np.flatnonzero(inside)]
        return ({"axis": happens.axis, "window": (happens.low, happens.high), "rows": rows},)

    @property
    def simulated(self) -> dict[tuple[str, ...], np.ndarray]:
        """Coordinates of every fit by simulation, by its effects."""
        every = (self.screened.base.candidate, *(() if self.searched is None else self.searched.ladder))
        return {c.active: c.z for c in reversed(every) if c.simulated and np.isfinite(c.cost)}

    @property
    def best(self) -> Candidate:
        """The candidate that is proposed: the base, where no effect is named."""
        if self.alike is None or self.searched is None or self.searched.best is None:
            return self.screened.base.candidate
        return self.searched.best

    @property
    def ends(self) -> Diagnosis:
        """What that candidate leaves."""
        if self.alike is None or self.searched is None or self.searched.diagnosis is None:
            return self.left
        return self.searched.diagnosis


def trace(
    runs: Runs,
    robot: Robot,
    noise: Noise,
    settings: Settings,
    stated: Mapping[str, tuple[float, float]] | None = None,
    library: Library = effects.BY_NAME,
    progress: Tell = lambda note: None,
    known: LoopStages | None = None,
    later: Callable[[BaseFit], None] = lambda base: None,
    keep: Keep = kept.nothing,
) -> LoopStages:
    """The stages of the loop up to a verdict, in order; the noise is known. `later` is told the base
    fit as soon as something is likely to be missing. What is kept of a stage holds what those before it found, which
    is one whole.

    What replicates of a bootstrap show in units of their own sds hardly depends on these: where the stages of the
    same table with other sds are `known`, and the same rows count, their replicates serve. Fits of histories then
    take a few steps of Gauss and Newton from those. Sets for which their program has no room are not simulated, and
    no row is set aside anew.

    Where residuals are without structure and everywhere as many times the sds, it is the sds that are wrong: the
    stages go through again with such as the residuals show.
    """
    task = _Task(runs, robot, noise, settings, stated, library, progress, known, later, keep)
    ranked = list[Ranking]()
    screened, sds = keep("base", functools.partial(_base, task, ranked))
    screened, left, searched = _searched(task, screened, sds, ranked)
    if searched is None:
        missed = undescribed(screened.base.space, runs, sds.noise, left.linear)
        word = "undescribed" if missed else "none"
        return LoopStages(word, screened, left, sds, missed=missed, unused=unused(runs))
    return _verdict(task, screened, left, sds, searched)


@dataclasses.dataclass(frozen=True)
class _Task:
    """The arguments of `trace`, which its stages share."""

    runs: Runs
    robot: Robot
    noise: Noise
    settings: Settings
    stated: Mapping[str, tuple[float, float]] | None
    library: Library
    progress: Tell
    known: LoopStages | None
    later: Callable[[BaseFit], None]
    keep: Keep

    def screen(self, noise: Noise, near: Candidate | None, ranked: list[Ranking]) -> Screening:
        """The base fit with this noise, from `near` if given, and its outliers; see `windows`."""
        space = pose(self.runs, self.robot, noise.sd, self.settings, self.stated, self.library)
        known, at = self.known, functools.partial(bases_at, self.runs)
        if known is not None and space.bare.observe.long:  # whose rows count here too
            space = dataclasses.replace(space.without(np.array(known.screened.outliers, int)), near=known.simulated)
            self.progress(Step("base"))
            base = fit_base(space, self.settings, self.runs.source, near)
            return same_rows(base, at, known.screened, self.settings)
        if near is None:
            near = self.windows(space, ranked)
        self.progress(Step("base"))
        return screen(fit_base(space, self.settings, self.runs.source, near), at, self.runs, self.settings)

    def windows(self, space: CandidateSpace, ranked: list[Ranking]) -> Candidate | None:
        """Where the base fit begins by the equations of a log in weak form; their ranking of the library is appended
        to `ranked`."""
        found = beforehand(space, self.settings)
        if found is None:
            return None
        make = functools.partial(findings.ranking_beforehand, space, found, self.settings)
        ranked.append(self.keep("ranking", make))
        return found.base


def _base(task: _Task, ranked: list[Ranking]) -> tuple[Screening, Sds]:
    """The base fit and the noise, which is scaled where residuals without structure exceed it by one factor."""
    known, noise = task.known, task.noise
    screened = task.screen(noise, None if known is None else known.screened.base.candidate, ranked)
    residuals = residuals_of(screened, task.runs)
    factors = {} if screened.cluster is not None else common_factors(residuals)
    sds = Sds(noise, factors, tuple(noise_remarks(residuals, noise.word)))
    if factors:
        task.progress(Step("sds"))
        sds = dataclasses.replace(sds, noise=noise.scaled(factors))
        screened = task.screen(sds.noise, screened.base.candidate, ranked)
    return screened, sds


def _tested(task: _Task, sds: Sds, screened: Screening) -> tuple[Screening, Diagnosis]:
    """A base fit with room for the sets of effects that are simulated, and the bootstrap of what it leaves."""
    known, weight = task.known, screened.base.space.weight
    null = None if known is None or np.any(known.screened.base.space.weight != weight) else known.left.test.null
    room = () if known is None else known.screened.base.space.room
    base, (linear, scores, _) = screened.base, screened.diagnosed
    space = base.space.with_room(room)
    if not room:
        space = with_room(base.space, base.candidate, linear, scores, task.settings)
    screened = dataclasses.replace(screened, base=dataclasses.replace(base, space=space))
    if np.max(np.abs(np.asarray(scores.single))) > LIKELY:
        task.later(screened.base)
    return screened, diagnosis_of_base(screened, task.settings, sds.noise.freedom, null)


def _tried(task: _Task, screened: Screening, left: Diagnosis) -> tuple[Screening, Diagnosis, Search]:
    """The search for effects that explain what the base leaves."""
    base = screened.base
    found = search(base.space, base.candidate, left, screened.bases, task.settings, task.progress)
    base = dataclasses.replace(base, space=base.space.with_room(found.room))
    return dataclasses.replace(screened, base=base), left, found


def _searched(
    task: _Task, screened: Screening, sds: Sds, ranked: list[Ranking]
) -> tuple[Screening, Diagnosis, Search | None]:
    """The search, repeated while it leaves outliers; None where the base leaves nothing."""
    settings, keep, progress = task.settings, task.keep, task.progress
    for k in range(SCREENINGS):
        progress(Step("bootstrap", (settings.replicates,)))
        screened, left = keep(f"bootstrap {k}", functools.partial(_tested, task, sds, screened))
        if k == 0 and not ranked:
            keep("ranking", functools.partial(findings.ranking, screened.base.space, left, settings))
        if not left.test.rejected and screened.cluster is None:
            return screened, left, None
        progress(Step("effects"))
        screened, left, searched = keep(f"search {k}", functools.partial(_tried, task, screened, left))
        after = searched.diagnosis
        if after is None or not after.test.rejected_with_margin or screened.base.space.near:
            break
        more = screen_beside(screened, after.scores, lambda base: bases_at(task.runs, base), task.runs, settings)
        if more is None:
            break
        progress(Step("alone"))
        screened = more
    return screened, left, searched


def _verdict(task: _Task, screened: Screening, left: Diagnosis, sds: Sds, searched: Search) -> LoopStages:
    """The verdict where the base leaves something: names, classes, a mechanism or a place."""
    runs, settings, progress = task.runs, task.settings, task.progress
    base, space, bases = screened.base.candidate, screened.base.space, screened.bases
    beside, predicted = CurveBeside(space, base, left, bases), Predicted()
    where = dataclasses.replace(beside.where, by_duty=varied_by_duty(runs))
    model, searched, stood = choose(runs, screened, left, searched, settings, progress, beside, predicted)
    stages = functools.partial(LoopStages, beside=beside, predicted=predicted)
    missed = undescribed(space, runs, sds.noise, left.linear, None if model is None else model[1].linear)
    if missed:
        return stages("undescribed", screened, left, sds, searched, missed=missed, unused=unused(runs))
    named = [] if model is None else [stood.established(e) for e in model[0].effects]
    level, found = "", None
    if not any(named):
        progress(Step("mechanism"))
        ladder = [c for c in (*searched.ladder, *([] if model is None else model[:1]))]
        found = mechanism(space, runs, base, left, ladder, bases, beside, predicted, settings)
        level = "place" if found is None or found.fails else "mechanism"
    if model is None:
        return stages(level, screened, left, sds, searched, where=where, standing=stood, mechanism=found)

    searched = dataclasses.replace(searched, best=model[0], diagnosis=model[1])
    best, after = model
    progress(Step("alike", (best.effects,)))
    alike = classes(space, base, best, searched.ladder, left, after, settings)
    if not any(named):
        return stages(level, screened, left, sds, searched, alike, where, standing=stood, mechanism=found)
    compared: tuple[HeldOutAlternative, ...] = ()
    if settings.prefer == HELD_OUT:
        progress(Step("held out"))
        searched, alike, compared = preference.prefer_by_held_out(space, runs, searched, alike, bases, settings)
        after = searched.diagnosis or after
        stood = stood.renamed(dict(zip(best.active, (searched.best or best).active, strict=True)))
    alone = [len(m) + len(v) == 1 for m, v in zip(alike.members, alike.stated, strict=True)]
    verdict = "named" if all(one for one, name in zip(alone, named, strict=True) if name) else "class"
    remains = locate(after, bases, space.included) if after.test.rejected_with_margin else None
    return stages(verdict, screened, left, sds, searched, alike, remains, standing=stood, held_out=compared)


def choose(
    runs: Runs,
    screened: Screening,
    left: Diagnosis,
    searched: Search,
    settings: Settings,
    progress: Tell,
    beside: CurveBeside,
    predicted: Predicted,
) -> tuple[tuple[Candidate, Diagnosis] | None, Search, NameSupport]:
    """The effects that belong in the model: those whose names stand by themselves, and those of the smallest set that
    predicts as well as any, but what only stands in for a curve; None for none. With what was searched, and which
    names stand.

    Where the largest set leaves nothing its effects are judged, else those of the set that predicts.

    Args:
        left: what the base leaves; beside: its curve.
        predicted: takes what fits predict of data held out.
    """
    base, space, bases = screened.base.candidate, screened.base.space, screened.bases
    best, after, long = searched.best, searched.diagnosis, space.bare.observe.long
    if best is None or after is None:
        return None, searched, standing(space, base, searched, left, bases, settings)
    adequate = not after.test.rejected_with_margin
    kinds = blocks_room.predictable(runs, space.bare)
    blocks = [mask for by in kinds.values() for mask in by.values()]
    asked = functools.partial(standing, space, base, searched, left, bases, settings, blocks=blocks, beside=beside)
    stood = asked() if adequate or long else None
    if stood is not None and all(stood.established(e) for e in best.effects):
        return (best, after), searched, stood
    few = None
    if not (long and stood is not None and stood.stands):  # refits of histories take long
        progress(Step("held out"))
        few = prediction.smallest(space, runs, base, path(searched), predicted)
    if stood is None:
        judged = best if few is None else few
        proposed = judged, after if judged is best else diagnose(space, judged, bases, left.test.null, settings)
        stood = asked(proposed=proposed)
    else:
        proposed = best, after
    names = [e for e in proposed[0].effects if stood.established(e)]
    further = [e for e in (() if few is None else few.effects) if e not in names and not stood.stands_in(e)]
    names += further[: settings.slots - len(names)]
    if not names:
        return None, searched, stood
    every = (proposed[0], best, *(c for c in searched.ladder if c.simulated))
    known = [c for c in every if c.key == frozenset(names)]
    if not known:
        active = filled(names, settings)
        begins = start(space, proposed[0], active, settings, left.scores)
        known = fit_candidates(space, [(active, begins)], settings)
        searched = dataclasses.replace(searched, ladder=(*searched.ladder, *known))
    seen = next((d for c, d in (proposed, (best, after)) if c is known[0]), None)
    return (known[0], seen or diagnose(space, known[0], bases, left.test.null, settings)), searched, stood


# --- the stages that are no room of their own -----------------------------------------------------------


def pose(
    runs: Runs,
    robot: Robot,
    sd: np.ndarray,
    settings: Settings,
    stated: Mapping[str, tuple[float, float]] | None = None,
    library: Library = effects.BY_NAME,
) -> CandidateSpace:
    """The base problem of a table, and room for the effects that its data can show.

    Rows are padded to one of a few sizes, so that tables of about one size share what is compiled; what is padded
    counts for nothing. A mass that the table states takes the place of the robot's own, and the ground may be any
    surface whose friction is not stated: its own prior, of another surface, would pull on what depends on slip.
    """
    robot = own_mass.with_table_mass(robot, runs)
    kind = observers.kind(runs)
    index, real = padded(len(runs), kind.sizes_padded)
    names = priors.free_names(robot, runs.configurations_named(robot), *kind.free())
    coordinates = priors.coordinates(robot, names, dict(stated or {}), any_surface=True)
    bare = observers.pose(runs.where(index), robot, coordinates, sd[index])
    shown = visible(library, robot, kind, both_ways(runs), pulsed(runs))
    space = candidate_space(bare, shown, library, settings.slots, settings.width)
    return space.without(~real)


def visible(
    library: Library,
    robot: Robot,
    kind: type[observers.Observer],
    either_way: bool = True,
    at_duties: bool = False,
) -> tuple[Effect, ...]:
    """The effects of a library that such data can show and the robot does not have yet.

    Args:
        either_way: whether the runs go both ways, see `both_ways`; at_duties: see `pulsed`.
    """
    have = {e.name for e in robot.effects}
    return tuple(
        effect()
        for name, effect in library.items()
        if name not in have
        and kind.shows(effect)
        and scales.present(effect, robot)
        and (either_way or not effect.needs_reverse)
        and (at_duties or not effect.needs_duty)
    )


def pulsed(runs: Runs) -> bool:
    """True if some runs have a duty below 1."""
    duties = [runs[name] for name in ("duty", *SIDES) if runs.has(name)]
    return any((np.abs(x) < 1).any() for x in duties)


def both_ways(runs: Runs) -> bool:
    """Whether runs go forward as well as backward, by any speed that they state or by what drives them."""
    moved = [c.column for c in channels.EVERY if c.zero_at_rest and c.directed]
    columns = [runs[name] for name in (*moved, runs.layout.imposed_column, "duty") if runs.has(name)]
    found = [x[np.isfinite(x)] for x in columns]
    return any(min(x.max(), -x.min()) > EITHER_WAY * np.abs(x).max() for x in found if x.size)


def padded(rows: int, sizes: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Rows with repeats of the first behind them, to the next of `sizes` or a multiple of the last, and which of them
    are real."""
    size = next((s for s in sizes if s >= rows), rows + (-rows % sizes[-1] if sizes else 0))
    index = np.concatenate([np.arange(rows), np.zeros(size - rows, int)])
    return index, np.arange(len(index)) < rows


def bases_at(runs: Runs, base: BaseFit) -> Bases:
    """Bases of curves over the readings of a fit: over measured ones they would share their noise."""
    problem = base.space.bare
    index, _ = padded(len(runs), problem.observe.sizes_padded)
    columns = dict(runs.where(index).columns)
    reading = np.where(np.isfinite(base.reading), base.reading, np.asarray(problem.data.measured))
    columns |= {c.column: reading[:, k] for k, c in enumerate(problem.channels)}
    z = base.candidate.z[: base.space.free]
    observe = problem.observe.at_fit(problem, z)
    return observe.bases(columns, base.space.included, problem.robot(jnp.asarray(z)))


def diagnosis_of_base(
    screened: Screening, settings: Settings, freedom: np.ndarray | None = None, null: Statistics | None = None
) -> Diagnosis:
    """What the base leaves, tested against the bootstrap of itself.

    Args:
        freedom: degrees of freedom of the sd of each channel; null: replicates where they are known.
    """
    space, base = screened.base.space, screened.base.candidate
    linear, scores, found = screened.diagnosed
    if null is None:
        null = bootstrap(
            space.bare, base.z[: space.free], linear, space.library.scored, screened.bases, settings.replicates,
            settings.seed, freedom,
        )  # fmt: skip
    return Diagnosis(linear, scores, AdequacyTest(found, null, settings))


def _once(columns: Sequence[np.ndarray]) -> int:
    """Number of rows after which a table begins anew, row for row."""
    rows = list(zip(*(column.astype(str).tolist() for column in columns), strict=True))
    return next(n for n in range(1, len(rows) + 1) if len(rows) % n == 0 and rows[:-n] == rows[n:])


def without_copies(runs: Runs) -> tuple[Runs, np.ndarray, list[Note]]:
    """The runs without exact copies of one another, their row numbers, and what to say of that.

    Rows that a file tells apart by no name, order or time are repeats, even if a coarse display shows them the same.
    They are copies where the whole table is: the same rows in the same sequence, several times.
    """
    columns = [*(runs[c] for c in observers.kind(runs).identity(runs)), *runs.extras.values()]
    seen: set[tuple[str, ...]] = set()
    keep: list[int] = []
    copies: list[int] = []
    if runs.sampled or {"run_id", *WHEN} & set(runs.headings):
        for k in range(len(runs)):
            row = tuple(str(column[k]) for column in columns)
            (copies if row in seen else keep).append(k)
            seen.add(row)
    else:
        once = _once(columns)
        keep, copies = list(range(once)), list(range(once, len(runs)))
    if not copies:
        return runs, np.arange(1, len(runs) + 1), []
    return runs.where(np.asarray(keep)), np.asarray(keep) + 1, [Copies(tuple(k + 1 for k in copies))]


def in_short(factor: float, traced: LoopStages, numbers: np.ndarray) -> Sensitivity:
    """What the loop says with another noise."""
    adequate = not traced.ends.test.rejected_with_margin
    near = bool(traced.screened.base.space.near)
    return Sensitivity(factor, traced.verdict, summary(traced, numbers), traced.members, adequate, near)


def summary(traced: LoopStages, numbers: np.ndarray) -> Summary:
    """The verdict of these stages, with what else its statement says; `numbers` as of `assemble_result`."""
    space, alike = traced.screened.base.space, traced.alike
    support = None if traced.standing is None else traced.standing.numbered(numbers)
    best = None if traced.searched is None else traced.searched.best
    base = traced.screened.base.candidate
    aside, counting = len(traced.screened.outliers), int(space.included.sum())
    many = aside > MANY * (aside + counting)
    return Summary(
        traced.verdict,
        traced.left.test.p_value,
        traced.where,
        missing=() if alike is None else missing(space, alike, support),
        nearest=best.effects if traced.verdict in WITHOUT_NAME and best is not None else (),
        support=support,
        aside=aside if many else 0,
        of=aside + counting,
        noise=traced.sds.remarks if traced.sds.factors and traced.verdict == "none" else (),
        cluster=traced.screened.cluster,
        mechanism=traced.mechanism,
        missed=traced.missed,
        unused=traced.unused,
        far=tuple(n for n, z in zip(space.coordinates.base.names, base.z[: space.free], strict=True) if abs(z) > FAR),
    )


def missing(space: CandidateSpace, alike: Classes, support: NameSupport | None) -> tuple[Missing, ...]:
    """Each effect in the model, with what it cannot be told from and whether it is established."""
    c, p = space.coordinates.base, space.free
    return tuple(
        Missing(
            names,
            tuple(
                FreedValue(s.name, float(c.value(np.asarray(s.fit.z[:p]))[s.index]), c.units[s.index]) for s in shifts
            ),
            families,
            support is None or support.established(names[0]),
            None if support is None else support.test_of(names[0]),
        )
        for names, shifts, families in zip(alike.members, alike.stated, alike.families, strict=True)
    )


# --- the result -----------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _Written:
    """The fit that a result is about: with the named effects, or with the curve where no name is given.

    Attributes:
        before, after: the fits of the base and of what is proposed, None where that is the base.
        robot: of the fit, with its coordinates z, their sds, its cost, and whether it converged.
        ends: what it leaves; curve, beside: the curve and what remains beside it, where no name is given.
    """

    before: findings.Fitted
    after: findings.Fitted | None
    robot: Robot
    z: np.ndarray
    sd: np.ndarray
    cost: float
    converged: bool
    posterior: Posterior
    ends: Diagnosis
    curve: Discrepancy | None = None
    beside: Diagnosis | None = None

    def or_refit(self, traced: LoopStages, kept: bool) -> _Written:
        """The same where it is `kept`, else with the robot and the posterior of the refit."""
        if kept:
            return self
        space, base = traced.screened.base.space, traced.screened.base.candidate
        posterior = of_fit(space, base.active, base.z, traced.left.linear)
        robot = findings.proposed_robot(space, base)
        return dataclasses.replace(self, robot=robot, converged=base.converged, posterior=posterior)


def _written(traced: LoopStages, progress: Tell) -> _Written:
    """The fit that the result of a verdict is about."""
    space, base, best, ends = traced.screened.base.space, traced.screened.base.candidate, traced.best, traced.ends
    curve = beside = None
    if traced.verdict in WITHOUT_NAME and traced.beside is not None:
        progress(Step("shape"))
        curve, beside = traced.beside.curve, traced.beside.diagnosis
    before = findings.Fitted(*space.fit_of(base.active, base.z))
    if best is base and curve is not None and beside is not None:
        return _Written(
            before, findings.Fitted(curve.problem, curve.z, None), curve.robot, curve.z,
            np.sqrt(np.diag(curve.covariance)), curve.chi2[1] / 2, curve.converged,
            of_curve(space, best.active, curve), beside, curve, beside,
        )  # fmt: skip
    after = None if best is base else findings.Fitted(*space.fit_of(best.active, best.z))
    posterior = of_fit(space, best.active, best.z, ends.linear)
    robot = findings.proposed_robot(space, best)
    return _Written(before, after, robot, best.z, best.sd, best.cost, best.converged, posterior, ends, curve, beside)


def _keeps(traced: LoopStages, written: _Written, gain: prediction.Gain | None) -> bool:
    """True if what is found predicts well enough to be written in place of the refit.

    What is written never predicts worse than the refit; a curve, which claims no cause, has to predict better.
    """
    refit = traced.best is traced.screened.base.candidate
    if gain is None or (written.curve is None and refit):
        return True
    return gain.mean > gain.se if refit else gain.mean >= -prediction.WORSE


def _claims(
    traced: LoopStages, settings: Settings
) -> tuple[tuple[FoundEffect, ...], DiscrepancyLocation | None, tuple[HiddenEffect, ...]]:
    """Effects that a verdict names, the place where something remains, and effects that they may conceal."""
    screened, left, alike = traced.screened, traced.left, traced.alike
    space, base, best = screened.base.space, screened.base.candidate, traced.best
    if alike is None:
        return (), None, ()
    found = findings.found_effects(space, base, best, alike, left.test, settings)
    if traced.verdict in WITHOUT_NAME:
        return found, None, ()
    ask = space.bare.observe.menu and not space.bare.observe.long
    concealed = findings.hidden_effects(space, hidden(space, best, alike, left, traced.ends, settings, ask=ask))
    return found, traced.where, concealed


def assemble_result(
    traced: LoopStages,
    runs: Runs,
    numbers: np.ndarray | None,
    settings: Settings,
    library: Library,
    progress: Tell,
) -> DiscoveryResult:
    """The result of a verdict, with what only now is worth its time: errors held out, and the next experiment."""
    screened, noise = traced.screened, traced.sds.noise
    space, base, best = screened.base.space, screened.base.candidate, traced.best
    included = space.included[: len(runs)]
    numbers = np.arange(1, len(runs) + 1) if numbers is None else numbers
    written = _written(traced, progress)
    progress(Step("errors"))
    known = [traced.predicted.get(prediction.key(c)) for c in (base, best)]
    seen = findings.readings(
        runs, noise.sd, written.before, written.after, known[0], None if best is base else known[1]
    )
    compared = traced.held_out
    nameless = traced.verdict in WITHOUT_NAME
    if traced.alike is not None and not nameless and not compared and not space.bare.observe.long:
        compared = preference.compared(space, runs, best, traced.alike)
    gain = _gain(space, runs, seen)
    kept = _keeps(traced, written, gain)
    written = written.or_refit(traced, kept)
    progress(Step("next"))
    remaining = _residuals(space, runs, written.ends.linear, seen.after, written.z)
    found = _Found(traced, written, seen, compared, gain, kept, remaining)
    result = _result(found, runs, numbers, settings, library)
    # What happens for a while is not everywhere alike.
    of_noise = of_sds(traced.sds, remaining) if traced.sds.factors or not traced.events else ()
    return dataclasses.replace(result, remarks=(*of_noise, *refit_worse(seen, noise, included), *remarks(result)))


@dataclasses.dataclass(frozen=True)
class _Found:
    """Verdict, fit and predictions of which a result is made.

    Attributes:
        seen: readings of every row; compared: alternatives by data held out; remaining: residuals of the fit.
        gain: by how much the fit predicts better than the refit; kept: True if it is written.
    """

    traced: LoopStages
    written: _Written
    seen: ReadingsOfRows
    compared: tuple[HeldOutAlternative, ...]
    gain: prediction.Gain | None
    kept: bool
    remaining: Residuals


def _alternatives(found: _Found, settings: Settings) -> tuple[tuple[Alternative, ...], tuple[Alternative, ...]]:
    """Sets of effects that explain nearly as much, and those of implausible size."""
    traced = found.traced
    ladder = traced.searched.ladder if traced.searched is not None else ()
    ladder = traced.alike.ladder if traced.alike is not None else ladder
    return findings.alternatives(traced.screened.base.space, traced.best, found.written.cost, ladder, settings)


def _unnamed(found: _Found, rows: int) -> UnnamedDiscrepancy | None:
    """The discrepancy that a curve describes, where no name is given."""
    written, where = found.written, found.traced.where
    if written.curve is None or where is None or written.beside is None:
        return None
    return findings.unnamed(written.curve, where, found.traced.left.test.p_value, written.beside.linear, rows)


def _result(about: _Found, runs: Runs, numbers: np.ndarray, settings: Settings, library: Library) -> DiscoveryResult:
    """The result without its remarks."""
    traced, written, seen = about.traced, about.written, about.seen
    screened, left, ends = traced.screened, traced.left, written.ends
    space, base = screened.base.space, screened.base.candidate
    observe, included = space.bare.observe, space.included[: len(runs)]
    error = lambda simulated: findings.errors(space.bare, simulated, seen.measured, seen.sd, included)  # noqa: E731
    near, too_large = _alternatives(about, settings)
    found, remains, concealed = _claims(traced, settings)
    listed = findings.effect_scores(space, left.scores, settings)
    shown = space.library.indices([s.name for s in listed])
    said = summary(traced, numbers)
    return DiscoveryResult(
        verdict=traced.verdict,
        summary=said,
        robot=written.robot,
        refit=findings.proposed_robot(space, base),
        gain=about.gain,
        written=about.kept,
        converged=written.converged,
        posterior=written.posterior,
        runs=runs,
        numbers=numbers,
        included=included,
        outliers=tuple(int(numbers[k]) for k in screened.outliers),
        unusable=tuple(int(numbers[k]) for k in screened.base.unusable),
        effects=found,
        unnamed=_unnamed(about, len(runs)),
        remains=remains,
        next_experiment=findings.next_experiment(_proposal(space, traced, settings)),
        cannot_see=findings.invisible(space, left.scores, settings),
        needs_histories=_needs_histories(library, type(observe)),
        needs_reverse=_needs_reverse(library, runs),
        alternatives=near,
        implausible=too_large,
        hidden=concealed,
        support=said.support,
        cluster=screened.cluster,
        residual_clusters=residual_clusters(about.remaining, settings.seed),
        before=findings.evidence(left.test, adequate=not left.test.rejected),
        after=findings.evidence(ends.test, adequate=not ends.test.rejected_with_margin),
        chi2=(2 * base.cost, 2 * written.cost),
        readings=int(np.sum(space.weight > 0)),
        base_shift=findings.base_shift(space, base.z, written.z, written.sd),
        scores=listed,
        cosine=cosines(space, left.scores)[np.ix_(shown, shown)],
        detail=observe.detail(screened.bases, included, left, ends),
        readings_of_rows=seen,
        errors_as_stated=error(seen.as_stated),
        errors=on_same_rows(seen.before, seen.after, error),
        errors_held_out={k: on_same_rows(*both, error) for k, both in seen.held_out.items()},
        held_out_unpredictable=blocks_room.unpredictable(runs, space.bare),
        held_out_worse=preference.worse(seen.held_out, error),
        alternatives_held_out=about.compared,
        noise=_noise(runs, traced.sds.noise, type(observe)),
        settings=settings,
        replicates=len(left.test.null.single),
    )


def refit_worse(seen: ReadingsOfRows, noise: Noise, included: np.ndarray) -> list[RefitWorse]:
    """Channels whose sds nobody states and that the refit misses by more than the robot as stated does, beyond their
    noise: the estimate gives some readings too large a weight.

    Args:
        included: True for rows that count, shape (rows,).
    """
    found = []
    for k, channel in enumerate(noise.channels):
        rows = included & np.isfinite(seen.measured[:, k] + seen.as_stated[:, k] + seen.before[:, k])
        if noise.source[k] not in noise_room.UNSTATED or not rows.any():
            continue
        stated, refit, size, sd = (
            float(np.sqrt(np.mean(x[rows, k] ** 2)))
            for x in (seen.as_stated - seen.measured, seen.before - seen.measured, seen.measured, noise.sd)
        )
        if refit > WORSE * stated and refit - stated > sd:
            found.append(RefitWorse(channel.name, stated / size, refit / size, noise_room.UNSTATED[noise.source[k]]))
    return found


def on_same_rows(
    before: np.ndarray, after: np.ndarray, error: Callable[[np.ndarray], Errors]
) -> tuple[Errors, Errors]:
    """Errors of readings before and after, over the rows that both fits predict."""
    both = np.isfinite(before) & np.isfinite(after)
    return error(np.where(both, before, np.nan)), error(np.where(both, after, np.nan))


def of_sds(sds: Sds, remaining: Residuals) -> tuple[NoiseOff, ...]:
    """What to say of sds of which something is said before the answer: by what the answer leaves; that they were
    changed, where it leaves what they now say."""
    off = tuple(noise_remarks(remaining, sds.noise.word)) if sds.remarks else ()
    if sds.factors:
        return () if off else sds.remarks
    return off


def _gain(space: CandidateSpace, runs: Runs, seen: ReadingsOfRows) -> prediction.Gain | None:
    """By how much what was found predicts better than the refit; None where nothing can be held out."""
    if not seen.held_out:
        return None
    counts, kinds = space.weight[: len(runs)] > 0, blocks_room.predictable(runs, space.bare)
    before, after = (
        prediction.scored({k: x[when] for k, x in seen.held_out.items()}, seen.measured, seen.sd, counts, kinds)
        for when in (0, 1)
    )
    return after.gain(before)


def residuals_of(screened: Screening, runs: Runs) -> Residuals:
    """What the base fit leaves of every reading."""
    base, free = screened.base, screened.base.space.free
    return _residuals(base.space, runs, screened.diagnosed[0], base.reading, base.candidate.z[:free])


def _residuals(
    space: CandidateSpace, runs: Runs, linear: Linearization, reading: np.ndarray, z: np.ndarray
) -> Residuals:
    """What a fit leaves of every reading.

    Args:
        linear: the fit at z, linearised; reading: what it says of every row [SI], shape (rows or more, channels).
    """
    rows, count = len(runs), len(runs.channels)
    counts = (space.weight[:rows] > 0) & np.isfinite(reading[:rows])
    jacobian = np.asarray(linear.jacobian)[: rows * count, : len(z)]
    whitened = np.where(counts, np.asarray(linear.by_row())[:rows], 0.0)
    return Residuals(
        type(space.bare.observe), runs, reading[:rows], whitened, counts, jacobian, z[: jacobian.shape[1]]
    )


def _proposal(space: CandidateSpace, traced: LoopStages, settings: Settings) -> Proposal | None:
    """What to do next; None where nothing is left to tell apart, or the model does not describe the runs."""
    if traced.verdict == "undescribed":
        return None
    if not space.bare.observe.menu:
        return no_menu(space) if traced.verdict != "none" else None
    if traced.verdict in WITHOUT_NAME and traced.where is not None:
        return denser(space, traced.where, settings)
    return None if traced.alike is None else separating(space, traced.best, traced.alike, settings)


def _needs_histories(library: Library, kind: type[observers.Observer]) -> tuple[str, ...]:
    """Effects of the library that data of this kind cannot show at all, and a history could."""
    return tuple(sorted(name for name, e in library.items() if e.transient and not kind.shows(e)))


def _needs_reverse(library: Library, runs: Runs) -> tuple[str, ...]:
    """Effects of the library that these runs cannot show since they all go one way."""
    return tuple(sorted(name for name, e in library.items() if e.needs_reverse and not both_ways(runs)))


def _noise(runs: Runs, noise: Noise, kind: type[observers.Observer]) -> dict[str, dict[str, object]]:
    """Channel → where its sd comes from, and its median share of the reading [%]."""
    with np.errstate(invalid="ignore"):
        share = 100 * noise.sd / np.maximum(kind.sizes(runs), 1e-12)
    return {
        name: {"source": noise.source[k], "median_percent": float(np.nanmedian(share[:, k]))}
        for k, name in enumerate(channels.names(noise.channels))
        if noise.source[k] != "no readings"
    }


def remarks(found: DiscoveryResult) -> Notes:
    """What a careful engineer would say of this result."""
    said: list[Note] = []
    for rows, why in ((found.unusable, "unusable"), (found.outliers, "outliers")):
        if rows:
            said.append(KeptOut(rows, why))
    far = {name: abs(p.shift_after) for name, p in found.base_shift.items() if abs(p.shift_after) > FAR}
    said += [FarFromPrior(name, x, "loop") for name, x in far.items()]
    held = tuple(name for name in undetermined(found.held_by_prior, found.together) if name not in far)
    said += [HeldByPrior(held)] * bool(held)
    said += [OnlyTogether(found.together)] * bool(found.together)
    said += [NotPredictable(found.held_out_unpredictable)] * bool(found.held_out_unpredictable)
    said += found.residual_clusters
    wave = found.unnamed
    if wave is not None and wave.score_free_in_each_run and wave.score < 0.5 * wave.score_free_in_each_run:
        said.append(PhasesDiffer(wave.score_free_in_each_run, wave.score))
    delay = found.base_shift.get(priors.DELAY)
    if delay is not None and priors.DELAY not in found.robot.rig.stated and abs(delay.after) > LATE * delay.sd_after:
        said.append(Late(delay.after, delay.sd_after))
    if found.remains is not None:
        said.append(StillLacks(found.remains.place, found.remains.variable))
    names = [e.name for e in found.effects]
    for t in () if found.support is None else found.support.tests:
        if t.rests_on is not None and t.effect in names:
            said.append(_rests_on(found, t))
    if not found.written and found.gain is not None:
        said.append(Unwritten(not found.effects, found.gain.mean, found.gain.se))
    said += preference.remarks(found.alternatives_held_out, found.settings.prefer)
    settled, asked = found.replicates, found.settings.replicates
    if settled < 0.9 * asked:
        said.append(LostReplicates(settled, asked))
    if 1 / (1 + settled) > min(found.settings.shares.values()):
        said.append(TooFewReplicates(settled))
    return tuple(said)


def _rests_on(found: DiscoveryResult, test: NameTest) -> RestsOn:
    """What would tell whether a run that an effect rests on is right: it again, and half steps on either side of it
    along a series that it is in."""
    runs = found.runs
    if test.what == "run":
        return RestsOn(test)
    row = int(np.flatnonzero(found.numbers == test.row)[0])
    columns = [c for c in ("configuration", *runs.axes) if runs.has(c)]
    at = {c: str(runs[c][row]) if runs[c].dtype.kind == "U" else float(runs[c][row]) for c in columns}
    for axis in sorted(runs.axes, key=lambda axis: axis != series_noise.FIRST):
        series = next((rows for rows in series_noise.series_of(runs, axis) if row in rows), None)
        x, here = runs[axis][row if series is None else series], float(runs[axis][row])
        beside = levels_beside(np.asarray(x, float), here)
        if beside:
            return RestsOn(test, at, axis, beside)
    return RestsOn(test, at)


def levels_beside(x: np.ndarray, here: float) -> tuple[float, ...]:
    """Levels half a step below and above one of a series, rounded to what a person sets; none where the others do
    not differ from it by `LEVEL` of their range.

    Args:
        x: levels of the series; here: that of the row.
    """
    apart = np.abs(x - here)
    others = apart[apart > LEVEL * np.ptp(x)]
    if not others.size:
        return ()
    unit = 10.0 ** math.floor(math.log10(others.min() / 2))
    step, at = round(others.min() / 2 / unit) * unit, round(here / unit) * unit
    return tuple(float(f"{v:.6g}") for v in (at - step, at + step))
