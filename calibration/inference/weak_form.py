"""Regression of base parameters and effects on the equations of a log in weak form, without any simulation.

If a log shows the states, the balances give their rates at its readings. The equation y' = f(y) is multiplied by
smooth windows w(t) and integrated by parts: ∫ w f(y) dt + ∫ w' y dt = 0. No derivative of a noisy reading is taken.
References: modulating functions, Preisig and Rippin, Comput. Chem. Eng. 17 (1993) 1. Inverse dynamic identification,
Gautier and Khalil, IEEE Trans. Robot. Autom. 6 (1990) 368. Weak SINDy, Messenger and Bortz, Multiscale Model. Simul.
19 (2021) 1474. Both terms contain readings, and overlapping windows share their noise. The covariance of this noise
follows from the sds of the readings and the steps of their instruments, and weights the windows (Bortz, Messenger and
Dukic, Bull. Math. Biol. 85 (2023) 110). No window contains a jump of an imposed quantity, a gap, or rest.

Readings are regressors too, and their noise biases the parameters. So derivatives are those of simulated states
(`with_smooth_states`), as instruments. The next figures are the largest bias of a parameter over 100 logs of each
kind, in posterior sds. The kinds are a motor with voltage, current and speed, a carriage with force and speed, and an
angle alone, also with coarse instruments. An independent NumPy regression with exact states as instruments has 0.21
(standard error 0.1), and 91 to 99 % of its intervals hold. An iterated covariance has 0.97 (82 %), on the motor with
its log-determinant as much as without. With windows of sin⁴, the covariance used before has 0.90 (72 %). One that
changes within the fit has 0.29 (56 %).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy import sparse
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares

from calibration.inference import linearization
from calibration.inference.priors import DELAY
from calibration.inference.problem import Problem
from calibration.inference.shown_states import (
    APART,
    REACH,
    LogPoints,
    RunWindows,
    StatePlan,
    join_windows,
    points_and_windows,
    state_plan,
    with_condition,
)
from mmrjax.compile import compiling
from mmrjax.compile.programs import return_memory
from mmrjax.model import balances, channels
from mmrjax.model.chassis import inertia_reduced
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals, State
from mmrjax.numerics.elementary import value_and_slope
from mmrjax.numerics.linear_equations import factorise, solve_factorised

#: Fewest windows for each base parameter of a regression that is used.
ENOUGH = 4
#: Variance added to the noise of a window, as a share of it. Without it, differences between overlapping windows
#: would have no noise.
FLOOR = 0.01
#: Steps of Newton's method to the current that a voltage drives.
CURRENT_STEPS = 3
#: Share of the distance to a reading by which a simulated state moves there at each point.
PULL = 1 / 64
#: Most steps of the regression with one covariance, and the relative change of its sum of squares at which it ends;
#: most covariances, largest change between two [prior sd], and the change of a residual at which the last is kept.
STEPS, SMALL, ROUNDS, FAR, SETTLED = 10, 1e-3, 12, 1.0, 0.02
#: Longest delay, as a share of a run; most delays of a grid, either way; difference of log L between delays that fit
#: equally well; farthest coordinates at which the profile of a delay is computed [prior sd]; rows by which a jump may
#: have come between two rows without a delay.
TENTH, DELAYS, SAME, NEAR, RESOLVED = 0.1, 200, 3.0, 4.0, 1.5
#: Most windows whose noise is known together, and most windows of a profile of delays.
TOGETHER, PROFILED = 400, 300
#: Sds by which the defects must exceed the noise of the readings for a disturbance.
CHANCE = 3.0


class EquationTerms(eqx.Module):
    """Terms f and y of the equations Σ w f Δt + Σ w' y Δt = 0 at each row, shape (rows, equations, ...).

    Attributes:
        f, y: terms at the measured readings.
        by_z, by_balance, by_reading, by_effects: derivatives of f and y with respect to coordinates, errors of the
            balances in `PROBED`, readings and effects' amplitudes.
        signals: signals at each row.
    """

    f: Array
    y: Array
    by_z: tuple[Array, Array]
    by_balance: tuple[Array, Array]
    by_reading: tuple[Array, Array]
    by_effects: tuple[Array, Array]
    signals: Signals


def _solve_current(robot: Robot, conditions: Conditions, state: State, way: Scalar) -> Scalar:
    """Current that satisfies the voltage balance, by Newton's method. Its derivatives are those of the last step."""

    def voltage_left(robot: Robot, state: State, current: Scalar) -> Scalar:
        state_with_current = dataclasses.replace(state, current=current)
        return jnp.asarray(balances.driven_signals(robot, conditions, state_with_current, way).voltage_left)

    constants: Any = jax.tree.map(
        lambda x: jax.lax.stop_gradient(x) if isinstance(x, jax.Array) else x, (robot, state)
    )
    current = jnp.zeros(())
    for step in range(CURRENT_STEPS):
        value, slope = jax.jvp(lambda x: voltage_left(constants[0], constants[1], x), (current,), (jnp.ones(()),))
        value = voltage_left(robot, state, current) if step == CURRENT_STEPS - 1 else value
        current = current - value / slope
    return current


class _MeasuredStates(eqx.Module):
    """States that follow from the readings of one point.

    Attributes:
        motor_speed: motor speed [rad/s] and current [A].
        lead: the part of the current by which it is later than its reading, see `_current_lead` [A].
        reading_per_speed: reading of the motion channel per motor speed.
        reading_per_ampere: reading of the current channel per ampere.
        errors: errors of the instruments, by channel.
    """

    motor_speed: Scalar
    current: Scalar
    lead: Scalar
    reading_per_speed: Scalar
    reading_per_ampere: Scalar
    errors: dict[int, Scalar]


def _current_lead(robot: Robot, row: LogPoints) -> Scalar:
    """Mean current around a point, less the mean of its readings [A].

    A held voltage changes at a row, whose reading shows the current before. So the reading of a fast winding shows
    the mean voltage since the row before. That of a slow winding is the mean current around its row.
    """
    if "voltage" not in row.drift or robot.rig.between_rows == "linear":
        return jnp.zeros(())
    step, ratio = row.reach / REACH, robot.motor.inductance / robot.motor.resistance
    relative_rise_time = jnp.maximum(ratio / step, 1e-6)
    share = 0.5 - relative_rise_time - 1 / jnp.expm1(-1 / relative_rise_time) - 1
    return -share * step * row.drift["voltage"] / robot.motor.resistance


def _measured_states(plan: StatePlan, robot: Robot, row: LogPoints, readings: Array) -> _MeasuredStates:
    """States that follow from the readings of one point, without slip."""
    conditions = row.imposed(robot.rig.delay)
    names = channels.channel_names(robot.channels)
    chassis = robot.chassis(conditions.configuration)
    zero = jnp.zeros(())
    one = jnp.ones(())

    def reading_of(k: int, state: State) -> Scalar:
        return channels.find_channel(names[k]).read(robot, balances.begin_signals(robot, conditions, state))

    current: Scalar = zero
    motor_speed: Scalar = zero
    reading_per_speed: Scalar = one
    reading_per_ampere: Scalar = one
    lead: Scalar = zero
    if conditions.motor_current is not None:
        current = jnp.asarray(conditions.motor_current)
    if plan.current >= 0:
        reading_per_ampere = reading_of(plan.current, State(one, zero, zero, zero, distance=zero))
        lead = _current_lead(robot, row)
        current = readings[plan.current] / reading_per_ampere + lead
    if plan.imposed == "motor_speed":
        motor_speed = jnp.asarray(conditions.motor_speed)
    else:
        rolling = State(zero, one, chassis.radius / robot.gearbox.ratio, zero, distance=chassis.radius)
        reading_per_speed = reading_of(plan.motion, rolling)
        if plan.angle:
            reading_per_speed = reading_per_speed / robot.gearbox.ratio  # that of the output by the output's
        motor_speed = (row.rate if plan.angle else readings[plan.motion]) / reading_per_speed
    rolling_speed = chassis.radius * motor_speed / robot.gearbox.ratio
    states = State(current, motor_speed, rolling_speed, zero, row.memory, distance=chassis.radius * row.angle)
    signals = balances.begin_signals(robot, conditions, states)
    errors = {
        k: balances.effects_sum(robot, signals, "sensor", names[k]) for k in (plan.motion, plan.current) if k >= 0
    }
    if plan.current >= 0:
        current = current - errors[plan.current] / reading_per_ampere
    if plan.motion >= 0 and not plan.angle:
        motor_speed = motor_speed - errors[plan.motion] / reading_per_speed
    return _MeasuredStates(motor_speed, current, lead, reading_per_speed, reading_per_ampere, errors)


def _rolling_signals(
    plan: StatePlan, robot: Robot, row: LogPoints, motor_speed: Scalar, current: Scalar
) -> tuple[Signals, Scalar]:
    """Signals of a point with these states, and its current. If no channel shows the current, it follows from the
    equations.
    """
    conditions = row.imposed(robot.rig.delay)
    radius = robot.chassis(conditions.configuration).radius
    rolling_speed, distance = radius * motor_speed / robot.gearbox.ratio, radius * row.angle
    state = State(current, motor_speed, rolling_speed, jnp.zeros(()), row.memory, distance=distance)
    if plan.imposed == "voltage" and plan.current < 0:
        current = _solve_current(robot, conditions, state, row.way)
    return balances.rolling_signals(robot, conditions, dataclasses.replace(state, current=current), row.way), current


def equation_terms(
    plan: StatePlan, robot: Robot, row: LogPoints, readings: Array, probes: frozenset[str] = frozenset()
) -> tuple[Array, Array, Signals]:
    """Terms f and y of the equations at one point, and its signals.

    Args:
        row: one point of `LogPoints`, without the first axis.
        readings: its readings [SI], shape (channels,).
        probes: names of effects that read no signal.
    """
    names = channels.channel_names(robot.channels)
    chassis = robot.chassis(row.conditions.configuration)
    states = _measured_states(plan, robot, row, readings)
    zero = jnp.zeros(())
    motor_speed = states.motor_speed
    if robot.has_ground and plan.mechanical and plan.travels:
        # The wheels turn faster than the load travels because of slip.
        rolling = balances.begin_signals(
            robot, row.conditions,
            State(states.current, motor_speed, chassis.radius * motor_speed / robot.gearbox.ratio, zero, row.memory,
                  distance=chassis.radius * row.angle),
        )  # fmt: skip
        if any(e.balance == "slip" and e.name not in probes for e in robot.effects):
            rolling = _rolling_signals(plan, robot, row, motor_speed, states.current)[0]
        motor_speed = (
            motor_speed + balances.effects_sum(robot, rolling, "slip") * robot.gearbox.ratio / chassis.radius
        )
    signals, current = _rolling_signals(plan, robot, row, motor_speed, states.current)
    f, y = list[Any](), list[Any]()
    if plan.electrical:
        # Divided by the inductance, the rate of the current would be mostly noise, and a large inductance fit best.
        f.append(signals.voltage_left)
        y.append(signals.inductance * current)
    if plan.mechanical:
        # A torque, not an acceleration: the derivative by an inertia is then the motion, which states without noise
        # give. That of an acceleration is a torque, whose model error would enter its own instrument.
        load_inertia = chassis.radius**2 * signals.mass / robot.sides if robot.has_ground else 0.0
        gearbox = robot.gearbox
        output_inertia = chassis.inertia + signals.inertia_added + load_inertia
        inertia = inertia_reduced(robot.motor.inertia, gearbox.ratio, gearbox.efficiency_load, output_inertia)
        motion = (
            (readings[plan.motion] - states.errors[plan.motion]) / states.reading_per_speed
            if plan.angle
            else motor_speed
        )
        f.append(inertia * signals.acceleration_wheel)
        y.append(inertia * motion / robot.gearbox.ratio)
    if plan.others:
        if robot.has_ground:
            creep = chassis.ground.speed_creep(signals.traction, signals.normal, signals.adhesion)
            slip_effects = balances.effects_sum(robot, signals, "slip")
            signals = dataclasses.replace(signals, speed=signals.speed_theoretical - creep - slip_effects)
        sensor_readings = balances.sensor(robot, signals)
        f += [sensor_readings[names[k]] - readings[k] for k in plan.others]
        y += [zero] * len(plan.others)
    return jnp.stack([jnp.asarray(x, float) for x in f]), jnp.stack([jnp.asarray(x, float) for x in y]), signals


@functools.partial(compiling.compiled, options=compiling.SELDOM)
def with_smooth_states(problem: Problem, plan: StatePlan, rows: LogPoints, z: Array) -> LogPoints:
    """Points whose state readings are replaced by states without noise, from the equations at coordinates z.

    Each state follows its equation from point to point by linearly implicit steps, and is slowly pulled towards its
    readings. It starts at the readings in each run and after rest. Such states serve as instruments: their noise is
    independent of that of the readings (Janot, Vandanjon and Gautier, Control Eng. Pract. 25 (2014) 85).
    """
    if not plan.mechanical:
        return rows
    robot = problem.coordinates.robot(problem.base, z)
    measured_states = jax.vmap(lambda row: _measured_states(plan, robot, row, row.readings))(rows)
    state_readings = jnp.stack([measured_states.motor_speed, measured_states.current], 1)
    count = 1 + plan.electrical

    def step(carry: tuple[Array, Array], inputs: tuple[LogPoints, Array]) -> tuple[tuple[Array, Array], Array]:
        (x, idle), (row, reading) = carry, inputs

        def rates(x: Array) -> tuple[Array, tuple[Array, Signals]]:
            signals = _rolling_signals(plan, robot, row, x[0], jnp.append(x, reading[count:])[1])[0]
            state_rates = [signals.acceleration_wheel * robot.gearbox.ratio, signals.voltage_left][:count]
            stacked = jnp.stack([jnp.asarray(r, float) for r in state_rates])
            return stacked, (stacked, signals)

        slope, (rate, signals) = jax.jacfwd(rates, has_aux=True)(x)
        inertia = jnp.stack([jnp.ones(()), jnp.asarray(signals.inductance, float)])[:count]
        x = x + solve_factorised(factorise(jnp.diag(inertia) - row.since * slope), row.since * rate)
        x = x + PULL * (reading[:count] - x)
        rests = (row.since <= 0) | (row.way == 0)
        x = jnp.where(rests | idle | ~jnp.all(jnp.isfinite(x)), reading[:count], x)
        return (x, rests), x

    states = jax.lax.scan(step, (state_readings[0, :count], jnp.asarray(True)), (rows, state_readings))[1]
    readings, rate = rows.readings, rows.rate
    if plan.electrical:
        readings = readings.at[:, plan.current].set(
            (states[:, 1] - measured_states.lead) * measured_states.reading_per_ampere
        )
    motion = states[:, 0] * measured_states.reading_per_speed
    if plan.angle:
        rate = motion
        motion = jnp.cumsum(0.5 * (motion + jnp.roll(motion, 1)) * rows.since)
    readings = readings.at[:, plan.motion].set(motion)
    return dataclasses.replace(rows, readings=readings, rate=rate)


@functools.partial(compiling.compiled, options=compiling.SELDOM)
def _terms_with_derivatives(
    problem: Problem, plan: StatePlan, rows: LogPoints, z: Array, effects: tuple[linearization.ScoredEffect, ...]
) -> EquationTerms:
    """Terms at each point for coordinates z, with derivatives with respect to base parameters, readings and
    effects.
    """
    balances_changed = tuple(
        dict.fromkeys((*linearization.PROBED, *(e.effect.balance for e in effects if e.effect.balance != "sensor")))
    )
    probes = tuple(linearization.balance_probe(b) for b in balances_changed)
    size = z.size
    names = channels.channel_names(problem.channels)

    def terms_of_point(row: LogPoints) -> tuple[Any, tuple[Any, Signals]]:
        def terms_and_values(x: Array) -> tuple[Any, tuple[Any, Signals]]:
            base = problem.coordinates.robot(problem.base, x[:size])
            robot = linearization.with_probes(base, probes, x[size : size + len(probes)])
            f, y, signals = equation_terms(
                plan, robot, row, x[size + len(probes) :], frozenset(p.name for p in probes)
            )
            return (f, y), ((f, y), signals)

        return jax.jacfwd(terms_and_values, has_aux=True)(jnp.concatenate([z, jnp.zeros(len(probes)), row.readings]))

    slopes, (values, signals) = jax.vmap(terms_of_point)(rows)
    base = problem.coordinates.robot(problem.base, z)
    memory = memory_by_point(base, rows, signals, effects)
    angle = rows.angle
    if plan.angle:  # The integrated readings have noise, which a gain of them would explain.
        readings_per_speed = jax.vmap(lambda row: _measured_states(plan, base, row, row.readings).reading_per_speed)(
            rows
        )
        angle = rows.readings[:, plan.motion] / (readings_per_speed * base.gearbox.ratio)

    def terms_of_effects(signals: Signals, angle: Array, memory: list[Array]) -> Array:
        signals_with_angle = dataclasses.replace(signals, angle=angle)
        terms = [
            linearization.effect_terms(
                base, signals_with_angle if e.effect.balance == "sensor" else signals, (e,), [m]
            )
            for e, m in zip(effects, memory, strict=True)
        ]
        return jnp.concatenate([jnp.zeros(0), *terms])

    effect_values = jax.vmap(terms_of_effects)(signals, angle, memory)
    # An effect changes an equation like a defect of its balance. An effect of an instrument changes it like a
    # negative reading, or like a defect of that equation if the reading follows from the states.
    instances = [e.effect for e in effects for _ in e.at]
    tangent_of_effect = np.array(
        [size + balances_changed.index(e.balance) if e.balance in balances_changed else -1 for e in instances], int
    )
    channel_of = np.array([names.index(e.channel) if e.channel in names else 0 for e in instances], int)
    first = len(values[0][0]) - len(plan.others)

    def of_effects(slope: Array, direct: bool) -> Array:
        change = -slope[:, :, size + len(probes) :][:, :, channel_of]
        for k, channel in enumerate(plan.others):
            change = change.at[:, first + k].set(jnp.asarray(1.0 * (channel_of == channel)) * direct)
        return (
            jnp.where(tangent_of_effect >= 0, slope[:, :, np.maximum(tangent_of_effect, 0)], change)
            * effect_values[:, None]
        )

    def slopes_of_f_and_y(part: Callable[[Array, bool], Array]) -> tuple[Array, Array]:
        return part(slopes[0], True), part(slopes[1], False)

    return EquationTerms(
        values[0],
        values[1],
        slopes_of_f_and_y(lambda s, _: s[:, :, :size]),
        slopes_of_f_and_y(lambda s, _: s[:, :, size : size + len(linearization.PROBED)]),
        slopes_of_f_and_y(lambda s, _: s[:, :, size + len(probes) :]),
        slopes_of_f_and_y(of_effects),
        jax.tree.map(lambda x: jnp.broadcast_to(x, rows.time.shape), signals),
    )


def memory_by_point(
    robot: Robot, rows: LogPoints, signals: Signals, effects: tuple[linearization.ScoredEffect, ...]
) -> list[Array]:
    """Memory of each effect at each point of the log and of the effect's grid, shape (points, grid)."""
    count = rows.since.shape[0]
    no_memory = [jnp.zeros((count, len(e.at))) for e in effects]

    def of_effect(scored: linearization.ScoredEffect) -> Array:
        def advance(memory: Array, row: tuple[Array, Array, Signals]) -> tuple[Array, Array]:
            since, angle, signals = row
            rate, slope = value_and_slope(lambda m: linearization.memory_rates(robot, scored, signals, m), memory)
            start_memory = linearization.initial_memory(robot, scored, angle)
            memory = jnp.where(since > 0, memory + since * rate / (1 - since * slope), start_memory)
            return memory, memory

        start_memory = linearization.initial_memory(robot, scored, rows.angle[0])
        return jax.lax.scan(advance, start_memory, (rows.since, rows.angle, signals))[1]

    return [
        zero if e.effect.memory_size is None else of_effect(e) for e, zero in zip(effects, no_memory, strict=True)
    ]


# --- a delay --------------------------------------------------------------------------------------------------


@functools.partial(compiling.compiled, options=compiling.SELDOM)
def _terms_by_coordinates(problem: Problem, plan: StatePlan, rows: LogPoints, z: Array) -> Array:
    """Terms f and y and their derivatives with respect to z, shape (2, points, equations, 1 + coordinates)."""

    def terms_of_point(row: LogPoints) -> Array:
        def terms_at(z: Array) -> tuple[Array, Array]:
            state_terms = jnp.stack(
                equation_terms(plan, problem.coordinates.robot(problem.base, z), row, row.readings)[:2]
            )
            return state_terms, state_terms

        slope, value = jax.jacfwd(terms_at, has_aux=True)(z)
        return jnp.concatenate([value[..., None], slope], -1)

    return jnp.moveaxis(jax.vmap(terms_of_point)(rows), 1, 0)


def fit_delay(problem: Problem, plan: StatePlan) -> float:
    """Delay of the imposed quantity after the time that its column states [s], negative if earlier.

    It is the best of a profile of the regression, over a tenth of a run in either direction.

    The terms are nearly affine in the imposed quantities, so a few evaluations serve all delays. The windows contain
    jumps, because jumps show a delay best. If several delays fit equally well, as with a periodic input, the shortest
    is returned.
    """
    file_delay = float(np.max(np.asarray(problem.base.rig.delay)))
    if DELAY not in problem.coordinates.names:
        return file_delay
    rows, course, windows = points_and_windows(problem, plan, across=True)
    if not (windows and rows.drift):
        return file_delay
    time, since = np.asarray(rows.time), np.asarray(rows.since)
    step = float(np.median(since[since > 0]))
    stride = -(-sum(len(w.rows) for w in windows) // PROFILED)
    windows = [w.part(np.arange(0, len(w.rows), stride)) for w in windows]
    longest = TENTH * float(np.median([time[w.rows].max() for w in windows]))
    grid = np.linspace(-longest, longest, 2 * int(np.clip(longest / step, 8, DELAYS)) + 1)
    joined = join_windows(windows)
    points_inside, places = np.unique(joined.rows, return_inverse=True)
    joined = dataclasses.replace(joined, rows=places.reshape(joined.rows.shape))
    rows = jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[points_inside]), rows)
    course = dataclasses.replace(course, cell=course.cell[points_inside])
    free = [k for k, name in enumerate(problem.coordinates.names) if name != DELAY]
    z = np.zeros(len(problem.coordinates))
    centre = np.asarray(problem.data.centre)
    undelayed = course.at(0.0)[0]

    def terms_with(imposed: dict[str, np.ndarray]) -> np.ndarray:
        """Terms at z with other imposed quantities, which do not depend on a delay."""
        conditions = rows.conditions
        for name, x in imposed.items():
            conditions = with_condition(conditions, name, jnp.asarray(x))
        points = dataclasses.replace(rows, conditions=conditions, drift={})
        return np.asarray(_terms_by_coordinates(problem, plan, points, jnp.asarray(z)))

    def profile(delays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Half of what -2 log L of the windows exceeds its least, and the coordinates, at each delay."""
        undelayed_terms = terms_with(undelayed)
        terms_per_unit = {
            n: (terms_with({**undelayed, n: x + np.ptp(x)}) - undelayed_terms) / np.ptp(x)
            for n, x in undelayed.items()
        }
        # In units of what is imposed, whose factor then is 1: other residuals would shrink with a larger inertia.
        largest = max(
            terms_per_unit, key=lambda n: float(np.abs(terms_per_unit[n][0, ..., 0]).mean() * np.ptp(undelayed[n]))
        )
        factor = terms_per_unit[largest][0].mean(0)  # (equations, 1 + z)
        acts = np.flatnonzero(np.abs(factor[:, 0]) > 0)
        unit = factor[acts, None, :1]
        relative_slopes = factor[acts, None, 1:] / factor[acts, None, :1]
        undelayed_integrals = _integrate_terms(plan, joined, *undelayed_terms)[acts]
        weighted = {
            n: _integrate_terms(plan, joined, x[0], x[1], "wk,wk...->wk...")[acts] for n, x in terms_per_unit.items()
        }
        costs, coordinates_by_delay = [], []
        for delay in delays:
            means = course.at(float(delay))[0]
            integrals = undelayed_integrals.copy()  # (equations, windows, 1 + z)
            for n, x in weighted.items():
                integrals += np.einsum("wk,ewk...->ew...", (means[n] - undelayed[n])[joined.rows], x)
            integrals[..., 1:] -= integrals[..., :1] * relative_slopes
            integrals /= unit
            size = np.sqrt(np.mean(integrals[..., 0] ** 2, 1))
            for _ in range(3):  # the noise of each equation is what the regression leaves
                flat = np.concatenate(integrals / np.maximum(size, 1e-300)[:, None, None])
                jacobian = np.concatenate([flat[:, 1:][:, free], np.eye(len(free))])
                target = np.concatenate([flat[:, 0], (z - centre)[free]])
                correction = -np.linalg.lstsq(jacobian, target, rcond=None)[0]
                remainder = integrals[..., 0] + integrals[..., 1:][..., free] @ correction
                size = np.sqrt(np.mean(remainder**2, 1))
            costs.append(np.sum(np.log(np.maximum(size, 1e-300))) * len(joined.rows) * APART)
            coordinates_by_delay.append(z.copy())
            coordinates_by_delay[-1][free] += correction
        return np.array(costs) - np.min(costs), np.stack(coordinates_by_delay)

    best = 0.0
    for delays in (grid, grid, None):
        delays = best + np.linspace(-step, step, 17) if delays is None else delays
        cost, coordinates_by_delay = profile(delays)
        inner = np.r_[np.inf, cost, np.inf]
        is_local_minimum = (inner[1:-1] <= inner[:-2]) & (inner[1:-1] <= inner[2:]) & (cost < SAME)
        k = int(np.argmin(np.abs(delays)))
        k = k if cost[k] < SAME else int(np.argmin(np.where(is_local_minimum, np.abs(delays), np.inf)))
        best = float(delays[k])
        z = np.clip(coordinates_by_delay[k], -NEAR, NEAR)
    return best if abs(best) > RESOLVED * step else 0.0


# --- the regression -------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class WeakFormFit:
    """Regression of a log in weak form: whitened residuals of its windows at the fitted coordinates, with
    derivatives.

    Attributes:
        z: base coordinates that minimise the squared residuals of windows and priors.
        residual: residuals of windows, then z - centre, shape (windows + coordinates,).
        jacobian: derivatives with respect to the coordinates.
        signatures: derivatives of the windows with respect to the amplitude of each instance [prior sd].
        plan, windows: channels that give the states, and the windows.
        centre, origin: prior mean, and coordinates of the terms.
        rows: points with states without noise.
        smooth_terms: terms there.
        read_terms: terms f and y at the readings.
    """

    z: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray
    signatures: np.ndarray
    plan: StatePlan
    windows: list[RunWindows]
    centre: np.ndarray
    origin: np.ndarray
    rows: LogPoints
    smooth_terms: EquationTerms
    read_terms: tuple[Any, Any]


def fit_weak_form(problem: Problem, effects: tuple[linearization.ScoredEffect, ...] = ()) -> WeakFormFit | None:
    """Fits the base parameters of a log to its equations in weak form.

    None if the log does not show the states, or has too few windows.

    Args:
        problem: problem of time histories, without effects in its coordinates.
        effects: effects whose signatures are computed.
    """
    plan = state_plan(problem)
    if plan is None:
        return None
    delay = fit_delay(problem, plan)
    rows, _, windows = points_and_windows(problem, plan, delay)
    windows = [
        w.part(k) for w in windows for k in np.array_split(np.arange(len(w.rows)), -(-len(w.rows) // TOGETHER))
    ]
    equations = plan.electrical + plan.mechanical + len(plan.others)
    if equations * sum(len(w.rows) for w in windows) < ENOUGH * len(problem.coordinates):
        return None

    sd = np.asarray(rows.sd)

    def terms(rows: LogPoints, z: np.ndarray) -> EquationTerms:
        return jax.device_get(_terms_with_derivatives(problem, plan, rows, jnp.asarray(z), effects))

    def whiten(factors: list[np.ndarray], *terms_by_pair: tuple[Any, Any]) -> np.ndarray:
        factors_and_windows = zip(factors, windows, strict=True)
        return np.concatenate(
            [solve_triangular(x, window_errors(plan, w, *terms_by_pair), lower=True) for x, w in factors_and_windows]
        )

    coordinates = problem.coordinates
    centre = np.array(problem.data.centre)
    if DELAY in coordinates.names:  # windows without jumps may not show it
        k = coordinates.names.index(DELAY)
        centre[k] = (delay - float(coordinates.value(centre)[k])) / float(coordinates.spread[k])

    def linearise_about(origin: np.ndarray) -> tuple[Any, ...]:
        """Function that returns residuals and their derivatives at z, and derivatives of the terms with respect to
        effects. Then the factors of the covariance, states without noise, and terms there and at the readings. These
        do not depend on z: they are computed at the origin.
        """
        smooth = with_smooth_states(problem, plan, rows, jnp.asarray(origin))
        smooth_terms, reading_terms = terms(smooth, origin), terms(rows, origin)
        read_terms = reading_terms.f, reading_terms.y  # the rest of a long log is large
        factors = _window_factors(plan, windows, sd, smooth_terms, read_terms)
        offset = whiten(factors, read_terms) - whiten(factors, (smooth_terms.f, smooth_terms.y))
        cache: dict[bytes, tuple[np.ndarray, tuple[Any, Any]]] = {}

        def residuals_at(z: np.ndarray) -> tuple[np.ndarray, tuple[Any, Any]]:
            if (key := z.tobytes()) not in cache:
                terms_at_z = terms(smooth, z)
                errors = whiten(factors, (terms_at_z.f[..., None], terms_at_z.y[..., None]), terms_at_z.by_z)
                errors[:, 0] += offset
                priors = np.concatenate([(z - centre)[:, None], np.eye(len(z))], 1)
                cache.clear()
                cache[key] = np.concatenate([errors, priors]), terms_at_z.by_effects
            return cache[key]

        return residuals_at, factors, smooth, smooth_terms, read_terms

    z = centre
    try:
        for _ in range(ROUNDS):
            return_memory()  # terms of a long log
            origin = z
            residuals_at, factors, *states = linearise_about(origin)
            regression = least_squares(
                lambda z: residuals_at(z)[0][:, 0], z, lambda z: residuals_at(z)[0][:, 1:], method="lm",  # noqa: B023
                max_nfev=STEPS, xtol=SMALL, ftol=SMALL,
            )  # fmt: skip
            step = (regression.x - z) * min(1.0, FAR / max(float(np.abs(regression.x - z).max()), 1e-300))
            z = z + step
            residuals, by_effects = residuals_at(z)
            if np.abs(residuals[:, 1:] @ step).max() < SETTLED:
                break
        signatures = whiten(factors, by_effects)
    except (np.linalg.LinAlgError, ValueError):  # non-finite numbers
        return None
    return WeakFormFit(z, residuals[:, 0], residuals[:, 1:], signatures, plan, windows, centre, origin, *states)


def _window_factors(
    plan: StatePlan,
    windows: list[RunWindows],
    sd: np.ndarray,
    smooth_terms: EquationTerms,
    read_terms: tuple[Any, Any],
) -> list[np.ndarray]:
    """Cholesky factors of the covariance of each part of the windows, with the disturbances of the equations.

    Args:
        smooth_terms, read_terms: terms at states without noise, and at the readings.
    """
    equations = smooth_terms.f.shape[1]
    reading_factors = [covariance_factor(plan, w, sd, smooth_terms, np.zeros(equations)) for w in windows]
    defect, noise, unit_variance = (
        np.concatenate([x.reshape(equations, -1).T for x in parts])
        for parts in (
            [window_errors(plan, w, read_terms) for w in windows],
            [np.sum(x**2, 1) for x in reading_factors],
            [np.tile(np.sum(w.weight**2 / w.steps, 1), equations) for w in windows],
        )
    )
    disturbances = disturbance_intensities(defect, noise, unit_variance)
    return (
        [covariance_factor(plan, w, sd, smooth_terms, disturbances) for w in windows]
        if disturbances.any()
        else reading_factors
    )


def window_errors(plan: StatePlan, w: RunWindows, *terms: tuple[Any, Any]) -> np.ndarray:
    """Errors of the equations in a run's windows, or their derivatives, from pairs of terms f and y, shape (windows,
    columns of all pairs).
    """
    integrals = np.concatenate([_integrate_terms(plan, w, np.asarray(f), np.asarray(y)) for f, y in terms], -1)
    return np.concatenate(integrals)


def _integrate_terms(
    plan: StatePlan, w: RunWindows, f: np.ndarray, y: np.ndarray, form: str = "wk,wk...->w..."
) -> np.ndarray:
    """Integrals of terms over a run's windows, shape (equations, windows, ...).

    With the form `wk,wk...->wk...`, each point's part of them, shape (equations, windows, length, ...).
    """
    slopes = enumerate(derivative_weights(plan, w, f.shape[1]))
    weigh = functools.partial(np.einsum, form)
    return np.stack([weigh(w.weight, f[w.rows, k]) + weigh(slope, y[w.rows, k]) for k, slope in slopes])


def derivative_weights(plan: StatePlan, w: RunWindows, equations: int) -> list[np.ndarray]:
    """Factor of y in the windows of each equation: the derivative of the window, from integration by parts. For the
    equation of an angle reading, minus its second derivative."""
    return [-w.bend if plan.angle and k == plan.electrical else w.slope for k in range(equations)]


def covariance_factor(
    plan: StatePlan, w: RunWindows, sd: np.ndarray, terms: EquationTerms, disturbances: np.ndarray
) -> np.ndarray:
    """Cholesky factor of the covariance of some windows. `disturbances`: torque and voltage that the model does not
    explain (`disturbance_intensities`).
    """
    equations, (points, channels) = terms.f.shape[1], sd.shape
    f_factors, y_factors = terms.by_reading
    noise = []
    for k, slope in enumerate(derivative_weights(plan, w, equations)):
        reading_noise = w.weight[..., None] * f_factors[w.rows, k] + slope[..., None] * y_factors[w.rows, k]
        disturbance = np.zeros((*w.rows.shape, equations))
        disturbance[..., k] = disturbances[k] * w.weight / np.sqrt(w.steps)
        noise.append(np.concatenate([reading_noise * sd[w.rows], disturbance], -1))
    all_noise = np.concatenate(noise)
    sources = channels + equations
    column = np.tile(w.rows, (equations, 1))[..., None] * sources + np.arange(sources)
    row = np.broadcast_to(np.arange(len(all_noise))[:, None, None], all_noise.shape)
    noise_by_source = sparse.csr_matrix(
        (all_noise.ravel(), (row.ravel(), column.ravel())), shape=(len(all_noise), points * sources)
    )
    covariance = (noise_by_source @ noise_by_source.T).toarray()
    return np.linalg.cholesky(covariance + np.diag(FLOOR * np.maximum(np.diag(covariance), 1e-300)))


def disturbance_intensities(defect: np.ndarray, noise: np.ndarray, unit_variance: np.ndarray) -> np.ndarray:
    """Intensity of white noise in the terms of each equation, in addition to the noise of the readings.

    A model error is not white. But without such noise, windows weighted for a precise instrument would see only the
    fastest part of the error, and parameters would follow it. 0 if the noise of the readings explains the errors.

    Args:
        defect: error of each window, shape (windows, equations).
        noise: variance of these errors due to the readings.
        unit_variance: variance due to white noise of intensity 1.
    """
    excess = np.mean(defect**2 - noise, 0)
    chance = CHANCE * np.sqrt(2 * np.sum(noise**2, 0) / APART) / len(defect)
    return np.where(excess > chance, np.sqrt(np.maximum(excess, 0.0) / np.mean(unit_variance, 0)), 0.0)
