"""What solvers minimise: the energy (16) of one formulation as a function of its unknowns.

    E = 1/2 |v_0|_V^2 + 1/2 |w_0|_W^2 + 1/2 theta^T Lambda theta + 1/2 sum_i r_i^T R_i^-1 r_i,   r_i = k1(x_i) - y_i

It is (16) of Orozco & Ratajczak (2025); R_i = sigma^2 I gives their 1 / (2 sigma^2).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import torch
from torch import Tensor

from diffeo_calib.common.errors import NumericalError
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.flows.integrators import Integrator
from diffeo_calib.maps.deformation import Deformation, ModelSpec, Momenta, relative
from diffeo_calib.maps.noise import Noise
from diffeo_calib.regression.cholesky import CholeskyRegression

D = TypeVar("D", bound=Deformation)


@dataclass(frozen=True)
class EnergyParts:
    """The terms of the energy, dimensionless; ``total`` is what a fit minimises."""

    field_x: Tensor
    field_y: Tensor
    prior: Tensor
    data: Tensor

    @property
    def total(self) -> Tensor:
        """E."""
        return self.field_x + self.field_y + self.prior + self.data


class Start(NamedTuple):
    """Where a descent begins.

    Args:
        momenta: there.
        evaluations: runs of the flows that finding it took.
    """

    momenta: Momenta
    evaluations: int = 0


class Objective(ABC, Generic[D]):
    """Measured pairs, kernels, noise, and the equations that make k1 from the unknowns.

    Attributes:
        spec: k0, kernels, prior. x: (N, n). y: (N, m). noise: R.
        controls: (M, n) configurations that carry momenta. reduced: whether these are not the data's.
        new_noise: (m, m) covariance of a new measurement, m^2; None for the mean of those that are fitted.
        certified: whether a minimum of the energy satisfies the end condition (12), up to the time steps.
    """

    spec: ModelSpec
    x: Tensor
    y: Tensor
    noise: Noise
    controls: Tensor
    reduced: bool
    new_noise: Tensor | None
    certified: bool

    @abstractmethod
    def zero(self) -> Momenta:
        """The unknowns of no deformation, k1 = k0."""

    @abstractmethod
    def start(self, integrator: Integrator) -> Start:
        """Where L-BFGS begins: it is hopeless from zero."""

    @abstractmethod
    def deform(self, momenta: Momenta, integrator: Integrator) -> D:
        """Run the flows for these momenta."""

    def calibrated(self, deformation: D) -> FittedMap:
        """A deformation of this problem as the map that users hold."""
        return FittedMap(deformation, self.noise, self.x if self.reduced else None, self.new_noise)

    @abstractmethod
    def preconditioner(self, momenta: Momenta, integrator: Integrator) -> CholeskyRegression:
        """G + R near these momenta, see lbfgs.py."""

    @abstractmethod
    def unknowns(self, momenta: Momenta) -> Momenta:
        """Those of all momenta (b, p, theta) that are free; the others follow from them."""

    def values(self, deformation: D) -> Tensor:
        """k1 at the data: (N, m)."""
        return deformation(self.x) if self.reduced else deformation.z1

    def energy(self, deformation: D) -> EnergyParts:
        """The energy of a deformation of this problem; differentiable once in its momenta."""
        residual = self.values(deformation) - self.y
        return EnergyParts(
            *deformation.field_energies(),
            0.5 * (deformation.momenta.theta**2 / self.spec.prior_variance).sum(),
            0.5 * (residual * self.noise.solve(residual)).sum(),
        )

    def coupling_residual(self, deformation: D) -> float:
        """|b_end - Dk0(xi)^T p| / |b_end|: zero at the optimum, and only there the paper's P0 holds.

        Undefined (NaN) with fewer control points than data, as the paper's momentum lives at the data, and in
        the Eulerian formulation, where the coupling holds by construction and proves nothing.
        """
        return float("nan") if self.reduced else deformation.coupling_residual()

    def end_residual(self, deformation: D) -> float:
        """|p_end - R^-1 (y - z1)| / |p_end|: the end condition (12); NaN with fewer control points than data."""
        if self.reduced:
            return float("nan")
        p_end = deformation.end_momenta.reshape(self.y.shape)
        return relative(p_end - self.noise.solve(self.y - deformation.z1), p_end)


def slope(
    objective: Objective[D], integrator: Integrator, momenta: Momenta, variables: Tensor
) -> tuple[Tensor, Tensor] | None:
    """Energy and its gradient, or nothing where the flows overflow.

    Args:
        objective: whose energy.
        integrator: time stepping.
        momenta: where; made from ``variables`` by operations that autograd has recorded.
        variables: what to differentiate by, any shape.

    Returns:
        the energy (a scalar) and the gradient, shaped like ``variables``, both detached; None if either is not
        finite.
    """
    with torch.enable_grad():
        try:
            total = objective.energy(objective.deform(momenta, integrator)).total
            (gradient,) = torch.autograd.grad(total, variables)
        except (NumericalError, AssertionError):  # the latter from torchdiffeq's adjoint, whose steps underflow
            return None
    total = total.detach()
    return (total, gradient) if bool(torch.isfinite(total)) and bool(torch.isfinite(gradient).all()) else None
