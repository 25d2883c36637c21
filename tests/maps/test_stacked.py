"""Rows of several kinds as one observation, against each kind by itself."""

from __future__ import annotations

import pytest
import torch
from math_bank import normal
from torch.testing import assert_close

from diffeo_calib.maps.observation import LinearFunctionals, Part, ReadPoints, Stacked
from diffeo_calib.sensors.range import FixedPoints

N, M, R = 7, 6, 3
Z = normal(N, M, seed=1)
BALL, FIRST = torch.tensor([3, 4, 5]), torch.tensor([0, 1, 2])
LENGTHS, HEIGHTS = torch.tensor([4, 0, 2]), torch.tensor([1, 6])


@pytest.fixture
def table() -> Stacked:
    """Three distances and two pairs of heights of different points; rows 3 and 5 report nothing."""
    distances = ReadPoints(FixedPoints.read, torch.cat([3.0 + normal(3, 3, seed=2), normal(3, 1, seed=3)], 1), 3)
    heights = LinearFunctionals(normal(2, 2, 3, seed=4), normal(2, 2, seed=5))
    parts = [
        Part(LENGTHS, BALL, torch.tensor([1]), distances),
        Part(HEIGHTS, FIRST, torch.tensor([2, 0]), heights),
    ]
    return Stacked(N, R, M, parts)


def test_values_are_those_of_each_kind(table: Stacked) -> None:
    found, (lengths, heights) = table.value(Z), table.parts
    assert_close(found[LENGTHS, 1], lengths.observe.value(Z[LENGTHS, 3:])[:, 0])
    assert_close(found[HEIGHTS][:, [2, 0]], heights.observe.value(Z[HEIGHTS, :3]))
    assert int((found != 0).sum()) == 3 + 4


def test_slopes_are_those_of_differences(table: Stacked) -> None:
    step, h = normal(N, M, seed=6), 1e-6
    change = (table.value(Z + h * step) - table.value(Z - h * step)) / (2 * h)
    assert_close((table.slope(Z) @ step[..., None])[..., 0], change, rtol=1e-7, atol=1e-8)
    assert not bool(table.slope(Z)[[3, 5]].any())


@pytest.mark.parametrize("index", [[4, 1, 1], [0, 5], [6, 2, 4, 3, 0]])
def test_rows_are_those_of_the_whole(table: Stacked, index: list[int]) -> None:
    rows = torch.tensor(index)
    some = table.rows(rows)
    assert len(some) == len(index)
    assert_close(some.value(Z[rows]), table.value(Z)[rows])
    assert_close(some.slope(Z[rows]), table.slope(Z)[rows])
