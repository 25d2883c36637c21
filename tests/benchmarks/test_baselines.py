"""Peers of the benchmark on real robots: joint offsets and learners on known answers."""

from __future__ import annotations

import baselines
import numpy as np
import pytest
import torch
from real_robots_bank import arm_data, sliding

import diffeo_calib as dc
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.simulated_arm import SimulatedArm


def test_joint_offsets_are_recovered() -> None:
    """A slide and turning joints, two markers; offsets that base and tool can replace are not compared."""
    robot, data = sliding()
    truth = torch.tensor([0.02, -0.01, 4e-3, 0.015, -0.03], dtype=torch.float64)
    true = Geometry.nominal(robot, 2)
    points = data.points.new_tensor([[0.05, 0.02, 0.1], [-0.04, 0.0, 0.06]])
    poses = robot(data.q + truth)
    seen = points @ poses[:, :3, :3].mT + poses[:, None, :3, 3]
    geometry, offsets = baselines.with_offsets(robot, dc.Measurements(data.q, seen))
    assert float((geometry.points(data.q) - seen).norm(dim=-1).max()) < 1e-9
    assert offsets[1:4] == pytest.approx(truth[1:4].numpy(), abs=1e-7)
    turned = geometry.joint_errors @ torch.linalg.inv(true.joint_errors)
    assert float(turned[[0, 1, 3, 4], :3, 3].abs().max()) < 1e-12  # nothing but turns about the joints' own axes
    own = (turned[..., :3, :3] @ robot.axes[..., None])[..., 0]
    assert float((own - robot.axes).abs().max()) < 1e-12


def test_an_unobservable_offset_stays_small() -> None:
    """A joint that hardly turns: base and tool can replace its offset."""
    arm = SimulatedArm(seed=1)
    q = arm.sample(60)
    q[:, 4] = 0.5 + 1e-3 * q[:, 4]
    _, offsets = baselines.with_offsets(arm.nominal, dc.Measurements(q, arm.true_points(q)))
    assert float(np.abs(offsets).max()) < 2 * baselines.OFFSET_PRIOR


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("method", ["geometry + GP", "geometry + boosting", "geometry + network", "GP alone"])
def test_learners_take_slides_and_several_markers(method: str) -> None:
    robot, data = sliding()
    fitted = baselines.METHODS[method](robot, data[:30], 0)
    assert fitted.kinematics(data.q).shape == (40, 2, 3)
    assert float((fitted.kinematics(data.q[:30]) - data.points[:30]).norm(dim=-1).mean()) < 0.1


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_a_learner_finds_a_smooth_residual() -> None:
    """The process predicts it; no remark, since its settings were chosen on all rows."""
    robot, train, test = arm_data(120)

    def wave(q: torch.Tensor) -> torch.Tensor:
        return 1e-3 * torch.stack([q[:, 0].sin(), q[:, 1].cos(), (q[:, 0] + q[:, 1]).sin()], dim=1)[:, None]

    data = dc.Measurements(train.q, wave(train.q))
    fitted = baselines.corrected(lambda q: torch.zeros(len(q), 1, 3), robot, data, 0, baselines.processes)
    assert dc.evaluate(fitted.kinematics, dc.Measurements(test.q, wave(test.q))).rms < 1e-4
    assert fitted.note is None


@pytest.mark.usefixtures("quick")
def test_a_subset_of_rows_is_noted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(baselines, "MOST_SELECTED", 20)
    monkeypatch.setattr(baselines, "MOST_ROWS", 30)
    robot, train, _ = arm_data(40)
    note = baselines.METHODS["geometry + GP"](robot, train, 0).note
    assert note == "settings chosen on 20 of 40 training rows; conditioned on 30 rows"
    assert baselines.METHODS["geometry + network"](robot, train, 0).note == "settings chosen on 20 of 40 training rows"
