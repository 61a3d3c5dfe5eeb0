"""Channels: the quantities that an instrument can show. Importable without jax.

The rig decides which channels exist: a robot (`Robot.channels`), a table of its runs (`Runs.channels`) and each
result carry them, in the order of `EVERY`.
"""

from __future__ import annotations

from collections.abc import Iterable

from mmrjax.model.quantities import SIDES as SIDES
from mmrjax.model.quantities import TABLE, Channel, channel_rows

#: All channels, and those of robots that turn: of each side, and of the motion in the plane.
EVERY = channel_rows()
OF_TURNS = EVERY[len(TABLE["channel"]) :]

#: Channels of a robot whose file states none.
USUAL = ("total_current", "motor_speed", "speed")


def channels_named(names: Iterable[str]) -> tuple[Channel, ...]:
    """The channels of these names, in the order of `EVERY`, which columns, arrays and reports follow.

    Raises:
        KeyError: no such channel.
    """
    wanted_names = set(names)
    if unknown := wanted_names - {c.name for c in EVERY}:
        raise KeyError(f"no channel {min(unknown)}; there are {', '.join(c.name for c in EVERY)}")
    return tuple(c for c in EVERY if c.name in wanted_names)


def usual_channels() -> tuple[Channel, ...]:
    """The channels of a robot without a rig."""
    return channels_named(USUAL)


def find_channel(name: str) -> Channel:
    """The channel with this name.

    Raises:
        KeyError: no such channel.
    """
    return channels_named((name,))[0]


def channel_names(channels: Iterable[Channel]) -> tuple[str, ...]:
    """Names of the channels, in order."""
    return tuple(c.name for c in channels)


def channel_index(name: str, channels: Iterable[Channel]) -> int:
    """Position of a channel in arrays over the channels `channels`.

    Raises:
        KeyError: `channels` does not contain the channel.
    """
    names = channel_names(channels)
    if name not in names:
        raise KeyError(f"no channel {name}; there are {', '.join(names)}")
    return names.index(name)
