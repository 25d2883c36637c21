"""What the command line shows: tables, a progress bar, warnings, errors, and what Ctrl-C means."""

from __future__ import annotations

import os
import re
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from diffeo_calib.calibration.findings import Outlier, Part
from diffeo_calib.fitting.result import Progress as Tell
from diffeo_calib.kinematics.evaluation import Evaluation

WIDTH = 160
"""Of tables that are not shown on a terminal: no number is cut."""
MOST_OUTLIERS = 10
"""Lines about single rows."""
EXIT_INTERRUPTED = 130
INTERRUPTED = "interrupted before there was a result to keep"
NOTHING_TO_KEEP = ("registration", "geometry")
"""Tasks of a calibration that an interruption leaves without a model."""

out = Console(width=None if sys.stdout.isatty() else WIDTH)
err = Console(stderr=True)


def say(text: str) -> None:
    """Print one line as it is, in the words of the command line: no markup, no colours, no folding."""
    out.print(_options(_plain(text)), highlight=False, soft_wrap=True)


def show_error(error: object) -> None:
    """Print one sentence about what went wrong, in the words of the command line."""
    err.print(f"[bold red]error:[/] {_options(_plain(error))}", highlight=False, soft_wrap=True)


def show_warning(message: Warning | str, *_: object, **__: object) -> None:
    """Print a warning; takes the place of :func:`warnings.showwarning`."""
    err.print(f"[bold yellow]warning:[/] {_options(_plain(message))}", highlight=False, soft_wrap=True)


def error_table(title: str, *columns: str, angles: bool = False) -> Table:
    """An empty table of position errors, with its leading columns; with ``angles`` also of orientation errors."""
    table = Table(title=title + ", orientation errors in deg" * angles, title_justify="left")
    for column in columns:
        table.add_column(column)
    for unit in ("", " deg")[: 1 + angles]:
        for column in ("RMS", "median", "95 %", "max"):
            table.add_column(column + unit, justify="right")
    return table


def add_errors(table: Table, errors: Evaluation, *labels: str) -> None:
    """Add a row of position errors in mm, and of orientation errors in degrees if there are any."""
    values = [1e3 * errors.rms, 1e3 * errors.median, 1e3 * errors.p95, 1e3 * errors.max]
    angles = (errors.angle_rms, errors.angle_median, errors.angle_p95, errors.angle_max)
    values += [angle for angle in angles if angle is not None]
    table.add_row(*labels, *(f"{value:.4f}" for value in values))


def parts_table(parts: Sequence[Part]) -> Table:
    """How much each part of a model explains."""
    table = Table(title="What explains how much (RMS over the training rows; parts may cancel)", title_justify="left")
    table.add_column("part")
    table.add_column("displacement, mm", justify="right")
    table.add_column("angle, mrad (slides: mm)", justify="right")
    for part in parts:
        angle = "" if part.angle is None else f"{1e3 * part.angle:.4f}"
        table.add_row(_plain(part.name), f"{1e3 * part.displacement:.4f}", angle)
    return table


def outlier_lines(outliers: Sequence[Outlier], rows: int) -> Iterator[str]:
    """Sentences about rows that look wrong, the worst first."""
    if not outliers:
        return
    flagged = len({outlier.row for outlier in outliers})
    yield f"{flagged} of {rows} training rows look wrong (numbers are lines of the file); none was dropped:"
    for outlier in outliers[:MOST_OUTLIERS]:
        marker = "" if outlier.marker is None else f", marker {outlier.marker}"
        far = f"{1e3 * outlier.distance:.3f} mm off, weight {outlier.weight:.2g}"
        yield f"  row {outlier.number}{marker}: {far}; {outlier.reason}"
    if len(outliers) > MOST_OUTLIERS:
        yield f"  and {len(outliers) - MOST_OUTLIERS} more"


@contextmanager
def progress_bar() -> Iterator[Tell]:
    """A progress bar on standard error, one line per task: yields ``progress(task, done, total)``."""
    columns = (
        TextColumn("{task.description:<18}"),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=err, transient=True) as bar:
        tasks = {}

        def update(task: str, done: int, total: int) -> None:
            """Move the line of a task, made at its first call."""
            if task not in tasks:
                tasks[task] = bar.add_task(task, total=total)
            bar.update(tasks[task], completed=done, total=total)

        yield update


@contextmanager
def told_interruption() -> Iterator[None]:
    """Turn a Ctrl-C for which there is no best state into a sentence and an exit code."""
    try:
        yield
    except KeyboardInterrupt:
        show_error(f"{INTERRUPTED}.")
        raise typer.Exit(EXIT_INTERRUPTED) from None


class Interrupts:
    """Ctrl-C: as long as there is nothing to keep, and the second time, it stops the program at once.

    In between it asks for the best state so far: it is noted, and raised at the next step that :meth:`watching` sees.
    An exception raised wherever the signal falls may be swallowed, by the import of a library for instance.

    Attributes:
        asked: whether the best state was asked for.
    """

    def __init__(self) -> None:
        self.asked = self._keeping = self._told = False

    def install(self) -> None:
        """Take over SIGINT."""
        self.asked = self._keeping = self._told = False
        signal.signal(signal.SIGINT, self._handle)

    def watching(self, progress: Tell) -> Tell:
        """The same progress, which ends the work with KeyboardInterrupt, once, after a Ctrl-C."""

        def step(task: str, done: int, total: int) -> None:
            self._keeping = self._keeping or task not in NOTHING_TO_KEEP
            progress(task, done, total)
            if self.asked and not self._told:
                self._told = True
                raise KeyboardInterrupt

        return step

    def _handle(self, _signal: int, _frame: FrameType | None) -> None:
        if not self._keeping:
            _stop(INTERRUPTED)
        if self.asked:
            _stop("interrupted again, stopped at once")
        self.asked = True
        err.print("interrupted: finishing with the best state so far; Ctrl-C again stops at once")


def _stop(text: str) -> None:
    """Say one sentence and end the process: nothing that is being imported or computed can get in the way."""
    with suppress(RuntimeError, OSError):  # the signal may fall into the printing of something else
        sys.stdout.flush()
    shown = "\r\x1b[2K\x1b[?25h" if sys.stderr.isatty() else ""  # over the progress bar, which hides the cursor
    os.write(2, f"{shown}error: {text}.\n".encode())
    os._exit(EXIT_INTERRUPTED)


def _plain(text: object) -> str:
    """Text in which rich sees no markup."""
    return str(text).replace("[", "\\[")


def _options(text: str) -> str:
    """Names of the Python interface as options: ``sep=';'`` -> ``--sep ';'``, `rotation_angle` -> --rotation-angle."""
    given = r"\b(sep|decimal|angle|length|duplicates|position|joints|rotation_angle)=('[^']*')"
    text = re.sub(given, lambda found: f"{_option(found[1])} {found[2]}", text)
    named = r"`(length|angle|rotation|convention|rotation_angle|std|rotation_std|controls)`"
    return re.sub(named, lambda found: _option(found[1]), text)


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")
