"""How the command line prints: plain lines, errors, warnings, log, a progress line."""

from __future__ import annotations

import logging
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import monotonic
from typing import Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, ProgressColumn, SpinnerColumn, Task, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar
from rich.text import Text

from diffeo_calib.cli.interrupts import EXIT_INTERRUPTED, INTERRUPTED, Progress
from diffeo_calib.common.errors import PACKAGE, printable

WIDTH = 160
"""Width of tables that are not shown on a terminal, so that no number is cut off."""
WORDS = {
    "registration": "finding base and markers",
    "geometry": "geometric calibration",
    "hyper-parameters": "choosing the scales",
    "cross-validation": "checking the deviations",
    "Gauss-Newton": "fitting",
    "changes": "looking for changes",
    "candidates": "drawing configurations",
    "plan": "choosing poses",
    "analysis": "analysing",
    "drawing": "drawing the report",
}
"""Task of the library -> what it does."""
LIMITED = ("hyper-parameters", "Gauss-Newton")
"""Tasks that may end before their total."""
FEWEST_SECONDS = 1.0
"""Before that no remaining time is told."""

out = Console(width=None if sys.stdout.isatty() else WIDTH)
err = Console(stderr=True)


def say(text: str) -> None:
    """Print one line verbatim, with Python keywords as options: no markup, no colours, no wrapping."""
    out.print(_as_options(plain(text)), highlight=False, soft_wrap=True)


def show_error(error: object) -> None:
    """Print an error as one sentence, with Python keywords as options."""
    err.print(f"[bold red]error:[/] {_as_options(plain(error))}", highlight=False, soft_wrap=True)


def show_warning(message: Warning | str) -> None:
    """Print a warning as one sentence, with Python keywords as options."""
    err.print(f"[bold yellow]warning:[/] {_as_options(plain(message))}", highlight=False, soft_wrap=True)


@contextmanager
def progress_bar(clock: Callable[[], float] = monotonic) -> Iterator[Progress]:
    """One line on standard error: what is being done and how long it will take. Yields ``progress(task, done, total)``.

    Python users pass it on too: ``with progress_bar() as progress: dc.calibrate(..., progress=progress)``.
    """
    columns = (SpinnerColumn(), TextColumn("{task.description}"), _Steps(bar_width=30), TimeElapsedColumn(), _Left())
    seen = err.is_terminal or err.is_jupyter
    with Bar(*columns, console=err, transient=True, get_time=clock, disable=not seen) as bar:
        line, current, last = bar.add_task("starting", total=None), "", 0

        def update(task: str, done: int, total: int) -> None:
            """Show this task, from its beginning if it is another one or starts again."""
            nonlocal current, last
            if task != current or done < last:
                bar.reset(line, description=WORDS.get(task, task), total=None, at_most=task in LIMITED)
            bar.update(line, completed=done, total=total if total > 1 else None)
            current, last = task, done

        yield update


class _Steps(BarColumn):
    """A bar for tasks of several steps."""

    def render(self, task: Task) -> Any:
        return Text("") if task.total is None else super().render(task)


class _Left(ProgressColumn):
    """How long a task will take by the time that its steps have taken."""

    def render(self, task: Task) -> Text:
        left = remaining(task.completed, task.total, task.elapsed)
        return Text("" if left is None else f"{'at most' if task.fields.get('at_most') else 'about'} {left} left")


def remaining(done: float, total: float | None, seconds: float | None) -> str | None:
    """Time for the rest of a task whose steps take the same time, in words; None if it cannot be told yet."""
    if total is None or seconds is None or done <= 0 or seconds < FEWEST_SECONDS:
        return None
    left = round(seconds * max(total - done, 0.0) / done)
    return f"{left} s" if left < 100 else f"{-(-left // 60)} min"


@contextmanager
def log_lines() -> Iterator[None]:
    """Print what the library logs, with the seconds since the start, on standard error."""
    handler, logger = _LogLines(logging.INFO), logging.getLogger(PACKAGE)
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)


class _LogLines(logging.Handler):
    """One line for each record."""

    def emit(self, record: logging.LogRecord) -> None:
        text = f"{record.relativeCreated / 1e3:7.1f} s  {record.getMessage()}"
        err.print(plain(text), highlight=False, soft_wrap=True)


@contextmanager
def exit_on_interrupt() -> Iterator[None]:
    """Turn a KeyboardInterrupt that leaves no result into a sentence and an exit code."""
    try:
        yield
    except KeyboardInterrupt:
        show_error(f"{INTERRUPTED}.")
        raise typer.Exit(EXIT_INTERRUPTED) from None


def plain(text: object) -> str:
    """Text in which rich finds no markup, and a terminal no escape sequences: names in it come from files."""
    return escape("\n".join(printable(line) for line in str(text).split("\n")))


def _as_options(text: str) -> str:
    """Keywords of Python as options: ``sep=';'`` -> ``--sep ';'``, `rotation_angle` -> --rotation-angle."""
    given = r"\b(sep|decimal|angle|length|joint_length|convention|duplicates|position|joints|rotation_angle)=('[^']*')"
    text = re.sub(given, lambda found: f"{_option(found[1])} {found[2]}", text)
    named = r"`(length|joint_length|angle|rotation|convention|rotation_angle|std|rotation_std|controls|tip|payload)`"
    return re.sub(named, lambda found: _option(found[1]), text)


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")
