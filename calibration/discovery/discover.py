"""The closed loop, in order: fit, outliers, score tests, adequacy, search, classes, discrepancy, next experiment.

Each stage is a pure function of the results of the stages before it.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from calibration.data import Names, Priors, inferred_facts
from calibration.data.columns import ROWS, SIDES, WHEN
from calibration.data.effect_file import Library
from calibration.data.input_errors import BadConfiguration, BadData
from calibration.data.runs import Runs
from calibration.described import describe, report_in_words
from calibration.discovery import findings, menu, prediction, preference, scales
from calibration.discovery.active_set import CandidateSpace, candidate_space
from calibration.discovery.adequacy import AdequacyTest, Diagnosis
from calibration.discovery.candidates import BaseFit, Candidate, fill_slots, fit_base, fit_candidates, start_of_fit
from calibration.discovery.classes import (
    Classes,
    ammeter_families,
    errors_of_ammeters,
    find_classes,
)
from calibration.discovery.description import missed_channels, remaining_errors, unused_inputs
from calibration.discovery.discrepancy import BaseCurve, locate_discrepancy, location_columns
from calibration.discovery.experiments import Proposal, propose_denser_runs, propose_nothing, propose_separating
from calibration.discovery.hidden import HiddenEffect, find_hidden_effects
from calibration.discovery.location import DiscrepancyLocation, varied_by_duty
from calibration.discovery.log_simulation import LogSimulation, refine_by_simulation, simulate_models
from calibration.discovery.loop_notes import (
    AlternativeValue,
    Mechanism,
    MissedChannel,
    MissingEffect,
    NameSupport,
    NameTest,
    VerdictSummary,
)
from calibration.discovery.loop_posterior import posterior_of_curve, posterior_of_fit
from calibration.discovery.mechanism import cached_hold_out_score, excess_misfit, find_mechanism
from calibration.discovery.outliers import (
    Screening,
    compile_ahead,
    screen_outliers,
    screen_with_effects,
)
from calibration.discovery.prediction import Predicted
from calibration.discovery.result import (
    DiscoveryResult,
    EffectRanking,
    Errors,
    FoundEffect,
    HeldOutAlternative,
    NoiseVerdict,
    ParameterShift,
    ReadingsOfRows,
)
from calibration.discovery.score_tests import StrongestStatistics, bootstrap_statistics
from calibration.discovery.screening import screen_by_weak_form
from calibration.discovery.search import SearchResult, best_of_each_size, diagnose_candidate, search_effects
from calibration.discovery.settings import FIT, HELD_OUT, WITHOUT_NAME, Settings, settings_for
from calibration.discovery.standing import judge_names
from calibration.inference import bases as bases_room
from calibration.inference import blocks as blocks_room
from calibration.inference import noise as noise_room
from calibration.inference import observers, preparation, priors, series_noise
from calibration.inference.bases import Bases
from calibration.inference.conduct import error_after_steps
from calibration.inference.fit_notes import Notes, Remark, progress_remark, remarks_with_codes
from calibration.inference.identifiability import undetermined_names
from calibration.inference.lack_of_fit import Residuals
from calibration.inference.linearization import Linearization
from calibration.inference.noise import Noise
from calibration.inference.noise_factor import common_factors, noise_remarks
from calibration.inference.observers.linear_rows import problem_of_readings
from calibration.inference.observers.windows import Windows, problem_of_windows
from calibration.inference.optimizers import CORES
from calibration.inference.population import StoreStage, compute_without_storing
from calibration.inference.residual_clusters import find_residual_clusters
from calibration.inference.shown_states import MissingStates, state_plan_or_reason
from calibration.inference.simulation_errors import channel_errors
from calibration.inference.weak_form import TENTH, fit_weak_form
from mmrjax import effects, fidelities
from mmrjax.compile.precision import SINGLE, Threads, in_double, is_double
from mmrjax.effects import Effect
from mmrjax.errors import count_noun
from mmrjax.model import channels
from mmrjax.model.robot import Robot

#: Factors on unstated noise for which the verdict is repeated: on an assumed noise, and on one estimated from the
#: table.
FACTORS = {"assumed": (0.5, 2.0), "estimated": (0.7, 1.4)}
#: Number of times that rows are screened for isolated outliers, with the effects found.
SCREENINGS = 4
#: Share of the largest speed or voltage above which a value is not noise about rest [-].
EITHER_WAY = 0.05
#: Size of a delay in its sds from which a note reports it, and as a share of the longest in the equations.
LATE, ENDS = 4.0, 0.9
#: Share of excluded rows above which the summary begins with it.
MANY = 0.03
#: Relative difference of two levels of a series, by its range, above which they are distinct [-].
LEVEL = 0.02
#: Ratio of the error of a refit to that of the robot as stated above which a note reports it [-].
WORSE = 1.1
#: Root of a score from which an effect is probably missing, before the bootstrap's result [σ].
LIKELY = 4.0
#: Distance from the prior above which a note reports a base parameter [prior sd].
FAR = 3.0
#: Steps of its longest run from which a log's verdict comes from its windows: a fit by simulation takes minutes.
LONG = 4000
#: Difference of a delay from whole rows up to which a simulation begins at these [rows].
NEAREST = 0.25
#: Sds of a χ² above its mean up to which a simulated base leaves no more than noise.
CHANCE = 3.0
#: Single effects that are simulated if the best of them leaves a discrepancy in the linear readings.
RIVALS = 3
#: Callback for progress notes.
Tell = Callable[[Remark | str], None]


@in_double
def discover(
    runs: Runs,
    robot: Robot,
    *,
    noise: str | None = None,
    stated: Priors | None = None,
    library: Library = effects.BY_NAME,
    replicates: int = 500,
    seed: int = 0,
    prefer: str = FIT,
    forbidden: Sequence[str] = (),
    rows: int = ROWS,
    progress: Callable[[str], None] = lambda text: None,
    keep: StoreStage = compute_without_storing,
    left: Callable[[], float | None] = lambda: None,
) -> DiscoveryResult:
    """Finds the model error of a robot with respect to measured runs, and traces it to a balance or an effect.

    Args:
        runs: settled runs, or time histories from rest.
        robot: robot model. Its values are the prior means. A mass in the table replaces the robot's mass.
        noise: standard deviations, in the format of `noise.parse_noise`. None: from columns of the file, or else
            estimated from series of conditions, or else assumed, halved and doubled.
        stated: parameter → (mean, sd) [SI]. These priors replace those of the fields.
        library: effects to test.
        replicates: number of bootstrap tables.
        seed: random seed.
        prefer: criterion for the leading effect of a class, `fit` or `held-out`.
        forbidden: kinds of experiments (`menu.KINDS`) and configurations that must not be proposed.
        rows: largest number of rows. Larger tables are thinned evenly: logs in time, tables over their conditions. A
            note reports it.
        progress: callback for progress messages.
        keep: function that stores the result of each finished stage.
        left: time left after the verdict [s] for verdicts at other noise levels. None: no limit.

    Raises:
        BadData, BadConfiguration: data that contradict themselves or are too few, invalid priors, unknown
            experiments, or a call inside `jax.jit` while JAX uses single precision.
    """
    if not is_double():
        raise BadConfiguration(f"discover: {SINGLE}")
    tell = report_in_words(progress)
    prepare = functools.partial(
        prepare_loop, robot=robot, noise=noise, stated=stated, library=library, replicates=replicates, seed=seed,
        prefer=prefer, forbidden=forbidden, rows=rows,
    )  # fmt: skip
    ready = prepare(runs)
    told = dataclasses.replace(ready, progress=tell, keep=keep, prepare=prepare)
    for note in ready.at_first:
        tell(note)
    traced = keep("verdict", lambda: told.trace(ahead=True))
    if traced.settled is not None:
        ready = prepare(traced.settled[0], settled=traced.settled[1])
        told = dataclasses.replace(ready, progress=tell, keep=keep)
    known = ready.noise
    refuted = remarks_with_codes(ready.notes, "lost_motion") if traced.verdict == "none" else ()
    notes: Notes = tuple(n for n in ready.notes if n not in refuted)
    silent = channels.channel_names(known.silent)
    factors = FACTORS.get(known.word, ())
    # Verdicts at other noises use the programs of the first one, so they run in parallel on other cores.
    threads = Threads(min(2, max(1, CORES - 1)))  # each takes as much memory as the first
    sensitivity, outstanding = list[NoiseVerdict](), list[float]()
    try:
        if factors:
            tell(progress_remark("factors", tuple(f"{f:g}" for f in factors), known.word))

        def trace_with_noise(factor: float) -> LoopStages:
            noise = known.scaled(dict.fromkeys(silent, factor))
            return keep(f"noise {factor:g}", dataclasses.replace(ready, noise=noise, known=traced).trace)

        verdicts = {f: threads.submit(trace_with_noise, f) for f in factors}
        found = keep("result", lambda: assemble_result(told, traced))
        if not all(verdict.done() for verdict in verdicts.values()):
            tell(progress_remark("others"))
        for f, verdict in verdicts.items():
            try:
                other = verdict.result(left())
                adequate, summary = not other.ends.test.rejected_with_margin, verdict_summary(other, ready.numbers)
                sensitivity.append(NoiseVerdict(f, other.verdict, summary, other.members, adequate))
            except concurrent.futures.TimeoutError:
                outstanding.append(f)
    finally:  # an interruption or the time limit waits for none of them
        threads.shutdown(wait=False, cancel_futures=True)
    if outstanding:
        notes = (Remark("outstanding", factors=tuple(outstanding), word=known.word), *notes)
    assumed = [c for c in known.silent if c not in {s.channel for s in known.along_series}]
    if assumed:
        notes = (
            *notes,
            Remark(
                "assumed_noise", channels=channels.channel_names(assumed), usual=noise_room.default_noise(assumed)
            ),
        )
    if known.along_series:
        notes = (*notes, Remark("noise_from_series", noise=known.along_series))
    return dataclasses.replace(found, remarks=(*notes, *found.remarks), sensitivity=tuple(sensitivity))


@dataclasses.dataclass(frozen=True)
class LoopInput:
    """Input of the stages of the loop: runs, robot, settings and callbacks.

    Attributes:
        runs: runs without exact copies.
        numbers: row numbers as used in messages.
        robot: robot from `preparation.prepare_input`.
        noise: noise of the readings.
        stated: priors (mean, sd) that replace those of the fields [SI].
        settings: statistical settings.
        library: effects to test.
        notes: remarks on the input.
        at_first: remarks to report before the first fit.
        progress: callback for progress messages.
        keep: function that stores each stage when it ends. A stored stage contains the results of the stages before.
        known: results for the same table with other sds.
        begin: fit of the base of a long log to its windows.
        prepare: function from settled runs that replace a log, and a remark on them, to their input.
        others: open while later programs are compiled on other cores, see `later`. None if there is nothing to
            compile.
    """

    runs: Runs
    numbers: np.ndarray
    robot: Robot
    noise: Noise
    stated: Priors
    settings: Settings
    library: Library
    notes: Notes = ()
    at_first: Notes = ()
    progress: Tell = lambda note: None
    keep: StoreStage = compute_without_storing
    known: LoopStages | None = None
    others: contextlib.ExitStack | None = None
    equations: CandidateSpace | None = None
    confirm: Callable[[Screening, Diagnosis, SearchResult, Noise], SearchResult] | None = None
    begin: Candidate | None = None
    prepare: Callable[..., LoopInput] | None = None
    later: list[Callable[[BaseFit], None]] = dataclasses.field(default_factory=list)

    def trace(self, ahead: bool = False) -> LoopStages:
        """Runs the stages of the loop up to the verdict.

        With `ahead`, later programs are compiled on other cores as soon as the equations of a log are ranked.

        If results with other sds are `known` for the same included rows, their bootstrap replicates are reused. In
        units of the sds, the statistics hardly depend on the sds. Logs keep their linear readings.

        If the residuals have no structure but exceed the sds by the same factor everywhere, the sds are wrong. The
        stages are then repeated with sds estimated from the residuals.
        """
        if (of_readings := self.trace_known_readings()) is not None:
            return of_readings
        by_windows, begin = self.trace_windows()
        if by_windows is not None:
            return by_windows
        ranked = list[EffectRanking]()
        with contextlib.ExitStack() as others:
            base_input = dataclasses.replace(self, others=others if ahead else None, later=[], begin=begin)
            screened, sds = self.keep("base", functools.partial(_fit_base_and_noise, base_input, ranked))
            if not self.shows_unmodelled_backlash and screened.base.space.bare.observe.long:
                described = begin is not None or screened.base.candidate.converged
                settled = None if described else self.trace_settled()
                return settled or _trace_readings(self, screened, sds, bool(ranked) or begin is not None)
            screened, diagnosis, searched = _search_until_clean(base_input, screened, sds, ranked)
            if searched is None:
                missed = missed_channels(screened.base.space, self.runs, sds.noise, diagnosis.linear)
                # A rigid base that leaves only noise refutes a backlash.
                loose = self.shows_unmodelled_backlash and diagnosis.test.rejected
                word = "undescribed" if missed or loose else "none"
                return LoopStages(word, screened, diagnosis, sds, missed=missed, unused=unused_inputs(self.runs))
            if self.confirm is not None:
                searched = self.confirm(screened, diagnosis, searched, sds.noise)
            return _reach_verdict(base_input, screened, diagnosis, sds, searched)

    def trace_known_readings(self) -> LoopStages | None:
        """Stages of the known linear readings of a log with other noise. None for other tables."""
        known = self.known
        if known is None or (run := known.run) is None or not known.screened.base.space.bare.observe.reads:
            return None
        space = known.screened.base.space
        equations = space.with_noise(self.noise.sd, space.weight)
        confirm = functools.partial(_smallest_confirmed, run.space, self.settings) if self.known_room else None
        traced = dataclasses.replace(self, equations=equations, known=None, confirm=confirm).trace()
        refuted = run.contradicts and traced.verdict != "none"
        return dataclasses.replace(traced, verdict="place") if refuted else traced

    def trace_windows(self) -> tuple[LoopStages | None, Candidate | None]:
        """Stages of the windows of a log with a long run, and their fit of its base.

        No stages if the windows find nothing, which readings may still do. Neither if they do not show the states.
        """
        other = self.known is not None and not isinstance(self.known.screened.base.space.bare.observe, Windows)
        if self.equations is not None or other or (equations := equations_of_log(self)) is None:
            return None, None

        confirm = functools.partial(_best_simulated_size, self.space.with_room(self.known_room), self.settings)
        simulates = self.known is None or self.known_room
        equations = dataclasses.replace(
            equations, keep=self.kept_apart("windows"), confirm=confirm if simulates else None
        )
        traced = equations.trace()
        slides = self.robot.has_ground and self.robot.rig.imposed == "voltage"  # which equations do not show
        begin = None if slides else _delayed_by_rows(self, traced.screened.base.candidate)
        return _confirm_by_simulation(self, equations, traced), begin

    def trace_settled(self) -> LoopStages | None:
        """Stages of the settled runs of a log that no fit describes. None if these are too few."""
        if self.prepare is None:
            return None
        try:
            runs, settled = preparation.settled_rows(self.runs.whole, self.robot, "unfitted")
        except BadData:
            return None
        ready = self.prepare(runs, settled=settled)
        for note in ready.at_first:
            self.progress(note)

        table = dataclasses.replace(ready, progress=self.progress, keep=self.kept_apart("settled"))
        return dataclasses.replace(table.trace(ahead=True), settled=(runs, settled))

    def kept_apart(self, word: str) -> StoreStage:
        """Storage of stages apart from those of the log over time. Only the ranking has the same name."""
        return lambda name, make: self.keep(name if name == "ranking" else f"{word} {name}", make)

    @property
    def known_room(self) -> Names:
        """Effects in the simulation program of the known results. Another program takes half a minute to compile."""
        return () if self.known is None or self.known.searched is None else self.known.searched.room

    @functools.cached_property
    def space(self) -> CandidateSpace:
        """Candidate space of the runs."""
        return build_candidate_space(self.runs, self.robot, self.noise.sd, self.settings, self.stated, self.library)

    @property
    def shows_unmodelled_backlash(self) -> bool:
        """True if the log shows backlash but the robot has none."""
        return bool(remarks_with_codes(self.at_first, "lost_motion"))

    def screen(self, noise: Noise, before: BaseFit | None, ranked: list[EffectRanking]) -> Screening:
        """Fits the base with this noise and excludes outliers. `before` is an earlier fit with other noise.

        For logs, the equations in weak form give the start of the fit. Their ranking of the library is appended to
        `ranked`, unless effects would only stand in for a backlash.
        """
        same = noise is self.noise
        space = self.equations or (self if same else dataclasses.replace(self, noise=noise)).space
        at = functools.partial(bases_at_fit, self.runs)
        near = None if before is None else before.candidate
        if before is None:
            if self.begin is not None:  # as near as a simulated fit, and its effects are ranked
                near = dataclasses.replace(self.begin, simulated=True)
            elif (ranking := screen_by_weak_form(space, self.settings)) is not None:
                make = functools.partial(findings.rank_effects_by_weak_form, space, ranking, self.settings)
                if not self.shows_unmodelled_backlash:
                    ranked.append(self.keep("ranking", make))
                near = None if ranking.slides else ranking.base
            if self.others is not None:
                self.later.append(self.others.enter_context(compile_ahead(space, at, self.settings)))
        if self.equations is None or not space.bare.observe.reads:  # linear readings have a fit
            self.progress(progress_remark("base"))
        return screen_outliers(fit_base(space, self.settings, self.runs.source, near), at, self.runs, self.settings)


def prepare_loop(
    runs: Runs,
    robot: Robot,
    *,
    noise: str | None = None,
    stated: Priors | None = None,
    library: Library = effects.BY_NAME,
    replicates: int = 500,
    seed: int = 0,
    prefer: str = FIT,
    forbidden: Sequence[str] = (),
    rows: int = ROWS,
    settled: Notes = (),
) -> LoopInput:
    """Prepares the input of the stages from the arguments of `discover`, and raises its errors.

    A campaign that needs only verdicts continues with `LoopInput.trace`, so it computes the same as the command.
    `settled`: remark on settled runs that replace a log.
    """
    menu.check_forbidden(forbidden, robot)
    runs, of_sides = preparation.rows_to_fit(runs, robot, rows)
    distinct, numbers, notes = remove_copies(runs)
    kind = observers.observer_kind(distinct)
    if len(distinct) < kind.fewest:
        raise BadData(
            f"{runs.source}: {count_noun(len(distinct), kind.word)} cannot show what a model lacks; at least "
            f"{kind.fewest} are needed"
        )
    ready = preparation.prepare_input(distinct, robot, noise, stated, settled=(*settled, *of_sides))
    for note in remarks_with_codes(ready.checked, "nothing_varies", "copied"):
        if note.code == "nothing_varies" or not note.tied:
            raise BadData(describe(note))
    unshown = missing_states_remarks(distinct, ready.robot)
    at_first = (*ready.foreign, *ready.doubted, *unshown, *remarks_with_codes(ready.checked, "lost_motion"))
    notes_so_far: Notes = (
        *notes, *ready.checked, *ready.begins, *ready.weighed, *ready.foreign, *ready.doubted, *unshown
    )  # fmt: skip
    output_turn = scales.output_rotation(distinct, ready.robot)
    channel_effects = {name: e for name, e in effects.OF_CHANNELS.items() if e.channel in ready.robot.rig.channels}
    library = {**library, **kind.library, **channel_effects}
    library = scales.scale_library(ready.robot, distinct.conditions(ready.robot), library, output_turn)
    settings = dataclasses.replace(
        settings_for(kind, replicates, seed, prefer),
        forbidden=tuple(forbidden),
        silent=tuple(c.name for c in ready.noise.silent),
    )
    return LoopInput(
        distinct, numbers, ready.robot, ready.noise, ready.stated, settings, library, notes_so_far, at_first
    )


def missing_states_remarks(runs: Runs, robot: Robot) -> list[Remark]:
    """Remark on a log that does not show the states of its equations."""
    read = {k: c for k, c in enumerate(runs.channels) if runs.sampled and np.isfinite(runs.measured()[:, k]).any()}
    plan = state_plan_or_reason(robot, read) if read else None
    return [Remark("unshown", source=runs.source, why=plan.value)] if isinstance(plan, MissingStates) else []


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


@dataclasses.dataclass(frozen=True)
class LoopStages:
    """Results of the stages of the loop up to the verdict.

    Attributes:
        verdict: `none`, `named`, `class`, `mechanism`, `place` or `undescribed`.
        screened: base fit without outliers.
        left: diagnosis of the base fit.
        sds: noise behind the verdict.
        searched: result of the search for effects.
        alike: alternatives to the effects found, if effects are named.
        where: location of the discrepancy, or of the rest that the effects leave.
        standing: tests of the effects' names.
        held_out: alternatives ordered by hold-out error, if these errors chose the leading effect.
        beside: smooth curve of the discrepancy of the base, if there is one.
        predicted: hold-out predictions of fits, as from `prediction.smallest_predictive_set`.
        mechanism: equation and driving variable, if no effect is established. They need not be established either.
        missed: channels that the refit does not describe. For other verdicts than `undescribed`, with the error that
            remains after adding effects.
        unused: numeric columns that vary and have no role.
        settled: settled runs that replace a log, and a remark on them.
    """

    verdict: str
    screened: Screening
    left: Diagnosis
    sds: VerdictNoise
    searched: SearchResult | None = None
    alike: Classes | None = None
    where: DiscrepancyLocation | None = None
    standing: NameSupport | None = None
    held_out: tuple[HeldOutAlternative, ...] = ()
    beside: BaseCurve | None = None
    predicted: Predicted = dataclasses.field(default_factory=dict)
    mechanism: Mechanism | None = None
    missed: tuple[MissedChannel, ...] = ()
    unused: Names = ()
    run: LogSimulation | None = None
    settled: tuple[Runs, Notes] | None = None

    @property
    def members(self) -> tuple[Names, ...]:
        """For each established effect, the effect and those that the data cannot separate from it."""
        return tuple(m for m, name in zip(self._classes, self._named, strict=True) if name)

    @property
    def _classes(self) -> tuple[Names, ...]:
        return () if self.alike is None else self.alike.members

    @property
    def _named(self) -> list[bool]:
        return [self.standing is None or self.standing.established(m[0]) for m in self._classes]

    @property
    def families(self) -> Names:
        """Families of the members of each established class, or of the location of a discrepancy without a name."""
        if self.alike is not None and self.verdict not in WITHOUT_NAME:
            return tuple(
                f for members, name in zip(self.alike.families, self._named, strict=True) if name for f in members
            )
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


def _fit_base_and_noise(given: LoopInput, ranked: list[EffectRanking]) -> tuple[Screening, VerdictNoise]:
    """Fits the base. If its residuals have no structure but exceed the noise by one factor, rescales the noise."""
    known_stages, noise = given.known, given.noise
    screened = given.screen(noise, None if known_stages is None else known_stages.screened.base, ranked)
    base, free = screened.base, screened.base.space.free
    residuals = _residual_tests(base.space, given.runs, screened.diagnosed[0], base.reading, base.candidate.z[:free])
    skip = screened.cluster is not None or not base.space.bare.observe.reads
    factors = {} if skip else common_factors(residuals)
    sds = VerdictNoise(noise, factors, tuple(noise_remarks(residuals, noise.word)))
    if factors:
        given.progress(progress_remark("sds"))
        sds = dataclasses.replace(sds, noise=noise.scaled(factors))
        screened = given.screen(sds.noise, screened.base, ranked)
    return screened, sds


def _test_base(given: LoopInput, sds: VerdictNoise, screened: Screening) -> tuple[Screening, Diagnosis]:
    """Tests the base fit by bootstrap. The returned fit also has a program for the sets of effects to be
    simulated.
    """
    known_stages, weight = given.known, screened.base.space.weight
    null = (
        None
        if known_stages is None or np.any(known_stages.screened.base.space.weight != weight)
        else known_stages.left.test.null
    )
    if np.max(np.abs(np.asarray(screened.diagnosed[1].single))) > LIKELY:
        for begin in given.later:
            begin(screened.base)
    return screened, diagnose_base_by_bootstrap(screened, given.settings, sds.noise.freedom, null)


def _search_effects(
    given: LoopInput, screened: Screening, left: Diagnosis
) -> tuple[Screening, Diagnosis, SearchResult]:
    """Searches for effects that explain the residuals of the base fit."""
    base = screened.base
    searched = search_effects(base.space, base.candidate, left, screened.bases, given.settings, given.progress)
    return screened, left, searched


def _search_until_clean(
    given: LoopInput, screened: Screening, sds: VerdictNoise, ranked: list[EffectRanking]
) -> tuple[Screening, Diagnosis, SearchResult | None]:
    """Searches for effects, again whenever new outliers appear. No search if the base fits, or if the log shows
    backlash that the robot lacks.
    """
    settings, keep, progress = given.settings, given.keep, given.progress
    for k in range(SCREENINGS):
        progress(progress_remark("bootstrap", settings.replicates))
        screened, diagnosis = keep(f"bootstrap {k}", functools.partial(_test_base, given, sds, screened))
        if k == 0 and not ranked and not given.shows_unmodelled_backlash:
            keep("ranking", functools.partial(findings.rank_library, screened.base.space, diagnosis, settings))
        if given.shows_unmodelled_backlash or (not diagnosis.test.rejected and screened.cluster is None):
            return screened, diagnosis, None  # effects of the library would only stand in for a backlash
        progress(progress_remark("effects"))
        screened, diagnosis, searched = keep(
            f"search {k}", functools.partial(_search_effects, given, screened, diagnosis)
        )
        after = searched.diagnosis
        if after is None or not after.test.rejected_with_margin:
            break
        more = screen_with_effects(
            screened, after.scores, lambda base: bases_at_fit(given.runs, base), given.runs, settings
        )
        if more is None:
            break
        progress(progress_remark("alone"))
        screened = more
    return screened, diagnosis, searched


def _reach_verdict(
    given: LoopInput, screened: Screening, left: Diagnosis, sds: VerdictNoise, searched: SearchResult
) -> LoopStages:
    """Verdict on a base with a discrepancy: effects, classes of effects, a mechanism, or a place."""
    runs, settings, progress = given.runs, given.settings, given.progress
    base, space, bases = screened.base.candidate, screened.base.space, screened.bases
    beside, predicted = BaseCurve(space, base, left, bases), Predicted()
    location = dataclasses.replace(beside.where, by_duty=varied_by_duty(runs))
    model, searched, stood = choose_effects(runs, screened, left, searched, settings, progress, beside, predicted)
    stages = functools.partial(LoopStages, beside=beside, predicted=predicted)
    leaves: tuple[MissedChannel, ...] = ()
    if missed := missed_channels(space, runs, sds.noise, left.linear):
        progress(progress_remark("held out"))
        refit = cached_hold_out_score(space, runs, base, predicted)
        fits = {c.key: c for c in (model[0] if model else None, searched.best, *best_of_each_size(searched)) if c}
        for fit in fits.values():
            leaves = remaining_errors(space, runs, missed, refit, cached_hold_out_score(space, runs, fit, predicted))
            if leaves:
                break
        else:
            return stages("undescribed", screened, left, sds, searched, missed=missed, unused=unused_inputs(runs))
        stages = functools.partial(stages, missed=leaves)
    established_names = [] if model is None else [stood.established(e) for e in model[0].effects]
    level, mechanism = "", None
    if not any(established_names):
        progress(progress_remark("mechanism"))
        ladder = [c for c in (*searched.ladder, *([] if model is None else model[:1]))]
        mechanism = find_mechanism(space, runs, base, left, ladder, bases, beside, predicted, settings)
        mechanism = mechanism and _with_ammeter_alternatives(space, mechanism, left.linear, bases, location, settings)
        level = "place" if mechanism is None or mechanism.fails else "mechanism"
    if model is None:
        return stages(level, screened, left, sds, searched, where=location, standing=stood, mechanism=mechanism)

    searched = dataclasses.replace(searched, best=model[0], diagnosis=model[1])
    best, after = model
    progress(progress_remark("alike", best.effects))
    alike = find_classes(space, base, best, searched.ladder, left, after, settings)
    if not any(established_names):
        return stages(level, screened, left, sds, searched, alike, location, standing=stood, mechanism=mechanism)
    compared: tuple[HeldOutAlternative, ...] = ()
    if settings.prefer == HELD_OUT:
        progress(progress_remark("held out"))
        searched, alike, compared = preference.prefer_by_held_out(space, runs, searched, alike, bases, settings)
        after = searched.diagnosis or after
        stood = stood.with_leaders(dict(zip(best.active, (searched.best or best).active, strict=True)))
    alone = all(one for one, name in zip(alike.alone, established_names, strict=True) if name)
    verdict = "named" if alone else "class"
    remains = locate_discrepancy(after, bases, space.included) if after.test.rejected_with_margin else None
    return stages(verdict, screened, left, sds, searched, alike, remains, standing=stood, held_out=compared)


def _with_ammeter_alternatives(
    space: CandidateSpace,
    found: Mechanism,
    linear: Linearization,
    bases: Bases,
    where: DiscrepancyLocation,
    settings: Settings,
) -> Mechanism:
    """The mechanism with ammeter errors that explain the data as well, see `ammeter_families`.

    Args:
        linear: linearization of the base fit.
        where: location of its discrepancy. It defines the curve of a mechanism without effects.
    """
    columns = np.asarray(linear.signatures)[:, [space.library.names[k] in found.effects for k in space.library.of]]
    columns = columns if found.effects else location_columns(linear, bases, where)
    fit = np.asarray(linear.jacobian), np.asarray(linear.residual)
    also = ammeter_families(space, *fit, columns, found.families[0], settings)
    families = tuple(dict.fromkeys((*found.families, *also)))
    return dataclasses.replace(found, families=families, ammeter=errors_of_ammeters(space, families))


def choose_effects(
    runs: Runs,
    screened: Screening,
    left: Diagnosis,
    searched: SearchResult,
    settings: Settings,
    progress: Tell,
    beside: BaseCurve,
    predicted: Predicted,
) -> tuple[tuple[Candidate, Diagnosis] | None, SearchResult, NameSupport]:
    """Effects to add to the model (None for no effects), the updated search, and the tests of their names.

    The effects are those whose names are established, and those of the smallest set that predicts as well as any.
    Effects that only imitate a curve are left out. If the largest set leaves no discrepancy, its effects are tested,
    otherwise those of the predictive set.

    Args:
        left: diagnosis of the base fit.
        beside: smooth curve of its discrepancy.
        predicted: cache of hold-out predictions of fits. This function adds to it.
    """
    base, space, bases = screened.base.candidate, screened.base.space, screened.bases
    best, after = searched.best, searched.diagnosis
    if best is None or after is None:
        return None, searched, judge_names(space, base, searched, left, bases, settings)
    adequate = not after.test.rejected_with_margin
    kinds = blocks_room.predictable_blocks(runs, space.bare)
    blocks = [mask for blocks_by_name in kinds.values() for mask in blocks_by_name.values()]
    support_of = functools.partial(
        judge_names, space, base, searched, left, bases, settings, blocks=blocks, beside=beside
    )
    stood = support_of() if adequate else None
    if stood is not None and all(stood.established(e) for e in best.effects):
        return (best, after), searched, stood
    progress(progress_remark("held out"))
    few = prediction.smallest_predictive_set(space, runs, base, best_of_each_size(searched), predicted)
    if stood is None:
        judged = best if few is None else few
        proposed = (
            judged,
            after if judged is best else diagnose_candidate(space, judged, bases, left.test.null, settings),
        )
        stood = support_of(proposed=proposed)
    else:
        proposed = best, after
    names = [e for e in proposed[0].effects if stood.established(e)]
    added_effects = [
        e for e in (() if few is None else few.effects) if e not in names and not stood.imitates_curve(e)
    ]
    names += added_effects[: settings.slots - len(names)]
    if not names:
        return None, searched, stood
    fits_of_names = [c for c in (proposed[0], best, *searched.ladder) if c.key == frozenset(names)]
    if not fits_of_names:
        active = fill_slots(names, settings)
        begins = start_of_fit(space, proposed[0], active, settings, left.scores)
        fits_of_names = fit_candidates(space, [(active, begins)], settings)
        searched = dataclasses.replace(searched, ladder=(*searched.ladder, *fits_of_names))
    diagnosis = next((d for c, d in (proposed, (best, after)) if c is fits_of_names[0]), None)
    return (
        (fits_of_names[0], diagnosis or diagnose_candidate(space, fits_of_names[0], bases, left.test.null, settings)),
        searched,
        stood,
    )


def equations_of_log(given: LoopInput) -> LoopInput | None:
    """The same input with the windows of a log as its table. None if the log does not show its states, or if its
    longest run has fewer than `LONG` steps.

    Windows use every row of a log, except for an angle alone. Simulations use fewer.
    """
    space, runs, sd, numbers = given.space, given.runs.whole, given.noise.sd, given.numbers
    observe: Any = space.bare.observe
    if not observe.long or observe.times.shape[1] < LONG:
        return None
    bare = space.bare
    motions = [c.settled for c in bare.channels if c.zero_at_rest]
    # With every row of an angle alone, the class of EMPS is tentative, and a pendulum leaves twice its noise.
    if given.runs.log is not None and (any(motions) or not motions):
        sd = np.broadcast_to(np.median(sd, 0), runs.measured().shape)
        bare, numbers = observers.pose_problem(runs, bare.base, bare.coordinates, sd), np.arange(1, len(runs) + 1)
        observe = bare.observe
    fit = fit_weak_form(bare, space.library.scored)
    if fit is None:
        return None

    def columns(rows: np.ndarray) -> dict[str, np.ndarray]:
        table = {name: x[rows] for name, x in runs.columns.items() if x.dtype.kind == "f"}
        return {**table, "configuration": np.asarray(observe.of_rows.configuration)[rows]}

    settings = given.settings
    posed, rows = problem_of_windows(bare, fit, space.library.scored, columns, settings.width)
    table = candidate_space(posed, space.library.effects, given.library, settings.slots, settings.width)
    noise = dataclasses.replace(given.noise, sd=sd[rows])
    shares = settings_for(type(posed.observe), settings.replicates).shares
    return dataclasses.replace(
        given, runs=runs.where(rows), numbers=numbers[rows], noise=noise, equations=table, known=None,
        settings=dataclasses.replace(settings, shares=shares),
    )  # fmt: skip


def _trace_readings(given: LoopInput, screened: Screening, sds: VerdictNoise, ranked: bool) -> LoopStages:
    """Stages of a log whose readings are linear about the simulated fit of its base, and the simulation of the model
    that they choose.

    Args:
        screened, sds: simulated fit of the base, and its noise.
        ranked: True if the effects have been ranked.
    """
    space, settings, measured = screened.base.space, given.settings, given.runs.measured()
    weight = space.weight.copy()
    weight[list(screened.outliers)] = np.isfinite(measured[list(screened.outliers)])
    problem = space.with_noise(None, weight).bare
    z = screened.base.candidate.z[: space.free]
    posed = problem_of_readings(problem, z, space.library.scored, settings.width)
    equations = candidate_space(posed, space.library.effects, given.library, settings.slots, settings.width)
    apart = given.kept_apart("readings")

    def keep(name: str, make: Callable[[], Any]) -> Any:
        """Stores a stage apart, except a second ranking."""
        return None if ranked and name == "ranking" else apart(name, make)

    confirm = functools.partial(_smallest_confirmed, space, settings)
    table = dataclasses.replace(
        given, equations=equations, noise=sds.noise, known=None, keep=keep, confirm=confirm
    )  # fmt: skip
    traced = table.trace()
    if not traced.sds.factors:
        traced = dataclasses.replace(
            traced, sds=dataclasses.replace(traced.sds, factors=sds.factors, remarks=sds.remarks)
        )
    linear = traced.screened.base
    space = space.with_noise(traced.sds.noise.sd, linear.space.weight)
    given.progress(progress_remark("confirm"))
    best = _chosen_fit(traced)
    space = space if traced.searched is None else space.with_room(traced.searched.room)
    run = simulate_models(space, linear.candidate, best, settings, screened.base.candidate)
    traced = dataclasses.replace(traced, run=run)
    if traced.searched is None:
        return traced
    confirmed = traced.left.test.confirmed(max(0.0, 2 * (run.base.cost - run.best.cost)))
    if not confirmed.rejected and traced.screened.cluster is None:
        left = dataclasses.replace(traced.left, test=confirmed)
        none = dataclasses.replace(run, best=run.base, promised=0.0, gained=0.0)
        return LoopStages("none", traced.screened, left, traced.sds, run=none)
    return _lower_if_contradicted(table, traced)


def _smallest_confirmed(
    space: CandidateSpace, settings: Settings, screened: Screening, left: Diagnosis, searched: SearchResult,
    noise: Noise,
) -> SearchResult:  # fmt: skip
    """The search with the smallest set whose simulation leaves no discrepancy, or else the largest set.

    The diagnosis is that of its simulation.

    Readings are linear near the fit of the base only. A large effect therefore leaves residuals that another one
    would explain.

    Args:
        space: space of the simulated log. If it has room for effects, only sets of these are simulated.
        screened, left, searched: linear fit of the base, its diagnosis, and the search from it.
        noise: noise of the readings.
    """
    best = searched.best
    if best is None or searched.diagnosis is None:
        return searched
    if len(best.effects) == 1 and not searched.diagnosis.test.rejected_with_margin:
        return searched
    alone = sorted((c for c in searched.ladder if len(c.effects) == 1 and c.plausible), key=lambda c: c.cost)
    sizes = [alone[:RIVALS], *([c] for c in best_of_each_size(searched) if len(c.effects) > 1)]
    sizes = [[c for c in sets if _has_room(space, c)] for sets in sizes]
    space = space.with_noise(noise.sd, screened.base.space.weight)
    space = space.with_room([*space.room, *(name for sets in sizes for c in sets for name in c.effects)])
    for sets in filter(None, sizes):
        fits = [refine_by_simulation(space, c, [c.z], settings) for c in sets]
        k = min(range(len(fits)), key=lambda k: fits[k].cost)
        diagnosis = diagnose_candidate(space, fits[k], screened.bases, left.test.null, settings, left.linear)
        searched = dataclasses.replace(searched, best=sets[k], diagnosis=diagnosis, room=space.room)
        if not diagnosis.test.rejected_with_margin:
            break
    return searched


def _has_room(space: CandidateSpace, fit: Candidate) -> bool:
    """True if the program of a log's simulations has room for a set of effects, or has not been determined."""
    return not space.room or {*fit.effects} <= {*space.room}


def _best_simulated_size(
    space: CandidateSpace, settings: Settings, screened: Screening, left: Diagnosis, searched: SearchResult,
    noise: Noise,
) -> SearchResult:  # fmt: skip
    """The search in the windows of a log with the largest set that lowers the misfit of a simulation.

    Windows of many rows have the power for a second effect, whose simulation may leave more than that of the first.

    Args: as for `_smallest_confirmed`, of the windows. The noise of the simulated log is that of `space`.
    """
    sets = [c for c in best_of_each_size(searched) if _has_room(space, c)]
    space = space.with_room([*space.room, *(name for c in sets for name in c.effects)])
    searched = dataclasses.replace(searched, room=space.room)
    if len(sets) < 2:
        return searched
    costs = [refine_by_simulation(space, c, [c.z], settings).cost for c in sets]
    best = sets[int(np.argmin(costs))]
    if best is searched.best:
        return searched
    diagnosis = diagnose_candidate(screened.base.space, best, screened.bases, left.test.null, settings)
    return dataclasses.replace(searched, best=best, diagnosis=diagnosis)


def _chosen_fit(traced: LoopStages) -> Candidate:
    """Fit of the verdict: the proposal, or else the best set of its mechanism."""
    base, searched, mechanism = traced.screened.base.candidate, traced.searched, traced.mechanism
    if searched is None or traced.best is not base:
        return traced.best
    named = frozenset(() if mechanism is None else mechanism.effects)
    return min(searched.ladder, key=lambda c: (c.key != named, not c.plausible, c.cost))


def _delayed_by_rows(given: LoopInput, fit: Candidate) -> Candidate:
    """The fit of a log's windows with a delay of whole rows, if that is near.

    A held quantity jumps at its rows. So a fast current jumps too as a function of the delay, and steps from one side
    do not lead to the other.
    """
    coordinates, steps = given.space.coordinates.base, np.diff(given.runs.whole["time_s"])
    if priors.DELAY not in coordinates.names or given.robot.rig.between_rows == "linear":
        return fit
    k, step = coordinates.names.index(priors.DELAY), float(np.median(steps[steps > 0]))
    delay = float(coordinates.value(fit.z[: given.space.free])[k])
    off = round(delay / step) * step - delay
    if abs(off) > NEAREST * step:
        return fit
    return dataclasses.replace(fit, z=fit.z + np.eye(len(fit.z))[k] * off / float(coordinates.spread[k]))


def _lower_if_contradicted(windows: LoopInput, traced: LoopStages) -> LoopStages:
    """Stages whose claim falls by one level if the simulation gains too little of what the equations promised."""
    run, screened, left, searched, beside = traced.run, traced.screened, traced.left, traced.searched, traced.beside
    if run is None or searched is None or beside is None or not run.contradicts or traced.verdict == "place":
        return traced
    if traced.verdict == "mechanism" and traced.mechanism is not None:  # a curve is not simulated
        return dataclasses.replace(traced, verdict="place") if traced.mechanism.effects else traced
    mechanism = find_mechanism(
        screened.base.space, windows.runs, screened.base.candidate, left, searched.ladder, screened.bases, beside,
        traced.predicted, windows.settings,
    )  # fmt: skip
    level = "place" if mechanism is None or mechanism.fails else "mechanism"
    return dataclasses.replace(traced, verdict=level, mechanism=mechanism, where=beside.where)


def _confirm_by_simulation(given: LoopInput, windows: LoopInput, traced: LoopStages) -> LoopStages | None:
    """Stages of a log's windows after the simulation of the base model and of the chosen one.

    None if nothing is missing: in the windows, or because the simulated base leaves no more than noise or the effects
    gain no more than chance there. If they gain less than half of what the windows promised, the claim falls by one
    level. No effect is named if the simulation misses a channel.
    """
    screened, left, searched, beside = traced.screened, traced.left, traced.searched, traced.beside

    def undescribed(missed: tuple[MissedChannel, ...]) -> LoopStages:
        return LoopStages("undescribed", screened, left, traced.sds, searched, beside=beside, run=traced.run,
                          predicted=traced.predicted, missed=missed, unused=unused_inputs(given.runs))  # fmt: skip

    if given.known is not None:  # only the noise differs
        if given.known.verdict == "undescribed":
            return undescribed(given.known.missed)
        refuted = given.known.run is not None and given.known.run.contradicts
        return dataclasses.replace(traced, verdict="place") if refuted and traced.verdict != "none" else traced
    if searched is None or beside is None:
        return None
    given.progress(progress_remark("confirm"))
    chosen, base = _chosen_fit(traced), _delayed_by_rows(given, screened.base.candidate)
    best = base if chosen is screened.base.candidate else _delayed_by_rows(given, chosen)
    run = simulate_models(given.space.with_room(searched.room), base, best, given.settings, disturbed=True)
    confirmed = left.test.confirmed(max(0.0, 2 * (run.base.cost - run.best.cost)))
    noise = CHANCE * math.sqrt(2 * float(np.sum(run.space.weight > 0)))
    if not confirmed.rejected or (not run.disturbed and excess_misfit(run.space, run.base) < noise):
        return None
    traced = dataclasses.replace(traced, run=run)
    linear = (run.diagnosis(x, left).linear for x in (run.base, run.best))
    refit, fit = (missed_channels(run.space, given.runs, given.noise, x) for x in linear)
    return undescribed(refit) if fit else _lower_if_contradicted(windows, traced)


# --- stages without a module of their own ---------------------------------------------------------------


def build_candidate_space(
    runs: Runs,
    robot: Robot,
    sd: np.ndarray,
    settings: Settings,
    stated: Priors | None = None,
    library: Library = effects.BY_NAME,
) -> CandidateSpace:
    """Base problem of a table, with slots for the effects that its data can reveal.

    Tables are padded with rows of weight 0 to one of a few sizes, so that tables of similar size share compiled
    programs. A mass in the table replaces the robot's mass. Ground friction without a stated prior gets a wide one
    for any surface, because the prior of a wrong surface would bias parameters that depend on slip.
    """
    robot = inferred_facts.with_table_mass(robot, runs)
    kind = observers.observer_kind(runs)
    index, real = padded_rows(len(runs), kind.sizes_padded)
    idle = (
        *(() if kind.axis else priors.OVER_TIME),
        *(f"{n}.mass" for n in inferred_facts.stated_masses(robot, runs)),
    )
    names = priors.loop_parameter_names(robot, runs.configurations_named(robot), *kind.free(), idle)
    unread = fidelities.unread_parameters("drive" if kind.axis else "steady", names, runs.turns)
    names = tuple(n for n in names if n not in unread)
    coordinates = priors.parameter_coordinates(robot, names, dict(stated or {}), any_surface=True)
    bare = observers.pose_problem(runs.where(index), robot, coordinates, sd[index])
    visible = visible_effects(library, robot, kind, goes_both_ways(runs), has_partial_duty(runs))
    space = candidate_space(bare, visible, library, settings.slots, settings.width)
    return space.without(~real)


def visible_effects(
    library: Library,
    robot: Robot,
    kind: type[observers.Observer],
    either_way: bool = True,
    at_duties: bool = False,
) -> tuple[Effect, ...]:
    """Effects of a library that this kind of data can reveal and that the robot does not have yet.

    Args:
        either_way: True if there are forward and backward runs, see `goes_both_ways`.
        at_duties: True if some runs have a duty below 1, see `has_partial_duty`.
    """
    have = {e.name for e in robot.effects}
    return tuple(
        effect()
        for name, effect in library.items()
        if name not in have
        and kind.shows(effect)
        and scales.effect_applies(effect, robot)
        and (either_way or not effect.needs_reverse)
        and (at_duties or not effect.needs_duty)
    )


def has_partial_duty(runs: Runs) -> bool:
    """True if some runs have a duty below 1, so that the supply is pulsed."""
    duties = [runs[name] for name in ("duty", *SIDES) if runs.has(name)]
    return any((np.abs(x) < 1).any() for x in duties)


def goes_both_ways(runs: Runs) -> bool:
    """True if there are forward and backward runs, according to a measured speed or the command."""
    motion_columns = [c.column for c in channels.EVERY if c.zero_at_rest and c.directed]
    columns = [runs[name] for name in (*motion_columns, runs.layout.imposed_column, "duty") if runs.has(name)]
    finite_columns = [x[np.isfinite(x)] for x in columns]
    return any(min(x.max(), -x.min()) > EITHER_WAY * np.abs(x).max() for x in finite_columns if x.size)


def padded_rows(rows: int, sizes: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Row indices, padded to the next larger length in `sizes` (or to a multiple of the largest) by repeating
    the first row.

    Also returns True for each index that is not padding.
    """
    size = next((s for s in sizes if s >= rows), rows + (-rows % sizes[-1] if sizes else 0))
    index = np.concatenate([np.arange(rows), np.zeros(size - rows, int)])
    return index, np.arange(len(index)) < rows


def bases_at_fit(runs: Runs, base: BaseFit) -> Bases:
    """Bases of smooth curves over the fitted readings. Curves over measured readings would share their noise."""
    problem, z, active = base.space.fit_of(base.candidate.active, base.candidate.z)
    problem = problem if active is None else base.space.problem(base.candidate.active)
    index, _ = padded_rows(len(runs), problem.observe.sizes_padded)
    columns = dict(runs.where(index).columns)
    reading = np.where(np.isfinite(base.reading), base.reading, np.asarray(problem.data.measured))
    columns |= {c.column: reading[:, k] for k, c in enumerate(problem.channels)}
    observe = problem.observe.at_fit(problem, z)
    return observe.bases(columns, base.space.included, problem.robot(jnp.asarray(z)))


def diagnose_base_by_bootstrap(
    screened: Screening,
    settings: Settings,
    freedom: np.ndarray | None = None,
    null: StrongestStatistics | None = None,
) -> Diagnosis:
    """Diagnosis of the base fit, tested against a bootstrap of this fit.

    Args:
        freedom: degrees of freedom of the sd of each channel.
        null: statistics of the bootstrap replicates. None: they are computed here.
    """
    space, base = screened.base.space, screened.base.candidate
    linear, scores, statistics = screened.diagnosed
    if null is None:
        null = bootstrap_statistics(
            space.bare, base.z[: space.free], linear, space.library.scored, screened.bases, settings.replicates,
            settings.seed, freedom,
        )  # fmt: skip
    return Diagnosis(linear, scores, AdequacyTest(statistics, null, settings))


def remove_copies(runs: Runs) -> tuple[Runs, np.ndarray, list[Remark]]:
    """Runs without exact copies, their row numbers, and remarks on the copies.

    Equal rows may be repeated measurements, for instance from a coarse display. They count as copies only if the
    whole table consists of the same sequence of rows, repeated.
    """
    columns = [*(runs[c] for c in observers.observer_kind(runs).identity(runs)), *runs.extras.values()]
    seen_columns: set[Names] = set()
    keep: list[int] = []
    copies: list[int] = []
    if runs.sampled or {"run_id", *WHEN} & set(runs.headings):
        for k in range(len(runs)):
            row = tuple(str(column[k]) for column in columns)
            (copies if row in seen_columns else keep).append(k)
            seen_columns.add(row)
    else:
        rows = list(zip(*(column.astype(str).tolist() for column in columns), strict=True))
        # rows after which the table repeats itself exactly, or all of its rows
        first_rows = next(n for n in range(1, len(rows) + 1) if len(rows) % n == 0 and rows[:-n] == rows[n:])
        keep, copies = list(range(first_rows)), list(range(first_rows, len(runs)))
    if not copies:
        return runs, np.arange(1, len(runs) + 1), []
    return runs.where(np.asarray(keep)), np.asarray(keep) + 1, [Remark("copies", rows=tuple(k + 1 for k in copies))]


def verdict_summary(traced: LoopStages, numbers: np.ndarray) -> VerdictSummary:
    """Data of the statement of a verdict. `numbers`: row numbers as used in messages."""
    space, alike = traced.screened.base.space, traced.alike
    support = None if traced.standing is None else traced.standing.with_row_numbers(numbers)
    best = None if traced.searched is None else traced.searched.best
    base = traced.screened.base.candidate
    aside, counting = len(traced.screened.outliers), int(space.included.sum())
    many = aside > MANY * (aside + counting)
    return VerdictSummary(
        traced.verdict,
        traced.left.test.p_value,
        traced.where,
        missing=() if alike is None else missing_effects(space, alike, support),
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


def missing_effects(space: CandidateSpace, alike: Classes, support: NameSupport | None) -> tuple[MissingEffect, ...]:
    """Effects that the search added to the model, each with its alternatives and whether it is established."""
    c, p = space.coordinates.base, space.free
    return tuple(
        MissingEffect(
            names,
            tuple(
                AlternativeValue(s.name, float(c.value(np.asarray(s.fit.z[:p]))[s.index]), c.units[s.index])
                for s in shifts
            ),
            families,
            support is None or support.established(names[0]),
            None if support is None else support.test_of(names[0]),
        )
        for names, shifts, families in zip(alike.members, alike.stated, alike.families, strict=True)
    )


# --- the result -----------------------------------------------------------------------------------------


def assemble_result(given: LoopInput, traced: LoopStages) -> DiscoveryResult:
    """Result of the loop. Computes the hold-out errors and the next experiment."""
    runs, numbers, settings, progress = given.runs, given.numbers, given.settings, given.progress
    screened, diagnosis, noise = traced.screened, traced.left, traced.sds.noise
    space, base, best, ends = screened.base.space, screened.base.candidate, traced.best, traced.ends
    nameless = traced.verdict in WITHOUT_NAME
    decided, shown = (space, best), diagnosis
    if (run := traced.run) is not None:
        best = run.base if best is base else run.best
        noise = noise if space.bare.observe.reads else given.noise
        space, base, traced = run.space, run.base, dataclasses.replace(traced, predicted={})
        shown, ends = run.diagnosis(base, diagnosis), run.diagnosis(best, ends)
    observe, included = space.bare.observe, space.included[: len(runs)]
    # The fit of the result: with the named effects, or with the curve if no name is given.
    beside = traced.beside if nameless and run is None else None
    if beside is not None:
        progress(progress_remark("shape"))
    before, curve = findings.FittedProblem(*space.fit_of(base.active, base.z)), None
    after, z, sd, cost = None, best.z, best.sd, best.cost
    if beside is not None and best is base:
        curve, ends = beside.curve, beside.diagnosis
        z, sd, cost = curve.z, np.sqrt(np.diag(curve.covariance)), curve.chi2[1] / 2
        after = findings.FittedProblem(curve.problem, z, None)
    elif best is not base:
        after = findings.FittedProblem(*space.fit_of(best.active, z))
    progress(progress_remark("errors"))
    predictions = [traced.predicted.get(prediction.candidate_key(c)) for c in (base, best)]
    kinds = blocks_room.predictable_blocks(runs, space.bare)
    row_readings = findings.readings_of_rows(
        runs, noise.sd, kinds, before, after, predictions[0], None if best is base else predictions[1]
    )
    compared = traced.held_out
    if traced.alike is not None and not nameless and not compared and not observe.long:
        compared = preference.compare_alternatives(space, runs, best, traced.alike)
    gains = _hold_out_gains(space, runs, traced, row_readings)
    gain = gains[-1][1] if gains and after is not None else None
    # What is written never predicts worse than the refit. A curve, which claims no cause, has to predict better.
    written = gain is None or (gain.mean > gain.se if best is base else gain.mean >= -prediction.WORSE)
    if written and curve is not None:
        robot, converged, posterior = curve.robot, curve.converged, posterior_of_curve(space, best.active, curve)
    else:
        fit, of_fit = (best, ends) if written else (base, shown)
        robot, converged = findings.proposed_robot(space, fit), fit.converged
        posterior = posterior_of_fit(space, fit.active, fit.z, of_fit.linear)
    progress(progress_remark("next"))
    remaining = _residual_tests(space, runs, ends.linear, row_readings.after, z)

    def error(simulated: np.ndarray) -> Errors:
        simulated = np.where(included[:, None], simulated, np.nan)
        return channel_errors(space.bare.channels, simulated, row_readings.measured, row_readings.sd)

    ladder = () if traced.searched is None else (traced.alike or traced.searched).ladder
    cost_there = decided[1].cost if curve is None else cost
    near, too_large = findings.listed_alternatives(*decided, cost_there, ladder, settings)
    found: tuple[FoundEffect, ...] = ()
    concealed: tuple[HiddenEffect, ...] = ()
    if traced.alike is not None:
        named, base_there = dataclasses.replace(best, cost=decided[1].cost), screened.base.candidate
        found = findings.found_effects(decided[0], base_there, named, traced.alike, diagnosis.test, settings)
        if not nameless and run is None:
            ask = observe.menu and not observe.long
            concealed = find_hidden_effects(space, best, traced.alike, diagnosis, traced.ends, settings, ask=ask)
    scores = findings.effect_scores(decided[0], diagnosis.scores, settings)
    summary, kind = verdict_summary(traced, numbers), type(observe)
    result = DiscoveryResult(
        verdict=traced.verdict,
        summary=summary,
        robot=robot,
        refit=findings.proposed_robot(space, base),
        gains=gains,
        written=written,
        converged=converged,
        posterior=posterior,
        runs=runs,
        numbers=numbers,
        included=included,
        outliers=tuple(int(numbers[k]) for k in screened.outliers if screened.base.space.bare.observe.reads),
        unusable=tuple(int(numbers[k]) for k in screened.base.unusable),
        effects=found,
        unnamed=None
        if beside is None or traced.where is None
        else findings.unnamed_discrepancy(beside, traced.where, diagnosis.test.p_value, len(runs)),
        remains=None if nameless or traced.alike is None else traced.where,
        next_experiment=_next_experiment(decided[0], traced, settings),
        cannot_see=findings.invisible_effects(decided[0], diagnosis.scores, settings),
        needs_histories=tuple(sorted(name for name, e in given.library.items() if e.transient and not kind.shows(e))),
        needs_reverse=tuple(
            sorted(name for name, e in given.library.items() if e.needs_reverse and not goes_both_ways(runs))
        ),
        alternatives=near,
        implausible=too_large,
        hidden=concealed,
        support=summary.support,
        cluster=screened.cluster,
        residual_clusters=find_residual_clusters(remaining, settings.seed),
        before=findings.evidence_of_test(diagnosis.test, adequate=not diagnosis.test.rejected),
        after=findings.evidence_of_test(ends.test, adequate=not ends.test.rejected_with_margin),
        chi2=(2 * base.cost, 2 * cost),
        readings=int(np.sum(space.weight > 0)),
        base_shift=findings.parameter_shifts(space, base.z, z, sd),
        scores=scores,
        detail=observe.detail(screened.bases, included, shown, ends),
        readings_of_rows=row_readings,
        errors_as_stated=error(row_readings.as_stated),
        errors=errors_on_common_rows(row_readings.before, row_readings.after, error),
        errors_held_out={
            k: errors_on_common_rows(*error_pair, error) for k, error_pair in row_readings.held_out.items()
        },
        held_out_unpredictable=blocks_room.unpredictable_kinds(runs, space.bare),
        held_out_worse=preference.worse_predictions(row_readings.held_out, error),
        alternatives_held_out=compared,
        noise=_noise_by_channel(runs, noise, kind),
        settings=settings,
        replicates=len(diagnosis.test.null.single),
    )
    # A temporary change is not uniform.
    is_event = traced.where is not None and bases_room.window_from_name(traced.where.variable) is not None
    of_noise = () if is_event and not traced.sds.factors else noise_remarks_before_verdict(traced.sds, remaining)
    if run is not None and run.contradicts:
        of_noise = (Remark("contradicted", promised=run.promised, gained=run.gained), *of_noise)
    return dataclasses.replace(
        result, remarks=(*of_noise, *worse_than_stated(row_readings, noise, included), *loop_remarks(result))
    )


def worse_than_stated(seen: ReadingsOfRows, noise: Noise, included: np.ndarray) -> list[Remark]:
    """Remarks on channels that the refit describes worse than the robot file did, by more than the noise.

    Their assumed noise then gives some other readings too much weight. Channels with stated noise are not reported.

    Args:
        included: True for included rows, shape (rows,).
    """
    worse_channels = []
    for k, channel in enumerate(noise.channels):
        rows = included & np.isfinite(seen.measured[:, k] + seen.as_stated[:, k] + seen.before[:, k])
        if noise.source[k] not in noise_room.UNSTATED or not rows.any():
            continue
        file_misfit, refit, size, sd = (
            float(np.sqrt(np.mean(x[rows, k] ** 2)))
            for x in (seen.as_stated - seen.measured, seen.before - seen.measured, seen.measured, noise.sd)
        )
        if refit > WORSE * file_misfit and refit - file_misfit > sd:
            worse_channels.append(
                Remark(
                    "refit_worse",
                    channel=channel.name,
                    stated=file_misfit / size,
                    refit=refit / size,
                    word=noise_room.UNSTATED[noise.source[k]],
                )
            )
    return worse_channels


def errors_on_common_rows(
    before: np.ndarray, after: np.ndarray, error: Callable[[np.ndarray], Errors]
) -> tuple[Errors, Errors]:
    """Errors of two sets of readings, over the readings that both fits predict."""
    in_both = np.isfinite(before) & np.isfinite(after)
    return error(np.where(in_both, before, np.nan)), error(np.where(in_both, after, np.nan))


def noise_remarks_before_verdict(sds: VerdictNoise, remaining: Residuals) -> tuple[Remark, ...]:
    """Remarks on wrong sds to report before the verdict: from the residuals of the final fit, or, if those agree with
    the sds, that the sds were changed.
    """
    off = tuple(noise_remarks(remaining, sds.noise.word)) if sds.remarks else ()
    if sds.factors:
        return () if off else sds.remarks
    return off


def _hold_out_gains(
    space: CandidateSpace, runs: Runs, traced: LoopStages, seen: ReadingsOfRows
) -> tuple[tuple[Names, prediction.Gain], ...]:
    """Hold-out gain of each set of effects over the refit, ordered by the number of effects. The proposal is last.

    Empty if no block can be held out.
    """
    if not seen.held_out:
        return ()
    counts, kinds = space.weight[: len(runs)] > 0, blocks_room.predictable_blocks(runs, space.bare)
    refit, proposal = ({k: x[when] for k, x in seen.held_out.items()} for when in (0, 1))
    by_set = {tuple(filter(None, active)): reading for (active, _), reading in traced.predicted.items()}
    sets = sorted((names for names in by_set if names and names != traced.best.effects), key=len)
    scored = [*((names, by_set[names]) for names in sets), (traced.best.effects, proposal)]
    score = functools.partial(
        prediction.score_readings, measured=seen.measured, sd=seen.sd, counts=counts, kinds=kinds
    )
    return tuple((names, score(reading).gain(score(refit))) for names, reading in scored)


def _residual_tests(
    space: CandidateSpace, runs: Runs, linear: Linearization, reading: np.ndarray, z: np.ndarray
) -> Residuals:
    """Residuals of a fit, with their statistics, by channel.

    Args:
        linear: linearization of the fit at z.
        reading: simulated reading of each row [SI], shape (rows or more, channels).
    """
    rows, count = len(runs), len(runs.channels)
    counts = (space.weight[:rows] > 0) & np.isfinite(reading[:rows])
    jacobian = np.asarray(linear.jacobian)[: rows * count, : len(z)]
    whitened = np.where(counts, np.asarray(linear.by_row())[:rows], 0.0)
    return Residuals(
        type(space.bare.observe), runs, reading[:rows], whitened, counts, jacobian, z[: jacobian.shape[1]]
    )


def _next_experiment(space: CandidateSpace, traced: LoopStages, settings: Settings) -> Proposal | None:
    """Next experiment. None if there are no alternatives to separate, or if the model does not describe the runs."""
    if traced.verdict == "undescribed":
        return None
    if not space.bare.observe.menu or space.bare.base.rig.follows_goal:
        return propose_nothing(space) if traced.verdict != "none" else None
    if traced.verdict in WITHOUT_NAME and traced.where is not None:
        return propose_denser_runs(space, traced.where, settings)
    return None if traced.alike is None else propose_separating(space, traced.best, traced.alike, settings)


def _noise_by_channel(runs: Runs, noise: Noise, kind: type[observers.Observer]) -> dict[str, dict[str, object]]:
    """Source and median relative size [%] of the sd of each channel."""
    with np.errstate(invalid="ignore"):
        share = 100 * noise.sd / np.maximum(kind.sizes(runs), 1e-12)
    return {
        name: {"source": noise.source[k], "median_percent": float(np.nanmedian(share[:, k]))}
        for k, name in enumerate(channels.channel_names(noise.channels))
        if noise.source[k] != "no readings"
    }


def loop_remarks(found: DiscoveryResult) -> Notes:
    """Remarks on the result that help to judge it."""
    remarks: list[Remark] = []
    for rows, why in ((found.unusable, "unusable"), (found.outliers, "outliers")):
        if rows:
            remarks.append(Remark("kept_out", rows=rows, why=why))
    far = {name: abs(p.shift_after) for name, p in found.base_shift.items() if abs(p.shift_after) > FAR}
    remarks += [Remark("far_from_prior", name=name, sds=x, kind="loop") for name, x in far.items()]
    undetermined = tuple(name for name in undetermined_names(found.held_by_prior, found.together) if name not in far)
    remarks += [Remark("held_by_prior", names=undetermined)] * bool(undetermined)
    remarks += [Remark("only_together", pairs=found.together)] * bool(found.together)
    remarks += [Remark("residual_cluster", cluster=c) for c in found.residual_clusters]
    after = found.readings_of_rows.after if found.written else found.readings_of_rows.before
    off = np.where(found.included[:, None], after - found.readings_of_rows.measured, np.nan)
    remarks += error_after_steps(found.runs, off)
    wave = found.unnamed
    if wave is not None and wave.score_free_in_each_run and wave.score < 0.5 * wave.score_free_in_each_run:
        remarks.append(Remark("phases_differ", free=wave.score_free_in_each_run, held=wave.score))
    delay = found.base_shift.get(priors.DELAY)
    remarks += delay_remarks(found.runs, delay, priors.DELAY in found.robot.rig.stated) if delay is not None else []
    if found.remains is not None:
        remarks.append(Remark("still_lacks", place=found.remains.place, variable=found.remains.variable))
    names = [e.name for e in found.effects]
    doubtful = [t for t in (found.support.tests if found.support else ()) if t.rests_on is not None]
    remarks += [_repeat_row_remark(found, t) for t in doubtful if t.effect in names and not t.changed]
    different = [t for t in doubtful if t.changed]
    if different:
        remarks.append(Remark("run_differs", test=max(different, key=lambda t: t.root_changed)))
    if not found.written and found.gain is not None:
        remarks.append(Remark("unwritten", curve=not found.effects, gain=found.gain.mean, se=found.gain.se))
    settled, replicates_asked = found.replicates, found.settings.replicates
    if settled < 0.9 * replicates_asked:
        remarks.append(Remark("lost_replicates", settled=settled, asked=replicates_asked))
    if 1 / (1 + settled) > min(found.settings.shares.values()):
        remarks.append(Remark("too_few_replicates", settled=settled))
    return tuple(remarks)


def delay_remarks(runs: Runs, delay: ParameterShift, stated: bool) -> list[Remark]:
    """Remark on a delay that the robot's file does not state, or that is as long as the search of the equations."""
    limit = TENTH * float(np.median([runs["time_s"][rows].max() for rows in runs.rows_by_run().values()]))
    ends = abs(delay.after) > ENDS * limit
    if abs(delay.after) <= LATE * delay.sd_after or (stated and not ends):
        return []
    return [Remark("late", delay=delay.after, sd=delay.sd_after, ends=ends)]


def _repeat_row_remark(found: DiscoveryResult, test: NameTest) -> Remark:
    """Remark that proposes an experiment if an effect depends on a single row: repeat the row, and add rows half a
    step away from it.
    """
    runs = found.runs
    row = int(np.flatnonzero(found.numbers == test.row)[0])
    columns = [c for c in ("configuration", *runs.axes) if runs.has(c)]
    conditions_there = {c: str(runs[c][row]) if runs[c].dtype.kind == "U" else float(runs[c][row]) for c in columns}
    for axis in sorted(runs.axes, key=lambda axis: axis != series_noise.FIRST):
        series = next((rows for rows in series_noise.series_along(runs, axis) if row in rows), None)
        x, value_of_row = runs[axis][row if series is None else series], float(runs[axis][row])
        beside = neighbouring_levels(np.asarray(x, float), value_of_row)
        if beside:
            return Remark("rests_on", test=test, conditions=conditions_there, axis=axis, beside=beside)
    return Remark("rests_on", test=test, conditions=conditions_there)


def neighbouring_levels(x: np.ndarray, here: float) -> tuple[float, ...]:
    """Levels half a step below and above one level of a series, rounded to practical values.

    Empty if all other levels are closer than `LEVEL` of the range of the series.

    Args:
        x: levels of the series.
        here: level of the run.
    """
    apart = np.abs(x - here)
    other_levels = apart[apart > LEVEL * np.ptp(x)]
    if not other_levels.size:
        return ()
    unit = 10.0 ** math.floor(math.log10(other_levels.min() / 2))
    step, level = round(other_levels.min() / 2 / unit) * unit, round(here / unit) * unit
    return tuple(float(f"{v:.6g}") for v in (level - step, level + step))
