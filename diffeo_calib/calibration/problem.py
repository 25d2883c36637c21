"""The fitting problem: measured pairs, kernels, noise, and the energy (16) of the exact model.

    E(b, p, theta) = 1/2 b^T K_V b + 1/2 p^T K_W p + 1/2 theta^T Lambda theta + 1/2 sum_i r_i^T R_i^-1 r_i

with r_i = k1(x_i) - y_i. It is (16) of Orozco & Ratajczak (2025) with initial momenta as unknowns;
R_i = sigma^2 I gives their 1 / (2 sigma^2).
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass

import torch
from torch import Tensor

from diffeo_calib.checks import as_tensor, check_finite, positive
from diffeo_calib.deformation import Deformation, ModelSpec, Momenta
from diffeo_calib.errors import InputError, sentence
from diffeo_calib.flows.hamiltonian import energy
from diffeo_calib.flows.integrate import Integrator
from diffeo_calib.kernels import Kernel
from diffeo_calib.noise import Noise
from diffeo_calib.nominal import NominalMap, as_nominal
from diffeo_calib.reductions.door import Backend

SMALLEST_NOISE = 1e-100
"""Standard deviation in m whose square is still a number."""


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


class Problem:
    """Measured pairs (x_i, y_i) and everything that a solver needs to fit them.

    Args:
        nominal: k0, a torch function (N, n) -> (N, m) or a :class:`NominalMap`.
        x: (N, n) joint configurations, rad or m.
        y: (N, m) measured task coordinates, m = d * markers, in m.
        joint_kernel: K_V on the n joints. task_kernel: K_W on R^d.
        noise: standard deviation sigma in m (R = sigma^2 I), or covariance blocks (N, m, m) in m^2.
        markers: P, the number of points per configuration; coordinates of one marker are adjacent.
        prior_variance: (K,) variances of the nominal map's parameters theta, if it has any.

    Attributes:
        controls: (M, n) configurations that carry momenta; the data's own x unless :meth:`with_controls`.

    Raises:
        InputError: shapes or kernels that do not fit, values that are not finite, or a nominal map
            that is not defined at the data.
    """

    def __init__(
        self,
        nominal: NominalMap | Callable[[Tensor], Tensor],
        x: object,
        y: object,
        *,
        joint_kernel: Kernel,
        task_kernel: Kernel,
        noise: object,
        markers: int = 1,
        prior_variance: object = (),
    ) -> None:
        self.x = self.controls = as_tensor(x, "x", ("N", "n")).detach()
        self.y = as_tensor(y, "y", (len(self.x), "m"), fix="pass one measured point per configuration").detach()
        nominal = as_nominal(nominal)
        m = self.y.shape[1]
        if markers < 1 or m % markers:
            raise InputError(sentence("`markers`", expected=f"a divisor of the {m} columns of `y`", got=markers))
        joint_kernel.check(self.x.shape[1], "joint_kernel")
        task_kernel.check(m // markers, "task_kernel")
        variance = (
            torch.zeros(0, dtype=self.x.dtype, device=self.x.device)
            if nominal.parameters == 0
            else positive(prior_variance, "prior_variance", (nominal.parameters,)).to(self.x.device)
        )
        self.model = ModelSpec(nominal, joint_kernel, task_kernel, variance, m // markers)
        self.noise = self._noise(noise)
        value = nominal(self.x, variance * 0.0)
        if value.shape != self.y.shape:
            raise InputError(
                sentence(
                    "`nominal(x)` has the wrong shape",
                    expected=tuple(self.y.shape),
                    got=tuple(value.shape),
                    fix="k0 must map (N, n) to the shape of `y`",
                )
            )
        check_finite(value, "nominal(x)")

    def _noise(self, noise: object) -> Noise:
        n, m = self.y.shape
        if isinstance(noise, (int, float)) or getattr(noise, "ndim", 0) == 0:
            sigma = positive(noise, "noise")
            if float(sigma) < SMALLEST_NOISE:
                raise InputError(sentence("`noise`", expected=f"at least {SMALLEST_NOISE:g} m", got=float(sigma)))
            return Noise((sigma**2 * torch.eye(m, dtype=self.y.dtype, device=self.y.device)).repeat(n, 1, 1))
        return Noise(as_tensor(noise, "noise", (n, m, m), fix="pass sigma in m or one covariance block per row"))

    def using(self, backend: Backend) -> Problem:
        """The same problem, its kernel sums run by this backend."""
        other = copy(self)
        other.model = self.model.using(backend)
        return other

    def with_controls(self, controls: object) -> Problem:
        """A coarse version: only these configurations (M, n) carry momenta, the N data ride along.

        Raises:
            InputError: wrong shape, or values that are not finite.
        """
        other = copy(self)
        n = self.x.shape[1]
        other.controls = as_tensor(controls, "controls", ("M", n), fix=f"pass configurations of {n} joints").detach()
        return other

    def subset(self, rows: Tensor) -> Problem:
        """The same problem with some of the measurements, given by their numbers."""
        other = copy(self)
        other.x, other.y, other.noise = self.x[rows], self.y[rows], Noise(self.noise.covariance[rows])
        other.controls = other.x
        return other

    @property
    def reduced(self) -> bool:
        """Whether the controls are not the data."""
        return self.controls is not self.x

    def zero(self) -> Momenta:
        """No deformation: k1 = k0."""
        points = len(self.controls) * self.y.shape[1] // self.model.task_dim
        return Momenta(
            torch.zeros_like(self.controls),
            self.y.new_zeros(points, self.model.task_dim),
            torch.zeros_like(self.model.prior_variance),
        )

    def deform(self, momenta: Momenta, integrator: Integrator, *, variational: bool = False) -> Deformation:
        """Run both flows for these momenta; variational if the result will be linearised."""
        return Deformation(self.model, self.controls, momenta, integrator, variational=variational)

    def values(self, deformation: Deformation) -> Tensor:
        """k1 at the data: (N, m)."""
        return deformation(self.x) if self.reduced else deformation.z1

    def energy(self, deformation: Deformation) -> EnergyParts:
        """The energy of a deformation of this problem; differentiable once in its momenta."""
        b, p, theta = deformation.momenta.tensors
        residual = self.values(deformation) - self.y
        return EnergyParts(
            energy(self.model.joint_kernel, self.controls, b),
            energy(self.model.task_kernel, deformation.z0.reshape(p.shape), p),
            0.5 * (theta**2 / self.model.prior_variance).sum(),
            0.5 * (residual * self.noise.solve(residual)).sum(),
        )

    def coupling_residual(self, deformation: Deformation) -> float:
        """|b_end - Dk0(xi)^T p| / |b_end|: zero at the optimum, and only there the paper's P0 holds.

        Undefined (NaN) with fewer control points than data: the paper's momentum lives at the data.
        """
        if self.reduced:
            return float("nan")
        jacobian = self.model.nominal.jacobian(deformation.xi, deformation.momenta.theta)
        p = deformation.momenta.y.reshape(self.y.shape)
        b_end = deformation.joint_flow.end[1]
        return _relative(b_end - (jacobian.mT @ p[:, :, None])[:, :, 0], b_end)

    def end_residual(self, deformation: Deformation) -> float:
        """|p_end - R^-1 (y - z1)| / |p_end|: the end condition (12); NaN with fewer control points than data."""
        if self.reduced:
            return float("nan")
        p_end = deformation.task_flow.end[1].reshape(self.y.shape)
        return _relative(p_end - self.noise.solve(self.y - deformation.z1), p_end)


def _relative(difference: Tensor, reference: Tensor) -> float:
    size = float(torch.linalg.norm(reference))
    return float(torch.linalg.norm(difference)) / size if size > 0 else float(torch.linalg.norm(difference))
