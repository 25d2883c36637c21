"""Tables of joint values and measurements, all of whose rows are checked together."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError, few, shown, warn_user
from diffeo_calib.measurements.checks import file_sha256
from diffeo_calib.measurements.csv.cells import (
    LARGEST_NUMBER,
    Block,
    Hideable,
    bad_cells,
    find_columns,
    number_hint,
    numbers_in,
)
from diffeo_calib.measurements.csv.columns import Columns, Values
from diffeo_calib.measurements.csv.joints import PoseColumns
from diffeo_calib.measurements.csv.lines import ANGLES, CsvLines, read_cells, stated_unit
from diffeo_calib.measurements.poses import ANGLE_UNITS
from diffeo_calib.measurements.table_format import UNITS_PER_METRE, options_of


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

    @property
    def options(self) -> str:
        """The options with which the command line reads this table, as a shell would take them."""
        joints, table = self.columns.joints, self.columns.table
        if isinstance(joints, PoseColumns):
            return shlex.join(["--robot-pose", joints.text, *options_of(replace(table, joints=()))])
        return shlex.join(options_of(replace(table, joints=joints.texts)))

    def numeric_columns(self, line_numbers: Tensor, *, gaps: bool = False) -> dict[str, Tensor]:
        """All columns whose cells in these lines (N,) are numbers, each (N,) in the units of the file.

        With ``gaps`` some cells may be empty or not a number, and are NaN then.
        """
        found = {}
        for name, cells in self.texts(line_numbers).items():
            values = numbers_in(cells, self.columns.table.decimal)
            there = [value for value in values if not gaps or value is None or not math.isnan(value)]
            if there and all(value is not None and math.isfinite(value) for value in there):
                found[name] = torch.tensor(values, dtype=torch.float64, device=HOST)
        return found

    def texts(self, line_numbers: Tensor) -> dict[str, list[str]]:
        """The cells of all columns in these lines (N,); empty if the file has changed since, or is gone."""
        try:
            if self.sha256 is None or file_sha256(self.path) != self.sha256:
                return {}
            header, rows = read_cells(self.path, self.columns.table.sep, self.columns.names)
        except (OSError, MeasurementError):
            return {}
        cells = dict(rows)
        wanted = [cells.get(line, []) for line in line_numbers.tolist()]
        return {name: [row[place] for row in wanted] for place, name in enumerate(header)} if all(wanted) else {}


FEW_ROWS = 2000
"""Rows among which those of a marker that was not seen are looked for."""
MUCH_FARTHER = 3.0
"""Times the largest distance of a row from its nearest one: so far is a single 0, 0, 0 where it is no position."""
ROWS_AT_ONCE = 2048
"""A multiple of the rows that predictions linearise together: blocks do not change their last digits."""


class TableFile(CsvLines):
    """A CSV file with columns in known units, used as a context.

    Args:
        path: the file.
        columns: which columns of numbers it has, and their units. texts: columns of texts, "nan" being empty, and
            whether it must have them.
    """

    def __init__(self, path: Path, columns: Columns, texts: Mapping[str, bool] = {}) -> None:  # not changed
        needed = [name for name, needed in texts.items() if needed]
        super().__init__(path, columns.table.sep, [*columns.names, *needed])
        self.columns, self.texts = columns, texts
        self._words: dict[str, list[int]] = {}

    def read(self, *, zeros: bool = True) -> tuple[Values, dict[str, list[str]], list[int]]:
        """The numbers and the texts of all rows, and the line number of each.

        Args:
            zeros: whether markers that are at 0, 0, 0 far from other rows are hidden there.

        Raises:
            MeasurementError: any mistake in the file; standard deviations that are not positive, negative payloads.

        Warns:
            DiffeoCalibWarning: values that look as if they were in another unit; what the file holds beside rows of
                numbers; rows that are left out because no marker was seen.
        """
        blocks = list(self._checked())
        texts = {name: [text for block in blocks for text in block.texts[name]] for name in blocks[0].texts}
        lines = [line for block in blocks for line in block.lines]
        numbers = torch.cat([block.numbers for block in blocks])
        markers = self.columns.hideable[: len(self.columns.triples)]
        for own in markers if zeros else ():
            self._hide_zeros(numbers, own, lines)
        if markers and not self.columns.all_hidden:
            seen = ~torch.stack([numbers[:, own.values].isnan().all(1) for own in markers]).all(0)
            kept = seen.nonzero()[:, 0].tolist()
            gone = [line for line, shows in zip(lines, seen.tolist(), strict=True) if not shows]
            if gone:
                warn_user(f"file '{self.path}': no marker was seen in line {few(gone)}: {len(gone)} row(s) left out")
            numbers, lines = numbers[kept], [lines[row] for row in kept]
            texts = {name: [own[row] for row in kept] for name, own in texts.items()}
        return self.columns.to_si(numbers), texts, lines

    def _hide_zeros(self, numbers: Tensor, own: Hideable, lines: Sequence[int]) -> None:
        """Write NaN where a marker is at 0, 0, 0 though it never comes near: a device that does not see it says so.

        One such row may be the origin of the frame, or the first pose: then all others must be much farther from it
        than from one another.
        """
        points, q = numbers[:, own.values[:3]], numbers[:, : len(self.columns.joints.columns)]
        lost, seen = (points == 0.0).all(1), points[(points.abs() > 0.0).any(1)]
        some = seen[:FEW_ROWS].unique(dim=0)
        if not bool(lost.any()) or len(some) < 2:
            return
        apart = torch.cdist(some, some).fill_diagonal_(math.inf).amin(1)
        limit = apart.median() if len(q[lost].unique(dim=0)) > 1 else MUCH_FARTHER * apart.amax()
        if bool(seen.norm(dim=1).amin() > limit):
            for place in (*own.values, *own.deviations):
                numbers[lost, place] = math.nan
            at = few([lines[row] for row in lost.nonzero()[:, 0].tolist()])
            names = few([self.columns.names[k] for k in own.values[:3]])
            warn_user(f"file '{self.path}': {names} are 0, 0, 0 in line {at}, far from other rows: taken as not seen")

    def _numbers(self) -> Iterator[Block]:
        """Numbers as written in the file, in blocks; MeasurementError for the first block with a mistake."""
        wanted = self.columns.names
        named = [name for name, needed in self.texts.items() if needed or name in self.header]
        places = find_columns(self.path, self.header, [*wanted, *named], self.sep)
        self._check_units()
        self._words = {}
        for block in self.blocks(ROWS_AT_ONCE):
            lines = [line for line, _ in block]
            cells = [[row[column] for _, row in block] for column in places[: len(wanted)]]
            numbers = self._with_gaps(lines, cells)
            own = zip(named, places[len(wanted) :], strict=True)
            texts = {name: ["" if row[k].lower() == "nan" else row[k] for _, row in block] for name, k in own}
            yield Block(numbers, texts, lines)

    def _with_gaps(self, lines: Sequence[int], columns: Sequence[Sequence[str]]) -> Tensor:
        """Numbers (B, c) of columns, NaN where a marker is hidden; MeasurementError for other cells without one."""
        names, decimal, hideable = self.columns.names, self.columns.table.decimal, self.columns.hideable
        found = [numbers_in(column, decimal) for column in columns]
        if any(None in column for column in found):
            rows = zip(lines, zip(*columns, strict=True), zip(*found, strict=True), strict=True)
            bad = [
                (line, names[k], texts[k]) for line, texts, own in rows for k, value in enumerate(own) if value is None
            ]
            raise bad_cells(self.path, bad, "a number", number_hint(bad[0][2], decimal))
        numbers = torch.tensor(found, dtype=torch.float64, device=HOST).T
        empty, large = numbers.isnan(), numbers.abs() >= LARGEST_NUMBER
        excused, shows = torch.zeros_like(empty), torch.zeros_like(empty[:, 0])
        seen = [~(empty[:, own.values].all(1) | large[:, own.values].all(1)) for own in hideable]
        for own, here in zip(hideable, seen, strict=True):
            excused[:, [*own.values, *own.deviations]] |= ~here[:, None]
            shows |= here
        for own, here in zip(hideable, seen, strict=True):
            excused[:, own.deviations] &= ~here[:, None]
        if hideable and not self.columns.all_hidden:
            excused[:, len(self.columns.joints.columns) :] |= ~shows[:, None]  # the row is left out
        gaps = empty | large
        wrong: list[tuple[int, int]] = (gaps & ~excused).nonzero().tolist()
        if wrong:
            bad = [(lines[row], names[k], columns[k][row]) for row, k in wrong]
            hint = " (all cells of a hidden marker or frame are empty)" * bool(hideable)
            huge = bool((large & ~numbers.isinf() & ~excused).any())
            expected = f"a number below {LARGEST_NUMBER:g} in size" if huge else "a finite number"
            raise bad_cells(self.path, bad, expected, f"remove or repair these lines{hint}")
        hidden: list[tuple[int, int]] = gaps.nonzero().tolist()
        for row, k in hidden:
            if columns[k][row].lower() not in ("", "nan"):
                self._words.setdefault(columns[k][row], []).append(lines[row])
        return numbers.masked_fill(gaps, math.nan)

    def _check_units(self) -> None:
        """Raise MeasurementError where the file states another unit of a wanted column than it is read with."""
        columns, table = self.columns, self.columns.table
        joints = zip(columns.joints.texts, columns.prismatic.tolist(), columns.joints.plain.tolist(), strict=True)
        units = [(name, table.joint_unit if slide else table.angle) for name, slide, plain in joints if plain]
        read: dict[str, Any] = dict(units)
        read |= {name: group.unit for group in columns.groups.values() for name in group.names if group.unit}
        angles = len(columns.rotation) == 3 * len(columns.triples)  # not a quaternion or a matrix
        read |= dict.fromkeys(columns.rotation if angles else (), columns.rotation_unit)
        stated = {name: stated_unit(name, self.units) for name in read}
        if not columns.kinds_known:  # the joints may be prismatic
            stated |= {name: None for name, _ in units if stated[name] not in ANGLES}
        wrong = [name for name, unit in read.items() if isinstance(unit, str) and stated[name] not in (None, unit)]
        for name in sorted(wrong, key=lambda name: stated[name] in (*UNITS_PER_METRE, *ANGLE_UNITS)):  # cm, inch first
            what, fix = f"file '{self.path}', column '{shown(name)}'", "state the unit of the file, or convert it"
            got = f"{stated[name]} in its header"
            raise MeasurementError.of(what, expected=f"{read[name]}, as stated", got=got, fix=fix)

    def _checked(self) -> Iterator[Block]:
        """All blocks; what they have in common is checked after the last one."""
        columns, largest = self.columns, None
        checks = [group.check for group in columns.groups.values() for _ in group.names]
        unseen, count = columns.hideable, 0
        for block in self._numbers():
            raw = block.numbers
            most = raw.nan_to_num(0.0).abs().amax(0, keepdim=True)
            largest = most if largest is None else torch.maximum(largest, most)
            for name, check, values in zip(columns.names, checks, raw.T, strict=True):
                wrong = [] if check is None else (values < 0 if check.zero else values <= 0).nonzero()[:, 0].tolist()
                if check is not None and wrong:
                    bad = [(block.lines[row], name, f"{float(values[row]):g}") for row in wrong]
                    raise bad_cells(self.path, bad, check.expected, check.fix)
            unseen = [own for own in unseen if bool(raw[:, own.values].isnan().all())]
            count += len(block.lines)
            yield block
        notes = self.notes
        if self._words:
            words = " and ".join(f"'{shown(text)}' ({len(at)})" for text, at in self._words.items())
            at = few(sorted({line for own in self._words.values() for line in own}))
            notes.append(f"cells that hold {words} are taken as empty (line {at})")
        if notes:
            warn_user(f"file '{self.path}': {'; '.join(notes)}")
        if largest is not None:
            for text in columns.unlikely_units(largest):
                warn_user(f"file '{self.path}': {text}")
        for own in unseen:
            names = few([columns.names[place] for place in own.values])
            what, fix = f"file '{self.path}', columns {names}: empty in all {count} lines", "leave them out"
            raise MeasurementError.of(what, expected=f"some line that {own.word}", fix=fix)
