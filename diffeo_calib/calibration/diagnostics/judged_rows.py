"""Rows beside a model: which of them look wrong, why, and whether their errors are those of a calibrated robot.

Explanations are asked in turn, the first that holds is named: joints of other lines, a device or marker that moved,
another reading of the table, a wrong unit, a block of wrong rows, single wrong rows, a change since the fit.

A column in which a device reports one value may be right: the height of a planar robot, the gauge of a ball that
touches a surface. It is wrong where the robot moves what the column tells.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import degrees, inf, log, radians
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.diagnostics.likely_mistakes import Step, best_run, out_of_step
from diffeo_calib.calibration.diagnostics.plausibility import refuse_mistakes
from diffeo_calib.calibration.identification.registration import spread
from diffeo_calib.calibration.scales.leave_one_out import LeaveOneOut
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.device import HOST, outside_inference_mode
from diffeo_calib.common.errors import MOST_NAMES, InputError, MeasurementError, few, printable, sentence, warn_user
from diffeo_calib.common.quantiles import above_estimated, chi2_above, chi2_median, known, largest_known
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import place, positions_of, predicted_at, residuals
from diffeo_calib.kinematics.nominal import FlangePoints
from diffeo_calib.kinematics.registered_map import marker_slopes
from diffeo_calib.measurements.bodies import Predicted
from diffeo_calib.measurements.poses import angle_between
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.placement import rigid_fit
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.coordinates import Places, errors_of_kinds, sensor_of
from diffeo_calib.sensors.errors import Evaluation, Evaluations
from diffeo_calib.sensors.kinds import divided

FAR = "far from where the other rows predict it"
MAX_MARKERS_FOR_EXCHANGE, MOST_OUTLIERS = 12, 10
"""Number of markers up to which exchanged pairs are looked for, and most lines about single rows."""
MOST_ROWS, MOST_EXPECTED = 500, 100
"""Rows that are looked at, and those of them in which the typical expected error is found."""
OF_DEVIATIONS = "std_"  # prefix of columns of known standard deviations, which may well be equal


@dataclass(frozen=True)
class Outlier:
    """A measurement that deviates from its prediction by more than noise explains.

    Args:
        row: number of the row in the measurements.
        marker: number of the marker; None if there is only one, or if poses were measured.
        number: line of the row in its file, see :attr:`Measurements.line_numbers`. name: of the row, in words.
        distance: from its prediction by all other rows, m; of readings in m at the tool.
        weight: its weight in the fit, about 1 for inliers; None if it took no part in the fit.
        reason: probable cause, in words.
        tip: name of the tip, of poses on several; else None.
        reading: what a reading is off by in its own unit, and this unit; None for measured positions.
    """

    row: int
    marker: int | None
    number: int
    name: str
    distance: float
    weight: float | None
    reason: str
    tip: str | None = None
    reading: tuple[float, str] | None = None

    @property
    def shown(self) -> tuple[float, str]:
        """Size of the error, and its unit."""
        return self.reading or (1e3 * self.distance, "mm")


def outlier_lines(outliers: Sequence[Outlier], rows: int, what: str = "training rows") -> Iterator[str]:
    """Sentences about rows that look wrong, the worst first; ``what`` the ``rows`` are."""
    if outliers:
        kept, count = "" if outliers[0].weight is None else "; none was dropped", len({each.row for each in outliers})
        yield f"{count} of {rows} {what} look wrong (numbers are lines of the file){kept}:"
    for outlier in outliers[:MOST_OUTLIERS]:
        marker = "" if outlier.marker is None else f", marker {outlier.marker}"
        marker = f", {printable(outlier.tip)}" if outlier.tip is not None else marker
        weight = "" if outlier.weight is None else f", weight {outlier.weight:.2g}"
        size, unit = outlier.shown
        yield f"  {printable(outlier.name)}{marker}: {size:.3f} {unit} off{weight}; {outlier.reason}"
    if len(outliers) > MOST_OUTLIERS:
        yield f"  and {len(outliers) - MOST_OUTLIERS} more"


def excluded(
    squares: Tensor, freedom: Tensor, *, least: float = 1.0, factor: float = 1.0, by_others: bool = True
) -> Tensor:
    """Which squared distances (N, bodies) are too large by chance, or beside most of the others.

    In units of a variance that is estimated from n numbers, the largest square of clean rows is that of an F ratio and
    not of chi-squared: twice as large with n = 30. Their median knows the variance half as well as all of them.

    Args:
        freedom: (N, bodies) of each. least: smallest size of the errors in units of what the model expects.
        factor: by which an error must exceed what chance explains. by_others: whether the others tell how large errors
            are, and not the model.
    """
    present, level = ~squares.isnan(), gates.OUTLIER_CHANCE / len(known(squares))
    kinds = freedom[present].unique().tolist()
    size = torch.cat([squares[present & (freedom == k)] / chi2_median(k) for k in kinds]).median()
    lower, limits = gates.MEDIAN_EFFICIENCY * float(freedom[present].sum()), torch.zeros_like(squares)
    for k in kinds:
        limits[freedom == k] = above_estimated(level, k, lower) if by_others else chi2_above(level, k)
    return squares > factor**2 * size.clamp(min=least) * limits


def outliers(
    model: CalibratedKinematics, placed: Any, tangent_data: TangentData, left_out: LeaveOneOut, least: float = 1.0
) -> list[Outlier]:
    """Measurements further from their prediction than noise explains, the worst first.

    Args:
        model: the calibrated model, which helps to find the causes.
        placed: the rows, as :func:`placing.place.place` finds them. tangent_data: the same, with their weights.
        left_out: their leave-one-out errors. least: see :func:`excluded`.
    """
    noise, weights, squares = tangent_data.noise_model, tangent_data.tails.weights, left_out.squares
    bad = excluded(squares, noise.of_freedom(float, squares), least=least)
    each = left_out.errors.unflatten(1, (noise.bodies, -1))
    distances = each.nan_to_num(0.0).norm(dim=2) if noise.size % 3 else each.unflatten(2, (-1, 3)).mean(2).norm(dim=2)
    outlying = []
    if placed.coordinates is not None:
        table, rows = placed.coordinates
        suspects = found_outliers(model, table, bad[rows], distances[rows], weights[rows])
        outlying += [replace(outlier, row=int(rows[outlier.row])) for outlier in suspects]
    for kind in placed.readings:
        data, sizes = kind.data, each[kind.rows, 0].nan_to_num(0.0).norm(dim=1).tolist()
        shown = errors_of_kinds(left_out.errors, None, [kind]).main
        unit, per_unit = shown.shown
        for k in bad[kind.rows, 0].nonzero()[:, 0].tolist():
            row, reading = int(kind.rows[k]), (per_unit * float(shown.errors[k, 0]), unit)
            of_row = row, None, int(data.line_numbers[k]), data.row_names[k], sizes[k], float(weights[row, 0])
            outlying.append(Outlier(*of_row, FAR, reading=reading))
    return sorted(outlying, key=lambda outlier: -outlier.distance)


def contradicted(model: CalibratedKinematics, data: Measurements) -> list[Outlier]:
    """Measurements that took no part in a fit and that its model excludes, the worst first.

    Their distances are judged by the model's own deviations, or by the median distance if the model is overconfident.
    """
    predicted = data.bodies.predicted(model.at_payloads(data.payload), data.q)
    errors = data.bodies.errors(data, predicted.points)  # (N, bodies, 3 or 6) m and rad, NaN for hidden markers
    squares = (errors * torch.linalg.solve(predicted.covariance, errors[..., None])[..., 0]).sum(-1)
    freedom = torch.full_like(squares, errors.shape[-1])
    bad = excluded(squares, freedom, factor=gates.OVERCONFIDENT, by_others=False)
    return found_outliers(model, data, bad, errors[..., :3].norm(dim=-1))


def found_outliers(
    model: CalibratedKinematics, data: Measurements, bad: Tensor, distances: Tensor, weights: Tensor | None = None
) -> list[Outlier]:
    """Wrong measurements with their probable causes, the worst first.

    Args:
        model: the calibrated model. data: the measurements. bad: (N, bodies) which of them are wrong.
        distances: (N, bodies) from their predictions, m. weights: (N, bodies) in the fit, if they took part in it.
    """
    if not bool(bad.any()):
        return []
    labels = data.bodies.labels(data, model.on)
    data = data if labels[0][1] is None else data.with_tips([str(tip) for _, tip in labels])
    predicted, outlying, names = model.at_payloads(data.payload)(data.q).detach(), list[Outlier](), data.row_names
    for row, body in bad.nonzero().tolist():
        (marker, tip), weight = labels[body], None if weights is None else float(weights[row, body])
        reason, line = _reason(row, body, data, predicted, bad), int(data.line_numbers[row])
        outlying.append(Outlier(row, marker, line, names[row], float(distances[row, body]), weight, reason, tip))
    return sorted(outlying, key=lambda outlier: -outlier.distance)


def _reason(row: int, body: int, data: Measurements, predicted: Tensor, bad: Tensor) -> str:
    """Probable cause of an outlier, in words."""
    small = gates.REMAINING_ERROR * float(known((predicted[row] - data.points[row]).norm(dim=-1)).max())
    for other in data.bodies.exchangeable(data) if data.seen_bodies.shape[1] <= MAX_MARKERS_FOR_EXCHANGE else ():
        errors = (predicted[row, [body, other]] - data.points[row, [other, body]]).norm(dim=-1)
        if other != body and float(errors.max()) < small:
            return f"markers {body} and {other} seem to be exchanged"
    others = [k for k in range(bad.shape[1]) if k != body and bool(data.seen_bodies[row, k])]
    if others and not bool(bad[row, others].any()):
        return f"{data.body_names[body]} alone is off, the other {data.bodies.many} of this row fit"
    elsewhere = largest_known((predicted - data.points[row]).norm(dim=-1))
    elsewhere[row] = torch.inf
    nearest = int(elsewhere.argmin())
    if float(elsewhere[nearest]) < small:
        return f"fits the configuration of row {int(data.line_numbers[nearest])}: a wrong pairing?"
    return FAR


# --- devices and columns ----------------------------------------------------------------------------------------------


def _device_rows(data: Any) -> Iterator[tuple[str, Tensor, Any]]:
    """The rows of any table by kind and device, in words, their numbers (M,), and they; those in sockets together."""
    for part, numbers in zip(data.parts, data.index, strict=True):
        names = [name * (place < 0) for name, place in zip(part.device_names, part.places.tolist(), strict=True)]
        for name in dict.fromkeys(names):
            rows = [row for row, other in enumerate(names) if other == name]
            yield f"{part.kind}s" + f" of '{name}'" * bool(name), numbers[rows], part.rows(rows)


def stuck_columns(data: Any) -> Iterator[tuple[str, Tensor]]:
    """Columns of any table in which a device reports one value in all rows where it reports any, and these rows."""
    for words, rows, table in _device_rows(data):
        for name, values in table.measured().items():
            if isinstance(values, Tensor) and not name.startswith(OF_DEVIATIONS):
                present = ~values.isnan()
                if int(present.sum()) >= gates.STUCK_ROWS and bool((values[present] == values[present][0]).all()):
                    yield f"'{name}' of the {words}", rows[present.to(rows.device)]


def warn_of_stuck(data: TangentData, table: Any) -> None:
    """Warn of columns of one value although the robot moves what they tell, by the geometric calibration."""
    size, shape = spread(data.points.unflatten(1, (-1, 3))), (data.noise_model.bodies, -1)
    for column, numbers in stuck_columns(table):
        rows = numbers.to(data.values.device)
        values, visible = data.values[rows].unflatten(1, shape), data.visible[rows].unflatten(1, shape)  # (M, P, r) m
        bodies = [values[:, body, flags] for body, flags in enumerate(visible.all(0)) if bool(flags.any())]
        spreads = [float(torch.linalg.svdvals(body - body.mean(0))[-1]) for body in bodies]
        least = min(spreads, default=0.0) / len(rows) ** 0.5  # RMS motion along any direction, m
        if least > gates.GEOMETRIC_RESIDUAL * size:
            expected = f"values that change by {1e3 * least:.3g} mm or more, as the robot moves"
            what, fix = f"{column} holds one value in all of its rows", "check the sensor and the column, or leave "
            warn_user(sentence(what, expected=expected, fix=fix + "these rows out"))


def warn_of_outliers(outlying: Sequence[Outlier], data: Any) -> None:
    """Warn if so many rows of a table, or of one device, are outliers that the inliers may be the wrong ones."""
    flags, parts = flagged(len(data), outlying), [("rows", torch.arange(len(data), device=HOST))]
    parts += [(words, rows) for words, rows, _ in _device_rows(data)]
    many = [(words, rows) for words, rows in parts if float(flags[rows].double().mean()) > gates.GROSS_SHARE]
    if many:
        many = many[:1] if many[0][0] == "rows" else many
        counts = few([f"{int(flags[rows].sum())} of {len(rows)} {words}" for words, rows in many], MOST_NAMES)
        fix = "do not rely on these rows: check that they pair joints with their own points, that markers keep their "
        fix += "numbers, the columns and units; of a set-up, whether more has moved than was said: leave it out, and "
        fix += "recalibrate the model with its rows alone, which finds both device and markers"
        expected, got = f"at most {100 * gates.GROSS_SHARE:.0f} %", f"for the worst row: {outlying[0].reason}"
        warn_user(sentence(f"{counts} are outliers", expected=expected, got=got, fix=fix))


def flagged(count: int, outlying: Sequence[Outlier]) -> Tensor:
    """(N,) boolean, true in the rows of outliers."""
    flags = torch.zeros(count, dtype=torch.bool, device=HOST)
    flags[[outlier.row for outlier in outlying]] = True
    return flags


# --- errors of rows that took no part in a fit ------------------------------------------------------------------------


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


class Judgement(NamedTuple):
    """What errors of a model mean: why they say nothing about the robot, or likely causes of large ones.

    Args:
        moved: whether something that moved explains errors that say nothing. outliers: positions that look wrong.
        rows: how many, evenly chosen, among which these were sought.
    """

    refusal: str | None = None
    causes: Sequence[str] = ()
    moved: bool = False
    outliers: Sequence[Outlier] = ()
    rows: int = 0


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
    moved = [sentence(motion, fix=fix) for motion in motions(model, some)]
    causes = moved or [*filter(None, [implausible(model, some, errors)])]
    if errors.median > impossible:
        if usual and not moved:
            refuse_mistakes(model.robot, some)
        return Judgement(" ".join(causes), (), bool(moved))
    if causes or not usual:
        return Judgement(None, causes)
    wrong = contradicted(model, some)
    causes = [*filter(None, [block_text(model, some, flagged(len(some), wrong))])]
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
        what = f"{100 * share:.0f} % of the judged positions are more than {1e3 * limit:.3g} mm from the model"
        fix = "did device, robot or tool move between rows? Name the set-ups (`session`); the model that was written "
        got, fix = f"an RMS error of {1e3 * evaluation.rms:.4g} mm", fix + "holds for a part of the rows at most"
        raise MeasurementError.of(what, expected="errors of a calibrated robot", got=got, fix=fix)


def implausible(model: CalibratedKinematics, data: Measurements, errors: Evaluation) -> str | None:
    """A sentence about errors that no calibrated robot has: expected and found median, what to check; else None."""
    predicted, most = _expected(model, data), model.robot.reach * gates.LARGEST_PER_REACH
    medians = [(errors.median, float(predicted.claimed.median()), 1e3, "mm", most)]
    if errors.orientation is not None:
        turns = predicted.covariance[..., 3:, 3:].diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
        medians.append((radians(errors.orientation.median), float(turns.median()), degrees(1.0), "degrees", inf))
    for median, usual, per_unit, unit, largest in medians:
        if median > min(largest, gates.LARGEST_PER_EXPECTED * usual):
            expected = f"a median of about {per_unit * usual:.2g} {unit} by the model's own uncertainty"
            fix = f"check `length` and `angle`, the order of the columns{sensor_of(data).options}, and that neither "
            fix += "device nor markers have moved: a model predicts in the measuring frame of its fit (if they have, "
            fix += "register the model: `model.registered`, evaluate --free both; or recalibrate it)"
            what, got = "these errors are not those of a calibrated robot", f"{per_unit * median:.3g} {unit}"
            return sentence(what, expected=expected, got=got, fix=fix)
    return None


def _some(data: Measurements, most: int) -> Measurements:
    """Evenly chosen rows, as many as tell enough."""
    return data.rows(slice(None, None, -(-len(data) // most)))


def _expected(model: CalibratedKinematics, data: Measurements) -> Predicted:
    """New measurements as a model predicts them at some rows."""
    some = _some(data, MOST_EXPECTED)
    return model.bodies.predicted(model.at_payloads(some.payload), some.q)


def expected_rms(model: CalibratedKinematics, data: Measurements, bodies: int) -> float:
    """RMS distance, m, that a model expects at some rows, of the first markers or frames, which a device measured."""
    return float(_expected(model, data).claimed[:, :bodies].square().mean().sqrt())


# --- rows that are wrong together -------------------------------------------------------------------------------------


def steps_of(model: CalibratedKinematics, data: Measurements) -> list[Step]:
    """Rows whose measured values belong to the joints of other lines, judged by a model."""
    predicted = model.at_payloads(data.payload)(data.q).detach()
    typical = float(_expected(model, data).claimed.median())
    return out_of_step(predicted, data.points, data.line_numbers, typical)


def find_block(wrong: Tensor) -> tuple[int, int] | None:
    """First and last + 1 of the rows (N,), in order, where wrong ones follow one another beyond chance; or None.

    The segment with the largest likelihood ratio of ``gates.BLOCK_SHARE`` against the overall share (S. Karlin,
    S. Altschul, "Methods for assessing the statistical significance of molecular sequence features", 1990).
    """
    count, n = int(wrong.sum()), len(wrong)
    share = count / n
    if count < gates.BLOCK_ROWS or share >= gates.BLOCK_SHARE:
        return None
    gain, loss = log(gates.BLOCK_SHARE / share), log((1 - gates.BLOCK_SHARE) / (1 - share))
    total, start, end = best_run(torch.where(wrong, gain, loss))
    return (start, end) if total > log(n / gates.BLOCK_CHANCE) else None


def block_text(model: CalibratedKinematics, data: Measurements, wrong: Tensor) -> str | None:
    """One sentence about rows, wrong by flags (N,), that follow one another, with their common cause; else None."""
    order = data.line_numbers.argsort()
    if (span := find_block(flags := wrong[order])) is None:
        return None
    start, end = span
    block = data.rows(order[start:end])
    lines, last = block.line_numbers.tolist(), " to the end of the table" * (end == len(data))
    size = float((model.at_payloads(block.payload)(block.q) - block.points).norm(dim=-1).nanmedian())
    count, where = int(flags[start:end].sum()), f"lines {lines[0]} to {lines[-1]}{last}"
    got = f"a median error of {1e3 * size:.3g} mm; {', '.join(motions(model, block)) or 'for no common reason'}"
    fix = "check what happened there; calibrate without these lines, or measure them again"
    return sentence(f"{count} rows look wrong that follow one another: {where}", got=got, fix=fix)


def common_cause(
    model: CalibratedKinematics, data: Measurements, wrong: Tensor, moved: str | None = None
) -> str | None:
    """The best explanation of wrong rows, flags (N,): out of step, ``moved`` by what a sentence says, or a block."""
    steps = steps_of(model, data) if int(wrong.sum()) >= gates.LAG_ROWS else []
    return steps[0].sentence() if steps else moved or block_text(model, data, wrong)


def motions(model: CalibratedKinematics, data: Measurements) -> list[str]:
    """The motions of device or markers that explain most of a model's errors on rows, in words, the best first.

    Such as ``moving the measuring device by 12.3 mm and 0.4 degrees explains 95 % of the squared error``.
    """
    data, some = _some(data, MOST_ROWS), _some(data, MOST_EXPECTED)
    laden, eye = model.at_payloads(data.payload), torch.eye(3, dtype=data.q.dtype, device=data.q.device)
    predicted = laden(data.q).detach()
    errors = data.points - predicted
    covariance = model.at_payloads(some.payload).map.posterior(some.q)[1]
    usual, visible = float(covariance.diagonal(dim1=1, dim2=2).mean(1).median()), ~errors.flatten(1).isnan()

    def size(errors: Tensor) -> float:
        """Median of the mean squares of the rows' known coordinates."""
        return float(errors.flatten(1).square().nanmean(1).median())

    if size(errors) < gates.LEAST_EXCESS**2 * usual:
        return []
    T = rigid_fit(predicted.flatten(0, 1), data.points.flatten(0, 1))
    turn = degrees(float(angle_between(eye, T[:3, :3])))
    by = f"{1e3 * float(errors.nanmean((0, 1)).norm()):.3g} mm" + f" and {turn:.2g} degrees" * bool(turn)
    left = {f"the measuring device by {by}": (data.points - predicted @ T[:3, :3].mT - T[:3, 3], 6)}
    points = FlangePoints(laden.nominal, laden.geometry.tool, same=True)
    geodesic = laden.map.geodesic.with_nominal(points)
    slopes = marker_slopes(geodesic, points, geodesic.linearise(data.q))  # (N, m, m)
    target = errors.flatten(1)[visible][:, None]
    step = torch.linalg.lstsq(slopes[visible], target, driver="gelsd").solution[:, 0]
    shifts = step.view(-1, 3).norm(dim=1)
    words = f"{laden.bodies.moved_words(len(shifts))} on the flange by {1e3 * float(shifts.max()):.3g} mm"
    left[words] = errors - (slopes @ step).view_as(errors), len(step)
    explained, count = dict[str, float](), int(visible.sum())
    for words, (after, unknowns) in left.items():
        part = float(after.square().nansum() / errors.square().nansum()) * count / max(count - unknowns, 1e-9)
        if size(after) < gates.MOST_LEFT**2 * usual:
            explained[f"moving {words} explains {100 * (1 - part):.4g} % of the squared error"] = 1.0 - part
    least = max([gates.LEAST_EXPLAINED, *(part - gates.AS_GOOD for part in explained.values())])
    return sorted((text for text, part in explained.items() if part >= least), key=lambda text: -explained[text])
