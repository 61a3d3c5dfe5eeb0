"""Regression of base parameters and effects on the equations of a log in weak form, without a simulation.

If a log shows the states, the balances give their rates at its readings. The equation y' = f(y) is
multiplied by smooth windows w(t) and integrated by parts: ∫ w f(y) dt + ∫ w' y dt = 0. No derivative of a noisy
reading is taken. References: modulating functions, Preisig and Rippin, Comput. Chem. Eng. 17 (1993) 1; inverse
dynamic identification, Gautier and Khalil, IEEE Trans. Robot. Autom. 6 (1990) 368; weak SINDy, Messenger and Bortz,
Multiscale Model. Simul. 19 (2021) 1474. Both terms contain readings, and overlapping windows share their noise. The
covariance of this noise follows from the sds of the readings and the steps of their instruments, and weights the
windows (Bortz, Messenger and Dukic, Bull. Math. Biol. 85 (2023) 110). No window contains a jump of an imposed
quantity, a gap, or rest.
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
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares

from calibration.inference.linearization import ScoredEffect, balance_probe, effect_terms, map_over_shapes
from calibration.inference.problem import Problem
from calibration.inference.shown_states import (
    Plan,
    Rows,
    Windows,
    motion_rates,
    plan_of,
    states_by_row,
    windows_of_log,
)
from mmrjax.compile.compiling import SELDOM, compiled
from mmrjax.effects import Effect
from mmrjax.model import balances, channels
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals, State

#: Fewest windows for each base parameter of a regression that is used.
ENOUGH = 4
#: Variance added to the noise of a window, as a share of it. Without it, differences between overlapping windows
#: would have no noise.
FLOOR = 0.01
#: Steps of Newton's method to the current that a voltage drives.
CURRENT_STEPS = 3
#: Most steps of the regression, and the relative change of its sum of squares at which it ends; change of a
#: coordinate for the derivative of the noise, and the change after which that is computed again [prior sd].
STEPS, SMALL, STEP, FAR = 10, 1e-3, 1e-4, 0.5


class Terms(eqx.Module):
    """Terms f and y of the equations Σ w f Δt + Σ w' y Δt = 0 at each row, shape (rows, equations, ...).

    Attributes:
        f, y: at the readings; by_z, by_reading, by_effects: their derivatives, those of f first.
    """

    f: Array
    y: Array
    by_z: tuple[Array, Array]
    by_reading: tuple[Array, Array]
    by_effects: tuple[Array, Array]


def _current(robot: Robot, conditions: Conditions, state: State, way: Scalar) -> Scalar:
    """Current of the voltage balance by Newton's method; its derivatives are those of the last step."""

    def left(robot: Robot, state: State, current: Scalar) -> Scalar:
        at = dataclasses.replace(state, current=current)
        return jnp.asarray(balances.driven_signals(robot, conditions, at, way).voltage_left)

    fixed: Any = jax.tree.map(lambda x: jax.lax.stop_gradient(x) if isinstance(x, jax.Array) else x, (robot, state))
    current = jnp.zeros(())
    for step in range(CURRENT_STEPS):
        value, slope = jax.jvp(lambda x: left(fixed[0], fixed[1], x), (current,), (jnp.ones(()),))
        value = left(robot, state, current) if step == CURRENT_STEPS - 1 else value
        current = current - value / slope
    return current


def row_terms(
    plan: Plan, robot: Robot, row: Rows, shown: Array, probes: frozenset[str] = frozenset()
) -> tuple[Array, Array, Signals]:
    """Returns terms f and y of one row's equations, and its signals.

    Args:
        row: one of `Rows`, without its leading axis; shown: its readings [SI], shape (channels,).
        probes: names of effects that read no signal.
    """
    conditions, names = row.conditions, channels.channel_names(robot.channels)
    chassis = robot.chassis(conditions.configuration)
    none, one = jnp.zeros(()), jnp.ones(())

    def per_unit(k: int, state: State) -> Scalar:
        return channels.find_channel(names[k]).read(robot, balances.begin_signals(robot, conditions, state))

    if plan.imposed == "motor_speed":
        turning: Scalar = jnp.asarray(conditions.motor_speed)
    else:
        rolling = State(none, one, chassis.radius / robot.gearbox.ratio, none, distance=chassis.radius)
        unit = per_unit(plan.motion, rolling)  # of an angle: of the output by the output's
        read = shown[plan.motion] if not plan.angle else row.rate
        turning = read / unit * (robot.gearbox.ratio if plan.angle else 1.0)
    if plan.current >= 0:
        current_per_unit = 1 / per_unit(plan.current, State(one, none, none, none, distance=none))
        current = shown[plan.current] * current_per_unit
    elif conditions.motor_current is not None:
        current = jnp.asarray(conditions.motor_current)
    else:
        current = none

    def state_at(turning: Scalar, current: Scalar) -> State:
        rolls = chassis.radius * turning / robot.gearbox.ratio
        return State(current, turning, rolls, none, row.memory, distance=chassis.radius * row.angle)

    def signals_at(turning: Scalar) -> tuple[Signals, Scalar]:
        at = state_at(turning, current)
        own: Scalar = current
        if plan.imposed == "voltage" and plan.current < 0:
            own = _current(robot, conditions, at, row.way)
        return balances.rolling_signals(robot, conditions, dataclasses.replace(at, current=own), row.way), own

    first = balances.begin_signals(robot, conditions, state_at(turning, current))
    errors = {
        k: balances.effects_sum(robot, first, "sensor", names[k]) for k in (plan.motion, plan.current) if k >= 0
    }
    if plan.current >= 0:
        current = current - errors[plan.current] * current_per_unit
    if plan.motion >= 0 and not plan.angle:
        turning = turning - errors[plan.motion] / unit
    if robot.has_ground and plan.mechanical and plan.travels:
        # The wheels turn faster than the load travels because of slip.
        if any(e.balance == "slip" and e.name not in probes for e in robot.effects):
            first = signals_at(turning)[0]
        turning = turning + balances.effects_sum(robot, first, "slip") * robot.gearbox.ratio / chassis.radius
    signals, own = signals_at(turning)
    f, y = [], []
    if plan.electrical:
        # Divided by the inductance, the rate of the current would be mostly noise, and a large inductance fit best.
        f.append(signals.voltage_left)
        y.append(signals.inductance * own)
    if plan.mechanical:  # in the instrument's unit, because a unit that depends on a parameter would shrink with it
        rise = unit * (1 / robot.gearbox.ratio if plan.angle else 1.0)
        f.append(rise * signals.acceleration_wheel * robot.gearbox.ratio)
        y.append(shown[plan.motion] + (-errors[plan.motion] if plan.angle else unit * turning - read))
    if plan.others:
        if robot.has_ground:
            creep = chassis.ground.speed_creep(signals.traction, signals.normal, signals.adhesion)
            lost = balances.effects_sum(robot, signals, "slip")
            signals = dataclasses.replace(signals, speed=signals.speed_theoretical - creep - lost)
        says = balances.sensor(robot, signals)
        f += [says[names[k]] - shown[k] for k in plan.others]
        y += [none] * len(plan.others)
    return jnp.stack([jnp.asarray(x, float) for x in f]), jnp.stack([jnp.asarray(x, float) for x in y]), signals


@functools.partial(compiled, options=SELDOM)
def _terms(problem: Problem, plan: Plan, rows: Rows, z: Array, effects: tuple[ScoredEffect, ...]) -> Terms:
    """Returns the terms of each row at coordinates z, with derivatives by base parameters, readings and effects."""
    entering = tuple(dict.fromkeys(e.effect.balance for e in effects if e.effect.balance != "sensor"))
    probes = tuple(balance_probe(b) for b in entering)
    size, names = z.size, channels.channel_names(problem.channels)

    def one(row: Rows) -> tuple[Any, tuple[Any, Signals]]:
        def both(x: Array) -> tuple[Any, tuple[Any, Signals]]:
            base = problem.coordinates.robot(problem.base, x[:size])
            amplitude = x[size : size + len(probes)]
            put = tuple(eqx.tree_at(lambda e: e.amplitude, p, a) for p, a in zip(probes, amplitude, strict=True))
            robot = dataclasses.replace(base, effects=(*base.effects, *put))
            f, y, signals = row_terms(plan, robot, row, x[size + len(probes) :], frozenset(p.name for p in probes))
            return (f, y), ((f, y), signals)

        return jax.jacfwd(both, has_aux=True)(jnp.concatenate([z, jnp.zeros(len(probes)), row.shown]))

    slopes, (values, signals) = jax.vmap(one)(rows)
    base = problem.coordinates.robot(problem.base, z)
    memory = memory_by_row(base, rows, signals, effects)
    entered = jax.vmap(lambda s, m: effect_terms(base, s, effects, m))(signals, memory)
    # An effect changes an equation like a defect of its balance. An effect of an instrument changes it like a
    # negative reading, or like a defect of that equation if the reading follows from the states.
    counts = np.array([len(e.at) for e in effects], int)
    enters = [entering.index(b) if (b := e.effect.balance) in entering else -1 for e in effects]
    which = np.repeat(np.array([size + k if k >= 0 else -1 for k in enters], int), counts)
    at = np.repeat(
        np.array([names.index(c) if (c := e.effect.channel) in names else 0 for e in effects], int), counts
    )
    first = len(values[0][0]) - len(plan.others)

    def of_effects(slope: Array, direct: bool) -> Array:
        shown = -slope[:, :, size + len(probes) :][:, :, at]
        for k, channel in enumerate(plan.others):
            shown = shown.at[:, first + k].set(jnp.asarray(1.0 * (at == channel)) * direct)
        by_term = jnp.where(which >= 0, slope[:, :, np.maximum(which, 0)], shown)
        return by_term * entered[:, None]

    def both(part: Callable[[Array, bool], Array]) -> tuple[Array, Array]:
        return part(slopes[0], True), part(slopes[1], False)

    return Terms(
        values[0],
        values[1],
        both(lambda s, _: s[:, :, :size]),
        both(lambda s, _: s[:, :, size + len(probes) :]),
        both(of_effects),
    )


def memory_by_row(robot: Robot, rows: Rows, signals: Signals, effects: tuple[ScoredEffect, ...]) -> list[Array]:
    """Returns the memory of each effect at each row and point of its grid, shape (rows, grid)."""
    count = rows.since.shape[0]
    nothing = [jnp.zeros((count, len(e.at))) for e in effects]

    def of_effect(scored: ScoredEffect) -> Array:
        def rate(effect: Effect, at: Array, signals: Signals) -> Array:
            known = dataclasses.replace(signals, memory={**signals.memory, effect.name: at})
            return jnp.asarray(effect.rate(robot, known), float)

        def begun(angle: Array) -> Array:
            return map_over_shapes(
                scored, lambda e, _: jnp.asarray(e.initial(robot, angle), float), jnp.zeros(len(scored.at))
            )

        def after(memory: Array, row: tuple[Array, Array, Signals]) -> tuple[Array, Array]:
            since, angle, signals = row
            law = lambda m: map_over_shapes(scored, lambda e, x: rate(e, x, signals), m)  # noqa: E731
            speed, slope = jax.jvp(law, (memory,), (jnp.ones_like(memory),))
            memory = jnp.where(since > 0, memory + since * speed / (1 - since * slope), begun(angle))
            return memory, memory

        return jax.lax.scan(after, begun(rows.angle[0]), (rows.since, rows.angle, signals))[1]

    return [zero if e.effect.memory_size is None else of_effect(e) for e, zero in zip(effects, nothing, strict=True)]


# --- the regression -------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class WeakForm:
    """Whitened residuals of the windows of a log at base coordinates z, with their derivatives.

    Attributes:
        z: coordinates of the base that minimise the squared residuals of windows and priors.
        residual: of windows, then z - centre, shape (windows + coordinates,).
        jacobian: by the coordinates; signatures: derivatives of the windows by each instance's amplitude [prior sd].
        windows: number of equations, one or more for each window.
    """

    z: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray
    signatures: np.ndarray
    windows: int


def weak_form(problem: Problem, effects: tuple[ScoredEffect, ...] = ()) -> WeakForm | None:
    """Returns the regression of a log's base parameters on its equations in weak form.

    None if the log does not show the states, or has too few windows.

    Args:
        problem: of histories, without effects in its coordinates; effects: instances whose signatures are computed.
    """
    plan = plan_of(problem)
    if plan is None:
        return None
    rate = motion_rates(problem, plan)
    cut = windows_of_log(problem, plan, rate)
    equations = plan.electrical + plan.mechanical + len(plan.others)
    if equations * sum(len(w.weight) for w in cut) < ENOUGH * len(problem.coordinates):
        return None
    rows = states_by_row(problem, plan, rate)

    def terms_at(z: np.ndarray, effects: tuple[ScoredEffect, ...] = ()) -> Terms:
        return jax.device_get(_terms(problem, plan, rows, jnp.asarray(z), effects))

    def joined(z: np.ndarray, effects: tuple[ScoredEffect, ...] = ()) -> list[_Joined]:
        terms = terms_at(z, effects)
        return [_joined(problem, plan, w, terms) for w in cut]

    grown: list[tuple[np.ndarray, list[np.ndarray]]] = []

    def growth(z: np.ndarray, here: list[_Joined]) -> list[np.ndarray]:
        """Returns the relative derivative of the sds by each coordinate, computed near z.

        Without it a larger inertia would always fit better.
        """
        if not grown or np.max(np.abs(grown[0][0] - z)) > FAR:
            moved = [terms_at(z + STEP * one) for one in np.eye(len(z))]
            sds = [[_sd(_noise(problem, plan, w, t)) for t in moved] for w in cut]
            found = [np.stack([(m - j.sd) / j.sd for m in each], 1) / STEP for each, j in zip(sds, here, strict=True)]
            grown[:] = [(z, found)]
        return grown[0][1]

    def made(z: np.ndarray, effects: tuple[ScoredEffect, ...] = ()) -> WeakForm:
        here, size = joined(z, effects), len(z)
        whole = np.concatenate([j.whitened(g) for j, g in zip(here, growth(z, here), strict=True)])
        prior = np.zeros((size, whole.shape[1]))
        prior[:, 0], prior[:, 1 : size + 1] = z - np.asarray(problem.data.centre), np.eye(size)
        both = np.concatenate([whole, prior])
        return WeakForm(z, both[:, 0], both[:, 1 : size + 1], whole[:, size + 1 :], len(whole))

    last: list[WeakForm] = []

    def at(z: np.ndarray) -> WeakForm:
        if not last or np.any(last[0].z != z):
            last[:] = [made(z.copy())]
        return last[0]

    # The windows are cut in NumPy. With such a residual, 600 x 12, optimistix's LevenbergMarquardt compiles for a
    # second and then takes 4.7 times the time of SciPy's (0.5 ms), as each evaluation is a host callback.
    try:
        found = least_squares(
            lambda z: at(z).residual, np.array(problem.data.centre), lambda z: at(z).jacobian, method="lm",
            max_nfev=STEPS, xtol=SMALL, ftol=SMALL,
        )  # fmt: skip
        return made(found.x, effects)
    except (np.linalg.LinAlgError, ValueError):  # non-finite numbers
        return None


@dataclasses.dataclass(frozen=True)
class _Joined:
    """Equations of the windows of a run.

    Attributes:
        whole: residual, derivatives and signatures, shape (windows, 1 + coordinates + instances).
        noise: their change by one sd of each reading, shape (windows, readings).
    """

    whole: np.ndarray
    noise: np.ndarray

    @property
    def sd(self) -> np.ndarray:
        """Noise of each window."""
        return _sd(self.noise)

    def whitened(self, growth: np.ndarray) -> np.ndarray:
        """Returns `whole` divided by its noise; `growth`: relative derivative of the noise by each coordinate."""
        covariance = self.noise @ self.noise.T + np.diag(FLOOR * self.sd**2)
        whole, count = self.whole.copy(), growth.shape[1]
        whole[:, 1 : count + 1] -= whole[:, :1] * growth
        return solve_triangular(np.linalg.cholesky(covariance), whole, lower=True)


def _sd(noise: np.ndarray) -> np.ndarray:
    return np.sqrt(np.maximum(np.sum(noise**2, 1), 1e-300))


def _slopes(plan: Plan, w: Windows, equations: int) -> list[np.ndarray]:
    """Weight of y of each equation in the windows."""
    slopes = [w.slope] * equations
    if plan.angle and plan.mechanical:
        slopes[plan.electrical] = -w.bend
    return slopes


def _noise(problem: Problem, plan: Plan, w: Windows, terms: Terms) -> np.ndarray:
    """Change of the windows of a run by one sd of each reading, shape (windows, readings)."""
    sd = np.asarray(problem.data.sd)[w.rows]
    by, also = (np.asarray(x)[w.rows] for x in terms.by_reading)
    slopes = _slopes(plan, w, terms.f.shape[1])
    shown = [c for c in range(sd.shape[1]) if np.any(by[:, :, c]) or np.any(also[:, :, c])]
    each = [
        np.concatenate([(w.weight * by[:, k, c] + slope * also[:, k, c]) * sd[:, c] for c in shown], 1)
        for k, slope in enumerate(slopes)
    ]
    return np.concatenate(each)


def _joined(problem: Problem, plan: Plan, w: Windows, terms: Terms) -> _Joined:
    """Equations of the windows of a run."""
    slopes = _slopes(plan, w, terms.f.shape[1])

    def integrated(f: Any, y: Any) -> np.ndarray:
        return np.concatenate([w.weight @ f[w.rows, k] + slope @ y[w.rows, k] for k, slope in enumerate(slopes)])

    parts = [
        integrated(terms.f[..., None], terms.y[..., None]),
        integrated(*terms.by_z),
        integrated(*terms.by_effects),
    ]
    return _Joined(np.concatenate(parts, 1), _noise(problem, plan, w, terms))
