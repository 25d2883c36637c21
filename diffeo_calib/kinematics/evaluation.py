"""Errors of any kinematics on measurements: of positions, and of orientations where poses were measured.

For calibrated models also: which rows took part in the fit, which rows lie outside the joint ranges of the fit, and
whether errors are too large to be those of a calibrated robot.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import degrees, inf, radians
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError, MeasurementError, sentence, warn_user
from diffeo_calib.common.inference_mode import outside_inference_mode
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.errors import READINGS, SPREAD, Evaluation, Evaluations
from diffeo_calib.kinematics.joint_order import check_joint_order, check_kind, check_tips
from diffeo_calib.kinematics.laden_rows import at_payloads, laden
from diffeo_calib.kinematics.places import Places, place, sensor_key
from diffeo_calib.kinematics.re_registration.registered_map import RegisteredMap
from diffeo_calib.kinematics.socket_errors import socket_errors, with_markers_of
from diffeo_calib.measurements.pose_frames import (
    by_frame,
    frames_of_points,
    transforms_of_frames,
    visible_rotation_numbers,
)
from diffeo_calib.measurements.poses import angle_between
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.measurements.rows import NO_SOCKET, RowGroups
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.tables import divided

LARGEST_ERROR_PER_REACH = 0.1
"""Median position errors above this fraction of the robot's reach are implausible."""
LARGEST_ERROR_PER_EXPECTED = 20.0
"""Median errors above this multiple of the error that the model itself expects are implausible."""
SAME_CONFIGURATION = 1e-9
"""Largest difference [rad or m] between the joint values of one row in two files, which comes from rounding."""
RANGE_MARGIN = 0.25
"""Rows may lie outside the joint range of the fit by this fraction of the range."""
ROWS_AT_ONCE = 1024
COORDINATES = 3
MOST_EXPECTED = 100
"""Rows from which the typical expected error is found."""


@outside_inference_mode
def evaluate(kinematics: Callable[[Tensor], Tensor], data: Any) -> Evaluation | Evaluations:
    """Compare kinematics with measurements.

    Devices that a model does not know are placed on the rows, and the result says how many numbers that took: the
    frames of several set-ups, or of positions beside a model that was calibrated without a measuring device; the
    devices of readings; the middles of sockets.

    Args:
        kinematics: (N, n) joint configurations -> (N, P, 3) marker positions in m in the measuring frame: a calibrated
            model, or the method ``points`` of a geometry. For measured poses: the three points that represent each.
        data: :class:`Measurements`, :class:`Readings` or :class:`Observations`.

    Returns:
        the errors of rows of one kind; of several kinds an evaluation for each, by name.

    Raises:
        InputError: arguments of another kind, another number of joints or markers, joints of the same names in another
            order, or poses on one side and points on the other.
        MeasurementError: too few rows of a set-up or device to place it, or readings that no place of it explains.
    """
    if not callable(kinematics) or isinstance(kinematics, Tree):
        expected = "a calibrated model or another function of joint values"
        raise InputError.of("`kinematics`", expected=expected, got=type(kinematics).__name__)
    if not isinstance(data, RowGroups):
        expected = "dc.Measurements, dc.Readings or Observations"
        raise InputError.of("`data`", expected=expected, got=type(data).__name__)
    check_rows(kinematics, data)
    found = residuals(kinematics, place(kinematics, data), data)
    return replace(found.main, placed=found.placed, numbers=found.numbers) if len(found) == 1 else found


def residuals(kinematics: Callable[[Tensor], Tensor], places: Places, data: Any) -> Evaluations:
    """Measured minus predicted values of every row, kind by kind, each in the unit of its device.

    Args:
        kinematics: as of :func:`evaluate`. places: of its devices beside the kinematics, see :func:`place`.
        data: rows of any kinds.

    Raises:
        InputError: another number of joints or markers, or poses on one side and points on the other.
        MeasurementError: readings of devices that ``places`` does not know.
    """
    kinds, index = dict[str, Evaluation](), dict[str, Tensor]()
    own, readings = divided(data)
    if own is not None:
        resting = torch.full_like(own.rows, NO_SOCKET) if own.table.places is None else own.table.places
        for some, of in ((resting < 0, _of_positions), (resting >= 0, _of_sockets)):
            if bool(some.any()):
                found = of(kinematics, places, own.table.rows(some))
                kinds[found.kind], index[found.kind] = found, own.rows[some]
    for table, rows in readings:
        names = [f"{table.kind}{number}" for number in ("", *(f" {k}" for k in range(2, len(readings) + 1)))]
        name = next(name for name in names if name not in kinds)
        kinds[name], index[name] = _of_readings(kinematics, places, table), rows
    return Evaluations(kinds, index, len(data), places.found, places.numbers)


def check_rows(kinematics: Callable[[Tensor], Tensor], data: Any) -> None:
    """Refuse rows of other joints, tips and kinds than those of a calibrated model."""
    for table in data.parts if isinstance(kinematics, CalibratedKinematics) else ():
        check_joint_order(kinematics.robot, table)
        if isinstance(table, Measurements):
            with_ball = with_markers_of(kinematics, table)
            check_kind(kinematics.lever, with_ball)
            check_tips(kinematics.on, with_ball)


def _predicted(kinematics: Callable[[Tensor], Tensor], data: Any) -> Tensor:
    """(N, P, 3) markers of kinematics under the payloads of the rows, m."""
    if not isinstance(kinematics, CalibratedKinematics) or len(data) <= ROWS_AT_ONCE:
        return at_payloads(kinematics, data)(data.q).detach()
    blocks = (data.rows(slice(first, first + ROWS_AT_ONCE)) for first in range(0, len(data), ROWS_AT_ONCE))
    return torch.cat([at_payloads(kinematics, block)(block.q).detach() for block in blocks])


def _of_positions(kinematics: Callable[[Tensor], Tensor], places: Places, table: Measurements) -> Evaluation:
    """Errors of measured positions or poses."""
    data = places.aligned(table.device_rows())
    predicted = _predicted(kinematics, data)
    predicted = predicted[:, :-1] if places.ball and predicted.shape[1] == data.markers + 1 else predicted
    if predicted.shape != data.points.shape:
        raise InputError.of(
            "the model and the measurements do not have the same markers",
            expected=f"predictions of shape {tuple(data.points.shape)}",
            got=tuple(predicted.shape),
            fix="evaluate on the markers that the model was calibrated with, in the same order",
        )
    whole = Evaluation(data.points[..., 0], line_numbers=data.line_numbers, devices=table.device_names, kind=data.kind)
    if data.frames is None or data.lever is None:
        away = data.points - predicted
        return replace(whole, errors=away.norm(dim=-1), away=away)
    frames = frames_of_points(predicted, data.lever)
    away = data.frames[..., :3, 3] - frames[..., :3, 3]
    angles = angle_between(frames[..., :3, :3], data.frames[..., :3, :3])
    angles = angles[:, 0] if angles.shape[1] == 1 else angles
    turned = transforms_of_frames(data.frames[..., :3, :3] @ frames[..., :3, :3].mT, 0.0 * away)
    turns = visible_rotation_numbers(turned, "rotvec", "rad").to(away)
    return replace(whole, errors=away.norm(dim=-1), angles=angles, away=away, turns=turns)


def _of_sockets(kinematics: Callable[[Tensor], Tensor], places: Places, table: Measurements) -> Evaluation:
    """Spread within sockets, and errors of known distances."""
    data = table.socket_rows()
    if data.socket is None or data.sockets is None:
        raise AssertionError("rows in sockets name these")
    predicted = _predicted(kinematics, data)[:, -1]
    found = socket_errors(predicted, data.socket.to(predicted.device), data.sockets)
    size, away, names = found.away.norm(dim=1, keepdim=True), found.away[:, None], data.row_sockets
    lines = data.line_numbers
    return Evaluation(size, None, away, lines, found.distances, what=SPREAD, kind="socket", devices=names)


def _of_readings(kinematics: Callable[[Tensor], Tensor], places: Places, data: Readings) -> Evaluation:
    """Errors of readings."""
    devices = places.devices.get(sensor_key(data))
    if devices is None:
        fix = "pass rows of the devices of the calibration"
        raise MeasurementError.of("`data`", expected="readings of the calibration", got=f"{data.kind}s", fix=fix)
    away = devices.in_unit(data, devices.errors(data, _predicted(kinematics, data)[:, -1]))
    unit, per_unit = ("m", 1e-3) if data.unit[0] == "mm" else (data.unit[0], 1.0)
    away = per_unit * away
    size, names = away.norm(dim=1, keepdim=True), data.device_names
    lines, of = data.line_numbers, data.kind
    return Evaluation(size, None, away[:, None], lines, what=READINGS, kind=of, unit=unit, devices=names)


def rows_used_in_fit(model: CalibratedKinematics, q: object) -> Tensor:
    """Which configurations the model was fitted to, up to the rounding of files.

    Args:
        model: the calibrated model. q: (N, n) joint configurations, rad or m.

    Returns:
        (N,) boolean.

    Raises:
        InputError: not a calibrated model, wrong shape, or values that are not finite.
    """
    fitted = _configurations(model)
    blocks = model.robot.joint_values(q).detach().split(ROWS_AT_ONCE)  # pyright: ignore[reportArgumentType]
    return torch.cat([torch.cdist(block, fitted, p=inf).amin(1) < SAME_CONFIGURATION for block in blocks])


def rows_of_other_frames(model: CalibratedKinematics, q: Tensor) -> int:
    """How many of the configurations (N, n) were fitted in another session than that of the model's measuring frame.

    Markers of such rows share shifts in the noise of the fit, which those of the model's own session do not. All rows
    of a registered model are in other frames: none is counted.
    """
    if isinstance(model.map, RegisteredMap):
        return 0
    shared = model.map.noise.shared[:, : -COORDINATES if model.ball else None]  # the ball's are places of its sockets
    if not shared[:1].numel() or len(shared) != len(model.configurations):
        return 0
    elsewhere = model.configurations[(shared != 0).any(2).any(1)]
    return int((torch.cdist(q.to(elsewhere), elsewhere, p=torch.inf) < SAME_CONFIGURATION).any(1).sum())


def joints_outside_range(model: CalibratedKinematics, q: object) -> Tensor:
    """Which joint values lie outside the range of the joint in the fit by more than a quarter of that range.

    Args:
        model: the calibrated model. q: (N, n) joint configurations, rad or m.

    Returns:
        (N, n) boolean. ``joints_outside_range(model, q).any(1)`` are the rows whose errors are not known.

    Raises:
        InputError: not a calibrated model, wrong shape, or values that are not finite.
    """
    fitted = _configurations(model)
    q = model.robot.joint_values(q).detach()  # pyright: ignore[reportArgumentType]
    low, high = fitted.amin(0), fitted.amax(0)
    margin = RANGE_MARGIN * (high - low) + SAME_CONFIGURATION
    return (q < low - margin) | (q > high + margin)


def _configurations(model: object) -> Tensor:
    """(N, n) configurations that a model was fitted to."""
    if not isinstance(model, CalibratedKinematics):
        raise InputError.of("`model`", expected="a calibrated model of a robot", got=type(model).__name__)
    return model.configurations


class OutsideRange:
    """Configurations outside the joint ranges of the fit, where the model's errors are not known, over many tables.

    Args:
        model: the calibrated model.
    """

    def __init__(self, model: CalibratedKinematics) -> None:
        self.model = model
        self.rows = self.outside = 0
        self.joints = torch.zeros(model.robot.n, dtype=torch.bool, device=model.configurations.device)

    def add(self, q: object) -> None:
        """Count configurations (N, n), rad or m."""
        outside = joints_outside_range(self.model, q)
        self.rows += len(outside)
        self.outside += int(outside.any(1).sum())
        self.joints |= outside.any(0)

    def warn(self) -> None:
        """Warn (DiffeoCalibWarning) with the number of rows and the names of the joints, if there are any."""
        if self.outside:
            names = [name for name, out in zip(self.model.robot.joint_names, self.joints, strict=True) if bool(out)]
            rows = f"{self.outside} of {self.rows} rows"
            what = f"{rows} are outside the joint range of the fit ({', '.join(names)})"
            fix = "trust them less than their standard deviations say, or measure there too"
            warn_user(sentence(what, fix=fix))


def warn_outside_range(model: CalibratedKinematics, q: object) -> None:
    """Warn of configurations outside the joint ranges of the fit, where the model's errors are not known.

    Args:
        model: the calibrated model. q: (N, n) joint configurations, rad or m.

    Warns:
        DiffeoCalibWarning: with the number of rows and the names of the joints.
    """
    found = OutsideRange(model)
    found.add(q)
    found.warn()


def check_plausible(model: CalibratedKinematics, data: Measurements, errors: Evaluation) -> None:
    """Warn of errors so large that the measurements were probably read in another way than they were written.

    Raises MeasurementError for errors that say nothing about the robot; arguments as of :func:`implausible`.
    """
    text = implausible(model, data, errors)
    if text is not None and impossible(model, errors):
        raise MeasurementError(text)
    if text is not None:
        warn_user(text)


def impossible(model: CalibratedKinematics, errors: Evaluation) -> bool:
    """Whether errors are so large that they say nothing about the robot: a median above a tenth of its reach."""
    return implausibly_far(model, errors.median)


def implausibly_far(model: CalibratedKinematics, distance: float) -> bool:
    """Whether a median distance, m, is above a tenth of the robot's reach."""
    return distance > LARGEST_ERROR_PER_REACH * model.robot.reach


def implausible(model: CalibratedKinematics, data: Measurements, errors: Evaluation) -> str | None:
    """A sentence about errors that no calibrated robot has: expected and found median, what to check; else None."""
    largest = model.robot.reach * LARGEST_ERROR_PER_REACH
    medians = [(errors.median, expected_error(model, data), 1e3, "mm", largest)]
    if errors.angle_median is not None:
        some = _some(data)
        covariance = laden(model, some).predict_poses(some.q)[1][..., 3:, 3:]
        medians.append((radians(errors.angle_median), _typical(covariance), degrees(1.0), "degrees", inf))
    for median, expected, per_unit, unit, most in medians:
        if median > min(most, LARGEST_ERROR_PER_EXPECTED * expected):
            options = ", `convention` and `rotation_angle`" * (data.poses is not None)
            return sentence(
                "these errors are not those of a calibrated robot",
                expected=f"a median of about {per_unit * expected:.2g} {unit} by the model's own uncertainty",
                got=f"{per_unit * median:.3g} {unit}",
                fix=f"check `length` and `angle`, the order of the columns{options}, and that neither the measuring "
                "device nor the markers have moved: a model predicts in the measuring frame of its fit (if they "
                "have, register the model, evaluate --register, or recalibrate it)",
            )
    return None


def expected_error(model: CalibratedKinematics, data: Measurements) -> float:
    """Typical distance, m, between a new measurement and its prediction."""
    return _typical(expected_covariance(model, data))


def expected_covariance(model: CalibratedKinematics, data: Measurements) -> Tensor:
    """(M, B, 3, 3) covariances of new positions at evenly spaced rows, m^2: of markers, or of origins of poses."""
    some = _some(data)
    if model.lever is None:
        return laden(model, some).predict(some.q)[1]
    return by_frame(laden(model, some).predict_poses(some.q)[1])[..., :3, :3]


def _some(data: Measurements) -> Measurements:
    """Evenly spaced rows, at most :data:`MOST_EXPECTED`."""
    return data.rows(slice(None, None, -(-len(data) // MOST_EXPECTED)))


def _typical(covariance: Tensor) -> float:
    """Median of the root of the traces of covariances (..., 3, 3)."""
    return float(covariance.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt().median())
