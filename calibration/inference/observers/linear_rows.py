"""Rows linear about one fit: readings of a log near the simulated fit of its base, or windows of its equations.

All stages of the loop run on such rows without a simulation. A row of windows is the balances of a log, integrated
against one window in time: its reading is 0, and its prediction is the whitened error of an equation (`weak_form`).
So a log is a table, and no run is simulated. At states that the readings give, the equations are linear in the sizes
of effects and nearly linear in the base parameters. So all fits are those of the linearised equations.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from calibration.data import Columns, Names
from calibration.inference import bases as bases_room
from calibration.inference import shown_states, weak_form
from calibration.inference.lack_of_fit import variance_of_sums
from calibration.inference.linearization import PROBED, Linearization, ScoredEffect
from calibration.inference.observers.base import Observer, SearchPolicy, with_effects
from calibration.inference.observers.settled import SettledRuns
from calibration.inference.observers.time_histories import Histories
from calibration.inference.optimizers import Numbers
from calibration.inference.problem import Data, Observation, Problem, data_from_readings
from mmrjax.compile import compiling
from mmrjax.effects.curve import WAYS
from mmrjax.model import channels
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import CONVERGED


class LinearRows(Observer):
    """Observer whose rows are linear in the base coordinates and the amplitudes, about one fit.

    Attributes:
        linear: linearization at `origin`, with one weight for all readings.
        origin: base coordinates of that fit.
        start: base coordinates at which searches begin.
        width: prior sd of an amplitude, relative to that of its field.
        effect, grid: effect of each instance, and its neighbours on the grid of its shape: before, at, after.
    """

    policy: ClassVar[SearchPolicy] = SearchPolicy(batch=16, steps=30, searches=1, one_by_one=False)
    one_row_reveals: ClassVar[bool] = False

    linear: Any = eqx.field(kw_only=True)
    origin: Float[Array, " parameters"] = eqx.field(kw_only=True)
    start: Float[Array, " parameters"] = eqx.field(kw_only=True)
    width: float = eqx.field(kw_only=True, static=True)
    effect: Int[Array, " instances"] = eqx.field(kw_only=True)
    grid: Float[Array, "three instances"] = eqx.field(kw_only=True)

    def errors(self, coordinates: Any, z: Array) -> Array:
        """Predictions minus readings at coordinates z, shape (readings,)."""
        linear = self.linear
        size = self.origin.shape[0]
        readings = linear.readings
        errors = linear.residual[:readings] + linear.jacobian[:readings] @ (z[:size] - self.origin)
        if not hasattr(coordinates, "active"):
            return errors
        _, amplitude, shape = coordinates.parts(z)
        before, peak, after = self.grid
        rise = (shape[:, None] - before) / (peak - before)
        fall = (after - shape[:, None]) / (after - peak)
        share = jnp.clip(jnp.minimum(*(jnp.where(jnp.isfinite(x), x, 1.0) for x in (rise, fall))), 0.0, 1.0)
        membership = self.effect == jnp.asarray(coordinates.active)[:, None]
        return errors + self.width * linear.signatures @ jnp.sum(amplitude[:, None] * membership * share, 0)

    def linearise(self, problem: Problem, z: Array, effects: tuple[ScoredEffect, ...]) -> Any:
        data = problem.data
        evaluated, linear = jax.device_get((_evaluated(self, problem.coordinates, data, z), self.linear))
        linear = linear.rescaled(np.asarray(data.weight) / np.asarray(data.sd))
        return dataclasses.replace(linear, residual=evaluated[0], jacobian=evaluated[1])

    @property
    def long(self) -> bool:
        return False

    @property
    def over_time(self) -> bool:
        return True

    # Also for windows, which inherit from settled runs.
    operating_points, at_fit = Observer.operating_points, Observer.at_fit
    draws, fit_replicate, search = Observer.draws, Observer.fit_replicate, Observer.search

    def unreachable(self, status: np.ndarray) -> np.ndarray:
        return np.zeros(np.shape(status), bool)

    def starts(
        self, problem: Problem, random: np.random.Generator, count: int, problem_of_log: Problem | None = None
    ) -> np.ndarray:
        return np.asarray(self.start)[None]

    def at(self, problem: Problem, z: Numbers, active: Numbers | None = None) -> tuple[Numbers, Numbers, Observation]:
        return _evaluated(self, with_effects(problem, active).coordinates, problem.data, jnp.asarray(z))


class LinearHistories(LinearRows, Histories):
    """Observer of time histories whose readings are linear about the fit of their base."""


def grid_of_effects(effects: tuple[ScoredEffect, ...]) -> tuple[Array, Array]:
    """Effect of each instance, and its neighbours on the grid of its shape, see `LinearRows`."""
    index = np.repeat(np.arange(len(effects)), [len(e.at) for e in effects])
    padded = [np.r_[-np.inf, e.at, np.inf] for e in effects]
    grid = [np.concatenate(x) for x in zip(*((x[:-2], x[1:-1], x[2:]) for x in padded), strict=True)]
    return jnp.asarray(index), jnp.asarray(np.stack(grid))


def problem_of_readings(problem: Problem, z: np.ndarray, effects: tuple[ScoredEffect, ...], width: float) -> Problem:
    """Problem of a log whose readings are linear about a fit of its base.

    Args:
        problem: problem of the log.
        z: coordinates of the fit.
        effects: effects whose signatures are computed.
        width: prior sd of amplitudes, relative to those of their fields.
    """
    data = problem.data
    observe = problem.observe
    z = np.asarray(z)
    linear: Any = jax.device_get(observe.linearise(problem, jnp.asarray(z), effects))
    scale = np.asarray(data.weight / data.sd)
    unwhitened = jax.tree.map(
        jnp.asarray, linear.rescaled(np.where(scale > 0, 1 / np.where(scale > 0, scale, 1.0), 0.0))
    )
    index, grid = grid_of_effects(effects)
    simulated = observe.at_fit(problem, z)
    fields: Any = {f.name: getattr(simulated, f.name) for f in dataclasses.fields(simulated)}
    rows = LinearHistories(
        **fields, linear=unwhitened, origin=jnp.asarray(z), start=jnp.asarray(z), width=width,
        effect=index, grid=grid,
    )  # fmt: skip
    return dataclasses.replace(problem, observe=rows)


@functools.partial(compiling.compiled, options=compiling.SELDOM)
def _evaluated(observe: LinearRows, coordinates: Any, data: Data, z: Array) -> tuple[Array, Array, Observation]:
    """Residuals of rows, penalties and priors, their Jacobian, and the observation."""

    def errors_twice(z: Array) -> tuple[Array, Array]:
        errors = observe.errors(coordinates, z)
        return errors, errors

    slopes, errors = jax.jacfwd(errors_twice, has_aux=True)(z)
    scale = (data.weight / data.sd).ravel()
    penalties = jnp.zeros(len(data.weight))
    residual = jnp.concatenate([scale * errors, penalties, z - data.centre])
    jacobian = [scale[:, None] * slopes, jnp.zeros((len(penalties), len(z))), jnp.eye(len(z))]
    status = jnp.full(len(penalties), CONVERGED)
    reading = errors.reshape(data.weight.shape) + data.measured
    observation = Observation(reading, penalties, status, jnp.zeros_like(status))
    return residual, jnp.concatenate(jacobian), observation


# --- windows of a log ----------------------------------------------------------------------------------------


#: Number of windows whose noise is known together.
TOGETHER = 128
#: Number of effects that are fitted before the rest counts as a disturbance.
FITTED = 4
#: Most rounds for the intensity of the disturbance, and its relative change at which they end.
ROUNDS, SAME = 8, 0.05
#: Variables of curves that follow from the states if no channel shows them.
UNSHOWN = ("speed_motor", "current")


class Integrals(eqx.Module):
    """Whitened integrals of terms over windows.

    Attributes:
        index: points of each window, shape (windows, length).
        weight: factor of f at each point.
        slope: factor of y there for each equation, shape (equations, windows, length).
        white: inverse Cholesky factor of each `TOGETHER` windows, in the order (equation, window).
        places: channel of each equation.
        count: number of channels.
    """

    index: Int[Array, "windows length"]
    weight: Float[Array, "windows length"]
    slope: Float[Array, "equations windows length"]
    white: Float[Array, "parts size size"]
    places: tuple[int, ...] = eqx.field(static=True)
    count: int = eqx.field(static=True)

    def __call__(self, f: Array, y: Array) -> Float[Array, "windows channels columns"]:
        """Integrals of terms, shape (points, equations, columns), by the channel of each equation."""
        integral = functools.partial(jnp.einsum, "wl,wlc->wc")
        integrals = jnp.stack(
            [
                integral(self.weight, f[self.index, k]) + integral(slope, y[self.index, k])
                for k, slope in enumerate(self.slope)
            ]
        )
        parts = len(self.white)
        columns = f.shape[-1]
        whitened = integrals.reshape(len(self.slope), parts, -1, columns).swapaxes(0, 1).reshape(parts, -1, columns)
        whitened = jnp.einsum("pij,pjc->pic", self.white, whitened)
        by_window = jnp.moveaxis(whitened.reshape(parts, len(self.slope), -1, columns), 1, 2)
        by_channel = jnp.zeros((len(self.index), self.count, columns))
        return by_channel.at[:, np.asarray(self.places)].set(by_window.reshape(len(self.index), -1, columns))

    def inside(self, windows: np.ndarray, points: int) -> np.ndarray:
        """True for points within some of the windows."""
        index, weight = (np.asarray(x)[windows] for x in (self.index, self.weight))
        return np.isin(np.arange(points), index[weight > 0])

    def mean(self, x: np.ndarray) -> np.ndarray:
        """Mean of a quantity of the points in each window."""
        weight = np.asarray(self.weight)
        return np.sum(weight * x[np.asarray(self.index)], 1) / np.maximum(np.sum(weight, 1), 1e-300)


_whitened = compiling.compiled(Integrals.__call__)


class WindowsLinearization(Linearization):
    """Linearization of windows. An error of a balance or a channel has a value at each point of the log.

    Attributes:
        integrals: integrals over the windows.
        slopes: derivatives of f and y with respect to an error of each balance, then of each reading.
        time, angle: time and angle of the driving shaft at each point.
        run: run of each window, -1 for padding.
    """

    integrals: Integrals
    slopes: Float[Array, "two points equations places"]
    time: Float[Array, " points"]
    angle: Float[Array, " points"]
    run: Int[Array, " windows"]

    @property
    def points(self) -> int:
        return self.time.shape[0]

    def at_points(self, rows: np.ndarray) -> np.ndarray:
        return self.integrals.inside(np.asarray(rows, bool), self.points)

    def of_rows(self, points: np.ndarray) -> np.ndarray:
        return self.integrals.mean(np.asarray(points, float)) > 0.5

    def columns(self, balance: Scalar | int, shapes: Array | np.ndarray) -> Float[Array, "readings terms"]:
        f, y = (s[:, :, balance, None] * shapes[:, None, :] for s in self.slopes)
        return (self.integrals(f, y) * self.scale[:, :, None]).reshape(-1, shapes.shape[1])

    def channel_columns(self, channel: Scalar | int, shapes: Array | np.ndarray) -> Float[Array, "readings terms"]:
        return -self.columns(len(PROBED) + channel, shapes)

    def variable(self, name: str) -> np.ndarray:
        if name in bases_room.ORDERS:
            return bases_room.ORDERS[name][0] * np.asarray(self.angle)
        return np.asarray(self.time if name == "time" else getattr(self.signals, name), float)

    def runs(self) -> list[np.ndarray]:
        run = np.asarray(self.run)
        return [np.flatnonzero(run == k) for k in np.unique(run[run >= 0])]


class Windows(LinearRows, SettledRuns):
    """Observer of the windows of a log.

    Attributes:
        table: columns of the log at its points.
    """

    word: ClassVar[str] = "window"
    fewest: ClassVar[int] = 24
    blocks: ClassVar[Names] = ("slope", "voltage", "run", "part")
    reads: ClassVar[bool] = False

    table: dict[str, Array]

    def detail(self, bases: bases_room.Bases, included: np.ndarray, before: Any, after: Any) -> Any:
        raise NotImplementedError  # that of the log

    def bases(self, columns: Columns, included: np.ndarray, robot: Robot) -> bases_room.Bases:
        linear = self.linear
        ways = {name: np.sign(linear.variable(name)) for name in WAYS}
        table = {bases_room.VARIABLES[v]: linear.variable(v) for v in UNSHOWN}
        table |= {name: np.asarray(x) for name, x in self.table.items()}
        weight = linear.at_points(included).astype(float)
        scope = bases_room.CurveScope.of(robot, table)
        return bases_room.families_of_table(table, weight, ways, scope)


def problem_of_windows(
    problem: Problem, fit: weak_form.WeakFormFit, effects: tuple[ScoredEffect, ...],
    columns: Callable[[np.ndarray], Columns], width: float,
) -> tuple[Problem, np.ndarray]:  # fmt: skip
    """Problem of the windows of a log, and the row of the log in the middle of each window.

    Args:
        problem: problem of the log.
        fit: its regression, with the signatures of `effects`.
        columns: function that returns the table in some rows of the log.
        width: prior sd of amplitudes, relative to those of their fields.
    """
    plan = fit.plan
    terms = fit.smooth_terms
    count = len(problem.channels)
    places = (*([plan.current] * plan.electrical), *([plan.motion] * plan.mechanical), *plan.others)
    run = np.repeat([w.run for w in fit.windows], [len(w.rows) for w in fit.windows])
    run = np.pad(run, (0, -len(run) % TOGETHER), constant_values=-1)
    windows = shown_states.join_windows(fit.windows, int(np.sum(run < 0)))
    slope_weights = np.stack(weak_form.derivative_weights(plan, windows, len(places)))
    parts = [windows.part(k) for k in np.split(np.arange(len(run)), len(run) // TOGETHER)]
    sd = np.asarray(fit.rows.sd)
    size = len(fit.z)
    has_no_equation = np.ones(count, bool)
    has_no_equation[list(places)] = False
    zero_readings = np.where((run < 0)[:, None] | has_no_equation, np.nan, 0.0)
    data = dataclasses.replace(
        data_from_readings(zero_readings, np.ones_like(zero_readings), size), centre=jnp.asarray(fit.centre)
    )
    finite_numbers = functools.partial(np.nan_to_num, posinf=0.0, neginf=0.0)
    reading_slopes = finite_numbers(
        [np.concatenate(x, 2) for x in zip(terms.by_balance, terms.by_reading, strict=True)]
    )
    errors = [x[..., None] for x in fit.read_terms]
    plain = [jnp.asarray(np.concatenate(x, 2)) for x in zip(errors, terms.by_z, terms.by_effects, strict=True)]

    def linearised(disturbances: np.ndarray) -> tuple[WindowsLinearization, list[np.ndarray]]:
        factors = [weak_form.covariance_factor(plan, w, sd, terms, disturbances) for w in parts]
        white = np.stack([np.linalg.inv(x) for x in factors])
        integrals = Integrals(
            jnp.asarray(windows.rows), jnp.asarray(windows.weight), jnp.asarray(slope_weights), jnp.asarray(white),
            places, count,
        )  # fmt: skip

        whitened = np.asarray(_whitened(integrals, *plain)).reshape(-1, plain[0].shape[2])
        prior = np.concatenate([np.zeros(len(run)), fit.origin - fit.centre])
        jacobian = np.concatenate([whitened[:, 1 : size + 1], np.zeros((len(run), size)), np.eye(size)])
        linear = WindowsLinearization(
            jnp.asarray(np.concatenate([whitened[:, 0], prior])), jnp.asarray(jacobian),
            jnp.asarray(finite_numbers(whitened[:, size + 1 :])), jnp.zeros((len(PROBED), 0)), data.weight,
            jax.tree.map(jnp.asarray, terms.signals), integrals, jnp.asarray(reading_slopes),
            fit.rows.time, fit.rows.angle, jnp.asarray(run),
            channels=channels.channel_names(problem.channels), magnitudes=problem.base.rig.magnitudes,
        )  # fmt: skip
        return linear, factors

    linear, factors = linearised(disturbances := np.zeros(len(places)))
    reading_factors = factors
    for _ in range(ROUNDS):  # the intensity depends on the weights of the windows, which depend on it
        previous = disturbances
        disturbances = _unexplained(linear, parts, factors, reading_factors, size, np.asarray(data.weight))
        if np.allclose(disturbances, previous, rtol=SAME):
            break
        linear, factors = linearised(disturbances)
    middle = np.take_along_axis(windows.rows, np.argmax(windows.weight, 1)[:, None], 1)[:, 0]
    table = {name: jnp.asarray(x) for name, x in columns(np.asarray(fit.rows.table_row)).items()}
    table |= {c.column: fit.rows.readings[:, k] for k, c in enumerate(problem.channels)}
    index, grid = grid_of_effects(effects)
    conditions = jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[middle]), fit.rows.conditions)
    observe = Windows(
        conditions, "drive", table, linear=linear, origin=jnp.asarray(fit.origin), start=jnp.asarray(fit.z),
        width=width, effect=index, grid=grid,
    )  # fmt: skip
    return Problem(problem.base, problem.coordinates, observe, data), np.asarray(fit.rows.table_row)[middle]


def _unexplained(
    linear: WindowsLinearization, parts: list[shown_states.RunWindows], factors: list[np.ndarray],
    reading_factors: list[np.ndarray], size: int, weight: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Intensity of the disturbance of each equation that neither the readings nor a few effects explain.

    Args:
        factors: Cholesky factors of the covariance that weights the windows of each part.
        reading_factors: the same factors for the noise of the readings alone.
        size: number of base coordinates.
    """
    readings = linear.readings
    places = linear.integrals.places
    columns, residuals = (np.asarray(x) for x in (linear.jacobian, linear.residual))
    signatures = np.zeros((len(residuals), linear.signatures.shape[1]))
    signatures[:readings] = linear.signatures
    for _ in range(FITTED + 1):
        basis = np.linalg.qr(columns)[0]
        unexplained, remaining_signatures = (
            residuals - basis @ (basis.T @ residuals),
            signatures - basis @ (basis.T @ signatures),
        )
        norm = np.linalg.norm(remaining_signatures, axis=0)
        norm = np.where(norm > 1e-3 * np.linalg.norm(signatures, axis=0), norm, np.inf)
        strongest = int(np.argmax(np.abs(remaining_signatures.T @ unexplained) / norm))
        columns = np.concatenate([columns, signatures[:, [strongest]]], 1)
    by_window = unexplained[:readings].reshape(linear.rows, -1)[:, list(places)]
    window_errors = [
        (x @ by_window[k].T.ravel()).reshape(len(places), -1).T
        for k, x in zip(np.split(np.arange(linear.rows), len(parts)), factors, strict=True)
    ]
    noise = [np.sum(x**2, 1).reshape(len(places), -1).T for x in reading_factors]
    unit = [np.tile(np.sum(w.weight**2 / w.steps, 1)[:, None], len(places)) for w in parts]
    counts = weight[:, places[0]] > 0
    run = np.asarray(linear.run)
    freedom_ratio = counts.sum() / max(counts.sum() - (size + FITTED) / len(places), 1.0)
    of_windows = (np.concatenate(x)[counts] for x in (window_errors, noise, unit))
    defect, variance, per_intensity = of_windows
    scaled = by_window[counts] / np.maximum(np.sqrt(np.mean(by_window[counts] ** 2, 0)), 1e-300)
    variance_ratios = [
        variance_of_sums([scaled[run[counts] == k, equation] for k in np.unique(run[counts])])
        for equation in range(len(places))
    ]
    return np.sqrt(variance_ratios) * weak_form.disturbance_intensities(
        defect * np.sqrt(freedom_ratio), variance, per_intensity
    )
