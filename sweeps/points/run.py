"""Simulation of the runs of a table as a sweep, and the table of results."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from calibration.data import Columns, Json
from calibration.data.input_errors import BadConfiguration
from calibration.data.posterior_file import Posterior
from calibration.data.runs import Runs
from calibration.inference import observers
from calibration.inference.problem import Observation
from mmrjax import fidelities
from mmrjax.compile.compiling import compiled
from mmrjax.fidelities import outputs
from mmrjax.fidelities.base import RunBatch
from mmrjax.fidelities.variation import FLAGS as FLAGS_CODE
from mmrjax.fidelities.variation import STATUS
from mmrjax.model import params
from mmrjax.model.channels import Channel
from mmrjax.model.conditions import Conditions
from mmrjax.model.paper_tables import COULOMB_PER_MAH
from mmrjax.model.robot import Robot
from mmrjax.model.signals import DONE, FLAGS, STATUSES
from sweeps import capabilities
from sweeps.config import FidelityPart, Part, SupplyPart
from sweeps.console import progress_bar
from sweeps.pages import words
from sweeps.points import scale
from sweeps.points.axes import SweepPlan
from sweeps.points.sampled_design import Blocks, DrawnSamples
from sweeps.points.scale import Job
from sweeps.points.tasks import run_task
from sweeps.store import Page, RunFolder, finish_run_folder

Table = Columns

#: Number of steps of `compare` for each step of a fit.
PARTS = 4


def ending_columns(robot: Robot, batch: RunBatch) -> Columns:
    """Columns with results at the end of a batch of runs, including those specific to the fidelity."""
    result, further = jax.device_get((batch.result, batch.columns))
    return outputs.output_columns(result, robot.channels, further)


def check_runs_bearable(robot: Robot, conditions: Conditions, config: FidelityPart) -> None:
    """Rejects options that do not suit every run, before the first run is simulated.

    Raises:
        BadConfiguration: the number of steps is not whole, a step is too large for the stiffness, or similar.
    """
    try:
        fidelities.get_fidelity(config.model).check(robot, conditions, config.options)
    except ValueError as error:
        raise BadConfiguration(f"--model {config.model}: {error}") from error


def conditions_of_runs(robot: Robot, runs: Runs, config: Part) -> Conditions:
    """Conditions of the runs, with the supply of the configuration, by default the external one."""
    if not isinstance(config, SupplyPart):
        return runs.conditions(robot)
    return runs.conditions(robot, battery=float(config.battery), discharge=config.discharge_mAh * COULOMB_PER_MAH)


def compute_chunks(
    job: Job,
    folder: RunFolder | None,
    name: str,
    advance: Callable[[float], None],
    kept: Callable[[Table], Table] = dict,
) -> Table:
    """Outputs of all chunks of a job, in order.

    Args:
        folder: folder and name for the chunks. Chunks from an interrupted command are not computed again.
        kept: function that selects outputs of a chunk, in the units of tables, shape (points,). Default: all.
    """
    chunks = range(len(job.blocks))
    files = [f"{name}-{k:06d}" for k in chunks]
    stored = {} if folder is None else {k: part for k in chunks if (part := folder.chunk(files[k])) is not None}
    chunks_left = [k for k in chunks if k not in stored]
    advance(sum(map(job.blocks.count, stored)))

    def keep(chunk: int, arrays: Table, _: Any) -> None:
        stored[chunk] = kept(arrays)
        if folder is not None:
            folder.keep_chunk(files[chunk], stored[chunk])

    if chunks_left:
        scale.write_chunks(keep, scale.Compiled(job), chunks_left, advance)
    results = [stored.pop(k) for k in chunks]
    return {column: np.concatenate([part.pop(column) for part in results]) for column in tuple(results[0])}


def job_of_run_table(robot: Robot, runs: Runs, config: FidelityPart, samples: DrawnSamples | None = None) -> Job:
    """Job for every output of the runs of a table, each combined with every sample if there are samples.

    Raises:
        BadConfiguration: the fidelity cannot simulate a run.
    """
    rows = conditions_of_runs(robot, runs, config)
    check_runs_bearable(robot, rows, config)
    plan = SweepPlan.of_rows(jax.tree.map(np.asarray, rows), samples)
    output_names = (*outputs.output_names(robot.channels), FLAGS_CODE, *fidelities.get_fidelity(config.model).columns)
    task = run_task(config.model, config.options, robot)
    chunk = getattr(config, "chunk", None) or scale.default_chunk(task)
    blocks = Blocks.of(plan.design.shape, chunk)
    return Job(robot, task, plan, output_names, "float64", blocks)


def evaluate_runs(robot: Robot, runs: Runs, config: FidelityPart, folder: RunFolder | None) -> Columns:
    """Simulates every run and returns the table of conditions and results. Long simulations show a progress bar.

    Chunks in the folder, from an interrupted run with the same configuration, are not simulated again.
    """
    job = job_of_run_table(robot, runs, config)
    slow = fidelities.fidelity_facts(config.model).slow or len(job.blocks) > 1
    with progress_bar(len(runs), quiet=not slow) as advance:
        chunks = compute_chunks(job, folder, "chunk", advance)
    columns = {row.column: chunks[row.name] for row in outputs.output_table(robot.channels)}
    further = {name: chunks[name] for name in fidelities.get_fidelity(config.model).columns}
    return {
        **condition_table(robot, runs),
        **columns,
        **outputs.status_words(chunks[STATUS], chunks[FLAGS_CODE]),
        **further,
    }


def simulate_histories(robot: Robot, runs: Runs, model: str | None) -> Table:
    """Conditions and simulated outputs for every row of a table of time histories.

    Its steps are finer than in fits, which simulate up to thousands of times.

    Args:
        robot: prepared for the table.
        model: requested fidelity. None: the fidelity for histories.

    Raises:
        BadConfiguration: the fidelity cannot simulate time histories.
    """
    histories = jax.device_get(
        _observe(observers.Histories.of(runs, robot, model, PARTS), params.without_weak_types(robot))
    )
    columns = {c.column: histories.reading[:, k] / c.factor for k, c in enumerate(robot.channels)}
    return {**condition_table(robot, runs), **columns, **outputs.status_words(histories.status, histories.flags)}


@compiled
def _observe(observe: observers.Observer, robot: Robot) -> Observation:
    return observe(robot)


def condition_table(robot: Robot, runs: Runs) -> Columns:
    """Condition columns of a table, with the robot's total mass if the table has none."""
    columns = dict(runs.columns)
    if "total_mass_kg" in runs.layout.axes and "total_mass_kg" not in columns:
        own_mass = np.array([float(chassis.mass) for chassis in robot.configurations.members])
        columns["total_mass_kg"] = own_mass[runs.configurations(robot)] + runs["payload_kg"]
    shown = ("configuration", *dict.fromkeys((*runs.layout.axes, *runs.axes)), "surface", "run_id")
    return {key: columns[key] for key in shown if key in columns}


def run_names(runs: Runs) -> np.ndarray:
    """Names of runs: those of their table, otherwise numbers."""
    return runs["run_id"] if runs.has("run_id") else np.array([f"run-{k + 1}" for k in range(len(runs))])


def write_run_folder(folder: RunFolder, model: str, table: Columns, page: Page, further: Json | None = None) -> int:
    """Writes the files common to all simulating commands, and moves the folder into place. Returns the exit code.

    Args:
        model: fidelity of the runs.
        table: conditions and results by column.
        page: page of the command.
        further: further entries of `result.json`.
    """
    folder.write_table("runs.csv", capabilities.drop_inapplicable_columns(folder.robot, table))
    statuses = {status: int(np.sum(table["status"] == status)) for status in STATUSES}
    flags = {name: int(np.sum(np.char.find(table["flags"], name) >= 0)) for name in FLAGS}
    about = {"model": model, "runs": len(table["status"]), "statuses": statuses, "flags": flags}
    folder.write_json("result.json", {"schema": f"mmrjax.{folder.command}/1", **(further or {}), **about})
    return finish_run_folder(folder, {"seed": None, "statuses": statuses}, page, words.every_run_solved(statuses))


#: Suffixes of an output's columns: standard deviation, ends of the 95 % interval.
SD, LOWER, UPPER = "_sd", "_lower", "_upper"
#: Column with the share of draws that converge.
SHARE = "posterior_converged"
QUANTILES = (0.025, 0.975)
#: Random seed of the draws.
SEED = 0


def simulate_draws(
    robot: Robot, posterior: Posterior, runs: Runs, config: FidelityPart, draws: int, folder: RunFolder | None = None
) -> Columns:
    """Simulates every run with robots drawn from the posterior: a sweep of the runs combined with the draws.

    The result is the uncertainty of the model's prediction, without the noise of readings. Each draw is one robot for
    all runs. Draws that do not converge in a run are omitted there. `SHARE` has the share of those that do.

    Returns:
        For each output its sd and the ends of its 95 % interval, NaN if fewer than two draws converge.
    """
    samples = DrawnSamples(tuple(posterior.names), posterior.draw(draws, SEED).T)
    job = job_of_run_table(robot, runs, config, samples)
    slow = fidelities.fidelity_facts(config.model).slow or draws * len(runs) > 100_000

    def summary(found: Table) -> Table:
        by_name = {name: values.reshape(-1, draws) for name, values in found.items()}
        counts = np.isin(by_name[STATUS], DONE) & np.isfinite(by_name[robot.channels[0].name])
        return _summary({o.column: by_name[o.name] for o in outputs.output_table(robot.channels)}, counts)

    draws_fit_chunk = job.blocks.size[-1] == draws  # then a chunk is stored as a summary
    with progress_bar(draws, quiet=not slow, doing="draws") as advance:
        chunks = compute_chunks(
            job, folder, "draws", lambda points: advance(points / len(runs)), summary if draws_fit_chunk else dict
        )
    return chunks if draws_fit_chunk else summary(chunks)


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


def interval_ranges(table: Columns, channels: tuple[Channel, ...], draws: int) -> list[str]:
    """Range of every channel over the runs, each end with its sd, and the number of draws that do not converge."""
    first_column = channels[0].column
    rows = np.flatnonzero(np.isfinite(table[first_column + SD]) & np.isfinite(table[first_column]))
    ranges = []
    for c in channels if len(rows) else ():
        value, sd = table[c.column], table[c.column + SD]
        least, most = rows[np.argmin(value[rows])], rows[np.argmax(value[rows])]
        ends = [with_sd(value[k], sd[k], c.resolution) for k in dict.fromkeys((int(least), int(most)))]
        ranges.append(f"{c.label}: {' to '.join(ends)} {c.unit}")
    first_remark, *more_remarks = interval_remarks(table, draws, "the table")
    return [*[first_remark] * bool(ranges), *ranges, *more_remarks]


def interval_remarks(table: Columns, draws: int, place: str = "runs.csv") -> list[str]:
    """Number of drawn robots and, if some do not converge, their number and that of the runs."""
    is_incomplete = table[SHARE] < 1
    remarks = [f"± one sd over {draws} robots drawn from the posterior. 95 % intervals are in {place}"]
    if is_incomplete.any():
        share = 100 * (1 - table[SHARE].min())
        remarks.append(
            f"in {int(is_incomplete.sum())} of {len(is_incomplete)} runs some draws fail (up to {share:.0f} %) "
            "and are left out"
        )
    return remarks


def with_sd(value: float, sd: float, most: int) -> str:
    """«4.19 ± 0.06», to two digits of the sd and at most `most` decimals."""
    if not (np.isfinite(sd) and sd > 0):
        return f"{value:z.{most}f} ± {sd:.{most}f}"
    digits = int(np.clip(1 - np.floor(np.log10(sd)), 0, most))
    return f"{value:z.{digits}f} ± {sd:.{digits}f}"
