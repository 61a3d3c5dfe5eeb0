"""Sentences about a fit, for the loop and for calibrations, and about feedforward constants."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from calibration.data import Names
from calibration.described import as_paragraph, sentences
from calibration.inference import blocks, fit_notes
from calibration.inference.feedforward import WRONG_UNITS, Feedforward, constant_units
from calibration.inference.identifiability import HELD
from calibration.inference.simulation_errors import root_mean_square
from mmrjax.errors import count_noun
from mmrjax.model import channels


def feedforward_statement(feedforward: Feedforward) -> str:
    """Feedforward constants, each with ± (95 %) and unit."""
    units = constant_units(feedforward.unit)
    constants_words = (
        f"{n} = {x:.4g} ± {1.96 * feedforward.sds[n]:.2g} {units[n]}" for n, x in feedforward.constants.items()
    )
    return ", ".join(constants_words) + "."


#: Ratio of a velocity in a wrong unit to the rate of the position → its unit.
MEANT = dict(
    zip(
        WRONG_UNITS,
        ("per minute", "per second, with a position in minutes", "in radians", "in rotations", "in degrees",
         "in rotations", "in rotations per minute, with a position in radians", "in millimetres",
         "in centimetres"),
        strict=True,
    )
)  # fmt: skip


if TYPE_CHECKING:
    from calibration.inference.lack_of_fit import Adequacy, RelativeError
    from calibration.inference.residual_clusters import ResidualCluster
    from calibration.inference.result import CalibrationResult


#: Meaning of a parameter far from its prior, by the kind of result.
FAR = {
    "loop": "It probably absorbs a missing effect",
    "calibration": "The prior or the model is wrong",
    "edge": "The search ended there. Widen the prior",
}
#: Origin of a prior that is neither from a field nor stated.
PRIORS = {"product": "the prior of its product with the guide share"}


def _error_share(channel: str, share: float) -> str:
    return f"{share:.0%} of the squared error of {channels.find_channel(channel).label}"


def determined_combination(pair: fit_notes.DependentPair) -> str:
    """Combination of two parameters that data determine: `the ratio of a and b`, `a + 0.03 · b`."""
    if pair.form != "linear":
        return f"the {pair.form} of {pair.one} and {pair.other}"
    return f"{pair.one} {'-' if pair.weight < 0 else '+'} {abs(pair.weight):.2g} · {pair.other}"


def is_determined_answer(held: bool, others: tuple[str, ...]) -> str:
    """Answer whether data determine a parameter: `yes`, `no`, or `only with motor.resistance` for both of a pair."""
    if others:
        return f"only with {', '.join(others)}"
    return "no" if held else "yes"


def sentence_on_rows(rows: tuple[int, ...], what: str, share: float = 0.0) -> str:
    """Sentence on rows with a property, and on its consequence."""
    row_words = f"rows {', '.join(map(str, rows))}"
    if what == "limited":
        return (
            f"{row_words} are within {share:.0%} of the adhesion limit. They give a lower bound for static friction, "
            "but their slip is larger than the friction model predicts"
        )
    if what == "jumps":
        return f"{row_words}: the calibrated robot leaves the ground"
    return f"{row_words}: the calibrated robot has the status {what}"


def search_agreement(starts: int, agree: int, elsewhere: int, more: float, open: int) -> str:
    """Sentence on the agreement of searches from several starts."""
    if starts == 1:
        return "one search was made and did not converge" if open else "one search was made"
    if agree == starts:
        return f"all {starts} searches end at one optimum"
    if open == starts:
        return f"none of {starts} searches converged"
    parts = [f"{agree} of {starts} searches end at the best optimum"]
    if elsewhere:
        parts.append(f"{elsewhere} at other optima (the next best is higher by {more:.3g})")
    if open:
        parts.append(f"{open} did not converge")
    return ", ".join(parts)


def search_generations(members: int, generations: int, settled: bool) -> str:
    """Sentences on the size of a search by generations, and on its end."""
    end = "The last one improved no further"
    if not settled:
        end = "The last one still improved: use more --generations"
    return f"{count_noun(members, 'member')} in {count_noun(generations, 'generation')}. {end}"


def distance_from_prior(bound: str, sds: float) -> str:
    """Bound of a parameter, or its distance from the middle of its prior [prior sds]."""
    if bound:
        return f"at its {bound} bound"
    return f"{abs(sds):.1f} prior sd {'below' if sds < 0 else 'above'} its prior's mean"


# --- what residuals show --------------------------------------------------------------------------------


def adequacy_finding_in_words(test: fit_notes.AdequacyFinding) -> str:
    """Result of the most significant test of residuals, in words."""
    whose = f"the residuals of {channels.find_channel(test.channel).label}" if test.channel else ""
    return {
        "": "",
        "stated": "the residuals exceed the stated noise",
        "repeats": "the residuals exceed the scatter of repeats",
        "follow": f"{whose} depend on {test.variable}",
        "remember": f"{whose} show autocorrelation",
    }[test.what]


#: Verdict on a model with large errors.
UNDESCRIBED = "this model does not describe these runs"
#: Reasons why no test of residuals decides on the adequacy of a fit.
OBSTACLES = {
    "undescribed": f"{UNDESCRIBED.capitalize()}: {{large}}. Check units, signs and unused columns first",
    "not converged": "No verdict: the search did not converge ({every})",
    "worse": "Not adequate: its errors exceed those of the robot file ({every})",
}


def _relative_errors(errors: Sequence[RelativeError]) -> str:
    """`total current 74 % of its measured rms (32 % with the file as given)`."""
    miss_words = [
        f"{channels.find_channel(m.channel).label} {_percent(m.fitted)} of its measured rms ({_percent(m.as_stated)} "
        "before the fit)"
        for m in errors
    ]
    return ", ".join(miss_words)


def _percent(share: float) -> str:
    return f"{100 * share:.{0 if share > 0.1 else 1}f} %"


def adequacy_verdict(adequacy: Adequacy) -> str:
    """Verdict on the adequacy of a fit."""
    if adequacy.obstacle:
        large = "it misses " + _relative_errors([m for m in adequacy.misses if m.large])
        return OBSTACLES[adequacy.obstacle].format(large=large, every=_relative_errors(adequacy.misses))
    chi2 = f"χ² {adequacy.chi2:.4g} on {adequacy.degrees_of_freedom:.4g} degrees of freedom"
    if adequacy.adequate is None or adequacy.p_value is None:
        return (
            "Adequacy cannot be tested: noise was estimated from the misfit "
            f"({adequacy.degrees_of_freedom:.4g} degrees of freedom). State it with --noise"
        )
    p = f"p = {adequacy.p_value:.2g}" if adequacy.p_value > 1e-6 else "p < 1e-6"
    if not adequacy.adequate:
        evidence = f"{chi2}, {p}" if adequacy.noise_known else f"{p}, with estimated noise"
        return (
            f"Not adequate: {adequacy_finding_in_words(adequacy.shown_by)} ({evidence}), so a term is missing. Run "
            "mmrjax loop to find it"
        )
    if adequacy.noise_known:
        return f"Adequate: the residuals are consistent with the stated noise ({chi2}, {p})"
    return (
        f"Adequate as far as can be tested: the residuals show no structure ({p}). The noise was estimated from them"
    )


#: Verdict of `Adequacy.adequate`, in words.
_VERDICTS: dict[bool | None, str] = {
    True: "The fit is adequate",
    False: "The fit is not adequate",
    None: "Adequacy undecided",
}


def calibration_answer(fit: CalibrationResult) -> str:
    """Answer of a calibration: adequate or not, and rms errors before and after over the rows that have both."""
    channel_errors, rows = list[tuple[str, str]](), dict[str, int]()
    for c in fit.channels:
        readings = fit.readings[c.name]
        is_compared = np.isfinite(readings.measured) & np.isfinite(readings.before) & np.isfinite(readings.after)
        if is_compared.any():
            size = root_mean_square(readings.measured[is_compared])
            before, after = (
                100 * root_mean_square((x - readings.measured)[is_compared]) / size
                for x in (readings.before, readings.after)
            )
            rows[c.label] = int(is_compared.sum())
            channel_errors.append((c.label, f"{c.label} {before:.1f} → {after:.1f} %"))
    if not channel_errors:
        return f"{_VERDICTS[fit.adequacy.adequate]}. No row is predicted before and after the fit."
    same_rows = len(set(rows.values())) == 1
    errors = ", ".join(text + ("" if same_rows else f" ({rows[label]} rows)") for label, text in channel_errors)
    row_words = f"the same {count_noun(max(rows.values()), 'row')}" if same_rows else "the same rows"
    return f"{_VERDICTS[fit.adequacy.adequate]}. The rms error before → after on {row_words}: {errors}."


#: Number of fitted parameters on a terminal, and codes of the remarks that it shows in full.
FEW, TO_CHECK = 4, ("unsettled", "far_from_prior", "after_steps", "shifted", "freed_delay", "residual_cluster")


def brief_calibration(fit: CalibrationResult) -> Names:
    """Lines printed below the answer: adequacy, determined parameters, hold-out errors, and what to check."""
    determined = {name: p for name, p in fit.parameters.items() if not p.held_by_prior}
    first = sorted(determined.items(), key=lambda item: -abs(item[1].shift))[:FEW]
    fitted = [f"{name} {p.value:.3g} ± {p.sd:.2g} {p.unit}".rstrip(" -") + f" ({p.shift:+.1f})" for name, p in first]
    others_text = f", and {len(determined) - FEW} more" * (len(determined) > FEW)
    parameters = (
        f"These runs determine {len(determined)} of {len(fit.parameters)} parameters (shift in prior sds): "
        f"{', '.join(fitted) or 'none'}{others_text}."
    )
    held_out = []
    for kind in list(fit.held_out_alike)[:1]:
        errors = fit.held_out[kind].errors
        percent = [f"{c.label} {errors[c.name].rms_percent:.1f} %" for c in fit.channels if errors[c.name].rows]
        held_out = [f"rms error with each {blocks.kind_in_words(kind)} left out of the fit: {', '.join(percent)}."]
    to_check = sentences(fit_notes.remarks_with_codes(fit.remarks, *TO_CHECK))
    check = f"Check first: {as_paragraph(to_check)} " * bool(to_check)
    others = count_noun(len(fit.notes) - len(to_check), "further remark")
    return f"{fit.adequacy.statement}.", parameters, *held_out, f"{check}--verbose prints tables and {others}."


#: Number of levels of a cluster that are listed, those with the largest means.
LISTED = 6


def residual_cluster(c: ResidualCluster) -> str:
    """Sentences on residuals that depend on a column that the model does not use."""
    subject = f"residuals of {channels.find_channel(c.channel).label}"
    range_ = f" within {c.within}" if c.within else ""
    signs = ", with opposite signs in both directions" if c.reversing else ""
    p = f"p = {c.p:.1g}"
    role = "a column that the model does not use" + (f" (as well by {', '.join(c.alike)})" if c.alike else "")
    if c.correlation is not None:
        return (
            f"{subject} are correlated with {c.column}{range_}{signs} (rank correlation {c.correlation:+.2f}, {p}), "
            f"{role}. Find what changes with it"
        )
    if c.coarser:
        shares = ", ".join(f"{name} alone {share:.0%} of it" for name, share in c.coarser)
        role += f" ({shares})"
    ordered = sorted(c.levels, key=lambda m: -abs(m.mean))[:LISTED]
    mean_levels = [m for m in c.levels if m in ordered]
    level_words = ", ".join(f"{m.name}: {m.mean:+.2g} {c.unit}" for m in mean_levels)
    dots = ", ..." if len(mean_levels) < len(c.levels) else ""
    return (
        f"{subject} differ between the levels of {c.column}{range_}{signs} (simulated minus measured: "
        f"{level_words}{dots}, {p}), {role}. Give each level a configuration, or find what differs"
    )


#: Code of a remark → a sentence with its values, or a function that makes one.
SAID: dict[str, str | Callable[..., str]] = {
    "feedforward_sign": (
        "Velocity and voltage have opposite signs. This fit flips the velocity. Invert one of them in the robot's "
        "code."
    ),
    "feedforward_speed_sign": (
        "Velocity and position have opposite signs. This fit flips the velocity. Invert one of them in the robot's "
        "code."
    ),
    "feedforward_unit": lambda ratio, near: (
        f"The velocity is {ratio:.4g} times the rate of the position: "
        + (f"it is probably {MEANT[near]}" if near else "check gear ratio and wheel size")
        + ". The constants use the position's unit."
    ),
    "feedforward_delay": lambda delay: f"The motion follows the voltage {1000 * delay:.0f} ms late, which is fitted.",
    "feedforward_filter": lambda lag: (
        f"The velocity lags the position by {1000 * lag:.0f} ms, so the position is fitted. Shorten the velocity "
        "filter before you use kP."
    ),
    "feedforward_limit": lambda level, current: (
        f"A current limit acts above {level:.2g} V of accelerating voltage."
        + ("" if current is None else f" The current reaches {current:.3g} A.")
        + " Those windows are left out. Lower the dynamic test's voltage, or raise the limit."
    ),
    "feedforward_skid": lambda level: (
        f"The wheels slip above {level:.2g} V of accelerating voltage. Those windows are left out. Lower the "
        "dynamic test's voltage."
    ),
    "feedforward_direction": lambda forward, backward: (
        f"kS differs by direction: {forward:.3g} V forward, {backward:.3g} V backward, as with a slope, a weight "
        "or a binding gear. WPILib's kS is their mean."
    ),
    "feedforward_sag": lambda rest, low: (
        f"The battery sagged from {rest:.3g} to {low:.3g} V, which makes kA and kV too large. Use setVoltage, or a "
        "fresh battery."
    ),
    "feedforward_missing": "Tests are missing: {tests}.",
    "feedforward_no_kA": lambda share, missing: (
        f"kA is not determined: its 95 % interval is ± {100 * share:.0f} %"
        + (f" ({', '.join(missing)} missing)" if missing else "")
        + ", so there are no feedback gains. Run dynamic tests with more acceleration and a faster log."
    ),
    "feedforward_gains_delayed": lambda delay, slow, prompt: (
        f"A delay of {1000 * delay:.0f} ms reduces the velocity kP from {prompt:.3g} to {slow:.3g}."
    ),
    "held_by_prior": f"these runs do not determine {{names}} (posterior sd above {HELD:g} times the prior sd)",
    "only_together": lambda pairs: (
        "these runs determine only combinations: "
        + ", ".join(f"{determined_combination(p)} (correlation {p.correlation:+.3f})" for p in pairs)
    ),
    "far_from_prior": lambda name, sds, kind: f"{name} is {sds:.1f} prior sds from its mean. {FAR[kind]}",
    "noise_off": lambda channel, factor, source: (
        f"the residuals of {channels.find_channel(channel).label if channel else 'every channel'} are {factor:.2g} "
        f"times the {source} noise. Check the noise"
    ),
    "not_profiled": "intervals are those of a linearized model (--profiles)",
    "no_covariance": "the posterior has no finite covariance. Do not use the intervals",
    "no_grip": "every run slides, so only priors determine static friction",
    "estimated_noise": lambda percent: (
        "noise is estimated from the misfit, which cannot test the model: "
        + ", ".join(f"{channel.replace('_', ' ')} {share:.1f} %" for channel, share in percent)
    ),
    "of_rows": sentence_on_rows,
    "at_bound": "{name} is at its {side} bound",
    "after_steps": lambda channel, share, rows, total: (
        f"{_error_share(channel, share)} lies in the first sample after each step of the command ({rows} of {total} "
        f"rows). Without them, the rms error falls to {100 * (1 - share) ** 0.5:.0f} %. Readings may be late. To fit "
        'this, set [rig] delay = "0 ± 0.02" [s]'
    ),
    "freed_delay": lambda channel, share: (
        f"without a delay, {_error_share(channel, share)} lies in the first sample after each step of the command, "
        "so rig.delay is fitted. To prevent this, set [rig] delay = '0 ± 0'"
    ),
    "shifted": lambda channel, share, shift: (
        f"{_error_share(channel, share)} is explained by readings {abs(1e3 * shift):.2g} ms "
        f"{'late' if shift > 0 else 'early'}. To fit this delay, set [rig] delay = "
        f'"{shift:.2g} ± {max(abs(shift), 0.005):.2g}" [s]'
    ),
    "product_alone": lambda friction, share, free: (
        f"the readings depend only on the product {friction} x {share}, whose factors only priors determine"
        if free
        else f"{share} is fitted with {friction} fixed, because readings depend only on their product"
    ),
    "prior_of_product": (
        "{name} has the prior {mean:.3g} ± {sd:.2g} of its product with the guide share. In the track model the "
        "guides carry {share:.0%} of the weight"
    ),
    "no_prediction": lambda kind, rows, total: (
        f"blocks by {blocks.kind_in_words(kind)}: the errors exclude {rows} of {total} held-out rows, in which "
        "the robot fitted to the other blocks slides"
    ),
    "block_not_converged": "the search without one block of {kind} did not converge",
    "agreement": search_agreement,
    "unsettled": lambda names: (
        "the search ended before it converged, so intervals are unreliable. These data "
        f"{'do not determine ' + ', '.join(names) if names else 'determine all parameters'}"
    ),
    "elsewhere": "{searches} of {total} searches converged at other values of {names}",
    "in_pieces": "{name} has a 95 % interval of {pieces} parts",
    "generations": search_generations,
    "determined": is_determined_answer,
    "edge": distance_from_prior,
    "ended_at_edge": lambda edge: (
        "the search ended at the edge of its range, with "
        + ", ".join(f"{name} {distance_from_prior(**at.values)}" for name, at in edge.items())
    ),
}
