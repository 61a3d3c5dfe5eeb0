"""NumPy, MATLAB and HDF5 files: named arrays."""

from __future__ import annotations

import functools
import zipfile
import zlib
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np

from calibration.data import input_files
from calibration.data.input_errors import BadData
from calibration.data.sources.recorded_signals import Signal, StoredArray, array_in_memory, part_of, signals_of_arrays

#: Kind of a compressed variable in a MATLAB file.
COMPRESSED = 15


def signals_of_npz(path: Path, name: str) -> tuple[Signal, ...]:
    """Signals of an .npz archive. Arrays of Python objects are never loaded.

    Raises:
        BadData: a member whose path leads out of the archive.
    """
    arrays: dict[str, StoredArray] = {}
    archive = zipfile.ZipFile(path)  # stays open until no signal needs it
    input_files.check_declared(name, len(archive.namelist()))
    for member in archive.namelist():
        member_path = PurePosixPath(member.replace("\\", "/"))
        if member_path.is_absolute() or ".." in member_path.parts:
            raise BadData(f"{name}, {member}: is a path that points outside the archive; expected names of arrays")
        if member_path.suffix != ".npy":
            continue
        array = member.removesuffix(".npy")
        if array in arrays:
            raise BadData(f"{name}, {member}: is in the archive twice; expected different names")
        with archive.open(member) as stream:
            arrays[array] = (
                *_read_npy_header(stream),
                functools.cache(functools.partial(_load_member, archive, member)),
            )
    return signals_of_arrays(name, arrays)


def signals_of_npy(path: Path, name: str) -> tuple[Signal, ...]:
    """Signals of an .npy file: columns of its array, or fields of its records."""
    with path.open("rb") as stream:
        shape, dtype = _read_npy_header(stream)
    loaded = functools.cache(lambda: np.load(path, allow_pickle=False))
    signals = signals_of_arrays(name, {path.stem: (shape, dtype, loaded)})
    fields = (replace(s, path=s.path.removeprefix(f"{path.stem}.")) for s in signals)
    return tuple(fields) if dtype.names else signals


def _read_npy_header(stream: Any) -> tuple[tuple[int, ...], np.dtype]:
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(stream)
    return shape, dtype


def _load_member(archive: zipfile.ZipFile, member: str) -> np.ndarray:
    with archive.open(member) as stream:
        return np.lib.format.read_array(stream, allow_pickle=False)


def signals_of_matlab(path: Path, name: str) -> tuple[Signal, ...]:
    """Signals of a MATLAB file up to version 7. Fields of structures are named by path, `log.motor.speed`."""
    from scipy import io

    _check_matlab(path, name)
    loaded = functools.cache(lambda: io.loadmat(path, squeeze_me=False, struct_as_record=True, chars_as_strings=True))
    arrays: dict[str, StoredArray] = {}
    plain = {"double", "single", "logical", *(f"{sign}int{n}" for sign in ("", "u") for n in (8, 16, 32, 64))}
    types = {"char": np.dtype(str)} | dict.fromkeys(plain, np.dtype(float))
    for variable, shape, kind in io.whosmat(path):
        if kind == "struct":
            arrays |= {field: array_in_memory(v) for field, v in _structure_fields(variable, loaded()[variable])}
        else:
            arrays[variable] = (shape, types.get(kind, np.dtype(object)), part_of(loaded, variable))
    return signals_of_arrays(name, arrays)


def _check_matlab(path: Path, name: str) -> None:
    """Rejects a file whose variables need more memory than is free, because reading one of them loads all.

    Raises:
        BadData: they need more.
    """
    content = input_files.file_bytes(path, name)
    order: Literal["little", "big"] = "big" if content[126:128] == b"MI" else "little"
    offset, size = 128, 0
    while offset + 8 <= len(content):
        kind, length = (int.from_bytes(content[k : k + 4], order) for k in (offset, offset + 4))
        offset += 8
        # in a compressed variable, the decompressed size follows its type
        begin = zlib.decompressobj().decompress(content[offset : offset + 256], 8) if kind == COMPRESSED else b""
        size += int.from_bytes(begin[4:8], order) if begin else length
        offset += length
    input_files.check_declared(name, 1, size, len(content))
    input_files.check_memory(name, size)


def _structure_fields(path: str, structure: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Arrays of a structure by path. In an array of structures the path has an index."""
    if structure.dtype.names is None:
        return [(path, structure)]
    fields: list[tuple[str, np.ndarray]] = []
    for k, element in enumerate(np.ravel(structure)):
        field_path = path if structure.size == 1 else f"{path}[{k}]"
        for field in structure.dtype.names:
            fields += _structure_fields(f"{field_path}.{field}", np.asarray(element[field]))
    return fields


def signals_of_hdf5(path: Path, name: str) -> tuple[Signal, ...]:
    """Signals of an HDF5 file, or of a MATLAB file of version 7.3, by their path.

    Raises:
        BadData: a link or the storage of a dataset leads to another file.
    """
    import h5py

    arrays: dict[str, StoredArray] = {}
    units: dict[str, str] = {}
    addresses: set[int] = set()

    def add_group(group: Any, path_of_group: str) -> None:
        address = h5py.h5o.get_info(group.id).addr
        if address in addresses:  # a group with several paths is read only under the first one
            return
        addresses.add(address)
        for key in group:
            if not _is_inside(group, key, name):
                continue
            item, item_path = group[key], f"{path_of_group}/{key}"
            if isinstance(item, h5py.Group):
                add_group(item, item_path)
            elif isinstance(item, h5py.Dataset) and item.shape is not None:
                if item.external or item.is_virtual:
                    raise BadData(
                        f"{name}, {item_path}: its values are in another file; copy its data into this file"
                    )
                is_text = h5py.check_string_dtype(item.dtype) is not None
                is_char = is_matlab and item.attrs.get("MATLAB_class") == b"char"
                dtype = np.dtype(f"U{item.dtype.itemsize}") if is_text or is_char else item.dtype
                load = functools.cache(functools.partial(_load_dataset, path, item_path, is_text, is_char, is_matlab))
                arrays[item_path] = (item.shape[::-1] if is_matlab else item.shape, dtype, load)
                unit = next((item.attrs[k] for k in ("unit", "units", "Unit", "Units") if k in item.attrs), "")
                units[item_path] = unit.decode("utf-8", "replace") if isinstance(unit, bytes) else str(unit)

    with h5py.File(path, "r") as file:
        is_matlab = any("MATLAB_class" in file[key].attrs for key in file if _is_inside(file, key, name))
        add_group(file, "")
    return signals_of_arrays(name, arrays, units)


def _is_inside(group: Any, key: str, name: str) -> bool:
    import h5py

    link = group.get(key, getlink=True)
    if isinstance(link, h5py.ExternalLink):
        raise BadData(
            f"{name}, {group.name.rstrip('/')}/{key}: is a link to another file, {link.filename}; copy its data "
            "into this file"
        )
    return not isinstance(link, h5py.SoftLink) and not key.startswith("#")


def _load_dataset(path: Path, item_path: str, is_text: bool, is_char: bool, is_matlab: bool) -> np.ndarray:
    import h5py

    with h5py.File(path, "r") as file:
        values = np.asarray(file[item_path].asstr()[()], dtype=str) if is_text else np.asarray(file[item_path][()])
        fill_value = file[item_path].attrs.get("_FillValue")  # of netCDF
    if fill_value is not None and np.size(fill_value) == 1 and values.dtype.kind in "iuf":
        values = np.ma.masked_equal(values, np.ravel(fill_value)[0])
    if is_char:
        return np.array(["".join(map(chr, row)) for row in np.atleast_2d(values.T)])
    return values.T if is_matlab else values
