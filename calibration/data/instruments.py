"""Sign and resolution of instruments, inferred from the readings of a table if the rig file does not state them."""

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

#: Smallest step, and largest rounding error of a printed reading, as shares of the largest difference.
SMALLEST, ROUNDING = 1e-5, 1e-7
#: Fewest different readings that show a step. In 99 % of tables the common divisor of so many random multiples is the
#: step itself, with four multiples in 83 %.
FEWEST = 8
#: Coarsest step of a display, as a share of the largest reading. Coarser steps are levels that a person set.
COARSEST = 0.25


def common_step(readings: np.ndarray) -> float:
    """Largest common divisor of all differences between readings (Euclid's algorithm).

    0 if that step is not larger than rounding errors, or if there are too few different readings. Evenly spaced
    readings that occur equally often, with at most one level missing, were set by a person. They do not show the
    resolution of a display.
    """
    levels, counts = np.unique(readings[np.isfinite(readings)], return_counts=True)
    if levels.size < FEWEST:
        return 0.0
    step, largest = 0.0, float(np.ptp(levels))
    for difference in np.diff(levels):
        a, b = float(difference), step
        while b > ROUNDING * largest:
            remainder = a - b * round(a / b)
            a, b = b, abs(remainder)
        step = a
        if step < SMALLEST * largest:
            return 0.0
    ladder = largest < (levels.size + 0.5) * step and np.min(np.abs(levels)) < 1.5 * step
    set_by_hand = ladder and np.ptp(counts) == 0
    return 0.0 if set_by_hand else step


def display_step(readings: np.ndarray, channel: Channel) -> float:
    """Resolution of the display of a channel [SI]. 0 if the readings show none.

    It is the `common_step`. With too few different readings, it is the largest power of ten, in the unit of the
    column, that divides all of them. It is at most `COARSEST` of the largest reading.

    Args:
        readings: readings [SI].
        channel: the channel.
    """
    step = common_step(readings)
    levels = np.unique(readings[np.isfinite(readings)]) / channel.factor
    if step or not 2 <= levels.size < FEWEST:
        return step
    largest = float(np.max(np.abs(levels)))
    powers = 10.0 ** np.arange(math.floor(math.log10(COARSEST * largest)), math.log10(SMALLEST * largest), -1)
    fits = [p for p in powers if np.all(np.abs(levels / p - np.round(levels / p)) < 1e-6)]
    return float(fits[0] * channel.factor) if fits else 0.0


def infer_instruments(instruments: tuple[Instrument, ...], columns: Columns) -> tuple[Instrument, ...]:
    """Instruments whose sign and resolution are inferred from the readings, where they are not stated.

    An instrument shows only the magnitude if no reading is negative although some runs go backward.

    Args:
        columns: columns of the table, in their units.
    """
    runs_backward = any(
        (columns[c] < 0).any() for c in ("supply_voltage_V", "motor_speed_rpm", "duty") if c in columns
    )
    inferred = []
    for instrument in instruments:
        channel = channels.find_channel(instrument.channel)
        readings = columns.get(channel.column, np.zeros(0))
        signed, quantum = instrument.signed, instrument.quantum
        if signed is None:
            signed = not runs_backward or bool((readings < 0).any())
        if quantum is None:
            quantum = common_step(readings) * channel.factor
        inferred.append(Instrument(instrument.channel, signed, quantum))
    return tuple(inferred)


def with_inferred_instruments(robot: Robot, runs: Runs) -> Robot:
    """Robot with the instruments inferred from its table."""
    rig_instruments = robot.rig.instruments
    all_instruments = runs.layout.instruments if any(i.free for i in rig_instruments) else rig_instruments
    channel_names = {i.channel for i in all_instruments}
    all_instruments = (*all_instruments, *(i for i in runs.layout.instruments if i.channel not in channel_names))
    if all_instruments == rig_instruments:
        return robot
    return dataclasses.replace(robot, rig=dataclasses.replace(robot.rig, instruments=all_instruments))
