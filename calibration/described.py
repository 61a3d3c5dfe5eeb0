"""`describe`: English sentences of notes and results, from the tables in `calibration/words`."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable
from typing import Any

from calibration.data import Names


def describe(found: Any, part: str = "", *about: str) -> str:
    """English sentence of a note or a result, such as a calibration's `remarks` or a result of `discover`.

    Args:
        found: a remark, a result, or a sentence, which is returned unchanged.
        part: part of a result: `header` of its robot file, or `standing` of the names in the loop. "": its answer.
        about: further arguments of the part: the name of the robot, for a header.

    Returns:
        The sentence, "" if there is nothing to report.

    Raises:
        TypeError: there is no sentence for this kind of object or part.
    """
    if isinstance(found, str):
        return found
    # results and notes are described by methods of their own, so their module cannot be imported above
    word_tables = importlib.import_module("calibration.words.note_words")
    if isinstance(found, word_tables.Remark) and not part:
        sentence = word_tables.NOTES[found.code]
        if isinstance(sentence, str):
            values_text = {name: ", ".join(x) if isinstance(x, tuple) else x for name, x in found.values.items()}
            return sentence.format(**values_text)
        return sentence(**found.values)
    sentence = word_tables.PARTS.get((type(found), part)) if part else word_tables.RESULTS.get(type(found))
    if sentence is None:
        kind = type(found).__name__ + (f", {part}" if part else "")
        raise TypeError(f"describe: got {kind}; expected a note or a result of calibrate, discover or sensitivity")
    return sentence(found, *about)


def sentences(notes: Iterable[object]) -> Names:
    """Sentence of each remark, in order."""
    return tuple(map(describe, notes))


def as_paragraph(texts: Iterable[str]) -> str:
    """Texts as sentences of one paragraph. A sentence begins with a capital, a parameter does not."""
    return " ".join(f"{text if '.' in text.split()[0] else text[0].upper() + text[1:]}." for text in texts if text)


def report_in_words(tell: Callable[[str], None]) -> Callable[[object], None]:
    """Callback for remarks that passes their sentences to `tell`."""
    return lambda note: tell(describe(note))
