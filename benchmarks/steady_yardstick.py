# ruff: noqa: E402 (cores and platform are chosen before jax starts)
"""`steady` compared with vectorised NumPy of the same balances, the natural alternative for a large sweep.

python benchmarks/steady_yardstick.py
python benchmarks/steady_yardstick.py --platform gpu --batches 4194304,67108864

On a CPU: a closed form without effects (only currents and speeds; every output), and Newton's method with four
effects, in NumPy on one core, `steady` on two. All sides of a ratio are timed in turn, in rounds, so that other work
on the machine affects all equally. Ratios are of the best times, of the medians, and of processor times divided by
the cores that each side uses, which other work barely affects. The last line is JSON.
On a GPU: points per second, bytes per point, and the shares of the device's bandwidth and arithmetic, from XLA's
counts for the compiled program (the loop's body as one turn).
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
from typing import Any

options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
options.add_argument("--platform", choices=("cpu", "gpu"), default="cpu")
options.add_argument("--batches", default="", help="points, comma separated (cpu 262144; gpu 2^22 to 2^26)")
options.add_argument("--rounds", type=int, default=40, help="timed calls of each side")
options.add_argument("--cores", type=int, default=2, help="number of cores that the process may use (cpu)")
options.add_argument("--bandwidth", type=float, default=4.8e12, help="of the GPU [bytes/s] (H200: 4.8e12)")
options.add_argument(
    "--arithmetic", type=float, default=34e12, help="of the GPU, double precision [1/s] (H200: 34e12)"
)
arguments = options.parse_args()
if arguments.platform == "cpu":
    # Before any thread starts.
    os.environ["JAX_PLATFORMS"] = "cpu"
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: arguments.cores])

import jax
import numpy as np
from measure import in_turn, machine, set_precision, yardstick_points

set_precision(single=False)

from worlds import vectorised

from mmrjax.effects import BY_NAME
from mmrjax.fidelities import outputs
from mmrjax.fidelities.steady import steady_outputs
from mmrjax.model import channels, paper_robots, params
from mmrjax.model.conditions import Conditions
from mmrjax.model.robot import Robot
from mmrjax.model.signals import CONVERGED

THREE = vectorised.NAMES
ALL = tuple(output.name for output in outputs.output_table(channels.usual_channels()))
EFFECTS = {"series_resistance": 0.3, "churning": 5e-4, "winding_heating": 1.0, "nonlinear_slip": 0.05}
PARAMETERS = (
    "motor.resistance", "motor.torque_constant", "motor.friction_coulomb", "motor.friction_viscous",
    "gearbox.ratio", "gearbox.efficiency_load", "gearbox.friction_coulomb", "6T2A.track.loss_coulomb",
    "6T2A.track.loss_viscous", "6T2A.mass", "6T2A.ground.rolling_resistance", "6T2A.ground.friction.static",
)  # fmt: skip


def conditions(size: int) -> Conditions:
    """The points as conditions on the device."""
    return jax.block_until_ready(Conditions(*yardstick_points(size)))


def with_effects(robot: Robot) -> Robot:
    """The robot with the four effects."""
    return dataclasses.replace(robot, effects=tuple(BY_NAME[k](amplitude=v) for k, v in EFFECTS.items()))


def largest_difference(ours: dict[str, Any], theirs: dict[str, np.ndarray]) -> float:
    """Largest difference of any output, over its largest value."""
    return max(float(np.max(np.abs(np.asarray(ours[k]) - v)) / np.max(np.abs(v))) for k, v in theirs.items())


@jax.jit
def derivatives(robot: Robot, runs: Conditions, values: dict[str, jax.Array]) -> dict[str, dict[str, jax.Array]]:
    """Derivatives of the three outputs with respect to parameters at each point, in reverse, one output at a time."""

    def total(values: dict[str, jax.Array], name: str) -> jax.Array:
        return steady_outputs(params.replace(robot, values), runs, (name,))[name].sum()

    return {name: jax.grad(total)(values, name) for name in THREE}


def compared(size: int, rounds: int) -> dict[str, Any]:
    """Both sides at one number of points: differences, rates and ratios."""
    robot, runs, given = paper_robots.nominal(), conditions(size), yardstick_points(size)
    effects, amplitudes = with_effects(robot), tuple(EFFECTS.values())
    for one in (robot, effects):
        assert (np.asarray(steady_outputs(one, runs, ("status",))["status"]) == CONVERGED).all()

    theirs_three = dict(zip(THREE, vectorised.closed_form(*given), strict=True))
    theirs_all = vectorised.closed_form_all(*given)
    theirs_newton = dict(zip(THREE, vectorised.newton(*given, *amplitudes), strict=True))
    assert set(theirs_all) == set(ALL)
    differences = {
        "three": largest_difference(steady_outputs(robot, runs, THREE), theirs_three),
        "all": largest_difference(steady_outputs(robot, runs, ALL), theirs_all),
        "effects": largest_difference(steady_outputs(effects, runs, THREE), theirs_newton),
    }
    assert max(differences.values()) < 1e-9, differences

    values = {p.name: np.full(size, float(p.value)) for p in params.walk_parameters(robot) if p.name in PARAMETERS}
    times = in_turn(
        {
            "numpy_three": lambda: vectorised.closed_form(*given),
            "steady_three": lambda: steady_outputs(robot, runs, THREE),
            "numpy_all": lambda: vectorised.closed_form_all(*given),
            "steady_all": lambda: steady_outputs(robot, runs, (*ALL, "status", "flags")),
            "numpy_newton": lambda: vectorised.newton(*given, *amplitudes),
            "steady_effects": lambda: steady_outputs(effects, runs, THREE),
            "steady_effects_all": lambda: steady_outputs(effects, runs, (*ALL, "status", "flags")),
            "derivatives": lambda: derivatives(robot, runs, values),
        },
        rounds,
    )
    pairs = {
        "three over NumPy's closed form, three": ("numpy_three", "steady_three", 2.0),
        "all over NumPy's closed form, three": ("numpy_three", "steady_all", 0.5),
        "all over NumPy's closed form, all": ("numpy_all", "steady_all", None),
        "effects over NumPy's Newton": ("numpy_newton", "steady_effects", 1.0),
    }
    pairs["derivatives over a run (at most)"] = ("derivatives", "steady_three", 4.0)

    def ratio(a: str, b: str) -> dict[str, float]:
        wall, spent = times[a] / times[b], times[a][:, 1].min() / times[b][:, 1].min()
        # NumPy keeps one core busy, XLA all of them.
        cores = arguments.cores if a.startswith("numpy") else 1
        best = times[a][:, 0].min() / times[b][:, 0].min()
        return {"best": best, "median": float(np.median(wall[:, 0])), "processor": spent * cores}

    ratios = {name: {**ratio(a, b), "goal": goal} for name, (a, b, goal) in pairs.items()}
    return {
        "points": size,
        "differences": differences,
        "per_s": {name: size / t[:, 0].min() for name, t in times.items()},
        "per_s_median": {name: size / float(np.median(t[:, 0])) for name, t in times.items()},
        "processor_ms": {name: 1e3 * t[:, 1].min() for name, t in times.items()},
        "ratios": ratios,
    }


def counted(size: int, rounds: int) -> dict[str, Any]:
    """Points per second on a GPU, and XLA's counts for the compiled program."""
    robot, runs = paper_robots.nominal(), conditions(size)
    rows = {}
    for name, one, wanted in (
        ("three", robot, THREE),
        ("all", robot, (*ALL, "status", "flags")),
        ("effects", with_effects(robot), THREE),
    ):
        compiled = (
            jax.jit(lambda robot, runs, wanted=wanted: steady_outputs(robot, runs, wanted)).lower(one, runs).compile()
        )
        best = float(in_turn({name: lambda: compiled(one, runs)}, rounds)[name][:, 0].min())  # noqa: B023
        cost, memory = compiled.cost_analysis() or {}, compiled.memory_analysis()
        least = (memory.argument_size_in_bytes + memory.output_size_in_bytes) / size
        moved, flops = cost.get("bytes accessed", float("nan")) / size, cost.get("flops", float("nan")) / size
        rate = size / best
        rows[name] = {
            "per_s": rate,
            "bytes_point_in_and_out": least,
            "bytes_point_counted": moved,
            "operations_point_counted": flops,
            "bandwidth_share_in_and_out": least * rate / arguments.bandwidth,
            "bandwidth_share_counted": moved * rate / arguments.bandwidth,
            "arithmetic_share": flops * rate / arguments.arithmetic,
            "temporary_bytes_point": memory.temp_size_in_bytes / size,
        }
    return {"points": size, **rows}


def main() -> None:
    gpu = arguments.platform == "gpu"
    if gpu and jax.devices()[0].platform != "gpu":
        sys.exit(f"--platform gpu: jax found {jax.devices()[0].platform}; expected a GPU")
    batches = arguments.batches or ("4194304,16777216,67108864" if gpu else "262144")
    record: dict[str, Any] = {"benchmark": "steady_yardstick", "machine": machine(), "rows": []}
    for size in (int(b) for b in batches.split(",")):
        record["load_before"] = os.getloadavg()[0]
        row = (counted if gpu else compared)(size, arguments.rounds)
        record["rows"].append(row)
        print(f"{size} points")
        if gpu:
            for name in ("three", "all", "effects"):
                r = row[name]
                print(
                    f"  {name:8} {r['per_s']:.3e} points/s; {r['bytes_point_in_and_out']:.0f} bytes a point in and "
                    f"out, {r['bandwidth_share_in_and_out']:.0%} of the bandwidth (as XLA counts, with what it "
                    f"stores between: {r['bytes_point_counted']:.0f}, {r['bandwidth_share_counted']:.0%}); "
                    f"{r['operations_point_counted']:.0f} operations, {r['arithmetic_share']:.0%} of the arithmetic"
                )
        else:
            for name, rate in row["per_s"].items():
                spent = row["processor_ms"][name]
                print(
                    f"  {name:20} best {rate:.3e} points/s, median {row['per_s_median'][name]:.3e}; "
                    f"{spent:.1f} ms of processor"
                )
            for name, r in row["ratios"].items():
                goal = "" if r["goal"] is None else f" (goal {r['goal']:g})"
                print(f"  {name}: {r['best']:.2f}, median {r['median']:.2f}, processor {r['processor']:.2f}{goal}")
    print(json.dumps(record))


if __name__ == "__main__":
    main()
