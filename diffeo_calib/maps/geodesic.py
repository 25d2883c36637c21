"""The exact model k1 = psi o k0(.; theta) o phi^-1 for given momenta, and its linearisation.

Both diffeomorphisms are landmark geodesics run one after the other (LDDMM; Orozco & Ratajczak 2025,
(2), (4), (13)):

    xi = phi^-1(x)      geodesic of K_V from the configurations x with momenta b
    z0 = k0(xi; theta)
    z1 = psi(z0)        geodesic of K_W from z0 with momenta p        z1_i = k1(x_i)

With P markers per configuration psi acts on R^d and moves all N P marker points.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffeo_calib.flows.geodesic import Flow
from diffeo_calib.flows.hamiltonian import energy
from diffeo_calib.flows.integrators import Integrator
from diffeo_calib.maps.deformation import Deformation, ModelSpec, Momenta, finite, relative, sums_run_by


class GeodesicDeformation(Deformation):
    """k1 for given momenta: two flows run once, then evaluated anywhere.

    Args:
        spec: nominal map, kernels, prior.
        x: (N, n) control configurations.
        momenta: b, p, theta.
        integrator: time stepping of both flows.
        variational: whether it will be linearised at its controls: their Jacobians are then carried along.

    Attributes:
        xi: (N, n) phi^-1(x).
        z1: (N, m) k1(x).
    """

    def __init__(
        self, spec: ModelSpec, x: Tensor, momenta: Momenta, integrator: Integrator, *, variational: bool = False
    ) -> None:
        self.spec, self.x, self.momenta, self.integrator = spec, x, momenta, integrator
        self.joint_flow = Flow(spec.joint_kernel, x, momenta.joint, integrator, variational=variational)
        self.xi = finite(self.joint_flow.end[0], "the joint-space flow overflows")
        self.z0 = spec.nominal(self.xi, momenta.theta)
        start = self._points(self.z0)
        self.task_flow = Flow(spec.task_kernel, start, momenta.task, integrator, variational=variational)
        self.z1 = finite(self.task_flow.end[0], "the task-space flow overflows").reshape(self.z0.shape)

    def __call__(self, x: Tensor) -> Tensor:
        """k1(x): (M, n) -> (M, m), differentiable by autograd in x."""
        z0 = self.spec.nominal(self.joint_flow(x), self.momenta.theta)
        return self.task_flow(self._points(z0)).reshape(z0.shape)

    def jacobian(self, x: Tensor) -> Tensor:
        """Dk1 = Dpsi Dk0 Dphi^-1, the exact derivative of :meth:`__call__`: (M, m, n)."""
        xi, d_phi = self.joint_flow.with_jacobian(x)
        z0 = self.spec.nominal(xi, self.momenta.theta)
        _, d_psi = self.task_flow.with_jacobian(self._points(z0))
        return self._apply_blocks(d_psi, self.spec.nominal.jacobian(xi, self.momenta.theta) @ d_phi)

    def field_energies(self) -> tuple[Tensor, Tensor]:
        """1/2 b^T K_V b and 1/2 p^T K_W p, differentiable once in b and p."""
        spec, (b, p, _) = self.spec, self.momenta.tensors
        return energy(spec.joint_kernel, self.x, b), energy(spec.task_kernel, self.z0.reshape(p.shape), p)

    @property
    def end_momenta(self) -> Tensor:
        """p at the end of the task-space geodesic: (N P, d)."""
        return self.task_flow.end[1]

    def coupling_residual(self) -> float:
        """|b_end - Dk0(xi)^T p| / |b_end|, zero at an optimum."""
        jacobian = self.spec.nominal.jacobian(self.xi, self.momenta.theta)
        p = self.momenta.task.reshape(self.z1.shape)
        b_end = self.joint_flow.end[1]
        return relative(b_end - (jacobian.mT @ p[:, :, None])[:, :, 0], b_end)

    def energy_drift(self) -> float:
        """The larger relative drift of the two Hamiltonians."""
        return max(self.joint_flow.energy_drift(), self.task_flow.energy_drift())

    @property
    def backends(self) -> tuple[str, str]:
        """What ran the kernel sums between the control points: in joint space, in task space."""
        return sums_run_by(self.spec.joint_kernel, self.x), sums_run_by(self.spec.task_kernel, self.momenta.task)

    def inverse_joint(self, xi: Tensor) -> Tensor:
        """phi(xi): the configurations x with phi^-1(x) = xi, (M, n)."""
        return self.joint_flow.inverse(xi)

    def linearise(self, x: Tensor | None = None) -> Linearisation:
        """How k1(x) moves with the fields v_t, w_t and theta.

        Args:
            x: (M, n) where; the control configurations by default.
        """
        theta, weights = self.momenta.theta, self.integrator.weights()
        if x is None or x is self.x:
            (chi, m_x), (z, m_y) = self.joint_flow.control_path(), self.task_flow.control_path()
        else:
            chi, m_x = self.joint_flow.path(x)
            z, m_y = self.task_flow.path(self._points(self.spec.nominal(chi[-1], theta)))
        # Theta_s = C Mx_1 Mx_s^-1 with C = Dpsi Dk0: a push at time s, carried to the end.
        to_end = self._apply_blocks(m_y[-1], self.spec.nominal.jacobian(chi[-1], theta)) @ m_x[-1]
        sensitivity = self._apply_blocks(m_y[-1], self.spec.nominal.sensitivities(chi[-1], theta))
        return Linearisation(
            self.spec,
            [NodeSensitivity(c, p, to_end @ torch.linalg.inv(m)) for c, p, m in zip(weights, chi, m_x, strict=True)],
            [NodeSensitivity(c, p, m_y[-1] @ torch.linalg.inv(m)) for c, p, m in zip(weights, z, m_y, strict=True)],
            sensitivity,
        )

    def momentum_pushes(self) -> tuple[list[NodeSensitivity], list[NodeSensitivity]]:
        """How the initial momenta of the controls make the fields: b acts at time s as Mx_s^-T b, p as My_s^-T p.

        Returns:
            pushes of the joint and of the task flow, with effects M_s^-1.
        """
        weights = self.integrator.weights()
        joint, task = (
            [NodeSensitivity(c, p, torch.linalg.inv(m)) for c, p, m in zip(weights, *flow.control_path(), strict=True)]
            for flow in (self.joint_flow, self.task_flow)
        )
        return joint, task

    def _points(self, z: Tensor) -> Tensor:
        """(M, m) -> (M P, d) marker points."""
        return z.reshape(-1, self.spec.task_dim)

    def _apply_blocks(self, blocks: Tensor, matrix: Tensor) -> Tensor:
        """Multiply every marker's rows by its own block: (M P, d, d), (M, m, k) -> (M, m, k)."""
        return (blocks @ matrix.reshape(len(blocks), self.spec.task_dim, matrix.shape[-1])).reshape(matrix.shape)


@dataclass(frozen=True)
class NodeSensitivity:
    """One node of the time grid: field values at ``points`` move the end by ``effect``.

    Args:
        weight: quadrature weight c of the node.
        points: (L, k) where the field acts.
        effect: (L, r, k) derivative of the end point with respect to the field's value there.
    """

    weight: float
    points: Tensor
    effect: Tensor

    def response(self, values: Tensor) -> Tensor:
        """weight * effect @ values: (L, k) -> (L, r)."""
        return self.weight * (self.effect @ values[:, :, None])[:, :, 0]

    def contract(self, weights: Tensor) -> Tensor:
        """Weights of r x r blocks (L r, L r) as weights of the field's components, (L, k, L)."""
        count, r, k = self.effect.shape
        half = (self.effect.mT @ weights.view(count, r, count * r)).view(count, k, count, r)
        return torch.einsum("ikjr,jrk->ikj", half, self.effect)

    def take(self, rows: Tensor | slice) -> NodeSensitivity:
        """The push of some points."""
        return NodeSensitivity(self.weight, self.points[rows], self.effect[rows])


@dataclass(frozen=True)
class Linearisation:
    """First-order effect on k1 of the fields at every time node and of theta.

    At zero momenta this is the tangent model k1 = k0 + Dk0 K_V b + K_W p + S theta.

    Args:
        spec: kernels and prior.
        joint: pushes of v_s at M configurations, effects Theta_s (M, m, n).
        task: pushes of w_t at M P marker points, effects Phi_t (M P, d, d).
        sensitivity: Dpsi S (M, m, K).
    """

    spec: ModelSpec
    joint: list[NodeSensitivity]
    task: list[NodeSensitivity]
    sensitivity: Tensor

    @property
    def joint_to_start(self) -> Tensor:
        """Theta_0 (M, m, n)."""
        return self.joint[0].effect

    @property
    def task_to_start(self) -> Tensor:
        """Phi_0 (M P, d, d)."""
        return self.task[0].effect

    def gram(self, other: Linearisation | None = None) -> Tensor:
        """Prior covariance of k1 at these points with k1 at the other's: (M m, N m).

        G = sum_s c_s Theta_s K_V Theta_s^T + sum_t c_t Phi_t K_W Phi_t^T + (Dpsi S) Lambda^-1 (Dpsi S)^T
        """
        other = self if other is None else other
        total = self.sensitivity.flatten(0, 1) * self.spec.prior_variance @ other.sensitivity.flatten(0, 1).T
        for kernel, mine, theirs in (
            (self.spec.joint_kernel, self.joint, other.joint),
            (self.spec.task_kernel, self.task, other.task),
        ):
            for a, b in zip(mine, theirs, strict=True):
                total += kernel.gram(a.points, a.weight * a.effect, b.points, b.effect)
        return total

    def inner(self, weights: Tensor) -> Tensor:
        """sum(weights * gram()), weights (M m, M m), differentiable in the scales of kernels and prior: scalar.

        The derivative of any function of the matrix, its slope as weights, without a graph through such matrices.
        """
        S = self.sensitivity.flatten(0, 1)
        total = ((weights @ S) * S).sum(0) @ self.spec.prior_variance
        for kernel, pushes in ((self.spec.joint_kernel, self.joint), (self.spec.task_kernel, self.task)):
            for push in pushes:
                total = total + push.weight * kernel.inner(push.points, push.points, push.contract(weights))
        return total

    def take(self, rows: Tensor) -> Linearisation:
        """The linearisation at some of the configurations, given by their numbers."""
        markers = self.sensitivity.shape[1] // self.spec.task_dim
        points = (rows[:, None] * markers + torch.arange(markers, device=rows.device)).flatten()
        joint, task = [p.take(rows) for p in self.joint], [p.take(points) for p in self.task]
        return Linearisation(self.spec, joint, task, self.sensitivity[rows])

    def product(self, mu: Tensor) -> Tensor:
        """G mu without the matrix G: (N, m, k) -> (N, m, k), by kernel sums."""
        prior = self.spec.prior_variance[:, None] * torch.einsum("imt,imk->tk", self.sensitivity, mu)
        total = torch.einsum("imt,tk->imk", self.sensitivity, prior)
        for kernel, pushes in ((self.spec.joint_kernel, self.joint), (self.spec.task_kernel, self.task)):
            for push in pushes:
                shaped = mu.reshape(len(push.points), -1, mu.shape[-1])  # (N, m, k) or (N P, d, k)
                momenta = (push.effect.mT @ shaped).mT  # (L, k, n)
                values = kernel.field(push.points, push.points, momenta)
                total = total + (push.weight * push.effect @ values.mT).reshape(mu.shape)
        return total

    def response(self, deformation: GeodesicDeformation) -> Tensor:
        """Linear effect of a deformation's own fields and theta on k1 at its controls: (N, m)."""
        total = torch.einsum("imk,k->im", self.sensitivity, deformation.momenta.theta)
        for push, v in zip(self.joint, deformation.joint_flow.velocities(), strict=True):
            total = total + push.response(v)
        for push, w in zip(self.task, deformation.task_flow.velocities(), strict=True):
            total = total + push.response(w).reshape(total.shape)
        return total

    def momenta(self, mu: Tensor) -> Momenta:
        """Momenta with end value mu (N, m): b = Theta_0^T mu, p = Phi_0^T mu, theta = Lambda^-1 (Dpsi S)^T mu."""
        b = (self.joint_to_start.mT @ mu[:, :, None])[:, :, 0]
        p = (self.task_to_start.mT @ mu.reshape(-1, self.spec.task_dim, 1))[:, :, 0]
        theta = self.spec.prior_variance * torch.einsum("imk,im->k", self.sensitivity, mu)
        return Momenta(b, p, theta)
