"""MDF version 4 (and 3), the measurement files of test benches and vehicles."""

from __future__ import annotations

import collections
import contextlib
import logging
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data.sources.recorded_signals import Clock, Load, Signal


def signals_of_mdf(path: Path, name: str) -> tuple[Signal, ...]:
    """Signals of an MDF file by channel, or `group/channel` if groups share a channel name."""
    signals: list[Signal] = []
    with _opened(path) as file:
        count = collections.Counter(c.name for g in file.groups for c in g.channels)
        for k, group in enumerate(file.groups):
            master = file.masters_db.get(k)
            rows = group.channel_group.cycles_nr
            title = str(getattr(group.channel_group, "acq_name", "") or f"group{k}")
            clock = None if master is None else Clock(group.channels[master].name, _time(path, k), "s")
            for j, channel in enumerate(group.channels):
                if j == master:
                    continue
                channel_path = channel.name if count[channel.name] == 1 else f"{title}/{channel.name}"
                unit = file.get_channel_unit(group=k, index=j) or ""
                signals.append(Signal(channel_path, rows, _column(path, k, j), unit, clock))
    clocks = {id(s.clock) for s in signals}
    if len(clocks) == 1 and signals and signals[0].clock is not None:  # a table
        time = signals[0].clock
        signals = [
            Signal("time_s", signals[0].length, time.load, "s"),
            *(Signal(s.path, s.length, s.load, s.unit) for s in signals),
        ]
    return tuple(signals)


@contextlib.contextmanager
def _opened(path: Path) -> Any:
    from asammdf import MDF

    logging.getLogger("asammdf").setLevel(logging.CRITICAL)  # this program reports its errors
    with path.open("rb") as stream:  # if given a path, it may create and remove other files
        try:
            file = MDF(stream)
        except Exception as error:
            _close_half_made(error)
            raise
        with file:
            yield file


def _close_half_made(error: BaseException) -> None:
    """Marks the object of a file that could not be opened as closed, because closing it would print an error."""
    frame = error.__traceback__
    while frame is not None:
        for local_value in frame.tb_frame.f_locals.values():
            if type(local_value).__module__.startswith("asammdf.") and hasattr(local_value, "_closed"):
                local_value._closed = True
                if (temporary := getattr(local_value, "_tempfile", None)) is not None:
                    temporary.close()
        frame = frame.tb_next


def _time(path: Path, group: int) -> Load:
    def load() -> np.ndarray:
        with _opened(path) as file:
            return np.array(file.get_master(group))

    return load


def _column(path: Path, group: int, index: int) -> Load:
    def load() -> np.ndarray:
        with _opened(path) as file:
            samples = file.get(group=group, index=index, ignore_invalidation_bits=True)  # otherwise they are omitted
        invalid = samples.invalidation_bits
        values = np.asarray(samples.samples)
        return values if invalid is None else np.ma.masked_array(values, np.asarray(invalid, bool))

    return load
