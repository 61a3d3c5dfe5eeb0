"""A large sweep with ordinary options, as a user runs it: time, processor time, peak memory and bytes on disk.

python benchmarks/sweep_options.py            # 2.4e6 points: without stored programs, with them, and with runs.csv
python benchmarks/sweep_options.py --repeats 5

Each run is a separate process, with an empty folder of compiled programs before the first of them. Prints a line per
run. The last line is JSON.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from measure import machine, set_precision

COMMAND = "import sys; sys.argv[0] = 'mmrjax'; from sweeps.cli import main; main()"


def run(words: list[str], folder: Path) -> dict[str, Any]:
    """Runs one command in a separate process, in a folder whose size is that of its results."""
    environment = {**os.environ, "MMRJAX_CACHE": str(folder / "programs")}
    begin = time.perf_counter()
    command = [sys.executable, "-c", COMMAND, *words]
    child = subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert child.stdout is not None
    said = child.stdout.read()
    _, status, usage = os.wait4(child.pid, 0)
    code = os.waitstatus_to_exitcode(status)
    assert code in (0, 3), said
    out = folder / "found"
    return {
        "seconds": time.perf_counter() - begin,
        "processor_s": usage.ru_utime + usage.ru_stime,
        "peak_memory_GB": usage.ru_maxrss / 1e6,
        "bytes": sum(f.stat().st_size for f in out.rglob("*") if f.is_file()),
        "exit_code": code,
        "load": os.getloadavg()[0],
    }


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--slopes", default="0:19.98:0.02")
    options.add_argument("--payloads", default="0:7.98:0.02")
    options.add_argument("--repeats", type=int, default=3, help="number of runs with stored programs")
    options.add_argument("--cores", type=int, default=2)
    arguments = options.parse_args()
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: arguments.cores])  # applies to the commands too
    set_precision(single=False)
    grid = ["sweep", "--slopes", arguments.slopes, "--payloads", arguments.payloads, "--out", "found"]
    record: dict[str, Any] = {"benchmark": "sweep_options", "machine": machine(), "command": grid, "runs": []}
    kinds = ["nothing kept", *["programs kept"] * arguments.repeats, "with --export csv"]
    with tempfile.TemporaryDirectory() as name:
        for kind in kinds:
            folder = Path(name)
            shutil.rmtree(folder / "found", ignore_errors=True)  # a complete sweep would not be simulated again
            row = run([*grid, *(["--export", "csv"] if "csv" in kind else [])], folder)
            record["runs"].append({"kind": kind, **row})
            print(
                f"{kind:18} {row['seconds']:6.1f} s, {row['processor_s']:6.1f} s of processor, "
                f"{row['peak_memory_GB']:.2f} GB, {row['bytes'] / 1e6:.0f} MB (load {row['load']:.1f})",
                flush=True,
            )
    print(json.dumps(record))


if __name__ == "__main__":
    main()
