"""Draws mutants at random by the operators of mutation tools, over all rooms, for tests/mutants.toml.

Each is one change of one node: an operator (arithmetic, comparison or logical), a number, a sign, a truth value or a
condition. Pairs of functions are swapped too (minimum and maximum, sin and cos, any and all). Text, annotations and
imports are not changed. The same seed draws the same mutants from the same sources.

    python benchmarks/draw_mutants.py --number 100 --seed 1        # TOML without `killed_by` on stdout
"""

from __future__ import annotations

import argparse
import ast
import json
import random
import re
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import mutants

ROOT = Path(__file__).parents[1]
PACKAGES = ("mmrjax", "calibration", "sweeps")
#: Most mutants of one file.
OF_A_FILE = 2

#: Replacements by the kind of the node.
ARITHMETIC = {"Add": "-", "Sub": "+", "Mult": "/", "Div": "*", "FloorDiv": "*", "Mod": "*", "Pow": "*"}
COMPARED = {"Lt": "<=", "LtE": "<", "Gt": ">=", "GtE": ">", "Eq": "!=", "NotEq": "==", "Is": "is not", "IsNot": "is",
            "In": "not in", "NotIn": "in"}  # fmt: skip
LOGIC = {
    "And": "_.values[0] or _.values[1]",
    "Or": "_.values[0] and _.values[1]",
    "Not": "_.operand",
    "USub": "_.operand",
}
PAIRS = {"minimum": "maximum", "min": "max", "sin": "cos", "any": "all", "argmin": "argmax", "floor": "ceil"}
OTHER = PAIRS | {b: a for a, b in PAIRS.items()}


class Draw(NamedTuple):
    """One change of a file, as tests/mutants.toml states it, and its line."""

    file: str
    function: str
    node: str
    by: str
    line: int


def replacement(node: ast.AST, kind: str) -> tuple[str, str]:
    """Path to the part of a node that an operator applies to, and its replacement. Empty if none does."""
    match node:
        case ast.BinOp() if not any(isinstance(getattr(n, "value", 0), str) for n in (node.left, node.right)):
            return "", f"_.left {ARITHMETIC[kind]} _.right" if kind in ARITHMETIC else ""
        case ast.Compare(comparators=[_]):
            return "", f"_.left {COMPARED[kind]} _.comparators[0]"
        case ast.BoolOp():
            return "", LOGIC[kind]
        case ast.UnaryOp(op=ast.Not() | ast.USub()):
            return "", "_.operand"
        case ast.Constant(value=bool(value)):
            return "", str(not value)
        case ast.Constant(value=int(value) | float(value)):
            return "", repr(value + 1 if isinstance(value, int) else 2.0 * value or 1.0)
        case ast.If():
            return " .test", "not _"
        case ast.Call(func=ast.Name(id=name)) if name in OTHER:
            return " .func", OTHER[name]
        case ast.Call(func=ast.Attribute(attr=name)) if name in OTHER:
            return " .func", f"(_.value).{OTHER[name]}"
    return "", ""


def computed(node: ast.AST) -> Iterator[ast.AST]:
    """A node and those below it, except messages, types and annotations."""
    match node:
        case ast.Raise() | ast.JoinedStr() | ast.arg() | ast.If(test=ast.Name(id="TYPE_CHECKING")):
            return
        case ast.Subscript(value=ast.Name(id=name)) if name[:1].isupper():
            return
    yield node
    for field, value in ast.iter_fields(node):
        if field not in ("annotation", "returns"):
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    yield from computed(child)


def stated(file: Path, module: ast.Module, node: ast.AST) -> Draw:
    """Change of a node that an operator applies to, in its innermost function or class."""
    scopes = {n: d for n, d in mutants.definitions(module).items() if isinstance(d, ast.FunctionDef | ast.ClassDef)}
    around = [name for name, scope in scopes.items() if node in ast.walk(scope)]
    function = max(around, key=lambda name: name.count("."), default="")
    kind = mutants.kind_of(node)
    of_kind = [n for n in mutants.reading_order(scopes.get(function, module)) if mutants.kind_of(n) == kind]
    rank = f" {of_kind.index(node) + 1}/{len(of_kind)}" if len(of_kind) > 1 else ""
    path, by = replacement(node, kind)
    return Draw(file.relative_to(ROOT).as_posix(), function, kind + rank + path, by, node.lineno)  # type: ignore[attr-defined]


def drawn(number: int, seed: int) -> Iterator[Draw]:
    """Mutants drawn at random: a file, weighted by the square root of its size, then a place."""
    rng = random.Random(seed)
    files = sorted(file for package in PACKAGES for file in (ROOT / package).rglob("*.py"))
    modules = {file: ast.parse(file.read_text(encoding="utf-8")) for file in files}
    nodes = {f: [n for n in computed(m) if replacement(n, mutants.kind_of(n))[1]] for f, m in modules.items()}
    files = [file for file in files if nodes[file]]
    weights = [len(nodes[file]) ** 0.5 for file in files]
    taken: Counter[Path] = Counter()
    while sum(taken.values()) < number:
        (file,) = rng.choices(files, weights)
        if taken[file] < OF_A_FILE and nodes[file]:
            taken[file] += 1
            yield stated(file, modules[file], nodes[file].pop(rng.randrange(len(nodes[file]))))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--number", type=int, default=100, metavar="N", help="mutants (default 100)")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of the draw (default 1)")
    options = parser.parse_args()
    if options.number < 1:
        parser.error(f"--number: got {options.number}; expected at least 1")
    for draw in drawn(options.number, options.seed):
        name = re.sub(r"\W+", "_", f"{draw.file[:-3]}_{draw.node}_{draw.line}")
        fields = {"kind": "drawn", **draw._asdict()}
        del fields["line"]
        print(f"[{name}]", *(f"{key} = {json.dumps(fields[key])}" for key in fields), "", sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
