"""Windows of a log: each row is the balances of a log, integrated against one window in time.

A reading is 0, and its prediction is the whitened error of an equation (`weak_form`). So a log is a table, and no run
is simulated. At states that the readings give, the equations are linear in the sizes of effects and nearly linear in
the base parameters. So all fits are those of the linearised equations.
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
from calibration.inference.bases import Bases
from calibration.inference.lack_of_fit import variance_of_sums
from calibration.inference.linearization import PROBED, Linearization, ScoredEffect
from calibration.inference.observers.linear_rows import LinearRows, grid_of_effects
from calibration.inference.observers.settled import SettledRuns
from calibration.inference.problem import Problem, data_from_readings
from calibration.inference.shown_states import RunWindows, join_windows
from calibration.inference.weak_form import (
    WeakFormFit,
    covariance_factor,
    derivative_weights,
    disturbance_intensities,
)
from mmrjax.compile.compiling import compiled
from mmrjax.effects.curve import WAYS
from mmrjax.model import channels
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot

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
        plain = jnp.stack(
            [
                integral(self.weight, f[self.index, k]) + integral(slope, y[self.index, k])
                for k, slope in enumerate(self.slope)
            ]
        )
        parts, columns = len(self.white), f.shape[-1]
        flat = plain.reshape(len(self.slope), parts, -1, columns).swapaxes(0, 1).reshape(parts, -1, columns)
        flat = jnp.einsum("pij,pjc->pic", self.white, flat)
        by_window = jnp.moveaxis(flat.reshape(parts, len(self.slope), -1, columns), 1, 2)
        out = jnp.zeros((len(self.index), self.count, columns))
        return out.at[:, np.asarray(self.places)].set(by_window.reshape(len(self.index), -1, columns))

    def inside(self, windows: np.ndarray, points: int) -> np.ndarray:
        """True for points within some of the windows."""
        index, weight = (np.asarray(x)[windows] for x in (self.index, self.weight))
        return np.isin(np.arange(points), index[weight > 0])

    def mean(self, x: np.ndarray) -> np.ndarray:
        """Mean of a quantity of the points in each window."""
        weight = np.asarray(self.weight)
        return np.sum(weight * x[np.asarray(self.index)], 1) / np.maximum(np.sum(weight, 1), 1e-300)


_whitened = compiled(Integrals.__call__)


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

    def shown(self, channel: Scalar | int, shapes: Array | np.ndarray) -> Float[Array, "readings terms"]:
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

    def detail(self, bases: Bases, included: np.ndarray, before: Any, after: Any) -> Any:
        raise NotImplementedError  # that of the log

    def bases(self, columns: Columns, included: np.ndarray, robot: Robot) -> Bases:
        linear = self.linear
        ways = {name: np.sign(linear.variable(name)) for name in WAYS}
        table = {bases_room.VARIABLES[v]: linear.variable(v) for v in UNSHOWN}
        table |= {name: np.asarray(x) for name, x in self.table.items()}
        weight, scope = linear.at_points(included).astype(float), bases_room.CurveScope.of(robot, table)
        return bases_room.families_of_table(table, weight, ways, scope)


def problem_of_windows(
    problem: Problem, fit: WeakFormFit, effects: tuple[ScoredEffect, ...], columns: Callable[[np.ndarray], Columns],
    width: float,
) -> tuple[Problem, np.ndarray]:  # fmt: skip
    """Problem of the windows of a log, and the row of the log in the middle of each window.

    Args:
        problem: problem of the log.
        fit: its regression, with the signatures of `effects`.
        columns: function that returns the table in some rows of the log.
        width: prior sd of amplitudes, relative to those of their fields.
    """
    plan, terms, count = fit.plan, fit.smooth, len(problem.channels)
    places = (*([plan.current] * plan.electrical), *([plan.motion] * plan.mechanical), *plan.others)
    run = np.repeat([w.run for w in fit.cut], [len(w.rows) for w in fit.cut])
    run = np.pad(run, (0, -len(run) % TOGETHER), constant_values=-1)
    windows = join_windows(fit.cut, int(np.sum(run < 0)))
    slope = np.stack(derivative_weights(plan, windows, len(places)))
    parts = [windows.part(k) for k in np.split(np.arange(len(run)), len(run) // TOGETHER)]
    sd, size = np.asarray(fit.rows.sd), len(fit.z)
    absent = np.ones(count, bool)
    absent[list(places)] = False
    none = np.where((run < 0)[:, None] | absent, np.nan, 0.0)
    data = dataclasses.replace(data_from_readings(none, np.ones_like(none), size), centre=jnp.asarray(fit.centre))
    finite = functools.partial(np.nan_to_num, posinf=0.0, neginf=0.0)
    reading_slopes = finite([np.concatenate(x, 2) for x in zip(terms.by_balance, terms.by_reading, strict=True)])
    errors = [x[..., None] for x in fit.read]
    plain = [jnp.asarray(np.concatenate(x, 2)) for x in zip(errors, terms.by_z, terms.by_effects, strict=True)]

    def linearised(unknown: np.ndarray) -> tuple[WindowsLinearization, list[np.ndarray]]:
        factors = [covariance_factor(plan, w, sd, terms, unknown) for w in parts]
        white = np.stack([np.linalg.inv(x) for x in factors])
        integrals = Integrals(
            jnp.asarray(windows.rows), jnp.asarray(windows.weight), jnp.asarray(slope), jnp.asarray(white), places,
            count,
        )  # fmt: skip

        whitened = np.asarray(_whitened(integrals, *plain)).reshape(-1, plain[0].shape[2])
        prior = np.concatenate([np.zeros(len(run)), fit.origin - fit.centre])
        jacobian = np.concatenate([whitened[:, 1 : size + 1], np.zeros((len(run), size)), np.eye(size)])
        linear = WindowsLinearization(
            jnp.asarray(np.concatenate([whitened[:, 0], prior])), jnp.asarray(jacobian),
            jnp.asarray(finite(whitened[:, size + 1 :])), jnp.zeros((len(PROBED), 0)), data.weight,
            jax.tree.map(jnp.asarray, terms.signals), integrals, jnp.asarray(reading_slopes),
            fit.rows.time, fit.rows.angle, jnp.asarray(run),
            channels=channels.channel_names(problem.channels), magnitudes=problem.base.rig.magnitudes,
        )  # fmt: skip
        return linear, factors

    linear, factors = linearised(unknown := np.zeros(len(places)))
    of_readings = factors
    for _ in range(ROUNDS):  # the intensity depends on the weights of the windows, which depend on it
        before, unknown = unknown, _unexplained(linear, parts, factors, of_readings, size, np.asarray(data.weight))
        if np.allclose(unknown, before, rtol=SAME):
            break
        linear, factors = linearised(unknown)
    middle = np.take_along_axis(windows.rows, np.argmax(windows.weight, 1)[:, None], 1)[:, 0]
    table = {name: jnp.asarray(x) for name, x in columns(np.asarray(fit.rows.first)).items()}
    table |= {c.column: fit.rows.shown[:, k] for k, c in enumerate(problem.channels)}
    index, grid = grid_of_effects(effects)
    conditions = jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[middle]), fit.rows.conditions)
    observe = Windows(
        conditions, "drive", table, linear=linear, origin=jnp.asarray(fit.origin), start=jnp.asarray(fit.z),
        width=width, effect=index, grid=grid,
    )  # fmt: skip
    return Problem(problem.base, problem.coordinates, observe, data), np.asarray(fit.rows.first)[middle]


def _unexplained(
    linear: WindowsLinearization, parts: list[RunWindows], factors: list[np.ndarray], of_readings: list[np.ndarray],
    size: int, weight: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Intensity of the disturbance of each equation that neither the readings nor a few effects explain.

    Args:
        factors: Cholesky factors of the covariance that weights the windows of each part.
        of_readings: the same factors for the noise of the readings alone.
        size: number of base coordinates.
    """
    readings, places = linear.readings, linear.integrals.places
    columns, e = (np.asarray(x) for x in (linear.jacobian, linear.residual))
    signatures = np.zeros((len(e), linear.signatures.shape[1]))
    signatures[:readings] = linear.signatures
    for _ in range(FITTED + 1):
        q = np.linalg.qr(columns)[0]
        left, rest = e - q @ (q.T @ e), signatures - q @ (q.T @ signatures)
        norm = np.linalg.norm(rest, axis=0)
        norm = np.where(norm > 1e-3 * np.linalg.norm(signatures, axis=0), norm, np.inf)
        best = int(np.argmax(np.abs(rest.T @ left) / norm))
        columns = np.concatenate([columns, signatures[:, [best]]], 1)
    by_window = left[:readings].reshape(linear.rows, -1)[:, list(places)]
    plain = [
        (x @ by_window[k].T.ravel()).reshape(len(places), -1).T
        for k, x in zip(np.split(np.arange(linear.rows), len(parts)), factors, strict=True)
    ]
    noise = [np.sum(x**2, 1).reshape(len(places), -1).T for x in of_readings]
    unit = [np.tile(np.sum(w.weight**2 / w.steps, 1)[:, None], len(places)) for w in parts]
    counts, run = weight[:, places[0]] > 0, np.asarray(linear.run)
    free = counts.sum() / max(counts.sum() - (size + FITTED) / len(places), 1.0)
    of_windows = (np.concatenate(x)[counts] for x in (plain, noise, unit))
    defect, variance, per_intensity = of_windows
    white = by_window[counts] / np.maximum(np.sqrt(np.mean(by_window[counts] ** 2, 0)), 1e-300)
    slow = [
        variance_of_sums([white[run[counts] == k, e] for k in np.unique(run[counts])]) for e in range(len(places))
    ]
    return np.sqrt(slow) * disturbance_intensities(defect * np.sqrt(free), variance, per_intensity)
