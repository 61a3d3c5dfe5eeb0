"""Engine of all sweeps: chunks of one compiled shape on all local devices, each stored while the next is computed.

A grid, a plan, the rows of a table and draws of a posterior are designs of points. Results are stored in a Zarr store
or as chunks of a run folder.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import queue
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float

from calibration.data import Columns, Json, Names
from mmrjax import WORKER, fidelities
from mmrjax.compile.compiling import Threads, compiled
from mmrjax.fidelities import outputs
from mmrjax.fidelities.variation import FLAGS, STATUS, Variation, evaluate_points, pick_outputs
from mmrjax.missions.profile import Profile
from mmrjax.model.conditions import Conditions
from mmrjax.model.paper_tables import adhesion_ratio
from mmrjax.model.robot import Robot
from sweeps.console import progress_bar
from sweeps.points.axes import SweepPlan
from sweeps.points.sampled_design import ROW, Blocks
from sweeps.points.tasks import VERDICT, Task

POINTS = "points"
#: Chunks with more points per device are padded to a multiple of this, so that designs of all sizes share few
#: programs.
PADDING_MULTIPLE = 16_384
#: Chunks that may be queued for writing.
QUEUED_CHUNKS = 1
#: Time after an interrupt for writing computed chunks, in each of two steps [s].
WRITING_TIME = 2.5
#: Types of stored outputs that are not numbers.
STORED_TYPES = {STATUS: "uint8", FLAGS: "uint16", VERDICT: "uint8"}


@dataclasses.dataclass(frozen=True)
class Job:
    """All data needed to compute any chunk of a sweep.

    Attributes:
        robot: robot that is varied.
        task: computation at each point.
        outputs: names of the outputs.
        storage: data type of stored outputs.
        profile: profile that every point follows, if any.
    """

    robot: Robot
    task: Task
    plan: SweepPlan
    outputs: Names
    storage: str
    blocks: Blocks
    profile: Profile | None = None


def device_kind() -> str:
    """Kind of the local devices, in words."""
    device = jax.local_devices()[0]
    return f"{device.platform}: {device.device_kind}"


def default_chunk(task: Task) -> int:
    """Default number of points in a chunk, on all local devices."""
    return task.points_per_call[not device_kind().startswith("cpu")] * len(jax.local_devices())


class CompiledJob:
    """A job on the local devices: a program for chunks of one shape, whose points are split among the devices."""

    def __init__(self, job: Job, devices: list[Any] | None = None) -> None:
        self.job = job
        devices = jax.local_devices() if devices is None else devices
        self.mesh = Mesh(np.array(devices), (POINTS,))
        # Every device gets the same number of points. The last point of a chunk is repeated to fill it.
        points_per_device = -(-job.blocks.points // len(devices))
        if job.task.run is None:
            points_per_device = fidelities.fidelity_facts(job.task.model).filled(points_per_device)
        if points_per_device >= PADDING_MULTIPLE:
            points_per_device = -(-points_per_device // PADDING_MULTIPLE) * PADDING_MULTIPLE
        self.size = points_per_device * len(devices)
        everywhere = NamedSharding(self.mesh, PartitionSpec())
        tree = (job.plan.varied(job.robot), job.plan.fixed())
        arrays, static_parts = eqx.partition(tree, eqx.is_array)
        self._variation, self._fixed = eqx.combine(jax.device_put(arrays, everywhere), static_parts)
        self._split = NamedSharding(self.mesh, PartitionSpec(POINTS))
        factors = {row.name: row.factor for row in outputs.output_table(job.robot.channels)}
        surface = job.plan.surface
        tracked = job.robot.configurations.tracked
        ratios = None if surface is None else tuple(adhesion_ratio(surface, x) for x in tracked)
        self._requested = _RequestedOutputs(
            job.task.model, tuple(job.task.options.items()), tuple((n, factors.get(n, 1.0)) for n in job.outputs),
            job.storage, ratios,
        )  # fmt: skip
        # Long computations run in parts. Between parts they report progress and can be interrupted.
        is_split = len(devices) > 1 or self._variation.varies_robot
        self.in_parts = job.task.slow and (job.task.run is not None or not is_split)
        self._program = _one_device_compiled if len(devices) == 1 else eqx.filter_jit(_split_among(self.mesh))

    def points(self, chunk: int) -> Float[np.ndarray, "points names"]:
        """Values of a chunk's points, padded with the last one to the compiled shape."""
        values = self.job.plan.design.values_in_slices(self.job.blocks.box(chunk))
        if len(values) == self.size:
            return values
        return values[np.minimum(np.arange(self.size), len(values) - 1)]

    def __call__(
        self, values: Float[np.ndarray, "points names"], report_share: Callable[[float], None] | None = None
    ) -> dict[str, Array]:
        """Starts the computation. Returns arrays of the compiled shape, which may still be in progress.

        Args:
            report_share: callback for the share that is done, if `in_parts`.
        """
        conditions = self._fixed
        rows = self.job.plan.rows
        if rows is not None:
            row_numbers = values[:, 0].astype(int)
            values = values[:, 1:]
            conditions = jax.tree.map(lambda x: jax.device_put(np.asarray(x)[row_numbers], self._split), rows)
        names = [name for name in self.job.plan.design.names if name != ROW]
        task_columns = [k for k, name in enumerate(names) if name in self.job.task.axes]
        on_devices = jax.device_put(np.delete(values, task_columns, axis=1) if task_columns else values, self._split)
        if self.in_parts:
            conditions = _broadcast(
                _on_surface(self._variation, conditions, on_devices, self._requested.surface), len(values)
            )
            run = self.job.task.run or self._run
            sizes = values[:, task_columns[0]] if task_columns else None
            return _in_stored_form(
                run(self._variation, conditions, on_devices, sizes, report_share or (lambda share: None)),
                self._requested,
            )
        values_by_name: dict[str, Array] = self._program(
            self._variation, conditions, on_devices, self._requested, self.job.profile
        )
        return values_by_name

    def _run(self, variation: Variation, conditions: Conditions, values: Array, _: Any, report_share: Advance) -> Any:
        """Runs the fidelity."""
        robot, conditions = variation.at(values, conditions)
        run = fidelities.get_fidelity(self.job.task.model).run(robot, conditions, self.job.task.options, report_share)
        return pick_outputs(run, robot.channels, self.job.outputs)


class _RequestedOutputs(NamedTuple):
    """Outputs of a fidelity with its options at each point, and their form in the store.

    Attributes:
        factors: SI value of each output's unit in tables.
        surface: adhesion of each configuration relative to that on the bench.
    """

    model: str
    options: tuple[tuple[str, float], ...]
    factors: tuple[tuple[str, float], ...]
    storage: str
    surface: tuple[float, ...] | None


def _broadcast(conditions: Conditions, points: int) -> Conditions:
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (points,)), conditions)


def _on_surface(
    variation: Variation, conditions: Conditions, values: Array, surface: tuple[float, ...] | None
) -> Conditions:
    """Conditions of points, with the adhesion of their configurations on the stated surface, if any."""
    if surface is None:
        return conditions
    _, point_conditions = variation.at(values, conditions)
    ratio = jnp.asarray(surface)[jnp.broadcast_to(point_conditions.configuration, values.shape[:1])]
    return dataclasses.replace(_broadcast(conditions, len(values)), adhesion=ratio)


def _one_device(
    variation: Variation, conditions: Conditions, values: Array, requested: _RequestedOutputs, profile: Profile | None
) -> dict[str, Array]:
    """Outputs of points in stored form."""
    conditions = _on_surface(variation, conditions, values, requested.surface)
    names = tuple(name for name, _ in requested.factors)
    values_by_name = evaluate_points(
        variation, requested.model, values, conditions, dict(requested.options), names, profile
    )
    return _in_stored_form(values_by_name, requested)


_one_device_compiled = compiled(_one_device)


def _in_stored_form(values_by_name: Mapping[str, Array], requested: _RequestedOutputs) -> dict[str, Array]:
    """Outputs in the units of tables and in the stored type. Outputs in `STORED_TYPES` have their own type."""
    stored = {
        name: (values_by_name[name] / factor).astype(requested.storage)
        for name, factor in requested.factors
        if name not in STORED_TYPES
    }
    unconverted_names = (*(name for name, _ in requested.factors if name in STORED_TYPES), STATUS)
    return {**stored, **{name: values_by_name[name].astype(STORED_TYPES[name]) for name in unconverted_names}}


def _split_among(mesh: Mesh) -> Callable[..., dict[str, Array]]:
    """`_one_device` on several devices, each with its share of the points."""

    def program(
        variation: Variation,
        conditions: Conditions,
        values: Array,
        requested: _RequestedOutputs,
        profile: Profile | None,
    ) -> dict[str, Array]:
        arrays, static_parts = eqx.partition((variation, profile), eqx.is_array)
        sharding = PartitionSpec(POINTS) if conditions.shape else PartitionSpec()

        def share_of_device(arrays: Any, conditions: Conditions, values: Array) -> dict[str, Array]:
            variation, profile = eqx.combine(arrays, static_parts)
            return _one_device(variation, conditions, values, requested, profile)

        # Each device has its own loops, so no device waits for another inside a loop.
        program_on_mesh = jax.shard_map(
            share_of_device,
            mesh=mesh,
            in_specs=(PartitionSpec(), sharding, PartitionSpec(POINTS)),
            out_specs=PartitionSpec(POINTS),
            check_vma=False,
        )
        return program_on_mesh(arrays, conditions, values)

    return program


#: A chunk in progress: number, results by variable, values of its points, and number of points reported as done.
#: Results may still be on a device.
Piece = tuple[int, dict[str, Array], np.ndarray, float]
Advance = Callable[[float], None]
#: Stores a chunk by its number: values of its points by variable, and values of its samples, one row for each
#: name, None if another chunk writes them.
StoreChunk = Callable[[int, Columns, np.ndarray | None], Any]


def produce_chunks(compiled_job: CompiledJob, chunks: Iterable[int], advance: Advance) -> Iterator[Piece]:
    """Computes chunks on the local devices, in order. The points of the next chunk are prepared meanwhile.

    Args:
        advance: callback for the number of further points that are done, for chunks that are computed in parts.
    """
    with Threads(1) as thread:
        prepared = deque[tuple[int, concurrent.futures.Future[Any]]]()
        for chunk in chunks:
            prepared.append((chunk, thread.submit(compiled_job.points, chunk)))
            if len(prepared) > 1:
                yield _start_chunk(compiled_job, *prepared.popleft(), advance)
        while prepared:
            yield _start_chunk(compiled_job, *prepared.popleft(), advance)


def _start_chunk(
    compiled_job: CompiledJob, chunk: int, points: concurrent.futures.Future[Any], advance: Advance
) -> Piece:
    values = points.result()
    if not compiled_job.in_parts:
        return chunk, compiled_job(values), values, 0.0
    count = compiled_job.job.blocks.count(chunk)
    report_share = share_counter(advance, count)
    arrays = compiled_job(values, report_share)
    report_share(1.0)
    return chunk, arrays, values, count


@contextlib.contextmanager
def share_progress(count: int = 1, quiet: bool = False) -> Iterator[Callable[[float], None]]:
    """Progress bar of `count` runs in one batch. Yields a function to call with the share that is done."""
    with progress_bar(count, quiet) as advance:
        report_share = share_counter(advance, count)
        yield report_share
        report_share(1.0)


def share_counter(advance: Advance, count: int) -> Callable[[float], None]:
    """Callback for the share of `count` runs that is done so far, which passes the increase to `advance`."""
    so_far = 0.0

    def report_share(share: float) -> None:
        nonlocal so_far
        advance(count * share - so_far)
        so_far = count * share

    return report_share


def fetch_values(arrays: Json, count: int) -> Columns:
    """First `count` values of each array, fetched from the device."""
    return {name: np.asarray(values)[:count] for name, values in jax.device_get(dict(arrays)).items()}


def write_chunks(store_chunk: StoreChunk, compiled_job: CompiledJob, chunks: Iterable[int], advance: Advance) -> None:
    """Computes chunks and writes each in a separate thread, while the next is computed.

    Args:
        store_chunk: function that stores a chunk.
        advance: callback for the number of points that are done.

    Raises:
        OSError: the disk is full, or the store cannot be written. Earlier chunks are kept.
    """
    waiting: queue.Queue[Piece | None] = queue.Queue(QUEUED_CHUNKS)
    stop = threading.Event()
    failures = list[BaseException]()

    def write(chunk: int, arrays: dict[str, Array], values: np.ndarray, points_reported: float) -> None:
        is_ready = all(x.is_ready() for x in arrays.values() if isinstance(x, jax.Array))  # type: ignore[attr-defined]
        if stop.is_set() and not is_ready:
            return
        jax.block_until_ready(list(arrays.values()))
        count = compiled_job.job.blocks.count(chunk)
        host_values = fetch_values(arrays, count)
        if stop.is_set() and not is_ready:  # interrupted during its computation
            return
        design = compiled_job.job.plan.design
        blocks = compiled_job.job.blocks
        sample_values = None
        if design.samples is not None and not any(blocks.place(chunk)[:-1]):
            # samples vary fastest; other chunks along their dimension repeat them
            slice_of_samples = blocks.box(chunk)[-1]
            sample_values = values[: slice_of_samples.stop - slice_of_samples.start, len(design.axes) :].T
        store_chunk(chunk, host_values, sample_values)
        advance(count - points_reported)

    def keep_writing() -> None:
        while (piece := waiting.get()) is not None:
            try:
                if not failures:
                    write(*piece)
            except BaseException as error:
                failures.append(error)
                stop.set()

    writer = threading.Thread(target=keep_writing, name=WORKER, daemon=True)
    writer.start()
    try:
        for piece in produce_chunks(compiled_job, chunks, advance):
            waiting.put(piece)
            if stop.is_set():
                break
        waiting.put(None)
        writer.join()
    except BaseException:
        stop.set()
        with contextlib.suppress(queue.Full):
            waiting.put(None, timeout=WRITING_TIME)
        writer.join(WRITING_TIME)  # computed chunks are written, running computations are abandoned
        raise
    if failures:
        raise failures[0]
