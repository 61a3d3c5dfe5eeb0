"""What an effect is: one equation that enters one balance with one linear amplitude."""

from __future__ import annotations

import abc
from typing import TYPE_CHECKING, ClassVar

import equinox as eqx

from mmrjax.params import Scalar
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class Effect(eqx.Module):
    """A term that the paper's model lacks.

    A subclass states its equation and source in its docstring, declares `amplitude` as a parameter with
    default 0 (absent) and `amplitude=True`, any shape parameters beside it, and the class attributes:

    Attributes:
        name: its name in files and reports.
        balance: the balance it enters, one of `balances.BALANCES`, whose unit its term has. A positive
            term takes away: a voltage drop, a loss torque, a resisting force, a lost speed; in `mass` it
            adds mass and in `sensor` it adds to the reading of `channel`.
        dissipative: whether a positive amplitude may only take power out.
        channel: for `sensor` alone: the field of `Reading` that it changes.
    """

    name: ClassVar[str]
    balance: ClassVar[str]
    dissipative: ClassVar[bool]
    channel: ClassVar[str] = ""

    amplitude: eqx.AbstractVar[Scalar]

    @abc.abstractmethod
    def term(self, robot: Robot, signals: Signals) -> Scalar:
        """The term [unit of its balance], linear in `amplitude`; may read any signal computed before."""
