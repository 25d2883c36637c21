"""A kernel of your own in 15 lines: fit with it, save the model and load it again.

    python scripts/examples/own_kernel.py

A kernel needs one method, the matrix of its values K(x_i, y_j). Fields, derivatives and covariances follow from it by
autograd. Closed forms, and sums that never build the matrix, are optional: `diffeo_calib/kernels/radial.py` has both.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.robots import elastic_rr


class Skewed(dc.Kernel):
    """K(x, y) = variance exp(-|x - y|^2 / (2 length^2)) [[1, c], [c, 1]]: a Gaussian with correlated components."""

    def __init__(self, length: float, variance: float, correlation: float) -> None:
        # Attributes with the names of the arguments: this is what a model file records.
        self.length, self.variance, self.correlation = length, variance, correlation

    def matrix(self, x: Tensor, y: Tensor) -> Tensor:
        """(M, 2), (N, 2) -> (2 M, 2 N): the two coordinates of a point are adjacent."""
        squares = (x[:, None] - y[None]).square().sum(-1)  # (M, N)
        kappa = self.variance * (-squares / (2 * self.length**2)).exp()
        coupling = torch.tensor([[1.0, self.correlation], [self.correlation, 1.0]], dtype=x.dtype, device=x.device)
        return torch.kron(kappa, coupling)


def mean_error(model: Callable[[Tensor], Tensor]) -> float:
    """Mean distance from the real arm at 1000 random configurations, length units."""
    x = 2 * torch.pi * torch.rand(1000, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    return float((model(x) - elastic_rr.real(x)).norm(dim=1).mean())


def main() -> None:
    """Fit the elastic two-link arm with this kernel in task space."""
    x = elastic_rr.grid(10)  # (100, 2) rad
    y = elastic_rr.real(x)  # (100, 2) measured positions, length units
    kernels = {"joint_kernel": dc.VonMises(1.0, variance=8.0), "task_kernel": Skewed(0.7, 1.0, correlation=0.3)}
    fit = dc.fit(dc.Problem(elastic_rr.nominal, x, y, noise=0.01, **kernels))
    print(fit.status)
    print(f"held-out error: nominal {mean_error(elastic_rr.nominal):.1e}, calibrated {mean_error(fit.model):.1e}")

    # A file records the name and the arguments of your kernel, not its code: pass the class again to load it.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "own_kernel.safetensors"
        dc.save(fit.model, path)
        loaded = dc.load(path, elastic_rr.nominal, kernels={"Skewed": Skewed})
    print(f"after loading: {mean_error(loaded):.1e}")

    # Kernels add, and other backends, solvers and integrators work as with the package's own kernels.
    kernels["task_kernel"] = Skewed(0.7, 0.5, correlation=0.3) + dc.Gaussian(0.7, 0.5)
    fit = dc.fit(dc.Problem(elastic_rr.nominal, x, y, noise=0.01, **kernels))
    print(f"sum of two kernels: {mean_error(fit.model):.1e}")


if __name__ == "__main__":
    main()
