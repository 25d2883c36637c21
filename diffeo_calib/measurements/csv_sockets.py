"""The columns of a CSV file that name the sockets in which a ball rested."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.measurements.csv_cells import read_texts
from diffeo_calib.measurements.sockets import SEPARATOR, Distances
from diffeo_calib.measurements.table_format import TableFormat


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

    def texts(self, path: Path, sep: str, lines: Sequence[int]) -> list[str]:
        """The socket of each of these lines of a file, such as "front/0".

        Raises:
            MeasurementError: no such column, several, or an empty cell.
        """
        if not self.names:
            raise MeasurementError.of(
                "`socket`", expected="names of columns", got="none", fix="pass ['place', 'socket']"
            )
        columns = [read_texts(path, sep, name, lines) for name in self.names]
        return [SEPARATOR.join(cells) for cells in zip(*columns, strict=True)]


def check_socket_options(position: object, table: TableFormat, session: str | None) -> None:
    """Raise MeasurementError for what a table of sockets does not have."""
    given = {"position": position, "rotation": table.rotation, "std": table.std, "rotation_std": table.rotation_std}
    names = [name for name, value in (given | {"session": session}).items() if value is not None]
    if names:
        what = " and ".join(f"`{name}`" for name in names) + " beside `socket`"
        fix = "leave it out: no position was measured; sockets of another set-up are other places"
        raise MeasurementError.of(what, fix=fix)
