"""Joint offsets far from a robot's description: found among geometric errors, absorbed exactly, mimic joints too."""

from __future__ import annotations

import math

import pytest
import torch
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.identification import registration
from diffeo_calib.calibration.identification.registration import (
    find_joint_offsets,
    register,
    register_robustly,
    with_joint_offsets,
)
from diffeo_calib.common.errors import DiffeoCalibWarning
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.simulated_arm import SimulatedArm

ARM = SimulatedArm(seed=3)


@pytest.mark.parametrize(("joint", "degrees"), [(1, 10.0), (2, -25.0), (3, 12.0), (4, 45.0)])
def test_one_joint_is_found_among_geometric_errors(joint: int, degrees: float) -> None:
    q, points = ARM.measure(50, seed=1)
    wrong = q.clone()
    wrong[:, joint] -= math.radians(degrees)
    offsets = find_joint_offsets(register(ARM.nominal, wrong, points).geometry, wrong, points)
    expected = torch.zeros(6, dtype=torch.float64)
    expected[joint] = math.radians(degrees)
    assert_close(offsets[1:5], expected[1:5], rtol=0, atol=0.01)  # base and marker may carry the first and the last


def test_gross_outliers_do_not_decide() -> None:
    q, points = ARM.measure(60, seed=1)
    wrong, points = q.clone(), points.clone()
    wrong[:, 2] -= 0.3
    points[:6, 0] += torch.randn(6, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    offsets = find_joint_offsets(register(ARM.nominal, wrong[6:], points[6:]).geometry, wrong, points)
    assert float(offsets[2]) == pytest.approx(0.3, abs=0.02)


def test_absorbed_offsets_are_exactly_other_joint_values() -> None:
    """Turning, sliding and mimic joints."""
    rows = [dc.DHRow(0.1, 0.3, 0.2), dc.DHRow(0.0, 0.5, 0.1, kind="prismatic"), dc.DHRow(0.2, -0.4, 0.0)]
    rows.append(dc.DHRow(0.3, 0.2, 0.1, mimic={"joint_1": -0.5, "joint_3": 1.0}))
    chain = dc.from_dh(rows)
    geometry = Geometry.nominal(chain, 2).absorb(
        0.1 * torch.randn(Geometry.nominal(chain, 2).size, dtype=torch.float64)
    )
    q = torch.randn(7, chain.n, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    offsets = torch.tensor([0.2, -0.05, 0.4], dtype=torch.float64)
    assert_close(with_joint_offsets(geometry, offsets).points(q), geometry.points(q + offsets), rtol=0, atol=1e-14)


@pytest.mark.parametrize("better", ["with", "without"])
def test_left_out_rows_decide_on_offsets(better: str, monkeypatch: pytest.MonkeyPatch) -> None:
    q, points = ARM.measure(40, seed=1)
    q[:, 2] -= 0.3
    data, robot = dc.Measurements(q, points), ARM.nominal
    if better == "with":
        with pytest.warns(DiffeoCalibWarning, match="joint offsets are far .*: elbow_joint by 17.* degrees: got"):
            assert register_robustly(robot, data).rms < 0.02
    else:
        monkeypatch.setattr(registration, "_left_out", lambda *_, with_offsets: 2.0 if with_offsets else 1.0)
        assert register_robustly(robot, data).rms > 0.05  # and no warning
