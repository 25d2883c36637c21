"""Lens and board of images: errors that all of them share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.identification.identification import Identification
from diffeo_calib.calibration.placing.placement import DeviceSet, SeenRows, Settled
from diffeo_calib.cameras.images import Camera
from diffeo_calib.common.errors import MeasurementError, sentence, warn_user
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.sensors.placed import PlacedDevices

CAMERA = "camera"
SIZE_WARNED, SIZE_REFUSED = 0.006, 0.02
"""Shares by which lengths of a board may differ from the robot's. Simulated arms with errors of a mm: below 0.004."""
ROUNDS = 5


@dataclass(frozen=True, eq=False)
class LensAndBoard(DeviceSet):
    """Lens and board of a camera.

    Args:
        camera: as images alone show them. slopes: (M, 9, c) effects of its errors on the points of each pose, m.
        rows: (M,) their rows of a calibration.
    """

    camera: Camera
    slopes: Tensor
    rows: Tensor

    @classmethod
    def of_table(cls, data: Measurements, rows: Tensor, registration: Identification) -> list[Any]:
        """That of the images of a table, none for other tables; rows: (M,) numbers in the whole table.

        Raises:
            MeasurementError: a board of another size than was said.
        """
        found = [cls(camera, slopes, rows) for camera, slopes in data.shared_errors()]
        for camera in found:
            camera.check_size(data, registration)
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
        unknowns = self.camera.unknowns + self.camera.root @ found.shifts
        return replace(self, camera=replace(self.camera, unknowns=unknowns, root=root))

    def placed(self) -> PlacedDevices:
        """See :class:`DeviceSet`."""
        whole = torch.zeros_like(self.rows)
        own = self.camera.unknowns[None], self.camera.deviations[None]
        return PlacedDevices(CAMERA, (CAMERA,), *own, self.rows, whole)

    def sentences(self) -> list[str]:
        """See :class:`DeviceSet`."""
        return list(self.camera.sentences())

    def entry(self) -> dict[str, object]:
        """See :class:`DeviceSet`."""
        return {"camera": self.camera.entry()}


def relative_size(data: Measurements, registration: Identification) -> float:
    """How much longer the distances of a board from its camera are than a robot as described says, as a share.

    Errors of base, markers and scale that explain the residuals of the registration, by reweighted least squares.
    """
    geometry = registration.geometry
    parts = [geometry.slices[name] for name in ("base", "tool")]
    by_place = geometry.sensitivities(data.q).flatten(1, 2)
    slopes = torch.cat([*(by_place[..., part] for part in parts), data.by_board_size()], 2)
    errors, weights = (data.points - geometry.points(data.q)).flatten(1), torch.ones_like(slopes[:, :1, :1])
    found = slopes.new_zeros(slopes.shape[2])
    for _ in range(ROUNDS):
        matrix, target = (weights * slopes).flatten(0, 1), (weights[..., 0] * errors).flatten()
        found = torch.linalg.lstsq(matrix, target[:, None], driver="gelsd").solution[:, 0]
        size = (errors - slopes @ found).norm(dim=1)
        weights = (1 / (1 + (size / (3 * size.median().clamp(min=1e-9))) ** 2).sqrt())[:, None, None]
    return float(found[-1])
