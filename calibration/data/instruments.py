"""Sign and step of instruments, inferred from the readings of a table where a rig's file leaves them free."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from calibration.data import Columns
from calibration.data.table import Runs
from mmrjax.model import channels
from mmrjax.model.channels import Channel
from mmrjax.model.rig import Instrument
from mmrjax.model.robot import Robot

#: Smallest step, and largest rounding of a printed reading, as shares of the largest difference.
SMALLEST, ROUNDING = 1e-5, 1e-7
#: Fewest different readings that show a step: the common divisor of so many random multiples is the step itself in
#: 99 % of tables, of four multiples in 83 %.
FEWEST = 8
#: Coarsest step of a display, as a share of the largest reading: coarser multiples are levels set by a person.
COARSEST = 0.25


def step_of(readings: np.ndarray) -> float:
    """Returns the largest common divisor of all differences between readings, by Euclid's algorithm.

    It is 0 if the divisor is no larger than rounding, or if there are too few different readings. A ladder of levels
    from its first rung on, each as often, at most one left out, was set by a person: it shows no display.
    """
    levels, counts = np.unique(readings[np.isfinite(readings)], return_counts=True)
    if levels.size < FEWEST:
        return 0.0
    step, largest = 0.0, float(np.ptp(levels))
    for apart in np.diff(levels):
        a, b = float(apart), step
        while b > ROUNDING * largest:
            rest = a - b * round(a / b)
            a, b = b, abs(rest)
        step = a
        if step < SMALLEST * largest:
            return 0.0
    ladder = largest < (levels.size + 0.5) * step and np.min(np.abs(levels)) < 1.5 * step
    set_by_hand = ladder and np.ptp(counts) == 0
    return 0.0 if set_by_hand else step


def display_step(readings: np.ndarray, channel: Channel) -> float:
    """Step of the display of a channel [SI], 0 if the readings show no step.

    It is the result of `step_of`. With too few different readings, it is the largest power of ten that divides all of
    them in the unit of their column. It is at most `COARSEST` of the largest reading.

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


def infer_instruments(instruments: tuple[Instrument, ...], columns: Columns) -> tuple[Instrument, ...]:
    """Instruments with sign and step inferred from the readings where they are free.

    An instrument shows magnitude alone if no reading is negative although some runs go backward.

    Args:
        columns: columns of the table, in their units.
    """
    back = any((columns[c] < 0).any() for c in ("supply_voltage_V", "motor_speed_rpm", "duty") if c in columns)
    inferred = []
    for instrument in instruments:
        channel = channels.find_channel(instrument.channel)
        readings = columns.get(channel.column, np.zeros(0))
        signed, quantum = instrument.signed, instrument.quantum
        if signed is None:
            signed = not back or bool((readings < 0).any())
        if quantum is None:
            quantum = step_of(readings) * channel.factor
        inferred.append(Instrument(instrument.channel, signed, quantum))
    return tuple(inferred)


def with_inferred_instruments(robot: Robot, runs: Runs) -> Robot:
    """Returns `robot` with the instruments that its table shows."""
    mine = robot.rig.instruments
    all_instruments = runs.layout.instruments if any(i.free for i in mine) else mine
    named = {i.channel for i in all_instruments}
    all_instruments = (*all_instruments, *(i for i in runs.layout.instruments if i.channel not in named))
    if all_instruments == mine:
        return robot
    return dataclasses.replace(robot, rig=dataclasses.replace(robot.rig, instruments=all_instruments))
