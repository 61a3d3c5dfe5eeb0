"""Shared parts of benchmarks: the machine in words, timing, memory, and the limit that a batch meets."""

from __future__ import annotations

import argparse
import datetime
import importlib.metadata
import json
import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

import mmrjax

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))  # the plain reference model


def parser(description: str, batches: str) -> argparse.ArgumentParser:
    """Options of all benchmarks with batches."""
    options = argparse.ArgumentParser(description=description)
    options.add_argument("--batches", default=batches, help="batch sizes, comma separated")
    options.add_argument("--repeats", type=int, default=20, help="number of timed calls of each batch")
    options.add_argument("--no-baseline", action="store_true", help="leave out the loop of SciPy")
    options.add_argument("--float32", action="store_true", help="single precision (default: double)")
    options.add_argument("--json", type=Path, metavar="FILE", help="write every number to this file too")
    return options


def set_precision(single: bool) -> None:
    """Sets single or double precision for this process and its child processes."""
    os.environ["JAX_ENABLE_X64"] = str(not single).lower()
    jax.config.update("jax_enable_x64", not single)


def machine() -> dict[str, Any]:
    """Processor, device and versions."""
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line]
        cpu = names[0] if names else cpu
    device = jax.devices()[0]
    versions = {name: importlib.metadata.version(name) for name in ("jax", "jaxlib", "diffrax", "optimistix")}
    versions |= {name: importlib.metadata.version(name) for name in ("numpy", "scipy")}
    versions["mmrjax"] = mmrjax.__version__  # a checkout need not be installed
    return {
        "date": datetime.date.today().isoformat(),
        "cpu": cpu,
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "device": f"{device.platform}: {device.device_kind}",
        "precision": "double" if jax.config.jax_enable_x64 else "single",
        "python": platform.python_version(),
        "versions": versions,
    }


def seconds(call: Callable[[], Any], repeats: int) -> tuple[float, float]:
    """Best and median wall time of `call`, which has been compiled before."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - start)
    return min(times), sorted(times)[len(times) // 2]


def yardstick_points(size: int) -> tuple[np.ndarray, ...]:
    """Configuration, voltage [V], slope [deg] and payload [kg], from Table 8 within nominal adhesion."""
    rng = np.random.default_rng(8)
    wheeled, slope, payload, voltage = rng.uniform((0, 0, 0, 15), (1, 12, 8, 33), (size, 4)).T.copy()
    return np.round(wheeled).astype(int), voltage, slope, payload


def in_turn(calls: dict[str, Callable[[], Any]], rounds: int) -> dict[str, np.ndarray]:
    """Wall and processor times [s] of each call, one of each per round, shape (rounds, 2)."""
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in calls}
    for call in calls.values():
        jax.block_until_ready(call())
    for _ in range(rounds):
        for name, call in calls.items():
            start, spent = time.perf_counter(), time.process_time()
            jax.block_until_ready(call())
            times[name].append((time.perf_counter() - start, time.process_time() - spent))
    return {name: np.array(t) for name, t in times.items()}


def memory() -> dict[str, int]:
    """Peak of this process on the device so far and its limit [bytes], empty if the device does not report them."""
    stats = jax.devices()[0].memory_stats() or {}
    wanted = {"peak": "peak_bytes_in_use", "limit": "bytes_limit"}
    return {name: int(stats[key]) for name, key in wanted.items() if key in stats}


def over_batches(
    batches: list[int], prepare: Callable[[int], Callable[[], Any]], repeats: int
) -> list[dict[str, Any]]:
    """Times one batch after another, upward, until one does not fit the device."""
    rows: list[dict[str, Any]] = []
    for size in sorted(batches):
        try:
            call = prepare(size)
            start = time.perf_counter()
            jax.block_until_ready(call())
            first = time.perf_counter() - start
            best, median = seconds(call, repeats)
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error) and "out of memory" not in str(error).lower():
                raise
            rows.append({"batch": size, "out_of_memory": True, **memory()})
            break
        rows.append(
            {"batch": size, "first_s": first, "best_s": best, "median_s": median, "per_s": size / best, **memory()}
        )
        print(row_words(rows[-1]), flush=True)
    return rows


def row_words(row: dict[str, Any]) -> str:
    """One row of the printed table."""
    if row.get("out_of_memory"):
        return f"{row['batch']:>10}  does not fit the device"
    peak = f"  peak {row['peak'] / 2**30:8.2f} GiB" if "peak" in row else ""
    return (
        f"{row['batch']:>10}  best {row['best_s'] * 1e3:10.2f} ms  median {row['median_s'] * 1e3:10.2f} ms  "
        f"{row['per_s']:12.3e} /s  compiled in {row['first_s']:5.1f} s{peak}"
    )


def limit_words(rows: list[dict[str, Any]]) -> str:
    """The limit that the batches met: the rate saturates, memory is full, or none yet."""
    timed = [row for row in rows if "per_s" in row]
    if not timed:
        return "memory: not even the smallest batch fits"
    top = max(timed, key=lambda row: row["per_s"])
    share = f", {top['peak'] / top['limit']:.0%} of the device's memory in use" if "limit" in top else ""
    words = []
    if len(timed) < 2:
        return "only one batch size: no limit determined"
    growth = timed[-1]["per_s"] / timed[-2]["per_s"] / (timed[-1]["batch"] / timed[-2]["batch"])
    gain = timed[-1]["per_s"] / timed[-2]["per_s"]
    if gain < 1.1:
        words.append(
            f"saturated at batch {top['batch']}, by arithmetic or memory traffic and not by memory size "
            f"(last step: {gain:.2f} x the rate for {timed[-1]['batch'] / timed[-2]['batch']:.0f} x the batch){share}"
        )
    elif rows[-1].get("out_of_memory"):
        words.append(f"memory, before the rate saturates: it still rose {gain:.2f} x{share}")
    else:
        words.append(f"none yet: the rate still rose {gain:.2f} x ({growth:.0%} of proportional){share}")
    if rows[-1].get("out_of_memory"):
        words.append(f"memory: batch {rows[-1]['batch']} does not fit")
    return "; ".join(words)


def finish(record: dict[str, Any], path: Path | None) -> None:
    """Prints the machine and writes the record."""
    m = record["machine"]
    versions = ", ".join(f"{k} {v}" for k, v in m["versions"].items())
    print(f"machine: {m['cpu']}, {m['cores']} cores; {m['device']}; {m['precision']} precision; {m['date']}")
    print(f"versions: Python {m['python']}, {versions}")
    if path:
        path.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def time_batches(record: dict[str, Any], arguments: argparse.Namespace, prepare: Callable[[int], Callable]) -> None:
    """Times each batch of the options into the record, and prints the limit of the last one."""
    record["batches"] = over_batches([int(b) for b in arguments.batches.split(",")], prepare, arguments.repeats)
    if record["batches"][-1].get("out_of_memory"):
        print(row_words(record["batches"][-1]))
    record["limit"] = limit_words(record["batches"])
    print(f"limit: {record['limit']}")
