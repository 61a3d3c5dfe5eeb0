# ruff: noqa: E402 (double precision is set before anything is imported)
"""Slip of shaking contacts: the law of Fig. 7 averaged over their oscillation, compared with the track model.

    python benchmarks/vibration.py            # 24 running gears drawn at random, ten rows each

A track that runs over its grousers shakes: reaction and sliding speed of each contact oscillate about their means.
Friction is nonlinear, so a robot may slip far more than Fig. 7 gives for its mean demand (Section 3.2.4, ref. [46].
Blekhman, Vibrational Mechanics, 2000: dry friction becomes an apparent viscous one).
docs/explanation/vibration.md derives it.
For each run the slip computed from the measured ripple of its contacts is compared with the run's own slip
and with that of Fig. 7 without ripple. Prints a line of JSON.
"""

from __future__ import annotations

import argparse
import json

import jax

jax.config.update("jax_enable_x64", True)

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from measure import machine

from mmrjax.fidelities.track import STEP, TrackTrajectory, track
from mmrjax.model import paper_robots, params
from mmrjax.model.conditions import Conditions
from mmrjax.model.contact import Friction
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import CONVERGED, NOT_SETTLED
from mmrjax.undercarriage import side_contacts as undercarriage
from mmrjax.undercarriage.half_robot import build_system
from mmrjax.undercarriage.side_contacts import GROUSERS

#: The tracked rows of the paper's tables: 15 V without payload, 33 V with 8 kg, at 0 to 20 deg.
VOLTAGE, SLOPE, PAYLOAD = (
    np.repeat([15.0, 33.0], 5),
    np.tile([0.0, 5.0, 10.0, 15.0, 20.0], 2),
    np.repeat([0.0, 8.0], 5),
)
#: Least and greatest value of each constant; constants in LOG are drawn uniformly in their logarithm.
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
#: Second harmonic of the sliding speed over the first: two events per pitch, a grouser landing in front and one
#: lifting at the rear. With it bursts of sliding are short and steep, as in the track model.
SECOND = 0.5
#: Number of phases for the average.
PHASES = 128
_BISECTIONS = 40


def _wave() -> Float[np.ndarray, " phases"]:
    phase = 2 * np.pi * (np.arange(PHASES) + 0.5) / PHASES
    wave = np.cos(phase) + SECOND * np.cos(2 * phase)
    return np.asarray(wave / np.mean(np.abs(wave)))


#: Deviation of the sliding speed from its mean, over its mean size: mean 0, mean size 1.
WAVE = _wave()


def coefficient(friction: Friction, speed: Scalar, swing: Scalar) -> Scalar:
    """Mean friction coefficient [-] of contacts with sliding speeds that oscillate about `speed`.

    (1/2π) ∫ μ(v + s ξ(φ)) dφ, with s = `swing`, the mean size of the deviation [m/s]. With s = 0 that of Fig. 7.
    """
    return jnp.mean(friction.coefficient(speed + swing * jnp.asarray(WAVE)))


def speed_sliding(friction: Friction, demanded: Scalar, swing: Scalar) -> Scalar:
    """Mean sliding speed [m/s] that shaking contacts need for the coefficient `demanded` [-], scalars.

    The inverse of `coefficient`, without swing `Friction.speed_creep`. NaN if no speed suffices.
    """
    furthest = friction.speed_static + swing * float(np.abs(WAVE).max())

    def narrower(between: tuple[Scalar, Scalar], _: None) -> tuple[tuple[Scalar, Scalar], None]:
        low, high = between
        middle = (low + high) / 2
        less = coefficient(friction, middle, swing) < demanded
        return (jnp.where(less, middle, low), jnp.where(less, high, middle)), None

    (low, high), _ = jax.lax.scan(narrower, (-furthest, furthest), None, length=_BISECTIONS)
    root = jax.lax.stop_gradient((low + high) / 2)
    value, slope = jax.jvp(lambda v: coefficient(friction, v, swing), (root,), (jnp.ones_like(root),))
    carried = coefficient(friction, furthest, swing) >= demanded
    # A Newton step does not change the root and gives it its derivatives.
    return jnp.where(carried, root - (value - demanded) / jnp.where(slope > 0, slope, 1.0), jnp.nan)


class Ripple(eqx.Module):
    """Oscillation of the contacts of one run, over its averaging window.

    The resulting loss of speed is the mean sliding speed for the demand (`speed_sliding`), less the lead.

    Attributes:
        swing: mean size of the sliding speed less its mean [m/s].
        lead: mean less plain mean of the sliding speed [m/s], positive if contacts slide faster while their
            load is larger. Means are weighted by load.
        normal: sd over mean of the ground's reaction [-].
        demanded: mean traction over mean reaction and adhesion [-].
    """

    swing: Scalar
    lead: Scalar
    normal: Scalar
    demanded: Scalar


def ripple(robot: Robot, conditions: Conditions, run: TrackTrajectory, window: float = 0.8) -> Ripple:
    """Ripple of one run on tracks (scalar fields) over its last `window` [s], from samples of at most 0.2 ms."""
    half = build_system(robot, conditions, STEP)

    def contacts(q: Float[Array, " 5"], v: Float[Array, " 5"]) -> tuple[Array, Array]:
        at = undercarriage.compute_contacts(half.path, half.chassis, q, v)
        return at.force[:GROUSERS], -at.speed_x[:GROUSERS]

    late = run.time > run.time[-1] - window
    force, sliding = jax.vmap(contacts)(run.q, run.v)
    load = jnp.where(late[:, None], force, 0.0)
    signals = run.steady.signals

    def mean(values: Array) -> Scalar:
        return jnp.sum(load * values) / jnp.sum(load)

    centre, reaction = mean(sliding), jnp.sum(force, axis=1)
    return Ripple(
        swing=mean(jnp.abs(sliding - centre)),
        lead=centre - (signals.speed_theoretical - signals.speed),
        normal=jnp.std(reaction, where=late) / jnp.mean(reaction, where=late),
        demanded=signals.traction / (signals.normal * signals.adhesion),
    )


def gear(rng: np.random.Generator) -> Robot:
    """A robot with random running gear and friction."""
    values = {
        name: float(np.exp(rng.uniform(*np.log(ends))) if name in LOG else rng.uniform(*ends))
        for name, ends in DRAWN.items()
    }
    values["6T2A.ground.friction.dynamic"] *= values["6T2A.ground.friction.static"]
    values["6T2A.ground.friction.speed_dynamic"] = 10 * values["6T2A.ground.friction.speed_static"]
    values["6T2A.track.guide_friction"] = 0.06
    return params.replace(paper_robots.nominal(), {name: jnp.asarray(value) for name, value in values.items()})


@eqx.filter_jit
def compared(robot: Robot, voltage: Array, slope: Array, payload: Array) -> dict[str, Array]:
    """Slip of each row [%]: of the run, of the averaged law, of Fig. 7 alone. Its ripple and status."""

    def one(voltage: jax.Array, slope: jax.Array, payload: jax.Array) -> dict[str, jax.Array]:
        conditions = Conditions(0, voltage=voltage, slope_deg=slope, payload=payload)
        run = track(robot, conditions, duration=1.5, sample=2e-4, rolling=True)
        seen, signals = ripple(robot, conditions, run), run.steady.signals
        friction = robot.chassis(0).ground.friction
        percent = 100 / signals.speed_theoretical
        return {
            "slip": 100 * (1 - signals.speed / signals.speed_theoretical),
            "law": percent * (speed_sliding(friction, seen.demanded, seen.swing) - seen.lead),
            "without ripple": percent * friction.speed_creep(seen.demanded),
            "swing": percent * seen.swing,
            "lead": percent * seen.lead,
            "normal": seen.normal,
            "demanded": seen.demanded / friction.static,
            "status": run.result.status,
        }

    return jax.vmap(one)(voltage, slope, payload)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--gears", type=int, default=24)
    options.add_argument("--seed", type=int, default=11)
    arguments = options.parse_args()
    rng = np.random.default_rng(arguments.seed)
    rows = (VOLTAGE, SLOPE, PAYLOAD)
    runs = [jax.device_get(compared(gear(rng), *rows)) for _ in range(arguments.gears)]
    all_runs = {name: np.concatenate([run[name] for run in runs]) for name in runs[0]}
    goes_on = np.isin(all_runs["status"], (CONVERGED, NOT_SETTLED))
    table, low = [], -100.0
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
        table.append(row)
        low = high
    record = {
        "benchmark": "vibration",
        "machine": machine(),
        "seed": arguments.seed,
        "left_out": int((~goes_on).sum()),
    }
    print(json.dumps(record | {"classes": table}))


if __name__ == "__main__":
    main()
