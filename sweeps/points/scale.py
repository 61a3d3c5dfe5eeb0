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
SHARED = 16_384
#: Chunks that may be queued for writing.
WAITING = 1
#: Time after an interrupt for writing computed chunks, in each of two steps [s].
LAST = 2.5
#: Types of stored outputs that are not numbers.
KINDS = {STATUS: "uint8", FLAGS: "uint16", VERDICT: "uint8"}


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
    return task.at_once[not device_kind().startswith("cpu")] * len(jax.local_devices())


class Compiled:
    """A job on the local devices: a program for chunks of one shape, whose points are split among the devices."""

    def __init__(self, job: Job, devices: list[Any] | None = None) -> None:
        self.job = job
        devices = jax.local_devices() if devices is None else devices
        self.mesh = Mesh(np.array(devices), (POINTS,))
        # Every device has the same number of points: the chunk's last point is repeated.
        share = -(-job.blocks.points // len(devices))
        share = share if job.task.run is not None else fidelities.fidelity_facts(job.task.model).filled(share)
        share = share if share < SHARED else -(-share // SHARED) * SHARED
        self.size = share * len(devices)
        everywhere = NamedSharding(self.mesh, PartitionSpec())
        tree = (job.plan.varied(job.robot), job.plan.fixed())
        arrays, static_parts = eqx.partition(tree, eqx.is_array)
        self._variation, self._fixed = eqx.combine(jax.device_put(arrays, everywhere), static_parts)
        self._split = NamedSharding(self.mesh, PartitionSpec(POINTS))
        factors = {row.name: row.factor for row in outputs.output_table(job.robot.channels)}
        surface, tracked = job.plan.surface, job.robot.configurations.tracked
        ratios = None if surface is None else tuple(adhesion_ratio(surface, x) for x in tracked)
        self._asked = _AskedOutputs(
            job.task.model, tuple(job.task.options.items()), tuple((n, factors.get(n, 1.0)) for n in job.outputs),
            job.storage, ratios,
        )  # fmt: skip
        # Long computations run in parts. Between parts they report progress and can be interrupted.
        is_split = len(devices) > 1 or self._variation.varies_robot
        self.in_parts = job.task.slow and (job.task.run is not None or not is_split)
        self._program = _one_device_kept if len(devices) == 1 else eqx.filter_jit(_split_among(self.mesh))

    def points(self, chunk: int) -> Float[np.ndarray, "points names"]:
        """Values of a chunk's points, padded with the last one to the compiled shape."""
        values = self.job.plan.design.values_in_slices(self.job.blocks.box(chunk))
        if len(values) == self.size:
            return values
        return values[np.minimum(np.arange(self.size), len(values) - 1)]

    def __call__(
        self, values: Float[np.ndarray, "points names"], told: Callable[[float], None] | None = None
    ) -> dict[str, Array]:
        """Starts the computation. Returns arrays of the compiled shape, which may still be in progress.

        Args:
            told: callback for the share that is done, if `in_parts`.
        """
        conditions, rows = self._fixed, self.job.plan.rows
        if rows is not None:
            configuration_index, values = values[:, 0].astype(int), values[:, 1:]
            conditions = jax.tree.map(lambda x: jax.device_put(np.asarray(x)[configuration_index], self._split), rows)
        names = [name for name in self.job.plan.design.names if name != ROW]
        own_places = [k for k, name in enumerate(names) if name in self.job.task.axes]
        placed = jax.device_put(np.delete(values, own_places, axis=1) if own_places else values, self._split)
        if self.in_parts:
            conditions = _wide(_on_surface(self._variation, conditions, placed, self._asked.surface), len(values))
            run = self.job.task.run or self._run
            sizes = values[:, own_places[0]] if own_places else None
            return _stored(run(self._variation, conditions, placed, sizes, told or (lambda share: None)), self._asked)
        values_by_name: dict[str, Array] = self._program(
            self._variation, conditions, placed, self._asked, self.job.profile
        )
        return values_by_name

    def _run(self, variation: Variation, conditions: Conditions, values: Array, _: Any, told: Advance) -> Any:
        """Runs the fidelity."""
        robot, conditions = variation.at(values, conditions)
        run = fidelities.get_fidelity(self.job.task.model).run(robot, conditions, self.job.task.options, told)
        return pick_outputs(run, robot.channels, self.job.outputs)


class _AskedOutputs(NamedTuple):
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


def _wide(conditions: Conditions, points: int) -> Conditions:
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (points,)), conditions)


def _on_surface(
    variation: Variation, conditions: Conditions, values: Array, surface: tuple[float, ...] | None
) -> Conditions:
    """Conditions of points, with the adhesion of their configurations on the stated surface, if any."""
    if surface is None:
        return conditions
    _, conditions_there = variation.at(values, conditions)
    ratio = jnp.asarray(surface)[jnp.broadcast_to(conditions_there.configuration, values.shape[:1])]
    return dataclasses.replace(_wide(conditions, len(values)), adhesion=ratio)


def _one_device(
    variation: Variation, conditions: Conditions, values: Array, asked: _AskedOutputs, profile: Profile | None
) -> dict[str, Array]:
    """Outputs of points in stored form."""
    conditions = _on_surface(variation, conditions, values, asked.surface)
    names = tuple(name for name, _ in asked.factors)
    values_by_name = evaluate_points(variation, asked.model, values, conditions, dict(asked.options), names, profile)
    return _stored(values_by_name, asked)


_one_device_kept = compiled(_one_device)


def _stored(found: Mapping[str, Array], asked: _AskedOutputs) -> dict[str, Array]:
    """Outputs in the units of tables and in the stored type. Outputs in `KINDS` have their own type."""
    stored = {n: (found[n] / factor).astype(asked.storage) for n, factor in asked.factors if n not in KINDS}
    unconverted_names = (*(n for n, _ in asked.factors if n in KINDS), STATUS)
    return {**stored, **{n: found[n].astype(KINDS[n]) for n in unconverted_names}}


def _split_among(mesh: Mesh) -> Callable[..., dict[str, Array]]:
    """`_one_device` on several devices, each with its share of the points."""

    def program(
        variation: Variation, conditions: Conditions, values: Array, asked: _AskedOutputs, profile: Profile | None
    ) -> dict[str, Array]:
        arrays, static_parts = eqx.partition((variation, profile), eqx.is_array)
        sharding = PartitionSpec(POINTS) if conditions.shape else PartitionSpec()

        def part(arrays: Any, conditions: Conditions, values: Array) -> dict[str, Array]:
            variation, profile = eqx.combine(arrays, static_parts)
            return _one_device(variation, conditions, values, asked, profile)

        # Each device has its own loops, so no device waits for another inside a loop.
        split = jax.shard_map(
            part,
            mesh=mesh,
            in_specs=(PartitionSpec(), sharding, PartitionSpec(POINTS)),
            out_specs=PartitionSpec(POINTS),
            check_vma=False,
        )
        return split(arrays, conditions, values)

    return program


#: A chunk in progress: its number, results by variable (possibly still on a device), values of its points, and the
#: number of its points that have been reported as done.
Piece = tuple[int, dict[str, Array], np.ndarray, float]
Advance = Callable[[float], None]
#: Stores a chunk by its number: values of its points by variable, and values of its samples, one row for each
#: name, None if another chunk writes them.
Keep = Callable[[int, Columns, np.ndarray | None], Any]


def produce_chunks(compiled: Compiled, chunks: Iterable[int], advance: Advance) -> Iterator[Piece]:
    """Computes chunks on the local devices, in order. The points of the next chunk are prepared meanwhile.

    Args:
        advance: callback for the number of further points that are done, for chunks that are computed in parts.
    """
    with Threads(1) as maker:
        prepared = deque[tuple[int, concurrent.futures.Future[Any]]]()
        for chunk in chunks:
            prepared.append((chunk, maker.submit(compiled.points, chunk)))
            if len(prepared) > 1:
                yield _start_chunk(compiled, *prepared.popleft(), advance)
        while prepared:
            yield _start_chunk(compiled, *prepared.popleft(), advance)


def _start_chunk(compiled: Compiled, chunk: int, points: concurrent.futures.Future[Any], advance: Advance) -> Piece:
    values = points.result()
    if not compiled.in_parts:
        return chunk, compiled(values), values, 0.0
    count = compiled.job.blocks.count(chunk)
    counter = share_counter(advance, count)
    arrays = compiled(values, counter)
    counter(1.0)
    return chunk, arrays, values, count


@contextlib.contextmanager
def share_progress(count: int = 1, quiet: bool = False) -> Iterator[Callable[[float], None]]:
    """Progress bar of `count` runs in one batch. Yields a function to call with the share that is done."""
    with progress_bar(count, quiet) as advance:
        told = share_counter(advance, count)
        yield told
        told(1.0)


def share_counter(advance: Advance, count: int) -> Callable[[float], None]:
    """Callback for the share of `count` runs that is done so far, which passes the increase to `advance`."""
    so_far = 0.0

    def told(share: float) -> None:
        nonlocal so_far
        advance(count * share - so_far)
        so_far = count * share

    return told


def fetch_values(arrays: Json, count: int) -> Columns:
    """First `count` values of each array, fetched from the device."""
    return {name: np.asarray(values)[:count] for name, values in jax.device_get(dict(arrays)).items()}


def write_chunks(keep: Keep, compiled: Compiled, chunks: Iterable[int], advance: Advance) -> None:
    """Computes chunks and writes each in a separate thread, while the next is computed.

    Args:
        keep: function that stores a chunk.
        advance: callback for the number of points that are done.

    Raises:
        OSError: the disk is full, or the store cannot be written. Earlier chunks are kept.
    """
    waiting: queue.Queue[Piece | None] = queue.Queue(WAITING)
    stop, failures = threading.Event(), list[BaseException]()

    def write(chunk: int, arrays: dict[str, Array], values: np.ndarray, told: float) -> None:
        is_ready = all(x.is_ready() for x in arrays.values() if isinstance(x, jax.Array))  # type: ignore[attr-defined]
        if stop.is_set() and not is_ready:
            return
        jax.block_until_ready(list(arrays.values()))
        count = compiled.job.blocks.count(chunk)
        host_values = fetch_values(arrays, count)
        if stop.is_set() and not is_ready:  # interrupted during its computation
            return
        design, blocks, drawn = compiled.job.plan.design, compiled.job.blocks, None
        if design.samples is not None and not any(blocks.place(chunk)[:-1]):
            # samples vary fastest; other chunks along their dimension repeat them
            along = blocks.box(chunk)[-1]
            drawn = values[: along.stop - along.start, len(design.axes) :].T
        keep(chunk, host_values, drawn)
        advance(count - told)

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
        for piece in produce_chunks(compiled, chunks, advance):
            waiting.put(piece)
            if stop.is_set():
                break
        waiting.put(None)
        writer.join()
    except BaseException:
        stop.set()
        with contextlib.suppress(queue.Full):
            waiting.put(None, timeout=LAST)
        writer.join(LAST)  # computed chunks are written, running computations are abandoned
        raise
    if failures:
        raise failures[0]
