"""Location of a discrepancy: the balance or the channel, and the variable."""

from __future__ import annotations

import dataclasses

import numpy as np

from calibration.data import Names
from calibration.data.columns import SUPPLY
from calibration.data.runs import Runs
from calibration.inference import bases
from mmrjax.effects.base import EQUATION
from mmrjax.effects.curve import EVERY_VARIABLE

#: Balances in which the current is a measure of the motors' load.
OF_LOAD = ("motor", "gearbox", "track", "ground", "slip", "yaw")
#: Range of the supply voltage over that of the duty, each over its largest, below which only the duty is varied [-].
SAGS = 0.3


def varied_by_duty(runs: Runs) -> bool:
    """True if a table varies the motors' voltage by the duty, at nearly constant supply voltage (which may sag)."""
    if not (runs.has("duty") and runs.has(SUPPLY)):
        return False
    duty, supply = (float(np.ptp(x) / max(np.max(x), 1e-300)) for x in map(np.abs, (runs["duty"], runs[SUPPLY])))
    return duty > 0 and supply < SAGS * duty


@dataclasses.dataclass(frozen=True)
class DiscrepancyLocation:
    """Location of a discrepancy.

    Attributes:
        place: balance with the curve that explains most, or channel with shifted readings.
        variable: variable of the curve.
        alike: places with curves that explain as much, or that represent balances without curves of their own.
        variables_alike: other variables with curves of similar significance there, the most significant first. Of
            temporary changes one along each axis.
        explained: decrease of χ² by the curves of that balance and variable [σ²].
        strongest: by the most significant family.
        by_duty: True if the motors' voltage varied only with the duty.
    """

    JSON = ("balance", "channel", "balances_alike", "variable", "variables_alike")
    place: str
    variable: str
    alike: Names
    variables_alike: Names
    explained: float
    strongest: float
    by_duty: bool = dataclasses.field(default=False, kw_only=True)

    @property
    def balance(self) -> str:
        """The balance, or `sensor` if the error is in an instrument."""
        return bases.balance_of(self.place)

    @property
    def channel(self) -> str:
        """The channel with wrong readings, empty for none."""
        return self.place if bases.is_channel_place(self.place) else ""

    @property
    def balances_alike(self) -> Names:
        """Balances with the same effect on the readings."""
        return tuple(dict.fromkeys(map(bases.balance_of, self.alike)))

    @property
    def family(self) -> str:
        """Its equation and the variable that it depends on, in the words of `Effect.family`."""
        happens = bases.window_from_name(self.variable)
        variable = self.variable if happens is None else happens.axis
        what = bases.place_in_words(self.place) if self.channel else EQUATION[self.balance]
        drivers = {name: v.driver for name, v in EVERY_VARIABLE.items() if v.driver}
        drivers |= {"current": "load" if self.balance in OF_LOAD else "current"}
        drivers |= {"payload": "load", "slope": "demand" if self.balance == "slip" else "slope"}
        drivers |= {"voltage": "duty"} if self.by_duty else {}
        return f"{what} that changes with {drivers.get(variable, variable)}"
