"""Store of a sweep: a Zarr group whose chunks are complete or absent, and a journal of finished chunks.

Arrays are in Zarr format 3. Each chunk is a file that is written under another name and moved into place, so files
are never incomplete. A chunk of the sweep is done when its line in a journal is complete. This line is written last
and contains a checksum of each file, to detect later damage.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import importlib.metadata
import json
import math
import os
import platform
import tempfile
import warnings
import zlib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from pydantic import BaseModel

from calibration.data import Columns, Json, Names
from calibration.data.input_errors import BadConfiguration, BadData
from calibration.data.input_files import file_bytes
from calibration.data.writing import naming_file
from mmrjax.compile.programs import source_hash
from mmrjax.fidelities.variation import STATUS
from mmrjax.model import params
from mmrjax.model.robot import Robot
from mmrjax.model.signals import STATUSES
from sweeps.console import print_message
from sweeps.points.sampled_design import SAMPLE, Blocks, Design
from sweeps.store import (
    ASIDE,
    IDENTITY,
    JOURNAL,
    LOCK,
    PACKAGES,
    STORE,
    Folder,
    interrupted_run,
    listed_names,
    lock_text,
    sha256_hex,
    share_at_work,
    try_to_lock,
)

#: Packages whose versions are part of a sweep's identity, in addition to those of every result.
MORE_PACKAGES = ("scipy", "zarr")

Identity = dict[str, dict[str, str]]


def job_identity(config: BaseModel, robot: Robot, files: Iterable[str], device: str) -> Identity:
    """Identity of a job in sections: configuration, data, code, versions, device.

    Args:
        config: configuration of the sweep, with chunk size and outputs resolved.
        files: input files.
        device: kind of the devices.

    Raises:
        BadConfiguration: a file cannot be read.
    """
    configuration = _flatten(config.model_dump(mode="json", exclude={"report", "table"}), "")
    configuration |= {f"robot {p.name}": repr(float(p.value)) for p in params.walk_parameters(robot)}
    return {
        "configuration": configuration,
        "data": {file: sha256_hex(file_bytes(Path(file), file, BadConfiguration)) for file in files},
        "code": {"source": source_hash()},
        "versions": {"python": platform.python_version(), **installed_versions((*PACKAGES, *MORE_PACKAGES))},
        "device": {"device": device},
    }


def installed_versions(packages: Iterable[str]) -> dict[str, str]:
    """Version of each package."""
    return {name: importlib.metadata.version(name) for name in packages}


def _flatten(content: Json, prefix: str) -> dict[str, str]:
    flat: dict[str, str] = {}
    for key, value in content.items():
        if isinstance(value, dict):
            flat |= _flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = repr(value)
    return flat


def identity_differences(stored: Mapping[str, Mapping[str, str]], now: Mapping[str, Mapping[str, str]]) -> str:
    """Sections in which two identities differ, with the first keys. Empty if they are equal."""
    differences = []
    for section in dict.fromkeys((*now, *stored)):
        old, new = stored.get(section, {}), now.get(section, {})
        keys = [key for key in dict.fromkeys((*new, *old)) if old.get(key) != new.get(key)]
        if keys:
            changes = [f"{key}{_change(old.get(key), new.get(key), section)}" for key in keys[:3]]
            others_text = f" and {len(keys) - 3} more" if len(keys) > 3 else ""
            differences.append(f"{section} ({', '.join(changes)}{others_text})")
    return "; ".join(differences)


def _change(old: str | None, new: str | None, section: str) -> str:
    if old is None or new is None:
        return " is new" if old is None else " is gone"
    # hashes and long lists are not shown
    return "" if section in ("data", "code") or len(old) + len(new) > 80 else f" was {old}, is {new}"


#: Name of the command in the lock file. It differs from that of sweeps into tables, which leave other files.
COMMAND = "sweep into a store"
#: Status of a point that has not been simulated.
ABSENT = 255
#: Typical block size of file systems, and typical size of an array's metadata [bytes].
BLOCK, METADATA = 4096, 1024


@dataclasses.dataclass(frozen=True)
class StoreLayout:
    """Arrays, chunks and attributes of a store.

    Attributes:
        design: the points.
        blocks: chunks of the sweep.
        variables: data type of each output in NumPy's notation, such as `<f8`, and its attributes: units, long_name
            and the like. Outputs have all dimensions of the design.
        coordinates: units and long names of the varied names.
        labels: words that replace the numbers of an axis.
        attributes: attributes of the group.
        compression: `none` or `zstd`.
    """

    design: Design
    blocks: Blocks
    variables: Mapping[str, tuple[str, Json]]
    coordinates: Mapping[str, Json]
    labels: Mapping[str, Names]
    attributes: Json
    compression: str = "none"

    @property
    def size(self) -> int:
        """Uncompressed size of the store on disk [bytes]: files and folders in blocks, metadata and journal."""
        counts, points = self.blocks.counts, self.blocks.points
        folders = sum(math.prod(counts[:k]) for k in range(len(counts)))
        point_bytes = sum(_disk_size(np.dtype(v).itemsize * points) for v, _ in self.variables.values()) * len(
            self.blocks
        )
        outputs = point_bytes + BLOCK * folders * len(self.variables)
        names = () if self.design.samples is None else self.design.samples.names
        sample_size = len(names) * counts[-1] * _disk_size(8 * self.blocks.size[-1])
        axes = sum(_disk_size(8 * len(values)) for values in self.design.axes.values())
        arrays = len(self.variables) + len(names) + len(self.design.axes)
        widest = dict.fromkeys(self.variables, (-1.2345678901234567e-300,) * 2)
        checks = dict.fromkeys([*widest, *names], 2**32 - 1)
        line = _journal_line(ChunkRecord(len(self.blocks), (points,) * len(STATUSES), widest, checks))
        return (
            outputs + sample_size + axes + arrays * (3 * BLOCK + METADATA) + _disk_size(len(line) * len(self.blocks))
        )


@dataclasses.dataclass(frozen=True)
class ChunkRecord:
    """Journal entry of a finished chunk.

    Attributes:
        chunk: number of chunk.
        statuses: number of points by status.
        ranges: smallest and largest finite value of each output.
        checks: CRC-32 checksum of the chunk's file for each array.
    """

    chunk: int
    statuses: tuple[int, ...]
    ranges: Mapping[str, tuple[float, float]]
    checks: Mapping[str, int]


class SweepStore(Folder):
    """Folder of a sweep, named `path` + `.partial` until it is complete, shared by the processes of a job array."""

    scratch = ASIDE
    extra_names = ("runs.csv", "runs.parquet")

    def __init__(self, path: Path, identity: Identity, layout: StoreLayout, *, force: bool = False) -> None:
        """Creates a store, or continues one with the same identity.

        Raises:
            BadConfiguration: `path` holds something else or a sweep with another identity (the message lists the
                differences), or another process is working on what `force` would replace.
            BadData: the sweep is finished but a file of its store is damaged.
        """
        super().__init__(path, force)
        self.layout = layout
        self.finished = False
        self._journal: TextIO | None = None
        self._share: Path | None = None
        self._identity = identity
        self._temporary = self.partial / ASIDE / "identity"
        self._intact: dict[int, ChunkRecord] = {}
        self._damaged = set[int]()
        was_killed = (path / LOCK).is_file()  # the process was killed while it moved the folder into place
        if self._is_finished() and (not force or (was_killed and not self._differences(path))):
            self._use_finished()
            return
        self.refuse_taken(force)
        self.refuse_foreign(COMMAND, force)
        try:
            while not self._enter(force):
                self.close()
        except BaseException:
            self.close()
            raise

    def _enter(self, force: bool) -> bool:
        """Creates or continues the store. False if another process removed it while this one waited."""
        try:
            self.partial.mkdir(parents=True, exist_ok=True)
            self._lock = (self.partial / LOCK).open("a")
        except OSError as error:
            raise BadConfiguration(
                f"--out: {self.path} cannot be written ({error.strerror}); choose another path"
            ) from error
        mark = interrupted_run(self.partial)
        if mark is not None and mark["command"] not in ("", COMMAND) and not try_to_lock(self._lock):
            raise self._busy()
        with self._locked():
            if not self._present():
                return self._finished_by_another(force)
            self._create_or_continue(force)
        return True

    def _is_finished(self) -> bool:
        return listed_names(self.path) is not None and (self.path / IDENTITY).is_file()

    def _finished_by_another(self, force: bool = False) -> bool:
        if not self._is_finished() or (force and self._differences(self.path)):
            return False
        self._use_finished()
        return True

    def _use_finished(self) -> None:
        self._check_identity(self.path)
        self._tidy()
        self.finished = True
        self._refuse_damaged()

    def _create_or_continue(self, force: bool) -> None:
        if (self.partial / IDENTITY).is_file() and not (force and self._differences(self.partial)):
            self._check_identity(self.partial)
            self._mend_layout()
        elif not force and self._is_finished():  # finished by another process in the meantime
            self._use_finished()
            self._remove_partial()
        else:
            self._create()

    # --- identity ---------------------------------------------------------------------------------

    def _differences(self, folder: Path) -> str:
        try:
            stored = json.loads((folder / IDENTITY).read_text(encoding="utf-8"))
            return identity_differences(stored, self._identity)
        except (ValueError, AttributeError, TypeError, RecursionError):
            return IDENTITY

    def _check_identity(self, folder: Path) -> None:
        differences = self._differences(folder)
        if differences == IDENTITY:
            raise BadData(
                f"--out: {folder / 'identity.json'} is damaged; choose another path, or --force to start again"
            )
        if differences:
            raise BadConfiguration(
                f"--out: {folder} contains another sweep, which differs in {differences}; choose another path, or "
                "use --force to start again"
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

    def _create(self) -> None:
        """Writes metadata and axes, then the identity: a store that has one is complete.

        Raises:
            BadConfiguration: another process is writing to the store that would be replaced.
        """
        busy_share = share_at_work(self.partial, self._share)
        if busy_share is not None:
            raise self._busy(busy_share)
        self._clear()
        (self.partial / LOCK).write_text(lock_text(COMMAND), encoding="utf-8")
        (self.partial / JOURNAL).mkdir()
        (self.partial / ASIDE).mkdir()
        with naming_file(self.partial / STORE):
            create_store(self.partial / STORE, self.layout)
        write_file(self.partial / IDENTITY, json.dumps(self._identity, indent=1).encode(), self._temporary)

    def _altered_files(self, folder: Path) -> dict[Path, bytes]:
        """Files of metadata and axes that differ from those of `create_store`, with their correct content."""
        with tempfile.TemporaryDirectory() as scratch_folder:
            create_store(Path(scratch_folder) / STORE, self.layout)
            file_contents = {
                p.relative_to(scratch_folder): p.read_bytes() for p in Path(scratch_folder).rglob("*") if p.is_file()
            }
        contents = {folder / name: content for name, content in file_contents.items()}
        return {p: content for p, content in contents.items() if not p.is_file() or p.read_bytes() != content}

    def _mend_layout(self) -> None:
        """Rewrites damaged metadata and axes, with a note."""
        for file, content in self._altered_files(self.partial).items():
            print_message(f"{file}: damaged, so it is written again")
            file.parent.mkdir(parents=True, exist_ok=True)
            write_file(file, content, self._temporary)

    def _refuse_damaged(self) -> None:
        """Rejects a finished sweep with a damaged file.

        Raises:
            BadData: a file is damaged.
        """
        damaged = next(iter(self._altered_files(self.path)), None)
        if damaged is None and len(self.done()) < len(self.layout.blocks):
            damaged_chunk = min(set(range(len(self.layout.blocks))) - set(self._intact))
            records = self._records().get(damaged_chunk, [])
            damaged = self._damaged_file(records[-1]) if records else self.path / JOURNAL
        if damaged is not None:
            raise BadData(f"--out: {damaged} is damaged; choose another path, or --force to start again")

    # --- chunks -----------------------------------------------------------------------------------

    def begin(self, shard: tuple[int, int] = (1, 1)) -> None:
        """Opens the journal of a share of the chunks, and locks this share.

        Raises:
            BadConfiguration: another process holds the lock, or has removed or replaced the store.
        """
        name = f"{shard[0]}-of-{shard[1]}"
        file = self.partial / JOURNAL / f"{name}.jsonl"
        self._temporary = self.partial / ASIDE / f"{name}-{os.getpid()}"
        with self._locked():
            if not self._present():
                if self._finished_by_another():
                    return
                raise BadConfiguration(
                    f"--out: another process has removed {self.partial}; the same command starts again"
                )
            self._check_identity(self.partial)
            journal = file.open("a+", encoding="utf-8")
            if not try_to_lock(journal):
                journal.close()
                raise self._busy(name)
            self._journal, self._share = journal, file
        if file.stat().st_size:  # the last line may be incomplete, if the process was killed
            self._journal.write("\n")
            self._journal.flush()

    def done(self) -> dict[int, ChunkRecord]:
        """Finished chunks with undamaged files, by number. Each damaged chunk is reported once."""
        for chunk, records in self._records().items():
            if chunk in self._intact:
                continue
            undamaged = next((record for record in records if self._damaged_file(record) is None), None)
            if undamaged is not None:
                self._intact[chunk] = undamaged
            elif chunk not in self._damaged and not self.finished:
                self._damaged.add(chunk)
                print_message(f"{self._damaged_file(records[-1])}: damaged, so it is computed again")
        return dict(sorted(self._intact.items()))

    def _records(self) -> dict[int, list[ChunkRecord]]:
        """Complete lines of all journals, by chunk."""
        records: dict[int, list[ChunkRecord]] = {}
        folder = self.path if self.finished else self.partial
        for file in sorted((folder / JOURNAL).glob("*.jsonl")):
            for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
                record = _parse_line(line)
                if record is not None and 0 <= record.chunk < len(self.layout.blocks):
                    records.setdefault(record.chunk, []).append(record)
        return records

    def _damaged_file(self, record: ChunkRecord) -> Path | None:
        """Damaged file of a chunk, or None."""
        store = (self.path if self.finished else self.partial) / STORE
        for name, file in self._files(record.chunk).items():
            try:
                if zlib.crc32((store / file).read_bytes()) != record.checks.get(name):
                    return store / file
            except OSError:
                return store / file
        return None

    def _files(self, chunk: int) -> dict[str, Path]:
        """Files of a chunk, by array. Those of samples belong to chunks at the beginning of all other axes."""
        place = self.layout.blocks.place(chunk)
        samples = self.layout.design.samples
        files = {v: Path(v, "c", *map(str, place)) for v in self.layout.variables}
        if samples is not None and not any(place[:-1]):
            files |= {name: Path(name, "c", *map(str, place[-1:])) for name in samples.names}
        return files

    def write(self, chunk: int, arrays: Columns, sample_values: np.ndarray | None) -> ChunkRecord:
        """Writes a chunk and marks it as done.

        Args:
            arrays: values by variable, one for each point of its box.
            sample_values: values of the samples, one row for each name. Only chunks at the beginning of all axes
                write them.
        """
        layout = self.layout
        files = self._files(chunk)
        box = layout.blocks.box(chunk)
        shape = tuple(b.stop - b.start for b in box)
        checks = dict[str, int]()
        ranges = dict[str, tuple[float, float]]()
        for name, (dtype, _) in layout.variables.items():
            values = np.asarray(arrays[name], dtype)
            checks[name] = self._write_array_chunk(
                files[name], values.reshape(shape), layout.blocks.size, fill_value(dtype)
            )
            extremes = float(np.fmin.reduce(values)), float(np.fmax.reduce(values))  # without NaN
            if values.dtype.kind == "f" and np.isfinite(extremes).all():
                ranges[name] = extremes
        samples = layout.design.samples
        if samples is not None and sample_values is not None:
            for name, values in zip(samples.names, sample_values, strict=True):
                checks[name] = self._write_array_chunk(files[name], values, layout.blocks.size[-1:], math.nan)
        counts = np.bincount(np.asarray(arrays[STATUS], np.intp), minlength=len(STATUSES))
        record = ChunkRecord(chunk, tuple(counts.tolist()), ranges, checks)
        assert self._journal is not None
        self._journal.write(_journal_line(record))
        self._journal.flush()
        os.fsync(self._journal.fileno())
        self._intact[chunk] = record
        return record

    def _write_array_chunk(self, file: Path, values: np.ndarray, size: tuple[int, ...], fill: Any) -> int:
        """Writes the chunk of an array and returns its checksum."""
        if values.shape != size:  # the format requires padding of the last chunk of an axis
            padded = np.full(size, fill, values.dtype)
            padded[tuple(slice(n) for n in values.shape)] = values
            values = padded
        path = self.partial / STORE / file
        path.parent.mkdir(parents=True, exist_ok=True)
        content = values.tobytes()
        if self.layout.compression == "zstd":
            from numcodecs.zstd import Zstd

            content = bytes(Zstd(**ZSTD).encode(content))
        write_file(path, content, self._temporary)
        return zlib.crc32(content)

    # --- the end ----------------------------------------------------------------------------------

    @contextlib.contextmanager
    def finishing(self) -> Iterator[bool]:
        """Yields True if this process finishes the sweep: every chunk is done and no process has finished it."""
        with self._locked():
            if not self._present():  # another process has moved it into place
                self.finished = True
            yield not self.finished and len(self.done()) == len(self.layout.blocks)

    def move_into_place(self) -> Path:
        """Moves the folder as `Folder.move_into_place` does. Call it within `finishing`."""
        path = super().move_into_place()
        self.finished = True
        return path

    def close(self) -> None:
        """Releases all locks, so that other processes can continue."""
        if self._journal is not None:
            with contextlib.suppress(OSError):  # the disk is full, which was reported
                self._journal.close()
        self._journal = self._share = None
        super().close()

    def abandon(self) -> None:
        """Removes the store if this process created it, no chunk is done, and no other process is working on it."""
        if self.finished or self._share is None:
            return
        with self._locked(), contextlib.suppress(OSError):
            if self._present() and not self.done() and share_at_work(self.partial, self._share) is None:
                self._remove_partial()


def write_file(path: Path, content: Any, temporary: Path) -> None:
    """Writes a file atomically, so that it also survives a power failure.

    Args:
        temporary: temporary path on the same disk, which is renamed at the end.
    """
    try:
        with temporary.open("wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        error.filename = str(path)
        raise


ZSTD: Json = {"level": 1, "checksum": False}


def create_store(path: Path, layout: StoreLayout) -> None:
    """Metadata of every array of a store, and the values of its axes."""
    import zarr
    from zarr.codecs import ZstdCodec

    compressors = None if layout.compression == "none" else [ZstdCodec(**ZSTD)]
    group = zarr.create_group(path, zarr_format=3, attributes=dict(layout.attributes))
    design, blocks = layout.design, layout.blocks
    sampled_names = design.samples.names if design.samples is not None else ()
    coordinate_attribute = {"coordinates": " ".join(sampled_names)} if sampled_names else {}
    for name, (dtype, attributes) in layout.variables.items():
        group.create_array(
            name, shape=design.shape, chunks=blocks.size, dtype=dtype, fill_value=fill_value(dtype),
            compressors=compressors, dimension_names=design.dimensions,
            attributes={**attributes, **coordinate_attribute},
        )  # fmt: skip
    for name, values in design.axes.items():
        words = layout.labels.get(name)
        array = group.create_array(
            name, shape=values.shape, chunks=values.shape, dtype=str if words else "float64", compressors=None,
            dimension_names=(name,), attributes=dict(layout.coordinates[name]),
        )  # fmt: skip
        array[:] = np.array([words[int(k)] for k in values], object) if words else values
    for name in sampled_names:
        group.create_array(
            name, shape=design.shape[-1:], chunks=blocks.size[-1:], dtype="float64", fill_value=math.nan,
            compressors=compressors, dimension_names=(SAMPLE,), attributes=dict(layout.coordinates[name]),
        )  # fmt: skip
    with warnings.catch_warnings():
        # without it xarray warns
        warnings.filterwarnings("ignore", message="Consolidated metadata is currently not part")
        zarr.consolidate_metadata(path)


#: Maximum number of sampled points of a store, and of chunks that they are read from.
SAMPLED_POINTS, SAMPLED_CHUNKS = 200_000, 100


def sample_store(store: Path, layout: StoreLayout) -> tuple[Columns, Columns]:
    """Varied values and outputs by name, at a random selection of the points. The seed is fixed."""
    import zarr

    group: Any = zarr.open_group(store, mode="r")
    rng = np.random.default_rng(0)
    blocks = layout.blocks
    design = layout.design
    chunks = np.sort(rng.permutation(len(blocks))[:SAMPLED_CHUNKS])
    points_per_chunk = -(-SAMPLED_POINTS // len(chunks))
    values = list[np.ndarray]()
    outputs = {name: list[np.ndarray]() for name in layout.variables}
    for chunk in map(int, chunks):
        box, count = blocks.box(chunk), blocks.count(chunk)
        rows = np.sort(rng.permutation(count)[:points_per_chunk]) if count > points_per_chunk else np.arange(count)
        values.append(design.values_in_slices(box)[rows])
        for name, parts in outputs.items():
            parts.append(group[name][box].ravel()[rows])
    varied = dict(zip(design.names, np.concatenate(values).T, strict=True))
    return varied, {name: np.concatenate(parts) for name, parts in outputs.items()}


def _disk_size(size: int) -> int:
    return -(-size // BLOCK) * BLOCK


def fill_value(dtype: str) -> Any:
    """Value of points that have not been simulated."""
    return math.nan if np.dtype(dtype).kind == "f" else ABSENT


def _journal_line(record: ChunkRecord) -> str:
    body = json.dumps(dataclasses.astuple(record), separators=(",", ":"))
    return f"{zlib.crc32(body.encode()):08x} {body}\n"


def _parse_line(line: str) -> ChunkRecord | None:
    """Entry of a journal line, None if the line is incomplete."""
    check, _, body = line.partition(" ")
    if not body or f"{zlib.crc32(body.encode()):08x}" != check:
        return None
    try:
        chunk, statuses, ranges, checks = json.loads(body)
        return ChunkRecord(int(chunk), tuple(statuses), {name: tuple(r) for name, r in ranges.items()}, dict(checks))
    except (ValueError, TypeError, AttributeError, RecursionError):
        return None
