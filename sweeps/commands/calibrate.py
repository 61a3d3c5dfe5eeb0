"""The command `calibrate`: from a table of runs to a run folder with the calibrated robot."""

from __future__ import annotations

from pathlib import Path

from rich.table import Table

from calibration.data.columns import Layout
from calibration.inference import blocks, priors
from calibration.inference.calibration import calibrate as run
from calibration.inference.result import CalibrationResult
from calibration.inference.simulation_errors import OF_SIZE
from calibration.words import fit_words
from mmrjax.errors import count_noun
from sweeps import config as configuration
from sweeps.console import print_message, print_output, step_reporter
from sweeps.inputs import load_robot, read_runs
from sweeps.pages import words
from sweeps.skeleton import finish_run_folder, page_writer
from sweeps.store import open_folder


def calibrate_robot(
    config: configuration.Calibrate, source: str, out: Path | None, force: bool, members: Path | None = None
) -> int:
    """Calibrate a robot to a table and leave a run folder; returns the exit code.

    0 done; 3 done, but the search or a fit without a block did not converge, or the solver failed at a row.
    """
    robot = load_robot(config).robot
    runs = read_runs(source, robot, columns=config.columns, measured=True, series=True)
    stated = priors.parse_priors(config.prior)
    with (
        open_folder("calibrate", config, robot, out, force, runs) as folder,
        step_reporter(print_message, "fitting") as heard,
    ):
        found = run(
            runs, robot, rows=config.rows, free=config.free, fix=config.fix, stated=stated,
            noise=config.noise or None, model=config.model, starts=config.starts, population=config.population,
            generations=config.generations, members=members, seed=config.seed,
            profiles=config.profiles, blocks=config.hold_out, solver=config.solver, tell=heard,
        )  # fmt: skip
        found.save(folder.results(), config.robot, folder.tables)
        print_calibration(found)
        settled = found.converged and all(b.converged for h in found.held_out.values() for b in h.blocks.values())
        manifest = {"seed": found.seed, "statuses": found.counts}
        shown = page_writer("calibration", found, robot_name=config.robot)
        return finish_run_folder(
            folder, config, manifest, solved=settled and words.every_run_solved(found.counts), page=shown, runs=runs
        )


def print_calibration(found: CalibrationResult) -> None:
    """Print the answer (adequate or not), parameters, errors and remarks."""
    print_output(fit_words.calibration_answer(found))
    print_output(f"{found.adequacy.statement}.")
    shown = Table(
        title=f"{count_noun(len(found), 'row')}, {found.model}", title_justify="left", box=None, pad_edge=False
    )
    for heading in ("parameter", "value", "95 % interval", "shift [σ]", "determined"):
        left = heading in ("parameter", "determined")
        shown.add_column(heading, justify="left" if left else "right", no_wrap=True, overflow="ignore")
    for name, p in found.parameters.items():
        low, high = (f"{v:.3g}" for v in p.interval)
        marks = "> " * p.interval_open[1] + "< " * p.interval_open[0]  # the end lies further out
        shown.add_row(name, f"{p.value:.4g}", f"{marks}{low} .. {high}", f"{p.shift:+.1f}", found.determined(name))
    print_output(shown)
    errors = Table(title=f"rms of simulated - measured [% of {OF_SIZE}]", title_justify="left")
    for heading in ("", "rows", *(c.label for c in found.channels)):
        errors.add_column(heading, justify="right" if heading else "left")
    lines = {"before": found.errors_before, "after": found.errors_after}
    lines |= {f"after, held out by {blocks.kind_in_words(k)}": found.held_out[k].errors for k in found.held_out_alike}
    for which, by in lines.items():
        cells = ("-" if e.rows == 0 else f"{e.rms_percent:.1f}" for e in by.values())
        errors.add_row(which, f"{max(e.rows for e in by.values())}/{len(found)}", *cells)
    print_output(errors)
    if Layout.of(found.robot).crosses_zero:
        print_output(words.describe_rms(found.rms))
    print_output(found.starts.statement())
    for note in found.notes:
        print_output(f"- {note}")
