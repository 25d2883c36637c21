"""Commands for both hands of a small robot: against the model itself and one hand at a time; mimic joints."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from deformation_bank import model_of
from robots_bank import parallelogram
from table_bank import held, refused
from torch import Tensor
from torch.testing import assert_close
from two_arms_bank import HANDS, robot

import diffeo_calib as dc
from diffeo_calib.kinematics.compensation.problem import joint_limits
from diffeo_calib.kinematics.compensation.targets import Targets
from diffeo_calib.measurements.poses import angle_between
from diffeo_calib.robots.joint import Joint
from diffeo_calib.robots.se3 import twist_transform
from diffeo_calib.runtime.build import calibrated_chain

ROWS = 12
TOOLS = torch.tensor([[0.0, 0.0, 0.1], [0.02, 0.05, 0.0]], dtype=torch.float64)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> dc.CalibratedKinematics:
    made = model_of(robot(tmp_path_factory.mktemp("two_arms")), dc.RK4(1), 1, elastic=False)
    return made.with_tool(None, HANDS[0])


@pytest.fixture(scope="module")
def q() -> Tensor:
    return torch.from_numpy(np.random.default_rng(0).uniform(-1.2, 1.2, (ROWS, 5)))


@pytest.fixture(scope="module")
def start(q: Tensor) -> Tensor:
    return q + torch.from_numpy(np.random.default_rng(1).uniform(-0.01, 0.01, q.shape))


def of_both(model: dc.CalibratedKinematics, q: Tensor, frame: str = "base") -> Tensor:
    """(N, 2, 4, 4) where the model has the tools."""
    return torch.stack([model.tool_poses(q, TOOLS[k], frame, hand) for k, hand in enumerate(HANDS)], dim=1)


@pytest.mark.parametrize("frame", ["base", "measuring"])
def test_both_hands_reach_their_poses(model: dc.CalibratedKinematics, q: Tensor, start: Tensor, frame: str) -> None:
    wanted = of_both(model, q, frame)
    found = dc.compensate(model, wanted, start, tool=TOOLS, frame=frame)
    assert found.counts == {"reached": ROWS}
    seen = of_both(model, found.q, frame)
    assert_close(seen, wanted, rtol=0, atol=2e-9)
    assert_close(found.poses, seen, rtol=0, atol=1e-12)
    assert found.miss.shape == held(found.angle_miss).shape == (ROWS, 2)
    assert float((of_both(model, start, frame) - wanted)[..., :3, 3].norm(dim=-1).min()) > 1e-4


def test_a_free_hand_stays(model: dc.CalibratedKinematics, q: Tensor, start: Tensor) -> None:
    """Rows with one target get the command of that hand alone; the waist moves both."""
    wanted = of_both(model, q)[..., :3, 3]
    wanted[::2, 1] = torch.nan
    found = dc.compensate(model, wanted, start, tool=TOOLS)
    alone = dc.compensate(model.with_tool(TOOLS[0], HANDS[0]), wanted[::2, 0], start[::2])
    assert_close(found.q[::2], alone.q, rtol=0, atol=1e-9)
    assert torch.equal(found.correction[::2, 3:], torch.zeros(ROWS // 2, 2, dtype=torch.float64))
    assert bool(found.miss[::2, 1].isnan().all())
    assert not bool(found.miss[:, 0].isnan().any())
    assert found.angle_miss is None
    assert bool(found.reached.all())
    assert_close(of_both(model, found.q)[1::2, :, :3, 3], wanted[1::2], rtol=0, atol=2e-9)


def test_directions_of_both_hands(model: dc.CalibratedKinematics, q: Tensor, start: Tensor) -> None:
    wanted = of_both(model, q)
    axes = 5.0 * wanted[..., :3, 0]
    wanted[0, 1], axes[0, 1] = torch.nan, torch.nan
    found = dc.compensate(model, wanted[..., :3, 3], start, axis=axes, tool_axis="x", tool=TOOLS)
    assert bool(found.reached.all())
    seen = of_both(model, found.q)
    assert_close(seen[1:, :, :3, 0], wanted[1:, :, :3, 0], rtol=0, atol=2e-9)
    assert_close(seen[0, 0, :3, 0], wanted[0, 0, :3, 0], rtol=0, atol=2e-9)


def test_the_nearest_command_weighs_both_hands(model: dc.CalibratedKinematics, q: Tensor) -> None:
    """Five joints cannot hold two poses: no direction of the free joints makes the sum of both costs smaller."""
    wanted = of_both(model, q)
    wanted[:, 0, :3, 3] += torch.tensor([1e-3, -2e-3, 1e-3], dtype=torch.float64)
    found = dc.compensate(model, wanted, q, tool=TOOLS)
    assert "reached" not in found.counts

    def cost(at: Tensor) -> Tensor:
        seen = of_both(model, at)
        shift = 0.5 * (seen - wanted)[..., :3, 3].square().sum(-1)
        turn = 1 - angle_between(wanted[..., :3, :3].flatten(0, 1), seen[..., :3, :3].flatten(0, 1)).cos()
        return (shift + 0.1**2 * turn.unflatten(0, (-1, 2))).sum(1)

    step = 1e-5 * torch.eye(5, dtype=torch.float64)
    slope = torch.stack([(cost(found.q + h) - cost(found.q - h)) / 2e-5 for h in step], dim=1)
    before = torch.stack([(cost(q + h) - cost(q - h)) / 2e-5 for h in step], dim=1)
    inside = (found.correction.abs() < np.radians(1.0) - 1e-9).to(torch.float64)
    assert float((slope * inside).norm(dim=1).max()) < 1e-4 * float(before.norm(dim=1).max())


def test_wrong_targets_of_both_hands(model: dc.CalibratedKinematics) -> None:
    targets, start = torch.zeros(2, 2, 3, dtype=torch.float64), torch.zeros(2, 5)
    missing = targets.clone()
    missing[1, 0, 2] = torch.nan

    def wrong(targets: Tensor = targets, **more: Any) -> Callable[[], object]:
        return lambda: dc.compensate(model, targets, start, **more)

    refused(
        ("`targets` of robot 'two_arms': expected 2 tips", wrong(targets[:, :1])),
        (r"`tool` has the wrong shape: expected \(2, 4, 4\)", wrong(tool=[0.0, 0.0, 0.1])),
        ("row 0: no tip has a target", wrong(torch.full((2, 2, 3), torch.nan))),
        ("not finite", wrong(missing)),
        ("`targets`, row 0, tip 0: the last row", wrong(torch.ones(2, 2, 4, 4))),
        (r"`axis` has the wrong shape: expected \(2, 2, 3\)", wrong(axis=torch.ones(2, 3))),
    )


@pytest.mark.parametrize("axes", [3, 1, 0])
def test_gradient_and_hessian_of_the_cost(model: dc.CalibratedKinematics, axes: int) -> None:
    """By central differences, of rigid kinematics far from the targets, a free hand in two rows."""
    rng, h, free = np.random.default_rng(1), 1e-5, np.zeros((6, 2), dtype=bool)
    free[1, 0] = free[4, 1] = True
    poses = twist_transform(torch.from_numpy(rng.standard_normal((6, 2, 6)))).numpy()
    q = rng.uniform(-2, 2, (6, model.robot.n))
    goal = Targets(poses[..., :3, 3], poses[..., :3, :axes], np.eye(3)[:, 3 - axes :], 0.3, free)
    errors = model.geometry.joint_errors.numpy()
    chain = calibrated_chain(model.robot.arrays, np.eye(4), errors, np.zeros(6 + 6 * model.robot.moving))

    def slope(at: np.ndarray) -> np.ndarray:
        there, jacobian = chain.poses_and_jacobian(at)
        return -np.einsum("nkj,nk->nj", goal.slopes(jacobian), goal.errors(there))

    here, jacobian = chain.poses_and_jacobian(q)
    S = goal.slopes(jacobian)
    hessian = S.swapaxes(1, 2) @ S + goal.curvature(jacobian, here)
    for joint, step in enumerate(h * np.eye(q.shape[1])):
        rise = goal.cost(chain.poses_and_jacobian(q + step)[0]) - goal.cost(chain.poses_and_jacobian(q - step)[0])
        np.testing.assert_allclose(slope(q)[:, joint], rise / (2 * h), rtol=0, atol=1e-8)
        change = (slope(q + step) - slope(q - step)) / (2 * h)
        np.testing.assert_allclose(hessian[:, :, joint], change, rtol=0, atol=1e-8)


def limited(mimic: dict[str, float], offset: float, low: float, high: float) -> dc.Chain:
    """Three joints, the last of which follows others within its own limits."""
    frame = torch.eye(4, dtype=torch.float64)
    frame[0, 3] = 0.3
    joints = [Joint(f"j{k}", "revolute", frame, lower=-2.0, upper=2.0) for k in range(2)]
    joints.append(Joint("j2", "revolute", frame, lower=low, upper=high, mimic=mimic, mimic_offset=offset))
    return dc.Chain("limited", "floor", "hand", joints)


def test_limits_of_a_mimic_joint_bind_its_driver() -> None:
    found = joint_limits(limited({"j1": -2.0}, 0.5, -1.5, 1.0), None)
    np.testing.assert_allclose(found.low, [-2.0, -0.25])
    np.testing.assert_allclose(found.high, [2.0, 1.0])
    assert not len(found.matrix)
    assert np.isinf(joint_limits(parallelogram(), None).high).all()


def test_corrections_stop_at_the_limits_of_joints_that_follow_several() -> None:
    found = joint_limits(limited({"j0": 1.0, "j1": 1.0}, 0.0, -1.0, 1.0), None)
    start = np.array([[0.5, 0.4], [0.1, 0.1], [0.8, 0.8], [0.5, 0.5]])
    q = start + np.array([[0.1, 0.1], [0.1, 0.1], [0.0, 0.0], [-0.1, 0.0]])
    kept = found.within(start, q)
    np.testing.assert_allclose(kept[[0, 1, 3]], [start[0], q[1], q[3]])
    assert np.isnan(kept[2]).all()
