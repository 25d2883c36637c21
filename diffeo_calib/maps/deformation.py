"""Deformations of a nominal map in any formulation: unknowns, fixed parts, and the interface that fits use."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from diffeo_calib.common.checks import LARGEST
from diffeo_calib.common.errors import NumericalError, sentence
from diffeo_calib.flows.integrators import Integrator
from diffeo_calib.kernels.base import Kernel
from diffeo_calib.kernels.reductions.backends import Backend
from diffeo_calib.maps.nominal import NominalMap


@dataclass(frozen=True)
class Momenta:
    """The unknowns of a fit."""

    joint: Tensor  # (N, n) initial momenta b of the joint-space geodesic
    task: Tensor  # (N P, d) initial momenta p of the task-space geodesic, the paper's P0
    theta: Tensor  # (K,) parameters of the nominal map, K may be 0

    def towards(self, other: Momenta, step: float) -> Momenta:
        """The point ``self + step (other - self)``."""
        return Momenta(*(torch.lerp(a, b, step) for a, b in zip(self.tensors, other.tensors, strict=True)))

    @property
    def tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        """(joint, task, theta): b, p and theta."""
        return self.joint, self.task, self.theta

    def flatten(self) -> Tensor:
        """The unknowns as one vector."""
        return torch.cat([t.flatten() for t in self.tensors])

    def to(self, device: torch.device | str) -> Momenta:
        """Return the momenta on a device."""
        return Momenta(*(t.to(device) for t in self.tensors))

    def unflatten(self, vector: Tensor) -> Momenta:
        """The inverse of :meth:`flatten`, shaped like this object."""
        parts = torch.split(vector, [t.numel() for t in self.tensors])
        return Momenta(*(part.view_as(t) for part, t in zip(parts, self.tensors, strict=True)))


@dataclass(frozen=True)
class ModelSpec:
    """The fixed part of a model, whatever the momenta: k0, the two kernels and the prior of theta."""

    nominal: NominalMap  # k0
    joint_kernel: Kernel  # K_V on joint space
    task_kernel: Kernel  # K_W on task space R^d
    prior_variance: Tensor  # (K,) variances of theta
    task_dim: int  # d; markers are consecutive groups of d values of k0
    # k0 at the control configurations, one for one, if it is another one there: the markers of a robot that was
    # measured in several set-ups
    at_controls: NominalMap | None = None

    @property
    def nominal_of_controls(self) -> NominalMap:
        """k0 at the control configurations."""
        return self.nominal if self.at_controls is None else self.at_controls

    def using(self, backend: Backend, accuracy: float | None = None) -> ModelSpec:
        """Return the model with its kernel sums evaluated by this backend; ``accuracy`` as :meth:`Kernel.using`."""
        joint, task = (kernel.using(backend, accuracy) for kernel in (self.joint_kernel, self.task_kernel))
        return replace(self, joint_kernel=joint, task_kernel=task)

    def to(self, device: torch.device | str) -> ModelSpec:
        """Return the model on a device. Nominal maps move their own constants to the device of their input."""
        joint, task = self.joint_kernel.to(device), self.task_kernel.to(device)
        return replace(self, joint_kernel=joint, task_kernel=task, prior_variance=self.prior_variance.to(device))


class Deformation(ABC):
    """k1 for given unknowns, in any formulation."""

    formulation: ClassVar[str]  # "exact" or "eulerian"
    spec: ModelSpec  # nominal map, kernels, prior
    x: Tensor  # (N, n) control configurations
    momenta: Momenta  # the unknowns
    integrator: Integrator  # time stepping
    z1: Tensor  # (N, m) k1(x)

    @abstractmethod
    def __call__(self, x: Tensor) -> Tensor:
        """k1(x): (M, n) -> (M, m), differentiable by autograd in x."""

    @abstractmethod
    def jacobian(self, x: Tensor) -> Tensor:
        """Dk1(x) as this formulation computes it: (M, m, n)."""

    def at_controls(self, x: Tensor) -> Tensor | None:
        """k1(x) (N, m) from the fit, if x are its control configurations and k0 is the same there as elsewhere."""
        return None

    @abstractmethod
    def field_energies(self) -> tuple[Tensor, Tensor]:
        """1/2 |v|_V^2 and 1/2 |w|_W^2 at time 0, the first two terms of (16); differentiable in the momenta."""

    @property
    @abstractmethod
    def task_controls(self) -> Tensor:
        """Marker points of the controls at time 0, which carry the task momenta: (N P, d)."""

    @property
    @abstractmethod
    def end_momenta(self) -> Tensor:
        """P at time 1, which the end condition (12) constrains: (N P, d)."""

    @abstractmethod
    def coupling_residual(self) -> float:
        """Relative violation of L_V v = -Dk^T P by the momenta of the two flows; NaN where it holds by construction."""

    @abstractmethod
    def energy_drift(self) -> float:
        """Relative drift of the fields' energy along the flows, which the exact equations conserve."""

    @property
    def backends(self) -> tuple[str, str]:
        """Backends of the kernel sums between the control points: in joint space, in task space."""
        return backend_names(self.spec.joint_kernel, self.x), backend_names(self.spec.task_kernel, self.momenta.task)

    @abstractmethod
    def to(self, device: torch.device | str) -> Deformation:
        """Return the deformation on a device."""


def backend_names(kernel: Kernel, points: Tensor) -> str:
    """Backends of a kernel's sums between these points (N, n)."""
    return "+".join(sorted(kernel.backends(len(points), points.device)))


def finite(points: Tensor, what: str) -> Tensor:
    """Return ``points``, the end of a flow.

    Raises:
        NumericalError: some are not finite, or too large to compute with; ``what`` names the flow.
    """
    if not bool((points.detach().abs() <= LARGEST).all()):
        what = f"{what}: the momenta are too large for its time steps"
        raise NumericalError.of(what, fix="start nearer (from zero or Gauss-Newton), or use more time steps")
    return points


def relative(difference: Tensor, reference: Tensor) -> float:
    """|difference| / |reference|, Frobenius norms; |difference| where the reference is zero."""
    size = float(torch.linalg.norm(reference))
    return float(torch.linalg.norm(difference)) / size if size > 0 else float(torch.linalg.norm(difference))


INVERSE_ITERATIONS = 50
LONGEST_JOINT_STEP = 0.5  # longest step of a joint in the search for an inverse, rad or m
SETTLED_JOINT_STEP = 1e-12  # the search for an inverse has settled when no joint moves by more than this, rad or m
MAX_INVERSE_RESIDUAL = 1e-9  # largest distance from a target, m, at which it counts as reached


def inverse_of(deformation: Deformation, target: Tensor, x: Tensor) -> Tensor:
    """Configurations x with k1(x) = target: compensation of a commanded target.

    Gauss-Newton with the exact Jacobian and steps of minimal norm. With more joints than coordinates the result is the
    solution nearest to the start to first order; with more coordinates than joints (several markers) it is the
    least-squares solution. Joint limits are not enforced: for the commands of a robot use ``dc.compensate``.

    Args:
        deformation: k1. target: (M, m) in m. x: (M, n) where the search starts.

    Returns:
        (M, n).

    Raises:
        NumericalError: some target is out of reach from its start, or the search did not settle.
    """
    residual = target
    for _ in range(INVERSE_ITERATIONS):
        residual = target - deformation(x)
        step = (torch.linalg.pinv(deformation.jacobian(x), rtol=1e-8) @ residual[:, :, None])[:, :, 0]
        if not bool((step.abs() > SETTLED_JOINT_STEP).any()):
            break
        x = x + step * (LONGEST_JOINT_STEP / step.abs().amax(1, keepdim=True).clamp(min=LONGEST_JOINT_STEP))
    else:
        raise NumericalError(_unreachable(residual, f"the search has not settled after {INVERSE_ITERATIONS} steps"))
    if target.shape[1] <= x.shape[1] and bool((residual.abs() > MAX_INVERSE_RESIDUAL).any()):
        raise NumericalError(_unreachable(residual, "the nearest configuration does not reach it"))
    return x


def _unreachable(residual: Tensor, what: str) -> str:
    """Message naming the target with the largest residual."""
    miss = residual.norm(dim=1)
    row = int(miss.argmax())
    return sentence(
        f"no configuration was found for target {row}: {what}",
        got=f"a distance of {float(miss[row]):.2e} m",
        fix="start nearer to the target, which may be out of reach or near a singularity",
    )
