"""Alternatives to each effect found: other effects and stated values that explain the same data as well."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from calibration.data import Names
from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.adequacy import Diagnosis
from calibration.discovery.candidates import Candidate, candidate_of_fit, fit_candidates, start_of_fit
from calibration.discovery.discrepancy import BaseCurve
from calibration.discovery.projection import Projection
from calibration.discovery.search import refit_without_each
from calibration.discovery.settings import Settings
from calibration.inference.bases import place_in_words
from calibration.inference.blocks import fit_from_each_start
from calibration.inference.linearization import Linearization
from mmrjax.model import channels

# --- stated values that may be wrong instead of an effect -----------------------------------------


#: Refits with a prior's mean at the end of the last one, until its pull is small [prior sds].
ROUNDS, PULL = 3, 0.3


@dataclasses.dataclass(frozen=True)
class Shift:
    """A base parameter that explains the data in place of an effect, if its prior is dropped.

    Attributes:
        name: dotted name of the parameter.
        value, stated: value that explains the data, and mean of its prior, both in `unit`.
        prior_sds: their distance in prior sds.
        fit: the fit with the parameter free of its prior. Its cost excludes that prior.
    """

    name: str
    value: float
    stated: float
    unit: str
    prior_sds: float
    fit: Candidate


def prior_shift_scores(jacobian: np.ndarray, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gain by dropping the prior of each coordinate.

    Returns the linear estimate of the decrease of χ² [σ²] and of the coordinate without its prior [prior sds].

    Args:
        jacobian, residual: Jacobian and residual of a fit, with the residuals of the priors last.
    """
    fit = Projection(jacobian, residual)
    priors = slice(len(residual) - jacobian.shape[1], None)
    leverage = np.sum(fit.half[:, priors] ** 2, 0)
    free = np.maximum(1 - leverage, 1e-9)
    is_visible = leverage < 1 - 1e-6
    return np.where(is_visible, fit.left[priors] ** 2 / free, 0.0), np.where(is_visible, residual[priors] / free, 0.0)


def find_prior_shifts(
    space: CandidateSpace, original: Candidate, least_gain: float, linear: Linearization | None = None
) -> list[Shift]:
    """Base parameters that reduce the χ² of a fit by at least `least_gain` [σ²] if their prior is dropped.

    Args:
        original: the fit. Its effects remain in the model.
        linear: linearization of that fit, if known.
    """
    if linear is None:
        problem, (active,) = space.problem_for_sets([original.active])
        residual, jacobian, _ = problem.observe.at(problem, original.z, active)
    else:
        residual, jacobian = linear.residual, linear.jacobian
    explained, values = prior_shift_scores(np.asarray(jacobian), np.asarray(residual))
    base, p = space.coordinates.base, space.free
    shifts = []
    for k in np.argsort(-explained[:p]):
        if explained[k] < least_gain:
            break
        shifted = _fit_without_prior(space, original, int(k), float(values[k]))
        if shifted is not None:
            value, stated = (float(base.value(np.asarray(z))[k]) for z in (shifted.z[:p], np.zeros(p)))
            shifts.append(Shift(base.names[k], value, stated, base.units[k], float(shifted.z[k]), shifted))
    return shifts


def _fit_without_prior(space: CandidateSpace, original: Candidate, k: int, value: float) -> Candidate | None:
    """Fit without the prior of coordinate k: the mean of the prior is moved to the estimate from the data.

    None if the estimate is outside the bounds of the parameter, or if the fit does not converge.
    """
    p, mean = space.free, value
    start = np.array(original.z)
    equipped, (indices,) = space.problem_for_sets([original.active])
    for _ in range(ROUNDS):
        centre = np.zeros(len(start))
        centre[k] = mean
        start[k] = mean
        problem = equipped.with_data(centre=jnp.asarray(centre))
        optima, _ = fit_from_each_start(problem, [start], [space.weight], [indices])
        best = jax.tree.map(lambda x: x[0], optima)
        z = np.asarray(best.z)
        if not np.isfinite(best.cost):
            return None
        if abs(z[k] - mean) < PULL:
            break
        mean, start = float(z[k]), z.copy()
    if space.coordinates.base.beyond(z[:p])[k]:
        return None
    return candidate_of_fit(space, original.active, best)


# --- classes --------------------------------------------------------------------------------------


#: Number of effects that are tried in place of each one.
TRIED = 16
#: Least predicted decrease of χ² by a shifted prior for it to be fitted, as a share of the effect's.
SURE = 0.7


@dataclasses.dataclass(frozen=True)
class Classes:
    """Alternatives that the data cannot distinguish from the best candidate.

    Attributes:
        members: for each effect of the best candidate, the effect itself and all effects that explain the data as
            well.
        stated: for each effect, base parameters whose stated value may be wrong instead.
        families: for each effect, the families of its alternatives, its own first, then those of `ammeter_families`.
        ladder: all candidates that were fitted, including those of the search.
    """

    members: tuple[Names, ...]
    stated: tuple[tuple[Shift, ...], ...]
    families: tuple[Names, ...]
    ladder: tuple[Candidate, ...]

    @property
    def alone(self) -> list[bool]:
        """For each effect, True if the data distinguish it from every alternative."""
        return [
            len(m) == len(f) == 1 and not s for m, s, f in zip(self.members, self.stated, self.families, strict=True)
        ]


def find_classes(base_curve: BaseCurve, best: Candidate, ladder: tuple[Candidate, ...], after: Diagnosis) -> Classes:
    """Effects and stated values that explain the data as well as each effect of the best fit.

    Real losses need not have the exact form of a library effect. So an alternative may explain less than the effect
    by a share `settings.form` of its sigmas, or by `form_family` if it is of the same family.

    Args:
        base_curve: the base fit with its diagnosis.
        after: diagnosis of the best fit.
    """
    space, base_diagnosis, settings = base_curve.space, base_curve.left, base_curve.settings
    names, effect_of = space.library.names, space.library.of
    # Largest |cos| between the projected signatures of every two effects, over their shapes.
    cosine = np.zeros((len(names), len(names)))
    np.maximum.at(cosine, (effect_of[:, None], effect_of[None, :]), np.abs(base_diagnosis.scores.cosine))
    is_single = len(best.effects) == 1
    without_each = [base_curve.base] if is_single else refit_without_each(space, best, ladder)
    rivals: dict[tuple[str, str], Names] = {}
    for name in best.effects:
        cosines = cosine[names.index(name)]
        for j in np.argsort(-cosines)[:TRIED]:
            if cosines[j] > settings.alike and names[j] not in best.effects:
                rivals[name, names[j]] = best.with_effect(name, names[j])
    fits = {c.key: c for c in ladder}
    untried = [active for active in rivals.values() if frozenset(active) - {""} not in fits]
    fitted = fit_candidates(space, [(w, start_of_fit(space, best, w, base_diagnosis.scores)) for w in untried])
    fits |= {c.key: c for c in fitted}
    members, shift_lists, families = [], [], []
    for name, without in zip(best.effects, without_each, strict=True):
        equivalent = [name]
        gain = 2 * (without.cost - best.cost)
        family = space.library[name].family()
        for (replaced, other), active in rivals.items():
            rival = fits[frozenset(active) - {""}]
            same_family = space.library[other].family() == family
            limit = settings.tolerance(gain, same_family)
            if cosine[names.index(name), names.index(other)] > settings.parallel:
                limit = max(limit, settings.same_parallel)
            plausible = rival.nearly if same_family else rival.plausible
            if replaced == name and plausible and 2 * (rival.cost - best.cost) <= limit:
                equivalent.append(other)
        members.append(tuple(equivalent))
        fit = Projection.of(after.linear)
        column = fit.jacobian[: after.linear.readings, space.free + best.active.index(name), None]
        ammeter = ammeter_families(space, remove_effect(space, best, name, fit), column, family, settings)
        families.append(tuple(dict.fromkeys((*(space.library[m].family() for m in equivalent), *ammeter))))
        shifts = find_prior_shifts(space, without, SURE * gain, base_diagnosis.linear if is_single else None)
        shift_lists.append(tuple(s for s in shifts if 2 * (s.fit.cost - best.cost) <= settings.tolerance(gain)))
    return Classes(tuple(members), tuple(shift_lists), tuple(families), (*ladder, *fitted))


def remove_effect(space: CandidateSpace, best: Candidate, effect: str, fit: Projection) -> Projection:
    """Projection at a fit after one of its effects is removed, to first order."""
    k = space.free + best.active.index(effect)
    removed = np.delete(fit.jacobian, [k, k + len(best.active)], 1)
    return Projection(removed, fit.residual - fit.jacobian[:, k] * best.z[k])


def ammeter_families(
    space: CandidateSpace, fit: Projection, columns: np.ndarray, family: str, settings: Settings
) -> Names:
    """Families of ammeter errors that explain the data as well as these effects, by changing the current readings
    alone.

    If the speed is imposed, the current is the main indicator of torque. Only another reading that responds clearly
    to torque can separate a loss from an ammeter error.

    Args:
        fit: the fit without the effects.
        columns: change of the readings per unit of each effect.
        family: family of the effects.
    """
    if space.bare.base.rig.imposed != "motor_speed":
        return ()
    names = channels.channel_names(space.bare.channels)
    explained, _ = fit.explained(columns)
    needed = explained - settings.tolerance(explained)
    driver = family.partition(" that ")[2].replace("with load", "with current")
    of_channel = np.arange(len(columns)) % len(names)
    return tuple(
        f"{place_in_words(name)} that {driver}"
        for k, name in enumerate(names)
        if name.endswith("current") and fit.explained(columns * (of_channel == k)[:, None])[0] >= needed
    )


def errors_of_ammeters(space: CandidateSpace, families: Names) -> Names:
    """Those of the families after the first that are errors of an ammeter, for a `Mechanism`."""
    names = channels.channel_names(space.bare.channels)
    ammeters = tuple(place_in_words(name) for name in names if name.endswith("current"))
    return tuple(f for f in families[1:] if f.startswith(ammeters))
