"""The command `calibrate`: fits a robot to a table of runs and writes a run folder."""

from __future__ import annotations

from calibration.inference import priors
from calibration.inference.calibration import calibrate as run
from sweeps import config as configuration
from sweeps.commands import feedforward_fit
from sweeps.console import print_message, step_reporter
from sweeps.inputs import load_robot, read_runs
from sweeps.pages import words
from sweeps.report import calibration_report
from sweeps.store import finish_run_folder, open_folder, print_report


def execute(config: configuration.Calibrate, beside: configuration.FittedRuns) -> int:
    """Calibrates a robot to a table and writes a run folder. Returns the exit code: 0 if done, 3 if the search or a
    fit without a block did not converge, or the solver failed for a row.
    """
    if config.feedforward is not None:
        return feedforward_fit.execute(config, beside)
    robot = load_robot(config).robot
    runs = read_runs(beside.data, robot, columns=config.columns, measured=True, series=True)
    prior_options = priors.parse_priors(config.prior)
    with (
        open_folder("calibrate", config, robot, beside, runs) as folder,
        step_reporter(print_message, "fitting") as heard,
    ):
        result = run(
            runs, robot, rows=config.rows, free=config.free, fix=config.fix, stated=prior_options,
            noise=config.noise or None, model=config.model, starts=config.starts, population=config.population,
            generations=config.generations, keep=folder.stage, seed=config.seed,
            profiles=config.profiles, blocks=config.hold_out, tell=heard,
        )  # fmt: skip
        result.save(folder.results(), config.robot, folder.tables)
        report = calibration_report.calibration_document(result, config.robot, feedforward_fit.voltage_fit(runs))
        document = print_report(report, brief=not beside.verbose)
        settled = result.converged and all(b.converged for h in result.held_out.values() for b in h.blocks.values())
        manifest = {"seed": result.seed, "statuses": result.counts}
        return finish_run_folder(
            folder,
            config,
            manifest,
            solved=settled and words.every_run_solved(result.counts),
            page=document,
            runs=runs,
        )
