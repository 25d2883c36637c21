"""Every tensor of the package says its device: a default device of the user's program changes nothing."""

from __future__ import annotations

import pytest
import torch
from math_bank import CASES, Case
from section_5 import section_5
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.kernels.base import Kernel
from diffeo_calib.robots import elastic_rr

every_case = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
TWICE = dc.GaussNewton(max_iterations=2)
FITS = {
    "Gauss-Newton": lambda problem: dc.fit(problem, integrator=dc.RK4(2)),
    "chosen steps": dc.fit,
    "adaptive": lambda problem: dc.fit(problem, TWICE, dc.TorchDiffEq("dopri5", rtol=1e-2, atol=1e-3)),
    "L-BFGS": lambda problem: dc.fit(problem, dc.LBFGS(max_iterations=5), dc.RK4(2)),
    "conjugate gradients": lambda problem: dc.fit(problem, dc.GaussNewton(linear="cg"), dc.RK4(2)),
    "controls": lambda problem: dc.fit(problem, TWICE, controls=20, integrator=dc.RK4(2)),
    "eulerian": lambda problem: dc.fit(problem, dc.LBFGS(max_iterations=5), dc.RK4(1), formulation="eulerian"),
}


def tensors(kernel: Kernel) -> list[Tensor]:
    return [value for term in kernel.terms for value in vars(term).values() if isinstance(value, Tensor)]


@pytest.mark.parametrize("name", FITS)
def test_a_default_device_does_not_matter(name: str) -> None:
    x = section_5(k=6).x
    expected = FITS[name](section_5(k=6))
    with torch.device("meta"):
        found = FITS[name](section_5(k=6))
        at = found.model(x), found.model.jacobian(x)
        if name != "eulerian":
            at = (*at, found.model.predict(x)[1])
    assert found.energy == expected.energy
    assert all(t.device.type == "cpu" for t in at)
    torch.testing.assert_close(at[0], expected.model(x), rtol=0, atol=0)


@every_case
def test_kernels_move_with_all_their_numbers(case: Case) -> None:
    there = case.kernel.to("meta")
    assert {t.device.type for t in tensors(there)} == {"meta"}
    assert {t.device.type for t in tensors(case.kernel)} == {"cpu"}
    x = case.points(4)
    torch.testing.assert_close(case.kernel.to("cpu").matrix(x, x), case.kernel.matrix(x, x), rtol=0, atol=0)


def test_problems_and_models_move() -> None:
    problem = section_5(k=5)
    moved = problem.to("meta")
    parts = [moved.x, moved.y, moved.controls, moved.noise.covariance, *tensors(moved.spec.joint_kernel)]
    assert {t.device.type for t in parts[:3] + parts[4:]} == {"meta"}
    fit = dc.fit(problem.to("cpu"), integrator=dc.RK4(2))
    x = elastic_rr.grid(3)
    torch.testing.assert_close(fit.model.to("cpu")(x), fit.model(x), rtol=0, atol=0)
