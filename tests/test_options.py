"""Options of commands are what their configurations say: nothing of a field is stated twice."""

import re
import sys
from pathlib import Path

import pytest
import typer

from sweeps import cli, config, config_campaign, options
from tests.commands import ends

KINDS = {
    "simulate": (config.Simulate, config.OneRun),
    "sweep": (config.Sweep, config_campaign.StoreOptions),
    "compare": (config.Compare, config.ComparedRuns),
    "reproduce": (config.Reproduce,),
    "render": (config.Render, config.OneRun),
    "calibrate": (config.Calibrate, config.FittedRuns),
    "loop": (config.Loop, config.LoopBeside),
    "export": (config.Export,),
    "settle": (config.Settle,),
    "sensitivity": (config.Sensitivity,),
    "resonance": (config.Resonance,),
    "climb": (config.Climb,),
    "check": (config.Check,),
    "size": (config.Size,),
}
CLI = Path(cli.__file__).read_text(encoding="utf-8")
#: Most options that `--help` of a command shows, besides `--help` and `--help-all`.
MOST = 8


@pytest.fixture(scope="module")
def parameters():
    """Parameters of each command's parser by name."""
    commands = typer.main.get_command(cli.app).commands
    return {name: {p.name: p for p in command.params} for name, command in commands.items()}


@pytest.fixture
def said(monkeypatch, capsys):
    """What `mmrjax ...` prints, the borders of its tables aside."""

    def say(*words):
        monkeypatch.setenv("COLUMNS", "200")
        monkeypatch.setattr(sys, "argv", ["mmrjax", *words])
        with pytest.raises(SystemExit):
            cli.main()
        out, err = capsys.readouterr()
        return out + err

    return say


@pytest.mark.parametrize("command", KINDS)
def test_every_field_that_can_be_chosen_is_an_option_that_says_what_the_schema_says(command, parameters):
    for kind in KINDS[command]:
        for name, fact in kind.model_json_schema()["properties"].items():
            if "const" in fact:
                assert name not in parameters[command]
                continue
            shown = parameters[command][name]
            assert fact["description"].rstrip(".").partition(" (")[0] in shown.help.replace("\\", ""), name
            _, unit = options.split_unit(name)
            assert not unit or f"({unit})" in shown.help, name
            assert all(choice in shown.help for choice in fact.get("enum", ()))
            assert shown.default is None, name  # what is not given is the configuration's affair
    assert {"config_file", "no_cache"} <= set(parameters[command])


@pytest.mark.parametrize("command", KINDS)
def test_help_shows_few_options_and_help_all_every_one(command, parameters, said):
    """Those that the command calls common, so that a name that is no option fails."""
    listed = [p for p in parameters[command].values() if p.opts[0].startswith("--") and p.name != "help_all"]
    shown = [p.opts[0] for p in listed if not p.hidden]
    called = re.search(rf'common="([^"]*)"(?:(?!common=).)*?def {command}\(', CLI, re.DOTALL)
    assert shown == [f"--{word}" for word in called[1].split()] and 0 < len(shown) <= MOST
    short, whole = said(command, "--help"), said(command, "--help-all")
    of_help = [{line.split()[1] for line in text.splitlines() if "│ --" in line} for text in (short, whole)]
    assert of_help[0] == {*shown, "--help-all", "--help"}
    assert of_help[1] == {*(p.opts[0] for p in listed), "--help-all", "--help"}
    assert f"Example: mmrjax {command}" in whole
    assert said(command, "--help") == short  # nothing is left of it


def test_keys_of_a_file_are_read_and_options_win(tmp_path):
    file = tmp_path / "c.toml"
    file.write_text("seed = 3\nreplicates = 300\nrows = 800\n")
    found = config.resolve_configuration(config.Loop, file, {})
    assert (found.seed, found.replicates, found.rows) == (3, 300, 800)
    assert config.resolve_configuration(config.Loop, file, {"rows": 1600}).rows == 1600


HARM = "import pathlib\npathlib.Path('harmed').touch()\n"
ASKED = [
    (("simulate",), 'effects = ["own.py"]'),
    (("loop", "measured"), 'effects = ["own.py"]'),
    (("sweep", "--dry-run"), 'effects = ["own.py"]\n[axes]\nvoltage = [24]'),
]


@pytest.mark.parametrize("command, text", ASKED)
def test_a_file_runs_no_code_unless_it_is_trusted(mmrjax, tmp_path, command, text):
    (tmp_path / "own.py").write_text(HARM)
    (tmp_path / "plan.toml").write_text(text)
    asks = (*command, "--config", "plan.toml", "--out", "x")
    _, out, _ = ends(mmrjax(*asks), "would run code, which a file may not request; give --effects on the command")
    assert not out and sorted(p.name for p in tmp_path.iterdir()) == ["own.py", "plan.toml"]
    for how in (("--trust",), ("--effects", "own.py")):
        ends(mmrjax(*asks, *how), "own.py: contains no effect")
        (tmp_path / "harmed").unlink()


def test_an_empty_list_of_effects_asks_for_nothing(tmp_path):
    (tmp_path / "a.toml").write_text(config.as_toml(config.Simulate()))
    assert "effects = []" in (tmp_path / "a.toml").read_text()
    assert config.resolve_configuration(config.Simulate, tmp_path / "a.toml", {}) == config.Simulate()
