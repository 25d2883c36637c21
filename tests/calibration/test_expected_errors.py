"""What a model expects of its errors: in the frame of a device, or after the best rigid motion where none holds it."""

from __future__ import annotations

import warnings
from typing import Any

import golden_bank
import pytest
import torch
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.expected_errors import expected_errors, workspace_deviation
from diffeo_calib.robots.se3 import twist_transform

FAR = twist_transform(torch.tensor([0.03, -0.02, 0.01, 0.02, 0.01, -0.03], dtype=torch.float64))


def calibrated(case: Any) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # few rows
        return dc.calibrate(case.robot, case.rows, hyperparameters=case.scales)


@pytest.mark.parametrize(("case", "free"), [(golden_bank.positions, False), (golden_bank.sockets, True)])
def test_rigid_motions_are_errors_of_a_model_in_the_frame_of_a_device_alone(case: Any, free: bool) -> None:
    model = calibrated(case()).model

    def away(q: Tensor) -> Tensor:
        return model(q) @ FAR[:3, :3].mT + FAR[:3, 3]

    found = expected_errors(model, {"itself": model, "away": away})
    own = workspace_deviation(model.map)
    assert found["itself"] == pytest.approx(own, rel=1e-6)
    if free:
        assert found["away"] == pytest.approx(own, rel=1e-6)
    else:
        assert found["away"] > 0.03


def test_the_workspace_is_drawn_once_within_the_ranges_of_the_rows() -> None:
    fitted = calibrated(golden_bank.positions()).model.map
    q = fitted.everywhere
    assert torch.equal(q, fitted.everywhere)
    assert bool(((q >= fitted.x.amin(0)) & (q <= fitted.x.amax(0))).all())
    assert bool((q.amax(0) - q.amin(0) > 0.9 * (fitted.x.amax(0) - fitted.x.amin(0))).all())
    free = fitted.without_rigid_motions()
    assert torch.equal(free.workspace, q)
    less = workspace_deviation(free)
    assert less < workspace_deviation(fitted)
    assert free.unregistered is free


def test_residual_and_shifts_of_a_fit_leave_its_noise() -> None:
    """R^-1 (y - h(k1)) = R_i^-1 (y - h(k1) - Z c), for sessions."""
    fit = calibrated(golden_bank.sessions()).fit
    noise = fit.problem.noise
    own = torch.linalg.solve(noise.covariance, (fit.residual - noise.shared @ fit.shifts)[..., None])[..., 0]
    torch.testing.assert_close(noise.solve(fit.residual), own, rtol=1e-6, atol=1e-6 * float(own.abs().max()))
    assert float(fit.shifts.norm()) > 0
