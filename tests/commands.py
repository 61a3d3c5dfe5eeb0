"""The command line in this process, the tables that it leaves, and files that it reads."""

import contextlib
import csv
import dataclasses
import json
import os
import signal
import sys
from pathlib import Path

import pandas as pd
import pytest

from calibration.data import robot_file
from calibration.data import runs as records
from calibration.data.input_errors import BadData
from mmrjax.model.params import walk_parameters
from sweeps import cli

#: The checkout.
ROOT = Path(__file__).resolve().parents[1]


def command(arguments):
    """Run a command, its first words as one string. Returns its exit code."""
    words, *rest = arguments
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as end:
        patch.setenv("XLA_FLAGS", os.environ.get("XLA_FLAGS", ""))  # a command may set it
        patch.setattr(sys, "argv", ["mmrjax", *str(words).split(), *map(str, rest)])
        cli.main()
    return end.value.code


def rows(path):
    """The rows of a CSV file."""
    with path.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def columns_of(path):
    """Columns of a CSV file: numbers, an empty cell NaN, or texts."""
    return {name: cells.to_numpy() for name, cells in pd.read_csv(path).items()}


def ends(run, *said, code=2):
    """A run (exit code, stdout, stderr) that ended with `code` and says each sentence, on stderr if it was refused."""
    ended, out, err = run
    text = out + err if code == 0 else err
    assert ended == code, err
    for sentence in said:
        assert sentence in text or sentence in " ".join(text.split()), text
    return run


@contextlib.contextmanager
def refused(says, error=BadData):
    """What it does is refused in one sentence that matches `says`."""
    with pytest.raises(error, match=says) as refusal:
        yield
    assert "\n" not in str(refusal.value)


class Hangs(BaseException):
    """A command or a reader has not answered."""


@contextlib.contextmanager
def alarmed(seconds=60):
    """Raises `Hangs` after so many seconds of wall-clock time."""

    def hang(*_):
        raise Hangs

    handler = signal.signal(signal.SIGALRM, hang)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, handler)


def parameter_values(robot):
    """Every parameter of a robot by its name."""
    return {p.name: float(p.value) for p in walk_parameters(robot)}


def text_file(path, text):
    """Path of a new file with this text."""
    path.write_text(text, encoding="utf-8")
    return path


def csv_text(columns):
    """A table of columns as the text of a CSV file."""
    lines = [",".join(columns), *(",".join(map(str, row)) for row in zip(*columns.values(), strict=True))]
    return "\n".join(lines) + "\n"


def read_rig(folder, text, name="rig.toml", **options):
    """The robot of a new file with this text."""
    return robot_file.read_robot(text_file(folder / name, text), **options)


def read_table(folder, text, robot=None, name="log.csv", **options):
    """The runs of a new table with this text."""
    return records.read_runs(text_file(folder / name, text), robot=robot, **options)


def with_columns(runs, **columns):
    """The runs with these columns added or replaced."""
    return dataclasses.replace(runs, columns=runs.columns | columns)


def read_json(path):
    """The content of a file of JSON."""
    return json.loads(path.read_text(encoding="utf-8"))


def schema_of(command):
    """Schema of a command's result.json."""
    return read_json(ROOT / "docs/schemas" / f"{command}.schema.json")


def motor_on_bench(torque_constant, resistance):
    """Rig file of one motor on a bench, from which current and speed are read."""
    return f"""
base = "none"
imposed = "voltage"
channels = ["motor_current", "motor_speed"]
sides = 1
[motor]
torque_constant = "{torque_constant}"
resistance = "{resistance}"
inductance = 0.0004
friction_coulomb = "0.02 ± 50 %"
friction_viscous = "3e-5 ± 100 %"
inertia = "0.0002 ± 40 %"
[gearbox]
ratio = 1
efficiency_load = "1 ± 0"
[bench]
load = "shaft"
inertia = "1e-7 ± 0"
loss_coulomb = "0 ± 0"
"""
