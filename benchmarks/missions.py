"""Speed of missions: a patrol of an hour with 120 starts, the current resolved at each.

    python benchmarks/missions.py                      # one robot, 180, and SciPy on a few of them
    python benchmarks/missions.py --robots 100000      # a batch of robots with different masses and frictions

Prints lines of JSON. The first call of each compiles and is not counted unless stated.
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
from scipy.integrate import solve_ivp  # noqa: E402

from mmrjax.missions.mission import Mission, mission  # noqa: E402
from mmrjax.missions.profile import Profile, profile  # noqa: E402
from mmrjax.model import paper_robots, params  # noqa: E402
from mmrjax.model.conditions import Conditions  # noqa: E402
from mmrjax.model.robot import Robot  # noqa: E402

#: Drive at a voltage, stop shorted; 120 times.
PERIOD, DRIVEN, CYCLES, VOLTAGE = 30.0, 22.0, 120, 24.0


def patrol() -> Profile:
    """An hour of the patrol."""
    return profile([0.0, DRIVEN, PERIOD], ["voltage", "brake", "brake"], voltage=VOLTAGE, cycles=CYCLES)


@eqx.filter_jit
def fleet(robots: Robot, conditions: Conditions, course: Profile) -> dict[str, jax.Array]:
    """Numbers of a batch with a leading axis in the conditions and in `mass` and `loss` of the robot."""
    axes = jax.tree.map(lambda x: 0 if jnp.ndim(x) else None, eqx.filter(robots, eqx.is_array))

    def one(robot: Robot, c: Conditions) -> dict[str, jax.Array]:
        found = mission(robot, c, course)
        return {
            "energy": found.total.energy, "distance": found.total.of["distance"], "status": found.result.status,
            "unaccounted": found.total.unaccounted, "peak": found.peaks["current"], "steps": found.steps,
        }  # fmt: skip

    return jax.vmap(one, in_axes=(axes, 0))(robots, conditions)


def drawn(count: int, seed: int = 0) -> tuple[Robot, Conditions]:
    """Robots with masses, losses and resistances around the nominal ones, in both configurations, on small slopes."""
    rng = np.random.default_rng(seed)
    robot = params.without_weak_types(paper_robots.nominal())
    base = {p.name: float(p.value) for p in params.walk_parameters(robot)}
    names = ("motor.resistance", "6T2A.mass", "4W2T.mass", "6T2A.track.loss_coulomb", "4W2T.track.loss_coulomb")
    values = {n: jnp.asarray(base[n] * rng.uniform(0.9, 1.1, count)) for n in names}
    conditions = Conditions(
        configuration=rng.integers(0, 2, count), voltage=VOLTAGE, payload=rng.uniform(0, 8, count),
        slope_deg=rng.uniform(0, 5, count),
    )  # fmt: skip
    return params.replace(robot, values), conditions


def seconds(function: Any, *arguments: Any, rounds: int = 3) -> tuple[float, float, Any]:
    """Time of the first call, the best time of the next ones, and the result."""
    begun = time.perf_counter()
    found = jax.block_until_ready(function(*arguments))
    first, best = time.perf_counter() - begun, np.inf
    print(f"first call {first:.1f} s", file=sys.stderr, flush=True)
    for _ in range(rounds):
        begun = time.perf_counter()
        found = jax.block_until_ready(function(*arguments))
        best = min(best, time.perf_counter() - begun)
    return first, best, found


def scipy_hour(conditions: Conditions, k: int, cycles: int = 2) -> float:
    """Time that SciPy takes for an hour of one run [s], from a few cycles.

    It integrates plain rates with heat and the energy sinks of a mission. LSODA was its fastest stiff method.
    """
    sys.path.append(str(Path(__file__).parent.parent / "tests"))
    from worlds import paper

    c = jax.tree.map(lambda x: float(x[k]), conditions)
    side = paper.Side(VOLTAGE, np.radians(c.slope_deg), c.payload, wheeled=c.configuration > 0.5)
    cold, R_wh, R_ha = side.R, 1.7, 6.0

    def rates(t: float, y: np.ndarray) -> list[float]:
        current, w, V, T_w, T_h = y[0], y[1], y[2], y[5], y[6]
        side.R = cold * (1 + 0.00393 * (T_w - 25))
        own = side.rates(t, y[:5])
        w_k = w / side.i
        rolled, sign = side.r * w_k, paper.soft_sign(side.r * w_k, 0.1 * side.V_s)
        traction = side.N * paper.friction(rolled - V, side.mu_s, side.mu_d, side.V_s, side.V_d)
        motor = (side.M_df0 * sign + side.K_fd * w) * w
        track = (side.M_t0 * sign + side.K_ft * w_k + side.r * side.mu_t * side.share * side.N * sign) * w_k
        into = (side.C * current - side.J_d * own[1]) * w - motor
        out = side.J_w * w_k * own[1] / side.i + track + traction * rolled
        copper, flow = side.R * current**2, (T_w - T_h) / R_wh
        heat = [(copper - flow) * R_wh / 16.3, (flow - (T_h - 25) / R_ha) * R_ha / 593.0]
        rolling = side.roll * paper.soft_sign(V, 0.1 * side.V_s) * V
        ways = [copper, motor, into - out, track, traction * (rolled - V), rolling, side.pull * V]
        return [*own, *heat, side.U * current, *ways, current**2, (out / w_k) ** 2 if w_k else 0.0]

    y, begun = np.zeros(17), time.perf_counter()
    y[5:7] = 25.0
    scale = np.array([10.0, 1000.0, 1.0, 1.0, 10.0, 50.0, 50.0, *[100.0] * 10])
    for _ in range(cycles):
        for voltage, length in ((VOLTAGE, DRIVEN), (0.0, PERIOD - DRIVEN)):
            side.U = voltage
            run = solve_ivp(rates, (0.0, length), y, method="LSODA", rtol=2e-5, atol=2e-5 * scale)
            assert run.success, run.message
            y = run.y[:, -1]
    taken = (time.perf_counter() - begun) * CYCLES / cycles
    lost = 2 * (y[7] - y[8:15].sum())
    assert abs(lost) < 1e-3 * y[7], f"SciPy's energy is off by {lost:g} J"
    return taken


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--robots", type=int, help="number of robots in a batch; default: one and 180, and SciPy")
    options.add_argument("--rounds", type=int, default=3)
    arguments = options.parse_args()
    course = patrol()
    if arguments.robots:
        first, best, found = seconds(fleet, *drawn(arguments.robots), course, rounds=arguments.rounds)
        report = {k: np.asarray(v) for k, v in found.items()}
        print(json.dumps({
            "benchmark": "missions, batch", "machine": machine(), "robots": arguments.robots,
            "first_s": round(first, 2), "best_s": round(best, 3),
            "followed": int(np.sum(report["status"] == 0)), "steps": int(report["steps"].max()),
            "unaccounted": float(np.abs(report["unaccounted"] / report["energy"]).max()),
        }), flush=True)  # fmt: skip
        return
    robot = params.without_weak_types(paper_robots.nominal())

    @eqx.filter_jit
    def alone(robot: Robot, conditions: Conditions, course: Profile) -> Mission:
        return mission(robot, conditions, course)

    first, best, one = seconds(alone, robot, Conditions(voltage=VOLTAGE), course, rounds=arguments.rounds)
    print(json.dumps({
        "benchmark": "missions, one", "machine": machine(), "first_s": round(first, 2), "best_s": round(best, 3),
        "steps": int(one.steps), "unaccounted": float(one.total.unaccounted / one.total.energy),
        "energy_Wh": float(one.total.energy) / 3600, "distance_m": float(one.total.of["distance"]),
    }), flush=True)  # fmt: skip
    batch = drawn(180)
    first, best, found = seconds(fleet, *batch, course, rounds=arguments.rounds)
    hours = [scipy_hour(batch[1], k) for k in (0, 60, 120, 179)]
    print(json.dumps({
        "benchmark": "missions, 180", "machine": machine(), "first_s": round(first, 2), "best_s": round(best, 3),
        "scipy_s": round(float(np.mean(hours)) * 180, 1), "ratio": round(float(np.mean(hours)) * 180 / best, 1),
        "followed": int(np.sum(np.asarray(found["status"]) == 0)),
    }), flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
