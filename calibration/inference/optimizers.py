"""Maximum a posteriori by Levenberg-Marquardt with exact Jacobians, from many starts at once; L-BFGS beside it."""

from __future__ import annotations

import concurrent.futures
import dataclasses
import functools
import itertools
import os
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int

from calibration.inference.normal_equations import backward, cholesky, forward
from calibration.inference.problem import MISSING, Data, Observation, Problem
from mmrjax.compiling import SELDOM, SMALL, compiled
from mmrjax.robot import Robot

#: Predicted decrease of the objective below which a point is an optimum: in ½σ² (the step left is then below
#: a twentieth of a posterior sd, about what the integrator's tolerance leaves of a rollout), and as a share.
DECREMENT, DECREMENT_SHARE = 1e-3, 1e-6
#: Rejected steps in a row after which a search ends, and change of z (and of the objective, relative) at which
#: it does; the second for rollouts.
PATIENCE = 12
#: Shares of the predicted fall of the objective below which a step is rejected and above which the next may be
#: longer, and by what the length of the next is then multiplied.
LITTLE, NEARLY_ALL = 0.01, 0.99
SHORTER, LONGER = 0.25, 3.5
TOLERANCE, TOLERANCE_LONG = 1e-6, 1e-3
#: How many times the decrease that its linearisation predicts a search of rollouts is given the hope of.
HOPELESS = 10.0
#: How many of them have to end in one place, to within so much of the objective, for it to be the optimum.
AGREE, SAME = 3, 0.01
#: Cores on which many searches run, at most.
CORES = min(4, os.cpu_count() or 1)

Z = Float[Array, " parameters"]
#: An array of JAX or NumPy.
Numbers = Any


class Pin(eqx.Module):
    """Coordinates held at a value: `z[k] = at[k]` where `held[k]`."""

    held: Bool[Array, " parameters"]
    at: Z

    def apply(self, z: Z) -> Z:
        return jnp.where(self.held, self.at, z)


def no_pin(size: int) -> Pin:
    """Nothing held."""
    return Pin(jnp.zeros(size, bool), jnp.zeros(size))


class Optimum(eqx.Module):
    """Where one search ended.

    Attributes:
        z: coordinates, shape (parameters,).
        covariance: of z, from the Gauss-Newton curvature (JᵀJ)⁻¹ of readings and priors, shape (parameters,
            parameters); sd: root of its diagonal.
        cost: objective, half the sum of squares of misfit and prior [-].
        decrement: decrease that the Gauss-Newton step from here still predicts [-].
        converged: whether the decrement is small (see `DECREMENT`); holds whatever the solver said.
        steps: iterations taken.
    """

    z: Z
    sd: Z
    covariance: Float[Array, "parameters parameters"]
    cost: Float[Array, ""]
    decrement: Float[Array, ""]
    converged: Bool[Array, ""]
    steps: Int[Array, ""]


def with_jacobian(function: Callable[[Z], Array]) -> Callable[[Z], Array]:
    """`function` with its Jacobian computed once, forward, wherever it is differentiated (either mode).

    Exact: implicit through the root of `steady`, through the rollout of `drive`. One evaluation of value
    and Jacobian together then serves every product with it, which a solver would else recompute.
    """

    @jax.custom_jvp
    def value(z: Z) -> Array:
        return function(z)

    @value.defjvp
    def derivative(primals: tuple[Z], tangents: tuple[Z]) -> tuple[Array, Array]:
        (z,), (dz,) = primals, tangents
        jacobian, out = jax.jacfwd(lambda x: (function(x),) * 2, has_aux=True)(z)
        return out, jacobian @ dz

    return value


def residuals(problem: Problem, data: Data, pin: Pin) -> Callable[[Z], Array]:
    """Residuals as a function of z: misfit, then prior; a held coordinate has a prior residual that keeps
    it where it is, so that the Jacobian has full rank."""

    def function(z: Z) -> Array:
        held = pin.apply(z)
        prior = jnp.where(pin.held, z - pin.at, z - data.centre)
        return jnp.concatenate([problem.misfit(held, data), prior])

    return with_jacobian(function)


def informing(data: Data) -> np.ndarray:
    """Indices of the residuals that carry information: readings and priors, not the penalty on adhesion."""
    readings, rows = data.measured.size, data.measured.shape[0]
    return np.r_[:readings, readings + rows : readings + rows + data.centre.size]


def _evaluated(problem: Problem, data: Data, pin: Pin) -> Callable[[Z], tuple[Array, Array, Observation]]:
    """Residuals (misfit, then prior), their Jacobian, and what the model says of every row, as a function of z: one
    evaluation serves all three."""

    def function(x: Z) -> tuple[Array, tuple[Array, Observation]]:
        seen = problem.observation(pin.apply(x))
        prior = jnp.where(pin.held, x - pin.at, x - data.centre)
        r = jnp.concatenate([problem.whitened(seen, data), prior])
        return r, (r, seen)

    def at(z: Z) -> tuple[Array, Array, Observation]:
        jacobian, (r, seen) = jax.jacfwd(function, has_aux=True)(z)
        return r, jacobian, seen

    return at


def _optimum(jacobian: Array, r: Array, z: Array, data: Data, pin: Pin, steps: Array) -> Optimum:
    informed = jacobian[informing(data)]
    lower = cholesky(informed.T @ informed)
    half = forward(lower, jnp.eye(z.shape[0]))
    sd = jnp.linalg.norm(half, axis=0)
    lower = cholesky(jacobian.T @ jacobian)
    decrement = 0.5 * jnp.sum(forward(lower, jacobian.T @ r) ** 2)
    held = jnp.where(pin.held, pin.at - data.centre, 0.0)
    cost = 0.5 * (jnp.sum(r**2) + jnp.sum(held**2))
    return Optimum(pin.apply(z), sd, half.T @ half, cost, decrement, _small(decrement, cost), steps)


def _small(decrement: Any, cost: Array) -> Array:
    return jnp.asarray(decrement < DECREMENT + DECREMENT_SHARE * cost)


def optimum(jacobian: np.ndarray, residual: np.ndarray, z: np.ndarray, data: Data) -> Optimum:
    """A point as an optimum, from its residuals (misfit, then prior) and their Jacobian, however these were found."""
    j, r, at = (jnp.asarray(x, float) for x in (jacobian, residual, z))
    return _optimum(j, r, at, data, no_pin(len(z)), jnp.asarray(0))


class Progress(eqx.Module):
    """A search between two steps.

    Attributes:
        y: the best point so far; found: residuals and Jacobian there, and what the model says.
        normal, gradient: J^T J and J^T r there.
        ahead: where the model is to be evaluated next; size: of the step to it, 1 / damping.
        steps: evaluations so far; rejected: those since y was found; over: whether the search has ended.
    """

    y: Z
    found: tuple[Float[Array, " residuals"], Float[Array, "residuals parameters"], Any]
    normal: Float[Array, "parameters parameters"]
    gradient: Z
    ahead: Z
    size: Float[Array, ""]
    steps: Int[Array, ""]
    rejected: Int[Array, ""]
    over: Bool[Array, ""]


def begin_at(start: Z, nowhere: tuple[Array, Array, Any]) -> Progress:
    """A search that has evaluated nothing yet.

    Args:
        nowhere: of the shapes of what it will find, all 0.
    """
    n, none = start.shape[0], jnp.asarray(0)
    return Progress(
        start, nowhere, jnp.zeros((n, n)), jnp.zeros(n), start, jnp.asarray(1.0), none, none, jnp.asarray(False)
    )


def step(at: Progress, found: tuple[Array, Array, Any], tolerance: float) -> Progress:
    """One step of Levenberg-Marquardt, d = -(J^T J + I / size)^-1 J^T r, from what was found where the last one led.

    A step by which the objective falls by less than `LITTLE` of what the linearisation predicts is rejected and the
    next one shortened; one by which it falls by `NEARLY_ALL` of it lets the next one be longer (Conn, Gould, Toint
    2000, alg. 6.1.1, with the numbers of optimistix 0.1). A search ends where an accepted step changes neither z nor
    any residual by more than the tolerance, and after `PATIENCE` steps in a row that were rejected: each is a quarter
    of the one before, so nothing is left to gain but rounding (or, of a rollout, the integrator's tolerance);
    `Optimum.converged` says whether that place is an optimum.
    """
    (r, jacobian, _), (r_old, jacobian_old, _) = found, at.found
    moved, changed, first = at.ahead - at.y, r - r_old, at.steps == 0
    fall = 0.5 * (jnp.sum(r**2) - jnp.sum(r_old**2))
    predicted = 0.5 * (jnp.sum((jacobian_old @ moved + r_old) ** 2) - jnp.sum(r_old**2))
    accepted = first | (fall <= LITTLE * predicted)
    good = ~first & (predicted < 0) & (fall < NEARLY_ALL * predicted)
    size = at.size * jnp.where(accepted, jnp.where(good, LONGER, 1.0), SHORTER)
    ended = jnp.all(jnp.abs(moved) < tolerance * (1 + jnp.abs(at.ahead)))
    ended &= accepted & jnp.all(jnp.abs(changed) < tolerance * (1 + jnp.abs(r)))

    new = at.ahead, found, jacobian.T @ jacobian, jacobian.T @ r
    old = at.y, at.found, at.normal, at.gradient
    y, best, normal, gradient = jax.tree.map(lambda a, b: jnp.where(accepted, a, b), new, old)
    tiny = jnp.finfo(size.dtype)
    damping = jnp.where(size > tiny.eps, 1 / jnp.maximum(size, tiny.eps), tiny.max)
    lower = cholesky(normal + damping * jnp.eye(y.shape[0]))
    ahead = y - backward(lower, forward(lower, gradient))
    rejected = jnp.where(accepted, 0, at.rejected + 1)
    over = ended | (rejected >= PATIENCE)
    return Progress(y, best, normal, gradient, ahead, size, at.steps + 1, rejected, over)


def _begin(problem: Problem, start: Z, data: Data) -> Progress:
    """A search of a problem that has evaluated nothing yet."""
    rows, count = data.measured.shape
    size, codes = rows * count + rows + start.shape[0], jnp.zeros(rows, int)
    seen = Observation(jnp.zeros((rows, count)), jnp.zeros(rows), codes, codes)
    return begin_at(start, (jnp.zeros(size), jnp.zeros((size, start.shape[0])), seen))


def _advance(problem: Problem, at: Progress, data: Data, pin: Pin, max_steps: int) -> Progress:
    """One step of a search. The model is evaluated in one place of the program, at the start of a step: what was
    accepted there is what the search returns, with its residuals, Jacobian and observation."""
    found = _evaluated(problem, data, pin)(at.ahead)
    new = step(at, found, TOLERANCE_LONG if problem.observe.long else TOLERANCE)
    over = new.over | (new.steps >= max_steps) | ~jnp.all(jnp.isfinite(new.y))
    return dataclasses.replace(new, over=over)


def _ended(at: Progress, data: Data, pin: Pin) -> Optimum:
    r, jacobian, _ = at.found
    return _optimum(jacobian, r, at.y, data, pin, at.steps)


def levenberg_marquardt(
    problem: Problem, start: Z, data: Data, pin: Pin | None = None, max_steps: int = 100
) -> tuple[Optimum, Observation]:
    """One search, and what the model says where it ended. To be vmapped over starts, data and pins."""
    pin = no_pin(start.shape[0]) if pin is None else pin
    end = jax.lax.while_loop(
        lambda at: ~at.over,
        lambda at: _advance(problem, at, data, pin, max_steps),
        _begin(problem, pin.apply(start), data),
    )
    return _ended(end, data, pin), end.found[2]


class Member(eqx.Module):
    """What one of many searches of a problem has of its own; a leading axis where there are many.

    Attributes:
        start: where it begins, shape (parameters,); weight, measured, centre: as of `Data`; active: its effects, see
            `ActiveSet`, None for those of the problem.
    """

    start: Numbers
    weight: Numbers
    measured: Numbers
    centre: Numbers
    active: Numbers | None = None

    def problem(self, problem: Problem) -> Problem:
        """The problem that it is a search of."""
        data = dataclasses.replace(problem.data, weight=self.weight, measured=self.measured, centre=self.centre)
        coordinates = problem.coordinates
        if self.active is not None:
            coordinates = coordinates.with_effects(self.active)
        return dataclasses.replace(problem, data=data, coordinates=coordinates)


@functools.partial(compiled, options=SELDOM)
def _vacant(problem: Problem, members: Member) -> Progress:
    """Searches that have ended before they began, from which nothing is taken."""

    def one(member: Member) -> Progress:
        begun = _begin(problem, member.start, member.problem(problem).data)
        return dataclasses.replace(begun, over=jnp.asarray(True))

    return jax.vmap(one)(members)


@functools.partial(compiled, options=SMALL)
def _go_on(
    problem: Problem, members: Member, fresh: Numbers, at: Progress, enough: Numbers, max_steps: int
) -> tuple[Progress, Optimum]:
    """Searches side by side until `enough` of them have ended, those that are `fresh` from their starts."""
    pin = no_pin(members.start.shape[-1])

    def begin(member: Member, fresh: Array, at: Progress) -> Progress:
        begun = _begin(problem, member.start, member.problem(problem).data)
        return jax.tree.map(lambda new, old: jnp.where(fresh, new, old), begun, at)

    def advance(member: Member, at: Progress) -> Progress:
        here = member.problem(problem)
        new = _advance(here, at, here.data, pin, max_steps)
        return jax.tree.map(lambda new, old: jnp.where(at.over, old, new), new, at)

    at = jax.vmap(begin)(members, fresh, at)
    at = jax.lax.while_loop(lambda at: jnp.sum(at.over) < enough, lambda at: jax.vmap(advance)(members, at), at)
    return at, jax.vmap(lambda member, at: _ended(at, member.problem(problem).data, pin))(members, at)


def searches_refilled(problem: Problem, members: Member, max_steps: int, places: int) -> tuple[Optimum, Observation]:
    """`levenberg_marquardt` of any number of members, so many at a time: one that has ended leaves its place to one
    that waits, where a batch would wait for the slowest of it. One program serves any number.

    Args:
        members: leading axis the searches, NumPy's arrays.
        places: searches side by side on each core.

    Returns:
        Where each search ended, and what the model says there.
    """
    count = len(members.start)
    cores = min(CORES, -(-count // places))
    first = jax.tree.map(lambda x: np.repeat(x[:1], places, 0), members)
    idle = _vacant(problem, first)

    def some(core: int) -> list[tuple[int, Any]]:
        waiting, ended = list(range(core, count, cores))[::-1], []
        holds = np.full(places, -1)
        at = idle
        while waiting or (holds >= 0).any():
            fresh = np.zeros(places, bool)
            for place in np.flatnonzero(holds < 0)[: len(waiting)]:
                holds[place], fresh[place] = waiting.pop(), True
            own = jax.tree.map(lambda x: x[np.maximum(holds, 0)], members)
            running = int((holds >= 0).sum())
            enough = places - running + (max(1, places // 4) if waiting else running)
            at, found = _go_on(problem, own, fresh, at, np.asarray(enough), max_steps)
            over, found, seen = jax.device_get((at.over, found, at.found[2]))
            for place in np.flatnonzero(over & (holds >= 0)):
                ended.append((holds[place], jax.tree.map(lambda x: x[place], (found, seen))))  # noqa: B023
                holds[place] = -1
        return ended

    if cores > 1:  # the program is made once, by a call that takes no step
        _go_on(problem, first, np.zeros(places, bool), idle, np.asarray(0), max_steps)
    with concurrent.futures.ThreadPoolExecutor(cores) as pool:
        ended = dict(itertools.chain(*pool.map(some, range(cores))))
    return jax.tree.map(lambda *x: np.stack(x), *(ended[k] for k in range(count)))


def linearised(problem: Problem, z: Z, data: Data) -> tuple[Array, Array, Observation]:
    """All that is asked of a rollout at z, in one program: residuals (misfit, then prior), Jacobian, observation.

    Where a rollout's step is too long for its friction law (V_s small beside μ_s) the run shakes and its
    derivative grows without limit; such a reading, if it counts, counts as one that could not be computed.
    """
    r, jacobian, seen = _linearised(problem, z, data)
    return *_counted(r, jacobian, data), seen


@compiled
def _linearised(problem: Problem, z: Z, data: Data) -> tuple[Array, Array, Observation]:
    # Of a row that leaves some of its adhesion's margin the penalty is negative here, and has its slope.
    counts = jnp.concatenate([data.weight.ravel() > 0, jnp.ones(data.measured.shape[0] + z.size, bool)])

    def function(z: Z) -> tuple[Array, tuple[Array, Observation]]:
        seen = problem.observation(z)
        readings = problem.whitened(seen, data)[: data.measured.size]
        r = jnp.concatenate([readings, problem.excess(seen, data), z - data.centre])
        return r, (r, seen)

    jacobian, (r, seen) = jax.jacfwd(function, has_aux=True)(z)
    known = jnp.all(jnp.isfinite(jacobian), axis=1)
    return jnp.where(known, r, MISSING * counts), jnp.where(known[:, None], jacobian, 0.0), seen


def _penalties(data: Data) -> Bool[Array, " residuals"]:
    readings, rows = data.measured.size, data.measured.shape[0]
    return jnp.zeros(readings + rows + data.centre.size, bool).at[readings : readings + rows].set(True)


def _counted(r: Array, jacobian: Array, data: Data) -> tuple[Array, Array]:
    counted = ~_penalties(data) | (r > 0)
    return jnp.where(counted, r, 0.0), jnp.where(counted[:, None], jacobian, 0.0)


def step_ahead(
    residual: Float[np.ndarray, " residuals"],
    jacobian: Float[np.ndarray, "residuals parameters"],
    penalty: Bool[np.ndarray, " residuals"],
) -> tuple[Float[np.ndarray, " parameters"], float]:
    """Step to the optimum of a linearisation whose penalties count where they are positive, and its gain.

    min_d ½ Σ (r + J d)² over readings and priors + ½ Σ max(0, r + J d)² over penalties, by their active set. The
    Gauss-Newton step knows those penalties alone that are positive where it begins: from just inside the limit of
    adhesion it leads across it, and predicts a gain that is not there.
    """

    def objective(d: np.ndarray) -> float:
        ahead = residual + jacobian @ d
        return 0.5 * float(np.sum(np.where(penalty, np.maximum(ahead, 0.0), ahead) ** 2))

    best, active = np.zeros(jacobian.shape[1]), ~penalty | (residual > 0)
    for _ in range(2 * int(penalty.sum()) + 2):
        j, r = jacobian[active], residual[active]
        d = -np.linalg.solve(j.T @ j, j.T @ r)
        best = min(best, d, key=objective)
        before, active = active, ~penalty | (residual + jacobian @ d > 0)
        if (active == before).all():
            break
    return best, objective(np.zeros_like(best)) - objective(best)


def evaluated(problem: Problem, z: Z, data: Data) -> Array:
    """The residuals of `linearised` alone, by the program of `read`: a rollout less to compile."""
    seen = read(problem, problem.robot(z))
    return jnp.concatenate([problem.whitened(seen, data), z - data.centre])


@jax.jit
def _stepped(at: Progress, found: tuple[Array, Array, Any]) -> Progress:
    return step(at, found, TOLERANCE_LONG)


def search_long(
    problem: Problem,
    start: Z,
    data: Data,
    max_steps: int = 100,
    tell: Callable[[int, float], None] = lambda steps, cost: None,
) -> tuple[Optimum, Observation, Observation]:
    """`levenberg_marquardt` with the steps taken from outside, so that a rollout is compiled once in all.

    It ends too where the step from a point would gain nothing that counts (a tenth of `DECREMENT`).

    Returns:
        Where the search ended, and what the model says where it started and where it ended.
    """
    pin = no_pin(start.shape[0])
    search: Progress | None = None
    accepted = True
    first: Observation | None = None
    best: tuple[Optimum, Observation] | None = None

    def judged(z: Z, steps: int, r: Array, jacobian: Array) -> tuple[Optimum, np.ndarray]:
        ahead, gain = step_ahead(np.asarray(r), np.asarray(jacobian), np.asarray(_penalties(data)))
        found = _optimum(*_counted(r, jacobian, data)[::-1], z, data, pin, jnp.asarray(steps))
        return dataclasses.replace(found, decrement=jnp.asarray(gain), converged=_small(gain, found.cost)), ahead

    for steps in range(1, max_steps + 1):
        at = start if search is None else search.ahead
        # A step that follows a rejected one is often rejected too; that takes no Jacobian, so the last one stays.
        r = None if accepted else evaluated(problem, at, data)
        if r is None or best is None or 0.5 * jnp.sum(r**2) < best[0].cost:
            signed, slope, seen = _linearised(problem, at, data)
            r, jacobian = _counted(signed, slope, data)
        if search is None:
            search, first = begin_at(start, jax.tree.map(jnp.zeros_like, (r, jacobian, None))), seen
        search = _stepped(search, (r, jacobian, None))
        accepted, done = bool(search.rejected == 0), bool(search.over)
        if accepted:
            found, ahead = judged(search.y, steps, signed, slope)
            best = found, seen
            done |= bool(found.decrement < 0.1 * (DECREMENT + DECREMENT_SHARE * found.cost))
        assert best is not None  # the first step only evaluates the start, and accepts it
        tell(steps, float(best[0].cost))
        if done:
            break
    assert best is not None and first is not None
    # The steps above see the limit of adhesion only once they have crossed it; these go along it.
    while not best[0].converged and (steps := steps + 1) <= max_steps:
        at = best[0].z + ahead
        if not 0.5 * jnp.sum(evaluated(problem, at, data) ** 2) < best[0].cost:
            break
        signed, slope, seen = _linearised(problem, at, data)
        found, ahead = judged(at, steps, signed, slope)
        best = found, seen
        tell(steps, float(found.cost))
    return best[0], first, best[1]


Evaluate = Callable[[Array], tuple[Array, Array, Observation]]


_steps = jax.jit(jax.vmap(lambda at, found: step(at, found, TOLERANCE_LONG)))


@eqx.filter_jit
def _optima(jacobian: Array, r: Array, z: Array, data: Data, weights: Array, steps: Array) -> Optimum:
    def one(jacobian: Array, r: Array, z: Array, weight: Array, steps: Array) -> Optimum:
        there = dataclasses.replace(data, weight=weight)
        return _optimum(jacobian, r, z, there, no_pin(z.shape[0]), steps)

    return jax.vmap(one)(jacobian, r, z, weights, steps)


def searches_long(
    evaluate: Evaluate, starts: Array, data: Data, weights: Array, max_steps: int, *, rivals: bool = False
) -> tuple[Optimum, Observation]:
    """A batch of `levenberg_marquardt` with the steps taken from outside, so that rollouts are compiled once in all.

    Args:
        evaluate: residuals, their Jacobian and the observation of every member at its z, compiled; leading axis the
            batch.
        starts: shape (members, coordinates); weights: of each member's readings, shape (members, rows, channels).
        rivals: whether all search the same optimum, so that all end once `AGREE` have ended in one place and none is
            lower, and those that cannot come down to it (by `HOPELESS` times what their step predicts) before.

    Returns:
        Where each search ended, and what the model says there.
    """
    starts = jnp.asarray(starts)
    found = evaluate(starts)
    at = jax.vmap(begin_at)(starts, jax.tree.map(jnp.zeros_like, found))
    over, taken = np.zeros(len(starts), bool), np.zeros(len(starts), int)
    for steps in range(1, max_steps + 1):
        # A step judges what was found where the last one led; what is accepted becomes y.
        new = _steps(at, found)
        moved, done = np.asarray(new.rejected == 0), np.asarray(new.over)
        at = _where(over, at, new)
        taken = np.where(over, taken, steps)
        r, jacobian, seen = at.found
        ends = _optima(jacobian, r, at.y, data, weights, jnp.asarray(taken))
        small = 0.1 * (DECREMENT + DECREMENT_SHARE * ends.cost)
        over = over | done | np.asarray(moved & (ends.decrement < small))
        if rivals:
            cost, reach = np.asarray(ends.cost), HOPELESS * np.asarray(ends.decrement)
            lowest = np.min(cost[over], initial=np.inf)
            agree = np.sum(over & (cost < lowest + SAME)) >= AGREE and not np.any(~over & (cost < lowest - SAME))
            over = over | (cost - reach > lowest) | agree
        if over.all():
            break
        found = evaluate(jnp.where(over[:, None], at.y, at.ahead))
    return ends, seen


@jax.jit
def _where(which: Array, new: Any, old: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(which.reshape(-1, *[1] * (a.ndim - 1)), a, b), new, old)


def quasi_newton(problem: Problem, start: Z, data: Data, max_steps: int = 2000) -> Optimum:
    """One search of the same objective by `optax.lbfgs`; its gradient is Jᵀr with the forward Jacobian.

    For many parameters, or where the Jacobian is too large to factorise.
    """
    pin = no_pin(start.shape[0])
    function = residuals(problem, data, pin)

    def cost(z: Z) -> Array:
        return 0.5 * jnp.sum(function(z) ** 2)

    solver = optax.lbfgs(memory_size=20)
    value_and_grad = optax.value_and_grad_from_state(cost)

    def step(carry: tuple) -> tuple:
        z, state, k, _ = carry
        value, gradient = value_and_grad(z, state=state)
        updates, state = solver.update(gradient, state, z, value=value, grad=gradient, value_fn=cost)
        return optax.apply_updates(z, updates), state, k + 1, jnp.max(jnp.abs(gradient))

    def go_on(carry: tuple) -> Array:
        return (carry[2] < max_steps) & (carry[3] > 1e-5)

    carry = (start, solver.init(start), jnp.asarray(0), jnp.asarray(jnp.inf))
    z, _, k, _ = jax.lax.while_loop(go_on, step, carry)
    r, jacobian, _ = _evaluated(problem, data, pin)(z)
    return _optimum(jacobian, r, z, data, pin, k)


@compiled
def searches(
    problem: Problem, starts: Float[Array, "starts parameters"], data: Data
) -> tuple[Optimum, Int[Array, "starts rows"], Int[Array, "starts rows"]]:
    """Levenberg-Marquardt from every start in one vmapped batch.

    Returns:
        Where each search ended, and the status of every row where it started and where it ended.
    """

    def search(z: Z) -> tuple[Optimum, Array, Array]:
        found, seen = levenberg_marquardt(problem, z, data)
        return found, problem.observation(z).status, seen.status

    return jax.vmap(search)(starts)


@compiled
def read(problem: Problem, robot: Robot) -> Observation:
    """What the model says of every row of the problem for any robot, compiled."""
    return problem.observe(robot)


def observation(problem: Problem, z: Z) -> Observation:
    """What the model says of every row at z, by a program that the search has compiled already if it is long."""
    return linearised(problem, z, problem.data)[2] if problem.observe.long else read(problem, problem.robot(z))
