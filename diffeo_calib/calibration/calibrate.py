"""`calibrate`: from a robot and measurements to calibrated kinematics, everything chosen from the data.

    1 registration   base frame and markers, six plus three per marker unknowns
    2 geometry       an error twist before every joint, with a prior; outliers lose their influence
    3 scales         of kernels, priors and noise, by marginal likelihood; then the weights of outliers, and again
    4 diffeomorphic  phi, psi, geometry and gravity sag together, fitted exactly

Each stage is kept in the result, so that a report can compare them.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any, overload

import torch

from diffeo_calib.calibration.arguments import Controls, check_arguments, check_controls
from diffeo_calib.calibration.choose_scales import ChosenScales, choose_scales
from diffeo_calib.calibration.contradicted_rows import warn_of_contradictions
from diffeo_calib.calibration.diagnostics.campaign import warn_of_open_directions
from diffeo_calib.calibration.diagnostics.likely_mistakes import warn_of_joints_below_tip
from diffeo_calib.calibration.diagnostics.plausibility import (
    check_deviations,
    check_identification,
    check_joints,
    check_limits,
    registered,
    warn_of_outliers,
)
from diffeo_calib.calibration.diagnostics.rounded_joints import warn_of_rounding
from diffeo_calib.calibration.findings import Outlier, Part, outliers, parts
from diffeo_calib.calibration.identification.identification import Identification, identify
from diffeo_calib.calibration.open_directions import with_open_directions
from diffeo_calib.calibration.payload_rows import payload_of_rows
from diffeo_calib.calibration.raised_place import warn_of_flat_places
from diffeo_calib.calibration.reading_result import ReadingsResult
from diffeo_calib.calibration.readings import calibrate_readings
from diffeo_calib.calibration.result import CalibrationResult
from diffeo_calib.calibration.robot_problem import RESIDUAL_TOLERANCE, robot_problem
from diffeo_calib.calibration.scales.hyperparameters import Hyperparameters
from diffeo_calib.calibration.scales.leave_one_out import LeaveOneOut
from diffeo_calib.calibration.scales.noise_model import NoiseModel
from diffeo_calib.calibration.scales.seen_point import with_best_seen_point
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.calibration.sessions import SessionFrames
from diffeo_calib.calibration.socket_places import SocketPlaces, held_parameters, stages_by_sockets
from diffeo_calib.calibration.sockets import FoundSockets, found_sockets, without_rigid_motions
from diffeo_calib.common.checks import check_seed
from diffeo_calib.common.errors import few
from diffeo_calib.common.inference_mode import outside_inference_mode
from diffeo_calib.common.threads import small_work
from diffeo_calib.fitting.fit import fit
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.fitting.gauss_newton import GaussNewton
from diffeo_calib.fitting.result import Fit, Progress, silent
from diffeo_calib.kernels.reductions.backends import Backend
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import evaluate
from diffeo_calib.kinematics.laden_rows import laden
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.kinematics.provenance import Provenance, check_note
from diffeo_calib.kinematics.summary import Summary
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.visibility import check_every_marker_seen
from diffeo_calib.regression.choose import MAX_DENSE
from diffeo_calib.robots.tree import Tree

LOG = logging.getLogger(__name__)
AUTO_CONTROLS = 200
"""Configurations that carry momenta where all of them would need too large a matrix."""
ADVICE = "judge it by held-out errors, and if they are poor, measure more poses or pass fewer `controls`"
"""On a fit that did not converge: solver and time steps, on which the solver advises, are no arguments here."""


@overload
def calibrate(
    robot: Tree,
    measurements: Measurements,
    *,
    hyperparameters: Hyperparameters | None = None,
    controls: Controls = "auto",
    backend: Backend = "auto",
    seed: int = 0,
    progress: Progress = silent,
    note: str = "",
) -> CalibrationResult: ...


@overload
def calibrate(
    robot: Tree,
    measurements: Readings,
    *,
    hyperparameters: Hyperparameters | None = None,
    seed: int = 0,
    progress: Progress = silent,
    note: str = "",
) -> ReadingsResult: ...


@small_work()
@outside_inference_mode
def calibrate(
    robot: Tree,
    measurements: Measurements | Readings,
    *,
    hyperparameters: Hyperparameters | None = None,
    controls: Controls = "auto",
    backend: Backend = "auto",
    seed: int = 0,
    progress: Progress = silent,
    note: str = "",
) -> CalibrationResult | ReadingsResult:
    """Calibrate a robot's kinematics.

    Args:
        robot: nominal chain, n joints.
        measurements: N configurations (rad, m) with P markers each (m; NaN where hidden) or with poses, of one tip or
            several, in the frame of the measuring device; base frame and markers on the tool are estimated. Their
            standard deviations are used if they have any; noise beyond these is estimated. With payloads the sag under
            any payload is found. Or rows with a ball in sockets, by themselves or joined with such rows. Or readings of
            distances, heights or images, whose devices are found with the robot.
        hyperparameters: scales of kernels and noise; chosen by marginal likelihood if not given.
        controls: how many of the configurations carry momenta, or "all"; "auto" is all up to 8000 measured
            coordinates and 200 for more, which takes minutes instead of hours (of 12,000 simulated rows 200 leave 6 %
            more error than 800). With payloads all of them do. Of more rows a random sample chooses geometry and
            scales; all are weighed and fitted.
        backend: evaluates the kernel sums, see :func:`fit`.
        seed: draws the poses on which the scales are selected.
        progress: called as ``progress(task, done, total)``; Ctrl-C keeps the best state so far.
        note: text that is kept with the model, such as a serial number; see :class:`Provenance`.

    Returns:
        a :class:`CalibrationResult`, or of readings a :class:`ReadingsResult`; ``result.model`` is the calibrated
        kinematics.

    Raises:
        MeasurementError: joints that do not match the robot, too few rows, a marker that no row shows, units that
            cannot be right, or measurements that do not belong to these configurations.
        RobotError: joint names in another order than the robot's.

    Warns:
        DiffeoCalibWarning: a joint never moves, or moves far beyond its limits; a joint below the tip, of which the
            table has a column, moves the markers; the poses leave the place of a marker or of the measuring frame open,
            lie in a plane or on a line, or move one joint at a time; sockets lie in a plane and one away from it would
            tell more; joint offsets are far from the robot's
            description; the median residual of a geometric calibration exceeds 2 % of the markers' spread; too few
            poses to select scales; leave-one-out errors contradict the scales; the device, the base or a marker seems
            to have moved during the measurements; wrong rows follow one another; more than 40 % of the rows are
            outliers; the joint values are rounded and this limits the accuracy.
    """
    check_arguments(robot, measurements, hyperparameters)
    check_note(note)
    check_seed(seed)
    check_controls(controls, measurements)
    if isinstance(measurements, Readings):
        given = {"hyperparameters": hyperparameters, "seed": seed, "progress": progress, "note": note}
        return calibrate_readings(robot, measurements, **given)
    check_joints(robot, measurements)
    check_every_marker_seen(measurements)
    # 0 measuring frames
    frames = SessionFrames.of(robot, measurements, progress)
    session, measurements = measurements.session, frames.aligned(measurements) if frames else measurements
    # 1 registration, 2 geometry
    places, measurements, stages = _geometric(robot, measurements, progress)
    # 3 scales
    data = _tangent_data(measurements, *stages)
    shared = [] if frames is None or session is None else [frames.shared(data, session)]
    shared += [] if places is None else [places.shared(measurements)]
    held = held_parameters(data.nominal.geometry) if measurements.without_device else ()
    data = replace(data, shared=torch.cat(shared, dim=2) if shared else None, held=held)
    chosen = choose_scales(data, measurements, *stages, given=hyperparameters, seed=seed, progress=progress)
    LOG.info("scales: %s", chosen.selection.status)
    # 4 diffeomorphic
    fitted = _fit(chosen, controls, backend, progress)
    result = _result(robot, measurements, *stages, chosen=chosen, fitted=fitted, places=places, note=note)
    return result if frames is None else replace(result, sessions=_fitted_frames(frames, result, measurements))


def _geometric(
    robot: Tree, measurements: Measurements, progress: Progress
) -> tuple[SocketPlaces | None, Measurements, tuple[Identification, Identification]]:
    """Registration and geometric calibration, and what they say about the measurements; places of sockets, if any."""
    progress("registration", 0, 1)
    LOG.info("calibrating %s with %r", robot.name, measurements)
    if measurements.sockets is not None:
        places, placed, stages = stages_by_sockets(robot, measurements)
        LOG.info("ball and sockets found, %s", stages[0].status)
        LOG.info("geometry: RMS %.4f mm", 1e3 * stages[1].rms)
        _warn_of_rows(robot, measurements, stages[0])
        return places, placed, stages
    registration = registered(robot, measurements)
    LOG.info("registration: base and markers found, RMS %.4f mm", 1e3 * registration.rms)
    progress("geometry", 0, 1)
    identification = identify(registration.geometry, measurements.q, measurements.points)
    LOG.info("geometry: RMS %.4f mm", 1e3 * identification.rms)
    check_identification(measurements, identification)
    check_deviations(measurements, registration)
    _warn_of_rows(robot, measurements, registration)
    return None, measurements, (registration, identification)


def _warn_of_rows(robot: Tree, measurements: Measurements, registration: Identification) -> None:
    """Warn of joints beyond their limits, of columns that were not used, and of what the poses leave open."""
    check_limits(robot, measurements)
    warn_of_joints_below_tip(robot, measurements)
    warn_of_open_directions(robot, measurements, registration)


def _fitted_frames(frames: SessionFrames, result: CalibrationResult, aligned: Measurements) -> SessionFrames:
    """The measuring frames with the shifts that were fitted: Z^T R^-1 (y - k1), their posterior mean."""
    noise = result.model.map.noise
    predicted = laden(result.model, aligned)(aligned.q).detach()
    errors = (aligned.points - predicted).nan_to_num(0.0).flatten(1)
    shifts = torch.einsum("nmc,nm->c", noise.shared, noise.solve(errors))
    sockets = 0 if result.sockets is None else result.sockets.positions.numel()  # the last shifts are theirs
    return frames.refined(shifts[: len(shifts) - sockets], predicted)


def _tangent_data(
    measurements: Measurements, registration: Identification, identification: Identification
) -> TangentData:
    """The measurements around the geometric calibration, weighted by its residuals."""
    payload = payload_of_rows(registration.geometry.chain, measurements)
    nominal = GeometryMap(registration.geometry, elastic=True, payload=payload)
    undeflected = identification.theta.new_zeros(nominal.parameters - nominal.geometry.size)
    theta = torch.cat([identification.theta, undeflected])
    sensor = NoiseModel.of(with_best_seen_point(measurements, identification), identification.noise)
    tails = identification.tails
    if sensor.bodies != measurements.markers:  # a pose is one body, and as wrong as its worst point
        tails = replace(tails, weights=tails.weights.unflatten(1, (sensor.bodies, -1)).amin(2))
    seen, predicted = measurements.points.flatten(1), nominal(measurements.q, theta)
    y = torch.where(seen.isnan(), predicted, seen)  # hidden markers: any value would do
    return TangentData(nominal, theta, measurements.q, y, sensor, tails)


def _fit(chosen: ChosenScales, controls: Controls, backend: Backend, progress: Progress) -> Fit:
    """The exact model, fitted from the geometric calibration."""
    data = chosen.data
    problem = robot_problem(data, chosen.selection.scales)
    count = _count(controls, data)
    start = replace(problem.zero(), theta=data.theta) if count is None else None
    solver = GaussNewton(tolerance=RESIDUAL_TOLERANCE)
    fitted = fit(problem, solver, controls=count, backend=backend, start=start, progress=progress)
    return replace(fitted, advice=ADVICE)


def _count(controls: Controls, data: TangentData) -> int | None:
    """Number of configurations that carry momenta; None for all."""
    if controls == "all" or (controls == "auto" and data.nominal.payload is not None):
        return None
    if controls == "auto":
        return AUTO_CONTROLS if data.y.numel() > MAX_DENSE and len(data.x) > AUTO_CONTROLS else None
    return controls


def _in_frame(
    fitted: Fit,
    measurements: Measurements,
    registration: Identification,
    places: SocketPlaces | None,
    chosen: ChosenScales,
) -> tuple[FittedMap, Measurements, FoundSockets | None]:
    """The map with covariances that hold where rows leave something open, the rows in its frame, and the sockets."""
    fitted_map = with_open_directions(fitted.model, measurements, registration)
    if places is None:
        return fitted_map, measurements, None
    if measurements.without_device:
        fitted_map = without_rigid_motions(fitted_map)
    sockets = found_sockets(fitted_map, measurements, places, chosen)
    warn_of_flat_places(fitted_map, measurements, sockets)
    return fitted_map, replace(places, positions=sockets.positions).placed(measurements), sockets


def _result(
    robot: Tree,
    measurements: Measurements,
    registration: Identification,
    identification: Identification,
    *,
    chosen: ChosenScales,
    fitted: Fit,
    places: SocketPlaces | None,
    note: str,
) -> CalibrationResult:
    """Findings about model and measurements, and everything together."""
    fitted_map, measurements, sockets = _in_frame(fitted, measurements, registration, places, chosen)
    kind: dict[str, Any] = {"lever": measurements.lever, "ball": measurements.sockets is not None}
    kinematics = CalibratedKinematics(robot, fitted_map, **kind)
    tails, left_out = chosen.data.tails, chosen.left_out
    explained, found = parts(kinematics), outliers(kinematics, measurements, chosen.data, chosen.judged)
    LOG.info("rows that look wrong and hardly count: %s", few([one.number for one in found], 20) or "none")
    warn_of_outliers(len({one.row for one in found}), measurements, found[0].reason if found else "")
    warn_of_contradictions(kinematics, measurements, found, chosen.moved)
    warn_of_rounding(robot, measurements, chosen.data.jacobian, left_out)
    stages = registration.geometry.points, identification.geometry.points, kinematics
    rms = [evaluate(stage, measurements).rms for stage in stages] + [_left_out_rms(left_out, measurements)]
    kind["rigid_errors"], kind["provenance"] = identification.geometry.joint_errors, Provenance.now(measurements, note)
    return CalibrationResult(
        model=CalibratedKinematics(robot, fitted_map, _summary(rms, chosen, fitted, explained, found), **kind),
        registration=registration,
        identification=identification,
        selection=chosen.selection,
        tails=tails,
        leave_one_out=left_out,
        parts=explained,
        outliers=found,
        fit=fitted,
        sockets=sockets,
    )


def _left_out_rms(left_out: LeaveOneOut, data: Measurements) -> float:
    """Root mean square of leave-one-out errors, m, of measured positions where there are any: others are spreads."""
    return left_out.rms if data.places is None or data.without_device else left_out.rows(data.places < 0).rms


def _summary(
    rms: list[float], chosen: ChosenScales, fitted: Fit, explained: list[Part], found: list[Outlier]
) -> Summary:
    """Numbers and sentences that travel with the model; ``rms`` of registration, geometry, model and left out, m."""
    registration, geometry, diffeomorphic, left_out = rms
    return Summary(
        registration_rms=registration,
        geometry_rms=geometry,
        diffeomorphic_rms=diffeomorphic,
        leave_one_out_rms=left_out,
        outliers=len(found),
        noise_degrees_of_freedom=chosen.data.tails.freedom,
        coupling_residual=fitted.coupling_residual,
        end_residual=fitted.end_residual,
        energy=fitted.energy,
        status=fitted.status,
        scales=chosen.selection.status,
        rows=len(chosen.data.x),
        parts={part.name: part.displacement for part in explained},
        effective_parameters=chosen.left_out.effective,
    )
