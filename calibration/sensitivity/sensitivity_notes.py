"""Remarks on a study, as data. `mmrjax.describe` makes their sentences."""

from __future__ import annotations

from calibration.inference.fit_notes import Note


class Sampling(Note):
    """Progress of a method over a number of operating points."""

    method: str
    points: int


class PointsLeftOut(Note):
    """Number of omitted operating points of outputs, and of all: the robot does not travel there, or too much of the
    sample does not."""

    points: int
    of: int
    sampled: bool
    outputs: tuple[str, ...]


class SampleLeftOut(Note):
    """Operating points of outputs where up to a share of the sample does not travel and is omitted."""

    points: int
    share: float
    outputs: tuple[str, ...]


class Inert(Note):
    """Inputs with zero derivatives, which are not sampled."""

    inputs: tuple[str, ...]


class Tied(Note):
    """Inputs kept at their ratio to another one."""

    inputs: tuple[str, ...]
