"""No package becomes heavier than `tests/weight.toml` allows, and the counter counts as by hand."""

import pytest
import weight

SOURCES = {
    "mmrjax/__init__.py": '"""Not counted."""\nfrom mmrjax import a\n',
    "mmrjax/a.py": "def f(x):\n    '''Not counted.'''\n    return g(x)\ndef g(x):\n    import mmrjax.b\n    return 'two words'\n",
    "mmrjax/b.py": "import mmrjax\n@dataclass\nclass B:\n    def f(self): return g(1)\n",
    "sweeps/page.j2": "<p>Three more words {{ value }}</p>",
}  # fmt: skip


def test_no_package_is_heavier_than_its_ceiling():
    assert weight.compare(weight.weigh(weight.texts_of(weight.ROOT)), weight.read_ceilings()) == []


def test_weight_is_that_counted_by_hand():
    counted = weight.weigh(SOURCES)
    # __init__: module, pass, import, alias. a: module; twice function, arguments, argument, return; pass, call, two names
    # with contexts; import, alias, constant. b: module, import, alias; class, name, context; function, arguments,
    # argument, return, call, name, context, constant.
    nodes = 4 + (1 + 2 * 4 + 6 + 3) + 14
    assert counted["mmrjax"] == {"nodes": nodes, "functions": 3, "records": 1, "modules": 3, "once": 0, "words": 2}
    assert counted["sweeps"]["words"] == 3 and counted["circle"] == {"modules": 3}
    assert weight.weigh({"mmrjax/a.py": "def f(): pass\nf()"})["mmrjax"]["once"] == 1


def test_a_heavier_package_and_a_ceiling_left_high_are_told(tmp_path):
    was = {"mmrjax": {"nodes": 1000, "functions": 10}}
    assert weight.compare(was, was) == weight.compare({"mmrjax": {"nodes": 995, "functions": 10}}, was) == []
    (heavier,) = weight.compare({"mmrjax": {"nodes": 1001, "functions": 10}}, was)
    (lighter,) = weight.compare({"mmrjax": {"nodes": 980, "functions": 10}}, was)
    assert "1001, at most 1000" in heavier and "lower it" in lighter
    path = tmp_path / "weight.toml"
    path.write_text("# Ceilings.\n[mmrjax]\nnodes = 1000\nfunctions = 10\n")
    with pytest.raises(SystemExit, match="mmrjax, functions: would rise"):
        weight.write_ceilings({"mmrjax": {"nodes": 900, "functions": 11}}, path)
    weight.write_ceilings({"mmrjax": {"nodes": 900, "functions": 11}}, path, "a new law")
    assert weight.read_ceilings(path) == {"mmrjax": {"nodes": 900, "functions": 11}}
    assert "# Ceilings.\n# mmrjax, functions: a new law\n" in path.read_text()
