"""Sensitivity studies: coverage of the indices by their intervals, and speed of a study's model evaluations.

    python benchmarks/sensitivity.py coverage       # 200 seeds: Ishigami, and the steady model against SciPy
    python benchmarks/sensitivity.py speed          # model evaluations of a study: SciPy loop, NumPy, ours

The SciPy implementation is `tests/worlds/paper.py`, a loop of `scipy.optimize.root` over points. The NumPy one is the
closed form of the same balances without effects, vectorised. `--json FILE` writes every number.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests"), str(Path(__file__).resolve().parent)]
os.environ.setdefault("JAX_ENABLE_X64", "true")

import jax  # noqa: E402
import numpy as np  # noqa: E402
from measure import machine  # noqa: E402
from worlds import paper  # noqa: E402

from calibration.sensitivity import sampled_indices  # noqa: E402
from calibration.sensitivity import uncertain_inputs as room  # noqa: E402
from calibration.sensitivity.model import Model, chosen_outputs  # noqa: E402
from mmrjax import nominal  # noqa: E402
from mmrjax.fidelities.variation import Variation, evaluate_points  # noqa: E402
from mmrjax.model.conditions import Conditions  # noqa: E402

NAMES = (
    "motor.torque_constant",
    "motor.resistance",
    "gearbox.efficiency_load",
    "6T2A.track.guide_share",
    "6T2A.track.loss_coulomb",
    "6T2A.ground.rolling_resistance",
)
OUTPUTS = ("total_current", "motor_speed", "speed")
VOLTAGE, SLOPE, PAYLOAD = 24.0, 5.0, 3.0
#: The adhesion of the reference study, without sliding draws.
ADHESION = {"6T2A.ground.friction.static": 0.6}


# --- Ishigami --------------------------------------------------------------------------------------------------


def ishigami(u: np.ndarray, a: float = 7.0, b: float = 0.1) -> np.ndarray:
    """Ishigami and Homma (1990) at points of the unit cube."""
    x = np.pi * (2 * u - 1)
    return np.sin(x[:, 0]) + a * np.sin(x[:, 1]) ** 2 + b * x[:, 2] ** 4 * np.sin(x[:, 0])


def ishigami_indices(a: float = 7.0, b: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """Its exact first-order and total indices."""
    one, two = (1 + b * np.pi**4 / 5) ** 2 / 2, a**2 / 8
    both = b**2 * np.pi**8 * (1 / 18 - 1 / 50)
    whole = one + two + both
    return np.array([one, two, 0.0]) / whole, np.array([one + both, two, both]) / whole


# --- the steady model in SciPy and NumPy -----------------------------------------------------------------------


def by_scipy(values: np.ndarray) -> np.ndarray:
    """Current of both motors, motor speed and speed [SI] at rows of parameters, one root at a time."""
    found = np.empty((len(values), 3))
    for k, row in enumerate(values):
        p = {**paper.NOMINAL, **ADHESION, **dict(zip(NAMES, row, strict=True))}
        current, motor, speed = paper.Side(VOLTAGE, math.radians(SLOPE), PAYLOAD, p=p).steady(tolerance=None)
        found[k] = 2 * current, motor, speed
    return found


def by_numpy(values: np.ndarray) -> np.ndarray:
    """Same as `by_scipy` by the closed form, vectorised over rows: two linear balances, then the creep."""
    p: dict[str, Any] = {**paper.NOMINAL, **ADHESION}
    p |= {name: values[:, k] for k, name in enumerate(NAMES)}
    c, alpha = "6T2A.", math.radians(SLOPE)
    mass = (p[c + "mass"] + PAYLOAD) / 2
    normal = mass * paper.G * math.cos(alpha)
    demand = p[c + "ground.rolling_resistance"] * normal + mass * paper.G * math.sin(alpha)
    ratio, radius, constant = p["gearbox.ratio"], p[c + "radius"], p["motor.torque_constant"]
    drive = ratio * p["gearbox.efficiency_load"]
    dry = p["motor.friction_coulomb"] + p["gearbox.friction_coulomb"]
    viscous = p["motor.friction_viscous"] + p["gearbox.friction_viscous"]
    guide = p[c + "track.guide_friction"] * p[c + "track.guide_share"] * normal
    load = p[c + "track.loss_coulomb"] + radius * (guide + demand)
    resistance = p["motor.resistance"]
    # drive (C (U - C w) / R - dry - viscous w) = load + K w / i
    above = drive * (constant * VOLTAGE / resistance - dry) - load
    below = drive * (constant**2 / resistance + viscous) + p[c + "track.loss_viscous"] / ratio
    motor = above / below
    current = (VOLTAGE - constant * motor) / resistance
    share = demand / normal / p[c + "ground.friction.static"]
    creep = 2 * p[c + "ground.friction.speed_static"] * np.sin(np.arcsin(share) / 3)
    return np.stack([2 * current, motor, radius * motor / ratio - creep], -1)


def ours() -> tuple[room.UncertainInputs, Model, Conditions]:
    """Inputs, model and operating point of the same study in this project."""
    from mmrjax.model import params

    robot = params.replace(nominal(), {k: jax.numpy.asarray(v) for k, v in ADHESION.items()})
    inputs = room.inputs_from_priors(robot, NAMES, {})
    model = Model(robot, inputs.columns, "steady", {}, chosen_outputs(OUTPUTS, robot))
    return inputs, model, Conditions(0, VOLTAGE, SLOPE, PAYLOAD)


# --- parts --------------------------------------------------------------------------------------------------------


def coverage(seeds: int, size: int, reference_size: int) -> dict[str, Any]:
    """Coverage of the true indices by 95 % intervals, for Ishigami and for the steady model."""
    record: dict[str, Any] = {"seeds": seeds, "evaluations": {}}
    exact = ishigami_indices()
    held = np.zeros((2, 3))
    for seed in range(seeds):
        design = sampled_indices.sobol_design(3, size, seed)
        found = sampled_indices.sobol_terms(design, ishigami(design))
        assert found is not None
        indices = sampled_indices.sobol_indices(found)
        for k, (true, e) in enumerate(zip(exact, (indices["first"], indices["total"]), strict=True)):
            held[k] += (e.low <= true) & (true <= e.high)
    record["ishigami"] = {"first": (held[0] / seeds).tolist(), "total": (held[1] / seeds).tolist()}
    print("Ishigami, share of seeds whose interval holds the index:", record["ishigami"], flush=True)

    inputs, model, conditions = ours()
    design = sampled_indices.sobol_design(len(NAMES), reference_size, 2**31)
    values = inputs.values(inputs.scores(design))
    began = time.perf_counter()
    by = by_scipy(values[:, : len(NAMES)])
    print(f"reference: {len(values)} roots by SciPy in {time.perf_counter() - began:.0f} s", flush=True)
    known = [sampled_indices.sobol_indices(sampled_indices.sobol_terms(design, by[:, j])) for j in range(3)]  # type: ignore[arg-type]
    held = np.zeros((3, 2, len(NAMES)))
    for seed in range(seeds):
        design = sampled_indices.sobol_design(len(NAMES), size, seed)
        values = inputs.values(inputs.scores(design))
        answer = model(values, conditions)
        for j, name in enumerate(OUTPUTS):
            found = sampled_indices.sobol_terms(design, answer.values[name])
            assert found is not None
            indices = sampled_indices.sobol_indices(found)
            pairs = [(indices[order], known[j][order]) for order in ("first", "total")]
            for k, (e, true) in enumerate(pairs):
                held[j, k] += (e.low <= true.value) & (true.value <= e.high)
    share = held / seeds
    record["steady"] = {
        name: {"first": share[j, 0].tolist(), "total": share[j, 1].tolist()} for j, name in enumerate(OUTPUTS)
    }
    record["reference"] = {
        name: {"first": known[j]["first"].value.tolist(), "total": known[j]["total"].value.tolist()}
        for j, name in enumerate(OUTPUTS)
    }
    inside = (share >= 0.9) & (share <= 0.98)
    for name, by_order in record["steady"].items():
        print(name, {key: [round(x, 3) for x in x_] for key, x_ in by_order.items()})
    print(
        f"steady: {share.min():.3f} to {share.max():.3f}, mean {share.mean():.3f}; "
        f"{int(inside.sum())} of {inside.size} indices within 0.90-0.98"
    )
    return record


def speed(points: int, repeats: int) -> dict[str, Any]:
    """Rate of model evaluations over the points of a Sobol design [1/s]: a loop of SciPy, NumPy, ours."""
    inputs, model, conditions = ours()
    blocks = 2 * len(NAMES) + 2
    design = sampled_indices.sobol_design(len(NAMES), 2 ** int(np.log2(points / 32 / blocks)), 0)
    values = inputs.values(inputs.scores(design))
    own = values[:, : len(NAMES)]
    some = own[:: max(len(own) // 2000, 1)]
    began = time.perf_counter()
    slow = by_scipy(some)
    scipy_s = len(some) / (time.perf_counter() - began)
    record: dict[str, Any] = {"points": len(values), "scipy_per_s": scipy_s}
    best = {"numpy": math.inf, "ours": math.inf, "ours_in_study": math.inf}
    variation, there = Variation(model.robot, model.columns), jax.numpy.asarray(values)
    model(values, conditions)
    evaluate_points(variation, "steady", there, conditions, {}, OUTPUTS)
    for _ in range(repeats):  # in turn
        began = time.perf_counter()
        fast = by_numpy(own)
        best["numpy"] = min(best["numpy"], time.perf_counter() - began)
        began = time.perf_counter()
        jax.block_until_ready(evaluate_points(variation, "steady", there, conditions, {}, OUTPUTS))
        best["ours"] = min(best["ours"], time.perf_counter() - began)
        began = time.perf_counter()
        answer = model(values, conditions)  # including transfers between NumPy and the device
        best["ours_in_study"] = min(best["ours_in_study"], time.perf_counter() - began)
    mine = np.stack([answer.values[name] for name in OUTPUTS], -1)
    record |= {f"{who}_per_s": len(values) / s for who, s in best.items()}
    record["error_numpy"] = float(np.max(np.abs(fast[:: max(len(own) // 2000, 1)] / slow - 1)))
    record["error_ours"] = float(np.max(np.abs(mine / fast - 1)))
    record["over_scipy"] = record["ours_per_s"] / scipy_s
    record["over_numpy"] = record["ours_per_s"] / record["numpy_per_s"]
    for key, value in record.items():
        print(f"{key}: {value:.4g}")
    return record


def main() -> None:
    """Runs one part."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("part", choices=("coverage", "speed"))
    options.add_argument("--seeds", type=int, default=200, help="number of seeds for the coverage")
    options.add_argument("--size", type=int, default=32, help="base points of a replicate, a power of 2")
    options.add_argument("--reference-size", type=int, default=512, help="base points of the reference by SciPy")
    options.add_argument("--points", type=int, default=500_000, help="evaluations for the rate")
    options.add_argument("--repeats", type=int, default=10)
    options.add_argument("--json", type=Path, metavar="FILE", help="write every number to this file too")
    a = options.parse_args()
    record: dict[str, Any] = machine()
    if a.part == "coverage":
        record |= coverage(a.seeds, a.size, a.reference_size)
    else:
        record |= speed(a.points, a.repeats)
    if a.json:
        a.json.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
