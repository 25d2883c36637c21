"""The lines of a CSV file, in blocks, once or several times."""

from __future__ import annotations

import csv
import os
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, TextIO

from diffeo_calib.common.errors import MeasurementError

if TYPE_CHECKING:
    from typing_extensions import Self

Lines = list[tuple[int, list[str]]]
"""Line number in the file and cells of every line that is not blank."""

LONGEST_LINE = 1 << 24
"""Characters; a file with longer lines is no table, and a device may have no line ends at all."""


class CsvLines:
    """A CSV file (UTF-8, one header line, blank lines skipped), used as a context.

    Args:
        path: the file. What can be read only once, such as a pipe, is copied while it is read the first time.
        sep: one character between cells.

    Attributes:
        header: the cells of the first line that is not blank.

    Raises:
        MeasurementError: a file that cannot be opened or read, is no text or no valid CSV, or has no row; on entering
            or while it is read.
    """

    header: list[str]

    def __init__(self, path: Path, sep: str) -> None:
        self.path, self.sep = path, sep
        self._stack = ExitStack()
        self._file: TextIO
        self._copy: TextIO | None = None
        self._read_once = False
        self._first: Iterator[tuple[int, list[str]]]

    def __enter__(self) -> Self:
        with self._stack as stack:  # closed if the header cannot be read
            self._file = stack.enter_context(self._open())
            self._first = self._cells()
            header = next(self._first, None)
            if header is None:
                what, fix = f"file '{self.path}' is empty", "check that it was exported completely"
                raise MeasurementError.of(what, expected="a header and rows of numbers", fix=fix)
            self.header = header[1]
            self._stack = stack.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, _value: object, _trace: TracebackType | None) -> None:
        self._stack.close()

    @property
    def progress(self) -> float:
        """Fraction of the file that has been read; 0 for a pipe."""
        size = os.fstat(self._file.fileno()).st_size
        return min(self._file.buffer.tell() / size, 1.0) if size and self._file.seekable() else 0.0

    def all(self) -> Lines:
        """All lines below the header."""
        return [line for block in self.blocks(LONGEST_LINE) for line in block]

    def blocks(self, rows: int) -> Iterator[Lines]:
        """The lines below the header, up to ``rows`` at once, from the first one at every call."""
        lines, self._first = self._first, iter(())
        if self._read_once:
            lines = self._cells()
            next(lines)
        self._read_once = True
        count = 0
        while block := list(islice(lines, rows)):
            count += len(block)
            yield block
        if not count:
            what, fix = f"file '{self.path}' has a header but no rows", "check that it was exported completely"
            raise MeasurementError.of(what, expected="at least one row of numbers", fix=fix)

    def _open(self) -> TextIO:
        path = self.path
        try:
            return path.open(encoding="utf-8-sig", newline="")
        except FileNotFoundError as error:
            fix = f"check the name and the folder (searched from '{Path.cwd()}')"
            raise MeasurementError.of(f"file '{path}' does not exist", fix=fix) from error
        except OSError as error:
            fix = "pass the name of a readable file"
            raise MeasurementError.of(f"file '{path}' cannot be opened ({error.strerror})", fix=fix) from error

    def _cells(self) -> Iterator[tuple[int, list[str]]]:
        """Line number and stripped cells of every line that is not blank."""
        line = 0
        reader = csv.reader(self._texts(), delimiter=self.sep, strict=True, skipinitialspace=self.sep != " ")
        try:
            for cells in reader:
                first, line = line + 1, reader.line_num  # a quoted cell may span lines
                stripped = [cell.strip() for cell in cells]
                if len(stripped) > 1 or any(stripped):
                    yield first, stripped
        except UnicodeDecodeError as error:
            fix = "save the table as CSV with UTF-8 encoding (a spreadsheet file cannot be read)"
            what = f"file '{self.path}' is not UTF-8 text"
            raise MeasurementError.of(what, expected="a CSV file", fix=fix) from error
        except csv.Error as error:
            what = f"file '{self.path}', line {line + 1}: not valid CSV ({error})"
            raise MeasurementError.of(what, fix="repair the quotes of this line") from error
        except OSError as error:
            what = f"file '{self.path}' cannot be read to its end ({error.strerror})"
            raise MeasurementError.of(what, fix="copy it to another disk first") from error

    def _texts(self) -> Iterator[str]:
        """The lines as text; the first time a pipe is read, they are copied."""
        if self._file.seekable():
            self._file.seek(0)
            yield from self._bounded(self._file)
        elif self._copy is None:
            copy = tempfile.TemporaryFile("w+", encoding="utf-8", newline="")  # noqa: SIM115  # closed with the file
            self._copy = self._stack.enter_context(copy)
            for text in self._bounded(self._file):
                self._copy.write(text)
                yield text
        else:
            self._copy.seek(0)
            yield from self._copy

    def _bounded(self, file: TextIO) -> Iterator[str]:
        number = 0
        while text := file.readline(LONGEST_LINE):
            number += 1
            if len(text) == LONGEST_LINE:
                what = f"file '{self.path}', line {number} has more than {LONGEST_LINE} characters"
                raise MeasurementError.of(what, fix="pass a table with one configuration per line")
            yield text
