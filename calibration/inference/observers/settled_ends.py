"""Starts of fits of time histories: fits to their settled ends, at several adhesions of the ground.

The misfit of a start has several valleys: a run that grips although the measured one slides (or the reverse) keeps
doing so during the descent. At its end, a run's dependence on this is through its creep only. So the base is first
fitted to the settled ends, by `steady`, once for each adhesion of a grid. Histories are then fitted from these points
and from draws of the prior with blunt instruments (enlarged sds), so that no inrush dominates. Configurations share
only the drive, so the best parameters of each are combined. A friction that rises until it slides has another valley
than one with the same creep that falls from a peak. The second is tried as well as the optimum found.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import ndtr

from calibration.inference.observers.settled import SettledRuns
from calibration.inference.optimizers import CORES, Optimum, fit_with_held
from calibration.inference.priors import TIED
from calibration.inference.problem import Problem, data_from_readings
from mmrjax.compile.compiling import Threads, compiled
from mmrjax.model import channels
from mmrjax.model.conditions import Conditions

if TYPE_CHECKING:
    from calibration.inference.observers.time_histories import Histories

#: Adhesions of the grid [-].
ADHESIONS = (0.06, 0.1, 0.15, 0.2, 0.27, 0.36, 0.48, 0.64, 0.85, 1.1)
#: Ranges of adhesion [-] and V_s [m/s] from which surfaces are drawn.
SURFACES = {"ground.friction.static": (0.05, 1.2), "ground.friction.speed_static": (0.002, 0.08)}
#: Share of a run that is its end. Largest change of a channel between the halves of a settled end: as a share of the
#: reading, and in sds of the difference.
END, CHANGE, CHANGE_SD = 0.2, 0.02, 4.0
#: Fewest readings of an end.
FEWEST = 4
#: Slip of the movers beyond which a run slides and has no information on settled travel [-].
SLIDES = 0.4
#: Least relative sd of an end's mean, because an end is never exactly settled [-].
FLOOR = 0.01
#: Shares of V_s that are tried: at settled ends, creep the size of the noise does not determine it.
FINER = (1.0, 0.25)
#: Steps of a fit to settled ends, and of one with blunt instruments.
STEPS, STEPS_BLUNT = 40, 20
#: Sd of a blunt instrument, over its channel's root mean square [-].
BLUNT = 0.03
#: Draws of the prior in addition to the settled ends, and number of fits with blunt instruments: without a regression
#: or over several configurations, and beside the regression of one.
MANY, FEW = (96, 8), (4, 2)
#: Points simulated in one call; calls run together on the cores.
TOGETHER = 16
#: Distance in a coordinate from which two starts are distinct [prior sds].
APART = 0.1
#: Parameters of a chassis' friction law that creep shows, and those that only sliding shows.
GRIP = STATIC, CREEP = "ground.friction.static", "ground.friction.speed_static"
SLIDING = "ground.friction.dynamic", "ground.friction.speed_dynamic"


@dataclasses.dataclass(frozen=True)
class SettledEnds:
    """Mean readings over the settled ends of runs, and of the intervals of runs whose conditions change.

    Attributes:
        conditions: conditions at each end, shape (ends,).
        mean, sd: means and their standard deviations [SI], shape (ends, channels). NaN if a channel is not measured
            or not settled.
        all_means: the same means, whether settled or not.
    """

    conditions: Conditions
    mean: np.ndarray
    sd: np.ndarray
    all_means: np.ndarray


def settled_ends_of_runs(problem: Problem) -> SettledEnds:
    """Settled readings at the ends of a problem's runs, all taken as forward."""
    observe: Histories = problem.observe  # type: ignore[assignment]
    data = problem.data
    measured, sd, weight = (np.asarray(x) for x in (data.measured, data.sd, data.weight))
    time = np.asarray(observe.time)
    intervals = [s for run in observe.constant_intervals() for s in run]
    ends = [s for s in intervals if s.whole or (s.driven and len(s.after(time, 1 - END)) >= FEWEST)] or intervals[:1]
    mean, error_of_mean, all_means = (np.full((len(ends), measured.shape[1]), np.nan) for _ in range(3))
    for k, interval in enumerate(ends):
        end_rows = interval.after(time, 1 - END) if interval.driven else interval.rows[:0]
        for c in range(measured.shape[1]):
            read_rows = end_rows[weight[end_rows, c] > 0]
            if len(read_rows) < FEWEST:
                continue
            all_means[k, c] = measured[read_rows, c].mean()
            first, second = np.array_split(measured[read_rows, c], 2)
            noise = 2 * np.median(sd[read_rows, c]) / np.sqrt(len(read_rows))
            size = abs(all_means[k, c])
            if abs(second.mean() - first.mean()) < max(CHANGE * size, CHANGE_SD * noise):
                mean[k, c], error_of_mean[k, c] = all_means[k, c], max(noise / 2, FLOOR * size)
    conditions = observe.conditions
    if observe.varying:
        rows = np.array([s.rows[0] for s in ends])
        conditions = jax.tree.map(lambda x: x[rows], observe.of_rows)
    # Ends that are not driven forwards have no readings here, so any conditions of steady travel are possible.
    is_driven = jnp.asarray([s.driven for s in ends])
    conditions = dataclasses.replace(
        conditions,
        voltage=jnp.where(is_driven, conditions.voltage, 24.0),
        duty=jnp.where(is_driven, conditions.duty, 1.0),
        open=jnp.where(is_driven, conditions.open, 0.0),
    )
    return SettledEnds(
        conditions, mean, np.where(np.isfinite(error_of_mean), np.maximum(error_of_mean, 1e-12), np.nan), all_means
    )


def starts_from_settled_ends(
    problem: Problem, draws: Float[np.ndarray, "draws parameters"], search: Callable[..., Optimum], searches: int
) -> Float[np.ndarray, "starts parameters"]:
    """Initial coordinates for searches of a base, the most promising first.

    Args:
        problem: problem of time histories, without effects in its coordinates.
        draws: random draws of the prior, tried in addition to the settled ends.
        search: function (problem, starts, largest number of steps) → optima of a batch of searches.
        searches: number of searches with blunt instruments.
    """
    ends = _fit_settled_ends(problem)
    friction = np.array(["ground.friction." in n for n in problem.coordinates.names])
    points = np.concatenate(
        [ends, np.where(friction, _spread_over_surfaces(problem, draws), ends[0]), 0 * ends[:1], draws]
    )
    data = problem.data
    counts = np.maximum(np.sum(np.asarray(data.weight) > 0, 0), 1)
    rms = np.sqrt(np.sum(np.asarray(data.weight > 0) * np.asarray(data.measured) ** 2, 0) / counts)
    blunt = problem.with_data(sd=jnp.hypot(data.sd, BLUNT * rms))
    optima = search(blunt, _recombine_points(blunt, points)[:searches], STEPS_BLUNT)
    sorted_optima = np.asarray(optima.z)[np.argsort(np.asarray(optima.cost))]
    best = _recombine_points(blunt, sorted_optima)[:1]
    distinct: list[np.ndarray] = []
    for z in np.concatenate([best, _with_peaked_friction(problem, best[0]), sorted_optima]):
        if all(np.max(np.abs(z - k)) > APART for k in distinct):
            distinct.append(z)
    return np.stack(distinct)


def _with_peaked_friction(problem: Problem, z: np.ndarray) -> np.ndarray:
    """Copies of z whose friction falls from a peak, with unchanged creep and sliding friction, shape (points,
    parameters).

    μ_s, V_s and V_d have their nominal ratios to μ_d and to each other, in one configuration or in all.
    """
    c = problem.coordinates
    points = []
    in_all_configurations = z.copy()
    value, nominal = np.asarray(c.value(z)), np.asarray(c.value(np.zeros(len(c))))
    for name in problem.base.configurations:
        names = [f"{name}.{x}" for x in (*GRIP, *SLIDING)]
        if not set(names[:3]) <= set(c.names):
            continue
        static, creep, dynamic, *sliding = (c.names.index(n) for n in names if n in c.names)
        peak_ratio = value[dynamic] / nominal[dynamic] * nominal[static] / value[static]
        new_values = {static: value[static] * peak_ratio, creep: value[creep] * peak_ratio}
        new_values |= {k: new_values[creep] * nominal[k] / nominal[creep] for k in sliding}
        points.append(z.copy())
        for k, x in new_values.items():
            points[-1][k] = in_all_configurations[k] = _coordinate_of_value(problem, k, x)
    return np.stack([*points, in_all_configurations])


def _recombine_points(problem: Problem, points: np.ndarray) -> np.ndarray:
    """New points from the best parameters of each configuration: the k-th point has the k-th best fit of its runs.

    Shared parameters come from the point that fits all runs best.
    """
    observe: Histories = problem.observe  # type: ignore[assignment]
    padded = np.resize(points, (-(-len(points) // TOGETHER) * TOGETHER, points.shape[1]))
    first_part, *parts = padded.reshape(-1, TOGETHER, points.shape[1])
    first_misfits = _reading_misfits(problem, first_part)  # compiles the program
    with Threads(CORES) as cores:
        misfits = [first_misfits, *cores.map(lambda part: _reading_misfits(problem, part), parts)]
    misfit_of_rows = np.sum(np.concatenate(misfits)[: len(points)] ** 2, 2)
    misfit_of_runs = np.zeros((len(points), len(observe.rows_of)))
    np.add.at(misfit_of_runs.T, np.asarray(observe.run), misfit_of_rows.T)
    misfit_or_infinity = np.where(np.isfinite(misfit_of_runs), misfit_of_runs, np.inf)
    recombined = np.tile(points[int(np.argmin(misfit_or_infinity.sum(1)))], (len(points), 1))
    configuration = np.asarray(problem.observe.conditions.configuration)
    for k, name in enumerate(problem.base.configurations):
        parameters = [j for j, n in enumerate(problem.coordinates.names) if n.startswith(f"{name}.")]
        if parameters and (configuration == k).any():
            order = np.argsort(misfit_or_infinity[:, configuration == k].sum(1), kind="stable")
            recombined[:, parameters] = points[order][:, parameters]
    return recombined


def _spread_over_surfaces(problem: Problem, draws: np.ndarray) -> np.ndarray:
    """Random draws whose adhesion and V_s are spread evenly (in logarithms) over the ranges of all surfaces.

    Dynamic friction values keep their nominal ratio to static ones.
    """
    points = []
    for z in draws:
        z = z.copy()
        for k, name in enumerate(problem.coordinates.names):
            for suffix, (low, high) in SURFACES.items():
                if name.endswith(suffix):
                    probability = ndtr(z[k])
                    z[k] = _coordinate_of_value(problem, k, low * (high / low) ** probability)
        points.append(_with_friction_slope(problem, z, 1.0))
    return np.stack(points)


def _coordinate_of_value(problem: Problem, k: int, value: float) -> float:
    """Coordinate where a parameter has this value [SI]."""
    c = problem.coordinates
    location, spread, scale = (np.asarray(x)[k] for x in (c.location, c.spread, c.scale))
    return float(((np.log(value) if scale else value) - location) / spread)


def _fit_settled_ends(problem: Problem) -> Float[np.ndarray, "starts parameters"]:
    """Fits to the settled ends: one at each adhesion of the grid, and one with a free adhesion."""
    names = problem.coordinates.names
    ends = settled_ends_of_runs(problem)
    mean = np.where(_slides_at_end(problem, ends)[:, None], np.nan, ends.mean)
    observe = SettledRuns(ends.conditions, "steady")
    ends_problem = Problem(problem.base, problem.coordinates, observe, data_from_readings(mean, ends.sd, len(names)))
    fixed_values, is_fixed = np.zeros((len(ADHESIONS), len(names))), np.zeros((len(ADHESIONS), len(names)), bool)
    for k in (k for k, n in enumerate(names) if n.endswith(STATIC)):
        fixed_values[:, k], is_fixed[:, k] = [_coordinate_of_value(problem, k, x) for x in ADHESIONS], True
    fits_at_adhesions = jax.device_get(
        fit_with_held(ends_problem, jnp.asarray(fixed_values), jnp.asarray(is_fixed), STEPS)
    )
    free_fits = fit_with_held(ends_problem, jnp.asarray(fits_at_adhesions.z), jnp.zeros(is_fixed.shape, bool), STEPS)
    free_fits = jax.device_get(free_fits)
    best = free_fits.z[int(np.argmin(np.where(np.isfinite(free_fits.cost), free_fits.cost, np.inf)))]
    finite_points = [z for z in (best, *fits_at_adhesions.z) if np.all(np.isfinite(z))]
    return np.stack([_with_friction_slope(problem, z, share) for z in finite_points for share in FINER])


def _slides_at_end(problem: Problem, ends: SettledEnds) -> np.ndarray:
    """True for each run whose tracks or wheels spin at its end, even if it still gains speed, shape (runs,)."""
    if not {"motor_speed", "speed"} <= set(problem.base.rig.channels):
        return np.zeros(len(ends.mean), bool)
    motor_speed, speed = (
        ends.all_means[:, channels.channel_index(c, problem.channels)] for c in ("motor_speed", "speed")
    )
    radius = np.array([float(c.radius) for c in problem.base.configurations.members])
    mover_speed = radius[np.asarray(ends.conditions.configuration)] * motor_speed
    with np.errstate(invalid="ignore", divide="ignore"):
        slip = 1 - speed / (mover_speed / float(problem.base.gearbox.ratio))
    return np.nan_to_num(slip) > SLIDES


def _with_friction_slope(problem: Problem, z: np.ndarray, share: float) -> np.ndarray:
    """Coordinates z with a share of their V_s. Parameters that settled ends do not determine keep their nominal ratio
    to others.
    """
    c = problem.coordinates
    value = np.array(c.value(np.asarray(z)))
    nominal = c.value(np.zeros(len(c)))
    for k, name in enumerate(c.names):
        if name.endswith(CREEP):
            value[k] *= share
    for k, name in enumerate(c.names):
        for follower, leader in TIED:
            if name.endswith(follower) and (leader_name := name.removesuffix(follower) + leader) in c.names:
                j = c.names.index(leader_name)
                value[k] = nominal[k] * value[j] / nominal[j]
    coordinate = np.where(c.scale, np.log(np.maximum(value, 1e-12)), value)
    is_changed = value != c.value(np.asarray(z))
    return np.where(is_changed, (coordinate - np.asarray(c.location)) / np.asarray(c.spread), z)


@compiled
def _reading_misfits(problem: Problem, zs: np.ndarray) -> Array:
    """Whitened residuals of the readings at each point, shape (points, rows, channels)."""
    shape = problem.data.measured.shape
    return jax.vmap(lambda z: problem.misfit(z)[: problem.data.measured.size].reshape(shape))(zs)
