"""Landmark geodesics: Hamilton's equations of H(q, a) = 1/2 sum_ij a_i^T K(q_i, q_j) a_j.

    q' =  dH/da = v(q)            v = sum_j K(., q_j) a_j
    a' = -dH/dq = -Dv(q)^T a      (LDDMM; Younes, Shapes and Diffeomorphisms)

The right-hand side is f = J grad H, so its vector-Jacobian product with cotangents (c for q', d for
a') is the Hessian of H applied to the direction (dq, da) = (-d, c): one more kernel sum of the same
kind, without backpropagation through the sums. The autograd Functions below implement it, so that both
backpropagation and adjoint methods use it.

A state is one tensor (2, N, n): ``state[0]`` the points q, ``state[1]`` the momenta a.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from diffeo_calib.common.checks import wrapped
from diffeo_calib.kernels.base import Kernel


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
