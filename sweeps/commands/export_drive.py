"""The command `export`: a drive in the format of another simulator, with what the format loses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.table import Table

from calibration.data import robot_file
from mmrjax.model import channels
from sweeps import config as configuration
from sweeps.console import say
from sweeps.export import export_words as words
from sweeps.export.formats import Export, exported
from sweeps.inputs import load_robot
from sweeps.skeleton import leave, page
from sweeps.store import open_folder


def export(config: configuration.Export, out: Path | None, force: bool) -> int:
    """Export a drive and leave a run folder with its files; returns the exit code, 0."""
    file = load_robot(config)
    with open_folder("export", config, file.robot, out, force) as folder:
        found = exported(
            file, config.to, configuration=config.configuration, data=config.data, at=config.joint,
            draws=config.draws, seed=config.seed,
        )  # fmt: skip
        robot_file.write(file.robot, folder.partial / "robot.toml", note=f"what was exported, from {config.robot}")
        for name, content in found.files.items():
            folder.write_bytes(name, content if isinstance(content, bytes) else content.encode())
        folder.write_text("LAW.md", words.law(found))
        folder.write_json("result.json", to_json(found))
        show(found)
        return leave(
            folder, config, {"seed": config.seed}, page=page("export", found), runs=found.comparison.situation.runs
        )


def to_json(found: Export) -> dict[str, Any]:
    """`result.json`."""
    compared = found.comparison
    return {
        "schema": "mmrjax.export/1",
        "format": found.format,
        "robot": found.joint.file.name,
        "configuration": found.joint.configuration,
        "statement": words.statement(found),
        "runs": len(compared.situation.command),
        "source": compared.situation.source,
        "reference": compared.reference,
        "errors_percent": {e.label: dict(e.percent) for e in compared.errors},
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


def show(found: Export) -> None:
    """Print what was exported, what becomes of each effect, and the errors."""
    say(words.statement(found))
    shown = Table(title="what the format holds", title_justify="left", box=None, pad_edge=False)
    for heading in ("term or effect", "verdict", "kept", "how"):
        shown.add_column(heading)
    for fate in found.comparison.fates:
        shown.add_row(fate.name, fate.verdict, words.kept(fate), fate.how)
    say(shown)
    errors = Table(title=words.errors_title(found), title_justify="left", box=None, pad_edge=False)
    errors.add_column("model")
    names = list(found.comparison.errors[0].percent)
    for name in names:
        errors.add_column(f"{channels.find(name).label} [%]", justify="right")
    for error in found.comparison.errors:
        errors.add_row(error.label, *(f"{error.percent[n]:.3g}" for n in names))
    say(errors)
    for sentence in words.remarks(found):
        say(f"- {sentence}")
    for name, value in found.checks.items():
        say(f"- {name}: {value:.3g}")
