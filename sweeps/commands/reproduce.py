"""The command `reproduce`: the paper's figures and tables for a robot."""

from __future__ import annotations

from calibration.data import runs as records
from mmrjax import fidelities
from mmrjax.model.paper_tables import CONFIGURATIONS
from sweeps import capabilities
from sweeps import config as configuration
from sweeps.console import print_message
from sweeps.inputs import load_robot
from sweeps.paper import data, report
from sweeps.store import finish_run_folder, open_folder, print_report


def execute(config: configuration.Reproduce, invocation: configuration.FolderPart) -> int:
    """Writes the paper's figures and tables for a robot to a run folder. Returns the exit code."""
    file = load_robot(config)
    robot = file.robot
    capabilities.check_on_ground(robot, "reproduce")
    resolves_gear = "track.guide_share" in fidelities.fidelity_facts(config.model).computes
    with open_folder("reproduce", config, robot, invocation, records.read_runs("measured")) as folder:
        document, rows = report.paper_document(file, resolves_gear)
        result = {"schema": "mmrjax.reproduce/1", "model": config.model, "rows": 0}
        if rows is None:
            print_message(
                f"the paper's runs use the configurations {', '.join(CONFIGURATIONS)}; this robot has none of them"
            )
        else:
            folder.write_table("rows.csv", data.paper_rows_table(rows))
            result |= {
                "rows": len(rows.conditions),
                "errors": data.bench_error_summary(rows),
                "adhesion_raised": rows.ratio,
            }
        folder.write_json("result.json", result)
        solved = rows is None or "failed" not in rows.plain["status"]
        return finish_run_folder(folder, {"seed": None}, print_report(document, file), solved)
