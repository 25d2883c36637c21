"""Parts of a robot that may have changed: transmissions and offsets of joints, gravity, geometry."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffeo_calib.calibration.recalibration.new_rows import NewRows
from diffeo_calib.kernels.radial import RadialKernel
from diffeo_calib.maps.linearisation import Linearisation

SMALLEST_AMPLITUDE_SHARE = 0.5
"""A small transmission error counts with this share of the largest joint's amplitude: it may have grown."""
OFFSET_DEVIATION_RAD_M = 3e-4
"""Of a joint offset, to which the sizes of changes are relative: they span 0.05 to 5 mrad."""
NEGLIGIBLE_EIGENVALUE_SHARE = 1e-6
"""Eigenvalues of a transmission's covariance below this share of the largest are left out."""


@dataclass(frozen=True, eq=False)
class ChangedPart:
    """A part of a model that may have changed: a hypothesis whose prior is that of the part in the old model.

    Args:
        name: of the joint, or "gravity" or "geometry".
        joint: the column of the joint whose error or offset it is; None for parameters of the nominal map.
        kernel: that of the joint's error; None for its offset, which all readings lack since then.
        columns: (k,) numbers of the parameters. deviations: (k,) their prior standard deviations.
    """

    name: str
    joint: int | None = None
    kernel: RadialKernel | None = None
    columns: Tensor | None = None
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
        if self.joint is None:
            return at.sensitivity[..., self.columns] * self.deviations
        return at.joint_to_start[:, :, self.joint, None] * self.shapes(at)[:, None]


def offsets_of(rows: NewRows) -> list[ChangedPart]:
    """The offsets of all joints, which are tested beside the parts: the geometry has them, among much else."""
    chain = rows.points.fitted.geometry.chain
    return [ChangedPart(f"the offset of {name}", joint) for joint, name in enumerate(chain.joint_names)]


def parts_of(rows: NewRows) -> list[ChangedPart]:
    """The parts of the model: every joint with a transmission term, gravity, geometry."""
    spec, nominal = rows.fitted.geodesic.spec, rows.points.fitted
    chain, prior = nominal.geometry.chain, spec.prior_variance
    own = {t.output: t for t in spec.joint_kernel.terms if isinstance(t, RadialKernel) and t.output is not None}
    least = SMALLEST_AMPLITUDE_SHARE**2 * max((float(term.variance) for term in own.values()), default=0.0)
    found: list[ChangedPart] = []
    for joint, term in own.items() if least > 0 else ():
        kernel = RadialKernel.from_config(term.to_config() | {"variance": max(float(term.variance), least)})
        found.append(ChangedPart(chain.joint_names[joint], joint, kernel))
    every = torch.arange(len(prior), device=prior.device)
    groups = {"gravity": every[nominal.sag], "geometry": every[nominal.geometry.slices["joints"]]}
    for name, columns in groups.items():
        supported = columns[prior[columns] > 0]
        if len(supported):
            found.append(ChangedPart(name, columns=supported, deviations=prior[supported].sqrt()))
    return found
