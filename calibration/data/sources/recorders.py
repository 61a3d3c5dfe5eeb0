"""Files of recorders with their own clocks: MDF version 4 and 3, ULog of PX4, and WPILOG of WPILib."""

from __future__ import annotations

import collections
import contextlib
import functools
import io
import logging
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data import input_files
from calibration.data.input_errors import BadData
from calibration.data.sources.recorded_signals import Clock, Signal, refused_signal, values_in_memory


def signals_of_mdf(path: Path, name: str) -> tuple[Signal, ...]:
    """Signals of an MDF file by channel, or `group/channel` if groups share a channel name."""
    signals: list[Signal] = []
    with _opened(path) as file:
        count = collections.Counter(c.name for g in file.groups for c in g.channels)
        for k, group in enumerate(file.groups):
            master, clock = file.masters_db.get(k), None
            if master is not None:
                clock = Clock(group.channels[master].name, functools.partial(_time, path, k), "s")
            title = str(getattr(group.channel_group, "acq_name", "") or f"group{k}")
            for j, channel in enumerate(group.channels):
                if j != master:
                    channel_path = channel.name if count[channel.name] == 1 else f"{title}/{channel.name}"
                    load, unit = functools.partial(_column, path, k, j), file.get_channel_unit(group=k, index=j)
                    signals.append(Signal(channel_path, group.channel_group.cycles_nr, load, unit or "", clock))
    clock = signals[0].clock if signals else None
    if clock is None or any(s.clock is not clock for s in signals):
        return tuple(signals)
    table = (replace(s, clock=None) for s in signals)
    return (Signal("time_s", signals[0].length, clock.load, "s"), *table)


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


def _time(path: Path, group: int) -> np.ndarray:
    with _opened(path) as file:
        return np.array(file.get_master(group))


def _column(path: Path, group: int, index: int) -> np.ndarray:
    with _opened(path) as file:
        samples = file.get(group=group, index=index, ignore_invalidation_bits=True)  # otherwise they are omitted
    invalid = samples.invalidation_bits
    values = np.asarray(samples.samples)
    return values if invalid is None else np.ma.masked_array(values, np.asarray(invalid, bool))


#: Bytes before the first message.
ULOG_HEADER = 16
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
    for topic_data in log.data_list:
        topic, fields = topic_data.name, dict(topic_data.data)
        if topic_data.multi_id:
            topic = f"{topic}[{topic_data.multi_id}]"
        clock = Clock(f"{topic}.timestamp", values_in_memory(fields.pop("timestamp")), "us")
        for field, values in fields.items():
            signals.append(Signal(f"{topic}.{field}", len(values), values_in_memory(values), "", clock))
    return tuple(signals)


def _check_messages(path: Path, name: str) -> dict[str, list[tuple[str, int]]]:
    """Returns the type and number of the fields of each topic.

    Raises:
        BadData: the file ends within a message. The library does not report that.
    """
    formats: dict[str, list[tuple[str, int]]] = {}
    content, byte = input_files.file_bytes(path, name, largest=path.stat().st_size), ULOG_HEADER
    while byte < len(content):
        begin = byte + 3
        end = begin + int.from_bytes(content[byte : byte + 2], "little")
        if max(begin, end) > len(content):
            raise _cut_off(name, "message", byte, len(content))
        if content[begin - 1 : begin] == b"F":
            topic, _, fields = content[begin:end].decode("utf-8", "replace").partition(":")
            formats[topic] = [(kind, int(count or 1)) for kind, count in _FIELD.findall(fields)]
        byte = end
    return formats


def _cut_off(name: str, unit: str, byte: int, size: int) -> BadData:
    """Error of a file that ends within a message or a record."""
    return BadData(
        f"{name}: ends within a {unit}, at byte {byte} of {size}, as if it was cut off; copy it again, or keep the "
        f"complete {unit}s: head -c {byte} {name}"
    )


def _field_count(topic: str, formats: dict[str, list[tuple[str, int]]], sizes: dict[str, int]) -> int:
    """Number of fields in a topic, counting each element of an array and of a nested topic."""
    if topic not in formats:
        return 1
    if topic not in sizes:
        sizes[topic] = sum(n * _field_count(kind, formats, sizes) for kind, n in formats[topic])
    return sizes[topic]


#: Bytes before the extra header. Type of the control records (of entry 0) that start an entry.
HEADER, START = 12, 0
#: Memory of the records, as a multiple of the file.
OBJECTS = 10
#: Entry types with one number per record. Other types are listed but cannot be read.
NUMBERS = {"double": "<f8", "float": "<f4", "int64": "<i8", "boolean": "?"}
WORDS = ("string", "json")
#: State of a SysId routine between its tests.
BETWEEN_TESTS = "none"


def signals_of_wpilog(path: Path, name: str) -> tuple[Signal, ...]:
    """Signals of a WPILOG file of version 1, each with its stamps since the robot's start.

    Source: wpiutil/doc/datalog.adoc of github.com/wpilibsuite/allwpilib.

    Raises:
        BadData: the version is another, or a record does not end within the file.
    """
    content = input_files.file_bytes(path, name)
    input_files.check_memory(name, OBJECTS * len(content))
    if content[7:8] != b"\x01":
        raise BadData(f"{name}: is a WPILOG file with a version other than 1; export it as CSV with DataLogTool")
    record_start = HEADER + int.from_bytes(content[8:HEADER], "little")
    entries: dict[int, tuple[str, str, list[int], list[bytes]]] = {}
    while record_start < len(content):
        sizes = content[record_start]
        lengths = (sizes & 3) + 1, (sizes >> 2 & 3) + 1, (sizes >> 4 & 7) + 1
        fields, begin = [], record_start + 1
        for length in lengths:
            fields.append(int.from_bytes(content[begin : begin + length], "little"))
            begin += length
        entry, size, stamp = fields
        if begin + size > len(content):
            raise _cut_off(name, "record", record_start, len(content))
        payload, record_start = content[begin : begin + size], begin + size
        if entry == 0 and payload[:1] == bytes([START]):
            number = int.from_bytes(payload[1:5], "little")
            entries[number] = (*_name_and_type(payload[5:]), [], [])
        elif entry in entries:
            _, kind, stamps, payloads = entries[entry]
            width = np.dtype(NUMBERS.get(kind, "V0")).itemsize
            if width in (0, size):
                stamps.append(stamp)
                payloads.append(payload if width or kind in WORDS else b"")
    clocks: dict[bytes, Clock] = {}
    return tuple(_wpilog_signal(*entry, clocks) for entry in entries.values() if entry[2])


def _wpilog_signal(
    name: str, kind: str, recorded: list[int], payloads: list[bytes], clocks: dict[bytes, Clock]
) -> Signal:
    """Values of an entry, with a clock in µs that entries with the same stamps share."""
    if kind in NUMBERS:
        values = np.frombuffer(b"".join(payloads), NUMBERS[kind])
    elif kind in WORDS:
        values = np.array([p.decode("utf-8", "replace") for p in payloads])
    else:
        return refused_signal(name, len(recorded), f"has the type {kind}, which is not supported")
    stamps = np.array(recorded)
    if name.startswith("sysid-test-state-"):  # the end of a test has the stamp of its last sample
        in_test = values != BETWEEN_TESTS
        values, stamps = values[in_test], stamps[in_test]
    clock = clocks.setdefault(stamps.tobytes(), Clock(f"{name} (time)", values_in_memory(stamps), "us"))
    return Signal(name, len(values), values_in_memory(values), "", clock, kind in WORDS)


def _name_and_type(payload: bytes) -> tuple[str, str]:
    """Name and type at the beginning of a payload, each preceded by its length."""
    texts = []
    for _ in range(2):
        length = int.from_bytes(payload[:4], "little")
        texts.append(payload[4 : 4 + length].decode("utf-8", "replace"))
        payload = payload[4 + length :]
    return texts[0], texts[1]
