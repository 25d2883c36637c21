"""A refusal needs a proof: rows of usual robots, unusually commanded or rounded, are calibrated."""

from __future__ import annotations

import math

import pytest
import torch
from product_bank import with_usual_scales
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.robots.joint import Joint
from diffeo_calib.robots.simulated_arm import SimulatedArm


def rounded(values: Tensor, step: float) -> Tensor:
    return (values / step).round() * step


def on_a_rail(arm: SimulatedArm) -> dc.Chain:
    rail = Joint("rail", "prismatic", torch.eye(4, dtype=torch.float64), lower=-1.0, upper=1.0)
    return dc.Chain("on a rail", "ground", arm.nominal.tip, [rail, *arm.nominal.joints])


@pytest.mark.filterwarnings("ignore:rail. never moved")
def test_a_rail_that_stands_still_is_calibrated() -> None:
    """Its values, near zero, are near a multiple of any step."""
    arm = SimulatedArm(seed=1)
    q, y = arm.measure(40, seed=2)
    rail = 1e-6 * torch.arange(40, dtype=torch.float64).remainder(53)
    data = dc.Measurements(torch.cat([rail[:, None], q], 1), rounded(y, 1e-6))
    assert with_usual_scales(on_a_rail(arm), data).left_out_rms < 2e-4


def test_poses_commanded_in_whole_degrees_are_calibrated() -> None:
    """An elastic arm that errs by a millimetre, which steps of 1 degree would explain if they were reported so."""
    arm = SimulatedArm(seed=1, gravity=2.0)
    q = rounded(arm.sample(40, 3).rad2deg(), 1.0).deg2rad()
    noise = arm.noise * torch.randn(40, 1, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    result = with_usual_scales(arm.nominal, dc.Measurements(q, rounded(arm.true_points(q) + noise, 1e-6)))
    assert 5e-4 < result.registration.rms < 5e-3
    assert result.left_out_rms < 0.3 * result.registration.rms
    assert math.isfinite(result.expected.workspace)
