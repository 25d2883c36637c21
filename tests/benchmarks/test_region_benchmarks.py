"""The benchmarks of regions: what is right by construction holds 95 %."""

from __future__ import annotations

import numpy as np
import pytest
import region_limits
import regions
import torch
from reading_bank import scales
from regions import INSIDE_95

import diffeo_calib as dc


def test_right_regions_hold_nineteen_of_twenty_in_the_mean() -> None:
    own = regions.case("usual", 15, 0, None)
    model = dc.calibrate(own.robot, own.train, hyperparameters=scales()).model
    inside = (region_limits.squares(model, own.test.q[:60], 300, 0) < INSIDE_95).double().mean(0)
    assert float(inside.mean()) == pytest.approx(0.95, abs=0.01)
    assert 0.03 < float(inside.std()) < 0.2  # more than chance in 60 rows gives: errors have a cause in common


def test_squared_distances_are_chi_squared() -> None:
    root = torch.tensor([[1.0, 0.0, 0.0], [2.0, 1.0, 0.0], [0.5, -1.0, 3.0]], dtype=torch.float64)
    errors = torch.from_numpy(np.random.default_rng(0).standard_normal((20_000, 3))) @ root.T
    inside = regions.squares(errors, (root @ root.T).expand(20_000, 3, 3)) < INSIDE_95
    assert float(inside.double().mean()) == pytest.approx(0.95, abs=0.005)
