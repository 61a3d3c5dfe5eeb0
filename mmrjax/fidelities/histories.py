"""Fidelity `drive` on a given time grid, with derivatives in many directions at low cost.

The rates are those of `drive`. The method is implicit with fixed steps: SDIRK2, two stages, order 2, L-stable and
stiffly accurate (Alexander, Diagonally implicit Runge-Kutta methods for stiff O.D.E.'s, SIAM J. Numer. Anal. 14
(1977)). Derivatives follow from the implicit function theorem, stage by stage: linear equations with the matrix of
Newton's method at the solution. A further direction costs one tangent of the rates per stage, instead of a rollout.
The Rodas4 of `drive` takes two thirds of the time for a run on the same grid. For each direction, however, it needs
six stages and the derivative of a Jacobian. On a fixed grid no error control shortens its steps at kinks of friction
(measured in docs/lab/figures.md).

After a jump of the voltage the current lags by L / R, often much less than a step. SDIRK2 leaves up to a fifth of the
jump at the end of such a step. The lag of the last jump therefore decays exponentially in every step, and the method
solves for the rest. This is an integrating factor (Lawson, Generalized Runge-Kutta processes for stable systems with
large Lipschitz constants, SIAM J. Numer. Anal. 4 (1967)).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mmrjax.fidelities.drive import (
    CURRENT,
    GROUND,
    MOTOR,
    drive_rates,
    drive_start,
    drive_units,
    moving,
    sampled_unknowns,
    state_of_unknowns,
    winding_rate,
)
from mmrjax.fidelities.rest import HELD, shaft_direction, standing_signals
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Pair, Scalar, Times
from mmrjax.model.rig import interpolate
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals
from mmrjax.numerics.batch_flow import compute_if_needed
from mmrjax.numerics.linear_equations import invert, solve
from mmrjax.numerics.rosenbrock import Unknowns

T = TypeVar("T")

_GAMMA = 1 - 0.5**0.5
#: Lengths of the two parts of a step, one for each stage, as shares of the step.
_WEIGHED = np.array([1 - _GAMMA, _GAMMA])
#: Most Newton steps of a stage, which starts from the solution of the last one, and the residual allowed, in the
#: units of the unknowns (10 A, 1000 rad/s, 1 m/s).
NEWTON, SOLVED = 30, 1e-9
#: First step [s] and growth of the steps with time [-]. `START`: after the start of a robot that may slide on its
#: ground. `CHANGE`: after the start of a shaft, or a change of the input by its largest value.
START, CHANGE = (1e-5, 0.02), (1e-4, 0.25)
#: The second pair for a load with backlash; and the longest step [s].
LOOSE, LONGEST = (1e-5, 0.08), 2.5e-3
#: Most steps of a run at a step of LONGEST; a longer run has longer steps.
STEPS = 8000
#: Conditions that drive the current.
DRIVING = ("voltage", "duty", "open", "motor_current", "goal")
#: Increase of the current for the slope of its rate, which gives its time constant [10 A].
MORE = 1e-3
#: Number of searches for the moment at which a shaft comes to rest: on a line from the start of the step, then by
#: Newton's method.
TURNS = 3
WAITS = TURNS + 1
#: Number of steps whose linearised equations are computed together.
BLOCK = 32


def time_grid(
    times: Float[np.ndarray, " times"],
    changes: Float[np.ndarray, " changes"] | None = None,
    sizes: Float[np.ndarray, " changes"] | None = None,
    longest: float | Float[np.ndarray, " intervals"] = LONGEST,
    start: tuple[float, float] = START,
    change: tuple[float, float] = CHANGE,
    parts: int = 1,
) -> np.ndarray:
    """Instants from 0 to the last of `times` [s], including `times` and `changes`.

    Args:
        changes: times of changes of the motors' command [s].
        sizes: size of each change relative to a usual one. The first step after a smaller change is longer.
        longest: longest step, if `STEPS` allows it [s]. An array has a value for each interval between `times`.
        start, change: first step and growth of the steps after the start and after changes.
        parts: number of equal steps into which each step is divided.
    """
    last = float(np.max(times, initial=0.0))
    changes = np.zeros(0) if changes is None else np.asarray(changes, float)
    sizes = np.ones(len(changes)) if sizes is None else np.asarray(sizes, float)
    is_inside = (changes > 0) & (changes < last)
    grow_starts, first_steps = np.append(0.0, changes[is_inside]), np.append(start[0], change[0] / sizes[is_inside])
    growth = np.append(start[1], np.full(is_inside.sum(), change[1]))
    requested_times, times = times, np.unique(np.concatenate([grow_starts, np.asarray(times, float)]))
    longest = np.maximum(longest, last / STEPS) if np.size(longest) else LONGEST  # one row has no interval
    longest = np.broadcast_to(longest, max(len(requested_times) - 1, 1))
    longest = longest[np.clip(np.searchsorted(requested_times, times[:-1], side="right") - 1, 0, len(longest) - 1)]
    interval_index = np.searchsorted(grow_starts, times[:-1], side="right") - 1  # the last change before each instant
    interval_start, first_steps, growth = (
        grow_starts[interval_index],
        first_steps[interval_index],
        growth[interval_index],
    )
    knee = np.maximum((longest - first_steps) / growth, 0.0)

    def step_count(t: np.ndarray) -> np.ndarray:  # number of steps up to t: ∫ dt / min(longest, first + grows t)
        growing_steps = np.log1p(growth * np.minimum(t, knee) / first_steps) / growth
        return growing_steps + np.maximum(t - knee, 0.0) / longest

    begin_count, end_count, knee_count = map(
        step_count, (times[:-1] - interval_start, times[1:] - interval_start, knee)
    )
    instants = []
    for k in range(len(times) - 1):
        count = max(1, int(np.ceil(end_count[k] - begin_count[k] - 1e-9)))
        counts = np.linspace(begin_count[k], end_count[k], count, endpoint=False)
        growing_time = first_steps[k] / growth[k] * np.expm1(growth[k] * np.minimum(counts, knee_count[k]))
        instants.append(interval_start[k] + growing_time + np.maximum(counts - knee_count[k], 0.0) * longest[k])
        instants[-1][0] = times[k]
    all_instants = np.concatenate([*instants, times[-1:]])
    return np.interp(
        np.arange((len(all_instants) - 1) * parts + 1) / parts, np.arange(len(all_instants)), all_instants
    )


def _split_conditions(conditions: Conditions) -> tuple[Conditions, Conditions]:
    """Conditions that change between instants, and constant ones. Each has None in the other's fields."""
    return eqx.partition(conditions, lambda x: jnp.ndim(x) > 0)


def first_conditions_and_state(robot: Robot, conditions: Conditions) -> tuple[Conditions, Unknowns]:
    """Conditions and state of a run at its first instant."""
    changing, constant = _split_conditions(conditions)
    first_conditions = eqx.combine(jax.tree.map(lambda x: x[0], changing), constant)
    return first_conditions, drive_start(robot, first_conditions)


class LinearisedRun(eqx.Module):
    """A solved run and its equations linearised along it: the response of the run to a change of its rates.

    The change at the end of a step has three parts. `carries` multiplies the change before the step, `gains` the
    change of the rates at each stage, and `lags` the change of the current's rates at its start.

    Attributes:
        begins, ends: unknowns at the beginning and end of every step, shape (steps, unknowns).
        stage_unknowns: unknowns at both stages, where the equations are linearised, shape (steps, 2, unknowns).
        directions: see `RunStates`.
        passes: True for steps in which a shaft stops or leaves rest.
        clock: start of a step, and the times of its stages [s], shape (steps, 3).
        sampled: for a controller with a rate, unknowns before each step, which a sample changes, and the factor of
            that change in the one at the step's end. None: no rate.
    """

    begins: Float[Array, "steps unknowns"]
    ends: Float[Array, "steps unknowns"]
    stage_unknowns: Float[Array, "steps 2 unknowns"]
    directions: Float[Array, "steps 2"]
    passes: Bool[Array, " steps"]
    clock: Float[Array, "steps 3"]
    carries: Float[Array, "steps unknowns unknowns"]
    gains: Float[Array, "steps 2 unknowns unknowns"]
    lags: Float[Array, "steps rates unknowns"]
    sampled: tuple[Float[Array, "steps unknowns"], Float[Array, "steps unknowns unknowns"]] | None = None


def _stopped_by_clamp(conditions: Conditions, y: Array) -> Array:
    """Unknowns, or their derivatives by row, without motion if a clamp holds the output."""
    if conditions.held is None:
        return y
    return jnp.where(conditions.held > 0.5, y.at[np.array([MOTOR, GROUND])].set(0.0), y)


def _at_start_of_step(robot: Robot, conditions: Conditions, length: Scalar, y: Unknowns) -> Unknowns:
    """Unknowns with which a step begins: stopped by a clamp, or read by a controller with a rate."""
    if robot.controller is None or not robot.controller.rate:
        return _stopped_by_clamp(conditions, y)
    y = _stopped_by_clamp(conditions, y)
    return jnp.where(length > 0, sampled_unknowns(robot, conditions, y), y)


def _unit_vector_of_current(y: Unknowns) -> Unknowns:
    """Unit vector of the current among the unknowns."""
    return jnp.eye(len(y), dtype=y.dtype)[CURRENT]


class CurrentLag(eqx.Module):
    """Difference of a current from its settled value after a jump of the voltage, which decays within a step.

    Attributes:
        begin, end: difference at the begin and end of a step.
        decay: rate of the decay [1/s].
        means: means over the parts of a step, as its stages need them.
    """

    begin: Float[Array, ""]
    means: Pair
    end: Float[Array, ""]
    decay: Float[Array, ""]


class RunStep(eqx.Module):
    """One time step of a run, or all of them, with fields of shape (steps, ...).

    Attributes:
        length: length [s].
        since: time from the last jump of the current's command to the begin of the step [s].
        begun: 0 before the first jump of a run that starts from rest, otherwise 1.
        before, now: the changing conditions before that jump and in the step.
        before: None if no lag follows a jump.
    """

    length: Array
    since: Array
    begun: Array
    before: Conditions | None
    now: Conditions

    def all_conditions(self, constant: Conditions) -> Conditions:
        """All conditions during the step."""
        return eqx.combine(self.now, constant)

    def rates_at_start(
        self, constant: Conditions, rate: Callable[[Array, Conditions], Array], y: Unknowns
    ) -> Float[Array, "rates ..."]:
        """Rates of the current at the start of the step, for the input before and after the last jump.

        The third is for the new input and a slightly larger current, which gives the time constant. None if no lag
        follows. Before a run the input is 0.
        """
        if self.before is None:
            return jnp.zeros((0, *rate(y, self.all_conditions(constant)).shape))
        now = self.all_conditions(constant)
        before = eqx.combine(self.before, constant)
        inputs_before = [x if x is None else self.begun * x for x in (before.duty, before.motor_current)]
        before = eqx.tree_at(lambda c: [c.duty, c.motor_current], before, inputs_before, is_leaf=lambda x: x is None)
        states = jnp.stack([y, y, y + MORE * _unit_vector_of_current(y)])
        stacked = jax.tree.map(lambda before, now: jnp.stack([before, now, now]), before, now)
        return jax.vmap(rate)(states, stacked)


def _slopes(speed: Array, times: Times) -> Array:
    """Slopes of the lines between the imposed speeds of instants, 0 in steps of no length."""
    length = jnp.diff(times)
    return jnp.where(length > 0, jnp.diff(speed) / jnp.where(length > 0, length, 1.0), 0.0)


def run_steps(conditions: Conditions, times: Times) -> tuple[RunStep, Conditions]:
    """All steps of a run, and the conditions that do not change.

    In a step an imposed speed follows the line between the instants. At an instant it has the acceleration that the
    conditions state.
    """
    changing, constant = _split_conditions(conditions)
    now = jax.tree.map(lambda x: x[:-1], changing)
    if changing.motor_speed is not None and now.motor_acceleration is not None:
        now = eqx.tree_at(lambda c: c.motor_acceleration, now, _slopes(changing.motor_speed, times))
    has_jumped = jnp.zeros(len(times) - 1, bool)
    for x in (getattr(now, name) for name in DRIVING):
        if x is not None:
            has_jumped |= jnp.concatenate([jnp.zeros(1, bool), x[1:] != x[:-1]])
    jump_index = jax.lax.cummax(jnp.where(has_jumped, jnp.arange(len(has_jumped)), 0))
    before = jax.tree.map(lambda x: x[jnp.maximum(jump_index - 1, 0)], now)
    starts_at_rest = conditions.begin is None
    begun = jnp.where((jump_index == 0) & starts_at_rest, 0.0, 1.0).astype(times.dtype)
    since = times[:-1] - times[jump_index]
    return RunStep(jnp.diff(times), since, begun, before if conditions.motor_speed is None else None, now), constant


def _lag_of_step(
    rates: Float[Array, " rates"],
    step: RunStep,
    current: Scalar,
    limit: Scalar,
    parts: Pair,
    wait: Scalar = 0.0,
) -> CurrentLag:
    """Lag of a step after the last jump, from the rates at its start: the remainder of its decay.

    `parts` and `wait` as of `_decay_over_parts`. None if the driver's limit acts on the `current`, which then follows
    the limit at once.
    """
    if not len(rates):
        return _decay_over_parts(jnp.zeros(()), jnp.zeros(()), parts, wait)
    slope = (rates[1] - rates[2]) / MORE
    decays = slope > 0  # except when a diode begins to block
    decay = jnp.where(decays, slope, 1.0)
    transient = (rates[0] - rates[1]) / decay * jnp.exp(-decay * step.since)
    decays &= jax.lax.stop_gradient(jnp.abs(current - transient)) <= limit
    return _decay_over_parts(jnp.where(decays, transient, 0.0), decay, parts, wait)


def _decay_over_parts(begin: Array, decay: Array, parts: Pair, wait: Scalar = 0.0) -> CurrentLag:
    """Lag in two parts of a step [s], from its value at the start. `wait` lies between them [s]."""
    second_start = parts[0] + wait
    begins = begin * jnp.exp(-decay * jnp.stack([jnp.zeros(()), second_start]))
    z = decay * parts
    means = jnp.where(z > 0, -jnp.expm1(-z) / jnp.where(z > 0, z, 1.0), 1.0) * begins
    return CurrentLag(begin, means, begin * jnp.exp(-decay * (second_start + parts[1])), decay)


def _lag_rates(robot: Robot, constant: Conditions, step: RunStep, y: Unknowns) -> Float[Array, " rates"]:
    """Rates that determine the lag of a step, see `RunStep.rates_at_start`."""
    return step.rates_at_start(constant, lambda y, conditions: winding_rate(robot, conditions, y), y)


def _lag_of_robot(robot: Robot, constant: Conditions, step: RunStep, y: Unknowns) -> CurrentLag:
    return _lag_of_step(
        _lag_rates(robot, constant, step, y), step, y[CURRENT], _current_limit(robot), step.length * _WEIGHED
    )


def _current_limit(robot: Robot) -> Scalar:
    """The driver's current limit in the unit of the current."""
    return robot.driver.current_limit / drive_units(robot)[CURRENT]


def _solve_stage(
    rates: Callable[[Array], Array], offset: Array, guess: Array, h: Array, lag_mean: Array, decay: Array
) -> Array:
    """Solves Y = known + γ h f(Y) for the unknowns without the lag. The lag acts by its mean."""
    offset = offset + _GAMMA * h * decay * lag_mean

    def residual(y: Array) -> Array:
        return y - offset - _GAMMA * h * rates(y + lag_mean)

    def newton(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        count, y, _ = state
        matrix, value = jax.jacfwd(lambda y: (residual(y),) * 2, has_aux=True)(y)
        step = solve(matrix, value)
        # Over a kink of the friction law full steps can alternate without end.
        trials = y - jnp.array([0.1, 0.4, 1.0], y.dtype)[:, None] * step
        residual_size = jnp.max(jnp.abs(jax.vmap(residual)(trials)), 1)
        best = jnp.where(residual_size[0] < residual_size[1], trials[0], trials[1])
        return (
            count + 1,
            jnp.where(residual_size[2] <= jnp.min(residual_size), trials[2], best),
            jnp.min(residual_size),
        )

    def is_unsolved(state: tuple[Array, Array, Array]) -> Array:
        return (state[0] < NEWTON) & (state[2] > SOLVED)

    _, y, error = jax.lax.while_loop(is_unsolved, newton, (jnp.asarray(0), guess, jnp.asarray(jnp.inf, guess.dtype)))
    return jnp.where(error <= SOLVED, y, jnp.nan)


class RunStates(eqx.Module):
    """A solved run, step by step.

    Attributes:
        stages: unknowns at both stages of every step, without lags.
        ends: states at the end of each step.
        directions: directions of a shaft (see `shaft_direction`) at the start and end of a step. They differ if it
            stops or leaves rest within the step.
        before: time in such a step until it stops, or leaves rest [s].
        since: start of the last part of a step [s], later if friction holds the shaft after it stops.
        rest: unknowns at that moment.
    """

    stages: Float[Array, "steps 2 unknowns"]
    ends: Float[Array, "steps unknowns"]
    directions: Float[Array, "steps 2"]
    before: Float[Array, " steps"]
    since: Float[Array, " steps"]
    rest: Float[Array, "steps unknowns"]


class _StepPart(eqx.Module):
    """A step, or its part before or after a shaft stops, or while it waits at rest.

    Attributes:
        phase: 0 for the whole step, 1 to `TURNS` for iterations of the part before rest. Then `WAITS` while friction
            still holds the shaft, and the remaining part.
        begin: unknowns at its start.
        lag: lag of the current at its start.
        since, length: start and length of the part [s].
        direction, next_direction: direction in which a shaft turns, and after it has waited.
        before, stages, end: see `RunStates`.
    """

    phase: Array
    begin: Unknowns
    lag: Array
    since: Array
    length: Array
    direction: Array
    next_direction: Array
    before: Array
    stages: Float[Array, "2 unknowns"]
    end: Unknowns


def solve_states(robot: Robot, conditions: Conditions, times: Times) -> RunStates:
    """Solves the equations of one run from standstill.

    Friction jumps when a shaft turns through rest. Each step therefore uses the friction of one direction. A step in
    which the shaft stops is split at that moment (Filippov systems; Leine and Nijmeijer, Dynamics and Bifurcations of
    Non-Smooth Mechanical Systems, 2004).

    Args: as for `history_signals`.
    """
    steps, constant = run_steps(conditions, times)
    first_conditions, first_state = first_conditions_and_state(robot, conditions)
    # change of the unknowns with motor speed when shafts and robot move as one, in their units
    units = drive_units(robot)
    travel_per_motor_angle = robot.chassis(first_conditions.configuration).radius / robot.gearbox.ratio
    joint_motion = (
        jnp.zeros(len(units)).at[MOTOR].set(1.0).at[GROUND].set(travel_per_motor_angle * units[MOTOR] / units[GROUND])
    )

    def take_step(y: Array, step: RunStep) -> tuple[Array, RunStates]:
        conditions = step.all_conditions(constant)
        y = _at_start_of_step(robot, conditions, step.length, y)
        lag = _lag_of_robot(robot, constant, step, y)
        rates = functools.partial(drive_rates, robot, conditions)

        def next_part(part: _StepPart) -> _StepPart:
            part_lag = _decay_over_parts(part.lag, lag.decay, part.length * _WEIGHED)
            part_begin = part.begin - part_lag.begin * _unit_vector_of_current(y)

            def solve_next_stage(starts: tuple[Array, Array], mean: Array) -> tuple[tuple[Array, Array], Array]:
                rates_in_direction = functools.partial(rates, direction=part.direction)
                stage_result = _solve_stage(
                    rates_in_direction, *starts, part.length, mean * _unit_vector_of_current(y), part_lag.decay
                )
                return (part_begin + (1 - _GAMMA) / _GAMMA * (stage_result - part_begin), stage_result), stage_result

            stages = jax.lax.scan(solve_next_stage, (part_begin, part_begin), part_lag.means)[1]
            end = stages[1] + part_lag.end * _unit_vector_of_current(y)
            speed_before, speed_after = part.begin[MOTOR], end[MOTOR]
            seeks_rest = jnp.where(part.phase == 0, part.direction * speed_after < 0, part.phase < TURNS)
            comes_to_rest, has_waited, unknowns_at_rest = (
                part.phase == TURNS,
                part.phase == WAITS,
                end - speed_after * joint_motion,
            )
            speed_drop = speed_before - speed_after  # 0 in a part of no length, of a step that begins at rest
            time_on_line = part.length * speed_before / jnp.where(speed_drop == 0, 1.0, speed_drop)
            motor_acceleration = rates(end, direction=part.direction)[MOTOR]
            time_by_newton = part.length - speed_after / jnp.where(motor_acceleration == 0, 1.0, motor_acceleration)
            time_to_rest = jnp.clip(jnp.where(part.phase == 0, time_on_line, time_by_newton), 0.0, step.length)
            since = part.since + jnp.where(comes_to_rest | has_waited, part.length, 0.0)
            direction, next_direction, wait = _direction_in_part(
                robot, conditions, unknowns_at_rest, step.length - since
            )
            length_left = jnp.where(comes_to_rest & (wait > 0), wait, step.length - since)
            phase_after_rest = jnp.where(wait > 0, WAITS, WAITS + 1)
            return _StepPart(
                jnp.where(
                    seeks_rest, part.phase + 1, jnp.where(comes_to_rest, phase_after_rest, WAITS + 2 - has_waited)
                ),
                jnp.where(comes_to_rest, unknowns_at_rest, jnp.where(has_waited, end, part.begin)),
                jnp.where(comes_to_rest | has_waited, part_lag.end, part.lag),
                since,
                jnp.where(seeks_rest, time_to_rest, length_left),
                jnp.where(comes_to_rest, direction, jnp.where(has_waited, part.next_direction, part.direction)),
                jnp.where(comes_to_rest, next_direction, part.next_direction),
                jnp.where(comes_to_rest, part.length, part.before),
                stages,
                end,
            )

        direction, next_direction, wait = _direction_in_part(robot, conditions, y, step.length)
        phase = jnp.where(wait > 0, WAITS, 0)
        length = jnp.where(wait > 0, wait, step.length)
        zero = jnp.zeros(())
        whole_step = _StepPart(
            phase, y, lag.begin, zero, length, direction, next_direction, wait, jnp.stack([y, y]), y
        )
        last = jax.lax.while_loop(lambda part: part.phase < WAITS + 2, next_part, whole_step)
        directions = jnp.stack([direction, last.direction])
        return last.end, RunStates(last.stages, last.end, directions, last.before, last.since, last.begin)

    return jax.lax.scan(take_step, first_state, steps)[1]


def _direction_in_part(robot: Robot, conditions: Conditions, y: Array, length: Array) -> tuple[Array, Array, Array]:
    """Direction of a shaft in a part of a step, after it has waited, and that time (see `shaft_direction`).

    0 if shafts and load stop separately. It waits at most for the part's length [s].
    """
    if not robot.moves_as_one:
        return jnp.zeros(()), jnp.zeros(()), jnp.zeros(())
    direction, wait = shaft_direction(robot, conditions, state_of_unknowns(robot, y))
    direction, wait = jnp.where(wait <= length, direction, HELD), jnp.where(wait <= length, wait, 0.0)
    return jnp.where(wait > 0, HELD, direction), direction, wait


def linearise_run(
    robot: Robot, conditions: Conditions, times: Times, states: RunStates | None = None
) -> LinearisedRun:
    """A solved run, with its equations linearised along it.

    Args: as for `history_signals`, and `states`: its states, if computed.
    """
    run = solve_states(robot, conditions, times) if states is None else states
    steps, constant = run_steps(conditions, times)
    first_state = first_conditions_and_state(robot, conditions)[1]
    before = jnp.concatenate([first_state[None], run.ends[:-1]])
    start_of_step = lambda step, y: _at_start_of_step(robot, step.all_conditions(constant), step.length, y)  # noqa: E731
    begins = jax.vmap(start_of_step)(steps, before)
    sampled = robot.controller is not None and robot.controller.rate > 0
    # A step to rest and the one from it use an approximant of the exponential. For a current that lags by a quarter
    # of such a part, implicit Euler would keep a fifth of the decayed excess.
    passes = (run.directions[:, 0] != run.directions[:, 1]) | (run.since > 0)
    h = steps.length
    spans = jnp.where(passes[:, None], jnp.stack([run.before, h - run.since], 1), _GAMMA * h[:, None])
    rest_and_wait = run.rest, jnp.where(passes, run.since - run.before, 0.0)
    middle = times[:-1] + spans[:, 0]
    clock = jnp.stack([times[:-1], middle, times[1:]], 1)

    def linearise_step(inputs: tuple) -> tuple[Array, Array, Array, Array, Array | None]:
        before, begin, end, stages, (rest, wait), directions, spans, passes, step = inputs
        conditions = step.all_conditions(constant)
        identity = jnp.eye(len(end), dtype=end.dtype)
        current = _unit_vector_of_current(end)

        lag_by_begin, rate = jax.jacfwd(lambda y: (_lag_rates(robot, constant, step, y),) * 2, has_aux=True)(begin)
        parts = jnp.where(passes, spans, step.length * _WEIGHED)
        lagging = lambda r: (_lag_of_step(r, step, begin[CURRENT], _current_limit(robot), parts, wait),) * 2  # noqa: E731
        by_rate, lag = jax.jacfwd(lagging, has_aux=True)(rate)
        lags = jnp.stack([lag.begin, lag.begin * jnp.exp(-lag.decay * (spans[0] + wait)), lag.end])
        ends = jnp.stack([begin, rest, end]) - lags[:, None] * current
        stage_unknowns = jnp.where(passes, (ends[1:] + ends[:-1]) / 2, stages) + lag.means[:, None] * current
        slopes = jax.vmap(jax.jacfwd(lambda y, direction: drive_rates(robot, conditions, y, direction)))(
            stage_unknowns, directions
        )
        z = spans[:, None, None] * slopes
        weight = jnp.where(passes, identity - z / 2 + z @ z / 6, identity)  # Padé (0, 3): 1 / (1 - z + z²/2 - z³/6)
        first, second = jax.vmap(invert)(identity - z @ weight)
        passes_rest = passes & (directions[0] != HELD)
        directions_at_rest = directions.at[1].set(jnp.where(wait > 0, HELD, directions[1]))
        jump = compute_if_needed(
            passes_rest, _sensitivity_jump, (robot, conditions, rest, directions_at_rest), jnp.zeros_like(end)
        )
        # The start of the second stage depends on the first stage and on the change before the step.
        by_first = jnp.where(passes, identity + jump[:, None] * identity[MOTOR], (1 - _GAMMA) / _GAMMA * identity)
        by_before = jnp.where(passes, 0.0, 1 - (1 - _GAMMA) / _GAMMA) * identity
        carried_first = by_first @ first
        carries = second @ (carried_first + by_before)
        gains = jnp.stack([spans[0] * second @ carried_first, spans[1] * second]) @ weight
        # The lag reduces the current at a step's start and acts on both stages; its remainder is added at the end.
        by_means = jnp.einsum("sij,sj->si", gains, slopes[:, :, CURRENT] + lag.decay * current)
        by_decay = lag.means @ gains[:, :, CURRENT]
        lags = jnp.outer(by_rate.begin, -carries[:, CURRENT]) + by_rate.means.T @ by_means
        lags = lags + jnp.outer(by_rate.end, current) + jnp.outer(by_rate.decay, by_decay)
        carries = carries + lags.T @ lag_by_begin
        if not sampled:
            return stage_unknowns, _stopped_by_clamp(conditions, carries.T).T, gains, lags, None
        return (
            stage_unknowns,
            carries @ jax.jacfwd(functools.partial(start_of_step, step))(before),
            gains,
            lags,
            carries,
        )

    scan_inputs = before, begins, run.ends, run.stages, rest_and_wait, run.directions, spans, passes, steps
    stage_unknowns, carries, gains, lags, start_factors = _steps_of_blocks(
        jax.lax.map(jax.vmap(linearise_step), _arrange_in_blocks(scan_inputs)), len(h)
    )
    samples = (before, start_factors) if sampled else None
    return LinearisedRun(
        begins, run.ends, stage_unknowns, run.directions, passes, clock, carries, gains, lags, samples
    )


@eqx.filter_custom_jvp
def _unknowns_at_ends(
    robot: Robot,
    conditions: Conditions,
    times: Times,
    solved_run: RunStates | LinearisedRun,
) -> Array:
    """Unknowns at the end of every step of a solved run, with their derivatives with respect to the robot."""
    return solved_run.ends


@_unknowns_at_ends.def_jvp
def _ends_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    """Tangents with respect to the robot's parameters."""
    (robot, conditions, times, states), input_tangents = primals, tangents[0]
    linearised = states if isinstance(states, LinearisedRun) else linearise_run(robot, conditions, times, states)

    def change(law: Callable[[Robot], Array]) -> Array:
        value, tangent = eqx.filter_jvp(law, (robot,), (input_tangents,))
        return jnp.zeros_like(value) if tangent is None else tangent

    def source(_: Array, y: Array, conditions_of_step: Conditions, direction: Array) -> Array:
        return change(lambda r: drive_rates(r, conditions_of_step, y, direction))

    def sample(y: Array, conditions_of_step: Conditions, length: Array) -> Array:
        return change(lambda r: _at_start_of_step(r, conditions_of_step, length, y))

    begin = change(lambda r: first_conditions_and_state(r, conditions)[1])
    return states.ends, run_response(conditions, linearised, source, lambda t, y, dy, _: dy, begin, sample)


def run_response(
    conditions: Conditions,
    run: LinearisedRun,
    source: Callable[[Array, Array, Conditions, Array], Array],
    observe: Callable[[Array, Array, Array, Conditions], Array],
    begin: Array,
    sample: Callable[[Array, Conditions, Array], Array] | None = None,
) -> Array:
    """Response of a run to small changes of its rates of change.

    Args:
        conditions: as for `history_signals`.
        run: the run.
        source: (time, state, conditions, `direction` of `balances.moving_signals`) → change of the rates, shape
            (unknowns, ...).
        observe: (time, state, its change, conditions) → quantity to return at the end of every step.
        begin: change of the state at the first instant.
        sample: (state, conditions, length of a step) → change of the state with which the step begins.

    Sources within a block of steps are computed together. The sequential part is one product per step.
    """
    steps, constant = run_steps(conditions, jnp.append(run.clock[:, 0], run.clock[-1, 2]))

    def contribution(run: LinearisedRun, step: RunStep) -> Array:
        """Contribution of the sources of a step, at its end."""
        conditions = step.all_conditions(constant)
        source_terms = jax.vmap(lambda t, y, direction: source(t, y, conditions, direction))(
            run.clock[1:], run.stage_unknowns, run.directions
        )
        tangents = jnp.tensordot(run.gains, source_terms, ((0, 2), (0, 1)))
        at_start = lambda y, step_conditions: source(run.clock[0], y, step_conditions, run.directions[0])[CURRENT]  # noqa: E731
        of_lag = step.rates_at_start(constant, at_start, run.begins)
        tangents = tangents + jnp.tensordot(run.lags, of_lag, ((0,), (0,)))
        if run.sampled is None or sample is None:
            return tangents
        before, factor = run.sampled
        return tangents + factor @ sample(before, conditions, step.length)

    def propagate(dy: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        dy = jnp.tensordot(step[0], dy, 1) + step[1]
        return dy, dy

    def block(dy: Array, inputs: tuple) -> tuple[Array, Array]:
        run, step, next_conditions = inputs
        last, changes = jax.lax.scan(propagate, dy, (run.carries, jax.vmap(contribution)(run, step)))
        observe_all = jax.vmap(lambda t, y, dy, changing: observe(t, y, dy, eqx.combine(changing, constant)))
        return last, observe_all(run.clock[:, 2], run.ends, changes, next_conditions)

    scan_inputs = run, steps, jax.tree.map(lambda x: x[1:], _split_conditions(conditions)[0])
    return _steps_of_blocks(jax.lax.scan(block, begin, _arrange_in_blocks(scan_inputs))[1], len(run.clock))


def _arrange_in_blocks(steps: T) -> T:
    """Data of each step, arranged in blocks of steps. The last block is padded with the last step."""

    def pad(x: Array) -> Array:
        x = jnp.concatenate([x, jnp.repeat(x[-1:], -len(x) % BLOCK, 0)])
        return x.reshape(len(x) // BLOCK, BLOCK, *x.shape[1:])

    return jax.tree.map(pad, steps)


def _steps_of_blocks(blocks: T, count: int) -> T:
    """Inverse of `_arrange_in_blocks` for this number of steps."""
    return jax.tree.map(lambda x: x.reshape(x.shape[0] * BLOCK, *x.shape[2:])[:count], blocks)


def _sensitivity_jump(robot: Robot, conditions: Conditions, y: Unknowns, directions: Pair) -> Unknowns:
    """Jump of the unknowns' sensitivity at a passage through rest, per motor speed before it: (f⁺ - f⁻) / f⁻.

    The moment of rest moves by -1 / f⁻ (Filippov systems; Leine and Nijmeijer 2004, Section 7.3).
    """
    before, after = jax.vmap(lambda direction: drive_rates(robot, conditions, y, direction))(directions)
    return (after - before) / before[MOTOR]


def history_signals(
    robot: Robot,
    conditions: Conditions,
    times: Times,
    linearised: LinearisedRun | None = None,
    indices: Int[Array, " places"] | None = None,
) -> Signals:
    """Signals of one run on a time grid, from standstill or as in `Rig.begins`.

    Fields have shape (times,) or (places,).

    Args:
        robot: its parameters may be tracers. Derivatives are forward, exact for these steps, and only with respect to
            the robot.
        conditions: one run. Each field scalar, or of shape (times,): the value of an instant acts until the next one,
            and the signals of that instant use it.
        times: times from 0 on, as from `time_grid` [s]. Repeated instants are steps of no length.
        linearised: the run, from `linearise_run`, if computed.
        indices: indices of the instants to return. None: all.

    A run whose equations could not be solved is not finite from there on. Shafts and a load that move as one rest if
    friction holds them. For others friction at rest is smooth: gravity makes a resting robot creep, below a tenth of
    V_s.
    """
    changing, constant = _split_conditions(conditions)
    ys, directions = _unknowns_of_run(robot, conditions, times, linearised)
    states = ys, jnp.append(directions[:, 0], directions[-1, 1]), changing
    if indices is not None:
        states = jax.tree.map(lambda x: x[indices], states)

    def signals_at(y: Array, direction: Array, changing_now: Conditions) -> Signals:
        instant_conditions = eqx.combine(changing_now, constant)
        return signals_of_instant(
            robot, instant_conditions, sampled_unknowns(robot, instant_conditions, y), direction
        )

    return jax.vmap(signals_at)(*states)


def _unknowns_of_run(
    robot: Robot, conditions: Conditions, times: Times, linearised: LinearisedRun | None
) -> tuple[Float[Array, "times unknowns"], Float[Array, "steps 2"]]:
    """Unknowns at every instant, and `directions` of every step."""
    constant_robot = jax.lax.stop_gradient(robot)
    run = solve_states(constant_robot, conditions, times) if linearised is None else linearised
    ends = _unknowns_at_ends(robot, conditions, times, run)
    return jnp.concatenate([first_conditions_and_state(robot, conditions)[1][None], ends]), run.directions


def signals_of_instant(robot: Robot, conditions: Conditions, y: Array, direction: Array) -> Signals:
    """Signals of an instant, in static equilibrium if friction or a clamp holds shafts and load.

    At the instant at which a clamp stops them, the signals before it.
    """
    state = state_of_unknowns(robot, y)
    signals = moving(robot, conditions, state)
    if not robot.moves_as_one or conditions.motor_speed is not None:
        return signals
    is_held = (direction == HELD) & (y[MOTOR] == 0)
    return jax.tree.map(lambda a, b: jnp.where(is_held, a, b), standing_signals(robot, conditions, state), signals)


class StepCourse(eqx.Module):
    """Course of a run within its steps. Signals have fields of shape (steps,).

    Attributes:
        first: signals at the begin of the step.
        begin, end: ends of the straight line that the signals follow, apart from a decaying lag.
        decays: exponent of that decay over the step, shape (steps,).
    """

    first: Signals
    begin: Signals
    end: Signals
    decays: Float[Array, " steps"]

    @staticmethod
    def read(steps: tuple[Array, ...], share: Float[Array, " steps"]) -> Float[Array, "steps ..."]:
        """Readings at a fraction of each step.

        Args:
            steps: readings at `first`, `begin` and `end`, shape (steps, ...), and `decays`.
        """
        first, begin, end, decays = steps
        decay_factor = jnp.reshape(jnp.exp(-decays * share), (*share.shape, *[1] * (first.ndim - share.ndim)))
        return interpolate(begin, end, share) + decay_factor * (first - begin)


def course_between_instants(
    robot: Robot,
    conditions: Conditions,
    times: Times,
    linearised: LinearisedRun | None = None,
    step_indices: Int[Array, " places"] | None = None,
) -> StepCourse:
    """Course of one run between its instants, for the run of `history_signals`.

    Args: as for `history_signals`, and `step_indices`: steps to return, each by the index of its first instant.
    """
    ys, directions = _unknowns_of_run(robot, conditions, times, linearised)
    steps, constant = run_steps(conditions, times)
    instants = _split_conditions(conditions)[0]
    conditions_before, conditions_after = (
        jax.tree.map(lambda x, cut=cut: x[cut], instants) for cut in (slice(-1), slice(1, None))
    )
    course_inputs = ys[:-1], ys[1:], steps, conditions_before, conditions_after, directions
    if step_indices is not None:
        course_inputs = jax.tree.map(lambda x: x[step_indices], course_inputs)

    def course_of_step(
        y: Array,
        after: Array,
        step: RunStep,
        conditions_before: Conditions,
        conditions_after: Conditions,
        directions: Array,
    ) -> StepCourse:
        conditions = step.all_conditions(constant)
        y = sampled_unknowns(robot, conditions, y)
        if step.before is None:  # the imposed quantity is itself linear
            first = signals_of_instant(robot, eqx.combine(conditions_before, constant), y, directions[0])
            return StepCourse(
                first,
                first,
                signals_of_instant(robot, eqx.combine(conditions_after, constant), after, directions[1]),
                jnp.zeros(()),
            )
        stopped_unknowns = _stopped_by_clamp(conditions, y)
        current_vector = _unit_vector_of_current(y)
        lag = _lag_of_robot(robot, constant, step, stopped_unknowns)
        states = jnp.stack([y, stopped_unknowns - lag.begin * current_vector, after - lag.end * current_vector])
        step_signals = jax.vmap(
            lambda *instant: jax.tree.map(jnp.asarray, signals_of_instant(robot, conditions, *instant))
        )(states, directions[np.array([0, 0, 1])])
        first, begin, end = (jax.tree.map(lambda x, k=k: x[k], step_signals) for k in range(3))
        return StepCourse(first, begin, end, lag.decay * step.length)

    return jax.vmap(course_of_step)(*course_inputs)
