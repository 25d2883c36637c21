"""A peer in JAX and diffrax as a method, see landmarks.py: compiled, float64, right-hand side in closed form.

Settings that were fastest of those tried: rows in blocks of 256 that are recomputed in the backward pass;
Tsit5 (order 5) with constant steps; diffrax's checkpointed adjoint with one checkpoint per step.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import torch
from landmarks import LENGTHSCALE, Landmarks, Method
from torch import Tensor

jax.config.update("jax_enable_x64", True)

GPU_PAIRS = 1 << 27  # of a block of rows


class Diffrax(Method):
    """JAX float64, jit-compiled ahead of time."""

    order: ClassVar[int] = 5
    environment: ClassVar[dict[str, str]] = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}

    def __init__(self, data: Landmarks) -> None:
        super().__init__(data)
        n, cuda = len(data.q), data.q.is_cuda
        device = jax.devices("gpu" if cuda else "cpu")[0]
        self.arrays = Landmarks(*(jax.device_put(t.cpu().numpy(), device) for t in data))  # pyright: ignore[reportArgumentType]
        self.block = min(n, max(1, GPU_PAIRS // n) if cuda else 256)
        self.compiled: dict[tuple[str, int], Any] = {}

    def compile(self, task: str, steps: int) -> None:
        """Compile ahead of time for this size."""
        functions: dict[str, Callable[..., Any]] = {
            "sum": lambda q, p, y, dq, dp: [self._sum(q, p)],
            "rhs": lambda q, p, y, dq, dp: self._rhs(q, p),
            "adjoint": self._adjoint,
            "loss_and_gradient": lambda q, p, y, dq, dp: self._loss_and_gradient(q, p, y, steps),
        }
        self.compiled[task, steps] = jax.jit(functions[task]).lower(*self.arrays).compile()

    def function(self, task: str, steps: int) -> Callable[[], list[Any]]:
        """Return a call and a wait for its end."""
        compiled = self.compiled[task, steps]
        return lambda: list(jax.block_until_ready(compiled(*self.arrays)))

    def endpoint(self, steps: int) -> Tensor:
        """q(1), without derivatives."""
        return self.tensors([jax.jit(self._end, static_argnums=2)(self.arrays.q, self.arrays.p, steps)])[0]

    def tensors(self, results: list[Any]) -> list[Tensor]:
        """By way of numpy."""
        return [torch.from_numpy(np.array(r)).to(self.data.q.device) for r in results]

    def threads(self) -> int:
        """XLA takes the processor's cores that it is given."""
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

    def _by_rows(self, row: Callable[..., Any], *arrays: jax.Array) -> Any:
        return jax.lax.map(lambda values: jax.checkpoint(row)(*values), arrays, batch_size=self.block)

    def _sum(self, q: jax.Array, p: jax.Array) -> jax.Array:
        return self._by_rows(lambda x: _kernel_row(x, q) @ p, q)

    def _rhs(self, q: jax.Array, p: jax.Array) -> tuple[jax.Array, jax.Array]:
        """dH/dp, dH/dq."""

        def row(x: jax.Array, a: jax.Array) -> tuple[jax.Array, jax.Array]:
            kappa = _kernel_row(x, q)
            weights = kappa * (p @ a)
            return kappa @ p, (weights @ q - x * weights.sum()) / LENGTHSCALE**2

        return self._by_rows(row, q, p)

    def _adjoint(self, q: jax.Array, p: jax.Array, y: jax.Array, dq: jax.Array, dp: jax.Array) -> list[jax.Array]:
        """Reverse mode: as the Hessian is symmetric, the cotangents (dp, dq) of dH/dp, dH/dq give its product."""
        to_q, to_p = jax.vjp(self._rhs, q, p)[1]((dp, dq))
        return [to_p, to_q]

    def _end(self, q: jax.Array, p: jax.Array, steps: int) -> jax.Array:
        def field(t: Any, state: Any, args: Any) -> Any:
            velocity, slope = self._rhs(*state)
            return velocity, -slope

        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            diffrax.Tsit5(),
            0.0,
            1.0,
            1.0 / steps,
            (q, p),
            saveat=diffrax.SaveAt(t1=True),
            stepsize_controller=diffrax.ConstantStepSize(),
            adjoint=diffrax.RecursiveCheckpointAdjoint(checkpoints=steps),
            max_steps=steps,
        )
        return solution.ys[0][0]  # pyright: ignore[reportOptionalSubscript]

    def _loss_and_gradient(self, q: jax.Array, p: jax.Array, y: jax.Array, steps: int) -> tuple[Any, Any]:
        def loss(p: jax.Array) -> tuple[jax.Array, jax.Array]:
            end = self._end(q, p, steps)
            energy = 0.5 * jnp.sum(p * self._sum(q, p))
            return len(q) * energy + jnp.sum((end - y) ** 2), end

        return jax.grad(loss, has_aux=True)(p)


def _kernel_row(x: jax.Array, q: jax.Array) -> jax.Array:
    """K(x, q_j) for all j: (d,), (N, d) -> (N,)."""
    r2 = x @ x - 2.0 * (q @ x) + (q * q).sum(-1)
    return jnp.exp(r2 * (-0.5 / LENGTHSCALE**2))
