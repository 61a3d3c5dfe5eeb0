"""Pages of the docs that are made and not written: the public names from their docstrings, the glossary, and the loop
by an example of its run folder.

    python docs/site.py            # docs/api.md, docs/glossary.md
    python docs/site.py found      # docs/example.md too, of the run folder of `mmrjax loop measured --out found`
"""

from __future__ import annotations

import inspect
import json
import shutil
import sys
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parent
FIGURES = ("before_after", "laws", "errors")
PACKAGES = ("mmrjax", "calibration", "sweeps")


def api() -> str:
    """Every public name with its signature, what it returns and its docstring; then the types that they return."""
    import mmrjax as mm

    parts = [
        "# The public names",
        "`import mmrjax as mm` gives every public name; SI units unless a name says otherwise. This page is made from the docstrings.",
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
    parts.append("# What they return")
    for kind in returned_types():
        parts += [f"## `{kind.__name__}`\n\n{_text(kind)}", *_members(kind, kind.__name__)]
    return "\n\n".join(parts) + "\n"


def returned_types() -> list[type]:
    """Types of this project that public functions return and that are no public names themselves."""
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
    """A docstring; of a function with what it returns, where the docstring has no section on that."""
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
    """Sections of the methods and properties of a class, with what they return."""
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
    """The words of pages and terminal."""
    from sweeps.pages.words import GLOSSARY

    lines = [f"**{word}**\n: {meaning}\n" for word, meaning in GLOSSARY.items()]
    return "# Words\n\nWhat pages and terminal say; `mmrjax explain NAME` explains every other name.\n\n" + "\n".join(
        lines
    )


def example(folder: Path) -> str:
    """The loop on the packaged runs, told from its `result.json`."""
    d = json.loads((folder / "result.json").read_text("utf-8"))
    labels = {"total_current": "current", "motor_speed": "motor speed", "speed": "speed"}
    cells = lambda errors: " | ".join(f"{errors[c]['rms_percent']:.1f}" for c in labels)  # noqa: E731
    reached = lambda errors: f"{max(e['rows'] for e in errors.values())}/{d['rows']}"  # noqa: E731
    lines = [("as stated", d["errors"]["as_stated"]["fitted"])]
    lines += [
        (what, d["errors"][when]["fitted"])
        for what, when in (("refitted", "before"), ("with what was found", "after"))
    ]
    table = "\n".join(f"| {what} | {cells(errors)} | {reached(errors)} |" for what, errors in lines)
    unseen = "\n".join(
        f"| another {kind.replace('_', ' and ')} | {cells(by['before'])} | {reached(by['before'])} | {cells(by['after'])} | {reached(by['after'])} |"
        for kind, by in d["held_out_by"].items()
    )
    found = "\n".join(
        f"* **{', or '.join(e['families'])}** (`{e['name']}`, {e['standing']}): {e['parameters']['amplitude']['value']:.3g} ± "
        f"{e['parameters']['amplitude']['sd']:.2g} {e['parameters']['amplitude']['unit']}; {e['equation'].rstrip('.')}."
        for e in d["effects"]
    )
    after = d["next_experiment"]
    return f"""# The loop by an example

Twenty settled runs of the robot were measured: two configurations, 15 and 33 V, slopes of 0 to 20°. Is the paper's model
of it complete? One command asks, in a minute on two cores:

```sh
mmrjax loop measured --out found
```

All figures below come from `found/result.json`; `found/report.html` shows them with everything behind them.

## Is it complete?
{d["statement"]}

{found}

| rms error [%] | {" | ".join(labels.values())} | runs reached |
|---|---|---|---|---|
{table}

![Residuals of every reading, before and after](example/before_after.svg)

Each dot is one reading: simulated less measured, in standard deviations of the instrument. Orange: the model with its
parameters fitted again; blue: with what was found. Noise stays in the grey band.

![What each effect explains, on its readings](example/laws.svg)

For each effect, the reading that it changes most, less that of the same robot without it: dots measured, dashes simulated.
If an effect is real, its dashes follow the dots along the whole axis.

## May I use the robot it wrote?
| rms error [%] of runs that the fit has not seen | refitted: {" | ".join(labels.values())} | reached | with what was found: {" | ".join(labels.values())} | reached |
|---|---|---|---|---|---|---|---|---|
{unseen}

![Errors of runs that the fit has seen and has not](example/errors.svg)

Each kind of block is left out in turn, and predicted by a fit that has not seen it. Use the robot for the kinds of
step that have small errors here, and not for those that have large ones.

## What next?
**{after["name"].capitalize()}.** {after["description"]}.

```sh
mmrjax sweep --robot found/robot.toml      # what it does over voltages, payloads and slopes
mmrjax explain {d["effects"][0]["name"]}            # the effect: equation, size, how to test for it
```
[How the loop decides](loop.md), [its words](glossary.md).
"""


def main() -> None:
    """Write the pages."""
    (DOCS / "api.md").write_text(api(), encoding="utf-8")
    (DOCS / "glossary.md").write_text(glossary(), encoding="utf-8")
    for folder in map(Path, sys.argv[1:]):
        (DOCS / "example.md").write_text(example(folder), encoding="utf-8")
        (DOCS / "example").mkdir(exist_ok=True)
        for name in FIGURES:
            shutil.copy(folder / "figures" / f"{name}.svg", DOCS / "example")


if __name__ == "__main__":
    main()
