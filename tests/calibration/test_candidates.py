"""Random configurations respect everything that is asked, and what refuses them all is named."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numbers_bank import tensor
from product_bank import sliding_robot
from robots_bank import limited
from table_bank import refused

import diffeo_calib as dc
from diffeo_calib.calibration.planning.candidates import collision_free
from diffeo_calib.robots import Chain, SimulatedArm


@pytest.fixture(scope="module")
def robot() -> Chain:
    return SimulatedArm(seed=1).nominal


def test_joints_stay_within_their_limits_and_one_turn() -> None:
    inf, pi = math.inf, math.pi
    limits = [(-1.0, 2.0), (-6.5, 6.5), (-inf, inf), (1.0, 9.0), (-9.0, -1.0), (0.1, 0.4)]
    kinds = ["revolute", "revolute", "continuous", "revolute", "revolute", "prismatic"]
    robot = limited(*((kind, *ends) for kind, ends in zip(kinds, limits, strict=True)))
    q = dc.candidates(robot, 4000)
    ends = [(-1.0, 2.0), (-pi, pi), (-pi, pi), (1.0, 1.0 + 2 * pi), (-1.0 - 2 * pi, -1.0), (0.1, 0.4)]
    lower, upper = tensor(ends).unbind(1)
    assert q.shape == (4000, 6)
    assert bool(((q >= lower) & (q <= upper)).all())
    near = 0.01 * (upper - lower)  # uniform: 4000 draws come near both ends
    assert bool(((q.amin(0) < lower + near) & (q.amax(0) > upper - near)).all())
    narrow = dc.candidates(robot, 100, ranges={"j1": (-6.0, -5.0), "j5": (0.2, 0.2)})
    assert bool(((narrow[:, 1] >= -6) & (narrow[:, 1] <= -5) & (narrow[:, 5] == 0.2)).all())


def test_the_device_sees_the_marker(robot: Chain) -> None:
    position, marker, direction = np.array([2.0, 1.0, 0.5]), np.array([0.05, 0.0, 0.1]), np.array([0.0, 3.0, 4.0])
    tracker = dc.Tracker(position.tolist(), marker.tolist(), direction.tolist(), half_angle=math.radians(30))
    tips = robot(dc.candidates(robot, 300, tracker=tracker)).numpy()
    lines, looks = position - (tips @ [*marker, 1.0])[:, :3], tips[:, :3, :3] @ direction
    angles = np.arccos((lines * looks).sum(1) / np.linalg.norm(lines, axis=1) / np.linalg.norm(looks, axis=1))
    assert 29 < np.degrees(angles).max() <= 30


def test_links_and_tool_stay_above_the_floor_and_outside_the_column(robot: Chain) -> None:
    tool, tracker = tensor([0.0, 0.0, 0.2, 1.0]), dc.Tracker((9.0, 0.0, 0.0), (0, 0, 0.2))
    q = dc.candidates(robot, 300, tracker=tracker, floor=0.1, column=(0.4, 0.0, 0.15))
    frames, tip = robot.joint_frames(q), robot(q)
    ends = torch.cat([frames[:, 1:, :3, 3], tip[:, None, :3, 3], (tip @ tool)[:, None, :3]], 1)
    assert float(ends[..., 2].min()) >= 0.1
    for share in torch.linspace(0, 1, 9, dtype=torch.float64):
        away = ends[:, :-1] + share * (ends[:, 1:] - ends[:, :-1]) - tensor([0.4, 0.0, 0.0])
        assert float(away[..., :2].norm(dim=2).min()) >= 0.15 - 1e-12
    below = dc.candidates(robot, 300, column=(0.4, 0.0, 0.15, 0.3))
    inside = ((robot(below)[:, :2, 3] - torch.tensor([0.4, 0.0])).norm(dim=1) < 0.15).nonzero()[:, 0]
    assert len(inside)  # above its top
    assert float(robot(below)[inside, 2, 3].min()) >= 0.3


def test_draws_follow_the_seed_and_the_user_s_own_check(robot: Chain) -> None:
    first = dc.candidates(robot, 10)
    assert torch.equal(first, dc.candidates(robot, 10, seed=0))
    assert torch.equal(first, dc.candidates(robot, 5000)[:10])
    assert not torch.equal(first, dc.candidates(robot, 10, seed=1))
    kept = dc.candidates(robot, 100, keep=lambda q: (q[:, 0] > 0.5).numpy())
    assert kept.shape == (100, 6)
    assert float(kept[:, 0].min()) > 0.5


def test_what_refuses_everything_is_named(robot: Chain, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("diffeo_calib.calibration.planning.candidates.FIRST_DRAWS", 10_000)
    tracker, narrow = (dc.Tracker((3.0, 0.0, 0.5), half_angle=angle) for angle in (math.radians(30), 0.01))
    refused(
        (
            r"^`floor` refuses nearly everything: 0 of .* random.*`tracker` refuses 9",
            lambda: dc.candidates(robot, 5, tracker=tracker, floor=5.0),
        ),
        ("^`keep` refuses", lambda: dc.candidates(robot, 5, keep=lambda q: q[:, 0] > 100.0, tracker=tracker)),
        (r"^`tracker` refuses .*: \d+ of", lambda: dc.candidates(robot, 500, tracker=narrow, floor=0.0)),
    )


def test_mistakes_are_one_sentence(robot: Chain) -> None:
    def drawn(count: int = 3, **options: Any) -> Callable[[], object]:
        return lambda: dc.candidates(robot, count, **options)

    refused(
        ("`count`", drawn(0)),
        (r"`ranges` names \['elbow'\]: expected joints of the robot", drawn(ranges={"elbow": (0, 1)})),
        ("lower <= upper", drawn(ranges={"waist_joint": (1.0, 0.0)})),
        ("joint_1", drawn(ranges={"joint_1": 1.0})),
        ("dc.Tracker, got tuple", drawn(tracker=(1.0, 0.0, 0.0))),
        (r"a function \(N, n\) -> \(N,\)", drawn(keep=True)),
        ("booleans, one per row", drawn(keep=lambda q: True)),
        ("booleans, one per row", drawn(keep=lambda q: q[:, 0])),
        ("`column`", drawn(column=(1.0, 2.0))),
        ("radius of `column`", drawn(column=(1.0, 2.0, -0.1))),
        ("`floor`", drawn(floor="low")),
        ("`seed`", drawn(seed=-1)),
        ("`direction` of the tracker", lambda: dc.Tracker((1, 0, 0), direction=(0, 0, 0))),
        ("`half_angle` of the tracker", lambda: dc.Tracker((1, 0, 0), half_angle=4.0)),
        ("joint 'slide' has no limits", lambda: dc.candidates(sliding_robot(), 3)),
        (r"a dc\.Tree", lambda: dc.candidates("robot", 3)),  # pyright: ignore[reportArgumentType]
    )


BAR = """<link name="{child}"><collision><origin xyz="0.2 0 0" rpy="0 1.5707963 0"/>
<geometry><cylinder radius="0.03" length="0.3"/></geometry></collision></link>
<joint name="j{child}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{x} 0 0"/>
<axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>"""


def test_bodies_of_the_urdf_collide(robot: Chain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of three bars of 0.4 m in a plane; the second joint turns without end."""
    pytest.importorskip("pinocchio")
    bars = (("base", "one", "revolute", 0), ("one", "two", "continuous", 0.4), ("two", "three", "revolute", 0.4))
    text = "".join(BAR.format(parent=parent, child=child, kind=kind, x=x) for parent, child, kind, x in bars)
    (tmp_path / "folding.urdf").write_text(f'<robot name="folding"><link name="base"/>{text}</robot>')
    folding = dc.load_urdf(tmp_path / "folding.urdf", "base", "three")
    keep = collision_free(folding)
    q = tensor([[0.3, 0.0, 0.0], [0.0, 2.1, 2.1], [1.0, -2.1, -2.1], [0.0, 2.1, -2.1]])
    assert keep(q).tolist() == [True, False, False, True]  # a triangle closes, a zigzag does not
    found = dc.candidates(folding, 200, keep=keep)
    assert bool(keep(found).all())
    refused(
        ("has no collision geometry", lambda: collision_free(robot)),
        ("was not read from a URDF", lambda: collision_free(sliding_robot())),
    )
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    refused((r"not installed; pip install .diffeo_calib\[collisions\]", lambda: collision_free(folding)))
