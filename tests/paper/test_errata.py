"""The errata of the paper, each shown on its test bed, and its numbers."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from eulerian_bank import CORRECTED, P0, deformed, momenta, small_problem
from math_bank import rr_problem, uniform
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.fitting.problem import tangent
from diffeo_calib.paper.eulerian import Eulerian, EulerianProblem
from diffeo_calib.robots import elastic_rr


@pytest.fixture(scope="module")
def bed() -> dc.Problem:
    return rr_problem(8)


def fitted(problem: dc.Problem, **errata: bool) -> dc.Fit:
    return dc.fit(problem, dc.LBFGS(max_iterations=30), dc.RK4(2), formulation="eulerian", **errata)  # pyright: ignore[reportArgumentType]


@pytest.fixture(scope="module")
def corrected(bed: dc.Problem) -> dc.Fit:
    return fitted(bed)


def jacobian_error(model: FittedMap | Callable[[Tensor], Tensor], x: Tensor) -> float:
    assert isinstance(model, FittedMap)
    pushes = 1e-5 * torch.eye(2, dtype=torch.float64)
    differences = torch.stack([(model(x + h) - model(x - h)) / 2e-5 for h in pushes], 2)
    return float((model.jacobian(x) - differences).norm() / differences.norm())


def mean_error(model: Callable[[Tensor], Tensor], x: Tensor) -> float:
    return float((model(x) - elastic_rr.real(x)).norm(dim=1).mean())


def test_corrected_sign_fits_the_test_bed(bed: dc.Problem, corrected: dc.Fit) -> None:
    x = uniform(500, 2, seed=7)
    assert corrected.energy == pytest.approx(dc.fit(bed).energy, rel=0.5)
    assert mean_error(corrected.model, x) < 1e-2 * mean_error(elastic_rr.nominal, x)
    assert corrected.formulation == "eulerian"
    assert np.isnan(corrected.coupling_residual)
    assert np.isfinite(corrected.end_residual)
    assert corrected.evaluations > corrected.iterations > 0


def test_erratum_1_printed_sign_is_slow(bed: dc.Problem, corrected: dc.Fit) -> None:
    """No shooting step lowers the energy, and a descent from zero needs many times more evaluations."""
    solver = dc.LBFGS(max_iterations=corrected.iterations)
    fit = dc.fit(bed, solver, dc.RK4(2), formulation="eulerian", printed_sign=True)
    assert not fit.converged
    assert fit.energy > 2 * corrected.energy
    assert EulerianProblem(bed, Eulerian(printed_sign=True)).start(dc.RK4(2))[0].task.count_nonzero() == 0
    for equations, lowers in ((Eulerian(printed_sign=True), False), (Eulerian(), True)):
        problem = EulerianProblem(bed, equations)
        start = tangent(bed).momenta().task
        energies = [float(problem.energy(problem.deform(momenta(s * start), dc.RK4(2))).total) for s in (0.0, 0.5, 1.0)]
        assert (max(energies[1:]) < energies[0]) is lowers
        assert (min(energies[1:]) > energies[0]) is not lowers


def test_erratum_2_order_of_the_missing_term() -> None:
    """Dk1 compared with differences of k1: a first-order error as printed, a second-order one with -D^2k0[v]."""
    x = uniform(10, 2, seed=0)
    for equations, ratio in ((Eulerian(), 2.0), (CORRECTED, 4.0)):
        errors = [jacobian_error(FittedMap(deformed(s * P0, equations), small_problem().noise), x) for s in (0.1, 0.05)]
        assert errors[0] / errors[1] == pytest.approx(ratio, rel=0.15)


def test_erratum_3_the_energy_drifts_with_p_div_v_and_not_without(bed: dc.Problem, corrected: dc.Fit) -> None:
    """On the optimum's path 1/2 |v|^2 + 1/2 |w|^2 should be constant."""
    printed = fitted(bed, printed_divergence=True)
    assert corrected.energy_drift < 0.01
    assert printed.energy_drift > 10 * corrected.energy_drift
    assert printed.energy > corrected.energy
