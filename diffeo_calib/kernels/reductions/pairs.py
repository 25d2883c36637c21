"""Pairwise scalars as matrices, each one matrix product of small vectors.

Distances use the expansion |e_i|^2 - 2 e_i . f_j + |f_j|^2. It loses digits far from the origin, so
callers shift the points to a common centre first.
"""

from __future__ import annotations

import torch
from torch import Tensor


class MatrixPairs:
    """Pairwise symbols as materialised (M, N) tensors, differentiable by autograd."""

    def dot(self, a: Tensor, b: Tensor) -> Tensor:
        """a_i . b_j: (M, k), (N, k) -> (M, N)."""
        return a @ b.T

    def squared_distance(self, e: Tensor, f: Tensor) -> Tensor:
        """|e_i - f_j|^2 up to rounding, possibly -1e-16: (M, D), (N, D) -> (M, N)."""
        return self.dot(*distance_factors(e, f))

    def squared_distance_change(self, e: Tensor, de: Tensor, f: Tensor, df: Tensor) -> Tensor:
        """2 (e_i - f_j) . (de_i - df_j), the derivative of the squared distance: (M, N)."""
        return self.dot(*distance_change_factors(e, de, f, df))


def distance_factors(e: Tensor, f: Tensor) -> tuple[Tensor, Tensor]:
    """Vectors (M, D + 2), (N, D + 2) whose dot products are |e_i - f_j|^2."""
    e2, f2 = _dots(e, e), _dots(f, f)
    return torch.cat([-2.0 * e, e2, torch.ones_like(e2)], -1), torch.cat([f, torch.ones_like(f2), f2], -1)


def distance_change_factors(e: Tensor, de: Tensor, f: Tensor, df: Tensor) -> tuple[Tensor, Tensor]:
    """Vectors (M, 2 D + 2), (N, 2 D + 2) whose dot products are 2 (e_i - f_j) . (de_i - df_j)."""
    ee, ff = 2.0 * _dots(e, de), 2.0 * _dots(f, df)
    left = torch.cat([-2.0 * e, -2.0 * de, ee, torch.ones_like(ee)], -1)
    return left, torch.cat([df, f, torch.ones_like(ff), ff], -1)


def _dots(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1, keepdim=True)


def weighted_sums(weights: list[Tensor], summands: list[Tensor]) -> list[Tensor]:
    """[sum_j w_ij b_j], transposed: weights (M, N) and summands (k, N) -> (k, M) each.

    On a CPU the product of a large matrix with a few columns is 2 to 3 times faster in this orientation.
    """
    return [b @ w.T for w, b in zip(weights, summands, strict=True)]
