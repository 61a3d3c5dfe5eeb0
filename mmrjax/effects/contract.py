"""What the checks of a user's effects and the tests of the library share: the signals that a term may read."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from mmrjax import balances
from mmrjax.conditions import Conditions
from mmrjax.params import Scalar
from mmrjax.robot import Robot
from mmrjax.signals import Signals, State


@dataclasses.dataclass
class _Witness:
    """Stands among a robot's effects, adds nothing, and keeps the signals that its balance hands to a term."""

    balance: str
    channel: str
    seen: list[Signals]
    acts_everywhere: ClassVar[bool] = True

    def term(self, robot: Robot, signals: Signals) -> Scalar | float:
        self.seen.append(signals)
        return 0.0


def readable(
    robot: Robot, conditions: Conditions, state: State, balance: str, channel: str = "", *, settled: bool = False
) -> Signals:
    """The signals that an effect of this balance may read: those computed before it, every other one `UNSET`.

    Args:
        conditions, state: one run at one instant, scalars; not traced.
        settled: in steady forward travel (`balances.settled`), else in motion (`balances.moving`).
    """
    witness = _Witness(balance, channel, [])
    watched = dataclasses.replace(robot, effects=(witness,))
    order = balances.settled if settled else balances.moving
    signals = order(watched, conditions, state)
    balances.sensor(watched, signals[0] if isinstance(signals, tuple) else signals)
    return witness.seen[0]
