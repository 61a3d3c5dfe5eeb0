"""Results of a calibrated robot with their uncertainty: its posterior, drawn from and simulated."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from calibration.data.posterior import Posterior
from calibration.data.runs import Runs
from mmrjax import fidelities, outputs, params
from mmrjax.channels import Channel
from mmrjax.robot import Robot
from mmrjax.signals import done
from sweeps.config import FidelityPart
from sweeps.console import progress, say
from sweeps.points import run

#: What is added to the column of an output: standard deviation, ends of the 95 % interval.
SD, LOWER, UPPER = "_sd", "_lower", "_upper"
#: Share of the draws that converge.
SHARE = "posterior_converged"
QUANTILES = (0.025, 0.975)
#: Draws are of this random seed.
SEED = 0


@dataclasses.dataclass(frozen=True)
class Intervals:
    """What draws of a posterior say of every run.

    Attributes:
        columns: as `intervals` names them; arrays of shape (runs,).
        draws: how many; channels: of the robot.
    """

    columns: dict[str, np.ndarray]
    draws: int
    channels: tuple[Channel, ...]

    def sd(self, column: str) -> np.ndarray:
        """Standard deviation of a column of the runs."""
        return self.columns[column + SD]


def intervals(robot: Robot, posterior: Posterior, runs: Runs, config: FidelityPart, draws: int) -> Intervals:
    """Simulate every run with so many robots drawn from the posterior.

    It is the uncertainty of what the model says, without the noise of a reading. Each draw is one robot for all runs.
    Draws that do not converge at a run count for nothing there; `SHARE` says how many do.

    Returns:
        For every output's column its sd and the ends of its 95 % interval, NaN where fewer than two draws converge.
    """
    values = posterior.draw(draws, SEED)
    fidelity, size = fidelities.get(config.model), min(config.runs_at_once, len(runs))
    rows_of = outputs.table(robot.channels)
    columns = [o.column for o in rows_of]
    seen = np.full((draws, len(runs), len(columns)), np.nan)
    robot = params.strong(robot)
    with progress(draws, quiet=not (fidelity.facts.slow or draws * len(runs) > 100_000), doing="draws") as advance:
        for d, theta in enumerate(values):
            drawn = params.replace(robot, {n: jnp.asarray(x) for n, x in zip(posterior.names, theta, strict=True)})
            for first in range(0, len(runs), size):
                rows = np.minimum(np.arange(first, first + size), len(runs) - 1)
                conditions = run.commanded(robot, runs.where(rows), config)
                result = jax.device_get(fidelity.run(drawn, conditions, config.options, None).result)
                count = min(size, len(runs) - first)
                there = np.asarray(done(result.status))[:count]
                for j, output in enumerate(rows_of):
                    reading = np.asarray(output.get(result))[:count] / output.factor
                    seen[d, first : first + count, j] = np.where(there, reading, np.nan)
            advance(1)
    return Intervals(_summary(seen, columns), draws, robot.channels)


def _summary(seen: np.ndarray, columns: list[str]) -> dict[str, np.ndarray]:
    there = np.isfinite(seen[..., 0])
    enough = there.sum(0) >= 2
    found: dict[str, np.ndarray] = {}
    for j, column in enumerate(columns):
        x = np.where(enough, seen[..., j], 0.0)
        low, high = np.nanquantile(x, QUANTILES, axis=0)
        spread = np.nanstd(x, 0, ddof=1)
        found |= {
            column + end: np.where(enough, value, np.nan)
            for end, value in ((SD, spread), (LOWER, low), (UPPER, high))
        }
    return {**found, SHARE: there.mean(0)}


def say_intervals(table: dict[str, np.ndarray], found: Intervals) -> None:
    """The range of every channel over the runs, each end with its sd; and how many draws do not converge."""
    first = found.channels[0].column
    there = np.isfinite(found.sd(first)) & np.isfinite(table[first])
    if there.any():
        say(f"± one sd over {found.draws} robots drawn from the posterior; 95 % intervals are in the table")
    for c in found.channels:
        value, sd = table[c.column], found.sd(c.column)
        if there.any():
            rows = np.flatnonzero(there)
            least, most = rows[np.argmin(value[rows])], rows[np.argmax(value[rows])]
            ends = [with_sd(value[k], sd[k], c.resolution) for k in dict.fromkeys((int(least), int(most)))]
            say(f"{c.label}: {' to '.join(ends)} {c.unit}")
    say_lost(found)


def say_lost(found: Intervals) -> None:
    """At how many runs how many draws do not converge, where some do not."""
    lost = found.columns[SHARE] < 1
    if lost.any():
        share = 100 * (1 - found.columns[SHARE].min())
        say(
            f"at {int(lost.sum())} of {len(lost)} runs up to {share:.0f} % of the draws do not converge; intervals "
            "there are of those that do"
        )


def with_sd(value: float, sd: float, most: int) -> str:
    """«4.19 ± 0.06», to two digits of the sd, at most so many after the point."""
    if not (np.isfinite(sd) and sd > 0):
        return f"{value:.{most}f} ± {sd:.{most}f}"
    digits = int(np.clip(1 - np.floor(np.log10(sd)), 0, most))
    return f"{value:.{digits}f} ± {sd:.{digits}f}"
