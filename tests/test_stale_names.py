"""Names that tests and benchmarks take from the project exist: what only runs by `make slow`, or never in CI, is read here."""

import ast
import importlib
import types

from tests.commands import ROOT

#: Benchmarks that are imported, by tests or one another; the others read their command line as they start.
IMPORTED = ("campaign", "loop", "loop_findings", "loop_scores", "measure", "rig_logs", "rigs")
OWN = ("mmrjax", "calibration", "sweeps", "worlds", *IMPORTED)
FILES = [p for folder in ("tests", "tests/worlds", "benchmarks") for p in sorted((ROOT / folder).glob("*.py"))]


def stale(tree):
    """Line and name of what is asked of one of the project's modules, and is not there."""
    modules = {}
    bound = {n.id for n in ast.walk(tree) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
    bound |= {a.arg for a in ast.walk(tree) if isinstance(a, ast.arg)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.partition(".")[0] in OWN:
                    module = importlib.import_module(alias.name)
                    modules[alias.asname or alias.name] = module
        elif isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] in OWN:
            module = importlib.import_module(node.module or "")
            for alias in node.names:
                if not hasattr(module, alias.name):
                    try:
                        importlib.import_module(f"{node.module}.{alias.name}")
                    except ModuleNotFoundError:
                        yield node.lineno, f"{node.module}.{alias.name}"
                        continue
                if isinstance(found := getattr(module, alias.name), types.ModuleType):
                    modules[alias.asname or alias.name] = found
    # What a test asks for because it is not there.
    missed = {
        n
        for w in ast.walk(tree)
        if isinstance(w, ast.With) and "AttributeError" in ast.unparse(w.items[0])
        for n in ast.walk(w)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node not in missed:
            name = node.value.id
            if name in modules and name not in bound and not hasattr(modules[name], node.attr):
                yield node.lineno, f"{modules[name].__name__}.{node.attr}"


def test_names_taken_from_the_project_exist():
    found = {str(path.relative_to(ROOT)): list(stale(ast.parse(path.read_text()))) for path in FILES}
    assert {name: stale for name, stale in found.items() if stale} == {}


def test_a_name_that_is_gone_is_seen():
    text = "import loop\nfrom calibration.data import runs, no_such_room\nfrom mmrjax.model import paper_robots as r\nloop.one(1)\nr.gone, runs.read_runs, r.nominal\n"
    assert [x for _, x in stale(ast.parse(text))] == [
        "calibration.data.no_such_room",
        "loop.one",
        "mmrjax.model.paper_robots.gone",
    ]
