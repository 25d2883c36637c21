"""Gradient descent with a fixed step, and the paper's two algorithms, which are built on the same parts."""

from __future__ import annotations

from itertools import pairwise
from math import factorial

import numpy as np
import pytest
import torch
from math_bank import few_points, normal, rr_problem, uniform
from numpy.polynomial import hermite_e

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, NumericalError
from diffeo_calib.paper.algorithms import Descent, Discretisation, evaluate, lr_calibration, section_5
from diffeo_calib.paper.eulerian_flow import Eulerian
from diffeo_calib.robots import elastic_rr

STEP = 0.05


def easy() -> dc.Problem:
    """Few points, far apart, and much noise: the Hessian is benign."""
    return few_points()


@pytest.mark.slow
@pytest.mark.parametrize(("formulation", "step", "tolerance"), [("exact", 0.15, 1e-3), ("eulerian", 0.05, 3e-3)])
def test_finds_the_optimum_of_an_easy_problem(formulation: str, step: float, tolerance: float) -> None:
    problem = easy()
    solver = dc.GradientDescent(step=step, tolerance=tolerance, max_iterations=300)
    fit = dc.fit(problem, solver, dc.RK4(1), formulation=formulation)  # pyright: ignore[reportArgumentType]
    best = dc.fit(problem, dc.LBFGS(max_iterations=40), dc.RK4(1), formulation=formulation)  # pyright: ignore[reportArgumentType]
    assert fit.converged
    assert fit.status.startswith("converged: gradient")
    assert fit.energy == pytest.approx(best.energy, rel=2e-3)
    assert all(after <= before for before, after in pairwise(fit.history))
    assert fit.history[0] == pytest.approx(float(problem.energy(problem.deform(problem.zero(), dc.RK4(1))).total))
    assert fit.iterations == len(fit.history) - 1 == fit.evaluations - 1


def test_begins_where_it_is_told() -> None:
    problem = easy()
    start = problem.zero().unflatten(0.05 * normal(24, seed=3))
    fit = dc.fit(problem, dc.GradientDescent(step=STEP, max_iterations=5), dc.RK4(1), start=start)
    there = float(problem.energy(problem.deform(start, dc.RK4(1))).total)
    assert fit.history[0] == pytest.approx(there, rel=1e-12)
    assert fit.history[-1] < there


@pytest.mark.parametrize("formulation", ["exact", "eulerian"])
def test_too_long_a_step_diverges_and_says_so(formulation: str) -> None:
    solver = dc.GradientDescent(step=100.0)
    fit = dc.fit(easy(), solver, dc.RK4(1), formulation=formulation)  # pyright: ignore[reportArgumentType]
    assert not fit.converged
    assert "diverged" in fit.status
    assert "lower `step`" in fit.status
    assert fit.energy == pytest.approx(min(fit.history), rel=1e-12)


def test_limit_and_interruption_keep_the_best_state() -> None:
    fit = dc.fit(easy(), dc.GradientDescent(step=STEP, max_iterations=3), dc.RK4(1))
    assert "raise `max_iterations`" in fit.status
    assert fit.solution.exhausted
    assert fit.iterations == 3
    assert fit.energy == pytest.approx(fit.history[-1], rel=1e-12)

    def stop(task: str, done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    fit = dc.fit(easy(), dc.GradientDescent(step=STEP), dc.RK4(1), progress=stop)
    assert fit.solution.interrupted
    assert fit.energy == pytest.approx(min(fit.history), rel=1e-12)


def test_on_the_test_bed_it_crawls() -> None:
    """The stable step is set by the largest eigenvalue; hundreds of steps would hardly change the rest."""
    fits = [
        dc.fit(rr_problem(6), dc.GradientDescent(step=step, max_iterations=20), dc.RK4(1), formulation="eulerian")
        for step in (3e-9, 1e-4)
    ]
    assert fits[0].history[-1] < fits[0].history[0]
    assert fits[0].energy > 100 * dc.fit(rr_problem(6), dc.LBFGS(max_iterations=20), formulation="eulerian").energy
    assert "diverged" in fits[1].status


@pytest.mark.parametrize(
    "arguments",
    [{"step": 0.0}, {"step": -1.0}, {"step": 1.0, "tolerance": -1.0}, {"step": 1.0, "max_iterations": 0}],
)
def test_wrong_settings(arguments: dict[str, float]) -> None:
    with pytest.raises(InputError, match=r"`(step|tolerance|max_iterations)`: expected"):
        dc.GradientDescent(**arguments)  # pyright: ignore[reportArgumentType]


# --- Algorithms 1 and 2 -----------------------------------------------------------------------------------------------


def test_algorithm_1_is_gradient_descent_from_zero() -> None:
    problem = easy()
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


def test_algorithm_1_diverges_with_one_clear_error() -> None:
    problem = easy()
    K = problem.spec.joint_kernel, problem.spec.task_kernel
    with pytest.raises(NumericalError, match="lower `mu`"):
        lr_calibration(problem.x, problem.y, elastic_rr.nominal, *K, 0.3, Descent(1e60, 1e-9, 50))
    with pytest.raises(InputError, match="`mu`"):
        lr_calibration(problem.x, problem.y, elastic_rr.nominal, *K, 0.3, Descent(-1.0, 1e-9, 50))


@pytest.mark.parametrize("equations", [Eulerian(), Eulerian(printed_jacobian=False)], ids=repr)
def test_algorithm_2_answers_like_the_fitted_model(equations: Eulerian) -> None:
    problem = easy()
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
    with pytest.raises(InputError, match="`K_V`: expected a kernel"):
        evaluate(xi, problem.x, fit.momenta.task, elastic_rr.nominal, None, K[1])  # pyright: ignore[reportArgumentType]
    for wrong, name in (({"equations": "printed"}, "equations"), ({"integrator": "rk4"}, "integrator")):
        with pytest.raises(InputError, match=f"`{name}`: expected"):
            evaluate(xi, problem.x, fit.momenta.task, elastic_rr.nominal, *K, Discretisation(**wrong))  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match=r"`k\(xi\)`"):
        evaluate(xi * 0 + 7, problem.x, fit.momenta.task, lambda x: elastic_rr.nominal(x) + (6.5 - x).log() * 0, *K)
    assert [tuple(t.shape) for t in evaluate(xi[:0], problem.x, fit.momenta.task, elastic_rr.nominal, *K)] == [
        (0, 2),
        (0, 2, 2),
    ]
    plain = [t.numpy() for t in (xi, problem.x, fit.momenta.task)]
    torch.testing.assert_close(
        evaluate(*plain, elastic_rr.nominal, *K, Discretisation(equations))[0], k1, rtol=0, atol=0
    )  # pyright: ignore


@pytest.mark.parametrize("k", [0, 2.5, "16"])
def test_grids_that_are_none(k: object) -> None:
    with pytest.raises(InputError, match="`k`: expected"):
        section_5(0.01, k)  # pyright: ignore[reportArgumentType]


def test_algorithms_1_and_2_hand_over() -> None:
    problem = easy()
    K = problem.spec.joint_kernel, problem.spec.task_kernel
    calibrated = lr_calibration(problem.x, problem.y, elastic_rr.nominal, *K, 0.3, Descent(STEP, 1e-3, 20))
    k1, _ = evaluate(problem.x, *calibrated)
    before, after = ((y - problem.y).norm() for y in (elastic_rr.nominal(problem.x), k1))
    assert float(after) < float(before)


# --- Errata 4 and 5 ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_erratum_4_sigma_100_is_no_sigma() -> None:
    """As the sigma of (5) it leaves the model as it is; as a weight or an inverse it calibrates."""
    x = uniform(300, 2, seed=2)

    def error(sigma: float) -> float:
        model = dc.fit(rr_problem(6, noise=sigma), dc.LBFGS(max_iterations=15), dc.RK4(2), formulation="eulerian").model
        return float((model(x) - elastic_rr.real(x)).norm(dim=1).mean())

    nominal = float((elastic_rr.nominal(x) - elastic_rr.real(x)).norm(dim=1).mean())
    assert error(100.0) > 0.9 * nominal
    for weight in (100.0, 5000.0):  # 1 / (2 sigma^2)
        assert error((2 * weight) ** -0.5) < 0.05 * nominal


def gaussian_derivative(order: int, x: np.ndarray, variance: float) -> np.ndarray:
    """The derivative of exp(-x^2 / (2 variance)) of an even order, by Hermite polynomials."""
    polynomial = hermite_e.hermeval(x / variance**0.5, [0.0] * order + [1.0])
    return variance ** (-order / 2) * polynomial * np.exp(-(x**2) / (2 * variance))


def inverted(coefficient: object, x: np.ndarray, y: np.ndarray, terms: int = 60) -> np.ndarray:
    """sum_beta c(beta_1) c(beta_2) D^(2 beta) of K * f, where f = exp(-|x|^2 / 2) and K is the Gaussian kernel."""
    parts = []
    for at in (x, y):
        series = [coefficient(b) * gaussian_derivative(2 * b, at, 2.0) for b in range(terms)]  # pyright: ignore
        parts.append(np.sum(series, 0) / 2**0.5)  # K * f = exp(-x^2 / 4) / sqrt(2) per coordinate
    return parts[0] * parts[1]


def test_erratum_5_the_factorial_inverts_the_gaussian_kernel() -> None:
    """L (K * f) = f for L = sum (-1)^|beta| / (2^|beta| prod beta_j!) D^(2 beta); what is printed does not.

    With D the plain derivative the alternating sign is needed too; with D = -i d/dx it is in D^(2 beta).
    As printed, prod beta_j is 0, and its inverse undefined, wherever some beta_j is 0: 1 is taken there.
    """
    x, y = (t.ravel() for t in np.meshgrid(np.linspace(-1.5, 1.5, 7), np.linspace(-1.5, 1.5, 7)))
    f = np.exp(-(x**2 + y**2) / 2)
    np.testing.assert_allclose(inverted(lambda b: (-0.5) ** b / factorial(b), x, y), f, rtol=0, atol=1e-8)
    for printed in (
        lambda b: (-0.5) ** b / max(b, 1),  # no factorial
        lambda b: 0.5**b / factorial(b),  # no sign: that smooths once more
    ):
        assert np.abs(inverted(printed, x, y, 12) - f).max() > 0.05


def test_errata_are_in_one_frozen_place() -> None:
    assert Eulerian() == Eulerian(printed_sign=False, printed_jacobian=True, printed_divergence=False)
    with pytest.raises(AttributeError):
        Eulerian().printed_sign = True  # pyright: ignore[reportAttributeAccessIssue]
