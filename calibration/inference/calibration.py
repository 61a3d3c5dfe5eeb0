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
    (runs, settled), progress = rows_to_fit(runs, robot, rows), report_in_words(tell)
    observe = observers.observer_kind(runs)
    fidelity = model or (OF_HISTORIES if observe.axis else fidelities.NAMES[0])
    facts = observers.facts_of_fidelity(fidelity)
    starts = (observe.searches or facts.starts) if starts is None else starts
    profiles = facts.profiles and observe.profiled if profiles is None else profiles
    blocks = facts.blocks if blocks is None else blocks
    kinds = (observe.blocks if blocks else ()) if isinstance(blocks, bool) else tuple(blocks)
    choose = functools.partial(_free_names, runs, observe, fidelity, free, fix)
    ready = prepare_input(runs, robot, noise, stated, assume=False, choose=choose, settled=settled)
    for note in (*ready.foreign, *ready.doubted):
        progress(note)
    base, of_product = _with_guide_priors(runs, ready, fidelity)
    coordinates = priors.parameter_coordinates(base, ready.names, {**of_product, **ready.stated})
    posed = observers.pose_problem(runs, base, coordinates, ready.noise.sd, fidelity)
    setting = _CalibrationInput(runs, observe, fidelity, profiles, kinds, ready, base, of_product)
    search, beside = _search(setting, posed, starts, population, generations, keep, seed, progress)
    if not free and priors.DELAY not in (*fix, *ready.names):
        setting, search = _free_delay_if_needed(setting, search, progress)
    return _calibration_result(setting, search, beside, seed, progress)


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
    robot, computes = prepared.robot, observers.facts_of_fidelity(fidelity).computes
    words = [configuration_tables.names_of_surfaces(names, robot, runs) for names in (free, fix)]
    present = _configurations_present(runs, robot)
    default = priors.default_names(present, robot, computed=computes, turns=runs.turns)
    owned = priors.names_to_fit(robot, present, () if observe.axis else priors.OVER_TIME)
    fixed_names = {*default, *fidelities.unread_parameters(fidelity, owned, runs.turns)}
    default = (*default, *(n for n in owned if n not in fixed_names and not n.endswith(computes)))
    if priors.DELAY in observe.free()[0] and priors.DELAY in robot.rig.stated - robot.rig.exact:
        default = (*default, priors.DELAY)
    names = priors.choose_free_names(robot, default, *words)
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
        of_product: priors of its guide friction, see `_with_guide_priors`.
    """

    runs: Runs
    observe: type[observers.Observer]
    fidelity: str
    profiles: bool
    kinds: Names
    ready: PreparedInput
    base: Robot
    of_product: Priors


def _with_guide_priors(runs: Runs, ready: PreparedInput, fidelity: str) -> tuple[Robot, Priors]:
    """Robot with the guide load that the fidelity computes, and priors for free guide frictions that have no stated
    prior.
    """
    robot, guide_priors = ready.robot, dict[str, tuple[float, float]]()
    if priors.GUIDE_SHARE not in observers.facts_of_fidelity(fidelity).computes:
        return robot, guide_priors
    present = _configurations_present(runs, robot)
    for name, chassis in ready.robot.configurations.items():
        if name in present and float(chassis.on_tracks) > 0.5:
            robot, more = priors.with_guide_share(robot, name)
            guide_priors |= more
    return robot, {
        name: prior for name, prior in guide_priors.items() if name in ready.names and name not in ready.stated
    }


def _free_delay_if_needed(
    setting: _CalibrationInput,
    found: MultistartResult,
    tell: Callable[[Remark], None],
) -> tuple[_CalibrationInput, MultistartResult]:
    """Repeats the search with a free delay, if the error of a log is concentrated in the samples after steps.

    No other parameter explains such an error, but other parameters would be distorted by it.
    """
    runs, ready, rig = setting.runs, setting.ready, setting.base.rig
    reading = np.asarray(optimizers.observe_at(found.problem, found.best.z).reading)
    late = remarks_with_codes(error_after_steps(runs, reading - runs.measured()), "after_steps")
    if not late or rig.inherits or priors.DELAY in rig.exact:
        return setting, found
    tell(progress_remark("delay"))
    note = Remark("freed_delay", channel=late[0].channel, share=late[0].share)
    ready = dataclasses.replace(ready, names=(*ready.names, priors.DELAY), weighed=(*ready.weighed, note))
    coordinates = priors.parameter_coordinates(setting.base, ready.names, {**setting.of_product, **ready.stated})
    posed = observers.pose_problem(runs, setting.base, coordinates, ready.noise.sd, setting.fidelity)
    index = [coordinates.names.index(name) for name in found.problem.coordinates.names]
    start = np.zeros((1, len(coordinates)))
    start[0, index] = found.best.z
    start = scans.place_at_minimum(posed, start)
    found = multistart.search_one_by_one(posed, ready.noise, start, found.shares, tell)
    return dataclasses.replace(setting, ready=ready), found


def _search(
    setting: _CalibrationInput,
    posed: Problem,
    starts: int,
    size: int | None,
    generations: int | None,
    keep: StoreStage,
    seed: int,
    tell: Callable[[Remark], None],
) -> tuple[MultistartResult, np.ndarray | None]:
    """Searches for the optimum. Also returns the optimum of `steady` if the searches started there.

    Args:
        size, generations: as `population` and `generations` of `calibrate`.

    Raises:
        BadConfiguration: a number of generations without a population, or the data do not support such a search.
    """
    runs, base, noise = setting.runs, setting.base, setting.ready.noise
    if size is None:
        size = POPULATION if fidelities.unread_parameters("steady", setting.ready.names, runs.turns) else 0
    if generations is not None and not size:
        raise BadConfiguration("--generations: has an effect only with --population; give it too")
    if size and not posed.observe.starts_from_steady:
        raise BadConfiguration(
            f"--population: got {size}; a population search needs settled rows and --model drive or track"
        )
    if 0 < size < LEAST:
        raise BadConfiguration(f"--population: got {size}; expected 0 or at least {LEAST} members")
    rng, all_members = np.random.default_rng(seed), None
    if runs.log is not None:
        sd = np.broadcast_to(np.median(noise.sd, 0), runs.log.measured().shape)
        all_members = observers.pose_problem(runs.log, base, posed.coordinates, sd)
    points = posed.observe.starts(posed, rng, starts, all_members)
    if not posed.observe.long:
        return multistart.search_from_starts(posed, noise, points), None
    if not posed.observe.starts_from_steady:
        shares = multistart.initial_noise_shares(noise)
        return multistart.search_one_by_one(posed, noise, points, shares, tell), None
    tell(progress_remark("steady"))
    draws = rng.standard_normal((fidelities.fidelity_facts("steady").starts, len(posed.coordinates)))
    draws[0] = 0.0
    steady = observers.pose_problem(runs, base, posed.coordinates, noise.sd)
    easy = multistart.search_from_starts(steady, noise, draws)
    points[0] = beside = np.asarray(easy.best.z)
    points[1:] = multistart.starts_from_posterior(easy.problem, beside, rng, len(points) - 1)
    posed = dataclasses.replace(posed, data=easy.problem.data)
    if not size:
        return multistart.search_one_by_one(posed, noise, points, easy.shares, tell), beside
    # The first generation has the posterior of `steady`, but the prior for friction of contacts, which has another
    # meaning there.
    covariance = identifiability.analyse_identifiability(easy.problem, jnp.asarray(beside)).covariance.copy()
    friction = np.array([FRICTION in name for name in easy.problem.coordinates.names])
    covariance[friction] = covariance[:, friction] = 0.0
    covariance[friction, friction] = 1.0
    everyone = population.run_evolution(
        posed, population.member_objective(posed, noise), beside, covariance, size=size,
        generations=generations or GENERATIONS, seed=seed, beside=points, tell=tell, keep=keep,
    )  # fmt: skip
    best_member = int(everyone.order[0])
    if not np.isfinite(everyone.cost[best_member]):
        endings = ", ".join(f"{n} {word.replace('_', ' ')}" for word, n in everyone.outcomes().items())
        raise BadConfiguration(
            f"--population: none of {len(everyone.z)} members runs in every row (ended in: {endings or 'none'}); "
            "begin from another robot, or free fewer parameters"
        )
    shares = population.most_probable_noise(posed, noise, np.asarray(everyone.seen.reading[best_member]))
    posed = multistart.with_noise_shares(posed, noise, shares)
    tell(progress_remark("derivatives"))
    identifiability_there = identifiability.analyse_identifiability(posed, jnp.asarray(everyone.z[best_member]))
    unreliable = population.unreliable_derivatives(
        posed, everyone.z[best_member], identifiability_there.jacobian, identifiability_there.sd
    )
    names = tuple(n for n, apart in zip(posed.coordinates.names, unreliable, strict=True) if apart)
    slope, left = population.local_regression(posed, everyone, best_member) if names else (None, np.nan)
    edge = population.parameters_at_edge(posed.coordinates, everyone.z[best_member])
    searched = population.PopulationSearch(everyone, best_member, names, slope, left, edge)
    return multistart.optimum_of_population(posed, noise, shares, searched, tell), beside


def _calibration_result(
    setting: _CalibrationInput,
    found: MultistartResult,
    beside: np.ndarray | None,
    seed: int,
    tell: Callable[[Remark], None],
) -> CalibrationResult:
    """Result of a calibration: linear analysis, scans, profiles and held-out blocks at the optimum.

    Args:
        beside: optimum of `steady` from which the search started, if any.

    Raises:
        BadConfiguration: at the optimum, the model has no operating point in some row.
    """
    runs, ready, observe, noise = setting.runs, setting.ready, setting.observe, setting.ready.noise
    posed, z, searched = found.problem, np.asarray(found.best.z), found.searched
    robot = posed.robot(jnp.asarray(z))
    after, before = optimizers.observe_at(posed, jnp.asarray(z)), optimizers.observe_robot(posed, posed.base)
    status, status_before = np.asarray(after.status), np.asarray(before.status)
    unreachable_rows = posed.unreachable_rows(status)
    if unreachable_rows.any():
        raise checks.infeasible_error(runs, robot, status, unreachable_rows, ready.names)
    seen_after, seen_before = (
        np.where(posed.observe.unreachable(codes)[:, None], np.nan, np.asarray(x.reading))
        for codes, x in ((status, after), (status_before, before))
    )
    if posed.observe.long:
        doing = ["the linear analysis", *["profiles"] * setting.profiles, *["blocks held out"] * bool(setting.kinds)]
        tell(progress_remark("optimum", ", ".join(doing)))
    about = identifiability.analyse_identifiability(
        posed, jnp.asarray(z), slope=None if searched is None else searched.slope
    )
    scanned = {k: scans.scan_coordinate(posed, z, k) for k in posed.observe.scanned(posed)}
    sd = about.sd.copy()
    for k, scan in scanned.items():
        sd[k] = scan.sd()
    wider = sd / about.sd  # correlations are kept
    about = dataclasses.replace(about, sd=sd, covariance=about.covariance * np.outer(wider, wider))
    notes = [*ready.foreign, *ready.doubted, *ready.checked, *ready.weighed]
    notes += [
        Remark("prior_of_product", name=name, mean=mean, sd=sd, share=priors.GUIDED)
        for name, (mean, sd) in setting.of_product.items()
    ]
    notes += [*ready.begins, *posed.observe.cautions(robot), *(() if searched is None else searched.remarks())]
    names = posed.coordinates.names
    notes += [
        Remark("in_pieces", name=names[k], pieces=parts) for k, s in scanned.items() if (parts := s.parts()) > 1
    ]
    elsewhere = scans.count_outside(scanned, found.starts.z, found.starts.converged)
    if elsewhere:
        scanned_names = tuple(names[k] for k in scanned)
        notes.append(Remark("elsewhere", searches=elsewhere, total=len(found.starts.cost), names=scanned_names))
    if not np.isfinite(about.covariance).all():
        notes.append(Remark("no_covariance"))
    if jumps := estimates.row_numbers(np.asarray(after.flags) >> FLAGS.index("jumps") & 1):
        notes.append(Remark("of_rows", rows=jumps, what="jumps"))
    profile = None
    if setting.profiles:
        profile = identifiability.profile_intervals(posed, jnp.asarray(z), float(found.best.cost), about)
    errors_by_kind = holdout.hold_out_by_kind(
        posed, z, {kind: holdout.blocks_of_kind(runs, kind) for kind in setting.kinds}
    )
    measured, sd, converged = runs.measured(), np.asarray(posed.data.sd), bool(found.best.converged)
    finite = np.isfinite(measured) & np.isfinite(seen_after)
    whitened = np.where(finite, (seen_after - measured) / sd, 0.0)
    residuals = lack_of_fit.Residuals(observe, runs, seen_after, whitened, finite, about.jacobian, z)
    notes += [] if noise.estimated.any() else noise_remarks(residuals)
    sources = {name: "product" for name in setting.of_product} | {name: "stated" for name in ready.stated}
    result = CalibrationResult(
        robot=robot,
        source=runs.source,
        channels=runs.channels,
        model=setting.fidelity,
        seed=seed,
        parameters=estimates.parameter_estimates(posed, setting.base, z, about, profile, beside, sources, scanned),
        tied={follower: (names[k], ratio) for follower, k, ratio in posed.coordinates.tied},
        noise=estimates.channel_noise(posed, noise, found.shares, measured),
        axis=observe.axis,
        errors_before=estimates.errors_by_channel(runs.channels, seen_before, measured, sd),
        errors_after=estimates.errors_by_channel(runs.channels, seen_after, measured, sd),
        held_out={kind: estimates.hold_out_errors(posed, h, measured, sd) for kind, h in errors_by_kind.items()},
        conditions=estimates.condition_columns(observe, runs),
        readings=estimates.readings_by_channel(runs.channels, measured, sd, seen_before, seen_after),
        status_before=np.array(STATUSES)[status_before],
        status=np.array(STATUSES)[status],
        adhesion_used=np.asarray(after.adhesion_used),
        objective=float(found.best.cost),
        converged=converged and not elsewhere,
        starts=found.starts,
        searched=searched,
        chi_square=estimates.chi_square(seen_after, measured, sd, about, noise),
        adequacy=lack_of_fit.judge_adequacy(
            residuals, seen_before, sd, estimated=noise.estimated, converged=converged
        ),
        residual_clusters=find_residual_clusters(residuals, seed),
        identifiability=about,
        posterior=posterior_of_coordinates(posed.coordinates, z, about.covariance),
        remarks=(
            *notes,
            *(() if priors.DELAY in ready.names else error_after_steps(runs, seen_after - measured)),
            *(Remark("unmeasured", name=n) for n, s in zip(ready.names, about.sensitivity, strict=True) if s < 1e-6),
        ),
    )
    return dataclasses.replace(result, remarks=(*result.remarks, *calibration_remarks(result)))


#: Shift from the prior above which a remark calls the prior or the model wrong [prior sd].
FAR = 3.0


def calibration_remarks(found: CalibrationResult) -> Iterator[Remark]:
    """Remarks on noise, search, rows, parameters, limits and held-out blocks."""
    shares = ((c.name, found.noise[c.name].estimated_percent) for c in found.channels)
    if estimated := tuple((name, percent) for name, percent in shares if percent is not None):
        yield Remark("estimated_noise", percent=estimated)
    if not found.converged:
        yield Remark("unsettled", names=found.undetermined)
    if not found.profiled:
        yield Remark("not_profiled")
    if found.starts.agree < len(found.starts.cost):
        yield found.starts.agreement
    yield from (Remark("residual_cluster", cluster=c) for c in found.residual_clusters)
    for k, word in enumerate(STATUSES):
        if k not in DONE and np.any(found.status == word):
            yield Remark("of_rows", rows=estimates.row_numbers(found.status == word), what=word)
    yield from _parameter_remarks(found)
    limited = found.adhesion_used > 1 - MARGIN
    if limited.any():
        yield Remark("of_rows", rows=estimates.row_numbers(limited), what="limited", share=MARGIN)
    for configuration in found.robot.configurations:
        friction = f"{configuration}.{priors.GUIDE_FRICTION}"
        share = f"{configuration}.{priors.GUIDE_SHARE}"
        if share in found.parameters:
            yield Remark("product_alone", friction=friction, share=share, free=friction in found.parameters)
    for kind, block_errors in found.held_out.items():
        if block_errors.unreachable_rows:
            yield Remark("no_prediction", kind=kind, rows=len(block_errors.unreachable_rows), total=len(found))
    for kind, block_errors in found.held_out.items():
        if not all(block.converged for block in block_errors.blocks.values()):
            yield Remark("block_not_converged", kind=kind)


def _parameter_remarks(found: CalibrationResult) -> Iterator[Remark]:
    far_names = {name for name, p in found.parameters.items() if abs(p.shift) > FAR}  # with a remark of their own
    if near_prior := tuple(name for name in found.undetermined if name not in far_names):
        yield Remark("held_by_prior", names=near_prior)
    if pairs := found.together:
        yield Remark("only_together", pairs=pairs)
    for name, p in found.parameters.items():
        if name in far_names:
            yield Remark("far_from_prior", name=name, sds=abs(p.shift), kind="calibration")
    for name, p in found.parameters.items():
        if p.at_bound:
            yield Remark("at_bound", name=name, side=p.at_bound)
    for name, p in found.parameters.items() if found.searched is not None else ():
        if EDGE < abs(p.shift) <= FAR and not p.at_bound:
            yield Remark("far_from_prior", name=name, sds=abs(p.shift), kind="edge")
