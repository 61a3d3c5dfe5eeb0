"""Weight of the source by package: what a reader has to understand, independent of layout and line length.

    python benchmarks/weight.py                             # figures, and ceilings of tests/weight.toml
    python benchmarks/weight.py --write                     # lower the ceilings to the figures
    python benchmarks/weight.py --write --reason "..."      # raise those that are exceeded, too

nodes: of the syntax trees without docstrings. Functions: with methods. Records: dataclasses, named tuples,
enumerations and modules of equinox. Modules: files. Once: functions of a module that the source names in one place.
Words: of English in string constants and templates. The circle is the largest set of modules that import each other,
imports in functions included.
"""

from __future__ import annotations

import argparse
import ast
import re
import tomllib
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

ROOT = Path(__file__).parents[1]
CEILINGS = ROOT / "tests" / "weight.toml"
PACKAGES = ("mmrjax", "calibration", "sweeps", "tests")
FIGURES = ("nodes", "functions", "records", "modules", "once", "words")
#: Share of a ceiling by which a figure may be below it before the ceiling has to follow.
SLACK = 0.01
_RECORDS = {"Module", "NamedTuple", "Enum", "IntEnum", "StrEnum", "BaseModel", "TypedDict", "Protocol", "dataclass"}
_WORD = re.compile(r"(?<![\w.])[A-Za-z][a-z]+(?![\w(])")
_MARKUP = re.compile(r"{[{%#].*?[}%#]}|<[^>]*>", re.DOTALL)

#: Package → figure → number; the circle has a package of its own.
Weight = dict[str, dict[str, int]]


def texts_of(root: Path) -> dict[str, str]:
    """Text of every source file and template of the packages, by path."""
    files = (f for p in PACKAGES for f in sorted((root / p).rglob("*")) if f.suffix in (".py", ".j2", ".html"))
    return {f.relative_to(root).as_posix(): f.read_text("utf-8") for f in files if "__pycache__" not in f.parts}


def weigh(texts: Mapping[str, str]) -> Weight:
    """Weight of source files and templates, given by path."""
    weight: Weight = {path.partition("/")[0]: dict.fromkeys(FIGURES, 0) for path in texts}
    trees = {path: _nodes(text) for path, text in texts.items() if path.endswith(".py")}
    names: Counter[str] = Counter()
    for path, text in texts.items():
        figures = weight[path.partition("/")[0]]
        if path not in trees:
            figures["words"] += _words(_MARKUP.sub(" ", text))
            continue
        figures["modules"] += 1
        for node in trees[path]:
            figures["nodes"] += 1
            figures["functions"] += isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
            figures["records"] += isinstance(node, ast.ClassDef) and _is_record(node)
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                figures["words"] += _words(node.value)
            elif isinstance(node, ast.Name | ast.Attribute):
                names[_name(node)] += 1
    for path, (tree, *_) in trees.items():
        top = ast.iter_child_nodes(tree)
        plain = [n.name for n in top if isinstance(n, ast.FunctionDef) and not n.decorator_list]
        weight[path.partition("/")[0]]["once"] += sum(names[name] == 1 for name in plain)
    return weight | {"circle": {"modules": largest_circle(trees)}}


def largest_circle(trees: Mapping[str, Iterable[ast.AST]]) -> int:
    """Size of the largest set of modules that import each other, tests left out."""
    paths = [path for path in trees if not path.startswith("tests/")]
    number = {_module(path): k for k, path in enumerate(paths)}
    pairs = [(k, number[n]) for k, path in enumerate(paths) for n in _imported(trees[path], path) if n in number]
    edges = np.array(pairs, int).reshape(-1, 2).T
    graph = csr_array((np.ones(len(pairs)), (edges[0], edges[1])), shape=(len(paths), len(paths)))
    _, circles = connected_components(graph, connection="strong")
    return int(np.bincount(circles).max())


def compare(weight: Weight, ceilings: Weight) -> list[str]:
    """Sentences on figures above their ceilings, and on ceilings that are too high for theirs."""
    found = []
    for package, figures in weight.items():
        for figure, value in figures.items():
            ceiling = ceilings[package][figure]
            if value > ceiling:
                found.append(f"{package}, {figure}: {value}, at most {ceiling}; make the change lighter")
            elif value < (1 - SLACK) * ceiling:
                found.append(
                    f"{package}, {figure}: {value}, {ceiling} allowed; lower it: python benchmarks/weight.py --write"
                )
    return found


def read_ceilings(path: Path = CEILINGS) -> Weight:
    """The ceilings of a file."""
    return tomllib.loads(path.read_text("utf-8"))


def write_ceilings(weight: Weight, path: Path = CEILINGS, reason: str = "") -> None:
    """Writes figures as ceilings, with the reason for raised ones among the comments.

    Raises:
        SystemExit: a ceiling would rise without a reason.
    """
    text = path.read_text("utf-8")
    old = tomllib.loads(text)
    raised = [f"{p}, {f}" for p, figures in weight.items() for f, x in figures.items() if x > old[p][f]]
    if raised and not reason:
        raise SystemExit(f"{'; '.join(raised)}: would rise; state why with --reason")
    comments = [line for line in text.splitlines() if line.startswith("#")]
    lines = [*comments, *([f"# {'; '.join(raised)}: {reason}"] if raised else [])]
    for package, figures in weight.items():
        lines += ["", f"[{package}]", *(f"{figure} = {value}" for figure, value in figures.items())]
    path.write_text("\n".join(lines) + "\n", "utf-8")


def _nodes(text: str) -> list[ast.AST]:
    """Nodes of a module, first the module itself, without docstrings."""
    nodes: list[ast.AST] = [ast.parse(text)]
    for node in nodes:  # which become more
        body = getattr(node, "body", None)
        if isinstance(body, list) and body and isinstance(body[0], ast.Expr):
            text_node = body[0].value
            if isinstance(text_node, ast.Constant) and isinstance(text_node.value, str):
                body[0] = ast.Pass()
        nodes += ast.iter_child_nodes(node)
    return nodes


def _is_record(node: ast.ClassDef) -> bool:
    parts = (n for base in (*node.bases, *node.decorator_list) for n in ast.walk(base))
    return not _RECORDS.isdisjoint(_name(n) for n in parts if isinstance(n, ast.Name | ast.Attribute))


def _name(node: ast.Name | ast.Attribute) -> str:
    return node.id if isinstance(node, ast.Name) else node.attr


def _words(text: str) -> int:
    return len(_WORD.findall(text)) if " " in text.strip() else 0


def _module(path: str) -> str:
    return path.removesuffix(".py").replace("/", ".").removesuffix(".__init__")


def _imported(nodes: Iterable[ast.AST], path: str) -> Iterable[str]:
    """Names of modules that a file may import, other than itself."""
    found: set[str] = set()
    for node in nodes:
        if isinstance(node, ast.ImportFrom):
            above = path.removesuffix(".py").split("/")[: -node.level] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            found |= {base, *(f"{base}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found - {_module(path)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="write the figures as ceilings")
    parser.add_argument("--reason", default="", help="why ceilings are raised")
    options = parser.parse_args()
    weight = weigh(texts_of(ROOT))
    if options.write:
        write_ceilings(weight, reason=options.reason)
    ceilings = read_ceilings()
    for package, figures in weight.items():
        print(package, *(f"{figure} {value} of {ceilings[package][figure]}" for figure, value in figures.items()))


if __name__ == "__main__":
    main()
