"""Settled turns: one row a run of a robot whose sides are driven apart, read when it circles."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from calibration.data.errors import BadConfiguration
from calibration.data.runs import Runs
from calibration.inference.blocks import TURN
from calibration.inference.observers.histories import Histories
from calibration.inference.observers.settled import SettledRuns
from calibration.inference.problem import Observation
from mmrjax import fidelities
from mmrjax.robot import Robot
from mmrjax.signals import NOT_SETTLED


class SettledTurns(SettledRuns):
    """Observer of settled turns.

    Contacts slide across the travel as far as the turn asks, so that the demand on adhesion, which bounds straight
    travel, bounds nothing here.
    """

    word: ClassVar[str] = "turns"
    blocks: ClassVar[tuple[str, ...]] = ("run", TURN, "voltage", "payload", "configuration")
    traced: ClassVar[bool] = False
    searches: ClassVar[int | None] = 4  # a turn takes some hundred times as long to find as straight travel
    profiled: ClassVar[bool] = False

    @classmethod
    def observes(cls, runs: Runs) -> bool:
        return runs.turns and super().observes(runs)

    @classmethod
    def of(cls, runs: Runs, robot: Robot, fidelity: str | None = None) -> SettledTurns:
        first = fidelities.NAMES[0]
        if fidelity not in (None, first):
            raise BadConfiguration(f"{runs.source}: settled turns are fitted with --model {first}; got {fidelity}")
        found = super().of(runs, robot, fidelity)
        return cls(found.conditions, found.fidelity, of_size=True)

    @classmethod
    def sizes(cls, runs: Runs) -> np.ndarray:
        """The channel's root mean square: readings of turns either way cross zero."""
        return Histories.sizes(runs)

    @classmethod
    def least(cls, runs: Runs) -> np.ndarray:
        return cls.sizes(runs)

    def __call__(self, robot: Robot) -> Observation:
        seen = super().__call__(robot)
        return dataclasses.replace(seen, adhesion_used=jnp.zeros_like(seen.adhesion_used))

    def unreachable(self, status: np.ndarray) -> np.ndarray:
        return super().unreachable(status) | (status == NOT_SETTLED)
