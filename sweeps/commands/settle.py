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


def execute(config: configuration.Settle, beside: configuration.SettledLog) -> int:
    """Finds the settled runs in a log and writes a run folder with their table. Returns the exit code, 0."""
    robot = load_robot(config).robot
    runs = read_runs(beside.data, robot, columns=config.columns, measured=True, series=True)
    column_options = [] if config.columns is None else ["--columns", config.columns]
    loop = shlex.join(["mmrjax", "loop", beside.data, "--robot", config.robot, *column_options])
    settled = settling.settle_log(runs, robot, shortest=config.shortest_s, drift=config.drift)
    few_runs_sentence = table_words.sentence_on_few_settled_runs(settled, SettledRuns.fewest, loop)
    with open_folder("settle", config, robot, beside, runs) as folder:
        folder.write_table("settled.csv", settled.table())
        folder.write_table("stretches.csv", segments_table(settled))
        folder.write_json("result.json", to_json(settled, few_runs_sentence))
        sign_sentences = sentences(ranges.remarks_on_signs(settled.settled_runs(), robot))
        document = print_report(settle_report.settle_document(settled, few_runs_sentence, sign_sentences))
        return finish_run_folder(folder, {"seed": None, "settled": len(settled.kept)}, document)


def segments_table(found: Settled) -> Columns:
    """Table with a row for each segment of a log: position, reason if omitted, means, their sds, and changes."""
    stretches = found.stretches
    table: Columns = {
        "run_id": np.array([s.run for s in stretches]),
        "from_s": np.array([s.begin for s in stretches]),
        "until_s": np.array([s.end for s in stretches]),
        "first_row": np.array([s.rows[0] + 1 for s in stretches]),
        "last_row": np.array([s.rows[-1] + 1 for s in stretches]),
        "imposed": np.array([s.imposed for s in stretches]),
        "left_out": np.array([s.reason if s.why else "" for s in stretches]),
    }
    for signal in found.signals:
        channel = signal.channel
        fields = {
            channel.column: "mean",
            channel.sd_column: "sd",
            channel.sd_column.replace("_sd_", "_change_"): "drift",
        }
        for column, field in fields.items():
            table[column] = np.array([getattr(s, field).get(channel.name, np.nan) for s in stretches])
    return table


def to_json(found: Settled, few: str = "") -> Json:
    """`result.json`. `few` is the sentence of `words.sentence_on_few_settled_runs`."""
    omitted = table_words.omitted_stretches(found.stretches, bool(few) and not found.runs.turns)
    return {
        "schema": "mmrjax.settle/1",
        "statement": table_words.settle_statement(found),
        "samples": len(found.runs),
        "settled": len(found.kept),
        "shortest_s": found.shortest,
        "drift": found.drift,
        "gaps": len(found.gaps),
        "scatter": dict(found.scatter),
        "glitches": {
            s.channel.name: sum(k.glitches.get(s.channel.name, 0) for k in found.kept) for s in found.signals
        },
        "left_out": [dict(zip(("why", "stretches", "samples", "rows", "do"), row, strict=True)) for row in omitted],
        "notes": [*filter(None, [few]), *table_words.settle_remarks(found)],
    }
