"""The paper's two algorithms and its test bed."""

from __future__ import annotations

import pytest
import torch
from listings import Descent, Discretisation, evaluate, lr_calibration
from math_bank import few_points, uniform

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.paper.eulerian import Eulerian
from diffeo_calib.robots import elastic_rr

STEP = 0.05


def test_algorithm_1_is_gradient_descent_from_zero() -> None:
    problem = few_points()
    K = problem.spec.joint_kernel, problem.spec.task_kernel
    result = lr_calibration(problem.x, problem.y, elastic_rr.nominal, *K, 0.3, Descent(STEP, 1e-9, 12))
    solver = dc.GradientDescent(step=STEP, tolerance=1e-9, max_iterations=12)
    fit = dc.fit(problem, solver, dc.RK4(2), formulation="eulerian")
    torch.testing.assert_close(result[1], fit.momenta.task, rtol=0, atol=1e-12)
    assert torch.equal(result[0], problem.x)
    assert result[2:] == (elastic_rr.nominal, *K)
    assert not result[1].requires_grad
    settled = lr_calibration(problem.x, problem.y, elastic_rr.nominal, *K, 0.3, Descent(STEP, 1e6, 12))
    assert not bool(settled[1].any())  # the tolerance is met at once


@pytest.mark.parametrize("equations", [Eulerian(), Eulerian(printed_jacobian=False)], ids=repr)
def test_algorithm_2_is_the_fitted_model(equations: Eulerian) -> None:
    problem = few_points()
    fit = dc.fit(problem, dc.LBFGS(max_iterations=10), dc.RK4(2), formulation="eulerian", **vars(equations))
    xi = uniform(9, 2, seed=1)
    K = problem.spec.joint_kernel, problem.spec.task_kernel
    k1, jacobian = evaluate(xi, problem.x, fit.momenta.task, elastic_rr.nominal, *K, Discretisation(equations))
    torch.testing.assert_close(k1, fit.model(xi), rtol=0, atol=1e-14)
    torch.testing.assert_close(jacobian, fit.model.jacobian(xi), rtol=0, atol=1e-14)
    with pytest.raises(InputError, match="`xi`"):
        evaluate(xi[:, :1], problem.x, fit.momenta.task, elastic_rr.nominal, *K)
    with pytest.raises(InputError, match=r"`P0` has the wrong shape.*what `lr_calibration` returned"):
        evaluate(xi, problem.x, fit.momenta.task[:2], elastic_rr.nominal, *K)
    with pytest.raises(InputError, match="`K_W`"):
        evaluate(xi, problem.x, fit.momenta.task, elastic_rr.nominal, K[0], dc.Gaussian(1.0, [1.0] * 3))
    with pytest.raises(InputError, match=r"`k\(xi\)`"):
        evaluate(xi * 0 + 7, problem.x, fit.momenta.task, lambda x: elastic_rr.nominal(x) + (6.5 - x).log() * 0, *K)
