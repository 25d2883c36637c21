"""One landmark problem of any size, the tasks measured on it, and the interface of a method that computes them.

Points are uniform in the unit cube, the kernel is exp(-|x - x'|^2 / (2 l^2)) with l = 1/2, and momenta sample
one smooth field divided by N, so that velocity (0.14 RMS) and accuracy of a time step hardly depend on N.

    sum                v_i = sum_j K_ij p_j
    rhs                gradient of H(q, p) = 1/2 sum_ij K_ij p_i . p_j in p and q
    adjoint            its derivative along (dq, dp), which is also its vector-Jacobian product
    loss_and_gradient  gradient in p of  N H(q, p) + sum_i |q_i(1) - y_i|^2  through the time steps, and q(1)
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from math import pi
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

TASKS = ("sum", "rhs", "adjoint", "loss_and_gradient")
LENGTHSCALE, VELOCITY, SEED = 0.5, 0.14, 0
SCALING_ROWS, TINY = 256, 64


class Landmarks(NamedTuple):
    """Points q, momenta p, targets y of q(1), a direction (dq, dp): (N, d) each, float64."""

    q: Tensor
    p: Tensor
    y: Tensor
    dq: Tensor
    dp: Tensor


def landmarks(n: int, dim: int, device: str = "cpu") -> Landmarks:
    """Return the problem with n points; a smaller problem has the first points of a larger one."""
    points, directions = (torch.Generator().manual_seed(SEED + k) for k in (0, 1))
    q = torch.rand(n, dim, generator=points, dtype=torch.float64)
    dq, dp = torch.randn(n, 2, dim, generator=directions, dtype=torch.float64).unbind(1)
    p = torch.sin(2.0 * pi * q + torch.arange(dim))
    few = q[:SCALING_ROWS]
    v = gaussian(few, few) @ p[:SCALING_ROWS] / len(few)
    p = p * VELOCITY / v.square().sum(1).mean().sqrt() / n
    y = q + VELOCITY * torch.sin(2.0 * q.roll(1, 1))
    return Landmarks(*(t.contiguous().to(device) for t in (q, p, y, dq, dp / n)))


def gaussian(x: Tensor, y: Tensor) -> Tensor:
    """Return the kernel matrix, from differences: (M, d), (N, d) -> (M, N)."""
    return torch.exp(-((x[:, None] - y[None]) ** 2).sum(-1) / (2.0 * LENGTHSCALE**2))


def gradient_rows(q: Tensor, p: Tensor, rows: slice) -> tuple[Tensor, Tensor]:
    """Return some rows of dH/dp and dH/dq, from differences."""
    x, a = q[rows], p[rows]
    kappa = gaussian(x, q)
    weights = kappa * (a @ p.T)
    slopes = (weights[..., None] * (x[:, None] - q[None])).sum(1)  # (M, N, d) -> (M, d)
    return kappa @ p, -slopes / LENGTHSCALE**2


def exact(task: str, data: Landmarks, rows: slice) -> list[Tensor]:
    """Return some rows of the results of sum, rhs or adjoint, by plain formulas (and torch's own jvp)."""
    if task == "adjoint":
        change = torch.func.jvp(lambda q, p: gradient_rows(q, p, rows), (data.q, data.p), (data.dq, data.dp))[1]
        return list(change)
    return list(gradient_rows(data.q, data.p, rows))[: 1 if task == "sum" else 2]


class Method(ABC):
    """One way of computing the tasks.

    Attributes:
        tasks: the tasks that it offers.
        order: order of its time stepping.
        environment: variables that must be set before its libraries are imported.
    """

    tasks: ClassVar[tuple[str, ...]] = TASKS
    order: ClassVar[int] = 4
    environment: ClassVar[dict[str, str]] = {}

    def __init__(self, data: Landmarks) -> None:
        self.data = data

    @abstractmethod
    def compile(self, task: str, steps: int) -> None:
        """Import, compile, start threads: once per program."""

    @abstractmethod
    def function(self, task: str, steps: int) -> Callable[[], list[Any]]:
        """Return the function to be timed; it waits for the device."""

    @abstractmethod
    def endpoint(self, steps: int) -> Tensor:
        """q(1) (N, d), without derivatives."""

    def tensors(self, results: list[Any]) -> list[Tensor]:
        """Results as torch tensors."""
        return results

    def threads(self) -> int:
        """Number of threads that it may use."""
        return torch.get_num_threads()


class TorchMethod(Method):
    """A method in torch: Hamiltonian, field and time stepping."""

    @abstractmethod
    def energy(self, q: Tensor, p: Tensor) -> Tensor:
        """H(q, p), differentiable."""

    @abstractmethod
    def field(self, state: Tensor, differentiable: bool) -> Tensor:
        """(dH/dp, -dH/dq): (2, N, d) -> (2, N, d)."""

    @abstractmethod
    def step(self, field: Callable[[Tensor], Tensor], y: Tensor, h: float) -> Tensor:
        """One time step."""

    @abstractmethod
    def sum(self) -> list[Tensor]:
        """v."""

    @abstractmethod
    def rhs(self) -> list[Tensor]:
        """dH/dp, dH/dq."""

    @abstractmethod
    def adjoint(self) -> Callable[[], list[Tensor]]:
        """Prepare, untimed, the function that returns this task's results."""

    def compile(self, task: str, steps: int) -> None:
        """Run a tiny problem: the formulas do not depend on N."""
        q = self.data.q
        type(self)(landmarks(TINY, q.shape[1], q.device.type)).function(task, 1)()

    def function(self, task: str, steps: int) -> Callable[[], list[Tensor]]:
        """Return a call and a wait for the accelerator."""
        calls = {"sum": lambda: self.sum, "rhs": lambda: self.rhs, "adjoint": self.adjoint}
        call = calls.get(task, lambda: lambda: self.loss_and_gradient(steps))()

        def timed() -> list[Tensor]:
            results = call()
            if self.data.q.is_cuda:
                torch.cuda.synchronize()
            return results

        return timed

    def end(self, p: Tensor, steps: int, differentiable: bool) -> Tensor:
        """q(1)."""
        state = torch.stack([self.data.q, p])
        for _ in range(steps):
            state = self.step(lambda y: self.field(y, differentiable), state, 1.0 / steps)
        return state[0]

    def endpoint(self, steps: int) -> Tensor:
        """q(1) (N, d), without derivatives."""
        with torch.no_grad():
            return self.end(self.data.p, steps, differentiable=False)

    def loss_and_gradient(self, steps: int) -> list[Tensor]:
        """Gradient of the loss in p; q(1)."""
        p = self.data.p.detach().requires_grad_()
        end = self.end(p, steps, differentiable=True)
        loss = len(p) * self.energy(self.data.q, p) + (end - self.data.y).square().sum()
        return [torch.autograd.grad(loss, p)[0], end.detach()]


def rk4(field: Callable[[Tensor], Tensor], y: Tensor, h: float) -> Tensor:
    """One step of the classical Runge-Kutta method."""
    k1 = field(y)
    k2 = field(y + 0.5 * h * k1)
    k3 = field(y + 0.5 * h * k2)
    k4 = field(y + h * k3)
    return y + (h / 6.0) * (k1 + 2.0 * (k2 + k3) + k4)


def ralston(field: Callable[[Tensor], Tensor], y: Tensor, h: float) -> Tensor:
    """One step of Ralston's method of order 2."""
    k1 = field(y)
    k2 = field(y + (2.0 / 3.0) * h * k1)
    return y + h * (0.25 * k1 + 0.75 * k2)
