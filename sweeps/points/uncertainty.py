"""Results of a calibrated robot with their uncertainty, from simulations of draws from its posterior."""

from __future__ import annotations

import dataclasses

import numpy as np

from calibration.data import Columns
from calibration.data.posterior_file import Posterior
from calibration.data.runs import Runs
from mmrjax import fidelities
from mmrjax.fidelities import outputs
from mmrjax.fidelities.variation import STATUS
from mmrjax.model.channels import Channel
from mmrjax.model.robot import Robot
from mmrjax.model.signals import DONE
from sweeps.config import FidelityPart
from sweeps.console import progress_bar
from sweeps.points import run
from sweeps.points.sampled_design import DrawnSamples
from sweeps.store import RunFolder

#: Suffixes of an output's columns: standard deviation, ends of the 95 % interval.
SD, LOWER, UPPER = "_sd", "_lower", "_upper"
#: Column with the share of draws that converge.
SHARE = "posterior_converged"
QUANTILES = (0.025, 0.975)
#: Random seed of the draws.
SEED = 0


@dataclasses.dataclass(frozen=True)
class Intervals:
    """Intervals of every run from draws of a posterior.

    Attributes:
        columns: columns from `simulate_draws`, arrays of shape (runs,).
        draws: number of draws.
        channels: channels of the robot.
    """

    columns: Columns
    draws: int
    channels: tuple[Channel, ...]

    def sd(self, column: str) -> np.ndarray:
        """Standard deviation of a column of the runs."""
        return self.columns[column + SD]


def simulate_draws(
    robot: Robot, posterior: Posterior, runs: Runs, config: FidelityPart, draws: int, folder: RunFolder | None = None
) -> Intervals:
    """Simulates every run with robots drawn from the posterior: a sweep of the runs combined with the draws.

    The result is the uncertainty of the model's prediction, without the noise of readings. Each draw is one robot for
    all runs. Draws that do not converge in a run are omitted there. `SHARE` has the share of those that do.

    Returns:
        For each output its sd and the ends of its 95 % interval, NaN if fewer than two draws converge.
    """
    samples = DrawnSamples(tuple(posterior.names), posterior.draw(draws, SEED).T)
    job = run.job_of_run_table(robot, runs, config, samples)
    slow = fidelities.fidelity_facts(config.model).slow or draws * len(runs) > 100_000

    def summary(found: run.Table) -> run.Table:
        by_name = {name: values.reshape(-1, draws) for name, values in found.items()}
        counts = np.isin(by_name[STATUS], DONE) & np.isfinite(by_name[robot.channels[0].name])
        return _summary({o.column: by_name[o.name] for o in outputs.output_table(robot.channels)}, counts)

    draws_fit_chunk = job.blocks.size[-1] == draws  # then a chunk is stored as a summary
    with progress_bar(draws, quiet=not slow, doing="draws") as advance:
        chunks = run.compute_chunks(
            job, folder, "draws", lambda points: advance(points / len(runs)), summary if draws_fit_chunk else dict
        )
    return Intervals(chunks if draws_fit_chunk else summary(chunks), draws, robot.channels)


def _summary(columns: Columns, counts: np.ndarray) -> Columns:
    """Spread of each column over draws. Arrays have shape (runs, draws). `counts`: True if a draw converges."""
    enough = counts.sum(1) >= 2
    by_column: Columns = {}
    for column, values in columns.items():
        x = np.where(enough[:, None], np.where(counts, values, np.nan), 0.0)
        with np.errstate(invalid="ignore"):  # windings that never settle
            low, high = np.nanquantile(x, QUANTILES, axis=1)
            spread = np.nanstd(x, 1, ddof=1)
        by_column |= {
            column + end: np.where(enough, value, np.nan)
            for end, value in ((SD, spread), (LOWER, low), (UPPER, high))
        }
    return {**by_column, SHARE: counts.mean(1)}


def interval_ranges(table: Columns, found: Intervals) -> list[str]:
    """Range of every channel over the runs, each end with its sd, and the number of draws that do not converge."""
    first_column = found.channels[0].column
    finite = np.isfinite(found.sd(first_column)) & np.isfinite(table[first_column])
    ranges = []
    for c in found.channels if finite.any() else ():
        value, sd, rows = table[c.column], found.sd(c.column), np.flatnonzero(finite)
        least, most = rows[np.argmin(value[rows])], rows[np.argmax(value[rows])]
        ends = [with_sd(value[k], sd[k], c.resolution) for k in dict.fromkeys((int(least), int(most)))]
        ranges.append(f"{c.label}: {' to '.join(ends)} {c.unit}")
    first_remark, *more_remarks = interval_remarks(found, "the table")
    return [*[first_remark] * bool(ranges), *ranges, *more_remarks]


def interval_remarks(found: Intervals, place: str = "runs.csv") -> list[str]:
    """Number of drawn robots and, if some do not converge, their number and that of the runs."""
    is_incomplete = found.columns[SHARE] < 1
    remarks = [f"± one sd over {found.draws} robots drawn from the posterior. 95 % intervals are in {place}"]
    if is_incomplete.any():
        share = 100 * (1 - found.columns[SHARE].min())
        remarks.append(
            f"in {int(is_incomplete.sum())} of {len(is_incomplete)} runs some draws fail (up to {share:.0f} %). "
            "Intervals use the others"
        )
    return remarks


def with_sd(value: float, sd: float, most: int) -> str:
    """«4.19 ± 0.06», to two digits of the sd and at most `decimals` decimals."""
    if not (np.isfinite(sd) and sd > 0):
        return f"{value:z.{most}f} ± {sd:.{most}f}"
    digits = int(np.clip(1 - np.floor(np.log10(sd)), 0, most))
    return f"{value:z.{digits}f} ± {sd:.{digits}f}"
