"""A rigid tool held by two hands: rows without a device, beside measured poses of both hands."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
import two_arms_bank
from product_bank import usual_scales
from tangent_bank import normal
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.measurements.poses import mark_points
from diffeo_calib.robots.se3 import rotation
from diffeo_calib.sensors.held_tool import HeldTools

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")]  # few rows
AXES = ("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0")
ORIGINS = ("0 {side} 0.3", "0 0 0.2", "0 0 0.35", "0.3 0 0", "0.1 0 0", "0.1 0 0")
NEWTON_STEPS = 12


def urdf() -> str:
    """Two arms of six joints on one base."""
    text = '<link name="base"/>'
    for hand, side in zip(two_arms_bank.HANDS, (0.35, -0.35), strict=True):
        parent = "base"
        for k, (axis, origin) in enumerate(zip(AXES, ORIGINS, strict=True)):
            child = f"{hand}_{k}"
            text += f'<link name="{child}"/><joint name="{hand}_j{k}" type="revolute"><parent link="{parent}"/>'
            text += f'<child link="{child}"/><origin xyz="{origin.format(side=side)}"/><axis xyz="{axis}"/>'
            text += '<limit lower="-3" upper="3"/></joint>'
            parent = child
        text += f'<link name="{hand}"/><joint name="{hand}_end" type="fixed"><parent link="{parent}"/>'
        text += f'<child link="{hand}"/><origin xyz="0.1 0 0.05"/></joint>'
    return f'<robot name="two_arms">{text}</robot>'


def away(arms: two_arms_bank.TwoArms, q: Tensor, X: Tensor) -> Tensor:
    """(N, 6) how far the second hand is from where a tool X has it, m and rad."""
    left, right = arms.poses(q).unbind(1)
    D = torch.linalg.inv(X) @ torch.linalg.inv(left) @ right
    skewed = D[:, :3, :3] - D[:, :3, :3].mT
    turn = 0.5 * torch.stack([skewed[:, 2, 1], skewed[:, 0, 2], skewed[:, 1, 0]], 1)
    return torch.cat([D[:, :3, 3], turn], 1)


def holding(arms: two_arms_bank.TwoArms, X: Tensor, home: Tensor, rows: int, seed: int) -> Tensor:
    """Configurations (N, 12) in which both hands hold the tool, by Newton steps of the second arm."""
    q = home + 0.6 * (2 * torch.rand(rows, 12, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) - 1)
    q[:, 6:] = home[6:]
    for _ in range(NEWTON_STEPS):
        J = torch.func.jacrev(lambda x: away(arms, x, X).sum(0))(q).movedim(1, 0)[..., 6:]  # (N, 6, 6)
        step = torch.linalg.lstsq(J, away(arms, q, X)[..., None]).solution[..., 0]
        q = torch.cat([q[:, :6], q[:, 6:] - step.clamp(-0.3, 0.3)], 1)
    return q[(away(arms, q, X).abs().amax(1) < 1e-9) & (q.abs().amax(1) < 2.5)]


@cache
def case(folder: Path) -> Any:
    path = folder / "arms.urdf"
    path.write_text(urdf())
    robot = dc.load_urdf(path, "base", list(two_arms_bank.HANDS))
    arms = two_arms_bank.TwoArms(robot)
    home = torch.tensor(
        [[0.3, 0.6, 0.9, 0.2, -0.6, 0.1], [-0.3, 0.6, 0.9, -0.2, -0.6, -0.1]], dtype=torch.float64
    ).flatten()
    left, right = arms.poses(home[None])[0]
    X = torch.linalg.inv(left) @ right
    q = holding(arms, X, home, 110, 3)
    q, kept = q[:32], q[32:]
    seen = q + 2e-5 * normal(*q.shape, seed=5)  # a tool is rigid to some hundredths of a millimetre
    held = dc.Readings.of("held tool", seen, torch.zeros(len(q), 6), None, robot.joint_names, numbers=6, doubt=False)
    free = home + 0.8 * (2 * torch.rand(16, 12, dtype=torch.float64, generator=torch.Generator().manual_seed(8)) - 1)
    turned = arms.poses(free)
    turned[..., :3, :3] = rotation(2e-4 * normal(16, 2, 3, seed=6)) @ turned[..., :3, :3]
    turned[..., :3, 3] += 2e-5 * normal(16, 2, 3, seed=7)
    tracked = dc.Measurements.from_poses(free, turned, robot.joint_names, on=two_arms_bank.HANDS)
    return robot, arms, X, tracked, held, kept


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return case(tmp_path_factory.mktemp("arms"))


def relative_errors(model: Any, arms: Any, q: Tensor) -> float:
    """RMS distance of the second hand from where the first has it, against the truth, m."""
    found, true = (torch.linalg.inv(poses[:, 0]) @ poses[:, 1] for poses in (model.poses(q), arms.poses(q)))
    return float((found - true)[:, :3, 3].norm(dim=1).square().mean().sqrt())


def test_slopes_are_derivatives(made: Any) -> None:
    _, arms, X, _, held, _ = made
    points = torch.cat([mark_points(frame, 0.1) for frame in arms.poses(held.q).unbind(1)], 1)
    found = HeldTools.at(held, HeldTools.points_of(points))
    assert_close(found.constants.view(3, 4), X[:3], rtol=0, atol=1e-3)
    assert float(found.errors(held, HeldTools.points_of(points)).abs().max()) < 1e-3


def test_it_makes_the_model_better_and_goes_through_verbs(made: Any, tmp_path: Path) -> None:
    robot, arms, X, tracked, held, kept = made
    scales = usual_scales(robot)
    rows: Any = dc.Observations.joined([tracked, held])
    alone = dc.calibrate(robot, tracked, hyperparameters=scales).model
    found = dc.calibrate(robot, rows, hyperparameters=scales)
    better, before = (relative_errors(model, arms, kept) for model in (found.model, alone))
    assert better < 0.5 * before
    assert_close(found.readings[0].devices.constants.view(3, 4)[:, 3], X[:3, 3], rtol=0, atol=2e-3)
    dc.save(found.model, tmp_path / "m.safetensors")
    model: Any = dc.load(tmp_path / "m.safetensors")
    new: Any = dc.Readings.of(
        "held tool", kept, torch.zeros(len(kept), 6), None, robot.joint_names, numbers=6, doubt=False
    )
    assert dc.evaluate(model, new).rms < 1e-3  # pyright: ignore
    assert model.predict(kept[:3])[0].shape == (3, 6, 3)


def test_both_hands_must_be_measured(made: Any) -> None:
    robot, arms, _, tracked, held, _ = made
    single = dc.Measurements.from_poses(tracked.q, arms.poses(tracked.q)[:, 0], robot.joint_names, on=["left"])
    with pytest.raises(MeasurementError, match=r"held tools: expected poses of 2 frames beside them, got 1"):
        dc.calibrate(robot, dc.Observations.joined([single, held]))  # pyright: ignore
