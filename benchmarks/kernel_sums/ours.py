"""The package's backends as methods, see landmarks.py."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import torch
from landmarks import LENGTHSCALE, Landmarks, TorchMethod
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.flows.geodesic import energy, geodesic_field
from diffeo_calib.flows.integrators import RungeKutta
from diffeo_calib.kernels.profiles import Profile
from diffeo_calib.kernels.reductions import keops
from diffeo_calib.kernels.reductions.backends import BACKENDS, Backend
from diffeo_calib.kernels.reductions.formulas import Formula, Points, matrices
from diffeo_calib.kernels.reductions.tiled import CPU_ELEMENTS
from diffeo_calib.kernels.reductions.tiled import Tiled as TiledSums


class Ours(TorchMethod):
    """The backend that `auto` chooses."""

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
        """Not used: the package's integrator does the steps."""
        raise NotImplementedError

    def sum(self) -> list[Tensor]:
        """Return v."""
        return [self.kernel.field(None, self.data.q, self.data.p)]

    def rhs(self) -> list[Tensor]:
        """dH/dp, dH/dq."""
        return list(self.kernel.hamiltonian_gradient(self.data.q, self.data.p))

    def adjoint(self) -> Callable[[], list[Tensor]]:
        """Return the Hessian product."""
        q, p, _, dq, dp = self.data
        return lambda: list(self.kernel.hessian_product(q, p, dq, dp))


class Dense(Ours):
    """One matrix."""

    backend = "dense"


class Fused(Ours):
    """Compiled loops."""

    backend = "fused"


class Tiled(Ours):
    """Tiles."""

    backend = "tiled"


class TiledRK4(Tiled):
    """Tiles, and the classical time stepping."""

    integrator = dc.RK4
    order = 4


class PlainTiles(TiledSums):
    """Tiled sums over all pairs of one set of points, with new matrices for every tile instead of pooled ones.

    Between two sets of points it is not written: no task here needs such sums.
    """

    def reduce(self, formula: Formula, profile: Profile, rows: Points | None, columns: Points) -> tuple[Tensor, ...]:
        """The results of a formula: every unordered pair of tiles once, as in the package."""
        if rows is not None:
            raise NotImplementedError
        if torch.is_grad_enabled() and any(t.requires_grad for t in columns.tensors):
            return super().reduce(formula, profile, rows, columns)  # with plain matrices already
        n, size = len(columns.features), int(CPU_ELEMENTS**0.5)
        tiles = [slice(k, min(k + size, n)) for k in range(0, n, size)]
        summands = [b.T.contiguous() for b in formula.summands(columns)]
        totals = [torch.zeros_like(b) for b in summands]  # (k, N)
        for a, i in enumerate(tiles):
            points = columns.rows(i)
            for j in tiles[a:]:
                weights = formula.weigh(matrices(points, columns.rows(j)), profile)
                for total, w, b in zip(totals, weights, summands, strict=True):
                    total[:, i] += b[:, j] @ w.T
                    if i != j:
                        total[:, j] += b[:, i] @ w
        return formula.finish([t.T for t in totals], columns)


class TiledUnpooled(Tiled):
    """Tiles of plain matrices: what the pool of tiled.py gains. In this process only."""

    def compile(self, task: str, steps: int) -> None:
        """Replace the package's tiled sums."""
        BACKENDS["tiled"] = PlainTiles()
        super().compile(task, steps)


class Keops(Ours):
    """Fused loops; where KeOps cannot run, an error instead of the package's fallback."""

    backend = "keops"

    def compile(self, task: str, steps: int) -> None:
        """Compile, or load the result of an earlier compilation."""
        keops.load()
        super().compile(task, steps)
        if not BACKENDS["keops"].usable():
            raise keops.KeopsUnavailableError("KeOps did not run")


class KeopsDefaultFlags(Keops):
    """The same formulas with the default compiler flags and summation scheme of pykeops."""

    environment: ClassVar[dict[str, str]] = {"CXXFLAGS": ""}

    def compile(self, task: str, steps: int) -> None:
        """Compile with the default summation scheme of LazyTensors, in this process."""
        lazy = keops.load().LazyTensor
        original = lazy.sum  # also sums over the coordinates of one symbol

        def default_sum(self: object, *args: object, sum_scheme: object = None, **options: object) -> object:
            return original(self, *args, **options)

        lazy.sum = default_sum
        super().compile(task, steps)
