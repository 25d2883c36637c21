"""How the command line prints: plain lines, errors, warnings, a progress bar."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar

from diffeo_calib.cli.interrupts import EXIT_INTERRUPTED, INTERRUPTED, Progress
from diffeo_calib.common.errors import printable

WIDTH = 160
"""Width of tables that are not shown on a terminal, so that no number is cut off."""

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
def progress_bar() -> Iterator[Progress]:
    """A progress bar on standard error, one line per task: yields ``progress(task, done, total)``."""
    columns = (
        TextColumn("{task.description:<18}"),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        TimeElapsedColumn(),
    )
    with Bar(*columns, console=err, transient=True) as bar:
        tasks = {}

        def update(task: str, done: int, total: int) -> None:
            """Move the line of a task, which its first call adds."""
            if task not in tasks:
                tasks[task] = bar.add_task(task, total=total)
            bar.update(tasks[task], completed=done, total=total)

        yield update


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
    named = r"`(length|joint_length|angle|rotation|convention|rotation_angle|std|rotation_std|controls)`"
    return re.sub(named, lambda found: _option(found[1]), text)


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")
