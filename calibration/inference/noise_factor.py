"""Whether sds are stated rightly: by what factor residuals without structure are off."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtr, chdtrc

from calibration.inference.fit_notes import NoiseOff
from calibration.inference.lack_of_fit import LEVEL, Residuals, structure

#: Factor on the sds from which it is said, either way; probability under right sds below which it is.
OFF, IMPROBABLE = 1.25, 0.001
#: Error of structure that speaks against sds that are off alike in every channel.
BEYOND_DOUBT = 0.005
#: Fewest degrees of freedom of a channel for its residuals to be told from structure.
FEWEST = 30
#: How far apart the factors of channels may be to be called the same.
ALIKE = 1.3


def noise_factors(fit: Residuals, level: float = LEVEL) -> dict[str, float]:
    """By how much the residuals of each channel exceed its sds, where that is sure; none where they have structure.

    Structure is looked for with sds as the misfit says, so that it does not depend on those that are stated.

    Args:
        level: family-wise error of seeing some where there is none.
    """
    tests = structure(fit.rescaled(), known=False)
    if tests and min(p for p, _ in tests) * len(tests) < level:
        return {}
    found = {}
    for channel, chi2, freedom in zip(fit.runs.channels, fit.chi2.tolist(), fit.freedom.tolist(), strict=True):
        if freedom < 1 or chi2 <= 0:
            continue
        factor = float(np.sqrt(chi2 / freedom))
        p = chdtrc(freedom, chi2) if factor > 1 else chdtr(freedom, chi2)
        if max(factor, 1 / factor) > OFF and p < IMPROBABLE:
            found[channel.name] = factor
    return found


def common_factors(fit: Residuals) -> dict[str, float]:
    """`noise_factors`, where every channel has one and they are the same; none else, or where readings are too few.

    What the model lacks shows in some channels more than in others: structure has to be beyond doubt to speak against
    sds that are off everywhere alike.
    """
    factors = noise_factors(fit, BEYOND_DOUBT)
    enough = bool(np.all(fit.freedom[fit.counts.any(0)] >= FEWEST))
    return factors if enough and _everywhere(fit, factors) else {}


def _everywhere(fit: Residuals, factors: dict[str, float]) -> bool:
    """Whether every channel that is read has a factor, and they are the same."""
    count = int(fit.counts.any(0).sum())
    return len(factors) == count > 1 and max(factors.values()) < ALIKE**2 * min(factors.values())


def noise_remarks(fit: Residuals, source: str = "stated") -> list[NoiseOff]:
    """Sds that are off by a factor; `source` says where they come from."""
    factors = noise_factors(fit)
    if _everywhere(fit, factors):
        return [NoiseOff("", float(np.exp(np.mean(np.log(list(factors.values()))))), source)]
    return [NoiseOff(name, factor, source) for name, factor in factors.items()]
