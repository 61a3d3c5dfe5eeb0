"""ULog, the logs of PX4: fields of the messages of each topic."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data import input_files
from calibration.data.input_errors import BadData
from calibration.data.sources.recorded_signals import Clock, Load, Signal

#: Bytes before the first message.
HEADER = 16
#: Type of a field, and number of its elements.
_FIELD = re.compile(r"([^;\[\] ]+)(?:\[(\d+)\])? [^;]+")


def signals_of_ulog(path: Path, name: str) -> tuple[Signal, ...]:
    """Signals of a ULog file: `topic.field`, for a second instance `topic[1].field`. Time counts from boot.

    Raises:
        BadData: the file is damaged.
    """
    from pyulog import ULog

    input_files.check_memory(name, path.stat().st_size)
    formats = _check_messages(path, name)
    sizes: dict[str, int] = {}
    for topic in formats:
        input_files.check_declared(name, _field_count(topic, formats, sizes))
    # the library prints damage to stdout, and leaves a file open that it cannot parse
    with path.open("rb") as stream, contextlib.redirect_stdout(io.StringIO()):
        log = ULog(stream)
    if log.file_corruption or not log.data_list:
        raise BadData(f"{name}: is a damaged or empty ULog file; download it again from the autopilot")
    signals = []
    for data in log.data_list:
        topic = data.name if data.multi_id == 0 else f"{data.name}[{data.multi_id}]"
        clock = Clock(f"{topic}.timestamp", _column(data, "timestamp"), "us")
        for field in data.data:
            if field != "timestamp":
                values = data.data[field]
                signals.append(Signal(f"{topic}.{field}", len(values), _column(data, field), "", clock))
    return tuple(signals)


def _check_messages(path: Path, name: str) -> dict[str, list[tuple[str, int]]]:
    """Returns the type and number of the fields of each topic.

    Raises:
        BadData: the file ends within a message. The library does not report that.
    """
    formats: dict[str, list[tuple[str, int]]] = {}
    size, byte = path.stat().st_size, HEADER
    with path.open("rb") as stream:
        stream.seek(byte)
        block, begin = b"", byte
        while byte < size:
            if byte - begin + 3 + 2**16 > len(block) and begin + len(block) < size:
                stream.seek(byte)
                block, begin = stream.read(2**22), byte
            if len(block) - (byte - begin) < 3:
                break
            next_message = byte + 3 + int.from_bytes(block[byte - begin : byte - begin + 2], "little")
            if next_message > size:
                break
            if block[byte - begin + 2 : byte - begin + 3] == b"F":
                topic, _, fields = (
                    block[byte - begin + 3 : next_message - begin].decode("utf-8", "replace").partition(":")
                )
                formats[topic] = [(kind, int(count or 1)) for kind, count in _FIELD.findall(fields)]
            byte = next_message
    if byte != size:
        raise BadData(
            f"{name}: ends within a message, at byte {byte} of {size}, as if it was cut off; copy it again, or "
            f"keep the complete messages: head -c {byte} {name}"
        )
    return formats


def _field_count(topic: str, formats: dict[str, list[tuple[str, int]]], sizes: dict[str, int]) -> int:
    """Number of fields in a topic, counting each element of an array and of a nested topic."""
    if topic not in sizes:
        nested_format = formats.get(topic)
        sizes[topic] = (
            1 if nested_format is None else sum(n * _field_count(kind, formats, sizes) for kind, n in nested_format)
        )
    return sizes[topic]


def _column(data: Any, field: str) -> Load:
    return lambda: np.asarray(data.data[field])
