"""Sentences of `settle`: why samples of a log are left out, and what to do."""

from __future__ import annotations

from collections.abc import Iterable

from calibration.data.input_errors import rows_text
from calibration.data.settling import RATES, Settled, Stretch
from mmrjax.errors import count_noun

#: Reasons that do not apply where the log itself is fitted, and the advice then.
OF_LEVELS = ("changes", "short", "settling", "accelerates")
#: Finding and advice for each of `settling.REASONS`.
WHY = {
    "changes": ("the imposed quantity always changes", "hold it at each level for a while"),
    "short": ("the level is held too briefly", "hold it longer, or set a smaller --shortest"),
    "settling": ("still changes at the end of its level", "hold the level longer, or set a larger --drift"),
    "accelerates": ("still accelerates at the end of its level", "hold the level longer, or set a larger --drift"),
    "idle": ("nothing drives the motors", "nothing, settled runs need a driven motor"),
    "rest": ("the drive does not move", "nothing, friction holds the drive"),
    "stuck": (
        "shows one number for a long time: saturated or frozen",
        "repair the instrument or change its range",
    ),
    "glitches": (
        "has many readings far from the others",
        "repair the instrument, or log a mean of pulses",
    ),
    "unread": ("no channel has enough readings", "log more readings, or remove these rows"),
    "undriven": ("the driver brakes or coasts", "nothing, a fit to the log uses them"),
}


def left_out_reason(stretch: Stretch) -> str:
    """Reason why a stretch is left out: `total_current still changes at the end of its level (6.1 %)`."""
    reason = f"{stretch.channel} {WHY[stretch.why][0]}" if stretch.channel else WHY[stretch.why][0]
    return reason + (f" ({100 * stretch.size:.2g} %)" if stretch.size else "")


def omitted_stretches(stretches: Iterable[Stretch], few: bool = False) -> list[tuple[str, int, int, str, str]]:
    """Reasons, each with its stretches, samples, rows of the longest one, and what to do.

    Args:
        few: the log itself is to be fitted, as it has too few settled runs.
    """
    causes = []
    omitted = [s for s in stretches if s.why]
    for why in dict.fromkeys(s.why for s in omitted):
        stretches_of_reason = [s for s in omitted if s.why == why]
        longest = max(stretches_of_reason, key=lambda s: len(s.rows))
        rows = f"{longest.rows[0] + 1}-{longest.rows[-1] + 1}"
        cure = "nothing, a fit to the log uses them" if few and why in OF_LEVELS else WHY[why][1]
        causes.append(
            (
                left_out_reason(longest),
                len(stretches_of_reason),
                sum(len(s.rows) for s in stretches_of_reason),
                rows,
                cure,
            )
        )
    return causes


def settle_statement(found: Settled) -> str:
    """Number of settled runs of a log, and its samples."""
    stretches, rows = found.kept, sum(len(s.rows) for s in found.kept)
    backward_count = sum(s.imposed < 0 for s in stretches)
    ways = f", {len(stretches) - backward_count} forward and {backward_count} backward" if backward_count else ""
    return (
        f"{count_noun(len(stretches), 'settled run')}{ways}, from {rows} of {len(found.runs)} samples (each at least "
        f"{found.shortest:.3g} s long, with means steady to {100 * found.drift:g} %)."
    )


def levels_and_samples(found: Settled) -> str:
    """Division of samples into levels, and the samples of a level that are used."""
    return (
        f"Neighbouring samples are one level if the imposed quantity differs by less than {50 * found.drift:g} % "
        f"or its noise. Its first samples are left out until every channel stays within {100 * found.drift:g} % "
        "of its last value, or its noise."
    )


def sentence_on_few_settled_runs(found: Settled, fewest: int, loop: str) -> str:
    """Sentence for a log with too few settled runs: fit the log itself, empty where it has enough.

    Args:
        fewest: rows that the loop asks for.
        loop: command that fits the log as it is.
    """
    if len(found.kept) >= fewest:
        return ""
    if found.runs.turns:  # over time a turn is simulated, and not fitted
        return f"The loop needs {fewest} settled runs: hold more levels, or each longer."
    return f"The loop needs {fewest} settled runs, so run it on the log as it is: {loop}."


def settle_remarks(found: Settled) -> list[str]:
    """Sentences on what should be looked at."""
    remarks = []
    if found.gaps:
        remarks.append(f"samples are missing after {rows_text(found.gaps, 5)}")
    for channel in (s.channel for s in found.signals):
        glitch_stretches = [s for s in found.kept if channel.name in s.glitches]
        if glitch_stretches:
            counts = [s.glitches[channel.name] for s in glitch_stretches]
            worst = glitch_stretches[counts.index(max(counts))]
            remarks.append(
                f"{channel.column}: {count_noun(sum(counts), 'reading')} in "
                f"{count_noun(len(glitch_stretches), 'settled run')} left out of the mean, far from their "
                f"neighbours. Most are in rows {worst.rows[0] + 1} to {worst.rows[-1] + 1} "
                f"({100 * max(counts) / len(worst.rows):.2g} %). Check the instrument, or log a mean of pulses"
            )
    angles = {rate: angle for angle, rate, _ in RATES}
    for channel in (s.channel for s in found.signals):
        if channel not in found.runs.channels:
            remarks.append(
                f"{channel.column} is the rate of {angles[channel.name]}. Add {channel.name} to channels in the "
                "rig's file to get it"
            )
    wide = {name: x for name, x in found.scatter.items() if x > 0}
    for signal in (s for s in found.signals if s.channel.name in wide):
        remarks.append(
            f"{signal.channel.column}: repeated levels differ by {wide[signal.channel.name]:.2g} "
            f"{signal.channel.unit} more than their noise, which the sds include"
        )
    return remarks
