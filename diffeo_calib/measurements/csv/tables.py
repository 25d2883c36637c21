"""Tables of joint values and measurements, read in blocks of rows after all rows have been checked."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError, few, warn_user
from diffeo_calib.measurements.checks import file_sha256
from diffeo_calib.measurements.csv.cells import (
    LARGEST_NUMBER,
    BadCells,
    Block,
    CsvLines,
    Mistakes,
    fill_hidden,
    find_columns,
    number,
    parse,
    read_cells,
)
from diffeo_calib.measurements.csv.columns import Columns, Values
from diffeo_calib.measurements.poses import LEVER


@dataclass(frozen=True)
class TableOrigin:
    """A table in a file, and how it was read.

    Args:
        path: the file.
        columns: which of its columns were read, and how.
        sha256: of its content; None for what can be read only once, such as a pipe.
        session: column of the set-ups.
    """

    path: Path
    columns: Columns
    sha256: str | None
    session: str | None = None

    @property
    def options(self) -> str:
        """The options with which the command line reads this table, as a shell would take them."""
        columns, table = self.columns, self.columns.table
        frames = max(len(columns.triples), 1)
        words = [word for triple in columns.triples for word in ("--position", ",".join(triple))]
        for option, names in (("--rotation", columns.rotation), ("--rotation-std", columns.rotation_std)):
            each = len(names) // frames or len(names)
            own = [names[k : k + each] for k in range(0, len(names), each or 1)]
            words += [word for group in own for word in (option, ",".join(group))]
        lever = f"{table.lever * table.per_metre:.17g}" if columns.rotation and table.lever != LEVER else None
        one = {"convention": table.convention, "rotation-angle": table.rotation_angle, "lever": lever}
        one |= {"std": ",".join(columns.std) or None, "payload": table.payload, "length": table.length}
        one |= {"angle": table.angle, "joint-length": table.joint_length, "joints": ",".join(columns.joints.texts)}
        one |= {**table.covariates, "session": self.session, "sep": table.sep, "decimal": table.decimal}
        words += [word for name, value in one.items() if value is not None for word in (f"--{name}", value)]
        return shlex.join(words + ["--camera-on-tool"] * table.camera_on_tool)

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


ROWS_AT_ONCE = 2048
"""A multiple of the rows that predictions linearise together: blocks do not change their last digits."""

Progress = Callable[[float], object]
"""Called with the fraction of the file that has been read."""


class TableFile(CsvLines):
    """A CSV file with columns in known units, used as a context.

    It can be read as a whole (:meth:`read`), or in two passes for joint values that do not fit in memory: :meth:`check`
    finds all mistakes and the number of rows; then :meth:`laden_joints` returns the rows.

    Args:
        path: the file.
        columns: which columns of numbers it has, and their units. texts: columns of texts, "nan" being empty, and
            whether it must have them.

    Attributes:
        rows: number of rows; 0 before the first pass.
    """

    def __init__(self, path: Path, columns: Columns, texts: Mapping[str, bool] = {}) -> None:  # not changed
        super().__init__(path, columns.table.sep)
        self.columns, self.texts, self.rows = columns, texts, 0

    def read(self) -> tuple[Values, dict[str, list[str]], list[int]]:
        """The numbers and the texts of all rows, and the line number of each.

        Raises:
            MeasurementError: any mistake in the file; standard deviations that are not positive, negative payloads.

        Warns:
            DiffeoCalibWarning: values that look as if they were in another unit.
        """
        blocks = list(self._checked())
        texts = {name: [text for block in blocks for text in block.texts[name]] for name in blocks[0].texts}
        lines = [line for block in blocks for line in block.lines]
        return self.columns.to_si(torch.cat([block.numbers for block in blocks])), texts, lines

    def check(self, each: Callable[[Values], object] | None = None, progress: Progress | None = None) -> None:
        """Find all mistakes, count the rows, and show blocks to ``each``; errors and warnings as in :meth:`read`."""
        for block in self._checked():
            if each is not None:
                each(self.columns.to_si(block.numbers))
            if progress is not None:
                progress(self.progress)

    def laden_joints(self) -> Iterator[tuple[Tensor, Tensor | None]]:
        """Joint values (B, n) [rad or m] of every block, and payloads (B,) if there are some, after :meth:`check`."""
        count = 0
        for block in self._numbers():
            count += len(block.lines)
            values = self.columns.to_si(block.numbers)
            yield values["q"], values.get("payload")
        if count != self.rows:
            what, fix = f"file '{self.path}' changed while it was read", "run the command again"
            raise MeasurementError.of(what, expected=f"{self.rows} rows", got=count, fix=fix)

    def _numbers(self) -> Iterator[Block]:
        """Numbers as written in the file, in blocks; nothing more from the first block with a mistake on.

        MeasurementError for anything unreadable, missing, ragged or not finite. Mistakes in rows are counted in the
        whole file first.
        """
        wanted, decimal, hideable = self.columns.names, self.columns.table.decimal, self.columns.hideable
        named = [name for name, needed in self.texts.items() if needed or name in self.header]
        places = find_columns(self.path, self.header, [*wanted, *named], self.sep)
        mistakes = Mistakes(self.path, wanted, decimal, markers=len(self.columns.triples))
        for lines in self.blocks(ROWS_AT_ONCE):
            whole = mistakes.without_ragged(lines, len(self.header))
            cells = [[cells[column] for column in places[: len(wanted)]] for _, cells in whole]
            numbers, hidden = parse(cells, decimal), []
            if numbers is None and hideable:
                hidden = fill_hidden(cells, hideable, all_hidden=self.columns.all_hidden)
                numbers = parse(cells, decimal)
            if numbers is None or not bool((numbers.abs() < LARGEST_NUMBER).all()):
                mistakes.add([line for line, _ in whole], cells)
            elif not mistakes:
                if hidden:
                    numbers[tuple(zip(*hidden, strict=True))] = math.nan
                own = zip(named, places[len(wanted) :], strict=True)
                found = {name: ["" if row[k].lower() == "nan" else row[k] for _, row in lines] for name, k in own}
                yield Block(numbers, found, [line for line, _ in lines])
        mistakes.raise_first()

    def _checked(self) -> Iterator[Block]:
        """All blocks; what they have in common is checked after the last one."""
        columns, largest = self.columns, None
        checks = [group.check for group in columns.groups.values() for _ in group.names]
        wrong = {place: (check, BadCells()) for place, check in enumerate(checks) if check is not None}
        unseen, self.rows = columns.hideable, 0
        for block in self._numbers():
            raw = block.numbers
            most = raw.nan_to_num(0.0).abs().amax(0, keepdim=True)
            largest = most if largest is None else torch.maximum(largest, most)
            for place, (check, bad) in wrong.items():
                values = raw[:, place]
                for row in (values < 0 if check.zero else values <= 0).nonzero()[:, 0].tolist():
                    bad.add(block.lines[row], columns.names[place], f"{float(values[row]):g}")
            unseen = [own for own in unseen if bool(raw[:, own.values].isnan().all())]
            self.rows += len(block.lines)
            yield block
        if largest is not None:
            for text in columns.unlikely_units(largest):
                warn_user(f"file '{self.path}': {text}")
        for check, bad in wrong.values():
            if bad.first:
                raise bad.error(self.path, check.expected, check.fix)
        for own in unseen if self.rows else ():
            names = few([columns.names[place] for place in own.values])
            what, fix = f"file '{self.path}', columns {names}: empty in all {self.rows} lines", "leave them out"
            raise MeasurementError.of(what, expected=f"some line that {own.word}", fix=fix)
