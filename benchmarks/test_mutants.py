"""The list of mutants is one that `make mutants` can try: nodes that exist, mistakes that parse, quick tests."""

import ast
import builtins
import dataclasses
import functools
import importlib.util
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
KINDS = {
    "balances", "energy", "contact", "statuses", "missions", "verdicts", "calibration", "readers", "units", "writers",
    "sweeps", "derivatives", "effects", "inertia", "posture", "climb", "sensitivity", "sizing", "words", "pages", "model",
    "fidelities", "safety", "export",
}  # fmt: skip

#: A test that leaves a file open in a cycle of objects, and one with a claim.
OPEN = """import gc

def test_open(tmp_path):
    gc.disable()
    cycle = [open(tmp_path / "kept", "w")]
    cycle.append(cycle)

def test_claim():
    assert {claim}
"""


@pytest.fixture(scope="module")
def command():
    """benchmarks/mutants.py."""
    spec = importlib.util.spec_from_file_location("benchmark_mutants", ROOT / "benchmarks" / "mutants.py")
    module = importlib.util.module_from_spec(spec)
    # dataclasses look their module up
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, spec.name, module)
        spec.loader.exec_module(module)
        yield module


@functools.cache
def marks_of_tests(file):
    """Name of each test of a file, with the marks `slow` and `nightly` of all its parameter sets."""
    body = ast.parse((ROOT / file).read_text(encoding="utf-8")).body
    whole = " ".join(ast.unparse(n) for n in body if isinstance(n, ast.Assign) and "pytestmark" in ast.unparse(n))
    tests = [n for n in body if isinstance(n, ast.FunctionDef) and n.name.startswith("test_")]
    decorators = {n.name: [ast.unparse(d) for d in n.decorator_list] for n in tests}
    texts = {name: " ".join([whole, *(d for d in ds if "parametrize" not in d)]) for name, ds in decorators.items()}
    return {name: {m for m in ("slow", "nightly") if f"mark.{m}" in text} for name, text in texts.items()}


def test_mutants_are_many_and_of_every_kind(command):
    every = command.mutants()
    assert (
        len(every) >= 300
        and sum(m.slow for m in every) <= 0.03 * len(every)
        and len({(m.file, m.function, m.node, m.by) for m in every}) == len(every)
    )
    kinds = Counter(m.kind for m in every)
    assert set(kinds) == KINDS and min(kinds.values()) >= 2


def test_mutants_apply_once_and_name_what_exists(command):
    files = {m.file for m in command.mutants()}
    modules = {file: ast.parse((ROOT / file).read_text(encoding="utf-8")) for file in files}
    words = {
        file: set(re.findall(r"\w+", ast.unparse(module))) | set(dir(builtins)) for file, module in modules.items()
    }
    for mutant in command.mutants():
        node, made = mutant.change(modules[mutant.file])
        assert ast.dump(node) != ast.dump(made), mutant.name
        assert {n.id for n in ast.walk(made) if isinstance(n, ast.Name)} <= words[mutant.file], mutant.name
        compile(ast.unparse(made), mutant.name, "exec")
    with pytest.raises(ValueError, match=rf"{mutant.name}: .* has \d+ nodes {mutant.node}; expected 1"):
        dataclasses.replace(mutant, function="").applied((ROOT / mutant.file).read_text(encoding="utf-8"))


def test_a_mutant_survives_new_names_and_layout_but_not_another_node_of_its_kind(command):
    mutant = command.Mutant("twice", "units", "x.py", "Sub 2/2 .right", "2 * _", ("t",), "Box.size")
    box = "class Box:\n\n    def size(self, a, b):\n        return a - {}"
    assert mutant.applied(box.format("(b - 3 * a)")) == box.format("(b - 2 * (3 * a))")
    assert mutant.applied(box.format("( # a comment\n a-(a)) ")) == box.format("(a - 2 * a)")
    with pytest.raises(ValueError, match=r"twice: Box\.size of x\.py has 3 nodes Sub; expected 2"):
        mutant.applied(box.format("(b - 3 - a)"))


def test_tests_that_kill_exist_and_are_quick(command):
    wrong = []
    for mutant in command.mutants():
        assert mutant.killed_by, mutant.name
        for node in mutant.killed_by:
            file, *test = node.split("::")
            marks = marks_of_tests(file)
            names = [t.split("[")[0] for t in test] or list(marks)
            allowed = [set(), {"slow"}] if mutant.slow else [set()]
            if not any(marks.get(name, {"none"}) in allowed for name in names):
                wrong.append(f"{mutant.name}: {node}")
    assert not wrong


def test_a_failure_counts_although_pytest_ends_with_an_error(tmp_path):
    """A file that a test leaves open is an error after the last test."""
    script = """import pathlib, sys, mutants
tree = pathlib.Path(sys.argv[1])
print(mutants.run(tree, [sys.argv[2]], "not slow", tree / "log", ("-q", "-W", "error"))[0])"""
    codes = []
    for claim in ("False", "True"):
        (tmp_path / f"test_{claim}.py").write_text(OPEN.format(claim=claim), encoding="utf-8")
        command = [sys.executable, "-c", script, tmp_path, f"test_{claim}.py"]
        done = subprocess.run(command, cwd=ROOT / "benchmarks", capture_output=True, text=True, check=True)
        codes.append(done.stdout.strip())
    assert codes == ["1", "-1"]


def test_a_slow_test_does_not_count_as_quick():
    assert marks_of_tests("tests/test_directions.py")["test_loop_names_it"] == {"nightly"}
    quick = "test_runs_that_go_both_ways_are_known_by_what_drives_them_or_by_a_speed"
    assert marks_of_tests("tests/test_directions.py")[quick] == set()
