"""The highest step that a robot climbs, found by a search over sequences of lever angles, and time of 1000 climbs.

    python benchmarks/climb_search.py --surface asphalt --members 1024 --generations 4 --out found.csv
    mmrjax climb --step 400 --surface asphalt --sequence found.csv

Members have angles of front and rear levers at times, and a step height. The best ones are parents of the next
generation, with angles and height changed at random. One success may be luck, because the grouser
that reaches the edge first decides the outcome. Each member therefore climbs `--tries` steps within `BAND` below its
height. Its score is the height less `MISSED` times the share of failures. `--adhesion 4` is a ground of unlimited
grip, which shows the limits of geometry and torque. `--begin` makes the first generation from a sequence, which
`--stretch` slows down.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from calibration.data import terrains
from mmrjax.climbing import terrain
from mmrjax.climbing.climb_simulation import NAMES, OVER, LeverSequence, climb_batch
from mmrjax.model import paper_robots, params
from mmrjax.model.conditions import Conditions
from mmrjax.model.paper_tables import SURFACES, adhesion_ratio

jax.config.update("jax_enable_x64", True)

#: Times of the free angles [s]; angles are linear in between.
KNOTS = np.array([0.3, 1.5, 3.0, 4.5, 6.0, 7.5, 9.0, 10.5])
LENGTH = 13.0
#: Least initial angle of a lever [deg].
FLUSH = -8.4
#: Range of heights of a member's tries, and the loss of score if none succeeds [m].
BAND, MISSED = 0.04, 0.2


def run(
    robot: object,
    angles: np.ndarray,
    heights: np.ndarray,
    volts: float,
    adhesion: float,
    payload: float,
    step: float,
    levers: float | None = None,
) -> object:
    """Climbs of members with angles (members, 2, knots) [deg] over steps of their heights [m]."""
    n = len(heights)
    conditions = Conditions(0, voltage=np.full(n, volts), adhesion=adhesion, payload=payload).resolved(robot)
    grounds = jax.vmap(lambda h: terrain.single_step(h))(jnp.asarray(heights))
    front, rear = (jnp.asarray(np.radians(angles[:, k])) for k in range(2))
    supply = None if levers is None else jnp.full(n, levers)
    knots = jnp.broadcast_to(jnp.asarray(KNOTS), front.shape)
    sequence = LeverSequence(knots, front, rear, over_time=True, supply=supply)
    return climb_batch(
        robot, conditions, grounds, sequence, duration=LENGTH, step=step, sample=0.05, part=1.0, record=False
    )


def begotten(random: np.random.Generator, begin: LeverSequence, stretch: float, n: int) -> np.ndarray:
    """Angles of a first generation: those of a sequence over time, slowed down, and perturbed in all but one."""
    at = stretch * np.asarray(begin.knots)
    own = np.stack([np.interp(KNOTS, at, np.degrees(np.asarray(a))) for a in (begin.front, begin.rear)])
    spread = np.linspace(0, 30, n)[:, None, None]
    return bounded(own + spread * random.normal(size=(n, *own.shape)))


def mutated(random: np.random.Generator, parents: np.ndarray, n: int, spread: float) -> np.ndarray:
    """Angles of members of the next generation: of two parents each, perturbed."""
    a, b = parents[random.integers(len(parents), size=(2, n))]
    angles = np.where(random.random(a.shape) < 0.8, a, b) + spread * random.normal(size=a.shape)
    return bounded(angles)


def bounded(angles: np.ndarray) -> np.ndarray:
    """Angles limited to the range of the levers, and to above the ground at the start."""
    angles = np.clip(angles, -170, 180)
    angles[:, :, 0] = np.maximum(angles[:, :, 0], FLUSH)
    return angles


def main() -> None:
    """Runs the search and prints the result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--surface", default="lacquered_wood", choices=list(SURFACES))
    parser.add_argument("--adhesion", type=float, help="replaces the surface's, as a ratio to the bench")
    parser.add_argument("--members", type=int, default=256)
    parser.add_argument("--tries", type=int, default=4, help="number of steps that each member climbs")
    parser.add_argument("--generations", type=int, default=4)
    parser.add_argument("--volts", type=float, default=12.0)
    parser.add_argument("--payload", type=float, default=0.0)
    parser.add_argument("--step", type=float, default=2e-4)
    parser.add_argument("--seconds", type=float, default=1e9, help="time after which no generation is started")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--begin", type=Path, help="CSV of time_s, front_deg, rear_deg for the first generation")
    parser.add_argument("--stretch", type=float, default=1.0)
    parser.add_argument("--heights", type=float, nargs=2, default=(100.0, 300.0), help="of the first generation [mm]")
    parser.add_argument("--levers-voltage", type=float, help="highest of the levers' motors; default: the supply's")
    parser.add_argument("--levers-current", type=float, help="current limit of the levers' driver")
    parser.add_argument("--out", type=Path, help="CSV of the best sequence, for mmrjax climb --sequence")
    told = parser.parse_args()
    robot, random = paper_robots.nominal(), np.random.default_rng(told.seed)
    if told.levers_current is not None:
        robot = params.replace(robot, {"running_gear.levers.current_limit": told.levers_current})
    adhesion = adhesion_ratio(told.surface, True) if told.adhesion is None else told.adhesion
    n, begun = told.members, time.time()
    best: list[tuple[float, float, int, np.ndarray]] = []
    for generation in range(told.generations):
        if time.time() - begun > told.seconds:
            break
        if not best:
            low, high = (h / 1000 for h in told.heights)
            held = random.uniform([[-60], [-90]], [[120], [180]], (n, 2, len(KNOTS)))
            # half of them keep their angles for a while
            angles = bounded(np.where(random.random(held.shape) < 0.5, np.roll(held, 1, axis=2), held))
            if told.begin is not None:
                begin = terrains.read_sequence(told.begin, robot, (0.0, 0.0))
                angles = begotten(random, begin, told.stretch, n)
            heights = random.uniform(low, high, n)
        else:
            parents = np.array([angles for *_, angles in best])
            tops = np.array([h for _, h, *_ in best])
            angles = mutated(random, parents, n, 25.0 * 0.7**generation)
            heights = random.choice(tops, n) + random.uniform(-0.01, 0.04, n)
        start = time.time()
        tried = (heights[:, None] - np.linspace(0, BAND, told.tries)).ravel()
        each = np.repeat(angles, told.tries, axis=0)
        found = run(robot, each, tried, told.volts, adhesion, told.payload, told.step, told.levers_voltage)
        took = time.time() - start
        over = np.sum(found.verdict.reshape(n, told.tries) == OVER, axis=1)
        does = heights - MISSED * (1 - over / told.tries)
        best += [(float(does[k]), float(heights[k]), int(over[k]), angles[k]) for k in np.flatnonzero(over)]
        best = sorted(best, key=lambda b: -b[0])[:48]
        counts = {name: int(np.sum(found.verdict == k)) for k, name in enumerate(NAMES)}
        all_of = [f"{1000 * height:.0f} mm" for _, height, got, _ in best if got == told.tries]
        top = f"highest with all {told.tries} {all_of[0]}" if all_of else "none with all"
        print(f"generation {generation}: {took:.1f} s, {counts}, {top}", flush=True)
        if best and told.out:
            _, height, got, angles = best[0]
            where = f"{told.surface}, {told.volts:g} V, {told.payload:g} kg"
            said = f"# {where}: {got} of {told.tries} steps of {1000 * (height - BAND):.0f} to {1000 * height:.0f} mm"
            rows = np.column_stack([KNOTS, *angles.round(1)])
            np.savetxt(told.out, rows, "%g", ",", header="time_s,front_deg,rear_deg", footer=said, comments="")


if __name__ == "__main__":
    main()
