"""What is claimed first holds at every noise that was tried."""

from types import SimpleNamespace

import pytest
from synthetic import LOST_MOTION

from calibration.described import describe
from calibration.discovery.loop_notes import Mechanism, MissingEffect, VerdictSummary
from calibration.discovery.result import DiscoveryResult
from calibration.discovery.verdict import headline
from calibration.words.loop_words import loop_answer, verdict_sentences

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
def test_it_is_the_deepest_claim_that_all_verdicts_hold(own, others, level, claims):
    found = headline(own, list(zip((0.7, 1.4), others, strict=False)))
    assert (found.level, found.claims) == (level, claims)
    assert found.factors == tuple(sorted((1.0, *(0.7, 1.4)[: len(others)])))


def test_it_is_said_with_the_noises_at_which_it_holds():
    said = loop_answer(headline(law("a"), [(0.7, of_mechanism(DROP)), (1.4, law("a"))]))
    assert said == f"No: a {DROP} is missing at 0.7, 1 and 1.4 times the noise. Its exact law is not established."
    weak = loop_answer(headline(law("a"), [(0.7, law("a", established=False))]))
    assert weak == "No: a voltage drop is missing at 0.7 and 1 times the noise. No more is established."
    assert loop_answer(headline(law("a", "b"))) == (
        f"No: a {DROP} (a or b, which these data cannot distinguish) is missing."
    )


def test_a_law_that_an_ammeter_imitates_is_stated_with_it():
    both = "loss torque that changes with speed", "reading of total current that changes with speed"
    found = headline(law("windage", families=both))
    assert found.level == "class" and loop_answer(found) == (
        f"No: a {both[0]} or a {both[1]} (windage, which these data cannot distinguish) is missing."
    )
    verdict = verdict_sentences(law("windage", families=both))
    assert verdict.startswith(f"Missing: windage, or a {both[1]} (these data cannot distinguish them) (")


def test_what_only_some_noises_cannot_tell_apart_comes_after_what_all_list():
    found = headline(of_mechanism(SLIP, DROP), [(0.7, of_mechanism(DROP)), (1.4, of_mechanism(DROP, "x that is"))])
    assert found.claims == ((DROP, SLIP, "x that is"),) and found.shared == (1,)
    assert f"At some of these noise levels it may be a {SLIP} or a x that is instead." in loop_answer(found)


def test_one_mechanism_is_claimed_once():
    """Two laws of one family, of which another noise leaves the mechanism alone."""
    two = VerdictSummary("class", 0.001, None, (*law("a").missing, *law("b").missing))
    assert headline(two, [(0.7, of_mechanism(DROP, SLIP))]).claims == ((DROP, SLIP),)


def test_lost_motion_comes_before_what_the_library_explains():
    """A servo with backlash: no effect explains it, and the answer was a reading that changes with time."""
    of = lambda *remarks: SimpleNamespace(remarks=remarks, headline=headline(law("a"), []))  # noqa: E731
    alone = DiscoveryResult.statement.fget(of())
    first = DiscoveryResult.statement.fget(of("a note", LOST_MOTION))
    assert first == f"{describe(LOST_MOTION)}. {alone}" and "at each of 20 reversals about 0.96 deg" in first
