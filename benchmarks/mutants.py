"""Applies the plausible mistakes of tests/mutants.toml: each has to make one of its listed tests fail.

Each mutant replaces one node of a function's syntax in a copy of the tree and runs its tests in a separate process.
Before that the same tests have to pass without any mutant. Tests of `make test` kill at least 97 % of the list.
A mutant with `slow = true` is killed by a slow test, one of `make test-all`.

    python benchmarks/mutants.py                          # all of them, one at a time
    python benchmarks/mutants.py --jobs 2
    python benchmarks/mutants.py --only track_drops_guide --only gravity_takes_cosine

Exits with 1 if a mutant survives, its tests cannot run, or its function has another number of such nodes.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import importlib.util
import json
import multiprocessing
import os
import queue
import re
import shutil
import sys
import tempfile
import time
import tomllib
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
LIST = ROOT / "tests" / "mutants.toml"
#: Slow imports of the tests, done once before processes are forked; no module of this project.
PRELOADED = ("numpy", "scipy.stats", "jax", "jax.numpy", "equinox", "optimistix", "optax", "mujoco")
#: A module that is imported before pytest sees it causes a warning, but has no asserts to rewrite here.
BASE = (
    "-q",
    "--continue-on-collection-errors",
    "-p",
    "no:cacheprovider",
    "-W",
    "ignore::pytest.PytestAssertRewriteWarning",
)
OPTIONS = ("-x", *BASE)
#: A mutant's node: kind, its rank of how many, and the path to a part.
NODE = re.compile(r"(\S+)(?: (\d+)/(\d+))?(?: ([.\[].*))?")
#: The node or a part of it in a replacement.
PART = re.compile(r"(?<!\w)_(?:\.[a-z_]+|\[-?\d+\])*(?!\w)")
#: Time limit of a mutant's tests [s]: a mutant may loop for ever.
PATIENCE = 900.0
LEFT_OUT = shutil.ignore_patterns(".git", ".venv", "runs", "__pycache__", ".*_cache", "*.egg-info", ".hypothesis")


@dataclasses.dataclass(frozen=True)
class Mutant:
    """A plausible mistake.

    Attributes:
        kind: where it is.
        file: from the root of the tree.
        node: syntax node to replace, `kind`, `kind 2/3` or either followed by a path to one of its parts.
        by: its replacement. `_` is the node, `_.left` a part of it. An empty text removes a statement.
        killed_by: node ids of tests, at least one of them has to fail.
        function: qualified name of the function, class or assigned name. Empty for the whole file.
        slow: these tests are marked slow.
    """

    name: str
    kind: str
    file: str
    node: str
    by: str
    killed_by: tuple[str, ...]
    function: str = ""
    slow: bool = False

    @property
    def marks(self) -> str:
        """Selection of the tests that may kill it, for pytest's option -m."""
        return "not nightly" if self.slow else "not slow"

    def change(self, module: ast.Module) -> tuple[ast.AST, ast.AST]:
        """The node of the module's tree, and what replaces it.

        Raises:
            ValueError: the function has another number of such nodes.
        """
        searched, rank, number, path = NODE.fullmatch(self.node).groups("")  # type: ignore[union-attr]
        nodes = [n for n in reading_order(definitions(module)[self.function]) if kind_of(n) == searched]
        if len(nodes) != int(number or 1):
            where = f"{self.function} of {self.file}" if self.function else self.file
            raise ValueError(f"{self.name}: {where} has {len(nodes)} nodes {searched}; expected {number or 1}")
        node = eval(f"_{path}", {"_": nodes[int(rank or 1) - 1]})
        filled = PART.sub(lambda part: f"({ast.unparse(eval(part[0], {'_': node}))})", self.by or "pass")
        made = ast.parse(filled).body[0]
        return node, made.value if isinstance(node, ast.expr) and isinstance(made, ast.Expr) else made

    def applied(self, source: str) -> str:
        """The file's text with the mistake in it."""
        tree = ast.parse(source)
        return ast.unparse(_Replacement(*self.change(tree)).visit(tree))


class _Replacement(ast.NodeTransformer):
    """Replaces one node of a tree."""

    def __init__(self, node: ast.AST, made: ast.AST) -> None:
        self.node, self.made = node, made

    def visit(self, node: ast.AST) -> Any:
        return self.made if node is self.node else self.generic_visit(node)


def kind_of(node: ast.AST) -> str:
    """Sub, Lt, Not ... of an operation, `f()` of a call, the number or the name; else the class of the node."""
    match node:
        case ast.BinOp(op=op) | ast.BoolOp(op=op) | ast.UnaryOp(op=op) | ast.Compare(ops=[op, *_]):
            return type(op).__name__
        case ast.Call(func=ast.Attribute(attr=name) | ast.Name(id=name)):
            return f"{name}()"
        case ast.Constant(value=value) if not isinstance(value, str):
            return repr(value)
        case ast.Attribute(attr=name) | ast.Name(id=name) | ast.keyword(arg=str(name)):
            return name
    return type(node).__name__


def reading_order(tree: ast.AST) -> list[ast.AST]:
    """Nodes that have a place in the text, by place; of those that begin together, the outer one first."""
    placed = (n for n in ast.walk(tree) if hasattr(n, "lineno"))
    return sorted(placed, key=lambda n: (n.lineno, n.col_offset))


def definitions(module: ast.Module) -> dict[str, ast.AST]:
    """Functions, classes and assigned names by qualified name. Empty: the whole file."""
    named: dict[str, ast.AST] = {"": module}

    def visit(node: ast.AST, prefix: str) -> None:
        for child in ast.iter_child_nodes(node):
            inner = prefix
            if isinstance(child, (ast.FunctionDef, ast.ClassDef)):
                named[prefix + child.name] = child
                inner = f"{prefix}{child.name}."
            elif isinstance(child, (ast.Assign, ast.AnnAssign)):
                named.setdefault(prefix + re.split(r"\W", ast.unparse(child))[0], child)
            visit(child, inner)

    visit(module, "")
    return named


def mutants() -> list[Mutant]:
    """The list of tests/mutants.toml."""
    with LIST.open("rb") as file:
        tables: dict[str, dict[str, Any]] = tomllib.load(file)
    return [Mutant(name, **{**of, "killed_by": tuple(of["killed_by"])}) for name, of in tables.items()]


class _Outcomes:
    """Pytest plugin that collects the node ids of tests that pass, and those of tests that fail."""

    def __init__(self) -> None:
        self.passed: list[str] = []
        self.failed: list[str] = []

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed or (report.when == "call" and report.passed):
            (self.failed if report.failed else self.passed).append(report.nodeid)


def _run(tree: str, tests: list[str], marks: str, log: str, answer: str, options: tuple[str, ...]) -> None:
    """Runs tests of a tree in this process. Writes pytest's exit code and the passed tests to a file."""
    os.chdir(tree)
    os.environ["PYTHONPATH"] = tree  # for processes that tests start
    sys.path.insert(0, tree)
    output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(output, 1)
    os.dup2(output, 2)
    import pytest

    outcomes = _Outcomes()
    try:
        code = int(pytest.main([*options, "-m", marks, *tests], plugins=[outcomes]))
    except Exception as error:  # what a test leaves open is raised when pytest ends
        code = 1 if outcomes.failed else -1
        print(f"pytest ended with {error!r}", flush=True)
    for name in ("mmrjax", "calibration", "sweeps"):
        module = sys.modules.get(name)
        if module is not None and not str(module.__file__).startswith(tree):
            code = -1  # another installation was tested
    Path(answer).write_text(json.dumps([code, outcomes.passed]), encoding="utf-8")


def run(
    tree: Path, tests: list[str], marks: str, log: Path, options: tuple[str, ...] = OPTIONS
) -> tuple[int | None, list[str]]:
    """Exit code of pytest over tests in a separate process, None if it hangs or dies, and the passed tests."""
    context = multiprocessing.get_context("forkserver")
    answer = tree / "mutant.json"
    answer.unlink(missing_ok=True)
    process = context.Process(target=_run, args=(str(tree), tests, marks, str(log), str(answer), options))
    process.start()
    process.join(PATIENCE)
    if process.is_alive():
        process.kill()
        process.join()
    if not answer.exists():
        return None, []
    code, passed = json.loads(answer.read_text(encoding="utf-8"))
    return code, passed


def tested(mutant: Mutant, tree: Path, stamp: int) -> tuple[str, float, str]:
    """Outcome of a mutant in a copy of the tree, seconds, and the end of pytest's output."""
    path, log = tree / mutant.file, tree / "mutant.log"
    original, times = path.read_text(encoding="utf-8"), path.stat()
    begin = time.perf_counter()
    try:
        path.write_text(mutant.applied(original), encoding="utf-8")
        os.utime(path, (stamp, stamp))  # so that no compiled module of another text is used
        code, _ = run(tree, list(mutant.killed_by), mutant.marks, log)
    except ValueError as error:
        return "error", 0.0, str(error)
    finally:
        path.write_text(original, encoding="utf-8")
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    outcome = {0: "survived", 1: "killed"}.get(-1 if code is None else code, "error")
    said = log.read_text(encoding="utf-8", errors="replace") if log.exists() else ""
    failed = [line for line in said.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return outcome, time.perf_counter() - begin, failed[0] if failed and outcome == "killed" else said[-1500:]


def passing(chosen: list[Mutant], trees: list[Path]) -> list[str]:
    """Node ids of the killing tests that pass without a mutant, under the stated marks."""
    names: list[str] = []
    for marks in dict.fromkeys(mutant.marks for mutant in chosen):
        tests = list(dict.fromkeys(test for mutant in chosen if mutant.marks == marks for test in mutant.killed_by))
        files = list(dict.fromkeys(test.split("::")[0] for test in tests))
        shares = [[t for t in tests if files.index(t.split("::")[0]) % len(trees) == k] for k in range(len(trees))]
        parts = [(tree, share) for tree, share in zip(trees, shares, strict=True) if share]
        with ThreadPoolExecutor(len(parts)) as pool:
            ends = pool.map(lambda part: run(part[0], part[1], marks, part[0] / "mutant.log", BASE), parts)  # noqa: B023
            names += [name for _, passed in ends for name in passed]
    return names


def fit(mutant: Mutant, names: list[str]) -> bool:
    """True where each of a mutant's tests passes without it."""
    return all(any(n == t or n.startswith((f"{t}[", f"{t}::")) for n in names) for t in mutant.killed_by)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", action="append", metavar="NAME", help="only this mutant; may be repeated")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="mutants at a time (default 1)")
    options = parser.parse_args()
    every = mutants()
    names = [m.name for m in every]
    if unknown := [name for name in options.only or [] if name not in names]:
        parser.error(f"--only: no mutant {unknown[0]}; there are {', '.join(names)}")
    if options.jobs < 1:
        parser.error(f"--jobs: got {options.jobs}; expected at least 1")
    chosen = [m for m in every if not options.only or m.name in options.only]
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([name for name in PRELOADED if importlib.util.find_spec(name.split(".")[0])])

    with tempfile.TemporaryDirectory(prefix="mmrjax-mutants-") as folder:
        copies = [Path(folder).resolve() / str(k) for k in range(options.jobs)]
        for copy in copies:
            shutil.copytree(ROOT, copy, ignore=LEFT_OUT)
        names = passing(chosen, copies)
        unfit = [m.name for m in chosen if not fit(m, names)]
        trees: queue.SimpleQueue[Path] = queue.SimpleQueue()
        for copy in copies:
            trees.put(copy)
        print(f"{len(chosen)} mutants; the tests of {len(chosen) - len(unfit)} pass without them", flush=True)

        def one(k: int) -> tuple[str, float]:
            mutant = chosen[k]
            outcome, seconds, said = "error", 0.0, "its tests do not pass without it"
            if mutant.name not in unfit:
                tree = trees.get()
                outcome, seconds, said = tested(mutant, tree, k + 1)
                trees.put(tree)
            print(f"{outcome:9} {seconds:6.1f} s  {mutant.kind:12} {mutant.name:40} {mutant.file}", flush=True)
            print(f"          {said.strip()}" if outcome != "killed" else f"          {said[:150]}", flush=True)
            return outcome, seconds

        with ThreadPoolExecutor(options.jobs) as pool:
            outcomes = list(pool.map(one, range(len(chosen))))

    print()
    by_kind = Counter((m.kind, outcome) for m, (outcome, _) in zip(chosen, outcomes, strict=True))
    print(f"{'kind':14}{'killed':>8}{'survived':>10}{'error':>7}")
    for kind in dict.fromkeys(m.kind for m in chosen):
        print(f"{kind:14}{by_kind[kind, 'killed']:8}{by_kind[kind, 'survived']:10}{by_kind[kind, 'error']:7}")
    left = [m.name for m, (outcome, _) in zip(chosen, outcomes, strict=True) if outcome != "killed"]
    quick = sum(outcome == "killed" and not m.slow for m, (outcome, _) in zip(chosen, outcomes, strict=True))
    print(f"{quick} of {len(chosen)} are killed by `make test` alone ({100 * quick / len(chosen):.1f} %)")
    print(f"{len(chosen) - len(left)} of {len(chosen)} killed" + (f"; not: {', '.join(left)}" if left else ""))
    return 1 if left else 0


if __name__ == "__main__":
    sys.exit(main())
