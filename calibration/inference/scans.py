"""Scans of parameters over which the misfit is a staircase or has several basins: a dead time, a phase, a gap.

Where a current rises within L/R and is sampled once in twenty of that, the misfit over a delay is flat but for a
cliff wherever a sample passes the rise: a gradient says nothing of what lies behind the next cliff, and a curvature
is that of the step one stands on. So the misfit is looked at over the whole of the parameter's prior, all others
moved with it as their linearisation says, before a search and after it; and what is known of the parameter afterwards
is read from that profile.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from calibration.inference.identifiability import Z95, Identifiability
from calibration.inference.optimizers import Optimum, evaluated, small
from calibration.inference.priors import known
from calibration.inference.problem import Data, Observation, Problem

#: Half of the range of a scan [prior sd].
RANGE = 4.0
#: Basins that are looked at more closely, those from which searches begin, and how often a search is begun again.
CLOSER, TRIED, AGAIN = 16, 2, 6
#: Fall of the objective [½σ²] that is worth another search: a parameter moves by a tenth of its sd for it.
WORTH = 5e-3


@dataclasses.dataclass(frozen=True)
class Scan:
    """The misfit over one coordinate.

    Attributes:
        at: values of the coordinate, increasing, shape (points,).
        cost: objective there, the others moved to where their linearisation has its minimum [½σ²], shape (points,).
        others: all coordinates then, shape (points, parameters).
    """

    at: Float[np.ndarray, " points"]
    cost: Float[np.ndarray, " points"]
    others: Float[np.ndarray, "points parameters"]

    def basins(self) -> np.ndarray:
        """Indices of the points that are lower than those beside them, the lowest first."""
        padded = np.concatenate([[np.inf], self.cost, [np.inf]])
        lowest = np.flatnonzero((self.cost <= padded[:-2]) & (self.cost < padded[2:]))
        return lowest[np.argsort(self.cost[lowest], kind="stable")]

    def interval(self) -> tuple[float, float]:
        """Ends of what no point beyond is within 95 % (a rise of 3.84 σ²)."""
        inside = np.flatnonzero(2 * (self.cost - self.cost.min()) <= Z95**2)
        return self._crossing(inside[0], -1), self._crossing(inside[-1], 1)

    def _crossing(self, k: int, side: int) -> float:
        """Where the rise passes 3.84 between the k-th point, inside, and the next; the last point if it does not."""
        if not 0 <= k + side < len(self.at):
            return float(self.at[k])
        one, two = (np.sqrt(max(2 * (self.cost[j] - self.cost.min()), 0.0)) for j in (k, k + side))
        return float(self.at[k] + (self.at[k + side] - self.at[k]) * (Z95 - one) / max(two - one, 1e-12))

    def open(self) -> tuple[bool, bool]:
        """Whether the interval may go on beyond the first or the last point."""
        inside = 2 * (self.cost - self.cost.min()) <= Z95**2
        return bool(inside[0]), bool(inside[-1])

    def parts(self) -> int:
        """Of how many pieces, apart from one another, the 95 % region consists."""
        inside = 2 * (self.cost - self.cost.min()) <= Z95**2
        return int(np.sum(inside & ~np.concatenate([[False], inside[:-1]])))

    def sd(self) -> float:
        """Of exp(-rise / 2) as a density over the coordinate."""
        width = np.gradient(self.at)
        mass = width * np.exp(self.cost.min() - self.cost)
        middle = np.sum(mass * self.at) / np.sum(mass)
        return float(np.sqrt(np.sum(mass * (self.at - middle) ** 2) / np.sum(mass)))


def scanned(problem: Problem) -> tuple[int, ...]:
    """Coordinates that are scanned: their fields say so, and the data follow them through time."""
    return problem.observe.scanned(problem)


def flagged(problem: Problem) -> tuple[int, ...]:
    """Coordinates whose fields say that the misfit over them may have cliffs or several basins."""
    fields = known(problem.base)
    names = problem.coordinates.names
    return tuple(k for k, n in enumerate(names) if n in fields and fields[n].spec.scanned)


def scan(problem: Problem, z: np.ndarray, data: Data, k: int) -> Scan:
    """The misfit over coordinate k, the others near z: evenly over the prior's range, and closer where it is low."""
    count = problem.observe.scan_points(problem, k)
    even = np.linspace(-RANGE, RANGE, count)
    seen = _sorted([_looked(problem, z, data, k, even)])
    step, few = even[1] - even[0], count // CLOSER
    around = [*seen.at[seen.basins()], *([z[k]] * CLOSER)][:CLOSER]
    around = [z[k], *around[: CLOSER - 1]]  # where the search stands too
    close = np.concatenate([c + step * np.linspace(-1, 1, few) for c in around])
    close = np.concatenate([close, np.repeat(z[k], count - len(close))])
    return _sorted([(seen.at, seen.cost, seen.others), _looked(problem, z, data, k, np.clip(close, -RANGE, RANGE))])


def _looked(problem: Problem, z: np.ndarray, data: Data, k: int, at: np.ndarray) -> tuple[np.ndarray, ...]:
    cost, others = problem.observe.scan(problem, jnp.asarray(z), data, k, jnp.asarray(at))
    return at, np.asarray(cost), np.asarray(others)


def _sorted(parts: list[tuple[np.ndarray, ...]]) -> Scan:
    at, cost, others = (np.concatenate(x) for x in zip(*parts, strict=True))
    order = np.unique(at, return_index=True)[1]
    cost = np.where(np.isfinite(cost), cost, np.inf)
    return Scan(at[order], cost[order], others[order])


def placed(problem: Problem, starts: Float[np.ndarray, "starts z"]) -> Float[np.ndarray, "starts z"]:
    """Starts of searches with what is scanned where the misfit is lowest, all else as it was."""
    starts = np.array(starts, float)
    for k in scanned(problem):
        for z in starts:
            seen = scan(problem, z, problem.data, k)
            z[k] = seen.at[np.argmin(seen.cost)]
    return starts


Found = tuple[Optimum, Observation]


def searched_on(
    problem: Problem, found: Found, data: Data, search: Callable[[np.ndarray], Found], tell: Callable[[str], None]
) -> Found:
    """Where a search ends that looks over what is scanned from where it ended, and begins again in a lower basin.

    It has converged where no basin is lower and none of the others would gain, whatever the gradient at a cliff says.

    Args:
        found: where a search ended, and what the model says there; search: another one from a start.
    """
    every = scanned(problem)
    if not every:
        return found

    def objective(z: np.ndarray) -> float:
        cost = 0.5 * float(jnp.sum(evaluated(problem, jnp.asarray(z), data) ** 2))
        return cost if np.isfinite(cost) else np.inf

    for _ in range(AGAIN):
        best, _ = found
        here, z = float(best.cost), np.asarray(best.z)
        gain = 0.0
        for k in every:
            seen = scan(problem, z, data, k)
            low = [j for j in seen.basins() if seen.cost[j] < here - WORTH][:TRIED]
            gain = max(gain, here - float(seen.cost.min()))
            starts = []
            for j in low:
                alone = np.where(np.arange(len(z)) == k, seen.at[j], z)
                starts.append(min((seen.others[j], alone), key=objective))
            ends = [search(start) for start in starts]
            lower = min(ends, key=lambda e: float(e[0].cost), default=found)
            if float(lower[0].cost) < here - WORTH:
                names = problem.coordinates.names
                tell(f"a lower basin of {names[k]}: objective {float(lower[0].cost):.4f}")
                found = lower
                break
        else:
            return _judged(found, gain)
    return _judged(found, np.inf)


def _judged(found: Found, gain: float) -> Found:
    best, seen = found
    settled = small(gain, best.cost) | (gain < WORTH) | bool(best.converged) & (gain < np.inf)
    return dataclasses.replace(best, converged=jnp.asarray(settled)), seen


def profiles(problem: Problem, z: np.ndarray) -> dict[int, Scan]:
    """The scans at an optimum, by coordinate: what the data say of each."""
    return {k: scan(problem, z, problem.data, k) for k in scanned(problem)}


def with_scanned_sds(about: Identifiability, scans: dict[int, Scan]) -> Identifiability:
    """The linear analysis with the sds of what is scanned as its profile says; correlations stay."""
    sd = about.sd.copy()
    for k, seen in scans.items():
        sd[k] = seen.sd()
    wider = sd / about.sd
    return dataclasses.replace(about, sd=sd, covariance=about.covariance * np.outer(wider, wider))


def statements(problem: Problem, scans: dict[int, Scan]) -> list[str]:
    """What to say of parameters whose 95 % region is in pieces."""
    said = []
    for k, seen in scans.items():
        if (parts := seen.parts()) > 1:
            said.append(
                f"{problem.coordinates.names[k]}: the values within its 95 % interval are in {parts} pieces, with "
                "worse ones between them; samples closer together would tell them apart"
            )
    return said
