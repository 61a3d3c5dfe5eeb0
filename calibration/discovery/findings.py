"""From the loop's stages to its result: effects, evidence, shifts, errors, each by name and in its unit."""

from __future__ import annotations

import dataclasses
import inspect
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from calibration.data.runs import Runs
from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.adequacy import AdequacyTest
from calibration.discovery.candidates import Candidate, fit_candidates, start
from calibration.discovery.classes import Classes
from calibration.discovery.discrepancy import Discrepancy, Location
from calibration.discovery.experiments import Proposal
from calibration.discovery.result import (
    Alternative,
    BaseShift,
    EffectScore,
    Errors,
    Estimate,
    Evidence,
    Formula,
    FoundEffect,
    KindOfEvidence,
    Member,
    NextExperiment,
    RankedExperiment,
    ReadingsOfRows,
    UnnamedDiscrepancy,
)
from calibration.discovery.score_tests import ScoreTable
from calibration.discovery.settings import Settings
from calibration.inference import bases as bases_room
from calibration.inference import blocks as blocks_room
from calibration.inference import priors
from calibration.inference.errors import summary
from calibration.inference.held_out import held_out
from calibration.inference.linearization import amplitude_of, shape_of, shape_scales, shaped
from calibration.inference.optimizers import read
from calibration.inference.problem import Problem
from mmrjax import channels
from mmrjax.balances import BALANCES
from mmrjax.effects import Effect
from mmrjax.robot import Robot


def size_of(effect: Effect) -> float:
    """One prior sd of an effect's amplitude [its unit]."""
    return amplitude_of(effect).spec.prior_sd(0.0)


def equation(effect: Effect) -> tuple[str, str]:
    """Equation and source of an effect, from its docstring."""
    head, _, source = (inspect.getdoc(type(effect)) or "").partition("Source:")
    return " ".join(head.split()), " ".join(source.split())


# --- effects --------------------------------------------------------------------------------------------


def found_effects(
    space: CandidateSpace, base: Candidate, best: Candidate, found: Classes, test: AdequacyTest, settings: Settings
) -> tuple[FoundEffect, ...]:
    """Each effect of the best candidate, with its class, amplitude and evidence.

    Args:
        test: of the base fit, whose bootstrap gives the p-values.
    """
    gains = _without_each(space, base, best, settings)
    null = np.asarray(test.null.single) ** 2
    listed = []
    for slot, members in enumerate(found.members):
        effect = space.library[members[0]]
        words, source = equation(effect)
        listed.append(
            FoundEffect(
                name=effect.name,
                members={name: _member(space, best, found, slot, name) for name in members},
                balance=effect.balance,
                unit=BALANCES[effect.balance][0],
                equation=words,
                source=source,
                parameters=_parameters(space, best, slot, settings),
                p_value=(1 + int(np.sum(null >= gains[slot]))) / (1 + len(null)),
                score=float(gains[slot]),
            )
        )
    return tuple(listed)


def _parameters(space: CandidateSpace, best: Candidate, slot: int, settings: Settings) -> dict[str, Estimate]:
    effect, p = space.library[best.active[slot]], space.free
    amplitude, unit = amplitude_of(effect), size_of(effect)
    sd = settings.width * best.sd[p + slot] * unit
    values = {amplitude.name: Estimate(float(best.amplitude[slot] * unit), float(sd), amplitude.spec.unit)}
    shape = shape_of(effect)
    if shape is not None:
        k, scales = p + settings.slots + slot, shape_scales(shape)
        value, slope = jax.value_and_grad(lambda z: shaped(scales, z))(jnp.asarray(best.z[k]))
        values[shape.name] = Estimate(float(value), float(slope) * float(best.sd[k]), shape.spec.unit)
    return values


def _member(space: CandidateSpace, best: Candidate, found: Classes, slot: int, name: str) -> Member:
    """An effect of a class in the leader's place."""
    wanted = frozenset(name if s == slot else n for s, n in enumerate(best.active)) - {""}
    other = next(c for c in (best, *found.ladder) if c.key == wanted)
    amplitude = other.amplitude[other.active.index(name)] * size_of(space.library[name])
    return Member(float(amplitude), float(2 * (other.cost - best.cost)))


def _without_each(space: CandidateSpace, base: Candidate, best: Candidate, settings: Settings) -> list[float]:
    """What each effect explains that the others cannot: the rise of χ² when it is taken away and all is refitted."""
    if len(best.effects) == 1:
        return [2 * (base.cost - best.cost)]
    fewer = [tuple("" if s == slot else n for s, n in enumerate(best.active)) for slot in range(len(best.effects))]
    fitted = fit_candidates(space, [(w, start(space, best, w, settings)) for w in fewer], settings)
    return [2 * (c.cost - best.cost) for c in fitted]


def unnamed(found: Discrepancy, where: Location, p_value: float, rows: int) -> UnnamedDiscrepancy:
    """The discrepancy of an `unnamed` verdict, over the rows of the table."""
    f, lacks = found.proposal, found.defect
    return UnnamedDiscrepancy(
        balance=where.balance,
        variable=where.variable,
        unit=found.unit,
        balances_alike=where.alike,
        effect=found.effect,
        p_value=p_value,
        score=float(found.chi2[0] - found.chi2[1]),
        score_free_in_each_run=where.explained if where.variable in bases_room.ORDERS else None,
        at=found.grid,
        value=found.curve,
        sd=found.sd,
        defect=None if lacks is None else lacks.value[:rows],
        defect_sd=None if lacks is None else lacks.sd[:rows],
        proposal=Formula(f.formula, f.mark, f.coefficients, f.sds, f.gain, f.tried),
    )


def alternatives(
    space: CandidateSpace, best: Candidate | None, ladder: Sequence[Candidate], settings: Settings, *, plausible: bool
) -> tuple[Alternative, ...]:
    """Candidates that explain the data nearly as well as the one proposed, or would but for their size."""
    if best is None or not best.effects:
        return ()
    listed = []
    for c in sorted(ladder, key=lambda x: x.cost):
        rise = 2 * (c.cost - best.cost)
        if c.key != best.key and c.plausible == plausible and rise <= settings.alternative:
            sds = {name: float(a) for name, a in zip(c.active, c.amplitude, strict=True) if name}
            sizes = {name: a * size_of(space.library[name]) for name, a in sds.items()}
            listed.append(Alternative(sizes, sds, float(rise)))
    return tuple(listed)


def proposed_robot(space: CandidateSpace, best: Candidate) -> Robot:
    """The base fitted, with what was found and no other effect."""
    whole = space.problem(best.active).robot(jnp.asarray(best.z))
    keep = set(best.effects) | {e.name for e in space.bare.base.effects}
    return dataclasses.replace(whole, effects=tuple(e for e in whole.effects if e.name in keep))


def next_experiment(proposal: Proposal | None) -> NextExperiment | None:
    """A proposal as plain data."""
    if proposal is None:
        return None
    menu = tuple(
        RankedExperiment(r.experiments[0], r.smallest, r.separates, float(r.chances.min()), float(r.chances.mean()))
        for r in proposal.table
    )
    return NextExperiment(
        proposal.name, proposal.experiments, proposal.description, proposal.separates, proposal.expected_sigma,
        proposal.settles, menu,
    )  # fmt: skip


# --- the base and the library ---------------------------------------------------------------------------


def evidence(test: AdequacyTest, adequate: bool) -> Evidence:
    """The strongest statistic of each kind, what it has to exceed, and its share among bootstrap tables."""
    kinds = {
        kind: KindOfEvidence(
            float(getattr(test.found, kind)), test.threshold(kind), test.p(kind), np.asarray(getattr(test.null, kind))
        )
        for kind in test.settings.shares
    }
    return Evidence(kinds, test.p_value, adequate)


def base_shift(space: CandidateSpace, before: np.ndarray, after: np.ndarray, sd: np.ndarray) -> dict[str, BaseShift]:
    """Every base parameter before and after, in its unit and in prior sds.

    Args:
        before, after: coordinates, those of the base first; sd: of the latter.
    """
    coordinates, p = space.coordinates.base, space.free
    z = [np.asarray(x[:p]) for x in (before, after)]
    value = [np.asarray(coordinates.value(jnp.asarray(x))) for x in (np.zeros(p), *z)]
    slope = np.asarray(coordinates.slope(jnp.asarray(z[1])))
    fields = priors.known(space.bare.base)
    return {
        name: BaseShift(
            prior=float(value[0][k]),
            before=float(value[1][k]),
            after=float(value[2][k]),
            unit=coordinates.units[k],
            sd_after=float(slope[k] * sd[k]),
            meaning=fields[name].spec.meaning,
            shift_before=float(z[0][k]),
            shift_after=float(z[1][k]),
        )
        for k, name in enumerate(coordinates.names)
    }


def effect_scores(space: CandidateSpace, scores: ScoreTable) -> tuple[EffectScore, ...]:
    """Every effect at its best shape, strongest first."""
    listed = []
    for effect in space.library.effects:
        m = space.library.best_instance(effect.name, np.asarray(scores.single))
        listed.append(
            EffectScore(
                name=effect.name,
                balance=effect.balance,
                score=float(scores.single[m] ** 2),
                amplitude=float(scores.amplitude[m] * size_of(effect)),
                sigmas_per_prior_sd=float(scores.left[m]),
            )
        )
    return tuple(sorted(listed, key=lambda s: -s.score))


def invisible(space: CandidateSpace, scores: ScoreTable, settings: Settings) -> tuple[str, ...]:
    """Effects of which the largest plausible amplitude leaves too few sigmas."""
    left = space.library.largest(np.asarray(scores.left))
    return tuple(
        n for n, x in zip(space.library.names, left, strict=True) if settings.plausible * x < settings.visible
    )


# --- readings and errors --------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Fitted:
    """A fit whose readings are shown: its problem, coordinates and active effects (None without slots)."""

    problem: Problem
    z: np.ndarray
    active: tuple[int, ...] | None


def readings(runs: Runs, sd: np.ndarray, before: Fitted, after: Fitted | None) -> ReadingsOfRows:
    """Fitted and held-out readings, for every kind of block; `after` None is the same as before."""
    rows = len(runs)

    def seen(fitted: Fitted) -> np.ndarray:
        found = read(fitted.problem, fitted.problem.robot(jnp.asarray(fitted.z)))
        lost = fitted.problem.observe.unreachable(np.asarray(found.status))[:rows, None]
        return np.where(lost, np.nan, np.asarray(found.reading)[:rows])

    held, labels = {}, {}
    for kind, by in blocks_room.distinct(runs, before.problem.observe.blocks).items():
        masks = list(by.values())
        first = held_out(before.problem, before.z, masks, before.active).reading
        later = first if after is None else held_out(after.problem, after.z, masks, after.active).reading
        held[kind], labels[kind] = (first, later), tuple(by)
    stated, fitted = seen(dataclasses.replace(before, z=np.zeros_like(before.z))), seen(before)
    later = fitted if after is None else seen(after)
    return ReadingsOfRows(runs.measured(), sd[:rows], stated, fitted, later, held, labels)


def errors(
    problem: Problem, simulated: np.ndarray, measured: np.ndarray, sd: np.ndarray, included: np.ndarray
) -> Errors:
    """Errors of every channel [%, and in σ] over the rows that count and have a simulated value."""
    simulated = np.where(included[:, None], simulated, np.nan)
    percent = problem.observe.percent(simulated, measured)
    sigma = (simulated - measured) / sd
    answer: Errors = {}
    for k, name in enumerate(channels.names()):
        there = sigma[np.isfinite(sigma[:, k]), k]
        rms = float(np.sqrt(np.mean(there**2))) if there.size else float("nan")
        answer[name] = {**summary(percent[:, k]), "rms_sigma": rms}
    return answer


# --- words ----------------------------------------------------------------------------------------------


def statement(verdict: str, p: float, classes: Sequence[Sequence[str]], where: Location | None) -> str:
    """The verdict in one sentence; `where` something is missing, or remains."""
    if verdict == "none":
        return f"Nothing is missing: what the fitted model leaves is what noise leaves (family-wise p = {p:.2g})."
    if verdict == "unnamed" and where is not None:
        others = [b for b in where.alike if b != where.balance]
        also = f" (or {', '.join(others)}, which act alike in these data)" if others else ""
        return (
            f"Something is missing in the balance {where.balance}{also}, best shown over "
            f"{where.variable.replace('_', ' ')}, and no effect of the library explains it "
            f"(family-wise p {said_p(p)})."
        )
    names = []
    for words in classes:
        unsure = f"one of {', '.join(words)} (these data cannot tell which)"
        names.append(words[0] if len(words) == 1 else unsure)
    left = "" if where is None else f" Something remains in the balance {where.balance}."
    return f"Missing: {'; '.join(names)} (family-wise p {said_p(p)}).{left}"


def said_p(p: float) -> str:
    """A p-value in words; a small one, of which the bootstrap knows little, as a bound rounded up."""
    if p > 0.01:
        return f"= {p:.2g}"
    step = 10.0 ** math.floor(math.log10(p))
    return f"≤ {math.ceil(p / step - 1e-9) * step:.1g}"
