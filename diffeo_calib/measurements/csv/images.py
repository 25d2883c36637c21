"""Images of a board in a CSV file: one line for each corner, and the lines of an image one row."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError, few
from diffeo_calib.measurements.csv.sensors import FileRows
from diffeo_calib.measurements.images import Known
from diffeo_calib.measurements.table import Measurements

IMAGE, POINT, PIXEL, CAMERA = "image", ("board_x", "board_y"), ("u", "v"), "camera"
"""Columns: name of the image, place of the corner on the board in the unit of length, pixels; name of the camera, if
there are several."""


@dataclass(frozen=True)
class ImageColumns:
    """How a table holds images.

    Args:
        camera: width and height of the images, pixels, or what is known of lens and board; of several cameras by the
            names in the column `camera`.
        camera_on_tool: whether the camera is on the tool; else the board is.
        device: column that names the set-up of every image; None for one.
    """

    camera: Known | Mapping[str, Known]
    camera_on_tool: bool = False
    device: str | None = None
    word: str = "an image"
    kind: str = "corners"
    values: tuple[str, ...] = (IMAGE, *POINT, *PIXEL)
    std: tuple[str, ...] = ()

    def filled(self, rows: FileRows) -> Tensor:
        """See :class:`SensorColumns`."""
        texts = rows.cells.texts(IMAGE, rows.lines, empty=True)
        return torch.tensor([bool(text) for text in texts], dtype=torch.bool, device=HOST)

    def own_lines(self, rows: FileRows) -> FileRows:
        """See :class:`SensorColumns`: the first line of every image."""
        first, names = torch.zeros(len(rows.lines), dtype=torch.bool, device=HOST), self._images(rows)
        first[[names.index(name) for name in dict.fromkeys(names)]] = True
        return rows.of(first)

    def table(self, rows: FileRows) -> Measurements:
        """See :class:`SensorColumns`."""
        names, table = self._images(rows), rows.columns.table
        groups = {name: list[int]() for name in names}
        for row, name in enumerate(names):
            groups[name].append(row)
        _check_joints(rows, groups)
        read = [rows.cells.numbers(name, rows.lines, table.decimal, "fill it in") for name in (*POINT, *PIXEL)]
        x, y, u, v = read
        flat = torch.stack([x / table.per_metre, y / table.per_metre, torch.zeros_like(x), u, v], 1)
        corners = flat.new_full((len(groups), max(map(len, groups.values())), 5), torch.nan)
        for number, own in enumerate(groups.values()):
            corners[number, : len(own)] = flat[own]
        first = self.own_lines(rows)
        known: dict[str, Any] = {"camera_on_tool": self.camera_on_tool, "doubt": False}
        if CAMERA in rows.cells.header:
            known["seen_by"] = first.cells.texts(CAMERA, first.lines, expected="the name of the camera")
        data = Measurements.from_images(first.values.q, corners, self.camera, rows.columns.joints, **known)
        set_ups = first.names(self.device, "a name")
        return data if set_ups is None else data.with_sessions(set_ups)

    def _images(self, rows: FileRows) -> list[str]:
        """Name of the image of each line, with that of its camera."""
        images = rows.cells.texts(IMAGE, rows.lines, expected="the name of the image", fix="fill it in")
        if CAMERA not in rows.cells.header:
            return images
        cameras = rows.cells.texts(CAMERA, rows.lines, empty=True)
        return [f"{camera}/{image}" for camera, image in zip(cameras, images, strict=True)]


def _check_joints(rows: FileRows, groups: dict[str, list[int]]) -> None:
    """Raise MeasurementError for an image whose lines differ in their joint values."""
    for name, own in groups.items():
        other = (rows.values.q[own] != rows.values.q[own[0]]).any(1).nonzero()[:, 0].tolist()
        if other:
            what = f"file '{rows.cells.path}', image '{name}'"
            got = f"other ones in line {few([rows.lines[own[row]] for row in other])}"
            fix = "give every image a name of its own, and its joint values in all of its lines"
            raise MeasurementError.of(what, expected="the joint values of its first line", got=got, fix=fix)


def written_columns(data: Any, session: str | None) -> ImageColumns:
    """How to read images that are written, with this column of set-ups."""
    several = len(data.cameras) > 1
    session = None if not data.session_names or (several and data.device_names == data.camera_names) else session
    sizes = {name: (camera.width, camera.height) for name, camera in data.cameras.items()}
    return ImageColumns(sizes if several else sizes.popitem()[1], data.board is not None, session)


def corner_lines(data: Any, cells: Mapping[str, list[Any]], per_metre: float) -> tuple[dict[str, list[Any]], Tensor]:
    """The cells of a line for each corner, from those of each image, and the number (M,) of its image."""
    number, corner = (~data.corners[..., 0].isnan()).nonzero().unbind(1)
    points, whose = data.corners[number, corner], number.tolist()
    named = {CAMERA: data.camera_names} if len(data.cameras) > 1 else {}
    found = {IMAGE: [str(k) for k in whose]}
    found |= {name: [column[k] for k in whose] for name, column in {**cells, **named}.items()}
    corners = torch.cat([per_metre * points[:, :2], points[:, 3:]], 1)
    return found | dict(zip((*POINT, *PIXEL), corners.T.tolist(), strict=True)), number
