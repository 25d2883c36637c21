"""What the columns of a table hold beside the joints: entries of the campaign file that `diffeo-calib init` writes."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from os.path import relpath
from pathlib import Path
from typing import NamedTuple

from diffeo_calib.cameras.files import read_camera
from diffeo_calib.cli.column_names import column
from diffeo_calib.cli.guesses import (
    LENS,
    NAMED,
    Sheet,
    guess_matrix,
    guess_positions,
    guess_readings,
    guess_sheet,
)
from diffeo_calib.cli.options import CORNERS, Places
from diffeo_calib.common.errors import InputError, few
from diffeo_calib.measurements.csv.cells import number
from diffeo_calib.measurements.csv.images import CAMERA, IMAGE, PIXEL, POINT
from diffeo_calib.measurements.csv.joined import joined_file
from diffeo_calib.measurements.csv.lines import read_cells
from diffeo_calib.measurements.table_format import TableFormat

USUAL_SIZES = (640, 480), (1280, 720), (1280, 960), (1920, 1080), (2048, 1536), (2592, 1944), (4096, 3072), (8192, 8192)
"""Widths and heights of images, pixels."""
BELOW = (12, 13, 14)
"""Places of the zeros below a rotation, of a matrix by rows."""


class Choice(NamedTuple):
    """One entry of the campaign file: an option, its value, and why; a remark if the option is empty."""

    name: str
    value: str | list[str] | bool
    why: str
    sure: bool = True

    def line(self) -> str:
        """As TOML; as a comment where the user is to decide."""
        values = self.value if isinstance(self.value, list) else [self.value]
        written = [json.dumps(value, ensure_ascii=False) for value in values]
        text = f"[{', '.join(written)}]" if isinstance(self.value, list) else written[0]
        return f"{'# ' * (not self.sure)}{self.name} = {text}  # {self.why}" if self.name else f"# {self.why}"


def entries(tables: Sequence[TableFormat], **why: str) -> Iterator[Choice]:
    """Fields of formats, each with its reason; where the formats differ, a remark for every value, to choose from."""
    for name, text in why.items():
        values = dict.fromkeys(getattr(table, name) for table in tables)
        known = (value for value in values if value not in (None, False))
        yield from (Choice(name.replace("_", "-"), value, text, sure=len(values) == 1) for value in known)


@dataclass(frozen=True)
class RowColumns:
    """Columns of what was measured, by their names.

    Args:
        markers: of positions. sockets: of place and socket. readings: texts of `fit --reading`. named: option -> column
            of the device or its set-up, the payload, time, temperature.
        matrix: the nine of the rotation, by rows, where poses are written as matrices. left: what is not used, and why.
    """

    markers: list[list[str]]
    sockets: list[str]
    readings: list[str]
    named: dict[str, str]
    matrix: Sequence[str] = ()
    left: Sequence[str] = ()

    @property
    def without_length(self) -> bool:
        """Whether no column is a length."""
        return not self.markers and all(text.endswith(LENS) for text in self.readings)

    @property
    def of_boards(self) -> bool:
        """Whether the rows are corners of a board in images."""
        return any(text.startswith(CORNERS) for text in self.readings)

    def entries(self) -> Iterator[Choice]:
        """Those that name them."""
        if self.markers:
            names = [",".join(triple) for triple in self.markers]
            yield Choice("position", names, f"{len(names)} marker(s), by their names")
        yield from (Choice("", "", f"{text}; not used") for text in self.left)
        if self.sockets:
            yield Choice(
                "socket", self.sockets, "by their names; a ball on the tool rested in this socket of a block there"
            )
        if self.readings:
            why = "by names; `displacement` is a distance with an unknown zero"
            if any(text.endswith(LENS) for text in self.readings):
                why += f"; replace {LENS} by the camera's focal lengths and principal point in pixels"
            sizes = self.of_boards and not self.readings[0].endswith(".yaml")
            why += "; the lens is that of the file beside the table" * (self.of_boards and not sizes)
            why += "; width and height of the images are the least usual size that holds all corners" * sizes
            yield Choice("reading", self.readings[0] if len(self.readings) == 1 else self.readings, why)
        for option, name in self.named.items():
            why = f"by its name: {NAMED[option].what}"
            remounted = option == "session" and bool(self.markers)
            why += "; add `remounted = true` if it stayed and the markers were mounted anew" * remounted
            yield Choice(option, name, why)


def rows_in(csv: Path, sheet: Sheet, joints: list[str]) -> RowColumns:
    """The probable contents of a table beside its joints."""
    known = {name.lower(): name for name in sheet.header}
    sockets = [known[name] for name in ("place", "socket") if name in known and "socket" in known]
    with_gaps = sheet.header if sockets else sheet.numbers  # rows in sockets have no positions
    markers, unmeasured = guess_positions([name for name in with_gaps if name not in joints])
    left = [f"{few(names)}: {why}" for names, why in unmeasured]
    others = [name for name in sheet.numbers if name not in joints]
    nameless = all(name.isdecimal() for name in sheet.header) and len(others) > 2
    matrix = () if markers or nameless else matrix_in(csv, sheet, others)
    markers = [others[:3]] if nameless else markers or [list(own) for own in matrix[:1]]
    readings = _readings_in(csv, sheet, others, alone=not markers and not sockets)
    if not markers and not sockets and not readings:
        expected = "three columns of numbers named x, y and z, alone or behind a separator, such as left_x"
        common = next((name for name in sheet.header if name not in joints), "COLUMN")
        fix = f"if they are in another file: --places FILE --by {common}; "
        fix += "without a tracker: a ball in sockets has columns `place` and `socket`, which `init` knows, a device a "
        fix += "column such as `distance`, `wire` or `height`; `fit --help` lists all options, see --reading"
        got = "; ".join(left) or few(sheet.numbers, 20)
        raise InputError.of(f"positions in '{csv}'", expected=expected, got=got, fix=fix)
    named = [name for name in sheet.header if name not in joints]
    columns = {"session": [] if sockets and not readings else named}
    guessed = {
        option: [name for name in columns.get(option, others) if column(name).plain in one.names]
        for option, one in NAMED.items()
    }
    found = {option: names[0] for option, names in guessed.items() if names}
    return RowColumns(markers, sockets, readings, found, [name for own in matrix[1:] for name in own], left)


def matrix_in(csv: Path, sheet: Sheet, columns: Sequence[str]) -> tuple[list[str], ...]:
    """Position and rotation, by rows, of poses that are written as 16 numbers by rows or columns; none without them."""
    found = guess_matrix(columns)
    if found is None:
        return ()
    names, named = found
    header, rows = read_cells(csv, sheet.sep)
    by_rows = named or all(
        number(cells[header.index(names[k])], sheet.decimal) == 0 for _, cells in rows for k in BELOW
    )
    entries = [names[4 * row : 4 * row + 4] if by_rows else names[row::4] for row in range(3)]
    return [row[3] for row in entries], [name for row in entries for name in row[:3]]


def _readings_in(csv: Path, sheet: Sheet, columns: Sequence[str], *, alone: bool) -> list[str]:
    """Texts of `fit --reading`; beside other kinds of rows, or one another, columns that some rows leave empty."""
    header, rows = read_cells(csv, sheet.sep)
    corners = _corners_in(csv, sheet) if {IMAGE, *POINT, *PIXEL} <= set(header) else []
    found = guess_readings([name for name in columns if not corners or name not in (*POINT, *PIXEL)])
    if alone and len(found) == 1 and not corners:
        return list(found)
    empty = {name for k, name in enumerate(header) if any(not cells[k].strip() for _, cells in rows)}
    return [*corners, *(text for text, own in found.items() if set(own) <= empty)]


def _corners_in(csv: Path, sheet: Sheet) -> list[str]:
    """The files of the cameras beside the table, as `images` writes them, else a usual size that holds all corners."""
    header, rows = read_cells(csv, sheet.sep)
    names = dict.fromkeys(cells[header.index(CAMERA)].strip() for _, cells in rows) if CAMERA in header else {}
    files = [f"{name}.yaml" for name in names if name]
    if len(files) > 1 and all((csv.parent / file).is_file() for file in files):
        return [f"{CORNERS}{csv.parent / file}" for file in files]
    own, cameras = csv.with_suffix(".yaml"), list[Path]()
    for file in [own] if own.is_file() else csv.parent.glob("*.yaml"):
        with suppress(InputError):  # no camera
            read_camera(file)
            cameras.append(file)
    if len(files) < 2 and len(cameras) == 1:
        return [f"{CORNERS}{cameras[0]}"]
    places = [header.index(name) for name in PIXEL]
    width, height = (max(number(cells[k], sheet.decimal) or 0.0 for _, cells in rows) for k in places)
    size = next((size for size in USUAL_SIZES if width < size[0] and height < size[1]), USUAL_SIZES[-1])
    return [f"{CORNERS}{','.join(map(str, size))}"]


def tips_of(markers: Sequence[Sequence[str]], leaves: Sequence[str]) -> list[str]:
    """The leaf after which the columns of each marker are named, such as left_x after left; none unless several are."""
    known = {column(leaf).plain: leaf for leaf in leaves}
    found = [known.get(column(triple[0]).plain.removesuffix("x")) for triple in markers]
    tips = [tip for tip in found if tip is not None]
    return tips if len(tips) == len(markers) and len(set(tips)) > 1 else []


def with_places(csv: Path, given: Places, folder: Path) -> tuple[Path, list[Choice]]:
    """The table, joined with that of the measured places if there is one, and the entries of a campaign in a folder."""
    if given.places is None:
        return csv, []
    joints, places = sheets = guess_sheet(csv), guess_sheet(given.places)
    tables = [read_cells(path, sheet.sep) for path, sheet in zip((csv, given.places), sheets, strict=True)]
    texts = [{name: {cells[k] for _, cells in rows} for k, name in enumerate(header)} for header, rows in tables]
    common = {name: len(own & texts[1][name]) for name, own in texts[0].items() if name in texts[1]}
    if given.by is None and not common:
        expected, got = "a column that both files have", " and ".join(few(own.header, 12) for own in (joints, places))
        fix = "add one, such as the number of the pose, or name two: --by COLUMN=OTHER"
        raise InputError.of("--places without --by", expected=expected, got=got, fix=fix)
    by = given.by or max(common, key=lambda name: common[name])
    found = joined_file(csv, given.places, by, joints.sep, joints.decimal, several=True)
    entries = [Choice("places", relpath(given.places, folder), "the measured places"), Choice("by", by, found.sentence)]
    return found, entries
