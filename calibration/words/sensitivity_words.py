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


def input_in_words(result: SensitivityResult, name: str) -> str:
    """Meaning of an input without symbols and sources, and its configuration. For effects, the name of the input."""
    if name.startswith("effects.") or not result.inputs[name].meaning:
        return name
    meaning = re.split(r"[,;:] | \(", result.inputs[name].meaning)[0]
    configuration = name.partition(".")[0]
    return f"{meaning} ({configuration})" if configuration in set(map(str, result.points.configuration)) else meaning


def sensitivity_statement(result: SensitivityResult) -> str:
    """Inputs that matter most for each output, with their operating points."""
    leaders = result.leaders()
    if not leaders:
        return "No input changes any of these outputs."
    verb, measure, qualification = _CAUSES.get(result.method, ("causes", "variance", ""))
    input_words = "; ".join(
        f"{input_in_words(result, name)} {verb} {100 * outputs[0][1]:.0f} % of the {measure} of {outputs[0][0]}"
        + "".join(f", {100 * share:.0f} % of {label}" for label, share in outputs[1:])
        for name, outputs in sorted(leaders.items(), key=lambda item: -len(item[1]))
    )
    negligible_count = len(result.negligible)
    return f"{points_studied(result)}: {input_words}{qualification}. " + (
        f"{negligible_count} of {len(result.inputs)} inputs do not matter."
        if negligible_count
        else "Every input matters somewhere."
    )


def points_studied(result: SensitivityResult) -> str:
    """`At 12 of 18 operating points (20° left out, where the robot does not travel)`."""
    total = len(result.points)
    masks = {o.studied.tobytes(): o.studied for o in result.outputs.values() if not o.studied.all()}
    if not masks:
        return f"At {count_noun(total, 'operating point')}"
    reason = (
        "the robot does not travel" if result.method == "local" else "too many sampled robots do not travel there"
    )
    fewest = min(int(x.sum()) for x in masks.values())
    if len(masks) > 1:
        return (
            f"At {fewest} to {total} of {total} operating points, by output (others are left out, because {reason})"
        )
    (studied,) = masks.values()
    labels = [o.row.label for o in result.outputs.values() if o.studied.all()]
    exceptions = f", but all {total} for {', '.join(labels)}" if labels else ""
    left_out = _points_in_words(result.points, ~studied)
    return f"At {fewest} of {total} operating points ({left_out} left out, because {reason}{exceptions})"


def _points_in_words(points: OperatingPoints, mask: np.ndarray) -> str:
    """Points of a mask by the values of one axis, such as `20° and 18 more`."""
    _, imposed, unit = points.imposed
    axes = [(x, symbol) for _, x, symbol in points.ground[::-1]] + [(imposed, f" {unit}"), (points.configuration, "")]
    most_points = 0
    words = ""
    for x, symbol in axes:
        values_inside = np.setdiff1d(x[mask], x[~mask])
        covered = int(np.isin(x, values_inside).sum())
        if covered > most_points:
            most_points, words = (
                covered,
                f"{', '.join(f'{v:g}' if symbol else str(v) for v in values_inside)}{symbol}",
            )
    other_count = int(mask.sum()) - most_points
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
