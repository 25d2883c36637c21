"""A deformation at its own controls, and rows of several kinds as one observation."""

from dataclasses import replace

import pytest
import torch
from fit_bank import random_start
from math_bank import normal, two_marker_problem, uniform
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.maps import linearisation
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.maps.nominal import SmoothMap
from diffeo_calib.maps.observation import LinearFunctionals, Part, ReadPoints, Stacked
from diffeo_calib.sensors.range import FixedPoints

PROBLEM = two_marker_problem(uniform(9, 2, seed=1))
DEFORMED = PROBLEM.deform(random_start(PROBLEM), dc.RK4(2))


@pytest.mark.parametrize("rows", [1, 4])
def test_covariance_with_itself_is_that_with_an_equal_one(rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """By blocks below the diagonal and their transposes, the last one smaller."""
    at = DEFORMED.linearise()
    expected = at.gram(replace(at))
    monkeypatch.setattr(linearisation, "GRAM_ROWS", rows)
    assert_close(at.gram(), expected, rtol=0, atol=1e-14 * float(expected.abs().max()))
    assert_close(at.gram(), at.gram().T, rtol=0, atol=1e-14 * float(expected.abs().max()))


def test_values_at_the_controls_are_those_of_the_fit() -> None:
    """As a copy, for the very same configurations only, and not around another map there or elsewhere."""
    x = DEFORMED.x.clone()
    DEFORMED.at_controls(x).add_(1.0)  # pyright: ignore[reportOptionalMemberAccess]
    assert_close(DEFORMED.at_controls(x), DEFORMED(x), rtol=0, atol=1e-13)
    shifted = SmoothMap(lambda at: PROBLEM.spec.nominal(at, at.new_zeros(0)) + 1.0)
    own = GeodesicDeformation(replace(DEFORMED.spec, at_controls=shifted), x, DEFORMED.momenta, dc.RK4(2))
    for other, at in (
        (DEFORMED, x.flip(0)),
        (DEFORMED, x[:-1]),
        (DEFORMED.with_nominal(shifted), x),  # another tool
        (own, x),  # markers of their own at every row of the fit
    ):
        assert other.at_controls(at) is None


N, M, R = 7, 6, 3
Z = normal(N, M, seed=1)
LENGTHS, HEIGHTS = torch.tensor([4, 0, 2]), torch.tensor([1, 6])


def table() -> Stacked:
    """Three distances and two pairs of heights of different points; rows 3 and 5 report nothing."""
    distances = ReadPoints(FixedPoints.read, torch.cat([3.0 + normal(3, 3, seed=2), normal(3, 1, seed=3)], 1), 3)
    heights = LinearFunctionals(normal(2, 2, 3, seed=4), normal(2, 2, seed=5))
    parts = [
        Part(LENGTHS, torch.tensor([3, 4, 5]), torch.tensor([1]), distances),
        Part(HEIGHTS, torch.tensor([0, 1, 2]), torch.tensor([2, 0]), heights),
    ]
    return Stacked(N, R, M, parts)


def test_values_are_those_of_each_kind_and_slopes_those_of_differences() -> None:
    every = table()
    found, (lengths, heights) = every.value(Z), every.parts
    assert_close(found[LENGTHS, 1], lengths.observe.value(Z[LENGTHS, 3:])[:, 0])
    assert_close(found[HEIGHTS][:, [2, 0]], heights.observe.value(Z[HEIGHTS, :3]))
    assert int((found != 0).sum()) == 3 + 4
    step, h = normal(N, M, seed=6), 1e-6
    change = (every.value(Z + h * step) - every.value(Z - h * step)) / (2 * h)
    assert_close((every.slope(Z) @ step[..., None])[..., 0], change, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("index", [[4, 1, 1], [0, 5], [6, 2, 4, 3, 0]])
def test_rows_are_those_of_the_whole(index: list[int]) -> None:
    rows, every = torch.tensor(index), table()
    some = every.rows(rows)
    assert len(some) == len(index)
    assert_close(some.value(Z[rows]), every.value(Z)[rows])
    assert_close(some.slope(Z[rows]), every.slope(Z)[rows])
