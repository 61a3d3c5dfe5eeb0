"""Files that store stage results. A JSON part holds values, names of our classes and positions of arrays; a binary
part holds the arrays. Each file is an `np.savez` archive whose checksum covers both parts. Reading runs no code from
the file. A file can name only dataclasses of `mmrjax` and `calibration`, effects that the user has loaded, and the
functions in `FUNCTIONS`. Fields are set without calling a constructor.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import inspect
import json
import math
import sys
import types
from pathlib import Path
from typing import Any, Literal

import numpy as np

from calibration.data import Columns
from calibration.data.effect_file import OWN_MODULE
from mmrjax.effects.scaled import scaled_effect
from mmrjax.model import channels
from mmrjax.model.channels import Channel

#: Packages whose dataclasses a file may name, and modules whose functions it may name.
PACKAGES = ("mmrjax", "calibration")
FUNCTIONS = ("calibration.discovery.menu", "calibration.discovery.menu")
#: Kinds of arrays that consist only of bytes.
KINDS = "biufcSU"


class Unwritable(Exception):
    """A value has a type that such a file cannot hold."""


class Unreadable(Exception):
    """A file is damaged, or holds no stage."""


def write_stage(file: Path, value: Any) -> None:
    """Writes a value.

    Raises:
        Unwritable: a part of it is no value, no array, and no instance of our dataclasses.
        OSError: the file cannot be written.
    """
    writer = _Writer()
    try:
        tree = json.dumps(writer.encoded(value), separators=(",", ":"), allow_nan=False).encode()
    except (RecursionError, TypeError, ValueError) as error:  # nested too deeply, without attributes, a huge number
        raise Unwritable(f"{type(error).__name__}: {error}") from error
    with file.open("wb") as stream:
        data = np.concatenate([np.zeros(0, np.uint8), *writer.data])
        np.savez(stream, allow_pickle=False, tree=np.frombuffer(tree, np.uint8), data=data)


def read_stage(file: Path) -> Any:
    """Reads a value written by `write_stage`.

    Raises:
        Unreadable: the file cannot be read, or names something that it must not.
    """
    try:
        arrays = read_arrays(file)
        return _Reader(arrays["data"].tobytes()).decoded(json.loads(arrays["tree"].tobytes()))
    except Exception as error:  # a damaged or forged file can raise anything
        raise Unreadable(f"{type(error).__name__}: {error}") from error


def read_arrays(file: Path) -> Columns:
    """Arrays of a file of `np.savez` without objects. A damaged file raises NumPy's errors."""
    with file.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
        return {key: arrays[key] for key in arrays.files}


#: Weakly typed arrays with more values are read as strongly typed arrays.
FEW = 256


class _Writer:
    """Encodes values: JSON has lists and plain values as they are, everything else as [KIND, ...]."""

    def __init__(self) -> None:
        self.data: list[np.ndarray] = []
        self._size = 0
        self._number: dict[int, int] = {}
        self._alive: list[Any] = []  # so that ids stay unique

    def encoded(self, x: Any) -> Any:
        if x is None or type(x) in (bool, int, str) or (type(x) is float and math.isfinite(x)):
            return x
        if type(x) is float:
            return ["float", str(x)]
        if id(x) in self._number:
            return ["again", self._number[id(x)]]
        encoding = self._compound(x)
        self._number[id(x)] = len(self._alive)
        self._alive.append(x)
        return encoding

    def _compound(self, x: Any) -> list[Any]:
        import jax

        if isinstance(x, Channel):
            return ["channel", x.name]
        if type(x) in (list, tuple, set, frozenset):
            return [type(x).__name__, [self.encoded(item) for item in x]]
        if type(x) is dict:
            return ["dict", [[self.encoded(key), self.encoded(item)] for key, item in x.items()]]
        if isinstance(x, np.ndarray | np.generic):
            return ["scalar" if isinstance(x, np.generic) else "array", *self._array(np.asarray(x))]
        if isinstance(x, jax.Array) and not jax.dtypes.issubdtype(x.dtype, jax.dtypes.extended):
            return ["jax", bool(x.aval.weak_type), *self._array(np.asarray(x))]
        if isinstance(x, type):
            return ["type", *_named_class(x)]
        if isinstance(x, types.FunctionType) and x.__module__ in FUNCTIONS:
            return ["function", x.__module__, x.__qualname__]
        if dataclasses.is_dataclass(x):
            fields = {name: self.encoded(value) for name, value in vars(x).items() if _holds(type(x), name)}
            return ["instance", *_named_class(type(x)), fields]
        if isinstance(x, tuple) and hasattr(x, "_fields"):
            return ["named", *_named_class(type(x)), [self.encoded(item) for item in x]]
        raise Unwritable(f"{type(x).__module__}.{type(x).__qualname__}")

    def _array(self, x: np.ndarray) -> list[Any]:
        if x.dtype.kind == "O":
            return ["O", list(x.shape), [self.encoded(item) for item in x.ravel()]]
        if x.dtype.kind not in KINDS:
            raise Unwritable(f"array of {x.dtype}")
        order: Literal["F", "C"] = (
            "F" if x.flags.f_contiguous and not x.flags.c_contiguous else "C"
        )  # which sums depend on
        content = x.ravel(order).view(np.uint8)
        offset, self._size = self._size, self._size + len(content)
        self.data.append(content)
        return [x.dtype.str, list(x.shape), order, offset]


class _Reader:
    """Decodes what `_Writer` encoded."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._known: list[Any] = []

    def decoded(self, x: Any) -> Any:
        if not isinstance(x, list):
            if isinstance(x, dict):
                raise Unreadable("a JSON object without a kind")
            return x
        kind, *rest = x
        if kind == "float":
            return float(rest[0])
        if kind == "again":
            return self._known[rest[0]]
        instance = self._compound(kind, *rest)
        self._known.append(instance)
        return instance

    def _compound(self, kind: str, *rest: Any) -> Any:
        if kind == "channel":
            return channels.find_channel(rest[0])
        if kind in ("list", "tuple", "set", "frozenset"):
            items = [self.decoded(item) for item in rest[0]]
            return {"list": list, "tuple": tuple, "set": set, "frozenset": frozenset}[kind](items)
        if kind == "dict":
            return {self.decoded(key): self.decoded(item) for key, item in rest[0]}
        if kind == "scalar":
            return self._array(*rest)[()]
        if kind == "array":
            return self._array(*rest)
        if kind == "jax":
            x = self._array(*rest[1:])
            weak = rest[0]
            import jax.numpy as jnp

            if not weak or not 0 < x.size <= FEW:
                return jnp.asarray(x)
            # Python scalars are weakly typed, and another program would be compiled for them.
            scalars = [jnp.asarray(value) for value in x.ravel().tolist()]
            return scalars[0] if x.shape == () else jnp.stack(scalars).reshape(x.shape)
        if kind == "type":
            return _class(*rest)
        if kind == "function":
            return _function(*rest)
        if kind == "instance":
            return self._instance(*rest)
        if kind == "named":
            return _class(*rest[:3])(*map(self.decoded, rest[3]))
        raise Unreadable(f"no such kind: {kind}")

    def _array(self, dtype: str, shape: list[int], *rest: Any) -> np.ndarray:
        if dtype == "O":
            filled = np.empty(math.prod(shape), object)
            filled[:] = [self.decoded(item) for item in rest[0]]
            return filled.reshape(shape)
        order, offset = rest
        kind = np.dtype(dtype)
        if kind.kind not in KINDS:
            raise Unreadable(f"array of {dtype}")
        return np.frombuffer(self._data, kind, math.prod(shape), offset).reshape(shape, order=order).copy("K")

    def _instance(self, module: str, name: str, factors: list[float] | None, fields: dict[str, Any]) -> Any:
        kind = _class(module, name, factors)
        if not dataclasses.is_dataclass(kind) or not all(_holds(kind, name) for name in fields):
            raise Unreadable(f"{module}.{name} has other fields")
        instance: Any = object.__new__(kind)
        for field, value in fields.items():
            object.__setattr__(instance, field, self.decoded(value))
        return instance


def _holds(kind: type, name: str) -> bool:
    """True if instances of a dataclass hold a value by that name: a field, or a cached property."""
    attribute = inspect.getattr_static(kind, name, None)
    fields: dict[str, Any] = getattr(kind, "__dataclass_fields__", {})
    return name in fields or isinstance(attribute, functools.cached_property)


def _named_class(kind: type) -> tuple[str, str, list[float] | None]:
    """Module and name of a class, and the factors of an effect that differs from it only by its priors."""
    plain = getattr(kind, "plain", None)
    base, factors = (kind, None) if plain is None else (plain, list(vars(kind)["factors"]))
    name = base.__module__, base.__qualname__
    if _class(*name, None) is not base:
        raise Unwritable(".".join(name))
    return *name, factors


def _class(module: str, name: str, factors: list[float] | None) -> type:
    """Class by name, from our packages or the effects that the user has loaded.

    Raises:
        Unreadable: there is no such class.
    """
    if module.partition(".")[0] in PACKAGES:
        target: Any = importlib.import_module(module)
    elif module.startswith(OWN_MODULE) and module in sys.modules:
        target = sys.modules[module]
    else:
        raise Unreadable(f"a class of {module}")
    for part in name.split("."):
        target = getattr(target, part)
    if not isinstance(target, type) or target.__module__ != module:
        raise Unreadable(f"{module}.{name} is no class there")
    return target if factors is None else scaled_effect(target, tuple(factors))


def _function(module: str, name: str) -> types.FunctionType:
    function = getattr(importlib.import_module(module), name) if module in FUNCTIONS else None
    if not isinstance(function, types.FunctionType) or function.__module__ != module:
        raise Unreadable(f"{module}.{name} is no function of a stage")
    return function
