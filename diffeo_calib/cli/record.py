"""Results of a command for programs: --json FILE, as reports/results.py says.

A command adds its results while it runs. The file is written when the command ends, with its exit code, its warnings
and its error if there was one. The result of an earlier run is removed before anything else: a command that ends before
it could begin (wrong usage, an early Ctrl-C, a kill) leaves no file that could be mistaken for its own.

Checks of the files that a command writes. They run before the work starts, and import nothing slow.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from diffeo_calib.common.errors import DiffeoCalibError, InputError
from diffeo_calib.common.files import PROGRAM, check_writable, write_whole
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
    """The entry of every evaluation of a tree."""
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

    Args:
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
