"""Random numbers, and errors against the truth, for all tests."""

import torch
from torch import Tensor

LIMIT = 7.814728
"""Squared radius that holds 95 % of three normal numbers."""


def tensor(values: object) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def normal(*shape: int, seed: int = 0, size: float = 1.0) -> Tensor:
    generator = torch.Generator("cpu").manual_seed(seed)
    return size * torch.randn(shape, dtype=torch.float64, device="cpu", generator=generator)


def drawn(*shape: int, seed: int = 0) -> Tensor:
    """Uniform in [0, 1)."""
    return torch.rand(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def rms(errors: Tensor) -> float:
    """Of the lengths of vectors (..., 3)."""
    return float(errors.detach().square().sum(-1).mean().sqrt())


def inside(errors: Tensor, covariance: Tensor) -> float:
    """Share of errors (..., 3) in the 95 % regions of their covariances (..., 3, 3)."""
    return float(((errors * torch.linalg.solve(covariance, errors)).sum(-1) < LIMIT).double().mean())


def rigid_rms(points: Tensor, truth: Tensor) -> float:
    """RMS distance (..., 3) after the best rigid motion of all points, m."""
    a, b = points.detach().reshape(-1, 3), truth.reshape(-1, 3)
    middle, target = a.mean(0), b.mean(0)
    U, _, Vh = torch.linalg.svd((a - middle).mT @ (b - target))
    turn = torch.eye(3, dtype=a.dtype)
    turn[2, 2] = torch.linalg.det(U @ Vh)
    return rms((a - middle) @ U @ turn @ Vh + target - b)
