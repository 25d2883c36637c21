"""The journal of a campaign: what was decided about every line of its table, one JSON object a line.

A line is written and brought to the disk before the verdict is shown. Of a line that a crash tore, the beginning is
removed when the journal is opened again; the row is then judged again. One process at a time writes it.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from diffeo_calib.common.errors import InputError

if TYPE_CHECKING:
    from typing_extensions import Self

try:
    import fcntl
except ImportError:  # Windows: two writers are not noticed there
    fcntl = None


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
                self._file = stack.enter_context(path.open("a+b"))
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
        """Append entries, whole or not at all; InputError where the disk is full."""
        start, text = self._file.seek(0, os.SEEK_END), "".join(json.dumps(one) + "\n" for one in entries)
        try:
            self._file.write(text.encode())
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as error:
            os.ftruncate(self._file.fileno(), start)
            raise InputError.of(f"{self.path} cannot be written ({error.strerror})", fix="free some space") from error

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


class GrowingTable:
    """A CSV file to which another program appends lines: those that are complete, from the last look on.

    Args:
        path: the file, whose first line names the columns.

    Attributes:
        header: that line; empty before it is there. count: complete lines seen after it.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.header, self.count = path, b"", 0
        self._place = 0

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


def digest(line: bytes) -> str:
    """What tells a line of a table from others."""
    return hashlib.sha256(line.strip()).hexdigest()[:16]
