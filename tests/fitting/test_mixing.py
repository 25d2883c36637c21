"""Mixed steps: exact for linear iterations, and the same optimum of a fit with fewer factorisations."""

from __future__ import annotations

import pytest
import torch
from math_bank import rr_problem
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.fitting import gauss_newton
from diffeo_calib.fitting.gauss_newton import MIXING_DEPTH, Mixing
from diffeo_calib.fitting.result import Fit
from diffeo_calib.maps.deformation import Momenta


def momenta(task: Tensor) -> Momenta:
    """Task momenta alone, b and theta that follow from them linearly."""
    return Momenta(2.0 * task[:, :2], task, task.sum(0))


def contraction(rates: list[float], size: int = 4) -> tuple[Tensor, Tensor]:
    """A symmetric matrix with some eigenvalues beside zeros, and the fixed point of x -> A x + (1 - A) x*."""
    generator = torch.Generator().manual_seed(0)
    vectors = torch.linalg.qr(torch.randn(3 * size, 3 * size, dtype=torch.float64, generator=generator)).Q
    values = torch.zeros(3 * size, dtype=torch.float64)
    values[: len(rates)] = torch.tensor(rates, dtype=torch.float64)
    return vectors * values @ vectors.T, torch.randn(3 * size, dtype=torch.float64, generator=generator)


def iterates(rates: list[float], steps: int) -> tuple[Momenta, Tensor]:
    """The last point of a mixed linear iteration from zero, and its fixed point."""
    A, fixed = contraction(rates)
    mixing, x = Mixing(), torch.zeros_like(fixed)
    point = momenta(x.view(-1, 3))
    for _ in range(steps):
        target = momenta((A @ x + fixed - A @ fixed).view(-1, 3))
        point = mixing.mixed(point, target) or target
        x = point.task.flatten()
    return point, fixed


@pytest.mark.parametrize("rates", [[0.3], [0.5, -0.8], [0.9, 0.4, -0.2], [1.5, 0.5]])
def test_a_linear_iteration_ends_after_one_step_for_each_rate(rates: list[float]) -> None:
    """Two more for start and end; also one that diverges by itself."""
    point, fixed = iterates(rates, len(rates) + 2)
    assert_close(point.task.flatten(), fixed, rtol=1e-9, atol=1e-9)
    assert_close(point.joint, 2.0 * point.task[:, :2], rtol=1e-9, atol=1e-9)
    assert_close(point.theta, point.task.sum(0), rtol=1e-9, atol=1e-9)


def test_a_converged_iteration_stays() -> None:
    """Also after more steps than are kept: differences of steps are rounding then."""
    point, fixed = iterates([0.5, 0.2], 2 * MIXING_DEPTH)
    assert_close(point.task.flatten(), fixed, rtol=1e-9, atol=1e-9)


def fitted(monkeypatch: pytest.MonkeyPatch, below: float) -> Fit:
    monkeypatch.setattr(gauss_newton, "MIXED_RESIDUAL", below)
    return dc.fit(rr_problem(8), dc.GaussNewton(tolerance=1e-6), dc.RK8(2))


def test_the_optimum_is_the_same_after_fewer_iterations(monkeypatch: pytest.MonkeyPatch) -> None:
    plain, mixed = fitted(monkeypatch, 0.0), fitted(monkeypatch, 0.1)
    assert mixed.converged
    assert mixed.iterations < plain.iterations
    assert mixed.energy == pytest.approx(plain.energy, rel=1e-6)


def test_a_mixed_point_that_is_no_better_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    """Then the plain step is taken, and mixing starts again."""
    plain, asked = fitted(monkeypatch, 0.0), []

    def far(self: Mixing, current: Momenta, target: Momenta) -> Momenta:
        asked.append(1)
        return current.towards(target, -0.5)

    monkeypatch.setattr(Mixing, "mixed", far)
    found = fitted(monkeypatch, 0.1)
    assert asked
    assert found.iterations == plain.iterations
    assert found.history == plain.history
    assert found.evaluations > plain.evaluations
