"""The protocol of observers."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Protocol

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from calibration.data.runs import Runs
from calibration.inference.bases import Bases
from calibration.inference.details import Detail
from calibration.inference.fit_notes import Note
from calibration.inference.linearization import Linearization, ScoredEffect
from calibration.inference.noise import Noise
from calibration.inference.optimizers import Numbers, Optimum, linearised, read
from calibration.inference.problem import Data, Observation, Problem
from mmrjax.effects import Effect
from mmrjax.model.conditions import Conditions
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals


@dataclasses.dataclass(frozen=True)
class SearchPolicy:
    """How fits of one kind of data are searched for in batches.

    Attributes:
        batch: fits in one batch.
        steps: most steps of one.
        searches: of the base.
        one_by_one: whether outliers are set aside one at a time, with a fit after each.
    """

    batch: int = 16
    steps: int = 60
    searches: int = 16
    one_by_one: bool = True


class CurveScores(Protocol):
    """Scores of the curves that a fit leaves: as normal deviates, and what each explains [σ²]; shape (families,)."""

    @property
    def curve(self) -> Array: ...

    @property
    def explained(self) -> Array: ...


class Statistics(Protocol):
    """Strongest statistics of a fit; `white` measures the memory of its residuals."""

    @property
    def white(self) -> Any: ...


class AdequacyTest(Protocol):
    """Test of whether a fit leaves something, by kind of statistic."""

    @property
    def found(self) -> Statistics: ...

    def p(self, kind: str) -> float: ...

    def threshold(self, kind: str) -> float: ...


class Diagnosis(Protocol):
    """What an observer reads of a fit and of what it leaves, see `discovery.adequacy.Diagnosis`."""

    @property
    def linear(self) -> Linearization: ...

    @property
    def scores(self) -> CurveScores: ...

    @property
    def test(self) -> AdequacyTest: ...


class Observer(eqx.Module):
    """What runs show, and what inference has to know of their kind.

    Attributes:
        conditions: of each run, shape (runs,); of a history what changes within one at each of its instants.
        word: what a row is; fewest: rows in which a missing effect can be told from noise.
        axis: column of a table along which the rows of a run follow one another; empty where a run is one row.
        sizes_padded: numbers of rows to which tables are padded, so that those of about one size share what is
            compiled; beyond the last to a multiple of that, and with none not at all.
        blocks: kinds of blocks to hold out, the most telling first.
        policy: how fits are searched for.
        rows_tell: whether a single row shows a defect by itself.
        evidence: kinds of evidence that something is missing.
        library: effects that such data show beside the library's.
        menu: whether the menu of experiments is of runs of this kind.
        searches: of a calibration; None takes the fidelity's; profiled: whether its parameters are profiled too,
            where the fidelity's are.
    """

    conditions: eqx.AbstractVar[Conditions]

    word: ClassVar[str]
    fewest: ClassVar[int]
    axis: ClassVar[str] = ""
    sizes_padded: ClassVar[tuple[int, ...]] = ()
    blocks: ClassVar[tuple[str, ...]]
    policy: ClassVar[SearchPolicy]
    rows_tell: ClassVar[bool]
    evidence: ClassVar[tuple[str, ...]]
    library: ClassVar[Mapping[str, type[Effect]]] = {}
    menu: ClassVar[bool] = True
    searches: ClassVar[int | None] = None
    profiled: ClassVar[bool] = True

    # --- of a table, before anything is simulated

    @classmethod
    def axes_of(cls, runs: Runs) -> tuple[str, ...]:
        """Columns of a table over which its readings vary."""
        return (*runs.axes, *([cls.axis] if cls.axis else []))

    @classmethod
    @abc.abstractmethod
    def observes(cls, runs: Runs) -> bool:
        """Whether a table is of this kind."""

    @classmethod
    @abc.abstractmethod
    def of(cls, runs: Runs, robot: Robot, fidelity: str | None = None) -> Observer:
        """The observer of a table; see `observers.pose`."""

    @classmethod
    @abc.abstractmethod
    def sizes(cls, runs: Runs) -> np.ndarray:
        """What a share of noise is of [SI], shape (rows, channels)."""

    @classmethod
    @abc.abstractmethod
    def check(cls, runs: Runs, noise: Noise) -> list[Note | str]:
        """Refuse runs that contradict themselves; return what should be said of them.

        Raises:
            BadData: readings that cannot all be true.
        """

    @classmethod
    @abc.abstractmethod
    def check_start(cls, runs: Runs, noise: Noise, robot: Robot) -> list[Note | str]:
        """Refuse runs whose beginning the model cannot follow; return what should be said of their length.

        Raises:
            BadData: a run that does not begin as the model does.
        """

    @classmethod
    def with_initial_states(cls, robot: Robot, runs: Runs, noise: Noise) -> Robot:
        """`robot` with the beginnings of runs that do not begin at rest; as it is where runs are settled."""
        return robot

    @classmethod
    @abc.abstractmethod
    def check_settled(cls, runs: Runs) -> None:
        """Refuse runs that are not one settled row each.

        Raises:
            BadData: time histories.
        """

    @classmethod
    @abc.abstractmethod
    def settled(cls, runs: Runs, steady: bool = False) -> tuple[Runs, np.ndarray, np.ndarray]:
        """One row a run, what it shows in the end [SI], shape (runs, channels), and how long it lasts [s].

        Args:
            steady: whether runs are left out whose speed still changes as it does below half of steady travel.
        """

    @classmethod
    @abc.abstractmethod
    def identity(cls, runs: Runs) -> tuple[str, ...]:
        """Columns in which exact copies of a row agree."""

    @classmethod
    @abc.abstractmethod
    def shows(cls, effect: type[Effect]) -> bool:
        """Whether data of this kind on an external supply can show an effect."""

    @classmethod
    @abc.abstractmethod
    def free(cls) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Parameters that such data determine beside those that all do: of the drive, and of each chassis."""

    # --- of robots

    @abc.abstractmethod
    def __call__(self, robot: Robot) -> Observation:
        """What a robot shows in every row."""

    def solve(self, robot: Robot) -> tuple[Array, Array] | None:
        """Where what rows show is a root: the unknowns of each, shape (rows, unknowns), and which were found."""
        return None

    @property
    def apart(self) -> bool:
        """True if `solve` takes much longer to compile than `shown`, so that it is a program of its own."""
        return False

    def read(self, robot: Robot) -> Observation:
        """Returns what a robot shows in every row, of an observer whose `apart` is true."""
        raise NotImplementedError

    def shown(self, robot: Robot, unknowns: Array, found: Array) -> tuple[Observation, Signals, Array]:
        """What a robot shows in every row at such unknowns, its signals, and what its equations leave there, shape
        (rows, unknowns)."""
        raise NotImplementedError

    def operating(self, robot: Robot) -> Signals | None:
        """Signals of a robot at every row's operating point; None where rows have none."""
        return None

    @property
    @abc.abstractmethod
    def long(self) -> bool:
        """Whether the model is a rollout: searches then run one by one, and end sooner."""

    @property
    @abc.abstractmethod
    def eased(self) -> bool:
        """Whether a search may begin at the optimum of the same problem with `steady`."""

    @abc.abstractmethod
    def unreachable(self, status: np.ndarray) -> np.ndarray:
        """Whether the model has no such operating point, by row."""

    @property
    def driven(self) -> Conditions:
        """Under what conditions the robot was driven, as if forwards; shape (cases,)."""
        return self.conditions

    def cautions(self, robot: Robot) -> list[str]:
        """What to know before the readings of a calibrated robot are trusted, as sentences."""
        return []

    @abc.abstractmethod
    def runs_counting(self, included: np.ndarray) -> int:
        """How many runs count, of rows that do."""

    def noise_misfit(self, off: Callable[[], np.ndarray], counts: Bool[np.ndarray, "rows channels"]) -> float:
        """χ² that noise alone leaves: of settled runs, whose rows tell nothing of one another, one for each reading.

        Args:
            off: returns the whitened residuals of a fit, shape (rows, channels); counts: True for readings that do.
        """
        return float(counts.sum())

    # --- of fits

    @abc.abstractmethod
    def linearise(self, problem: Problem, z: Array, data: Data, effects: tuple[ScoredEffect, ...]) -> Linearization:
        """Residuals, Jacobian and signatures at z."""

    def at_fit(self, problem: Problem, z: Numbers) -> Observer:
        """The same with what a fit of a problem has found out about its runs."""
        return self

    def draws(self, problem: Problem, z: Array, linear: Linearization, keys: Array, factors: np.ndarray) -> Any:
        """What replicates of the bootstrap begin with, leading axis the keys: the keys, or fits of tables drawn.

        Args:
            problem: of the base alone, at its fit z; linear: the same fit, linearised.
            keys: random, as numbers, shape (replicates, words).
            factors: on the sds of each replicate, shape (replicates, channels).
        """
        return keys

    @abc.abstractmethod
    def replicate(
        self, problem: Problem, data: Data, effects: tuple[ScoredEffect, ...], linear: Linearization, drawn: Any
    ) -> Linearization:
        """A table drawn from the fit of the base, fitted again and linearised: one replicate of the bootstrap.

        Args:
            problem: of the base alone; data: of the table; linear: the fit, linearised.
            drawn: one of `draws`.
        """

    def starts(self, problem: Problem, random: np.random.Generator, count: int) -> Float[np.ndarray, "starts z"]:
        """Coordinates at which at most `count` searches of a base begin: the prior mean, and draws of the prior.

        Args:
            problem: without effects in its coordinates.
        """
        size = len(problem.coordinates)
        return np.concatenate([np.zeros((1, size)), random.standard_normal((max(count, 1) - 1, size))])

    def scanned(self, problem: Problem) -> tuple[int, ...]:
        """Coordinates whose misfit is looked at over their prior's range, see `scans`: none where the searches of a
        kind of data begin at so many draws of the prior that they see every basin."""
        return ()

    def scan_points(self, problem: Problem, k: int) -> int:
        """At how many values a coordinate is looked at, a multiple of `scans.CLOSER`."""
        raise NotImplementedError

    def scan(self, problem: Problem, z: Array, data: Data, k: int, values: Array) -> tuple[Array, Array]:
        """Objective where coordinate k has each of `values` and the others have moved from z to where their
        linearisation has its minimum, shape (values,), and all coordinates then, (values, coordinates)."""
        raise NotImplementedError

    def places(self, problem: Problem) -> int:
        """Searches of a problem side by side on a core, by `searches_refilled`."""
        raise NotImplementedError

    @abc.abstractmethod
    def search(
        self,
        problem: Problem,
        starts: Numbers,
        weights: Numbers,
        active: Numbers | None = None,
        *,
        rivals: bool = False,
        most: int | None = None,
    ) -> tuple[Optimum, Observation]:
        """Any number of fits, each to its own weights, and what each says of every row.

        Args:
            starts: shape (members, coordinates); weights: of each member's readings, (members, rows, channels).
            active: set of effects of each member, see `ActiveSet`; None leaves the problem's.
            rivals: whether all search the same optimum, so that some may be given up.
            most: steps of each; None: those of the policy.
        """

    def observed(self, problem: Problem, z: Numbers, active: Numbers | None = None) -> Observation:
        """What the model says of every row at z.

        Args:
            active: its effects, of a problem with slots.
        """
        if not self.long:
            return self.at(problem, z, active)[2]
        problem = _with_effects(problem, active)
        return read(problem, problem.robot(jnp.asarray(z)))

    def at(self, problem: Problem, z: Numbers, active: Numbers | None = None) -> tuple[Numbers, Numbers, Observation]:
        """Residuals, their Jacobian and what the model says of every row at z; arguments as of `observed`."""
        return linearised(_with_effects(problem, active), jnp.asarray(z), problem.data)

    @abc.abstractmethod
    def bases(self, columns: Mapping[str, np.ndarray], included: Bool[np.ndarray, " rows"], robot: Robot) -> Bases:
        """Bases of the curves that a discrepancy is looked for with.

        Args:
            columns: of the padded table, with fitted readings; robot: fitted.
        """

    @abc.abstractmethod
    def detail(self, bases: Bases, included: np.ndarray, before: Diagnosis, after: Diagnosis) -> Detail:
        """What data of this kind tell beside the fit.

        Args:
            bases: of curves; included: whether a row of the table counts.
            before, after: what base and proposed robot leave.
        """


def _with_effects(problem: Problem, active: Numbers | None) -> Problem:
    if active is None:
        return problem
    return dataclasses.replace(problem, coordinates=problem.coordinates.with_effects(jnp.asarray(active)))
