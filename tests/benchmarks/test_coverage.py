"""The benchmark of coverage: its draws, its distances, and one whole record."""

from __future__ import annotations

import coverage
import numpy as np
import pytest
import torch

import diffeo_calib as dc
from diffeo_calib.robots.simulated_arm import SimulatedArm


def test_configurations_beyond_the_limits_are_near_them() -> None:
    arm = SimulatedArm(seed=0)
    q = coverage.beyond(arm, 200, np.random.default_rng(0))
    low, high = arm.nominal.limits.unbind(1)
    assert q.shape == (200, 6)
    assert bool(((q < low) | (q > high)).any(1).all())
    margin = coverage.BEYOND * (high - low)
    assert bool(((q >= low - margin) & (q <= high + margin)).all())


def test_noise_is_gaussian_or_has_heavy_tails() -> None:
    shape, rng = (20_000, 1, 3), np.random.default_rng(0)
    clean, heavy = (coverage.noise(shape, case, 2e-5, rng) for case in ("clean", "t3"))
    assert float(clean.std()) == pytest.approx(2e-5, rel=0.02)
    assert float(heavy.abs().median()) == pytest.approx(0.765 * 2e-5, rel=0.03)  # of Student's t
    assert float(heavy.abs().max()) > 10 * float(clean.abs().max())


def test_squared_distances_are_chi_squared() -> None:
    root = torch.tensor([[1.0, 0.0, 0.0], [2.0, 1.0, 0.0], [0.5, -1.0, 3.0]], dtype=torch.float64)
    errors = torch.from_numpy(np.random.default_rng(0).standard_normal((20_000, 3))) @ root.T
    inside = coverage.squares(errors, (root @ root.T).expand(20_000, 3, 3)) < coverage.INSIDE_95
    assert float(inside.double().mean()) == pytest.approx(0.95, abs=0.005)


def test_repeats_stay_on_one_side() -> None:
    q, points = SimulatedArm(seed=0).measure(20)
    twice = dc.Measurements(torch.cat([q, q]), torch.cat([points, points + 1e-5]))
    for seed in range(3):
        train, test = coverage.split(twice, 11, seed)
        assert len(train) == 12
        assert len(test) == 28
        assert float(torch.cdist(train.q, test.q).min()) > 0


def test_summary_of_records() -> None:
    records = [
        {"case": "clean", "poses": 30, "seed": seed, "measured": value, "perfect_std": 0.02, "rms_mm": 0.1}
        | {"seconds": 1.0}
        for seed, value in enumerate((0.9, 0.95, 1.0))
    ]
    (row,) = coverage.summary([*records, {"case": "clean", "poses": 30, "seed": 3, "note": "it failed"}])
    assert row["seeds"] == 3
    assert row["measured"] == "0.950 +- 0.124"
    assert row["measured_std"] == pytest.approx(0.05)
    assert row["measured_min"] == pytest.approx(0.9)


@pytest.mark.slow
def test_one_record() -> None:
    record = coverage.simulated("outliers", 20, 0)
    for name in ("measured", "true", "outside"):
        assert 0.5 < float(record[name] or 0) <= 1.0, name
    assert 0.005 < float(record["perfect_std"] or 0) < 0.08
