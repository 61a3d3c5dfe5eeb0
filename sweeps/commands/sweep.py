"""The command `sweep`: simulates the points of a grid or a plan into a table of runs or a Zarr store."""

from __future__ import annotations

import dataclasses
import errno
import math
import shutil
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich import filesize

from calibration.data import Json, profiles
from calibration.data.input_errors import BadConfiguration, InputError
from calibration.data.robot_file import RobotFile
from calibration.data.writing import replacing
from mmrjax.fidelities import outputs
from mmrjax.model import channels, quantities
from mmrjax.model.paper_tables import COULOMB_PER_MAH
from mmrjax.model.signals import FLAGS, STATUSES
from sweeps import config_campaign
from sweeps.config import Sweep
from sweeps.config_campaign import Campaign, StoreOptions
from sweeps.console import print_message, print_output, progress_bar
from sweeps.inputs import load_robot, posterior_beside_robot
from sweeps.pages import words
from sweeps.points import axes, grid, run, scale
from sweeps.points.job import prepare_job, robot_for_turns, store_layout
from sweeps.points.sampled_design import Blocks
from sweeps.points.tasks import task_of_configuration
from sweeps.points.zarr_store import STORE, ChunkRecord, Identity, StoreLayout, SweepStore, job_identity
from sweeps.report import sweep_report
from sweeps.report.document import Column, Table
from sweeps.report.run_tables import endings_table
from sweeps.report.terminal_renderer import print_table
from sweeps.store import DONE, IDENTITY, SOLVER_FAILED, default_path, finish_run_folder, open_folder, print_report

#: Most runs of a grid for which a table (runs.csv) is written. More runs go to a store, which takes a tenth of time
#: and space.
MAX_TABLE_RUNS = 100_000
#: Space on the disk that must stay free besides the store [bytes].
FREE_MARGIN = 64 * 2**20
#: Number of points for estimating the time of a slow fidelity.
TIMED_POINTS = 64


def execute(config: Campaign | Sweep, invocation: StoreOptions) -> int:
    """Simulates a sweep and writes a run folder. Returns the exit code.

    A grid of at most `MAX_TABLE_RUNS` runs becomes a table, unless an option of a store is given.
    """
    file = load_robot(config)
    if not isinstance(config, Sweep):
        return _sweep_into_store(config, file, invocation)
    notes: list[str] = []
    resolved = grid.resolve_grid(config, file.robot, config.battery, notes)
    run_count = math.prod(map(len, grid.grid_axes(resolved, file.robot, config.battery).values()))
    writes_table = not invocation.of_store and (run_count <= MAX_TABLE_RUNS or config.posterior is not None)
    if not invocation.of_store and not writes_table:
        print_message(
            f"{run_count:,} points: too many for runs.csv ({MAX_TABLE_RUNS:,}), see {STORE} or add --export csv"
        )
    for note in notes:
        print_message(note)
    if writes_table:
        return _sweep_into_table(resolved, file, invocation)
    sweep_config = resolved.model_copy(update={"configurations": config.configurations})
    return _sweep_into_store(config_campaign.campaign_of_grid(sweep_config), file, invocation)


def _sweep_into_table(config: Sweep, file: RobotFile, invocation: StoreOptions) -> int:
    robot = file.robot
    runs = grid.grid_conditions(config, robot, config.battery)
    posterior = None if config.posterior is None else posterior_beside_robot(file)
    with open_folder("sweep", config, robot, invocation) as folder:
        table = run.evaluate_runs(robot, runs, config, folder)
        notes: list[str] = []
        if posterior is not None and config.posterior is not None:
            table |= run.simulate_draws(robot, posterior, runs, config, config.posterior, folder)
            notes = run.interval_ranges(table, robot.channels, config.posterior)
        page = print_report(sweep_report.sweep_document(file, config.model, table, notes), file)
        return run.write_run_folder(folder, config.model, table, page)


def _sweep_into_store(config: Campaign, file: RobotFile, invocation: StoreOptions) -> int:
    robot, where = file.robot, invocation.where
    plan = axes.plan_design(config, robot, where)
    robot = robot_for_turns(robot, {*plan.axes, *plan.conditions})
    task = task_of_configuration(config, robot)
    output_names = invocation.outputs or config.outputs or task.default_outputs
    chunk = config.chunk or scale.default_chunk(task)
    config = config.model_copy(update={"chunk": chunk, "outputs": output_names})
    job = prepare_job(config, robot, plan, where)
    layout = store_layout(config, job)
    path = invocation.out or default_path("sweep")
    if invocation.dry_run:
        dry_run(job, layout, path)
        return DONE
    files = [*([config.robot] if Path(config.robot).is_file() else []), *config.effects, *plan.data]
    files += [config.profile] if config.profile is not None and config.profile not in profiles.PACKAGED else []
    identity = job_identity(config, robot, files, scale.device_kind())
    if not any((folder / IDENTITY).is_file() for folder in (path, path.with_name(f"{path.name}.partial"))):
        _reject_without_space(layout.size, 1.0, path)  # a continued sweep needs less
    store = SweepStore(path, identity, layout, force=invocation.force)
    try:
        if not store.finished:
            simulate_chunks(store, job, invocation)
        return finish_sweep(store, config, file, job, identity, invocation)
    except BaseException:
        if invocation.shard is None:
            store.abandon()
        raise
    finally:
        store.close()


# --- before ---------------------------------------------------------------------------------------------------------


def dry_run(job: scale.Job, layout: StoreLayout, path: Path) -> None:
    """Reports points, chunks, bytes and expected time of a sweep. Nothing is written."""
    compiled = scale.CompiledJob(job)
    blocks = job.blocks
    is_slow = job.task.slow
    if is_slow and blocks.points > TIMED_POINTS:
        small_blocks = Blocks.of(job.plan.design.shape, TIMED_POINTS)
        compiled = scale.CompiledJob(dataclasses.replace(job, blocks=small_blocks))
    durations = []
    for _ in range(2 if is_slow else 4):  # the first call compiles
        start = time.perf_counter()
        scale.fetch_values(compiled(compiled.points(0)), 1)
        durations.append(time.perf_counter() - start)
    seconds = min(durations[1:]) / compiled.size
    design = job.plan.design
    dimensions = " x ".join(f"{n} {name}" for n, name in zip(design.shape, design.dimensions, strict=True))
    folder, free_bytes = _disk_space(path)
    rows = {
        "points": f"{design.points:,} ({dimensions})",
        "chunks": f"{len(blocks):,} of {blocks.points:,} points on {compiled.mesh.size} x {scale.device_kind()}",
        "store": f"{filesize.decimal(layout.size)} (uncompressed); free {filesize.decimal(free_bytes)} in {folder}",
        "time": f"about {duration_text(seconds * blocks.points * len(blocks))} once compiled, "
        f"{1 / seconds:,.0f} points/s (timed here on {compiled.size:,} points). Compiling "
        f"{duration_text(max(durations[0] - durations[1], 0.0))}",
    }
    print_table(Table("dry-run", (Column("a sweep of"), Column("")), list(rows.items())))
    _reject_without_space(layout.size, 1.0, path)


def _disk_space(path: Path) -> tuple[Path, int]:
    """Existing folder that will contain a path, and the free space there [bytes]."""
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    return folder, shutil.disk_usage(folder).free


def _reject_without_space(size: int, share_left: float, path: Path) -> None:
    """Rejects a sweep whose results would not fit on the disk.

    Args:
        size: size of the whole store [bytes].
        share_left: share that is not yet written.
    """
    needed_bytes = math.ceil(size * share_left) + FREE_MARGIN
    (folder, free_bytes) = _disk_space(path)
    if needed_bytes > free_bytes:
        raise BadConfiguration(
            f"--out: results need {filesize.decimal(needed_bytes)} (uncompressed); {folder} has "
            f"{filesize.decimal(free_bytes)} free; choose another disk, fewer points or outputs, or "
            'storage = "float32"'
        )


def duration_text(seconds: float) -> str:
    for unit, length in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.2g} s"


# --- the run --------------------------------------------------------------------------------------------------------


def chunks_of_shard(share: tuple[int, int], chunks: int) -> range:
    """Chunks of share k of n."""
    k, n = share
    return range((k - 1) * chunks // n, k * chunks // n)


def simulate_chunks(store: SweepStore, job: scale.Job, invocation: StoreOptions) -> None:
    """Computes and writes the unfinished chunks of this process's share.

    Raises:
        BadConfiguration: the disk has too little space or becomes full.
    """
    store.begin(invocation.share)
    done = store.done()
    shard_chunks = chunks_of_shard(invocation.share, len(job.blocks))
    chunks_left = [k for k in shard_chunks if k not in done]
    _reject_without_space(store.layout.size, len(chunks_left) / len(job.blocks), store.path)
    if not chunks_left:
        return
    total = sum(job.blocks.count(k) for k in shard_chunks)
    points_before = total - sum(job.blocks.count(k) for k in chunks_left)
    if points_before:
        print_message(f"{store.partial}: resumes after {points_before:,} of {total:,} points")
    try:
        with progress_bar(total, quiet=False, done=points_before, rate=True) as advance:
            scale.write_chunks(store.write, scale.CompiledJob(job), chunks_left, advance)
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        count = len(store.done())
        raise InputError(
            f"{store.partial}: {error.strerror} after {count} of {len(job.blocks)} chunks. Free some space, and "
            "the same command resumes"
        ) from error


def finish_sweep(
    store: SweepStore, config: Campaign, file: RobotFile, job: scale.Job, identity: Identity, invocation: StoreOptions
) -> int:
    """Writes the files of a complete sweep and moves it into place, or reports the progress of an incomplete one."""
    completes_now = False
    if not store.finished:
        with store.finishing() as completes_now:
            if completes_now:
                # write all files of a run folder except the store, then move the store into place
                summary = sweep_summary(store.layout, job, store.done().values())
                store.write_json("result.json", summary)
                manifest = {
                    "statuses": summary["statuses"],
                    "seed": config.samples.get("seed", 0),
                    "hashes": identity["data"],
                }
                document = sweep_report.campaign_document(file, store.layout, summary, store.partial / STORE)
                store.config = config
                store.robot = job.robot
                finish_run_folder(store, manifest, print_report(document, file))
    done = store.done()
    if not store.finished:
        print_output(
            f"{len(done)} of {len(job.blocks)} chunks of {store.partial} are finished. The last share, or no "
            "--shard, completes the sweep"
        )
        return DONE
    for kind in invocation.export:
        print_message(str(export_runs(kind, store.path, store.layout)))
    counts = points_by_status(done.values())
    if not completes_now:
        print_table(endings_table(counts, "points", job.task.model))
        print_output(str(store.path))
    return DONE if words.every_run_solved(counts) else SOLVER_FAILED


def sweep_summary(layout: StoreLayout, job: scale.Job, records: Iterable[ChunkRecord]) -> Json:
    """`result.json`."""
    records = list(records)
    units = {name: a["units"] for name, (_, a) in layout.variables.items() if "units" in a}
    names = [name for name in job.outputs if name in units]
    ranges = {name: [record.ranges[name] for record in records if name in record.ranges] for name in names}
    return {
        "schema": "mmrjax.sweep_store/1",
        "store": STORE,
        "model": job.task.model,
        "points": job.plan.design.points,
        "dimensions": dict(zip(job.plan.design.dimensions, job.plan.design.shape, strict=True)),
        "samples": list(job.plan.design.samples.names) if job.plan.design.samples is not None else [],
        "statuses": points_by_status(records),
        "outputs": {
            name: {
                "unit": units[name],
                "least": min((low for low, _ in extremes), default=None),
                "greatest": max((high for _, high in extremes), default=None),
            }
            for name, extremes in ranges.items()
        },
    }


def points_by_status(records: Iterable[ChunkRecord]) -> dict[str, int]:
    """Number of points with each status, zeros included."""
    total = np.sum([record.statuses for record in records], axis=0, dtype=int)
    return dict(zip(STATUSES, np.broadcast_to(total, len(STATUSES)).tolist(), strict=True))


#: Columns of conditions, as in tables of runs and options, and their unit in the unit of the store. Other quantities
#: keep their names.
COLUMNS = {c.field: (c.column, 1.0) for c in quantities.SET if c.in_tables and c.field} | {
    "motor_speed": ("motor_speed_rpm", quantities.RPM),
    "motor_current": ("motor_current_A", 1.0),
    "discharge": ("discharge_mAh", COULOMB_PER_MAH),
}


def export_runs(kind: str, folder: Path, layout: StoreLayout) -> Path:
    """Writes `runs.csv` or `runs.parquet` into a finished run folder. Returns the path.

    One row for each point, in order. Numbers that are not finite become empty cells.
    """
    import pyarrow as pa
    from pyarrow import csv, parquet

    path = folder / f"runs.{kind}"
    writer = None
    with replacing(path) as temporary:
        for part in chunk_tables(folder / STORE, layout):
            if kind == "csv":
                fields = [f.with_type(pa.string()) if pa.types.is_dictionary(f.type) else f for f in part.schema]
                part = part.cast(pa.schema(fields))
            if writer is None and kind == "csv":
                quoting = csv.WriteOptions(quoting_style="needed")
                writer = csv.CSVWriter(temporary, part.schema, write_options=quoting)
            elif writer is None:
                writer = parquet.ParquetWriter(temporary, part.schema)
            writer.write_table(part)
        assert writer is not None  # a sweep has at least one chunk
        writer.close()
    return path


def chunk_tables(store: Path, layout: StoreLayout) -> Iterator[Any]:
    """Yields the points of each chunk as an Arrow table."""
    import pyarrow as pa
    import zarr

    group = zarr.open_group(store, mode="r")
    columns = {row.name: row.column for row in outputs.output_table(channels.EVERY)}
    flag_texts = [";".join(f for k, f in enumerate(FLAGS) if bits >> k & 1) for bits in range(1 << len(FLAGS))]

    def labelled(numbers: np.ndarray, labels: Sequence[str]) -> Any:
        return pa.DictionaryArray.from_arrays(numbers.astype(np.int32), list(labels))

    for box in map(layout.blocks.box, range(len(layout.blocks))):
        table: dict[str, Any] = {}
        for name, values in zip(layout.design.names, layout.design.values_in_slices(box).T, strict=True):
            column, unit = COLUMNS.get(name, (name, 1.0))
            axis_labels = layout.labels.get(name)
            table[column] = pa.array(values / unit) if axis_labels is None else labelled(values, axis_labels)
        for name, (dtype, attributes) in layout.variables.items():
            array: Any = group[name]
            chunk_values = array[box].ravel()
            if np.dtype(dtype).kind == "f":
                table[columns.get(name, name)] = pa.array(chunk_values, from_pandas=True)
            else:
                labels = flag_texts if "flag_masks" in attributes else attributes["flag_meanings"].split()
                table[name] = labelled(chunk_values, labels)
        yield pa.table(table)
