"""For tests of exports: an ugly but valid URDF, geometries in general position, poses by pinocchio, rigid models."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from deformation_bank import geometry_of
from robots_bank import draw
from scipy.spatial.transform import Rotation
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.robots import Chain, Geometry

UGLY = """<?xml version='1.0' encoding="utf-8"?>
<!-- <joint name="pan" type="revolute"><origin xyz="9 9 9" rpy="9 9 9"/></joint> -->
<!DOCTYPE robot>
<robot name="Grüße &amp; más" xmlns:xacro="http://ros.org/wiki/xacro">
\t<xacro:property name="pi" value="3.1415"/>
  <link name="floor"><visual><origin xyz="1 1 1" rpy='0 0 0'/><geometry><mesh filename="package://none/a.dae"/>
    </geometry></visual></link><link name="a"/><link name="b"/><link name="c"/><link name="d"/><link name="e"/>
  <link name="hand"/>  <link name="finger"/>
  <gazebo><joint name="pan"><origin xyz="8 8 8"/></joint><![CDATA[<joint name="pan"><origin xyz="7 7 7"/>]]></gazebo>
  <joint   type='revolute'
           name='pan' >
      <parent link='floor'/> <child link='a'/>
      <!-- <origin xyz="6 6 6"/> -->
      <origin
         rpy = '0.0   1.57079632679 0'
         xyz = "0 0
                0.3" />
      <axis xyz="0 0 1"/><limit lower="-3" upper='3' effort="1" velocity="1"/>
  </joint>
  <joint name="lift" type="continuous">
     <parent link="a"/><child link="b"/><axis xyz="0 2 0"/></joint>
  <joint name="pla>te" type="fixed">
    <origin rpy="0 0 0.5" xyz="0.1 0 0"></origin><parent link="b"/><child link="c"/></joint>
  <joint name="slide" type="prismatic">
    <parent link="c"/><child link="d"/><origin/><axis xyz="1 0 0"/><limit lower="0" upper="1" effort="1" velocity="1"/>
  </joint>
  <joint name="turn" type="revolute">
    <origin xyz="0.2 0 0"/><parent link="d"/><child link="e"/><axis xyz="0 -1 0"/>
    <limit lower="-2" upper="2" effort="1" velocity="1"/>
    <!-- a second origin, which readers ignore --><origin xyz="5 5 5"/></joint>
  <joint name="flange" type="fixed"><origin xyz="0 0 0.1" rpy="0 3.14159265358979 0"/>
     <parent link="e"/><child link="hand"/></joint>
  <joint name="grip" type="prismatic"><origin xyz="0 0 0.01"/><parent link="hand"/><child link="finger"/>
     <axis xyz="0 1 0"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint>
</robot>
<!-- end -->
"""
UGLY_ENDS = ("floor", "hand")


def write_ugly(path: Path, text: str = UGLY, encoding: str = "utf-8") -> Chain:
    """Write a file and read its chain."""
    path.write_bytes(text.encode(encoding))
    return dc.load_urdf(path, *UGLY_ENDS)


def wrong(chain: Chain, size: float = 1e-2, markers: int = 1) -> Geometry:
    """A geometry with an error before every joint."""
    return geometry_of(chain, markers, size, seed=7, reach=0.1)


def own_poses(geometry: Geometry, q: Tensor) -> Tensor:
    """Poses of the tip in the robot's own base."""
    return torch.linalg.inv(geometry.base) @ geometry.poses(q)


def configurations(chain: Chain, count: int = 40, seed: int = 9) -> Tensor:
    return draw(count, chain.n, seed=seed)


def pinocchio_poses(path: Path, chain: Chain, q: Tensor) -> Tensor:
    """Poses of the tip in the base by another library; mimic joints get their values from the chain."""
    pin = pytest.importorskip("pinocchio")
    model = pin.buildModelFromUrdf(str(path))
    data = model.createData()
    columns = [model.joints[model.getJointId(name)].idx_v for name in chain.moving_names]
    poses = []
    for row in chain.moving_values(q).numpy():
        step = np.zeros(model.nv)
        step[columns] = row
        pin.forwardKinematics(model, data, pin.integrate(model, pin.neutral(model), step))
        pin.updateFramePlacements(model, data)
        base, tip = (data.oMf[model.getFrameId(name)] for name in (chain.base, chain.tip))
        poses.append(base.actInv(tip).homogeneous)
    return torch.from_numpy(np.stack(poses))


def rigid_model(case: dc.CalibratedKinematics, truth: Geometry) -> dc.CalibratedKinematics:
    """A model without any deformation, whose points are those of a geometry with the same joint errors or others."""
    deformation = case.map.geodesic
    spec = deformation.spec
    errors = torch.linalg.inv(case.nominal.geometry.joint_errors) @ truth.joint_errors
    turns = torch.from_numpy(Rotation.from_matrix(errors[:, :3, :3].numpy()).as_rotvec())
    theta = torch.zeros(case.nominal.parameters, dtype=torch.float64)
    theta[case.nominal.geometry.slices["joints"]] = torch.cat([errors[:, :3, 3], turns], 1).flatten()
    b, p, _ = (torch.zeros_like(t) for t in deformation.momenta.tensors)
    still = GeodesicDeformation(spec, deformation.x, Momenta(b, p, theta), deformation.integrator)
    fitted = FittedMap(still, case.map.noise, case.map.data, case.map.new_noise)
    return dc.CalibratedKinematics(case.robot, fitted, case.summary, lever=case.lever)


def changed_lines(before: bytes, after: bytes) -> Sequence[tuple[bytes, bytes]]:
    """Lines that differ between two texts with as many lines."""
    old, new = before.split(b"\n"), after.split(b"\n")
    assert len(old) == len(new)
    return [(a, b) for a, b in zip(old, new, strict=True) if a != b]
