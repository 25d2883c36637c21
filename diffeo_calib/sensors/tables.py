"""The two ways in which rows tell of a robot: coordinates of points on the tool, and readings of the ball."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.measurements.rows import NO_SOCKET, with_attributes
from diffeo_calib.measurements.table import Measurements


class Coordinates(NamedTuple):
    """Rows that tell coordinates: positions, poses, a ball in sockets; and their numbers (M,) in the whole table."""

    table: Measurements
    rows: Tensor


class OtherReadings(NamedTuple):
    """Readings of one kind, and their numbers (M,) in the whole table."""

    table: Readings
    rows: Tensor


def divided(data: Any) -> tuple[Coordinates | None, list[OtherReadings]]:
    """The rows of any table that tell coordinates, as one table, and its readings by kind."""
    index = getattr(data, "index", (torch.arange(len(data), device=HOST),))
    parts = list(zip(data.parts, index, strict=True))
    own = [(table, rows) for table, rows in parts if isinstance(table, Measurements)]
    readings = [OtherReadings(table, rows) for table, rows in parts if isinstance(table, Readings)]
    if len(own) < 2:
        return (Coordinates(*own[0]) if own else None), readings
    rows = torch.cat([numbers for _, numbers in own])
    order = rows.argsort()
    return Coordinates(Measurements.joined([table for table, _ in own]).rows(order), rows[order]), readings


def with_markers(table: Measurements, markers: int) -> Measurements:
    """Rows that tell coordinates, with so many markers, the ball last: rows of one kind hide those of the other."""
    if table.sockets is not None:
        table = table.with_sockets_of_rows()
        return table.with_hidden_markers(markers - 1) if table.markers == 1 < markers else table
    return table.with_hidden_ball() if table.markers == markers - 1 else table


def measured_rows(table: Measurements) -> tuple[Measurements, Tensor]:
    """The rows that a device measured, with all markers of the table, and their numbers (M,)."""
    rows = torch.arange(len(table), device=HOST)
    rows = rows if table.socket is None else rows[table.socket == NO_SOCKET]
    return with_attributes(table.rows(rows), socket=None, sockets=None), rows


def ball_tip(own: Coordinates | None, readings: Sequence[OtherReadings], usual: str) -> str:
    """Name of the tip that carries the ball; the usual one where no table names it."""
    tables = [one.table for one in readings] + ([] if own is None else [own.table])
    return next((tip for table in tables if (tip := table.ball_tip) is not None), usual)


def check_poses(data: Any) -> None:
    """Raise MeasurementError for poses beside rows with a ball, of which a model knows no pose."""
    kinds = dict.fromkeys(part.kind for part in data.parts)
    if "pose" in kinds and len(kinds) > 1:
        got = " and ".join(f"{kind}s" for kind in kinds)
        fix = "give the positions of the poses alone (leave their rotation out)"
        raise MeasurementError.of("poses in a table of several kinds", expected="positions", got=got, fix=fix)
