"""Corrected URDF and MJCF files: the poses of the geometry in other readers, every other byte as it was."""

import math
import re
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from deformation_bank import model_of
from export_bank import UGLY, UGLY_ENDS, changed_lines, configurations, own_poses, pinocchio_poses, write_ugly, wrong
from robots_bank import draw

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, RobotError
from diffeo_calib.interop.urdf import mjcf_text, origin_numbers, urdf_of, write_mjcf, write_urdf
from diffeo_calib.robots import Geometry, SimulatedArm
from diffeo_calib.robots.joint import Joint
from diffeo_calib.robots.se3 import roll_pitch_yaw, transforms
from diffeo_calib.robots.tree import Chain

MIMIC = UGLY.replace('<axis xyz="0 -1 0"/>', '<axis xyz="0 -1 0"/><mimic joint="lift" multiplier="-0.5" offset="0.2"/>')
TEXTS = {
    "ugly": UGLY.encode(),
    "crlf": UGLY.replace("\n", "\r\n").encode(),
    "bom": UGLY.encode("utf-8-sig"),
    "latin-1": UGLY.replace('encoding="utf-8"', 'encoding="iso-8859-1"').encode("latin-1"),
    "cp1252": UGLY.replace('encoding="utf-8"', 'encoding="windows-1252"').encode("cp1252"),
    "undeclared name space": UGLY.replace(' xmlns:xacro="http://ros.org/wiki/xacro"', "").encode(),
    "mimic": MIMIC.encode(),
    "one line": re.sub(r">\s+<", "><", UGLY).encode(),
}


ORIGIN = re.compile(rb"\s*<origin\b[^>]*>")
TRIPLE = rb" ".join([rb"-?[\d.e+-]+"] * 3)
LAYOUT = (
    rb"<origin\n         rpy = '%b'\n         xyz = \"%b\" />",
    rb'<joint name="lift" type="continuous">\n     <origin xyz="%b" rpy="%b"/>\n     <parent',
    rb'<child link="d"/><origin xyz="%b" rpy="%b"/><axis',
    rb'    <origin xyz="%b" rpy="%b"/><parent link="d"/>',
)


def but_origins(robot: dc.Tree) -> dict[str, Any]:
    config = robot.to_config()
    return config | {"joints": [joint | {"origin": None} for joint in config["joints"]]}


@pytest.mark.parametrize("content", TEXTS.values(), ids=TEXTS.keys())
def test_other_readers_get_the_geometry_s_poses_and_only_origins_change(content: bytes, tmp_path: Path) -> None:
    before, after = tmp_path / "before.urdf", tmp_path / "after.urdf"
    before.write_bytes(content)
    chain = dc.load_urdf(before, *UGLY_ENDS)
    geometry, q = wrong(chain), configurations(chain)
    write_urdf(geometry, after)
    again = dc.load_urdf(after, *UGLY_ENDS)
    torch.testing.assert_close(again(q), own_poses(geometry, q), rtol=0, atol=1e-12)
    assert float((chain(q) - again(q)).abs().max()) > 1e-2
    assert but_origins(again) == but_origins(chain)
    torch.testing.assert_close(pinocchio_poses(after, chain, q), own_poses(geometry, q), rtol=0, atol=1e-12)
    new = after.read_bytes()
    assert ORIGIN.sub(b"", new) == ORIGIN.sub(b"", content)
    old_origins, new_origins = ORIGIN.findall(content), ORIGIN.findall(new)
    assert len(new_origins) == len(old_origins) + 1, "the joint without one gets its own"
    assert len([origin for origin in old_origins if origin not in new_origins]) == 3, "pan, slide, turn"
    assert (new.count(b"\r\n") == new.count(b"\n")) == (b"\r" in content)
    for number in (b"9 9 9", b"8 8 8", b"7 7 7", b"6 6 6", b"5 5 5", b"1 1 1"):
        assert new.count(number) == content.count(number), "comments, CDATA, other elements"
    if content == TEXTS["ugly"]:
        assert all(re.search(layout % (TRIPLE, TRIPLE), new) for layout in LAYOUT)


def test_without_errors_the_file_is_copied(tmp_path: Path) -> None:
    chain = write_ugly(tmp_path / "robot.urdf", encoding="utf-8-sig")
    write_urdf(Geometry.nominal(chain), tmp_path / "new.urdf")
    assert (tmp_path / "new.urdf").read_bytes() == UGLY.encode("utf-8-sig")
    one = wrong(chain)
    one = replace(one, joint_errors=torch.cat([Geometry.nominal(chain).joint_errors[:3], one.joint_errors[3:]]))
    write_urdf(one, tmp_path / "new.urdf")
    ((old, _),) = changed_lines(UGLY.encode("utf-8-sig"), (tmp_path / "new.urdf").read_bytes())
    assert old == b'    <origin xyz="0.2 0 0"/><parent link="d"/><child link="e"/><axis xyz="0 -1 0"/>'


@pytest.mark.parametrize("lever", [0.0, 1e-16, 1e-14, 1e-9, 1e-4, 0.3])
def test_angles_of_an_origin_are_exact_also_where_they_are_ambiguous(lever: float) -> None:
    angles = draw(200, 3, seed=1) * torch.tensor([2.0, 0.0, 2.0], dtype=torch.float64)
    angles[:, 1] = torch.where(torch.arange(200) % 2 == 0, math.pi / 2, -math.pi / 2) + lever * draw(200, seed=2)
    for row in angles.tolist():
        R = roll_pitch_yaw(*row)
        place, found = origin_numbers(transforms(R, draw(3, seed=3)))
        torch.testing.assert_close(roll_pitch_yaw(*found), R, rtol=0, atol=1e-15)
        assert place == draw(3, seed=3).tolist()
        assert abs(found[1]) < math.pi / 2 + 1e-12


def test_a_model_brings_its_own_urdf(tmp_path: Path) -> None:
    """Byte for byte, whatever they are. Of its rigid kinematics: tests/cli/test_commands.py."""
    text = UGLY.replace('utf-8"', 'iso-8859-1"').replace("-->", "\xff -->")
    chain = write_ugly(tmp_path / "robot.urdf", text, "latin-1")
    dc.save(model_of(chain), tmp_path / "model.safetensors")
    model: Any = dc.load(tmp_path / "model.safetensors")
    assert urdf_of(model.robot) == (tmp_path / "robot.urdf").read_bytes()
    write_urdf(wrong(model.robot), tmp_path / "new.urdf")
    q, again = configurations(chain), dc.load_urdf(tmp_path / "new.urdf", *UGLY_ENDS)
    torch.testing.assert_close(again(q), own_poses(wrong(chain), q), rtol=0, atol=1e-12)


def test_files_that_are_not_of_the_robot(tmp_path: Path) -> None:
    chain, path, new = write_ugly(tmp_path / "robot.urdf"), tmp_path / "other.urdf", tmp_path / "new.urdf"
    commented = UGLY.replace("<!-- end -->", "<!-- serial number 7 -->")
    path.write_text(commented, encoding="utf-8")
    write_urdf(wrong(chain), new, robot=path)
    assert b"serial number 7" in new.read_bytes()
    for change, message in (
        (("0.3", "0.31"), "it differs at 'pan'; pass the nominal URDF"),
        (('"0 -1 0"', '"0 1 0"'), "it differs at 'turn'"),
        (('xyz="0 0 0.1"', 'xyz="0 0 0.2"'), "it differs at 'hand'"),
        (("'pan'", "'panning'"), "the joints of .* got panning, lift"),
        (('"continuous"', '"revolute"'), "the kinds of joints of .*expected revolute, continuous"),
        (('"hand"', '"fist"'), "has no link 'hand'"),
        (("</robot>", ""), "not well-formed"),
    ):
        assert change[0] in commented
        path.write_text(commented.replace(*change), encoding="utf-8")
        with pytest.raises(RobotError, match=message):
            write_urdf(wrong(chain), new, robot=path)
    with pytest.raises(RobotError, match="there is no file"):
        write_urdf(wrong(chain), new, robot=tmp_path / "none.urdf")
    chain = dc.from_dh([(0.1, 0.2, 0.3), (0.1, 0, 0)])
    with pytest.raises(InputError, match=r"'robot' does not hold the URDF that it was fitted with; pass the file"):
        write_urdf(wrong(chain), tmp_path / "none.urdf")
    assert not (tmp_path / "none.urdf").exists()
    chain = write_ugly(tmp_path / "robot.urdf", UGLY.replace('name="grip"', 'name="pan"'))
    with pytest.raises(RobotError, match=r"joint 'pan' in the URDF of .*: expected one <joint> with this name, got 2"):
        write_urdf(wrong(chain), tmp_path / "new.urdf")


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le"])
def test_texts_of_two_bytes_per_letter_are_refused(encoding: str, tmp_path: Path) -> None:
    text = UGLY.replace('encoding="utf-8"', 'encoding="utf-16"')
    chain = write_ugly(tmp_path / "robot.urdf", "\ufeff" * (encoding != "utf-16") + text, encoding)
    with pytest.raises(RobotError, match="save the file in UTF-8"):
        write_urdf(wrong(chain), tmp_path / "new.urdf")


needs_mujoco = pytest.mark.skipif(find_spec("mujoco") is None, reason="mujoco is not installed")


def tip_poses(model: Any, chain: dc.Tree, q: torch.Tensor) -> torch.Tensor:
    import mujoco

    data, found = mujoco.MjData(model), torch.eye(4, dtype=torch.float64).repeat(len(q), 1, 1)
    for row, values in enumerate(chain.moving_values(q).numpy()):
        for name, value in zip(chain.moving_names, values, strict=True):
            data.joint(name).qpos[0] = value
        mujoco.mj_kinematics(model, data)
        site = data.site(chain.tips[0])
        found[row, :3, 3] = torch.from_numpy(site.xpos.copy())
        found[row, :3, :3] = torch.from_numpy(site.xmat.reshape(3, 3).copy())
    return found


def inertia(body: Any) -> np.ndarray:
    import mujoco

    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, body.iquat)
    return R.reshape(3, 3) @ np.diag(body.inertia) @ R.reshape(3, 3).T


@needs_mujoco
@pytest.mark.parametrize("text", [UGLY, MIMIC], ids=["ugly", "mimic"])
def test_mujoco_finds_the_tip_where_the_geometry_has_it(text: str, tmp_path: Path) -> None:
    import mujoco

    (tmp_path / "before.urdf").write_text(text)
    chain = dc.load_urdf(tmp_path / "before.urdf", *UGLY_ENDS)
    geometry, q = wrong(chain), configurations(chain)
    write_mjcf(geometry, tmp_path / "after.xml")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "after.xml"))
    torch.testing.assert_close(tip_poses(model, chain, q), own_poses(geometry, q), rtol=0, atol=1e-12)
    assert model.neq == sum(joint.mimic is not None for joint in chain.joints)
    for joint in chain.joints:
        if joint.mimic is not None:
            np.testing.assert_allclose(model.eq_data[0, :2], [joint.mimic_offset, *joint.mimic.values()])


@needs_mujoco
def test_limits_masses_inertias_and_names(tmp_path: Path) -> None:
    import mujoco

    arm = SimulatedArm(seed=0)
    arm.write_urdf(tmp_path / "arm.urdf")
    text = (tmp_path / "arm.urdf").read_text()
    turned = re.sub(r'(<inertial>\s*<origin xyz="[^"]*")[^/]*/>', r'\1 rpy="0.3 -0.5 0.7"/>', text)
    assert turned != text
    (tmp_path / "arm.urdf").write_text(turned)
    chain = dc.load_urdf(tmp_path / "arm.urdf", "base_link", "flange")
    ours = mujoco.MjModel.from_xml_string(mjcf_text(wrong(chain)))
    theirs = mujoco.MjModel.from_xml_path(str(tmp_path / "arm.urdf"))
    np.testing.assert_allclose(ours.jnt_range, chain.limits.numpy())
    for joint in chain.moving_names:
        here, there = (model.body(model.jnt_bodyid[model.joint(joint).id]) for model in (ours, theirs))
        assert here.name == there.name
        np.testing.assert_allclose(here.mass, there.mass)
        np.testing.assert_allclose(here.ipos, there.ipos, atol=1e-12)
        np.testing.assert_allclose(inertia(here), inertia(there), rtol=0, atol=1e-9)
    robot = dc.from_dh([(0.3, 0.0, 0.1), (0.2, 0.4, 0.0)], "standard", names=["a", "b"])
    model = mujoco.MjModel.from_xml_string(mjcf_text(wrong(robot)))
    assert {"a", "b"} <= {model.body(number).name for number in range(model.nbody)}


def test_what_mjcf_cannot_hold_is_refused() -> None:
    joints = [Joint(name, "revolute", torch.eye(4, dtype=torch.float64)) for name in "ab"]
    both = replace(joints[0], name="c", mimic={"a": 1.0, "b": 2.0})
    with pytest.raises(InputError, match="mimic joint 'c'"):
        mjcf_text(wrong(Chain("robot", "base", "tip", [*joints, both])))
    arm = SimulatedArm(seed=0).nominal
    with pytest.raises(InputError, match="not above"):
        mjcf_text(wrong(arm.reversed()))
    alone = replace(joints[0], name="d", mimic={"elsewhere": 1.0})
    beside = Joint("elsewhere", "revolute", torch.eye(4, dtype=torch.float64))
    with pytest.raises(InputError, match=r"mimic joint 'd'.*elsewhere"):
        mjcf_text(wrong(Chain("robot", "base", "tip", [*joints, alone], drivers=[beside])))
