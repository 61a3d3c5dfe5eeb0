"""Compiled programs on disk, for arguments of one structure.

JAX's own cache is consulted only after tracing and lowering, which is most of the time of a process that compiles
nothing. Here a program is found by its name, a hash of all inputs of its tracing. These are the source of our
packages, the versions of the libraries, JAX's settings, and the arguments with shapes in place of arrays. Arguments
that cannot be named (a class of a user's own file, an array of keys) are compiled as usual. A program is native code:
it is read only from a folder that nobody but the user can change (`exposure_reason`).

In addition to JAX's cache this saves processor time of warm commands (docs/lab/figures.md, 2026-11-28). It saves 27 %
of `simulate` (7.6 → 5.6 s), 23 % of a `sweep` and 45 % of `loop measured` (68 → 37 s). `jax.export` saves no more: it
needs the same names.
"""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import functools
import hashlib
import importlib.metadata
import io
import os
import pickle
import stat
import sys
import threading
import types
import zlib
from collections.abc import Callable, Hashable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.monitoring
import jax.numpy as jnp
from jax.experimental import serialize_executable


def exposure_reason(folder: Path) -> str:
    """Reason why another user could place files in a folder, empty if only the user and root can.

    The folder and its files have to belong to the user, and neither the group nor others may write to it. Each folder
    above it has to belong to the user or to root, and be sticky if others may write to it: they could rename it.

    Args:
        folder: may not exist yet. The folders above it are checked then.
    """
    if not hasattr(os, "geteuid"):  # a system without owners and modes
        return ""
    absolute_folder = folder.absolute()
    try:
        for part in (absolute_folder, *absolute_folder.parents):
            if part.exists() and (reason := _folder_exposure_reason(part, part == absolute_folder)):
                return reason
        if absolute_folder.resolve() != absolute_folder:
            return exposure_reason(absolute_folder.resolve())
        for entry in absolute_folder.iterdir() if absolute_folder.is_dir() else ():
            if entry.lstat().st_uid != os.geteuid():
                return f"{entry} belongs to another user"
    except OSError as error:
        return f"{error.filename or folder}: {error.strerror}"
    return ""


def _folder_exposure_reason(part: Path, is_folder: bool) -> str:
    """Reason why another user could replace a folder above, or place files in the folder itself."""
    state = part.stat(follow_symlinks=is_folder)
    if state.st_uid != os.geteuid() and (is_folder or state.st_uid != 0):
        return f"{part} belongs to another user"
    writable = state.st_mode & stat.S_IWOTH or (state.st_mode & stat.S_IWGRP and not _is_private_group(state.st_gid))
    sticky = state.st_mode & stat.S_ISVTX and not is_folder
    if writable and not sticky and not stat.S_ISLNK(state.st_mode):
        return f"others may write to {part}"
    return ""


def _is_private_group(group: int) -> bool:
    """True if a group has the user's name: many systems create one for each user."""
    import grp
    import pwd

    try:
        return grp.getgrgid(group).gr_name == pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:
        return False


#: Environment variable with the folder for programs; if it is unset or empty, none are stored.
VARIABLE = "MMRJAX_PROGRAMS"
#: Packages whose source is part of a name, and distributions whose version is part of it.
OWN = ("mmrjax", "calibration", "sweeps")
LIBRARIES = ("jax", "jaxlib", "equinox", "optimistix", "lineax", "diffrax", "optax", "numpy", "scipy", "mujoco-mjx")
_KNOWN = {*OWN, "jax", "jaxlib", "equinox", "optimistix", "lineax", "diffrax", "optax", "numpy", "mujoco"}
_KNOWN |= {"builtins", "functools", "operator", "math", "collections", "copyreg", "types"}
#: Settings of JAX and environment variables for logging and storage, which do not change results. Precision is also
#: here, because stored programs are always in double precision.
_IGNORED_SETTINGS = (
    "jax_compilation_cache",
    "jax_persistent_cache",
    "jax_log",
    "jax_logging",
    "jax_dump",
    "jax_enable_x64",
)
_HEEDED_VARIABLES = ("XLA_", "EQX_")


#: Lock of the thread that traces: two threads that trace one function fill the same stores of JAX and Equinox, which
#: then fail ("Store occupied").
TRACING = threading.RLock()
T = TypeVar("T")


class Unnamed(Exception):
    """Raised for arguments that have no name in other processes."""


class _ArrayPlaceholder:
    """Placeholder of an array in a result."""


@dataclasses.dataclass(frozen=True)
class StoredProgram:
    """One compiled program.

    Attributes:
        executable: maps the list of arrays among the arguments to the list of arrays in the result.
        result: result of the function, with a `_ArrayPlaceholder` for every array.
    """

    executable: Callable[..., list[Any]]
    result: Any

    def __call__(self, arguments: Any) -> Any:
        """Calls the function with arguments of this structure."""
        outputs = iter(self.executable(*_arrays(jax.tree.leaves(arguments))))
        return jax.tree.map(lambda x: next(outputs) if isinstance(x, _ArrayPlaceholder) else x, self.result)


def compile_with_options(lowered: Any, options: dict[str, Any]) -> Any:
    """Compiles with those options that this version of XLA supports.

    Args:
        lowered: result of `jax.jit(function).lower`.
    """
    program = lowered.compile({name: value for name, value in options.items() if _is_supported(name, value)})
    return_memory()
    return program


def return_memory() -> None:
    """Returns freed memory to the system. glibc alone keeps it: up to 200 MB after a compilation."""
    with contextlib.suppress(AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


@functools.cache
def _is_supported(option: str, value: Any) -> bool:
    """True if this version of XLA has a compile option, tried on a small program.

    XLA refuses an option after a tenth of a compilation, which for a log is seconds.
    """
    try:
        jax.jit(lambda x: x).lower(0.0).compile({option: value})
    except jax.errors.JaxRuntimeError:
        return False
    return True


class Programs:
    """The programs of a function by the structure of its arguments, in this process and on disk."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any] | None = None) -> None:
        """Stores the function and the options of the compiler."""
        self.function, self.options = function, options or {}
        self._by_structure: dict[Any, Future[StoredProgram | None]] = {}

    def of(self, arguments: tuple[tuple, dict[str, Any]]) -> StoredProgram | None:
        """The program for positional and named arguments, None if it may not be stored."""
        return self.of_structure(structure_of(arguments), arguments)

    def of_structure(
        self, structure: Hashable | None, arguments: tuple[tuple, dict[str, Any]]
    ) -> StoredProgram | None:
        """The program for arguments of known structure (`structure_of`), None if it may not be stored."""
        folder = os.environ.get(VARIABLE, "")
        if structure is None or not folder or not _may_store_programs() or not _folder_is_private(folder):
            return None
        known_program = self._by_structure.get(structure)
        if known_program is not None:
            return known_program.result()
        # The tracing thread may wait for a program of another thread, which must have finished its own tracing.
        with TRACING:
            is_new = structure not in self._by_structure
            promise = self._by_structure.setdefault(structure, Future())
            if is_new:
                leaves, tree = jax.tree.flatten(arguments)
                make = self._result_or_error(
                    structure, functools.partial(self._loaded_or_lowered, Path(folder), leaves, tree)
                )
        if is_new:
            promise.set_result(self._result_or_error(structure, make))
        return promise.result()

    def _result_or_error(self, structure: Hashable, make: Callable[[], T]) -> T:
        """Result of `make`, stored. After an error it is forgotten, and waiting threads receive the error."""
        try:
            return make()
        except BaseException as error:
            self._by_structure.pop(structure).set_exception(error)
            raise

    def _loaded_or_lowered(self, folder: Path, leaves: list[Any], tree: Any) -> Callable[[], StoredProgram | None]:
        """Returns a function that gives the program: read from the folder, or traced here, compiled and stored."""
        try:
            name = _program_name(self.function, tree.unflatten([_leaf_structure(x) for x in leaves]))
        except (Unnamed, pickle.PicklingError, AttributeError, TypeError, RecursionError):
            return lambda: None
        program_file = folder / f"{name}.program"
        loaded = None
        with contextlib.suppress(Exception):  # an unreadable entry, for any reason, is made again
            loaded = pickle.loads(program_file.read_bytes())
        arrays = _arrays(leaves)
        if loaded is not None:
            result, executable_name = loaded
            executable = _load_executable(folder, executable_name, len(arrays), result)
            if executable is not None:
                return functools.partial(StoredProgram, executable, result)
        result, lowered = self._lower(leaves, tree)
        text = lowered.as_text()
        executable_name = hashlib.sha256(f"{sorted(self.options.items())}{text}".encode()).hexdigest()
        executable = _load_executable(folder, executable_name, len(arrays), result)

        def make() -> StoredProgram:
            """Compiles in parallel with other threads that trace and compile."""
            program = executable
            if program is None:
                with _read_from_cache() as read:
                    program = compile_with_options(lowered, self.options)
                # A program that JAX has read from its cache loses functions when it is written again (XLA on a CPU),
                # and one with callbacks into Python holds addresses of this process.
                if read or "callback" in text:
                    return StoredProgram(program, result)
                with contextlib.suppress(Exception):  # an unwritable program, for any reason, is not stored
                    serialized = serialize_executable.serialize(program)[0]
                    _write_atomically(_executable(folder, executable_name), zlib.compress(serialized, 1))
            with contextlib.suppress(pickle.PicklingError, AttributeError, TypeError):
                _write_atomically(program_file, pickle.dumps((result, executable_name)))
            return StoredProgram(program, result)

        return make

    def _lower(self, leaves: list[Any], tree: Any) -> tuple[Any, Any]:
        """Structure of the function's result, and the function lowered for these arguments."""
        returned: list[Any] = []

        def flat_function(*arrays: Any) -> list[Any]:
            array_iterator = iter(arrays)
            args, keywords = tree.unflatten([next(array_iterator) if eqx.is_array(x) else x for x in leaves])
            out, shape = jax.tree.flatten(self.function(*args, **keywords))
            returned.append(jax.tree.unflatten(shape, [_ArrayPlaceholder() if eqx.is_array(x) else x for x in out]))
            return _arrays(out)

        flat_function.__name__ = f"kept_{getattr(self.function, '__name__', 'function')}"
        # The text names the program on disk; without unused arguments, programs of different functions could collide.
        lowered = jax.jit(flat_function, keep_unused=True).lower(*_arrays(leaves))
        return returned[0], lowered


def structure_of(arguments: Any) -> Hashable | None:
    """Returns the structure of arguments that a program depends on, None if not hashable or if some are traced."""
    leaves, tree = jax.tree.flatten(arguments)
    if has_tracer(leaves):
        return None
    try:
        structure = tree, tuple(_leaf_structure(x) for x in leaves)
        hash(structure)
    except (TypeError, Unnamed):
        return None
    return structure


def has_tracer(tree: Any) -> bool:
    """True if a leaf is a tracer."""
    return any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(tree))


def _arrays(leaves: list[Any]) -> list[Any]:
    return [x for x in leaves if eqx.is_array(x)]


@functools.cache
def _folder_is_private(folder: str) -> bool:
    """True if nobody but the user can change a folder and its files, as checked at first use."""
    return not exposure_reason(Path(folder))


def _may_store_programs() -> bool:
    """True if programs of this process may be stored: double precision, on the single device of a CPU."""
    return bool(jnp.result_type(float) == jnp.float64) and jax.default_backend() == "cpu" and jax.device_count() == 1


def _leaf_structure(leaf: Any) -> Any:
    """Key of a leaf: shape, dtype and weak type of an array. Any other leaf with its type.

    Raises:
        Unnamed: an array of keys, or of another kind that NumPy does not have.
    """
    if not eqx.is_array(leaf):
        return type(leaf), leaf
    if jnp.issubdtype(leaf.dtype, jax.dtypes.extended):
        raise Unnamed
    return leaf.shape, str(leaf.dtype), bool(getattr(leaf, "weak_type", False))


class _ArgumentPickler(pickle.Pickler):
    """Pickles only objects of known packages, equal objects to equal bytes."""

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file, protocol=5)
        self.fast = True  # no references to earlier objects: they depend on which of two equal objects was used

    def reducer_override(self, thing: Any) -> Any:
        is_named = isinstance(thing, type | types.FunctionType | types.BuiltinFunctionType)
        if is_named and (thing.__module__ or "").partition(".")[0] not in _KNOWN:
            raise Unnamed
        if isinstance(thing, type) and _class_object(thing) is not thing:  # made by a function, such as the curves
            facts = sorted((k, v) for k, v in vars(thing).items() if isinstance(v, str | int | float | tuple))
            return tuple, ((thing.__module__, thing.__qualname__, thing.__bases__, *facts),)
        return NotImplemented


def _class_object(thing: type) -> Any:
    """The object that a module holds under the name of a class."""
    scope: Any = sys.modules.get(thing.__module__)
    for name in thing.__qualname__.split("."):
        scope = getattr(scope, name, None)
    return scope


def _program_name(function: Callable[..., Any], arguments: Any) -> str:
    """Name of a program: a hash of all inputs of its tracing.

    Args:
        arguments: arguments with shapes in place of arrays.

    Raises:
        Unnamed: an object belongs to an unknown package.
    """
    qualified_name = function.__module__, function.__qualname__
    if qualified_name[0].partition(".")[0] not in OWN or "<" in qualified_name[1]:
        raise Unnamed
    file = io.BytesIO()
    settings = {k: str(v) for k, v in jax.config.values.items() if not k.startswith(_IGNORED_SETTINGS)}
    settings |= {k: v for k, v in os.environ.items() if k.startswith(_HEEDED_VARIABLES)}
    _ArgumentPickler(file).dump((qualified_name, tuple(sorted(settings.items())), arguments))
    return hashlib.sha256(source_hash().encode() + file.getvalue()).hexdigest()


@functools.cache
def source_hash(root: Path = Path(__file__).resolve().parents[2]) -> str:  # noqa: B008 (a constant)
    """A hash of the source of our packages in a folder, of the versions of the libraries and of Python."""
    digest = hashlib.sha256(sys.version.encode())
    for library in LIBRARIES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            digest.update(f"{library} {importlib.metadata.version(library)}\n".encode())
    for package in OWN:
        for path in sorted((root / package).rglob("*.py")):
            digest.update(f"{path.relative_to(root)}\n".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _executable(folder: Path, name: str) -> Path:
    return folder / f"{name}.executable"


def _load_executable(folder: Path, name: str, arrays: int, result: Any) -> Callable[..., list[Any]] | None:
    """The executable with that name for this number of arrays, None if it is missing or unreadable."""
    result_count = sum(isinstance(x, _ArrayPlaceholder) for x in jax.tree.leaves(result))
    try:
        serialized = zlib.decompress(_executable(folder, name).read_bytes())
        _load_lapack()
        return serialize_executable.deserialize_and_load(
            serialized, jax.tree.structure(((0,) * arrays, {})), jax.tree.structure([0] * result_count)
        )
    except Exception:  # an unreadable entry, for any reason, is made again
        return None


@functools.cache
def _load_lapack() -> None:
    """Lets JAX find LAPACK, as it does when it lowers a call of it: programs read from disk call it too."""
    jax.jit(jnp.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), float))


@contextlib.contextmanager
def _read_from_cache() -> Iterator[list[str]]:
    """Yields a list that is filled if JAX reads a program from its own cache in this thread meanwhile."""
    thread_id = threading.get_ident()
    read = list[str]()

    def listen(event: str, **_: Any) -> None:
        if event.endswith("/cache_hits") and threading.get_ident() == thread_id:
            read.append(event)

    jax.monitoring.register_event_listener(listen)
    try:
        yield read
    finally:
        jax.monitoring.unregister_event_listener(listen)


def _write_atomically(path: Path, content: bytes) -> None:
    """Writes a file completely or not at all. Ignores a folder without write permission."""
    partial = path.with_name(f"{path.name}.{os.getpid()}.{threading.get_ident()}")
    with contextlib.suppress(OSError):
        partial.write_bytes(content)
        partial.replace(path)
