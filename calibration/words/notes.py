"""One sentence for each kind of note, of a table, a fit or the loop."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from calibration.discovery import notes as of_loop
from calibration.inference import notes as of_fit
from calibration.inference.notes import Note
from calibration.words import fits, loop, steps


#: What is said of each kind of note; what is not among them has a `statement` of its own.
SAID: dict[type, Callable[[Any], str]] = {
    of_fit.Step: steps.step,
    of_fit.HeldByPrior: fits.held_by_prior,
    of_fit.FarFromPrior: fits.far_from_prior,
    of_fit.NoiseOff: fits.noise_off,
    of_loop.AssumedNoise: loop.assumed_noise,
    of_loop.Copies: loop.copies,
    of_loop.KeptOut: loop.kept_out,
    of_loop.PhasesDiffer: loop.phases_differ,
    of_loop.StillLacks: loop.still_lacks,
    of_loop.Led: loop.led,
    of_loop.LostReplicates: loop.lost_replicates,
    of_loop.TooFewReplicates: loop.too_few_replicates,
}


def sentence(note: Note | str) -> str:
    """A note in words."""
    if isinstance(note, str):
        return note
    said = SAID.get(type(note))
    return str(note.statement) if said is None else said(note)


def sentences(notes: Iterable[Note | str]) -> tuple[str, ...]:
    """Each note in words, in order."""
    return tuple(map(sentence, notes))


def in_words(tell: Callable[[str], None]) -> Callable[[Note | str], None]:
    """What is told in sentences, as a computation tells it in notes."""
    return lambda note: tell(sentence(note))
