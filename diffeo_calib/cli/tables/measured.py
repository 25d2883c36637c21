"""From the options of a command to the table that they describe, of whatever kinds its rows are. Imports torch."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import Any

from diffeo_calib.cameras.files import read_camera
from diffeo_calib.cli.options.sockets import check_place
from diffeo_calib.cli.tables import positions
from diffeo_calib.cli.tables.positions import MeasuredTable
from diffeo_calib.common.errors import InputError
from diffeo_calib.measurements.csv.images import ImageColumns, image_size
from diffeo_calib.measurements.csv.sensors import ReadingColumns, SocketColumns
from diffeo_calib.measurements.table_format import TableFormat

KINDS = {"distance": "distance", "displacement": "distance", "height": "height"}
"""Kinds with one column."""
CORNERS = "corners="
"""Begin of the option for images of a board."""
UNKNOWN_ZERO_M = 1.0
"""Standard deviation of the unknown zero of displacements: wide."""


def measured_table(options: Mapping[str, Any]) -> MeasuredTable:
    """The table that the options of `fit` or `evaluate` describe; exact repeats are kept.

    Raises:
        InputError: options that do not go together, or are not written as they should be.
    """
    given = options.get
    on_tool, session = bool(given("camera_on_tool")), given("session")
    texts = given("reading") or ()
    images = any(text.startswith(CORNERS) for text in texts)
    readings = tuple(
        image_columns(text, on_tool, session) if text.startswith(CORNERS) else reading_columns(text, session)
        for text in texts
    )
    known = given("socket"), given("distance"), given("distance_std")
    check_place(options)
    table = positions.table_format(*(options[name] for name in ("length", "angle", "sep", "decimal", "joint_length")))
    turned = (given(name) for name in ("rotation", "convention", "rotation_angle", "lever"))
    table = positions.with_rotation(table, *turned, camera_on_tool=on_tool and not images)
    table = positions.with_columns(table, *(given(name) for name in ("std", "rotation_std", "payload")))
    return MeasuredTable(
        options["csv"],
        options["joints"],
        given("position") or [],
        table,
        given("duplicates") or "keep",
        given("session"),
        socket_columns(*known, table),
        readings,
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


def image_columns(text: str, on_tool: bool, session: str | None) -> ImageColumns:
    """corners=CAMERA.yaml, or corners=WIDTH,HEIGHT of images by an unknown camera, as columns.

    Raises:
        InputError: neither a size nor the file of a camera.
    """
    rest = text.removeprefix(CORNERS).strip()
    size = image_size(rest.split(","))
    if size is not None:
        return ImageColumns(size, None, on_tool, session)
    camera = read_camera(rest)
    return ImageColumns((camera.width, camera.height), camera, on_tool, session)


def reading_columns(text: str, device: str | None) -> ReadingColumns:
    """KIND=COLUMN as columns; images have two, and the four numbers of their cameras."""
    kind, _, rest = text.partition("=")
    words = tuple(word.strip() for word in rest.split(","))
    numbers = [_number(word) for word in words]
    if kind == "image" and len(words) == 6 and all(words[:2]):
        fx, fy, cx, cy = numbers[2:]
        if fx and fy and cx is not None and cy is not None and min(fx, fy) > 0.0:
            return ReadingColumns("image", words[:2], device, intrinsics=(fx, fy, cx, cy))
    elif kind in KINDS and len(words) == 1 and words[0]:
        value = words if numbers[0] is None else numbers[0]
        if kind == "distance" and isinstance(value, float) and value <= 0.0:
            fix = "write the length of the ball bar in the unit of --length, or name a column"
            raise InputError.of(f"--reading {text}", expected="a distance above 0", fix=fix)
        return ReadingColumns(KINDS[kind], value, device, UNKNOWN_ZERO_M * (kind == "displacement"))
    expected = "distance=COLUMN, displacement=COLUMN, height=COLUMN, image=U,V,FX,FY,CX,CY or corners=FILE"
    raise InputError.of(f"--reading {text}", expected=expected, fix="focal lengths FX, FY are positive pixels")


def _number(text: str) -> float | None:
    """A finite number; None for the name of a column."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if isfinite(value) else None
