"""Check of the stated sds against the scatter of residuals without structure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.special import chdtr, chdtrc

from calibration.inference.fit_notes import Remark
from calibration.inference.lack_of_fit import LEVEL, Residuals, structure_tests

#: Factor on the sds, in either direction, above which a note reports it; p-value under correct sds below which it
#: does.
OFF, IMPROBABLE = 1.25, 0.001
#: Significance of structure that refutes a common factor of all channels.
BEYOND_DOUBT = 0.005
#: Fewest degrees of freedom of a channel for a test of structure.
FEWEST = 30
#: Sds of chance by which a variance exceeds 1.
CHANCE = 3.0
#: Largest ratio of the factors of channels, squared, for one common factor.
ALIKE = 1.3


def noise_factors(fit: Residuals, level: float = LEVEL) -> dict[str, float]:
    """Ratio of the residuals of each channel to its sds, if it differs significantly from 1. Empty if they have
    structure.

    Structure is tested with sds estimated from the misfit, so that the result does not depend on the stated sds.

    Args:
        level: family-wise significance level of that test.
    """
    tests = structure_tests(fit.rescaled(), known=False)
    if tests and min(p for p, _ in tests) * len(tests) < level:
        return {}
    factors = {}
    for channel, chi2, freedom in zip(fit.runs.channels, fit.chi2.tolist(), fit.freedom.tolist(), strict=True):
        if freedom < 1 or chi2 <= 0:
            continue
        factor = float(np.sqrt(chi2 / freedom))
        p = chdtrc(freedom, chi2) if factor > 1 else chdtr(freedom, chi2)
        if max(factor, 1 / factor) > OFF and p < IMPROBABLE:
            factors[channel.name] = factor
    return factors


def common_factors(fit: Residuals) -> dict[str, float]:
    """The `noise_factors`, if every channel has the same factor. Otherwise, or with too few readings, empty.

    A model error affects some channels more than others. So a factor that is common to all channels is rejected only
    by highly significant structure.
    """
    factors = noise_factors(fit, BEYOND_DOUBT)
    enough = bool(np.all(fit.freedom[fit.counts.any(0)] >= FEWEST))
    return factors if enough and _is_common_factor(fit, factors) else {}


def _is_common_factor(fit: Residuals, factors: dict[str, float]) -> bool:
    """True if every measured channel has a factor and the factors agree."""
    count = int(fit.counts.any(0).sum())
    return len(factors) == count > 1 and max(factors.values()) < ALIKE**2 * min(factors.values())


def noise_remarks(fit: Residuals, source: str = "stated") -> list[Remark]:
    """Remarks on sds that are wrong by a factor. `source`: source of the sds."""
    factors = noise_factors(fit)
    if _is_common_factor(fit, factors):
        return [
            Remark(
                "noise_off", channel="", factor=float(np.exp(np.mean(np.log(list(factors.values()))))), source=source
            )
        ]
    return [Remark("noise_off", channel=name, factor=factor, source=source) for name, factor in factors.items()]


def variance_of_sums(residuals: Sequence[Float[np.ndarray, " rows"]]) -> float:
    """Variance of sums of consecutive residuals, divided by their number: 1 for white noise of unit variance.

    The sums are over blocks whose length is the root of the number of residuals (batch means, Flegal and Jones, Ann.
    Stat. 38 (2010) 1034). 1 if the excess is chance.

    Args:
        residuals: whitened residuals of each run, in order of time.
    """
    length = max(int(np.sqrt(sum(map(len, residuals)))), 1)
    blocks = [b for e in residuals for b in np.array_split(e, max(len(e) // length, 1)) if len(b)]
    variance = float(np.mean([np.sum(b) ** 2 / len(b) for b in blocks])) if blocks else 1.0
    return variance if variance > 1 + CHANCE * np.sqrt(2 / len(blocks)) else 1.0
