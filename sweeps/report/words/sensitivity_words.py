"""Sentences about a sensitivity study."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from calibration.sensitivity import sensitivity_notes

if TYPE_CHECKING:
    from calibration.sensitivity.result import SensitivityResult

#: What each method says of an input.
METHODS = {
    "local": "exact derivatives at the robot's own values",
    "sobol": "shares of the variance, alone and with others",
    "morris": "screening by elementary effects",
    "derivative": "bounds of those shares from exact gradients",
    "shapley": "shares of the variance of correlated inputs",
}


def statement(found: SensitivityResult) -> str:
    """Inputs that matter most for each output."""
    leaders = {
        name: [f"{label} ({100 * share:.0f} %)" for label, share in outputs]
        for name, outputs in found.leaders().items()
    }
    if not leaders:
        return "None of these inputs changes any of these outputs."
    ordered = sorted(leaders.items(), key=lambda item: -len(item[1]))
    said = "; ".join(f"{name} matters most for {', '.join(what)}" for name, what in ordered)
    idle = len(found.negligible)
    return f"{said[0].upper() if said[0].islower() and '.' not in said.split(' ')[0] else said[0]}{said[1:]}; " + (
        f"{idle} of {len(found.inputs)} inputs do not matter." if idle else "every input matters somewhere."
    )


def sampling(note: sensitivity_notes.Sampling) -> str:
    """Distribution of the inputs that a method samples."""
    return f"{METHODS[note.method]}, over {note.points} operating points"


def points_left_out(note: sensitivity_notes.PointsLeftOut) -> str:
    """Points that are left out."""
    who = "too many robots of the sample do" if note.sampled else "the robot does"
    return (
        f"{note.points} of {note.of} operating points are left out, since {who} not travel there "
        f"({', '.join(note.outputs)})"
    )


def sample_left_out(note: sensitivity_notes.SampleLeftOut) -> str:
    """Operating points with part of the sample left out."""
    return (
        f"at {note.points} operating points up to {100 * note.share:.1f} % of the sample is left out, since the "
        f"robot does not travel there: the indices are of robots that do ({', '.join(note.outputs)})"
    )


def inert(note: sensitivity_notes.Inert) -> str:
    """Inputs with only zero derivatives."""
    names = ", ".join(note.inputs)
    if note.correlated:
        return (
            "every derivative by them is exactly zero where one was taken, so that what effect they have is that of "
            f"inputs they are correlated with: {names}"
        )
    return f"not sampled, since every derivative by them is exactly zero where one was taken: {names}"


#: Kind of note → a sentence with its fields, or a function that makes one.
SAID: dict[type, str | Callable[[Any], str]] = {
    sensitivity_notes.Sampling: sampling,
    sensitivity_notes.PointsLeftOut: points_left_out,
    sensitivity_notes.SampleLeftOut: sample_left_out,
    sensitivity_notes.Inert: inert,
    sensitivity_notes.Tied: "kept at their ratio to another input, and part of what it does: {inputs}",
}
