"""The command `loop` as a user runs it: what it leaves, what it says of bad input, effects of the user's own."""

import contextlib
import functools
import io
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import jsonschema
import numpy as np
import pytest
from numpy.testing import assert_allclose
from synthetic import FEW, small
from worlds import histories, settled, tables

from calibration.data import effect_file, robot_file
from calibration.inference import bases as curves
from mmrjax.effects import BY_NAME
from sweeps import cli
from sweeps.commands import loop as room
from tests.commands import ROOT, csv_text, parameter_values, read_json, rows, schema_of, text_file

SCHEMA = schema_of("loop")
PRIORS = [a for c in ("6T2A", "4W2T") for a in ("--prior", f"{c}.ground.friction.static=0.6±0.09")]

#: What the generator's `guide_binding` does, which is not in the library, as a user would write it.
MINE = '''
from typing import ClassVar

import jax.numpy as jnp
from mmrjax.effects import Effect
from mmrjax.model.params import Scalar, parameter
from mmrjax.model.signals import Signals


class PayloadBinding(Effect):
    """ΔM_t = a max(m - 2 kg, 0)² / 25 kg²: the payload bends the chassis. Source: none, an example."""

    name: ClassVar[str] = "payload_binding"
    balance: ClassVar[str] = "track"
    dissipative: ClassVar[bool] = True

    amplitude: Scalar = parameter(
        0.0, unit="N·m", meaning="torque at 7 kg", bounds=(-3.0, 3.0), sd=0.3, source="example", amplitude=True
    )

    def term(self, robot, signals: Signals) -> Scalar:
        return self.amplitude * jnp.maximum(signals.payload - 2.0, 0.0) ** 2 / 25.0
'''


def mmrjax(folder, *arguments):
    """Run a command in this process and in a folder: exit code, stdout and stderr."""
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        patch.chdir(folder)
        patch.setattr(os, "_exit", sys.exit)
        patch.setattr(sys, "argv", ["mmrjax", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            cli.main()
    return SimpleNamespace(code=end.value.code, out=out.getvalue(), err=err.getvalue())


def written(path, table):
    text_file(path, csv_text(table))


def loaded(p):
    return settled.table8(p, payloads=(0.0, 3.0, 5.0, 8.0), slopes=(0.0, 10.0), voltages=(24.0, 33.0))


@functools.cache
def commanded(every=False):
    """The whole command on 24 runs of a robot whose track churns, one of them twice. Made once for all files.

    It looks for the effects of `FEW` alone, or for `every` one of the library.
    """
    room_for_it = tempfile.TemporaryDirectory()  # which is there as long as the answer
    folder, kept = Path(room_for_it.name), []
    case = tables.narrow(["churning"], 15.0, seed=3, grid=small)
    columns = {**case.table, "run_id": np.arange(24)}  # one of them twice
    written(folder / "runs.csv", {k: np.append(v, v[4]) for k, v in columns.items()})

    def discover(*arguments, **options):
        kept.append(discovering(*arguments, **options))
        return kept[-1]

    with pytest.MonkeyPatch.context() as patch:
        discovering = room.discover
        patch.setattr(room, "discover", discover)
        if not every:
            patch.setattr(room, "effect_file", SimpleNamespace(effect_library=lambda paths: FEW.library))
        answer = mmrjax(folder, "loop", "runs.csv", "--replicates", 250, "--out", "found", *PRIORS)
    result = read_json(folder / "found/result.json")
    return SimpleNamespace(
        folder=folder, case=case, answer=answer, result=result, found=kept[0], room_for_it=room_for_it
    )


@pytest.fixture(scope="module", params=["few", pytest.param("every", marks=pytest.mark.slow)])
def done(request):
    return commanded(every=True) if request.param == "every" else commanded()


@contextlib.contextmanager
def few_effects():
    """The command with a library of three effects beside the user's: small programs, compiled fast."""
    with pytest.MonkeyPatch.context() as patch:
        some = {n: BY_NAME[n] for n in ("churning", "series_resistance", "load_slip")}

        def library(paths):
            return some | {e.name: e for path in paths for e in effect_file.read_effect_file(Path(path))}

        patch.setattr(room, "effect_file", SimpleNamespace(effect_library=library))
        yield


@pytest.fixture(scope="module")
def quick():
    with few_effects():
        yield


# --- what it leaves ----------------------------------------------------------------------------------


def test_loop_command_prints_its_answer_and_leaves_its_files(done):
    assert done.answer.code == 0
    lines = done.answer.out.rstrip().splitlines()
    assert lines[-1] == "found" and lines[0].startswith("No: a loss torque")
    assert len(lines) <= 5 and "Added: churning" in lines[1]  # the rest is on the page
    assert "fitting the base model" in done.answer.err and "fitting the base model" not in done.answer.out
    names = {p.name for p in (done.folder / "found").iterdir()}
    assert names == {
        "config.resolved.toml", "figures", "fitted.toml", "manifest.json", "posterior.nc", "report.html", "result.json", "robot.toml", "rows.csv",
        "screening.json",
    }  # fmt: skip


def test_what_is_written_predicts_and_the_refit_stands_beside_it(done):
    said = done.result["prediction"]
    assert said["written"] == "found" and said["gain"] > said["se"] > 0
    refit, found = (robot_file.load_robot(done.folder / "found" / f"{name}.toml") for name in ("fitted", "robot"))
    assert not refit.effects and [e.name for e in found.effects] == [done.result["effects"][0]["name"]]
    values = parameter_values(refit)
    for name, shift in done.result["base_shift"].items():
        if shift["unit"] == "-":
            assert values[name] == pytest.approx(shift["before"], rel=1e-6)


def test_residuals_of_rows_are_simulated_less_measured_readings(done):
    """As statistics.md has it, before as after."""
    table = rows(done.folder / "found/rows.csv")
    for name in ("total_current{}_A", "motor_speed{}_rpm", "speed{}_mm_s"):
        channel, read = name.partition("{")[0], name.format("")
        for fit in ("before", "after"):
            names = f"{fit}_{read}", read, name.format("_sd"), f"residual_{fit}_{channel}_sigma"
            shown, measured, sd, residual = (np.array([float(row[n]) for row in table]) for n in names)
            assert_allclose(residual, (shown - measured) / sd, atol=1e-4)  # nine digits are written
            assert np.ptp(residual) > 1


def test_result_has_the_schema_of_the_issue(done):
    r = done.result
    jsonschema.validate(r, SCHEMA)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({**r, "verdict": "perhaps"}, SCHEMA)
    assert r["schema"] == "mmrjax.loop/4" and r["verdict"] in ("named", "class")
    (effect,) = r["effects"]
    assert effect["name"] == effect["class"][0] and "churning" in effect["class"]
    amplitude = effect["parameters"]["amplitude"]
    assert amplitude["sd"] > 0 and 0 < effect["p_value"] < 0.05 and not amplitude["held_by_prior"]
    if effect["name"] == "churning":
        truth = done.case.label["effects"][0]["amplitude"]
        assert abs(amplitude["value"] - truth) < 4 * amplitude["sd"] and amplitude["unit"] == "N·m·s^2"
    assert set(r["cannot_see"]) <= set(BY_NAME) and "cogging" in r["needs_series"]
    assert r["next_experiment"] is not None or r["verdict"] == "named"
    for errors in r["errors"].values():
        for seen in ("fitted", "held_out"):
            assert set(errors[seen]) == {"total_current", "motor_speed", "speed"}
            assert all(0 < by["rms_percent"] < 20 for by in errors[seen].values())
    before, after = (r["errors"][w]["held_out"]["total_current"]["rms_sigma"] for w in ("before", "after"))
    assert after < 0.7 * before
    assert r["adequate"] == {"before": False, "after": True}
    assert not re.search(r"\bNaN\b|Infinity", (done.folder / "found/result.json").read_text())


def test_copied_rows_count_once_and_a_note_reports_them(done):
    assert done.result["rows"] == done.result["rows_used"] == 24
    assert any("row 25 is an exact copy" in note for note in done.result["notes"])


# --- effects of the user's own, and thin data --------------------------------------------------------


def result_with_own_effect(folder, table):
    """result.json of the command on a table, with an effect of the user's own beside three of the library."""
    written(folder / "runs.csv", table)
    run = ["loop", "runs.csv", "--no-report", "--replicates", 250, "--out", "x", *PRIORS]
    assert mmrjax(folder, *run, "--effects", text_file(folder / "mine.py", MINE)).code == 0
    return read_json(folder / "x/result.json")


@pytest.mark.slow
def test_users_effect_is_scored_and_named(quick, tmp_path):
    result = result_with_own_effect(tmp_path, tables.narrow(["guide_binding"], 12.0, seed=5, grid=loaded).table)
    assert result["verdict"] == "named" and [e["name"] for e in result["effects"]] == ["payload_binding"]
    assert result["scores"][0]["name"] == "payload_binding" and result["scores"][0]["score"] > 60
    assert "[effects.payload_binding]" in (tmp_path / "x/robot.toml").read_text()


# --- bad input ---------------------------------------------------------------------------------------

HEADER = (
    "configuration,supply_voltage_V,total_mass_kg,payload_kg,slope_deg,total_current_A,motor_speed_rpm,speed_mm_s"
)


#: Eight runs with nothing wrong.
TABLE = "\n".join([HEADER, *(f"6T2A,{u},13.1,0,5,{2 + 0.05 * u},{320 * u},{27 * u}" for u in range(12, 20))])


def test_interrupt_leaves_nothing(tmp_path, monkeypatch):
    def interrupted(*_, **__):
        assert (tmp_path / "x.partial").exists()
        raise KeyboardInterrupt

    monkeypatch.setattr(room, "discover", interrupted)
    (tmp_path / "runs.csv").write_text(TABLE)
    answer = mmrjax(tmp_path, "loop", "runs.csv", "--out", "x")
    assert answer.code == 130 and answer.err.splitlines()[-1].startswith("mmrjax: interrupted")
    assert [p.name for p in tmp_path.iterdir()] == ["runs.csv"]


# --- histories ---------------------------------------------------------------------------------------


def starts_churning(folder):
    """The whole command on six starts of a robot whose tracks churn, one sample given twice."""
    made = histories.narrow(["churning"], 14.0, seed=5, duration=0.8)
    written(folder / "starts.csv", {k: np.append(v, v[40]) for k, v in made.table.items()})
    priors = [*PRIORS, *(a.replace("static=0.6±0.09", "dynamic=0.48±0.08") for a in PRIORS)]
    answer = mmrjax(folder, "loop", "starts.csv", "--replicates", 250, "--out", "found", *priors)
    return SimpleNamespace(folder=folder, label=made.label["effects"][0], answer=answer)


@pytest.fixture(scope="module")
def started(quick, tmp_path_factory):
    return starts_churning(tmp_path_factory.mktemp("started"))


@pytest.mark.nightly
def test_histories_go_through_the_command(started):
    assert started.answer.code == 0, started.answer.err
    r = read_json(started.folder / "found/result.json")
    (effect,) = r["effects"]
    assert r["verdict"] == "named" and effect["name"] == "churning" and r["rows"] == 6 * 41
    amplitude = effect["parameters"]["amplitude"]
    assert abs(amplitude["value"] - started.label["amplitude"]) < 4 * amplitude["sd"]
    assert any("row 247 is an exact copy" in note for note in r["notes"])
    told = r["series"]
    assert told["runs"] == 6 and told["samples"] == 6 * 41 and r["needs_series"] == []
    assert {o["order"] for o in told["before"]["orders"]} | set(told["orders_unresolved"]) == set(curves.ORDERS)
    assert len(told["after"]["memory"]["autocorrelation"]["speed"]) == told["after"]["memory"]["lags"]
    assert r["evidence"]["before"]["white"]["threshold"] > 0
    # the errors by blocks that differ: slope, voltage and payload go together in these six runs
    assert set(r["held_out_by"]) == {"slope", "run"}


# --- a channel more ----------------------------------------------------------------------------------

FOURTH = """
import csv, sys
from mmrjax.model import quantities
quantities.TABLE["channel"] += (quantities.Channel(
    "terminal_voltage", "V", "terminal voltage", (-200.0, 200.0), 50.0, word="voltage", signal="voltage"
),)
from mmrjax.model import channels
channels.USUAL += ("terminal_voltage",)
source, target, out, *priors = sys.argv[1:]
rows = list(csv.DictReader(open(source)))
for row in rows:
    row |= {"terminal_voltage_V": row["supply_voltage_V"], "terminal_voltage_sd_V": "0.05"}
with open(target, "w") as file:
    table = csv.DictWriter(file, rows[0])
    table.writeheader()
    table.writerows(rows)
sys.argv = ["mmrjax", "loop", target, "--out", out, "--replicates", "250", "--no-report", *priors]
from sweeps.cli import main
main()
"""


@pytest.mark.slow
def test_fourth_channel_goes_through_the_loop_by_one_row(tmp_path):
    source, found = ROOT / "tests/record/library.csv", tmp_path / "found"
    command = [sys.executable, "-c", FOURTH, source, tmp_path / "runs.csv", found, *PRIORS]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stderr
    result = read_json(found / "result.json")
    assert "churning" in result["effects"][0]["class"] and "terminal_voltage" in result["noise"]
    assert result["chi2"]["readings"] == 4 * result["rows"]
    assert result["errors"]["after"]["fitted"]["terminal_voltage"]["rows"] == result["rows"]
