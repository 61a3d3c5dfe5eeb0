"""The table of channels: everything that an instrument can show, one row each. No other room counts them.

Importable without jax. A new channel is a row of `CHANNELS`; files, noise, fits, reports and sensor effects follow.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mmrjax.robot import Robot
    from mmrjax.signals import Signals

RPM = math.pi / 30  # rad/s
MM = 1e-3  # m


@dataclasses.dataclass(frozen=True)
class Channel:
    """One channel.

    Attributes:
        name: key of its readings, field of results; noun first.
        column, sd_column: in tables of runs, with the unit in the name.
        unit: of those columns; factor: the SI value of one such unit.
        label: words of reports.
        word: short name that `--noise` takes.
        range: least and largest reading that a table may hold [unit]; sd_largest: largest sd [unit].
        read: what of the signals an ideal instrument shows [SI].
        sd_share: sd that is assumed where none is known, as a share of the reading [-].
        resolution: digits after the point that a person wants to see [unit].
        unit_si: of readings inside; empty where `factor` is 1.
        zero_at_rest: whether it shows 0 until the robot moves.
        other_units: what is often written in its column by mistake, and the SI value of each.
    """

    name: str
    column: str
    sd_column: str
    unit: str
    factor: float
    label: str
    word: str
    range: tuple[float, float]
    sd_largest: float
    read: Callable[[Robot, Signals], Any]
    sd_share: float
    resolution: int = 1
    unit_si: str = ""
    zero_at_rest: bool = False
    other_units: tuple[tuple[str, float], ...] = ()


#: In the order of columns, arrays and reports. Read through the module (`channels.CHANNELS`), so that a row more
#: is a row more everywhere.
CHANNELS: tuple[Channel, ...] = (
    Channel(
        name="total_current",
        column="total_current_A",
        sd_column="total_current_sd_A",
        unit="A",
        factor=1.0,
        label="total current",
        word="current",
        range=(-200.0, 200.0),
        sd_largest=100.0,
        read=lambda robot, signals: signals.total_current,
        sd_share=0.02,
        resolution=3,
        other_units=(("mA", 1e-3),),
    ),
    Channel(
        name="motor_speed",
        column="motor_speed_rpm",
        sd_column="motor_speed_sd_rpm",
        unit="rpm",
        factor=RPM,
        label="motor speed",
        word="motor_speed",
        range=(-30_000.0, 30_000.0),
        sd_largest=10_000.0,
        read=lambda robot, signals: signals.speed_motor,
        sd_share=0.005,
        unit_si="rad/s",
        zero_at_rest=True,
        other_units=(("rad/s", 1.0), ("turns/s", 2 * math.pi), ("deg/s", math.pi / 180)),
    ),
    Channel(
        name="speed",
        column="speed_mm_s",
        sd_column="speed_sd_mm_s",
        unit="mm/s",
        factor=MM,
        label="speed",
        word="speed",
        range=(-10_000.0, 10_000.0),
        sd_largest=5_000.0,
        read=lambda robot, signals: signals.speed,
        sd_share=0.01,
        unit_si="m/s",
        zero_at_rest=True,
        other_units=(("m/s", 1.0), ("km/h", 1 / 3.6), ("cm/s", 1e-2), ("m/min", 1 / 60)),
    ),
)


def names() -> tuple[str, ...]:
    """Names of all channels, in order."""
    return tuple(c.name for c in CHANNELS)


def index(name: str) -> int:
    """Position of a channel in arrays.

    Raises:
        KeyError: no such channel.
    """
    for k, channel in enumerate(CHANNELS):
        if channel.name == name:
            return k
    raise KeyError(f"no channel {name}; there are {', '.join(names())}")


def factors() -> tuple[float, ...]:
    """SI value of one unit of each channel's column."""
    return tuple(c.factor for c in CHANNELS)
