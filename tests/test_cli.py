"""The command line as a user runs it: run folders, exit codes, messages, interruption."""

import os
import re
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numpy as np
import pytest
import rich.text
import typer

from mmrjax import OLDER_EMITTERS, SOUND_AT_LEVEL_0, errors, fidelities
from sweeps import cli, options
from sweeps.config import Sweep, as_toml, resolve_configuration
from sweeps.points.scale import CompiledJob, share_counter
from tests.commands import ends, read_json
from tests.commands import rows as table
from tests.pages import recorded

MMRJAX = [sys.executable, "-c", "from sweeps.cli import main; main()"]
HEADER = (
    "configuration,supply_voltage_V,total_mass_kg,payload_kg,slope_deg,total_current_A,motor_speed_rpm,speed_mm_s"
)
CLIMBS = ["--set", "6T2A.ground.friction.static=0.6", "--set", "4W2T.ground.friction.static=0.6"]


def test_compare_own_mass_takes_the_robots(mmrjax, tmp_path):
    mmrjax("compare --no-report --out stated", *CLIMBS)
    mmrjax("compare --no-report --own-mass --out own", *CLIMBS)
    stated, own = (table(tmp_path / k / "runs.csv")[-1] for k in ("stated", "own"))
    assert (stated["total_mass_kg"], own["total_mass_kg"]) == ("21.1", "19.5")
    assert float(own["total_current_A"]) < float(stated["total_current_A"])


def test_data_are_hashed_in_the_manifest(mmrjax, tmp_path):
    import hashlib

    (tmp_path / "sub").mkdir()
    (tmp_path / "sub/runs.csv").write_text(f"{HEADER}\n6T2A,15,13.1,0,5,2.75,4800,400\n")
    assert mmrjax("compare sub/runs.csv --no-report --out x")[0] == 0
    known = hashlib.sha256((tmp_path / "sub/runs.csv").read_bytes()).hexdigest()
    assert read_json(tmp_path / "x/manifest.json")["hashes"]["runs.csv"] == known


def test_shares_of_a_batch_add_up_to_its_runs():
    told = []
    share = share_counter(told.append, 180)
    for k in range(21):
        share(k / 20)
    share(1.0)
    assert sum(told) == pytest.approx(180) and told[1] == pytest.approx(9) and told[-1] == 0


@pytest.mark.slow
def test_render_writes_a_picture_and_refuses_other_names(mmrjax, tmp_path):
    ends(mmrjax("render robot.bmp"), "expected a name that ends in .png")
    for words, message in (
        (("robot.png", "--time", "2"), "render: time: got 2 s; expected a time within the run, 0 to 1.5 s"),
        (("robot.png", "--time", "nan"), "render: time: got nan s"),
    ):
        _, out, err = ends(mmrjax("render", *words), message)
        assert out == "" and len(err.strip().splitlines()) == 1
    _, out, _ = ends(mmrjax("render robot.png --duration 0.05 --time 0.04"), "not_settled", code=0)
    assert out.rstrip().endswith("robot.png")  # drawn as it was asked for
    assert (tmp_path / "robot.png").read_bytes().startswith(b"\x89PNG")
    assert [p.name for p in tmp_path.iterdir()] == ["robot.png"]


def test_unwritable_or_taken_folder_is_refused(mmrjax, tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.txt").write_text("years of work")
    for out, says in (
        ("file/below", "--out: file/below cannot be written"), ("file", "--out: file exists already"),
        ("", "--out: got '.'; expected the name of a folder"),
    ):  # fmt: skip
        ends(mmrjax("sweep --out", out), says)
    ends(mmrjax("sweep --out mine --force"))
    assert (tmp_path / "mine/thesis.txt").exists()  # --force replaces run folders only


def test_run_folder_is_replaced_only_when_told(mmrjax, tmp_path):
    one = "simulate --no-report --out r"
    assert [mmrjax(words)[0] for words in (one, one, f"{one} --slope 5 --force")] == [0, 2, 0]
    assert table(tmp_path / "r/runs.csv")[0]["slope_deg"] == "5"


def test_full_disk_names_the_file_whichever_it_is(mmrjax, tmp_path, monkeypatch):
    """What the system says of a full disk names none."""
    honest = Path.write_text

    def full(path, *text, **options):
        if path.name == ".result.writing.json":  # written aside first
            raise OSError(28, "No space left on device")
        return honest(path, *text, **options)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_text", full)
        says = "r.partial/result.json: No space left on device; no run folder was written"
        ends(mmrjax("simulate --no-report --out r"), says)
    assert not (tmp_path / "r").exists()

    def picture(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("sweeps.report.page_renderer.write_report_page", picture)
    ends(mmrjax("simulate --out r"), "r.partial: No space left on device")


def test_interrupted_sweep_goes_on_where_it_stopped(mmrjax, tmp_path, monkeypatch):
    arguments = "sweep --slopes 0:9:1 --voltages 24 --configurations 6T2A --no-report"
    simulated, honest = [], CompiledJob.__call__

    def interrupted(compiled, values, *told):
        if len(simulated) == 3:
            while not any((tmp_path / "s.partial/chunks").glob("*.stage")):
                time.sleep(0.001)  # the first is being written meanwhile
            raise KeyboardInterrupt
        simulated.append(len(values))
        return honest(compiled, values, *told)

    monkeypatch.setattr(CompiledJob, "__call__", interrupted)
    ends(mmrjax(f"{arguments} --chunk 10 --out s"), "with --out continues after the last complete chunk", code=130)
    assert not (tmp_path / "s").exists() and (tmp_path / "s.partial").exists()
    kept = len(list((tmp_path / "s.partial/chunks").glob("*.stage")))
    assert 0 < kept <= 3
    simulated.clear()
    monkeypatch.setattr(CompiledJob, "__call__", lambda *a: (simulated.append(len(a[1])), honest(*a))[1])
    assert mmrjax(f"{arguments} --chunk 10 --out s")[0] == 0
    assert simulated == [fidelities.FEW] * (6 - kept)  # filled up, and none twice
    resumed = (tmp_path / "s/runs.csv").read_text()
    assert mmrjax(f"{arguments} --chunk 60 --out t")[0] == 0
    assert resumed == (tmp_path / "t/runs.csv").read_text()
    assert not (tmp_path / "s.partial").exists()


def test_partial_folder_of_another_run_is_not_taken_up(mmrjax, tmp_path, monkeypatch):
    arguments = "sweep --slopes 0:9:1 --chunk 60 --no-report --out"
    honest, calls = CompiledJob.__call__, []
    kept = tmp_path / "s.partial/chunks/chunk-000000.stage"

    def interrupted(*call):
        if calls:
            while not kept.exists():
                time.sleep(0.001)  # it is being written meanwhile
            raise KeyboardInterrupt
        calls.append(call)
        return honest(*call)

    with monkeypatch.context() as patch:
        patch.setattr(CompiledJob, "__call__", interrupted)
        assert mmrjax(arguments, "s")[0] == 130 and kept.exists()
    other = "--set", "motor.resistance=0.9"
    ends(mmrjax(arguments, "s", *other), "--force")
    assert kept.exists()
    mmrjax(arguments, "s", *other, "--force")
    mmrjax(arguments, "t", *other)
    assert (tmp_path / "s/runs.csv").read_text() == (tmp_path / "t/runs.csv").read_text()


@pytest.mark.parametrize("given", [None, "", "--xla_cpu_use_fusion_emitters=false"])
@pytest.mark.parametrize("model", ["track", "drive", "steady"])
def test_track_model_runs_xla_on_one_thread_unless_told_otherwise(monkeypatch, given, model):
    monkeypatch.setenv("XLA_FLAGS", given or "")  # so that it is put back
    if given is None:
        monkeypatch.delenv("XLA_FLAGS")
    resolved = resolve_configuration(Sweep, None, {"model": model})
    cli._prepare_environment(resolved)
    ours = "--xla_cpu_multi_thread_eigen=false" if model == "track" else None
    assert os.environ.get("XLA_FLAGS") == (ours if given is None else given)


@pytest.mark.slow
@pytest.mark.parametrize("arguments, flags", [
    ("sweep --config grid.toml", [SOUND_AT_LEVEL_0, "--xla_cpu_multi_thread_eigen=false"]),
    ("compare --model track", [SOUND_AT_LEVEL_0, "--xla_cpu_multi_thread_eigen=false"]),
    ("sweep", [SOUND_AT_LEVEL_0]), ("loop", [",".join((SOUND_AT_LEVEL_0, *cli.LOOP_COMPILER_OPTIONS))]),
    ("calibrate", [f"{SOUND_AT_LEVEL_0},{OLDER_EMITTERS}"]),
])  # fmt: skip
def test_flags_are_set_before_jax_is_imported(tmp_path, arguments, flags):
    """In a process of its own, up to where the options are checked and a folder refused."""
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken/thesis.txt").write_text("years of work")
    (tmp_path / "grid.toml").write_text('model = "track"\n')
    bare = {key: value for key, value in os.environ.items() if key != "XLA_FLAGS"} | {"JAX_PLATFORMS": "cpu"}
    words = [sys.executable, "-c", PROBE, *arguments.split(), "--out", "taken"]
    done = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path, env=bare)
    assert done.returncode == 2 and done.stdout.split() == flags, done.stderr


PROBE = """
import os, sys
class Seen:
    def find_spec(self, name, *_):
        if name == 'jax': print(os.environ.get('XLA_FLAGS'))
sys.meta_path.insert(0, Seen())
from sweeps.cli import main; main()
"""


def test_help_of_every_command_is_as_recorded(mmrjax, monkeypatch):
    monkeypatch.setenv("COLUMNS", "160")
    commands = typer.main.get_command(cli.app).commands
    named = [
        [name, *inner]
        for name, c in commands.items()
        for inner in ([[x] for x in getattr(c, "commands", ())] or [[]])
    ]
    lines = []
    for words in ([], *named):
        _, out, _ = ends(mmrjax(*words, "--help"), code=0)
        lines += [" ".join(re.sub("[^\\S ]|[╭╮╰╯│─]", " ", line).split()) for line in out.splitlines()]
    text = re.sub("Usage: .*?mmrjax", "Usage: mmrjax", "\n".join(filter(None, lines)) + "\n")
    assert text == recorded("help", text)


def test_no_word_in_brackets_is_lost_from_a_help():
    def helps(command):
        yield re.sub(r"\[/?bold\]", "", command.help or "")
        yield from (str(getattr(p, "help", "") or "") for p in command.params)
        for inner in getattr(command, "commands", {}).values():
            yield from helps(inner)

    for text in helps(typer.main.get_command(cli.app)):
        assert rich.text.Text.from_markup(text).plain == text.replace("\\[", "["), text


@pytest.mark.slow
def test_check_passes_on_this_installation(mmrjax):
    _, out, _ = ends(mmrjax("--check"), "24 V / C_E", code=0)
    assert "FAILED" not in out
    assert "compilation cache" in out and ("programs" in out or "off" in out)


@pytest.mark.parametrize("text, values", [
    ("0,5,10", (0.0, 5.0, 10.0)), ("0:1:0.25", (0.0, 0.25, 0.5, 0.75, 1.0)), ("0:1:0.3,9", (0.0, 0.3, 0.6, 0.9, 9.0)),
    ("0:20:0.1", np.arange(201) / 10),
])  # fmt: skip
def test_axis_takes_values_and_ranges(text, values):
    assert options.parse_axis("--slopes", text) == pytest.approx(values)


@pytest.mark.parametrize("model, expected", [("steady", {}), ("drive", {"duration_s": 30.0}),
                                             ("track", {"duration_s": 1.5, "step_s": 1e-4})])  # fmt: skip
def test_resolved_configuration_states_the_options_of_its_fidelity(tmp_path, model, expected):
    written = as_toml(resolve_configuration(Sweep, None, {"model": model}))
    stated = tomllib.loads(written)
    assert {key: stated[key] for key in ("duration_s", "step_s") if key in stated} == expected
    (tmp_path / "again.toml").write_text(written)
    assert as_toml(resolve_configuration(Sweep, tmp_path / "again.toml", {})) == written


def test_configurations_of_former_versions_are_read(tmp_path):
    (tmp_path / "old.toml").write_text('model = "steady"\nstep_s = 0.0001\nrobot = "sm1"\n')
    assert resolve_configuration(Sweep, tmp_path / "old.toml", {}).robot == "sm1"


# --- what ends a command from outside -------------------------------------------------------------------------------


@pytest.mark.parametrize("ended", [MemoryError(), RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 9 bytes."),
                                   ImportError("libx.so: failed to map segment from shared object")])  # fmt: skip
@pytest.mark.parametrize("command", ["simulate", "sweep --zarr --voltages 24 --slopes 0"])
def test_memory_exhausted_is_one_sentence_and_leaves_nothing(mmrjax, tmp_path, monkeypatch, command, ended):
    def short(*_, **__):
        raise ended

    monkeypatch.setattr(CompiledJob, "__call__", short)
    code, _, err = mmrjax(command, "--no-report", "--out", "x")
    assert code == 2 and err.endswith("mmrjax: out of memory; use a smaller --chunk, fewer rows, or more memory\n")
    assert "Traceback" not in err and not any(tmp_path.iterdir())


def test_a_message_has_at_most_400_characters_and_keeps_its_end(capsys):
    whole = f"{'/data' * 30}/log.csv: got none; run mmrjax loop {'/data' * 30}/log.csv"
    assert cli._print_failure(whole, 4) == 4 and capsys.readouterr().err == f"mmrjax: {whole}\n"
    assert cli._print_failure(f"x: got {'many words ' * 99}; expected fewer", 2) == 2
    err = capsys.readouterr().err
    assert len(err) <= len("mmrjax: \n") + errors.LONGEST == 409 and err.endswith("; expected fewer\n")


def test_too_little_memory_is_refused_at_once(mmrjax, tmp_path, monkeypatch):
    import resource

    monkeypatch.setattr(resource, "getrlimit", lambda _: (500_000_000, 500_000_000))
    ends(
        mmrjax("simulate --out x"),
        "memory: got a limit of 0.5 GB of address space (ulimit -v); expected at least 2 GB",
    )
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("code", ["0", "1", "'all is well'"])
def test_an_effects_file_cannot_end_the_command_as_if_it_were_done(mmrjax, tmp_path, monkeypatch, code):
    (tmp_path / "own.py").write_text(f"import sys\nsys.exit({code})\n")
    ends(mmrjax("simulate --effects own.py --out x"), "own.py: its code fails (SystemExit:")
    assert not (tmp_path / "x").exists()

    def later(*_, **__):
        raise SystemExit(0)

    monkeypatch.setattr(CompiledJob, "__call__", later)
    ends(mmrjax("simulate --no-report --out x"), "a file's code ended the program")
    assert [p.name for p in tmp_path.iterdir()] == ["own.py"]


def test_a_file_that_ends_too_early_is_no_interrupt(mmrjax, monkeypatch):
    def short(*_, **__):
        raise EOFError("No data left in file")

    monkeypatch.setattr(CompiledJob, "__call__", short)
    _, _, err = ends(mmrjax("simulate --no-report --out x"), "internal error: No data left in file", code=1)
    assert "interrupted" not in err


def test_a_name_that_is_not_utf8_is_refused_before_anything_runs(mmrjax, tmp_path):
    code, _, err = mmrjax("compare", "runs\udcff.csv", "--out", "r")
    assert code == 2 and err == "mmrjax: runs?.csv: is not in UTF-8; rename the file or folder\n"
    assert not list(tmp_path.iterdir())


def test_a_rig_on_a_read_only_disk_is_named_without_a_partial(mmrjax, monkeypatch):
    monkeypatch.setattr(
        Path, "write_text", lambda *_, **__: (_ for _ in ()).throw(OSError(30, "Read-only file system"))
    )
    code, _, err = mmrjax("rig new r.toml --kind bench")
    assert code == 2 and err == "mmrjax: r.toml: cannot be written (Read-only file system); choose another path\n"
