"""Sentences of the loop: verdict, support of names, ruled-out and hidden effects, worse errors, remarks."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from calibration.data import Names
from calibration.data.input_errors import three_digits
from calibration.described import describe
from calibration.discovery import loop_notes
from calibration.discovery.location import DiscrepancyLocation
from calibration.discovery.outliers import OutlierCluster
from calibration.discovery.settings import WITHOUT_NAME, Settings
from calibration.inference import bases, blocks
from calibration.inference.series_noise import SeriesNoise
from calibration.words.fit_words import UNDESCRIBED
from mmrjax import effects
from mmrjax.effects.base import EQUATION
from mmrjax.errors import count_noun
from mmrjax.model import channels

if TYPE_CHECKING:
    from calibration.discovery.findings import EffectRanking, FoundEffect, UnnamedDiscrepancy
    from calibration.discovery.result import DiscoveryResult, Errors, NoiseVerdict, WorseChannel
    from calibration.discovery.verdict import LoopStages

# --- the verdict ----------------------------------------------------------------------------------------


def verdict_sentences(summary: loop_notes.VerdictSummary) -> str:
    """A verdict in a few sentences: the claim with its evidence, then its limits."""
    where, evidence = summary.where, f"family-wise p {p_value(summary.p)}"
    if summary.missed:
        evidence += f", but it still misses {', '.join(map(_missed, summary.missed))} on unseen runs"
    if summary.verdict == "none":
        text = f"Nothing is missing: the residuals are consistent with noise (family-wise p = {summary.p:.2g})."
    elif summary.verdict == "undescribed":
        text = _undescribed(summary)
    elif summary.verdict in WITHOUT_NAME and where is not None:
        claim = _mechanism_claim if summary.verdict == "mechanism" else _place_claim
        text = f"{claim(summary, where, evidence)}{_not_established(summary)}"
    else:
        names = [_effect_and_rivals(effect) for effect in summary.missing if effect.established]
        text = f"Missing: {' and '.join(names)} ({evidence}).{_tentative(summary)}"
        text += "" if where is None else f" The {bases.place_in_words(where.place)} still has an error."
    if summary.aside:
        share = 100 * summary.aside / summary.of
        text = f"{summary.aside} of {summary.of} rows ({share:.0f} %) are set aside as outliers. {text}"
    if summary.noise:
        text = f"{text} But {'. '.join(map(describe, summary.noise))}"
    if summary.cluster is not None:
        text = f"{text} {cluster_sentence(summary.cluster).capitalize()}, so these rows are kept."
    return text


def _mechanism_claim(summary: loop_notes.VerdictSummary, where: DiscrepancyLocation, evidence: str) -> str:
    """A mechanism with its evidence: share of the misfit, gain on held-out runs, and repeatability."""
    mechanism = summary.mechanism
    assert mechanism is not None
    names = " or ".join(map(with_article, mechanism.families))
    if where.family in mechanism.families and where.window is not None:
        names += f", {_variable_phrase(where)}"
    errors = f", {mechanism.gain / mechanism.se:.1f} standard errors" if 0 < mechanism.se < math.inf else ""
    return (
        f"Missing: {names}, established as a mechanism. It explains {100 * mechanism.share:.0f} % of the misfit "
        f"beyond noise, raises the log likelihood of held-out runs by {mechanism.gain:.2g} per affected "
        f"reading{errors}, and is found again in {100 * mechanism.again:.0f} % of the fits without one block "
        f"({evidence}). No law of the library is established."
    )


def _place_claim(summary: loop_notes.VerdictSummary, where: DiscrepancyLocation, evidence: str) -> str:
    """A place with the variable that shows it, and reasons why nothing more is established."""
    others = [bases.place_in_words(p).removesuffix(" balance") for p in where.alike if p != where.place]
    alternatives = f" (or {', '.join(others)}, which these data cannot distinguish)" if others else ""
    family = f": {where.family}" if where.variable in bases.VARIABLES else ""
    no_effect = "is established" if summary.missing else "explains it"
    no_more = "" if summary.mechanism is None else f" No mechanism is established: {no_mechanism(summary.mechanism)}."
    return (
        f"Something is missing in the {bases.place_in_words(where.place)}{alternatives}, "
        f"{_variable_phrase(where)}{family}. No effect of the library {no_effect} ({evidence}).{no_more}"
    )


def _not_established(summary: loop_notes.VerdictSummary) -> str:
    """Effects in the model whose names are not established, or else the nearest candidates."""
    if summary.missing or not summary.nearest:
        return _tentative(summary)
    candidates, them = ("candidate is", "it") if len(summary.nearest) == 1 else ("candidates are", "them")
    return f" The nearest {candidates} {' and '.join(summary.nearest)}, but the tests do not support {them}."


def _missed(m: loop_notes.MissedChannel) -> str:
    """`total current by 10 % of its measured rms`."""
    return f"{channels.find_channel(m.channel).label} by {100 * m.error:.0f} % of its measured rms"


def loop_answer(headline: loop_notes.Headline) -> str:
    """Answer of the loop: the deepest claim that holds at every noise factor tried.

    Terminal, page, result.json and robot files state this sentence, and no other level.
    """
    *first, last = [f"{f:g}" for f in headline.factors]
    noises = f" at {', '.join(first)} and {last} times the noise" if first else ""
    claims = [c[: n or len(c)] for c, n in zip(headline.claims, headline.shared, strict=False)]
    missing = _are_missing([" or ".join(map(with_article, sure)) for sure in claims] or ["something"])
    laws = [_law(*law) for law in zip(headline.claims, headline.families, headline.values, strict=False)]
    alternatives = "".join(
        f" At some of these noise levels it may be {' or '.join(map(with_article, c[n:]))} instead."
        for c, n in zip(headline.claims, headline.shared, strict=False)
        if n and c[n:]
    )
    return {
        "none": f"Yes, as far as these runs show{noises}: the residuals are consistent with noise.",
        "undescribed": f"No verdict{noises}: {UNDESCRIBED}.",
        "open": f"Perhaps. The answers{noises} differ: whether anything is missing depends on the noise.",
        **dict.fromkeys(("named", "class"), f"No: {_are_missing(laws)}{noises}."),
        "mechanism": f"No: {missing}{noises}.{alternatives} Its exact law is not established.",
        "place": f"No: {missing}{noises}.{alternatives} No more is established.",
    }[headline.level]


def _law(names: Sequence[str], families: Sequence[str], values: Sequence[loop_notes.AlternativeValue]) -> str:
    """`a loss torque that changes with speed (churning or windage, which these data cannot distinguish)`."""
    terms = [*map(freed_value, values), *in_order_of_parts(names)]
    ambiguity = ", which these data cannot distinguish" if len(terms) + len(families) > 2 else ""
    return f"{' or '.join(map(with_article, families))} ({' or '.join(terms)}{ambiguity})"


def in_order_of_parts(names: Iterable[str]) -> list[str]:
    """Effects in the order of the balances from the supply to the instruments, others last."""
    parts, balances = tuple(EQUATION), {e.name: e.balance for e in effects.ALL}
    return sorted(names, key=lambda name: parts.index(balances[name]) if name in balances else len(parts))


def with_article(noun: str) -> str:
    """A noun with its indefinite article."""
    return f"{'an' if noun[:1] in 'aeiou' else 'a'} {noun}"


def _are_missing(nouns: Sequence[str]) -> str:
    """`a slip is missing`, `a slip and a loss torque are missing`."""
    return f"{' and '.join(nouns)} {'is' if len(nouns) == 1 else 'are'} missing"


def _undescribed(summary: loop_notes.VerdictSummary) -> str:
    """Sentence on a model that does not describe the runs: the misfit and the checks."""
    misses = [
        _missed(m) + (f" (its noise is estimated as {100 * m.noise:.0f} %)" if m.noise > m.error else "")
        for m in summary.missed
    ]
    checks = [f"unused columns that vary ({', '.join(summary.unused)})"] * bool(summary.unused)
    checks += [f"parameters far from their priors ({', '.join(summary.far)})"] * bool(summary.far)
    checks += ["units, signs and sides of columns"]
    if not misses:
        return f"{UNDESCRIBED.capitalize()}: it lacks backlash. Add backlash first."
    return (
        f"{UNDESCRIBED.capitalize()}: after the refit, it misses {', '.join(misses)}. Check "
        f"first: {', and '.join(checks)}."
    )


def _changed_constant(constant: str, run: int | None) -> str:
    """`a different motor.inertia in run 3`."""
    if "." in constant:
        return f"a different {constant} in run {run}"
    return f"a constant error in the {bases.place_in_words(constant)} of run {run}"


#: Evidence against a mechanism.
NO_MECHANISM = {
    "share": "it explains only {share:.0f} % of the misfit beyond noise",
    "gain": "the log likelihood of held-out runs changes by {0.gain:+.2g} ± {0.se:.2g} per reading",
    "again": "only {again:.0f} % of the fits without one block find it again",
    "many": "{many} variables or equations may cause it",
    "run": "{changed} explains as much",
}


def no_mechanism(mechanism: loop_notes.Mechanism) -> str:
    """Reasons against the best mechanism."""
    parts = {
        "share": 100 * mechanism.share,
        "again": 100 * mechanism.again,
        "many": mechanism.candidates,
        "changed": _changed_constant(mechanism.changed, mechanism.run),
    }
    reasons = [NO_MECHANISM[name].format(mechanism, **parts) for name in mechanism.fails]
    return f"the best candidate is a {mechanism.families[0]}, but {' and '.join(reasons)}"


def curve_course(d: UnnamedDiscrepancy) -> str:
    """Course of a smooth curve with its values at both ends, empty without a variable."""
    if d.window is not None or d.variable not in bases.VARIABLES or len(d.at) < 2:
        return ""
    ends = [f"{d.value[k]:.2g} {d.unit} at {_level(d.variable, d.at[k])}" for k in (0, -1)]
    k = int(np.argmax(np.abs(d.value - np.interp(d.at, d.at[[0, -1]], d.value[[0, -1]]))))
    between = f", passing {d.value[k]:.2g} {d.unit} at {_level(d.variable, d.at[k])}"
    bent = not min(d.value[0], d.value[-1]) <= d.value[k] <= max(d.value[0], d.value[-1])
    verb = "rises" if d.value[-1] > d.value[0] else "falls"
    return f"{verb} from {ends[0]} to {ends[1]}{between * bent}"


def proposed_formula(d: UnnamedDiscrepancy) -> str:
    """The formula of a curve, or its course where no single term explains it."""
    if d.proposal.expression:
        return f"{d.proposal.expression} ({d.proposal.mark})"
    course = curve_course(d)
    return f"The curve {course}. {NO_FORMULA}" if course else NO_FORMULA


#: Units in which people set the variables of a curve, and their SI values.
_SET_IN = {"speed_motor": ("rpm", math.pi / 30), "slope": ("°", math.pi / 180), "speed": ("mm/s", 1e-3)}


def _level(variable: str, x: float) -> str:
    units = {"voltage": "V", "current": "A", "payload": "kg", "time": "s"}
    unit, factor = _SET_IN.get(variable, (units.get(variable, ""), 1.0))
    return f"{float(f'{x / factor:.3g}'):g} {unit}".rstrip()


def brief_verdict(summary: loop_notes.VerdictSummary) -> str:
    """Verdict, families of a mechanism, and the first name of each effect, marked established or tentative."""
    phrases = []
    if summary.verdict == "mechanism" and summary.mechanism is not None:
        phrases.append(" or ".join(summary.mechanism.families))
    for word, established in (("established", True), ("tentative", False)):
        names = [effect.names[0] for effect in summary.missing if effect.established == established]
        phrases += [f"{', '.join(names)} {word}"] * bool(names)
    return ": ".join([summary.verdict, *[", ".join(phrases)] * bool(phrases)])


def at_other_noise(verdicts: Sequence[NoiseVerdict]) -> str:
    """The verdicts with other noise, in a sentence, empty for none."""
    factors_by_verdict: dict[str, list[str]] = {}
    for verdict in verdicts:
        factors_by_verdict.setdefault(brief_verdict(verdict.summary), []).append(f"{verdict.factor:g}")
    answers = [
        f"with {' and with '.join(factors)} times the noise, the verdict is {phrase}"
        for phrase, factors in factors_by_verdict.items()
    ]
    return ", and ".join(answers)


def _effect_and_rivals(effect: loop_notes.MissingEffect) -> str:
    """An effect, with the alternatives that the data cannot distinguish from it."""
    readings = [with_article(f) for f in effect.families[1:] if f.startswith("reading")]
    if len(effect.names) + len(effect.values) + len(readings) == 1:
        return effect.names[0]
    family = f"{effect.families[0]}, " if len(effect.families) == 1 else ""
    names = ", ".join(in_order_of_parts(effect.names))
    choice = names if len(effect.names) == 1 else f"one of {names}"
    values = [freed_value(v) for v in effect.values]
    return f"{family}{', or '.join([choice, *values, *readings])} (these data cannot distinguish them)"


def _tentative(summary: loop_notes.VerdictSummary) -> str:
    """Effects in the model whose names are not established, each with the reasons against it. All effects if the
    verdict names none.
    """
    phrases = [
        f"{_effect_and_rivals(effect)}, which {doubts}" if (doubts := effect_doubts(effect.test))
        else f"{_effect_and_rivals(effect)} ({support_reasons(summary.support)})"
        for effect in summary.missing
        if not effect.established or summary.verdict in WITHOUT_NAME
    ]  # fmt: skip
    return f" Tentative, kept because it improves predictions: {'; '.join(phrases)}." if phrases else ""


def verdict_line(stages: LoopStages) -> str:
    """The verdict at one noise level: `at one noise level: class, series_resistance or supply_sag`."""
    claims = [" or ".join(members) for members in stages.members] or [
        with_article(family) for family in stages.families
    ]
    return f"at one noise level: {', '.join((stages.verdict, *claims))}"


def ranking_lines(ranking: EffectRanking, brief: bool = False) -> list[str]:
    """Lines of the ranking by regression: the answer and the strongest effects. With `brief`, only their names."""
    method_words = f"by regression on {ranking.windows} windows of the log" if ranking.windows else "by regression"
    if not ranking.missing:
        return [
            f"{method_words}, not yet confirmed: no effect of the library exceeds chance (family-wise p = "
            f"{ranking.p_value:.2g})"
        ]
    first = f"{method_words}, not yet confirmed: something is missing (family-wise p {p_value(ranking.p_value)})"
    beyond = ranking.beyond_chance[:5]
    if not beyond:
        return [f"{first}. No effect exceeds chance"]
    if brief:
        return [f"{first}. Strongest alone: {', '.join(e.name for e in beyond)}"]
    lines = [
        f"  {k}. {e.name}, {with_article(e.family)}: lowers the misfit by {three_digits(e.score)} σ², "
        f"amplitude {e.amplitude:.3g} ± {e.sd:.2g} {e.unit}".rstrip(" -")
        for k, e in enumerate(beyond, 1)
    ]
    return [f"{first}. Strongest effects, each added alone:", *lines]


def regression_verdict(ranking: EffectRanking) -> str:
    """Answer of a ranking to a loop without a verdict: never more than a mechanism, and the base parameters."""
    alike = [e for e in ranking.beyond_chance if e.score >= ranking.beyond_chance[0].score - Settings.alternative]
    families = " or ".join(dict.fromkeys(with_article(e.family) for e in alike))
    finding = "something may be missing, but no effect explains it"
    if alike:
        finding = f"perhaps {families} is missing ({' or '.join(e.name for e in alike)})"
    finding = finding if ranking.missing else "no effect of the library exceeds chance"
    numbers = ", ".join(f"{name} {value:.4g} ± {sd:.2g}" for name, (value, sd) in ranking.parameters.items())
    numbers = f". Parameters [SI]: {numbers}" if numbers else ""
    return f"regression only, not confirmed: {finding}{numbers}"


#: Remark if a regression finds nothing missing but the simulation does.
DISAGREES = "simulation disagrees: the refit leaves more error than chance"


def search_progress(effects: Sequence[str], families: Sequence[str]) -> str:
    """Findings of a search before its verdict is known."""
    return (
        f"so far, simulation confirms {' and '.join(with_article(f) for f in dict.fromkeys(families))} "
        f"({' and '.join(effects)}). Tests follow"
    )


def _variable_phrase(where: DiscrepancyLocation) -> str:
    """Variable that shows a discrepancy, and equally significant others."""
    similar = [
        variable_showing_discrepancy(v, where.by_duty).removeprefix("clearest when plotted ")
        for v in where.variables_alike
    ]
    return variable_showing_discrepancy(where.variable, where.by_duty) + (
        f" (equally clear {', '.join(similar)})" if similar else ""
    )


def variable_showing_discrepancy(variable: str, by_duty: bool = False) -> str:
    """Variable that shows a discrepancy. `by_duty`: only the duty changed the motors' voltage."""
    variable = "duty" if by_duty and variable == "voltage" else variable
    window = bases.window_from_name(variable)
    if variable == "side":
        return "different on the two sides"
    if window is None:
        return (
            f"clearest when plotted over {bases.variable_in_words(variable)}"
            if variable != "order"
            else "drifting from run to run"
        )
    if window.axis == "time":
        return f"from {window.low:.3g} to {window.high:.3g} s after the start of the runs"
    if window.axis == "order":
        return f"in runs {window.low:.0f} to {window.high:.0f}"
    return f"in the runs at {window.words}"


def freed_value(v: loop_notes.AlternativeValue) -> str:
    """`motor.resistance is 1.94 ohm`."""
    return f"{v.name} is {v.value:.3g} {v.unit}".rstrip(" -")


def p_value(p: float) -> str:
    """A p-value. If it is small, an upper bound, because the bootstrap cannot resolve it."""
    if p > 0.01:
        return f"= {p:.2g}"
    step = 10.0 ** math.floor(math.log10(p))
    return f"≤ {math.ceil(p / step - 1e-9) * step:.1g}"


def cluster_sentence(c: OutlierCluster) -> str:
    """Sentence on the common level of outlying rows."""
    position = f"at {c.axis} {c.level}" if c.level else f"at {c.axis} {c.low:.3g} to {c.high:.3g}"
    return f"{c.inside} of {c.of} outlying rows cluster {position} (p = {c.p:.1g})"


# --- the first screen -----------------------------------------------------------------------------------


def is_established(result: DiscoveryResult, effect: FoundEffect) -> bool:
    """True if the name of an effect is established."""
    return result.support is None or result.support.established(effect.name)


def standing_of_effect(result: DiscoveryResult, effect: FoundEffect) -> str:
    """Standing of an effect, with its score and the threshold of chance."""
    test = None if result.support is None else result.support.test_of(effect.name)
    if is_established(result, effect):
        evidence = "" if test is None else f": {test.root:.1f} σ (chance alone reaches {test.needed:.1f} σ)"
        if test is not None and test.shows_form:
            variable = bases.variable_in_words(test.over)
            evidence += f", and its size varies by ±{100 * test.spread:.0f} % over {variable}"
        return f"established{evidence}"
    return f"tentative: it improves predictions, but {effect_doubts(test)}" if effect_doubts(test) else "tentative"


def brief_answer(result: DiscoveryResult, moved: Sequence[str], next_step: str) -> Names:
    """Lines printed below the answer: parameters far from their stated values, effects added, errors with the number
    of rows, and the next step.

    Args:
        moved: sentences on parameters far from their stated values.
    """
    added = [
        f"{e.name} {effect_amplitude(e)}" + " (tentative)" * (not is_established(result, e)) for e in result.effects
    ]
    changes = f"Changed: {', and '.join(moved)}. " * bool(moved) + f"Added: {', '.join(added)}." * bool(added)
    stated_errors, fitted = result.errors_as_stated, result.errors[0 if result.refit_alone else 1]
    errors = [
        f"{channels.find_channel(c).label} {percent_text(stated_errors[c])} → {percent_text(e)} %"
        for c, e in fitted.items()
        if e["rows"]
    ]
    simulated, total = max((int(e["rows"]) for e in stated_errors.values()), default=0), len(result.runs)
    aside = f", {len(result.outliers)} set aside as outliers" * bool(result.outliers)
    unreached = f" (of the robot file as given, {simulated} rows can be simulated)" * (simulated < total)
    rows = f"{int(result.included.sum())} of {total} rows are used{aside}{unreached}"
    return (
        *filter(None, [changes.rstrip()]),
        f"rms error, robot file as given → after the loop: {', '.join(errors)}. {rows}.",
        f"Next: {next_step}",
    )


def percent_text(error: Mapping[str, float | int]) -> str:
    """The rms error of a channel [%]: one decimal, one significant digit if small, `-` without rows."""
    percent = float(error["rms_percent"])
    if not error["rows"]:
        return "-"
    return f"{percent:.1f}" if percent == 0 or percent >= 0.095 else f"{percent:.1g}"


def errors_of_written_robot(result: DiscoveryResult) -> list[str]:
    """Errors of the written robot on fitted and on held-out rows, by kind of block, or "No"."""
    when = 1 if result.written else 0
    if result.headline.level == "undescribed":
        return [f"No: {UNDESCRIBED}."]
    lines = [f"**These conditions**: {_rms(result.errors[when], len(result.runs))}."] * bool(result.errors[when])
    for kind, error_pair in result.errors_held_out.items():
        lines.append(f"**Another {blocks.kind_in_words(kind)}**: {_rms(error_pair[when], len(result.runs))}.")
    return lines


def _rms(errors: Errors, total: int) -> str:
    """Largest rms error of any channel, the worst reading, and the number of simulated rows if some failed."""
    non_empty = [e for e in errors.values() if e["rows"]]
    if not non_empty:
        return "no row can be simulated"
    rms, worst, rows = (max(float(e[name]) for e in non_empty) for name in ("rms_percent", "max_percent", "rows"))
    reached = f" ({rows:.0f} of {total} rows simulated)" if rows < total else ""
    return f"rms error ≤ {rms:.1f} %, worst {worst:.1f} %{reached}"


def largest_share(result: DiscoveryResult) -> str:
    """The reading with the largest share of the remaining misfit. Empty if that share is below `SHARE`."""
    readings, runs = result.readings_of_rows, result.runs
    after = readings.after if result.written else readings.before
    squares = np.where(result.included[:, None], ((after - readings.measured) / readings.sd) ** 2, np.nan)
    total = float(np.nansum(squares))
    if not total > 0 or (share := 100 * float(np.nanmax(squares)) / total) < SHARE:
        return ""
    row, k = np.unravel_index(int(np.nanargmax(squares)), squares.shape)
    columns = {c: runs[c][row] for c in ("configuration", *runs.axes) if runs.has(c)}
    conditions, label = _conditions(columns), result.channels[k].label
    return f"Row {result.numbers[row]} ({conditions}): its {label} causes {share:.0f} % of the remaining misfit"


def _conditions(columns: Mapping[str, str | float]) -> str:
    """Conditions of a run by column: `6T2A, 33 V, 20 deg`."""
    return ", ".join(str(x) if isinstance(x, str) else f"{x:g} {c.rpartition('_')[2]}" for c, x in columns.items())


#: Smallest share of the remaining misfit for which a reading is reported [%].
SHARE = 10.0


def _begun_from(robot_name: str) -> str:
    return f" from {robot_name}" if robot_name else ""


def proposed_header(result: DiscoveryResult, robot_name: str) -> str:
    """Header of the proposed robot's file."""
    return f"found by the loop{_begun_from(robot_name)} with {result.runs.source}: {result.statement}"


def refit_header(result: DiscoveryResult, robot_name: str) -> str:
    """Header of the refitted robot's file."""
    return f"fitted by the loop{_begun_from(robot_name)} to {result.runs.source}, with no effect added"


#: Sentence if there is no formula.
NO_FORMULA = "no single term explains 90 % of the curve"

# --- support of names -----------------------------------------------------------------------------------

#: Reasons for or against names.
REASONS = {
    "": "",
    "implausible": "every effect that explains it has an implausible size",
    "larger": "{effects} would explain more, at an implausible size",
    "better curve": "a {curves} explains the data better than {effects}",
    "curve alone": "a single {curves} leaves no significant misfit",
    "none by itself": "{lost}",
    "beside": "each effect explains more than chance: {strengths}",
}


def support_reasons(support: loop_notes.NameSupport | None) -> str:
    """Reasons for or against the names, empty for none."""
    if support is None:
        return ""
    return REASONS[support.why].format(
        effects=" and ".join(support.effects),
        curves=" and ".join(map(_curve, support.curves)),
        strengths=", ".join(map(_score_words, support.tests)),
        lost="; ".join(f"{t.effect} {effect_doubts(t)}" for t in support.tests if t.fails),
    )


def naming_reasons(result: DiscoveryResult) -> str:
    """Reasons for or against the names. A curve that explains everything comes first."""
    reasons, discrepancy = support_reasons(result.support), result.unnamed
    if discrepancy is None or not result.adequate_after or (result.support is not None and result.support.curves):
        return reasons
    placed_curve = loop_notes.PlacedCurve(discrepancy.place, (discrepancy.variable,))
    return "; ".join([REASONS["curve alone"].format(curves=_curve(placed_curve)), *[reasons] * bool(reasons)])


def _score_words(test: loop_notes.NameTest) -> str:
    """Score of an effect, with the threshold of chance and the score without its strongest row."""
    less = ""
    if test.changed:
        less = f", {_changed_constant(test.changed, test.row)} explains {test.root_changed:.1f} σ"
    elif test.row is not None:
        less = f", and {test.root_without:.1f} σ remain without row {test.row}"
    return f"{test.effect} scores {test.root:.1f} σ (chance alone reaches {test.needed:.1f} σ{less})"


#: Evidence against a single effect.
DOUBTS = {
    "chance": "explains {0.root:.1f} σ{beside}, where chance alone reaches {0.needed:.1f} σ",
    "curve": "explains less than a smooth curve in its place",
    "row": "depends on row {0.row} alone",
    "run": "explains no more than {changed} ({0.root_changed:.1f} σ)",
    "blocks": "is chosen by only {again:.0f} % of the fits without one block",
    "larger": "explains less than {larger} at an implausible size",
    "remains": "leaves an error in its own equation",
    "form": "changes in size{spread} over {over_variable} ({0.varies:.1f} σ)",
    "noise": "is only {0.offset:.1%} of readings of unknown noise (--noise)",
}


def effect_doubts(test: loop_notes.NameTest | None) -> str:
    """Reasons against an effect, empty for none."""
    if test is None or not test.fails:
        return ""
    curves = ", ".join(_place_over(c.place, *c.variables) for c in test.curves)
    doubts = {
        "beside": curves and f" next to smooth curves ({curves})",
        "larger": " and ".join(test.larger),
        "changed": _changed_constant(test.changed, test.row),
    }
    doubts |= {"over_variable": bases.variable_in_words(test.over)}
    doubts["spread"] = f" by ±{100 * test.spread:.0f} %" if math.isfinite(test.spread) else ""
    *first, last = [DOUBTS[d].format(test, **doubts, again=100 * test.again) for d in test.fails]
    return f"{', '.join(first)} and {last}" if first else last


def _curve(c: loop_notes.PlacedCurve) -> str:
    if bases.window_from_name(c.variables[0]) is not None:
        return f"constant in the {bases.place_in_words(c.place)} {variable_showing_discrepancy(c.variables[0])}"
    return f"smooth {'curve' if len(c.variables) == 1 else 'surface'} in the {_place_over(c.place, *c.variables)}"


def _place_over(place: str, *variables: str) -> str:
    """`slip balance over motor speed and slope`."""
    return f"{bases.place_in_words(place)} over {' and '.join(map(bases.variable_in_words, variables))}"


def support_sentence(result: DiscoveryResult) -> str:
    """Sentence on the support of names, empty without one."""
    if not result.standing:
        return ""
    if result.verdict in WITHOUT_NAME:
        return f"Why no name: {result.standing}."
    return f"{result.standing[0].upper()}{result.standing[1:]}."


#: Reasons why an effect is not plausible.
RULED_OUT = {
    "power": "{0.name} would supply power",
    "size": "{0.name} would have {0.size:.2g} times its largest plausible size, so check {check}",
    "edge": "{0.name} is within one sd of its largest plausible size",
}


def why_ruled_out(reasons: Sequence[loop_notes.RuledOut]) -> str:
    """Reason why each effect is not plausible."""
    return "; ".join(RULED_OUT[r.why].format(r, check=" and ".join(r.check)) for r in reasons)


# --- other findings -------------------------------------------------------------------------------------


def moved_parameter(name: str, value: float, stated: float, unit: str, shift: float) -> str:
    """`motor.friction_viscous is 1.2e-05 N·m·s, 3 times the stated value 4e-06 (+2.3 prior sds)`."""
    ratio = f"{value / stated:.2g} times the " if stated and value / stated > 0 else ""
    now = freed_value(loop_notes.AlternativeValue(f"`{name}`", value, unit))
    return f"{now}, {ratio}stated value {stated:.3g} ({shift:+.1f} prior sds)"


def effect_amplitude(e: FoundEffect) -> str:
    """Amplitude of an effect: `-0.0154 ± 0.00014`, with its unit where it has one."""
    amplitude = e.parameters["amplitude"]
    return f"{amplitude.value:.3g} ± {amplitude.sd:.2g} {amplitude.unit}".rstrip(" -")


def indistinguishable_effects(result: DiscoveryResult, e: FoundEffect) -> str:
    """Effects and stated values that these data do not distinguish from an effect."""
    settled = [x.name for x in effects.ALL if x.settles_to in e.members and not result.runs.sampled]
    others = ", ".join(
        [
            name
            + (f" (at {size:.2g} times its largest plausible size)" if (size := e.members[name].size) >= 1 else "")
            for name in in_order_of_parts(list(e.members)[1:])
        ]
        + [f"{name} (only time histories can tell)" for name in settled if name not in e.members]
    )
    values = " or ".join(
        f"{freed_value(loop_notes.AlternativeValue(name, s.value, s.unit))} "
        f"(stated value {s.stated:.3g}, {s.prior_sds:+.1f} sds)"
        for name, s in e.stated.items()
    )
    return ", or ".join(words for words in (others, values) if words)


def rising_errors_sentence(worse: Sequence[WorseChannel], predicted: Mapping[str, tuple[int, int]]) -> str:
    """Sentence on errors that rise and on rows that are no longer predicted, empty for none.

    Args:
        predicted: kind of block → rows that are predicted before and after.
    """
    parts = []
    for kind, (before, after) in predicted.items():
        worse_of_kind = [w for w in worse if w.kind == kind]
        changes = [
            f"{channels.find_channel(w.channel).label} {_two_numbers(w.before, w.after)} %" for w in worse_of_kind
        ]
        if worse_of_kind:
            changes[-1] += f" (same {min(w.rows for w in worse_of_kind)} rows)"
        if before > after:
            changes.append(f"{count_noun(before - after, 'row')} can no longer be predicted")
        if changes:
            parts.append(f"by {blocks.kind_in_words(kind)} {', '.join(changes)}")
    return f"Predictions of held-out rows get worse: {', and '.join(parts)}." if parts else ""


def _two_numbers(before: float, after: float) -> str:
    """Two numbers with the fewest digits that show their difference."""
    texts = [(f"{before:.{k}f}", f"{after:.{k}f}") for k in range(1, 6)]
    return " → ".join(next((pair for pair in texts if pair[0] != pair[1]), texts[-1]))


# --- remarks --------------------------------------------------------------------------------------------


def noise_in_words(noise: SeriesNoise) -> str:
    """An estimated sd: `0.055 A and 1.3 % of the reading`."""
    parts = [
        f"{noise.floor / noise.channel.factor:.2g} {noise.channel.unit}" if noise.floor or not noise.share else "",
        f"{100 * noise.share:.2g} % of the reading" if noise.share else "",
    ]
    step = math.sqrt(12) * noise.least / noise.channel.factor
    display = f" (display resolution {step:.2g} {noise.channel.unit})" if noise.least > noise.floor else ""
    return " and ".join(filter(None, parts)) + display


def noise_from_series(noise: tuple[SeriesNoise, ...]) -> str:
    """Channels whose sds are estimated along series."""
    parts = [f"{s.channel.label} {noise_in_words(s)}" for s in noise]
    along = dict.fromkeys(f"{s.count} series of {s.axis}" for s in noise)
    freedom = min(s.freedom for s in noise)
    return (
        f"the noise of {', '.join(s.channel.name for s in noise)} is not given: {', '.join(parts)} are estimated "
        f"along {' and '.join(along)} ({freedom:.1f} degrees of freedom). Set yours with --noise"
    )


def copied_rows(rows: tuple[int, ...]) -> str:
    """Rows that copy earlier ones."""
    if len(rows) == 1:
        return f"row {rows[0]} is an exact copy and counts once"
    return f"rows {', '.join(map(str, rows))} are exact copies and count once"


#: Reasons why rows do not count.
UNUSED = {
    "unusable": "are not used: the fit slides or fails there",
    "outliers": "are outliers that no effect explains",
}


def imposed_delay(delay: float, sd: float, ends: bool = False) -> str:
    """Delay of the imposed quantity, and the line for the rig's file. `ends`: it is a tenth of a run or more."""
    why = "no longer delay is searched. Check the columns' clocks"
    return (
        f"the imposed quantity acts {1e3 * abs(delay):.3g} ± {1e3 * sd:.2g} ms "
        f"{'later' if delay > 0 else 'earlier'} than its column states, and "
        f'{why if ends else "the rig file gives no delay"}. To start from it, set [rig] delay = "{delay:.3g} ± '
        f'{sd:.2g}"'
    )


#: Reason why a log does not show the states of its equations → sentence part, and what to log.
UNSHOWN = {
    "motion": ("no channel reads a speed or an angle", "one"),
    "sign": ("an instrument shows no sign", "it"),
    "slack": ("motor and load move apart", ""),
    "turn": ("the robot turns", ""),
    "goal": ("a controller gives the voltage", "the duty"),
    "follower": ("no channel follows the imposed speed", "the current"),
}


def sentence_on_single_run(
    test: loop_notes.NameTest,
    conditions: Mapping[str, str | float] = MappingProxyType({}),
    axis: str = "",
    beside: tuple[float, ...] = (),
) -> str:
    """Sentence on an effect that depends on one row."""
    conditions_words = _conditions(conditions)
    row = f"row {test.row}{f' ({conditions_words})' * bool(conditions_words)}"
    others = (
        f"add runs at {axis} {' and '.join(f'{x:g}' for x in beside)}" if beside else "add runs on either side of it"
    )
    return (
        f"{test.effect} depends on row {test.row} alone ({test.root:.1f} σ with it, "
        f"{test.root_without:.1f} σ without). Repeat {row}, and {others}"
    )


#: Code of a remark → a sentence with its values, or a function that makes one.
SAID: dict[str, str | Callable[..., str]] = {
    "assumed_noise": "no noise is given for {channels}: {usual} is assumed. Set yours with --noise",
    "noise_from_series": noise_from_series,
    "refit_worse": (
        "{channel}: the refit increased its error ({stated:.0%} → {refit:.0%} of the measured rms), so the {word} "
        "noise is wrong. State it with --noise"
    ),
    "copies": copied_rows,
    "kept_out": lambda rows, why: f"rows {', '.join(map(str, rows))} {UNUSED[why]}",
    "still_lacks": lambda place, variable: (
        f"the {bases.place_in_words(place)} still has an error, which varies with the "
        f"{bases.variable_in_words(variable)}"
    ),
    "late": imposed_delay,
    "unshown": lambda source, why: (
        f"{source}: effects are simulated, in minutes, because {UNSHOWN[why][0]}"
        + f". Log {UNSHOWN[why][1]} for a fast answer" * bool(UNSHOWN[why][1])
    ),
    "lost_replicates": "only {settled} of {asked} bootstrap tables were refitted",
    "outstanding": lambda factors, word: (
        f"no time was left to test the verdict with {' and '.join(f'{f:g}' for f in factors)} times the "
        f"{word} noise. Run it without --within"
    ),
    "too_few_replicates": "{settled} bootstrap tables are too few. Use --replicates 500",
    "rests_on": sentence_on_single_run,
    "run_differs": lambda test: (
        f"{_changed_constant(test.changed, test.row)} explains {test.root_changed:.1f} σ, {test.effect} "
        f"{test.root:.1f} σ. Check or repeat that run"
    ),
    "contradicted": (
        "a simulation explains {gained:.0%} of the misfit, the equations {promised:.0%}, so the claim is one level "
        "lower"
    ),
    "unwritten": lambda curve, gain, se: (
        f"{'the curve' if curve else 'the proposed model'} predicts held-out runs "
        f"{'no better' if curve and gain > 0 else 'worse'} than the refit (log likelihood {gain:+.2f} ± {se:.2f} per "
        "reading), so robot.toml is the refit"
    ),
}
