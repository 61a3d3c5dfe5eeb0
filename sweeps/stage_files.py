"""Files that store finished chunks and stages, so that an interrupted command can continue.

Each file is a pickle after its checksum. Reading runs no code from the file. A pickle may name only dataclasses and
named tuples of `mmrjax` and `calibration`, effects that the user has loaded, and a few functions. These functions are
in `REBUILDERS`, `ARRAYS` and `FUNCTIONS`.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import pickle
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data.effect_file import OWN_MODULE
from mmrjax.effects.base import restore_effect, scaled_effect
from mmrjax.model import channels
from mmrjax.model.channels import Channel

#: Packages whose classes a file may name, and the module whose functions it may name.
PACKAGES, FUNCTIONS = ("mmrjax", "calibration"), "calibration.discovery.menu"
#: Functions that rebuild objects from their parts.
REBUILDERS = (channels.find_channel, scaled_effect, restore_effect)
#: Classes and functions that rebuild arrays and numbers of NumPy, and the function for arrays of JAX, by its name.
ARRAYS = (
    np.ndarray, np.dtype, np.zeros(1).__reduce__()[0], np.zeros(1).__reduce_ex__(5)[0], np.float64(0).__reduce__()[0],
)  # fmt: skip
JAX_ARRAY = ("jax._src.array", "_reconstruct_array")


class Unwritable(Exception):
    """A value has a type that such a file cannot hold."""


class Unreadable(Exception):
    """A file is damaged, or names something that it must not."""


def write_stage(file: Path, value: Any) -> None:
    """Writes a value.

    Raises:
        Unwritable: a part of it is no plain value, no array, and no instance of our dataclasses.
        OSError: the file cannot be written.
    """
    content = io.BytesIO()
    try:
        _Writer(content, protocol=5).dump(value)
    except (RecursionError, TypeError, ValueError, AttributeError, pickle.PickleError) as error:
        raise Unwritable(f"{type(error).__name__}: {error}") from error
    file.write_bytes(sealed(content.getvalue()))


def sealed(content: bytes) -> bytes:
    """Content of a file after its checksum."""
    return hashlib.sha256(content).digest() + content


def read_stage(file: Path) -> Any:
    """Reads a value written by `write_stage`.

    Raises:
        Unreadable: the file cannot be read, or names something that it must not.
    """
    try:
        stored = file.read_bytes()
        content = stored[hashlib.sha256().digest_size :]
        if stored != sealed(content):
            raise pickle.PickleError("another checksum")
        return _Reader(io.BytesIO(content)).load()
    except Exception as error:  # a damaged or forged file can raise anything
        raise Unreadable(f"{type(error).__name__}: {error}") from error


class _Writer(pickle.Pickler):
    """Pickles a value whose classes and functions `_Reader` accepts."""

    def reducer_override(self, x: Any) -> Any:
        if isinstance(x, Channel):
            return channels.find_channel, (x.name,)
        if isinstance(x, type) and (plain := getattr(x, "plain", None)) is not None:
            return scaled_effect, (plain, vars(x)["factors"])
        if isinstance(x, type | types.FunctionType | types.BuiltinFunctionType):
            _check_module(x.__module__)
            _check_named(x, x.__module__)
        return NotImplemented


class _Reader(pickle.Unpickler):
    """Unpickles values written by `_Writer`."""

    def find_class(self, module: str, name: str) -> Any:
        _check_module(module)  # before it is imported
        target = super().find_class(module, name)
        _check_named(target, module)
        return target


def _check_module(module: str) -> None:
    """Raises `pickle.PickleError` for a module that a file may not name."""
    is_user_module = module.startswith(OWN_MODULE) and module in sys.modules
    is_array_module = module == JAX_ARRAY[0] or module in [x.__module__ for x in ARRAYS]
    if module.partition(".")[0] not in PACKAGES and not is_user_module and not is_array_module:
        raise pickle.PickleError(f"a class of {module}")


def _check_named(target: Any, module: str) -> None:
    """Raises `pickle.PickleError` for a class or a function of a module that a file may not name."""
    name = getattr(target, "__qualname__", str(target))
    if target in ARRAYS or (module, name) == JAX_ARRAY:
        return
    is_record = isinstance(target, type) and (dataclasses.is_dataclass(target) or issubclass(target, tuple))
    is_function = isinstance(target, types.FunctionType) and (target in REBUILDERS or module == FUNCTIONS)
    if target.__module__ != module or not (is_record or is_function):
        raise pickle.PickleError(f"{module}.{name}")
