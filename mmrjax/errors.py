"""Exceptions and messages for user input. Importable without jax."""

from __future__ import annotations

import difflib
import itertools
import re
from collections.abc import Iterable

#: A word longer than the first number is cut to `SHOWN` characters; longest path; longest message.
WORD, SHOWN, PATH, LONGEST = 80, 40, 240, 400


#: Characters that Python does not call printable and a text may contain: line feed, tab, and spaces of typesetting.
_LAYOUT = "\n\t\u00a0\u2009\u202f"


def printable(text: str) -> str:
    """Returns a text with `�` in place of characters that a terminal or page obeys or cannot show.

    These are escape sequences, other controls, overrides of the writing direction, and halves of surrogate pairs.
    """
    return text if text.isprintable() else "".join(c if c.isprintable() or c in _LAYOUT else "�" for c in text)


def shorten(message: str) -> str:
    """Returns a message with very long words cut and the middle of a very long text left out."""

    def cut(word: re.Match[str]) -> str:
        if len(word[0]) <= (PATH if "/" in word[0] else WORD):
            return word[0]
        end = word[0][len(word[0].rstrip(";,:.)")) :]
        return f"{word[0][:SHOWN]}… ({len(word[0]) - len(end):,} characters){end}"

    shortened = re.sub(r"\S+", cut, message)
    return (
        shortened if len(shortened) <= LONGEST else f"{shortened[: 2 * LONGEST // 3]} … {shortened[-LONGEST // 4 :]}"
    )


class UsageError(ValueError):
    """Wrong use of the public API. One sentence: where, what came, what is allowed."""

    def __init__(self, message: str) -> None:
        """Stores the message, `shorten` and `printable`."""
        super().__init__(shorten(printable(message)))


def count_noun(count: int, noun: str) -> str:
    """Returns a count with its noun, `1 run` or `2,000 runs`. The noun is singular and its plural ends in s."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"  # a comparison of NumPy integers gives no Python bool


def allowed_words(word: str, allowed: Iterable[str], limit: int = 1, listed: Iterable[str] | None = None) -> str:
    """Returns «did you mean X? allowed: ...» for an unknown word.

    Args:
        word: the unknown word.
        allowed: all valid words.
        limit: largest number of suggestions.
        listed: the words to list as allowed, if not all.
    """
    allowed = list(allowed)
    similar = similar_words(word, allowed, limit)
    hint = f"did you mean {', '.join(similar)}? " if similar else ""
    return f"{hint}allowed: {list_some(allowed if listed is None else listed)}"


def list_some(names: Iterable[str], width: int = 240) -> str:
    """A list of names, cut after `width` characters with the number of the others: "a, b and 3 more"."""
    names = list(names)
    ends = list(itertools.accumulate(len(name) + 2 for name in names))
    listed_count = max(1, sum(end <= width for end in ends))
    rest = len(names) - listed_count
    return ", ".join(names) if rest <= 1 else f"{', '.join(names[:listed_count])} and {rest} more"


def similar_words(word: str, allowed: Iterable[str], limit: int = 1) -> list[str]:
    """Up to `limit` of the allowed words that resemble one, ignoring case.

    Words that contain it come first, in their order (`current` is a part of `total_current`).
    """
    folded = {a.casefold(): a for a in allowed}
    plain_word = word.casefold()
    parts = [f for f in folded if plain_word in re.split(r"[._ -]", f)]
    close = difflib.get_close_matches(plain_word, folded, max(limit, 1))
    return [folded[f] for f in dict.fromkeys([*([plain_word] if plain_word in folded else []), *parts, *close])][
        :limit
    ]
