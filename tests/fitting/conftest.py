"""Fits that several files use."""

import pytest
from math_bank import rr_problem

import diffeo_calib as dc


@pytest.fixture(scope="session")
def small() -> dc.Fit:
    """An 8 x 8 grid: quick to fit, and deformed as much as the paper's."""
    return dc.fit(rr_problem(8), dc.GaussNewton(), dc.RK4(2))


@pytest.fixture(scope="session")
def fine(small: dc.Fit) -> dc.Fit:
    """The same problem with finer time steps."""
    return dc.fit(small.problem, dc.GaussNewton(), dc.RK4(8), start=small.momenta)
