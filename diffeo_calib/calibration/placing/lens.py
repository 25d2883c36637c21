"""Lens and board of images: errors that all of them share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.identification.identification import Identification
from diffeo_calib.calibration.placing.placement import DeviceSet, OtherRows, SeenRows, Settled
from diffeo_calib.cameras.board import LENS
from diffeo_calib.cameras.images import Camera
from diffeo_calib.common.errors import MeasurementError, sentence, warn_user
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.sensors.board_camera import CAMERA, BoardCamera, Explained
from diffeo_calib.sensors.places import PlacedDevices

SIZE_WARNED, SIZE_REFUSED = 0.006, 0.02
"""Shares by which lengths of a board may differ from the robot's. Simulated arms with errors of a mm: below 0.004."""
ROUNDS = 5
PARTS = slice(0, len(LENS)), slice(len(LENS), None)
"""Lens and board among the unknowns of a camera."""


@dataclass(frozen=True, eq=False)
class LensAndBoard(DeviceSet):
    """Lens and board of a camera.

    Args:
        camera: as images alone show them. slopes: (M, 9, c) effects of its errors on the points of each pose, m.
        rows: (M,) their rows of a calibration. on_tool: whether the camera is on the tool, else the board.
        apart: (9 M, c) the same effects apart from the places of the robot and of what is on the tool.
        explained: at the tool; what the fit says is zero before it.
    """

    camera: Camera
    slopes: Tensor
    rows: Tensor
    on_tool: bool
    apart: Tensor
    explained: Explained

    @classmethod
    def of_table(cls, data: Measurements, rows: Tensor, registration: Identification) -> list[Any]:
        """That of the images of a table, none for other tables; rows: (M,) numbers in the whole table.

        Raises:
            MeasurementError: a board of another size than was said.
        """
        found = []
        for camera, slopes, noise in data.shared_errors():
            corners = _rms_distance(noise.diagonal(dim1=1, dim2=2).sqrt())
            explained = Explained(registration.rms, 0.0, 0.0, 0.0, 0.0, corners)
            places = _places(data, registration).flatten(1, 2).flatten(0, 1)
            apart = slopes.flatten(0, 1)
            apart = apart - places @ torch.linalg.lstsq(places, apart, driver="gelsd").solution
            found.append(cls(camera, slopes, rows, data.board is not None, apart, explained))
            found[-1].check_size(data, registration)
        return found

    def check_size(self, data: Measurements, registration: Identification) -> None:
        """Compare the board's lengths with those of the robot as described, base and hand-eye being free.

        Raises:
            MeasurementError: a board of another size than was said. Warns: lengths that differ less.
        """
        larger = relative_size(data, registration)
        if abs(larger) < SIZE_WARNED:
            return
        what = "the size of the board does not fit that of the robot"
        got = f"lengths in the images {100 * abs(larger):.1f} % {'larger' if larger > 0 else 'smaller'}"
        fix = "measure the printed squares with a caliper (printers scale to fit the page), and check their unit"
        if abs(larger) > SIZE_REFUSED:
            raise MeasurementError.of(what, expected="lengths as in the robot's description", got=got, fix=fix)
        warn_user(sentence(f"{what}: {got}", fix=fix))

    @property
    def size(self) -> int:
        """Errors of lens and board."""
        return self.slopes.shape[2]

    def effects(self, data: SeenRows) -> Tensor:
        """See :class:`DeviceSet`."""
        found = data.y.new_zeros(*data.y.shape, self.size)
        found[self.rows, : self.slopes.shape[1]] = self.slopes
        return found

    def settled(self, found: Settled) -> LensAndBoard:
        """See :class:`DeviceSet`."""
        root = self.camera.root @ torch.linalg.cholesky(found.covariance)
        change = self.camera.root @ found.shifts
        lens, board = (self._at_tool(change, part) for part in PARTS)
        lens_std, board_std = (self._at_tool(root, part) for part in PARTS)
        known = {"lens": lens, "board": board, "lens_std": lens_std, "board_std": board_std}
        camera = replace(self.camera, unknowns=self.camera.unknowns + change, root=root)
        return replace(self, camera=camera, explained=replace(self.explained, **known))

    def with_rows(self, other: OtherRows) -> LensAndBoard:
        """See :class:`DeviceSet`."""
        if other.coordinates is None:
            raise MeasurementError.of("rows of a camera", expected="images", got="none")
        ((camera, slopes, _),) = other.coordinates.table.shared_errors()
        return replace(self, camera=camera, slopes=slopes, rows=other.coordinates.rows)

    def _at_tool(self, errors: Tensor, part: slice) -> float:
        """RMS distance, m, of points by some of the lens' and board's errors (14,) or (14, c), summed in squares."""
        own = torch.zeros_like(errors)
        own[part] = errors[part]
        moved = self.apart @ torch.linalg.pinv(self.camera.root) @ own
        return _rms_distance(moved.view(len(self.rows), self.slopes.shape[1], -1).norm(dim=2))

    def placed(self) -> PlacedDevices:
        """See :class:`DeviceSet`."""
        whole = torch.zeros_like(self.rows)
        own = self._board_camera.numbers[None], self.camera.deviations[None]
        return PlacedDevices(CAMERA, (CAMERA,), *own, self.rows, whole)

    @property
    def _board_camera(self) -> BoardCamera:
        return BoardCamera(self.camera, self.on_tool, self.explained)

    def sentences(self) -> list[str]:
        """See :class:`DeviceSet`."""
        return list(self._board_camera.sentences())

    def entry(self) -> dict[str, object]:
        """See :class:`DeviceSet`."""
        return {"camera": self.camera.entry() | {"explained_m": vars(self.explained) | {"arm": self.explained.arm}}}


def relative_size(data: Measurements, registration: Identification) -> float:
    """How much longer the distances of a board from its camera are than a robot as described says, as a share.

    Errors of base, markers and scale that explain the residuals of the registration, by reweighted least squares.
    """
    geometry = registration.geometry
    slopes = torch.cat([_places(data, registration).flatten(1, 2), data.by_board_size()], 2)
    errors, weights = (data.points - geometry.points(data.q)).flatten(1), torch.ones_like(slopes[:, :1, :1])
    found = slopes.new_zeros(slopes.shape[2])
    for _ in range(ROUNDS):
        matrix, target = (weights * slopes).flatten(0, 1), (weights[..., 0] * errors).flatten()
        found = torch.linalg.lstsq(matrix, target[:, None], driver="gelsd").solution[:, 0]
        size = (errors - slopes @ found).norm(dim=1)
        weights = (1 / (1 + (size / (3 * size.median().clamp(min=1e-9))) ** 2).sqrt())[:, None, None]
    return float(found[-1])


def _places(data: Measurements, registration: Identification) -> Tensor:
    """Derivatives (M, P, 3, 6 + 3 P) of points by the places of the base and of what is on the tool."""
    geometry = registration.geometry
    slopes = geometry.sensitivities(data.q)
    return torch.cat([slopes[..., geometry.slices[name]] for name in ("base", "tool")], 3)


def _rms_distance(coordinates: Tensor) -> float:
    """RMS distance of points by RMS errors (M, 9) of their coordinates, m."""
    return float((3 * coordinates.square().mean()).sqrt())
