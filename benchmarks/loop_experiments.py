"""What readings of experiments that the loop proposed say of its alternatives."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calibration.discovery import experiments, predicted


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What readings of experiments say of alternatives.

    Attributes:
        chi2: of each alternative, by name; best: whose is the smallest.
        refuted: alternatives whose χ² is larger by `Settings.refuted` or more.
        resolved: whether the best alone is left.
    """

    chi2: dict[str, float]
    best: str
    refuted: tuple[str, ...]

    @property
    def resolved(self) -> bool:
        """Whether one alternative is left."""
        return len(self.refuted) == len(self.chi2) - 1

    @property
    def left(self) -> tuple[str, ...]:
        """Alternatives that are not refuted."""
        return tuple(n for n in self.chi2 if n not in self.refuted)


def among(seen: experiments.PredictedReadings, names: Sequence[str]) -> experiments.PredictedReadings:
    """Of these alternatives alone, in their order; the first is the best fit only while that is among them."""
    kept = [k for k, n in enumerate(seen.names) if n in names]
    return dataclasses.replace(
        seen, names=tuple(seen.names[k] for k in kept), value=seen.value[kept], half=seen.half[kept]
    )


def supported(seen: experiments.PredictedReadings, carried_out: Mapping[str, Mapping[str, Any]]) -> Verdict:
    """Which alternative the readings of experiments support.

    Args:
        seen: what was foreseen.
        carried_out: experiment → `value` and `sd` of its readings [SI], repeats averaged, in the menu's order;
            NaN for what was not read.
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
        d = value - seen.value[k, at]
        chi2[name] = float(d @ np.linalg.solve(experiments._covariance(seen.half[k, at], sd), d))
    best = min(chi2, key=chi2.__getitem__)
    return Verdict(chi2, best, tuple(n for n, c in chi2.items() if c - chi2[best] >= seen.settings.refuted))
