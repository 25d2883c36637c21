"""The benchmark of covariates: a drift is found where there is one, by formulas that a second way confirms."""

from __future__ import annotations

import covariates
import pytest
import torch
from covariates import Split
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.robots.simulated_arm import SimulatedArm

TRAIN, ROWS = 60, 90


def drifting() -> tuple[Split, Tensor, Tensor]:
    """An arm whose tracker moves by 0.2 mm, the time of the rows, and a shuffled one."""
    arm, time = SimulatedArm(0), torch.linspace(-1.0, 1.0, ROWS, dtype=torch.float64)
    q, points = arm.measure(ROWS, seed=1)
    seen = points + 1e-4 * time[:, None, None] * torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    order, other = (torch.randperm(ROWS, generator=generator) for _ in range(2))
    data = dc.Measurements(q, seen).rows(order)
    return Split(arm.nominal, data[:TRAIN], data[TRAIN:]), time[order], time[other]


@pytest.mark.slow
def test_a_drift_is_found_and_a_shuffled_time_is_not() -> None:
    model, time, shuffled = drifting()
    ratio, further = model.likeliest("frame, linear", time)
    assert ratio > 30.0
    assert model.likeliest("frame, linear", shuffled)[0] < 10.0
    assert model.predicted(further, known=True)[0] < 0.9 * model.without[0]
    # densities of torch, and the normal equations of the regression, are the second way
    whole = model.prior + model.noise
    matrices = [(whole + scale * further)[model.fit, model.fit].contiguous() for scale in (0.0, 1.0)]
    target = model.target[model.fit]
    normals = (torch.distributions.MultivariateNormal(torch.zeros_like(target), matrix) for matrix in matrices)
    plain, drifting_too = (float(one.log_prob(target)) for one in normals)
    assert ratio == pytest.approx(2 * (drifting_too - plain), rel=1e-8)
    for known in (True, False):
        across = (model.prior + known * further)[model.new, model.fit]
        mean = across @ torch.linalg.solve(matrices[1], model.target[model.fit])
        away = (model.target[model.new] - mean).view(-1, 3)
        rms, _ = model.predicted(further, known=known)
        assert rms == pytest.approx(1e6 * float(away.square().sum(1).mean().sqrt()), rel=1e-6)


def test_scaled_and_approach() -> None:
    q = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.5, 1e-4]], dtype=torch.float64)
    assert covariates.approach(q).tolist() == [[0, 0], [1, 0], [-1, 0]]
    assert covariates.scaled(torch.tensor([4.0, 8.0, 10.0]), 2).tolist() == [-1, 1, 2]
