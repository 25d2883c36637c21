"""Tables of both kinds of rows: positions that a device measured, and a ball that rested in sockets.

The ball is the last marker of all rows: hidden where the device measured, and alone where it rested in a socket.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.measurements.frozen import with_attributes
from diffeo_calib.measurements.sockets import NO_SOCKET
from diffeo_calib.measurements.table_checks import check_alike

T = TypeVar("T")
BALL = "ball"
"""Name of the last marker, if the other ones have names."""


def joined_rows(parts: Sequence[T]) -> T:
    """Tables of one kind, or of positions and sockets, as one; MeasurementError if they differ in their columns."""
    tables: Any = list(parts)
    if len(tables) == 1:
        return tables[0]
    tables = tables[0].beside_one_another(tables)
    check_alike(tables, tables[0].BY_ROW, tables[0].ALIKE)
    whole = {name: torch.cat([table.columns[name] for table in tables]) for name in tables[0].columns}
    same = {name: common([getattr(table, name) for table in tables]) for name in ("file_sha256", "origin")}
    return with_attributes(tables[0], **whole, **same)


def of_one_layout(tables: list[Any]) -> list[Any]:
    """Positions and rows in sockets with the same markers, the ball as the last one."""
    mixed = len({table.sockets is None for table in tables}) > 1 or len({table.markers for table in tables}) > 1
    return _of_one_kind(tables) if mixed else tables


def common(values: Sequence[T]) -> T | None:
    """The value that all have in common; None if they differ."""
    first = values[0]
    same = all(value is first or (isinstance(first, str) and value == first) for value in values)
    return first if same else None


def device_rows(data: T) -> T:
    """The rows whose positions a device measured, without the ball; the table itself if it has no sockets."""
    table: Any = data
    if table.sockets is None:
        return data
    rows = table.rows((table.socket == NO_SOCKET).nonzero()[:, 0].tolist())
    changes = {"socket": None, "sockets": None, "points": rows.points[:, :-1]}
    changes |= {} if rows.std is None else {"std": rows.std[:, :-1]}
    changes |= {name: _all_but_last(getattr(rows, name)) for name in ("marker_names", "on")}
    return with_attributes(rows, **changes)


def socket_rows(data: T) -> T:
    """The rows whose ball rested in sockets, with the ball alone; MeasurementError if there are none."""
    table: Any = data
    if table.sockets is None:
        raise MeasurementError.of("the rows have no sockets", fix="pass Measurements.from_sockets(...)")
    if table.without_device and table.markers == 1:
        return data
    rows = table.rows((table.socket != NO_SOCKET).nonzero()[:, 0].tolist())
    changes = {"points": rows.points[:, -1:], "marker_names": None, "on": None, "std": None}
    return with_attributes(rows, **changes, session=None, session_names=())


def with_hidden_ball(data: T) -> T:
    """Measured positions with a ball that no row shows as their last marker."""
    table: Any = data
    none = table.points.new_full((len(table), 1, 3), torch.nan)
    changes: dict[str, object] = {"points": torch.cat([table.points, none], dim=1)}
    if table.std is not None:
        changes["std"] = torch.cat([table.std, none], dim=1)
    if table.marker_names is not None:
        changes["marker_names"] = (*table.marker_names, BALL)
    if table.on is not None:
        changes["on"] = (*table.on, table.on[-1])
    return with_attributes(data, **changes)


def with_hidden_markers(data: T, markers: int) -> T:
    """Rows in sockets with so many markers before the ball that no row shows."""
    table: Any = data
    none = table.points.new_full((len(table), markers, 3), torch.nan)
    return with_attributes(data, points=torch.cat([none, table.points], dim=1), marker_names=None, on=None)


def _all_but_last(names: tuple[str, ...] | None) -> tuple[str, ...] | None:
    return None if names is None else names[:-1]


def _of_one_kind(tables: list[Any]) -> list[Any]:
    """Tables of either kind, or of both, as those of both."""
    device = [table for table in tables if table.sockets is None]
    known = [table for table in tables if table.sockets is not None]
    if not known:
        return tables
    both = with_hidden_ball(device[0]) if device else max(known, key=lambda table: table.markers)
    found: list[Any] = []
    for table in tables:
        none = torch.full((len(table),), NO_SOCKET, dtype=torch.int64, device=HOST)
        if table.sockets is None:
            found.append(with_attributes(with_hidden_ball(table), socket=none, sockets=known[0].sockets))
        elif table.markers == 1:
            found.append(_beside(table, both, none))
        else:
            found.append(table)
    return found


def _beside(table: Any, other: Any, none: Tensor) -> Any:
    """Rows in sockets with the markers of other rows, all hidden."""
    shown = with_hidden_markers(table, other.markers - 1)
    changes = {"marker_names": other.marker_names, "on": other.on}
    changes |= {} if other.std is None else {"std": torch.full_like(shown.points, torch.nan)}
    changes |= {} if other.session is None else {"session": none, "session_names": other.session_names}
    return with_attributes(shown, **changes)
