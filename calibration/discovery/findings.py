"""Entries of the loop's result: effects, evidence, shifts and errors, by name and in their units."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from calibration import described
from calibration.data import Json, Names, writing
from calibration.discovery import adequacy, candidates, classes, loop_notes, projection, search
from calibration.discovery.active_set import CandidateSpace, with_only
from calibration.discovery.candidates import Candidate
from calibration.discovery.discrepancy import BaseCurve
from calibration.discovery.formula import Proposal
from calibration.discovery.location import DiscrepancyLocation
from calibration.discovery.score_tests import ScoreTable
from calibration.inference import bases, linearization
from calibration.inference.estimates import SIDE_OF_BOUND
from calibration.inference.identifiability import held_by_prior
from calibration.inference.linearization import amplitude_unit
from mmrjax.model import params
from mmrjax.model.balances import BALANCES
from mmrjax.model.robot import Robot

# --- effects --------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class ParameterEstimate:
    """Fitted value of a parameter with its standard deviation, both in `unit`. `held_by_prior`: True if the data do
    not determine it.
    """

    value: float
    sd: float
    unit: str
    held_by_prior: bool


@dataclasses.dataclass(frozen=True)
class ClassMember:
    """An effect that explains the data as well as the leading effect of its class.

    Attributes:
        amplitude: fitted amplitude [unit].
        size: amplitude relative to the largest plausible one [-].
        rise_chi2: rise of χ² compared with the leading effect [σ²].
    """

    amplitude: float
    size: float
    rise_chi2: float


@dataclasses.dataclass(frozen=True)
class StatedValue:
    """A stated value of the robot that may be wrong, in place of a missing effect.

    Attributes:
        value: value that explains the data.
        stated: stated value, the mean of its prior. Both are in `unit`.
        prior_sds: their distance in prior sds.
        rise_chi2: rise of χ² compared with the effect [σ²].
    """

    value: float
    stated: float
    unit: str
    prior_sds: float
    rise_chi2: float


@dataclasses.dataclass(frozen=True)
class FoundEffect:
    """An effect that the loop added to the model, with its alternatives and evidence.

    Attributes:
        name: name of the leading effect of its class.
        members: the effect and all effects that the data cannot separate from it.
        stated: base parameters, by name, whose stated value may be wrong instead.
        families: families of the members, the leading one first. If there is only one, the equation and its driving
            variable are known.
        balance, unit: balance that the effect enters, and its unit.
        equation, source: equation and source, from the effect's docstring.
        parameters: fitted amplitude and shape.
        p_value: share of bootstrap tables in which the strongest effect explains as much.
        score: rise of χ² if the effect is removed and the rest refitted [σ²].
        share: share of the excess misfit (χ² minus its expectation) that it explains [-].
    """

    name: str
    members: dict[str, ClassMember]
    stated: dict[str, StatedValue]
    families: Names
    balance: str
    unit: str
    equation: str
    source: str
    parameters: dict[str, ParameterEstimate]
    p_value: float
    score: float
    share: float

    def to_json(self, support: loop_notes.NameSupport | None) -> Json:
        """Entry of result.json. `support`: tests of the names."""
        test = None if support is None else support.test_of(self.name)
        form = test is not None and test.shows_form
        return {
            "name": self.name,
            "class": [*self.members, *self.stated],
            "standing": "established" if support is None or support.established(self.name) else "tentative",
            "doubts": test.fails if test else [],
            "rests_on_row": test and test.rests_on,
            "root": test and test.root,
            "root_needed": test and test.needed,
            **writing.entries_of(
                self, "families", "balance", "unit", "equation", "source", "parameters", "p_value", "score", "share"
            ),
            "accuracy_of_form": writing.entries_of(test, "over", "share=spread") if form else None,
            **writing.entries_of(self, "members", "stated_values=stated"),
        }


def found_effects(
    space: CandidateSpace,
    base: Candidate,
    best: Candidate,
    found_classes: classes.Classes,
    test: adequacy.AdequacyTest,
) -> tuple[FoundEffect, ...]:
    """Result entry of each effect of the best candidate: its class, its parameters and its evidence.

    Args:
        test: adequacy test of the base fit. Its bootstrap gives the p-values.
    """
    # The unique contribution of each effect: the rise of χ² if it is removed and everything is refitted.
    fits_without = [base] if len(best.effects) == 1 else search.refit_without_each(space, best, found_classes.ladder)
    null, excess = np.asarray(test.null.single), candidates.excess_misfit(space, base)
    effects, fits = [], {c.key: c for c in reversed((best, *found_classes.ladder))}

    def class_member(leader: str, name: str) -> ClassMember:
        rival = fits[frozenset(best.with_effect(leader, name)) - {""}]
        k, unit = rival.active.index(name), amplitude_unit(space.library[name])
        return ClassMember(
            float(rival.amplitude[k] * unit), float(rival.size[k]), float(2 * (rival.cost - best.cost))
        )

    classes_of_effects = zip(
        found_classes.members, found_classes.stated, found_classes.families, fits_without, strict=True
    )
    for slot, (members, shifts, families, without) in enumerate(classes_of_effects):
        effect, gain = space.library[members[0]], float(2 * (without.cost - best.cost))
        equation, _, source = (inspect.getdoc(type(effect)) or "").partition("Source:")
        effects.append(
            FoundEffect(
                name=effect.name,
                members={name: class_member(members[0], name) for name in members},
                stated={
                    s.name: StatedValue(s.value, s.stated, s.unit, s.prior_sds, float(2 * (s.fit.cost - best.cost)))
                    for s in shifts
                },
                families=families,
                balance=effect.balance,
                unit=BALANCES[effect.balance][0],
                equation=" ".join(equation.split()),
                source=" ".join(source.split()),
                parameters=_effect_parameters(space, best, slot),
                p_value=search.single_p_value(gain, null),
                score=gain,
                share=candidates.share_of_excess(excess, gain),
            )
        )
    return tuple(effects)


def _effect_parameters(space: CandidateSpace, best: Candidate, slot: int) -> dict[str, ParameterEstimate]:
    effect, k = space.library[best.active[slot]], space.free + slot
    amplitude, unit = linearization.amplitude_of(effect), amplitude_unit(effect)
    fitted = float(best.amplitude[slot] * unit), float(space.settings.width * best.sd[k] * unit)
    undetermined = held_by_prior(best.sd)
    values = {amplitude.name: ParameterEstimate(*fitted, amplitude.spec.unit, bool(undetermined[k]))}
    shape = linearization.free_shape_parameter(effect)
    if shape is not None:
        k += space.settings.slots
        value, slope = _shape_and_slope(linearization.shape_scales(shape), best.z[k])
        fitted = float(value), float(slope) * float(best.sd[k])
        values[shape.name] = ParameterEstimate(*fitted, shape.spec.unit, bool(undetermined[k]))
    return values


_shape_and_slope = jax.jit(jax.value_and_grad(linearization.shape_parameter_at, argnums=1))


@dataclasses.dataclass(frozen=True)
class UnnamedDiscrepancy(DiscrepancyLocation):
    """A discrepancy that no effect of the library explains.

    Attributes:
        unit: unit of the balance.
        effect: name of the smooth curve in the proposed robot.
        p_value: family-wise p-value.
        score: decrease of χ² by the curve [σ²].
        at: values of the variable [SI].
        value, sd: value and standard deviation of the curve there [unit].
        proposal: proposed formula.
        over, defect, defect_sd: for each row the fitted variable [SI] and the defect of the balance [unit]: the curve
            plus the row's residual, along the travel. None if single rows do not show it.
    """

    unit: str
    effect: str
    p_value: float
    score: float
    at: np.ndarray
    value: np.ndarray
    sd: np.ndarray
    proposal: Proposal
    over: np.ndarray | None = None
    defect: np.ndarray | None = None
    defect_sd: np.ndarray | None = None

    def to_json(self) -> Json:
        """Entry of result.json."""
        return {
            "name": "unnamed",
            "class": [],
            "families": (self.family,),
            **writing.entries_of(
                self, "balance", "channel", "balances_alike", "variable", "variables_alike", "window"
            ),
            "unit": self.unit,
            "equation": None,
            "parameters": {},
            **writing.entries_of(self, "p_value", "score", "effect"),
            "curve": writing.entries_of(self, "at", "value", "sd", "unit"),
            "course": described.describe(self),
            "proposal": self.proposal,
        }


def unnamed_discrepancy(
    base_curve: BaseCurve, where: DiscrepancyLocation, p_value: float, rows: int, simulated: bool
) -> UnnamedDiscrepancy | None:
    """Result entry of a discrepancy without a name. The curve and the errors of rows come from the same fit.

    A simulated log has the curve to first order at the base fit of its equations. None for a wave there, which has
    its own phase in each run.
    """
    curve, row_values = base_curve.at_base, {}
    if not simulated:
        fitted, linear = base_curve.fitted, base_curve.diagnosis.linear
        grid, value, sd, score = fitted.grid, fitted.curve, fitted.sd, fitted.chi2[0] - fitted.chi2[1]
        if base_curve.space.bare.observe.one_row_reveals:
            window = bases.window_from_name(where.variable)
            x, way = linear.curve_variable(where.place, where.variable if window is None else window.axis)
            row_errors, row_sd = projection.balance_error_by_row(linear, where.place)
            defect = np.interp(x, grid, value) + way * row_errors
            row_values = {"over": x[:rows], "defect": defect[:rows], "defect_sd": row_sd[:rows]}
    elif where.variable in bases.ORDERS:
        return None
    else:
        (grid, value, sd), score = curve.drawn(curve.start, curve.covariance), curve.explained
    return UnnamedDiscrepancy(
        **dataclasses.asdict(where), unit=base_curve.unit, effect=curve.effect, p_value=p_value, score=float(score),
        at=grid, value=value, sd=sd, proposal=base_curve.proposal, **row_values,
    )  # fmt: skip


@dataclasses.dataclass(frozen=True)
class RejectedCandidate:
    """Effects that were fitted but are not proposed.

    Attributes:
        effects: amplitude of each effect.
        prior_sds: the same amplitudes in prior sds.
        sizes: amplitudes relative to the largest plausible ones [-].
        rise_chi2: χ² minus the χ² of the proposed fit [σ²]. Negative if these effects explain more.
        reasons: reasons why they are implausible.
    """

    JSON = ("effects", "prior_sds", "sizes", "rise_chi2", "why")
    effects: dict[str, float]
    prior_sds: dict[str, float]
    sizes: dict[str, float]
    rise_chi2: float
    reasons: tuple[loop_notes.RuledOut, ...] = ()

    @property
    def why(self) -> str:
        """Reasons why they are implausible, as a sentence."""
        return described.describe(self)


def listed_alternatives(
    space: CandidateSpace, best: Candidate, cost: float, ladder: Sequence[Candidate]
) -> tuple[tuple[RejectedCandidate, ...], tuple[RejectedCandidate, ...]]:
    """Candidates that explain the data nearly as well as the proposal, and separately those of implausible
    size.

    A candidate that only adds effects to the proposal, or to another listed candidate, is omitted if these explain
    little.

    Args:
        cost: objective of the proposal [½σ²].
        best: the proposal, if it is a candidate.
    """
    near: dict[bool, list[RejectedCandidate]] = {True: [], False: []}
    simpler = {best.key: cost} if best.key else {}
    for c in sorted(ladder, key=lambda x: (len(x.effects), x.cost)):
        rise = 2 * (c.cost - cost)
        if c.key in simpler or not c.effects or rise > space.settings.alternative:
            continue
        if any(key < c.key and 2 * (x - c.cost) < space.settings.alternative for key, x in simpler.items()):
            continue
        simpler[c.key] = c.cost
        near[c.plausible].append(_alternative(space, c, rise))
    plausible, ruled_out = (tuple(sorted(near[x], key=lambda a: a.rise_chi2)) for x in (True, False))
    return plausible, ruled_out


def _alternative(space: CandidateSpace, candidate: Candidate, rise: float) -> RejectedCandidate:
    amplitudes, sds, sizes, reasons = {}, {}, {}, list[loop_notes.RuledOut]()
    for slot, (name, amplitude, size) in enumerate(
        zip(candidate.active, candidate.amplitude, candidate.size, strict=True)
    ):
        if not name:
            continue
        effect = space.library[name]
        sds[name], sizes[name] = float(amplitude), float(size)
        amplitudes[name] = float(amplitude) * amplitude_unit(effect)
        sd = space.settings.width * float(candidate.sd[space.free + slot])
        if name in candidate.supplying:
            reasons.append(loop_notes.RuledOut(name, "power"))
        elif size >= 1:
            check = effect.rests_on or (linearization.amplitude_of(effect).spec.meaning,)
            reasons.append(loop_notes.RuledOut(name, "size", float(size), tuple(check)))
        elif not candidate.plausible and size * (1 + sd / max(abs(float(amplitude)), 1e-12)) >= 1:
            reasons.append(loop_notes.RuledOut(name, "edge"))
    return RejectedCandidate(amplitudes, sds, sizes, float(rise), tuple(reasons))


def proposed_robot(space: CandidateSpace, best: Candidate) -> Robot:
    """Fitted robot with the effects of the proposal and no others of the library."""
    robot = space.problem(best.active).robot(jnp.asarray(best.z))
    return with_only(robot, {*best.effects, *(e.name for e in space.bare.base.effects)})


# --- the base and the library ---------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class ParameterShift:
    """A base parameter before and after effects were added: value in its unit, and distance from its prior [prior
    sds].

    Attributes:
        held_by_prior: True if the data do not determine it after, see `identifiability.held_by_prior`.
        at_bound: bound at which it is after, `lower`, `upper` or None.
    """

    prior: float
    before: float
    after: float
    unit: str
    sd_after: float
    meaning: str
    shift_before: float
    shift_after: float
    held_by_prior: bool
    at_bound: str | None


def parameter_shifts(
    space: CandidateSpace, before: np.ndarray, after: np.ndarray, sd: np.ndarray
) -> dict[str, ParameterShift]:
    """Every base parameter before and after effects were added, in its unit and in prior sds.

    Args:
        before, after: coordinates of both fits. Coordinates of the base come first.
        sd: standard deviation of `after`.
    """
    coordinates, p = space.coordinates.base, space.free
    z = [np.asarray(x[:p]) for x in (before, after)]
    value = [coordinates.stated, *(coordinates.value(x) for x in z)]
    slope = np.asarray(coordinates.slope(jnp.asarray(z[1])))
    fields, undetermined = params.parameters_by_name(space.bare.base), held_by_prior(sd)
    bound = coordinates.beyond(z[1])
    return {
        name: ParameterShift(
            prior=float(value[0][k]),
            before=float(value[1][k]),
            after=float(value[2][k]),
            unit=coordinates.units[k],
            sd_after=float(slope[k] * sd[k]),
            meaning=fields[name].spec.meaning,
            shift_before=float(z[0][k]),
            shift_after=float(z[1][k]),
            held_by_prior=bool(undetermined[k]),
            at_bound=SIDE_OF_BOUND[int(bound[k])],
        )
        for k, name in enumerate(coordinates.names)
    }


@dataclasses.dataclass(frozen=True)
class EffectScore:
    """Score of a library effect alone. All other parameters are refitted on the linearised equations of the base fit.

    Attributes:
        name: name of the effect.
        balance: balance that it enters.
        score: decrease of χ² by the effect at its best shape and plausible size [σ²].
        amplitude, sd: its amplitude and standard deviation [unit].
        sigmas_per_prior_sd: change of the readings per prior sd [σ].
        family: equation and driving variable in words.
        unit: unit of its amplitude.
        supplies: True if its sign would supply power. It then explains nothing.
    """

    JSON = ("name", "balance", "score", "amplitude", "sigmas_per_prior_sd")
    name: str
    balance: str
    score: float
    amplitude: float
    sigmas_per_prior_sd: float
    sd: float
    family: str
    unit: str
    supplies: bool = False


def effect_scores(space: CandidateSpace, scores: ScoreTable) -> tuple[EffectScore, ...]:
    """Score of each effect at its best shape and a plausible amplitude, strongest first. Equal scores are sorted by
    name.
    """
    score_list = []
    for effect in space.library.effects:
        instance = space.library.best_instance(effect.name, np.asarray(scores.single))
        best_amplitude, sigmas = float(scores.amplitude[instance]), float(scores.left[instance])
        unit = amplitude_unit(effect)
        spec = linearization.amplitude_of(effect).spec
        low = max(-space.settings.plausible, spec.bounds[0] / unit)
        amplitude = min(max(best_amplitude, low), space.settings.plausible)
        explained = float(scores.single[instance] ** 2 - ((best_amplitude - amplitude) * sigmas) ** 2)
        score_list.append(
            EffectScore(
                name=effect.name,
                balance=effect.balance,
                score=max(explained, 0.0),
                amplitude=amplitude * unit,
                sigmas_per_prior_sd=sigmas,
                sd=unit / max(sigmas, 1e-300),
                family=effect.family(),
                unit=spec.unit,
                # as in `candidates.supplying_effects`
                supplies=space.bare.observe.long and effect.dissipative and amplitude < 0,
            )
        )
    return tuple(sorted(score_list, key=lambda s: (-round(s.score, 9), s.name)))


@dataclasses.dataclass(frozen=True)
class EffectRanking:
    """Ranking of the library by regression, before any set of effects is fitted. It is not confirmed by simulation.

    Attributes:
        missing: True if an effect is missing.
        p_value: family-wise p-value of the test for a missing effect.
        chance: critical score of the strongest effect [σ²].
        effects: effects by score, strongest first. Effects that would supply power come last.
        windows: number of equations in weak form. 0 if the ranking uses the sensitivities of the base fit.
        parameters: base parameters fitted together with the first effect, with their sds [SI].
    """

    missing: bool
    p_value: float
    chance: float
    effects: tuple[EffectScore, ...]
    windows: int = 0
    parameters: dict[str, tuple[float, float]] = dataclasses.field(default_factory=dict)

    @property
    def beyond_chance(self) -> list[EffectScore]:
        """Effects that explain more than chance."""
        return [e for e in self.effects if e.score > self.chance and not e.supplies]


def rank_library(space: CandidateSpace, diagnosis: adequacy.Diagnosis) -> EffectRanking:
    """Ranking of the library by the share of the base's misfit that each effect alone would explain."""
    test = diagnosis.test
    ranking = _rank_effects(space, diagnosis.scores)
    return EffectRanking(test.rejected, test.p_value, test.threshold("single") ** 2, ranking)


def rank_effects_by_weak_form(space: CandidateSpace, screening: search.WeakFormScreening) -> EffectRanking:
    """Ranking of the effects by the equations of a log in weak form, before any simulation."""
    p = search.single_p_value(float(np.max(screening.scores.single**2)), screening.null)
    chance = float(np.quantile(screening.null, 1 - space.settings.family_wise_error, method="higher")) ** 2
    ranking = _rank_effects(space, screening.scores)
    shifts = parameter_shifts(space, screening.base.z, screening.base.z, screening.base.sd)
    parameters = {name: (shift.after, shift.sd_after) for name, shift in shifts.items()}
    return EffectRanking(p <= space.settings.family_wise_error, p, chance, ranking, screening.windows, parameters)


def _rank_effects(space: CandidateSpace, scores: ScoreTable) -> tuple[EffectScore, ...]:
    """Effects sorted by score. Effects that would supply power come last."""
    return tuple(sorted(effect_scores(space, scores), key=lambda e: e.supplies))


def invisible_effects(space: CandidateSpace, scores: ScoreTable, by_effect: Sequence[EffectScore]) -> Names:
    """Effects that the data cannot reveal, because even their largest plausible amplitude changes the
    readings by less than `settings.visible`.

    Args:
        by_effect: result of `effect_scores`.
    """
    weak = {s.name for s in by_effect if s.score < space.settings.visible**2}
    largest = zip(space.library.names, space.library.largest(np.asarray(scores.left)), strict=True)
    return tuple(
        name for name, x in largest if space.settings.plausible * x < space.settings.visible and name in weak
    )


#: Rise of the objective up to which a joint fit is as good [σ²], and largest number of reported effects.
SAME, MOST = 4.0, 6


@dataclasses.dataclass(frozen=True)
class HiddenEffect:
    """An effect that the named effects of a fit could hide.

    Attributes:
        name: name of the effect.
        amplitude: largest amplitude that would stay hidden, in `unit`.
        sigmas: change of the readings by that amplitude, if the named effects were fixed [σ].
    """

    name: str
    amplitude: float
    unit: str
    sigmas: float


def find_hidden_effects(
    space: CandidateSpace, named: Names, base_scores: ScoreTable, named_scores: ScoreTable
) -> tuple[HiddenEffect, ...]:
    """Effects that may be present in addition to the named ones, which would hide them, the largest first.

    At the fit with a name, a further effect may have any amplitude that raises the objective by no more than `SAME`:
    b̂ ± √same sd. The name hides the effect if the largest plausible such amplitude, without the name, would change
    the readings by `needed` sigmas. The two are then strongly correlated.

    Args:
        base_scores, named_scores: scores of the fits without and with the named effects.
    """
    hidden = []
    for effect in space.library.effects:
        instance = space.library.best_instance(effect.name, np.asarray(base_scores.left))
        sensitivity, remaining = float(base_scores.left[instance]), float(named_scores.left[instance])
        if effect.name in named or remaining <= 0 or sensitivity <= 0:
            continue
        centre, spread = float(named_scores.amplitude[instance]), np.sqrt(SAME) / remaining
        ends = np.clip([centre - spread, centre + spread], -space.settings.plausible, space.settings.plausible)
        if effect.dissipative:
            ends = np.maximum(ends, 0.0)
        size = float(ends[np.argmax(np.abs(ends))])
        if abs(size) * sensitivity >= space.settings.needed and abs(size) * remaining <= 2 * np.sqrt(SAME):
            unit = linearization.amplitude_of(effect).spec.unit
            hidden.append(HiddenEffect(effect.name, size * amplitude_unit(effect), unit, abs(size) * sensitivity))
    return tuple(sorted(hidden, key=lambda h: -h.sigmas)[:MOST])
