"""`calibrate`: from a robot and measured rows to calibrated kinematics, everything chosen from the data.

    1 registration   base frame and markers, or ball and devices
    2 geometry       an error twist before every joint, with a prior; outliers lose their influence
    3 scales         of kernels, priors and noise, by marginal likelihood; then the weights of outliers, and again
    4 calibrated     phi, psi, geometry, gravity sag and devices together, fitted exactly

Each stage is kept in the result, so that a report can compare them.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from math import log
from typing import Literal

from diffeo_calib.calibration.choose_scales import (
    FEWEST_JUDGED,
    FEWEST_POSES,
    RESIDUAL_TOLERANCE,
    ChosenScales,
    check_models,
    choose_scales,
    robot_problem,
)
from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.diagnostics.hypotheses import lengths, warn_of_lengths, warn_of_taken_scales, worth_it
from diffeo_calib.calibration.diagnostics.judge import Finding, judge
from diffeo_calib.calibration.diagnostics.judged_rows import (
    Outlier,
    common_cause,
    flagged,
    outliers,
    warn_of_outliers,
    warn_of_stuck,
)
from diffeo_calib.calibration.diagnostics.open_directions import warn_of_single_joints, warn_of_what_is_open
from diffeo_calib.calibration.diagnostics.plausibility import (
    check_joints,
    check_limits,
    warn_of_no_errors,
    warn_of_rounding,
)
from diffeo_calib.calibration.expected_errors import with_open_directions
from diffeo_calib.calibration.placing.lens import EXACT_SIZE, BoardSize
from diffeo_calib.calibration.placing.place import Placed, place
from diffeo_calib.calibration.placing.placement import Placement
from diffeo_calib.calibration.result import CalibrationResult, parts
from diffeo_calib.common.checks import check_count, check_seed
from diffeo_calib.common.device import HOST, outside_inference_mode
from diffeo_calib.common.errors import InputError, as_written, few, kept_warnings, warn_user
from diffeo_calib.common.threads import small_work
from diffeo_calib.fitting.fit import fit
from diffeo_calib.fitting.gauss_newton import GaussNewton
from diffeo_calib.fitting.result import Fit, Progress, silent
from diffeo_calib.kernels.reductions.backends import Backend
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.provenance import OF_POSITIONS, Provenance, Summary, check_note
from diffeo_calib.measurements.observations import Observations
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.process.scales import Hyperparameters
from diffeo_calib.regression.conjugate_gradients import MAX_DENSE
from diffeo_calib.robots.payload import check_same_load
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.devices import CHANGE, VALUE

Controls = int | Literal["auto", "all"]
Table = Measurements | Readings | Observations  # measured rows of any kind


def check_arguments(robot: object, measurements: object, hyperparameters: object) -> None:
    """Raise InputError for arguments of the wrong kind."""
    tables = Measurements, Readings, Observations
    kinds = ((robot, "robot", (Tree,)), (measurements, "measurements", tables))
    for given, name, allowed in (*kinds, (hyperparameters, "hyperparameters", (Hyperparameters, type(None)))):
        if not isinstance(given, allowed):
            expected = " or ".join(f"a dc.{kind.__name__}" for kind in allowed if kind is not type(None))
            raise InputError.of(f"`{name}`", expected=expected, got=type(given).__name__)
    if isinstance(hyperparameters, Hyperparameters) and isinstance(robot, Tree):
        got = len(hyperparameters.transmission_amplitude), len(hyperparameters.compliance)
        if got != (robot.n, robot.moving):
            expected = f"scales of {robot.n} joints, {robot.moving} of them moving"
            raise InputError.of("`hyperparameters`", expected=expected, got=f"{got[0]} and {got[1]}")


def check_controls(controls: Controls, measurements: Table) -> None:
    """Raise InputError unless this is a number of configurations, 'auto' or 'all'."""
    if not isinstance(controls, str):
        check_count(controls, "`controls`", most=len(measurements))
        check_same_load(measurements.payload, "`controls`", controls, fix="leave `controls` out, or pass fewer rows")
    elif controls not in ("auto", "all"):
        raise InputError.of("`controls`", expected="a number, 'auto' or 'all'", got=as_written(controls))


LOG = logging.getLogger(__name__)
AUTO_CONTROLS = 200  # configurations that carry momenta where all of them would need too large a matrix
ADVICE = "judge it by held-out errors, and if they are poor, measure more poses or pass fewer `controls`"
"""On a fit that did not converge: solver and time steps, on which the solver advises, are no arguments here."""


@small_work()
@outside_inference_mode
def calibrate(
    robot: Tree,
    measurements: Table,
    *,
    hyperparameters: Hyperparameters | None = None,
    scales_of: Sequence[CalibratedKinematics] = (),
    controls: Controls = "auto",
    backend: Backend = "auto",
    seed: int = 0,
    progress: Progress = silent,
    note: str = "",
) -> CalibrationResult:
    """Calibrate a robot's kinematics.

    Args:
        robot: nominal chain, n joints.
        measurements: N configurations (rad, m) with P markers each (m; NaN where hidden) or with poses, of one tip or
            several, in the frame of the measuring device; base frame and markers on the tool are estimated. Their
            standard deviations are used if they have any; noise beyond these is estimated. With payloads the sag under
            any payload is found. Or rows with a ball in sockets, or readings of distances, heights or images, whose
            devices are found with the robot; or rows of several kinds, see :class:`Observations`. A drift with columns
            such as time or temperature (``with_covariates``) is part of the model where left-out rows prove it.
        hyperparameters: scales of kernels and noise; chosen by marginal likelihood if not given.
        scales_of: calibrated robots of the same type, whose mean scales are used, for 15 to 120 rows. They are
            inflated where leave-one-out errors of these rows contradict them.
        controls: how many of the configurations carry momenta, or "all"; "auto" is all up to 8000 measured
            coordinates and 200 for more, which takes minutes instead of hours (of 12,000 simulated rows 200 leave 6 %
            more error than 800). With payloads all of them do. Of more rows a random sample chooses geometry and
            scales; all are weighed and fitted.
        backend: evaluates the kernel sums, see :func:`fit`.
        seed: draws the poses on which the scales are selected.
        progress: called as ``progress(task, done, total)``; Ctrl-C keeps the best state so far.
        note: text that is kept with the model, such as a serial number; see :class:`Provenance`.

    Returns:
        a :class:`CalibrationResult`; ``result.model`` is the calibrated kinematics.

    Raises:
        MeasurementError: joints that do not match the robot, too few rows, a marker that no row shows, points that
            never move, or rows that another reading of the table explains far better; the message names it.
        InputError: models of another type of robot, or scales given twice.
        RobotError: joint names in another order than the robot's.

    Warns:
        DiffeoCalibWarning: a joint never moves, or moves far beyond its limits; a joint below the tip, of which the
            table has a column, moves the markers; the poses leave the place of a marker or of the measuring frame open,
            lie in a plane or on a line, or move one joint at a time; joint offsets are far from the robot's
            description; the median residual of a geometric calibration exceeds 5 % of the markers' spread and no other
            reading explains it; a column holds one value although the robot moves; the rows show no errors of the
            robot; too few poses to select scales; leave-one-out errors contradict the scales; during the measurements
            something moved or drifted, a joint offset or a zero changed; rows that follow an axis do not tell its
            errors from a drift; a length of robot or device is not what it is said to be; wrong rows follow one
            another; more than 40 % of the rows are outliers; the joint values are rounded and this limits the accuracy.
    """
    check_arguments(robot, measurements, hyperparameters)
    check_models(scales_of, robot)
    if scales_of and hyperparameters is not None:
        raise InputError.of("`hyperparameters` beside `scales_of`", expected="one of them", fix="leave one out")
    check_note(note)
    check_seed(seed)
    check_controls(controls, measurements)
    check_joints(robot, measurements)
    with kept_warnings() as warned:
        placed = place(robot, measurements, progress)
        check_limits(robot, measurements)
        warn_of_single_joints(robot, measurements)
        data = placed.tangent_data()
        warn_of_no_errors(robot, data, placed.registration, placed.identification)
        warn_of_stuck(data, measurements)
        if placed.coordinates is None:
            warn_of_what_is_open(data, [kind.devices for kind in placed.readings])
        stages = placed.registration, placed.identification
        scales_for = partial(choose_scales, given=hyperparameters, models=scales_of, seed=seed, progress=progress)
        chosen = scales_for(data, measurements, *stages)
        if not chosen.selection.interrupted and (drifting := placed.drifting()) is not None:
            again = scales_for(drifting.tangent_data(), measurements, *stages)
            if worth_it(chosen.left_out.errors, again.left_out.errors):
                placed, chosen = drifting, again
        if scales_of and len(data.x) >= FEWEST_JUDGED and not chosen.selection.interrupted:
            warn_of_taken_scales(chosen.left_out, scales_for(data, measurements, *stages, models=()).left_out)
        how = chosen.selection
        if not how.interrupted and (widened := placed.widened(chosen.data, how.scales)):
            placed, text = widened
            chosen = scales_for(placed.tangent_data(), measurements, *stages)
            warn_user(text)
        if any(isinstance(part, BoardSize) for part in placed.placement):
            placed, chosen = _of_exact_board(placed, chosen)
        devices, bodies = placed.placement.hypotheses(chosen.data, CHANGE), placed.placement.bodies
        judged = chosen.data, chosen.selection.scales, chosen.left_out, placed.data.line_numbers
        best = judge(
            *judged, placed.data.row_names, devices=devices, bodies=bodies, opens=not chosen.selection.interrupted
        )
        if best and best.columns is not None:
            chosen = scales_for(placed.tangent_data(best.columns), measurements, *stages)
        LOG.info("scales: %s", chosen.selection.status)
        fitted = _fit(chosen, controls, backend, progress)
        return _result(robot, placed, chosen, fitted, best, note=note, warned=warned)


TOLD_LOG_ODDS = log(10.0)  # before the rows are seen: of a board of the size that was told against a print


def _of_exact_board(placed: Placed, chosen: ChosenScales) -> tuple[Placed, ChosenScales]:
    """With a board of the size that its detector was told, unless rows are likelier of a print."""
    sets = [part.of_std(EXACT_SIZE) if isinstance(part, BoardSize) else part for part in placed.placement]
    exact, scales = replace(placed, placement=Placement(tuple(sets))), chosen.selection.scales
    data = replace(chosen.data, shared=exact.placement.shared(chosen.data))
    if chosen.data.process(scales).evidence > data.process(scales).evidence + TOLD_LOG_ODDS:
        return placed, chosen
    return exact, replace(chosen, data=data)


def _fit(chosen: ChosenScales, controls: Controls, backend: Backend, progress: Progress) -> Fit:
    """The exact model, fitted from the geometric calibration."""
    data = chosen.data
    problem = robot_problem(data, chosen.selection.scales)
    many = not data.nominal.load.by_row and data.y.numel() > MAX_DENSE and len(data.x) > AUTO_CONTROLS
    count = controls if isinstance(controls, int) else AUTO_CONTROLS if many and controls == "auto" else None
    start = replace(problem.zero(), theta=data.theta) if count is None else None  # coarse fits find one of their own
    solver = GaussNewton(tolerance=RESIDUAL_TOLERANCE)
    fitted = fit(problem, solver, controls=count, backend=backend, start=start, progress=progress)
    return replace(fitted, advice=ADVICE, model=replace(fitted.model, unresolved=chosen.unresolved))


def _common_cause(
    model: CalibratedKinematics, placed: Placed, outlying: Sequence[Outlier], best: Finding | None
) -> str | None:
    """What explains rows that look wrong together, in a sentence: a change among the rows, or their order."""
    said = best and best.text
    if placed.coordinates is None:
        return said
    table, rows = placed.coordinates
    return common_cause(model, table, flagged(len(placed.data), outlying)[rows.to(HOST)], said)


def _result(
    robot: Tree,
    placed: Placed,
    chosen: ChosenScales,
    fitted: Fit,
    best: Finding | None,
    *,
    note: str,
    warned: list[str],
) -> CalibrationResult:
    """Findings about model and rows, and everything together."""
    data, scales, fitted_map = chosen.data, chosen.selection.scales, fitted.model
    q = placed.data.q if placed.coordinates is None else placed.coordinates.table.q
    fitted_map = with_open_directions(fitted_map, q, placed.registration, rigid=placed.lever is not None)
    fitted_map = fitted_map.without_rigid_motions() if placed.free else fitted_map
    placed = placed.settled(fitted, fitted_map, chosen)
    model = CalibratedKinematics(robot, fitted_map, lever=placed.lever, ball=placed.ball)
    for devices in placed.placement:
        devices.warn_of_weakness(model)
    chosen_scales = int(placed.data.groups().max()) + 1 >= FEWEST_POSES  # else chance makes rows and lengths doubtful
    least = 1.0 if chosen_scales else gates.UNCHOSEN_FACTOR
    explained, outlying = parts(model), outliers(model, placed, data, chosen.judged, least)
    LOG.info("rows that look wrong and hardly count: %s", few([outlier.number for outlier in outlying], 20) or "none")
    warn_of_outliers(outlying, placed.data)
    if said := _common_cause(model, placed, outlying, best):
        warn_user(said)
    warn_of_rounding(robot, placed.data, data, chosen.left_out)
    found_lengths = lengths(data, scales, placed.placement.hypotheses(data, VALUE)) if chosen_scales else []
    summary = Summary(
        **dict(zip(OF_POSITIONS, placed.stage_rms(model), strict=False)),
        leave_one_out_rms=placed.by_kind(chosen.left_out.errors).positions_rms,
        outliers=len(outlying),
        noise_degrees_of_freedom=data.tails.freedom,
        **{name: getattr(fitted, name) for name in ("coupling_residual", "end_residual", "energy", "status")},
        scales=chosen.selection.status,
        rows=len(data.x),
        parts={part.name: part.displacement for part in explained},
        effective_parameters=chosen.left_out.effective,
        length_in_doubt=warn_of_lengths(found_lengths),
        warnings="\n".join(warned) or None,
    )
    return CalibrationResult(
        model=model.changed(
            summary=summary,
            placement=placed.placement.placed(),
            rigid_errors=placed.identification.geometry.joint_errors,
            provenance=Provenance.now(placed.data, note),
            scales=scales.vector,
        ),
        placed=placed,
        selection=chosen.selection,
        tails=data.tails,
        leave_one_out=chosen.left_out,
        parts=explained,
        outliers=outlying,
        fit=fitted,
        lengths=found_lengths,
        partial=best is not None and best.columns is not None,
    )
