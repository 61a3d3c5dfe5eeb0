# ruff: noqa: E402 (double precision is set before anything is imported)
"""Slip of contacts that shake: the averaged law against the track model, ripple in, slip out.

    python benchmarks/vibration.py            # 24 running gears drawn at random, ten rows each

Of each run the ripple of its contacts is measured and the slip that follows from it compared with the run's own,
beside that of Fig. 7 without ripple. Prints a line of JSON.
"""

from __future__ import annotations

import argparse
import json

import jax

jax.config.update("jax_enable_x64", True)

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from measure import machine

from mmrjax import params, robots, vibration
from mmrjax.conditions import Conditions
from mmrjax.fidelities.track import track
from mmrjax.robot import Robot
from mmrjax.signals import CONVERGED, NOT_SETTLED

#: The tracked rows of the paper's tables: 15 V without payload, 33 V with 8 kg, at 0 to 20 deg.
VOLTAGE, SLOPE, PAYLOAD = (
    np.repeat([15.0, 33.0], 5),
    np.tile([0.0, 5.0, 10.0, 15.0, 20.0], 2),
    np.repeat([0.0, 8.0], 5),
)
#: Least and greatest value of each constant; of those in LOG the logarithm is drawn evenly.
DRAWN = {
    "6T2A.ground.friction.static": (0.5, 0.75),
    "6T2A.ground.friction.dynamic": (0.8, 0.98),  # of μ_s
    "6T2A.ground.friction.speed_static": (0.005, 0.03),
    "running_gear.guide_recess": (0.0, 4e-4),
    "running_gear.contact_stiffness": (1.5e7, 8e7),
    "running_gear.contact_damping": (200.0, 1200.0),
    "running_gear.guide_gap": (0.01, 0.03),
    "running_gear.payload_height": (0.04, 0.1),
    "running_gear.centre_offset": (-0.02, 0.02),
}
LOG = ("6T2A.ground.friction.speed_static", "running_gear.contact_stiffness", "running_gear.contact_damping")
#: Upper ends of the classes of slip [%].
CLASSES = (3.0, 6.0, 10.0, 100.0)


def gear(rng: np.random.Generator) -> Robot:
    """A robot whose running gear and friction are drawn."""
    values = {
        name: float(np.exp(rng.uniform(*np.log(ends))) if name in LOG else rng.uniform(*ends))
        for name, ends in DRAWN.items()
    }
    values["6T2A.ground.friction.dynamic"] *= values["6T2A.ground.friction.static"]
    values["6T2A.ground.friction.speed_dynamic"] = 10 * values["6T2A.ground.friction.speed_static"]
    values["6T2A.track.guide_friction"] = 0.06
    return params.replace(robots.nominal(), {name: jnp.asarray(value) for name, value in values.items()})


@eqx.filter_jit
def compared(robot: Robot) -> dict[str, jax.Array]:
    """Slip of each row [%]: of the run, of the averaged law, of Fig. 7 alone; its ripple and status."""

    def one(voltage: jax.Array, slope: jax.Array, payload: jax.Array) -> dict[str, jax.Array]:
        conditions = Conditions(0, voltage=voltage, slope_deg=slope, payload=payload)
        run = track(robot, conditions, duration=1.5, sample=2e-4, rolling=True)
        seen, signals = vibration.ripple(robot, conditions, run), run.steady.signals
        friction = robot.chassis(0).ground.friction
        percent = 100 / signals.speed_theoretical
        return {
            "slip": 100 * (1 - signals.speed / signals.speed_theoretical),
            "law": percent * (vibration.speed_sliding(friction, seen.demanded, seen.swing) - seen.lead),
            "without ripple": percent * friction.speed_creep(seen.demanded),
            "swing": percent * seen.swing,
            "lead": percent * seen.lead,
            "normal": seen.normal,
            "demanded": seen.demanded / friction.static,
            "status": run.result.status,
        }

    return jax.vmap(one)(jnp.asarray(VOLTAGE), jnp.asarray(SLOPE), jnp.asarray(PAYLOAD))


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--gears", type=int, default=24)
    options.add_argument("--seed", type=int, default=11)
    arguments = options.parse_args()
    rng = np.random.default_rng(arguments.seed)
    runs = [jax.device_get(compared(gear(rng))) for _ in range(arguments.gears)]
    all_runs = {name: np.concatenate([run[name] for run in runs]) for name in runs[0]}
    goes_on = np.isin(all_runs["status"], (CONVERGED, NOT_SETTLED))
    rows, low = [], -100.0
    for high in CLASSES:
        here = goes_on & (all_runs["slip"] >= low) & (all_runs["slip"] < high)
        row = {"slip_up_to": high, "runs": int(here.sum())}
        for name in ("law", "without ripple"):
            error = (all_runs[name] - all_runs["slip"])[here]
            row[name] = {
                "rms": float(np.sqrt(np.nanmean(error**2))),
                "within_half_a_point": float(np.mean(np.abs(error) < 0.5)),
                "none": int(np.sum(~np.isfinite(error))),
            }
        rows.append(row)
        low = high
    record = {
        "benchmark": "vibration",
        "machine": machine(),
        "seed": arguments.seed,
        "left_out": int((~goes_on).sum()),
    }
    print(json.dumps(record | {"classes": rows}))


if __name__ == "__main__":
    main()
