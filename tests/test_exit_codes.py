"""One rule for exit codes: whatever the answer 0, and 3 where a solver failed. Documented for each command."""

import shlex
import signal
import subprocess
import sys
import time
import weakref

import numpy as np
import pytest

from sweeps import cli
from sweeps.pages import words
from sweeps.points import run


@pytest.mark.quick(1)
@pytest.mark.parametrize("status, code", [(status, 3 if status == "failed" else 0) for status in words.STATUSES])
def test_only_a_solver_that_failed_ends_with_3(status, code, mmrjax, monkeypatch):
    honest = run.evaluate_runs

    def evaluate(*given, **options):
        found = honest(*given, **options)
        return {**found, "status": np.array([status, *found["status"][1:]])}

    monkeypatch.setattr(run, "evaluate_runs", evaluate)
    assert mmrjax("compare measured --no-report --out s")[0] == code


def test_a_reader_that_has_had_enough_is_no_fault_of_a_file_of_effects(monkeypatch, capsys):
    """As `mmrjax loop --help | head`: the option parser ends the program itself."""

    def app(**_):
        try:
            raise BrokenPipeError
        except BrokenPipeError:
            raise SystemExit(1)  # noqa: B904

    monkeypatch.setattr(cli, "app", app)
    monkeypatch.setattr("sys.argv", ["mmrjax"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 1 and capsys.readouterr().err == ""


PROGRAM = [sys.executable, "-c", "from sweeps.cli import main; main()"]


@pytest.mark.parametrize(
    "arguments, streams, code",
    [
        ("--version", ">&-", 0),
        ("--version", "<&- >&- 2>&-", 0),
        ("--version", "> /dev/full", 2),
        ("--help", "> /dev/full", 2),
        ("--version", "2> /dev/full", 0),
        ("rig new no/folder.toml", "2> /dev/full", 2),
        ("rig new no/folder.toml", "> /dev/full", 2),
    ],
)
def test_closed_and_full_outputs_change_no_exit_code_but_of_what_is_lost(tmp_path, arguments, streams, code):
    shell = f"{shlex.join(PROGRAM)} {arguments} {streams}"
    ended = subprocess.run(["sh", "-c", shell], capture_output=True, text=True, cwd=tmp_path)
    assert ended.returncode == code and ended.stderr.count("\n") == (code and "2>" not in streams), ended.stderr


def test_files_do_not_get_the_number_of_a_closed_stream(tmp_path):
    code = "from sweeps import cli; cli._replace_closed_streams(); print(open('file', 'w').fileno() > 2, file=open('n', 'w'))"
    subprocess.run(["sh", "-c", f"{shlex.join([sys.executable, '-c', code])} <&- >&- 2>&-"], check=True, cwd=tmp_path)
    assert (tmp_path / "n").read_text() == "True\n"


def test_an_interrupt_within_a_callback_is_obeyed(monkeypatch, capsys):
    """As in the collection of garbage, where Python would print it and go on."""

    class Garbage:
        pass

    def app(**_):
        thing = Garbage()
        held = weakref.ref(thing, lambda _: signal.raise_signal(signal.SIGINT))
        del thing
        for _ in range(500):
            time.sleep(0.01)
        return held

    monkeypatch.setattr(cli, "app", app)
    monkeypatch.setattr("sys.argv", ["mmrjax"])
    monkeypatch.setattr("os._exit", sys.exit)
    hook, begun = sys.unraisablehook, time.monotonic()
    ignored = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    with pytest.raises(SystemExit) as end:
        cli.main()
    signal.signal(signal.SIGINT, ignored)
    assert end.value.code == 130 and time.monotonic() - begun < 4 and sys.unraisablehook is hook
    assert capsys.readouterr().err == "mmrjax: interrupted; no run folder was written\n"
