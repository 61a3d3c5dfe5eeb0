"""Tests of effects' names against smooth curves that explain as much, or that make the effects insignificant.

A name is a claim about a cause. A curve claims only a place and a shape. Effects selected from many can together
imitate a law that the library lacks. So names are compared with curves by evidence that includes the number of
alternatives (MacKay, Information Theory, Inference, and Learning Algorithms, 2003, ch. 28). If a fit with effects is
not adequate, each has to keep its significance in addition to the best curves.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from statistics import NormalDist

import numpy as np

from calibration.data import Names
from calibration.discovery import smooth
from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.adequacy import Diagnosis
from calibration.discovery.candidates import Candidate
from calibration.discovery.classes import remove_effect
from calibration.discovery.discrepancy import BaseCurve, locate_discrepancy
from calibration.discovery.loop_notes import NameSupport, NameTest, PlacedCurve
from calibration.discovery.projection import Projection
from calibration.discovery.score_tests import augment_with_columns, family_columns, statistics_with_columns
from calibration.discovery.search import Proposed, SearchResult, diagnose_candidate, refit_without_each
from calibration.discovery.settings import Settings
from calibration.inference import bases as bases_room
from calibration.inference.bases import Bases
from calibration.inference.linearization import Linearization, amplitude_of

#: Number of curves that are added to effects, one after the other.
CURVES = 3
#: Number of curves that are tried alone, without any name.
ALONE = 4
#: Least share of an effect's gain that the slopes without it must predict for them to be used for other effects.
PROMISED = 0.8
#: Balances with curves of another balance, those of one equation. A positive error of a speed meter has the same
#: effect as negative slip. A duty that the bridge does not give is a voltage drop.
EQUATION = {"mass": "ground", "speed": "slip", "duty": "electrical"} | {
    other: b for b, others in bases_room.STANDS_FOR.items() for other in others
}
#: Variables of surfaces, in pairs.
VARIABLES = ("voltage", "current", "speed_motor", "slope", "payload")


def equation_of_place(place: str) -> str:
    """Balance, or channel, whose smooth curves compete with the effects of a place."""
    return EQUATION.get(place, place)


def judge_names(
    base_curve: BaseCurve,
    searched: SearchResult,
    proposed: Proposed | None = None,
    blocks: Sequence[np.ndarray] = (),
) -> NameSupport:
    """Tests which effects may be named: those of the best candidate of a search, or of a proposal.

    A set that leaves no significant residuals is compared with curves. Another set is compared with a single curve.
    Then each effect is tested on its own (`judge_each_name`).

    Args:
        base_curve: the base fit, its diagnosis and the smooth curve of its discrepancy.
        proposed: a candidate instead of the search's best, and its diagnosis.
        blocks: mask of the rows of each block that is left out in turn, shape (rows,).
    """
    best, after = (searched.best, searched.diagnosis) if proposed is None else proposed
    if best is None or after is None:
        return NameSupport(False, "implausible")
    better = _better_but_implausible(base_curve, searched.best or best, searched.ladder)
    adequate = not after.test.rejected_with_margin
    if len(best.effects) == 1 and adequate and better:
        return NameSupport(False, "larger", better[0].effects)
    support = _compare_with_curves(base_curve, best) if adequate else _compare_with_single_curve(base_curve, best)
    fits = dataclasses.replace(searched, ladder=(base_curve.base, *searched.ladder))
    tests = judge_each_name(base_curve, best, fits, after, blocks, better)
    if support.stands:
        stands = any(t.established for t in tests)
        support = NameSupport(stands, "beside" if stands else "none by itself")
    return dataclasses.replace(support, tests=tests)


def _better_but_implausible(base_curve: BaseCurve, best: Candidate, ladder: Sequence[Candidate]) -> list[Candidate]:
    """Candidates with more evidence that only their size excludes, the best first."""
    needed = evidence_of_names(base_curve.space, base_curve.base, best) + base_curve.settings.preferred
    evidence = {
        c.active: (evidence_of_names(base_curve.space, base_curve.base, c), c)
        for c in ladder
        if c.simulated and np.isfinite(c.cost) and len(c.effects) <= len(best.effects) and not c.plausible
    }
    better = [(e, c) for e, c in evidence.values() if e > needed]
    return [c for _, c in sorted(better, key=lambda pair: -pair[0])]


# --- an adequate fit: is a curve the better explanation? ---------------------------------------------------


def cost_of_names(space: CandidateSpace, best: Candidate) -> float:
    """Penalty on the decrease of χ² by a set of effects [σ²], for its free parameters and for the number of sets of
    its size.

    The prior of an amplitude has the size of greatest evidence, as for a curve.
    """
    sets = 2 * math.log(math.comb(len(space.library), len(best.effects)))
    return sum(_cost_of_effect(space, best, effect) for effect in best.effects) + sets


def _cost_of_effect(space: CandidateSpace, best: Candidate, effect: str) -> float:
    """Penalty for the free amplitude and shape of one effect [σ²]."""
    k = space.free + best.active.index(effect)
    of_amplitude, of_shape = np.clip(np.asarray(best.sd)[[k, k + len(best.active)]], 1e-6, 1.0)
    amplitude = min(-2 * math.log(of_amplitude), 1 + math.log1p((float(best.z[k]) / of_amplitude) ** 2))
    return float(amplitude - 2 * math.log(of_shape))


def evidence_of_names(space: CandidateSpace, base: Candidate, best: Candidate) -> float:
    """Twice the log evidence for a set of effects against no effects [σ²]."""
    return 2 * (base.cost - best.cost) - cost_of_names(space, best)


def _compare_with_curves(base_curve: BaseCurve, best: Candidate) -> NameSupport:
    """Compares names with one smooth curve: of one variable anywhere, or of two variables in a balance with several
    names.
    """
    space, bases, linear = base_curve.space, base_curve.bases, base_curve.left.linear
    equations = [_equation_of_effect(space, effect) for effect in best.effects]
    places = {place for place, _ in bases_room.family_names(bases)}
    curves = _curve_evidence(space, linear, bases, {e for e in places if equations.count(e) > 1})
    if not curves:
        return NameSupport(True)
    curve_evidence, best_place = max(curves)
    # Curves are linear at the base, so names get the better of their fit and of their linear gain there.
    explained = max(2 * (base_curve.base.cost - best.cost), _linear_explanation(space, best, linear))
    names_evidence = explained - cost_of_names(space, best)
    if curve_evidence - 2 * math.log(len(curves)) > names_evidence + base_curve.settings.preferred:
        return NameSupport(False, "better curve", best.effects, (best_place,))
    return NameSupport(True)


def _curve_evidence(
    space: CandidateSpace, linear: Linearization, bases: Bases, crowded: set[str], equation: str = ""
) -> list[tuple[float, PlacedCurve]]:
    """Evidence of each smooth curve and wave: of one variable in any place, of two variables in the places of
    `crowded`.

    Args:
        equation: only curves in its places. Empty: in all.
    """
    included, families = space.included, dict.fromkeys(bases_room.family_names(bases))
    variables = {variable for _, variable in families}
    varying = [
        v
        for v in (*bases_room.VARIABLES, *bases_room.ORDERS)
        if v in variables and _variable_varies(linear, v, included)
    ]
    curves = []
    for place, variable in families:
        if variable in varying and (not equation or equation_of_place(place) == equation):
            curve = smooth.fit_smooth_curve(linear, place, variable, included)
            curves.append((curve.evidence, PlacedCurve(place, (variable,))))
    project, varied = Projection.of(linear), [v for v in VARIABLES if v in varying]
    for place, pair in itertools.product(sorted(crowded), itertools.combinations(varied, 2)):
        evidence, _ = smooth.fit_smooth_surface(linear, place, pair, included, project)
        curves.append((evidence, PlacedCurve(place, pair)))
    return curves


def _variable_varies(linear: Linearization, variable: str, included: np.ndarray) -> bool:
    x = linear.curve_variable(bases_room.SHAFTS, variable)[0][linear.at_points(included)]
    return bool(np.all(np.isfinite(x)) and np.ptp(x) > 1e-9 * max(np.max(np.abs(x)), 1e-9))


def _linear_explanation(space: CandidateSpace, best: Candidate, linear: Linearization) -> float:
    """Decrease of χ² by the effects of a candidate, to first order at the base fit and at their nearest grid shapes
    [σ²].
    """
    shapes, library, nearest = best.z[space.free + len(best.active) :], space.library, []
    for slot, name in enumerate(best.active):
        if name:
            instances = library.instances(name)
            nearest.append(instances[np.argmin(np.abs(library.at[instances] - shapes[slot]))])
    return Projection.of(linear).explained(np.asarray(linear.signatures)[:, nearest])[0]


# --- a fit that is not adequate: do the names keep their significance? -------------------------------------


def _equation_of_effect(space: CandidateSpace, effect: str) -> str:
    return equation_of_place(space.library[effect].channel or space.library[effect].balance)


def _compare_with_single_curve(base_curve: BaseCurve, best: Candidate) -> NameSupport:
    """Tests if a single smooth curve fits the data where the effects of a candidate do not."""
    base_diagnosis, bases = base_curve.left, base_curve.bases
    names = bases_room.family_names(bases)
    strongest: dict[str, int] = {}  # family of each place, the most significant place first
    for index in np.argsort(-np.asarray(base_diagnosis.scores.curve)):
        strongest.setdefault(names[index][0], int(index))
    for place, k in itertools.islice(strongest.items(), ALONE):
        columns = family_columns(base_diagnosis.linear, bases, k)
        statistics, _ = statistics_with_columns(base_diagnosis.linear, bases, columns, [place])
        if not base_diagnosis.test.of(statistics).rejected_with_margin:
            return NameSupport(False, "curve alone", curves=(PlacedCurve(place, names[k][1:]),))
    location, space = base_curve.where, base_curve.space
    equations = {_equation_of_effect(space, effect) for effect in best.effects}
    # Linear rows of logs have no fit of a curve.
    if not space.bare.observe.over_time and equation_of_place(location.place) in equations:
        # A strong curve distorts the base fit, and names then absorb its residuals in the same equation.
        # If the result is highly significant, no closer look is compiled.
        adequate = not base_diagnosis.test.exceeds_margin("chi2", base_curve.fitted.chi2[1])
        if adequate and not base_curve.diagnosis.test.rejected_with_margin:
            return NameSupport(False, "curve alone", curves=(PlacedCurve(location.place, (location.variable,)),))
    return NameSupport(True)


def _strongest_curves(diagnosis: Diagnosis, bases: Bases, equation: str) -> list[int]:
    """Families of curves outside an equation, the most significant first, until the residuals are noise or `CURVES`
    are added.
    """
    places, linear = [n[0] for n in bases_room.family_names(bases)], diagnosis.linear
    excluded = np.array([equation_of_place(p) == equation for p in places])
    chosen_curves, columns = list[int](), np.zeros((linear.readings, 0))
    deviate, test = np.array(diagnosis.scores.curve), diagnosis.test
    while test.rejected_with_margin and len(chosen_curves) < CURVES:
        chosen_curves.append(int(np.argmax(np.where(excluded, -np.inf, deviate))))
        columns = np.concatenate([columns, family_columns(linear, bases, chosen_curves[-1])], 1)
        statistics, deviate = statistics_with_columns(linear, bases, columns, [places[k] for k in chosen_curves])
        test = test.of(statistics)
    return chosen_curves


def judge_each_name(
    base_curve: BaseCurve,
    best: Candidate,
    searched: SearchResult,
    after: Diagnosis,
    blocks: Sequence[np.ndarray],
    better: Sequence[Candidate],
) -> tuple[NameTest, ...]:
    """Tests each effect on its own, with all other effects fitted.

    A test has the root of the effect's score in addition to curves of other equations, and its most influential row.
    It also has the share of hold-out blocks that find the effect again, and its evidence against curves of its own
    equation.

    The test uses a score instead of an amplitude over its sd. With a free shape that ratio stays small, however much
    an effect explains (Hauck and Donner, J. Am. Stat. Assoc. 72 (1977). Davies, Biometrika 64 (1977)). Curves in the
    effect's own equation would absorb it. So they are compared with it in addition to the largest set of the search.
    Without that set, a curve would represent its other effects in the same equation.

    Args:
        after: diagnosis of the fit with all of them.
        blocks: as in `judge_names`.
        better: candidates that are the better explanation but not of a plausible size.
    """
    space, bases, settings = base_curve.space, base_curve.bases, base_curve.settings
    names, largest, tests = bases_room.family_names(bases), searched.best or best, []
    over_time = space.bare.observe.over_time
    diagnosis_of_largest = searched.diagnosis or after
    deficient = _deficient_equations(space, diagnosis_of_largest, bases)
    without_each = dict(zip(largest.effects, refit_without_each(space, largest, searched.ladder), strict=True))
    without_effect = refit_without_each(space, best, searched.ladder)
    fits = {c.active: c for c in (*without_effect, *(c for e, c in without_each.items() if e in best.effects))}
    linearizations = {active: diagnose_candidate(space, c, bases, after).linear for active, c in fits.items()}
    for effect, without in zip(best.effects, without_effect, strict=True):
        equation, linear = _equation_of_effect(space, effect), linearizations[without.active]
        curves = _strongest_curves(after, bases, equation)
        fit, columns = _with_curves(linear, bases, curves), space.library.columns(effect, linear)
        root = float(fit.roots(columns).max())
        judged, tangent = fit, linear
        if root**2 < PROMISED * 2 * (without.cost - best.cost):
            tangent = after.linear
            judged = remove_effect(space, best, effect, _with_curves(tangent, bases, curves))
        row, root_without, changed, root_changed = None, math.inf, "", 0.0
        if over_time:
            row, changed, root_changed = changed_run(space, linear, bases, fit)
        else:
            row, root_without = _most_influential_row(space, fit, columns)
        full_fit, other_fit = (largest, without_each[effect]) if effect in without_each else (best, without)
        evidence = evidence_over_curves(base_curve, full_fit, other_fit, (effect,), linearizations[other_fit.active])
        families = (space.library[effect].family(),)
        linear_of_largest = diagnosis_of_largest.linear if effect in without_each else after.linear
        tests.append(
            NameTest(
                effect,
                root,
                after.test.threshold("single") + over_time * settings.margins["single"],
                tuple(PlacedCurve(names[k][0], names[k][1:]) for k in curves),
                evidence,
                row,
                root_without,
                _recurrence(
                    space, families, judged, space.library.columns(effect, tangent), tangent, blocks, settings
                ),
                next((c.effects for c in better if effect not in c.effects), ()),
                equation in deficient,
                *_largest_variation(space, full_fit, effect, linear_of_largest, settings.shares["single"]),
                offset=_relative_zero_error(space, best, effect, settings),
                changed=changed,
                root_changed=root_changed,
            )
        )
    return tuple(tests)


def _relative_zero_error(space: CandidateSpace, best: Candidate, effect: str, settings: Settings) -> float:
    """Zero error of an instrument without a stated noise, divided by the rms of its readings [-]. Otherwise
    infinite.
    """
    kind = space.library[effect]
    if kind.channel not in settings.silent or not getattr(kind, "of_zero", False):
        return math.inf
    k = [c.name for c in space.bare.channels].index(kind.channel)
    measured = np.asarray(space.bare.data.measured)[space.included, k]
    amplitude = abs(float(best.amplitude[best.active.index(effect)])) * amplitude_of(kind).spec.prior_sd(0.0)
    return amplitude / max(float(np.sqrt(np.nanmean(measured**2))), 1e-300)


def _deficient_equations(space: CandidateSpace, diagnosis: Diagnosis, bases: Bases) -> set[str]:
    """Equations with a significant discrepancy: those of the most significant curve and of the strongest effect."""
    if not diagnosis.test.rejected_with_margin:
        return set()
    deficient = {equation_of_place(locate_discrepancy(diagnosis, bases, space.included).place)}
    if diagnosis.test.exceeds_margin("single"):
        strongest = space.library.of[int(np.argmax(np.abs(diagnosis.scores.single)))]
        deficient.add(_equation_of_effect(space, space.library.names[strongest]))
    return deficient


def _largest_variation(
    space: CandidateSpace, best: Candidate, effect: str, linear: Linearization, share: float
) -> tuple[float, str, float, float]:
    """Largest change of an effect's amplitude over a variable, as a line or a parabola.

    Returns four values: root of its score after a refit [σ], variable, critical value [σ], and relative change of
    the amplitude at an end of the variable's range [-]. The critical value holds for all these tests
    (Bonferroni 1936).

    To first order, the residual of a law of another form is the name's own term with an amplitude that varies. So
    a few columns can test what a whole family of curves, with many more, cannot. Only for
    settled runs, where each row depends only on the term in this row. In histories the root is 0.

    Args:
        linear: the fit of the candidate, linearised.
        share: family-wise error of the critical value.
    """
    largest = 0.0, "", math.inf
    if space.bare.observe.over_time:
        return *largest[:2], math.inf, math.inf
    fit, slot = Projection.of(linear), space.free + best.active.index(effect)
    of_row = fit.jacobian[: linear.readings, slot].reshape(linear.rows, -1)
    variables = [v for v in (*VARIABLES, "speed") if _variable_varies(linear, v, space.included)]
    for variable in variables:
        values = linear.curve_variable(bases_room.SHAFTS, variable)[0].reshape(-1, linear.rows).mean(0)
        x = bases_room.scale_to_unit_range(np.nan_to_num(values), space.included.astype(float))
        columns = np.stack([(of_row * shape[:, None]).ravel() for shape in (x, 2 * x**2 - 1)], 1)
        for root, norm2, score in zip(fit.roots(columns), *fit.norms(columns), strict=True):
            spread = abs(score / max(norm2, 1e-300) / best.z[slot]) if best.z[slot] else math.inf
            largest = max(largest, (float(root), variable, float(spread)))
    chance = NormalDist().inv_cdf(1 - share / (4 * max(len(variables), 1)))  # two shapes, either sign
    return *largest[:2], chance, largest[2]


def evidence_over_curves(
    base_curve: BaseCurve, best: Candidate, without: Candidate, effects: Names, linear: Linearization
) -> float:
    """Twice the log Bayes factor of effects of one equation over the best smooth curve in it [σ²].

    Effects and curve are each penalised for the number of their alternatives in that equation.

    Args:
        best: candidate with the effects.
        without: the same candidate without them.
        linear: linearization at `without`.
    """
    space = base_curve.space
    equation = _equation_of_effect(space, effects[0])
    rivals = sum(_equation_of_effect(space, name) == equation for name in space.library.names)
    cost = sum(_cost_of_effect(space, best, name) + 2 * math.log(rivals) for name in effects)
    same_equation = [evidence for evidence, _ in _curve_evidence(space, linear, base_curve.bases, set(), equation)]
    by_curve = max(same_equation, default=-math.inf) - 2 * math.log(max(len(same_equation), 1))
    return 2 * (without.cost - best.cost) - cost - by_curve


def _with_curves(linear: Linearization, bases: Bases, curves: Sequence[int]) -> Projection:
    """Projection at a fit with additional families of curves."""
    columns = [np.zeros((linear.readings, 0)), *(family_columns(linear, bases, k) for k in curves)]
    return Projection(*augment_with_columns(linear, np.concatenate(columns, 1)))


def recurrence_of_families(
    base_curve: BaseCurve, best: Candidate, families: Sequence[str], blocks: Sequence[np.ndarray]
) -> float:
    """Share of the informative blocks for which, without the block, an effect of these families still explains most.

    A block is informative if half of the information on the candidate's first effect remains without it. 1 if there
    is none.
    """
    space, effect, linear = base_curve.space, best.effects[0], base_curve.left.linear
    fit = Projection.of(linear)
    if fit.roots(space.library.columns(effect, linear)).max() ** 2 < PROMISED * 2 * (
        base_curve.base.cost - best.cost
    ):
        linear = diagnose_candidate(space, best, base_curve.bases, base_curve.left).linear
        fit = remove_effect(space, best, effect, Projection.of(linear))
    columns = space.library.columns(effect, linear)
    return _recurrence(space, families, fit, columns, linear, blocks, base_curve.settings)


def _recurrence(
    space: CandidateSpace,
    families: Sequence[str],
    fit: Projection,
    columns: np.ndarray,
    linear: Linearization,
    blocks: Sequence[np.ndarray],
    settings: Settings,
) -> float:
    """Share of the informative blocks for which, without the block, an effect of these families still explains most.

    The criterion is the same as in `classes`. A block is informative if half of the information on the effect remains
    without it. 1 if there is none.

    If an effect explains much, the fit without it may be so far off that its linearization predicts nothing reliable.
    Then `fit` is the fit with the effect, to first order without it.

    Args:
        columns: sensitivities to the effect.
        linear: linearization with the sensitivities to all effects of the library.
    """
    library, recurs, signatures = space.library, [], np.asarray(linear.signatures)
    same_family = np.array([library[name].family() in families for name in library.names])[library.of]
    information = fit.norms(columns)[0].max()
    for left_out in blocks:
        kept_rows = kept_readings(space, left_out, len(signatures))
        without = fit.only(kept_rows)
        if without.norms(columns[kept_rows])[0].max() < 0.5 * information:
            continue
        roots = without.roots(signatures[kept_rows])
        most = np.max(roots) ** 2
        recurs.append(np.max(roots[same_family]) ** 2 >= most - settings.tolerance(most))
    return float(np.mean(recurs)) if recurs else 1.0


def _most_influential_row(space: CandidateSpace, fit: Projection, columns: np.ndarray) -> tuple[int | None, float]:
    """Number of the row whose omission reduces the largest root most, and the root without it. None for fewer than
    three rows.
    """
    lowest: tuple[int | None, float] = None, math.inf
    rows = np.flatnonzero(space.included)
    for row in rows if len(rows) > 2 else ():
        kept_rows = kept_readings(space, np.arange(len(space.included)) == row, len(columns))
        root = float(fit.only(kept_rows).roots(columns[kept_rows]).max())
        lowest = (int(row) + 1, root) if root < lowest[1] else lowest
    return lowest


def changed_run(
    space: CandidateSpace, linear: Linearization, bases: Bases, fit: Projection
) -> tuple[int | None, str, float]:
    """Run, constant and root of the best explanation by one constant that differs in one run. None for one run.

    The constants are the free parameters and a constant error of each place. A run has hundreds of readings, so an
    effect may be visible in one run only. If a constant of that run explains as much, the run may just be different.
    """
    readings, names = linear.readings, list(space.coordinates.base.names)
    columns = [np.asarray(linear.jacobian)[:readings, : space.free]]
    for k, (place, _) in enumerate(bases_room.family_names(bases)):
        if place not in names:
            columns.append(family_columns(linear, bases, k)[:, :1])
            names += [place] * columns[-1].shape[1]  # none if the readings do not show the place
    constants = np.concatenate(columns, 1)
    best: tuple[int | None, str, float] = None, "", 0.0
    runs = [(k, rows) for k, rows in enumerate(linear.runs()) if space.included[rows].any()]
    for k, rows in runs if len(runs) > 1 else ():
        left_out = np.zeros(len(space.included), bool)
        left_out[rows] = True
        readings_of_run = np.flatnonzero(~kept_readings(space, left_out, readings))
        roots = fit.roots(constants[readings_of_run], readings_of_run)
        if roots.max() > best[2]:
            best = k + 1, names[int(np.argmax(roots))], float(roots.max())
    return best


def kept_readings(space: CandidateSpace, left_out: np.ndarray, readings: int) -> np.ndarray:
    """True for readings that remain after some rows are left out, including padding, shape (readings,)."""
    rows = np.concatenate([left_out, np.zeros(len(space.included) - len(left_out), bool)])
    return np.repeat(~rows, readings // len(rows))
