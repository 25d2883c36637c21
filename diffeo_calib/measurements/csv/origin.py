"""The file that measurements were read from, kept so that other readings of it can be tried if they do not fit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.measurements.csv.cells import number, read_cells
from diffeo_calib.measurements.csv.columns import Columns
from diffeo_calib.measurements.table_checks import file_sha256


@dataclass(frozen=True)
class TableOrigin:
    """A table in a file, and how it was read.

    Args:
        path: the file.
        columns: which of its columns were read, and how.
        sha256: of its content; None for what can be read only once, such as a pipe.
    """

    path: Path
    columns: Columns
    sha256: str | None

    def numeric_columns(self, line_numbers: Tensor, *, gaps: bool = False) -> dict[str, Tensor]:
        """All columns whose cells in these lines (N,) are numbers, each (N,) in the units of the file.

        Empty if the file has changed since, or is gone. With ``gaps`` some cells may be empty or not a number, and are
        NaN then.
        """
        try:
            if self.sha256 is None or file_sha256(self.path) != self.sha256:
                return {}
            header, rows = read_cells(self.path, self.columns.table.sep)
        except (OSError, MeasurementError):
            return {}
        cells = dict(rows)
        wanted = [cells.get(line, []) for line in line_numbers.tolist()]
        if not all(wanted):
            return {}
        found = {}
        for place, name in enumerate(header):
            cells_here = [row[place].strip() or "nan" for row in wanted]
            values = [number(cell, self.columns.table.decimal) for cell in cells_here]
            there = [value for value in values if not gaps or value is None or not math.isnan(value)]
            if there and all(value is not None and math.isfinite(value) for value in there):
                found[name] = torch.tensor(values, dtype=torch.float64, device=HOST)
        return found
