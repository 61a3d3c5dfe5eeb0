"""Opening of data sources: their format follows from the first bytes, and their signals are listed."""

from __future__ import annotations

import collections
import fnmatch
import hashlib
import importlib
import math
import os
import stat
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data import input_files
from calibration.data.input_errors import BadData, InputError
from calibration.data.sources import columnar
from calibration.data.sources.recorded_signals import Clock, Load, Signal, Source, plain_values, refused_type

#: Separator between the path of a file and the path of signals in it.
WITHIN = "::"


@dataclass(frozen=True)
class Format:
    """A format of files.

    Attributes:
        kind: name of a file of this format.
        module, reader: the function that lists its signals.
        library: the required library.
        extra: extra of this package that installs it.
    """

    kind: str
    module: str
    reader: str
    library: str = ""

    def signals(self, path: Path, name: str) -> Any:
        """Signals of a file.

        Raises:
            BadData: a library is not installed, or it cannot read the file.
        """
        try:
            module = importlib.import_module(f"calibration.data.sources.{self.module}")
            return getattr(module, self.reader)(path, name)
        except InputError:
            raise
        except ImportError as error:
            if not self.library:
                raise
            raise BadData(
                f"{name}: is {self.kind}; reading it needs {self.library}, which is not installed: pip install "
                "mmrjax[logs]"
            ) from error
        except Exception as error:  # each library has its own errors
            raise unreadable_file(name, self.kind, error) from error


PARQUET = Format("a Parquet file", "columnar", "signals_of_parquet")
ARROW = Format("an Arrow file", "columnar", "signals_of_arrow")
HDF5 = Format("an HDF5 file", "arrays", "signals_of_hdf5", "h5py")
MATLAB = Format("a MATLAB file", "arrays", "signals_of_matlab")
NPZ = Format("an .npz archive", "arrays", "signals_of_npz")
NPY = Format("a NumPy file", "arrays", "signals_of_npy")
JSON = Format("a JSON file", "json_records", "signals_of_json")
BAG = Format("a ROS bag", "bags", "signals_of_bag", "rosbags")
MCAP = Format("an MCAP file", "bags", "signals_of_bag", "rosbags")
ULOG = Format("a ULog file", "recorders", "signals_of_ulog", "pyulog")
MDF = Format("an MDF file", "recorders", "signals_of_mdf", "asammdf")
WPILOG = Format("a WPILOG file", "recorders", "signals_of_wpilog")
WORKBOOK = Format("a workbook", "workbook", "signals_of_workbook", "python-calamine")

#: First bytes of each format.
BEGINNINGS = {
    b"PAR1": PARQUET, b"ARROW1": ARROW, b"\xff\xff\xff\xff": ARROW, b"\x89HDF\r\n\x1a\n": HDF5,
    b"MATLAB 7.3": HDF5, b"MATLAB 5.0": MATLAB, b"\x93NUMPY": NPY, b"#ROSBAG": BAG, b"\x89MCAP": MCAP,
    b"ULog": ULOG, b"MDF     ": MDF, b"UnFinMF ": MDF, b"WPILOG": WPILOG,
    b"\xd0\xcf\x11\xe0": WORKBOOK,
}  # fmt: skip
#: Formats without fixed first bytes, by suffix.
SUFFIXES = {".mat": MATLAB, ".db3": BAG, ".jsonl": JSON, ".ndjson": JSON}
#: File of a ROS 2 bag's folder that lists its contents.
_METADATA = "metadata.yaml"
_RECORDINGS = (".db3", ".mcap")


def unreadable_file(name: str, kind: str, error: BaseException) -> BadData:
    """Error for a file that its library rejects."""
    why = " ".join(str(error).split()) or type(error).__name__
    return BadData(f"{name}: cannot be read as {kind} ({why}); it may be cut off or damaged; export or copy it again")


def split_source(source: str) -> tuple[Path, str]:
    """Path of a file, and path of signals in it (empty if not stated)."""
    if Path(source).exists():
        return Path(source), ""
    file, _, signal_path = source.partition(WITHIN)
    return Path(file), signal_path


def files_of_group(source: str) -> list[Path]:
    """Files that match a pattern such as `runs/*.csv`, in order. Empty if it is a file name, or none matches."""
    path = Path(source)
    if not set("*?[") & {*source} or path.exists():
        return []
    names = fnmatch.filter(os.listdir(path.parent), path.name) if path.parent.is_dir() else []
    return sorted(path.parent / name for name in names if not name.startswith("."))


def format_of(path: Path, name: str) -> Format | None:
    """Format of a file or of a bag folder. None: text in columns.

    Raises:
        BadData: the path is a pipe, a device or a folder that is no bag, or the file cannot be opened.
    """
    if path.is_dir():
        if (path / _METADATA).exists():
            return BAG
        if parts := sorted(file.name for file in path.iterdir() if file.suffix in _RECORDINGS):
            raise BadData(
                f"{name}: is a folder without {_METADATA}; expected that file of the bag, or a recording, as "
                f"{path / parts[0]}"
            )
    first_bytes = input_files.first_bytes(path, name)
    file_format = next(
        (file_format for magic, file_format in BEGINNINGS.items() if first_bytes.startswith(magic)), None
    )
    if file_format is None and first_bytes.startswith(b"PK\x03\x04"):
        file_format = _format_of_zip(path)
    if file_format is None and any(
        text.match(first_bytes) for text, word in input_files.TEXTS.items() if word == "JSON"
    ):
        file_format = JSON
    return file_format or SUFFIXES.get(path.suffix.lower())


def _format_of_zip(path: Path) -> Format | None:
    """Format of a zip file by the names in it, or by its suffix if it is damaged."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except (zipfile.BadZipFile, OSError):
        names = {".npz": [".npy"], ".xlsx": ["xl/"], ".ods": ["content.xml"]}.get(path.suffix.lower(), [])
    if any(name.endswith(".npy") for name in names):
        return NPZ
    return WORKBOOK if any(name.startswith("xl/") or name == "content.xml" for name in names) else None


def open_signals(path: Path, signal_path: str, name: str, file_format: Format) -> Source:
    """The signals of a file of a format other than text.

    Args:
        signal_path: path of signals in it, empty for all.
        name: name of the file, for messages.

    Raises:
        BadData: for the same reasons as `Format.signals`, or there is no signal below `signal_path`.
    """
    files = [path]
    if path.is_dir():
        for item in path.iterdir():
            if item.is_symlink() and not (item.exists() and item.resolve().is_relative_to(path.resolve())):
                raise BadData(f"{name}, {item.name}: is a link that points outside the bag; expected the file itself")
            if not stat.S_ISREG(item.stat().st_mode) and not item.is_dir():
                raise BadData(f"{name}, {item.name}: is not a regular file; expected the files of a bag")
        files = [file for file in sorted(path.iterdir()) if file.is_file()]
    signals = tuple(file_format.signals(path, name))
    if not signals:
        raise BadData(f"{name}: is {file_format.kind} without signals; expected at least one column or array")
    digest = hashlib.sha256()  # of the files in order of their names
    for file in files:
        with file.open("rb") as stream:
            while block := stream.read(2**20):
                digest.update(block)
    byte_count = sum(file.stat().st_size for file in files)
    source = checked_source(name, file_format.kind, signals, byte_count, digest.hexdigest())
    return source.below(signal_path) if signal_path else source


def open_object(source: Any) -> Source:
    """The signals of a table in memory.

    Raises:
        BadData: for the same reasons as `columnar.signals_of_object`.
    """
    kind, signals = columnar.signals_of_object(source)
    return checked_source(kind, kind, signals)


def checked_source(
    name: str, kind: str, signals: Sequence[Signal], held: float = math.inf, digest: str = ""
) -> Source:
    """Source whose sizes are checked before its values are read, and whose values are plain arrays.

    Signals with the same path are rejected.

    Args:
        held: size of the file [bytes].

    Raises:
        BadData: a size is implausible (`input_files.check_declared`).
    """
    size = input_files.VALUE * sum(signal.length for signal in signals)
    input_files.check_declared(name, len(signals), size, held)
    count = collections.Counter(signal.path for signal in signals)
    why = "has the same name as another signal; expected different names"
    signals = [s if count[s.path] == 1 else replace(s, refused=why) for s in signals]
    return Source(name, kind, _guarded_signals(signals, name, kind), digest)


def _guarded_signals(signals: Sequence[Signal], name: str, kind: str) -> tuple[Signal, ...]:
    """Signals that raise `BadData` if they are rejected or too large for the memory, or if their library cannot read
    their values. Shared clocks stay shared.
    """

    def guarded(load: Load, path: str, signal: Signal, refused: str = "") -> Load:
        place = f"{name}, {path}"

        def read() -> np.ndarray:
            if refused:
                raise BadData(f"{place}: {refused}")
            input_files.check_memory(place, signal.size or input_files.VALUE * signal.length)
            try:
                values = load()
                why = refused_type(values.dtype)
                values = values if why else plain_values(values)
            except InputError:
                raise
            except Exception as error:  # each library has its own errors
                raise unreadable_file(place, kind, error) from error
            if not why and len(values) != signal.length:
                why = f"has {len(values)} of the {signal.length} values that it declares; it may be damaged"
            if why:
                raise BadData(f"{place}: {why}")
            return values

        return read

    clocks: dict[int, Clock] = {}
    for s in signals:
        if s.clock is not None and id(s.clock) not in clocks:
            clocks[id(s.clock)] = replace(s.clock, load=guarded(s.clock.load, s.clock.name, s))
    return tuple(
        replace(s, load=guarded(s.load, s.path, s, s.refused), clock=clocks.get(id(s.clock))) for s in signals
    )
