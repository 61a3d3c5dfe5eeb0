# ruff: noqa: E402 (cores are chosen before jax starts)
"""`mmrjax.simulate` compared with its compiled equations and with the same equations in vectorised NumPy.

python benchmarks/door.py

All sides are timed in turn, in rounds. The best and median wall time and the least processor time of each are
printed. A ratio compares NumPy's closed form of currents and speeds (on one core) with the API. The API returns the
same three numbers and statuses and makes conditions from arrays. The last line is JSON.
"""

from __future__ import annotations

import argparse
import json
import os
from typing import Any

options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
options.add_argument("--points", type=int, default=262_144)
options.add_argument("--rounds", type=int, default=40, help="timed calls of each side")
options.add_argument("--cores", type=int, default=2, help="number of cores that the process may use")
arguments = options.parse_args()
os.environ["JAX_PLATFORMS"] = "cpu"
os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: arguments.cores])

import numpy as np
from measure import in_turn, machine, set_precision, yardstick_points

set_precision(single=False)

from worlds import vectorised

import mmrjax as mm
from mmrjax.fidelities.steady import steady_batch, steady_outputs

NAMES = vectorised.NAMES


def read(results: mm.Results) -> list[Any]:
    """Readings of the instruments, and statuses of the runs."""
    return [*(getattr(results, name) for name in NAMES), results.status]


def main() -> None:
    given = yardstick_points(arguments.points)
    robot, runs = mm.nominal(), mm.Conditions(*given)
    words = np.array(robot.configurations.names)[given[0]]
    one = dict(configuration="6T2A", voltage=24.0, slope_deg=10.0, payload=3.0)
    theirs = vectorised.closed_form(*given)
    for ours, wanted in zip(read(mm.simulate(robot, runs)), theirs, strict=False):
        assert np.max(np.abs(np.asarray(ours) - wanted)) < 1e-9 * np.max(np.abs(wanted))
    calls = {
        "numpy": lambda: vectorised.closed_form(*given),
        "core": lambda: steady_outputs(robot, runs, (*NAMES, "status")),
        "core, everything": lambda: steady_batch(robot, runs),
        "simulate": lambda: read(mm.simulate(robot, runs)),
        "Conditions and simulate": lambda: read(mm.simulate(robot, mm.Conditions(*given))),
        "the same by names": lambda: read(mm.simulate(robot, mm.Conditions(words, *given[1:]))),
        "everything": lambda: mm.simulate(robot, mm.Conditions(*given)).result,
        "one point": lambda: read(mm.simulate(robot, mm.Conditions(**one))),
        "one point, everything": lambda: mm.simulate(robot, mm.Conditions(**one)).result,
    }
    load = os.getloadavg()[0]
    times = in_turn(calls, arguments.rounds)
    record: dict[str, Any] = {"benchmark": "door", "machine": machine(), "points": arguments.points, "load": load}
    record["ms"] = {
        name: {"best": t[:, 0].min(), "median": float(np.median(t[:, 0])), "processor": t[:, 1].min()}
        for name, t in ((name, 1e3 * t) for name, t in times.items())
    }
    for name, row in record["ms"].items():
        print(f"{name:26} best {row['best']:8.2f} ms, median {row['median']:8.2f}; processor {row['processor']:8.2f}")

    def ratio(a: str, b: str, cores: int) -> dict[str, float]:
        wall = times[a][:, 0] / times[b][:, 0]
        spent = times[a][:, 1].min() / times[b][:, 1].min() * cores
        best = times[a][:, 0].min() / times[b][:, 0].min()
        return {"best": best, "median": float(np.median(wall)), "processor": spent}

    record["ratios"] = {
        "simulate over numpy (goal 2)": ratio("numpy", "Conditions and simulate", arguments.cores),
        "simulate over its core (at most 2)": ratio("Conditions and simulate", "core", 1),
        "everything over its core (at most 2)": ratio("everything", "core, everything", 1),
    }
    for name, row in record["ratios"].items():
        print(f"{name}: {row['best']:.2f}, median {row['median']:.2f}, processor {row['processor']:.2f}")
    print(json.dumps(record))


if __name__ == "__main__":
    main()
