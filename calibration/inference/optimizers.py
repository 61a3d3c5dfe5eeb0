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
#: twice as many have to lower it. (Where a load sticks, a rollout is not smooth, and its Jacobian promises more.)
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
    """Slice of the adhesion penalties among the residuals: one for each row, between readings and priors."""
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


def _least_squares_solver(data: Data, long: bool) -> OneSidedLevenbergMarquardt:
    """Solver for fits to such data. `long`: True for rollouts."""
    penalties, tolerance = adhesion_penalty_slice(data), TOLERANCE_LONG if long else TOLERANCE
    return OneSidedLevenbergMarquardt(
        tolerance, penalties.start, penalties.stop, near=0.0 if long else NEAR, rough=long
    )


def optimum_at(jacobian: Array, r: Array, z: Array, data: Data, steps: Array, slope: Array) -> Optimum:
    """Optimum record of a point. `slope` is the Jacobian that predicts its decrement."""
    penalties = adhesion_penalty_slice(data)
    informed = jacobian[informative_residuals(data)]
    half = solve_lower(informed.T @ informed, jnp.eye(z.shape[0]))
    cost = half_squares(r, penalties)
    decrement = cost - half_squares(r + slope @ one_sided_step(r, slope, penalties, 0.0), penalties)
    converged = jnp.asarray(decrement < DECREMENT + DECREMENT_SHARE * cost)
    return Optimum(z, jnp.linalg.norm(half, axis=0), half.T @ half, cost, decrement, converged, steps)


def _begin_search(problem: Problem, start: Z) -> SearchState:
    """State of a problem's search before its first evaluation."""
    data = problem.data
    size, codes = adhesion_penalty_slice(data).stop + start.shape[0], jnp.zeros(data.measured.shape[0], int)
    aux = jax.eval_shape(lambda: Observation(data.measured, data.measured[:, 0], codes, codes))
    return _least_squares_solver(data, problem.observe.long).begin(start, size, aux)


def _advance_search(problem: Problem, at: SearchState, max_steps: int | Numbers) -> SearchState:
    """One step of a problem's search.

    The compiled program evaluates the model in one place, at the start of a step. The point that is accepted there is
    the result of the search, with its residuals, Jacobian and observation.
    """
    solver = _least_squares_solver(problem.data, problem.observe.long)
    state = solver.step(at, *_evaluate_residuals(problem, at.ahead))
    is_over = state.over | (state.steps >= max_steps) | ~jnp.all(jnp.isfinite(state.y))
    return dataclasses.replace(state, over=is_over)


def _optimum_of_state(at: SearchState, data: Data) -> Optimum:
    r = jnp.where(jnp.all(jnp.isfinite(at.y)), at.residual, jnp.nan)
    return optimum_at(at.jacobian, r, at.y, data, at.steps, at.slope)


def levenberg_marquardt(problem: Problem, start: Z, max_steps: int = 100) -> tuple[Optimum, Observation]:
    """Optimum of one search, and the observation there. It can be vmapped over problems and starts."""

    def advance(at: SearchState) -> SearchState:
        return _advance_search(problem, at, max_steps)

    at = jax.lax.while_loop(lambda at: ~at.over, advance, _begin_search(problem, start))
    return _optimum_of_state(at, problem.data), at.aux


class HeldCoordinates(eqx.Module):
    """Coordinates of which some are held: `z[k] = values[k]` where `held[k]` is True."""

    coordinates: Any
    held: Bool[Array, " parameters"]
    values: Z

    def robot(self, base: Robot, z: Z) -> Robot:
        return self.coordinates.robot(base, jnp.where(self.held, self.values, z))


@compiled
def fit_with_held(problem: Problem, starts: Array, held: Array, max_steps: int = 100) -> Optimum:
    """Optimum from each start with some of its coordinates held. Their priors are left out of its cost."""

    def fit(start: Z, held: Array) -> Optimum:
        coordinates = HeldCoordinates(problem.coordinates, held, start)
        of_start = problem.with_data(centre=jnp.where(held, start, problem.data.centre))
        return levenberg_marquardt(dataclasses.replace(of_start, coordinates=coordinates), start, max_steps)[0]

    return jax.vmap(fit)(starts, held)


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
    at = jax.vmap(lambda member: _begin_search(member.problem(problem), member.start))(members)
    return dataclasses.replace(at, over=jnp.ones_like(at.over))


def _start_fresh_searches(problem: Problem, members: SearchMember, fresh: Numbers, at: SearchState) -> SearchState:
    """States of parallel searches after the `fresh` ones were reset to their starts."""

    def begin(member: SearchMember, fresh: Array, at: SearchState) -> SearchState:
        search_begin = _begin_search(member.problem(problem), member.start)
        return jax.tree.map(lambda new, old: jnp.where(fresh, new, old), search_begin, at)

    return jax.vmap(begin)(members, fresh, at)


_admitted = compiled(_start_fresh_searches, options=SELDOM)


def _step_unfinished(
    problem: Problem, members: SearchMember, at: SearchState, roots: tuple[Array, Array] | None, max_steps: Numbers
) -> SearchState:
    """One step of each unfinished search. `roots`: solved rows of each, if a separate program solves them."""

    def advance(member: SearchMember, at: SearchState, roots: tuple[Array, Array] | None) -> SearchState:
        new = _advance_search(dataclasses.replace(member.problem(problem), roots=roots), at, max_steps)
        return jax.tree.map(lambda new, old: jnp.where(at.over, old, new), new, at)

    return jax.vmap(advance)(members, at, roots)


def _optima_of_states(problem: Problem, members: SearchMember, at: SearchState) -> Optimum:
    return jax.vmap(lambda member, at: _optimum_of_state(at, member.problem(problem).data))(members, at)


def _continue_searches(
    problem: Problem, members: SearchMember, fresh: Numbers, at: SearchState, enough: Numbers, max_steps: Numbers
) -> tuple[SearchState, Optimum]:
    """Continues parallel searches until `enough` of them have ended. `fresh` ones begin at their starts."""
    at = jax.lax.while_loop(
        lambda at: jnp.sum(at.over) < enough,
        lambda at: _step_unfinished(problem, members, at, None, max_steps),
        _start_fresh_searches(problem, members, fresh, at),
    )
    return at, _optima_of_states(problem, members, at)


@functools.partial(compiled, options=OVER_TIME)
def _solve_rows(problem: Problem, z: Numbers, active: Numbers | None) -> tuple[Array, Array]:
    """Result of `Observer.solve` at each of several z. Arguments as in `SearchMember`."""

    def solve_member(z: Array, active: Array | None) -> tuple[Array, Array] | None:
        coordinates = problem.coordinates if active is None else problem.coordinates.with_effects(active)
        return problem.observe.solve(coordinates.robot(problem.base, z))

    solutions = jax.vmap(solve_member)(z, active)
    assert solutions is not None  # of an observer that is `apart`
    return solutions


@functools.partial(compiled, options=OVER_TIME)
def _step_with_roots(
    problem: Problem, members: SearchMember, at: SearchState, roots: tuple[Array, Array], max_steps: Numbers
) -> tuple[SearchState, Optimum]:
    at = _step_unfinished(problem, members, at, roots, max_steps)
    return at, _optima_of_states(problem, members, at)


def _continue_searches_separately(
    problem: Problem, members: SearchMember, fresh: Numbers, at: SearchState, enough: Numbers, max_steps: Numbers
) -> tuple[SearchState, Optimum]:
    """`_continue_searches` for observers whose rows are solved by a separate program (`Observer.apart`)."""
    at = _admitted(problem, members, fresh, at)
    while True:
        roots = _solve_rows(problem, at.ahead, members.active)
        at, results = _step_with_roots(problem, members, at, roots, max_steps)
        if np.asarray(at.over).sum() >= enough:
            return at, results


def with_solved_rows(problem: Problem, z: Z) -> Problem:
    """Problem with its rows solved at z. Unchanged if its observer needs no separate program."""
    if not problem.observe.apart:
        return problem
    return dataclasses.replace(
        problem, roots=jax.tree.map(lambda x: x[0], solve_rows_at(problem, np.asarray(z)[None]))
    )


def solve_rows_at(problem: Problem, zs: Numbers) -> tuple[np.ndarray, np.ndarray]:
    """Solutions of the rows at several z (first axis), by the program of the searches."""
    count, active = problem.observe.searches_per_core(problem), getattr(problem.coordinates, "active", None)
    slots = None if active is None else np.repeat(np.asarray(active)[None], count, 0)
    filled = np.resize(zs, (-(-len(zs) // count) * count, zs.shape[1]))
    parts = [jax.device_get(_solve_rows(problem, part, slots)) for part in filled.reshape(-1, count, zs.shape[1])]
    return jax.tree.map(lambda *x: np.concatenate(x)[: len(zs)], *parts)


_go_on_often = compiled(_continue_searches, options=SMALL)
_go_on_seldom = compiled(_continue_searches, options=SELDOM)


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

    def leave(self, over: np.ndarray, found: Any) -> None:
        """Removes members whose search has ended, and keeps their results. The first axis of `found` is the place."""
        for place in np.flatnonzero(over & self.taken):
            self.ended[int(self.holds[place])] = jax.tree.map(lambda x: x[place], found)  # noqa: B023
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
    count, step_limit = len(members.start), np.asarray(max_steps)
    cores = min(CORES, -(-count // places))
    first_members = jax.tree.map(lambda x: np.repeat(x[:1], places, 0), members)
    idle = _placeholder_searches(problem, first_members)
    go_on = _go_on_seldom if getattr(problem.coordinates, "fitted_once", False) else _go_on_often
    go_on = _continue_searches_separately if problem.observe.apart else go_on

    def search_on_core(core: int) -> dict[int, Any]:
        assigned, states = SearchQueue(range(core, count, cores), places), idle
        while assigned:
            fresh = np.isin(np.arange(places), assigned.fill())
            own_members = jax.tree.map(lambda x: x[assigned.member], members)
            running = int(assigned.taken.sum())
            enough = places - running + (max(1, places // 4) if assigned.waiting else running)
            states, results = go_on(problem, own_members, fresh, states, np.asarray(enough), step_limit)
            assigned.leave(*jax.device_get((states.over, (results, states))))
        return assigned.ended

    if cores > 1:  # compiles the program once, by a call that takes no step
        go_on(problem, first_members, np.zeros(places, bool), idle, np.asarray(0), step_limit)
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
        member = SearchMember(z, data.weight, data.measured, data.centre, active)
        members = jax.tree.map(lambda x: np.asarray(x)[None], member)
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
    state, first = _begin_search(problem, start), None
    best: Optimum | None = None
    for steps in range(1, max_steps + 1):
        # A step after a rejected one is often rejected too; that needs no Jacobian, so the previous one remains.
        r = evaluate_residuals(problem, state.ahead) if state.rejected > 0 else None
        if r is None or best is None or 0.5 * jnp.sum(r**2) < best.cost:
            r, jacobian, observation = linearise_rollout(problem, state.ahead)
        first = observation if first is None else first
        state, end = _step_search(state, (r, jacobian, observation), problem.data)
        done = bool(state.over)
        if best is None or state.rejected == 0:  # the first step only evaluates the start
            best = end
            done |= bool(end.decrement < 0.1 * (DECREMENT + DECREMENT_SHARE * end.cost))
        tell(steps, float(best.cost))
        if done:
            break
    assert best is not None and first is not None
    return best, first, state.aux


#: Function of members' coordinates and indices: residuals, penalties with their signs, their Jacobian and the
#: observation, as NumPy arrays; leading axis these members.
Evaluate = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, Observation]]


@functools.partial(compiled, options=SELDOM)
def _step_search(at: SearchState, evaluation: tuple[Array, Array, Any], data: Data) -> tuple[SearchState, Optimum]:
    """Next step of a search, and its best point."""
    new = _least_squares_solver(data, long=True).step(at, *evaluation)
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
    starts, weights, solver = np.asarray(starts), np.asarray(weights), _least_squares_solver(data, long=True)
    assigned = SearchQueue(range(len(starts)), len(starts) if within <= SAME else min(places, len(starts)))
    cost, ahead = np.full(len(starts), np.inf), starts[assigned.member]
    trail = np.full((2 * LATELY, len(assigned.member)), np.nan)
    searches: list[Any] = [None] * len(ahead)
    while assigned:
        fresh, going = assigned.fill(), np.flatnonzero(assigned.taken)
        # A step accepts or rejects the point to which the last one led; an accepted point becomes y.
        ahead[fresh], trail[:, fresh] = starts[assigned.holds[fresh]], np.nan
        evaluated = evaluate(ahead[going], assigned.holds[going])
        for j, k in enumerate(going):  # one at a time, so that one program serves any number of searches
            evaluation = jax.tree.map(lambda x: x[j], evaluated)  # noqa: B023
            if k in fresh:
                searches[k] = jax.device_get(solver.begin(ahead[k], evaluation[0].size, evaluation[2])), None
            searches[k] = jax.device_get(_step_search(searches[k][0], evaluation, data))
        results = [(s.over, s.steps, s.ahead, s.aux, end) for s, end in searches]
        finished, steps, ahead, observation, ends = jax.tree.map(lambda *x: np.stack(x), *results)
        small = 0.1 * (DECREMENT + DECREMENT_SHARE * ends.cost)
        is_over = finished | (steps >= max_steps) | (ends.decrement < small)
        is_over = is_over | (trail[0] - ends.cost < SAME + STALLED * ends.cost)
        cost[assigned.holds[going]] = ends.cost[going]
        if within < np.inf:
            done = np.r_[[*assigned.ended], assigned.holds[is_over & assigned.taken]].astype(int)
            lowest = np.min(cost[done], initial=np.inf)
            lower = assigned.taken & ~is_over & (ends.cost < lowest - SAME)
            agree = within <= SAME and np.sum(cost[done] < lowest + SAME) >= AGREE and not lower.any()
            so_far = min(lowest, np.min(ends.cost[assigned.taken]))
            with np.errstate(invalid="ignore"):  # NaN of runs that cannot be simulated yet
                hope = HOPELESS * np.fmin(ends.decrement, trail[LATELY] - ends.cost)
            is_over = is_over | (ends.cost - hope > so_far + within) | agree
        trail = np.concatenate([trail[1:], ends.cost[None]])
        assigned.leave(is_over, (ends, observation))
    return jax.tree.map(lambda *x: np.stack(x), *(assigned.ended[k] for k in range(len(starts))))


def search_starts(
    problem: Problem, starts: Float[Array, "starts parameters"]
) -> tuple[Optimum, Int[Array, "starts rows"], Int[Array, "starts rows"]]:
    """Searches from each start, in batches.

    Batches of `AT_ONCE` rows limit the memory. An interrupt takes effect between them.

    Returns:
        The end of each search, and the status of each row at its start and at its end.
    """
    data = problem.data
    if not problem.observe.apart:
        size = min(len(starts), max(1, AT_ONCE // len(data.measured)))
        filled = np.resize(starts, (-(-len(starts) // size) * size, starts.shape[1]))  # one program for all batches
        parts = [jax.device_get(_search_starts(problem, z)) for z in filled.reshape(-1, size, starts.shape[1])]
        return jax.tree.map(lambda *x: np.concatenate(x)[: len(starts)], *parts)
    tables = (np.repeat(np.asarray(x)[None], len(starts), 0) for x in (data.weight, data.measured, data.centre))
    members = SearchMember(np.asarray(starts), *tables)
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
    return problem.observe.read(robot) if problem.observe.apart else _simulated_readings(problem, robot)


@functools.partial(compiled, options=OVER_TIME)
def _simulated_readings(problem: Problem, robot: Robot) -> Observation:
    return problem.observe(robot)


def observe_at(problem: Problem, z: Z) -> Observation:
    """Observation at z. For rollouts, by a program that the search has already compiled."""
    return linearise(problem, z)[2] if problem.observe.long else observe_robot(problem, problem.robot(z))
