"""What the errors of a calibrated model on measured rows mean: what to expect, rows that look wrong, likely causes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.diagnostics.outliers import Outlier, contradicted
from diffeo_calib.calibration.diagnostics.plausibility import refuse_mistakes
from diffeo_calib.calibration.diagnostics.row_order import block_text, steps_of
from diffeo_calib.calibration.expected_errors import ExpectedError
from diffeo_calib.common.errors import InputError, MeasurementError, sentence
from diffeo_calib.common.quantiles import known
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import (
    LARGEST_ERROR_PER_REACH,
    Judgement,
    expected,
    judged,
    positions_of,
    some_rows,
)
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.sensors.coordinates import Places
from diffeo_calib.sensors.errors import ERRORS, Evaluation, Evaluations


def check_errors(model: CalibratedKinematics, found: Evaluation, usual: float) -> None:
    """Raise MeasurementError if so many positions are far from a model that it holds for a part of the rows alone.

    Args:
        model: the fitted model. found: errors of positions, of rows that were held out if there are any.
        usual: median error of the rows of the fit after a geometric calibration, m.
    """
    reach = model.robot.reach
    limit = min(max(gates.LARGE_PER_REACH * reach, gates.LARGE_PER_USUAL * usual), LARGEST_ERROR_PER_REACH * reach)
    share = float((known(found.errors) > limit).double().mean())
    if share > gates.MOST_LARGE:
        raise MeasurementError.of(
            f"{100 * share:.0f} % of the judged positions are more than {1e3 * limit:.3g} mm from the model",
            expected="errors of a calibrated robot",
            got=f"an RMS error of {1e3 * found.rms:.4g} mm",
            fix="did device, robot or tool move between rows? Name the set-ups (`session`); the model that was written "
            "holds for a part of the rows at most",
        )


@dataclass(frozen=True)
class JudgedRows(Judgement):
    """Judged errors, and the positions that look wrong among ``rows`` evenly chosen ones."""

    outliers: Sequence[Outlier] = ()
    rows: int = 0


def judge(model: CalibratedKinematics, places: Places, data: Any, found: Evaluations) -> JudgedRows:
    """Name rows that look wrong, and likely causes of large errors.

    Args:
        model: a calibrated model. places, data, found: see :func:`~diffeo_calib.kinematics.evaluation.residuals`.

    Raises:
        MeasurementError: another reading of the table explains impossible errors.
    """
    seen = positions_of(model, places, data)
    if seen is None or found.positions is None:
        return JudgedRows(judged(model, places, data, found).refusal)
    some = some_rows(seen)
    for step in steps_of(model, some):
        return JudgedRows(step.sentence())
    known, errors = judged(model, places, data, found), found.positions
    if known.refusal is not None and not known.moved:
        refuse_mistakes(model.robot, some)
    if known.refusal is not None or known.causes:
        return JudgedRows(known.refusal, known.causes, known.moved)
    wrong = contradicted(model, some)
    block, usual = block_text(model, some, wrong), expected_rms(model, seen, errors.errors.shape[1])
    causes = [block] if block is not None else []
    if not causes and not wrong and errors.rms >= gates.LARGE_PER_EXPECTED * usual:
        what = f"the errors are {errors.rms / usual:.1f} times as large as the model expects: "
        fix = "something has changed since the fit, or these poses are unlike those of the fit: compare, or recalibrate"
        size = f"RMS {1e3 * errors.rms:.3f} mm"
        causes = [sentence(what + size, expected=f"about {1e3 * usual:.3f} mm", fix=fix)]
    return JudgedRows(None, causes, outliers=wrong, rows=len(some))


def expected_rms(model: CalibratedKinematics, data: Measurements, bodies: int) -> float:
    """RMS distance, m, between new measurements and predictions that a model expects of the poses of some rows.

    Args:
        model: a calibrated model. data: its markers. bodies: how many of them, or of its frames, a device measured.
    """
    covariance = expected(model, data).places[:, :bodies]
    return float(covariance.diagonal(dim1=-2, dim2=-1).sum(-1).mean().sqrt())


class Accuracy(NamedTuple):
    """What is compared with a limit."""

    value: float  # RMS error, in ``unit``: m or that of readings
    unit: str
    of: str  # what it is of, in words


def accuracy(
    model: CalibratedKinematics,
    errors: Iterable[Evaluation],
    unit: str,
    expected: ExpectedError | None = None,
    *,
    which: str = "",
) -> Accuracy:
    """The error by which a model is accepted, in a unit.

    In m that of measured positions. Where no position was measured it is the one that the model expects over the joint
    ranges of its rows. A spread within sockets and errors of readings are no accuracy, but the model is not more
    accurate than these. In another unit that of its readings.

    Args:
        errors: of the rows that decide, kind by kind. unit: m, px, ... expected: by the model, if it is known already.
        which: these rows are, in words.

    Raises:
        InputError: no row measured in this unit.
    """
    judged = list(errors)
    own = [one for one in judged if one.unit == unit and one.count]
    of = ["" if one.what == ERRORS else f"({one.label}) " for one in own]
    measured = [Accuracy(one.rms, unit, f"{of[k]}on {one.count} rows{which}") for k, one in enumerate(own)]
    if unit != "m" and measured:
        return measured[0]
    if unit != "m":
        fix = "give the limit in mm: without positions the error that the model expects is compared with it"
        got = ", ".join(one.kind for one in judged)
        raise InputError.of(f"a limit in {unit}", expected="rows in this unit", got=got, fix=fix)
    if not any(one.what == ERRORS for one in own):
        how = "expected over the joint ranges of the fit, without measured positions"
        measured.append(Accuracy((expected or ExpectedError.of(model)).whole, unit, how))
    return max(measured, key=lambda one: one.value)
