"""Compilation cache: programs compiled by XLA, stored on disk so that later processes can read them.

The folder is `$MMRJAX_CACHE`, otherwise `$XDG_CACHE_HOME/mmrjax`, otherwise `~/.cache/mmrjax`. `MMRJAX_CACHE=off`
switches it off. JAX keys an entry by program, compiler version, flags and device. Each version of jaxlib and each
kind of processor has its own subfolder, because machines with different processors may share a home. Programs are
native code, so a folder that others could change is not used (`mmrjax.compile.programs`). This module can be imported
without jax.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import platform
import re
import stat
import warnings
from pathlib import Path

from mmrjax.compile.programs import exposure_reason

VARIABLE = "MMRJAX_CACHE"
#: Variable from which `mmrjax.compile.programs` reads the folder for whole programs. Empty: none are stored.
PROGRAMS = "MMRJAX_PROGRAMS"
OFF = ("off", "0", "no", "false")
#: Size of the cache [bytes] beyond which its oldest entries are deleted when it is enabled, down to half of this.
LIMIT = 4 * 2**30


def cache_location() -> Path | None:
    """Folder of the cache, which may not exist yet. None if the cache is switched off or there is no home folder."""
    folder_text = os.environ.get(VARIABLE, "").strip()
    if folder_text.lower() in OFF:
        return None
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    path = Path(folder_text or (base if base.is_absolute() else Path("~/.cache")) / "mmrjax")
    try:
        path = path.expanduser()
    except RuntimeError:  # the user has no home folder
        return None
    # The subfolder depends on the features of the processor, as native code does.
    try:
        flags = re.findall(r"^(?:flags|Features)\s*:.*", Path("/proc/cpuinfo").read_text(encoding="utf-8"), re.M)[:1]
    except OSError:
        flags = []
    processor_text = " ".join([platform.machine(), platform.processor(), *flags])
    processor = f"{platform.machine()}-{hashlib.sha256(processor_text.encode()).hexdigest()[:8]}"
    return path / f"xla-{importlib.metadata.version('jaxlib')}-{processor}"


def keep_programs() -> Path | None:
    """Enables the cache for every compiled program, however small. Call it before anything compiles.

    A cache in JAX's own settings (`JAX_COMPILATION_CACHE_DIR`) takes precedence. An entry that cannot be read is
    compiled again. If other users could change the folder, it is not used, and a line on stderr reports this.

    Returns:
        The folder. None if the cache is switched off, or the folder cannot be written or could be changed by others.
    """
    if _is_unsafe(os.environ.get(PROGRAMS, "")):
        os.environ[PROGRAMS] = ""
    folder = cache_location()
    if folder is None:
        return None
    # On some processors XLA logs an error for each program that it reads. It mistakes tuning flags of its own
    # compiler for features of another machine (openxla/xla issue 44565). Real failures are also raised.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    # Checks of diffrax that raise contain a host callback, and JAX does not store such programs. They check that
    # times increase, which holds by construction here. Otherwise the result would be NaN.
    os.environ.setdefault("EQX_ON_ERROR", "nan")
    import jax

    jax_folder = jax.config.values["jax_compilation_cache_dir"]
    if jax_folder is not None:
        if "://" not in jax_folder and _is_unsafe(jax_folder):
            jax.config.update("jax_enable_compilation_cache", False)
            return None
        return Path(jax_folder)
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError:
        return None
    if not os.access(folder, os.W_OK | os.X_OK) or _is_unsafe(str(folder)):
        return None
    _delete_oldest(folder.parent)
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation cache entry")
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    jax.config.update("jax_raise_persistent_cache_errors", False)
    os.environ.setdefault(PROGRAMS, str(folder))
    return folder


def _is_unsafe(folder: str) -> bool:
    """True if other users could change a folder of compiled programs, and thus run their code. Prints a message."""
    reason = exposure_reason(Path(folder)) if folder else ""
    if reason:
        from sweeps.console import print_message

        print_message(
            f"compiled programs are not cached: {reason}. Set {VARIABLE} to your own folder, or chmod go-w it"
        )
    return bool(reason)


def _cache_entries(folder: Path) -> list[tuple[float, int, Path]]:
    """Time of writing, size [bytes] and path of every entry."""
    entries = []
    for path in folder.iterdir() if folder.is_dir() else ():
        try:
            state = path.stat()
        except OSError:  # deleted by another process meanwhile
            continue
        if stat.S_ISREG(state.st_mode):  # with a GPU, XLA keeps its own folder there
            entries.append((state.st_mtime, state.st_size, path))
    return entries


def _delete_oldest(caches: Path) -> None:
    """Deletes the oldest entries of all versions if the cache is larger than `LIMIT`."""
    entries = [entry for folder in caches.glob("xla-*") for entry in _cache_entries(folder)]
    size = sum(entry[1] for entry in entries)
    if size <= LIMIT:
        return
    for _, entry_size, path in sorted(entries):
        path.unlink(missing_ok=True)
        size -= entry_size
        if size <= LIMIT / 2:
            return


def describe_cache() -> str:
    """Folder of the cache with number and size of its programs, or the reason for not using it."""
    folder = cache_location()
    if folder is None:
        return f"off ({VARIABLE}=off)" if os.environ.get(VARIABLE) else "off"
    if reason := exposure_reason(folder):
        return f"{folder}: not used, since {reason}"
    entries = _cache_entries(folder)
    return f"{folder}: {len(entries)} programs, {sum(entry[1] for entry in entries) / 1e6:.1f} MB"
