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
#: Ratio of the relative range of the supply voltage to the relative range of the duty, below which only the duty
#: counts as varied [-].
SAGS = 0.3


def varied_by_duty(runs: Runs) -> bool:
    """True if a table varies the motor voltage by the duty, while the supply voltage is constant except for sag."""
    if not (runs.has("duty") and runs.has(SUPPLY)):
        return False
    duty_range, supply_range = (
        float(np.ptp(x) / max(np.max(x), 1e-300)) for x in map(np.abs, (runs["duty"], runs[SUPPLY]))
    )
    return duty_range > 0 and supply_range < SAGS * duty_range


@dataclasses.dataclass(frozen=True)
class DiscrepancyLocation:
    """Balance or channel of a discrepancy, and the variable that it depends on.

    Attributes:
        place: balance with the curve that explains most, or channel with shifted readings.
        variable: variable of the curve.
        alike: other places whose curves explain as much, or whose balances have no curves of their own.
        variables_alike: other variables whose curves there are of similar significance, the most significant first.
            Temporary changes have one entry for each axis.
        explained: decrease of χ² by the curves of that balance and variable [σ²].
        strongest: decrease of χ² by the most significant family of curves [σ²].
        by_duty: True if the voltage of the motors varied only with the duty.
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
        """Balance of the discrepancy, or `sensor` if an instrument is in error."""
        return bases.balance_of(self.place)

    @property
    def channel(self) -> str:
        """Channel with wrong readings, empty if the discrepancy is in a balance."""
        return self.place if bases.is_channel_place(self.place) else ""

    @property
    def balances_alike(self) -> Names:
        """Balances in which the same error would change the readings in the same way."""
        return tuple(dict.fromkeys(map(bases.balance_of, self.alike)))

    @property
    def window(self) -> dict[str, str | float] | None:
        """Axis, begin and end of a temporary change. None for other discrepancies."""
        window = bases.window_from_name(self.variable)
        return None if window is None else dataclasses.asdict(window)

    @property
    def family(self) -> str:
        """Equation and driving variable, in the words of `Effect.family`."""
        window = bases.window_from_name(self.variable)
        variable = self.variable if window is None else window.axis
        subject = bases.place_in_words(self.place) if self.channel else EQUATION[self.balance]
        drivers = {name: v.driver for name, v in EVERY_VARIABLE.items() if v.driver}
        drivers |= {"current": "load" if self.balance in OF_LOAD else "current"}
        drivers |= {"payload": "load", "slope": "demand" if self.balance == "slip" else "slope"}
        drivers |= {"voltage": "duty"} if self.by_duty else {}
        return f"{subject} that changes with {drivers.get(variable, variable)}"
