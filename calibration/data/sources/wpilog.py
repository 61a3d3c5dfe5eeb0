"""WPILOG, the data logs of WPILib: entries with a name, a type and stamped values."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from calibration.data import input_files
from calibration.data.input_errors import BadData
from calibration.data.sources.recorded_signals import Clock, Signal, values_in_memory

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
            raise BadData(
                f"{name}: ends within a record, at byte {record_start} of {len(content)}, as if it was cut off; "
                f"copy it again, or keep the complete records: head -c {record_start} {name}"
            )
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
