"""Rows that were computed by the nominal robot's controller or a program, not measured.

If nothing but the digits of a table separates its rows from the nominal robot, they say nothing about its errors: a
device would see some tenths of a millimetre of these.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics.campaign import quantum
from diffeo_calib.calibration.identification.identification import Identification
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.errors import MeasurementError, sentence, warn_user
from diffeo_calib.measurements.pose_frames import POINTS
from diffeo_calib.robots.tree import Tree


@dataclass(frozen=True)
class NominalLimits:
    """When rows are the nominal robot's own.

    Args:
        share: residual after registration, in the extent of the measured values, that no device and no robot leaves.
        digits: residual, in what the digits of joints and values explain, up to which there is nothing else.
        coarsest_m: coarsest digit of values that is looked at.
        doubted_share: residual, in that extent, from which errors of a robot show.
        doubted: residual of the registration, in that of the geometric calibration, up to which errors of links explain
            nothing.
        overdetermined: measured coordinates per unknown from which residuals tell something.
        fewest_joints: of robots whose errors base and marker cannot absorb.
    """

    share: float = 1e-6
    digits: float = 1.15
    coarsest_m: float = 2e-4
    doubted_share: float = 1e-4
    doubted: float = 1.15
    overdetermined: float = 3.0
    fewest_joints: int = 3


LIMITS = NominalLimits()
WHAT = "these rows are those of the nominal robot, as its controller or a simulation computes them"
FIX = (
    "use what a device measured, not the position that the controller displays; to try the package without one, "
    "simulate a robot with errors (`diffeo-calib demo`)"
)


def check_not_nominal(robot: Tree, data: TangentData, registration: Identification, found: Identification) -> None:
    """Refuse rows that the nominal robot explains to their last digit; warn of those that show no errors of links.

    Args:
        robot: n joints. data: the rows around the geometric calibration.
        registration: base and markers, or ball and devices. found: the geometric calibration.
    """
    points = data.nominal(data.x, torch.zeros_like(data.theta))
    predicted = points if data.observe is None else data.observe.value(points)
    errors = (data.y - predicted).masked_fill(~data.visible, torch.nan)
    rms = float(errors.square().nanmean().sqrt())
    size = float((data.y - data.y.mean(0)).abs().amax())  # the reach of a robot with slides may have no bound
    spare = int(data.visible.sum()) > LIMITS.overdetermined * _placed_numbers(data)
    if spare and (rms < LIMITS.share * size or _by_digits(robot, data, errors)):
        expected = "errors of some 0.1 mm, which every robot has"
        raise MeasurementError.of(WHAT, expected=expected, got=f"{1e3 * rms:.2g} mm RMS", fix=FIX)
    shown = registration.noise > min(LIMITS.doubted * found.noise, LIMITS.doubted_share * size)
    if (
        not shown
        and robot.n >= LIMITS.fewest_joints
        and data.coordinates > LIMITS.overdetermined * data.nominal.geometry.size
    ):
        what = f"these rows show no errors of the robot: its description explains them to {1e3 * rms:.2g} mm RMS, and "
        what += "errors of its links explain no more"
        warn_user(sentence(what, fix=f"if they were computed, {FIX}"))


def _placed_numbers(data: TangentData) -> int:
    """Numbers of base, markers and devices."""
    slices = data.nominal.geometry.slices
    devices = 0 if data.shared is None else data.shared.shape[2]
    return sum(slices[name].stop - slices[name].start for name in ("base", "tool")) + devices


def _by_digits(robot: Tree, data: TangentData, errors: Tensor) -> bool:
    """Whether the digits of joints and values explain errors (N, R)."""
    slopes = data.jacobian
    for width in (1, POINTS):  # single points, or the middles of three that stand for a pose
        if errors.shape[1] % (3 * width) and width > 1:
            continue
        values, own, by_joints = (_middles(v, width) for v in (data.y, errors, slopes))
        found = [
            None if bool(seen.isnan().any()) else quantum(column, turning=False)
            for column, seen in zip(values.unbind(1), own.unbind(1), strict=True)
        ]
        steps = [step[0] for step in found if step is not None and step[0] <= LIMITS.coarsest_m]
        if len(steps) < len(found):
            continue
        joints = [quantum(data.x[:, k], turning=robot.periodic[k]) for k in range(robot.n)]
        variances = data.x.new_tensor([0.0 if step is None else step[0] ** 2 / 12 for step in joints])
        explained = data.x.new_tensor(steps).square().mean() / 12 + (by_joints.square() @ variances).mean()
        return bool(own.square().mean() < LIMITS.digits**2 * explained)
    return False


def _middles(values: Tensor, width: int) -> Tensor:
    """Means of ``width`` points that follow one another: (N, 3 width k, ...) -> (N, 3 k, ...)."""
    return values if width == 1 else values.unflatten(1, (-1, width, 3)).mean(2).flatten(1, 2)
