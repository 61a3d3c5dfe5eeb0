"""One rule for exit codes: whatever the answer 0, and 3 where a solver failed; documented for each command."""

from pathlib import Path

import numpy as np
import pytest
from typer.main import get_command

from sweeps import cli
from sweeps.pages import words
from sweeps.points import run

DOCS = Path(__file__).resolve().parents[1] / "docs"


@pytest.mark.quick(1)
@pytest.mark.parametrize(("status", "code"), [(status, 3 if status == "failed" else 0) for status in words.STATUSES])
def test_only_a_solver_that_failed_ends_with_3(status, code, mmrjax, monkeypatch):
    honest = run.evaluate_runs

    def evaluate(*given, **options):
        found = honest(*given, **options)
        return {**found, "status": np.array([status, *found["status"][1:]])}

    monkeypatch.setattr(run, "evaluate_runs", evaluate)
    assert mmrjax("compare", "measured", "--no-report", "--out", "s")[0] == code


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


def test_every_command_says_what_3_means_and_the_docs_have_its_words():
    text = (DOCS / "reference" / "exit-codes.md").read_text(encoding="utf-8")
    documented = {}
    for line in text.splitlines():
        if line.startswith("| `"):
            names, _, meaning = line.strip("| ").partition(" | ")
            documented |= {name.strip("` "): meaning for name in names.split(",")}
    said = {
        name: command.epilog.partition("Exit code 3: ")[2].removesuffix(".")
        for name, command in get_command(cli.app).commands.items()
        if "Exit code 3" in (command.epilog or "")
    }
    assert said == documented and all(said.values()) and {"simulate", "sweep", "loop", "check"} <= set(said)
