"""Errors of any kinematics on measurements: of positions, and of orientations where poses were measured.

For calibrated models also: which rows took part in the fit, which rows lie outside the joint ranges of the fit, and
whether errors are too large to be those of a calibrated robot.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import degrees, inf, nan, radians

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError, MeasurementError, sentence, warn_user
from diffeo_calib.common.hidden_values import known
from diffeo_calib.common.inference_mode import outside_inference_mode
from diffeo_calib.common.notebook import table_html
from diffeo_calib.common.quantiles import quantile
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.errors_frame import errors_frame
from diffeo_calib.kinematics.joint_order import check_joint_order, check_kind, check_tips
from diffeo_calib.kinematics.laden_rows import at_payloads, laden
from diffeo_calib.kinematics.reading_errors import placed
from diffeo_calib.kinematics.socket_errors import DistanceError, socket_errors, with_markers_of
from diffeo_calib.measurements.frames import check_one_set_up
from diffeo_calib.measurements.pose_frames import frames_of_points
from diffeo_calib.measurements.poses import angle_between
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.measurements.sockets import NO_SOCKET, Sockets
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.tree import Tree

LARGEST_ERROR_PER_REACH = 0.1
"""Median position errors above this fraction of the robot's reach are implausible."""
LARGEST_ERROR_PER_EXPECTED = 20.0
"""Median errors above this multiple of the error that the model itself expects are implausible."""
SAME_CONFIGURATION = 1e-9
"""Largest difference [rad or m] between the joint values of one row in two files, which comes from rounding."""
RANGE_MARGIN = 0.25
"""Rows may lie outside the joint range of the fit by this fraction of the range."""
ROWS_AT_ONCE = 1024
MOST_EXPECTED = 100
"""Rows from which the typical expected error is found."""


@dataclass(frozen=True, repr=False)
class Evaluation:
    """Distances between predicted and measured markers, or the errors of poses in position and orientation.

    Args:
        errors: (N, P) distances in m, NaN for hidden markers; for poses (N, T) distances of the T frames' origins.
        angles: (N,) angles in rad between predicted and measured orientations, (N, T) of poses on several tips; None if
            only points were measured.
        away: (N, P, 3) measured minus predicted positions, m. line_numbers: (N,) of the measurements.
        distances: known distances between sockets. If no position was measured, ``errors`` are distances from the mean
            of the predicted positions in the socket: a spread, which is 2 to 6 times smaller than errors.
        spread: (N,) these distances, m, beside measured positions, whose ``errors`` have NaN for rows in sockets.
    """

    errors: Tensor
    angles: Tensor | None = None
    away: Tensor | None = None
    line_numbers: Tensor | None = None
    distances: tuple[DistanceError, ...] = ()
    spread: Tensor | None = None

    def rows(self, chosen: Tensor) -> Evaluation:
        """The errors of some rows, chosen by a mask (N,) or by their numbers."""
        others = {name: getattr(self, name) for name in ("angles", "away", "line_numbers", "spread")}
        return Evaluation(self.errors[chosen], **{k: v[chosen] for k, v in others.items() if v is not None})

    to_frame = errors_frame

    def __repr__(self) -> str:
        names = ("rms", "median", "p95", "max")
        text = f"{len(known(self.errors))} distances in m: " + ", ".join(f"{n}={getattr(self, n):.4g}" for n in names)
        if self.angles is not None:
            angles = ", ".join(f"{n}={getattr(self, f'angle_{n}'):.4g}" for n in names)
            text = f"{text}; {len(known(self.angles))} angles in deg: {angles}"
        return f"Evaluation({text})"

    def _repr_html_(self) -> str:
        """A table of the errors, for notebooks."""
        names = ("rms", "median", "p95", "max")
        rows = [["position [mm]", *(f"{1e3 * getattr(self, name):.4f}" for name in names)]]
        if self.angles is not None:
            rows.append(["orientation [deg]", *(f"{getattr(self, f'angle_{name}'):.4f}" for name in names)])
        return table_html(f"Errors of {len(self.errors)} rows", ("", "RMS", "median", "95 %", "max"), rows)

    @property
    def count(self) -> int:
        """Number of rows with errors."""
        return int((~self.errors.isnan().all(1)).sum())

    @property
    def rms(self) -> float:
        """Root mean square distance, m."""
        return float(self.errors.square().nanmean().sqrt())

    @property
    def mean(self) -> float:
        """Mean distance, m."""
        return float(self.errors.nanmean())

    @property
    def median(self) -> float:
        """Median distance, m."""
        return self.quantile(0.5)

    @property
    def p95(self) -> float:
        """95th percentile of the distances, m."""
        return self.quantile(0.95)

    @property
    def max(self) -> float:
        """Largest distance, m."""
        return float(known(self.errors).max())

    def quantile(self, fraction: float) -> float:
        """The distance, m, that the given fraction of markers does not exceed."""
        return quantile(known(self.errors), fraction)

    @property
    def angle_rms(self) -> float | None:
        """Root mean square angle, **degrees**; None without orientations."""
        return None if self.angles is None else float(self.angles.rad2deg().square().nanmean().sqrt())

    @property
    def angle_median(self) -> float | None:
        """Median angle, **degrees**; None without orientations."""
        return self.angle_quantile(0.5)

    @property
    def angle_p95(self) -> float | None:
        """95th percentile of the angles, **degrees**; None without orientations."""
        return self.angle_quantile(0.95)

    @property
    def angle_max(self) -> float | None:
        """Largest angle, **degrees**; None without orientations."""
        return None if self.angles is None else float(known(self.angles).max().rad2deg())

    def angle_quantile(self, fraction: float) -> float | None:
        """The angle, **degrees**, that the given fraction of poses does not exceed; None without orientations."""
        return None if self.angles is None else quantile(known(self.angles.rad2deg()), fraction)


@outside_inference_mode
def evaluate(kinematics: Callable[[Tensor], Tensor], data: Measurements | Readings) -> Evaluation:
    """Compare kinematics with measurements.

    Args:
        kinematics: (N, n) joint configurations -> (N, P, 3) marker positions in m in the measuring frame: a calibrated
            model, or the method ``points`` of a geometry. For measured poses: the three points that represent each.
        data: measured configurations and markers or poses; or readings, whose devices are placed where they fit best.

    Raises:
        InputError: arguments of another kind, another number of joints or markers, joints of the same names in another
            order, or poses on one side and points on the other.
        MeasurementError: rows of several set-ups.
    """
    if not callable(kinematics) or isinstance(kinematics, Tree):
        expected = "a calibrated model or another function of joint values"
        raise InputError.of("`kinematics`", expected=expected, got=type(kinematics).__name__)
    if isinstance(data, Readings):
        return Evaluation(placed(kinematics, data).distances(data, kinematics), None, None, data.lines)
    if not isinstance(data, Measurements):
        raise InputError.of("`data`", expected="dc.Measurements", got=type(data).__name__)
    check_one_set_up(data)
    if isinstance(kinematics, CalibratedKinematics):
        data = with_markers_of(kinematics, data)
        check_joint_order(kinematics.robot, data)
        check_kind(kinematics.lever, data)
        check_tips(kinematics.on, data)
    predicted = at_payloads(kinematics, data)(data.q).detach()
    if predicted.shape != data.points.shape:
        raise InputError.of(
            "the model and the measurements do not have the same markers",
            expected=f"predictions of shape {tuple(data.points.shape)}",
            got=tuple(predicted.shape),
            fix="evaluate on the markers that the model was calibrated with, in the same order",
        )
    if data.socket is not None and data.sockets is not None:
        return _with_sockets(predicted, data, data.socket.to(predicted.device), data.sockets)
    if data.frames is None or data.lever is None:
        away = data.points - predicted
        return Evaluation(away.norm(dim=-1), None, away, data.line_numbers)
    frames = frames_of_points(predicted, data.lever)
    away = data.frames[..., :3, 3] - frames[..., :3, 3]
    angles = angle_between(frames[..., :3, :3], data.frames[..., :3, :3])
    angles = angles[:, 0] if angles.shape[1] == 1 else angles
    return Evaluation(away.norm(dim=-1), angles, away, data.line_numbers)


def _with_sockets(predicted: Tensor, data: Measurements, socket: Tensor, sockets: Sockets) -> Evaluation:
    """Spread within sockets; errors of measured positions (N, P, 3) where there are any, and the spread beside."""
    found = socket_errors(predicted[:, -1], socket, sockets)
    spread = None if data.without_device else found.away.norm(dim=-1)
    away = (data.points - predicted).masked_fill((socket != NO_SOCKET)[:, None, None], nan)
    if spread is None:
        away[:, -1] = found.away
    return Evaluation(away.norm(dim=-1), None, away, data.line_numbers, found.distances, spread)


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
    return errors.median > LARGEST_ERROR_PER_REACH * model.robot.reach


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
    some = _some(data)
    if model.lever is None:
        return _typical(laden(model, some).predict(some.q)[1])
    return _typical(laden(model, some).predict_poses(some.q)[1][..., :3, :3])


def _some(data: Measurements) -> Measurements:
    """Evenly spaced rows, at most :data:`MOST_EXPECTED`."""
    return data.rows(slice(None, None, -(-len(data) // MOST_EXPECTED)))


def _typical(covariance: Tensor) -> float:
    """Median of the root of the traces of covariances (..., 3, 3)."""
    return float(covariance.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt().median())
