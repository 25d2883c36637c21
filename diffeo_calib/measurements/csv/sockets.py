"""The columns of a CSV file that name the sockets in which a ball rested."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from diffeo_calib.common.errors import MeasurementError, few
from diffeo_calib.measurements.csv.cells import read_texts
from diffeo_calib.measurements.csv.columns import ChainLike, Columns, position_triples
from diffeo_calib.measurements.csv.tables import TableFile
from diffeo_calib.measurements.sockets import SEPARATOR, Distances
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import Names, TableFormat

WITHOUT_SOCKET = "fill it in; lines without a socket hold a measured position, whose columns must be named (`position`)"


@dataclass(frozen=True)
class SocketColumns:
    """How a table names sockets.

    Args:
        names: of the columns, such as place and socket; the last one names the socket at its place.
        distances: known distances between sockets, m. distance_std: their standard deviation, m.
    """

    names: Sequence[str]
    distances: Distances | None = None
    distance_std: float | None = None

    def texts(self, path: Path, sep: str, lines: Sequence[int], *, empty: bool = False) -> list[str]:
        """The socket of each of these lines of a file, such as "front/0"; "" where its cells are empty, if they may be.

        Raises:
            MeasurementError: no such column, several, or an empty cell.
        """
        if not self.names:
            raise MeasurementError.of(
                "`socket`", expected="names of columns", got="none", fix="pass ['place', 'socket']"
            )
        said = {"expected": "the name of a place or socket", "fix": WITHOUT_SOCKET}
        columns = [read_texts(path, sep, name, lines, empty=empty, **said) for name in self.names]
        rows = list(zip(*columns, strict=True))
        for line, cells in zip(lines, rows, strict=True):
            if any(cells) and not all(cells):
                what = f"file '{path}', line {line}, column '{self.names[cells.index('')]}'"
                raise MeasurementError.of(what, expected="a name", got="an empty cell", fix="fill it in")
        return [SEPARATOR.join(cells) if all(cells) else "" for cells in rows]


def read_rows_in_sockets(
    path: Path,
    joints: Sequence[str] | ChainLike,
    sockets: SocketColumns,
    table: TableFormat,
    *,
    kinds: Sequence[str] | None = None,
    position: Names | None = None,
    session: str | None = None,
    on: Sequence[str] | None = None,
) -> Measurements:
    """Read rows in which a ball rested in sockets, beside measured positions if ``position`` names their columns.

    Arguments and errors are those of :func:`~diffeo_calib.measurements.csv.files.read_measurements`; ``session`` and
    ``on`` are those of the measured positions.
    """
    if position is None:
        columns = Columns.of(table.joints_only(), joints, kinds, [])
        with TableFile(path, columns) as file:
            values, lines = file.read()
        return _in_sockets(values.q, sockets.texts(path, table.sep, lines), lines, columns, sockets).with_tips(on)
    columns = replace(Columns.of(table.for_reading(), joints, kinds, position_triples(position)), all_hidden=True)
    with TableFile(path, columns) as file:
        values, lines = file.read()
    texts = sockets.texts(path, table.sep, lines, empty=True)
    resting = _resting(path, texts, values.points, lines)
    rows, others = (kind.nonzero()[:, 0].tolist() for kind in (~resting, resting))
    own, rest = ([lines[row] for row in some] for some in (rows, others))
    plain = Measurements(
        values.q[rows],
        values.points[rows],
        columns.joints,
        std=None if values.std is None else values.std[rows],
        doubt=False,
    )
    device = plain.with_line_numbers(own).with_tips(on)
    if session is not None:
        device = device.with_sessions(read_texts(path, table.sep, session, own))
    ball = _in_sockets(values.q[others], [texts[row] for row in others], rest, columns, sockets)
    whole = Measurements.joined([device, ball])
    return whole.rows(whole.line_numbers.argsort())


def _in_sockets(
    q: Tensor, texts: Sequence[str], lines: Sequence[int], columns: Columns, sockets: SocketColumns
) -> Measurements:
    """Rows in sockets with these names."""
    known = sockets.distances, sockets.distance_std
    data = Measurements.from_sockets(q, texts, columns.joints, distances=known[0], distance_std=known[1], doubt=False)
    return data.with_line_numbers(lines)


def _resting(path: Path, texts: Sequence[str], points: Tensor, lines: Sequence[int]) -> Tensor:
    """(N,) boolean: the rows whose ball rested in a socket; the other ones have measured positions.

    Args:
        path: the file. texts: sockets of the rows, "" without one. points: (N, P, 3), NaN where hidden.
        lines: their numbers.

    Raises:
        MeasurementError: a row with both or with neither, or no row in a socket.
    """
    resting = torch.tensor([bool(text) for text in texts], dtype=torch.bool, device=points.device)
    measured = ~points.isnan().flatten(1).all(1)
    for both, got, fix in (
        (resting & measured, "both", "leave one of them empty, and write two lines if both were measured"),
        (~resting & ~measured, "neither", "fill in one of them, or remove the line"),
    ):
        wrong = [lines[row] for row in both.nonzero()[:, 0].tolist()]
        if wrong:
            what = f"file '{path}', line {few(wrong)}"
            raise MeasurementError.of(what, expected="a position or a socket", got=got, fix=fix)
    if not bool(resting.any()):
        what, fix = f"file '{path}': no line names a socket", "leave `socket` out"
        raise MeasurementError.of(what, expected="some rows in sockets", fix=fix)
    return resting


def check_socket_options(position: object, table: TableFormat, session: str | None) -> None:
    """Raise MeasurementError for what rows in sockets, or those beside measured positions, do not have."""
    given = {"rotation": table.rotation, "rotation_std": table.rotation_std, "payload": table.payload}
    given |= {"camera_on_tool": table.camera_on_tool or None}
    given |= {"std": table.std, "session": session} if position is None else {}
    names = [name for name, value in given.items() if value is not None]
    if names:
        what = " and ".join(f"`{name}`" for name in names) + " beside `socket`"
        fix = "leave it out: no position was measured; sockets of another set-up are other places"
        if position is not None:
            fix = "leave it out: rows in sockets go with measured positions alone"
        raise MeasurementError.of(what, fix=fix)
