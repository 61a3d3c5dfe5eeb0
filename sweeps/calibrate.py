"""The command `calibrate`: from a table of runs to a run folder with the calibrated robot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.table import Table

from calibration.data import robot_file
from calibration.data.runs import CHANNELS
from calibration.inference import blocks as holdout
from calibration.inference import priors
from calibration.inference import result as outcome
from calibration.inference.calibrate import calibrate as run
from sweeps import commands
from sweeps import config as configuration

#: Kinds of blocks to hold out, by --hold-out; None leaves them to the fidelity.
_BLOCKS = {None: None, True: tuple(holdout.BLOCKS), False: ()}


def calibrate(config: configuration.Calibrate, source: str, out: Path | None, force: bool) -> int:
    """Calibrate a robot to a table and leave a run folder; returns the exit code.

    0 done; 3 done, but the search did not converge, or a row or a fit without a block did not.
    """
    runs = commands.read_runs(source, measured=True, series=True)
    robot = commands.load_robot(config)
    stated = priors.parse_priors(config.prior)
    with commands.open_folder("calibrate", config, robot, out, force, runs) as folder:
        found = run(
            runs, robot, free=config.free, fix=config.fix, stated=stated, noise=config.noise or None,
            model=config.model, starts=config.starts, seed=config.seed, profiles=config.profiles,
            blocks=_BLOCKS[config.hold_out], tell=commands.tell,
        )  # fmt: skip
        document = outcome.document(found)
        folder.write_json("result.json", document)
        folder.write_table("rows.csv", outcome.rows_table(found))
        folder.write_text("config.resolved.toml", configuration.as_toml(config))
        free = ", ".join(document["parameters"])
        note = f"calibrated from {config.robot} with {runs.source}; the free parameters: {free}"
        robot_file.write(found.robot, folder.partial / "robot.toml", note=note)
        print_calibration(document)
        if config.report:
            from sweeps import report_calibration

            report_calibration.write(folder.partial, found, document, robot_name=config.robot)
        path = folder.finish({"seed": config.seed, "statuses": document["statuses"]}, runs)
        commands.say(str(path))
        settled = found.converged and all(h.converged.all() for h in found.held_out.values())
        reached = document["statuses"]["converged"] == len(runs)
        return commands.DONE if settled and reached else commands.SOME_NOT_CONVERGED


def print_calibration(document: dict[str, Any]) -> None:
    """Parameters, errors and remarks, for a person."""
    shown = Table(
        title=f"{document['rows']} rows, {document['model']}", title_justify="left", box=None, pad_edge=False
    )
    for heading in ("parameter", "value", "95 % interval", "shift [σ]", "held by"):
        side = "left" if heading in ("parameter", "held by") else "right"
        shown.add_column(heading, justify=side, no_wrap=True, overflow="ignore")
    for name, p in document["parameters"].items():
        low, high = (f"{v:.3g}" for v in p["interval"])
        marks = "> " * p["interval_open"][1] + "< " * p["interval_open"][0]  # the end lies further out
        shown.add_row(
            name, f"{p['value']:.4g}", f"{marks}{low} .. {high}", f"{p['shift_in_prior_sd']:+.1f}",
            "prior" if p["held_by_prior"] else "data",
        )  # fmt: skip
    commands.say(shown)
    errors = Table(title="rms of (simulated - measured) / simulated, eq. (35) [%]", title_justify="left")
    for heading in ("", "rows", *(c.replace("_", " ") for c in CHANNELS)):
        errors.add_column(heading, justify="right" if heading else "left")
    lines = {"before": document["errors"]["before"]["fitted"], "after": document["errors"]["after"]["fitted"]}
    lines |= {f"after, held out by {k.replace('_', ' and ')}": v["all"] for k, v in document["held_out_by"].items()}
    for words, by in lines.items():
        cells = ("-" if by[c]["rows"] == 0 else f"{by[c]['rms_percent']:.1f}" for c in CHANNELS)
        errors.add_row(words, f"{by['total_current']['rows']}/{document['rows']}", *cells)
    commands.say(errors)
    commands.say(document["optimizer"]["agreement"])
    for note in document["notes"]:
        commands.say(f"- {note}")
