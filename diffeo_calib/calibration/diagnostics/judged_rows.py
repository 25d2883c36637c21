"""Rows beside a finished model: are their errors those of a calibrated robot, and what explains them otherwise?

Explanations are asked in turn, the first that holds is named: joints of other lines, a device or marker that moved,
another reading of the table, a wrong unit, a block of wrong rows, single wrong rows, a change since the fit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import degrees, inf, radians
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.diagnostics.outliers import Outlier, contradicted, flagged
from diffeo_calib.calibration.diagnostics.plausibility import refuse_mistakes
from diffeo_calib.calibration.diagnostics.row_order import Step, find_block, out_of_step
from diffeo_calib.common.device import outside_inference_mode
from diffeo_calib.common.errors import InputError, MeasurementError, sentence, warn_user
from diffeo_calib.common.quantiles import known
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import place, positions_of, predicted_at, residuals
from diffeo_calib.kinematics.nominal import FlangePoints
from diffeo_calib.kinematics.registered_map import marker_slopes
from diffeo_calib.measurements.bodies import Predicted
from diffeo_calib.measurements.poses import angle_between
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.placement import rigid_fit
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.coordinates import Places, sensor_of
from diffeo_calib.sensors.errors import Evaluation, Evaluations
from diffeo_calib.sensors.tables import Coordinates, divided

MOST_ROWS, MOST_EXPECTED = 500, 100
"""Rows that are looked at, and those of them in which the typical expected error is found."""


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
    places = place(kinematics, data)
    errors = residuals(kinematics, places, data)
    if isinstance(kinematics, CalibratedKinematics):
        doubt = judge(kinematics, places, data, errors, usual=False)
        if doubt.moved:
            raise MeasurementError(doubt.refusal)
        if doubt.refusal is not None:
            warn_user(doubt.refusal)
    return replace(errors.main, placed=errors.placed, numbers=errors.numbers) if len(errors) == 1 else errors


@dataclass(frozen=True)
class Judgement:
    """What errors of a model mean."""

    refusal: str | None = None  # why they say nothing about the robot; None if they do
    causes: Sequence[str] = ()  # likely causes of large errors
    moved: bool = False  # whether something that moved explains errors that say nothing
    outliers: Sequence[Outlier] = ()  # positions that look wrong
    rows: int = 0  # evenly chosen ones among which these were sought


def judge(
    model: CalibratedKinematics, places: Places, data: Any, compared: Evaluations, *, usual: bool = True
) -> Judgement:
    """Name rows that look wrong, and likely causes of large errors.

    Args:
        model: a calibrated model. places, data, compared: see :func:`~diffeo_calib.kinematics.evaluation.residuals`.
        usual: whether to look at errors below a tenth of the robot's reach, and for wrong rows.

    Raises:
        MeasurementError: another reading of the table explains impossible errors.
    """
    impossible, errors = gates.LARGEST_PER_REACH * model.robot.reach, compared.positions
    measured = positions_of(model, places, data)
    some = None if measured is None or errors is None else _some(measured, MOST_ROWS)
    for step in steps_of(model, some) if usual and some is not None else ():
        return Judgement(step.sentence())
    for table, _ in divided(data)[1]:
        sensor = sensor_of(table)
        away = sensor.away(table, predicted_at(model, table), places).norm(dim=1)
        if (median := float(away.nanmedian())) > impossible:
            if usual and some is not None:
                refuse_mistakes(model.robot, some)
            got = f"a median of {1e3 * median:.4g} mm at the ball"
            return Judgement(sentence("these errors are not those of a calibrated robot", got=got, fix=sensor.advice))
    if some is None or errors is None or not (usual or errors.median > impossible):
        return Judgement()
    fix = "register the model first: `model.registered`, evaluate --free both"
    moved = [sentence(motion.sentence, fix=fix) for motion in motions(model, some)]
    causes = moved or [*filter(None, [implausible(model, some, errors)])]
    if errors.median > impossible:
        if usual and not moved:
            refuse_mistakes(model.robot, some)
        return Judgement(" ".join(causes), (), bool(moved))
    if causes or not usual:
        return Judgement(None, causes)
    wrong = contradicted(model, some)
    causes = [*filter(None, [block_text(model, some, wrong)])]
    claimed = expected_rms(model, some, errors.errors.shape[1])
    if not causes and not wrong and errors.rms >= gates.LARGE_PER_EXPECTED * claimed:
        what = f"the errors are {errors.rms / claimed:.1f} times as large as the model expects: "
        fix = "something has changed since the fit, or these poses are unlike those of the fit: compare, or recalibrate"
        size = f"RMS {1e3 * errors.rms:.3f} mm"
        causes = [sentence(what + size, expected=f"about {1e3 * claimed:.3f} mm", fix=fix)]
    return Judgement(None, causes, outliers=wrong, rows=len(some))


def check_errors(model: CalibratedKinematics, evaluation: Evaluation, usual: float) -> None:
    """Raise MeasurementError if so many positions are far from a model that it holds for a part of the rows alone.

    Args:
        model: the fitted model. evaluation: errors of positions, of rows that were held out if there are any.
        usual: median error of the rows of the fit after a geometric calibration, m.
    """
    reach = model.robot.reach
    limit = min(max(gates.LARGE_PER_REACH * reach, gates.LARGE_PER_USUAL * usual), gates.LARGEST_PER_REACH * reach)
    share = float((known(evaluation.errors) > limit).double().mean())
    if share > gates.MOST_LARGE:
        raise MeasurementError.of(
            f"{100 * share:.0f} % of the judged positions are more than {1e3 * limit:.3g} mm from the model",
            expected="errors of a calibrated robot",
            got=f"an RMS error of {1e3 * evaluation.rms:.4g} mm",
            fix="did device, robot or tool move between rows? Name the set-ups (`session`); the model that was written "
            "holds for a part of the rows at most",
        )


def implausible(model: CalibratedKinematics, data: Measurements, errors: Evaluation) -> str | None:
    """A sentence about errors that no calibrated robot has: expected and found median, what to check; else None."""
    predicted, options = _expected(model, data), sensor_of(data).options
    largest = model.robot.reach * gates.LARGEST_PER_REACH
    medians = [(errors.median, float(predicted.claimed.median()), 1e3, "mm", largest)]
    if errors.orientation is not None:
        turns = predicted.covariance[..., 3:, 3:].diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
        medians.append((radians(errors.orientation.median), float(turns.median()), degrees(1.0), "degrees", inf))
    for median, usual, per_unit, unit, most in medians:
        if median > min(most, gates.LARGEST_PER_EXPECTED * usual):
            return sentence(
                "these errors are not those of a calibrated robot",
                expected=f"a median of about {per_unit * usual:.2g} {unit} by the model's own uncertainty",
                got=f"{per_unit * median:.3g} {unit}",
                fix=f"check `length` and `angle`, the order of the columns{options}, and that neither the measuring "
                "device nor the markers have moved: a model predicts in the measuring frame of its fit (if they "
                "have, register the model: `model.registered`, evaluate --free both; or recalibrate it)",
            )
    return None


def _some(data: Measurements, most: int) -> Measurements:
    """Evenly chosen rows, as many as tell enough."""
    return data.rows(slice(None, None, -(-len(data) // most)))


def _expected(model: CalibratedKinematics, data: Measurements) -> Predicted:
    """New measurements as a model predicts them at some rows."""
    some = _some(data, MOST_EXPECTED)
    return model.bodies.predicted(model.at_payloads(some.payload), some.q)


def expected_rms(model: CalibratedKinematics, data: Measurements, bodies: int) -> float:
    """RMS distance, m, between new measurements and predictions that a model expects of the poses of some rows.

    Args:
        model: a calibrated model. data: its markers. bodies: how many of them, or of its frames, a device measured.
    """
    return float(_expected(model, data).claimed[:, :bodies].square().mean().sqrt())


# --- rows that are wrong together -------------------------------------------------------------------------------------


def steps_of(model: CalibratedKinematics, data: Measurements) -> list[Step]:
    """Rows whose measured values belong to the joints of other lines, judged by a model."""
    predicted = model.at_payloads(data.payload)(data.q).detach()
    typical = float(_expected(model, data).claimed.median())
    return out_of_step(predicted, data.points, data.line_numbers, typical)


def block_text(model: CalibratedKinematics, data: Measurements, wrong: Sequence[Outlier]) -> str | None:
    """One sentence about wrong rows that follow one another, with their common cause if there is one; else None."""
    order = data.line_numbers.argsort()
    flags = flagged(len(data), [outlier.row for outlier in wrong])[order]
    span = find_block(flags)
    if span is None:
        return None
    start, end = span
    block = data.rows(order[start:end])
    lines, last = block.line_numbers.tolist(), " to the end of the table" * (end == len(data))
    size = float((model.at_payloads(block.payload)(block.q) - block.points).norm(dim=-1).nanmedian())
    why = ", ".join(cause.sentence for cause in motions(model, block))
    return sentence(
        f"{int(flags[start:end].sum())} rows look wrong that follow one another: lines {lines[0]} to {lines[-1]}{last}",
        got=f"a median error of {1e3 * size:.3g} mm{f'; {why}' if why else ', for no common reason'}",
        fix="check what happened there; calibrate without these lines, or measure them again",
    )


def common_cause(
    model: CalibratedKinematics, data: Measurements, wrong: Sequence[Outlier], moved: str | None = None
) -> str | None:
    """The best explanation of several wrong rows: they are out of step, something moved, they follow one another.

    Args:
        moved: a sentence about something that moved, which explains wrong rows after it.
    """
    steps = steps_of(model, data) if len(wrong) >= gates.LAG_ROWS else []
    return steps[0].sentence() if steps else moved or block_text(model, data, wrong)


def warn_of_contradictions(
    model: CalibratedKinematics, coordinates: Coordinates | None, wrong: Sequence[Outlier], moved: str | None
) -> None:
    """Warn of the best explanation of wrong rows of a fit, see :func:`common_cause`.

    Args:
        model: the fitted model. coordinates: its rows that tell coordinates. wrong: the outliers among all rows.
    """
    if coordinates is not None:
        numbers = {row: number for number, row in enumerate(coordinates.rows.tolist())}
        wrong = [replace(outlier, row=numbers[outlier.row]) for outlier in wrong if outlier.row in numbers]
        moved = common_cause(model, coordinates.table, wrong, moved)
    if moved is not None:
        warn_user(moved)


# --- a moved device or a moved marker: the best motion, and how much of the errors it explains ------------------------


class Motion(NamedTuple):
    """A motion that explains a part of the squared error, and errors (N, P, 3) that remain, m, NaN where hidden."""

    what: str  # "the measuring device" or "the marker"
    size: str
    left: Tensor
    explained: float

    @property
    def sentence(self) -> str:
        """Such as ``moving the measuring device by 12.3 mm and 0.4 degrees explains 95 % of the squared error``."""
        return f"moving {self.what} by {self.size} explains {100 * self.explained:.4g} % of the squared error"


def motions(model: CalibratedKinematics, data: Measurements) -> list[Motion]:
    """The motions that explain most of a model's errors on rows of its markers, the best first; or none."""
    data, some = _some(data, MOST_ROWS), _some(data, MOST_EXPECTED)
    laden = model.at_payloads(data.payload)
    errors = data.points - laden(data.q).detach()
    covariance = model.at_payloads(some.payload).map.posterior(some.q)[1]
    usual, count = float(covariance.diagonal(dim1=1, dim2=2).mean(1).median()), int((~errors.isnan()).sum())

    def size(errors: Tensor) -> float:
        """Median of the mean squares of the rows' known coordinates."""
        return float(errors.flatten(1).square().nanmean(1).median())

    if size(errors) < gates.LEAST_EXCESS**2 * usual:
        return []
    likely = list[Motion]()
    for what, by, left, unknowns in (_of_device(data.points, errors), _of_markers(laden, data.q, errors)):
        freedom = count - unknowns
        share = float(left.square().nansum() / errors.square().nansum()) * count / freedom if freedom > 0 else 1.0
        if size(left) < gates.MOST_LEFT**2 * usual:
            likely.append(Motion(what, by, left, 1.0 - share))
    least = max([gates.LEAST_EXPLAINED, *(each.explained - gates.AS_GOOD for each in likely)])
    return sorted((each for each in likely if each.explained >= least), key=lambda motion: -motion.explained)


def _of_device(measured: Tensor, errors: Tensor) -> tuple[str, str, Tensor, int]:
    """What moves, by how much, the errors that remain, and the count of unknowns."""
    predicted = measured - errors
    T = rigid_fit(predicted.flatten(0, 1), measured.flatten(0, 1))
    turn = float(angle_between(torch.eye(3, dtype=T.dtype, device=T.device), T[:3, :3]))
    by = f"{1e3 * float(errors.nanmean((0, 1)).norm()):.3g} mm" + f" and {degrees(turn):.2g} degrees" * bool(turn)
    return "the measuring device", by, measured - predicted @ T[:3, :3].mT - T[:3, 3], 6


def _of_markers(model: CalibratedKinematics, q: Tensor, errors: Tensor) -> tuple[str, str, Tensor, int]:
    points = FlangePoints(model.nominal, model.geometry.tool, same=True)
    geodesic, away, visible = model.map.geodesic.with_nominal(points), errors.flatten(1), ~errors.flatten(1).isnan()
    slopes = marker_slopes(geodesic, points, geodesic.linearise(q))  # (N, m, m)
    step = torch.linalg.lstsq(slopes[visible], away[visible][:, None], driver="gelsd").solution[:, 0]
    shift = step.view(-1, 3).norm(dim=1)
    what = f"{model.bodies.moved_words(len(shift))} on the flange"
    return what, f"{1e3 * float(shift.max()):.3g} mm", (away - slopes @ step).view_as(errors), len(step)
