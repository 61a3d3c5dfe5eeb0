"""What every command leaves is what `tests/record/commands` has of it (benchmarks/record.py). A difference is seen."""

import copy
import subprocess
import sys
from pathlib import Path

import pytest
import record

ROOT = Path(__file__).resolve().parent.parent

WAS = {
    "words": "simulate",
    "code": 0,
    "files": {
        "a/runs.csv": record.digest([
            *(("speed_mm_s", 100.0 + k) for k in range(20)),
            *(("status", "converged") for _ in range(20)),
            *(("sd", x) for x in (0.1, 0.2)),
        ])
    },
}  # fmt: skip


def changed(place, **leaves):
    """The record with leaves of a digest made anew."""
    now = copy.deepcopy(WAS)
    now["files"][place] = {**now["files"][place], "exact": "another", **leaves}
    return now


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("record")
    record.inputs(path)
    return path


@pytest.mark.parametrize("name", record.QUICK)
def test_quick_commands_leave_what_is_recorded(name, folder, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "")  # a command may set it
    assert record.differences(record.record(name), record.run(name, folder), record.CASES[name].rtol) == []


@pytest.mark.nightly
def test_every_command_leaves_what_is_recorded():
    command = [sys.executable, str(ROOT / "benchmarks" / "record.py"), "--check"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_case_is_recorded():
    kept = {path.stem for path in record.RECORD.glob("*.json")}
    assert kept == set(record.CASES)
    assert all(record.record(name)["words"] == case.words for name, case in record.CASES.items())
    assert set(record.QUICK) <= kept and all(not record.CASES[name].after for name in record.QUICK)


@pytest.mark.parametrize("by, seen", [(0.0, False), (1e-9, False), (1e-4, True)])
def test_a_number_is_held_to_its_tolerance(by, seen):
    numbers = record.digest([("speed_mm_s", (100.0 + k) * (1 + by * (k == 7))) for k in range(20)])["speed_mm_s"]
    found = record.differences(WAS, changed("a/runs.csv", speed_mm_s=numbers), 1e-6)
    assert bool(found) is seen
    short = [0.1, 0.2 * (1 + by)]
    assert bool(record.differences(WAS, changed("a/runs.csv", sd=short), 1e-6)) is seen
    assert bool(record.differences(WAS, changed("a/runs.csv", sd=short), 1e-6, exact=True)) is True


def test_order_of_numbers_text_files_and_exit_codes_are_compared():
    backward = record.digest([("speed_mm_s", 119.0 - k) for k in range(20)])["speed_mm_s"]
    assert record.differences(WAS, changed("a/runs.csv", speed_mm_s=backward), 1e-3)
    words = record.digest([*(("status", "converged") for _ in range(19)), ("status", "slides")])
    assert record.differences(WAS, changed("a/runs.csv", **words), 1e-3)
    assert record.differences(WAS, {**WAS, "files": {}}, 1e-3) == ["a/runs.csv: not left"]
    assert record.differences(WAS, {**WAS, "code": 3}, 1e-3) == ["code: 3 (was 0)"]
    assert record.differences(WAS, copy.deepcopy(WAS), 1e-6, exact=True) == []


def test_what_says_when_and_where_is_no_part_of_a_record():
    leaves = [*record._flat({"seconds": 3.1, "hashes": {"robot": "x"}, "value": [1, None, True]})]
    assert [name for name, _ in leaves] == ["{}", "value[]", "value[]", "value[]", "value[]"]
