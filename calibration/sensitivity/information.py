"""Which runs would tell most of the inputs: Fisher information of readings, and D-optimal choices out of a list.

In scores s the inputs are standard normal beforehand, with information I. A run adds JᵀJ, J the derivatives of its
readings by s over their standard deviations. The choice maximises log det(I + Σ JᵀJ), twice what is expected to be
learnt of all inputs together [nat] (Lindley 1956; Chaloner and Verdinelli, Statist. Sci. 10 (1995)): greedily, then
by exchanges as long as one gains (Fedorov 1972).
"""

from __future__ import annotations

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class Choice:
    """Runs to make next, the one that tells most first.

    Attributes:
        rows: of the candidates; gain: bits that each adds to those before it, shape (runs,).
        covariance: of the scores after each run, the first before any; shape (runs + 1, inputs, inputs).
    """

    rows: tuple[int, ...]
    gain: np.ndarray
    covariance: np.ndarray


def fisher(jacobian: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Information of each run on the scores, shape (runs, inputs, inputs).

    Args:
        jacobian: of its readings by the scores, shape (runs, channels, inputs), NaN where there is no reading.
        sd: of the readings, shape (runs, channels).
    """
    with np.errstate(divide="ignore", invalid="ignore"):  # a share of a reading of zero tells nothing
        whitened = jacobian / sd[..., None]
    whitened = np.where(np.isfinite(whitened), whitened, 0.0)
    return np.einsum("rci,rcj->rij", whitened, whitened)


def choose(information: np.ndarray, count: int) -> Choice:
    """The runs that together tell most, each candidate at most once.

    Args:
        information: of each candidate, from `fisher`; count: how many runs.
    """
    candidates, size, _ = information.shape
    count = min(count, candidates)
    chosen: list[int] = []
    for _ in range(count):
        chosen.append(_best(information, chosen))
    improved = True
    while improved:
        improved = False
        for place in range(count):
            others = chosen[:place] + chosen[place + 1 :]
            best = _best(information, others)
            if _value(information, [*others, best]) > _value(information, chosen) + 1e-9:
                chosen = [*others, best]
                improved = True
    ordered: list[int] = []
    for _ in range(count):  # of the set, the most telling first
        left = [k for k in chosen if k not in ordered]
        ordered.append(max(left, key=lambda k: _value(information, [*ordered, k])))
    values = [_value(information, ordered[:k]) for k in range(count + 1)]
    eye = np.eye(size)
    after = [np.linalg.inv(eye + information[ordered[:k]].sum(0)) for k in range(count + 1)]
    return Choice(tuple(ordered), np.diff(values) / (2 * np.log(2)), np.stack(after))


def _value(information: np.ndarray, rows: list[int]) -> float:
    total = np.eye(information.shape[1]) + information[rows].sum(0)
    return float(np.linalg.slogdet(total)[1])


def _best(information: np.ndarray, rows: list[int]) -> int:
    """The candidate, not among `rows`, that adds most to them."""
    total = np.eye(information.shape[1]) + information[rows].sum(0)
    value = np.linalg.slogdet(total + information)[1]
    value[rows] = -np.inf
    return int(np.argmax(value))
