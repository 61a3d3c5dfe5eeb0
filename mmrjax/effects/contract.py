"""The signals that a term may read, for the checks of a user's effects and the tests of the library."""

from __future__ import annotations

import dataclasses

from mmrjax.effects.base import Effect
from mmrjax.model import balances
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals, State


def _witness(place: str, whose: str, seen: list[Signals]) -> Effect:
    """An effect with a zero term that records the signals its balance passes to it."""

    class Witness(Effect):
        balance = place
        channel = whose
        amplitude: Scalar = 0.0

        def term(self, robot: Robot, signals: Signals) -> Scalar:
            seen.append(signals)
            return 0.0

    return Witness()


def readable_signals(
    robot: Robot, conditions: Conditions, state: State, balance: str, channel: str = "", *, settled: bool = False
) -> Signals:
    """The signals that an effect of this balance may read: those computed before it; the others are `UNSET`.

    Args:
        conditions, state: one run at one instant, scalars; not traced.
        settled: in steady forward travel (`balances.settled_signals`), else in motion (`balances.moving_signals`).
    """
    seen: list[Signals] = []
    watched = dataclasses.replace(robot, effects=(_witness(balance, channel, seen),))
    order = balances.settled_signals if settled else balances.moving_signals
    signals = order(watched, conditions, state)
    balances.sensor(watched, signals[0] if isinstance(signals, tuple) else signals)
    return seen[0]
