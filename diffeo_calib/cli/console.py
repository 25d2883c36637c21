"""How the command line prints: plain lines, errors, warnings, log, a progress line.

What Ctrl-C means. Imports nothing slow: the handler is installed before everything else.
"""

from __future__ import annotations

import logging
import os
import re
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from time import monotonic
from types import FrameType
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar
from rich.table import Table

from diffeo_calib.cli.record import EXIT_INTERRUPTED, record
from diffeo_calib.common.errors import PACKAGE, few, printable
from diffeo_calib.common.files import remove_unfinished

WIDTH = 160  # width of tables that are not shown on a terminal, so that no number is cut off
WORDS = {
    "registration": "finding base and markers",
    "geometry": "geometric calibration",
    "hyper-parameters": "choosing the scales",
    "axes": "looking for errors of the axes",
    "cross-validation": "checking the deviations",
    "Gauss-Newton": "fitting",
    "changes": "looking for changes",
    "candidates": "drawing configurations",
    "plan": "choosing poses",
    "analysis": "analysing",
    "drawing": "drawing the report",
    "commands": "correcting commands",
    "images": "looking for the board",
}
"""Task of the library -> what it does."""

out = Console(width=None if sys.stdout and sys.stdout.isatty() else WIDTH)
err = Console(stderr=True)


def say(*lines: str) -> None:
    """Print lines verbatim, with Python keywords as options: no markup, no colours, no wrapping."""
    for line in lines:
        out.print(_as_options(plain(line)), highlight=False, soft_wrap=True)


def show(kind: str, message: object) -> None:
    """Print an error or a warning as one sentence, with Python keywords as options."""
    colour = {"error": "red", "warning": "yellow"}[kind]
    err.print(f"[bold {colour}]{kind}:[/] {_as_options(plain(message))}", highlight=False, soft_wrap=True)


def text_table(title: str, header: Sequence[str], rows: Iterable[Sequence[str]], labels: int = 1, **how: Any) -> Table:
    """A table of text: the first columns, labels, to the left, numbers to the right. ``how``: as of rich's table."""
    table = Table(title=title, title_justify="left", **how)
    for number, name in enumerate(header):
        table.add_column(name, justify="right" if number >= labels else "left", no_wrap=number >= labels)
    for row in rows:
        table.add_row(*row)
    return table


@contextmanager
def progress_bar(clock: Callable[[], float] = monotonic) -> Iterator[Progress]:
    """One line on standard error: what is being done and how long it will take. Yields ``progress(task, done, total)``.

    Python users pass it on too: ``with progress_bar() as progress: dc.calibrate(..., progress=progress)``.
    """
    times = TimeElapsedColumn(), TimeRemainingColumn()
    columns = SpinnerColumn(), TextColumn("{task.description}"), BarColumn(bar_width=30), *times
    visible = err.is_terminal or err.is_jupyter
    with Bar(*columns, console=err, transient=True, get_time=clock, disable=not visible) as bar:
        line, current, last = bar.add_task("starting", total=None), "", 0

        def update(task: str, done: int, total: int) -> None:
            nonlocal current, last
            if task != current or done < last:  # another one, or it starts again
                bar.reset(line, description=WORDS.get(task, task), total=None)
            bar.update(line, completed=done, total=total if total > 1 else None)
            current, last = task, done

        yield update


@contextmanager
def log_lines() -> Iterator[None]:
    """Print what the library logs, with the seconds since the start, on standard error."""

    def emit(record: logging.LogRecord) -> None:
        text = f"{record.relativeCreated / 1e3:7.1f} s  {record.getMessage()}"
        err.print(plain(text), highlight=False, soft_wrap=True)

    handler, logger = logging.Handler(logging.INFO), logging.getLogger(PACKAGE)
    handler.emit, before = emit, logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)


def plain(text: object) -> str:
    """Text in which rich finds no markup, and a terminal no escape sequences: names in it come from files."""
    return escape("\n".join(printable(line) for line in str(text).split("\n")))


KEYWORDS = "length angle joint_length sep decimal duplicates joints position marker rotation convention rotation_angle"
KEYWORDS += " std rotation_std controls tip payload"
"""Keywords of Python that are options."""


def _as_options(text: str) -> str:
    """Keywords of Python as options: ``sep=';'`` -> ``--sep ';'``, `rotation_angle` -> --rotation-angle."""
    names = KEYWORDS.replace(" ", "|")
    text = re.sub(rf"\b({names})=('[^']*')", lambda match: f"--{match[1].replace('_', '-')} {match[2]}", text)
    return re.sub(f"(?<!in Python )`({names})`", lambda match: f"--{match[1].replace('_', '-')}", text)


INTERRUPTED = "interrupted before there was a result to keep"
NOTHING_TO_KEEP = ("registration", "geometry")  # tasks of a calibration whose interruption leaves no model

Progress = Callable[[str, int, int], None]  # ``progress(task, done, total)``


class Interrupts:
    """Ctrl-C ends the program at once as long as there is no result to keep, and whenever it is pressed again.

    Otherwise the first one asks for the best result so far (``asked``): the next step that :meth:`watching` sees
    raises KeyboardInterrupt. Raised where the signal arrives, it could be swallowed, for instance by an import.
    """

    def __init__(self) -> None:
        self.asked = self._keeping = self._raised = False
        self._note: Callable[[str], object] = print

    def install(self) -> None:
        """Handle SIGINT from now on."""
        self.asked = self._keeping = self._raised = False
        signal.signal(signal.SIGINT, self._handle)

    def watching(self, progress: Progress, note: Callable[[str], object]) -> Progress:
        """A callback that raises KeyboardInterrupt once after a Ctrl-C; ``note`` prints the answer to that."""
        self._note = note

        def step(task: str, done: int, total: int) -> None:
            self._keeping = self._keeping or task not in NOTHING_TO_KEEP
            progress(task, done, total)
            if self.asked and not self._raised:
                self._raised = True
                raise KeyboardInterrupt

        return step

    def _handle(self, _signal: int, _frame: FrameType | None) -> None:
        if not self._keeping:
            end_process(f"interrupted; written: {few(record.files)}" if record.files else INTERRUPTED)
        if self.asked:
            end_process("interrupted again, stopped at once")
        self.asked = True
        self._note("interrupted: finishing with the best state so far; Ctrl-C again stops at once")


def end_process(text: str) -> None:
    """Print one sentence and end the process, whatever is being imported or computed."""
    remove_unfinished()
    with suppress(RuntimeError, OSError, AttributeError):  # it may arrive while something is printed, or nothing can be
        sys.stdout.flush()
    shown = "\r\x1b[2K\x1b[?25h" if err.is_terminal else ""  # over the progress bar, which hides the cursor
    os.write(2, f"{shown}error: {text}.\n".encode())
    os._exit(EXIT_INTERRUPTED)


interrupts = Interrupts()
