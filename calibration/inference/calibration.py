"""A calibration from table to result: noise, starts, optimum, what is known of it, errors seen and unseen."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from calibration.data import surfaces
from calibration.data.columns import ROWS
from calibration.data.input_errors import BadConfiguration
from calibration.data.runs import Runs
from calibration.data.thinning import thinned
from calibration.described import in_words
from calibration.inference import blocks as holdout
from calibration.inference import (
    checks,
    estimates,
    identifiability,
    lack_of_fit,
    multistart,
    observers,
    optimizers,
    population,
    priors,
    scans,
    solvers,
)
from calibration.inference.fit_notes import Elsewhere, Fact, Note, OfRows, PriorOfProduct, Step
from calibration.inference.fit_posterior import of_coordinates
from calibration.inference.multistart import Found
from calibration.inference.noise import Noise
from calibration.inference.noise_factor import noise_remarks
from calibration.inference.population import GENERATIONS, LEAST
from calibration.inference.preparation import Prepared, prepare
from calibration.inference.problem import Problem
from calibration.inference.remarks import numbers, remarks
from calibration.inference.residual_clusters import residual_clusters
from calibration.inference.result import CalibrationResult
from mmrjax import fidelities
from mmrjax.compile.precision import SINGLE, in_double, is_double
from mmrjax.model.robot import Robot
from mmrjax.model.signals import FLAGS, STATUSES

#: Members of a generation where parameters are free that `steady` does not read.
POPULATION = 256
#: Fidelity of time histories where none is stated.
OF_HISTORIES = "drive"
#: Parameters that the resolved running gear gives another meaning: beginnings after their configuration.
FRICTION = "ground.friction."


@in_double
def calibrate(
    runs: Runs,
    robot: Robot,
    *,
    free: Sequence[str] = (),
    fix: Sequence[str] = (),
    stated: Mapping[str, tuple[float, float]] | None = None,
    noise: str | None = None,
    model: str | None = None,
    starts: int | None = None,
    population: int | None = None,
    generations: int | None = None,
    members: Path | None = None,
    seed: int = 0,
    profiles: bool | None = None,
    blocks: Sequence[str] | bool | None = None,
    rows: int = ROWS,
    solver: str | optimizers.Solver | None = None,
    tell: Callable[[str], None] = lambda sentence: None,
) -> CalibrationResult:
    """Calibrate `robot` to measured runs.

    Args:
        runs: rows of settled runs, or of time histories.
        robot: its values are the prior means; a mass that the table states takes the place of its own.
        free, fix: parameter names, see `priors.choose`; stated: priors in place of the fields', (mean, sd) [SI].
        noise: as `noise.parse`; None takes the file's sd columns, or estimates.
        model: name of a fidelity; None takes `drive` for time histories and `steady` for settled runs.
        starts: the prior mean and `starts - 1` draws from the prior; for settled rows with a rollout the optimum of
            `steady` and draws from its posterior.
        population: members of each generation of a search without gradients, with which that of a rollout begins;
            None takes `POPULATION` where parameters are free that `steady` does not read, else none.
        generations: at most, None `population.GENERATIONS`; members: file in which those that were run are kept, and
            from which the same calibration goes on.
        seed: of the starts and of all that is drawn; profiles: whether to profile every parameter.
        blocks: kinds of blocks to hold out; True: all that tell something of such data.
            These three by default as the kind of data and the fidelity say.
        rows: of a log over time from which on readings are used of fewer, evenly in time, which its notes say.
        solver: of optimistix, or the name of one (`solvers.NAMES`), for the searches from the starts; None takes
            ours, which also serves all fits that begin at the optimum (profiles, blocks). Penalties on adhesion are
            cut off at 0 for any other than ours.
        tell: is given a sentence now and then while a long calibration goes on.

    Raises:
        BadData: data that cannot be fitted, see `checks.check`.
        BadConfiguration: an unknown fidelity or parameter, a prior or noise that is none, or of a mass that the
            table states, rows that no robot near the priors reaches; an unknown solver; or a call inside `jax.jit`
            where JAX is single.
    """
    if not is_double():
        raise BadConfiguration(f"calibrate: {SINGLE}")
    solver = solvers.solver(solver) if isinstance(solver, str) else solver
    runs, told = thinned(runs.of(robot), rows), in_words(tell)
    plan = _planned(runs, model, starts, profiles, blocks)
    choose = functools.partial(_free_names, runs, plan, free, fix)
    ready = prepare(runs, robot, noise, stated, assume=False, choose=choose)
    for note in (*ready.foreign, *ready.doubted):
        told(note)
    base, of_product = _guided(runs, ready, plan)
    setting = _Setting(runs, plan, ready, base, of_product)
    posed = setting.problem()
    evolved = _evolved(posed, ready.names, runs, population, generations, members)
    found, beside = _searched(runs, base, posed, ready.noise, plan.starts, evolved, seed, told, solver)
    optimum = _optimum(setting, found)
    if found.problem.observe.long:
        doing = ["the linear analysis", *["profiles"] * plan.profiles, *["blocks held out"] * bool(plan.kinds)]
        told(Step("optimum", (", ".join(doing),)))
    return _result(setting, found, optimum, _analysed(setting, found, optimum), beside, seed)


@dataclasses.dataclass(frozen=True)
class _Plan:
    """Settings of a calibration, completed by the kind of data and the fidelity.

    Attributes:
        fidelity: its name; starts: of the search; profiles: True to profile every parameter.
        kinds: of the blocks that are held out.
    """

    observe: type[observers.Observer]
    fidelity: str
    starts: int
    profiles: bool
    kinds: tuple[str, ...]


def _planned(
    runs: Runs, model: str | None, starts: int | None, profiles: bool | None, blocks: Sequence[str] | bool | None
) -> _Plan:
    """Plan of a calibration from the arguments of `calibrate`; the kind of data and the fidelity fill in for None."""
    observe = observers.kind(runs)
    fidelity = model or (OF_HISTORIES if observe.axis else fidelities.NAMES[0])
    effort = observers.facts(fidelity).effort
    starts = (observe.searches or effort.starts) if starts is None else starts
    profiles = effort.profiles and observe.profiled if profiles is None else profiles
    blocks = effort.blocks if blocks is None else blocks
    kinds = (observe.blocks if blocks else ()) if isinstance(blocks, bool) else tuple(blocks)
    return _Plan(observe, fidelity, starts, profiles, kinds)


def _free_names(
    runs: Runs,
    plan: _Plan,
    free: Sequence[str],
    fix: Sequence[str],
    prepared: Prepared,
) -> tuple[str, ...]:
    """Names of the free parameters.

    Raises:
        BadConfiguration: an unknown name, or one that the fidelity does not read.
    """
    robot, fidelity, computes = prepared.robot, plan.fidelity, observers.facts(plan.fidelity).computes
    words = [surfaces.names_of_surfaces(names, robot, runs) for names in (free, fix)]
    present = _present(runs, robot)
    default = priors.default_names(present, robot, computed=computes, turns=runs.turns)
    owned = priors.stated_names(robot, present, () if plan.observe.axis else priors.OVER_TIME)
    held = {*default, *fidelities.unread(fidelity, owned, runs.turns)}
    default = (*default, *(n for n in owned if n not in held and not n.endswith(computes)))
    default = (*default, *priors.delays(robot, plan.observe.free()[0]))
    names = priors.choose(robot, default, *words)
    if unread := fidelities.unread(fidelity, names, runs.turns):
        if fidelities.OF_TURNS in unread[0]:
            raise BadConfiguration(f"--free {unread[0]}: these runs are straight, which do not show it")
        reads = ", ".join(other for other in fidelities.NAMES if not fidelities.unread(other, unread, runs.turns))
        raise BadConfiguration(f"--free {unread[0]}: --model {fidelity} does not read it; allowed: --model {reads}")
    return names


def _present(runs: Runs, robot: Robot) -> set[str]:
    """Names of the configurations that the runs have."""
    return {robot.configurations.names[k] for k in runs.configurations(robot)}


@dataclasses.dataclass(frozen=True)
class _Setting:
    """A table and a robot, ready for a search.

    Attributes:
        base: the robot at the prior means; of_product: priors of its guide frictions, see `_guided`.
    """

    runs: Runs
    plan: _Plan
    ready: Prepared
    base: Robot
    of_product: dict[str, tuple[float, float]]

    def problem(self) -> Problem:
        """The problem to be solved, with the noise as it is known before a search."""
        coordinates = priors.coordinates(self.base, self.ready.names, {**self.of_product, **self.ready.stated})
        return observers.pose(self.runs, self.base, coordinates, self.ready.noise.sd, self.plan.fidelity)

    def remarks(self) -> list[Note | str]:
        """Remarks on the table and the priors."""
        ready = self.ready
        products = [PriorOfProduct(name, mean, sd, priors.GUIDED) for name, (mean, sd) in self.of_product.items()]
        return [*ready.foreign, *ready.doubted, *ready.checked, *ready.weighed, *products, *ready.begins]


def _guided(runs: Runs, ready: Prepared, plan: _Plan) -> tuple[Robot, dict[str, tuple[float, float]]]:
    """The robot with the guides' share that the fidelity computes, and the priors of the guide frictions that are
    free and not stated."""
    robot, known = ready.robot, dict[str, tuple[float, float]]()
    if priors.GUIDE_SHARE not in observers.facts(plan.fidelity).computes:
        return robot, known
    present = _present(runs, robot)
    for name, chassis in ready.robot.configurations.items():
        if name in present and float(chassis.on_tracks) > 0.5:
            robot, more = priors.guided(robot, name)
            known |= more
    return robot, {name: prior for name, prior in known.items() if name in ready.names and name not in ready.stated}


def _evolved(
    posed: Problem,
    names: Sequence[str],
    runs: Runs,
    population: int | None,
    generations: int | None,
    members: Path | None,
) -> _Evolved:
    """Settings of the search by generations, from the arguments of `calibrate`.

    Raises:
        BadConfiguration: settings of a population for a search without one, or for data that are not searched so.
    """
    if population is None:
        population = POPULATION if fidelities.unread("steady", names, runs.turns) else 0
    if (members is not None or generations is not None) and not population:
        raise BadConfiguration("--generations, --members: there is no population; state --population")
    if population and not posed.observe.eased:
        raise BadConfiguration(
            f"--population: got {population}; settled rows with --model drive or track alone are searched so"
        )
    if 0 < population < LEAST:
        raise BadConfiguration(f"--population: got {population}; expected 0 or at least {LEAST} members")
    return _Evolved(population, generations or GENERATIONS, members)


def _searched(
    runs: Runs,
    base: Robot,
    posed: Problem,
    known: Noise,
    starts: int,
    evolved: _Evolved,
    seed: int,
    tell: Callable[[Step], None],
    solver: optimizers.Solver | None,
) -> tuple[Found, np.ndarray | None]:
    """The searches of a problem, and where they began at the optimum of `steady`, that optimum."""
    rng, size = np.random.default_rng(seed), len(posed.coordinates)
    points = posed.observe.starts(posed, rng, starts)
    if not posed.observe.long:
        return multistart.search(posed, known, points, solver), None
    if not posed.observe.eased:
        shares = multistart.first_shares(known)
        return multistart.search_one_by_one(posed, known, points, shares, tell, solver), None
    tell(Step("steady"))
    if evolved.size:
        population.Members(posed, evolved.file)  # refuses a file of others before the search of steady
    draws = rng.standard_normal((fidelities.facts("steady").effort.starts, size))
    draws[0] = 0.0
    easy = multistart.search(observers.pose(runs, base, posed.coordinates, known.sd), known, draws, solver)
    points[0] = beside = np.asarray(easy.best.z)
    points[1:] = multistart.nearby(easy.problem, beside, rng, len(points) - 1)
    posed = dataclasses.replace(posed, data=easy.problem.data)
    if not evolved.size:
        return multistart.search_one_by_one(posed, known, points, easy.shares, tell, solver), beside
    covariance = _first_generation(easy.problem, beside)
    members = population.Members(posed, evolved.file)
    everyone = population.evolve(
        members, population.objective(posed, known), beside, covariance, size=evolved.size,
        generations=evolved.generations, seed=seed, beside=points, tell=tell,
    )  # fmt: skip
    at = int(everyone.order[0])
    if not np.isfinite(everyone.cost[at]):
        ended = population.Searched(everyone, at, (), None, np.nan).outcomes()
        said = ", ".join(f"{count} {word.replace('_', ' ')}" for word, count in ended.items())
        raise BadConfiguration(
            f"--population: none of {len(everyone.z)} members can be run in every row (members with a row that ends "
            f"so: {said or 'none'}); begin from another robot, or free less"
        )
    posed, shares = multistart.reestimate_noise_at(posed, known, everyone, at)
    tell(Step("derivatives"))
    about = identifiability.analyse(posed, jnp.asarray(everyone.z[at]))
    off = population.apart(posed, members, everyone.z[at], about.jacobian, about.sd)
    names = tuple(n for n, apart in zip(posed.coordinates.names, off, strict=True) if apart)
    slope, left = population.regression(posed, everyone, at) if names else (None, np.nan)
    edge = population.edges(posed.coordinates, everyone.z[at])
    searched = population.Searched(everyone, at, names, slope, left, edge)
    return multistart.at_best(posed, known, shares, searched, tell, solver), beside


@dataclasses.dataclass(frozen=True)
class _Evolved:
    """A search by generations: members of each, 0 for none; how many at most; the file in which members are kept."""

    size: int
    generations: int
    file: Path | None


def _first_generation(easy: Problem, z: np.ndarray) -> np.ndarray:
    """Covariance of the first generation: what `steady` knows, but the friction of contacts is as the prior says, as
    it meant another thing to `steady`."""
    covariance = identifiability.analyse(easy, jnp.asarray(z)).covariance.copy()
    friction = np.array([FRICTION in name for name in easy.coordinates.names])
    covariance[friction] = covariance[:, friction] = 0.0
    covariance[friction, friction] = 1.0
    return covariance


@dataclasses.dataclass(frozen=True)
class _Optimum:
    """The model at the optimum and before the fit.

    Attributes:
        z: coordinates; robot: that they make; after: what is observed of it.
        status, status_before: codes, shape (rows,).
        seen, seen_before: readings [SI], shape (rows, channels), NaN in rows that the model does not reach.
    """

    z: np.ndarray
    robot: Robot
    after: optimizers.Observation
    status: np.ndarray
    status_before: np.ndarray
    seen: np.ndarray
    seen_before: np.ndarray


def _optimum(setting: _Setting, found: Found) -> _Optimum:
    """The model at the optimum that was found and before the fit.

    Raises:
        BadConfiguration: the model reaches no operating point in some row at the optimum.
    """
    posed, z = found.problem, np.asarray(found.best.z)
    fitted = posed.robot(jnp.asarray(z))
    after, before = optimizers.observation(posed, jnp.asarray(z)), optimizers.read(posed, posed.base)
    status, status_before = np.asarray(after.status), np.asarray(before.status)
    lost = multistart.unreachable(posed, status)
    if lost.any():
        raise checks.infeasible(setting.runs, fitted, status, lost, setting.ready.names)
    seen, seen_before = _reached(posed, status, after.reading), _reached(posed, status_before, before.reading)
    return _Optimum(z, fitted, after, status, status_before, seen, seen_before)


@dataclasses.dataclass(frozen=True)
class _Analysis:
    """What is known of an optimum.

    Attributes:
        about: the linear analysis; scanned: scans along parameters, by the number of the coordinate.
        elsewhere: searches that ended where the scans have nothing, see `scans.apart`.
        profile: of every parameter, None without profiles; held: blocks held out, by kind.
        notes: remarks on these.
    """

    about: identifiability.Identifiability
    scanned: dict[int, scans.Scan]
    elsewhere: int
    profile: identifiability.Profile | None
    held: dict[str, holdout.HeldOut]
    notes: list[Note | str]


def _analysed(setting: _Setting, found: Found, optimum: _Optimum) -> _Analysis:
    """Linear analysis, scans, profiles and held-out blocks at the optimum."""
    posed, z, plan, searched = found.problem, optimum.z, setting.plan, found.searched
    notes: list[Note | str] = [*posed.observe.cautions(optimum.robot)]
    about = identifiability.analyse(posed, jnp.asarray(z), slope=None if searched is None else searched.slope)
    notes += searched.remarks() if searched is not None else []
    scanned = scans.profiles(posed, z)
    about = scans.with_scanned_sds(about, scanned)
    notes += scans.remarks(posed, scanned)
    elsewhere = scans.apart(scanned, found.starts.z, found.starts.converged)
    if elsewhere:
        over = tuple(posed.coordinates.names[k] for k in scanned)
        notes.append(Elsewhere(elsewhere, len(found.starts.cost), over))
    if not np.isfinite(about.covariance).all():
        notes.append(Fact("no covariance"))
    if jumps := numbers(np.asarray(optimum.after.flags) >> FLAGS.index("jumps") & 1):
        notes.append(OfRows(jumps, "jumps"))
    profile = None
    if plan.profiles:
        profile = identifiability.profile(posed, jnp.asarray(z), float(found.best.cost), about)
    held = holdout.held_out(posed, z, {kind: holdout.blocks(setting.runs, kind) for kind in plan.kinds})
    return _Analysis(about, scanned, elsewhere, profile, held, notes)


def _result(
    setting: _Setting, found: Found, optimum: _Optimum, analysis: _Analysis, beside: np.ndarray | None, seed: int
) -> CalibrationResult:
    """The result of a calibration; `beside` is the optimum of `steady` that the search began from, if any."""
    runs, known, posed, about = setting.runs, setting.ready.noise, found.problem, analysis.about
    z, seen, seen_before, observe = optimum.z, optimum.seen, optimum.seen_before, setting.plan.observe
    measured, sd, converged = runs.measured(), np.asarray(posed.data.sd), bool(found.best.converged)
    finite = np.isfinite(measured) & np.isfinite(seen)
    whitened = np.where(finite, (seen - measured) / sd, 0.0)
    left = lack_of_fit.Residuals(observe, runs, seen, whitened, finite, about.jacobian, z)
    notes = [*setting.remarks(), *analysis.notes, *([] if known.estimated.any() else noise_remarks(left))]
    sources = {name: "product" for name in setting.of_product} | {name: "stated" for name in setting.ready.stated}
    result = CalibrationResult(
        robot=optimum.robot,
        source=runs.source,
        channels=runs.channels,
        model=setting.plan.fidelity,
        seed=seed,
        parameters=estimates.parameters(
            posed, setting.base, z, about, analysis.profile, beside, sources, analysis.scanned
        ),
        tied=estimates.tied(posed),
        noise=estimates.noise(posed, known, found.shares, measured),
        axis=observe.axis,
        errors_before=estimates.errors(runs.channels, seen_before, measured, sd),
        errors_after=estimates.errors(runs.channels, seen, measured, sd),
        held_out={kind: estimates.held_out(posed, h, measured, sd) for kind, h in analysis.held.items()},
        conditions=estimates.conditions(observe, runs),
        readings=estimates.readings(runs.channels, measured, sd, seen_before, seen),
        status_before=np.array(STATUSES)[optimum.status_before],
        status=np.array(STATUSES)[optimum.status],
        adhesion_used=np.asarray(optimum.after.adhesion_used),
        objective=float(found.best.cost),
        converged=converged and not analysis.elsewhere,
        starts=found.starts,
        searched=found.searched,
        chi_square=estimates.chi_square(seen, measured, sd, about, known),
        adequacy=lack_of_fit.judged(left, seen_before, sd, estimated=known.estimated, converged=converged),
        residual_clusters=residual_clusters(left, seed),
        identifiability=about,
        posterior=of_coordinates(posed.coordinates, z, about.covariance),
        remarks=(*notes, *checks.unmeasured(setting.ready.names, about.sensitivity)),
    )
    return dataclasses.replace(result, remarks=(*result.remarks, *remarks(result)))


def _reached(posed: Problem, status: np.ndarray, reading: jax.Array) -> np.ndarray:
    """Readings [SI], NaN in rows that the model does not reach."""
    return np.where(posed.observe.unreachable(status)[:, None], np.nan, np.asarray(reading))
