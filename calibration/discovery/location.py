"""Where something is missing: the balance or the channel, and over what it shows."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from calibration.data.columns import SUPPLY
from calibration.data.runs import Runs
from calibration.inference import bases
from mmrjax.effects.base import EQUATION
from mmrjax.effects.curve import EVERY_VARIABLE

#: Balances in which the current stands for the load that the motors carry.
OF_LOAD = ("motor", "gearbox", "track", "ground", "slip", "yaw")
#: Spread of the supply voltage over that of the duty, each over its largest, below which the duty alone is set [-].
SAGS = 0.3


def varied_by_duty(runs: Runs) -> bool:
    """True if the motors' voltage varies in a table by the duty, at about one supply voltage: one that is measured
    sags a little."""
    if not (runs.has("duty") and runs.has(SUPPLY)):
        return False
    duty, supply = (float(np.ptp(x) / max(np.max(x), 1e-300)) for x in map(np.abs, (runs["duty"], runs[SUPPLY])))
    return duty > 0 and supply < SAGS * duty


@dataclasses.dataclass(frozen=True)
class DiscrepancyLocation:
    """Where something is missing.

    Attributes:
        place: balance in which a curve explains most, or channel whose readings it shifts; variable: over which it
            does.
        alike: places in which one explains as much, or would if it had curves of its own.
        variables_alike: over which a curve there is as improbable, beside `variable`: the most improbable first, of
            what happens for a while one along each axis.
        explained: what the curves of that balance and variable explain [σ²]; strongest: what the most improbable
            family does.
        by_duty: whether the motors' voltage varied with the duty alone.
    """

    place: str
    variable: str
    alike: tuple[str, ...]
    variables_alike: tuple[str, ...]
    explained: float
    strongest: float
    by_duty: bool = dataclasses.field(default=False, kw_only=True)

    @property
    def balance(self) -> str:
        """The balance, `sensor` where it is in what an instrument shows."""
        return bases.balance_of(self.place)

    @property
    def channel(self) -> str:
        """The channel whose readings are off, empty for none."""
        return self.place if bases.in_readings(self.place) else ""

    @property
    def balances_alike(self) -> tuple[str, ...]:
        """Balances of the places that act alike."""
        return tuple(dict.fromkeys(map(bases.balance_of, self.alike)))

    @property
    def family(self) -> str:
        """Its equation and what drives it, in the words of `Effect.family`."""
        happens = bases.window(self.variable)
        variable = self.variable if happens is None else happens.axis
        what = bases.in_words(self.place) if self.channel else EQUATION[self.balance]
        drivers = {name: v.driver for name, v in EVERY_VARIABLE.items() if v.driver}
        drivers |= {"current": "load" if self.balance in OF_LOAD else "current"}
        drivers |= {"payload": "load", "slope": "demand" if self.balance == "slip" else "slope"}
        drivers |= {"voltage": "duty"} if self.by_duty else {}
        return f"{what} that changes with {drivers.get(variable, variable)}"

    def to_json(self) -> dict[str, Any]:
        """As in result.json."""
        return {
            "balance": self.balance,
            "channel": self.channel,
            "balances_alike": self.balances_alike,
            "variable": self.variable,
            "variables_alike": self.variables_alike,
        }
