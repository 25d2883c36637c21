"""Errors of any kinematics on measurements: of positions, and of orientations where poses were measured.

For calibrated models also: which rows took part in the fit, which rows lie outside the joint ranges of the fit, and
whether errors are too large to be those of a calibrated robot, or those of a moved device or marker.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import degrees, inf, radians
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST, outside_inference_mode
from diffeo_calib.common.errors import InputError, MeasurementError, sentence, warn_user
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.joint_ranges import SAME_CONFIGURATION, check_same_robot, fitted_configurations
from diffeo_calib.kinematics.nominal import FlangePoints
from diffeo_calib.kinematics.registered_map import marker_slopes
from diffeo_calib.measurements.bodies import Predicted
from diffeo_calib.measurements.poses import angle_between
from diffeo_calib.measurements.rows import RowGroups
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.placement import rigid_fit
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.coordinates import Beside, Places, check_shown, known_devices, sensor_of
from diffeo_calib.sensors.errors import Evaluation, Evaluations
from diffeo_calib.sensors.known_drift import KnownDrift
from diffeo_calib.sensors.tables import divided, measured_positions, rows_of_one_kind, with_points

LARGEST_ERROR_PER_REACH = 0.1
"""Median position errors above this fraction of the robot's reach are implausible."""
LARGEST_ERROR_PER_EXPECTED = 20.0
"""Median errors above this multiple of the error that the model itself expects are implausible."""
ROWS_AT_ONCE = 1024
MOST_EXPECTED = 100
"""Rows from which the typical expected error is found."""


@outside_inference_mode
def evaluate(kinematics: Callable[[Tensor], Tensor], data: Any) -> Evaluation | Evaluations:
    """Compare kinematics with measurements.

    Rows of one set-up of the fit are compared in its frame. Devices that a model does not know are placed on the rows,
    and the result says how many numbers that took: the frames of several set-ups, of a new one, or of positions beside
    a model that was calibrated without a measuring device; the devices of readings; the middles of sockets.

    Args:
        kinematics: (N, n) joint configurations -> (N, P, 3) marker positions in m in the measuring frame: a calibrated
            model, or the method ``points`` of a geometry. For measured poses: the three points that represent each.
        data: :class:`Measurements`, :class:`Readings` or :class:`Observations`.

    Returns:
        the errors of rows of one kind; of several kinds an evaluation for each, by name.

    Raises:
        InputError: arguments of another kind, another number of joints or markers, joints of the same names in another
            order, or poses on one side and points on the other.
        MeasurementError: too few rows of a set-up or device to place it, or a device or marker that moved far.

    Warns:
        DiffeoCalibWarning: errors of a model that no calibrated robot has, readings that no place of a device explains.
    """
    if not callable(kinematics) or isinstance(kinematics, Tree):
        expected = "a calibrated model or another function of joint values"
        raise InputError.of("`kinematics`", expected=expected, got=type(kinematics).__name__)
    if not isinstance(data, RowGroups):
        expected = "dc.Measurements, dc.Readings or Observations"
        raise InputError.of("`data`", expected=expected, got=type(data).__name__)
    places = place(kinematics, data)
    found = residuals(kinematics, places, data)
    if isinstance(kinematics, CalibratedKinematics):
        doubt = judged(kinematics, places, data, found, usual=False)
        if doubt.moved:
            raise MeasurementError(doubt.refusal)
        if doubt.refusal is not None:
            warn_user(doubt.refusal)
    return replace(found.main, placed=found.placed, numbers=found.numbers) if len(found) == 1 else found


def residuals(kinematics: Callable[[Tensor], Tensor], places: Places, data: Any) -> Evaluations:
    """Measured minus predicted values of every row, kind by kind, each in the unit of its device.

    Kinematics and errors as of :func:`evaluate`; places of the devices as :func:`place` finds them.
    """
    found = [
        (sensor_of(table).errors(table, _predicted(kinematics, table), places), rows)
        for table, rows in rows_of_one_kind(data)
    ]
    return Evaluations.of(found, places.found, places.numbers)


def check_rows(kinematics: Callable[[Tensor], Tensor], data: Any) -> None:
    """Refuse rows of other joints, tips and kinds than those of a calibrated model, and rows that show no error."""
    check_shown(data)
    if isinstance(kinematics, CalibratedKinematics):
        check_same_robot(kinematics, data)
        for table, _ in rows_of_one_kind(data):
            sensor_of(table).check(table, kinematics)


def place(kinematics: Callable[[Tensor], Tensor], data: Any, *, every_session: bool = False) -> Places:
    """Place what a model does not know on the rows of a table: frames of set-ups, devices of readings.

    Rows of a single set-up are placed only with ``every_session``; by default they are in the model's frame.

    Raises:
        InputError: rows that a model cannot be compared with, or joints in another order.
        MeasurementError: too few rows of a set-up or device, or readings that no place of it explains.
    """
    check_rows(kinematics, data)
    model = kinematics if isinstance(kinematics, CalibratedKinematics) else None
    known = {"unplaced": model is not None and model.own_frame, "every_session": every_session}
    turns, parts = None if model is None else model.turns, rows_of_one_kind(data)
    beside = Beside(partial(_predicted, kinematics), known_devices(kinematics), turns, **known)
    found = Places(ball=len(parts) > 1 if model is None else model.ball)
    for table, _ in parts:
        found = found.beside(sensor_of(table).place(table, beside))
    drift = KnownDrift.of(kinematics)
    sentences = [f"{found.numbers} numbers in all were found from the rows that are judged"] * (found.numbers > 0)
    sentences += [] if drift is None else drift.in_rows(data)
    return replace(found, found=(*found.found, *sentences))


def placement_sentences(model: object) -> list[str]:
    """Where the devices are that a model knows, with deviations; none for other kinematics."""
    drift = KnownDrift.of(model)
    lines = [line for own in getattr(model, "placement", None) or () for line in own.sentences()]
    return lines if drift is None else [*lines, *drift.of_joints()]


def at_payloads(kinematics: Callable[[Tensor], Tensor], data: Any) -> Callable[[Tensor], Tensor]:
    """Kinematics at some rows, each under its payload; those that are no calibrated models know no payload and stay."""
    return kinematics.at_payloads(data.payload) if isinstance(kinematics, CalibratedKinematics) else kinematics


def _predicted(kinematics: Callable[[Tensor], Tensor], data: Any) -> Tensor:
    """(N, P, 3) markers of kinematics under the payloads of the rows, and where a drift moved them, m."""
    own, drift = at_payloads(kinematics, data), KnownDrift.of(kinematics)
    return own(data.q).detach() if drift is None else drift.points(own, data)


def rows_used_in_fit(model: CalibratedKinematics, q: object) -> Tensor:
    """Which configurations (N, n), rad or m, the model was fitted to, up to the rounding of files: (N,) boolean.

    Raises:
        InputError: not a calibrated model, wrong shape, or values that are not finite.
    """
    fitted = fitted_configurations(model)
    blocks = model.robot.joint_values(q).detach().split(ROWS_AT_ONCE)  # pyright: ignore[reportArgumentType]
    return torch.cat([torch.cdist(block, fitted, p=inf).amin(1) < SAME_CONFIGURATION for block in blocks])


def unseen(model: CalibratedKinematics, q: Tensor) -> Tensor:
    """(N,) which configurations took no part in the fit, nor in a registration."""
    new = ~rows_used_in_fit(model, q)
    if model.registration is not None:
        new &= torch.cdist(q, model.registration.q.to(q), p=inf).amin(1) > SAME_CONFIGURATION
    return new.to(HOST)


def rows_of_other_frames(model: CalibratedKinematics, q: Tensor) -> int:
    """How many of the configurations (N, n) were fitted in another session than that of the model's measuring frame.

    All rows of a registered model are in other frames, and models of old files do not know: none is counted.
    """
    if model.registration is not None:
        return 0
    rows = [own.rows[own.elsewhere.to(HOST)[own.device]].to(q.device) for own in model.placement]
    elsewhere = model.configurations[torch.cat(rows)] if rows else model.configurations[:0]
    return int((torch.cdist(q.to(elsewhere), elsewhere, p=torch.inf) < SAME_CONFIGURATION).any(1).sum())


@dataclass(frozen=True)
class Judgement:
    """What errors of a model mean."""

    refusal: str | None = None  # why they say nothing about the robot; None if they do
    causes: Sequence[str] = ()  # likely causes of large errors
    moved: bool = False  # whether something that moved explains errors that say nothing


def judged(
    model: CalibratedKinematics, places: Places, data: Any, found: Evaluations, *, usual: bool = True
) -> Judgement:
    """Whether errors are those of a calibrated robot: something may have moved, or a unit is wrong.

    Args:
        model: a calibrated model. places, data, found: see :func:`residuals`.
        usual: whether to look at errors below a tenth of the robot's reach too.
    """
    impossible = LARGEST_ERROR_PER_REACH * model.robot.reach
    for table, _ in divided(data)[1]:
        away = sensor_of(table).away(table, _predicted(model, table), places).norm(dim=1)
        if (median := float(away.nanmedian())) > impossible:
            fix = "check the unit of the readings (--length), their columns (--reading), and the device of every row"
            fix += " (`device`, --session)"
            got = f"a median of {1e3 * median:.4g} mm at the ball"
            return Judgement(sentence("these errors are not those of a calibrated robot", got=got, fix=fix))
    seen = positions_of(model, places, data)
    if seen is None or found.positions is None or not (usual or found.positions.median > impossible):
        return Judgement()
    some, fix = some_rows(seen), "register the model first: `model.registered`, evaluate --free both"
    moved = [sentence(motion.sentence, fix=fix) for motion in motions(model, some)]
    causes = moved or [text for text in [implausible(model, some, found.positions)] if text is not None]
    if found.positions.median > impossible:
        return Judgement(" ".join(causes) or None, (), bool(moved))
    return Judgement(None, causes)


def some_rows(data: Measurements) -> Measurements:
    """Evenly chosen rows, so many as tell what moved."""
    return data.rows(slice(None, None, -(-len(data) // MOST_ROWS)))


def positions_of(model: CalibratedKinematics, places: Places, data: Any) -> Measurements | None:
    """The measured positions of a table in the frame of a model, with its markers; None if none was measured.

    A drift that the model knows is undone.
    """
    own, drift = measured_positions(data), KnownDrift.of(model)
    if own is None:
        return None
    own = places.aligned(own)
    return with_points(own if drift is None else drift.undone(own), model)


def implausible(model: CalibratedKinematics, data: Measurements, errors: Evaluation) -> str | None:
    """A sentence about errors that no calibrated robot has: expected and found median, what to check; else None."""
    largest = model.robot.reach * LARGEST_ERROR_PER_REACH
    found, options = expected(model, data), sensor_of(data).options
    medians = [(errors.median, _typical(found.places), 1e3, "mm", largest)]
    if errors.orientation is not None:
        turns = found.covariance[..., 3:, 3:]
        medians.append((radians(errors.orientation.median), _typical(turns), degrees(1.0), "degrees", inf))
    for median, usual, per_unit, unit, most in medians:
        if median > min(most, LARGEST_ERROR_PER_EXPECTED * usual):
            return sentence(
                "these errors are not those of a calibrated robot",
                expected=f"a median of about {per_unit * usual:.2g} {unit} by the model's own uncertainty",
                got=f"{per_unit * median:.3g} {unit}",
                fix=f"check `length` and `angle`, the order of the columns{options}, and that neither the measuring "
                "device nor the markers have moved: a model predicts in the measuring frame of its fit (if they "
                "have, register the model: `model.registered`, evaluate --free both; or recalibrate it)",
            )
    return None


def expected_error(model: CalibratedKinematics, data: Measurements) -> float:
    """Typical distance, m, between a new measurement and its prediction."""
    return _typical(expected(model, data).places)


def expected(model: CalibratedKinematics, data: Measurements) -> Predicted:
    """New measurements as a model predicts them at evenly spaced rows, at most :data:`MOST_EXPECTED`."""
    some = data.rows(slice(None, None, -(-len(data) // MOST_EXPECTED)))
    return model.bodies.predicted(model.at_payloads(some.payload), some.q)


def _typical(covariance: Tensor) -> float:
    """Median of the root of the traces of covariances (..., 3, 3)."""
    return float(covariance.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt().median())


# --- errors that are those of a moved device or a moved marker: the best motion, and how much it explains -------------

LEAST_EXPLAINED = 0.5
"""Part of the squared error, per degree of freedom, that a motion must explain."""
LEAST_EXCESS = 2.0
"""Errors below this multiple of the expected ones are not examined."""
MOST_LEFT = 5.0
"""Errors that remain may be this multiple of the expected ones: a wrong unit is no motion."""
AS_GOOD = 0.02
"""Motions that explain nearly as much as the best one are named, too."""
MOST_ROWS = 500
"""Rows that are looked at."""


class Motion(NamedTuple):
    """A motion that explains errors."""

    what: str  # "the measuring device" or "the marker"
    shift: float  # m, of the device at the middle of the rows
    turn: float  # rad, 0 for a marker
    explained: float  # part of the squared error
    left: Tensor  # (N, m) the errors that remain, m, NaN where hidden

    @property
    def sentence(self) -> str:
        """Such as ``moving the measuring device by 12.3 mm and 0.4 degrees explains 95 % of the squared error``."""
        turn = f" and {degrees(self.turn):.2g} degrees" if self.turn else ""
        share = f"explains {100 * self.explained:.4g} % of the squared error"
        return f"moving {self.what} by {1e3 * self.shift:.3g} mm{turn} {share}"


def motions(model: CalibratedKinematics, data: Measurements) -> list[Motion]:
    """The motions that explain most of a model's errors on rows of its markers, the best first; or none."""
    data, some = (data.rows(slice(None, None, -(-len(data) // most))) for most in (MOST_ROWS, MOST_EXPECTED))
    laden = model.at_payloads(data.payload)
    mean = laden(data.q).detach()
    covariance = model.at_payloads(some.payload).map.posterior(some.q)[1]
    usual = float(covariance.diagonal(dim1=1, dim2=2).mean(1).median())

    def size(errors: Tensor) -> float:
        """Median of the mean squares of the rows' known coordinates."""
        return float(errors.flatten(1).square().nanmean(1).median())

    if size(data.points - mean) < LEAST_EXCESS**2 * usual:
        return []
    found = [_device(mean, data.points), _marker(laden, data.q, (data.points - mean).flatten(1))]
    found = [each for each in found if size(each.left) < MOST_LEFT**2 * usual]
    least = max([LEAST_EXPLAINED, *(each.explained - AS_GOOD for each in found)])
    return sorted((each for each in found if each.explained >= least), key=lambda motion: -motion.explained)


def _device(predicted: Tensor, measured: Tensor) -> Motion:
    T = rigid_fit(predicted.flatten(0, 1), measured.flatten(0, 1))
    left = measured - predicted @ T[:3, :3].mT - T[:3, 3]
    shift = float((measured - predicted).nanmean((0, 1)).norm())
    turn = float(angle_between(torch.eye(3, dtype=T.dtype, device=T.device), T[:3, :3]))
    return Motion("the measuring device", shift, turn, _explained(measured - predicted, left, 6), left)


def _marker(model: CalibratedKinematics, q: Tensor, errors: Tensor) -> Motion:
    points = FlangePoints(model.nominal, model.geometry.tool, same=True)
    geodesic, seen = model.map.geodesic.with_nominal(points), ~errors.isnan()
    slopes = marker_slopes(geodesic, points, geodesic.linearise(q))  # (N, m, m)
    step = torch.linalg.lstsq(slopes[seen], errors[seen][:, None], driver="gelsd").solution[:, 0]
    left = errors - slopes @ step
    shift = step.view(-1, 3).norm(dim=1)
    what = f"{model.bodies.moved_words(len(shift))} on the flange"
    return Motion(what, float(shift.max()), 0.0, _explained(errors, left, len(step)), left)


def _explained(before: Tensor, after: Tensor, unknowns: int) -> float:
    """1 - mean square after / before, per degree of freedom."""
    count, left = int((~before.isnan()).sum()), float(after.square().nansum() / before.square().nansum())
    return 1.0 - left * count / (count - unknowns) if count > unknowns else 0.0
