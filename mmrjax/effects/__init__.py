"""The library of effects. A new effect is one file and one line in `ALL`."""

from mmrjax.effects.base import Effect
from mmrjax.effects.churning import Churning
from mmrjax.effects.mass_offset import MassOffset
from mmrjax.effects.rolling_radius import RollingRadius
from mmrjax.effects.series_resistance import SeriesResistance
from mmrjax.effects.winding_heating import WindingHeating

ALL: tuple[type[Effect], ...] = (
    SeriesResistance,
    WindingHeating,
    Churning,
    MassOffset,
    RollingRadius,
)

BY_NAME: dict[str, type[Effect]] = {effect.name: effect for effect in ALL}

__all__ = ["ALL", "BY_NAME", "Effect"]
