"""Checks before a run of the track model: impossible postures, and the largest stable step."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mmrjax.compile.compiling import compiled
from mmrjax.model import balances, masses, params
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import State
from mmrjax.undercarriage import mjcf
from mmrjax.undercarriage.half_robot import HalfRobotState, HalfRobotSystem, advance, build_system, roll, stand
from mmrjax.undercarriage.side_contacts import lever_tips

SAFETY = 0.75  # of the linear limit: ripple loads the contacts more than standing does
LEAST = 0.01  # [m/s], least V_s for the linear limit
PROBE = 1e-6  # [s], step for computing rates


def step_derivative(run: HalfRobotSystem, at: HalfRobotState) -> Float[Array, "11 11"]:
    """Derivative of (q, v, current) after one step with respect to (q, v, current), of one run."""

    def after(y: Float[Array, " 11"]) -> Float[Array, " 11"]:
        next_state, _, _ = advance(run, HalfRobotState(y[:5], y[5:10], y[10], at.discharge, at.memory))
        return jnp.concatenate([next_state.q, next_state.v, jnp.asarray(next_state.current)[None]])

    return jax.jacfwd(after)(jnp.concatenate([at.q, at.v, jnp.asarray(at.current)[None]]))


@compiled
def _step_derivatives(
    robot: Robot, conditions: Conditions, steps: Float[Array, "runs starts"]
) -> Float[Array, "runs starts 11 11"]:
    """Derivatives of (q, v, current) after one step with respect to (q, v, current), standing and rolling."""

    def one(conditions: Conditions, steps: Float[Array, " starts"]) -> Float[Array, "starts 11 11"]:
        run = build_system(robot, conditions, PROBE)
        starts = jax.tree.map(lambda *at: jnp.stack(at), stand(run), roll(run))
        return jax.vmap(lambda at, step: step_derivative(build_system(robot, conditions, step), at))(starts, steps)

    return jax.vmap(one)(conditions, steps)


def _roll_period(robot: Robot, conditions: Conditions) -> Scalar:
    """Period of rolling over that of bouncing, for a robot on contacts at ±B/2 [-]."""
    zero = jnp.zeros_like(conditions.voltage)
    mass = balances.begin_signals(robot, conditions, State(zero, zero, zero, zero)).mass
    parts = mjcf.robot_bodies(robot, masses.masses_of_parts(robot, conditions, mass), conditions)
    half_width = robot.chassis(conditions.configuration).turning.width / 2
    inertia = jnp.sum(parts.inertia[:, 0] + parts.mass * parts.place[:, 1] ** 2)
    return jnp.sqrt(inertia / jnp.sum(parts.mass)) / half_width


def largest_step(robot: Robot, conditions: Conditions) -> Float[np.ndarray, " runs"]:
    """Largest stable step [s] of each run of a batch of `conditions`.

    Three quarters of the step that, linearised about the robot standing and rolling, would make a small disturbance
    grow. The quarter is for the ripple of the contacts. A small V_s is no limit: friction is implicit in a step, and
    its remaining chatter stays within V_s. For a robot free to turn, the step of straight travel is reduced by the
    ratio of the frequencies of rolling and bouncing on its contacts.
    """
    if conditions.turns:
        slower = np.asarray(jax.vmap(lambda c: _roll_period(robot, c))(conditions))
        return np.minimum(slower, 1.0) * largest_step(robot, conditions.straight())
    laws = [p for p in params.walk_parameters(robot) if p.name.endswith("ground.friction.speed_static")]
    robot = params.without_weak_types(params.replace(robot, {p.name: jnp.maximum(p.value, LEAST) for p in laws}))

    def maps(steps: Float[np.ndarray, "runs starts"]) -> Float[np.ndarray, "runs starts 11 11"]:
        transition_maps = np.asarray(_step_derivatives(robot, conditions, jnp.asarray(steps)))
        usable = np.isfinite(transition_maps).all(axis=(-2, -1), keepdims=True)
        return np.where(usable, transition_maps, 0.0)

    low, high = np.full((*conditions.shape, 2), -7.0), np.full((*conditions.shape, 2), -2.0)  # powers of ten
    # Growth in continuous time (a robot about to tip, friction that falls with speed) does not depend on the step;
    # slow drifts do not either.
    rates = (maps(np.full_like(low, PROBE)) - np.eye(11)) / PROBE
    physical = 20.0 + 2 * np.maximum(np.linalg.eigvals(rates).real.max(axis=-1), 0.0)
    for _ in range(16):
        middle = (low + high) / 2
        growth = np.abs(np.linalg.eigvals(maps(10**middle))).max(axis=-1)
        stable = growth < 1 + physical * 10**middle
        low, high = np.where(stable, middle, low), np.where(stable, high, middle)
    return np.asarray(SAFETY * (10**low).min(axis=1))


def check_track_step(robot: Robot, conditions: Conditions, step: float, sample: float) -> None:
    """Raises for conditions and steps that the track model cannot compute.

    Args:
        robot, conditions: a batch of runs.
        step, sample: intervals of integration and of the record [s].

    Raises:
        ValueError: a lever reaches below the ground, or the step is too large for the stiffness. The message
            then suggests a smaller step that divides `sample`.
    """
    tracked = robot.configurations.tracked[np.asarray(conditions.configuration, int)]
    gear = robot.running_gear
    height = float(robot.radius_pulley + gear.grouser_height)  # levers exist only on tracks
    for name, (_, up) in zip(("lever_front", "lever_rear"), lever_tips(gear, conditions), strict=True):
        tips = np.ravel(np.asarray(up))
        tip = float(np.min(tips))
        if tracked.any() and tip < -height:
            of_run = f"levers_{name.removeprefix('lever_')}_deg"
            run_value = getattr(conditions, of_run)
            stands = (
                np.degrees(float(getattr(gear, name))) if run_value is None else np.ravel(run_value)[np.argmin(tips)]
            )
            name = name if run_value is None else of_run
            raise ValueError(
                f"{name}: got {stands:.0f} deg, its tip {1e3 * (-tip - height):.0f} mm below the ground; "
                "expected both tips above the ground"
            )
    limits = largest_step(robot, conditions)
    worst = int(np.argmin(limits))
    if step > limits[worst]:
        raise ValueError(
            f"step: got {step:g} s; the largest stable step is {limits[worst]:.2g} s (run {worst + 1} of "
            f"{len(limits)}); take {_whole(sample, limits[worst]):g} s, a softer contact or a larger V_s"
        )


def _whole(sample: float, limit: float) -> float:
    # The largest step up to `limit` that divides `sample` and can be written with six digits.
    count = math.ceil(sample / limit)
    while abs(float(f"{sample / count:.6g}") * count / sample - 1) > 1e-12:
        count += 1
    return sample / count
