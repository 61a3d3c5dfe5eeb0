"""The command `loop`: from a table of runs to what the model lacks, and a robot that has it."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from rich.table import Table

from calibration.data import effect_file, robot_file
from calibration.data.columns import Layout
from calibration.described import in_words
from calibration.discovery import findings
from calibration.discovery.discover import discover
from calibration.discovery.kept import REFIT_FILE, OutOfTime
from calibration.discovery.resolve import check_resolvable, resolve
from calibration.discovery.result import DiscoveryResult, Ranking
from calibration.discovery.settings import fewest_replicates
from calibration.inference import blocks, observers, priors
from calibration.inference.simulation_errors import OF_SIZE
from calibration.words import loop_words
from calibration.words.step_words import expected_time
from sweeps import config as configuration
from sweeps.console import print_message, print_output, step_reporter
from sweeps.inputs import load_robot, read_runs
from sweeps.pages import words
from sweeps.skeleton import finish_run_folder, page_writer
from sweeps.store import SOLVER_FAILED, RunFolder, open_folder

T = TypeVar("T")
#: File of what regression says before anything is confirmed, and its schema.
SCREENING_FILE, SCREENING = "screening.json", "mmrjax.screening/1"


def run_loop(
    config: configuration.Loop,
    source: str,
    out: Path | None,
    force: bool,
    members: Path | None = None,
    within: float | None = None,
) -> int:
    """Run the closed loop on a table and leave a run folder; returns the exit code.

    0 done, whatever the verdict; 3 done, but the fit that is proposed did not converge, or its time was out before
    there was a verdict. Stages are kept as they end, so that the same command goes on after that, or an interrupt.

    Args:
        within: wall-clock time after which it ends with the best that there is [s].
    """
    try:
        return _loop(config, source, out, force, members, within)
    except OutOfTime:
        return SOLVER_FAILED


def _loop(
    config: configuration.Loop, source: str, out: Path | None, force: bool, members: Path | None, within: float | None
) -> int:
    began = time.monotonic()
    robot = load_robot(config).robot
    runs = read_runs(source, robot, columns=config.columns, measured=True, series=True)
    stated = priors.parse_priors(config.prior)
    if config.resolve:
        check_resolvable(runs, members)
    replicates = max(config.replicates, fewest_replicates(observers.observer_kind(runs)))

    stages: dict[str, Any] = {}

    def left() -> float | None:
        return None if within is None else max(within - (time.monotonic() - began), 0.0)

    def timed(text: str) -> None:
        used = time.monotonic() - began
        more = expected_time(text, used)
        print_message(f"{used:4.0f} s  {text}{'' if more is None else f' (about {more:.0f} s more)'}")

    with (
        open_folder("loop", config, robot, out, force, runs) as folder,
        step_reporter(timed, "preparing the table") as heard,
    ):

        def progress(text: str) -> None:
            heard(text)
            if left() == 0.0 and "verdict" not in stages:
                raise OutOfTime

        def keep(name: str, make: Callable[[], T]) -> T:
            found = stages[name] = folder.stage(name, make)
            if name == "ranking":
                _show_ranking(stages[name], folder, timed)
            if name == "verdict":
                timed(f"{loop_words.verdict_line(stages[name])}; next, errors held out and other noises")
            return found

        try:
            with _alarm(left(), lambda: "verdict" not in stages):
                found = discover(
                    runs, robot, rows=config.rows, noise=config.noise or None, stated=stated,
                    library=effect_file.effect_library(config.effects), replicates=replicates, seed=config.seed,
                    prefer=config.prefer, forbidden=config.forbid, progress=progress, keep=keep, left=left,
                )  # fmt: skip
        except KeyboardInterrupt as ended:
            if isinstance(ended, OutOfTime):
                _say_out_of_time(within or 0.0, begun=bool(stages))
            _say_kept(stages, folder, config.robot)
            raise
        if config.resolve:
            found = _resolved(found, config, members, progress)
        print_discovery(found)
        if config.resolve and found.resolved is None:
            print_output(
                "The track model was not asked: nothing remains in slip, track or ground that it has a say in."
            )
        found.save(folder.results(), config.robot, folder.tables)
        if config.report:
            progress("writing the report")
        manifest = {"seed": config.seed, "verdict": found.verdict}
        shown = page_writer("loop", found, robot_name=config.robot)
        return finish_run_folder(folder, config, manifest, solved=found.converged, page=shown, runs=found.runs)


def _resolved(
    found: DiscoveryResult, config: configuration.Loop, members: Path | None, progress: Callable[[str], None]
) -> DiscoveryResult:
    """The result, with its resistance resolved by the track model."""
    resolved = resolve(
        found, noise=config.noise or None, population=config.population, generations=config.generations,
        members=members, seed=config.seed, tell=in_words(progress),
    )  # fmt: skip
    return dataclasses.replace(found, resolved=resolved)


def _say_out_of_time(within: float, begun: bool) -> None:
    """Say that time was out before a verdict [s]; `begun`: a stage has ended."""
    more = max(5, math.ceil(within / 30))  # twice as much
    first = "" if begun else f", nor a fit of the base model; give it more, as --within {more}min"
    print_message(f"no verdict within {within:g} s{first}")


@contextlib.contextmanager
def _alarm(seconds: float | None, wanted: Callable[[], bool]) -> Iterator[None]:
    """Raise `OutOfTime` within once so much time has passed, in the middle of a step too where the platform can,
    while it is `wanted`; each second again, since what is called may hold it back.

    Args:
        seconds: None: never.
    """
    if seconds is None or not hasattr(signal, "SIGALRM"):
        yield
        return

    def ring(*_: Any) -> None:
        if wanted():
            raise OutOfTime

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, max(seconds, 1e-3), 1.0)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def _show_ranking(found: Ranking, folder: RunFolder, timed: Callable[[str], None]) -> None:
    """Say what regression makes of the library, and leave it in the run folder: the first answer."""
    first, *lines = loop_words.ranking_lines(found)
    timed(first)
    for line in lines:
        print_message(line)
    content = {"schema": SCREENING, "confirmed": False, **dataclasses.asdict(found)}
    folder.write_json(SCREENING_FILE, content)


def _say_kept(stages: dict[str, Any], folder: RunFolder, robot_name: str) -> None:
    """Say which stages are kept, and leave the robot of the base fit where there is one but no verdict."""
    if not stages:
        return
    kept = [name for name in stages if folder.keeps(name)]
    if not kept:
        print_message(f"nothing could be kept of {', '.join(stages)}; the same command begins anew")
        return
    print_message(f"kept: {', '.join(kept)}; to continue, run the same command with --out {folder.path}")
    if "verdict" in stages:
        traced = stages["verdict"]
        print_message(f"{loop_words.verdict_line(traced)}; errors held out and other noises are outstanding")
        return
    if "ranking" in stages:
        for line in loop_words.ranking_lines(stages["ranking"]):
            print_message(line)
    searches = [found for name, found in stages.items() if name.startswith("search")]
    if searches and (best := searches[-1][2].best) is not None:
        library = searches[-1][0].base.space.library
        print_message(loop_words.so_far(best.effects, [library[n].family() for n in best.effects]))
    if "base" not in stages:
        return
    base = stages["base"][0].base
    robot = findings.proposed_robot(base.space, base.candidate)
    robot_file.write_robot(
        robot, folder.partial / REFIT_FILE, note=f"{robot_name}, fitted; the loop has no verdict yet"
    )
    print_message(f"the best that is known so far is the refit, {folder.partial / REFIT_FILE}")


def _effects(found: DiscoveryResult) -> Table:
    """Table of the effects that were found."""
    shown = Table(box=None, pad_edge=False)
    numbers = ("amplitude", "lowers misfit by", "own p")
    for heading in ("effect", "what is missing", *numbers, "indistinguishable from"):
        number = heading in numbers
        shown.add_column(heading, justify="right" if number else "left", no_wrap=number or heading == "effect")
    for e in found.effects:
        shown.add_row(
            loop_words.effect_called(found, e), ", or ".join(e.families), loop_words.effect_amplitude(e),
            f"{loop_words.misfit_text(e.score)} ({100 * e.share:.0f} %)", f"{e.p_value:.2g}",
            loop_words.indistinguishable_effects(found, e) or "-",
        )  # fmt: skip
    return shown


def _errors(found: DiscoveryResult) -> Table:
    """Table of the errors of the robot as stated, of its fits, and of rows held out."""
    errors = Table(title=f"rms error [% of the {OF_SIZE}]", title_justify="left")
    for heading in ("", "rows", *(c.label for c in found.channels)):
        errors.add_column(heading, justify="right" if heading else "left")
    whens = (0,) if found.refit_alone else (0, 1)
    when = ("before", "after")
    lines = {"as stated, nothing fitted": found.errors_as_stated}
    lines |= {f"{when[k]}, fitted": found.errors[k] for k in whens}
    for kind, both in found.errors_held_out.items():
        lines |= {f"{when[k]}, held out by {blocks.kind_in_words(kind)}": both[k] for k in whens}
    for text, by in lines.items():
        cells = ("-" if e["rows"] == 0 else f"{e['rms_percent']:.1f}" for e in by.values())
        errors.add_row(text, f"{max(e['rows'] for e in by.values())}/{len(found.runs)}", *cells)
    return errors


def print_discovery(found: DiscoveryResult) -> None:
    """Verdict, effects, errors and remarks, for a person; the answer and the next step last."""
    first = found.headline
    if len(first.factors) > 1:
        print_output(f"{first.level}: {loop_words.loop_headline(first)}.")
    print_output(f"{found.verdict}: {found.statement}")
    if not found.robot.has_ground and found.effects:
        print_output("The track balance of a shaft is what its load loses.")
    for said in (loop_words.support_sentence(found), loop_words.ruled_out(found)):
        if said:
            print_output(said)
    rise = loop_words.rising_errors_sentence(found.held_out_worse, found.predicted)
    if rise:
        print_output(rise)
    if found.effects:
        print_output(_effects(found))
        print_output(
            "lowers misfit by: rise of χ² without it, all else refitted (share of the excess misfit); own p: among "
            "the strongest of the library"
        )
    if found.hidden:
        print_output(loop_words.hidden_effects_sentence(found))
    if found.unnamed is not None:
        print_output(loop_words.proposed_formula(found.unnamed))
    if found.resolved is not None:
        print_output(found.resolved.statement)
        for note in found.resolved.notes:
            print_output(f"- track model: {note}")
    print_output(_errors(found))
    if Layout.of(found.robot).crosses_zero:
        shown_fits = {when: by for when, by in found.rms.items() if not (found.refit_alone and "after" in when)}
        print_output(words.describe_rms(shown_fits))
    if found.sensitivity:
        print_output(f"{loop_words.at_other_noise(found.sensitivity)}")
    for note in found.notes:
        print_output(f"- {note}")
    print_output(loop_words.completeness_answer(found))
    after = found.next_experiment
    if after is not None:
        sigma = f" (expected {after.expected_sigma:.1f} σ)" if after.separates else ""
        print_output(f"Next: {after.name}: {after.description}{sigma}")
