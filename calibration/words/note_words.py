"""One sentence for each kind of note, of a table, a fit, the loop or a study."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from calibration.inference.fit_notes import Note, Step
from calibration.words import fit_words, loop_words, sensitivity_words, step_words, table_words

#: What is said of each kind of note; what is not among them has a `statement` of its own.
SAID: dict[type, str | Callable[[Any], str]] = {
    Step: step_words.step,
    **table_words.SAID,
    **fit_words.SAID,
    **loop_words.SAID,
    **sensitivity_words.SAID,
}


def sentence(note: Note | str) -> str:
    """A note in words."""
    if isinstance(note, str):
        return note
    said = SAID.get(type(note))
    if isinstance(said, str):
        listed = {name: ", ".join(x) if isinstance(x, tuple) else x for name, x in vars(note).items()}
        return said.format(**listed)
    return str(note.statement) if said is None else said(note)


def sentences(notes: Iterable[Note | str]) -> tuple[str, ...]:
    """Each note in words, in order."""
    return tuple(map(sentence, notes))


def in_words(tell: Callable[[str], None]) -> Callable[[Note | str], None]:
    """What is told in sentences, as a computation tells it in notes."""
    return lambda note: tell(sentence(note))
