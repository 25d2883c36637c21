"""Thousands of targets at once, a redundant arm, and a bound of work."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from product_bank import Case, with_usual_scales
from robots_bank import tool_frame
from test_compensate import BOUND, commands, inside, intended, misses, near_wrist_singularity

import diffeo_calib as dc
from diffeo_calib.robots.geometry import Geometry

pytestmark = pytest.mark.slow


def test_thousands_of_targets(arm: Case) -> None:
    """Random ones, through singularities, and out of reach: every row ends in the right status."""
    q = torch.cat([commands(arm, 2000), near_wrist_singularity(arm, 400), commands(arm, 200, seed=1)])
    targets = intended(arm, q)
    targets[2400:, :3, 3] *= 2.5 / targets[2400:, :3, 3].norm(dim=1, keepdim=True)
    found = dc.compensate(arm.model, targets, q, tool=tool_frame())
    assert inside(arm, found)
    distance, angle = misses(arm, found.q, targets)
    assert float(torch.maximum(distance, angle)[found.reached].max()) <= 1e-9
    assert float(torch.maximum(distance, angle)[~found.reached].min()) > 1e-10
    assert set(found.status[2400:]) == {"unreachable"}
    assert set(found.status[2000:2400]) <= {"reached", "singular", "limit"}
    assert int(found.reached[:2000].sum()) > 1500
    again = dc.compensate(arm.model, targets, q, tool=tool_frame(), limits=[[-20.0, 20.0]] * 6)
    for row, status in enumerate(found.status):
        if status == "limit":
            assert again.status[row] == "reached"
    J = arm.model.tool_jacobian(q, tool_frame())
    J[:, 3:] *= 0.3  # m per rad
    s = torch.linalg.svdvals(J)
    weak = s[:, -1] / s[:, 0]
    singular = torch.tensor([status == "singular" for status in found.status])
    assert float(weak[singular].median()) < 0.2 * float(weak[found.reached].median())
    assert float(weak[singular].max()) < 0.1


@pytest.fixture(scope="module")
def seven_joints() -> tuple[dc.Chain, dc.CalibratedKinematics]:
    """An arm with an elbow that can swing, with geometric errors, calibrated with 60 positions of one marker."""
    quarter = math.pi / 2
    turns = (-quarter, quarter, quarter, -quarter, -quarter, quarter, 0.0)
    lengths = (0.36, 0.0, 0.42, 0.0, 0.4, 0.0, 0.126)
    robot = dc.from_dh([(0.0, turn, length) for turn, length in zip(turns, lengths, strict=True)], name="seven")
    truth = replace(Geometry.nominal(robot), tool=torch.tensor([[0.05, 0.02, 0.1]], dtype=torch.float64))
    theta = torch.from_numpy(5e-4 * np.random.default_rng(7).standard_normal(truth.size))
    q = torch.from_numpy(np.random.default_rng(1).uniform(-1.5, 1.5, (60, 7)))
    points = truth.absorb(theta).points(q + 3e-4 * torch.sin(q + 1))
    noise = 1e-5 * torch.from_numpy(np.random.default_rng(2).standard_normal(tuple(points.shape)))
    return robot, with_usual_scales(robot, dc.Measurements(q, points + noise)).model


def test_a_redundant_arm_stays_near_its_start(seven_joints: tuple[dc.Chain, dc.CalibratedKinematics]) -> None:
    """The smallest weighted motion: weights times correction has no part along the self-motion."""
    robot, model = seven_joints
    q = torch.from_numpy(np.random.default_rng(3).uniform(0.3, 1.4, (200, 7)))
    targets = robot(q) @ tool_frame()
    for weights in (torch.ones(7), torch.tensor([1.0, 10.0, 1.0, 0.1, 1.0, 5.0, 1.0])):
        found = dc.compensate(model, targets, q, tool=tool_frame(), weights=weights)
        free = found.reached & (found.correction.abs() < BOUND - 1e-9).all(1)
        assert int(free.sum()) > 150
        J = model.tool_jacobian(found.q, tool_frame())[free]
        selfmotion = torch.linalg.svd(J, full_matrices=True).Vh[:, -1]
        cost = weights.double() * found.correction[free]
        share = (selfmotion * cost).sum(1).abs() / cost.norm(dim=1)
        assert float(share.quantile(0.95)) < 0.02


def test_a_redundant_arm_goes_round_a_limit(seven_joints: tuple[dc.Chain, dc.CalibratedKinematics]) -> None:
    """One joint that must not move forwards: the others reach the targets without it."""
    robot, model = seven_joints
    q = torch.from_numpy(np.random.default_rng(3).uniform(0.3, 1.4, (100, 7)))
    targets = robot(q) @ tool_frame()
    free = dc.compensate(model, targets, q, tool=tool_frame())
    rows = (free.reached & (free.correction[:, 1] > 1e-5)).nonzero().flatten()
    limits = torch.tensor([[-3.0, 3.0]] * 7)
    held = []
    for row in rows[:20].tolist():
        limits[1, 1] = q[row, 1]
        found = dc.compensate(model, targets[row : row + 1], q[row : row + 1], tool=tool_frame(), limits=limits)
        assert float(found.q[0, 1]) <= float(limits[1, 1])
        held.append(bool(found.reached))
    assert sum(held) > 0.7 * len(held)
