"""Predicted readings of devices in known places, with their covariances.

A reading at q is h(z(q), d), z the ball and d what is known of the device, both found from the same rows. Their errors
belong together: whatever no row tells apart, such as the place of the whole scene, moves both and no reading. With
slopes A by the points and B by the unknowns u of the device,

    cov = A C A^T + A X B^T + B X^T A^T + B U B^T + noise,    X = cov(z, u), U = cov(u),

from the posterior of the fit. Devices that measured no row of the fit were placed around the model: X = 0.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.fitting.fitted_map import PREDICT_ROWS, FittedMap
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.measurements.poses import block_diagonal
from diffeo_calib.sensors.devices import Devices, Extrinsics
from diffeo_calib.sensors.set_ups import MountedMarkers, seen_mounted

MOTION_SHARE = 0.01
"""Effects of a shift of a fit that differ from a motion by less than this share are those of the motion."""


@dataclass(frozen=True, eq=False)
class PredictedReadings:
    """Predicted readings of one device at N configurations.

    Args:
        kind: of its readings; "position" of markers that were mounted anew. device: its name, or that of the session.
        unit: of the readings.
        mean: (N, r) readings; NaN where the device cannot see its target. covariance: (N, r, r) of these.
    """

    kind: str
    device: str
    unit: str
    mean: Tensor
    covariance: Tensor

    @property
    def deviations(self) -> Tensor:
        """(N, r) standard deviations."""
        return self.covariance.diagonal(dim1=1, dim2=2).clamp(min=0).sqrt()


def own_shifts(shared: Tensor, slopes: Tensor) -> tuple[Tensor, Tensor]:
    """Shifts of a fit that are motions of one device: which (c,) of them, boolean, and these motions (k, k').

    Args:
        shared: (M, r, c) effects of all shifts on its rows. slopes: (M, r, k) of these rows by motions of the device.
    """
    columns, slopes = (shared != 0).any(1).any(0), slopes.flatten(0, 1)
    effects = shared[..., columns].flatten(0, 1)
    motions = torch.linalg.pinv(slopes) @ effects
    rigid = (effects - slopes @ motions).norm(dim=0) < MOTION_SHARE * effects.norm(dim=0)
    columns[columns.clone()] = rigid
    return columns, motions[:, rigid]


class FittedDevice(NamedTuple):
    """A device of readings beside a fit, where the model has it."""

    devices: Devices  # it alone, with the standard deviations of its k unknowns after the rows on which it was placed
    # (k, k') what each of these does to its unknowns; without them the root of their covariance by the rows on which it
    # was placed
    root: Tensor
    # (c,) boolean, the shifts of the fit that move it; None for a device that measured no row of the fit, or of a model
    # that was moved since
    columns: Tensor | None = None
    noise: Tensor | None = None  # (r, r) of a reading by its rows of the fit, m^2; None without any

    @classmethod
    def of(cls, fitted: FittedMap, group: Extrinsics, number: int) -> FittedDevice:
        """A device of a set of those of readings."""
        devices: Any = group.only(group.names[number : number + 1])
        deviations = devices.deviations[0]
        placed, rows = cls(devices, torch.diag(deviations)), devices.rows
        if not len(rows):
            return placed
        numbers, shared = fitted.noise.visible[rows][0], fitted.noise.shared[rows]
        placed = placed._replace(noise=fitted.noise.covariance[rows][:, numbers][:, :, numbers].median(0).values)
        slopes = placed.by_increments(fitted.fitted_points[rows, -3 * devices.seen_points :])
        columns, root = own_shifts(shared[:, numbers], slopes)
        moves = fitted.registration is None and bool(columns.any())
        return placed._replace(columns=columns, root=root) if moves else placed

    def by_increments(self, points: Tensor) -> Tensor:
        """(N, r, k) derivatives of readings of points (N, 3 P'), which it sees, by its unknowns, m."""
        return self.devices.by_increments(points, torch.zeros(len(points), dtype=torch.int64, device=HOST))

    def readings(self, fitted: FittedMap, rows: tuple[Tensor, Linearisation], *, noise: bool) -> tuple[Tensor, Tensor]:
        """Mean (N, r) and covariance (N, r, r) of its readings, m, of points and their linearisation."""
        whole, at = rows
        points = whole[:, -3 * self.devices.seen_points :]
        observation = self.devices.observation(torch.zeros(len(points), dtype=torch.int64, device=HOST))
        A = torch.nn.functional.pad(observation.slope(points), (whole.shape[1] - points.shape[1], 0))
        B = self.by_increments(points) @ self.root
        if self.columns is None:
            covariance = fitted.conditional.covariance(at, A) + B @ B.mT
        else:
            covariance = fitted.with_shifts(at.projected(A), B, self.columns)
        of_device = A @ fitted.new_noise @ A.mT if self.noise is None else self.noise
        return observation.value(points).detach(), covariance + (of_device if noise else fitted.short_errors(at, A))


def predicted_readings(model: Any, q: Tensor, *, noise: bool = True) -> list[PredictedReadings]:
    """Predicted readings at q (N, n) of every device that a model knows, see :meth:`predict_readings`."""
    fitted: FittedMap = model.map
    sets = [devices for devices in model.placement if devices.reads and len(q)]
    markers = [devices for devices in model.placement if devices.kind == MountedMarkers.kind]
    readings = [reading for devices in markers for reading in _mounted(model, devices, q, noise=noise)]
    each = (slice(first, first + PREDICT_ROWS) for first in range(0, len(q) if sets else 0, PREDICT_ROWS))
    parts = [fitted.linearised_value(q[some], fitted.geodesic.at_rows(some)) for some in each]
    for devices in sets:
        unit, scale, zero = devices.shown or ("", (1.0,), (0.0,))  # files of old versions: as reported, lengths in m
        for number, name in enumerate(devices.names):
            device = FittedDevice.of(fitted, devices, number)
            means, blocks = zip(*(device.readings(fitted, rows, noise=noise) for rows in parts), strict=True)
            factor = q.new_tensor(scale) / devices.metres[number]
            mean = torch.cat(means) * factor + q.new_tensor(zero)
            covariance = torch.cat(blocks) * factor[:, None] * factor
            readings.append(PredictedReadings(devices.kind, name, unit, mean, covariance))
    return readings


def _mounted(model: Any, devices: Extrinsics, q: Tensor, *, noise: bool) -> Iterator[PredictedReadings]:
    """Positions of the markers as they were mounted in other sessions than that of the model."""
    mean, covariance = model.predict(q, noise=noise)
    shifts, deviations = (each.unflatten(1, (-1, 3)) for each in (devices.constants, devices.deviations))
    P = shifts.shape[1]
    turns = model.turns(q)[:, :P]
    for name, shift, std in zip(devices.names, shifts, deviations, strict=True):
        if bool(shift.any()):
            places = 1e3 * (mean[:, :P] + (turns @ shift[..., None])[..., 0])
            places = places.masked_fill(~seen_mounted(std)[:, None], torch.nan)
            blocks = 1e6 * (covariance[:, :P] + turns @ torch.diag_embed(std.square()) @ turns.mT)
            yield PredictedReadings("position", name, "mm", places.flatten(1), block_diagonal(blocks))
