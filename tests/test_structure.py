"""How the code hangs together, read from the code with `ast`; shown to be able to fail."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LAYERS = ("mmrjax", "calibration", "sweeps")  # each may import those before it
FORBIDDEN_ROOMS = {"utils", "util", "helpers", "helper", "common", "misc"}
HEAVY = {"jax", "jaxlib", "equinox", "optimistix", "lineax", "diffrax", "matplotlib", "scipy"}
#: Modules that `mmrjax --help` loads: what they import at the top is paid for by every command.
FRONT_DOOR = ("sweeps/__init__.py", "sweeps/cli.py")


def imports(tree: ast.AST, package: str) -> list[tuple[str, int]]:
    """Names of imported modules with their lines, anywhere in a module of `package`."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [(alias.name, node.lineno) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                parts = package.split(".")
                base = ".".join(parts[: len(parts) - node.level + 1])
                found.append((f"{base}.{node.module}" if node.module else base, node.lineno))
            else:
                found.append((node.module or "", node.lineno))
        elif (
            isinstance(node, ast.Call)
            and ast.unparse(node.func) in ("importlib.import_module", "import_module", "__import__")
            and node.args
            and isinstance(node.args[0], ast.Constant)
        ):
            found.append((str(node.args[0].value), node.lineno))
    return found


def violations(root: Path) -> list[str]:
    """Every breach of the rules below `root`, as `path:line: what`."""
    found = []
    for rank, layer in enumerate(LAYERS):
        for path in sorted((root / layer).rglob("*.py")):
            relative = path.relative_to(root)
            tree = ast.parse(path.read_text(encoding="utf-8"))
            package = ".".join(relative.parent.parts)
            for part in (*relative.parent.parts, path.stem):
                if part in FORBIDDEN_ROOMS:
                    found.append(f"{relative}:1: a room named {part}")
            for name, line in imports(tree, package):
                if name.partition(".")[0] in LAYERS[rank + 1 :]:
                    found.append(f"{relative}:{line}: {layer} imports {name}")
            for node in ast.walk(tree):
                if not isinstance(node, ast.Call):
                    continue
                if (
                    isinstance(node.func, ast.Attribute)
                    and node.func.attr == "term"
                    and relative.parts
                    != (
                        "mmrjax",
                        "balances.py",
                    )
                ):
                    found.append(f"{relative}:{node.lineno}: sums an effect's term outside balances")
                if layer == "mmrjax" and isinstance(node.func, ast.Name) and node.func.id in ("open", "print"):
                    found.append(f"{relative}:{node.lineno}: {node.func.id} in the physics")
            if relative.as_posix() in FRONT_DOOR:
                top = ast.Module([n for n in tree.body if not isinstance(n, ast.FunctionDef)], [])
                for name, line in imports(top, package):
                    if name.partition(".")[0] in HEAVY:
                        found.append(f"{relative}:{line}: the front door loads {name}")
    return found


def test_structure_holds():
    assert violations(ROOT) == []


BAD = {
    "mmrjax imports calibration": ("mmrjax/bad.py", "from calibration import fit"),
    "mmrjax imports sweeps.run": ("mmrjax/models/bad.py", "def f():\n    import sweeps.run"),
    "calibration imports sweeps": ("calibration/bad.py", "from sweeps import grid"),
    "mmrjax imports sweeps.grid": ("mmrjax/bad.py", "import importlib\nimportlib.import_module('sweeps.grid')"),
    "sums an effect's term": ("mmrjax/models/bad.py", "def f(e, r, s):\n    return e.term(r, s)"),
    "a room named utils": ("sweeps/utils.py", ""),
    "a room named common": ("mmrjax/common/__init__.py", ""),
    "front door loads jax": ("sweeps/cli.py", "import jax"),
    "front door loads equinox": (
        "sweeps/__init__.py",
        "try:\n    from equinox import Module\nexcept ImportError: pass",
    ),
    "print in the physics": ("mmrjax/bad.py", "print(1)"),
}


@pytest.mark.parametrize("what", sorted(BAD))
def test_structure_rule_can_fail(what, tmp_path):
    path, source = BAD[what]
    for clean in ("mmrjax/balances.py", "calibration/__init__.py", "sweeps/__init__.py"):
        (tmp_path / clean).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / clean).write_text("def f(e, r, s):\n    return e.term(r, s)\n" if "balances" in clean else "")
    assert violations(tmp_path) == []
    (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / path).write_text(source)
    found = violations(tmp_path)
    assert len(found) == 1 and what in found[0], found


def test_front_door_loads_nothing_heavy():
    if not (ROOT / "sweeps" / "cli.py").exists():
        pytest.skip("no command line yet")
    code = "import sys, sweeps.cli; print(sorted({m.partition('.')[0] for m in sys.modules} & set(sys.argv[1:])))"
    heavy = sorted(HEAVY)
    answer = subprocess.run(
        [sys.executable, "-c", code, *heavy], cwd=ROOT, capture_output=True, text=True, check=True, timeout=60
    )
    assert answer.stdout.strip() == "[]"


def test_reference_implementation_imports_nothing_of_ours():
    tree = ast.parse((ROOT / "tests" / "reference.py").read_text(encoding="utf-8"))
    assert not {name.partition(".")[0] for name, _ in imports(tree, "tests")} & {*LAYERS, "jax"}
