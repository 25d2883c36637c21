"""What the errors of a calibrated model on measured rows mean: what to expect, rows that look wrong, likely causes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from diffeo_calib.calibration.contradicted_rows import block_text, contradicted, step_text, steps_of
from diffeo_calib.calibration.expected_errors import expected_of
from diffeo_calib.calibration.findings import Outlier
from diffeo_calib.common.errors import InputError, MeasurementError, sentence
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import expected_covariance, implausible, implausibly_far, impossible
from diffeo_calib.kinematics.re_registration.motions import MOST_ROWS, motions
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.sensors.coordinates import sensor_of
from diffeo_calib.sensors.errors import Evaluation, Evaluations
from diffeo_calib.sensors.places import Places, sensor_key
from diffeo_calib.sensors.tables import divided

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


def judge(model: CalibratedKinematics, places: Places, data: Any, found: Evaluations) -> Judgement:
    """Name rows that look wrong, and likely causes of large errors.

    Args:
        model: a calibrated model. places, data, found: see :func:`~diffeo_calib.kinematics.evaluation.residuals`.

    Raises:
        MeasurementError: rows out of step with their joints, or errors that say nothing about the robot.
    """
    for table, _ in divided(data)[1]:
        devices = places.devices[sensor_key(table)]
        away = devices.errors(table, model(table.q).detach()[:, -1]).norm(dim=1)
        if implausibly_far(model, float(away.median())):
            what, got = (
                "these errors are not those of a calibrated robot",
                f"a median of {1e3 * float(away.median()):.4g}",
            )
            fix = "check --length, the columns of --reading, and --session, which names the device of every row"
            raise MeasurementError.of(what, got=f"{got} mm at the ball", fix=fix)
    seen = positions_of(model, places, data)
    if seen is None or found.positions is None:
        return Judgement()
    some = seen.rows(slice(None, None, -(-len(seen) // MOST_ROWS)))
    steps = steps_of(model, some)
    if steps:
        raise MeasurementError(step_text(steps[0]))
    named = motions(model, some)
    causes = [sentence(motion.sentence, fix="evaluate with --register") for motion in named]
    causes = causes or [text for text in [implausible(model, some, found.positions)] if text is not None]
    if impossible(model, found.positions):
        raise MeasurementError(" ".join(causes))
    if causes:
        return Judgement(causes)
    wrong = contradicted(model, some)
    block = block_text(model, some, wrong)
    causes = [block] if block is not None else _larger_than_expected(model, seen, found.positions) * (not wrong)
    return Judgement(causes, wrong, len(some))


def positions_of(model: CalibratedKinematics, places: Places, data: Any) -> Measurements | None:
    """The measured positions of a table in the frame of a model, with its markers; None if none was measured."""
    own = divided(data)[0]
    if own is None or own.table.without_device:
        return None
    rows = places.aligned(own.table.device_rows())
    return sensor_of(rows).with_points(rows, model)


def expected_rms(model: CalibratedKinematics, data: Measurements, bodies: int) -> float:
    """RMS distance, m, between new measurements and predictions that a model expects of the poses of some rows.

    Args:
        model: a calibrated model. data: its markers. bodies: how many of them, or of its frames, a device measured.
    """
    covariance = expected_covariance(model, data)[:, :bodies]
    return float(covariance.diagonal(dim1=-2, dim2=-1).sum(-1).mean().sqrt())


def _larger_than_expected(model: CalibratedKinematics, data: Measurements, errors: Evaluation) -> list[str]:
    """A sentence about errors above twice the expected ones."""
    expected = expected_rms(model, data, errors.errors.shape[1])
    if errors.rms < LARGE_PER_EXPECTED * expected:
        return []
    what = (
        f"the errors are {errors.rms / expected:.1f} times as large as the model expects: RMS {1e3 * errors.rms:.3f} mm"
    )
    fix = "something has changed since the fit, or these poses are unlike those of the fit: compare, or recalibrate"
    return [sentence(what, expected=f"about {1e3 * expected:.3f} mm", fix=fix)]


@dataclass(frozen=True)
class Accuracy:
    """What is compared with a limit.

    Args:
        value: RMS error, in ``unit``: m or px. of: what it is of, in words.
    """

    value: float
    unit: str
    of: str


def accuracy(model: CalibratedKinematics, found: Evaluations, used: Tensor, unit: str) -> Accuracy:
    """The error by which a model is accepted, in a unit.

    In m that of measured positions that took no part in the fit, of all if there are no others. Where no position was
    measured it is the one that the model expects over the joint ranges of its rows: a spread within sockets and errors
    of readings flatter. In px that of images.

    Args:
        found: errors of N rows. used: (N,) whether they were used in the fit. unit: m or px.

    Raises:
        InputError: no row measured in this unit.
    """
    new = found.rows(~used.cpu()) if not bool(used.all()) else found
    beside = " not used in the fit" * bool((~used).any())
    for one in new.values():
        if one.unit == unit and (one.what == "errors" or unit != "m"):
            return Accuracy(one.rms, unit, f"on {len(one.errors)} rows{beside}")
    if unit != "m":
        fix = "give the limit in mm: without positions the error that the model expects is compared with it"
        raise InputError.of("a limit in px", expected="rows of images", got=", ".join(found), fix=fix)
    return Accuracy(expected_of(model), unit, "expected over the joint ranges of the fit, no position was measured")
