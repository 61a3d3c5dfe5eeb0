"""Impossible postures and the largest stable step of the track model, and the natural vibrations of half a robot."""

from __future__ import annotations

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import linear_sum_assignment

from mmrjax.compile.compiling import compiled
from mmrjax.model import balances, masses, params
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.undercarriage import mjcf
from mmrjax.undercarriage.half_robot import (
    HalfRobotState,
    HalfRobotSystem,
    advance,
    build_system,
    mass_matrix,
    roll,
    stand,
)
from mmrjax.undercarriage.side_contacts import lever_tips

SAFETY = 0.75  # of the linear limit: ripple loads the contacts more than standing does
LEAST = 0.01  # [m/s], least V_s for the linear limit
PROBE = 1e-6  # [s], step for computing rates


def step_derivative(run: HalfRobotSystem, state: HalfRobotState) -> Float[Array, "11 11"]:
    """Derivative of (q, v, current) after one step with respect to (q, v, current), of one run."""

    def numbers_after(y: Float[Array, " 11"]) -> Float[Array, " 11"]:
        next_state, _, _ = advance(run, HalfRobotState(y[:5], y[5:10], y[10], state.discharge, state.memory))
        return jnp.concatenate([next_state.q, next_state.v, next_state.current[None]])

    return jax.jacfwd(numbers_after)(jnp.concatenate([state.q, state.v, state.current[None]]))


@compiled
def _step_derivatives(
    robot: Robot, conditions: Conditions, steps: Float[Array, "runs starts"]
) -> Float[Array, "runs starts 11 11"]:
    """Derivatives of (q, v, current) after one step with respect to (q, v, current), standing and rolling."""

    def derivatives_of_run(conditions: Conditions, steps: Float[Array, " starts"]) -> Float[Array, "starts 11 11"]:
        run = build_system(robot, conditions, PROBE)
        states = jax.tree.map(lambda *state: jnp.stack(state), stand(run), roll(run))
        return jax.vmap(lambda state, step: step_derivative(build_system(robot, conditions, step), state))(
            states, steps
        )

    return jax.vmap(derivatives_of_run)(conditions, steps)


def _roll_period(robot: Robot, conditions: Conditions) -> Scalar:
    """Period of rolling over that of bouncing, for a robot on contacts at ±B/2 [-]."""
    mass = balances.mass_with_effects(robot, conditions)
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
        period_ratio = np.asarray(jax.vmap(lambda c: _roll_period(robot, c))(conditions))
        return np.minimum(period_ratio, 1.0) * largest_step(robot, conditions.straight())
    speed_parameters = [p for p in params.walk_parameters(robot) if p.name.endswith("ground.friction.speed_static")]
    robot = params.without_weak_types(
        params.replace(robot, {p.name: jnp.maximum(p.value, LEAST) for p in speed_parameters})
    )

    def transition_matrices(steps: Float[np.ndarray, "runs starts"]) -> Float[np.ndarray, "runs starts 11 11"]:
        matrices = np.asarray(_step_derivatives(robot, conditions, jnp.asarray(steps)))
        is_finite = np.isfinite(matrices).all(axis=(-2, -1), keepdims=True)
        return np.where(is_finite, matrices, 0.0)

    low, high = np.full((*conditions.shape, 2), -7.0), np.full((*conditions.shape, 2), -2.0)  # powers of ten
    # Growth in continuous time (a robot about to tip, friction that falls with speed) does not depend on the step;
    # slow drifts do not either.
    rates = (transition_matrices(np.full_like(low, PROBE)) - np.eye(11)) / PROBE
    physical = 20.0 + 2 * np.maximum(np.linalg.eigvals(rates).real.max(axis=-1), 0.0)
    for _ in range(16):
        middle = (low + high) / 2
        growth = np.abs(np.linalg.eigvals(transition_matrices(10**middle))).max(axis=-1)
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
        lowest_tip = float(np.min(tips))
        if tracked.any() and lowest_tip < -height:
            condition_name = f"levers_{name.removeprefix('lever_')}_deg"
            stated = getattr(conditions, condition_name)
            angle_deg = (
                np.degrees(float(getattr(gear, name))) if stated is None else np.ravel(stated)[np.argmin(tips)]
            )
            name = name if stated is None else condition_name
            raise ValueError(
                f"{name}: got {angle_deg:.0f} deg, its tip {1e3 * (-lowest_tip - height):.0f} mm below the ground; "
                "expected both tips above the ground"
            )
    limits = largest_step(robot, conditions)
    worst = int(np.argmin(limits))
    if step > limits[worst]:
        raise ValueError(
            f"step: got {step:g} s; the largest stable step is {limits[worst]:.2g} s (run {worst + 1} of "
            f"{len(limits)}); take {_step_that_divides(sample, limits[worst]):g} s, a softer contact or a larger V_s"
        )


def _step_that_divides(sample: float, limit: float) -> float:
    # The largest step up to `limit` that divides `sample` and can be written with six digits.
    count = math.ceil(sample / limit)
    while abs(float(f"{sample / count:.6g}") * count / sample - 1) > 1e-12:
        count += 1
    return sample / count


POSITIONS = 12  # of the belt within a pitch of the grousers
#: A mode is named after the coordinate with most of its kinetic energy.
NAMES = ("surge", "bounce", "pitch", "drive", "driven pulley")
#: Damping ratio below which a mode amplifies at its own frequency: 1 / 2ζ above 1.
RESONANT = 0.5
_SWINGS = 0.95  # damping ratio above which a motion does not count as an oscillation


class Mode(NamedTuple):
    """A natural vibration, over the positions of the belt within a pitch.

    Attributes:
        name: one of `NAMES`, chosen by the kinetic energy in its eigenvector.
        frequency: damped natural frequency, averaged over the positions that have the mode [Hz].
        low, high: range of the frequency over the positions [Hz].
        natural: undamped natural frequency |λ| / 2π, averaged [Hz].
        damping: damping ratio ζ = -Re λ / |λ|, averaged [-]. Negative: unstable.
        share: share of its kinetic energy in the coordinate of its name, averaged [-].
        positions: share of the positions that have the mode [-].
    """

    name: str
    frequency: float
    low: float
    high: float
    natural: float
    damping: float
    share: float
    positions: float

    @property
    def amplifies(self) -> bool:
        """True if it is lightly damped at most positions of the belt."""
        return self.damping < RESONANT and self.positions > 0.5

    @property
    def resonant(self) -> bool:
        """True if it amplifies and its frequency changes by less than an octave with the position of the belt.

        Some harmonic always lies within an octave, so a peak there would confirm nothing.
        """
        return self.amplifies and self.high < 2 * self.low

    @property
    def band(self) -> tuple[float, float]:
        """Band of resonance [Hz]: its range or its half-power width f ± ζ f, whichever is wider."""
        width = abs(self.damping) * self.frequency
        return min(self.low, self.frequency - width), max(self.high, self.frequency + width)


def modes(robot: Robot, conditions: Conditions, positions: int = POSITIONS) -> list[list[Mode]]:
    """Oscillatory modes of each run of a batch, the lowest first.

    The robot rolls at the speed of the steady fidelity, with height and pitch in equilibrium. The derivative J of a
    step h with respect to the state gives dy/dt = (J - 1) y / h and its eigenvalues λ. J is also used for the largest
    stable step. It includes friction, belt, motor and winding.

    Args:
        robot, conditions: a batch of runs.
        positions: positions of the belt, evenly over a pitch of the grousers.
    """
    rates, masses = jax.device_get(_linearised_steps(params.without_weak_types(robot), conditions, positions))
    return [_run_modes(rate, mass) for rate, mass in zip(rates, masses, strict=True)]


@compiled
def _linearised_steps(
    robot: Robot, conditions: Conditions, positions: int
) -> tuple[Float[Array, "runs positions 11 11"], Float[Array, "runs positions 5 5"]]:
    def linearise(conditions: Conditions) -> tuple[Array, Array]:
        run = build_system(robot, conditions, PROBE)
        rolling = roll(run)

        def linearise_at(pulley_angle: Array) -> tuple[Array, Array]:
            motion = eqx.tree_at(lambda m: m.q, rolling, stand(run, pulley_angle).q)
            return (step_derivative(run, motion) - jnp.eye(11)) / PROBE, mass_matrix(run, motion)

        return jax.vmap(linearise_at)(jnp.arange(positions) / positions * run.path.pitch / run.path.radius)

    return jax.vmap(linearise)(conditions)


def _run_modes(rates: Float[np.ndarray, "positions 11 11"], masses: Float[np.ndarray, "positions 5 5"]) -> list[Mode]:
    """The modes of one run, from its linearisation at each position."""
    modes_by_name: dict[str, list[tuple[complex, float]]] = {}
    for rate, mass in zip(rates, masses, strict=True):
        if not np.isfinite(rate).all():
            continue
        values, vectors = np.linalg.eig(rate)
        is_oscillating = (values.imag > 0) & (-values.real < _SWINGS * np.abs(values))
        velocity = vectors[5:10, is_oscillating]
        energy = np.abs(np.real(velocity.conj() * (mass @ velocity)))
        shares = (energy / energy.sum(axis=0)).T
        for k, name in zip(*linear_sum_assignment(-shares), strict=True):
            modes_by_name.setdefault(NAMES[name], []).append((values[is_oscillating][k], shares[k, name]))
    modes_of_run = []
    for name, members in modes_by_name.items():
        value, share = np.array([m[0] for m in members]), np.array([m[1] for m in members])
        frequency = value.imag / (2 * np.pi)
        magnitude = np.abs(value)
        numbers = (frequency.mean(), frequency.min(), frequency.max(), (magnitude / (2 * np.pi)).mean())
        ratios = ((-value.real / magnitude).mean(), share.mean(), len(members) / len(rates))
        modes_of_run.append(Mode(name, *map(float, numbers), *map(float, ratios)))
    return sorted(modes_of_run, key=lambda mode: mode.frequency)
