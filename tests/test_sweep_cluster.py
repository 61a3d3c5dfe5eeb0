"""Sweeps on dask workers: the same store as without, also when a worker is killed. Schedulers that do not answer."""

import importlib.util
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from test_cli import MMRJAX
from test_effect_file import GOOD
from test_sweep_store import CONFIG, arrays

from calibration.data.input_errors import BadConfiguration
from mmrjax.model import paper_robots
from sweeps.config_campaign import Campaign
from sweeps.points import axes, cluster, scale
from sweeps.points.job import prepare_job

pytest.importorskip("distributed")


class Cluster:
    """A scheduler and workers, processes of their own."""

    def __init__(self, folder, workers, nanny="--no-nanny"):
        self.folder = folder
        environment = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONWARNINGS": "ignore"}
        self.log = (folder / "cluster.log").open("w")

        def start(*words):
            return subprocess.Popen(words, cwd=folder, env=environment, stdout=self.log, stderr=self.log)

        self.port = free_port()
        self.address = f"tcp://127.0.0.1:{self.port}"
        self.scheduler = start(
            sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(self.port),
            "--no-dashboard",
        )  # fmt: skip
        self.workers = [
            start(
                sys.executable, "-m", "distributed.cli.dask_worker", self.address, "--nthreads", "1", "--no-dashboard",
                nanny, "--local-directory", str(folder / f"worker-{k}"),
            )
            for k in range(workers)
        ]  # fmt: skip

    def close(self):
        for process in (*self.workers, self.scheduler):
            if process.poll() is None:
                process.kill()
            process.wait()
        self.log.close()


def free_port():
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


@pytest.fixture
def two_workers(tmp_path):
    folder = tmp_path / "cluster"
    folder.mkdir()
    running = Cluster(folder, 2)
    yield running
    running.close()


def command(folder, *options, timeout=300):
    words = [*MMRJAX, "sweep", "plan.toml", *map(str, options)]
    return subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=timeout)


@pytest.mark.slow
def test_worker_killed_in_the_middle_changes_nothing(tmp_path, two_workers):
    """Of two workers one is killed when a third of the chunks is there. The other does the rest."""
    config = CONFIG.replace("chunk = 40", "chunk = 10").replace("number = 50", "number = 500")
    (tmp_path / "plan.toml").write_text(config)
    killed = []

    def kill():
        journal = tmp_path / "there.partial/journal/1-of-1.jsonl"
        while not journal.exists() or journal.read_text().count("\n") < 100:
            time.sleep(0.01)
        two_workers.workers[0].send_signal(signal.SIGKILL)
        killed.append(journal.read_text().count("\n"))

    thread = threading.Thread(target=kill, daemon=True)
    thread.start()
    there = command(tmp_path, "--scheduler", two_workers.address, "--out", "there")
    assert there.returncode == 0, there.stderr
    assert killed and killed[0] < 270  # of 300: it was in the middle
    assert two_workers.workers[0].poll() is not None and two_workers.workers[1].poll() is None
    assert command(tmp_path, "--out", "here").returncode == 0
    assert arrays(tmp_path / "there") == arrays(tmp_path / "here")


@pytest.mark.slow
def test_scheduler_that_does_not_answer_is_refused_in_ten_seconds(tmp_path):
    (tmp_path / "plan.toml").write_text(CONFIG)
    with socket.socket() as silent:  # takes the connection and says nothing
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        begin = time.perf_counter()
        done = command(tmp_path, "--out", "s", "--scheduler", address, timeout=60)
        took = time.perf_counter() - begin
    assert done.returncode == 2 and done.stderr.removeprefix("sweep: working\n") == (
        f"mmrjax: --scheduler: got {address}; no scheduler answers there within 4 s (silence); expected one such "
        "as tcp://host:8786\n"
    )
    assert took < 10 and [p.name for p in tmp_path.iterdir()] == ["plan.toml"]


def test_scheduler_without_dask_says_what_to_install(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(BadConfiguration, match=r"--scheduler: needs dask; install mmrjax\[cluster\]"):
        cluster.connect_workers("tcp://127.0.0.1:1")


def test_scheduler_without_workers_is_refused(tmp_path, monkeypatch):
    (tmp_path / "cluster").mkdir()
    alone = Cluster(tmp_path / "cluster", 0)
    monkeypatch.setattr(cluster, "ANSWER", 3.0)
    try:
        with pytest.raises(BadConfiguration, match=r"has no workers; start one for each device: `dask worker tcp"):
            connect_when_up(alone.address)
    finally:
        alone.close()


@pytest.mark.slow
def test_worker_with_another_program_is_refused(two_workers, monkeypatch):
    monkeypatch.setattr(cluster, "source_hash", lambda: "other")
    with pytest.raises(BadConfiguration, match=r"runs different software; it differs in code \(source\)"):
        connect_when_up(two_workers.address)
    monkeypatch.undo()
    pool = cluster.connect_workers(two_workers.address)
    assert pool.device.startswith("cpu")
    pool.close()


def connect_when_up(address):
    """The scheduler of a test takes a moment to start."""
    for _ in range(20):
        try:
            pool = cluster.connect_workers(address)
        except BadConfiguration as error:
            if "no scheduler answers" not in str(error):
                raise
            time.sleep(0.2)
        else:
            pool.close()
            return


@pytest.mark.slow
def test_users_own_effects_travel_to_the_workers(tmp_path, two_workers):
    (tmp_path / "mine.py").write_text(GOOD)
    (tmp_path / "sealed.toml").write_text("[effects.seal_drag]\namplitude = 0.05\n")
    config = 'effects = ["mine.py"]\nrobot = "sealed.toml"\n' + CONFIG.replace("chunk = 40", "chunk = 100")
    (tmp_path / "plan.toml").write_text(config)
    done = command(tmp_path, "--trust", "--scheduler", two_workers.address, "--out", "there")
    assert done.returncode == 0, done.stderr
    assert command(tmp_path, "--trust", "--out", "here").returncode == 0
    assert arrays(tmp_path / "there") == arrays(tmp_path / "here")


@pytest.fixture
def job():
    """Ten chunks of one point each."""
    config = Campaign(axes={"voltage": [*range(15, 25)]}, chunk=1, outputs=("speed",))
    robot = paper_robots.nominal()
    return prepare_job(config, robot, axes.plan_design(config, robot, "x"), "x")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of dask, about what it loses here
@pytest.mark.parametrize(
    "victim, message", [("workers", "no worker for 1 s; start one"), ("scheduler", "connection lost")]
)
def test_workers_or_scheduler_lost_for_good_end_the_sweep(two_workers, job, monkeypatch, victim, message):
    monkeypatch.setattr(cluster, "WORKER", 1.0)
    pool = cluster.connect_workers(two_workers.address)
    try:
        pieces = pool.produce(job, range(10))
        next(pieces)
        for process in two_workers.workers if victim == "workers" else [two_workers.scheduler]:
            process.kill()
        with pytest.raises(cluster.LostWorkers, match=message):
            list(pieces)
    finally:
        pool.client.close(timeout=2)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.slow
def test_chunk_that_kills_its_workers_ends_the_sweep(tmp_path, job, monkeypatch):
    (tmp_path / "cluster").mkdir()
    restarting = Cluster(tmp_path / "cluster", 1, "--nanny")
    deadly = eval("lambda *_: __import__('os')._exit(1)", {})  # of no module, so that it travels whole
    monkeypatch.setattr(cluster, "compute_on_worker", deadly)
    monkeypatch.setattr(cluster, "RETRIES", 0)
    pool = cluster.connect_workers(restarting.address)
    try:
        with pytest.raises(cluster.LostWorkers, match=r"chunk 3 lost its worker 1 times, perhaps for lack of memory"):
            list(pool.produce(job, [3]))
    finally:
        pool.client.close(timeout=2)
        restarting.close()


class Completed(list):
    """As dask's `as_completed`, of futures that are finished as they come."""

    def __init__(self, futures=(), loop=None):
        super().__init__(futures)

    add, is_empty = list.append, lambda self: not self


@pytest.mark.slow
def test_chunks_that_workers_compute_are_those_of_this_process(job, monkeypatch):
    """What travels, computed where it arrives, in a process that has not yet seen the job, here this one."""
    import distributed

    class Client:
        loop = None

        def submit(self, work, *arguments, key, **_):
            result = work(*arguments)
            return SimpleNamespace(key=key, result=lambda timeout=None: result, release=lambda: None)

    monkeypatch.setattr(distributed, "as_completed", Completed)
    monkeypatch.setattr(cluster.Pool, "_workers", lambda _: 1)
    monkeypatch.setattr(cluster.Pool, "_next", lambda _, under_way: under_way.pop(0))
    compiled, found = scale.Compiled(job), {}
    for piece in cluster.Pool(Client(), cluster.introduce_worker()[1]).produce(job, range(3)):
        found[piece.chunk] = piece.arrays
    assert set(found) == {0, 1, 2}
    for chunk, arrays_there in found.items():
        here = compiled(compiled.points(chunk))
        assert set(arrays_there) == set(here)
        for name, values in here.items():
            own = np.asarray(values)[: job.blocks.count(chunk)]  # the rest fills the chunk up
            np.testing.assert_array_equal(np.asarray(arrays_there[name]), own)


def test_workers_that_come_later_get_chunks(job, monkeypatch):
    import distributed

    class Client:
        loop, under_way = None, 0

        def submit(self, *_, key, **__):
            self.under_way += 1
            return SimpleNamespace(key=key, result=dict, release=lambda: None)

    client, workers, seen = Client(), [1], []

    def finished(_, under_way):
        seen.append(len(under_way))
        return under_way.pop(0)

    monkeypatch.setattr(distributed, "as_completed", Completed)
    monkeypatch.setattr(cluster.Pool, "_workers", lambda _: workers[0])
    monkeypatch.setattr(cluster.Pool, "_next", finished)
    chunks = []
    for piece in cluster.Pool(client, "cpu: cpu").produce(job, range(10)):
        chunks.append(piece.chunk)
        workers[0] = 3 if len(chunks) > 1 else 1
    assert chunks == [*range(10)] and client.under_way == 10
    assert seen == [2, 2, 6, 6, 6, 5, 4, 3, 2, 1]


def test_worker_that_comes_later_and_differs_is_refused():
    expected = {**cluster.program_identity(), "device": {"device": "gpu: another"}}
    with pytest.raises(
        BadConfiguration, match=r"a worker that joined later runs different software or has another device: device \("
    ):
        cluster.compute_on_worker(b"", "x", 0, expected)


def test_workers_of_several_kinds_are_refused(monkeypatch):
    class Client:
        closed = False

        def wait_for_workers(self, *_, **__):
            pass

        def run(self, _):
            return {
                "tcp://a": (cluster.program_identity(), "cpu: cpu"),
                "tcp://b": (cluster.program_identity(), "gpu: H200"),
            }

        def close(self):
            self.closed = True

    client = Client()
    monkeypatch.setattr(cluster, "_connect_client", lambda _: client)
    with pytest.raises(
        BadConfiguration, match=r"workers have different devices, cpu: cpu, gpu: H200; expected one kind"
    ):
        cluster.connect_workers("tcp://x:1")
    assert client.closed


def test_result_whose_worker_is_lost_before_it_is_fetched_does_not_hang(monkeypatch):
    """A future that is finished and whose data went with its worker never answers."""
    monkeypatch.setattr(cluster, "WORKER", 0.1)

    class Silent:
        def result(self, timeout):
            raise TimeoutError

    class Client:
        def scheduler_info(self, n_workers):
            return {"workers": {}}

        def wait_for_workers(self, count, timeout):
            raise TimeoutError

    with pytest.raises(TimeoutError):
        cluster.Pool(Client(), "cpu")._result(Silent())
