"""The journal of a campaign: what was decided about every line of its table, one JSON object a line.

A line is written and brought to the disk before the verdict is shown. Of a line that a crash tore, the beginning is
removed when the journal is opened again; the row is then judged again. One process at a time writes it.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import time
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from io import FileIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from diffeo_calib.common.errors import DiffeoCalibError, InputError, few
from diffeo_calib.common.files import FULL

if TYPE_CHECKING:
    from typing_extensions import Self

try:
    import fcntl
except ImportError:  # Windows: two writers are not noticed there
    fcntl = None


STILL_SECONDS = 5.0
"""Time after which no program is writing half a line any more."""


class Journal:
    """The journal beside a table, open for one process: a context.

    Args:
        path: the file.

    Attributes:
        entries: what it holds.

    Raises:
        InputError: it cannot be opened, another process writes it, or it is no journal.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with ExitStack() as stack:
            try:
                self._file = stack.enter_context(path.open("a+b", buffering=0))
                if fcntl is not None:
                    fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                fix = "end the other one, or name another table"
                raise InputError.of(f"{path}: another process runs this campaign", fix=fix) from error
            except OSError as error:
                raise InputError.of(f"{path} cannot be opened ({error.strerror})", fix="check the folder") from error
            self.entries = self._read()
            self._stack = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def add(self, entries: Iterable[dict[str, Any]]) -> None:
        """Append entries, whole or not at all; DiffeoCalibError where the disk is full."""
        text = "".join(json.dumps(one) + "\n" for one in entries)
        try:
            append_whole(self._file, text.encode())
        except OSError as error:
            raise DiffeoCalibError.of(f"{self.path} cannot be written ({error.strerror})", fix=FULL) from error

    def _read(self) -> list[dict[str, Any]]:
        self._file.seek(0)
        content = self._file.read()
        whole = content[: content.rfind(b"\n") + 1]
        if len(whole) < len(content):
            os.ftruncate(self._file.fileno(), len(whole))
        try:
            return [json.loads(line) for line in whole.splitlines()]
        except ValueError as error:
            what = f"{self.path} is not the journal of a campaign"
            raise InputError.of(what, got=str(error), fix="name another journal, or move it away") from error


def append_whole(file: FileIO, content: bytes) -> None:
    """Append to an unbuffered file and bring it to the disk; OSError, and the file as before, if that fails."""
    start, rest = file.seek(0, os.SEEK_END), memoryview(content)
    try:
        while rest:
            rest = rest[file.write(rest) :]
        os.fsync(file.fileno())
    except OSError:
        file.truncate(start)
        raise


class GrowingTable:
    """A CSV file to which lines are appended, by other programs too: those that are complete, from the last look on.

    Args:
        path: the file, whose first line names the columns. sep: their separator. decimal: mark of the numbers.

    Attributes:
        header: that line; empty before it is there. count: complete lines seen after it.
    """

    def __init__(self, path: Path, sep: str = ",", decimal: str = ".") -> None:
        self.path, self.header, self.count = path, b"", 0
        self._sep, self._decimal, self._place = sep, decimal, 0

    def new_lines(self) -> list[bytes]:
        """Complete lines that were appended since the last call; InputError if the file has become shorter."""
        try:
            with self.path.open("rb") as file:
                if file.seek(0, os.SEEK_END) < self._place:
                    fix = "append to it only; begin another journal for another table"
                    raise InputError.of(f"{self.path} has become shorter during the campaign", fix=fix)
                file.seek(self._place)
                content = file.read()
        except FileNotFoundError:
            return []
        except OSError as error:
            raise InputError.of(f"{self.path} cannot be read ({error.strerror})", fix="check the path") from error
        whole = content[: content.rfind(b"\n") + 1]
        self._place += len(whole)
        lines = [line for line in whole.splitlines(keepends=True) if line.strip()]
        if lines and not self.header:
            self.header, lines = lines[0], lines[1:]
        self.count += len(lines)
        return lines

    def cells(self, line: bytes) -> list[str]:
        """The cells of a line."""
        return next(csv.reader([line.decode(errors="replace")], delimiter=self._sep), [])

    def written(self, row: dict[str, Any]) -> tuple[bytes, bytes]:
        """The header and the line of a row: column -> value; InputError for columns that the table does not have."""
        header = self.cells(self.header) or list(row)
        unknown = [name for name in row if name not in header]
        if unknown:
            expected = f"those of {self.path.name}: {few(header)}"
            raise InputError.of(f"columns {few(unknown)} of a row", expected=expected)
        values = [row.get(name) for name in header]
        marked = [repr(value).replace(".", self._decimal) if isinstance(value, float) else value for value in values]
        return self.header or self._line(header), self._line(marked)

    def append(self, header: bytes, line: bytes) -> bytes:
        """Append a line, whole or not at all, after the header if the file is empty.

        Returns:
            half a line that a crash had left at the end: it was removed.

        Raises:
            InputError: it cannot be written, or another program is writing a line.
        """
        try:
            with self.path.open("a+b", buffering=0) as file:
                torn = self._torn(file)
                if torn:
                    file.truncate(file.seek(0, os.SEEK_END) - len(torn))
                append_whole(file, line if file.seek(0, os.SEEK_END) else header + line)
        except OSError as error:
            raise InputError.of(f"{self.path} cannot be written ({error.strerror})", fix=FULL) from error
        return torn

    def _torn(self, file: FileIO) -> bytes:
        """Half a line at the end of the file; InputError if it has just been written."""
        file.seek(self._place)
        content = file.read()
        torn = content[content.rfind(b"\n") + 1 :]
        if torn and time.time() - os.fstat(file.fileno()).st_mtime < STILL_SECONDS:
            fix = "let one program write the table; send the row again"
            raise InputError.of(f"another program is writing a line of {self.path}", fix=fix)
        return torn

    def _line(self, cells: Sequence[object]) -> bytes:
        text = io.StringIO()
        csv.writer(text, delimiter=self._sep, lineterminator="\n").writerow(cells)
        return text.getvalue().encode()


def digest(line: bytes) -> str:
    """Hash that tells a line of a table from others."""
    return hashlib.sha256(line.strip()).hexdigest()[:16]
