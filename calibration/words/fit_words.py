"""Sentences about a fit, for the loop and for calibrations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from calibration.inference import blocks, fit_notes
from calibration.inference.identifiability import HELD
from calibration.inference.simulation_errors import root_mean_square
from mmrjax.errors import count_noun
from mmrjax.model import channels

if TYPE_CHECKING:
    from calibration.inference.lack_of_fit import Adequacy, Miss
    from calibration.inference.residual_clusters import ResidualCluster
    from calibration.inference.result import CalibrationResult


#: Meaning of a parameter far from its prior, by the kind of result.
FAR = {
    "loop": "{} is implausible, {:.1f} prior sds from its prior: it probably absorbs a missing effect",
    "calibration": "{} lies {:.1f} prior sds from its prior: the prior or the model is wrong",
    "edge": "{}: its posterior mean lies {:.1f} prior sds from its prior, at the edge of where the search looked: "
    "widen the prior and search again, or doubt the model",
}
#: Facts without a name or a number.
FACTS = {
    "not profiled": "no profiles were made: intervals are linear, and too symmetric where the model is curved",
    "no covariance": "the posterior has no finite covariance: values stand, intervals do not",
    "no grip": "no run grips: static friction, and slip below it, are known by their priors alone",
}
#: Origin of a prior that is neither from a field nor stated.
PRIORS = {"product": "its product with the share of the guides, as in the other fidelities"}
#: Reasons why a member of a population loses a row.
LOST_AS = {
    "slides": "slide", "tips": "turn over", "failed": "leave the ground for good or cannot be computed",
    "stalled": "stall",
}  # fmt: skip


def noise_off(note: fit_notes.NoiseOff) -> str:
    """Ratio of residuals to their sds."""
    if not note.channel:
        return (
            f"residuals are {note.factor:.2g} times the {note.source} sds in every channel and under all "
            "conditions: are the sds right?"
        )
    return (
        f"residuals of {channels.find_channel(note.channel).label} are {note.factor:.2g} times the {note.source} "
        "sds, under all conditions: are these sds right?"
    )


def estimated_noise(note: fit_notes.EstimatedNoise) -> str:
    """Channels whose noise was estimated."""
    each = ", ".join(f"{channel.replace('_', ' ')} {percent:.1f} %" for channel, percent in note.percent)
    return (
        f"no noise was stated for {each}: estimated from the misfit, so it includes model error and cannot "
        "test whether the model is adequate"
    )


def determined_combination(two: fit_notes.Pair) -> str:
    """Combination of two parameters that data determine: `the ratio of a and b`, `a + 0.03 · b`."""
    if two.form != "linear":
        return f"the {two.form} of {two.one} and {two.other}"
    return f"{two.one} {'-' if two.weight < 0 else '+'} {abs(two.weight):.2g} · {two.other}"


def is_determined_answer(found: fit_notes.Determination) -> str:
    """Answer whether data determine a parameter: `yes`, `no`, or `only with motor.resistance` for both of a pair."""
    if found.others:
        return f"only with {', '.join(found.others)}"
    return "no" if found.held else "yes"


def only_together(note: fit_notes.OnlyTogether) -> str:
    """Parameters that are not determined separately, with what is."""
    each = [f"{determined_combination(p)} (correlation {p.correlation:+.3f})" for p in note.pairs]
    return f"determined only together: {', '.join(each)}"


def of_rows(note: fit_notes.OfRows) -> str:
    """Rows with a property, and its consequence."""
    rows = f"rows {', '.join(map(str, note.rows))}"
    if note.what == "limited":
        return (
            f"{rows} are within {note.share:.0%} of the adhesion limit: it bounds their static friction from below, "
            "and does not explain all of their slip"
        )
    if note.what == "jumps":
        return f"{rows}: the calibrated robot's running gear jumps; it leaves the ground at times"
    return f"{rows}: {note.what} with the calibrated robot"


def product_alone(note: fit_notes.ProductAlone) -> str:
    """Sentence on two parameters that act only as a product."""
    if note.free:
        return f"only the product {note.friction} x {note.share} acts; the priors alone divide it"
    return f"{note.share} is found with {note.friction} held: only their product acts"


def no_prediction(note: fit_notes.NoPrediction) -> str:
    """Rows that a fit without their block does not predict."""
    return (
        f"held out by {blocks.kind_in_words(note.kind)}: {note.rows} of {note.of} rows have no prediction, because "
        "the robot fitted without them slides there; the errors leave them out"
    )


def same_predictions(note: fit_notes.SamePredictions) -> str:
    """Kinds of blocks that give the same predictions."""
    return (
        f"held out by {' or by '.join(blocks.kind_in_words(k) for k in note.others)}: the same predictions as held "
        f"out by {blocks.kind_in_words(note.kind)}, shown in their place; these runs do not vary them separately"
    )


def search_agreement(note: fit_notes.Agreement) -> str:
    """Agreement of searches from many starts."""
    if note.starts == 1:
        return "one search, which did not converge" if note.open else "one search"
    if note.agree == note.starts:
        return f"all {note.starts} starts end at the same optimum"
    parts = [f"{note.agree} of {note.starts} starts end at the best optimum"]
    if note.elsewhere:
        parts.append(f"{note.elsewhere} at others (the next costs {note.more:.3g} more)")
    if note.open:
        parts.append(f"{note.open} did not converge")
    return ", ".join(parts)


def unsettled_search(note: fit_notes.Unsettled) -> str:
    """A search that ended before it converged."""
    names = ", ".join(note.names)
    determined = f"these data do not determine {names}" if names else "the data determine them all"
    return (
        f"the search ended before it converged: parameters are the best that it found, their intervals are not to be "
        f"trusted, and {determined}"
    )


def calibrated_header(found: CalibrationResult, robot_name: str) -> str:
    """Header of the calibrated robot's file."""
    return f"calibrated from {robot_name} with {found.source}; the free parameters: {', '.join(found.parameters)}"


# --- a search by population -----------------------------------------------------------------------------


def search_generations(note: fit_notes.Generations) -> str:
    """Progress of a search."""
    end = "the last gained nothing that counts"
    if not note.settled:
        end = "the last still gained: go on with more --generations"
    return f"{count_noun(note.members, 'member')} in {count_noun(note.generations, 'generation')}; {end}"


def lost_rows(note: fit_notes.LostRows) -> str:
    """Members with a row that is lost."""
    lost = ", ".join(f"{note.members[status]} {how}" for status, how in LOST_AS.items() if status in note.members)
    return f"of the members, in some row: {lost}; a row that is lost costs a member its rank"


def members_jump(note: fit_notes.MembersJump) -> str:
    """Members whose running gear jumps."""
    best = f"the best in rows {', '.join(map(str, note.best))}" if note.best else "the best in none"
    return (
        f"{note.members} of the members jump in some row: their running gear drops between guides and pulleys and "
        f"throws them off the ground at times; {best}"
    )


def prior_edge(at: fit_notes.Edge) -> str:
    """Bound of a parameter, or its distance from the middle of its prior."""
    if at.bound:
        return f"at its {at.bound} bound"
    return f"{abs(at.sds):.1f} prior sd {'below' if at.sds < 0 else 'above'} the middle of its prior"


def ended_at_edge(note: fit_notes.EndedAtEdge) -> str:
    """A search that ended at the edge of what was allowed."""
    named = ", ".join(f"{name} {prior_edge(at)}" for name, at in note.edge.items())
    return f"the search ended at the edge of what was allowed: its best member has {named}"


# --- what residuals show --------------------------------------------------------------------------------


def shown_by(test: fit_notes.Shown) -> str:
    """Result of the most significant test of residuals."""
    whose = f"the residuals of {channels.find_channel(test.channel).label}" if test.channel else ""
    return {
        "": "",
        "stated": "the residuals exceed the stated noise",
        "repeats": "the residuals exceed the scatter of repeated runs",
        "follow": f"{whose} follow {test.variable}",
        "remember": f"{whose} show autocorrelation",
    }[test.what]


#: Reasons why no test of residuals decides on the adequacy of a fit.
OBSTACLES = {
    "undescribed": "This model does not describe these runs: {large}. Check units, signs, sides, and columns that "
    "vary and are not used, before any parameter is read",
    "not converged": "No verdict: the search did not converge, so its parameters are not the best ones ({every})",
    "worse": "Not adequate: the fit is worse than the robot's file as stated ({every})",
}


def _misses(those: Sequence[Miss]) -> str:
    """`total current 74 % of its measured rms (32 % with the file as stated)`."""
    each = [
        f"{channels.find_channel(m.channel).label} {_percent(m.fitted)} of its measured rms ({_percent(m.as_stated)} "
        "with the file as stated)"
        for m in those
    ]
    return ", ".join(each)


def _percent(share: float) -> str:
    return f"{100 * share:.{0 if share > 0.1 else 1}f} %"


def adequacy_verdict(found: Adequacy) -> str:
    """Verdict on the adequacy of a fit; first line of a calibration's output."""
    if found.obstacle:
        large = "it misses " + _misses([m for m in found.misses if m.large])
        return OBSTACLES[found.obstacle].format(large=large, every=_misses(found.misses))
    chi2 = f"χ² {found.chi2:.4g} on {found.degrees_of_freedom:.4g} degrees of freedom"
    if found.adequate is None or found.p_value is None:
        return (
            "Adequacy cannot be tested: the noise was estimated from the misfit, and "
            f"{found.degrees_of_freedom:.4g} degrees of freedom cannot show structure; state it with --noise"
        )
    p = f"p = {found.p_value:.2g}" if found.p_value > 1e-6 else "p < 1e-6"
    if not found.adequate:
        why = f"{chi2}, {p}" if found.noise_known else f"{p}, the noise estimated from them"
        return (
            f"Not adequate: {shown_by(found.shown_by)} ({why}), so something is missing and the parameters may "
            "absorb it; run mmrjax loop to find it"
        )
    if found.noise_known:
        return f"Adequate: the residuals are consistent with the stated noise ({chi2}, {p})"
    return (
        f"Adequate as far as can be tested: the residuals show no structure ({p}); the noise was estimated from "
        "them, so χ² tests nothing"
    )


#: Verdict of `Adequacy.adequate`, in words.
_VERDICTS: dict[bool | None, str] = {
    True: "The fit is adequate",
    False: "The fit is not adequate",
    None: "Adequacy undecided",
}


def calibration_answer(found: CalibrationResult) -> str:
    """Answer of a calibration: adequate or not, and rms errors before and after over the rows that have both."""
    each, rows = list[tuple[str, str]](), dict[str, int]()
    for c in found.channels:
        r = found.readings[c.name]
        both = np.isfinite(r.measured) & np.isfinite(r.before) & np.isfinite(r.after)
        if both.any():
            size = root_mean_square(r.measured[both])
            before, after = (100 * root_mean_square((x - r.measured)[both]) / size for x in (r.before, r.after))
            rows[c.label] = int(both.sum())
            each.append((c.label, f"{c.label} {before:.1f} → {after:.1f} %"))
    if not each:
        return f"{_VERDICTS[found.adequacy.adequate]}; no row is reached both before and after."
    same = len(set(rows.values())) == 1
    errors = ", ".join(text + ("" if same else f" ({rows[label]} rows)") for label, text in each)
    where = f"the same {count_noun(max(rows.values()), 'row')}" if same else "the same rows"
    return f"{_VERDICTS[found.adequacy.adequate]}; rms error before → after on {where}: {errors}."


#: Levels of a cluster that are listed, the farthest from nothing.
LISTED = 6


def residual_cluster(c: ResidualCluster) -> str:
    """Residuals that go with a column without a role."""
    what = f"residuals of {channels.find_channel(c.channel).label}"
    within = f" within {c.within}" if c.within else ""
    signs = ", with opposite signs in the two directions of travel" if c.reversing else ""
    p = f"p = {c.p:.1g}"
    role = "a column without a role" + (f" (as well by {', '.join(c.alike)})" if c.alike else "")
    if c.correlation is not None:
        return (
            f"{what} go with {c.column}{within}{signs} (rank correlation {c.correlation:+.2f}; {p}), {role}: find "
            "what differs with it"
        )
    if c.coarser:
        shares = ", ".join(f"{name} alone {share:.0%} of it" for name, share in c.coarser)
        role += f" ({shares})"
    ordered = sorted(c.levels, key=lambda m: -abs(m.mean))[:LISTED]
    kept = [m for m in c.levels if m in ordered]
    each = ", ".join(f"{m.name}: {m.mean:+.2g} {c.unit}" for m in kept)
    more = ", ..." if len(kept) < len(c.levels) else ""
    return (
        f"{what} cluster by {c.column}{within}{signs} (simulated less measured at levels {each}{more}; {p}), {role}: "
        "give each level its own configuration, or find what differs"
    )


#: Kind of note → a sentence with its fields, or a function that makes one.
SAID: dict[type, str | Callable[[Any], str]] = {
    fit_notes.HeldByPrior: f"not determined by these runs (posterior sd above {HELD:g} of the prior's): {{names}}",
    fit_notes.OnlyTogether: only_together,
    fit_notes.FarFromPrior: lambda note: FAR[note.of].format(note.name, note.sds),
    fit_notes.NoiseOff: noise_off,
    fit_notes.Fact: lambda note: FACTS[note.what],
    fit_notes.EstimatedNoise: estimated_noise,
    fit_notes.BesideSteady: "{inside} of {of} parameters lie within their 95 % intervals of the same "
    "problem's optimum "
    "with steady; furthest apart is {furthest}, {sds:.2f} sd",
    fit_notes.OfRows: of_rows,
    fit_notes.AtBound: "{name} is at its {side} bound",
    fit_notes.ProductAlone: product_alone,
    fit_notes.PriorOfProduct: "{name}: its prior, {mean:.3g} ± {sd:.2g}, is that of its product with "
    "the share of the "
    "guides in the other fidelities; the track model puts {share:.0%} of the weight on them",
    fit_notes.NoPrediction: no_prediction,
    fit_notes.SamePredictions: same_predictions,
    fit_notes.BlockNotConverged: "a search without a block of {kind} did not converge",
    fit_notes.Agreement: search_agreement,
    fit_notes.Unsettled: unsettled_search,
    fit_notes.Elsewhere: "{searches} of {of} searches converged at other values of {names}",
    fit_notes.InPieces: "{name}: the values within its 95 % interval are in {pieces} pieces, with worse ones between "
    "them; samples closer together would tell them apart",
    fit_notes.Generations: search_generations,
    fit_notes.LostRows: lost_rows,
    fit_notes.MembersJump: members_jump,
    fit_notes.EndedAtEdge: ended_at_edge,
    fit_notes.ReadFromMembers: "derivatives of the run by {names} are not those of its differences "
    "(contacts open and "
    "close): what the rows determine is read from a regression over the members near the best, which leaves "
    "{left:.2g} sd rms",
}
