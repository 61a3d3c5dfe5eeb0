"""Sweeps at scale: rate of points into a Zarr store, its time budget, peak memory, and scaling over devices.

    python benchmarks/sweep_scale.py                                  # 1e6 steady points on two cores
    python benchmarks/sweep_scale.py --memory 100000,1000000,10000000 # peak memory by number of points
    python benchmarks/sweep_scale.py --points 100000000 --out DISK    # 1e8 steady points, on a GPU
    python benchmarks/sweep_scale.py --weak 1,2,4 --model drive       # 16384 runs a device, on 1, 2 and 4 devices
    python benchmarks/sweep_scale.py --weak 1,2,4 --model track
    python benchmarks/sweep_scale.py --model track --points 100000 --duration 1   # track at the standard step
    python benchmarks/sweep_scale.py --against-cpu --points 200000    # largest difference of GPU and CPU results
    python benchmarks/sweep_scale.py --designs                        # points a second of the sampled designs

Prints one line of JSON: machine, versions, times. Programs are compiled before the time is taken, unless stated.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from measure import machine, set_precision

#: Ranges of the varied inputs: Table 8's, on a surface that holds most of it.
AXES = {"slope_deg": (0.0, 20.0), "voltage": (15.0, 33.0), "payload": (0.0, 8.0)}


def plan_of(points: int, sampled: bool) -> dict[str, Any]:
    """Tables of a configuration with this even number of points: a grid, or a Latin hypercube."""
    surface = {"surface": "asphalt"}
    if sampled:
        over = {name: {"distribution": "uniform", "low": a, "high": b} for name, (a, b) in AXES.items()}
        samples = {"design": "latin_hypercube", "number": points, "over": over}
        return {"samples": samples, "conditions": {**surface, "configuration": "6T2A"}}
    half = points // 2
    one = divisor(half, round(half ** (1 / 3)))
    other = divisor(half // one, round((half / one) ** 0.5))
    numbers = dict(zip(AXES, (one, other, half // one // other), strict=True))
    axes = {name: {"start": a, "stop": b, "number": numbers[name]} for name, (a, b) in AXES.items()}
    return {"axes": {"configuration": "all", **axes}, "conditions": surface}


def divisor(number: int, most: int) -> int:
    """The largest divisor of a number up to another."""
    return next(k for k in range(most, 0, -1) if number % k == 0)


def prepared(arguments: argparse.Namespace, points: int, devices: int) -> tuple[Any, Any]:
    """Configuration and job of a sweep."""
    import jax

    from mmrjax import fidelities
    from mmrjax.model import channels, paper_robots
    from sweeps.config_campaign import Campaign
    from sweeps.points import axes
    from sweeps.points.job import prepare_job

    chunk = (
        arguments.chunk
        or fidelities.fidelity_facts(arguments.model).at_once(jax.default_backend() != "cpu") * devices
    )
    config = Campaign(
        model=arguments.model, chunk=min(chunk, points), storage=arguments.storage, outputs=channels.USUAL,
        duration_s=arguments.duration if arguments.model != "steady" else None,
        **plan_of(points, arguments.sampled),
    )  # fmt: skip
    robot = paper_robots.nominal()
    plan = axes.plan_design(config, robot, "benchmark")
    return config, prepare_job(config, robot, plan, "benchmark")


def against_cpu(arguments: argparse.Namespace) -> dict[str, Any]:
    """The first chunk on the default devices and on the processor: largest relative difference of each output."""
    import jax

    from sweeps.points import scale

    _, job = prepared(arguments, arguments.points, 1)
    count = job.blocks.count(0)
    found = []
    for devices in (jax.local_devices(), jax.local_devices(backend="cpu")[:1]):
        compiled = scale.CompiledJob(job, devices)
        found.append(scale.fetch_values(compiled(compiled.points(0)), count))
    one, other = found
    differences = {}
    for name in job.outputs:
        finite = np.isfinite(other[name])
        size = np.abs(other[name][finite])
        differences[name] = float(np.max(np.abs(one[name][finite] - other[name][finite]) / np.maximum(size, 1e-9)))
    return {
        "points": count,
        "devices": [f"{d.platform}: {d.device_kind}" for d in jax.local_devices()],
        "different_statuses": int(np.sum(one["status"] != other["status"])),
        "largest_relative_difference": differences,
    }


def sweep(arguments: argparse.Namespace, points: int, devices: list[Any] | None = None) -> dict[str, Any]:
    """Runs one sweep into a store on disk and returns its times."""
    import jax

    from sweeps.commands import sweep as command
    from sweeps.points import scale
    from sweeps.points.job import store_layout
    from sweeps.points.zarr_store import SweepStore

    devices = jax.local_devices() if devices is None else devices
    config, job = prepared(arguments, points, len(devices))
    if arguments.out is not None:
        Path(arguments.out).mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(dir=arguments.out))
    try:
        compiled = scale.CompiledJob(job, devices)
        begin = time.perf_counter()
        scale.fetch_values(compiled(compiled.points(0)), 1)
        first = time.perf_counter() - begin
        layout = store_layout(config, job)
        begin = time.perf_counter()
        store = SweepStore(folder / "s", {}, layout)
        store.begin()
        scale.write_chunks(store.write, compiled, range(len(job.blocks)), lambda _: None)
        total = time.perf_counter() - begin
        statuses = command.points_by_status(store.done().values())
        store.close()
    finally:
        shutil.rmtree(folder)
    return {
        "model": job.task.model,
        "points": job.plan.design.points,
        "devices": len(devices),
        "chunk": job.blocks.points,
        "chunks": len(job.blocks),
        "bytes": layout.size,
        "seconds": total,
        "points_per_s": job.plan.design.points / total,
        "first_chunk_with_compiling_s": first,
        "statuses": {name: count for name, count in statuses.items() if count},
        "peak_memory_GB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
    }


def memory(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Peak memory by number of points, one process for each."""
    rows = []
    for points in arguments.memory.split(","):
        words = [
            sys.executable,
            __file__,
            "--points",
            points,
            "--model",
            arguments.model,
            "--storage",
            arguments.storage,
        ]
        words += ["--chunk", str(arguments.chunk)] if arguments.chunk else []
        words += ["--sampled"] if arguments.sampled else []
        words += ["--out", arguments.out] if arguments.out else []
        done = subprocess.run(words, capture_output=True, text=True, check=True)
        rows += json.loads(done.stdout.splitlines()[-1])["sweeps"]
    return rows


def weak(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """The same number of runs per device, for increasing numbers of devices. The second of two sweeps is timed.

    The points are samples, so that each device has its share of easy and hard runs.
    """
    import jax

    arguments.sampled = True
    rows: list[dict[str, Any]] = []
    for count in map(int, arguments.weak.split(",")):
        devices = jax.local_devices()[:count]
        if len(devices) < count:
            print(f"only {len(devices)} devices, {count} requested", file=sys.stderr)
            break
        chunk, arguments.chunk = arguments.chunk, arguments.per_device * count
        sweep(arguments, arguments.per_device * count * arguments.rounds, devices)
        rows.append(sweep(arguments, arguments.per_device * count * arguments.rounds, devices))
        arguments.chunk = chunk
        rows[-1]["efficiency"] = rows[-1]["points_per_s"] / count / (rows[0]["points_per_s"] / rows[0]["devices"])
        print(json.dumps(rows[-1]), file=sys.stderr)
    return rows


def designs() -> list[dict[str, Any]]:
    """Points per second of each sampled design of four dimensions, from the middle of 1e9 points."""
    from sweeps.points.sampled_design import DESIGNS

    rows = []
    for name, design in DESIGNS.items():
        best = np.inf
        for _ in range(3):
            begin = time.perf_counter()
            design(1, 10**9, 4, 5 * 10**8, 10**6)
            best = min(best, time.perf_counter() - begin)
        rows.append({"design": name, "dimensions": 4, "points_per_s": 1e6 / best})
    return rows


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--points", type=int, default=1_000_000)
    options.add_argument("--model", default="steady")
    options.add_argument("--duration", type=float, help="of a run of drive or track [s]")
    options.add_argument("--chunk", type=int, help="points in one call, over all devices")
    options.add_argument("--storage", default="float64")
    options.add_argument("--sampled", action="store_true", help="a Latin hypercube instead of a grid")
    options.add_argument("--out", help="folder on the disk to write to")
    options.add_argument("--repeats", type=int, default=1)
    options.add_argument("--memory", help="numbers of points, one process for each")
    options.add_argument("--weak", help="numbers of devices, such as 1,2,4")
    options.add_argument("--per-device", type=int, default=16_384, help="runs per device and chunk of --weak")
    options.add_argument("--rounds", type=int, default=2, help="chunks of --weak")
    options.add_argument("--against-cpu", action="store_true")
    options.add_argument("--designs", action="store_true")
    arguments = options.parse_args()
    from sweeps import compilation_cache

    compilation_cache.keep_programs()
    set_precision(False)
    record: dict[str, Any] = {"benchmark": "sweep_scale", "machine": machine()}
    if arguments.designs:
        record["designs"] = designs()
    elif arguments.against_cpu:
        record["against_cpu"] = against_cpu(arguments)
    elif arguments.memory:
        record["sweeps"] = memory(arguments)
    elif arguments.weak:
        record["sweeps"] = weak(arguments)
    else:
        record["sweeps"] = [sweep(arguments, arguments.points) for _ in range(arguments.repeats)]
    print(json.dumps(record))


if __name__ == "__main__":
    main()
