"""What is raised where a user's input comes in. Importable without jax."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable


class UsageError(ValueError):
    """Wrong use of the public API; one sentence: where, what came, what is allowed."""


def counted(count: int, noun: str) -> str:
    """`1 run`, `2,000 runs`: how many of what a noun in the singular names, whose plural has an s."""
    return f"{count:,} {noun}{'s' * (count != 1)}"


def choices(word: str, allowed: Iterable[str], most: int = 1, shown: Iterable[str] | None = None) -> str:
    """«did you mean X? allowed: ...» for an unknown word; up to `most` that are near it. `shown`: those that are
    listed, where not all are."""
    allowed = list(allowed)
    found = near(word, allowed, most)
    hint = f"did you mean {', '.join(found)}? " if found else ""
    return f"{hint}allowed: {', '.join(allowed if shown is None else shown)}"


def near(word: str, allowed: Iterable[str], most: int = 1) -> list[str]:
    """Up to `most` of the words that are near one, whatever their capitals: first, in their order, those that have it
    as a part (`current` is one of `total_current`)."""
    folded = {a.casefold(): a for a in allowed}
    wanted = word.casefold()
    parts = [f for f in folded if wanted in re.split(r"[._ -]", f)]
    close = difflib.get_close_matches(wanted, folded, max(most, 1))
    return [folded[f] for f in dict.fromkeys([*([wanted] if wanted in folded else []), *parts, *close])][:most]
