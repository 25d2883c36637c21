"""MJCF files: MuJoCo finds the tips where the geometry has them, moves joints within their limits, knows the masses."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from export_bank import UGLY, UGLY_ENDS, configurations, own_poses, wrong

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.interop.urdf import mjcf_text, write_mjcf
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.joint import Joint
from diffeo_calib.robots.tree import Chain

mujoco: Any = pytest.importorskip("mujoco")
MIMIC = UGLY.replace('<axis xyz="0 -1 0"/>', '<axis xyz="0 -1 0"/><mimic joint="lift" multiplier="-0.5" offset="0.2"/>')


def tip_poses(model: Any, chain: dc.Tree, q: torch.Tensor) -> torch.Tensor:
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
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, body.iquat)
    return R.reshape(3, 3) @ np.diag(body.inertia) @ R.reshape(3, 3).T


@pytest.mark.parametrize("text", [UGLY, MIMIC], ids=["ugly", "mimic"])
def test_mujoco_finds_the_tip_where_the_geometry_has_it(text: str, tmp_path: Path) -> None:
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


def test_limits_masses_inertias_and_names(tmp_path: Path) -> None:
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
