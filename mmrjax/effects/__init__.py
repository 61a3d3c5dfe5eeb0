"""The library of effects, one file a balance: a new effect is a class in the file of its balance."""

from mmrjax.effects import (
    electrical_effects,
    gearbox_effects,
    ground_effects,
    inductance_effects,
    inertia_effects,
    mass_effects,
    motor_effects,
    sensor_effects,
    slip_effects,
    supply_effects,
    track_effects,
    turning_effects,
)
from mmrjax.effects.base import Effect, amplitude, defined_in
from mmrjax.effects.curve import CURVES, CURVES_ROUND, CURVES_SHOWN, WAVES
from mmrjax.effects.sensor_effects import OF_CHANNELS

_FILES = (
    mass_effects,
    inertia_effects,
    supply_effects,
    electrical_effects,
    inductance_effects,
    motor_effects,
    gearbox_effects,
    track_effects,
    ground_effects,
    slip_effects,
    sensor_effects,
)

#: Every effect of the library, balance by balance and there in the order of its file. Tables of scores and the
#: random numbers of a bootstrap go by position: a new effect stands at the end of its file.
ALL: tuple[type[Effect], ...] = tuple(effect for file in _FILES for effect in defined_in(file))

BY_NAME: dict[str, type[Effect]] = {effect.name: effect for effect in ALL}

#: Discrepancies without a name, which robot files know and no library holds.
UNNAMED: dict[str, type[Effect]] = {**CURVES, **WAVES, **CURVES_ROUND, **CURVES_SHOWN}

#: Of a robot that turns: robot files know them, and the loop looks for them in tables of turns.
OF_TURNS: dict[str, type[Effect]] = {effect.name: effect for effect in defined_in(turning_effects)}

#: What robot files know beside the library. Those of channels the loop looks for where a robot has the channel.
BESIDE: dict[str, type[Effect]] = {**UNNAMED, **OF_TURNS, **OF_CHANNELS}

__all__ = [
    "ALL", "BESIDE", "BY_NAME", "CURVES", "CURVES_ROUND", "CURVES_SHOWN", "OF_CHANNELS", "OF_TURNS", "UNNAMED",
    "WAVES", "Effect", "amplitude", "defined_in",
]  # fmt: skip
