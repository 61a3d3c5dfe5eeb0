"""Prose and names that a reader would stumble over: docs, strings of the source, templates, help, locals.

    python benchmarks/prose.py              # figures, and ceilings
    python benchmarks/prose.py --most 20    # with the longest sentences that are flagged

Sentences with a habit of `HABITS` or more than `LONG` words [%]. A semicolon does not end a sentence. Semicolons in
docstrings, and in templates and program strings outside errors [per 1000 words]. Assignments to a local that is named
after how it was come by [%].
"""

from __future__ import annotations

import argparse
import ast
import re
import tomllib
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
PACKAGES = ("mmrjax", "calibration", "sweeps")
LONG = 32
HABITS = re.compile(
    r"^(What|Whether|How|Where|Those|Which) (?!is the|to )|\b(of|by|from|at|on|over|beside) which\b|\bbeside\b"
    r"|\b(is|are|was|were) (said|told|asked)\b|\b(one|those) that\b|\b(says nothing|is none|are none|nothing of)\b"
    r"|\b(alike|by itself|hardly|now and then)\b"
)
#: Locals that say how a value was come by, and not what it is.
EMPTY_NAMES = frozenset([
    "found", "at", "own", "shown", "known", "said",
    "each", "every", "stated", "held", "moved", "left", "kept", "given",
    "which", "what", "by", "where", "over", "whole", "mine", "theirs", "here", "chosen", "lost", "turned", "ended",
    "begun", "wanted", "taken", "asked", "named", "listed", "used", "seen",
])  # fmt: skip
ERRORS = re.compile(r"(Bad\w+|\w*Error)$")
#: A syntax tree as the list of its nodes.
Nodes = list[ast.AST]
SEMICOLON = re.compile(r";(?=\s)")
#: Largest figures. They only fall.
CEILINGS = {
    "docs": 1.2, "help": 1.8, "templates": 1.9, "strings": 1.0, "semicolons": 0.5, "chains": 6.8,
    **dict.fromkeys(PACKAGES, 1.0),
}  # fmt: skip


def sentences(text: str) -> list[str]:
    """Sentences of at least six words, without code and markup."""
    text = re.sub(r"`[^`]*`|{[{%#].*?[}%#]}|<[^>]*>|{[^}]*}", "X", text)
    parts = re.split(r"(?<=[.!?])\s+|\n\s*\n|\n\s*[-*|#]", text)
    return [" ".join(part.split()) for part in parts if len(part.split()) > 5]


def is_flagged(sentence: str) -> bool:
    """True for a long sentence and for one with a habit."""
    return len(sentence.split()) > LONG or HABITS.search(sentence) is not None


def _texts(content: Any) -> Iterator[str]:
    if isinstance(content, str):
        yield content
    for item in content.values() if isinstance(content, dict) else content if isinstance(content, list) else ():
        yield from _texts(item)


def _docstrings(tree: Nodes) -> Iterator[str]:
    kinds = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
    yield from (text for node in tree if isinstance(node, kinds) and (text := ast.get_docstring(node)))


def _strings(trees: Iterable[Nodes], aside: Collection[int] = ()) -> Iterator[str]:
    for tree in trees:
        for node in tree:
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in aside:
                yield node.value


def program_texts(tree: Nodes) -> list[str]:
    """Strings outside docstrings and errors. An error is one sentence with semicolons: what came, what is allowed."""
    calls = ((n, getattr(n.func, "attr", getattr(n.func, "id", ""))) for n in tree if isinstance(n, ast.Call))
    aside = {id(x) for call, name in calls if ERRORS.match(name) for x in ast.walk(call)}
    aside |= {id(n.value) for n in tree if isinstance(n, ast.Expr)}
    return [*_strings([tree], aside)]


def semicolons(texts: Iterable[str]) -> float:
    """Semicolons before a space [per 1000 words]."""
    every = [*texts]
    return 1000 * sum(len(SEMICOLON.findall(t)) for t in every) / max(sum(len(t.split()) for t in every), 1)


def empty_names(trees: Iterable[Nodes]) -> float:
    """Share of assignments to a name of `EMPTY_NAMES` [%]."""
    nodes = (node for tree in trees for node in tree)
    names = [node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)]
    return 100 * sum(name in EMPTY_NAMES for name in names) / max(len(names), 1)


def nodes_by_file(root: Path) -> dict[Path, Nodes]:
    """Nodes of the syntax tree of each source file."""
    files = (p for name in PACKAGES for p in sorted((root / name).rglob("*.py")))
    return {p: [*ast.walk(ast.parse(p.read_text("utf-8")))] for p in files}


def texts_by_kind(root: Path, sources: dict[Path, Nodes]) -> dict[str, list[str]]:
    """Texts of the docs, of help, of templates, and of the other strings of the source."""
    docs = [p for p in sorted((root / "docs").rglob("*.md")) if "lab" not in p.parts]
    help_files = {p for p in sources if p.parent.name == "sweeps" and p.name.startswith(("config", "cli"))}
    pages = root / "sweeps" / "pages" / "templates"
    catalogue = tomllib.loads((pages / "catalogue.toml").read_text("utf-8"))
    return {
        "docs": [re.sub(r"```.*?```", "", p.read_text("utf-8"), flags=re.S) for p in (root / "README.md", *docs)],
        "help": [*_strings(sources[p] for p in help_files)],
        "templates": [*(p.read_text("utf-8") for p in pages.glob("*.j2")), *_texts(catalogue)],
        "strings": [*_strings(tree for p, tree in sources.items() if p not in help_files)],
    }


def figures(root: Path = ROOT) -> dict[str, float]:
    """Each figure of `CEILINGS`."""
    sources = nodes_by_file(root)
    result, by_kind = {}, texts_by_kind(root, sources)
    for kind, texts in by_kind.items():
        every = [sentence for text in texts for sentence in sentences(text)]
        result[kind] = 100 * sum(map(is_flagged, every)) / max(len(every), 1)
    result["semicolons"] = semicolons(text for tree in sources.values() for text in _docstrings(tree))
    programs = (text for tree in sources.values() for text in program_texts(tree))
    result["chains"] = semicolons([*by_kind["templates"], *programs])
    for name in PACKAGES:
        result[name] = empty_names(tree for p, tree in sources.items() if p.is_relative_to(root / name))
    return result


def main() -> None:
    """Print the figures, and the longest flagged sentences if wanted."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--most", type=int, default=0)
    most = parser.parse_args().most
    for name, figure in figures().items():
        print(f"{name:12s} {figure:6.2f} of {CEILINGS[name]:g}")
    for kind, texts in texts_by_kind(ROOT, nodes_by_file(ROOT)).items():
        flagged = {s for text in texts for s in sentences(text) if is_flagged(s)}
        for sentence in sorted(flagged, key=len, reverse=True)[:most]:
            print(f"{kind}: {sentence[:240]}")


if __name__ == "__main__":
    main()
