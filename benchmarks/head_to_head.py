"""Comparison of our loop with other methods, on the same hold-out blocks of the same records.

    python benchmarks/head_to_head.py --jobs 30 --public FOLDER --cases FOLDER
    python benchmarks/head_to_head.py --records packaged,rig-00 --methods refit,scipy,ridge
    python benchmarks/head_to_head.py --table

Records are the packaged table, public records of others, cases of a folder and synthetic rigs of `tests/worlds`.
Methods are our refit, our verdict, SciPy's least squares on independent NumPy physics, MuJoCo's identification
toolbox and PySINDy on the defects. Two regressions on the refit's residuals estimate the best prediction that these
channels allow. For each optional package that is missing a line reports it. `--packages FOLDER` adds a search path:

    pip install --target FOLDER --no-deps pysindy derivative scikit-learn joblib threadpoolctl narwhals \\
        absl-py colorama imageio plotly tabulate

Each record and method is a line of `--out`. A restarted run continues where it ended.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import multiprocessing
import os
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import campaign
import numpy as np
import public_records
import rivals
from loop_findings import plain
from loop_scores import interval

METHODS = tuple(rivals.METHODS)
#: Methods to compare with the verdict; regressions whose better one is the ceiling.
COMPETITORS, CEILING = ("refit", "scipy", "mujoco", "sindy"), ("ridge", "boosted")
#: Words of the table.
WORDS = {
    "refit": "our refit", "verdict": "our terms", "scipy": "SciPy", "mujoco": "MuJoCo sysid", "sindy": "PySINDy",
    "ridge": "ridge", "boosted": "boosted trees", "true": "true term",
}  # fmt: skip
#: Least share of the refit's rows that a method has to predict for a comparison.
PREDICTED = 0.9
#: Relative difference by which a competitor's error has to be lower to count as lower.
TENTH = 0.1
#: Records and methods of `--quick`.
QUICK = {"records": "rig-00", "methods": "refit,ridge"}


@dataclasses.dataclass(frozen=True)
class Job:
    """A record with its methods and options of the run."""

    record: str
    methods: tuple[str, ...]
    public: Path | None
    cases: Path | None
    packages: Path | None
    seed: int
    replicates: int


# --- one record, in a process of its own --------------------------------------------------------------------


def work(job: Job, line: Connection, core: int | None = None) -> None:
    """Runs the methods of a record. Sends ("begin", method) and ("line", line) for each."""
    if core is not None:
        os.sched_setaffinity(0, {core})
    if job.packages is not None:
        sys.path.append(str(job.packages))  # after the installed packages
    for method, result in lines(job, lambda method: line.send(("begin", method))):
        line.send(("line", {"record": job.record, "method": method, **result}))
    line.send(("end", ""))


def lines(job: Job, begin: Any = lambda method: None) -> Iterable[tuple[str, dict[str, Any]]]:
    """Yields (method, its line) for the methods of a record. A failure is a line too.

    Args:
        begin: called with each method before it runs.
    """
    with tempfile.TemporaryDirectory() as folder:
        begin("base")
        began = time.perf_counter()
        try:
            record = public_records.record(job.record, Path(folder), job.public, job.cases, job.seed)
            posed = rivals.posed(record.robot, record.table, job.seed, job.replicates, record.case)
        except Exception as error:
            yield from ((method, {"failed": _why(error)}) for method in job.methods)
            return
        base = time.perf_counter() - began
        for method in job.methods:
            begin(method)
            began = time.perf_counter()
            try:
                found = rivals.quietly(rivals.METHODS[method], posed)
            except Exception as error:
                yield method, {"failed": _why(error)}
                continue
            spent = time.perf_counter() - began
            seconds = found.seconds or (base if method == "refit" else spent)
            yield method, {"seconds": seconds, "truth": record.answer.kind, **measured(posed, found, record.answer)}


def _why(error: Exception) -> str:
    known = isinstance(error, public_records.NoRecord | rivals.Unable)
    return str(error) if known else f"{type(error).__name__}: {error}"


def measured(posed: Any, found: Any, answer: public_records.Answer) -> dict[str, Any]:
    """Errors of a method in percent of the measured rms, by kind of block, row and channel, and its claim."""
    size = np.sqrt(np.nanmean(np.where(posed.counts, posed.measured, np.nan) ** 2, 0))
    off: dict[str, np.ndarray] = {}
    for fold, reading in zip(posed.folds, found.unseen, strict=True):
        here = off.setdefault(fold.kind, np.full(posed.measured.shape, np.nan))
        rows = fold.out[:, None] & posed.counts
        here[rows] = (100 * (reading - posed.measured) / size)[rows]
    claim = {"level": found.level, "claims": found.claims, "families": found.families} if found.level else {}
    if claim:
        claim["wrong"] = public_records.judged(found.level, found.claims, found.families, answer)
    return {
        "channels": posed.channels,
        "off": {kind: [[_short(v) for v in row] for row in x] for kind, x in off.items()},
        "note": found.note,
        **claim,
    }


def _short(x: float) -> float | None:
    return float(f"{x:.4g}") if np.isfinite(x) else None


# --- all records --------------------------------------------------------------------------------------------


def run(jobs: Sequence[Job], count: int, within: float, keep: Any) -> None:
    """Runs records on `count` processes.

    A method that takes longer than `within` seconds is ended with its process. The record's remaining methods run in
    another one.

    Args:
        keep: called with each line.
    """
    spawn = multiprocessing.get_context("spawn")
    waiting, at_work = list(jobs), dict[Connection, tuple[Any, Job, str, float]]()
    cores: list[int | None] = sorted(os.sched_getaffinity(0))[:count] if count > 1 else []
    cores += [None] * (count - len(cores))
    taken: dict[Any, int | None] = {}

    def over(line: Connection) -> None:
        process = at_work.pop(line)[0]
        process.join()
        cores.append(taken.pop(process))

    while waiting or at_work:
        while waiting and len(at_work) < count:
            job, (mine, theirs) = waiting.pop(0), spawn.Pipe()
            core = cores.pop(0)
            process = spawn.Process(target=work, args=(job, theirs, core), daemon=True)
            process.start()
            theirs.close()
            taken[process] = core
            at_work[mine] = (process, job, "base", time.monotonic())
        soonest = min(began for *_, began in at_work.values()) + within - time.monotonic()
        for line in wait(list(at_work), timeout=max(soonest, 0.05)):
            assert isinstance(line, Connection)
            process, job, method, began = at_work[line]
            try:
                word, what = line.recv()
            except (EOFError, OSError):
                over(line)
                waiting[:0] = ended(job, method, f"the process ended with {process.exitcode}", keep)
                continue
            if word == "begin":
                at_work[line] = (process, job, what, time.monotonic())
            elif word == "line":
                keep(what)
                job = dataclasses.replace(job, methods=tuple(m for m in job.methods if m != what["method"]))
                at_work[line] = (process, job, method, began)
            else:
                over(line)
        for line, (process, job, method, began) in list(at_work.items()):
            if time.monotonic() - began > within:
                process.kill()
                over(line)
                waiting[:0] = ended(job, method, f"no result in {within:g} s", keep)


def ended(job: Job, method: str, why: str, keep: Any) -> list[Job]:
    """Keeps the line of a method whose process ended, and returns the job of the remaining methods.

    Without a base no method remains.
    """
    over = job.methods if method == "base" else (method,)
    for name in over:
        if name in job.methods:
            keep({"record": job.record, "method": name, "failed": why})
    left = tuple(m for m in job.methods if m not in over)
    return [dataclasses.replace(job, methods=left)] if left else []


# --- the table ----------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Compared:
    """A record's methods on the rows that all of them predict.

    Attributes:
        record: its name.
        truth: kind of its answer.
        channels: names.
        percent: method → rms error of each channel [% of the measured rms].
        partial: the same for a method that predicts too few rows, over its own rows, with their share.
        rows: compared rows, over the kinds of blocks.
        lines: method → line.
    """

    record: str
    truth: str
    channels: tuple[str, ...]
    percent: dict[str, np.ndarray]
    partial: dict[str, tuple[np.ndarray, float]]
    rows: int
    lines: dict[str, dict[str, Any]]

    def over_all(self, method: str) -> float:
        """Rms over the channels [%], NaN for a method outside the comparison."""
        there = self.percent.get(method)
        return float("nan") if there is None else float(np.sqrt(np.nanmean(there**2)))

    @property
    def ceiling(self) -> float:
        """The lower error of the two regressions [%], NaN without both."""
        values = [self.over_all(m) for m in CEILING]
        return float(np.nanmin(values)) if np.isfinite(values).any() else float("nan")

    @property
    def share(self) -> float:
        """Share of the improvement from the refit to the ceiling that our terms reach [-].

        It is 1 if our terms are below the ceiling, NaN if neither is lower than the refit by a tenth.
        """
        refit, ours = self.over_all("refit"), self.over_all("verdict")
        lowest = float(np.fmin(self.ceiling, ours))
        return (refit - ours) / (refit - lowest) if lowest < (1 - TENTH) * refit else float("nan")

    def better(self) -> list[str]:
        """Competitors whose error is lower than that of our terms by more than a tenth."""
        ours = self.over_all("verdict")
        return [m for m in COMPETITORS if self.over_all(m) < (1 - TENTH) * ours]


def compared(every: Sequence[dict[str, Any]]) -> list[Compared]:
    """Records in their order. For a repeated method the last line counts."""
    by: dict[str, dict[str, dict[str, Any]]] = {}
    for line in every:
        by.setdefault(line["record"], {})[line["method"]] = line
    return [_compared(name, of) for name, of in by.items()]


def _compared(name: str, of: dict[str, dict[str, Any]]) -> Compared:
    errors = {m: _stacked(x["off"]) for m, x in of.items() if x.get("off")}
    truth = next((x["truth"] for x in of.values() if "truth" in x), "unknown")
    channels = next((tuple(x["channels"]) for x in of.values() if "channels" in x), ())
    if "refit" not in errors:
        return Compared(name, truth, channels, {}, {}, 0, of)
    whole = np.isfinite(errors["refit"])
    part = {m: float((np.isfinite(x) & whole).sum() / whole.sum()) for m, x in errors.items()}
    partial = {m: (np.sqrt(np.nanmean(errors[m] ** 2, 0)), x) for m, x in part.items() if 0 < x < PREDICTED}
    errors = {m: x for m, x in errors.items() if part[m] >= PREDICTED}
    same = np.all([np.isfinite(x) for x in errors.values()], 0)
    percent = {m: np.sqrt(np.nanmean(np.where(same, x, np.nan) ** 2, 0)) for m, x in errors.items()}
    return Compared(name, truth, channels, percent, partial, int(same.any(1).sum()), of)


def _stacked(off: dict[str, list[list[float | None]]]) -> np.ndarray:
    return np.concatenate([np.array(x, float) for x in off.values()])


def table(records: Sequence[Compared]) -> list[str]:
    """The comparison in markdown: first the figures, then a row for each record."""
    columns = ("refit", "verdict", "scipy", "mujoco", "sindy", "ridge", "boosted", "true")
    head = [
        "record",
        "channels",
        *(WORDS[m] for m in columns),
        "covered",
        "claim",
        "wrong",
        "PySINDy's claims",
        "seconds",
    ]
    out = [*figures(records), "", f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
    for r in records:
        cells = [r.record, ", ".join(r.channels), *(_cell(r, m) for m in columns)]
        cells += ["–" if np.isnan(r.share) else f"{100 * r.share:.0f} %", *_claim(r.lines.get("verdict", {}))]
        cells += [_names(r.lines.get("sindy", {})), _seconds(r)]
        out.append(f"| {' | '.join(cells)} |")
    return out


def figures(records: Sequence[Compared]) -> list[str]:
    """Figures over all records."""
    ours = [r for r in records if "verdict" in r.percent]
    known = [r for r in ours if r.truth == "library" and np.isfinite(r.share)]
    good = [r for r in known if r.share >= 0.8]
    out = [
        f"* records: {len(records)}, compared with our terms: {len(ours)}; "
        f"{sum('failed' in r.lines.get('verdict', {}) for r in records)} without a verdict",
        "* mechanisms of the library, refit a tenth above terms or ceiling: our terms cover 80 % of the way or more: "
        f"{interval(len(good), len(known))}",
        "* a competitor's error is lower by more than a tenth: "
        + interval(sum(bool(r.better()) for r in ours), len(ours)),
    ]
    for m in COMPETITORS[1:]:
        there = [r for r in ours if m in r.percent]
        lower = sum(m in r.better() for r in there)
        higher = sum(r.over_all("verdict") < (1 - TENTH) * r.over_all(m) for r in there)
        out.append(f"* {WORDS[m]}: error lower by a tenth on {lower}, higher on {higher} of {len(there)} records")
    for m in ("verdict", "sindy"):
        judged = [x["wrong"] for r in records if (x := r.lines.get(m, {})).get("wrong") is not None]
        out.append(f"* wrong claims, {WORDS[m]}: {interval(sum(judged), len(judged))}")
    return out


def _cell(r: Compared, method: str) -> str:
    line = r.lines.get(method)
    if line is None:
        return ""
    if "failed" in line:
        return "" if method == "true" else line["failed"].replace("|", "/")[:60]
    if method in r.partial:
        return f"({_percent(r.partial[method][0])}; {100 * r.partial[method][1]:.0f} % of the readings)"
    return _percent(r.percent[method]) if method in r.percent else "nothing to hold out"


def _percent(errors: np.ndarray) -> str:
    return " / ".join(f"{x:.3g}" for x in errors)


def _claim(line: dict[str, Any]) -> tuple[str, str]:
    if "level" not in line:
        return line.get("failed", ""), ""
    what = "; ".join(", ".join(c) for c in line["claims"]) or "; ".join(line["families"][:2])
    wrong = {None: "not known", True: "**yes**", False: "no"}[line["wrong"]]
    return f"{line['level']}{': ' + what if what else ''}", wrong


def _names(line: dict[str, Any]) -> str:
    if "level" not in line:
        return ""
    names = [name for claim in line["claims"] for name in claim]
    few = ", ".join(names) if len(names) <= 2 else f"{len(names)} effects"
    return f"{few or 'none'}{', **wrong**' if line['wrong'] else ''}"


def _seconds(r: Compared) -> str:
    return " / ".join(f"{r.lines[m]['seconds']:.0f}" for m in METHODS if "seconds" in r.lines.get(m, {}))


# --- command line -------------------------------------------------------------------------------------------


def options() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--public", type=Path, metavar="FOLDER", help="public records, see docs/lab/head-to-head.md")
    parser.add_argument("--cases", type=Path, metavar="FOLDER", help="cases with a robot's file and a table each")
    parser.add_argument("--packages", type=Path, metavar="FOLDER", help="folder with pysindy and scikit-learn")
    parser.add_argument(
        "--records", default="packaged,public,cases,synthetic",
        help="groups (packaged, public, cases, synthetic) or names, e.g. packaged,real-01,rig-07",
    )  # fmt: skip
    parser.add_argument("--methods", default=",".join(METHODS), help="of %(default)s")
    parser.add_argument("--rigs", type=int, default=public_records.RIGS, help="number of synthetic rigs")
    parser.add_argument("--seed", type=int, default=0, help="for the synthetic rigs, bootstraps and trees")
    parser.add_argument("--replicates", type=int, default=500, help="of the bootstrap")
    parser.add_argument("--within", type=float, default=900.0, help="time limit of a method [s]")
    parser.add_argument("--jobs", type=int, default=1, help="number of processes, each with one record")
    parser.add_argument(
        "--out", type=Path, default=Path("runs/head_to_head.jsonl"), help="one line for each record and method"
    )
    parser.add_argument("--cache", type=Path, help="folder of compiled programs that the processes share")
    parser.add_argument("--quick", action="store_true", help="one synthetic rig and two methods, in this process")
    parser.add_argument("--table", action="store_true", help="print the table of an existing --out")
    return parser


def wanted(given: argparse.Namespace, done: set[tuple[str, str]]) -> list[Job]:
    """Records with their methods that have no line yet.

    Raises:
        SystemExit: an unknown record or method.
    """
    groups = public_records.names(given.public, given.cases, given.rigs)
    every = [n for word in given.records.split(",") for n in groups.get(word, [word])]
    methods = given.methods.split(",")
    strange = [m for m in methods if m not in METHODS]
    if strange:
        raise SystemExit(f"--methods: got {strange[0]}; expected some of {', '.join(METHODS)}")
    jobs = []
    for name in dict.fromkeys(every):
        left = tuple(m for m in METHODS if m in methods and (name, m) not in done)
        if left:
            jobs.append(Job(name, left, given.public, given.cases, given.packages, given.seed, given.replicates))
    return jobs


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs records, or prints the table."""
    given = options().parse_args(arguments)
    if given.quick:
        given.records, given.methods = QUICK["records"], QUICK["methods"]
    given.out.parent.mkdir(parents=True, exist_ok=True)
    known = campaign.known(given.out)
    if not given.table:
        jobs = wanted(given, {(x["record"], x["method"]) for x in known if "failed" not in x})
        total, began, made = sum(len(j.methods) for j in jobs), time.monotonic(), 0
        os.environ.setdefault("JAX_PLATFORMS", "cpu")
        if given.jobs > 1:
            os.environ.update({k: v for k, v in campaign.ALONE.items() if k not in os.environ})
        if given.cache is not None:
            os.environ["MMRJAX_CACHE"] = str(given.cache.resolve())
        with given.out.open("a", encoding="utf-8") as file:

            def keep(line: dict[str, Any]) -> None:
                nonlocal made
                made += 1
                known.append(line)
                file.write(json.dumps(plain(line)) + "\n")
                file.flush()
                what = line.get("failed", "done")
                print(
                    f"{made}/{total} {time.monotonic() - began:.0f} s: {line['record']} {line['method']}: {what}",
                    flush=True,
                )

            if given.quick:
                for job in jobs:
                    for method, result in lines(job):
                        keep({"record": job.record, "method": method, **result})
            else:
                run(jobs, given.jobs, given.within, keep)
    with contextlib.suppress(BrokenPipeError):
        print("\n".join(table(compared(known))))


if __name__ == "__main__":
    main()
