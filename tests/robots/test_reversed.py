"""Robots seen from one of their tips: inverse poses, the same gravity, and what a URDF read from hand to hand gives."""

from __future__ import annotations

import json
from dataclasses import replace
from math import pi
from pathlib import Path

import pytest
import torch
from robots_bank import CHAINS, draw, every_chain
from simulated_body import HANDS, URDF_FILE
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import RobotError
from diffeo_calib.measurements.poses import LEVER, mark_points, poses_from_marks
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.dh import DHRow, from_dh
from diffeo_calib.robots.gravity import GravitySag
from diffeo_calib.robots.tree import Chain, Ends, Tree, robot_from_config


def two_arms() -> Tree:
    """A turning column with two arms of three joints, one with a slide."""
    arm = [(0.3, 0.4, 0.1), (0.25, -pi / 2, 0.05), (0.2, 0.3, 0.0)]
    left = [DHRow(*row, parent=parent) for row, parent in zip(arm, (0, 1, 2), strict=True)]
    right = [DHRow(*row[:3], theta=0.5, parent=parent) for row, parent in zip(arm, (0, 4, 5), strict=True)]
    right[1] = DHRow(0.1, pi / 3, 0.2, 0.1, "prismatic", parent=4)
    return from_dh([DHRow(0.1, pi / 2, 0.6), *left, *right], tips={"left": 3, "right": 6})


def reordered(q: Tensor, robot: Tree, other: Tree) -> Tensor:
    """Configurations of one robot in the order of the joints of another."""
    return q[:, [robot.joint_names.index(name) for name in other.joint_names]]


def own_features(robot: Tree, q: Tensor) -> dict[str, Tensor]:
    """Gravity features of every joint about its own axis, by its name."""
    sag = GravitySag(robot)
    parts = sag.features(q).split([compliance.size for compliance in sag.compliances], 1)
    return {robot.moving_names[c.joint]: part for c, part in zip(sag.compliances, parts, strict=True) if c.own}


@every_chain
def test_a_reversed_chain_has_inverse_poses(chain: Chain) -> None:
    back, q = chain.reversed(), draw(5, chain.n, size=0.5)
    own = reordered(q, chain, back)
    assert (back.base, back.tips) == (chain.tip, (chain.base,))
    assert_close(back(own), torch.linalg.inv(chain(q)), rtol=0, atol=1e-13)
    again = back.reversed()
    assert again.serial
    assert again.tips == chain.tips
    assert_close(again(reordered(q, chain, again)), chain(q), rtol=0, atol=1e-13)


def test_hand_to_hand_of_a_table_is_that_of_both_arms() -> None:
    robot = two_arms()
    held, q = robot.reversed("left"), draw(6, robot.n)
    both = robot.tip_poses(q)
    assert_close(held(reordered(q, robot, held)), torch.linalg.inv(both[:, 0]) @ both[:, 1], rtol=0, atol=1e-14)
    assert held.joint_names[-4:] == ("joint_1", "joint_5", "joint_6", "joint_7")
    copy = robot_from_config(json.loads(json.dumps(held.to_config())))
    assert_close(copy.places(q), held.places(q), rtol=0, atol=0)


def contained(here: dict[str, Tensor], there: dict[str, Tensor]) -> float:
    """Largest part of one robot's features that no combination of the same joint's features of the other gives."""
    left = [
        float((there[name] @ torch.linalg.lstsq(there[name], one, driver="gelsd").solution - one).abs().max())
        for name, one in here.items()
        if name in there
    ]
    assert left
    return max(left)


@pytest.mark.parametrize("robot", [CHAINS["serial"], CHAINS["arm"], two_arms()], ids=["serial", "arm", "two arms"])
def test_gravity_is_that_of_the_ground(robot: Tree) -> None:
    """What a joint's sag can be does not depend on the link from which one looks, unless the ground is forgotten."""
    back, q = robot.reversed(robot.tips[0]), draw(80, robot.n)
    own = reordered(q, robot, back)
    here = own_features(robot, q)
    assert contained(here, own_features(back, own)) < 1e-10
    loads = {load: back.ends[load] for load in back.loads}
    hanging = Tree("x", back.base, back.joints, back.parents, Ends({tip: back.ends[tip] for tip in back.tips}, loads))
    assert contained(here, own_features(hanging, own)) > 1e-2


def test_a_urdf_read_from_hand_to_hand_is_its_reversed_tree() -> None:
    """Poses there agree with pinocchio's; frames and gravity features are the same here."""
    both = dc.load_urdf(URDF_FILE, "pelvis", list(HANDS))
    held, read = both.reversed("left_hand"), dc.load_urdf(URDF_FILE, "left_hand", ["right_hand"], ["pelvis"])
    q = draw(80, both.n, size=0.5)
    assert_close(held(reordered(q, both, held)), read(reordered(q, both, read)), rtol=0, atol=1e-14)
    here, there = own_features(held, reordered(q, both, held)), own_features(read, reordered(q, both, read))
    assert set(here) == set(there)
    assert contained(here, there) < 1e-10


def test_a_tip_must_be_named_where_there_are_several() -> None:
    for tip in (None, "middle"):
        with pytest.raises(RobotError, match=r"`tip`: expected one of left, right"):
            two_arms().reversed(tip)


@pytest.mark.slow
def test_a_chain_seen_from_its_tool_is_calibrated(tmp_path: Path) -> None:
    """A tracker on the flange of the simulated arm sees a marker on the floor."""
    arm, q = SimulatedArm(seed=1, markers=3), SimulatedArm().sample(120, seed=1)
    frame = torch.eye(4, dtype=torch.float64)
    arm.truth = replace(arm.truth, tool=mark_points(frame[None], LEVER)[0])
    marker = torch.tensor([0.3, 0.2, 0.1, 1.0], dtype=torch.float64)
    seen = (torch.linalg.inv(poses_from_marks(arm.true_points(q), LEVER)) @ marker)[:, :3]
    robot = arm.nominal.reversed()
    data = dc.Measurements(reordered(q, arm.nominal, robot), seen + draw(120, 3, size=2e-5), robot.joint_names)
    result, test = dc.calibrate(robot, data[:80]), data[80:]
    assert dc.evaluate(result.model, test).rms < 0.3 * dc.evaluate(result.identification.geometry.points, test).rms
    dc.save(result.model, tmp_path / "a.safetensors")
    loaded = dc.load(tmp_path / "a.safetensors")
    assert isinstance(loaded, dc.CalibratedKinematics)
    assert_close(loaded(test.q), result.model(test.q), rtol=0, atol=0)
