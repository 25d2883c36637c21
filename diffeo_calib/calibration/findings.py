"""How much each part of a calibrated model explains."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffeo_calib.kernels.radial import RadialKernel
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.kinematics.transmission import gear_lines

MOST_CONFIGURATIONS = 8000
"""Configurations on which the parts of a model are measured."""


@dataclass(frozen=True)
class Part:
    """One part of the model and its effect.

    Args:
        name: such as "geometry", "transmission of joint_2", "gravity on joints".
        displacement: RMS displacement of the markers by this part over the measured configurations, m.
        angle: RMS error of the joint for the transmission of a joint, rad (m for a slide); None for other parts.
    """

    name: str
    displacement: float
    angle: float | None = None


def parts(model: CalibratedKinematics) -> list[Part]:
    """How much each part of a model explains, to first order in the deformations; parts may cancel each other.

    Of many configurations a part is looked at, evenly spread over the table.

    The mean of a joint's transmission error over the configurations is equivalent to a joint offset and counts as
    geometry.
    """
    deformation = model.map.deformation
    by_row = deformation.spec.at_controls
    nominal = by_row if isinstance(by_row, GeometryMap) else model.nominal  # each row has its own payload
    x, theta = model.configurations, deformation.momenta.theta
    rows = torch.arange(0, len(x), -(-len(x) // MOST_CONFIGURATIONS), device=x.device)
    nominal, x = nominal.rows(rows), x[rows]
    errors, _ = nominal.split(theta)
    jacobian = nominal.jacobian(x, theta)
    joints, offsets = _joint_parts(model, x, jacobian)
    registered, refined = nominal.geometry.points(x), nominal.geometry.points(x, errors)
    found = [Part("geometry", _rms((refined - registered).flatten(1) + jacobian @ offsets))]
    effects = nominal.sensitivities(x, theta) * theta
    if nominal.elasticity is not None:
        sag = effects[..., nominal.sag]
        found += [Part(name, _rms(sag[..., own].sum(-1))) for name, own in nominal.elasticity.parts.items()]
    crooked = effects[..., nominal.parts["axes"]].split([6 * count for *_, count in nominal.own.axes], -1)
    for (axis, *_), moved in zip(nominal.own.axes, crooked, strict=False):
        found.append(Part(f"the axis of {model.robot.moving_names[axis]}", _rms(moved.sum(-1))))
    joints += [Part(f"gear line {line.frequency:.1f} of {line.joint}", line.displacement) for line in gear_lines(model)]
    points = deformation.spec.nominal(x, theta).reshape(-1, deformation.spec.task_dim)
    bent = deformation.spec.task_kernel.field(points, deformation.task_controls, deformation.momenta.task)
    return [*found, *joints, Part("task space", _rms(bent))]


def _joint_parts(model: CalibratedKinematics, x: Tensor, jacobian: Tensor) -> tuple[list[Part], Tensor]:
    """Transmission of every joint, then the coupled joint errors; and the transmissions' means (n,)."""
    deformation = model.map.deformation
    found, coupled, means = [], torch.zeros_like(jacobian[..., 0]), torch.zeros_like(x[0])
    for term in deformation.spec.joint_kernel.terms:
        v = term.field(x, deformation.x, deformation.momenta.joint)
        if isinstance(term, RadialKernel) and term.output is not None:
            means = means + v.mean(0)
            varying = v - v.mean(0)
            angle = float(varying[:, term.output].square().mean().sqrt())
            moved = _rms((jacobian @ varying[:, :, None])[..., 0])
            found.append(Part(f"transmission of {model.robot.joint_names[term.output]}", moved, angle))
        else:
            coupled = coupled + (jacobian @ v[:, :, None])[..., 0]
    return [*found, Part("coupled joint errors", _rms(coupled))], means


def _rms(displacements: Tensor) -> float:
    """Root mean square length of displacements, coordinates in triples, m."""
    return float(displacements.reshape(-1, 3).square().sum(-1).mean().sqrt())
