"""A robot's program as a CSV table: its joint values are replaced, columns are added, all other cells are kept."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path

from torch import Tensor

from diffeo_calib.common.errors import MeasurementError, listed
from diffeo_calib.common.files import write_whole
from diffeo_calib.measurements.csv.cells import read_cells
from diffeo_calib.measurements.csv.columns import Columns
from diffeo_calib.measurements.table_format import TableFormat

Column = Sequence[str] | Sequence[float]


@dataclass(frozen=True)
class Program:
    """The cells of a table.

    Args:
        header: names of the columns. rows: cells of every line below that is not blank.
        lines: line number of every row in the file.
    """

    header: list[str]
    rows: list[list[str]]
    lines: list[int]

    @classmethod
    def read(cls, path: Path, table: TableFormat) -> Program:
        """Read all cells as text.

        Raises:
            MeasurementError: a file that cannot be read, or lines of different lengths.
        """
        header, lines = read_cells(path, table.sep)
        return cls(header, [cells for _, cells in lines], [line for line, _ in lines])

    def check_free(self, names: Sequence[str]) -> None:
        """Raise MeasurementError if a column that is to be added is there already."""
        taken = [name for name in names if name in self.header]
        if taken:
            what = f"the program already has the column(s) {listed(taken)}, which the output adds"
            raise MeasurementError.of(what, fix="rename or remove them, unless the program has been corrected already")

    def write(self, path: Path, q: Tensor, joints: Columns, added: Mapping[str, Column], table: TableFormat) -> None:
        """Write the program with other joint values and more columns; overwrites.

        Args:
            path: the file.
            q: (N, n) joint values, rad and m; NaN becomes an empty cell.
            joints: their columns.
            added: names and values of the columns to add, numbers in the units of the file.
            table: units, separator and decimal mark.

        Raises:
            InputError: a file that cannot be written.
        """
        values = joints.joints_from_si(q).tolist()
        places = [self.header.index(name) for name in joints.joints]
        text = io.StringIO(newline="")
        writer = csv.writer(text, delimiter=table.sep)
        writer.writerow([*self.header, *added])
        for row, cells in enumerate(self.rows):
            line = list(cells)
            for place, value in zip(places, values[row], strict=True):
                line[place] = _cell(value, table)
            writer.writerow([*line, *(_cell(column[row], table) for column in added.values())])
        write_whole(path, text.getvalue().encode())


def _cell(value: str | float, table: TableFormat) -> str:
    if isinstance(value, str):
        return value
    return repr(value).replace(".", table.decimal) if isfinite(value) else ""
