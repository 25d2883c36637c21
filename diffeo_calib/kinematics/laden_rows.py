"""Calibrated models at measurements whose rows carry different payloads."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy

import torch
from torch import Tensor

from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.payload import check_masses, check_payloads, with_mass, with_masses
from diffeo_calib.measurements.pose_frames import frames_of_points, of_frames
from diffeo_calib.measurements.poses import LEVER
from diffeo_calib.measurements.table import Measurements

Kinematics = Callable[[Tensor], Tensor]


class LadenRows:
    """A model at the N configurations of some measurements, each with its own payload.

    Args:
        model: the calibrated model. masses: (N,) in the unit of its fit.
    """

    def __init__(self, model: CalibratedKinematics, masses: Tensor) -> None:
        check_masses(model.nominal, masses)
        self.model, self.masses = model, masses.cpu()

    def __call__(self, q: Tensor) -> Tensor:
        """Marker positions (N, n) -> (N, P, 3), m."""
        laden = with_masses(self.model.map, self.masses)
        return laden.deformation(self.model.robot.joint_values(q)).unflatten(1, (-1, 3))

    def poses(self, q: Tensor) -> Tensor:
        """See :meth:`CalibratedKinematics.poses`."""
        return of_frames(frames_of_points(self(q), self.model.lever or LEVER))

    def predict(self, q: Tensor, *, noise: bool = True) -> tuple[Tensor, Tensor]:
        """See :meth:`CalibratedKinematics.predict`."""
        mean, covariance = self._each(q, lambda model, some: model.predict(some, noise=noise))
        return mean, covariance

    def predict_poses(self, q: Tensor, *, noise: bool = True) -> tuple[Tensor, Tensor]:
        """See :meth:`CalibratedKinematics.predict_poses`."""
        mean, covariance = self._each(q, lambda model, some: model.predict_poses(some, noise=noise))
        return mean, covariance

    def _each(self, q: Tensor, of: Callable[[CalibratedKinematics, Tensor], tuple[Tensor, ...]]) -> list[Tensor]:
        """Values of all rows, computed for the rows of one payload at a time."""
        self.model.predict(q[:1])  # what covariances need is computed once, and taken over by the copies of the model
        groups = [(self.masses == mass).nonzero()[:, 0] for mass in self.masses.unique()]
        found = [of(self._under(float(self.masses[rows[0]])), q[rows]) for rows in groups]
        order = torch.cat(groups).argsort().to(q.device)
        return [torch.cat(parts)[order] for parts in zip(*found, strict=True)]

    def _under(self, mass: float) -> CalibratedKinematics:
        model = copy(self.model)
        model.map = with_mass(model.map, mass)
        return model


def laden(model: CalibratedKinematics, data: Measurements) -> CalibratedKinematics | LadenRows:
    """A model under the payloads of measurements; the model itself if it knows no payload.

    Raises:
        MeasurementError: payloads on one side only.
    """
    check_payloads(model.payload, data)
    if data.payload is None:
        return model
    return LadenRows(model, data.payload)


def of_one_payload(model: CalibratedKinematics, data: Measurements) -> tuple[CalibratedKinematics, Measurements]:
    """The rows that carry the most frequent payload, and the model under it; both unchanged without payloads."""
    check_payloads(model.payload, data)
    if data.payload is None:
        return model, data
    usual = data.payload.mode().values
    return model.with_payload(float(usual)), data.rows(data.payload == usual)


def at_payloads(kinematics: Kinematics, data: Measurements) -> Kinematics:
    """The same for any kinematics: those that are no calibrated models know no payload and stay."""
    return laden(kinematics, data) if isinstance(kinematics, CalibratedKinematics) else kinematics
