"""Slip of the ten tracked rows by the track model: one set of nine constants, searched by generations.

    python benchmarks/slip.py                                  # against the paper's simulated rows
    python benchmarks/slip.py --against measured               # against the measured ones
    python benchmarks/slip.py --against measured --without 10  # without the rows of a slope, which are predicted
    python benchmarks/slip.py --population 4096 --generations 1  # how long a population takes

Slip = 1 - V / (r_k ω_k), eq. (33). The best set is run again at half and a quarter of the step.
Prints lines of JSON.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import equinox as eqx  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from measure import machine  # noqa: E402

from calibration.data.runs import read  # noqa: E402
from calibration.inference import population, priors  # noqa: E402
from calibration.inference.observers.settled import SettledRuns  # noqa: E402
from calibration.inference.population import Members, Population, Rows  # noqa: E402
from calibration.inference.problem import Observation, Problem, data_of  # noqa: E402
from mmrjax import channels, params, robots  # noqa: E402
from mmrjax.conditions import Conditions  # noqa: E402
from mmrjax.fidelities import steady  # noqa: E402
from mmrjax.fidelities.stability import largest_step  # noqa: E402
from mmrjax.fidelities.track import STEP, Trajectory, track  # noqa: E402
from mmrjax.robot import Robot  # noqa: E402
from mmrjax.signals import Result  # noqa: E402

DURATION = 1.5  # of a run, from a rolling start [s]
#: Guide friction at the share that the track model puts out (docs/track-model.md).
BASE = {"6T2A.track.guide_friction": 0.06}
FREE = (
    "6T2A.ground.friction.static",
    "6T2A.ground.friction.dynamic",
    "6T2A.ground.friction.speed_static",
    "running_gear.guide_recess",
    "running_gear.guide_gap",
    "running_gear.contact_stiffness",
    "running_gear.contact_damping",
    "running_gear.centre_offset",
    "running_gear.payload_height",
)
SD = 0.4  # of the slip [percentage points]
NEAR = 0.15  # spread of the first generation about a set that is given [prior sd]


class Longer(SettledRuns):
    """Settled rows by runs that are long enough for a gear that shakes."""

    def __call__(self, robot: Robot) -> Observation:
        def one(conditions: Conditions) -> Result:
            return track(robot, conditions, duration=DURATION, rolling=True).result

        found = jax.vmap(one)(self.conditions)
        reading = jnp.stack([found.reading[name] for name in channels.USUAL], -1)
        return Observation(reading, jnp.asarray(found.adhesion_used), found.status, found.flags)


def posed(against: str) -> tuple[Problem, np.ndarray]:
    """The problem of the tracked rows, and their slip [%]."""
    robot = params.replace(robots.nominal(), BASE)
    table = read(against)
    table = table.where(table["configuration"] == "6T2A")
    coordinates = priors.coordinates(robot, FREE, any_surface=True)
    data = data_of(table.measured(), SettledRuns.sizes(table), len(FREE))
    problem = Problem(params.strong(robot), coordinates, Longer.of(table, robot, "track"), data)
    return problem, slip(problem, table.measured())


def slip(problem: Problem, reading: np.ndarray) -> np.ndarray:
    """Slip [%] of readings, (..., rows)."""
    robot = problem.base
    motor, speed = (reading[..., channels.USUAL.index(name)] for name in ("motor_speed", "speed"))
    return 100 * (1 - speed / (motor / float(robot.gearbox.ratio) * float(robot.radius_pulley)))


def search(
    problem: Problem, target: np.ndarray, weight: np.ndarray, arguments: argparse.Namespace, members: Members
) -> Population:
    """The generations of one search; rows of weight 0 are held out."""

    def objective(z: np.ndarray, seen: Rows) -> np.ndarray:
        with np.errstate(all="ignore"):
            error = np.where(weight > 0, (slip(problem, seen.reading) - target) / SD, 0.0)
            cost = 0.5 * (np.sum(error**2, -1) + np.sum(z**2, -1))
        return np.where(np.isfinite(cost), cost, np.inf)

    size = len(FREE)
    centre, spread = np.zeros(size), 1.0
    if arguments.near is not None:
        values, coordinates = json.loads(arguments.near.read_text(encoding="utf-8")), problem.coordinates
        theta = np.array([values[name] for name in FREE])
        u = np.where(np.array(coordinates.scale), np.log(np.maximum(theta, 1e-12)), theta)
        centre, spread = (u - np.asarray(coordinates.location)) / np.asarray(coordinates.spread), NEAR
    return population.evolve(
        members, objective, centre, spread**2 * np.eye(size), size=arguments.population,
        generations=arguments.generations, seed=arguments.seed, tell=lambda said: print(said, file=sys.stderr),
    )  # fmt: skip


def known(problem: Problem, found: Population, at: int) -> dict[str, Any]:
    """What the rows determine, from a regression of the slip over the members near the best."""
    there = np.isfinite(found.cost) & np.isfinite(slip(problem, found.reading)).all(1)
    z = found.z[there]
    near = np.argsort(np.sum((z - found.z[at]) ** 2, 1), kind="stable")[: 5 * (len(FREE) + 1)]
    values = slip(problem, found.reading[there][near])
    design = np.column_stack([np.ones(len(near)), z[near] - found.z[at]])
    slope, *_ = np.linalg.lstsq(design, values / SD, rcond=None)
    singular = np.linalg.svd(slope[1:].T, compute_uv=False)
    return {"singular_values": singular.round(3).tolist(), "determined": int(np.sum(singular > 1))}


@eqx.filter_jit
def shaken(robot: Robot, conditions: Conditions, step: float) -> Trajectory:
    """Runs at a step, whatever the linear limit says of it."""
    return jax.vmap(lambda one: track(robot, one, duration=DURATION, step=step, rolling=True))(conditions)


def again(problem: Problem, z: np.ndarray) -> dict[str, Any]:
    """Slip of 1.5 s at several steps, and how much the best set shakes."""
    robot, conditions, found = problem.robot(z), problem.observe.conditions, {}
    found["largest stable step"] = float(largest_step(robot, conditions).min())
    for parts in (1, 2, 4):
        runs = shaken(robot, conditions, STEP / parts)
        signals, last = runs.steady.signals, runs.time > 0.75
        found[f"step / {parts}"] = {
            "slip": np.round(100 * (1 - signals.speed / signals.speed_theoretical), 3).tolist(),
            "status": np.asarray(runs.result.status).tolist(),
        }
        if parts == 1:
            for name in ("normal", "total_current", "speed"):
                x = np.asarray(getattr(runs.signals, name))[:, np.asarray(last)[0]]
                found[f"ripple of {name}"] = np.round(x.std(1) / x.mean(1), 4).tolist()
            found["reading"] = {n: np.asarray(runs.result.reading[n]).round(4).tolist() for n in channels.USUAL}
    return found


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--against", default="simulated_by_paper", choices=("simulated_by_paper", "measured"))
    options.add_argument("--population", type=int, default=256)
    options.add_argument("--generations", type=int, default=30)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--all-rows", action="store_true", help="also the first measured row, else left out")
    options.add_argument("--without", type=float, help="slope whose rows are held out and predicted [deg]")
    options.add_argument("--near", type=Path, help="JSON file of constants near which to search")
    options.add_argument("--members", type=Path, help="file that keeps what was run")
    arguments = options.parse_args()
    problem, target = posed(arguments.against)
    weight = np.ones(len(target))
    if arguments.against == "measured" and not arguments.all_rows:
        weight[0] = 0.0
    slopes = np.rad2deg(np.asarray(problem.observe.conditions.slope))
    counted = weight.copy()
    if arguments.without is not None:
        weight = np.where(np.isclose(slopes, arguments.without), 0.0, weight)
    members = Members(problem, arguments.members)
    plain = jax.vmap(lambda c: steady.steady(problem.base, c))(problem.observe.conditions)
    begun = time.perf_counter()
    found = search(problem, target, weight, arguments, members)
    at = int(found.order[0])
    error = slip(problem, found.reading[at]) - target
    print(json.dumps({
        "benchmark": "slip", "machine": machine(), "against": arguments.against, "target": target.round(3).tolist(),
        "members": len(found.z), "seconds": round(time.perf_counter() - begun, 1), "settled": found.settled,
        "slip": slip(problem, found.reading[at]).round(3).tolist(), "weight": weight.tolist(),
        "rms": float(np.sqrt(np.average(error**2, weights=weight))), "without_deg": arguments.without,
        "held_out_error": error[(weight == 0) & (counted > 0)].round(3).tolist(),
        "steady": np.asarray(100 * plain.slip).round(3).tolist(),
        "constants": dict(zip(FREE, map(float, problem.coordinates.value(found.z[at])), strict=True)),
        "z": found.z[at].round(3).tolist(), **known(problem, found, at), **again(problem, found.z[at]),
    }), flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
