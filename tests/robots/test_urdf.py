"""URDF files: kinematics that are read, content that is ignored, faults that are explained."""

import os
import re
from math import inf
from pathlib import Path

import pytest
import torch

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibWarning, InputError, RobotError
from diffeo_calib.robots import load_urdf

LINKS = "".join(f'<link name="{name}"/>' for name in ("base_link", "upper_arm", "forearm", "tool"))
Z = '<axis xyz="0 0 1"/>'
XACRO = "http://www.ros.org/wiki/xacro"


def joint(name: str, parent: str, child: str, kind: str = "revolute", inside: str = Z) -> str:
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{inside}</joint>'


GOOD = (
    joint("shoulder", "base_link", "upper_arm")
    + joint("elbow", "upper_arm", "forearm", "continuous", '<origin xyz="1 0 0"/><axis xyz="0 0 2"/>')
    + joint("mount", "forearm", "tool", "fixed", '<origin xyz="0 0.5 0" rpy="0 0 1.5"/>')
)
Q = torch.tensor([[0.3, -0.4]], dtype=torch.float64)


def robot(body: str, attributes: str = ' name="arm"') -> str:
    return f"<robot{attributes}>{LINKS}{body}</robot>"


def load(folder: Path, content: str | bytes, tip: str = "tool", base: str = "base_link") -> dc.Chain:
    file = folder / "arm.urdf"
    file.write_bytes(content.encode() if isinstance(content, str) else content)
    return load_urdf(file, base, tip)


JUNK = """<!-- comment --><?hint x?><xacro:include filename="x"/><gazebo><plugin name="p"/></gazebo>
    <material name="m"/><transmission name="t"><type>x</type></transmission><unheard_of a="b"><joint/></unheard_of>
    <sensor:camera name="c"/><material name="m"/>"""
MESH = """<link name="base_link"><visual><geometry><mesh filename="package://none/missing.dae"/></geometry></visual>
    <visual><geometry><blob/></geometry></visual><collision/><inertial/></link>"""


@pytest.mark.parametrize(
    "content",
    [
        robot(JUNK + GOOD, "").replace('<link name="base_link"/>', MESH),
        b"\xef\xbb\xbf" + robot(GOOD).encode(),  # a byte order mark
        '<?xml version="1.0" encoding="utf-16"?>'.encode("utf-16") + robot(GOOD).encode("utf-16-le"),
        robot(GOOD, f' name="arm" xmlns="http://drake.mit.edu" xmlns:xacro="{XACRO}"'),
        robot(GOOD.replace(Z, Z + '<limit lower="-inf" upper="inf"/>')),
        robot(GOOD.replace(Z, Z + '<limit effort="1"/>')),
        robot(GOOD.replace(Z, '<axis xyz="0 0 3e-200"/>')),  # its square is not representable
        robot(GOOD + joint("k", "tool", "finger", "revolute", '<limit lower="1" upper="0"/>')),  # off the path
    ],
)
def test_what_is_read_without_a_word(content: str | bytes, tmp_path: Path) -> None:
    chain, plain = load(tmp_path, content), load(tmp_path, robot(GOOD))
    assert chain.name == "arm"  # the file's, where the robot has none
    assert torch.equal(chain(Q), plain(Q))


def test_joints_off_the_path_may_be_of_any_kind(tmp_path: Path) -> None:
    side = '<link name="finger"/><link name="thumb"/><link name="cloud"/><link name="cart"/>'
    side += joint("grip", "tool", "finger", "revolute")
    side += joint("follow", "tool", "thumb", "revolute", '<axis xyz="1 0 0"/><mimic joint="grip" multiplier="-1"/>')
    side += joint("drift", "tool", "cloud", "floating") + joint("roll", "cart", "base_link", "planar")
    assert load(tmp_path, robot(GOOD + side)).joint_names == ("shoulder", "elbow")
    assert load(tmp_path, robot(GOOD + side), "finger").joint_names == ("shoulder", "elbow", "grip")


def test_defaults_of_the_format(tmp_path: Path) -> None:
    body = joint("shoulder", "base_link", "upper_arm", "prismatic", '<limit effort="1" velocity="1"/>')
    body += joint("elbow", "upper_arm", "forearm", "revolute", '<limit lower="-1" upper="2"/>')
    chain = load(tmp_path, robot(body + joint("mount", "forearm", "tool", "fixed", '<axis xyz="0 0 0"/>')))
    assert chain.limits.tolist() == [[-inf, inf], [-1.0, 2.0]]
    assert chain.axes.tolist() == [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]


FIXED = '<axis xyz="0 0 0"/><mimic joint="elbow"/><limit lower="1" upper="0"/>'


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('<?xml version="0.0" ?>' + robot(GOOD), "ignored the version in its XML declaration"),
        ('<?xml version="1.1" ?>' + robot(GOOD), "ignored the version in its XML declaration"),
        ('\n<?xml version="1.0" ?>' + robot(GOOD), "ignored an XML declaration that is not at its very beginning"),
        (robot("<!-- a -- b -->" + GOOD), "ignored two hyphens inside a comment"),
        (robot(GOOD.replace(Z, Z + '<limit lower="1" upper="-1"/>')), r"limits of joint 'shoulder' \(lower 1, upper"),
        (robot(GOOD.replace(Z, Z + '<limit lower="nan" upper="1"/>')), r"lower nan, upper 1"),
        (robot(GOOD.replace('<origin xyz="0 0.5', f'{FIXED}<origin xyz="0 0.5')), "<mimic> of joint 'mount'"),
    ],
)
def test_harmless_faults_are_ignored_with_a_warning(content: str, message: str, tmp_path: Path) -> None:
    plain = load(tmp_path, robot(GOOD))
    with pytest.warns(DiffeoCalibWarning, match=message) as caught:
        chain = load(tmp_path, content)
    assert len(caught) == 1
    assert torch.equal(chain(Q), plain(Q))
    assert chain.limits.isinf().all()


def one(kind: str = "revolute", inside: str = Z) -> str:
    """A robot of one joint."""
    return robot(joint("j", "base_link", "tool", kind, inside))


MACROS = f'<robot name="r" xmlns:xacro="{XACRO}"><xacro:include filename="x"/></robot>'
FAST = joint("k", "base_link", "upper_arm") + joint(
    "j", "upper_arm", "tool", inside='<mimic joint="k" multiplier="1e200"/>'
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot name='r'><link name='a'>", "is not well-formed XML (line 1"),
        ("<sdf/>", "is not a URDF: expected <robot> as its root element, got <sdf>"),
        ('<robot name="r" xmlns="x"><links/></robot>', "has no link 'base_link'"),
        (MACROS, "but macros that may make it; expand the xacro file first"),
        (robot("<link/>"), "a <link> in "),
        (robot("<joint name='j'/>"), "has no attribute 'type'"),
        (robot("<joint name='j' type='fixed'><child link='tool'/></joint>"), "joint 'j' in "),
        (robot("<joint name='j' type='fixed'><parent/><child link='tool'/></joint>"), "<parent> of joint 'j'"),
        (robot(GOOD.replace("1 0 0", "1 0")), "expected 3 finite numbers, got '1 0'; correct the file"),
        # a file that was not expanded is refused at once, not when another tip is chosen
        (
            robot(GOOD + joint("grip", "tool", "finger", "floating", '<origin xyz="${a} 0 0"/>')),
            "expand the xacro file",
        ),
        (one(inside='<mimic joint="k" offset="much"/>'), "offset of <mimic> of joint 'j' in "),
        (robot(FAST), "the multiplier of 'k' in joint 'j': expected a number of at most 1e+06, got 1e+200"),
        (one(inside='<mimic joint="k"/>'), "mimics 'k', which is not a joint between 'base_link' and 'tool'; choose a"),
        (robot(GOOD + joint("again", "base_link", "tool")), "has two parent joints ('mount' and 'again')"),
        (robot(joint("j", "base_link", "forearm") + joint("j", "forearm", "tool")), "several joints named ['j']"),
        (one("fixed"), "has no moving joint from 'base_link' to 'tool'"),
        (one("floating"), "the type of joint 'j' in "),
        (one(inside='<axis xyz="0 0 0"/>'), "the axis of joint 'j': expected a non-zero vector"),
        (robot(joint("a", "base_link", "upper_arm")), "are not connected in '{}': got 'base_link' below"),
        (robot(joint("a", "upper_arm", "tool") + joint("b", "tool", "upper_arm")), "loop: got the path tool <-"),
    ],
)
def test_bad_files_are_explained(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message.replace("{}", str(tmp_path / "arm.urdf")))):
        load(tmp_path, text)


@pytest.mark.parametrize(
    ("base", "tip", "message"),
    [
        ("base_link", "fore_arm", r"`tip`: .* has no link 'fore_arm'; did you mean 'forearm'\?.* its links are"),
        ("zzz", "tool", r"`base`: .*; its links are base_link, upper_arm, forearm, tool\.$"),
        ("tool", "tool", "no moving joint from 'tool' to 'tool'"),
    ],
)
def test_unknown_links_come_with_near_matches_and_all_links(base: str, tip: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(RobotError, match=message):
        load(tmp_path, robot(GOOD), tip, base)


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="needs a device without an end")
def test_files_that_are_no_files(tmp_path: Path) -> None:
    for place in ("/dev/zero", tmp_path):
        with pytest.raises(RobotError, match=f"'{place}' is no file; check the path of the URDF"):
            load_urdf(place, "a", "b")
    with pytest.raises(InputError, match="the name of a file: expected text or a path, got 3"):
        load_urdf(3, "a", "b")  # pyright: ignore[reportArgumentType]
    with pytest.raises(RobotError, match=r"there is no file '.*arm.urdf'; check the path"):
        load_urdf(tmp_path / "arm.urdf", "base_link", "tool")
    large = tmp_path / "large.urdf"
    large.touch()
    os.truncate(large, 200_000_000)  # takes no space
    with pytest.raises(RobotError, match=r"too large for a URDF: expected at most 100 MB"):
        load_urdf(large, "a", "b")
