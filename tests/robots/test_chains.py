"""Chains, mimic joints and URDF files: attributes, reach, values, messages. Poses and derivatives: test_laws.py."""

import json
import os
import re
from collections.abc import Mapping
from math import inf, nan, pi
from pathlib import Path
from typing import Any, cast

import pytest
import torch
from robots_bank import CHAIN, CROOKED, KINDS, LIFT, MOVING, build, crooked_joints, draw, expand

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibWarning, InputError, RobotError
from diffeo_calib.robots import Chain, DHRow, Joint, SimulatedArm, from_dh, load_urdf
from diffeo_calib.robots.se3 import rotation, transforms
from diffeo_calib.robots.tree import robot_from_config


@pytest.fixture
def crooked(tmp_path: Path) -> Chain:
    (tmp_path / "robot.urdf").write_text(CROOKED)
    return load_urdf(tmp_path / "robot.urdf", "world", "end")


def test_attributes_forms_of_values_and_reach(crooked: Chain) -> None:
    assert crooked.joint_names == ("slide", "turn", "spin", "lift")
    assert crooked.kinds == ("prismatic", "revolute", "continuous", "prismatic")
    assert crooked.periodic == (False, True, True, False)
    assert crooked.limits.tolist() == [[-0.4, 0.7], [-2.0, 2.0], [-inf, inf], [0.0, 0.2]]
    assert "crooked" in repr(crooked)
    assert "slide, turn, spin, lift" in repr(crooked)
    q = draw(2, 4)
    for same in cast(list[Any], [q.tolist(), q.numpy()]):
        torch.testing.assert_close(crooked(same), crooked(q))
    assert crooked(q.float()).dtype == torch.float64
    assert crooked(q[:0]).shape == (0, 4, 4)
    assert crooked.jacobian(q[:0]).shape == (0, 6, 4)
    arm = SimulatedArm()
    distances = arm.nominal(arm.sample(3000))[:, :3, 3].norm(dim=1)
    assert distances.max() < arm.nominal.reach < 1.3 * distances.max()
    lower, upper = crooked.limits.clamp(-pi, pi).unbind(1)
    q = lower + (upper - lower) * torch.rand(2000, 4, dtype=torch.float64)
    assert crooked(q)[:, :3, 3].norm(dim=1).max() < crooked.reach < 10


def slide(name: str, lower: float, upper: float, mimic: Mapping[str, float] | None = None, offset: float = 0) -> Joint:
    return Joint(name, "prismatic", torch.eye(4), torch.ones(3), lower, upper, mimic, offset)


X, MOTOR = slide("x", -1, 2), Joint("motor", "continuous", torch.eye(4))


@pytest.mark.parametrize(
    ("joints", "reach"),
    [
        ([slide("x", -inf, inf)], inf),
        ([X], 2.0),
        ([X, slide("y", 0, 0.1, {"x": -2.0}, 0.5)], 5.5),  # from 0.5 - 4 to 0.5 + 2, whatever its own limits are
        ([MOTOR, X], 2.0),  # the motor without limits drives no slide
        ([MOTOR, slide("rack", -0.2, 0.3, {"motor": 0.01})], 0.3),
        ([MOTOR, slide("rack", -inf, inf, {"motor": 0.01})], inf),
        ([MOTOR, X, slide("y", -9, 9, {"x": 1.0, "motor": 0.0})], 4.0),
    ],
)
def test_reach_counts_strokes_and_follows_from_the_limits_of_drivers(joints: list[Joint], reach: float) -> None:
    assert Chain("r", "a", "b", joints).reach == reach


def bad_origin(entry: float, row: int, column: int) -> torch.Tensor:
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[row, column] = entry
    return matrix


RIGID, OFFSET = "origin of joint 'j': expected a rigid transform", "offset of joint 'j': expected a finite number, got"
EYE, MAPPING = torch.eye(4), "the mimic of joint 'j': expected a mapping from names of joints to multipliers"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"kind": "ball"}, "the kind of joint 'j': expected one of revolute, continuous"),
        *(({"origin": bad_origin(*entry)}, RIGID) for entry in ((1.1, 0, 0), (-1.0, 2, 2), (0.1, 3, 0))),
        ({"origin": bad_origin(nan, 0, 3)}, "not finite"),
        ({"origin": torch.eye(3)}, "`the origin of joint 'j'` has the wrong shape: expected (4, 4), got (3, 3)"),
        ({"axis": torch.zeros(3)}, "the axis of joint 'j': expected a non-zero vector"),
        ({"lower": 1.0, "upper": -1.0}, "the limits of joint 'j': expected lower <= upper"),
        *(({"mimic": wrong}, MAPPING) for wrong in ({}, "k", {3: 1.0})),
        *(({"mimic": {"k": 1.0}, "mimic_offset": wrong}, f"{OFFSET} {wrong}") for wrong in (inf, None)),
        ({"kind": "fixed", "mimic": {"k": 1.0}}, "joint 'j' is fixed and cannot mimic; give it a moving kind, or no"),
        ({"mimic_offset": 0.1}, "joint 'j' has a mimic offset but mimics no joint; name the joints that drive it"),
    ],
)
def test_joints_check_themselves(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        Joint("j", **{"kind": "revolute", "origin": EYE} | arguments)


@pytest.mark.parametrize(
    ("mimic", "message"),
    [
        ({"rail": {"wrist": 1.0}}, "joint 'rail' of robot 'machine' mimics 'wrist', which is not a joint between"),
        ({"rail": {"waist": 1.0, "plate": 1.0}}, "joint 'rail' of robot 'machine' mimics 'plate', which is fixed; mak"),
        ({"rail": {"rail": 1.0}}, "joints of robot 'machine' mimic each other in a circle: rail; make one of"),
        (
            {"early": {"rail": 1.0}, "rail": {"waist": 1.0, "sum": 1.0}, "sum": {"rack": 1.0}, "rack": {"rail": 1.0}},
            "mimic each other in a circle: rail, sum, rack; make one of them active.",
        ),
        ({name: {"waist": 1.0} for name in MOVING}, "mimic each other in a circle: waist; make"),
    ],
)
def test_chains_check_their_mimic_joints(mimic: Mapping[str, Mapping[str, float]], message: str) -> None:
    with pytest.raises(RobotError, match=re.escape(message)):
        build(crooked_joints(KINDS), {name: (drivers, 0.0) for name, drivers in mimic.items()})


def test_mimic_joints_follow_the_active_ones() -> None:
    q = draw(5, 3)
    torch.testing.assert_close(CHAIN.moving_values(q), expand(q), rtol=0, atol=1e-15)
    assert torch.equal(CHAIN.moving_values(q)[:, [1, 2, 4]], q)


@pytest.mark.parametrize("convention", ["standard", "craig"])
def test_rows_of_a_table_with_mimic(convention: str) -> None:
    free = [(0.1, 0.4, 0.3, 0.2), (-0.2, -1.1, 0.5, 0.7, "prismatic"), (0.3, 0.9, -0.1), (0.1, 0.2, 0.4)]
    follow = {"joint_1": -1.0, "joint_4": 0.5}
    q = draw(5, 2)
    full = torch.stack([q[:, 0], 0.2 + 3 * q[:, 0], 0.1 - q[:, 0] + 0.5 * q[:, 1], q[:, 1]], dim=1)
    rows = [
        free[0],
        DHRow(-0.2, -1.1, 0.5, 0.7, "prismatic", {"joint_1": 3.0}, 0.2),
        (0.3, 0.9, -0.1, 0.0, "revolute", follow, 0.1),
        DHRow(0.1, 0.2, 0.4),
    ]
    chain = from_dh(rows, convention)
    assert chain.joint_names == ("joint_1", "joint_4")
    torch.testing.assert_close(chain(q), from_dh(free, convention)(full), rtol=0, atol=1e-14)


def test_a_driver_off_the_path_is_a_column(tmp_path: Path) -> None:
    urdf = tmp_path / "lift.urdf"
    urdf.write_text(LIFT)
    whole, upper = load_urdf(urdf, "floor", "hand"), load_urdf(urdf, "a", "hand")
    assert upper.joint_names == ("lift", "wrist", "turn")
    assert upper.moving_names == whole.moving_names[1:]
    q = torch.tensor([[0.3, -0.2, 0.5], [0.1, 0.7, -1.1]], dtype=torch.float64)
    turn = transforms(rotation(q[:, 2:] * whole.axes[0]), torch.zeros(2, 3, dtype=torch.float64))
    base = whole.joint_frames(q[:, [2, 0, 1]])[:, 0] @ turn
    torch.testing.assert_close(base @ upper(q), whole(q[:, [2, 0, 1]]), rtol=0, atol=1e-14)
    slopes = torch.autograd.functional.jacobian(lambda row: upper(row[None])[0, :3, 3], q[0])
    torch.testing.assert_close(upper.jacobian(q[:1])[0, :3], slopes, rtol=0, atol=1e-14)
    assert robot_from_config(json.loads(json.dumps(upper.to_config()))).joint_names == upper.joint_names


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


def test_joints_off_the_path_and_defaults(tmp_path: Path) -> None:
    side = '<link name="finger"/><link name="thumb"/><link name="cloud"/><link name="cart"/>'
    side += joint("grip", "tool", "finger", "revolute")
    side += joint("follow", "tool", "thumb", "revolute", '<axis xyz="1 0 0"/><mimic joint="grip" multiplier="-1"/>')
    side += joint("drift", "tool", "cloud", "floating") + joint("roll", "cart", "base_link", "planar")
    assert load(tmp_path, robot(GOOD + side)).joint_names == ("shoulder", "elbow")
    assert load(tmp_path, robot(GOOD + side), "finger").joint_names == ("shoulder", "elbow", "grip")
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
    return robot(joint("j", "base_link", "tool", kind, inside))


MACROS = f'<robot name="r" xmlns:xacro="{XACRO}"><xacro:include filename="x"/></robot>'
FAST = joint("k", "base_link", "upper_arm")
FAST += joint("j", "upper_arm", "tool", inside='<mimic joint="k" multiplier="1e200"/>')


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot name='r'><link name='a'>", "is not well-formed XML (line 1"),
        ('<robot name="r" xmlns="x"><links/></robot>', "has no link 'base_link'"),
        (MACROS, "but macros that may make it; expand the xacro file first"),
        (robot("<link/>"), "a <link> in "),
        (robot("<joint name='j'/>"), "has no attribute 'type'"),
        (robot("<joint name='j' type='fixed'><child link='tool'/></joint>"), "joint 'j' in "),
        (robot(GOOD.replace("1 0 0", "1 0")), "expected 3 finite numbers, got '1 0'; correct the file"),
        # a file that was not expanded is refused at once, not when another tip is chosen
        (robot(GOOD + joint("g", "tool", "finger", "floating", '<origin xyz="${a} 0 0"/>')), "expand the xacro file"),
        (one(inside='<mimic joint="k" offset="much"/>'), "offset of <mimic> of joint 'j' in "),
        (robot(FAST), "the multiplier of 'k' in joint 'j': expected a number of at most 1e+06, got 1e+200"),
        (robot(GOOD + joint("again", "base_link", "tool")), "has two parent joints ('mount' and 'again')"),
        (robot(joint("j", "base_link", "forearm") + joint("j", "forearm", "tool")), "several joints named ['j']"),
        (one("fixed"), "has no moving joint from 'base_link' to 'tool'"),
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
