"""A calibration from table to result: noise, starts, optimum, its analysis, and errors of fitted and held-out
rows.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence

import jax.numpy as jnp
import numpy as np

from calibration.data import Names, Priors, configuration_tables
from calibration.data.columns import ROWS
from calibration.data.input_errors import SEEDS, BadConfiguration, stated_count
from calibration.data.runs import Runs
from calibration.described import report_in_words
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
)
from calibration.inference.conduct import error_after_steps
from calibration.inference.fit_notes import Remark, progress_remark, remarks_with_codes
from calibration.inference.identifiability import posterior_of_coordinates
from calibration.inference.lack_of_fit import noise_remarks
from calibration.inference.multistart import MultistartResult
from calibration.inference.population import EDGE, GENERATIONS, LEAST, StoreStage, compute_without_storing
from calibration.inference.preparation import PreparedInput, prepare_input, rows_to_fit
from calibration.inference.problem import MARGIN, Problem
from calibration.inference.residual_clusters import find_residual_clusters
from calibration.inference.result import CalibrationResult
from mmrjax import fidelities
from mmrjax.compile.compiling import SINGLE, in_double, is_double
from mmrjax.model.robot import Robot
from mmrjax.model.signals import DONE, FLAGS, STATUSES

#: Members of a generation if parameters are free that `steady` does not read.
POPULATION = 256
#: Largest values of arguments.
LARGEST = {"starts": 100_000, "population": 1_000_000, "generations": 10_000, "seed": SEEDS}
#: Default fidelity for time histories.
OF_HISTORIES = "drive"
#: Parameters with another meaning in the resolved running gear: prefixes after the configuration's name.
FRICTION = "ground.friction."


@in_double
def calibrate(
    runs: Runs,
    robot: Robot,
    *,
    free: Sequence[str] = (),
    fix: Sequence[str] = (),
    stated: Priors | None = None,
    noise: str | None = None,
    model: str | None = None,
    starts: int | None = None,
    population: int | None = None,
    generations: int | None = None,
    keep: StoreStage = compute_without_storing,
    seed: int = 0,
    profiles: bool | None = None,
    blocks: Sequence[str] | bool | None = None,
    rows: int = ROWS,
    tell: Callable[[str], None] = lambda sentence: None,
) -> CalibrationResult:
    """Fits parameters of `robot` to measured runs.

    Args:
        runs: settled runs or time histories.
        robot: robot model. Its values are the prior means. A mass in the table replaces the robot's mass.
        free, fix: names of parameters to fit or not, see `priors.choose_free_names`.
        stated: parameter → (mean, sd) [SI]. These priors replace those of the fields.
        noise: standard deviations, in the format of `noise.parse_noise`. None: from the sd columns of the file, or
            estimated.
        model: name of the fidelity. None: `drive` for time histories, `steady` for settled runs.
        starts: number of searches: one from the prior mean, the others from random draws of the prior. For settled
            rows with a rollout, they start at the optimum of `steady` and at draws from its posterior.
        population: number of members of each generation of a search without gradients, which precedes the search with
            a rollout. None: `POPULATION` if parameters are free that `steady` does not use, otherwise 0.
        generations: largest number of generations. None: `population.GENERATIONS`.
        keep: storage of the population's generations, so that the same calibration can resume.
        seed: random seed of the starts and all other draws.
        profiles: True to compute a profile likelihood of each parameter.
        blocks: kinds of blocks to hold out. True: all that are informative for such data. Defaults of these two
            depend on the kind of data and the fidelity.
        rows: largest number of rows. Larger tables are thinned evenly: logs in time, tables over their conditions. A
            note reports it.
        tell: callback for progress messages.

    Raises:
        BadData: data that cannot be fitted, see `checks.check_data`.
        BadConfiguration: an unknown fidelity or parameter. A number that is not allowed. An invalid prior or
            noise, or a prior of a mass that the table states. Rows that no robot near the priors reaches, or a call
            inside `jax.jit` while JAX uses single precision.
    """
    if not is_double():
        raise BadConfiguration(f"calibrate: {SINGLE}")
    for name, value, low in (
        ("starts", starts, 1), ("population", population, 0), ("generations", generations, 1), ("seed", seed, 0),
    ):  # fmt: skip
        if value is not None:
            stated_count(value, name, low, LARGEST[name])
    (runs, row_remarks), progress = rows_to_fit(runs, robot, rows), report_in_words(tell)
    observe = observers.observer_kind(runs)
    fidelity = model or (OF_HISTORIES if observe.axis else fidelities.NAMES[0])
    facts = observers.facts_of_fidelity(fidelity)
    starts = (observe.searches or facts.starts) if starts is None else starts
    profiles = facts.profiles and observe.profiled if profiles is None else profiles
    blocks = facts.blocks if blocks is None else blocks
    kinds = (observe.blocks if blocks else ()) if isinstance(blocks, bool) else tuple(blocks)
    choose_names = functools.partial(_free_names, runs, observe, fidelity, free, fix)
    prepared = prepare_input(runs, robot, noise, stated, assume=False, choose=choose_names, settled=row_remarks)
    for remark in (*prepared.inherited_remarks, *prepared.log_remarks):
        progress(remark)
    base, guide_priors = _with_guide_priors(runs, prepared, fidelity)
    coordinates = priors.parameter_coordinates(base, prepared.names, {**guide_priors, **prepared.stated})
    problem = observers.pose_problem(runs, base, coordinates, prepared.noise.sd, fidelity)
    inputs = _CalibrationInput(runs, observe, fidelity, profiles, kinds, prepared, base, guide_priors)
    searches, steady_optimum = _search(inputs, problem, starts, population, generations, keep, seed, progress)
    if not free and priors.DELAY not in (*fix, *prepared.names):
        inputs, searches = _free_delay_if_needed(inputs, searches, progress)
    return _calibration_result(inputs, searches, steady_optimum, seed, progress)


def _free_names(
    runs: Runs,
    observe: type[observers.Observer],
    fidelity: str,
    free: Sequence[str],
    fix: Sequence[str],
    prepared: PreparedInput,
) -> Names:
    """Names of the free parameters.

    Raises:
        BadConfiguration: a name is unknown, or the fidelity does not use the parameter.
    """
    robot = prepared.robot
    computes = observers.facts_of_fidelity(fidelity).computes
    free_and_fixed = [configuration_tables.names_of_surfaces(names, robot, runs) for names in (free, fix)]
    present = _configurations_present(runs, robot)
    default = priors.default_names(present, robot, computed=computes, turns=runs.turns)
    stated_names = priors.names_to_fit(robot, present, () if observe.axis else priors.OVER_TIME)
    excluded = {*default, *fidelities.unread_parameters(fidelity, stated_names, runs.turns)}
    default = (*default, *(n for n in stated_names if n not in excluded and not n.endswith(computes)))
    if priors.DELAY in observe.free()[0] and priors.DELAY in robot.rig.stated - robot.rig.exact:
        default = (*default, priors.DELAY)
    names = priors.choose_free_names(robot, default, *free_and_fixed)
    if unread := fidelities.unread_parameters(fidelity, names, runs.turns):
        if fidelities.OF_TURNS in unread[0]:
            raise BadConfiguration(f"--free {unread[0]}: only turns depend on it, and these runs are straight")
        reads = ", ".join(
            other for other in fidelities.NAMES if not fidelities.unread_parameters(other, unread, runs.turns)
        )
        raise BadConfiguration(f"--free {unread[0]}: --model {fidelity} does not use it; allowed: --model {reads}")
    return names


def _configurations_present(runs: Runs, robot: Robot) -> set[str]:
    """Names of the configurations present in the runs."""
    return {robot.configurations.names[k] for k in runs.configurations(robot)}


@dataclasses.dataclass(frozen=True)
class _CalibrationInput:
    """Table, robot and options of a calibration, after defaults of the kind of data and the fidelity.

    Attributes:
        fidelity: name of the fidelity.
        profiles: True to compute a profile likelihood of each parameter.
        kinds: kinds of block that are held out.
        base: robot at the prior means.
        guide_priors: priors of its guide friction, see `_with_guide_priors`.
    """

    runs: Runs
    observe: type[observers.Observer]
    fidelity: str
    profiles: bool
    kinds: Names
    prepared: PreparedInput
    base: Robot
    guide_priors: Priors


def _with_guide_priors(runs: Runs, prepared: PreparedInput, fidelity: str) -> tuple[Robot, Priors]:
    """Robot with the guide load that the fidelity computes, and priors for free guide frictions that have no stated
    prior.
    """
    robot = prepared.robot
    guide_priors = dict[str, tuple[float, float]]()
    if priors.GUIDE_SHARE not in observers.facts_of_fidelity(fidelity).computes:
        return robot, guide_priors
    present = _configurations_present(runs, robot)
    for name, chassis in prepared.robot.configurations.items():
        if name in present and float(chassis.on_tracks) > 0.5:
            robot, more = priors.with_guide_share(robot, name)
            guide_priors |= more
    return robot, {
        name: prior for name, prior in guide_priors.items() if name in prepared.names and name not in prepared.stated
    }


def _free_delay_if_needed(
    inputs: _CalibrationInput,
    searches: MultistartResult,
    tell: Callable[[Remark], None],
) -> tuple[_CalibrationInput, MultistartResult]:
    """Repeats the search with a free delay, if the error of a log is concentrated in the samples after steps.

    No other parameter explains such an error, but other parameters would be distorted by it.
    """
    runs = inputs.runs
    prepared = inputs.prepared
    rig = inputs.base.rig
    reading = np.asarray(optimizers.observe_at(searches.problem, searches.best.z).reading)
    late_remarks = remarks_with_codes(error_after_steps(runs, reading - runs.measured()), "after_steps")
    if not late_remarks or rig.inherits or priors.DELAY in rig.exact:
        return inputs, searches
    tell(progress_remark("delay"))
    remark = Remark("freed_delay", channel=late_remarks[0].channel, share=late_remarks[0].share)
    prepared = dataclasses.replace(
        prepared, names=(*prepared.names, priors.DELAY), mass_remarks=(*prepared.mass_remarks, remark)
    )
    coordinates = priors.parameter_coordinates(
        inputs.base, prepared.names, {**inputs.guide_priors, **prepared.stated}
    )
    problem = observers.pose_problem(runs, inputs.base, coordinates, prepared.noise.sd, inputs.fidelity)
    index = [coordinates.names.index(name) for name in searches.problem.coordinates.names]
    start = np.zeros((1, len(coordinates)))
    start[0, index] = searches.best.z
    start = scans.place_at_minimum(problem, start)
    searches = multistart.search_one_by_one(problem, prepared.noise, start, searches.shares, tell)
    return dataclasses.replace(inputs, prepared=prepared), searches


def _search(
    inputs: _CalibrationInput,
    problem: Problem,
    starts: int,
    population_size: int | None,
    generations: int | None,
    keep: StoreStage,
    seed: int,
    tell: Callable[[Remark], None],
) -> tuple[MultistartResult, np.ndarray | None]:
    """Searches for the optimum. Also returns the optimum of `steady` if the searches started there.

    Args:
        population_size, generations: as `population` and `generations` of `calibrate`.

    Raises:
        BadConfiguration: a number of generations without a population, or the data do not support such a search.
    """
    runs = inputs.runs
    base = inputs.base
    noise = inputs.prepared.noise
    if population_size is None:
        population_size = (
            POPULATION if fidelities.unread_parameters("steady", inputs.prepared.names, runs.turns) else 0
        )
    if generations is not None and not population_size:
        raise BadConfiguration("--generations: has an effect only with --population; give it too")
    if population_size and not problem.observe.starts_from_steady:
        raise BadConfiguration(
            f"--population: got {population_size}; a population search needs settled rows and --model drive or track"
        )
    if 0 < population_size < LEAST:
        raise BadConfiguration(f"--population: got {population_size}; expected 0 or at least {LEAST} members")
    rng = np.random.default_rng(seed)
    problem_of_log = None
    if runs.log is not None:
        sd = np.broadcast_to(np.median(noise.sd, 0), runs.log.measured().shape)
        problem_of_log = observers.pose_problem(runs.log, base, problem.coordinates, sd)
    points = problem.observe.starts(problem, rng, starts, problem_of_log)
    if not problem.observe.long:
        return multistart.search_from_starts(problem, noise, points), None
    if not problem.observe.starts_from_steady:
        shares = multistart.initial_noise_shares(noise)
        return multistart.search_one_by_one(problem, noise, points, shares, tell), None
    tell(progress_remark("steady"))
    draws = rng.standard_normal((fidelities.fidelity_facts("steady").starts, len(problem.coordinates)))
    draws[0] = 0.0
    steady_problem = observers.pose_problem(runs, base, problem.coordinates, noise.sd)
    steady_result = multistart.search_from_starts(steady_problem, noise, draws)
    points[0] = steady_optimum = np.asarray(steady_result.best.z)
    points[1:] = multistart.starts_from_posterior(steady_result.problem, steady_optimum, rng, len(points) - 1)
    problem = dataclasses.replace(problem, data=steady_result.problem.data)
    if not population_size:
        return multistart.search_one_by_one(problem, noise, points, steady_result.shares, tell), steady_optimum
    # The first generation has the posterior of `steady`, but the prior for friction of contacts, which has another
    # meaning there.
    covariance = identifiability.analyse_identifiability(
        steady_result.problem, jnp.asarray(steady_optimum)
    ).covariance.copy()
    friction = np.array([FRICTION in name for name in steady_result.problem.coordinates.names])
    covariance[friction] = covariance[:, friction] = 0.0
    covariance[friction, friction] = 1.0
    members = population.run_evolution(
        problem, population.member_objective(problem, noise), steady_optimum, covariance, size=population_size,
        generations=generations or GENERATIONS, seed=seed, further_points=points, tell=tell, keep=keep,
    )  # fmt: skip
    best_member = int(members.order[0])
    if not np.isfinite(members.cost[best_member]):
        endings = ", ".join(f"{n} {word.replace('_', ' ')}" for word, n in members.outcomes().items())
        raise BadConfiguration(
            f"--population: none of {len(members.z)} members runs in every row (ended in: {endings or 'none'}); "
            "begin from another robot, or free fewer parameters"
        )
    shares = population.most_probable_noise(problem, noise, np.asarray(members.observations.reading[best_member]))
    problem = multistart.with_noise_shares(problem, noise, shares)
    tell(progress_remark("derivatives"))
    analysis = identifiability.analyse_identifiability(problem, jnp.asarray(members.z[best_member]))
    unreliable = population.unreliable_derivatives(problem, members.z[best_member], analysis.jacobian, analysis.sd)
    names = tuple(n for n, apart in zip(problem.coordinates.names, unreliable, strict=True) if apart)
    slope, regression_rms = population.local_regression(problem, members, best_member) if names else (None, np.nan)
    edge = population.parameters_at_edge(problem.coordinates, members.z[best_member])
    searched = population.PopulationSearch(members, best_member, names, slope, regression_rms, edge)
    return multistart.optimum_of_population(problem, noise, shares, searched, tell), steady_optimum


def _calibration_result(
    inputs: _CalibrationInput,
    searches: MultistartResult,
    steady_optimum: np.ndarray | None,
    seed: int,
    tell: Callable[[Remark], None],
) -> CalibrationResult:
    """Result of a calibration: linear analysis, scans, profiles and held-out blocks at the optimum.

    Args:
        steady_optimum: optimum of `steady` from which the search started, if any.

    Raises:
        BadConfiguration: at the optimum, the model has no operating point in some row.
    """
    runs = inputs.runs
    prepared = inputs.prepared
    observe = inputs.observe
    noise = inputs.prepared.noise
    problem = searches.problem
    z = np.asarray(searches.best.z)
    searched = searches.searched
    robot = problem.robot(jnp.asarray(z))
    observation_after = optimizers.observe_at(problem, jnp.asarray(z))
    observation_before = optimizers.observe_robot(problem, problem.base)
    status, status_before = np.asarray(observation_after.status), np.asarray(observation_before.status)
    unreachable_rows = problem.unreachable_rows(status)
    if unreachable_rows.any():
        raise checks.infeasible_error(runs, robot, status, unreachable_rows, prepared.names)
    readings_after, readings_before = (
        np.where(problem.observe.unreachable(codes)[:, None], np.nan, np.asarray(x.reading))
        for codes, x in ((status, observation_after), (status_before, observation_before))
    )
    if problem.observe.long:
        next_steps = [
            "the linear analysis",
            *["profiles"] * inputs.profiles,
            *["blocks held out"] * bool(inputs.kinds),
        ]
        tell(progress_remark("optimum", ", ".join(next_steps)))
    analysis = identifiability.analyse_identifiability(
        problem, jnp.asarray(z), slope=None if searched is None else searched.slope
    )
    scanned = {k: scans.scan_coordinate(problem, z, k) for k in problem.observe.scanned(problem)}
    sd = analysis.sd.copy()
    for k, scan in scanned.items():
        sd[k] = scan.sd()
    sd_ratio = sd / analysis.sd  # correlations are kept
    analysis = dataclasses.replace(analysis, sd=sd, covariance=analysis.covariance * np.outer(sd_ratio, sd_ratio))
    remarks = [*prepared.inherited_remarks, *prepared.log_remarks, *prepared.table_remarks, *prepared.mass_remarks]
    remarks += [
        Remark("prior_of_product", name=name, mean=mean, sd=sd, share=priors.GUIDED)
        for name, (mean, sd) in inputs.guide_priors.items()
    ]
    remarks += [
        *prepared.start_remarks,
        *problem.observe.cautions(robot),
        *(() if searched is None else searched.remarks()),
    ]
    names = problem.coordinates.names
    remarks += [
        Remark("in_pieces", name=names[k], pieces=parts) for k, scan in scanned.items() if (parts := scan.parts()) > 1
    ]
    ended_elsewhere = scans.count_outside(scanned, searches.starts.z, searches.starts.converged)
    if ended_elsewhere:
        scanned_names = tuple(names[k] for k in scanned)
        remarks.append(
            Remark("elsewhere", searches=ended_elsewhere, total=len(searches.starts.cost), names=scanned_names)
        )
    if not np.isfinite(analysis.covariance).all():
        remarks.append(Remark("no_covariance"))
    if jumps := estimates.row_numbers(np.asarray(observation_after.flags) >> FLAGS.index("jumps") & 1):
        remarks.append(Remark("of_rows", rows=jumps, what="jumps"))
    profile = None
    if inputs.profiles:
        profile = identifiability.profile_intervals(problem, jnp.asarray(z), float(searches.best.cost), analysis)
    errors_by_kind = holdout.hold_out_by_kind(
        problem, z, {kind: holdout.blocks_of_kind(runs, kind) for kind in inputs.kinds}
    )
    measured = runs.measured()
    sd = np.asarray(problem.data.sd)
    converged = bool(searches.best.converged)
    finite = np.isfinite(measured) & np.isfinite(readings_after)
    whitened = np.where(finite, (readings_after - measured) / sd, 0.0)
    residuals = lack_of_fit.Residuals(observe, runs, readings_after, whitened, finite, analysis.jacobian, z)
    remarks += [] if noise.estimated.any() else noise_remarks(residuals)
    sources = {name: "product" for name in inputs.guide_priors} | {name: "stated" for name in prepared.stated}
    result = CalibrationResult(
        robot=robot,
        source=runs.source,
        channels=runs.channels,
        model=inputs.fidelity,
        seed=seed,
        parameters=estimates.parameter_estimates(
            problem, inputs.base, z, analysis, profile, steady_optimum, sources, scanned
        ),
        tied={follower: (names[k], ratio) for follower, k, ratio in problem.coordinates.tied},
        noise=estimates.channel_noise(problem, noise, searches.shares, measured),
        axis=observe.axis,
        errors_before=estimates.errors_by_channel(runs.channels, readings_before, measured, sd),
        errors_after=estimates.errors_by_channel(runs.channels, readings_after, measured, sd),
        held_out={kind: estimates.hold_out_errors(problem, h, measured, sd) for kind, h in errors_by_kind.items()},
        conditions=estimates.condition_columns(observe, runs),
        readings=estimates.readings_by_channel(runs.channels, measured, sd, readings_before, readings_after),
        status_before=np.array(STATUSES)[status_before],
        status=np.array(STATUSES)[status],
        adhesion_used=np.asarray(observation_after.adhesion_used),
        objective=float(searches.best.cost),
        converged=converged and not ended_elsewhere,
        starts=searches.starts,
        searched=searched,
        chi_square=estimates.chi_square(readings_after, measured, sd, analysis, noise),
        adequacy=lack_of_fit.judge_adequacy(
            residuals, readings_before, sd, estimated=noise.estimated, converged=converged
        ),
        residual_clusters=find_residual_clusters(residuals, seed),
        identifiability=analysis,
        posterior=posterior_of_coordinates(problem.coordinates, z, analysis.covariance),
        remarks=(
            *remarks,
            *(() if priors.DELAY in prepared.names else error_after_steps(runs, readings_after - measured)),
            *(
                Remark("unmeasured", name=n)
                for n, sensitivity in zip(prepared.names, analysis.sensitivity, strict=True)
                if sensitivity < 1e-6
            ),
        ),
    )
    return dataclasses.replace(result, remarks=(*result.remarks, *calibration_remarks(result)))


#: Shift from the prior above which a remark calls the prior or the model wrong [prior sd].
FAR = 3.0


def calibration_remarks(result: CalibrationResult) -> Iterator[Remark]:
    """Remarks on noise, search, rows, parameters, limits and held-out blocks."""
    shares = ((c.name, result.noise[c.name].estimated_percent) for c in result.channels)
    if estimated := tuple((name, percent) for name, percent in shares if percent is not None):
        yield Remark("estimated_noise", percent=estimated)
    if not result.converged:
        yield Remark("unsettled", names=result.undetermined)
    if not result.profiled:
        yield Remark("not_profiled")
    if result.starts.agree < len(result.starts.cost):
        yield result.starts.agreement
    yield from (Remark("residual_cluster", cluster=c) for c in result.residual_clusters)
    for k, word in enumerate(STATUSES):
        if k not in DONE and np.any(result.status == word):
            yield Remark("of_rows", rows=estimates.row_numbers(result.status == word), what=word)
    yield from _parameter_remarks(result)
    limited = result.adhesion_used > 1 - MARGIN
    if limited.any():
        yield Remark("of_rows", rows=estimates.row_numbers(limited), what="limited", share=MARGIN)
    for configuration in result.robot.configurations:
        friction = f"{configuration}.{priors.GUIDE_FRICTION}"
        share = f"{configuration}.{priors.GUIDE_SHARE}"
        if share in result.parameters:
            yield Remark("product_alone", friction=friction, share=share, free=friction in result.parameters)
    for kind, block_errors in result.held_out.items():
        if block_errors.unreachable_rows:
            yield Remark("no_prediction", kind=kind, rows=len(block_errors.unreachable_rows), total=len(result))
    for kind, block_errors in result.held_out.items():
        if not all(block.converged for block in block_errors.blocks.values()):
            yield Remark("block_not_converged", kind=kind)


def _parameter_remarks(result: CalibrationResult) -> Iterator[Remark]:
    far_names = {name for name, p in result.parameters.items() if abs(p.shift) > FAR}  # with a remark of their own
    if near_prior := tuple(name for name in result.undetermined if name not in far_names):
        yield Remark("held_by_prior", names=near_prior)
    if pairs := result.together:
        yield Remark("only_together", pairs=pairs)
    for name, p in result.parameters.items():
        if name in far_names:
            yield Remark("far_from_prior", name=name, sds=abs(p.shift), kind="calibration")
    for name, p in result.parameters.items():
        if p.at_bound:
            yield Remark("at_bound", name=name, side=p.at_bound)
    for name, p in result.parameters.items() if result.searched is not None else ():
        if EDGE < abs(p.shift) <= FAR and not p.at_bound:
            yield Remark("far_from_prior", name=name, sds=abs(p.shift), kind="edge")
