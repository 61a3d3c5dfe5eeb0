"""Judgement of a loop's alternatives by the readings of its proposed experiments."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calibration.discovery import experiments, predicted


@dataclasses.dataclass(frozen=True)
class Verdict:
    """Judgement of alternatives by the readings of experiments.

    Attributes:
        chi2: of each alternative, by name.
        best: the one with the smallest.
        refuted: alternatives whose χ² is larger by `Settings.refuted` or more.
        resolved: True if only the best is left.
    """

    chi2: dict[str, float]
    best: str
    refuted: tuple[str, ...]

    @property
    def resolved(self) -> bool:
        """True if one alternative is left."""
        return len(self.refuted) == len(self.chi2) - 1

    @property
    def left(self) -> tuple[str, ...]:
        """Alternatives that are not refuted."""
        return tuple(n for n in self.chi2 if n not in self.refuted)


def among(seen: experiments.PredictedReadings, names: Sequence[str]) -> experiments.PredictedReadings:
    """The readings of these alternatives, in their order. The first is the best fit only if that is among them."""
    kept = [k for k, n in enumerate(seen.names) if n in names]
    return dataclasses.replace(
        seen, names=tuple(seen.names[k] for k in kept), value=seen.value[kept], half=seen.half[kept]
    )


def supported(seen: experiments.PredictedReadings, carried_out: Mapping[str, Mapping[str, Any]]) -> Verdict:
    """Judges alternatives by the readings of experiments.

    Args:
        seen: predicted readings.
        carried_out: experiment → `value` and `sd` of its readings [SI], repeats averaged, in the menu's order,
            NaN for missing ones.
    """
    spans = predicted.reading_spans(seen.experiments)
    at = np.concatenate([np.arange(len(seen.sd))[spans[name]] for name in carried_out])
    value, sd = (
        np.concatenate([np.asarray(r[what], float) for r in carried_out.values()]) for what in ("value", "sd")
    )
    read = seen.exists[at] & np.isfinite(value)
    at, value, sd = at[read], value[read], sd[read]
    chi2 = {}
    for k, name in enumerate(seen.names):
        d, half = value - seen.value[k, at], seen.half[k, at]
        chi2[name] = float(d @ np.linalg.solve(half @ half.T + np.diag(sd**2), d))
    best = min(chi2, key=chi2.__getitem__)
    return Verdict(chi2, best, tuple(n for n, c in chi2.items() if c - chi2[best] >= seen.settings.refuted))
