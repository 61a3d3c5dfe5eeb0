"""The command `loop`: finds the effects that the model of a robot lacks, from a table of runs."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar

import numpy as np

import mmrjax as mm
from calibration.data import Columns, effect_file, robot_file
from calibration.data.runs import Runs
from calibration.described import describe
from calibration.discovery import REFIT_FILE, OutOfTime, findings
from calibration.discovery.discover import discover
from calibration.discovery.result import DiscoveryResult
from calibration.discovery.settings import fewest_replicates
from calibration.inference import observers, priors
from calibration.inference.details import EquationErrors
from calibration.inference.lost_motion import lost_motion_notes
from calibration.inference.simulation_errors import root_mean_square
from calibration.words import loop_words
from calibration.words.step_words import expected_time
from mmrjax.model import params
from mmrjax.model.robot import Robot
from sweeps import config as configuration
from sweeps import store
from sweeps.console import print_message, step_reporter
from sweeps.inputs import load_robot, read_runs
from sweeps.report import loop_report
from sweeps.report.fit_tables import Change
from sweeps.store import SOLVER_FAILED, RunFolder, finish_run_folder, open_folder, print_report

T = TypeVar("T")
#: Schema of the file with the ranking by regression, before any confirmation.
SCREENING = "mmrjax.screening/1"


def execute(config: configuration.Loop, options: configuration.LoopBeside) -> int:
    """Runs the closed loop on a table and writes a run folder. Returns the exit code: 0 for any verdict, 3 if the
    proposed fit did not converge, or if the time budget ended before a verdict. Finished stages are stored, so that
    the same command continues after such an end or an interrupt. For a model of several joints, each joint has its
    own loop and folder.
    """
    if config.model is not None:
        from sweeps.commands import loop_joints

        return loop_joints.run_joints(config, options, _run_with_time_limit)
    robot = load_robot(config).robot
    return _run_with_time_limit(
        config, options, robot, read_runs(options.data, robot, columns=config.columns, measured=True, series=True)
    )


def _run_with_time_limit(
    config: configuration.Loop, options: configuration.LoopBeside, robot: Robot, runs: Runs
) -> int:
    try:
        return _run_loop(config, options, robot, runs)
    except OutOfTime:
        return SOLVER_FAILED


def _run_loop(config: configuration.Loop, options: configuration.LoopBeside, robot: Robot, runs: Runs) -> int:
    start, time_budget = time.monotonic(), options.seconds
    prior_options = priors.parse_priors(config.prior)
    replicates = max(config.replicates, fewest_replicates(observers.observer_kind(runs)))

    stages: dict[str, Any] = {}

    def seconds_left() -> float:
        return max(time_budget - (time.monotonic() - start), 0.0)

    def timed(text: str) -> None:
        elapsed = time.monotonic() - start
        expected = expected_time(text, elapsed)
        print_message(f"{elapsed:4.0f} s  {text}{'' if expected is None else f' (about {expected:.0f} s more)'}")

    with (
        open_folder("loop", config, robot, options, runs) as folder,
        step_reporter(timed, "preparing the table") as report_step,
    ):

        def progress(text: str) -> None:
            report_step(text)
            if seconds_left() == 0.0 and "verdict" not in stages:
                raise OutOfTime

        def keep(name: str, make: Callable[[], T]) -> T:
            result = stages[name] = folder.stage(name, make)
            if name == "ranking":
                # The ranking by regression is the first answer.
                ranking: findings.EffectRanking = stages[name]
                first_line, *lines = loop_words.ranking_lines(ranking, brief=not options.verbose)
                timed(first_line)
                for line in lines:
                    print_message(line)
                answer = loop_words.regression_verdict(ranking)
                content = {"schema": SCREENING, "confirmed": False, "answer": answer, **dataclasses.asdict(ranking)}
                folder.write_json(store.SCREENING_FILE, content)
            if name == "verdict":
                timed(f"{loop_words.verdict_line(stages[name])}. Next: held-out errors and other noise levels")
            return result

        try:
            with _time_limit(seconds_left(), lambda: "verdict" not in stages):
                verdict = discover(
                    runs, robot, rows=config.rows, noise=config.noise or None, stated=prior_options,
                    library=effect_file.effect_library(config.effects), replicates=replicates, seed=config.seed,
                    forbidden=config.forbid, progress=progress, keep=keep, left=seconds_left,
                )  # fmt: skip
        except KeyboardInterrupt as ended:
            if isinstance(ended, OutOfTime):
                minutes = max(5, math.ceil(time_budget / 30))  # with twice the time
                hint = f", and no fit of the base model; allow more, such as --within {minutes}min"
                print_message(f"no verdict within {time_budget:g} s{hint * (not stages)}")
                for note in lost_motion_notes(runs, robot):  # then no effect is ranked
                    print_message(describe(note))
            _report_stored_stages(stages, folder, config.robot)
            raise
        document = loop_report.loop_document(verdict, config.robot, changes_by_effect(verdict))
        page = print_report(document, brief=not options.verbose)
        verdict.save(folder.results(), config.robot, folder.tables)
        if config.report:
            progress("writing the report")
        manifest = {"seed": config.seed, "verdict": verdict.verdict}
        return finish_run_folder(folder, manifest, page, verdict.converged)


@contextlib.contextmanager
def _time_limit(seconds: float, applies: Callable[[], bool]) -> Iterator[None]:
    """Context manager that raises `OutOfTime` in its block after this many seconds while `applies` is true.

    On some platforms it also interrupts a running step, and repeats this every second, because a called function may
    suppress the exception.
    """
    if not hasattr(signal, "SIGALRM"):
        yield
        return

    def ring(*_: Any) -> None:
        if applies():
            raise OutOfTime

    handler_before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, max(seconds, 1e-3), 1.0)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, handler_before)


def _report_stored_stages(stages: Mapping[str, Any], folder: RunFolder, robot_name: str) -> None:
    """Reports which stages are stored. Without a verdict, writes the robot of the base fit if available."""
    if not stages:
        return
    stored_stages = [name for name in stages if folder.keeps(name)]
    if not stored_stages:
        print_message(f"{', '.join(stages)} could not be saved. The same command starts anew")
        return
    print_message(f"kept: {', '.join(stored_stages)}. To continue, run the same command with --out {folder.path}")
    if "verdict" in stages:
        traced = stages["verdict"]
        print_message(f"{loop_words.verdict_line(traced)}. Held-out errors and other noise levels are missing")
        return
    if "ranking" in stages:
        for line in (*loop_words.ranking_lines(stages["ranking"]), loop_words.regression_verdict(stages["ranking"])):
            print_message(line)
        tests = [stage[1].test for name, stage in stages.items() if name.startswith("bootstrap")]
        if tests and tests[-1].rejected and not stages["ranking"].missing:
            print_message(loop_words.DISAGREES)
    searches = [search for name, search in stages.items() if name.startswith("search")]
    if searches and (best := searches[-1][2].best) is not None:
        library = searches[-1][0].base.space.library
        print_message(loop_words.search_progress(best.effects, [library[n].family() for n in best.effects]))
    if "base" not in stages:
        return
    base = stages["base"][0].base
    robot = findings.proposed_robot(base.space, base.candidate)
    robot_file.write_robot(
        robot, folder.partial / REFIT_FILE, note=f"{robot_name}, fitted. The loop has no verdict yet"
    )
    print_message(f"the best result so far is the refit, {folder.partial / REFIT_FILE}")


def changes_by_effect(result: DiscoveryResult) -> dict[str, Change]:
    """Change of settled runs by each effect of the written robot. Empty for histories."""
    added = [e.name for e in result.effects if e.name in {x.name for x in result.robot.effects}]
    if not isinstance(result.detail, EquationErrors) or not added:
        return {}
    conditions = result.runs.conditions(result.robot)

    def simulated(robot: Robot) -> Columns:
        results = mm.simulate(robot, conditions)
        return {c.name: np.asarray(getattr(results, c.name)) for c in result.channels}

    with_effects, largest, measured = simulated(result.robot), {}, result.readings_of_rows.measured
    for name in added:
        without = simulated(params.replace(result.robot, {f"effects.{name}.amplitude": params.as_float(0.0)}))
        changes = []
        for k, c in enumerate(result.channels):
            a, b = without[c.name], with_effects[c.name]
            size = root_mean_square(measured[result.included, k])
            if np.isfinite(size) and size > 0:
                changes.append(Change(c, 100 * root_mean_square((b - a)[result.included]) / size, a, b))
        if changes:
            largest[name] = max(changes, key=lambda change: change.rms)
    return largest
