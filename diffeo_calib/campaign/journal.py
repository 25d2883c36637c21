"""The journal of a campaign: what was decided about every line of its table, one JSON object a line. ::

    {"begun": {"robot": "5f3a...", "length": "mm", "header": "x,y,z"}}
    {"line": 2, "sha": "7c5f...", "rows": [{"fits": true, "accepted": true, "error": 2e-05}]}
    {"line": 3, "sha": "90a1...", "unreadable": "line 3, column 'x': expected a number"}
    {"row": 0, "accepted": false}
    {"removed": "12.5,3"}

`begun`: what the lines are read and judged with. `row`: a row, counted from 0, that was judged anew or decided about.
`removed`: half a line of the table. A line is written and brought to the disk before the verdict is shown. Of a line
that a crash tore, the beginning is removed when the journal is opened again; the row is then judged again. A file that
is no journal is left as it is. One process at a time writes it.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import time
from collections.abc import Iterable, Sequence
from contextlib import ExitStack, suppress
from io import FileIO
from itertools import chain, starmap
from pathlib import Path
from stat import S_ISREG
from typing import IO, Any

from diffeo_calib.common.errors import DiffeoCalibError, InputError, few, warn_user
from diffeo_calib.common.files import FULL, bring_to_disk, lock_file
from diffeo_calib.measurements.csv.cells import csv_text, number

KEPT = ("fits", "accepted", "error", "expected", "cause", "decided", "again", "shown")
"""Fields of a verdict in a journal."""
LARGEST = 1e100  # largest error, m
BEGUN = "begun"
FIRST = b'{"begun": {'  # how a journal begins
STILL_SECONDS = 5.0  # time after which no program is writing half a line any more


class Journal(ExitStack):
    """The journal beside a table, open for one process: a context, whose ``entries`` are those it had.

    Raises:
        InputError: it cannot be opened, another process writes it, or it is no journal.

    Warns:
        DiffeoCalibWarning: its file system has no locks.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        with ExitStack() as stack:
            try:
                if path.exists() and not path.is_file():  # a pipe would be waited for
                    raise self.damaged("a folder, a pipe or a device")
                self._file = stack.enter_context(path.open("a+b", buffering=0))
                locked = lock_file(self._file, wait=False)
                if locked is False:
                    fix = "end the other one, or name another table"
                    raise InputError.of(f"{path}: another process runs this campaign", fix=fix)
                self.entries = self._read()
            except OSError as error:
                raise InputError.of(f"{path} cannot be opened ({error.strerror})", fix="check the folder") from error
            if locked is None:
                warn_user(f"{path} cannot be locked: run no second campaign of this table at the same time.")
            self.push(stack.pop_all())

    def add(self, entries: Iterable[dict[str, Any]]) -> None:
        """Append entries, whole or not at all; DiffeoCalibError where the disk is full."""
        text = "".join(json.dumps(entry) + "\n" for entry in entries)
        try:
            append_whole(self._file, text.encode())
        except OSError as error:
            raise DiffeoCalibError.of(f"{self.path} cannot be written ({error.strerror})", fix=FULL) from error

    def _read(self) -> list[dict[str, Any]]:
        """The entries, without a line that was torn; InputError, and the file as it is, if there is anything else."""
        self._file.seek(0)
        if not FIRST.startswith(self._file.read(2)):
            raise self.damaged("another text")
        self._file.seek(0)
        content = self._file.read()
        *whole, torn = content.split(b"\n")
        entries, lines, rows = list[dict[str, Any]](), 0, 0
        for place, text in enumerate(whole):
            entry: Any = None
            with suppress(ValueError, RecursionError):
                entry = json.loads(text)
            if not _is_entry(entry, lines, rows):
                raise self.damaged(f"{text[:60].decode(errors='replace')!r} in line {place + 1}")
            lines, rows = lines + ("line" in entry), rows + len(entry.get("rows", ()))
            entries.append(entry)
        ours = torn.rstrip(b"\0")[:1] in (b"", b"{") if entries else FIRST.startswith(torn[: len(FIRST)])
        if not ours:
            raise self.damaged(f"{torn[:60].decode(errors='replace')!r} at its end")
        if torn:
            os.ftruncate(self._file.fileno(), len(content) - len(torn))
        return entries

    def damaged(self, got: str) -> InputError:
        """An error about its content."""
        fix = "name another table, or move the file away to judge all rows anew"
        return InputError.of(f"{self.path} is not the journal of a campaign", got=got, fix=fix)


def _is_entry(entry: Any, lines: int, rows: int) -> bool:
    """Whether something is an entry of a journal after so many lines and rows."""
    match entry:
        case {"line": int(line), "sha": str(), "rows": [_, *_] as judged}:
            whole = all(isinstance(item, dict) and {"fits", "accepted"} <= {*item} for item in judged)
            good = whole and all(starmap(_is_field, chain.from_iterable(item.items() for item in judged)))
            return line == lines + 2 and len(entry) == 3 and good
        case {"line": int(line), "sha": str(), "unreadable": str()}:
            return line == lines + 2 and len(entry) == 3
        case {"row": int(row), **changed}:
            return 0 <= row < rows and all(starmap(_is_field, changed.items()))
        case {"begun": dict(begun)}:
            return len(entry) == 1 and all(isinstance(text, str) for text in begun.values())
        case {"removed": str()}:
            return len(entry) == 1
    return False


def _is_field(name: str, value: object) -> bool:
    """Whether a field of a verdict can have a value."""
    match name, value:
        case ("fits", None) | ("fits" | "accepted" | "decided" | "again", bool()) | ("cause", str()):
            return True
        case ("error" | "expected", float(size)) | ("shown", [str(), float(size)]):
            return 0 <= size < LARGEST
    return False


def append_whole(file: FileIO, content: bytes) -> None:
    """Append to an unbuffered file and bring it to the disk; OSError, and the file as before, if that fails."""
    start, rest = file.seek(0, os.SEEK_END), memoryview(content)
    try:
        while rest:
            rest = rest[file.write(rest) :]
        bring_to_disk(file)
    except OSError:
        file.truncate(start)
        raise


class GrowingTable:
    """A CSV file to which lines are appended, by other programs too: those that are complete, from the last look on.

    Args:
        path: the file, whose first line names the columns. sep: their separator. decimal: mark of the numbers.

    Attributes:
        header: that line; empty before it is there.
    """

    def __init__(self, path: Path, sep: str = ",", decimal: str = ".") -> None:
        self.path, self.header = path, b""
        self._sep, self._decimal = sep, decimal
        self._seen, self._half, self._since = b"", b"", 0.0  # half a line after what was seen, and since when it is it
        self._state: object = None  # of the file at the last look

    def new_lines(self) -> list[bytes]:
        """Complete lines that were appended since the last call; InputError if what was there has changed."""
        try:
            status = self.path.stat()
            if not S_ISREG(status.st_mode):  # a pipe would be waited for, a device may never end
                raise InputError.of(f"{self.path} is no file to which lines are appended", fix="name another one")
            state = status.st_size, status.st_mtime_ns, status.st_ino
            if state == self._state:
                return []
            with self.path.open("rb") as file:
                whole = self._after(file)
        except FileNotFoundError:
            whole, state = self._after(io.BytesIO()), None
        except OSError as error:
            raise InputError.of(f"{self.path} cannot be read ({error.strerror})", fix="check the path") from error
        self._state = state
        self._seen += whole
        lines = [line for line in whole.splitlines(keepends=True) if line.strip()]
        if lines and not self.header:
            self.header, lines = lines[0], lines[1:]
        return lines

    def cells(self, line: bytes) -> list[str]:
        """The cells of a line; none if it cannot be read."""
        try:
            return next(csv.reader([line.decode("utf-8-sig", "replace")], delimiter=self._sep), [])
        except csv.Error:
            return []

    def same(self, line: bytes, other: bytes) -> bool:
        """Whether the cells of two whole lines are the same words and numbers."""
        mark, pairs = self._decimal, zip(self.cells(line), self.cells(other), strict=True)
        return all(a == b or None is not number(a, mark) == number(b, mark) for a, b in pairs)

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

        Waits while it is not clear whether another program goes on with half a line at the end.

        Returns:
            half a line that a crash had left at the end: it was removed.

        Raises:
            InputError: it cannot be written, it was changed, or another program is writing a line.
        """
        try:
            with self.path.open("r+b" if self._seen else "a+b", buffering=0) as file:
                torn = self._torn(file)
                if torn:
                    file.truncate(file.seek(0, os.SEEK_END) - len(torn))
                append_whole(file, line if file.seek(0, os.SEEK_END) else header + line)
        except OSError as error:
            raise InputError.of(f"{self.path} cannot be written ({error.strerror})", fix=FULL) from error
        return torn

    def _after(self, file: IO[bytes]) -> bytes:
        """The complete lines after those that were seen; InputError if these have changed."""
        content = file.read()
        if not content.startswith(self._seen):
            fix = "append to it only: undo the change, or move its journal away to judge all rows anew"
            raise InputError.of(f"{self.path} was changed, or made shorter, during the campaign", fix=fix)
        end = content.rfind(b"\n") + 1
        if content[end:] != self._half:
            self._half, self._since = content[end:], time.monotonic()
        return content[len(self._seen) : end]

    def _torn(self, file: FileIO) -> bytes:
        """Half a line at the end of the file that stays as it is; InputError if another program goes on with it."""
        file.seek(0)
        self._after(file)
        half = self._half
        if half:
            time.sleep(max(self._since + STILL_SECONDS - time.monotonic(), 0.0))
            file.seek(0)
            self._after(file)
        if self._half not in (b"", half):
            fix = "let one program write the table; send the row again"
            raise InputError.of(f"another program is writing a line of {self.path}", fix=fix)
        return self._half

    def _line(self, cells: Sequence[object]) -> bytes:
        return csv_text([cells], self._sep).encode()


def digest(line: bytes) -> str:
    """Hash that tells a line of a table from others."""
    return hashlib.sha256(line.strip()).hexdigest()[:16]
