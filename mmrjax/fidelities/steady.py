"""Fidelity `steady`: the operating point as a solution of the balances, with implicit derivatives."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mmrjax.compile.compiling import SELDOM, compiled
from mmrjax.fidelities import outputs, rest
from mmrjax.fidelities.base import (
    Fidelity,
    ImplicitSolution,
    Progress,
    RunBatch,
    result_of_signals,
    travel_status,
    withhold_numbers,
)
from mmrjax.model import balances, channels, contact, params
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import (
    BATTERY_EMPTY,
    CODES,
    CONVERGED,
    FAILED,
    REVERSES,
    ROLLS_BACK,
    SLIDES,
    STALLED,
    Result,
    Signals,
    State,
)
from mmrjax.numerics.batch_flow import compute_if_needed
from mmrjax.numerics.elementary import clip
from mmrjax.numerics.linear_equations import Vector
from mmrjax.numerics.newton import root, root_alone
from mmrjax.numerics.rosenbrock import Unknowns
from mmrjax.turning import circling

# Units of the unknowns and of the torque residual, which scale them to the order of one.
_SPEED, _CURRENT, _SPEED_MOTOR, _VOLTAGE, _TORQUE = 1.0, 10.0, 1000.0, 10.0, 100.0


_balanced = compiled(balances.settled_signals)


def _signals_and_residuals(
    robot: Robot, conditions: Conditions, unknowns: Vector, sense: Array
) -> tuple[State, Signals, Vector]:
    """State and signals at given unknowns, and the residuals of the balances, all 0 at the operating point.

    The unknowns are speed, current and motor speed, in the order of elimination of the balances. For any robot the
    slip determines the speed and the voltage the current. The torque then gives the motor speed. The current is as
    the duty alone would drive it, see `Driver.admitted`. If a clamp holds the output, the third unknown is the torque
    that the clamp carries, in place of the motor speed.
    """
    speed, scaled_current, third = unknowns
    conditions, speed_motor = _clamped_conditions(conditions, third)
    current, blocked_voltage = rest.admitted_current(robot, conditions, _CURRENT * scaled_current)
    state = State(current, _SPEED_MOTOR * speed_motor, _SPEED * speed, conditions.discharge)
    signals, creep_speed = _balanced(rest.without_diode(robot), conditions, state, sense)
    # Moving with balanced torques, or at rest with too little torque: speed >= 0 and torque <= 0 in the direction of
    # travel, and one of them is 0.
    torque_deficit = -sense * signals.torque_net / _TORQUE
    scaled_motion = sense * third
    torque_error = sense * jnp.where(scaled_motion < torque_deficit, scaled_motion, torque_deficit)
    slip_error, voltage_error = (
        signals.speed_sliding - creep_speed,
        (signals.voltage_left - blocked_voltage) / _VOLTAGE,
    )
    if conditions.motor_speed is not None:  # the torque determines the current; the motor speed is given
        speed_error = speed_motor - conditions.motor_speed / _SPEED_MOTOR
        return (
            state,
            signals,
            (slip_error, (signals.torque_net / _TORQUE), speed_error),
        )
    if not robot.driver.returns_current:  # a diode takes the rest of the voltage
        settled_voltage = signals.voltage_back + signals.voltage_drop
        signals = replace(signals, voltage=settled_voltage, voltage_left=jnp.zeros_like(settled_voltage))
    return state, signals, (slip_error, voltage_error, torque_error)


def _clamped_conditions(conditions: Conditions, third: Scalar) -> tuple[Conditions, Scalar]:
    """Conditions with the clamp's torque as the load, and the motor speed in the unit of its unknown."""
    if conditions.held is None:
        return conditions, third
    is_clamped = rest.output_is_held(conditions)
    load = 0.0 if conditions.load_torque is None else conditions.load_torque
    clamped = replace(conditions, load_torque=jnp.where(is_clamped, _TORQUE * third, load))
    return clamped, jnp.where(is_clamped, 0.0, third)


@compiled
def _residuals(unknowns: Vector, robot: Robot, run_inputs: tuple[Conditions, Array]) -> Vector:
    conditions, sense = run_inputs
    robot = robot.within(conditions.configuration)
    return _signals_and_residuals(robot, _sound_conditions(robot, conditions)[1], unknowns, sense)[2]


def _residuals_without_limit(unknowns: Vector, robot: Robot, run_inputs: tuple[Conditions, Array]) -> Vector:
    """`_residuals` in most runs: linear, without the driver's limit and diode."""
    return _residuals(unknowns, replace(robot, driver=robot.driver.unlimited()), run_inputs)


def _sound_conditions(robot: Robot, conditions: Conditions) -> tuple[Array, Conditions]:
    """True if a run's conditions are finite and its mass is positive, and the conditions, set to 1 if not.

    A NaN in the residual would reach the derivatives of the whole batch, as 0 * NaN.
    """
    total_mass = conditions.total_mass
    mass = robot.chassis(conditions.configuration).mass + conditions.payload if total_mass is None else total_mass
    sound = jnp.asarray("mass" in robot.lacks) | (jnp.asarray(mass) > 0)
    for number in jax.tree.leaves(conditions):
        sound &= jnp.isfinite(number)
    conditions = jax.tree.map(lambda x: jnp.where(sound, x, jnp.ones_like(x)), conditions)
    # Without adhesion the robot slides, and the share of adhesion used has no value.
    return sound, replace(conditions, adhesion=jnp.maximum(conditions.adhesion, 1e-9))


def _initial_guess(robot: Robot, conditions: Conditions) -> Vector:
    voltage = rest.voltage_at_rest(robot, conditions)
    speed = voltage * (0.9 / robot.motor.torque_constant)
    if conditions.motor_speed is not None:
        speed = conditions.motor_speed
    current = voltage * (0.05 / robot.motor.resistance)
    if not conditions.voltage_follows:  # below the limit, from which Newton's method reaches each part of the curve
        current = clip(current, -0.5 * robot.driver.current_limit, 0.5 * robot.driver.current_limit)
    return (
        robot.chassis(conditions.configuration).radius * speed * (1 / robot.gearbox.ratio / _SPEED),
        current / _CURRENT,
        speed / _SPEED_MOTOR,
    )


def _search_arguments(robot: Robot, conditions: Conditions) -> tuple[Callable, Vector, Robot, Any, float]:
    """Residuals, first guess, robot, inputs of the run and tolerance: the arguments of `newton.root`."""
    tolerance = float(jnp.finfo(jnp.result_type(conditions.voltage)).eps) ** 0.85
    sound = _sound_conditions(robot, conditions)[1]
    start = jax.lax.stop_gradient(_initial_guess(robot, sound))
    return _residuals, start, robot, (conditions, rest.travel_direction(robot, sound)), tolerance


def _solve_balances(robot: Robot, conditions: Conditions) -> tuple[Vector, Array]:
    """The root of the balances, and True if the search converged. Derivatives are implicit."""
    return root(*_search_arguments(robot, conditions), None if robot.effects else _residuals_without_limit)


@compiled
def _turning_signals(robot: Robot, conditions: Conditions) -> Signals:
    return circling.circling_signals(robot, conditions)[0].signals


def operating_signals(robot: Robot, conditions: Conditions) -> Signals:
    """Every signal of one run at its operating point, with numbers at any status (see `operating_point`).

    For a robot that turns, those of each side, on an axis of 2.
    """
    if conditions.turns:
        return _turning_signals(robot, conditions)
    unknowns, _ = _solve_balances(robot, conditions)
    _, sound_conditions = _sound_conditions(robot, conditions)
    return _signals_and_residuals(robot, sound_conditions, unknowns, rest.travel_direction(robot, sound_conditions))[
        1
    ]


def steady(robot: Robot, conditions: Conditions) -> Result:
    """Steady travel of one run, forward or backward: a root in motor current, motor speed and robot speed.

    Derivatives are implicit (forward and reverse). Vmapped by `steady_batch`.

    Args:
        robot: any robot. Its parameters may be tracers.
        conditions: one run, scalar fields.

    Returns:
        Scalars. The status is one of these. `converged`. `reverses`: steady travel backward due to a negative
        voltage. `rolls_back`: gravity drives the robot against its motors, or backward without voltage. `stalled`:
        shafts or robot are slower than a tenth of V_s, where static friction is not resolved, and neither motors nor
        gravity can turn the shafts. The current is that of stall, the shaft speed 0, and the robot creeps at the
        sliding speed of the friction law. `slides`: the demand is above the adhesion limit. `battery_empty`.
        `failed`. The last three have NaN in every number but `mass` and `adhesion_used`, which are NaN too if the
        conditions are not finite or the mass is not positive. A member without numbers has zero derivatives and does
        not affect the others.
    """
    if conditions.turns:
        return circling.steady(robot, conditions)
    point, sound = operating_point(robot, conditions)
    # Friction at rest holds a standing robot; the contact law alone would give it a creep.
    has_crept = jnp.abs(point.speed) >= robot.chassis(conditions.configuration).speed_still
    parked = (point.status == STALLED) & ((jnp.abs(point.theoretical_speed) < 1e-9) | has_crept)
    speed = jnp.where(parked, 0.0, point.speed)
    reading = {**point.reading, "speed": speed}
    # The ground of a standing robot does not carry more than its limit either, although the shafts creep.
    exceeds_adhesion = parked & (point.adhesion_used > 1)
    point = replace(
        point,
        reading=reading,
        slip=jnp.where(parked, contact.slip_ratio(speed, point.theoretical_speed), point.slip),
        adhesion_used=jnp.where(exceeds_adhesion, 1.0, point.adhesion_used),
        traction=point.traction / jnp.where(exceeds_adhesion, point.adhesion_used, 1.0),
        power_ground=jnp.where(parked, 0.0, point.power_ground),
        power_lift=jnp.where(parked, 0.0, point.power_lift),
    )
    settles = (point.status == CONVERGED) | (point.status == STALLED)
    travels_backward = (point.status == REVERSES) | (point.status == ROLLS_BACK)
    return withhold_numbers(point, settles | travels_backward, sound)


@compiled
def operating_point(robot: Robot, conditions: Conditions) -> tuple[Result, Array]:
    """Same as `steady`, but with finite numbers at any status, so that a fit can return from there.

    If the robot `slides`, the numbers follow from the balances with the contact at the sliding speed V_s. Current and
    motor speed are those without sliding, the robot is V_s slower than r_k ω_k, and its speed has no derivative with
    respect to μ_s.

    Returns:
        The result, and True if robot and conditions are sound (see `_sound_conditions`).
    """
    if conditions.turns:
        return circling.operating_point(robot, conditions)
    signals, status, sound = operating_state(robot, conditions)
    return result_of_signals(robot.within(conditions.configuration), signals, status), sound


def _slides_in_place(robot: Robot, conditions: Conditions) -> Array:
    robot = robot.within(conditions.configuration)
    return rest.slides_in_place(robot, _sound_conditions(robot, conditions)[1])


def operating_state(robot: Robot, conditions: Conditions) -> tuple[Signals, Array, Array]:
    """Every signal of `operating_point`, its status, and True if robot and conditions are sound."""
    unknowns, solved = _solve_balances(robot, conditions)
    return _state_at_unknowns(robot, conditions, unknowns, solved)[:3]


def _state_at_unknowns(
    robot: Robot,
    conditions: Conditions,
    unknowns: Vector,
    solved: Array,
    tests_sliding: bool = True,
    static_at_rest: bool = True,
) -> tuple[Signals, Array, Array, Vector]:
    """`operating_state` at given unknowns, and the residuals of the balances there.

    Args:
        tests_sliding: True to distinguish sliding from standing beyond the limit of adhesion. False: it `slides`.
        static_at_rest: True for static equilibrium in the signals of a robot at rest. False: signals of the search.
    """
    constant_inputs = jax.lax.stop_gradient((robot, conditions))  # nothing is stored for a loop that rarely runs
    robot = robot.within(conditions.configuration)
    sound, conditions = _sound_conditions(robot, conditions)
    sense = rest.travel_direction(robot, conditions)
    state, signals, residual = _signals_and_residuals(robot, conditions, unknowns, sense)
    speed_still = robot.chassis(conditions.configuration).speed_still
    voltage = rest.voltage_at_rest(robot, conditions)
    at_rest = rest.is_at_rest(sense, voltage, signals.speed_theoretical, signals.speed, speed_still)
    at_rest |= sense * signals.speed_theoretical <= 1e-9
    # In the order in which they matter to a reader.
    status = jnp.where(at_rest, STALLED, travel_status(signals.speed, voltage))
    if robot.has_ground:
        exceeds_adhesion = jnp.abs(signals.demand) > signals.adhesion_limit
        is_sliding = (
            compute_if_needed(exceeds_adhesion, _slides_in_place, constant_inputs, jnp.zeros_like(exceeds_adhesion))
            if tests_sliding
            else exceeds_adhesion
        )
        status = jnp.where(exceeds_adhesion, jnp.where(is_sliding, SLIDES, STALLED), status)
    if static_at_rest and conditions.motor_speed is None:
        stands_still = (status == STALLED) & (jnp.abs(signals.speed_theoretical) < 1e-9)
        stands_still &= ~rest.output_is_held(conditions) | (
            sense * unknowns[2] <= 1e-9
        )  # friction leaves the clamp nothing
        static = rest.standing_signals(robot, _clamped_conditions(conditions, 0.0)[0], state)
        signals = jax.tree.map(lambda standing, moving: jnp.where(stands_still, standing, moving), static, signals)
    status = jnp.where(rest.output_is_held(conditions), CONVERGED, status)
    status = jnp.where(solved, status, FAILED)
    status = jnp.where(robot.battery.emptied(conditions.battery, conditions.discharge), BATTERY_EMPTY, status)
    status = jnp.where(sound, status, FAILED)
    return signals, status, sound, residual


#: Most points that a CPU computes at once; the intermediate values of a block then fit in its cache.
BLOCK = 32_768


def _map_over_points(function: Callable[..., Any], *arguments: Any) -> Any:
    """`function` of scalars, mapped over the leading axis of all arrays that have one. On a CPU block by block."""
    batched = jax.vmap(function, in_axes=jax.tree.map(lambda x: 0 if jnp.ndim(x) else None, arguments))
    leaves, tree = jax.tree.flatten(arguments)
    points = max((len(x) for x in leaves if jnp.ndim(x)), default=0)
    # Blocks of equal size share a program; a number of points without a suitable divisor is computed at once.
    block = next((size for size in range(BLOCK, BLOCK // 8, -1) if points % size == 0), points)
    if points <= BLOCK or block == points or jax.default_backend() != "cpu":
        return batched(*arguments)

    def map_block(rows: list[Array | None]) -> Any:
        block_leaves = [x if row is None else row for x, row in zip(leaves, rows, strict=True)]
        return batched(*jax.tree.unflatten(tree, block_leaves))

    # Reverse mode computes a block again: the stored values of all blocks would fill the memory.
    blocks = jax.lax.map(
        jax.checkpoint(map_block), [jnp.reshape(x, (-1, block)) if jnp.ndim(x) else None for x in leaves]
    )
    return jax.tree.map(lambda x: jnp.reshape(x, points), blocks)


@compiled
def steady_batch(robot: Robot, conditions: Conditions) -> Result:
    """`steady` over a batch, compiled.

    Args:
        robot: one robot, or parameters of shape (points,) among its numbers.
        conditions: leading axis of every field.
    """
    return _map_over_points(steady, robot, conditions)


@compiled
def steady_outputs(robot: Robot, conditions: Conditions, names: tuple[str, ...]) -> dict[str, Array]:
    """`steady` over a batch, limited to the named outputs.

    Args:
        robot: one robot, or parameters of shape (points,) among its numbers.
        conditions: shape (points,).
        names: names of `outputs.output_table`, `status` (code into `STATUSES`) and `flags` (bit mask over `FLAGS`).

    Returns:
        Arrays of shape (points,) by name [SI], NaN if a point has no such number, see `steady`.

    Raises:
        KeyError: an unknown name. The message lists the valid ones.
    """
    allowed = (*outputs.output_names(channels.EVERY), *CODES)
    if unknown := [name for name in names if name not in allowed]:
        raise KeyError(f"no output {unknown[0]}; there are {', '.join(allowed)}")

    def outputs_of_point(robot: Robot, conditions: Conditions) -> dict[str, Array]:
        result = steady(robot, conditions)
        return {name: jnp.asarray(getattr(result, name)) for name in names}

    return _map_over_points(outputs_of_point, robot, conditions)


def _settled_results(robot: Robot, conditions: Conditions) -> Result:
    return jax.vmap(lambda c: operating_point(robot, c)[0])(conditions)


def _solve_run(robot: Robot, conditions: Conditions) -> tuple[Unknowns, Bool[Array, ""]]:
    if conditions.turns:
        return circling.solve_turn(robot, conditions)
    unknowns, is_root = root_alone(*_search_arguments(robot, conditions))
    return jnp.stack(unknowns), is_root


def _results_at_unknowns(
    robot: Robot, conditions: Conditions, unknowns: Unknowns, solved: Bool[Array, ""], static_at_rest: bool = True
) -> tuple[Result, Signals, Unknowns]:
    if conditions.turns:
        return circling.turn_results(robot, conditions, unknowns, solved)
    signals, status, _, residual = _state_at_unknowns(
        robot, conditions, tuple(unknowns), solved, False, static_at_rest
    )
    return result_of_signals(robot.within(conditions.configuration), signals, status), signals, jnp.stack(residual)


#: `operating_point` in two halves.
IMPLICIT = ImplicitSolution(_solve_run, _results_at_unknowns)


#: Numbers of rows that tables are padded to, so that tables of similar size share a program; beyond the last number,
#: a multiple of it.
SIZES = (16, 24, 32, 48, 64, 96, 128, 192, 256)


def results_of_rows(robot: Robot, conditions: Conditions, static_at_rest: bool = True) -> tuple[Result, Signals]:
    """Results and signals of the rows of a table, with each half as a separate program.

    Args:
        static_at_rest: True for static equilibrium in the signals of rows at rest. False: a smaller program.
    """
    robot = params.without_weak_types(robot)
    rows = conditions.shape[0]
    parts = []
    # Straight travel is computed quickly, so that every table can share one program.
    size = next((s for s in SIZES if s >= rows and conditions.turns), SIZES[-1])
    for part in np.arange(rows + -rows % size).reshape(-1, size):
        index = np.where(part < rows, part, 0)
        padded = jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[index]), conditions)  # noqa: B023
        parts.append(_results_of_solved_rows(robot, padded, *_solved_rows(robot, padded), static_at_rest))
    return jax.tree.map(lambda *x: jnp.asarray(np.concatenate(x)[:rows]), *parts)


@functools.partial(compiled, options=SELDOM)
def _solved_rows(robot: Robot, conditions: Conditions) -> tuple[Float[Array, "rows unknowns"], Bool[Array, " rows"]]:
    return jax.vmap(lambda c: IMPLICIT.solve(robot, c))(conditions)


@functools.partial(compiled, options=SELDOM)
def _results_of_solved_rows(
    robot: Robot, conditions: Conditions, unknowns: Array, solved: Array, static_at_rest: bool
) -> tuple[Result, Signals]:
    results_at = functools.partial(_results_at_unknowns, robot, static_at_rest=static_at_rest)
    return jax.vmap(lambda *row: results_at(*row)[:2])(conditions, unknowns, solved)


def _run_batch(
    robot: Robot, conditions: Conditions, options: Mapping[str, float], progress: Progress | None = None
) -> RunBatch:
    return RunBatch(steady_batch(robot, conditions))


def _check_run(robot: Robot, conditions: Conditions, options: Mapping[str, float]) -> None:
    """Raises for runs without a steady state: an arm with gravity over its angle, or a turn on a slope.

    Such an arm turns unevenly, or hangs at an angle that its friction decides.
    """
    if conditions.turns and np.any(np.asarray(conditions.slope_deg) != 0):
        steepest = np.asarray(conditions.slope_deg).flat[int(np.argmax(np.abs(np.asarray(conditions.slope_deg))))]
        raise ValueError(
            f"got a slope of {steepest:g} deg for a robot that turns, so it has no steady state; use --model drive"
        )
    for k, (name, load) in enumerate(robot.configurations.items()):
        if np.any(np.asarray(load.torque_gravity) > 0) and np.any(np.asarray(conditions.configuration) == k):
            raise ValueError(
                f"{name} has a gravity torque that depends on its angle, so it has no steady state; use --model "
                "drive, and tables with time_s"
            )


FIDELITY = Fidelity(
    "steady", settled=_settled_results, implicit=IMPLICIT, run=_run_batch, outputs=steady_outputs, check=_check_run
)
