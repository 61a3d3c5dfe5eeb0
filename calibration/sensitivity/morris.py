"""Screening by elementary effects: changes of an output when single inputs change (Morris 1991).

μ* is the mean magnitude of the change per whole range of the input (Campolongo et al., Environ. Model. Softw. 22
(2007)). σ is the standard deviation of the change between places, due to nonlinearity or interactions. Trajectories
and measures are computed by SALib.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy import stats

from calibration.sensitivity.replicates import LEVEL, IntervalEstimate

#: Levels of the grid of the trajectories.
LEVELS = 4


@dataclasses.dataclass(frozen=True)
class ElementaryEffects:
    """Elementary effects of each input on an output [unit of the output per range of the input], shape (inputs,).

    Attributes:
        mean: μ, mean of the effects.
        size: μ*, mean magnitude of the effects, with its interval.
        spread: σ, standard deviation of the effects.
        trajectories: number of included trajectories.
        lost: number of omitted trajectories, at a point of which the model has no value.
    """

    mean: np.ndarray
    size: IntervalEstimate
    spread: np.ndarray
    trajectories: int
    lost: int


def morris_design(inputs: int, trajectories: int, seed: int) -> np.ndarray:
    """Trajectories in the unit cube, shape (trajectories · (inputs + 1), inputs)."""
    from SALib.sample import morris as sampling

    # The sampler uses NumPy's global generator despite its seed argument, so the state is restored.
    state = np.random.get_state()  # noqa: NPY002
    try:
        return sampling.sample(_problem(inputs), trajectories, num_levels=LEVELS, seed=seed)
    finally:
        np.random.set_state(state)  # noqa: NPY002


def elementary_effects(points: np.ndarray, values: np.ndarray) -> ElementaryEffects | None:
    """Elementary effects of each input on one output.

    Args:
        points: points from `morris_design`.
        values: values of the output there.

    Returns:
        None if fewer than two trajectories have values at all points.
    """
    from SALib.analyze.morris import analyze

    count, steps = len(points) // (points.shape[1] + 1), points.shape[1] + 1
    values_by_path = values.reshape(count, steps)
    finite = np.isfinite(values_by_path).all(1)
    finite_points = np.repeat(finite, steps)
    if finite.sum() < 2:
        return None
    state = np.random.get_state()  # noqa: NPY002
    try:
        analysis = analyze(
            _problem(points.shape[1]), points[finite_points], values[finite_points], num_levels=LEVELS, seed=0
        )
    finally:
        np.random.set_state(state)  # noqa: NPY002
    size = np.asarray(analysis["mu_star"], float)
    # change of the output per change of the moved input, shape (trajectories, inputs)
    steps_taken = np.diff(points[finite_points].reshape(-1, steps, points.shape[1]), axis=1)
    moved_input = np.abs(steps_taken).argmax(-1)
    change = (
        np.diff(values_by_path[finite], axis=1) / np.take_along_axis(steps_taken, moved_input[..., None], -1)[..., 0]
    )
    elementary = np.zeros_like(change)
    np.put_along_axis(elementary, moved_input, change, 1)
    width = float(stats.t.ppf(0.5 + LEVEL / 2, int(finite.sum()) - 1)) / np.sqrt(finite.sum())
    error = width * np.abs(elementary).std(0, ddof=1)
    return ElementaryEffects(
        np.asarray(analysis["mu"], float),
        IntervalEstimate(size, size - error, size + error),
        np.asarray(analysis["sigma"], float),
        int(finite.sum()),
        int(count - finite.sum()),
    )


def _problem(inputs: int) -> dict[str, object]:
    return {
        "num_vars": inputs,
        "names": [str(k) for k in range(inputs)],
        "bounds": [[0.0, 1.0]] * inputs,
        "groups": None,
    }
