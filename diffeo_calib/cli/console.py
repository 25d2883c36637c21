"""What a command says: to people, plain lines, errors, warnings, a progress line; to programs, its results by --json.

A command adds its results while it runs. Their file, see reports/results.py, is written when the command ends, with its
exit code, warnings and error. The result of an earlier run is removed before anything else: a command that ends before
it could begin (wrong usage, an early Ctrl-C, a kill) leaves no file that could be mistaken for its own.

Also checks of files to be written, and what Ctrl-C means. Imports nothing slow: the handler is installed first.
"""

from __future__ import annotations

import json
import logging
import math
import os
import re
import signal
import sys
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from time import monotonic
from types import FrameType
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar
from rich.table import Table

from diffeo_calib.common.errors import PACKAGE, DiffeoCalibError, InputError, few, printable
from diffeo_calib.common.files import PROGRAM, check_writable, remove_unfinished, write_whole
from diffeo_calib.reports.results import FORMAT, SIZES, VERSION

if TYPE_CHECKING:
    from diffeo_calib.sensors.errors import Evaluation

OPTION = "--json"
EXIT_ERROR, EXIT_INTERRUPTED = 1, 130


class Record:
    """The results of the command that runs."""

    def __init__(self) -> None:
        self.path: Path | None = None
        self._results: dict[str, Any] = {}
        self.warnings: list[str] = []
        self._depth = 0

    def add(self, **results: Any) -> None:
        """Add results, or replace those of the same name."""
        self._results |= results

    def warned(self, message: Warning | str) -> str:
        """The text of a warning, which is kept."""
        self.warnings.append(str(message))
        return self.warnings[-1]

    @property
    def files(self) -> list[str]:
        """Files that are written."""
        return [str(path) for path in self._results.get("files", {}).values()]

    @contextmanager
    def written(self, arguments: list[str]) -> Iterator[None]:
        """Write the file, if it is wanted, when the outermost command inside has ended."""
        if self._depth == 0:
            self.path, self._results, self.warnings = None, {}, []
        self._depth += 1
        code, error = 0, None
        try:
            yield
        except typer.Exit as ended:
            code = ended.exit_code
            raise
        except DiffeoCalibError as raised:
            code, error = EXIT_ERROR, str(raised)
            raise
        except SystemExit as ended:  # of a command inside this one
            code = ended.code if isinstance(ended.code, int) else 0
            raise
        except BaseException:  # wrong usage, found after --json
            self.path = None
            raise
        finally:
            self._depth -= 1
            if self._depth == 0 and self.path is not None:
                write_whole(self.path, self._text(arguments, code, error).encode())

    def _text(self, arguments: list[str], code: int, error: str | None) -> str:
        made = {"format": FORMAT, "format_version": VERSION, "diffeo_calib": "unknown", "arguments": arguments}
        made |= {"exit_code": code, "error": error, "warnings": self.warnings, "results": self._results}
        with suppress(PackageNotFoundError):  # copied instead of installed
            made["diffeo_calib"] = version("diffeo_calib")
        return json.dumps(_plain(made), indent=2, allow_nan=False, ensure_ascii=False) + "\n"


record = Record()


def remove_earlier(arguments: Sequence[str]) -> None:
    """Remove the result of an earlier run at the place that a command line names; any other file stays."""
    for word, following in zip(arguments, [*arguments[1:], ""], strict=False):
        name, given, value = word.partition("=")
        with suppress(OSError, ValueError):
            path = Path(os.path.realpath(value if given else following))
            if name == OPTION and path.is_file():
                with path.open("rb") as file:
                    begin = file.read(100)
                if FORMAT.encode() in begin:
                    path.unlink()


ERRORS = "errors"  # as in sensors/errors.py, which loads torch


def kind_entry(errors: Evaluation, *, metres: bool = False) -> dict[str, object]:
    """Errors of some rows in the unit in which they are shown, or in m; of orientations in degrees (null without)."""
    unit, per_unit = ("m", 1.0) if metres else errors.shown
    entry: dict[str, object] = {"rows": errors.count} | ({} if metres else {"what": errors.what, "unit": unit})
    entry |= {f"{name}{'_m' * metres}": per_unit * getattr(errors, name) for name in SIZES}
    return entry | {f"angle_{name}_deg": getattr(errors.orientation, name, None) for name in SIZES}


def entries_by_kind(errors: Mapping[str, Any]) -> dict[str, Any]:
    """Errors of every kind of rows as ``kinds``; those of measured positions once more as ``errors``, in m.

    Args:
        errors: kind -> errors, or errors by rows and by stage.
    """
    entries: dict[str, Any] = {"kinds": _each(errors, kind_entry), "errors": {}}
    for stages in errors.values():
        leaf: Any = stages
        while isinstance(leaf, Mapping):
            leaf = next(iter(leaf.values()))
        if leaf.what == ERRORS:
            entries["errors"] = _each(stages, partial(kind_entry, metres=True))
    return entries


def _each(errors: Any, entry: Callable[[Evaluation], dict[str, Any]]) -> Any:
    return {name: _each(part, entry) for name, part in errors.items()} if isinstance(errors, Mapping) else entry(errors)


def _plain(value: Any) -> Any:
    """The value as JSON has it: arrays as lists, paths as text, no numbers that are not finite."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def check_outputs(named: dict[str, Path], inputs: dict[str, Path], *, may_come: Container[str] = ()) -> None:
    """Refuse files that cannot be written, that are also read, or that are named twice.

    --json is one of the files. Files that are read must exist, which is known at once, before anything is loaded.
    named: option -> file to write. inputs: name of an argument -> file that is read.
    may_come: names of files that may not exist yet.
    """
    wanted, record.path = record.path, None  # nothing is written there before the place has been checked
    if wanted is not None:
        _check("--json", wanted, inputs | named)
    record.path = wanted
    taken = dict(inputs)
    for option, path in named.items():
        _check(option, path, taken)
        taken[option] = path
    for name, path in inputs.items():
        if name not in may_come and not os.path.lexists(path):
            kind = "model file" if name in ("MODEL", "OLD") else "file"
            fix = f"check the path of {name}"
            if PROGRAM in path.name:
                fix = f"name a function with the columns that it reads: --robot-pose A,B,...={path}"
            raise InputError.of(f"there is no {kind} {path}", fix=fix)


def _check(option: str, path: Path, taken: dict[str, Path]) -> None:
    try:
        check_writable(path)
        for name, other in taken.items():
            same = path.exists() and other.exists() and path.samefile(other)
            if same or os.path.realpath(path) == os.path.realpath(other):
                raise InputError.of(f"{option} {path} is the file of {name}", fix="name another file")
    except OSError as error:
        what = f"{option} {path} cannot be written ({error.strerror})"
        raise InputError.of(what, fix="name another file") from error


def make_folder(folder: Path) -> None:
    """Make a folder unless it exists; InputError if that is not possible."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        what = f"the folder {folder} cannot be made ({error.strerror})"
        raise InputError.of(what, fix="name another folder") from error


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
