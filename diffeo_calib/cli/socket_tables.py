"""Tables of rows in sockets as the options describe them, and what is printed about them. Imports torch."""

from __future__ import annotations

from collections.abc import Iterator
from math import isfinite

from diffeo_calib.calibration.sockets import FLATTERY, workspace_deviation
from diffeo_calib.common.errors import InputError
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import Evaluation
from diffeo_calib.measurements.csv_sockets import SocketColumns
from diffeo_calib.measurements.table_format import TableFormat

SPREAD_TITLE = "Spread within sockets in mm"
"""Of tables whose errors are distances from the middle of a socket."""


def socket_columns(
    socket: str | None, distance: list[str] | None, std: float | None, table: TableFormat
) -> SocketColumns | None:
    """The options of sockets in SI units; None without sockets.

    Raises:
        InputError: a distance that is not written as A,B=LENGTH.
    """
    if socket is None:
        return None
    known = dict(_distance(text, table) for text in distance or ())
    return SocketColumns(
        tuple(name.strip() for name in socket.split(",")),
        known or None,
        None if std is None else std / table.per_metre,
    )


def _distance(text: str, table: TableFormat) -> tuple[tuple[str, str], float]:
    pair, _, length = text.rpartition("=")
    names = tuple(name.strip() for name in pair.split(","))
    try:
        value = float(length)
    except ValueError:
        value = 0.0
    if len(names) != 2 or not value > 0.0 or not isfinite(value):
        fix = "write two names of sockets and a length, such as 0,1=50 or front/0,front/1=50"
        raise InputError.of(f"--distance {text}", expected="A,B=LENGTH", fix=fix)
    return (names[0], names[1]), value / table.per_metre


def socket_lines(errors: Evaluation, rows: str) -> Iterator[str]:
    """Known distances and those found, for some rows."""
    for one in errors.distances:
        between = f"distance of '{one.first}' and '{one.second}' ({rows})"
        yield f"{between}: {1e3 * one.found:.3f} mm, known {1e3 * one.known:.3f}, error {1e3 * one.error:+.3f}"


def expectation_lines(model: CalibratedKinematics) -> Iterator[str]:
    """The absolute error that a model of sockets expects, and that the spread flatters."""
    expected = 1e3 * workspace_deviation(model.map)
    yield f"expected absolute error over the joint ranges of the fit, after a rigid fit: {expected:.3f} mm RMS"
    yield FLATTERY
