"""Measured rows held out by slope and by voltage, for the track model with a free running gear.

    python benchmarks/track_table.py slip --seconds 480      # slip of the tracked rows, nine constants
    python benchmarks/track_table.py table --seconds 480     # all readings of all twenty rows
    python benchmarks/track_table.py slip --simulated        # with the paper's simulated slip as a prior of the
                                                             # held-out rows, and searches for that slip only
    python benchmarks/track_table.py lumped                  # slip of the tracked rows by `steady`, for comparison
    python benchmarks/track_table.py time --population 4096  # gears x 20 rows x 1.5 s by the track model

All searches (of all rows, and without each block of rows) run together: one batch runs a generation of each. A
search judges and uses only members that it drew itself, so that none knows its held-out rows. Rows that change
between regimes run three times, at voltages 0.1 % apart, and count by their mean square. The best members of each
search run again at half and a quarter of the step. Its answer is the member with the lowest mean cost of the three
steps, on the rows that its search saw.

With `--simulated` the paper's simulated slip of all ten tracked rows counts too, also for rows whose measured slip is
left out. Its sd is the rms of simulated less measured slip over the tracked rows that the search sees. With
`--state FILE` the searches are stored, and the same command continues them. Prints lines of JSON.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import pickle
import re
import sys
import time
from pathlib import Path
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import equinox as eqx  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from cmaes import CMA  # noqa: E402
from jaxtyping import Array  # noqa: E402
from measure import machine  # noqa: E402
from scipy.optimize import least_squares  # noqa: E402

from calibration.data import inferred_facts  # noqa: E402
from calibration.data.runs import Runs, read_runs  # noqa: E402
from calibration.inference import priors  # noqa: E402
from calibration.inference.blocks import fit_from_each_start  # noqa: E402
from calibration.inference.observers.settled import SettledRuns  # noqa: E402
from calibration.inference.population import simulate_members  # noqa: E402
from calibration.inference.problem import MARGIN, STIFFNESS, Observation, Problem, data_from_readings  # noqa: E402
from mmrjax.effects.mass_effects import MassOffset  # noqa: E402
from mmrjax.effects.travel_effects import VibrationSlip  # noqa: E402
from mmrjax.effects.voltage_effects import BrushDrop, SeriesResistance  # noqa: E402
from mmrjax.fidelities.steady import steady  # noqa: E402
from mmrjax.fidelities.track import STEP, track  # noqa: E402
from mmrjax.model import channels, paper_robots, params  # noqa: E402
from mmrjax.model.conditions import Conditions  # noqa: E402
from mmrjax.model.robot import Robot  # noqa: E402
from mmrjax.model.signals import Result  # noqa: E402

DURATION = 1.5  # of a run, from a rolling start [s]
FRICTION = tuple(f"6T2A.ground.friction.{name}" for name in ("static", "dynamic", "speed_static"))
GEAR = tuple(
    f"running_gear.{name}"
    for name in (
        "guide_recess",
        "guide_gap",
        "contact_stiffness",
        "contact_damping",
        "centre_offset",
        "payload_height",
    )
)
#: Constants that determine currents and motor speeds, and the friction of the wheeled rows.
DRIVE = (
    "motor.torque_constant",
    "motor.friction_coulomb",
    "motor.friction_viscous",
    "gearbox.efficiency_load",
    "gearbox.friction_coulomb",
    "gearbox.friction_viscous",
    "effects.brush_drop.amplitude",
    "effects.series_resistance.amplitude",
    "effects.mass_offset.amplitude",
    "6T2A.track.loss_coulomb",
    "6T2A.track.loss_viscous",
    "6T2A.track.guide_friction",
    "6T2A.ground.rolling_resistance",
    "4W2T.track.loss_coulomb",
    "4W2T.track.loss_viscous",
    "4W2T.ground.rolling_resistance",
    "4W2T.ground.friction.static",
    "4W2T.ground.friction.speed_static",
)
#: Constants of the lumped model in place of the running gear.
LUMPED = (
    "6T2A.ground.friction.static",
    "6T2A.ground.friction.speed_static",
    "effects.vibration_slip.amplitude",
    "effects.vibration_slip.exponent",
)
#: Sets of docs/explanation/vibration.md: S was fitted to the simulated slip, N to the measured slip.
SET_S = (0.6093, 0.5331, 0.00961, 3.648e-4, 0.01066, 3.816e7, 649.2, 0.00011, 0.0595)
SET_N = (0.5353, 0.4847, 0.00766, 3.841e-4, 0.01465, 1.969e7, 347.5, 0.00536, 0.0912)
NEAR = 0.25  # spread of the first generation about a set [prior sd]
SD_SLIP = {"slip": 0.4, "table": 0.8}  # [percentage points]
SD_CURRENT, SD_MOTOR, SD_SPEED = 2.0, 0.5, 1.0  # [%]
REPEATS = (1.0, 1.001, 0.999)  # of the voltage of rows that change between regimes
WANDERS = (20.0, 9.0)  # rows above this voltage [V] and slope [deg]
FINALISTS = 40
APART = 0.1  # least distance between members of one half [prior sd]
LOST = 1e3  # cost of a row that slides away, tips or leaves the ground


class Resolved(SettledRuns):
    """Tracked rows by the track model, with repeats for changing ones, and wheeled rows by `steady`.

    Wheels have no grousers: the track model returns the same numbers for them (docs/explanation/track-model.md).
    """

    wheeled: Conditions = eqx.field(kw_only=True)
    parts: int = eqx.field(static=True, default=1)

    def __call__(self, robot: Robot) -> Observation:
        def tracked(conditions: Conditions) -> Result:
            return track(robot, conditions, duration=DURATION, step=STEP / self.parts, rolling=True).result

        found = [jax.vmap(tracked)(self.conditions)]
        if self.wheeled.shape[0]:
            found.append(jax.vmap(lambda conditions: steady(robot, conditions))(self.wheeled))

        def joined(get: Any) -> Array:
            return jnp.concatenate([jnp.asarray(get(one)) for one in found])

        reading = jnp.stack([joined(lambda one, n=name: one.reading[n]) for name in channels.USUAL], -1)
        used, status, flags = (joined(lambda one, n=n: getattr(one, n)) for n in ("adhesion_used", "status", "flags"))
        return Observation(reading, used, status, flags)


@dataclasses.dataclass
class Search:
    """One search: the rows that it sees, and the members that it drew and found.

    Attributes:
        name. `seen`: rows that count. `together`: True if speeds share an error, so that slip has a separate one.
        prior: sd of the paper's simulated slip [points], inf if it does not count.
        cma: draws.
        z: members drawn.
        cost: of each.
    """

    name: str
    seen: np.ndarray
    together: bool
    prior: float
    cma: CMA
    z: list[np.ndarray] = dataclasses.field(default_factory=list)
    cost: list[np.ndarray] = dataclasses.field(default_factory=list)

    def best(self, count: int) -> np.ndarray:
        """Members drawn: half of them the best ones, half good ones at a distance from one another."""
        z, cost = np.concatenate(self.z), np.concatenate(self.cost)
        order = np.argsort(cost, kind="stable")
        chosen = [*order[: count // 2]]
        for k in order[count // 2 :]:
            if len(chosen) == count or not np.isfinite(cost[k]):
                break
            if np.min(np.linalg.norm(z[chosen] - z[k], axis=1)) > APART:
                chosen.append(k)
        return z[[*chosen, *order[count // 2 :]][:count]]

    def begin_again(self) -> None:
        """Replaces a converged search by a new one near its best member."""
        if self.cma.should_stop():
            z, cost = np.concatenate(self.z), np.concatenate(self.cost)
            size, seed = self.cma.population_size, 1000 + len(self.z)
            cov = NEAR**2 * np.eye(z.shape[1])
            self.cma = CMA(z[np.argmin(cost)], 1.0, population_size=size, seed=seed, cov=cov)


@dataclasses.dataclass(frozen=True)
class Posed:
    """A problem and its rows.

    Attributes:
        problem: of runs (rows with their repeats).
        row: of each run.
        measured: of each row, (rows, channels).
        slope, voltage, tracked: of each row.
        what: `slip` or `table`.
        simulated: slip of the paper's simulation [%], NaN for wheeled rows.
    """

    problem: Problem
    row: np.ndarray
    measured: np.ndarray
    slope: np.ndarray
    voltage: np.ndarray
    tracked: np.ndarray
    what: str
    simulated: np.ndarray

    def percent(self, reading: np.ndarray) -> np.ndarray:
        """Errors of runs [% of simulated, eq. (35)], and of slip [points], shape (..., runs, channels + 1)."""
        measured = self.measured[self.row]
        with np.errstate(all="ignore"):
            error = 100 * (reading - measured) / reading
            return np.concatenate([error, (self.slip(reading) - self.slip(measured))[..., None]], -1)

    def slip(self, reading: np.ndarray) -> np.ndarray:
        """Slip of runs [%]."""
        chassis, ratio = self.problem.base.configurations, float(self.problem.base.gearbox.ratio)
        radius = np.where(self.tracked, float(chassis["6T2A"].radius), float(chassis["4W2T"].radius))[self.row]
        motor, speed = (reading[..., channels.USUAL.index(name)] for name in ("motor_speed", "speed"))
        with np.errstate(all="ignore"):
            return 100 * (1 - speed * ratio / (motor * radius))

    def cost(self, z: np.ndarray, found: Observation, search: Search) -> np.ndarray:
        """Half the sum of squares of members, over the rows that a search sees."""
        current, motor, speed = (channels.USUAL.index(n) for n in ("total_current", "motor_speed", "speed"))
        error = self.percent(found.reading)
        weight = (search.seen / np.bincount(self.row))[self.row]
        sd = SD_SLIP[self.what]
        if self.what == "slip":
            square = (error[..., -1] / sd) ** 2
        else:
            last = (error[..., -1] / sd) if search.together else (error[..., speed] / SD_SPEED)
            square = (error[..., current] / SD_CURRENT) ** 2 + (error[..., motor] / SD_MOTOR) ** 2 + last**2
        square = square + 2 * LOST * self.problem.observe.unreachable(found.status)
        with np.errstate(all="ignore"):
            cost = 0.5 * np.sum(np.where(weight > 0, weight * square, 0), -1) + 0.5 * np.sum(z**2, -1)
            if np.isfinite(search.prior):
                apart = (self.slip(found.reading) - self.simulated[self.row]) / search.prior
                cost += 0.5 * np.sum(
                    np.where(self.tracked[self.row], apart**2 / np.bincount(self.row)[self.row], 0), -1
                )
        return np.where(np.isfinite(cost), cost, np.inf)

    def mean(self, per_run: np.ndarray) -> np.ndarray:
        """Means over the repeats of each row, shape (..., rows, any)."""
        share = (self.row[None] == np.arange(len(self.measured))[:, None]) / np.bincount(self.row)[:, None]
        return np.einsum("ij,...jk->...ik", share, per_run)


def pose(what: str) -> tuple[Posed, Robot, Runs]:
    """The problem, the robot with its effects, and the table."""
    table = read_runs("measured")
    if what == "slip":
        table = table.where(table["configuration"] == "6T2A")
    robot = inferred_facts.with_table_mass(paper_robots.nominal(), read_runs("measured"))
    if what == "slip":
        robot = params.replace(robot, {"6T2A.track.guide_friction": 0.06})
        names, stated = FRICTION + GEAR, {}
    else:
        robot, stated = priors.with_guide_share(robot, "6T2A")
        zero = jnp.asarray(0.0)
        made = (BrushDrop(amplitude=zero), SeriesResistance(amplitude=zero), MassOffset(amplitude=zero))
        robot = dataclasses.replace(robot, effects=made)
        names = FRICTION + GEAR + DRIVE
    coordinates = priors.parameter_coordinates(robot, names, stated, any_surface=True)
    tracked = table["configuration"] == "6T2A"
    voltage, slope = (np.asarray(table[name], float) for name in ("supply_voltage_V", "slope_deg"))
    runs, factor = [], []
    for row in np.flatnonzero(tracked):
        times = REPEATS if voltage[row] > WANDERS[0] and slope[row] > WANDERS[1] else REPEATS[:1]
        runs += [row] * len(times)
        factor += times
    wheeled = np.flatnonzero(~tracked)
    conditions = table.conditions(robot)
    chosen = jax.tree.map(lambda x: x[np.array(runs)], conditions)
    chosen = dataclasses.replace(chosen, voltage=chosen.voltage * np.array(factor))
    rest = jax.tree.map(lambda x: x[wheeled], conditions)
    row = np.concatenate([runs, wheeled]).astype(int)
    measured = table.measured()
    paper = read_runs("simulated_by_paper")
    paper = paper.where(paper["configuration"] == "6T2A")
    if not all(np.array_equal(paper[n], table.where(tracked)[n]) for n in ("supply_voltage_V", "slope_deg")):
        raise ValueError("the simulated rows of the paper are not those measured")
    motor, speed = (paper.measured()[:, channels.USUAL.index(name)] for name in ("motor_speed", "speed"))
    simulated = np.full(len(measured), np.nan)
    simulated[tracked] = 100 * (1 - speed * float(robot.gearbox.ratio) / (motor * float(robot.radius_pulley)))
    data = data_from_readings(measured[row], SettledRuns.sizes(table)[row], len(names))
    problem = Problem(params.without_weak_types(robot), coordinates, Resolved(chosen, "track", wheeled=rest), data)
    return Posed(problem, row, measured, slope, voltage, tracked, what, simulated), robot, table


def lumped(posed: Posed, robot: Robot, table: Runs, seen: list[np.ndarray]) -> tuple[Problem, np.ndarray, np.ndarray]:
    """`steady` with vibration_slip fitted to the rows of each search: the problem, z and the covariance of each."""
    names = DRIVE + LUMPED
    zero = VibrationSlip(amplitude=jnp.asarray(0.0))
    robot = dataclasses.replace(robot, effects=(*robot.effects, zero))
    stated = priors.with_guide_share(paper_robots.nominal(), "6T2A")[1]
    share = {"total_current": SD_CURRENT, "motor_speed": SD_MOTOR, "speed": SD_SPEED}
    size = np.abs(posed.measured) * np.array([0.01 * share[name] for name in channels.USUAL])
    data = data_from_readings(posed.measured, size, len(names))
    coordinates = priors.parameter_coordinates(robot, names, stated, any_surface=True)
    problem = Problem(params.without_weak_types(robot), coordinates, SettledRuns.of(table, robot, "steady"), data)
    weights = [np.asarray(data.weight) * s[:, None] for s in seen]
    found, _ = fit_from_each_start(problem, [np.zeros(len(names))] * len(seen), weights)
    slope = jax.jit(jax.jacfwd(lambda z, weight: problem.with_data(weight=weight).misfit(z)))
    spread = []
    for z, weight in zip(found.z, weights, strict=True):
        by = np.asarray(slope(jnp.asarray(z), jnp.asarray(weight)))
        spread.append(np.linalg.inv(by.T @ by + np.eye(len(names))))
    return problem, np.asarray(found.z), np.array(spread)


def begun(posed: Posed, arguments: argparse.Namespace, robot: Robot, table: Runs) -> list[Search]:
    """The searches."""
    rows = np.ones(len(posed.measured), bool)
    if posed.what == "slip":
        rows[0] = False  # -2.2 %, of which 1.2 points are printing
    slopes = {f"without {s:g} deg": rows & (posed.slope != s) for s in np.unique(posed.slope)}
    voltages = {f"without {v:g} V": rows & (posed.voltage != v) for v in np.unique(posed.voltage)}
    coordinates = posed.problem.coordinates

    def standard(values: tuple[float, ...]) -> np.ndarray:
        scale = np.array(coordinates.scale)[: len(values)]
        u = np.where(scale, np.log(np.maximum(np.array(values), 1e-12)), np.array(values))
        return (u - np.asarray(coordinates.location)[: len(values)]) / np.asarray(coordinates.spread)[: len(values)]

    one, two = standard(SET_S), standard(SET_N)
    gear, anywhere = NEAR**2 * np.eye(len(one)), np.eye(len(one))
    if posed.what == "slip":
        starts = [
            ("all rows, near S", rows, True, one, gear),
            ("all rows, near N", rows, True, two, gear),
            ("all rows, near both", rows, True, (one + two) / 2, gear),
            ("all rows, anywhere", rows, True, 0 * one, anywhere),
        ]
        if arguments.simulated:
            none = np.zeros_like(rows)
            starts += [("simulation, near S", none, True, one, gear)]
            starts += [("simulation, anywhere", none, True, 0 * one, anywhere)]
        starts += [(name, seen, True, one, gear) for name, seen in slopes.items()]
    else:
        plan = [("all rows", rows, True), ("all rows, speeds apart", rows, False)]
        plan += [(name, seen, True) for name, seen in (slopes | voltages).items()]
        _, z, spread = lumped(posed, robot, table, [seen for _, seen, _ in plan])
        count = len(DRIVE)
        starts = []
        for (name, seen, together), at, cov in zip(plan, z, spread, strict=True):
            both = np.zeros((len(coordinates), len(coordinates)))
            both[: len(one), : len(one)] = gear
            both[len(one) :, len(one) :] = cov[:count, :count]
            starts.append((name, seen, together, np.concatenate([one, at[:count]]), both))

    def prior(seen: np.ndarray) -> float:
        if not arguments.simulated or (posed.what == "slip" and np.array_equal(seen, rows)):
            return np.inf
        if not seen.any():
            return SD_SLIP[posed.what]
        compared = seen & posed.tracked & (np.arange(len(seen)) > 0)
        measured = Posed.slip(dataclasses.replace(posed, row=np.arange(len(seen))), posed.measured)
        return float(np.sqrt(np.mean((posed.simulated - measured)[compared] ** 2)))

    searches = []
    for k, (name, seen, together, centre, cov) in enumerate(starts):
        cma = CMA(centre, 1.0, population_size=arguments.population, seed=arguments.seed + k, cov=cov)
        searches.append(Search(name, seen.astype(float), together, prior(seen), cma))
    return searches


def generations(posed: Posed, searches: list[Search], together: int, arguments: argparse.Namespace) -> int:
    """Runs generations of all searches together, returns their number."""
    start = time.perf_counter()
    for number in range(arguments.generations):
        if time.perf_counter() - start > arguments.seconds:
            break
        drawn = [np.array([s.cma.ask() for _ in range(arguments.population)]) for s in searches]
        found = simulate_members(posed.problem, np.concatenate(drawn), together=together)
        for k, (search, z) in enumerate(zip(searches, drawn, strict=True)):
            here = slice(k * arguments.population, (k + 1) * arguments.population)
            cost = posed.cost(z, jax.tree.map(lambda x: x[here], found), search)  # noqa: B023
            search.z.append(z)
            search.cost.append(cost)
            search.cma.tell([(a, float(min(c, 1e6))) for a, c in zip(z, cost, strict=True)])
            search.begin_again()
        best = " ".join(f"{min(c.min() for c in s.cost):.1f}" for s in searches)
        print(f"{number + 1}: {time.perf_counter() - start:.0f} s, {best}", file=sys.stderr, flush=True)
    if arguments.state:
        arguments.state.write_bytes(pickle.dumps(searches))
    return len(searches[0].z)


@eqx.filter_jit
def _again(problem: Problem, points: Array) -> Observation:
    return jax.vmap(problem.observation)(points)


def finer(posed: Posed, points: np.ndarray, parts: int) -> Observation:
    """Readings of members at a fraction of the step."""
    observe = dataclasses.replace(posed.problem.observe, parts=parts)
    return jax.device_get(_again(dataclasses.replace(posed.problem, observe=observe), jnp.asarray(points)))


def lumped_slip(arguments: argparse.Namespace) -> None:
    """Slip of the tracked rows by `steady`, with Fig. 7 alone and with vibration_slip, fitted to the rows seen."""
    posed, robot, table = pose("slip")
    rows = np.arange(len(table)) > 0
    seen = {"all rows": rows} | {f"without {s:g} deg": rows & (posed.slope != s) for s in np.unique(posed.slope)}
    row = dataclasses.replace(posed, row=np.arange(len(table)))
    measured = row.slip(posed.measured)
    for law, names in (("Fig. 7 alone", LUMPED[:2]), ("vibration_slip", LUMPED)):
        effects = (VibrationSlip(amplitude=jnp.asarray(0.0)),) if len(names) > 2 else ()
        base = dataclasses.replace(robot, effects=effects)
        coordinates = priors.parameter_coordinates(base, names, any_surface=True)
        data = data_from_readings(posed.measured, np.ones_like(posed.measured), len(names))
        problem = Problem(params.without_weak_types(base), coordinates, SettledRuns.of(table, base, "steady"), data)
        observed = eqx.filter_jit(lambda problem, z: problem.observation(z))
        for name, here in seen.items():
            compared = here & (np.arange(len(here)) > 0)
            sd = np.sqrt(np.mean((posed.simulated - measured)[compared] ** 2)) if arguments.simulated else np.inf

            def residuals(z: np.ndarray) -> np.ndarray:
                found = observed(problem, jnp.asarray(z))  # noqa: B023
                slip = np.nan_to_num(row.slip(np.asarray(found.reading)), nan=100.0)
                counted = here | np.isfinite(sd)  # noqa: B023
                over = np.maximum(np.asarray(found.adhesion_used) - (1 - MARGIN), 0) / STIFFNESS * counted
                return np.concatenate([
                    (slip - measured)[here] / SD_SLIP["slip"], (slip - posed.simulated) / sd, over, z,  # noqa: B023
                ])  # fmt: skip

            starts = [np.zeros(len(names)), np.eye(len(names))[0], 0.5 * np.ones(len(names))]
            z = min((least_squares(residuals, z) for z in starts), key=lambda found: found.cost).x
            found = observed(problem, jnp.asarray(z))
            error = row.slip(np.asarray(found.reading)) - measured
            out = rows & ~here
            print(json.dumps({
                "law": law, "search": name, "prior": sd if np.isfinite(sd) else None,
                "seen rms": float(np.sqrt(np.mean(error[here] ** 2)).round(3)), "error": error.round(2).tolist(),
                "held-out error": error[out].round(2).tolist(), "status": np.asarray(found.status).tolist(),
                "constants": np.asarray(coordinates.value(z)).round(5).tolist(),
            }), flush=True)  # fmt: skip


def timed(arguments: argparse.Namespace) -> dict[str, Any]:
    """Time of one generation of gears over all twenty rows, with wheeled ones also by the track model."""
    table = read_runs("measured")
    robot = inferred_facts.with_table_mass(
        params.replace(paper_robots.nominal(), {"6T2A.track.guide_friction": 0.06}), table
    )
    coordinates = priors.parameter_coordinates(robot, FRICTION + GEAR, any_surface=True)
    conditions = table.conditions(robot)
    data = data_from_readings(table.measured(), SettledRuns.sizes(table), len(coordinates))
    none = jax.tree.map(lambda x: x[:0], conditions)
    problem = Problem(
        params.without_weak_types(robot), coordinates, Resolved(conditions, "track", wheeled=none), data
    )
    values = np.where(np.array(coordinates.scale), np.log(np.maximum(np.abs(SET_S), 1e-12)), np.array(SET_S))
    centre = (values - np.asarray(coordinates.location)) / np.asarray(coordinates.spread)
    size = (arguments.population, len(coordinates))
    points = centre + NEAR * np.random.default_rng(arguments.seed).standard_normal(size)
    start = time.perf_counter()

    def advance(done: int) -> None:
        print(f"{done} members, {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)

    found = simulate_members(problem, points, advance)
    took = time.perf_counter() - start
    statuses = dict(zip(*map(np.ndarray.tolist, np.unique(found.status, return_counts=True)), strict=True))
    run = {"gears": len(points), "rows": len(table), "run_s": DURATION, "step": STEP}
    return {**run, "seconds": round(took, 1), "statuses": statuses}


def rms(error: np.ndarray) -> list[float]:
    """Root mean square of each column."""
    return np.sqrt(np.mean(error**2, 0)).round(3).tolist()


def determined(posed: Posed, z: np.ndarray, found: list[Observation], seen: np.ndarray) -> list[float]:
    """Singular values of the slip of tracked rows [its sd] by the constants [prior sd], from a regression."""
    slip = np.mean([posed.mean(posed.slip(s.reading)[..., None])[..., 0] for s in found], 0)[:, seen & posed.tracked]
    usable = np.isfinite(slip).all(1)
    design = np.column_stack([np.ones(usable.sum()), z[usable] - z[usable].mean(0)])
    slope, *_ = np.linalg.lstsq(design, slip[usable] / SD_SLIP[posed.what], rcond=None)
    return np.linalg.svd(slope[1:].T, compute_uv=False).round(2).tolist()


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("what", choices=("slip", "table", "lumped", "time"))
    options.add_argument("--population", type=int, default=56, help="members of a generation of each search")
    options.add_argument("--generations", type=int, default=60)
    options.add_argument("--seconds", type=float, default=np.inf, help="time after which no generation is started")
    options.add_argument("--simulated", action="store_true", help="use the paper's simulated slip too, as a prior")
    options.add_argument("--only", help="regular expression of the names of searches to run")
    options.add_argument(
        "--parts", type=int, nargs="+", default=[1, 2, 4], help="divisors of the step for the finalists"
    )
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--state", type=Path, help="file to store and continue the searches; use only your own")
    arguments = options.parse_args()
    if arguments.what == "time":
        print(json.dumps({"machine": machine(), **timed(arguments)}), flush=True)
        return
    if arguments.what == "lumped":
        lumped_slip(arguments)
        return
    posed, robot, table = pose(arguments.what)
    if arguments.state and arguments.state.exists():
        searches = pickle.loads(arguments.state.read_bytes())
    else:
        searches = begun(posed, arguments, robot, table)
        if arguments.only:
            searches = [s for s in searches if re.search(arguments.only, s.name)]
    together = arguments.population * len(searches)
    start = time.perf_counter()
    count = generations(posed, searches, together, arguments)
    took = time.perf_counter() - start
    finalists = min(FINALISTS, count * arguments.population)
    best = [search.best(finalists) for search in searches]
    points = np.concatenate(best)
    steps = [
        simulate_members(posed.problem, points, together=together) if parts == 1 else finer(posed, points, parts)
        for parts in arguments.parts
    ]
    print(json.dumps({
        "machine": machine(), "what": posed.what, "generations": count, "seconds": round(took, 1),
        "members": count * len(searches) * arguments.population, "names": posed.problem.coordinates.names,
        "columns": [*channels.USUAL, "slip"],
    }), flush=True)  # fmt: skip
    held: dict[str, list[np.ndarray]] = {}
    for k, search in enumerate(searches):
        here = slice(k * finalists, (k + 1) * finalists)
        own = [jax.tree.map(lambda x: x[here], s) for s in steps]  # noqa: B023
        cost = np.mean([posed.cost(points[here], s, search) for s in own], 0)
        at = int(np.argmin(cost))
        seen = search.seen > 0
        shown = seen if seen.any() else posed.tracked
        out = ~shown & ((posed.what == "table") | (np.arange(len(seen)) > 0))
        lowest = np.minimum.accumulate([c.min() for c in search.cost])
        errors = np.array([posed.mean(posed.percent(s.reading[at])) for s in own])
        slip = np.array([posed.mean(posed.slip(s.reading[at])[:, None])[posed.tracked, 0] for s in own])
        if out.any():
            held.setdefault(search.name.split()[-1], []).append(errors[:, out])
        print(json.dumps({
            "search": search.name, "prior": search.prior if np.isfinite(search.prior) else None,
            "cost": cost[at].round(2), "gain of the last 8": float(lowest[-9:][0] - lowest[-1]),
            "seen rms": [rms(e[shown]) for e in errors], "held-out error": errors[:, out].round(2).tolist(),
            "errors": errors[0].round(2).tolist(), "slip": slip.round(2).tolist(),
            "simulated rms": rms((slip - posed.simulated[posed.tracked]).T),
            "singular values": determined(posed, points[here], own, shown),
            "constants": np.asarray(posed.problem.coordinates.value(points[here][at])).tolist(),
            "z": points[here][at].round(2).tolist(),
        }), flush=True)  # fmt: skip
    for kind, parts in held.items():
        print(json.dumps({"held out by": kind, "rms": [rms(e) for e in np.concatenate(parts, 1)]}), flush=True)


if __name__ == "__main__":
    main()
