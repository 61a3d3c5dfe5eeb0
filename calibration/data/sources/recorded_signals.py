"""Signals of a recording: each has a path, values that are read when needed, and possibly its own clock."""

from __future__ import annotations

import fnmatch
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np

from calibration.data import Names, input_files
from calibration.data.input_errors import BadData
from mmrjax.errors import similar_words

#: Function that reads the values of a signal from its source.
Load: TypeAlias = Callable[[], np.ndarray]
#: Shape and type of an array, and a function that loads it.
StoredArray: TypeAlias = tuple[tuple[int, ...], np.dtype, Load]
#: Last parts of paths that mark time stamps, without unit.
CLOCKS = ("time", "t", "timestamp", "timestamps", "stamp", "elapsed", "clock", "timestamp_sample")
#: Units that the name of a clock may end with, and their value in seconds.
UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}
#: Column with the run of each row, if a source has several runs.
RUN = "run_id"
#: Most paths that a message lists.
LISTED = 12
#: Separators of the parts of a path.
_PARTS = re.compile(r"[/.]|::")
_UNIT_OF_CLOCK = re.compile(r"(?:[_ ]?[\[(]?)(s|ms|us|µs|ns|sec|seconds|millis|micros)[\])]?$", re.IGNORECASE)
_COUNTS = {"millis": "ms", "micros": "us", "nanos": "ns"}
_WORDS_OF_UNITS = {"sec": "s", "seconds": "s", "millis": "ms", "micros": "us"}


@dataclass(frozen=True)
class Clock:
    """Time stamps that several signals share.

    Attributes:
        name: path of the time stamps, for messages.
        load: function that returns the time stamps, shape (n,), numbers or `datetime64`.
        unit: unit of the numbers, a key of `UNITS`, empty if the recording does not state it.
    """

    name: str
    load: Load
    unit: str = ""


@dataclass(frozen=True)
class Signal:
    """One signal of a recording.

    Attributes:
        path: its name in the recording.
        length: number of its samples.
        load: function that returns the values, shape (length,): numbers, words or `datetime64`.
        unit: unit that the recording states, empty if it states none.
        clock: its clock. None: its samples are rows of a table.
        words: True if the values are text.
        refused: reason why it cannot be read, empty if it can.
        size: memory that `load` needs [bytes]. 0: memory of `length` numbers.
    """

    path: str
    length: int
    load: Load
    unit: str = ""
    clock: Clock | None = None
    words: bool = False
    refused: str = ""
    size: float = 0.0

    def __post_init__(self) -> None:
        """Replaces code points in path and unit that text files cannot hold."""
        for field in ("path", "unit"):
            object.__setattr__(self, field, encodable_text(getattr(self, field)))

    @property
    def name(self) -> str:
        """Last part of the path."""
        return path_parts(self.path)[-1]


def encodable_text(text: str) -> str:
    """Returns a text with ? in the place of code points that UTF-8 cannot encode (lone surrogates)."""
    return text.encode("utf-8", "replace").decode()


def refused_type(dtype: np.dtype) -> str:
    """Reason why values of a type cannot be read, empty if they can."""
    if dtype.kind in "biufUSMm":
        return ""
    kinds = {"O": "objects", "c": "complex numbers", "V": "raw bytes"}
    return f"holds {kinds.get(dtype.kind, f'values of type {dtype}')}; expected numbers or words"


def plain_values(values: np.ndarray) -> np.ndarray:
    """Returns numbers, dates or words without a mask: a masked entry is a missing reading."""
    kind = values.dtype.kind
    if isinstance(values, np.ma.MaskedArray):
        missing = values.dtype.type("NaT") if kind in "mM" else "" if kind == "U" else b"" if kind == "S" else np.nan
        values = np.ma.filled(values.astype(float) if kind in "biu" else values, missing)
    if kind == "S":
        values = np.char.decode(values, "utf-8", "replace")
    try:
        "".join(values.tolist() if values.dtype.kind == "U" else ()).encode()
    except UnicodeEncodeError:
        values = np.array([encodable_text(word) for word in values.tolist()])
    return values


def values_in_memory(values: np.ndarray) -> Load:
    """Returns a function that returns the given values."""
    return lambda: values


def array_in_memory(values: np.ndarray) -> StoredArray:
    """Description of an array in memory."""
    return values.shape, values.dtype, values_in_memory(values)


def refused_signal(path: str, length: int, why: str) -> Signal:
    """Signal that cannot be read, for the reason `why`."""
    return Signal(path, length, lambda: np.empty(0), refused=why)


def part_of(load: Callable[[], Any], key: Any) -> Load:
    """Returns a function that loads something and returns its part with this key."""
    return lambda: load()[key]


def path_parts(path: str) -> list[str]:
    """Returns the parts of a path, separated by slashes, points or double colons."""
    return [part for part in _PARTS.split(path) if part] or [path]


def matching_signals(signals: Iterable[Signal], name: str) -> list[Signal]:
    """Signals that match a name: the signal with this path, otherwise signals whose path ends with its parts.

    A `*` in the name matches any text.
    """
    pool = list(signals)
    if "*" in name:
        return [s for s in pool if fnmatch.fnmatchcase(s.path, name)]
    if exact := [s for s in pool if s.path == name]:
        return exact
    name_parts = path_parts(name)
    return [s for s in pool if path_parts(s.path)[-len(name_parts) :] == name_parts]


def find_signal(signals: Sequence[Signal], name: str, where: str) -> Signal:
    """The only signal that matches a name.

    Raises:
        BadData: no signal matches, or several match.
    """
    matches = matching_signals(signals, name)
    if len(matches) == 1:
        return matches[0]
    if matches:
        paths_text = ", ".join(s.path for s in matches[:8])
        raise BadData(
            f"{where}, {name}: the name fits {len(matches)} signals, {paths_text}; give the path of one of them"
        )
    raise BadData(f"{where}, {name}: no such signal; {suggested_paths(name, [s.path for s in signals])}")


def suggested_paths(name: str, paths: Sequence[str]) -> str:
    """Hint for an unknown name: up to three similar paths, otherwise the first `LISTED` paths."""
    similar = similar_words(name, paths, 3)
    if similar:
        return f"did you mean {', '.join(similar)}?"
    return f"it has {', '.join(paths[:LISTED])}{', ...' if len(paths) > LISTED else ''}"


def unit_of_clock(name: str) -> str | None:
    """Unit in the name of a clock, empty if it states none, None if it is no name of a clock."""
    plain_name = name.strip().casefold()
    if plain_name in CLOCKS:
        return ""
    if plain_name in _COUNTS:
        return _COUNTS[plain_name]
    match = _UNIT_OF_CLOCK.search(plain_name)
    if match and plain_name[: match.start()].rstrip("_ ") in CLOCKS:
        return _WORDS_OF_UNITS.get(match[1], match[1].replace("µ", "u"))
    return None


def signals_of_arrays(
    source: str, arrays: Mapping[str, StoredArray], units: Mapping[str, str] | None = None
) -> tuple[Signal, ...]:
    """Signals of named arrays. Each column of an array of two dimensions is a separate signal, `name[0]`.

    The clock of an array is the equally long clock in its group, otherwise the only other clock of that length. A
    clock is an array that is named like one (`unit_of_clock`). Arrays without a clock form a table, as do all arrays
    if they are equally long.

    Args:
        source: name of the recording, for messages.
        arrays: arrays by path.
        units: units that the recording states, by path.

    Raises:
        BadData: too many columns (`input_files.check_declared`).
    """
    input_files.check_declared(source, sum(_column_count(*array[:2]) for array in arrays.values()))
    lengths = {path: sample_count(shape) for path, (shape, *_) in arrays.items()}
    clocks: dict[int, dict[str, Clock]] = {}
    if len({n for n in lengths.values() if n > 1}) > 1:
        for path, (shape, dtype, load) in arrays.items():
            unit = unit_of_clock(path_parts(path)[-1])
            if unit is not None and dtype.kind in "iufM" and sum(n > 1 for n in shape) == 1:
                clocks_by_group = clocks.setdefault(lengths[path], {})
                clocks_by_group.setdefault(parent_path(path), Clock(path, _flattened(load), unit))
    signals: list[Signal] = []
    for path, array in arrays.items():
        clocks_by_group = clocks.get(lengths[path], {})
        only_clock = next(iter(clocks_by_group.values())) if len(clocks_by_group) == 1 else None
        clock = clocks_by_group.get(parent_path(path), only_clock)
        signals += _signals_of_array(path, *array, (units or {}).get(path, ""), clock)
    return tuple(signals)


def parent_path(path: str) -> str:
    """Path without its last part."""
    last_part = path_parts(path)[-1]
    return path[: len(path) - len(last_part)] if path.endswith(last_part) else ""


def sample_count(shape: tuple[int, ...]) -> int:
    """Number of samples of an array: its first dimension, or the second if it is a single row."""
    if not shape:
        return 1
    return shape[1] if len(shape) == 2 and shape[0] == 1 else shape[0]


def _column_count(shape: tuple[int, ...], dtype: np.dtype) -> int:
    columns = shape[1] if len(shape) == 2 and 1 not in shape else 1
    return columns * sum(_column_count((), dtype[name]) for name in dtype.names) if dtype.names else columns


def _flattened(load: Load) -> Load:
    return lambda: np.ravel(load())


def _signals_of_array(
    path: str, shape: tuple[int, ...], dtype: np.dtype, load: Load, unit: str, clock: Clock | None
) -> list[Signal]:
    if dtype.names:
        fields = [_signals_of_array(f"{path}.{n}", shape, dtype[n], part_of(load, n), "", clock) for n in dtype.names]
        return [signal for signals in fields for signal in signals]
    is_text, refused = dtype.kind in "US", refused_type(dtype)
    if not refused and len(shape) > 2:
        refused = f"has {len(shape)} dimensions; expected one, or two for several signals"
    size = float(math.prod(shape)) * max(dtype.itemsize, input_files.VALUE)
    parts = {path: _flattened(load)}
    if not refused and len(shape) == 2 and 1 not in shape:
        parts = {f"{path}[{j}]": part_of(load, np.s_[:, j]) for j in range(shape[1])}
    n = sample_count(shape)
    return [Signal(p, n, part, unit, clock, is_text, refused, size) for p, part in parts.items()]


@dataclass(frozen=True)
class Source:
    """Recording or table: its signals, and notes on how it was read.

    Attributes:
        name: name for messages.
        kind: kind of file, such as `a Parquet file`.
        signals: signals in the order of the recording.
        digest: SHA-256 of the file, empty for data in memory.
        notes: sentences on how it was read.
    """

    name: str
    kind: str
    signals: tuple[Signal, ...]
    digest: str = ""
    notes: Names = ()

    def below(self, prefix: str) -> Source:
        """Signals below a path.

        Raises:
            BadData: there are none.
        """
        prefix_parts = path_parts(prefix)
        signals_below = tuple(
            s for s in self.signals if path_parts(s.path)[: len(prefix_parts)] == prefix_parts or s.path == prefix
        )
        if not signals_below:
            groups = dict.fromkeys(parent_path(s.path).rstrip("/.") or s.path for s in self.signals)
            raise BadData(f"{self.name}::{prefix}: no such signal; {suggested_paths(prefix, list(groups))}")
        return replace(self, signals=signals_below)
