"""What is raised where a user's input comes in. Importable without jax."""

from __future__ import annotations

import difflib
import itertools
import re
from collections.abc import Iterable

#: Longest word of a message, of which `SHOWN` characters are kept if it is longer; longest path; longest message.
WORD, SHOWN, PATH, LONGEST = 80, 40, 300, 900


def shortened(message: str, longest: int = LONGEST) -> str:
    """Returns a message without the rest of very long words and the middle of very long text."""

    def cut(word: re.Match[str]) -> str:
        if len(word[0]) <= (PATH if "/" in word[0] else WORD):
            return word[0]
        end = word[0][len(word[0].rstrip(";,:.)")) :]
        return f"{word[0][:SHOWN]}… ({len(word[0]) - len(end):,} characters){end}"

    found = re.sub(r"\S+", cut, message)
    return found if len(found) <= longest else f"{found[: 2 * longest // 3]} … {found[-longest // 4 :]}"


class UsageError(ValueError):
    """Wrong use of the public API; one sentence: where, what came, what is allowed."""

    def __init__(self, message: str) -> None:
        """Keeps the message `shortened`."""
        super().__init__(shortened(message))


def counted(count: int, noun: str) -> str:
    """`1 run`, `2,000 runs`: how many of what a noun in the singular names, whose plural has an s."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"  # a NumPy integer compares to no bool of Python


def choices(word: str, allowed: Iterable[str], most: int = 1, shown: Iterable[str] | None = None) -> str:
    """«did you mean X? allowed: ...» for an unknown word; up to `most` that are near it. `shown`: those that are
    listed, where not all are."""
    allowed = list(allowed)
    found = near(word, allowed, most)
    hint = f"did you mean {', '.join(found)}? " if found else ""
    return f"{hint}allowed: {some(allowed if shown is None else shown)}"


def some(names: Iterable[str], width: int = 240) -> str:
    """A list of names, cut after `width` characters with the number of the others: "a, b and 3 more"."""
    names = list(names)
    ends = list(itertools.accumulate(len(name) + 2 for name in names))
    shown = max(1, sum(end <= width for end in ends))
    rest = len(names) - shown
    return ", ".join(names) if rest <= 1 else f"{', '.join(names[:shown])} and {rest} more"


def near(word: str, allowed: Iterable[str], most: int = 1) -> list[str]:
    """Up to `most` of the words that are near one, whatever their capitals: first, in their order, those that have it
    as a part (`current` is one of `total_current`)."""
    folded = {a.casefold(): a for a in allowed}
    wanted = word.casefold()
    parts = [f for f in folded if wanted in re.split(r"[._ -]", f)]
    close = difflib.get_close_matches(wanted, folded, max(most, 1))
    return [folded[f] for f in dict.fromkeys([*([wanted] if wanted in folded else []), *parts, *close])][:most]
