"""Instruments whose sign or step a rig's file leaves free: as the readings of a table show them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import numpy as np

from calibration.data.table import Runs
from mmrjax.model import channels
from mmrjax.model.channels import Channel
from mmrjax.model.rig import Instrument
from mmrjax.model.robot import Robot

#: Smallest step that counts as one, and what of a difference is rounding, as shares of the largest difference.
SMALLEST, ROUNDING = 1e-5, 1e-9
#: Fewest different readings that tell a step: of so many random multiples the common divisor is the step itself in
#: 99 % of tables, of four in 83 %.
FEWEST = 8
#: Coarsest step of a display, as a share of the largest reading: coarser multiples are levels that somebody set.
COARSEST = 0.25


def step_of(readings: np.ndarray) -> float:
    """The largest step of which all differences between readings are multiples, by Euclid's algorithm; 0: there is
    none that is larger than rounding, or too few different readings tell."""
    levels = np.unique(readings[np.isfinite(readings)])
    if levels.size < FEWEST:
        return 0.0
    found, largest = 0.0, float(np.ptp(levels))
    for apart in np.diff(levels):
        a, b = float(apart), found
        while b > ROUNDING * largest:
            rest = a - b * round(a / b)
            a, b = b, abs(rest)
        found = a
        if found < SMALLEST * largest:
            return 0.0
    return found


def display_step(readings: np.ndarray, channel: Channel) -> float:
    """Step of the display that shows a channel [SI], 0 if none shows.

    It is that of `step_of`. Too few different readings do not tell it. Then it is the largest power of ten that
    divides all of them, in the unit of their column and up to `COARSEST` of the largest.

    Args:
        readings: [SI].
    """
    step = step_of(readings)
    levels = np.unique(readings[np.isfinite(readings)]) / channel.factor
    if step or not 2 <= levels.size < FEWEST:
        return step
    largest = float(np.max(np.abs(levels)))
    powers = 10.0 ** np.arange(math.floor(math.log10(COARSEST * largest)), math.log10(SMALLEST * largest), -1)
    fits = [p for p in powers if np.all(np.abs(levels / p - np.round(levels / p)) < 1e-6)]
    return float(fits[0] * channel.factor) if fits else 0.0


def infer_instruments(
    instruments: tuple[Instrument, ...], columns: Mapping[str, np.ndarray]
) -> tuple[Instrument, ...]:
    """Instruments with nothing free: one shows magnitude alone where none of its readings is negative and some runs
    go backward, and its step is that of its readings.

    Args:
        columns: of the table, in their units.
    """
    back = any((columns[c] < 0).any() for c in ("supply_voltage_V", "motor_speed_rpm", "duty") if c in columns)
    found = []
    for instrument in instruments:
        channel = channels.find_channel(instrument.channel)
        shown = columns.get(channel.column, np.zeros(0))
        signed, quantum = instrument.signed, instrument.quantum
        if signed is None:
            signed = not back or bool((shown < 0).any())
        if quantum is None:
            quantum = step_of(shown) * channel.factor
        found.append(Instrument(instrument.channel, signed, quantum))
    return tuple(found)


def with_inferred_instruments(robot: Robot, runs: Runs) -> Robot:
    """`robot` with the instruments that its table shows."""
    mine = robot.rig.instruments
    found = runs.layout.instruments if any(i.free for i in mine) else mine
    named = {i.channel for i in found}
    found = (*found, *(i for i in runs.layout.instruments if i.channel not in named))
    if found == mine:
        return robot
    return dataclasses.replace(robot, rig=dataclasses.replace(robot.rig, instruments=found))
