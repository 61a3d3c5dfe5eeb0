"""Files of recorders with their own clocks: MDF version 4 and 3, ULog of PX4, and WPILOG of WPILib."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import io
import logging
import re
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data import input_files
from calibration.data.input_errors import BadData
from calibration.data.sources.recorded_signals import Clock, Load, Signal, values_in_memory


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
    for data in log.data_list:
        topic = data.name if data.multi_id == 0 else f"{data.name}[{data.multi_id}]"
        clock = Clock(f"{topic}.timestamp", _field_values(data, "timestamp"), "us")
        for field in data.data:
            if field != "timestamp":
                values = data.data[field]
                signals.append(Signal(f"{topic}.{field}", len(values), _field_values(data, field), "", clock))
    return tuple(signals)


def _check_messages(path: Path, name: str) -> dict[str, list[tuple[str, int]]]:
    """Returns the type and number of the fields of each topic.

    Raises:
        BadData: the file ends within a message. The library does not report that.
    """
    formats: dict[str, list[tuple[str, int]]] = {}
    size, byte = path.stat().st_size, ULOG_HEADER
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
        raise _cut_off(name, "message", byte, size)
    return formats


def _cut_off(name: str, unit: str, byte: int, size: int) -> BadData:
    """Error of a file that ends within a message or a record."""
    return BadData(
        f"{name}: ends within a {unit}, at byte {byte} of {size}, as if it was cut off; copy it again, or keep the "
        f"complete {unit}s: head -c {byte} {name}"
    )


def _field_count(topic: str, formats: dict[str, list[tuple[str, int]]], sizes: dict[str, int]) -> int:
    """Number of fields in a topic, counting each element of an array and of a nested topic."""
    if topic not in sizes:
        nested_format = formats.get(topic)
        sizes[topic] = (
            1 if nested_format is None else sum(n * _field_count(kind, formats, sizes) for kind, n in nested_format)
        )
    return sizes[topic]


def _field_values(data: Any, field: str) -> Load:
    return lambda: np.asarray(data.data[field])


#: Bytes before the extra header. Type of the control records (of entry 0) that start an entry.
HEADER, START = 12, 0
#: Memory of the records, as a multiple of the file.
OBJECTS = 10
#: Entry types with one number per record. Other types are listed but cannot be read.
NUMBERS = {"double": "<f8", "float": "<f4", "int64": "<i8", "boolean": "?"}
WORDS = ("string", "json")
#: State of a SysId routine between its tests.
BETWEEN_TESTS = "none"


@dataclasses.dataclass
class _Entry:
    name: str
    kind: str
    stamps: list[int] = dataclasses.field(default_factory=list)
    payloads: list[bytes] = dataclasses.field(default_factory=list)

    def signal(self, clocks: dict[bytes, Clock]) -> Signal:
        """The entry's values, with a clock in µs that entries with the same stamps share."""
        if self.kind in NUMBERS:
            values = np.frombuffer(b"".join(self.payloads), NUMBERS[self.kind])
        elif self.kind in WORDS:
            values = np.array([p.decode("utf-8", "replace") for p in self.payloads])
        else:
            return Signal(
                self.name,
                len(self.stamps),
                lambda: np.zeros(0),
                refused=f"has the type {self.kind}, which is not supported",
            )
        stamps = np.array(self.stamps)
        if self.name.startswith("sysid-test-state-"):  # the end of a test has the stamp of its last sample
            in_test = values != BETWEEN_TESTS
            values, stamps = values[in_test], stamps[in_test]
        clock = clocks.setdefault(stamps.tobytes(), Clock(f"{self.name} (time)", values_in_memory(stamps), "us"))
        return Signal(self.name, len(values), values_in_memory(values), "", clock, self.kind in WORDS)


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
    entries: dict[int, _Entry] = {}
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
            number, (title, kind) = int.from_bytes(payload[1:5], "little"), _name_and_type(payload[5:])
            entries[number] = _Entry(title, kind)
        elif entry in entries and (width := np.dtype(NUMBERS.get(entries[entry].kind, "V0")).itemsize) in (0, size):
            entries[entry].stamps.append(stamp)
            entries[entry].payloads.append(payload if width or entries[entry].kind in WORDS else b"")
    clocks: dict[bytes, Clock] = {}
    return tuple(entry.signal(clocks) for entry in entries.values() if entry.stamps)


def _name_and_type(payload: bytes) -> tuple[str, str]:
    """Name and type at the beginning of a payload, each preceded by its length."""
    texts = []
    for _ in range(2):
        length = int.from_bytes(payload[:4], "little")
        texts.append(payload[4 : 4 + length].decode("utf-8", "replace"))
        payload = payload[4 + length :]
    return texts[0], texts[1]
