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

#: Number of steps of `compare` for each step of a fit.
STEPS_PER_FIT_STEP = 4


def ending_columns(robot: Robot, batch: RunBatch) -> Columns:
    """Columns with results at the end of a batch of runs, including those specific to the fidelity."""
    result, fidelity_columns = jax.device_get((batch.result, batch.columns))
    return outputs.output_columns(result, robot.channels, fidelity_columns)


def check_fidelity_options(robot: Robot, conditions: Conditions, config: FidelityPart) -> None:
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
    select: Callable[[Columns], Columns] = dict,
) -> Columns:
    """Outputs of all chunks of a job, in order.

    Args:
        folder: folder for the chunks, if any. Chunks from an interrupted command are not computed again.
        name: prefix of the names of the chunks.
        select: function that selects outputs of a chunk, in the units of tables, shape (points,). Default: all.
    """
    chunks = range(len(job.blocks))
    files = [f"{name}-{k:06d}" for k in chunks]
    stored = {} if folder is None else {k: part for k in chunks if (part := folder.chunk(files[k])) is not None}
    chunks_left = [k for k in chunks if k not in stored]
    advance(sum(map(job.blocks.count, stored)))

    def store_chunk(chunk: int, arrays: Columns, _: Any) -> None:
        stored[chunk] = select(arrays)
        if folder is not None:
            folder.keep_chunk(files[chunk], stored[chunk])

    if chunks_left:
        scale.write_chunks(store_chunk, scale.CompiledJob(job), chunks_left, advance)
    results = [stored.pop(k) for k in chunks]
    return {column: np.concatenate([part.pop(column) for part in results]) for column in tuple(results[0])}


def job_of_run_table(robot: Robot, runs: Runs, config: FidelityPart, samples: DrawnSamples | None = None) -> Job:
    """Job for every output of the runs of a table, each combined with every sample if there are samples.

    Raises:
        BadConfiguration: the fidelity cannot simulate a run.
    """
    rows = conditions_of_runs(robot, runs, config)
    check_fidelity_options(robot, rows, config)
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
    is_slow = fidelities.fidelity_facts(config.model).slow or len(job.blocks) > 1
    with progress_bar(len(runs), quiet=not is_slow) as advance:
        chunks = compute_chunks(job, folder, "chunk", advance)
    columns = {row.column: chunks[row.name] for row in outputs.output_table(robot.channels)}
    fidelity_columns = {name: chunks[name] for name in fidelities.get_fidelity(config.model).columns}
    return {
        **condition_table(robot, runs),
        **columns,
        **outputs.status_words(chunks[STATUS], chunks[FLAGS_CODE]),
        **fidelity_columns,
    }


def simulate_histories(robot: Robot, runs: Runs, model: str | None) -> Columns:
    """Conditions and simulated outputs for every row of a table of time histories.

    Its steps are finer than in fits, which simulate up to thousands of times.

    Args:
        robot: prepared for the table.
        model: requested fidelity. None: the fidelity for histories.

    Raises:
        BadConfiguration: the fidelity cannot simulate time histories.
    """
    histories = jax.device_get(
        _observe(observers.Histories.of(runs, robot, model, STEPS_PER_FIT_STEP), params.without_weak_types(robot))
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
        unloaded_masses = np.array([float(chassis.mass) for chassis in robot.configurations.members])
        columns["total_mass_kg"] = unloaded_masses[runs.configurations(robot)] + runs["payload_kg"]
    order = ("configuration", *dict.fromkeys((*runs.layout.axes, *runs.axes)), "surface", "run_id")
    return {key: columns[key] for key in order if key in columns}


def run_names(runs: Runs) -> np.ndarray:
    """Names of runs: those of their table, otherwise numbers."""
    return runs["run_id"] if runs.has("run_id") else np.array([f"run-{k + 1}" for k in range(len(runs))])


def write_run_folder(folder: RunFolder, model: str, table: Columns, page: Page, entries: Json | None = None) -> int:
    """Writes the files common to all simulating commands, and moves the folder into place. Returns the exit code.

    Args:
        model: fidelity of the runs.
        table: conditions and results by column.
        page: page of the command.
        entries: further entries of `result.json`.
    """
    folder.write_table("runs.csv", capabilities.drop_inapplicable_columns(folder.robot, table))
    statuses = {status: int(np.sum(table["status"] == status)) for status in STATUSES}
    flags = {name: int(np.sum(np.char.find(table["flags"], name) >= 0)) for name in FLAGS}
    counts = {"model": model, "runs": len(table["status"]), "statuses": statuses, "flags": flags}
    folder.write_json("result.json", {"schema": f"mmrjax.{folder.command}/1", **(entries or {}), **counts})
    return finish_run_folder(folder, {"seed": None, "statuses": statuses}, page, words.every_run_solved(statuses))


#: Suffixes of an output's columns: standard deviation, ends of the 95 % interval.
SD, LOWER, UPPER = "_sd", "_lower", "_upper"
#: Column with the share of draws that converge.
CONVERGED_SHARE = "posterior_converged"
QUANTILES = (0.025, 0.975)
#: Random seed of the draws.
SEED = 0


def simulate_draws(
    robot: Robot, posterior: Posterior, runs: Runs, config: FidelityPart, draws: int, folder: RunFolder | None = None
) -> Columns:
    """Simulates every run with robots drawn from the posterior: a sweep of the runs combined with the draws.

    The result is the uncertainty of the model's prediction, without the noise of readings. Each draw is one robot for
    all runs. Draws that do not converge in a run are omitted there. `CONVERGED_SHARE` has the share of those that do.

    Returns:
        For each output its sd and the ends of its 95 % interval, NaN if fewer than two draws converge.
    """
    samples = DrawnSamples(tuple(posterior.names), posterior.draw(draws, SEED).T)
    job = job_of_run_table(robot, runs, config, samples)
    is_slow = fidelities.fidelity_facts(config.model).slow or draws * len(runs) > 100_000

    def summarise(outputs_of_chunk: Columns) -> Columns:
        by_name = {name: values.reshape(-1, draws) for name, values in outputs_of_chunk.items()}
        is_converged = np.isin(by_name[STATUS], DONE) & np.isfinite(by_name[robot.channels[0].name])
        return _summary(
            {output.column: by_name[output.name] for output in outputs.output_table(robot.channels)}, is_converged
        )

    draws_fit_chunk = job.blocks.size[-1] == draws  # then a chunk is stored as a summary
    with progress_bar(draws, quiet=not is_slow, doing="draws") as advance:
        chunks = compute_chunks(
            job, folder, "draws", lambda points: advance(points / len(runs)), summarise if draws_fit_chunk else dict
        )
    return chunks if draws_fit_chunk else summarise(chunks)


def _summary(columns: Columns, is_converged: np.ndarray) -> Columns:
    """Spread of each column over draws. Arrays have shape (runs, draws). `is_converged`: True if a draw converges."""
    has_two_draws = is_converged.sum(1) >= 2
    by_column: Columns = {}
    for column, values in columns.items():
        values_kept = np.where(has_two_draws[:, None], np.where(is_converged, values, np.nan), 0.0)
        with np.errstate(invalid="ignore"):  # windings that never settle
            low, high = np.nanquantile(values_kept, QUANTILES, axis=1)
            sds = np.nanstd(values_kept, 1, ddof=1)
        by_column |= {
            column + end: np.where(has_two_draws, value, np.nan)
            for end, value in ((SD, sds), (LOWER, low), (UPPER, high))
        }
    return {**by_column, CONVERGED_SHARE: is_converged.mean(1)}


def interval_ranges(table: Columns, channels: tuple[Channel, ...], draws: int) -> list[str]:
    """Range of every channel over the runs, each end with its sd, and the number of draws that do not converge."""
    first_column = channels[0].column
    rows = np.flatnonzero(np.isfinite(table[first_column + SD]) & np.isfinite(table[first_column]))
    ranges = []
    for channel in channels if len(rows) else ():
        value = table[channel.column]
        sd = table[channel.column + SD]
        lowest_row, highest_row = rows[np.argmin(value[rows])], rows[np.argmax(value[rows])]
        texts = [
            with_sd(value[k], sd[k], channel.resolution) for k in dict.fromkeys((int(lowest_row), int(highest_row)))
        ]
        ranges.append(f"{channel.label}: {' to '.join(texts)} {channel.unit}")
    first_remark, *more_remarks = interval_remarks(table, draws, "the table")
    return [*[first_remark] * bool(ranges), *ranges, *more_remarks]


def interval_remarks(table: Columns, draws: int, place: str = "runs.csv") -> list[str]:
    """Remarks on the number of drawn robots and, if some draws fail, on the runs in which they do."""
    is_incomplete = table[CONVERGED_SHARE] < 1
    remarks = [f"± one sd over {draws} robots drawn from the posterior. 95 % intervals are in {place}"]
    if is_incomplete.any():
        share = 100 * (1 - table[CONVERGED_SHARE].min())
        remarks.append(
            f"in {int(is_incomplete.sum())} of {len(is_incomplete)} runs some draws fail (up to {share:.0f} %) "
            "and are left out"
        )
    return remarks


def with_sd(value: float, sd: float, max_digits: int) -> str:
    """«4.19 ± 0.06», to two digits of the sd and at most `max_digits` decimals."""
    if not (np.isfinite(sd) and sd > 0):
        return f"{value:z.{max_digits}f} ± {sd:.{max_digits}f}"
    digits = int(np.clip(1 - np.floor(np.log10(sd)), 0, max_digits))
    return f"{value:z.{digits}f} ± {sd:.{digits}f}"
