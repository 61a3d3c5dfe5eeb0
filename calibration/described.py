"""Sentences of notes and results, which the layer above makes: `mmrjax.describe` imports it when it is called."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import mmrjax


def described(found: object, part: str = "", *about: str) -> str:
    """Sentence of a note or result, or of one part of it; see `mmrjax.describe`."""
    return mmrjax.describe(found, part, *about)


def sentences(notes: Iterable[object]) -> tuple[str, ...]:
    """Sentence of each note, in order."""
    return tuple(map(described, notes))


def in_words(tell: Callable[[str], None]) -> Callable[[object], None]:
    """A callback for notes that passes their sentences on to `tell`."""
    return lambda note: tell(described(note))
