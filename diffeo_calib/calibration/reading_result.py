"""Result of a calibration by readings that are not positions: the model, its devices, and what is not determined."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from diffeo_calib.calibration.identification.reading_registration import ReadingIdentification
from diffeo_calib.calibration.scales.leave_one_out import LeaveOneOut
from diffeo_calib.calibration.scales.selection import Selection
from diffeo_calib.calibration.sockets import workspace_deviation
from diffeo_calib.common.errors import InputError
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.fitting.result import Fit
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.reading_devices import Devices
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.regression.choose import condition_for_covariances

Stage = tuple[Callable[[Tensor], Tensor], Devices]
"""Kinematics, (N, n) -> (N, 1, 3) in m, and the devices beside them."""
FLATTERY = (
    "errors of readings flatter: what no reading shows, such as the robot's size with devices that hold no length, is "
    "not in them; choose nothing by them"
)


@dataclass(frozen=True, eq=False)
class FoundDevices:
    """The devices after a calibration, in the robot's base.

    Args:
        devices: their places. deviations: (D, k) standard deviations of their increments, m or rad.
        workspace_deviation: root mean square distance, m, that the model expects between its positions and the true
            ones over the joint ranges of the rows, after the best rigid motion: no reading shows it.
        size_deviation: standard deviation of the robot's size, relative.
        size_share: its part of ``workspace_deviation``, from 0 to 1.
    """

    devices: Devices
    deviations: Tensor
    workspace_deviation: float
    size_deviation: float
    size_share: float

    def sentences(self) -> list[str]:
        """Places of the devices, and the absolute error to expect."""
        lines = [self.devices.sentence(number, own) for number, own in enumerate(self.deviations)]
        expected = f"over the joint ranges of the rows, after a rigid fit: {1e3 * self.workspace_deviation:.3f} mm RMS"
        size = f"the robot's size is known to {100 * self.size_deviation:.3f} %"
        return [*lines, f"expected absolute error {expected}; {size}", FLATTERY]

    def entry(self) -> dict[str, object]:
        """The same for programs, in m and rad."""
        constants = dict(zip(self.devices.names, self.devices.constants.tolist(), strict=True))
        deviations = dict(zip(self.devices.names, self.deviations.tolist(), strict=True))
        places = {"constants": constants, "deviations": deviations}
        return {**places, "expected_error_m": self.workspace_deviation, "size_deviation": self.size_deviation}


@dataclass(frozen=True, eq=False)
class ReadingsResult:
    """A calibration by readings.

    Args:
        model: the calibrated kinematics of the ball, in the robot's base.
        found: where the devices are, in the robot's base, and what is not determined.
        identification: registration and geometric calibration.
        selection: the scales of kernels, priors and noise. leave_one_out: errors of readings predicted from all others.
        fit: the exact model's fit with its certificates.
        outliers: row numbers whose weight is below one half.
    """

    model: CalibratedKinematics
    found: FoundDevices
    identification: ReadingIdentification
    selection: Selection
    leave_one_out: LeaveOneOut
    fit: Fit
    outliers: list[int]

    @property
    def stages(self) -> dict[str, Stage]:
        """Name of each stage -> its kinematics and devices."""
        known = self.identification
        geometry, theta = known.geometry, known.theta
        return {
            "nominal + registration": (geometry.points, known.registered),
            "geometry": (lambda q: geometry.points(q, theta), known.devices),
            "diffeomorphic": (self.model, self.found.devices),
        }

    def errors(self, data: Readings, stage: str = "diffeomorphic") -> Tensor:
        """Measured minus predicted readings (N, r), m, of devices of this calibration.

        Those of images are in m at the mean distance of the ball from the camera.

        Raises:
            MeasurementError: readings of another kind or of other devices.
        """
        if stage not in self.stages:
            raise InputError.of("`stage`", expected=", ".join(self.stages), got=stage)
        kinematics, devices = self.stages[stage]
        return devices.errors(data, kinematics(data.q).detach()[:, 0])

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C cut the work short; the model is then the best state so far."""
        return self.fit.solution.interrupted or self.selection.interrupted

    @property
    def status(self) -> str:
        """How the calibration ended, in one sentence."""
        return f"{self.fit.status}; scales: {self.selection.status}"

    def __repr__(self) -> str:
        return f"ReadingsResult({self.model!r}: {self.status})"


def found_devices(fitted: Fit, fitted_map: FittedMap, devices: Devices) -> FoundDevices:
    """The devices with what the fit says about them: shifts Z^T R^-1 (y - h(k1)), their posterior mean.

    Args:
        fitted: the fit. fitted_map: its map, without rigid motions. devices: where they were before.
    """
    problem, noise = fitted.problem, fitted.problem.noise
    shifts = torch.einsum("nmc,nm->c", noise.shared, noise.solve(problem.y - problem.values(fitted.model.geodesic)))
    at = fitted_map.geodesic.linearise(fitted_map.x)
    at = at if fitted_map.slopes is None else at.projected(fitted_map.slopes)
    alone = condition_for_covariances(at, noise.own)  # as for sockets: so wide is their prior
    known = torch.einsum("nmc,nmk->ck", noise.shared, alone.solve(noise.shared))
    known = known + torch.eye(len(known), dtype=known.dtype, device=known.device)
    own = torch.linalg.inv(known).diagonal().clamp(min=0).sqrt().view(len(devices.names), -1)
    moved = devices.moved(shifts.view(own.shape) * devices.deviations)
    return FoundDevices(moved, own * devices.deviations, *_size(fitted_map))


def _size(fitted: FittedMap) -> tuple[float, float, float]:
    """Expected error over the workspace [m], deviation of the robot's size, and its share of the expected error."""
    expected = workspace_deviation(fitted)
    if fitted.workspace is None:
        raise InputError.of("the map has no workspace", fix="calibrate with readings")
    points, at = fitted.geodesic.linearised_value(fitted.workspace)
    away = points - points.mean(0)
    covariance = fitted.covariance_between(at)
    weight = (away / away.square().sum()).flatten()
    deviation = float((weight @ covariance @ weight).clamp(min=0).sqrt())
    spread = float(away.square().sum(1).mean().sqrt())
    return expected, deviation, min(deviation * spread / max(expected, 1e-12), 1.0)
