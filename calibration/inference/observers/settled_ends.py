"""Where fits of histories begin: at what their settled ends say, for any adhesion of the ground.

The misfit of a start has valleys: a run that grips where the measured one slides, or the other way round, stays so
all the way down. How a run ends depends on that by its creep alone, so the base is fitted to the settled ends first,
by `steady`, once for each adhesion of a grid. Histories are then fitted from there and from draws of the prior with
blunt instruments, which lets no inrush outweigh all the rest; and since configurations share the drive alone, the
best of each is put together with the best of the others. A friction that rises until it slides has a valley of its
own beside that of one that falls from a peak with the same creep, so the second is tried beside what was found.
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
from calibration.inference.optimizers import CORES, Optimum, Pin, levenberg_marquardt
from calibration.inference.priors import TIED
from calibration.inference.problem import Problem, data_of
from mmrjax.compile.compiling import compiled
from mmrjax.compile.precision import Threads
from mmrjax.model import channels
from mmrjax.model.conditions import Conditions

if TYPE_CHECKING:
    from calibration.inference.observers.time_histories import Histories

#: Adhesions that are tried [-].
ADHESIONS = (0.06, 0.1, 0.15, 0.2, 0.27, 0.36, 0.48, 0.64, 0.85, 1.1)
#: Adhesion [-] and V_s [m/s] of the surfaces that are drawn.
SURFACES = {"ground.friction.static": (0.05, 1.2), "ground.friction.speed_static": (0.002, 0.08)}
#: Share of a run that is its end, and change of a channel between the halves of an end that is settled: as a share of
#: the reading, and in sds of the difference.
END, CHANGE, CHANGE_SD = 0.2, 0.02, 4.0
#: Fewest readings of an end.
FEWEST = 4
#: Slip of the movers beyond which a run slides: it tells nothing of settled travel [-].
SLIDES = 0.4
#: Least relative sd of an end's mean: what is not quite settled is no better known [-].
FLOOR = 0.01
#: Shares of the V_s at the settled ends that are tried: creep at the noise's size does not tell it.
FINER = (1.0, 0.25)
#: Steps of a fit to settled ends; of one with blunt instruments, and how many of those there are.
STEPS, STEPS_BLUNT, SEARCHES = 40, 20, 8
#: Sd of a blunt instrument, over its channel's root mean square [-].
BLUNT = 0.03
#: Draws of the prior, beside the settled ends.
DRAWS = 96
#: Points that are followed in one call, calls side by side on the cores.
TOGETHER = 16
#: Distance of two starts in a coordinate from which they are two [prior sds].
APART = 0.1
#: Of a chassis' friction law what creep shows, and what only sliding does.
GRIP = STATIC, CREEP = "ground.friction.static", "ground.friction.speed_static"
SLIDING = "ground.friction.dynamic", "ground.friction.speed_dynamic"


@dataclasses.dataclass(frozen=True)
class Ends:
    """Means over the settled ends of runs, and of the stretches of runs whose conditions change.

    Attributes:
        conditions: shape (ends,).
        mean, sd: [SI], NaN where a channel is not read or not settled, shape (ends, channels).
        shown: the same means, settled or not.
    """

    conditions: Conditions
    mean: np.ndarray
    sd: np.ndarray
    shown: np.ndarray


def settled_ends(problem: Problem) -> Ends:
    """What the runs of a problem show at their ends, as far as they are settled, driven forwards."""
    observe: Histories = problem.observe  # type: ignore[assignment]
    data = problem.data
    measured, sd, weight = (np.asarray(x) for x in (data.measured, data.sd, data.weight))
    time = np.asarray(observe.time)
    every = [s for run in observe.stretches() for s in run]
    found = [s for s in every if s.whole or (s.driven and len(s.after(time, 1 - END)) >= FEWEST)] or every[:1]
    mean, error, shown = (np.full((len(found), measured.shape[1]), np.nan) for _ in range(3))
    for k, stretch in enumerate(found):
        end = stretch.after(time, 1 - END) if stretch.driven else stretch.rows[:0]
        for c in range(measured.shape[1]):
            these = end[weight[end, c] > 0]
            if len(these) < FEWEST:
                continue
            shown[k, c] = measured[these, c].mean()
            halves = np.array_split(measured[these, c], 2)
            change = abs(halves[1].mean() - halves[0].mean())
            noise = 2 * np.median(sd[these, c]) / np.sqrt(len(these))
            size = abs(shown[k, c])
            if change < max(CHANGE * size, CHANGE_SD * noise):
                mean[k, c] = shown[k, c]
                error[k, c] = max(noise / 2, FLOOR * size)
    conditions = observe.conditions
    if observe.varying:
        rows = np.array([s.rows[0] for s in found])
        conditions = jax.tree.map(lambda x: x[rows], observe.of_rows)
    # What is not driven forwards has no readings here: any conditions of steady travel do.
    driven = jnp.asarray([s.driven for s in found])
    conditions = dataclasses.replace(
        conditions,
        voltage=jnp.where(driven, conditions.voltage, 24.0),
        duty=jnp.where(driven, conditions.duty, 1.0),
        open=jnp.where(driven, conditions.open, 0.0),
    )
    return Ends(conditions, mean, np.where(np.isfinite(error), np.maximum(error, 1e-12), np.nan), shown)


def starts(
    problem: Problem, draws: Float[np.ndarray, "draws parameters"], search: Callable[..., Optimum]
) -> Float[np.ndarray, "starts parameters"]:
    """Coordinates at which searches of a base may begin, the most promising first.

    Args:
        problem: of histories, without effects in its coordinates.
        draws: of the prior, tried beside the settled ends.
        search: (problem, starts, most steps) → where a batch of searches of its ends.
    """
    ends = _at_ends(problem)
    friction = np.array(["ground.friction." in n for n in problem.coordinates.names])
    points = np.concatenate([ends, np.where(friction, _spread(problem, draws), ends[0]), 0 * ends[:1], draws])
    blunt = _blunt(problem)
    found = search(blunt, _recombined(blunt, points)[:SEARCHES], STEPS_BLUNT)
    ended = np.asarray(found.z)[np.argsort(np.asarray(found.cost))]
    best = _recombined(blunt, ended)[:1]
    return _apart(np.concatenate([best, _peaked(problem, best[0]), ended]))


def _peaked(problem: Problem, z: np.ndarray) -> np.ndarray:
    """z with a friction that falls from a peak, creep and sliding friction the same: its μ_s, V_s and V_d in the
    nominal ratios to μ_d and to each other, of one configuration and of all; shape (points, parameters)."""
    c, out, every = problem.coordinates, [], z.copy()
    value, nominal = np.asarray(c.value(z)), np.asarray(c.value(np.zeros(len(c))))
    for name in problem.base.configurations:
        own = [f"{name}.{x}" for x in (*GRIP, *SLIDING)]
        if not set(own[:3]) <= set(c.names):
            continue
        static, creep, dynamic, *sliding = (c.names.index(n) for n in own if n in c.names)
        rise = value[dynamic] / nominal[dynamic] * nominal[static] / value[static]
        new = {static: value[static] * rise, creep: value[creep] * rise}
        new |= {k: new[creep] * nominal[k] / nominal[creep] for k in sliding}
        out.append(z.copy())
        for k, x in new.items():
            out[-1][k] = every[k] = _coordinate(problem, k, x)
    return np.stack([*out, every])


def _apart(points: np.ndarray) -> np.ndarray:
    """Points without those that are not apart from an earlier one."""
    kept: list[np.ndarray] = []
    for z in points:
        if all(np.max(np.abs(z - k)) > APART for k in kept):
            kept.append(z)
    return np.stack(kept)


def _recombined(problem: Problem, points: np.ndarray) -> np.ndarray:
    """Points with the parameters of each configuration exchanged, so that the k-th has what fits its runs k-th best;
    what is shared is that of the point that fits all runs best."""
    by_run = _misfit_of_runs(problem, points)
    mixed = np.tile(points[int(np.argmin(by_run.sum(1)))], (len(points), 1))
    which = np.asarray(problem.observe.conditions.configuration)
    for k, name in enumerate(problem.base.configurations):
        own = [j for j, n in enumerate(problem.coordinates.names) if n.startswith(f"{name}.")]
        if own and (which == k).any():
            order = np.argsort(by_run[:, which == k].sum(1), kind="stable")
            mixed[:, own] = points[order][:, own]
    return mixed


def _spread(problem: Problem, draws: np.ndarray) -> np.ndarray:
    """Draws with adhesion and V_s spread evenly (in logarithms) over what surfaces show, dynamic values in their
    nominal ratio to static ones."""
    out = []
    for z in draws:
        z = z.copy()
        for k, name in enumerate(problem.coordinates.names):
            for suffix, (low, high) in SURFACES.items():
                if name.endswith(suffix):
                    share = ndtr(z[k])
                    z[k] = _coordinate(problem, k, low * (high / low) ** share)
        out.append(_with_sliding(problem, z, 1.0))
    return np.stack(out)


def _coordinate(problem: Problem, k: int, value: float) -> float:
    """The coordinate at which a parameter has a value [SI]."""
    c = problem.coordinates
    location, spread, scale = (np.asarray(x)[k] for x in (c.location, c.spread, c.scale))
    return float(((np.log(value) if scale else value) - location) / spread)


def _blunt(problem: Problem) -> Problem:
    """The problem as it would be with blunt instruments."""
    data = problem.data
    count = np.maximum(np.sum(np.asarray(data.weight) > 0, 0), 1)
    rms = np.sqrt(np.sum(np.asarray(data.weight > 0) * np.asarray(data.measured) ** 2, 0) / count)
    return dataclasses.replace(problem, data=dataclasses.replace(data, sd=jnp.hypot(data.sd, BLUNT * rms)))


def _at_ends(problem: Problem) -> Float[np.ndarray, "starts parameters"]:
    """Fits to the settled ends: with each adhesion of the grid, and with a free one."""
    names = problem.coordinates.names
    statics = [k for k, n in enumerate(names) if n.endswith(STATIC)]
    ends = settled_ends(problem)
    mean = np.where(_sliding(problem, ends)[:, None], np.nan, ends.mean)
    observe = SettledRuns(ends.conditions, "steady")
    here = Problem(problem.base, problem.coordinates, observe, data_of(mean, ends.sd, len(names)))
    pinned = np.stack([_with_adhesion(problem, np.zeros(len(names)), a) for a in ADHESIONS])
    held = np.zeros(pinned.shape, bool)
    held[:, statics] = True
    fitted = jax.device_get(_pinned(here, jnp.asarray(pinned), jnp.asarray(held)))
    free = jax.device_get(_pinned(here, jnp.asarray(fitted.z), jnp.zeros(held.shape, bool)))
    best = free.z[int(np.argmin(np.where(np.isfinite(free.cost), free.cost, np.inf)))]
    wanted = [z for z in (best, *fitted.z) if np.all(np.isfinite(z))]
    return np.stack([_with_sliding(problem, z, share) for z in wanted for share in FINER])


def _sliding(problem: Problem, ends: Ends) -> np.ndarray:
    """Whether a run's movers spin at its end, shape (runs,): also while it still gains speed, forwards or back."""
    if not {"motor_speed", "speed"} <= set(problem.base.rig.channels):
        return np.zeros(len(ends.mean), bool)
    turning, travelling = (ends.shown[:, channels.index(c, problem.channels)] for c in ("motor_speed", "speed"))
    robot = problem.base
    radius = np.array([float(c.radius) for c in robot.configurations.members])
    circumference = radius[np.asarray(ends.conditions.configuration)] * turning
    with np.errstate(invalid="ignore", divide="ignore"):
        slip = 1 - travelling / (circumference / float(robot.gearbox.ratio))
    return np.nan_to_num(slip) > SLIDES


def _with_adhesion(problem: Problem, z: np.ndarray, adhesion: float) -> np.ndarray:
    """z with this adhesion in every configuration."""
    z, c = z.copy(), problem.coordinates
    for k, name in enumerate(c.names):
        if name.endswith(STATIC):
            z[k] = _coordinate(problem, k, adhesion)
    return z


def _with_sliding(problem: Problem, z: np.ndarray, share: float) -> np.ndarray:
    """z with a share of its V_s, and what settled ends do not show in the nominal ratio to what they do."""
    c = problem.coordinates
    value = np.array(c.value(np.asarray(z)))
    nominal = c.value(np.zeros(len(c)))
    for k, name in enumerate(c.names):
        if name.endswith(CREEP):
            value[k] *= share
    for k, name in enumerate(c.names):
        for follower, leader in TIED:
            if name.endswith(follower) and (own := name.removesuffix(follower) + leader) in c.names:
                j = c.names.index(own)
                value[k] = nominal[k] * value[j] / nominal[j]
    inside = np.where(c.scale, np.log(np.maximum(value, 1e-12)), value)
    changed = value != c.value(np.asarray(z))
    return np.where(changed, (inside - np.asarray(c.location)) / np.asarray(c.spread), z)


@compiled
def _pinned(problem: Problem, starts: Array, held: Array) -> Optimum:
    def one(z: Array, held: Array) -> Optimum:
        return levenberg_marquardt(problem, z, problem.data, Pin(held, z), max_steps=STEPS)[0]

    return jax.vmap(one)(starts, held)


def _misfit_of_runs(problem: Problem, points: np.ndarray) -> np.ndarray:
    """Sum of squares of the readings of each run at each point [σ²], infinite where one cannot be followed; shape
    (points, runs)."""
    observe: Histories = problem.observe  # type: ignore[assignment]
    filled = np.resize(points, (-(-len(points) // TOGETHER) * TOGETHER, points.shape[1]))
    parts = filled.reshape(-1, TOGETHER, points.shape[1])
    first = _misfits(problem, jnp.asarray(parts[0]))  # compiles the program
    with Threads(CORES) as cores:
        each = [first, *cores.map(lambda part: _misfits(problem, jnp.asarray(part)), parts[1:])]
    by_row = np.sum(np.concatenate([np.asarray(x) for x in each])[: len(points)] ** 2, 2)
    by_run = np.zeros((len(points), len(observe.rows_of)))
    np.add.at(by_run.T, np.asarray(observe.run), by_row.T)
    return np.where(np.isfinite(by_run), by_run, np.inf)


@compiled
def _misfits(problem: Problem, zs: Array) -> Array:
    """Whitened residuals of the readings at each point, shape (points, rows, channels)."""
    shape = problem.data.measured.shape
    return jax.vmap(lambda z: problem.misfit(z, problem.data)[: problem.data.measured.size].reshape(shape))(zs)
