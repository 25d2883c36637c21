"""Checks of new rows, before the old model sees them."""

from __future__ import annotations

from math import degrees, nan
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError, MeasurementError, as_written, sentence, warn_user
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import rows_used_in_fit
from diffeo_calib.kinematics.re_registration.registered_map import Registration
from diffeo_calib.measurements.pose_frames import kind_of_points
from diffeo_calib.measurements.rows import RowGroups
from diffeo_calib.sensors.tables import Coordinates, OtherReadings

Marker = Literal["evidence", "same", "moved", "other"]
LARGEST_TURN_RAD = 0.1
"""Standard deviation of the turn of the measuring device from which its place is open."""
LARGEST_RATIO = 5.0
"""Ratio of measured and predicted distances that only another unit explains: markers may be others."""
FARTHEST_PAIRS = 0.5
"""Of all pairs of rows, this part with the largest distances is compared."""
UNLIKELY = 0.01


def check_arguments(model: object, new: object, marker: object) -> None:
    """Raise InputError for arguments of the wrong kind."""
    if not isinstance(model, CalibratedKinematics):
        raise InputError.of("`model`", expected="a calibrated model of a robot", got=type(model).__name__)
    if not isinstance(new, RowGroups):
        expected = "dc.Measurements, dc.Readings or dc.Observations"
        raise InputError.of("the new rows", expected=expected, got=type(new).__name__)
    if not isinstance(marker, str) or marker not in get_args(Marker):
        raise InputError.of("`marker`", expected=", ".join(map(repr, get_args(Marker))), got=as_written(marker))


def check_kinds(model: CalibratedKinematics, own: Coordinates | None, readings: list[OtherReadings]) -> None:
    """Raise InputError for rows that show other markers than those of the calibration."""
    measured, table = model.nominal.geometry.markers, None if own is None else own.table
    ball = bool(readings) or (table is not None and table.sockets is not None)
    if model.lever is not None and ball:
        fix = "measure poses again, or calibrate again with all rows"
        raise InputError.of("the new rows", expected="poses", got="rows that show a ball", fix=fix)
    if table is None or table.without_device:
        return
    seen = table.markers - (table.sockets is not None)
    same = (table.lever is None) == (model.lever is None)
    if not same or seen not in {measured, measured - model.ball}:
        kinds = [kind_of_points(count, lever) for count, lever in ((measured, model.lever), (seen, table.lever))]
        fix = "measure the same kind again, calibrate again with all rows, or register the model (`model.registered`)"
        if model.registration is not None:  # at other markers than those of the calibration
            fix = "measure the markers of the calibration itself, or calibrate again with all rows"
        raise InputError.of("the new rows", expected=kinds[0], got=kinds[1], fix=fix)


def check_other_table(model: CalibratedKinematics, new: Any) -> None:
    """Raise InputError for rows of the model's own fit: they would count twice."""
    if model.provenance is not None and model.provenance.table_sha256 == new.sha256:
        used = int(rows_used_in_fit(model, new.q).sum())
        if used:
            what = f"the model was fitted to {used} of these {len(new)} measurements: they would count twice"
            raise InputError.of(what, fix="pass rows that were measured later")


def check_size(predicted: Tensor, measured: Tensor) -> None:
    """Raise MeasurementError for another unit of length: points (M, P, 3) by the old model, m, and measured ones."""
    ratio = size_ratio(predicted, measured)
    if not 1 / LARGEST_RATIO < ratio < LARGEST_RATIO:
        raise MeasurementError.of(
            "the new rows do not have the robot's size",
            expected="distances between rows as the model predicts them",
            got=f"{ratio:.3g} times these",
            fix="check `length` and `angle`, and the order of the columns",
        )


def size_ratio(predicted: Tensor, measured: Tensor) -> float:
    """Median ratio of measured and predicted distances between rows, which no place of the device changes.

    The middle of the markers that a row shows stands for the row.
    """
    expected, found = (
        torch.pdist(points.masked_fill(measured.isnan(), nan).nanmean(1)) for points in (predicted, measured)
    )
    far = expected >= expected.quantile(FARTHEST_PAIRS) if len(expected) else expected.bool()
    return float((found[far] / expected[far]).median()) if bool((expected[far] > 0).all()) and len(expected) else 1.0


def check_place(found: Registration) -> None:
    """Raise MeasurementError if the rows leave open how the measuring device is turned."""
    turn = float(found.frame_deviations[3:].max())
    if turn > LARGEST_TURN_RAD:
        raise MeasurementError.of(
            "the new rows do not tell where the measuring device stands",
            expected="markers that are not all on one line or at one place",
            got=f"its turn is known to {degrees(turn):.2g} degrees only",
            fix="measure poses in which several joints move",
        )


def warn_of_moved_markers(found: Registration, marker: str) -> None:
    """Warn if the markers are said to be the same, and the rows say otherwise."""
    if marker == "same" and found.same_place is not None and found.same_place < UNLIKELY and found.shift is not None:
        what = f"the rows say that the markers have moved by {1e3 * float(found.shift.norm(dim=1).max()):.2g} mm"
        warn_user(sentence(f'{what}, although marker="same"', fix="leave `marker` out"))
