"""The next experiment: the one of a menu that best separates the alternatives of a finished loop.

Alternatives are hypotheses that explain the same table equally well. Each predicts every reading y of the menu
with the covariance S = diag(sd²) + J C Jᵀ. The first term is the variance of the instruments. The second is, to first
order, the covariance of the fitted coordinates. C = (JᵀJ)⁻¹ is over readings and priors of the table (Chaloner and
Verdinelli, Bayesian experimental design, Statistical Science 10 (1995)). The separation of two alternatives A, B is
√(dᵀ S⁻¹ d), d = y_A - y_B. S is the covariance of A or of B, whichever gives the smaller separation (Hunter and
Reiner, Designs for discriminating between two rival models, Technometrics 7 (1965)). If one of them is true, the χ²
of the other is larger by σ² ± 2σ, where σ is their separation. So the probability that the false one is refuted is
Φ((σ² - refuted) / 2σ). The proposal is expected to separate most of all pairs. If one experiment is not enough, two
are proposed.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import ndtr

from calibration.data import Names
from calibration.described import describe
from calibration.discovery import menu, predicted
from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.candidates import Candidate
from calibration.discovery.classes import Classes
from calibration.discovery.location import DiscrepancyLocation
from calibration.discovery.reach import Reach, reach_of_space
from calibration.discovery.settings import Settings
from calibration.inference import bases, priors
from calibration.inference.fit_notes import Remark
from calibration.inference.optimizers import informative_residuals
from calibration.inference.problem import Problem
from mmrjax.compile.compiling import SELDOM, compiled
from mmrjax.fidelities.steady import IMPLICIT
from mmrjax.model import channels
from mmrjax.model.robot import Robot
from mmrjax.numerics.linear_equations import solve_lower
from mmrjax.numerics.newton import implicit_slopes

#: Alternatives are predicted in batches of a multiple of this, so that most classes share compiled programs.
PAD = 4
NONE = "none on this menu"


@dataclasses.dataclass(frozen=True)
class PredictedReadings:
    """Predicted readings of all experiments of the menu, for each alternative.

    Attributes:
        names: names of the alternatives. The best fit is first.
        experiments: experiments of the menu.
        value: predicted readings [SI], shape (alternatives, readings).
        sd: standard deviation of each instrument's reading [SI], shape (readings,).
        half: factor J C^½ of the covariance that is due to the fit, which is half halfᵀ. Shape (alternatives,
            readings, coordinates).
        exists: True for readings that exist for every alternative, shape (readings,).
        settings: thresholds of the separation.
    """

    names: Names
    experiments: tuple[menu.Experiment, ...]
    value: np.ndarray
    half: np.ndarray
    sd: np.ndarray
    exists: np.ndarray
    settings: Settings

    def apart(self, a: int, b: int, *experiments: str) -> float:
        """Expected separation of two alternatives if all of these experiments are carried out [σ]."""
        spans = predicted.reading_spans(self.experiments)
        columns = np.concatenate([np.flatnonzero(self.exists[spans[e]]) + spans[e].start for e in experiments])
        d = self.value[a, columns] - self.value[b, columns]
        halves = (self.half[x, columns] for x in (a, b))
        squares = [d @ np.linalg.solve(half @ half.T + np.diag(self.sd[columns] ** 2), d) for half in halves]
        return float(np.sqrt(max(min(squares), 0.0)))


@dataclasses.dataclass(frozen=True)
class RankedExperiment:
    """An experiment of the menu, or several carried out together, with its power to separate alternatives.

    Attributes:
        experiments: names of the experiments.
        sigma: separation of every two alternatives [σ], in the order of `itertools.combinations`. The pairs with the
            best fit are first.
        separates: alternatives that it separates from the best fit by at least `Settings.apart`.
        settings: critical values of the separation.
    """

    JSON = ("name", "smallest_sigma=smallest", "separates", "chance_worst", "chance_mean")
    experiments: Names
    sigma: tuple[float, ...]
    separates: Names
    settings: Settings

    @property
    def smallest(self) -> float:
        """Smallest separation of any pair of alternatives [σ]."""
        return min(self.sigma, default=0.0)

    @property
    def sufficient(self) -> tuple[float, ...]:
        """Separations that are large enough to justify the experiment [σ]."""
        return tuple(s for s in self.sigma if s >= self.settings.worth)

    @property
    def chances(self) -> np.ndarray:
        """For each pair of alternatives, the probability that the wrong one is refuted if the other is true."""
        sigma = np.maximum(self.sigma, 1e-9)
        return ndtr((sigma**2 - self.settings.refuted) / (2 * sigma))

    @property
    def name(self) -> str:
        """Name of the first experiment."""
        return self.experiments[0]

    @property
    def chance_worst(self) -> float:
        """Smallest of `chances`."""
        return float(self.chances.min())

    @property
    def chance_mean(self) -> float:
        """Mean of `chances`."""
        return float(self.chances.mean())


@dataclasses.dataclass(frozen=True)
class Proposal:
    """The proposed next experiment, or two experiments if one is not enough.

    Attributes:
        experiments: names of the experiments. Only `NONE` if no experiment helps.
        instruction: instruction for the experimenter.
        separates: alternatives that it separates from the best fit.
        expected_sigma: smallest separation among the pairs that justify an experiment [σ], 0 for none.
        settles: True if it separates every two alternatives by at least `Settings.apart`.
        table: all experiments of the menu, the most useful first.
    """

    JSON = ("name", "experiments", "description", "separates", "expected_sigma", "settles", "menu=table")
    experiments: Names
    instruction: Remark
    separates: Names = ()
    expected_sigma: float = 0.0
    settles: bool = False
    table: tuple[RankedExperiment, ...] = ()

    @property
    def name(self) -> str:
        """Name of the proposal, with all its experiments."""
        return " and ".join(self.experiments)

    @property
    def description(self) -> str:
        """Instruction in words: what to do and what to read."""
        return describe(self.instruction)


# --- alternatives -----------------------------------------------------------------------------------


def alternatives_of_class(best: Candidate, found_classes: Classes) -> dict[str, Candidate]:
    """Candidates that the data cannot separate, by the names of their effects, and of stated values that may be wrong
    in place of one. The best fit is first.
    """
    fitted = {c.key: c for c in sorted(found_classes.ladder, key=lambda c: -c.cost)}
    alternatives = {best.active: best}
    for leader, *others in found_classes.members:
        for name in others:
            active = best.with_effect(leader, name)
            alternatives[active] = fitted[frozenset(active) - {""}]
    by_name = {" + ".join(c.effects): c for c in alternatives.values()}
    for shifts in found_classes.stated:
        by_name |= {" + ".join((s.name, *s.fit.effects)): s.fit for s in shifts}
    return by_name


# --- predictions ------------------------------------------------------------------------------------


@functools.partial(compiled, options=SELDOM)
def _predict_alternatives(
    problem: Problem,
    undetermined: priors.Coordinates | None,
    batch: predicted.ExperimentBatch,
    which: Array,
    z: Array,
    informed: Array,
) -> tuple[predicted.MenuPrediction, Array]:
    """Readings of the menu for each alternative, and the square root of their covariance due to the fit.

    Args:
        undetermined: coordinates that the data do not determine at all and that keep their priors.
        informed: Jacobian of the readings and priors at each fit.
    """

    def predict_alternative(
        active: Array, z: Float[Array, " coordinates"], informed: Array
    ) -> tuple[predicted.MenuPrediction, Array]:
        coordinates = problem.coordinates.with_effects(active)

        def robot(x: Array) -> Robot:
            base = problem.base if undetermined is None else undetermined.robot(problem.base, x[z.size :])
            return coordinates.robot(base, x[: z.size])

        extended = jnp.concatenate([z, jnp.zeros(0 if undetermined is None else len(undetermined))])
        unknowns, solved = predicted.map_over_runs(IMPLICIT.solve, robot(extended), batch)

        def readings(x: Array) -> tuple[Any, predicted.MenuPrediction]:
            return predicted.predict_readings(robot(x[: extended.size]), batch, unknowns + x[extended.size :], solved)

        (acts, all_readings, residuals), prediction = jax.jacfwd(readings, has_aux=True)(
            jnp.concatenate([extended, jnp.zeros(unknowns.shape[1])])
        )
        slopes = predicted.arrange_readings(
            batch, [a[:, : extended.size] for a in acts], implicit_slopes(all_readings, residuals)
        )
        half = jnp.concatenate([solve_lower(informed.T @ informed, slopes[:, : z.size].T).T, slopes[:, z.size :]], 1)
        exists = prediction.exists & jnp.all(jnp.isfinite(half), 1) & jnp.isfinite(prediction.value)
        return dataclasses.replace(prediction, exists=exists), half

    return jax.vmap(predict_alternative)(which, z, informed)


def predict_menu(space: CandidateSpace, candidates: Mapping[str, Candidate]) -> PredictedReadings:
    """Predicted readings of the menu for these alternatives. The instruments are as accurate as those of the table.

    The menu holds the experiments within reach of the table that every alternative robot can do, without forbidden
    ones.
    """
    names, alternatives = list(candidates), list(candidates.values())
    alternatives += [alternatives[0]] * (-len(alternatives) % PAD)
    robot = space.bare.base
    all_parameters = priors.loop_parameter_names(robot, robot.configurations.names)
    further_names = [n for n in all_parameters if n not in space.coordinates.base.names]
    undetermined = priors.parameter_coordinates(robot, further_names) if further_names else None
    equipped, indices = space.problem_for_sets(c.active for c in alternatives)
    active = jnp.asarray(indices)
    z = jnp.asarray(np.stack([c.z for c in alternatives]))
    informed = jnp.stack(
        [
            equipped.observe.at(equipped, c.z, index_of_set)[1][informative_residuals(equipped.data)]
            for c, index_of_set in zip(alternatives, indices, strict=True)
        ]
    )
    reach = reach_of_space(space, space.bare.robot(jnp.asarray(alternatives[0].z[: space.free])))
    menu_experiments, channel_names = menu.experiment_menu(reach), channels.channel_names(space.bare.channels)
    batch = predicted.batch_experiments(menu_experiments, channel_names)
    predictions, half = jax.tree.map(
        lambda x: np.asarray(x)[: len(names)],
        _predict_alternatives(equipped, undetermined, batch, active, z, informed),
    )
    experiments, possible = _possible_experiments(menu_experiments, predictions, space.settings)
    medians = np.median(space.equipped.data.sd, 0)
    sd = predicted.reading_sds(experiments, dict(zip(channel_names, medians, strict=True)))
    value, half = (np.nan_to_num(x[:, possible]) for x in (predictions.value, half))
    exists = np.all(predictions.exists[:, possible], 0)
    return PredictedReadings(tuple(names), experiments, value, half, sd, exists, space.settings)


def _possible_experiments(
    experiments: Sequence[menu.Experiment], predictions: predicted.MenuPrediction, settings: Settings
) -> tuple[tuple[menu.Experiment, ...], np.ndarray]:
    """Experiments of a menu that are possible and allowed, and a mask of their readings among all readings of the
    menu.

    Args:
        predictions: predictions for each alternative, the best fit first.
    """
    possible_experiments: list[menu.Experiment] = []
    masks: list[np.ndarray] = []
    end = 0
    for e in experiments:
        rows = np.ones(predicted.reading_count(e), bool)
        if isinstance(e, menu.ProposedRuns):
            span = slice(end, end := end + len(e.voltage))
            steepest = math.inf if e.used is None else e.used.steepest
            has_grip = np.abs(predictions.grip[:, span]) < np.where(np.asarray(e.slope) > steepest, menu.GRIP, np.inf)
            possible = menu.possible_runs(e, np.all(predictions.feasible[:, span] & has_grip, 0))
            if possible.any():
                temperature, speed = (np.asarray(x)[0, span] for x in (predictions.temperature, predictions.speed))
                e = menu.restrict_run(e, possible, temperature, speed)
            rows = np.repeat(possible, len(e.channels))
        rows &= not {*e.kinds} & {*settings.forbidden}
        if rows.any():
            possible_experiments.append(e)
        masks.append(rows)
    return tuple(possible_experiments), np.concatenate(masks)


# --- the choice -------------------------------------------------------------------------------------


def _rank_experiment(predictions: PredictedReadings, *experiments: str) -> RankedExperiment:
    pairs = itertools.combinations(range(len(predictions.names)), 2)
    sigma = tuple(predictions.apart(a, b, *experiments) for a, b in pairs)
    separations = zip(predictions.names[1:], sigma, strict=False)  # the pairs of the best fit come first
    return RankedExperiment(
        experiments, sigma, tuple(n for n, s in separations if s >= predictions.settings.apart), predictions.settings
    )


def _usefulness(r: RankedExperiment) -> tuple[bool, float]:
    """Sort key of an experiment: True if it separates any pair well enough, then the expected number of separated
    pairs.
    """
    return bool(r.sufficient), float(np.sum(np.minimum(r.chances, r.settings.enough)))


def rank_experiments(predictions: PredictedReadings) -> tuple[RankedExperiment, ...]:
    """Experiments of the menu, sorted by the expected number of separated pairs. Ties, within `Settings.enough`, keep
    the order of the menu, which begins with the least effort.
    """
    return tuple(
        sorted(
            (_rank_experiment(predictions, e.name) for e in predictions.experiments), key=_usefulness, reverse=True
        )
    )


def choose_experiment(predictions: PredictedReadings) -> Proposal:
    """Experiment that separates most pairs of alternatives, with a second one if that helps enough."""
    table = rank_experiments(predictions)
    if not table:
        return Proposal((NONE,), Remark("nothing_possible"))
    plan = table[0]
    rankings = (
        _rank_experiment(predictions, plan.name, e.name) for e in predictions.experiments if e.name != plan.name
    )
    pair = max(rankings, key=_usefulness, default=plan)
    if pair.sufficient and (
        not plan.sufficient or _usefulness(pair)[1] > _usefulness(plan)[1] + predictions.settings.gain
    ):
        plan = pair
    if not plan.sufficient:
        instruction = Remark("nothing_tells", names=predictions.names, sigma=predictions.settings.worth)
        return Proposal((NONE,), instruction, table=table)
    by_name = {e.name: e for e in predictions.experiments}
    instruction = Remark("carry_out", experiments=tuple(by_name[name] for name in plan.experiments))
    settles = plan.smallest >= predictions.settings.apart
    return Proposal(plan.experiments, instruction, plan.separates, min(plan.sufficient), settles, table)


#: Number of runs in a series that covers the variable of a curve more densely, and of repeats that are averaged.
SERIES, REPEATS = 15, 3


def denser_runs_instruction(place: str, variable: str, within: Reach, by_duty: bool = False) -> Remark:
    """Instruction to measure more levels of the variable of a curve, within reach of the table.

    Its values: `low` and `high`, the range of the voltages, and `top`, the highest voltage of the table [V]. `slope`
    [deg] and `payload` [kg] are the largest ones. `steps` are those of voltage, slope and payload.
    """
    volts = within.voltages
    low, high = (volts[0], volts[-1]) if volts[-1] > volts[0] else (menu.round_significant(0.5 * volts[0]), volts[0])
    slope = max(u.steepest for u in within.used)
    payload = max(u.payloads[-1] for u in within.used)
    voltage_step, slope_step, payload_step = (
        menu.step_of_settings(x, SERIES - 1) for x in (high - low, slope, payload)
    )
    low, high, slope, payload = (
        menu.last_setting(x, step_size)
        for x, step_size in ((low, voltage_step), (high, voltage_step), (slope, slope_step), (payload, payload_step))
    )
    low = low or voltage_step
    return Remark(
        "more_runs", place=place, variable=variable, runs=SERIES, low=low, high=high, top=volts[-1], slope=slope,
        payload=payload, steps=(voltage_step, slope_step, payload_step), within=within, by_duty=by_duty,
    )  # fmt: skip


def propose_denser_runs(space: CandidateSpace, where: DiscrepancyLocation, settings: Settings) -> Proposal:
    """Proposal to measure more levels of the variable of a discrepancy without a name.

    Its expected separation from no discrepancy is the χ² per run of the table times the number of proposed runs [σ].
    """
    variable, within = where.variable, reach_of_space(space)
    runs = space.bare.observe.number_of_included_runs(space.included)
    sigma = float(np.sqrt(max(where.strongest, 0.0) * SERIES * REPEATS / max(runs, 1)))
    if sigma < settings.worth:
        return Proposal((NONE,), Remark("too_weak", variable=variable, sigma=sigma))
    name = f"steady speeds for {variable}" if variable in bases.ORDERS else f"finer steps in {variable}"
    name = name if bases.window_from_name(variable) is None else "the same runs again"
    curve = f"curve of the {bases.place_in_words(where.place)} over {variable}"
    instruction = denser_runs_instruction(where.place, variable, within, where.by_duty)
    return Proposal((name,), instruction, (curve,), sigma)


def propose_separating(space: CandidateSpace, best: Candidate, found_classes: Classes) -> Proposal | None:
    """Experiment that separates the alternatives of a class. None if each effect has only one candidate name."""
    alternatives = alternatives_of_class(best, found_classes)
    return choose_experiment(predict_menu(space, alternatives)) if len(alternatives) > 1 else None
