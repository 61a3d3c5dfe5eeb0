"""Opening of input files. Every table, profile and TOML file is opened here."""

from __future__ import annotations

import contextlib
import math
import os
import re
import stat
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from calibration.data import Json
from calibration.data.input_errors import BadConfiguration, BadData, InputError
from mmrjax.errors import count_noun

#: First bytes of unsupported formats, and their names (`sources.opening` has the supported formats).
BINARY = {
    b"PK\x03\x04": "an Excel workbook or a zip file", b"\xd0\xcf\x11\xe0": "an Excel workbook",
    b"\x1f\x8b": "a gzip file", b"SQLite format 3\0": "an SQLite file", b"%PDF": "a PDF",
}  # fmt: skip
#: First characters of JSON and of web pages.
TEXTS = {
    re.compile(rb"\s*(\{|\[\s*[\[{\"\d-])"): "JSON",
    re.compile(rb"\s*<(!doctype|html|\?xml)", re.I): "a web page or XML",
}  # fmt: skip
#: Largest table and TOML file [bytes]. Most keys and deepest nesting of a TOML file.
LARGEST, LARGEST_TOML, KEYS, DEEPEST = 2**31, 2**22, 2_000, 16
#: Most signals of a recording, or columns of a table.
COLUMNS = 20_000
#: Bytes of a value, and largest share of the free memory for values. Copies and checks need the rest.
VALUE, SHARE = 8, 0.3
#: Largest ratio of declared to stored bytes (deflate reaches 1,032), and size that any file may declare [bytes].
RATIO, SMALL = 1_100, 2**28
#: Range of whole numbers in a TOML file (TOML 1.0: 64 bits).
WHOLE = 2**63
#: Names of file types that are not read.
_KINDS = {stat.S_ISDIR: "a folder", stat.S_ISFIFO: "a pipe", stat.S_ISSOCK: "a socket"}


def file_bytes(path: Path, where: str | Path, kind: type[InputError] = BadData, largest: int = LARGEST) -> bytes:
    """Bytes of a regular file.

    Args:
        where: beginning of the error message.
        kind: class of the exception.
        largest: largest allowed size [bytes].

    Raises:
        InputError: the path is a folder, a pipe or a device, the file is larger than `largest`, or it cannot be
            opened.
    """
    with _opened(path, where, kind, largest) as stream:
        return stream.read()


def first_bytes(path: Path, where: str | Path, kind: type[InputError] = BadData, length: int = 4096) -> bytes:
    """First bytes of a regular file of any size.

    Args:
        where: beginning of the error message.
        kind: class of the exception.

    Raises:
        InputError: for the same reasons as in `file_bytes`.
    """
    with _opened(path, where, kind) as stream:
        return stream.read(length)


@contextlib.contextmanager
def _opened(path: Path, where: str | Path, kind: type[InputError], largest: float = math.inf) -> Iterator[BinaryIO]:
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            file_kind = next((word for is_kind, word in _KINDS.items() if is_kind(status.st_mode)), "a device")
            raise kind(f"{where}: is {file_kind}; expected a file")
        if status.st_size > largest:
            raise kind(f"{where}: has {status.st_size / 1e6:,.0f} MB; expected at most {largest / 1e6:,.0f} MB")
        if math.isfinite(largest):
            check_memory(where, status.st_size)
        with path.open("rb") as stream:
            yield stream
    except (OSError, ValueError) as error:  # a name with a null byte
        raise kind(f"{where}: cannot be read ({getattr(error, 'strerror', None) or error})") from error


def check_declared(where: str | Path, columns: int, size: float = 0.0, held: float = math.inf) -> None:
    """Rejects implausible sizes in the header of a source, before its values are read.

    Args:
        where: beginning of the error message.
        columns: number of signals or columns.
        size: size of all values [bytes].
        held: size of the file [bytes].

    Raises:
        BadData: there are more than `COLUMNS` columns, or more values than a file of this size can hold.
    """
    if columns > COLUMNS:
        raise BadData(
            f"{where}: has {columns:,} columns; expected at most {COLUMNS:,}; export only those that you need"
        )
    if size > max(RATIO * held, SMALL):
        raise BadData(
            f"{where}: declares {size / 1e9:.3g} GB of values in a file of {held:,.0f} bytes; it may be cut off "
            "or damaged; export or copy it again"
        )


def check_memory(where: str | Path, size: float) -> None:
    """Rejects values that would need more than `SHARE` of the free memory, before they are read.

    Args:
        where: beginning of the error message.
        size: size of the values [bytes].

    Raises:
        BadData: they would need more.
    """
    if size > SHARE * (free := available_memory()):
        raise BadData(
            f"{where}: its values need {size / 1e9:.3g} GB, and {free / 1e9:.3g} GB of memory are free; expected at "
            f"most {SHARE * free / 1e9:.3g} GB; give a part of the recording, or every n-th row"
        )


def available_memory() -> float:
    """Free memory for this process [bytes], considering the system and the limit of its address space (`ulimit -v`).

    Infinite if the system does not report it.
    """
    try:
        free = float(os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
        with contextlib.suppress(OSError, StopIteration):  # includes file caches, which the system can free
            lines = Path("/proc/meminfo").read_text("ascii").splitlines()
            free = float(next(line for line in lines if line.startswith("MemAvailable")).split()[1]) * 1024
        with contextlib.suppress(ImportError, OSError):
            import resource

            limit = resource.getrlimit(resource.RLIMIT_AS)[0]
            used_bytes = int(Path("/proc/self/statm").read_text("ascii").split()[0]) * os.sysconf("SC_PAGE_SIZE")
            free = free if limit == resource.RLIM_INFINITY else min(free, float(limit - used_bytes))
        return free
    except (ValueError, OSError, AttributeError):
        return math.inf


def csv_bytes(path: Path, where: str | Path) -> bytes:
    """Bytes of a file that should be CSV.

    Raises:
        BadData: for the same reasons as `file_bytes`, or the file has another format, which the message names.
    """
    content = file_bytes(path, where)
    format_name = next((word for begin, word in BINARY.items() if content.startswith(begin)), None)
    format_name = format_name or next((word for begin, word in TEXTS.items() if begin.match(content)), None)
    if format_name is not None:
        raise BadData(
            f"{where}: is {format_name}; expected CSV, Parquet, or "
            "another format of docs/howto/formats.md; export it as CSV"
        )
    return content


def toml_text(path: Path, where: str | Path) -> str:
    """Text of a TOML file.

    Args:
        where: beginning of the error message.

    Raises:
        BadConfiguration: for the same reasons as `file_bytes`, or the text is not in UTF-8.
    """
    try:
        return file_bytes(path, where, BadConfiguration, LARGEST_TOML).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadConfiguration(f"{where}: not a readable TOML file ({error}); save it in UTF-8") from error


def flat_table(content: Json, prefix: str = "") -> Json:
    """Values of a table and its subtables by dotted name."""
    flat: Json = {}
    for key, value in content.items():
        name = f"{prefix}{key}"
        flat |= flat_table(value, f"{name}.") if isinstance(value, dict) else {name: value}
    return flat


def toml_content(text: str, where: str | Path) -> Json:
    """Keys and tables of a TOML text.

    Args:
        where: beginning of the error message.

    Raises:
        BadConfiguration: the text is no TOML, has more than `KEYS` keys, is nested deeper than `DEEPEST` tables, or
            has a whole number of more than 64 bits.
    """
    too_deep = f"{where}: tables or lists are nested too deeply; expected at most {DEEPEST} levels"
    try:
        content = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, ValueError) as error:  # more digits than Python converts
        raise BadConfiguration(f"{where}: not a readable TOML file ({error})") from error
    except RecursionError as error:
        raise BadConfiguration(too_deep) from error
    key_count = 0
    pending: list[tuple[Json | list[Any], int]] = [(content, 1)]
    while pending:
        value, depth = pending.pop()
        if depth > DEEPEST:
            raise BadConfiguration(too_deep)
        items = value.values() if isinstance(value, dict) else value
        key_count += len(value) if isinstance(value, dict) else 0
        if key_count > KEYS:
            raise BadConfiguration(f"{where}: has more than {count_noun(KEYS, 'key')}; is it the right file?")
        for item in items:
            if isinstance(item, dict | list):
                pending.append((item, depth + 1))
            elif isinstance(item, int) and not -WHOLE <= item < WHOLE:
                raise BadConfiguration(
                    f"{where}: got a whole number beyond 64 bits; expected numbers of at most 18 digits"
                )
    return content
