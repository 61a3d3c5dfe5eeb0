"""Chunks of a sweep on the workers of a dask scheduler, one worker per device. Chunks of lost workers are recomputed.

Workers send their chunks to the process that the user started. Only this process writes, so no shared disk is needed.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import importlib.util
import itertools
import pickle
import sys
import threading
from collections.abc import Iterable, Iterator
from typing import Any

from calibration.data import Columns, Json
from calibration.data.input_errors import BadConfiguration, InputError
from mmrjax.compile.programs import source_hash
from sweeps.points.scale import Job, Produced
from sweeps.points.zarr_store import identity_differences, installed_versions
from sweeps.store import PACKAGES

#: Longest wait for an answer of the scheduler, and for its first worker [s].
ANSWER, WORKER = 4.0, 60.0
#: Attempts for a chunk on other workers before the sweep ends.
RETRIES = 5
#: Chunks that are queued at each worker.
AHEAD = 1
GONE = "--scheduler: connection lost; restart the scheduler, and the same command resumes"


class LostWorkers(InputError):
    """The workers were lost for good. The sweep can be resumed."""


@dataclasses.dataclass(frozen=True)
class Pool:
    """A scheduler with its workers.

    Attributes:
        client: client of dask.
        device: kind of the workers' devices.
    """

    client: Any
    device: str

    def close(self) -> None:
        """Disconnects from the scheduler."""
        self.client.close()

    def produce(self, job: Job, chunks: Iterable[int]) -> Produced:
        """Yields chunks as workers finish them. If a worker is lost, its chunk is computed again.

        Raises:
            LostWorkers: the workers of a chunk were lost too often, there was no worker for a minute, or the
                scheduler is gone.
            BadConfiguration: a worker has other software, or another kind of device.
        """
        from distributed import CancelledError, KilledWorker, TimeoutError, as_completed

        from sweeps.points.scale import Piece

        work, chunks_left = _pack_job(job), iter(chunks)
        name = hashlib.sha256(work).hexdigest()[:16]
        expected = {**program_identity(), "device": {"device": self.device}}
        tried: dict[int, int] = {}
        numbers: dict[str, int] = {}

        def submit(chunk: int) -> Any:
            tried[chunk] = tried.get(chunk, 0) + 1
            key = f"chunk-{chunk}-{tried[chunk]}-{name}"
            future = self.client.submit(compute_on_worker, work, name, chunk, expected, key=key, retries=RETRIES)
            numbers[future.key] = chunk
            return future

        def fill() -> None:
            """Submits enough work for the present workers. Some may have joined later."""
            room = max(self._workers(), 1) * (1 + AHEAD) - len(numbers)
            for chunk in itertools.islice(chunks_left, max(room, 0)):
                under_way.add(submit(chunk))

        under_way = as_completed(loop=self.client.loop)
        fill()
        while not under_way.is_empty():
            try:
                future = self._next(under_way)
                chunk = numbers.pop(future.key)
                arrays = self._result(future)
            except TimeoutError as error:
                raise LostWorkers(
                    f"--scheduler: no worker for {WORKER:g} s; start one, and the same command resumes"
                ) from error
            except (KilledWorker, CancelledError) as error:
                if self.client.status != "running":
                    raise LostWorkers(GONE) from error
                if tried[chunk] > RETRIES:
                    raise LostWorkers(
                        f"--scheduler: chunk {chunk} lost its worker {tried[chunk]} times, perhaps for lack of "
                        "memory; the same command resumes"
                    ) from error
                under_way.add(submit(chunk))
                continue
            future.release()
            yield Piece(chunk, arrays)
            fill()

    def _workers(self) -> int:
        """Number of workers."""
        try:
            return len(self.client.scheduler_info(n_workers=-1)["workers"])
        except Exception as error:  # a scheduler that is gone may raise anything
            raise LostWorkers(GONE) from error

    def _next(self, under_way: Any) -> Any:
        """Next finished future. Waits while at least one worker is connected.

        Raises:
            TimeoutError: there was no worker for `WORKER` seconds.
            LostWorkers: the scheduler is gone.
        """
        finished: list[Any] = []
        failed: list[BaseException] = []

        def take_next() -> None:
            try:
                finished.append(next(under_way))
            except BaseException as error:
                failed.append(error)

        thread = threading.Thread(target=take_next, daemon=True)
        thread.start()
        while thread.is_alive():
            thread.join(WORKER / 4)
            if thread.is_alive() and not self._workers():
                self.client.wait_for_workers(1, timeout=WORKER)
        if failed:
            raise failed[0]
        return finished[0]

    def _result(self, future: Any) -> Any:
        """Result of a finished future. If its worker is lost before the fetch, another worker recomputes it.

        Raises:
            TimeoutError, LostWorkers: as `_next`.
        """
        while True:
            try:
                return future.result(timeout=WORKER)
            except TimeoutError:
                if not self._workers():
                    self.client.wait_for_workers(1, timeout=WORKER)


def _pack_job(job: Job) -> bytes:
    """A job as bytes. It includes the source of the user's own effects, so workers need no user files."""
    import cloudpickle

    own_modules = {
        sys.modules[type(e).__module__] for e in job.robot.effects if not type(e).__module__.startswith("mmrjax.")
    }
    for module in own_modules:
        cloudpickle.register_pickle_by_value(module)
    try:
        return bytes(cloudpickle.dumps(job))
    finally:
        for module in own_modules:
            cloudpickle.unregister_pickle_by_value(module)


def connect_workers(address: str) -> Pool:
    """Workers of a scheduler, with the same software and kind of device.

    Raises:
        BadConfiguration: dask is not installed, nobody answers at the address, there is no worker, or workers differ
            from this process or among each other.
    """
    if importlib.util.find_spec("distributed") is None:
        raise BadConfiguration("--scheduler: needs dask; install mmrjax[cluster]")
    client = _connect_client(address)
    try:
        try:
            client.wait_for_workers(1, timeout=ANSWER)
        except TimeoutError:
            raise BadConfiguration(
                f"--scheduler: {address} has no workers; start one for each device: `dask worker {address} "
                "--nthreads 1`"
            ) from None
        own_identity, kinds = program_identity(), set()
        for worker, (host, device) in client.run(introduce_worker).items():
            differ = identity_differences(own_identity, host)
            if differ:
                raise BadConfiguration(f"--scheduler: {worker} runs different software; it differs in {differ}")
            kinds.add(device)
        if len(kinds) > 1:
            raise BadConfiguration(
                f"--scheduler: the workers have different devices, {', '.join(sorted(kinds))}; expected one kind"
            )
        return Pool(client, kinds.pop())
    except BaseException:
        client.close()
        raise


def _connect_client(address: str) -> Any:
    """Client of the scheduler at an address. It must answer within `ANSWER` seconds.

    dask limits the wait for a connection but not for messages over it, so this waits in a thread.
    """
    import distributed

    clients: list[Any] = []
    failed: list[BaseException] = []

    def ask() -> None:
        try:
            clients.append(distributed.Client(address, timeout=ANSWER, name="mmrjax sweep", set_as_default=False))
        except BaseException as error:  # a server that is no scheduler may cause any error
            failed.append(error)

    with _silence_dask():
        asking = threading.Thread(target=ask, daemon=True)
        asking.start()
        asking.join(ANSWER + 0.5)
    if clients:
        return clients[0]
    reason = (str(failed[0]).split("\n")[0] or type(failed[0]).__name__) if failed else "silence"
    raise BadConfiguration(
        f"--scheduler: got {address}; no scheduler answers there within {ANSWER:g} s ({reason}); expected one "
        "such as tcp://host:8786"
    )


@contextlib.contextmanager
def _silence_dask() -> Iterator[None]:
    """Suppresses dask's log of a failed connection, because the error message already reports it."""
    import logging

    loggers = [logging.getLogger(name) for name in ("distributed.comm", "distributed.client", "distributed.core")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


# --- on the workers -------------------------------------------------------------------------------------------------

_lock = threading.Lock()
_compiled: dict[str, Any] = {}


def program_identity() -> dict[str, dict[str, str]]:
    """Hash of the source, and versions of the packages that affect results."""
    return {"code": {"source": source_hash()}, "versions": installed_versions(PACKAGES)}


@functools.cache
def _start_worker() -> None:
    """Prepares a worker process: compiled programs are stored, as in the main process."""
    from sweeps import compilation_cache

    compilation_cache.keep_programs()


def introduce_worker() -> tuple[dict[str, dict[str, str]], str]:
    """Software of a worker and its device."""
    _start_worker()
    from sweeps.points.scale import device_kind

    return program_identity(), device_kind()


def compute_on_worker(work: bytes, name: str, chunk: int, expected: Json) -> Columns:
    """Computes a chunk on this worker's devices. A job is unpacked and compiled once.

    Args:
        work: the job, packed.
        name: name of the job.
        expected: software and device of the other workers.

    Raises:
        BadConfiguration: this worker joined later and differs from the others.
    """
    host, device = introduce_worker()
    differ = identity_differences(expected, {**host, "device": {"device": device}})
    if differ:
        raise BadConfiguration(
            f"--scheduler: a worker that joined later runs different software or has another device: {differ}"
        )
    from mmrjax.compile.precision import double_precision
    from sweeps.points.scale import Compiled, fetch_values

    with _lock, double_precision():  # restores the precision of the worker's other jobs
        if name not in _compiled:
            _compiled.clear()
            _compiled[name] = Compiled(pickle.loads(work))
        compiled = _compiled[name]
        return fetch_values(compiled(compiled.points(chunk)), compiled.job.blocks.count(chunk))
