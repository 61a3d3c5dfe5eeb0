"""Settled turns: one row for each run of a robot with independently driven sides, read while it circles."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from calibration.data import Columns, Names
from calibration.data.input_errors import BadConfiguration
from calibration.data.runs import Runs
from calibration.inference import bases as bases_room
from calibration.inference import priors
from calibration.inference.bases import Bases
from calibration.inference.blocks import TURN
from calibration.inference.linearization import PROBED, Linearization, ScoredEffect
from calibration.inference.observers.base import SearchPolicy
from calibration.inference.observers.settled import SettledLinearization, SettledRuns, side_shares
from calibration.inference.observers.time_histories import Histories
from calibration.inference.optimizers import solve_rows_at
from calibration.inference.problem import Observation, Problem
from mmrjax import effects, fidelities
from mmrjax.effects import Effect
from mmrjax.effects.curve import IN_TURNS, VARIABLES_ROUND, WAYS
from mmrjax.fidelities.steady import results_of_rows
from mmrjax.model.balances import ROUND
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import NOT_SETTLED, Result, Signals

#: Variables of curves in turns; the order of runs is the table's.
VARIABLES = (*(v for v in IN_TURNS if v != "order"), *VARIABLES_ROUND)


def signal_by_point(signals: Signals, name: str) -> Float[Array, " points"]:
    """A signal at each point [SI].

    Args:
        signals: shape (rows, sides).
    """
    return jnp.broadcast_to(getattr(signals, name), jnp.shape(signals.speed_motor)).T.ravel()


class TurnLinearization(SettledLinearization):
    """Linearization of settled turns. Each side of each row is a point. The last axis of `signals` is the side."""

    probed: ClassVar[Names] = (*PROBED, *ROUND)

    @property
    def points(self) -> int:
        return self.rows * self.defects.shape[1]

    def at_points(self, rows: np.ndarray) -> np.ndarray:
        return np.tile(rows, self.defects.shape[1])

    def of_rows(self, points: np.ndarray) -> np.ndarray:
        return np.any(points.reshape(-1, self.rows), axis=0)

    def variable(self, name: str) -> np.ndarray:
        return np.asarray(signal_by_point(self.signals, name), float)

    def channel_columns(self, channel: Scalar | int, shapes: Array | np.ndarray) -> Float[Array, "readings terms"]:
        errors_of_sides = shapes.reshape(-1, self.rows, shapes.shape[1])
        shares = np.stack([side_shares(name, len(errors_of_sides)) for name in self.channels])
        return super().channel_columns(channel, jnp.tensordot(jnp.asarray(shares)[channel], errors_of_sides, 1))


class SettledTurns(SettledRuns):
    """Observer of settled turns.

    In a turn, contacts slide sideways as far as the turn requires. Adhesion, which limits straight travel, is no
    limit here.
    """

    word: ClassVar[str] = "turns"
    blocks: ClassVar[Names] = ("run", TURN, "voltage", "payload", "configuration")
    one_row_reveals: ClassVar[bool] = False  # a row has a defect on either side
    library: ClassVar[Mapping[str, type[Effect]]] = effects.OF_TURNS
    menu: ClassVar[bool] = False
    policy: ClassVar[SearchPolicy] = SearchPolicy(searches=4)
    searches: ClassVar[int | None] = 4  # solving a turn takes some hundred times as long as straight travel
    profiled: ClassVar[bool] = False
    linearization: ClassVar[type[SettledLinearization]] = TurnLinearization
    shape_sides: ClassVar[tuple[int, ...]] = (2,)

    @classmethod
    def accepts_table(cls, runs: Runs) -> bool:
        return runs.turns and super().accepts_table(runs)

    @classmethod
    def of(cls, runs: Runs, robot: Robot, fidelity: str | None = None) -> SettledTurns:
        default_model = fidelities.NAMES[0]
        if fidelity not in (None, default_model):
            raise BadConfiguration(
                f"{runs.source}: settled turns are fitted with --model {default_model}; got {fidelity}"
            )
        observer = super().of(runs, robot, fidelity)
        return cls(observer.conditions, observer.fidelity)

    @classmethod
    def sizes(cls, runs: Runs) -> np.ndarray:
        """Root mean square of each channel, because readings cross zero between turns in both directions."""
        return Histories.sizes(runs)

    @classmethod
    def least(cls, runs: Runs) -> np.ndarray:
        return cls.sizes(runs)

    @classmethod
    def free(cls) -> tuple[Names, Names]:
        return (), priors.OF_TURNS

    def _simulated_readings(self, robot: Robot, result: Result) -> Observation:
        observation = super()._simulated_readings(robot, result)
        return dataclasses.replace(observation, adhesion_used=jnp.zeros_like(observation.adhesion_used))

    @property
    def solves_separately(self) -> bool:
        return True

    def read(self, robot: Robot) -> Observation:
        return self._simulated_readings(robot, results_of_rows(robot, self.conditions)[0])

    def draws(
        self, problem: Problem, z: Array, linear: Linearization, keys: Array, factors: np.ndarray
    ) -> tuple[Any, ...]:
        """Draws as in the protocol, with the roots at each refit."""
        tables = super().draws(problem, z, linear, keys, factors)
        return *tables, solve_rows_at(problem, tables[2])

    def fit_replicate(
        self,
        problem: Problem,
        effects: tuple[ScoredEffect, ...],
        linear: Linearization,
        drawn: tuple[Any, ...],
    ) -> Linearization:
        problem_with_roots = dataclasses.replace(problem, roots=drawn[-1])
        return super().fit_replicate(problem_with_roots, effects, linear, drawn[:-1])

    def unreachable(self, status: np.ndarray) -> np.ndarray:
        return super().unreachable(status) | (status == NOT_SETTLED)

    def bases(self, columns: Columns, included: np.ndarray, robot: Robot) -> Bases:
        """Bases of curves, see `Observer.bases`, in the balances of both sides and of the turn.

        Curves are over the signals of each side, the yaw rate, and the side.
        """
        names = [v for v in VARIABLES if v != "voltage" or robot.rig.shows_voltage]
        signals = results_of_rows(robot, self.conditions)[1]
        signal_values = {n: np.asarray(signal_by_point(signals, n)) for n in (*names, *WAYS)}
        columns_by_point = {bases_room.VARIABLES[v]: signal_values[v] for v in names}
        columns_by_point |= {c: np.tile(columns[c], 2) for c in ("configuration", "order") if c in columns}
        weight = np.tile(included.astype(float), 2)
        balances = bases_room.balances_of(robot, (*bases_room.BALANCES, *bases_room.OF_TURNS))
        axes = (bases_room.axes_of(robot)[0], bases_room.VARIABLES["payload"], *VARIABLES_ROUND)  # what is imposed
        scope = dataclasses.replace(bases_room.CurveScope.of(robot, columns_by_point), balances=balances, axes=axes)
        return bases_room.families_of_table(
            columns_by_point, weight, {way: signal_values[way] for way in WAYS}, scope
        )
