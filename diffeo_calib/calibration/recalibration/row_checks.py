"""Checks of new rows as an old model sees them, before it is made to fit them."""

from __future__ import annotations

from math import nan

from diffeo_calib.calibration.recalibration.checks import size_ratio
from diffeo_calib.calibration.recalibration.new_rows import NewRows
from diffeo_calib.common.errors import MeasurementError, sentence, warn_user

OUTLIER_WEIGHT = 0.2
"""Rows with a smaller weight are named."""
LARGEST_OUTLIER_PART = 0.5
"""Part of the rows that may hardly count: with more of them it is not clear which rows are wrong."""
LARGEST_EXCESS = 10.0
"""Residuals by this factor above the expected ones are not those of a worn joint."""
USUAL_RATIO = 3e-3
"""Relative error of distances that no robot has."""


def warn_of_scale(rows: NewRows) -> None:
    """Warn if distances between measured points differ by a factor that no robot has."""
    if rows.before.place is None or rows.observe is not None:
        return
    seen = rows.y.masked_fill(~rows.noise_model.coordinates(rows.y), nan)
    predicted, measured = ((seen - away).unflatten(1, (-1, 3)) for away in (rows.residual, 0.0))
    ratio = size_ratio(predicted, measured)
    if abs(ratio - 1.0) > USUAL_RATIO:
        what = f"distances between the new rows are {ratio:.4f} times those that the model predicts"
        warn_user(sentence(what, fix="check the scale of the measuring device"))


def check_rows(rows: NewRows, excess: float) -> None:
    """Raise MeasurementError if half of the rows hardly count, and errors are larger than those of worn joints."""
    bad = int((rows.tails.weights < OUTLIER_WEIGHT).any(1).sum())
    if bad >= LARGEST_OUTLIER_PART * len(rows) and excess > LARGEST_EXCESS:
        raise MeasurementError.of(
            f"{bad} of {len(rows)} new rows contradict the old model",
            expected="rows of the same robot, most of them right",
            fix="check that the table belongs to this robot; if it was damaged or rebuilt, calibrate it afresh",
        )
