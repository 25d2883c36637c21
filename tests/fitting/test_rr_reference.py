"""The paper's test bed at full size, compared with reference values of an independent prototype."""

import pytest
import torch
from math_bank import rr_problem, uniform

import diffeo_calib as dc
from diffeo_calib.fitting.result import Fit
from diffeo_calib.robots import elastic_rr


@pytest.fixture(scope="module")
def two_steps() -> Fit:
    return dc.fit(rr_problem(16), dc.GaussNewton(), dc.RK4(2))


@pytest.fixture(scope="module")
def four_steps(two_steps: Fit) -> Fit:
    return dc.fit(two_steps.problem, dc.GaussNewton(max_iterations=4), dc.RK4(4), start=two_steps.momenta)


def test_energy_with_two_steps(two_steps: Fit) -> None:
    assert two_steps.converged
    assert two_steps.energy <= 5.6963e-2
    assert two_steps.energy == pytest.approx(5.6962289e-2, rel=1e-6)
    assert two_steps.coupling_residual <= 1e-6


def test_energy_with_four_steps(four_steps: Fit) -> None:
    assert four_steps.energy == pytest.approx(5.6961068e-2, rel=1e-6)
    assert four_steps.coupling_residual <= 1e-6
    assert four_steps.end_residual <= 5e-3
    assert four_steps.field_energy == pytest.approx(5.69582e-2, rel=1e-5)
    squares = float((four_steps.model.deformation.z1 - four_steps.problem.y).square().sum())
    assert squares == pytest.approx(5.649e-10, rel=1e-2)


def test_held_out_error_falls_by_five_orders(two_steps: Fit) -> None:
    x = uniform(3000, 2, seed=0)
    truth = elastic_rr.real(x)
    nominal, fitted = ((guess - truth).norm(dim=1).mean() for guess in (elastic_rr.nominal(x), two_steps.model(x)))
    assert float(nominal) == pytest.approx(0.108, abs=2e-3)
    assert float(torch.log10(nominal / fitted)) >= 5.0


def test_jacobian_of_the_fitted_model(two_steps: Fit) -> None:
    """The exact Jacobian of the model is that of the real arm, which the paper's (18)-(20) do not reach."""
    x = uniform(200, 2, seed=1)
    live = x.clone().requires_grad_()
    real = torch.stack([torch.autograd.grad(elastic_rr.real(live)[:, k].sum(), live)[0] for k in range(2)], 1)
    torch.testing.assert_close(two_steps.model.jacobian(x), real, rtol=0, atol=1e-4)
