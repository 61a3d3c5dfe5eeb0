"""Maximum a posteriori estimation: least squares with exact Jacobians, from many starts at once.

Every search uses the solver in `levenberg_marquardt`.
"""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Callable, Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from calibration.inference.levenberg_marquardt import (
    NEAR,
    OneSidedLevenbergMarquardt,
    SearchState,
    half_squares,
    one_sided_step,
    zero_inactive_residuals,
)
from calibration.inference.problem import MISSING, Data, Observation, Problem
from mmrjax.compile.compiling import OVER_TIME, SELDOM, SMALL, Threads, compiled
from mmrjax.model.robot import Robot
from mmrjax.numerics.linear_equations import solve_lower

#: Predicted decrease of the objective below which a point is an optimum: in ½σ² (the remaining step is then below
#: a twentieth of a posterior sd, similar to the effect of the integrator's tolerance), and as a share.
DECREMENT, DECREMENT_SHARE = 1e-3, 1e-6
#: Change of z (and of the residuals, relative) at which a search ends; the second for rollouts.
TOLERANCE, TOLERANCE_LONG = 1e-6, 1e-3
#: Multiple of the decrease predicted by its linearisation that a search of rollouts may still achieve.
HOPELESS = 10.0
#: Number of last steps that predict the further decrease of a search of rollouts. Share of the objective by which
#: twice as many have to lower it. Where a load sticks, a rollout is not smooth, and its Jacobian promises more.
#: A run that breaks away from rest slowly makes the objective rough at 0.002 prior sds, although its Jacobian agrees
#: with finite differences to 1e-6. So each fit of the drivetrain's log takes 15 to 30 steps. 3 and 3e-4 saved 15 % of
#: the time and left the objectives higher by up to 1 %; half of the rows saved half of the time.
LATELY, STALLED = 5, 1e-4
#: Number of searches that have to end in one place, and their tolerance in the objective, for an optimum.
AGREE, SAME = 3, 0.01
#: Largest number of cores for parallel searches.
CORES = min(4, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)
#: Most rows of a table, times searches, in one batch.
AT_ONCE = 2**14

Z = Float[Array, " parameters"]
#: An array of JAX or NumPy.
Numbers = Any


class Optimum(eqx.Module):
    """End of one search.

    Attributes:
        z: coordinates, shape (parameters,).
        covariance: covariance of z, from the Gauss-Newton curvature (JᵀJ)⁻¹ of readings and priors, shape
            (parameters, parameters).
        sd: standard deviations, from the diagonal of `covariance`.
        cost: objective: half the sum of squared residuals of readings and priors [-].
        decrement: further decrease that the Gauss-Newton step predicts [-].
        converged: True if the decrement is small (see `DECREMENT`), whatever the solver reports.
        steps: number of iterations.
    """

    z: Z
    sd: Z
    covariance: Float[Array, "parameters parameters"]
    cost: Float[Array, ""]
    decrement: Float[Array, ""]
    converged: Bool[Array, ""]
    steps: Int[Array, ""]


def adhesion_penalty_slice(data: Data) -> slice:
    """Slice of the adhesion penalties in the residuals: one for each row, between readings and priors."""
    return slice(data.measured.size, data.measured.size + data.measured.shape[0])


def informative_residuals(data: Data) -> np.ndarray:
    """Indices of the residuals of readings and priors, without the adhesion penalties."""
    penalties = adhesion_penalty_slice(data)
    return np.r_[: penalties.start, penalties.stop : penalties.stop + data.centre.size]


def _evaluate_residuals(problem: Problem, z: Z) -> tuple[Array, Array, Observation]:
    """Residuals (readings, penalties with their signs, priors) at z, their Jacobian, and the observation.

    All three come from one evaluation of the model.
    """
    r, jacobian, observation, _ = problem.linearised(problem.robot, z)
    r = jnp.concatenate([r, z - problem.data.centre])
    return r, jnp.concatenate([jacobian, jnp.eye(z.size)]), observation


def _least_squares_solver(data: Data, is_rollout: bool) -> OneSidedLevenbergMarquardt:
    """Solver for fits to such data. `is_rollout`: True for rollouts."""
    penalties = adhesion_penalty_slice(data)
    tolerance = TOLERANCE_LONG if is_rollout else TOLERANCE
    return OneSidedLevenbergMarquardt(
        tolerance, penalties.start, penalties.stop, near=0.0 if is_rollout else NEAR, rough=is_rollout
    )


def optimum_at(jacobian: Array, r: Array, z: Array, data: Data, steps: Array, slope: Array) -> Optimum:
    """Optimum record of a point. `slope` is the Jacobian that predicts its decrement."""
    penalties = adhesion_penalty_slice(data)
    informative_jacobian = jacobian[informative_residuals(data)]
    inverse_factor = solve_lower(informative_jacobian.T @ informative_jacobian, jnp.eye(z.shape[0]))
    cost = half_squares(r, penalties)
    decrement = cost - half_squares(r + slope @ one_sided_step(r, slope, penalties, 0.0), penalties)
    converged = jnp.asarray(decrement < DECREMENT + DECREMENT_SHARE * cost)
    return Optimum(
        z,
        jnp.linalg.norm(inverse_factor, axis=0),
        inverse_factor.T @ inverse_factor,
        cost,
        decrement,
        converged,
        steps,
    )


def _begin_search(problem: Problem, start: Z) -> SearchState:
    """State of a problem's search before its first evaluation."""
    data = problem.data
    size = adhesion_penalty_slice(data).stop + start.shape[0]
    no_codes = jnp.zeros(data.measured.shape[0], int)
    aux = jax.eval_shape(lambda: Observation(data.measured, data.measured[:, 0], no_codes, no_codes))
    return _least_squares_solver(data, problem.observe.long).begin(start, size, aux)


def _advance_search(problem: Problem, state: SearchState, max_steps: int | Numbers) -> SearchState:
    """One step of a problem's search.

    The compiled program evaluates the model in one place, at the start of a step. The point that is accepted there is
    the result of the search, with its residuals, Jacobian and observation.
    """
    solver = _least_squares_solver(problem.data, problem.observe.long)
    next_state = solver.step(state, *_evaluate_residuals(problem, state.ahead))
    is_over = next_state.over | (next_state.steps >= max_steps) | ~jnp.all(jnp.isfinite(next_state.y))
    return dataclasses.replace(next_state, over=is_over)


def _optimum_of_state(state: SearchState, data: Data) -> Optimum:
    r = jnp.where(jnp.all(jnp.isfinite(state.y)), state.residual, jnp.nan)
    return optimum_at(state.jacobian, r, state.y, data, state.steps, state.slope)


def levenberg_marquardt(problem: Problem, start: Z, max_steps: int = 100) -> tuple[Optimum, Observation]:
    """Optimum of one search, and the observation there. It can be vmapped over problems and starts."""

    def advance(state: SearchState) -> SearchState:
        return _advance_search(problem, state, max_steps)

    state = jax.lax.while_loop(lambda state: ~state.over, advance, _begin_search(problem, start))
    return _optimum_of_state(state, problem.data), state.aux


class HeldCoordinates(eqx.Module):
    """Coordinates of which some are held: `z[k] = values[k]` where `held[k]` is True."""

    coordinates: Any
    held: Bool[Array, " parameters"]
    values: Z

    def robot(self, base: Robot, z: Z) -> Robot:
        return self.coordinates.robot(base, jnp.where(self.held, self.values, z))


@compiled
def fit_with_held(problem: Problem, starts: Array, is_held: Array, max_steps: int = 100) -> Optimum:
    """Optimum from each start with some of its coordinates held. Their priors are left out of its cost."""

    def fit(start: Z, is_held: Array) -> Optimum:
        coordinates = HeldCoordinates(problem.coordinates, is_held, start)
        of_start = problem.with_data(centre=jnp.where(is_held, start, problem.data.centre))
        return levenberg_marquardt(dataclasses.replace(of_start, coordinates=coordinates), start, max_steps)[0]

    return jax.vmap(fit)(starts, is_held)


class SearchMember(eqx.Module):
    """Data of one of many searches of a problem. For many, each field has a first axis of members.

    Attributes:
        start: initial coordinates, shape (parameters,).
        weight, measured, centre: fields of `Data`.
        active: set of effects, see `ActiveSet`. None: those of the problem.
    """

    start: Numbers
    weight: Numbers
    measured: Numbers
    centre: Numbers
    active: Numbers | None = None

    def problem(self, problem: Problem) -> Problem:
        """Problem of this search."""
        if self.active is not None:
            problem = dataclasses.replace(problem, coordinates=problem.coordinates.with_effects(self.active))
        return problem.with_data(weight=self.weight, measured=self.measured, centre=self.centre)


@functools.partial(compiled, options=SELDOM)
def _placeholder_searches(problem: Problem, members: SearchMember) -> SearchState:
    """States of searches that have already ended, as placeholders."""
    states = jax.vmap(lambda member: _begin_search(member.problem(problem), member.start))(members)
    return dataclasses.replace(states, over=jnp.ones_like(states.over))


def _start_fresh_searches(
    problem: Problem, members: SearchMember, fresh: Numbers, states: SearchState
) -> SearchState:
    """States of parallel searches after the `fresh` ones were reset to their starts."""

    def begin(member: SearchMember, fresh: Array, state: SearchState) -> SearchState:
        begun = _begin_search(member.problem(problem), member.start)
        return jax.tree.map(lambda new, old: jnp.where(fresh, new, old), begun, state)

    return jax.vmap(begin)(members, fresh, states)


_start_fresh_compiled = compiled(_start_fresh_searches, options=SELDOM)


def _step_unfinished(
    problem: Problem,
    members: SearchMember,
    states: SearchState,
    roots: tuple[Array, Array] | None,
    max_steps: Numbers,
) -> SearchState:
    """One step of each unfinished search. `roots`: solved rows of each, if a separate program solves them."""

    def advance(member: SearchMember, state: SearchState, roots: tuple[Array, Array] | None) -> SearchState:
        new = _advance_search(dataclasses.replace(member.problem(problem), roots=roots), state, max_steps)
        return jax.tree.map(lambda new, old: jnp.where(state.over, old, new), new, state)

    return jax.vmap(advance)(members, states, roots)


def _optima_of_states(problem: Problem, members: SearchMember, states: SearchState) -> Optimum:
    return jax.vmap(lambda member, states: _optimum_of_state(states, member.problem(problem).data))(members, states)


def _continue_searches(
    problem: Problem, members: SearchMember, fresh: Numbers, states: SearchState, enough: Numbers, max_steps: Numbers
) -> tuple[SearchState, Optimum]:
    """Continues parallel searches until `enough` of them have ended. `fresh` ones begin at their starts."""
    states = jax.lax.while_loop(
        lambda states: jnp.sum(states.over) < enough,
        lambda states: _step_unfinished(problem, members, states, None, max_steps),
        _start_fresh_searches(problem, members, fresh, states),
    )
    return states, _optima_of_states(problem, members, states)


@functools.partial(compiled, options=OVER_TIME)
def _solve_rows(problem: Problem, z: Numbers, active: Numbers | None) -> tuple[Array, Array]:
    """Result of `Observer.solve` at each of several z. Arguments as in `SearchMember`."""

    def solve_member(z: Array, active: Array | None) -> tuple[Array, Array] | None:
        coordinates = problem.coordinates if active is None else problem.coordinates.with_effects(active)
        return problem.observe.solve(coordinates.robot(problem.base, z))

    solutions = jax.vmap(solve_member)(z, active)
    assert solutions is not None  # of an observer with `solves_separately`
    return solutions


@functools.partial(compiled, options=OVER_TIME)
def _step_with_roots(
    problem: Problem, members: SearchMember, states: SearchState, roots: tuple[Array, Array], max_steps: Numbers
) -> tuple[SearchState, Optimum]:
    states = _step_unfinished(problem, members, states, roots, max_steps)
    return states, _optima_of_states(problem, members, states)


def _continue_searches_separately(
    problem: Problem, members: SearchMember, fresh: Numbers, states: SearchState, enough: Numbers, max_steps: Numbers
) -> tuple[SearchState, Optimum]:
    """`_continue_searches` for observers that solve rows by a separate program (`Observer.solves_separately`)."""
    states = _start_fresh_compiled(problem, members, fresh, states)
    while True:
        roots = _solve_rows(problem, states.ahead, members.active)
        states, results = _step_with_roots(problem, members, states, roots, max_steps)
        if np.asarray(states.over).sum() >= enough:
            return states, results


def with_solved_rows(problem: Problem, z: Z) -> Problem:
    """Problem with its rows solved at z. Unchanged if its observer needs no separate program."""
    if not problem.observe.solves_separately:
        return problem
    return dataclasses.replace(
        problem, roots=jax.tree.map(lambda x: x[0], solve_rows_at(problem, np.asarray(z)[None]))
    )


def solve_rows_at(problem: Problem, zs: Numbers) -> tuple[np.ndarray, np.ndarray]:
    """Solutions of the rows at several z (first axis), by the program of the searches."""
    count = problem.observe.searches_per_core(problem)
    active = getattr(problem.coordinates, "active", None)
    slots = None if active is None else np.repeat(np.asarray(active)[None], count, 0)
    padded = np.resize(zs, (-(-len(zs) // count) * count, zs.shape[1]))
    parts = [jax.device_get(_solve_rows(problem, part, slots)) for part in padded.reshape(-1, count, zs.shape[1])]
    return jax.tree.map(lambda *x: np.concatenate(x)[: len(zs)], *parts)


_continue_frequent = compiled(_continue_searches, options=SMALL)
_continue_rare = compiled(_continue_searches, options=SELDOM)


class SearchQueue:
    """Queue of members for a fixed number of parallel searches. Finished members are replaced by waiting ones.

    Attributes:
        waiting: members that wait for a place, the next one last.
        holds: member in each place, -1 if the place is empty.
        ended: result of each finished member.
    """

    def __init__(self, members: Iterable[int], count: int) -> None:
        """Queue of members, with `count` empty places."""
        self.waiting, self.holds = list(members)[::-1], np.full(count, -1)
        self.ended: dict[int, Any] = {}

    def __bool__(self) -> bool:
        return bool(self.waiting) or bool(self.taken.any())

    @property
    def taken(self) -> np.ndarray:
        """True for places with a member."""
        return self.holds >= 0

    @property
    def member(self) -> np.ndarray:
        """Member in each place. An arbitrary member in empty places."""
        return np.maximum(self.holds, 0)

    def fill(self) -> np.ndarray:
        """Moves waiting members into empty places. Returns these places."""
        fresh = np.flatnonzero(~self.taken)[: len(self.waiting)]
        self.holds[fresh] = [self.waiting.pop() for _ in fresh]
        return fresh

    def leave(self, is_over: np.ndarray, results: Any) -> None:
        """Removes members whose search has ended, and keeps their results, whose first axis is the place."""
        for place in np.flatnonzero(is_over & self.taken):
            self.ended[int(self.holds[place])] = jax.tree.map(lambda x: x[place], results)  # noqa: B023
            self.holds[place] = -1


def search_refilling(
    problem: Problem, members: SearchMember, max_steps: int, places: int
) -> tuple[Optimum, Observation]:
    """Searches for any number of members, as `levenberg_marquardt`, with a fixed number in parallel.

    Finished members are replaced by waiting ones, so no batch waits for its slowest member. One compiled program
    serves any number of members.

    Args:
        members: members along the first axis, as NumPy arrays.
        places: number of parallel searches on each core.

    Returns:
        The end of each search, and the observation there.
    """
    optima, state = _search_with_states(problem, members, max_steps, places)
    return optima, state.aux


def _search_with_states(
    problem: Problem, members: SearchMember, max_steps: int, places: int
) -> tuple[Optimum, SearchState]:
    """Results of `search_refilling`, with the state of the solver at the end of each search."""
    count = len(members.start)
    step_limit = np.asarray(max_steps)
    cores = min(CORES, -(-count // places))
    first_members = jax.tree.map(lambda x: np.repeat(x[:1], places, 0), members)
    placeholders = _placeholder_searches(problem, first_members)
    continue_searches = _continue_rare if getattr(problem.coordinates, "fitted_once", False) else _continue_frequent
    continue_searches = _continue_searches_separately if problem.observe.solves_separately else continue_searches

    def search_on_core(core: int) -> dict[int, Any]:
        queue = SearchQueue(range(core, count, cores), places)
        states = placeholders
        while queue:
            is_fresh = np.isin(np.arange(places), queue.fill())
            members_in_places = jax.tree.map(lambda x: x[queue.member], members)
            running = int(queue.taken.sum())
            enough = places - running + (max(1, places // 4) if queue.waiting else running)
            states, results = continue_searches(
                problem, members_in_places, is_fresh, states, np.asarray(enough), step_limit
            )
            queue.leave(*jax.device_get((states.over, (results, states))))
        return queue.ended

    if cores > 1:  # compiles the program once, by a call that takes no step
        continue_searches(problem, first_members, np.zeros(places, bool), placeholders, np.asarray(0), step_limit)
    with Threads(cores) as pool:
        results_by_member = {
            k: result for part in pool.map(search_on_core, range(cores)) for k, result in part.items()
        }
    return jax.tree.map(lambda *x: np.stack(x), *(results_by_member[k] for k in range(count)))


def linearise(problem: Problem, z: Z) -> tuple[Array, Array, Observation]:
    """Residuals (misfit, then priors) at z, their Jacobian, and the observation, by a program of the searches."""
    data = problem.data
    if problem.observe.long:
        r, jacobian, observation = linearise_rollout(problem, z)
    else:
        active = getattr(problem.coordinates, "active", None)
        search = SearchMember(z, data.weight, data.measured, data.centre, active)
        members = jax.tree.map(lambda x: np.asarray(x)[None], search)
        _, final_states = _search_with_states(problem, members, 1, problem.observe.searches_per_core(problem))
        state = jax.tree.map(lambda x: jnp.asarray(x[0]), final_states)
        r, jacobian, observation = state.residual, state.jacobian, state.aux
    return *clip_penalties(r, jacobian, data), observation


@functools.partial(compiled, options=SELDOM)
def clip_penalties(r: Array, jacobian: Array, data: Data) -> tuple[Array, Array]:
    """Residuals and Jacobian with penalties clipped at 0, for a linearisation without one-sided residuals.

    A reading with a non-finite derivative counts as not computed.
    """
    return zero_inactive_residuals(*mask_uncomputed(r, jacobian, data), adhesion_penalty_slice(data))


def mask_uncomputed(r: Array, jacobian: Array, data: Data) -> tuple[Array, Array]:
    """Residuals and Jacobian in which a reading with a non-finite derivative counts as not computed."""
    counts = jnp.concatenate([data.weight.ravel() > 0, jnp.ones(data.measured.shape[0] + jacobian.shape[1], bool)])
    computed = jnp.all(jnp.isfinite(jacobian), axis=1)
    return jnp.where(computed, r, MISSING * counts), jnp.where(computed[:, None], jacobian, 0.0)


@functools.partial(compiled, options=OVER_TIME)
def linearise_rollout(problem: Problem, z: Z) -> tuple[Array, Array, Observation]:
    """Result of `linearise` for a rollout, with negative penalties and their derivatives.

    If a step of the rollout is too long for its friction law (V_s small compared with μ_s), the run oscillates and
    its derivative grows without limit. Such a reading counts as not computed, if it has a weight.
    """
    r, jacobian, observation = _evaluate_residuals(problem, z)
    return *mask_uncomputed(r, jacobian, problem.data), observation


def evaluate_residuals(problem: Problem, z: Z) -> Array:
    """Residuals of `linearise` without the Jacobian. It uses the program of `observe_robot`, which saves a
    compilation.
    """
    observation = observe_robot(problem, problem.robot(z))
    return jnp.concatenate([problem.whitened(observation), z - problem.data.centre])


def search_rollout(
    problem: Problem,
    start: Z,
    max_steps: int = 100,
    tell: Callable[[int, float], None] = lambda steps, cost: None,
) -> tuple[Optimum, Observation, Observation]:
    """Search as `levenberg_marquardt`, with its loop in Python so that the rollout is compiled only once.

    It also ends if the next step would bring no relevant gain (a tenth of `DECREMENT`).

    Returns:
        The optimum, and the observations at the start and at the end.
    """
    state = _begin_search(problem, start)
    observation_at_start = None
    best: Optimum | None = None
    for steps in range(1, max_steps + 1):
        # A step after a rejected one is often rejected too; that needs no Jacobian, so the previous one remains.
        r = evaluate_residuals(problem, state.ahead) if state.rejected > 0 else None
        if r is None or best is None or 0.5 * jnp.sum(r**2) < best.cost:
            r, jacobian, observation = linearise_rollout(problem, state.ahead)
        observation_at_start = observation if observation_at_start is None else observation_at_start
        state, point = _step_search(state, (r, jacobian, observation), problem.data)
        done = bool(state.over)
        if best is None or state.rejected == 0:  # the first step only evaluates the start
            best = point
            done |= bool(point.decrement < 0.1 * (DECREMENT + DECREMENT_SHARE * point.cost))
        tell(steps, float(best.cost))
        if done:
            break
    assert best is not None and observation_at_start is not None
    return best, observation_at_start, state.aux


#: Function of members' coordinates and indices: residuals, penalties with their signs, their Jacobian and the
#: observation, as NumPy arrays; leading axis these members.
Evaluate = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, Observation]]


@functools.partial(compiled, options=SELDOM)
def _step_search(state: SearchState, evaluation: tuple[Array, Array, Any], data: Data) -> tuple[SearchState, Optimum]:
    """Next step of a search, and its best point."""
    new = _least_squares_solver(data, is_rollout=True).step(state, *evaluation)
    return new, _optimum_of_state(new, data)


def search_rollouts(
    evaluate: Evaluate,
    starts: Numbers,
    data: Data,
    weights: Numbers,
    max_steps: int,
    places: int,
    *,
    within: float = np.inf,
) -> tuple[Optimum, Observation]:
    """Searches of any number of members, as `levenberg_marquardt`, with the loop in Python so that rollouts are
    compiled once.

    Finished members are replaced by waiting ones. A search also ends if its last steps lowered the objective by too
    little (`STALLED`).

    Args:
        evaluate: function that evaluates the model for members.
        starts: initial coordinates, shape (members, coordinates).
        weights: weights of each member's readings, shape (members, rows, channels).
        places: number of parallel searches.
        within: distance from the lowest objective within which members with the same readings matter. A search ends
            if it cannot come that near: by `HOPELESS` times the predicted decrease of its step, or by the decrease of
            its last `LATELY` steps. `SAME` if all search the same optimum. All then end once `AGREE` of them have
            ended at one point and no other is lower.

    Returns:
        The end of each search, and the observation there.
    """
    starts = np.asarray(starts)
    weights = np.asarray(weights)
    solver = _least_squares_solver(data, is_rollout=True)
    queue = SearchQueue(range(len(starts)), len(starts) if within <= SAME else min(places, len(starts)))
    cost = np.full(len(starts), np.inf)
    ahead = starts[queue.member]
    cost_history = np.full((2 * LATELY, len(queue.member)), np.nan)
    searches: list[Any] = [None] * len(ahead)
    while queue:
        fresh = queue.fill()
        active_places = np.flatnonzero(queue.taken)
        # A step accepts or rejects the point to which the last one led; an accepted point becomes y.
        ahead[fresh], cost_history[:, fresh] = starts[queue.holds[fresh]], np.nan
        evaluated = evaluate(ahead[active_places], queue.holds[active_places])
        for j, k in enumerate(active_places):  # one at a time, so that one program serves any number of searches
            evaluation = jax.tree.map(lambda x: x[j], evaluated)  # noqa: B023
            if k in fresh:
                searches[k] = jax.device_get(solver.begin(ahead[k], evaluation[0].size, evaluation[2])), None
            searches[k] = jax.device_get(_step_search(searches[k][0], evaluation, data))
        results = [(state.over, state.steps, state.ahead, state.aux, point) for state, point in searches]
        is_finished, steps, ahead, observation, points = jax.tree.map(lambda *x: np.stack(x), *results)
        negligible_decrease = 0.1 * (DECREMENT + DECREMENT_SHARE * points.cost)
        is_over = is_finished | (steps >= max_steps) | (points.decrement < negligible_decrease)
        is_over = is_over | (cost_history[0] - points.cost < SAME + STALLED * points.cost)
        cost[queue.holds[active_places]] = points.cost[active_places]
        if within < np.inf:
            finished_members = np.r_[[*queue.ended], queue.holds[is_over & queue.taken]].astype(int)
            lowest = np.min(cost[finished_members], initial=np.inf)
            is_lower = queue.taken & ~is_over & (points.cost < lowest - SAME)
            agree = within <= SAME and np.sum(cost[finished_members] < lowest + SAME) >= AGREE and not is_lower.any()
            lowest_so_far = min(lowest, np.min(points.cost[queue.taken]))
            with np.errstate(invalid="ignore"):  # NaN of runs that cannot be simulated yet
                possible_decrease = HOPELESS * np.fmin(points.decrement, cost_history[LATELY] - points.cost)
            is_over = is_over | (points.cost - possible_decrease > lowest_so_far + within) | agree
        cost_history = np.concatenate([cost_history[1:], points.cost[None]])
        queue.leave(is_over, (points, observation))
    return jax.tree.map(lambda *x: np.stack(x), *(queue.ended[k] for k in range(len(starts))))


def search_starts(
    problem: Problem, starts: Float[Array, "starts parameters"]
) -> tuple[Optimum, Int[Array, "starts rows"], Int[Array, "starts rows"]]:
    """Searches from each start, in batches.

    Batches of `AT_ONCE` rows limit the memory. An interrupt takes effect between them.

    Returns:
        The end of each search, and the status of each row at its start and at its end.
    """
    data = problem.data
    if not problem.observe.solves_separately:
        size = min(len(starts), max(1, AT_ONCE // len(data.measured)))
        padded = np.resize(starts, (-(-len(starts) // size) * size, starts.shape[1]))  # one program for all batches
        parts = [jax.device_get(_search_starts(problem, z)) for z in padded.reshape(-1, size, starts.shape[1])]
        return jax.tree.map(lambda *x: np.concatenate(x)[: len(starts)], *parts)
    repeated_data = (
        np.repeat(np.asarray(x)[None], len(starts), 0) for x in (data.weight, data.measured, data.centre)
    )
    members = SearchMember(np.asarray(starts), *repeated_data)
    # A search of one step evaluates its start.
    first_results, final_results = (
        search_refilling(problem, members, steps, problem.observe.searches_per_core(problem)) for steps in (1, 100)
    )
    return final_results[0], first_results[1].status, final_results[1].status


@compiled
def _search_starts(problem: Problem, starts: Array | np.ndarray) -> tuple[Optimum, Array, Array]:
    def search(z: Any) -> tuple[Optimum, Array, Array]:
        optimum, observation = levenberg_marquardt(problem, z)
        return optimum, problem.observation(z).status, observation.status

    return jax.vmap(search)(starts)


def observe_robot(problem: Problem, robot: Robot) -> Observation:
    """Observation of any robot in each row of the problem, by a compiled program."""
    return problem.observe.read(robot) if problem.observe.solves_separately else _simulated_readings(problem, robot)


@functools.partial(compiled, options=OVER_TIME)
def _simulated_readings(problem: Problem, robot: Robot) -> Observation:
    return problem.observe(robot)


def observe_at(problem: Problem, z: Z) -> Observation:
    """Observation at z. For rollouts, by a program that the search has already compiled."""
    return linearise(problem, z)[2] if problem.observe.long else observe_robot(problem, problem.robot(z))
