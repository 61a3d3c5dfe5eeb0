"""Modules that pass on a table, or a command's configuration, while a command runs.

    python benchmarks/passes.py runs loop measured
    python benchmarks/passes.py config sweep --voltages 24

A module of the program counts if one of its functions is called with the object among its arguments, except the
object's own module. Two counts: all modules, and modules that pass it on to another. Prints a line of JSON.
"""

from __future__ import annotations

import argparse
import json
import sys
import threading
from types import FrameType
from typing import Any

import pydantic

from calibration.data.table import Runs
from sweeps.cli import main

KINDS = {"runs": Runs, "config": pydantic.BaseModel}
PROGRAM = ("mmrjax", "calibration", "sweeps")


def taken(frame: FrameType, kind: type) -> bool:
    """True if an argument of a function is an object of a kind, or a tuple that contains one."""
    code = frame.f_code
    count = code.co_argcount + code.co_kwonlyargcount + bool(code.co_flags & 4) + bool(code.co_flags & 8)
    given = [frame.f_locals.get(name) for name in code.co_varnames[:count]]
    return any(isinstance(x, kind) or (isinstance(x, tuple) and any(isinstance(y, kind) for y in x)) for x in given)


def watched(kind: type, arguments: list[str]) -> dict[str, Any]:
    """Modules through which a command with these arguments passes an object of a kind."""
    found: dict[str, None] = {}
    steps: dict[tuple[str, str], None] = {}
    own = {base.__module__ for base in (kind, *kind.__subclasses__())} | {"sweeps.config", "sweeps.config_campaign"}

    def seen(frame: FrameType | None, event: str, _: Any) -> None:
        name = frame.f_globals.get("__name__", "") if frame is not None and event == "call" else ""
        if frame is None or name.partition(".")[0] not in PROGRAM or name in own or not taken(frame, kind):
            return
        found[name] = None
        caller = frame.f_back
        while caller is not None and caller.f_globals.get("__name__", "").partition(".")[0] not in PROGRAM:
            caller = caller.f_back
        if caller is not None and caller.f_globals["__name__"] != name:
            steps[caller.f_globals["__name__"], name] = None

    sys.argv = ["mmrjax", *arguments]
    threading.setprofile(seen)
    sys.setprofile(seen)
    try:
        main()
    except SystemExit:
        pass
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    on = {module for module, _ in steps} & set(found)
    return {"modules": len(found), "hand_on": len(on), "which": {name: name in on for name in found}}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=KINDS, help="what is followed")
    parser.add_argument("command", nargs=argparse.REMAINDER, help="command of mmrjax, with its options")
    given = parser.parse_args()
    print(json.dumps(watched(KINDS[given.kind], given.command)))
