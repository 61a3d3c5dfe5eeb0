"""Interface of observers: readings of one kind of runs, and properties of that kind that inference needs."""

from __future__ import annotations

import abc
import dataclasses
import threading
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from calibration.data import Columns, Names
from calibration.data.runs import Runs
from calibration.inference.bases import Bases
from calibration.inference.details import Detail
from calibration.inference.fit_notes import Remark
from calibration.inference.linearization import Linearization, ScoredEffect
from calibration.inference.noise import Noise
from calibration.inference.optimizers import (
    CORES,
    Evaluate,
    Numbers,
    Optimum,
    linearise,
    observe_robot,
    search_rollouts,
)
from calibration.inference.problem import Observation, Problem
from mmrjax.compile.compiling import Threads
from mmrjax.effects import Effect
from mmrjax.model.conditions import Conditions
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals
from mmrjax.numerics.linear_equations import solve


@dataclasses.dataclass(frozen=True)
class SearchPolicy:
    """Options of batched fits for one kind of data.

    Attributes:
        batch: number of fits in one batch.
        steps: largest number of steps of a fit.
        searches: number of searches of the base.
        one_by_one: True if outliers are removed one at a time, with a refit after each.
    """

    batch: int = 16
    steps: int = 60
    searches: int = 16
    one_by_one: bool = True


class Observer(eqx.Module):
    """Readings of one kind of runs, and the properties of that kind that inference needs.

    Attributes:
        conditions: conditions of each run, shape (runs,). Conditions that change within a history have a value at
            each instant.
        word: noun for a row in messages.
        fewest: smallest number of rows that can separate a missing effect from noise.
        axis: column that orders the rows of a run, empty if each run is one row.
        sizes_padded: numbers of rows to which tables are padded, so that those of similar size share compiled
            programs. Larger tables are padded to a multiple of the last one. Empty for no padding.
        blocks: kinds of block to hold out, the most informative first.
        policy: options of batched fits.
        one_row_reveals: True if one row alone can reveal a missing effect.
        evidence: kinds of evidence for a missing effect.
        library: effects that only such data can reveal, in addition to the library.
        menu: True if the menu of experiments has runs of this kind.
        searches: number of starts of a calibration. None: the default of the fidelity.
        reads: True if the rows are readings of channels, False if they are errors of equations.
        profiled: False if parameters are never profiled for this kind, whatever the fidelity states.
    """

    conditions: eqx.AbstractVar[Conditions]

    word: ClassVar[str]
    fewest: ClassVar[int]
    axis: ClassVar[str] = ""
    sizes_padded: ClassVar[tuple[int, ...]] = ()
    blocks: ClassVar[Names]
    policy: ClassVar[SearchPolicy]
    one_row_reveals: ClassVar[bool]
    evidence: ClassVar[Names]
    library: ClassVar[Mapping[str, type[Effect]]] = {}
    menu: ClassVar[bool] = True
    searches: ClassVar[int | None] = None
    profiled: ClassVar[bool] = True
    reads: ClassVar[bool] = True

    # --- of a table, before anything is simulated

    @classmethod
    def axes_of(cls, runs: Runs) -> Names:
        """Columns of a table with which its readings vary."""
        return (*runs.axes, *([cls.axis] if cls.axis else []))

    @classmethod
    def padded_rows(cls, rows: int) -> tuple[Int[np.ndarray, " padded"], Bool[np.ndarray, " padded"]]:
        """Row indices, padded by repeating the first row, see `sizes_padded`. Also True for each without padding."""
        sizes = cls.sizes_padded
        size = next((s for s in sizes if s >= rows), rows + (-rows % sizes[-1] if sizes else 0))
        index = np.pad(np.arange(rows), (0, size - rows))
        return index, np.arange(size) < rows

    @classmethod
    @abc.abstractmethod
    def accepts_table(cls, runs: Runs) -> bool:
        """True if a table is of this kind."""

    @classmethod
    @abc.abstractmethod
    def of(cls, runs: Runs, robot: Robot, fidelity: str | None = None) -> Observer:
        """Creates the observer of a table. Arguments as in `observers.pose_problem`."""

    @classmethod
    @abc.abstractmethod
    def sizes(cls, runs: Runs) -> np.ndarray:
        """Reference size of each reading [SI] for noise stated as a share, shape (rows, channels)."""

    @classmethod
    @abc.abstractmethod
    def check(cls, runs: Runs, noise: Noise) -> list[Remark | str]:
        """Rejects runs that contradict each other. Returns remarks on the others.

        Raises:
            BadData: readings that cannot all be true.
        """

    @classmethod
    def check_start(cls, runs: Runs, noise: Noise, robot: Robot) -> list[Remark | str]:
        """Rejects runs whose initial state the model cannot reproduce. Returns remarks on the length of the others.

        Raises:
            BadData: a run does not begin in an initial state of the model.
        """
        return []

    @classmethod
    def check_settled(cls, runs: Runs) -> None:
        """Rejects data other than settled runs with one row each.

        Raises:
            BadData: time histories.
        """

    @classmethod
    @abc.abstractmethod
    def settled(cls, runs: Runs, steady: bool = False) -> tuple[Runs, np.ndarray, np.ndarray]:
        """One row for each run, the final readings of the run [SI], shape (runs, channels), and its duration [s].

        Args:
            steady: True to omit runs whose speed still changes as much as it does below half of steady travel.
        """

    @classmethod
    @abc.abstractmethod
    def identity(cls, runs: Runs) -> Names:
        """Columns in which copies of a row agree."""

    @classmethod
    @abc.abstractmethod
    def shows(cls, effect: type[Effect]) -> bool:
        """True if data of this kind, with an external supply, can reveal an effect."""

    @classmethod
    def free(cls) -> tuple[Names, Names]:
        """Names of further parameters that such data determine: of the drive, and of each chassis."""
        return (), ()

    # --- of robots

    @abc.abstractmethod
    def __call__(self, robot: Robot) -> Observation:
        """Simulated observation of a robot in each row."""

    def solve(self, robot: Robot) -> tuple[Array, Array] | None:
        """Unknowns of each row, shape (rows, unknowns), and True if a solution was found. None if rows are not
        solutions of equations.
        """
        return None

    @property
    def solves_separately(self) -> bool:
        """True if `solve` is compiled as a separate program, because its compilation takes much longer."""
        return False

    def read(self, robot: Robot) -> Observation:
        """Simulated observation of a robot in each row. Only for observers with a separate program for `solve`."""
        raise NotImplementedError

    def observation_at_unknowns(
        self, robot: Robot, unknowns: Array, is_solved: Array
    ) -> tuple[Observation, Signals, Array]:
        """Observation of a robot in each row at given unknowns, its signals, and the residuals of its equations
        there.

        The residuals have the shape (rows, unknowns).
        """
        raise NotImplementedError

    def operating_points(self, robot: Robot) -> Signals | None:
        """Signals of a robot at the operating point of each row. None if rows have no operating point."""
        return None

    @property
    @abc.abstractmethod
    def long(self) -> bool:
        """True if the model is a rollout. Searches then run one at a time and end sooner."""

    @property
    def over_time(self) -> bool:
        """True if a row does not depend on its own conditions alone: in a rollout, and in a window of a log."""
        return self.long or not self.reads

    @property
    def starts_from_steady(self) -> bool:
        """True if a search may start at the optimum of the same problem with `steady`."""
        return self.long and not self.axis

    @abc.abstractmethod
    def unreachable(self, status: np.ndarray) -> np.ndarray:
        """True for rows whose status is not a valid operating point."""

    @property
    def driven(self) -> Conditions:
        """Conditions under which the robot was driven, all taken as forward, shape (cases,)."""
        return self.conditions

    def cautions(self, robot: Robot) -> list[str]:
        """Warnings about the readings of a calibrated robot, as sentences."""
        return []

    def number_of_included_runs(self, included: np.ndarray) -> int:
        """Number of runs with at least one included row."""
        return int(included.sum())

    def noise_misfit(self, residuals: Callable[[], np.ndarray], counts: Bool[np.ndarray, "rows channels"]) -> float:
        """Expected χ² of noise alone. For settled runs it is one for each reading, because rows are independent.

        Args:
            residuals: function that returns the whitened residuals of a fit, shape (rows, channels).
            counts: True for included readings.
        """
        return float(counts.sum())

    # --- of fits

    @abc.abstractmethod
    def linearise(self, problem: Problem, z: Array, effects: tuple[ScoredEffect, ...]) -> Linearization:
        """Residuals, Jacobian and sensitivities to effects at z."""

    def at_fit(self, problem: Problem, z: Numbers) -> Self:
        """Observer with facts about its runs that a fit has determined."""
        return self

    def draws(self, problem: Problem, z: Array, linear: Linearization, keys: Array, factors: np.ndarray) -> Any:
        """Random input of each bootstrap replicate, first axis the replicates: the keys, or fits of drawn tables.

        Args:
            problem: problem of the base, with its fit z.
            linear: linearization of that fit.
            keys: random keys as numbers, shape (replicates, words).
            factors: factors on the sds of each replicate, shape (replicates, channels).
        """
        return keys

    def fit_replicate(
        self, problem: Problem, effects: tuple[ScoredEffect, ...], linear: Linearization, drawn: Any
    ) -> Linearization:
        """Linearization of one bootstrap replicate: a table that is drawn from the fit of the base and refitted.

        A table of noise alone, refitted by one linear step, unless the kind of data needs more.

        Args:
            problem: problem of the base.
            linear: linearization of the fit.
            drawn: one element of `draws`.
        """
        data = problem.data
        jacobian = linear.jacobian
        is_fitted = jnp.concatenate([data.weight.ravel(), jnp.zeros(linear.rows), jnp.ones(jacobian.shape[1])])
        noise = is_fitted * jax.random.normal(jax.random.wrap_key_data(drawn), is_fitted.shape)
        residual = noise - jacobian @ solve(jacobian.T @ jacobian, jacobian.T @ noise)
        return dataclasses.replace(linear, residual=residual)

    def starts(
        self, problem: Problem, random: np.random.Generator, count: int, problem_of_log: Problem | None = None
    ) -> Float[np.ndarray, "starts z"]:
        """Initial coordinates for at most `count` searches of a base: the prior mean, and draws of the prior.

        Args:
            problem: problem without effects in its coordinates.
            problem_of_log: the same problem with all rows of a log that was thinned.
        """
        size = len(problem.coordinates)
        return np.concatenate([np.zeros((1, size)), random.standard_normal((max(count, 1) - 1, size))])

    def scanned(self, problem: Problem) -> tuple[int, ...]:
        """Coordinates whose objective is scanned over the range of the prior, see `scans`.

        Empty if enough starts are drawn from the prior to reach every local optimum.
        """
        return ()

    def number_of_scan_points(self, problem: Problem, k: int) -> int:
        """Number of scanned values of a coordinate, a multiple of `scans.CLOSER`."""
        raise NotImplementedError

    def scan(self, problem: Problem, z: Array, k: int, values: Array) -> tuple[Array, Array]:
        """Objective at each of `values` of coordinate k, shape (values,), and all coordinates there, shape (values,
        coordinates).

        The other coordinates move from z to the minimum of the linearised objective.
        """
        raise NotImplementedError

    def searches_per_core(self, problem: Problem) -> int:
        """Number of searches of a problem that run together on a core, see `searches_refilled`."""
        raise NotImplementedError

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
        """Fits from any number of starts, each with its own weights, and the observations at their optima.

        Args:
            starts: initial coordinates, shape (members, coordinates).
            weights: weights of the readings of each member, shape (members, rows, channels).
            active: set of effects of each member, see `ActiveSet`. None: those of the problem.
            rivals: True if all members search the same optimum, so that some may be stopped early.
            most: largest number of steps. None: that of the policy.
        """
        evaluate = parallel_evaluator(problem, weights, active)
        steps = self.policy.steps if most is None else most
        return search_rollouts(evaluate, starts, problem.data, weights, steps, self.policy.batch)

    def observation_at(self, problem: Problem, z: Numbers, active: Numbers | None = None) -> Observation:
        """Simulated observation in each row at z.

        Args:
            active: effects in the slots, for a problem with slots.
        """
        if not self.long:
            return self.at(problem, z, active)[2]
        problem = with_effects(problem, active)
        return observe_robot(problem, problem.robot(jnp.asarray(z)))

    def at(self, problem: Problem, z: Numbers, active: Numbers | None = None) -> tuple[Numbers, Numbers, Observation]:
        """Residuals, their Jacobian and the observation at z. Arguments as in `observation_at`."""
        return linearise(with_effects(problem, active), jnp.asarray(z))

    @abc.abstractmethod
    def bases(self, columns: Columns, included: Bool[np.ndarray, " rows"], robot: Robot) -> Bases:
        """Bases of smooth curves that describe a discrepancy.

        Args:
            columns: columns of the padded table, with fitted readings.
            robot: fitted robot.
        """

    @abc.abstractmethod
    def detail(self, bases: Bases, included: np.ndarray, before: Any, after: Any) -> Detail:
        """Further findings for this kind of data.

        Args:
            bases: bases of smooth curves.
            included: True for included rows of the table.
            before, after: diagnoses without and with the proposal.
        """


def with_effects(problem: Problem, active: Numbers | None) -> Problem:
    """Problem with these effects in its slots. None: unchanged."""
    if active is None:
        return problem
    return dataclasses.replace(problem, coordinates=problem.coordinates.with_effects(jnp.asarray(active)))


def parallel_evaluator(problem: Problem, weights: Numbers, active: Numbers | None) -> Evaluate:
    """Function that evaluates the model for members of a search, in parallel.

    Args:
        weights, active: values for each member, see `Observer.search`.
    """
    weights = np.asarray(weights)
    is_compiled = threading.Event()

    def evaluate_one(z: np.ndarray, member: int) -> tuple[Numbers, Numbers, Observation]:
        slots = None if active is None else np.asarray(active)[member]
        return jax.device_get(problem.observe.at(problem.with_data(weight=weights[member]), z, slots))

    def evaluate(z: np.ndarray, members: np.ndarray) -> tuple[np.ndarray, np.ndarray, Observation]:
        with Threads(CORES if is_compiled.is_set() else 1) as cores:
            results = list(cores.map(evaluate_one, z, members))
        is_compiled.set()  # the first call has compiled the program
        return jax.tree.map(lambda *x: np.stack(x), *results)

    return evaluate
