"""Files that store finished chunks and stages, so that an interrupted command can continue.

Each file is an `np.savez` archive, whose checksums cover all parts: a pickle, and the arrays that it refers to.
Reading runs no code from the file: a pickle may name only dataclasses and named tuples of `mmrjax` and `calibration`,
effects that the user has loaded, and the functions in `REBUILDING` and `FUNCTIONS`.
"""

from __future__ import annotations

import dataclasses
import io
import pickle
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data import Columns
from calibration.data.effect_file import OWN_MODULE
from mmrjax.effects.base import restore_effect, scaled_effect
from mmrjax.model import channels
from mmrjax.model.channels import Channel

#: Packages whose classes a file may name, and the module whose functions it may name.
PACKAGES, FUNCTIONS = ("mmrjax", "calibration"), "calibration.discovery.menu"


class Unwritable(Exception):
    """A value has a type that such a file cannot hold."""


class Unreadable(Exception):
    """A file is damaged, or names something that it must not."""


def write_stage(file: Path, value: Any) -> None:
    """Writes a value.

    Raises:
        Unwritable: a part of it is no value, no array, and no instance of our dataclasses.
        OSError: the file cannot be written.
    """
    content = io.BytesIO()
    writer = _Writer(content)
    try:
        writer.dump(value)
    except (RecursionError, TypeError, ValueError, AttributeError, pickle.PickleError) as error:
        raise Unwritable(f"{type(error).__name__}: {error}") from error
    arrays = {str(position): array for position, array in writer.arrays.values()}
    with file.open("wb") as stream:
        np.savez(stream, allow_pickle=False, pickle=np.frombuffer(content.getbuffer(), np.uint8), **arrays)


def read_stage(file: Path) -> Any:
    """Reads a value written by `write_stage`.

    Raises:
        Unreadable: the file cannot be read, or names something that it must not.
    """
    try:
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        return _Reader(arrays).load()
    except Exception as error:  # a damaged or forged file can raise anything
        raise Unreadable(f"{type(error).__name__}: {error}") from error


class _Writer(pickle.Pickler):
    """Pickles a value without its arrays of numbers, which it numbers and collects."""

    def __init__(self, stream: io.BytesIO) -> None:
        super().__init__(stream, protocol=5)
        self.arrays: dict[int, tuple[int, np.ndarray]] = {}

    def persistent_id(self, x: Any) -> int | None:
        if not isinstance(x, np.ndarray) or x.dtype.hasobject:
            return None
        return self.arrays.setdefault(id(x), (len(self.arrays), x))[0]

    def reducer_override(self, x: Any) -> Any:
        import jax

        if isinstance(x, Channel):
            return channels.find_channel, (x.name,)
        if isinstance(x, np.generic):
            return _scalar, (np.asarray(x),)
        if isinstance(x, np.ndarray):
            return _object_array, (x.shape, x.ravel().tolist())
        if isinstance(x, jax.Array) and not jax.dtypes.issubdtype(x.dtype, jax.dtypes.extended):
            return _device_array, (np.asarray(x), bool(x.aval.weak_type))
        if isinstance(x, type) and (plain := getattr(x, "plain", None)) is not None:
            return scaled_effect, (plain, vars(x)["factors"])
        if isinstance(x, type | types.FunctionType | types.BuiltinFunctionType):
            _check_module(x.__module__)
            _check_named(x, x.__module__)
        return NotImplemented


class _Reader(pickle.Unpickler):
    """Reads what `_Writer` wrote."""

    def __init__(self, arrays: Columns) -> None:
        super().__init__(io.BytesIO(arrays["pickle"].tobytes()))
        self._arrays = arrays

    def persistent_load(self, pid: int) -> np.ndarray:
        return self._arrays[str(pid)]

    def find_class(self, module: str, name: str) -> Any:
        _check_module(module)  # before it is imported
        target = super().find_class(module, name)
        _check_named(target, module)
        return target


def _check_module(module: str) -> None:
    """Raises `pickle.PickleError` for a module that a file may not name."""
    is_users = module.startswith(OWN_MODULE) and module in sys.modules
    if module.partition(".")[0] not in PACKAGES and module != __name__ and not is_users:
        raise pickle.PickleError(f"a class of {module}")


def _check_named(target: Any, module: str) -> None:
    """Raises `pickle.PickleError` for a class or a function of a module that a file may not name."""
    is_record = isinstance(target, type) and (dataclasses.is_dataclass(target) or issubclass(target, tuple))
    is_function = isinstance(target, types.FunctionType) and (target in REBUILDING or module == FUNCTIONS)
    if target.__module__ != module or not (is_record or is_function):
        raise pickle.PickleError(f"{module}.{getattr(target, '__qualname__', target)}")


def _scalar(array: np.ndarray) -> Any:
    """Scalar of NumPy that an array without dimensions holds."""
    return array[()]


def _object_array(shape: tuple[int, ...], items: list[Any]) -> np.ndarray:
    """Array of these objects."""
    filled = np.empty(len(items), object)
    filled[:] = items
    return filled.reshape(shape)


#: Weakly typed arrays with more values are read as strongly typed arrays.
FEW = 256


def _device_array(array: np.ndarray, weak: bool) -> Any:
    """Array of JAX."""
    import jax.numpy as jnp

    if not weak or not 0 < array.size <= FEW:
        return jnp.asarray(array)
    # Python scalars are weakly typed, and another program would be compiled for strongly typed ones.
    return jnp.stack([jnp.asarray(value) for value in array.ravel().tolist()]).reshape(array.shape)


#: Functions that rebuild objects from their parts.
REBUILDING = (_scalar, _object_array, _device_array, channels.find_channel, scaled_effect, restore_effect)
