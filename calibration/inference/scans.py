"""Scans of parameters whose misfit is a staircase or has several local minima: a dead time, a phase, backlash.

If a current rises within L/R and is sampled at a twentieth of that rate, the misfit over a delay is a staircase. It
steps where a sample passes the rise. A gradient has no information on what is beyond the next step, and a curvature
is that of the current step only. So the misfit is scanned over all of the parameter's prior, before and after a
search, while the other parameters move with it according to their linearisation. The parameter's posterior is taken
from that profile.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from calibration.inference.fit_notes import Remark, progress_remark
from calibration.inference.identifiability import Z95
from calibration.inference.optimizers import Optimum, evaluate_residuals
from calibration.inference.problem import Observation, Problem
from mmrjax.model.params import parameters_by_name

#: Half of the range of a scan [prior sd].
RANGE = 4.0
#: Number of basins (local minima) scanned more closely, number from which searches begin, most repeats of a search.
CLOSER, TRIED, AGAIN = 16, 2, 6
#: Decrease of the objective [½σ²] that justifies another search: it moves a parameter by a tenth of its sd.
WORTH = 5e-3


@dataclasses.dataclass(frozen=True)
class Scan:
    """Misfit over one coordinate.

    Attributes:
        values: scanned values of the coordinate, increasing, shape (points,).
        cost: objective at each value, with the other coordinates at their linearised minimum [½σ²], shape (points,).
        others: all coordinates at each value, shape (points, parameters).
    """

    values: Float[np.ndarray, " points"]
    cost: Float[np.ndarray, " points"]
    others: Float[np.ndarray, "points parameters"]

    def local_minima(self) -> np.ndarray:
        """Indices of the local minima, the lowest first."""
        padded = np.concatenate([[np.inf], self.cost, [np.inf]])
        lowest = np.flatnonzero((self.cost <= padded[:-2]) & (self.cost < padded[2:]))
        return lowest[np.argsort(self.cost[lowest], kind="stable")]

    @property
    def _inside(self) -> np.ndarray:
        """True for points within 95 % (a rise of up to 3.84 σ²)."""
        return 2 * (self.cost - self.cost.min()) <= Z95**2

    def interval(self) -> tuple[float, float]:
        """Smallest interval that contains all points within 95 %."""
        places_inside = np.flatnonzero(self._inside)
        return self._crossing(places_inside[0], -1), self._crossing(places_inside[-1], 1)

    def _crossing(self, inner: int, side: int) -> float:
        """Coordinate between point k (inside) and the next one at which the rise is 3.84, or the end point."""
        if not 0 <= inner + side < len(self.values):
            return float(self.values[inner])
        inner_root, outer_root = (
            np.sqrt(max(2 * (self.cost[j] - self.cost.min()), 0.0)) for j in (inner, inner + side)
        )
        return float(
            self.values[inner]
            + (self.values[inner + side] - self.values[inner])
            * (Z95 - inner_root)
            / max(outer_root - inner_root, 1e-12)
        )

    def open(self) -> tuple[bool, bool]:
        """True for each end of the interval that may lie beyond the scanned range."""
        return bool(self._inside[0]), bool(self._inside[-1])

    def parts(self) -> int:
        """Number of separate parts of the 95 % region."""
        return int(np.sum(np.diff(self._inside.astype(int), prepend=0) > 0))

    def sd(self) -> float:
        """Standard deviation of the coordinate, with exp(-rise / 2) as its density."""
        width = np.gradient(self.values)
        mass = width * np.exp(self.cost.min() - self.cost)
        middle = np.sum(mass * self.values) / np.sum(mass)
        return float(np.sqrt(np.sum(mass * (self.values - middle) ** 2) / np.sum(mass)))


def wide_coordinates(problem: Problem) -> tuple[int, ...]:
    """Indices of the coordinates whose prior is wider than one local minimum of the misfit, according to their fields
    (`Spec.scanned`).
    """
    fields = parameters_by_name(problem.base)
    c = problem.coordinates
    values = [c.value(np.full(len(c), side * RANGE)) for side in (-1.0, 1.0)]
    half = 0.5 * (values[1] - values[0])
    widths = [fields[n].spec.scanned if n in fields else None for n in c.names]
    return tuple(k for k, width in enumerate(widths) if width is not None and half[k] > width)


def scan_coordinate(problem: Problem, z: np.ndarray, k: int) -> Scan:
    """Scan of coordinate k: at z, evenly over the range of the prior, and more closely near minima.

    Without the point at z, a narrow minimum that contains no other point could be missed.
    """
    count = problem.observe.number_of_scan_points(problem, k)
    scan = _scan_at(problem, z, k, np.append(np.linspace(-RANGE, RANGE, count - 1), z[k]))
    minima = np.array([z[k], *scan.values[scan.local_minima()]])[:CLOSER]
    points_per_minimum = count // CLOSER
    near_minima = (minima[:, None] + 2 * RANGE / (count - 1) * np.linspace(-1, 1, points_per_minimum)).ravel()
    if points_per_minimum > 2:
        scan = _scan_at(problem, z, k, np.resize(near_minima, count), scan)
    low, high = scan.interval()
    return _scan_at(problem, z, k, np.linspace(1.5 * low - 0.5 * high, 1.5 * high - 0.5 * low, count), scan)


def _scan_at(problem: Problem, z: np.ndarray, k: int, values: np.ndarray, before: Scan | None = None) -> Scan:
    """Scan with further points."""
    values = np.clip(values, -RANGE, RANGE)
    points = values, *map(np.asarray, problem.observe.scan(problem, jnp.asarray(z), k, jnp.asarray(values)))
    if before is not None:
        points = tuple(
            np.concatenate(x) for x in zip((before.values, before.cost, before.others), points, strict=True)
        )
    order = np.unique(points[0], return_index=True)[1]
    values, cost, others = (x[order] for x in points)
    return Scan(values, np.where(np.isfinite(cost), cost, np.inf), others)


def place_at_minimum(problem: Problem, starts: Float[np.ndarray, "starts z"]) -> Float[np.ndarray, "starts z"]:
    """Starts whose scanned coordinates are moved to the lowest misfit near the first start. Other coordinates are
    unchanged.
    """
    starts = np.array(starts, float)
    for k in problem.observe.scanned(problem):
        scan = scan_coordinate(problem, starts[0], k)
        starts[:, k] = scan.values[np.argmin(scan.cost)]
    return starts


SearchEnd = tuple[Optimum, Observation]


def search_lower_minima(
    problem: Problem, best: SearchEnd, search: Callable[[np.ndarray], SearchEnd], tell: Callable[[Remark], None]
) -> SearchEnd:
    """Scans the optimum of a search, and repeats the search from any lower minimum.

    It has converged if no scanned minimum is lower and the other coordinates bring no gain. The gradient at a step of
    the staircase need not be zero.

    Args:
        best: optimum of a search, and the observation there.
        search: function that searches from a start.
    """
    coordinates = problem.observe.scanned(problem)
    if not coordinates:
        return best

    def objective(z: np.ndarray) -> float:
        cost = 0.5 * float(jnp.sum(evaluate_residuals(problem, jnp.asarray(z)) ** 2))
        return cost if np.isfinite(cost) else np.inf

    for _ in range(AGAIN):
        cost_here = float(best[0].cost)
        z = np.asarray(best[0].z)
        scans = {k: scan_coordinate(problem, z, k) for k in coordinates}
        lower = best
        for k, scan in scans.items():
            for j in [j for j in scan.local_minima() if scan.cost[j] < cost_here - WORTH][:TRIED]:
                start = np.where(np.arange(len(z)) == k, scan.values[j], z)
                candidate = search(min((scan.others[j], start), key=objective))
                lower = min(lower, candidate, key=lambda search_end: float(search_end[0].cost))
        if not float(lower[0].cost) < cost_here - WORTH:
            break
        best = lower
        scanned_names = " or ".join(problem.coordinates.names[k] for k in coordinates)
        tell(progress_remark("basin", scanned_names, float(best[0].cost)))
    else:
        return dataclasses.replace(best[0], converged=jnp.asarray(False)), best[1]
    # A kink has a slope on either side, so an optimum there is a point with no lower point nearby.
    lowest = min(float(scan.cost.min()) for scan in scans.values())
    sd = np.array(best[0].sd)
    for k, scan in scans.items():
        sd[k] = scan.sd()
    has_converged = bool(best[0].converged) or cost_here - lowest < WORTH
    return dataclasses.replace(best[0], converged=jnp.asarray(has_converged), sd=jnp.asarray(sd)), best[1]


def count_outside(scans: dict[int, Scan], z: np.ndarray | None, converged: np.ndarray) -> int:
    """Number of converged searches that ended outside the 95 % intervals of the scans at the best optimum.

    Args:
        z: end of each search, shape (searches, parameters), None if not known.
        converged: True for each converged search.
    """
    if z is None:
        return 0
    outside = np.zeros(len(converged), bool)
    for k, scan in scans.items():
        low, high = scan.interval()
        outside |= (z[:, k] < low) | (z[:, k] > high)
    return int(np.sum(outside & converged))
