"""Noise with shifts that rows share, against the explicit matrix; and the measurements that a fitted map implies."""

from __future__ import annotations

import pytest
import torch
from fit_bank import shared_noise
from math_bank import normal, two_marker_problem, uniform
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.maps.noise import Noise


def explicit(noise: Noise) -> Tensor:
    flat = noise.shared.flatten(0, 1)
    return torch.block_diag(*noise.covariance) + flat @ flat.T


def test_the_operations_are_those_of_the_explicit_matrix() -> None:
    R, values = shared_noise(6, 3), normal(6, 3, seed=3)
    matrix = explicit(R)
    torch.testing.assert_close(R.solve(values).flatten(), torch.linalg.solve(matrix, values.flatten()))
    torch.testing.assert_close(R.multiply(values[..., None]).flatten(), matrix @ values.flatten())
    torch.testing.assert_close(R.add_to(torch.zeros_like(matrix)), matrix)
    rows = torch.tensor([4, 1])
    some = matrix.view(6, 3, 6, 3)[rows][:, :, rows].reshape(6, 6)
    torch.testing.assert_close(explicit(R.rows(rows)), some)
    torch.testing.assert_close(explicit(R.own), torch.block_diag(*R.covariance))


@pytest.mark.parametrize("reduced", [False, True])
def test_a_map_knows_its_measurements(reduced: bool) -> None:
    """The measurements that momenta imply are those of the fit, or, with few control points, lead to the same map."""
    problem = two_marker_problem(uniform(15, 2, seed=3), shared_noise(15, 4))
    solver, steps = dc.GaussNewton(tolerance=1e-12), dc.RK4(4)
    controls = problem.x[::2] if reduced else None
    fitted = dc.fit(problem, solver, steps, controls=controls)
    implied = fitted.model.measured()
    if not reduced:
        torch.testing.assert_close(implied, problem.y, rtol=0.0, atol=1e-5)
    problem.y = implied
    again = dc.fit(problem, solver, steps, controls=controls, start=fitted.momenta)
    new = uniform(20, 2, seed=8)
    torch.testing.assert_close(again.model(new), fitted.model(new), rtol=0.0, atol=1e-4)
