"""The errors that a calibrated model expects over the joint ranges of its rows, and what they consist of.

Without a measuring device rigid motions that remain in the fields say nothing about the robot, and are taken out of all
covariances (regression/rigid_motions.py). A device that measured other rows holds the frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.robots.placement import rigid_fit

WORKSPACE_ROWS = 100
"""Random configurations in the joint ranges of the rows, over which rigid motions are left out."""


def workspace_deviation(fitted: FittedMap) -> float:
    """Root mean square distance, m, between modelled and true positions that the model expects over its workspace.

    Of the last marker, the ball.
    """
    covariance = fitted.posterior(workspace_of(fitted), noise=False)[1]
    return float(covariance.diagonal(dim1=1, dim2=2)[:, -3:].sum(1).mean().sqrt())


def fitted_map_of(model: CalibratedKinematics) -> FittedMap:
    """The map of a model's fit, without a registration."""
    return model.map.fitted


def stands_free(model: CalibratedKinematics) -> bool:
    """Whether no device measured positions in the fit of a model: its frame is the robot's base."""
    return fitted_map_of(model).workspace is not None


def expected_of(model: CalibratedKinematics) -> float:
    """See :func:`workspace_deviation`."""
    return workspace_deviation(fitted_map_of(model))


def without_rigid_motions(fitted: FittedMap) -> FittedMap:
    """The same map whose covariances leave out rigid motions over the joint ranges of its rows."""
    parts = fitted.noise, fitted.data, fitted.new_noise, workspace_of(fitted)
    return FittedMap(fitted.deformation, *parts, slopes=fitted.slopes, y=fitted.y)


def workspace_of(fitted: FittedMap) -> Tensor:
    """Random configurations (M, n) in the joint ranges of the rows; those that the map keeps if there are any."""
    if fitted.workspace is not None:
        return fitted.workspace
    low, high = fitted.x.amin(0), fitted.x.amax(0)
    shape = WORKSPACE_ROWS, len(low)
    draws = torch.rand(shape, dtype=torch.float64, generator=seeded(0), device=HOST).to(low)
    return low + (high - low) * draws


@dataclass(frozen=True)
class ExpectedError:
    """What a model expects of its own errors.

    Args:
        workspace: root mean square distance, m, between its positions of the last marker and the true ones over the
            joint ranges of the rows; without a measuring device after the best rigid motion.
        size: standard deviation of the robot's size, relative. size_share: its part of ``workspace``, from 0 to 1.
    """

    workspace: float
    size: float
    size_share: float

    @classmethod
    def of(cls, fitted: FittedMap) -> ExpectedError:
        """That of a fitted map."""
        points, at = fitted.geodesic.linearised_value(workspace_of(fitted))
        own = torch.eye(fitted.m, dtype=points.dtype, device=points.device)[-3:].expand(len(points), -1, -1)
        away = points[:, -3:] - points[:, -3:].mean(0)
        covariance = fitted.covariance_between(at.projected(own))
        weight = (away / away.square().sum()).flatten()
        deviation = float((weight @ covariance @ weight).clamp(min=0).sqrt())
        spread, expected = float(away.square().sum(1).mean().sqrt()), workspace_deviation(fitted)
        return cls(expected, deviation, min(deviation * spread / max(expected, 1e-12), 1.0))

    def entry(self) -> dict[str, object]:
        """For programs."""
        return {"expected_error_m": self.workspace, "size_deviation": self.size}


def expected_errors(model: CalibratedKinematics, stages: Mapping[str, Callable[[Tensor], Tensor]]) -> dict[str, float]:
    """Root mean square distances, m, of the ball from its true places over the joint ranges of the rows, by stage.

    sqrt(d^2 + s^2) with d the distance between the places of a stage and those of the model, and s the one that the
    model expects of its own; without a measuring device after the best rigid motion.

    Args:
        model: of rows in sockets or of readings.
        stages: name -> kinematics, (N, n) -> (N, P, 3) in m, the ball last.
    """
    fitted, own = model.map, workspace_deviation(model.map)
    q = workspace_of(fitted)
    places = model(q).detach()[:, -1]

    def expected(points: Tensor) -> float:
        if fitted.workspace is not None:
            T = rigid_fit(points, places)
            points = points @ T[:3, :3].mT + T[:3, 3]
        return float(((points - places).square().sum(1).mean() + own**2).sqrt())

    return {name: expected(kinematics(q).detach()[:, -1]) for name, kinematics in stages.items()}
