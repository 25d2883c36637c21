"""URDF files: kinematics that are read, content that is ignored, faults that are explained."""

import os
import re
import warnings
from math import inf
from pathlib import Path

import pytest
import torch

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibWarning, InputError, RobotError
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
        (robot(LINKS + "<link name='m'/>" + joint("j", "base_link", "m") + joint("j", "m", "tool")), "joint"),
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


# --- harmless faults, which other programs load too, cause a warning; numbers without bounds do not pass --------------


def short(inside: str = "", kind: str = "revolute", name: str = "j", ends: str = "ab") -> str:
    return joint(name, *ends, kind, inside)


def abc(body: str, attributes: str = ' name="r"') -> str:
    return f'<robot{attributes}><link name="a"/><link name="b"/><link name="c"/>{body}</robot>'


def turning(inside: str) -> str:
    """The same of one joint, with more in it."""
    return abc(short('<origin xyz="0 0 1"/><axis xyz="0 1 0"/>' + inside))


TURN = short('<origin xyz="0 0 1"/><axis xyz="0 1 0"/>')
Q = torch.tensor([[0.3]], dtype=torch.float64)


def load(folder: Path, content: str | bytes, tip: str = "b") -> dc.Chain:
    file = folder / "r.urdf"
    file.write_bytes(content.encode() if isinstance(content, str) else content)
    return load_urdf(file, "a", tip)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('<?xml version="0.0" ?>' + abc(TURN), "ignored the version in its XML declaration"),
        ('<?xml version="1.1" ?>' + abc(TURN), "ignored the version in its XML declaration"),
        ('\n<?xml version="1.0" ?>' + abc(TURN), "ignored an XML declaration that is not at its very beginning"),
        (abc("<!-- a -- b -->" + TURN), "ignored two hyphens inside a comment"),
        (
            turning('<limit lower="1" upper="-1"/>'),
            r"the limits of joint 'j' \(lower 1, upper -1\); correct the file if",
        ),
        (turning('<limit lower="nan" upper="1"/>'), r"lower nan, upper 1"),
    ],
)
def test_harmless_faults_are_ignored_with_a_warning(content: str, message: str, tmp_path: Path) -> None:
    plain = load(tmp_path, abc(TURN))
    with pytest.warns(DiffeoCalibWarning, match=message):
        chain = load(tmp_path, content)
    assert torch.equal(chain(Q), plain(Q))
    assert chain.limits.tolist() == [[-inf, inf]]


@pytest.mark.parametrize(
    "content",
    [
        b"\xef\xbb\xbf" + abc(TURN).encode(),  # a byte order mark
        '<?xml version="1.0" encoding="utf-16"?>'.encode("utf-16") + abc(TURN).encode("utf-16-le"),
        abc(TURN, ' name="r" xmlns="http://drake.mit.edu" xmlns:xacro="http://www.ros.org/wiki/xacro"'),
        abc("<sensor:camera/><material name='m'/><material name='m'/><gazebo/><transmission/>" + TURN),
        turning('<limit lower="-inf" upper="inf"/>'),
        turning('<limit effort="1"/>'),
        abc(short('<origin xyz="0 0 1"/><axis xyz="0 3e-200 0"/>')),  # its square is not representable
    ],
)
def test_what_is_read_without_a_word(content: str | bytes, tmp_path: Path) -> None:
    plain = load(tmp_path, abc(TURN))
    assert torch.equal(load(tmp_path, content)(Q), plain(Q))


def test_a_fixed_joint_that_mimics(tmp_path: Path) -> None:
    fixed = short('<axis xyz="0 0 0"/><mimic joint="j"/><limit lower="1" upper="0"/>', "fixed", "k", "bc")
    with pytest.warns(DiffeoCalibWarning, match="ignored <mimic> of joint 'k', which is fixed") as caught:
        chain = load(tmp_path, abc(TURN + fixed), "c")
    assert len(caught) == 1
    assert chain.joint_names == ("j",)
    assert torch.equal(chain(Q), load(tmp_path, abc(TURN))(Q))


def test_faults_off_the_path_are_not_mentioned(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load(tmp_path, abc(TURN + short('<limit lower="1" upper="0"/>', "revolute", "k", "bc")))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (abc(short('<axis xyz="0 inf 0"/>')), "xyz of <axis> of joint 'j'"),
        (abc(short('<origin xyz="0 0 1e308"/>')), "the origin of joint 'j'"),
        (
            abc(TURN + short('<mimic joint="j" multiplier="1e200"/>', "revolute", "k", "bc")),
            "the multiplier of 'j' in joint 'k': expected a number of at most 1e+06, got 1e+200",
        ),
        (
            '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="x"/></robot>',
            "but macros that may make it; expand the xacro file first",
        ),
        (abc(TURN.replace('name="j"', 'name="j" name="k"')), "is not well-formed XML"),
        ('<robot name="r" xmlns="x"><links/></robot>', "has no link 'a'"),
    ],
)
def test_what_cannot_be_ignored_safely(content: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        load(tmp_path, content, "c" if "mimic" in content else "b")


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="needs a device without an end")
def test_files_that_are_no_files(tmp_path: Path) -> None:
    for place in ("/dev/zero", tmp_path):
        with pytest.raises(RobotError, match=f"'{place}' is no file; check the path of the URDF"):
            load_urdf(place, "a", "b")
    large = tmp_path / "large.urdf"
    large.touch()
    os.truncate(large, 200_000_000)  # takes no space
    with pytest.raises(RobotError, match=r"too large for a URDF: expected at most 100 MB"):
        load_urdf(large, "a", "b")
    with pytest.warns(dc.DiffeoCalibWarning, match="inf m"), pytest.raises(InputError, match="the origin of joint"):
        dc.from_dh([(1e308, 0.0, 0.0)])
