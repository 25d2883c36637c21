"""Ball, devices and geometric errors from readings, by maximum a posteriori with heavy tails.

The robot's base is the measuring frame: no reading says where it stands. Base and error twist of the first joint are
held, the devices are unknown.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from math import sqrt
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.calibration.identification.identification import LIMITS, Prior
from diffeo_calib.calibration.identification.reading_starts import height_factor, starts
from diffeo_calib.calibration.student_t import Tails, reweight
from diffeo_calib.common.errors import InputError, MeasurementError, as_written
from diffeo_calib.common.threads import torch_alone
from diffeo_calib.kinematics.reading_devices import Devices
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.tree import Tree

ROUGH_M = 2e-3
"""Errors of a robot before its calibration, to compare starts."""
STARTS_STEPS = 200
UNEXPLAINED = "no place of ball and devices explains the readings"
CHECK = "check the unit of the readings (mm or m), the order of the joints, "
CHECK += "and which device each row names; or measure more rows with each device"
UNKNOWN_ZERO_M = 1.0
LARGEST_SHARE = 0.02
"""Median residual, relative to the robot's reach, of readings that belong to it."""
UNIT_RATIO, CORRELATED = 10.0, 0.5
"""Factor between measured and found heights from which a unit is wrong, and their correlation that shows it."""


@dataclass(frozen=True, eq=False)
class ReadingIdentification:
    """Geometry and devices.

    Args:
        geometry: the start, with the ball of the registration as marker. theta: (K,) its errors, m and rad.
        devices: where they are. registered: where they were with errors of joints zero.
        noise: scale of the errors of each of the r numbers of a reading, m. tails: weights of the rows (N, 1).
        registered_rms: RMS residual with errors of joints zero, m. rms: with them.
    """

    geometry: Geometry
    theta: Tensor
    devices: Devices
    registered: Devices
    noise: float
    tails: Tails
    registered_rms: float
    rms: float


def held_parameters(geometry: Geometry) -> tuple[int, ...]:
    """Numbers of the parameters that readings cannot tell apart from where the robot stands."""
    base, joints = geometry.slices["base"], geometry.slices["joints"]
    return (*range(base.start, base.stop), *range(joints.start, joints.start + 6))


def identify_readings(robot: Tree, data: Readings) -> ReadingIdentification:
    """Find ball, devices and geometric errors.

    Raises:
        MeasurementError: readings that no place of ball and devices explains.
    """
    bare = Geometry.nominal(robot, 1)
    poses = bare.marker_poses(data.q)[:, 0]
    R, t = poses[:, :3, :3], poses[:, :3, 3]
    scale = _deviations(bare)
    still = scale.clone()
    still[bare.slices["joints"]] = 0.0
    if data.kind == "height":
        _check_unit(1.0 / max(height_factor(data, R, t), 1.0))
    found = []
    for ball, devices in starts(data, R, t):
        geometry = bare.with_tool(ball[None])
        with suppress(InputError):  # the ball at a fixed point or behind a camera: a bad start, or bad readings
            rough = _solve(geometry, data, devices, still, torch.full_like(t[:, 0], ROUGH_M), robust=True)
            found.append((_of_worst_device(data, rough.errors), rough, geometry))
    if not found:
        raise MeasurementError.of(UNEXPLAINED, fix=CHECK)
    worst, rough, geometry = min(found, key=lambda one: one[0])
    _check_size(robot, data, worst, rough.errors)
    registered = float(rough.errors.square().mean().sqrt())
    return _estimate(geometry.absorb(rough.theta), data, rough.devices, scale, registered)


def with_unknown_zero(data: Readings, found: ReadingIdentification) -> ReadingIdentification:
    """The same for distances whose zero is not known."""
    free = found.registered.deviations.clone()
    free[3] = UNKNOWN_ZERO_M
    devices = replace(found.registered, deviations=free)
    return _estimate(found.geometry, data, devices, _deviations(found.geometry), found.registered_rms)


def _deviations(geometry: Geometry) -> Tensor:
    """Prior deviations (K,) of the errors, zero for those that readings cannot show."""
    prior = Prior().deviations(geometry)
    prior[list(held_parameters(geometry))] = 0.0
    return prior


def _estimate(
    geometry: Geometry, data: Readings, devices: Devices, scale: Tensor, registered: float
) -> ReadingIdentification:
    """Errors, devices, tails and noise level together."""
    level, r = max(registered, LIMITS.smallest_noise_m), data.values.shape[1]
    tails = Tails.none(len(data), 1, device=data.values.device)
    fit = None
    for _ in range(LIMITS.rounds):
        fit = _solve(geometry, data, devices, scale, level / tails.weights[:, 0].sqrt())
        squares, leverage = fit.errors.square().sum(1), fit.leverage.sum(1)
        spare = max(r * len(data) - float(leverage.sum()), 1.0)
        before, level = level, max(sqrt(float((tails.weights[:, 0] * squares).sum()) / spare), LIMITS.smallest_noise_m)
        tails = reweight((squares / level**2)[:, None] + leverage[:, None] / tails.weights, r)
        if abs(level - before) < LIMITS.noise_change * level:
            break
    if fit is None:
        raise MeasurementError.of("`readings`", expected="some rounds of estimation")
    rms = float(fit.errors.square().mean().sqrt())
    return ReadingIdentification(geometry, fit.theta, fit.devices, devices, level, tails, registered, rms)


class _Fit(NamedTuple):
    """theta (K,), the devices, errors of the rows (N, r) in m, leverage (N, r)."""

    theta: Tensor
    devices: Devices
    errors: Tensor
    leverage: Tensor


def _solve(
    geometry: Geometry, data: Readings, devices: Devices, scale: Tensor, sigma: Tensor, *, robust: bool = False
) -> _Fit:
    """Fit theta = scale u and the devices' increments, in units of their deviations, by least squares."""
    from scipy.optimize import least_squares  # noqa: PLC0415  # slow to import, not needed to use a model

    K, count, device = len(scale), len(devices.constants), devices.numbers(data)

    def moved(u: np.ndarray) -> tuple[Tensor, Devices]:
        v = torch.from_numpy(u)
        return scale * v[:K], devices.moved(v[K:].view(count, -1) * devices.deviations)

    def errors(u: np.ndarray) -> Tensor:
        theta, there = moved(u)
        return -there.errors(data, geometry.points(data.q, theta)[:, 0])

    def slopes(u: np.ndarray) -> Tensor:
        theta, there = moved(u)
        points = geometry.points(data.q, theta)[:, 0]
        A = there.observation(device).slope(points)
        by_theta = A @ (geometry.sensitivities(data.q, theta)[:, 0] * scale)
        return (torch.cat([by_theta, there.shared(points, device)], 2) / sigma[:, None, None]).flatten(0, 1)

    def residual(u: np.ndarray) -> np.ndarray:
        return np.concatenate([(errors(u) / sigma[:, None]).flatten().numpy(), u])

    def jacobian(u: np.ndarray) -> np.ndarray:
        return np.concatenate([slopes(u).numpy(), np.eye(len(u))])

    method: Any = {"loss": "soft_l1"} if robust else {"loss": "linear"}
    derivatives: Any = jacobian  # scipy's stubs know its names of difference schemes only
    with torch_alone():
        fit = least_squares(residual, np.zeros(K + devices.freedom), derivatives, max_nfev=STARTS_STEPS, **method)
        white = np.concatenate([slopes(fit.x).numpy(), np.eye(len(fit.x))])
        U = np.linalg.qr(white)[0]
    leverage = torch.from_numpy(np.square(U[: data.values.numel()]).sum(1)).view(data.values.shape)
    theta, there = moved(fit.x)
    return _Fit(theta, there, errors(fit.x), leverage)


def _of_worst_device(data: Readings, errors: Tensor) -> tuple[float, str]:
    """The largest median residual of a device's readings, m, and its name: one wrong plane of three shows in it."""
    sizes = errors.norm(dim=1)
    return max((float(sizes[data.device == number].median()), name) for number, name in enumerate(data.names))


def _check_size(robot: Tree, data: Readings, worst: tuple[float, str], errors: Tensor) -> None:
    """Raise MeasurementError for readings that no place of ball and devices explains.

    Args:
        robot, data: see :func:`identify_readings`.
        worst: median residual, m, of the device where it is largest, and its name.
        errors: predicted minus measured readings (N, r).
    """
    if data.kind == "height":
        _check_unit(_factor(data, errors))
    median, device = worst
    if median > LARGEST_SHARE * robot.reach:
        expected = f"residuals well below {1e3 * LARGEST_SHARE * robot.reach:.0f} mm with the robot's description"
        got = f"a median of {1e3 * median:.3g} mm at {as_written(device)}"
        raise MeasurementError.of(UNEXPLAINED, expected=expected, got=got, fix=CHECK)


def _check_unit(factor: float) -> None:
    """Raise MeasurementError where heights move ``factor`` times as much along the planes' normals as was measured."""
    if not 1 / UNIT_RATIO < factor < UNIT_RATIO:
        times = f"{factor:.3g} times smaller" if factor > 1.0 else f"{1 / factor:.3g} times larger"
        what = f"the heights are about {times} than the robot moves along the planes' normals"
        raise MeasurementError.of(what, fix="check the unit of the heights (mm or m)")


def _factor(data: Readings, errors: Tensor) -> float:
    """By how much the ball's heights change per change of the measured ones; 1 if they hardly change together."""
    measured, predicted = data.values[:, 0], (data.values + errors)[:, 0]
    whose = torch.nn.functional.one_hot(data.device, len(data.names)).to(measured)
    mean = whose / whose.sum(0)
    measured, predicted = (values - whose @ (mean.mT @ values) for values in (measured, predicted))
    together, size = float(measured @ predicted), float(measured.norm() * predicted.norm())
    if together < CORRELATED * size or size == 0.0:
        return 1.0
    return together / float(measured @ measured)
