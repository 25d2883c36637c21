"""What the errors of a calibrated model on measured rows mean: what to expect, rows that look wrong, likely causes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import log
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics.misplaced_rows import STEP_LIMITS, Step, out_of_step
from diffeo_calib.calibration.diagnostics.plausibility import refuse_mistakes
from diffeo_calib.calibration.expected_errors import ExpectedError
from diffeo_calib.calibration.findings import FALSE_ALARM_PROBABILITY, Outlier, found_outliers
from diffeo_calib.common.errors import InputError, MeasurementError, sentence, warn_user
from diffeo_calib.common.quantiles import chi2_above, chi2_median, known
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import (
    LARGEST_ERROR_PER_REACH,
    causes_of,
    expected,
    expected_error,
    impossible,
    impossible_errors,
    positions_of,
    some_rows,
)
from diffeo_calib.kinematics.re_registration.motions import motions
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.sensors.coordinates import sensor_of
from diffeo_calib.sensors.errors import Evaluation, Evaluations
from diffeo_calib.sensors.places import Places
from diffeo_calib.sensors.tables import Coordinates


@dataclass(frozen=True)
class BlockLimits:
    """When wrong rows count as a block.

    Args:
        wrong: share of the rows of a block that are wrong.
        fewest_rows: smallest number of wrong rows.
        chance: probability that wrong rows which are spread at random look like a block.
        excess: factor by which an error must exceed what the model's deviations exclude by chance: outside of the
            rows of its fit a model may be overconfident.
    """

    wrong: float = 0.9
    fewest_rows: int = 4
    chance: float = 1e-3
    excess: float = 3.0


LIMITS = BlockLimits()
PAIR = "pair every configuration with its own measured values: was a line lost or doubled there?"


def contradicted(model: CalibratedKinematics, data: Measurements) -> list[Outlier]:
    """Measurements that took no part in a fit and that its model excludes, the worst first.

    Their distances are judged by the model's own deviations, or by the median distance if the model is overconfident.
    """
    data = sensor_of(data).with_points(data, model)
    errors, squares = _errors(model, data)
    freedom = errors.shape[-1]
    seen = known(squares)
    size = max(1.0, float(seen.median()) / chi2_median(freedom))
    limit = LIMITS.excess**2 * size * chi2_above(FALSE_ALARM_PROBABILITY / len(seen), freedom)
    return found_outliers(model, data, squares > limit, errors[..., :3].norm(dim=-1))


def _errors(model: CalibratedKinematics, data: Measurements) -> tuple[Tensor, Tensor]:
    """Errors (N, bodies, 3 or 6) in m and rad, and their squared distances (N, bodies) by the model's deviations.

    NaN for hidden markers.
    """
    found = data.bodies.predicted(model.at_payloads(data.payload), data.q)
    errors = data.bodies.errors(data, found.points)
    solved = torch.linalg.solve(found.covariance, errors[..., None])[..., 0]
    return errors, (errors * solved).sum(-1)


def steps_of(model: CalibratedKinematics, data: Measurements) -> list[Step]:
    """Rows whose measured values belong to the joints of other lines, judged by a model."""
    return out_of_step(
        model.at_payloads(data.payload)(data.q).detach(), data.points, data.line_numbers, expected_error(model, data)
    )


def step_text(step: Step) -> str:
    """One sentence about rows out of step."""
    return sentence(step.sentence, got=f"{step.rows} rows that fit there, and not at their own joints", fix=PAIR)


def block_text(model: CalibratedKinematics, data: Measurements, wrong: list[Outlier]) -> str | None:
    """One sentence about wrong rows that follow one another, with their common cause if there is one; else None."""
    order = data.line_numbers.argsort()
    flags = torch.zeros(len(data), dtype=torch.bool, device=order.device)
    flags[[one.row for one in wrong]] = True
    place = find_block(flags[order])
    if place is None:
        return None
    start, end = place
    block = data.rows(order[start:end])
    lines, last = block.line_numbers.tolist(), " to the end of the table" * (end == len(data))
    size = float((model.at_payloads(block.payload)(block.q) - block.points).norm(dim=-1).nanmedian())
    causes = motions(model, block)
    why = "; " + ", ".join(cause.sentence for cause in causes) if causes else ", for no common reason"
    count = int(flags[order[start:end]].sum())
    return sentence(
        f"{count} rows look wrong that follow one another: lines {lines[0]} to {lines[-1]}{last}",
        got=f"a median error of {1e3 * size:.3g} mm{why}",
        fix="check what happened there; calibrate without these lines, or measure them again",
    )


def warn_of_contradictions(
    model: CalibratedKinematics, own: Coordinates | None, wrong: list[Outlier], moved: str | None
) -> None:
    """Warn of the best explanation of wrong rows of a fit.

    Args:
        model: the fitted model. own: its rows that tell coordinates. wrong: the outliers among all rows.
        moved: a sentence about something that moved, which explains wrong rows after it.

    Warns:
        DiffeoCalibWarning: rows are out of step, follow one another, or something moved.
    """
    text = moved
    if own is not None:
        place = {row: number for number, row in enumerate(own.rows.tolist())}
        wrong = [replace(one, row=place[one.row]) for one in wrong if one.row in place]
        steps = steps_of(model, own.table) if len(wrong) >= STEP_LIMITS.fewest_rows else []
        text = step_text(steps[0]) if steps else moved or block_text(model, own.table, wrong)
    if text is not None:
        warn_user(text)


def find_block(wrong: Tensor, limits: BlockLimits = LIMITS) -> tuple[int, int] | None:
    """First and last + 1 of the rows (N,), in order, where wrong ones follow one another beyond chance; or None.

    The segment with the largest likelihood ratio of ``limits.wrong`` against the overall share (S. Karlin,
    S. Altschul, "Methods for assessing the statistical significance of molecular sequence features", 1990).
    """
    count, n = int(wrong.sum()), len(wrong)
    share = count / n
    if count < limits.fewest_rows or share >= limits.wrong:
        return None
    gain, loss = log(limits.wrong / share), log((1 - limits.wrong) / (1 - share))
    best, score, start, place = log(n / limits.chance), 0.0, 0, None
    for row, bad in enumerate(wrong.tolist()):
        if score <= 0:
            score, start = 0.0, row
        score += gain if bad else loss
        if score > best:
            best, place = score, (start, row + 1)
    return place


LARGE_PER_REACH, LARGE_PER_USUAL = 0.01, 20.0
"""Errors above this share of the robot's reach, and this multiple of those of usual rows after a geometric calibration,
are no errors of a calibrated robot; nor are those above a tenth of its reach."""
MOST_LARGE = 0.25
"""Share of the rows from which such errors fail a fit."""


def check_errors(model: CalibratedKinematics, found: Evaluation, usual: float) -> None:
    """Raise MeasurementError if so many positions are far from a model that it holds for a part of the rows alone.

    Args:
        model: the fitted model. found: errors of positions, of rows that were held out if there are any.
        usual: median error of the rows of the fit after a geometric calibration, m.
    """
    reach = model.robot.reach
    limit = min(max(LARGE_PER_REACH * reach, LARGE_PER_USUAL * usual), LARGEST_ERROR_PER_REACH * reach)
    share = float((known(found.errors) > limit).double().mean())
    if share > MOST_LARGE:
        raise MeasurementError.of(
            f"{100 * share:.0f} % of the judged positions are more than {1e3 * limit:.3g} mm from the model",
            expected="errors of a calibrated robot",
            got=f"an RMS error of {1e3 * found.rms:.4g} mm",
            fix="did device, robot or tool move between rows? Name the set-ups (`session`); the model that was written "
            "holds for a part of the rows at most",
        )


LARGE_PER_EXPECTED = 2.0
"""RMS errors from this multiple of the expected ones on are warned about."""


@dataclass(frozen=True)
class Judgement:
    """What errors mean.

    Args:
        causes: sentences about likely causes of large errors. outliers: positions that look wrong among ``rows``
            evenly chosen ones.
    """

    causes: list[str] = field(default_factory=list)
    outliers: list[Outlier] = field(default_factory=list)
    rows: int = 0


def impossible_or_refused(model: CalibratedKinematics, places: Places, data: Any, found: Evaluations) -> str | None:
    """See :func:`~diffeo_calib.kinematics.evaluation.impossible_errors`.

    Raises:
        MeasurementError: another reading of the table, or something that moved, explains the rows; it is named.
    """
    seen = positions_of(model, places, data)
    if seen is not None and found.positions is not None and impossible(model, found.positions):
        some = _refused_steps(model, seen)
        if not motions(model, some):
            refuse_mistakes(model.robot, some)
    return impossible_errors(model, places, data, found)


def judge(model: CalibratedKinematics, places: Places, data: Any, found: Evaluations) -> Judgement:
    """Name rows that look wrong, and likely causes of large errors; arguments as of :func:`impossible_or_refused`.

    Raises:
        MeasurementError: rows out of step with their joints.
    """
    seen = positions_of(model, places, data)
    if seen is None or found.positions is None:
        return Judgement()
    some = _refused_steps(model, seen)
    causes = causes_of(model, some, found.positions)
    if causes:
        return Judgement(causes)
    wrong = contradicted(model, some)
    block = block_text(model, some, wrong)
    causes = [block] if block is not None else larger_than_expected(model, seen, found.positions) * (not wrong)
    return Judgement(causes, wrong, len(some))


def _refused_steps(model: CalibratedKinematics, data: Measurements) -> Measurements:
    """Evenly chosen rows; MeasurementError if they are out of step with their joints."""
    some = some_rows(data)
    for step in steps_of(model, some):
        raise MeasurementError(step_text(step))
    return some


def expected_rms(model: CalibratedKinematics, data: Measurements, bodies: int) -> float:
    """RMS distance, m, between new measurements and predictions that a model expects of the poses of some rows.

    Args:
        model: a calibrated model. data: its markers. bodies: how many of them, or of its frames, a device measured.
    """
    covariance = expected(model, data).places[:, :bodies]
    return float(covariance.diagonal(dim1=-2, dim2=-1).sum(-1).mean().sqrt())


def larger_than_expected(model: CalibratedKinematics, data: Measurements, errors: Evaluation) -> list[str]:
    """A sentence about errors above twice the expected ones."""
    usual = expected_rms(model, data, errors.errors.shape[1])
    if errors.rms < LARGE_PER_EXPECTED * usual:
        return []
    what = f"the errors are {errors.rms / usual:.1f} times as large as the model expects: RMS {1e3 * errors.rms:.3f} mm"
    fix = "something has changed since the fit, or these poses are unlike those of the fit: compare, or recalibrate"
    return [sentence(what, expected=f"about {1e3 * usual:.3f} mm", fix=fix)]


@dataclass(frozen=True)
class Accuracy:
    """What is compared with a limit.

    Args:
        value: RMS error, in ``unit``: m or that of readings. of: what it is of, in words.
    """

    value: float
    unit: str
    of: str


def accuracy(model: CalibratedKinematics, found: Evaluations, used: Tensor, unit: str) -> Accuracy:
    """The error by which a model is accepted, in a unit.

    In m that of measured positions that took no part in the fit, of all if there are no others. Where no position was
    measured it is the one that the model expects over the joint ranges of its rows. A spread within sockets and errors
    of readings are no accuracy, but the model is not more accurate than these. In another unit that of its readings.

    Args:
        found: errors of N rows. used: (N,) whether they were used in the fit. unit: m, px, ...

    Raises:
        InputError: no row measured in this unit.
    """
    new = found.rows(~used.cpu()) if not bool(used.all()) else found
    beside = " not used in the fit" * bool((~used).any())
    own = [one for one in new.values() if one.unit == unit and one.count]
    measured = [
        Accuracy(one.rms, unit, f"{'' if one.what == 'errors' else f'({one.label}) '}on {one.count} rows{beside}")
        for one in own
    ]
    if unit != "m" and measured:
        return measured[0]
    if unit != "m":
        fix = "give the limit in mm: without positions the error that the model expects is compared with it"
        raise InputError.of(f"a limit in {unit}", expected="rows in this unit", got=", ".join(found), fix=fix)
    if not any(one.what == "errors" for one in own):
        of = "expected over the joint ranges of the fit, no position was measured"
        measured.append(Accuracy(ExpectedError.of(model).whole, unit, of))
    return max(measured, key=lambda one: one.value)
