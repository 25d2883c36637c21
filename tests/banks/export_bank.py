"""For tests of exports: an ugly but valid URDF, geometries in general position, poses by pinocchio, rigid models."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from deformation_bank import geometry_of
from robots_bank import FOLDER, draw
from scipy.spatial.transform import Rotation
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.robots import Chain, Geometry

UGLY = (FOLDER / "ugly.urdf").read_bytes().decode()
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
