"""Landmark geodesics and their flows: integrated once for the controls, then evaluated at any passive point.

Hamilton's equations of H(q, a) = 1/2 sum_ij a_i^T K(q_i, q_j) a_j (LDDMM; Younes, Shapes and Diffeomorphisms):

    q' =  dH/da = v(q)            v = sum_j K(., q_j) a_j
    a' = -dH/dq = -Dv(q)^T a

The right-hand side is f = J grad H, so its vector-Jacobian product with cotangents (c for q', d for a') is the Hessian
of H applied to the direction (dq, da) = (-d, c): one more kernel sum of the same kind, without backpropagation through
the sums. A state is one tensor (2, N, n): ``state[0]`` the controls q, ``state[1]`` their momenta a.

Every other point x is passive, x' = v_t(x), and its Jacobian M = D flow(x) solves M' = Dv_t(x) M. Passive points are
integrated with the *same* stages as the controls (recorded and replayed, or integrated again together with them). With
fixed steps the flow is therefore one smooth map of x, M is its exact derivative (up to rounding, not up to the step
size), and a passive point that starts at a control follows it exactly. With adaptive steps this holds to their
tolerance.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from math import isqrt
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from diffeo_calib.common.checks import wrapped
from diffeo_calib.flows.integrators import Integrator, Run
from diffeo_calib.kernels.base import Kernel
from diffeo_calib.kernels.reductions.backends import Backend


def geodesic_field(kernel: Kernel, state: Tensor) -> Tensor:
    """Right-hand side (q', a') of the geodesic equations.

    Args:
        kernel: reproducing kernel of the vector fields.
        state: (2, N, n) points and momenta.

    Returns:
        (2, N, n), differentiable once by autograd in ``state`` (not in hyper-parameters).
    """
    return _GeodesicField.apply(state, kernel)


def velocity(kernel: Kernel, x: Tensor, q: Tensor, a: Tensor) -> Tensor:
    """v(x) = sum_j K(x, q_j) a_j, with closed-form backpropagation in O(M + N) memory.

    Args:
        kernel: reproducing kernel of the vector fields.
        x: (M, n) evaluation points. q: (N, n) controls. a: (N, n) their momenta.

    Returns:
        (M, n), differentiable by autograd in x, q and a (not in hyper-parameters).
    """
    if wrapped(x):
        return kernel.field(x, q, a)
    return _Velocity.apply(x, q, a, kernel)


def energy(kernel: Kernel, q: Tensor, a: Tensor) -> Tensor:
    """H(q, a) = 1/2 |v|_V^2, the squared norm of the field (first two terms of (16)).

    Args:
        kernel: reproducing kernel of the vector fields.
        q: (N, n) points. a: (N, n) momenta.

    Returns:
        scalar, differentiable once by autograd in q and a.
    """
    return _Energy.apply(q, a, kernel)


class _GeodesicField(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, state: Tensor, kernel: Kernel) -> Tensor:
        ctx.save_for_backward(state)
        ctx.kernel = kernel
        q, a = state.unbind(0)
        velocity, gradient = kernel.hamiltonian_gradient(q, a)
        return torch.stack([velocity, -gradient])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        (state,) = ctx.saved_tensors
        c, d = grads[0].unbind(0)
        dv, dg = ctx.kernel.hessian_product(state[0], state[1], -d, c)
        return torch.stack([dg, dv]), None


class _Velocity(torch.autograd.Function):
    """v(x), whose gradients are those of sum_ij c_i^T K(x_i, q_j) a_j: two kernel sums."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, q: Tensor, a: Tensor, kernel: Kernel) -> Tensor:
        ctx.save_for_backward(x, q, a)
        ctx.kernel = kernel
        return kernel.field(x, q, a)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, Tensor | None, Tensor | None, None]:
        x, q, a = ctx.saved_tensors
        (c,) = grads
        to_x, to_q, to_a, _ = ctx.needs_input_grad
        dx = ctx.kernel.gradient(x, c, q, a)[1] if to_x else None
        da, dq = ctx.kernel.gradient(q, a, x, c) if to_q or to_a else (None, None)
        return dx, dq, da, None


class _Energy(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, q: Tensor, a: Tensor, kernel: Kernel) -> Tensor:
        velocity, gradient = kernel.hamiltonian_gradient(q, a)
        ctx.save_for_backward(velocity, gradient)
        return 0.5 * (a * velocity).sum()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor, None]:
        velocity, gradient = ctx.saved_tensors
        return grads[0] * gradient, grads[0] * velocity, None


BLOCK_ROWS = 4096  # number of points that are evaluated together, which bounds the memory of large queries


class Flow:
    """The time-1 map of the geodesic that starts at (q, a).

    Args:
        kernel: reproducing kernel of the vector fields.
        q: (N, n) control points at time 0. a: (N, n) their momenta.
        integrator: time stepping.
        variational: whether to integrate the Jacobians at the controls in the same run. If :meth:`control_path` will be
            needed, this is cheaper than a second run. Gradients then do not use the closed-form adjoint.

    Attributes:
        nodes: the controls' states (2, N, n) at the nodes of the time grid.
        stages: at every stage of the run; empty if the method is not replayable.
    """

    def __init__(
        self, kernel: Kernel, q: Tensor, a: Tensor, integrator: Integrator, *, variational: bool = False
    ) -> None:
        self.kernel, self.integrator = kernel, integrator
        self._jacobians: list[Tensor] | None = None
        if variational:
            n, start = q.shape[1], torch.cat([q, a, _eye(q).flatten(1)], -1)
            run = Run(integrator, self._variational_controls, start, lambda s: torch.stack(s[:, : 2 * n].split(n, 1)))
            self._jacobians = [s[:, 2 * n :].unflatten(1, (n, n)) for s in run.nodes]
            run.nodes = [torch.stack(s[:, : 2 * n].split(n, 1)) for s in run.nodes]
            self._run = run
        else:
            self._run = Run(integrator, self._rate, torch.stack([q, a]))
        self.nodes, self.stages = self._run.nodes, self._run.stages

    def using(self, backend: Backend) -> Flow:
        """Return the flow, whose passive points move by kernel sums of this backend."""
        other = copy(self)
        other.kernel = self.kernel.using(backend)
        return other

    def _rate(self, state: Tensor) -> Tensor:
        return geodesic_field(self.kernel, state)

    def _variational_controls(self, packed: Tensor) -> Tensor:
        """q' = v, a' = -Dv^T a, M' = Dv M: one kernel sum gives all three."""
        n = isqrt(packed.shape[1] + 1) - 1  # columns: n + n + n^2
        q, a, m = packed[:, :n], packed[:, n : 2 * n], packed[:, 2 * n :].unflatten(1, (n, n))
        v, dv = self.kernel.field_and_jacobian(None, q, a)
        return torch.cat([v, -(dv.mT @ a[:, :, None])[:, :, 0], (dv @ m).flatten(1)], -1)

    @property
    def end(self) -> Tensor:
        """The controls' state (2, N, n) at time 1."""
        return self.nodes[-1]

    def energy_drift(self) -> float:
        """|H(1) - H(0)| / H(0): zero for the exact flow."""
        start, end = (float(energy(self.kernel, *node)) for node in (self.nodes[0], self.nodes[-1]))
        return abs(end - start) / start if start > 0 else 0.0

    def __call__(self, x: Tensor) -> Tensor:
        """The flow of passive points: (M, n) -> (M, n); differentiable by autograd."""

        def field(points: Tensor, controls: Tensor) -> Tensor:
            return velocity(self.kernel, points, *controls)

        return torch.cat([self._run.alongside(field, x[rows], self._rate)[-1] for rows in row_blocks(x)])

    def with_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The flow (M, n) and its Jacobian (M, n, n) at passive points x (M, n)."""
        parts = [self.path(x[rows]) for rows in row_blocks(x)]
        return torch.cat([p[-1] for p, _ in parts]), torch.cat([m[-1] for _, m in parts])

    def path(self, x: Tensor) -> tuple[list[Tensor], list[Tensor]]:
        """Passive points (M, n) and their Jacobians (M, n, n) at all nodes of the time grid."""
        n = x.shape[1]

        def field(state: Tensor, controls: Tensor) -> Tensor:
            v, dv = self.kernel.field_and_jacobian(state[:, :n], *controls)
            return torch.cat([v, (dv @ state[:, n:].unflatten(1, (n, n))).flatten(1)], -1)

        states = self._run.alongside(field, torch.cat([x, _eye(x).flatten(1)], -1), self._rate)
        return [s[:, :n] for s in states], [s[:, n:].unflatten(1, (n, n)) for s in states]

    def control_path(self) -> tuple[list[Tensor], list[Tensor]]:
        """The controls and their Jacobians at all nodes of the time grid."""
        if self._jacobians is None:
            return self.path(self.nodes[0][0])
        return [q for q, _ in self.nodes], self._jacobians


def _eye(x: Tensor) -> Tensor:
    """One identity per point: (M, n) -> (M, n, n)."""
    m, n = x.shape
    return torch.eye(n, dtype=x.dtype, device=x.device).expand(m, n, n)


def row_blocks(x: Tensor) -> Iterator[slice]:
    """Rows that are evaluated together."""
    if wrapped(x):
        return iter([slice(None)])  # a recorded program must not depend on the number of rows
    return (slice(i, i + BLOCK_ROWS) for i in range(0, max(len(x), 1), BLOCK_ROWS))
