"""Remarks on a study, as data. `mmrjax.describe` makes their sentences."""

from __future__ import annotations

from calibration.inference.fit_notes import Note


class Sampling(Note):
    """A method that goes over so many operating points now."""

    method: str
    points: int


class PointsLeftOut(Note):
    """Operating points of outputs that are left out, of how many: the robot does not travel there, or too many of the
    sample do not."""

    points: int
    of: int
    sampled: bool
    outputs: tuple[str, ...]


class SampleLeftOut(Note):
    """Operating points of outputs at which up to a share of the sample does not travel, and is left out."""

    points: int
    share: float
    outputs: tuple[str, ...]


class Inert(Note):
    """Inputs by which every derivative is zero: they are not sampled, or they are `correlated` with others."""

    inputs: tuple[str, ...]
    correlated: bool


class Tied(Note):
    """Inputs that are kept at their ratio to another one."""

    inputs: tuple[str, ...]
