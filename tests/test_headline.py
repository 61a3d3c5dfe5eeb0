"""What is claimed first holds at every noise that was tried."""

from types import SimpleNamespace

import pytest

from calibration.discovery.loop_notes import Mechanism, MissingEffect, VerdictSummary, headline
from calibration.words.loop_words import loop_answer

DROP, SLIP = "voltage drop that changes with current", "slip that changes with demand"


def law(*names, families=(DROP,), established=True):
    """A verdict with one effect, and what it cannot be told from."""
    verdict = "place" if not established else "named" if len(names) == 1 else "class"
    place = SimpleNamespace(family=DROP) if not established else None
    return VerdictSummary(verdict, 0.001, place, (MissingEffect(names, (), families, established),))


def of_mechanism(*families):
    place = SimpleNamespace(family=families[0])
    return VerdictSummary("mechanism", 0.001, place, mechanism=Mechanism(families, (), 0.9, 1.0, 0.1, 1.0))


def nothing(verdict="none"):
    return VerdictSummary(verdict, 0.5, None)


@pytest.mark.parametrize(
    "own, others, level, claims",
    [
        (law("a"), (law("a"), law("a")), "named", (("a",),)),
        (law("a"), (law("a", "b"), law("a")), "class", (("a", "b"),)),
        (law("a"), (law("b"), law("a")), "mechanism", ((DROP,),)),
        (law("a"), (of_mechanism(DROP), law("a")), "mechanism", ((DROP,),)),
        (law("a"), (of_mechanism(SLIP, DROP), law("a")), "mechanism", ((DROP, SLIP),)),
        (law("a"), (of_mechanism(SLIP), law("a")), "place", ()),
        (law("a", established=False), (law("a", established=False),), "place", (("voltage drop",),)),
        (law("a"), (law("a", established=False),), "place", (("voltage drop",),)),
        (nothing(), (nothing(), nothing()), "none", ()),
        (nothing(), (law("a"), nothing()), "open", ()),
        (law("a"), (nothing("undescribed"),), "open", ()),
        (of_mechanism(DROP), (), "mechanism", ((DROP,),)),
    ],
)
def test_headline_is_the_deepest_claim_that_all_verdicts_share(own, others, level, claims):
    found = headline(own, list(zip((0.7, 1.4), others, strict=False)))
    assert (found.level, found.claims) == (level, claims)
    assert found.factors == tuple(sorted((1.0, *(0.7, 1.4)[: len(others)])))


def test_what_only_some_noises_cannot_tell_apart_comes_after_what_all_list():
    found = headline(of_mechanism(SLIP, DROP), [(0.7, of_mechanism(DROP)), (1.4, of_mechanism(DROP, "x that is"))])
    assert found.claims == ((DROP, SLIP, "x that is"),) and found.shared == (1,)
    assert f"At some of these noise levels it may be a {SLIP} or a x that is instead." in loop_answer(found)


def test_one_mechanism_is_claimed_once():
    """Two laws of one family, of which another noise leaves the mechanism alone."""
    two = VerdictSummary("class", 0.001, None, (*law("a").missing, *law("b").missing))
    assert headline(two, [(0.7, of_mechanism(DROP, SLIP))]).claims == ((DROP, SLIP),)
