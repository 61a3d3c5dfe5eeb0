"""Compilation cache: programs compiled by XLA, stored on disk so that later processes can read them.

Folder: `$MMRJAX_CACHE`, else `$XDG_CACHE_HOME/mmrjax`, else `~/.cache/mmrjax`. `MMRJAX_CACHE=off` switches it off.
JAX keys an entry by program, compiler version, flags and device. A folder of its own for each version of jaxlib and
each kind of processor keeps native code of one machine from another with the same home. Programs are native code: a
folder that others could change is not used (`mmrjax.compile.programs`). Importable without jax.
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
#: The same of `mmrjax.compile.programs`, which finds programs that were kept whole there; empty to keep none so.
PROGRAMS = "MMRJAX_PROGRAMS"
OFF = ("off", "0", "no", "false")
#: Size beyond which the oldest entries are dropped when the cache is enabled, down to half of it [bytes].
LIMIT = 4 * 2**30


def cache_location() -> Path | None:
    """Folder of the cache, which need not exist yet. None if the cache is switched off or has no known place."""
    folder_text = os.environ.get(VARIABLE, "").strip()
    if folder_text.lower() in OFF:
        return None
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    path = Path(folder_text or (base if base.is_absolute() else Path("~/.cache")) / "mmrjax")
    try:
        path = path.expanduser()
    except RuntimeError:  # nobody's home
        return None
    # Native code depends on the features of the processor.
    try:
        flags = re.findall(r"^(?:flags|Features)\s*:.*", Path("/proc/cpuinfo").read_text(encoding="utf-8"), re.M)[:1]
    except OSError:
        flags = []
    kind = " ".join([platform.machine(), platform.processor(), *flags])
    processor = f"{platform.machine()}-{hashlib.sha256(kind.encode()).hexdigest()[:8]}"
    return path / f"xla-{importlib.metadata.version('jaxlib')}-{processor}"


def keep_programs() -> Path | None:
    """Keep every compiled program, however small, and read programs kept by earlier processes, as the commands do.

    To be called before anything compiles. A cache that JAX has been given by its own settings
    (`JAX_COMPILATION_CACHE_DIR`) stays. An entry that cannot be read is compiled again. `MMRJAX_CACHE` is the folder
    to hold caches, or `off`, without it `~/.cache/mmrjax`. A folder that other users could change is not used, which
    a line on stderr reports.

    Returns:
        The folder, None if the cache is switched off, its place cannot be written to or others could change it.
    """
    if _is_unsafe(os.environ.get(PROGRAMS, "")):
        os.environ[PROGRAMS] = ""
    folder = cache_location()
    if folder is None:
        return None
    # On some processors XLA logs an error for each program that it reads: tuning flags of its own compiler that it
    # takes for features of another machine (openxla/xla issue 44565). What fails is raised, not only logged.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    # Checks inside of diffrax that raise hold a host callback, and such a program is never kept: what they check
    # (times that increase) is right by construction here, and a wrong one would give NaN.
    os.environ.setdefault("EQX_ON_ERROR", "nan")
    import jax

    own_folder = jax.config.values["jax_compilation_cache_dir"]
    if own_folder is not None:
        if "://" not in own_folder and _is_unsafe(own_folder):
            jax.config.update("jax_enable_compilation_cache", False)
            return None
        return Path(own_folder)
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
    """True if other users could change a folder of compiled programs and so run their code. This is reported."""
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
        except OSError:  # dropped by another process meanwhile
            continue
        if stat.S_ISREG(state.st_mode):  # XLA has a folder of its own there, with a GPU
            entries.append((state.st_mtime, state.st_size, path))
    return entries


def _delete_oldest(caches: Path) -> None:
    """Delete the oldest entries of all versions if there are too many."""
    entries = [entry for folder in caches.glob("xla-*") for entry in _cache_entries(folder)]
    size = sum(entry[1] for entry in entries)
    if size <= LIMIT:
        return
    for _, bytes_, path in sorted(entries):
        path.unlink(missing_ok=True)
        size -= bytes_
        if size <= LIMIT / 2:
            return


def describe_cache() -> str:
    """Folder of the cache with number and size of its programs, or why it is not used."""
    folder = cache_location()
    if folder is None:
        return f"off ({VARIABLE}=off)" if os.environ.get(VARIABLE) else "off"
    if exposed := exposure_reason(folder):
        return f"{folder}: not used, since {exposed}"
    entries = _cache_entries(folder)
    return f"{folder}: {len(entries)} programs, {sum(entry[1] for entry in entries) / 1e6:.1f} MB"
