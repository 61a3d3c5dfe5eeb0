"""What is said before a run of the track model: postures that cannot be, and the largest stable step."""

from __future__ import annotations

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mmrjax import params
from mmrjax.conditions import Conditions
from mmrjax.fidelities.half_robot import Motion, advance, roll, stand, system
from mmrjax.robot import Robot
from mmrjax.running_gear import RunningGear
from mmrjax.undercarriage import lever_tip

SAFETY = 0.75  # of the linear limit: contacts bear more than when standing, by their ripple
_PROBE = 1e-5  # [s], step at which the slopes of the dynamics are taken; their limit is found from them


@eqx.filter_jit
def _slopes(robot: Robot, conditions: Conditions, gear: RunningGear) -> Float[Array, "runs starts 11 11"]:
    # Rates of (q, v, current) by (q, v, current), standing and rolling.
    def one(conditions: Conditions) -> Float[Array, "starts 11 11"]:
        run = system(robot, conditions, gear, _PROBE)

        def rate(y: Float[Array, " 11"], at: Motion) -> Float[Array, " 11"]:
            motion = Motion(y[:5], y[5:10], y[10], at.discharge, at.memory)
            after, signals, _ = advance(run, motion)
            current = jnp.asarray(signals.voltage_left / signals.inductance)
            return jnp.concatenate([y[5:10], (after.v - motion.v) / _PROBE, current[None]])

        def slope(at: Motion) -> Float[Array, "11 11"]:
            return jax.jacfwd(rate)(jnp.concatenate([at.q, at.v, jnp.asarray(at.current)[None]]), at)

        return jax.vmap(slope)(jax.tree.map(lambda *at: jnp.stack(at), stand(run), roll(run)))

    return jax.vmap(one)(conditions)


def _grows(slopes: Float[np.ndarray, "n 11 11"], steps: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    # Spectral radius of a semi-implicit Euler step, the winding integrated exactly.
    n, step = len(slopes), steps[:, None, None]
    velocity = np.eye(11)[5:10] + step * slopes[:, 5:10]
    place = np.broadcast_to(np.eye(11)[:5], (n, 5, 11)) + step * velocity
    decay = slopes[:, 10, 10]
    gain = np.expm1(steps * decay) / decay
    current = np.eye(11)[10] + gain[:, None] * slopes[:, 10]
    return np.abs(np.linalg.eigvals(np.concatenate([place, velocity, current[:, None]], axis=1))).max(axis=1)


def largest_step(robot: Robot, conditions: Conditions, gear: RunningGear | None = None) -> Float[np.ndarray, " runs"]:
    """Largest stable step [s] of each run of a batch of `conditions`.

    Three quarters of the step at which semi-implicit Euler, linearised about the robot standing and
    rolling, would make a small disturbance grow; the quarter is for the ripple of the contacts.
    """
    gear = RunningGear() if gear is None else gear
    slopes = np.asarray(_slopes(params.strong(robot), conditions, gear))
    runs, starts = slopes.shape[:2]
    flat = slopes.reshape(runs * starts, 11, 11)
    usable = np.isfinite(flat).all(axis=(1, 2))
    flat = np.where(usable[:, None, None], flat, np.diag([0.0] * 10 + [-1.0]))
    # What grows in continuous time too (a robot about to tip, friction that falls with speed) is no matter of
    # the step; slow drifts neither.
    physical = 20.0 + 2 * np.maximum(np.linalg.eigvals(flat).real.max(axis=1), 0.0)
    low, high = np.full(len(flat), -7.0), np.full(len(flat), -2.0)  # powers of ten, halved in between
    for _ in range(16):
        middle = (low + high) / 2
        stable = _grows(flat, 10**middle) < 1 + physical * 10**middle
        low, high = np.where(stable, middle, low), np.where(stable, high, middle)
    return SAFETY * (10**low).reshape(runs, starts).min(axis=1)


def refuse(robot: Robot, conditions: Conditions, gear: RunningGear, step: float, sample: float) -> None:
    """Raise for what no run can be made of.

    Args:
        robot, conditions, gear: a batch of runs.
        step, sample: intervals of integration and of the record [s].

    Raises:
        ValueError: a lever reaches below the ground, or the step is too large for the stiffness; the message
            then names a step that is neither too large nor at odds with `sample`.
    """
    tracked = np.asarray(jax.vmap(robot.chassis)(conditions.configuration).on_tracks) > 0.5
    height = float(robot.radius_pulley + gear.grouser_height)  # levers are on tracks alone
    for name, angle, side in (("lever_front", gear.lever_front, 1.0), ("lever_rear", gear.lever_rear, -1.0)):
        tip = float(lever_tip(gear, angle, side)[1])
        if tracked.any() and tip < -height:
            raise ValueError(
                f"{name}: got {np.degrees(float(angle)):.0f} deg, its tip {1e3 * (-tip - height):.0f} mm below the "
                "ground; expected a posture on the main tracks, with both tips above the ground"
            )
    limits = largest_step(robot, conditions, gear)
    worst = int(np.argmin(limits))
    if step > limits[worst]:
        raise ValueError(
            f"step: got {step:g} s; contacts and friction are too stiff for it, the largest stable step is "
            f"{limits[worst]:.2g} s (run {worst + 1} of {len(limits)}); take {_whole(sample, limits[worst]):g} s, a "
            "softer contact or a larger V_s"
        )


def _whole(sample: float, limit: float) -> float:
    # The largest step up to `limit` that divides `sample` and that six digits write down in full.
    count = math.ceil(sample / limit)
    while abs(float(f"{sample / count:.6g}") * count / sample - 1) > 1e-12:
        count += 1
    return sample / count
