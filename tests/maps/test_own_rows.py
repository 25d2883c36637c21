"""A deformation at its own controls: their covariance by blocks, and values that the fit knows already."""

from __future__ import annotations

from dataclasses import replace

import pytest
from fit_bank import random_start
from math_bank import rr_problem, two_marker_problem, uniform
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.fitting.problem import Problem
from diffeo_calib.maps import linearisation
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.maps.nominal import SmoothMap

PROBLEMS = {"rr": rr_problem(3), "two markers": two_marker_problem(uniform(9, 2, seed=1))}
every_problem = pytest.mark.parametrize("problem", PROBLEMS.values(), ids=PROBLEMS.keys())


def deformed(problem: Problem) -> GeodesicDeformation:
    return problem.deform(random_start(problem), dc.RK4(2))


@every_problem
@pytest.mark.parametrize("rows", [1, 4, 8])
def test_covariance_with_itself_is_that_with_an_equal_one(
    problem: Problem, rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By blocks below the diagonal and their transposes, the last one smaller."""
    at = deformed(problem).linearise()
    expected = at.gram(replace(at))
    monkeypatch.setattr(linearisation, "GRAM_ROWS", rows)
    assert_close(at.gram(), expected, rtol=0, atol=1e-14 * float(expected.abs().max()))
    assert_close(at.gram(), at.gram().T, rtol=0, atol=1e-14 * float(expected.abs().max()))


@every_problem
def test_values_at_the_controls_are_those_of_the_fit(problem: Problem) -> None:
    """As a copy, and for the very same configurations only."""
    deformation = deformed(problem)
    x = deformation.x.clone()
    known = deformation.at_controls(x)
    assert known is not None
    assert_close(known, deformation(x), rtol=0, atol=1e-13)
    known += 1.0
    assert_close(deformation.at_controls(x), deformation(x), rtol=0, atol=1e-13)
    assert deformation.at_controls(x.flip(0)) is None
    assert deformation.at_controls(x[:-1]) is None


@every_problem
def test_values_of_another_map_are_not_known(problem: Problem) -> None:
    """Another tool, or markers of their own at every row of the fit."""
    deformation = deformed(problem)
    shifted = SmoothMap(lambda at: problem.spec.nominal(at, at.new_zeros(0)) + 1.0)
    assert deformation.with_nominal(shifted).at_controls(deformation.x) is None
    rows = replace(deformation.spec, at_controls=shifted)
    other = GeodesicDeformation(rows, deformation.x, deformation.momenta, dc.RK4(2))
    assert other.at_controls(deformation.x) is None
