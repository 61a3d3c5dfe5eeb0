"""The library of effects. A new effect is a class in the file that names its balance in the first line."""

from mmrjax.effects import (
    drive_effects,
    mass_effects,
    signal_effects,
    track_effects,
    travel_effects,
    turning_effects,
    voltage_effects,
)
from mmrjax.effects.base import Effect, EffectClasses, amplitude, effects_of_module
from mmrjax.effects.curve import CURVES, CURVES_ROUND, CURVES_SHOWN, WAVES
from mmrjax.effects.signal_effects import OF_CHANNELS

_FILES = (mass_effects, voltage_effects, drive_effects, track_effects, travel_effects, signal_effects)

#: All effects of the library by balance, in the order of each file. Tables of scores and the random numbers of a
#: bootstrap depend on the position: add a new effect after the others of its balance.
ALL: tuple[type[Effect], ...] = tuple(effect for file in _FILES for effect in effects_of_module(file))

BY_NAME: EffectClasses = {effect.name: effect for effect in ALL}

#: Unnamed discrepancies, which robot files accept but the library does not contain.
UNNAMED: EffectClasses = {**CURVES, **WAVES, **CURVES_ROUND, **CURVES_SHOWN}

#: Effects of a robot that turns; robot files accept them, and the loop tries them on tables of turns.
OF_TURNS: EffectClasses = {effect.name: effect for effect in effects_of_module(turning_effects)}

#: Further effects that robot files accept. The loop tries those of a channel if the robot has the channel.
BESIDE: EffectClasses = {**UNNAMED, **OF_TURNS, **OF_CHANNELS}

__all__ = [
    "ALL", "BESIDE", "BY_NAME", "CURVES", "CURVES_ROUND", "CURVES_SHOWN", "OF_CHANNELS", "OF_TURNS", "UNNAMED",
    "WAVES", "Effect", "amplitude", "effects_of_module",
]  # fmt: skip
