"""Kernels, problems and models move to another device with all their tensors."""

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


def tensors(kernel: Kernel) -> list[Tensor]:
    return [value for term in kernel.terms for value in vars(term).values() if isinstance(value, Tensor)]


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
