"""Names of users in files of other languages, on terminals and on pages: they are words there, and nothing obeys them."""

from __future__ import annotations

import ast
import builtins
import csv
import html.parser
import json
import re
import tomllib
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pyarrow as pa
import pytest
import samples
from pyarrow import feather, parquet
from rich.table import Table as RichTable

from calibration.data import delimited
from calibration.data.input_errors import BadConfiguration, BadData
from calibration.data.robot_file import find_robot_file, write_robot
from calibration.data.writing import cell_text, json_text, toml_value, write_table
from mmrjax.errors import UsageError, printable
from mmrjax.model.robot import Configurations
from sweeps.config import Simulate, as_toml
from sweeps.console import print_json, print_message, print_output
from sweeps.export import feed_forward
from sweeps.export import joint as joints
from sweeps.export.law_source import LawConstant, jax_source, mjlab_files, module_from_source
from sweeps.export.mujoco import mjcf_fragment, mjcf_motor, mjcf_scene, translate_law
from sweeps.report import export_report, page_renderer
from sweeps.report.document import Column, Document, Note, Section, Table
from tests.commands import csv_text

#: Each ends a literal, a comment or a line of some language, and would then call `boom`.
NAMES = (
    'x"""+str(boom())+"""', "'''+str(boom())+'''", "b\\N{x}\\", "l\nboom()\r\u2028boom()\x85boom()", "{boom()}{{b}}%s",
    "--><boom/>---x--", "]]><boom/>", "</script><script>boom()</script>", '" onload="boom()', "*/ int boom; /*",
    "=cmd|' /C boom'!A0", "+1+boom", "-boom", "@boom", "'=boom", "\tboom", "\x1b[31m\x1b]0;boom\x07\x9b", "\u202eboom",
    "half \ud800 boom", "|`boom`<b>", "\x7f", "\N{GRINNING FACE}",
)  # fmt: skip
ALL = " ".join(NAMES)


def obeyed(text):
    """Characters that a terminal or page would obey."""
    return set(text) - set(printable(text))


@pytest.fixture(scope="module")
def drive():
    """The packaged robot as a joint, its file and its load called by all names, and its numbers."""
    file = find_robot_file("nominal")
    named = replace(file.robot, configurations=Configurations({ALL: file.robot.configurations.members[0]}))
    joint = joints.joint_of_robot(replace(file, robot=named, source=f"{ALL.replace('/', '')}.toml"), ALL)
    numbers = {n: float(p.value) for n, p in joint.parameters().items()} | dict.fromkeys(joint.surroundings(), 0.7)
    return joint, [LawConstant(n, x, ALL, ALL, ALL) for n, x in numbers.items()]


def test_generated_source_has_names_as_words_and_runs_none(drive, monkeypatch):
    def boom():
        raise AssertionError("executed")

    monkeypatch.setattr(builtins, "boom", boom, raising=False)
    joint, known = drive
    jax_text = jax_source(joint, known, [ALL])
    for text in (jax_text, mjlab_files(joint, known, [ALL])["mjlab_actuator.py"]):
        tree = ast.parse(text)
        assert "boom" not in {n.id for n in ast.walk(tree) if isinstance(n, ast.Name)}
        assert not obeyed(text) and "boom" in ast.get_docstring(tree)
    module = module_from_source(jax_text)
    assert set(module.PARAMS) == {c.name for c in known} and any(ALL in n for n in module.PARAMS)


@pytest.mark.parametrize(
    "line",
    ["boom()", "X = boom()", "import os", "from os import system", "def f(p):\n    return p.__class__.mro()",
     "def f(p):\n    return __import__('os')", "class A: pass", "f = lambda: 1"],
)  # fmt: skip
def test_source_that_would_do_more_than_state_a_law_is_not_executed(drive, line):
    with pytest.raises(BadConfiguration, match="not executed"):
        module_from_source(f"{jax_source(*drive)}\n{line}\n")


def test_models_headers_and_pages_of_an_export_have_names_as_words(drive):
    joint = drive[0]
    law = translate_law(joint, 0.0)
    motor = mjcf_motor(joint, dict(zip(law.names, map(float, law.start), strict=True)))
    about = dict.fromkeys(("gear", "frictionloss", "damping", "armature"), ALL)
    fragment = mjcf_fragment(joint, motor, about, [ALL], f"{joint.name}_drive", "drive", 12.0)
    for text in (fragment, mjcf_scene(joint, 1.0, f"{joint.name}_drive", "drive", 12.0, 0.1)):
        assert "boom" not in {node.tag for node in ElementTree.fromstring(text).iter()}
        assert not obeyed(text)
    points = feed_forward.SteadyMap(
        np.arange(2.0), np.arange(2.0), dict.fromkeys(feed_forward.COLUMNS, np.zeros((2, 2)))
    )
    header = feed_forward.c_header(joint, points, [ALL])
    assert "boom" not in re.sub(r"/\*.*?\*/", "", header, flags=re.S).replace(joint.name, "")
    assert joint.name.isidentifier() and not obeyed(header)
    words = export_report.escape_markdown(ALL)
    assert not obeyed(words) and "<" not in words and "`" not in words and not re.search(r"(?<!\\)\||\n", words)


@pytest.mark.parametrize("name", NAMES)
def test_toml_and_json_keep_every_name(name):
    shown = name.encode("utf-8", "replace").decode()
    assert tomllib.loads(f"a = {toml_value({name: [name]})}")["a"] == {shown: [shown]}
    given = Simulate.model_construct(robot=shown)
    assert tomllib.loads(as_toml(given))["robot"] == shown
    text = json_text({name: name})
    assert json.loads(text) == {name: name} and not obeyed(text)


def test_robot_files_keep_names_of_columns(tmp_path):
    robot = find_robot_file("nominal").robot
    columns = tuple((f"column_{k}", n.encode("utf-8", "replace").decode(), 1.0) for k, n in enumerate(NAMES))
    rig = replace(robot.rig, columns=columns)
    write_robot(replace(robot, rig=rig), tmp_path / "robot.toml", note=ALL.replace("\ud800", ""))
    content = (tmp_path / "robot.toml").read_text("utf-8")
    assert list(tomllib.loads(content)["columns"].values()) == [theirs for _, theirs, _ in columns]


@pytest.mark.parametrize("name", NAMES)
def test_csv_has_no_formulas_and_its_reader_gives_the_words_back(name, tmp_path):
    table = Table("t", (Column(name), Column("b")), [(name, "x"), ("y", -1.5)])
    write_table(tmp_path / "t.csv", {"b": np.array([-1.5, 2.0]), name: np.array([name, "y"])})
    for text in ((tmp_path / "t.csv").read_text("utf-8"), table.csv):
        cells = [cell for row in csv.reader(text.splitlines()) for cell in row]
        assert not obeyed(text) and [c for c in cells if re.match(r"[=+@\t\r]|-(?!1\.5$)", c)] == []
    found = delimited.read_csv_columns(tmp_path / "t.csv", "t.csv")
    as_read = printable(name).replace("\n", " ").strip()
    if name != "\tboom":  # whose tab is the space around a cell
        assert (found.header[1], list(found.values[1])) == (as_read, [as_read, "y"])
    assert list(map(float, found.values[0])) == [-1.5, 2.0]


def test_cells_that_are_numbers_get_no_apostrophe():
    assert [cell_text(x) for x in ("-1", "+2e3", "-inf", -3.0, "a=b", "-x", "'-x")] == [
        "-1", "+2e3", "-inf", "-3", "a=b", "'-x", "''-x",
    ]  # fmt: skip


class Elements(html.parser.HTMLParser):
    """Tags and attributes of a page."""

    def __init__(self, text):
        super().__init__()
        self.found: list[tuple[str, ...]] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, *(name for name, _ in attrs)))


def test_pages_have_names_as_words(tmp_path):
    def elements(name):
        table = Table("t", (Column(name), Column("b", name, group=name)), [(name, name), ("y", -1.5)], title=name)
        document = Document(name, name, (Note(name),), (Section(name, (table, Note((name, name)))),))
        text = page_renderer.write_report_page(tmp_path, document).read_text("utf-8")
        assert not obeyed(text)
        return Elements(text).found

    plain = elements("plain")
    for name in (n for n in NAMES if "`" not in n):  # which our markup shows as code
        assert elements(name) == plain


def test_terminals_get_nothing_that_they_obey(capsys):
    table = RichTable(title="t")
    table.add_column(ALL)
    table.add_row(ALL)
    print_output(ALL)
    print_output(table)
    print_message(ALL)
    print_json({ALL: ALL})
    out, err = capsys.readouterr()
    assert "boom" in out and "boom" in err and not obeyed(out + err)
    for error in (BadConfiguration(ALL), BadData(ALL), UsageError(ALL)):
        assert not obeyed(str(error))


#: Name of a signal that sets a terminal's colour and title.
RED = "\x1b[31mred\x1b]0;pwn\x07\u202e"


def arrow(columns):
    schema = pa.schema([pa.field(n, pa.float64(), metadata={"unit": RED}) for n in columns])
    return pa.table(list(map(pa.array, columns.values())), schema=schema)


WRITERS = {
    "a.npz": samples.npz, "a.json": samples.json_records, "b.json": samples.json_arrays, "c.mat": samples.mat73,
    "a.csv": lambda path, columns: path.write_text(csv_text(columns)),
    "a.parquet": lambda path, columns: parquet.write_table(arrow(columns), path),
    "a.feather": lambda path, columns: feather.write_feather(arrow(columns), str(path)),
}  # fmt: skip


@pytest.mark.parametrize("file", WRITERS)
def test_names_in_files_of_every_format_reach_no_terminal(mmrjax, tmp_path, file):
    WRITERS[file](tmp_path / file, {RED if n == "amps" else n: v for n, v in samples.table().items()})
    for arguments in (("inspect", file), ("inspect", file, "--json"), ("rig", "check", f"{RED}.toml", file)):
        code, out, err = mmrjax(*arguments)
        assert code in (0, 2, 4) and not obeyed(out + err), (arguments, out, err)
        assert "red" in out + err
    content = (tmp_path / file).read_bytes()
    (tmp_path / file).write_bytes(content[: len(content) // 2].replace(b"0", b"\x1b[31m"))  # damaged
    code, out, err = mmrjax("inspect", file)
    assert code in (0, 4) and not obeyed(out + err)
