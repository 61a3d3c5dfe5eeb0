"""Seconds and memory to read a long log to checked columns: Parquet of ten million rows, CSV of one million.

python benchmarks/read_tables.py
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

#: A bench whose log has time, voltage, current and speed.
RIG = """
base = "none"
channels = ["total_current", "motor_speed"]
[motor]
resistance = "2 ± 20 %"
torque_constant = "0.05 ± 20 %"
[gearbox]
ratio = 1
efficiency_load = "1 ± 0"
[bench]
load = "shaft"
inertia = 0.001
loss_coulomb = "0.01 ± 50 %"
"""


def write(path: Path, rows: int) -> None:
    """Write a staircase of voltage with noise, at 1 kHz."""
    rng = np.random.default_rng(62)
    time_s = np.arange(rows) / 1e3
    volts = 2.0 + np.floor(time_s % 60 / 5)
    columns = {
        "time_s": time_s,
        "supply_voltage_V": volts,
        "total_current_A": 0.1 * volts + rng.normal(0, 0.01, rows),
        "motor_speed_rpm": 180 * volts + rng.normal(0, 2.0, rows),
    }
    if path.suffix == ".parquet":
        import pyarrow as pa
        from pyarrow import parquet

        parquet.write_table(pa.table(columns), path)
    else:
        text = "{:.3f},{:g},{:.4f},{:.2f}\n".format
        with path.open("w") as stream:
            stream.write(",".join(columns) + "\n")
            stream.writelines(text(*row) for row in zip(*(c.tolist() for c in columns.values()), strict=True))


def read(path: Path, rig: Path) -> None:
    """Read a file and print rows, seconds and the memory that reading took [GB] beyond the libraries."""
    from calibration.data import runs
    from calibration.data.robot_file import load_robot

    robot = load_robot(rig)
    runs.read_runs({"time_s": [0.0, 1.0], "supply_voltage_V": [1.0, 1.0], "total_current_A": [0.1, 0.1]}, robot)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    began, used = time.perf_counter(), time.process_time()
    found = runs.read_runs(path, robot)
    seconds, used = time.perf_counter() - began, time.process_time() - used
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(
        f"{path.suffix} {len(found):,} rows: {seconds:.2f} s ({used:.2f} s of processor), "
        f"{(after - before) / 1e6:.2f} GB, in all {after / 1e6:.2f} GB"
    )


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--parquet-rows", type=int, default=10_000_000)
    options.add_argument("--csv-rows", type=int, default=1_000_000)
    options.add_argument("--read", nargs=2, type=Path, help="a file and a rig's file, in a process of its own")
    stated = options.parse_args()
    if stated.read:
        read(*stated.read)
        return
    with tempfile.TemporaryDirectory() as folder:
        rig = Path(folder, "rig.toml")
        rig.write_text(RIG)
        for name, rows in (("log.parquet", stated.parquet_rows), ("log.csv", stated.csv_rows)):
            write(Path(folder, name), rows)
            subprocess.run([sys.executable, __file__, "--read", str(Path(folder, name)), str(rig)], check=True)


if __name__ == "__main__":
    main()
