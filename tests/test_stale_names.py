"""Names that tests and benchmarks take from the project exist: what only runs by `make slow`, or never in CI, is read here."""

import ast
import importlib
import types

from tests.commands import ROOT

#: With benchmarks that are imported. The others read their command line as they start.
OWN = ("mmrjax", "calibration", "sweeps", "worlds", "campaign", "loop", "loop_findings", "loop_scores", "measure")
OWN += ("rig_logs", "rigs")
FILES = [p for folder in ("tests", "tests/worlds", "benchmarks") for p in sorted((ROOT / folder).glob("*.py"))]


def is_own(module):
    return module.partition(".")[0] in OWN


def stale(tree):
    """Attributes of the project's modules that are missing. An import of a name that is missing fails."""
    modules, bound = {}, {a.arg for a in ast.walk(tree) if isinstance(a, ast.arg)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            bound.add(node.id)
        elif isinstance(node, ast.Import):
            modules |= {a.asname or a.name: importlib.import_module(a.name) for a in node.names if is_own(a.name)}
        elif isinstance(node, ast.ImportFrom) and is_own(node.module or ""):
            source = __import__(node.module, fromlist=[alias.name for alias in node.names])
            names = {alias.asname or alias.name: getattr(source, alias.name) for alias in node.names}
            modules |= {name: x for name, x in names.items() if isinstance(x, types.ModuleType)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            name = node.value.id
            if name in modules and name not in bound and not hasattr(modules[name], node.attr):
                yield f"{modules[name].__name__}.{node.attr}"


def test_names_taken_from_the_project_exist():
    missing = [(path.name, name) for path in FILES for name in stale(ast.parse(path.read_text(encoding="utf-8")))]
    assert missing == [("test_public_api.py", "mmrjax.simulat")]  # which has to be missing
