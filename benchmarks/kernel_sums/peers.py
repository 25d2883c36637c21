"""Peers in torch as methods, see landmarks.py: how one would write the tasks without the package.

No code is copied: naive_dense is the textbook formula; dense_autograd and keops_* let autograd differentiate H and then
its gradient, as the public LDDMM tutorials of KeOps describe it.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar

import torch
from landmarks import LENGTHSCALE, Method, TorchMethod, gaussian, ralston, rk4
from torch import Tensor

from diffeo_calib.kernels.reductions import keops


class Autograd(TorchMethod):
    """H in a few lines; everything else by autograd, twice."""

    @abstractmethod
    def smooth(self, x: Tensor, y: Tensor, b: Tensor) -> Tensor:
        """Return sum_j K(x_i, y_j) b_j."""

    def energy(self, q: Tensor, p: Tensor) -> Tensor:
        """1/2 <p, K(q, q) p>."""
        return 0.5 * (p * self.smooth(q, q, p)).sum()

    def field(self, state: Tensor, differentiable: bool) -> Tensor:
        """(dH/dp, -dH/dq)."""
        q, p = state.unbind(0)
        dp, dq = self._gradient(q, p, differentiable)
        return torch.stack([dp, -dq])

    def _gradient(self, q: Tensor, p: Tensor, differentiable: bool) -> list[Tensor]:
        """dH/dp, dH/dq."""
        with torch.enable_grad():
            if not differentiable:
                q, p = q.detach(), p.detach()
            q, p = (t if t.requires_grad else t.detach().requires_grad_() for t in (q, p))
            return list(torch.autograd.grad(self.energy(q, p), (p, q), create_graph=differentiable))

    def step(self, field: Callable[[Tensor], Tensor], y: Tensor, h: float) -> Tensor:
        """Classical Runge-Kutta."""
        return rk4(field, y, h)

    def sum(self) -> list[Tensor]:
        """Return v."""
        return [self.smooth(self.data.q, self.data.q, self.data.p)]

    def rhs(self) -> list[Tensor]:
        """dH/dp, dH/dq."""
        return self._gradient(self.data.q, self.data.p, differentiable=False)

    def adjoint(self) -> Callable[[], list[Tensor]]:
        """Return the backward pass only; the graph is built before and kept, as in a flow's forward pass."""
        q, p = (t.detach().clone().requires_grad_() for t in (self.data.q, self.data.p))
        gradient = self._gradient(q, p, differentiable=True)
        cotangents = (self.data.dp, self.data.dq)
        return lambda: list(torch.autograd.grad(gradient, (p, q), cotangents, retain_graph=True))


class DenseAutograd(Autograd):
    """A materialised matrix from one matrix product; RK4."""

    def smooth(self, x: Tensor, y: Tensor, b: Tensor) -> Tensor:
        """Distances by |x|^2 - 2 x . y + |y|^2."""
        x2, y2 = x.square().sum(-1, keepdim=True), y.square().sum(-1)
        r2 = torch.addmm(x2 + y2, x, y.T, alpha=-2.0)
        return torch.exp(r2 * (-0.5 / LENGTHSCALE**2)) @ b


class KeopsTutorial(Autograd):
    """The way of the tutorials: LazyTensors with the defaults of pykeops, Ralston's method."""

    order: ClassVar[int] = 2
    environment: ClassVar[dict[str, str]] = {"CXXFLAGS": ""}
    scheme: ClassVar[str] = "auto"

    def compile(self, task: str, steps: int) -> None:
        """Compile, or load the result of an earlier compilation."""
        keops.load()
        super().compile(task, steps)

    def smooth(self, x: Tensor, y: Tensor, b: Tensor) -> Tensor:
        """A LazyTensor kernel."""
        lazy = keops.load()
        kernel = (-lazy.Vi(x).sqdist(lazy.Vj(y)) * (0.5 / LENGTHSCALE**2)).exp()
        return (kernel * lazy.Vj(b)).sum(dim=1, sum_scheme=self.scheme)

    def step(self, field: Callable[[Tensor], Tensor], y: Tensor, h: float) -> Tensor:
        """Return the state after one step of Ralston's method."""
        return ralston(field, y, h)


class KeopsTuned(KeopsTutorial):
    """The same with the package's compiler flags, direct summation and RK4."""

    order: ClassVar[int] = 4
    environment: ClassVar[dict[str, str]] = {}
    scheme: ClassVar[str] = "direct_sum"

    def step(self, field: Callable[[Tensor], Tensor], y: Tensor, h: float) -> Tensor:
        """Classical Runge-Kutta."""
        return rk4(field, y, h)


class NaiveDense(Method):
    """Broadcast differences (N, N, d), then exp, then a matrix product; closed-form gradient of H."""

    tasks: ClassVar[tuple[str, ...]] = ("sum", "rhs")

    def compile(self, task: str, steps: int) -> None:
        """Start torch's threads."""
        gaussian(self.data.q[:64], self.data.q[:64])

    def function(self, task: str, steps: int) -> Callable[[], list[Tensor]]:
        """Return a call and a wait for the accelerator."""

        def timed() -> list[Tensor]:
            results = self._sum() if task == "sum" else self._rhs()
            if self.data.q.is_cuda:
                torch.cuda.synchronize()
            return results

        return timed

    def endpoint(self, steps: int) -> Tensor:
        """Not offered."""
        raise NotImplementedError

    def _sum(self) -> list[Tensor]:
        return [gaussian(self.data.q, self.data.q) @ self.data.p]

    def _rhs(self) -> list[Tensor]:
        q, p = self.data.q, self.data.p
        differences = q[:, None] - q[None]
        kappa = torch.exp(-(differences**2).sum(-1) / (2.0 * LENGTHSCALE**2))
        weights = kappa * (p @ p.T)
        return [kappa @ p, -torch.einsum("ij,ijd->id", weights, differences) / LENGTHSCALE**2]
