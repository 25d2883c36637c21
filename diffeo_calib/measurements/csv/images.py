"""Images of a board in a CSV file: one line for each corner, and the lines of an image one row."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError, few
from diffeo_calib.measurements.csv.cells import bad_cells
from diffeo_calib.measurements.csv.columns import Group
from diffeo_calib.measurements.csv.sensors import SensorColumns, Written
from diffeo_calib.measurements.csv.tables import FileRows
from diffeo_calib.measurements.images import Known
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import TableFormat

IMAGE, POINT, PIXEL, CAMERA = "image", ("board_x", "board_y"), ("u", "v"), "camera"
"""Columns: name of the image, place of the corner on the board in the unit of length, pixels; name of the camera, if
there are several."""


@dataclass(frozen=True)
class ImageColumns(SensorColumns):
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
    word = "an image"

    @property
    def texts(self) -> Mapping[str, bool]:
        return {CAMERA: False, IMAGE: True} | ({} if self.device is None else {self.device: True})

    def groups(self, table: TableFormat) -> tuple[Group, ...]:
        return Group(POINT, table.length), Group(PIXEL)

    def filled(self, rows: FileRows) -> Tensor:
        return rows.filled(IMAGE)

    def own_lines(self, rows: FileRows) -> FileRows:
        """The first line of every image."""
        return rows.of(torch.tensor([own[0] for own in self._images(rows).values()], dtype=torch.int64, device=HOST))

    def table(self, rows: FileRows) -> Measurements:
        images = self._images(rows)
        _check_joints(rows, images)
        points, pixels = (rows.values[one] for one in self.groups(rows.columns.table))
        flat = torch.cat([points, torch.zeros_like(points[:, :1]), pixels], 1)
        empty = flat[:, [0, 1, 3, 4]].isnan().nonzero().tolist()
        if empty:
            bad = [(rows.lines[row], (*POINT, *PIXEL)[k], "") for row, k in empty]
            raise bad_cells(rows.path, bad, "a number", "fill it in, or delete the line")
        corners = flat.new_full((len(images), max(map(len, images.values())), 5), torch.nan)
        for number, own in enumerate(images.values()):
            corners[number, : len(own)] = flat[own]
        first = self.own_lines(rows)
        known: dict[str, Any] = {"camera_on_tool": self.camera_on_tool, "doubt": False}
        if CAMERA in rows.texts:
            known["seen_by"] = first.named(CAMERA, "the name of the camera")
        data = Measurements.from_images(first.values["q"], corners, self.camera, rows.columns.joints.texts, **known)
        set_ups = first.devices(self.device, "a name")
        return data if set_ups is None else data.with_sessions(set_ups)

    def written(self, part: Any, table: TableFormat) -> Written:
        """A line for each corner."""
        number, corner = (~part.corners[..., 0].isnan()).nonzero().unbind(1)
        seen, whose = part.corners[number, corner], number.tolist()
        texts = {IMAGE: [str(k) for k in whose]}
        named = {CAMERA: part.camera_names} if len(part.cameras) > 1 else {}
        named |= {} if self.device is None else {self.device: part.device_names}
        texts |= {name: [column[k] for k in whose] for name, column in named.items()}
        points, pixels = self.groups(table)
        return {points: seen[:, :2], pixels: seen[:, 3:]}, texts, number

    def _images(self, rows: FileRows) -> dict[str, list[int]]:
        """The lines of each image, by its name with that of its camera."""
        images = rows.named(IMAGE, "the name of the image")
        if CAMERA in rows.texts:
            images = [f"{camera}/{image}" for camera, image in zip(rows.texts[CAMERA], images, strict=True)]
        found: dict[str, list[int]] = {}
        for row, name in enumerate(images):
            found.setdefault(name, []).append(row)
        return found


def _check_joints(rows: FileRows, groups: dict[str, list[int]]) -> None:
    """Raise MeasurementError for an image whose lines differ in their joint values."""
    for name, own in groups.items():
        other = (rows.values["q"][own] != rows.values["q"][own[0]]).any(1).nonzero()[:, 0].tolist()
        if other:
            what = f"file '{rows.path}', image '{name}'"
            got = f"other ones in line {few([rows.lines[own[row]] for row in other])}"
            fix = "give every image a name of its own, and its joint values in all of its lines"
            raise MeasurementError.of(what, expected="the joint values of its first line", got=got, fix=fix)


def written_columns(data: Any, session: str | None) -> ImageColumns:
    """How to read images that are written, with this column of set-ups."""
    several = len(data.cameras) > 1
    session = None if not data.session_names or (several and data.device_names == data.camera_names) else session
    sizes = {name: (camera.width, camera.height) for name, camera in data.cameras.items()}
    return ImageColumns(sizes if several else sizes.popitem()[1], data.board is not None, session)
