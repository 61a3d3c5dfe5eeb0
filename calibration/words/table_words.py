"""Sentences about a table before any fit, and about the settled runs of a log."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

from calibration.data import Names
from calibration.data.input_errors import rows_text
from calibration.data.settling import RATES, REASONS, Settled, Stretch
from mmrjax.errors import count_noun

#: Measurements that determine a parameter which the data do not, by the start or end of its name.
WOULD_MEASURE = {
    "battery.": "runs on the battery (Source Mode 1)",
    "motor.inductance": "the starting current, sampled every 0.1 ms",
    "motor.inertia": "a history of the start",
    ".inertia": "a history of the start",
    "motor.resistance_thermal": "long runs at high current and the effect winding_heating",
    "motor.temperature_ambient": "several room temperatures and the effect winding_heating",
    ".friction.dynamic": "a history with movers faster than V_d",
    ".friction.speed_dynamic": "a history with movers faster than V_s",
    ".guide_share": "the fidelities steady and drive (in track, fit guide_friction)",
    ".mass": "a scale, or runs without total_mass_kg",
}
#: Losses that data do not distinguish without variation of a condition.
ALIKE = {
    "guides": "rolling resistance, guide friction and Coulomb losses",
    "slope": "rolling resistance and Coulomb losses",
    "voltage": "constant and speed-dependent losses",
    "speed": "constant and speed-dependent losses",
}


def would_measure(name: str) -> str:
    """Runs or an instrument that would measure a parameter that these data do not."""
    for key, meaning in WOULD_MEASURE.items():
        if name.startswith(key) or name.endswith(key):
            return meaning
    return "conditions in which it has an effect"


def differing_repeats(
    source: str,
    rows: tuple[int, int],
    column: str,
    values: tuple[float, float],
    apart: str,
    unused: Names = (),
    more: int = 0,
    near: str = "",
) -> str:
    """Sentence on two rows whose readings differ under the same conditions."""
    (first, second), (one, other) = rows, values
    finding = (
        f"{source} rows {first} and {second}, {column}: the same conditions gave {one:g} and {other:g}, {apart} "
        f"apart{f' (and {more} more such pairs)' * bool(more)}"
    )
    if unused:
        advice = f'set [columns] {near} = "{unused[0]}"' if near else "name it under [columns]"
        return f"{finding}. {_unused(unused)}. So {advice}, or give each level of a load a configuration"
    wrong = f"{finding}. Remove the wrong row"
    return f"{wrong}, or find what changed between them" if more else wrong


def _unused(names: Sequence[str]) -> str:
    vary, are = ("vary", "are") if len(names) > 1 else ("varies", "is")
    return f"{', '.join(names)} {vary} from row to row and {are} not used"


def unused_columns(source: str, columns: tuple[tuple[str, str], ...]) -> str:
    """Sentences on columns that vary and are not used, and on the quantity that each may be."""
    sentences = [f"{source}: {_unused([name for name, _ in columns])}"]
    for name, near in columns:
        if near:
            sentences.append(f'If {name} is {near}, set [columns] {near} = "{name}" in the robot\'s file')
    return ". ".join(sentences)


def nothing_varies(source: str, rows: int, column: str, unused: Names = ()) -> str:
    """Sentence on runs that differ only by noise, and advice."""
    advice = f"{_unused(unused)}. Name conditions under [columns], or "
    record = f"{'r' if unused else 'R'}ecord runs at several values of {column} or at several loads"
    return f"{source}: these {rows} runs differ only by noise. {advice * bool(unused)}{record}"


def copied_channel(source: str, column: str, other: str, intercept: float, slope: float, tied: bool) -> str:
    """Sentence on a channel that is a linear function of another channel."""
    start = f"{intercept:.4g} {'+' if slope >= 0 else '-'} " if intercept else ""
    factor = abs(slope) if intercept else slope
    sentence = f"{source}, {column}: equals {start}{factor:.4g} times {other} in every row, to the last digit"
    if tied:
        return f"{sentence}. If it is computed, remove it: it would count twice"
    return f"{sentence}, so it is computed. Measure or remove it"


def _runs(names: Names, one: str, several: str) -> str:
    return f"run {names[0]} {one}" if len(names) == 1 else f"runs {', '.join(names)} {several}"


def inherited_priors(part: str, changed: tuple[tuple[str, float, float], ...], kept: Names) -> str:
    """Sentence on a part with changed values that keeps the nominal robot's priors of friction."""
    changes = ", ".join(f"{name} {value:g} instead of {nominal:g}" for name, value, nominal in changed)
    return (
        f"the {part} differs from the nominal robot's ({changes}), but {', '.join(kept)} still "
        f"{'has' if len(kept) == 1 else 'have'} the nominal robot's prior. Set yours with --prior"
    )


def sentence_on_implausible_readings(
    column: str, unit: str, factor: float, units: Names, others: Names, imposed: str
) -> str:
    """Sentence on readings that no similar robot gives."""
    ratio, size = (factor, "large") if factor > 1 else (1 / factor, "small")
    subject = f"{column}: about {float(f'{ratio:.2g}'):g} times too {size} for this robot"
    shared = f"; the same factor in {' and '.join(others)}: check {imposed} and the robot's file" if others else ""
    if units:
        return f"{subject}; are they in {' or '.join(units)}? expected {unit}{shared}"
    return f"{subject}{shared}" if others else f"{subject}; check the unit, {unit}, {imposed} and the robot's file"


#: Reasons for fitting the settled runs of a log.
NOT_OVER_TIME = {"sides": "a log of two sides is not fitted over time", "unfitted": "no fit over time converges"}

#: Code of a remark → a sentence with its values, or a function that makes one.
SAID: dict[str, str | Callable[..., str]] = {
    "unmeasured": lambda name: f"{name} keeps its prior value. These data lack {would_measure(name)}",
    "constant": lambda column, value, alike: f"{column} is {value:g} in every row, so {ALIKE[alike]} look the same",
    "repeats": differing_repeats,
    "larger_noise": (
        "{channel}: {pairs} pairs of repeats scatter {factor:.2g} times the {source} noise, so its sd is "
        "multiplied by this. Check them, or set --noise"
    ),
    "unused": unused_columns,
    "no_load_gives": (
        "{source}, {theirs}: the load's friction and torque leave {share:.0%} of its variance unexplained. If a "
        'brake sets it, set [columns] load_torque_Nm = "{theirs}", and remove the channel output_torque'
    ),
    "nothing_varies": nothing_varies,
    "copied": copied_channel,
    "turned": (
        "{source}, {theirs}: its rms error is {off:.2g}, but {turned:.2g} with the opposite sign. To reverse it, "
        'set [columns] {column} = {{column = "{theirs}", factor = -1}}'
    ),
    "stiff_supply": (
        "{column} is {value:g} in every row, so the supply counts as stiff. If it is not measured, remove it"
    ),
    "lost_motion": lambda source, column, reversals, width, unit, angle, stiffness: (
        f"{source}, {column}: "
        + (
            f"the output lags the motor by {width:.2g} {unit} rms in proportion to its acceleration, as with a "
            f'compliant coupling. Set damping and stiffness = "{stiffness:.2g} ± 50 %" (N·m/rad'
            if stiffness
            else (
                f"at each of {reversals} reversals about {width:.2g} {unit} of motion is lost, as by backlash. "
                f'Set backlash = "{angle:.2g} ± 30 %" (rad'
            )
        )
        + " at the output) in the load's table"
    ),
    "ends_early": lambda runs, lasts, share: (
        f"{_runs(runs, 'ends', 'end')} after {lasts:.2g} s at the latest"
        f"{'' if math.isnan(share) else f', at {share:.0%} of the steady speed'}, before the speed is steady, so "
        "only priors determine the resistance to travel. Record longer"
    ),
    "never_grips": lambda runs, share: (
        f"{_runs(runs, 'slides', 'slide')} to the end, at {share:.0%} of the speed of the tracks or wheels. This "
        "does not show static friction"
    ),
    "thinned": (
        "{source}: the fit uses {kept} of {rows} rows, evenly spaced in time. Change this with --rows, or use settle"
    ),
    "settled_runs": lambda source, why, runs, lasts: (
        f"{source}: {NOT_OVER_TIME[why]}, so the fit uses its settled runs ({runs}, {lasts:.3g} s in all), "
        "which show no inertias, delays or start"
    ),
    "few_points": (
        "{source}: a log of two sides is not fitted over time, and its settled runs ({runs}, {lasts:.3g} s in all) "
        "have only {points} operating points. Hold {needed} or more levels until all readings are steady for "
        "{each:.2g} s. For straight travel, give one command"
    ),
    "thinned_table": ("{source}: {kept} of {rows} rows are used and numbered anew. Change this with --rows"),
    "coarse_steps": lambda lasts, step: (
        f"runs of {lasts:.0f} s are simulated in steps of {1e3 * step:.0f} ms. To resolve ripple with a "
        "shorter period than ten steps, use shorter runs"
    ),
    "stops_on_slope": (
        "run {runs}: the motors are not driven on a slope. The simulated robot creeps there at a few mm/s. "
        "Leave out rows at rest if they matter"
    ),
    "inherited_priors": inherited_priors,
    "off_by": sentence_on_implausible_readings,
    "slopes_in": (
        "slope_deg: the current rises {rise:.2g} times as fast with the slope as for this robot; are slopes in "
        "{unit}? expected degrees"
    ),
}


#: Reasons that do not apply where the log itself is fitted, and the advice then.
OF_LEVELS = ("changes", "short", "settling", "accelerates")


def omitted_stretches(stretches: Iterable[Stretch], few: bool = False) -> list[tuple[str, int, int, str, str]]:
    """For each reason: its words, its numbers of stretches and samples, rows of the longest stretch, and advice.

    Args:
        few: the log itself is to be fitted, as it has too few settled runs.
    """
    rows = []
    omitted = [s for s in stretches if s.why]
    for why in dict.fromkeys(s.why for s in omitted):
        stretches_of_reason = [s for s in omitted if s.why == why]
        longest = max(stretches_of_reason, key=lambda s: len(s.rows))
        row_range = f"{longest.rows[0] + 1}-{longest.rows[-1] + 1}"
        cure = "nothing, a fit to the log uses them" if few and why in OF_LEVELS else ", or ".join(REASONS[why][1:])
        rows.append(
            (
                longest.reason,
                len(stretches_of_reason),
                sum(len(s.rows) for s in stretches_of_reason),
                row_range,
                cure,
            )
        )
    return rows


def settle_statement(settled: Settled) -> str:
    """Sentence on the number of settled runs of a log and of their samples."""
    stretches, rows = settled.kept, sum(len(s.rows) for s in settled.kept)
    backward_count = sum(s.imposed < 0 for s in stretches)
    directions = (
        f", {len(stretches) - backward_count} forward and {backward_count} backward" if backward_count else ""
    )
    return (
        f"{count_noun(len(stretches), 'settled run')}{directions}, from {rows} of {len(settled.runs)} samples (each "
        f"at least {settled.shortest:.3g} s long, with means steady to {100 * settled.drift:g} %)."
    )


def levels_and_samples(settled: Settled) -> str:
    """Sentences on the division of a log into levels, and on the samples of a level that count."""
    return (
        f"Neighbouring samples are one level if the imposed quantity differs by less than {50 * settled.drift:g} % "
        f"or its noise. A level counts once every channel stays within {100 * settled.drift:g} % of its last value, "
        "or its noise."
    )


def sentence_on_few_settled_runs(settled: Settled, fewest: int, loop: str) -> str:
    """Advice for a log with too few settled runs, empty if it has enough.

    Args:
        fewest: number of settled runs that the loop needs.
        loop: command that fits the log as it is.
    """
    if len(settled.kept) >= fewest:
        return ""
    if settled.runs.turns:  # over time a turn is simulated, and not fitted
        return f"The loop needs {fewest} settled runs: hold more levels, or each longer."
    return f"The loop needs {fewest} settled runs, so run it on the log: {loop}."


def settle_remarks(settled: Settled) -> list[str]:
    """Sentences on points to check, one each."""
    remarks = []
    if settled.gaps:
        remarks.append(f"samples are missing after {rows_text(settled.gaps, 5)}")
    for channel in (s.channel for s in settled.signals):
        glitch_stretches = [s for s in settled.kept if channel.name in s.glitches]
        if glitch_stretches:
            counts = [s.glitches[channel.name] for s in glitch_stretches]
            worst = glitch_stretches[counts.index(max(counts))]
            remarks.append(
                f"{channel.column}: {count_noun(sum(counts), 'reading')} in "
                f"{count_noun(len(glitch_stretches), 'settled run')} are far from their neighbours and left out of "
                f"the mean, most in rows {worst.rows[0] + 1} to {worst.rows[-1] + 1} "
                f"({100 * max(counts) / len(worst.rows):.2g} %). Check the instrument, or log a mean of pulses"
            )
    angles = {rate: angle for angle, rate, _ in RATES}
    for channel in (s.channel for s in settled.signals):
        if channel not in settled.runs.channels:
            remarks.append(
                f"{channel.column} is the rate of {angles[channel.name]}. To get it, add {channel.name} to the "
                "rig's channels"
            )
    scatter = {name: x for name, x in settled.scatter.items() if x > 0}
    for signal in (s for s in settled.signals if s.channel.name in scatter):
        remarks.append(
            f"{signal.channel.column}: repeated levels differ by {scatter[signal.channel.name]:.2g} "
            f"{signal.channel.unit} beyond their noise, which the sds include"
        )
    return remarks
