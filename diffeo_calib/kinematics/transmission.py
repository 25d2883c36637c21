"""Transmission errors of single joints, read off the kernel terms that act on one joint alone, and gear lines."""

from __future__ import annotations

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor
from diffeo_calib.common.data_frames import is_data_frame, named_columns
from diffeo_calib.common.errors import InputError, as_written
from diffeo_calib.kernels.radial import RadialKernel
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.maps.deformation import Deformation
from diffeo_calib.robots.tree import Tree


def transmission(deformation: Deformation, robot: Tree, joint: str, values: object) -> Tensor:
    """Motion of a joint beyond its reading, see :meth:`CalibratedKinematics.transmission`: (M,) -> (M,) rad or m."""
    x, index = _configurations(robot, joint, values)
    nominal, smooth = deformation.spec.nominal, smooth_transmission(deformation, robot, joint, values)
    if not isinstance(nominal, GeometryMap) or not nominal.waves.size:
        return smooth
    turned = nominal.waves.turned(x, nominal.wave_coefficients(deformation.momenta.theta))
    return smooth + (turned - x)[:, index]


def smooth_transmission(deformation: Deformation, robot: Tree, joint: str, values: object) -> Tensor:
    """The same without gear lines, for pictures whose points lie too far apart for them."""
    x, index = _configurations(robot, joint, values)
    terms = deformation.spec.joint_kernel.terms
    own = [t for t in terms if isinstance(t, RadialKernel) and t.columns == (index,) and t.output == index]
    fields = (term.field(x, deformation.x, deformation.momenta.joint)[:, index] for term in own)
    return sum(fields, torch.zeros_like(x[:, index]))


def _configurations(robot: Tree, joint: str, values: object) -> tuple[Tensor, int]:
    """Configurations (M, n) with these values of one joint, the others at zero, and the number of the joint."""
    if not isinstance(joint, str) or joint not in robot.joint_names:
        raise InputError.of("`joint`", expected=", ".join(robot.joint_names), got=as_written(joint))
    index = robot.joint_names.index(joint)
    values = named_columns(values, [joint], "values")[:, 0] if is_data_frame(values) else values
    at = as_tensor(values, "values", ("M",), empty=True)
    x = torch.zeros(len(at), robot.n, dtype=at.dtype, device=at.device)
    x[:, index] = at
    return x, index
