"""Output of commands: results on stdout, everything else on stderr."""

from __future__ import annotations

import contextlib
import io
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import IO, Any, cast

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.segment import Segment
from rich.text import Text

from calibration.data import Json
from calibration.data.writing import json_text, naming_file
from mmrjax.errors import printable

#: Widest line of text on a terminal.
COLUMNS = 80
#: Longest silence of a long computation, and of a command that begins [s].
SILENCE, FIRST_MESSAGE = 2.0, 1.0
#: Name of the output of results in error messages.
OUTPUT = "standard output"


class _SafeConsole(Console):
    """Console that replaces characters which a terminal would interpret, because names, units and cells may be
    untrusted.
    """

    def render(self, renderable: Any, options: Any = None) -> Iterator[Segment]:
        """Segments of text, each `printable`."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else segment._replace(text=printable(segment.text))


_WIDTH = None if sys.stdout is not None and sys.stdout.isatty() else 160  # a file has no width
_out = _SafeConsole(highlight=False, soft_wrap=True, markup=False, width=_WIDTH)


class _ErrorStream(io.TextIOBase):
    """Standard error. Messages that cannot be written, for instance because the disk is full, are dropped."""

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError):
            sys.stderr.write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError):
            sys.stderr.flush()

    def isatty(self) -> bool:
        return sys.stderr.isatty()

    def fileno(self) -> int:
        return sys.stderr.fileno()


MESSAGES = _ErrorStream()
_err = _SafeConsole(file=cast(IO[str], MESSAGES), highlight=False, soft_wrap=True, markup=False)


def print_output(what: Any) -> None:
    """Prints text or a table to stdout."""
    with naming_file(OUTPUT):
        _out.print(wrap_for_terminal(what) if isinstance(what, str) and sys.stdout.isatty() else what)


def print_json(content: Json) -> None:
    """Prints JSON to stdout."""
    with naming_file(OUTPUT):
        print(json_text(content))


def print_message(text: str) -> None:
    """Prints a line to stderr. It replaces a progress line."""
    rewrite_line("")
    _err.print(wrap_for_terminal(text) if MESSAGES.isatty() else text)


def rewrite_line(text: str) -> None:
    """Rewrites the last line of a terminal. Nothing is written to files."""
    if MESSAGES.isatty():
        MESSAGES.write(f"\r\x1b[K{printable(text)[: COLUMNS - 1]}")
        MESSAGES.flush()


def wrap_for_terminal(text: str) -> str:
    """Text wrapped for a terminal at `COLUMNS`, with indented lists. For a file it is unchanged."""
    return "\n".join(
        textwrap.fill(
            line, COLUMNS, subsequent_indent="  " * line.startswith("- "), break_long_words=False,
            break_on_hyphens=False,
        )
        for line in text.split("\n")
    )  # fmt: skip


@contextmanager
def report_working(name: str) -> Iterator[None]:
    """Reports that a command is working if imports and compilation take longer than usual."""
    timer = threading.Timer(FIRST_MESSAGE, print_message, [f"{name}: working"])
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
        timer.join()


@contextmanager
def step_reporter(
    print_line: Callable[[str], None],
    doing: str,
    silence: float = SILENCE,
    rewrite: Callable[[str], None] = rewrite_line,
) -> Iterator[Callable[[str], None]]:
    """Yields a function that prints the current step. After a silence, the step is printed again with its time and
    the number of programs compiled.

    Args:
        print_line: function that prints a line.
        doing: step before the first call.
        silence: longest time without output [s].
        rewrite: function that rewrites the progress line.
    """
    import jax

    from calibration.words.step_words import still_running_sentence

    compiled = 0
    current_step = [(doing, time.monotonic(), 0)]
    step_reported, stopped = threading.Event(), threading.Event()

    def count(event: str, duration_secs: float, **_: Any) -> None:
        nonlocal compiled
        compiled += event.endswith("backend_compile_duration")

    def report_step(text: str) -> None:
        current_step[:] = [(text, time.monotonic(), compiled)]
        step_reported.set()
        print_line(text)

    def repeat_steps() -> None:
        while not stopped.is_set():
            is_reported = step_reported.wait(silence)
            step_reported.clear()
            if not is_reported and not stopped.is_set():
                text, started, compiled_before = current_step[0]
                rewrite(still_running_sentence(text, time.monotonic() - started, compiled - compiled_before))

    jax.monitoring.register_event_duration_secs_listener(count)
    thread = threading.Thread(target=repeat_steps, daemon=True)
    thread.start()
    try:
        yield report_step
    finally:
        stopped.set()
        step_reported.set()
        thread.join()


@contextmanager
def report_stage(number: int, total: int, doing: str, without_time: bool = False) -> Iterator[None]:
    """Reports a stage of a command and its elapsed time. `without_time`: without the time, next to a progress bar."""
    text = f"{number} of {total}, {doing}"
    if without_time:
        print_message(text)
        yield
        return
    with step_reporter(print_message, doing) as report_step:
        report_step(text)
        yield


class RateColumn(ProgressColumn):
    """Column with the rate per second."""

    def render(self, task: Task) -> Text:
        """Rate over the last minute, or over the whole run at its end."""
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:,.0f}/s")


@contextmanager
def progress_bar(
    total: int, quiet: bool, doing: str = "simulating", done: int = 0, rate: bool = False
) -> Iterator[Callable[[float], None]]:
    """A progress bar on stderr. Yields a function to call with the number of newly finished items.

    Args:
        done: number of items already finished.
        rate: True to show the rate per second.
    """
    columns = [TextColumn(doing), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn()]
    with Progress(*columns, *([RateColumn()] if rate else []), console=_err, disable=quiet) as bar:
        task = bar.add_task("", total=total, completed=done)
        # rounded, because the sum of a chunk's shares may be slightly below its runs
        yield lambda count: bar.update(task, completed=round(bar.tasks[task].completed + count, 6))
