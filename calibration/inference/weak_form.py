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

    def left(robot: Robot, state: State, current: Scalar) -> Scalar:
        state_there = dataclasses.replace(state, current=current)
        return jnp.asarray(balances.driven_signals(robot, conditions, state_there, way).voltage_left)

    fixed: Any = jax.tree.map(lambda x: jax.lax.stop_gradient(x) if isinstance(x, jax.Array) else x, (robot, state))
    current = jnp.zeros(())
    for step in range(CURRENT_STEPS):
        value, slope = jax.jvp(lambda x: left(fixed[0], fixed[1], x), (current,), (jnp.ones(()),))
        value = left(robot, state, current) if step == CURRENT_STEPS - 1 else value
        current = current - value / slope
    return current


class _MeasuredStates(eqx.Module):
    """States that follow from the readings of one point.

    Attributes:
        turning: motor speed [rad/s] and current [A].
        lead: the part of the current by which it is later than its reading, see `_current_lead` [A].
        unit: reading of the motion channel per motor speed.
        per_ampere: reading of the current channel per ampere.
        errors: errors of the instruments, by channel.
    """

    turning: Scalar
    current: Scalar
    lead: Scalar
    unit: Scalar
    per_ampere: Scalar
    errors: dict[int, Scalar]


def _current_lead(robot: Robot, row: LogPoints) -> Scalar:
    """Mean current around a point, less the mean of its readings [A].

    A held voltage changes at a row, whose reading shows the current before. So the reading of a fast winding shows
    the mean voltage since the row before. That of a slow winding is the mean current around its row.
    """
    if "voltage" not in row.drift or robot.rig.between_rows == "linear":
        return jnp.zeros(())
    step, ratio = row.reach / REACH, robot.motor.inductance / robot.motor.resistance
    rise = jnp.maximum(ratio / step, 1e-6)
    share = 0.5 - rise - 1 / jnp.expm1(-1 / rise) - 1
    return -share * step * row.drift["voltage"] / robot.motor.resistance


def _measured_states(plan: StatePlan, robot: Robot, row: LogPoints, shown: Array) -> _MeasuredStates:
    """States that follow from the readings of one point, without slip."""
    conditions, names = row.imposed(robot.rig.delay), channels.channel_names(robot.channels)
    chassis = robot.chassis(conditions.configuration)
    none, one = jnp.zeros(()), jnp.ones(())

    def per_unit(k: int, state: State) -> Scalar:
        return channels.find_channel(names[k]).read(robot, balances.begin_signals(robot, conditions, state))

    current: Scalar = none
    turning: Scalar = none
    unit: Scalar = one
    per_ampere: Scalar = one
    lead: Scalar = none
    if conditions.motor_current is not None:
        current = jnp.asarray(conditions.motor_current)
    if plan.current >= 0:
        per_ampere = per_unit(plan.current, State(one, none, none, none, distance=none))
        lead = _current_lead(robot, row)
        current = shown[plan.current] / per_ampere + lead
    if plan.imposed == "motor_speed":
        turning = jnp.asarray(conditions.motor_speed)
    else:
        rolling = State(none, one, chassis.radius / robot.gearbox.ratio, none, distance=chassis.radius)
        unit = per_unit(plan.motion, rolling)
        if plan.angle:
            unit = unit / robot.gearbox.ratio  # that of the output by the output's
        turning = (row.rate if plan.angle else shown[plan.motion]) / unit
    rolls = chassis.radius * turning / robot.gearbox.ratio
    states = State(current, turning, rolls, none, row.memory, distance=chassis.radius * row.angle)
    first = balances.begin_signals(robot, conditions, states)
    errors = {
        k: balances.effects_sum(robot, first, "sensor", names[k]) for k in (plan.motion, plan.current) if k >= 0
    }
    if plan.current >= 0:
        current = current - errors[plan.current] / per_ampere
    if plan.motion >= 0 and not plan.angle:
        turning = turning - errors[plan.motion] / unit
    return _MeasuredStates(turning, current, lead, unit, per_ampere, errors)


def _rolling_signals(
    plan: StatePlan, robot: Robot, row: LogPoints, turning: Scalar, current: Scalar
) -> tuple[Signals, Scalar]:
    """Signals of a point with these states, and its current. If no channel shows the current, it follows from the
    equations.
    """
    conditions = row.imposed(robot.rig.delay)
    radius = robot.chassis(conditions.configuration).radius
    rolls, distance = radius * turning / robot.gearbox.ratio, radius * row.angle
    state = State(current, turning, rolls, jnp.zeros(()), row.memory, distance=distance)
    if plan.imposed == "voltage" and plan.current < 0:
        current = _solve_current(robot, conditions, state, row.way)
    return balances.rolling_signals(robot, conditions, dataclasses.replace(state, current=current), row.way), current


def equation_terms(
    plan: StatePlan, robot: Robot, row: LogPoints, shown: Array, probes: frozenset[str] = frozenset()
) -> tuple[Array, Array, Signals]:
    """Terms f and y of the equations at one point, and its signals.

    Args:
        row: one point of `LogPoints`, without the first axis.
        shown: its readings [SI], shape (channels,).
        probes: names of effects that read no signal.
    """
    names, chassis = channels.channel_names(robot.channels), robot.chassis(row.conditions.configuration)
    states, none = _measured_states(plan, robot, row, shown), jnp.zeros(())
    turning = states.turning
    if robot.has_ground and plan.mechanical and plan.travels:
        # The wheels turn faster than the load travels because of slip.
        first = balances.begin_signals(
            robot, row.conditions,
            State(states.current, turning, chassis.radius * turning / robot.gearbox.ratio, none, row.memory,
                  distance=chassis.radius * row.angle),
        )  # fmt: skip
        if any(e.balance == "slip" and e.name not in probes for e in robot.effects):
            first = _rolling_signals(plan, robot, row, turning, states.current)[0]
        turning = turning + balances.effects_sum(robot, first, "slip") * robot.gearbox.ratio / chassis.radius
    signals, current = _rolling_signals(plan, robot, row, turning, states.current)
    f, y = list[Any](), list[Any]()
    if plan.electrical:
        # Divided by the inductance, the rate of the current would be mostly noise, and a large inductance fit best.
        f.append(signals.voltage_left)
        y.append(signals.inductance * current)
    if plan.mechanical:
        # A torque, not an acceleration: the derivative by an inertia is then the motion, which states without noise
        # give. That of an acceleration is a torque, whose model error would enter its own instrument.
        carried = chassis.radius**2 * signals.mass / robot.sides if robot.has_ground else 0.0
        gear, turns = robot.gearbox, chassis.inertia + signals.inertia_added + carried
        inertia = inertia_reduced(robot.motor.inertia, gear.ratio, gear.efficiency_load, turns)
        read = (shown[plan.motion] - states.errors[plan.motion]) / states.unit if plan.angle else turning
        f.append(inertia * signals.acceleration_wheel)
        y.append(inertia * read / robot.gearbox.ratio)
    if plan.others:
        if robot.has_ground:
            creep = chassis.ground.speed_creep(signals.traction, signals.normal, signals.adhesion)
            slip_effects = balances.effects_sum(robot, signals, "slip")
            signals = dataclasses.replace(signals, speed=signals.speed_theoretical - creep - slip_effects)
        says = balances.sensor(robot, signals)
        f += [says[names[k]] - shown[k] for k in plan.others]
        y += [none] * len(plan.others)
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
    units = jax.vmap(lambda row: _measured_states(plan, robot, row, row.shown))(rows)
    read, count = jnp.stack([units.turning, units.current], 1), 1 + plan.electrical

    def step(before: tuple[Array, Array], given: tuple[LogPoints, Array]) -> tuple[tuple[Array, Array], Array]:
        (x, idle), (row, reading) = before, given

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

    states = jax.lax.scan(step, (read[0, :count], jnp.asarray(True)), (rows, read))[1]
    readings, rate = rows.shown, rows.rate
    if plan.electrical:
        readings = readings.at[:, plan.current].set((states[:, 1] - units.lead) * units.per_ampere)
    motion = states[:, 0] * units.unit
    if plan.angle:
        rate, motion = motion, jnp.cumsum(0.5 * (motion + jnp.roll(motion, 1)) * rows.since)
    readings = readings.at[:, plan.motion].set(motion)
    return dataclasses.replace(rows, shown=readings, rate=rate)


@functools.partial(compiling.compiled, options=compiling.SELDOM)
def _terms_with_derivatives(
    problem: Problem, plan: StatePlan, rows: LogPoints, z: Array, effects: tuple[linearization.ScoredEffect, ...]
) -> EquationTerms:
    """Terms at each point for coordinates z, with derivatives with respect to base parameters, readings and
    effects.
    """
    entering = tuple(
        dict.fromkeys((*linearization.PROBED, *(e.effect.balance for e in effects if e.effect.balance != "sensor")))
    )
    probes = tuple(linearization.balance_probe(b) for b in entering)
    size, names = z.size, channels.channel_names(problem.channels)

    def terms_of_point(row: LogPoints) -> tuple[Any, tuple[Any, Signals]]:
        def both(x: Array) -> tuple[Any, tuple[Any, Signals]]:
            base = problem.coordinates.robot(problem.base, x[:size])
            robot = linearization.with_probes(base, probes, x[size : size + len(probes)])
            f, y, signals = equation_terms(
                plan, robot, row, x[size + len(probes) :], frozenset(p.name for p in probes)
            )
            return (f, y), ((f, y), signals)

        return jax.jacfwd(both, has_aux=True)(jnp.concatenate([z, jnp.zeros(len(probes)), row.shown]))

    slopes, (values, signals) = jax.vmap(terms_of_point)(rows)
    base = problem.coordinates.robot(problem.base, z)
    memory = memory_by_point(base, rows, signals, effects)
    angle = rows.angle
    if plan.angle:  # The integrated readings have noise, which a gain of them would explain.
        units = jax.vmap(lambda row: _measured_states(plan, base, row, row.shown).unit)(rows)
        angle = rows.shown[:, plan.motion] / (units * base.gearbox.ratio)

    def entering_terms(signals: Signals, angle: Array, memory: list[Array]) -> Array:
        read = dataclasses.replace(signals, angle=angle)
        terms = [
            linearization.effect_terms(base, read if e.effect.balance == "sensor" else signals, (e,), [m])
            for e, m in zip(effects, memory, strict=True)
        ]
        return jnp.concatenate([jnp.zeros(0), *terms])

    entered = jax.vmap(entering_terms)(signals, angle, memory)
    # An effect changes an equation like a defect of its balance. An effect of an instrument changes it like a
    # negative reading, or like a defect of that equation if the reading follows from the states.
    instances = [e.effect for e in effects for _ in e.at]
    enters = np.array([size + entering.index(e.balance) if e.balance in entering else -1 for e in instances], int)
    channel_of = np.array([names.index(e.channel) if e.channel in names else 0 for e in instances], int)
    first = len(values[0][0]) - len(plan.others)

    def of_effects(slope: Array, direct: bool) -> Array:
        change = -slope[:, :, size + len(probes) :][:, :, channel_of]
        for k, channel in enumerate(plan.others):
            change = change.at[:, first + k].set(jnp.asarray(1.0 * (channel_of == channel)) * direct)
        return jnp.where(enters >= 0, slope[:, :, np.maximum(enters, 0)], change) * entered[:, None]

    def both(part: Callable[[Array, bool], Array]) -> tuple[Array, Array]:
        return part(slopes[0], True), part(slopes[1], False)

    return EquationTerms(
        values[0],
        values[1],
        both(lambda s, _: s[:, :, :size]),
        both(lambda s, _: s[:, :, size : size + len(linearization.PROBED)]),
        both(lambda s, _: s[:, :, size + len(probes) :]),
        both(of_effects),
        jax.tree.map(lambda x: jnp.broadcast_to(x, rows.time.shape), signals),
    )


def memory_by_point(
    robot: Robot, rows: LogPoints, signals: Signals, effects: tuple[linearization.ScoredEffect, ...]
) -> list[Array]:
    """Memory of each effect at each point of the log and of the effect's grid, shape (points, grid)."""
    count = rows.since.shape[0]
    nothing = [jnp.zeros((count, len(e.at))) for e in effects]

    def of_effect(scored: linearization.ScoredEffect) -> Array:
        def after(memory: Array, row: tuple[Array, Array, Signals]) -> tuple[Array, Array]:
            since, angle, signals = row
            speed, slope = value_and_slope(lambda m: linearization.memory_rates(robot, scored, signals, m), memory)
            start_memory = linearization.initial_memory(robot, scored, angle)
            memory = jnp.where(since > 0, memory + since * speed / (1 - since * slope), start_memory)
            return memory, memory

        start_memory = linearization.initial_memory(robot, scored, rows.angle[0])
        return jax.lax.scan(after, start_memory, (rows.since, rows.angle, signals))[1]

    return [zero if e.effect.memory_size is None else of_effect(e) for e, zero in zip(effects, nothing, strict=True)]


# --- a delay --------------------------------------------------------------------------------------------------


@functools.partial(compiling.compiled, options=compiling.SELDOM)
def _terms_by_coordinates(problem: Problem, plan: StatePlan, rows: LogPoints, z: Array) -> Array:
    """Terms f and y and their derivatives with respect to z, shape (2, points, equations, 1 + coordinates)."""

    def one(row: LogPoints) -> Array:
        def of(z: Array) -> tuple[Array, Array]:
            state_terms = jnp.stack(
                equation_terms(plan, problem.coordinates.robot(problem.base, z), row, row.shown)[:2]
            )
            return state_terms, state_terms

        slope, value = jax.jacfwd(of, has_aux=True)(z)
        return jnp.concatenate([value[..., None], slope], -1)

    return jnp.moveaxis(jax.vmap(one)(rows), 1, 0)


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
    rows, course, cut = points_and_windows(problem, plan, across=True)
    if not (cut and rows.drift):
        return file_delay
    time, since = np.asarray(rows.time), np.asarray(rows.since)
    step = float(np.median(since[since > 0]))
    apart = -(-sum(len(w.rows) for w in cut) // PROFILED)
    cut = [w.part(np.arange(0, len(w.rows), apart)) for w in cut]
    limit = TENTH * float(np.median([time[w.rows].max() for w in cut]))
    grid = np.linspace(-limit, limit, 2 * int(np.clip(limit / step, 8, DELAYS)) + 1)
    w = join_windows(cut)
    inside, places = np.unique(w.rows, return_inverse=True)
    w = dataclasses.replace(w, rows=places.reshape(w.rows.shape))
    rows = jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[inside]), rows)
    course = dataclasses.replace(course, cell=course.cell[inside])
    free = [k for k, name in enumerate(problem.coordinates.names) if name != DELAY]
    z, centre = np.zeros(len(problem.coordinates)), np.asarray(problem.data.centre)
    prompt = course.at(0.0)[0]

    def terms_with(imposed: dict[str, np.ndarray]) -> np.ndarray:
        """Terms at z with other imposed quantities, which do not depend on a delay."""
        conditions = rows.conditions
        for name, x in imposed.items():
            conditions = with_condition(conditions, name, jnp.asarray(x))
        points = dataclasses.replace(rows, conditions=conditions, drift={})
        return np.asarray(_terms_by_coordinates(problem, plan, points, jnp.asarray(z)))

    def profile(delays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Half of what -2 log L of the windows exceeds its least, and the coordinates, at each delay."""
        fixed = terms_with(prompt)
        change = {n: (terms_with({**prompt, n: x + np.ptp(x)}) - fixed) / np.ptp(x) for n, x in prompt.items()}
        # In units of what is imposed, whose factor then is 1: other residuals would shrink with a larger inertia.
        first = max(change, key=lambda n: float(np.abs(change[n][0, ..., 0]).mean() * np.ptp(prompt[n])))
        factor = change[first][0].mean(0)  # (equations, 1 + z)
        acts = np.flatnonzero(np.abs(factor[:, 0]) > 0)
        unit, growth = factor[acts, None, :1], factor[acts, None, 1:] / factor[acts, None, :1]
        prompt_integrals = _integrate_terms(plan, w, *fixed)[acts]
        weighted = {n: _integrate_terms(plan, w, x[0], x[1], "wk,wk...->wk...")[acts] for n, x in change.items()}
        costs, ends = [], []
        for delay in delays:
            means = course.at(float(delay))[0]
            integrals = prompt_integrals.copy()  # (equations, windows, 1 + z)
            for n, x in weighted.items():
                integrals += np.einsum("wk,ewk...->ew...", (means[n] - prompt[n])[w.rows], x)
            integrals[..., 1:] -= integrals[..., :1] * growth
            integrals /= unit
            size = np.sqrt(np.mean(integrals[..., 0] ** 2, 1))
            for _ in range(3):  # the noise of each equation is what the regression leaves
                flat = np.concatenate(integrals / np.maximum(size, 1e-300)[:, None, None])
                jacobian = np.concatenate([flat[:, 1:][:, free], np.eye(len(free))])
                target = np.concatenate([flat[:, 0], (z - centre)[free]])
                move = -np.linalg.lstsq(jacobian, target, rcond=None)[0]
                remainder = integrals[..., 0] + integrals[..., 1:][..., free] @ move
                size = np.sqrt(np.mean(remainder**2, 1))
            costs.append(np.sum(np.log(np.maximum(size, 1e-300))) * len(w.rows) * APART)
            ends.append(z.copy())
            ends[-1][free] += move
        return np.array(costs) - np.min(costs), np.stack(ends)

    best = 0.0
    for delays in (grid, grid, None):
        delays = best + np.linspace(-step, step, 17) if delays is None else delays
        cost, ends = profile(delays)
        inner = np.r_[np.inf, cost, np.inf]
        lows = (inner[1:-1] <= inner[:-2]) & (inner[1:-1] <= inner[2:]) & (cost < SAME)
        k = int(np.argmin(np.abs(delays)))
        k = k if cost[k] < SAME else int(np.argmin(np.where(lows, np.abs(delays), np.inf)))
        best, z = float(delays[k]), np.clip(ends[k], -NEAR, NEAR)
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
        plan, cut: channels that give the states, and the windows.
        centre, origin: prior mean, and coordinates of the terms.
        rows: points with states without noise.
        smooth: terms there.
        read: terms f and y at the readings.
    """

    z: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray
    signatures: np.ndarray
    plan: StatePlan
    cut: list[RunWindows]
    centre: np.ndarray
    origin: np.ndarray
    rows: LogPoints
    smooth: EquationTerms
    read: tuple[Any, Any]


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
    late = fit_delay(problem, plan)
    rows, _, cut = points_and_windows(problem, plan, late)
    cut = [w.part(k) for w in cut for k in np.array_split(np.arange(len(w.rows)), -(-len(w.rows) // TOGETHER))]
    equations = plan.electrical + plan.mechanical + len(plan.others)
    if equations * sum(len(w.rows) for w in cut) < ENOUGH * len(problem.coordinates):
        return None

    sd = np.asarray(rows.sd)

    def terms(rows: LogPoints, z: np.ndarray) -> EquationTerms:
        return jax.device_get(_terms_with_derivatives(problem, plan, rows, jnp.asarray(z), effects))

    def whiten(factors: list[np.ndarray], *given: tuple[Any, Any]) -> np.ndarray:
        windows = zip(factors, cut, strict=True)
        return np.concatenate([solve_triangular(x, window_errors(plan, w, *given), lower=True) for x, w in windows])

    coordinates, centre = problem.coordinates, np.array(problem.data.centre)
    if DELAY in coordinates.names:  # windows without jumps may not show it
        k = coordinates.names.index(DELAY)
        centre[k] = (late - float(coordinates.value(centre)[k])) / float(coordinates.spread[k])

    def linearise_about(origin: np.ndarray) -> tuple[Any, ...]:
        """Function that returns residuals and their derivatives at z, and derivatives of the terms with respect to
        effects. Then the factors of the covariance, states without noise, and terms there and at the readings, all
        of which are those of the origin.
        """
        smooth = with_smooth_states(problem, plan, rows, jnp.asarray(origin))
        exact, of_readings = terms(smooth, origin), terms(rows, origin)
        read = of_readings.f, of_readings.y  # the rest of a long log is large
        factors = _window_factors(plan, cut, sd, exact, read)
        offset = whiten(factors, read) - whiten(factors, (exact.f, exact.y))
        last: dict[bytes, tuple[np.ndarray, tuple[Any, Any]]] = {}

        def at(z: np.ndarray) -> tuple[np.ndarray, tuple[Any, Any]]:
            if (key := z.tobytes()) not in last:
                given = terms(smooth, z)
                errors = whiten(factors, (given.f[..., None], given.y[..., None]), given.by_z)
                errors[:, 0] += offset
                priors = np.concatenate([(z - centre)[:, None], np.eye(len(z))], 1)
                last.clear()
                last[key] = np.concatenate([errors, priors]), given.by_effects
            return last[key]

        return at, factors, smooth, exact, read

    z = centre
    try:
        for _ in range(ROUNDS):
            return_memory()  # terms of a long log
            origin = z
            at, factors, *states = linearise_about(origin)
            regression = least_squares(
                lambda z: at(z)[0][:, 0], z, lambda z: at(z)[0][:, 1:], method="lm",  # noqa: B023
                max_nfev=STEPS, xtol=SMALL, ftol=SMALL,
            )  # fmt: skip
            step = (regression.x - z) * min(1.0, FAR / max(float(np.abs(regression.x - z).max()), 1e-300))
            z = z + step
            residuals, by_effects = at(z)
            if np.abs(residuals[:, 1:] @ step).max() < SETTLED:
                break
        signatures = whiten(factors, by_effects)
    except (np.linalg.LinAlgError, ValueError):  # non-finite numbers
        return None
    return WeakFormFit(z, residuals[:, 0], residuals[:, 1:], signatures, plan, cut, centre, origin, *states)


def _window_factors(
    plan: StatePlan, cut: list[RunWindows], sd: np.ndarray, exact: EquationTerms, read: tuple[Any, Any]
) -> list[np.ndarray]:
    """Cholesky factors of the covariance of each part of the windows, with the disturbances of the equations.

    Args:
        exact, read: terms at states without noise, and at the readings.
    """
    equations = exact.f.shape[1]
    plain = [covariance_factor(plan, w, sd, exact, np.zeros(equations)) for w in cut]
    defect, noise, unit = (
        np.concatenate([x.reshape(equations, -1).T for x in parts])
        for parts in (
            [window_errors(plan, w, read) for w in cut],
            [np.sum(x**2, 1) for x in plain],
            [np.tile(np.sum(w.weight**2 / w.steps, 1), equations) for w in cut],
        )
    )
    unknown = disturbance_intensities(defect, noise, unit)
    return [covariance_factor(plan, w, sd, exact, unknown) for w in cut] if unknown.any() else plain


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
    plan: StatePlan, w: RunWindows, sd: np.ndarray, terms: EquationTerms, unknown: np.ndarray
) -> np.ndarray:
    """Cholesky factor of the covariance of some windows. `unknown`: torque and voltage that the model does not
    explain (`disturbance_intensities`).
    """
    equations, (points, channels) = terms.f.shape[1], sd.shape
    reading_factors, also = terms.by_reading
    noise = []
    for k, slope in enumerate(derivative_weights(plan, w, equations)):
        changed = w.weight[..., None] * reading_factors[w.rows, k] + slope[..., None] * also[w.rows, k]
        own_equations = np.zeros((*w.rows.shape, equations))
        own_equations[..., k] = unknown[k] * w.weight / np.sqrt(w.steps)
        noise.append(np.concatenate([changed * sd[w.rows], own_equations], -1))
    all_noise, wide = np.concatenate(noise), channels + equations
    column = np.tile(w.rows, (equations, 1))[..., None] * wide + np.arange(wide)
    row = np.broadcast_to(np.arange(len(all_noise))[:, None, None], all_noise.shape)
    flat = sparse.csr_matrix(
        (all_noise.ravel(), (row.ravel(), column.ravel())), shape=(len(all_noise), points * wide)
    )
    covariance = (flat @ flat.T).toarray()
    return np.linalg.cholesky(covariance + np.diag(FLOOR * np.maximum(np.diag(covariance), 1e-300)))


def disturbance_intensities(defect: np.ndarray, noise: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Intensity of white noise in the terms of each equation, in addition to the noise of the readings.

    A model error is not white. But without such noise, windows weighted for a precise instrument would see only the
    fastest part of the error, and parameters would follow it. 0 if the noise of the readings explains the errors.

    Args:
        defect: error of each window, shape (windows, equations).
        noise: variance of these errors due to the readings.
        unit: variance due to white noise of intensity 1.
    """
    more = np.mean(defect**2 - noise, 0)
    chance = CHANCE * np.sqrt(2 * np.sum(noise**2, 0) / APART) / len(defect)
    return np.where(more > chance, np.sqrt(np.maximum(more, 0.0) / np.mean(unit, 0)), 0.0)
