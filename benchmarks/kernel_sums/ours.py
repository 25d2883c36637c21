"""The package's backends as methods, see landmarks.py."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import torch
from landmarks import LENGTHSCALE, Landmarks, TorchMethod
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.flows.hamiltonian import energy, geodesic_field
from diffeo_calib.flows.integrators import RungeKutta
from diffeo_calib.kernels.reductions import keops
from diffeo_calib.kernels.reductions.backends import BACKENDS, Backend


class Ours(TorchMethod):
    """Whatever `auto` chooses."""

    backend: ClassVar[Backend] = "auto"
    integrator: ClassVar[type[RungeKutta]] = dc.RK8
    order: ClassVar[int] = 8

    def __init__(self, data: Landmarks) -> None:
        super().__init__(data)
        self.kernel = dc.Gaussian(lengthscale=LENGTHSCALE).using(self.backend)

    def energy(self, q: Tensor, p: Tensor) -> Tensor:
        """H, with the package's closed-form gradient."""
        return energy(self.kernel, q, p)

    def field(self, state: Tensor, differentiable: bool) -> Tensor:
        """Hamilton's equations, with the package's closed-form adjoint."""
        return geodesic_field(self.kernel, state)

    def end(self, p: Tensor, steps: int, differentiable: bool) -> Tensor:
        """q(1) by the package's integrator."""
        field = lambda _, y: self.field(y, differentiable)  # noqa: E731
        return self.integrator(steps).nodes(field, torch.stack([self.data.q, p]))[-1][0]

    def step(self, field: Callable[[Tensor], Tensor], y: Tensor, h: float) -> Tensor:
        """Not used: the package steps."""
        raise NotImplementedError

    def sum(self) -> list[Tensor]:
        """Return v."""
        return [self.kernel.field(self.data.q, self.data.q, self.data.p)]

    def rhs(self) -> list[Tensor]:
        """dH/dp, dH/dq."""
        q, p = self.data.q, self.data.p
        return list(self.kernel.gradient(q, p, q, p))

    def adjoint(self) -> Callable[[], list[Tensor]]:
        """Return the Hessian product."""
        q, p, _, dq, dp = self.data
        return lambda: list(self.kernel.hessian_product(q, p, dq, dp))


class Dense(Ours):
    """One matrix."""

    backend = "dense"


class Tiled(Ours):
    """Tiles."""

    backend = "tiled"


class TiledRK4(Tiled):
    """Tiles, and the classical time stepping."""

    integrator = dc.RK4
    order = 4


class Keops(Ours):
    """Fused loops; an error rather than the package's fallback, where KeOps cannot run."""

    backend = "keops"

    def compile(self, task: str, steps: int) -> None:
        """Compile, or load what was compiled before."""
        keops.load()
        super().compile(task, steps)
        if not BACKENDS["keops"].usable():
            raise keops.KeopsUnavailableError("KeOps did not run")


class KeopsDefaultFlags(Keops):
    """The same formulas with the compiler flags and the summation scheme that pykeops comes with."""

    environment: ClassVar[dict[str, str]] = {"CXXFLAGS": ""}

    def compile(self, task: str, steps: int) -> None:
        """Compile, with this process' LazyTensors summing by their default scheme."""
        lazy = keops.load().LazyTensor
        original = lazy.sum  # of one symbol's coordinates, too

        def default_sum(self: object, *args: object, sum_scheme: object = None, **options: object) -> object:
            return original(self, *args, **options)

        lazy.sum = default_sum
        super().compile(task, steps)
