"""Sentences about a sensitivity study."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from mmrjax.errors import count_noun

if TYPE_CHECKING:
    from calibration.sensitivity.result import OperatingPoints, SensitivityResult

#: Meaning of each method's result for an input.
METHODS = {
    "local": "exact derivatives at the robot's own values",
    "sobol": "shares of the variance, of each input alone and with others",
    "morris": "screening by elementary effects",
}


#: Method → verb, measure and qualification of an input's share; others measure shares of the variance.
_CAUSES = {
    "local": ("causes", "variance", " (to first order)"),
    "morris": ("has", "squared effects", ""),
}


def input_in_words(found: SensitivityResult, name: str) -> str:
    """An input in words: its meaning without symbols' sources, and its configuration. The name of an effect's."""
    if name.startswith("effects.") or not found.inputs[name].meaning:
        return name
    words = re.split(r"[,;:] | \(", found.inputs[name].meaning)[0]
    part = name.partition(".")[0]
    return f"{words} ({part})" if part in set(map(str, found.points.configuration)) else words


def sensitivity_statement(found: SensitivityResult) -> str:
    """Inputs that matter most for each output, with their operating points."""
    leaders = found.leaders()
    if not leaders:
        return "No input changes any of these outputs."
    verb, measure, note = _CAUSES.get(found.method, ("causes", "variance", ""))
    input_words = "; ".join(
        f"{input_in_words(found, name)} {verb} {100 * outputs[0][1]:.0f} % of the {measure} of {outputs[0][0]}"
        + "".join(f", {100 * share:.0f} % of {label}" for label, share in outputs[1:])
        for name, outputs in sorted(leaders.items(), key=lambda item: -len(item[1]))
    )
    points_words, idle = points_studied(found), len(found.negligible)
    return f"{points_words}: {input_words}{note}. " + (
        f"{idle} of {len(found.inputs)} inputs do not matter." if idle else "Every input matters somewhere."
    )


def points_studied(found: SensitivityResult) -> str:
    """`At 12 of 18 operating points (20° left out, where the robot does not travel)`."""
    total = len(found.points)
    parts = {o.studied.tobytes(): o.studied for o in found.outputs.values() if not o.studied.all()}
    if not parts:
        return f"At {count_noun(total, 'operating point')}"
    why = "the robot does not travel" if found.method == "local" else "too many sampled robots do not travel there"
    fewest = min(int(x.sum()) for x in parts.values())
    if len(parts) > 1:
        return f"At {fewest} to {total} of {total} operating points, by output (others are left out, because {why})"
    (studied,) = parts.values()
    labels = [o.row.label for o in found.outputs.values() if o.studied.all()]
    rest = f", but all {total} for {', '.join(labels)}" if labels else ""
    left_out = _points_in_words(found.points, ~studied)
    return f"At {fewest} of {total} operating points ({left_out} left out, because {why}{rest})"


def _points_in_words(points: OperatingPoints, mask: np.ndarray) -> str:
    """Points of a mask by the values of one axis, such as `20° and 18 more`."""
    _, imposed, unit = points.imposed
    axes = [(x, u) for _, x, u in points.ground[::-1]] + [(imposed, f" {unit}"), (points.configuration, "")]
    most, words = 0, ""
    for x, symbol in axes:
        values_inside = np.setdiff1d(x[mask], x[~mask])
        covered = int(np.isin(x, values_inside).sum())
        if covered > most:
            most, words = covered, f"{', '.join(f'{v:g}' if symbol else str(v) for v in values_inside)}{symbol}"
    other_count = int(mask.sum()) - most
    return " and ".join(
        [words] * bool(words) + [f"{other_count} more" if words else str(other_count)] * bool(other_count)
    )


#: Code of a remark → a sentence with its values, or a function that makes one.
SAID: dict[str, str | Callable[..., str]] = {
    "sampling": lambda method, points: f"{METHODS[method]}, over {points} operating points",
    "points_left_out": lambda points, total, sampled, outputs: (
        f"{points} of {total} operating points are left out, since "
        f"{'too many sampled robots do' if sampled else 'the robot does'} not travel there "
        f"({', '.join(outputs)})"
    ),
    "sample_left_out": lambda points, share, outputs: (
        f"at {points} operating points up to {100 * share:.1f} % of the sample does not travel and is left out "
        f"({', '.join(outputs)})"
    ),
    "inert": "these inputs are not sampled, because no output depends on them: {inputs}",
    "tied": "these inputs scale with another, whose share includes theirs: {inputs}",
}
