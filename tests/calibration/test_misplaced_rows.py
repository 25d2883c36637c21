"""Measured values out of step with the joints from some line on are refused, with the line and the lag."""

from __future__ import annotations

import pytest
import torch
from product_bank import simulated

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics.misplaced_rows import check_row_order
from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.common.errors import MeasurementError

pytestmark = pytest.mark.slow  # robust registrations by the dozen


def shifted(data: dc.Measurements, first: int, lag: int) -> dc.Measurements:
    """The measured values from row ``first`` on belong to the joints ``lag`` rows below; row 0 is line 2."""
    wanted = torch.arange(len(data))
    wanted[first:] += lag
    kept = wanted < len(data)
    lines = torch.arange(2, len(data) + 2)[kept].tolist()
    return dc.Measurements(data.q[kept], data.points[wanted[kept]]).with_line_numbers(lines)


@pytest.mark.parametrize(
    ("first", "lag", "words"),
    [
        (20, -1, "from line 22 on the measured values belong to the joints 1 line above"),
        (10, 2, "from line 12 on the measured values belong to the joints 2 lines below"),
        (34, -1, "from line 36 on the measured values belong to the joints 1 line above"),
    ],
)
def test_from_a_line_on(first: int, lag: int, words: str) -> None:
    """Whether these are most of the rows, or the last few."""
    arm, train, _ = simulated(40)
    with pytest.raises(MeasurementError, match=f"do not fit this robot: {words}: got .* rows that fit there.*; pair"):
        dc.calibrate(arm.nominal, shifted(train, first, lag))


def test_a_part_of_the_rows_is_enough() -> None:
    """As after a split."""
    arm, train, _ = simulated(60)
    some, _ = shifted(train, 25, -1).split(0.7, seed=0)
    with pytest.raises(MeasurementError, match=r"from line 2[5-9] on .* the joints 1 line above"):
        dc.calibrate(arm.nominal, some)


def test_tables_that_are_right_pass() -> None:
    """With a few wrong rows, and with a pair of exchanged ones."""
    arm, train, _ = simulated(40)
    points = train.points.clone()
    points[[3, 4]] = points[[4, 3]]
    points[[8, 15, 30]] += 0.2
    data = dc.Measurements(train.q, points)
    check_row_order(arm.nominal, data, register(arm.nominal, data.q, data.points))
