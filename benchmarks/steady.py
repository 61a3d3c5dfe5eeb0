"""Rate of `steady` in points per second, compared with scipy.optimize.root on the plain reference model.

python benchmarks/steady.py
python benchmarks/steady.py --no-baseline --batches 4096,65536,1048576,16777216
"""

from __future__ import annotations

import time

import jax
import numpy as np
from measure import finish, machine, parser, set_precision, time_batches

options = parser(__doc__.splitlines()[0], "65536")
options.add_argument("--baseline-points", type=int, default=4000, help="points that the loop of SciPy solves")


def conditions(size: int) -> np.ndarray:
    """Rows (wheeled, slope [rad], payload [kg], voltage [V]) of Table 8's ranges that the nominal adhesion holds."""
    rng = np.random.default_rng(8)
    return rng.uniform((0, 0, 0, 15), (1, np.radians(12), 8, 33), (size, 4))


def main() -> None:
    arguments = options.parse_args()
    set_precision(arguments.float32)
    import jax.numpy as jnp

    from mmrjax.fidelities.steady import steady_batch
    from mmrjax.model import paper_robots
    from mmrjax.model.conditions import Conditions
    from mmrjax.model.signals import CONVERGED

    robot = paper_robots.nominal()

    def batch(size: int):
        wheeled, slope, payload, voltage = conditions(size).T
        return Conditions(
            voltage=voltage, slope_deg=np.degrees(slope), payload=payload, configuration=np.round(wheeled)
        )

    def prepare(size: int):
        runs = jax.block_until_ready(batch(size))
        return lambda: steady_batch(robot, runs)

    record = {"benchmark": "steady", "machine": machine()}
    print("    points")
    time_batches(record, arguments, prepare)

    if not arguments.no_baseline:
        from worlds import paper

        count = arguments.baseline_points
        answer = steady_batch(robot, batch(count))
        assert bool(jnp.all(answer.status == CONVERGED))
        ours = np.stack(
            [answer.reading["total_current"] / 2, answer.reading["motor_speed"], answer.reading["speed"]], -1
        )
        rows = [(v, s, p, bool(round(w))) for w, s, p, v in conditions(count)]
        best, loop = float("inf"), []
        for _ in range(2):
            start = time.perf_counter()
            # SciPy's own default tolerance, 1.5e-8: looser than ours
            loop = [paper.Side(*row).steady(tolerance=None) for row in rows]
            best = min(best, time.perf_counter() - start)
        tight = np.array([paper.Side(*row).steady(tolerance=1e-13) for row in rows])
        top = max((r for r in record["batches"] if "per_s" in r), key=lambda r: r["per_s"])
        record["baseline"] = {
            "points": count,
            "per_s": count / best,
            "ratio": top["per_s"] * best / count,
            "error": float(np.max(np.abs(np.array(loop) / tight - 1))),
            "error_ours": float(np.max(np.abs(ours / tight - 1))),
        }
        b = record["baseline"]
        print(
            f"scipy.optimize.root, a loop of {count}: {b['per_s']:.3e} points/s, error {b['error']:.0e} "
            f"(ours {b['error_ours']:.0e}); ratio {b['ratio']:.0f}"
        )
    finish(record, arguments.json)


if __name__ == "__main__":
    main()
