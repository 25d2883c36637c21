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
from typing import Literal

import torch

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
from diffeo_calib.calibration.result import CalibrationResult
from diffeo_calib.calibration.robot_problem import robot_problem
from diffeo_calib.calibration.scales.hyperparameters import Hyperparameters
from diffeo_calib.calibration.scales.sensor import Sensor
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.calibration.sessions import SessionFrames
from diffeo_calib.calibration.sockets import (
    FoundSockets,
    SocketPlaces,
    found_sockets,
    held_parameters,
    stages_by_sockets,
    without_rigid_motions,
)
from diffeo_calib.common.checks import check_count, check_seed
from diffeo_calib.common.errors import InputError, as_written, few
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
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.visibility import check_every_marker_seen
from diffeo_calib.regression.choose import MAX_DENSE
from diffeo_calib.robots.tree import Tree

LOG = logging.getLogger(__name__)
AUTO_CONTROLS = 200
"""Configurations that carry momenta where all of them would need too large a matrix."""
RESIDUAL_TOLERANCE = 1e-5
"""Of coupling and end residual: the remaining error is far below the noise."""
ADVICE = "judge it by held-out errors, and if they are poor, measure more poses or pass fewer `controls`"
"""On a fit that did not converge: solver and time steps, on which the solver advises, are no arguments here."""
Controls = int | Literal["auto", "all"]


@small_work()
@outside_inference_mode
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
) -> CalibrationResult:
    """Calibrate a robot's kinematics.

    Args:
        robot: nominal chain, n joints.
        measurements: N configurations (rad, m) with P markers each (m; NaN where hidden) or with poses, in the frame of
            the measuring device; base frame and markers on the tool are estimated. Their standard deviations are used
            if they have any; noise beyond these is estimated. With payloads the sag under any payload is found.
        hyperparameters: scales of kernels and noise; chosen by marginal likelihood if not given.
        controls: how many of the configurations carry momenta, or "all"; "auto" is all up to 8000 measured
            coordinates and 200 for more, which is as accurate there and takes minutes instead of hours. With payloads
            all of them do.
        backend: evaluates the kernel sums, see :func:`fit`.
        seed: draws the poses on which the scales are selected.
        progress: called as ``progress(task, done, total)``; Ctrl-C keeps the best state so far.
        note: text that is kept with the model, such as a serial number; see :class:`Provenance`.

    Returns:
        a :class:`CalibrationResult`; ``result.model`` is the calibrated kinematics.

    Raises:
        MeasurementError: joints that do not match the robot, too few rows, a marker that no row shows, units that
            cannot be right, or measurements that do not belong to these configurations.
        RobotError: joint names in another order than the robot's.

    Warns:
        DiffeoCalibWarning: a joint never moves, or moves far beyond its limits; a joint below the tip, of which the
            table has a column, moves the markers; the poses leave the place of a marker or of the measuring frame open,
            lie in a plane or on a line, or move one joint at a time; joint offsets are far from the robot's
            description; the median residual of a geometric calibration exceeds 2 % of the markers' spread; too few
            poses to select scales; leave-one-out errors contradict the scales; the device, the base or a marker seems
            to have moved during the measurements; wrong rows follow one another; more than 40 % of the rows are
            outliers; the joint values are rounded and this limits the accuracy.
    """
    _check_arguments(robot, measurements, hyperparameters)
    check_note(note)
    check_seed(seed)
    check_joints(robot, measurements)
    check_every_marker_seen(measurements)
    _check_controls(controls, measurements)
    # 0 measuring frames
    frames = SessionFrames.of(robot, measurements, progress)
    session, measurements = measurements.session, frames.aligned(measurements) if frames else measurements
    # 1 registration, 2 geometry
    places, measurements, stages = _geometric(robot, measurements, progress)
    # 3 scales
    data = _tangent_data(measurements, *stages)
    if frames is not None and session is not None:
        data = replace(data, shared=frames.shared(data, session))
    elif places is not None:
        held = held_parameters(data.nominal.geometry)
        data = replace(data, shared=places.shared(measurements), held=held)
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
    return frames.refined(shifts, predicted)


def _check_arguments(robot: object, measurements: object, hyperparameters: object) -> None:
    """Raise InputError for arguments of the wrong kind."""
    kinds = ((robot, "robot", Tree), (measurements, "measurements", Measurements))
    for given, name, kind in (*kinds, (hyperparameters, "hyperparameters", Hyperparameters)):
        if not isinstance(given, kind) and not (name == "hyperparameters" and given is None):
            raise InputError.of(f"`{name}`", expected=f"a dc.{kind.__name__}", got=type(given).__name__)
    if isinstance(hyperparameters, Hyperparameters) and isinstance(robot, Tree):
        got = len(hyperparameters.transmission_amplitude), len(hyperparameters.compliance)
        if got != (robot.n, robot.moving):
            expected = f"scales of {robot.n} joints, {robot.moving} of them moving"
            raise InputError.of("`hyperparameters`", expected=expected, got=f"{got[0]} and {got[1]}")


def _check_controls(controls: Controls, measurements: Measurements) -> None:
    """Raise InputError unless this is a number of configurations, 'auto' or 'all'."""
    if not isinstance(controls, str):
        check_count(controls, "`controls`", most=len(measurements))
        if measurements.payload is not None:
            fix = "leave `controls` out, or pass fewer rows"
            raise InputError.of("`controls` of measurements with payloads", expected="'all'", got=controls, fix=fix)
    elif controls not in ("auto", "all"):
        raise InputError.of("`controls`", expected="a number, 'auto' or 'all'", got=as_written(controls))


def _tangent_data(
    measurements: Measurements, registration: Identification, identification: Identification
) -> TangentData:
    """The measurements around the geometric calibration, weighted by its residuals."""
    payload = payload_of_rows(registration.geometry.chain, measurements)
    nominal = GeometryMap(registration.geometry, elastic=True, payload=payload)
    undeflected = identification.theta.new_zeros(nominal.parameters - nominal.geometry.size)
    theta = torch.cat([identification.theta, undeflected])
    sensor, tails = Sensor.of(measurements, identification.noise), identification.tails
    if sensor.bodies != measurements.markers:  # a pose is one body, and as wrong as its worst point
        tails = replace(tails, weights=tails.weights.amin(1, keepdim=True))
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
    fitted_map = without_rigid_motions(fitted_map)
    sockets = found_sockets(fitted_map, measurements, places, chosen)
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
    kinematics = CalibratedKinematics(robot, fitted_map, lever=measurements.lever)
    tails, left_out = chosen.data.tails, chosen.left_out
    explained, found = parts(kinematics), outliers(kinematics, measurements, chosen.data, left_out)
    LOG.info("rows that look wrong and hardly count: %s", few([one.number for one in found], 20) or "none")
    warn_of_outliers(len({one.row for one in found}), measurements, found[0].reason if found else "")
    warn_of_contradictions(kinematics, measurements, found, chosen.moved)
    warn_of_rounding(robot, measurements, chosen.data.jacobian, left_out)
    stages = registration.geometry.points, identification.geometry.points, kinematics
    summary = _summary([evaluate(stage, measurements).rms for stage in stages], chosen, fitted, explained, found)
    return CalibrationResult(
        model=CalibratedKinematics(
            robot,
            fitted_map,
            summary,
            lever=measurements.lever,
            rigid_errors=identification.geometry.joint_errors,
            provenance=Provenance.now(measurements, note),
        ),
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


def _summary(
    rms: list[float], chosen: ChosenScales, fitted: Fit, explained: list[Part], found: list[Outlier]
) -> Summary:
    """Numbers and sentences that travel with the model; ``rms`` of registration, geometry and model, m."""
    registration, geometry, diffeomorphic = rms
    return Summary(
        registration_rms=registration,
        geometry_rms=geometry,
        diffeomorphic_rms=diffeomorphic,
        leave_one_out_rms=chosen.left_out.rms,
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
