"""The command of a campaign: many cases of each kind, one line of a file for each, on many processes, resumable."""

from __future__ import annotations

import argparse
import dataclasses
import functools
import gc
import itertools
import json
import multiprocessing
import os
import resource
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import loop_findings
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [p for p in (str(ROOT), str(ROOT / "tests")) if p not in sys.path]

from mmrjax import SOUND_AT_LEVEL_0  # noqa: E402
from sweeps.cli import LOOP_COMPILER_OPTIONS  # noqa: E402

#: A worker has one thread, so that as many workers as cores share a machine without waiting for each other. Options
#: of the compiler are those of `mmrjax loop`.
ALONE = {
    "XLA_FLAGS": ",".join((SOUND_AT_LEVEL_0, *LOOP_COMPILER_OPTIONS))
    + " --xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}
#: Number of memory mappings beyond which a worker drops its compiled programs; Linux allows 65530.
MAPPINGS = 30_000
#: The same limit for resident memory [bytes].
MEMORY = 5e9


@dataclasses.dataclass(frozen=True)
class Task:
    """One case: its kind, seed and options of the judgement."""

    kind: str
    seed: int
    replicates: int = 500
    robot: str = "nominal"
    narrow: bool = False
    stratum: str = ""
    brief: bool = False


@functools.cache
def ready() -> None:
    """Sets double precision, and stores compiled programs on disk for the other workers."""
    import jax

    from sweeps import compilation_cache

    compilation_cache.keep_programs()
    jax.config.update("jax_enable_x64", True)


@functools.cache
def robot_of(name: str) -> Any:
    """A robot by its name or from its file."""
    ready()
    from calibration.data import robot_file

    return robot_file.load_robot(name)


#: Largest amplitude of a case, in ordinary sizes; larger ones are implausible for any library.
SIZES = 3.0


def refused(label: Mapping[str, Any], low: float, sizes: bool = True, sigmas: bool = True) -> str:
    """Reason for leaving out a case, empty for a valid one.

    Args:
        low: sigmas that each effect has to leave.
        sizes, sigmas: True to check these.
    """
    if label.get("rows_lost"):
        return "rows would slide or stand still"
    if not label.get("sound", True):
        return "too stiff for the generator's method"
    if sizes and any(e["sizes"] >= SIZES for e in label["effects"]):
        return f"needs more than {SIZES:g} ordinary sizes"
    if sigmas and not all(e["sigmas"] > 0.9 * low for e in label["effects"]):
        return f"leaves less than {low:g} sigma"
    return ""


#: Entries of a label that are not properties of the case.
TRUTH = ("schema", "seed", "kind", "stratum", "effects", "constants", "z", "sd_over_prior")


def begun(case: Any, task: Task, stated: Mapping[str, tuple[float, float]] | None = None) -> Any:
    """The problem with which the loop begins, read from the files of a case as a user's files are."""
    ready()
    from calibration.data import robot_file
    from calibration.data import runs as records
    from calibration.discovery.loop_input import prepare_loop

    with tempfile.TemporaryDirectory() as folder:
        case.write(Path(folder))
        robot = robot_of(task.robot) if case.toml is None else robot_file.read_robot(Path(folder) / "rig.toml")
        runs = records.read_runs(Path(folder) / "table.csv", robot=robot)
    return prepare_loop(runs, robot, stated=stated, replicates=task.replicates, seed=task.seed)


def looped(case: Any, task: Task, stated: Mapping[str, tuple[float, float]] | None = None) -> tuple[Any, Any, dict]:
    """The loop's problem, its result, and the line of a case: its label with verdict and findings."""
    began, spent = time.perf_counter(), time.process_time()
    given = begun(case, task, stated)
    from calibration.discovery.discover import trace_verdict

    found = trace_verdict(given)
    line = {
        "seconds": time.perf_counter() - began,
        "processor_seconds": time.process_time() - spent,
        "memory": 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
        **loop_findings.verdict(found),
        **loop_findings.findings(given, found),
        "stratum": case.label["stratum"],
        "made": {k: v for k, v in case.label.items() if k not in TRUTH},
        "truth": case.label["effects"],
    }
    return given, found, line


def guarded(work: Callable[[Task], dict], task: Task) -> dict:
    """The line of a case, or the error that it ended with."""
    try:
        return {"kind": task.kind, "seed": task.seed, **work(task)}
    except Exception as error:
        return {"kind": task.kind, "seed": task.seed, "error": f"{type(error).__name__}: {error}"}
    finally:
        _make_room()


def _make_room() -> None:
    mapped, pages = Path("/proc/self/maps"), Path("/proc/self/statm")
    if "jax" not in sys.modules or not mapped.exists():
        return
    resident = int(pages.read_text().split()[1]) * resource.getpagesize()
    if mapped.read_bytes().count(b"\n") > MAPPINGS or resident > MEMORY:
        sys.modules["jax"].clear_caches()
        gc.collect()


def known(path: Path) -> list[dict]:
    """Lines of a file. The last one may be cut off."""
    lines = []
    for text in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            lines.append(json.loads(text))
        except json.JSONDecodeError:
            continue
    return lines


# --- processes ----------------------------------------------------------------------------------------


def programs(program: Callable[[Task], Hashable | dict], task: Task) -> tuple[Task, Hashable | dict]:
    """A task with the shape of its compiled programs, or the line of an invalid case."""
    try:
        return task, program(task)
    except Exception as error:
        return task, {"error": f"{type(error).__name__}: {error}"}


class Shares:
    """Queue of tasks that prefers to give a worker tasks for programs that it has compiled.

    Compiling takes a minute and judging seconds, and each process compiles the programs that it runs.
    """

    def __init__(self, tasks: Iterable[tuple[Task, Hashable]]) -> None:
        self.waiting: dict[Hashable, list[Task]] = {}
        for task, shape in tasks:
            self.waiting.setdefault(shape, []).append(task)
        self.at_work: Counter[Hashable] = Counter()

    def next(self, before: Hashable | None) -> tuple[Task, Hashable] | None:
        """A task for a worker whose last one had shape `before`, and its shape, None if no task is left.

        If no task of that shape is left, the one of the shape with the most waiting tasks per worker.
        """
        if before is not None:
            self.at_work[before] -= 1
        shape = before
        if not self.waiting.get(shape):
            shape = max(
                (k for k, tasks in self.waiting.items() if tasks),
                key=lambda k: len(self.waiting[k]) / (1 + self.at_work[k]) ** 2,
                default=None,
            )
        if shape is None:
            return None
        self.at_work[shape] += 1
        return self.waiting[shape].pop(0), shape


def _worker(work: Callable[[Task], dict], line: Connection, core: int | None) -> None:
    """Judges tasks from a connection, on one core if one is given, because XLA's pool has a thread for each core."""
    if core is not None:
        os.sched_setaffinity(0, {core})
    while (task := line.recv()) is not None:
        line.send(guarded(work, task))


def judged(work: Callable[[Task], dict], shares: Shares, jobs: int, limit: float = np.inf) -> Iterator[dict]:
    """Yields the lines of tasks as workers finish them, until all are done or `limit` seconds have passed.

    If a worker dies, its case gets an error, and another worker replaces it.
    """
    began, spawn = time.monotonic(), multiprocessing.get_context("spawn")
    workers: dict[Connection, tuple[BaseProcess, Task, Hashable]] = {}
    cores = itertools.cycle(sorted(os.sched_getaffinity(0)) if jobs > 1 else [None])

    def hire() -> None:
        dealt = shares.next(None)
        if dealt is None:
            return
        mine, theirs = spawn.Pipe()
        process = spawn.Process(target=_worker, args=(work, theirs, next(cores)), daemon=True)
        process.start()
        theirs.close()
        mine.send(dealt[0])
        workers[mine] = (process, *dealt)

    for _ in range(jobs):
        hire()
    try:
        while workers:
            ready = wait(list(workers), timeout=max(min(limit - (time.monotonic() - began), 1e6), 0.01))
            if not ready:
                print("the time limit is reached", flush=True)
                return
            for line in ready:
                process, task, shape = workers.pop(line)
                try:
                    done = line.recv()
                except (EOFError, OSError):
                    process.join()
                    shares.at_work[shape] -= 1
                    yield {
                        "kind": task.kind,
                        "seed": task.seed,
                        "error": f"the process ended with {process.exitcode}",
                    }
                    hire()
                    continue
                dealt = shares.next(shape)
                line.send(None if dealt is None else dealt[0])
                if dealt is not None:
                    workers[line] = (process, *dealt)
                yield done
    finally:
        for process, *_ in workers.values():
            process.terminate()


def campaign(
    doc: str | None,
    kinds: tuple[str, ...],
    work: Callable[[Task], dict],
    program: Callable[[Task], Hashable | dict],
    summary: Callable[..., list[str]],
    out: str,
) -> None:
    """Reads the command line, makes and judges cases in separate processes, and prints the figures.

    Args:
        work: a function of a module.
        summary: function of all lines.
        program: function of a module that returns the shape of a task's programs, or the line of an invalid case.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    for kind in kinds:
        parser.add_argument(f"--{kind.replace('_', '-')}", type=int, default=0, help="cases")
    parser.add_argument("--replicates", type=int, default=500)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--first", "--seed", type=int, default=0, help="first seed")
    parser.add_argument("--robot", default="nominal", help="robot of the cases of the paper's robot")
    parser.add_argument("--stratum", default="", help="only one stratum of the wide kinds, e.g. plain")
    parser.add_argument("--narrow", action="store_true", help="one surface with stated adhesion")
    parser.add_argument(
        "--brief", action="store_true", help="only verdicts and findings, without carrying out experiments"
    )
    parser.add_argument("--out", type=Path, default=Path(out))
    parser.add_argument("--cache", type=Path, help="folder of compiled programs that the workers share")
    parser.add_argument("--limit", type=float, default=np.inf, help="seconds after which the campaign stops")
    parser.add_argument("--only-summary", action="store_true", help="print the figures of an existing --out")
    given = parser.parse_args()
    given.out.parent.mkdir(parents=True, exist_ok=True)
    lines = [x for x in known(given.out) if "error" not in x]  # errors are tried again
    if given.only_summary:
        print("\n".join(summary(known(given.out))))
        return
    done = {(x["kind"], x["seed"]) for x in lines}
    wanted = {kind: getattr(given, kind) for kind in kinds}
    tasks = [
        Task(kind, seed, given.replicates, given.robot, given.narrow, given.stratum, given.brief)
        for kind, count in wanted.items()
        for seed in range(given.first, given.first + count)
        if (kind, seed) not in done
    ]
    tasks.sort(key=lambda t: (t.seed - given.first) / wanted[t.kind])  # kinds progress in parallel
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    if given.jobs > 1:
        os.environ.update({k: v for k, v in ALONE.items() if k not in os.environ})
    if given.cache is not None:
        os.environ["MMRJAX_CACHE"] = str(given.cache.resolve())
    began = time.monotonic()
    made = 0
    cut = given.out.exists() and given.out.read_bytes()[-1:] not in (b"", b"\n")  # killed while writing
    with given.out.open("a", encoding="utf-8") as file:
        file.write("\n" if cut else "")

        def keep(line: dict) -> None:
            nonlocal made
            made += 1
            lines.append(line)
            file.write(json.dumps(loop_findings.plain(line)) + "\n")
            file.flush()
            if made % 50 == 0:
                print(f"{made}/{len(tasks)} cases, {time.monotonic() - began:.0f} s", flush=True)

        with multiprocessing.get_context("spawn").Pool(given.jobs) as pool:
            shaped = pool.map(functools.partial(programs, program), tasks, chunksize=4)
        for task, shape in shaped:
            if isinstance(shape, dict):
                keep({"kind": task.kind, "seed": task.seed, **shape})
        print(f"{len(tasks) - made} cases to judge, {time.monotonic() - began:.0f} s", flush=True)
        shares = Shares((t, shape) for t, shape in shaped if not isinstance(shape, dict))
        for line in judged(work, shares, given.jobs, given.limit - (time.monotonic() - began)):
            keep(line)
    print("\n".join(summary(lines)))
    print(f"{made} of {len(tasks)} cases in {time.monotonic() - began:.0f} s with {given.jobs} processes")
