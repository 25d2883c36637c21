"""Rigid exports of models that were registered with other markers than those of the fit."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from product_bank import Case, simulated

import diffeo_calib as dc
from diffeo_calib.interop.rigid import rigid_kinematics


@pytest.mark.slow
def test_another_number_of_markers(arm: Case) -> None:
    true, q = simulated(1)[0], arm.test.q[:20]
    markers = torch.tensor([[0.05, 0.0, 0.1], [0.0, -0.06, 0.12]], dtype=torch.float64)
    true.truth = replace(true.truth, tool=markers)
    registered = arm.model.registered(dc.Measurements(q, true.true_points(q)))
    found = rigid_kinematics(registered)
    assert found.geometry.markers == 2
    fitted = rigid_kinematics(arm.model)
    assert found.rms < 2.0 * fitted.rms
