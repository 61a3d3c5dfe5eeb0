"""The list of mutants is one that `make mutants` can try: texts that stand once, mistakes that parse, quick tests."""

import ast
import functools
import importlib.util
import sys
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
KINDS = {
    "balances", "energy", "contact", "statuses", "missions", "verdicts", "calibration", "readers", "units", "writers",
    "sweeps", "derivatives", "effects", "inertia", "posture", "climb",
    "safety",
}  # fmt: skip


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
def quick_tests(file):
    """Names of the tests of a file that are not marked slow."""
    body = ast.parse((ROOT / file).read_text(encoding="utf-8")).body
    marks = [ast.unparse(n) for n in body if isinstance(n, ast.Assign)]
    if any(m.startswith("pytestmark") and "slow" in m for m in marks):
        return frozenset()
    tests = [n for n in body if isinstance(n, ast.FunctionDef) and n.name.startswith("test_")]
    return frozenset(n.name for n in tests if not any("mark.slow" in ast.unparse(d) for d in n.decorator_list))


def test_mutants_are_many_and_of_every_kind(command):
    every = command.mutants()
    assert len(every) >= 60 and len({(m.file, m.text, m.by) for m in every}) == len(every)
    kinds = Counter(m.kind for m in every)
    assert set(kinds) == KINDS and min(kinds.values()) >= 3


def test_mutants_apply_once_and_parse(command):
    for mutant in command.mutants():
        source = (ROOT / mutant.file).read_text(encoding="utf-8")
        changed = mutant.applied(source)
        assert ast.dump(ast.parse(changed)) != ast.dump(ast.parse(source)), mutant.name
    with pytest.raises(ValueError, match=rf"{mutant.name}: its text stands 2 times in .*; expected once"):
        mutant.applied(2 * source)


def test_tests_that_kill_exist_and_are_quick(command):
    wrong = []
    for mutant in command.mutants():
        assert mutant.killed_by, mutant.name
        for node in mutant.killed_by:
            file, *test = node.split("::")
            names = quick_tests(file)
            if not names or any(t.split("[")[0] not in names for t in test):
                wrong.append(f"{mutant.name}: {node}")
    assert not wrong


def test_a_slow_test_is_none_that_kills():
    assert "test_loop_names_it" not in quick_tests("tests/test_directions.py")
    assert "test_runs_that_go_both_ways_are_known_by_what_drives_them_or_by_a_speed" in quick_tests(
        "tests/test_directions.py"
    )
