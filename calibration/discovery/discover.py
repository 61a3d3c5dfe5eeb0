"""The closed loop: its stages in order, see `STAGES`, and its verdicts at other noise levels."""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

from calibration.data import Priors
from calibration.data.columns import ROWS
from calibration.data.effect_file import Library
from calibration.data.input_errors import BadConfiguration
from calibration.data.runs import Runs
from calibration.described import report_in_words
from calibration.discovery import log_stages, loop_input, stages, verdict
from calibration.discovery.assembly import assemble_result
from calibration.discovery.candidates import Candidate
from calibration.discovery.outliers import Screening
from calibration.discovery.result import DiscoveryResult, NoiseVerdict
from calibration.inference import fit_notes, population
from calibration.inference import noise as noise_room
from calibration.inference.optimizers import CORES
from mmrjax import effects
from mmrjax.compile import compiling
from mmrjax.model import channels
from mmrjax.model.robot import Robot

#: Factors on unstated noise for which the verdict is repeated: on an assumed noise, and on one estimated from the
#: table.
FACTORS = {"assumed": (0.5, 2.0), "estimated": (0.7, 1.4)}


@compiling.in_double
def discover(
    runs: Runs,
    robot: Robot,
    *,
    noise: str | None = None,
    stated: Priors | None = None,
    library: Library = effects.BY_NAME,
    replicates: int = 500,
    seed: int = 0,
    forbidden: Sequence[str] = (),
    rows: int = ROWS,
    progress: Callable[[str], None] = lambda text: None,
    keep: population.StoreStage = population.compute_without_storing,
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
    if not compiling.is_double():
        raise BadConfiguration(f"discover: {compiling.SINGLE}")
    tell = report_in_words(progress)
    prepare = functools.partial(
        loop_input.prepare_loop, robot=robot, noise=noise, stated=stated, library=library, replicates=replicates,
        seed=seed, forbidden=forbidden, rows=rows,
    )  # fmt: skip
    ready = prepare(runs)
    given = dataclasses.replace(
        ready, progress=tell, keep=keep, settled=functools.cache(lambda: loop_input.settled_input(ready, prepare))
    )
    for note in ready.at_first:
        tell(note)
    traced = keep("verdict", functools.partial(trace_verdict, given, ahead=True))
    if traced.settled and (table := given.settled()) is not None:
        ready, given = table, dataclasses.replace(table, progress=tell, keep=keep)
    result, sensitivity, outstanding = _with_other_noises(
        ready, traced, lambda: keep("result", lambda: assemble_result(given, traced)), tell, keep, left
    )
    refuted = fit_notes.remarks_with_codes(ready.notes, "lost_motion") if traced.verdict == "none" else ()
    notes = (n for n in ready.notes if n not in refuted)
    remarks = (*_remarks_on_noise(ready.noise, outstanding, notes), *result.remarks)
    return dataclasses.replace(result, remarks=remarks, sensitivity=sensitivity)


def _with_other_noises(
    ready: loop_input.LoopInput,
    traced: verdict.LoopStages,
    assemble: Callable[[], DiscoveryResult],
    tell: Callable[[fit_notes.Remark], None],
    keep: population.StoreStage,
    left: Callable[[], float | None],
) -> tuple[DiscoveryResult, tuple[NoiseVerdict, ...], tuple[float, ...]]:
    """The result, the verdicts at other noises, and the factors of those that the time limit left out.

    Verdicts at other noises use the programs of the first one, so they run on other cores while the result is made.
    """
    base_noise = ready.noise
    silent, factors = channels.channel_names(base_noise.silent), FACTORS.get(base_noise.word, ())
    threads = compiling.Threads(min(2, max(1, CORES - 1)))  # each takes as much memory as the first
    sensitivity, outstanding = list[NoiseVerdict](), list[float]()

    def trace_with_noise(factor: float) -> verdict.LoopStages:
        noise = base_noise.scaled(dict.fromkeys(silent, factor))
        scaled = dataclasses.replace(ready, noise=noise, known=traced)
        return keep(f"noise {factor:g}", functools.partial(trace_verdict, scaled))

    try:
        if factors:
            tell(fit_notes.progress_remark("factors", tuple(f"{f:g}" for f in factors), base_noise.word))
        verdicts = {f: threads.submit(trace_with_noise, f) for f in factors}
        result = assemble()
        if not all(one.done() for one in verdicts.values()):
            tell(fit_notes.progress_remark("others"))
        for f, pending in verdicts.items():
            try:
                other = pending.result(left())
            except concurrent.futures.TimeoutError:
                outstanding.append(f)
                continue
            summary = verdict.verdict_summary(other, ready.numbers)
            adequate = not other.ends.test.rejected_with_margin
            sensitivity.append(NoiseVerdict(f, other.verdict, summary, other.members, adequate))
    finally:  # an interruption or the time limit waits for none of them
        threads.shutdown(wait=False, cancel_futures=True)
    return result, tuple(sensitivity), tuple(outstanding)


def _remarks_on_noise(
    noise: noise_room.Noise, outstanding: tuple[float, ...], notes: Iterable[fit_notes.Remark | str]
) -> fit_notes.Notes:
    """Remarks on verdicts that are outstanding, then `notes`, then remarks on the source of the noise."""
    first = [fit_notes.Remark("outstanding", factors=outstanding, word=noise.word)] if outstanding else []
    assumed, last = [c for c in noise.silent if c not in {s.channel for s in noise.along_series}], []
    if assumed:
        usual = noise_room.default_noise(assumed)
        last.append(fit_notes.Remark("assumed_noise", channels=channels.channel_names(assumed), usual=usual))
    if noise.along_series:
        last.append(fit_notes.Remark("noise_from_series", noise=noise.along_series))
    return (*first, *notes, *last)


# --- the stages -----------------------------------------------------------------------------------------


class Stage(NamedTuple):
    """One stage of the loop.

    Attributes:
        name: name of the stage, and of its file if it is stored.
        inputs: results of earlier stages that it needs.
        function: function of the `LoopInput` and of these results. It returns its results, or `LoopStages` if it
            reaches the verdict.
        results: names of its results.
        stored: True if its results are stored. The search stores each of its rounds.
    """

    name: str
    inputs: tuple[str, ...]
    function: Callable[..., Any]
    results: tuple[str, ...] = ()
    stored: bool = False


def trace_verdict(given: loop_input.LoopInput, ahead: bool = False) -> verdict.LoopStages:
    """Runs the stages of the loop, in the order of `STAGES`, until one reaches the verdict.

    With `ahead`, other cores compile the programs of later stages during the fit of the base.

    If results with other sds are `known` for the same included rows, their bootstrap replicates are reused. In
    units of the sds, the statistics hardly depend on the sds. Logs keep their linear readings.
    """
    with contextlib.ExitStack() as others:
        given = dataclasses.replace(given, others=others if ahead else None, later=[], ranked=[])
        context: dict[str, Any] = {}
        for stage in STAGES:
            run = functools.partial(stage.function, given, *(context[name] for name in stage.inputs))
            outcome = given.keep(stage.name, run) if stage.stored else run()
            if isinstance(outcome, verdict.LoopStages):
                return outcome
            context |= zip(stage.results, outcome if len(stage.results) > 1 else (outcome,), strict=False)
    raise AssertionError("the last stage reaches a verdict")


def trace_known_readings(given: loop_input.LoopInput) -> verdict.LoopStages | None:
    """Runs the stages on the known linear readings of a log, with other noise. None for other tables."""
    shared_stages = given.known
    if (
        shared_stages is None
        or (run := shared_stages.run) is None
        or not shared_stages.screened.base.space.bare.observe.reads
    ):
        return None
    space = shared_stages.screened.base.space
    equations = space.with_noise(given.noise.sd, space.weight)
    confirm = functools.partial(log_stages.smallest_confirmed, run.space) if given.known_room else None
    traced = trace_verdict(dataclasses.replace(given, equations=equations, known=None, confirm=confirm))
    refuted = run.contradicts and traced.verdict != "none"
    return dataclasses.replace(traced, verdict="place") if refuted else traced


def trace_windows(given: loop_input.LoopInput) -> verdict.LoopStages | Candidate | None:
    """Runs the stages on the windows of a log with a long run.

    If they find nothing, the start of a simulated fit, because the readings may still find something. None if a log
    has no windows, or if they give no start.
    """
    if (windows := log_stages.windows_of_log(given)) is None:
        return None
    space = given.space.with_room(given.known_room)
    confirm = functools.partial(log_stages.best_simulated_size, space)
    simulates = given.known is None or given.known_room
    windows = dataclasses.replace(windows, keep=given.kept_apart("windows"), confirm=confirm if simulates else None)
    traced = trace_verdict(windows)
    if (confirmed := log_stages.confirm_windows(given, windows, traced)) is not None:
        return confirmed
    slides = given.robot.has_ground and given.robot.rig.imposed == "voltage"  # which equations do not show
    return None if slides else log_stages.delayed_by_rows(given, traced.screened.base.candidate)


def trace_settled_runs(
    given: loop_input.LoopInput, begin: Candidate | None, screened: Screening
) -> verdict.LoopStages | None:
    """Runs the stages on the settled runs of a log that no fit describes. None for others, or with too few runs."""
    base = screened.base
    if given.shows_unmodelled_backlash or not base.space.bare.observe.long:
        return None
    if begin is not None or base.candidate.converged or (table := given.settled()) is None:
        return None
    for note in table.at_first:
        given.progress(note)
    table = dataclasses.replace(table, progress=given.progress, keep=given.kept_apart("settled"))
    return dataclasses.replace(trace_verdict(table, ahead=True), settled=True)


def trace_readings(
    given: loop_input.LoopInput, begin: Candidate | None, screened: Screening, sds: verdict.VerdictNoise
) -> verdict.LoopStages | None:
    """Runs the stages on the linear readings of a log about its simulated fit, and simulates the model that they
    choose. None for other tables, and for a log with backlash that the robot lacks.
    """
    if given.shows_unmodelled_backlash or not screened.base.space.bare.observe.long:
        return None
    readings = log_stages.readings_of_log(given, screened, sds, bool(given.ranked) or begin is not None)
    return log_stages.confirm_readings(given, readings, screened, sds, trace_verdict(readings))


#: The loop. A log may get its verdict from its windows, its settled runs or its linear readings.
STAGES = (
    Stage("other noise", (), trace_known_readings),
    Stage("windows", (), trace_windows, ("begin",)),
    Stage("base", ("begin",), stages.fit_base_and_noise, ("screened", "sds"), stored=True),
    Stage("settled", ("begin", "screened"), trace_settled_runs),
    Stage("readings", ("begin", "screened", "sds"), trace_readings),
    Stage("search", ("screened", "sds"), stages.search_until_clean, ("screened", "left", "searched")),
    Stage("verdict", ("screened", "left", "sds", "searched"), stages.reach_verdict),
)
