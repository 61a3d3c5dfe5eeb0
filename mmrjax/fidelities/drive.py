"""Fidelity `drive`: equations of motion of drives and chassis over time, with slip, inductance and battery."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mmrjax.compile.compiling import compiled
from mmrjax.fidelities.base import (
    Fidelity,
    History,
    Progress,
    RunBatch,
    result_of_signals,
    withhold_numbers,
)
from mmrjax.fidelities.rest import HELD, holds, standing_signals, status_moving, voltage_at_rest
from mmrjax.fidelities.steady import operating_signals
from mmrjax.model import balances
from mmrjax.model.conditions import Conditions
from mmrjax.model.driver import FAST
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import (
    BATTERY_EMPTY,
    CONVERGED,
    FAILED,
    STALLED,
    Result,
    Signals,
    State,
)
from mmrjax.numerics.elementary import value_and_slope
from mmrjax.numerics.rosenbrock import Unknowns, error_norm, step_longest
from mmrjax.turning import circling
from mmrjax.turning.two_sides import SIDES

# Units of the unknowns (current, motor speed, speed, distance, discharge), which scale them to the order of one.
# The memories of effects follow, each in its own unit.
_UNITS = (10.0, 1000.0, 1.0, 1.0, 10.0)
CURRENT, MOTOR, GROUND = 0, 1, 2
_GAP = 0.01  # of the angle between motor and load, the last unknown if there is one [rad]

#: Time after which a run counts as settled [s].
TIME_SETTLED = 4.0
#: Instants of a history.
SAMPLES = 1001
TIME_INRUSH, SAMPLES_INRUSH = 0.04, 160  # first part of a history [s], and its additional samples
TIME_RISE, SAMPLES_RISE = 0.002, 40  # first part of the inrush, in which the current rises to its peak


class DriveTrajectory(eqx.Module):
    """One run over time.

    Attributes:
        time: [s], shape (times,).
        distance: distance along the slope [m], shape (times,). For a robot that turns, distance from its start.
        signals: all signals at those times. Each field has the shape (times,).
        result: the state at the end, with the run's status.
    """

    time: Float[Array, " times"]
    distance: Float[Array, " times"]
    signals: Signals
    result: Result


def drive_units(robot: Robot) -> tuple[float, ...]:
    """Units of the unknowns."""
    memory = tuple(effect.memory_size or 1.0 for effect in robot.remembering)
    return _UNITS + memory + (1.0,) * len(robot.controller_states) + (_GAP,) * robot.loose


def state_of_unknowns(robot: Robot, y: Unknowns) -> State:
    """The state of a vector of unknowns."""
    y = y * jnp.asarray(drive_units(robot), y.dtype)
    memory = {effect.name: y[len(_UNITS) + k] for k, effect in enumerate(robot.remembering)}
    position = len(_UNITS) + len(memory)
    controller_states = dict(
        zip(robot.controller_states, y[position : position + len(robot.controller_states)], strict=True)
    )
    gap = y[-1] if robot.loose else None
    return State(y[0], y[1], y[2], y[4], memory, distance=y[3], gap=gap, **controller_states)


def unknowns_of_state(robot: Robot, state: State) -> Unknowns:
    """The inverse of `state_of_unknowns`."""
    memory = [state.memory[effect.name] for effect in robot.remembering]
    values = [state.current, state.speed_motor, state.speed, state.distance, state.discharge, *memory]
    values += [getattr(state, name) for name in robot.controller_states]
    values += [] if state.gap is None else [state.gap]
    return jnp.stack([jnp.asarray(x, float) for x in values]) / jnp.asarray(drive_units(robot))


def sampled_unknowns(robot: Robot, conditions: Conditions, y: Unknowns) -> Unknowns:
    """Unknowns after a controller with a rate has read them, if a sample is due. Unchanged for other robots."""
    if robot.controller is None or not robot.controller.rate:
        return y
    state = balances.sampled_controller(robot, conditions, state_of_unknowns(robot, y))
    return unknowns_of_state(robot, state)


#: The signals of an instant, traced once for each kind of robot and shared within a program.
moving = compiled(balances.moving_signals)


@compiled
def drive_rates(robot: Robot, conditions: Conditions, y: Unknowns, direction: Scalar | None = None) -> Unknowns:
    """Rates of change of the unknowns, in their units [1/s]. `direction`: as in `moving_signals`, or `HELD`."""
    is_standing = jnp.asarray(False if direction is None else direction == HELD)
    state = state_of_unknowns(robot, y)
    signals = moving(robot, conditions, state, None if direction is None else jnp.where(is_standing, 0.0, direction))
    current_rate = signals.voltage_left / signals.inductance
    motor_acceleration, acceleration = (
        jnp.where(is_standing, 0.0, x)
        for x in (signals.acceleration_wheel * robot.gearbox.ratio, signals.acceleration)
    )
    if conditions.motor_speed is not None:  # the current follows from torque, the shaft from the imposed speed
        imposed_acceleration = conditions.motor_acceleration
        current_rate, motor_acceleration = (
            jnp.zeros_like(current_rate),
            jnp.zeros_like(motor_acceleration) if imposed_acceleration is None else imposed_acceleration,
        )
    rates = [
        current_rate,
        motor_acceleration,
        acceleration,
        signals.speed,
        balances.charge_drawn(robot, conditions, signals.total_current),
        *(jnp.asarray(effect.rate(robot, signals), y.dtype) for effect in robot.remembering),
        *balances.controller_rates(robot, conditions, state),
        *[signals.speed_wheel - signals.speed_output] * robot.loose,
    ]
    return jnp.stack(rates) / jnp.asarray(drive_units(robot), y.dtype)


def winding_rate(robot: Robot, conditions: Conditions, y: Unknowns) -> Array:
    """Rate of change of the current alone, in its unit [1/s], if the speed is not imposed."""
    state = state_of_unknowns(robot, y)
    signals = balances.driven_signals(robot, conditions, state, None)
    return signals.voltage_left / signals.inductance / _UNITS[CURRENT]


_norm = functools.partial(error_norm, count=len(_UNITS))


def drive_start(robot: Robot, conditions: Conditions, rolling: bool = False) -> Unknowns:
    """Unknowns at rest. With `rolling`, the unknowns of steady travel, with settled memories of effects. If there is
    no steady travel, the unknowns at rest.
    """
    units = jnp.asarray(drive_units(robot), jnp.result_type(conditions.voltage))
    load = robot.chassis(conditions.configuration)
    unknowns_at_rest = jnp.zeros_like(units).at[4].set(conditions.discharge / units[4])
    if conditions.motor_speed is not None:
        unknowns_at_rest = unknowns_at_rest.at[1].set(conditions.motor_speed / units[1])
        if not robot.has_ground:  # only a ground has a speed of grip
            unknowns_at_rest = unknowns_at_rest.at[2].set(
                load.radius / robot.gearbox.ratio * conditions.motor_speed / units[2]
            )
    if robot.rig.begins is not None and conditions.begin is not None:
        initial = _initial_unknowns(robot, conditions)
        angle = initial[3] / load.radius
        memory = [effect.initial(robot, angle) for effect in robot.remembering]
        begin = jnp.stack([*initial, jnp.asarray(conditions.discharge, units.dtype), *memory])
        unknowns_at_rest = unknowns_at_rest.at[: len(begin)].set(begin / units[: len(begin)])
    if robot.loose:
        unknowns_at_rest = unknowns_at_rest.at[-1].set(
            load.twist(load.torque_load(unknowns_at_rest[3] * units[3] / load.radius)) / units[-1]
        )
    if not rolling:
        return unknowns_at_rest
    signals = operating_signals(robot, conditions)
    memory = [effect.settled(robot, signals) for effect in robot.remembering]
    state = [signals.current, signals.speed_motor, signals.speed, 0.0, conditions.discharge, *memory]
    state += [jnp.zeros(())] * len(robot.controller_states)
    if robot.loose:
        state += [load.twist(signals.torque_output)]
    y = jnp.stack([jnp.asarray(x, units.dtype) for x in state]) / units
    return jnp.where(jnp.all(jnp.isfinite(y)), y, unknowns_at_rest)


def _initial_unknowns(robot: Robot, conditions: Conditions) -> Array:
    """Current, motor speed, speed and distance [SI] at the start of a history that does not begin at rest.

    The load rolls with the shafts. The current is in equilibrium with the voltage, which it reaches within
    milliseconds.
    """
    assert robot.rig.begins is not None and conditions.begin is not None
    begin = robot.rig.begins.of(conditions.begin)
    radius = robot.chassis(conditions.configuration).radius
    motor_speed = begin.motor_speed if conditions.motor_speed is None else conditions.motor_speed
    speed = radius * motor_speed / robot.gearbox.ratio
    zero = jnp.zeros(())
    state_without_slip = State(zero, motor_speed, speed, zero, distance=radius * begin.angle)
    conditions = balances.with_controller_duty(robot, conditions, state_without_slip)
    voltage_left = voltage_at_rest(robot, conditions)
    if conditions.motor_current is None:  # an amplifier compensates it
        share = jnp.abs(balances.bridge_duty(robot, conditions)) if robot.driver.decay == FAST else 1.0
        voltage_left = voltage_left - share * robot.motor.voltage_back(motor_speed)
    open_circuit = (conditions.open > 0.5) | (conditions.motor_speed is not None)
    current = jnp.where(open_circuit, 0.0, robot.motor.current_stall(voltage_left))
    return jnp.stack([jnp.asarray(x, float) for x in (current, motor_speed, speed, radius * begin.angle)])


def drive(
    robot: Robot,
    conditions: Conditions,
    times: Float[Array, " times"],
    tolerance: float = 1e-6,
    max_steps: int = 4096,
    *,
    rolling: bool = False,
) -> DriveTrajectory:
    """Simulates one robot over time under constant conditions, from standstill or rolling, and returns the
    trajectory at the given times.

    Args:
        robot: any robot. Its parameters may be tracers.
        conditions: conditions of one run, scalar fields.
        times: increasing times, from 0 [s]. The run ends at the last one.
        tolerance: relative and (in units of 10 A, 1000 rad/s, 1 m/s) absolute error of a step.
        max_steps: number of integration steps after which a run has `failed`.
        rolling: True to start at the operating point of the steady fidelity, or with the sliding speed at V_s if it
            would slide. Derivatives pass through it. False: from standstill.

    Returns:
        The trajectory, with a status for the end of the run. `converged`: the speed changes by less than 0.1 % in a
        tenth of a second, else `not_settled`. `reverses`, `rolls_back`: the same, with backward travel due to a
        negative voltage or to gravity against the motors. `stalled`: the robot does not travel. From standstill it is
        exactly at rest if friction holds it. `slides`: the movers slide beyond V_s and the robot loses speed or
        stands. A robot that keeps its speed has `converged`, flagged `slips`. `battery_empty`: the charge is used up.
        Signals after that and the result's numbers are NaN. `failed`: the integrator gave up. The numbers are NaN.
        Derivatives are forward (`jax.jvp`, `jax.jacfwd`).
    """
    if conditions.turns:
        return _drive_turning(robot, conditions, times, tolerance, max_steps, rolling)
    y0 = drive_start(robot, conditions, rolling)
    is_speed_imposed = conditions.motor_speed is not None
    driven = rolling or is_speed_imposed or robot.controller is not None  # a controller may turn it later
    parked = jnp.asarray(False) if driven else holds(robot, conditions)
    rate_factor = jnp.where(parked, jnp.zeros_like(y0).at[jnp.asarray([0, 4])].set(1.0), 1.0)
    arguments = robot, conditions, rate_factor, y0, times, tolerance, max_steps
    sampled = robot.controller is not None and robot.controller.rate
    ys, reached_end = (
        _integrate_samples(*arguments) if sampled else _integrate_unknowns(drive_rates, _norm, *arguments)
    )
    signals = jax.vmap(lambda y: balances.moving_signals(robot, conditions, state_of_unknowns(robot, y)))(ys)
    if not is_speed_imposed:
        signals_at_rest = jax.vmap(lambda y: standing_signals(robot, conditions, state_of_unknowns(robot, y)))(ys)
        signals = jax.tree.map(lambda rest, travel: jnp.where(parked, rest, travel), signals_at_rest, signals)
    end = jax.tree.map(lambda x: x[-1], signals)
    last_conditions = balances.with_controller_duty(robot, conditions, state_of_unknowns(robot, ys[-1]))
    status = _status_of_run(robot, last_conditions, end, parked, reached_end)
    return _cut_at_empty_battery(
        robot,
        conditions,
        times,
        ys[:, 3] * _UNITS[3],
        signals,
        signals.discharge,
        result_of_signals(robot, end, status),
    )


def _cut_at_empty_battery(
    robot: Robot,
    conditions: Conditions,
    times: Array,
    distance: Array,
    signals: Signals,
    discharge: Scalar,
    end: Result,
) -> DriveTrajectory:
    """The recorded part of a run: it ends with an empty battery, and all later numbers are NaN.

    The parabola of the battery alone would continue.
    """
    has_charge = (conditions.battery < 0.5) | ~robot.battery.empty(discharge)
    signals, distance = jax.tree.map(
        lambda x: jnp.where(has_charge.reshape(-1, *[1] * (x.ndim - 1)), x, jnp.nan), (signals, distance)
    )
    valid = (end.status != BATTERY_EMPTY) & (end.status != FAILED)
    result = withhold_numbers(end, valid, end.status != FAILED)
    return DriveTrajectory(times, distance, signals, result)


def _integrate_unknowns(
    rates: Callable[[Robot, Conditions, Array], Array],
    norm: Callable[[Array], Scalar],
    robot: Robot,
    conditions: Conditions,
    rate_factor: Array | float,
    y0: Array,
    times: Array,
    tolerance: float,
    max_steps: int,
    currents: int = 1,
) -> tuple[Float[Array, "times unknowns"], Array]:
    """Unknowns at the given times, and True if the integrator reached the last one.

    Args:
        rates: function that returns the rates of the unknowns.
        norm: function that returns the norm of an error of the unknowns.
        rate_factor: 0 for robots that stay at rest, otherwise 1.
        currents: number of currents, the first of the unknowns.
    """
    import diffrax  # only here: the import takes half a second

    from mmrjax.numerics.rodas import Rodas4

    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda _, y, run: rates(run[0], run[1], y) * run[2]),
        Rodas4(lambda y, run: jnp.abs(y[:currents]) * _UNITS[CURRENT] > run[0].driver.current_limit),
        times[0],
        times[-1],
        dt0=jnp.asarray(1e-4, y0.dtype),
        y0=y0,
        args=(robot, conditions, rate_factor),
        saveat=diffrax.SaveAt(ts=times),
        max_steps=max_steps,
        throw=False,
        stepsize_controller=diffrax.PIDController(
            rtol=tolerance, atol=tolerance, norm=norm, dtmax=step_longest(robot, conditions)
        ),
        adjoint=diffrax.ForwardMode(),
    )
    assert solution.ys is not None
    return solution.ys, solution.result == diffrax.RESULTS.successful


def _integrate_samples(
    robot: Robot,
    conditions: Conditions,
    rate_factor: Array,
    y0: Array,
    times: Array,
    tolerance: float,
    max_steps: int,
) -> tuple[Float[Array, "times unknowns"], Array]:
    """`_integrate_unknowns` for a controller with a rate: from one sample or requested time to the next."""

    def to_requested_time(carry: tuple[Array, Array, Array], end: Array) -> tuple[tuple[Array, Array, Array], Array]:
        def to_next_sample(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            time, y, reached_end = carry
            y = sampled_unknowns(robot, conditions, y)
            until = jnp.minimum(end, time + jnp.asarray(state_of_unknowns(robot, y).clock))
            span = jnp.stack([time, until])
            ys, reached = _integrate_unknowns(
                drive_rates, _norm, robot, conditions, rate_factor, y, span, tolerance, max_steps
            )
            return until, ys[-1], reached_end & reached

        carry = jax.lax.while_loop(lambda carry: carry[0] < end, to_next_sample, carry)
        return carry, sampled_unknowns(robot, conditions, carry[1])

    (_, _, reached_end), ys = jax.lax.scan(to_requested_time, (times[0], y0, jnp.asarray(True)), times)
    return ys, reached_end


def _drive_turning(
    robot: Robot, conditions: Conditions, times: Array, tolerance: float, max_steps: int, rolling: bool
) -> DriveTrajectory:
    """`drive` for a robot with independently driven sides. Its signals have a last axis of left and right side."""
    y0 = circling.turning_start(robot, conditions, rolling)
    parked = jnp.asarray(False) if rolling else circling.holds(robot, conditions)
    rate_factor = jnp.where(parked, circling.changing_at_rest(y0), 1.0)
    ys, reached_end = _integrate_unknowns(
        circling.turning_rates,
        circling.norm,
        robot,
        conditions,
        rate_factor,
        y0,
        times,
        tolerance,
        max_steps,
        len(SIDES),
    )
    motion = jax.vmap(lambda y: circling.motion_of_unknowns(robot, y))(ys)
    travel = jax.vmap(lambda m: balances.turning_signals(robot, conditions, m))(motion)
    end = jax.tree.map(lambda x: x[-1], (travel, motion))
    status = jnp.where(parked, STALLED, circling.status_after_run(robot, conditions, *end))
    status = jnp.where(reached_end, status, FAILED)
    distance = jnp.hypot(motion.place_x, motion.place_y)
    result = circling.result_of_turn(robot, end[0], status)
    return _cut_at_empty_battery(robot, conditions, times, distance, travel.signals, motion.discharge, result)


def _status_of_run(robot: Robot, conditions: Conditions, end: Signals, parked: Array, reached_end: Array) -> Array:
    voltage = voltage_at_rest(robot, conditions) if conditions.voltage_follows else end.voltage
    status = status_moving(robot, conditions, end, voltage)
    status = jnp.where(parked, STALLED, status)
    status = jnp.where(robot.battery.emptied(conditions.battery, end.discharge), BATTERY_EMPTY, status)
    return jnp.where(reached_end & jnp.isfinite(end.speed), status, FAILED)


@compiled
def drive_batch(
    robot: Robot,
    conditions: Conditions,
    times: Float[Array, " times"],
    tolerance: float = 1e-6,
    max_steps: int = 4096,
) -> DriveTrajectory:
    """`drive` for one robot over a batch of conditions (first axis of every field), compiled."""
    return jax.vmap(lambda c: drive(robot, c, times, tolerance, max_steps))(conditions)


def _settled_results(robot: Robot, conditions: Conditions) -> Result:
    # A table of settled runs does not record their starts. A start from standstill slides first, at μ_d; on a slope
    # between μ_d and μ_s it never grips, although it was measured there. Hence a rolling start, as in `track`.
    times = jnp.asarray([0.0, TIME_SETTLED])
    return jax.vmap(lambda one: drive(robot, one, times, rolling=True).result)(conditions)


def _run_batch(
    robot: Robot, conditions: Conditions, options: Mapping[str, float], progress: Progress | None = None
) -> RunBatch:
    return RunBatch(drive_batch(robot, conditions, jnp.asarray([0.0, options["duration"]])).result)


def _run_histories(
    robot: Robot, conditions: Conditions, options: Mapping[str, float], progress: Progress | None = None
) -> RunBatch:
    duration = options["duration"]  # times are denser while the current rises to its peak
    inrush = np.linspace(0.0, min(TIME_INRUSH, duration), SAMPLES_INRUSH, endpoint=False)
    rise = np.linspace(0.0, min(TIME_RISE, duration), SAMPLES_RISE, endpoint=False)
    times = np.unique(np.round(np.concatenate([rise, inrush, np.linspace(0.0, duration, SAMPLES)]), 9))
    histories = drive_batch(robot, conditions, jnp.asarray(times))
    return RunBatch(
        histories.result, history=History.of(robot, histories.time, histories.distance, histories.signals)
    )


def _standstill_cautions(robot: Robot, conditions: Conditions) -> list[str]:
    run = drive_batch(robot, conditions, jnp.asarray([0.0, TIME_SETTLED]))
    rows = ", ".join(str(k + 1) for k in np.flatnonzero(np.asarray(run.result.status) != CONVERGED))
    if not rows:
        return []
    return [
        f"rows {rows}: computed from a rolling start. From standstill, the robot does not settle within "
        f"{TIME_SETTLED:g} s, sliding at μ_d"
    ]


def current_after(robot: Robot, conditions: Conditions, step: Scalar, signals: Signals) -> Scalar:
    """Motor current after one step [A]: exponential Euler, exact for a winding at constant speed.

    L dI/dt = U_left(I). I + Δt U_left / L · (e^z - 1) / z with z = Δt U_left' / L. The electrical time
    constant (0.2 ms) is of the order of the step, so the winding's own decay is integrated exactly. U_left'
    comes from the balances and includes a battery or an effect that changes the slope.
    """

    def voltage_left(current: Array) -> Array:
        total_current = signals.total_current + robot.sides * signals.share_drawn * (current - signals.current)
        shifted = replace(signals, current=current, total_current=total_current)
        return balances.electrical(robot, conditions, balances.supply(robot, conditions, shifted)).voltage_left

    voltage, slope = value_and_slope(voltage_left, signals.current)
    z = step * slope / signals.inductance
    return signals.current + step / signals.inductance * voltage * jnp.expm1(z) / z


FIDELITY = Fidelity(
    "drive", settled=_settled_results, run=_run_batch, histories=_run_histories, cautions=_standstill_cautions
)
