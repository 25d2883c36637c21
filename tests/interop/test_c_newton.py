"""The Newton step in C: quadratic convergence, Newton's formula, trust region, joint limits, singularities."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from c_bank import CModel, c_model, needs_compiler
from deformation_bank import deformation_of
from robots_bank import CHAINS, draw
from scipy.spatial.transform import Rotation

from diffeo_calib.kinematics.program import program_of
from diffeo_calib.robots import Chain
from diffeo_calib.robots.se3 import twist_transform

pytestmark = needs_compiler
TOOL = twist_transform(draw(6, seed=6)).numpy()
HOME = np.array([0.3, -0.8, 1.1, 0.4, 0.9, -0.2])
LIMIT = 1.2


def stepper(chain: Chain, folder: Path, limits: np.ndarray | None = None) -> CModel:
    program = program_of(deformation_of(chain, elastic=False))
    assert program is not None
    return c_model(program, folder, TOOL, limits)


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> CModel:
    return stepper(CHAINS["arm"], tmp_path_factory.mktemp("newton"), np.tile([-LIMIT, LIMIT], (6, 1)))


def pose_at(made: CModel, q: np.ndarray) -> np.ndarray:
    return made.poses(q[None])[0]


def errors_of_steps(made: CModel, q: np.ndarray, target: np.ndarray, steps: int, bound: float = 0.1) -> list[float]:
    errors = []
    for _ in range(steps):
        q, error = made.newton_step(q, target, bound=bound)
        errors.append(error)
    return errors


def pose_error(start: np.ndarray, target: np.ndarray, weight: float) -> np.ndarray:
    turn = Rotation.from_matrix(target[:3, :3] @ start[:3, :3].T).as_rotvec()
    return np.concatenate([target[:3, 3] - start[:3, 3], weight * turn])


def weighted(jacobian: np.ndarray, weight: float) -> np.ndarray:
    return np.diag([1.0, 1.0, 1.0, weight, weight, weight]) @ jacobian


def test_steps_converge_quadratically(arm: CModel) -> None:
    for seed in range(5):
        start = HOME + 0.1 * draw(6, seed=seed).numpy().clip(-1, 1)
        target = pose_at(arm, start + 0.05 * draw(6, seed=10 + seed).numpy().clip(-1, 1))
        errors = errors_of_steps(arm, start, target, 7)
        assert errors[0] > 1e-2
        assert errors[-1] < 1e-14
        ratios = [after / before**2 for before, after in pairwise(errors) if after > 1e-13]
        assert max(ratios) < 100.0


@pytest.mark.parametrize("weight", [0.1, 1.0])
def test_a_free_step_is_newtons(arm: CModel, weight: float) -> None:
    target = pose_at(arm, HOME + 0.02)
    poses, slopes = arm.poses_and_jacobian(HOME[None])
    e = pose_error(poses[0], target, weight)
    after, error = arm.newton_step(HOME, target, weight, bound=1.0)
    np.testing.assert_allclose(error, np.linalg.norm(e), rtol=1e-12)
    np.testing.assert_allclose(after - HOME, np.linalg.solve(weighted(slopes[0], weight), e), rtol=0, atol=1e-6)


@pytest.mark.parametrize("bound", [1e-3, 0.01, 0.03])
@pytest.mark.parametrize("weight", [0.0, 0.1])
def test_a_bounded_step_is_the_best_of_its_length(arm: CModel, weight: float, bound: float) -> None:
    """On the bound the gradient is parallel to the step."""
    poses, slopes = arm.poses_and_jacobian(HOME[None])
    target = pose_at(arm, HOME + 0.1)
    e, J = pose_error(poses[0], target, weight), weighted(slopes[0], weight)
    step = arm.newton_step(HOME, target, weight, bound)[0] - HOME
    np.testing.assert_allclose(np.linalg.norm(step), bound, rtol=1e-3)
    gradient = J.T @ (e - J @ step)
    np.testing.assert_allclose(gradient @ step, np.linalg.norm(gradient) * np.linalg.norm(step), rtol=1e-3)


@pytest.mark.parametrize("angle", [1e-9, 0.3, 1.6, 3.0, np.pi - 1e-7, np.pi])
def test_errors_of_large_rotations(arm: CModel, angle: float) -> None:
    """Up to half a turn, where the rotation vector is hard to read from the matrix."""
    start = pose_at(arm, HOME)
    for axis in [*np.eye(3), *draw(10, 3, seed=2).numpy()]:
        target = start.copy()
        target[:3, :3] = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix() @ start[:3, :3]
        np.testing.assert_allclose(arm.newton_step(HOME, target, weight=2.0)[1], 2.0 * angle, rtol=1e-7, atol=1e-15)


def test_joints_stop_at_their_limits(arm: CModel) -> None:
    """The rest of the joints then does its best: the gradient in these vanishes in the end."""
    wanted = HOME.copy()
    wanted[2] = LIMIT + 0.2
    target, q = pose_at(arm, wanted), HOME
    for _ in range(50):
        q, error = arm.newton_step(q, target)
        assert (np.abs(q) <= LIMIT).all()
    assert q[2] == LIMIT
    assert error > 1e-4
    poses, slopes = arm.poses_and_jacobian(q[None])
    gradient = weighted(slopes[0], 0.1).T @ pose_error(poses[0], target, 0.1)
    assert gradient[2] > 0  # it would go on
    outward = gradient * np.sign(q)
    assert (outward[np.abs(q) == LIMIT] > 0).all()
    assert np.abs(gradient[np.abs(q) < LIMIT]).max() < 1e-9


def test_joints_beyond_their_limits_come_back(arm: CModel) -> None:
    q = HOME.copy()
    q[0], q[4] = LIMIT + 0.3, -LIMIT - 0.05
    target = pose_at(arm, q)
    for _ in range(8):
        before, (q, _) = q, arm.newton_step(q, target)
        assert np.linalg.norm(q - before) <= 0.1 * (1 + 1e-12)
    assert (np.abs(q) <= LIMIT).all()


def test_the_rest_makes_up_for_joints_at_limits(arm: CModel) -> None:
    q = HOME.copy()
    q[0] = LIMIT + 0.01
    target = pose_at(arm, q + 0.001)
    poses, slopes = arm.poses_and_jacobian(q[None])
    e, J = pose_error(poses[0], target, 0.1), weighted(slopes[0], 0.1)
    expected = np.linalg.lstsq(J[:, 1:], e + 0.01 * J[:, 0], rcond=None)[0]
    after, _ = arm.newton_step(q, target, bound=10.0)
    assert after[0] == LIMIT
    np.testing.assert_allclose(after[1:] - q[1:], expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("bound", [1e-4, 0.01, 0.5])
def test_no_step_is_longer_than_the_bound(arm: CModel, bound: float) -> None:
    """Far targets, and targets out of reach."""
    for seed in range(10):
        target = twist_transform(draw(6, seed=seed, size=3.0)).numpy()
        after, error = arm.newton_step(HOME, target, bound=bound)
        assert np.linalg.norm(after - HOME) <= bound * (1 + 1e-12)
        assert error > 0.1


def test_near_singularities_steps_stay_small(arm: CModel) -> None:
    """Wrist axes in one plane: a shift across them asks for infinite joint velocities."""
    q = torch.zeros(1, 6, dtype=torch.float64).numpy()
    direction = np.linalg.svd(arm.poses_and_jacobian(q)[1][0])[0][:, -1]
    target = pose_at(arm, q[0])
    target[:3, 3] += 5e-4 * direction[:3] / np.linalg.norm(direction[:3])
    after, error = arm.newton_step(q[0], target, bound=0.02)
    assert np.linalg.norm(after - q[0]) <= 0.02 * (1 + 1e-12)
    left = pose_error(pose_at(arm, after), target, 0.1)
    assert np.linalg.norm(left) <= error


@pytest.mark.parametrize(
    "name", ["one joint", *(pytest.param(name, marks=pytest.mark.slow) for name in ("gantry", "slides"))]
)
def test_robots_of_fewer_joints(name: str, tmp_path: Path) -> None:
    """They reach the poses that they can reach."""
    chain = CHAINS[name]
    made = stepper(chain, tmp_path)
    q, target = 0.1 * np.ones(chain.n), pose_at(made, 0.2 * np.ones(chain.n))
    assert errors_of_steps(made, q, target, 10)[-1] < 1e-13


@pytest.mark.parametrize("bound", [0.0, -1.0])
def test_no_motion_without_a_bound(arm: CModel, bound: float) -> None:
    np.testing.assert_array_equal(arm.newton_step(HOME, np.eye(4), bound=bound)[0], HOME)
