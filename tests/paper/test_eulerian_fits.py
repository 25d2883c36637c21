"""Fits in the paper's formulation: its algorithms, gradient descent, and what it does not support."""

from pathlib import Path

import pytest
import torch
from eulerian_bank import P0, deformed
from listings import Descent, lr_calibration
from math_bank import few_points, uniform

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, NumericalError
from diffeo_calib.fitting.problem import tangent
from diffeo_calib.robots import elastic_rr


def test_a_fit_of_an_easy_problem(tmp_path: Path) -> None:
    fit = dc.fit(few_points(), formulation="eulerian")
    assert fit.converged
    assert fit.status.startswith("converged")
    again = dc.fit(fit.problem, formulation="eulerian", start=fit.momenta)
    assert again.energy == pytest.approx(fit.energy, rel=1e-8)
    assert fit.energy == pytest.approx(dc.fit(few_points()).energy, rel=0.1)
    x = uniform(6, 2, seed=3)
    found = fit.model.inverse(fit.model(x), x + 0.01)
    torch.testing.assert_close(fit.model(found), fit.model(x), rtol=0, atol=1e-10)
    assert (fit.model(x[:0]).shape, fit.model.jacobian(x[:0]).shape) == ((0, 2), (0, 2, 2))
    for action in (lambda: fit.model.predict(x), lambda: dc.save(fit.model, tmp_path / "model.safetensors")):
        with pytest.raises(InputError, match='formulation="exact"'):
            action()


def test_overflow_is_reported() -> None:
    with pytest.raises(NumericalError, match=r"fixed points \(17\) overflows"):
        deformed(1e30 * P0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"formulation": "lagrangian"}, r'`formulation`: expected "exact" or "eulerian", got \'lagrangian\''),
        ({"printed_sign": True}, r'expected none, got printed_sign; .*formulation="eulerian"'),
        ({"formulation": "eulerian", "sign": True}, r"expected printed_sign, printed_jacobian, .* got sign"),
        ({"formulation": "eulerian", "printed_sign": 1}, r"`printed_sign`: expected True or False, got 1"),
        ({"formulation": "eulerian", "controls": 3}, r"momentum at every measurement"),
        ({"formulation": "eulerian", "solver": dc.GaussNewton()}, r"use dc.LBFGS\(\) or dc.GradientDescent"),
        ({"formulation": "eulerian", "start": tangent(few_points()).momenta()}, r"same control points and formulation"),
    ],
)
def test_wrong_arguments_are_one_clear_error(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        dc.fit(few_points(), integrator=dc.RK4(1), **arguments)  # pyright: ignore[reportArgumentType]


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


@pytest.mark.parametrize(("formulation", "step"), [("exact", 100.0), ("eulerian", 1e30)])
def test_too_long_a_step_diverges_and_says_so(formulation: str, step: float) -> None:
    solver = dc.GradientDescent(step=step)
    fit = dc.fit(few_points(), solver, dc.RK4(1), formulation=formulation)  # pyright: ignore[reportArgumentType]
    assert not fit.converged
    assert "diverged" in fit.status
    assert "lower `step`" in fit.status
    assert fit.iterations == len(fit.history) - 1
    assert fit.energy == pytest.approx(min(fit.history), rel=1e-12)
