"""Run folders: everything that a command leaves, written aside and moved into place when it is whole."""

from __future__ import annotations

import contextlib
import datetime
import hashlib
import importlib.metadata
import json
import os
import pickle
import platform
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from calibration.data import writing
from calibration.data.errors import BadConfiguration, InputError
from calibration.data.runs import Runs
from mmrjax import __version__, params

if TYPE_CHECKING:
    from mmrjax.robot import Robot
    from sweeps.config import RobotPart

T = TypeVar("T")
#: Exit codes of a command that is done: every solver gave an answer, or one failed. A run that stalls or slides, a
#: requirement that is missed and any verdict are answers.
DONE, SOLVER_FAILED = 0, 3
#: Packages whose versions are part of a result.
PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "equinox", "optimistix", "lineax", "diffrax", "numpy")


class Folder:
    """What a command leaves, in `path` + `.partial` until it is whole and moved into place."""

    def __init__(self, path: Path) -> None:
        """The folder that is to appear at `path`.

        Raises:
            BadConfiguration: no name of a folder.
        """
        if not path.name:
            raise BadConfiguration(f"--out: got {str(path)!r}; expected the name of a folder")
        self.path, self.partial = path, path.with_name(path.name + ".partial")
        self.started = datetime.datetime.now(datetime.UTC)

    def refuse_taken(self, force: bool) -> None:
        """Refuse a path that holds something already.

        Args:
            force: whether a run folder is to be replaced.

        Raises:
            BadConfiguration: it does.
        """
        taken = self.path.is_file() or (self.path.is_dir() and any(self.path.iterdir()))
        if taken and not (force and (self.path / "manifest.json").is_file()):
            hint = "--force replaces a run folder" if self.path.is_dir() else "it is a file"
            raise BadConfiguration(f"--out: {self.path} exists already; choose another path ({hint})")

    def write_text(self, name: str, text: str) -> None:
        """Write a text file."""
        writing.write_text(self.partial / name, text)

    def write_json(self, name: str, content: dict[str, Any]) -> None:
        """Write a JSON file; what is not finite becomes null."""
        writing.write_json(self.partial / name, content)

    def write_table(self, name: str, columns: dict[str, np.ndarray]) -> None:
        """Write a table as CSV; what is not finite becomes an empty cell."""
        writing.write_table(self.partial / name, columns)

    def finish(self, manifest: dict[str, Any], runs: Runs | None = None) -> Path:
        """Write the manifest and move the folder into place; returns its path.

        Hashes of the folder's `robot.toml` and of the file that `runs` came from, if any, are added.
        """
        hashes = {"robot": digest((self.partial / "robot.toml").read_bytes()), **manifest.get("hashes", {})}
        if runs is not None and runs.digest:
            hashes[runs.source] = runs.digest
        now = datetime.datetime.now(datetime.UTC)
        times = {
            "started": self.started.isoformat(timespec="seconds"),
            "seconds": round((now - self.started).total_seconds(), 3),
        }
        self.write_json("manifest.json", {**provenance(), **times, **manifest, "hashes": hashes})
        return self.move_into_place()

    def move_into_place(self) -> Path:
        """The finished folder, where it is to appear."""
        raise NotImplementedError


class RunFolder(Folder):
    """A folder that appears at `path` only when `finish` is called.

    If the command is stopped, the same command with the same configuration finds its finished chunks in `partial`
    and goes on; with another configuration the partial folder is begun anew.
    """

    def __init__(self, path: Path, identity: dict[str, Any], *, force: bool = False) -> None:
        """Begin or take up a run folder.

        Args:
            path: where the folder is to appear.
            identity: what makes this run what it is; two runs with the same identity share their chunks.
            force: replace an existing run folder.

        Raises:
            BadConfiguration: `path` holds something already, or cannot be written.
        """
        super().__init__(path)
        self._force = force
        self.refuse_taken(force)
        self._digest = digest(json.dumps(identity, sort_keys=True, default=str).encode())
        mark = self.partial / "identity"
        foreign = self.partial.exists() and not mark.is_file()
        if foreign and not (self.partial.is_dir() and not any(self.partial.iterdir())):
            raise BadConfiguration(f"--out: {self.partial} is in the way and is no run of ours; choose another path")
        try:
            if mark.is_file() and mark.read_text() != self._digest:
                shutil.rmtree(self.partial)
            (self.partial / "chunks").mkdir(parents=True, exist_ok=True)
            mark.write_text(self._digest)
        except OSError as error:
            raise BadConfiguration(
                f"--out: {path} cannot be written ({error.strerror}); choose another path"
            ) from error

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, *_: Any) -> None:
        """Leave nothing behind where the command was refused, or interrupted before a chunk was done.

        What else an interrupt leaves is taken up again.
        """
        if kind is None:
            return
        if isinstance(error, OSError) and error.filename is None:
            error.filename = str(self.partial)
        chunks = self.partial / "chunks"
        vain = issubclass(kind, KeyboardInterrupt) and not any((*chunks.glob("*.npz"), *chunks.glob("*.stage")))
        if vain or issubclass(kind, InputError):
            shutil.rmtree(self.partial, ignore_errors=True)

    def chunk(self, name: str) -> dict[str, np.ndarray] | None:
        """A chunk that an interrupted run finished, or None."""
        file = self.partial / "chunks" / f"{name}.npz"
        if not file.is_file():
            return None
        with np.load(file, allow_pickle=False) as arrays:
            return {key: arrays[key] for key in arrays.files}

    def keep_chunk(self, name: str, columns: dict[str, np.ndarray]) -> None:
        """Keep a finished chunk for a run that is taken up again."""
        file = self.partial / "chunks" / f"{name}.npz"
        aside = file.with_suffix(".writing")
        with writing.naming(file), aside.open("wb") as stream:
            np.savez(stream, allow_pickle=False, **columns)
        aside.replace(file)

    def stage(self, name: str, make: Callable[[], T]) -> T:
        """The result of a stage: that which an interrupted run of the same identity kept, or made now and kept. What
        cannot be written is not kept."""
        file = self._of_stage(name)
        if file.is_file():
            return pickle.loads(file.read_bytes())
        made = make()
        aside = file.with_suffix(".writing")
        with contextlib.suppress(OSError, pickle.PicklingError, AttributeError, TypeError):
            aside.write_bytes(pickle.dumps(made))
            aside.replace(file)
        return made

    def keeps(self, name: str) -> bool:
        """Whether the result of a stage is kept."""
        return self._of_stage(name).is_file()

    def _of_stage(self, name: str) -> Path:
        return self.partial / "chunks" / f"{re.sub(r'[^a-z0-9.]', '-', name)}.stage"

    def move_into_place(self) -> Path:
        """Drop the chunks, and move the folder to where it is to appear."""
        shutil.rmtree(self.partial / "chunks")
        (self.partial / "identity").unlink()
        if self.path.is_dir():
            if self._force and any(self.path.iterdir()):
                shutil.rmtree(self.path)
            else:
                self.path.rmdir()
        os.replace(self.partial, self.path)
        return self.path


def open_folder(
    command: str, config: RobotPart, robot: Robot, out: Path | None, force: bool, runs: Runs | None = None
) -> RunFolder:
    """The run folder of a command, whose identity is what it was told and the program's source: what another version
    has kept is not gone on with.

    Args:
        command: its name; config: its configuration; robot: the one that the configuration names, changes and all.
        out: where the folder is to appear; None: a new one below `runs/`; force: replace an existing run folder.
        runs: the table that it was given, if any.
    """
    import jax

    from mmrjax.programs import sources

    identity = {
        "command": command,
        "program": f"{sources()}, {jax.default_backend()}",
        "config": config.model_dump(exclude={"report"}),
        "robot": {p.name: float(p.value) for p in params.walk(robot)},
        "runs": None if runs is None else {key: value.tolist() for key, value in runs.columns.items()},
    }
    return RunFolder(out or default_path(command), identity, force=force)


def provenance() -> dict[str, Any]:
    """Program, versions and devices that made a result."""
    import jax
    import jax.numpy as jnp

    return {
        "schema": "mmrjax.manifest/1",
        "program": f"mmrjax {__version__}",
        "arguments": sys.argv[1:],
        "python": platform.python_version(),
        "versions": {name: importlib.metadata.version(name) for name in PACKAGES},
        "devices": [str(d) for d in jax.devices()],
        "float": jnp.result_type(float).name,
    }


def digest(content: bytes) -> str:
    """SHA-256 of some bytes, in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def default_path(command: str) -> Path:
    """`runs/<command>-<time>`, for a command that was given no `--out`."""
    now = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    path = Path("runs") / f"{command}-{now}"
    return path if not path.exists() else path.with_name(f"{path.name}-{os.getpid()}")
