"""Calibration by distances to fixed points, heights above planes or images, whose devices are in unknown places.

Nothing says where the robot stands: its base is the measuring frame, base and error twist of the first joint are held,
and rigid motions are left out of all covariances, as with sockets. What is not known of a device is an error that all
its rows share. Touched planes and images hold no length: the robot's size is then that of its description.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics.reading_plausibility import (
    check_readings,
    check_zero,
    warn_of_size,
    warn_of_what_is_open,
)
from diffeo_calib.calibration.identification.identification import Prior
from diffeo_calib.calibration.identification.reading_registration import (
    ReadingIdentification,
    held_parameters,
    identify_readings,
    with_unknown_zero,
)
from diffeo_calib.calibration.reading_result import ReadingsResult, found_devices
from diffeo_calib.calibration.robot_problem import RESIDUAL_TOLERANCE, robot_problem
from diffeo_calib.calibration.scales.cross_validation import cross_validated_inflation
from diffeo_calib.calibration.scales.defaults import defaults
from diffeo_calib.calibration.scales.hyperparameters import Hyperparameters
from diffeo_calib.calibration.scales.leave_one_out import estimate_tails, leave_one_out
from diffeo_calib.calibration.scales.noise_model import NoiseModel
from diffeo_calib.calibration.scales.selection import Selection, select
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.calibration.sockets import without_rigid_motions
from diffeo_calib.fitting.fit import fit
from diffeo_calib.fitting.gauss_newton import GaussNewton
from diffeo_calib.fitting.result import Progress, silent
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.kinematics.provenance import Provenance
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.robots.tree import Tree

LOG = logging.getLogger(__name__)


def calibrate_readings(
    robot: Tree,
    readings: Readings,
    *,
    hyperparameters: Hyperparameters | None = None,
    seed: int = 0,
    progress: Progress = silent,
    note: str = "",
) -> ReadingsResult:
    """:func:`diffeo_calib.calibrate` for readings; the arguments are checked there.

    Raises:
        InputError: arguments of another kind.
        MeasurementError: too few rows, another number of joints, readings that do not belong to the robot.

    Warns:
        DiffeoCalibWarning: directions, joints or places of the ball that no reading shows; readings without length.
    """
    check_readings(robot, readings)
    progress("geometry", 0, 1)
    LOG.info("calibrating %s with %r", robot.name, readings)
    found = identify_readings(robot, readings)
    LOG.info("registration RMS %.4f mm, geometry %.4f mm", 1e3 * found.registered_rms, 1e3 * found.rms)
    _check_zero(readings, found)
    data = _tangent_data(readings, found)
    shown = dict(zip(robot.joint_names, _shown(data).tolist(), strict=True))
    warn_of_what_is_open(readings, found.devices, shown, _tilt(readings, data, found))
    if hyperparameters is None:
        data, selection = _with_scales(data, readings, found, seed, progress)
    else:
        selection = Selection(hyperparameters, "given")
        data = data.with_tails(estimate_tails(data, hyperparameters, seed))
    problem = robot_problem(data, selection.scales)
    start = replace(problem.zero(), theta=data.theta)
    fitted = fit(problem, GaussNewton(tolerance=RESIDUAL_TOLERANCE), start=start, progress=progress)
    fitted_map = without_rigid_motions(fitted.model)
    devices = found_devices(fitted, fitted_map, found.devices)
    warn_of_size(readings, devices.size_deviation, devices.size_share, devices.workspace_deviation)
    rigid_errors, provenance = found.geometry.absorb(found.theta).joint_errors, Provenance.now(readings, note)
    return ReadingsResult(
        model=CalibratedKinematics(robot, fitted_map, rigid_errors=rigid_errors, provenance=provenance),
        found=devices,
        identification=found,
        selection=selection,
        leave_one_out=leave_one_out(data, selection.scales, seed),
        fit=fitted,
        outliers=(data.tails.weights[:, 0] < 0.5).nonzero()[:, 0].tolist(),
    )


def _check_zero(readings: Readings, found: ReadingIdentification) -> None:
    if readings.kind == "distance" and not readings.offset_std:
        free = with_unknown_zero(readings, found)
        offsets = dict(zip(readings.names, free.devices.constants[:, 3].tolist(), strict=True))
        check_zero(found.noise, free.noise, offsets)


def _tangent_data(readings: Readings, found: ReadingIdentification) -> TangentData:
    """The readings around the geometric calibration."""
    nominal, devices = GeometryMap(found.geometry, elastic=True), found.devices
    theta = torch.cat([found.theta, found.theta.new_zeros(nominal.parameters - found.geometry.size)])
    points, numbers = nominal(readings.q, theta), devices.numbers(readings)
    return TangentData(
        nominal,
        theta,
        readings.q,
        devices.values(readings),
        NoiseModel(1, readings.values.shape[1], points=NoiseModel(1)),
        found.tails,
        shared=devices.shared(points, numbers),
        held=held_parameters(found.geometry),
        observe=devices.observation(numbers),
    )


def _with_scales(
    data: TangentData, readings: Readings, found: ReadingIdentification, seed: int, progress: Progress
) -> tuple[TangentData, Selection]:
    """Scales by marginal likelihood, weights of the rows, and deviations inflated where few rows determine them."""
    centre = defaults(data, found.noise, Prior())
    selection = select(centre, data, seed=seed, progress=progress)
    for _ in range(0 if selection.interrupted else 1):
        data = data.with_tails(estimate_tails(data, selection.scales, seed))
        selection = select(centre, data, start=selection.scales, seed=seed, progress=progress)
    scales = selection.scales.supported(data.jacobian, data.new_noise(selection.scales))
    data = data.with_tails(estimate_tails(data, scales, seed))
    groups = readings.groups()
    factor = None
    if not selection.interrupted:
        factor = cross_validated_inflation(centre, scales, data, groups, seed=seed, progress=progress)
    factor = factor or leave_one_out(data, scales, seed).inflation(int(groups.max()) + 1)
    return data, replace(selection, scales=scales.inflated(factor**0.5))


def _shown(data: TangentData) -> Tensor:
    """(n,) motion of the readings with each joint, relative to that of a coordinate of the ball."""
    whole = data.nominal.jacobian(data.x, data.theta)
    shown = data.jacobian.square().mean((0, 1)).sqrt()
    return shown / whole.square().mean((0, 1)).sqrt().clamp(min=1e-9)


def _tilt(readings: Readings, data: TangentData, found: ReadingIdentification) -> Tensor:
    """(3,) motions of the readings per unit of the ball's offset, without what moved devices would do as well."""
    tool = found.geometry.slices["tool"]
    by_ball = data.sensitivities[..., tool].flatten(0, 1)
    shared = found.devices.shared(data.points, found.devices.numbers(readings)).flatten(0, 1)
    shared = shared / shared.norm(dim=0).clamp(min=1e-12)
    known = torch.linalg.lstsq(shared, by_ball, rcond=1e-6, driver="gelsd").solution
    return torch.linalg.svdvals(by_ball - shared @ known) / len(by_ball) ** 0.5
