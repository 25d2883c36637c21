"""The objective of solvers: the energy (16) of one formulation as a function of its unknowns.

    E = 1/2 |v_0|_V^2 + 1/2 |w_0|_W^2 + 1/2 theta^T Lambda theta + 1/2 sum_i r_i^T R_i^-1 r_i,   r_i = k1(x_i) - y_i

This is (16) of Orozco & Ratajczak (2025), where R_i = sigma^2 I gives the weight 1 / (2 sigma^2).

The tangent model: calibration as Gaussian-process regression.

To first order k1 = k0 + Dk0 K_V b + K_W p + S theta: a Gaussian process with the prior covariance

    G(x, x') = Dk0(x) K_V(x, x') Dk0(x')^T + K_W(k0(x), k0(x')) + S(x) Lambda^-1 S(x')^T

Conditioned on the data it gives the momenta, the marginal likelihood and exact leave-one-out errors. The
same linear algebra around a deformation instead of zero is one Gauss-Newton step.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from math import nan
from typing import Generic, NamedTuple, TypeVar

import torch
from torch import Tensor

from diffeo_calib.common.errors import NumericalError
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.flows.integrators import RK4, Integrator
from diffeo_calib.maps.deformation import Deformation, ModelSpec, Momenta, relative
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.maps.noise import Noise
from diffeo_calib.maps.observation import Observation
from diffeo_calib.regression.cholesky import CholeskyRegression
from diffeo_calib.regression.choose import LinearSolver, condition, condition_controls
from diffeo_calib.regression.conditional import DataConditional
from diffeo_calib.regression.conjugate_gradients import CG_TOLERANCE

D = TypeVar("D", bound=Deformation)


@dataclass(frozen=True)
class EnergyParts:
    """The terms of the energy, dimensionless; fits minimise ``total``."""

    field_x: Tensor
    field_y: Tensor
    prior: Tensor
    data: Tensor

    @property
    def total(self) -> Tensor:
        """E."""
        return self.field_x + self.field_y + self.prior + self.data


class Objective(ABC, Generic[D]):
    """Measured pairs, kernels and noise, with the equations of one formulation that give k1 from the unknowns.

    Attributes:
        spec: k0, kernels, prior. x: (N, n). y: (N, m), or (N, r) with ``observe``. noise: R.
        controls: (M, n) configurations that carry momenta. reduced: whether they differ from the data's.
        new_noise: (m, m) covariance of a new measurement, m^2; None for the mean of ``noise``.
        observe: what was measured of k1; None for all its coordinates.
        whole: the problem whose maps the fit leads to, by default its own; see :meth:`Problem.standing_for`.
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
    observe: Observation | None = None
    whole: Objective[D] | None = None

    @abstractmethod
    def zero(self) -> Momenta:
        """The unknowns of no deformation, k1 = k0."""

    @abstractmethod
    def start(self, integrator: Integrator) -> tuple[Momenta, int]:
        """The default start of L-BFGS, near the tangent solution: it makes no progress from zero.

        Returns:
            its momenta; runs of the flows that were needed to find them.
        """

    @abstractmethod
    def deform(self, momenta: Momenta, integrator: Integrator) -> D:
        """Run the flows for these momenta."""

    def calibrated(self, deformation: D) -> FittedMap:
        """A deformation of this problem as the map that users work with."""
        if self.whole is not None:
            return self.whole.calibrated(self.whole.deform(deformation.momenta, deformation.integrator))
        slopes = self.slopes(deformation)
        data = self.x if self.reduced else None
        return FittedMap(deformation, self.noise, data, self.new_noise, slopes=slopes, y=self.y)

    @abstractmethod
    def preconditioner(self, momenta: Momenta, integrator: Integrator) -> CholeskyRegression:
        """G + R near these momenta; see lbfgs.py."""

    @abstractmethod
    def unknowns(self, momenta: Momenta) -> Momenta:
        """The free ones of all momenta (b, p, theta); the rest is implied by them, and empty."""

    def coordinates(self, deformation: D) -> Tensor:
        """k1 at the data: (N, m)."""
        return deformation(self.x) if self.reduced else deformation.z1

    def values(self, deformation: D) -> Tensor:
        """Predicted measurements: k1 (N, m), or h(k1) (N, r)."""
        points = self.coordinates(deformation)
        return points if self.observe is None else self.observe.value(points)

    def residual(self, rows: Tensor, points: Tensor) -> Tensor:
        """Measured minus predicted, (M, m) or (M, r), at the rows with these numbers, from k1 there, (M, m)."""
        predicted = points if self.observe is None else self.observe.rows(rows).value(points)
        return self.y[rows] - predicted

    def slopes(self, deformation: D) -> Tensor | None:
        """A = Dh at k1 of the data: (N, r, m); None if all coordinates were measured."""
        return None if self.observe is None else self.observe.slope(self.coordinates(deformation)).detach()

    def energy(self, deformation: D, values: Tensor | None = None) -> EnergyParts:
        """The energy of a deformation of this problem; differentiable once in its momenta.

        Args:
            deformation: of this problem. values: :meth:`values` of it, if they are known.
        """
        residual = (self.values(deformation) if values is None else values) - self.y
        return EnergyParts(
            *deformation.field_energies(),
            0.5 * (deformation.momenta.theta**2 / self.spec.prior_variance).sum(),
            0.5 * (residual * self.noise.solve(residual)).sum(),
        )

    def coupling_residual(self, deformation: D) -> float:
        """|b_end - Dk0(xi)^T p| / |b_end|, zero at the optimum.

        NaN with fewer control points than data, since the paper's momentum lives at the data, and in the Eulerian
        formulation, in which the coupling holds by construction.
        """
        return float("nan") if self.reduced else deformation.coupling_residual()

    def end_residual(self, deformation: D) -> float:
        """|p_end - A^T R^-1 (y - h(z1))| / |p_end|: the end condition (12); NaN with fewer control points than data.

        Without ``observe`` h is the identity.
        """
        if self.reduced:
            return float("nan")
        p_end = deformation.end_momenta.reshape(deformation.z1.shape)
        pull, slopes = self.noise.solve(self.y - self.values(deformation)), self.slopes(deformation)
        pull = pull if slopes is None else (slopes.mT @ pull[:, :, None])[:, :, 0]
        return relative(p_end - pull, p_end)


def slope(
    objective: Objective[D], integrator: Integrator, momenta: Momenta, variables: Tensor
) -> tuple[Tensor, Tensor] | None:
    """Energy and its gradient by ``variables``, of which the momenta are made; None where they are not finite."""
    with torch.enable_grad():
        try:
            total = objective.energy(objective.deform(momenta, integrator)).total
            (gradient,) = torch.autograd.grad(total, variables)
        except (NumericalError, AssertionError):  # the latter if steps of torchdiffeq's adjoint underflow
            return None
    total = total.detach()
    return (total, gradient) if bool(torch.isfinite(total)) and bool(torch.isfinite(gradient).all()) else None


class Regression(NamedTuple):
    """A linearisation conditioned on its data; ``target`` (N, m) is measured minus linearised at zero fields, m."""

    conditional: DataConditional
    target: Tensor

    def momenta(self) -> Momenta:
        """Posterior mode of b, p, theta."""
        return self.conditional.momenta(self.target)


def regress(
    problem: Objective[GeodesicDeformation],
    deformation: GeodesicDeformation,
    linear: LinearSolver = "auto",
    tolerance: float = CG_TOLERANCE,
) -> Regression:
    """Linearise a problem around a deformation of it and condition it on its data, which are its control points.

    Args:
        linear: "cholesky" of G + R, conjugate gradients "cg", or "auto" by size.
        tolerance: of conjugate gradients, relative residual.

    Raises:
        InputError: the method needs more memory than is free.
        NumericalError: G + R is not positive definite in float64.
    """
    slopes = problem.slopes(deformation)
    lin = deformation.linearise()
    response = deformation.linear_response(lin)
    if slopes is not None:
        lin, response = lin.projected(slopes), (slopes @ response[:, :, None])[:, :, 0]
    target = problem.y - problem.values(deformation) + response
    return Regression(condition(lin, problem.noise, linear, tolerance), target)


def linear_optimum(
    problem: Objective[GeodesicDeformation],
    deformation: GeodesicDeformation,
    linear: LinearSolver = "auto",
    tolerance: float = CG_TOLERANCE,
) -> tuple[Momenta, float]:
    """The momenta that minimise the energy of a problem linearised around a deformation; arguments as of `regress`.

    Problems with fewer control points than data are solved by their normal equations.

    Returns:
        the momenta; how far the energy of the linearised problem falls to them, NaN if the data are the controls.
    """
    if not problem.reduced:
        return regress(problem, deformation, linear, tolerance).momenta(), nan
    slopes = problem.slopes(deformation)
    return condition_controls(deformation, problem.x, problem.noise, slopes, problem.residual).mode()


def tangent(problem: Objective[GeodesicDeformation], linear: LinearSolver = "auto") -> Regression:
    """The tangent model at zero deformation."""
    return regress(problem, problem.deform(problem.zero(), RK4(1)), linear)
