"""The closed loop, on settled runs or histories: fit, find the residual, trace it, name it or say it has no name."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy import stats

from calibration.data.effect_file import Library
from calibration.data.errors import BadData
from calibration.data.runs import MEASURED, Runs
from calibration.discovery import active_set as slots
from calibration.discovery import bases as curve_room
from calibration.discovery import score_tests as trace
from calibration.discovery.active_set import Slots, amplitude_of
from calibration.discovery.score_tests import Curves, Linear, Scores, Summary, Tracer
from calibration.inference import optimizers as fit
from calibration.inference import priors
from calibration.inference.problem import Observation, Problem, build
from mmrjax import effects
from mmrjax.effects import Effect
from mmrjax.robot import Robot

#: Freed by the loop beside friction: what benches and makers state, with their tolerances.
BENCH = (
    "motor.resistance",
    "motor.torque_constant",
    "motor.friction_coulomb",
    "motor.friction_viscous",
    "gearbox.efficiency_load",
    "gearbox.friction_coulomb",
    "gearbox.friction_viscous",
)
#: And beside them what only a start shows.
START, START_CHASSIS = ("motor.inductance", "motor.inertia"), ("inertia", "ground.friction.dynamic")
#: Family-wise error of «something is missing», shared out among the four kinds of evidence.
ALPHA = {"single": 0.03, "curve": 0.01, "pair": 0.004, "chi2": 0.006}
#: The same for histories, where also the memory of what is left counts.
ALPHA_SERIES = ALPHA | {"chi2": 0.003, "white": 0.003}
#: Hypotheses refitted in one batch; of histories, and the most steps of such a fit.
BATCH = 16
BATCH_SERIES, STEPS_SERIES = 8, 30
#: Draws of the prior among which the starts of a fit to histories are chosen: far off, a start slides where the
#: measured one grips, and a search from there stays.
DRAWS, SEARCHES = 128, 16
#: Rise of the objective [σ²] up to which another effect explains the data as well, and up to which it does
#: where the signatures are nearly parallel.
SAME, SAME_PARALLEL, PARALLEL = 4.0, 9.0, 0.95
#: What each of two effects has to explain, given the other, for both to be named [σ].
BOTH = 5.0
#: How far beyond its threshold a statistic has to be for a fit with effects to be rejected: two sigmas of a
#: leftover that lies right on it would flip the verdict, at a family-wise error of some 1 %.
MARGIN = {"single": 0.5, "curve": 0.7, "pair": 6.0, "chi2": 10.0, "white": 1.0}
#: Rows are padded to a multiple of this, so that tables of about one size share what is compiled.
PAD = 16
#: Largest share of rows set aside as outliers, and the family-wise error of that.
OUTLIERS, ALPHA_OUTLIER = 0.1, 0.01
#: How many times further off than the median row [σ] no row can be that was measured as it is stated.
GROSS = 12.0
#: Scale of Cauchy's weights [σ], and their iterations.
CAUCHY, ROBUST = 2.4, 8


@dataclasses.dataclass(frozen=True)
class Gate:
    """Whether a fit leaves something to explain.

    Attributes:
        found: the strongest statistics of the data; null: of the bootstrap, shape (replicates,) each.
        alpha: share of the family-wise error of each kind of evidence.
    """

    found: Summary
    null: Summary
    alpha: dict[str, float] = dataclasses.field(default_factory=lambda: ALPHA)

    def p(self, kind: str) -> float:
        """Share of bootstrap tables with a statistic as strong, never below 1 / (replicates + 1)."""
        null = getattr(self.null, kind)
        return (1 + int(np.sum(null >= float(getattr(self.found, kind))))) / (1 + len(null))

    def threshold(self, kind: str) -> float:
        """What the strongest statistic of its kind has to exceed."""
        return float(np.quantile(getattr(self.null, kind), 1 - self.alpha[kind], method="higher"))

    @property
    def open(self) -> bool:
        """Whether something is missing, at a family-wise error of 5 %."""
        return any(self.p(kind) <= level for kind, level in self.alpha.items())

    @property
    def clear(self) -> bool:
        """Whether what is left is beyond doubt, so that a fit which leaves it is not the whole story."""
        return any(float(getattr(self.found, k)) > self.threshold(k) + MARGIN[k] for k in self.alpha)

    @property
    def p_value(self) -> float:
        """Family-wise p-value: the smallest of its kinds, each over its share of the error."""
        total = sum(self.alpha.values())
        return min(1.0, min(self.p(kind) * total / level for kind, level in self.alpha.items()))


@dataclasses.dataclass(frozen=True)
class Hypothesis:
    """A set of effects, fitted with the base.

    Attributes:
        which: index of the effect in each slot, -1 where empty.
        z: coordinates, see `Slots`; sd: their posterior sds; cost: the objective [½σ²].
        amplitude: in prior sds of each slot's effect (0 where empty).
        plausible: whether every amplitude is within its bounds, four prior sds, and the sign of a loss.
        converged: whether the fit is an optimum.
        reading: what the base fit says of every row [SI], shape (rows, 3).
    """

    which: tuple[int, ...]
    z: np.ndarray
    sd: np.ndarray
    cost: float
    amplitude: np.ndarray
    plausible: bool
    converged: bool
    reading: np.ndarray | None = None

    @property
    def effects(self) -> tuple[int, ...]:
        """Indices of the effects that are present."""
        return tuple(k for k in self.which if k >= 0)


@dataclasses.dataclass(frozen=True)
class Round:
    """One look at what a fit leaves.

    Attributes:
        hypothesis: what was fitted; linear, scores: there; gate: whether something is left.
    """

    hypothesis: Hypothesis
    linear: Linear
    scores: Scores
    gate: Gate


@dataclasses.dataclass(frozen=True)
class Finding:
    """What the loop found.

    Attributes:
        verdict: `none`, `named`, `class` or `unnamed`.
        base, after: the fit without effects, and the one that is proposed (the same for `none`).
        classes: of each effect found, indices of the effects that these data cannot tell from it, itself first.
        ladder: every hypothesis that was fitted.
        unnamed: (balance, variable, balances that act alike) of an `unnamed` discrepancy, or of what the
            effects of another verdict leave; None if they leave nothing that is beyond doubt.
        rounds: base, then every fit that was gated.
        outliers: rows set aside; unusable: rows that cannot be simulated.
        invisible: indices of effects that the data cannot see.
    """

    verdict: str
    base: Round
    after: Round
    classes: tuple[tuple[int, ...], ...]
    ladder: tuple[Hypothesis, ...]
    unnamed: tuple[str, str, tuple[str, ...]] | None
    rounds: tuple[Round, ...]
    outliers: tuple[int, ...]
    unusable: tuple[int, ...]
    invisible: tuple[int, ...]


def free_names(configurations: Sequence[str], starts: bool = False) -> tuple[str, ...]:
    """What the loop frees for data of these configurations, settled or with histories of starts."""
    present = set(configurations)
    chassis = [c for c, word in (("tracked", "6T2A"), ("wheeled", "4W2T")) if word in present]
    more = START_CHASSIS * starts
    return (*BENCH, *START * starts, *(f"{c}.{n}" for c in chassis for n in (*priors.FRICTION[c], "radius", *more)))


def visible_effects(library: Library, robot: Robot, series: bool = False) -> tuple[Effect, ...]:
    """The effects that runs on an external supply can show, settled or from their start on, and that the robot
    does not have yet."""
    have = {e.name for e in robot.effects}
    skip = have | {"battery_sag"}  # acts on the battery alone
    if not series:
        skip |= {"thermal_drift"} | {name for name, e in library.items() if e.transient}  # settles to winding_heating
    return tuple(e() for name, e in library.items() if name not in skip)


class Engine:
    """What is compiled once for a robot, a library and a size of table, and used for every table.

    Args:
        base: robot whose values are the prior means.
        library: effects to look for.
        size: slots, thus the most effects that are found at once.
        series: whether its tables hold histories.
    """

    def __init__(
        self, base: Robot, library: Library = effects.BY_NAME, size: int = 4, *, series: bool = False
    ) -> None:
        self.base, self.library, self.series = base, library, series
        self.effects = visible_effects(library, base, series)
        self.batch = BATCH_SERIES if series else BATCH
        self.names = tuple(e.name for e in self.effects)
        self.equipped = slots.equipped(base, library, self.names)
        self.size = size
        self.candidates = tuple(slots.scored(e) for e in self.effects)
        self.of = np.repeat(np.arange(len(self.names)), [len(c.at) for c in self.candidates])
        self.at = np.concatenate([c.at for c in self.candidates])
        self.tracer = Tracer(self.candidates)
        self.evaluate = eqx.filter_jit(_evaluate)
        self.fits = self._fits_series if series else eqx.filter_jit(self._fits)
        self.observe = eqx.filter_jit(lambda problem, z: problem.observation(z))
        self.costs = eqx.filter_jit(lambda problem, zs: jax.lax.map(lambda z: _cost(problem, z), zs, batch_size=16))
        self.angle = eqx.filter_jit(_angle)

    def _fits(self, problem: Problem, which: Array, starts: Array, weights: Array) -> tuple[fit.Optimum, Observation]:
        """Fits of hypotheses, each to its own rows, and what each says of every row."""

        def one(w: Array, z: Array, weight: Array) -> tuple[fit.Optimum, Observation]:
            there = dataclasses.replace(problem, coordinates=problem.coordinates.with_effects(w))
            data = dataclasses.replace(problem.data, weight=weight)
            found = fit.levenberg_marquardt(there, z, data, max_steps=60)
            return found, there.observation(found.z)

        return jax.vmap(one)(which, starts, weights)

    def _fits_series(
        self, problem: Problem, which: Array, starts: Array, weights: Array, rivals: bool = False
    ) -> tuple[fit.Optimum, Observation]:
        """As `_fits`, of histories; their runs are compiled once for all steps."""
        evaluate = lambda z: self.evaluate(problem, which, z, weights)  # noqa: E731
        return fit.searches_long(evaluate, starts, problem.data, weights, STEPS_SERIES, rivals=rivals)


def _evaluate(problem: Problem, which: Array, z: Array, weights: Array) -> tuple[Array, Array, Observation]:
    def one(w: Array, z: Array, weight: Array) -> tuple[Array, Array, Observation]:
        coordinates = problem.coordinates
        if isinstance(coordinates, Slots):
            coordinates = coordinates.with_effects(w)
        there = dataclasses.replace(problem, coordinates=coordinates)
        return fit.linearised(there, z, dataclasses.replace(problem.data, weight=weight))

    return jax.vmap(one)(which, z, weights)


def _angle(problem: Problem, z: Array) -> Array:
    return problem.observe.angle(problem.observe.whole(problem.robot(z)))


def _cost(problem: Problem, z: Array) -> Array:
    cost = jnp.sum(problem.misfit(z, problem.data) ** 2) + jnp.sum(z**2)
    return jnp.where(jnp.isfinite(cost), cost, jnp.inf)


def padded(runs: Runs, to: int = PAD) -> tuple[Runs, np.ndarray]:
    """The runs with repeats of the first behind them, to a multiple of `to`, and which rows count."""
    rows = len(runs)
    index = np.concatenate([np.arange(rows), np.zeros(-rows % to, int)])
    return runs.where(index), np.arange(len(index)) < rows


class Loop:
    """One pass of the loop over one table.

    Args:
        engine: compiled parts.
        runs: the table; sd: of its readings [SI], shape (rows, 3).
        stated: priors in place of the fields', see `priors.coordinates`.
        replicates: of each bootstrap; seed: of everything random.
        numbers: of the rows, as messages call them; None counts from 1.
        progress: called with a sentence as the work goes on.
    """

    def __init__(
        self,
        engine: Engine,
        runs: Runs,
        sd: np.ndarray,
        *,
        stated: dict[str, tuple[float, float]] | None = None,
        replicates: int = 500,
        seed: int = 0,
        numbers: np.ndarray | None = None,
        progress: Callable[[str], None] = lambda text: None,
    ) -> None:
        self.engine, self.runs, self.replicates, self.seed, self.progress = engine, runs, replicates, seed, progress
        whole, there = padded(runs, 1 if engine.series else PAD)
        sd = np.concatenate([sd, np.repeat(sd[:1], len(there) - len(runs), 0)])
        self.counts = there.copy()  # rows that count; changes as outliers are set aside
        names = free_names(runs["configuration"], engine.series)
        coordinates = priors.coordinates(engine.base, names, stated)
        self.problem = build(whole, engine.base, coordinates, sd, "drive" if engine.series else "steady")
        self.coordinates = slots.slots(coordinates, engine.effects, engine.size)
        self.numbers = np.arange(1, len(runs) + 1) if numbers is None else numbers
        self.unusable: tuple[int, ...] = ()
        self.outliers: tuple[int, ...] = ()
        self._looked: tuple | None = None  # the last look: outliers and the gate ask for the same

    # --- fits ---------------------------------------------------------------------------------------

    @property
    def alpha(self) -> dict[str, float]:
        """Share of the family-wise error of each kind of evidence."""
        return ALPHA_SERIES if self.engine.series else ALPHA

    @property
    def weight(self) -> np.ndarray:
        """1 for readings that count, shape (rows, 3)."""
        return np.repeat(self.counts[:, None].astype(float), 3, 1)

    def _weighted(self, problem: Problem) -> Problem:
        centre = jnp.zeros(len(problem.coordinates))
        data = dataclasses.replace(problem.data, weight=jnp.asarray(self.weight), centre=centre)
        return dataclasses.replace(problem, data=data)

    @property
    def slotted(self) -> Problem:
        """The problem with slots for effects, all empty."""
        problem = dataclasses.replace(self.problem, base=self.engine.equipped, coordinates=self.coordinates)
        return self._weighted(problem)

    def base_fit(self) -> Hypothesis:
        """The base fitted alone, from the prior mean and from draws of the prior; the best that was found.

        Rows that it cannot reach at all are kept out, and it is fitted again.
        """
        empty = (-1,) * self.engine.size
        while True:
            found, seen = self._searches_series() if self.engine.series else self._searches()
            k = int(np.argmin(np.where(np.isfinite(found.cost), found.cost, np.inf)))
            lost = self.problem.unreachable(seen.status[k]) & self.counts
            if not lost.any():
                best = jax.tree.map(lambda x: x[k], found)  # noqa: B023
                return dataclasses.replace(self._hypothesis(empty, best), reading=seen.reading[k])
            self._set_aside(lost)

    def _searches(self) -> tuple[fit.Optimum, Observation]:
        """Where searches of the base end, from the prior mean and from draws of the prior, and what it says there."""
        p, empty, batch = len(self.coordinates.base), (-1,) * self.engine.size, self.engine.batch
        starts = np.zeros((batch, len(self.coordinates)))
        starts[1:, :p] = np.random.default_rng(self.seed).standard_normal((batch - 1, p))
        return self._batch([empty] * batch, starts, [self.weight] * batch)

    def _searches_series(self) -> tuple[fit.Optimum, Observation]:
        """As `_searches`, of histories: without slots, and from the best of many draws."""
        bare, p = self._weighted(self.problem), len(self.coordinates.base)
        draws = np.random.default_rng(self.seed).standard_normal((DRAWS, p))
        order = np.argsort(np.asarray(self.engine.costs(bare, jnp.asarray(draws))))
        starts = np.concatenate([np.zeros((1, p)), draws[order[: SEARCHES - 1]]])
        weights, none = jnp.repeat(bare.data.weight[None], SEARCHES, 0), jnp.zeros((SEARCHES, 0))
        found, seen = jax.device_get(self.engine.fits(bare, none, jnp.asarray(starts), weights, rivals=True))
        empty = np.zeros((SEARCHES, 2 * self.engine.size))
        z, sd = (np.concatenate(x, 1) for x in ((found.z, empty), (found.sd, empty + 1.0)))
        return dataclasses.replace(found, z=z, sd=sd), seen

    def _set_aside(self, lost: np.ndarray) -> None:
        self.unusable = tuple(sorted({*self.unusable, *map(int, np.flatnonzero(lost))}))
        self.counts = self.counts & ~lost
        if self.counts.sum() < 4:
            rows = ", ".join(str(self.numbers[k]) for k in self.unusable[:12])
            raise BadData(f"{self.runs.source}: the model reaches too few rows to trace anything (not rows {rows})")

    def _batch(self, which: Sequence, starts: Sequence, weights: Sequence) -> tuple[fit.Optimum, Observation]:
        parts = [jnp.asarray(np.stack([np.asarray(x) for x in xs])) for xs in (which, starts, weights)]
        return jax.device_get(self.engine.fits(self.slotted, *parts))

    def fit_all(
        self, proposals: Sequence[tuple[tuple[int, ...], np.ndarray]], weights: Sequence[np.ndarray] | None = None
    ) -> list[Hypothesis]:
        """Fit every (which, start), in batches of one size."""
        found, batch = [], self.engine.batch
        for first in range(0, len(proposals), batch):
            part = list(proposals[first : first + batch])
            fill = part + [part[0]] * (batch - len(part))
            best, _ = self._batch([w for w, _ in fill], [z for _, z in fill], [self.weight] * batch)
            found += [self._hypothesis(w, jax.tree.map(lambda x: x[k], best)) for k, (w, _) in enumerate(part)]  # noqa: B023
        return found

    def held_out(self, h: Hypothesis, blocks: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Readings of each block's rows by the fit of `h` that has not seen them, and how often it converged.

        Args:
            blocks: masks of rows, shape (rows of the table,) each.

        Returns:
            Readings [SI], NaN where no block holds the row or the fit cannot reach it, shape (rows, 3); and
            which blocks' fits converged.
        """
        rows, batch = len(self.runs), self.engine.batch
        reading, converged = np.full((rows, 3), np.nan), []
        for first in range(0, len(blocks), batch):
            part = list(blocks[first : first + batch])
            fill = part + [part[0]] * (batch - len(part))
            out = [np.concatenate([m, np.zeros(len(self.counts) - rows, bool)]) for m in fill]
            best, seen = self._batch([h.which] * batch, [h.z] * batch, [self.weight * ~m[:, None] for m in out])
            converged += list(best.converged[: len(part)])
            for k, mask in enumerate(part):
                lost = self.problem.unreachable(seen.status[k])[:rows, None]
                reading[mask] = np.where(lost, np.nan, seen.reading[k][:rows])[mask]
        return reading, np.asarray(converged)

    def _hypothesis(self, which: tuple[int, ...], best: fit.Optimum) -> Hypothesis:
        amplitude = slots.WIDE * self.coordinates.parts(best.z)[1]
        spread = slots.WIDE * self.coordinates.parts(best.sd)[1]
        amplitude = np.where(np.asarray(which) >= 0, amplitude, 0.0)
        ok = all(self._plausible(k, a, s) for k, a, s in zip(which, amplitude, spread, strict=True) if k >= 0)
        cost = float(best.cost) if np.isfinite(best.cost) else np.inf
        return Hypothesis(which, best.z, best.sd, cost, amplitude, ok, bool(best.converged))

    def _plausible(self, k: int, amplitude: float, sd: float) -> bool:
        effect = self.engine.effects[k]
        spec = amplitude_of(effect).spec
        value = amplitude * spec.prior_sd(0.0)
        if not (spec.bounds[0] < value < spec.bounds[1] and abs(amplitude) < slots.PLAUSIBLE):
            return False
        return not (effect.dissipative and amplitude < -2 * sd)

    def start(self, from_: Hypothesis, which: tuple[int, ...], scores: Scores | None = None) -> np.ndarray:
        """Where to start a fit of `which`: at another fit, new effects at what their score says."""
        p, s = len(self.coordinates.base), self.engine.size
        z = np.zeros(p + 2 * s)
        z[:p] = from_.z[:p]
        for slot, k in enumerate(which):
            if k >= 0 and k in from_.which:
                old = from_.which.index(k)
                z[p + slot], z[p + s + slot] = from_.z[p + old], from_.z[p + s + old]
            elif k >= 0 and scores is not None:
                m = self._best_instance(scores, k)
                z[p + slot] = np.clip(float(scores.amplitude[m]) / slots.WIDE, -1.5, 1.5)
                z[p + s + slot] = self.engine.at[m]
        return z

    def _best_instance(self, scores: Scores, k: int) -> int:
        mine = np.flatnonzero(self.engine.of == k)
        return int(mine[np.argmax(np.abs(np.asarray(scores.single)[mine]))])

    # --- looks --------------------------------------------------------------------------------------

    def problem_of(self, h: Hypothesis) -> Problem:
        """The problem in which a hypothesis was fitted."""
        problem = self.slotted
        return dataclasses.replace(problem, coordinates=problem.coordinates.with_effects(h.which))

    def look(self, h: Hypothesis, curves: tuple[Curves, ...]) -> tuple[Linear, Scores, Summary]:
        """A fit linearised, and what candidates could explain of its residual."""
        key = (h.which, np.asarray(h.z).tobytes(), self.counts.tobytes(), curve_room.names(curves))
        if self._looked is None or self._looked[0] != key:
            problem = self.problem_of(h)
            seen = self.engine.tracer.look(problem, jnp.asarray(h.z), problem.data, curves)  # type: ignore[attr-defined]
            self._looked = key, jax.device_get(seen)
        return self._looked[1]

    def null(self, h: Hypothesis, curves: tuple[Curves, ...]) -> Summary:
        """Bootstrap of the base fit: the strongest statistics of tables in which nothing is missing."""
        if self.engine.series:
            linear, data = self.look(h, curves)[0], self.problem_of(h).data
            one = lambda keys: self.engine.tracer.null_linear(linear, data, curves, keys)  # type: ignore[attr-defined]  # noqa: E731
        else:
            problem, z = self._weighted(self.problem), jnp.asarray(h.z[: len(self.coordinates.base)])
            one = lambda keys: self.engine.tracer.null(problem, z, problem.data, curves, keys)  # type: ignore[attr-defined]  # noqa: E731
        return trace.bootstrap(one, self.replicates, self.seed)

    def gate(self, h: Hypothesis, curves: tuple[Curves, ...], null: Summary) -> Round:
        """Look at a fit, and test what it leaves."""
        linear, scores, found = self.look(h, curves)
        return Round(h, linear, scores, Gate(found, null, self.alpha))

    def round_of(self, problem: Problem, z: np.ndarray, like: Round) -> Round:
        """A look at the fit of another problem of the same table, against the thresholds of a round."""
        seen = self.engine.tracer.look(problem, jnp.asarray(z), problem.data, self.curves)  # type: ignore[attr-defined]
        linear, scores, found = jax.device_get(seen)
        return dataclasses.replace(like, linear=linear, scores=scores, gate=Gate(found, like.gate.null, self.alpha))

    # --- the loop -----------------------------------------------------------------------------------

    def run(self) -> Finding:
        """The whole loop."""
        self.progress("fitting the base model")
        h0 = self._outliers(self.base_fit())
        self.curves = curves = self._curves(h0)
        self.progress(f"bootstrap of {self.replicates} tables: what would a complete model leave?")
        null = self.null(h0, curves)
        base = self.gate(h0, curves, null)
        if not base.gate.open:
            return self._finding("none", base, (base,), ())
        self.progress("something is missing: fitting every effect that could explain it")
        ladder = self._singles(base)
        rounds, best = [base], self._best(ladder)
        while best is not None:
            rounds.append(self.gate(best, curves, null))
            if not rounds[-1].gate.clear or len(best.effects) == self._most():
                break
            self.progress(f"{self._said(best)} leaves something: fitting further effects beside it")
            more = self._extend(best, rounds[-1].scores, base, ladder)
            best = self._accepted(self._best(more), ladder)
            ladder += more
        after = rounds[-1]
        foreign = after is base or self._beside_the_point(base, after)
        if foreign or (after.gate.clear and self._one_curve(base, curves)):
            unnamed = self._locate(base.scores, curves)
            return self._finding("unnamed", base, tuple(rounds), tuple(ladder), unnamed=unnamed)
        best = after.hypothesis
        self.progress(f"what else explains as much as {self._said(best)}?")
        classes = self._classes(best, ladder, base)
        verdict = "named" if all(len(c) == 1 for c in classes) else "class"
        remains = self._locate(after.scores, curves) if after.gate.clear else None
        return self._finding(verdict, after, tuple(rounds), tuple(ladder), classes, remains)

    def _beside_the_point(self, base: Round, after: Round) -> bool:
        """Whether the effects leave far more than noise, and explain less than half of what was there."""
        readings = 3 * int(self.counts.sum())  # what χ² is without anything missing, priors included
        there, left = (2 * r.hypothesis.cost - readings for r in (base, after))
        return bool(left > 2 * np.sqrt(2 * readings) and there - left < 0.5 * there)

    def _one_curve(self, base: Round, curves: tuple[Curves, ...]) -> bool:
        """Whether one smooth curve in one balance would leave nothing that is beyond doubt."""
        k = int(np.argmax(self._said_by(base.scores)))
        gate = Gate(trace.beside_curve(base.linear, curves, k), base.gate.null, base.gate.alpha)
        return not gate.clear

    def _finding(
        self,
        verdict: str,
        after: Round,
        rounds: tuple,
        ladder: tuple,
        classes: tuple = (),
        unnamed: tuple | None = None,
    ) -> Finding:
        invisible = self._invisible(rounds[0].scores)
        return Finding(
            verdict, rounds[0], after, classes, ladder, unnamed, rounds, self.outliers, self.unusable, invisible
        )

    def _curves(self, h: Hypothesis) -> tuple[Curves, ...]:
        # Of fitted readings: a curve over measured ones would share their noise.
        columns = dict(padded(self.runs, 1 if self.engine.series else PAD)[0].columns)
        reading = np.where(np.isfinite(h.reading), h.reading, np.asarray(self.problem.data.measured))  # type: ignore[arg-type]
        columns |= dict(zip(MEASURED, reading.T, strict=True))
        found = curve_room.families(columns, self.counts.astype(float))
        if not self.engine.series:
            return found
        observe = self.problem.observe
        angle = self.engine.angle(self.problem, jnp.asarray(h.z[: len(self.coordinates.base)]))
        return (
            *found,
            *curve_room.waves(columns, np.nan_to_num(angle), *map(np.asarray, (observe.rows, observe.knots))),
        )

    def _said(self, h: Hypothesis) -> str:
        return " and ".join(self.engine.names[k] for k in h.effects)

    def _most(self) -> int:
        """Effects that the data allow: one for every five rows, and no more than there are slots."""
        return int(min(self.engine.size, max(1, self.counts.sum() // 5)))

    def _invisible(self, scores: Scores) -> tuple[int, ...]:
        """Effects of which the largest plausible amplitude leaves less than three sigmas."""
        left = np.array([np.asarray(scores.left)[self.engine.of == k].max() for k in range(len(self.engine.names))])
        return tuple(int(k) for k in np.flatnonzero(slots.PLAUSIBLE * left < 3.0))

    def _gross(self, h: Hypothesis) -> Hypothesis:
        """Set aside rows that lie so far off that they bend the fit, and with it every score.

        They are looked for at a robust fit: Cauchy's weights, iterated (Holland and Welsch 1977).
        """
        sd, measured = (np.asarray(x) for x in (self.problem.data.sd, self.problem.data.measured))

        def off(reading: np.ndarray) -> np.ndarray:
            return np.abs((reading - measured) / sd).max(1)

        far, start = off(h.reading), h.z
        if far[self.counts].max() < GROSS:
            return h
        for _ in range(ROBUST):
            weight = self.weight / np.sqrt(1 + (far / CAUCHY) ** 2)[:, None]
            batch = self.engine.batch
            found, seen = self._batch([h.which] * batch, [start] * batch, [weight] * batch)
            far, start = off(seen.reading[0]), found.z[0]
        gross = self.counts & (far > GROSS * max(1.0, float(np.median(far[self.counts]))))
        if not gross.any() or gross.sum() > OUTLIERS * self.counts.sum():
            return h
        self.outliers = tuple(map(int, np.flatnonzero(gross)))
        self.counts = self.counts & ~gross
        return self.base_fit()

    def _outliers(self, h: Hypothesis) -> Hypothesis:
        """Set aside rows with a reading that stands alone: its own shift explains more than any effect or curve."""
        allowed = int(OUTLIERS * self.counts.sum())
        h = self._gross(h)
        level = stats.norm.isf(ALPHA_OUTLIER / 2 / (3 * self.counts.sum()))
        while len(self.outliers) < allowed:
            families = self._curves(h)
            _, scores, _ = self.look(h, families)
            alone = (np.abs(np.asarray(scores.row)) * self.counts[:, None]).max(1)
            k = int(alone.argmax())
            curves = np.asarray(scores.explained)[[n[1] not in curve_room.ORDERS for n in curve_room.names(families)]]
            together = max(np.max(np.asarray(scores.single) ** 2), np.max(curves))
            if alone[k] < level or alone[k] ** 2 < together:
                break
            # A fit to histories takes too long to go on sample by sample.
            far = np.argsort(-alone)[: allowed - len(self.outliers)] if self.engine.series else np.array([k])
            far = far[(alone[far] >= level) & (alone[far] ** 2 >= together)]
            self.outliers = (*self.outliers, *map(int, far))
            self.counts = self.counts & ~np.isin(np.arange(len(self.counts)), far)
            h = self.base_fit()
        return h

    def _singles(self, base: Round) -> list[Hypothesis]:
        scores = np.abs(np.asarray(base.scores.single))
        by_effect = np.array([scores[self.engine.of == k].max() for k in range(len(self.engine.names))])
        order = [int(k) for k in np.argsort(-by_effect)[: self.engine.batch]]
        empty = (-1,) * (self.engine.size - 1)
        proposals = [((k, *empty), self.start(base.hypothesis, (k, *empty), base.scores)) for k in order]
        return self.fit_all(proposals)

    def _extend(self, best: Hypothesis, scores: Scores, base: Round, ladder: list[Hypothesis]) -> list[Hypothesis]:
        """One effect more: beside the best, or in the place of one of its effects, and pairs from the base."""
        count = len(best.effects) + 1
        empty = (-1,) * (self.engine.size - count)
        single = np.abs(np.asarray(scores.single))
        by_effect = np.array([single[self.engine.of == k].max() for k in range(len(self.engine.names))])
        by_effect[list(best.effects)] = 0.0
        wanted = [(*best.effects, int(k), *empty) for k in np.argsort(-by_effect)[: self.engine.batch]]
        sources = {w: (best, scores) for w in wanted}
        if count == 2:
            pair = np.triu(np.asarray(base.scores.pair))
            seen: list[tuple[int, ...]] = []
            for flat in np.argsort(-pair, axis=None)[:4000]:
                i, j = np.unravel_index(flat, pair.shape)
                w = tuple(sorted((int(self.engine.of[i]), int(self.engine.of[j]))))
                if w[0] != w[1] and w not in seen:
                    seen.append(w)
                if len(seen) == self.engine.batch:
                    break
            for w in seen:
                full = (*w, *empty)
                if full not in sources and (w[1], w[0], *empty) not in sources:
                    sources[full] = (base.hypothesis, base.scores)
        return self.fit_all([(w, self.start(h, w, s)) for w, (h, s) in sources.items()])

    def _best(self, hypotheses: Sequence[Hypothesis]) -> Hypothesis | None:
        there = [h for h in hypotheses if h.plausible and np.isfinite(h.cost)]
        return min(there, key=lambda h: h.cost) if there else None

    def _accepted(self, h: Hypothesis | None, ladder: Sequence[Hypothesis]) -> Hypothesis | None:
        """`h`, if it explains so much more than any one effect fewer does that every one of its effects is needed."""
        if h is None:
            return None
        fewer = [x.cost for x in ladder if len(x.effects) == len(h.effects) - 1 and x.plausible]
        return h if 2 * (min(fewer, default=np.inf) - h.cost) >= BOTH**2 else None

    def _classes(self, best: Hypothesis, ladder: list[Hypothesis], base: Round) -> tuple[tuple[int, ...], ...]:
        """For each effect of the best fit, the effects that explain the data as well in its place."""
        cosine = self.cosines(base)
        wanted = []
        for slot, k in enumerate(best.effects):
            for j in np.argsort(-cosine[k])[:BATCH]:
                if cosine[k, j] > 0.5 and j not in best.effects:
                    which = list(best.which)
                    which[slot] = int(j)
                    wanted.append((slot, tuple(which)))
        known = {tuple(sorted(h.which)): h for h in ladder}
        new = [w for _, w in wanted if tuple(sorted(w)) not in known]
        fitted = self.fit_all([(w, self.start(best, w, base.scores)) for w in new]) if new else []
        ladder += fitted
        known |= {tuple(sorted(h.which)): h for h in fitted}
        classes = []
        for slot, k in enumerate(best.effects):
            same = [k]
            for s, which in wanted:
                other = known[tuple(sorted(which))]
                rise = 2 * (other.cost - best.cost)
                j = which[slot]
                limit = SAME_PARALLEL if cosine[k, j] > PARALLEL else SAME
                if s == slot and other.plausible and rise <= limit:
                    same.append(j)
            classes.append(tuple(same))
        return tuple(classes)

    def cosines(self, base: Round) -> np.ndarray:
        """Largest |cos| between what the base leaves of two effects' signatures, over their shapes."""
        cosine = np.abs(np.asarray(base.scores.cosine))
        count = len(self.engine.names)
        whole = np.zeros((count, count))
        np.maximum.at(whole, (self.engine.of[:, None], self.engine.of[None, :]), cosine)
        return whole

    def _said_by(self, scores: Scores) -> np.ndarray:
        """By what curves are compared: what they explain, or where they have different numbers of terms (waves have
        two a run) how improbable that is."""
        return np.asarray(scores.curve if self.engine.series else scores.explained)

    def _locate(self, scores: Scores, curves: tuple[Curves, ...]) -> tuple[str, str, tuple[str, ...]]:
        """Balance and variable of the curve that explains most, and the balances in which one explains as much, or
        would if it had curves of its own."""
        names = curve_room.names(curves)
        deviate, said = np.asarray(scores.curve), self._said_by(scores)
        k = int(deviate.argmax())
        variable = max(
            (j for j, n in enumerate(names) if n[0] == names[k][0] and n[1] != curve_room.CONDITIONS),
            key=lambda j: said[j],
        )
        best = {b: max(deviate[j] for j, n in enumerate(names) if n[0] == b) for b in curve_room.BALANCES}
        alike = [(b, *curve_room.STANDS_FOR.get(b, ())) for b, d in best.items() if d > deviate[k] - 1.0]
        return names[k][0], names[variable][1], tuple(itertools.chain(*alike))
