"""Fidelity `steady`: the operating point as a root of the balances, with implicit derivatives."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mmrjax import balances, outputs
from mmrjax.conditions import Conditions
from mmrjax.fidelities.base import Fidelity, Progress, Run
from mmrjax.fidelities.newton import root
from mmrjax.fidelities.result import result, withhold
from mmrjax.robot import Robot
from mmrjax.signals import BATTERY_EMPTY, CONVERGED, FAILED, SLIDES, STALLED, Result, Signals, State

# Units of the unknowns and of the torque residual, so that all are of the order of one.
_CURRENT, _SPEED_MOTOR, _SPEED, _VOLTAGE, _TORQUE = 10.0, 1000.0, 1.0, 10.0, 100.0


def _state(unknowns: Float[Array, " 3"], discharge: Float[Array, ""]) -> State:
    return State(_CURRENT * unknowns[0], _SPEED_MOTOR * unknowns[1], _SPEED * unknowns[2], discharge)


_balanced = eqx.filter_jit(balances.settled)


@eqx.filter_jit
def _residual(unknowns: Float[Array, " 3"], run: tuple[Robot, Conditions]) -> Float[Array, " 3"]:
    robot, conditions = run
    signals, creep = _balanced(robot, conditions, _state(unknowns, conditions.discharge))
    # Moving with balanced torques, or at rest with too little torque: speed >= 0, torque <= 0, one of them 0.
    torque = jnp.minimum(unknowns[1], -signals.torque_net / _TORQUE)
    return jnp.stack([signals.voltage_left / _VOLTAGE, torque, signals.speed_sliding - creep])


def _sound(robot: Robot, conditions: Conditions) -> tuple[Array, Conditions]:
    """Whether a run's conditions are finite and its mass positive; where not, all ones in their place.

    A NaN that entered the residual would reach the derivatives of the whole batch, as 0 * NaN.
    """
    stated = conditions.total_mass
    mass = robot.chassis(conditions.configuration).mass + conditions.payload if stated is None else stated
    sound = jnp.all(jnp.isfinite(jnp.stack([jnp.asarray(x, float) for x in jax.tree.leaves(conditions)]))) & (
        mass > 0
    )
    conditions = jax.tree.map(lambda x: jnp.where(sound, x, jnp.ones_like(x)), conditions)
    # No adhesion at all: the robot slides, but a share of nothing has no value.
    return sound, dataclasses.replace(conditions, adhesion=jnp.maximum(conditions.adhesion, 1e-9))


def _start(robot: Robot, conditions: Conditions) -> Float[Array, " 3"]:
    battery = robot.battery.voltage(0.0, conditions.discharge)
    nominal = jnp.where(conditions.battery > 0.5, battery, conditions.voltage)
    speed = 0.9 * nominal / robot.motor.torque_constant
    return jnp.stack(
        [
            0.1 * nominal / robot.motor.resistance / _CURRENT,
            speed / _SPEED_MOTOR,
            robot.chassis(conditions.configuration).radius * speed / robot.gearbox.ratio / _SPEED,
        ]
    )


def _root(robot: Robot, conditions: Conditions) -> tuple[State, Array]:
    """The state at which the balances close, and whether the search got there; derivatives are implicit."""
    tolerance = float(jnp.finfo(jnp.result_type(conditions.voltage)).eps) ** 0.85
    run = (robot, conditions)
    unknowns, solved = root(_residual, jax.lax.stop_gradient(_start(robot, conditions)), run, tolerance)
    return _state(unknowns, conditions.discharge), solved


def operating_signals(robot: Robot, conditions: Conditions) -> Signals:
    """Every signal of one run at its operating point, with numbers whatever the status (see `operating_point`)."""
    _, conditions = _sound(robot, conditions)
    return _balanced(robot, conditions, _root(robot, conditions)[0])[0]


def steady(robot: Robot, conditions: Conditions) -> Result:
    """Steady forward travel of one run: a root in motor current, motor speed and robot speed.

    Derivatives are implicit (forward and reverse). Vmapped by `steady_batch`.

    Args:
        robot: any robot; its parameters may be tracers.
        conditions: one run, scalar fields.

    Returns:
        Scalars. `status` is `converged`; `stalled` (shafts or robot slower than a tenth of V_s, where
        friction at rest is not resolved: too little torque; where it cannot turn the shafts, stall current,
        shaft speed 0, and the robot creeps back at the sliding speed of the static friction law; what
        gravity would drive back is held); `slides`
        (the demand is above the adhesion limit), `battery_empty` or `failed`, all three with NaN in
        every number but `mass` and `adhesion_used` (NaN too where the conditions are no numbers, or
        the mass not positive). A member that has no numbers has zero derivatives and harms no
        other.
    """
    point, sound = operating_point(robot, conditions)
    return withhold(point, (point.status == CONVERGED) | (point.status == STALLED), sound)


@eqx.filter_jit
def operating_point(robot: Robot, conditions: Conditions) -> tuple[Result, Array]:
    """`steady` with the numbers left in whatever the status, for a fit that has to find its way back.

    Where the robot `slides` they are those of the balances with the contact held at V_s: current and motor
    speed as if the ground held, the robot V_s slower than r_k ω_k, and no derivative of the speed in μ_s.

    Returns:
        The result, and whether robot and conditions are sound (see `_sound`).
    """
    sound, conditions = _sound(robot, conditions)
    state, solved = _root(robot, conditions)
    signals, _ = _balanced(robot, conditions, state)
    solved = solved & jnp.isfinite(signals.voltage_left + signals.torque_net)
    rest = robot.chassis(conditions.configuration).ground.friction.speed_rest
    stands = jnp.minimum(signals.speed_theoretical, signals.speed) < rest
    # Ordered by what a person would say first.
    status = jnp.where(stands, STALLED, CONVERGED)
    status = jnp.where(jnp.abs(signals.demand) > signals.adhesion_limit, SLIDES, status)
    status = jnp.where(solved, status, FAILED)
    empty = (conditions.battery > 0.5) & robot.battery.empty(conditions.discharge)
    status = jnp.where(empty, BATTERY_EMPTY, status)
    status = jnp.where(sound, status, FAILED)
    return result(robot, signals, status), sound


@eqx.filter_jit
def steady_batch(robot: Robot, conditions: Conditions) -> Result:
    """`steady` over a batch of conditions (leading axis of every field) for one robot, compiled."""
    return jax.vmap(steady, in_axes=(None, 0))(robot, conditions)


@eqx.filter_jit
def steady_outputs(robot: Robot, conditions: Conditions, names: tuple[str, ...]) -> dict[str, Array]:
    """Chosen outputs of `steady` over points of which each may have its own robot, compiled.

    Args:
        robot: leaves are scalars, or arrays of shape (points,).
        conditions: shape (points,).
        names: of `outputs.table()`, `status` and `flags`.

    Returns:
        By name in SI units, shape (points,).
    """
    axes = jax.tree.map(lambda x: 0 if eqx.is_array(x) and x.ndim else None, robot)
    found = jax.vmap(steady, in_axes=(axes, 0))(robot, conditions)
    rows = {row.name: row for row in outputs.table()}
    return {name: rows[name].get(found) if name in rows else getattr(found, name) for name in names}


def _settled(robot: Robot, conditions: Conditions) -> Result:
    return jax.vmap(lambda c: operating_point(robot, c)[0])(conditions)


def _run(robot: Robot, conditions: Conditions, options: Mapping[str, float], progress: Progress | None = None) -> Run:
    return Run(steady_batch(robot, conditions))


FIDELITY = Fidelity("steady", settled=_settled, run=_run)
