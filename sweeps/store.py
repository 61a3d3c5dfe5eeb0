"""Run folders with the files of a command, written to a temporary folder that is moved into place when complete."""

from __future__ import annotations

import contextlib
import datetime
import errno
import fcntl
import hashlib
import importlib
import importlib.metadata
import json
import os
import platform
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO, TypeVar

from calibration.data import Columns, Json, Names, robot_file, writing
from calibration.data.input_errors import BadConfiguration, InputError
from calibration.data.robot_file import RobotFile
from calibration.data.runs import Runs
from calibration.discovery import REFIT_FILE
from mmrjax import __version__
from mmrjax.model import params
from mmrjax.model.robot import Robot
from sweeps import config as configuration
from sweeps import stage_files
from sweeps.config import FolderPart, RobotPart
from sweeps.console import print_message, print_output
from sweeps.report import terminal_renderer
from sweeps.report.document import Document

Page = Callable[[Path], Any]


def print_report(document: Document, file: RobotFile | None = None, brief: bool = False) -> Page:
    """Prints a document and returns its page, which ends with the robot's parameters if its file is given."""
    terminal_renderer.print_document(document, brief)
    return lambda folder: importlib.import_module("sweeps.report.page_renderer").write_report_page(
        folder, document, file
    )


def finish_run_folder(folder: Folder, manifest: Json, page: Page, solved: bool = True) -> int:
    """Writes configuration, robot and page, moves the folder into place and prints its path.

    Args:
        folder: folder with the command's own files. A `robot.toml` among them is kept.
        manifest: entries in addition to program, versions and hashes.
        page: function that writes the page, called if the configuration wants one.
        solved: True if every solver gave an answer.

    Returns:
        Exit code: 0, or 3 if a solver failed.
    """
    results = folder.results()
    config = folder.config
    if not (results / "robot.toml").exists():
        note = f"the robot of this run, from {config.robot}"
        robot_file.write_robot(folder.robot, results / "robot.toml", note=note)
    folder.write_text("config.resolved.toml", configuration.as_toml(config))
    if getattr(config, "report", True):
        page(results)
    print_output(str(folder.finish(manifest)))
    return DONE if solved else SOLVER_FAILED


T = TypeVar("T")
#: Exit codes of a finished command: all solvers gave an answer, or one failed. A run that stalls or slides, a missed
#: requirement and any verdict are answers.
DONE, SOLVER_FAILED = 0, 3
#: Schemas of a finished run folder, and of the lock file that marks an unfinished one.
MANIFEST, UNFINISHED = "mmrjax.manifest/1", "mmrjax.unfinished/1"
LOCK, CHUNKS = "lock", "chunks"
#: Zarr group of a sweep, journal of its chunks, and temporary folder for its files.
STORE, JOURNAL, IDENTITY, ASIDE = "results.zarr", "journal", "identity.json", "writing"
#: Names in an unfinished folder, before the results are written.
UNFINISHED_NAMES = frozenset((LOCK, CHUNKS, REFIT_FILE, STORE, JOURNAL, IDENTITY, ASIDE))
#: Ending of the files in `CHUNKS`.
STAGE_SUFFIX = ".stage"
#: File with the loop's ranking by regression, before any confirmation.
SCREENING_FILE = "screening.json"
#: Key of the lock file with the names of foreign files.
FOREIGN = "foreign"
#: Commands that fit a robot.
FITTING_COMMANDS = (["calibrate"], ["loop"])
#: Largest manifest or mark that is read [bytes].
LARGEST_FILE = 2**20
#: Packages whose versions are part of a result.
PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "equinox", "optimistix", "lineax", "diffrax", "numpy")


class Folder:
    """Folder with the files of a command, named `path` + `.partial` until it is complete and moved into place.

    Attributes:
        config, robot: configuration of the command, and its robot.
        runs: table whose hash the manifest records, if any.
    """

    config: RobotPart
    robot: Robot
    runs: Runs | None = None
    #: Folder for files that a finished command does not need.
    scratch: str
    #: Names that a finished folder may contain besides those of the manifest.
    extra_names: Names = ()

    def __init__(self, path: Path, force: bool) -> None:
        """Folder that will appear at `path`. `force`: True to replace a run folder there.

        Raises:
            BadConfiguration: the path is no name of a folder.
        """
        if not path.name:
            raise BadConfiguration(f"--out: got {str(path)!r}; expected the name of a folder")
        self.path = path
        self.partial = path.with_name(path.name + ".partial")
        self.tables = "csv"
        self._results_begun = False
        self._digest = ""
        self._force = force
        self._lock: TextIO | None = None
        self.started = datetime.datetime.now(datetime.UTC)

    def refuse_taken(self, force: bool) -> None:
        """Rejects a final path that already exists.

        Args:
            force: True to replace a run folder that contains only files of its command.

        Raises:
            BadConfiguration: the path exists and may not be replaced.
        """
        if not os.path.lexists(self.path) or (self.path.is_dir() and not any(self.path.iterdir())):
            return
        if not self.path.is_dir():
            hint = "it is a file"
        elif not force:
            hint = "--force replaces a run folder"
        elif (file_names := listed_names(self.path)) is None:
            hint = "--force replaces only run folders"
        else:
            leftovers = (LOCK, self.scratch)  # of a process that was moving the folder
            foreign = sorted({p.name for p in self.path.iterdir()} - {*file_names, *leftovers, *self.extra_names})
            if not foreign:
                return
            hint = f"--force would delete {foreign[0]}, which its command did not write"
        raise BadConfiguration(f"--out: {self.path} exists already; choose another path ({hint})")

    def refuse_foreign(self, command: str, force: bool) -> None:
        """Rejects a `.partial` folder that is not ours, or contains a foreign file or interrupted work of another
        command.

        Args:
            command: command that will continue there.
            force: True to discard interrupted work of another command.

        Raises:
            BadConfiguration: the folder may not be used.
        """
        if not os.path.lexists(self.partial) or (self.partial.is_dir() and not any(self.partial.iterdir())):
            return
        mark = interrupted_run(self.partial)
        if mark is None:
            raise BadConfiguration(f"--out: {self.partial} was not created by mmrjax; choose another path")
        if foreign := sorted(self._foreign()):
            raise BadConfiguration(
                f"--out: {self.partial} contains {foreign[0]}, which its command did not write; move that file, or "
                "choose another path"
            )
        if mark["command"] not in ("", command) and not force and holds_work(self.partial):
            raise BadConfiguration(
                f"--out: {self.partial} contains an interrupted {mark['command']}; choose another path "
                "or --force to start again"
            )

    def _busy(self, share: str = "") -> BadConfiguration:
        """Error on another process that uses the folder."""
        share_text = f", share {share.replace('-', ' ')}" * bool(share)
        return BadConfiguration(
            f"--out: another process is using {self.partial}{share_text}; wait for it, or choose another path"
        )

    def _present(self) -> bool:
        """True if nobody has removed or moved the folder that this process opened."""
        assert self._lock is not None
        try:
            return os.path.samestat(os.fstat(self._lock.fileno()), (self.partial / LOCK).stat())
        except FileNotFoundError:
            return False

    def _foreign(self) -> set[str]:
        """Names of foreign files in the partial folder.

        Before results are written, these are all names except `UNFINISHED_NAMES`. Later the lock file lists them.
        """
        foreign = {p.name for p in self.partial.iterdir()} - UNFINISHED_NAMES
        foreign_names = _read_json(self.partial / LOCK).get(FOREIGN)
        chunk_files = (self.partial / CHUNKS).glob("*")
        return (foreign & set(map(str, foreign_names)) if isinstance(foreign_names, list) else foreign) | {
            f"{CHUNKS}/{p.name}" for p in chunk_files if p.suffix != STAGE_SUFFIX
        }

    def _clear(self) -> None:
        """Deletes all our files in the partial folder except its lock."""
        foreign = self._foreign()
        for entry in self.partial.iterdir():
            if entry.name != LOCK and entry.name not in foreign:
                shutil.rmtree(entry) if entry.is_dir() and not entry.is_symlink() else entry.unlink()

    def _remove_partial(self) -> None:
        """Deletes the partial folder, the lock last. Foreign files are kept."""
        with contextlib.suppress(OSError):
            self._clear()
            if {p.name for p in self.partial.iterdir()} <= {LOCK}:
                (self.partial / LOCK).unlink(missing_ok=True)
                self.partial.rmdir()

    def results(self) -> Path:
        """Folder for the results, which is moved into place when all are written."""
        mark = _read_json(self.partial / LOCK)
        lock = self.partial / LOCK
        if not self._results_begun and FOREIGN not in mark:
            # Foreign files are listed before the first result is written. All other files are then ours.
            text = json.dumps({**mark, FOREIGN: sorted(self._foreign())})
            with writing.naming_file(lock), lock.open("r+b", buffering=0) as stream:
                stream.write(text.encode())  # in one write, so that others never read a part
        self._results_begun = True
        return self.partial

    def write_text(self, name: str, text: str) -> None:
        """Writes a text file."""
        writing.write_text(self.results() / name, text)

    def write_bytes(self, name: str, content: bytes) -> None:
        """Writes bytes to a file."""
        with writing.naming_file(self.partial / name):
            (self.results() / name).write_bytes(content)

    def write_json(self, name: str, content: Json) -> None:
        """Writes a JSON file. Numbers that are not finite become null."""
        writing.write_json(self.results() / name, content)

    def write_table(self, name: str, columns: Columns) -> None:
        """Writes a table as CSV and, if requested, as Parquet. Numbers that are not finite become empty cells."""
        writing.write_table(self.results() / name, columns, self.tables)

    def finish(self, manifest: Json) -> Path:
        """Writes the manifest and moves the folder into place. Returns its path.

        The manifest also has hashes of `robot.toml` and of the file of runs, if any, and the names of all files:
        `--force` deletes nothing else.
        """
        hashes = {"robot": sha256_hex((self.partial / "robot.toml").read_bytes()), **manifest.get("hashes", {})}
        if self.runs is not None and self.runs.digest:
            hashes[self.runs.source] = self.runs.digest
        names = {"manifest.json", *(p.name for p in self.partial.iterdir())} - {LOCK, CHUNKS} - self._foreign()
        import jax
        import jax.numpy as jnp

        new_manifest = {
            "schema": MANIFEST,
            "program": f"mmrjax {__version__}",
            "arguments": sys.argv[1:],
            "python": platform.python_version(),
            "versions": {name: importlib.metadata.version(name) for name in PACKAGES},
            "devices": [str(d) for d in jax.devices()],
            "float": jnp.result_type(float).name,
            "started": self.started.isoformat(timespec="seconds"),
            "seconds": round((datetime.datetime.now(datetime.UTC) - self.started).total_seconds(), 3),
            **manifest,
            **({"identity": self._digest} if self._digest else {}),
            "hashes": hashes,
            "contents": sorted(names),
        }
        self.write_json("manifest.json", new_manifest)
        return self.move_into_place()

    def move_into_place(self) -> Path:
        """Moves the finished folder to its final path and returns it.

        The folder that it replaces is first moved into the new one and deleted there. If the process is killed
        between two steps, the same command completes the rest.

        Raises:
            OSError: the path was created since the run began. The partial folder is kept.
        """
        try:
            self.refuse_taken(self._force)
        except BadConfiguration:
            raise OSError(errno.EEXIST, os.strerror(errno.EEXIST), str(self.path)) from None
        if self.path.is_dir():
            replaced = self.partial / self.scratch / "replaced"
            shutil.rmtree(replaced, ignore_errors=True)
            os.replace(self.path, replaced)
        os.replace(self.partial, self.path)
        self._tidy()
        return self.path

    def _tidy(self) -> None:
        """Deletes temporary files of a finished folder, the lock last. While it exists, others may be left."""
        if (self.path / LOCK).is_file():
            shutil.rmtree(self.path / self.scratch, ignore_errors=True)
            (self.path / LOCK).unlink(missing_ok=True)

    def close(self) -> None:
        """Releases the lock, so that other processes can use the folder."""
        if self._lock is not None:
            with contextlib.suppress(OSError):  # the disk is full, which was reported
                self._lock.close()
            self._lock = None


def listed_names(folder: Path) -> list[str] | None:
    """Names in the manifest of a run folder. None if it is not one of ours."""
    manifest = _read_json(folder / "manifest.json")
    names = manifest.get("contents")
    if manifest.get("schema") != MANIFEST or not isinstance(names, list):
        return None
    return [name for name in names if isinstance(name, str)]


def interrupted_run(partial: Path) -> dict[str, str] | None:
    """Command and identity of an interrupted run. None if the folder is not one of ours.

    Both are empty if the run was killed before it wrote them.
    """
    if partial.is_symlink() or not (partial / LOCK).is_file():
        return None
    for _ in range(2):  # another process may write it between the first check and the listing
        mark = _read_json(partial / LOCK)
        if mark.get("schema") == UNFINISHED and isinstance(mark.get("command"), str):
            return {"command": mark["command"], "identity": str(mark.get("identity", ""))}
        with contextlib.suppress(FileNotFoundError):
            if not (partial / LOCK).stat().st_size and [p.name for p in partial.iterdir()] == [LOCK]:
                return {"command": "", "identity": ""}
    return None


def lock_text(command: str, identity: str = "") -> str:
    """Text of the file `lock`, which marks a folder as ours."""
    return json.dumps({"schema": UNFINISHED, "command": command, "identity": identity})


def holds_work(partial: Path) -> bool:
    """True if a run that ended early stored anything: chunks, stages, journal lines, or a result."""
    patterns = (f"{CHUNKS}/[!.]*{STAGE_SUFFIX}", f"{JOURNAL}/*.jsonl", "manifest.json")
    return any(file.stat().st_size for pattern in patterns for file in partial.glob(pattern))


def share_at_work(partial: Path, caller_journal: Path | None = None) -> str | None:
    """Share of a sweep that another process is computing. None if there is none.

    Args:
        caller_journal: journal of this process.
    """
    for file in sorted((partial / JOURNAL).glob("*.jsonl")):
        if file != caller_journal:
            with file.open("a") as journal:
                if not try_to_lock(journal):
                    return file.stem
    return None


def try_to_lock(file: TextIO) -> bool:
    """Locks an open file until it is closed. False if another process has locked it."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    return True


def _read_json(file: Path) -> Json:
    """Content of a small JSON file, empty if it cannot be read."""
    try:
        with file.open("rb") as stream:
            content = json.loads(stream.read(LARGEST_FILE))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


class RunFolder(Folder):
    """A folder that appears at `path` only when `finish` is called.

    If the command is stopped, the same command with the same configuration continues from the finished chunks in
    `partial`. With `force`, another configuration starts again. Only one process at a time uses the folder.
    """

    scratch = CHUNKS

    def __init__(self, path: Path, identity: Json, *, force: bool = False) -> None:
        """Creates or continues a run folder.

        Args:
            path: final path of the folder.
            identity: everything that determines the run, including its `command`. Runs with the same identity share
                their chunks.
            force: True to replace an existing run folder, or an interrupted one of another command.

        Raises:
            BadConfiguration: `path` already exists or cannot be written, another process is using it, or another
                command was interrupted there.
        """
        super().__init__(path, force)
        self.command = str(identity.get("command", ""))
        self._digest = identity_digest(identity)
        self._continued = False
        self.refuse_taken(force)
        try:
            self.refuse_foreign(self.command, force)
            while not self._enter():
                self.close()
                self.refuse_foreign(self.command, force)
            self._create_or_continue()
        except BadConfiguration:
            self.close()
            raise
        except OSError as error:
            self.close()
            raise BadConfiguration(
                f"--out: {path} cannot be written ({error.strerror}); choose another path"
            ) from error

    def _enter(self) -> bool:
        """Locks the partial folder. False if another process has removed or moved it meanwhile."""
        self.partial.mkdir(parents=True, exist_ok=True)
        self._lock = (self.partial / LOCK).open("a+", encoding="utf-8")
        if not try_to_lock(self._lock) or share_at_work(self.partial) is not None:
            raise self._busy()
        return self._present()

    def _create_or_continue(self) -> None:
        assert self._lock is not None
        try:
            self.refuse_taken(self._force)  # moved by a process that has finished meanwhile
        except BadConfiguration:
            if not holds_work(self.partial):
                self._remove()
            raise
        mark = interrupted_run(self.partial)
        self._continued = mark is not None and mark["identity"] == self._digest
        if not self._continued:
            if holds_work(self.partial) or FOREIGN in _read_json(self.partial / LOCK):
                if not self._force:
                    raise BadConfiguration(
                        f"--out: {self.partial} contains interrupted work of another configuration; choose "
                        "another path, or --force to start again"
                    )
                print_message(f"{self.partial}: was made with another configuration and is started again")
            self._clear()
            self._lock.truncate(0)
            self._lock.write(lock_text(self.command, self._digest))
            self._lock.flush()
        (self.partial / CHUNKS).mkdir(exist_ok=True)

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(self, error_type: type[BaseException] | None, error: BaseException | None, *_: Any) -> None:
        """Removes the folder if no chunk is finished, or if the input of a new run was rejected. Otherwise the same
        command can continue from it.
        """
        if isinstance(error, OSError) and error.filename is None:
            error.filename = str(self.partial)
        is_rejected = error_type is not None and issubclass(error_type, InputError) and not self._continued
        if error_type is not None and (is_rejected or not holds_work(self.partial)):
            self._remove()
        self.close()

    def _remove(self) -> None:
        """Removes the partial folder of this process."""
        self._remove_partial()
        self.close()

    def chunk(self, name: str) -> Any:
        """Chunk from an interrupted run. None if missing or damaged, which is reported."""
        file = self._chunk_file(name)
        try:
            return stage_files.read_stage(file) if file.is_file() else None
        except stage_files.Unreadable:
            print_message(f"{file}: damaged, so it is computed again")
            return None

    def keep_chunk(self, name: str, content: Any) -> None:
        """Stores a finished chunk, for continuing an interrupted run."""
        with writing.replacing(self._chunk_file(name)) as temporary:
            stage_files.write_stage(temporary, content)

    def stage(self, name: str, make: Callable[[], T]) -> T:
        """Result of a stage: read if an interrupted run of the same identity stored it, otherwise computed and
        stored. A result that cannot be written is not stored.
        """
        stored: tuple[T] | None = self.chunk(name)  # in a tuple, since a result may be None
        if stored is None:
            stored = (make(),)
            with contextlib.suppress(OSError, stage_files.Unwritable):
                self.keep_chunk(name, stored)
        return stored[0]

    def keeps(self, name: str) -> bool:
        """True if a chunk or the result of a stage is stored."""
        return self._chunk_file(name).is_file()

    def _chunk_file(self, name: str) -> Path:
        return self.partial / CHUNKS / f"{re.sub(r'[^a-z0-9.]', '-', name)}{STAGE_SUFFIX}"


def open_folder(
    command: str, config: RobotPart, robot: Robot, invocation: FolderPart, runs: Runs | None = None
) -> RunFolder:
    """Run folder of a command. Its identity is the configuration and the program's source.

    Files of another version are not used.

    Args:
        command: name of the command.
        config: configuration of the command.
        robot: robot of the configuration, with its changes.
        invocation: path of the folder, and True to replace an existing one.
        runs: input table, if any.
    """
    folder = RunFolder(
        invocation.out or default_path(command), run_identity(command, config, robot, runs), force=invocation.force
    )
    folder.tables = getattr(config, "table", folder.tables)
    folder.config, folder.robot, folder.runs = config, robot, runs
    return folder


def run_identity(command: str, config: RobotPart, robot: Robot, runs: Runs | None) -> Json:
    """Identity of a run: its configuration, its inputs and the program's source. Arguments as in `open_folder`."""
    import jax

    from mmrjax.compile.programs import source_hash

    return {
        "command": command,
        "program": f"{source_hash()}, {jax.default_backend()}",
        "config": config.model_dump(exclude={"report", "table"}),
        "robot": params.values_by_name(robot),
        "runs": None if runs is None else {key: value.tolist() for key, value in runs.columns.items()},
        "effects": [sha256_hex(Path(file).read_bytes()) for file in config.effects],
    }


def is_finished(path: Path, identity: Json) -> bool:
    """True if the finished run folder at a path has this identity."""
    return bool(_read_json(path / "manifest.json").get("identity") == identity_digest(identity))


def identity_digest(identity: Json) -> str:
    """SHA-256 of the identity of a run."""
    return sha256_hex(json.dumps(identity, sort_keys=True, default=str).encode())


def rows_of_fit(robot: Path) -> frozenset[str]:
    """Hashes of the tables that a robot was fitted to, from the manifest in its folder. May be empty."""
    manifest = _read_json(robot.parent / "manifest.json") if robot.is_file() else {}
    hashes, arguments = manifest.get("hashes"), manifest.get("arguments")
    if not isinstance(hashes, dict) or not isinstance(arguments, list) or arguments[:1] not in FITTING_COMMANDS:
        return frozenset()
    is_fitted_robot = robot.name != "robot.toml" or hashes.get("robot") == sha256_hex(robot.read_bytes())
    return (
        frozenset(str(value) for name, value in hashes.items() if name != "robot") if is_fitted_robot else frozenset()
    )


def sha256_hex(content: bytes) -> str:
    """SHA-256 of some bytes, in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def default_path(command: str) -> Path:
    """`runs/<command>-<time>`, for a command without `--out`."""
    now = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    path = Path("runs") / f"{command}-{now}"
    is_taken = path.exists() or path.with_name(f"{path.name}.partial").exists()
    return path.with_name(f"{path.name}-{os.getpid()}") if is_taken else path
