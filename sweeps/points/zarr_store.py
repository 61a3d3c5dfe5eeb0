"""The store of a sweep: a Zarr group whose chunks are whole or absent, and the record of those that are done.

Arrays are laid out in the Zarr format 3; each chunk is a file, written aside and moved into place, so that none is
ever half there. A chunk of the sweep counts as done when its line in a journal is whole, and that is written last.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import json
import math
import os
import shutil
import warnings
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from calibration.data.errors import BadConfiguration
from mmrjax.signals import STATUSES
from mmrjax.variation import STATUS
from sweeps.points.design import SAMPLE, Blocks, Design
from sweeps.points.identity import Identity, differences
from sweeps.store import Folder

STORE = "results.zarr"
#: Folder in which files are written before they are moved into place.
ASIDE = "writing"
#: Status of a point that has not been simulated.
ABSENT = 255


@dataclasses.dataclass(frozen=True)
class Variable:
    """An array of a store.

    Attributes:
        name: of the array; dtype: in NumPy's words; attributes: units, long_name and the like.
    """

    name: str
    dtype: str
    attributes: Mapping[str, Any]


@dataclasses.dataclass(frozen=True)
class Layout:
    """What a store holds.

    Attributes:
        design: the points; blocks: its chunks; variables: outputs, of all dimensions of the design.
        coordinates: units and names of what varies, by name; labels: words of an axis in place of its numbers.
        attributes: of the group; compression: `none` or `zstd`.
    """

    design: Design
    blocks: Blocks
    variables: tuple[Variable, ...]
    coordinates: Mapping[str, Mapping[str, Any]]
    labels: Mapping[str, tuple[str, ...]]
    attributes: Mapping[str, Any]
    compression: str = "none"

    @property
    def size(self) -> int:
        """Bytes of all arrays, uncompressed."""
        outputs = sum(np.dtype(v.dtype).itemsize for v in self.variables) * len(self.blocks) * self.blocks.points
        samples = self.design.samples
        drawn = 0 if samples is None else 8 * len(samples.names) * samples.number
        return outputs + drawn + 8 * sum(len(v) for v in self.design.axes.values())


@dataclasses.dataclass(frozen=True)
class Done:
    """What the journal knows of a finished chunk.

    Attributes:
        chunk: its number; statuses: how many points ended in each; ranges: least and greatest finite value of each
            output, none where there is none.
    """

    chunk: int
    statuses: tuple[int, ...]
    ranges: Mapping[str, tuple[float, float]]


class SweepStore(Folder):
    """The folder of a sweep, `path` + `.partial` until it is whole, shared by the processes of a job array."""

    def __init__(self, path: Path, identity: Identity, layout: Layout, *, force: bool = False) -> None:
        """Begin a store, or take up one with the same identity.

        Raises:
            BadConfiguration: `path` holds something else, or a sweep of another identity (the message says where they
                differ), or another process is at work on what `force` would replace.
        """
        super().__init__(path)
        self.layout = layout
        self.finished = False
        self._journal: TextIO | None = None
        self._share: Path | None = None
        self._lock: TextIO | None = None
        self._identity = identity
        self._aside = self.partial / ASIDE / "identity"
        cut_short = (path / "lock").is_file()  # killed while the folder was moved into place
        if (path / "identity.json").is_file() and (not force or (cut_short and not self._differs(path))):
            self._take_finished()
            return
        self.refuse_taken(force)
        ours = (self.partial / "lock").is_file()
        if self.partial.exists() and not ours and any(self.partial.iterdir()):
            raise BadConfiguration(
                f"--out: {self.partial} is in the way and is no sweep of ours; choose another path"
            )
        try:
            while not self._enter(force):
                self.close()
        except BaseException:
            self.close()
            raise

    def _enter(self, force: bool) -> bool:
        """Begin the store or take it up; False where another process has removed it while this one waited for it."""
        try:
            self.partial.mkdir(parents=True, exist_ok=True)
            self._lock = (self.partial / "lock").open("a")
        except OSError as error:
            raise BadConfiguration(
                f"--out: {self.path} cannot be written ({error.strerror}); choose another path"
            ) from error
        with self._locked():
            if not self._present():
                return self._finished_by_another(force)
            self._begin_or_take_up(force)
        return True

    def _present(self) -> bool:
        """Whether the folder is the one that this process has opened, and not removed or moved meanwhile."""
        assert self._lock is not None
        try:
            return os.path.samestat(os.fstat(self._lock.fileno()), (self.partial / "lock").stat())
        except FileNotFoundError:
            return False

    def _finished_by_another(self, force: bool = False) -> bool:
        if not (self.path / "identity.json").is_file() or (force and self._differs(self.path)):
            return False
        self._take_finished()
        return True

    def _take_finished(self) -> None:
        self._same(self.path)
        self._tidy()
        self.finished = True

    def _begin_or_take_up(self, force: bool) -> None:
        if (self.partial / "identity.json").is_file() and not (force and self._differs(self.partial)):
            self._same(self.partial)
        elif not force and (self.path / "identity.json").is_file():  # finished between our looking and our coming
            self._take_finished()
            shutil.rmtree(self.partial)
        else:
            self._create()

    # --- identity ---------------------------------------------------------------------------------

    def _differs(self, folder: Path) -> str:
        stored = json.loads((folder / "identity.json").read_text(encoding="utf-8"))
        return differences(stored, self._identity)

    def _same(self, folder: Path) -> None:
        differ = self._differs(folder)
        if differ:
            raise BadConfiguration(
                f"--out: {folder} holds another sweep, which differs in {differ}; choose another path, or --force to "
                "begin anew"
            )

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        assert self._lock is not None
        fcntl.flock(self._lock, fcntl.LOCK_EX)
        try:
            yield
        finally:
            fcntl.flock(self._lock, fcntl.LOCK_UN)

    # --- layout -----------------------------------------------------------------------------------

    def _clear(self) -> None:
        for entry in self.partial.iterdir():
            if entry.name != "lock":
                shutil.rmtree(entry) if entry.is_dir() else entry.unlink()

    def _create(self) -> None:
        """Metadata and axes, and the identity last: what has one is whole.

        Raises:
            BadConfiguration: another process is writing to what would be replaced.
        """
        share = self._at_work()
        if share is not None:
            raise self._busy(share)
        self._clear()
        (self.partial / "journal").mkdir()
        (self.partial / ASIDE).mkdir()
        create(self.partial / STORE, self.layout)
        write_file(self.partial / "identity.json", json.dumps(self._identity, indent=1).encode(), self._aside)

    # --- chunks -----------------------------------------------------------------------------------

    def begin(self, shard: tuple[int, int] = (1, 1)) -> None:
        """Open the journal of a share of the chunks; from now on no other process may work on it.

        Raises:
            BadConfiguration: another process does, or has removed the store or begun another one in its place.
        """
        name = f"{shard[0]}-of-{shard[1]}"
        file, self._aside = self.partial / "journal" / f"{name}.jsonl", self.partial / ASIDE / f"{name}-{os.getpid()}"
        with self._locked():
            if not self._present():
                if self._finished_by_another():
                    return
                raise BadConfiguration(
                    f"--out: another process has removed {self.partial}; the same command begins anew"
                )
            self._same(self.partial)
            journal = file.open("a+", encoding="utf-8")
            if not _lockable(journal):
                journal.close()
                raise self._busy(name)
            self._journal, self._share = journal, file
        if file.stat().st_size:  # a line cut short by a kill must not swallow the next
            self._journal.write("\n")
            self._journal.flush()

    def _at_work(self) -> str | None:
        """A share that another process works on, of those that have one; to be called within `_locked`."""
        for file in sorted((self.partial / "journal").glob("*.jsonl")):
            if file != self._share:
                with file.open("a") as journal:
                    if not _lockable(journal):
                        return file.stem
        return None

    def _busy(self, name: str) -> BadConfiguration:
        return BadConfiguration(
            f"--out: another process is at work on {self.partial}, share {name.replace('-', ' ')}; wait for it, or "
            "choose another path"
        )

    def done(self) -> dict[int, Done]:
        """Finished chunks by number."""
        found: dict[int, Done] = {}
        folder = self.path if self.finished else self.partial
        for file in sorted((folder / "journal").glob("*.jsonl")):
            for line in file.read_text(encoding="utf-8").splitlines():
                record = _record(line)
                if record is not None:
                    found[record.chunk] = record
        return found

    def write(self, chunk: int, arrays: Mapping[str, np.ndarray], drawn: np.ndarray | None) -> Done:
        """Write a chunk and count it as done.

        Args:
            arrays: by variable, a value a point of its box; drawn: values of the samples there, a row a name, written
                by the chunks at the beginning of all axes.
        """
        layout, place = self.layout, self.layout.blocks.place(chunk)
        box = layout.blocks.box(chunk)
        shape = tuple(b.stop - b.start for b in box)
        store = self.partial / STORE
        for variable in layout.variables:
            values = np.asarray(arrays[variable.name], variable.dtype).reshape(shape)
            self._chunk(store / variable.name, place, values, layout.blocks.size, fill(variable))
        samples = layout.design.samples
        if samples is not None and drawn is not None and not any(place[:-1]):
            for name, values in zip(samples.names, drawn, strict=True):
                self._chunk(store / name, place[-1:], values, layout.blocks.size[-1:], math.nan)
        record = Done(
            chunk, _counts(arrays[STATUS]), {v.name: r for v in layout.variables if (r := _range(arrays, v))}
        )
        assert self._journal is not None
        self._journal.write(_line(record))
        self._journal.flush()
        os.fsync(self._journal.fileno())
        return record

    def _chunk(
        self, array: Path, place: tuple[int, ...], values: np.ndarray, size: tuple[int, ...], empty: Any
    ) -> None:
        if values.shape != size:  # chunks at the end of an axis are filled up, as the format wants
            full = np.full(size, empty, values.dtype)
            full[tuple(slice(n) for n in values.shape)] = values
            values = full
        file = array.joinpath("c", *map(str, place))
        file.parent.mkdir(parents=True, exist_ok=True)
        content = np.ascontiguousarray(values).data
        write_file(file, content if self.layout.compression == "none" else _compressed(content), self._aside)

    # --- the end ----------------------------------------------------------------------------------

    @contextlib.contextmanager
    def last(self) -> Iterator[bool]:
        """Whether this process is the one that finishes the sweep: every chunk is done, and nobody has finished."""
        with self._locked():
            if not self._present():
                self.finished = True
            yield not self.finished and len(self.done()) == len(self.layout.blocks)

    def move_into_place(self) -> Path:
        """The finished folder, where it is to appear; to be called within `last`.

        The folder that it replaces goes into the new one first, and is deleted there: after a kill between any two
        steps the same command does the rest.
        """
        if self.path.is_dir():
            replaced = self.partial / ASIDE / "replaced"
            shutil.rmtree(replaced, ignore_errors=True)
            os.replace(self.path, replaced)
        os.replace(self.partial, self.path)
        self.finished = True
        self._tidy()
        return self.path

    def _tidy(self) -> None:
        """Delete what a finished folder does not need, the lock last: while there is one, something may be left."""
        if (self.path / "lock").is_file():
            shutil.rmtree(self.path / ASIDE, ignore_errors=True)
            (self.path / "lock").unlink(missing_ok=True)

    def close(self) -> None:
        """Let other processes work on what is left."""
        for file in (self._journal, self._lock):
            if file is not None:
                with contextlib.suppress(OSError):  # of a line that found no room, which has been said
                    file.close()
        self._journal = self._share = self._lock = None

    def abandon(self) -> None:
        """Leave nothing behind, where this process has begun, no chunk is done and nobody else is at work."""
        if self.finished or self._share is None:
            return
        with self._locked(), contextlib.suppress(OSError):
            if self._present() and not self.done() and self._at_work() is None:
                self._clear()  # the lock last: a folder without one would be somebody else's
                shutil.rmtree(self.partial)


def _lockable(journal: TextIO) -> bool:
    """Lock a journal until it is closed; False where another process has."""
    try:
        fcntl.flock(journal, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def write_file(path: Path, content: Any, aside: Path) -> None:
    """Write a file that is there whole or not at all, and outlives a loss of power.

    Args:
        aside: where it is written, on the same disk, before it is moved into place.
    """
    try:
        with aside.open("wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(aside, path)
    except OSError:
        with contextlib.suppress(OSError):
            aside.unlink()
        raise


def _compressed(content: Any) -> bytes:
    from numcodecs.zstd import Zstd

    return bytes(Zstd(level=ZSTD["level"], checksum=ZSTD["checksum"]).encode(np.frombuffer(content, np.uint8)))


ZSTD: dict[str, Any] = {"level": 1, "checksum": False}


def create(path: Path, layout: Layout) -> None:
    """Metadata of every array of a store, and the values of its axes."""
    import zarr
    from zarr.codecs import ZstdCodec

    compressors = None if layout.compression == "none" else [ZstdCodec(**ZSTD)]
    group = zarr.create_group(path, zarr_format=3, attributes=dict(layout.attributes))
    design, blocks = layout.design, layout.blocks
    drawn = design.samples.names if design.samples is not None else ()
    further = {"coordinates": " ".join(drawn)} if drawn else {}
    for v in layout.variables:
        group.create_array(
            v.name, shape=design.shape, chunks=blocks.size, dtype=v.dtype, fill_value=fill(v),
            compressors=compressors, dimension_names=design.dimensions, attributes={**v.attributes, **further},
        )  # fmt: skip
    for name, values in design.axes.items():
        words = layout.labels.get(name)
        array = group.create_array(
            name, shape=values.shape, chunks=values.shape, dtype=str if words else "float64", compressors=None,
            dimension_names=(name,), attributes=dict(layout.coordinates[name]),
        )  # fmt: skip
        array[:] = np.array([words[int(k)] for k in values], object) if words else values
    for name in drawn:
        group.create_array(
            name, shape=design.shape[-1:], chunks=blocks.size[-1:], dtype="float64", fill_value=math.nan,
            compressors=compressors, dimension_names=(SAMPLE,), attributes=dict(layout.coordinates[name]),
        )  # fmt: skip
    with warnings.catch_warnings():
        # xarray opens a store with it at once, and one without it with a warning
        warnings.filterwarnings("ignore", message="Consolidated metadata is currently not part")
        zarr.consolidate_metadata(path)


def fill(variable: Variable) -> Any:
    """Value of points that have not been simulated."""
    return math.nan if np.dtype(variable.dtype).kind == "f" else ABSENT


def _counts(status: np.ndarray) -> tuple[int, ...]:
    return tuple(np.bincount(np.asarray(status, np.intp), minlength=len(STATUSES)).tolist())


def _range(arrays: Mapping[str, np.ndarray], variable: Variable) -> tuple[float, float] | None:
    if np.dtype(variable.dtype).kind != "f":
        return None
    values = arrays[variable.name]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="All-NaN")
        low, high = float(np.nanmin(values)), float(np.nanmax(values))
    return (low, high) if math.isfinite(low) and math.isfinite(high) else None


def _line(record: Done) -> str:
    body = json.dumps([record.chunk, record.statuses, record.ranges], separators=(",", ":"))
    return f"{zlib.crc32(body.encode()):08x} {body}\n"


def _record(line: str) -> Done | None:
    """A line of a journal; None where it is not whole."""
    check, _, body = line.partition(" ")
    if not body or f"{zlib.crc32(body.encode()):08x}" != check:
        return None
    chunk, statuses, ranges = json.loads(body)
    return Done(chunk, tuple(statuses), {name: tuple(r) for name, r in ranges.items()})
