"""The parts of the search against second implementations: quadratic programs, derivatives, chains, limits."""

from __future__ import annotations

import gc
import weakref
from itertools import product

import numpy as np
import pytest
import torch
from product_bank import Case
from robots_bank import CHAINS, parallelogram

import diffeo_calib as dc
from diffeo_calib.kinematics.compensation.box_search import box_minimum, joint_limits
from diffeo_calib.kinematics.compensation.targets import Targets
from diffeo_calib.robots.joint import Joint
from diffeo_calib.robots.se3 import twist_transform
from diffeo_calib.runtime.build import calibrated_chain, nominal_chain
from diffeo_calib.runtime.chain import CalibratedChain

Array = np.ndarray


def rigid(chain: dc.Chain) -> CalibratedChain:
    L = chain.moving
    return calibrated_chain(
        nominal_chain(chain.to_config()), np.eye(4), np.tile(np.eye(4), (L, 1, 1)), np.zeros(6 + 6 * L), None
    )


# --- quadratic functions in boxes ---------------------------------------------------------------------------------


def smallest(H: Array, g: Array, low: Array, high: Array) -> Array:
    """By trying every face of the box."""
    best, value = np.zeros_like(g), np.inf
    for face in product((0, 1, 2), repeat=len(g)):
        kind = np.array(face)
        s = np.where(kind == 0, 0.0, np.where(kind == 1, low, high))
        free = kind == 0
        s[free] = np.linalg.solve(H[np.ix_(free, free)], -(g + H @ s)[free])
        if (s >= low - 1e-12).all() and (s <= high + 1e-12).all() and 0.5 * s @ H @ s + g @ s < value:
            best, value = s, 0.5 * s @ H @ s + g @ s
    return best


def test_the_minimum_in_a_box() -> None:
    """Well and badly conditioned, on faces of every dimension, with joints that cannot move."""
    rng = np.random.default_rng(0)
    root = rng.standard_normal((200, 4, 4)) * 10.0 ** rng.uniform(-3, 0, (200, 1, 4))
    H = root @ root.swapaxes(1, 2) + 1e-8 * np.eye(4)
    g, low, high = rng.standard_normal((200, 4)), -rng.random((200, 4)), rng.random((200, 4))
    low[::3, 1], high[::5, 2] = 0.0, 0.0
    low[::7, 3] = high[::7, 3] = 0.0
    found = box_minimum(H, g, low, high)
    for row in range(200):
        expected = smallest(H[row], g[row], low[row], high[row])
        values = [0.5 * s @ H[row] @ s + g[row] @ s for s in (found[row], expected)]
        assert values[0] == pytest.approx(values[1], rel=1e-9, abs=1e-12)
        assert bool(((found[row] >= low[row]) & (found[row] <= high[row])).all())


# --- what the tool shall reach ------------------------------------------------------------------------------------


def random_poses(rows: int, seed: int) -> Array:
    twists = 1.5 * np.random.default_rng(seed).standard_normal((rows, 6))
    return twist_transform(torch.from_numpy(twists)).numpy()


def targets(kind: str, rows: int) -> Targets:
    poses = random_poses(rows, 3)[:, None]
    count = {"poses": 3, "axis": 1, "positions": 0}[kind]
    tool_axes = np.eye(3)[:, -count:] if count else np.zeros((3, 0))
    return Targets(poses[..., :3, 3], poses[..., :3, :count], tool_axes, lever=0.3)


@pytest.mark.parametrize(("kind", "name"), [("poses", "arm"), ("axis", "slides"), ("positions", "slides")])
def test_gradient_and_hessian_of_the_cost(kind: str, name: str) -> None:
    """By central differences, far from the targets."""
    chain = rigid(CHAINS[name])
    n, rows, h = CHAINS[name].n, 6, 1e-5
    q = np.random.default_rng(1).uniform(-2, 2, (rows, n))
    goal = targets(kind, rows)

    def cost(at: Array) -> Array:
        return goal.cost(chain.poses(at))

    def slope(at: Array) -> Array:
        poses, J = chain.poses_and_jacobian(at)
        return -np.einsum("nkj,nk->nj", goal.slopes(J), goal.errors(poses))

    poses, J = chain.poses_and_jacobian(q)
    S = goal.slopes(J)
    hessian = S.swapaxes(1, 2) @ S + goal.curvature(J, poses)
    for joint in range(n):
        step = np.zeros(n)
        step[joint] = h
        np.testing.assert_allclose(slope(q)[:, joint], (cost(q + step) - cost(q - step)) / (2 * h), rtol=0, atol=1e-8)
        change = (slope(q + step) - slope(q - step)) / (2 * h)
        np.testing.assert_allclose(hessian[:, :, joint], change, rtol=0, atol=1e-8)


# --- limits -------------------------------------------------------------------------------------------------------


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
    np.testing.assert_allclose(kept[0], [0.55, 0.45])
    np.testing.assert_allclose(kept[[1, 3]], q[[1, 3]])
    assert np.isnan(kept[2]).all()


# --- models -------------------------------------------------------------------------------------------------------


def test_a_model_is_forgotten_with_its_last_use(arm: Case) -> None:
    model = arm.model.with_tool([0.0, 0.0, 0.1])
    dc.compensate(model, torch.zeros(1, 3), torch.zeros(1, 6))
    seen = weakref.ref(model)
    del model
    gc.collect()
    assert seen() is None


def test_torch_and_numpy_find_the_same_commands(arm: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    """Models without constants for NumPy are evaluated by torch."""
    q = arm.test.q[:10]
    targets = arm.robot(q)
    found = dc.compensate(arm.model.with_tool(None), targets, q)
    monkeypatch.setattr("diffeo_calib.kinematics.tool.program_of", lambda _: None)
    again = dc.compensate(arm.model.with_tool(None), targets, q)
    assert found.status == again.status
    torch.testing.assert_close(again.q[found.reached], found.q[found.reached], rtol=0, atol=1e-7)
