"""The command `loop`: from a table of runs to what the model lacks, and a robot that has it."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from calibration.data import effect_file, robot_file
from calibration.inference import checks
from calibration.inference import noise as noise_room
from calibration.data.errors import BadData
from calibration.data.runs import CHANNELS, Runs
from calibration.discovery import result as loop_outcome
from calibration.discovery.loop import Engine, Finding, Loop
from calibration.inference import priors
from calibration.inference.problem import is_series
from sweeps import commands
from sweeps import config as configuration

#: Fewest rows, and fewest samples of histories, in which a missing effect can be told from noise.
FEWEST, FEWEST_SAMPLES = 6, 24
#: Factors on an assumed noise at which the verdict is looked at too.
FACTORS = (0.5, 2.0)


def loop(config: configuration.Loop, source: str, out: Path | None, force: bool) -> int:
    """Run the closed loop on a table and leave a run folder; returns the exit code.

    0 done; 3 done, but rows could not be simulated, or the fit that is proposed did not converge.
    """
    began = time.monotonic()
    runs, numbers, notes = _distinct(commands.read_runs(source, measured=True, series=True))
    series = is_series(runs)
    fewest, word = (FEWEST_SAMPLES, "samples") if series else (FEWEST, "runs")
    if len(runs) < fewest:
        raise BadData(
            f"{runs.source}: {len(runs)} {word} cannot show what a model lacks; at least {fewest} are needed"
        )
    robot = commands.load_robot(config)
    stated = priors.parse_priors(config.prior)
    known = noise_room.assumed(runs, config.noise or None)
    notes += checks.check(runs, (), known)
    if series:
        checks.from_rest(runs, known)
        notes += _long(runs)

    def progress(text: str) -> None:
        commands.tell(f"{time.monotonic() - began:4.0f} s  {text}")

    with commands.open_folder("loop", config, robot, out, force, runs) as folder:
        engine = Engine(robot, effect_file.library(config.effects), series=series)

        def one(factor: float = 1.0) -> tuple[Loop, Finding]:
            sd = noise_room.assumed(runs, config.noise or None, factor).sd
            looped = Loop(
                engine, runs, sd, stated=stated, replicates=config.replicates, seed=config.seed,
                numbers=numbers,
                progress=progress if factor == 1.0 else lambda text: None,
            )  # fmt: skip
            return looped, looped.run()

        looped, found = one()
        progress("errors on data held out")
        curve = loop_outcome.discrepancy(looped, found)
        seen = loop_outcome.readings(looped, found, curve)
        progress("the next experiment")
        document = loop_outcome.document(looped, found, seen, curve)
        document["noise"] = _noise(looped, known)
        document["noise_sensitivity"] = []
        if "assumed" in known.source:
            for factor in FACTORS:
                progress(f"the verdict with {factor:g} times the assumed noise")
                document["noise_sensitivity"].append(_other(factor, *one(factor)))
            silent = ", ".join(c for c, w in zip(CHANNELS, known.source, strict=True) if w == "assumed")
            notes.append(f"no sd is stated for {silent}: {noise_room.ASSUMED} is assumed; state yours with --noise")
        document["notes"] = [*notes, *remarks(document)]
        folder.write_json("result.json", document)
        folder.write_table("rows.csv", loop_outcome.rows_table(looped, found, seen))
        folder.write_text("config.resolved.toml", configuration.as_toml(config))
        proposed = loop_outcome.robot(looped, found, curve)
        note = f"found by the loop from {config.robot} with {runs.source}: {document['statement']}"
        robot_file.write(proposed, folder.partial / "robot.toml", note=note)
        print_loop(document)
        if config.report:
            from sweeps import report_loop

            progress("writing the report")
            report_loop.write(folder.partial, looped, found, seen, document, curve, robot_name=config.robot)
        path = folder.finish({"seed": config.seed, "verdict": found.verdict}, runs)
        commands.say(str(path))
        converged = found.after.hypothesis.converged if curve is None else curve.converged
        sound = converged and not found.unusable
        return commands.DONE if sound else commands.SOME_NOT_CONVERGED


def _distinct(runs: Runs) -> tuple[Runs, np.ndarray, list[str]]:
    """The runs without exact copies of one another, their row numbers, and what to say of that."""
    seen: set[tuple[str, ...]] = set()
    keep, copies = [], []
    for k in range(len(runs)):
        # Repeats of a history begin alike, at rest.
        row = tuple(str(column[k]) for name, column in runs.columns.items() if name != "run_id" or is_series(runs))
        (copies if row in seen else keep).append(k)
        seen.add(row)
    if not copies:
        return runs, np.arange(1, len(runs) + 1), []
    rows = ", ".join(str(k + 1) for k in copies)
    said = f"rows {rows} are exact copies of earlier ones and count once"
    if len(copies) == 1:
        said = f"row {rows} is an exact copy of an earlier one and counts once"
    return runs.where(keep), np.asarray(keep) + 1, [said]  # type: ignore[arg-type]


def _long(runs: Runs) -> list[str]:
    """What to say of runs so long that the steps of the model are."""
    from mmrjax.fidelities.histories import LONGEST, STEPS

    step = runs["time_s"].max() / STEPS
    if step <= 2 * LONGEST:
        return []
    return [
        f"runs of {runs['time_s'].max():.0f} s are followed in steps of {1e3 * step:.0f} ms: waves of a shaft faster "
        "than some ten steps are not resolved; cut the runs to look for them"
    ]


def _noise(looped: Loop, known: noise_room.Noise) -> dict[str, Any]:
    reading = np.abs(looped.runs.measured())
    if looped.engine.series:
        reading = np.sqrt(np.mean(reading**2, 0, keepdims=True))
    share = 100 * np.median(known.sd / np.maximum(reading, 1e-12), axis=0)
    return {c: {"source": known.source[k], "median_percent": float(share[k])} for k, c in enumerate(CHANNELS)}


def _other(factor: float, looped: Loop, found: Finding) -> dict[str, Any]:
    """What the loop says with another noise, in short."""
    return {
        "factor": factor,
        "verdict": found.verdict,
        "statement": loop_outcome.statement(looped, found),
        "classes": [[looped.engine.names[k] for k in c] for c in found.classes],
        "adequate_after": not found.after.gate.clear,
    }


def remarks(document: dict[str, Any]) -> list[str]:
    """What a careful engineer would say of this result, one sentence each."""
    said = []
    for rows, why in (
        (document["rows_unusable"], "cannot be simulated: the fitted model slides or fails there"),
        (document["rows_outliers"], "stand alone: outliers, which no effect explains"),
    ):
        if rows:
            said.append(f"rows {', '.join(map(str, rows))} {why}; they are kept out")
    for name, p in document["base_shift"].items():
        if abs(p["shift_after"]) > 3:
            said.append(
                f"{name} lies {abs(p['shift_after']):.1f} prior sds from its prior: it stands in for something"
            )
    for e in document["effects"]:
        free = e.get("score_free_in_each_run")
        if free and e["score"] < 0.5 * free:
            said.append(
                f"the wave stands at another angle in each run (it explains {free:.0f} σ² free in each, "
                f"{e['score']:.0f} with one phase): robot.toml holds the mean; start runs from a mark"
            )
    if document["remains"]:
        where, over = document["remains"]["balance"], document["remains"]["variable"].replace("_", " ")
        said.append(f"what was found does not explain everything: {where} still lacks something over {over}")
    settled, asked = document["bootstrap"]["replicates"], document["bootstrap"]["asked"]
    if settled < 0.9 * asked:
        said.append(f"only {settled} of {asked} bootstrap tables could be fitted again; the thresholds are theirs")
    if 1 / (1 + settled) > min(document["bootstrap"]["shares"].values()):
        said.append(f"{settled} bootstrap tables are too few for every kind of evidence to count; use 500 or more")
    return said


def print_loop(document: dict[str, Any]) -> None:
    """Verdict, effects, errors and remarks, for a person."""
    commands.say(f"{document['verdict']}: {document['statement']}")
    if document["effects"] and document["verdict"] != "unnamed":
        shown = Table(box=None, pad_edge=False)
        for heading in ("effect", "balance", "amplitude", "explains [σ²]", "could as well be"):
            shown.add_column(
                heading, justify="right" if heading.startswith(("ampl", "expl")) else "left", no_wrap=True
            )
        for e in document["effects"]:
            a = e["parameters"]["amplitude"]
            shown.add_row(
                e["name"], e["balance"], f"{a['value']:.3g} ± {a['sd']:.2g} {a['unit']}", f"{e['score']:.0f}",
                ", ".join(e["class"][1:]) or "-",
            )  # fmt: skip
        commands.say(shown)
    if document["verdict"] == "unnamed":
        proposal = document["effects"][0]["proposal"]
        commands.say(f"{proposal['formula']} ({proposal['mark']})")
    after = document["next_experiment"]
    if after is not None:
        sigma = f" (expected {after['expected_sigma']:.1f} σ)" if after["separates"] else ""
        commands.say(f"next: {after['name']}: {after['description']}{sigma}")
    errors = Table(title=f"rms error [% of the {document['errors_percent_of']}]", title_justify="left")
    for heading in ("", "rows", *(c.replace("_", " ") for c in CHANNELS)):
        errors.add_column(heading, justify="right" if heading else "left")
    whens = ("before",) if document["verdict"] == "none" else ("before", "after")
    lines = {f"{w}, fitted": document["errors"][w]["fitted"] for w in whens}
    for kind, by in document["held_out_by"].items():
        lines |= {f"{w}, held out by {kind.replace('_', ' and ')}": by[w] for w in whens}
    for words, by in lines.items():
        cells = ("-" if by[c]["rows"] == 0 else f"{by[c]['rms_percent']:.1f}" for c in CHANNELS)
        errors.add_row(words, f"{by['total_current']['rows']}/{document['rows']}", *cells)
    commands.say(errors)
    for other in document["noise_sensitivity"]:
        commands.say(f"with {other['factor']:g} times the assumed noise: {other['verdict']}: {other['statement']}")
    for note in document["notes"]:
        commands.say(f"- {note}")
