"""The next experiment: of a menu, the one that best tells apart what a finished loop could not.

Alternatives are hypotheses that explain the same table equally well. Each foresees every reading y of the menu,
with the covariance S = diag(sd²) + J C Jᵀ: of the instruments, and to first order of its fitted coordinates,
C = (JᵀJ)⁻¹ over readings and priors of the table (Chaloner and Verdinelli, Bayesian experimental design,
Statistical Science 10 (1995)). Two alternatives A, B are √(dᵀ S⁻¹ d) apart, d = y_A - y_B, with the S of the
two that leaves less (Hunter and Reiner, Designs for discriminating between two rival models, Technometrics 7
(1965)). If one of them is true, the χ² of the other is larger by σ² ± 2σ, σ being that distance, so that the
chance that the false one is refuted is Φ((σ² - refuted) / 2σ). What is proposed is what is expected to tell the
most of all pairs apart; where one experiment does not do, two.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import ndtr

from calibration.discovery import menu, predicted
from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.candidates import Candidate
from calibration.discovery.classes import Classes
from calibration.discovery.discrepancy import Location
from calibration.discovery.reach import Reach, reach_of
from calibration.discovery.settings import Settings
from calibration.inference import bases, priors
from calibration.inference.normal_equations import cholesky, forward
from calibration.inference.optimizers import informing
from calibration.inference.problem import Problem
from mmrjax import channels
from mmrjax.channels import RPM
from mmrjax.compiling import compiled

#: Alternatives are foreseen in batches of a multiple of this, so that most classes share what is compiled.
PAD = 4
NONE = "none on this menu"


@dataclasses.dataclass(frozen=True)
class PredictedReadings:
    """What every alternative foresees of every reading of the menu.

    Attributes:
        names: of the alternatives, the best fit first.
        experiments: the menu.
        value: readings [SI], shape (alternatives, readings); sd: of the instruments [SI], shape (readings,).
        half: J C^½, so that the covariance that the fit leaves is half halfᵀ; shape
            (alternatives, readings, coordinates).
        there: readings that exist for every alternative, shape (readings,).
        settings: from which separation an experiment counts.
    """

    names: tuple[str, ...]
    experiments: tuple[menu.Experiment, ...]
    value: np.ndarray
    half: np.ndarray
    sd: np.ndarray
    there: np.ndarray
    settings: Settings

    def apart(self, a: int, b: int, *experiments: str) -> float:
        """Expected separation of two alternatives by experiments, all carried out [σ]."""
        where = predicted.spans(self.experiments)
        spans = [where[e] for e in experiments]
        at = np.concatenate([np.flatnonzero(self.there[k]) + k.start for k in spans])
        d = self.value[a, at] - self.value[b, at]
        squares = [d @ np.linalg.solve(_covariance(self.half[x, at], self.sd[at]), d) for x in (a, b)]
        return float(np.sqrt(max(min(squares), 0.0)))


def _covariance(half: np.ndarray, sd: np.ndarray) -> np.ndarray:
    return half @ half.T + np.diag(sd**2)


@dataclasses.dataclass(frozen=True)
class Ranked:
    """One experiment of the menu, or several carried out together.

    Attributes:
        experiments: their names; sigma: between every two alternatives, the pairs of the best fit first, as
            `itertools.combinations` has them [σ].
        separates: alternatives that they tell from the best fit, at `Settings.apart`.
        settings: from which separation an experiment counts.
    """

    experiments: tuple[str, ...]
    sigma: tuple[float, ...]
    separates: tuple[str, ...]
    settings: Settings

    @property
    def smallest(self) -> float:
        """Separation of the pair that is told apart worst [σ]."""
        return min(self.sigma, default=0.0)

    @property
    def told(self) -> tuple[float, ...]:
        """Separations that are worth while."""
        return tuple(s for s in self.sigma if s >= self.settings.worth)

    @property
    def chances(self) -> np.ndarray:
        """For each pair, that the false one is refuted if either is true."""
        sigma = np.maximum(self.sigma, 1e-9)
        return ndtr((sigma**2 - self.settings.refuted) / (2 * sigma))


@dataclasses.dataclass(frozen=True)
class Proposal:
    """The next experiment, or two where one does not do.

    Attributes:
        experiments: names of what to carry out; `NONE` alone where the menu holds nothing.
        description: what to do and what to read.
        separates: alternatives that it tells from the best fit.
        expected_sigma: the smallest separation of a pair that it is worth doing for; 0 for none.
        settles: whether it tells every two alternatives apart, at `Settings.apart`.
        table: the whole menu, the most useful experiment first.
    """

    experiments: tuple[str, ...]
    description: str
    separates: tuple[str, ...]
    expected_sigma: float
    settles: bool
    table: tuple[Ranked, ...]

    @property
    def name(self) -> str:
        """Of all of it."""
        return " and ".join(self.experiments)


# --- alternatives -----------------------------------------------------------------------------------


def alternatives(best: Candidate, found: Classes, *, stated: bool = True) -> dict[str, Candidate]:
    """The candidates that a table leaves, by the names of their effects; the best fit first.

    Args:
        stated: whether values that may be wrong in the place of an effect are among them, by their names.
    """
    fitted = {c.key: c for c in sorted(found.ladder, key=lambda c: -c.cost)}
    kept = {best.active: best}
    for slot, members in enumerate(found.members):
        for name in members[1:]:
            active = tuple(name if s == slot else n for s, n in enumerate(best.active))
            kept[active] = fitted[frozenset(n for n in active if n)]
    named = {" + ".join(c.effects): c for c in kept.values()}
    if stated:
        for shifts in found.stated:
            named |= {" + ".join((s.name, *s.fit.effects)): s.fit for s in shifts}
    return named


# --- what they foresee ------------------------------------------------------------------------------


@compiled
def _predicted(
    problem: Problem, other: priors.Coordinates | None, batch: predicted.Batch, which: Array, z: Array
) -> tuple[predicted.Predicted, Array]:
    """Readings of the menu, and ½ of what the fit leaves of their covariance, by alternative.

    `other` are coordinates of what the table does not show at all, known by their priors alone.
    """
    rows = informing(problem.data)

    def one(w: Array, z: Float[Array, " coordinates"]) -> tuple[predicted.Predicted, Array]:
        here = dataclasses.replace(problem, coordinates=problem.coordinates.with_effects(w))

        def residual(x: Array) -> Array:
            return jnp.concatenate([here.misfit(x, here.data), x - here.data.centre])

        def reading(x: Array) -> tuple[Array, predicted.Predicted]:
            base = here.base if other is None else other.robot(here.base, x[z.size :])
            found = predicted.readings(here.coordinates.robot(base, x[: z.size]), batch)
            return found.value, found

        informed = jax.jacfwd(residual)(z)[rows]
        lower = cholesky(informed.T @ informed)
        wide = jnp.concatenate([z, jnp.zeros(0 if other is None else len(other))])
        slopes, found = jax.jacfwd(reading, has_aux=True)(wide)
        half = jnp.concatenate([forward(lower, slopes[:, : z.size].T).T, slopes[:, z.size :]], 1)
        exists = found.exists & jnp.all(jnp.isfinite(half), 1) & jnp.isfinite(found.value)
        return dataclasses.replace(found, exists=exists), half

    return jax.vmap(one)(which, z)


def predict(space: CandidateSpace, candidates: Mapping[str, Candidate], settings: Settings) -> PredictedReadings:
    """What these alternatives foresee of the menu, with instruments as good as those of the table.

    The menu holds what is within reach of the table, what the robots of all alternatives manage, and what is not
    forbidden.
    """
    names, those = list(candidates), list(candidates.values())
    those += [those[0]] * (-len(those) % PAD)
    robot = space.bare.base
    whole = priors.free_names(robot, robot.configurations.names)
    more = [n for n in whole if n not in space.coordinates.base.names]
    other = priors.coordinates(robot, more) if more else None
    active = jnp.asarray([space.library.indices(c.active) for c in those])
    z = jnp.asarray(np.stack([c.z for c in those]))
    within = reach_of(space, space.bare.robot(jnp.asarray(those[0].z[: space.free])))
    everything, shown = menu.menu(within), channels.names(space.bare.channels)
    found, half = jax.device_get(_predicted(space.equipped, other, predicted.batch(everything, shown), active, z))
    found, half = jax.tree.map(lambda x: np.asarray(x)[: len(names)], (found, half))
    experiments, kept = _possible(everything, found, within, settings)
    medians = np.median(np.asarray(space.equipped.data.sd), 0)
    sd = predicted.sds(experiments, dict(zip(shown, medians, strict=True)))
    value, half = np.nan_to_num(found.value[:, kept]), np.nan_to_num(half[:, kept])
    return PredictedReadings(tuple(names), experiments, value, half, sd, np.all(found.exists, 0)[kept], settings)


def _possible(
    experiments: Sequence[menu.Experiment], found: predicted.Predicted, within: Reach, settings: Settings
) -> tuple[tuple[menu.Experiment, ...], np.ndarray]:
    """What of a menu is possible and not forbidden, and whether each reading of the whole menu is of that.

    Args:
        found: of every alternative, the best fit first.
    """
    runs = [e for e in experiments if isinstance(e, menu.Run)]
    ends = dict(zip((r.name for r in runs), np.cumsum([len(r.voltage) for r in runs]).tolist(), strict=True))
    left: list[menu.Experiment] = []
    kept: list[np.ndarray] = []
    for e in experiments:
        rows = np.ones(predicted.size(e), bool)
        if isinstance(e, menu.Run):
            at = slice(ends[e.name] - len(e.voltage), ends[e.name])
            grips = np.abs(found.grip[:, at]) < np.where(np.asarray(e.slope) > e.beyond, menu.GRIP, np.inf)
            done = menu.possible(e, np.all(found.does[:, at] & grips, 0))
            if done.any():
                hot, fast = np.asarray(found.temperature)[0, at], np.asarray(found.speed)[0, at]
                e = menu.carried_out(e, done, hot, fast, within)
            rows = np.repeat(done, len(e.channels))
        if set(e.kinds) & set(settings.forbidden):
            rows = np.zeros(len(rows), bool)
        if rows.any():
            left.append(e)
        kept.append(rows)
    return tuple(left), np.concatenate(kept)


# --- the choice -------------------------------------------------------------------------------------


def _ranked(seen: PredictedReadings, *experiments: str) -> Ranked:
    pairs = itertools.combinations(range(len(seen.names)), 2)
    sigma = tuple(seen.apart(a, b, *experiments) for a, b in pairs)
    others = zip(seen.names[1:], sigma, strict=False)  # the pairs of the best fit come first
    return Ranked(experiments, sigma, tuple(n for n, s in others if s >= seen.settings.apart), seen.settings)


def _use(r: Ranked) -> tuple[bool, float]:
    """Whether it is worth while for any pair, and how many pairs it is expected to tell apart."""
    return bool(r.told), float(np.sum(np.minimum(r.chances, r.settings.enough)))


def ranked(seen: PredictedReadings) -> tuple[Ranked, ...]:
    """The whole menu by the number of pairs that an experiment is expected to tell apart; of those that tell as many
    by `Settings.enough`, in the menu's order, the least effort first."""
    return tuple(sorted((_ranked(seen, e.name) for e in seen.experiments), key=_use, reverse=True))


def choose(seen: PredictedReadings) -> Proposal:
    """The experiment of the menu that tells most apart, with the best one beside it where that adds enough."""
    table = ranked(seen)
    if not table:
        return Proposal((NONE,), "Every experiment of the menu is forbidden or beyond reach", (), 0.0, False, ())
    plan = table[0]
    (first,) = plan.experiments
    both = (_ranked(seen, first, e.name) for e in seen.experiments if e.name != first)
    more = max(both, key=_use, default=plan)
    if more.told and (not plan.told or _use(more)[1] > _use(plan)[1] + seen.settings.gain):
        plan = more
    if not plan.told:
        text = f"No experiment of the menu tells {' and '.join(seen.names)} apart by {seen.settings.worth:g} sigma"
        return Proposal((NONE,), text, (), 0.0, False, table)
    said = {e.name: e.description for e in seen.experiments}
    text = ". And: ".join(said[name] for name in plan.experiments)
    return Proposal(
        plan.experiments, text, plan.separates, min(plan.told), plan.smallest >= seen.settings.apart, table
    )


#: Runs of a series that covers the variable of a curve more densely, and repeats of each that are averaged.
SERIES, REPEATS = 15, 3


def _steps(variable: str, within: Reach) -> str | None:
    """How the variable of a curve is covered more densely, within reach of the table; None for a wave."""
    volts = within.voltages
    low, high = (volts[0], volts[-1]) if volts[-1] > volts[0] else (menu.round_significant(0.5 * volts[0]), volts[0])
    slope = max(u.steepest for u in within.used)
    payload = max(u.payloads[-1] for u in within.used)
    step, angle, mass = (menu.round_significant(x / (SERIES - 1), 1) for x in (high - low, slope, payload))
    load = [f"a payload up to {payload:g} kg"] * (payload > 0) + [f"a slope up to {slope:g} deg"] * (slope > 0)
    loaded = " and ".join(load) or "a brake or a drawbar pull"
    if variable in bases.ORDERS:
        return None
    happens = bases.window(variable)
    if happens is not None and happens.axis == "order":
        return (
            f"Make runs {happens.low:.0f} to {happens.high:.0f} again, and as many before and after them, in another "
            "order: what comes back with them hangs on their conditions, what does not happened then"
        )
    if happens is not None and happens.axis != "time":
        return f"Make the runs at {happens.words} again, on another day, and as many a little below and above that"
    if happens is not None:
        return (
            f"Make two of the runs again, sampled as finely as the instruments allow from {happens.low:.3g} to "
            f"{happens.high:.3g} s, one of them with all that is switched in that time left as it is"
        )
    own = _of_rig(variable, within, slope, payload)
    if own is not None:
        return own
    return {
        "voltage": f"Repeat at one slope and payload with the supply voltage from {low:g} to {high:g} V in steps of "
        f"{step:g} V",
        "current": f"Repeat at {high:g} V with {loaded}, raised in small steps, so that the current rises evenly "
        f"from no load to its largest, some {within.current * within.motors:.2g} A",
        "speed_motor": f"Repeat on the level, unladen, with the supply voltage in steps of {step:g} V from crawl to "
        f"{high:g} V",
        "slope": f"Repeat at one voltage and payload with the slope from 0 to {slope:g} deg in steps of {angle:g} "
        "deg, and downhill",
        "payload": f"Repeat at one voltage and slope with the payload from 0 to {payload:g} kg in steps of {mass:g} "
        "kg",
        "speed": "Repeat on the level, unladen, with the travelling speed in even steps from crawl to its largest, "
        f"some {within.speed:.2g} m/s at {high:g} V",
        "time": f"Record one condition from a cold start for ten minutes, at {low:g} V rather than more, and again "
        f"at once while everything is warm; watch the winding's temperature ({within.hot:g} °C is allowed)",
        "order": "Repeat the table in another order, rows that were first last, and one condition again after every "
        "fifth run",
    }.get(variable, f"Repeat with {variable.replace('_', ' ')} in even small steps from its least to its largest")


def _of_rig(variable: str, within: Reach, slope: float, payload: float) -> str | None:
    """`_steps` where the motors' speed is imposed, or the load is a shaft; None where they say nothing else."""
    level = "Repeat on the level, unladen," if within.has_ground else "Repeat"
    if within.imposed == "motor_speed":
        fastest = max(within.speeds, default=within.motor_speed) / RPM
        turning = f"with the motor speed in {SERIES} even steps up to {fastest:.0f} rpm"
        words = {
            "speed_motor": f"{level} {turning}",
            "speed": f"{level} {turning}, and so the travelling speed",
            "slope": f"Repeat at one motor speed and payload with the slope from 0 to {slope:g} deg, and downhill",
            "payload": f"Repeat at one motor speed and slope with the payload from 0 to {payload:g} kg",
            "time": "Record one motor speed from a cold start for ten minutes, and again at once while all is warm",
        }
        if not within.has_ground:
            words["current"] = f"{level} at one motor speed with a brake that is raised in {SERIES} even steps"
        return words.get(variable)
    if within.has_ground:
        return None
    high = within.voltages[-1]
    return {
        "voltage": f"Repeat with the supply voltage in {SERIES} even steps up to {high:g} V",
        "speed_motor": f"Repeat with the supply voltage in {SERIES} even steps from crawl to {high:g} V",
        "speed": f"Repeat with the supply voltage in {SERIES} even steps from crawl to {high:g} V",
        "current": f"Repeat at {high:g} V with a brake that is raised in {SERIES} even steps",
    }.get(variable)


def _steady_speeds(variable: str, within: Reach) -> str:
    """How a wave is followed from speed to speed."""
    volts = within.voltages
    low, high = (volts[0], volts[-1]) if volts[-1] > volts[0] else (menu.round_significant(0.5 * volts[0]), volts[0])
    three = [f"{menu.round_significant(v):g}" for v in (low, 0.5 * (low + high), high)]
    return (
        f"Mark the driving shaft, start every run from the mark, and record steady travel at {', '.join(three[:2])} "
        f"and {three[2]} V with at least 20 samples a wave: what keeps its {variable} at every speed turns with that "
        "part"
    )


def denser(space: CandidateSpace, where: Location, settings: Settings) -> Proposal:
    """More runs along the variable of a discrepancy without a name.

    Its expected separation from nothing is that of the table [σ], whose curve explains so much a run, over the
    runs of the series.
    """
    place, variable = bases.in_words(where.place), where.variable
    runs, within = space.bare.observe.runs_counting(space.included), reach_of(space)
    sigma = float(np.sqrt(max(where.strongest, 0.0) * SERIES * REPEATS / max(runs, 1)))
    finer = _steps(variable, within)
    how = _steady_speeds(variable, within) if finer is None else finer
    text = f"{how}; read every channel. What the {place} lacks then shows its shape"
    name = f"finer steps in {variable}" if finer is not None else f"steady speeds for {variable}"
    name = name if bases.window(variable) is None else "the same runs again"
    if sigma < settings.worth:
        text = f"A series in {variable} would show what is missing by {sigma:.1f} sigma"
        return Proposal((NONE,), text, (), 0.0, False, ())
    return Proposal((name,), text, (f"curve of the {place} over {variable}",), sigma, False, ())


def separating(space: CandidateSpace, best: Candidate, found: Classes, settings: Settings) -> Proposal | None:
    """What tells the alternatives of a class apart; None where each effect has one name."""
    left = alternatives(best, found)
    return choose(predict(space, left, settings)) if len(left) > 1 else None
