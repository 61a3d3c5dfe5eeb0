"""Prose of docs, help, templates and strings, and names of locals, stay below their ceilings."""

import ast

import prose


def test_no_figure_of_prose_is_above_its_ceiling():
    above = {name: figure for name, figure in prose.figures().items() if figure > prose.CEILINGS[name]}
    assert above == {}, "python benchmarks/prose.py --most 20 lists the sentences"


def test_prose_is_counted_as_by_hand(tmp_path):
    plain, clause = "The loop prints the answer and the next step.", "What the loop prints as the answer of it."
    long = " ".join(["word"] * (prose.LONG + 1)) + "."
    assert [prose.is_flagged(s) for s in prose.sentences(f"{plain} {clause} {long}")] == [False, True, True]
    assert len(prose.sentences(f"{plain[:-1]}; {clause}")) == 1  # a semicolon ends no sentence
    nodes = [*ast.walk(ast.parse("found = 1\nroot = found\nf(at=root)\nother = 2\nat, last = 3, 4"))]
    assert prose.empty_names([nodes]) == 40.0
    for name in prose.PACKAGES:
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.py").write_text(f'"""{clause} {plain[:-1]}; {plain}"""\n')
    (tmp_path / "docs").mkdir(), (tmp_path / "README.md").write_text(f"{plain}\n\n```sh\n{clause}\n```\n")
    (tmp_path / "sweeps" / "config.py").write_text(f"x = option_field(1, {clause!r})\n")
    pages = tmp_path / "sweeps" / "pages" / "templates"
    pages.mkdir(parents=True), (pages / "a.j2").write_text(f"<p>{plain}</p><p>{{{{ long }}}}</p>")
    (pages / "catalogue.toml").write_text(f'[a.b]\ntext = "{clause} {{}}"\n')
    counted = prose.figures(tmp_path)
    assert counted["docs"] == 0 and counted["help"] == 100 and counted["templates"] == 50
    assert counted["semicolons"] == 1000 / len(f"{clause} {plain} {plain}".split()) and counted["mmrjax"] == 0
