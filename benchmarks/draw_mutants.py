"""Draws mutants at random by the operators of mutation tools, over all rooms, for tests/mutants.toml.

Each is one change of one line: an operator (arithmetic, comparison or logical), a number, a sign, a truth value or a
condition. Pairs of functions are swapped too (minimum and maximum, sin and cos, any and all). Text, annotations and
imports are not changed. The same seed draws the same mutants from the same sources.

    python benchmarks/draw_mutants.py --number 100 --seed 1        # TOML without `killed_by` on stdout
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import json
import random
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

BINARY = {ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*", ast.FloorDiv: "*", ast.Mod: "*", ast.Pow: "*"}
COMPARED = {
    ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">", ast.Eq: "!=", ast.NotEq: "==",
    ast.Is: "is not", ast.IsNot: "is", ast.In: "not in", ast.NotIn: "in",
}  # fmt: skip
PAIRS = {"minimum": "maximum", "min": "max", "sin": "cos", "any": "all", "argmin": "argmax", "floor": "ceil"}
OTHER = PAIRS | {b: a for a, b in PAIRS.items()}


@dataclasses.dataclass(frozen=True)
class Draw:
    """One change in a file: characters `begin` to `end` of its text are replaced by `by`."""

    file: str
    line: int
    operator: str
    begin: int
    end: int
    by: str


class Change(NamedTuple):
    """A change as tests/mutants.toml states it: the function's qualified name, its text and the replacement."""

    function: str
    text: str
    by: str


class _Finder(ast.NodeVisitor):
    """Collects the places of a module that an operator applies to, except text, annotations and imports."""

    def __init__(self, file: str, source: str) -> None:
        self.file, self.source = file, source
        lines = source.splitlines(keepends=True)
        self.starts = [0]
        for line in lines:
            self.starts.append(self.starts[-1] + len(line))
        self.encoded = [line.encode() for line in lines]
        self.found: list[Draw] = []

    def at(self, line: int, column: int) -> int:
        """Character offset of a line (from 1) and a column in bytes."""
        return self.starts[line - 1] + len(self.encoded[line - 1][:column].decode())

    def span(self, node: ast.expr) -> tuple[int, int]:
        assert node.end_lineno is not None and node.end_col_offset is not None
        return self.at(node.lineno, node.col_offset), self.at(node.end_lineno, node.end_col_offset)

    def add(self, operator: str, line: int, begin: int, end: int, by: str) -> None:
        self.found.append(Draw(self.file, line, operator, begin, end, by))

    def between(self, left: ast.expr, right: ast.expr, sign: str, by: str, operator: str) -> None:
        """Replaces the operator's sign in the text between its operands."""
        begin, end = self.span(left)[1], self.span(right)[0]
        text = self.source[begin:end]
        if text.count(sign) == 1 and "\n" not in text and "#" not in text:
            place = begin + text.index(sign)
            self.add(operator, left.end_lineno or left.lineno, place, place + len(sign), by)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        signs = {
            ast.Add: "+",
            ast.Sub: "-",
            ast.Mult: "*",
            ast.Div: "/",
            ast.FloorDiv: "//",
            ast.Mod: "%",
            ast.Pow: "**",
        }
        strings = any(isinstance(n, ast.Constant) and isinstance(n.value, str) for n in (node.left, node.right))
        if type(node.op) in BINARY and not strings:
            self.between(node.left, node.right, signs[type(node.op)], BINARY[type(node.op)], "arithmetic")
        self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> None:
        words = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=",
                 ast.Is: "is", ast.IsNot: "is not", ast.In: "in", ast.NotIn: "not in"}  # fmt: skip
        kind = type(node.ops[0])
        if len(node.ops) == 1:
            self.between(node.left, node.comparators[0], words[kind], COMPARED[kind], "comparison")
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        sign, by = ("and", "or") if isinstance(node.op, ast.And) else ("or", "and")
        self.between(node.values[0], node.values[1], sign, by, "logic")
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        begin, inner = self.span(node)[0], self.span(node.operand)[0]
        if isinstance(node.op, (ast.USub, ast.Not)) and "\n" not in self.source[begin:inner]:
            self.add("sign" if isinstance(node.op, ast.USub) else "logic", node.lineno, begin, inner, "")
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        begin, end = self.span(node)
        if isinstance(node.value, bool):
            self.add("truth", node.lineno, begin, end, str(not node.value))
        elif isinstance(node.value, int):
            self.add("number", node.lineno, begin, end, str(node.value + 1))
        elif isinstance(node.value, float):
            self.add("number", node.lineno, begin, end, repr(2.0 * node.value if node.value else 1.0))

    def visit_If(self, node: ast.If) -> None:
        begin, end = self.span(node.test)
        if "\n" not in self.source[begin:end] and "TYPE_CHECKING" not in self.source[begin:end]:
            self.add("condition", node.lineno, begin, end, f"not ({self.source[begin:end]})")
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        function = node.func
        name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
        if name in OTHER:
            end = self.span(function)[1]
            self.add("function", function.end_lineno or node.lineno, end - len(name), end, OTHER[name])
        self.generic_visit(node)

    def visit_Raise(self, node: ast.Raise) -> None:
        pass  # text of a message

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        pass

    def visit_Subscript(self, node: ast.Subscript) -> None:
        if not isinstance(node.value, ast.Name) or not node.value.id[:1].isupper():  # not a type
            self.generic_visit(node)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        for default in [*node.args.defaults, *(d for d in node.args.kw_defaults if d is not None)]:
            self.visit(default)
        for statement in node.body:
            self.visit(statement)


def places(file: Path) -> list[Draw]:
    """All places of a file that an operator applies to."""
    source = file.read_text(encoding="utf-8")
    finder = _Finder(file.relative_to(ROOT).as_posix(), source)
    finder.visit(ast.parse(source))
    return finder.found


def context(source: str, draw: Draw) -> Change:
    """The innermost function of a change, and the fewest words and signs around it that occur once there."""
    around = [(b - a, n) for n, (a, b) in mutants.functions(source).items() if a <= draw.begin and draw.end <= b]
    function = min(around)[1]
    whole = mutants.functions(source)[function]
    tokens = [m.span() for m in mutants.TOKEN.finditer(source)]
    first = sum(end <= draw.begin for _, end in tokens)
    last = max(first, sum(begin < draw.end for begin, _ in tokens) - 1)
    for more in range(len(tokens)):
        begin, end = tokens[max(first - more // 2, 0)][0], tokens[min(last + (more + 1) // 2, len(tokens) - 1)][1]
        text = source[begin:end]
        if len(mutants.pattern(text).findall(source, *whole)) == 1:
            break
    return Change(function, text, source[begin : draw.begin] + draw.by + source[draw.end : end])


def drawn(number: int, seed: int) -> Iterator[tuple[Draw, Change]]:
    """Mutants drawn at random: a file, weighted by the square root of its size, then a place."""
    rng = random.Random(seed)
    files = sorted(file for package in PACKAGES for file in (ROOT / package).rglob("*.py"))
    found = {file: places(file) for file in files}
    files = [file for file in files if found[file]]
    weights = [len(found[file]) ** 0.5 for file in files]
    taken: Counter[Path] = Counter()
    count = 0
    while count < number:
        (file,) = rng.choices(files, weights)
        if taken[file] >= OF_A_FILE or not found[file]:
            continue
        draw = found[file].pop(rng.randrange(len(found[file])))
        source = file.read_text(encoding="utf-8")
        try:
            changed = ast.parse(source[: draw.begin] + draw.by + source[draw.end :])
        except SyntaxError:
            continue
        if ast.dump(changed) == ast.dump(ast.parse(source)):
            continue
        taken[file] += 1
        count += 1
        yield draw, context(source, draw)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--number", type=int, default=100, metavar="N", help="mutants (default 100)")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of the draw (default 1)")
    options = parser.parse_args()
    if options.number < 1:
        parser.error(f"--number: got {options.number}; expected at least 1")
    names: Counter[str] = Counter()
    for draw, change in drawn(options.number, options.seed):
        name = f"{Path(draw.file).with_suffix('').as_posix().replace('/', '_')}_{draw.operator}_{draw.line}"
        names[name] += 1
        name += f"_{names[name]}" if names[name] > 1 else ""
        fields = {"kind": "drawn", "file": draw.file, **change._asdict()}
        print(
            f"[{name}]",
            *(f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in fields.items()),
            "",
            sep="\n",
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
