"""Measured poses of a table read in other ways: rotations in another convention or order, inverted, other columns."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import permutations
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.errors import shown
from diffeo_calib.measurements.csv.columns import Columns
from diffeo_calib.measurements.csv.tables import TableOrigin
from diffeo_calib.measurements.poses import (
    EULER,
    POINTS,
    inverse_poses,
    points_of_frames,
    rotation_matrices,
    transforms_of_frames,
)
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import flat_names

INVERTED = (
    "the poses seem to be those of the measuring frame, seen from the tool: if a camera on the tool sees a board, "
    "pass camera_on_tool=True (--camera-on-tool), else give the poses of the tool in the measuring frame"
)
NOT_INVERTED = (
    "the poses seem to be those of the camera in the board's frame already, or those of a board on the tool that a "
    "fixed camera sees: leave camera_on_tool (--camera-on-tool) out"
)


class Reread(NamedTuple):
    """Points (N, P, 3), m, of poses as they might have been meant.

    Args:
        words: what was changed. option: that reads the table so, where one option alone differs.
        on: tips of the points. partial: whether positions alone are explained.
    """

    points: Tensor
    words: str
    option: str = ""
    on: tuple[str, ...] = ()
    partial: bool = False


def other_rotations(data: Measurements) -> Iterator[Reread]:
    """Measured poses whose rotations are read in other ways, or whose poses are inverted; none without poses."""
    if data.frames is None or data.lever is None:
        return
    lever, on, seen_from_tool = data.lever, data.on or (), data.board is not None
    written = inverse_poses(data.frames) if seen_from_tool else data.frames

    def reread(frames: Tensor, words: str, option: str = "") -> Reread:
        return Reread(points_of_frames(inverse_poses(frames) if seen_from_tool else frames, lever), words, option, on)

    turns, places = written[..., :3, :3], written[..., :3, 3]
    yield reread(inverse_poses(written), NOT_INVERTED if seen_from_tool else INVERTED)
    words = "the rotations alone seem to be inverted (transposed): give those that belong to the positions"
    yield reread(transforms_of_frames(turns.mT, places), words)
    for rotations, words, option in _rewritten(data):
        yield reread(transforms_of_frames(rotations.to(places.device), places), words, option)
    if not seen_from_tool:  # else the place of the camera follows from its rotation
        words = "the positions alone fit: check the convention and the unit of the rotation columns"
        yield Reread(places, words, on=on[::POINTS], partial=True)


def with_coordinate(data: Measurements, marker: int, axis: int, values: Tensor) -> Tensor:
    """The points (N, P, 3) with other values (N,) of one coordinate of a marker, or of a pose's origin, m."""
    points, values = data.points.clone(), values.to(data.points.device)
    if data.frames is None:
        points[:, marker, axis] = values.where(~points[:, marker, axis].isnan(), torch.nan)
    elif data.board is not None and data.lever is not None:
        written = inverse_poses(data.frames)
        written[:, 0, axis, 3] = values
        return points_of_frames(inverse_poses(written), data.lever)
    else:
        points[:, POINTS * marker : POINTS * (marker + 1), axis] += (values - data.frames[:, marker, axis, 3])[:, None]
    return points


def numeric_table(data: Measurements) -> tuple[Columns | None, Mapping[str, Tensor]]:
    """How measurements were read, and all numeric columns of their file; None without it, or of rows of many lines."""
    if not isinstance(data.origin, TableOrigin) or data.origin.columns.table.marker is not None:
        return None, {}
    table = data.origin.numeric_columns(data.line_numbers)
    return (data.origin.columns, table) if table else (None, {})


def _rewritten(data: Measurements) -> Iterator[tuple[Tensor, str, str]]:
    """Rotations (N, T, 3, 3) read in other ways, with words, and the option that reads them so."""
    columns, table = numeric_table(data)
    names = () if columns is None else flat_names(columns.table.rotation)
    if columns is None or columns.table.convention is None or not all(name in table for name in names):
        return
    convention, unit = columns.table.convention, columns.table.rotation_angle or "rad"
    frames = len(columns.table.triples)
    numbers = torch.stack([table[name] for name in names], dim=1).unflatten(1, (frames, -1))
    count, flat = numbers.shape[2], numbers.flatten(0, 1)

    def read(values: Tensor, convention: str, angle: str) -> Tensor:
        return rotation_matrices(values, convention, angle=angle).unflatten(0, (-1, frames))

    families = {3: (*EULER, "rotvec"), 4: ("quat_xyzw", "quat_wxyz"), 9: ("matrix",)}
    for other in families[count]:
        if other != convention:
            yield read(flat, other, unit), "", f"convention='{other}'"
    if count == 3:
        other = "deg" if unit == "rad" else "rad"
        yield read(flat, convention, other), "", f"rotation_angle='{other}'"
        for order in list(permutations(range(3)))[1:-1]:  # the last, reversed Euler angles, is a convention by itself
            words = f"the rotation columns seem to be in the order {shown(','.join(names[k] for k in order))}"
            yield read(flat[:, list(order)], convention, unit), words, ""
