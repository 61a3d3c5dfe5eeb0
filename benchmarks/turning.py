"""The paper's robot turning on the spot: power on each surface of Table 5, and least voltage of a turn.

    python benchmarks/turning.py [--speed] [--track]

With --speed: settled turns per second in one batch, and the time of turning runs of 2 s compared with straight ones.
With --track: turns of the track model compared with settled ones, and with settled ones on an equivalent even
contact.
"""

from __future__ import annotations

import argparse
import time

import jax
import jax.numpy as jnp
import numpy as np

import mmrjax as mm
from mmrjax.fidelities import drive, steady, track
from mmrjax.model import params
from mmrjax.model.paper_tables import SURFACES, adhesion_ratio, lateral_ratio
from mmrjax.model.signals import NOT_SETTLED, STATUSES
from mmrjax.undercarriage.running_gear import BeltPath, tips_on_path

jax.config.update("jax_enable_x64", True)

VOLTAGES = np.concatenate([np.arange(0.5, 8.0, 0.25), [15.0, 24.0, 33.0]])
#: Yaw rate above which a robot turns [rad/s].
TURNS = 0.05


def surfaces() -> None:
    """Prints the table of docs/explanation/turning.md."""
    robot = mm.nominal()
    names = [(c, s, p) for c in robot.configurations for s in SURFACES for p in (0.0, 8.0)]
    rows = [(c, s, p, float(u)) for c, s, p in names for u in VOLTAGES]
    tracks = {c: float(k.on_tracks) > 0.5 for c, k in robot.configurations.items()}
    runs = mm.Conditions(
        [r[0] for r in rows], voltage=[r[3] for r in rows], payload=[r[2] for r in rows], duty_left=-1.0,
        duty_right=1.0, adhesion=[adhesion_ratio(r[1], tracks[r[0]]) for r in rows],
        adhesion_lateral=[lateral_ratio(r[1], tracks[r[0]]) for r in rows],
    )  # fmt: skip
    found = mm.simulate(robot, runs).result
    shape = len(names), len(VOLTAGES)
    rate, current, power, status = (
        np.asarray(x).reshape(shape)
        for x in (found.reading["yaw_rate"], found.reading["motor_current_right"], found.power_supply, found.status)
    )
    print("| robot | surface | payload | turns from | 15 V | 24 V | 33 V | power at 33 V | not settled |")
    print("|---|---|---|---|---|---|---|---|---|")
    for k, (configuration, surface, payload) in enumerate(names):
        turning = VOLTAGES[np.nan_to_num(rate[k]) > TURNS]
        cells = [f"{rate[k, j]:.2f} rad/s, {current[k, j]:.2f} A" for j in (-3, -2, -1)]
        least = f"{turning.min():g} V" if turning.size else "-"
        print(
            f"| {configuration} | {surface.replace('_', ' ')} | {payload:g} kg | {least} | {' | '.join(cells)} | "
            f"{power[k, -1]:.0f} W | {(status[k] == NOT_SETTLED).sum()} |"
        )


def speed(points: int) -> None:
    """Prints settled turns per second, and the time of turning runs over that of straight ones."""
    robot = mm.nominal()
    rng = np.random.default_rng(0)
    duties = rng.uniform(-1, 1, (2, points))
    runs = mm.Conditions(["6T2A"] * points, voltage=33.0, duty_left=duties[0], duty_right=duties[1]).resolved(robot)
    for name in ("compiled and run", "run"):
        begun = time.perf_counter()
        status = jax.block_until_ready(steady.steady_outputs(robot, runs, ("yaw_rate", "total_current", "status")))
        took = time.perf_counter() - begun
        print(f"steady, {points} turns, {name}: {took:.2f} s, {points / took:.3g} a second")
    print("statuses", np.unique(np.asarray(status["status"]), return_counts=True))
    straight = mm.Conditions(["6T2A"] * 180, voltage=np.linspace(10, 33, 180)).resolved(robot)
    turning = mm.Conditions(
        ["6T2A"] * 180, voltage=np.linspace(10, 33, 180), duty_left=1.0, duty_right=rng.uniform(-1, 1, 180)
    ).resolved(robot)
    times, took = jnp.asarray([0.0, 2.0]), {}
    for name, batch in (("straight", straight), ("turning", turning)):
        for _ in range(2):
            begun = time.perf_counter()
            jax.block_until_ready(drive.drive_batch(robot, batch, times))
            took[name] = time.perf_counter() - begun
    print(f"drive, 180 runs of 2 s: straight {took['straight']:.3f} s, turning {took['turning']:.3f} s, "
          f"{took['turning'] / took['straight']:.1f} times")  # fmt: skip


def tracks() -> None:
    """Prints the table of docs/explanation/turning.md, "Against the track model"."""
    robot = mm.nominal()
    rows = [(24, 24, 10), (15, 15, -15), (33, 33, 14.85), (15, 10.5, 15), (24, -24, 24), (24, 24, 12)]
    names = ["6T2A"] * 4 + ["4W2T"] * 2
    supply, left, right = np.array(rows, float).T
    runs = mm.Conditions(names, voltage=supply, duty_left=left / supply, duty_right=right / supply).resolved(robot)
    found = track.track_batch(robot, runs, duration=1.0, rolling=True)
    half = found.time.shape[1] // 2
    load, place = (np.asarray(x)[:, half:] for x in (found.reactions.grouser, found.reactions.place))
    along = np.asarray(
        tips_on_path(BeltPath(robot.radius_pulley, robot.running_gear), jnp.asarray(place.ravel())).forward
    )
    spread = (load * along.reshape(place.shape) ** 2).sum((1, 2, 3)) / np.maximum(load.sum((1, 2, 3)), 1e-9)
    lengths = np.where(np.asarray(runs.configuration) == 0, np.sqrt(12 * spread), robot.running_gear.wheelbase)

    @jax.jit
    @jax.vmap
    def settled(run, share, length):
        changed = {"6T2A.track.guide_share": share, "running_gear.wheelbase": length}
        return steady.steady(params.replace(robot, changed), run).reading

    whole = settled(runs, found.steady.guide_share, robot.running_gear.wheelbase * np.ones(len(rows)))
    even = settled(runs, found.steady.guide_share, jnp.asarray(lengths))
    for k, (name, row) in enumerate(zip(names, rows, strict=True)):
        print(f"{name} {row[1]:g} and {row[2]:g} V, an even load over {1e3 * lengths[k]:.1f} mm, guides' share "
              f"{float(found.steady.guide_share[k]):.3f}, {STATUSES[int(found.result.status[k])]}")  # fmt: skip
        for column in ("yaw_rate", "motor_current_left", "motor_current_right", "speed", "lateral_speed"):
            values = (float(x[column][k]) for x in (whole, found.result.reading, even))
            print("  {:20s} steady {:8.4f}  track {:8.4f}  steady on that length {:8.4f}".format(column, *values))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--speed", action="store_true", help="turns a second")
    parser.add_argument("--track", action="store_true", help="compare with the track model")
    parser.add_argument("--points", type=int, default=16_384, help="turns of --speed")
    chosen = parser.parse_args()
    if chosen.speed:
        speed(chosen.points)
    else:
        (tracks if chosen.track else surfaces)()
