"""Fits to functionals of k1 instead of its coordinates."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from fit_bank import noise_blocks
from math_bank import K_V, K_W, normal, uniform
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.fitting.problem import Problem
from diffeo_calib.maps.observation import LinearFunctionals, Observation, ReadPoints
from diffeo_calib.robots import elastic_rr

ROWS = 30


def configurations() -> Tensor:
    return uniform(ROWS, 2, seed=3)


def distances(fixed: Tensor) -> ReadPoints:
    return ReadPoints(lambda own, point: (point - own).norm()[None], fixed, fixed.shape[1])


def observations() -> dict[str, Observation]:
    angle = 6.0 * uniform(ROWS, 1, seed=5)
    axes = torch.stack([angle.cos(), angle.sin()], -1)
    where = torch.tensor([[2.5, 0.5], [-2.0, 1.5]], dtype=torch.float64).repeat(ROWS // 2, 1)
    return {"distance": distances(where), "plane": LinearFunctionals(axes, 0.1 * normal(ROWS, 1, seed=7))}


def problem_of(observe: Observation, noise: object = 1e-3) -> Problem:
    x = configurations()
    y = observe.value(elastic_rr.real(x))
    return Problem(elastic_rr.nominal, x, y, joint_kernel=K_V, task_kernel=K_W, noise=noise, observe=observe)


def test_the_identity_as_a_functional_is_a_measured_position(tmp_path: Path) -> None:
    x, blocks = configurations(), noise_blocks(ROWS, 2)
    y = elastic_rr.real(x)
    kernels: dict[str, Any] = {"joint_kernel": K_V, "task_kernel": K_W}
    eye = torch.eye(2, dtype=torch.float64).expand(ROWS, 2, 2)
    turn = torch.linalg.qr(normal(ROWS, 2, 2, seed=6)).Q
    whole = Problem(elastic_rr.nominal, x, y, noise=blocks, new_noise=blocks[0], **kernels)
    turned = Problem(
        elastic_rr.nominal,
        x,
        (turn @ y[:, :, None])[:, :, 0] - 0.25,
        noise=turn @ blocks @ turn.mT,
        new_noise=blocks[0],
        observe=LinearFunctionals(turn @ eye, torch.full((ROWS, 2), 0.25, dtype=torch.float64)),
        **kernels,
    )
    first, second = (dc.fit(problem, integrator=dc.RK4(2)) for problem in (whole, turned))
    assert second.energy == pytest.approx(first.energy, rel=1e-9)
    at = uniform(20, 2, seed=9)
    torch.testing.assert_close(second.model(at), first.model(at), rtol=0, atol=1e-7)
    for mine, theirs in zip(second.model.predict(at), first.model.predict(at), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-5, atol=1e-7)
    dc.save(second.model, tmp_path / "model.safetensors")
    again = dc.load(tmp_path / "model.safetensors", elastic_rr.nominal)
    for mine, theirs in zip(again.predict(at), second.model.predict(at), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("name", [pytest.param("distance", marks=pytest.mark.slow), "plane"])
def test_certificates_and_solvers(name: str) -> None:
    """Gauss-Newton by both linear solvers ends at one optimum, which (12) certifies and L-BFGS cannot lower."""
    problem, steps = problem_of(observations()[name], noise=0.01), dc.RK8(2)
    found = dc.fit(problem, dc.GaussNewton(tolerance=1e-6), steps)
    assert found.converged, found.status
    assert max(found.coupling_residual, found.end_residual) < 1e-6
    by_sums = dc.fit(problem, dc.GaussNewton(tolerance=1e-6, linear="cg"), steps)
    assert by_sums.energy == pytest.approx(found.energy, rel=1e-9)
    descended = dc.fit(problem, dc.LBFGS(max_iterations=10), steps, start=found.momenta)
    assert descended.energy == pytest.approx(found.energy, rel=1e-8)
    gradient = _gradient(problem, found)
    assert float(gradient.norm()) < 1e-5 * float(_gradient(problem, None).norm())
    miss = (found.model(problem.x) - elastic_rr.real(problem.x)).norm(dim=1).mean()
    before = (elastic_rr.nominal(problem.x) - elastic_rr.real(problem.x)).norm(dim=1).mean()
    assert float(miss) < 0.5 * float(before)


def _gradient(problem: Problem, found: dc.Fit | None) -> Tensor:
    at = (problem.zero() if found is None else found.momenta).flatten().clone().requires_grad_()
    total = problem.energy(problem.deform(problem.zero().unflatten(at), dc.RK8(2))).total
    return torch.autograd.grad(total, at)[0]


def test_what_problems_refuse() -> None:
    observe = observations()["distance"]
    kernels: dict[str, Any] = {"joint_kernel": K_V, "task_kernel": K_W, "noise": 1e-3}
    x = configurations()
    with pytest.raises(InputError, match=r"`y`.*\(30, 1\)"):
        Problem(elastic_rr.nominal, x, elastic_rr.real(x), observe=observe, **kernels)
    with pytest.raises(InputError, match="Observation"):
        Problem(elastic_rr.nominal, x, x[:, :1], observe=len, **kernels)  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="Eulerian"):
        dc.fit(problem_of(observe), formulation="eulerian")
