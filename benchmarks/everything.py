"""Runs all tiers of checks one after another, goes on after a failure, and prints one table.

    python benchmarks/everything.py --jobs 64                       # all tiers
    python benchmarks/everything.py --jobs 64 --limit-minutes 9     # stops in time
    python benchmarks/everything.py --jobs 64 --go-on               # only what the last call did not finish
    python benchmarks/everything.py --table                         # the table of what has finished so far

Each test's outcome is written to `TIER.jsonl` in the output folder as soon as it is known, so a killed call loses
only the tests in progress. The folder also has the output of each tier (`TIER.txt`) and the table (`table.json`).
Needs no virtual environment: `--python` names an interpreter that imports what the tests need, for instance through
PYTHONPATH. Exits with 1 if a tier failed or did not finish.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
#: Files that are tiers of their own, though their tests are marked slow.
SEPARATE = {"attack": "tests/test_attack.py", "browser": "tests/test_browser.py"}
MARKS = {"quick": "not slow", "slow": "slow and not nightly", "nightly": "nightly"}
TIERS = ("lint", "quick", "slow", "nightly", "attack", "browser", "mutants")
LINT = {
    "ruff check": ("ruff", "check", "."),
    "ruff format": ("ruff", "format", "--check", "."),
    "mypy": ("mypy",),
}
OUTCOMES = ("passed", "failed", "skipped")
#: Flags of `make test`: programs compile faster and run slower.
FLAGS = (
    "--xla_backend_extra_options=xla_cpu_disable_new_fusion_emitters=true",
    "--xla_backend_optimization_level=1",
    "--xla_cpu_parallel_codegen_split_count=1",
)
#: Time for pytest to write its summary after an interrupt, before it is killed [s].
GRACE = 30.0
#: Workers above which tests are distributed singly, since the longest file would take longer than the rest.
MANY = 8


def note(log: Path, **entry: Any) -> None:
    """Appends a line to a tier's log."""
    with log.open("a", encoding="utf-8") as file:
        file.write(json.dumps({**entry, "at": time.time()}) + "\n")


def entries(log: Path) -> list[dict[str, Any]]:
    """Lines of a tier's log, without one that was cut in the middle."""
    read = []
    for line in log.read_text(encoding="utf-8").splitlines() if log.exists() else []:
        try:
            read.append(json.loads(line))
        except ValueError:
            continue
    return read


def outcomes(log: Path) -> dict[str, dict[str, Any]]:
    """Last entry of each finished test."""
    return {entry["test"]: entry for entry in entries(log) if "test" in entry}


def summary(tier: str, log: Path) -> dict[str, Any]:
    """Row of the table: counts, minutes, and what is missing. It follows from the log alone."""
    lines, tests = entries(log), outcomes(log)
    row: dict[str, Any] = {"tier": tier}
    row |= {outcome: sum(test["outcome"] == outcome for test in tests.values()) for outcome in OUTCOMES}
    starts = [k for k, line in enumerate(lines) if "command" in line]
    calls = [lines[a:b] for a, b in zip(starts, [*starts[1:], None], strict=False)]
    row["minutes"] = round(sum(call[-1]["at"] - call[0]["at"] for call in calls) / 60, 2)
    last = calls[-1] if calls else []
    selected = max((line["selected"] for line in last if "selected" in line), default=None)
    if selected is not None:
        row["left"] = max(
            0, selected - len({line["test"] for line in last if not line.get("test", ".py").endswith(".py")})
        )
    codes = [line["code"] for line in last if "code" in line]
    row["state"] = "not run" if not calls else "not finished" if not codes or row.get("left") else "finished"
    if codes and codes[0] not in (0, 5) and row["state"] == "finished" and not row["failed"]:
        row["state"] = f"exit code {codes[0]}"  # no tests collected is 5
    return row


def table(out: Path, tiers: list[str]) -> list[dict[str, Any]]:
    """Rows of all tiers. Printed, and written to `table.json`."""
    rows = [summary(tier, out / f"{tier}.jsonl") for tier in tiers]
    (out / "table.json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    print(f"\n{'tier':10}" + "".join(f"{name:>9}" for name in (*OUTCOMES, "minutes")))
    for row in rows:
        left = f", {row['left']} left" if row.get("left") else ""
        state = "" if row["state"] == "finished" else f"  {row['state']}{left}"
        print(f"{row['tier']:10}" + "".join(f"{row[name]:9}" for name in OUTCOMES) + f"{row['minutes']:9.1f}{state}")
    print(f"written to {out / 'table.json'}", flush=True)
    return rows


def commands(tier: str, options: argparse.Namespace) -> dict[str, list[str]]:
    """Commands of a tier by name. The results of pytest and of the mutants are logged one test at a time."""
    python, log = options.python, options.out / f"{tier}.jsonl"
    finished = outcomes(log)
    if tier == "lint":
        return {name: [python, "-m", *words] for name, words in LINT.items() if name not in finished}
    if tier == "mutants":
        command = [python, "benchmarks/mutants.py", "--jobs", str(options.jobs)]
        if finished:
            listed = re.findall(r"^\[(\w+)\]$", (ROOT / "tests" / "mutants.toml").read_text(encoding="utf-8"), re.M)
            left = [name for name in listed if name not in finished]
            return {tier: [*command, *(f"--only={name}" for name in left)]} if left else {}
        return {tier: command}
    words = ["--durations=10", "--durations-min=2", "-p", "everything_log", f"--junitxml={options.junit / tier}.xml"]
    if options.jobs > 1:
        words += [f"-n{options.jobs}", "--dist", "worksteal" if options.jobs > MANY else "loadfile"]
        words += ["--no-loadscope-reorder"]
    if tier in SEPARATE:
        words += [SEPARATE[tier]]
    else:
        words += ["-m", MARKS[tier], *(f"--ignore={file}" for file in SEPARATE.values())]
    return {tier: [python, "-m", "pytest", *words]}


def environment(python: str, log: Path, done: Path) -> dict[str, str]:
    """Environment of a tier: this tree's packages first, fast compilation, and where tests are logged."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "benchmarks"), *filter(None, [os.environ.get("PYTHONPATH")])])
    return {
        "XLA_FLAGS": " ".join(FLAGS),
        **os.environ,
        "PYTHONPATH": path,
        "PYTHONDONTWRITEBYTECODE": "",  # tests start processes, which would compile all modules again
        "EVERYTHING_LOG": str(log),
        "EVERYTHING_DONE": str(done),
    }


def run(command: list[str], log: Path, seconds: float, extra: dict[str, str]) -> int | None:
    """Exit code of a command, None if it was stopped at its limit. Its output is appended to `TIER.txt`."""
    process = subprocess.Popen(
        command, cwd=ROOT, env=extra, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace",
        start_new_session=True,
    )  # fmt: skip

    def read() -> None:
        assert process.stdout is not None
        with log.with_suffix(".txt").open("a", encoding="utf-8") as file:
            for line in process.stdout:
                file.write(line)
                file.flush()
                if mutant := re.match(r"(killed|survived|error) +([\d.]+) s +\S+ +(\w+) ", line):
                    outcome = "passed" if mutant[1] == "killed" else "failed"
                    note(log, test=mutant[3], outcome=outcome, seconds=float(mutant[2]), text=mutant[1])
                elif number := re.match(r"(\d+) mutants; the tests", line):
                    note(log, selected=int(number[1]))

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    try:
        return process.wait(seconds)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGINT)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(GRACE)
        return None
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)  # workers that outlive it
        process.wait()
        reader.join(5)


def run_tier(tier: str, options: argparse.Namespace, until: float) -> None:
    """Runs a tier and logs its results."""
    log, done = options.out / f"{tier}.jsonl", options.out / f"{tier}.done"
    done.write_text("\n".join(outcomes(log)), encoding="utf-8")
    todo = commands(tier, options)
    if not todo:
        return
    note(log, command=" ".join(next(iter(todo.values()))[:12]))
    codes: list[int | None] = []
    for name, command in todo.items():
        if tier == "lint":
            usable = subprocess.run([*command[:3], "--version"], capture_output=True, cwd=ROOT).returncode == 0
            code = run(command, log, until - time.time(), environment(options.python, log, done)) if usable else 0
            if code is not None:
                outcome = "skipped" if not usable else "failed" if code else "passed"
                note(log, test=name, outcome=outcome, text="" if usable else f"no module {command[2]}")
        else:
            code = run(command, log, until - time.time(), environment(options.python, log, done))
        codes.append(code)
    if None not in codes:
        note(log, code=max(codes, key=abs))  # type: ignore[arg-type]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="tests at a time (default 2)")
    parser.add_argument("--tiers", default=",".join(TIERS), help="tiers by comma (default all: %(default)s)")
    parser.add_argument("--python", default=sys.executable, metavar="PATH", help="interpreter (default: this one)")
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "everything", metavar="DIR")
    parser.add_argument("--junit", type=Path, metavar="DIR", help="JUnit files of the tiers (default: with the rest)")
    parser.add_argument("--limit-minutes", type=float, default=1e6, metavar="M", help="limit of the whole call")
    parser.add_argument("--go-on", action="store_true", help="leave out tests that earlier calls finished")
    parser.add_argument("--table", action="store_true", help="only print the table of what has finished so far")
    options = parser.parse_args()
    tiers = options.tiers.split(",")
    if unknown := [tier for tier in tiers if tier not in TIERS]:
        parser.error(f"--tiers: got {unknown[0]}; expected some of {', '.join(TIERS)}")
    if options.jobs < 1:
        parser.error(f"--jobs: got {options.jobs}; expected at least 1")
    options.out = options.out.resolve()
    options.junit = (options.junit or options.out).resolve()
    for folder in (options.out, options.junit):
        folder.mkdir(parents=True, exist_ok=True)
    for tier in [] if options.go_on or options.table else tiers:
        for suffix in (".jsonl", ".txt"):
            (options.out / f"{tier}{suffix}").unlink(missing_ok=True)
    until = time.time() + 60 * options.limit_minutes
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    try:
        for tier in [] if options.table else tiers:
            if time.time() >= until:
                break
            print(f"{time.strftime('%H:%M:%S')} {tier}", flush=True)
            run_tier(tier, options, until)
            for name, test in outcomes(options.out / f"{tier}.jsonl").items():
                if test["outcome"] == "failed":
                    print(f"  FAILED {name}", flush=True)
            if summary(tier, options.out / f"{tier}.jsonl")["state"].startswith("exit code"):
                print((options.out / f"{tier}.txt").read_text(encoding="utf-8")[-500:], flush=True)
    finally:
        rows = table(options.out, tiers)
    return 1 if any(row["failed"] or row["state"] != "finished" for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
