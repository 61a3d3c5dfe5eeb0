"""The command `export`: a drive in the format of another simulator, with a report of what the format cannot
represent.
"""

from __future__ import annotations

from calibration.data import Json
from sweeps import config as configuration
from sweeps.export.formats import Export, export_format
from sweeps.inputs import load_robot
from sweeps.report import export_report
from sweeps.store import finish_run_folder, open_folder, print_report


def execute(config: configuration.Export, beside: configuration.FolderPart) -> int:
    """Exports a drive and writes a run folder with its files. Returns the exit code, 0."""
    file = load_robot(config)
    with open_folder("export", config, file.robot, beside) as folder:
        exported = export_format(
            file, config.to, configuration=config.configuration, data=config.data, at=config.joint,
            draws=config.draws, seed=config.seed,
        )  # fmt: skip
        for name, content in exported.files.items():
            folder.write_bytes(name, content if isinstance(content, bytes) else content.encode())
        folder.write_text("LAW.md", export_report.law_text(exported))
        folder.write_json("result.json", to_json(exported))
        document = print_report(export_report.export_document(exported))
        return finish_run_folder(
            folder,
            config,
            {"seed": config.seed},
            robot=file.robot,
            note="what was exported",
            page=document,
            runs=exported.comparison.situation.runs,
        )


def to_json(found: Export) -> Json:
    """`result.json`."""
    compared = found.comparison
    return {
        "schema": "mmrjax.export/1",
        "format": found.format,
        "robot": found.joint.file.name,
        "configuration": found.joint.configuration,
        "statement": export_report.export_statement(found),
        "runs": len(compared.situation.command),
        "source": compared.situation.source,
        "reference": compared.reference,
        "errors_percent": compared.errors,
        "translated": dict(compared.translated),
        "refitted": dict(compared.refitted),
        "effects": [
            {"name": f.name, "verdict": f.verdict, "how": f.how, "share_kept": f.kept} for f in compared.fates
        ],
        "idle": list(found.joint.idle),
        "checks": dict(found.checks),
        "constants": [
            {"name": c.name, "value": c.value, "unit": c.unit, "low": c.low, "high": c.high, "source": c.source}
            for c in found.constants
        ],
        "files": sorted(found.files),
    }
