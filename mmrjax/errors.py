"""What is raised where a user's input comes in. Importable without jax."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class UsageError(ValueError):
    """Wrong use of the public API; one sentence: where, what came, what is allowed."""


def choices(word: str, allowed: Iterable[str], most: int = 1) -> str:
    """«did you mean X? allowed: ...» for an unknown word; up to `most` that are near it."""
    allowed = list(allowed)
    near = difflib.get_close_matches(word, allowed, most)
    hint = f"did you mean {', '.join(near)}? " if near else ""
    return f"{hint}allowed: {', '.join(allowed)}"
