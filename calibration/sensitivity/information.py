"""Most informative runs: Fisher information of readings, and D-optimal choices from a list.

In scores s the inputs are standard normal before any run, with information I. A run adds JᵀJ, J the derivatives of
its readings by s over their standard deviations. The choice maximises log det(I + Σ JᵀJ), twice the expected gain of
information on all inputs together [nat] (Lindley 1956; Chaloner and Verdinelli, Statist. Sci. 10 (1995)). It is
made greedily, then improved by exchanges (Fedorov 1972).
"""

from __future__ import annotations

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class Choice:
    """Runs to make next, the most informative first.

    Attributes:
        rows: of the candidates.
        gain: bits that each adds to those before it, shape (runs,).
        covariance: of the scores after each run, starting with no run, shape (runs + 1, inputs, inputs).
    """

    rows: tuple[int, ...]
    gain: np.ndarray
    covariance: np.ndarray


def fisher_information(jacobian: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Information of each run on the scores, shape (runs, inputs, inputs).

    Args:
        jacobian: of its readings by the scores, shape (runs, channels, inputs), NaN for missing readings.
        sd: of the readings, shape (runs, channels).
    """
    with np.errstate(divide="ignore", invalid="ignore"):  # a share of a reading of zero is no information
        whitened = jacobian / sd[..., None]
    whitened = np.where(np.isfinite(whitened), whitened, 0.0)
    return np.einsum("rci,rcj->rij", whitened, whitened)


def choose_runs(information: np.ndarray, count: int) -> Choice:
    """Runs that together are most informative, each candidate at most once.

    Args:
        information: of each candidate, from `fisher_information`.
        count: number of runs.
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
    for _ in range(count):  # of the set, the most informative first
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
    """Candidate outside `rows` that adds most information to them."""
    total = np.eye(information.shape[1]) + information[rows].sum(0)
    value = np.linalg.slogdet(total + information)[1]
    value[rows] = -np.inf
    return int(np.argmax(value))
