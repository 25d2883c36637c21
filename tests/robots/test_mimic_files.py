"""Mimic joints in DH tables and URDF files."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from robots_bank import draw

from diffeo_calib.common.errors import RobotError
from diffeo_calib.robots import DHRow, from_dh, load_urdf
from diffeo_calib.robots.se3 import rotation
from diffeo_calib.robots.tree import robot_from_config


@pytest.mark.parametrize("convention", ["standard", "craig"])
def test_rows_of_a_table_with_mimic(convention: str) -> None:
    free = [(0.1, 0.4, 0.3, 0.2), (-0.2, -1.1, 0.5, 0.7, "prismatic"), (0.3, 0.9, -0.1), (0.1, 0.2, 0.4)]
    follow = {"joint_1": -1.0, "joint_4": 0.5}
    expected, q = from_dh(free, convention), draw(5, 2)
    full = torch.stack([q[:, 0], 0.2 + 3 * q[:, 0], 0.1 - q[:, 0] + 0.5 * q[:, 1], q[:, 1]], dim=1)
    rows = [
        free[0],
        DHRow(-0.2, -1.1, 0.5, 0.7, "prismatic", {"joint_1": 3.0}, 0.2),
        (0.3, 0.9, -0.1, 0.0, "revolute", follow, 0.1),
        DHRow(0.1, 0.2, 0.4),
    ]
    chain = from_dh(rows, convention)
    assert chain.joint_names == ("joint_1", "joint_4")
    torch.testing.assert_close(chain(q), expected(full), rtol=0, atol=1e-14)
    without_offset = from_dh([*rows[:2], rows[2][:6], rows[3]], convention)  # pyright: ignore[reportIndexIssue]
    full[:, 2] -= 0.1
    torch.testing.assert_close(without_offset(q), expected(full), rtol=0, atol=1e-14)


URDF = """<robot name="lift">
  <link name="floor"/><link name="a"/><link name="b"/><link name="c"/><link name="d"/><link name="e"/><link name="f"/>
  <link name="hand"/><link name="finger"/>
  <joint name="turn" type="revolute"><parent link="floor"/><child link="a"/><origin xyz="1 0.1 0" rpy="1 2 3"/>
    <axis xyz="0.6 0.8 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
  <joint name="counter" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0 0.2 0.3" rpy="0.4 0 1"/>
    <axis xyz="0 0.6 0.8"/><limit lower="-2" upper="2" effort="1" velocity="1"/>
    <mimic joint="turn" multiplier="-0.5" offset="0.3"/></joint>
  <joint name="rack" type="prismatic"><parent link="b"/><child link="c"/><axis xyz="0.48 0.6 0.64"/>
    <limit lower="-2" upper="2" effort="1" velocity="1"/><mimic joint="turn" multiplier="0.1"/></joint>
  <joint name="mount" type="fixed"><parent link="c"/><child link="d"/><origin xyz="0 0 0.4" rpy="0 1 0"/></joint>
  <joint name="lift" type="prismatic"><parent link="d"/><child link="e"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="twin" type="prismatic"><parent link="e"/><child link="f"/><origin xyz="0.1 0 0" rpy="0.2 0.3 0"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/><mimic joint="lift" offset="-0.1"/></joint>
  <joint name="wrist" type="revolute"><parent link="f"/><child link="hand"/><axis xyz="1 0 0"/>
    <origin xyz="0 0.1 0.1" rpy="0 0.1 0.2"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="grip" type="revolute"><parent link="hand"/><child link="finger"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/><mimic joint="wrist" multiplier="2"/></joint>
</robot>"""


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    (tmp_path / "lift.urdf").write_text(URDF)
    return tmp_path / "lift.urdf"


def test_urdf_files_with_mimic_are_read(urdf: Path) -> None:
    chain = load_urdf(urdf, "floor", "hand")
    assert chain.joint_names == ("turn", "lift", "wrist")
    assert chain.moving_names == ("turn", "counter", "rack", "lift", "twin", "wrist")
    expected = [[1, 0, 0], [-0.5, 0, 0], [0.1, 0, 0], [0, 1, 0], [0, 1, 0], [0, 0, 1]]
    assert chain.coupling.tolist() == expected
    assert chain.coupling_offset.tolist() == [0, 0.3, 0, 0, -0.1, 0]
    assert load_urdf(urdf, "floor", "finger").coupling[-1].tolist() == [0, 0, 2]


def test_poses_and_jacobian_agree_with_pinocchio(urdf: Path) -> None:
    pin = pytest.importorskip("pinocchio")
    chain, model = load_urdf(urdf, "floor", "hand"), pin.buildModelFromUrdf(str(urdf), mimic=True)
    data, hand = model.createData(), model.getFrameId("hand")
    columns = [model.joints[model.getJointId(name)].idx_v for name in chain.joint_names]
    q = draw(20, 3)
    poses, jacobians = chain(q), chain.jacobian(q)
    for row in range(len(q)):
        configuration = np.zeros(model.nq)
        configuration[columns] = q[row].numpy()
        pin.computeJointJacobians(model, data, configuration)
        pin.updateFramePlacements(model, data)
        pose = torch.from_numpy(data.oMf[hand].homogeneous)
        torch.testing.assert_close(poses[row], pose, rtol=0, atol=1e-12)
        world = pin.getFrameJacobian(model, data, hand, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)[:, columns]
        torch.testing.assert_close(jacobians[row], torch.from_numpy(world), rtol=0, atol=1e-12)


def test_a_driver_off_the_path_is_a_column(urdf: Path) -> None:
    whole, upper = load_urdf(urdf, "floor", "hand"), load_urdf(urdf, "a", "hand")
    assert upper.joint_names == ("lift", "wrist", "turn")
    assert upper.moving_names == whole.moving_names[1:]
    q = torch.tensor([[0.3, -0.2, 0.5], [0.1, 0.7, -1.1]], dtype=torch.float64)
    base = whole.joint_frames(q[:, [2, 0, 1]])[:, 0] @ rotation_about(whole.axes[0], q[:, 2])
    torch.testing.assert_close(base @ upper(q), whole(q[:, [2, 0, 1]]), rtol=0, atol=1e-14)
    slopes = torch.func.vmap(torch.func.jacrev(lambda row: upper(row[None])[0, :3, 3]))(q)
    torch.testing.assert_close(upper.jacobian(q)[:, :3], slopes, rtol=0, atol=1e-14)
    assert robot_from_config(json.loads(json.dumps(upper.to_config()))).joint_names == upper.joint_names


def rotation_about(axis: torch.Tensor, angles: torch.Tensor) -> torch.Tensor:
    poses = torch.eye(4, dtype=torch.float64).repeat(len(angles), 1, 1)
    poses[:, :3, :3] = rotation(angles[:, None] * axis)
    return poses


def test_a_driver_that_is_not_there_is_explained(urdf: Path) -> None:
    urdf.write_text(URDF.replace('<mimic joint="turn" multiplier="-0.5"', '<mimic joint="twist" multiplier="-0.5"'))
    message = "joint 'counter' of robot 'lift' mimics 'twist', which is not a joint between 'a' and 'hand'; choose a"
    with pytest.raises(RobotError, match=re.escape(message)):
        load_urdf(urdf, "a", "hand")


def test_a_mimic_without_a_joint_is_explained_on_the_path_only(urdf: Path) -> None:
    urdf.write_text(URDF.replace('<mimic joint="wrist" multiplier="2"/>', "<mimic/>"))
    assert load_urdf(urdf, "floor", "hand").n == 3
    with pytest.raises(RobotError, match=r"<mimic> of joint 'grip' in '.*' has no attribute 'joint'; add it"):
        load_urdf(urdf, "floor", "finger")
