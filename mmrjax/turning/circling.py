"""Robots with independently driven sides: settled turns, and turning over time, from the same equations.

The fidelities `steady` and `drive` use both for conditions that distinguish the sides (`Conditions.turns`).
"""

from __future__ import annotations

import functools
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mmrjax.compile.compiling import compiled
from mmrjax.effects.base import Effect
from mmrjax.fidelities import rest
from mmrjax.fidelities.base import mask_unknown, power_ratio, result_of_signals, withhold_numbers
from mmrjax.fidelities.rest import SHARE, TIME, voltage_at_rest
from mmrjax.model import balances, contact
from mmrjax.model.chassis import Chassis
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Pair, Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import (
    BATTERY_EMPTY,
    CONVERGED,
    FAILED,
    GRAVITY,
    NOT_SETTLED,
    STALLED,
    TIPS,
    PlaneMotion,
    Result,
    Signals,
    State,
)
from mmrjax.numerics import batch_flow
from mmrjax.numerics.linear_equations import inverse
from mmrjax.numerics.rosenbrock import Unknowns, error_norm_of_sides
from mmrjax.turning.two_sides import SIDES

#: Unknowns of a settled turn.
Settling = Float[Array, " 9"]

# Units of the unknowns: currents, motor speeds, speed, lateral speed, yaw rate; heading, place; discharge.
_UNITS = (10.0, 10.0, 1000.0, 1000.0, 1.0, 1.0, 10.0, 1.0, 1.0, 1.0, 10.0)
#: Unknowns of the whole robot, in order, after the currents and the motor speeds.
_OF_ROBOT = ("speed", "speed_lateral", "yaw_rate", "heading", "place_x", "place_y", "discharge")
#: Unknowns of a robot in straight travel.
OF_STRAIGHT = 5
#: Unknowns that settle on level ground.
SETTLING = 7

#: First search for a settled turn. `ALONG`: step of an unknown for a finite difference. `NEAR`: change that ends the
#: search [units]. `SOON`: largest number of evaluations. `CLOSE`: largest Newton step at the end of the search.
ALONG, NEAR, SOON, CLOSE = 1e-6, 1e-7, 60, 1e-6
#: Second search, by implicit Euler: first, shortest and longest step [s], and factors of a longer and a shorter step.
#: A step is shortened if the rates grew by more than `WORSE`, or an unknown changed by more than `FAR` units. The
#: shortest step is accepted at any rates. It follows the run, along which the rates may grow, for example if friction
#: or the gearbox's power changes direction.
FIRST, SHORTEST, LONGEST, LONGER, SHORTER, WORSE, FAR = 0.05, 1e-4, 1e9, 3.0, 0.25, 1.05, 0.1
#: Number of members searched at a time; few members of a batch need it.
FEW = 32
#: Change that ends the second search, if the rates are small too [1/s] or the step is long [s]; and its most steps.
SMALL, SMALL_RATE, LONG, TURNS = 1e-9, 1e-7, 10.0, 200


def _effects_with_memory(robot: Robot, size: int) -> tuple[Effect, ...]:
    """Effects whose memory is among `size` unknowns: all that have one, or none. In the latter case memories are
    settled.
    """
    return robot.remembering if size > len(_UNITS) else ()


def _units_of_unknowns(memory_effects: tuple[Effect, ...]) -> Array:
    return jnp.asarray((*_UNITS, *(size for e in memory_effects for size in (e.memory_size or 1.0,) * 2)))


def motion_of_unknowns(robot: Robot, y: Unknowns) -> PlaneMotion:
    """Motion of the robot that the unknowns describe."""
    memory_effects = _effects_with_memory(robot, y.shape[0])
    y = y * _units_of_unknowns(memory_effects).astype(y.dtype)
    memory = {e.name: y[len(_UNITS) + 2 * k :][:2] for k, e in enumerate(memory_effects)}
    return PlaneMotion(y[:2], y[2:4], y[4], y[5], y[6], y[7], y[8], y[9], y[10], memory)


_turning = compiled(balances.turning_signals)


@compiled
def turning_rates(robot: Robot, conditions: Conditions, y: Unknowns) -> Unknowns:
    """Rates of change of the unknowns, in their units [1/s]. 0 for a motor with imposed speed."""
    return _rates(robot, conditions, y, _turning(robot, conditions, motion_of_unknowns(robot, y)))


def _rates(robot: Robot, conditions: Conditions, y: Array, travel: balances.Travel) -> Array:
    motion = motion_of_unknowns(robot, y)
    memory_effects = _effects_with_memory(robot, y.shape[0])
    signals = travel.signals
    is_free = conditions.of_sides().motor_speed is None
    cos, sin = jnp.cos(motion.heading), jnp.sin(motion.heading)
    rates = [
        *(is_free * signals.voltage_left / signals.inductance),
        *(is_free * signals.acceleration_wheel * robot.gearbox.ratio),
        travel.acceleration,
        travel.acceleration_lateral,
        travel.acceleration_yaw,
        motion.yaw_rate,
        motion.speed * cos - motion.speed_lateral * sin,
        motion.speed * sin + motion.speed_lateral * cos,
        balances.charge_drawn(robot, conditions, signals.total_current[0]),
    ]
    for effect in memory_effects:
        rates.extend(jax.vmap(lambda s, effect=effect: effect.rate(robot, s))(signals))
    return jnp.stack([jnp.asarray(x, y.dtype) for x in rates]) / _units_of_unknowns(memory_effects).astype(y.dtype)


def turning_start(robot: Robot, conditions: Conditions, rolling: bool = False) -> Unknowns:
    """Unknowns at rest, with the heading of the conditions. With `rolling`, in the settled turn if there is one.

    Motors with an imposed speed turn.
    """
    heading = 0.0 if conditions.heading_deg is None else jnp.radians(conditions.heading_deg)
    units = _units_of_unknowns(robot.remembering)
    side_conditions = conditions.of_sides()
    y = jnp.zeros_like(units).at[7].set(heading).at[10].set(conditions.discharge)
    if side_conditions.motor_speed is not None:
        y = y.at[2:4].set(side_conditions.motor_speed)
    if not rolling:
        return y / units
    unknowns, solved = _find_settled_unknowns(robot, conditions)
    travel, motion = _signals_and_motion(robot, conditions, unknowns)
    signals = travel.signals
    memory = [jax.vmap(lambda s, e=e: e.settled(robot, s))(signals) for e in robot.remembering]
    motion_values = [
        motion.current,
        motion.speed_motor,
        *(jnp.reshape(getattr(motion, name), 1) for name in _OF_ROBOT),
    ]
    rolling_values = jnp.concatenate([*motion_values, *memory]).at[7].set(y[7])
    return jnp.where(solved & jnp.all(jnp.isfinite(rolling_values)), rolling_values, y) / units


# --- circling


def _initial_guess(robot: Robot, conditions: Conditions) -> Float[Array, " 11"]:
    """Motors near their no-load speed, and the turn of a robot with twice the width and no slip."""
    side_conditions = conditions.of_sides()
    chassis = robot.chassis(conditions.configuration)
    motor_speeds = 0.9 * jax.vmap(lambda c: voltage_at_rest(robot, c))(side_conditions) / robot.motor.torque_constant
    if side_conditions.motor_speed is not None:
        motor_speeds = side_conditions.motor_speed
    speeds = chassis.radius * motor_speeds / robot.gearbox.ratio
    yaw_rate = (speeds[1] - speeds[0]) / (2 * chassis.turning.width)
    y = jnp.zeros(len(_UNITS)).at[2:4].set(motor_speeds).at[4].set(jnp.mean(speeds)).at[6].set(yaw_rate)
    return y.at[10].set(conditions.discharge) / jnp.asarray(_UNITS)


class _BroydenSearch(eqx.Module):
    """Search for a settled turn by Broyden's method.

    Attributes:
        y: unknowns that settle, and the loads.
        rates: `_scaled_balance` at y.
        inverse: approximate inverse of minus its Jacobian.
        evaluations: number of evaluations of `_scaled_balance`.
        solved: True once the search has converged.
    """

    y: Settling
    rates: Settling
    inverse: Float[Array, "9 9"]
    evaluations: Scalar
    solved: Array


#: Jacobian of `_scaled_balance` at the end of a search, True if it is a turn, and a stable one, and True once it has
#: been computed.
_LinearisedBalance = tuple[Array, Array, Array]


class _EulerSearch(eqx.Module):
    """Search for a settled turn by following a run until it settles.

    Attributes:
        y: unknowns that settle, and the loads.
        rates: `_scaled_balance` at y.
        jacobian: Jacobian of `_scaled_balance`.
        step: length of the next step [s].
        turns: number of steps.
        solved: True once it has converged.
    """

    y: Settling
    rates: Settling
    jacobian: Float[Array, "9 9"]
    step: Scalar
    turns: Scalar
    solved: Array


def _scaled_balance(robot: Robot, conditions: Conditions, y: Settling) -> Settling:
    """Residuals of a settled turn: rates of the unknowns that settle [1/s], and minus the errors of the loads."""
    return _imbalance_of_sides(robot, conditions, y, _signals_and_motion(robot, conditions, y)[0])


def _imbalance_of_sides(robot: Robot, conditions: Conditions, y: Settling, travel: balances.Travel) -> Settling:
    """`_scaled_balance` from the signals of both sides."""
    load_residual = travel.grip.residual / _load_units(robot, conditions)
    return jnp.concatenate(
        [_rates(robot, conditions, _all_unknowns(conditions, y), travel)[:SETTLING], -load_residual]
    )


def _all_unknowns(conditions: Conditions, y: Settling) -> Float[Array, " 11"]:
    """All unknowns of a robot, with its position at the start."""
    charge = jnp.zeros(len(_UNITS) - SETTLING).at[-1].set(conditions.discharge / _UNITS[-1])
    return jnp.concatenate([y[:SETTLING], charge])


def _speeds_over_width(robot: Robot, conditions: Conditions, y: Settling) -> Float[Array, " 4"]:
    """Speeds of both sides and of their tracks that decide the sign of friction, relative to its smoothing
    width [-].
    """
    chassis = robot.chassis(conditions.configuration)
    _, motor_speeds, ahead, _, yaw = jnp.split(y[:SETTLING] * jnp.asarray(_UNITS[:SETTLING]), [2, 4, 5, 6])
    side_speeds, mover_speeds = (
        ahead - yaw * SIDES * chassis.turning.width,
        motor_speeds * chassis.radius / robot.gearbox.ratio,
    )
    return jnp.concatenate([side_speeds, mover_speeds]) / chassis.speed_still


def _allowed_step_fraction(robot: Robot, conditions: Conditions, y: Array, step: Array) -> Scalar:
    """Fraction of a step that changes no unknown by more than `FAR` and reverses no friction."""
    share = jnp.minimum(1.0, FAR / jnp.max(jnp.abs(step[:SETTLING])))
    speeds_now, speeds_then = (_speeds_over_width(robot, conditions, unknowns) for unknowns in (y, y + share * step))
    reverses = (speeds_now * speeds_then < 0) & (jnp.minimum(jnp.abs(speeds_now), jnp.abs(speeds_then)) > 1)
    return share * jnp.min(jnp.where(reverses, speeds_now / jnp.where(reverses, speeds_now - speeds_then, 1.0), 1.0))


def _load_units(robot: Robot, conditions: Conditions) -> Pair:
    """Units of the transferred load [N] and of the centre of pressure [m]."""
    return jnp.stack([robot.chassis(conditions.configuration).mass * GRAVITY, robot.running_gear.wheelbase])


def _is_searched(conditions: Conditions) -> np.ndarray:
    """True for the unknowns of a search, False for imposed speeds and their currents, shape (9,)."""
    return np.arange(SETTLING + len(SIDES)) >= (0 if conditions.of_sides().motor_speed is None else 4)


def _search_start(robot: Robot, conditions: Conditions) -> Settling:
    """Initial unknowns of a search. Imposed speeds keep these values."""
    return jnp.concatenate([_initial_guess(robot, conditions)[:SETTLING], jnp.zeros(len(SIDES))])


def _begin_broyden(inputs: tuple[Robot, Conditions]) -> _BroydenSearch:
    start = _search_start(*inputs)
    return _BroydenSearch(start, jnp.zeros_like(start), jnp.eye(start.size), jnp.asarray(0), jnp.asarray(False))


def _broyden_step(inputs: tuple[Robot, Conditions], search: _BroydenSearch) -> _BroydenSearch:
    """Next evaluation: at the start, then along each unknown from there, then along the secants."""
    size = search.y.size
    is_probing = search.evaluations <= size
    step = (search.inverse * search.rates).sum(-1)
    damped_step = step * _allowed_step_fraction(*inputs, search.y, step)
    damped_step = jnp.where(is_probing, ALONG * (np.arange(size) == search.evaluations - 1), damped_step)
    residual = _scaled_balance(*inputs, search.y + damped_step)
    residual = jnp.where(_is_searched(inputs[1]), residual, _search_start(*inputs) - search.y - damped_step)
    predicted_step = search.inverse @ (search.rates - residual)
    row = damped_step @ search.inverse
    change = jnp.outer(damped_step - predicted_step, row) / (damped_step @ predicted_step)
    inverse = jnp.where(
        (search.evaluations > 0) & jnp.all(jnp.isfinite(change)), search.inverse + change, search.inverse
    )
    y = jnp.where(is_probing, search.y, search.y + damped_step)
    rates = jnp.where(is_probing & (search.evaluations > 0), search.rates, residual)
    return _BroydenSearch(y, rates, inverse, search.evaluations + 1, ~is_probing & (jnp.max(jnp.abs(step)) < NEAR))


def _jacobian_at_rest(conditions: Conditions) -> Float[np.ndarray, "9 9"]:
    """Jacobian of `_scaled_balance` with nothing in motion."""
    return -np.eye(len(_is_searched(conditions)))


def _jacobian_and_value(robot: Robot, conditions: Conditions, y: Array) -> tuple[Array, Array]:
    """Jacobian of `_scaled_balance`, and its value. Imposed unknowns have no equation."""
    slope, residual = jax.jacfwd(lambda y: (_scaled_balance(robot, conditions, y),) * 2, has_aux=True)(y)
    return jnp.where(_is_searched(conditions)[:, None], slope, _jacobian_at_rest(conditions)), residual


def _no_linearisation(inputs: tuple[Robot, Conditions, Array, Array]) -> _LinearisedBalance:
    return jnp.asarray(_jacobian_at_rest(inputs[1])), jnp.asarray(False), jnp.asarray(False)


def _linearise_balance(inputs: tuple[Robot, Conditions, Array, Array], _: _LinearisedBalance) -> _LinearisedBalance:
    y, solved = inputs[2:]
    slope, residual = _jacobian_and_value(*inputs[:2], y)
    inverted, determinant = inverse(-slope)
    is_close = jnp.max(jnp.abs(inverted @ residual)) < CLOSE
    return slope, solved & is_close & (determinant > 0), jnp.asarray(True)


def _begin_euler(inputs: tuple[Robot, Conditions, Array, _LinearisedBalance]) -> _EulerSearch:
    """State before the first step, which has length 0 and only evaluates."""
    y, (jacobian, is_turn, _) = inputs[2:]
    y = jnp.where(is_turn, y, _search_start(*inputs[:2]))
    slope = jnp.where(is_turn, jacobian, _jacobian_at_rest(inputs[1]))
    return _EulerSearch(y, jnp.zeros_like(y), slope, jnp.asarray(FIRST), jnp.asarray(0), is_turn)


def _euler_step(inputs: tuple[Robot, Conditions, Array, _LinearisedBalance], search: _EulerSearch) -> _EulerSearch:
    """One implicit Euler step along the run. It is rejected if the rates grow or an unknown changes too much."""
    settling_mask = np.diag(np.arange(search.y.size) < SETTLING)
    step = inverse(jnp.asarray(settling_mask) / search.step - search.jacobian)[0] @ search.rates
    largest_change = jnp.max(jnp.abs(step))
    next_y = search.y + step
    slope, residual = _jacobian_and_value(*inputs[:2], next_y)
    norm_before, norm_after = jnp.linalg.norm(search.rates), jnp.linalg.norm(residual)
    is_rejected = (~(norm_after <= WORSE * norm_before + SMALL) | (largest_change > FAR)) & (search.turns > 0)
    is_rejected &= search.step > SHORTEST
    has_settled = ~is_rejected & (largest_change < SMALL) & ((search.step > LONG) | (norm_after < SMALL_RATE))
    y, residual, slope = (
        jnp.where(is_rejected, old, new)
        for old, new in ((search.y, next_y), (search.rates, residual), (search.jacobian, slope))
    )
    length = jnp.clip(search.step * jnp.where(is_rejected, SHORTER, LONGER), SHORTEST, LONGEST)
    return _EulerSearch(y, residual, slope, length, search.turns + 1, has_settled)


def _find_settled_unknowns(robot: Robot, conditions: Conditions) -> tuple[Settling, Bool[Array, ""]]:
    """The unknowns of a settled turn on level ground, see `_EulerSearch`, and True if it was found.

    Broyden's method, which first evaluates along each unknown, finds most. If it does not converge, or converges to
    an unstable turn, implicit Euler with growing steps follows a run until it settles. Only its shortest steps may
    let the rates grow. The last step is Newton's and carries the implicit derivatives.

    Of 128 turns at random duties this finds all, and optimistix's `Newton` from the same start finds 83. In batches
    each member ends on its own (`batch_flow.loop_until`). A search by `optimistix.root_find` lasts as long as its
    slowest member.
    """
    inputs = robot, conditions
    broyden_end = batch_flow.loop_until(
        _begin_broyden, _broyden_step, lambda s: (s.evaluations >= SOON) | s.solved, inputs, lambda s: (s.y, s.solved)
    )
    linearisation = batch_flow.loop_until(
        _no_linearisation, _linearise_balance, lambda s: s[2], (*inputs, *broyden_end)
    )
    euler_end = batch_flow.loop_until(
        _begin_euler,
        _euler_step,
        lambda s: (s.turns >= TURNS) | s.solved,
        (*inputs, broyden_end[0], linearisation),
        lane_count=FEW,
    )
    is_solved = euler_end.solved & jnp.all(jnp.isfinite(euler_end.jacobian))
    slope = jnp.where(is_solved, euler_end.jacobian, jnp.asarray(_jacobian_at_rest(conditions)))
    return euler_end.y + inverse(-slope)[0] @ jnp.where(
        is_solved, _scaled_balance(robot, conditions, euler_end.y), 0.0
    ), is_solved


def _signals_and_motion(robot: Robot, conditions: Conditions, y: Settling) -> tuple[balances.Travel, PlaneMotion]:
    """Signals of both sides, and motion, at the unknowns of a search.

    The duties alone would cause these currents, see `rest.admitted_current`.
    """
    motion = motion_of_unknowns(robot, _all_unknowns(conditions, y))
    current, blocked_voltage = jax.vmap(lambda c, x: rest.admitted_current(robot, c, x))(
        conditions.of_sides(), motion.current
    )
    motion = replace(motion, current=jnp.asarray(current))
    travel = _turning(rest.without_diode(robot), conditions, motion, y[SETTLING:] * _load_units(robot, conditions))
    signals = travel.signals
    signals = replace(
        signals, voltage=signals.voltage - blocked_voltage, voltage_left=signals.voltage_left - blocked_voltage
    )
    return replace(travel, signals=signals), motion


def solve_turn(robot: Robot, conditions: Conditions) -> tuple[Settling, Bool[Array, ""]]:
    """Unknowns of a settled turn, and True if it was found, see `ImplicitSolution.solve`."""
    return jax.lax.stop_gradient(_find_settled_unknowns(*jax.lax.stop_gradient((robot, conditions))))


def turn_results(
    robot: Robot, conditions: Conditions, unknowns: Settling, solved: Bool[Array, ""]
) -> tuple[Result, Signals, Settling]:
    """Result, signals of both sides and residuals at given unknowns, see `ImplicitSolution.results_at`."""
    travel, motion = _signals_and_motion(robot, conditions, unknowns)
    deviation_from_start = unknowns - jax.lax.stop_gradient(_search_start(robot, conditions))
    imbalance = jnp.where(
        _is_searched(conditions), _imbalance_of_sides(robot, conditions, unknowns, travel), deviation_from_start
    )
    status = _turn_status(robot, conditions, travel, motion, solved)
    return result_of_turn(robot, travel, status), travel.signals, imbalance


def circling_signals(robot: Robot, conditions: Conditions) -> tuple[balances.Travel, PlaneMotion, Array]:
    """Signals of a settled turn on level ground, motion, and status. All numbers are finite for every status.

    Args:
        conditions: conditions of one run, scalar fields, on level ground.

    Returns:
        Signals of both sides, motion of the robot, and one of these statuses. `converged`. `stalled`: neither shafts
        nor robot move faster than the resolution of static friction. `tips`: no load is left on a side or at an end.
        `battery_empty`. `not_settled`: no settled turn was found. Possibly none exists, because friction falls with
        sliding.
    """
    unknowns, solved = _find_settled_unknowns(robot, conditions)
    travel, motion = _signals_and_motion(robot, conditions, unknowns)
    return travel, motion, _turn_status(robot, conditions, travel, motion, solved)


def _turn_status(
    robot: Robot, conditions: Conditions, travel: balances.Travel, motion: PlaneMotion, solved: Array
) -> Array:
    """Status of a settled turn, or `not_settled` if none was found."""
    status = status_of_steady_motion(robot, conditions, travel, motion)
    return jnp.where(solved | (status == BATTERY_EMPTY), status, NOT_SETTLED)


def _motion_size(chassis: Chassis, ahead: Scalar, aside: Scalar, yaw: Scalar) -> Array:
    """Magnitude of a motion in the plane, or of its rate of change, at the sides [m/s], [m/s²]."""
    return jnp.abs(ahead) + jnp.abs(aside) + jnp.abs(yaw) * chassis.turning.width / 2


def status_of_steady_motion(
    robot: Robot, conditions: Conditions, travel: balances.Travel, motion: PlaneMotion
) -> Array:
    """Status of a robot in steady motion."""
    chassis = robot.chassis(conditions.configuration)
    shaft_speed = jnp.max(jnp.abs(travel.signals.speed_theoretical))
    motion_size = _motion_size(chassis, motion.speed, motion.speed_lateral, motion.yaw_rate)
    status = jnp.where(jnp.minimum(shaft_speed, motion_size) < chassis.speed_still, STALLED, CONVERGED)
    grip, load = travel.grip, jnp.sum(travel.grip.normal)
    is_tipping = (jnp.abs(grip.load_transfer) >= load / 2) | (
        jnp.abs(grip.centre) >= robot.running_gear.wheelbase / 2
    )
    status = jnp.where(is_tipping, TIPS, status)
    return jnp.where(robot.battery.emptied(conditions.battery, motion.discharge), BATTERY_EMPTY, status)


def status_after_run(robot: Robot, conditions: Conditions, travel: balances.Travel, motion: PlaneMotion) -> Array:
    """Status at the end of a run over time: `not_settled` if the motion still changes, otherwise that of
    `status_of_steady_motion`.
    """
    chassis = robot.chassis(conditions.configuration)
    motion_size = _motion_size(chassis, motion.speed, motion.speed_lateral, motion.yaw_rate)
    acceleration_size = _motion_size(
        chassis, travel.acceleration, travel.acceleration_lateral, travel.acceleration_yaw
    )
    status = status_of_steady_motion(robot, conditions, travel, motion)
    return jnp.where((acceleration_size * TIME > SHARE * motion_size) & (status == CONVERGED), NOT_SETTLED, status)


def changing_at_rest(y: Unknowns) -> Unknowns:
    """1 for the unknowns that change while friction holds the robot (currents and charge), otherwise 0."""
    return jnp.zeros_like(y).at[jnp.asarray([0, 1, 10])].set(1.0)


norm = functools.partial(error_norm_of_sides, of_robot=slice(4, len(_UNITS)), count=OF_STRAIGHT)


def _sides_at_rest(robot: Robot, conditions: Conditions, motion: PlaneMotion) -> tuple[Conditions, State]:
    """Conditions of each side, with the slope along its heading, and its state."""
    side_conditions = conditions.of_sides()
    slope_along = jnp.degrees(jnp.arcsin(jnp.sin(side_conditions.slope) * jnp.cos(motion.heading)))
    return (
        replace(side_conditions, slope_deg=slope_along, heading_deg=None),
        balances.states_of_sides(robot, conditions, motion),
    )


def current_at_rest(robot: Robot, conditions: Conditions, motion: PlaneMotion) -> Pair:
    """Currents that settle in a standing robot [A]."""
    side_conditions, state = _sides_at_rest(robot, conditions, motion)
    return jnp.asarray(jax.vmap(lambda c, s: rest.current_at_rest(robot, c, s))(side_conditions, state))


def holding_margin(robot: Robot, conditions: Conditions, motion: PlaneMotion) -> Array:
    """Margin of the friction that holds the robot at rest at its heading, negative if it cannot hold it [-].

    The friction of each side has to hold its motor and its share of gravity. The ground has to hold all of gravity.
    """
    side_conditions, state = _sides_at_rest(robot, conditions, motion)
    side_margins = jax.vmap(lambda c, s: rest.holding_margin(robot, c, s))(side_conditions, state)
    chassis = robot.chassis(conditions.configuration)
    lateral_grip = (
        chassis.ground.friction.static * conditions.adhesion * balances.lateral_friction(conditions, chassis)
    )
    lateral_slope = jnp.abs(jnp.tan(conditions.slope) * jnp.sin(motion.heading))
    return rest.smallest_of(
        side_margins[0], side_margins[1], jnp.where(lateral_slope > 0, lateral_grip - lateral_slope, jnp.inf)
    )


def holds(robot: Robot, conditions: Conditions) -> Array:
    """True if friction holds a standing robot at the currents one millisecond after the start."""
    motion = motion_of_unknowns(robot, turning_start(robot, conditions))
    settled = replace(motion, current=current_at_rest(robot, conditions, motion))
    return jax.lax.stop_gradient(holding_margin(robot, conditions, settled)) >= 0


def result_of_turn(robot: Robot, travel: balances.Travel, status: Array) -> Result:
    """Result at one instant of a turn: readings, powers and warnings. Each is a mean of both sides or the
    worse side's value.
    """
    signals = travel.signals
    side_results = jax.vmap(lambda s: result_of_signals(robot, s, status))(signals)
    mean = jax.tree.map(lambda x: jnp.mean(x, axis=0), side_results)
    flags = side_results.flags[0] | side_results.flags[1]
    limit = robot.sides / 2 * signals.adhesion_limit
    result = replace(
        mean,
        reading=balances.readings_of_sides(robot, signals),
        slip=contact.slip_ratio(mean.speed, mean.theoretical_speed),
        adhesion_used=jnp.max(jnp.hypot(travel.grip.ahead, travel.grip.aside) / limit),
        efficiency_motor=power_ratio(mean.power_motor, mean.power_supply),
        efficiency_gear=power_ratio(mean.power_gear, mean.power_motor),
        efficiency_chassis=power_ratio(mean.power_ground, mean.power_gear),
        winding_settled=jnp.max(side_results.winding_settled),
        status=status,
        flags=flags,
    )
    return mask_unknown(robot, result)


def operating_point(robot: Robot, conditions: Conditions) -> tuple[Result, Array]:
    """A settled turn, see `circling_signals`, and True if its conditions are valid. All numbers are finite for every
    status.
    """
    is_valid = jnp.asarray(True)
    for number in jax.tree.leaves(conditions):
        is_valid &= jnp.isfinite(number)
    conditions = jax.tree.map(lambda x: jnp.where(is_valid, x, jnp.ones_like(x)), conditions)
    travel, _, status = circling_signals(robot, conditions)
    # On a slope the heading changes continuously.
    status = jnp.where(conditions.slope_deg == 0, status, NOT_SETTLED)
    return result_of_turn(robot, travel, jnp.where(is_valid, status, FAILED)), is_valid


def steady(robot: Robot, conditions: Conditions) -> Result:
    """Result of `steady` for a robot that turns, see `circling_signals`. NaN if there is no settled turn."""
    point, is_valid = operating_point(robot, conditions)
    return withhold_numbers(point, (point.status == CONVERGED) | (point.status == STALLED), is_valid)
