"""Laws of the evidence for unknowns that a hypothesis opens, against dense Gaussians and least squares."""

from __future__ import annotations

import pytest
import torch
from math_bank import normal
from torch.distributions import MultivariateNormal
from torch.testing import assert_close

from diffeo_calib.calibration.diagnostics.hypotheses import Evidence

ROWS, UNKNOWNS = 12, 2
ROOT = normal(ROWS, ROWS, seed=1)
K = ROOT @ ROOT.mT + torch.eye(ROWS, dtype=torch.float64)
E, R = normal(ROWS, UNKNOWNS, seed=2), 5.0 * normal(ROWS, seed=3)
FOUND = Evidence.by(E, R, torch.linalg.cholesky(K))


def test_sizes_are_those_of_weighted_least_squares() -> None:
    white = torch.linalg.solve(torch.linalg.cholesky(K), torch.cat([E, R[:, None]], 1))
    expected = torch.linalg.lstsq(white[:, :UNKNOWNS], white[:, UNKNOWNS:]).solution[:, 0]
    left = white[:, UNKNOWNS] - white[:, :UNKNOWNS] @ expected
    assert_close(FOUND.size, expected, rtol=1e-6, atol=0)
    assert float(FOUND.gain) == pytest.approx(float(white[:, UNKNOWNS].square().sum() - left.square().sum()))
    assert FOUND.excess == pytest.approx(float(left.square().mean()))
    assert FOUND.excess > 1.0


def test_errors_that_are_smaller_than_expected_are_no_excess() -> None:
    assert Evidence.by(E, 1e-3 * R, torch.linalg.cholesky(K)).excess == 1.0


@pytest.mark.parametrize("variance", [1e-3, 1.0, 1e3])
def test_odds_are_the_ratio_of_the_densities(variance: float) -> None:
    zero = torch.zeros(ROWS, dtype=torch.float64)
    without, beside = (MultivariateNormal(zero, one).log_prob(R) for one in (K, K + variance * E @ E.mT))
    (odds,) = FOUND.log_odds(torch.tensor([variance], dtype=torch.float64)).tolist()
    assert odds == pytest.approx(float(beside - without), rel=1e-6)
