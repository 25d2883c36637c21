"""URDF files: kinematics that are read, content that is ignored, faults that are explained."""

import re
from math import inf, pi
from pathlib import Path

import pytest
import torch
from scipy.spatial.transform import Rotation

from diffeo_calib.common.errors import RobotError
from diffeo_calib.robots import load_urdf

LINKS = "".join(f'<link name="{name}"/>' for name in ("base_link", "upper_arm", "forearm", "tool"))


def joint(name: str, parent: str, child: str, kind: str = "revolute", inside: str = '<axis xyz="0 0 1"/>') -> str:
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{inside}</joint>'


GOOD = (
    joint("shoulder", "base_link", "upper_arm")
    + joint("elbow", "upper_arm", "forearm", "continuous", '<origin xyz="1 0 0"/><axis xyz="0 0 2"/>')
    + joint("mount", "forearm", "tool", "fixed", '<origin xyz="0 0.5 0" rpy="0 0 1.5"/>')
)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "arm.urdf"


def robot(body: str, name: str = ' name="arm"') -> str:
    return f"<robot{name}>{body}</robot>"


def test_a_plain_file_is_read(file: Path) -> None:
    file.write_text(robot(LINKS + GOOD))
    chain = load_urdf(str(file), "base_link", "tool")
    assert (chain.name, chain.base, chain.tip) == ("arm", "base_link", "tool")
    assert chain.joint_names == ("shoulder", "elbow")
    expected = torch.tensor([1.0 - 0.5, 0.0, 0.0], dtype=torch.float64)
    q = torch.tensor([[0.0, torch.pi / 2]], dtype=torch.float64)
    torch.testing.assert_close(chain(q)[0, :3, 3], expected, rtol=0, atol=1e-15)


def test_everything_but_kinematics_is_ignored(file: Path) -> None:
    junk = """<!-- comment --><?hint x?><xacro:include filename="x"/><gazebo><plugin name="p"/></gazebo>
      <material name="m"/><transmission name="t"><type>x</type></transmission><unheard_of a="b"><joint/></unheard_of>
      <sensor:camera name="c"/>"""
    mesh = """<link name="base_link"><visual><geometry><mesh filename="package://none/missing.dae"/></geometry></visual>
      <visual><geometry><blob/></geometry></visual><collision/><inertial/></link>"""
    file.write_text(robot(junk + LINKS.replace('<link name="base_link"/>', mesh) + GOOD, name=""))
    chain = load_urdf(file, "base_link", "tool")
    assert chain.name == "arm"  # the file's, where the robot has none
    assert chain.n == 2


def test_joints_off_the_path_may_be_of_any_kind(file: Path) -> None:
    side = '<link name="finger"/><link name="thumb"/><link name="cloud"/><link name="cart"/>'
    side += joint("grip", "tool", "finger", "revolute")
    side += joint("follow", "tool", "thumb", "revolute", '<axis xyz="1 0 0"/><mimic joint="grip" multiplier="-1"/>')
    side += joint("drift", "tool", "cloud", "floating") + joint("roll", "cart", "base_link", "planar")
    file.write_text(robot(LINKS + GOOD + side))
    assert load_urdf(file, "base_link", "tool").joint_names == ("shoulder", "elbow")
    assert load_urdf(file, "base_link", "finger").joint_names == ("shoulder", "elbow", "grip")


def test_defaults_of_the_format(file: Path) -> None:
    body = joint("shoulder", "base_link", "upper_arm", "prismatic", '<limit effort="1" velocity="1"/>')
    body += joint("elbow", "upper_arm", "forearm", "revolute", '<limit lower="-1" upper="2"/>')
    body += joint("mount", "forearm", "tool", "fixed", '<axis xyz="0 0 0"/>')
    file.write_text(robot(LINKS + body))
    chain = load_urdf(file, "base_link", "tool")
    assert chain.limits.tolist() == [[-inf, inf], [-1.0, 2.0]]
    assert chain.axes.tolist() == [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]


def test_origins_are_roll_pitch_yaw_then_a_shift(file: Path) -> None:
    origin = '<origin rpy="0.3 -4 1.5707963267948966" xyz="1e-1 -2. 3"/>'
    only_rpy, only_xyz = '<origin rpy="0 0 1"/>', '<origin xyz="1 2 3"/>'
    body = joint("shoulder", "base_link", "upper_arm", "revolute", origin)
    body += joint("elbow", "upper_arm", "forearm", "revolute", only_rpy)
    body += joint("mount", "forearm", "tool", "fixed", only_xyz)
    file.write_text(robot(LINKS + body))
    chain = load_urdf(file, "base_link", "tool")
    turn = Rotation.from_euler("xyz", [0.3, -4.0, pi / 2]).as_matrix()
    torch.testing.assert_close(chain.offsets[0, :3, :3], torch.from_numpy(turn), rtol=0, atol=1e-15)
    assert chain.offsets[0, :3, 3].tolist() == [0.1, -2.0, 3.0]
    assert chain.offsets[1, :3, 3].tolist() == [0.0, 0.0, 0.0]
    assert chain.tip_offsets[0][:, 3].tolist() == [1.0, 2.0, 3.0, 1.0]
    assert torch.equal(chain.tip_offsets[0][:3, :3], torch.eye(3, dtype=torch.float64))
    assert chain.axes.tolist() == [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]


def test_numbers_off_the_path_are_checked_too(file: Path) -> None:
    """A file that was not expanded is refused at once, not when another tip is chosen."""
    side = '<link name="finger"/>' + joint("grip", "tool", "finger", "floating", '<origin xyz="${a} 0 0"/>')
    file.write_text(robot(LINKS + GOOD + side))
    with pytest.raises(RobotError, match=r"xyz of <origin> of joint 'grip' in .*expand the xacro file first"):
        load_urdf(file, "base_link", "tool")


def one(kind: str = "revolute", inside: str = '<axis xyz="0 0 1"/>') -> str:
    """A robot of one joint."""
    return robot(LINKS + joint("j", "base_link", "tool", kind, inside))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is not well-formed XML"),
        ("plain words", "is not well-formed XML"),
        ("<robot name='r'><link name='a'>", "is not well-formed XML (line 1"),
        ("<sdf/>", "is not a URDF: expected <robot> as its root element, got <sdf>"),
        (robot("<link/>"), "a <link> in "),
        (robot(LINKS + "<joint type='fixed'/>"), "a <joint> in "),
        (robot(LINKS + "<joint name='j'/>"), "has no attribute 'type'"),
        (robot(LINKS + "<joint name='j' type='fixed'><child link='tool'/></joint>"), "joint 'j' in "),
        (robot(LINKS + "<joint name='j' type='fixed'><parent/><child link='tool'/></joint>"), "<parent> of joint 'j'"),
        (robot(LINKS + GOOD.replace("1 0 0", "1 0")), "expected 3 finite numbers, got '1 0'; correct the file"),
        (robot(LINKS + GOOD.replace("1 0 0", "1 0 nan")), "expected 3 finite numbers"),
        (robot(LINKS + GOOD.replace("1 0 0", "${l} 0 0")), "expand the xacro file first"),
        (one(inside='<limit lower="a" upper="1"/>'), "lower of <limit> of joint 'j'"),
        (one(inside='<mimic joint="k" offset="much"/>'), "offset of <mimic> of joint 'j' in "),
        (one(inside='<mimic joint="k" multiplier="inf"/>'), "expected a finite number, got 'inf'; correct the file"),
        (robot(LINKS + GOOD + joint("again", "base_link", "tool")), "has two parent joints ('mount' and 'again')"),
        (one("fixed"), "has no moving joint from 'base_link' to 'tool'"),
        (one("floating"), "the type of joint 'j' in "),
        (one("planar"), "got 'planar'; choose a base and a tip"),
        (one("hinge"), "got 'hinge'"),
        (one(inside='<mimic joint="k"/>'), "mimics 'k', which is not a joint between 'base_link' and 'tool'; choose a"),
        (one(inside='<axis xyz="0 0 0"/>'), "the axis of joint 'j': expected a non-zero vector"),
    ],
)
def test_bad_files_are_explained(file: Path, text: str, message: str) -> None:
    file.write_text(text)
    with pytest.raises(RobotError, match=re.escape(message)):
        load_urdf(file, "base_link", "tool")


def test_a_missing_file_is_explained(file: Path) -> None:
    with pytest.raises(RobotError, match=r"there is no file '.*arm.urdf'; check the path"):
        load_urdf(file, "base_link", "tool")


def test_unknown_links_come_with_near_matches_and_all_links(file: Path) -> None:
    file.write_text(robot(LINKS + GOOD))
    with pytest.raises(RobotError, match=r"`tip`: .* has no link 'fore_arm'; did you mean 'forearm'\?.* its links are"):
        load_urdf(file, "base_link", "fore_arm")
    with pytest.raises(RobotError, match=r"`base`: .*; its links are base_link, upper_arm, forearm, tool\.$"):
        load_urdf(file, "zzz", "tool")


def test_links_that_are_not_connected_are_explained(file: Path) -> None:
    file.write_text(robot(LINKS + joint("a", "base_link", "upper_arm")))
    message = "links 'base_link' and 'tool' are not connected in .*: got 'base_link' below 'base_link', 'tool' below"
    with pytest.raises(RobotError, match=message):
        load_urdf(file, "base_link", "tool")
    ring = joint("a", "upper_arm", "forearm") + joint("b", "forearm", "upper_arm")
    file.write_text(robot(LINKS + ring))
    with pytest.raises(RobotError, match="make a loop: got the path forearm <- upper_arm <- forearm"):
        load_urdf(file, "base_link", "forearm")
    file.write_text(robot(LINKS + GOOD))
    with pytest.raises(RobotError, match="no moving joint from 'tool' to 'tool'"):
        load_urdf(file, "tool", "tool")
