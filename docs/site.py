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
from collections.abc import Iterator
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parent
FIGURES = ("before_after", "laws", "errors")


def api() -> str:
    """Every public name with its signature and docstring."""
    import mmrjax as mm

    parts = [
        "# The public names",
        "`import mmrjax as mm` gives every public name; SI units unless a name says otherwise. This page is made from the docstrings.",
    ]
    for name in sorted((n for n in mm.__all__ if not n.startswith("_")), key=str.lower):
        thing = getattr(mm, name)
        if not callable(thing):
            parts.append(f"## `mm.{name}`\n\n`{thing!r}`")
            continue
        signature = "" if inspect.isclass(thing) and issubclass(thing, BaseException) else _signature(thing)
        parts.append(f"## `mm.{name}{signature}`\n\n```text\n{inspect.getdoc(thing)}\n```")
        if inspect.isclass(thing) and not issubclass(thing, BaseException):
            parts += [f"### `{name}.{m}`\n\n```text\n{inspect.getdoc(f)}\n```" for m, f in _methods(thing)]
    return "\n\n".join(parts) + "\n"


def _signature(thing: Any) -> str:
    names = [n for n in inspect.signature(thing).parameters if n not in ("self", "cls")]
    return f"({', '.join(names)})"


def _methods(kind: type) -> Iterator[tuple[str, Any]]:
    for name, member in vars(kind).items():
        if not name.startswith("_") and (inspect.isfunction(member) or isinstance(member, property)):
            yield name, member


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
