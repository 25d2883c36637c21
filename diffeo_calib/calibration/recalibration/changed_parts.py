"""Parts of a robot that may have changed: transmissions and offsets of joints, gravity, geometry."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from diffeo_calib.calibration.recalibration.new_rows import NewRows
from diffeo_calib.kernels.radial import RadialKernel
from diffeo_calib.maps.linearisation import Linearisation

SMALLEST_AMPLITUDE_SHARE = 0.5
"""A small transmission error counts with this share of the largest joint's amplitude: it may have grown."""
OFFSET_DEVIATION_RAD_M = 3e-4
"""Of a joint offset, to which the sizes above are relative: they span 0.05 to 5 mrad."""
NEGLIGIBLE_EIGENVALUE_SHARE = 1e-6
"""Eigenvalues of a transmission's covariance below this share of the largest are left out."""


@dataclass(frozen=True, eq=False)
class ChangedPart(ABC):
    """A part of a model that may have changed.

    Args:
        name: of the joint, or "gravity" or "geometry".
    """

    name: str

    @abstractmethod
    def root(self, at: Linearisation) -> Tensor:
        """(M, m, c) columns whose products are the part's prior covariance at M configurations, m."""

    @abstractmethod
    def size(self, at: Linearisation, whole: Linearisation, mu: Tensor) -> float:
        """RMS of the part over M configurations, in its own unit, prior variances as old.

        Args:
            at: what was measured. whole: the coordinates of the markers. mu: (M, m) end momenta.
        """

    def displacement(self, at: Linearisation, whole: Linearisation, mu: Tensor) -> float:
        """RMS displacement of the markers by it, m; arguments as :meth:`size`."""
        moved = self.root(whole) @ torch.einsum("imc,im->c", self.root(at), mu)
        return float(moved.unflatten(1, (-1, 3)).square().sum(-1).mean().sqrt())


@dataclass(frozen=True, eq=False)
class Transmission(ChangedPart):
    """The transmission error of one joint.

    Args:
        joint: its column. kernel: its kernel term.
    """

    joint: int
    kernel: RadialKernel

    def root(self, at: Linearisation) -> Tensor:
        """See :class:`ChangedPart`."""
        values, vectors = torch.linalg.eigh(self._covariance(at))
        kept = values > NEGLIGIBLE_EIGENVALUE_SHARE * values[-1]
        shapes = vectors[:, kept] * values[kept].sqrt()  # (M, c)
        return at.joint_to_start[:, :, self.joint, None] * shapes[:, None]

    def size(self, at: Linearisation, whole: Linearisation, mu: Tensor) -> float:
        """In rad or m."""
        turned = (at.joint_to_start[:, :, self.joint] * mu).sum(1)
        return float((self._covariance(at) @ turned).square().mean().sqrt())

    def _covariance(self, at: Linearisation) -> Tensor:
        """(M, M) of the joint's error, rad^2 or m^2."""
        points = at.joint[0].points
        one = points.new_zeros(len(points), 1, points.shape[1])
        one[:, 0, self.joint] = 1.0
        return self.kernel.gram(points, one, points, one)


@dataclass(frozen=True, eq=False)
class Parameters(ChangedPart):
    """A group of the nominal map's parameters.

    Args:
        columns: (k,) their numbers. variances: (k,) their prior variances.
    """

    columns: Tensor
    variances: Tensor

    def root(self, at: Linearisation) -> Tensor:
        """See :class:`ChangedPart`."""
        return at.sensitivity[..., self.columns] * self.variances.sqrt()

    def size(self, at: Linearisation, whole: Linearisation, mu: Tensor) -> float:
        """In m, of the markers."""
        return self.displacement(at, whole, mu)


@dataclass(frozen=True, eq=False)
class Offset(ChangedPart):
    """The offset of one joint, which all its readings lack since then: a new zero, a slipped gear.

    Args:
        joint: its column.
    """

    joint: int

    def root(self, at: Linearisation) -> Tensor:
        """See :class:`ChangedPart`."""
        return OFFSET_DEVIATION_RAD_M * at.joint_to_start[:, :, self.joint, None]

    def size(self, at: Linearisation, whole: Linearisation, mu: Tensor) -> float:
        """In rad or m, with its sign."""
        return OFFSET_DEVIATION_RAD_M * float(torch.einsum("imc,im->c", self.root(at), mu))


def offsets_of(rows: NewRows) -> list[Offset]:
    """The offsets of all joints, which are tested beside the parts: the geometry has them, among much else."""
    chain = rows.points.fitted.geometry.chain
    return [Offset(f"the offset of {name}", joint) for joint, name in enumerate(chain.joint_names)]


def parts_of(rows: NewRows) -> list[ChangedPart]:
    """The parts of the model: every joint with a transmission term, gravity, geometry."""
    spec, nominal = rows.fitted.geodesic.spec, rows.points.fitted
    chain, prior = nominal.geometry.chain, spec.prior_variance
    own = {t.output: t for t in spec.joint_kernel.terms if isinstance(t, RadialKernel) and t.output is not None}
    least = SMALLEST_AMPLITUDE_SHARE**2 * max((float(term.variance) for term in own.values()), default=0.0)
    found: list[ChangedPart] = []
    for joint, term in own.items() if least > 0 else ():
        kernel = RadialKernel.from_config(term.to_config() | {"variance": max(float(term.variance), least)})
        found.append(Transmission(chain.joint_names[joint], joint, kernel))
    every = torch.arange(len(prior), device=prior.device)
    groups = {"gravity": every[nominal.sag], "geometry": every[nominal.geometry.slices["joints"]]}
    for name, columns in groups.items():
        supported = columns[prior[columns] > 0]
        if len(supported):
            found.append(Parameters(name, supported, prior[supported]))
    return found
