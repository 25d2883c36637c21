"""The tangent model is Gaussian-process regression: factor, first Gauss-Newton iterate."""

import pytest
import torch
from fit_bank import noise_blocks
from math_bank import rr_problem, two_marker_problem, uniform

from diffeo_calib.common import checks
from diffeo_calib.common.errors import InputError
from diffeo_calib.fitting.gauss_newton import GaussNewton
from diffeo_calib.fitting.problem import Problem, Regression, tangent
from diffeo_calib.flows.integrators import RK4
from diffeo_calib.regression.conditional import Process

PROBLEMS = {
    "rr": rr_problem(4),
    "two markers": two_marker_problem(uniform(12, 2, seed=3)),
    "noise blocks": two_marker_problem(uniform(12, 2, seed=3), noise_blocks(12, 4)),
}
every_problem = pytest.mark.parametrize("problem", PROBLEMS.values(), ids=PROBLEMS.keys())


def dense(regression: Regression) -> Process:
    assert isinstance(regression.conditional, Process)
    return regression.conditional.about(regression.target)


@every_problem
def test_factor_and_target_at_zero(problem: Problem) -> None:
    """G + R and y - k0, written out."""
    k0 = problem.spec.nominal(problem.x, torch.zeros(0, dtype=torch.float64))
    dk0 = torch.block_diag(*problem.spec.nominal.jacobian(problem.x, torch.zeros(0, dtype=torch.float64)))
    z = k0.reshape(-1, problem.spec.task_dim)
    expected = (
        dk0 @ problem.spec.joint_kernel.matrix(problem.x, problem.x) @ dk0.T
        + problem.spec.task_kernel.matrix(z, z)
        + torch.block_diag(*problem.noise.covariance)
    )
    regression = tangent(problem)
    torch.testing.assert_close(dense(regression).factor.matrix, expected, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(regression.target, problem.y - k0, rtol=0, atol=1e-15)
    mu = torch.linalg.solve(expected, (problem.y - k0).flatten()).reshape(problem.y.shape)
    torch.testing.assert_close(dense(regression).mu.view_as(mu), mu, rtol=1e-8, atol=1e-8)


@every_problem
def test_first_gauss_newton_iterate_is_the_tangent_model(problem: Problem) -> None:
    first = GaussNewton(max_iterations=1).solve(problem, RK4(2)).momenta
    for actual, expected in zip(first.tensors, tangent(problem).momenta().tensors, strict=True):
        torch.testing.assert_close(actual, expected, rtol=1e-8, atol=1e-9)


def test_more_memory_than_is_free_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "free_memory", lambda: 2**14)
    with pytest.raises(InputError, match=r"32 measured coordinates.*more memory than is free.*controls=500"):
        tangent(PROBLEMS["rr"])
