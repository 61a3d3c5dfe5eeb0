"""ULog, the logs of PX4: fields of the messages of each topic."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data import input_files
from calibration.data.input_errors import BadData
from calibration.data.sources.recorded_signals import Clock, Signal

#: Bytes before the first message.
HEADER = 16
#: Type of a field, and number of its elements.
_FIELD = re.compile(r"([^;\[\] ]+)(?:\[(\d+)\])? [^;]+")


def of_ulog(path: Path, name: str) -> tuple[Signal, ...]:
    """Signals of a ULog file, `topic.field`, of a second instance `topic[1].field`. Time counts from the boot.

    Raises:
        BadData: a damaged file.
    """
    from pyulog import ULog

    input_files.check_memory(name, path.stat().st_size)
    formats = _check_messages(path, name)
    sizes: dict[str, int] = {}
    for topic in formats:
        input_files.check_declared(name, _field_count(topic, formats, sizes))
    # the library reports damage to stdout, and leaves a file open that it opened and cannot parse
    with path.open("rb") as stream, contextlib.redirect_stdout(io.StringIO()):
        log = ULog(stream)
    if log.file_corruption or not log.data_list:
        raise BadData(
            f"{name}: is a damaged ULog file, or one without data; expected a whole log; download it again from the "
            "autopilot"
        )
    found = []
    for data in log.data_list:
        topic = data.name if data.multi_id == 0 else f"{data.name}[{data.multi_id}]"
        clock = Clock(f"{topic}.timestamp", _column(data, "timestamp"), "us")
        for field in data.data:
            if field != "timestamp":
                values = data.data[field]
                found.append(Signal(f"{topic}.{field}", len(values), _column(data, field), "", clock))
    return tuple(found)


def _check_messages(path: Path, name: str) -> dict[str, list[tuple[str, int]]]:
    """Returns the type and number of the fields of each topic.

    Raises:
        BadData: the file ends within a message. The library does not report that.
    """
    formats: dict[str, list[tuple[str, int]]] = {}
    size, at = path.stat().st_size, HEADER
    with path.open("rb") as stream:
        stream.seek(at)
        block, begin = b"", at
        while at < size:
            if at - begin + 3 + 2**16 > len(block) and begin + len(block) < size:
                stream.seek(at)
                block, begin = stream.read(2**22), at
            if len(block) - (at - begin) < 3:
                break
            after = at + 3 + int.from_bytes(block[at - begin : at - begin + 2], "little")
            if after > size:
                break
            if block[at - begin + 2 : at - begin + 3] == b"F":
                topic, _, fields = block[at - begin + 3 : after - begin].decode("utf-8", "replace").partition(":")
                formats[topic] = [(kind, int(count or 1)) for kind, count in _FIELD.findall(fields)]
            at = after
    if at != size:
        raise BadData(
            f"{name}: ends within a message, at byte {at} of {size}, as if it is cut off; copy it again, or if the "
            f"recorder lost its power, keep the whole messages: head -c {at} {name}"
        )
    return formats


def _field_count(topic: str, formats: dict[str, list[tuple[str, int]]], sizes: dict[str, int]) -> int:
    """Number of the fields of a topic, each element of an array and of a nested topic separately."""
    if topic not in sizes:
        inner = formats.get(topic)
        sizes[topic] = 1 if inner is None else sum(n * _field_count(kind, formats, sizes) for kind, n in inner)
    return sizes[topic]


def _column(data: Any, field: str) -> Callable[[], np.ndarray]:
    return lambda: np.asarray(data.data[field])
