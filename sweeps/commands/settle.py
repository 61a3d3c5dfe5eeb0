"""The command `settle`: finds the settled runs in a log."""

from __future__ import annotations

import shlex

import numpy as np

from calibration.data import Columns, Json, settling
from calibration.data.settling import Settled
from calibration.described import sentences
from calibration.inference import ranges
from calibration.inference.observers import SettledRuns
from calibration.words import table_words
from sweeps import config as configuration
from sweeps.inputs import load_robot, read_runs
from sweeps.report import settle_report
from sweeps.store import finish_run_folder, open_folder, print_report


def execute(config: configuration.Settle, invocation: configuration.SettledLog) -> int:
    """Finds the settled runs in a log and writes a run folder with their table. Returns the exit code, 0."""
    robot = load_robot(config).robot
    runs = read_runs(invocation.data, robot, columns=config.columns, measured=True, series=True)
    column_options = [] if config.columns is None else ["--columns", config.columns]
    loop_command = shlex.join(["mmrjax", "loop", invocation.data, "--robot", config.robot, *column_options])
    settled = settling.settle_log(runs, robot, shortest=config.shortest_s, drift=config.drift)
    few_runs_sentence = table_words.sentence_on_few_settled_runs(settled, SettledRuns.fewest, loop_command)
    with open_folder("settle", config, robot, invocation, runs) as folder:
        folder.write_table("settled.csv", settled.table())
        folder.write_table("stretches.csv", segments_table(settled))
        folder.write_json("result.json", to_json(settled, few_runs_sentence))
        sign_sentences = sentences(ranges.remarks_on_signs(settled.settled_runs(), robot))
        page = print_report(settle_report.settle_document(settled, few_runs_sentence, sign_sentences))
        return finish_run_folder(folder, {"seed": None, "settled": len(settled.kept)}, page)


def segments_table(settled: Settled) -> Columns:
    """Table with a row for each segment of a log: position, reason if omitted, means, their sds, and changes."""
    stretches = settled.stretches
    table: Columns = {
        "run_id": np.array([s.run for s in stretches]),
        "from_s": np.array([s.begin for s in stretches]),
        "until_s": np.array([s.end for s in stretches]),
        "first_row": np.array([s.rows[0] + 1 for s in stretches]),
        "last_row": np.array([s.rows[-1] + 1 for s in stretches]),
        "imposed": np.array([s.imposed for s in stretches]),
        "left_out": np.array([s.reason if s.why else "" for s in stretches]),
    }
    for signal in settled.signals:
        channel = signal.channel
        fields = {
            channel.column: "mean",
            channel.sd_column: "sd",
            channel.sd_column.replace("_sd_", "_change_"): "drift",
        }
        for column, field in fields.items():
            table[column] = np.array([getattr(stretch, field).get(channel.name, np.nan) for stretch in stretches])
    return table


def to_json(settled: Settled, few_runs_sentence: str = "") -> Json:
    """`result.json`. `few_runs_sentence` is the sentence of `words.sentence_on_few_settled_runs`."""
    omitted = table_words.omitted_stretches(settled.stretches, bool(few_runs_sentence) and not settled.runs.turns)
    return {
        "schema": "mmrjax.settle/1",
        "statement": table_words.settle_statement(settled),
        "samples": len(settled.runs),
        "settled": len(settled.kept),
        "shortest_s": settled.shortest,
        "drift": settled.drift,
        "gaps": len(settled.gaps),
        "scatter": dict(settled.scatter),
        "glitches": {
            signal.channel.name: sum(run.glitches.get(signal.channel.name, 0) for run in settled.kept)
            for signal in settled.signals
        },
        "left_out": [dict(zip(("why", "stretches", "samples", "rows", "do"), row, strict=True)) for row in omitted],
        "notes": [*filter(None, [few_runs_sentence]), *table_words.settle_remarks(settled)],
    }
