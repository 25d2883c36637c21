"""Parts of a robot that may have changed since its calibration: hypotheses whose priors are those of the old model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kernels.radial import RadialKernel
from diffeo_calib.kinematics.re_registration.registered_map import robot_map
from diffeo_calib.maps.linearisation import Linearisation

SMALLEST_AMPLITUDE_SHARE = 0.5
"""A small transmission error counts with this share of the largest joint's amplitude: it may have grown."""
OFFSET_DEVIATION_RAD_M = 3e-4
"""Of a joint offset, to which the sizes of changes are relative: they span 0.05 to 5 mrad."""
NEGLIGIBLE_EIGENVALUE_SHARE = 1e-6
"""Eigenvalues of a transmission's covariance below this share of the largest are left out."""


@dataclass(frozen=True, eq=False)
class ChangedPart:
    """A part of a model that may have changed.

    Args:
        name: of the joint, or "gravity" or "geometry".
        joint: the column of the joint whose error or offset it is; None for parameters of the nominal map.
        kernel: that of the joint's error; None for its offset, which all readings lack since then.
        deviations: (K,) prior standard deviations of the parameters, zero of those that it leaves alone.
    """

    name: str
    joint: int | None = None
    kernel: RadialKernel | None = None
    deviations: Tensor | None = None

    @property
    def offset(self) -> bool:
        """Whether it is the offset of a joint."""
        return self.joint is not None and self.kernel is None

    def shapes(self, at: Linearisation) -> Tensor:
        """(M, c) columns whose products are the prior covariance of the joint's errors, rad or m."""
        points = at.joint[0].points
        if self.kernel is None:
            return torch.full_like(points[:, :1], OFFSET_DEVIATION_RAD_M)
        one = points.new_zeros(len(points), 1, points.shape[1])
        one[:, 0, self.joint] = 1.0
        values, vectors = torch.linalg.eigh(self.kernel.gram(points, one, points, one))
        kept = values > NEGLIGIBLE_EIGENVALUE_SHARE * values[-1]
        return vectors[:, kept] * values[kept].sqrt()

    def root(self, at: Linearisation) -> Tensor:
        """(M, m, c) columns whose products are the part's prior covariance at M configurations, m."""
        if self.deviations is not None:
            return (at.sensitivity * self.deviations)[..., self.deviations > 0]
        return at.joint_to_start[:, :, self.joint, None] * self.shapes(at)[:, None]


class Drift(NamedTuple):
    """A part that has changed, and the variance of its change relative to its old variance."""

    part: ChangedPart
    variance: float

    def root(self, at: Linearisation) -> Tensor:
        """(M, m, c) columns whose products are the covariance of the change at M configurations, m."""
        return self.variance**0.5 * self.part.root(at)


def offsets_of(fitted: FittedMap) -> list[ChangedPart]:
    """The offsets of all joints, which are tested beside the parts: the geometry has them, among much else."""
    names = robot_map(fitted).geometry.chain.joint_names
    return [ChangedPart(f"the offset of {name}", joint) for joint, name in enumerate(names)]


def parts_of(fitted: FittedMap) -> list[ChangedPart]:
    """The parts of a robot's map: every joint with a transmission term, gravity, geometry."""
    spec, nominal = fitted.geodesic.spec, robot_map(fitted)
    names = nominal.geometry.chain.joint_names
    own = {t.output: t for t in spec.joint_kernel.terms if isinstance(t, RadialKernel) and t.output is not None}
    least = SMALLEST_AMPLITUDE_SHARE**2 * max((float(term.variance) for term in own.values()), default=0.0)
    found: list[ChangedPart] = []
    for joint, term in own.items() if least > 0 else ():
        kernel = RadialKernel.from_config(term.to_config() | {"variance": max(float(term.variance), least)})
        found.append(ChangedPart(names[joint], joint, kernel))
    for name, columns in (("gravity", nominal.sag), ("geometry", nominal.geometry.slices["joints"])):
        deviations = torch.zeros_like(spec.prior_variance)
        deviations[columns] = spec.prior_variance[columns].sqrt()
        found += [ChangedPart(name, deviations=deviations)] if bool(deviations.any()) else []
    return found
