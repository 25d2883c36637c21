"""Tables of rows in sockets as the options describe them, and what is printed about them. Imports torch."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from math import isfinite
from pathlib import Path
from typing import Any

from torch import Tensor

from diffeo_calib.calibration.expected_errors import expected_errors
from diffeo_calib.calibration.sockets import FLATTERY, workspace_deviation
from diffeo_calib.cli.options.sockets import check_place
from diffeo_calib.cli.record import record
from diffeo_calib.cli.tables import positions
from diffeo_calib.cli.tables.positions import MeasuredTable
from diffeo_calib.common.errors import InputError
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import Evaluation
from diffeo_calib.measurements.csv.sensors import SocketColumns
from diffeo_calib.measurements.table_format import TableFormat

SPREAD_TITLE = "Spread within sockets in mm"
"""Of tables whose errors are distances from the middle of a socket."""


def measured_table(options: Mapping[str, Any]) -> MeasuredTable:
    """The table that the options of `fit` or `evaluate` describe, of positions or of sockets; exact repeats are kept.

    Raises:
        InputError: options that do not go together.
    """
    given = options.get
    others = ("session", "rotation", "camera_on_tool", "std", "payload", "register", "residuals")
    refused = {name: given(name) for name in others}
    known = given("socket"), given("distance"), given("distance_std")
    check_place(given("position"), *known, refused)
    table = positions.table_format(*(options[name] for name in ("length", "angle", "sep", "decimal", "joint_length")))
    turned = (options[name] for name in ("rotation", "convention", "rotation_angle", "lever"))
    table = positions.with_rotation(table, *turned, camera_on_tool=options["camera_on_tool"])
    table = positions.with_columns(table, *(options[name] for name in ("std", "rotation_std", "payload")))
    return MeasuredTable(
        options["csv"],
        options["joints"],
        given("position") or [],
        table,
        given("duplicates") or "keep",
        given("session"),
        socket_columns(*known, table),
    )


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


def check_outputs_of_sockets(source: MeasuredTable, report: Path | None) -> None:
    """Raise InputError for a report about rows in sockets."""
    if source.sockets is not None and report is not None:
        fix = "leave it out: a report shows errors of measured positions"
        raise InputError.of("--report beside --socket", fix=fix)


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


def stage_line(model: CalibratedKinematics, stages: Mapping[str, Callable[[Tensor], Tensor]]) -> str:
    """The absolute errors that a model of sockets or readings expects of every stage; they go into the record too."""
    found = expected_errors(model, stages)
    record.add(expected_error_by_stage_m=found)
    listed = ", ".join(f"{name} {1e3 * value:.3f}" for name, value in found.items())
    return f"expected absolute error by stage, in mm: {listed}"


def expectation_lines(model: CalibratedKinematics, flattery: str = FLATTERY) -> Iterator[str]:
    """The absolute error that a model of sockets or readings expects, and what does not show it without a device."""
    alone, expected = model.map.workspace is not None, 1e3 * workspace_deviation(model.map)
    fitted = ", after a rigid fit" * alone
    yield f"expected absolute error over the joint ranges of the fit{fitted}: {expected:.3f} mm RMS"
    yield from [flattery] * alone
