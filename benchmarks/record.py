"""Digests of the results of every command, in `tests/record/commands`, so that no result changes unnoticed.

    python benchmarks/record.py --check             # to the tolerance of each case. Exits with 1 for a difference
    python benchmarks/record.py --check --exact     # to the last digit, if only code was moved
    python benchmarks/record.py --write --only size # after a correction, with a line in CHANGELOG.md

A case is a command with few points, rows or searches, and takes a folder of inputs. The digest covers the exit code
and the CSV, JSON and TOML files of the result. Text is stored as a hash. Each list of numbers under one name is
stored as count, norm and two weighted sums (short ones as they are). Times, places and versions are left out.
`benchmarks/test_record_commands.py` checks all cases, and a few quick ones with every `make test`.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import dataclasses
import hashlib
import io
import json
import math
import os
import shutil
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from calibration.data.input_errors import is_number
from mmrjax import OLDER_EMITTERS

RECORD = Path(__file__).resolve().parents[1] / "tests" / "record" / "commands"
ROBOTINO = Path(__file__).resolve().parents[1] / "docs" / "rigs" / "robotino"
#: Largest relative difference of numbers: of solutions, and of searches that end at a small gain.
SOLVED, SEARCHED = 1e-6, 1e-3
#: Size below which a number counts as rounding, in any unit.
NOTHING = 1e-12
#: Keys with time, place or program version.
PROVENANCE = frozenset(
    ("program", "arguments", "python", "versions", "devices", "float", "started", "seconds", "hashes", "identity")
)
#: Longest list of numbers that is stored as it is.
SHORT = 6


@dataclasses.dataclass(frozen=True)
class Case:
    """A command, as words. `after`: a case whose folders it reads, if any. `rtol`: tolerance of its numbers."""

    words: str
    after: str = ""
    rtol: float = SOLVED


LOOP = "--replicates 250 --no-report"
FEW = "--slopes 0,10 --payloads 0,8 --voltages 15,33 --no-report"
KINDS = ("tracked", "wheeled", "bench", "pendulum", "linear")
CASES = {
    "simulate": Case("simulate --configuration 4W2T --voltage 24 --slope 10 --payload 5 --no-report"),
    "simulate_drive": Case("simulate --model drive --duration 0.5 --slope 5 --no-report"),
    "simulate_track": Case("simulate --model track --duration 0.1 --no-report"),
    "simulate_rig": Case("simulate --robot winch.toml --voltage 12 --no-report"),
    "mission": Case("simulate --profile patrol --battery --payload 5 --no-report"),
    "sweep": Case(f"sweep {FEW}"),
    "sweep_rig": Case("sweep --robot bench.toml --motor-speeds 500,1000,2000 --no-report"),
    "sweep_store": Case("sweep plan.toml --export csv --no-report"),
    "compare": Case("compare measured --no-report"),
    "compare_rig": Case("compare bench.csv --robot bench.toml --no-report"),
    "reproduce": Case("reproduce"),
    "calibrate": Case(
        "calibrate measured --noise current=2%,motor_speed=0.5%,speed=1% --starts 4 --no-profiles --no-report",
        rtol=SEARCHED,
    ),
    "calibrate_rig": Case("calibrate bench.csv --robot bench.toml --starts 4 --no-report", rtol=SEARCHED),
    "simulate_posterior": Case("simulate --robot calibrate/robot.toml --posterior 20 --no-report", "calibrate"),
    "loop_bench": Case(f"loop bench.csv --robot bench.toml {LOOP}", rtol=SEARCHED),
    "loop_winch": Case(f"loop winch.csv --robot winch.toml {LOOP}", rtol=SEARCHED),
    "loop_robotino": Case(
        f"loop settled.csv --robot robotino.toml --noise current=5%,speed=10% {LOOP}", rtol=SEARCHED
    ),
    "sensitivity": Case(f"sensitivity --parameters motor.* --outputs speed,total_current --evaluations 4000 {FEW}"),
    "sensitivity_local": Case(f"sensitivity --method local --parameters motor.* --outputs speed,total_current {FEW}"),
    "sensitivity_posterior": Case(
        f"sensitivity --robot calibrate/robot.toml --posterior --outputs speed --evaluations 4000 {FEW}", "calibrate"
    ),
    "resonance": Case("resonance --voltages 10:34:6 --payloads 0 --duration 0.5 --no-report"),
    "climb": Case("climb --gap 60 --levers-front 45 --voltage 24 --duration 2 --time-step 4e-4 --no-report"),
    "check": Case("check aims.toml --no-report"),
    "size": Case("size aims.toml --no-report", rtol=SEARCHED),
    "rig_check": Case("rig check bench.toml bench.csv --json"),
    "rig_check_robotino": Case("rig check robotino.toml settled.csv --json"),
    **{f"rig_new_{kind}": Case(f"rig new new_{kind}.toml --kind {kind}") for kind in KINDS},
}
#: Quick cases, those of `make test`: a rig solved, and files written.
QUICK = ("simulate_rig", "sweep_rig", "rig_new_bench", "rig_new_tracked")


def run(name: str, folder: Path) -> dict[str, Any]:
    """Runs a case in `folder`, which has its inputs, and returns digests of its results.

    A folder of `--out` has the case's name. The case runs in this process, so that cases share compiled programs.
    """
    from sweeps import cli

    words = CASES[name].words.split()
    left_by = [] if words[0] == "rig" else ["--out", name]
    before = {path for path in folder.iterdir()}
    said, old = io.StringIO(), (Path.cwd(), sys.argv)
    try:
        os.chdir(folder)
        sys.argv = ["mmrjax", *words, *left_by]
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(io.StringIO()):
            try:
                cli.main()
                code: Any = 0
            except SystemExit as end:
                code = end.code
    finally:
        os.chdir(old[0])
        sys.argv = old[1]
    files = {f"{name}/{p.relative_to(folder / name)}": p for p in sorted((folder / name).rglob("*"))}
    files |= {path.name: path for path in sorted(set(folder.iterdir()) - before) if path.is_file()}
    left = {at: values for at, path in files.items() if (values := list(_read(path)))}
    if "--json" in words:
        left["stdout"] = list(_flat(json.loads(said.getvalue())))
    return {"words": CASES[name].words, "code": code, "files": {at: digest(values) for at, values in left.items()}}


def inputs(folder: Path) -> None:
    """Copies the inputs of the cases into a folder."""
    for path in (*RECORD.glob("*.toml"), *RECORD.glob("*.csv"), *ROBOTINO.glob("*.toml"), *ROBOTINO.glob("*.csv")):
        shutil.copy(path, folder)


# --- digests ------------------------------------------------------------------------------------------

Leaf = tuple[str, Any]


def _read(path: Path) -> Iterator[Leaf]:
    """Yields names and values of a file in order. Nothing for a store's identity or a picture."""
    if path.suffix == ".csv":
        with path.open(encoding="utf-8", newline="") as stream:
            rows = csv.reader(stream)
            head = next(rows)
            yield "columns", " ".join(head)
            for row in rows:
                yield from ((name, _number(cell)) for name, cell in zip(head, row, strict=True))
    elif path.suffix == ".json" and ".zarr" not in str(path) and path.name != "identity.json":  # hashes of the code
        yield from _flat(json.loads(path.read_text(encoding="utf-8")))
    elif path.suffix == ".toml":
        yield from _flat(tomllib.loads(path.read_text(encoding="utf-8")))


def _number(cell: str) -> Any:
    try:
        return float(cell)
    except ValueError:
        return cell


def _flat(value: Any, name: str = "") -> Iterator[Leaf]:
    """Leaves of nested tables under dotted names. Those of a list under one name."""
    if isinstance(value, dict):
        yield f"{name}{{}}", " ".join(key for key in value if key not in PROVENANCE)
        for key, item in value.items():
            if key not in PROVENANCE:
                yield from _flat(item, f"{name}.{key}" if name else key)
    elif isinstance(value, list):
        yield f"{name}[]", str(len(value))
        for item in value:
            yield from _flat(item, f"{name}[]")
    else:
        yield name, value


def digest(leaves: list[Leaf]) -> dict[str, Any]:
    """Values by name: numbers as a list, or as count, norm and two weighted sums. Others and the whole as a hash."""
    groups: dict[str, list[Any]] = {}
    for name, value in leaves:
        groups.setdefault(name, []).append(value)
    kept: dict[str, Any] = {"exact": _hash(leaves)}
    for name, values in groups.items():
        numbers = [v for v in values if is_number(v)]
        rest = [None if is_number(v) else v for v in values]
        if numbers:
            kept[name] = numbers if len(numbers) <= SHORT else _sums(numbers)
        if len(numbers) < len(values):
            kept[f"{name}, text"] = values[0] if len(values) == 1 and len(str(values[0])) <= 40 else _hash(rest)
    return kept


def _hash(values: Any) -> str:
    return hashlib.sha256(json.dumps(values).encode()).hexdigest()[:16]


def _sums(x: list[float]) -> dict[str, float]:
    """Count, norm and two sums with weights in [-1, 1] that depend on the position in the list."""
    return {
        "count": len(x),
        "norm": math.sqrt(math.fsum(v * v for v in x)),
        "first": math.fsum(v * math.cos(1.7 * k * k + 0.4) for k, v in enumerate(x)),
        "second": math.fsum(v * math.sin(2.3 * k * k + 0.9) for k, v in enumerate(x)),
    }


# --- comparison ---------------------------------------------------------------------------------------


def differences(was: dict[str, Any], now: dict[str, Any], rtol: float, exact: bool = False) -> list[str]:
    """Differences of two records of a case, one line each.

    Args:
        rtol: largest difference of numbers relative to the largest of their list, or to their norm.
        exact: True to compare every digit too.
    """
    found = [f"{key}: {now[key]} (was {was[key]})" for key in ("words", "code") if was[key] != now[key]]
    old, new = was["files"], now["files"]
    found += [f"{at}: {'not left' if at in old else 'new'}" for at in sorted(set(old) ^ set(new))]
    for at in sorted(set(old) & set(new)):
        if old[at]["exact"] == new[at]["exact"]:
            continue
        names = [*old[at], *(name for name in new[at] if name not in old[at])]
        lines = [
            f"{at}: {name}: {new[at].get(name)} (was {old[at].get(name)})"
            for name in names
            if name != "exact" and not _close(old[at].get(name), new[at].get(name), rtol)
        ]
        found += lines or ([f"{at}: differs in its last digits"] if exact else [])
    return found


def _close(a: Any, b: Any, rtol: float) -> bool:
    if isinstance(a, dict) and isinstance(b, dict):
        allowed = rtol * max(a["norm"], b["norm"]) + NOTHING
        return a["count"] == b["count"] and all(
            abs(a[key] - b[key]) <= allowed for key in ("norm", "first", "second")
        )
    if isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        allowed = rtol * max(abs(x) for x in (*a, *b)) + NOTHING
        return all(abs(x - y) <= allowed for x, y in zip(a, b, strict=True))
    return type(a) is type(b) and a == b


def record(name: str) -> dict[str, Any]:
    """The stored record of a case."""
    return json.loads((RECORD / f"{name}.json").read_text(encoding="utf-8"))


def as_text(kept: dict[str, Any]) -> str:
    """A record as JSON, with a line for each name."""

    def line(value: Any) -> str:
        return json.dumps(value, ensure_ascii=False)

    files = [
        f"  {line(at)}: {{\n" + ",\n".join(f"   {line(k)}: {line(v)}" for k, v in names.items()) + "\n  }"
        for at, names in kept["files"].items()
    ]
    head = "".join(f" {line(key)}: {line(kept[key])},\n" for key in ("words", "code"))
    return "{\n" + head + ' "files": {\n' + ",\n".join(files) + "\n }\n}\n"


def with_needed(names: list[str]) -> list[str]:
    """Cases in the order of `CASES`, with those whose folders they read."""
    wanted = {*names, *(CASES[name].after for name in names)} - {""}
    return [name for name in CASES if name in wanted]


def main() -> int:
    # Compiled by the older emitters, in half of the time; traced, because programs on disk may be of another source.
    os.environ.setdefault("XLA_FLAGS", f"--xla_backend_extra_options={OLDER_EMITTERS}")
    os.environ["MMRJAX_PROGRAMS"] = ""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--check", action="store_true", help="compare with the record")
    what.add_argument("--write", action="store_true", help="write the record again")
    parser.add_argument("--exact", action="store_true", help="compare every digit")
    parser.add_argument("--only", action="append", choices=list(CASES), help="one case, repeatable; default: all")
    options = parser.parse_args()
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        inputs(Path(folder))
        for name in with_needed(options.only or list(CASES)):
            began = time.process_time()
            now = run(name, Path(folder))
            spent = f"{time.process_time() - began:6.1f} s"
            if options.write:
                (RECORD / f"{name}.json").write_text(as_text(now), encoding="utf-8")
                print(f"{spent}  {name}: exit code {now['code']}", flush=True)
                continue
            found = differences(record(name), now, CASES[name].rtol, options.exact)
            failed += bool(found)
            print(f"{spent}  {name}: {'differs' if found else 'as recorded'}", *found, sep="\n          ", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
