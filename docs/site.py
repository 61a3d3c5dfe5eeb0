"""Writes the pages of `docs/reference` that follow from the code, and the tutorial that follows from a run folder.

python docs/site.py            # the pages of PAGES
python docs/site.py found      # docs/start/table.md too, from the folder of `mmrjax loop measured --out found`
"""

from __future__ import annotations

import ast
import hashlib
import inspect
import json
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parent
FIGURES = ("before_after", "law")
PACKAGES = ("mmrjax", "calibration", "sweeps")
#: What the tutorial about the loop was written from, and the parts of `result.json` in it.
RECORD = DOCS / "start" / "loop.json"
RECORDED = ("statement", "rows", "errors", "held_out_by", "effects", "next_experiment")
#: Second paragraph of every page that this program writes.
MADE = "*`python docs/site.py` writes this page from the code.*"


def api() -> str:
    """Page of the public names: signature, docstring, and the types that they return."""
    import mmrjax as mm

    parts = [
        "# The public names",
        "`import mmrjax as mm` gives every public name. Units are SI unless a name states another.",
        MADE,
    ]
    names = sorted((n for n in mm.__all__ if not n.startswith("_")), key=str.lower)
    for name in names:
        thing = getattr(mm, name)
        if not callable(thing):
            parts.append(f"## `mm.{name}`\n\n`{thing!r}`")
            continue
        signature = "" if inspect.isclass(thing) and issubclass(thing, BaseException) else _signature(thing)
        parts.append(f"## `mm.{name}{signature}`\n\n{_text(thing)}")
        parts += _members(thing, name)
    parts.append("# Types that they return")
    for kind in returned_types():
        parts += [f"## `{kind.__name__}`\n\n{_text(kind)}", *_members(kind, kind.__name__)]
    return "\n\n".join(parts) + "\n"


def returned_types() -> list[type]:
    """Types that public functions return and that are not public names themselves."""
    import mmrjax as mm

    public = [getattr(mm, name) for name in mm.__all__ if not name.startswith("_")]
    found = {_returned(thing)[1] for thing in public if inspect.isroutine(thing)}
    own = [kind for kind in found if inspect.isclass(kind) and kind.__module__.split(".")[0] in PACKAGES]
    return sorted(set(own) - {thing for thing in public if inspect.isclass(thing)}, key=lambda kind: kind.__name__)


def _returned(function: Any) -> tuple[str, Any]:
    """The return annotation of a function, and the type of that name."""
    stated = str(inspect.signature(function).return_annotation)
    return stated, getattr(sys.modules[function.__module__], stated, None)


def _text(thing: Any) -> str:
    """Docstring of a public name; for a function it ends with a section `Returns`."""
    doc = inspect.getdoc(thing) or ""
    if inspect.isroutine(thing) and "Returns:" not in doc:
        stated, kind = _returned(thing)
        about = (inspect.getdoc(kind) or "").split("\n")[0] if inspect.isclass(kind) else ""
        doc += f"\n\nReturns:\n    {stated}{f': {about}' if about else ''}"
    return f"```text\n{doc}\n```"


def _signature(thing: Any) -> str:
    signature = inspect.signature(thing)
    names = [n for n in signature.parameters if n not in ("self", "cls")]
    return f"({', '.join(names)})" + ("" if inspect.isclass(thing) else f" → {signature.return_annotation}")


def _members(thing: Any, name: str) -> list[str]:
    """Sections of the methods and properties of a class."""
    if not inspect.isclass(thing) or issubclass(thing, BaseException):
        return []
    parts = []
    for member, value in vars(thing).items():
        if member.startswith("_") or not (inspect.isfunction(value) or isinstance(value, property)):
            continue
        function = value.fget if isinstance(value, property) else value
        stated = inspect.signature(function).return_annotation
        call = f"{member} → {stated}" if value is not function else f"{member}{_signature(function)}"
        parts.append(f"### `{name}.{call}`\n\n```text\n{inspect.getdoc(value)}\n```")
    return parts


def glossary() -> str:
    """Page of the words that reports and the terminal use."""
    from sweeps.pages.words import GLOSSARY

    lines = [f"**{word}**\n: {meaning}\n" for word, meaning in GLOSSARY.items()]
    opening = "Words of the reports and the terminal. `mmrjax explain NAME` prints these and every other name."
    return "\n\n".join(["# Glossary", opening, MADE, "\n".join(lines)])


def statuses() -> str:
    """Page of the statuses of a run, its flags and the verdicts of `loop` and `climb`."""
    from sweeps.pages import words
    from sweeps.report.climb_report import VERDICTS

    parts = {
        "Statuses": {name: _sentence(meaning) for name, (_, meaning) in words.STATUSES.items()},
        "Flags": {name: _sentence(meaning) for name, meaning in words.FLAGS.items()},
        "Verdicts of the loop": {name: _sentence(meaning) for name, meaning in words.LOOP_VERDICTS.items()},
        "Verdicts of a climb": {name: _sentence(verdict[1]) for name, verdict in VERDICTS.items()},
        "Files of a run folder": {name: _sentence(meaning) for name, meaning in words.FILES.items()},
    }
    opening = (
        "Every run has one status and any number of flags. They are in the columns `status` and `flags` of `runs.csv`. A run that stalls or "
        "slides is a valid result, with [exit code](exit-codes.md) 0."
    )
    tables = [f"## {heading}\n\n" + _table(("name", "meaning"), _named(rows)) for heading, rows in parts.items()]
    return "\n\n".join(["# Statuses, flags, verdicts and files", opening, MADE, *tables]) + "\n"


def exit_codes() -> str:
    """Page of the exit codes, with the meaning of 3 for each command."""
    groups: dict[str, list[str]] = {}
    for name, command in _commands():
        if meaning := (command.epilog or "").partition("Exit code 3: ")[2].removesuffix("."):
            groups.setdefault(meaning, []).append(name)
    rows = [(", ".join(f"`{name}`" for name in names), meaning) for meaning, names in groups.items()]
    codes = (
        ("0", "done, whatever the answer: runs that stall or slide, requirements that are missed, every verdict"),
        ("1", "internal error; `--check`: a part of the installation does not work"),
        ("2", "usage or configuration error, a folder that cannot be written or is in use, or not enough memory"),
        ("3", "done, but a solver failed or the time ran out; the results state where"),
        ("4", "bad data, or a finished sweep with damaged files"),
        ("130", "interrupted; the same command with the same `--out` continues"),
    )
    tables = [_table(("code", "meaning"), codes), "## Exit code 3", _table(("command", "exit code 3"), rows)]
    return "\n\n".join(["# Exit codes", MADE, *tables]) + "\n"


def commands() -> str:
    """Page of the commands: help, example, arguments and options."""
    parts = [
        "# Commands",
        "Each command writes a run folder and prints its path on the last line. `mmrjax COMMAND --help` prints the "
        "common options. Options marked `*` appear with `--help-all` only.",
        MADE,
    ]
    for name, command in _commands():
        example = (command.epilog or "").partition("Exit code 3")[0].strip().removeprefix("Example: ")
        parts += [f"## `mmrjax {name}`", _plain(command.help or "")]
        parts += [f"Example: {' · '.join(f'`{one}`' for one in re.split('; | · ', example.rstrip('.')))}"] * bool(
            example
        )
        rows = [
            (f"`{_called(option)}`", _plain(option.help or "")) for option in command.params if option.name != "help"
        ]
        parts += [_table(("option", "meaning"), rows)] * bool(rows)
    return "\n\n".join(parts) + "\n"


def _commands() -> list[tuple[str, Any]]:
    """Commands of the command line by name, those of a group with the group's name in front."""
    from typer.main import get_command

    from sweeps import cli

    def flat(name: str, command: Any) -> Iterator[tuple[str, Any]]:
        if not hasattr(command, "commands"):
            yield name, command
        for word, one in getattr(command, "commands", {}).items():
            yield from flat(f"{name} {word}".strip(), one)

    return list(flat("", get_command(cli.app)))


def _called(option: Any) -> str:
    """Name of an option as people type it, an argument in capitals."""
    names = [name for name in (*option.opts, *option.secondary_opts) if name.startswith("-")]
    return (" / ".join(names) or option.metavar or option.name.upper()) + " *" * bool(
        getattr(option, "hidden", False)
    )


def _plain(text: str) -> str:
    """Help without the marks of the terminal, as one cell of a table or some paragraphs."""
    text = re.sub(r"\[/?bold\]", "", text).replace("\\[", "[")
    return "\n\n".join(" ".join(part.split()) for part in text.split("\n\n")).replace("[[", "\\[[")


def schemas() -> str:
    """Page of the JSON Schemas, one for each command that has one."""
    rows = [
        (f"`{path.name.split('.')[0]}`", f"[{path.name}](../schemas/{path.name})")
        for path in sorted((DOCS / "schemas").glob("*.json"))
    ]
    opening = "Every `result.json` names its schema in `schema`, and is valid by the JSON Schema of that command."
    return "\n\n".join(["# Schemas", opening, MADE, _table(("command", "schema"), rows)]) + "\n"


def quantities() -> str:
    """Page of the conditions, channels and outputs: column, unit, range."""
    from mmrjax import derived
    from mmrjax.fidelities import outputs
    from mmrjax.model import channels, quantities

    conditions = [
        (f"`{c.column}`", c.label, c.unit_shown or "-", _range(c), ", ".join(c.other_units) or "-")
        for c in quantities.SET
    ]
    shown = [
        (
            f"`{c.column}`", c.label, c.unit_shown or "-", _range(c), f"{100 * c.sd_share:g} %",
            " and ".join(["settled runs"] * c.settled + ["histories"] * c.over_time),
        )
        for c in channels.EVERY
    ]  # fmt: skip
    further = [(f"`{o.column}`", o.label, o.unit) for o in (*outputs.FURTHER, *derived.TABLE)]
    parts = [
        "# Conditions, channels and outputs",
        "A condition is set before a run, a channel is read from an instrument, an output is computed. The column "
        "of a standard deviation has `_sd` before its unit: `speed_sd_mm_s`.",
        MADE,
        "## Conditions",
        _table(("column", "meaning", "unit", "range", "other units"), conditions),
        "## Channels",
        _table(("column", "meaning", "unit", "range", "assumed noise", "in"), shown),
        "## Outputs",
        _table(("column", "meaning", "unit"), further),
    ]
    return "\n\n".join(parts) + "\n"


def _range(quantity: Any) -> str:
    return " to ".join(f"{x:g}" for x in quantity.range)


def parameters() -> str:
    """Page of the parameters of the paper's robot (value, prior, bounds, source), and of the keys that no fit frees."""
    from calibration.data import robot_file
    from mmrjax.model import paper_robots, params

    entries = []
    for p in params.walk_parameters(paper_robots.nominal()):
        spec, (low, high) = p.spec, p.spec.bounds
        value = f"{float(p.value):.4g} ± {spec.prior_sd(float(p.value)):.2g} {spec.unit}"
        entries.append(
            f"**`{p.name}`** {value}\n: {spec.meaning}. Bounds: {low:g} to {high:g}. Source: {spec.source}\n"
        )
    opening = (
        "Parameters of the packaged robot: nominal value ± standard deviation of the prior, SI unit, meaning, bounds "
        "of a fit, source. `mmrjax explain NAME` prints the equation too. `--set NAME=VALUE` changes one."
    )
    keys = ["| key | allowed | meaning |", "|---|---|---|"]
    keys += [
        f"| `{name}` | {robot_file.allowed_setting(name)} | {meaning} |"
        for name, (_, _, meaning) in robot_file.SETTINGS.items()
    ]
    others = (
        "## Keys that no fit frees",
        "Counts, ratings by makers, switches and choices. Robot files and `--set` take them.",
    )
    return "\n\n".join(["# Parameters", opening, MADE, "\n".join(entries), *others, "\n".join(keys)]) + "\n"


def modules() -> str:
    """Page of the modules, each with the first sentence of its docstring."""
    parts = [
        "# Modules",
        "[The structure of the code](../explanation/code.md) explains the order of the packages.",
        MADE,
    ]
    for package in PACKAGES:
        folders: dict[str, list[tuple[str, str]]] = {}
        for path in sorted((DOCS.parent / package).rglob("*.py")):
            doc = ast.get_docstring(ast.parse(path.read_text("utf-8"))) or ""
            first = re.split(r"(?<=[.])\s", " ".join(doc.partition("\n\n")[0].split()), maxsplit=1)[0]
            if first:
                folder = str(path.parent.relative_to(DOCS.parent))
                folders.setdefault(folder, []).append((f"`{path.name}`", first))
        parts += [f"## `{folder}`\n\n" + _table(("module", "contents"), rows) for folder, rows in folders.items()]
    return "\n\n".join(parts) + "\n"


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}."


def _named(rows: dict[str, str]) -> list[tuple[str, str]]:
    return [(f"`{name}`", meaning) for name, meaning in rows.items()]


def _table(heads: tuple[str, ...], rows: Any) -> str:
    """Table in Markdown."""
    lines = [heads, ("---",) * len(heads), *rows]
    return "\n".join(
        "| " + " | ".join(str(cell).replace("|", "∣").replace("\n", " ") for cell in line) + " |" for line in lines
    )


def picture_source(name: str) -> str:
    """Hash of what a picture of the gallery is made from: templates, renderer, and of the loop its record."""
    pages = DOCS.parent / "sweeps"
    files = [*sorted((pages / "pages" / "templates").iterdir()), pages / "report" / "page_renderer.py"]
    return hashlib.sha256(b"".join(f.read_bytes() for f in [*files, *[RECORD] * (name == "loop")])).hexdigest()[:16]


def example(result: Path) -> str:
    """Tutorial about the loop on the packaged runs, from its `result.json` or the record of it."""
    d = json.loads(result.read_text("utf-8"))
    labels = {"total_current": "current", "motor_speed": "motor speed", "speed": "speed"}
    cells = lambda errors: " | ".join(f"{errors[c]['rms_percent']:.1f}" for c in labels)  # noqa: E731
    reached = lambda errors: f"{max(e['rows'] for e in errors.values())}/{d['rows']}"  # noqa: E731
    lines = [("as stated", d["errors"]["as_stated"]["fitted"])]
    lines += [
        (what, d["errors"][when]["fitted"]) for what, when in (("refitted", "before"), ("with the effects", "after"))
    ]
    table = "\n".join(f"| {what} | {cells(errors)} | {reached(errors)} |" for what, errors in lines)
    unseen = "\n".join(
        f"| another {kind.replace('_', ' and ')} | {when} | {cells(by[key])} | {reached(by[key])} |"
        for kind, by in d["held_out_by"].items()
        for when, key in (("refitted", "before"), ("with the effects", "after"))
    )
    effects = "\n".join(
        f"* **{', or '.join(e['families'])}** (`{e['name']}`, {e['standing']}).\n  Equation: {e['equation'].rstrip('.')}.\n"
        + f"  Size: {e['parameters']['amplitude']['value']:.3g} ± {e['parameters']['amplitude']['sd']:.2g} "
        f"{e['parameters']['amplitude']['unit']}".rstrip(" -")
        + "."
        for e in d["effects"]
    )
    steps = "\n".join(f"1. {step}." for step in d["next_experiment"]["description"].split(". Then: "))
    return f"""# A table of runs

Twenty settled runs of the packaged robot were measured, on tracks (6T2A) and wheels (4W2T), at 15 V without payload and
33 V with 8 kg, on slopes from 0 to 20°. Does the paper's model describe them? One command answers in a minute:

```sh
mmrjax loop measured --out found
```

All numbers below are from `found/result.json`; `found/report.html` shows them with more detail. For your own runs, write a
[table](../reference/tables.md) and replace `measured` by its path.

## Is it complete?

{d["statement"]}

{effects}

| rms error [%] | {" | ".join(labels.values())} | runs reached |
|---|---|---|---|---|
{table}

*As stated* is the model with the unchanged robot file, *refitted* the same model fitted to these runs. A run is *reached*
if the simulated robot has a steady state at its conditions. Otherwise it slides or does not move.

![Residuals of every reading, before and after](figures/before_after.svg)

Each dot is one reading: simulated minus measured, in standard deviations of the instrument. Orange is the refitted model,
blue the model with the effects. The grey band is ± 2 standard deviations.

![Influence of an effect on its readings](figures/law.svg)

The figure shows the reading that an effect changes most, relative to the robot without the effect. Dots are measured;
crosses are the refitted model with nothing added. The blue line is the law with its 95 % band. If an effect is real, the
line follows the dots.

## May I use the robot?

Each block of runs, such as all runs on one slope, is left out in turn and predicted by a fit to the other runs. These
errors show how well the robot file predicts conditions that were not measured:

| rms error of unseen runs [%] | model | {" | ".join(labels.values())} | reached |
|---|---|---|---|---|---|
{unseen}

## What next?

The report proposes:

{steps}

```sh
mmrjax sweep --robot found/robot.toml
mmrjax explain {d["effects"][0]["name"]}
```

The first command simulates the new robot over voltages, payloads and slopes. The second prints the equation, usual size
and bench test of an effect. [Read a verdict](../howto/read-a-verdict.md) explains the other verdicts.
"""


#: Pages of `docs/reference` that follow from the code.
PAGES = {
    "api": api, "commands": commands, "exit-codes": exit_codes, "glossary": glossary, "modules": modules,
    "parameters": parameters, "quantities": quantities, "schemas": schemas, "statuses": statuses,
}  # fmt: skip


def main() -> None:
    """Write the pages."""
    for name, page in PAGES.items():
        (DOCS / "reference" / f"{name}.md").write_text(page(), encoding="utf-8")
    for folder in map(Path, sys.argv[1:]):
        (DOCS / "start" / "table.md").write_text(example(folder / "result.json"), encoding="utf-8")
        result = json.loads((folder / "result.json").read_text("utf-8"))
        kept = {name: result[name] for name in RECORDED}
        RECORD.write_text(json.dumps(kept, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        for name in FIGURES:
            shutil.copy(folder / "figures" / f"{name}.svg", DOCS / "start" / "figures")


if __name__ == "__main__":
    main()
