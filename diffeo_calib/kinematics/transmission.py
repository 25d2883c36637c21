"""Transmission errors of single joints: of kernel terms that act on one joint alone, its axis, and gear lines."""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, hypot
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor
from diffeo_calib.common.data_frames import is_data_frame, named_columns
from diffeo_calib.common.errors import InputError, as_written
from diffeo_calib.kernels.radial import RadialKernel
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.maps.deformation import Deformation
from diffeo_calib.robots.tree import Tree


def transmission(deformation: Deformation, robot: Tree, joint: str, values: object, *, lines: bool = True) -> Tensor:
    """Motion of a joint beyond its reading, see :meth:`CalibratedKinematics.transmission`: (M,) -> (M,) rad or m.

    Without gear ``lines`` for pictures whose points lie too far apart for them.
    """
    x, index = _configurations(robot, joint, values)
    terms, momenta, nominal = deformation.spec.joint_kernel.terms, deformation.momenta, deformation.spec.nominal
    of_joint = [t for t in terms if isinstance(t, RadialKernel) and t.columns == (index,) and t.output == index]
    error = sum((t.field(x, deformation.x, momenta.joint)[:, index] for t in of_joint), torch.zeros_like(x[:, index]))
    if not isinstance(nominal, GeometryMap):
        return error
    error = error + nominal.along_axis(x, index) @ momenta.theta
    return error + (nominal.turned(x, momenta.theta) - x)[:, index] if lines else error


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


SAME_RATIO = 0.5  # difference of two frequencies, rad per rad, up to which one counts as a multiple of the other
MULTIPLES = (2, 3, 4)  # waves per turn of the motor that are named


@dataclass(frozen=True)
class NamedGearLine:
    """amplitude cos(frequency q - phase) of one joint.

    Args:
        joint: its name.
        frequency: rad per rad of the joint: periods per turn; the ratio of a gear or a multiple of it.
        amplitude: rad. phase: rad.
        multiple: how often the frequency contains that of another line of the robot; 1 if there is none.
        displacement: RMS displacement of the markers by it over the model's configurations, m.
    """

    joint: str
    frequency: float
    amplitude: float
    phase: float
    multiple: int
    displacement: float

    @property
    def sentence(self) -> str:
        """Such as "joint_3: gear line 200.3 per rad = 2 x 100.15, 0.070 mrad"."""
        ratio = f" = {self.multiple} x {self.frequency / self.multiple:.2f}" if self.multiple > 1 else ""
        return f"{self.joint}: gear line {self.frequency:.1f} per rad{ratio}, {1e3 * self.amplitude:.3f} mrad"


def gear_lines(model: Any) -> tuple[NamedGearLine, ...]:
    """The gear lines of a model, the largest displacement first; empty where no line was found."""
    nominal, theta = model.nominal, model.map.deformation.momenta.theta
    waves, part = nominal.own.waves, nominal.parts["waves"]
    if not waves:
        return ()
    sensitivities, coefficients = nominal.sensitivities(model.configurations, theta)[..., part], theta[part].view(-1, 2)
    effects = (sensitivities * coefficients.flatten()).unflatten(-1, (-1, 2)).sum(-1)  # (N, 3 P, K)
    moved = effects.unflatten(1, (-1, 3)).square().sum(2).mean((0, 1)).sqrt().tolist()
    lines = []
    for k, (joint, frequency) in enumerate(waves):
        C, S = coefficients[k].tolist()
        others = [m for m in MULTIPLES if any(abs(frequency / m - other) <= SAME_RATIO for _, other in waves)]
        what = model.robot.joint_names[joint], frequency, hypot(C, S), atan2(S, C), [*others, 1][0]
        lines.append(NamedGearLine(*what, moved[k]))
    return tuple(sorted(lines, key=lambda line: -line.displacement))
