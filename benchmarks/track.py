# ruff: noqa: E402 (double precision is set before anything is imported)
"""The track model: compile and run time of Table 8, derivatives compared with the run, influence of its assumptions.

python benchmarks/track.py
python benchmarks/track.py --only speed --batches 180,1024
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import resource
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np

from mmrjax.fidelities.track import TIME_ROLLED, _simulate_batch, track
from mmrjax.model import paper_robots, params
from mmrjax.model.conditions import Conditions
from mmrjax.model.signals import STATUSES
from mmrjax.undercarriage.modes import largest_step

#: Parameters of the derivatives: the first four, or all twelve, five of them of the contacts.
DERIVED = (
    "motor.resistance",
    "6T2A.track.guide_friction",
    "6T2A.track.loss_coulomb",
    "gearbox.efficiency_load",
    "motor.torque_constant",
    "gearbox.friction_viscous",
    "6T2A.mass",
    "4W2T.ground.rolling_resistance",
    "6T2A.ground.friction.speed_static",
    "4W2T.ground.friction.static",
    "running_gear.contact_stiffness",
    "running_gear.guide_gap",
)
READ = ("total_current", "motor_speed", "speed")
ASSUMED = {
    "guide_recess": (0.0, 5e-5, 1e-4, 2e-4),
    "guide_gap": (10e-3, 20e-3, 40e-3),
    "pretension": (50.0, 100.0, 200.0),
    "span_stiffness": (3e4, 1e5, 3e5),
    "span_damping": (3.0, 10.0, 30.0),
    "contact_stiffness": (1.5e7, 3e7, 6e7, 1.2e8),
    "contact_exponent": (1.3, 1.5, 1.7),
    "contact_damping": (100.0, 300.0, 1000.0),
    "contact_depth": (5e-5, 1e-4, 2e-4),
    "grouser_length": (2.5e-3, 5e-3, 10e-3),
    "centre_height": (-5e-3, 5e-3, 15e-3),
}


def table8(size: int = 180):
    axes = (0.0, 1.0), paper_robots.SLOPES_DEG, paper_robots.PAYLOADS_KG, paper_robots.VOLTAGES_V
    rows = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 4)
    wheeled, slope, payload, voltage = np.tile(rows, (-(-size // len(rows)), 1))[:size].T
    return Conditions(voltage=voltage, slope_deg=slope, payload=payload, configuration=wheeled)


def timed(call) -> tuple[float, float]:
    """Wall and processor seconds of one call."""
    wall, cpu = time.perf_counter(), time.process_time()
    jax.block_until_ready(call())
    return time.perf_counter() - wall, time.process_time() - cpu


def speed(batches: list[int]) -> dict:
    """Compile and run time of `batches` runs of 1.5 s from standstill."""
    robot, found = paper_robots.nominal(), {}
    for size in batches:
        commands = table8(size)
        first = timed(lambda commands=commands: _simulate_batch(robot, commands, 1.5, 1e-4, 1e-3, False))
        again = timed(lambda commands=commands: _simulate_batch(robot, commands, 1.5, 1e-4, 1e-3, False))
        status = np.asarray(_simulate_batch(robot, commands, 1.5, 1e-4, 1e-3, False).result.status)
        found[size] = {
            "compile_s": first[0] - again[0],
            "run_s": again[0],
            "run_cpu_s": again[1],
            "run_steps_per_s": size * 15_000 / again[0],
            "memory_GB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
            "status": {STATUSES[k]: int(n) for k, n in zip(*np.unique(status, return_counts=True), strict=True)},
        }
    return found


def derivatives(size: int = 30) -> dict:
    """Times of forward Jacobians of the settled readings by 1, 4 and 12 parameters, a gradient by 4, and the run.

    30 runs of 0.6 s from Table 8, rolling. Least processor time of five rounds, with each call in turn.
    """
    robot = paper_robots.nominal()
    values = {p.name: p.value for p in params.walk_parameters(robot)}
    every = table8()
    commands = jax.tree.map(lambda x: x[jnp.linspace(0, len(x) - 1, size).astype(int)], every)

    def readings(theta, run):
        changed = params.replace(robot, {n: values[n] * (1 + x) for n, x in zip(DERIVED, theta, strict=False)})
        answer = track(changed, run, duration=TIME_ROLLED, rolling=True).result
        return jnp.stack([answer.reading[name] for name in READ])

    ways = {
        "run": (readings, 4),
        "forward_1": (jax.jacfwd(readings), 1),
        "forward_4": (jax.jacfwd(readings), 4),
        "forward_12": (jax.jacfwd(readings), 12),
        "reverse_4": (jax.grad(lambda theta, run: readings(theta, run)[0]), 4),
    }
    found, calls = {}, {}
    for name, (way, parameters) in ways.items():
        at = jnp.zeros(parameters)
        began = time.process_time()
        compiled = jax.jit(jax.vmap(way, in_axes=(None, 0))).lower(at, commands).compile()
        found[f"{name}_compile_cpu_s"] = time.process_time() - began
        calls[name] = lambda compiled=compiled, at=at: compiled(at, commands)
        timed(calls[name])
    took = {name: [] for name in calls}
    for _ in range(5):
        for name, call in calls.items():
            took[name].append(timed(call)[1])
    for name, seconds in took.items():
        found[f"{name}_cpu_s"] = min(seconds)
        found[f"{name}_over_run"] = min(seconds) / min(took["run"])
    return found


def assumptions() -> dict:
    """Guide share, current, speed and ripple of 6T2A at 33 V over each constant that the paper does not state."""
    robot, found = paper_robots.nominal(), {}
    runs = Conditions(voltage=33.0, slope_deg=[0.0, 5.0], payload=jnp.asarray([0.0, 8.0]))

    @jax.jit
    def settled(gears):
        def both(gear):
            changed = dataclasses.replace(robot, running_gear=gear)
            return jax.vmap(lambda run: track(changed, run, duration=0.8, rolling=True))(runs)

        answer = jax.vmap(both)(gears)
        normal = answer.signals.normal[..., -300:]
        ripple = (normal.max(-1) - normal.min(-1)) / 2 / normal.mean(-1)
        reading = answer.result.reading
        return answer.steady.guide_share, reading["total_current"], reading["speed"], ripple, answer.result.status

    cases = [(name, value) for name, values in ASSUMED.items() for value in values]
    gears = [params.replace(robot.running_gear, {name: jnp.asarray(value)}) for name, value in cases]
    answers = settled(jax.tree.map(lambda *x: jnp.stack(x), *gears))
    for k, (name, value) in enumerate(cases):
        share, current, fast, ripple, status = (np.asarray(x[k]) for x in answers)
        found[f"{name} = {value:g}"] = {
            "guide_share": share.round(4).tolist(),
            "total_current_A": current.round(4).tolist(),
            "speed_m_s": fast.round(4).tolist(),
            "reaction_ripple": ripple.round(3).tolist(),
            "status": [STATUSES[s] for s in status],
        }
    return found


def turning(size: int = 32) -> dict:
    """Processor time of a step of the half robot and of both sides, `size` runs of 0.1 s, the least of five."""
    robot, found = paper_robots.nominal(), {}
    alike = Conditions("6T2A", voltage=np.linspace(12.0, 33.0, size)).resolved(robot)
    apart = dataclasses.replace(alike, duty_left=jnp.ones(size), duty_right=jnp.linspace(-1.0, 1.0, size))
    for name, runs in (("half_robot", alike), ("both_sides", apart)):
        first = timed(lambda runs=runs: _simulate_batch(robot, runs, 0.1, 1e-4, 1e-3, False))
        took = min(timed(lambda runs=runs: _simulate_batch(robot, runs, 0.1, 1e-4, 1e-3, False))[1] for _ in range(5))
        found[name] = {"compile_cpu_s": first[1], "step_us": 1e6 * took / (1000 * size)}
    return found


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--only", choices=("speed", "derivatives", "assumptions", "step", "turning"))
    options.add_argument("--batches", default="180")
    options.add_argument("--json", type=Path)
    chosen = options.parse_args()
    batches = [int(b) for b in chosen.batches.split(",")]
    parts = {
        "speed": lambda: speed(batches),
        "derivatives": derivatives,
        "assumptions": assumptions,
        "turning": turning,
        "step": lambda: {"largest_step_s": float(largest_step(paper_robots.nominal(), table8()).min())},
    }
    found = {name: call() for name, call in parts.items() if chosen.only in (None, name)}
    print(json.dumps(found, indent=1))
    if chosen.json:
        chosen.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
